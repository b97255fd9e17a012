"""Datasets and acquisitions for other programs: what is written is read back, by our importers and by those programs' rules."""

import csv
import json
import math

import h5py
import imageio.v3 as imageio
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import raytwin as rt
from raytwin.acquisition import (
    DatasetRow,
    Instrument,
    filters_from_text,
    open_acquisition,
    read_dataset,
    setting_from_text,
    write_acquisition,
    write_dataset,
)
from raytwin.acquisition.mask_shapes import iter_mask_shapes
from raytwin.cli import main

SHAPE = (14, 18)
SETTING = "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05;kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05"


def inside_outline(outline, shape):
    """Pixels whose centre lies inside an outline, by the even-odd rule."""
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    inside = np.zeros(shape, dtype=bool)
    for (x0, y0), (_, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= (columns > x0) & (rows > min(y0, y1)) & (rows < max(y0, y1))
    return inside


def from_run_lengths(counts, shape):
    values = np.repeat(np.arange(len(counts)) % 2, counts).astype(bool)
    return values.reshape(shape, order="F")


@settings(max_examples=60)
@given(arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_boxes_run_lengths_and_outlines_give_the_mask_back(mask):
    from scipy import ndimage

    shapes = list(iter_mask_shapes(mask))
    whole = np.zeros_like(mask)
    for shape in shapes:
        part = from_run_lengths(shape.counts, mask.shape)
        assert not (whole & part).any()
        whole |= part
        left, top, width, height = shape.box_px
        rows, columns = np.nonzero(part)
        assert (left, top, width, height) == (
            *(columns.min(), rows.min()),
            *(np.ptp(columns) + 1, np.ptp(rows) + 1),
        )
        assert shape.area_px == part.sum()
        # the outline leaves holes out; the outside of a part is what can be reached from the border, not across corners
        filled = ndimage.binary_fill_holes(part)
        np.testing.assert_array_equal(inside_outline(shape.outline_px, mask.shape), filled)
    np.testing.assert_array_equal(whole, mask)


@pytest.fixture
def dataset(tmp_path):
    rng = np.random.default_rng(3)
    path = tmp_path / "pairs.h5"
    with write_dataset(path, shape=SHAPE, provenance={"seed": 3}) as writer:
        for number in range(6):
            image = rng.normal(1.0, 0.5, (2, *SHAPE)).astype(np.float32)
            mask = np.zeros(SHAPE, dtype=bool)
            if number % 2:
                mask[2 : 4 + number, 3:7] = True
                mask[12, 15:17] = True
            writer.append(
                image=image,
                foreign_object_mask=mask,
                product_mask=np.ones(SHAPE),
                row=DatasetRow(
                    image=f"jar {number // 2}" if number < 4 else f"jar/{number}",
                    product=f"p{number}",
                    foreign_object="glass" if number % 2 else "",
                    size_mm=1.5 if number % 2 else math.nan,
                    contrast=0.25 if number % 2 else math.nan,
                    split=("train", "val", "test")[number % 3],
                    setting=SETTING,
                ),
            )
    return path


def test_coco_annotations_and_pictures_give_masks_and_values_back(dataset, tmp_path, json_of):
    assert json_of("export", dataset, "--to", "coco", "-o", tmp_path / "coco")["to"] == "coco"
    seen = set()
    with read_dataset(dataset) as pairs:
        for split in ("train", "val", "test"):
            content = json.loads((tmp_path / "coco" / "annotations" / f"{split}.json").read_text())
            info = content["info"]
            lowest, highest = np.array(info["lowest"]), np.array(info["highest"])
            for image in content["images"]:
                number = image["id"] - 1
                seen.add(number)
                assert pairs.rows[number].split == split
                picture = tifffile.imread(tmp_path / "coco" / image["file_name"])
                assert picture.shape == (image["height"], image["width"], 3) and picture.dtype == np.uint16
                values = lowest + picture[..., :2] / 65535 * (highest - lowest)
                step = (highest - lowest).max() / 65535
                np.testing.assert_allclose(np.moveaxis(values, -1, 0), pairs.images(number), atol=0.51 * step)
                mine = [one for one in content["annotations"] if one["image_id"] == image["id"]]
                mask = np.zeros(SHAPE, dtype=bool)
                for one in mine:
                    assert one["category_id"] == content["categories"][0]["id"] and one["iscrowd"] == 0
                    assert one["segmentation"]["size"] == list(SHAPE)
                    mask |= from_run_lengths(one["segmentation"]["counts"], SHAPE)
                np.testing.assert_array_equal(mask, pairs.foreign_object_masks(number))
                assert len(mine) == (2 if number % 2 else 0)
    assert seen == set(range(6))


def test_labels_are_of_yolo_alone(dataset, tmp_path):
    with pytest.raises(rt.InputError, match="labels: got boxes with coco; expected none"):
        rt.export(dataset, tmp_path / "coco", to="coco", labels="boxes")
    assert not (tmp_path / "coco").exists()


@pytest.mark.parametrize("labels", ["polygons", "boxes"])
def test_yolo_labels_are_shares_of_the_image(dataset, tmp_path, labels):
    written = rt.export(dataset, tmp_path / "yolo", to="yolo", labels=labels)
    assert "grey level" in written.warnings[-1]
    text = (tmp_path / "yolo" / "data.yaml").read_text()
    assert "train: images/train\nval: images/val\n" in text and "0: foreign_object" in text
    lines = (tmp_path / "yolo" / "labels" / "train" / "jar_1_3.txt").read_text().splitlines()
    assert len(lines) == 2 and all(line.startswith("0 ") for line in lines)
    values = np.array([float(word) for word in lines[0].split()[1:]])
    if labels == "boxes":
        np.testing.assert_allclose(values, [5 / 18, 4.5 / 14, 4 / 18, 5 / 14], atol=1e-6)
    else:
        corners = values.reshape(-1, 2) * (SHAPE[1], SHAPE[0])
        np.testing.assert_allclose(corners, [[3, 2], [7, 2], [7, 7], [3, 7]], atol=1e-4)
    pictures = sorted((tmp_path / "yolo" / "images").rglob("*.png"))
    assert len(pictures) == 6 and imageio.imread(pictures[0]).shape == (*SHAPE, 3)
    assert (tmp_path / "yolo" / "labels" / "train" / "jar_0.txt").read_text() == "", "a clean product has an empty file"


def test_tiff_of_a_dataset_states_pitch_and_setting_and_comes_back(dataset, tmp_path, capsys):
    folder = tmp_path / "tiff"
    assert main(["export", str(dataset), "--to", "tiff", "--pixel-mm", "0.15", "-o", str(folder)]) == 0
    with tifffile.TiffFile(folder / "low" / "jar_0.tif") as file:
        assert 'PhysicalSizeX="0.15"' in file.ome_metadata and "kv=40,power_w=40" in file.ome_metadata
        above, below = file.pages[0].tags["XResolution"].value
        assert above / below == pytest.approx(10 / 0.15) and file.pages[0].tags["ResolutionUnit"].value == 3
    assert main(["import", "reference", str(folder), "-o", str(tmp_path / "back.h5")]) == 0
    capsys.readouterr()
    with read_dataset(dataset) as pairs, read_dataset(tmp_path / "back.h5") as back:
        found = {row.product: number for number, row in enumerate(back.rows)}
        for number, row in enumerate(pairs.rows):
            again = found[row.product]
            np.testing.assert_array_equal(back.images(again), pairs.images(number))
            np.testing.assert_array_equal(back.foreign_object_masks(again), pairs.foreign_object_masks(number))
            assert (back.rows[again].split, back.rows[again].setting) == (row.split, row.setting)
    with (folder / "rows.csv").open(newline="", encoding="utf-8") as stream:
        assert [row["size_mm"] for row in csv.DictReader(stream)] == ["", "1.5"] * 3


@pytest.fixture
def session(tmp_path):
    rng = np.random.default_rng(5)
    path = tmp_path / "session.h5"
    instrument = Instrument(
        anode="W",
        pixel_mm=0.15,
        source_object_mm=990,
        source_detector_mm=1059,
        scintillator=filters_from_text("CsI:0.5"),
    )
    with write_acquisition(path, instrument) as writer:
        dark = rng.integers(90, 110, (3, *SHAPE)).astype(np.uint16)
        writer.add_series("dark", kind="dark", exposure_ms=20, frames=dark)
        for name, kind in (("flat 40", "flat"), ("jar", "object")):
            writer.add_series(
                name,
                kind=kind,
                frames=rng.integers(900, 1100, (2, *SHAPE)).astype(np.uint16),
                setting=setting_from_text("kv=40,current_ma=1,exposure_ms=20,filter=Cu:0.05+Al:1"),
                scene="jar" if kind == "object" else "",
                role="calibration" if kind == "flat" else None,
            )
        mask = np.zeros(SHAPE)
        mask[3:5, 6:9] = 1
        writer.add_scene(
            "jar", kind="product", thickness_mm={"pmma": np.full(SHAPE, 20.0)}, foreign_object_mask=mask, size_mm=1.5
        )
    return path


def same_series(first, second, words):
    np.testing.assert_allclose(second.read_frames(), first.read_frames())
    for word in words:
        assert getattr(second, word) == getattr(first, word), word


SETTING_WORDS = ("kind", "kV", "current_mA", "exposure_ms", "filters")


def test_tiff_of_an_acquisition_comes_back_whole(session, tmp_path):
    from raytwin.acquisition.images import import_images

    rt.export(session, tmp_path / "tiff", to="tiff")
    import_images(tmp_path / "tiff", tmp_path / "back.h5")
    with open_acquisition(session) as first, open_acquisition(tmp_path / "back.h5") as back:
        assert back.instrument == first.instrument
        for one, other in zip(first.series, back.series, strict=True):
            same_series(one, other, (*SETTING_WORDS, "name", "scene", "role", "averaged"))
        np.testing.assert_array_equal(back.scenes["jar"].foreign_object_mask, first.scenes["jar"].foreign_object_mask)
        np.testing.assert_array_equal(back.scenes["jar"].thickness_mm["pmma"], np.full(SHAPE, 20.0))
        assert back.scenes["jar"].size_mm == 1.5


def test_nxtomo_of_an_acquisition_comes_back_in_its_runs(session, tmp_path):
    from raytwin.acquisition.nxtomo import import_nxtomo

    rt.export(session, tmp_path / "nx", to="nxtomo")
    import_nxtomo(tmp_path / "nx" / "scan.nxs", tmp_path / "back.h5")
    with open_acquisition(session) as first, open_acquisition(tmp_path / "back.h5") as back:
        for one, other in zip(first.series, back.series, strict=True):
            same_series(one, other, ("kind", "exposure_ms"))
        assert back.instrument.pixel_mm == pytest.approx(0.15)


def test_dicom_of_an_acquisition_comes_back_with_its_settings(session, tmp_path):
    pytest.importorskip("pydicom", reason="DICOM files need the extra `dicom`")
    from raytwin.acquisition.dicom import import_dicom

    rt.export(session, tmp_path / "dicom", to="dicom")
    import_dicom(tmp_path / "dicom", tmp_path / "back.h5")
    with open_acquisition(session) as first, open_acquisition(tmp_path / "back.h5") as back:
        by_kind = {series.kind: series for series in back.series}
        for one in first.series:
            same_series(one, by_kind[one.kind], SETTING_WORDS)
        for word in ("anode", "pixel_mm", "source_object_mm", "source_detector_mm"):
            assert getattr(back.instrument, word) == getattr(first.instrument, word)


def test_a_zarr_store_holds_every_array_and_attribute_of_the_file(session, dataset, tmp_path):
    zarr = pytest.importorskip("zarr", reason="Zarr stores need the extra `zarr`")
    for name, source in (("session", session), ("dataset", dataset)):
        written = rt.export(source, tmp_path / name, to="zarr")
        assert list(written.files) == ["data.zarr"]
        store = zarr.open_group(tmp_path / name / "data.zarr", mode="r")
        arrays_there = []
        with h5py.File(source) as file:
            assert store.attrs["format"] == file.attrs["format"]

            def same(path, item, store=store, found=arrays_there):
                if not isinstance(item, h5py.Dataset):
                    return
                found.append(path)
                if h5py.check_string_dtype(item.dtype):
                    parent, _, name = path.rpartition("/")
                    assert (store[parent] if parent else store).attrs[name] == item.asstr()[()].tolist()
                    return
                np.testing.assert_array_equal(store[path][...], item[()])
                if item.ndim > 1:
                    assert store[path].metadata.dimension_names[-2:] == ("row", "column")
                    assert store[path].chunks[-2:] == item.shape[-2:]

            file.visititems(same)
        assert len(arrays_there) > 3


def test_real_numbers_keep_sixteen_bits_in_dicom(tmp_path):
    pytest.importorskip("pydicom", reason="DICOM files need the extra `dicom`")
    from raytwin.acquisition._image_files import read_image

    frame = np.random.default_rng(1).normal(0.5, 0.3, SHAPE).astype(np.float32)
    with write_acquisition(tmp_path / "a.h5") as writer:
        writer.add_series("flat", kind="flat", frames=frame[None])
    written = rt.export(tmp_path / "a.h5", tmp_path / "dicom", to="dicom")
    assert any("rescale slope" in text for text in written.warnings)
    again = read_image(tmp_path / "dicom" / "flat" / "0001.dcm")
    np.testing.assert_allclose(again, frame, atol=0.51 * np.ptp(frame) / 65533 + 1e-6)


@pytest.mark.parametrize(
    ("source", "words", "told"),
    [
        ("dataset", ["--to", "csv"], "one of coco, yolo, tiff, zarr for a dataset"),
        ("session", ["--to", "coco"], "one of tiff, nxtomo, dicom, zarr for an acquisition"),
        ("dataset", ["--to", "tiff", "--pixel-mm", "0"], "a finite pitch above 0 mm"),
        ("dataset", ["--to", "coco", "--setting", "kv=40,power_w=1,exposure_ms=1"], "only a twin is exported"),
    ],
)
def test_what_a_form_cannot_hold_is_one_line_and_leaves_nothing(request, tmp_path, capsys, source, words, told):
    path = request.getfixturevalue(source)
    before = sorted(tmp_path.iterdir())
    assert main(["export", str(path), *words, "-o", str(tmp_path / "out")]) == 2
    captured = capsys.readouterr()
    assert told in captured.err and captured.err.count("\n") == 1 and captured.out == ""
    assert sorted(tmp_path.iterdir()) == before
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept.txt").write_text("mine")
    form = "coco" if source == "dataset" else "tiff"
    assert main(["export", str(path), "--to", form, "-o", str(tmp_path / "full")]) == 2
    assert [one.name for one in (tmp_path / "full").iterdir()] == ["kept.txt"]


def test_a_file_that_is_not_there_is_what_its_form_is_made_of(tmp_path, refused_line):
    for form, kind in (("coco", "dataset"), ("nxtomo", "acquisition"), ("tiff", "dataset or acquisition")):
        assert f"none.h5; expected an existing {kind} file" in refused_line(
            "export", tmp_path / "none.h5", "--to", form, "-o", tmp_path / "out"
        )


# Our HDF5 files in viewers


def shown(file):
    """The array that a viewer opens first, by the rules of NeXus: `default` down to a group with `signal`."""
    node = file
    while "signal" not in node.attrs:
        assert node.attrs["NX_class"] in ("NXroot", "NXentry")
        node = node[node.attrs["default"]]
    assert node.attrs["NX_class"] == "NXdata"
    return node[node.attrs["signal"]]


def test_viewers_find_frames_and_images_as_pictures(session, dataset):
    with h5py.File(session) as file:
        assert shown(file).name == "/series/flat 40/frames" and shown(file).attrs["interpretation"] == "image"
        assert file["scenes/jar"].attrs["signal"] == "foreign_object_mask"
        assert file["scenes/jar/thickness_mm"].attrs["signal"] == "pmma"
    with h5py.File(dataset) as file:
        assert shown(file).name == "/images" and shown(file).attrs["interpretation"] == "image"
    with open_acquisition(session) as acquisition:
        assert dict(acquisition.attributes) == {"format": "raytwin-acquisition", "version": 1}
        assert dict(acquisition.scenes["jar"].attributes) == {}


def test_silx_shows_what_nexus_says(session, dataset):
    nxdata = pytest.importorskip("silx.io.nxdata", reason="silx is not installed")
    for path, shape in ((session, (2, *SHAPE)), (dataset, (6, 2, *SHAPE))):
        with h5py.File(path) as file:
            default = nxdata.get_default(file)
            assert default.is_valid and default.signal.shape == shape and default.interpretation == "image"

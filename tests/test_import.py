"""`raytwin import`: every layout on small files made here; damaged and incomplete input is one clear line."""

import csv
import json
import shutil
import tomllib
from pathlib import Path

import h5py
import imageio.v3 as imageio
import numpy as np
import pytest
import tifffile

from raytwin.acquisition import (
    Filter,
    Instrument,
    delta_r,
    open_acquisition,
    read_dataset,
    replace_bad_pixels,
    setting_from_text,
    write_acquisition,
)
from raytwin.acquisition._image_files import iter_images, read_image
from raytwin.acquisition.images import import_images
from raytwin.acquisition.nxtomo import import_nxtomo
from raytwin.acquisition.reference import import_reference
from raytwin.acquisition.zenodo import import_zenodo
from raytwin.cli import main
from raytwin.errors import FileFormatError, InputError

SHAPE = (12, 17)


def image(seed=0, dtype=np.uint16, shape=SHAPE):
    return np.random.default_rng(seed).integers(0, 4000, shape).astype(dtype)


# Folders of images


SIDECAR = """
[instrument]
anode = "W"
anode_angle_deg = 12
pixel_mm = 0.15
scintillator = "CsI:0.6"
bits = 12
counting = false

[[series]]
kind = "dark"
files = "dark/*.tif"
exposure_ms = 20

[[series]]
name = "flat"
kind = "flat"
files = ["flat/img_?.png", "flat/img_??.png"]
setting = "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05"
role = "calibration"
belt_speed_mm_s = 300

[[series]]
kind = "object"
for_each = "products/*"
files = "40kV*.tif"
name = "40kV"
kV = 40
exposure_ms = 20
filter = "Cu:0.05"

[[scene]]
kind = "product"
for_each = "products/*"
foreign_object_mask = "bone.png"
thickness_mm = { pmma = "pmma.tif" }
product = "fillet"
size_mm = 3.5
split = "val"
"""


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "session"
    for name in ("dark", "flat", "products/a", "products/b"):
        (root / name).mkdir(parents=True)
    tifffile.imwrite(root / "dark/stack.tif", np.stack([image(1), image(2)]), photometric="minisblack")
    tifffile.imwrite(root / "dark/tail.tif", image(3), compression="zlib")
    for number in (1, 2, 10):
        imageio.imwrite(root / f"flat/img_{number}.png", image(number))
    imageio.imwrite(root / "flat/unused.png", image())
    for seed, name in enumerate("ab"):
        tifffile.imwrite(root / f"products/{name}/40kV.tif", image(20 + seed).astype(np.float32) + 0.5)
        tifffile.imwrite(root / f"products/{name}/pmma.tif", np.full(SHAPE, 20, np.float32))
        colour = np.zeros((*SHAPE, 3), np.uint8)
        colour[2:4, 3:6, 0] = 255
        imageio.imwrite(root / f"products/{name}/bone.png", colour)
    (root / "raytwin.toml").write_text(SIDECAR)
    return root


def test_a_folder_comes_in_as_its_sidecar_says(folder, tmp_path, capsys):
    out = tmp_path / "out.h5"
    assert main(["import", "images", str(folder), "-o", str(out), "--json"]) == 0
    captured = capsys.readouterr()
    account = json.loads(captured.out)
    assert account["format"] == "acquisition" and account["frames"] == 8
    assert [skipped["what"] for skipped in account["skipped"]] == ["flat/unused.png"]
    assert "skipped flat/unused.png: no series or scene of the sidecar names it" in captured.err
    assert any("no source-detector distance" in note for note in account["notes"])
    with open_acquisition(out) as acquisition:
        assert acquisition.instrument.scintillator == (Filter(material="CsI", thickness_mm=0.6),)
        assert (acquisition.instrument.bits, acquisition.instrument.counting) == (12, False)
        dark, flat, a, b = acquisition.series
        assert [dark.name, flat.name, a.name, b.name] == ["001_dark", "flat", "a_40kV", "b_40kV"]
        np.testing.assert_array_equal(dark.read_frames(), [image(1), image(2), image(3)])
        np.testing.assert_array_equal(flat.read_frames(), [image(1), image(2), image(10)])
        assert flat.setting == setting_from_text("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05")
        assert (flat.role, flat.belt_speed_mm_s, dark.exposure_ms) == ("calibration", 300, 20)
        assert a.scene == "a" and a.setting == setting_from_text("kv=40,exposure_ms=20,filter=Cu:0.05")
        assert a.dtype == np.float32
        np.testing.assert_array_equal(b.read_frames()[0], image(21) + np.float32(0.5))
        scene = acquisition.scenes["b"]
        assert scene.foreign_object_mask.sum() == 6 and scene.thickness_mm["pmma"].max() == 20
        assert (scene.product, scene.size_mm, scene.attributes["split"]) == ("fillet", 3.5, "val")


def test_raw_files_are_read_by_their_layout(tmp_path):
    root = tmp_path / "raw"
    root.mkdir()
    frames = np.stack([image(4), image(5)]).astype(">u2")
    (root / "a.raw").write_bytes(b"head" + frames.tobytes())
    layout = f"[raw]\nrows = {SHAPE[0]}\ncolumns = {SHAPE[1]}\nbyte_order = 'big'\nheader_bytes = 4\n"
    (root / "raytwin.toml").write_text(layout + "[[series]]\nkind='flat'\nfiles='*.raw'\n")
    assert import_images(root, tmp_path / "o.h5").frames == 2
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        np.testing.assert_array_equal(acquisition.series[0].read_frames(), [image(4), image(5)])
    (root / "a.raw").write_bytes(b"head" + frames.tobytes()[:-1])
    with pytest.raises(InputError, match=r"a.raw: got 819 bytes; expected 4 \+ n x 408 bytes"):
        import_images(root, tmp_path / "o.h5")
    (root / "raytwin.toml").write_text("[[series]]\nkind='flat'\nfiles='*.raw'\n")
    with pytest.raises(InputError, match="a raw file without layout"):
        import_images(root, tmp_path / "o.h5")


@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_a_colour_tiff_of_sixteen_bits_is_one_image(tmp_path, planes):
    """Not a stack of as many images as it has rows."""
    root = tmp_path / "tiff"
    root.mkdir()
    grey = image(6)

    def write(colours):
        values = np.stack(colours, axis=-1 if planes == "contig" else 0)
        tifffile.imwrite(root / "a.tif", values, photometric="rgb", planarconfig=planes)

    write([grey] * 3)
    (root / "raytwin.toml").write_text("[[series]]\nkind='flat'\nfiles='*.tif'\n")
    import_images(root, tmp_path / "o.h5")
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        np.testing.assert_array_equal(acquisition.series[0].read_frames(), [grey])
    write([grey, grey, grey + 1])
    with pytest.raises(InputError, match=r"a.tif: got an image of shape \(.*3\); expected one grey value a pixel"):
        import_images(root, tmp_path / "o.h5")


def test_eight_bit_grey_and_grey_stored_as_colour_are_grey(tmp_path):
    root = tmp_path / "png"
    root.mkdir()
    grey = image(6, np.uint8)
    imageio.imwrite(root / "a.png", grey)
    imageio.imwrite(root / "b.png", np.repeat(grey[..., None], 3, axis=2))
    (root / "raytwin.toml").write_text("[[series]]\nkind='flat'\nfiles='*.png'\n")
    import_images(root, tmp_path / "o.h5")
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        frames = acquisition.series[0].read_frames()
    assert frames.dtype == np.uint16
    np.testing.assert_array_equal(frames, [grey, grey])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda root: (root / "raytwin.toml").unlink(), "raytwin.toml: got no such file; expected a sidecar"),
        (lambda root: (root / "raytwin.toml").write_text("[[series]"), "got text that is not TOML"),
        (
            lambda root: (root / "raytwin.toml").write_text("[instrument]\n", encoding="utf-16"),
            "raytwin.toml: got text in UTF-16; expected text in UTF-8; save it as UTF-8",
        ),
        (lambda root: (root / "raytwin.toml").write_text("[serie]\n", encoding="utf-8-sig"), "got the word 'serie'"),
        (lambda root: (root / "raytwin.toml").write_text("[serie]\n"), "got the word 'serie'; expected one of"),
        (
            lambda root: (root / "raytwin.toml").write_text("[instrument]\npixel = 1\n[[series]]\n"),
            "did you mean pixel_mm",
        ),
        (lambda root: (root / "raytwin.toml").write_text("[instrument]\n"), "got no [[series]]"),
        (
            lambda root: (root / "raytwin.toml").write_text("[[series]]\nfiles='x*.tif'\n"),
            "no file that matches 'x*.tif'",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text("[[series]]\nfiles='../*.tif'\n"),
            "a pattern below the folder",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text("[[series]]\nkind='lit'\nfiles='dark/*.tif'\n"),
            "kind of series 001_lit: got 'lit'; expected one of dark, flat",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text("[[series]]\nkind='flat'\nfiles='dark/*.tif'\nkV='40'\n"),
            "series 1, kV: got '40'; expected a number without quotes",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text("[[series]]\nkind='flat'\nfiles='dark/*.tif'\nkV=-40\n"),
            "import: error: raytwin.toml, series 1, kV: got -40 kV; expected a finite number above 0 kV",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text(
                "[[series]]\nkind='dark'\nfiles='dark/*.tif'\nexposure_ms=-20\n"
            ),
            "import: error: raytwin.toml, series 1, exposure_ms: got -20 ms; expected a finite number of 0 or more ms",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text(SIDECAR.replace("size_mm = 3.5", "size_mm = -3.5")),
            "import: error: raytwin.toml, scene 1, size_mm: got -3.5 mm",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text(
                "[instrument]\npixel_mm = -1\n" + SIDECAR[SIDECAR.index("[[") :]
            ),
            "import: error: raytwin.toml, [instrument], instrument pixel_mm: got -1",
        ),
        (
            lambda root: (root / "raytwin.toml").write_text("[[series]]\nkind='flat'\nfor_each='no*'\nfiles='*'\n"),
            "no folder that matches 'no*'",
        ),
        (lambda root: imageio.imwrite(root / "flat/img_2.png", image(shape=(3, 3))), "img_2.png: got 3 x 3 pixels"),
        (
            lambda root: tifffile.imwrite(root / "dark/tail.tif", np.full(SHAPE, 0.5, np.float32)),
            "tail.tif: got values that are not whole; expected whole detector numbers",
        ),
        (
            lambda root: imageio.imwrite(root / "products/a/bone.png", image(0, np.uint8, (3, 3))),
            "masks and maps of one",
        ),
        (
            lambda root: imageio.imwrite(
                root / "flat/img_1.png", np.random.default_rng(0).integers(0, 9, (4, 4, 3), np.uint8)
            ),
            "img_1.png: got an image of shape (4, 4, 3); expected one grey value a pixel",
        ),
        (
            lambda root: (root / "flat/img_1.png").write_bytes((root / "flat/img_1.png").read_bytes()[:150]),
            "img_1.png: got 150 bytes that cannot be decoded",
        ),
        (
            lambda root: (root / "dark/tail.tif").write_bytes((root / "dark/tail.tif").read_bytes()[:200]),
            "tail.tif: got 200 bytes that cannot be decoded",
        ),
        (lambda root: (root / "dark/tail.tif").write_bytes(b""), "tail.tif: got 0 bytes that cannot be decoded"),
    ],
)
def test_a_folder_that_cannot_be_read_says_what_to_change(folder, tmp_path, refused_import, change, message):
    change(folder)
    assert message in refused_import("images", folder, out=tmp_path / "out.h5")


def test_an_empty_folder_and_no_folder_are_told_apart(tmp_path, refused_import):
    (tmp_path / "empty").mkdir()
    for layout in ("images", "reference", "zenodo"):
        line = refused_import(layout, tmp_path / "empty", out=tmp_path / "o.h5")
        assert "got an empty folder" in line
        line = refused_import(layout, tmp_path / "absent", out=tmp_path / "o.h5")
        assert "got no such folder" in line
    assert "without EMVA1288_Data.txt" in refused_import("emva1288", tmp_path / "empty", out=tmp_path / "o.h5")
    assert "0 NeXus files" in refused_import("nxtomo", tmp_path / "empty", out=tmp_path / "o.h5")


# NXtomo


def nexus(path, keys, *, link=None, count_time=0.02, units="s", shape=SHAPE, data=True):
    frames = np.random.default_rng(0).integers(0, 4000, (len(keys), *shape)).astype(np.uint16)
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry1/tomo_entry/instrument/detector")
        detector["image_key"] = np.asarray(keys)
        if link is not None:
            detector["data"] = h5py.ExternalLink(link, "/entry/frames")
        elif data:
            detector["data"] = frames
            file["entry1/tomo_entry/data/data"] = h5py.SoftLink("/entry1/tomo_entry/instrument/detector/data")
            file["entry1/tomo_entry/data/image_key"] = h5py.SoftLink("/entry1/tomo_entry/instrument/detector/image_key")
        if count_time is not None:
            detector["count_time"] = count_time
            detector["count_time"].attrs["units"] = units
        detector["x_pixel_size"] = 2.5
        detector["x_pixel_size"].attrs["units"] = "um"
    return frames


def test_runs_of_one_kind_stay_apart_and_in_order(tmp_path):
    keys = [1, 1, 2, 2, 2, 0, 0, 3, 0, 1, 2]
    frames = nexus(tmp_path / "scan.nxs", keys, count_time=20, units="ms")
    report = import_nxtomo(tmp_path / "scan.nxs", tmp_path / "o.h5")
    assert [(entry["kind"], entry["frames"]) for entry in report.read] == [
        ("flat", 2), ("dark", 3), ("object", 2), ("object", 1), ("flat", 1), ("dark", 1)
    ]  # fmt: skip
    assert [(skipped.what, skipped.reason) for skipped in report.skipped] == [
        ("frames 7 to 7", "marked as invalid (image_key 3)")
    ]
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        kept = np.concatenate([series.read_frames() for series in acquisition.series])
        np.testing.assert_array_equal(kept, np.delete(frames, 7, axis=0))
        assert {series.exposure_ms for series in acquisition.series} == {20.0}
        assert acquisition.instrument.pixel_mm == pytest.approx(0.0025)
        assert acquisition.series[2].scene == "sample" and acquisition.series[0].scene == ""


def test_frames_behind_a_broken_link_are_found_beside_the_file(tmp_path):
    frames = nexus(tmp_path / "scan.nxs", [1, 2, 0], link="elsewhere/scan-frames.h5")
    with pytest.raises(InputError, match="got no frames: detector detector: its frames cannot be reached"):
        import_nxtomo(tmp_path / "scan.nxs", tmp_path / "o.h5")
    with h5py.File(tmp_path / "scan-frames.h5", "w") as file:
        file["entry/frames"] = frames
    assert import_nxtomo(tmp_path, tmp_path / "o.h5").frames == 3
    (tmp_path / "scan-frames.h5").write_bytes((tmp_path / "scan-frames.h5").read_bytes()[:500])
    with pytest.raises(InputError, match="truncated"):
        import_nxtomo(tmp_path / "scan.nxs", tmp_path / "o2.h5")
    assert not (tmp_path / "o2.h5").exists()


def test_a_change_of_exposure_time_starts_a_new_series(tmp_path):
    nexus(tmp_path / "scan.nxs", [1, 1, 1, 2], count_time=[0.01, 0.02, 0.02, 0.02])
    import_nxtomo(tmp_path / "scan.nxs", tmp_path / "o.h5")
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        assert [(series.n_frames, series.exposure_ms) for series in acquisition.series] == [(1, 10), (2, 20), (1, 20)]


def test_a_nexus_file_without_what_is_needed_says_what(tmp_path, refused_import):
    out = tmp_path / "o.h5"
    with h5py.File(tmp_path / "a.nxs", "w") as file:
        file["entry/data"] = 1
    assert "got no image_key" in refused_import("nxtomo", tmp_path / "a.nxs", out=out)
    nexus(tmp_path / "b.nxs", [1, 2], data=False)
    assert "got no frames" in refused_import("nxtomo", tmp_path / "b.nxs", out=out)
    nexus(tmp_path / "c.nxs", [1, 2, 0])
    with h5py.File(tmp_path / "c.nxs", "a") as file:
        del file["entry1/tomo_entry/instrument/detector/image_key"]
        file["entry1/tomo_entry/instrument/detector/image_key"] = [1, 2]
    assert "2 image_key values for 3 frames" in refused_import("nxtomo", tmp_path / "c.nxs", out=out)
    words = ("nxtomo", tmp_path / "c.nxs", "--detector", "other")
    assert "detector: got 'other'" in refused_import(*words, out=out)
    nexus(tmp_path / "d.nxs", [1, 2, 0])
    with h5py.File(tmp_path / "d.nxs", "a") as file:
        other = file.create_group("entry1/tomo_entry/instrument/camera")
        other["image_key"], other["data"] = [1, 2], np.ones((2, *SHAPE), np.uint16)
    assert "frames of several detectors" in refused_import("nxtomo", tmp_path / "d.nxs", out=out)
    assert import_nxtomo(tmp_path / "d.nxs", out, detector="camera").frames == 2
    out.unlink()
    (tmp_path / "e.nxs").write_bytes((tmp_path / "c.nxs").read_bytes()[:900])
    assert "truncated" in refused_import("nxtomo", tmp_path / "e.nxs", out=out)


def test_no_exposure_time_is_said_and_not_guessed(tmp_path):
    nexus(tmp_path / "a.nxs", [1, 2], count_time=None)
    report = import_nxtomo(tmp_path / "a.nxs", tmp_path / "o.h5")
    assert "no count_time: the exposure time is unknown" in report.notes
    nexus(tmp_path / "a.nxs", [1, 2], count_time=[-1.0, 2.0])
    report = import_nxtomo(tmp_path / "a.nxs", tmp_path / "o.h5")
    assert any("count_time holds 2 values" in note for note in report.notes)


# EMVA 1288


LIST = """# a comment
v 3.0
n 12 17 12
b 40000.0 120.0
i images\\b_1.png
i images\\B_2.png
d 40000.0
i images\\d_1.png
b 1180000.0 3546.0
"""


@pytest.fixture
def emva(tmp_path):
    root = tmp_path / "emva"
    (root / "images").mkdir(parents=True)
    for name, seed in (("b_1", 1), ("b_2", 2), ("d_1", 3)):
        imageio.imwrite(root / f"images/{name}.png", image(seed))
    (root / "EMVA1288_Data.txt").write_text(LIST)
    return root


def test_levels_of_an_emva_set_become_series_with_exposure_and_photons(emva, tmp_path, json_of):
    out = tmp_path / "o.h5"
    account = json_of("import", "emva1288", emva, "-o", out)
    assert account["skipped"] == [{"what": "bright level of 1.18 ms", "reason": "it lists no images"}]
    with open_acquisition(out) as acquisition:
        bright, dark = acquisition.series
        assert acquisition.instrument.bits == 12
        assert (bright.kind, bright.exposure_ms, bright.photons_per_pixel) == ("flat", 0.04, 120.0)
        assert (dark.kind, dark.exposure_ms, dark.photons_per_pixel) == ("dark", 0.04, None)
        np.testing.assert_array_equal(bright.read_frames(), [image(1), image(2)])
        np.testing.assert_array_equal(dark.read_frames(), [image(3)])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("i images\\d_1.png", "i images\\d_9.png", "line 8: got image images/d_9.png; expected a file that exists"),
        ("n 12 17 12", "n 12 16 12", "b_1.png: got 12 x 17 pixels; expected 12 x 16 as line n says"),
        ("b 40000.0 120.0", "b 40000.0", "line 4: got 40000.0; expected b EXPOSURE_NS PHOTONS"),
        ("b 40000.0 120.0", "b -4 120.0", "line 4: got -4 120.0"),
        ("b 40000.0 120.0", "", "line 5: got an image before any level"),
        ("d 40000.0", "d nan", "line 7: got nan"),
        ("i images\\d_1.png", "i", "line 8: got no file name"),
        (LIST, "v 3.0\n", "got no level with images"),
    ],
)
def test_a_list_that_cannot_be_read_names_its_line(emva, tmp_path, refused_import, old, new, message):
    (emva / "EMVA1288_Data.txt").write_text(LIST.replace(old, new))
    assert message in refused_import("emva1288", emva, out=tmp_path / "o.h5")


def test_lines_that_mean_nothing_are_reported_and_values_beyond_the_bits_are_noted(emva, tmp_path, capsys):
    (emva / "EMVA1288_Data.txt").write_text(LIST.replace("n 12", "n 8") + "x 1\n")
    assert main(["import", "emva1288", str(emva / "EMVA1288_Data.txt"), "-o", str(tmp_path / "o.h5")]) == 0
    captured = capsys.readouterr()
    assert "unknown line 'x 1'" in captured.err and "do not fit 8 bits" in captured.out


# The paper's data


def log_pair(number, *, bone):
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    high = 0.4 * np.exp(-((row - 6) ** 2 + (column - 8) ** 2) / 60).astype(np.float32)
    mask = (np.abs(row - 6) < 2) & (np.abs(column - 8) < 2) & bone
    low = (high * (1.7 + 0.05 * number * mask)).astype(np.float32)
    return low, high, np.stack([low > 0.1, mask]).astype(np.uint8)


COLUMNS = ("ID", "Original_ID", "Chicken_ID", "Bone_Class", "Bone_ID", "FO_size", "Attenuation", "Contrast")


def processed(root, *, sets=("Dataset #1",), exposures=("100ms_10avg",), splits=("train", "val", "test"), table=True):
    for data_set in sets:
        for exposure in exposures:
            for kV, channel in (("40kV_40W", 0), ("90kV_45W", 1)):
                for split in splits:
                    for name in ("NoBone", "RibBone"):
                        folder = root / data_set / f"{kV}_{exposure}" / split / name
                        folder.mkdir(parents=True)
                        rows = []
                        for number in (1, 2):
                            images = log_pair(number, bone=name == "RibBone")
                            tifffile.imwrite(folder / f"{number:03d}.tiff", images[channel])
                            if channel == 0:
                                masks = folder.with_name(f"{name}_segm")
                                masks.mkdir(exist_ok=True)
                                tifffile.imwrite(masks / f"{number:03d}.tiff", images[2], photometric="minisblack")
                            bone = name == "RibBone"
                            rows.append(
                                [
                                    number,
                                    number + 50,
                                    7,
                                    name,
                                    12 * bone,
                                    3.5 * bone,
                                    0.3,
                                    0.05 * number if bone else -1,
                                ]
                            )
                        if table:
                            with folder.with_name(f"{name}.csv").open("w", newline="") as stream:
                                writer = csv.writer(stream)
                                writer.writerow(
                                    [
                                        "ID",
                                        "Original_ID",
                                        "Chicken_ID",
                                        "Bone_Class",
                                        "Bone_ID",
                                        "FO_size",
                                        "Attenuation",
                                        "Contrast",
                                    ]
                                )
                                writer.writerows(rows)


def test_processed_images_become_pairs_with_masks_and_rows(tmp_path, json_of):
    processed(tmp_path / "Submission")
    out = tmp_path / "set1.h5"
    account = json_of("import", "zenodo", tmp_path, "-o", out)
    assert account["format"] == "dataset" and account["frames"] == 12 and account["skipped"] == []
    assert sum(entry["images"] for entry in account["read"]) == 12
    with read_dataset(out) as dataset:
        assert dataset.shape == SHAPE and not dataset.has_counts
        for split in ("train", "val", "test"):
            assert len(dataset.indices(split=split)) == 4
        number = [row.image for row in dataset.rows].index("train/RibBone/002")
        row = dataset.rows[number]
        assert (row.product, row.foreign_object, row.size_mm, row.contrast) == ("7", "RibBone 12", 3.5, 0.1)
        low, high = row.setting.split(";")
        assert setting_from_text(low) == setting_from_text(
            "kv=40,power_w=40,exposure_ms=100,filter=Cu:0.05,averaged=10"
        )
        assert setting_from_text(high).power_W == 45
        images = log_pair(2, bone=True)
        np.testing.assert_array_equal(dataset.images(number), images[:2])
        np.testing.assert_array_equal(dataset.product_masks(number), images[2][0] != 0)
        np.testing.assert_array_equal(dataset.foreign_object_masks(number), images[2][1] != 0)
        clean = dataset.rows[[row.image for row in dataset.rows].index("test/NoBone/001")]
        assert clean.foreign_object == "" and np.isnan(clean.size_mm) and np.isnan(clean.contrast)


def test_two_sets_and_several_exposures_stay_apart_in_the_rows(tmp_path):
    processed(tmp_path, splits=("train",))
    processed(tmp_path, sets=("Dataset #2",), exposures=("100ms_10avg", "20ms_1avg"), splits=("test",))
    report = import_zenodo(tmp_path, tmp_path / "all.h5")
    assert report.frames == 12
    with read_dataset(tmp_path / "all.h5") as dataset:
        settings = {row.setting for row in dataset.rows}
        assert len(settings) == 2
        assert {row.image.split("/")[0] for row in dataset.rows} == {"Dataset #1", "Dataset #2"}
        assert {row.product for row in dataset.rows} == {"Dataset #1/7", "Dataset #2/7"}
    assert import_zenodo(tmp_path, tmp_path / "short.h5", select="20ms").frames == 4
    assert import_zenodo(tmp_path / "Dataset #1", tmp_path / "one.h5").frames == 4


def test_images_without_partner_or_mask_are_skipped_with_the_reason(tmp_path):
    processed(tmp_path, splits=("train",))
    base = tmp_path / "Dataset #1"
    (base / "90kV_45W_100ms_10avg/train/RibBone/001.tiff").unlink()
    (base / "40kV_40W_100ms_10avg/train/RibBone/002.tiff").unlink()
    (base / "40kV_40W_100ms_10avg/train/NoBone_segm/001.tiff").unlink()
    (base / "40kV_40W_50ms_1avg/train/NoBone").mkdir(parents=True)
    report = import_zenodo(tmp_path, tmp_path / "o.h5")
    assert report.frames == 1
    assert {(skipped.what.split("Dataset #1/")[1], skipped.reason) for skipped in report.skipped} == {
        ("40kV_40W_50ms_1avg", "no tree of another tube voltage beside it"),
        ("40kV_40W_100ms_10avg/train/RibBone/001.tiff", "not there at 90 kV"),
        ("90kV_45W_100ms_10avg/train/RibBone/002.tiff", "not there at 40 kV"),
        ("40kV_40W_100ms_10avg/train/NoBone/001.tiff", "no mask of this number"),
    }


def test_without_table_the_contrast_comes_from_the_image(tmp_path):
    processed(tmp_path, splits=("test",), table=False)
    report = import_zenodo(tmp_path, tmp_path / "o.h5")
    assert any("no such table" in skipped.reason for skipped in report.skipped)
    with read_dataset(tmp_path / "o.h5") as dataset:
        number = [row.image for row in dataset.rows].index("test/RibBone/002")
        low, high, masks = log_pair(2, bone=True)
        assert dataset.rows[number].contrast == pytest.approx(delta_r(low, high, masks[1]))


def test_damaged_images_and_masks_of_another_shape_are_named(tmp_path, refused_import):
    processed(tmp_path / "in", splits=("test",))
    base = tmp_path / "in/Dataset #1/40kV_40W_100ms_10avg/test"
    mask = base / "NoBone_segm/001.tiff"
    tifffile.imwrite(mask, np.zeros((2, 3, 3), np.uint8), photometric="minisblack")
    line = refused_import("zenodo", tmp_path / "in", out=tmp_path / "o.h5")
    assert "001.tiff: got masks of shape (2, 3, 3); expected (2, 12, 17)" in line
    (base / "NoBone/001.tiff").write_bytes((base / "NoBone/001.tiff").read_bytes()[:300])
    line = refused_import("zenodo", tmp_path / "in", out=tmp_path / "o.h5")
    assert "001.tiff: got 300 bytes that cannot be decoded" in line
    tifffile.imwrite(base / "NoBone/001.tiff", np.full(SHAPE, np.nan, np.float32))
    assert "a value that is not finite" in refused_import("zenodo", tmp_path / "in", out=tmp_path / "o.h5")
    tifffile.imwrite(base / "NoBone/001.tiff", np.zeros((3, 3), np.float32))
    assert "got shape (12, 17); expected shape (3, 3)" in refused_import(
        "zenodo", tmp_path / "in", out=tmp_path / "o.h5"
    )


def raw_session(root, *, samples=2, exposures=("100ms_10avg", "20ms_1avg")):
    (root / "ff").mkdir(parents=True)
    dark = np.full(SHAPE, 100, np.uint16)
    tifffile.imwrite(root / "ff/di_pre.tif", dark)
    for exposure in exposures:
        for kV in ("40kV_40W", "90kV_45W"):
            tifffile.imwrite(root / f"ff/{kV}_{exposure}.tif", np.full(SHAPE, 4100, np.uint16))
    rows = []
    for number in range(1, samples + 1):
        bone = number % 2 == 0
        folder = root / f"{number:03d}"
        folder.mkdir()
        low, high, masks = log_pair(number, bone=bone)
        tifffile.imwrite(folder / "di_pre.tif", dark)
        for exposure in exposures:
            for kV, log_image in (("40kV_40W", low), ("90kV_45W", high)):
                counts = np.rint(100 + 4000 * np.exp(-log_image)).astype(np.uint16)
                tifffile.imwrite(folder / f"{kV}_{exposure}.tif", counts)
        if bone:
            colour = np.zeros((*SHAPE, 3), np.uint8)
            colour[..., 0] = 255 * masks[1]
            imageio.imwrite(folder / "segm.png", colour)
        rows.append([number, 7, "RibBone" if bone else "NoBone", 12 if bone else 0])
    for name, header, table in (
        ("stats.csv", ["Sample", "Chicken", "Bone_Class", "Bone"], rows),
        ("bone_size.csv", ["Bone_Class", "Bone", "Size_mm"], [["RibBone", 12, 4.5]]),
    ):
        with (root / name).open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(header)
            writer.writerows(table)


def test_a_raw_session_becomes_an_acquisition_that_makes_the_dataset(tmp_path, capsys, json_of):
    raw_session(tmp_path / "session")
    out = tmp_path / "session.h5"
    assert main(["import", "zenodo", str(tmp_path / "session"), "-o", str(out)]) == 0
    assert "acquisition file" in capsys.readouterr().out
    with open_acquisition(out) as acquisition:
        assert acquisition.instrument.pixel_mm == 0.15
        assert len(acquisition.of_kind("object")) == 8 and len(acquisition.of_kind("flat")) == 4
        assert {series.exposure_ms for series in acquisition.of_kind("dark")} == {100, 20, None}
        flat = acquisition.of_kind("flat")[0]
        assert flat.filters == (Filter(material="Cu", thickness_mm=0.05),)
        scene = acquisition.scenes["002"]
        assert (scene.product, scene.foreign_object, scene.size_mm) == ("7", "RibBone 12", 4.5)
        np.testing.assert_array_equal(scene.foreign_object_mask, log_pair(2, bone=True)[2][1] != 0)
        assert not acquisition.scenes["001"].foreign_object_mask.any()
    words = ["--low", "kv=40,exposure_ms=20", "--high", "kv=90,exposure_ms=20"]
    assert json_of("import", "reference", out, "-o", tmp_path / "d.h5", *words)["frames"] == 2
    with read_dataset(tmp_path / "d.h5") as dataset:
        low, high, _ = log_pair(2, bone=True)
        np.testing.assert_allclose(dataset.images(1), [low, high], atol=4e-4)
        assert dataset.rows[1].size_mm == 4.5
        assert dataset.rows[1].contrast == pytest.approx(0.1, abs=0.01)


def test_samples_without_folder_row_or_mask_are_reported(tmp_path):
    raw_session(tmp_path / "s", samples=4, exposures=("100ms_10avg",))
    shutil.rmtree(tmp_path / "s/001")
    (tmp_path / "s/002/segm.png").unlink()
    shutil.copytree(tmp_path / "s/003", tmp_path / "s/009")
    shutil.copy(tmp_path / "s/ff/di_pre.tif", tmp_path / "s/003/notes.tif")
    report = import_zenodo(tmp_path / "s", tmp_path / "o.h5")
    told = {skipped.what: skipped.reason for skipped in report.skipped}
    assert told["s, sample 1"] == "in stats.csv but without a folder"
    assert told["s/009"] == "no row in stats.csv"
    assert told["003/notes.tif"] == "its name is no setting"
    assert any("sample 002: no segm.png" in note for note in report.notes)
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        assert acquisition.scenes["002"].foreign_object_mask is None
        assert {series.exposure_ms for series in acquisition.of_kind("dark")} == {100}
    (tmp_path / "s/stats.csv").write_text("Sample,Bone\n1,2\n")
    with pytest.raises(InputError, match="got columns Sample, Bone; expected Sample, Chicken, Bone_Class, Bone"):
        import_zenodo(tmp_path / "s", tmp_path / "p.h5")
    assert not (tmp_path / "p.h5").exists()


def test_calibration_flats_keep_their_powers_and_the_darks_before_and_after(tmp_path, capsys, refused_import):
    root = tmp_path / "flats"
    for power in (1, 3, 10):
        (root / f"{power}W").mkdir(parents=True)
        for number in range(3):
            tifffile.imwrite(root / f"{power}W/{number}.tif", image(number))
        for name in ("di_pre", "di_post"):
            tifffile.imwrite(root / f"{power}W/{name}.tif", image(9))
    out = tmp_path / "o.h5"
    assert main(["import", "zenodo", str(root), "-o", str(out), "--kv", "90", "--exposure-ms", "20"]) == 0
    capsys.readouterr()
    with open_acquisition(out) as acquisition:
        assert [series.name for series in acquisition.series[:3]] == ["1W_di_pre", "1W_flat", "1W_di_post"]
        assert [series.power_W for series in acquisition.of_kind("flat")] == [1, 3, 10]
        assert acquisition.of_kind("flat")[0].setting == setting_from_text(
            "kv=90,power_w=1,exposure_ms=20,filter=Cu:0.05"
        )
        assert acquisition.of_kind("flat")[0].n_frames == 3
    report = import_zenodo(root, out)
    assert any("give them with --kv and --exposure-ms" in note for note in report.notes)
    line = refused_import("zenodo", root, "--kv", "-90", out=tmp_path / "p.h5")
    assert "--kv: got -90.0 kV" in line


# A user's own reference images


PAIRS = """
[instrument]
pixel_mm = 0.45
[pairs]
low = "*/low.tif"
high = "*/high.tif"
foreign_object_mask = "*/bone.png"
product_mask = "*/product.png"
values = "log"
low_setting = "kv=40,exposure_ms=100"
high_setting = "kv=90,exposure_ms=100"
rows = "rows.csv"
"""


@pytest.fixture
def pairs(tmp_path):
    root = tmp_path / "pairs"
    for number in range(1, 4):
        low, high, masks = log_pair(number, bone=number != 1)
        (root / f"p{number}").mkdir(parents=True)
        tifffile.imwrite(root / f"p{number}/low.tif", low)
        tifffile.imwrite(root / f"p{number}/high.tif", high)
        imageio.imwrite(root / f"p{number}/bone.png", 255 * masks[1])
        imageio.imwrite(root / f"p{number}/product.png", 255 * masks[0])
    (root / "rows.csv").write_text("image,product,foreign_object,size_mm,split\np2,fillet,rib,2.5,train\np1,,,,val\n")
    (root / "raytwin.toml").write_text(PAIRS)
    return root


def test_corrected_pairs_with_masks_become_a_dataset(pairs, tmp_path, json_of):
    out = tmp_path / "d.h5"
    account = json_of("import", "reference", pairs, "-o", out)
    assert account["read"][0]["images"] == 3 and account["read"][0]["with_foreign_object"] == 2
    with read_dataset(out) as dataset:
        assert [row.image for row in dataset.rows] == ["p1", "p2", "p3"]
        assert [row.split for row in dataset.rows] == ["val", "train", "test"]
        row = dataset.rows[1]
        assert (row.product, row.foreign_object, row.size_mm) == ("fillet", "rib", 2.5)
        low, high, masks = log_pair(2, bone=True)
        np.testing.assert_array_equal(dataset.images(1), [low, high])
        np.testing.assert_array_equal(dataset.product_masks(1), masks[0] != 0)
        assert row.contrast == pytest.approx(delta_r(low, high, masks[1]))
        assert any("--ring-px 7 makes it as wide" in note for note in account["notes"])
        assert dataset.rows[2].foreign_object == "unnamed" and dataset.rows[0].foreign_object == ""


def test_transmissions_are_made_logarithmic(pairs, tmp_path):
    for path in pairs.glob("*/*.tif"):
        tifffile.imwrite(path, np.exp(-tifffile.imread(path)))
    (pairs / "raytwin.toml").write_text(PAIRS.replace('"log"', '"transmission"'))
    import_reference(pairs, tmp_path / "d.h5")
    with read_dataset(tmp_path / "d.h5") as dataset:
        np.testing.assert_allclose(dataset.images(1), log_pair(2, bone=True)[:2], atol=1e-6)


def test_incomplete_pairs_are_skipped_and_products_dealt_out(pairs, tmp_path):
    (pairs / "p1/high.tif").unlink()
    (pairs / "p3/bone.png").unlink()
    report = import_reference(pairs, tmp_path / "d.h5", validation=1.0, rng=np.random.default_rng(0))
    assert [(skipped.what, skipped.reason.split(" (")[0]) for skipped in report.skipped] == [
        ("image p1", "no high image"),
        ("image p3", "no foreign_object_mask"),
    ]
    with read_dataset(tmp_path / "d.h5") as dataset:
        assert [row.split for row in dataset.rows] == ["val"]
    (pairs / "raytwin.toml").write_text(PAIRS + 'without_mask = "clean"\n')
    assert import_reference(pairs, tmp_path / "d.h5").frames == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('low = "*/low.tif"', 'low = "low.tif"', "[pairs], low: got 'low.tif'; expected a pattern with one '*'"),
        ('low = "*/low.tif"', 'low = "x/*.tif"', "got no image pair with mask (image p1: no low image)"),
        ('low = "*/low.tif"\n', "", "[pairs]: got no low; expected low = ..."),
        ('"log"', '"linear"', "[pairs], values: got 'linear'; expected one of log, transmission"),
        ("kv=40,", "kv=90,", "got 90 kV and 90 kV; expected the lower tube voltage as low"),
        ("rows.csv", "table.csv", "[pairs], rows: got table.csv; expected a csv file"),
        ("product_mask", "products_mask", "did you mean product_mask"),
    ],
)
def test_a_sidecar_of_pairs_that_cannot_be_used_says_why(pairs, tmp_path, refused_import, old, new, message):
    (pairs / "raytwin.toml").write_text(PAIRS.replace(old, new))
    assert message in refused_import("reference", pairs, out=tmp_path / "d.h5")


def test_a_ring_narrower_than_a_pixel_is_refused(pairs, tmp_path, refused_import):
    line = refused_import("reference", pairs, "--ring-px", "0", out=tmp_path / "d.h5")
    assert "dilations: got 0; expected 1 pixel or more" in line


def test_masks_of_another_shape_are_refused(pairs, tmp_path, refused_import):
    imageio.imwrite(pairs / "p2/bone.png", np.zeros((3, 3), np.uint8))
    line = refused_import("reference", pairs, out=tmp_path / "d.h5")
    assert "bone.png: got a mask of 3 x 3 pixels; expected 12 x 17 as the images" in line


def test_raw_series_with_a_sidecar_become_a_dataset_directly(tmp_path):
    root = tmp_path / "raw"
    low, high, masks = log_pair(2, bone=True)
    (root / "p").mkdir(parents=True)
    lines = ["[[series]]", "kind='dark'", "files='dark.tif'", "exposure_ms=20"]
    tifffile.imwrite(root / "dark.tif", np.full(SHAPE, 100, np.uint16))
    for kv, log_image in ((40, low), (90, high)):
        tifffile.imwrite(root / f"flat{kv}.tif", np.full(SHAPE, 4100, np.uint16))
        tifffile.imwrite(root / f"p/{kv}.tif", np.rint(100 + 4000 * np.exp(-log_image)).astype(np.uint16))
        setting = f"setting='kv={kv},exposure_ms=20'"
        lines += ["[[series]]", "kind='flat'", f"files='flat{kv}.tif'", setting]
        lines += ["[[series]]", "kind='object'", "for_each='p'", f"files='{kv}.tif'", f"name='{kv}'", setting]
    imageio.imwrite(root / "p/bone.png", 255 * masks[1])
    lines += ["[[scene]]", "for_each='p'", "foreign_object_mask='bone.png'"]
    (root / "raytwin.toml").write_text("\n".join(lines))
    report = import_reference(root, tmp_path / "d.h5")
    assert (report.frames, report.skipped) == (1, ())
    with read_dataset(tmp_path / "d.h5") as dataset:
        np.testing.assert_allclose(dataset.images(0), [low, high], atol=4e-4)


def test_an_acquisition_without_pairs_makes_no_dataset(tmp_path, refused_import):
    with write_acquisition(tmp_path / "a.h5", Instrument()) as writer:
        writer.add_series("flat", kind="flat", frames=image()[None])
    line = refused_import("reference", tmp_path / "a.h5", out=tmp_path / "d.h5")
    assert "expected object series at two tube voltages that name the same scene" in line
    (tmp_path / "cut.h5").write_bytes((tmp_path / "a.h5").read_bytes()[:2000])
    assert "truncated" in refused_import("reference", tmp_path / "cut.h5", out=tmp_path / "d.h5")


@pytest.mark.parametrize("layout", ["images", "dicom", "xtekct", "nxtomo", "emva1288", "zenodo", "reference"])
def test_every_layout_has_a_help_with_an_example(layout, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["import", layout, "--help"])
    assert caught.value.code == 0
    assert f"raytwin import {layout}" in capsys.readouterr().out


def test_an_output_that_cannot_be_written_is_one_line(emva, tmp_path, refused_line):
    (tmp_path / "file").write_text("")
    for out, told in ((tmp_path, "got a folder"), (tmp_path / "file" / "o.h5", "got a place that cannot be written")):
        line = refused_line("import", "emva1288", emva, "-o", out)
        assert told in line and line.count("\n") == 1


def test_bad_pixels_of_a_twin_are_replaced_in_every_image(pairs, tmp_path):
    bad = np.zeros(SHAPE, bool)
    bad[6, 8] = True
    import_reference(pairs, tmp_path / "d.h5", bad_pixels=bad)
    with read_dataset(tmp_path / "d.h5") as dataset:
        images = np.stack(log_pair(2, bone=True)[:2])
        np.testing.assert_array_equal(dataset.images(1), replace_bad_pixels(images, bad))
        assert (dataset.images(1) != images).any()


def test_the_name_of_a_shipped_twin_gives_its_bad_pixels(pairs, tmp_path, refused_line):
    words = ["import", "reference", str(pairs), "-o", str(tmp_path / "d.h5"), "--twin", "virtual_lab"]
    assert (
        "map of bad pixels: got 64 x 64 pixels; expected 12 x 17 pixels as in the images; give the map, or the twin"
        in refused_line(*words)
    )


def test_the_sidecars_of_the_manual_are_read(folder, pairs, tmp_path):
    manual = (Path(__file__).parents[1] / "docs" / "importing.md").read_text()
    series, corrected = [part.split("```")[0] for part in manual.split("```toml\n")[1:]]
    tables = tomllib.loads(series)
    assert set(tables) == {"instrument", "raw", "series", "scene"}
    (folder / "rows.csv").write_text("scene,product,size_mm,split\na,thigh,2.5,train\n")
    (folder / "raytwin.toml").write_text(
        series.replace("flat_40kV/*.tif", "flat/*.png").replace("product_mask", "# ").replace("thickness_pmma", "pmma")
    )
    assert import_images(folder, tmp_path / "o.h5").frames == 9
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        a, b = (acquisition.scenes[name] for name in "ab")
        assert (a.product, a.foreign_object, a.size_mm, a.attributes["split"]) == ("thigh", "rib bone", 2.5, "train")
        assert (b.product, b.foreign_object, b.size_mm) == ("fillet", "rib bone", 3.5)
    folders = corrected.replace("low/*.tif", "*/low.tif").replace("high/*.tif", "*/high.tif")
    (pairs / "raytwin.toml").write_text(folders.replace("bone/*.png", "*/bone.png").replace("product/*.", "*/product."))
    assert import_reference(pairs, tmp_path / "d.h5").frames == 3


EMVA_LIST = """v 3.0
n {bits} 40 32
b 0.0 {first}
i b0_1.png
i b0_2.png
{levels}
d 0.0
i d0_1.png
i d0_2.png
d 1000000.0
i d1_1.png
i d1_2.png
"""


@pytest.mark.parametrize(("bits", "gain_DN", "first_photons"), [(8, 0.05, 0.0), (12, 0.4, 50.0)])
def test_emva_sets_with_an_exposure_of_0_import_and_calibrate(tmp_path, json_of, bits, gain_DN, first_photons):
    """The dark end of a set with pulsed light, or a camera whose shortest exposure is not told, has 0 ns."""
    rng = np.random.default_rng(bits)
    root = tmp_path / "set"
    root.mkdir()
    full = 2**bits - 1
    levels = [first_photons, *(full / gain_DN * share for share in (0.1, 0.2, 0.4, 0.6))]

    def write(name, electrons):
        values = 10.0 + gain_DN * rng.poisson(electrons, (32, 40)) + rng.normal(0.0, 1.5, (32, 40))
        values = np.clip(np.rint(values), 0, full).astype(np.uint8 if bits == 8 else np.uint16)
        imageio.imwrite(root / f"{name}.png", values)

    lines = []
    for number, electrons in enumerate(levels):
        for frame in (1, 2):
            write(f"b{number}_{frame}", electrons)
        if number:
            lines += [f"b 1000000.0 {electrons}", f"i b{number}_1.png", f"i b{number}_2.png"]
    for number in (0, 1):
        for frame in (1, 2):
            write(f"d{number}_{frame}", 0.0)
    text = EMVA_LIST.format(bits=bits, first=first_photons, levels="\n".join(lines))
    (root / "EMVA1288_Data.txt").write_text(text)
    assert json_of("import", "emva1288", root, "-o", tmp_path / "o.h5")["frames"] == 14
    (level,) = json_of("calibrate", tmp_path / "o.h5", "-o", tmp_path / "twin.h5")["levels"]
    assert level["gain_DN_low"] < gain_DN < level["gain_DN_high"]


def test_a_photon_counter_without_darks_has_a_dark_of_0_by_declaration(tmp_path, capsys, json_of):
    rng = np.random.default_rng(4)
    folder = tmp_path / "counter"
    folder.mkdir()
    sidecar = "[instrument]\ncounting = true\n"
    for mean in (200, 400, 800):
        for frame in range(4):
            tifffile.imwrite(folder / f"flat{mean}_{frame}.tif", rng.poisson(mean, (48, 64)).astype(np.uint16))
        sidecar += f'[[series]]\nkind = "flat"\nfiles = "flat{mean}_*.tif"\nexposure_ms = {mean}\n'
    (folder / "raytwin.toml").write_text(sidecar)
    assert main(["import", "images", str(folder), "-o", str(tmp_path / "o.h5")]) == 0
    capsys.readouterr()
    answer = json_of("calibrate", tmp_path / "o.h5", "-o", tmp_path / "twin.h5")
    assert answer["dark_DN"]["value"] == 0.0
    assert answer["levels"][0]["gain_DN"] == pytest.approx(1.0, rel=0.05)


def test_a_broken_tag_that_does_not_matter_is_not_told_and_one_that_does_is_an_error(tmp_path, caplog):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, image(1), metadata=None, description="x" * 40)
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        places = {tag.code: tag.offset for tag in file.pages[0].tags}
    # tag 270, the description: its number of values leads beyond the file
    data[places[270] + 8 : places[270] + 12] = (2**31).to_bytes(4, "little")
    path.write_bytes(data)
    np.testing.assert_array_equal(read_image(path), image(1))
    assert not caplog.records
    # tag 273, where the picture's numbers lie
    data[places[273] + 2 : places[273] + 4] = (99).to_bytes(2, "little")
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"a\.tif"):
        read_image(path)
    assert not caplog.records, "the error says it"


def test_fits_images_come_in_as_they_are_stored_unsigned_and_in_stacks(tmp_path):
    fits = pytest.importorskip("astropy.io.fits", reason="FITS files need the extra `fits`")
    frames = np.stack([image(1), image(2)])
    fits.PrimaryHDU(frames).writeto(tmp_path / "stack.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(frames[0])]).writeto(tmp_path / "extension.fit")
    np.testing.assert_array_equal(list(iter_images(tmp_path / "stack.fits")), frames)
    np.testing.assert_array_equal(read_image(tmp_path / "extension.fit"), frames[0])
    extensions = [fits.PrimaryHDU(), *(fits.ImageHDU(frame) for frame in (frames[0], frames[1], frames[1]))]
    fits.HDUList(extensions).writeto(tmp_path / "several.fits")
    (tmp_path / "raytwin.toml").write_text('[[series]]\nkind = "dark"\nfiles = "several.fits"\nexposure_ms = 20\n')
    report = import_images(tmp_path, tmp_path / "out.h5")
    assert any("2 images behind the first of several.fits not taken" in note for note in report.notes)
    whole = (tmp_path / "stack.fits").read_bytes()
    (tmp_path / "cut.fits").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileFormatError, match=r"cut\.fits"):
        list(iter_images(tmp_path / "cut.fits"))

"""The acquisition file: what was written comes back, in pieces; what cannot be read is one clear line."""

import tracemalloc

import h5py
import numpy as np
import pytest

from raytwin.acquisition import (
    Filter,
    Instrument,
    Setting,
    filters_from_text,
    open_acquisition,
    setting_from_text,
    write_acquisition,
)
from raytwin.errors import FileFormatError, InputError

INSTRUMENT = Instrument(
    anode="W",
    anode_angle_deg=12.0,
    inherent_filtration=filters_from_text("Be:0.8+Al:0.5"),
    source_object_mm=990.0,
    source_detector_mm=1059.0,
    pixel_mm=0.15,
    detector="area",
    counting=False,
    scintillator=filters_from_text("CsI:0.6"),
    detector_cover=filters_from_text("C:1"),
    focal_spot_mm=0.0,
    bits=16,
    maximum_power_w=45.0,
    readout_ms=1.5,
    belt_axis="column",
)
SETTING = setting_from_text("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05,averaged=10,source_detector_mm=1059")


def frames_of(n, rows=6, columns=5, *, seed=0, dtype=np.uint16):
    return np.random.default_rng(seed).integers(0, 65535, (n, rows, columns)).astype(dtype)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "session.h5"


def small(path, **attributes):
    """A file with one dark and one flat series; the flat's attributes can be set afterwards."""
    with write_acquisition(path, INSTRUMENT) as writer:
        writer.add_series("dark", kind="dark", frames=frames_of(3), exposure_ms=20)
        writer.add_series("flat", kind="flat", frames=frames_of(4, seed=1), setting=SETTING, scene="")
    with h5py.File(path, "a") as file:
        for name, value in attributes.items():
            file["series/flat"].attrs[name] = value


def fails(path):
    with pytest.raises(FileFormatError) as caught:
        open_acquisition(path).close()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_instrument_series_and_scene_come_back_as_written(path):
    thickness = np.linspace(0, 30, 30, dtype=np.float32).reshape(6, 5)
    mask = np.eye(6, 5)
    with write_acquisition(path, INSTRUMENT) as writer:
        writer.attributes["operator"] = "A"
        writer.add_series("second", kind="flat", frames=frames_of(4), setting=SETTING, index=7, role="evaluation")
        writer.add_series(
            "first",
            kind="object",
            frames=np.full((2, 6, 5), 1.5),
            index=3,
            setting=setting_from_text("kv=90,current_ma=0.5,exposure_ms=100"),
            frame_interval_ms=120,
            belt_speed_mm_s=300,
            panel_rotation_deg=90,
            source_object_mm=900,
            photons_per_pixel=1234.5,
            scene="chicken",
            corrected=("gain", "offset"),
            time_s=[0.0, 0.12],
        )
        writer.add_series("third", kind="afterglow", frames=frames_of(1), exposure_ms=20, kV=0)
        writer.add_scene(
            "chicken",
            kind="product",
            thickness_mm={"chicken_breast": thickness},
            foreign_object_mask=mask,
            product_mask=np.ones((6, 5)),
            product="fillet 3",
            foreign_object="bone 2",
            size_mm=3.5,
            attributes={"split": "val"},
        )
    with open_acquisition(path) as acquisition:
        assert acquisition.instrument == INSTRUMENT
        assert acquisition.attributes["operator"] == "A"
        first, second, third = acquisition.series
        assert [first.name, second.name, third.name] == ["first", "second", "third"]
        assert second.setting == SETTING
        assert second.filters == (Filter(material="Cu", thickness_mm=0.05),)
        assert (second.role, second.averaged, second.power_W) == ("evaluation", 10, 40.0)
        assert first.setting == Setting(kV=90, current_mA=0.5, exposure_ms=100)
        assert first.corrected == frozenset({"offset", "gain"})
        assert (first.frame_interval_ms, first.belt_speed_mm_s, first.panel_rotation_deg) == (120, 300, 90)
        assert (first.source_object_mm, first.photons_per_pixel, first.scene) == (900, 1234.5, "chicken")
        assert first.dtype == np.float32
        np.testing.assert_array_equal(first.time_s, [0.0, 0.12])
        assert third.kV is None and third.setting is None and third.exposure_ms == 20
        np.testing.assert_array_equal(second.read_frames(), frames_of(4))
        scene = acquisition.scenes["chicken"]
        np.testing.assert_array_equal(scene.thickness_mm["chicken_breast"], thickness)
        np.testing.assert_array_equal(scene.foreign_object_mask, mask != 0)
        assert scene.product_mask.all()
        assert (scene.product, scene.foreign_object, scene.size_mm) == ("fillet 3", "bone 2", 3.5)
        assert dict(scene.attributes) == {"split": "val"}


@pytest.mark.parametrize("compression", [None, "lzf", "gzip"])
def test_compression_changes_the_file_and_not_the_frames(path, compression):
    with write_acquisition(path, compression=compression) as writer:
        writer.add_series("flat", kind="flat", frames=frames_of(9))
    with open_acquisition(path) as acquisition:
        np.testing.assert_array_equal(acquisition.series[0].read_frames(), frames_of(9))


@pytest.mark.parametrize(("maximum_bytes", "pieces"), [(1, 7), (2 * 60, 4), (3 * 60, 3), (2**20, 1)])
def test_pieces_hold_all_frames_in_order_whatever_their_size(path, maximum_bytes, pieces):
    with write_acquisition(path) as writer:
        writer.add_series("flat", kind="flat", frames=frames_of(7), chunk_frames=1)
    with open_acquisition(path) as acquisition:
        read = list(acquisition.series[0].iter_frames(maximum_bytes=maximum_bytes))
    assert len(read) == pieces
    np.testing.assert_array_equal(np.concatenate(read), frames_of(7))


def test_read_frames_takes_a_range_as_a_slice_does(path):
    small(path)
    with open_acquisition(path) as acquisition:
        series = acquisition.series[1]
        every = frames_of(4, seed=1)
        for start, stop in [(0, 2), (-1, None), (2, 2), (3, 1), (0, 99)]:
            np.testing.assert_array_equal(series.read_frames(start, stop), every[start:stop])


def test_a_long_series_is_written_and_read_in_pieces_never_as_a_whole(path):
    n, shape = 400, (128, 160)
    whole_bytes = n * shape[0] * shape[1] * 2
    tracemalloc.start()
    with write_acquisition(path) as writer:
        series = writer.add_series("flat", kind="flat", shape=shape)
        for number in range(n):
            series.append(np.full(shape, number, dtype=np.uint16), time_s=number * 0.02)
    total = 0
    with open_acquisition(path) as acquisition:
        for frames in acquisition.series[0].iter_frames(maximum_bytes=2**20):
            total += int(frames[:, 0, 0].sum())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert total == n * (n - 1) // 2
    assert peak < whole_bytes / 3


def test_a_chunk_larger_than_the_memory_allowed_is_still_read_in_small_pieces(path):
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "raytwin-acquisition", "version": 1})
        group = file.create_group("series/flat")
        group.attrs["kind"] = "flat"
        group.create_dataset("frames", data=frames_of(64), chunks=(64, 6, 5))
    with open_acquisition(path) as acquisition:
        pieces = list(acquisition.series[0].iter_frames(maximum_bytes=600))
        assert max(len(piece) for piece in pieces) == 10
        whole = list(acquisition.series[0].iter_frames(maximum_bytes=2000))
        assert len(whole) == 1


def test_what_is_missing_is_said_with_what_cannot_be_done(path):
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "raytwin-acquisition", "version": 1})
        for name in ("b", "a"):
            group = file.create_group(f"series/{name}")
            group.attrs["kind"] = "flat"
            group["frames"] = frames_of(2, dtype=np.uint8)
    with open_acquisition(path) as acquisition:
        assert [series.name for series in acquisition.series] == ["a", "b"]
        assert acquisition.series[0].dtype == np.uint16
        told = "\n".join(acquisition.missing)
    for words in ("without index", "no dark series", "without kV", "without current or power", "no pixel size"):
        assert words in told


def test_wide_integers_are_handed_out_as_float32_and_refused_beyond_24_bits(path):
    small(path)
    with h5py.File(path, "a") as file:
        del file["series/flat/frames"]
        file["series/flat"]["frames"] = np.full((1, 6, 5), 2**20, dtype=np.uint32)
        file["series/dark"].attrs["averaged"] = 1
        del file["series/dark/frames"]
        file["series/dark"]["frames"] = np.full((1, 6, 5), 2**25, dtype=np.uint32)
    with open_acquisition(path) as acquisition:
        dark, flat = acquisition.series
        assert flat.read_frames().dtype == np.float32 and flat.read_frames().max() == 2**20
        with pytest.raises(FileFormatError, match=r"series dark/frames: got a value beyond 16777216 DN"):
            dark.read_frames()


# What cannot be read


def test_no_file_a_folder_text_and_a_truncated_file_are_told_apart(tmp_path):
    assert "got no such file; expected an acquisition file" in fails(tmp_path / "absent.h5")
    assert "got a folder" in fails(tmp_path)
    (tmp_path / "text.h5").write_text("not this")
    assert "is not HDF5" in fails(tmp_path / "text.h5")
    (tmp_path / "empty.h5").write_bytes(b"")
    assert "0 bytes that is not HDF5" in fails(tmp_path / "empty.h5")
    small(tmp_path / "whole.h5")
    data = (tmp_path / "whole.h5").read_bytes()
    for share in (0.3, 0.6, 0.95):
        (tmp_path / "cut.h5").write_bytes(data[: int(share * len(data))])
        assert "truncated" in fails(tmp_path / "cut.h5")


def test_a_series_whose_name_is_no_text_is_named(path):
    small(path)
    with h5py.File(path, "a") as file:
        file["series"].move("flat", b"fl\xff")
    assert r"a name that is no text, b'fl\xff'" in fails(path)


def test_another_format_or_version_is_named(path):
    small(path)
    with h5py.File(path, "a") as file:
        file.attrs["version"] = 2
    assert "raytwin-acquisition version 2; expected version 1" in fails(path)
    with h5py.File(path, "a") as file:
        file.attrs["format"] = "something"
    assert "got format 'something'; expected an acquisition" in fails(path)
    with h5py.File(path, "a") as file:
        del file.attrs["format"]
    assert "without a `format` attribute" in fails(path)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        (
            {"exposure_ms": -20.0},
            "series flat, attribute exposure_ms: got -20 ms; expected a finite number of 0 or more ms",
        ),
        ({"exposure_ms": np.nan}, "series flat, attribute exposure_ms: got nan ms"),
        ({"exposure_ms": 1e300}, "exposure_ms: got 1e+300 ms; expected a finite number of 0 or more, at most 1e+12 ms"),
        ({"exposure_ms": "long"}, "attribute exposure_ms: got 'long'; expected a finite number of 0 or more ms"),
        ({"kV": np.inf}, "attribute kV: got inf kV"),
        ({"kV": -40}, "attribute kV: got -40 kV"),
        ({"power_W": 0}, "attribute power_W: got 0 W"),
        ({"current_mA": 3.0}, "series flat, current_mA and power_W: got 3 mA and 40 W at 40 kV"),
        ({"averaged": 0}, "attribute averaged: got 0; expected a finite number of 1 or more"),
        ({"averaged": 1.5}, "attribute averaged: got 1.5; expected a whole number"),
        ({"index": -1}, "attribute index"),
        ({"filter": "Cu"}, "series flat, filter: got 'Cu'; expected MATERIAL:mm"),
        ({"filter": 3}, "attribute filter: got 3; expected text"),
        ({"kind": "light"}, "attribute kind: got 'light'; expected one of dark, flat, object, afterglow"),
        ({"role": "best"}, "attribute role: got 'best'; expected one of calibration, evaluation"),
        ({"corrected": "gamma"}, "attribute corrected: got gamma; expected any of offset, gain, defects, log"),
        ({"photons_per_pixel": -1}, "attribute photons_per_pixel: got -1"),
        ({"panel_rotation_deg": np.nan}, "attribute panel_rotation_deg: got nan degrees"),
    ],
)
def test_an_attribute_out_of_range_names_its_series(path, attributes, message):
    small(path, **attributes)
    assert message in fails(path)


def test_series_without_frames_are_refused(path):
    small(path)
    with h5py.File(path, "a") as file:
        del file["series/flat/frames"]
    assert "series flat: got no dataset `frames`" in fails(path)
    with h5py.File(path, "a") as file:
        file["series/flat"]["frames"] = np.zeros((0, 6, 5), np.uint16)
    assert "series flat/frames: got shape (0 x 6 x 5); expected at least one frame" in fails(path)
    with h5py.File(path, "a") as file:
        del file["series/flat/frames"]
        file["series/flat"]["frames"] = np.zeros((6, 5), np.uint16)
    assert "got shape (6 x 5)" in fails(path)
    with h5py.File(path, "a") as file:
        del file["series"]
    assert "got no series" in fails(path)


@pytest.mark.parametrize("chunks", [(1, 6, 5), (2, 6, 5), None])
def test_a_recording_that_was_cut_off_is_refused_not_read_as_zeros(path, chunks):
    small(path)
    with h5py.File(path, "a") as file:
        del file["series/flat/frames"]
        frames = file["series/flat"].create_dataset("frames", (9, 6, 5), np.uint16, chunks=chunks)
        if chunks is not None:
            frames[:4] = 7
    assert "series flat/frames: got" in fails(path) and "the recording was cut off" in fails(path)


def test_frames_that_are_not_finite_are_named_when_they_are_read(path):
    with write_acquisition(path) as writer:
        writer.add_series("flat", kind="flat", frames=np.ones((3, 4, 5)))
    with h5py.File(path, "a") as file:
        file["series/flat/frames"][1, 2, 3] = np.nan
    with open_acquisition(path) as acquisition, pytest.raises(FileFormatError) as caught:
        list(acquisition.series[0].iter_frames())
    assert "series flat/frames: got a value that is not finite in frame 1, row 2, column 3" in str(caught.value)


def test_masks_of_another_shape_are_refused(path):
    told = "scene p: got masks or maps of 5 x 6 pixels; expected 6 x 5 pixels"
    with pytest.raises(FileFormatError, match=told), write_acquisition(path) as writer:
        writer.add_series("object", kind="object", frames=frames_of(1), scene="p")
        writer.add_scene("p", kind="product", product_mask=np.ones((5, 6)))
    assert not path.exists() and not list(path.parent.iterdir())
    told = "expected masks and maps of one shape"
    with pytest.raises(FileFormatError, match=told), write_acquisition(path) as writer:
        writer.add_series("object", kind="object", frames=frames_of(1), scene="p")
        writer.add_scene("p", kind="product", product_mask=np.ones((6, 5)), thickness_mm={"water": np.ones((6, 6))})


def test_a_scene_without_anything_known_is_a_name_only(path):
    with write_acquisition(path) as writer:
        writer.add_series("object", kind="object", frames=frames_of(1), scene="p")
        writer.add_scene("p", kind="slab", size_mm=np.nan)
    with open_acquisition(path) as acquisition:
        scene = acquisition.scenes["p"]
    assert scene.shape is None and scene.foreign_object_mask is None and len(scene.thickness_mm) == 0
    assert np.isnan(scene.size_mm)
    assert "water" not in scene.thickness_mm


def test_negative_path_lengths_are_refused(path):
    told = "thickness of water in scene p: got a negative or non-finite value"
    with pytest.raises(InputError, match=told), write_acquisition(path) as writer:
        writer.add_scene("p", kind="slab", thickness_mm={"water": -np.ones((6, 5))})


# What cannot be written


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (lambda w: w.add_series("a/b", kind="flat", frames=frames_of(1)), "series name: got 'a/b'"),
        (lambda w: w.add_series("", kind="flat", frames=frames_of(1)), "series name: got ''"),
        (lambda w: w.add_series("a", kind="bright", frames=frames_of(1)), "kind of series a: got 'bright'"),
        (lambda w: w.add_series("a", kind="flat"), "series a: got no frames"),
        (lambda w: w.add_series("a", kind="flat", frames=np.full((1, 2, 2), np.nan)), "a value that is not finite"),
        (lambda w: w.add_series("a", kind="flat", frames=np.full((1, 2, 2), -1)), "values from -1 to -1"),
        (
            lambda w: w.add_series("a", kind="flat", frames=np.full((1, 2, 2), 0.5), dtype=np.uint16),
            "values that are not whole",
        ),
        (lambda w: w.add_series("a", kind="flat", frames=frames_of(1), dtype=np.int32), "dtype of series a"),
        (
            lambda w: w.add_series("a", kind="flat", frames=[frames_of(1), frames_of(1, columns=4)]),
            "frames of series a: got shape (1 x 6 x 4); expected frames of 6 x 5 pixels",
        ),
        (lambda w: w.add_series("a", kind="flat", frames=frames_of(1), role="x"), "role of series a"),
        (lambda w: w.add_series("a", kind="flat", frames=frames_of(1), corrected=["x"]), "corrected of series a"),
        (lambda w: w.add_series("a", kind="flat", frames=frames_of(1), exposure_ms=-1), "exposure_ms: got -1 ms"),
        (
            lambda w: w.add_series("a", kind="flat", frames=frames_of(2), time_s=[1.0, 0.0]),
            "times that are not in order",
        ),
        (lambda w: w.add_series("a", kind="flat", shape=(2, 2)), "series a/frames: got shape (0 x 2 x 2)"),
        (lambda w: [w.add_series("a", kind="flat", frames=frames_of(1)) for _ in range(2)], "got 'a' twice"),
        (lambda w: w.add_scene("s", kind="cube"), "kind of scene s: got 'cube'"),
        (lambda w: None, "got no series"),
    ],
)
def test_what_cannot_be_written_leaves_no_file_behind(path, add, message):
    path.write_bytes(b"the one before")
    with pytest.raises(InputError) as caught, write_acquisition(path) as writer:
        add(writer)
    assert message in str(caught.value)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    assert path.read_bytes() == b"the one before"


def test_a_failure_in_the_middle_keeps_the_file_that_was_there(path):
    small(path)
    before = path.read_bytes()
    with pytest.raises(RuntimeError, match="power cut"), write_acquisition(path) as writer:
        writer.add_series("flat", kind="flat", frames=frames_of(1))
        raise RuntimeError("power cut")
    assert path.read_bytes() == before
    assert len(list(path.parent.iterdir())) == 1


def test_the_same_content_makes_the_same_bytes(tmp_path):
    for name in ("a.h5", "b.h5"):
        small(tmp_path / name)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_a_line_s_description_and_binning_come_back_from_the_file(tmp_path):
    described = Instrument(
        detector="tdi",
        tdi_stages=64,
        readout_ms=0.05,
        readout_overlaps=True,
        maximum_kV=120.0,
        maximum_current_mA=2.0,
        focal_power_w_per_mm=900.0,
        interlayer=(Filter(material="Cu", thickness_mm=1.0),),
        back_scintillator=(Filter(material="Gd2O2S@7.32", thickness_mm=0.3),),
        binning_adds="charge",
    )
    setting = Setting(kV=60, current_mA=1, exposure_ms=128, binning=2, belt_speed_mm_s=100.0, frame_interval_ms=2.0)
    with write_acquisition(tmp_path / "a.h5", described) as writer:
        writer.add_series("flat", kind="flat", frames=np.zeros((2, 4, 5), np.uint16), setting=setting)
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        assert acquisition.instrument == described
        (series,) = acquisition.series
        assert series.setting.binning == 2
        assert (series.belt_speed_mm_s, series.frame_interval_ms) == (100.0, 2.0)


def test_an_empty_scintillator_is_one_that_nobody_states(tmp_path):
    path = tmp_path / "session.h5"
    with write_acquisition(path, Instrument(scintillator=(), inherent_filtration=())) as writer:
        writer.add_series("dark", kind="dark", exposure_ms=20.0, frames=np.full((2, 8, 8), 100, np.uint16))
    with open_acquisition(path) as acquisition:
        assert acquisition.instrument.scintillator is None
        # that nothing filters the beam is a statement
        assert acquisition.instrument.inherent_filtration == ()

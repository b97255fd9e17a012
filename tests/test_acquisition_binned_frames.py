import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.binned_frames import binned, means_of_bins
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import setting_from_text
from raytwin.errors import InputError

SHAPE = (23, 31)


@pytest.fixture
def session(tmp_path):
    rng = np.random.default_rng(1)
    path = tmp_path / "session.h5"
    frames = rng.integers(0, 60_000, size=(7, *SHAPE), dtype=np.uint16)
    thickness_mm = rng.uniform(0, 20, size=SHAPE).astype(np.float32)
    mask = np.zeros(SHAPE, dtype=bool)
    mask[4:14, 5:20] = True
    with write_acquisition(path, instrument=Instrument(pixel_mm=0.15, bits=16)) as writer:
        writer.add_scene("slab", kind="slab", thickness_mm={"PMMA": thickness_mm}, product_mask=mask)
        setting = setting_from_text("kv=60,power_w=20,exposure_ms=50")
        writer.add_series("flat", kind="flat", setting=setting, frames=frames)
        writer.add_series("slab", kind="object", setting=setting, scene="slab", frames=frames[:2])
    return path, frames, thickness_mm


@given(rows=st.integers(1, 40), columns=st.integers(1, 40), factor=st.integers(1, 8), seed=st.integers(0, 1000))
def test_means_over_squares_keep_the_mean_of_the_part_they_cover(rows, columns, factor, seed):
    image = np.random.default_rng(seed).uniform(0, 100, size=(2, rows, columns))
    small = means_of_bins(image, factor)
    assert small.shape == (2, rows // factor, columns // factor)
    top, left = (rows % factor) // 2, (columns % factor) // 2
    part = image[:, top : top + rows // factor * factor, left : left + columns // factor * factor]
    if small.size:
        np.testing.assert_allclose(small.mean(), part.mean(), rtol=1e-5)
        np.testing.assert_allclose(small[0, 0, 0], part[0, :factor, :factor].mean(), rtol=1e-5)


def test_frames_maps_and_pitch_are_those_of_larger_pixels(session):
    path, frames, thickness_mm = session
    with open_acquisition(path) as acquisition:
        small = binned(acquisition, 3)
        assert small.instrument.pixel_mm == pytest.approx(0.45)
        assert [item.shape for item in small.series] == [(7, 10), (7, 10)]
        expected = frames[:, 1:22, :30].reshape(7, 7, 3, 10, 3).mean(axis=(2, 4))
        found = np.concatenate(list(small.series[0].iter_frames()))
        np.testing.assert_allclose(found, expected, rtol=1e-6)
        np.testing.assert_array_equal(small.series[0].read_frames(2, 5), found[2:5])
        np.testing.assert_allclose(
            small.scenes["slab"].thickness_mm["PMMA"],
            thickness_mm[1:22, :30].reshape(7, 3, 10, 3).mean(axis=(1, 3)),
            rtol=1e-5,
        )
        mask = small.scenes["slab"].product_mask
        assert mask is not None
        assert mask.sum() == 3 * 5  # rows 4 to 13 from row 1 on, columns 5 to 19: squares of which half are covered
        # the file's own is as it was
        assert acquisition.series[0].shape == SHAPE


def test_a_factor_that_leaves_no_pixel_is_refused(session):
    with open_acquisition(session[0]) as acquisition:
        assert binned(acquisition, 1) is acquisition
        for factor in (0, 24):
            with pytest.raises(InputError, match="from 1 to 23"):
                binned(acquisition, factor)


def test_light_of_log_images_is_averaged_not_its_logarithm(session, tmp_path):
    frames = session[1]
    share = (frames[:2] + 1.0) / 65_536.0  # from opaque to open within a square
    with write_acquisition(tmp_path / "logs.h5", instrument=Instrument(pixel_mm=0.15)) as writer:
        setting = setting_from_text("kv=60,power_w=20,exposure_ms=50")
        writer.add_series(
            "logs",
            kind="object",
            setting=setting,
            frames=-np.log(share).astype(np.float32),
            corrected=("offset", "gain", "log"),
        )
    with open_acquisition(tmp_path / "logs.h5") as acquisition:
        small = binned(acquisition, 3).series[0].read_frames()
    expected = share[:, 1:22, :30].reshape(2, 7, 3, 10, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(np.exp(-small), expected, rtol=1e-5)

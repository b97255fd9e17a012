"""Imports of measurements that others made, against an independent reading of the same files."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from raytwin.acquisition import mean_of_frames, open_acquisition
from raytwin.acquisition.emva1288 import import_emva1288
from raytwin.acquisition.nxtomo import import_nxtomo

REALDATA = Path(__file__).parents[2] / "shared" / "realdata"
pytestmark = pytest.mark.realdata


def needs(name):
    folder = REALDATA / name
    return pytest.mark.skipif(not folder.is_dir(), reason=f"no {name}: measured data are not part of the project")


@needs("emva_ccd")
def test_the_emva_set_comes_in_with_all_levels_frames_and_photons(tmp_path):
    """EMVA1288/datasets, set 001 (CC BY-SA 3.0): 13 levels of 2 frames and one of 50, bright and dark."""
    source = REALDATA / "emva_ccd"
    report = import_emva1288(source, tmp_path / "o.h5")
    assert (report.frames, report.skipped) == (152, ())
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        flats, darks = acquisition.of_kind("flat"), acquisition.of_kind("dark")
        assert [series.n_frames for series in flats] == [series.n_frames for series in darks] == [2] * 13 + [50]
        assert [series.exposure_ms for series in flats] == [series.exposure_ms for series in darks]
        assert (flats[0].exposure_ms, flats[12].exposure_ms, flats[13].exposure_ms) == (0.04, 13.72, 5.16)
        assert (flats[0].photons_per_pixel, flats[12].photons_per_pixel) == (120.0, 41235.0)
        assert all(series.shape == (480, 640) and series.dtype == np.uint16 for series in acquisition.series)
        assert acquisition.instrument.bits == 12 and all(series.kV is None for series in acquisition.series)
        for kind, series in (("b", flats[13]), ("d", darks[13])):
            files = [source / f"images/{kind}_s_000_snap_{number:03d}.png" for number in range(50)]
            total = sum(np.asarray(Image.open(path), dtype=np.int64) for path in files)
            np.testing.assert_allclose(mean_of_frames([series]), total / 50, rtol=1e-12)


@needs("k11")
def test_the_tomography_scan_comes_in_as_runs_in_time_order(tmp_path):
    """DiamondLightSource/httomo, k11_diad (BSD-3): flats, darks, projections, flats, darks; frames in a linked file."""
    report = import_nxtomo(REALDATA / "k11" / "k11-18014.nxs", tmp_path / "o.h5")
    assert [(entry["kind"], entry["frames"], entry["first_frame"]) for entry in report.read] == [
        ("flat", 50, 0),
        ("dark", 50, 50),
        ("object", 3001, 100),
        ("flat", 50, 3101),
        ("dark", 50, 3151),
    ]
    with h5py.File(REALDATA / "k11" / "k11-18014-imaging.h5") as file:
        frames = file["entry/detector/detector"][()]
    with open_acquisition(tmp_path / "o.h5") as acquisition:
        assert {series.exposure_ms for series in acquisition.series} == {20.0}
        assert {series.shape for series in acquisition.series} == {(22, 26)}
        for series, start in zip(acquisition.series, (0, 50, 100, 3101, 3151), strict=True):
            expected = frames[start : start + series.n_frames].mean(axis=0)
            np.testing.assert_allclose(mean_of_frames([series]), expected, rtol=1e-12)
        np.testing.assert_array_equal(np.concatenate([s.read_frames() for s in acquisition.series]), frames)

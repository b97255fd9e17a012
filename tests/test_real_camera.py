"""A rocket camera's frames, as the package msfc-ccd ships them: conversion factors against its own two methods."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition import write_acquisition
from raytwin.generator.twins.twin_answer import calibration_answer

fits = pytest.importorskip("astropy.io.fits", reason="astropy is not installed (extra `fits`)")
PACKAGE = find_spec("msfc_ccd")
if PACKAGE is None:
    pytest.skip("msfc-ccd is not installed: `pip install --no-deps msfc-ccd`", allow_module_level=True)

LED = Path(str(PACKAGE.origin)).parent / "_data" / "led"
FLATS, DARKS = (4803, 4804), (4860, 4861)
# electrons per DN: variance of these two flats by msfc-ccd's photon transfer, and 55Fe lines of other exposures
BY_VARIANCE = {(0, 0): 2.529, (0, 1): 2.508, (1, 0): 2.530, (1, 1): 2.512}
BY_IRON = {(0, 0): 2.555, (0, 1): 2.503}


def tap(number, row, column):
    """The lit pixels that one of the four amplifiers reads, in the order of its readout."""
    frame = fits.getdata(LED / f"ESIS1_{number:05d}.fit.gz").astype(np.uint16)
    part = frame[row * 520 : (row + 1) * 520, column * 1076 : (column + 1) * 1076]
    return part[:: -1 if row else 1, :: -1 if column else 1][8:, 50:1074]


@pytest.mark.parametrize(
    ("row", "column"), [(0, 0), *(pytest.param(*one, marks=pytest.mark.slow) for one in BY_VARIANCE if one != (0, 0))]
)
def test_the_gain_of_each_amplifier_agrees_with_the_package_s_two_methods(tmp_path, row, column):
    path = tmp_path / "tap.h5"
    with write_acquisition(path) as writer:
        for name, kind, numbers in (("dark", "dark", DARKS), ("led", "flat", FLATS)):
            frames = np.stack([tap(number, row, column) for number in numbers])
            writer.add_series(name, kind=kind, exposure_ms=2000.0, frames=frames)
    (level,) = calibration_answer(rt.calibrate(path, seed=0))["levels"]
    slope, low, high = (level[f"photon_transfer_slope_DN{end}"] for end in ("", "_low", "_high"))
    assert 1.0 / slope == pytest.approx(BY_VARIANCE[row, column], rel=0.01)
    assert low < 1.0 / BY_VARIANCE[row, column] < high
    # power supplies of the camera stand in its noise power as lines: they are no reason to know nothing
    assert high / low < 1.05
    if (row, column) in BY_IRON:
        assert 1.0 / slope == pytest.approx(BY_IRON[row, column], rel=0.03)

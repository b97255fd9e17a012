"""A twin in squares of pixels is what a calibration of averaged frames would be."""

import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.binned_frames import binned, means_of_bins
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.cli import main
from raytwin.diagnosis.session import binning
from raytwin.diagnosis.session.binned_twin import binned_twin
from raytwin.generator.effects import AppliedEffect
from raytwin.generator.frames.line_model import LineModel
from raytwin.generator.line.series_request import SeriesRequest
from raytwin.generator.spread.psf import Spread
from raytwin.generator.twins.twin_io import read_twin

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("line") / "session.h5"
    words = ["--protocol", "calibration", "--seed", "5", "--size", "130", "--frames", "24"]
    assert main(["lab", "--family", "none", "-o", str(path), *words]) == 0
    return path


@pytest.fixture(scope="module", params=[2, 4])
def both(request, session):
    """Factor; the panel's twin in squares; the twin that averaged frames calibrate."""
    factor = request.param
    with open_acquisition(session) as acquisition:
        fine = calibrate_twin(acquisition, rng=np.random.default_rng(1))
        averaged = calibrate_twin(binned(acquisition, factor), rng=np.random.default_rng(1))
    return factor, binned_twin(fine, factor), averaged


def test_maps_and_levels_are_those_of_averaged_frames(both):
    factor, squares, averaged = both
    assert squares.maps.shape == averaged.maps.shape == (130 // factor, 130 // factor)
    assert squares.instrument == averaged.instrument
    good = (squares.maps.bad_pixels == 0) & (averaged.maps.bad_pixels == 0)
    assert good.mean() > 0.9
    for exposure_ms in (10.0, 100.0):
        there, here = (twin.maps.dark_at(exposure_ms)[good] for twin in (averaged, squares))
        # the panel's own darks are drawn closer together than these: 0.02 DN
        np.testing.assert_allclose(here, there, atol=0.1)
    # drawn towards 1 as far as data are thin, which those of a pixel are more
    np.testing.assert_allclose(squares.maps.gain_relative[good], averaged.maps.gain_relative[good], atol=0.02)
    assert squares.noise.read_noise_DN.value == pytest.approx(averaged.noise.read_noise_DN.value, rel=0.02)
    for here, there in zip(squares.levels, averaged.levels, strict=True):
        assert here.rate_DN_per_mAs.value == pytest.approx(there.rate_DN_per_mAs.value, rel=1e-3)
        # either fit knows its slope to 1 %
        assert here.photon_transfer_slope_DN.value == pytest.approx(there.photon_transfer_slope_DN.value, rel=0.03)
        # few squares leave open how far light spreads among them
        assert there.gain_DN.low < here.gain_DN.value < there.gain_DN.high
        np.testing.assert_allclose(here.flat_shape[good], there.flat_shape[good], rtol=2e-3)


def test_light_spreads_over_as_much_less_of_a_square(both):
    _, squares, averaged = both
    left = [twin.noise.spread.value.variance_share for twin in (squares, averaged)]
    gain = averaged.levels[0].gain_DN  # known no better than the share that it comes from
    assert left[0] == pytest.approx(left[1], rel=(gain.high - gain.low) / (2.0 * gain.value))
    width = squares.noise.spread.intervals["sigma_px"]
    assert width.low <= width.value <= width.high


def test_spectra_give_squares_the_level_of_pixels_and_fewer_dn_a_photon(both, session):
    factor, squares, _ = both
    with open_acquisition(session) as acquisition:
        flat = next(item for item in acquisition.of_kind("flat") if item.setting is not None)
        fine = calibrate_twin(acquisition, rng=np.random.default_rng(1))
    request = SeriesRequest(kind="flat", frames=4, exposure_ms=flat.exposure_ms, setting=replace(flat.setting, kV=64.0))
    whole, small = LineModel(fine).expect(request), LineModel(squares).expect(request)
    good = squares.maps.bad_pixels == 0
    there = means_of_bins(np.asarray(whole.signal_DN), factor)
    # bad pixels apart, which are no light's doing
    np.testing.assert_allclose(np.median(np.asarray(small.signal_DN)[good]), np.median(there[good]), rtol=1e-3)
    gains = [squares.spectral.best, fine.spectral.best]
    at = fine.spectral.names.index("log_DN_per_keV")
    assert gains[0][at] - gains[1][at] == pytest.approx(-2.0 * math.log(factor))


def test_lengths_of_its_effects_are_in_squares(series_line):
    had = (
        AppliedEffect(id="motion_blur", parameters={"strength": 4.0}),
        AppliedEffect(id="mtf_tail", parameters={"strength": 6.0, "reach_px": 3.0}),
        AppliedEffect(id="mtf_tail", parameters={"strength": 6.0}),
        AppliedEffect(id="bad_pixels", parameters={"strength": 30.0}),
        AppliedEffect(id="object_scatter", parameters={"strength": 9.0}, since="calibration"),
        AppliedEffect(id="somebody_else_s", parameters={"strength": 1.0}),
    )
    small = binned_twin(replace(series_line, effects=had), 2).effects
    assert [item.id for item in small] == [item.id for item in had]
    assert small[0].parameters["strength"] == 2.0
    assert small[1].parameters["reach_px"] == 1.5
    assert small[2].parameters["reach_px"] > 0.0
    assert small[3].parameters["strength"] == 100.0
    assert small[4:] == had[4:]


@pytest.mark.parametrize("axes", ["both", "row"])
def test_a_square_has_what_the_spread_leaves_in_it_along_its_axes(series_line, axes):
    spread = replace(series_line.noise.spread, value=Spread(sigma_px=0.9, axes=axes))
    fine = replace(series_line, noise=replace(series_line.noise, spread=spread))
    found = binned_twin(fine, 2).noise.spread.value
    assert found.axes == axes
    assert found.variance_share == pytest.approx(spread.value.binned_variance_share(2), rel=1e-6)


def test_a_panel_without_pitch_keeps_its_level(series_line):
    bare = replace(series_line, instrument=replace(series_line.instrument, pixel_mm=None))
    small = binned_twin(bare, 2)
    names = small.spectral.names
    moved = dict(zip(names, small.spectral.best - bare.spectral.best, strict=True))
    assert moved["log_DN_per_keV"] + moved["log_output"] == pytest.approx(0.0)
    assert small.instrument.pixel_mm is None


def test_a_square_with_a_bad_pixel_is_bad(series_line):
    bad = np.zeros((40, 40), np.uint8)
    bad[5, 9], bad[5, 8] = 3, 1
    small = binned_twin(replace(series_line, maps=replace(series_line.maps, bad_pixels=bad)), 2)
    assert small.maps.bad_pixels[2, 4] == 3
    assert np.count_nonzero(small.maps.bad_pixels) == 1
    assert binned_twin(series_line, 1) is series_line


@pytest.mark.slow
def test_another_day_of_a_large_panel_is_compared_in_squares_with_its_own_twin(tmp_path, capsys, monkeypatch):
    words = ["--protocol", "short", "--seed", "33", "--size", "96", "--frames", "12", "--products", "2"]
    assert main(["lab", "--family", "none", "-o", str(tmp_path / "first.h5"), *words]) == 0
    assert main(["diagnose", str(tmp_path / "first.h5"), "-o", str(tmp_path / "first"), "--json"]) == 0
    monkeypatch.setattr(binning, "LARGEST_PIXELS", 48 * 48)
    later, answer, twin = tmp_path / "later.h5", tmp_path / "later", tmp_path / "first" / "twin.h5"
    moving = ["--session", "1", "--effect", "motion_blur=6@always"]
    assert main(["lab", "--family", "none", "-o", str(later), *words, *moving]) == 0

    def said(*more):
        capsys.readouterr()
        assert main(["diagnose", str(later), "-o", str(answer), "--json", *more]) == 0
        return json.loads(capsys.readouterr().out)

    found = said("--twin", str(twin))
    assert found["causes"][0]["effect"] == "motion_blur"
    assert found["causes"][0]["strength"]["value"] == pytest.approx(6.0, rel=0.2)
    assert any("means of 2 x 2 pixels" in line for line in found["warnings"])
    improved = read_twin(answer / "twin.h5")
    assert improved.maps.shape == (96, 96)
    assert improved.effects[0].parameters["strength"] == pytest.approx(6.0, rel=0.2)
    # with what was found there is no gap, and on a day without it another strength of it explains that
    os.replace(answer / "twin.h5", tmp_path / "improved.h5")
    assert said("--twin", str(tmp_path / "improved.h5"))["verdict"] == "no_gap"
    assert main(["lab", "--family", "none", "-o", str(later), *words, "--session", "1"]) == 0
    found = said("--twin", str(tmp_path / "improved.h5"))
    assert (found["verdict"], found["causes"][0]["effect"]) == ("explained", "motion_blur")
    assert found["causes"][0]["strength"]["value"] < 1.0
    assert any("the twin has motion_blur, and this session shows 0.0" in line for line in found["warnings"])

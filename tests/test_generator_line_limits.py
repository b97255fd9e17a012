"""Limits of tube, readout and belt; binning and dual-layer panels against drawn quanta and closed forms."""

import importlib.util
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition import Filter, Instrument, Setting, filters_from_text, setting_from_text
from raytwin.errors import InputError
from raytwin.generator.line.binning import binned_pixel
from raytwin.generator.line.line_limits import (
    check_count_rate,
    check_limits,
    frames_per_s,
    line_period_ms,
    permitted_focal_power_W,
    shortest_interval_ms,
)
from raytwin.generator.line.spectral_signal import OpenBeam
from raytwin.generator.predictions.contrast import predict_contrast
from raytwin.generator.predictions.dual_layer import predict_back_layer
from raytwin.generator.predictions.predict import binned_over_single, predict_flatfield, spectral_model_of
from raytwin.generator.spread.psf import Spread, blur_variance_share, sampled_gaussian_1d
from raytwin.generator.twins.twin_io import read_twin, write_twin
from raytwin.materials import transmission
from raytwin.spectra import detector_response

BELT = Instrument(detector="line", pixel_mm=0.4, source_object_mm=500.0, source_detector_mm=1000.0, readout_ms=0.1)


@pytest.fixture(scope="module")
def twin():
    path = Path(__file__).with_name("test_generator_twin.py")
    spec = importlib.util.spec_from_file_location("twin_by_hand", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.make_twin()


def setting(**changes):
    return Setting(**{"kV": 60.0, "current_mA": 0.5, "exposure_ms": 20.0, **changes})


@pytest.mark.parametrize(
    ("instrument", "changes", "message"),
    [
        ({"maximum_power_w": 20.0}, {}, "setting: got 30 W; expected at most the tube's 20 W; lower the current"),
        ({"maximum_kV": 50.0}, {}, "setting: got 60 kV; expected at most the tube's 50 kV; lower the tube voltage"),
        ({"maximum_current_mA": 0.4}, {}, "setting: got 0.5 mA; expected at most the tube's 0.4 mA"),
        (
            {"focal_spot_mm": 0.02, "focal_power_w_per_mm": 1000.0},
            {},
            "got 30 W; expected at most a focal spot of 0.02 mm at 1000 W/mm takes: 20 W",
        ),
        (
            {"readout_ms": 5.0},
            {"frame_interval_ms": 24.0},
            "frame_interval_ms: got 24 ms between frames; expected at least 25 ms",
        ),
        (
            {"readout_ms": 5.0, "readout_overlaps": True},
            {"frame_interval_ms": 19.0},
            "expected at least 20 ms for an exposure of 20 ms and 5 ms of readout",
        ),
    ],
)
def test_what_tube_and_readout_cannot_do_is_one_clear_error(instrument, changes, message):
    with pytest.raises(InputError) as caught:
        check_limits(Instrument(**instrument), setting(**changes))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_settings_at_their_limits_pass():
    instrument = Instrument(
        maximum_power_w=30.0, maximum_kV=60.0, maximum_current_mA=0.5, readout_ms=5.0, focal_spot_mm=0.03,
        focal_power_w_per_mm=1000.0,
    )  # fmt: skip
    assert check_limits(instrument, setting(frame_interval_ms=25.0)) == ()
    assert check_limits(Instrument(), setting()) == ()
    assert frames_per_s(instrument, setting()) == pytest.approx(40.0)
    assert frames_per_s(instrument, setting(averaged=4)) == pytest.approx(10.0)
    assert frames_per_s(replace(instrument, readout_overlaps=True), setting()) == pytest.approx(50.0)


def test_power_on_a_small_focus_follows_the_published_rule_and_is_a_warning():
    """1.4 d^0.88 W with d in um: 44 W at 50 um, 613 W at 1 mm (Flynn and others 1994)."""
    assert permitted_focal_power_W(0.05) == pytest.approx(43.8, rel=0.01)
    assert permitted_focal_power_W(1.0) == pytest.approx(611.0, rel=0.01)
    small = Instrument(focal_spot_mm=0.02)
    (warning,) = check_limits(small, setting())
    assert "30 W on a focal spot of 0.02 mm" in warning
    assert "about 19.5 W" in warning
    for declared in ({"maximum_power_w": 50.0}, {"focal_power_w_per_mm": 5000.0}, {"anode": "Mo"}):
        assert check_limits(replace(small, **declared), setting()) == ()
    with pytest.raises(InputError, match="focal_spot_mm: got 0 mm"):
        permitted_focal_power_W(0)


@given(st.floats(1.0, 1000.0), st.integers(1, 8))
def test_a_line_exposes_while_the_belt_moves_one_pixel(speed, binning):
    """0.4 mm pixels at a magnification of 2 see 0.2 mm of the belt."""
    moving = setting(exposure_ms=0.05, belt_speed_mm_s=speed, binning=binning)
    period = line_period_ms(BELT, moving)
    assert period == pytest.approx(1000.0 * 0.2 * binning / speed)
    longest = period - BELT.readout_ms
    if longest > 1e-3:
        assert check_limits(BELT, replace(moving, exposure_ms=0.999 * longest)) == ()
    with pytest.raises(InputError, match="in which the belt moves one pixel"):
        check_limits(BELT, replace(moving, exposure_ms=1.01 * max(longest, 0.0) + 0.01))


def test_lines_are_triggered_by_the_belt():
    moving = setting(exposure_ms=1.0, belt_speed_mm_s=100.0)
    assert check_limits(BELT, replace(moving, frame_interval_ms=2.0)) == ()
    with pytest.raises(InputError, match=r"frame_interval_ms: got 3 ms between lines; expected 2 ms"):
        check_limits(BELT, replace(moving, frame_interval_ms=3.0))
    assert line_period_ms(replace(BELT, pixel_mm=None), moving) is None
    assert check_limits(replace(BELT, detector="area"), replace(moving, exposure_ms=50.0)) == ()


def test_the_belt_sets_the_exposure_of_a_tdi_detector():
    tdi = replace(BELT, detector="tdi", tdi_stages=64)
    moving = setting(exposure_ms=128.0, belt_speed_mm_s=100.0)
    assert check_limits(tdi, moving) == ()
    assert shortest_interval_ms(tdi, moving) == pytest.approx(2.0)
    assert frames_per_s(tdi, moving) == pytest.approx(500.0)
    with pytest.raises(InputError, match=r"exposure_ms: got 20 ms; expected 128 ms: 64 stages of 2 ms at 100 mm/s"):
        check_limits(tdi, replace(moving, exposure_ms=20.0))
    with pytest.raises(InputError, match="at most 2 ms"):
        check_limits(replace(tdi, readout_ms=3.0), moving)


def test_a_counting_pixel_has_a_highest_count_rate():
    counter = Instrument(counting=True, maximum_counts_per_s=1e6)
    check_count_rate(counter, setting(), 2e4)
    check_count_rate(Instrument(), setting(), 1e9)
    check_count_rate(counter, setting(binning=2), 8e4)
    with pytest.raises(
        InputError, match=r"got 1.25e\+06 counts a second in one pixel; expected at most the detector's"
    ):
        check_count_rate(counter, setting(), 2.5e4)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"tdi_stages": 4, "detector": "line"}, "instrument tdi_stages: got 4 for a detector of kind line"),
        ({"maximum_counts_per_s": 1e6, "counting": False}, "instrument maximum_counts_per_s: got 1e+06 counts/s"),
        ({"interlayer": filters_from_text("Cu:1")}, "instrument interlayer: got Cu:1; expected back_scintillator"),
        ({"binning_adds": "max"}, "instrument binning_adds: got max; expected one of mean, sum, charge"),
        ({"maximum_kV": 0.0}, "instrument maximum_kV: got 0.0; expected a finite positive number"),
    ],
)
def test_an_instrument_that_contradicts_itself_is_refused(fields, message):
    with pytest.raises(InputError) as caught:
        Instrument(**fields)
    assert message in str(caught.value)


@pytest.mark.parametrize("binning", [1, 2, 3, 4])
def test_binned_noise_is_that_of_blurred_quanta_drawn_and_binned(binning):
    """Quanta counted per pixel, spread by a sampled Gaussian, then averaged b x b."""
    rng = np.random.default_rng(binning)
    sigma, size, frames = 0.7, 192, 40
    kernel = sampled_gaussian_1d(sigma, 6)
    variances = []
    for _ in range(frames):
        quanta = rng.standard_normal((size, size))
        for axis in (0, 1):
            spread = sum(
                weight * np.roll(quanta, shift, axis) for shift, weight in zip(range(-6, 7), kernel, strict=True)
            )
            quanta = spread
        blocks = quanta.reshape(size // binning, binning, size // binning, binning).mean(axis=(1, 3))
        variances.append(np.mean(blocks**2))
    expected = Spread(model="sampled", sigma_px=sigma).binned_variance_share(binning) / binning**2
    assert np.mean(variances) == pytest.approx(expected, abs=5 * np.std(variances) / math.sqrt(frames))


@given(st.sampled_from(["aperture", "sampled"]), st.floats(0.0, 2.0), st.integers(1, 30))
def test_binning_shares_rise_from_one_pixel_s_to_that_of_the_quanta(model, sigma, binning):
    share = Spread(model=model, sigma_px=sigma).binned_variance_share(binning)
    assert Spread(model=model, sigma_px=sigma).binned_variance_share(1) == pytest.approx(
        blur_variance_share(model, sigma), rel=1e-6
    )
    assert share <= Spread(model=model, sigma_px=sigma).binned_variance_share(binning + 1) + 1e-12 <= 1.0 + 1e-9
    assert Spread(model=model, sigma_px=sigma).binned_variance_share(1000) == pytest.approx(1.0, abs=0.01)


def test_binned_flatfields_add_signal_noise_and_photons_as_the_readout_does(twin):
    one = setting(filters=filters_from_text("Cu:0.05"))
    plain = predict_flatfield(twin, one)
    read = twin.noise.read_variance_DN2
    quantum = plain.sd_DN.value**2 - read
    ratio = binned_over_single(twin, 2)
    assert 1.0 < ratio < 4.0
    for adds, signal, electronic in (("mean", 1.0, 0.25), ("sum", 4.0, 4.0), ("charge", 4.0, 1.0)):
        line = replace(twin, instrument=replace(twin.instrument, binning_adds=adds))
        found = predict_flatfield(line, replace(one, binning=2))
        assert found.mean_DN.value == pytest.approx(signal * plain.mean_DN.value)
        assert found.photons_absorbed.value == pytest.approx(4 * plain.photons_absorbed.value)
        expected = ratio * quantum * binned_pixel(2, adds).quantum + read * electronic
        assert found.sd_DN.value**2 == pytest.approx(expected, rel=2e-3)
        assert found.gain_DN == plain.gain_DN
    undeclared = predict_flatfield(twin, replace(one, binning=2))
    assert any("declare binning_adds" in line for line in undeclared.warnings)
    with pytest.raises(InputError, match="binning: got 0; expected a whole number from 1 to 64"):
        replace(one, binning=0)
    with pytest.raises(InputError, match="binning_adds: got median"):
        binned_pixel(2, "median")


def test_charge_binned_before_the_adc_saturates_earlier(twin):
    bright = setting_from_text("kv=90,power_w=90,exposure_ms=60,filter=Cu:0.05,binning=4")
    said = {}
    for adds in ("sum", "charge"):
        line = replace(twin, instrument=replace(twin.instrument, binning_adds=adds))
        said[adds] = any("saturates" in line for line in predict_flatfield(line, bright).warnings)
    assert said == {"sum": False, "charge": True}


def test_prediction_refuses_what_the_line_cannot_do(twin):
    limited = replace(twin, instrument=replace(twin.instrument, readout_ms=5.0))
    with pytest.raises(InputError, match="frame_interval_ms: got 21 ms"):
        predict_flatfield(limited, setting(frame_interval_ms=21.0))


def test_a_counting_line_is_refused_a_rate_beyond_its_limit(twin):
    counting = replace(twin.instrument, counting=True)
    one = setting(filters=filters_from_text("Cu:0.05"))
    counts = predict_flatfield(replace(twin, instrument=counting), one).photons_absorbed.value
    rate = counts / 0.02
    limits = {scale: replace(counting, maximum_counts_per_s=scale * rate) for scale in (0.9, 1.1)}
    assert predict_flatfield(replace(twin, instrument=limits[1.1]), one).photons_absorbed.value == counts
    with pytest.raises(InputError, match="counts pile up"):
        predict_flatfield(replace(twin, instrument=limits[0.9]), one)


DUAL = {"interlayer": filters_from_text("Cu:1"), "back_scintillator": filters_from_text("Gd2O2S@7.32:0.3")}


def test_the_back_layer_sees_the_beam_behind_front_and_interlayer(twin):
    """The most probable parameters alone: the same sums written out."""
    posterior = replace(twin.spectral, samples=twin.spectral.best[None, :])
    line = replace(twin, instrument=replace(twin.instrument, **DUAL), spectral=posterior)
    one = setting(kV=90.0, filters=filters_from_text("Cu:0.05"))
    found = predict_back_layer(line, one)
    model = spectral_model_of(line)
    photons = model.weights(posterior.samples, OpenBeam(kV=90.0, filters=one.filters))[0]
    energies = model.energies_keV[: photons.size]
    thickness = math.exp(float(posterior.column("log_scintillator_thickness")[0]))
    (front,) = posterior.scintillator
    front = replace(front, thickness_mm=front.thickness_mm * thickness)
    behind = photons * transmission((*posterior.cover, front, *DUAL["interlayer"]), energies, bin_width_keV=0.5)
    response = detector_response(energies_keV=energies, scintillator=DUAL["back_scintillator"])
    absorbed = behind * response.interacting_fraction
    assert found.mean_energy_back_keV.value == pytest.approx(absorbed @ energies**2 / (absorbed @ energies), rel=1e-3)
    instrument = line.instrument
    area = (1000.0 / instrument.source_detector_mm) ** 2 * instrument.pixel_mm**2 * one.tube_load_mAs
    assert found.photons_absorbed.value == pytest.approx(absorbed.sum() * area, rel=1e-3)
    assert found.mean_energy_back_keV.value > found.mean_energy_front_keV.value + 5.0


def test_thicker_interlayers_dim_and_harden_the_back_image(twin):
    results = []
    for interlayer in ("", "Cu:0.3", "Cu:1"):
        layers = {**DUAL, "interlayer": filters_from_text(interlayer)}
        line = replace(twin, instrument=replace(twin.instrument, **layers))
        results.append(predict_back_layer(line, setting(kV=90.0)))
    ratios = [result.signal_over_front.value for result in results]
    energies = [result.mean_energy_back_keV.value for result in results]
    assert ratios[0] > ratios[1] > ratios[2] > 0
    assert energies[0] < energies[1] < energies[2]
    assert set(results[0].as_dict()) >= {"signal_over_front", "photons_absorbed"}


def test_a_back_layer_that_is_not_there_cannot_be_predicted(twin):
    with pytest.raises(InputError, match="a declared back_scintillator"):
        predict_back_layer(twin, setting())
    dual = replace(twin, instrument=replace(twin.instrument, **DUAL))
    with pytest.raises(InputError, match="a tube load"):
        predict_back_layer(dual, setting(current_mA=None))


def test_a_twin_s_file_keeps_the_line_s_description(tmp_path, twin):
    described = replace(
        twin.instrument, **DUAL, maximum_kV=100.0, readout_overlaps=True, binning_adds="charge", maximum_current_mA=2.0,
        focal_power_w_per_mm=900.0,
    )  # fmt: skip
    write_twin(tmp_path / "t.h5", replace(twin, instrument=described))
    assert read_twin(tmp_path / "t.h5").instrument == described


def test_contrasts_are_those_of_single_pixels(twin):
    low, high = setting(kV=40.0, current_mA=1.0), setting(kV=90.0)
    slabs = {
        "product": Filter(material="chicken_breast", thickness_mm=20.0),
        "foreign_object": Filter(material="rib_bone", thickness_mm=2.0),
    }
    assert predict_contrast(twin, low=low, high=high, **slabs).as_dict()
    with pytest.raises(InputError, match=r"binning: got 2 in kv=40,.*expected binning 1 here"):
        predict_contrast(twin, low=replace(low, binning=2), high=high, **slabs)

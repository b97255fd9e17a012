"""Exposures and distances that are not as stated: what flats tell of them, and how far predictions then reach."""

import dataclasses
import math

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition, write_acquisition
from raytwin.acquisition.setting import Setting, filters_from_text
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.calibration.flats.flat_levels import SeriesPoint
from raytwin.calibration.flats.setting_errors import (
    BEND_SD,
    DISTANCE_SD,
    EXPOSURE_SD_MS,
    allowing_for_settings,
    dark_current_sd,
    setting_errors,
    told_errors,
)
from raytwin.errors import InputError
from raytwin.generator.line.measured_flats import stray_of_setting
from raytwin.generator.line.twin import Z95, estimate_above_zero
from raytwin.generator.predictions.predict import predict_flatfield

MM, COPPER = 1059.0, filters_from_text("Cu:0.05")
DARK_SD = dark_current_sd(400.0 / 100.0, bits=16)  # DN/ms, of a dark of 400 DN at 100 ms


def flat(number, *, kV=80.0, ms=100.0, mm=None, late_ms=0.0, near_mm=0.0):
    """A flat of 1 mA whose light is as if its exposure were longer and its detector nearer."""
    light = (ms + late_ms) * (MM / ((mm or MM) - near_mm)) ** 2
    return SeriesPoint(
        series=f"flat_{number}", kV=kV, filters=COPPER, exposure_ms=ms, load_mAs=ms / 1000.0, source_detector_mm=mm,
        photons_per_pixel=None, frames=10, averaged=1, signal_DN=20.0 * light, mean_signal_DN=20.0 * light,
        pair_variance_DN2=1.0, stack_variance_DN2=1.0, used=True, masked="", drift_percent=0.0, common_mode_percent=0.0,
    )  # fmt: skip


def half_width(estimate):
    return (estimate.high - estimate.low) / 2.0 / estimate.value


def test_flats_of_one_exposure_and_distance_leave_what_is_known_beforehand():
    found = setting_errors([flat(0), flat(1, kV=40.0)], source_detector_mm=MM)
    assert found["exposure_ms"] == {"value": 0.0, "sd": pytest.approx(EXPOSURE_SD_MS)}
    assert found["distance_mm"] == {"value": 0.0, "sd": pytest.approx(DISTANCE_SD * MM)}
    assert found["bend"] == {"value": 0.0, "sd": pytest.approx(BEND_SD)}
    # beams have levels of their own: another voltage at another exposure tells nothing
    assert setting_errors([flat(0), flat(1, kV=40.0, ms=20.0)], source_detector_mm=MM)["exposure_ms"]["value"] == 0.0
    assert setting_errors([dataclasses.replace(flat(0), load_mAs=None)], source_detector_mm=MM) is None


@pytest.mark.parametrize("late_ms", [0.0, 0.5, 3.0])
def test_two_exposures_tell_how_long_they_are(late_ms):
    points = [flat(0, late_ms=late_ms), flat(1, ms=20.0, late_ms=late_ms), flat(2, kV=40.0)]
    found = setting_errors(points, source_detector_mm=MM)["exposure_ms"]
    assert found["sd"] < 0.25
    assert found["value"] == pytest.approx(late_ms, abs=0.1 + 0.3 * late_ms)
    told = told_errors(setting_errors(points, source_detector_mm=MM))
    assert len(told) == int(late_ms > 0.0) and all("longer than stated" in line for line in told)


def test_two_currents_tell_how_the_response_bends(make_model_twin):
    """A level 4 % low at the brightest flat: what lies above is as uncertain as its law, its noise four times."""
    bright, dim = flat(0), dataclasses.replace(flat(1), load_mAs=0.02, signal_DN=20.0 * 20.0 * 1.04)
    found = setting_errors([bright, dim], source_detector_mm=MM)["bend"]
    assert -0.05 < found["value"] < -0.025 and found["sd"] < BEND_SD
    rows = [one.as_dict() for one in (bright, dim)]
    evidence = {"photon_transfer": rows, "setting_errors": setting_errors([bright, dim], source_detector_mm=MM)}
    twin = dataclasses.replace(make_model_twin((8, 8)), evidence=evidence)
    setting = Setting(kV=80.0, current_mA=2.0, exposure_ms=100.0, filters=COPPER)
    of_level, of_noise = stray_of_setting(twin, setting, None, distance_mm=MM, signal_DN=4000.0)
    assert of_noise == pytest.approx(4.0 * of_level)
    assert of_level == pytest.approx(math.hypot(found["value"], found["sd"]) * (2.0 - np.mean([1.0, 0.208])))


@pytest.mark.parametrize("far_off", [{"source_detector_mm": 1.059}, {"exposure_ms": 1e-6}, {"exposure_ms": 1e12}])
def test_a_setting_of_which_nothing_is_known_is_refused(make_model_twin, far_off):
    points = [flat(0), flat(1, kV=40.0)]
    evidence = {
        "photon_transfer": [point.as_dict() for point in points],
        "setting_errors": setting_errors(points, source_detector_mm=MM),
    }
    twin = dataclasses.replace(make_model_twin((8, 8)), evidence=evidence)
    words = {"kV": 60.0, "current_mA": 1.0, "exposure_ms": 100.0}
    assert twin.predict(**words).mean_DN.value > 0
    with pytest.raises(
        InputError, match=r"setting: got .* mm from the source, .*nearer to those of the calibrating flats"
    ):
        twin.predict(**{**words, **far_off})


def test_two_distances_tell_where_the_focal_spot_is():
    points = [flat(0, near_mm=4.0), flat(1, mm=530.0, near_mm=4.0)]
    found = setting_errors(points, source_detector_mm=MM)["distance_mm"]
    assert found["value"] == pytest.approx(-4.0, abs=1.0)
    assert found["sd"] < 3.0


def test_beams_that_were_measured_at_other_exposures_are_less_sure_against_each_other(make_model_twin):
    """A time that is 0.36 ms longer makes 5 ms 7 % brighter and 100 ms hardly at all: no spectrum did it."""
    levels = [
        dataclasses.replace(level, series=(f"flat_{number}",), source_detector_mm=None)
        for number, level in enumerate(make_model_twin((8, 8)).levels)
    ]
    for ms, expected in ((100.0, 0.0), (5.0, EXPOSURE_SD_MS * (1 / 5 - 1 / 100) / 2)):
        points = [flat(0, kV=40.0), flat(1, kV=90.0, ms=ms)]
        errors = setting_errors(points, source_detector_mm=MM)
        for before, after in zip(levels, allowing_for_settings(levels, points, errors), strict=True):
            of_bend = BEND_SD * (1.0 - ms / 100.0) / 2
            added = math.hypot(Z95 * expected, Z95 * of_bend, half_width(before.rate_DN_per_mAs))
            assert half_width(after.rate_DN_per_mAs) == pytest.approx(added, rel=1e-6)
    assert allowing_for_settings(levels, points, None) == tuple(levels)


@pytest.mark.parametrize("measured_ms", [(100.0,), (100.0, 50.0)])
def test_predictions_hold_exposures_that_are_longer_than_stated(tmp_path, make_model_twin, measured_ms):
    late_ms = 0.6  # of the 1 ms that a generator may be off by
    line, rng = make_model_twin((64, 64)), np.random.default_rng(0)

    def truth(kV, ms):
        return predict_flatfield(line, Setting(kV=kV, current_mA=1.0, exposure_ms=ms + late_ms, filters=COPPER))

    def frames(mean_DN, sd_DN):
        return np.round(1200.0 + mean_DN + sd_DN * rng.standard_normal((6, 64, 64))).astype(np.uint16)

    with write_acquisition(tmp_path / "flats.h5", line.instrument) as writer:
        for ms in measured_ms:
            writer.add_series(f"dark_{ms:g}", kind="dark", exposure_ms=ms, frames=frames(0.0, 12.0))
            for kV in (40.0, 90.0):
                light = truth(kV, ms)
                setting = Setting(kV=kV, current_mA=1.0, exposure_ms=ms, filters=COPPER)
                shown = frames(light.mean_DN.value, light.sd_DN.value)
                writer.add_series(f"flat_{kV:g}_{ms:g}", kind="flat", setting=setting, frames=shown)
    with open_acquisition(tmp_path / "flats.h5") as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(0), advise=False)
    for kV in (40.0, 90.0, 65.0):
        there, short = (
            predict_flatfield(twin, Setting(kV=kV, current_mA=1.0, exposure_ms=ms, filters=COPPER)).mean_DN
            for ms in (100.0, 20.0)
        )
        assert short.low < truth(kV, 20.0).mean_DN.value < short.high
        assert half_width(short) > half_width(there)
        if len(measured_ms) == 1:
            expected = Z95 * EXPOSURE_SD_MS * (1 / 20 - 1 / 100)
            assert half_width(short) == pytest.approx(math.hypot(half_width(there), expected), rel=0.15)


@pytest.mark.parametrize("darks_ms", [(100.0,), (100.0, 20.0)])
def test_levels_hold_a_dark_current_that_darks_of_another_exposure_do_not_tell(tmp_path, make_model_twin, darks_ms):
    line, rng = make_model_twin((64, 64)), np.random.default_rng(0)

    def at(kV, ms=20.0):
        return Setting(kV=kV, current_mA=1.0, exposure_ms=ms, filters=COPPER)

    def frames(mean_DN, sd_DN, ms):
        return np.round(300.0 + ms + mean_DN + sd_DN * rng.standard_normal((6, 64, 64))).astype(np.uint16)

    with write_acquisition(tmp_path / "flats.h5", line.instrument) as writer:
        for ms in darks_ms:
            writer.add_series(f"dark_{ms:g}", kind="dark", exposure_ms=ms, frames=frames(0.0, 12.0, ms))
        for kV in (40.0, 90.0):
            light = predict_flatfield(line, at(kV))
            shown = frames(light.mean_DN.value, light.sd_DN.value, 20.0)
            writer.add_series(f"flat_{kV:g}", kind="flat", setting=at(kV), frames=shown)
    with open_acquisition(tmp_path / "flats.h5") as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(0), advise=False)
    told = [text for text in twin.warnings if "measure darks at 20 ms" in text]
    assert len(told) == int(len(darks_ms) == 1)
    for kV in (40.0, 65.0, 90.0):
        found, truth = predict_flatfield(twin, at(kV)), predict_flatfield(line, at(kV))
        assert found.mean_DN.low < truth.mean_DN.value < found.mean_DN.high
    for level in twin.levels:
        light = predict_flatfield(line, at(level.kV))
        wide = half_width(level.rate_DN_per_mAs) > 80.0 * DARK_SD / light.mean_DN.value
        assert wide == (len(darks_ms) == 1)
        slope = (light.sd_DN.value**2 - 12.0**2) / light.mean_DN.value
        assert level.photon_transfer_slope_DN.low < slope < level.photon_transfer_slope_DN.high


def test_flats_of_two_currents_tell_the_dark_current():
    points = [
        dataclasses.replace(flat(0), signal_DN=2000.0 - 40.0, unknown_growth_ms=-80.0),
        dataclasses.replace(flat(1), signal_DN=500.0 - 40.0, load_mAs=0.025, unknown_growth_ms=-80.0),
    ]
    found = setting_errors(points, source_detector_mm=MM, dark_DN_per_ms_sd=DARK_SD)
    assert found["dark_DN_per_ms"]["value"] == pytest.approx(0.5, abs=0.2)
    assert found["dark_DN_per_ms"]["sd"] < 0.5 * DARK_SD
    assert np.shape(found["second_moments"]) == (3, 3)
    # no dark current where darks tell it: nothing is learned of it
    assert "dark_DN_per_ms" not in setting_errors([flat(0), flat(1)], source_detector_mm=MM, dark_DN_per_ms_sd=DARK_SD)


def test_levels_at_exposures_as_short_as_their_error_stay_above_zero(make_model_twin):
    twin = make_model_twin((8, 8))
    rows = [dataclasses.replace(flat(0), series=name, exposure_ms=1.0, load_mAs=0.001).as_dict()
            for level in twin.levels for name in level.series]  # fmt: skip
    errors = setting_errors([flat(0, ms=1.0)], source_detector_mm=MM)
    twin = dataclasses.replace(twin, evidence={"photon_transfer": rows, "setting_errors": errors})
    for ms in (0.3, 1.0):
        found = predict_flatfield(twin, Setting(kV=40.0, current_mA=100.0, exposure_ms=ms, filters=COPPER)).mean_DN
        assert 0.0 < found.low < found.value < found.high
    # nothing but rounding where the level is many standard deviations from 0
    found = estimate_above_zero(100.0, 2.0)
    assert (found.low, found.high) == pytest.approx((100.0 - 2.0 * Z95, 100.0 + 2.0 * Z95), rel=1e-6)
    # a Gaussian whose half is cut
    assert estimate_above_zero(1e-6, 1.0).high == pytest.approx(2.2414, abs=1e-3)


def test_evidence_of_older_twins_says_nothing_and_damaged_evidence_is_refused(make_model_twin):
    twin, setting = make_model_twin((8, 8)), Setting(kV=60.0, current_mA=1.0, exposure_ms=20.0)
    assert stray_of_setting(twin, setting, None, distance_mm=MM, signal_DN=1.0) == (0.0, 0.0)
    row = {"series": "a", "used": True, "signal_DN": 100.0, "load_mAs": 0.1, "exposure_ms": 100.0}
    damaged = {"photon_transfer": [row], "setting_errors": {"second_moments": [[1.0, "b"]], "largest_DN": 1.0}}
    with pytest.raises(InputError, match="setting_errors"):
        stray_of_setting(dataclasses.replace(twin, evidence=damaged), setting, None, distance_mm=MM, signal_DN=1.0)

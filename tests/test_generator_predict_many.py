"""Many settings at once give what each gives alone, on a twin whose posterior is one parameter set."""

import importlib.util
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytwin.acquisition.setting import Setting, filters_from_text
from raytwin.errors import InputError
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.generator.predictions.predict_many import predict_levels

_PLACE = importlib.util.spec_from_file_location("twin_by_hand", Path(__file__).with_name("test_generator_twin.py"))
_BY_HAND = importlib.util.module_from_spec(_PLACE)
_PLACE.loader.exec_module(_BY_HAND)

KV = [40.0, 40.0, 61.5, 61.5, 90.0, 75.0]
FILTERS = [filters_from_text(text) for text in ("Cu:0.05", "", "Al:1+Cu:0.1", "Cu:0.1+Al:1", "Cu:0.05", "Sn:0.1")]
LOAD_MAS = np.array([0.02, 0.01, 0.02, 0.02, 0.005, 0.015])


@pytest.fixture(scope="module")
def twin():
    made = _BY_HAND.make_twin()
    parameters = made.spectral.best.copy()
    parameters[[1, 2, 8, 9]] = 0.1, 0.007, 0.02, -0.01  # scintillator, kV error, attenuation of Al and Cu
    return replace(made, spectral=replace(made.spectral, best=parameters, samples=np.repeat([parameters], 2, axis=0)))


@pytest.mark.parametrize("distance_mm", [None, 700.0])
def test_many_settings_at_once_are_the_single_predictions(twin, distance_mm):
    found = predict_levels(twin, kV=KV, filters=FILTERS, load_mAs=LOAD_MAS, averaged=4, source_detector_mm=distance_mm)
    for number, (kV, stack, load) in enumerate(zip(KV, FILTERS, LOAD_MAS, strict=True)):
        setting = Setting(
            kV=kV,
            exposure_ms=20.0,
            current_mA=float(load / 0.02),
            filters=stack,
            averaged=4,
            source_detector_mm=distance_mm,
        )
        single = predict_flatfield(twin, setting)
        assert found.mean_DN[number] == pytest.approx(single.mean_DN.value, rel=1e-9)
        assert found.sd_DN[number] == pytest.approx(single.sd_DN.value, rel=1e-9)
        assert found.gain_DN[number] == pytest.approx(single.gain_DN.value, rel=1e-9)
        assert found.measured[number] == single.measured_level
    assert found.measured.tolist() == [True, False, False, False, True, False]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kV": [40.0]}, "one kV and one filter stack a setting"),
        ({"load_mAs": [0.1, 0.2]}, "load_mAs: got shape .2,.; expected one number, or one for each of 6"),
        ({"load_mAs": 0.0}, "finite values above 0"),
        ({"kV": [np.nan] * 6}, "finite values above 0"),
        ({"averaged": np.inf}, "finite values above 0"),
        ({"filters": [filters_from_text("Pb:500")] * 6}, "layers that let some photons through"),
    ],
)
def test_settings_that_cannot_be_predicted_are_refused(twin, changes, message):
    with pytest.raises(InputError, match=message):
        predict_levels(twin, **{"kV": KV, "filters": FILTERS, "load_mAs": LOAD_MAS, **changes})


@pytest.mark.parametrize("kV", [9.95, 301.0])
def test_a_voltage_without_spectra_is_refused_as_it_was_given(twin, kV):
    """The calibrated tube gives 0.7 % more than it is set to: neither edge is where the message would have it."""
    expected = f"kV: got {kV:g} kV; expected 10 to 300 kV"
    with pytest.raises(InputError, match=expected):
        predict_levels(twin, kV=[kV], filters=FILTERS[:1], load_mAs=0.02)
    with pytest.raises(InputError, match=expected):
        predict_flatfield(twin, Setting(kV=kV, exposure_ms=20.0, current_mA=0.1, filters=FILTERS[0]))


def test_without_a_spectrum_only_measured_levels_are_predicted_at_once(twin):
    plain = replace(twin, spectral=None)
    known = predict_levels(plain, kV=[40.0], filters=FILTERS[:1], load_mAs=0.02)
    assert known.mean_DN[0] == pytest.approx(23000.0 * 0.02)
    with pytest.raises(InputError, match="without spectral part"):
        predict_levels(plain, kV=[60.0], filters=FILTERS[:1], load_mAs=0.02)


@pytest.mark.parametrize("kV", [90.0, 75.0])
def test_flats_that_stray_from_their_beams_levels_widen_every_predicted_level(twin, kV):
    """A response that bends shows as loads whose levels differ: one more load strays as they do, measured beam or not."""
    setting = Setting(kV=kV, filters=filters_from_text("Cu:0.05"), current_mA=1.0, exposure_ms=10.0)

    def relative_half_width(scatter):
        line = replace(twin, evidence={**twin.evidence, "scatter_of_flats": scatter})
        mean = predict_flatfield(line, setting).mean_DN
        return (mean.high - mean.low) / 2.0 / mean.value

    usual = relative_half_width(None)
    steady = relative_half_width({"relative_sd": 1e-4, "degrees": 6.0})
    straying = relative_half_width({"relative_sd": 0.01, "degrees": 6.0})
    assert steady == usual
    assert straying == pytest.approx(math.sqrt(usual**2 + 1.96**2 * (0.01**2 - 0.002**2)), rel=0.02)


def test_series_whose_noise_strays_widen_every_predicted_noise(twin):
    setting = Setting(kV=75.0, filters=filters_from_text("Cu:0.05"), current_mA=1.0, exposure_ms=10.0)

    def relative_half_width(scatter):
        line = replace(twin, evidence={**twin.evidence, "scatter_of_noise": scatter})
        sd = predict_flatfield(line, setting).sd_DN
        return (sd.high - sd.low) / 2.0 / sd.value

    none = relative_half_width(None)
    assert relative_half_width({"relative_sd": 0.0, "degrees": 4.0}) == none
    with pytest.raises(InputError, match=r"`scatter_of_noise` that cannot be read; .* calibrate again"):
        relative_half_width({"degrees": 4.0})
    # power strays by 6 %, noise by half of it
    straying = relative_half_width({"relative_sd": 0.06, "degrees": 4.0})
    assert straying == pytest.approx(math.hypot(none, 1.96 * 0.03), rel=0.02)

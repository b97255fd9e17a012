"""Signals of the spectral model against direct sums over a spectrum; gains against published means of energy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition.setting import Filter, filters_from_text
from raytwin.errors import InputError
from raytwin.generator.line.spectral_signal import OpenBeam, SpectralModel, attenuation_scale_name, gain_behind_object
from raytwin.spectra import (
    air_kerma_uGy_per_mAs,
    detector_response,
    filtered_spectrum,
    tube_fluence_interpolated,
    tube_spectrum,
)


@pytest.fixture(scope="module")
def model():
    return SpectralModel(filter_materials=("Al", "Cu"), highest_kV=100.0)


def parameters(model, **values):
    full = np.zeros((1, len(model.names)))
    for name, value in values.items():
        full[0, model.names.index(name)] = value
    return full


def direct(kV, filters, *, scintillator="CsI:0.5", cover="", counting=False):
    """Signal (keV), sum of squares (keV2), interacting photons per mAs and mm2 at 1 m; kerma (uGy / mAs)."""
    bare = tube_spectrum(kV=kV)
    weights = tube_fluence_interpolated(kV, energies_keV=bare.energies_keV, for_sums=True)
    spectrum = filtered_spectrum(replace(bare, fluence=weights), filters_from_text(filters))
    response = detector_response(
        scintillator=filters_from_text(scintillator),
        cover=filters_from_text(cover),
        counting=counting,
        energies_keV=spectrum.energies_keV,
    )
    photons = spectrum.fluence * spectrum.bin_width_keV / 100.0
    return (
        float(np.sum(photons * response.mean_deposited_keV)),
        float(np.sum(photons * response.mean_square_deposited_keV2)),
        float(np.sum(photons * response.interacting_fraction)),
        air_kerma_uGy_per_mAs(spectrum),
    )


@pytest.mark.parametrize(
    ("kV", "filters"), [(40.0, "Cu:0.05"), (90.0, "Cu:0.05"), (60.5, "Al:1+Cu:0.1"), (90.0, ""), (90.0, "Sn:0.1")]
)
def test_signals_are_the_sums_over_the_spectrum(model, kV, filters):
    signal = model.signal(parameters(model), OpenBeam(kV=kV, filters=filters_from_text(filters)))
    first, second, photons, kerma = direct(kV, filters)
    assert signal.rate_DN_per_mAs[0] == pytest.approx(first, rel=1e-3)
    assert signal.gain_DN[0] == pytest.approx(second / first, rel=1e-3)
    assert signal.absorbed_per_mAs[0] == pytest.approx(photons, rel=1e-3)
    assert signal.kerma_uGy_per_mAs[0] == pytest.approx(kerma, rel=1e-3)


def test_a_layer_of_inherent_aluminium_is_a_filter(model):
    beam = OpenBeam(kV=40.0, filters=filters_from_text("Cu:0.05"))
    signal = model.signal(parameters(model, inherent_filtration_mm_Al=0.7), beam)
    assert signal.rate_DN_per_mAs[0] == pytest.approx(direct(40.0, "Cu:0.05+Al:0.7")[0], rel=1e-3)


def test_a_thicker_scintillator_between_nodes_agrees_with_its_own_response(model):
    beam = OpenBeam(kV=90.0, filters=filters_from_text("Cu:0.05"))
    signal = model.signal(parameters(model, log_scintillator_thickness=0.15), beam)
    first, second, *_ = direct(90.0, "Cu:0.05", scintillator=f"CsI:{0.5 * np.exp(0.15)}")
    assert signal.rate_DN_per_mAs[0] == pytest.approx(first, rel=1e-3)
    assert signal.gain_DN[0] == pytest.approx(second / first, rel=1e-3)


def test_a_tube_voltage_error_is_another_tube_voltage(model):
    beam = OpenBeam(kV=60.0, filters=())
    signal = model.signal(parameters(model, kV_error=0.013), beam)
    assert signal.rate_DN_per_mAs[0] == pytest.approx(direct(60.0 * 1.013, "")[0], rel=1e-3)


def test_without_escape_the_response_is_that_of_kept_k_photons(model):
    beam = OpenBeam(kV=90.0, filters=filters_from_text("Cu:0.05"))
    kept = model.signal(parameters(model, escape_scale=-1.0), beam)
    bare = tube_spectrum(kV=90.0, filters=beam.filters)
    response = detector_response(
        scintillator=filters_from_text("CsI:0.5"), energies_keV=bare.energies_keV, escape=False
    )
    first, second = (
        float(np.sum(bare.fluence * moment))
        for moment in (response.mean_deposited_keV, response.mean_square_deposited_keV2)
    )
    assert kept.rate_DN_per_mAs[0] == pytest.approx(first * bare.bin_width_keV / 100.0, rel=2e-3)
    assert kept.gain_DN[0] == pytest.approx(second / first, rel=2e-3)


def test_a_cover_that_nobody_stated_is_a_cover(model):
    beam = OpenBeam(kV=60.0, filters=())
    declared = SpectralModel(cover=filters_from_text("C:0.8"), filter_materials=("Al", "Cu"), highest_kV=100.0)
    # behind a window: below 5 keV the unstated layer is not steeper than there
    moved = model.signal(parameters(model, cover_mm_C=0.8, inherent_filtration_mm_Al=0.5), beam)
    known = declared.signal(parameters(declared, inherent_filtration_mm_Al=0.5), beam)
    for name in ("rate_DN_per_mAs", "gain_DN", "absorbed_per_mAs", "kerma_uGy_per_mAs"):
        assert getattr(moved, name)[0] == pytest.approx(getattr(known, name)[0], rel=1e-3), name
    assert (
        moved.kerma_uGy_per_mAs[0]
        == model.signal(parameters(model, inherent_filtration_mm_Al=0.5), beam).kerma_uGy_per_mAs[0]
    )


def test_a_voltage_that_varies_is_the_mean_over_its_voltages(model):
    beam = OpenBeam(kV=60.0, filters=filters_from_text("Al:2"))
    spread = 0.02
    varying = model.signal(parameters(model, kV_variance=spread**2), beam)
    ends = [model.signal(parameters(model, kV_error=sign * spread), beam) for sign in (-1.0, 1.0)]
    mean = np.mean([item.rate_DN_per_mAs[0] for item in ends])
    assert varying.rate_DN_per_mAs[0] == pytest.approx(mean, rel=1e-6)
    square = np.mean([item.rate_DN_per_mAs[0] * item.gain_DN[0] for item in ends])
    assert varying.rate_DN_per_mAs[0] * varying.gain_DN[0] == pytest.approx(square, rel=1e-6)


def test_draws_that_were_changed_are_other_draws(model):
    beam = OpenBeam(kV=60.0, filters=())
    samples = np.concatenate([parameters(model), parameters(model, log_scintillator_thickness=0.2)])
    before = model.signal(samples, beam).rate_DN_per_mAs
    samples[1] = samples[0]
    after = model.signal(samples, beam).rate_DN_per_mAs
    assert before[1] > 1.01 * before[0]
    assert after[1] == after[0] == before[0]


def test_light_counts_once_in_the_signal_and_twice_in_its_square(model):
    beam = OpenBeam(kV=30.0, filters=filters_from_text("Al:2"))
    plain, lighter = (model.signal(parameters(model, light_exponent=value), beam) for value in (0.0, 0.3))
    rows = model.moment_weights(parameters(model)[0], beam)
    power = (model.energies_keV[: rows.shape[1]] / 50.0) ** 0.3
    assert lighter.rate_DN_per_mAs[0] == pytest.approx(float(rows[0] @ power), rel=1e-9)
    assert lighter.rate_DN_per_mAs[0] * lighter.gain_DN[0] == pytest.approx(float(rows[1] @ power**2), rel=1e-9)
    assert lighter.absorbed_per_mAs[0] == pytest.approx(plain.absorbed_per_mAs[0], rel=1e-12)


def test_declared_layers_and_cover_lie_in_the_beam():
    declared = SpectralModel(
        inherent=filters_from_text("Be:0.8+Al:0.5"),
        scintillator=filters_from_text("Gd2O2S@7.32:0.1"),
        cover=filters_from_text("C:1"),
        highest_kV=90.0,
    )
    signal = declared.signal(parameters(declared), OpenBeam(kV=90.0, filters=()))
    first, second, *_ = direct(90.0, "Be:0.8+Al:0.5", scintillator="Gd2O2S@7.32:0.1", cover="C:1")
    assert signal.rate_DN_per_mAs[0] == pytest.approx(first, rel=1e-3)
    assert signal.gain_DN[0] == pytest.approx(second / first, rel=1e-3)


def test_a_counting_detector_has_gain_one_count():
    counter = SpectralModel(scintillator=filters_from_text("CdTe:1"), counting=True, highest_kV=90.0)
    signal = counter.signal(parameters(counter), OpenBeam(kV=60.0, filters=()))
    assert signal.gain_DN[0] == pytest.approx(1.0, abs=1e-9)
    assert signal.rate_DN_per_mAs[0] == pytest.approx(signal.absorbed_per_mAs[0])


def test_gain_at_90_kV_is_about_1_7_times_that_at_40_kV():
    """<E^2> / <E> of what CsI absorbs behind 50 um Cu and 0.5 mm Al: about 28.7 keV at 40 kV, 49.5 keV at 90 kV.

    These figures leave the escape of K-fluorescence out; with it the quanta at 90 kV are smaller.
    """
    spectra = {kV: tube_spectrum(kV=kV, filters=filters_from_text("Cu:0.05+Al:0.5")) for kV in (40.0, 90.0)}
    for kV, expected in ((40.0, 28.7), (90.0, 49.5)):
        energies = spectra[kV].energies_keV
        response = detector_response(
            scintillator=(Filter(material="CsI", thickness_mm=0.5),), energies_keV=energies, escape=False
        )
        weight = spectra[kV].fluence * response.interacting_fraction
        assert np.sum(weight * energies**2) / np.sum(weight * energies) == pytest.approx(expected, rel=0.015)
    model = SpectralModel(highest_kV=100.0)
    gains = [
        model.signal(parameters(model), OpenBeam(kV=kV, filters=filters_from_text("Cu:0.05+Al:0.5"))).gain_DN[0]
        for kV in (40.0, 90.0)
    ]
    assert 1.5 < gains[1] / gains[0] < 1.75


def test_scales_multiply_the_signal_and_the_gain_as_named(model):
    beam = OpenBeam(kV=60.0, filters=())
    plain = model.signal(parameters(model), beam)
    scaled = model.signal(
        parameters(model, log_output=np.log(1.3), log_DN_per_keV=np.log(0.2), log_swank=np.log(0.8)), beam
    )
    assert scaled.rate_DN_per_mAs[0] == pytest.approx(plain.rate_DN_per_mAs[0] * 1.3 * 0.2)
    assert scaled.gain_DN[0] == pytest.approx(plain.gain_DN[0] * 0.2 / 0.8)
    assert scaled.absorbed_per_mAs[0] == pytest.approx(plain.absorbed_per_mAs[0] * 1.3)


@given(st.floats(0.0, 60.0), st.floats(0.0, 60.0))
def test_gain_rises_and_transmission_falls_behind_thicker_product(model, first_mm, second_mm):
    thin, thick = sorted((first_mm, second_mm))
    rate, gain = gain_behind_object(
        model,
        parameters(model)[0],
        OpenBeam(kV=60.0, filters=()),
        material="chicken_breast",
        thickness_mm=np.array([0.0, thin, thick]),
    )
    assert rate[0] == gain[0] == pytest.approx(1.0)
    assert rate[2] <= rate[1] + 1e-12 <= 1.0 + 1e-9
    assert gain[2] >= gain[1] - 1e-12 >= 1.0 - 1e-9


@given(st.floats(-0.05, 0.05), st.floats(0.0, 3.0), st.floats(-0.3, 0.3))
def test_many_sets_at_once_are_the_sets_one_by_one(model, kV_error, filtration, thickness):
    beam = OpenBeam(kV=60.0, filters=filters_from_text("Cu:0.05"))
    one = parameters(
        model, kV_error=kV_error, inherent_filtration_mm_Al=filtration, log_scintillator_thickness=thickness
    )
    other = parameters(model, **{attenuation_scale_name("Cu"): 0.02})
    together = model.signal(np.concatenate([one, other]), beam)
    for row, alone in enumerate((one, other)):
        signal = model.signal(alone, beam)
        assert together.rate_DN_per_mAs[row] == pytest.approx(signal.rate_DN_per_mAs[0], rel=1e-12)
        assert together.gain_DN[row] == pytest.approx(signal.gain_DN[0], rel=1e-12)


def test_a_voltage_beyond_the_model_is_refused(model):
    with pytest.raises(InputError, match="kV: got 140 kV; expected at most 100 kV"):
        model.signal(parameters(model), OpenBeam(kV=140.0, filters=()))

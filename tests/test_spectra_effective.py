"""Effective attenuation, half-value layers, air kerma and measured spectra."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytwin.acquisition.setting import filters_from_text
from raytwin.errors import FileFormatError, InputError
from raytwin.materials import material_from_name, mu_per_mm
from raytwin.spectra import (
    Spectrum,
    air_kerma_uGy_per_mAs,
    detector_response,
    effective_mu_per_mm,
    energy_grid_keV,
    fluence_per_cm2_mAs,
    half_value_layer_mm,
    mean_energy_keV,
    signal_weights,
    spectrum_from_file,
    tube_spectrum,
)

WATER, ALUMINIUM = material_from_name("water"), material_from_name("Al")


def _one_energy(energy_keV: float) -> Spectrum:
    grid = energy_grid_keV(energy_keV + 0.25)
    fluence = np.zeros(grid.size)
    fluence[-1] = 1.0
    return Spectrum(energies_keV=grid, fluence=fluence)


@pytest.mark.parametrize("energy_keV", [20.25, 60.25, 120.25])
def test_one_energy_has_one_coefficient_at_any_thickness(energy_keV: float) -> None:
    mu = float(mu_per_mm(WATER, energy_keV))
    measured = effective_mu_per_mm(WATER, spectrum=_one_energy(energy_keV), thickness_mm=[0.0, 1e-9, 1.0, 100.0, 1e5])
    np.testing.assert_allclose(measured, mu, rtol=1e-9)
    assert effective_mu_per_mm(WATER, spectrum=_one_energy(energy_keV)) == pytest.approx(mu, rel=1e-12)


@given(thickness_mm=st.floats(0.01, 1e4), factor=st.floats(1.05, 10.0), kV=st.sampled_from([40, 90]))
@settings(max_examples=60, deadline=None)
def test_effective_mu_falls_with_thickness_between_its_limits(thickness_mm: float, factor: float, kV: int) -> None:
    beam = tube_spectrum(kV=kV, filters=filters_from_text("Cu:0.05+Al:0.5"))
    thin = float(effective_mu_per_mm(WATER, spectrum=beam))
    thick, thicker = effective_mu_per_mm(WATER, spectrum=beam, thickness_mm=[thickness_mm, thickness_mm * factor])
    assert mu_per_mm(WATER, beam.energies_keV).min() < thicker < thick < thin


def test_effective_mu_is_equation_4_with_its_normalisation() -> None:
    beam = tube_spectrum(kV=60, filters=filters_from_text("Al:2"))
    response = detector_response(energies_keV=beam.energies_keV, scintillator=filters_from_text("CsI:0.6"))
    weights = beam.energies_keV * response.absorbed_fraction * beam.fluence
    mu = mu_per_mm(ALUMINIUM, beam.energies_keV)
    thin = effective_mu_per_mm(ALUMINIUM, spectrum=beam, response=response)
    assert thin == pytest.approx(np.sum(weights * mu) / np.sum(weights), rel=1e-12)
    through = effective_mu_per_mm(ALUMINIUM, spectrum=beam, response=response, thickness_mm=3.0)
    assert through == pytest.approx(-np.log(np.sum(weights * np.exp(-mu * 3.0)) / np.sum(weights)) / 3.0, rel=1e-12)
    counting = detector_response(
        energies_keV=beam.energies_keV, scintillator=filters_from_text("CsI:0.6"), counting=True
    )
    # counting weighs the soft photons more
    assert effective_mu_per_mm(ALUMINIUM, spectrum=beam, response=counting) > thin


@pytest.mark.parametrize(("kV", "expected_keV"), [(40, 28.7), (90, 49.5)])
def test_gain_ratio_of_the_spectrum_is_the_published_one(kV: float, expected_keV: float) -> None:
    # <E^2> / <E> over what 0.6 mm CsI absorbs, K escape left out, behind 50 um Cu and 0.5 mm Al: 28.7 keV at 40 kV and
    # 49.5 keV at 90 kV, and so 1.7 times as much gain at 90 kV. With K escape the moments fall to 28.2 and 47.7 keV.
    beam = tube_spectrum(kV=kV, filters=filters_from_text("Cu:0.05+Al:0.5"))
    layers = filters_from_text("CsI:0.6")
    whole = detector_response(energies_keV=beam.energies_keV, scintillator=layers, escape=False)
    ratio = (whole.mean_square_deposited_keV2 @ beam.fluence) / (whole.mean_deposited_keV @ beam.fluence)
    assert ratio == pytest.approx(expected_keV, rel=0.005)
    escaped = detector_response(energies_keV=beam.energies_keV, scintillator=layers)
    less = (escaped.mean_square_deposited_keV2 @ beam.fluence) / (escaped.mean_deposited_keV @ beam.fluence)
    assert 0.95 * ratio < less < ratio


def test_a_response_on_other_energies_is_refused() -> None:
    beam = tube_spectrum(kV=60)
    with pytest.raises(
        InputError, match=r"response: got a response at 78 energies; expected a response on the spectrum"
    ):
        signal_weights(beam, detector_response(energies_keV=energy_grid_keV(40.0)))
    longer = detector_response(energies_keV=energy_grid_keV(100.0))
    np.testing.assert_allclose(signal_weights(beam, longer), signal_weights(beam), rtol=1e-12)


@pytest.mark.parametrize("thickness_mm", [-1.0, float("nan"), float("inf")])
def test_a_thickness_that_cannot_be_is_refused(thickness_mm: float) -> None:
    with pytest.raises(InputError, match=r"thickness_mm: got .* mm; expected finite thicknesses of 0 mm or more"):
        effective_mu_per_mm(WATER, spectrum=_one_energy(60.25), thickness_mm=thickness_mm)


@pytest.mark.parametrize("fraction", [0.5, 0.25, 0.1])
def test_value_layers_of_one_energy_are_logarithms_over_mu(fraction: float) -> None:
    expected = -np.log(fraction) / float(mu_per_mm(ALUMINIUM, 60.25))
    assert half_value_layer_mm(_one_energy(60.25), ALUMINIUM, fraction=fraction) == pytest.approx(expected, rel=1e-9)


def test_a_fraction_that_cannot_be_is_refused() -> None:
    for fraction in (0.0, 1.0, float("nan")):
        with pytest.raises(InputError, match=r"fraction: got .*; expected a fraction above 0 and below 1"):
            half_value_layer_mm(_one_energy(60.25), ALUMINIUM, fraction=fraction)


def test_air_kerma_of_one_energy_is_fluence_times_energy_times_the_nist_coefficient() -> None:
    # NIST mu_en/rho of air: 0.03041 cm2/g at 60 keV; one photon / keV / cm2 in a bin of 0.5 keV at 60.25 keV
    near = 0.5 * 60.25 * 0.03041 * 1.602176634e-16 / 1e-3 * 1e6
    assert air_kerma_uGy_per_mAs(_one_energy(60.25)) == pytest.approx(near, rel=0.01)


def test_air_kerma_of_a_relative_spectrum_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "relative.txt"
    path.write_text("10 1\n10.5 2\n11 1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"spectrum: got a relative spectrum \(file relative.txt\)"):
        air_kerma_uGy_per_mAs(spectrum_from_file(path))


@pytest.mark.parametrize(
    ("header", "shift_keV"),
    [
        ("", 0.0),
        ("# energy: centre\n", 0.0),
        ("# energy: top\n", -0.125),
        ("# (top of bin)\n", -0.125),
        ("# energy: bottom\n", 0.125),
    ],
)
def test_a_measured_spectrum_keeps_its_photons_and_its_energies(tmp_path: Path, header: str, shift_keV: float) -> None:
    energies = np.arange(10.125, 40.0, 0.25)
    fluence = np.exp(-((energies - 25.0) ** 2) / 40.0)
    path = tmp_path / "measured.dat"
    rows = "".join(f"{energy:.4f}\t{value:.6e}\n" for energy, value in zip(energies, fluence, strict=True))
    path.write_text(f"# tube voltage: 40 kV\n# unit: photons/keV/cm2/mAs at 1 m\n{header}{rows}", encoding="utf-8")
    spectrum = spectrum_from_file(path)
    assert spectrum.absolute
    assert spectrum.kV == 40.0
    assert fluence_per_cm2_mAs(spectrum) == pytest.approx(fluence.sum() * 0.25, rel=1e-6)
    expected = energies @ fluence / fluence.sum() + shift_keV
    assert mean_energy_keV(spectrum) == pytest.approx(expected, abs=1e-3)
    np.testing.assert_array_equal(spectrum.energies_keV, energy_grid_keV(200.0)[: spectrum.energies_keV.size])


def test_column_names_above_the_numbers_are_passed_over(tmp_path: Path) -> None:
    plain, named = tmp_path / "plain.csv", tmp_path / "named.csv"
    rows = "10,1\n11,2\n12,1\n"
    plain.write_text(rows, encoding="utf-8")
    named.write_text(f"keV,fluence\n{rows}", encoding="utf-8")
    np.testing.assert_array_equal(spectrum_from_file(named).fluence, spectrum_from_file(plain).fluence)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# nothing\n", r"0 lines of numbers in .*; expected at least two"),
        ("10 1\n11 x\n", r"line 2: got '11 x'; expected two numbers: energy in keV and fluence per keV"),
        ("10 1\n11\n", r"line 2: got '11'"),
        ("10 1\n11 1\n13 1\n", r"energies: got steps from 1 to 2 keV; expected energies that rise in equal steps"),
        ("11 1\n10 1\n", r"expected energies that rise in equal steps"),
        ("10 1\n11 -1\n", r"fluence: got negative values or NaN"),
        ("10 1\n11 nan\n", r"fluence: got negative values or NaN"),
        ("10 0\n11 0\n", r"got no photons above 1 keV; expected a spectrum"),
        (
            "10000 1\n10500 1\n",
            r"got photons at 10750 keV; expected energies in keV, 500 keV at most; convert eV to keV",
        ),
        ("# energy: left\n10 1\n11 1\n", r"energy: got 'left'; expected centre, top or bottom"),
    ],
)
def test_a_spectrum_file_that_cannot_be_read_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "measured.dat"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=message):
        spectrum_from_file(path)
    with pytest.raises(FileFormatError, match=r"spectrum file: got .*; expected a readable file"):
        spectrum_from_file(tmp_path / "missing.dat")

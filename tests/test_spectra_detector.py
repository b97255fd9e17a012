"""What a detector keeps of each photon: closed forms, photons followed one by one, and the laws of moments."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytwin.acquisition.setting import Filter, filters_from_text
from raytwin.errors import InputError
from raytwin.materials import material_from_name, mu_per_mm, transmission
from raytwin.spectra import counted_fraction, detector_response, energy_grid_keV, k_escape_fractions, tube_spectrum
from raytwin.spectra.detector import COUNTER_SD_KEV

GRID = energy_grid_keV(150.0)
DETECTORS = st.tuples(
    st.sampled_from(["CsI", "Gd2O2S@4.5", "CdTe", "a-Se", "CdWO4", "Si"]), st.floats(0.01, 3.0), st.booleans()
)


@pytest.mark.parametrize("scintillator", ["CsI:0.5", "Gd2O2S@7.32:0.1", "CdTe:1"])
def test_without_escape_everything_that_interacts_stays(scintillator: str) -> None:
    layers = filters_from_text(scintillator)
    response = detector_response(energies_keV=GRID, scintillator=layers, escape=False, bin_width_keV=0.0)
    absorbed = 1.0 - transmission(layers, GRID)
    np.testing.assert_allclose(response.interacting_fraction, absorbed, rtol=1e-12)
    np.testing.assert_allclose(response.absorbed_fraction, absorbed, rtol=1e-12)
    np.testing.assert_allclose(response.mean_deposited_keV, GRID * absorbed, rtol=1e-12)
    np.testing.assert_allclose(response.mean_square_deposited_keV2, GRID**2 * absorbed, rtol=1e-12)


def test_a_cover_takes_its_share_of_every_moment() -> None:
    cover = filters_from_text("C:1+Al:0.2")
    bare, covered = detector_response(energies_keV=GRID), detector_response(energies_keV=GRID, cover=cover)
    passed = transmission(cover, GRID)
    # the bins that an edge of carbon, aluminium or caesium iodide cuts are means of products
    smooth = np.abs(covered.interacting_fraction / (bare.interacting_fraction * passed) - 1) < 1e-12
    assert smooth.sum() >= GRID.size - 8
    np.testing.assert_allclose(
        covered.mean_square_deposited_keV2[smooth], (bare.mean_square_deposited_keV2 * passed)[smooth], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "thickness_mm", "energy_keV"),
    [("CsI", 0.5, 40.0), ("CsI", 0.1, 60.0), ("Gd2O2S@4.5", 0.2, 52.0), ("CdTe", 1.0, 35.0), ("a-Se", 0.3, 20.0)],
)
def test_moments_agree_with_photons_followed_one_by_one(name: str, thickness_mm: float, energy_keV: float) -> None:
    rng = np.random.default_rng(20_260_727)
    photons = 200_000
    material = material_from_name(name)
    mu = float(mu_per_mm(material, energy_keV))
    depth_mm = rng.exponential(1.0 / mu, photons)
    inside = depth_mm < thickness_mm
    # chance that an interaction emits each K line: what escapes from a layer so thin that every K photon leaves it
    lines = k_escape_fractions(material, [energy_keV], thickness_mm=1e-9)
    chances = np.array([float(fraction[0]) for _, fraction in lines])
    line_keV = np.append([energy for energy, _ in lines], 0.0)
    which = rng.choice(line_keV.size, size=photons, p=np.append(chances, 1.0 - chances.sum()))
    mu_line = np.append([float(mu_per_mm(material, energy)) for energy, _ in lines], 1.0)[which]
    cosine = rng.uniform(-1.0, 1.0, photons)
    path_mm = np.where(cosine > 0, thickness_mm - depth_mm, depth_mm) / np.abs(cosine)
    leaves = rng.exponential(1.0, photons) > mu_line * path_mm
    deposited_keV = np.where(inside, energy_keV - np.where(leaves, line_keV[which], 0.0), 0.0)

    response = detector_response(
        energies_keV=[energy_keV], scintillator=[Filter(material=name, thickness_mm=thickness_mm)]
    )
    for counted, expected in (
        (inside.astype(float), response.interacting_fraction[0]),
        (deposited_keV, response.mean_deposited_keV[0]),
        (deposited_keV**2, response.mean_square_deposited_keV2[0]),
    ):
        standard_error = counted.std(ddof=1) / np.sqrt(photons)
        assert abs(counted.mean() - expected) < 4.5 * standard_error + 1e-6 * expected

    # a counter of it, its threshold between what stays with and without the K photon
    threshold_keV = energy_keV - 0.5 * float(line_keV[0])
    pulse_keV = deposited_keV[inside] + COUNTER_SD_KEV * rng.standard_normal(int(inside.sum()))
    share = counted_fraction(
        energies_keV=[energy_keV],
        threshold_keV=[threshold_keV],
        layer=Filter(material=name, thickness_mm=thickness_mm),
    )[0, 0]
    assert abs(np.mean(pulse_keV > threshold_keV) - share) < 4.5 * np.sqrt(share * (1.0 - share) / inside.sum())

    # the same where two pixels share the charge at random, with a threshold that both may pass
    part, threshold_keV = rng.random(int(inside.sum())), 0.3 * energy_keV
    thresholds_keV = threshold_keV + COUNTER_SD_KEV * rng.standard_normal(part.size)
    counts = sum((one * deposited_keV[inside] > thresholds_keV).astype(int) for one in (part, 1.0 - part))
    expected = counted_fraction(
        energies_keV=[energy_keV],
        threshold_keV=[threshold_keV],
        layer=Filter(material=name, thickness_mm=thickness_mm),
        shared=True,
    )[0, 0]
    assert abs(counts.mean() - expected) < 4.5 * counts.std() / np.sqrt(counts.size)


def test_k_lines_of_caesium_iodide_escape_as_published() -> None:
    # Iodine and caesium K-alpha at 28.5 and 30.9 keV (X-ray Data Booklet); no escape below the edge of each
    lines = k_escape_fractions(material_from_name("CsI"), np.array([30.0, 34.0, 40.0]), thickness_mm=0.5)
    energies = [energy for energy, _ in lines]
    assert [energy for energy in energies if abs(energy - 28.5) < 0.2]
    assert [energy for energy in energies if abs(energy - 30.9) < 0.2]
    total = sum(fraction for _, fraction in lines)
    assert total[0] == 0.0
    assert 0.0 < total[1] < total[2] < 0.5


def test_thin_layers_lose_more_fluorescence_than_thick_ones() -> None:
    shares = [
        sum(
            float(fraction[0]) for _, fraction in k_escape_fractions(material_from_name("CsI"), [50.0], thickness_mm=mm)
        )
        for mm in (0.001, 0.1, 0.5, 5.0)
    ]
    assert np.all(np.diff(shares) < 0)


@given(detector=DETECTORS)
@settings(max_examples=40, deadline=None)
def test_moments_keep_their_laws(detector: tuple[str, float, bool]) -> None:
    name, thickness_mm, counting = detector
    response = detector_response(
        energies_keV=GRID, scintillator=[Filter(material=name, thickness_mm=thickness_mm)], counting=counting
    )
    share, mean, square = (
        response.interacting_fraction,
        response.mean_deposited_keV,
        response.mean_square_deposited_keV2,
    )
    assert np.all((share > 0) & (share <= 1))
    # in a bin that an edge cuts, mean energies and shares may differ by the bin's half width
    assert np.all((response.absorbed_fraction >= 0) & (response.absorbed_fraction <= share * (1 + 0.25 / GRID)))
    # Cauchy-Schwarz: the square of a mean is at most the mean square times the share that has any
    assert np.all(mean**2 <= square * share * (1 + 1e-9))
    if counting:
        np.testing.assert_array_equal(mean, share)
        np.testing.assert_array_equal(square, share)
    else:
        np.testing.assert_allclose(response.absorbed_fraction, mean / GRID, rtol=1e-12)


def test_a_second_layer_catches_what_the_first_lets_through() -> None:
    both = detector_response(energies_keV=GRID, scintillator=filters_from_text("CsI:0.2+Gd2O2S:0.2"), bin_width_keV=0.0)
    front = detector_response(energies_keV=GRID, scintillator=filters_from_text("CsI:0.2"), bin_width_keV=0.0)
    behind = detector_response(
        energies_keV=GRID,
        scintillator=filters_from_text("Gd2O2S:0.2"),
        cover=filters_from_text("CsI:0.2"),
        bin_width_keV=0.0,
    )
    np.testing.assert_allclose(
        both.mean_deposited_keV, front.mean_deposited_keV + behind.mean_deposited_keV, rtol=1e-10
    )


@pytest.mark.parametrize(
    ("kV", "scintillator", "filters"),
    [(60, "Gd2O2S:0.2", "Cu:0.5"), (90, "CsI:0.5", "Sn:0.2")],
)
def test_half_keV_bins_cost_less_than_a_tenth_of_a_percent(kV: float, scintillator: str, filters: str) -> None:
    import spekpy

    energies, fluence = spekpy.Spek(kvp=kV, th=12, dk=0.05, physics="casim", targ="W", z=100, mas=1).get_spectrum()
    layers, crossed = filters_from_text(scintillator), filters_from_text(filters)
    fine = detector_response(energies_keV=energies, scintillator=layers)
    signal = (fine.mean_deposited_keV * transmission(crossed, energies)) @ fluence * 0.05
    beam = tube_spectrum(kV=kV, filters=crossed)
    ours = (
        detector_response(energies_keV=beam.energies_keV, scintillator=layers).mean_deposited_keV @ beam.fluence * 0.5
    )
    assert ours == pytest.approx(signal, rel=1e-3)


@pytest.mark.parametrize("layers", ["", "CsI:0"])
def test_a_detector_without_a_sensitive_layer_is_refused(layers: str) -> None:
    with pytest.raises(InputError, match=r"scintillator: got .*; expected at least one layer of more than 0 mm"):
        detector_response(energies_keV=GRID, scintillator=filters_from_text(layers))


def test_a_counter_s_layer_has_a_thickness() -> None:
    with pytest.raises(InputError, match="a thickness above 0 mm"):
        counted_fraction(energies_keV=[60.0], threshold_keV=[20.0], layer=Filter(material="CdTe", thickness_mm=0.0))

"""Attenuation and energy absorption against published tables, and the laws that layers obey."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytwin.acquisition.setting import Filter
from raytwin.errors import InputError
from raytwin.materials import (
    TABLES,
    absorption_edges_keV,
    mass_attenuation_cm2_g,
    mass_energy_absorption_cm2_g,
    material_from_name,
    mixture_by_mass,
    mu_per_mm,
    transmission,
)

# NIST X-ray mass attenuation coefficients, Hubbell and Seltzer, NISTIR 5632 (2004): total with coherent scattering
NIST_CM2_G = {
    "water_liquid": {10: 5.329, 20: 0.8096, 30: 0.3756, 40: 0.2683, 60: 0.2059, 100: 0.1707, 150: 0.1505},
    "aluminium": {10: 26.23, 20: 3.441, 30: 1.128, 40: 0.5685, 60: 0.2778, 100: 0.1704},
    "copper": {20: 33.79, 30: 10.92, 40: 4.862, 60: 1.593, 100: 0.4584},
    "muscle_skeletal_icru44": {20: 0.8205, 30: 0.3783, 40: 0.2685, 60: 0.2048, 100: 0.1693},
    "bone_cortical_icru44": {20: 4.001, 30: 1.331, 40: 0.6655, 60: 0.3148, 100: 0.1855},
}
# the same source, mass energy-absorption coefficients
NIST_ENERGY_ABSORPTION_CM2_G = {
    "air": {10: 4.742, 15: 1.334, 20: 0.5389, 30: 0.1537, 40: 0.06833, 50: 0.04098, 60: 0.03041, 80: 0.02407,
            100: 0.02325, 150: 0.02496, 200: 0.02672, 300: 0.02872},
    "C": {10: 2.078, 15: 0.5627, 20: 0.2238, 30: 0.06614, 40: 0.03343, 50: 0.02397, 60: 0.02098, 100: 0.02147},
    "aluminium": {10: 25.43, 20: 3.094, 40: 0.3601, 60: 0.1099, 100: 0.03794, 200: 0.02745},
    "copper": {10: 148.4, 20: 27.88, 40: 4.163, 60: 1.290, 100: 0.2949, 200: 0.05781},
}  # fmt: skip

ENERGIES = np.array([10.0, 25.0, 33.3, 60.0, 120.0])
LAYERS = st.lists(
    st.builds(
        Filter,
        material=st.sampled_from(["water", "Al", "Cu", "chicken_breast", "CsI", "Gd2O2S@7.32"]),
        thickness_mm=st.floats(0.0, 20.0),
    ),
    max_size=4,
)


@pytest.mark.parametrize("name", NIST_CM2_G)
def test_mass_attenuation_agrees_with_nist_within_2_percent(name: str) -> None:
    energies = np.array(list(NIST_CM2_G[name]), dtype=float)
    published = np.array(list(NIST_CM2_G[name].values()))
    np.testing.assert_allclose(mass_attenuation_cm2_g(material_from_name(name), energies), published, rtol=0.02)


@pytest.mark.parametrize("table", ["chantler", "penelope"])
@pytest.mark.parametrize("name", NIST_CM2_G)
def test_second_opinions_differ_from_nist_by_4_percent_at_most_and_are_not_the_same_data(name: str, table: str) -> None:
    energies = np.array(list(NIST_CM2_G[name]), dtype=float)
    published = np.array(list(NIST_CM2_G[name].values()))
    other = mass_attenuation_cm2_g(material_from_name(name), energies, table=table)
    np.testing.assert_allclose(other, published, rtol=0.04)
    assert np.max(np.abs(other / mass_attenuation_cm2_g(material_from_name(name), energies) - 1)) > 0.002


def test_aluminium_at_65_keV_lies_on_the_nist_curve_unlike_the_kissel_total() -> None:
    # the cubic in log-log through NIST's values at 50, 60, 80 and 100 keV (0.3681, 0.2778, 0.2018, 0.1704 cm2/g)
    cubic = np.polyfit(np.log([50, 60, 80, 100]), np.log([0.3681, 0.2778, 0.2018, 0.1704]), 3)
    on_the_curve = np.exp(np.polyval(cubic, np.log(65.0)))
    assert mass_attenuation_cm2_g(material_from_name("Al"), 65.0) == pytest.approx(on_the_curve, rel=0.005)


@pytest.mark.parametrize(("name", "tolerance"), [("air", 0.002), ("C", 0.002), ("aluminium", 0.005), ("copper", 0.025)])
def test_energy_absorption_agrees_with_nist(name: str, tolerance: float) -> None:
    energies = np.array(list(NIST_ENERGY_ABSORPTION_CM2_G[name]), dtype=float)
    published = np.array(list(NIST_ENERGY_ABSORPTION_CM2_G[name].values()))
    absorbed = mass_energy_absorption_cm2_g(material_from_name(name), energies)
    np.testing.assert_allclose(absorbed, published, rtol=tolerance)


def test_energy_absorption_stays_below_attenuation() -> None:
    energies = np.geomspace(1.0, 500.0, 200)
    for name in ("water", "air", "bone", "Cu", "CsI", "W"):
        material = material_from_name(name)
        absorbed, attenuated = (
            mass_energy_absorption_cm2_g(material, energies),
            mass_attenuation_cm2_g(material, energies),
        )
        assert np.all((absorbed > 0) & (absorbed < attenuated))


def test_linear_coefficient_is_mass_coefficient_times_density() -> None:
    aluminium = material_from_name("Al")
    np.testing.assert_allclose(
        mu_per_mm(aluminium, ENERGIES), mass_attenuation_cm2_g(aluminium, ENERGIES) * 2.699 / 10, rtol=1e-14
    )


def test_shape_of_the_energies_is_kept() -> None:
    water = material_from_name("water")
    assert mu_per_mm(water, 60.0).shape == ()
    assert mu_per_mm(water, ENERGIES.reshape(5, 1)).shape == (5, 1)
    many = np.linspace(10.0, 100.0, 5000)
    np.testing.assert_allclose(mu_per_mm(water, many)[::500], mu_per_mm(water, many[::500]), rtol=1e-14)


@given(layers=LAYERS)
@settings(max_examples=60, deadline=None)
def test_transmission_lies_between_0_and_1_and_layers_multiply(layers: list[Filter]) -> None:
    whole = transmission(layers, ENERGIES)
    assert np.all((whole >= 0) & (whole <= 1))
    product = np.prod([transmission([layer], ENERGIES) for layer in layers], axis=0) if layers else np.ones(5)
    np.testing.assert_allclose(whole, product, rtol=1e-10, atol=1e-300)


@given(layers=LAYERS, seed=st.randoms())
@settings(max_examples=40, deadline=None)
def test_order_of_the_layers_does_not_matter(layers: list[Filter], seed: object) -> None:
    shuffled = list(layers)
    seed.shuffle(shuffled)  # type: ignore[attr-defined]
    np.testing.assert_allclose(
        transmission(shuffled, ENERGIES), transmission(layers, ENERGIES), rtol=1e-10, atol=1e-300
    )


@given(thickness_mm=st.floats(0.001, 10.0), more_mm=st.floats(0.001, 10.0))
@settings(max_examples=40, deadline=None)
def test_transmission_falls_with_thickness_and_a_split_layer_is_the_same_layer(
    thickness_mm: float, more_mm: float
) -> None:
    one = [Filter(material="Al", thickness_mm=thickness_mm)]
    two = [*one, Filter(material="Al", thickness_mm=more_mm)]
    joined = [Filter(material="Al", thickness_mm=thickness_mm + more_mm)]
    assert np.all(transmission(two, ENERGIES) < transmission(one, ENERGIES))
    np.testing.assert_allclose(transmission(two, ENERGIES), transmission(joined, ENERGIES), rtol=1e-10)


@given(share=st.floats(0.0, 1.0))
@settings(max_examples=30, deadline=None)
def test_mass_coefficient_of_a_mixture_is_the_mean_by_mass(share: float) -> None:
    water, bone = material_from_name("water"), material_from_name("bone")
    mixed = mixture_by_mass({water: 1.0 - share, bone: share}, name="wet bone")
    expected = (1 - share) * mass_attenuation_cm2_g(water, ENERGIES) + share * mass_attenuation_cm2_g(bone, ENERGIES)
    np.testing.assert_allclose(mass_attenuation_cm2_g(mixed, ENERGIES), expected, rtol=1e-12)


def test_a_bin_cut_by_an_edge_gets_its_mean_and_the_others_their_centre() -> None:
    tin = [Filter(material="Sn", thickness_mm=0.2)]
    centres = np.array([28.75, 29.25, 29.75])  # the K edge of tin is at 29.20 keV
    points, means = transmission(tin, centres), transmission(tin, centres, bin_width_keV=0.5)
    fine = transmission(tin, np.linspace(29.0, 29.5, 20001))
    assert means[1] == pytest.approx(fine.mean(), rel=0.03)
    assert means[1] > 3 * points[1]
    np.testing.assert_array_equal(means[[0, 2]], points[[0, 2]])


def test_edges_of_caesium_iodide_are_where_the_tables_say() -> None:
    # K edges 33.169 (I) and 35.985 keV (Cs), L3 edges 4.557 and 5.012 keV: X-ray Data Booklet, table 1-1
    edges = absorption_edges_keV(material_from_name("CsI"))
    for expected in (33.169, 35.985, 4.557, 5.012):
        assert np.min(np.abs(edges - expected)) < 0.005


@pytest.mark.parametrize("energy_keV", [0.5, 501.0, float("nan"), -3.0])
@pytest.mark.parametrize("table", TABLES)
def test_energies_outside_the_tables_are_refused(energy_keV: float, table: str) -> None:
    with pytest.raises(InputError, match=r"energy_keV: got .* keV; expected energies from 1 to 500 keV"):
        mu_per_mm(material_from_name("Al"), [20.0, energy_keV], table=table)


def test_an_unknown_table_is_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"table: got 'elam'; expected one of xraylib, chantler, penelope"):
        mu_per_mm(material_from_name("Al"), 20.0, table="elam")


@pytest.mark.parametrize("number", [6, 13, 29, 55, 74])
def test_chantlers_table_is_read_as_xraydb_reads_it(number: int) -> None:
    xraydb = pytest.importorskip("xraydb")
    energies = np.array([1.02, 5.0, 11.3, 36.0, 69.6, 160.0, 400.0])
    found = TABLES["chantler"](number, energies)
    np.testing.assert_allclose(found, xraydb.mu_chantler(number, 1000.0 * energies), rtol=1e-12)

"""The lab's beam, scintillator and sampling classes against closed forms and published constants."""

import ast
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, special

from raytwin.acquisition.setting import Filter, filters_from_text
from raytwin.errors import InputError
from raytwin.lab import LabSystem, aperture_share, compute_incidence, compute_level, sample_system
from raytwin.lab.attenuation import composition, mu_per_mm
from raytwin.lab.response import _escape_probability, compute_deposits, gain_DN, level_of_groups
from raytwin.lab.tube import beam

COPPER = filters_from_text("Cu:0.05")
MEAT_AND_BONE = ("chicken_breast", "rib_bone")


def test_the_lab_shares_no_physics_with_the_twin():
    room = Path(__file__).parents[1] / "lab"
    allowed = {"acquisition", "errors", "files"}
    for path in room.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.level == 2:
                assert (node.module or "").split(".")[0] in allowed, f"{path.name}: {node.module}"
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            module = getattr(node, "module", None) or ""
            assert not any(name.split(".")[0] in ("raytwin", "xraylib") for name in [*names, module]), path.name


@pytest.mark.parametrize("material", ["water", "chicken_breast", "rib_bone", "fat", "pmma", "CsI", "air", "Cu"])
def test_mass_fractions_add_up_to_one(material):
    fractions, density_g_cm3 = composition(material)
    assert sum(fractions.values()) == pytest.approx(1.0, abs=1e-12)
    assert density_g_cm3 > 0


def test_water_has_its_stoichiometric_mass_fractions():
    # 2 x 1.008 of 18.015 g/mol
    assert composition("water")[0]["H"] == pytest.approx(0.11190, abs=2e-5)


@pytest.mark.parametrize(
    ("material", "energy_keV", "mu_rho_cm2_g"),
    # NIST XCOM (Berger et al., NBSIR 87-3597), totals with coherent scattering. Tables differ by 1-4 %.
    [("water", 20.0, 0.8098), ("water", 60.0, 0.2059), ("Al", 30.0, 1.128), ("Cu", 40.0, 4.862), ("Cu", 80.0, 0.7630)],
)
def test_attenuation_agrees_with_xcom_within_the_tables_own_difference(material, energy_keV, mu_rho_cm2_g):
    density_g_cm3 = composition(material)[1]
    found = mu_per_mm(material, np.array([energy_keV]))[0] * 10 / density_g_cm3
    assert found == pytest.approx(mu_rho_cm2_g, rel=0.03)


def test_unknown_materials_and_energies_are_refused_in_one_line():
    with pytest.raises(InputError, match="material in the virtual lab: got 'unobtainium'; expected an element"):
        composition("unobtainium")
    with pytest.raises(InputError, match="a density with a formula; write Gd2O2S@DENSITY"):
        composition("Gd2O2S")
    with pytest.raises(InputError, match="density above 0"):
        composition("Gd2O2S@-1")
    with pytest.raises(InputError, match="1 to 400 keV"):
        mu_per_mm("water", np.array([500.0]))
    with pytest.raises(InputError, match="20 to 300 kV"):
        beam(kV=500.0, anode_angle_deg=12.0)


def test_filters_in_the_beam_multiply_in_any_order():
    layers = filters_from_text("Cu:0.05+Al:1")
    one = beam(kV=60.0, anode_angle_deg=12.0, filters=layers)
    other = beam(kV=60.0, anode_angle_deg=12.0, filters=layers[::-1])
    np.testing.assert_allclose(one.photons_per_mAs_mm2, other.photons_per_mAs_mm2, rtol=1e-12)
    assert one.energy_keV.max() < 60.0


def test_deposits_share_out_what_is_absorbed():
    energy_keV = np.arange(5.0, 120.0, 0.5)
    deposits = compute_deposits(energy_keV, scintillator_mm=0.5)
    absorbed = np.bincount(deposits.energy_index, deposits.probability)
    np.testing.assert_allclose(absorbed, -np.expm1(-mu_per_mm("CsI", energy_keV) * 0.5), rtol=1e-12)
    assert (deposits.probability >= 0).all() and (deposits.deposit_keV >= 0).all()
    mean_keV = np.bincount(deposits.energy_index, deposits.probability * deposits.deposit_keV) / absorbed
    below = energy_keV < 33.0
    np.testing.assert_allclose(mean_keV[below], energy_keV[below])
    assert (mean_keV[energy_keV > 34.0] < energy_keV[energy_keV > 34.0]).all()


@pytest.mark.parametrize("ratio", [0.3, 1.0, 4.0])
def test_escape_from_a_thick_slab_follows_the_closed_form(ratio):
    # Half-space: P = (1 - x ln(1 + 1/x)) / 2, x = mu_k / mu (int exp(-mu z) E2(mu_k z) dz).
    mu_in, mu_line = 3.0, 3.0 * ratio
    found = _escape_probability(np.array([mu_in]), mu_line, 60.0)[0]
    expected = 0.5 * (1.0 - ratio * np.log1p(1.0 / ratio))
    direct = integrate.quad(lambda z: mu_in * np.exp(-mu_in * z) * 0.5 * special.expn(2, mu_line * z), 0, 60)[0]
    assert direct == pytest.approx(expected, rel=1e-6)
    assert found == pytest.approx(expected, rel=1e-3)


def test_escape_from_a_thin_slab_is_certain():
    assert _escape_probability(np.array([1e-6]), 1e-6, 0.01)[0] == pytest.approx(1.0, abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    kV=st.sampled_from([40.0, 90.0]),
    seed=st.sampled_from([None, 1]),
    meat_mm=st.floats(0.0, 30.0),
    bone_mm=st.floats(0.0, 3.0),
)
def test_sampling_classes_keep_signal_and_variance_behind_any_product(kV, seed, meat_mm, bone_mm):
    system = LabSystem() if seed is None else sample_system(np.random.default_rng(seed))
    lengths_mm = {"chicken_breast": meat_mm, "rib_bone": bone_mm}
    grouped = level_of_groups(
        compute_incidence(system, kV=kV, filters=COPPER, materials=MEAT_AND_BONE), thickness_mm=lengths_mm
    )
    exact = compute_level(system, kV=kV, filters=COPPER, thickness_mm=lengths_mm)
    assert grouped.energy_keV_per_mAs == pytest.approx(exact.energy_keV_per_mAs, rel=1e-3)
    assert grouped.squared_keV2_per_mAs == pytest.approx(exact.squared_keV2_per_mAs, rel=3e-3)


def test_a_filter_in_the_beam_and_the_same_layer_as_object_mean_the_same():
    system = LabSystem()
    as_filter = compute_level(system, kV=40.0, filters=(*COPPER, Filter(material="water", thickness_mm=10.0)))
    as_object = compute_level(system, kV=40.0, filters=COPPER, thickness_mm={"water": 10.0})
    assert as_filter.energy_keV_per_mAs == pytest.approx(as_object.energy_keV_per_mAs, rel=1e-12)


def test_the_default_system_gives_the_levels_of_the_papers_line():
    # 23.0 DN/ms at 40 kV 40 W, 173.7 at 90 kV 45 W, photon-transfer slope 1.949 DN at 40 kV.
    system = LabSystem()
    per_keV = system.electrons_per_keV * system.DN_per_electron
    for kV, power_W, DN_per_ms in ((40.0, 40.0, 23.0), (90.0, 45.0, 173.7)):
        level = compute_level(system, kV=kV, filters=COPPER)
        assert level.energy_keV_per_mAs * per_keV * power_W / kV / 1000 == pytest.approx(DN_per_ms, rel=0.03)
    gain = gain_DN(system, compute_level(system, kV=40.0, filters=COPPER), DN_per_electron=system.DN_per_electron)
    assert gain * aperture_share(system.psf_sigma_px) ** 2 == pytest.approx(1.949, rel=0.03)


@pytest.mark.parametrize("kV", [40.0, 90.0])
def test_photons_per_pixel_do_not_depend_on_the_pitch(kV):
    coarse = LabSystem().at_size(rows=16, columns=16, pixel_mm=0.45)
    fine = LabSystem().at_size(rows=16, columns=16, pixel_mm=0.15)
    assert fine.source_detector_mm == pytest.approx(1059.0)
    a, b = (compute_level(system, kV=kV, filters=COPPER).photons_absorbed_per_mAs for system in (coarse, fine))
    assert a == pytest.approx(b, rel=1e-12)


@pytest.mark.parametrize("sigma", [0.0, 0.35, 0.8, 1.5])
@pytest.mark.parametrize("lag", [0, 1, 3])
def test_aperture_share_is_the_integral_it_stands_for(sigma, lag):
    def seen(x):
        if sigma == 0:
            return float(abs(x) < 0.5)
        return special.ndtr((x + 0.5) / sigma) - special.ndtr((x - 0.5) / sigma)

    corners = [-0.5, 0.5, -lag - 0.5, -lag + 0.5]
    expected = integrate.quad(lambda x: seen(x) * seen(x + lag), -12, 12, points=corners, limit=400)[0]
    assert aperture_share(sigma, lag) == pytest.approx(expected, abs=1e-9)


@given(sigma=st.floats(0.0, 2.0))
def test_blur_moves_variance_to_the_neighbours_and_loses_none(sigma):
    shares = [aperture_share(sigma, lag) for lag in range(-20, 21)]
    assert sum(shares) == pytest.approx(1.0, abs=1e-9)
    assert min(shares) > -1e-12


def test_systems_that_cannot_be_are_refused():
    for wrong in ({"psf_sigma_px": float("nan")}, {"read_noise_DN": -1.0}, {"light_swank": 1.5}, {"bits": 20}):
        with pytest.raises(InputError, match=f"lab system {next(iter(wrong))}"):
            LabSystem(**wrong)
    with pytest.raises(InputError, match="less than the source-detector distance"):
        LabSystem(source_object_mm=5000.0)
    with pytest.raises(InputError, match="100 to 100000 mm"):
        LabSystem().at_size(rows=16, columns=16, pixel_mm=0.1, source_detector_mm=1.0)

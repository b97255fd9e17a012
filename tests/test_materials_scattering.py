"""Directions of scattered photons: their integral, Klein and Nishina's law, and where coherent scattering goes."""

import numpy as np
import pytest
import xraylib

from raytwin.errors import InputError
from raytwin.materials import material_from_name, scattering_per_sr

WATER = material_from_name("water_liquid")
ANGLES = np.linspace(0.0, np.pi, 2001)


@pytest.mark.parametrize("energy_keV", [15.0, 45.0, 120.0])
@pytest.mark.parametrize("material", ["water_liquid", "Al", "bone_cortical"])
def test_all_directions_together_are_one(material, energy_keV):
    density = scattering_per_sr(material_from_name(material), energy_keV, ANGLES)
    assert 2.0 * np.pi * np.trapezoid(density * np.sin(ANGLES), ANGLES) == pytest.approx(1.0, rel=2e-3)


def test_at_500_keV_water_scatters_as_free_electrons_do():
    alpha = 500.0 / 510.99895
    kept = 1.0 / (1.0 + alpha * (1.0 - np.cos(ANGLES)))
    electrons = kept**2 * (kept + 1.0 / kept - np.sin(ANGLES) ** 2)
    electrons /= 2.0 * np.pi * np.trapezoid(electrons * np.sin(ANGLES), ANGLES)
    wide = np.radians(10.0) < ANGLES
    np.testing.assert_allclose(scattering_per_sr(WATER, 500.0, ANGLES)[wide], electrons[wide], rtol=0.02)


def test_coherent_scattering_goes_the_more_forward_the_harder_the_beam():
    soft, hard = (scattering_per_sr(WATER, energy_keV, np.radians([0.0, 5.0, 20.0])) for energy_keV in (25.0, 60.0))
    assert soft[0] > soft[1] > soft[2]
    assert hard[1] / hard[0] < 0.8 * soft[1] / soft[0]
    # the forward direction holds Z^2 Thomson cross sections of each atom, and no incoherent scattering
    per_g = 6.02214076e23 * 7.9407877e-26 * (2.0 * 0.1119 / 2.016 + 64.0 * 0.8881 / 15.999)
    total = xraylib.CS_Rayl_CP("H2O", 60.0) + xraylib.CS_Compt_CP("H2O", 60.0)
    assert hard[0] == pytest.approx(per_g / total, rel=0.02)


@pytest.mark.parametrize(("energy_keV", "angle"), [(0.5, 0.1), (50.0, -0.1), (50.0, 4.0)])
def test_energies_and_angles_without_meaning_are_refused(energy_keV, angle):
    with pytest.raises(InputError):
        scattering_per_sr(WATER, energy_keV, [angle])

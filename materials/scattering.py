"""Into which directions a material scatters photons."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .attenuation import MAXIMUM_ENERGY_KEV, MINIMUM_ENERGY_KEV
from .material import Material, atomic_number_from_symbol

FloatArray = NDArray[np.float64]

_ANGLES = np.linspace(0.0, np.pi, 721)
_KEPT = 512  # elements at an energy


def scattering_per_sr(material: Material, energy_keV: float, angle_rad: ArrayLike) -> FloatArray:
    """Share of scattered photons that goes into a direction, per sr: coherent and incoherent scattering together.

    (d sigma_R / d Omega + d sigma_C / d Omega) / (sigma_R + sigma_C), free atoms, mixture rule; integrates to 1 over all
    directions. Interference between molecules, which takes coherent scattering out of the first degrees, is left out.

    Args:
        material: what scatters.
        energy_keV: photon energy, 1 to 500 keV.
        angle_rad: between the directions before and after, 0 to pi, any shape.

    Returns:
        Array of the shape of `angle_rad`, 1/sr.

    Raises:
        InputError: an energy or angle outside its range.

    Source: xraylib's DCS_Rayl and DCS_Compt (form factors and incoherent functions of Cullen, Hubbell, Kissel, EPDL97),
    doi:10.1016/j.sab.2011.09.011.
    Checked against: Klein and Nishina (1929) at 500 keV and the integral over all directions (tests/test_materials_scattering.py).
    """
    if not MINIMUM_ENERGY_KEV <= energy_keV <= MAXIMUM_ENERGY_KEV:
        raise InputError(
            "energy_keV",
            received=f"{energy_keV:g} keV",
            expected=f"an energy from {MINIMUM_ENERGY_KEV:g} to {MAXIMUM_ENERGY_KEV:g} keV, where the tables are",
        )
    angles = np.asarray(angle_rad, dtype=np.float64)
    if not np.all((angles >= 0.0) & (angles <= np.pi)):
        raise InputError("angle_rad", received=f"{angles.min():g} to {angles.max():g}", expected="0 to pi")
    density = np.zeros(_ANGLES.shape)
    for symbol, fraction in material.mass_fractions.items():
        density += fraction * _of_element(atomic_number_from_symbol(symbol), float(energy_keV))
    whole = 2.0 * np.pi * np.trapezoid(density * np.sin(_ANGLES), _ANGLES)
    return np.asarray(np.interp(angles, _ANGLES, density / whole))


@lru_cache(maxsize=_KEPT)
def _of_element(number: int, energy_keV: float) -> FloatArray:
    """Differential cross section (angle,) of an element at an energy, cm2/g/sr."""
    import xraylib_np

    element, energy = np.array([number]), np.array([energy_keV])
    both = xraylib_np.DCS_Rayl(element, energy, _ANGLES) + xraylib_np.DCS_Compt(element, energy, _ANGLES)
    return np.asarray(both, dtype=np.float64).reshape(-1)

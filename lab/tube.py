"""The tube of the virtual lab: SpekPy's `kqp` model, behind the lab's own filters."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter
from ..errors import InputError
from .attenuation import mu_per_mm

Array = NDArray[np.float64]

BIN_KEV = 0.5
LOWEST_KEV = 3.0  # below, nothing passes even 0.1 mm of aluminium


@dataclass(frozen=True, slots=True, kw_only=True)
class Beam:
    """Photons that reach the object's plane, by energy.

    Fields: energy_keV (n,) bin centres; photons_per_mAs_mm2 (n,) photons per bin, per mAs and mm2, 1 m from the source.
    """

    energy_keV: Array
    photons_per_mAs_mm2: Array


@lru_cache(maxsize=256)
def _bare_spectrum(kV: float, anode_angle_deg: float) -> tuple[Array, Array]:
    import spekpy

    tube = spekpy.Spek(kvp=kV, th=anode_angle_deg, dk=BIN_KEV, physics="kqp", targ="W", mas=1.0, z=100.0)
    energy_keV, fluence_per_keV_cm2 = tube.get_spectrum(edges=False, flu=True, diff=True)
    keep = energy_keV >= LOWEST_KEV
    photons = np.array(fluence_per_keV_cm2[keep] * BIN_KEV / 100.0)
    energies = np.array(energy_keV[keep])
    energies.setflags(write=False)
    photons.setflags(write=False)
    return energies, photons


def beam(*, kV: float, anode_angle_deg: float, filters: Sequence[Filter] = ()) -> Beam:
    """The spectrum of the tube behind filters, in photons per 0.5 keV bin, mAs and mm2 at 1 m.

    N(E) = Phi(E) exp(-sum_f mu_f(E) t_f). No air: give it as a filter where it matters.

    Args:
        kV: peak voltage that the anode really sees, 20 to 300 kV.
        anode_angle_deg: 6 to 30 degrees.
        filters: layers, inherent ones included.

    Raises:
        InputError: a voltage or angle out of range, or an unknown material.

    Source: SpekPy v2, physics model `kqp` (Omar, Andreo and Poludniowski 2020, doi:10.1002/mp.14359).
    """
    if not 20.0 <= kV <= 300.0:
        raise InputError("kV of the virtual lab's tube", received=f"{kV:g} kV", expected="20 to 300 kV")
    if not 6.0 <= anode_angle_deg <= 30.0:
        raise InputError("anode_angle_deg", received=f"{anode_angle_deg:g}", expected="6 to 30 degrees")
    energy_keV, photons = _bare_spectrum(float(kV), float(anode_angle_deg))
    exponent = np.zeros_like(energy_keV)
    for layer in filters:
        exponent += mu_per_mm(layer.material, energy_keV) * layer.thickness_mm
    return Beam(energy_keV=energy_keV, photons_per_mAs_mm2=photons * np.exp(-exponent))

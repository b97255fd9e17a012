"""The tube of the virtual lab: one of several models of bremsstrahlung, behind the lab's own filters."""

import math
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


# Bremsstrahlung of SpekPy's models; `casim` is the twin's own, drawn so that a right tube is among the lab's.
MODELS = ("kqp", "casim", "sim", "uni", "diff", "classical")
_RIPPLE_NODES = (-math.sqrt(0.75), 0.0, math.sqrt(0.75))  # of a sine, by Chebyshev's rule


@lru_cache(maxsize=256)
def _bare_spectrum(kV: float, anode_angle_deg: float, model: str) -> tuple[Array, Array]:
    import spekpy

    tube = spekpy.Spek(kvp=kV, th=anode_angle_deg, dk=BIN_KEV, physics=model, targ="W", mas=1.0, z=100.0)
    energy_keV, fluence_per_keV_cm2 = tube.get_spectrum(edges=False, flu=True, diff=True)
    keep = energy_keV >= LOWEST_KEV
    photons = np.array(fluence_per_keV_cm2[keep] * BIN_KEV / 100.0)
    energies = np.array(energy_keV[keep])
    energies.setflags(write=False)
    photons.setflags(write=False)
    return energies, photons


@lru_cache(maxsize=256)
def _rippled_spectrum(kV: float, anode_angle_deg: float, model: str, ripple_percent: float) -> tuple[Array, Array]:
    """The mean of the spectra through one period of a voltage that dips by `ripple_percent`, on the peak voltage's bins."""
    energies, photons = _bare_spectrum(kV, anode_angle_deg, model)
    if ripple_percent == 0.0:
        return energies, photons
    total = np.zeros_like(photons)
    for node in _RIPPLE_NODES:
        lower = kV * (1.0 - ripple_percent / 200.0 * (1.0 - node))
        at, number = _bare_spectrum(lower, anode_angle_deg, model)
        # bins stand elsewhere: shift them by less than one, keeping the number of photons
        moved = np.interp(energies, at, number, left=0.0, right=0.0)
        total += moved * (number.sum() / moved.sum()) / len(_RIPPLE_NODES)
    return energies, total


def beam(
    *,
    kV: float,
    anode_angle_deg: float,
    filters: Sequence[Filter] = (),
    model: str = "kqp",
    ripple_percent: float = 0.0,
) -> Beam:
    """The spectrum of the tube behind filters, in photons per 0.5 keV bin, mAs and mm2 at 1 m.

    N(E) = Phi(E) exp(-sum_f mu_f(E) t_f). No air: give it as a filter where it matters.

    Args:
        kV: peak voltage that the anode really sees, 20 to 300 kV.
        anode_angle_deg: 6 to 30 degrees.
        filters: layers, inherent ones included.
        model: of `MODELS`.
        ripple_percent: by how much the voltage dips between its peaks (0 to 50), as a sine.

    Raises:
        InputError: a voltage or angle out of range, or an unknown material or model.

    Source: SpekPy v2, physics model `kqp` (Omar, Andreo and Poludniowski 2020, doi:10.1002/mp.14359); the others are
    those of Poludniowski et al. 2021, doi:10.1002/mp.14945, with other cross sections and angular laws.
    """
    if not 20.0 <= kV <= 300.0:
        raise InputError("kV of the virtual lab's tube", received=f"{kV:g} kV", expected="20 to 300 kV")
    if not 6.0 <= anode_angle_deg <= 30.0:
        raise InputError("anode_angle_deg", received=f"{anode_angle_deg:g}", expected="6 to 30 degrees")
    if model not in MODELS:
        raise InputError("tube model of the virtual lab", received=repr(model), expected="one of " + ", ".join(MODELS))
    if not 0.0 <= ripple_percent <= 50.0:
        raise InputError("ripple_percent", received=f"{ripple_percent:g}", expected="0 to 50 %")
    energy_keV, photons = _rippled_spectrum(float(kV), float(anode_angle_deg), model, float(ripple_percent))
    exponent = np.zeros_like(energy_keV)
    for layer in filters:
        exponent += mu_per_mm(layer.material, energy_keV) * layer.thickness_mm
    return Beam(energy_keV=energy_keV, photons_per_mAs_mm2=photons * np.exp(-exponent))

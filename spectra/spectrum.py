"""A photon spectrum on the common grid, and the numbers that describe it: mean energy, air kerma, half-value layers."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter
from ..errors import InputError
from ..materials import (
    Library,
    Material,
    mass_energy_absorption_cm2_g,
    material_from_name,
    mu_per_mm,
    transmission,
)
from .grid import BIN_WIDTH_KEV, energy_grid_keV

FloatArray = NDArray[np.float64]

# 1 keV/g in microgray: 1.602176634e-16 J/keV / 1e-3 kg/g = 1.602e-13 Gy
_UGY_PER_KEV_PER_G = 1.602176634e-7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spectrum:
    """A spectrum and where it comes from.

    Fields: energies_keV (n,), bin centres of the common grid (`energy_grid_keV`); fluence (n,), photons / keV / cm2 /
    mAs at 1 m in vacuum; bin_width_keV; kV, anode, anode_angle_deg, model (`casim`, `kqp`, or the file it was read
    from), model_version; filters that it has crossed, in order; absolute (False: the fluence has an arbitrary scale).
    """

    energies_keV: FloatArray = field(repr=False)
    fluence: FloatArray = field(repr=False)
    bin_width_keV: float = BIN_WIDTH_KEV
    kV: float | None = None
    anode: str | None = None
    anode_angle_deg: float | None = None
    model: str = ""
    model_version: str = ""
    filters: tuple[Filter, ...] = ()
    absolute: bool = True

    def __post_init__(self) -> None:
        energies = np.array(self.energies_keV, dtype=float)
        fluence = np.array(self.fluence, dtype=float)
        if energies.ndim != 1 or energies.shape != fluence.shape or energies.size == 0:
            raise InputError(
                "spectrum",
                received=f"{energies.shape} energies and {fluence.shape} fluences",
                expected="one fluence for each energy, at least one",
            )
        if not (np.all(np.isfinite(fluence)) and np.all(fluence >= 0)):
            raise InputError("fluence", received="a negative or infinite value, or NaN", expected="values of 0 or more")
        if not np.any(fluence > 0):
            raise InputError("fluence", received="zero everywhere", expected="some photons")
        energies.setflags(write=False)
        fluence.setflags(write=False)
        object.__setattr__(self, "energies_keV", energies)
        object.__setattr__(self, "fluence", fluence)


def filtered_spectrum(
    spectrum: Spectrum, filters: Sequence[Filter], *, table: str = "xraylib", library: Library | None = None
) -> Spectrum:
    """The spectrum behind more layers: fluence exp(-sum mu t).

    Taken at the bin centres; in a bin that an absorption edge of a layer cuts, the mean over the bin.

    Raises:
        InputError: an unknown material or table, or layers so thick that no photon is left.
    """
    passed = transmission(
        filters, spectrum.energies_keV, table=table, library=library, bin_width_keV=spectrum.bin_width_keV
    )
    behind = spectrum.fluence * passed
    # fewer than one photon in 1e30 is no beam, whatever floating point can still hold
    if not behind.sum() > 1e-30 * spectrum.fluence.sum():
        raise InputError(
            "filters", received="+".join(map(str, filters)), expected="layers that let some photons through"
        )
    return replace(spectrum, fluence=behind, filters=(*spectrum.filters, *filters))


def mean_energy_keV(spectrum: Spectrum) -> float:
    """Mean photon energy in keV: sum(E phi) / sum(phi)."""
    return float(spectrum.energies_keV @ spectrum.fluence / spectrum.fluence.sum())


def fluence_per_cm2_mAs(spectrum: Spectrum) -> float:
    """Photons per cm2 and mAs at 1 m, all energies: sum(phi) dE."""
    return float(spectrum.fluence.sum() * spectrum.bin_width_keV)


def _air_kerma_weights(energies_keV: FloatArray) -> FloatArray:
    whole = _air_kerma_weights_of_grid()
    if np.array_equal(energies_keV, energy_grid_keV()[: energies_keV.size]):
        return whole[: energies_keV.size]
    return energies_keV * mass_energy_absorption_cm2_g(material_from_name("air"), energies_keV)


@lru_cache(maxsize=1)
def _air_kerma_weights_of_grid() -> FloatArray:
    # once for every kV: this coefficient takes some tenths of a second to tabulate
    grid = energy_grid_keV()
    return grid * mass_energy_absorption_cm2_g(material_from_name("air"), grid)


def air_kerma_uGy_per_mAs(spectrum: Spectrum) -> float:
    """Air kerma in microgray per mAs at 1 m: sum(phi E mu_en/rho(air)) dE.

    Collision kerma; below 300 keV it differs from kerma by less than 0.2 %.

    Raises:
        InputError: the spectrum's scale is arbitrary (read from a file without a unit).
    """
    if not spectrum.absolute:
        raise InputError(
            "spectrum",
            received=f"a relative spectrum ({spectrum.model})",
            expected="photons / keV / cm2 / mAs at 1 m",
            remedy="air kerma needs an absolute spectrum",
        )
    weights = _air_kerma_weights(spectrum.energies_keV)
    return float(_UGY_PER_KEV_PER_G * spectrum.bin_width_keV * (weights @ spectrum.fluence))


def half_value_layer_mm(
    spectrum: Spectrum, material: Material, *, fraction: float = 0.5, table: str = "xraylib"
) -> float:
    """Thickness in mm that leaves `fraction` of the air kerma (0.5: the first half-value layer), narrow beam.

    Solves sum(k exp(-mu x)) = fraction sum(k), k = phi E mu_en/rho(air), by Newton's method on the logarithm, which is
    convex and falling and so converges from below.

    Args:
        spectrum: the beam.
        material: the absorber.
        fraction: between 0 and 1.
        table: attenuation table.

    Raises:
        InputError: a fraction outside 0 to 1.

    Checked against: the half-value layers of PTB's beam qualities, 3.5 % (tests/test_spectra_reference.py).
    """
    if not 0.0 < fraction < 1.0:
        raise InputError("fraction", received=fraction, expected="a fraction above 0 and below 1")
    mu = mu_per_mm(material, spectrum.energies_keV, table=table)
    weights = _air_kerma_weights(spectrum.energies_keV) * spectrum.fluence
    weights = weights / weights.sum()
    thickness_mm = 0.0
    for _ in range(200):
        left = weights * np.exp(-mu * thickness_mm)
        remaining = float(left.sum())
        step = float(np.log(remaining / fraction) * remaining / (left @ mu))
        thickness_mm += step
        if abs(step) <= 1e-12 * thickness_mm:
            break
    return thickness_mm

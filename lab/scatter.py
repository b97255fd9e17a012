"""Radiation that the object scatters, photon by photon: Compton and Rayleigh, up to four collisions, in the true geometry.

Histories start where primary photons enter the object, evenly spread. Their first collision is forced; at every collision a
random point of each of 8 x 8 parts of the detector hears what is sent there (density per sr x solid angle x way out
through the object), which is an unbiased estimate with far less noise than waiting for photons to arrive, and without
the patchiness that points anywhere leave. Only the field of the detector is irradiated.

Coherent scattering: Thomson's law times the squared form factor; incoherent: Klein and Nishina's, with the electrons
that are bound too tightly taken off as 1 - (F / Z)^2 (for free atoms; a rough form of the incoherent function). The
sum of both is scaled to Chantler's total less the photoelectric part.

Source: O. Klein and Y. Nishina, Z. Phys. 52 (1929) 853; form factors of D. Waasmaier and A. Kirfel, Acta Cryst. A51
(1995) 416, through xraydb; next-event estimator: M. H. Kalos, Nucl. Sci. Eng. 16 (1963) 111.
Checked against: the integral of single scatter over a slab (tests/test_lab_scatter.py).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .attenuation import composition, mu_per_mm
from .response import Incidence
from .system import LabSystem

Array = NDArray[np.float64]

LOWEST_KEV = 8.0
STEP_KEV = 2.0
# Even steps of sin(theta / 2), on which form factors vary smoothly: half a degree near forward.
HALF_SINES = np.linspace(0.0, 1.0, 257)
COSINES = 1.0 - 2.0 * HALF_SINES**2
GRID = 64
TALLY = 16
MODES = 7
POINTS = 8
ORDERS = 4
HISTORIES = 131_072
_R_E2_MM2 = 2.8179403262e-12**2
_HC_KEV_ANGSTROM = 12.398419843


@dataclass(frozen=True, slots=True, kw_only=True)
class Tables:
    """Scattering of a material on the energy grid.

    Fields: mu (energy,) total attenuation per mm; scattered (energy,) share of collisions that scatter; coherent
    (energy,) share of these; densities (energy, angle) per sr, integrating to 1; cumulated (energy, angle) from forward
    on; angles as in HALF_SINES.
    """

    mu: Array
    scattered: Array
    coherent: Array
    coherent_density: Array
    incoherent_density: Array
    coherent_cumulated: Array
    incoherent_cumulated: Array


@lru_cache(maxsize=32)
def scatter_tables(material: str, n_energies: int) -> Tables:
    """Tables of a material for energies LOWEST_KEV + i STEP_KEV."""
    import xraydb

    energy_keV = LOWEST_KEV + STEP_KEV * np.arange(n_energies, dtype=np.float64)
    fractions, density_g_cm3 = composition(material)
    ratio = energy_keV[:, None] / 510.99895
    kept = 1.0 / (1.0 + ratio * (1.0 - COSINES[None, :]))
    klein_nishina = 0.5 * _R_E2_MM2 * kept**2 * (kept + 1.0 / kept - 1.0 + COSINES[None, :] ** 2)
    thomson = 0.5 * _R_E2_MM2 * (1.0 + COSINES[None, :] ** 2)
    # sin(theta / 2) / lambda in 1 / Angstrom
    transfer = HALF_SINES[None, :] * energy_keV[:, None] / _HC_KEV_ANGSTROM
    coherent = np.zeros_like(transfer)
    incoherent = np.zeros_like(transfer)
    photoelectric = np.zeros_like(energy_keV)
    for element, fraction in fractions.items():
        number = xraydb.atomic_number(element)
        per_mass = fraction / xraydb.atomic_mass(element)
        factor = np.asarray(xraydb.f0(element, transfer.ravel())).reshape(transfer.shape)
        coherent += per_mass * thomson * factor**2
        incoherent += per_mass * klein_nishina * number * np.maximum(1.0 - (factor / number) ** 2, 0.0)
        photo = np.asarray(xraydb.mu_chantler(element, energy_keV * 1000.0, photo=True))
        photoelectric += fraction * photo * density_g_cm3 / 10.0
    mu = mu_per_mm(material, energy_keV)

    def normalised(density: Array) -> tuple[Array, Array, Array]:
        # d(cos theta) = -4 s ds
        rate = density * (8.0 * math.pi * HALF_SINES)
        steps = 0.5 * (rate[:, 1:] + rate[:, :-1]) * np.diff(HALF_SINES)
        total = steps.sum(axis=1)
        cumulated = np.concatenate([np.zeros((total.size, 1)), np.cumsum(steps, axis=1)], axis=1) / total[:, None]
        return density / total[:, None], cumulated, total

    coherent_density, coherent_cumulated, coherent_total = normalised(coherent)
    incoherent_density, incoherent_cumulated, incoherent_total = normalised(incoherent)
    return Tables(
        mu=mu,
        scattered=np.clip(1.0 - photoelectric / mu, 0.0, 1.0),
        coherent=coherent_total / (coherent_total + incoherent_total),
        coherent_density=coherent_density,
        incoherent_density=incoherent_density,
        coherent_cumulated=coherent_cumulated,
        incoherent_cumulated=incoherent_cumulated,
    )


def block_means(fine: NDArray[np.float32], cells: int) -> Array:
    """Means of a fine map over `cells` x `cells` blocks of about equal size."""
    result: Array = np.asarray(fine, dtype=np.float64)
    for axis in (0, 1):
        edges = np.linspace(0, result.shape[axis], cells + 1).astype(np.intp)
        result = np.add.reduceat(result, edges[:-1], axis=axis) / np.diff(edges).reshape(
            (-1, 1) if axis == 0 else (1, -1)
        )
    return result


def scattered_photons(
    system: LabSystem,
    incidence: Incidence,
    thickness_mm: Mapping[str, NDArray[np.float32]],
    *,
    rng: np.random.Generator,
    histories: int = HISTORIES,
    orders: int = ORDERS,
) -> Array:
    """Scattered photons that reach the cells of the detector, per pixel and mAs.

    Args:
        system: geometry; the object stands at `source_object_mm`.
        incidence: the beam without object.
        thickness_mm: material -> path length (mm) over the field of the detector, margins cut off.
        rng: draws the histories.
        histories: photons that are started.
        orders: collisions that are followed.

    Returns:
        (2, TALLY, TALLY, energy): scattered once, and more often.
    """
    from ._scatter_loops import _STREAMS, follow_photons

    n_energies = int((incidence.group_keV.max() - LOWEST_KEV) / STEP_KEV) + 2
    names = [name for name, fine in thickness_mm.items() if float(fine.max()) > 0]
    if not names:
        return np.zeros((2, TALLY, TALLY, n_energies))
    blocks = np.stack([block_means(thickness_mm[name], GRID).ravel() for name in names], axis=1)
    height = blocks.sum(axis=1)
    share = blocks / np.maximum(height, 1e-12)[:, None]
    tables = [scatter_tables(name, n_energies) for name in names]

    def stacked(field: str) -> Array:
        return np.ascontiguousarray(np.stack([getattr(table, field) for table in tables]))

    photons = incidence.photons_per_mAs
    cumulated = np.concatenate([[0.0], np.cumsum(photons)]) / photons.sum()
    # `_pick` gives the place before; its number plus one names the group.
    energy_of = np.clip(np.rint((incidence.group_keV - LOWEST_KEV) / STEP_KEV), 0, n_energies - 1).astype(np.int64)
    energy_of = np.concatenate([energy_of[:1], energy_of])
    scale = system.pixel_mm / system.magnification
    field_mm = (system.rows * scale, system.columns * scale)
    tally = np.zeros((_STREAMS, 2, TALLY * TALLY, n_energies))
    started = histories // _STREAMS * _STREAMS
    follow_photons(
        started,
        np.uint64(rng.integers(0, 2**63)),
        height,
        share,
        field_mm,
        (GRID, GRID),
        system.source_object_mm,
        system.source_detector_mm - system.source_object_mm,
        (system.rows * system.pixel_mm, system.columns * system.pixel_mm),
        (TALLY, TALLY),
        cumulated,
        energy_of,
        LOWEST_KEV,
        STEP_KEV,
        stacked("mu"),
        stacked("scattered"),
        stacked("coherent"),
        HALF_SINES.size,
        stacked("coherent_cumulated"),
        stacked("coherent_density"),
        stacked("incoherent_cumulated"),
        stacked("incoherent_density"),
        POINTS,
        orders,
        tally,
    )
    pixels_per_cell = system.rows * system.columns / TALLY**2
    # Every history stands for so many primary photons of the whole field.
    per_history = photons.sum() * system.rows * system.columns / started
    total: Array = tally.sum(axis=0).reshape(2, TALLY, TALLY, n_energies) * (per_history / pixels_per_cell)
    return total


def smooth_map(cells: Array, shape: tuple[int, int]) -> Array:
    """A map (row, column) of low polynomials through a few cells; scattered radiation has no sharp features.

    Polynomials, not waves: scatter falls towards the borders, and a sum of cosines would be flat there and ripple inside.
    """
    rows, columns = cells.shape

    def powers(count: int, places: int) -> Array:
        x = (np.arange(places) + 0.5) / places * 2.0 - 1.0
        result: Array = np.asarray(np.polynomial.legendre.legvander(x, min(MODES, count) - 1), dtype=np.float64)
        return result

    up = powers(rows, shape[0]) @ np.linalg.pinv(powers(rows, rows))
    across = powers(columns, shape[1]) @ np.linalg.pinv(powers(columns, columns))
    result: Array = np.maximum(up @ cells @ across.T, 0.0)
    return result


def class_rates(incidence: Incidence, spectrum: Array) -> Array:
    """Photons absorbed by deposit class (class,) of photons that arrive with a spectrum on the scatter's energy grid."""
    energy_keV = LOWEST_KEV + STEP_KEV * np.arange(spectrum.size)
    nearest = np.abs(energy_keV[:, None] - incidence.group_keV[None, :]).argmin(axis=1)
    result: Array = spectrum @ incidence.class_share[nearest]
    return result

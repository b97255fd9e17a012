"""X-ray tubes: SpekPy's spectra at whole kV, each computed once, and a smooth function of kV between them."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..acquisition.setting import Filter
from ..errors import InputError
from ..materials import Library
from ._cache import keep, read_kept
from .grid import BIN_WIDTH_KEV, FIRST_CENTRE_KEV, MAXIMUM_KV, energy_grid_keV
from .spectrum import Spectrum, filtered_spectrum

FloatArray = NDArray[np.float64]

MODELS = ("casim", "kqp")
MINIMUM_KV = 10.0
# SpekPy's physics tables: tungsten further than the 300 kV used here, the other anodes to 50 kV
MAXIMUM_KV_OF_ANODE = {"W": MAXIMUM_KV, "Mo": 50.0, "Rh": 50.0, "Ag": 50.0, "Cr": 50.0, "Cu": 50.0, "Au": 50.0}
MINIMUM_ANGLE_DEG = 1.0
MAXIMUM_ANGLE_DEG = 60.0

DEFAULT_ANODE = "W"
DEFAULT_ANGLE_DEG = 12.0
DEFAULT_MODEL = "casim"

# Line yields rise as (kV / edge - 1) to about this power, so their root is nearly straight in kV.
_YIELD_POWER = 1.65
# Bremsstrahlung falls to zero at the end point as about this power of (kV - E).
_TIP_POWER = 0.9
# Bins below the first share of the kV are interpolated at fixed energy, above the second at fixed energy / kV.
_FIXED_ENERGY_BELOW = 0.8
_FIXED_SHARE_ABOVE = 0.9


def tube_spectrum(
    *,
    kV: float,
    filters: Sequence[Filter] = (),
    anode: str = DEFAULT_ANODE,
    anode_angle_deg: float = DEFAULT_ANGLE_DEG,
    model: str = DEFAULT_MODEL,
    energies_keV: ArrayLike | None = None,
    table: str = "xraylib",
    library: Library | None = None,
) -> Spectrum:
    """Spectrum of a reflection tube behind filters: photons / keV / cm2 / mAs at 1 m in vacuum.

    phi(E) = phi_SpekPy(E; kV, anode, angle, model) exp(-sum_i mu_i(E) t_i). SpekPy's own model holds the anode's
    self-absorption and nothing else: a window is a filter, air is a filter. A whole kV is SpekPy's answer; between them
    see `tube_fluence_interpolated`. SpekPy is checked by its authors from 20 to 300 kV.

    Args:
        kV: peak tube voltage, 10 to 300 (anodes other than W: to 50).
        filters: layers in the beam, by name and thickness in mm.
        anode: W, Mo, Rh, Ag, Cr, Cu or Au.
        anode_angle_deg: 1 to 60 degrees.
        model: SpekPy's physics, `casim` or `kqp` (always named: SpekPy's `default` is its oldest model).
        energies_keV: a longer piece of the common grid to fill with zeros above the kV; None: up to the kV.
        table: attenuation table of the filters.
        library: where the filters' names are looked up.

    Returns:
        Spectrum on the common grid.

    Raises:
        InputError: an argument outside its range, an unknown anode, model or material.

    Source: Omar, Andreo, Poludniowski (2020), doi:10.1002/mp.14359, doi:10.1002/mp.14360;
        Poludniowski et al. (2021), doi:10.1002/mp.14945 (SpekPy v2).
    Checked against: half-value layers of PTB's beam qualities to 150 kV, 3.5 % (tests/test_spectra_reference.py).
    """
    top_keV = float(_checked_kV(kV, anode))
    grid = energy_grid_keV(top_keV) if energies_keV is None else _common_grid(energies_keV, top_keV)
    fluence = tube_fluence_interpolated(
        kV, energies_keV=grid, anode=anode, anode_angle_deg=anode_angle_deg, model=model
    )
    bare = Spectrum(
        energies_keV=grid,
        fluence=fluence,
        kV=float(kV),
        anode=anode,
        anode_angle_deg=float(anode_angle_deg),
        model=model,
        model_version=f"spekpy {_spekpy_version()}",
    )
    return filtered_spectrum(bare, filters, table=table, library=library) if filters else bare


def tube_fluence_interpolated(
    kV: float,
    *,
    energies_keV: FloatArray,
    anode: str = DEFAULT_ANODE,
    anode_angle_deg: float = DEFAULT_ANGLE_DEG,
    model: str = DEFAULT_MODEL,
) -> FloatArray:
    """Fluence of an unfiltered tube at any kV, photons / keV / cm2 / mAs at 1 m, smooth in kV.

    Cubic convolution (Keys) in kV between SpekPy's spectra at whole kV, so value and slope in kV are continuous.
    Bremsstrahlung is interpolated at fixed E below 0.8 kV (edges of the anode stay where they are), at fixed E / kV
    above 0.9 kV (the end point moves with kV), blended between; the bin that the end point lies in is filled by share.
    Lines are interpolated at fixed E in the power of their yield. Exact at whole kV.

    Args:
        kV: 10 to 300 (anodes other than W: to 50).
        energies_keV: (n,) a piece of the common grid from its beginning; bins above the kV are 0.
        anode, anode_angle_deg, model: as in `tube_spectrum`.

    Returns:
        (n,) fluence. The first call at a kV computes up to four spectra (about a second); afterwards it takes about
        0.25 ms.

    Raises:
        InputError: an argument outside its range.

    Checked against: SpekPy called at the kV itself with a fine grid; signals in 0.5 mm CsI behind 0.5 mm Al or more
        agree within 0.1 % from 40 to 150 kV, most within 0.02 % (tests/test_spectra_tube.py). The rest is mostly that
        of half-keV bins at the end point: 0.3 % at 20 kV behind 2.5 mm Al, more where less of the beam is left.
    """
    kV = _checked_kV(kV, anode)
    tube = (anode, _checked_angle(anode_angle_deg), _checked_model(model))
    energies = np.asarray(energies_keV, dtype=float)
    last_keV = FIRST_CENTRE_KEV + BIN_WIDTH_KEV * (energies.size - 1)
    if (
        energies.ndim != 1
        or not energies.size
        or abs(energies[0] - FIRST_CENTRE_KEV) + abs(energies[-1] - last_keV) > 1e-6
    ):
        raise _not_the_grid(energies, "a piece of the common grid 1.25, 1.75, ... keV from its beginning")
    below = int(np.floor(kV + 1e-9))
    share = max(kV - below, 0.0)
    if share < 1e-9:
        whole, lines = _tube_node(*tube, below)
        return _filled(whole + lines, energies.size)
    weights = {node: weight for node, weight in _cubic_weights(below, share, anode).items() if weight != 0.0}
    nodes = sorted(weights)
    grid = energy_grid_keV(kV)
    bins = grid.size
    relative = grid / kV
    tip = int((relative > _FIXED_ENERGY_BELOW).argmax())
    fixed_energy = np.zeros(bins)
    fixed_share = np.zeros(bins)
    roots = np.zeros((len(nodes), bins))
    end = 0.0
    for row, node in enumerate(nodes):
        bremsstrahlung, _ = _tube_node(*tube, node)
        used = min(bins, bremsstrahlung.size)
        fixed_energy[:used] += weights[node] * bremsstrahlung[:used]
        roots[row, :used] = _line_roots(*tube, node)[:used]
        centres = energy_grid_keV(float(node))
        straightened = np.interp(relative[tip:] * node, centres, _straightened(*tube, node))
        height = weights[node] * (node / kV) ** _TIP_POWER * straightened
        fixed_share[tip:] += height * np.clip(kV - grid[tip:], 0.0, None) ** _TIP_POWER
        end += float(height[-1])
    # the bin that holds the end point: its centre's value when it is full, falling with the share that the beam fills
    covered = (kV - (grid[-1] - 0.5 * BIN_WIDTH_KEV)) / BIN_WIDTH_KEV
    fixed_share[-1] = end * (0.5 * BIN_WIDTH_KEV) ** _TIP_POWER * covered ** (_TIP_POWER + 1.0)
    blend = np.clip((relative - _FIXED_ENERGY_BELOW) / (_FIXED_SHARE_ABOVE - _FIXED_ENERGY_BELOW), 0.0, 1.0)
    blend = blend * blend * (3.0 - 2.0 * blend)
    # below the edge there is no yield: its root goes on straight there, so that the curve starts at the edge itself
    for row in range(len(nodes) - 3, -1, -1):
        silent = (roots[row] == 0.0) & (roots[row + 1] != 0.0)
        roots[row, silent] = 2.0 * roots[row + 1, silent] - roots[row + 2, silent]
    yields = np.clip(np.array([weights[node] for node in nodes]) @ roots, 0.0, None) ** _YIELD_POWER
    fluence = (1.0 - blend) * fixed_energy + blend * fixed_share + yields
    return _filled(np.clip(fluence, 0.0, None), energies.size)


def _filled(values: FloatArray, size: int) -> FloatArray:
    filled = np.zeros(size)
    used = min(size, values.size)
    filled[:used] = values[:used]
    return filled


def _cubic_weights(below: int, share: float, anode: str) -> dict[int, float]:
    """Keys' cubic convolution over the four whole kV around; beyond the table's ends by quadratic continuation."""
    t = share
    weights = {
        below - 1: 0.5 * (-t + 2 * t * t - t**3),
        below: 0.5 * (2 - 5 * t * t + 3 * t**3),
        below + 1: 0.5 * (t + 4 * t * t - 3 * t**3),
        below + 2: 0.5 * (-t * t + t**3),
    }
    lowest, highest = int(MINIMUM_KV), int(MAXIMUM_KV_OF_ANODE[anode])
    for node, inward in ((below - 1, 1), (below + 2, -1)):
        if not lowest <= node <= highest:
            outside = weights.pop(node)
            for step, factor in ((1, 3.0), (2, -3.0), (3, 1.0)):
                inside = node + inward * step
                weights[inside] = weights.get(inside, 0.0) + factor * outside
    return weights


@lru_cache(maxsize=2048)
def _tube_node(anode: str, anode_angle_deg: float, model: str, kV: int) -> FloatArray:
    """Bremsstrahlung and lines (2, n) at a whole kV on the common grid up to it, from the cache or SpekPy."""
    bins = energy_grid_keV(float(kV)).size
    key: dict[str, object] = {
        "anode": anode,
        "anode_angle_deg": anode_angle_deg,
        "model": model,
        "kV": kV,
        "spekpy": _spekpy_version(),
        "grid": f"{bins} bins of {BIN_WIDTH_KEV} keV from 1 keV",
    }
    name = f"tube_{anode}_{anode_angle_deg:g}deg_{model}_{kV}kV_spekpy{_spekpy_version()}.npz"
    kept = read_kept(name, key, size=bins)
    if kept is None:
        kept = _spekpy_fluence(anode, anode_angle_deg, model, kV)
        keep(name, key, kept)
    kept.setflags(write=False)
    return kept


@lru_cache(maxsize=2048)
def _line_roots(anode: str, anode_angle_deg: float, model: str, kV: int) -> FloatArray:
    return np.asarray(_tube_node(anode, anode_angle_deg, model, kV)[1] ** (1.0 / _YIELD_POWER), dtype=float)


@lru_cache(maxsize=2048)
def _straightened(anode: str, anode_angle_deg: float, model: str, kV: int) -> FloatArray:
    bremsstrahlung = _tube_node(anode, anode_angle_deg, model, kV)[0]
    return np.asarray(bremsstrahlung / (kV - energy_grid_keV(float(kV))) ** _TIP_POWER, dtype=float)


def _spekpy_fluence(anode: str, anode_angle_deg: float, model: str, kV: int) -> FloatArray:
    import spekpy

    tube = spekpy.Spek(
        kvp=float(kV), th=anode_angle_deg, dk=BIN_WIDTH_KEV, physics=model, targ=anode, x=0, y=0, z=100, mas=1
    )
    energies, bremsstrahlung = tube.get_spectrum(char=False)
    _, lines = tube.get_spectrum(brem=False)
    grid = energy_grid_keV(float(kV))
    if len(energies) != grid.size or not np.allclose(energies, grid, atol=1e-6):
        raise RuntimeError(f"SpekPy answered on a grid of its own at {kV} kV: {energies[0]} ... {energies[-1]} keV")
    return np.clip(np.asarray([bremsstrahlung, lines], dtype=np.float64), 0.0, None)


@lru_cache(maxsize=1)
def _spekpy_version() -> str:
    from importlib.metadata import version

    return version("spekpy")


def _checked_kV(kV: float, anode: str) -> float:
    if anode not in MAXIMUM_KV_OF_ANODE:
        raise InputError("anode", received=repr(anode), expected=f"one of {', '.join(MAXIMUM_KV_OF_ANODE)}")
    highest = MAXIMUM_KV_OF_ANODE[anode]
    if not MINIMUM_KV <= kV <= highest:
        raise InputError(
            "kV", received=f"{kV} kV", expected=f"{MINIMUM_KV:g} to {highest:g} kV, where the {anode} spectra are known"
        )
    return float(kV)


def _checked_angle(anode_angle_deg: float) -> float:
    if not MINIMUM_ANGLE_DEG <= anode_angle_deg <= MAXIMUM_ANGLE_DEG:
        raise InputError(
            "anode angle",
            received=f"{anode_angle_deg} degrees",
            expected=f"{MINIMUM_ANGLE_DEG:g} to {MAXIMUM_ANGLE_DEG:g} degrees",
        )
    return round(float(anode_angle_deg), 4)


def _checked_model(model: str) -> str:
    if model not in MODELS:
        raise InputError("model", received=repr(model), expected=f"one of SpekPy's {', '.join(MODELS)}")
    return model


def _common_grid(energies_keV: ArrayLike, top_keV: float) -> FloatArray:
    energies = np.asarray(energies_keV, dtype=float)
    needed = energy_grid_keV(top_keV).size
    whole = energy_grid_keV(500.0)
    fits = energies.ndim == 1 and needed <= energies.size <= whole.size
    if not (fits and np.allclose(energies, whole[: energies.size], rtol=0.0, atol=1e-6)):
        raise _not_the_grid(energies, f"the common grid 1.25, 1.75, ... keV up to {top_keV:g} keV or further")
    return energies


def _not_the_grid(energies: FloatArray, expected: str) -> InputError:
    return InputError(
        "energies_keV",
        received=f"an array of shape {energies.shape}",
        expected=expected,
        remedy="use energy_grid_keV(maximum_keV)",
    )

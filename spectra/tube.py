"""X-ray tubes: SpekPy's spectra at whole kV, packaged or computed once, and a smooth function of kV between them."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..acquisition.setting import Filter
from ..errors import InputError, check_number
from ..materials import Library
from ._cache import keep, read_kept
from ._packaged import packaged_fluence, packaged_lines, packaged_version
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
# Lines are looked for with bins this wide; a bin's lines are then known to lie at one energy.
_LINE_BIN_KEV = 0.02
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
    top_keV = float(checked_kV(kV, anode=anode))
    grid = energy_grid_keV(top_keV) if energies_keV is None else _common_grid(energies_keV, top_keV)
    fluence = tube_fluence_interpolated(
        kV, energies_keV=grid, anode=anode, anode_angle_deg=anode_angle_deg, model=model
    )
    bare_angle = _checked_angle(anode_angle_deg)
    bare = Spectrum(
        energies_keV=grid,
        fluence=fluence,
        kV=float(kV),
        anode=anode,
        anode_angle_deg=float(anode_angle_deg),
        model=model,
        model_version=f"spekpy {_version_of(anode, bare_angle, model)}",
    )
    return filtered_spectrum(bare, filters, table=table, library=library) if filters else bare


def tube_fluence_interpolated(
    kV: float,
    *,
    energies_keV: FloatArray,
    anode: str = DEFAULT_ANODE,
    anode_angle_deg: float = DEFAULT_ANGLE_DEG,
    model: str = DEFAULT_MODEL,
    for_sums: bool = False,
) -> FloatArray:
    """Fluence of an unfiltered tube at any kV, photons / keV / cm2 / mAs at 1 m, smooth in kV.

    Cubic convolution (Keys) in kV between SpekPy's spectra at whole kV, so value and slope in kV are continuous.
    Bremsstrahlung is interpolated at fixed E below 0.8 kV (edges of the anode stay where they are), at fixed E / kV
    above 0.9 kV (the end point moves with kV), blended between; the bin that the end point lies in is filled by share.
    Lines are interpolated at fixed E in the power of their yield. At whole kV it is SpekPy's answer for these bins.

    `for_sums` gives the fluence that makes sum(phi f) dE, with a smooth f at the bins' centres, the integral of phi f: the
    bremsstrahlung's first two moments about each bin's centre are shared with the bins beside it (f taken as a parabola
    through three centres; the fall to the end point as (kV - E)^0.9 exactly), and lines, which are not at the centres,
    are shared between the two bins about their energy. Photons and mean energy are kept; a bin's height is no longer the
    spectrum's there.

    Args:
        kV: 10 to 300 (anodes other than W: to 50).
        energies_keV: (n,) a piece of the common grid from its beginning; bins above the kV are 0.
        anode, anode_angle_deg, model: as in `tube_spectrum`.
        for_sums: weights of a sum over energy rather than heights of the spectrum.

    Returns:
        (n,) fluence, in about 0.3 ms. Spectra of the default tube come with the package at every whole kV, but for last bits
        those of SpekPy; for another anode or angle SpekPy computes up to four at the first call (0.4 to 10 s each),
        which are kept on disk.

    Raises:
        InputError: an argument outside its range.

    Checked against: SpekPy called at the kV itself with a fine grid; see tests/test_spectra_tube.py for the bounds. Below
        30 kV copper without aluminium passes the tube's L lines below its edge at 9 keV, where its transmission changes
        up to threefold within a bin: sums are 0.5 % off behind 0.05 mm at 20 kV, 7 % behind 0.2 mm, a third behind 0.5 mm.
    """
    kV = checked_kV(kV, anode=anode)
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
        if for_sums:
            whole = _moments_shared(whole, float(below))
            lines = _lines_shared(lines, *tube)
        return _filled(np.clip(whole + lines, 0.0, None), energies.size)
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
    straight_end = end
    covered = (kV - (grid[-1] - 0.5 * BIN_WIDTH_KEV)) / BIN_WIDTH_KEV
    fixed_share[-1] = end * (0.5 * BIN_WIDTH_KEV) ** _TIP_POWER * covered ** (_TIP_POWER + 1.0)
    blend = np.clip((relative - _FIXED_ENERGY_BELOW) / (_FIXED_SHARE_ABOVE - _FIXED_ENERGY_BELOW), 0.0, 1.0)
    blend = blend * blend * (3.0 - 2.0 * blend)
    # below the edge there is no yield: its root goes on straight there, so that the curve starts at the edge itself
    for row in range(len(nodes) - 3, -1, -1):
        silent = (roots[row] == 0.0) & (roots[row + 1] != 0.0)
        roots[row, silent] = 2.0 * roots[row + 1, silent] - roots[row + 2, silent]
    yields = np.clip(np.array([weights[node] for node in nodes]) @ roots, 0.0, None) ** _YIELD_POWER
    bremsstrahlung = np.clip((1.0 - blend) * fixed_energy + blend * fixed_share, 0.0, None)
    if for_sums:
        bremsstrahlung = _moments_shared(bremsstrahlung, kV, end=straight_end)
        yields = _lines_shared(yields, *tube)
    return _filled(np.clip(bremsstrahlung + yields, 0.0, None), energies.size)


def _moments_shared(sampled: FloatArray, kV: float, *, end: float | None = None) -> FloatArray:
    """Bremsstrahlung (bin,) sampled at the centres -> weights of a sum over the bins; see `tube_fluence_interpolated`.

    In each bin phi = s (kV - E)^0.9 with s linear; `end` is s in the last bin where its centre lies beyond the kV.
    """
    centres = energy_grid_keV(kV)
    width = BIN_WIDTH_KEV
    before_end = kV - centres
    straight = sampled / np.where(before_end > 0, before_end, 1.0) ** _TIP_POWER
    if end is not None:
        straight[-1] = end
    slope = np.gradient(straight, -width)  # with u = kV - E
    slope[-1] = slope[-2]
    nearest = np.clip(before_end - 0.5 * width, 0.0, None)
    furthest = np.clip(before_end + 0.5 * width, 0.0, None)
    power = _TIP_POWER + 1.0
    near, far = nearest**power, furthest**power
    integrals = []  # of u^(0.9 + n) over the bin
    for n in range(4):
        integrals.append((far - near) / (power + n))
        near, far = near * nearest, far * furthest
    level = straight - slope * before_end
    zeroth, first, second = (level * integrals[n] + slope * integrals[n + 1] for n in range(3))
    # about the centre: E - centre = before_end - u
    mean = (before_end * zeroth - first) / width
    square = (before_end**2 * zeroth - 2.0 * before_end * first + second) / width**2
    mean[0] = square[0] = 0.0
    weights = zeroth - square
    weights[1:] += 0.5 * (mean + square)[:-1]
    weights[:-1] += 0.5 * (square - mean)[1:]
    # nothing lies above the last bin: its parabola goes through the three centres up to its own
    weights[-1] += square[-1] + 1.5 * mean[-1] + 0.5 * square[-1]
    weights[-2] -= 0.5 * (square - mean)[-1] + 2.0 * mean[-1] + square[-1]
    weights[-3] += 0.5 * (mean + square)[-1]
    return np.asarray(weights / width)


def _lines_shared(lines: FloatArray, anode: str, anode_angle_deg: float, model: str) -> FloatArray:
    """Lines (bin,) shared between the two bins about their energy, so that their mean energy is kept."""
    away = _line_offsets(anode, anode_angle_deg, model)[: lines.size]
    up, down = np.clip(away, 0.0, None) * lines, np.clip(-away, 0.0, None) * lines
    up[-1] = down[0] = 0.0
    shared = lines - up - down
    shared[1:] += up[:-1]
    shared[:-1] += down[1:]
    return shared


@lru_cache(maxsize=64)
def _line_offsets(anode: str, anode_angle_deg: float, model: str) -> FloatArray:
    """Where in its bin of the common grid the lines lie, in bins from the centre (bin,); 0 without lines.

    The lines' shares within a bin hardly change with kV; those at a kV above all edges are taken.
    """
    places = packaged_lines(anode, anode_angle_deg, model)
    if places is None:
        places = kept_line_places(anode, anode_angle_deg, model)
    return np.asarray((places[1] - energy_grid_keV(MAXIMUM_KV)) / BIN_WIDTH_KEV)


def kept_line_places(anode: str, anode_angle_deg: float, model: str) -> FloatArray:
    """Height and mean energy (keV) of the lines in each bin of the whole grid (2, n), from the cache or SpekPy."""
    kV = int(min(100.0, MAXIMUM_KV_OF_ANODE[anode]))
    grid = energy_grid_keV(MAXIMUM_KV)
    key: dict[str, object] = {
        "anode": anode,
        "anode_angle_deg": anode_angle_deg,
        "model": model,
        "kV": kV,
        "spekpy": spekpy_version(),
        "lines": f"{grid.size} bins of {BIN_WIDTH_KEV} keV from 1 keV, lines to {_LINE_BIN_KEV} keV",
    }
    name = f"lines_{anode}_{anode_angle_deg:g}deg_{model}_spekpy{spekpy_version()}.npz"
    kept = read_kept(name, key, size=grid.size)
    if kept is None:
        import spekpy

        fine = spekpy.Spek(
            kvp=float(kV), th=anode_angle_deg, dk=_LINE_BIN_KEV, physics=model, targ=anode, x=0, y=0, z=100, mas=1
        )
        energies, heights = fine.get_spectrum(brem=False)
        place = np.floor((energies - 1.0) / BIN_WIDTH_KEV + 1e-9).astype(int)
        total = np.bincount(place, weights=heights, minlength=grid.size)
        energy = np.bincount(place, weights=heights * energies, minlength=grid.size)
        kept = np.array([total, np.divide(energy, total, out=grid.copy(), where=total > 0)])
        keep(name, key, kept)
    return kept


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
    """Bremsstrahlung and lines (2, n) at a whole kV on the common grid up to it: packaged, from the cache or SpekPy's."""
    found = packaged_fluence(anode, anode_angle_deg, model, kV)
    if found is None:
        found = kept_tube_fluence(anode, anode_angle_deg, model, kV)
    found.setflags(write=False)
    return found


def kept_tube_fluence(anode: str, anode_angle_deg: float, model: str, kV: int) -> FloatArray:
    """Bremsstrahlung and lines (2, n) at a whole kV on the common grid up to it, from the cache or SpekPy."""
    bins = energy_grid_keV(float(kV)).size
    key: dict[str, object] = {
        "anode": anode,
        "anode_angle_deg": anode_angle_deg,
        "model": model,
        "kV": kV,
        "spekpy": spekpy_version(),
        "grid": f"{bins} bins of {BIN_WIDTH_KEV} keV from 1 keV",
    }
    name = f"tube_{anode}_{anode_angle_deg:g}deg_{model}_{kV}kV_spekpy{spekpy_version()}.npz"
    kept = read_kept(name, key, size=bins)
    if kept is None:
        kept = _spekpy_fluence(anode, anode_angle_deg, model, kV)
        keep(name, key, kept)
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
def spekpy_version() -> str:
    """Version of the SpekPy that is installed."""
    from importlib.metadata import version

    return version("spekpy")


def _version_of(anode: str, anode_angle_deg: float, model: str) -> str:
    """SpekPy's version that the spectra of a tube are of: of the packaged ones where it is among them."""
    packaged = packaged_version() if packaged_lines(anode, anode_angle_deg, model) is not None else None
    return packaged or spekpy_version()


def checked_anode(anode: str) -> str:
    """The anode's element, if spectra are known of it.

    Raises:
        InputError: another one.
    """
    if anode not in MAXIMUM_KV_OF_ANODE:
        raise InputError("anode", received=repr(anode), expected=f"one of {', '.join(MAXIMUM_KV_OF_ANODE)}")
    return anode


def checked_kV(kV: float, *, anode: str) -> float:
    """The tube voltage, kV, if the spectra of an anode are known there.

    Raises:
        InputError: an unknown anode, or a voltage outside its range.
    """
    highest = MAXIMUM_KV_OF_ANODE[checked_anode(anode)]
    check_number("kV", kV, unit="kV")
    if not MINIMUM_KV <= kV <= highest:
        raise InputError(
            "kV",
            received=f"{kV:g} kV",
            expected=f"{MINIMUM_KV:g} to {highest:g} kV, where the {anode} spectra are known",
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

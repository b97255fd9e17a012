"""Tables over photon energy that a spectral model takes its sums from.

What tubes send, filters pass and scintillators keep at each energy, at nodes of voltage, thickness and threshold, with the
interpolation between the nodes. Tables are computed when they are first asked for, and kept.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import HIGHEST_THRESHOLD_KEV
from ...acquisition.setting import Filter
from ...materials import material_from_name, mu_per_mm
from ...spectra import (
    MINIMUM_KV,
    MODELS,
    counted_fraction,
    detector_response,
    energy_grid_keV,
    light_per_keV,
    tube_fluence_interpolated,
)

REFERENCE_KEV = 50.0
OTHER_TABLES = ("chantler", "penelope")
# thresholds of counters (node,), keV, between which the counted share is linear
THRESHOLDS_KEV: NDArray[np.float64] = np.linspace(0.0, HIGHEST_THRESHOLD_KEV, 161)
# tube voltages (node,), kV, between which the fluence is linear, half a per cent apart at most: 1e-4 of a signal at 40 kV
# (behind 0.3 mm of copper 8e-4), a tenth of that from 90 kV on
NODES_KV: NDArray[np.float64] = np.concatenate(
    [0.05 * np.arange(200, 600), 0.1 * np.arange(300, 600), 0.25 * np.arange(240, 1201)]
)
LOG_THICKNESS = np.linspace(-1.6, 1.6, 33)  # nodes of the scintillator thickness
# below, layers that nobody stated count as here: nothing passes a window, and no layer may let through more
_LOWEST_KEV = 5.0
_LARGEST_DEPARTURE = 0.1  # between attenuation tables; more is an edge at another place
_LARGEST_MODEL_RATIO = 0.15  # logarithm of one spectrum model over the other; more is the last bin at the end point


def fluence_at_nodes(
    nodes: NDArray[np.intp],
    top: int,
    *,
    anode: str,
    anode_angle_deg: float,
    model: str,
    energies_keV: NDArray[np.float64],
) -> NDArray[np.float64]:
    """A tube's unfiltered fluence (node, energy), photons / keV / cm2 / mAs at 1 m.

    Args:
        nodes: (node,) places in `NODES_KV`.
        top: on how many of the first energies.
        anode, anode_angle_deg, model: as of `spectra.tube_fluence_interpolated`.
        energies_keV: the first energies of the common grid.
    """
    kept = _kept_fluence(anode, anode_angle_deg, model, energies_keV.size)
    for node in nodes:
        if np.isnan(kept[node, 0]):
            kept[node] = tube_fluence_interpolated(
                float(NODES_KV[node]),
                energies_keV=energies_keV,
                anode=anode,
                anode_angle_deg=anode_angle_deg,
                model=model,
                for_sums=True,
            )
    return np.asarray(kept[nodes, :top])


@lru_cache(maxsize=16)
def _kept_fluence(anode: str, anode_angle_deg: float, model: str, bins: int) -> NDArray[np.float64]:
    """A tube's fluence at `NODES_KV` (node, energy) on the first bins of the grid; NaN where nobody has computed it yet."""
    return np.full((NODES_KV.size, bins), np.nan)


def log_ratio_of_models(
    kV: float, *, anode: str, anode_angle_deg: float, model: str, energies_keV: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Logarithm of the other of SpekPy's models over this one (energy,), held constant beyond the end point."""
    ratio = np.zeros(energies_keV.size)
    if kV >= MINIMUM_KV:
        both = [
            tube_fluence_interpolated(
                kV, energies_keV=energies_keV, anode=anode, anode_angle_deg=anode_angle_deg, model=name
            )
            for name in (model, next(name for name in MODELS if name != model))
        ]
        seen = (both[0] > 1e-9 * both[0].max()) & (both[1] > 0)
        if np.any(seen):
            ratio[seen] = np.log(both[1][seen] / both[0][seen])
            last = int(np.flatnonzero(seen)[-1])
            ratio[last + 1 :] = ratio[last]
    return np.clip(ratio, -_LARGEST_MODEL_RATIO, _LARGEST_MODEL_RATIO)


def table_departure(material: str, table: str, energies_keV: NDArray[np.float64]) -> NDArray[np.float64]:
    """Another table's attenuation over xraylib's, less 1 (energy,)."""
    known = material_from_name(material)
    ratio = mu_per_mm(known, energies_keV, table=table) / mu_per_mm(known, energies_keV)
    # the tables' edges lie a few eV apart: a bin between them says nothing of the tables
    return np.clip(ratio - 1.0, -_LARGEST_DEPARTURE, _LARGEST_DEPARTURE)


def levelled(values: NDArray[np.float64], energies_keV: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (energy,) with those below the lowest energy that matters replaced by the value there."""
    first = min(int(np.searchsorted(energies_keV, _LOWEST_KEV)), len(values) - 1)
    return np.concatenate([np.full(first, values[first]), values[first:]])


@lru_cache(maxsize=16)
def response_rows(layer: Filter, bins: int) -> dict[str, NDArray[np.float64]]:
    """What a unit of each response parameter adds to the logarithms at each energy (energy,), for a scintillator's first layer.

    The depth slope is the loss of light from the diode's side of the layer to the other, as a share: row <z> / L - 1 / 2,
    with z the depth at which photons of an energy are stopped.
    """
    energies = energy_grid_keV(500.0)[:bins]
    absorber = mu_per_mm(material_from_name(layer.material), energies)
    depth = np.maximum(absorber * layer.thickness_mm, 1e-6)
    logarithm = np.log(energies / REFERENCE_KEV)
    rows = {
        "cover_mm_C": -levelled(mu_per_mm(material_from_name("C"), energies), energies),
        "cover_mm_Al": -levelled(mu_per_mm(material_from_name("Al"), energies), energies),
        "dead_layer_um": -1e-3 * levelled(absorber, energies),
        "light_nonproportionality": light_per_keV(layer.material, energies),
        "light_exponent": logarithm,
        "light_depth_slope": 1.0 / depth - 1.0 / np.expm1(np.minimum(depth, 500.0)) - 0.5,
        "swank_exponent": logarithm,
    }
    for row in rows.values():
        row.setflags(write=False)
    return rows


@lru_cache(maxsize=16)
def response_tables(
    scintillator: tuple[Filter, ...], cover: tuple[Filter, ...], counting: bool, bins: int
) -> NDArray[np.float64]:
    """What a photon leaves in a scintillator (quantity, node of thickness, energy), on the first bins of the grid.

    Quantities: mean deposit, mean square deposit, interacting share; what the other attenuation tables add to the first
    two; what full escape of K photons takes from the first two.
    """
    energies = energy_grid_keV(500.0)[:bins]

    def tables(escape: bool) -> NDArray[np.float64]:
        rows = []
        for log_scale in LOG_THICKNESS:
            layers = tuple(
                Filter(material=layer.material, thickness_mm=layer.thickness_mm * float(np.exp(log_scale)))
                for layer in scintillator
            )
            found = detector_response(
                scintillator=layers, cover=cover, counting=counting, energies_keV=energies, escape=escape
            )
            rows.append((found.mean_deposited_keV, found.mean_square_deposited_keV2, found.interacting_fraction))
        return np.array(rows).transpose(1, 0, 2)

    escaping, kept = tables(True), tables(False)
    departure = np.mean([table_departure(scintillator[0].material, name, energies) for name in OTHER_TABLES], axis=0)
    # a larger coefficient at one energy is a thicker layer at that energy
    by_table = np.gradient(escaping[:2], LOG_THICKNESS, axis=1) * departure
    result = np.concatenate([escaping, by_table, escaping[:2] - kept[:2]])
    result.setflags(write=False)
    return np.asarray(result)


@lru_cache(maxsize=16)
def counted_tables(layer: Filter, bins: int) -> NDArray[np.float64]:
    """Counts of a photon that interacts in a counter's layer (2, 2, node of threshold, energy).

    Along the first axis: of charge that one pixel has, and that two pixels share; along the second: all K photons that a slab
    lets out leave, and none does.
    """
    energies = energy_grid_keV(500.0)[:bins]
    tables = [
        [
            counted_fraction(
                energies_keV=energies, threshold_keV=THRESHOLDS_KEV, layer=layer, escape=escape, shared=shared
            )
            for escape in (True, False)
        ]
        for shared in (False, True)
    ]
    return np.array(tables)


def brackets(nodes: NDArray[np.float64], at: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Where positions `at` (draw,) lie among nodes: the node below each, and the share of the way to the next."""
    clipped = np.clip(at, nodes[0], nodes[-1])
    below = np.clip(np.searchsorted(nodes, clipped, side="right") - 1, 0, len(nodes) - 2)
    share = (clipped - nodes[below]) / (nodes[below + 1] - nodes[below])
    return below, share


def interpolate(nodes: NDArray[np.float64], table: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows of `table` (node, energy) at positions `at` (draw,), linear between nodes."""
    below, share = brackets(nodes, at)
    lowest, highest = int(below.min()), int(below.max()) + 2
    if len(at) < 2 * (highest - lowest):
        return np.asarray(table[below] * (1.0 - share)[:, None] + table[below + 1] * share[:, None])
    weights = np.zeros((len(at), highest - lowest))
    rows = np.arange(len(at))
    weights[rows, below - lowest] = 1.0 - share
    weights[rows, below - lowest + 1] = share
    return np.asarray(weights @ table[lowest:highest])

"""Cells of the frequency plane, and the power of electronic noise and of slow changes in them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .noise_power import NoisePower, mode_share, usable

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Cells of frequencies: bins are single up to six and wider by a fifth from there.

    The power of a spread hardly changes inside a cell, and the fit has a tenth of the numbers.

    Fields: bins (bin,): places of those in use in a flattened power; cell (bin,): which each is in; weight (bin,): its share of
    the cell's modes; share (cell,): of the modes in use.
    """

    bins: NDArray[np.intp]
    cell: NDArray[np.intp]
    weight: FloatArray
    share: FloatArray

    def means(self, power: FloatArray) -> FloatArray:
        """Means over cells (cell,) of a power (K + 1, K + 1)."""
        return np.asarray(np.bincount(self.cell, self.weight * power.ravel()[self.bins]), dtype=np.float64)


@lru_cache(maxsize=16)
def cells_of(side: int) -> Cells:
    """Those of squares of a side, px."""
    order = np.arange(side // 2 + 1)
    wider = 6 + np.floor(np.log(np.maximum(order, 6) / 6.0) / math.log(1.2) + 1e-9)
    line = np.where(order <= 6, order, wider).astype(np.intp)
    bins = np.flatnonzero(usable(side))
    _, cell = np.unique((line[:, None] * (line[-1] + 1) + line[None, :]).ravel()[bins], return_inverse=True)
    modes = mode_share(side).ravel()[bins]
    together = np.bincount(cell, modes)
    return Cells(bins, cell, modes / together[cell], together / together.sum())


@lru_cache(maxsize=16)
def slow_shapes(side: int) -> FloatArray:
    """f_0 / f and its square (2, K + 1, K + 1), 1 at the lowest frequency in full use: spectra of most slow processes lie between."""
    order = np.arange(side // 2 + 1)
    square = (order[:, None] ** 2 + order[None, :] ** 2).astype(np.float64)
    square[0, 0] = 1.0
    return np.stack([np.sqrt(8.0 / square), 8.0 / square])


@lru_cache(maxsize=16)
def slow_in_cells(side: int) -> FloatArray:
    """The power of slow changes (cell, change)."""
    return np.stack([cells_of(side).means(power) for power in slow_shapes(side)], axis=1)


def electronic_shape(darks: Sequence[NoisePower], side: int) -> FloatArray:
    """Power of electronic noise over its mean (K + 1, K + 1), as repeated darks show it; 1 without any.

    White, but for the frequencies whose power no white noise has: interference from power supplies and clocks stands in narrow
    lines. There the darks' own power is taken.

    Source: a bin of M modes is gamma distributed, its cube root nearly Gaussian (Wilson and Hilferty, PNAS 17 (1931) 684);
    of n Gaussian numbers none exceeds sqrt(2 ln n) standard deviations but by chance (Donoho and Johnstone, Biometrika 81
    (1994) 425).
    """
    shape = np.ones((side // 2 + 1, side // 2 + 1))
    used = usable(side)
    medians = [(item, float(np.median(item.power_DN2[used]))) for item in darks]
    alive = [(item, median) for item, median in medians if median > 0]  # darks of zeros have no shape
    if not alive:
        return shape
    modes = np.sum([item.modes[used] for item, _ in alive], axis=0)
    power = np.sum([item.modes[used] * item.power_DN2[used] / median for item, median in alive], axis=0) / modes
    root_variance = 1.0 / (9.0 * modes)
    departure = (np.cbrt(power) - (1.0 - root_variance)) / np.sqrt(root_variance)
    lines = np.abs(departure) > math.sqrt(2.0 * math.log(power.size))
    shape[used] = np.where(lines, power, 1.0)
    return shape / float(np.average(shape[used], weights=mode_share(side)[used]))


def most_of_power(measured: FloatArray, modes: FloatArray, cells: int) -> FloatArray:
    """What a power is at most of which this was measured (cell,), with chance for all of so many `cells`.

    Source: Wilson and Hilferty, as in `electronic_shape`, and Donoho and Johnstone.
    """
    farthest = math.sqrt(2.0 * math.log(max(cells, 2)))
    root = 1.0 - 1.0 / (9.0 * modes) - farthest / (3.0 * np.sqrt(modes))
    return np.where(root > 0, measured / np.maximum(root, 1e-3) ** 3, math.inf)

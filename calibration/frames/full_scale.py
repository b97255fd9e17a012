"""Whether a series reaches the end of its ADC's range."""

import math

import numpy as np
from numpy.typing import NDArray

from ._kept_sums import KeptSums

_FULL_SCALES = tuple(float(2**bits - 1) for bits in (8, 10, 12, 14, 16))


def full_scale_reached(total: KeptSums, bits: int | None) -> float | None:
    """The full scale (DN) if more than 0.1 % of a series' values stand at it, else None; bits None: unknown."""
    full = float(2**bits - 1) if bits else None
    share = total.maximum_count / (total.frames * total.pixels)
    scales = (full,) if full is not None else _FULL_SCALES
    if total.maximum_DN in scales and share > 1e-3:
        return total.maximum_DN
    constant = total.pairs > 0 and float(np.median(total.pair_variance_DN2)) == 0.0
    return total.maximum_DN if share > 0.5 and constant else None


def top_of_range(total: KeptSums, bits: int | None) -> float:
    """Full scale that a series may reach, DN."""
    return float(2**bits - 1) if bits else max(_next_full_scale(total.maximum_DN), total.maximum_DN)


def _next_full_scale(value: float) -> float:
    """The smallest usual full scale at or above a value, DN."""
    return next((scale for scale in _FULL_SCALES if scale >= value), math.inf)


def reaches(total: KeptSums, top_DN: float, mask: NDArray[np.bool_] | None = None) -> bool:
    """Whether the noise of a series reaches a full scale."""
    chosen = slice(None) if mask is None else mask
    spread = math.sqrt(max(float(np.median(total.pair_variance_DN2[chosen])), 0.0))
    return float(np.median(total.mean_DN[chosen])) + 4 * spread > top_DN

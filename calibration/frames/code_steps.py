"""The distance of an ADC's codes, from the numbers that frames hold."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

FALSE_ALARM = 1e-6  # of one test of one series: hundreds of series are tested at once
_MANY = 1e-3  # share of the changes that one of a size is: pixels that were corrected may show sizes of their own


def code_step(values: NDArray[Any]) -> float | None:
    """The step (DN) of whole numbers that all lie a common multiple apart; None where it is 1, or values are not whole.

    Args:
        values: any shape, DN.
    """
    # floats beyond 2^53 are whole whatever they stand for
    if values.dtype.kind == "f" and not bool(np.all((values == np.rint(values)) & (np.abs(values) < 2.0**53))):
        return None
    codes = np.unique(values).astype(np.int64)
    if codes.size < 3:
        return None
    step = int(np.gcd.reduce(np.diff(codes)))
    # with k codes seen, all of them multiples of s by chance: s^-(k - 1)
    return float(step) if step > 1 and (codes.size - 1) * math.log(step) > -math.log(FALSE_ALARM) else None


def least_change(frames: NDArray[Any]) -> float:
    """The smallest change from frame to frame that many pixels show, DN: the distance of codes where noise is coarser; 1 at least.

    Codes that a factor has set apart lie no common multiple apart (60.1 DN: 60 or 61), and `code_step` does not find them.

    Args:
        frames: (frame, row, column), DN, of one setting.
    """
    if frames.dtype.kind == "f" and not bool(np.all(frames == np.rint(frames))):
        return 1.0  # means of exposures, or no numbers
    changes = np.abs(np.diff(frames.astype(np.float64), axis=0))
    sizes, counts = np.unique(changes[changes > 0.0], return_counts=True)
    often = sizes[counts >= _MANY * counts.sum()]
    return max(1.0, float(often[0])) if often.size else 1.0

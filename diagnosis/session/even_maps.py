"""Maps that are the same everywhere stand as (1, 1), which is quicker to add and to project; to that form, to full size, means.

And what a map does around each of its pixels: its range there, and where it has a step.
"""

import numpy as np
from numpy.typing import NDArray

from ...generator.frames.line_model import ExpectedSeries
from ..arrays import BoolArray, FloatArray, RealArray

NEIGHBOURS_PX = 5  # side of the square that a pixel's neighbours are in
_STEP_SHARE = 0.12  # of the brighter side, among neighbours: more is a step

Map = NDArray[np.float32]
NOWHERE: Map = np.zeros((1, 1), np.float32)
NOWHERE.setflags(write=False)


def compact(image: RealArray, scale: float) -> Map:
    """The map as float32, or (1, 1) where it is the same everywhere to 1e-7 of `scale`."""
    first = float(image.flat[0])
    if float(np.max(image)) - float(np.min(image)) <= 1e-7 * max(scale, 1e-12):
        return np.full((1, 1), first, np.float32)
    return np.asarray(image, dtype=np.float32)


def full_size(image: RealArray, shape: tuple[int, ...]) -> FloatArray:
    """The map (row, column), to be read only."""
    return np.broadcast_to(np.asarray(image, dtype=np.float64), shape)


def signal_map(expected: ExpectedSeries, shape: tuple[int, ...]) -> FloatArray:
    """Expected signal (row, column), DN, to be read only."""
    return full_size(expected.signal_DN, shape)


def mean_over(image: RealArray, mask: BoolArray) -> float:
    """Mean of a map over the pixels of a mask (row, column)."""
    return float(np.mean(full_size(image, mask.shape)[mask]))


def local_range(signal_DN: RealArray, reach: int = 1) -> FloatArray:
    """Largest less least signal (row, column) within `reach` pixels of each, DN."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * reach + 1
    return np.asarray(maximum_filter(signal_DN, size) - minimum_filter(signal_DN, size), dtype=np.float64)


def near_steps(signal: RealArray) -> BoolArray:
    """Pixels with a step of a signal (row, column) among their neighbours."""
    from scipy.ndimage import maximum_filter, minimum_filter

    highest, lowest = maximum_filter(signal, NEIGHBOURS_PX), minimum_filter(signal, NEIGHBOURS_PX)
    steps: BoolArray = (highest - lowest) > _STEP_SHARE * np.maximum(highest, 1e-9)
    return steps

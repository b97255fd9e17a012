"""How far the noise of rounded numbers is from a Gaussian's: where steps are coarse, few pixels jump and the others stand still."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..session.summaries import PIECE_FRAMES, kurtosis_excess

_COARSEST, _FINEST = 0.04, 0.7  # noise in steps: below, hardly a pixel jumps; above, rounding leaves a Gaussian


def rounded_kurtosis(sd_steps: float, frames: int) -> float:
    """Excess kurtosis that `summarise_series` finds in frames of rounded Gaussian noise, each pixel's mean anywhere between codes.

    sd_steps: standard deviation of a frame before rounding, in steps; frames: of the series. Error: 0.1 of the value,
    0.15 where more than 64 frames are looked at in pieces of unlike length.
    """
    if not 0.0 < sd_steps < _FINEST or frames < 3:
        return 0.0
    nodes, values = _table(min(frames, PIECE_FRAMES))
    return float(np.interp(math.log(max(sd_steps, _COARSEST)), nodes, values))


@lru_cache(maxsize=16)
def _table(frames: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Logarithms of the noise in steps, and the excess kurtosis there; an integral over a Latin hypercube.

    Its own lines: `scipy.stats` has such points, and takes a third of a second to import.
    """
    from scipy.special import ndtri

    points = 8192
    mean = (np.arange(points) + 0.5) / points
    noise = np.random.default_rng(0).permuted(np.tile(ndtri(mean), (frames, 1)), axis=1)
    nodes = np.geomspace(_COARSEST, _FINEST, 25)
    values = np.zeros(nodes.size)
    for number, sd in enumerate(nodes):
        steps = np.diff(np.rint(mean + sd * noise), axis=0) ** 2
        inside = steps / np.maximum(steps.mean(axis=0), 1e-12)
        values[number] = kurtosis_excess(float(np.sum(inside**2)), float(inside.size), frames - 1)
    values[-1] = 0.0  # a Gaussian at the fine end
    return np.log(nodes), values

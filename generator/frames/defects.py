"""Where the defects are that calibration has not seen: drawn from the effect's own seed, so that every frame has the same."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..line.line_state import FixedPattern, FloatArray, LineState


def gain_pattern(pattern: FixedPattern, shape: tuple[int, int]) -> FloatArray:
    """Factor (row, column) of a fixed pattern of the gain, mean 1."""
    rng = np.random.default_rng([0x6A17, pattern.seed])
    return 1.0 + pattern.rms * rng.standard_normal(shape)


@dataclass(frozen=True, slots=True)
class BadPixels:
    """New bad pixels, maps (row, column): dead ones read nothing of the light, hot ones more than their share."""

    dead: NDArray[np.bool_]
    hot: NDArray[np.bool_]


def new_bad_pixels(state: LineState, shape: tuple[int, int]) -> BadPixels | None:
    """Dead and hot ones, a third of all in clusters of 2 x 2 and short lines."""
    if state.bad_share <= 0:
        return None
    rng = np.random.default_rng([0xBAD, state.bad_seed])
    wanted = rng.binomial(shape[0] * shape[1], min(state.bad_share, 1.0))
    dead = np.zeros(shape, dtype=bool)
    hot = np.zeros(shape, dtype=bool)
    while int(np.count_nonzero(dead | hot)) < wanted:
        left = wanted - int(np.count_nonzero(dead | hot))
        row, column = int(rng.integers(shape[0])), int(rng.integers(shape[1]))
        kind = rng.random()
        height, width = (2, 2) if kind < 1 / 12 and left >= 4 else (1, 8) if kind < 0.125 and left >= 8 else (1, 1)
        target = dead if rng.random() >= state.bad_hot_share else hot
        target[row : row + height, column : column + width] = True
    return BadPixels(dead=dead, hot=hot & ~dead)

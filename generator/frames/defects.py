"""Defects that calibration has not seen, drawn from the effect's own seed, so that every frame has the same; noise of lines."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..line.line_state import (
    FixedPattern,
    FloatArray,
    LineFlicker,
    LineState,
    TelegraphPixels,
    TilePattern,
    between_lines,
)


def gain_pattern(pattern: FixedPattern, shape: tuple[int, int]) -> FloatArray:
    """Factor (row, column) of a fixed pattern of the gain, mean 1."""
    rng = np.random.default_rng([0x6A17, pattern.seed])
    if pattern.of_columns:
        return np.broadcast_to(1.0 + pattern.rms * rng.standard_normal(shape[1]), shape)
    if pattern.correlation_px <= 0.0:
        return 1.0 + pattern.rms * rng.standard_normal(shape)
    from scipy.ndimage import gaussian_filter

    # white noise through a Gaussian of width s is alike over sqrt(2) s, and 1 / (4 pi s^2) of its variance is left
    width, beyond = pattern.correlation_px / math.sqrt(2.0), math.ceil(4.0 * pattern.correlation_px)
    drawn = rng.standard_normal([length + 2 * beyond for length in shape])
    kernel = np.zeros((4 * beyond + 1, 4 * beyond + 1))
    kernel[2 * beyond, 2 * beyond] = 1.0
    left = float(np.sum(gaussian_filter(kernel, width) ** 2))
    smooth = gaussian_filter(drawn, width)[beyond:-beyond, beyond:-beyond]
    return np.asarray(1.0 + pattern.rms / math.sqrt(left) * smooth)


def tile_gain(pattern: TilePattern, shape: tuple[int, int]) -> FloatArray:
    """Factor (row, column) of the gains of tiles, mean 1 over the panel: what all share is its level."""
    rng = np.random.default_rng([0x711E, pattern.seed])
    rows, columns = pattern.rows.tile_of(shape[0]), pattern.columns.tile_of(shape[1])
    drawn = rng.standard_normal((rows[-1] + 1, columns[-1] + 1))[rows][:, columns]
    return np.asarray(1.0 + pattern.rms * (drawn - drawn.mean()))


def sample_flicker(flicker: LineFlicker, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """Factor (row, column) of the lines of one exposure."""
    shares = flicker.rms**2 * (1.0 - flicker.column_share), flicker.rms**2 * flicker.column_share
    return 1.0 + _lines(shares, flicker.together_lines, shape, rng)


def sample_offsets(state: LineState, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """Noise (row, column or 1, 1), DN, common to rows and columns of one exposure."""
    return _lines((state.row_variance_DN2, state.column_variance_DN2), state.offsets_together_lines, shape, rng)


def _lines(
    variances: tuple[float, float], together_lines: float, shape: tuple[int, int], rng: np.random.Generator
) -> FloatArray:
    """Sum (row, column or 1, 1) of what is common to each row and to each column, of these variances."""
    from scipy.signal import lfilter

    total = np.zeros((1, 1))
    next_to = between_lines(1, together_lines)
    for axis, variance in enumerate(variances):
        if variance > 0.0:
            drawn = math.sqrt(1.0 - next_to**2) * rng.standard_normal(shape[axis])
            drawn[0] /= math.sqrt(1.0 - next_to**2)
            lines = math.sqrt(variance) * lfilter([1.0], [1.0, -next_to], drawn)
            total = total + np.expand_dims(lines, 1 - axis)
    return np.asarray(total)


class Jumping:
    """Pixels that jump, from exposure to exposure of a series: where they are follows from the effect's seed."""

    def __init__(self, pixels: TelegraphPixels, shape: tuple[int, int], rng: np.random.Generator) -> None:
        where = np.random.default_rng([0x7E1E, pixels.seed])
        self._where = where.random(shape) < pixels.share
        count = int(np.count_nonzero(self._where))
        self._height_reads, self._stay = pixels.of_pixels(count, where)
        self._up = rng.random(count) < 0.5

    def added_to(self, value: FloatArray, read_DN: FloatArray | float, rng: np.random.Generator) -> FloatArray:
        """One exposure (row, column), DN, with their levels added; they may have jumped when the next one asks."""
        out = np.array(value, dtype=np.float64)
        height = self._height_reads * np.broadcast_to(read_DN, out.shape)[self._where]
        out[self._where] += np.where(self._up, height, 0.0)
        self._up = self._up ^ (rng.random(self._up.size) < 1.0 / self._stay)
        return out


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

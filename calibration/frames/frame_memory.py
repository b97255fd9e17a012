"""Noise that frames share with those before them: an image lag, a recursive filter.

What a frame takes over from the one before lowers the difference of the two, and with it the gain that differences give. Of n frames

    D_k = half the mean square difference of frames k apart = v (1 - rho_k)

for noise of variance v and correlation rho_k. Over many frames the noise of their mean has v (1 + 2 sum over k of rho_k) a frame:
the quanta's, and the gain belongs to it. Frames are compared by x00 - x01 - x10 + x11 of neighbouring pixels, brought to one level,
so that neither flicker nor a moving shape nor lines count.

Source: variance of a mean of correlated numbers: Box, Jenkins, Time Series Analysis (1976), 2.1.5.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import Series
from ._kept_sums import KeptSums
from .dark_frames import DarkFrames
from .frame_checks import repeats_the_last
from .frame_sums import PIECE_BYTES

_LEAST_FRAMES = 6  # half of the lags show what noise is once nothing is shared
_MOST_FRAMES = 48
_SIDE_PX = 256  # around the middle: more pixels add nothing to what frames share
_TILES = 4  # along each side of that, whose scatter is the sampling noise
_BEYOND_CHANCE = 4.07  # standard errors: 1 in 1000 of Student's t, as 16 tiles tell the error

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMemory:
    """Correlation of noise with that of the next frame (`next_frame`), and variance of many frames over that of pairs (`ratio`)."""

    next_frame: float
    ratio: float


def frame_memory(
    flats: Sequence[tuple[Series, KeptSums]], darks: DarkFrames, good: NDArray[np.bool_]
) -> FrameMemory | None:
    """What frames of flats share with those before them; None where it is not beyond chance, or no series has frames enough.

    Args:
        flats: series of single exposures, with their sums.
        darks: dark frames.
        good: pixels in use (row, column).
    """
    found = [
        _differences(item, total, darks.of(item), good)
        for item, total in flats
        if total.frames >= _LEAST_FRAMES and item.averaged == 1
    ]
    # series of fewer frames reach less far
    lags = min((len(one[0]) for one in found if len(one)), default=0) // 2
    rows = [_correlations(one, lags) for one in found if len(one) and lags]
    tiles = np.concatenate(rows) if rows else np.zeros((0, 1))
    if len(tiles) < 2:
        return None
    correlation, error = tiles.mean(axis=0), tiles.std(axis=0, ddof=1) / math.sqrt(len(tiles))
    if abs(correlation[0]) < _BEYOND_CHANCE * error[0]:
        return None
    # lags at which nothing is seen bring noise alone
    seen = np.abs(correlation) > 2.0 * error
    last = lags if seen.all() else int(np.argmin(seen))
    total = 1.0 + 2.0 * float(correlation[:last].sum())
    return FrameMemory(next_frame=float(correlation[0]), ratio=total / (1.0 - float(correlation[0])))


def _correlations(differences: FloatArray, lags: int) -> FloatArray:
    """rho_k of the first lags, of tiles with noise (tile, lag): D_k over that of later lags, each counted with its pairs.

    A pattern that comes up steadily adds a square of the lag, which what frames share does not: where later lags show it, it is
    subtracted.
    """
    lag = np.arange(1.0, differences.shape[1] + 1)
    pairs = lag[::-1]
    centred = lag[lags:] ** 2 - np.average(lag[lags:] ** 2, weights=pairs[lags:])
    weight = pairs[lags:] * centred
    steady = differences[:, lags:] @ weight / (weight @ centred)
    if len(steady) > 1 and steady.mean() > _BEYOND_CHANCE * steady.std(ddof=1) / math.sqrt(len(steady)):
        differences = differences - steady[:, None] * lag**2
    late = np.average(differences[:, lags:], axis=1, weights=pairs[lags:])
    noisy = late > 0
    return np.asarray(1.0 - differences[noisy, :lags] / late[noisy, None])


def _differences(item: Series, total: KeptSums, dark: FloatArray, good: NDArray[np.bool_]) -> FloatArray:
    """D_k of a series in each tile (tile, lag), DN^2; tiles without good pixels and copies of frames are left out."""
    middle = tuple(
        slice(max(0, (side - _SIDE_PX) // 2), max(0, (side - _SIDE_PX) // 2) + _SIDE_PX) for side in good.shape
    )
    level = float(np.mean((total.mean_DN - dark)[good]))
    frames: list[FloatArray] = []
    last = None
    for piece in item.iter_frames(maximum_bytes=PIECE_BYTES):
        own, last = piece[~repeats_the_last(piece, last)], piece[-1]
        for frame in own[: _MOST_FRAMES - len(frames)]:
            signal = frame.astype(np.float64) - dark
            mean = float(np.mean(signal[good]))
            frames.append(_sharp((signal * (level / mean) if mean > 0 < level else signal)[middle]))
        if len(frames) >= _MOST_FRAMES:
            break
    if len(frames) < _LEAST_FRAMES:
        return np.zeros((0, 1))
    whole: NDArray[np.bool_] = np.all(_blocks(good[middle]), axis=-1)
    result = []
    for rows in np.array_split(np.arange(whole.shape[0]), _TILES):
        for columns in np.array_split(np.arange(whole.shape[1]), _TILES):
            tile = np.ix_(rows, columns)
            values = np.stack([frame[tile][whole[tile]] for frame in frames])
            if values.shape[1] == 0:
                continue
            values = values - values.mean(axis=0)
            products = values @ values.T / values.shape[1]
            squares = np.diag(products)
            count = len(frames)
            result.append(
                [
                    0.5 * float(np.mean(squares[: count - k] + squares[k:] - 2.0 * np.diag(products, k)))
                    for k in range(1, count)
                ]
            )
    return np.array(result)


def _blocks(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Pixels of blocks of 2 x 2 (block row, block column, 4)."""
    rows, columns = values.shape[0] // 2, values.shape[1] // 2
    used = values[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
    return used.transpose(0, 2, 1, 3).reshape(rows, columns, 4)


def _sharp(frame: FloatArray) -> FloatArray:
    """x00 - x01 - x10 + x11 of blocks of 2 x 2 pixels (block row, block column)."""
    return np.asarray(_blocks(frame) @ np.array([1.0, -1.0, -1.0, 1.0]))

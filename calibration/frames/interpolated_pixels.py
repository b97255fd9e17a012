"""Pixels that firmware has replaced by means of their neighbours: they hold less noise, and share it with these."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from ...acquisition.acquisition_io import PIECE_BYTES, Series

# Neighbours (row, column) that a pixel is the mean of: one of the next four or all of them, pairs across it, all eight
_NEAR = ((0, -1), (0, 1), (-1, 0), (1, 0))
_FAR = ((-1, -1), (1, 1), (-1, 1), (1, -1))
_SOURCES = (
    *((place,) for place in _NEAR),
    *((first, (-first[0], -first[1])) for first in ((0, 1), (1, 0), (1, 1), (1, -1))),
    _NEAR,
    (*_NEAR, *_FAR),
)
_DIFFERENCES = 32  # of frames, over all series: chance then leaves a tenth of the noise at least
_LEAST_DIFFERENCES = 8  # fewer do not tell a pixel without noise of its own from chance
_CHANCE = 1e-9  # that a pixel with noise of its own looks like one without
_MOST_LEFT = 0.1  # of the others' noise, by rounding; a pixel that one mean of two was made of has a quarter
_BLOCK_PX = 32  # noise hardly changes over so many pixels


def find_interpolated(series: Sequence[Series]) -> NDArray[np.bool_] | None:
    """Pixels (row, column) that follow neighbours from frame to frame with no noise of their own.

    What a pixel differs by from the mean of neighbours has the variance of white noise and more, or less where light spreads; of
    a replaced pixel nothing is left but rounding. It is compared with the same of other pixels nearby, as it is and over the
    pixel's own variance, so that neither shade nor blur looks like it.

    Args:
        series: flats and darks of one shape, as read.

    Returns:
        None: too few frames to tell.
    """
    from ._kernels import add_what_neighbours_leave

    usable = [item for item in series if item.n_frames > 1]
    most = -(-_DIFFERENCES // max(len(usable), 1))
    shape = usable[0].shape if usable else (0, 0)
    own, left = np.zeros(shape, dtype=np.float32), np.zeros((len(_SOURCES), *shape), dtype=np.float32)
    counts = np.array([len(source) for source in _SOURCES])
    places = np.zeros((len(_SOURCES), counts.max(), 2), dtype=np.int64)
    for number, source in enumerate(_SOURCES):
        places[number, : len(source)] = source
    count = 0
    for item in usable:
        for change in _changes(item, most):
            add_what_neighbours_leave(change, places, counts, own, left)
            count += 1
    if count < _LEAST_DIFFERENCES:
        return None
    # over the median of chi-square of so many degrees
    least = min(_MOST_LEFT, float(gammaincinv(0.5 * count, _CHANCE) / gammaincinv(0.5 * count, 0.5)))
    result = np.zeros(shape, dtype=bool)
    inside = np.s_[1:-1, 1:-1]
    for squares in left[:, *inside]:
        with np.errstate(over="ignore"):  # a pixel that never changes leaves all of it
            share = squares / np.maximum(own[inside], np.finfo(np.float32).tiny)
        result[inside] |= (squares < least * _nearby(squares)) & (share < least * _nearby(share))
    return result


def _changes(item: Series, most: int) -> Iterator[NDArray[np.float32]]:
    """Differences (row, column) of pairs of frames that share none, less their median, over what half of them exceed: bright and dark
    ones count alike, and those of which more than half are 0 tell nothing."""
    first: NDArray[np.float64] | None = None
    for piece in item.iter_frames(maximum_bytes=PIECE_BYTES):
        for frame in piece:
            if most < 1:
                return
            if first is None:
                first = frame.astype(np.float64)
                continue
            change = frame - first
            change -= np.median(change)
            half = float(np.median(np.abs(change)))
            if half > 0:
                yield (change / half).astype(np.float32)
            first, most = None, most - 1


def _nearby(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Median of the block that each pixel lies in (row, column); pixels beyond the last whole block take that one's."""
    sides = [min(_BLOCK_PX, side) for side in values.shape]
    rows, columns = (side // block for side, block in zip(values.shape, sides, strict=True))
    whole = values[: rows * sides[0], : columns * sides[1]].reshape(rows, sides[0], columns, sides[1])
    medians = np.median(whole.swapaxes(1, 2).reshape(rows, columns, -1), axis=-1)
    down, across = (
        np.minimum(np.arange(side) // block, count - 1)
        for side, block, count in zip(values.shape, sides, (rows, columns), strict=True)
    )
    return np.asarray(medians[np.ix_(down, across)])

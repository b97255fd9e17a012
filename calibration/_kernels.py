"""Compiled loops of the calibration."""

from typing import Any

import numpy as np
from numba import njit, prange

_BLOCK = 4096  # pixels a thread takes at a time: its sums stay in the cache
COUNT_BLOCK = 1024  # the same for detector counts, whose sums stay in the nearest cache


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]
def accumulate(frames: Any, last: Any, has_last: bool, reference: Any, deviation: Any, square: Any, pair: Any) -> None:
    """Add frames (n, pixels) to the running sums (pixels,); `last` is the frame before and is replaced."""
    count, pixels = frames.shape
    blocks = (pixels + _BLOCK - 1) // _BLOCK
    for block in prange(blocks):
        start = block * _BLOCK
        stop = min(start + _BLOCK, pixels)
        for k in range(count):
            differs = k > 0 or has_last
            for p in range(start, stop):
                value = float(frames[k, p])
                from_reference = value - reference[p]
                deviation[p] += from_reference
                square[p] += from_reference * from_reference
                if differs:
                    step = value - last[p]
                    pair[p] += step * step
                last[p] = value


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]
def accumulate_counts(
    frames: Any,
    last: Any,
    has_last: bool,
    reference: Any,
    deviation: Any,
    square: Any,
    pair: Any,
    totals: Any,
    highest: Any,
    times: Any,
) -> None:
    """`accumulate` for uint8 or uint16 frames: whole numbers, summed exactly relative to the first frame given.

    Also filled, for blocks of COUNT_BLOCK pixels: totals (block, frame); highest value (block,) and how many values
    equal it, `times` (block,).
    """
    count, pixels = frames.shape
    for block in prange(len(highest)):
        start = block * COUNT_BLOCK
        stop = min(start + COUNT_BLOCK, pixels)
        size = stop - start
        first = frames[0, start:stop]
        block_deviation = np.zeros(size, np.int64)
        block_square = np.zeros(size, np.int64)
        block_pair = np.zeros(size, np.int64)
        top = np.int64(-1)
        top_times = np.int64(0)
        for k in range(count):
            row = frames[k, start:stop]
            before = frames[max(k - 1, 0), start:stop]
            total = np.uint32(0)  # COUNT_BLOCK values of 16 bits fit
            row_top = row[0]
            for p in range(size):
                total = np.uint32(total + np.uint32(row[p]))
                row_top = max(row_top, row[p])
            # a loop of its own: with the two reductions in it, it would not be vectorised
            for p in range(size):
                away = np.int32(np.int32(row[p]) - np.int32(first[p]))
                step = np.int32(np.int32(row[p]) - np.int32(before[p]))
                block_deviation[p] += away
                block_square[p] += away * away
                block_pair[p] += step * step
            totals[block, k] = total
            if row_top > top:
                top = row_top
                top_times = np.int64(0)
            if row_top == top:
                for p in range(size):
                    top_times += row[p] == row_top
        highest[block] = top
        times[block] = top_times
        for p in range(size):
            q = start + p
            shift = first[p] - reference[q]
            deviation[q] += block_deviation[p] + count * shift
            square[q] += block_square[p] + 2.0 * shift * block_deviation[p] + count * shift * shift
            pair[q] += block_pair[p]
            if has_last:
                seam = first[p] - last[q]
                pair[q] += seam * seam
            last[q] = frames[count - 1, q]

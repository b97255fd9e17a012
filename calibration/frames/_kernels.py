"""Compiled loops of the calibration."""

from typing import Any

import numpy as np
from numba import njit, prange

_BLOCK = 4096  # pixels a thread takes at a time: its sums stay in the cache
COUNT_BLOCK = 4096  # the same for detector counts, whose sums are narrower
_WINDOW = 16  # frames that are looked at twice while they are in the cache: for their spread, then for their sums
_ROOM = 2**32


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


@njit(inline="always")  # type: ignore[untyped-decorator]
def _add_narrow(
    frames: Any, begin: int, end: int, start: int, stop: int, first: Any, deviation: Any, square: Any, pair: Any
) -> None:
    """Add frames begin..end of pixels start..stop to 32-bit sums that the caller knows to have room for them.

    Four frames at a time, one loop a sum: what the compiler turns into vector instructions.
    """
    size = stop - start
    k = begin
    while k + 4 <= end:
        a, b = frames[k, start:stop], frames[k + 1, start:stop]
        c, d = frames[k + 2, start:stop], frames[k + 3, start:stop]
        before = frames[max(k - 1, 0), start:stop]
        for p in range(size):
            at = np.int32(first[p])
            deviation[p] = np.int32(
                deviation[p]
                + np.int32(np.int32(a[p]) - at)
                + np.int32(np.int32(b[p]) - at)
                + np.int32(np.int32(c[p]) - at)
                + np.int32(np.int32(d[p]) - at)
            )
        for p in range(size):
            at = np.int32(first[p])
            s, t = np.int32(np.int32(a[p]) - at), np.int32(np.int32(b[p]) - at)
            u, v = np.int32(np.int32(c[p]) - at), np.int32(np.int32(d[p]) - at)
            square[p] = np.uint32(square[p] + np.uint32(s * s) + np.uint32(t * t) + np.uint32(u * u) + np.uint32(v * v))
        for p in range(size):
            w, x, y, z = np.int32(a[p]), np.int32(b[p]), np.int32(c[p]), np.int32(d[p])
            s, t = np.int32(w - np.int32(before[p])), np.int32(x - w)
            u, v = np.int32(y - x), np.int32(z - y)
            pair[p] = np.uint32(pair[p] + np.uint32(s * s) + np.uint32(t * t) + np.uint32(u * u) + np.uint32(v * v))
        k += 4
    while k < end:
        a = frames[k, start:stop]
        before = frames[max(k - 1, 0), start:stop]
        for p in range(size):
            away = np.int32(np.int32(a[p]) - np.int32(first[p]))
            step = np.int32(np.int32(a[p]) - np.int32(before[p]))
            deviation[p] = np.int32(deviation[p] + away)
            square[p] = np.uint32(square[p] + np.uint32(away * away))
            pair[p] = np.uint32(pair[p] + np.uint32(step * step))
        k += 1


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
) -> None:
    """`accumulate` for uint8 or uint16 frames: whole numbers, summed exactly relative to the first frame given.

    Sums are kept in 32 bits while the spread of the values seen leaves room, and moved to 64 bits before it does not.
    Also filled, for blocks of COUNT_BLOCK pixels: totals (block, frame) and the highest value (block,).
    """
    count, pixels = frames.shape
    for block in prange(len(highest)):
        start = block * COUNT_BLOCK
        stop = min(start + COUNT_BLOCK, pixels)
        size = stop - start
        first = frames[0, start:stop]
        low, high = np.empty(size, frames.dtype), np.empty(size, frames.dtype)
        narrow_deviation = np.zeros(size, np.int32)
        narrow_square, narrow_pair = np.zeros(size, np.uint32), np.zeros(size, np.uint32)
        wide_deviation = np.zeros(size, np.int64)
        wide_square, wide_pair = np.zeros(size, np.int64), np.zeros(size, np.int64)
        top = np.int64(0)
        held = np.int64(0)  # no 32-bit sum of squares is above this
        for begin in range(0, count, _WINDOW):
            end = min(begin + _WINDOW, count)
            before = frames[max(begin - 1, 0), start:stop]
            for p in range(size):
                low[p] = min(first[p], before[p])
                high[p] = max(first[p], before[p])
            for k in range(begin, end):
                row = frames[k, start:stop]
                total = np.uint32(0)  # COUNT_BLOCK values of 16 bits fit
                for p in range(size):
                    total = np.uint32(total + np.uint32(row[p]))
                totals[block, k] = total
                for p in range(size):
                    low[p] = min(low[p], row[p])
                    high[p] = max(high[p], row[p])
            spread = np.int64(0)
            for p in range(size):
                spread = max(spread, np.int64(high[p]) - np.int64(low[p]))
                top = max(top, np.int64(high[p]))
            added = spread * spread * (end - begin)
            if held + added >= _ROOM:
                for p in range(size):
                    wide_deviation[p] += narrow_deviation[p]
                    wide_square[p] += narrow_square[p]
                    wide_pair[p] += narrow_pair[p]
                    narrow_deviation[p], narrow_square[p], narrow_pair[p] = 0, 0, 0
                held = np.int64(0)
            if added < _ROOM:
                held += added
                _add_narrow(frames, begin, end, start, stop, first, narrow_deviation, narrow_square, narrow_pair)
            else:
                for k in range(begin, end):
                    row = frames[k, start:stop]
                    before = frames[max(k - 1, 0), start:stop]
                    for p in range(size):
                        away = np.int64(row[p]) - np.int64(first[p])
                        step = np.int64(row[p]) - np.int64(before[p])
                        wide_deviation[p] += away
                        wide_square[p] += away * away
                        wide_pair[p] += step * step
        highest[block] = top
        for p in range(size):
            q = start + p
            shift = first[p] - reference[q]
            moved = wide_deviation[p] + narrow_deviation[p]
            deviation[q] += moved + count * shift
            square[q] += wide_square[p] + narrow_square[p] + 2.0 * shift * moved + count * shift * shift
            pair[q] += wide_pair[p] + narrow_pair[p]
            if has_last:
                seam = first[p] - last[q]
                pair[q] += seam * seam
            last[q] = frames[count - 1, q]


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]
def count_equal(frames: Any, highest: Any, value: int, times: Any) -> None:
    """How many values of each block of COUNT_BLOCK pixels equal `value`, which is the highest of all (block,)."""
    count, pixels = frames.shape
    for block in prange(len(highest)):
        found = np.int64(0)
        if highest[block] == value:
            start = block * COUNT_BLOCK
            stop = min(start + COUNT_BLOCK, pixels)
            for k in range(count):
                row = frames[k, start:stop]
                for p in range(stop - start):
                    found += row[p] == value
        times[block] = found


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]
def add_what_neighbours_leave(change: Any, places: Any, counts: Any, own: Any, left: Any) -> None:
    """Add squares of a map (row, column), and of what the mean of neighbours leaves of it; pixels at the border are left out.

    places: (source, neighbour, 2), rows and columns away; counts: neighbours of each source. own: (row, column); left: (source,
    row, column).
    """
    rows, columns = change.shape
    for row in prange(1, rows - 1):
        for column in range(1, columns - 1):
            own[row, column] += change[row, column] ** 2
        for source in range(len(counts)):
            share = np.float32(1.0 / counts[source])
            rest = change[row].copy()
            for number in range(counts[source]):
                down, across = places[source, number]
                for column in range(1, columns - 1):
                    rest[column] -= share * change[row + down, column + across]
            for column in range(1, columns - 1):
                left[source, row, column] += rest[column] * rest[column]

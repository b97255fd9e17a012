"""Compiled loops of the calibration."""

from typing import Any

from numba import njit, prange

_BLOCK = 4096  # pixels a thread takes at a time: its sums stay in the cache


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

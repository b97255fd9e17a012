"""Compiled sum of exponentials over energies for many pixels at once."""

from typing import Any

import numpy as np
from numba import njit, prange

MOMENTS = 4  # weights a call sums; fewer are padded with zeros
TOGETHER = 4  # energies a pass over a tile takes: loads and stores of the sums are shared
# pixels times energies: half a millisecond's work, and threads may take 6 ms to start on busy cores
FEW_TERMS = 1_000_000
_TILE = 512  # pixels a thread takes at a time: sums and thicknesses stay in the nearest cache
# no NaN and no infinity reaches the kernel, but the flags that would assume it are left out: -inf may pass max()
_FAST = {"contract", "nsz", "reassoc", "arcp"}


@njit(fastmath=_FAST, inline="always")  # type: ignore[untyped-decorator]
def _power_of_two(exponent: Any) -> Any:
    """2^exponent to 2e-7 for -126.5 < exponent < 126.5; exactly 1 at 0 and exactly 0 below."""
    bounded = min(max(exponent, np.float32(-127.0)), np.float32(126.0))
    whole = np.floor(bounded + np.float32(0.5))
    rest = bounded - whole
    value = np.float32(1.5353362e-4)
    value = value * rest + np.float32(1.3398874e-3)
    value = value * rest + np.float32(9.6184374e-3)
    value = value * rest + np.float32(5.5503325e-2)
    value = value * rest + np.float32(2.4022648e-1)
    value = value * rest + np.float32(6.9314720e-1)
    value = value * rest + np.float32(1.0)
    # the exponent's bits of a float32; 0 at -127
    bits = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23))
    return value * bits.view(np.float32)


@njit(fastmath=_FAST, cache=True)  # type: ignore[untyped-decorator]
def _sum_tile(tile: Any, thickness: Any, depth: Any, weight: Any, open_sum: Any, out: Any) -> None:
    """`sum_exponentials` of one tile's pixels."""
    materials, pixels = thickness.shape
    energies = depth.shape[1]
    start = tile * _TILE
    size = min(_TILE, pixels - start)
    sum_0 = np.zeros(_TILE, np.float32)
    sum_1 = np.zeros(_TILE, np.float32)
    sum_2 = np.zeros(_TILE, np.float32)
    sum_3 = np.zeros(_TILE, np.float32)
    more = np.zeros((TOGETHER, _TILE), np.float32)
    first = thickness[0, start : start + size]
    second = thickness[1, start : start + size]
    for j in range(0, energies, TOGETHER):
        if materials > 2:
            for i in range(TOGETHER):
                for p in range(size):
                    more[i, p] = depth[2, j + i] * thickness[2, start + p]
                for m in range(3, materials):
                    for p in range(size):
                        more[i, p] += depth[m, j + i] * thickness[m, start + p]
        for p in range(size):
            t = first[p]
            u = second[p]
            e_0 = _power_of_two(-depth[0, j] * t - depth[1, j] * u - more[0, p])
            e_1 = _power_of_two(-depth[0, j + 1] * t - depth[1, j + 1] * u - more[1, p])
            e_2 = _power_of_two(-depth[0, j + 2] * t - depth[1, j + 2] * u - more[2, p])
            e_3 = _power_of_two(-depth[0, j + 3] * t - depth[1, j + 3] * u - more[3, p])
            sum_0[p] += (weight[0, j] * e_0 + weight[0, j + 1] * e_1) + (
                weight[0, j + 2] * e_2 + weight[0, j + 3] * e_3
            )
            sum_1[p] += (weight[1, j] * e_0 + weight[1, j + 1] * e_1) + (
                weight[1, j + 2] * e_2 + weight[1, j + 3] * e_3
            )
            sum_2[p] += (weight[2, j] * e_0 + weight[2, j + 1] * e_1) + (
                weight[2, j + 2] * e_2 + weight[2, j + 3] * e_3
            )
            sum_3[p] += (weight[3, j] * e_0 + weight[3, j + 1] * e_1) + (
                weight[3, j + 2] * e_2 + weight[3, j + 3] * e_3
            )
    sums = (sum_0, sum_1, sum_2, sum_3)
    absent = np.zeros(_TILE, np.float32)
    for m in range(materials):
        for p in range(size):
            absent[p] += abs(thickness[m, start + p])
    for k in range(out.shape[0]):
        one = sums[k]
        for p in range(size):
            out[k, start + p] = one[p] if absent[p] > 0 else open_sum[k]


@njit(fastmath=_FAST, cache=True)  # type: ignore[untyped-decorator]
def sum_exponentials_alone(thickness: Any, depth: Any, weight: Any, open_sum: Any, out: Any) -> None:
    """`sum_exponentials` without further threads."""
    for tile in range((thickness.shape[1] + _TILE - 1) // _TILE):
        _sum_tile(tile, thickness, depth, weight, open_sum, out)


@njit(parallel=True, fastmath=_FAST, cache=True)  # type: ignore[untyped-decorator]
def sum_exponentials(thickness: Any, depth: Any, weight: Any, open_sum: Any, out: Any) -> None:
    """out[k, p] = sum_j weight[k, j] 2^(-sum_m depth[m, j] thickness[m, p]); open_sum[k] where all thicknesses are 0.

    thickness (material >= 2, pixel), depth (material, energy), weight (MOMENTS, energy): energies a multiple of
    TOGETHER; out (k <= MOMENTS, pixel); all float32.
    """
    for tile in prange((thickness.shape[1] + _TILE - 1) // _TILE):
        _sum_tile(tile, thickness, depth, weight, open_sum, out)

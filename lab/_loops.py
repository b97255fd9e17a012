"""The compiled loops of the measuring chain, and the random numbers that they draw.

Every row has a random stream of its own, so the same seed gives the same bytes on any number of threads. Uniforms are
xoshiro256++ (Blackman and Vigna 2021, doi:10.1145/3460772), seeded through splitmix64. Poisson numbers below a mean of
64 are a sum of two: one of a tabulated mean by Walker's alias method (Walker 1977, doi:10.1145/355744.355749) and one of
the small remainder by inversion, each from 32 random bits; from 64 on they are Hörmann's PTRS (1993,
doi:10.1016/0167-6687(93)90997-4). Gamma numbers: Marsaglia and Tsang (2000, doi:10.1145/358407.358414).

All of it stands in one file because numba keeps compiled loops by the file that they stand in.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit, prange

# Fewer photons than this in a sub-pixel are drawn one by one, more as one Poisson number a class.
_ONE_BY_ONE = 5.0

TABLE_STEP = 0.5
TABLE_MEAN = 64.0
_ENTRIES = 256

_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_LOW_32 = np.uint64(0xFFFFFFFF)
_LOW_24 = np.uint64(0xFFFFFF)
_U11, _U17, _U23, _U24, _U27, _U30, _U31, _U32, _U41, _U45, _U19, _U56 = (
    np.uint64(n) for n in (11, 17, 23, 24, 27, 30, 31, 32, 41, 45, 19, 56)
)
_TO_UNIT_53 = 2.0**-53
_TO_UNIT_32 = 2.0**-32


@lru_cache(maxsize=1)
def poisson_tables() -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Walker tables (keep probability, alias) of the Poisson law at means 0, 0.5, ... 64; shape (129, 256) each."""
    from scipy.special import gammaln, xlogy

    means = np.arange(int(TABLE_MEAN / TABLE_STEP) + 1) * TABLE_STEP
    counts = np.arange(_ENTRIES, dtype=np.float64)
    keep = np.ones((means.size, _ENTRIES), dtype=np.float32)
    alias = np.zeros((means.size, _ENTRIES), dtype=np.uint8)
    for row, mean in enumerate(means):
        share = np.exp(xlogy(counts, mean) - mean - gammaln(counts + 1.0))
        share *= _ENTRIES / share.sum()
        poor = [i for i in range(_ENTRIES) if share[i] < 1]
        rich = [i for i in range(_ENTRIES) if share[i] >= 1]
        while poor and rich:
            low, high = poor.pop(), rich.pop()
            keep[row, low] = share[low]
            alias[row, low] = high
            share[high] -= 1.0 - share[low]
            (poor if share[high] < 1 else rich).append(high)
    return keep, alias


@njit(inline="always")
def _rotl(x, k):  # type: ignore[no-untyped-def]
    return (x << k) | (x >> (np.uint64(64) - k))


@njit(cache=True)
def seed_stream(state, key, stage, frame, row):  # type: ignore[no-untyped-def]
    """Fill `state` (4 uint64) for one (key, stage, frame, row); different arguments give unrelated streams."""
    x = key
    for word in (np.uint64(stage), np.uint64(frame), np.uint64(row)):
        x = (x ^ (word + _GOLDEN)) * _MIX_1
        x = (x ^ (x >> _U30)) * _MIX_2
        x ^= x >> _U31
    for i in range(4):
        x += _GOLDEN
        z = x
        z = (z ^ (z >> _U30)) * _MIX_1
        z = (z ^ (z >> _U27)) * _MIX_2
        state[i] = z ^ (z >> _U31)


@njit(inline="always")
def next_bits(state):  # type: ignore[no-untyped-def]
    """64 random bits."""
    s0, s1, s2, s3 = state[0], state[1], state[2], state[3]
    result = _rotl(s0 + s3, _U23) + s0
    shifted = s1 << _U17
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= shifted
    state[0], state[1], state[2], state[3] = s0, s1, s2, _rotl(s3, _U45)
    return result


@njit(inline="always")
def uniform(state):  # type: ignore[no-untyped-def]
    """A uniform number in (0, 1)."""
    return (np.float64(next_bits(state) >> _U11) + 0.5) * _TO_UNIT_53


@njit(cache=True)
def _poisson_large(state, mean):  # type: ignore[no-untyped-def]
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    quick = 0.9277 - 3.6224 / (b - 2.0)
    while True:
        u = uniform(state) - 0.5
        v = uniform(state)
        us = 0.5 - abs(u)
        k = math.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= quick:
            return k
        if k < 0.0 or (us < 0.013 and v > us):
            continue
        if math.log(v * inverse_alpha / (a / (us * us) + b)) <= k * math.log(mean) - mean - math.lgamma(k + 1.0):
            return k


@njit(inline="always")
def poisson(state, mean, keep, alias):  # type: ignore[no-untyped-def]
    """A Poisson number (float64) of mean `mean`; `keep` and `alias` are `poisson_tables()`."""
    if mean >= TABLE_MEAN:
        count = _poisson_large(state, mean)
    else:
        row = np.int64(mean * (1.0 / TABLE_STEP))
        rest = mean - row * TABLE_STEP
        bits = next_bits(state)
        entry = np.int64(bits >> _U56)
        fraction = np.float32((bits >> _U32) & _LOW_24) * np.float32(2.0**-24)
        count = np.float64(entry) if fraction < keep[row, entry] else np.float64(alias[row, entry])
        u = np.float64(bits & _LOW_32) * _TO_UNIT_32
        if u >= 1.0 - rest:  # 1 - rest <= exp(-rest): most draws of the remainder end here, as 0
            term = math.exp(-rest)
            extra = 0.0
            while u >= term and extra < 24.0:
                u -= term
                extra += 1.0
                term *= rest / extra
            count += extra
    return count


@njit(cache=True)
def normal(state):  # type: ignore[no-untyped-def]
    """A standard normal number (polar method)."""
    while True:
        x = 2.0 * uniform(state) - 1.0
        y = 2.0 * uniform(state) - 1.0
        r = x * x + y * y
        if 0.0 < r < 1.0:
            return x * math.sqrt(-2.0 * math.log(r) / r)


@njit(cache=True)
def gamma(state, shape):  # type: ignore[no-untyped-def]
    """A gamma number of mean and variance `shape`, for shape >= 1/3."""
    d = shape - 1.0 / 3.0 if shape >= 1.0 else shape + 2.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    while True:
        x = normal(state)
        v = 1.0 + c * x
        if v <= 0.0:
            continue
        v = v * v * v
        u = uniform(state)
        if u < 1.0 - 0.0331 * x * x * x * x or math.log(u) < 0.5 * x * x + d * (1.0 - v + math.log(v)):
            break
    value = d * v
    if shape < 1.0:
        value *= uniform(state) ** (1.0 / shape)
    return value


@njit(parallel=True, cache=True)
def light_of_photons(  # type: ignore[no-untyped-def]
    cell, rates, totals, factor, deposit_keV, light_variance, key, frame, sub, keep, alias, light
):
    """Fill `light` (fine row, fine column) with keV of light: photons drawn by class, light spread by a gamma law.

    `cell` says which row of `rates` (cell, class) each sub-pixel has; `totals` are their sums; `factor` turns a rate
    into the mean number of photons in this sub-pixel and frame.
    """
    n_classes = deposit_keV.size
    for coarse in prange(cell.shape[0] // sub):
        state = np.empty(4, dtype=np.uint64)
        seed_stream(state, key, 1, frame, coarse)
        for row in range(coarse * sub, (coarse + 1) * sub):
            for column in range(cell.shape[1]):
                here = cell[row, column]
                expected = totals[here] * factor
                first, second = 0.0, 0.0
                if expected < _ONE_BY_ONE:
                    count = int(poisson(state, expected, keep, alias))
                    for _ in range(count):
                        # One photon: its class by inversion of the cumulated rates.
                        left = uniform(state) * totals[here]
                        k = 0
                        while k < n_classes - 1 and left >= rates[here, k]:
                            left -= rates[here, k]
                            k += 1
                        first += deposit_keV[k]
                        second += deposit_keV[k] * deposit_keV[k]
                else:
                    for k in range(n_classes):
                        count_k = poisson(state, rates[here, k] * factor, keep, alias)
                        first += count_k * deposit_keV[k]
                        second += count_k * deposit_keV[k] * deposit_keV[k]
                if first > 0.0 and light_variance > 0.0:
                    # The photons' light adds to mean `first` and variance light_variance * second.
                    shape = first * first / (light_variance * second)
                    first *= gamma(state, shape) / shape
                light[row, column] = first


@njit(parallel=True, cache=True)
def spread_light(light, row_taps, column_taps, sub, out):  # type: ignore[no-untyped-def]
    """Collect fine light in square pixels behind a separable spread.

    The taps are the shares that a pixel takes of the sub-pixels in a line across it, from row to row and from column to
    column; they reach over the margin that `light` has on every side, so that pixel 0 begins with sub-pixel 0 of `light`.
    """
    rows, columns = out.shape
    n_taps = row_taps.size
    fine_columns = light.shape[1]
    for row in prange(rows):
        line = np.zeros(fine_columns, dtype=np.float32)
        start = row * sub
        for t in range(n_taps):
            w = row_taps[t]
            for column in range(fine_columns):
                line[column] += w * light[start + t, column]
        for column in range(columns):
            total = np.float32(0.0)
            begin = column * sub
            for t in range(n_taps):
                total += column_taps[t] * line[begin + t]
            out[row, column] = total


@njit(parallel=True, cache=True)
def electrons_of_light(light_keV, electrons_per_keV, dark_electrons, key, frame, keep, alias, out):  # type: ignore[no-untyped-def]
    """Poisson numbers of electrons, light and dark current together."""
    for row in prange(light_keV.shape[0]):
        state = np.empty(4, dtype=np.uint64)
        seed_stream(state, key, 2, frame, row)
        for column in range(light_keV.shape[1]):
            mean = light_keV[row, column] * electrons_per_keV + dark_electrons[row, column]
            out[row, column] = poisson(state, mean, keep, alias)


@njit(parallel=True, cache=True)
def read_out(electrons, DN_per_electron, dark_DN, noise_DN, share, key, frame, out):  # type: ignore[no-untyped-def]
    """DN before the ADC: conversion, offset, white electronic noise; `share` divides the electrons of summed frames."""
    for row in prange(electrons.shape[0]):
        state = np.empty(4, dtype=np.uint64)
        seed_stream(state, key, 3, frame, row)
        for column in range(electrons.shape[1]):
            out[row, column] = (
                electrons[row, column] * share * DN_per_electron[row, column]
                + dark_DN[row, column]
                + noise_DN[row, column] * normal(state)
            )

"""Random streams for compiled loops: one stream a row, so the same seed gives the same bytes on any number of threads.

Uniforms are xoshiro256++ (Blackman and Vigna 2021, doi:10.1145/3460772), seeded through splitmix64. Poisson numbers
below a mean of 64 are a sum of two: one of a tabulated mean by Walker's alias method (Walker 1977,
doi:10.1145/355744.355749) and one of the small remainder by inversion, each from 32 random bits; from 64 on they are
Hörmann's PTRS (1993, doi:10.1016/0167-6687(93)90997-4). Gamma numbers: Marsaglia and Tsang (2000,
doi:10.1145/358407.358414).
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

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

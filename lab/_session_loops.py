"""The compiled loops of long sessions: the laws of `_loops`, with bright sub-pixels drawn by their cumulants.

A sub-pixel that expects `_ONE_BY_ONE` photons or more gets its light from one normal number z through the expansion
m1 + sqrt(m2) (z (1 - s^2 / 36) + s (z^2 - 1) / 6), s the skewness: mean, variance and skewness of the compound Poisson
law are kept, the excess kurtosis (about 1/N) is not. Fewer photons are drawn one by one as before.

Source of the expansion: Cornish and Fisher 1938, doi:10.2307/1400905. Normal numbers: the ziggurat of Marsaglia and
Tsang 2000, doi:10.18637/jss.v005.i08, on 256 layers.
"""

import math

import numpy as np
from numba import njit, prange

from ._loops import gamma, next_bits, poisson, seed_stream, uniform

_ONE_BY_ONE = 8.0
_MANY_ELECTRONS = 400.0

_R = 3.6541528853610088
_V = 0.00492867323399
_LAYERS = 256
_U11, _U8, _MASK_8 = np.uint64(11), np.uint64(8), np.uint64(255)
_TO_UNIT_53 = 2.0**-53


def _ziggurat():  # type: ignore[no-untyped-def]
    x = np.zeros(_LAYERS + 1)
    f = np.exp(-0.5 * _R * _R)
    x[0] = _V / f
    x[1] = _R
    for i in range(2, _LAYERS):
        x[i] = math.sqrt(-2.0 * math.log(_V / x[i - 1] + math.exp(-0.5 * x[i - 1] ** 2)))
    return x


_X = _ziggurat()  # type: ignore[no-untyped-call]
_F = np.exp(-0.5 * _X**2)


@njit(cache=True)
def fast_normal(state):  # type: ignore[no-untyped-def]
    """A standard normal number (ziggurat)."""
    while True:
        bits = next_bits(state)
        layer = np.int64(bits & _MASK_8)
        u = 2.0 * (np.float64(bits >> _U11) * _TO_UNIT_53) - 1.0
        x = u * _X[layer]
        if abs(x) < _X[layer + 1]:
            return x
        if layer == 0:
            while True:
                a = -math.log(uniform(state)) / _R
                b = -math.log(uniform(state))
                if b + b > a * a:
                    return _R + a if u > 0 else -_R - a
        elif _F[layer] + uniform(state) * (_F[layer + 1] - _F[layer]) < math.exp(-0.5 * x * x):
            return x


@njit(parallel=True, cache=True)
def light_of_many_photons(  # type: ignore[no-untyped-def]
    cell, rates, totals, sums, factor, deposit_keV, light_variance, key, frame, sub, keep, alias, light
):
    """As `_loops.light_of_photons`; `sums` (cell, 3) are sum r d, sum r d^2 and sum r d^3 over the classes."""
    n_classes = deposit_keV.size
    second_of = 1.0 + light_variance
    third_of = (1.0 + light_variance) * (1.0 + 2.0 * light_variance)
    for coarse in prange(cell.shape[0] // sub):
        state = np.empty(4, dtype=np.uint64)
        seed_stream(state, key, 1, frame, coarse)
        for row in range(coarse * sub, (coarse + 1) * sub):
            for column in range(cell.shape[1]):
                here = cell[row, column]
                expected = totals[here] * factor
                if expected >= _ONE_BY_ONE:
                    variance = sums[here, 1] * factor * second_of
                    spread = math.sqrt(variance)
                    skew = sums[here, 2] * factor * third_of / (variance * spread)
                    z = fast_normal(state)
                    bent = z * (1.0 - skew * skew * (1.0 / 36.0)) + skew * (z * z - 1.0) * (1.0 / 6.0)
                    light[row, column] = max(sums[here, 0] * factor + spread * bent, 0.0)
                    continue
                first, second = 0.0, 0.0
                count = int(poisson(state, expected, keep, alias)) if expected > 0.0 else 0
                for _ in range(count):
                    left = uniform(state) * totals[here]
                    k = 0
                    while k < n_classes - 1 and left >= rates[here, k]:
                        left -= rates[here, k]
                        k += 1
                    first += deposit_keV[k]
                    second += deposit_keV[k] * deposit_keV[k]
                if first > 0.0 and light_variance > 0.0:
                    shape = first * first / (light_variance * second)
                    first *= gamma(state, shape) / shape
                light[row, column] = first


@njit(parallel=True, cache=True)
def light_quanta(cell, rates, factor, light_variance, key, stage, frame, keep, alias, out):  # type: ignore[no-untyped-def]
    """Photons of a rate (cell,) times `factor`, each with its light's spread: mean n, variance n (1 + light_variance)."""
    second_of = 1.0 + light_variance
    for row in prange(cell.shape[0]):
        state = np.empty(4, dtype=np.uint64)
        seed_stream(state, key, stage, frame, row)
        for column in range(cell.shape[1]):
            mean = rates[cell[row, column]] * factor
            if mean >= _ONE_BY_ONE:
                z = fast_normal(state)
                spread = math.sqrt(mean * second_of)
                skew = (1.0 + 2.0 * light_variance) / spread
                bent = z * (1.0 - skew * skew * (1.0 / 36.0)) + skew * (z * z - 1.0) * (1.0 / 6.0)
                out[row, column] = max(mean + spread * bent, 0.0)
                continue
            count = poisson(state, mean, keep, alias) if mean > 0.0 else 0.0
            if count > 0.0 and light_variance > 0.0:
                count = max(count + math.sqrt(light_variance * count) * fast_normal(state), 0.0)
            out[row, column] = count


@njit(parallel=True, cache=True)
def electrons_of_much_light(light_keV, electrons_per_keV, dark_electrons, key, frame, keep, alias, out):  # type: ignore[no-untyped-def]
    """Poisson numbers of electrons, light and dark current together; many of them by the law's first three cumulants."""
    for row in prange(light_keV.shape[0]):
        state = np.empty(4, dtype=np.uint64)
        seed_stream(state, key, 2, frame, row)
        for column in range(light_keV.shape[1]):
            mean = max(light_keV[row, column] * electrons_per_keV + dark_electrons[row, column], 0.0)
            if mean >= _MANY_ELECTRONS:
                z = fast_normal(state)
                out[row, column] = math.floor(mean + math.sqrt(mean) * z + (z * z - 1.0) * (1.0 / 6.0) + 0.5)
            else:
                out[row, column] = poisson(state, mean, keep, alias)


@njit(parallel=True, cache=True)
def read_out_fast(electrons, DN_per_electron, dark_DN, noise_DN, share, key, frame, out):  # type: ignore[no-untyped-def]
    """DN before the ADC, as `_loops.read_out`."""
    for row in prange(electrons.shape[0]):
        state = np.empty(4, dtype=np.uint64)
        seed_stream(state, key, 3, frame, row)
        for column in range(electrons.shape[1]):
            out[row, column] = (
                electrons[row, column] * share * DN_per_electron[row, column]
                + dark_DN[row, column]
                + noise_DN[row, column] * fast_normal(state)
            )

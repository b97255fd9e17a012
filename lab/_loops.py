"""The compiled loops of the measuring chain. Every row has a random stream of its own (see `_random`)."""

import numpy as np
from numba import njit, prange

from ._random import gamma, normal, poisson, seed_stream, uniform

# Fewer photons than this in a sub-pixel are drawn one by one, more as one Poisson number a class.
_ONE_BY_ONE = 5.0


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
def spread_light(light, taps, sub, out):  # type: ignore[no-untyped-def]
    """Collect fine light in square pixels behind a separable spread.

    `taps` are the shares that a pixel takes of the sub-pixels in a line across it; they reach over the margin that
    `light` has on every side, so that pixel 0 begins with sub-pixel 0 of `light`.
    """
    rows, columns = out.shape
    n_taps = taps.size
    fine_columns = light.shape[1]
    for row in prange(rows):
        line = np.zeros(fine_columns, dtype=np.float32)
        start = row * sub
        for t in range(n_taps):
            w = taps[t]
            for column in range(fine_columns):
                line[column] += w * light[start + t, column]
        for column in range(columns):
            total = np.float32(0.0)
            begin = column * sub
            for t in range(n_taps):
                total += taps[t] * line[begin + t]
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

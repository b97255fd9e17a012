"""A twin whose own numbers are changed: gain of all levels, or spectrum with the levels that follow it."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .spectral_signal import OpenBeam, SpectralModel
from .twin import Level, SpectralPosterior, Twin
from .twin_spectrum import spectral_model_of

FloatArray = NDArray[np.float64]


def with_gain(twin: Twin, factor: float) -> Twin:
    """The twin with a quantum variance larger by a factor, at the same signal and number of photons."""
    levels = tuple(
        replace(
            level,
            gain_DN=level.gain_DN.times(factor),
            photon_transfer_slope_DN=level.photon_transfer_slope_DN.times(factor),
        )
        for level in twin.levels
    )
    spectral = None if twin.spectral is None else moved(twin, "log_swank", lambda values: values - math.log(factor))
    return replace(twin, levels=levels, spectral=spectral)


def moved(twin: Twin, name: str, change: Callable[[FloatArray], FloatArray]) -> SpectralPosterior:
    """The twin's posterior with one of its parameters changed, in all draws and in the best.

    Raises:
        InputError: a twin without spectral part.
    """
    spectral = twin.spectral
    if spectral is None:
        raise InputError("twin", received="no spectral part", expected="one calibrated from flats of known beams")
    column = spectral.names.index(name)
    samples, best = spectral.samples.copy(), spectral.best.copy()
    samples[:, column] = change(samples[:, column])
    best[column] = change(best[column : column + 1])[0]
    return replace(spectral, samples=samples, best=best)


def with_spectrum(twin: Twin, after: SpectralPosterior) -> Twin:
    """The twin with another posterior; its measured levels change as the model's best parameters say.

    Raises:
        InputError: a twin without spectral part.
    """
    before = twin.spectral
    if before is None:
        raise InputError("twin", received="no spectral part", expected="one calibrated from flats of known beams")
    highest = max([160.0, *(level.kV for level in twin.levels if level.kV is not None)])
    model = spectral_model_of(twin, highest_kV=highest)
    levels = tuple(_moved_level(level, model, before.best, after.best) for level in twin.levels)
    return replace(twin, spectral=after, levels=levels)


def _moved_level(level: Level, model: SpectralModel, before: FloatArray, after: FloatArray) -> Level:
    if level.kV is None:
        return level
    found = model.signal(np.stack([before, after]), OpenBeam(kV=level.kV, filters=level.filters))
    rate = float(found.rate_DN_per_mAs[1] / found.rate_DN_per_mAs[0])
    gain = float(found.gain_DN[1] / found.gain_DN[0])
    return replace(
        level,
        rate_DN_per_mAs=None if level.rate_DN_per_mAs is None else level.rate_DN_per_mAs.times(rate),
        gain_DN=level.gain_DN.times(gain),
        photon_transfer_slope_DN=level.photon_transfer_slope_DN.times(gain),
    )

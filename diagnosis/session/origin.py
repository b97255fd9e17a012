"""Whether a twin was calibrated from the very series that it is to be compared with."""

import math
from collections.abc import Sequence

import numpy as np

from ...acquisition.acquisition_io import Series
from ...generator.line.twin import Twin
from ..arrays import BoolArray, FloatArray

_MOST_SERIES = 12  # of each kind that are looked at
_SURE = 10.0  # standard deviations of a variance of independent pixels; light spreads over a few
_LEAST_SHARE = 0.05  # of a map's frames that a series must bring to be found
_ROUNDING = 1e-6  # relative, of maps that are kept in single precision
_MOST_PAIRS = 8  # of frames that a series' noise is taken from


def made_of(twin: Twin, series: Sequence[Series]) -> bool:
    """Whether darks or flats among the series are in a twin's maps.

    The mean frame of a series lies closer to a map that it is a part of than its own noise allows; to any other map it lies
    further away, by that map's noise as well.
    """
    good = twin.maps.bad_pixels == 0
    sure = max(_SURE * math.sqrt(2.0 / max(int(np.count_nonzero(good)), 1)), _LEAST_SHARE)
    for kind in ("dark", "flat"):
        for item in [one for one in series if one.kind == kind and "gain" not in one.corrected][:_MOST_SERIES]:
            mean_DN, noise_DN2 = _mean_and_noise(item, good)
            # of a single frame no noise is seen: a map of nothing else is that frame
            least_DN2 = noise_DN2 * (1.0 - sure) or (_ROUNDING * float(np.max(np.abs(mean_DN)))) ** 2
            if any(_variance(apart, good) < least_DN2 for apart in _from_maps(twin, item, mean_DN, good)):
                return True
    return False


def _from_maps(twin: Twin, item: Series, mean_DN: FloatArray, good: BoolArray) -> list[FloatArray]:
    """Distance (row, column), DN, of a dark from the twin's, or of a flat from each shape it has for the kV and filters."""
    less_dark_DN = mean_DN - twin.maps.dark_at(item.exposure_ms)
    if item.kind == "dark":
        return [less_dark_DN]
    signal_DN = mean_DN if "offset" in item.corrected else less_dark_DN
    level_DN = float(np.median(signal_DN[good]))
    layers = sorted(map(str, item.filters))
    known = [one for one in twin.levels if one.kV == item.kV and sorted(map(str, one.filters)) == layers]
    return [signal_DN - level_DN * one.flat_shape for one in known] if level_DN > 0.0 else []


def _mean_and_noise(item: Series, good: BoolArray) -> tuple[FloatArray, float]:
    """Mean frame (row, column), DN, and variance of its noise, DN^2; 0 for a single frame, which shows none."""
    total, noise_DN2, last = np.zeros(item.shape), [], None
    for piece in item.iter_frames():
        for frame in np.asarray(piece, dtype=np.float64):
            total += frame
            if last is not None and len(noise_DN2) < _MOST_PAIRS:
                noise_DN2.append(_variance(frame - last, good) / 2.0)
            last = frame
    return total / item.n_frames, float(np.mean(noise_DN2)) / item.n_frames if noise_DN2 else 0.0


def _variance(image: FloatArray, good: BoolArray) -> float:
    """Variance of what pixels in use have of their own, without the few that a fading ghost's outline or a hot pixel shifts."""
    from scipy.stats import sigmaclip

    steps = np.diff(image, axis=1)[good[:, 1:] & good[:, :-1]]
    return float(np.var(sigmaclip(steps).clipped)) / 2.0 if steps.size else 0.0

"""The threshold of an observer that searches a whole image, at a stated rate of false alarms.

The output of a template over an image of noise is a Gaussian field on the pixels, of unit variance and correlation r_r, r_c between
neighbours along rows and columns. An alarm is a local maximum above t. Where correlations fall off as Gaussians, a pixel is one with
the chance

    G(t) = integral from t of phi(z) q(r_r, z) q(r_c, z) dz,    q(r, z) = Phi2(h z, h z; -r^2),    h = ((1 - r) / (1 + r))^(1/2)

(Phi2: bivariate normal distribution; q: both neighbours along an axis lie lower). Maxima above a high threshold are rare and so
Poisson: the chance of an alarm in A pixels is 1 - exp(-A G(t)). It joins independent pixels (r = 0: G = Q(t), nearly) to smooth
fields, where it is the expected number of maxima of random-field theory. The number of independent places is N with
1 - (1 - Q(t))^N the same chance.

Source: Worsley, NeuroImage 28 (2005) 1056 (discrete local maxima); Adler, The Geometry of Random Fields (1981).
Checked against: templates over drawn noise (tests/test_observers.py).
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

FloatArray = NDArray[np.float64]

_LOG_H = np.linspace(math.log(0.01), math.log(2.5), 40)
_THRESHOLD = np.linspace(-2.0, 9.0, 221)
_LOG_CHANCE = np.linspace(-42.0, -1.0, 165)  # of a pixel; from an alarm in 1e18 pixels


def chance_of_maximum(threshold: FloatArray, *, row_correlation: float, column_correlation: float) -> FloatArray:
    """Chance G (threshold,) that a pixel is a local maximum above each threshold (rising, evenly spaced)."""
    from scipy.special import ndtr

    step = threshold[1] - threshold[0]
    z = np.concatenate([threshold, threshold[-1] + step * np.arange(1, 1 + math.ceil(4.0 / step))])
    density = np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    for correlation in (row_correlation, column_correlation):
        density = density * _both_lower(z, correlation)
    pieces = 0.5 * step * (density[1:] + density[:-1])
    above = np.cumsum(pieces[::-1])[::-1]
    # beyond the last point the neighbours are lower for sure
    return np.asarray(above[: threshold.size] + ndtr(-z[-1]))


def _both_lower(z: FloatArray, correlation: float) -> FloatArray:
    from scipy.special import ndtr, owens_t

    square = min(correlation**2, 1 - 1e-12)
    at = math.sqrt((1.0 - correlation) / (1.0 + correlation)) * z
    return np.asarray(np.maximum(ndtr(at) - 2.0 * owens_t(at, math.sqrt((1.0 + square) / (1.0 - square))), 0.0))


@lru_cache(maxsize=1)
def _thresholds() -> FloatArray:
    """Threshold at every ln h of rows and columns and ln chance (row, column, chance)."""
    found = np.empty((_LOG_H.size, _LOG_H.size, _LOG_CHANCE.size))
    squares = np.exp(2 * _LOG_H)
    correlation = (1 - squares) / (1 + squares)
    for row in range(_LOG_H.size):
        for column in range(row + 1):
            chance = chance_of_maximum(
                _THRESHOLD, row_correlation=correlation[row], column_correlation=correlation[column]
            )
            logs = np.log(np.maximum(chance, 1e-300))
            found[row, column] = found[column, row] = np.interp(_LOG_CHANCE, logs[::-1], _THRESHOLD[::-1])
    return found


def search_threshold(
    *, row_correlation: ArrayLike, column_correlation: ArrayLike, area_px: ArrayLike, false_alarm_rate: float
) -> FloatArray:
    """Threshold (standard deviations) at which `false_alarm_rate` of the images without object show an alarm.

    Args:
        row_correlation, column_correlation: of the output in neighbouring pixels (`Detectability`).
        area_px: what is searched, pixels; arrays that broadcast.
        false_alarm_rate: share of images.

    Example:
        >>> from raytwin.observers import search_threshold
        >>> t = search_threshold(row_correlation=0.8, column_correlation=0.8, area_px=1e4, false_alarm_rate=0.01)
        >>> round(float(t), 1)
        4.7

    Raises:
        InputError: a rate that is not between 0 and 1.
    """
    from scipy.ndimage import map_coordinates

    if not 0 < false_alarm_rate < 1:
        raise InputError("false-alarm rate", received=false_alarm_rate, expected="a share of images between 0 and 1")
    row, column, area = np.broadcast_arrays(
        *(np.asarray(one, float) for one in (row_correlation, column_correlation, area_px))
    )
    places = []
    for correlation in (row, column):
        inside = np.clip(correlation, -0.99, 1 - 1e-9)
        places.append(_place(0.5 * np.log((1 - inside) / (1 + inside)), _LOG_H))
    places.append(_place(math.log(-math.log1p(-false_alarm_rate)) - np.log(area), _LOG_CHANCE))
    found = map_coordinates(_thresholds(), np.stack([one.ravel() for one in places]), order=1, mode="nearest")
    return np.asarray(found.reshape(row.shape))


def _place(values: FloatArray, nodes: FloatArray) -> FloatArray:
    return np.asarray((values - nodes[0]) / (nodes[1] - nodes[0]))


def independent_places(threshold: ArrayLike, false_alarm_rate: float) -> FloatArray:
    """Number of independent places whose largest value exceeds `threshold` in `false_alarm_rate` of the images."""
    from scipy.special import log_ndtr

    return np.asarray(np.log1p(-false_alarm_rate) / log_ndtr(np.asarray(threshold, float)))

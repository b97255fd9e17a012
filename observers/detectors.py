"""Detectability of a known signal in known noise by linear observers, from spectra alone.

With s(f) the signal's spectrum and S(f) the power of the noise (variance where it is white), sums over the frequencies of a patch:

| detector | template w | d'^2 = (w s)^2 / (w S w) |
|---|---|---|
| ideal | s / S | sum \\|s\\|^2 / S: prewhitening, no linear observer does better |
| hotelling | best weights of ten channels | v K^-1 v, v = U s, K = U S U |
| npw | s | (sum \\|s\\|^2)^2 / sum \\|s\\|^2 S: matched filter, noise taken as white |
| npwe | E^2 s | (sum E^2 \\|s\\|^2)^2 / sum E^4 \\|s\\|^2 S: the same behind an eye filter E |

Source: ICRU Report 54 (1996); Barrett & Myers, Foundations of Image Science (2004), ch. 13; Burgess, J. Opt. Soc. Am. A 11 (1994)
1237 (eye filter); Abbey & Barrett, J. Opt. Soc. Am. A 18 (2001) 473 (difference-of-Gaussian channels).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from .frequencies import FrequencyBins

FloatArray = NDArray[np.float64]

# display pixels of 0.25 mm at half a metre: 8.73 mm, 35 of them, a degree
PIXELS_PER_DEGREE = 35.0
_EYE_DEGREE = 0.25  # E = f exp(-b f) is largest at 1 / b = 4 cycles a degree
_CHANNELS = 10
_FIRST_CHANNEL = 0.005  # cycles per pixel, of the dense set of Abbey & Barrett
_CHANNEL_RATIO = 1.4
_CHANNEL_WIDTH = 1.67


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detectability:
    """Fields, each of the shape of the tasks (...): d_squared, no unit; row_correlation, column_correlation: of what the template
    leaves of the noise, between neighbouring pixels along rows and along columns."""

    d_squared: FloatArray
    row_correlation: FloatArray
    column_correlation: FloatArray


Detector = Callable[[FloatArray, FloatArray, FloatArray, FrequencyBins], Detectability]


def _correlations(output_power: FloatArray, bins: FrequencyBins) -> tuple[FloatArray, FloatArray]:
    total = np.maximum(output_power.sum(axis=-1), 1e-300)
    row, column = (output_power @ np.cos(2 * math.pi * frequency) / total for frequency in (bins.row, bins.column))
    return row, column


def detect_ideal(energy: FloatArray, amplitude: FloatArray, power: FloatArray, bins: FrequencyBins) -> Detectability:
    """d' of the ideal linear (prewhitening) observer; see the module.

    Args:
        energy: (..., bin) |s|^2 summed in the bins.
        amplitude: (..., bin) Re s, not needed here.
        power: (..., bin) of the noise, mean in the bins.
        bins: the frequencies.
    """
    output = energy / power
    return Detectability(d_squared=output.sum(axis=-1), **_named(_correlations(output, bins)))


def _named(found: tuple[FloatArray, FloatArray]) -> dict[str, FloatArray]:
    return {"row_correlation": found[0], "column_correlation": found[1]}


def detect_npw(energy: FloatArray, amplitude: FloatArray, power: FloatArray, bins: FrequencyBins) -> Detectability:
    """d' of the non-prewhitening matched filter; arguments as of `detect_ideal`."""
    return _filtered(energy, power, bins, np.ones_like(bins.row))


def detect_npwe(energy: FloatArray, amplitude: FloatArray, power: FloatArray, bins: FrequencyBins) -> Detectability:
    """d' of the non-prewhitening filter behind the eye's, E = f exp(-0.25 f), f in cycles per degree at 35 pixels a degree."""
    return _filtered(energy, power, bins, eye_filter(np.hypot(bins.row, bins.column)))


def eye_filter(frequency: FloatArray) -> FloatArray:
    """Contrast sensitivity of the eye (of the shape of `frequency`, cycles per pixel), 1 at its largest.

    E = f exp(-b f) with f in cycles per degree, at 35 pixels a degree, and b = 0.25 degree. Source: ICRU Report 54; Burgess 1994.
    """
    per_degree = frequency * PIXELS_PER_DEGREE
    return np.asarray(per_degree * _EYE_DEGREE * np.exp(1.0 - _EYE_DEGREE * per_degree))


def _filtered(energy: FloatArray, power: FloatArray, bins: FrequencyBins, eye: FloatArray) -> Detectability:
    seen = energy * eye**2
    output = seen * eye**2 * power
    noise = np.maximum(output.sum(axis=-1), 1e-300)
    return Detectability(d_squared=seen.sum(axis=-1) ** 2 / noise, **_named(_correlations(output, bins)))


def channels(bins: FrequencyBins) -> FloatArray:
    """Difference-of-Gaussian channels (channel, bin), dense set of Abbey & Barrett 2001.

    C_j = exp(-(f / (Q s_j))^2 / 2) - exp(-(f / s_j)^2 / 2), s_j = 0.005 1.4^j cycles per pixel, Q = 1.67, j = 1 to 10.
    """
    frequency = np.hypot(bins.row, bins.column)
    width = _FIRST_CHANNEL * _CHANNEL_RATIO ** np.arange(1, _CHANNELS + 1)[:, None]
    return np.asarray(
        np.exp(-0.5 * (frequency / (_CHANNEL_WIDTH * width)) ** 2) - np.exp(-0.5 * (frequency / width) ** 2)
    )


def detect_hotelling(
    energy: FloatArray, amplitude: FloatArray, power: FloatArray, bins: FrequencyBins
) -> Detectability:
    """d' of the channelised Hotelling observer with difference-of-Gaussian channels; arguments as of `detect_ideal`."""
    through = channels(bins)
    response = amplitude @ through.T
    weighted = power * bins.share
    covariance = np.einsum("ib,...b,jb->...ij", through, weighted, through, optimize=True)
    # channels that overlap leave a matrix that is nearly singular
    covariance += 1e-9 * np.trace(covariance, axis1=-2, axis2=-1)[..., None, None] * np.eye(len(through)) / len(through)
    weights = np.linalg.solve(covariance, response[..., None])[..., 0]
    output = (weights @ through) ** 2 * weighted
    return Detectability(d_squared=np.sum(response * weights, axis=-1), **_named(_correlations(output, bins)))


DETECTORS: MappingProxyType[str, Detector] = MappingProxyType(
    {"ideal": detect_ideal, "hotelling": detect_hotelling, "npw": detect_npw, "npwe": detect_npwe}
)

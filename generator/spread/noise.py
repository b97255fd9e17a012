"""Noise of a detector frame, drawn in its physical order: quanta, spread, signal-following white noise, electronics.

Everything is above dark and in DN. The quantum part is drawn on a frame larger than the image by the reach of the
spread, so that the borders have the variance and the correlation of the middle.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import InputError
from .psf import Spread, convolve_separable


def sample_correlated_quanta(
    variance_DN2: NDArray[np.floating],
    step_DN: NDArray[np.floating] | float,
    *,
    spread: Spread,
    rng: np.random.Generator,
    kernel: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:
    """Zero-mean quantum noise after the optical spread (row, column), DN.

    Counts are Poisson of mean variance / step^2 and each count is worth `step`, so before the spread the variance is
    `variance_DN2` and the third cumulant variance x step; the spread then multiplies the variance of a pixel by
    sum(h^2) and correlates neighbours.

    Args:
        variance_DN2: variance before the spread (row, column), DN^2, 0 or more.
        step_DN: DN a quantum (row, column) or one number, above 0.
        spread: see generator.spread.psf.
        rng: source of randomness.
        kernel: in place of the calibrated spread's, (2 R + 1,) per axis or (2 R + 1, 2 R + 1).

    Raises:
        InputError: negative or NaN variance, a step of 0 or less.
    """
    variance = np.asarray(variance_DN2, dtype=np.float64)
    step = np.broadcast_to(np.asarray(step_DN, dtype=np.float64), variance.shape)
    if not np.all(variance >= 0):
        raise InputError("quantum variance", received=float(np.nanmin(variance)), expected="0 DN^2 or more everywhere")
    if not np.all(step > 0):
        raise InputError("DN a quantum", received=float(np.nanmin(step)), expected="above 0 DN everywhere")
    taps = spread.noise_kernel if kernel is None else kernel
    reach = len(taps) // 2
    mean = np.pad(variance / step**2, reach, mode="edge")
    counts = rng.poisson(mean)
    wide = ((counts - mean) * np.pad(step, reach, mode="edge")).astype(np.float32)
    return spread_inside(wide, taps)


def spread_inside(wide: NDArray[np.floating], kernel: NDArray[np.floating]) -> NDArray[np.float32]:
    """`wide` (row + 2 R, column + 2 R) convolved with a kernel of reach R, per axis or whole: (row, column)."""
    reach = len(kernel) // 2
    if kernel.ndim == 1:
        spread: NDArray[np.floating] = convolve_separable(wide, kernel, mode="constant")
    else:
        from scipy.signal import oaconvolve

        spread = oaconvolve(wide, kernel, mode="same")
    inner = slice(reach, -reach) if reach else slice(None)
    return np.asarray(spread[inner, inner], dtype=np.float32)


def sample_frame_noise(
    signal_DN: NDArray[np.floating],
    *,
    gain_DN: ArrayLike,
    gain_relative: NDArray[np.floating] | float = 1.0,
    white_fraction: NDArray[np.floating] | float,
    read_variance_DN2: ArrayLike,
    spread: Spread,
    rng: np.random.Generator,
    quantum_share: float = 1.0,
    third_cumulant_share: float = 1.0,
    read_share: float = 1.0,
    kernel: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:
    """Zero-mean noise of a frame of mean `signal_DN`, or the named shares of it (row, column), DN.

    variance before the spread = quantum_share x gain x signal, of which white_fraction / (1 + white_fraction) is white.

    Args:
        signal_DN: mean above dark (row, column), DN; negative values count as 0.
        gain_DN: variance per signal with the spread's share restored, one number or (row, column), DN.
        gain_relative: the pixel's own gain over the detector median.
        white_fraction: signal-following white variance over quantum variance before the spread, one number or (row, column).
        read_variance_DN2: electronic variance, one number or (row, column), DN^2.
        quantum_share, third_cumulant_share, read_share: shares of the variance, of the third cumulant and of the
            electronic variance to draw; all 1 for a frame from scratch, less for a top-up.
        rng: source of randomness.
        kernel: see `sample_correlated_quanta`.
    """
    relative = np.asarray(gain_relative, dtype=np.float64)
    quanta_signal = np.clip(np.asarray(signal_DN, dtype=np.float64), 0.0, None) / relative
    gain = np.asarray(gain_DN, dtype=np.float64)
    total = quantum_share * gain * quanta_signal
    step = gain * (third_cumulant_share / quantum_share if quantum_share > 0 else 1.0)
    noise = sample_correlated_quanta(
        total / (1.0 + white_fraction), step, spread=spread, rng=rng, kernel=kernel
    ) * relative.astype(np.float32)
    white = relative**2 * total * (white_fraction / (1.0 + white_fraction))
    white = white + read_share * np.asarray(read_variance_DN2, dtype=np.float64)
    scale = np.sqrt(np.clip(white, 0.0, None)).astype(np.float32)
    return np.asarray(noise + scale * rng.standard_normal(signal_DN.shape, dtype=np.float32))


def digitise(
    counts_DN: NDArray[np.floating], *, bits: int | None, quantised: bool, averaged: int = 1
) -> NDArray[np.float32]:
    """Round to the ADC's steps (1/averaged DN for averaged frames) and clip to its range (row, column), DN."""
    result = np.asarray(counts_DN, dtype=np.float64)
    if quantised:
        result = np.rint(result * averaged) / averaged
    highest = math.inf if bits is None else float(2**bits - 1)
    return np.clip(result, 0.0 if quantised else -math.inf, highest).astype(np.float32)

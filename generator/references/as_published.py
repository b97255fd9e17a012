"""The paper's recipe for a noisy image, kept as the baseline that everything else is compared with.

Its order and constants: one gain for both tube voltages, full noise on top of the reference's own, and one Gaussian blur last,
over signal, quantum noise and electronic noise alike. The width of the noise autocovariance is read as that of the blur, and
gain and electronic noise are first raised by its continuous noise-equivalent area, 4 pi sigma^2, so that the noise of one
pixel comes out as measured.

Source: Andriiashen et al., X-ray Image Generation as a Method of Performance Prediction for Real-Time Inspection, Eq. 5-6
and the calibration section; order and constants where the text is silent: the authors' code, pod2settings (generator).
"""

import math

import numpy as np
from numpy.typing import NDArray

from ..line.twin import Twin
from ..spread.psf import convolve_separable, sampled_gaussian_1d


def published_parameters(twin: Twin) -> dict[str, float]:
    """Gain (DN), read noise (DN) and blur (px) as the paper's calibration would have read them from the same flats.

    The gain is the photon-transfer slope of the first level, for every level, times 4 pi blur^2; the read noise is that of
    the twin times 2 sqrt(pi) blur; the blur is the width of the autocovariance, sqrt(2) times that of the optical spread.
    Without blur the measured slope and noise stand as they are.
    """
    blur = math.sqrt(2.0) * twin.noise.spread.value.sigma_px
    area = 4.0 * math.pi * blur**2 if blur > 0 else 1.0
    return {
        "gain_DN": twin.levels[0].photon_transfer_slope_DN.value * area,
        "read_noise_DN": math.sqrt(twin.noise.read_variance_DN2 * area),
        "blur_px": blur,
    }


def sample_as_published(
    signal_DN: NDArray[np.floating],
    *,
    gain_DN: float,
    read_noise_DN: float,
    blur_px: float,
    dark_DN: NDArray[np.floating],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Counts with dark (row, column), DN: dark + (Poisson(I / g) g + N(0, sigma_e)) convolved with a Gaussian.

    The dark is a fixed pattern that the correction takes off again, so it is not blurred.

    Args:
        signal_DN: mean above dark from the reference (row, column), DN.
        gain_DN, read_noise_DN, blur_px: see `published_parameters`.
        dark_DN: dark frame (row, column), DN.
        rng: source of randomness.
    """
    quanta = rng.poisson(np.clip(signal_DN, 0.0, None) / gain_DN) * gain_DN
    noisy = quanta + read_noise_DN * rng.standard_normal(signal_DN.shape)
    kernel = sampled_gaussian_1d(blur_px, max(1, math.ceil(4 * blur_px)))
    return convolve_separable(noisy.astype(np.float32), kernel, mode="reflect") + np.asarray(dark_DN, dtype=np.float32)

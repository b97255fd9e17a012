"""The optical spread of the detector, and the correlation it leaves in the noise.

Two descriptions of a Gaussian spread of width sigma exist in the field, and below one pixel they differ:

- `aperture`: quanta land anywhere in a pixel, their light spreads as a continuous Gaussian, square pixels collect it.
  This is what a scintillator on a pixel array does. Autocovariance per axis: triangle * Gaussian(sqrt(2) sigma).
- `sampled`: quanta are counted per pixel first and the counts are then convolved with a Gaussian sampled at the pixel
  centres. Many simulators do this. Autocovariance: the discrete kernel with itself.

All arrays here are per unit variance before the spread: a kernel sums to 1, and so does an autocovariance.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

PSF_MODELS = ("aperture", "sampled")


def _check(model: str, sigma_px: float) -> None:
    if model not in PSF_MODELS:
        raise InputError("psf model", received=model, expected="one of " + ", ".join(PSF_MODELS))
    if not (math.isfinite(sigma_px) and sigma_px >= 0):
        raise InputError("psf_sigma_px", received=f"{sigma_px} px", expected="a finite width of 0 px or more")


def sampled_gaussian_1d(sigma_px: float, radius: int) -> NDArray[np.float64]:
    """Gaussian sampled at -radius..radius (2 radius + 1,), normalised to sum 1."""
    position = np.arange(-radius, radius + 1)
    if sigma_px < 1e-6:
        return np.asarray(position == 0, dtype=np.float64)
    weight = np.exp(-0.5 * (position / sigma_px) ** 2)
    return np.asarray(weight / weight.sum(), dtype=np.float64)


def noise_autocovariance_1d(model: str, sigma_px: float, radius: int) -> NDArray[np.float64]:
    """Autocovariance of unit white quanta after the spread at lags 0..radius (radius + 1,), one axis; no unit.

    Notes:
        `aperture`: integral of (1 - |u - k|)+ times a Gaussian of width sqrt(2) sigma, in closed form.
        `sampled`: sum_j h_j h_(j+k).

    Checked against: numerical quadrature and Monte Carlo, tests/test_generator_psf.py.
    """
    _check(model, sigma_px)
    lag = np.arange(radius + 1, dtype=np.float64)
    if model == "sampled":
        reach = radius + max(3, math.ceil(6 * sigma_px))
        kernel = sampled_gaussian_1d(sigma_px, reach)
        full = np.convolve(kernel, kernel)
        return np.asarray(full[2 * reach : 2 * reach + radius + 1])
    width = math.sqrt(2.0) * sigma_px
    if width < 1e-6:
        return np.asarray(lag == 0, dtype=np.float64)
    from scipy.special import ndtr

    def second_integral(position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integral of the integral of a Gaussian of this width."""
        scaled = position / width
        density = np.exp(-0.5 * scaled**2) / math.sqrt(2 * math.pi)
        return np.asarray(width * (scaled * ndtr(scaled) + density))

    # the triangle's second derivative is delta(-1) - 2 delta(0) + delta(1)
    return second_integral(lag + 1) - 2 * second_integral(lag) + second_integral(lag - 1)


def noise_autocovariance(model: str, sigma_px: float, radius: int) -> NDArray[np.float64]:
    """Autocovariance of unit white quanta after the spread (2 radius + 1, 2 radius + 1), lag 0 in the centre."""
    half = noise_autocovariance_1d(model, sigma_px, radius)
    full = np.concatenate([half[:0:-1], half])
    return np.asarray(np.outer(full, full))


def blur_variance_share(model: str, sigma_px: float) -> float:
    """Share of the quantum variance that the spread leaves in one pixel: sum(h^2) of the discrete kernel; no unit.

    0.125 for a sampled Gaussian of 0.8 px, 0.41 for 0.5 px; the continuous 1/(4 pi sigma^2) is 29 % off at 0.5 px.
    """
    return float(noise_autocovariance_1d(model, sigma_px, 0)[0] ** 2)


@lru_cache(maxsize=64)
def _noise_kernel_1d(model: str, sigma_px: float, radius: int) -> NDArray[np.float64]:
    if model == "sampled":
        kernel = sampled_gaussian_1d(sigma_px, radius)
    else:
        # symmetric root of the noise power of the sampled pattern
        size = 512
        half = noise_autocovariance_1d(model, sigma_px, size // 2)
        circular = np.concatenate([half, half[-2:0:-1]])
        power = np.clip(np.fft.fft(circular).real, 0.0, None)
        impulse = np.fft.fftshift(np.fft.ifft(np.sqrt(power)).real)
        kernel = impulse[size // 2 - radius : size // 2 + radius + 1]
        kernel = kernel / kernel.sum()
    kernel.flags.writeable = False
    return kernel


def noise_kernel_1d(model: str, sigma_px: float) -> NDArray[np.float64]:
    """Kernel per axis (2 R + 1,) that gives white noise the autocovariance of quanta after the spread; sums to 1.

    For `sampled` it is the spread itself. For `aperture` it is the symmetric root of the autocovariance: white noise
    drawn per pixel and convolved with it has the covariance of quanta that land anywhere in the pixel.
    """
    _check(model, sigma_px)
    radius = max(7, math.ceil(5 * sigma_px) + 4)
    return _noise_kernel_1d(model, float(sigma_px), radius)


@lru_cache(maxsize=64)
def noise_coupling(model: str, sigma_px: float) -> float:
    """sum(h^2 rho) / sum(h^3), h the noise kernel and rho its autocovariance: 1 without spread; no unit.

    By this factor the third moment grows when noise is drawn in proportion to a signal that carries noise of the same
    spread: E[r n^2] = gain x Var(r before the spread) x sum(h^2 rho).
    """
    kernel = noise_kernel_1d(model, sigma_px)
    half = noise_autocovariance_1d(model, sigma_px, len(kernel) // 2)
    rho = np.concatenate([half[:0:-1], half])
    return float((np.sum(kernel**2 * rho) / np.sum(kernel**3)) ** 2)


def optical_kernel_1d(model: str, sigma_px: float) -> NDArray[np.float64]:
    """Kernel per axis (2 R + 1,) by which the spread blurs a signal already averaged over pixels; sums to 1.

    The pixel's own aperture is in the signal's pixel averages, so for both descriptions this is the Gaussian averaged
    over pixel positions (`aperture`) or sampled at them (`sampled`).
    """
    _check(model, sigma_px)
    radius = max(3, math.ceil(5 * sigma_px) + 1)
    if model == "sampled" or sigma_px < 1e-6:
        return sampled_gaussian_1d(sigma_px, radius)
    from scipy.special import ndtr

    edge = np.arange(-radius, radius + 2) - 0.5
    kernel = np.diff(ndtr(edge / sigma_px))
    return np.asarray(kernel / kernel.sum())


def convolve_separable(
    image: NDArray[np.floating], kernel_1d: NDArray[np.floating], *, mode: str = "nearest"
) -> NDArray[np.float32]:
    """`image` (..., row, column) convolved with `kernel_1d` along rows and columns; borders by scipy's `mode`."""
    from scipy.ndimage import correlate1d

    result = np.asarray(image, dtype=np.float32)
    for axis in (-2, -1):
        result = correlate1d(result, kernel_1d, axis=axis, mode=mode)
    return np.asarray(result)

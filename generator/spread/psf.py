"""The optical spread of the detector, and the correlation it leaves in the noise.

Transfer function along rows and columns (f in cycles per pixel):

    H(f) = (1 - w) exp(-2 pi^2 sigma^2 q) + w / (1 + (2 pi L)^2 q)^p,    q = a f_row^2 + f_column^2 / a

sigma: width of the Gaussian core; w: share of the light in a tail of reach L; p: its order, 1 for the Lorentzian transfer of
screens, 3/2 for light that falls off as exp(-r / L). Order 0 stands for a layer in which light diffuses and is absorbed, a
distance L from the pixels: exp(-L (sqrt((2 pi)^2 q + k^2) - k)), k the inverse of the length over which it is absorbed. Without
absorption that is light which falls off as (r^2 + L^2)^(-3/2), of a point behind a clear layer; with it as exp(-k r) far away.
a: width along rows over width along columns. With w = 0 and a = 1 it is the Gaussian of most simulators, which factors into two
axes. A line camera takes its lines one after another, so that no light gets from one to the next: f across the lines is 0 then.

Two descriptions of how quanta meet pixels exist in the field, and below one pixel they differ:

- `aperture`: quanta land anywhere in a pixel, their light spreads as a continuous Gaussian, square pixels collect it.
  This is what a scintillator on a pixel array does. Autocovariance per axis: triangle * Gaussian(sqrt(2) sigma).
- `sampled`: quanta are counted per pixel first and the counts are then convolved with a Gaussian sampled at the pixel
  centres. Many simulators do this. Autocovariance: the discrete kernel with itself.

All arrays here are per unit variance before the spread: a kernel sums to 1, and so does an autocovariance.

Source: tails of screens: Burgess (1978), doi:10.1118/1.594387; diffusion with absorption: Swank, Appl. Opt. 12 (1973) 1865,
of which this is one distance to the pixels and nothing sent back.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError

PSF_MODELS = ("aperture", "sampled")
AXES = ("both", "row", "column")  # index along which light spreads; one where the other counts lines of a line camera
LAYER = 0.0  # order of the tail that a layer makes
FloatArray = NDArray[np.float64]
_GRID = 64  # cells of the noise power spectrum per axis
_REACH = 14  # of a kernel over both axes, px
_ALIASES = 3  # spectra on either side that a tail and a pixel's aperture still let through: 1e-5 of the power


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """The optical spread: `model` (`aperture` or `sampled`), sigma_px, aspect, tail_share, tail_px, tail_order,
    absorption_per_px, which only a layer's tail has (see the module), and axes (`both`; `row` or `column`: the index along
    which light spreads, where the other counts lines that were taken one after another).

    Example:
        >>> Spread(sigma_px=0.5).variance_share < Spread(sigma_px=0.3).variance_share
        True
    """

    model: str = "aperture"
    sigma_px: float = 0.0
    aspect: float = 1.0
    tail_share: float = 0.0
    tail_px: float = 1.0
    tail_order: float = 1.0
    absorption_per_px: float = 0.0
    axes: str = "both"

    def __post_init__(self) -> None:
        _check(self.model, self.sigma_px)
        if self.axes not in AXES:
            raise InputError("axes of the optical spread", received=self.axes, expected="one of " + ", ".join(AXES))
        bounds = {
            "aspect": (0.1, 10.0),
            "tail_share": (0.0, 1.0),
            "tail_px": (0.0, 1000.0),
            "tail_order": (0.0, 100.0),
            "absorption_per_px": (0.0, 1000.0),
        }
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(
                    f"{name} of the optical spread",
                    received=f"{getattr(self, name):g}",
                    expected=f"{low:g} to {high:g}",
                )

    @property
    def separable(self) -> bool:
        """Whether it is one Gaussian, alike along both axes, so that kernels factor into one per axis."""
        return self.aspect == 1.0 and self.tail_share == 0.0 and self.axes == "both"

    @property
    def reach_px(self) -> int:
        """Beyond this lag pixels' noise is independent to some 1e-6, px."""
        widest = self.sigma_px * math.sqrt(max(self.aspect, 1.0 / self.aspect))
        return max(3, math.ceil(6.0 * widest) + 2, math.ceil(12.0 * self.tail_px) if self.tail_share > 0 else 0)

    def transfer(self, f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        """Transfer function, frequencies in cycles per pixel that broadcast; 1 at 0."""
        if self.axes != "both":
            f_row, f_column = (
                f if self.axes == axis else np.zeros_like(f) for f, axis in ((f_row, "row"), (f_column, "column"))
            )
        if self.separable:
            return np.asarray(
                base_transfer_1d(self.model, self.sigma_px, f_row)
                * base_transfer_1d(self.model, self.sigma_px, f_column)
            )
        wide, narrow = math.sqrt(self.aspect), 1.0 / math.sqrt(self.aspect)
        core = base_transfer_1d(self.model, self.sigma_px * wide, f_row) * base_transfer_1d(
            self.model, self.sigma_px * narrow, f_column
        )
        if self.tail_share == 0.0:
            return np.asarray(core)
        square = self.aspect * f_row**2 + f_column**2 / self.aspect
        tail = _tail_transfer(self, square)
        return np.asarray((1.0 - self.tail_share) * core + self.tail_share * tail)

    def noise_power(self, cells: int = _GRID) -> FloatArray:
        """Power of unit white quanta after spread and sampling, (cells/2 + 1, cells/2 + 1) frequencies 0 to 1/2.

        `aperture`: sum over aliases of |H sinc|^2. `sampled`: |H|^2 of counts per pixel. Its value at 0 is 1.
        """
        return _noise_power(self, cells)

    def noise_autocovariance(self, radius: int) -> FloatArray:
        """Autocovariance of unit white quanta after the spread (2 radius + 1, 2 radius + 1), lag 0 in the centre."""
        if self.separable:
            return noise_autocovariance(self.model, self.sigma_px, radius)
        cells = max(_GRID, 4 * radius)
        full = np.fft.fftshift(np.fft.ifft2(whole_spectrum(self.noise_power(cells))).real)
        middle = slice(cells // 2 - radius, cells // 2 + radius + 1)
        return np.asarray(full[middle, middle])

    @property
    def variance_share(self) -> float:
        """Share of the quantum variance that the spread leaves in one pixel; no unit."""
        if self.separable:
            return blur_variance_share(self.model, self.sigma_px)
        return float(self.noise_autocovariance(0)[0, 0])

    def binned_variance_share(self, binning: int) -> float:
        """Variance of the mean of b x b pixels, times b^2, over the quantum variance before the spread; no unit.

        sum over lags of (b - |k|)(b - |l|) rho(k, l) / b^2: neighbours are correlated, so averaging gains less than b^2.
        """
        rho = self.noise_autocovariance(binning - 1)
        weight = binning - np.abs(np.arange(1 - binning, binning, dtype=np.float64))
        return float(weight @ rho @ weight) / binning**2

    @property
    def noise_kernel(self) -> FloatArray:
        """Kernel that gives white noise the autocovariance of quanta after the spread; sums to 1.

        (2 R + 1,) per axis where `separable`, else (2 R + 1, 2 R + 1).
        """
        if self.separable:
            return noise_kernel_1d(self.model, self.sigma_px)
        return _root_kernel(self)

    @property
    def noise_coupling(self) -> float:
        """sum(h^2 rho) / sum(h^3) of the noise kernel h and its autocovariance rho, see `noise_coupling`; no unit."""
        if self.separable:
            return noise_coupling(self.model, self.sigma_px)
        kernel = self.noise_kernel
        rho = self.noise_autocovariance(kernel.shape[0] // 2)
        return float(np.sum(kernel**2 * rho) / np.sum(kernel**3))


def _tail_transfer(spread: Spread, square: FloatArray) -> FloatArray:
    """Of a tail, at squared frequencies q (see the module)."""
    reach = 2.0 * np.pi * spread.tail_px
    if spread.tail_order == LAYER:
        absorbed = spread.absorption_per_px * spread.tail_px
        return np.asarray(np.exp(absorbed - np.sqrt(reach**2 * square + absorbed**2)))
    fallen = 1.0 + reach**2 * square
    if spread.tail_order == 1.5:
        return np.asarray(1.0 / (fallen * np.sqrt(fallen)))  # a general power takes several times as long
    return np.asarray(fallen**-spread.tail_order)


@lru_cache(maxsize=64)
def _noise_power(spread: Spread, cells: int) -> FloatArray:
    if spread.axes != "both":
        line = np.broadcast_to(_power_of_line(spread, cells), (cells // 2 + 1, cells // 2 + 1))
        return line if spread.axes == "column" else line.T
    of_core, of_both, of_tail = _parts_of_power(
        replace(spread, tail_share=1.0 if spread.tail_share > 0.0 else 0.0), cells
    )
    power = of_core
    if spread.tail_share > 0.0:
        core, tail = 1.0 - spread.tail_share, spread.tail_share
        power = core**2 * of_core + 2.0 * core * tail * of_both + tail**2 * of_tail
    power.flags.writeable = False
    return power


@lru_cache(maxsize=64)
def _parts_of_power(spread: Spread, cells: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Power of the core, of core and tail together, and of the tail (cells/2 + 1, cells/2 + 1), which any share of the tail has in
    common; of a spread without a tail the core's alone, three times."""
    widths = (spread.sigma_px * math.sqrt(spread.aspect), spread.sigma_px / math.sqrt(spread.aspect))
    of_core = np.outer(*(_power_of_gaussian(spread.model, float(width), cells) for width in widths))
    if spread.tail_share == 0.0:
        return of_core, of_core, of_core
    # a core of no width: what other cores have in common
    light, of_tail = _light_of_tail(replace(spread, sigma_px=0.0), cells)
    along_rows, along_columns = (
        base_transfer_1d(spread.model, width, _aliases(spread.model, cells)) for width in widths
    )
    kept = cells // 2 + 1
    # the sum over aliases as in `_folded`, one axis after the other
    folded = np.einsum("fka,ka->fk", light.reshape(len(light), kept, -1), along_columns.reshape(kept, -1))
    of_both = np.einsum("kaf,ka->kf", folded.reshape(kept, -1, kept), along_rows.reshape(kept, -1))
    return of_core, of_both, of_tail


def _power_of_line(spread: Spread, cells: int) -> FloatArray:
    """Power of unit quanta whose light spreads along one axis, at 0 .. 1/2 of it (cells/2 + 1,)."""
    width = spread.sigma_px * (math.sqrt(spread.aspect) if spread.axes == "row" else 1.0 / math.sqrt(spread.aspect))
    power = _power_of_gaussian(spread.model, width, cells)
    if spread.tail_share == 0.0:
        return power
    core, tail = 1.0 - spread.tail_share, spread.tail_share
    every = _aliases(spread.model, cells)
    of_core = base_transfer_1d(spread.model, width, every)
    of_tail = _tail_transfer(spread, every**2 * (spread.aspect if spread.axes == "row" else 1.0 / spread.aspect))
    collected = np.sinc(every) ** 2 if spread.model == "aperture" else np.ones_like(every)
    with_tail = collected * tail * of_tail * (2.0 * core * of_core + tail * of_tail)
    return np.asarray(core**2 * power + with_tail.reshape(len(power), -1).sum(axis=1))


@lru_cache(maxsize=8)
def _light_of_tail(tail: Spread, cells: int) -> tuple[FloatArray, FloatArray]:
    """Transfer of a tail times what the pixel lets through, at all aliases along both axes, and the power of the tail alone."""
    every = _aliases(tail.model, cells)
    transfer = _tail_transfer(tail, tail.aspect * every[:, None] ** 2 + every[None, :] ** 2 / tail.aspect)
    aperture = np.outer(np.sinc(every), np.sinc(every)) ** 2 if tail.model == "aperture" else np.ones_like(transfer)
    light = transfer * aperture
    return light, _folded(light * transfer, cells)


@lru_cache(maxsize=16)
def _aliases(model: str, cells: int) -> FloatArray:
    """Frequencies that fall on 0 .. 1/2 along one axis, those of one after the other."""
    order = np.arange(-_ALIASES, _ALIASES + 1) if model == "aperture" else np.zeros(1)
    return np.asarray((np.arange(cells // 2 + 1)[:, None] / cells + order).ravel())


def _folded(power: FloatArray, cells: int) -> FloatArray:
    """The sum over aliases (cells/2 + 1, cells/2 + 1)."""
    kept = cells // 2 + 1
    return np.asarray(power.reshape(kept, len(power) // kept, kept, -1).sum(axis=(1, 3)))


@lru_cache(maxsize=256)
def _power_of_gaussian(model: str, sigma_px: float, cells: int) -> FloatArray:
    """Power of unit quanta after a Gaussian spread at 0 .. 1/2 (cells/2 + 1,), one axis."""
    half = noise_autocovariance_1d(model, sigma_px, cells // 2)
    # where a wide spread leaves nothing, rounding and the end of the lags leave -1e-16 (2 px) to -3e-6 (5 px)
    power = np.maximum(np.fft.fft(np.concatenate([half, half[-2:0:-1]])).real[: half.size], 0.0)
    power.flags.writeable = False
    return power


def whole_spectrum(quadrant: FloatArray) -> FloatArray:
    """A spectrum over all frequencies (n, n) from its quadrant 0 .. n/2, even along both axes."""
    whole = np.concatenate([quadrant, quadrant[-2:0:-1]], axis=0)
    return np.concatenate([whole, whole[:, -2:0:-1]], axis=1)


@lru_cache(maxsize=16)
def _root_kernel(spread: Spread) -> FloatArray:
    """Symmetric root of the noise power, cut at its reach and brought back to a sum of 1."""
    impulse = np.fft.fftshift(np.fft.ifft2(np.sqrt(whole_spectrum(spread.noise_power()))).real)
    middle = slice(_GRID // 2 - _REACH, _GRID // 2 + _REACH + 1)
    kernel = np.asarray(impulse[middle, middle] / impulse[middle, middle].sum())
    kernel.flags.writeable = False
    return kernel


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


def base_transfer_1d(psf_model: str, psf_sigma_px: float, frequency: FloatArray) -> FloatArray:
    """Transfer function of a Gaussian spread along one axis, frequency in cycles per pixel."""
    if psf_model == "sampled":
        reach = max(3, math.ceil(6 * psf_sigma_px))
        kernel = sampled_gaussian_1d(psf_sigma_px, reach)[reach:]
        steps = np.arange(reach + 1)
        return np.asarray(np.cos(2 * np.pi * frequency[..., None] * steps) @ np.where(steps == 0, kernel, 2 * kernel))
    return np.asarray(np.exp(-2.0 * (np.pi * psf_sigma_px * frequency) ** 2))


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

"""Neighbour covariances of the noise, from frame differences, and the fit of the optical spread to them.

The noise autocovariance is h * h, sqrt(2) wider than the optical spread h; reading its width as that of h is the
commonest mistake. Summed over neighbours it gives the gain whatever h is.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from ..generator.psf import PSF_MODELS, noise_autocovariance
from .frame_sums import effective_frames

# White noise proportional to signal beside the quanta (secondary quanta): 1/K of the quantum variance for K electrons a
# quantum, K = 100-1000; the width leaves room for other white noise that follows the signal.
WHITE_FRACTION_PRIOR = (0.003, 0.03)
POOR_FIT = 2.0  # chi-square a degree of freedom above which a Gaussian spread is not believed
# In chi-square: light collected in square pixels is what detectors do, so quanta counted first must fit clearly better.
MODEL_PENALTY = {"aperture": 0.0, "sampled": 4.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseCovariance:
    """Temporal noise autocovariance of one series, one frame, averaged over good pixels.

    Fields: covariance_DN2 (2 R + 1, 2 R + 1), lag 0 in the centre, symmetric; samples: independent frames x pixels that
    carry the same information; signal_DN: mean signal above dark over the same pixels; common_mode: variance of the
    factor that a whole frame shares, relative to the signal (0 where it does not stand out of the pixels' own noise);
    pair_share (2 R + 1, 2 R + 1): pairs of good pixels at each lag over pixels, less than 1 because frames end.
    """

    covariance_DN2: NDArray[np.float64]
    samples: float
    signal_DN: float
    common_mode: float
    pair_share: NDArray[np.float64]

    @property
    def radius(self) -> int:
        """Largest lag R, px."""
        return int(self.covariance_DN2.shape[0]) // 2


def compute_noise_covariance(
    pieces: Iterable[NDArray[Any]],
    *,
    signal_DN: NDArray[np.float64],
    good: NDArray[np.bool_],
    radius: int,
    about: tuple[NDArray[np.float64], int] | None = None,
) -> NoiseCovariance:
    """Autocovariance of the noise of one frame from successive differences, DN^2.

    C(o) = mean over pixels r of d(r) d(r + o) / 2 for d = x_(i+1) - x_i, after the part of d that is proportional to
    the signal (one common factor a frame: tube output) or, without signal, its mean is projected out; the share of the
    covariance that this projection takes away is restored.

    Args:
        pieces: frames (m, row, column) in time order, DN; at least two frames in all.
        signal_DN: mean signal above dark (row, column), DN; zeros for darks.
        good: pixels to use (row, column).
        radius: largest lag, px.
        about: mean frame (row, column) and how many frames it is the mean of, N: deviations from it, d = x_i - mean with
            C(o) = mean of d(r) d(r + o) / (1 - 1/N), in place of successive differences.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2
    from scipy.special import chdtri

    rows, columns = good.shape
    size = (next_fast_len(rows + radius, real=True), next_fast_len(columns + radius, real=True))
    mask = good.astype(np.float64)
    pixels = int(good.sum())
    if pixels < (2 * radius + 1) ** 2:
        raise InputError(
            "good pixels",
            received=pixels,
            expected=f"at least {(2 * radius + 1) ** 2} for covariances up to {radius} px",
            remedy="use larger frames",
        )
    has_signal = bool(np.any(signal_DN[good] > 0))
    shape = np.where(good, signal_DN, 0.0) if has_signal else mask
    norm = float(np.sum(shape**2))
    power = np.zeros((size[0], size[1] // 2 + 1))
    count = 0
    factors: list[float] = []
    last: NDArray[np.float64] | None = None if about is None else about[0]
    for piece in pieces:
        for frame in piece:
            current = np.asarray(frame, dtype=np.float64)
            if last is not None:
                difference = np.where(good, current - last, 0.0)
                factor = float(np.sum(difference * shape)) / norm
                difference -= factor * shape
                spectrum = rfft2(difference, s=size)
                power += spectrum.real**2 + spectrum.imag**2
                factors.append(factor)
                count += 1
            last = current if about is None else last
    if count == 0 or (about is not None and about[1] < 2):
        raise InputError("frames", received="fewer than two frames", expected="at least two frames of one setting")
    window = np.ix_(np.arange(-radius, radius + 1) % size[0], np.arange(-radius, radius + 1) % size[1])
    single = 2.0 if about is None else 1.0 - 1.0 / about[1]  # variance of d over that of one frame
    products = irfft2(power, s=size)[window] / (single * count)
    coverage = rfft2(mask, s=size)
    neighbours = irfft2(coverage.real**2 + coverage.imag**2, s=size)[window]
    covariance = products / np.maximum(neighbours, 1.0)
    # the projection takes NPS(0) / N from every lag, NPS(0) being the sum over lags
    lags = covariance.size
    covariance = covariance + covariance.sum() / (1.0 - lags / pixels) / pixels
    covariance = 0.5 * (covariance + covariance[::-1, ::-1])
    signal = float(signal_DN[good].mean()) if has_signal else 0.0
    degrees = effective_frames(count + 1) if about is None else count * single
    common = 0.0
    if has_signal:
        # the pixels' own noise moves the factor too; what is left must stand out of that as in 1 of 1000 by chance
        own = float(covariance.sum()) / norm
        excess = float(np.mean(np.square(factors))) / single - own
        common = excess if excess > own * (float(chdtri(degrees, 1e-3)) / degrees - 1.0) else 0.0
    return NoiseCovariance(
        covariance_DN2=covariance,
        samples=degrees * pixels,
        signal_DN=signal,
        common_mode=common,
        pair_share=np.clip(neighbours / pixels, 1.0 / pixels, 1.0),
    )


def _half_plane(radius: int) -> list[tuple[int, int]]:
    """Lags (dy, dx) without their mirror images, lag 0 first."""
    lags = [(dy, dx) for dy in range(radius + 1) for dx in range(-radius, radius + 1) if dy > 0 or dx >= 0]
    return sorted(lags, key=lambda lag: (lag[0] ** 2 + lag[1] ** 2, lag))


def sampling_covariance(
    covariance_DN2: NDArray[np.float64], samples: float, radius: int, pair_share: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Covariance matrix (L, L) of estimated autocovariances at the half-plane lags up to `radius`, DN^4.

    For a stationary Gaussian field: Cov[C(o), C(p)] = sum_k [C(k) C(k + o - p) + C(k) C(k + o + p)] / N. `pair_share`
    (2 R' + 1, 2 R' + 1), lag 0 in the centre: how many pairs there are at a lag for each of N; the entries are divided by
    the root of the two lags' shares.

    Source: Bartlett, An Introduction to Stochastic Processes (1955), in two dimensions.
    """
    from scipy.fft import irfftn, next_fast_len, rfftn

    # sum_k C(k) C(k + s), s up to 2 R; importing scipy.signal for it would take longer
    rows, columns = (2 * length - 1 for length in covariance_DN2.shape)
    size = [next_fast_len(rows, real=True), next_fast_len(columns, real=True)]
    pair = irfftn(rfftn(covariance_DN2, size) * rfftn(covariance_DN2[::-1, ::-1], size), size)[:rows, :columns]
    centre = pair.shape[0] // 2
    padded = np.pad(pair, max(0, 2 * radius - centre))
    centre = padded.shape[0] // 2
    lags = np.array(_half_plane(radius))
    difference = lags[:, None, :] - lags[None, :, :]
    total = lags[:, None, :] + lags[None, :, :]
    matrix = (
        padded[centre + difference[..., 0], centre + difference[..., 1]]
        + padded[centre + total[..., 0], centre + total[..., 1]]
    )
    if pair_share is not None:
        middle = pair_share.shape[0] // 2
        root = np.sqrt(pair_share[middle + lags[:, 0], middle + lags[:, 1]])
        matrix = matrix / np.outer(root, root)
    return np.asarray(matrix / samples)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpreadFit:
    """Optical spread and gains fitted together to the noise covariances of several series.

    Fields: model (`aperture`, `sampled`); sigma_px, sigma_sd_px; gain_DN (group,): quantum and signal-following white
    variance per signal with the spread's share restored; gain_sd_DN; slope_DN (group,): variance of one pixel per
    signal; slope_sd_DN; white_fraction (group,): the white part over the quantum part; read_variance_DN2, read_sd_DN2;
    chi_square, degrees: of the fit; chi_square_other: the same of the other description of the spread; summed: gains and
    slopes are sums of covariances, because no Gaussian fits.
    """

    model: str
    sigma_px: float
    sigma_sd_px: float
    gain_DN: NDArray[np.float64]
    gain_sd_DN: NDArray[np.float64]
    slope_DN: NDArray[np.float64]
    slope_sd_DN: NDArray[np.float64]
    white_fraction: NDArray[np.float64]
    read_variance_DN2: float
    read_sd_DN2: float
    chi_square: float
    degrees: int
    chi_square_other: float
    sigma_other_px: float
    summed: bool = False


class _Problem:
    """The series' covariances in whitened form; linear in everything but the width of the spread."""

    def __init__(
        self,
        series: Sequence[NoiseCovariance],
        group: Sequence[int],
        radius: int,
        read_variance: float,
        expected: Sequence[NDArray[np.float64]] | None = None,
    ):
        self.series = list(series)
        self.radius = radius
        self.lags = _half_plane(radius)
        self.rows = np.array([dy for dy, _ in self.lags]) + radius
        self.columns = np.array([dx for _, dx in self.lags]) + radius
        self.groups = max(group, default=-1) + 1
        self.group = list(group)
        self.signal = [item.signal_DN for item in series]
        self.whitening: list[NDArray[np.float64]] = []
        self.data: list[NDArray[np.float64]] = []
        from scipy.linalg import cholesky, solve_triangular

        for number, item in enumerate(series):
            cut = item.radius - radius
            window = item.covariance_DN2[
                cut : item.covariance_DN2.shape[0] - cut, cut : item.covariance_DN2.shape[1] - cut
            ]
            # weights from the measured covariances favour those that came out low, so the fit's own take their place
            smooth = self._smoothed(window, item.samples, read_variance) if expected is None else expected[number]
            matrix = sampling_covariance(smooth, item.samples, radius, item.pair_share)
            lower = cholesky(matrix + 1e-12 * np.trace(matrix) / len(matrix) * np.eye(len(matrix)), lower=True)
            inverse = solve_triangular(lower, np.eye(len(lower)), lower=True)
            self.whitening.append(inverse)
            self.data.append(inverse @ window[self.rows, self.columns])

    @staticmethod
    def _smoothed(window: NDArray[np.float64], samples: float, read_variance: float) -> NDArray[np.float64]:
        """Autocovariance with the lags that are nothing but noise set to zero, for the weights."""
        centre = window.shape[0] // 2
        zero = max(window[centre, centre], 0.1 * read_variance, 1e-6)
        kept = np.where(np.abs(window) > 4.0 * zero / math.sqrt(samples), window, 0.0)
        kept[centre, centre] = zero
        return np.asarray(kept)

    def reweighted(self, model: str, sigma: float) -> "_Problem":
        """The same problem with its weights from the covariances fitted at this width."""
        _, coefficients, _ = self.solve(model, sigma)
        shape = noise_autocovariance(model, sigma, self.radius)
        centre = self.radius
        expected = []
        for item, signal, group in zip(self.series, self.signal, self.group, strict=True):
            window = np.zeros_like(shape)
            white = float(coefficients[-1])
            if group >= 0:
                window += signal * max(float(coefficients[group]), 0.0) * shape
                white += signal * float(coefficients[self.groups + group])
            measured = float(item.covariance_DN2[item.radius, item.radius])
            window[centre, centre] = max(window[centre, centre] + white, 0.1 * measured, 1e-6)
            expected.append(window)
        return _Problem(self.series, self.group, self.radius, 0.0, expected)

    def solve(self, model: str, sigma: float) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """Chi-square, coefficients (A_0.., W_0.., read variance) and whitened design at this width."""
        shape = noise_autocovariance(model, sigma, self.radius)[self.rows, self.columns]
        delta = np.array([1.0 if lag == (0, 0) else 0.0 for lag in self.lags])
        blocks, targets = [], []
        for inverse, data, signal, group in zip(self.whitening, self.data, self.signal, self.group, strict=True):
            design = np.zeros((len(shape), 2 * self.groups + 1))
            if group >= 0:
                design[:, group] = signal * shape
                design[:, self.groups + group] = signal * delta
            design[:, -1] = delta
            blocks.append(inverse @ design)
            targets.append(data)
        matrix = np.concatenate(blocks)
        target = np.concatenate(targets)
        # prior on W - w0 A, scaled by the gain of a first pass
        first = np.linalg.lstsq(matrix, target, rcond=None)[0]
        centre, width = WHITE_FRACTION_PRIOR
        prior = np.zeros((self.groups, 2 * self.groups + 1))
        for g in range(self.groups):
            # the sum is the gain, known even where the two cannot be told apart
            scale = max(abs(first[g] + first[self.groups + g]), 1e-12) * width
            prior[g, g], prior[g, self.groups + g] = -centre / scale, 1.0 / scale
        matrix = np.concatenate([matrix, prior])
        target = np.concatenate([target, np.zeros(self.groups)])
        coefficients = np.linalg.lstsq(matrix, target, rcond=None)[0]
        residual = target - matrix @ coefficients
        return float(residual @ residual), np.asarray(coefficients, dtype=np.float64), matrix


def _summed_gains(
    series: Sequence[NoiseCovariance],
    group: Sequence[int],
    *,
    groups: int,
    reach: int,
    read_variance_DN2: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gains and slopes with their standard deviations (group,), DN, from covariances summed up to lag `reach`.

    gain = (sum over lags of C - r^2) / signal, whatever the spread's shape; slope = (C(0) - r^2) / signal. Series of a
    group are weighted by their precision.
    """
    information = np.zeros((2, groups))
    estimate = np.zeros((2, groups))
    for item, number in zip(series, group, strict=True):
        if number < 0:
            continue
        cut = item.radius - reach
        edge = item.covariance_DN2.shape[0] - cut
        window = item.covariance_DN2[cut:edge, cut:edge]
        matrix = sampling_covariance(window, item.samples, reach, item.pair_share)
        # half plane: every lag but 0 counts twice
        twice = np.full(len(matrix), 2.0)
        twice[0] = 1.0
        for kind, (value, variance) in enumerate(
            ((float(window.sum()), float(twice @ matrix @ twice)), (float(window[reach, reach]), float(matrix[0, 0])))
        ):
            weight = item.signal_DN**2 / max(variance, 1e-300)
            information[kind, number] += weight
            estimate[kind, number] += weight * (value - read_variance_DN2) / item.signal_DN
    estimate = estimate / information
    sd = 1.0 / np.sqrt(information)
    return estimate[0], sd[0], estimate[1], sd[1]


def fit_spread(
    series: Sequence[NoiseCovariance],
    *,
    group: Sequence[int],
    radius: int = 5,
    models: Sequence[str] = PSF_MODELS,
) -> SpreadFit:
    """Fit C_s(o) = I_s [A_g rho(o; sigma) + W_g delta(o)] + r^2 delta(o) to all series by generalised least squares.

    rho is the autocovariance of unit quanta after the spread (sums to 1), so gain_g = A_g + W_g and the slope of a
    photon-transfer line is A_g rho(0) + W_g. Both descriptions of the spread are tried; `sampled` is kept where it is
    better by more than `MODEL_PENALTY`, and where the data leave it open the standard deviations cover both.

    Where no Gaussian describes the covariances (chi-square above `POOR_FIT` a degree of freedom), gains and slopes come from
    the covariances themselves, summed over neighbours, and only the width from the fit.

    Args:
        series: covariances, darks included (signal 0).
        group: per series, the index of its kV and filter; -1 for darks.
        radius: largest lag used, px.
        models: descriptions to try.

    Raises:
        FitError: no series with signal, or the least-squares problem has no solution.
    """
    from scipy.optimize import minimize_scalar

    if not any(index >= 0 for index in group):
        raise FitError("the noise fit needs at least one flat series with two or more frames")
    read_guess = min(
        (s.covariance_DN2[s.radius, s.radius] for s, g in zip(series, group, strict=True) if g < 0), default=0.0
    )
    problem = _Problem(series, group, radius, float(read_guess))
    grid = np.linspace(0.0, 0.45 * radius, 25)

    def width_of(problem: _Problem, model: str) -> tuple[float, float]:
        values = [problem.solve(model, float(sigma))[0] for sigma in grid]
        best = int(np.argmin(values))
        bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
        result = minimize_scalar(
            lambda sigma: problem.solve(model, float(sigma))[0],
            bounds=bounds,
            method="bounded",
            options={"xatol": 1e-5},
        )
        return float(result.fun), float(result.x)

    for _ in range(2):
        found = {model: width_of(problem, model) for model in models}
        model = min(found, key=lambda name: found[name][0] + MODEL_PENALTY[name])
        problem = problem.reweighted(model, found[model][1])
    found = {model: width_of(problem, model) for model in models}
    model = min(found, key=lambda name: found[name][0] + MODEL_PENALTY[name])
    chi_square, sigma = found[model]
    _, coefficients, matrix = problem.solve(model, sigma)
    if not np.all(np.isfinite(coefficients)):
        raise FitError("the noise covariances have no finite fit; look for saturated or constant frames")

    # standard deviations: the width joins the linear coefficients through its numerical derivative
    step = max(1e-3, 0.01 * sigma)
    lower = max(sigma - step, 0.0)
    derivative = (
        (problem.solve(model, sigma + step)[2] - problem.solve(model, lower)[2]) @ coefficients / (sigma + step - lower)
    )
    jacobian = np.column_stack([matrix, derivative])
    information = jacobian.T @ jacobian
    scale = np.sqrt(np.clip(np.diag(information), 1e-300, None))
    covariance = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
    degrees = jacobian.shape[0] - jacobian.shape[1]
    inflation = max(1.0, chi_square / degrees) if degrees > 0 else 1.0
    covariance = covariance * inflation

    groups = problem.groups
    share = float(noise_autocovariance(model, sigma, 0)[0, 0])
    share_high = float(noise_autocovariance(model, sigma + step, 0)[0, 0])
    share_low = float(noise_autocovariance(model, lower, 0)[0, 0])
    share_slope = (share_high - share_low) / (sigma + step - lower)
    quantum, white = coefficients[:groups], coefficients[groups : 2 * groups]
    gain_sd, slope_sd = [], []
    for g in range(groups):
        direction = np.zeros(2 * groups + 2)
        direction[g] = direction[groups + g] = 1.0
        gain_sd.append(math.sqrt(float(direction @ covariance @ direction)))
        direction[g], direction[-1] = share, quantum[g] * share_slope
        slope_sd.append(math.sqrt(float(direction @ covariance @ direction)))
    sigma_sd = math.sqrt(max(float(covariance[-1, -1]), 0.0))
    other = next((name for name in found if name != model), model)
    # the descriptions' likelihood ratio says how much of their difference is left open
    if other != model:
        behind = found[other][0] - chi_square + MODEL_PENALTY[other] - MODEL_PENALTY[model]
        weight = 1.0 / (1.0 + math.exp(min(0.5 * behind / inflation, 50.0)))
        sigma_sd = math.hypot(sigma_sd, math.sqrt(weight) * (found[other][1] - sigma))
        _, others, _ = problem.solve(other, found[other][1])
        moved = others[:groups] + others[groups : 2 * groups] - quantum - white
        gain_sd = [math.hypot(sd, math.sqrt(weight) * float(step)) for sd, step in zip(gain_sd, moved, strict=True)]
    gain, slope = quantum + white, quantum * share + white
    gain_spread, slope_spread = np.array(gain_sd), np.array(slope_sd)
    summed = degrees > 0 and chi_square / degrees > POOR_FIT
    if summed:
        reach = min(radius, math.ceil(3.0 * math.sqrt(2.0) * sigma) + 1)
        gain, gain_spread, slope, slope_spread = _summed_gains(
            series, group, groups=groups, reach=reach, read_variance_DN2=float(coefficients[-1])
        )
    return SpreadFit(
        model=model,
        sigma_px=sigma,
        sigma_sd_px=sigma_sd,
        gain_DN=gain,
        gain_sd_DN=gain_spread,
        slope_DN=slope,
        slope_sd_DN=slope_spread,
        summed=summed,
        white_fraction=white / np.where(quantum > 0, quantum, np.nan),
        read_variance_DN2=float(coefficients[-1]),
        read_sd_DN2=math.sqrt(max(float(covariance[2 * groups, 2 * groups]), 0.0)),
        chi_square=chi_square,
        degrees=degrees,
        chi_square_other=found[other][0],
        sigma_other_px=found[other][1],
    )

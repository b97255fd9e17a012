"""Noise power of one series, from differences of frames freed of everything that is not noise of single pixels.

A frame pair's difference holds noise, and what changed between the two: one factor of the tube, a smooth change of the
beam's shape, offsets of rows and columns. Squares of the frame are therefore taken one by one (the regions of interest of
IEC 62220-1): the common factor is subtracted, the difference is divided by the local signal, and every part of it that is
constant or linear along a row or along a column is projected out. What the projection takes from white noise is known
exactly and given back; frequencies that it leaves little of are left out.

Conventions: frequency in cycles per pixel, `power` in DN^2, so that white noise of variance v has the power v at every
frequency, and the mean over all frequencies is the variance of a pixel.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...generator.line.twin import Z95
from ..frames.frame_checks import repeats_the_last
from ..frames.frame_sums import effective_frames

LARGEST_SQUARE_PX = 64  # a spread of 3 px leaves half of the power at the lowest frequency in use
SMALLEST_SQUARE_PX = 8
_LOW_BAND = 0.25  # cycles a pixel, from which the power at 0 is extrapolated
_LEAST_GOOD_SHARE = 0.7  # of a square's pixels, for the projection to be as in a whole one
_LEAST_LEFT = 0.15  # of white noise, after the projection, for a frequency to be used
_MOST_BROKEN = 256  # squares with bad pixels, from which what such squares show is known well enough
# squares from this side lose slopes too; in smaller ones these hold a quarter of all modes and more
_SLOPES_FROM_PX = 32

FloatArray = NDArray[np.float64]


def square_side_px(shape: tuple[int, int]) -> int:
    """Side of the squares for frames of a shape (rows, columns), px: 64, or the power of 2 that fits one and a half times."""
    smallest = min(shape)
    side = LARGEST_SQUARE_PX
    while side > SMALLEST_SQUARE_PX and 3 * side > 2 * smallest:
        side //= 2
    return side


def holds_squares(good: NDArray[np.bool_]) -> bool:
    """Whether enough good pixels (row, column) lie together for the noise power of one square."""
    side = square_side_px((good.shape[0], good.shape[1]))
    return bool(_Squares.of(np.ones(good.shape), good, side, has_signal=False, divided=False).corners)


@lru_cache(maxsize=16)
def mode_share(side: int) -> FloatArray:
    """Share of all frequencies that each cell of the quadrant stands for (K + 1, K + 1); sums to 1."""
    half = side // 2
    times = np.full(half + 1, 2.0)
    times[0] = times[half] = 1.0
    return np.asarray(np.outer(times, times) / side**2)


@lru_cache(maxsize=16)
def _taper(side: int) -> FloatArray:
    """Sine taper (side,): squares that overlap by half then weigh all pixels alike."""
    return np.asarray(np.sin(np.pi * (np.arange(side) + 0.5) / side))


@lru_cache(maxsize=16)
def _removed(side: int) -> FloatArray:
    """Orthonormal tapered lines that are projected out (side, term): constant and, in large squares, linear."""
    taper = _taper(side)
    position = np.linspace(-1.0, 1.0, side)
    terms = 2 if side >= _SLOPES_FROM_PX else 1
    lines = np.stack([taper * position**power for power in range(terms)], axis=1)
    return np.asarray(np.linalg.qr(lines)[0])


@lru_cache(maxsize=16)
def left_of_white_noise(side: int) -> FloatArray:
    """Share of white noise power that the projection leaves (K + 1,), one axis; the taper's own loss is not counted."""
    basis, taper = _removed(side), _taper(side)
    lines = np.fft.rfft(np.diag(taper) - basis @ (basis.T * taper), axis=0)
    return np.asarray(np.sum(lines.real**2 + lines.imag**2, axis=1) / np.sum(taper**2))


@lru_cache(maxsize=16)
def usable(side: int) -> NDArray[np.bool_]:
    """Frequencies of which the projection leaves enough (K + 1, K + 1)."""
    left = left_of_white_noise(side)
    return np.asarray(np.outer(left, left) > _LEAST_LEFT)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What the squares of a series show of the power that noise has.

    Fields: parts: for rows and for columns, what squares of a kind keep at each frequency of noise at each other (shown, of
    noise); shares (part, K + 1, K + 1): of the squares, 0 where a kind keeps too little of white noise while another does not;
    left: share of white noise that those in use keep (K + 1, K + 1).
    """

    parts: tuple[tuple[FloatArray, FloatArray], ...]
    shares: FloatArray
    left: FloatArray

    @classmethod
    def of(cls, parts: Sequence[tuple[float, FloatArray, FloatArray]]) -> "Shown":
        """The squares that these parts (share, rows, columns) make up."""
        white = np.stack([np.outer(rows.sum(axis=1), columns.sum(axis=1)) for _, rows, columns in parts])
        enough = white > _LEAST_LEFT
        shares = np.array([share for share, *_ in parts])[:, None, None] * (enough | ~enough.any(axis=0))
        left = np.maximum(np.sum(shares * white, axis=0), 1e-9)
        return cls(tuple((rows, columns) for _, rows, columns in parts), shares, left)

    def smeared(self, power: FloatArray) -> FloatArray:
        """A power (K + 1, K + 1) as the squares show it after taper and projection, white noise unchanged."""
        kept = zip(self.shares, self.parts, strict=True)
        total = sum(share * (rows @ power @ columns.T) for share, (rows, columns) in kept)
        return np.asarray(total / self.left)


def _by_frequency(kept: FloatArray) -> FloatArray:
    """Of what is kept at each frequency of a covariance at each lag (K + 1, K + 1): of noise at each frequency instead."""
    order = np.arange(len(kept))
    weight = np.full(order.size, 2.0)
    weight[0] = weight[-1] = 1.0
    side = 2 * (order.size - 1)
    cosine = np.cos(2.0 * np.pi * np.outer(order, order) / side)
    return np.asarray((kept * weight) @ (cosine * weight) / side)


def _kept_of_lags(lines: FloatArray, lags: NDArray[np.intp]) -> FloatArray:
    """Power (frequency, lag) that an operator (M, M) on lines leaves of a covariance of 1 at a lag either way."""
    side = lines.shape[-1]
    spectra = np.fft.rfft(lines, axis=0)
    kept = [np.sum(spectra[:, : side - lag] * spectra[:, lag:].conj(), axis=1).real for lag in lags]
    return np.asarray(np.stack(kept, axis=1) / np.sum(_taper(side) ** 2))


@lru_cache(maxsize=16)
def whole_squares(side: int) -> Shown:
    """What squares without bad pixels show."""
    basis, taper = _removed(side), _taper(side)
    axis = _by_frequency(_kept_of_lags(np.diag(taper) - basis @ (basis.T * taper), np.arange(side // 2 + 1)))
    return Shown.of([(1.0, axis, axis)])


def _pairs(line: FloatArray) -> FloatArray:
    """Products of a line's (M,) elements summed over pairs at each lag (M / 2 + 1,)."""
    spectrum = np.fft.rfft(line, n=2 * len(line))
    return np.asarray(np.fft.irfft(spectrum.real**2 + spectrum.imag**2)[: len(line) // 2 + 1])


@lru_cache(maxsize=8)
def _kept_with_holes(side: int, good: bytes) -> FloatArray:
    """What squares with bad pixels keep along their last axis at each frequency of noise at each other (K + 1, K + 1).

    A line with fewer pixels loses more of its noise to the same terms: a hundredth of the power of a panel with 3 % of bad
    pixels. Lines are taken one by one; as in `_Squares`, a missing pixel is filled once with what is projected out, and lags are
    weighted by the pairs of pixels of whole lines over those that there are.
    """
    basis, taper = _removed(side), _taper(side)
    weight = np.tile(taper**2, len(good) // side**2)
    kinds, place = np.unique(np.frombuffer(good, dtype=np.bool_).reshape(-1, side), axis=0, return_inverse=True)
    projector = np.eye(side) - basis @ basis.T
    order = np.arange(side // 2 + 1)
    kept, pairs, whole = np.zeros((order.size, order.size)), np.zeros(order.size), np.zeros(order.size)
    for mask, times in zip(kinds, np.bincount(place.reshape(-1), weights=weight), strict=True):
        lines = (projector - (projector * ~mask) @ projector) * (taper * mask)
        kept += times * _kept_of_lags(lines * mask[:, None], order)
        pairs += times * _pairs(taper * mask)
        whole += times * _pairs(taper)
    scale = (whole / np.maximum(pairs, 1e-9 * whole))[np.minimum(np.arange(side), side - np.arange(side))]
    scaled = np.fft.rfft(np.fft.irfft(kept, n=side, axis=0) * scale[:, None], axis=0).real
    return _by_frequency(scaled / weight.sum())


def smeared(power: FloatArray) -> FloatArray:
    """A power (K + 1, K + 1) as squares without bad pixels show it after taper and projection, white noise unchanged."""
    return whole_squares(2 * (power.shape[0] - 1)).smeared(power)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisePower:
    """Temporal noise power of one series, one exposure, over the quadrant of frequencies 0 .. 1/2 (K + 1, K + 1).

    Fields:
        power_DN2: (K + 1, K + 1), row frequency first; NaN where the projection leaves too little.
        modes: independent complex amplitudes that carry the same information (K + 1, K + 1), 0 where power is NaN.
        signal_DN: mean signal above dark over the squares in use.
        common_mode: variance of the factor that a whole frame shares, relative to the signal (0 where it does not stand
            out of the pixels' own noise).
        between_series: whether the two frames of a difference come from different series, so that slow changes of the beam's
            shape are in it.
        change_DN2: what a change of the beam's shape between the two, of relative variance 1, adds to the variance; 0: not known.
        shown: what the squares show of noise; None: what whole ones do.
        row_variance_DN2, column_variance_DN2: of offsets common to a row or to a column of one exposure, with the standard
            deviations row_sd_DN2, column_sd_DN2.
    """

    power_DN2: FloatArray
    modes: FloatArray
    signal_DN: float
    common_mode: float = 0.0
    row_variance_DN2: float = 0.0
    row_sd_DN2: float = 0.0
    column_variance_DN2: float = 0.0
    column_sd_DN2: float = 0.0
    between_series: bool = False
    change_DN2: float = 0.0
    shown: Shown | None = None

    @property
    def square_px(self) -> int:
        """Pixels along a side of the squares."""
        return 2 * (int(self.power_DN2.shape[0]) - 1)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Frequencies in use (K + 1, K + 1)."""
        return np.asarray(self.modes > 0)

    @property
    def samples(self) -> float:
        """Independent frames x pixels."""
        return 2.0 * float(self.modes.sum())

    def times(self, factor: float) -> "NoisePower":
        """The power times a known factor."""
        names = ("power_DN2", "row_variance_DN2", "row_sd_DN2", "column_variance_DN2", "column_sd_DN2", "change_DN2")
        return replace(self, **{name: factor * getattr(self, name) for name in names})

    def smeared(self, power: FloatArray) -> FloatArray:
        """A power (K + 1, K + 1) as the squares of this series show it, white noise unchanged."""
        return (self.shown or whole_squares(self.square_px)).smeared(power)

    def as_exposure(self, averaged: int, *, whole: bool) -> "NoisePower":
        """The power of one exposure, from that of means of so many; whole: they were rounded to whole numbers.

        The rounding of a mean is white and comes once, however many exposures it holds; that of each exposure stays in.
        """
        found = self.times(float(averaged))
        if averaged == 1 or not whole:
            return found
        stored = float(np.average(self.power_DN2[self.used], weights=mode_share(self.square_px)[self.used]))
        rounding = averaged * rounding_variance(stored)
        power = found.power_DN2 - rounding
        # where rounding was most of it, what is left is known worse by as much
        left = 1.0 - rounding / max(averaged * stored, 1e-300)
        return replace(found, power_DN2=power, modes=self.modes * left**2)

    def filled(self, expected_DN2: FloatArray) -> FloatArray:
        """Power (K + 1, K + 1), DN^2: `expected_DN2` where it was not measured."""
        return np.asarray(np.where(self.used, self.power_DN2, expected_DN2))

    def variance_DN2(self, expected_DN2: FloatArray) -> float:
        """Variance of one pixel, DN^2: mean over frequencies, those that were not measured as expected."""
        return float(np.sum(mode_share(self.square_px) * self.filled(expected_DN2)))


@lru_cache(maxsize=16)
def spread_of_bins(side: int) -> float:
    """Variance of one frequency's power over that of as many independent amplitudes as `modes`: below 1.

    Squares overlap: their powers at one frequency are less correlated than the pixels that they share, while neighbouring
    frequencies are correlated instead. A sum over many frequencies has the variance that `modes` says.
    """
    taper = _taper(side)
    shifted = np.zeros(side)
    shifted[side // 2 :] = taper[: side - side // 2] * taper[side // 2 :]
    correlation = (shifted.sum() / np.sum(taper**2)) ** 2
    return float((0.5 * (1.0 + 2.0 * correlation)) ** 2)


def _starts(length: int, side: int) -> NDArray[np.intp]:
    count = max(1, math.ceil((length - side) / (side / 2)) + 1)
    return np.unique(np.rint(np.linspace(0, length - side, count)).astype(np.intp))


@dataclass(slots=True)
class _Squares:
    """Squares of a frame in which enough pixels are good, and the sums over them."""

    side: int
    corners: list[tuple[int, int]]
    masks: list[NDArray[np.bool_] | None]
    scale: list[FloatArray]  # reciprocal of the square's relative signal, the taper left out
    level: FloatArray  # mean signal of each square
    pixels: float  # independent pixels in all of them
    pairs: FloatArray | None = None  # whole squares' pairs of pixels over those of squares with holes, by lag
    shown: Shown | None = None  # what they show of noise, once it is asked for

    @classmethod
    def of(
        cls, signal_DN: FloatArray, good: NDArray[np.bool_], side: int, *, has_signal: bool, divided: bool
    ) -> "_Squares":
        corners: list[tuple[int, int]] = []
        masks: list[NDArray[np.bool_] | None] = []
        scale: list[FloatArray] = []
        level: list[float] = []
        weight = np.zeros(good.shape)
        taper = _taper(side)
        window = np.outer(taper, taper) ** 2
        for row in _starts(good.shape[0], side):
            for column in _starts(good.shape[1], side):
                place = (slice(row, row + side), slice(column, column + side))
                mask = good[place]
                share = float(np.sum(window * mask) / np.sum(window))
                if share < _LEAST_GOOD_SHARE:
                    continue
                signal = signal_DN[place]
                mean = float(np.sum(window * signal * mask) / np.sum(window * mask))
                if has_signal and not mean > 0:
                    continue
                relative = np.ones((side, side))
                if divided:
                    relative = np.where(mask, mean / np.where(signal > 0.05 * mean, signal, mean), 0.0)
                elif share < 1.0:
                    relative = mask.astype(np.float64)
                corners.append((int(row), int(column)))
                masks.append(None if mask.all() else mask)
                scale.append(relative)
                level.append(mean)
                weight[place] += window * mask
        total = float(weight.sum())
        pixels = total**2 / float(np.sum(weight**2)) if total > 0 else 0.0
        return cls(side, corners, masks, scale, np.array(level), pixels)

    def power(self, difference: FloatArray) -> FloatArray:
        """Folded power (K + 1, K + 1) of a difference, the mean over the squares."""
        from scipy.fft import rfft2

        side = self.side
        window, basis = np.outer(_taper(side), _taper(side)), _removed(side)
        stack = np.empty((len(self.corners), side, side))
        for number, (row, column) in enumerate(self.corners):
            np.multiply(difference[row : row + side, column : column + side], self.scale[number], out=stack[number])
        left = _projected(stack * window, basis)
        holes = [number for number, mask in enumerate(self.masks) if mask is not None]
        if self.shown is None:
            self.shown = self._shown()
        power = np.zeros((side // 2 + 1, side // 2 + 1))
        if len(holes) < len(self.corners):
            spectra = rfft2(np.delete(left, holes, axis=0), axes=(1, 2), overwrite_x=True)
            power += _folded(np.sum(spectra.real**2 + spectra.imag**2, axis=0)) * (self.shown.shares[0] > 0)
        if holes:
            masks = np.stack([mask for mask in self.masks if mask is not None])
            # a missing pixel takes the value of what is projected out, so that it leaves no hole in a slope
            filled = np.where(masks, stack[holes], stack[holes] - left[holes] / window)
            broken = _folded(self._power_with_holes(_projected(filled * window, basis) * masks))
            power += broken * (self.shown.shares[-1] > 0)
        power /= len(self.corners) * float(np.sum(_taper(side) ** 2)) ** 2
        return np.where(usable(side), power / self.shown.left, 0.0)

    def _shown(self) -> Shown:
        """What these squares show of noise."""
        holes = [mask for mask in self.masks if mask is not None]
        whole = whole_squares(self.side)
        if not holes:
            return whole
        share = len(holes) / len(self.corners)
        masks = np.stack(holes[:: 1 + len(holes) // _MOST_BROKEN])
        rows, columns = (_kept_with_holes(self.side, one.tobytes()) for one in (masks.swapaxes(1, 2), masks))
        kinds = [(1.0 - share, *whole.parts[0]), (share, rows, columns)]
        return Shown.of([kind for kind in kinds if kind[0] > 0])

    def _power_with_holes(self, squares: FloatArray) -> FloatArray:
        """Summed power (M, M/2 + 1) of squares in which pixels are missing, as if none were.

        In lags up to half a square: products of the pixels that are there, times the pairs that a whole square has at that lag
        over those that these squares have. Pairs that lie further apart wrap round to the same lags; they are uncorrelated.
        """
        from scipy.fft import irfft2, rfft2

        side = self.side
        spectra = rfft2(squares, axes=(1, 2), overwrite_x=True)
        lags = irfft2(np.sum(spectra.real**2 + spectra.imag**2, axis=0), s=(side, side))
        if self.pairs is None:
            window = np.outer(_taper(side), _taper(side))
            padded = (2 * side, 2 * side)
            there = rfft2(np.stack([window * mask for mask in self.masks if mask is not None]), s=padded, axes=(1, 2))
            whole = rfft2(window, s=padded)
            order = np.arange(side)
            near = np.where(order <= side // 2, order, order + side)
            found, all_of_them = (
                irfft2(np.sum(one.real**2 + one.imag**2, axis=0), s=padded)[np.ix_(near, near)]
                for one in (there, whole[None])
            )
            self.pairs = len(squares) * all_of_them / found
        return np.asarray(rfft2(lags * self.pairs).real)


def _projected(lines: FloatArray, basis: FloatArray) -> FloatArray:
    """Tapered squares (square, M, M) without what `basis` (M, term) spans along either axis."""
    rest = lines - basis @ (basis.T @ lines)
    return np.asarray(rest - (rest @ basis) @ basis.T)


def compute_noise_power(
    pieces: Iterable[NDArray[Any]],
    *,
    signal_DN: FloatArray,
    good: NDArray[np.bool_],
    side: int | None = None,
    about: tuple[FloatArray, int] | None = None,
) -> NoisePower:
    """Noise power of one frame from successive differences, DN^2.

    Args:
        pieces: frames (m, row, column) in time order, DN; at least two frames in all.
        signal_DN: mean signal above dark (row, column), DN; zeros for darks.
        good: pixels to use (row, column).
        side: of the squares, px, even; None: `square_side_px`.
        about: mean frame (row, column) and how many frames it is the mean of, N: deviations from it, d = x_i - mean with
            variance 1 - 1/N of a frame's, in place of successive differences.

    Raises:
        InputError: fewer than two frames, or no square with enough good pixels.

    Source: IEC 62220-1-1:2015, noise power spectrum; sine tapers: Riedel and Sidorenko, IEEE Trans. Signal Process. 43
    (1995) 188. Checked against: noise of known power, tests/test_calibration_noise_power.py.
    """
    summed = _PowerSum(signal_DN=signal_DN, good=good, side=side)
    single = 2.0 if about is None else 1.0 - 1.0 / max(about[1], 2)
    last: FloatArray | None = None if about is None else about[0]
    copies = 0
    for piece in pieces:
        for frame in piece:
            current = np.asarray(frame, dtype=np.float64)
            if about is None and repeats_the_last(current[None], last)[0]:
                copies += 1
                continue
            if last is not None:
                summed.add(current - last)
            last = current if about is None else last
    if summed.count == 0 and copies:
        # nothing ever moves: there is no noise
        summed.add(np.zeros(good.shape))
    if summed.count == 0 or (about is not None and about[1] < 2):
        raise InputError("frames", received="fewer than two frames", expected="at least two frames of one setting")
    degrees = effective_frames(summed.count + 1) if about is None else summed.count * single
    return summed.result(single=single, degrees=degrees)


def compute_difference_power(
    first: FloatArray,
    second: FloatArray,
    *,
    exposures: tuple[int, int],
    dark_exposures: tuple[int, int],
    same_dark: bool,
    good: NDArray[np.bool_],
    side: int | None = None,
    shape: FloatArray | None = None,
) -> NoisePower:
    """Noise power of one exposure from two mean frames of the same beam, at the same or another level, DN^2.

    Both are divided by their own mean level, so the pixels' gains and the beam's shape cancel:
    d = x_1 / I_1 - x_2 / I_2, of variance g s (1 / (n_1 I_1) + 1 / (n_2 I_2)) + r^2 (1 / (n_1 I_1^2) + 1 / (n_2 I_2^2)).
    The power is brought to a read variance of 1 r^2; `signal_DN` is then the ratio of the two sums.

    Args:
        first, second: mean signal above dark (row, column), DN.
        exposures: how many exposures each is the mean of.
        dark_exposures: of the dark frames that were subtracted, 0 where one has no noise.
        same_dark: whether it was the same dark frame.
        good: pixels to use (row, column).
        side: of the squares, px; None: `square_side_px`.
        shape: the beam's shape, by which differences are divided (row, column); None: that of the two frames, whose own noise
            adds to the power where it is not far below their signal.

    Raises:
        InputError: a frame without signal.
    """
    levels = [float(np.mean(frame[good])) for frame in (first, second)]
    if not min(levels) > 0:
        raise InputError("flat frames", received="no signal above dark", expected="flats brighter than the darks")
    read = sum(1.0 / (n * level**2) for n, level in zip(exposures, levels, strict=True))
    if same_dark and dark_exposures[0] > 0:
        read += (1.0 / levels[0] - 1.0 / levels[1]) ** 2 / dark_exposures[0]
    elif not same_dark:
        read += sum(1.0 / (n * level**2) for n, level in zip(dark_exposures, levels, strict=True) if n > 0)
    quantum = sum(1.0 / (n * level) for n, level in zip(exposures, levels, strict=True))
    if shape is None:
        shape = 0.5 * (first / levels[0] + second / levels[1])
    summed = _PowerSum(signal_DN=shape, good=good, side=side, divided=True)
    summed.add((second / levels[1] - first / levels[0]) / math.sqrt(read))
    found = summed.result(single=1.0, degrees=1.0)
    return replace(
        found,
        signal_DN=found.signal_DN * quantum / read,
        common_mode=0.0,
        between_series=True,
        change_DN2=1.0 / read,
    )


def rounding_variance(stored_DN2: float) -> float:
    """What rounding to whole numbers added to Gaussian noise whose variance is then so much, DN^2: at most 1/12.

    Noise of variance v far below 1 moves few numbers: 1/12 - sum over k of exp(-(2 pi k)^2 v) / (2 pi^2 k^2), with levels anywhere
    between two whole numbers.

    Source: Fourier series of the rounding error (Widrow, IRE Trans. CT-3 (1956) 266). Checked against: numbers drawn and rounded,
    tests/test_calibration_noise_power.py.
    """
    from scipy.optimize import brentq

    order = np.arange(1, 50)

    def added(variance: float) -> float:
        return 1.0 / 12.0 - float(
            np.sum(np.exp(-((2.0 * np.pi * order) ** 2) * variance) / (2.0 * (np.pi * order) ** 2))
        )

    if stored_DN2 <= 0.0:
        return 0.0
    return stored_DN2 - float(brentq(lambda variance: variance + added(variance) - stored_DN2, 0.0, stored_DN2))


class _PowerSum:
    """Sums over differences of frames."""

    def __init__(
        self, *, signal_DN: FloatArray, good: NDArray[np.bool_], side: int | None, divided: bool = False
    ) -> None:
        self.side = side or square_side_px((good.shape[0], good.shape[1]))
        self.good = good
        self.has_signal = bool(np.any(signal_DN[good] > 0))
        self.signal_DN = signal_DN
        self.squares = _Squares.of(
            signal_DN, good, self.side, has_signal=self.has_signal, divided=divided and self.has_signal
        )
        if not self.squares.corners:
            raise InputError(
                "good pixels",
                received=int(good.sum()),
                expected=f"squares of {self.side} x {self.side} px with nine good pixels in ten",
                remedy="use larger frames, or look at why so many pixels look bad",
            )
        self.shape = np.where(good, signal_DN, 0.0) if self.has_signal else good.astype(np.float64)
        self.norm = float(np.sum(self.shape**2))
        self.power = np.zeros((self.side // 2 + 1, self.side // 2 + 1))
        self.lines = [np.zeros(0), np.zeros(0)]
        self.factors: list[float] = []
        self.count = 0

    def add(self, difference: FloatArray) -> None:
        """One more difference (row, column), DN."""
        kept = np.where(self.good, difference, 0.0)
        factor = float(np.sum(kept * self.shape)) / self.norm
        kept -= factor * self.shape
        self.power += self.squares.power(kept)
        steps = [_line_steps(kept, self.good, axis) ** 2 for axis in (1, 0)]
        self.lines = [last + one if self.count else one for last, one in zip(self.lines, steps, strict=True)]
        self.factors.append(factor)
        self.count += 1

    def result(self, *, single: float, degrees: float) -> NoisePower:
        """The power of one exposure; single: variance of a difference over that of one; degrees: independent differences."""
        side = self.side
        used = usable(side)
        power = np.where(used, self.power / (single * self.count), np.nan)
        modes = np.where(used, 0.5 * mode_share(side) * self.squares.pixels * degrees, 0.0)
        if self.squares.shown is not None:
            modes *= self.squares.shown.shares.sum(axis=0)
        # a plateau's height, for what the pixels' own noise adds to whole frames and lines
        lowest = int(np.argmax(used.any(axis=1))) + 1
        plateau = _at_zero(power, modes)
        signal = float(np.mean(self.squares.level)) if self.has_signal else 0.0
        common = 0.0
        if self.has_signal:
            from scipy.special import chdtri

            # the pixels' own noise moves the factor too; what is left must stand out of that as in 1 of 1000 by chance
            own = plateau / self.norm
            excess = float(np.mean(np.square(self.factors))) / single - own
            common = excess if excess > own * (float(chdtri(degrees, 1e-3)) / degrees - 1.0) else 0.0
        step = 1.0 - np.cos(2.0 * np.pi * np.arange(side // 2 + 1) / side)
        weight = np.full(side // 2 + 1, 2.0)
        weight[0] = weight[-1] = 1.0
        found = []
        for axis, line in enumerate((power[:, lowest], power[lowest])):
            columns = self.good.shape[1 - axis]
            expected = float(np.nansum(weight * step * np.nan_to_num(line, nan=plateau)) / side) / columns
            measured, relative_sd = _line_variance(self.lines[axis] / (single * self.count), degrees)
            found.append((measured - expected, relative_sd * max(measured, expected)))
        return NoisePower(
            power_DN2=power,
            modes=modes,
            signal_DN=signal,
            common_mode=common,
            row_variance_DN2=found[0][0],
            row_sd_DN2=found[0][1],
            column_variance_DN2=found[1][0],
            column_sd_DN2=found[1][1],
            shown=self.squares.shown,
        )


def _at_zero(power: FloatArray, modes: FloatArray) -> float:
    """Power at frequency 0 from that at low ones, whose logarithm falls as the square of the frequency (DN^2)."""
    order = np.arange(power.shape[0]) / (2.0 * (power.shape[0] - 1))
    square = order[:, None] ** 2 + order[None, :] ** 2
    low = (modes > 0) & (square < _LOW_BAND**2) & (np.nan_to_num(power) > 0)
    if np.count_nonzero(low) < 3:
        low = (modes > 0) & (np.nan_to_num(power) > 0)
    if not low.any():
        return 0.0
    design = np.stack([np.ones(int(low.sum())), square[low]], axis=1) * np.sqrt(modes[low])[:, None]
    found = np.linalg.lstsq(design, np.log(power[low]) * np.sqrt(modes[low]), rcond=None)[0]
    return float(np.exp(found[0]))


def _line_steps(difference: FloatArray, good: NDArray[np.bool_], axis: int) -> FloatArray:
    """Steps between the means of neighbouring lines (step,), DN: rows for axis 1, columns for axis 0."""
    count = good.sum(axis=axis)
    means = difference.sum(axis=axis) / np.maximum(count, 1)
    usable = count > 0.5 * good.shape[axis]
    return np.asarray(np.diff(means)[usable[1:] & usable[:-1]])


def _line_variance(mean_squares_DN2: FloatArray, degrees: float) -> tuple[float, float]:
    """Variance of one line's mean (DN^2) from mean square steps between lines (step,), and its relative standard deviation.

    The median over the lines, as a line of a cluster or of a readout block may step by itself. A mean square of n differences
    follows chi-square over n, whose median m is known; the median of N of them has the variance 1 / (4 N f(m)^2), f their
    density. Neighbouring steps share a line: the variance is half as large again, as it is for mean squares.
    """
    from scipy.special import gammaincinv, gammaln

    if mean_squares_DN2.size == 0:
        return 0.0, 0.0
    half = 0.5 * degrees
    middle = float(gammaincinv(half, 0.5))  # of chi-square over 2
    relative_density = math.exp(half * math.log(middle) - middle - float(gammaln(half)))  # times the median itself
    median = float(np.median(mean_squares_DN2))
    relative_sd = math.sqrt(1.5 / mean_squares_DN2.size) / (2.0 * relative_density)
    return 0.5 * median * half / middle, relative_sd


def _folded(power: FloatArray) -> FloatArray:
    """(M, M/2 + 1) of a real transform -> (K + 1, K + 1), mirror frequencies averaged."""
    half = power.shape[0] // 2
    folded = power[: half + 1].copy()
    folded[1:half] += power[:half:-1]
    folded[1:half] *= 0.5
    return folded


def correlation_of_quanta(
    powers: Sequence[NoisePower],
    expected_DN2: Sequence[FloatArray],
    quanta_DN2: Sequence[FloatArray],
    *,
    unseen_sd: float = 0.0,
    reach: int = 2,
) -> list[dict[str, float]]:
    """Correlation of neighbouring pixels' signal-following noise, with 95 % intervals.

    rho(o) = C(o) / C(0), pooled over series in proportion to what each tells. The fitted power of the quanta, which squares
    have not smeared, is taken times what was measured of it over what was expected there.

    Args:
        powers: of series with signal.
        expected_DN2: their fitted power (K + 1, K + 1) as squares show it, with electronic noise and slow changes.
        quanta_DN2: fitted power of what follows the signal (K + 1, K + 1), not smeared.
        unseen_sd: relative standard deviation of the fitted power at frequencies that were not measured.
        reach: largest lag, px.

    Returns:
        Rows `lag_row`, `lag_column`, `value`, `low`, `high`, lag (0, 0) left out.
    """
    lags = [(row, column) for row in range(reach + 1) for column in range(reach + 1) if row or column]
    sums, information, unseen = (np.zeros(len(lags)) for _ in range(3))
    for item, expected, fitted in zip(powers, expected_DN2, quanta_DN2, strict=True):
        side = item.square_px
        order = np.arange(side // 2 + 1)
        share = mode_share(side)
        shown = item.smeared(fitted)
        seen = item.used & (shown > 0)
        raised = fitted / np.where(seen, shown, 1.0)
        quanta = np.where(seen, fitted + raised * (item.filled(expected) - expected), fitted)
        whole = float(np.sum(share * quanta))
        if not whole > 0:
            continue
        scatter = np.where(seen, (raised * expected) ** 2 / np.where(seen, item.modes, 1.0), 0.0)
        for number, (row, column) in enumerate(lags):
            wave = np.outer(np.cos(2 * np.pi * order * row / side), np.cos(2 * np.pi * order * column / side))
            value = float(np.sum(share * wave * quanta)) / whole
            variance = float(np.sum((share * (wave - value)) ** 2 * scatter)) / whole**2
            sums[number] += value / variance
            information[number] += 1.0 / variance
            unseen[number] += float(np.sum(np.where(seen, 0.0, share * (wave - value) * quanta))) / whole / variance
    rows = []
    for (row, column), total, weight, model in zip(lags, sums, information, unseen, strict=True):
        if weight > 0:
            value, half = total / weight, Z95 * math.hypot(1.0 / math.sqrt(weight), unseen_sd * model / weight)
            rows.append(
                {"lag_row": row, "lag_column": column, "value": value, "low": value - half, "high": value + half}
            )
    return rows

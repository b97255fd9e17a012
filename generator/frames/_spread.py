"""Blur and noise correlation of one series: transfer functions on cosine transforms, whose borders mirror."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..line.line_state import FloatArray, LineState
from ..spread._fine_picture import averaging, cosines_at_pixels, fine_frequencies, kept_cosines, sampled_picture
from ..spread.psf import Spread, base_transfer_1d, convolve_separable, whole_spectrum
from ._distortion import distorted

Kept = Callable[[object, Callable[[], Any]], Any]  # (name, make) -> what is made once under the name

_GRID = 64  # cells of the noise power spectrum per axis
_REACH = 14  # of the noise kernel where effects change it, px
_SHOWN = 4  # lags of the autocovariance, 0 included


@dataclass(frozen=True, slots=True)
class NoisePattern:
    """Correlation of quantum noise after the spread.

    Fields: share (of the variance that is left in one pixel); autocovariance (4, 4), 1 at lag 0; kernel: what white noise
    per pixel is convolved with, per axis (2 R + 1,) or (2 R + 1, 2 R + 1).
    """

    share: float
    autocovariance: FloatArray
    kernel: FloatArray

    def squared_transfer(self, f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        """Transfer function (n, m) from the variance before the spread to the variance of the pixels."""
        reach = self.kernel.shape[0] // 2
        square = self.kernel[..., reach:] ** 2
        steps = np.arange(reach + 1)
        weight = np.where(steps == 0, 1.0, 2.0)
        rows = np.cos(2 * np.pi * f_row * steps) * weight
        columns = np.cos(2 * np.pi * f_column.T * steps) * weight
        separable = self.kernel.ndim == 1
        found = np.outer(rows @ square, columns @ square) if separable else rows @ square[reach:] @ columns.T
        return np.asarray(found * (self.share / found[0, 0]))

    def sample(
        self, mean_DN: FloatArray, quantum_DN: FloatArray, shape: tuple[int, int], rng: np.random.Generator
    ) -> FloatArray:
        """Noise of zero mean (row, column): quanta of `quantum_DN` each, counted per pixel, then spread.

        Args:
            mean_DN: before the spread, (row, column) or (1, 1), 0 or more.
            quantum_DN: DN a quantum, of the same shape.
        """
        reach = self.kernel.shape[0] // 2
        wide = (shape[0] + 2 * reach, shape[1] + 2 * reach)
        if mean_DN.shape == (1, 1):
            mean, quantum = np.broadcast_to(mean_DN, wide), np.broadcast_to(quantum_DN, wide)
        else:
            mean, quantum = (np.pad(values, reach, mode="symmetric") for values in (mean_DN, quantum_DN))
        expected = mean / quantum
        counts = (rng.poisson(expected) - expected) * quantum
        if self.kernel.ndim == 1:
            spread = convolve_separable(counts, self.kernel, mode="constant")
        else:
            from scipy.signal import oaconvolve

            spread = oaconvolve(counts, self.kernel, mode="same")
        return np.asarray(spread[reach : reach + shape[0], reach : reach + shape[1]], dtype=np.float64)


@lru_cache(maxsize=64)
def _base_pattern(spread: Spread) -> NoisePattern:
    table = spread.noise_autocovariance(_SHOWN - 1)[_SHOWN - 1 :, _SHOWN - 1 :]
    return NoisePattern(
        share=float(table[0, 0]),
        autocovariance=table / table[0, 0],
        kernel=np.asarray(spread.noise_kernel, dtype=np.float64),
    )


def optical_transfer(state: LineState, spread: Spread, f_row: FloatArray, f_column: FloatArray) -> FloatArray:
    """Transfer function of the light's spread (n, m): the calibrated one, tails in part in its place, and factors."""
    result = spread.transfer(f_row, f_column)
    if state.tails:
        left = 1.0 - sum(weight for weight, _ in state.tails)
        result = left * result
        for weight, transfer in state.tails:
            result = result + weight * transfer(f_row, f_column)
    for factor in state.optical_transfers:
        result = result * factor(f_row, f_column)
    return np.asarray(result)


def noise_pattern(spread: Spread, state: LineState) -> NoisePattern:
    """Noise correlation with the state's spread.

    Where nothing changes the calibrated spread it is that of `psf`. Else the power of quanta that land anywhere in a
    pixel, whose light square pixels collect and sample (`aperture`): sum over aliases of |H|^2 sinc^2, and that of the
    calibrated spread is replaced by it.
    """
    if not (state.tails or state.optical_transfers or state.power_transfers):
        return _base_pattern(spread)
    frequency = np.arange(_GRID // 2 + 1) / _GRID
    power = spread.noise_power(_GRID)
    aliases = 0 if spread.model == "sampled" else 2 if spread.sigma_px > 0.4 and spread.tail_share == 0 else 4
    order = np.arange(-aliases, aliases + 1)

    def aliased(axis: str) -> FloatArray:
        """Frequencies along an axis with their aliases; 0 where it counts lines, which share no light."""
        return (frequency[:, None] + order).ravel() if spread.axes in ("both", axis) else np.zeros(frequency.size)

    rows, columns = aliased("row"), aliased("column")
    f_row, f_column = rows[:, None], columns[None, :]
    before = spread.transfer(f_row, f_column)
    change = optical_transfer(state, spread, f_row, f_column) ** 2
    for factor in state.power_transfers:
        change = change * factor(f_row, f_column)
    change = change - before**2
    if aliases:
        change = change * np.sinc(f_row) ** 2 * np.sinc(f_column) ** 2
        change = change.reshape(frequency.size, -1, frequency.size, columns.size // frequency.size).sum(axis=(1, 3))
    power = np.maximum(power + change, 0.0)
    whole = whole_spectrum(power)
    covariance = np.fft.ifft2(whole).real
    impulse = np.fft.fftshift(np.fft.ifft2(np.sqrt(whole)).real)
    middle = slice(_GRID // 2 - _REACH, _GRID // 2 + _REACH + 1)
    return NoisePattern(
        share=float(covariance[0, 0]),
        autocovariance=covariance[:_SHOWN, :_SHOWN] / covariance[0, 0],
        kernel=np.ascontiguousarray(impulse[middle, middle]),
    )


@lru_cache(maxsize=64)
def _frequencies(length: int) -> NDArray[np.float64]:
    return np.arange(length) / (2.0 * length)


@lru_cache(maxsize=32)
def _drawing(
    length: int,
    points: int,
    kept: int,
    psf_model: str,
    psf_sigma_px: float,
    shift_px: float,
    places_px: tuple[float, ...] = (),
) -> NDArray[np.float64]:
    """What the calibrated spread and a displacement make of pixels or cells along one axis: (length, points)."""
    order = np.arange(kept)
    transfer = base_transfer_1d(psf_model, psf_sigma_px, order / (2.0 * length))
    if points > length:
        transfer = transfer * averaging(points)[:kept]
    return np.asarray(
        (cosines_at_pixels(length, points, kept, shift_px, places_px) * transfer) @ _cosines(points, kept)
    )


@lru_cache(maxsize=8)
def _cosines(points: int, kept: int) -> NDArray[np.float64]:
    """The first cosines (kept, points) of a cosine transform over `points`."""
    return np.asarray(2.0 * np.cos(np.pi / points * np.outer(np.arange(kept), np.arange(points) + 0.5)))


def object_transfer(state: LineState, f_row: FloatArray, f_column: FloatArray) -> NDArray[np.inexact] | None:
    """Transfer function (n, m) of what blurs what stands in the beam, None: nothing does.

    Where a blur goes to one side it is complex, (2, n, m): at (f_row, f_column) and at (f_row, -f_column).
    """
    if not state.object_transfers:
        return None

    def product(f_column: FloatArray) -> NDArray[np.inexact]:
        parts = [factor(f_row, f_column) for factor in state.object_transfers]
        return np.asarray(math.prod(parts[1:], start=parts[0]))

    found = product(f_column)
    return np.stack(np.broadcast_arrays(found, product(-f_column))) if np.iscomplexobj(found) else found


def spread_maps(
    signal_DN: FloatArray,
    variance_DN2: FloatArray,
    *,
    state: LineState,
    pattern: NoisePattern,
    spread: Spread,
    draft: bool = False,
    kept: Kept | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Picture after all blur (DN), and quantum variance after blur of the object and spread of the quanta (DN^2).

    draft: a third of the work for pictures that are compared with each other: the variance is blurred by what stands before the
    detector alone and not displaced (it is right away from edges), and cosines that the spread leaves below 1e-3 are left out.
    kept: keeps transfer functions for calls with the same blur and spread.
    """
    if signal_DN.shape == (1, 1):
        return signal_DN, pattern.share * variance_DN2
    shape = (signal_DN.shape[0], signal_DN.shape[1])
    from scipy.fft import dctn

    def once(name: object, make: Callable[[], Any]) -> Any:
        return make() if kept is None else kept(name, make)

    fine = state.picture
    nothing = np.zeros((1, 1))
    along = (
        optical_transfer(state, spread, fine_frequencies(shape[0])[:, None], nothing),
        optical_transfer(state, spread, nothing, fine_frequencies(shape[1])[None, :]),
    )
    cosines = [kept_cosines(one.ravel(), 1e-3 if draft else 1e-5) for one in along]
    rest = signal_DN if fine is None else None if signal_DN is fine.signal_DN else signal_DN - fine.signal_DN
    blurred: NDArray[np.floating] = np.zeros(shape)
    if spread.separable and not (state.object_transfers or state.tails or state.optical_transfers):

        def drawn(picture: NDArray[np.floating], counts: Sequence[int]) -> FloatArray:
            rows, columns = (
                _drawing(length, points, count, spread.model, spread.sigma_px, shift, places)
                for length, points, count, shift, places in zip(
                    shape, picture.shape, counts, state.shift_px, state.course_px, strict=True
                )
            )
            return np.asarray(rows @ picture @ columns.T)

        if fine is not None:
            key = (spread, state.shift_px, state.course_px, *cosines)
            if key not in fine.fine.drawn:
                fine.fine.drawn[key] = drawn(fine.fine.cells, cosines)
            blurred = fine.scale * fine.fine.drawn[key]
        if rest is not None:
            blurred = blurred + drawn(rest, shape)
    else:

        def transfer(counts: Sequence[int]) -> NDArray[np.inexact]:
            def made() -> NDArray[np.inexact]:
                frequency = [fine_frequencies(length)[:count] for length, count in zip(shape, counts, strict=True)]
                f_row, f_column = frequency[0][:, None], frequency[1][None, :]
                whole = optical_transfer(state, spread, f_row, f_column)
                blur = object_transfer(state, f_row, f_column)
                return whole if blur is None else whole * blur

            return np.asarray(once((shape, *counts), made))

        pictures: list[tuple[NDArray[np.floating], NDArray[np.inexact]]] = []
        if fine is not None:
            sharp = fine.scale * fine.fine.transform[: cosines[0], : cosines[1]]
            pictures.append((sharp, transfer(cosines)))
        if rest is not None:
            pictures.append((dctn(rest, type=2), transfer(shape)))
        blurred = sampled_picture(pictures, shape, state.shift_px, state.course_px)
    radial_px, turn_px = state.distortion_px
    blurred = distorted(np.asarray(blurred, dtype=np.float64), radial_px=radial_px, turn_px=turn_px)
    f_row, f_column = _frequencies(shape[0])[:, None], _frequencies(shape[1])[None, :]
    blur = once(("object", shape), lambda: object_transfer(state, f_row, f_column))
    if draft:
        variance = (
            variance_DN2 if blur is None else sampled_picture([(dctn(variance_DN2, type=2), blur)], shape, (0.0, 0.0))
        )
        return blurred, pattern.share * np.maximum(variance, 0.0)
    power = pattern.squared_transfer(f_row, f_column)
    variance = sampled_picture(
        [(dctn(variance_DN2, type=2), power if blur is None else power * blur)],
        shape,
        state.shift_px,
        state.course_px,
    )
    variance = distorted(variance, radial_px=radial_px, turn_px=turn_px)
    return blurred, np.maximum(variance, 0.0)


def blurred_object(state: LineState) -> tuple[FloatArray, FloatArray]:
    """Signal and variance before the spread of light, with the blur of the object in them, 0 or more."""
    signal, variance = state.signal_DN, state.variance_DN2
    still = state.shift_px == state.distortion_px == (0.0, 0.0) and state.course_px == ((), ())
    if signal.shape == (1, 1) or (still and not state.object_transfers):
        return signal, variance
    from scipy.fft import dctn

    shape = (signal.shape[0], signal.shape[1])
    blur = object_transfer(state, _frequencies(shape[0])[:, None], _frequencies(shape[1])[None, :])
    radial_px, turn_px = state.distortion_px
    spread = [
        distorted(
            sampled_picture([(dctn(one, type=2), blur)], shape, state.shift_px, state.course_px),
            radial_px=radial_px,
            turn_px=turn_px,
        )
        for one in (signal, variance)
    ]
    floor = 1e-12 * max(float(signal.max()), 1e-300)
    return np.maximum(spread[0], floor), np.maximum(spread[1], 0.0)


def from_beyond(state: LineState, spread: Spread) -> FloatArray:
    """What pixels would get more (row, column), DN, if the picture went on as it ends beyond its borders, and did not mirror there.

    What effects blur alone: the calibrated spread ends within some pixels.
    """
    rows, columns = state.signal_DN.shape
    if not (state.object_transfers or state.optical_transfers or state.tails):
        return np.zeros((rows, columns))
    from scipy.fft import fftfreq, irfft2, rfft2, rfftfreq

    around = ((rows, rows), (columns, columns))
    more = np.pad(state.signal_DN, around, mode="edge") - np.pad(state.signal_DN, around, mode="symmetric")
    f_row, f_column = fftfreq(3 * rows)[:, None], rfftfreq(3 * columns)[None, :]
    transfer: NDArray[np.inexact] = optical_transfer(state, spread, f_row, f_column)
    blur = object_transfer(state, f_row, f_column)
    if blur is not None:
        transfer = transfer * (blur[0] if np.iscomplexobj(blur) else blur)
    transfer = transfer - spread.transfer(f_row, f_column)
    found = irfft2(transfer * rfft2(more), s=more.shape)
    return np.asarray(found[rows : 2 * rows, columns : 2 * columns])

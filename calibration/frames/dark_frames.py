"""Dark frames of a session: their mean by exposure time, growth and noise; what they say of dark level and read noise."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import Series
from ...generator.line.twin import Estimate, estimate_from_sd
from ._kept_sums import KeptSums
from .frame_sums import effective_frames


@dataclass(frozen=True, slots=True)
class DarkFrames:
    """Dark frames: the mean at each session and exposure, growth, and the pairs' variance over all sessions.

    Fields: by_exposure: mean frame (row, column), DN, by session and exposure (ms); sums of each series; per_ms: growth (row,
    column), DN/ms; variance: of one exposure, DN^2 (row, column), NaN where nothing was repeated, from `effective` independent
    frames.
    """

    by_exposure: dict[tuple[int, float | None], NDArray[np.float64]]
    sums: list[tuple[Series, KeptSums]]
    per_ms: NDArray[np.float64]
    variance: NDArray[np.float64]
    effective: float

    @classmethod
    def taken_off(cls, shape: tuple[int, int], measured: "DarkFrames | None" = None) -> "DarkFrames":
        """Of frames that are offset-corrected already: zeros, with the noise of what was measured."""
        zero = np.zeros(shape)
        if measured is None:
            return cls({(0, None): zero}, [], zero, np.full(shape, np.nan), 0.0)
        return cls({(0, None): zero}, measured.sums, zero, measured.variance, measured.effective)

    @property
    def repeated(self) -> list[tuple[Series, KeptSums]]:
        """Series of two frames or more."""
        return [(item, total) for item, total in self.sums if total.pairs > 0]

    def variance_between_series(self) -> tuple[NDArray[np.float64], float]:
        """Variance of one exposure (DN^2; row, column) from successive series of a session and exposure, and of how many
        independent frames; NaN and 0 where no two are of one.

        What changed in single pixels from series to series is in it. The level of each difference, its median, is not.
        """
        total, effective = np.zeros(self.per_ms.shape), 0.0
        for key in self.by_exposure:
            some = [(item, sums) for item, sums in self.sums if (item.session, item.exposure_ms) == key]
            share = effective_frames(len(some)) / max(len(some) - 1, 1)
            for (first, first_sums), (second, second_sums) in pairwise(some):
                change = second_sums.mean_DN - first_sums.mean_DN
                counts = (first_sums.frames * first.averaged, second_sums.frames * second.averaged)
                total += share * (change - np.median(change)) ** 2 / sum(1.0 / count for count in counts)
                effective += share
        return (total / effective, effective) if effective else (np.full(total.shape, np.nan), 0.0)

    def of(self, item: Series) -> NDArray[np.float64]:
        """The dark frame (row, column) of a series, DN: of its own session where that has darks; 0 where it is taken off."""
        return np.zeros(item.shape) if "offset" in item.corrected else self.at(item.session, item.exposure_ms)

    def key_of(self, item: Series) -> tuple[int, float | None] | None:
        """Session and exposure of the dark frame that `of` takes or grows from; None where it is taken off already."""
        if "offset" in item.corrected or not self.sums:
            return None
        sessions = sorted({key[0] for key in self.by_exposure}, key=lambda one: (abs(one - item.session), one))
        exposures = [key[1] for key in self.by_exposure if key[0] == sessions[0]]
        known = [exposure for exposure in exposures if exposure is not None]
        if item.exposure_ms in exposures or item.exposure_ms is None or not known:
            return (sessions[0], item.exposure_ms if item.exposure_ms in exposures else exposures[0])
        wanted = item.exposure_ms
        return (sessions[0], min(known, key=lambda exposure: abs(exposure - wanted)))

    def unknown_growth_ms(self, item: Series) -> float:
        """By how much the exposure of a series is longer than that of its dark frame, where no session has darks at two exposures."""
        known = {key for key in self.by_exposure if key[1] is not None}
        key = self.key_of(item)
        if len(known) > len({session for session, _ in known}) or key is None or key[1] is None:
            return 0.0
        return 0.0 if item.exposure_ms is None else item.exposure_ms - key[1]

    def exposures_of(self, item: Series) -> int:
        """How many exposures the dark frame of a series is the mean of; 0 where it is taken off already."""
        key = self.key_of(item)
        return sum(total.frames * one.averaged for one, total in self.sums if (one.session, one.exposure_ms) == key)

    def at(self, session: int, exposure_ms: float | None) -> NDArray[np.float64]:
        """The dark frame (row, column) of an exposure time, DN: measured, or grown from the nearest that was."""
        sessions = sorted({key[0] for key in self.by_exposure}, key=lambda one: (abs(one - session), one))
        exposures = {key[1]: mean for key, mean in self.by_exposure.items() if key[0] == sessions[0]}
        if exposure_ms in exposures:
            return exposures[exposure_ms]
        known = [key for key in exposures if key is not None]
        if exposure_ms is None or not known:
            return next(iter(exposures.values()))
        nearest = min(known, key=lambda key: abs(key - exposure_ms))
        return np.asarray(exposures[nearest] + self.per_ms * (exposure_ms - nearest))

    def noise_at(self, session: int, exposure_ms: float | None) -> tuple[float, float, float] | None:
        """Noise of `at` and of what grows from it, as `DetectorMaps.dark_noise` has it; None: the dark was subtracted before."""
        exposures = {
            key: sum(total.frames * one.averaged for one, total in self.sums if (one.session, one.exposure_ms) == key)
            for key in self.by_exposure
        }
        sessions = sorted({key[0] for key in self.by_exposure}, key=lambda one: (abs(one - session), one))
        own = (sessions[0], exposure_ms)
        if not exposures.get(own):
            return None
        weights, denominator = _growth_weights({key: count for key, count in exposures.items() if count})
        growth = {key: weight / denominator for key, weight in weights.items()} if denominator > 0 else {}
        return (
            1.0 / exposures[own],
            2.0 * growth.get(own, 0.0) / exposures[own],
            sum(weight**2 / exposures[key] for key, weight in growth.items()),
        )

    def noise_under(self, shares: Sequence[tuple[Series, float]]) -> float:
        """Variance that noise of the darks gives a pixel of a weighted mean of series, over that of one exposure; growth apart."""
        together: dict[tuple[int, float | None], tuple[float, int]] = {}
        for item, share in shares:
            key, count = self.key_of(item), self.exposures_of(item)
            if key is not None and count:
                together[key] = together.get(key, (0.0, count))[0] + share, count
        return sum(share**2 / count for share, count in together.values())


def _growth_weights(
    counts: Mapping[tuple[int, float | None], float],
) -> tuple[dict[tuple[int, float | None], float], float]:
    """Weight of each mean dark in the growth with exposure, by session and exposure, and what their sum is divided by.

    A line in each session, one slope for all; counts: weight of each dark in its session's line.
    """
    weights: dict[tuple[int, float | None], float] = {}
    denominator = 0.0
    for session in {key[0] for key in counts}:
        times = {key: key[1] for key in counts if key[0] == session and key[1] is not None}
        if len(times) < 2:
            continue
        middle = sum(counts[key] * time for key, time in times.items()) / sum(counts[key] for key in times)
        for key, time in times.items():
            weights[key] = counts[key] * (time - middle)
            denominator += counts[key] * (time - middle) ** 2
    return weights, denominator


def sum_darks(series: Sequence[Series], shape: tuple[int, int], sums_of: Callable[[Series], KeptSums]) -> DarkFrames:
    """Dark frames of series of one shape (row, column)."""
    sums = [(item, sums_of(item)) for item in series]
    grouped: dict[tuple[int, float | None], list[KeptSums]] = {}
    for item, total in sums:
        grouped.setdefault((item.session, item.exposure_ms), []).append(total)
    frames = {key: sum(total.frames for total in totals) for key, totals in grouped.items()}
    by_exposure = {
        key: np.asarray(sum(total.mean_DN * total.frames for total in totals) / frames[key])
        for key, totals in grouped.items()
    }
    per_ms = np.zeros(shape)
    weights, denominator = _growth_weights(frames)
    for key, weight in weights.items():
        per_ms += weight / denominator * by_exposure[key]
    variance = np.full(shape, np.nan)
    pairs = [(item, total) for item, total in sums if total.pairs > 0]
    effective = sum(effective_frames(total.frames) for _, total in pairs)
    if pairs:
        variance = np.asarray(
            sum(total.pair_variance_DN2 * (item.averaged * effective_frames(total.frames)) for item, total in pairs)
            / effective
        )
    return DarkFrames(by_exposure=by_exposure, sums=sums, per_ms=per_ms, variance=variance, effective=effective)


def dark_estimate(
    darks: DarkFrames,
    good: NDArray[np.bool_],
    session: int,
    exposures: Sequence[float | None],
    read_DN2: float,
) -> tuple[Estimate, float | None]:
    """Median dark (DN) of a session at the shortest exposure of its flats that was measured dark; spread of repeats
    included."""
    known = sorted(key[1] for key in darks.by_exposure if key[0] == session and key[1] is not None)
    shared = [key for key in known if key in exposures]
    candidates = shared or known
    exposure = candidates[0] if candidates else None
    mean = darks.at(session, exposure)
    integer = all(total.integer for _, total in darks.sums)
    there = [(item, total) for item, total in darks.sums if item.session == session and item.exposure_ms == exposure]
    level = _median_of_means(mean[good], sum(total.frames for _, total in there), integer)
    repeats = [_median_of_means(total.mean_DN[good], total.frames, total.integer) for _, total in there]
    frames = sum(total.frames for _, total in there)
    pixels = int(good.sum())
    if darks.effective > 0:
        noise = float(np.nanmedian(darks.variance[good])) / max(frames, 1)
    else:
        noise = max(read_DN2, 0.0) / max(sum(total.frames * item.averaged for item, total in there), 1)
    # frame noise carries pixels over the median of the map: sd^2 = E|noise| / (pixels x density at the median)
    low, high = np.quantile(mean[good], [0.4, 0.6])
    sd = math.sqrt(math.sqrt(2.0 * noise / math.pi) * max(float(high - low), 0.5 * math.sqrt(noise)) / 0.2 / pixels)
    if len(repeats) > 1:
        sd = max(sd, float(np.std(repeats, ddof=1)) / math.sqrt(len(repeats)))
    return estimate_from_sd(level, max(sd, 1e-9)), exposure


def _median_of_means(values: NDArray[np.float64], frames: int, integer: bool) -> float:
    """Median of pixel means; means of few whole numbers tie, so the ties are taken as spread over their step."""
    middle = float(np.median(values))
    if not integer or frames < 1:
        return middle
    step = 1.0 / frames
    # an even number of pixels may put the median between two steps
    middle = float(np.partition(values, len(values) // 2)[len(values) // 2])
    below = int(np.count_nonzero(values < middle - 0.5 * step))
    tied = int(np.count_nonzero(np.abs(values - middle) <= 0.5 * step))
    return middle - 0.5 * step + step * (0.5 * len(values) - below) / tied


def dark_map_sd(
    darks: DarkFrames, good: NDArray[np.bool_], session: int, exposure_ms: float | None, read_DN2: float
) -> float | None:
    """Standard deviation of one pixel of the dark frame (DN), from the frames it is the mean of; `read_DN2` where these
    show no noise."""
    frames = sum(
        total.frames * item.averaged
        for item, total in darks.sums
        if (item.session, item.exposure_ms) == (session, exposure_ms)
    )
    if frames == 0:
        return None
    variance = float(np.mean(darks.variance[good])) if darks.effective >= 1 else read_DN2
    return math.sqrt(max(variance, 0.0) / frames)


def read_variance_map(
    darks: DarkFrames, good: NDArray[np.bool_], pooled: float
) -> tuple[NDArray[np.float64], float | None]:
    """Electronic and rounding variance per pixel (row, column), shrunk towards the pooled value, DN^2; its relative
    standard deviation in one pixel."""
    if darks.effective < 1 or not np.all(np.isfinite(darks.variance)):
        return np.full(darks.per_ms.shape, max(pooled, 0.0)), None
    ratio = darks.variance / max(float(np.mean(darks.variance[good])), 1e-12)
    noise = 2.0 / darks.effective
    keep = shrinkage(ratio[good], noise)
    result = max(pooled, 0.0) * (1.0 + keep * (ratio - 1.0))
    return np.asarray(np.where(good, result, pooled * ratio)), math.sqrt(keep * noise)


def shrinkage(ratio: NDArray[np.float64], noise: float) -> float:
    """Share of a map's spread about 1 that is real rather than sampling noise of variance `noise`."""
    low, high = np.quantile(ratio, [0.1587, 0.8413])
    total = (0.5 * float(high - low)) ** 2
    return max(0.0, 1.0 - noise / total) if total > 0 else 0.0

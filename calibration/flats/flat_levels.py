"""Flats of a session: each series as photon transfer sees it, the level of each beam, and the pixels' relative gain."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.setting import Filter, text_from_filters
from ...generator.line.twin import Estimate, Level, estimate_from_sd
from ..frames._kept_sums import KeptSums
from ..frames.dark_frames import DarkFrames, shrinkage
from ..frames.frame_sums import effective_frames
from ..frames.robust import robust_sd
from .noise_of_flats import FlatNoise
from .repeated_frames import beam_of

_SERIES_REPRODUCIBILITY = 1e-3  # of the level: what series of one setting are weighted by, beside their noise


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesPoint:
    """One flat series as photon transfer sees it; per frame, detector means over good pixels.

    Fields: series, kV, filters, exposure_ms, load_mAs (None where unknown), frames, averaged, signal_DN (median),
    mean_signal_DN, pair_variance_DN2, stack_variance_DN2 (of one single frame: averaging undone; of a flat without a
    second frame what other series of its beam show), used (False: masked, with the reason in `masked`), drift_percent
    (change of the frame mean over the series), common_mode_percent (rms output noise from frame to frame), unknown_growth_ms
    (`DarkFrames.unknown_growth_ms`).
    """

    series: str
    kV: float | None
    filters: tuple[Filter, ...]
    exposure_ms: float | None
    load_mAs: float | None
    source_detector_mm: float | None
    photons_per_pixel: float | None
    frames: int
    averaged: int
    signal_DN: float
    mean_signal_DN: float
    pair_variance_DN2: float
    stack_variance_DN2: float
    used: bool
    masked: str
    drift_percent: float
    common_mode_percent: float
    unknown_growth_ms: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return {
            "series": self.series,
            "kV": self.kV,
            "filter": text_from_filters(self.filters),
            "exposure_ms": self.exposure_ms,
            "load_mAs": self.load_mAs,
            "source_detector_mm": self.source_detector_mm,
            "frames": self.frames,
            "averaged": self.averaged,
            "signal_DN": self.signal_DN,
            "pair_variance_DN2": self.pair_variance_DN2,
            "stack_variance_DN2": self.stack_variance_DN2,
            "used": self.used,
            "masked": self.masked,
            "drift_percent": self.drift_percent,
            "common_mode_percent": self.common_mode_percent,
            "unknown_growth_ms": self.unknown_growth_ms,
        }


def series_points(
    sums: Sequence[tuple[Series, KeptSums, str]], noise: FlatNoise, darks: DarkFrames, good: NDArray[np.bool_]
) -> tuple[SeriesPoint, ...]:
    """The flats, in order; sums: each with its sums and why it is left out (empty: it is not)."""
    order = {item.name: index for index, (item, _) in enumerate(noise.stacks)}
    points = []
    for item, total, reason in sums:
        signal = total.mean_DN - darks.of(item)
        index = order.get(item.name)
        source = noise.of_stacks[index] if index is not None else None
        means = total.frame_mean_DN
        drift = 0.0
        typical = float(np.mean(signal[good]))
        if total.frames > 2 and typical > 0:
            position = np.linspace(-0.5, 0.5, total.frames)
            drift = 100.0 * float(np.polyfit(position, means, 1)[0]) / typical
        why = reason
        if source is not None and not source.in_fit:
            why = "bends away from the photon-transfer line" if item.name in noise.bent else "no signal above dark"
        points.append(
            SeriesPoint(
                series=item.name,
                kV=item.kV,
                filters=item.filters,
                exposure_ms=item.exposure_ms,
                load_mAs=load_mAs_of(item),
                source_detector_mm=item.source_detector_mm,
                photons_per_pixel=item.photons_per_pixel,
                frames=total.frames,
                averaged=item.averaged,
                signal_DN=float(np.median(signal[good])),
                mean_signal_DN=typical,
                pair_variance_DN2=float(np.mean(total.pair_variance_DN2[good])) * item.averaged,
                stack_variance_DN2=float(np.mean(total.stack_variance_DN2[good])) * item.averaged,
                used=not why,
                masked=why,
                drift_percent=drift,
                common_mode_percent=100.0 * math.sqrt(source.power.common_mode) if source else 0.0,
                unknown_growth_ms=darks.unknown_growth_ms(item),
            )
        )
    return tuple(points)


def with_noise_of_others(points: Sequence[SeriesPoint], noise: FlatNoise) -> tuple[SeriesPoint, ...]:
    """Single-frame flats with the variance of one exposure and the output noise that others of their beam show."""
    result = []
    for point in points:
        beam = (point.kV, tuple(sorted(str(layer) for layer in point.filters)))
        known = noise.slope_of_single(beam) if point.used and point.frames < 2 else None
        if known is None:
            result.append(point)
            continue
        slope_DN, common = known
        variance = slope_DN * point.mean_signal_DN + noise.fit.read_variance_DN2
        result.append(
            replace(
                point,
                pair_variance_DN2=variance,
                stack_variance_DN2=variance,
                common_mode_percent=100.0 * math.sqrt(common),
            )
        )
    return tuple(result)


def load_mAs_of(item: Series) -> float | None:
    """Tube load of one exposure, mAs; None where it is not stated."""
    if item.kV is None or item.exposure_ms is None:
        return None
    current = (
        item.current_mA
        if item.current_mA is not None
        else (item.power_W / item.kV if item.power_W is not None else None)
    )
    return None if current is None else current * item.exposure_ms / 1000.0


def levels_of(
    acquisition: AcquisitionFile,
    noise: FlatNoise,
    darks: DarkFrames,
    good: NDArray[np.bool_],
    *,
    points: Sequence[SeriesPoint],
    saturation_DN: Mapping[str, float],
) -> tuple[Level, ...]:
    """Level, gain and shape of the field of each beam in use, in the fit's order; saturation_DN: of series that reach it, by name."""
    point_of = {point.series: point for point in points}
    fit = noise.fit
    saturated = [(beam_of(item), saturation_DN[item.name]) for item in acquisition.series if item.name in saturation_DN]
    levels = []
    for group, place in noise.place_in_fit.items():
        members = [(item, total) for item, total, fitted in noise.flats_in_fit if fitted == place]
        beam = noise.beams[group]
        shape_sum = np.zeros(good.shape)
        for item, total in members:
            shape_sum += (total.mean_DN - darks.of(item)) * total.frames
        centre = float(np.median(shape_sum[good]))
        frames = sum(total.frames for _, total in members)
        flat_shape = shape_sum / centre if centre > 0 else np.ones(good.shape)
        first = members[0][0]
        distance = first.source_detector_mm or acquisition.instrument.source_detector_mm
        same = [item for item, _ in members if (item.source_detector_mm or distance) == distance]
        levels.append(
            Level(
                kV=beam[0],
                filters=first.filters,
                gain_DN=estimate_from_sd(float(fit.gain_DN[place]), float(fit.gain_sd_DN[place])),
                photon_transfer_slope_DN=estimate_from_sd(float(fit.slope_DN[place]), float(fit.slope_sd_DN[place])),
                rate_DN_per_mAs=_rate([point_of[item.name] for item in same], darks, good, flat_shape),
                source_detector_mm=distance,
                saturation_DN=min((top_DN for of, top_DN in saturated if of == beam), default=None),
                flat_shape=flat_shape.astype(np.float32),
                series=tuple(item.name for item, _ in members),
                role="calibration",
                exposures=frames**2 / sum(total.frames / item.averaged for item, total in members),
                signal_DN=max(centre, 0.0) / frames,
                dark_noise=darks.noise_under([(item, total.frames / frames) for item, total in members]),
            )
        )
    return tuple(levels)


def _rate(
    points: Sequence[SeriesPoint], darks: DarkFrames, good: NDArray[np.bool_], flat_shape: NDArray[np.float64]
) -> Estimate | None:
    """Signal per mAs (DN) by weighted mean over the series; the scatter between them is part of the interval.

    What a single series cannot show, how well tube and filters repeat themselves, is not: the spectral fit learns it.
    """
    known = [point for point in points if point.load_mAs]
    if not known:
        return None
    load = np.array([point.load_mAs for point in known], dtype=np.float64)
    signal = np.array([point.signal_DN for point in known])
    noise = float(np.nanmedian(darks.variance[good])) if darks.effective > 0 else 0.0
    frames = np.array([point.frames * point.averaged for point in known], dtype=np.float64)
    of_a_pixel = (noise + np.array([p.pair_variance_DN2 for p in known])) / frames
    # robust: a few pixels far off do not move a median
    spread = robust_sd(flat_shape[good])
    sampling = median_variance(of_a_pixel, spread_sd=spread * signal, pixels=int(good.sum())) / load**2
    weight = 1.0 / (sampling + (_SERIES_REPRODUCIBILITY * signal / load) ** 2)
    weight /= weight.sum()
    rate = float(np.sum(weight * signal / load))
    variance = float(np.sum(weight**2 * sampling))
    if len(known) > 1:
        variance = max(variance, float(np.sum(weight * (signal / load - rate) ** 2)) / (len(known) - 1))
    return estimate_from_sd(rate, math.sqrt(variance))


def scatter_of_flats(points: Sequence[SeriesPoint]) -> dict[str, float] | None:
    """By how much a flat's level strays from that of its beam's other flats, each over its load; None: no beam has two.

    A response that bends, a dark that moved since, a current or a time that is not as set: all of them, as far as loads differ.

    Returns:
        relative_sd: standard deviation; degrees: of freedom.
    """
    groups: dict[tuple[Any, ...], list[float]] = {}
    for point in points:
        if point.used and point.load_mAs:
            beam = (point.kV, tuple(sorted(map(str, point.filters))), point.source_detector_mm)
            groups.setdefault(beam, []).append(point.signal_DN / point.load_mAs)
    rates = [np.array(members) for members in groups.values() if len(members) > 1]
    degrees = sum(len(one) - 1 for one in rates)
    if degrees < 1:
        return None
    squares = sum(float(np.sum((one / one.mean() - 1.0) ** 2)) for one in rates)
    return {"relative_sd": math.sqrt(squares / degrees), "degrees": float(degrees)}


def median_variance(noise_variance: ArrayLike, *, spread_sd: ArrayLike, pixels: int) -> NDArray[np.float64]:
    """Variance of the median of a fixed map under noise, in the unit of `noise_variance`.

        var = s sqrt((2 m)^2 + (pi / 2 s)^2) / n

    s: noise sd of a pixel, m: sd of the map. Where m >> s only the pixels within s of the median can move it, so its noise is
    sqrt(2 m / s) times that of the mean. Right at both ends, between them within 15 % for Gaussian maps.
    """
    noise = np.asarray(noise_variance, dtype=np.float64)
    spread = np.asarray(spread_sd, dtype=np.float64)
    return np.asarray(np.sqrt(noise * (4.0 * spread**2 + (0.5 * math.pi) ** 2 * noise)) / pixels)


def gain_map_of(
    noise: FlatNoise, darks: DarkFrames, good: NDArray[np.bool_], *, read_map: NDArray[np.float64], estimator: str
) -> tuple[NDArray[np.float64], float | None]:
    """Gain of each pixel over the detector median (row, column), shrunk towards 1 as far as its own slope is noise, and
    the standard deviation of one pixel's value: of noise s^2 and true spread t^2, s t / sqrt(s^2 + t^2).

    Args:
        noise: of the flats.
        darks: dark frames.
        good: pixels in use (row, column).
        read_map: electronic and rounding variance (row, column), DN^2.
        estimator: as in `compute_photon_transfer`.
    """
    fit = noise.fit
    numerator = np.zeros(good.shape)
    weight_sum = 0.0
    for item, total, place in noise.flats_in_fit:
        if total.pairs < 1:
            continue
        slope = float(fit.slope_DN[place])
        signal = total.mean_DN - darks.of(item)
        typical = float(np.median(signal[good]))
        if slope <= 0 or typical <= 0:
            continue
        variance = slope * typical + fit.read_variance_DN2
        stack = estimator == "stack"
        effective = total.frames - 1.0 if stack else effective_frames(total.frames)
        weight = effective * (slope * typical / variance) ** 2 / 2.0
        own = total.stack_variance_DN2 if stack else total.pair_variance_DN2
        # in place: at full size every array that need not be made counts
        lit = signal > 0
        signal *= slope
        ratio = own * item.averaged
        ratio -= read_map
        np.divide(ratio, signal, out=ratio, where=lit)
        ratio[~lit] = 1.0
        ratio *= weight
        numerator += ratio
        weight_sum += weight
    if weight_sum <= 0:
        return np.ones(good.shape), None
    ratio = numerator / weight_sum
    ratio = ratio / float(np.median(ratio[good]))
    real = shrinkage(ratio[good], 1.0 / weight_sum)
    gain_map = np.where(good, np.clip(1.0 + real * (ratio - 1.0), 0.1, 10.0), 1.0)
    return np.asarray(gain_map), math.sqrt(real / weight_sum)

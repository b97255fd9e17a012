"""What the flats of a session say beside the fit: drift, lag, linearity, repeats, the shape of the noise."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.setting import text_from_filters
from ...generator.line.twin import Z95
from ..frames.dark_frames import DarkFrames
from ..spread.noise_power import correlation_of_quanta
from ..spread.series_scatter import series_differ
from .flat_levels import SeriesPoint, load_mAs_of, scatter_of_flats
from .noise_of_flats import FlatNoise
from .noise_sources import NoiseSource
from .repeated_frames import beam_of

_POOR_FIT = 2.0  # chi-square a degree of freedom: five standard deviations for 50 degrees


def flat_evidence(
    points: Sequence[SeriesPoint], noise: FlatNoise, darks: DarkFrames, good: NDArray[np.bool_]
) -> tuple[dict[str, Any], list[str]]:
    """What the series say about drift, lag, linearity and the shape of the noise, beside the fit; and warnings of it."""
    fit = noise.fit
    warnings: list[str] = []
    used = [point for point in points if point.used]
    ratio = _stack_over_pair_variance(used)
    if ratio is not None and ratio > 1.02:
        warnings.append(
            f"stack variances are {100 * (ratio - 1):.1f} % above pair variances: the level drifts or frames are"
            " correlated; gains come from pairs"
        )
    linearity = _linearity(used)
    read_DN2 = float(np.nanmedian(darks.variance[good])) if darks.effective > 0 else 0.0
    dark_frames = min((kept.frames for _, kept in darks.sums), default=1)
    left = np.asarray(fit.slope_DN / np.where(fit.gain_DN > 0, fit.gain_DN, np.nan))
    repeats = _repeats(
        used,
        read_DN2=read_DN2,
        dark_frames=dark_frames,
        pixels=int(good.sum()),
        share=float(np.nanmedian(left)) if np.isfinite(left).any() else 1.0,
    )
    for row in repeats:
        if abs(row["change_percent"]) > max(0.3, 5.0 * row["noise_percent"]):
            warnings.append(
                f"the level changed by {row['change_percent']:+.2g} % from {row['series'][0]} to {row['series'][-1]} at"
                " the same setting: output or detector drift between series"
            )
    if linearity is not None and linearity["largest_departure_percent"] > 1.0:
        warnings.append(
            "signal departs from a line in tube load or exposure by up to"
            f" {linearity['largest_departure_percent']:.2g} %"
        )
    misfit = fit.chi_square / max(fit.degrees, 1.0)
    if misfit > _POOR_FIT:
        warnings.append(
            f"no kernel family describes the noise power (chi-square {misfit:.1f} per degree of freedom of the best, {fit.family});"
            " the intervals are widened by the misfit"
        )
    ratios = _ratios_of_series(noise, darks)
    degrees = len(ratios) - len(fit.gain_DN) - 1
    warnings += _uneven(ratios, degrees=degrees)
    dark_levels = [
        {
            "series": item.name,
            "index": item.index,
            "exposure_ms": item.exposure_ms,
            "median_DN": float(np.median(total.mean_DN[good])),
            "frames": total.frames,
        }
        for item, total in darks.sums
    ]
    evidence = {
        "stack_over_pair_variance": ratio,
        "drift_percent_per_series": {p.series: p.drift_percent for p in used},
        "output_rms_percent": max((p.common_mode_percent for p in used), default=0.0),
        "repeated_settings": repeats,
        "linearity": linearity,
        "scatter_of_flats": scatter_of_flats(used),
        "scatter_of_noise": _scatter_of_noise(ratios, degrees=degrees),
        "dark": dark_levels,
        "line_noise_DN": {
            "rows": math.sqrt(fit.row_variance_DN2),
            "columns": math.sqrt(fit.column_variance_DN2),
        },
        "noise_correlation": _correlation_of_quanta(noise),
        "spread_fit": {
            "family": fit.family,
            "chi_square_per_degree": misfit,
            "degrees": fit.degrees,
            "criteria": fit.criteria,
            "white_fraction": [float(value) for value in fit.white_fraction],
            "gain_by_extrapolation_over_fit": _finite_pair(fit.other_route),
            "slow_changes": [
                {"variance_at_lowest_frequency_DN2": float(value)} for value in fit.excess_DN2 if value > 0
            ],
        },
        "photon_transfer": [point.as_dict() for point in points],
    }
    return evidence, warnings


def _stack_over_pair_variance(points: Sequence[SeriesPoint]) -> float | None:
    """Mean ratio of the variance about the mean to that of successive frames, weighted by frames; 1 without drift."""
    lit = [p for p in points if p.pair_variance_DN2 > 0 and math.isfinite(p.stack_variance_DN2) and p.frames > 2]
    if not lit:
        return None
    weights = np.array([p.frames for p in lit], dtype=np.float64)
    return float(np.average([p.stack_variance_DN2 / p.pair_variance_DN2 for p in lit], weights=weights))


def _sources_of(noise: FlatNoise) -> tuple[NoiseSource, ...]:
    return (*noise.of_stacks, *noise.of_pairs, *noise.of_others, *noise.of_darks)


def _ratios_of_series(noise: FlatNoise, darks: DarkFrames) -> list[tuple[str, float, float]]:
    """Of each series in the fit of the spread: its name (empty where it has none), measured over fitted noise, its sd."""
    names = [item.name for item, _ in noise.stacks]
    names += [""] * (len(noise.of_pairs) + len(noise.of_others))
    names += [item.name for item, _ in darks.repeated]
    in_fit = [name for name, source in zip(names, _sources_of(noise), strict=True) if source.in_fit]
    return [(name, *ratio) for name, ratio in zip(in_fit, noise.fit.series_ratio, strict=True)]


def _correlation_of_quanta(noise: FlatNoise) -> list[dict[str, float]]:
    """Correlation of neighbouring pixels' quantum noise in the series of the fit, see `correlation_of_quanta`."""
    fit = noise.fit
    in_use = [source for source in _sources_of(noise) if source.in_fit]
    bright = [number for number, source in enumerate(in_use) if source.group >= 0]
    return correlation_of_quanta(
        [in_use[number].power for number in bright],
        [fit.expected_DN2[number] + fit.slow_DN2[number] for number in bright],
        [fit.quanta_DN2[number] for number in bright],
        unseen_sd=float(np.median(fit.gain_sd_DN / np.maximum(fit.gain_DN, 1e-300))),
    )


def _scatter_of_noise(ratios: Sequence[tuple[str, float, float]], *, degrees: int) -> dict[str, float] | None:
    """By how much the noise power of a series strays from the fitted one beyond its sampling; ratios as in `_uneven`.

    Returns:
        relative_sd: standard deviation; degrees: of freedom. None: there are none.
    """
    known = [(ratio - 1.0, sd) for _, ratio, sd in ratios if math.isfinite(ratio)]
    if degrees < 1 or not known:
        return None
    beyond = sum(off**2 for off, _ in known) / degrees - sum(sd**2 for _, sd in known) / len(known)
    return {"relative_sd": math.sqrt(max(beyond, 0.0)), "degrees": float(degrees)}


def _uneven(ratios: Sequence[tuple[str, float, float]], *, degrees: int) -> list[str]:
    """A warning where the noise of series differs by more than chance; ratios: name, measured over fitted noise, its sd."""
    if not series_differ([(ratio, sd) for _, ratio, sd in ratios], degrees):
        return []
    known = [(name, ratio, (ratio - 1.0) / sd) for name, ratio, sd in ratios if math.isfinite(ratio)]
    total = sum(z**2 for *_, z in known)
    name, ratio, _ = max(known, key=lambda one: abs(one[2]))
    farthest = f"{name} has" if name else "one has"
    return [
        f"the noise of the series departs from one line by more than chance (chi-square {total / degrees:.1f} a series;"
        f" {farthest} {ratio:.3g} of the fitted noise); the intervals are widened by that"
    ]


def _finite_pair(route: tuple[float, float]) -> dict[str, float] | None:
    value, sd = route
    return {"value": value, "low": value - Z95 * sd, "high": value + Z95 * sd} if math.isfinite(sd) else None


def session_evidence(
    acquisition: AcquisitionFile, flats: Sequence[Series], noise: FlatNoise, darks: DarkFrames, good: NDArray[np.bool_]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Per session: its series, dark levels, levels a mAs, and their change since the first session that has the same; and warnings.

    Nothing for one session.
    """
    numbers = sorted({item.session for item in [*flats, *(item for item, _ in darks.sums)]})
    warnings: list[str] = []
    if len(numbers) < 2:
        return [], warnings
    dark_first: dict[float | None, float] = {}
    rate_first: dict[tuple[Any, ...], float] = {}
    found = []
    for number in numbers:
        dark_change: dict[str, float] = {}
        for key, mean in darks.by_exposure.items():
            if key[0] == number:
                level = float(np.median(mean[good]))
                dark_change[f"{key[1]:g} ms" if key[1] is not None else "unknown"] = level - dark_first.setdefault(
                    key[1], level
                )
        loads: dict[tuple[Any, ...], list[tuple[float, float]]] = {}
        for item, total, _ in noise.flats_in_fit:
            load = load_mAs_of(item)
            if load is not None and item.session == number:
                signal = float(np.median((total.mean_DN - darks.of(item))[good]))
                loads.setdefault((*beam_of(item), item.source_detector_mm), []).append((signal, load))
        level_change: dict[str, float] = {}
        for beam, pairs in loads.items():
            rate = sum(signal for signal, _ in pairs) / sum(load for _, load in pairs)
            name = f"{beam[0]:g} kV" + "".join(f" {layer}" for layer in beam[1])
            level_change[name] = 100.0 * (rate / rate_first.setdefault(beam, rate) - 1.0)
        found.append(
            {
                "session": number,
                "series": sum(item.session == number for item in acquisition.series),
                "dark_change_DN": dark_change,
                "level_change_percent": level_change,
            }
        )
        largest = max(level_change.values(), key=abs, default=0.0)
        if abs(largest) > 0.3:
            warnings.append(f"session {number + 1}: levels changed by up to {largest:+.2g} % since the first session")
        largest = max(dark_change.values(), key=abs, default=0.0)
        if abs(largest) > 1.0:
            warnings.append(
                f"session {number + 1}: the dark level moved by {largest:+.3g} DN; each session has its own darks"
            )
    return found, warnings


def _repeats(
    points: Sequence[SeriesPoint], *, read_DN2: float, dark_frames: int, pixels: int, share: float
) -> list[dict[str, Any]]:
    """Settings measured more than once: levels in order of time, sampling noise of each, change from first to last, %.

    Args:
        points: the flats.
        read_DN2: electronic variance of a pixel and frame.
        dark_frames: of the shortest dark series.
        pixels: that the levels are means of.
        share: of the quanta's variance that the spread leaves in one pixel; a mean over pixels carries all of it.
    """
    groups: dict[tuple[Any, ...], list[SeriesPoint]] = {}
    for point in points:
        key = (point.kV, point.filters, point.exposure_ms, point.load_mAs, point.photons_per_pixel)
        groups.setdefault((*key, point.source_detector_mm), []).append(point)
    rows = []
    for members in groups.values():
        if len(members) < 2:
            continue
        levels = [point.mean_signal_DN for point in members]
        change = 100.0 * (levels[-1] / levels[0] - 1.0)
        sampling = []
        for point in members:
            quanta_DN2 = max(point.pair_variance_DN2 - read_DN2, 0.0) / max(share, 1e-3)
            noise_DN2 = ((quanta_DN2 + read_DN2) / (point.frames * point.averaged) + read_DN2 / dark_frames) / pixels
            of_pixels = 100.0 * math.sqrt(noise_DN2) / max(point.mean_signal_DN, 1e-9)
            sampling.append(math.hypot(point.common_mode_percent / math.sqrt(point.frames), of_pixels))
        rows.append(
            {
                "series": [point.series for point in members],
                "mean_signal_DN": levels,
                "change_percent": change,
                "sampling_percent": sampling,
                "noise_percent": math.hypot(sampling[0], sampling[-1], 0.02),
            }
        )
    return rows


def _linearity(points: Sequence[SeriesPoint]) -> dict[str, Any] | None:
    """Departure of the signal from a line through zero in mAs (or photons, or ms) within each kV and filter, %."""
    groups: dict[tuple[Any, ...], list[SeriesPoint]] = {}
    for point in points:
        groups.setdefault((point.kV, point.filters, point.source_detector_mm), []).append(point)
    rows: list[dict[str, Any]] = []
    for members in groups.values():
        for quantity in ("load_mAs", "photons_per_pixel", "exposure_ms"):
            values = [getattr(point, quantity) for point in members]
            if all(value for value in values) and len(set(values)) > 1:
                load = np.array(values, dtype=np.float64)
                signal = np.array([point.signal_DN for point in members])
                slope = float(np.sum(signal) / np.sum(load))
                departure = 100.0 * (signal - slope * load) / np.max(signal)
                rows.append(
                    {
                        "kV": members[0].kV,
                        "filter": text_from_filters(members[0].filters),
                        "against": quantity,
                        "DN_per_unit": slope,
                        "departure_percent_of_full": [float(value) for value in departure],
                    }
                )
                break
    if not rows:
        return None
    largest = max(max(abs(value) for value in row["departure_percent_of_full"]) for row in rows)
    return {"largest_departure_percent": largest, "groups": rows}

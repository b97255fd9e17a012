"""Exposures and distances that are not as stated, a response that bends, a dark that grows: what flats of one beam say of them.

One error of all exposures, one of all distances, and one bend: a level S goes as (t + dt) / (d + dd)^2 (1 + b S / S_brightest). They
are nuisances. What they leave open widens levels at other exposures, distances and signals; nothing is corrected, as labels
are the user's to put right.

Where all darks have one exposure t_dark, nobody knows how much of them is dark current c: a level is then c (t - t_dark) too high,
and the gain, variance over level, as much too low.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...generator.line.measured_flats import USUAL_STRAY, rate_changes, stray_of_rates
from ...generator.line.twin import Z95, Level
from .flat_levels import SeriesPoint

# between a line's readout (0.02 ms) and the 1 ms that IEC 60601-2-54 allows a loading time, beside 10 % of it which all exposures
# share; each order of magnitude alike: rms sqrt((1 - 0.02^2) / (2 ln 50)) ms
EXPOSURE_SD_MS = 0.36
# relative: 21 CFR 1020.31 (e) allows indicators of the source-image distance 2 %, two standard deviations
DISTANCE_SD = 0.01
# Dark current is 0 to all of the dark level over the exposure, for no offset is negative: of that, each order of magnitude alike from
# a thousandth on, below which it is lost in any level. It fills no more of the full scale in a second than silicon photodiodes
# at room temperature leak (1 nA/cm2: Janesick, Photon Transfer, 2007, ch. 11) over what panels hold (5 nC/cm2: 1.6e6 electrons on
# 75 um, Konstantinidis et al. 2012, doi:10.1016/j.nima.2012.06.024).
_LEAST_DARK_SHARE = 1e-3
_FILLED_A_SECOND = 0.2
BEND_SD = 0.005  # at the brightest flat: panels and cameras state 1 % of linearity (EMVA 1288), two standard deviations
_ROUNDS = 20  # of sizes that are known better each time
_CLEAR = 3.0  # standard deviations: one line in 400 is told without cause


def dark_current_sd(dark_DN_per_ms: float, *, bits: int | None) -> float:
    """Standard deviation (DN/ms, about 0) of the dark current where darks of one exposure alone were measured.

    Args:
        dark_DN_per_ms: dark level over its exposure, the least of the session.
        bits: of the converter; None: not known.
    """
    largest = dark_DN_per_ms if bits is None else min(dark_DN_per_ms, 1e-3 * _FILLED_A_SECOND * 2.0**bits)
    return largest * math.sqrt((1.0 - _LEAST_DARK_SHARE**2) / (2.0 * math.log(1.0 / _LEAST_DARK_SHARE)))


def setting_errors(
    points: Sequence[SeriesPoint], *, source_detector_mm: float | None, dark_DN_per_ms_sd: float = 0.0
) -> dict[str, Any] | None:
    """What is known of them, from flats of the same kV and filter that differ in exposure, distance or signal.

    Args:
        points: flats in use.
        source_detector_mm: where a flat states no distance of its own.
        dark_DN_per_ms_sd: of the dark current (`dark_current_sd`), where no flat has a dark of its own exposure.

    Returns:
        exposure_ms, distance_mm, bend: value and sd of each, and dark_DN_per_ms where darks leave it open; second_moments: of the
        first three (3, 3), about 0; largest_DN: of the brightest flat. None: no flat has a load.
    """
    known = [point for point in points if point.load_mAs and point.exposure_ms and point.signal_DN > 0]
    if not known:
        return None
    distances = [point.source_detector_mm or source_detector_mm or 1000.0 for point in known]
    level = np.array([math.log(point.signal_DN / float(point.load_mAs or 1.0)) for point in known]) + 2.0 * np.log(
        distances
    )
    largest_DN = max(point.signal_DN for point in known)
    change = np.stack(
        [
            rate_changes(exposure_ms=point.exposure_ms, source_detector_mm=mm, share=point.signal_DN / largest_DN)
            for point, mm in zip(known, distances, strict=True)
        ]
    )
    least = np.array([EXPOSURE_SD_MS, DISTANCE_SD * float(np.mean(distances)), BEND_SD]) ** 2
    growth = np.array([point.unknown_growth_ms / point.signal_DN for point in known])
    if growth.any() and dark_DN_per_ms_sd > 0.0:
        change, least = np.column_stack([change, growth]), np.append(least, dark_DN_per_ms_sd**2)
    beams = [(point.kV, tuple(sorted(map(str, point.filters)))) for point in known]
    for beam in set(beams):  # the level of a beam is free
        members = np.array([one == beam for one in beams])
        level[members] -= level[members].mean()
        change[members] -= change[members].mean(axis=0)
    degrees = len(known) - len(set(beams))
    prior, variance = least, USUAL_STRAY**2
    found: NDArray[np.float64] = np.zeros(len(least))
    covariance: NDArray[np.float64] = np.diag(least)
    for _ in range(_ROUNDS):
        covariance = np.asarray(np.linalg.inv(change.T @ change / variance + np.diag(1.0 / prior)))
        found = np.asarray(covariance @ change.T @ level / variance)
        # a line that is far off is one of few that are: its own size stands in for what lines are off usually
        own = np.diag(covariance)
        told = float(np.sum(1.0 - own / prior))
        prior = np.maximum(least, found**2 + own)
        if degrees - told > 0.5:  # levels that stray by more than lines do usually tell as much less
            left = float(np.sum((level - change @ found) ** 2))
            variance = max(USUAL_STRAY**2, left / (degrees - told))
    names = ("exposure_ms", "distance_mm", "bend", "dark_DN_per_ms")
    estimates = zip(names, found, np.sqrt(np.diag(covariance)), strict=False)
    return {
        **{name: {"value": float(value), "sd": float(sd)} for name, value, sd in estimates},
        "largest_DN": largest_DN,
        "second_moments": (covariance + np.outer(found, found))[:3, :3].tolist(),
    }


def told_errors(errors: Mapping[str, Any] | None) -> list[str]:
    """A line for each error that is three standard deviations from 0."""
    if errors is None:
        return []
    told = []
    for name, what, unit in (("exposure_ms", "exposures", "ms"), ("distance_mm", "source-detector distances", "mm")):
        found = errors[name]
        if abs(found["value"]) > _CLEAR * found["sd"]:
            away = f"{abs(found['value']):.2g} {unit} {'longer' if found['value'] > 0 else 'shorter'} than stated"
            told.append(
                f"flats of one beam fit {what} that are {away} (+-{Z95 * found['sd']:.1g} {unit}), or a dark level or a response"
                " that bends: levels at others have wider intervals for it; state the true ones if these are wrong"
            )
    return told


def told_darks(points: Sequence[SeriesPoint], changes: Mapping[str, float]) -> list[str]:
    """A line where darks of other exposures than the flats' leave levels less certain than they repeat; changes: `dark_changes`."""
    grown = [point for point in points if point.unknown_growth_ms]
    largest = max((abs(changes.get(point.series, 0.0)) for point in grown), default=0.0)
    if largest < USUAL_STRAY:
        return []

    def exposures(values: Iterable[float]) -> str:
        return " and ".join(f"{value:g}" for value in sorted(set(values))) + " ms"

    flats = exposures(point.exposure_ms or 0.0 for point in grown)
    darks = exposures((point.exposure_ms or 0.0) - point.unknown_growth_ms for point in grown)
    return [
        f"darks at {darks} alone, flats at {flats}: how much of a dark is dark current is not known, and levels and gains are wider"
        f" for it, by +-{100.0 * Z95 * largest:.2g} % at most; measure darks at {flats}"
    ]


def dark_changes(
    points: Sequence[SeriesPoint], errors: Mapping[str, Any] | None, *, dark_DN_per_ms_sd: float
) -> dict[str, float]:
    """By how much one standard deviation of dark current makes the level of each series too high, relative."""
    current = (errors or {}).get("dark_DN_per_ms", {"value": 0.0, "sd": dark_DN_per_ms_sd})
    rms = math.hypot(current["value"], current["sd"])
    return {point.series: rms * point.unknown_growth_ms / point.signal_DN for point in points if point.signal_DN > 0}


def allowing_for_darks(levels: Sequence[Level], changes: Mapping[str, float]) -> tuple[Level, ...]:
    """Levels and gains as uncertain as the dark current makes them; changes: `dark_changes`."""
    result = []
    for level in levels:
        sd = abs(mean_change(level, changes))
        rate = level.rate_DN_per_mAs
        result.append(
            replace(
                level,
                rate_DN_per_mAs=None if rate is None else rate.widened(sd),
                gain_DN=level.gain_DN.widened(sd),
                photon_transfer_slope_DN=level.photon_transfer_slope_DN.widened(sd),
            )
        )
    return tuple(result)


def mean_change(level: Level, changes: Mapping[str, float]) -> float:
    """`dark_changes` of the flats of a level, in the mean."""
    return float(np.mean([changes.get(name, 0.0) for name in level.series])) if level.series else 0.0


def allowing_for_settings(
    levels: Sequence[Level], points: Sequence[SeriesPoint], errors: Mapping[str, Any] | None
) -> tuple[Level, ...]:
    """Levels whose rates are as uncertain as these errors make them against each other: what spectra are fitted to."""
    if errors is None:
        return tuple(levels)
    point_of = {point.series: point for point in points}
    changes = [
        np.mean(
            [
                rate_changes(
                    exposure_ms=point_of[name].exposure_ms,
                    source_detector_mm=level.source_detector_mm,
                    share=point_of[name].signal_DN / errors["largest_DN"],
                )
                for name in level.series
            ],
            axis=0,
        )
        for level in levels
    ]
    lit = [change for level, change in zip(levels, changes, strict=True) if level.rate_DN_per_mAs is not None]
    middle = np.mean(lit, axis=0) if lit else np.zeros(3)
    result = []
    for level, change in zip(levels, changes, strict=True):
        rate = level.rate_DN_per_mAs
        if rate is not None:
            rate = rate.widened(stray_of_rates(errors, change - middle))
        result.append(replace(level, rate_DN_per_mAs=rate))
    return tuple(result)

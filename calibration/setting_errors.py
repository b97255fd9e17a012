"""Exposures and distances that are not as stated: what flats of one beam say of their errors.

One error of all exposures and one of all distances: a level goes as (t + dt) / (d + dd)^2. Both are nuisances. What they leave
open widens levels at other exposures and distances; nothing is corrected, as labels are the user's to put right.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..generator.line.measured_flats import USUAL_STRAY, rate_changes, stray_of_rates
from ..generator.line.twin import Z95, Level
from .flat_levels import SeriesPoint

# between a line's readout (0.02 ms) and the 1 ms that IEC 60601-2-54 allows a loading time, beside 10 % of it which all exposures
# share; each order of magnitude alike: rms sqrt((1 - 0.02^2) / (2 ln 50)) ms
EXPOSURE_SD_MS = 0.36
# relative: 21 CFR 1020.31 (e) allows indicators of the source-image distance 2 %, two standard deviations
DISTANCE_SD = 0.01
_CLEAR = 3.0  # standard deviations: one line in 400 is told without cause


def setting_errors(points: Sequence[SeriesPoint], *, source_detector_mm: float | None) -> dict[str, Any] | None:
    """What is known of both errors, from flats of the same kV and filter that differ in exposure or distance.

    Args:
        points: flats in use.
        source_detector_mm: where a flat states no distance of its own.

    Returns:
        exposure_ms, distance_mm: value and sd of each; second_moments: of both (2, 2), about 0. None: no flat has a load.
    """
    known = [point for point in points if point.load_mAs and point.exposure_ms and point.signal_DN > 0]
    if not known:
        return None
    distances = [point.source_detector_mm or source_detector_mm or 1000.0 for point in known]
    level = np.array([math.log(point.signal_DN / float(point.load_mAs or 1.0)) for point in known]) + 2.0 * np.log(
        distances
    )
    change = np.stack([rate_changes(point.exposure_ms, mm) for point, mm in zip(known, distances, strict=True)])
    beams = [(point.kV, tuple(sorted(map(str, point.filters)))) for point in known]
    for beam in set(beams):  # the level of a beam is free
        members = np.array([one == beam for one in beams])
        level[members] -= level[members].mean()
        change[members] -= change[members].mean(axis=0)
    degrees = len(known) - len(set(beams))
    precision = np.diag([EXPOSURE_SD_MS**-2.0, (DISTANCE_SD * float(np.mean(distances))) ** -2.0])
    variance = USUAL_STRAY**2
    found: NDArray[np.float64] = np.zeros(2)
    covariance: NDArray[np.float64] = np.linalg.inv(precision)
    for _ in range(2):  # levels that stray by more than lines do usually tell as much less
        covariance = np.asarray(np.linalg.inv(change.T @ change / variance + precision))
        found = np.asarray(covariance @ change.T @ level / variance)
        if degrees > 0:
            variance = max(variance, float(np.sum((level - change @ found) ** 2)) / degrees)
    sd = np.sqrt(np.diag(covariance))
    return {
        "exposure_ms": {"value": float(found[0]), "sd": float(sd[0])},
        "distance_mm": {"value": float(found[1]), "sd": float(sd[1])},
        "second_moments": (covariance + np.outer(found, found)).tolist(),
    }


def told_errors(errors: Mapping[str, Any] | None) -> list[str]:
    """A line for each error that is three standard deviations from 0."""
    told = []
    for name, what, unit in (("exposure_ms", "exposures", "ms"), ("distance_mm", "source-detector distances", "mm")):
        found = errors[name] if errors is not None else {"value": 0.0, "sd": 1.0}
        if abs(found["value"]) > _CLEAR * found["sd"]:
            away = f"{abs(found['value']):.2g} {unit} {'longer' if found['value'] > 0 else 'shorter'} than stated"
            told.append(
                f"flats of one beam fit {what} that are {away} (+-{Z95 * found['sd']:.1g} {unit}), or a dark level or a response"
                " that bends: levels at others have wider intervals for it; state the true ones if these are wrong"
            )
    return told


def allowing_for_settings(
    levels: Sequence[Level], points: Sequence[SeriesPoint], errors: Mapping[str, Any] | None
) -> tuple[Level, ...]:
    """Levels whose rates are as uncertain as these errors make them against each other: what spectra are fitted to."""
    if errors is None:
        return tuple(levels)
    point_of = {point.series: point for point in points}
    changes = [
        np.mean([rate_changes(point_of[name].exposure_ms, level.source_detector_mm) for name in level.series], axis=0)
        for level in levels
    ]
    lit = [change for level, change in zip(levels, changes, strict=True) if level.rate_DN_per_mAs is not None]
    middle = np.mean(lit, axis=0) if lit else np.zeros(2)
    result = []
    for level, change in zip(levels, changes, strict=True):
        rate = level.rate_DN_per_mAs
        if rate is not None:
            rate = rate.widened(stray_of_rates(errors, change - middle))
        result.append(replace(level, rate_DN_per_mAs=rate))
    return tuple(result)

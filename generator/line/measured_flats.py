"""The flats that a twin was calibrated with, as its evidence tells them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Setting
from ...errors import LARGEST, InputError
from .twin import Z95, Level, Twin

USUAL_STRAY = 0.002  # relative, of a flat that is repeated


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredFlat:
    """A series of flats whose level and noise made the twin.

    Fields: series: its name; signal_DN: median above dark, above 0; kV, exposure_ms, load_mAs of an exposure, source_detector_mm:
    None where unknown.
    """

    series: str
    signal_DN: float
    kV: float | None
    exposure_ms: float | None
    load_mAs: float | None
    source_detector_mm: float | None


def measured_flats(twin: Twin) -> tuple[MeasuredFlat, ...]:
    """The flats of known signal that were used, in the order of the acquisition; none where the evidence has none.

    Raises:
        InputError: evidence that is no list of series with numbers.
    """
    points = twin.evidence.get("photon_transfer") or ()
    try:
        found = [_flat(point) for point in points if point["used"]]
    except (TypeError, KeyError, ValueError, AttributeError):
        raise _unreadable("photon_transfer", "a row for each flat with `series`, `used` and `signal_DN`") from None
    return tuple(flat for flat in found if flat.signal_DN > 0)


def stray_of_flats(twin: Twin) -> float:
    """Relative standard deviation by which one more flat of a measured beam strays from its level over the load.

    As the calibrating flats show it (`scatter_of_flats` of the evidence), and no less than lines do usually: one session does not
    show what another day brings.
    """
    return max(USUAL_STRAY, _scatter(twin, "scatter_of_flats"))


def stray_of_noise(twin: Twin) -> float:
    """Relative standard deviation by which a series' noise power strays from what was fitted to all (`scatter_of_noise`)."""
    return _scatter(twin, "scatter_of_noise")


def rate_changes(*, exposure_ms: float | None, source_detector_mm: float | None, share: float) -> NDArray[np.float64]:
    """What 1 ms and 1 mm more than stated, and a bend of 1 at the brightest flat, do to the logarithm of a level over its load (3,).

    0 where unknown; share: the level over that of the brightest flat.
    """
    return np.array(
        [1.0 / exposure_ms if exposure_ms else 0.0, -2.0 / source_detector_mm if source_detector_mm else 0.0, share]
    )


def stray_of_rates(errors: Mapping[str, Any], change: NDArray[np.float64]) -> float:
    """Relative standard deviation of a level over its load at one setting against another, as times, distances and response leave it.

    errors: `setting_errors` of the evidence; change: `rate_changes` at the one less those at the other.
    """
    return math.sqrt(max(float(change @ np.asarray(errors["second_moments"], dtype=np.float64) @ change), 0.0))


def stray_of_setting(
    twin: Twin, setting: Setting, level: Level | None, *, distance_mm: float, signal_DN: float
) -> tuple[float, float]:
    """Relative standard deviations at a setting, of the level and of the variance of its quanta, as exposure, distance and level are
    not those of the calibrating flats.

    A response S (1 + b S) has the slope 1 + 2 b S, and the quanta's variance goes with its square: four times as far as the level.

    Args:
        twin: whose evidence says how far times, distances and response may be off; an older one's says nothing, which counts as 0.
        setting: of the level.
        level: the measured level of its beam, whose flats are compared with; None: all flats of the twin.
        distance_mm: from the source to the detector at the setting.
        signal_DN: the level itself.

    Raises:
        InputError: evidence that cannot be read, or a setting so far off that a 95 % interval spans all numbers there are.
    """
    errors = twin.evidence.get("setting_errors")
    if errors is None:
        return 0.0, 0.0
    flats = [flat for flat in measured_flats(twin) if flat.load_mAs and (level is None or flat.series in level.series)]
    usual_mm = twin.instrument.source_detector_mm or distance_mm
    if not flats:
        return 0.0, 0.0
    try:
        largest_DN = float(errors["largest_DN"])
        known = [
            rate_changes(
                exposure_ms=flat.exposure_ms,
                source_detector_mm=flat.source_detector_mm or usual_mm,
                share=flat.signal_DN / largest_DN,
            )
            for flat in flats
        ]
        there = rate_changes(
            exposure_ms=setting.exposure_ms, source_detector_mm=distance_mm, share=signal_DN / largest_DN
        )
        change = there - np.mean(known, axis=0)
        of_level, of_noise = (stray_of_rates(errors, change * (1.0, 1.0, bend)) for bend in (1.0, 4.0))
    except (TypeError, KeyError, ValueError, ZeroDivisionError):
        raise _unreadable("setting_errors", "`second_moments` of 3 x 3 numbers and `largest_DN`") from None
    if not Z95 * max(of_level, of_noise) < math.log(LARGEST):
        raise InputError(
            "setting",
            received=f"{setting.exposure_ms:g} ms at {distance_mm:g} mm from the source, {signal_DN:.3g} DN",
            expected="exposure, distance and level nearer to those of the calibrating flats, from which they can be told",
            remedy="lengths are in mm and times in ms; or calibrate with flats nearer to this setting",
        )
    return of_level, of_noise


def _unreadable(name: str, expected: str) -> InputError:
    return InputError(
        "evidence of the twin", received=f"`{name}` that cannot be read", expected=expected, remedy="calibrate again"
    )


def _scatter(twin: Twin, name: str) -> float:
    """A scatter of the evidence; 0 where it has none.

    Raises:
        InputError: one that is no number of 0 or more.
    """
    found = twin.evidence.get(name)
    if found is None:
        return 0.0
    value = found.get("relative_sd") if isinstance(found, Mapping) else found
    if not isinstance(value, int | float) or not 0.0 <= value < math.inf:
        raise _unreadable(name, "a `relative_sd` of 0 or more")
    return float(value)


def _flat(point: Mapping[str, Any]) -> MeasuredFlat:
    def number(name: str) -> float | None:
        value = point.get(name)
        return None if value is None else float(value)

    return MeasuredFlat(
        series=str(point["series"]),
        signal_DN=float(point["signal_DN"]),
        kV=number("kV"),
        exposure_ms=number("exposure_ms"),
        load_mAs=number("load_mAs"),
        source_detector_mm=number("source_detector_mm"),
    )

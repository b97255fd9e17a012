"""The flats that a twin was calibrated with, as its evidence tells them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ...errors import InputError
from .twin import Twin

USUAL_STRAY = 0.002  # relative, of a flat that is repeated


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredFlat:
    """A series of flats whose level and noise made the twin.

    Fields: series: its name; signal_DN: median above dark, above 0; kV, exposure_ms, load_mAs of an exposure: None where unknown.
    """

    series: str
    signal_DN: float
    kV: float | None
    exposure_ms: float | None
    load_mAs: float | None


def measured_flats(twin: Twin) -> tuple[MeasuredFlat, ...]:
    """The flats of known signal that were used, in the order of the acquisition; none where the evidence has none.

    Raises:
        InputError: evidence that is no list of series with numbers.
    """
    points = twin.evidence.get("photon_transfer") or ()
    try:
        found = [_flat(point) for point in points if point["used"]]
    except (TypeError, KeyError, ValueError, AttributeError):
        raise InputError(
            "evidence of the twin",
            received="`photon_transfer` that cannot be read",
            expected="a row for each flat with `series`, `used` and `signal_DN`",
            remedy="calibrate again",
        ) from None
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
        raise InputError(
            "evidence of the twin",
            received=f"`{name}` that cannot be read",
            expected="a `relative_sd` of 0 or more",
            remedy="calibrate again",
        )
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
    )

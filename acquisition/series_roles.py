"""Which series of a session calibrate, and what shape of frame it has."""

from collections import Counter
from collections.abc import Sequence

from .acquisition_io import Series


def commonest_shape(series: Sequence[Series]) -> tuple[int, int] | None:
    """The shape (rows, columns) that most series have, the first of equals; None without any."""
    counted = Counter(item.shape for item in series)
    return counted.most_common(1)[0][0] if counted else None


def calibrating_names(series: Sequence[Series]) -> frozenset[str]:
    """Names of the series from which the twin is calibrated.

    Series whose role is `calibration` where there are any; else, of raw darks and unrotated flats without role, those
    that came first: the darks before the first beam, and of each kV and filter the first run of flats (all exposures and
    loads of one visit to that beam).
    """
    usable = [
        item
        for item in series
        if item.kind in ("dark", "flat") and item.role != "evaluation" and not item.corrected & {"log", "gain"}
    ]
    stated = [item for item in usable if item.role == "calibration"]
    if stated:
        chosen = {item.name for item in stated}
        if not any(item.kind == "dark" for item in stated):
            # flats are marked, darks are not: those up to the last marked flat belong to them
            last = max(item.index for item in stated)
            darks = [item for item in usable if item.kind == "dark"]
            before = [item for item in darks if item.index <= last]
            chosen |= {item.name for item in before or darks}
        return frozenset(chosen)
    ordered = sorted((item for item in usable if item.panel_rotation_deg % 360.0 == 0.0), key=lambda item: item.index)
    first: dict[tuple[object, ...], str] = {}
    for item in ordered:
        load = None if item.setting is None else item.setting.tube_load_mAs
        beam = () if item.kind == "dark" else (item.kV, item.filters, load, item.source_detector_mm)
        first.setdefault((item.exposure_ms, *beam), item.name)
    return frozenset(first.values())

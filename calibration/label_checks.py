"""Do the labels of series fit their frames: kinds, tube load, kV, filters, clocks."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ..acquisition.acquisition_io import Series
from ..acquisition.setting import text_from_filters
from .findings import Finding, FindingCode

# Departures of a level from its label that are no wrong label: 3 sd of the largest plausible output drift (3 % rms), and
# a detector whose response bends by up to 5 %.
LEVEL_FITS = 0.15
_GAP = 2.5  # usual intervals: at least one frame and a half is missing
_DARK_APART = 0.3  # of a flat's signal, in the median: no dark drifts by so much

Levels = Mapping[str, float]


def kind_findings(series: Sequence[Series], levels_DN: Levels, noise_DN: Levels) -> list[Finding]:
    """Darks that are brighter than other darks by a flat's signal, and flats without light.

    Args:
        series: those that have been read.
        levels_DN: median of each mean frame, by name.
        noise_DN: temporal noise of one frame, by name; NaN where it is not known.
    """
    darks = [item for item in series if item.kind == "dark" and "offset" not in item.corrected]
    lit = [item for item in series if item.kind == "flat" and not item.corrected & {"offset", "log"}]
    if not darks or not lit:
        return []
    found = []
    dark = min(levels_DN[item.name] for item in darks)
    highest = max(levels_DN[item.name] for item in lit)
    typical = float(np.median([levels_DN[item.name] for item in lit]))
    for item in darks:
        level = levels_DN[item.name]
        limit = max(_DARK_APART * (typical - dark), 5.0 * _or_zero(noise_DN[item.name]))
        if level - dark > limit > 0 and not _grows_with_exposure(item, darks, levels_DN):
            found.append(
                Finding(code=FindingCode.DARK_WITH_LIGHT, series=item.name, values={"level": level, "dark": dark})
            )
    lightless = {entry.series for entry in found}
    good = [levels_DN[item.name] for item in darks if item.name not in lightless]
    for item in lit:
        level = levels_DN[item.name]
        # means of thousands of pixels: a tenth of one pixel's noise is a signal
        if level - max(good) <= 0.1 * _or_zero(noise_DN[item.name]) and level <= highest:
            found.append(
                Finding(code=FindingCode.NO_LIGHT, series=item.name, values={"level": level, "dark": max(good)})
            )
    return found


def _or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _grows_with_exposure(item: Series, darks: Sequence[Series], levels_DN: Levels) -> bool:
    """Whether the darks' levels rise with exposure time, so that a high level is dark current."""
    known = [one for one in darks if one.exposure_ms is not None]
    if item.exposure_ms is None or len(known) < 2:
        return False
    same = [levels_DN[one.name] for one in known if one.exposure_ms == item.exposure_ms]
    shorter = [levels_DN[one.name] for one in known if (one.exposure_ms or 0.0) < item.exposure_ms]
    longer = [levels_DN[one.name] for one in known if (one.exposure_ms or 0.0) > item.exposure_ms]
    level = levels_DN[item.name]
    typical = float(np.median(same))
    alike = len(same) == 1 or abs(level - typical) <= 0.2 * abs(typical)
    return alike and all(one <= level for one in shorter) and all(one >= level for one in longer) and bool(shorter)


def _load(item: Series) -> tuple[float, str, str, float] | None:
    """(load, quantity, unit, declared number) that a flat's level is proportional to."""
    current = item.current_mA
    if current is None and item.power_W is not None and item.kV:
        current = item.power_W / item.kV
    if current and item.exposure_ms:
        if item.power_W is not None:
            return current * item.exposure_ms / 1000.0, "tube load", "W", item.power_W
        return current * item.exposure_ms / 1000.0, "tube load", "mA", current
    if item.photons_per_pixel:
        return item.photons_per_pixel, "photon count", "photons", item.photons_per_pixel
    if item.exposure_ms:
        return item.exposure_ms, "exposure time", "ms", item.exposure_ms
    return None


def _beam(item: Series) -> tuple[Any, ...]:
    return (item.kV, _layers(item), item.source_detector_mm, item.layer, item.session)


def _layers(item: Series) -> tuple[str, ...]:
    return tuple(sorted(str(layer) for layer in item.filters))


def load_findings(series: Sequence[Series], signals_DN: Levels) -> list[Finding]:
    """Flats whose signal departs from the line through the other flats of their beam.

    Args:
        series: flats that are neither saturated nor without light.
        signals_DN: level above dark, by name.
    """
    groups: dict[tuple[Any, ...], list[tuple[Series, float, str, str, float]]] = {}
    for item in series:
        load = _load(item)
        if load is not None and signals_DN[item.name] > 0:
            groups.setdefault((*_beam(item), load[1]), []).append((item, *load))
    found = []
    for members in groups.values():
        rates = np.array([signals_DN[item.name] / load for item, load, *_ in members])
        if len({round(load, 12) for _, load, *_ in members}) < 2 and len(members) < 3:
            continue
        for index, (item, _, quantity, unit, declared) in enumerate(members):
            others = np.delete(rates, index)
            typical = float(np.median(others)) if others.size else rates[index]
            off = float(rates[index] / typical - 1.0)
            # of two that disagree nobody knows which is wrong: the later one is named
            agree = others.size >= 2 and float(np.max(np.abs(others / typical - 1.0))) <= LEVEL_FITS
            last_of_two = others.size == 1 and index == 1
            if abs(math.log(rates[index] / typical)) > math.log1p(LEVEL_FITS) and (agree or last_of_two):
                found.append(
                    Finding(
                        code=FindingCode.LOAD_LABEL,
                        series=item.name,
                        values={
                            "percent": 100.0 * off,
                            "quantity": quantity,
                            "fits": declared * (1.0 + off),
                            "unit": unit,
                            "declared": declared,
                        },
                    )
                )
    return found


def beam_findings(series: Sequence[Series], signals_DN: Levels) -> list[Finding]:
    """Flats at a higher kV, or behind less filter, that give less signal a mAs: what no tube and no filter does.

    Args:
        series: flats whose loads fit their levels.
        signals_DN: level above dark, by name.
    """
    rates: dict[str, float] = {}
    for item in series:
        load = _load(item)
        if item.kV is not None and load is not None and load[1] == "tube load" and signals_DN[item.name] > 0:
            distance = item.source_detector_mm or 1.0
            rates[item.name] = signals_DN[item.name] / load[0] * distance**2
    known = [item for item in series if item.name in rates]
    found: dict[str, Finding] = {}
    for one in known:
        for other in known:
            apart = (one.source_detector_mm is None) != (other.source_detector_mm is None) or one.layer != other.layer
            if apart or one.name in found or other.name in found or one.session != other.session:
                continue
            less = rates[one.name] < rates[other.name] / (1.0 + LEVEL_FITS)
            if one.kV is None or other.kV is None or not less:
                continue
            if _layers(one) == _layers(other) and one.kV > other.kV * (1.0 + LEVEL_FITS):
                found[one.name] = Finding(
                    code=FindingCode.KV_LABEL,
                    series=one.name,
                    values={"kV": one.kV, "other_kV": other.kV, "other": other.name},
                )
            elif one.kV == other.kV and _less_filter(one, other):
                found[other.name] = Finding(
                    code=FindingCode.FILTER_LABEL,
                    series=other.name,
                    values={
                        "filters": text_from_filters(other.filters) or "no filter",
                        "other_filters": text_from_filters(one.filters) or "no filter",
                        "other": one.name,
                    },
                )
    return list(found.values())


def _less_filter(one: Series, other: Series) -> bool:
    """Every layer of `one` stands before the other too, at least as thick, and something more."""

    def thickness_mm(item: Series) -> dict[str, float]:
        total: dict[str, float] = {}
        for layer in item.filters:
            total[layer.material] = total.get(layer.material, 0.0) + layer.thickness_mm
        return total

    own, more = thickness_mm(one), thickness_mm(other)
    return own != more and all(more.get(material, 0.0) >= length for material, length in own.items())


def clock_findings(series: Sequence[Series]) -> list[Finding]:
    """Times that stand still, leave gaps, are closer than the exposure lasts, or run against the order of series."""
    found = []
    for item in series:
        if item.time_s is None or item.n_frames < 2:
            continue
        steps = np.diff(item.time_s)
        still = int(np.count_nonzero(steps == 0))
        if still:
            found.append(Finding(code=FindingCode.CLOCK_STANDS, series=item.name, values={"count": still}))
            continue
        usual = float(np.median(steps))
        gaps = np.flatnonzero(steps > _GAP * usual)
        if gaps.size and gaps.size < 0.1 * steps.size + 1:
            longest = int(np.argmax(steps))
            found.append(
                Finding(
                    code=FindingCode.CLOCK_GAP,
                    series=item.name,
                    values={
                        "count": int(gaps.size),
                        "frame": longest + 1,
                        "gap": float(steps[longest]),
                        "usual": usual,
                    },
                )
            )
        # frames overlap by their readout at most; averaged ones take as many exposures
        if item.exposure_ms and 1000.0 * usual < 0.9 * item.exposure_ms:
            found.append(
                Finding(
                    code=FindingCode.CLOCK_EXPOSURE,
                    series=item.name,
                    values={"interval_ms": 1000.0 * usual, "exposure_ms": item.exposure_ms},
                )
            )
    timed = [item for item in series if item.time_s is not None and item.index >= 0]
    for earlier, later in pairwise(sorted(timed, key=lambda item: (item.session, item.index))):
        if earlier.session == later.session and earlier.time_s is not None and later.time_s is not None:
            before = float(later.time_s[0]) < float(earlier.time_s[-1])
            # clocks that start anew with every series tell nothing of their order
            if before and float(later.time_s[0]) > 0 and float(earlier.time_s[0]) > 0:
                found.append(Finding(code=FindingCode.CLOCK_ORDER, series=later.name, values={"other": earlier.name}))
    return found

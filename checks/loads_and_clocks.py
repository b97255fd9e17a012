"""Flats whose level does not go with their tube load, and clocks that do not go with frames and order."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ..acquisition.acquisition_io import Series
from .findings import Finding, FindingCode

# Departures of a level from its label that are no wrong label: 3 sd of the largest plausible output drift (3 % rms), and
# a detector whose response bends by up to 5 %.
LEVEL_FITS = 0.15
_CLEAR = 3.0  # standard deviations of the dark
_GAP = 2.5  # usual intervals: at least one frame and a half is missing

Levels = Mapping[str, float]


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


def load_findings(series: Sequence[Series], signals_DN: Levels, *, dark_sd_DN: float) -> list[Finding]:
    """Flats whose signal departs from the line through the other flats of their beam.

    Args:
        series: flats that are neither saturated nor without light.
        signals_DN: level above dark, by name.
        dark_sd_DN: by how much any of them may be off, as darks differ.
    """
    groups: dict[tuple[Any, ...], list[tuple[Series, float, str, str, float]]] = {}
    for item in series:
        load = _load(item)
        if load is not None and signals_DN[item.name] > 0:
            groups.setdefault((*_beam(item), load[1]), []).append((item, *load))
    found = []
    for members in groups.values():
        rates = np.array([signals_DN[item.name] / load for item, load, *_ in members])
        # logarithmic, from the line through the others
        fits = np.array([math.log1p(LEVEL_FITS + _CLEAR * dark_sd_DN / signals_DN[item.name]) for item, *_ in members])
        if len({round(load, 12) for _, load, *_ in members}) < 2 and len(members) < 3:
            continue
        for index, (item, _, quantity, unit, declared) in enumerate(members):
            others = np.delete(rates, index)
            typical = float(np.median(others)) if others.size else rates[index]
            off = float(rates[index] / typical - 1.0)
            # of two that disagree nobody knows which is wrong: the later one is named
            among = np.abs(np.log(others / typical)) <= np.delete(fits, index)
            agree = others.size >= 2 and bool(np.all(among))
            last_of_two = others.size == 1 and index == 1
            if abs(math.log(rates[index] / typical)) > fits[index] and (agree or last_of_two):
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
    # layers of a panel are exposed at once
    for earlier, later in pairwise(sorted(timed, key=lambda item: (item.session, item.layer or "", item.index))):
        if (
            (earlier.session, earlier.layer) == (later.session, later.layer)
            and earlier.time_s is not None
            and later.time_s is not None
        ):
            before = float(later.time_s[0]) < float(earlier.time_s[-1])
            # clocks that start anew with every series tell nothing of their order
            if before and float(later.time_s[0]) > 0 and float(earlier.time_s[0]) > 0:
                found.append(Finding(code=FindingCode.CLOCK_ORDER, series=later.name, values={"other": earlier.name}))
    return found

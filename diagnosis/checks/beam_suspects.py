"""Series whose label says wrongly whether the beam was on, or the field empty."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .readings import FRAMES_READ, Reading, Suspect, mean_of

_NO_BEAM = 0.01  # of the level that a flat should have for its tube load
_CLEAR_QUANTA = 5.0  # standard deviations of a variance above that of a dark
_ENERGY_RANGE = 4.0  # times between the signals of quanta of the softest and of a usual beam
_DARK_EXCESS = 0.05  # of the weakest flat, that a dark may lie above the other darks
# the same whatever the flats: twice the catalogue's largest drift of a dark; of few bits _DARK_EXCESS of the panel's range
_DRIFTS_DN = 200.0
_RELEASED = 0.08  # of the exposures before, which an image lag may leave in a dark
_WEAK = 0.1  # of the flats' usual level, below which a flat's pattern says nothing of a shadow
_SHADOW_IN_FLAT = 0.35  # spread of the logarithm of a flat against other flats


def lit_darks(
    darks: Sequence[Reading], lit: Sequence[Reading], good: NDArray[np.bool_], *, bits: int | None
) -> list[Suspect]:
    """Darks that lie far above the others: there was a beam. bits: of the ADC; None: unknown, and taken as many."""
    if len(darks) < 2 or not lit:
        return []
    level_DN = {item.name: float(np.median(item.mean_DN[good])) for item in (*darks, *lit)}
    lowest = min(level_DN[item.name] for item in darks)
    beams = [level_DN[item.name] for item in lit if item.series.kind == "flat" or len(lit) < 3]
    # without flats the thinnest object stands for them
    weakest = min(beams) if beams else max(level_DN[item.name] for item in lit)
    drifts_DN = _DRIFTS_DN if bits is None else min(_DRIFTS_DN, _DARK_EXCESS * 2.0**bits)
    found = []
    for item in darks:
        excess = level_DN[item.name] - float(np.median([level_DN[one.name] for one in darks if one is not item]))
        before = [level_DN[one.name] for one in lit if one.series.index < item.series.index]
        released = _RELEASED * max((one - lowest for one in before[-3:]), default=0.0)
        if excess > max(_DARK_EXCESS * (weakest - lowest), released, drifts_DN):
            found.append(
                Suspect(
                    series=(item.name,),
                    text=f"{item.name} is labelled dark, but lies {excess:.0f} DN above the other darks: the beam was on",
                    evidence=excess,
                )
            )
    return found if len(found) < len(darks) else []


def flats_without_beam(judged: list[Reading], good: NDArray[np.bool_]) -> tuple[list[Suspect], list[Reading]]:
    """Flats without light among flats with light."""
    flats = [item for item in judged if item.series.kind == "flat"]
    found, left = [], []
    # per mAs, or per ms: a short exposure is weak by right
    rates = {item.name: item.level_DN / math.exp(item.label.log_load) for item in flats}
    dim = set()
    for item in flats:
        alike = [rates[one.name] for one in flats if (one.label.load is None) == (item.label.load is None)]
        if rates[item.name] <= _NO_BEAM * float(np.median(alike)):
            dim.add(item.name)
    gains = [item.gain_DN for item in flats if item.name not in dim and item.gain_DN > 0]
    usual = float(np.median(gains)) if gains else math.nan
    for item in judged:
        dark = item.name in dim and not _shows_quanta(item, usual, good)
        if item.series.kind == "flat" and (dark or not item.level_DN > 0):
            found.append(
                Suspect(
                    series=(item.name,),
                    text=f"{item.name} is labelled flat, but shows no beam ({item.level_DN:.0f} DN above dark): it looks like a dark",
                    evidence=1e3,
                )
            )
        else:
            left.append(item)
    return found, left


def _shows_quanta(item: Reading, gain_DN: float, good: NDArray[np.bool_]) -> bool:
    """Whether the little light of a flat has the noise of quanta, which are worth about gain_DN each: a soft beam behind metal."""
    if item.variance_DN2 is None or not item.gain_DN > 0:
        return False
    clear = item.gain_DN * item.level_DN > _CLEAR_QUANTA * item.gain_sd * mean_of(item.variance_DN2, good)
    return clear and gain_DN / _ENERGY_RANGE < item.gain_DN < gain_DN * _ENERGY_RANGE


def shadows_in_flats(judged: Sequence[Reading], good: NDArray[np.bool_]) -> list[Suspect]:
    """Flats whose brightness varies over the field as no other flat's does."""
    flats = [item for item in judged if item.series.kind == "flat" and item.picture is not None]
    if len(flats) < 3:
        return []
    found = []
    typical = float(np.median([item.level_DN for item in flats]))
    for item in flats:
        if item.level_DN < _WEAK * typical:
            continue  # darks and read noise have a pattern of their own
        picture = np.maximum(np.asarray(item.picture), 1e-3)[good]
        low, high = np.quantile(np.log(picture), [0.05, 0.95])
        photons = max(item.level_DN, 1e-9) * min(item.series.n_frames, FRAMES_READ)
        noise = 3.3 * math.sqrt(item.gain_DN / photons) if item.gain_DN > 0 else 0.0
        if high - low > _SHADOW_IN_FLAT + noise:
            found.append(
                Suspect(
                    series=(item.name,),
                    text=f"{item.name} is labelled flat, but its brightness varies by {100 * (1 - math.exp(low - high)):.0f} %"
                    " over the field as no other flat's does: something stood in the beam",
                    evidence=500.0,
                )
            )
    return found if 2 * len(found) < len(flats) else []

"""Series whose label says wrongly whether the beam was on, the field empty, or a frame a single exposure."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .findings import Finding, FindingCode
from .readings import FRAMES_READ, Reading, mean_of

_NO_BEAM = 0.01  # of the level that a flat should have for its tube load
_CLEAR_QUANTA = 5.0  # standard deviations of a variance above that of a dark
_ENERGY_RANGE = 4.0  # times between the signals of quanta of the softest and of a usual beam
_DARK_EXCESS = 0.05  # of the weakest flat, that a dark may lie above what the other darks let expect
# the same whatever the flats: twice the catalogue's largest drift of a dark; of few bits _DARK_EXCESS of the panel's range
_DRIFTS_DN = 200.0
_WARMER = 0.25  # of a dark current: two degrees where it doubles every six
_RELEASED = 0.08  # of the exposures before, which an image lag may leave in a dark
_WEAK = 0.1  # of the flats' usual level, below which a flat's pattern says nothing of a shadow
_ALIKE = 0.1  # of the noise of flats of one beam: its gains, and their sampling errors
_CLEAR = 3.0  # standard deviations
_SHADOW_IN_FLAT = 0.35  # spread of the logarithm of a flat against other flats


def lit_darks(
    darks: Sequence[Reading], lit: Sequence[Reading], good: NDArray[np.bool_], *, bits: int | None
) -> list[Finding]:
    """Darks that lie far above what the other darks let expect at their exposure: there was a beam.

    bits: of the ADC; None: unknown, and taken as many.
    """
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
        level = level_DN[item.name]
        others = [(one.series.exposure_ms or 0.0, level_DN[one.name]) for one in darks if one is not item]
        expected = _dark_current(item.series.exposure_ms or 0.0, level, others)
        before = [level_DN[one.name] for one in lit if one.series.index < item.series.index]
        released = _RELEASED * max((one - lowest for one in before[-3:]), default=0.0)
        warmer = _WARMER * (expected - lowest)
        if level - expected > max(_DARK_EXCESS * (weakest - lowest), released, drifts_DN, warmer):
            found.append(
                Finding(code=FindingCode.DARK_WITH_LIGHT, series=item.name, values={"level": level, "dark": expected})
            )
    return found if len(found) < len(darks) else []


def _dark_current(exposure_ms: float, level_DN: float, others: Sequence[tuple[float, float]]) -> float:
    """Level that other darks (exposure_ms, level_DN) let expect of one.

    That is theirs at the same exposure, or what the line through the two nearest exposures says.
    A dark current only adds with time. The dark's own level stands where all others are of one shorter exposure, or of longer ones
    and brighter.
    """
    levels: dict[float, list[float]] = {}
    for exposure, level in others:
        levels.setdefault(exposure, []).append(level)
    typical = {exposure: float(np.median(values)) for exposure, values in levels.items()}
    if exposure_ms in typical:
        return typical[exposure_ms]
    if len(typical) == 1:
        ((only, level),) = typical.items()
        return max(level, level_DN) if exposure_ms > only else level
    first, second = sorted(sorted(typical, key=lambda one: abs(one - exposure_ms))[:2])
    if exposure_ms < first:
        return min(typical[first], level_DN)
    rate = max(typical[second] - typical[first], 0.0) / (second - first)
    return typical[first] + rate * (exposure_ms - first)


def flats_without_beam(judged: Sequence[Reading]) -> tuple[list[Finding], list[Reading]]:
    """Flats without light among flats with light, and the other series."""
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
        dark = item.name in dim and not _shows_quanta(item, usual)
        if item.series.kind == "flat" and (dark or not item.level_DN > 0):
            found.append(Finding(code=FindingCode.NO_LIGHT, series=item.name, values={"signal": item.level_DN}))
        else:
            left.append(item)
    return found, left


def _shows_quanta(item: Reading, gain_DN: float) -> bool:
    """Whether the little light of a flat has the noise of quanta, which are worth about gain_DN each: a soft beam behind metal."""
    return item.gain_sd < 1.0 / _CLEAR_QUANTA and gain_DN / _ENERGY_RANGE < item.gain_DN < gain_DN * _ENERGY_RANGE


def shadows_in_flats(judged: Sequence[Reading], read_DN2: float, good: NDArray[np.bool_]) -> list[Finding]:
    """Flats whose brightness varies over the field as no other flat's does.

    Args:
        judged: lit series.
        read_DN2: variance of the darks, of a single exposure.
        good: pixels that are looked at (row, column).
    """
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
        # of the mean frame and of the dark that was subtracted; 3.3 standard deviations lie between these quantiles of noise
        single_DN2 = max(item.gain_DN, 0.0) * item.level_DN + read_DN2
        mean_DN2 = single_DN2 / min(item.series.n_frames, FRAMES_READ) + read_DN2 / FRAMES_READ
        noise = 3.3 * math.sqrt(mean_DN2) / max(item.level_DN, 1e-9)
        if high - low > _SHADOW_IN_FLAT + noise:
            percent = 100.0 * (1.0 - math.exp(low - high))
            found.append(Finding(code=FindingCode.SHADOW, series=item.name, values={"percent": percent}))
    return found if 2 * len(found) < len(flats) else []


def undeclared_means(judged: Sequence[Reading], read_DN2: float, good: NDArray[np.bool_]) -> list[Finding]:
    """Flats whose noise is that of a mean of more frames than declared, by the other flats of their beam.

    Flagged is a variance, declared averaging undone, that is nearer to that of a mean of two than to the least which the other flats
    allow of a single exposure.

    Args:
        judged: lit series.
        read_DN2: variance of the darks, of a single exposure.
        good: pixels that are looked at (row, column).
    """
    beams: dict[tuple[object, ...], list[Reading]] = {}
    for item in judged:
        if item.series.kind == "flat" and item.variance_DN2 is not None and item.level_DN > 0:
            # noise that came after the calibration is an effect
            beams.setdefault((item.label.beam, item.since), []).append(item)
    found: list[Finding] = []
    for members in beams.values():
        left = list(members)
        # the clearest first: among those that another is judged by, one mean makes single exposures look like means
        while (told := max((_as_mean(item, left, read_DN2, good) for item in left), default=None)) and told[0] > 1.0:
            _, name, values = told
            found.append(Finding(code=FindingCode.AVERAGED, series=name, values=values))
            left = [item for item in left if item.name != name]
    return found


def _as_mean(
    item: Reading, members: Sequence[Reading], read_DN2: float, good: NDArray[np.bool_]
) -> tuple[float, str, dict[str, float | str]]:
    """How much clearer a flat is a mean of two frames than a single exposure (1: neither), its name, and what is said of it."""
    others = [one for one in members if one is not item]
    variances = np.array([mean_of(one.variance_DN2, good) for one in others]) - read_DN2
    # what is known of a dim flat's quanta hangs on the read noise
    alike = np.array([_ALIKE + _CLEAR * min(one.gain_sd, 1.0) for one in others])
    expected = _expected_variance(item.level_DN, np.array([one.level_DN for one in others]), variances, alike)
    if expected is None or expected[0] <= read_DN2:
        return 0.0, item.name, {}
    single, likely = (read_DN2 + one for one in expected)
    variance, declared = mean_of(item.variance_DN2, good), item.series.averaged
    values: dict[str, float | str] = {
        "count": max(2, round(likely / variance)) * declared,
        "how": f"its noise is {math.sqrt(likely / variance):.2g} times less than the other flats let expect",
        "declared": declared,
    }
    return single / variance / math.sqrt(2.0), item.name, values


def _expected_variance(
    level_DN: float, levels_DN: NDArray[np.float64], variances_DN2: NDArray[np.float64], alike: NDArray[np.float64]
) -> tuple[float, float] | None:
    """The least and the likeliest variance at a level, DN^2, of noise as other flats (flat,) show it; None: they show no such noise.

    alike (flat,): to which share of itself each variance is known.

    Noise has a constant part (electronics, rounding), one that grows as the level (quanta), and one as its square (flicker).
    """
    from scipy.optimize import linprog, nnls

    if not levels_DN.size or not np.all(variances_DN2 > 0):
        return None
    parts = np.stack([np.ones(levels_DN.size), levels_DN / level_DN, (levels_DN / level_DN) ** 2], axis=1)
    limits = np.concatenate([(1.0 + alike) * variances_DN2, -(1.0 - alike) * variances_DN2])
    least = linprog(np.ones(3), A_ub=np.concatenate([parts, -parts]), b_ub=limits, bounds=(0.0, None))
    if not least.success:
        return None
    quanta = variances_DN2 * level_DN / levels_DN
    likely = float(np.median(quanta))
    if np.any(np.abs(quanta / likely - 1.0) > alike):  # they alone do not explain it
        likely = float(nnls(parts / variances_DN2[:, None], np.ones(levels_DN.size))[0].sum())
    return float(least.fun), max(likely, float(least.fun))

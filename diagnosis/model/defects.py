"""Pixels that stand out of the panel and are not known to be bad: they count as outliers and are left out of all else."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..arrays import BoolArray, FloatArray, RealArray
from ..probes.fixed_pattern import smooth_part
from ..probes.lasting import OUTLYING, lasting_pixels
from ..session.even_maps import NEIGHBOURS_PX, near_steps, signal_map
from ..session.session import SessionSeries
from ..session.summaries import BLOCK_PX, LEAST_NOISE_DN2, FirstLook, rounded_away
from ..session.usable import SeenSeries
from .calibrated_maps import CalibratedMaps
from .changes import DUST_LIMIT

_LEAST_SCENES, _NEARLY_ALWAYS = 4, 0.9  # unlike objects, and share of their series, that show what is the panel's own
# share of a block that stands out: its corner of a tile is a quarter, a cluster of 6 x 6 defects 0.56
_NEARLY_WHOLE = 0.75
_MOST_OUTLYING = 0.1  # share of the pixels; more of them are a pattern


@dataclass(frozen=True, slots=True, kw_only=True)
class StandingOut:
    """Pixels (row, column) in use that stand out: `bad` ones, and `any`, with those that dust would explain (1 % of the light)."""

    bad: BoolArray
    any: BoolArray


def new_outliers(seen: Sequence[SeenSeries], maps: CalibratedMaps, *, counting: bool) -> StandingOut:
    """Pixels in use that stand out in any dark or flat, or in all objects from some time on.

    Unless the detector counts quanta, numbers that stand still say how far a pixel is from the next step of the ADC.
    """
    good, shape = maps.good, maps.good.shape
    outlying, dusty = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for one in seen:
        kind, look = one.session.series.kind, one.look
        if kind not in ("dark", "flat") or (not counting and rounded_away(look, good)):
            continue
        residual = maps.corrected(one.session, look.mean_DN)
        if kind == "flat":
            signal = signal_map(one.expected, shape)
            residual = residual - signal * float(np.median((residual / np.maximum(signal, 1e-9))[good]))
        residual = residual - smooth_part(residual, good)
        centre = float(np.median(residual[good]))
        spread = 1.4826 * float(np.median(np.abs(residual[good] - centre)))
        departs = np.abs(residual - centre)
        out = departs > OUTLYING * max(spread, math.sqrt(LEAST_NOISE_DN2 / look.frames))
        if kind == "flat":
            dusty |= out
            out &= departs > DUST_LIMIT * signal
        outlying |= out
        if look.frames > 9:
            ratio = look.pair_variance_DN2 / max(float(np.median(look.pair_variance_DN2[good])), LEAST_NOISE_DN2)
            limit = max(_largest_ratio(look.frames), 2.5)
            if bool(np.any(ratio[good] > limit)):
                outlying |= (ratio > limit * np.maximum(1.0, _of_lines(ratio, good))) & good
    outlying |= _out_in_every_object(seen, maps)
    # a detector full of outliers is a pattern, not a set of defects
    bad, all_of_them = (
        found if found.sum() < _MOST_OUTLYING * good.sum() else np.zeros(shape, dtype=bool)
        for found in (_without_areas(outlying) & good, _without_areas(outlying | dusty) & good)
    )
    return StandingOut(bad=bad, any=all_of_them | bad)


def _without_areas(outlying: BoolArray) -> BoolArray:
    """Pixels (row, column) that stand out, less areas of them as large as a block: a tile or a mark of the screen is a pattern."""
    from scipy.ndimage import maximum_filter, uniform_filter

    whole = uniform_filter(outlying.astype(np.float32), BLOCK_PX) > _NEARLY_WHOLE
    return np.asarray(outlying & ~maximum_filter(whole, BLOCK_PX), dtype=bool)


def _out_in_every_object(seen: Sequence[SeenSeries], maps: CalibratedMaps) -> BoolArray:
    """Pixels that stand out of their neighbours in nearly all later views, of several scenes, in which no step passes by them."""
    from scipy.ndimage import median_filter

    good = maps.good
    # a hot one stands out of the longer exposures alone
    alike: dict[tuple[float | None, float | None], list[SeenSeries]] = {}
    for one in seen:
        series = one.session.series
        if series.kind == "object" and not one.session.calibrates:
            alike.setdefault((series.kV, series.exposure_ms), []).append(one)
    found = np.zeros(good.shape, dtype=bool)
    for members in alike.values():
        times, views = np.zeros(good.shape), np.zeros(good.shape)
        seen_in: dict[str, BoolArray] = {}
        for one in reversed(members):
            measured = maps.corrected(one.session, one.look.mean_DN)
            signal = signal_map(one.expected, good.shape)
            residual = measured - signal
            residual = residual - median_filter(residual, size=NEIGHBOURS_PX, mode="nearest")
            even = ~near_steps(signal)
            views += even
            spread = max(1.4826 * float(np.median(np.abs(residual[good]))), 1e-9)
            times += even & (np.abs(residual) > OUTLYING * spread)
            scene = one.session.series.scene
            seen_in[scene] = even | seen_in.get(scene, np.zeros_like(even))
            scenes = np.sum(list(seen_in.values()), axis=0)
            found |= (scenes >= _LEAST_SCENES) & (times >= _NEARLY_ALWAYS * views)
    return found


def _of_lines(ratio: RealArray, good: BoolArray) -> FloatArray:
    """Median of a map (row, column) of 1 as a rule along each pixel's row or column, the larger: noise that a line has in common."""
    known = np.where(good, np.asarray(ratio, dtype=np.float64), 1.0)
    rows, columns = (np.median(known, axis=axis, keepdims=True) for axis in (1, 0))
    return np.asarray(np.maximum(rows, columns))


@lru_cache(maxsize=64)
def _largest_ratio(frames: int) -> float:
    """Variance from differences of successive frames over its expectation that one pixel in ten million passes by chance."""
    from scipy.special import gammainccinv

    freedom = 2.0 * (frames - 1.0) / 3.0  # successive differences share frames
    # upper end of chi squared
    return float(2.0 * gammainccinv(0.5 * freedom, 1e-7) / freedom)


def lasting_anywhere(seen: Sequence[SeenSeries], good: BoolArray, *, counting: bool) -> BoolArray:
    """Good pixels (row, column) whose level lasts for some frames in any later dark; one that stands at a step leaves it seldom."""
    found = np.zeros(good.shape, dtype=bool)
    for one in seen:
        look = one.look
        tells = counting or not rounded_away(look, good)
        if one.session.series.kind == "dark" and not one.session.calibrates and tells:
            found |= lasting_pixels(
                look.stack_variance_DN2, look.pair_variance_DN2, look.frames, good, least_DN2=LEAST_NOISE_DN2
            )
    return found


def memory_of(look: FirstLook, outlying: BoolArray) -> tuple[float, int] | None:
    """Median share of outlying pixels' variance that lasts from frame to frame, and their number; None: none is noisy."""
    stack, pair = look.stack_variance_DN2[outlying], look.pair_variance_DN2[outlying]
    seen = stack > 0
    if not seen.any():
        return None
    return float(np.median(1.0 - pair[seen] / stack[seen])), int(np.count_nonzero(seen))


def counting_series(kept: Sequence[SessionSeries]) -> str:
    """The later series that pixels standing out anywhere are counted with; empty where dead or hot ones cannot show."""
    later = [item for item in kept if not item.calibrates and item.series.kind in ("dark", "flat")]
    if later:
        return later[-1].name if {item.series.kind for item in later} == {"dark", "flat"} else ""
    objects = [item for item in kept if not item.calibrates and item.series.kind == "object"]
    return objects[-1].name if len({item.series.scene for item in objects}) >= _LEAST_SCENES else ""

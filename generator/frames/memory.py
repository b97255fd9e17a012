"""What earlier exposures leave behind: charge in traps that is read later (lag), and a gain that light has raised (burn-in)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..line.line_state import FloatArray, GainMemory, LagLaw, LineState
from ..line.series_request import SeriesRequest
from .light import Charge
from .model_cache import Carried

LAGS = 3
_SLOWEST = 1e-9  # filling, share an exposure: where no light comes and nothing empties
_FOLLOWED = 2  # pictures exposed before a series' own, the last ones, whose fading is followed one by one

Exposed = Callable[[SeriesRequest], tuple[LineState, Charge]]  # the line's state for an earlier series, and its charge


def decays(law: LagLaw, interval_s: float) -> FloatArray:
    """Share of a trap's charge (trap,) that is left after one exposure."""
    return np.exp(-interval_s / np.asarray(law.time_s, dtype=np.float64))


def pause_of(law: LagLaw, request: SeriesRequest, clock_s: float) -> float:
    """From clock_s, when the exposures before ended, to the begin of the series."""
    return request.start_s - clock_s if request.pause_stated else law.idle_s


def paused(law: LagLaw, trapped: FloatArray, pause_s: float) -> tuple[FloatArray, FloatArray]:
    """Charge in the traps (trap, ...) after a pause, and what the next exposure reads of that released in it."""
    left = (trapped.T * decays(law, max(pause_s, 0.0))).T
    return left, law.pause_share * np.sum(trapped - left, axis=0)


@dataclass(frozen=True, slots=True)
class Trapped:
    """What earlier exposures have left behind, as sums of what each of them brought.

    Fields: pictures, each (row, column) or (1, 1), DN; held (trap, picture): shares of them in the traps; found (picture,): shares
    that the first exposure finds.
    """

    pictures: tuple[FloatArray, ...]
    held: FloatArray
    found: FloatArray

    def images(self) -> tuple[FloatArray, FloatArray]:
        """Charge in the traps (trap, row, column) and what the first exposure finds (row, column), DN."""
        none = np.zeros((1, 1))
        held = [
            sum((share * one for share, one in zip(shares, self.pictures, strict=True)), none) for shares in self.held
        ]
        found = sum((share * one for share, one in zip(self.found, self.pictures, strict=True)), none)
        return np.stack(held), found


def trapped_before(request: SeriesRequest, law: LagLaw, exposed: Exposed, readout_ms: float | None) -> Trapped:
    """Charge in the traps at the begin of the series, and what its first exposure finds."""
    share = np.asarray(law.trapped)
    pictures: list[FloatArray] = []
    trapped = np.zeros((len(law.trapped), len(request.previous)))
    clock: float | None = None
    for earlier in request.previous:
        interval = earlier.interval_s(readout_ms)
        exposures = earlier.frames * earlier.exposures_per_frame
        if clock is not None:
            trapped, _ = paused(law, trapped, pause_of(law, earlier, clock))
        decay = decays(law, interval)
        left = decay**exposures
        trapped = trapped * left[:, None]
        if earlier.beam_on:
            state, charge = exposed(earlier)
            caught = 1.0 if state.lag is not None else law.before_share
            if caught > 0.0:
                trapped[:, len(pictures)] = caught * share * (1.0 - left) / np.maximum(1.0 - decay, 1e-12)
                pictures.append(charge.mean)
        clock = earlier.start_s + exposures * interval
    found = np.zeros(trapped.shape[1])
    if clock is not None:
        trapped, found = paused(law, trapped, pause_of(law, request, clock))
    return Trapped(tuple(pictures), trapped[:, : len(pictures)], found[: len(pictures)])


def with_trapped(
    law: LagLaw, decay: FloatArray, before: Trapped, own: FloatArray, exposures: int, averaged: int
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Mean signal of a series whose exposures bring `own` (row, column), DN, with lag, and how it changes over the frames.

    y_n = x - sum_i a_i^n [phi_i x - (1 - a_i) R_i], R_i a sum of the pictures of earlier exposures: each picture has one course.
    Those of long ago, of which only slow traps hold some still, fade together.
    """
    number = np.arange(exposures)
    fades = np.array([frame_means(left**number, averaged) for left in decay])
    courses = ((1.0 - decay)[:, None] * before.held).T @ fades
    if law.pause_share > 0:
        courses = courses + before.found[:, None] * frame_means((number == 0).astype(np.float64), averaged)
    long_ago = max(len(before.pictures) - _FOLLOWED, 0)
    moving = [
        (own, -np.asarray(law.trapped) @ fades),
        *zip(before.pictures[long_ago:], courses[long_ago:], strict=True),
    ]
    shares = courses[:long_ago].mean(axis=1)
    if shares.any():
        faint = sum(share * one for share, one in zip(shares, before.pictures[:long_ago], strict=True))
        moving.append((np.asarray(faint), courses[:long_ago].sum(axis=0) / shares.sum()))
    signal = own
    trend = []
    for picture, course in moving:
        signal = signal + course.mean() * picture
        trend.append((picture, course - course.mean()))
    return signal, trend


@dataclass(frozen=True, slots=True)
class Filled:
    """Share of each kind of traps (row, column) or (1, 1) that is full, and when, s."""

    shares: tuple[FloatArray, ...]
    time_s: float = 0.0

    @staticmethod
    def nowhere(law: GainMemory) -> "Filled":
        """No trap is."""
        return Filled(tuple(np.zeros((1, 1)) for _ in law.kinds))

    def at(self, law: GainMemory, time_s: float) -> tuple[FloatArray, ...]:
        """Those that are still full at a time."""
        pause_s = max(time_s - self.time_s, 0.0)
        return tuple(
            full * math.exp(-pause_s / fade_s) for full, (_, fade_s) in zip(self.shares, law.kinds, strict=True)
        )

    def after(
        self, law: GainMemory, request: SeriesRequest, light_DN: FloatArray, readout_ms: float | None
    ) -> "Filled":
        """Once a series has brought this light with each of its exposures."""
        interval_s, exposures = request.interval_s(readout_ms), request.frames * request.exposures_per_frame
        shares = tuple(
            steady + (full - steady) * np.exp(-exposures * pace)
            for full, (steady, pace) in zip(
                self.at(law, request.start_s), filling(law, light_DN, interval_s), strict=True
            )
        )
        return Filled(shares, request.start_s + exposures * interval_s)


def filled_before(
    request: SeriesRequest, law: GainMemory, exposed: Exposed, readout_ms: float | None, carried: Carried
) -> tuple[FloatArray, ...]:
    """Share of each kind of traps (row, column) or (1, 1) that earlier exposures have left full at the begin of the series.

    carried: what was found for the series asked before, which is taken up where that one's earlier exposures are this one's, too.
    """
    earlier = (*request.long_ago, *request.previous)
    known = len(carried.steps) if carried.begins(earlier) else 0
    filled = carried.value if known else Filled.nowhere(law)
    for one in earlier[known:]:
        if one.beam_on:
            state, charge = exposed(one)
            if state.gain_memory is not None:  # else it had not set in
                filled = filled.after(law, one, charge.mean, readout_ms)
    carried.take(earlier, filled)
    return filled.at(law, request.start_s)


def filling(law: GainMemory, light_DN: FloatArray, interval_s: float) -> list[tuple[FloatArray, FloatArray]]:
    """Of each kind of traps, the share that is full in the end under exposures of this light, and 1 over those that it takes."""
    taken = law.filled_per_DN * np.maximum(light_DN, 0.0)
    paces = [np.maximum(taken + interval_s / fade_s, _SLOWEST) for _, fade_s in law.kinds]
    return [(taken / pace, pace) for pace in paces]


def gain_course(
    law: GainMemory,
    before: Sequence[FloatArray],
    light_DN: FloatArray,
    interval_s: float,
    exposures: int,
    averaged: int,
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Mean factor on the signal over a series, and its changes: (map, profile over the stored frames of mean 0) by kind of traps.

    The mean is exact; all pixels change in the course of the one in the middle, as far as each does.
    """
    gain: FloatArray = np.ones((1, 1))
    changes = []
    for (share, _), full, (steady, pace) in zip(law.kinds, before, filling(law, light_DN, interval_s), strict=True):
        away = full - steady
        left = -np.expm1(-exposures * pace)
        gain = gain + law.most * share * (steady + away * left / (exposures * -np.expm1(-pace)))
        course = np.exp(-float(np.median(pace)) * np.arange(exposures))
        course = frame_means(
            (course - course.mean()) / max(1.0 - math.exp(-float(np.median(pace)) * exposures), 1e-300), averaged
        )
        changes.append((law.most * share * away * left, course))
    return gain, changes


def temporal_covariance(law: LagLaw, decay: FloatArray, averaged: int) -> FloatArray:
    """Covariance of stored frames (1 + lags,) over the variance of one exposure without lag."""
    trapped = np.asarray(law.trapped)
    # covariance of single exposures over `lag`, sums of geometric series in closed form
    first = 1.0 - float(trapped.sum())
    amount = trapped * (1.0 - decay)
    mixed = np.outer(amount, amount) / (1.0 - np.outer(decay, decay))

    def single(lag: int) -> float:
        if lag == 0:
            return first**2 + float(mixed.sum())
        return first * float(np.sum(amount * decay ** (lag - 1))) + float(np.sum(mixed * decay[:, None] ** lag))

    if averaged == 1:
        return np.array([single(lag) for lag in range(LAGS + 1)])
    reach = averaged * (LAGS + 1)
    singles = np.array([single(lag) for lag in range(reach)])
    inside = averaged - np.abs(np.arange(-averaged + 1, averaged))
    return np.array(
        [
            float(np.sum(inside * singles[np.abs(lag * averaged + np.arange(-averaged + 1, averaged))])) / averaged**2
            for lag in range(LAGS + 1)
        ]
    )


def frame_means(profile: FloatArray, averaged: int) -> FloatArray:
    """Profile over exposures -> profile over stored frames."""
    return np.asarray(profile.reshape(-1, averaged).mean(axis=1))

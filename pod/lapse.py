"""POD with a ceiling below 1 (lapses: objects missed at any size) and a floor above 0 (false calls that hit by chance).

POD(x) = floor + (ceiling - floor) g^-1(c0 + c1 x)

Bounds are likelihood-ratio ones, from the profile over the other parameters. A ceiling is only known where there are
many trials of large objects: a curve that may never reach 90 % has no a90.
Validity: independent trials; ceiling within (0.5, 1], floor within [0, 0.5).
Source: Wichmann & Hill, Perception & Psychophysics 63 (2001) 1293 (the same curve in psychophysics); Self & Liang,
JASA 82 (1987) 605 (tests at the border).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from .hit_miss import Z_ONE_SIDED, Z_TWO_SIDED, fit_pooled, size_from_x, size_in_range
from .likelihood import Curve
from .links import Link, link_from_name
from .trials import Trials

Array = NDArray[np.float64]

_TINY = 1e-9
_FLOOR, _CEILING = 2, 3  # places among c0, c1, floor, ceiling


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A ceiling or floor (a probability) with its two-sided 95 % likelihood interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LapseFit:
    """A POD curve with ceiling and floor. Sizes in the data's unit, None where the data cannot support a number.

    a90_95: one-sided 95 % likelihood-ratio bound; a90_low_two_sided, a90_95_two_sided: ends of the two-sided one.
    p_plain: p-value of the test that the plain curve (0 to 1) is enough.
    """

    link: str
    log_size: bool
    c0: float
    c1: float
    ceiling: Share
    floor: Share
    log_likelihood: float
    aic: float
    p_plain: float
    a50: float | None
    a90: float | None
    a90_95: float | None
    a90_95_two_sided: float | None
    a90_low_two_sided: float | None
    warnings: tuple[str, ...]


def fit_lapse_pod(
    table: Trials, *, link: str = "cloglog", log_size: bool = False, ceiling: bool = True, floor: bool = True
) -> LapseFit:
    """Fit a POD curve whose ceiling and floor are free; sizes in the data's unit.

    Args:
        table: the trials, taken as independent.
        link: the link's name.
        log_size: fit on ln size.
        ceiling, floor: which of the two is free (else 1 and 0).

    Raises:
        InputError: neither is free.
        FitError: the data have no curve (all hits, all misses, one size).
    """
    if not (ceiling or floor):
        raise InputError("ceiling and floor", received="neither free", expected="at least one of them free")
    shape = link_from_name(link)
    plain_fit = fit_pooled(table, link=shape, log_size=log_size, method="auto")
    if plain_fit.curve is None:
        raise FitError("; ".join(plain_fit.warnings))
    problem, plain = _Problem.of(plain_fit.curve, ceiling=ceiling, floor=floor), plain_fit.curve.coefficients
    best, value = problem.minimise(None, starts=problem.starts(plain))
    c0, slope, low_share, high_share = problem.parameters(best)
    notes: list[str] = []
    top, bottom = Share(value=1.0, low=1.0, high=1.0), Share(value=0.0, low=0.0, high=0.0)
    if ceiling:
        top = problem.interval(_CEILING, best, value, within=(0.5, 1.0))
    if floor:
        bottom = problem.interval(_FLOOR, best, value, within=(0.0, 0.5))
    if ceiling and top.low <= 0.5 + 1e-6:
        notes.append("the trials of large objects are too few to bound the ceiling from below")
    a50 = a90 = bound = bound_two = bound_low = None
    if slope <= 0:
        notes.append("POD does not rise with size in these data: no a50 and no a90")
    else:
        sizes: dict[int, float | None] = {}
        for percent in (50, 90):
            share = (percent / 100 - low_share) / (high_share - low_share)
            if not 0 < share < 1:
                sizes[percent] = None
                reason = "is above" if share <= 0 else "never reaches"
                notes.append(f"the curve {reason} {percent} %, so there is no a{percent}")
                continue
            at = (shape.eta_from_pod(share) - c0) / slope
            sizes[percent], note = size_in_range(
                at, smallest=float(problem.x[0]), largest=float(problem.x[-1]), log_size=log_size, percent=percent
            )
            if note:
                notes.append(note)
        a50, a90 = sizes[50], sizes[90]
    if a90 is not None:
        ends = problem.bounds_on_a90(math.log(a90) if log_size else a90, best, value)
        bound, bound_two, bound_low = (size_from_x(end, log_size=log_size) for end in ends)
        if bound is None or bound_two is None:
            which, what = ("", "bound") if bound is None else ("two-sided ", "upper end of a two-sided interval")
            notes.append(
                f"a curve that never reaches 90 % is within the {which}95 % likelihood region: no {what} on a90"
            )
    gain = max(problem.deviance(np.array([*plain, 0.0, 1.0]))[0] - value, 0.0)
    return LapseFit(
        link=link,
        log_size=log_size,
        c0=c0,
        c1=slope,
        ceiling=top,
        floor=bottom,
        log_likelihood=-0.5 * value,
        aic=problem.aic(value),
        p_plain=_border_p(gain, ceiling + floor),
        a50=a50,
        a90=a90,
        a90_95=bound,
        a90_95_two_sided=bound_two,
        a90_low_two_sided=bound_low,
        warnings=tuple(notes),
    )


def lapse_aic(plain: Curve, *, ceiling: bool, floor: bool) -> float:
    """AIC of a curve whose ceiling or floor is free, as in `fit_lapse_pod`, from the most likely one without."""
    problem = _Problem.of(plain, ceiling=ceiling, floor=floor)
    starts = problem.starts(plain.coefficients)
    value, slopes = problem.deviance(starts[-1])
    # at the border the plain curve is the best one, unless a lower ceiling or a higher floor lowers -2 ln L
    if (ceiling and slopes[3] > 0) or (floor and slopes[2] < 0):
        value = min(value, problem.minimise(None, starts=[starts[0], starts[-1]])[1])
    return problem.aic(value)


def _border_p(gain: float, free: int) -> float:
    """p-value of a likelihood-ratio statistic whose `free` parameters lie on their border under the hypothesis."""
    from scipy.special import gammaincc

    if gain <= 0:
        return 1.0
    one, two = float(gammaincc(0.5, gain / 2)), math.exp(-gain / 2)
    return 0.5 * one if free == 1 else 0.5 * one + 0.25 * two


def _root(function: Callable[[float], float], inside: float, limit: float, level: float) -> float:
    """Where a function that grows from `inside` towards `limit` crosses `level`; `limit` where it does not."""
    from scipy.optimize import brentq

    if function(limit) <= level:
        return limit
    return float(brentq(lambda at: function(at) - level, inside, limit, xtol=1e-8 * (1 + abs(limit - inside))))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """-2 ln L over (c0, c1, floor, ceiling), on x standardised for the search."""

    x: Array
    hits: Array
    misses: Array
    link: Link
    ceiling: bool
    floor: bool

    @classmethod
    def of(cls, plain: Curve, *, ceiling: bool, floor: bool) -> "_Problem":
        """Of the trials that a plain curve was fitted to, with its link."""
        return cls(x=plain.x, hits=plain.hits, misses=plain.misses, link=plain.link, ceiling=ceiling, floor=floor)

    def deviance(self, p: Array) -> tuple[float, Array]:
        c0, c1, low, high = p
        eta = c0 + c1 * self.x
        inner = self.link.pod_from_eta(eta)
        parts = self.link.log_parts(eta)
        pod = np.clip(low + (high - low) * inner, 1e-300, 1 - 1e-16)
        value = -2 * float(self.hits @ np.log(pod) + self.misses @ np.log1p(-pod))
        rate = -2 * (self.hits / pod - self.misses / (1 - pod))
        by_eta = rate * (high - low) * inner * parts.log_hit_1
        return value, np.array([by_eta.sum(), by_eta @ self.x, rate @ (1 - inner), rate @ inner])

    def aic(self, value: float) -> float:
        """Of a curve with this -2 ln L."""
        return value + 2 * (2 + self.ceiling + self.floor)

    def starts(self, coefficients: tuple[float, ...]) -> list[Array]:
        c0, c1 = coefficients
        middle = float(np.average(self.x, weights=self.hits + self.misses))
        result = []
        for steeper, high, low in ((1.0, 0.98, 0.02), (2.0, 0.9, 0.1), (3.0, 0.8, 0.05), (1.5, 0.95, 0.2)):
            slope = steeper * c1
            centre = c0 + c1 * middle - slope * middle
            result.append(np.array([centre, slope, low if self.floor else 0.0, high if self.ceiling else 1.0]))
        result.append(np.array([c0, c1, 0.0, 1.0]))
        return result

    def _bounds(self, fixed: dict[int, float] | None) -> list[tuple[float | None, float | None]]:
        bounds: list[tuple[float | None, float | None]] = [
            (None, None),
            (None, None),
            (0.0, 0.5 - _TINY) if self.floor else (0.0, 0.0),
            (0.5 + _TINY, 1.0) if self.ceiling else (1.0, 1.0),
        ]
        for index, value in (fixed or {}).items():
            bounds[index] = (value, value)
        return bounds

    def minimise(self, fixed: dict[int, float] | None, *, starts: list[Array]) -> tuple[Array, float]:
        """Smallest deviance with some parameters held, from several starts."""
        from scipy.optimize import minimize

        middle, spread = float(self.x.mean()), float(self.x.std()) or 1.0

        def scaled(q: Array) -> tuple[float, Array]:
            slope = q[1] / spread
            value, g = self.deviance(np.array([q[0] - slope * middle, slope, q[2], q[3]]))
            return value, np.array([g[0], (g[1] - middle * g[0]) / spread, g[2], g[3]])

        bounds = self._bounds(fixed)
        best, lowest = starts[0], math.inf
        for start in starts:
            begin = np.array([start[0] + start[1] * middle, start[1] * spread, start[2], start[3]])
            for index, (low, high) in enumerate(bounds):
                if low is not None and high is not None:
                    begin[index] = min(max(begin[index], low), high)
            answer = minimize(
                scaled, begin, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-15, "gtol": 1e-8}
            )
            if answer.fun < lowest:
                lowest, q = float(answer.fun), answer.x
                best = np.array([q[0] - q[1] / spread * middle, q[1] / spread, q[2], q[3]])
        return best, lowest

    def minimise_through(self, at: float, pod: float, *, starts: list[Array]) -> float:
        """Smallest deviance of curves that reach `pod` at x = `at`."""
        from scipy.optimize import minimize

        spread = float(self.x.std()) or 1.0
        centred = self.x - at

        def held(q: Array) -> float:
            share = (pod - q[1]) / (q[2] - q[1])
            c0 = self.link.eta_from_pod(min(max(share, 1e-12), 1 - 1e-12))
            inner = self.link.pod_from_eta(c0 + q[0] / spread * centred)
            values = np.clip(q[1] + (q[2] - q[1]) * inner, 1e-300, 1 - 1e-16)
            return -2 * float(self.hits @ np.log(values) + self.misses @ np.log1p(-values))

        bounds = self._bounds(None)
        limits = [(1e-9, None), bounds[2], (max(bounds[3][0] or 0.0, pod + 1e-6), 1.0)]
        lowest = math.inf
        for start in starts:
            for high in {max(start[3], pod + 1e-3), 1.0 if not self.ceiling else 0.5 * (1 + pod)}:
                begin = [max(start[1] * spread, 1e-6), start[2], min(high, 1.0)]
                answer = minimize(held, begin, method="L-BFGS-B", bounds=limits, options={"ftol": 1e-13, "eps": 1e-7})
                lowest = min(lowest, float(answer.fun))
        return lowest

    def interval(self, place: int, best: Array, lowest: float, *, within: tuple[float, float]) -> Share:
        """A floor or ceiling with its two-sided 95 % likelihood interval; lowest: the deviance of the best parameters."""
        estimate = float(best[place])

        def excess(at: float) -> float:
            return self.minimise({place: at}, starts=[best])[1] - lowest

        low, high = (
            limit if abs(estimate - limit) < 1e-7 else _root(excess, estimate, limit, Z_TWO_SIDED**2)
            for limit in within
        )
        return Share(value=estimate, low=low, high=high)

    def bounds_on_a90(self, at90: float, best: Array, lowest: float) -> list[float | None]:
        """One-sided upper, two-sided upper and two-sided lower 95 % bound on the x of a90, `at90` by the best parameters.

        None where curves that never reach 90 % are within the likelihood region.
        """
        span = float(self.x[-1] - self.x[0])
        far = at90 + 20 * span
        # a curve that never reaches 90 % is one with its a90 at infinity
        never = self.minimise({_CEILING: 0.9}, starts=[best])[1] - lowest if self.ceiling else math.inf

        def excess(at: float) -> float:
            return self.minimise_through(at, 0.9, starts=[best]) - lowest

        ends: list[float | None] = []
        for quantile in (Z_ONE_SIDED**2, Z_TWO_SIDED**2):
            held = never > quantile and excess(far) > quantile
            ends.append(_root(excess, at90, far, quantile) if held else None)
        ends.append(_root(excess, at90, at90 - 20 * span, Z_TWO_SIDED**2))
        return ends

    @staticmethod
    def parameters(p: Array) -> tuple[float, float, float, float]:
        return float(p[0]), float(p[1]), float(p[2]), float(p[3])

"""Likelihood bounds on the a90 of a population-averaged curve with crossed random effects.

The curve is held at POD 90 % at x by the constant, c0 = eta90(s) - c1 x; what is left free is the slope and the
spreads.

r(x) = sign(x_hat - x) sqrt(D_p(x) - D_hat), D the deviance: the plain likelihood ratio.
r*(x) = r + ln(q / r) / r, q = l_p'(x) j_p(x_hat)^(-1/2) (|j(x)| / |j(x_hat)|)^(1/2), j the information on slope and
spreads (those that are not 0): the tail area of the likelihood averaged over them with equal weight, by Laplace's method
(DiCiccio & Martin).
A bound is where r or r* reaches t (V / V_hat)^(1/2): V_hat the variance from the likelihood's curvature, V the one that
knows how few networks and images there are, t Student's quantile with the degrees of freedom of V (`few_groups.py`).
The curvature of the random effects is the observed one; with the expected one, as lme4 does, a90 comes out low by some 2 %
of itself with links other than logit.
Source: DiCiccio & Martin, J. R. Stat. Soc. B 55 (1993) 305.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError
from ._laplace import Laplace
from .few_groups import Levels, levels_of, size_from_test, student_quantile
from .links import Link
from .mixed import Codes, MixedFit, averaged_eta, fit_mixed, minimise, second_differences
from .trials import Trials

Array = NDArray[np.float64]

_NO_MAXIMUM = "the likelihood of the fit with crossed random effects does not fall on all sides of its estimate"


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossedTrials:
    """Trials of crossed factors as a regression asks for them: design (row, 2), 1 and x; codes (row,) of each factor; link."""

    table: Trials
    design: Array
    factors: list[Codes]
    link: Link

    def laplace(self, *, expected: bool) -> Laplace:
        """Their deviance by Laplace's method, with the expected or the observed curvature."""
        return Laplace.of(self.table, factors=self.factors, link=self.link, expected=expected)

    def fit(self, start: Array, *, expected: bool = True) -> MixedFit:
        """The most likely regression.

        Raises:
            FitError: the search did not converge.
        """
        return fit_mixed(
            self.design,
            self.table.hits,
            self.table.misses,
            factors=self.factors,
            link=self.link,
            start=start,
            expected=expected,
        )

    def levels_of(self, mixed: MixedFit, laplace: Laplace) -> Levels:
        """What the levels of the factors say of the spreads of a fit."""
        looks = self.table.hits + self.table.misses
        shares = [np.bincount(codes, weights=looks) / self.table.n for codes in self.factors]
        return levels_of(mixed.sd, shares, laplace.information(self.design @ mixed.coefficients, mixed.sd))


class AveragedSize:
    """The averaged a90 on the scale of x: its estimate, standard error (delta method) and bounds.

    Raises:
        FitError: the likelihood does not fall on all sides of the estimate.
    """

    def __init__(self, mixed: MixedFit, trials: CrossedTrials) -> None:
        link = trials.link
        self._link = link
        self._x = trials.design[:, 1]
        self._least = mixed.deviance
        # under logit the two curvatures are the same
        self._laplace = trials.laplace(expected=link.name == "logit")
        parameters = np.concatenate((mixed.coefficients, mixed.sd))
        self.estimate = self._size(parameters)
        rise = np.array(
            [
                (self._size(parameters + step) - self._size(parameters - step)) / (2 * step.max())
                for step in np.diag(1e-4 * np.maximum(np.abs(parameters), 1e-2))
            ]
        )
        squared = float(rise @ mixed.covariance @ rise)
        if not squared > 0:
            raise FitError(_NO_MAXIMUM)
        self.error = math.sqrt(squared)
        # the free parameters (slope, spreads) in units in which the deviance is round
        covariance = mixed.covariance[1:, 1:].copy()
        zero = np.concatenate(([False], mixed.sd == 0))
        covariance[zero, :] = 0.0
        covariance[:, zero] = 0.0
        covariance[zero, zero] = 0.05
        try:
            self._root = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            raise FitError(_NO_MAXIMUM) from None
        self._centre = parameters[1:]
        # a spread at 0 is apart from the others in these units, and held there by r*
        self._kept = ~zero
        self._information_at_estimate: float | None = None
        self._likelihood: dict[tuple[float, float], float | None] = {}
        self._mixed = mixed
        self._levels = trials.levels_of(mixed, self._laplace)
        self._eta_rise = self._rise_of_eta(mixed.sd)
        variance, freedom = self._levels.spread(self.error**2, 1 / float(mixed.coefficients[1]))
        self.degrees_of_freedom = float(freedom)
        self._stretch = math.sqrt(float(variance)) / self.error

    def _rise_of_eta(self, sd: Array) -> Array:
        """Derivative of the eta of POD 90 % by each spread."""
        width = 1e-4
        ends = [
            [averaged_eta(0.9, math.hypot(*(sd + side * step)), link=self._link) for side in (1, -1)]
            for step in width * np.eye(len(sd))
        ]
        return np.array([(up - down) / (2 * width) for up, down in ends])

    def _quantile(self, below: float) -> float:
        return self._stretch * float(student_quantile(below, self.degrees_of_freedom))

    def wald_bound(self, below: float, side: float) -> float | None:
        """x above (side 1) or below (-1) the estimate where Wald's test of POD(x) = 90 % stops to reject; None: nowhere."""
        c0, c1 = self._mixed.coefficients
        eta = averaged_eta(0.9, math.hypot(*self._mixed.sd), link=self._link)

        def excess(x: float) -> tuple[float, float, float]:
            toward = np.array([1.0, x, *-self._eta_rise])
            variance, freedom = self._levels.spread(float(toward @ self._mixed.covariance @ toward), 1.0)
            return float(c0 + c1 * x - eta), float(variance), float(freedom)

        span = float(np.ptp(self._x))
        return size_from_test(excess, below=below, upper=side > 0, start=self.estimate, span=span)

    def _size(self, parameters: Array) -> float:
        eta = averaged_eta(0.9, math.hypot(*parameters[2:]), link=self._link)
        return float((eta - parameters[0]) / parameters[1])

    def _held(self, at: float) -> Callable[[Array], float]:
        def deviance(free: Array) -> float:
            parameters = self._centre + self._root @ free
            eta = averaged_eta(0.9, math.hypot(*parameters[1:]), link=self._link)
            return self._laplace.deviance(eta + parameters[0] * (self._x - at), parameters[1:])

        return deviance

    def _profile(self, at: float, start: Array) -> tuple[float, Array]:
        """Rise of the deviance where the averaged a90 is held at x = at, and the free parameters there."""
        point, value, _, _ = minimise(self._held(at), start, hessian=2 * np.eye(len(start)), tolerance=1e-8)
        return value - self._least, point

    def likelihood_bound(self, below: float, side: float) -> float | None:
        """x above (side 1) or below (-1) the estimate where r reaches Student's quantile; None where it never does."""
        if (below, side) not in self._likelihood:
            z = self._quantile(below)
            begin = self.estimate + side * z * self.error
            self._likelihood[below, side] = self._solve(z, side, self._root_of_drop, begin)
        return self._likelihood[below, side]

    def modified_bounds(self, asked: Sequence[tuple[float, float]]) -> list[float | None]:
        """x where r* reaches the quantile, for each (below, side) asked; all plain bounds where r* fails for one."""
        plain = [self.likelihood_bound(below, side) for below, side in asked]
        if any(value is None for value in plain):
            return plain
        found = [
            self._solve(self._quantile(below), side, self._modified_root, value)
            for (below, side), value in zip(asked, plain, strict=True)
            if value is not None
        ]
        reach = [
            math.nan if value is None else side * (value - self.estimate)
            for (_, side), value in zip(asked, found, strict=True)
        ]
        upward = [(below, r) for (below, side), r in zip(asked, reach, strict=True) if side > 0]
        in_order = all(r > 0 for r in reach) and sorted(upward) == sorted(upward, key=lambda pair: pair[1])
        return list(found) if in_order else plain

    def _solve(
        self, z: float, side: float, root: Callable[[float, Array], tuple[float, Array]], begin: float
    ) -> float | None:
        start = np.zeros(len(self._centre))
        span = float(np.ptp(self._x))
        before, root_before, at = self.estimate, 0.0, begin
        for _ in range(25):
            now, start = root(at, start)
            if not math.isfinite(now) or abs(at - self.estimate) > 50 * span:
                return None
            if abs(now - z) < 1e-4:
                return at
            if at == before:
                return None  # the search stands still
            rate = (now - root_before) / (at - before)
            if not rate * side > 0:
                return None
            before, root_before = at, now
            away = side * (at - self.estimate)
            step = side * (z - now) / rate
            at = self.estimate + side * (away + min(max(step, -0.9 * away), 2 * away))
        return None

    def _root_of_drop(self, at: float, start: Array) -> tuple[float, Array]:
        drop, point = self._profile(at, start)
        return math.sqrt(max(drop, 0.0)), point

    def _modified_root(self, at: float, start: Array) -> tuple[float, Array]:
        drop, point = self._profile(at, start)
        r = math.sqrt(max(drop, 0.0))
        if r < 0.05:
            return r, point
        width = 1e-3 * self.error
        # the free parameters are at their optimum, so the profile's slope is the partial one
        slope = (self._held(at + width)(point) - self._held(at - width)(point)) / (4 * width)
        if self._information_at_estimate is None:
            middle = np.zeros(len(point))
            self._information_at_estimate = self._information(self.estimate, middle)
        ratio = self._information(at, point) / self._information_at_estimate
        q = abs(slope) * self.error * math.sqrt(ratio) if 0.05 < ratio < 20 else math.nan
        return (r + math.log(q / r) / r, point) if q > 0 else (math.nan, point)

    def _information(self, at: float, point: Array) -> float:
        """Determinant on slope and spreads that are not 0, up to a constant factor."""
        held = self._held(at)

        def part(kept: Array) -> float:
            moved = point.copy()
            moved[self._kept] = kept
            return held(moved)

        return float(np.linalg.det(second_differences(part, point[self._kept], width=0.03) / 2))

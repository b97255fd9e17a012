"""Profile likelihood of a two-parameter curve: bounds on the size at a given POD, band of the curve, joint region.

Likelihood-ratio regions are {c : 2 (sup l - l(c)) / divisor <= q}, q a chi-square quantile with 1 degree of freedom for
a size or for the curve at one size, with 2 for the joint region. They need no symmetry. They exist where the data separate,
as the supremum of the likelihood does, but hold a true a90 far too seldom there (VALIDATION pod-28).
Source: MIL-HDBK-1823A (2009) G.3; Cheng & Iles, Technometrics 25 (1983) 77, doi:10.1080/00401706.1983.10487817.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..results import ByValue
from .links import Link
from .solver import fit_batch

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve(ByValue):
    """A curve's data and fit on the x it is linear in: distinct x, hits and misses (distinct,), link, coefficients.

    `supremum` is the largest attainable log-likelihood, `divisor` what the likelihood is divided by (repeats),
    `at_maximum` whether the coefficients are the most likely ones (not so for a bias-reduced fit).
    """

    x: Array
    hits: Array
    misses: Array
    link: Link
    coefficients: tuple[float, float]
    covariance: Array
    supremum: float
    divisor: float = 1.0
    at_maximum: bool = True

    def most_likely_x(self, eta: float) -> float:
        """The x at which the most likely curve reaches `eta`, the coefficients' own where there is no such curve."""
        c0, c1 = self.coefficients
        if not self.at_maximum:
            design = np.stack((np.ones_like(self.x), self.x), axis=1)
            batch = fit_batch(design, self.hits[None], self.misses[None], link=self.link)
            if batch.converged[0] and batch.coefficients[0, 1] > 0:
                c0, c1 = batch.coefficients[0]
        return float((eta - c0) / c1)


def profile(curve: Curve, x: Array, eta: Array, slope: Array) -> tuple[Array, Array, Array]:
    """Largest log-likelihood of curves through (x, eta), the slope there and dl/d(eta) along the way; all (point,).

    Args:
        x, eta: (point,), where the curve is held.
        slope: (point,), slopes to start from.
    """
    distance = curve.x - x[:, None]
    slope = slope.copy()
    step = np.zeros_like(slope)
    best = np.full(len(x), -np.inf)
    pull = np.zeros_like(slope)
    for _ in range(60):
        trial = slope + step
        parts = curve.link.log_parts(eta[:, None] + trial[:, None] * distance)
        value = parts.log_hit @ curve.hits + parts.log_miss @ curve.misses
        first = parts.log_hit_1 * curve.hits + parts.log_miss_1 * curve.misses
        second = parts.log_hit_2 * curve.hits + parts.log_miss_2 * curve.misses
        better = value >= best - 1e-11 * (1 + np.abs(best))
        slope = np.where(better, trial, slope)
        best = np.where(better, value, best)
        pull = np.where(better, first.sum(axis=1), pull)
        gradient = (first * distance).sum(axis=1)
        curvature = -(second * distance * distance).sum(axis=1)
        move = np.divide(gradient, curvature, out=np.zeros_like(gradient), where=curvature > 1e-300)
        # beyond a span of 30 units of eta the likelihood is flat to rounding: keep the steps there tame
        step = np.where(better, move, 0.5 * step)
        reach = np.abs(distance).max(axis=1)
        limit = 30.0 / np.maximum(reach, 1e-300)
        step = np.clip(step, -limit, limit)
        if np.all(np.abs(np.where(better, gradient, np.inf) * step) < 1e-12):
            break
    return best, slope, pull


def size_bound(curve: Curve, *, eta: float, quantile: float, upper: bool, start: float) -> float | None:
    """Likelihood-ratio bound on the x at which the curve reaches `eta`; x's own unit, None where there is none.

    The root of 2 (sup l - l_p(x)) / divisor = quantile on one side of `start`, an x inside the region. There is no
    bound where curves without any slope are within the region too.

    Args:
        eta: g(POD) asked for.
        quantile: chi-square quantile with 1 degree of freedom (2.706 for a one-sided 95 % bound, 3.841 two-sided).
        upper: the bound above, else below.
        start: an x where the left side is below `quantile`, the estimate as a rule.
    """
    allowed = quantile * curve.divisor
    if may_be_flat(curve, eta=eta, quantile=quantile, upper=upper):
        return None
    slope = np.array([max(curve.coefficients[1], 1e-12)])
    side = 1.0 if upper else -1.0

    def root_of(x: float) -> tuple[float, float]:
        nonlocal slope
        value, slope, pull = profile(curve, np.array([x]), np.array([eta]), slope)
        ratio = max(2 * (curve.supremum - float(value[0])), 0.0)
        signed = math.sqrt(ratio) - math.sqrt(allowed)
        # d l_p / dx = -slope dl/d(eta), by the envelope theorem
        rate = float(slope[0] * pull[0]) / math.sqrt(ratio) if ratio > 0 else 0.0
        return signed, rate

    variance = _wald_variance(curve, start)
    spread = float(curve.x[-1] - curve.x[0]) or 1.0
    reach = math.sqrt(variance * allowed) if math.isfinite(variance) and variance > 0 else 0.1 * spread
    inside, outside = start, math.nan
    x = start + side * min(reach, 10 * spread)
    for _ in range(80):
        signed, rate = root_of(x)
        if abs(signed) < 1e-10:
            return x
        if signed < 0:
            inside = x
        else:
            outside = x
        newton = x - signed / rate if rate * side > 0 else math.nan
        if math.isnan(outside):
            # grow, but let Newton shorten the way where it points outward
            longest = inside + side * 3 * (abs(inside - start) + 0.01 * spread)
            x = newton if math.isfinite(newton) and side * (newton - inside) > 0 else longest
            if side * (x - longest) > 0:
                x = longest
        else:
            low, high = min(inside, outside), max(inside, outside)
            if high - low < 1e-12 * (abs(high) + spread):
                return 0.5 * (low + high)
            x = newton if low < newton < high else 0.5 * (low + high)
    return None


def may_be_flat(curve: Curve, *, eta: float, quantile: float, upper: bool) -> bool:
    """Whether curves without any slope are within the region, so that the likelihood bounds no size; as `size_bound`."""
    return 2 * (curve.supremum - _flat_log_likelihood(curve, eta, upper=upper)) <= quantile * curve.divisor


def _flat_log_likelihood(curve: Curve, eta: float, *, upper: bool) -> float:
    """Largest log-likelihood of curves that only reach `eta` at plus (or minus) infinity: flat, below (above) it."""
    hits, misses = float(curve.hits.sum()), float(curve.misses.sum())
    target = float(curve.link.pod_from_eta(np.array(eta)))
    share = hits / (hits + misses)
    share = min(share, target) if upper else max(share, target)
    value = 0.0
    if hits:
        value += hits * math.log(share) if share > 0 else -math.inf
    if misses:
        value += misses * math.log1p(-share) if share < 1 else -math.inf
    return value


def _wald_variance(curve: Curve, x: float) -> float:
    toward = np.array([1.0, x])
    return float(toward @ curve.covariance @ toward) / max(curve.coefficients[1] ** 2, 1e-300)


def eta_band(curve: Curve, x: Array, *, quantile: Array | float) -> tuple[Array, Array]:
    """Likelihood-ratio limits (low, high) of eta at each x, each (point,); -inf and +inf where there is none.

    With a 1-degree quantile each point's own interval, with a 2-degree quantile the band of the whole curve.
    """
    allowed = quantile * curve.divisor
    c0, c1 = curve.coefficients
    centre = c0 + c1 * x
    spread = np.sqrt(
        np.maximum(curve.covariance[0, 0] + 2 * x * curve.covariance[0, 1] + x * x * curve.covariance[1, 1], 1e-12)
    )
    limits = []
    for side in (-1.0, 1.0):
        eta = centre + side * spread * np.sqrt(allowed)
        slope = np.full(len(x), c1)
        for _ in range(60):
            value, slope, pull = profile(curve, x, eta, slope)
            excess = 2 * (curve.supremum - value) - allowed
            rate = -2 * pull
            usable = rate * side > 1e-12
            # 2 (sup l - l_p) is convex in eta, so Newton from outside never steps over the root
            step = np.where(usable, -excess / np.where(usable, rate, 1.0), side * spread)
            step = np.clip(step, -20 * spread - 1, 20 * spread + 1)
            eta = eta + step
            if np.all(np.abs(excess) < 1e-9 * (1 + allowed)) or np.all(np.abs(eta) > 1e3):
                break
        limits.append(np.where(np.abs(eta) > 100, side * np.inf, eta))
    return limits[0], limits[1]


def joint_region(curve: Curve, *, quantile: float, points: int = 180) -> Array:
    """Border of the joint region of (c0, c1), (points, 2), in order around the estimate.

    2 (sup l - l(c)) / divisor = quantile, with the 2-degree chi-square quantile (5.991 for 95 %). Found along rays; the
    region is convex because the likelihood is log-concave. Only for fits whose likelihood has a maximum.
    """
    allowed = quantile * curve.divisor
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
    ray = np.stack((np.cos(angle), np.sin(angle)), axis=1) @ np.linalg.cholesky(curve.covariance).T
    centre = np.array(curve.coefficients)
    radius = np.full(points, math.sqrt(allowed))
    deviation: Callable[[Array], Array] = lambda c: c[:, :1] + c[:, 1:] * curve.x  # noqa: E731
    for _ in range(60):
        parts = curve.link.log_parts(deviation(centre + radius[:, None] * ray))
        value = parts.log_hit @ curve.hits + parts.log_miss @ curve.misses
        first = parts.log_hit_1 * curve.hits + parts.log_miss_1 * curve.misses
        rate = -2 * (first * deviation(ray)).sum(axis=1)
        excess = 2 * (curve.supremum - value) - allowed
        if np.all(np.abs(excess) < 1e-9 * (1 + allowed)):
            break
        step = np.where(rate > 0, -excess / np.where(rate > 0, rate, 1.0), radius)
        radius = np.maximum(radius + step, 0.1 * radius)
    return np.asarray(centre + radius[:, None] * ray)

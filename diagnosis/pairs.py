"""Two effects at once, each brought to what the other leaves, in turn, until neither moves.

The evidence is the chain rule's: of the first at its strength (its uncertainty as a Gaussian's), times that of the second in what
the first leaves. Which of two is the first makes no difference where both have settled.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .curve_fits import IMPLAUSIBLE, CurveFit, fit_curve
from .curves import Curve
from .discrepancy import FARTHEST_LEVEL, LEVELS, log_leak
from .observed import Observed, Point, slope

_IN_FULL = 10  # pairs, the likeliest at first sight, that are settled
_TURNS, _SETTLED = 6, 0.1  # in which two settle, and gain of log evidence that ends them
_CARRIED = LEVELS.up_to(FARTHEST_LEVEL)
_VARIANTS = 2  # of an effect beside another, the likeliest at first sight, that are fitted with all levels


@dataclass(frozen=True, slots=True, kw_only=True)
class Single:
    """One effect against the probes: fits of its variants, the best of them, log evidence over none (variants averaged)."""

    fits: Sequence[CurveFit]
    best: CurveFit
    log_evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two effects: log evidence over none, and the fit of each beside the other, by effect."""

    log_evidence: float
    fits: Mapping[str, CurveFit]

    @property
    def effects(self) -> tuple[str, str]:
        """The two, in alphabetical order."""
        first, second = sorted(self.fits)
        return first, second


def weigh_pairs(observed: Observed, singles: Mapping[str, Single], *, leading: int) -> list[Pair]:
    """The effects that explain most, so many as `leading` says, each with every other one: those that are likely at first sight.

    Args:
        observed: what is weighed.
        singles: all effects, by id.
        leading: how many effects are the first of a pair.
    """
    if len(singles) < 2:
        return []
    curves = {name: [fit.curve for fit in single.fits] for name, single in singles.items()}
    ranked = sorted(singles, key=lambda effect: -singles[effect].log_evidence)
    seen: dict[tuple[str, str], tuple[float, Point, str]] = {}
    for first in ranked[:leading]:
        best = singles[first].best
        point = best.at_level(min(best.level, FARTHEST_LEVEL))
        beside = observed.beside(point)
        start = beside.log_likelihood - observed.log_likelihood
        for second, own in curves.items():
            if second == first:
                continue
            gain = max(fit_curve(beside, beside.scaled(curve), exact=True).log_evidence for curve in own)
            a, b = sorted((first, second))
            if (a, b) not in seen or start + gain > seen[a, b][0]:
                seen[a, b] = start + gain, point, second
    likely = sorted(seen.values(), key=lambda item: -item[0])[:_IN_FULL]
    return [_settled(observed, point, curves, other) for _, point, other in likely]


def _settled(observed: Observed, point: Point, curves: Mapping[str, Sequence[Curve]], other: str) -> Pair:
    """Two effects by turns: `other` beside a first one at its point, then the first beside the other, and so on."""
    none = observed.log_likelihood
    best: Pair | None = None
    fits: dict[str, CurveFit] = {}
    for _ in range(_TURNS):
        beside = observed.beside(point)
        fit = _beside(beside, curves[other])
        evidence = beside.log_likelihood - none + fit.log_evidence
        second = Point(curve=_own(curves[other], fit), strength=fit.best, level=fit.level)
        wide = beside.widened(fit.curve, fit.best, fit.level) or beside
        evidence += log_density(point) + log_width(wide, [point], [second])
        fits = {
            point.curve.effect: fits.get(point.curve.effect, _as_fit(point)),
            other: replace(fit, curve=second.curve),
        }
        if best is not None and evidence < best.log_evidence + _SETTLED:
            break
        best = Pair(log_evidence=evidence, fits=fits)
        point, other = second, point.curve.effect
    if best is None:
        raise ValueError("no turn was taken")
    return best


def _own(curves: Sequence[Curve], fit: CurveFit) -> Curve:
    """The curve of a fit, in the units before any effect is taken off."""
    return next(curve for curve in curves if curve.variant == fit.curve.variant)


def _as_fit(point: Point) -> CurveFit:
    """Of an effect that has not been fitted beside another."""
    return CurveFit(
        curve=point.curve,
        by_level=np.zeros(1),
        log_evidence=0.0,
        level=point.level,
        strengths=point.strength * np.array([0.999, 1.0, 1.001]),
        log_likelihood=np.zeros(3),
    )


def _beside(beside: Observed, curves: Sequence[Curve]) -> CurveFit:
    """The best of an effect's variants beside another, its evidence that of all variants."""
    first = [
        (fit_curve(beside, beside.scaled(curve), exact=True).log_evidence, number)
        for number, curve in enumerate(curves)
    ]
    likely = sorted(first, reverse=True)[:_VARIANTS]
    fits = [fit_curve(beside, beside.scaled(curves[number]), levels=_CARRIED) for _, number in likely]
    best = max(fits, key=lambda fit: fit.log_evidence)
    total = float(np.logaddexp.reduce([fit.log_evidence for fit in fits])) - math.log(len(curves))
    return replace(best, log_evidence=total)


def left_by_the_stronger(observed: Observed, pair: Pair) -> tuple[str, float]:
    """Which of two moves the probes more, and the log density of what its law leaves in the other's shape over that of the other.

    With that in place of the other's density the pair's evidence is that of the stronger one alone, off by so much.
    """
    points = {effect: fit.point for effect, fit in pair.fits.items()}
    lengths = {effect: observed.length(point.curve, point.strength) for effect, point in points.items()}
    strong, weak = sorted(lengths, key=lambda effect: -lengths[effect])
    ratio = lengths[weak] / max(lengths[strong], 1e-12)
    fit = pair.fits[strong]
    levels, frequencies = LEVELS.levels[: len(fit.by_level)], LEVELS.of_kind[: len(fit.by_level)]
    if len(fit.by_level) < 2:
        leaves = log_leak(ratio, fit.level)
    else:
        shares = np.log(frequencies) + fit.by_level
        shares -= np.logaddexp.reduce(shares)
        leaves = float(
            np.logaddexp.reduce([share + log_leak(ratio, level) for share, level in zip(shares, levels, strict=True)])
        )
    return strong, leaves - log_density(replace(points[weak], level=0.0)) + math.log(LEVELS.of_kind[0])


def log_density(point: Point, *, another: bool = False) -> float:
    """Log of a level's frequency (of laws of the kind, or of `another`) times the density of a strength's logarithm, even in it."""
    curve, log = point.curve, math.log
    frequencies = LEVELS.of_another if another else LEVELS.of_kind
    level = frequencies[int(np.argmin(np.abs(np.array(LEVELS.levels) - point.level)))]
    if curve.low <= point.strength <= curve.high:
        density = (1.0 - IMPLAUSIBLE) / log(curve.high / curve.low)
    else:
        low, high = curve.reach
        density = IMPLAUSIBLE / (log(high / low) - log(curve.high / curve.low))
    return log(level) + log(density)


def log_width(beside: Observed, points: Sequence[Point], free: Sequence[Point] = ()) -> float:
    """Log of the integral over the logarithms of strengths about `points`, as a Gaussian's, in what is left beside them.

    free: points whose strengths take what they can first. No strength counts for more than all that are tried.
    """
    both = [*points, *free]
    rows = np.stack([slope(point.curve, point.strength) for point in both]) / beside.units
    gram = beside.nuisances.inner(rows, rows)
    count, total = len(points), 0.0
    for number, point in enumerate(points):
        # what the strengths before this one, and the free ones, leave of it
        others = [*range(number), *range(count, len(both))]
        own = float(gram[number, number])
        if others:
            across = gram[number, others]
            own -= float(across @ np.linalg.solve(gram[np.ix_(others, others)] + 1e-9 * np.eye(len(others)), across))
        low, high = point.curve.reach
        total += min(0.5 * math.log(2.0 * math.pi / max(own, 1e-12)), math.log(math.log(high / low)))
    return total

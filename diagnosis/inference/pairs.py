"""Two effects at once, each brought to what the other leaves, in turn, until neither moves.

The evidence is the chain rule's: of the first at its strength (its uncertainty as a Gaussian's), times that of the second in what
the first leaves. Which of two is the first makes no difference where both have settled.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...generator.effects import EFFECTS
from ..arrays import FloatArray, IndexArray
from ..model.curves import Curve
from .curve_fits import IN_FULL, CurveFit, first_looks, fit_curve, log_integral, log_mean_exp, refined
from .discrepancy import FARTHEST_LEVEL, LEVELS, at_most_off, leak_below, leak_density, log_frequency, only
from .observed import Observed, Point

_TURNS, _SETTLED = 6, 0.1  # in which two settle, and gain of log evidence that ends them
_CARRIED = LEVELS.up_to(FARTHEST_LEVEL)
_VARIANTS = 2  # of an effect beside another, the likeliest at first sight, that are fitted with all levels


@dataclass(frozen=True, slots=True, kw_only=True)
class Single:
    """One effect against the probes: fits of its variants, the best of them, log evidence over none (variants averaged)."""

    fits: Sequence[CurveFit]
    best: CurveFit
    log_evidence: float

    @staticmethod
    def of(fits: Sequence[CurveFit]) -> "Single":
        """From the fits of all its variants."""
        best = max(fits, key=lambda fit: fit.log_evidence)
        mean = log_mean_exp([fit.log_evidence for fit in fits])
        return Single(fits=fits, best=replace(best, share=mean - best.log_evidence), log_evidence=mean)


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


def weigh_pairs(
    observed: Observed, singles: Mapping[str, Single], *, leading: int, beside: Sequence[Curve] = ()
) -> list[Pair]:
    """The `leading` effects that explain most, each with every other one: those that are likely at first sight.

    Of each of them the pair with its best companion is among these, and so is the pair that explains most if all laws are exact.
    beside: curves of effects as they respond beside another.
    """
    if len(singles) < 2:
        return []

    def curves(effect: str, other: str) -> list[Curve]:
        of_effect = [curve for curve in beside if curve.effect == effect]
        own = [fit.curve for fit in singles[effect].fits]
        return own + [one for one in of_effect if one.variant.beside is not None and one.variant.beside.id == other]

    ranked = sorted(singles, key=lambda effect: -singles[effect].log_evidence)
    seen: dict[tuple[str, str], tuple[float, Point, str]] = {}
    for first in ranked[:leading]:
        best = singles[first].best
        point = best.at_level(min(best.level, FARTHEST_LEVEL))
        for second, evidence in _at_first_sight(observed, point, [one for one in singles if one != first], curves):
            a, b = sorted((first, second))
            if (a, b) not in seen or evidence > seen[a, b][0]:
                seen[a, b] = evidence, point, second
    likely = sorted(seen.values(), key=lambda item: -item[0])
    # each of the leading effects with its best companion: what one's law leaves is asked of all of them
    companions: dict[str, tuple[float, Point, str]] = {}
    for item in likely:
        companions.setdefault(item[1].effect, item)
    taken = likely[:IN_FULL]  # with ten the same are named (notebook, ablation)
    taken += [item for item in companions.values() if not any(item is one for one in taken)]
    starts = [(singles[point.effect].best, point, other) for _, point, other in taken]
    start = _together_exactly(observed, singles)
    if start is not None and {start[1].effect, start[2]} not in [{at.effect, other} for _, at, other in starts]:
        starts.append(start)
    return [
        _settled(observed, fit, at, {at.effect: curves(at.effect, other), other: curves(other, at.effect)}, other)
        for fit, at, other in starts
    ]


def _together_exactly(observed: Observed, singles: Mapping[str, Single]) -> tuple[CurveFit, Point, str] | None:
    """The two effects that explain most together if their laws are exact: fit and place of the one that explains more, and the other.

    Alone, each counts what the other does as its law's error. Responses are taken as straight in the strength.
    """
    fits = [
        fit
        for effect, single in singles.items()
        if not observed.has(effect)
        for fit in single.fits
        if not fit.curve.by_chance_alone
    ]
    alone = observed.conditioned()
    moved = np.stack([alone.residual, *(alone.scaled(fit.curve).response(fit.best) for fit in fits)])
    inner = alone.nuisances.inner(moved, moved)
    asked, gram = inner[0, 1:], inner[1:, 1:]
    own = np.maximum(np.diag(gram), 1e-12)
    free = np.maximum(np.outer(own, own) - gram**2, 1e-9 * np.outer(own, own))
    # how many times its strength each has beside another
    times = (own[None, :] * asked[:, None] - gram * asked[None, :]) / free
    effects = np.array([fit.curve.effect for fit in fits])
    apart = (effects[:, None] != effects[None, :]) & (times > 0.0) & (times.T > 0.0)
    if not np.any(apart):
        return None
    explained = asked[:, None] * times
    both = np.where(apart, explained + explained.T, -np.inf)
    first, second = np.unravel_index(int(np.argmax(both)), both.shape)
    if explained[second, first] > explained[first, second]:
        first, second = second, first
    fit = fits[first]
    strength = float(np.clip(times[first, second] * fit.best, fit.strengths[0], fit.strengths[-1]))
    return fit, Point(curve=fit.curve, strength=strength, level=0.0, share=fit.share), str(effects[second])


def _at_first_sight(
    observed: Observed, point: Point, others: Sequence[str], curves: Callable[[str, str], Sequence[Curve]]
) -> Iterator[tuple[str, float]]:
    """Every other effect with the log evidence over none of it beside a first one at its point, the priors aside."""
    first = point.effect
    together = [[other for other in others if not observed.has(other)], *([one] for one in others if observed.has(one))]
    for effects in filter(None, together):
        start, left = _beside_first(observed, point, effects[0])
        looks = first_looks(left, [curve for other in effects for curve in curves(other, first)])
        for other in effects:
            yield other, start + max(fit.log_evidence for fit in looks if fit.curve.effect == other)


def _settled(
    observed: Observed, first: CurveFit, point: Point, curves: Mapping[str, Sequence[Curve]], other: str
) -> Pair:
    """Two effects by turns: `other` beside a first one at its point, then the first beside the other; the likeliest turn."""
    best, fits = -math.inf, {}
    at = replace(first, level=point.level)
    start, beside = _beside_first(observed, point, other)
    for turn in range(_TURNS):
        second = _beside(beside, curves[other])
        start_second, beside_second = _beside_first(observed, second.point, point.effect)
        evidence, before = start + log_prior(beside_second, point) + second.log_evidence, best
        if evidence > best:
            best, fits = evidence, {point.effect: at, other: second}
        if turn and evidence < before + _SETTLED:
            break
        at, point, other = second, second.point, point.effect
        start, beside = start_second, beside_second
    return Pair(log_evidence=best, fits=fits)


def _beside_first(observed: Observed, point: Point, other: str) -> tuple[float, Observed]:
    """What a first effect leaves to another, and its log evidence over none without the prior; neither is there by the twin."""
    both = (point.effect, other)
    alone = observed.conditioned(*both)
    beside = alone.in_presence_of(point)
    return observed.log_evidence_without(*both) + beside.log_likelihood - alone.log_likelihood, beside


def _beside(beside: Observed, curves: Sequence[Curve]) -> CurveFit:
    """The best of an effect's variants beside another, its evidence that of all variants."""
    likely = sorted(first_looks(beside, curves), key=lambda fit: -fit.log_evidence)[:_VARIANTS]
    fits = [fit_curve(beside, fit.curve, levels=_CARRIED) for fit in likely]
    best = max(fits, key=lambda fit: fit.log_evidence)
    total = float(np.logaddexp.reduce([fit.log_evidence for fit in fits])) - math.log(len(curves))
    return replace(best, log_evidence=total, share=total - best.log_evidence)


def may_leave(effect: str, other: str) -> bool:
    """Whether an effect's law, off as it may be, can leave another's shape, as far as the catalogue knows both."""
    known, left = EFFECTS.get(effect), EFFECTS.get(other)
    return known is None or left is None or known.may_leave(left)


def log_odds_of_leak(observed: Observed, pair: Pair, *, also_off: float = 0.0) -> tuple[str, float]:
    """Which of two moves the probes more, and how much likelier its law's leaving the other's shape is than that effect: log of it.

    also_off: what laws leave elsewhere, a misfit, over what they do: they may be off by as much here.

    Minus infinity where its law cannot. The likelihood of the weaker one's strength is integrated over what such a law leaves in
    place of that effect's prior. Of that shape a steady law leaves what is steady.
    """
    weak, strong = sorted(
        pair.fits, key=lambda effect: observed.length(pair.fits[effect].curve, pair.fits[effect].best)
    )
    if not may_leave(strong, weak):
        return strong, -math.inf
    first, second = pair.fits[strong], pair.fits[weak]
    left = second
    courses = first.curve.variant.course, second.curve.variant.course
    if courses[0] == "steady" != courses[1] and observed.steady is not None:
        _, beside = _beside_first(observed, first.point, weak)
        second, left = (
            fit_curve(beside, curve, levels=only(second.level))
            for curve in (second.curve, observed.steady.of(second.curve))
        )
    shares = np.log(LEVELS.of_kind[: len(first.by_level)]) + first.by_level
    shares = np.exp(shares - np.logaddexp.reduce(shares))
    levels = [max(at_most_off(level), also_off) for level in LEVELS.levels]
    acting = observed.acting([first.point])
    return strong, log_odds_of_leak_in(observed, second, acting, list(zip(shares, levels, strict=False)), shape=left)


def log_odds_of_leak_in(
    observed: Observed,
    second: CurveFit,
    acting: tuple[IndexArray, FloatArray],
    levels: Sequence[tuple[float, float]],
    *,
    shape: CurveFit | None = None,
) -> float:
    """How much likelier it is that a law leaves an effect's shape than that the effect is there: log of it.

    second: the effect's fit beside that law; acting: parts of the session (probe,), in each of which the law leaves a share, and
    how far it moves each, squared standard deviations (part,); levels: by which it is off, each after its probability; shape: the fit
    of what such a law could leave of the effect's shape, None: all of it.
    """
    shape = second if shape is None else shape
    parts, squares = acting
    own = observed.power_by_part(shape.curve, second.best, parts)
    # of what it would have to leave in a part over what it does there, as much as the effect shows there; a part that a law does not
    # move is left as it is to a standard deviation
    ratio = max(math.sqrt(float(np.sum(own**2 / (squares + 1.0))) / max(float(np.sum(own)), 1e-12)), 1e-12)
    ratios = ratio * shape.strengths / second.best
    least = ratio / max(observed.length(shape.curve, second.best), 1.0)  # a standard deviation
    density = sum(share * leak_density(ratios, level, least) for share, level in levels)
    low = sum(share * leak_below(float(ratios[0]), level, least) for share, level in levels)
    top = float(shape.log_likelihood.max())
    likelihood = np.exp(shape.log_likelihood - top)
    left = float(np.trapezoid(likelihood * density, np.log(shape.strengths))) + float(likelihood[0]) * low
    there = log_integral(second.strengths, second.log_likelihood, second.curve.variant.low, second.curve.variant.high)
    return top + math.log(max(left, 1e-300)) - there


def log_prior(observed: Observed, point: Point, *, another: bool = False, any_strength: bool = False) -> float:
    """Log of what a point takes of the prior: its curve's, how often laws (of `another` kind) are off by its level, its strengths'.

    Strengths are even in their logarithm. The Gaussian that `Observed.in_presence_of` frees them by is no prior: what it gives is
    subtracted, and the integral over the reach put in its place. About a point, where the likelihood is highest, that falls to both
    sides, but at an end of the reach. observed: without this effect; any_strength: none that is tried is more plausible.
    """
    curve, variant = point.curve, point.curve.variant
    slope, curvature = observed.score_and_information(point)
    width = 1.0 / (curvature + point.strength_sd**-2)
    free = 0.5 * (slope**2 * width + math.log(width / point.strength_sd**2))
    strengths = refined(curve.log_strengths(), point.strength, math.sqrt(width))
    x = strengths / point.strength - 1.0  # responses are nearly straight in the strength
    pull = 0.0 if strengths[0] < point.strength < strengths[-1] else slope
    within = log_integral(
        strengths, pull * x - 0.5 * curvature * x**2, *(curve.reach if any_strength else (variant.low, variant.high))
    )
    return variant.log_prior + point.share + log_frequency(point.level, another=another) + within - free

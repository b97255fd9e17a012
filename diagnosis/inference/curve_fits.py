"""Evidence of one effect with its inner parameters fixed, its strength integrated out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from ...generator.line.twin import Z95
from ..arrays import FloatArray
from ..model.curves import Curve, places_of
from .discrepancy import LEAST_MOVED, LEVELS, Levels, only
from .observed import Observed, Point

_ROUNDS, _SETTLED = 4, 0.05  # in which a level's best strength is found, and change of its logarithm that ends them
# variants of an effect, effects, and pairs, the likeliest at first sight, that are weighed in full, at least
IN_FULL = 3
_CLOSE = math.log(100.0)  # of log evidence: what is less likely than that changes a mean by less than one per cent
_WEAK = 0.3  # of the best strength
IMPLAUSIBLE = 0.01  # probability that an effect is weaker or stronger than its plausible range
_REACHES = (0.05, 0.01, 0.002, 0.0004, 0.0)  # least relative widths about which finer strengths are set, round by round


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveFit:
    """One curve against a residual."""

    curve: Curve
    by_level: FloatArray  # (level,): log evidence over none with the law off by each level
    at_any_strength: FloatArray  # (level,): the same with a prior of the strength that is even over all its reach
    log_evidence: float  # by_level averaged over the levels' frequencies
    level: float  # the likeliest
    strengths: FloatArray  # (node,)
    log_likelihood: FloatArray  # (node,) over none at that level
    share: float = 0.0  # as of a `Point`

    @property
    def best(self) -> float:
        """Strength of the highest likelihood."""
        return float(self.strengths[int(np.argmax(self.log_likelihood))])

    @property
    def point(self) -> Point:
        """Where the likelihood is highest."""
        return self.at_level(self.level)

    def at_level(self, level: float) -> Point:
        """Where the likelihood is highest, the law off by another level."""
        return Point(curve=self.curve, strength=self.best, level=level, share=self.share)

    def of_another(self, *, any_strength: bool) -> float:
        """Log evidence over none of an effect that is only like the curve's, of any strength or one that is plausible for it."""
        return _over_levels(self.at_any_strength if any_strength else self.by_level, LEVELS.of_another)


def _over_levels(by_level: FloatArray, frequencies: Sequence[float]) -> float:
    return float(logsumexp(by_level, b=np.asarray(frequencies[: len(by_level)])))


def fit_curve(observed: Observed, curve: Curve, *, levels: Levels = LEVELS) -> CurveFit:
    """Evidence of one curve, in the units of the first probes, over none, its strength integrated out, see `log_integral`.

    What an effect does by chance grows with its strength; at each level the covariance is that of the law at its best strength, found
    in rounds.
    """
    scaled = observed.scaled(curve)
    (sharp,) = _Terms.of_each(observed, [scaled])
    exact = sharp.closed_in()
    found = [_off_by(observed, scaled, exact, level, sharp) or exact for level in levels.levels]
    return _fit_of(curve, found, levels)


def first_looks(observed: Observed, curves: Sequence[Curve]) -> list[CurveFit]:
    """The same of several curves with their laws taken as exact, at a fraction of the cost."""
    terms = _Terms.of_each(observed, [observed.scaled(curve) for curve in curves])
    return [_fit_of(curve, [own.closed_in()], only(0.0)) for curve, own in zip(curves, terms, strict=True)]


def _fit_of(curve: Curve, found: Sequence["_Likelihood"], levels: Levels) -> CurveFit:
    """A fit from the likelihood at each level."""
    own = curve.variant
    by_level = np.array([item.log_evidence(own.low, own.high) for item in found])
    with np.errstate(divide="ignore"):
        likeliest = int(np.argmax(by_level + np.log(np.asarray(levels.of_kind))))
    return CurveFit(
        curve=curve,
        by_level=by_level + own.log_prior,
        at_any_strength=np.array([item.log_evidence(*curve.reach) for item in found]) + own.log_prior,
        log_evidence=_over_levels(by_level, levels.of_kind) + own.log_prior,
        level=levels.levels[likeliest],
        strengths=found[likeliest].strengths,
        log_likelihood=found[likeliest].values,
    )


def _over_given(observed: Observed, fit: CurveFit) -> CurveFit:
    """A fit where the twin has all its effects but this one, its evidence over all that it has."""
    more = observed.log_evidence_without(fit.curve.effect)
    return replace(
        fit,
        by_level=fit.by_level + more,
        at_any_strength=fit.at_any_strength + more,
        log_evidence=fit.log_evidence + more,
    )


def fit_effects(observed: Observed, curves: Sequence[Curve]) -> list[CurveFit]:
    """Every curve fitted: with all levels of discrepancy those variants of an effect that are likeliest, or close to it, if exact."""
    # where the twin has all its effects but each curve's own
    others = iter(first_looks(observed.conditioned(), [curve for curve in curves if not observed.has(curve.effect)]))
    found = [
        _over_given(observed, first_looks(observed.conditioned(curve.effect), [curve])[0])
        if observed.has(curve.effect)
        else next(others)
        for curve in curves
    ]
    ranked: dict[str, list[int]] = {}
    for number in sorted(range(len(curves)), key=lambda number: -found[number].log_evidence):
        ranked.setdefault(curves[number].effect, []).append(number)
    for numbers in ranked.values():
        least = found[numbers[0]].log_evidence - _CLOSE
        close = max(IN_FULL, sum(found[number].log_evidence > least for number in numbers))
        for number in numbers[:close]:
            curve = curves[number]
            found[number] = _over_given(observed, fit_curve(observed.conditioned(curve.effect), curve))
        for number in numbers[close:]:
            # of the others no more is counted than an exact law's part, as often as laws are exact
            exact = found[number].log_evidence + math.log(LEVELS.of_kind[0])
            found[number] = replace(found[number], log_evidence=exact)
    return found


@dataclass(frozen=True, slots=True)
class _Likelihood:
    """Log likelihood over none (node,) of a curve at strengths (node,)."""

    strengths: FloatArray
    values: FloatArray

    def log_evidence(self, low: float, high: float) -> float:
        """Under a prior of a strength that is plausible from low to high."""
        return log_integral(self.strengths, self.values, low, high)

    @property
    def best(self) -> float:
        """Strength where it is highest."""
        return float(self.strengths[int(np.argmax(self.values))])


class _Terms:
    """Log likelihood over none of a curve at any strength: r ~ N(m(s), C + s^2 S S^T), S what it does by chance, C all else.

    With S^T C^-1 S = V D V^T and c = V^T S^T C^-1 (r - m) it is that of N(m, C) and
    1/2 sum c_i^2 s^2 / (1 + s^2 d_i) - 1/2 sum log(1 + s^2 d_i).
    """

    @classmethod
    def of_each(cls, observed: Observed, curves: Sequence[Curve]) -> "list[_Terms]":
        """Those of several curves, in the units of what is weighed."""
        parts = [np.concatenate([curve.responses, _chance_of(curve)]) for curve in curves]
        vectors = np.concatenate([observed.residual[None, :], *parts])
        taken_up = observed.nuisances.project(vectors)
        found = []
        for curve, place in zip(curves, places_of([vectors[:1], *parts])[1:], strict=True):
            own, left = vectors[place], taken_up[place]
            of_residual = own @ vectors[0] - left @ taken_up[0]
            found.append(cls(curve, own @ own.T - left @ left.T, of_residual))
        return found

    def __init__(self, curve: Curve, inner: FloatArray, of_residual: FloatArray) -> None:
        """Of the curve's responses, and what it does by chance after them: a C^-1 b, and a C^-1 r."""
        self._curve = curve
        nodes = len(curve.responses)
        self._linear, self._gram = of_residual[:nodes], inner[:nodes, :nodes]
        self._values, vectors = np.linalg.eigh(inner[nodes:, nodes:])
        self._values = np.maximum(self._values, 0.0)
        self._of_nodes, self._of_residual = inner[:nodes, nodes:] @ vectors, of_residual[nodes:] @ vectors

    def at(self, strengths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log likelihood over none, and squared length of the response, at strengths."""
        weights = self._curve.weights(strengths)
        quadratic = np.einsum("si,ij,sj->s", weights, self._gram, weights)
        value = weights @ self._linear - 0.5 * quadratic
        if len(self._values):
            grown = np.multiply.outer(strengths**2, self._values)
            taken = strengths[:, None] ** 2 / (1.0 + grown)
            response = weights @ self._of_nodes
            value += 0.5 * np.sum(taken * (self._of_residual - response) ** 2 - np.log1p(grown), axis=1)
            quadratic = quadratic - np.sum(taken * response**2, axis=1)
        return value, np.maximum(quadratic, 0.0)

    def closed_in(self) -> _Likelihood:
        """At strengths of the whole reach: a peak sharper than these lie apart is closed in on."""
        coarse = strengths = self._curve.log_strengths()
        value, quadratic = self.at(strengths)
        for reach in _REACHES:
            at = int(np.argmax(value))
            width = max(1.0 / math.sqrt(max(float(quadratic[at]), 1e-6)), reach)
            strengths = refined(coarse, float(strengths[at]), width)
            value, quadratic = self.at(strengths)
        return _Likelihood(strengths, value)


def _off_by(observed: Observed, curve: Curve, exact: _Likelihood, level: float, sharp: _Terms) -> _Likelihood | None:
    """Log likelihood over none with the law off by a level; None: that moves nothing."""
    best, found = exact.best, None
    for _ in range(_ROUNDS):
        wide = observed.widened(curve, best, level, chance=False)
        if wide is None:
            break
        (terms,) = _Terms.of_each(wide, [curve.over(wide.units / observed.units)])
        own = terms.closed_in()
        value = own.values + wide.log_likelihood - observed.log_likelihood
        # weak strengths keep the sharp covariance: there the law's inaccuracy does nothing
        weak = own.strengths < _WEAK * best
        found = _Likelihood(own.strengths, np.where(weak, sharp.at(own.strengths)[0], value))
        before, best = best, found.best
        if abs(math.log(best / before)) < _SETTLED:
            break
    return found


def _chance_of(curve: Curve) -> FloatArray:
    """What a curve does by chance a unit of strength (factor, probe); what moves nothing that shows is left out."""
    shows = np.max(np.abs(curve.chance), axis=0, initial=0.0) * curve.reach[1] >= LEAST_MOVED
    return np.asarray(curve.chance[:, shows].T)


def refined(strengths: FloatArray, best: float, width: float) -> FloatArray:
    """Nodes with a finer set about `best`, 6 relative widths to each side."""
    span = np.linspace(-6.0, 6.0, 49) * min(max(width, 1e-6), 0.5)
    near = best * np.exp(span)
    return np.unique(np.concatenate([strengths, near[(near >= strengths[0]) & (near <= strengths[-1])]]))


def log_integral(strengths: FloatArray, log_likelihood: FloatArray, low: float, high: float) -> float:
    """log of the mean likelihood under a prior that is even in the logarithm of the strength.

    Most of it from low to high, IMPLAUSIBLE beyond: a line may be better, or worse, than the catalogue takes for plausible.
    """
    x = np.log(strengths)
    inside = (strengths >= 0.999999 * low) & (strengths <= 1.000001 * high)
    widths = np.diff(x)
    plausible = inside[:-1] & inside[1:]
    top = float(log_likelihood.max())
    areas = 0.5 * (np.exp(log_likelihood[:-1] - top) + np.exp(log_likelihood[1:] - top)) * widths
    total = 0.0
    for part, share in ((plausible, 1.0 - IMPLAUSIBLE), (~plausible, IMPLAUSIBLE)):
        total += share * float(areas[part].sum()) / max(float(widths[part].sum()), 1e-12)
    return top + math.log(max(total, 1e-300))


def interval_of(fits: Sequence[CurveFit]) -> tuple[float, float, float]:
    """Posterior median and 95 % bounds of a strength, its inner parameters' variants weighed by their evidence.

    Each has the shape of its likelihood at the level by which its law is likeliest to be off.
    """
    top = max(fit.log_evidence for fit in fits)
    likely = [fit for fit in fits if fit.log_evidence >= top - 12.0]
    nodes = np.unique(np.concatenate([fit.strengths for fit in likely]))
    total = np.full(len(nodes), -np.inf)
    for fit in likely:
        value = np.interp(np.log(nodes), np.log(fit.strengths), fit.log_likelihood, left=-np.inf, right=-np.inf)
        variant = fit.curve.variant
        at_level = log_integral(fit.strengths, fit.log_likelihood, variant.low, variant.high)
        total = np.logaddexp(total, value + fit.log_evidence - at_level)
    return interval_under(nodes, total)


def interval_under(strengths: FloatArray, log_likelihood: FloatArray) -> tuple[float, float, float]:
    x = np.log(strengths)
    density = np.exp(log_likelihood - log_likelihood.max())
    cumulated = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(x))])
    low, middle, high = np.interp([0.025, 0.5, 0.975], cumulated / cumulated[-1], x)
    return math.exp(middle), math.exp(low), math.exp(high)


def interval_of_any(
    intervals: Sequence[tuple[float, float, float]], shares: Sequence[float] | FloatArray
) -> tuple[float, float, float]:
    """The first's value, and 95 % bounds over all: each a Gaussian in the logarithm on either side of its median.

    intervals: value and 95 % bounds; shares: probabilities, in any unit.
    """
    from scipy.optimize import brentq
    from scipy.special import ndtr

    values, lows, highs = np.log(np.asarray(intervals)).T
    weights = np.asarray(shares) / np.sum(shares)
    below, above = (np.maximum(side / Z95, 1e-9) for side in (values - lows, highs - values))

    def beyond(x: float, probability: float) -> float:
        return float(weights @ ndtr((x - values) / np.where(x < values, below, above))) - probability

    ends = float(lows.min()) - 1e-6, float(highs.max()) + 1e-6
    low, high = (math.exp(brentq(beyond, *ends, args=(probability,))) for probability in (0.025, 0.975))
    return intervals[0][0], low, high


def log_mean_exp(values: Sequence[float]) -> float:
    """Log of the mean of what has these logarithms."""
    return float(logsumexp(values)) - math.log(len(values))

"""Evidence of one effect with its inner parameters fixed, its strength integrated out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .curves import Curve
from .inexact_laws import LAW_ERRORS, LEAST_FACTOR, credible, law_factors, own_variance, with_law
from .nuisances import Nuisances

_CHANCE_NODES = 161
IMPLAUSIBLE = 0.01  # probability that an effect is weaker or stronger than its plausible range
_REACHES = (0.05, 0.01, 0.002, 0.0004, 0.0)  # least relative widths about which finer strengths are set, round by round


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveFit:
    """One curve against the residual: log evidence over none, likelihood over strength nodes, the separation from none.

    separation is the length of the response at the best strength once the nuisances have taken their part, in standard
    deviations.
    """

    curve: Curve
    log_evidence: float
    strengths: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    separation: float

    @property
    def best(self) -> float:
        """Strength of the highest likelihood."""
        return float(self.strengths[int(np.argmax(self.log_likelihood))])


def fit_curve(
    residual: NDArray[np.float64],
    curve: Curve,
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    *,
    places: NDArray[np.intp] | None = None,
    law_errors: Sequence[tuple[float, float]] = LAW_ERRORS,
) -> CurveFit:
    """Evidence of one curve over none, its strength integrated over a log-uniform prior, see `_log_integral`.

    The law's inaccuracy is a random factor a group and a part of each probe's own, both in proportion to what the
    nuisances leave of the response at the best strength (found in rounds) and to what is seen in each of `places` (groups
    where absent).
    """
    places = groups if places is None else places
    if curve.by_chance_alone:
        return _fit_chance(residual, curve, nuisances)
    nodes = curve.responses
    solved = nuisances.solve_all(nodes)
    seen = nuisances.solve(residual)

    def terms(
        model: Nuisances, rows: NDArray[np.float64], vector: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return model.inner(rows, vector[None, :])[:, 0], model.inner(rows, rows)

    def likelihood(
        strengths: NDArray[np.float64], model: tuple[NDArray[np.float64], NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        weights = curve.weights(strengths)
        quadratic = np.einsum("si,ij,sj->s", weights, model[1], weights)
        return weights @ model[0] - 0.5 * quadratic, quadratic

    sharp = terms(nuisances, nodes, residual)
    coarse = curve.log_strengths()
    strengths = coarse
    value, quadratic = likelihood(strengths, sharp)
    at = int(np.argmax(value))
    for reach in _REACHES:  # a peak sharper than the nodes lie apart is closed in on
        width = max(1.0 / math.sqrt(max(float(quadratic[at]), 1e-6)), reach)
        strengths = _refined(coarse, float(strengths[at]), width)
        value, quadratic = likelihood(strengths, sharp)
        at = int(np.argmax(value))
    choices = [(strengths, value, math.sqrt(max(float(quadratic[at]), 0.0)))]
    start = float(strengths[at])
    for law_error, share in law_errors:
        best = start
        for _ in range(3):
            effective = credible(curve.weights(np.array([best]))[0] @ solved, seen, places)
            extra = law_factors(curve, best, effective, groups, law_error)
            own = own_variance(curve, best, effective, law_error)
            if not extra and float(own.max()) < LEAST_FACTOR:
                break
            # evidence over none: the residual's own terms change with the covariance
            moved, moved_nodes, wide, shift = with_law(residual, nodes, nuisances, extra, own)
            wide_terms = terms(wide, moved_nodes, moved)
            value, quadratic = likelihood(coarse, wide_terms)
            width = 1.0 / math.sqrt(max(float(quadratic[int(np.argmax(value))]), 1e-6))
            strengths = _refined(coarse, float(coarse[int(np.argmax(value))]), max(width, 0.3 * law_error))
            value, quadratic = likelihood(strengths, wide_terms)
            value = value + shift + math.log(share)
            # weak strengths keep the sharp covariance: there the law's inaccuracy does nothing
            weak = strengths < 0.3 * best
            value = np.where(weak, likelihood(strengths, sharp)[0], value)
            at = int(np.argmax(value))
            choices.append((strengths, value, math.sqrt(max(float(quadratic[at]), 0.0))))
            moved_on = abs(math.log(float(strengths[at]) / best))
            best = float(strengths[at])
            if moved_on < 0.05:
                break
    strengths, value, separation = max(choices, key=lambda item: float(item[1].max()))
    return CurveFit(
        curve=curve,
        log_evidence=_log_integral(strengths, value, curve.low, curve.high),
        strengths=strengths,
        log_likelihood=value,
        separation=separation,
    )


def _fit_chance(residual: NDArray[np.float64], curve: Curve, nuisances: Nuisances) -> CurveFit:
    """Evidence over none of a curve that moves probes by chance alone: r ~ N(0, C + s^2 S S^T), S its spread.

    With S^T C^-1 S = V D V^T and c = V^T S^T C^-1 r the log likelihood ratio is
    1/2 sum c_i^2 s^2 / (1 + s^2 d_i) - 1/2 sum log(1 + s^2 d_i).
    """
    if curve.spread is None:
        raise ValueError(f"curve {curve.effect} {curve.variant} moves nothing")
    spread = curve.spread.T
    values, vectors = np.linalg.eigh(nuisances.inner(spread, spread))
    along = vectors.T @ nuisances.inner(spread, residual[None, :])[:, 0]
    strengths = curve.log_strengths(_CHANCE_NODES)
    grown = np.multiply.outer(strengths**2, np.maximum(values, 0.0))
    quadratic = np.sum(along**2 * strengths[:, None] ** 2 / (1.0 + grown), axis=1)
    likelihood = 0.5 * (quadratic - np.sum(np.log1p(grown), axis=1))
    return CurveFit(
        curve=curve,
        log_evidence=_log_integral(strengths, likelihood, curve.low, curve.high),
        strengths=strengths,
        log_likelihood=likelihood,
        separation=math.sqrt(2.0 * max(float(likelihood.max()), 0.0)),
    )


def _refined(strengths: NDArray[np.float64], best: float, width: float) -> NDArray[np.float64]:
    """Nodes with a finer set about `best`, 6 relative widths to each side."""
    span = np.linspace(-6.0, 6.0, 49) * min(max(width, 1e-6), 0.5)
    near = best * np.exp(span)
    return np.unique(np.concatenate([strengths, near[(near >= strengths[0]) & (near <= strengths[-1])]]))


def _log_integral(
    strengths: NDArray[np.float64], log_likelihood: NDArray[np.float64], low: float, high: float
) -> float:
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
    """Posterior median and 95 % bounds of a strength, its inner parameters' variants weighed by their evidence."""
    top = max(fit.log_evidence for fit in fits)
    likely = [fit for fit in fits if fit.log_evidence > top - 12.0]
    nodes = np.unique(np.concatenate([fit.strengths for fit in likely]))
    total = np.full(len(nodes), -np.inf)
    for fit in likely:
        value = np.interp(np.log(nodes), np.log(fit.strengths), fit.log_likelihood, left=-np.inf, right=-np.inf)
        total = np.logaddexp(total, value)
    return interval_under(nodes, total)


def interval_under(strengths: NDArray[np.float64], log_likelihood: NDArray[np.float64]) -> tuple[float, float, float]:
    x = np.log(strengths)
    density = np.exp(log_likelihood - log_likelihood.max())
    cumulated = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(x))])
    low, middle, high = np.interp([0.025, 0.5, 0.975], cumulated / cumulated[-1], x)
    return math.exp(middle), math.exp(low), math.exp(high)


def log_mean_exp(values: NDArray[np.float64], axis: int | tuple[int, ...] | None = None) -> Any:
    top = np.max(values, axis=axis, keepdims=True)
    mean = np.log(np.mean(np.exp(values - top), axis=axis, keepdims=True)) + top
    return mean.item() if axis is None else np.squeeze(mean, axis=axis)

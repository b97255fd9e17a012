"""Which hypothesis explains a vector of probes: none, one effect, two, or something that is not in the catalogue.

Probes are residuals r (probe,) against the twin, in units of their own standard deviations. Nuisance parameters are
integrated out exactly (they are linear with Gaussian priors): r ~ N(m, C), C = I + F F^T, F (probe, factor) the
responses to the nuisances times their prior standard deviations. With C = L L^T only projections are needed.

    none      m = 0
    effect    m = m_e(s), s the strength, log-uniform over its plausible range, the law's own inaccuracy a random factor
              (LAW_ERRORS) for each group of probes; what the effect does by chance is extra covariance
    pair      m = m_e(s) + m_f(t)
    unknown   m = 0 and an extra variance tau^2 in any number of families of probes, tau log-uniform, at a price for each

Evidence of each is integrated numerically over strengths; a hypothesis' probability is prior x evidence, raised to a
power below 1 where tests on simulated sessions showed overconfidence.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

# relative errors of an effect's law and how probable each is: real effects follow the catalogue's laws more or less well
LAW_ERRORS: tuple[tuple[float, float], ...] = ((0.10, 0.7), (0.30, 0.3))
LAW_PROBE_SHARE = 0.5  # of the law's error that is each probe's own
EXACT_LAW_ERROR = 0.03  # relative error of probes that a strength is defined by
STRENGTH_NODES = 25
_PAIR_NODES = 13
_CHANCE_NODES = 121
LEAST_RESPONSE = 1e-3  # standard deviations of a probe, below which nothing responds
_REACHES = (0.05, 0.01, 0.002, 0.0004, 0.0)  # least relative widths about which finer strengths are set, round by round
_UNKNOWN_TAU = np.geomspace(0.5, 5000.0, 14)
UNKNOWN_DOUBT = 0.05  # share of what an effect of the catalogue explains that an unknown one must explain beyond it
UNKNOWN_CHANCE = 3.0  # log evidence that sessions without any effect show by chance (up to 3.5 in 46 sealed ones)
PAIR_DOUBT = 3e-3  # share of the stronger effect's log evidence that a second effect must bring
PAIR_DOUBT_ROOT = 0.6  # and so often its square root: what a slightly wrong law leaves by chance
PAIR_DOUBT_ELSEWHERE = 0.36  # share of both that is left of them where the two effects move no probe in common
# no more than this, and this share of the stronger one's evidence, which fades below an evidence of PAIR_DOUBT_FADES: beside 56
# sealed effects of evidences up to 1e6 another one gained 5 at most (a wandering output 15), beside glares of up to 4e7 90, beside
# one with a focal spot a tail 294 of 3e6
PAIR_DOUBT_LEAST = 12.0
PAIR_DOUBT_STRONG = 3e-5
PAIR_DOUBT_FADES = 1e6
PAIR_DOUBT_SHARED = (
    9.0  # and so much more of the latter, times the square of the share of probes that both effects move
)
APART_DOUBT = 5.0  # of a second effect seen where the first cannot act
_LAW_MATTERS = 1.5  # standard deviations by which a law's error must move the probes for it to be carried in a pair
_PAIRS_IN_FULL = 14  # pairs, the likeliest, either order, for which both laws are taken as inexact
_TIMES_SEEN = (
    1.5  # what a law predicts in a place over what is seen there, up to which it may be off by a share of itself
)
_BELOW = np.geomspace(0.34, 0.97, 12)  # strengths that are tried below the plausible range, over its lower end
_WANTS_LESS = (
    4.5  # log likelihood by which a strength below the plausible range must be better to speak against an effect
)
_MOVES = 0.3  # standard deviations of a probe by which an effect is said to move it
_LEAST_FACTOR = 0.05  # variance of a factor along itself that is worth carrying
UNKNOWN_SHARE = 0.1  # of the groups of probes in which an effect outside the catalogue shows
_SWEEPS = 4


def node_weights(nodes: NDArray[np.float64], strengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (strength, node) with which responses at nodes > 0 add up: Lagrange through the four nearest of 0 and nodes."""
    points = np.concatenate([[0.0], nodes])
    result = np.zeros((len(strengths), len(nodes)))
    used = min(len(points), 4)
    # the interval's two points and their neighbours; the point 0 adds nothing
    first = np.clip(np.searchsorted(points, strengths) - used // 2, 0, len(points) - used)
    row = np.arange(len(strengths))
    for i in range(used):
        at = first + i
        weight = np.ones(len(strengths))
        for j in range(used):
            if j != i:
                other = points[first + j]
                weight *= (strengths - other) / (points[at] - other)
        inner = at > 0
        result[row[inner], at[inner] - 1] = weight[inner]
    return result


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Response of the probes to one effect with its inner parameters fixed.

    Fields: effect (id); variant (name of the inner parameters' choice); parameters (inner parameters, without the
    strength); low, high: plausible range of the strength; strengths (node,) > 0 ascending; responses (node, probe): m_e at
    the nodes, standardised as the probes are; 0 at strength 0; spread (probe, factor): random responses a unit of strength
    that come with the effect (a drifting output shifts each series' level by chance); jitter (probe,): variance a unit of
    strength squared that it gives each probe by itself (a gain map that changed pixel by pixel); exact (probe,): probes that
    the strength is defined by, in which no law can be far off.
    Between nodes and zero the response is interpolated (Lagrange through
    the four nearest points, 0 one of them).
    """

    effect: str
    variant: str
    parameters: Mapping[str, float]
    low: float
    high: float
    strengths: NDArray[np.float64]
    responses: NDArray[np.float64]
    since: str = "always"
    spread: NDArray[np.float64] | None = None
    jitter: NDArray[np.float64] | None = None
    exact: NDArray[np.bool_] | None = None

    @property
    def by_chance_alone(self) -> bool:
        """Whether the effect moves no probe by a known amount, but some by chance."""
        return self.spread is not None and not bool(np.any(np.abs(self.responses) > LEAST_RESPONSE))

    def weights(self, strength: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights (strength, node) with which the nodes' responses add up at given strengths."""
        return node_weights(self.strengths, np.atleast_1d(np.asarray(strength, dtype=np.float64)))

    def response(self, strength: float) -> NDArray[np.float64]:
        """Response (probe,) at one strength."""
        return np.asarray(self.weights(np.array([strength]))[0] @ self.responses)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """One explanation and how probable it is.

    Fields: effects (ids; empty for none; `("unknown_effect",)` for an effect outside the catalogue); probability;
    log_evidence; strengths per effect: best value and 95 % interval (value, low, high); variants per effect; location:
    probe group of an unknown effect; chi_square of the standardised probes left over, nuisances refitted.
    """

    effects: tuple[str, ...]
    probability: float
    log_evidence: float
    strengths: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    variants: Mapping[str, Curve] = field(default_factory=dict)
    location: str = ""


UNKNOWN = "unknown_effect"


@dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """Prior probabilities of the kinds of hypothesis, shared evenly within each kind; they need not sum to 1."""

    none: float = 0.35
    single: float = 0.40
    pair: float = 0.10
    unknown: float = 0.15


class Nuisances:
    """Factor model of the nuisances: what of a vector is left when they may take up what they can."""

    def __init__(self, factors: NDArray[np.float64], cholesky: NDArray[np.float64] | None = None) -> None:
        """`factors` (probe, factor): response to one prior standard deviation of each nuisance."""
        self.factors = factors
        self._cholesky: NDArray[np.float64] = (
            np.asarray(np.linalg.cholesky(np.eye(factors.shape[1]) + factors.T @ factors))
            if cholesky is None
            else cholesky
        )
        self.log_determinant = 2.0 * float(np.sum(np.log(np.diag(self._cholesky))))

    def project(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """z (vector, factor) with a^T C^-1 b = a.b - z_a.z_b for vectors (vector, probe)."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self._cholesky, self.factors.T @ vectors.T, lower=True).T)

    def inner(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Matrix a C^-1 b^T for a (i, probe), b (j, probe)."""
        return np.asarray(a @ b.T - self.project(a) @ self.project(b).T)

    def solve(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 vector (probe,)."""
        from scipy.linalg import cho_solve

        return np.asarray(vector - self.factors @ cho_solve((self._cholesky, True), self.factors.T @ vector))

    def solve_all(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 of each of the vectors (vector, probe): what the nuisances leave of them."""
        from scipy.linalg import cho_solve

        return np.asarray(vectors - cho_solve((self._cholesky, True), self.factors.T @ vectors.T).T @ self.factors.T)

    def fitted(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Most probable nuisances (factor,), in prior standard deviations, for a residual (probe,)."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve((self._cholesky, True), self.factors.T @ vector))

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance (factor,) of nuisances once the probes are seen, prior variance 1."""
        from scipy.linalg import solve_triangular

        half = solve_triangular(self._cholesky, np.eye(len(self._cholesky)), lower=True)
        return np.asarray(np.sum(half**2, axis=0))

    def predicted_sd(self, factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviations (probe,) of other probes with these factors, once the nuisances are fitted on the own ones."""
        from scipy.linalg import solve_triangular

        half = solve_triangular(self._cholesky, factors.T, lower=True)
        return np.asarray(np.sqrt(1.0 + np.sum(half**2, axis=0)))

    def widened(self, extra: NDArray[np.float64]) -> "Nuisances":
        """With more factors (probe, extra); what is known of the old ones is used again."""
        from scipy.linalg import solve_triangular

        old, new = self.factors.shape[1], extra.shape[1]
        below = solve_triangular(self._cholesky, self.factors.T @ extra, lower=True).T
        corner = np.eye(new) + extra.T @ extra - below @ below.T
        cholesky = np.zeros((old + new, old + new))
        cholesky[:old, :old] = self._cholesky
        cholesky[old:, :old] = below
        cholesky[old:, old:] = np.linalg.cholesky(corner)
        return Nuisances(np.concatenate([self.factors, extra], axis=1), cholesky)


def log_strength_nodes(low: float, high: float, count: int = STRENGTH_NODES) -> NDArray[np.float64]:
    """Strengths at which integrals are taken, evenly in the logarithm, from a third of `low` to 1.5 `high`."""
    return np.geomspace(low / 3.0, 1.5 * high, count)


def _log_mean_exp(values: NDArray[np.float64], axis: int | tuple[int, ...] | None = None) -> Any:
    top = np.max(values, axis=axis, keepdims=True)
    mean = np.log(np.mean(np.exp(values - top), axis=axis, keepdims=True)) + top
    return mean.item() if axis is None else np.squeeze(mean, axis=axis)


def _group_factors(response: NDArray[np.float64], groups: NDArray[np.intp], sd: float) -> NDArray[np.float64]:
    """A column a group: the response there times `sd`; groups in which it would move nothing are left out."""
    power = np.bincount(groups, weights=response**2)
    kept = np.nonzero(sd**2 * power > _LEAST_FACTOR)[0]
    place = np.full(len(power), -1)
    place[kept] = np.arange(len(kept))
    rows = np.nonzero(place[groups] >= 0)[0]
    columns = np.zeros((len(response), len(kept)))
    columns[rows, place[groups[rows]]] = sd * response[rows]
    return columns


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


def _refined(strengths: NDArray[np.float64], best: float, width: float) -> NDArray[np.float64]:
    """Nodes with a finer set about `best`, 6 relative widths to each side."""
    span = np.linspace(-6.0, 6.0, 49) * min(max(width, 1e-6), 0.5)
    near = best * np.exp(span)
    return np.unique(np.concatenate([strengths, near[(near >= strengths[0]) & (near <= strengths[-1])]]))


def _log_integral(
    strengths: NDArray[np.float64], log_likelihood: NDArray[np.float64], low: float, high: float
) -> float:
    """log of the mean likelihood under a log-uniform prior from low to high."""
    inside = (strengths >= 0.999999 * low) & (strengths <= 1.000001 * high)
    x, y = np.log(strengths[inside]), log_likelihood[inside]
    top = float(y.max())
    return top + math.log(max(float(np.trapezoid(np.exp(y - top), x)), 1e-300) / (x[-1] - x[0]))


def interval_of(fits: Sequence[CurveFit]) -> tuple[float, float, float]:
    """Posterior median and 95 % bounds of a strength, its inner parameters' variants weighed by their evidence."""
    top = max(fit.log_evidence for fit in fits)
    likely = [fit for fit in fits if fit.log_evidence > top - 12.0]
    nodes = np.unique(np.concatenate([fit.strengths for fit in likely]))
    total = np.full(len(nodes), -np.inf)
    for fit in likely:
        value = np.interp(np.log(nodes), np.log(fit.strengths), fit.log_likelihood)
        total = np.logaddexp(total, value)
    return _interval(nodes, total)


def _interval(strengths: NDArray[np.float64], log_likelihood: NDArray[np.float64]) -> tuple[float, float, float]:
    x = np.log(strengths)
    density = np.exp(log_likelihood - log_likelihood.max())
    cumulated = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(x))])
    low, middle, high = np.interp([0.025, 0.5, 0.975], cumulated / cumulated[-1], x)
    return math.exp(middle), math.exp(low), math.exp(high)


def fit_curve(
    residual: NDArray[np.float64],
    curve: Curve,
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    *,
    places: NDArray[np.intp] | None = None,
    law_errors: Sequence[tuple[float, float]] = LAW_ERRORS,
) -> CurveFit:
    """Evidence of one curve over none, its strength integrated over the log-uniform plausible range.

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
    coarse = np.unique(np.concatenate([log_strength_nodes(curve.low, curve.high), [curve.low, curve.high]]))
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
            effective = _credible(curve.weights(np.array([best]))[0] @ solved, seen, places)
            extra = _law_factors(curve, best, effective, groups, law_error)
            own = _own_variance(curve, best, effective, law_error)
            if extra.shape[1] == 0 and float(own.max()) < _LEAST_FACTOR:
                break
            # evidence over none: the residual's own terms change with the covariance
            moved, moved_nodes, wide, shift = _with_law(residual, nodes, nuisances, extra, own)
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
    strengths = np.unique(
        np.concatenate([log_strength_nodes(curve.low, curve.high, _CHANCE_NODES), [curve.low, curve.high]])
    )
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


def _credible(
    response: NDArray[np.float64], seen: NDArray[np.float64], places: NDArray[np.intp]
) -> NDArray[np.float64]:
    """The part of a response (probe,) that its law's inaccuracy is a share of: in each place no more than `_TIMES_SEEN` what is seen.

    A law that predicts thousands of standard deviations where nothing is seen is wrong by all of them, not off by a share.
    """
    predicted = np.bincount(places, weights=response**2)
    found = np.bincount(places, weights=np.maximum(seen**2, 1.0))
    share = np.sqrt(np.minimum(1.0, _TIMES_SEEN**2 * found / np.maximum(predicted, 1e-12)))
    return np.asarray(response * share[places])


def _law_factors(
    curve: Curve, strength: float, response: NDArray[np.float64], groups: NDArray[np.intp], law_error: float
) -> NDArray[np.float64]:
    """What is random about an effect at a strength (probe, factor): its law's inaccuracy, and its own spread."""
    parts = []
    if curve.exact is not None:
        response = np.where(curve.exact, 0.0, response)
    if float(np.max(np.abs(response), initial=0.0)) * law_error >= 0.3:
        parts.append(_group_factors(response, groups, law_error))
    if curve.spread is not None and float(np.max(np.abs(curve.spread))) * strength >= 0.3:
        parts.append(curve.spread * strength)
    return np.concatenate(parts, axis=1) if parts else np.zeros((len(response), 0))


def law_terms(
    curve: Curve, strength: float, groups: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What a law that is off as usual adds: factors (probe, factor) and each probe's own variance (probe,)."""
    response = curve.response(strength)
    usual = LAW_ERRORS[0][0]
    return _law_factors(curve, strength, response, groups, usual), _own_variance(curve, strength, response, usual)


def _own_variance(
    curve: Curve, strength: float, effective: NDArray[np.float64], law_error: float
) -> NDArray[np.float64]:
    """Variance (probe,) that an effect gives each probe by itself: by its law's relative error, and by chance."""
    share: float | NDArray[np.float64] = LAW_PROBE_SHARE * law_error
    if curve.exact is not None:
        share = np.where(curve.exact, EXACT_LAW_ERROR, share)
    own = (share * effective) ** 2
    return np.asarray(own if curve.jitter is None else own + strength**2 * curve.jitter)


@dataclass(frozen=True, slots=True)
class Widened:
    """Nuisances once an effect's law may be off, and the probes' standard deviations (probe,) that they are in units of."""

    nuisances: Nuisances
    root: NDArray[np.float64]


def widened_for(
    residual: NDArray[np.float64],
    curve: Curve,
    strength: float,
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    law_error: float,
    *,
    places: NDArray[np.intp] | None = None,
) -> Widened:
    """What may vary beside a curve at a strength whose law may be off by law_error; residual (probe,) is what is seen."""
    effective = curve.weights(np.array([strength]))[0] @ nuisances.solve_all(curve.responses)
    effective = _credible(effective, nuisances.solve(residual), groups if places is None else places)
    return _widened(
        nuisances,
        _law_factors(curve, strength, effective, groups, law_error),
        _own_variance(curve, strength, effective, law_error),
    )


def _widened(base: Nuisances, factors: NDArray[np.float64], inexact: NDArray[np.float64]) -> Widened:
    """With more factors (probe, factor) and more variance of each probe's own (probe,)."""
    root = np.sqrt(1.0 + inexact)
    return Widened(Nuisances(np.concatenate([base.factors, factors], axis=1) / root[:, None]), root)


def _with_law(
    residual: NDArray[np.float64],
    nodes: NDArray[np.float64],
    base: Nuisances,
    factors: NDArray[np.float64],
    inexact: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], Nuisances, float]:
    """Residual, nodes and nuisances once an effect's law may be off, and the bare residual's change of log likelihood.

    Args:
        residual, nodes, base: as they were.
        factors: what is random in groups (probe, factor).
        inexact: variance of each probe's own (probe,).
    """
    found = _widened(base, factors, inexact)
    wide, root = found.nuisances, found.root
    moved, moved_nodes = residual / root, nodes / root
    before, after = residual[None, :], moved[None, :]
    quadratic = float(moved @ moved - np.sum(wide.project(after) ** 2)) - float(
        residual @ residual - np.sum(base.project(before) ** 2)
    )
    determinant = 2.0 * float(np.sum(np.log(root))) + wide.log_determinant - base.log_determinant
    return moved, moved_nodes, wide, -0.5 * (determinant + quadratic)


def unknown_evidence(
    residual: NDArray[np.float64], nuisances: Nuisances, groups: NDArray[np.intp], names: Sequence[str]
) -> tuple[float, str]:
    """Log evidence over none of an effect that no catalogue holds, and the group of probes where it is seen most.

    Every group may have an extra variance tau^2, log-uniform over a grid, with probability UNKNOWN_SHARE; the evidence is
    that of the best combination (each group's tau in turn, several sweeps), its prior in it, of one group at least.
    """
    from scipy.linalg import cho_factor, cho_solve

    count = len(names)
    sizes = np.bincount(groups, minlength=count)
    factors = nuisances.factors
    grams = np.stack([factors[groups == g].T @ factors[groups == g] for g in range(count)])
    sums = np.stack([factors[groups == g].T @ residual[groups == g] for g in range(count)])
    squares = np.array([float(np.sum(residual[groups == g] ** 2)) for g in range(count)])
    grid = np.concatenate([[0.0], _UNKNOWN_TAU])
    cost = math.log(UNKNOWN_SHARE / len(_UNKNOWN_TAU))
    tau2 = np.zeros(count)

    def value(weights: NDArray[np.float64], inner: NDArray[np.float64], vector: NDArray[np.float64]) -> float:
        factor = cho_factor(inner, lower=True, check_finite=False)
        determinant = 2.0 * float(np.sum(np.log(np.diag(factor[0])))) - float(sizes @ np.log(weights))
        return -0.5 * (determinant + float(weights @ squares) - float(vector @ cho_solve(factor, vector)))

    one = np.eye(factors.shape[1])
    base = value(np.ones(count), one + grams.sum(axis=0), sums.sum(axis=0))
    alone: list[tuple[float, int]] = []
    best = base
    for sweep in range(_SWEEPS):
        changed = False
        for g in range(count):
            if sizes[g] == 0:
                continue
            weights = 1.0 / (1.0 + tau2)
            weights[g] = 0.0
            inner = one + np.tensordot(weights, grams, axes=1)
            vector = weights @ sums
            found = []
            for tau in grid:
                own = 1.0 / (1.0 + tau**2)
                weights[g] = own
                found.append(value(weights, inner + own * grams[g], vector + own * sums[g]) + (cost if tau else 0.0))
            if sweep == 0 and not np.any(np.delete(tau2, g)):
                alone.append((max(found[1:]), g))
            at = int(np.argmax(found))
            changed |= bool(grid[at] ** 2 != tau2[g])
            tau2[g] = grid[at] ** 2
            best = found[at] + cost * float(np.count_nonzero(np.delete(tau2, g)))
        if not changed:
            break
    if not np.any(tau2):
        best, place = max(alone)
    else:
        place = int(np.argmax(tau2 * sizes))
    return best - base, str(names[place])


def weigh_hypotheses(
    residual: NDArray[np.float64],
    *,
    curves: Sequence[Curve],
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    group_names: Sequence[str],
    unknown_groups: NDArray[np.intp] | None = None,
    unknown_names: Sequence[str] | None = None,
    priors: Priors | None = None,
    power: float = 1.0,
    pairs_from: int = 6,
    law_errors: Sequence[tuple[float, float]] = LAW_ERRORS,
    loose: Mapping[str, float] | None = None,
    left: Mapping[str, float] | None = None,
    chance: Mapping[str, float] | None = None,
    elsewhere: Mapping[str, NDArray[np.bool_]] | None = None,
    places: NDArray[np.intp] | None = None,
    fits: Sequence[CurveFit] | None = None,
) -> tuple[Hypothesis, ...]:
    """All hypotheses, most probable first; their probabilities sum to 1.

    Args:
        residual: standardised probes less the twin's (probe,).
        curves: what each effect would do; several curves of one effect are variants with equal prior.
        nuisances: factor model of what may vary without being an effect.
        groups, group_names: group of each probe (probe,), within which a law's inaccuracy is one factor.
        unknown_groups, unknown_names: partition for the unknown effect; the same as `groups` where absent.
        priors: of the kinds of hypothesis.
        power: calibration of confidence: evidences are raised to it.
        pairs_from: pairs are formed of the best so many effects with every other.
        law_errors: relative errors of an effect's law in each group, and how probable each is.
        chance: effect -> log evidence that sessions without it show, beyond what the nuisances allow; taken off.
        loose: effects whose law leaves something where it predicts nothing, and the share of their log evidence, in place of
            PAIR_DOUBT, that a second effect beside them must bring wherever it acts.
        left: effect -> share of its log evidence that what is wrong with its law may give a second one, where it is not
            PAIR_DOUBT_STRONG.
        elsewhere: effect -> probes (probe,) that it cannot move, however wrong its law; what a second effect gains there is
            not doubted.
        places: place of each probe (probe,), within which a law is off by a share of no more than what is seen there; the
            groups where absent.
        fits: of the curves, with the same residual, nuisances, groups, places and law errors, where they are known.
    """
    priors, chance, elsewhere = priors or Priors(), chance or {}, elsewhere or {}
    left, loose = left or {}, loose or {}
    places = groups if places is None else places
    if fits is None:
        fits = [fit_curve(residual, curve, nuisances, groups, places=places, law_errors=law_errors) for curve in curves]
    by_effect: dict[str, list[CurveFit]] = {}
    for fit in fits:
        by_effect.setdefault(fit.curve.effect, []).append(fit)
    n_effects = max(len(by_effect), 1)
    raw: list[tuple[tuple[str, ...], float, float, dict[str, tuple[float, float, float]], dict[str, Curve], str]] = [
        ((), 0.0, math.log(priors.none), {}, {}, "")
    ]
    singles: dict[str, CurveFit] = {}
    evidence_of: dict[str, float] = {}
    for effect, group_fits in by_effect.items():
        evidence = float(_log_mean_exp(np.array([fit.log_evidence for fit in group_fits])))
        best = max(group_fits, key=lambda fit: fit.log_evidence)
        singles[effect] = best
        evidence_of[effect] = evidence
        raw.append(
            (
                (effect,),
                evidence - chance.get(effect, 0.0),
                math.log(priors.single / n_effects),
                {effect: interval_of(group_fits)},
                {effect: best.curve},
                "",
            )
        )
    ranked = sorted(singles, key=lambda effect: -evidence_of[effect])
    n_pairs = max(n_effects * (n_effects - 1) // 2, 1)
    table = _NodeTable(curves)
    starts: list[tuple[float, str, str, _PairStart]] = []
    for first in ranked[:pairs_from]:
        # the second is looked for in what the first leaves, over all its variants
        leading = singles[first]
        states = _states_of(leading, residual, nuisances, groups, places, law_errors, table)
        for second, second_fits in by_effect.items():
            if second == first:
                continue
            # of two that lead both orders are tried: what one alone is best with need not be so beside the other
            start = _start_pair(leading, second_fits, states=states, table=table)
            # the first's own variants were averaged above; its best stands for them
            starts.append((evidence_of[first] - leading.log_evidence, first, second, start))
    overlaps = _overlaps([start for *_, start in starts], evidence_of, nuisances, table)
    apart = _Apart(residual, nuisances, groups, places, law_errors)

    def doubted(number: int, evidence: float, below: Mapping[str, float]) -> float:
        """Evidence of a pair less what the first's law may have left of it for the second to take up.

        below: how much more likely each effect's strengths below the plausible range are.
        """
        _, first, second, _ = starts[number]
        strong, weak = sorted((first, second), key=lambda effect: -evidence_of[effect])
        stronger = max(evidence_of[strong], 0.0)
        doubt = loose.get(strong, PAIR_DOUBT) * stronger + PAIR_DOUBT_ROOT * math.sqrt(stronger)
        if strong not in loose:
            doubt *= PAIR_DOUBT_ELSEWHERE + (1.0 - PAIR_DOUBT_ELSEWHERE) * overlaps[number]
            shared = 1.0 + PAIR_DOUBT_SHARED * overlaps[number] ** 2
            leaves = left.get(strong, PAIR_DOUBT_STRONG) * min(1.0, stronger / PAIR_DOUBT_FADES) ** 2
            doubt = min(doubt, PAIR_DOUBT_LEAST + leaves * shared * stronger)
        gain = evidence - evidence_of[strong]
        if strong in elsewhere and gain > 0.0:
            clean = elsewhere[strong] & ~np.any(np.abs(singles[strong].curve.responses) > _MOVES, axis=0)
            doubt = min(doubt, max(gain - apart.evidence(clean, by_effect[weak]), 0.0) + APART_DOUBT)
        if gain > 0.0 and below[weak] > _WANTS_LESS and (strong in loose or stronger > PAIR_DOUBT_FADES):
            # less of it than there can be: it stands for what the first's law leaves
            doubt = max(doubt, gain + APART_DOUBT)
        return evidence - doubt - chance.get(first, 0.0) - chance.get(second, 0.0)

    ahead = [
        doubted(number, more + start.log_evidence, start.below) for number, (more, _, _, start) in enumerate(starts)
    ]
    pairs: dict[tuple[str, ...], tuple[float, dict[str, tuple[float, float, float]], dict[str, Curve]]] = {}
    for rank, number in enumerate(sorted(range(len(starts)), key=lambda number: -ahead[number])):
        more, first, second, start = starts[number]
        errors = law_errors if rank < _PAIRS_IN_FULL else ()
        found, strengths, chosen, below = _finish_pair(residual, start, nuisances, groups, places, errors, table=table)
        key = (min(first, second), max(first, second))
        evidence = doubted(number, found + more, below)
        if key not in pairs or evidence > pairs[key][0]:
            pairs[key] = (evidence, strengths, chosen)
    prior = math.log(priors.pair / n_pairs)
    raw += [(key, evidence, prior, strengths, chosen, "") for key, (evidence, strengths, chosen) in pairs.items()]
    parts = groups if unknown_groups is None else unknown_groups
    names = group_names if unknown_names is None else unknown_names
    unknown, place = unknown_evidence(residual, nuisances, parts, names)
    # no law is exact: a strong effect leaves a part of what it does to be explained by anything
    unknown -= UNKNOWN_CHANCE + UNKNOWN_DOUBT * max(
        0.0, min(unknown, max((evidence for _, evidence, *_ in raw), default=0.0))
    )
    raw.append(((UNKNOWN,), unknown, math.log(priors.unknown), {}, {}, place))
    scores = np.array([power * evidence + prior for _, evidence, prior, *_ in raw])
    probability = np.exp(scores - scores.max())
    probability /= probability.sum()
    return tuple(
        sorted(
            (
                Hypothesis(
                    effects=effects,
                    probability=float(p),
                    log_evidence=evidence,
                    strengths=strengths,
                    variants=chosen,
                    location=location,
                )
                for (effects, evidence, _, strengths, chosen, location), p in zip(raw, probability, strict=True)
            ),
            key=lambda item: (-item.probability, -item.log_evidence),
        )
    )


class _Apart:
    """Evidence of effects in a part of the probes alone."""

    def __init__(
        self,
        residual: NDArray[np.float64],
        nuisances: Nuisances,
        groups: NDArray[np.intp],
        places: NDArray[np.intp],
        law_errors: Sequence[tuple[float, float]],
    ) -> None:
        self._residual = residual
        self._nuisances = nuisances
        self._groups = groups
        self._places = places
        self._law_errors = law_errors
        self._within: dict[bytes, Nuisances] = {}
        self._found: dict[tuple[bytes, str], float] = {}

    def evidence(self, part: NDArray[np.bool_], fits: Sequence[CurveFit]) -> float:
        """Log evidence over none of an effect, its variants averaged, in the probes of `part` (probe,)."""
        if not np.any(part):
            return 0.0
        key, effect = np.packbits(part).tobytes(), fits[0].curve.effect
        if (key, effect) not in self._found:
            if key not in self._within:
                self._within[key] = Nuisances(self._nuisances.factors[part])
            self._found[key, effect] = self._of(part, fits, self._within[key])
        return self._found[key, effect]

    def _of(self, part: NDArray[np.bool_], fits: Sequence[CurveFit], nuisances: Nuisances) -> float:
        found = [
            fit_curve(
                self._residual[part],
                _of_probes(fit.curve, part),
                nuisances,
                self._groups[part],
                places=self._places[part],
                law_errors=self._law_errors,
            ).log_evidence
            for fit in fits
        ]
        return float(_log_mean_exp(np.array(found)))


def _of_probes(curve: Curve, part: NDArray[np.bool_]) -> Curve:
    return replace(
        curve,
        responses=curve.responses[:, part],
        spread=None if curve.spread is None else curve.spread[part],
        jitter=None if curve.jitter is None else curve.jitter[part],
        exact=None if curve.exact is None else curve.exact[part],
    )


class _NodeTable:
    """The responses of all curves one under another (node, probe), and where each curve's are."""

    def __init__(self, curves: Sequence[Curve]) -> None:
        self.nodes = np.concatenate([curve.responses for curve in curves])
        self._place = {}
        position = 0
        for curve in curves:
            self._place[id(curve)] = slice(position, position + len(curve.responses))
            position += len(curve.responses)

    def rows(self, *curves: Curve) -> NDArray[np.intp]:
        """Rows of some curves."""
        every = np.arange(len(self.nodes))
        return np.concatenate([every[self._place[id(curve)]] for curve in curves])


@dataclass(frozen=True, slots=True)
class _State:
    """What is left to explain when one effect's law may be off by so much: all nodes' terms, and the log prior of it."""

    linear: NDArray[np.float64]
    gram: NDArray[np.float64]
    shift: float


def _states_of(
    leading: CurveFit,
    residual: NDArray[np.float64],
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    places: NDArray[np.intp],
    law_errors: Sequence[tuple[float, float]],
    table: _NodeTable,
) -> list[_State]:
    def state(model: Nuisances, nodes: NDArray[np.float64], vector: NDArray[np.float64], shift: float) -> _State:
        # a^T C^-1 b of all with all, by one projection
        projected, own = model.project(nodes), model.project(vector[None, :])[0]
        return _State(nodes @ vector - projected @ own, nodes @ nodes.T - projected @ projected.T, shift)

    result = [state(nuisances, table.nodes, residual, 0.0)]
    curve = leading.curve
    effective = curve.weights(np.array([leading.best]))[0] @ nuisances.solve_all(curve.responses)
    effective = _credible(effective, nuisances.solve(residual), places)
    for law_error, probability in law_errors:
        extra = _law_factors(curve, leading.best, effective, groups, law_error)
        own = _own_variance(curve, leading.best, effective, law_error)
        if extra.shape[1] or float(own.max()) >= _LEAST_FACTOR:
            moved, nodes, wide, shift = _with_law(residual, table.nodes, nuisances, extra, own)
            result.append(state(wide, nodes, moved, shift + math.log(probability)))
    return result


@dataclass(frozen=True, slots=True, kw_only=True)
class _PairStart:
    """An effect's best variant with the best variant of another: grid of strengths, log evidence over none (variants averaged)."""

    first: Curve
    second: Curve
    grid: "_PairGrid"
    log_evidence: float
    moves: float

    @property
    def below(self) -> dict[str, float]:
        """How much more likely strengths below the plausible range are, by effect."""
        return _by_effect(self.first, self.second, self.grid.below)


def _start_pair(
    first: CurveFit, seconds: Sequence[CurveFit], *, states: Sequence[_State], table: _NodeTable
) -> _PairStart:
    """The other's variants weighed with the first's law only inexact."""
    a = first.curve
    tried: list[tuple[float, _PairGrid, CurveFit]] = []
    for second in seconds:
        rows = table.rows(a, second.curve)
        grids = [
            _pair_integral(a, second.curve, (state.linear[rows], state.gram[np.ix_(rows, rows)]), state.shift)
            for state in states
        ]
        grid = max(grids, key=lambda item: item.log_integral)
        tried.append((grid.log_integral, grid, second))
    mean = float(_log_mean_exp(np.array([item[0] for item in tried])))
    _, grid, chosen = max(tried, key=lambda item: item[0])
    b = chosen.curve
    rows = table.rows(a, b)[len(a.responses) :]
    weights_b = b.weights(np.array([grid.best[1]]))[0]
    moves = math.sqrt(max(float(weights_b @ states[0].gram[np.ix_(rows, rows)] @ weights_b), 0.0))
    return _PairStart(first=a, second=b, grid=grid, log_evidence=mean, moves=moves)


def _overlaps(
    starts: Sequence[_PairStart], evidence_of: Mapping[str, float], nuisances: Nuisances, table: _NodeTable
) -> NDArray[np.float64]:
    """Share of what the weaker effect of each pair does, nuisances aside, that lies where the stronger one does as much."""
    solved = nuisances.solve_all(table.nodes)
    result = np.ones(len(starts))
    for number, start in enumerate(starts):
        squares = [
            (curve.weights(np.array([strength]))[0] @ solved[table.rows(curve)]) ** 2
            for curve, strength in zip((start.first, start.second), start.grid.best, strict=True)
        ]
        if evidence_of[start.first.effect] > evidence_of[start.second.effect]:
            squares.reverse()
        weaker, stronger = squares
        result[number] = float(np.sum(np.minimum(weaker, stronger))) / max(float(weaker.sum()), 1e-12)
    return result


def _finish_pair(
    residual: NDArray[np.float64],
    pair: _PairStart,
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    places: NDArray[np.intp],
    law_errors: Sequence[tuple[float, float]],
    *,
    table: _NodeTable,
) -> tuple[float, dict[str, tuple[float, float, float]], dict[str, Curve], dict[str, float]]:
    """Log evidence over none of two effects, strengths, the variants, and how much more likely strengths below their ranges are.

    Where the second moves the probes by so much that its own law matters, both may be off.
    """
    a, b, grid = pair.first, pair.second, pair.grid
    value = grid.log_integral
    share = pair.log_evidence - value
    nodes = table.nodes[table.rows(a, b)]
    best: tuple[float, _PairGrid] = (value, grid)
    if law_errors and pair.moves * law_errors[0][0] > _LAW_MATTERS:
        solved, seen = nuisances.solve_all(nodes), nuisances.solve(residual)
        for law_error, probability in law_errors:
            start = grid.best
            for _ in range(2):
                effective_a = _credible(a.weights(np.array([start[0]]))[0] @ solved[: len(a.responses)], seen, places)
                effective_b = _credible(b.weights(np.array([start[1]]))[0] @ solved[len(a.responses) :], seen, places)
                extra = np.concatenate(
                    [
                        _law_factors(a, start[0], effective_a, groups, law_error),
                        _law_factors(b, start[1], effective_b, groups, law_error),
                    ],
                    axis=1,
                )
                if not extra.shape[1]:
                    break
                own = _own_variance(a, start[0], effective_a, law_error)
                own = own + _own_variance(b, start[1], effective_b, law_error)
                moved, moved_nodes, wide, shift = _with_law(residual, nodes, nuisances, extra, own)
                again = _pair_integral(a, b, _pair_terms(wide, moved_nodes, moved), shift + math.log(probability))
                if again.log_integral > best[0]:
                    best = (again.log_integral, again)
                moved_on = max(abs(math.log(x / y)) for x, y in zip(again.best, start, strict=True))
                start = again.best
                if moved_on < 0.1:
                    break
    chosen = best[1]
    density = np.exp(chosen.log_likelihood - chosen.log_likelihood.max())
    marginal_a = np.log(np.maximum(np.trapezoid(density, np.log(chosen.second), axis=1), 1e-300))
    marginal_b = np.log(np.maximum(np.trapezoid(density, np.log(chosen.first), axis=0), 1e-300))
    strengths = {
        a.effect: _interval(chosen.first, marginal_a),
        b.effect: _interval(chosen.second, marginal_b),
    }
    return best[0] + share, strengths, {a.effect: a, b.effect: b}, _by_effect(a, b, chosen.below)


def _by_effect(first: Curve, second: Curve, values: tuple[float, float]) -> dict[str, float]:
    return {first.effect: values[0], second.effect: values[1]}


@dataclass(frozen=True, slots=True, kw_only=True)
class _PairGrid:
    """Log likelihood over none (first, second) at strengths of two effects, and log of its mean under the prior.

    below: how much more likely strengths below the plausible range are, of the first and of the second, the other one at its best.
    """

    log_integral: float
    first: NDArray[np.float64]
    second: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    below: tuple[float, float] = (0.0, 0.0)

    @property
    def best(self) -> tuple[float, float]:
        i, j = np.unravel_index(int(np.argmax(self.log_likelihood)), self.log_likelihood.shape)
        return float(self.first[i]), float(self.second[j])


def _pair_terms(
    model: Nuisances, nodes: NDArray[np.float64], residual: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return model.inner(nodes, residual[None, :])[:, 0], model.inner(nodes, nodes)


def _pair_integral(
    a: Curve, b: Curve, terms: tuple[NDArray[np.float64], NDArray[np.float64]], shift: float
) -> _PairGrid:
    """Mean likelihood of two effects on a grid of both strengths that closes in on the best."""
    linear, gram = terms
    count = len(a.responses)

    def grid_of(sa: NDArray[np.float64], sb: NDArray[np.float64]) -> NDArray[np.float64]:
        wa, wb = a.weights(sa), b.weights(sb)
        la, lb = wa @ linear[:count], wb @ linear[count:]
        qa = np.einsum("si,ij,sj->s", wa, gram[:count, :count], wa)
        qb = np.einsum("si,ij,sj->s", wb, gram[count:, count:], wb)
        cross = wa @ gram[:count, count:] @ wb.T
        return np.asarray(la[:, None] + lb[None, :] - 0.5 * (qa[:, None] + qb[None, :]) - cross)

    xa = np.linspace(math.log(a.low), math.log(a.high), _PAIR_NODES)
    xb = np.linspace(math.log(b.low), math.log(b.high), _PAIR_NODES)
    range_a, range_b = xa[-1] - xa[0], xb[-1] - xb[0]
    result: _PairGrid | None = None
    for _ in range(7):
        grid = grid_of(np.exp(xa), np.exp(xb)) + shift
        top = float(grid.max())
        inner = np.trapezoid(np.exp(grid - top), xb, axis=1)
        value = top + math.log(max(float(np.trapezoid(inner, xa)), 1e-300) / (range_a * range_b))
        result = _PairGrid(log_integral=value, first=np.exp(xa), second=np.exp(xb), log_likelihood=grid)
        near = grid > top - 8.0
        rows, columns = np.nonzero(near.any(axis=1))[0], np.nonzero(near.any(axis=0))[0]
        if len(rows) >= 6 and len(columns) >= 6:
            break
        # zoom to where the likelihood lies, one node to each side
        xa = np.linspace(xa[max(rows[0] - 1, 0)], xa[min(rows[-1] + 1, len(xa) - 1)], _PAIR_NODES)
        xb = np.linspace(xb[max(columns[0] - 1, 0)], xb[min(columns[-1] + 1, len(xb) - 1)], _PAIR_NODES)
    if result is None:
        raise RuntimeError("no grid was tried")
    best, top = result.best, float(result.log_likelihood.max()) - shift
    less_a, less_b = (
        curve.low * _BELOW if at < 1.001 * curve.low else None for curve, at in zip((a, b), best, strict=True)
    )
    below = (
        0.0 if less_a is None else float(grid_of(less_a, np.array([best[1]])).max()) - top,
        0.0 if less_b is None else float(grid_of(np.array([best[0]]), less_b).max()) - top,
    )
    return replace(result, below=below)

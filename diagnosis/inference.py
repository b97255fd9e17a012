"""Which hypothesis explains a vector of probes: none, one effect, two, or something that is not in the catalogue.

Probes are residuals r (probe,) against the twin, in units of their own standard deviations. Nuisance parameters are
integrated out exactly (they are linear with Gaussian priors): r ~ N(m, C), C = I + F F^T, F (probe, factor) the
responses to the nuisances times their prior standard deviations. With C = L L^T only projections are needed.

    none      m = 0
    effect    m = m_e(s), s the strength, log-uniform over its plausible range, the law's own inaccuracy a random factor
              (sd LAW_ERROR) for each group of probes
    pair      m = m_e(s) + m_f(t)
    unknown   m = 0 and an extra variance tau^2 in one group of probes, tau log-uniform

Evidence of each is integrated numerically over strengths; a hypothesis' probability is prior x evidence, raised to a
power below 1 where tests on simulated sessions showed overconfidence.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

LAW_ERROR = 0.10
LAW_PROBE_SHARE = 0.5  # of the law's error that is each probe's own
STRENGTH_NODES = 25
_PAIR_NODES = 13
_UNKNOWN_TAU = np.geomspace(1.0, 300.0, 14)


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Response of the probes to one effect with its inner parameters fixed.

    Fields: effect (id); variant (name of the inner parameters' choice); parameters (inner parameters, without the
    strength); low, high: plausible range of the strength; strengths (node,) > 0 ascending; responses (node, probe): m_e at
    the nodes, standardised as the probes are; 0 at strength 0; spread (probe, factor): random responses a unit of strength
    that come with the effect (a drifting output shifts each series' level by chance).
    Between nodes and zero the response is interpolated
    (piecewise quadratic through 0 and the two nearest nodes).
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

    def weights(self, strength: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights (strength, node) with which the nodes' responses add up at given strengths; Lagrange through 0."""
        nodes = self.strengths
        s = np.atleast_1d(np.asarray(strength, dtype=np.float64))
        result = np.zeros((len(s), len(nodes)))
        if len(nodes) == 1:
            result[:, 0] = s / nodes[0]
            return result
        right = np.clip(np.searchsorted(nodes, s), 1, len(nodes) - 1)
        a, b = nodes[right - 1], nodes[right]
        # quadratic through (0, 0), (a, .), (b, .)
        row = np.arange(len(s))
        result[row, right - 1] = s * (s - b) / (a * (a - b))
        result[row, right] = s * (s - a) / (b * (b - a))
        return result

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

    def fitted(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Most probable nuisances (factor,), in prior standard deviations, for a residual (probe,)."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve((self._cholesky, True), self.factors.T @ vector))

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
    """A column a group: the response there times `sd`; groups without response are left out."""
    columns = []
    for group in range(int(groups.max()) + 1):
        column = np.where(groups == group, response, 0.0)
        if np.sum(column**2) > 1e-4:
            columns.append(sd * column)
    return np.stack(columns, axis=1) if columns else np.zeros((len(response), 0))


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

    def interval(self) -> tuple[float, float, float]:
        """Posterior mean of the logarithm and 95 % bounds, as strengths."""
        return _interval(self.strengths, self.log_likelihood)


def _refined(strengths: NDArray[np.float64], best: float, width: float) -> NDArray[np.float64]:
    """Nodes with a finer set about `best`, 6 relative widths to each side."""
    span = np.linspace(-6.0, 6.0, 49) * min(max(width, 1e-4), 0.5)
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
    law_error: float = LAW_ERROR,
) -> CurveFit:
    """Evidence of one curve over none, its strength integrated over the log-uniform plausible range.

    The law's inaccuracy is a random factor a group; its factors are rebuilt at the best strength (two rounds).
    """
    nodes = curve.responses

    def terms(model: Nuisances) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return model.inner(nodes, residual[None, :])[:, 0], model.inner(nodes, nodes)

    def likelihood(
        strengths: NDArray[np.float64], model: tuple[NDArray[np.float64], NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        weights = curve.weights(strengths)
        quadratic = np.einsum("si,ij,sj->s", weights, model[1], weights)
        return weights @ model[0] - 0.5 * quadratic, quadratic

    sharp = terms(nuisances)
    coarse = np.unique(np.concatenate([log_strength_nodes(curve.low, curve.high), [curve.low, curve.high]]))
    strengths = coarse
    value, quadratic = likelihood(strengths, sharp)
    at = int(np.argmax(value))
    for _ in range(3):
        width = 1.0 / math.sqrt(max(float(quadratic[at]), 1e-6))
        strengths = _refined(coarse, float(strengths[at]), width)
        value, quadratic = likelihood(strengths, sharp)
        at = int(np.argmax(value))
    sharp_value, sharp_strengths = value, strengths
    separation = math.sqrt(max(float(quadratic[at]), 0.0))
    for _ in range(3):
        best = float(strengths[at])
        response = curve.weights(np.array([best]))[0] @ nodes
        extra = _law_factors(curve, best, response, groups, law_error)
        if extra.shape[1] == 0:
            break
        # evidence over none: the residual's own terms change with the covariance
        moved, moved_nodes, wide, shift = _with_law(
            residual, nodes, nuisances, extra, [response], LAW_PROBE_SHARE * law_error
        )
        wide_terms = (wide.inner(moved_nodes, moved[None, :])[:, 0], wide.inner(moved_nodes, moved_nodes))
        value, quadratic = likelihood(coarse, wide_terms)
        # weak strengths keep the sharp covariance: there the law's inaccuracy does nothing
        width = 1.0 / math.sqrt(max(float(quadratic[int(np.argmax(value))]), 1e-6))
        strengths = _refined(coarse, float(coarse[int(np.argmax(value))]), max(width, 0.3 * law_error))
        value, quadratic = likelihood(strengths, wide_terms)
        value = value + shift
        weak = strengths < 0.3 * best
        value = np.where(weak, likelihood(strengths, sharp)[0], value)
        at = int(np.argmax(value))
        separation = math.sqrt(max(float(quadratic[at]), 0.0))
        if abs(math.log(float(strengths[at]) / best)) < 0.05:
            break
    if float(sharp_value.max()) > float(value.max()):
        strengths, value = sharp_strengths, sharp_value
    return CurveFit(
        curve=curve,
        log_evidence=_log_integral(strengths, value, curve.low, curve.high),
        strengths=strengths,
        log_likelihood=value,
        separation=separation,
    )


def _law_factors(
    curve: Curve, strength: float, response: NDArray[np.float64], groups: NDArray[np.intp], law_error: float
) -> NDArray[np.float64]:
    """What is random about an effect at a strength (probe, factor): its law's inaccuracy, and its own spread."""
    parts = []
    if float(np.max(np.abs(response), initial=0.0)) * law_error >= 0.3:
        parts.append(_group_factors(response, groups, law_error))
    if curve.spread is not None and float(np.max(np.abs(curve.spread))) * strength >= 0.3:
        parts.append(curve.spread * strength)
    return np.concatenate(parts, axis=1) if parts else np.zeros((len(response), 0))


def _with_law(
    residual: NDArray[np.float64],
    nodes: NDArray[np.float64],
    base: Nuisances,
    factors: NDArray[np.float64],
    responses: Sequence[NDArray[np.float64]],
    probe_error: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], Nuisances, float]:
    """Residual, nodes and nuisances once an effect's law may be off, and the bare residual's change of log likelihood.

    Args:
        residual, nodes, base: as they were.
        factors: what is random in groups (probe, factor).
        responses: of the effects at their strengths; each probe's own part may be off by `probe_error`.
        probe_error: relative.
    """
    scale = np.ones(len(residual))
    for response in responses:
        scale = scale + (probe_error * response) ** 2
    root = np.sqrt(scale)
    moved, moved_nodes = residual / root, nodes / root
    wide = Nuisances(np.concatenate([base.factors, factors], axis=1) / root[:, None])
    before, after = residual[None, :], moved[None, :]
    quadratic = float(moved @ moved - np.sum(wide.project(after) ** 2)) - float(
        residual @ residual - np.sum(base.project(before) ** 2)
    )
    determinant = float(np.sum(np.log(scale))) + wide.log_determinant - base.log_determinant
    return moved, moved_nodes, wide, -0.5 * (determinant + quadratic)


def _unknown_fits(
    residual: NDArray[np.float64], nuisances: Nuisances, groups: NDArray[np.intp], names: Sequence[str]
) -> list[tuple[str, float]]:
    """Log evidence over none of an extra variance in each group, tau integrated."""
    base = nuisances.solve(residual)
    results = []
    for group, name in enumerate(names):
        member = groups == group
        count = int(member.sum())
        if count == 0:
            continue
        # the block of C^-1 that belongs to the members; by its eigenvectors one tau costs nothing
        own = nuisances.factors[member]
        block = np.eye(count) - own @ _solve_inner(nuisances, own.T)
        values, vectors = np.linalg.eigh(0.5 * (block + block.T))
        values = np.clip(values, 0.0, None)
        projected = vectors.T @ base[member]
        logs = []
        for tau in _UNKNOWN_TAU:
            scale = tau**2 / max(count, 1) * 4.0 if count > 4 else tau**2
            denominator = 1.0 + scale * values
            logs.append(
                -0.5 * float(np.sum(np.log(denominator))) + 0.5 * float(np.sum(scale * projected**2 / denominator))
            )
        results.append((name, float(_log_mean_exp(np.array(logs)))))
    return results


def _solve_inner(nuisances: Nuisances, right: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.linalg import cho_solve

    return np.asarray(cho_solve((nuisances._cholesky, True), right))


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
    law_error: float = LAW_ERROR,
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
        law_error: relative standard deviation of an effect's law in each group.
    """
    priors = priors or Priors()
    fits = [fit_curve(residual, curve, nuisances, groups, law_error=law_error) for curve in curves]
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
                evidence,
                math.log(priors.single / n_effects),
                {effect: best.interval()},
                {effect: best.curve},
                "",
            )
        )
    ranked = sorted(singles, key=lambda effect: -evidence_of[effect])
    n_pairs = max(n_effects * (n_effects - 1) // 2, 1)
    done: set[tuple[str, str]] = set()
    for first in ranked[:pairs_from]:
        # the second is looked for in what the first leaves, over all its variants
        leading = singles[first]
        for second, second_fits in by_effect.items():
            key = (min(first, second), max(first, second))
            if second == first or key in done:
                continue
            done.add(key)
            best_pair: tuple[float, Any] | None = None
            variants = []
            for candidate in second_fits:
                pair = _fit_pair(residual, leading, candidate, nuisances, groups, law_error)
                variants.append(pair[0])
                if best_pair is None or pair[0] > best_pair[0]:
                    best_pair = pair
            # the first's own variants were averaged above; its best stands for them
            evidence = float(_log_mean_exp(np.array(variants))) + (evidence_of[first] - leading.log_evidence)
            if best_pair is None:
                continue
            strengths, chosen = best_pair[1]
            raw.append((key, evidence, math.log(priors.pair / n_pairs), strengths, chosen, ""))
    parts = groups if unknown_groups is None else unknown_groups
    names = group_names if unknown_names is None else unknown_names
    unknown = _unknown_fits(residual, nuisances, parts, names)
    for name, evidence in unknown:
        raw.append(((UNKNOWN,), evidence, math.log(priors.unknown / max(len(unknown), 1)), {}, {}, name))
    scores = np.array([power * evidence + prior for _, evidence, prior, *_ in raw])
    probability = np.exp(scores - scores.max())
    probability /= probability.sum()
    merged: list[Hypothesis] = []
    unknown_total = 0.0
    unknown_best: tuple[float, str, float] | None = None
    for (effects, evidence, _, strengths, chosen, location), p in zip(raw, probability, strict=True):
        if effects == (UNKNOWN,):
            unknown_total += float(p)
            if unknown_best is None or p > unknown_best[0]:
                unknown_best = (float(p), location, evidence)
            continue
        merged.append(
            Hypothesis(
                effects=effects, probability=float(p), log_evidence=evidence, strengths=strengths, variants=chosen
            )
        )
    if unknown_best is not None:
        merged.append(
            Hypothesis(
                effects=(UNKNOWN,),
                probability=unknown_total,
                log_evidence=unknown_best[2],
                location=unknown_best[1],
            )
        )
    return tuple(sorted(merged, key=lambda item: (-item.probability, -item.log_evidence)))


def _fit_pair(
    residual: NDArray[np.float64],
    first: CurveFit,
    second: CurveFit,
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    law_error: float,
) -> tuple[float, tuple[dict[str, tuple[float, float, float]], dict[str, Curve]]]:
    """Log evidence of two effects over none and their strengths, on grids of both that close in on the best."""
    a, b = first.curve, second.curve
    nodes = np.concatenate([a.responses, b.responses])
    n_first = len(a.responses)

    def terms(model: Nuisances) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return model.inner(nodes, residual[None, :])[:, 0], model.inner(nodes, nodes)

    def grid_of(
        sa: NDArray[np.float64], sb: NDArray[np.float64], model: tuple[NDArray[np.float64], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        wa, wb = a.weights(sa), b.weights(sb)
        linear, gram = model
        la, lb = wa @ linear[:n_first], wb @ linear[n_first:]
        qa = np.einsum("si,ij,sj->s", wa, gram[:n_first, :n_first], wa)
        qb = np.einsum("si,ij,sj->s", wb, gram[n_first:, n_first:], wb)
        cross = wa @ gram[:n_first, n_first:] @ wb.T
        return np.asarray(la[:, None] + lb[None, :] - 0.5 * (qa[:, None] + qb[None, :]) - cross)

    def integral(
        model: tuple[NDArray[np.float64], NDArray[np.float64]], shift: float
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        xa = np.linspace(math.log(a.low), math.log(a.high), _PAIR_NODES)
        xb = np.linspace(math.log(b.low), math.log(b.high), _PAIR_NODES)
        range_a, range_b = xa[-1] - xa[0], xb[-1] - xb[0]
        best: tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None = None
        for _ in range(7):
            grid = grid_of(np.exp(xa), np.exp(xb), model) + shift
            top = float(grid.max())
            inner = np.trapezoid(np.exp(grid - top), xb, axis=1)
            value = top + math.log(max(float(np.trapezoid(inner, xa)), 1e-300) / (range_a * range_b))
            best = (value, np.exp(xa), np.exp(xb), grid)
            near = grid > top - 8.0
            rows, columns = np.nonzero(near.any(axis=1))[0], np.nonzero(near.any(axis=0))[0]
            if len(rows) >= 6 and len(columns) >= 6:
                break
            # zoom to where the likelihood lies, one node to each side
            xa = np.linspace(xa[max(rows[0] - 1, 0)], xa[min(rows[-1] + 1, len(xa) - 1)], _PAIR_NODES)
            xb = np.linspace(xb[max(columns[0] - 1, 0)], xb[min(columns[-1] + 1, len(xb) - 1)], _PAIR_NODES)
        if best is None:
            raise RuntimeError("no grid was tried")
        return best

    value, sa, sb, grid = integral(terms(nuisances), 0.0)
    i, j = np.unravel_index(int(np.argmax(grid)), grid.shape)
    response_a = a.weights(sa[i : i + 1])[0] @ a.responses
    response_b = b.weights(sb[j : j + 1])[0] @ b.responses
    extra = np.concatenate(
        [
            _law_factors(a, float(sa[i]), response_a, groups, law_error),
            _law_factors(b, float(sb[j]), response_b, groups, law_error),
        ],
        axis=1,
    )
    if extra.shape[1]:
        moved, moved_nodes, wide, shift = _with_law(
            residual, nodes, nuisances, extra, [response_a, response_b], LAW_PROBE_SHARE * law_error
        )
        again = integral((wide.inner(moved_nodes, moved[None, :])[:, 0], wide.inner(moved_nodes, moved_nodes)), shift)
        if again[0] > value:
            value, sa, sb, grid = again
    top = grid.max()
    with np.errstate(under="ignore"):
        density = np.exp(grid - top)
    marginal_a = np.log(np.maximum(np.trapezoid(density, np.log(sb), axis=1), 1e-300))
    marginal_b = np.log(np.maximum(np.trapezoid(density, np.log(sa), axis=0), 1e-300))
    strengths = {a.effect: _interval(sa, marginal_a), b.effect: _interval(sb, marginal_b)}
    return value, (strengths, {a.effect: a, b.effect: b})

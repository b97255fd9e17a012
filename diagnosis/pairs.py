"""Two effects at once: every other one beside those that lead, and what the stronger one's law may have left for the weaker.

The second is looked for in what the first leaves, over all its variants; of two that lead both orders are tried. What a law that is
only nearly right leaves goes to any effect that can take it: a second one must bring more than that (`Doubts`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ._pair_loops import pair_integral, pair_likelihood
from .curve_fits import IMPLAUSIBLE, CurveFit, fit_curve, interval_under, log_mean_exp
from .curves import Curve
from .inexact_laws import LEAST_FACTOR, credible, law_factors, own_variance, with_law
from .nuisances import Nuisances

PAIR_DOUBT = 3e-3  # share of the stronger effect's log evidence that a second effect must bring
PAIR_DOUBT_ROOT = 0.6  # and so often its square root: what a slightly wrong law leaves by chance
PAIR_DOUBT_ELSEWHERE = 0.36  # share of both that is left of them where the two effects move no probe in common
# no more than this, and this share of the stronger one's evidence, which fades below an evidence of PAIR_DOUBT_FADES: beside 56
# sealed effects of evidences up to 1e6 another one gained 5 at most (a wandering output 15), beside glares of up to 4e7 90, beside
# one with a focal spot a tail 294 of 3e6
PAIR_DOUBT_LEAST = 12.0
PAIR_DOUBT_STRONG = 1e-5
PAIR_DOUBT_FADES = 1e6
PAIR_DOUBT_SHARED = 2.9e-4  # and so much more of it, times the square of the effects' overlap
APART_DOUBT = 5.0  # of a second effect seen where the first cannot act
_PAIR_NODES = 13
_LAW_MATTERS = 1.5  # standard deviations by which a law's error must move the probes for it to be carried in a pair
_TURNED = 2  # pairs, the likeliest, whose variants are chosen by turns
_MOST_TURNS = 4
_PAIRS_IN_FULL = 14  # pairs, the likeliest, either order, for which both laws are taken as inexact
# times the least that is plausible: of twelve seconds named beside one sealed effect, where they were none, eight lay below that
_AT_BOTTOM = 1.2
_BELOW = np.geomspace(0.34, 0.97, 12)  # strengths that are tried below the plausible range, over its lower end
_WANTS_LESS = 4.5  # log likelihood by which less than is plausible must be better to speak against an effect
_MOVES = 0.3  # standard deviations of a probe by which an effect is said to move it


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """What is weighed.

    Fields: residual, standardised probes less the twin's (probe,); nuisances, their factor model; groups (probe,), within which a
    law's inaccuracy is one factor; places (probe,), within which a law is off by a share of no more than what is seen there;
    law_errors: relative errors of a law in each group, and how probable each is.
    """

    residual: NDArray[np.float64]
    nuisances: Nuisances
    groups: NDArray[np.intp]
    places: NDArray[np.intp]
    law_errors: Sequence[tuple[float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubts:
    """How effects are known to mislead, by effect.

    Fields:
        chance: log evidence that sessions without it show, beyond what the nuisances allow; taken off.
        loose: effects whose law leaves something where it predicts nothing, and the share of their log evidence, in place of
            PAIR_DOUBT, that a second effect beside them must bring wherever it acts.
        sharp: effects that change edges alone, which nothing that such a law leaves looks like: not doubted for it.
        told: effects that pixels or codes of their own tell, which no other effect's law can leave: found at the least that is
            plausible they are doubted no more than elsewhere.
        elsewhere: probes (probe,) that it cannot move, however wrong its law; what a second effect gains there is not doubted.
    """

    chance: Mapping[str, float] = field(default_factory=dict)
    loose: Mapping[str, float] = field(default_factory=dict)
    sharp: frozenset[str] = frozenset()
    told: frozenset[str] = frozenset()
    elsewhere: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Single:
    """One effect against the probes: fits of its variants, the best of them, log evidence over none (variants averaged)."""

    fits: Sequence[CurveFit]
    best: CurveFit
    log_evidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two effects, in alphabetical order.

    Fields: effects; log_evidence over none, doubts taken off; strengths (value, low, high) and variants by effect.
    """

    effects: tuple[str, str]
    log_evidence: float
    strengths: Mapping[str, tuple[float, float, float]]
    variants: Mapping[str, Curve]


def weigh_pairs(
    observed: Observed, singles: Mapping[str, Single], curves: Sequence[Curve], *, doubts: Doubts, leading: int
) -> list[Pair]:
    """The effects that explain most, so many as `leading` says, each with every other one; the better of two orders.

    Args:
        observed: what is weighed.
        singles: all effects, by id.
        curves: of all fits.
        doubts: what a second effect must bring.
        leading: how many effects are the first of a pair.
    """
    table = _NodeTable(curves)
    ranked = sorted(singles, key=lambda effect: -singles[effect].log_evidence)
    starts: list[_PairStart] = []
    for first in ranked[:leading]:
        # the second is looked for in what the first leaves, over all its variants
        best = singles[first].best
        states = _states_of(best.curve, best.best, observed, table)
        for second, single in singles.items():
            if second != first:
                # of two that lead both orders are tried: what one alone is best with need not be so beside the other
                starts.append(_start_pair(singles[first], single, head=best.curve, states=states, table=table))
    doubt = _SecondDoubted(observed, singles, doubts)

    def ahead_of(some: Sequence[_PairStart]) -> tuple[list[float], list[float]]:
        overlaps = _overlaps(some, singles, observed.nuisances, table)
        return list(overlaps), [
            start.log_evidence - doubt.of(start, overlap, start.log_evidence, start.below, start.strengths)
            for start, overlap in zip(some, overlaps, strict=True)
        ]

    overlaps, ahead = ahead_of(starts)
    # nor need what is best beside one that is best alone be best beside one that is not
    likely = sorted(range(len(starts)), key=lambda number: -ahead[number])[:_TURNED]
    turned = [_turned(starts[number], observed, singles, table=table) for number in likely]
    more = [start for start, number in zip(turned, likely, strict=True) if start is not starts[number]]
    if more:
        of_more = ahead_of(more)
        starts, overlaps, ahead = [*starts, *more], [*overlaps, *of_more[0]], [*ahead, *of_more[1]]
    pairs: dict[tuple[str, str], Pair] = {}
    for rank, number in enumerate(sorted(range(len(starts)), key=lambda number: -ahead[number])):
        start = starts[number]
        found, strengths, variants, below = _finish_pair(
            observed, start, observed.law_errors if rank < _PAIRS_IN_FULL else (), table=table
        )
        at = {effect: value for effect, (value, *_) in strengths.items()}
        evidence = found - doubt.of(start, overlaps[number], found, below, at)
        first, second = sorted(start.effects)
        if (first, second) not in pairs or evidence > pairs[first, second].log_evidence:
            pairs[first, second] = Pair(
                effects=(first, second), log_evidence=evidence, strengths=strengths, variants=variants
            )
    return list(pairs.values())


class _SecondDoubted:
    """What is taken off a pair's log evidence: what the stronger one's law may have left for the weaker to take up."""

    def __init__(self, observed: Observed, singles: Mapping[str, Single], doubts: Doubts) -> None:
        self._singles = singles
        self._doubts = doubts
        self._apart = _Apart(observed)

    def of(
        self,
        pair: "_PairStart",
        overlap: float,
        evidence: float,
        below: Mapping[str, float],
        strengths: Mapping[str, float],
    ) -> float:
        """Doubt about a pair.

        Args:
            pair: its effects.
            overlap: share of what the weaker one does that lies where the stronger one does as much.
            evidence: log evidence of the pair over none.
            below: how much more likely each effect's strengths below the plausible range are.
            strengths: of the effects, at their best.
        """
        doubts = self._doubts
        strong, weak = sorted(pair.effects, key=lambda effect: -self._singles[effect].log_evidence)
        stronger = max(self._singles[strong].log_evidence, 0.0)
        loose = strong in doubts.loose and weak not in doubts.sharp
        doubt = (doubts.loose[strong] if loose else PAIR_DOUBT) * stronger + PAIR_DOUBT_ROOT * math.sqrt(stronger)
        curves = {curve.effect: curve for curve in (pair.first, pair.second)}
        # what a law that is nearly right leaves is taken up by whatever can take it, at the least that is plausible
        at_bottom = weak not in doubts.told and strengths[weak] < _AT_BOTTOM * curves[weak].low
        if not loose and not at_bottom:
            doubt *= PAIR_DOUBT_ELSEWHERE + (1.0 - PAIR_DOUBT_ELSEWHERE) * overlap
            leaves = (PAIR_DOUBT_STRONG + PAIR_DOUBT_SHARED * overlap**2) * min(1.0, stronger / PAIR_DOUBT_FADES) ** 2
            doubt = min(doubt, PAIR_DOUBT_LEAST + leaves * stronger)
        gain = evidence - self._singles[strong].log_evidence
        if strong in doubts.elsewhere and gain > 0.0:
            moves = np.any(np.abs(self._singles[strong].best.curve.responses) > _MOVES, axis=0)
            apart = self._apart.evidence(doubts.elsewhere[strong] & ~moves, self._singles[weak].fits)
            doubt = min(doubt, max(gain - apart, 0.0) + APART_DOUBT)
        if gain > 0.0 and below[weak] > _WANTS_LESS and (strong in doubts.loose or stronger > PAIR_DOUBT_FADES):
            # less of it than there can be: it stands for what the first's law leaves
            doubt = max(doubt, gain + APART_DOUBT)
        return doubt + sum(doubts.chance.get(effect, 0.0) for effect in pair.effects)


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


def _states_of(curve: Curve, strength: float, observed: Observed, table: _NodeTable) -> list[_State]:
    """What is left to explain beside an effect of some strength, its law exact and off by each of the law errors."""

    def state(model: Nuisances, nodes: NDArray[np.float64], vector: NDArray[np.float64], shift: float) -> _State:
        # a^T C^-1 b of all with all, by one projection
        projected, own = model.project(nodes), model.project(vector[None, :])[0]
        return _State(nodes @ vector - projected @ own, nodes @ nodes.T - projected @ projected.T, shift)

    residual, nuisances = observed.residual, observed.nuisances
    result = [state(nuisances, table.nodes, residual, 0.0)]
    effective = curve.weights(np.array([strength]))[0] @ nuisances.solve_all(curve.responses)
    effective = credible(effective, nuisances.solve(residual), observed.places)
    for law_error, probability in observed.law_errors:
        extra = law_factors(curve, strength, effective, observed.groups, law_error)
        own = own_variance(curve, strength, effective, law_error)
        if extra or float(own.max()) >= LEAST_FACTOR:
            moved, nodes, wide, shift = with_law(residual, table.nodes, nuisances, extra, own)
            result.append(state(wide, nodes, moved, shift + math.log(probability)))
    return result


@dataclass(frozen=True, slots=True, kw_only=True)
class _PairStart:
    """An effect's best variant with the best variant of another: grid of strengths, log evidence over none (variants averaged).

    stronger: the one that alone has more evidence; moves: length of what the second one does, nuisances aside.
    """

    first: Curve
    second: Curve
    stronger: str
    grid: "_PairGrid"
    log_evidence: float
    moves: float

    @property
    def effects(self) -> tuple[str, str]:
        """The two, the first first."""
        return self.first.effect, self.second.effect

    @property
    def strengths(self) -> dict[str, float]:
        """Strengths of the highest likelihood, by effect."""
        return _by_effect(self.first, self.second, self.grid.best)

    @property
    def below(self) -> dict[str, float]:
        """How much more likely strengths below the plausible range are, by effect."""
        return _by_effect(self.first, self.second, self.grid.below)


def _start_pair(
    first: Single, second: Single, *, head: Curve, states: Sequence[_State], table: _NodeTable
) -> _PairStart:
    """The other's variants beside one of the first, `head`, which stands for all of them; the first's law alone is inexact."""
    a = head
    tried: list[tuple[float, _PairGrid, CurveFit]] = []
    stronger = (first if first.log_evidence >= second.log_evidence else second).best.curve.effect
    for fit in second.fits:
        rows = table.rows(a, fit.curve)
        grids = [
            _pair_integral(
                a, fit.curve, (state.linear[rows], state.gram[np.ix_(rows, rows)]), state.shift, stronger=stronger
            )
            for state in states
        ]
        grid = max(grids, key=lambda item: item.log_integral)
        tried.append((grid.log_integral, grid, fit))
    mean = float(log_mean_exp(np.array([item[0] for item in tried])))
    _, grid, chosen = max(tried, key=lambda item: item[0])
    b = chosen.curve
    rows = table.rows(a, b)[len(a.responses) :]
    weights_b = b.weights(np.array([grid.best[1]]))[0]
    moves = math.sqrt(max(float(weights_b @ states[0].gram[np.ix_(rows, rows)] @ weights_b), 0.0))
    others = first.log_evidence - first.best.log_evidence
    return _PairStart(first=a, second=b, stronger=stronger, grid=grid, log_evidence=others + mean, moves=moves)


def _turned(start: _PairStart, observed: Observed, singles: Mapping[str, Single], *, table: _NodeTable) -> _PairStart:
    """The pair with either effect's variant chosen anew beside the other's, by turns, for as long as that explains more."""
    best = start
    for _ in range(_MOST_TURNS):
        head, strength = best.second, best.strengths[best.second.effect]
        states = _states_of(head, strength, observed, table)
        found = _start_pair(singles[head.effect], singles[best.first.effect], head=head, states=states, table=table)
        if found.log_evidence <= best.log_evidence:
            break
        best = found
    return best


def _overlaps(
    starts: Sequence[_PairStart], singles: Mapping[str, Single], nuisances: Nuisances, table: _NodeTable
) -> NDArray[np.float64]:
    """Share of what the weaker effect of each pair does, nuisances aside, that lies where the stronger one does as much."""
    solved = nuisances.solve_all(table.nodes)
    result = np.ones(len(starts))
    for number, start in enumerate(starts):
        squares = [
            (curve.weights(np.array([strength]))[0] @ solved[table.rows(curve)]) ** 2
            for curve, strength in zip((start.first, start.second), start.grid.best, strict=True)
        ]
        first, second = (singles[effect].log_evidence for effect in start.effects)
        if first > second:
            squares.reverse()
        weaker, stronger = squares
        result[number] = float(np.sum(np.minimum(weaker, stronger))) / max(float(weaker.sum()), 1e-12)
    return result


def _finish_pair(
    observed: Observed, pair: _PairStart, law_errors: Sequence[tuple[float, float]], *, table: _NodeTable
) -> tuple[float, dict[str, tuple[float, float, float]], dict[str, Curve], dict[str, float]]:
    """Log evidence over none of two effects, strengths, the variants, and how much more likely strengths below their ranges are.

    Where the second moves the probes by so much that its own law matters, both may be off.
    """
    a, b, grid = pair.first, pair.second, pair.grid
    residual, nuisances, groups, places = observed.residual, observed.nuisances, observed.groups, observed.places
    value = grid.log_integral
    share = pair.log_evidence - value
    nodes = table.nodes[table.rows(a, b)]
    best: tuple[float, _PairGrid] = (value, grid)
    if law_errors and pair.moves * law_errors[0][0] > _LAW_MATTERS:
        solved, seen = nuisances.solve_all(nodes), nuisances.solve(residual)
        for law_error, probability in law_errors:
            start = grid.best
            for _ in range(2):
                effective_a = credible(a.weights(np.array([start[0]]))[0] @ solved[: len(a.responses)], seen, places)
                effective_b = credible(b.weights(np.array([start[1]]))[0] @ solved[len(a.responses) :], seen, places)
                extra = law_factors(a, start[0], effective_a, groups, law_error)
                extra = extra.and_of(law_factors(b, start[1], effective_b, groups, law_error))
                if not extra:
                    break
                own = own_variance(a, start[0], effective_a, law_error)
                own = own + own_variance(b, start[1], effective_b, law_error)
                moved, moved_nodes, wide, shift = with_law(residual, nodes, nuisances, extra, own)
                terms = _pair_terms(wide, moved_nodes, moved)
                again = _pair_integral(a, b, terms, shift + math.log(probability), stronger=pair.stronger)
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
        a.effect: interval_under(chosen.first, marginal_a),
        b.effect: interval_under(chosen.second, marginal_b),
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
    return model.inner(nodes, residual[None, :]).ravel(), model.inner(nodes, nodes)


def _pair_integral(
    a: Curve, b: Curve, terms: tuple[NDArray[np.float64], NDArray[np.float64]], shift: float, *, stronger: str
) -> _PairGrid:
    """Mean likelihood of two effects on a grid of both strengths that closes in on the best.

    Where a strength comes to lie at an end of its plausible range it is sought beyond, with little prior. Less of the weaker
    effect than is plausible gets its strength so, but no evidence: that is how it stands for what the stronger one's law leaves.
    """
    nodes = a.strengths, b.strengths

    def over(range_a: tuple[float, float], range_b: tuple[float, float]) -> _PairGrid:
        logs = [(math.log(low), math.log(high)) for low, high in (range_a, range_b)]
        value, at_a, at_b, grid = pair_integral(*nodes, *terms, *logs, _PAIR_NODES)
        if not math.isfinite(value):
            raise ValueError(f"the likelihood of {a.effect} and {b.effect} is no number")
        return _PairGrid(
            log_integral=value + shift, first=np.exp(at_a), second=np.exp(at_b), log_likelihood=grid + shift
        )

    def likelihood(of_a: NDArray[np.float64], of_b: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(pair_likelihood(*nodes, *terms, of_a, of_b))

    result = over((a.low, a.high), (b.low, b.high))
    best, top = result.best, float(result.log_likelihood.max()) - shift
    less_a, less_b = (
        curve.low * _BELOW if _at_ends(curve, at)[0] else None for curve, at in zip((a, b), best, strict=True)
    )
    below = (
        0.0 if less_a is None else float(likelihood(less_a, np.array([best[1]])).max()) - top,
        0.0 if less_b is None else float(likelihood(np.array([best[0]]), less_b).max()) - top,
    )
    ranges = [_reached(curve, at) for curve, at in zip((a, b), best, strict=True)]
    counted = [
        (low if curve.effect == stronger else max(low, curve.low), high)
        for curve, (low, high) in zip((a, b), ranges, strict=True)
    ]
    value = result.log_integral
    if counted != [(a.low, a.high), (b.low, b.high)]:
        result = over(*counted)
        value = float(np.logaddexp(math.log1p(-IMPLAUSIBLE) + value, math.log(IMPLAUSIBLE) + result.log_integral))
    if ranges != counted:
        result = over(*ranges)
    return replace(result, log_integral=value, below=below)


def _at_ends(curve: Curve, strength: float) -> tuple[bool, bool]:
    """Whether a strength lies at the lower and at the upper end of the plausible range."""
    return strength < 1.001 * curve.low, strength > 0.999 * curve.high


def _reached(curve: Curve, strength: float) -> tuple[float, float]:
    """The plausible range of a strength, or what is tried beyond the end that it lies at."""
    low, high = _at_ends(curve, strength)
    return curve.reach[0] if low else curve.low, curve.reach[1] if high else curve.high


class _Apart:
    """Evidence of effects in a part of the probes alone."""

    def __init__(self, observed: Observed) -> None:
        self._observed = observed
        self._within: dict[bytes, Nuisances] = {}
        self._found: dict[tuple[bytes, str], float] = {}

    def evidence(self, part: NDArray[np.bool_], fits: Sequence[CurveFit]) -> float:
        """Log evidence over none of an effect, its variants averaged, in the probes of `part` (probe,)."""
        if not np.any(part):
            return 0.0
        key, effect = np.packbits(part).tobytes(), fits[0].curve.effect
        if (key, effect) not in self._found:
            if key not in self._within:
                self._within[key] = Nuisances(self._observed.nuisances.factors[part])
            self._found[key, effect] = self._of(part, fits, self._within[key])
        return self._found[key, effect]

    def _of(self, part: NDArray[np.bool_], fits: Sequence[CurveFit], nuisances: Nuisances) -> float:
        found = [
            fit_curve(
                self._observed.residual[part],
                _of_probes(fit.curve, part),
                nuisances,
                self._observed.groups[part],
                places=self._observed.places[part],
                law_errors=self._observed.law_errors,
            ).log_evidence
            for fit in fits
        ]
        return float(log_mean_exp(np.array(found)))


def _of_probes(curve: Curve, part: NDArray[np.bool_]) -> Curve:
    return replace(
        curve,
        responses=curve.responses[:, part],
        spread=None if curve.spread is None else curve.spread[part],
        jitter=None if curve.jitter is None else curve.jitter[part],
        exact=None if curve.exact is None else curve.exact[part],
    )

"""Spreads that the noise leaves open: the best core of each way that quanta meet pixels, and tails of all laws with one of them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .spread_candidates import Candidate, best_of, criterion, starts_of
from .spread_changes import learn_changes
from .spread_families import LOG_REACH, TAIL, Family, reach_mass, share_density
from .spread_problem import SpreadProblem

FloatArray = NDArray[np.float64]
_OfReaches = list[tuple[float, Candidate]]  # a family at reaches of the tail, each with its share of all reaches
_REWEIGHTED = 3  # times: the power that the weights come from then no longer moves
_REACH_STEP = math.log(1.5)  # changes the gain by less than a share is known to
_STEPS = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0)  # standard deviations, at which share and reach are averaged over
_FINE_STEPS = 50  # between two of these shares, over which prior and likelihood are summed
_MOST_SD = 0.15  # of the share between such steps, which then reach over most of what it can be


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """Spreads that the data leave open.

    Fields: candidates; log_weights (candidate,): logarithms of their probabilities, but for a constant; inflation: chi-square a
    degree of freedom of the likeliest, 1 at least, which chi-squares are divided by.
    """

    candidates: tuple[Candidate, ...]
    log_weights: FloatArray
    inflation: float


@dataclass(frozen=True, slots=True)
class _Tails:
    """Spreads of one family and reach, the logarithm of that reach's prior probability, and the shares of light (share,) that their
    tails have; empty: one spread, of a share that nothing tells."""

    log_prior: float
    candidates: tuple[Candidate, ...]
    shares: tuple[float, ...] = ()

    def log_weights(self, least: float, inflation: float) -> FloatArray:
        """Logarithm of the probability that each stands for, chi-squares counted from the least."""
        above = (np.array([item.chi_square for item in self.candidates]) - least) / inflation
        if not self.shares:
            return np.asarray(self.log_prior - 0.5 * above)
        return self.log_prior + log_weights_of_shares(self.shares, above)


def members_of(problem: SpreadProblem) -> Members:
    """Spreads that the data leave open, with their probabilities.

    Tails are averaged over for the way that quanta meet pixels that is likelier with the best spread of any form.
    """
    cores = _cores(problem)
    general = {form: _of_reaches(problem, form) for form in problem.forms.general.values()}
    best, least = {}, {}
    for model in problem.prior:
        own = [item for item in cores if item.spread.model == model]
        best[model] = min([item for item in own if item.lit] or own, key=partial(criterion, problem))
        least[model] = likeliest([*own, *(item for _, item in general[problem.forms.general[model]])]).chi_square
    of_all = max(problem.prior, key=lambda model: math.log(problem.prior[model][0]) - 0.5 * least[model])
    found = []
    for model, (prior, no_tail) in problem.prior.items():
        if no_tail > 0.0:
            found.append(_Tails(math.log(prior * no_tail), (best[model],)))
        if model == of_all and no_tail < 1.0:
            found += _with_tails(problem, best[model], general, prior * (1.0 - no_tail))
    return _weighed(problem, found, _Tails(0.0, (best[of_all],)))


def _weighed(problem: SpreadProblem, found: Sequence[_Tails], otherwise: _Tails) -> Members:
    """All spreads found, or another one where each of them leaves a beam without quanta."""
    any_lit = any(item.lit for one in found for item in one.candidates)
    found = found if any_lit else [otherwise]
    candidates = [item for one in found for item in one.candidates]
    kept = [item.lit or not any_lit for item in candidates]
    least = min(item.chi_square for item, keep in zip(candidates, kept, strict=True) if keep)
    inflation = max(1.0, least / problem.independent)
    log_weights = np.concatenate([one.log_weights(least, inflation) for one in found])
    log_weights -= [0.5 * (criterion(problem, item) - item.chi_square) for item in candidates]
    return Members(
        tuple(item for item, keep in zip(candidates, kept, strict=True) if keep), log_weights[kept], inflation
    )


def likeliest(candidates: Sequence[Candidate]) -> Candidate:
    """The spread of the least chi-square."""
    return min(candidates, key=lambda item: item.chi_square)


def _cores(problem: SpreadProblem) -> list[Candidate]:
    """Families without a tail at their best; the weights are those of the best spread."""
    simplest, general = problem.forms.cores[0], problem.forms.general["aperture"]
    found: dict[str, Candidate] = {}
    for _ in range(_REWEIGHTED):
        for form in (simplest, general):
            starts = [found[form.name].theta] if form.name in found else starts_of(form)
            found[form.name] = best_of(problem, form, starts)
        best = min(found.values(), key=partial(criterion, problem))
        problem.reweight(best.spread, best.coefficients)
        learn_changes(problem, found[general.name])
    return [best_of(problem, form, starts_of(form)) for form in problem.forms.cores]


def _with_tails(
    problem: SpreadProblem, core: Candidate, known: Mapping[Family, _OfReaches], probability: float
) -> Iterator[_Tails]:
    """Spreads with this core and tails of all laws, reaches and shares.

    known: families whose reaches have been tried; probability: prior, of all tails.
    """
    for form in problem.forms.families:
        if form.model != core.spread.model or set(form.names) != {*core.form.names, *TAIL}:
            continue
        share_at = form.names.index("tail_share")
        for of_reach, best in known.get(form) or _of_reaches(problem, form):
            log_prior = math.log(probability * form.of_tails * of_reach)
            variance = best.parameter_variance("tail_share")
            if variance <= 0.0:
                yield _Tails(log_prior, (best,))
                continue
            shares = _about(float(best.theta[share_at]), min(math.sqrt(variance), _MOST_SD), (0.0, 1.0))
            yield _Tails(log_prior, tuple(best.with_share(problem, share) for share in shares), tuple(shares))


def log_weights_of_shares(shares: Sequence[float], chi_squares: FloatArray) -> FloatArray:
    """Logarithms of weights (share,), with which sums over these shares are integrals over prior and likelihood.

    Between two shares chi-square is interpolated, and what depends on the share is linear: near a share of 0 the prior and the
    likelihood fall by much from one of a few to the next.
    """
    from scipy.interpolate import PchipInterpolator

    nodes, least = np.asarray(shares), float(np.min(chi_squares))
    fine = np.linspace(nodes[0], nodes[-1], _FINE_STEPS * (len(nodes) - 1) + 1)
    prior = np.array([share_density(float(share)) for share in fine])
    likely = prior * np.exp(-0.5 * PchipInterpolator(nodes, chi_squares - least)(fine))
    hats = np.stack([np.interp(fine, nodes, one) for one in np.eye(len(nodes))])
    weight = np.trapezoid(hats * likely, fine, axis=1)
    return np.asarray(np.log(np.maximum(weight, np.finfo(np.float64).tiny)) - 0.5 * least)


def _of_reaches(problem: SpreadProblem, form: Family) -> _OfReaches:
    """The best spread of a family at each of some reaches of the tail, with its share of all reaches.

    Reaches stand at even steps; about the best one where it is known to less than a step.
    """
    place = form.names.index("log_tail_px")
    count = 1 + math.ceil((LOG_REACH[1] - LOG_REACH[0]) / _REACH_STEP)
    grid = np.linspace(*LOG_REACH, count)
    step = float(grid[1] - grid[0])
    found: _OfReaches = []
    starts = starts_of(form)
    for reach in grid:
        for start in starts:
            start[place] = reach
        item = best_of(problem, form, starts, fixed=("log_tail_px",))
        found.append((reach_mass(float(reach), step if grid[0] < reach < grid[-1] else 0.5 * step), item))
        starts = [item.theta.copy()]
    free = best_of(problem, form, [likeliest([item for _, item in found]).theta])
    sd = math.sqrt(max(free.parameter_variance("log_tail_px"), 0.0))
    if not 0.0 < sd < 0.5 * step:
        return found
    sharp = []
    for reach, width in _steps(float(free.theta[place]), sd, LOG_REACH):
        theta = free.theta.copy()
        theta[place] = reach
        sharp.append((reach_mass(reach, width), best_of(problem, form, [theta], fixed=("log_tail_px",))))
    return sharp


def _steps(middle: float, sd: float, bounds: tuple[float, float]) -> list[tuple[float, float]]:
    """Values about a middle, inside the bounds, and the width that each stands for."""
    values = _about(middle, sd, bounds)
    halves = 0.5 * np.diff(values, prepend=values[0], append=values[-1])
    return [(value, float(width)) for value, width in zip(values, halves[:-1] + halves[1:], strict=True)]


def _about(middle: float, sd: float, bounds: tuple[float, float]) -> list[float]:
    """Values about a middle, inside the bounds."""
    return [float(value) for value in np.unique(np.clip(middle + sd * np.array(_STEPS), *bounds))]

"""Spreads that the noise leaves open: the best core of each way that quanta meet pixels, and tails of all laws with one of them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .spread_candidates import Candidate, best_of, criterion, starts_of
from .spread_changes import learn_changes
from .spread_families import LOG_REACH, TAIL, Family, reach_mass, share_density
from .spread_problem import SpreadProblem

FloatArray = NDArray[np.float64]
Members = list[tuple[float, Candidate]]  # each with the logarithm of its weight before chi-square counts
_OfReaches = list[tuple[float, Candidate]]  # a family at reaches of the tail, each with its share of all reaches
_REWEIGHTED = 3  # times: the power that the weights come from then no longer moves
_REACH_STEP = math.log(1.5)  # changes the gain by less than a share is known to
_STEPS = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0)  # standard deviations, at which share and reach are averaged over
_FINE_STEPS = 50  # between two of these shares, over which prior and likelihood are summed
_MOST_SD = 0.15  # of the share between such steps, which then reach over most of what it can be


def members_of(problem: SpreadProblem) -> Members:
    """Spreads that the data leave open, with the logarithm of the weight of each before its chi-square counts.

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
        found.append((prior * no_tail, best[model]))
        if model == of_all:
            found += [
                (prior * (1.0 - no_tail) * mass, item) for mass, item in _with_tails(problem, best[model], general)
            ]
    return [
        (math.log(mass) - 0.5 * (criterion(problem, item) - item.chi_square), item)
        for mass, item in [one for one in found if one[0] > 0 and one[1].lit] or [(1.0, best[of_all])]
    ]


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
    problem: SpreadProblem, core: Candidate, known: Mapping[Family, _OfReaches]
) -> Iterator[tuple[float, Candidate]]:
    """Spreads with this core and tails of all laws, reaches and shares, each with its prior probability among tails.

    known: families whose reaches have been tried.
    """
    for form in problem.forms.families:
        if form.model != core.spread.model or set(form.names) != {*core.form.names, *TAIL}:
            continue
        share_at = form.names.index("tail_share")
        for of_reach, best in known.get(form) or _of_reaches(problem, form):
            variance = best.parameter_variance("tail_share")
            if variance <= 0.0:
                yield form.of_tails * of_reach, best
                continue
            sd = min(math.sqrt(variance), _MOST_SD)
            shares = _about(float(best.theta[share_at]), sd, (0.0, 1.0))
            items = [best.with_share(problem, share) for share in shares]
            for item, mass in zip(items, masses_of_shares(shares, [one.chi_square for one in items]), strict=True):
                yield form.of_tails * of_reach * mass, item


def masses_of_shares(shares: Sequence[float], chi_squares: Sequence[float]) -> FloatArray:
    """Prior mass (share,) for which each share stands, so that sums over the shares, weighted by their likelihoods, are integrals.

    Between two shares chi-square is interpolated, and what depends on the share is linear: near a share of 0 the prior and the
    likelihood fall by much from one of a few to the next.
    """
    from scipy.interpolate import PchipInterpolator

    nodes = np.asarray(shares)
    fine = np.linspace(nodes[0], nodes[-1], _FINE_STEPS * (len(nodes) - 1) + 1)
    chi_square = PchipInterpolator(nodes, chi_squares)(fine)
    likely = np.array([share_density(float(share)) for share in fine]) * np.exp(
        -0.5 * (chi_square - np.min(chi_squares))
    )
    hats = np.stack([np.interp(fine, nodes, one) for one in np.eye(len(nodes))])
    mass = np.trapezoid(hats * likely, fine, axis=1)
    return np.asarray(mass * np.exp(0.5 * (np.asarray(chi_squares) - np.min(chi_squares))))


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

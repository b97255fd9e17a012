"""Slow changes between frames: which series have them, how large they are, and what they leave open."""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from ...generator.spread.psf import Spread
from .spread_candidates import Candidate, normal_at
from .spread_normal import Normal
from .spread_problem import SpreadProblem

FloatArray = NDArray[np.float64]
# Changes of the beam's shape between series have one size, any standard deviation equally likely (Gelman, Bayesian Analysis 1
# (2006) 515); fewer pairs than these leave its mean square unbounded. Sizes are those at which the pair that tells most would
# tell it from none, times these.
_LEAST_CHANGES = 4
_CHANGE_SIZES = np.geomspace(1e-3, 1e6, 181)


def learn_changes(problem: SpreadProblem, item: Candidate) -> None:
    """Take from all pairs of series how far the beam's shape changes between two, which none of them exceeds by much.

    A change is relative to the level, so that bright pairs tell what dim ones may hold. Each pair's coefficients E and F are
    Gaussian about 0, with one standard deviation for all, relative to the level: its mean square over its posterior, whatever
    the spread is near that of `item`.
    """
    problem.slow_sd_DN2[:] = math.inf
    pairs = [
        (number, problem.slow_places(order))
        for order, number in enumerate(problem.drifting)
        if problem.series[number].change_DN2 > 0
    ]
    if len(pairs) < _LEAST_CHANGES:
        return
    coefficients, chi_square = problem.solve(item.spread)
    normal = normal_at(problem, item.form, item.theta, coefficients, range(len(item.theta)))
    unit_DN2 = np.repeat([problem.series[number].change_DN2 for number, _ in pairs], 2)
    own = [place for _, both in pairs for place in both]
    mean_square = _mean_square(normal, own, unit_DN2, max(1.0, chi_square / problem.independent))
    for number, _ in pairs:
        problem.slow_sd_DN2[number] = math.sqrt(mean_square) * problem.series[number].change_DN2


def _mean_square(normal: Normal, own: Sequence[int], unit: FloatArray, inflation: float) -> float:
    """Posterior mean of the squared size that coefficients have, in their units.

    Args:
        normal: normal equations with nothing known of these, all else that is fitted included.
        own: places of the coefficients.
        unit: of each.
        inflation: what chi-square is divided by.
    """
    rest = sorted(set(range(len(normal.right))) - set(own))
    others = Normal(normal.matrix[np.ix_(rest, rest)], normal.right[rest], normal.square)
    through = normal.matrix[np.ix_(own, rest)] @ others.covariance()
    information = normal.matrix[np.ix_(own, own)] - through @ normal.matrix[np.ix_(rest, own)]
    told = (normal.right[own] - through @ others.right) * unit
    known, directions = np.linalg.eigh(information * np.outer(unit, unit) / inflation)
    known, told = np.clip(known, 0.0, None), directions.T @ told / inflation
    size = _CHANGE_SIZES[:, None] / math.sqrt(float(known[-1]))
    raised = 1.0 + known * size**2
    evidence = np.sum(0.5 * (told * size) ** 2 / raised - 0.5 * np.log(raised), axis=1)
    # sizes are equally likely and stand at equal steps of their logarithm
    weight = np.exp(evidence - evidence.max()) * size[:, 0]
    return float(np.sum(weight * size[:, 0] ** 2) / weight.sum())


def find_drifting(problem: SpreadProblem, spread: Spread) -> tuple[int, ...]:
    """Series with slow changes: differences between series always, others where these stand out (Schwarz's criterion)."""
    lit = tuple(number for number, group in enumerate(problem.group) if group >= 0)
    every = copy(problem)
    every.drifting = lit
    coefficients, _ = every.solve(spread)
    normal = every.normal(every.in_cells(spread)).with_white_prior(every.white_prior(coefficients))
    covariance = normal.covariance()
    needed = math.log(max(problem.independent, 2.0))
    found = []
    for order, number in enumerate(lit):
        place = every.slow_places(order)
        own = coefficients[place]
        gained = float(own @ np.linalg.pinv(covariance[np.ix_(place, place)]) @ own)
        if number in problem.drifting or (own.sum() > 0 and gained > 2.0 * needed):
            found.append(number)
    return tuple(found)


def changed_as_power(problem: SpreadProblem, item: Candidate) -> tuple[FloatArray, FloatArray, float]:
    """What gains and slopes (group,) and read variance change by, DN and DN^2, where slow changes may only add power.

    Left free, their fitted power may fall below 0 at high frequencies, which white noise then makes good; held at 0, their
    own noise is taken from the quanta. What the choice changes is not known.
    """
    slow = [place for order in range(len(problem.drifting)) for place in problem.slow_places(order)]
    held, _ = problem.solve(item.spread, also=slow)
    quantum, white = np.split(held[: 2 * problem.groups], 2)
    slopes = quantum * item.variance_share + white
    moved_read = float(held[problem.read_place]) - item.read_DN2
    return np.asarray(quantum + white - item.gains), np.asarray(slopes - item.slopes), moved_read

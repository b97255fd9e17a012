"""Effects that act in some series only: which series those are."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, IndexArray
from ..model.changes import Variant
from .curve_fits import CurveFit
from .observed import Observed


@dataclass(frozen=True, slots=True, kw_only=True)
class InSome:
    """A variant that acts in some series alone, numbers of these, and their log probability against all."""

    variant: Variant
    series: tuple[int, ...]
    log_prior: float


def in_some_series(observed: Observed, fits: Sequence[CurveFit], series_of: IndexArray) -> InSome | None:
    """In which series one effect, of these fits, acts; None: no part of them explains more than all.

    Series are taken in one after the other, the one that explains most first, law and nuisances as in a fit to all. Any number of
    series is as likely as another, and so are all sets of so many. series_of: number of each probe's series (probe,).
    """
    best: InSome | None = None
    most = 0.0
    for fit in fits:
        for response in observed.scaled(fit.curve).responses:
            chosen, gain, log_prior = _chosen(observed, response, series_of)
            if chosen and gain > most:
                best, most = InSome(variant=fit.curve.variant, series=chosen, log_prior=log_prior), gain
    return best


def _chosen(observed: Observed, response: FloatArray, series_of: IndexArray) -> tuple[tuple[int, ...], float, float]:
    """Series of one response, the log evidence that they bring over all of them, and their log prior; none where that is no gain."""
    numbers = np.unique(series_of[np.abs(response) > 0.0])
    if len(numbers) < 2:
        return (), 0.0, 0.0
    parts = np.where(series_of == numbers[:, None], response, 0.0)
    linear = observed.nuisances.inner(parts, observed.residual[None, :])[:, 0]
    gram = observed.nuisances.inner(parts, parts)

    def explained(taken: list[int]) -> float:
        along, length = float(linear[taken].sum()), float(gram[np.ix_(taken, taken)].sum())
        return 0.5 * along**2 / length if along > 0.0 and length > 0.0 else 0.0

    whole = explained(list(range(len(numbers))))
    taken: list[int] = []
    found: tuple[list[int], float, float] = ([], 0.0, 0.0)
    while len(taken) < len(numbers) - 1:
        rest = [number for number in range(len(numbers)) if number not in taken]
        taken = [*taken, max(rest, key=lambda number: explained([*taken, number]))]
        log_prior = -math.log(len(numbers)) - math.log(math.comb(len(numbers), len(taken)))
        gain = explained(taken) + log_prior - whole
        if gain > found[1]:
            found = taken, gain, log_prior
    return tuple(int(numbers[number]) for number in sorted(found[0])), found[1], found[2]

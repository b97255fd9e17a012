"""What is random about an effect's law: a factor for each group of probes, a part of each probe's own, and what it does by chance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, vstack

from .curves import Curve
from .nuisances import Nuisances

# relative errors of an effect's law and how probable each is: real effects follow the catalogue's laws more or less well
LAW_ERRORS: tuple[tuple[float, float], ...] = ((0.10, 0.7), (0.30, 0.3))
LAW_PROBE_SHARE = 0.5  # of the law's error that is each probe's own
EXACT_LAW_ERROR = 0.03  # relative error of probes that a strength is defined by
LEAST_FACTOR = 0.05  # variance of a factor along itself that is worth carrying
_LEAST_MOVED = 0.3  # standard deviations of a probe by which what is random about a law must move one to be carried
_TIMES_SEEN = (
    1.5  # what a law predicts in a place over what is seen there, up to which it may be off by a share of itself
)


def credible(response: NDArray[np.float64], seen: NDArray[np.float64], places: NDArray[np.intp]) -> NDArray[np.float64]:
    """The part of a response (probe,) that its law's inaccuracy is a share of: in each place no more than `_TIMES_SEEN` what is seen.

    A law that predicts thousands of standard deviations where nothing is seen is wrong by all of them, not off by a share.
    """
    predicted = np.bincount(places, weights=response**2)
    found = np.bincount(places, weights=np.maximum(seen**2, 1.0))
    share = np.sqrt(np.minimum(1.0, _TIMES_SEEN**2 * found / np.maximum(predicted, 1e-12)))
    return np.asarray(response * share[places])


@dataclass(frozen=True, slots=True)
class LawFactors:
    """What is random about effects at their strengths.

    Fields: of_laws (factor, probe): a row for each group of probes and effect, what the law is off by there; spread (probe, factor):
    what the effects do by chance.
    """

    of_laws: csc_array
    spread: NDArray[np.float64]

    def __bool__(self) -> bool:
        return bool(self.of_laws.shape[0] or self.spread.shape[1])

    def and_of(self, other: "LawFactors") -> "LawFactors":
        """Of two effects."""
        return LawFactors(
            vstack([self.of_laws, other.of_laws], format="csc"), np.concatenate([self.spread, other.spread], axis=1)
        )

    def full(self) -> NDArray[np.float64]:
        """All of them (probe, factor)."""
        return np.concatenate([self.of_laws.toarray().T, self.spread], axis=1)


def law_factors(
    curve: Curve, strength: float, response: NDArray[np.float64], groups: NDArray[np.intp], law_error: float
) -> LawFactors:
    """What is random about an effect at a strength: its law's inaccuracy, and its own spread."""
    if curve.exact is not None:
        response = np.where(curve.exact, 0.0, response)
    spread = curve.spread
    if spread is None or float(np.max(np.abs(spread), initial=0.0)) * strength < _LEAST_MOVED:
        spread = np.zeros((len(response), 0))
    moves = float(np.max(np.abs(response), initial=0.0)) * law_error >= _LEAST_MOVED
    return LawFactors(group_factors(response, groups, law_error if moves else 0.0), spread * strength)


def group_factors(response: NDArray[np.float64], groups: NDArray[np.intp], sd: float) -> csc_array:
    """A row (factor, probe) a group: the response there times `sd`; groups in which it would move nothing are left out."""
    power = np.bincount(groups, weights=response**2)
    kept = sd**2 * power > LEAST_FACTOR
    inside = kept[groups]
    places = (np.cumsum(kept) - 1)[groups[inside]]
    starts = np.concatenate([[0], np.cumsum(inside)])
    return csc_array((sd * response[inside], places, starts), shape=(int(np.count_nonzero(kept)), len(response)))


def law_terms(
    curve: Curve, strength: float, groups: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What a law that is off as usual adds: factors (probe, factor) and each probe's own variance (probe,)."""
    response = curve.response(strength)
    usual = LAW_ERRORS[0][0]
    factors = law_factors(curve, strength, response, groups, usual).full()
    return factors, own_variance(curve, strength, response, usual)


def own_variance(
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
    effective = credible(effective, nuisances.solve(residual), groups if places is None else places)
    return _widened(
        nuisances,
        law_factors(curve, strength, effective, groups, law_error),
        own_variance(curve, strength, effective, law_error),
    )


def _widened(base: Nuisances, law: LawFactors, inexact: NDArray[np.float64]) -> Widened:
    """With what is random about a law, and more variance of each probe's own (probe,)."""
    root = np.sqrt(1.0 + inexact)
    return Widened(base.over(root, law.spread, law.of_laws), root)


def with_law(
    residual: NDArray[np.float64],
    nodes: NDArray[np.float64],
    base: Nuisances,
    law: LawFactors,
    inexact: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], Nuisances, float]:
    """Residual, nodes and nuisances once an effect's law may be off, and the bare residual's change of log likelihood.

    Args:
        residual, nodes, base: as they were.
        law: what is random in groups and by chance.
        inexact: variance of each probe's own (probe,).
    """
    found = _widened(base, law, inexact)
    wide, root = found.nuisances, found.root
    moved, moved_nodes = residual / root, nodes / root
    before, after = residual[None, :], moved[None, :]
    quadratic = float(moved @ moved - np.sum(wide.project(after) ** 2)) - float(
        residual @ residual - np.sum(base.project(before) ** 2)
    )
    determinant = 2.0 * float(np.sum(np.log(root))) + wide.log_determinant - base.log_determinant
    return moved, moved_nodes, wide, -0.5 * (determinant + quadratic)

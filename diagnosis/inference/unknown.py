"""What no catalogue holds: more variance in some families of probes than anything known gives them.

In how many families an unknown effect shows is not known: every number of them is as likely as another.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ...generator.effects import EFFECTS
from ..arrays import FloatArray, IndexArray
from .observed import Observed

SIZES = np.geomspace(0.5, 5000.0, 14)  # standard deviations
LOG_DENSITY = -math.log(math.log(SIZES[-1] / SIZES[0]))  # of their logarithm, where every size is as likely
_SWEEPS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Families:
    """Families of probes: one axis of the series of one kind and scene, or what shows in it that one effect alone can make."""

    of: IndexArray  # (probe,): number of each probe's family
    names: tuple[str, ...]
    exact: frozenset[int] = frozenset()  # numbers of those in which one effect alone shows
    # kind of each family's series (empty: several) and axis; nothing where that is not known
    of_kind: tuple[tuple[str, str], ...] = ()

    def reached_by(self, effects: Collection[str]) -> frozenset[int]:
        """Numbers of those in which laws of effects can leave anything; an effect that the catalogue does not hold can in all."""
        known = [EFFECTS.get(effect) for effect in effects]
        return frozenset(
            number
            for number, place in enumerate(self.of_kind or (("", ""),) * len(self.names))
            if number not in self.exact and any(effect is None or effect.reaches(*place) for effect in known)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtraVariance:
    """What a residual shows beyond what may vary."""

    log_evidence: float  # over none, of an unknown effect
    place: str  # family of probes in which it is seen most
    variance: FloatArray  # (probe,), squares of standard deviations of the first probes

    @property
    def length(self) -> float:
        """Root of the sum of the extra variances of all probes."""
        return math.sqrt(float(np.sum(self.variance)))


def fit_extra_variance(
    observed: Observed, families: Families, *, left_by: Collection[str] | None = None
) -> ExtraVariance:
    """What a residual shows beyond what may vary, in families of probes; left_by: in those that laws of these effects reach.

    Every family may have an extra variance tau^2, log-uniform over a grid; the evidence is that of the best combination (each
    family's tau in turn, several sweeps), its prior in it, of one family at least.
    """
    members = [np.nonzero(families.of == number)[0] for number in range(len(families.names))]
    reached = frozenset(range(len(members))) if left_by is None else families.reached_by(left_by)
    open_ones = [number for number, part in enumerate(members) if len(part) and number in reached]
    if not open_ones:
        return ExtraVariance(log_evidence=-math.inf, place="", variance=np.zeros(len(observed.residual)))
    sizes = np.array([len(part) for part in members])
    count = len(open_ones)
    grid = np.concatenate([[0.0], SIZES])
    weighted = _Weighted(observed, members)
    alone = np.full((len(members), len(grid)), -np.inf)
    base, best = weighted.log_likelihood, -math.inf
    for _ in range(_SWEEPS):
        changed = False
        for g in open_ones:
            others = int(np.count_nonzero(np.delete(weighted.weights, g) < 1.0))
            found = weighted.at_each(g, 1.0 / (1.0 + grid**2))
            if not others:
                alone[g] = found
            found = found + _price(others, count)
            found[1:] += _price(others + 1, count) - _price(others, count)
            at = int(np.argmax(found))
            weight = 1.0 / (1.0 + grid[at] ** 2)
            if weight != weighted.weights[g]:
                changed = True
                weighted.weigh(g, weight)
            best = float(found[at])
        if not changed:
            break
    tau2 = 1.0 / weighted.weights - 1.0
    own = alone[:, 1:] - base
    if not np.any(tau2):
        best = float(own.max()) + _price(1, count) + base
        place = int(np.unravel_index(int(np.argmax(own)), own.shape)[0])
    else:
        place = int(np.argmax(tau2 * sizes))
    variance = tau2[families.of] * observed.units**2
    return ExtraVariance(log_evidence=best - base, place=families.names[place], variance=variance)


def _price(shown: int, count: int) -> float:
    """Log prior of certain `shown` of `count` families at certain sizes; 0 of none, which is no such effect."""
    if not shown:
        return 0.0
    ways = math.lgamma(count + 1) - math.lgamma(shown + 1) - math.lgamma(count - shown + 1)
    return -math.log(count) - ways - shown * math.log(len(SIZES))


class _Weighted:
    """The likelihood of a residual with each family of probes counting so much, kept up to date as weights change."""

    def __init__(self, observed: Observed, members: Sequence[IndexArray]) -> None:
        """All families count in full; members: probes of each."""
        self._factors, self._residual, self._members = observed.nuisances.full(), observed.residual, members
        self.weights = np.ones(len(members))  # one over the variance of the probes of each family
        self._normal = np.eye(self._factors.shape[1]) + self._factors.T @ self._factors
        self._asked = self._factors.T @ self._residual
        self._squares = float(self._residual @ self._residual)
        self._settle()

    def weigh(self, family: int, weight: float) -> None:
        """Let a family count so much from here on."""
        more = weight - self.weights[family]
        factors, residual = self._factors[self._members[family]], self._residual[self._members[family]]
        self._normal += more * (factors.T @ factors)
        self._asked += more * (factors.T @ residual)
        self._squares += more * float(residual @ residual)
        self.weights[family] = weight
        self._settle()

    def _settle(self) -> None:
        from scipy.linalg import solve_triangular

        self._root: FloatArray = np.asarray(np.linalg.cholesky(self._normal))
        self._left = solve_triangular(self._root, self._asked, lower=True, check_finite=False)
        sizes = np.array([len(part) for part in self._members])
        spread = float(sizes @ np.log(self.weights)) - self._squares
        explained = float(self._left @ self._left) - 2.0 * float(np.sum(np.log(np.diag(self._root))))
        self.log_likelihood = 0.5 * (spread + explained)  # but for a constant

    def at_each(self, family: int, weights: FloatArray) -> FloatArray:
        """The log likelihood with one family counting as much as each of some weights (weight,) has it.

        With N = L L^T the nuisances' precision, S = L^-1 F^T (factor, probe) of the family and S^T S = V D V^T, more weight d makes
        N + d F^T F of it, whose inverse and determinant are those of N with 1 + d D along the columns of S V.
        """
        from scipy.linalg import solve_triangular

        part = self._members[family]
        residual, more = self._residual[part], weights - self.weights[family]
        seen = solve_triangular(self._root, self._factors[part].T, lower=True, check_finite=False)
        own = seen @ residual
        most = 1.0 / self.weights[family]  # N holds the family's own part, so that D is less than this
        if len(part) <= len(seen):
            values, vectors = np.linalg.eigh(seen.T @ seen)
            values = np.clip(values, 0.0, most)
            of_left, of_own = vectors.T @ (seen.T @ self._left), values * (vectors.T @ residual)
        else:
            values, vectors = np.linalg.eigh(seen @ seen.T)
            values = np.clip(values, 0.0, most)
            of_left, of_own = np.sqrt(values) * (vectors.T @ self._left), np.sqrt(values) * (vectors.T @ own)
        grown = 1.0 + np.multiply.outer(more, values)
        along = of_left + np.multiply.outer(more, of_own)
        explained = 2.0 * more * float(own @ self._left) + more**2 * float(own @ own)
        explained -= np.sum(more[:, None] * along**2 / grown, axis=1)
        spread = len(part) * np.log(weights / self.weights[family]) - more * float(residual @ residual)
        return np.asarray(self.log_likelihood + 0.5 * (spread + explained - np.sum(np.log(grown), axis=1)))

"""What no catalogue holds: more variance in some families of probes than anything known gives them.

In how many families an unknown effect shows is not known: every number of them is as likely as another.
"""

import math
from collections.abc import Collection
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
    residual, nuisances = observed.residual, observed.nuisances
    factors = nuisances.full()
    members = [np.nonzero(families.of == number)[0] for number in range(len(families.names))]
    reached = frozenset(range(len(members))) if left_by is None else families.reached_by(left_by)
    open_ones = [number for number, part in enumerate(members) if len(part) and number in reached]
    if not open_ones:
        return ExtraVariance(log_evidence=-math.inf, place="", variance=np.zeros(len(residual)))
    grams = np.stack([factors[part].T @ factors[part] for part in members])
    sums = np.stack([factors[part].T @ residual[part] for part in members])
    squares = np.array([float(np.sum(residual[part] ** 2)) for part in members])
    sizes = np.array([len(part) for part in members])
    count = len(open_ones)
    grid = np.concatenate([[0.0], SIZES])
    normal = np.eye(factors.shape[1]) + grams.sum(axis=0)
    tau2 = np.zeros(len(members))
    alone = np.full((len(members), len(grid)), -np.inf)
    base, best = 0.0, -math.inf
    for sweep in range(_SWEEPS):
        changed = False
        for g in open_ones:
            part = members[g]
            weights = 1.0 / (1.0 + tau2)
            weights[g] = 0.0
            without = normal - grams[g] / (1.0 + tau2[g])
            rest: FloatArray = np.asarray(np.linalg.cholesky(without))
            found = _at_each(1.0 / (1.0 + grid**2), rest, weights @ sums, factors[part], residual[part])
            weights[g] = 1.0
            found += 0.5 * float(sizes @ np.log(weights) - (weights @ squares - squares[g]))
            others = int(np.count_nonzero(np.delete(tau2, g)))
            if sweep == 0 and not others:
                base = float(found[0])
                alone[g] = found
            found = found + _price(others, count)
            found[1:] += _price(others + 1, count) - _price(others, count)
            at = int(np.argmax(found))
            changed |= bool(grid[at] ** 2 != tau2[g])
            tau2[g] = grid[at] ** 2
            normal = without + grams[g] / (1.0 + tau2[g])
            best = float(found[at])
        if not changed:
            break
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


def _at_each(
    weights: FloatArray, rest: FloatArray, vector: FloatArray, factors: FloatArray, residual: FloatArray
) -> FloatArray:
    """Log likelihood (weight,) with the probes of one group counting so much, but for a constant that they do not change.

    weights: one over these probes' variance (weight,); rest: Cholesky factor of the precision of nuisances that all others leave
    (factor, factor); vector: what these say of them (factor,); factors (probe, factor) and residual (probe,): of the group.
    """
    from scipy.linalg import solve_triangular

    right = np.concatenate([factors, vector[None, :]]).T
    solved = solve_triangular(rest, right, lower=True, check_finite=False).T
    across, asked = solved[:-1], solved[-1]
    values, vectors = np.linalg.eigh(across @ across.T)
    values = np.maximum(values, 0.0)
    own = across.T @ residual
    # both along the eigenvectors of what the group sees of the nuisances
    of_asked, of_own = vectors.T @ (across @ asked), values * (vectors.T @ residual)
    grown = 1.0 + np.multiply.outer(weights, values)
    along = of_asked + np.multiply.outer(weights, of_own)
    explained = float(asked @ asked) + 2.0 * weights * float(asked @ own) + weights**2 * float(own @ own)
    explained -= np.sum(weights[:, None] * along**2 / grown, axis=1)
    determinant = 2.0 * float(np.sum(np.log(np.diag(rest)))) + np.sum(np.log(grown), axis=1)
    spread = len(residual) * np.log(weights) - weights * float(residual @ residual)
    return np.asarray(0.5 * (spread + explained - determinant))

"""Evidence of an effect that no catalogue holds: more variance in some families of probes than anything known gives them."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .nuisances import Nuisances

UNKNOWN_SHARE = 0.1  # of the groups of probes in which an effect outside the catalogue shows
_UNKNOWN_TAU = np.geomspace(0.5, 5000.0, 14)
_SWEEPS = 4


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

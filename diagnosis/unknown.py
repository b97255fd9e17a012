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
    parts = [np.nonzero(groups == number)[0] for number in range(len(names))]
    factors = nuisances.factors
    grams = np.stack([factors[part].T @ factors[part] for part in parts])
    sums = np.stack([factors[part].T @ residual[part] for part in parts])
    squares = np.array([float(np.sum(residual[part] ** 2)) for part in parts])
    sizes = np.array([len(part) for part in parts])
    grid = np.concatenate([[0.0], _UNKNOWN_TAU])
    cost = math.log(UNKNOWN_SHARE / len(_UNKNOWN_TAU))
    one = np.eye(factors.shape[1])
    tau2 = np.zeros(len(parts))
    alone: list[tuple[float, int]] = []
    base = best = 0.0
    for sweep in range(_SWEEPS):
        changed = False
        for g, part in enumerate(parts):
            if not len(part):
                continue
            weights = 1.0 / (1.0 + tau2)
            weights[g] = 0.0
            rest: NDArray[np.float64] = np.asarray(np.linalg.cholesky(one + np.tensordot(weights, grams, axes=1)))
            found = _at_each(1.0 / (1.0 + grid**2), rest, weights @ sums, factors[part], residual[part])
            weights[g] = 1.0
            found += 0.5 * float(sizes @ np.log(weights) - (weights @ squares - squares[g]))
            if sweep == 0 and not np.any(np.delete(tau2, g)):
                base = float(found[0])
                alone.append((float(max(found[1:])) + cost, g))
            found[1:] += cost
            at = int(np.argmax(found))
            changed |= bool(grid[at] ** 2 != tau2[g])
            tau2[g] = grid[at] ** 2
            best = float(found[at]) + cost * float(np.count_nonzero(np.delete(tau2, g)))
        if not changed:
            break
    if not np.any(tau2):
        best, place = max(alone)
    else:
        place = int(np.argmax(tau2 * sizes))
    return best - base, str(names[place])


def _at_each(
    weights: NDArray[np.float64],
    rest: NDArray[np.float64],
    vector: NDArray[np.float64],
    factors: NDArray[np.float64],
    residual: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Log likelihood (weight,) with the probes of one group counting so much, but for a constant that they do not change.

    Args:
        weights: of these probes, one over their variance (weight,).
        rest: Cholesky factor of the precision of the nuisances that all others leave (factor, factor).
        vector: what the others say of the nuisances (factor,).
        factors, residual: of the group's probes (probe, factor), (probe,).
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

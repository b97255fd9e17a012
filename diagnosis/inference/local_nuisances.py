"""Factor model of nuisances most of which touch one block of probes alone, none integrated out before.

I + F^T F is an arrow: a small matrix a block, and what all share along its last rows. Its Cholesky factor is one too.
"""

import numpy as np
from numpy.typing import NDArray


class LocalNuisances:
    """r ~ N(m, C), C = I + F F^T: what nuisances take up, and what is known of each once the probes are seen."""

    def __init__(self, factors: NDArray[np.float64], blocks: NDArray[np.intp]) -> None:
        """`factors` (probe, factor): response to one prior standard deviation of each nuisance; `blocks` (probe,): block of each."""
        self.factors = factors
        of_block, shared = local_columns(factors, blocks)
        width = len(shared)
        self._order = np.concatenate([*of_block.values(), shared])
        across = np.ascontiguousarray(factors[:, shared])
        normal = np.eye(width) + across.T @ across
        self._parts: list[tuple[slice, NDArray[np.float64], NDArray[np.float64]]] = []
        start = 0
        for block, columns in of_block.items():
            members = np.nonzero(blocks == block)[0]
            own = factors[np.ix_(members, columns)]
            lower: NDArray[np.float64] = np.asarray(np.linalg.cholesky(np.eye(len(columns)) + own.T @ own))
            coupling = _half(lower, own.T @ across[members])
            normal -= coupling.T @ coupling
            self._parts.append((slice(start, start + len(columns)), lower, coupling))
            start += len(columns)
        self._across = slice(start, start + width)
        self._cholesky: NDArray[np.float64] = np.asarray(np.linalg.cholesky(normal))

    def fitted(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Most probable nuisances (factor,), in prior standard deviations, for a residual (probe,)."""
        return np.asarray(self._solved((self.factors.T @ vector)[:, None])[:, 0])

    def solve(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 vector (probe,)."""
        return np.asarray(vector - self.factors @ self.fitted(vector))

    def solve_all(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 of each of the vectors (vector, probe): what the nuisances leave of them."""
        return np.asarray(vectors - (self.factors @ self._solved(self.factors.T @ vectors.T)).T)

    def given_others(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Each probe (probe,) as the others do not tell it, in standard deviations: (C^-1 r)_i / sqrt((C^-1)_ii)."""
        return np.asarray(self.solve(vector) / np.sqrt(np.maximum(self.precision, 1e-12)))

    @property
    def precision(self) -> NDArray[np.float64]:
        """Diagonal (probe,) of C^-1: what of each probe's variance the others do not tell."""
        return np.asarray(1.0 - self.known_of(self.factors))

    def known_of(self, factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance (probe,) that the nuisances, fitted on the own probes, still give to probes with these factors."""
        return np.asarray(np.sum(self._halved(factors.T) ** 2, axis=0))

    def _halved(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """L^-1 of (factor, vector), in the arrow's order."""
        right = right[self._order]
        across = right[self._across]
        for part, lower, coupling in self._parts:
            there = np.flatnonzero(np.any(right[part], axis=0))  # of many vectors few touch a block's own nuisances
            if not there.size:
                continue
            own = _half(lower, right[part, there])
            right[part, there] = own
            across[:, there] -= coupling.T @ own
        right[self._across] = _half(self._cholesky, across)
        return right

    def _solved(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """(I + F^T F)^-1 of (factor, vector)."""
        from scipy.linalg import solve_triangular

        half = self._halved(right)
        across = solve_triangular(self._cholesky, half[self._across], lower=True, trans="T", check_finite=False)
        half[self._across] = across
        for part, lower, coupling in self._parts:
            half[part] = solve_triangular(
                lower, half[part] - coupling @ across, lower=True, trans="T", check_finite=False
            )
        result = np.empty_like(half)
        result[self._order] = half
        return result


def local_columns(
    factors: NDArray[np.float64], blocks: NDArray[np.intp]
) -> tuple[dict[int, NDArray[np.intp]], NDArray[np.intp]]:
    """Columns of factors (probe, factor) that touch one block alone (or none), by block, and those that touch several."""
    numbers, inverse = np.unique(blocks, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    starts = np.searchsorted(inverse[order], np.arange(len(numbers)))
    touches = np.logical_or.reduceat((factors != 0.0)[order], starts, axis=0)
    alone = np.count_nonzero(touches, axis=0) <= 1
    place = np.argmax(touches, axis=0)
    found = {int(number): np.nonzero(alone & (place == at))[0] for at, number in enumerate(numbers)}
    return {block: columns for block, columns in found.items() if len(columns)}, np.nonzero(~alone)[0]


def _half(lower: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.linalg import solve_triangular

    return np.asarray(solve_triangular(lower, right, lower=True, check_finite=False))

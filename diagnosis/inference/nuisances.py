"""Factor model of the nuisances: r ~ N(m, C) with C = I + F F^T, for probes of which most nuisances touch one block alone.

A nuisance that touches one block of probes only (the series of one placement of a scene, or one flat) can be integrated
out within the block: C_b = I + F_b F_b^T = L_b L_b^T, and L_b^-1 makes residuals, responses and the shared factors
of the block standardised again (`Whitening`). What is left is the same likelihood with a tenth of the factors (`Nuisances`).
Where single nuisances are asked for, none is integrated out before (`LocalNuisances`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csc_array, vstack

from ..arrays import BoolArray, FloatArray, IndexArray, RealArray
from ..model.curves import Curve, places_of


class Nuisances:
    """C = I + F F^T + E E^T: what of a vector is left when nuisances may take up what they can.

    `factors` F (probe, factor) are full; `of_laws` E^T (factor, probe), if any, are sparse, as the laws of effects give them: a
    column a group of probes and effect. E is integrated out first: with one effect it costs no more than its entries.
    """

    def __init__(self, factors: FloatArray, of_laws: csc_array | None = None) -> None:
        """Both give the response to one prior standard deviation of each nuisance."""
        self.factors = factors
        self.of_laws = of_laws if of_laws is not None and of_laws.shape[0] else None
        normal = np.eye(factors.shape[1]) + factors.T @ factors
        self.log_determinant = 0.0
        if self.of_laws is not None:
            self._laws = _root_of_laws(self.of_laws)
            self._shared = _half(self._laws, self.of_laws @ factors)
            normal -= self._shared.T @ self._shared
            self.log_determinant = _log_determinant(self._laws)
        self._cholesky: FloatArray = np.asarray(np.linalg.cholesky(normal))
        self.log_determinant += _log_determinant(self._cholesky)

    def over(self, root: FloatArray, factors: FloatArray, of_laws: csc_array) -> "Nuisances":
        """With more factors of both kinds, of probes whose standard deviations are `root` (probe,) times as large."""
        inverse = 1.0 / root
        wider = self.factors if not factors.shape[1] else np.concatenate([self.factors, factors], axis=1)
        every = of_laws if self.of_laws is None else vstack([self.of_laws, of_laws], format="csc")
        data = every.data * np.repeat(inverse, np.diff(every.indptr))
        scaled = csc_array((data, every.indices, every.indptr), shape=every.shape)
        return Nuisances(wider * inverse[:, None], scaled)

    def full(self) -> FloatArray:
        """All factors (probe, factor)."""
        if self.of_laws is None:
            return self.factors
        return np.concatenate([self.factors, self.of_laws.toarray().T], axis=1)

    def of_probes(self, probes: BoolArray) -> "Nuisances":
        """Of some of its probes (probe,)."""
        return Nuisances(
            self.factors[probes], None if self.of_laws is None else self.of_laws[:, np.flatnonzero(probes)]
        )

    def project(self, vectors: FloatArray) -> FloatArray:
        """z (vector, factor) with a^T C^-1 b = a.b - z_a.z_b for vectors (vector, probe)."""
        return self._projected(self.factors.T @ vectors.T, None if self.of_laws is None else self.of_laws @ vectors.T)

    def project_each(self) -> FloatArray:
        """The same (probe, factor) of each probe by itself."""
        return self._projected(self.factors.T, None if self.of_laws is None else self.of_laws.toarray())

    def _projected(self, of_factors: FloatArray, of_laws: FloatArray | None) -> FloatArray:
        """z (vector, factor), from factors times vectors (factor, vector) of both kinds."""
        if of_laws is None:
            return _half(self._cholesky, of_factors).T
        own = _half(self._laws, of_laws)
        right = of_factors - self._shared.T @ own
        return np.concatenate([own, _half(self._cholesky, right)]).T

    def inner(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Matrix a C^-1 b^T for a (i, probe), b (j, probe)."""
        left = self.project(a)
        return np.asarray(a @ b.T - left @ (left if b is a else self.project(b)).T)

    def solve(self, vector: FloatArray) -> FloatArray:
        """C^-1 vector (probe,)."""
        return np.asarray(self.solve_all(vector[None, :])[0])

    def solve_all(self, vectors: FloatArray) -> FloatArray:
        """C^-1 of each of the vectors (vector, probe): what the nuisances leave of them."""
        from scipy.linalg import cho_solve

        right = self.factors.T @ vectors.T
        if self.of_laws is None:
            fitted = cho_solve((self._cholesky, True), right, check_finite=False)
            return np.asarray(vectors - fitted.T @ self.factors.T)
        own = _half(self._laws, self.of_laws @ vectors.T)
        fitted = cho_solve((self._cholesky, True), right - self._shared.T @ own, check_finite=False)
        of_laws = _half(self._laws, own - self._shared @ fitted, transposed=True)
        return np.asarray(vectors - fitted.T @ self.factors.T - (self.of_laws.T @ of_laws).T)


def _root_of_laws(of_laws: csc_array) -> RealArray:
    """L of I + E^T E = L L^T; its diagonal (factor,) where no probe has two of the columns."""
    if int(np.max(np.diff(of_laws.indptr), initial=0)) <= 1:
        squares = np.bincount(of_laws.indices, weights=of_laws.data**2, minlength=of_laws.shape[0])
        return np.asarray(np.sqrt(1.0 + squares))
    return np.linalg.cholesky(np.eye(of_laws.shape[0]) + (of_laws @ of_laws.T).toarray())


def _log_determinant(root: RealArray) -> float:
    """Of L L^T; root: L, or its diagonal alone."""
    return 2.0 * float(np.sum(np.log(root if root.ndim == 1 else np.diag(root))))


class Whitening:
    """Integrates out every factor that lies within one block; `factors` are the shared ones that are left, whitened."""

    def __init__(self, factors: FloatArray, blocks: IndexArray) -> None:
        """`factors` (probe, factor), `blocks` (probe,): block of each probe."""
        of_block, shared = local_columns(factors, blocks)
        self._members = []
        self._lower = []
        for block in np.unique(blocks):
            members = np.nonzero(blocks == block)[0]
            own = factors[np.ix_(members, of_block.get(int(block), np.zeros(0, np.intp)))]
            self._members.append(members)
            self._lower.append(np.linalg.cholesky(np.eye(len(members)) + own @ own.T))
        self.factors: FloatArray = np.ascontiguousarray(self.apply(factors[:, shared].T).T)

    def apply(self, vectors: FloatArray) -> FloatArray:
        """Vectors (vector, probe) with unit noise once the local nuisances are integrated out."""
        result = np.zeros(vectors.shape)
        for members, lower in zip(self._members, self._lower, strict=True):
            own = vectors[:, members]
            there = np.flatnonzero(np.any(own, axis=1))
            if there.size:
                result[np.ix_(there, members)] = _half(lower, own[there].T).T
        return result

    def undo(self, whitened: FloatArray) -> FloatArray:
        """Vectors (vector, probe) as they were before `apply`."""
        result = np.zeros(whitened.shape)
        for members, lower in zip(self._members, self._lower, strict=True):
            result[:, members] = whitened[:, members] @ lower.T
        return result

    def variances(self, variances: FloatArray) -> FloatArray:
        """Variances (probe,) of independent extra noise of the probes, as they are in whitened ones."""
        result = np.empty_like(variances)
        for members, lower in zip(self._members, self._lower, strict=True):
            inverse = _half(lower, np.eye(len(members)))
            result[members] = inverse**2 @ variances[members]
        return result

    def curves(self, curves: Sequence[Curve]) -> tuple[Curve, ...]:
        """Curves with their responses whitened."""
        if not curves:
            return ()
        each = [curve.responses for curve in curves]
        whole = self.apply(np.concatenate(each))
        result = []
        for curve, place in zip(curves, places_of(each), strict=True):
            spread = None if curve.spread is None else np.ascontiguousarray(self.apply(curve.spread.T).T)
            jitter = None if curve.jitter is None else self.variances(curve.jitter)
            result.append(replace(curve, responses=whole[place], spread=spread, jitter=jitter))
        return tuple(result)


class LocalNuisances:
    """What nuisances take up, none integrated out before, and what is known of each once the probes are seen.

    I + F^T F is an arrow: a small matrix a block, and what all share along its last rows. Its Cholesky factor is one too.
    """

    def __init__(self, factors: FloatArray, blocks: IndexArray) -> None:
        """`factors` (probe, factor): response to one prior standard deviation of each nuisance; `blocks` (probe,): block of each."""
        self.factors = factors
        of_block, shared = local_columns(factors, blocks)
        width = len(shared)
        self._order = np.concatenate([*of_block.values(), shared])
        across = np.ascontiguousarray(factors[:, shared])
        normal = np.eye(width) + across.T @ across
        self._parts: list[tuple[slice, FloatArray, FloatArray]] = []
        start = 0
        for block, columns in of_block.items():
            members = np.nonzero(blocks == block)[0]
            own = factors[np.ix_(members, columns)]
            lower: FloatArray = np.asarray(np.linalg.cholesky(np.eye(len(columns)) + own.T @ own))
            coupling = _half(lower, own.T @ across[members])
            normal -= coupling.T @ coupling
            self._parts.append((slice(start, start + len(columns)), lower, coupling))
            start += len(columns)
        self._across = slice(start, start + width)
        self._cholesky: FloatArray = np.asarray(np.linalg.cholesky(normal))

    def fitted(self, vector: FloatArray) -> FloatArray:
        """Most probable nuisances (factor,), in prior standard deviations, for a residual (probe,)."""
        half = self._halved((self.factors.T @ vector)[:, None])
        across = _half(self._cholesky, half[self._across], transposed=True)
        half[self._across] = across
        for part, lower, coupling in self._parts:
            half[part] = _half(lower, half[part] - coupling @ across, transposed=True)
        result = np.empty(len(half))
        result[self._order] = half[:, 0]
        return result

    def solve(self, vector: FloatArray) -> FloatArray:
        """C^-1 vector (probe,)."""
        return np.asarray(vector - self.factors @ self.fitted(vector))

    def given_others(self, vector: FloatArray) -> FloatArray:
        """Each probe (probe,) as the others do not tell it, in standard deviations: (C^-1 r)_i / sqrt((C^-1)_ii)."""
        return np.asarray(self.solve(vector) / np.sqrt(np.maximum(self.precision, 1e-12)))

    @property
    def precision(self) -> FloatArray:
        """Diagonal (probe,) of C^-1: what of each probe's variance the others do not tell."""
        return np.asarray(1.0 - self.known_of(self.factors))

    def known_of(self, factors: FloatArray) -> FloatArray:
        """Variance (probe,) that the nuisances, fitted on the own probes, still give to probes with these factors."""
        return np.asarray(np.sum(self._halved(factors.T) ** 2, axis=0))

    def _halved(self, right: FloatArray) -> FloatArray:
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


def local_columns(factors: FloatArray, blocks: IndexArray) -> tuple[dict[int, IndexArray], IndexArray]:
    """Columns of factors (probe, factor) that touch one block alone (or none), by block, and those that touch several."""
    numbers, inverse = np.unique(blocks, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    starts = np.searchsorted(inverse[order], np.arange(len(numbers)))
    touches = np.logical_or.reduceat((factors != 0.0)[order], starts, axis=0)
    alone = np.count_nonzero(touches, axis=0) <= 1
    place = np.argmax(touches, axis=0)
    found = {int(number): np.nonzero(alone & (place == at))[0] for at, number in enumerate(numbers)}
    return {block: columns for block, columns in found.items() if len(columns)}, np.nonzero(~alone)[0]


def _half(lower: RealArray, right: FloatArray, *, transposed: bool = False) -> FloatArray:
    """L^-1 right, or L^-T right, for a triangle L, or a diagonal (row,) that stands for one."""
    from scipy.linalg import solve_triangular

    if lower.ndim == 1:
        return np.asarray(right / lower[:, None])
    return np.asarray(solve_triangular(lower, right, lower=True, trans="T" if transposed else "N", check_finite=False))

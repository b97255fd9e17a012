"""Factor model of the nuisances: r ~ N(m, C) with C = I + F F^T + E E^T, of which only projections are needed."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, vstack


class Nuisances:
    """Factor model of the nuisances: what of a vector is left when they may take up what they can.

    `factors` F (probe, factor) are full; `of_laws` E^T (factor, probe), if any, are sparse, as the laws of effects give them: a
    column a group of probes and effect. E is integrated out first: with one effect it costs no more than its entries.
    """

    def __init__(self, factors: NDArray[np.float64], of_laws: csc_array | None = None) -> None:
        """Both give the response to one prior standard deviation of each nuisance."""
        self.factors = factors
        self.of_laws = of_laws if of_laws is not None and of_laws.shape[0] else None
        normal = np.eye(factors.shape[1]) + factors.T @ factors
        self.log_determinant = 0.0
        if self.of_laws is not None:
            self._laws = _RootOfLaws(self.of_laws)
            self._shared = self._laws.half(self.of_laws @ factors)
            normal -= self._shared.T @ self._shared
            self.log_determinant = self._laws.log_determinant
        self._cholesky: NDArray[np.float64] = np.asarray(np.linalg.cholesky(normal))
        self.log_determinant += 2.0 * float(np.sum(np.log(np.diag(self._cholesky))))

    def over(self, root: NDArray[np.float64], factors: NDArray[np.float64], of_laws: csc_array) -> "Nuisances":
        """With more factors of both kinds, of probes whose standard deviations are `root` (probe,) times as large."""
        inverse = 1.0 / root
        wider = self.factors if not factors.shape[1] else np.concatenate([self.factors, factors], axis=1)
        every = of_laws if self.of_laws is None else vstack([self.of_laws, of_laws], format="csc")
        return Nuisances(wider * inverse[:, None], _scaled(every, inverse))

    def full(self) -> NDArray[np.float64]:
        """All factors (probe, factor)."""
        if self.of_laws is None:
            return self.factors
        return np.concatenate([self.factors, self.of_laws.toarray().T], axis=1)

    def of_probes(self, probes: NDArray[np.bool_]) -> "Nuisances":
        """Of some of its probes (probe,)."""
        return Nuisances(
            self.factors[probes], None if self.of_laws is None else self.of_laws[:, np.flatnonzero(probes)]
        )

    def project(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """z (vector, factor) with a^T C^-1 b = a.b - z_a.z_b for vectors (vector, probe)."""
        return self._projected(self.factors.T @ vectors.T, None if self.of_laws is None else self.of_laws @ vectors.T)

    def project_each(self) -> NDArray[np.float64]:
        """The same (probe, factor) of each probe by itself."""
        return self._projected(self.factors.T, None if self.of_laws is None else self.of_laws.toarray())

    def _projected(self, of_factors: NDArray[np.float64], of_laws: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """z (vector, factor), from factors times vectors (factor, vector) of both kinds."""
        from scipy.linalg import solve_triangular

        if of_laws is None:
            return np.asarray(solve_triangular(self._cholesky, of_factors, lower=True, check_finite=False).T)
        own = self._laws.half(of_laws)
        right = of_factors - self._shared.T @ own
        return np.concatenate([own, solve_triangular(self._cholesky, right, lower=True, check_finite=False)]).T

    def inner(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Matrix a C^-1 b^T for a (i, probe), b (j, probe)."""
        left = self.project(a)
        return np.asarray(a @ b.T - left @ (left if b is a else self.project(b)).T)

    def solve(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 vector (probe,)."""
        return np.asarray(self.solve_all(vector[None, :])[0])

    def solve_all(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 of each of the vectors (vector, probe): what the nuisances leave of them."""
        from scipy.linalg import cho_solve

        right = self.factors.T @ vectors.T
        if self.of_laws is None:
            fitted = cho_solve((self._cholesky, True), right, check_finite=False)
            return np.asarray(vectors - fitted.T @ self.factors.T)
        own = self._laws.half(self.of_laws @ vectors.T)
        fitted = cho_solve((self._cholesky, True), right - self._shared.T @ own, check_finite=False)
        of_laws = self._laws.transposed_half(own - self._shared @ fitted)
        return np.asarray(vectors - fitted.T @ self.factors.T - (self.of_laws.T @ of_laws).T)


class _RootOfLaws:
    """L of I + E^T E = L L^T; a diagonal where no probe has two of the columns."""

    def __init__(self, of_laws: csc_array) -> None:
        if int(np.max(np.diff(of_laws.indptr), initial=0)) <= 1:
            squares = np.bincount(of_laws.indices, weights=of_laws.data**2, minlength=of_laws.shape[0])
            self._root = np.sqrt(1.0 + squares)
            self.log_determinant = 2.0 * float(np.sum(np.log(self._root)))
        else:
            self._root = np.linalg.cholesky(np.eye(of_laws.shape[0]) + (of_laws @ of_laws.T).toarray())
            self.log_determinant = 2.0 * float(np.sum(np.log(np.diag(self._root))))

    def half(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """L^-1 right (factor, vector)."""
        from scipy.linalg import solve_triangular

        if self._root.ndim == 1:
            return np.asarray(right / self._root[:, None])
        return np.asarray(solve_triangular(self._root, right, lower=True, check_finite=False))

    def transposed_half(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """L^-T right (factor, vector)."""
        from scipy.linalg import solve_triangular

        if self._root.ndim == 1:
            return np.asarray(right / self._root[:, None])
        return np.asarray(solve_triangular(self._root, right, lower=True, trans="T", check_finite=False))


def _scaled(of_laws: csc_array, factor: NDArray[np.float64]) -> csc_array:
    """Columns of (factor, probe) times `factor` (probe,)."""
    data = of_laws.data * np.repeat(factor, np.diff(of_laws.indptr))
    return csc_array((data, of_laws.indices, of_laws.indptr), shape=of_laws.shape)

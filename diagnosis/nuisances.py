"""Factor model of the nuisances: r ~ N(m, C) with C = I + F F^T, of which only projections are needed."""

import numpy as np
from numpy.typing import NDArray


class Nuisances:
    """Factor model of the nuisances: what of a vector is left when they may take up what they can."""

    def __init__(self, factors: NDArray[np.float64], cholesky: NDArray[np.float64] | None = None) -> None:
        """`factors` (probe, factor): response to one prior standard deviation of each nuisance."""
        self.factors = factors
        self._cholesky: NDArray[np.float64] = (
            np.asarray(np.linalg.cholesky(np.eye(factors.shape[1]) + factors.T @ factors))
            if cholesky is None
            else cholesky
        )
        self.log_determinant = 2.0 * float(np.sum(np.log(np.diag(self._cholesky))))

    def project(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """z (vector, factor) with a^T C^-1 b = a.b - z_a.z_b for vectors (vector, probe)."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self._cholesky, self.factors.T @ vectors.T, lower=True).T)

    def inner(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Matrix a C^-1 b^T for a (i, probe), b (j, probe)."""
        return np.asarray(a @ b.T - self.project(a) @ self.project(b).T)

    def solve(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 vector (probe,)."""
        from scipy.linalg import cho_solve

        return np.asarray(vector - self.factors @ cho_solve((self._cholesky, True), self.factors.T @ vector))

    def solve_all(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 of each of the vectors (vector, probe): what the nuisances leave of them."""
        from scipy.linalg import cho_solve

        return np.asarray(vectors - cho_solve((self._cholesky, True), self.factors.T @ vectors.T).T @ self.factors.T)

    def fitted(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Most probable nuisances (factor,), in prior standard deviations, for a residual (probe,)."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve((self._cholesky, True), self.factors.T @ vector))

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance (factor,) of nuisances once the probes are seen, prior variance 1."""
        from scipy.linalg import solve_triangular

        half = solve_triangular(self._cholesky, np.eye(len(self._cholesky)), lower=True)
        return np.asarray(np.sum(half**2, axis=0))

    @property
    def half(self) -> NDArray[np.float64]:
        """L^-1 F^T (factor, probe): C^-1 = I - half^T half."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self._cholesky, self.factors.T, lower=True))

    def predicted_sd(self, factors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviations (probe,) of other probes with these factors, once the nuisances are fitted on the own ones."""
        from scipy.linalg import solve_triangular

        half = solve_triangular(self._cholesky, factors.T, lower=True)
        return np.asarray(np.sqrt(1.0 + np.sum(half**2, axis=0)))

    def widened(self, extra: NDArray[np.float64]) -> "Nuisances":
        """With more factors (probe, extra); what is known of the old ones is used again."""
        from scipy.linalg import solve_triangular

        old, new = self.factors.shape[1], extra.shape[1]
        below = solve_triangular(self._cholesky, self.factors.T @ extra, lower=True).T
        corner = np.eye(new) + extra.T @ extra - below @ below.T
        cholesky = np.zeros((old + new, old + new))
        cholesky[:old, :old] = self._cholesky
        cholesky[old:, :old] = below
        cholesky[old:, old:] = np.linalg.cholesky(corner)
        return Nuisances(np.concatenate([self.factors, extra], axis=1), cholesky)

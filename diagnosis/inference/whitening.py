"""Local nuisances taken out first, so that inference has to carry only the few that all series share.

A nuisance that touches one block of probes only (the series of one placement of a scene, or one flat) can be integrated
out within the block: C_b = I + F_b F_b^T = L_b L_b^T, and L_b^-1 makes residuals, responses and the shared factors
of the block standardised again. What is left is the same likelihood with a tenth of the factors.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..model.curves import Curve
from .local_nuisances import local_columns


class Whitening:
    """Integrates out every factor that lies within one block; `factors` are the shared ones that are left, whitened."""

    def __init__(self, factors: NDArray[np.float64], blocks: NDArray[np.intp]) -> None:
        """`factors` (probe, factor), `blocks` (probe,): block of each probe."""
        of_block, shared = local_columns(factors, blocks)
        self._members = []
        self._lower = []
        for block in np.unique(blocks):
            members = np.nonzero(blocks == block)[0]
            own = factors[np.ix_(members, of_block.get(int(block), np.zeros(0, np.intp)))]
            self._members.append(members)
            self._lower.append(np.linalg.cholesky(np.eye(len(members)) + own @ own.T))
        self.factors: NDArray[np.float64] = np.ascontiguousarray(self.apply(factors[:, shared].T).T)

    def apply(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vectors (vector, probe) with unit noise once the local nuisances are integrated out."""
        from scipy.linalg import solve_triangular

        result = np.zeros(vectors.shape)
        for members, lower in zip(self._members, self._lower, strict=True):
            own = vectors[:, members]
            there = np.flatnonzero(np.any(own, axis=1))
            if there.size:
                result[np.ix_(there, members)] = solve_triangular(lower, own[there].T, lower=True, check_finite=False).T
        return result

    def undo(self, whitened: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vectors (vector, probe) as they were before `apply`."""
        result = np.zeros(whitened.shape)
        for members, lower in zip(self._members, self._lower, strict=True):
            result[:, members] = whitened[:, members] @ lower.T
        return result

    def variances(self, variances: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variances (probe,) of independent extra noise of the probes, as they are in whitened ones."""
        from scipy.linalg import solve_triangular

        result = np.empty_like(variances)
        for members, lower in zip(self._members, self._lower, strict=True):
            inverse = solve_triangular(lower, np.eye(len(members)), lower=True, check_finite=False)
            result[members] = inverse**2 @ variances[members]
        return result

    def curves(self, curves: Sequence[Curve]) -> tuple[Curve, ...]:
        """Curves with their responses whitened."""
        if not curves:
            return ()
        whole = self.apply(np.concatenate([curve.responses for curve in curves]))
        position = 0
        result = []
        for curve in curves:
            spread = None if curve.spread is None else np.ascontiguousarray(self.apply(curve.spread.T).T)
            jitter = None if curve.jitter is None else self.variances(curve.jitter)
            responses = whole[position : position + len(curve.responses)]
            result.append(replace(curve, responses=responses, spread=spread, jitter=jitter))
            position += len(curve.responses)
        return tuple(result)

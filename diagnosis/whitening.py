"""Local nuisances taken out first, so that inference has to carry only the few that all series share.

A nuisance that touches one block of probes only (the series of one placement of a scene, or one flat) can be integrated
out within the block: C_b = I + F_b F_b^T = L_b L_b^T, and L_b^-1 makes residuals, responses and the shared factors
of the block standardised again. What is left is the same likelihood with a tenth of the factors.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .inference import Curve


@dataclass(frozen=True, slots=True, kw_only=True)
class WhitenedProblem:
    """Residual (probe,), shared factors (probe, factor) and curves after the local nuisances are integrated out."""

    residual: NDArray[np.float64]
    factors: NDArray[np.float64]
    curves: tuple[Curve, ...]


def whiten(
    residual: NDArray[np.float64],
    factors: NDArray[np.float64],
    curves: tuple[Curve, ...],
    blocks: NDArray[np.intp],
) -> WhitenedProblem:
    """Integrate out every factor that lies within one block.

    Args:
        residual: (probe,), unit noise.
        factors: (probe, factor).
        curves: responses to effects.
        blocks: block of each probe (probe,).
    """
    from scipy.linalg import solve_triangular

    touched = np.abs(factors) > 0
    first = np.array([blocks[np.argmax(column)] for column in touched.T], dtype=np.intp)
    local = np.array([bool(np.all(blocks[touched[:, i]] == first[i])) for i in range(factors.shape[1])], dtype=bool)
    parts = [residual[None, :], factors[:, ~local].T]
    for curve in curves:
        parts.append(curve.responses)
        if curve.spread is not None:
            parts.append(curve.spread.T)
    stack = np.concatenate(parts, axis=0)
    result = np.empty_like(stack)
    for block in np.unique(blocks):
        members = np.nonzero(blocks == block)[0]
        own = factors[np.ix_(members, np.nonzero(local & (first == block))[0])]
        lower = np.linalg.cholesky(np.eye(len(members)) + own @ own.T)
        result[:, members] = solve_triangular(lower, stack[:, members].T, lower=True, check_finite=False).T
    shared = int((~local).sum())
    position = 1 + shared
    whitened = []
    for curve in curves:
        responses = result[position : position + len(curve.responses)]
        position += len(curve.responses)
        spread = None
        if curve.spread is not None:
            spread = np.ascontiguousarray(result[position : position + curve.spread.shape[1]].T)
            position += curve.spread.shape[1]
        whitened.append(replace(curve, responses=responses, spread=spread))
    return WhitenedProblem(
        residual=result[0], factors=np.ascontiguousarray(result[1 : 1 + shared].T), curves=tuple(whitened)
    )

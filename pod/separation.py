"""Separation: data in which some size parts hits from misses, so that no finite curve is the most likely one."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def check_separation(design: Array, hits: Array, misses: Array) -> bool:
    """True where no finite maximum-likelihood curve exists.

    With one size column: the hits and the misses do not overlap (a shared end point is still separated). With more
    columns: a linear programme looks for a direction v with design v >= 0 at every hit, <= 0 at every miss, not all
    zero. All hits or all misses count as separated. Holds for every log-concave link.

    Args:
        design: (row, coefficient), intercept first.
        hits, misses: (row,), counts.

    Source: Albert & Anderson, Biometrika 71 (1984) 1; Konis, D.Phil. thesis, Oxford (2007).
    """
    hit, miss = hits > 0, misses > 0
    if not hit.any() or not miss.any():
        return True
    if design.shape[1] == 1:
        return False
    if design.shape[1] == 2:
        x = design[:, 1]
        lowest_hit, highest_hit = x[hit].min(), x[hit].max()
        lowest_miss, highest_miss = x[miss].min(), x[miss].max()
        if lowest_hit == highest_hit == lowest_miss == highest_miss:
            return False  # constant size: not separated, but no slope either
        return bool(highest_miss <= lowest_hit or highest_hit <= lowest_miss)
    from scipy.optimize import linprog

    scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
    signed = np.concatenate((design[hit], -design[miss])) / scale
    # maximise sum(signed v) with signed v >= 0 and |v| <= 1: above zero means a separating direction
    answer = linprog(-signed.sum(axis=0), A_ub=-signed, b_ub=np.zeros(len(signed)), bounds=(-1, 1), method="highs")
    return bool(answer.status == 0 and -answer.fun > 1e-7)


def separated_batch(x: Array, hits: Array, misses: Array) -> NDArray[np.bool_]:
    """`check_separation` for many fits on one size column: x (row,), hits and misses (fit, row) -> (fit,)."""
    hit, miss = hits > 0, misses > 0
    lowest_hit = np.where(hit, x, np.inf).min(axis=1)
    highest_hit = np.where(hit, x, -np.inf).max(axis=1)
    lowest_miss = np.where(miss, x, np.inf).min(axis=1)
    highest_miss = np.where(miss, x, -np.inf).max(axis=1)
    return np.asarray((highest_miss <= lowest_hit) | (highest_hit <= lowest_miss))

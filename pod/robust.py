"""Sandwich covariance of a pooled curve whose trials repeat networks or images."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .likelihood import Curve
from .trials import Trials

Array = NDArray[np.float64]


def score_rows(table: Trials, curve: Curve, *, log_size: bool) -> Array:
    """Contribution of each row to the score of (c0, c1), (row, 2)."""
    x = np.log(table.size) if log_size else table.size
    parts = curve.link.log_parts(curve.coefficients[0] + curve.coefficients[1] * x)
    first = table.hits * parts.log_hit_1 + table.misses * parts.log_miss_1
    return np.asarray(np.stack((first, first * x), axis=1))


def bread(table: Trials, curve: Curve, *, log_size: bool) -> Array:
    """Inverse of the observed information of (c0, c1), (2, 2)."""
    x = np.log(table.size) if log_size else table.size
    parts = curve.link.log_parts(curve.coefficients[0] + curve.coefficients[1] * x)
    weight = -(table.hits * parts.log_hit_2 + table.misses * parts.log_miss_2)
    design = np.stack((np.ones_like(x), x), axis=1)
    return np.asarray(np.linalg.inv((design * weight[:, None]).T @ design))


def clustered_meat(
    left: Array, right: Array, groups: list[NDArray[np.intp]], groups_right: list[NDArray[np.intp]] | None = None
) -> Array:
    """Sum over clusters of (sum of left scores) (sum of right scores)', multi-way by inclusion and exclusion; (2, 2).

    Args:
        left, right: (row, 2), score contributions (the same array for a variance).
        groups: one array of codes (row,) a way of clustering, of the left rows.
        groups_right: the same for the right rows, on shared codes; None = `groups`.
    """
    other = groups if groups_right is None else groups_right
    meat = np.zeros((left.shape[1], right.shape[1]))
    for ways in range(1, len(groups) + 1):
        for chosen in combinations(range(len(groups)), ways):
            code_left, code_right = _joined([groups[w] for w in chosen], [other[w] for w in chosen])
            count = int(max(code_left.max(), code_right.max())) + 1
            total_left = np.zeros((count, left.shape[1]))
            total_right = np.zeros((count, right.shape[1]))
            np.add.at(total_left, code_left, left)
            np.add.at(total_right, code_right, right)
            factor = count / (count - 1) if ways == 1 and count > 1 else 1.0
            meat += (-1) ** (ways + 1) * factor * total_left.T @ total_right
    return meat


def clustered_covariance(table: Trials, curve: Curve, *, groups: list[NDArray[np.intp]], log_size: bool) -> Array:
    """Cluster-robust covariance of (c0, c1), (2, 2); never below the largest one-way covariance in any direction."""
    scores = score_rows(table, curve, log_size=log_size)
    inner = bread(table, curve, log_size=log_size)
    meat = clustered_meat(scores, scores, groups)
    values, vectors = np.linalg.eigh(meat)
    if len(groups) > 1 and values.min() <= 0:
        # the difference of ways need not be positive; the sum of the ways is, and errs to the wide side
        meat = sum((clustered_meat(scores, scores, [codes]) for codes in groups), np.zeros((2, 2)))
    del vectors
    return np.asarray(inner @ meat @ inner)


def few_clusters_factor(clusters: int) -> float:
    """What to multiply a clustered covariance by so that normal quantiles serve: (t / z)^2 at 97.5 %, clusters - 1."""
    from scipy.special import stdtrit

    return float((stdtrit(max(clusters - 1, 1), 0.975) / 1.959963984540054) ** 2)


def _joined(left: list[NDArray[np.intp]], right: list[NDArray[np.intp]]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    code_left, code_right = left[0], right[0]
    for next_left, next_right in zip(left[1:], right[1:], strict=True):
        base = int(max(next_left.max(), next_right.max())) + 1
        both = np.concatenate((code_left * base + next_left, code_right * base + next_right))
        codes = np.unique(both, return_inverse=True)[1]
        code_left, code_right = codes[: len(code_left)], codes[len(code_left) :]
    return code_left, code_right

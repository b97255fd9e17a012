"""Variances of a pooled curve whose trials repeat networks or images."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..results import ByValue
from .few_groups import satterthwaite
from .likelihood import Curve
from .trials import Trials

Array = NDArray[np.float64]

FEWEST_CLUSTERS = 3  # with two, 91 % of one-sided 95 % bounds covered (validation/pod_coverage.py, shared luck)


def score_rows(table: Trials, curve: Curve, *, log_size: bool) -> Array:
    """Contribution of each row to the score of (c0, c1), (row, 2)."""
    x = np.log(table.size) if log_size else table.size
    parts = curve.link.log_parts(curve.coefficients[0] + curve.coefficients[1] * x)
    first = table.hits * parts.log_hit_1 + table.misses * parts.log_miss_1
    return np.asarray(np.stack((first, first * x), axis=1))


def information_rows(table: Trials, curve: Curve, *, log_size: bool) -> Array:
    """Contribution of each row to the expected information on (c0, c1), (row, 2, 2)."""
    x = np.log(table.size) if log_size else table.size
    parts = curve.link.log_parts(curve.coefficients[0] + curve.coefficients[1] * x)
    weight = -(table.hits + table.misses) * parts.log_hit_1 * parts.log_miss_1
    design = np.stack((np.ones_like(x), x), axis=1)
    return np.asarray(weight[:, None, None] * design[:, :, None] * design[:, None, :])


def bread(table: Trials, curve: Curve, *, log_size: bool) -> Array:
    """Inverse of the observed information of (c0, c1), (2, 2)."""
    x = np.log(table.size) if log_size else table.size
    parts = curve.link.log_parts(curve.coefficients[0] + curve.coefficients[1] * x)
    weight = -(table.hits * parts.log_hit_2 + table.misses * parts.log_miss_2)
    design = np.stack((np.ones_like(x), x), axis=1)
    return np.asarray(np.linalg.inv((design * weight[:, None]).T @ design))


def clustered_meat(left: Array, right: Array, groups: list[NDArray[np.intp]]) -> Array:
    """Sum over clusters of (sum of left scores) (sum of right scores)', multi-way by inclusion and exclusion; (2, 2).

    Args:
        left, right: (row, 2), score contributions (the same array for a variance).
        groups: one array of codes (row,) a way of clustering.
    """
    meat = np.zeros((left.shape[1], right.shape[1]))
    for ways in range(1, len(groups) + 1):
        for chosen in combinations(range(len(groups)), ways):
            code = _joined([groups[way] for way in chosen])
            count = int(code.max()) + 1
            total_left = np.zeros((count, left.shape[1]))
            total_right = np.zeros((count, right.shape[1]))
            np.add.at(total_left, code, left)
            np.add.at(total_right, code, right)
            factor = count / (count - 1) if ways == 1 and count > 1 else 1.0
            meat += (-1) ** (ways + 1) * factor * total_left.T @ total_right
    return meat


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Way(ByValue):
    """One way of clustering: what each cluster does to the coefficients when it is left out.

    steps: (cluster, coefficient), minus the change. information: (cluster, coefficient, coefficient), of each cluster's looks.
    """

    steps: Array
    information: Array

    def variance(self, direction: Array) -> tuple[Array, Array]:
        """Jackknife variance (CR3) of direction . coefficients, and Bell and McCaffrey's degrees of freedom; both (...).

        Args:
            direction: (..., coefficient).
        """
        clusters = len(self.steps)
        value = (clusters - 1) / clusters * ((direction @ self.steps.T) ** 2).sum(axis=-1)
        whole = self.information.sum(axis=0)
        inverse = np.linalg.inv(whole)
        # under independent looks the steps are u_g' s_g with covariance diag(e) - F' J^-1 F; df = trace^2 / sum of squares
        rest = np.linalg.inv(whole - self.information)
        u = np.einsum("gij,...j->...gi", rest, direction)
        f = np.einsum("gij,...gj->...gi", self.information, u)
        e = np.einsum("...gi,...gi->...g", u, f)
        spent = np.einsum("...gi,ij,...gj->...g", f, inverse, f)
        cross = inverse @ np.einsum("...gi,...gj->...ij", f, f)
        squares = (e**2).sum(axis=-1) - 2 * (e * spent).sum(axis=-1) + np.einsum("...ij,...ji->...", cross, cross)
        with np.errstate(divide="ignore", invalid="ignore"):
            freedom = (e - spent).sum(axis=-1) ** 2 / squares
        # rounding may give less than nothing where a direction rests on one cluster
        return np.asarray(value), np.asarray(np.where(freedom >= 1, np.minimum(freedom, clusters - 1), 1.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Clustered(ByValue):
    """Variances of a pooled curve that hold with repeated and with few networks and images.

    V = max(V_network + V_image - V_cell, V_network, V_image), each by the jackknife, V_cell of the looks of a network at an
    image. Degrees of freedom after Satterthwaite.
    Source: Cameron, Gelbach & Miller, J. Bus. Econ. Stat. 29 (2011) 238, doi:10.1198/jbes.2010.07136; Bell & McCaffrey, Surv.
    Methodol. 28 (2002) 169; Hillis, Stat. Med. 26 (2007) 596, doi:10.1002/sim.2532.
    """

    ways: tuple[Way, ...]
    cells: Array

    def covariance(self) -> Array:
        """Of the coefficients together, (coefficient, coefficient); the sum of the ways where their difference is none."""
        each = [(len(way.steps) - 1) / len(way.steps) * way.steps.T @ way.steps for way in self.ways]
        total = sum(each, np.zeros_like(self.cells))
        less = total - self.cells if len(each) > 1 else total
        return np.asarray(less if np.linalg.eigvalsh(less).min() > 0 else total)

    def variance(self, direction: Array) -> tuple[Array, Array]:
        """Variance of direction . coefficients and its degrees of freedom, both (...); direction (..., coefficient)."""
        found = [way.variance(direction) for way in self.ways]
        if len(found) == 1:
            return found[0]
        each = np.stack([value for value, _ in found])
        cells = np.einsum("...i,ij,...j->...", direction, self.cells, direction)
        total = np.maximum(each.sum(axis=0) - cells, each.max(axis=0))
        return total, satterthwaite(total, found)


def leave_out(scores: Array, information: Array, codes: NDArray[np.intp]) -> Way | None:
    """One way of clustering; None where the others do not fix the coefficients once a cluster is left out.

    Args:
        scores: (row, coefficient), contributions to the score.
        information: (row, coefficient, coefficient), contributions to the expected information.
        codes: (row,), cluster of each row.
    """
    clusters, width = int(codes.max()) + 1, scores.shape[1]
    score = np.zeros((clusters, width))
    np.add.at(score, codes, scores)
    each = np.zeros((clusters, width, width))
    np.add.at(each, codes, information)
    rest = each.sum(axis=0) - each
    scale = np.sqrt(np.einsum("gii->gi", rest))
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.linalg.det(rest / scale[:, :, None] / scale[:, None, :])
    # a determinant of correlations this small is rounding
    if not np.all(even > 1e-10):
        return None
    return Way(steps=np.linalg.solve(rest, score[..., None])[..., 0], information=each)


def clustered_fit(scores: Array, information: Array, groups: list[NDArray[np.intp]]) -> Clustered | None:
    """Variances of a fit's coefficients, clustered in one or two ways; None where nothing tells them.

    That is so with fewer than three clusters, and where one cluster alone holds up the fit.

    Args:
        scores: (row, coefficient), contributions to the score.
        information: (row, coefficient, coefficient), contributions to the information.
        groups: one array of codes (row,) a way of clustering.
    """
    if any(int(codes.max()) + 1 < FEWEST_CLUSTERS for codes in groups):
        return None
    ways = [leave_out(scores, information, codes) for codes in groups]
    whole = [way for way in ways if way is not None]
    if len(whole) < len(ways):
        return None
    width = scores.shape[1]
    cells = np.zeros((width, width))
    if len(groups) > 1:
        codes = _joined(groups)
        totals = np.zeros((int(codes.max()) + 1, width))
        np.add.at(totals, codes, scores)
        inner = np.linalg.inv(information.sum(axis=0))
        cells = inner @ totals.T @ totals @ inner
    return Clustered(ways=tuple(whole), cells=cells)


def clustered_curve(table: Trials, curve: Curve, *, groups: list[NDArray[np.intp]], log_size: bool) -> Clustered | None:
    """`clustered_fit` of (c0, c1).

    Args:
        table: the trials.
        curve: the pooled curve fitted to them.
        groups: one array of codes (row,) a way of clustering.
        log_size: whether the curve is on ln size.
    """
    information = information_rows(table, curve, log_size=log_size)
    return clustered_fit(score_rows(table, curve, log_size=log_size), information, groups)


def clustered_total(rows: Array, groups: list[NDArray[np.intp]]) -> tuple[float, float]:
    """Variance of a sum of contributions and its degrees of freedom, by the rule of `Clustered`.

    Args:
        rows: (row,), contributions that add up to about 0.
        groups: one array of codes (row,) a way of clustering.
    """
    sums = [np.bincount(codes, weights=rows) for codes in groups]
    ways = [(float((one**2).sum()) * len(one) / max(len(one) - 1, 1), float(max(len(one) - 1, 1))) for one in sums]
    if len(ways) == 1:
        return ways[0]
    cells = float((np.bincount(_joined(groups), weights=rows) ** 2).sum())
    total = max(sum(value for value, _ in ways) - cells, *(value for value, _ in ways))
    return total, float(satterthwaite(total, ways))


def _joined(groups: list[NDArray[np.intp]]) -> NDArray[np.intp]:
    """One code (row,) for each combination of codes that occurs."""
    code = groups[0]
    for other in groups[1:]:
        code = np.unique(code * (int(other.max()) + 1) + other, return_inverse=True)[1]
    return code

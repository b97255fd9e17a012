"""Spread of the difference of two a90 whose tables share networks or images, by leaving each of these out.

Both curves are fitted again without one network, or without one image, in both tables at once. With d_g the change of the
difference a90_second - a90_first, G the number of networks or of images,

    V = sum_g d_g^2 (G - 1) / G

holds all that comes with a network or an image: what it does to both tables alike drops out of d_g, what it does to one
of them (the noise of one exposure, which all networks see) stays. Networks and images add up as in `robust.Clustered`.
Each a90 has its variance by the same rule, so that the three agree: an influence function in their place, without the
refits, is short where few images lie on the rise of the curve.

Source: Efron & Stein, Ann. Stat. 9 (1981) 586, doi:10.1214/aos/1176345462; Cameron, Gelbach & Miller, J. Bus. Econ. Stat. 29
(2011) 238, doi:10.1198/jbes.2010.07136.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .few_groups import satterthwaite
from .likelihood import Curve
from .robust import FEWEST_CLUSTERS, Way, bread, information_rows, leave_out, score_rows
from .solver import fit_batch
from .trials import Trials

Array = NDArray[np.float64]
Codes = NDArray[np.intp]

_MOST_REFITS = 1000  # of so many images none moves a curve by more than Newton's first step says


@dataclass(frozen=True, slots=True, kw_only=True)
class DifferenceSpread:
    """Of the difference of two a90 that share networks or images.

    sd: its standard deviation, in the unit of the sizes; sd_of_log: that of ln ratio (NaN where an a90 is not above 0);
    degrees_of_freedom: of both, after Satterthwaite; correlation: of the two a90, as estimated (also outside 0 to 1).
    """

    sd: float
    sd_of_log: float
    degrees_of_freedom: float
    correlation: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Looks:
    """A table with its pooled curve: the x of a90, its gradient by the coefficients (2,), and of each row the score (row, 2) and
    the information (row, 2, 2)."""

    table: Trials
    curve: Curve
    log_size: bool
    x90: float
    gradient: Array
    scores: Array
    information: Array

    @classmethod
    def of(cls, table: Trials, curve: Curve, *, log_size: bool) -> "_Looks":
        c0, c1 = curve.coefficients
        x90 = (curve.link.eta_from_pod(0.9) - c0) / c1
        return cls(
            table=table,
            curve=curve,
            log_size=log_size,
            x90=x90,
            gradient=-np.array([1.0, x90]) / c1,
            scores=score_rows(table, curve, log_size=log_size),
            information=information_rows(table, curve, log_size=log_size),
        )

    def influence(self) -> Array:
        """What each row adds to the x of a90, (row,)."""
        return np.asarray(self.scores @ bread(self.table, self.curve, log_size=self.log_size) @ self.gradient)

    def moved(self, way: Way, codes: Codes) -> Array:
        """Change of the x of a90 where each cluster is left out, (cluster,): of a new fit, else of Newton's first step."""
        step = -way.steps @ self.gradient
        clusters = len(step)
        if clusters > _MOST_REFITS:
            return np.asarray(step)
        x = np.log(self.table.size) if self.log_size else self.table.size
        distinct, where = np.unique(x, return_inverse=True)
        counts = []
        for of_row in (self.table.hits, self.table.misses):
            each = np.zeros((clusters, len(distinct)))
            np.add.at(each, (codes, where), of_row)
            counts.append(each.sum(axis=0) - each)
        found = fit_batch(
            np.stack((np.ones_like(distinct), distinct), axis=1),
            *counts,
            link=self.curve.link,
            start=np.array(self.curve.coefficients),
        )
        c0, c1 = found.coefficients.T
        # without some image hits and misses may not overlap, or POD not rise
        usable = found.converged & (np.nan_to_num(c1) > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            x90 = (self.curve.link.eta_from_pod(0.9) - c0) / c1
        return np.where(usable, x90 - self.x90, step)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Parts:
    """Variances by one way of clustering: of each a90, of their difference; the latter's summands with degrees of freedom."""

    each: tuple[float, float]
    difference: float
    summands: list[tuple[float, float]]


def difference_spread(
    tables: Sequence[Trials], curves: Sequence[Curve], *, shared: Sequence[str], log_size: bool
) -> DifferenceSpread | None:
    """Spread of a90_second - a90_first, each of a pooled curve that rises; None where nothing tells it.

    That is so with two networks or two images, and where one of them alone holds up a curve.

    Args:
        tables: both; a code of a shared label means the same in both.
        curves: the pooled curve of each.
        shared: `network`, `image` or both: which are the same ones in both tables.
        log_size: whether the curves are on ln size.
    """
    looks = [_Looks.of(table, curve, log_size=log_size) for table, curve in zip(tables, curves, strict=True)]
    ways: list[_Parts] = []
    for name in ("network", "image"):
        codes = [_own_codes(getattr(table, name)) for table in tables]
        if all(one is None for one in codes):
            continue
        parts = _parts(looks, codes, [getattr(table, name) for table in tables], together=name in shared)
        if parts is None:
            return None
        ways.append(parts)
    if not ways:
        return None
    cells = _cells(looks, together=len(shared) > 1)
    totals = [
        _total([way.each[0] for way in ways], cells[0]),
        _total([way.each[1] for way in ways], cells[1]),
        _total([way.difference for way in ways], cells[2]),
    ]
    first, second, difference = totals
    if not (first > 0 and second > 0):
        return None
    correlation = (first + second - difference) / (2 * math.sqrt(first * second))
    sd = math.sqrt(max(difference, 0.0))
    sizes = [math.exp(one.x90) if log_size else one.x90 for one in looks]
    middle = math.sqrt(sizes[0] * sizes[1]) if min(sizes) > 0 else math.nan
    return DifferenceSpread(
        sd=sd * middle if log_size else sd,
        sd_of_log=sd if log_size else sd / middle,
        degrees_of_freedom=float(satterthwaite(difference, [part for way in ways for part in way.summands])),
        correlation=correlation,
    )


def _own_codes(codes: Codes | None) -> Codes | None:
    """Codes that count only the table's own labels; None where there are none, or one."""
    if codes is None:
        return None
    found = np.unique(codes, return_inverse=True)[1].astype(np.intp)
    return found if found.max() > 0 else None


def _total(ways: list[float], cells: float) -> float:
    """The rule of `robust.Clustered`."""
    return max(sum(ways) - cells, *ways) if len(ways) > 1 else ways[0]


def _parts(
    looks: Sequence[_Looks], codes: Sequence[Codes | None], labels: Sequence[Codes], *, together: bool
) -> _Parts | None:
    """Variances by one way of clustering; None where nothing tells them."""
    moved: list[Array | None] = []
    summands: list[tuple[float, float]] = []
    for look, one in zip(looks, codes, strict=True):
        if one is None:
            moved.append(None)
            continue
        clusters = int(one.max()) + 1
        way = leave_out(look.scores, look.information, one) if clusters >= FEWEST_CLUSTERS else None
        if way is None:
            return None
        moved.append(look.moved(way, one) * math.sqrt((clusters - 1) / clusters))
        summands.append(
            (0.0 if moved[-1] is None else float(moved[-1] @ moved[-1]), float(way.variance(look.gradient)[1]))
        )
    each = [0.0 if change is None else float(change @ change) for change in moved]
    if not together or moved[0] is None or moved[1] is None:
        return _Parts(each=(each[0], each[1]), difference=sum(each), summands=summands)
    names = np.unique(np.concatenate(labels))
    change = np.zeros(len(names))
    for sign, part, label in zip((-1.0, 1.0), (moved[0], moved[1]), labels, strict=True):
        change[np.searchsorted(names, np.unique(label))] += sign * part
    value = float(change @ change)
    joined = leave_out(
        _side_by_side([look.scores for look in looks]),
        _side_by_side([look.information for look in looks]),
        np.searchsorted(names, np.concatenate(labels)),
    )
    if joined is None:
        return None
    toward = np.concatenate((-looks[0].gradient, looks[1].gradient))
    return _Parts(each=(each[0], each[1]), difference=value, summands=[(value, float(joined.variance(toward)[1]))])


def _side_by_side(parts: Sequence[Array]) -> Array:
    """Rows of two tables under each other, their coefficients side by side: (row, 2, ...) twice to (rows, 4, ...)."""
    rows = [len(part) for part in parts]
    result = np.zeros((sum(rows), *(4 for _ in parts[0].shape[1:])))
    for table, part in enumerate(parts):
        place = slice(0, rows[0]) if table == 0 else slice(rows[0], None)
        own = slice(2 * table, 2 * table + 2)
        result[(place, *(own for _ in part.shape[1:]))] = part
    return result


def _cells(looks: Sequence[_Looks], *, together: bool) -> tuple[float, float, float]:
    """Variances of the looks of a network at an image, of each a90 and of their difference; 0 where not both are known."""
    tables = [look.table for look in looks]
    if any(table.network is None or table.image is None for table in tables):
        return 0.0, 0.0, 0.0
    pairs = [np.stack((table.network, table.image), axis=1) for table in tables]  # type: ignore[arg-type]
    codes = np.unique(np.concatenate(pairs), axis=0, return_inverse=True)[1].ravel()
    cut = len(pairs[0])
    count = int(codes.max()) + 1
    sums = [
        np.bincount(one, weights=look.influence(), minlength=count)
        for one, look in zip((codes[:cut], codes[cut:]), looks, strict=True)
    ]
    first, second = (float(one @ one) for one in sums)
    return first, second, first + second - 2 * float(sums[0] @ sums[1]) * together

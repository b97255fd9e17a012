"""Bootstrap of a POD curve by image, by network or by both: thousands of refits in one batched solve.

Resampling both draws networks and images independently and multiplies their counts (the pigeonhole bootstrap): somewhat
too wide, never far too narrow. A resample whose hits and misses do not overlap has no a90: it counts as unknown.
Resamples of k networks or images spread (1 - 1/k)^(1/2) of what they should, and know nothing of Student's quantile: their
percentiles are moved out to Phi(t_(k-1) (k / (k - 1))^(1/2)) (expanded percentiles), and a percentile beyond all resamples is
None.
Source: Owen, Ann. Appl. Stat. 1 (2007) 386, doi:10.1214/07-AOAS122; Efron & Tibshirani (1993), ch. 13; Hesterberg, Am. Stat. 69
(2015) 371, doi:10.1080/00031305.2015.1089789.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from .few_groups import student_quantile
from .links import link_from_name
from .separation import separated_batch
from .solver import fit_batch
from .trials import Trials

Array = NDArray[np.float64]

UNITS = ("row", "image", "network", "both")


@dataclass(frozen=True, slots=True, kw_only=True)
class BootstrapSizes:
    """Refits: a50 and a90 (replicate,) in the data's unit, NaN where a resample has none (separated, or not rising).

    a90_95: 95th percentile; a90_low, a90_high: 2.5th and 97.5th percentiles, each expanded where networks or images are
    drawn. A resample without a90 counts as larger than any; None where the percentile falls among them or beyond all
    resamples. unknown: their share.
    """

    a50: Array
    a90: Array
    coefficients: Array
    a90_95: float | None
    a90_low: float | None
    a90_high: float | None
    unknown: float


def bootstrap_weights(table: Trials, *, by: str, replicates: int, rng: np.random.Generator) -> Array:
    """How often each row is drawn, (replicate, row).

    Args:
        table: the trials.
        by: what is drawn anew: `row` (each trial), `image`, `network` or `both`.
        replicates: number of resamples.
        rng: the random numbers.

    Raises:
        InputError: `by` is unknown, or the table lacks the labels it needs.
    """
    if by not in UNITS:
        raise InputError("bootstrap unit", received=repr(by), expected="one of " + ", ".join(UNITS))
    rows = len(table.size)
    if by == "row":
        return rng.multinomial(rows, np.full(rows, 1 / rows), size=replicates).astype(float)
    weights = np.ones((replicates, rows))
    for name, codes in (("network", table.network), ("image", table.image)):
        if by in (name, "both"):
            if codes is None:
                raise InputError(
                    "bootstrap unit", received=by, expected=f"a column {name} in the table", remedy="use row instead"
                )
            levels = int(codes.max()) + 1
            weights *= rng.multinomial(levels, np.full(levels, 1 / levels), size=replicates)[:, codes]
    return weights


def bootstrap_pod(
    table: Trials,
    *,
    link: str,
    log_size: bool,
    by: str,
    replicates: int,
    rng: np.random.Generator,
) -> BootstrapSizes:
    """a50 and a90 of refits to resampled trials, in the data's unit.

    Grouped rows (several trials of one size) are drawn trial by trial under `by="row"` only if given one row each.

    Args:
        table: the trials.
        link: the link's name.
        log_size: fit on ln size.
        by: `row`, `image`, `network` or `both`.
        replicates: number of refits.
        rng: the random numbers.

    Raises:
        InputError: see `bootstrap_weights`.
        FitError: the data themselves have no curve.
    """
    shape = link_from_name(link)
    x = np.log(table.size) if log_size else table.size
    distinct, where = np.unique(x, return_inverse=True)
    hits = np.empty((replicates, len(distinct)))
    misses = np.empty_like(hits)
    indicator = _Grouping(where, len(distinct))
    step = max(1, 4_000_000 // max(len(x), 1))
    for first in range(0, replicates, step):
        part = slice(first, min(first + step, replicates))
        weights = bootstrap_weights(table, by=by, replicates=part.stop - part.start, rng=rng)
        hits[part] = indicator.sum(weights * table.hits)
        misses[part] = indicator.sum(weights * table.misses)
    coefficients = fit_many(distinct, hits, misses, link=link, log_size=False)
    whole = fit_many(distinct, indicator.sum(table.hits[None]), indicator.sum(table.misses[None]), link=link)
    if not np.isfinite(whole).all():
        raise FitError("the data have no most likely curve (all hits, all misses, or no overlap): nothing to bootstrap")
    a50, a90 = (sizes_at(coefficients, shape.eta_from_pod(p), log_size=log_size) for p in (0.5, 0.9))
    ordered = np.sort(np.where(np.isfinite(a90), a90, np.inf))

    drawn = [codes for name, codes in (("network", table.network), ("image", table.image)) if by in (name, "both")]
    fewest = min((int(codes.max()) + 1 for codes in drawn if codes is not None), default=None)

    def percentile(share: float) -> float | None:
        moved = share if fewest is None else expanded_share(share, fewest)
        # a share of one resample or less is beyond what they tell
        if fewest is not None and min(moved, 1 - moved) * replicates < 1:
            return None
        value = float(ordered[min(max(math.ceil(moved * replicates) - 1, 0), replicates - 1)])
        return value if math.isfinite(value) else None

    return BootstrapSizes(
        a50=a50,
        a90=a90,
        coefficients=coefficients,
        a90_95=percentile(0.95),
        a90_low=percentile(0.025),
        a90_high=percentile(0.975),
        unknown=float(np.mean(~np.isfinite(a90))),
    )


def expanded_share(share: float, groups: int) -> float:
    """The percentile of resamples of so many groups that serves for `share`, 0 to 1; 0 or 1 with one group.

    >>> round(expanded_share(0.975, 82), 3)
    0.977
    """
    from scipy.special import ndtr

    if groups < 2:
        return float(share > 0.5)
    side = 1.0 if share > 0.5 else -1.0
    quantile = float(student_quantile(max(share, 1 - share), groups - 1.0))
    return float(ndtr(side * quantile * math.sqrt(groups / (groups - 1))))


def fit_many(x: Array, hits: Array, misses: Array, *, link: str, log_size: bool = False) -> Array:
    """Maximum-likelihood c0 and c1 of many tables of trials on the same sizes, (fit, 2); NaN where there is no maximum.

    Args:
        x: (size,), distinct sizes.
        hits, misses: (fit, size), counts or weights.
        link: the link's name.
        log_size: fit on ln size.
    """
    x = np.log(x) if log_size else np.asarray(x, dtype=float)
    result = np.full((len(hits), 2), np.nan)
    fits = np.flatnonzero(~separated_batch(x, hits, misses))
    if not len(fits):
        return result
    design = np.stack((np.ones_like(x), x), axis=1)
    shape = link_from_name(link)
    # all tables together are where each of them is near
    start = fit_batch(design, hits[fits].sum(axis=0)[None], misses[fits].sum(axis=0)[None], link=shape)
    batch = fit_batch(
        design,
        hits[fits],
        misses[fits],
        link=shape,
        start=start.coefficients[0] if start.converged[0] else None,
    )
    result[fits] = batch.coefficients
    return result


def sizes_at(coefficients: Array, eta: float, *, log_size: bool) -> Array:
    """Sizes at which curves (fit, 2) reach eta, (fit,) in the data's unit; NaN where a curve does not rise."""
    c0, c1 = coefficients[:, 0], coefficients[:, 1]
    rising = c1 > 0
    at = np.where(rising, (eta - c0) / np.where(rising, c1, 1.0), np.nan)
    return np.asarray(np.exp(np.clip(at, -700, 700)) if log_size else at)


class _Grouping:
    """Sums over rows that share a size, by one pass over sorted rows."""

    def __init__(self, where: NDArray[np.intp], groups: int) -> None:
        self._order = np.argsort(where, kind="stable")
        self._first = np.searchsorted(where[self._order], np.arange(groups))
        self._identity = len(where) == groups

    def sum(self, rows: Array) -> Array:
        ordered = rows[:, self._order]
        return ordered if self._identity else np.asarray(np.add.reduceat(ordered, self._first, axis=1))

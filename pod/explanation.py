"""Which property explains detection best: contrast, size, thickness, position, ...

Each property alone makes a curve (on the property or on its logarithm, whichever predicts better), judged by how well
curves fitted to some of the images predict the hits on the others: the gain in log-likelihood per trial over a
constant POD, in nats. Held-out images keep repeats of networks from counting as evidence. The joint fit then says what
each adds to all others.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from .covariates import CovariateFit, fit_covariates
from .hit_miss import PodFit
from .links import Link, link_from_name
from .repeats import fit_pod
from .solver import fit_batch
from .trials import Trials

_FOLDS = 10  # parts of the images that are held out in turn

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Property:
    """One property as the only one. gain: held-out log-likelihood per trial over a constant POD, nats; larger is
    better.

    behind: how much the best property's gain is ahead, with its standard error over images (0 for the best itself).
    area: chance that a hit has more of the property (or less, for a falling one) than a miss. fit: its POD curve.
    p_beyond: p-value that it adds something to all other properties together, None where the joint fit cannot be made.
    """

    name: str
    log: bool
    gain: float
    behind: float
    behind_error: float
    area: float
    rising: bool
    aic: float | None
    fit: PodFit
    p_beyond: float | None


def explain_detection(
    table: Trials,
    columns: Mapping[str, Array],
    *,
    rng: np.random.Generator,
    link: str = "cloglog",
    repeats: str = "pooled",
) -> tuple[tuple[Property, ...], CovariateFit | None]:
    """Properties in order of what they explain, best first, and the joint fit on all of them (None if there is none).

    Args:
        table: the trials.
        columns: property -> values (row,).
        rng: draws the folds.
        link: the link's name.
        repeats: how each property's own curve treats repeats, see `fit_pod`.

    Raises:
        InputError: fewer than two properties, or images.
        FitError: all trials ended alike.
    """
    if len(columns) < 1:
        raise InputError("properties", received="none", expected="one or more columns")
    if table.n_hits in (0, table.n):
        raise FitError("all trials ended alike (all hits or all misses): there is nothing to explain")
    shape = link_from_name(link)
    unit = table.image if table.image is not None else np.arange(len(table.size))
    units = int(unit.max()) + 1
    if units < 4:
        raise InputError("image", received=f"{units} images", expected="four or more, to hold some out")
    fold = (rng.permutation(units) % min(_FOLDS, units))[unit]
    constant = _held_out(np.ones((len(table.size), 1)), table, fold, shape)
    scores: dict[str, tuple[bool, Array]] = {}
    for name, values in columns.items():
        column = np.asarray(values, dtype=float)
        tried = {False: column}
        if np.all(column > 0):
            tried[True] = np.log(column)
        best: tuple[bool, Array] | None = None
        for log, x in tried.items():
            gain = _held_out(np.stack((np.ones_like(x), x), axis=1), table, fold, shape) - constant
            if best is None or gain.sum() > best[1].sum():
                best = (log, gain)
        if best is not None:
            scores[name] = best
    logs = tuple(name for name, (log, _) in scores.items() if log)
    joint: CovariateFit | None = None
    if len(columns) > 1:
        try:
            joint = fit_covariates(table, columns, link=link, logs=logs)
        except (FitError, InputError):
            joint = None
    leader = max(scores, key=lambda name: float(scores[name][1].sum()))
    found = []
    for name, (log, gain) in scores.items():
        by_unit = np.bincount(unit, weights=scores[leader][1] - gain, minlength=units) / table.n
        fit = fit_pod(
            columns[name],
            table.hits,
            trials=table.hits + table.misses,
            link=link,
            log_size=log,
            repeats=repeats,
            network=table.network,
            image=table.image,
            site=table.site,
        )
        area = _area(np.asarray(columns[name], dtype=float), table)
        found.append(
            Property(
                name=name,
                log=log,
                gain=float(gain.sum()) / table.n,
                behind=float(by_unit.sum()),
                behind_error=float(by_unit.std() * math.sqrt(units)) if name != leader else 0.0,
                area=max(area, 1 - area),
                rising=area >= 0.5,
                aic=fit.aic,
                fit=fit,
                p_beyond=None if joint is None else float(joint.p[1 + joint.names.index(name)]),
            )
        )
    return tuple(sorted(found, key=lambda one: -one.gain)), joint


def _held_out(design: Array, table: Trials, fold: NDArray[np.intp], link: Link) -> Array:
    """Log-likelihood of each row under the curve fitted without its fold, (row,); Firth's fit, which always exists."""
    groups = np.unique(fold)
    inside = fold[None] != groups[:, None]
    batch = fit_batch(design, inside * table.hits, inside * table.misses, link=link, bias_reduced=True)
    result = np.empty(len(table.size))
    for group, coefficients, converged in zip(groups, batch.coefficients, batch.converged, strict=True):
        rows = fold == group
        if converged:
            up, down = link.log_likelihood(design[rows] @ coefficients)
        else:
            share = (table.hits[~rows].sum() + 0.5) / ((table.hits + table.misses)[~rows].sum() + 1)
            up, down = np.full(rows.sum(), math.log(share)), np.full(rows.sum(), math.log1p(-share))
        result[rows] = table.hits[rows] * up + table.misses[rows] * down
    return result


def _area(values: Array, table: Trials) -> float:
    """Chance that a hit has a larger value than a miss; ties count half."""
    order = np.argsort(values, kind="stable")
    distinct, where = np.unique(values[order], return_inverse=True)
    hits = np.bincount(where, weights=table.hits[order], minlength=len(distinct))
    misses = np.bincount(where, weights=table.misses[order], minlength=len(distinct))
    below = np.cumsum(misses) - misses
    return float((hits * (below + 0.5 * misses)).sum() / (hits.sum() * misses.sum()))

"""POD against several properties at once: g(POD) = c0 + sum_j c_j x_j.

a_p of one property at given values v of the others: (g(p) - c0 - sum_k c_k v_k) / c.
Bounds: Wald, and likelihood ratio from the profile over all other coefficients. With repeated looks both take the variances
and Student's quantile of `repeats.fit_cluster`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from .few_groups import ONE_SIDED, size_from_test, student_quantile
from .hit_miss import Z_ONE_SIDED, Bounds, size_from_x, size_in_range
from .links import Link, link_from_name
from .robust import Clustered, clustered_fit
from .separation import check_separation
from .solver import fit_batch
from .trials import Trials

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class CovariateFit:
    """A fit on several properties. coefficients, errors, p: one each for the constant and `names`, in that order.

    Coefficients are per unit of the property (of its ln where `logs` says so); errors are robust to repeats where
    networks or images repeat; p is that of a Wald test, of Student's distribution there. covariance goes with the errors;
    clustered holds the variances where looks repeat.
    """

    names: tuple[str, ...]
    logs: tuple[bool, ...]
    link: str
    method: str
    coefficients: Array
    errors: Array
    p: Array
    covariance: Array
    log_likelihood: float
    deviance: float
    aic: float
    separated: bool
    robust: bool
    clustered: Clustered | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeAt:
    """a50 and a90 of one property with the others held, in its own unit; None with a reason in `warnings`."""

    name: str
    held: Mapping[str, float]
    a50: float | None
    a90: float | None
    a90_95: Bounds
    warnings: tuple[str, ...]


def fit_covariates(
    table: Trials,
    columns: Mapping[str, Array],
    *,
    link: str = "cloglog",
    logs: tuple[str, ...] = (),
    method: str = "auto",
) -> CovariateFit:
    """Fit POD on several properties; coefficients per unit of each.

    Args:
        table: the trials (their own `size` is not used).
        columns: property -> values (row,).
        link: the link's name.
        logs: properties taken by their natural logarithm.
        method: `auto`, `ml` or `firth`; `auto` is `firth` where the data separate.

    Raises:
        InputError: a property without spread, not above 0 where its logarithm is asked for, or a copy of others.
        FitError: the data separate under `ml`, all trials ended alike, or looks repeat and nothing tells how much networks
            and images differ.
    """
    shape = link_from_name(link)
    design = design_from_columns(columns, logs=logs, rows=len(table.size))
    if table.n_hits in (0, table.n):
        raise FitError("all trials ended alike (all hits or all misses): there is nothing to explain")
    separated = check_separation(design, table.hits, table.misses)
    used = ("firth" if separated else "ml") if method == "auto" else method
    if separated and used == "ml":
        raise FitError(
            "these properties part hits from misses (the data separate): use method firth, or fewer properties"
        )
    batch = fit_batch(design, table.hits[None], table.misses[None], link=shape, bias_reduced=used == "firth")
    if not batch.converged[0]:
        raise FitError("the fit on several properties did not converge: use fewer of them")
    coefficients = batch.coefficients[0]
    parts = shape.log_parts(design @ coefficients)
    log_likelihood = float(table.hits @ parts.log_hit + table.misses @ parts.log_miss)
    weight = -(table.hits + table.misses) * parts.log_hit_1 * parts.log_miss_1
    covariance = _inverse((design * weight[:, None]).T @ design)
    groups = [codes for codes in (table.network, table.image) if codes is not None and 0 < codes.max() < table.n - 1]
    clustered = None
    freedom = np.full(design.shape[1], np.inf)
    errors = np.sqrt(np.diag(covariance))
    if groups:
        first = table.hits * parts.log_hit_1 + table.misses * parts.log_miss_1
        looks = weight[:, None, None] * design[:, :, None] * design[:, None, :]
        clustered = None if separated else clustered_fit(design * first[:, None], looks, groups)
        if clustered is None:
            raise FitError(
                "networks or images repeat, and nothing tells how much they differ: there are fewer than three, one alone"
                " holds up the fit, or hits and misses do not overlap"
            )
        covariance = clustered.covariance()
        variances, freedom = clustered.variance(np.eye(design.shape[1]))
        errors = np.sqrt(variances)
    from scipy.special import ndtr, stdtr

    deviation = -np.abs(coefficients / errors)
    known = np.isfinite(freedom)
    total = table.hits + table.misses
    with np.errstate(divide="ignore", invalid="ignore"):
        saturated = np.where(table.hits > 0, table.hits * np.log(table.hits / total), 0.0)
        saturated = saturated + np.where(table.misses > 0, table.misses * np.log(table.misses / total), 0.0)
    return CovariateFit(
        names=tuple(columns),
        logs=tuple(name in logs for name in columns),
        link=link,
        method=used,
        coefficients=coefficients,
        errors=errors,
        p=np.asarray(2 * np.where(known, stdtr(np.where(known, freedom, 1.0), deviation), ndtr(deviation))),
        covariance=covariance,
        log_likelihood=log_likelihood,
        deviance=2 * (float(saturated.sum()) - log_likelihood),
        aic=2 * design.shape[1] - 2 * log_likelihood,
        separated=separated,
        robust=bool(groups),
        clustered=clustered,
    )


def size_at(
    fit: CovariateFit, table: Trials, columns: Mapping[str, Array], *, name: str, held: Mapping[str, float]
) -> SizeAt:
    """a50 and a90 of one property with the others held; in that property's unit.

    Args:
        fit: from `fit_covariates` on the same table and columns.
        name: the property asked for.
        held: value of every other property, in its own unit.

    Raises:
        InputError: a property without a value, or an unknown one.
    """
    for other in fit.names:
        if other != name and other not in held:
            raise InputError("held", received=f"no value of {other}", expected="a value of every other property")
    if name not in fit.names:
        raise InputError("name", received=repr(name), expected="one of " + ", ".join(fit.names))
    shape = link_from_name(fit.link)
    place = 1 + fit.names.index(name)
    log_size = fit.logs[place - 1]
    point = np.ones(len(fit.names) + 1)
    for index, other in enumerate(fit.names):
        if other != name:
            point[index + 1] = math.log(held[other]) if fit.logs[index] else held[other]
    values = np.log(columns[name]) if log_size else np.asarray(columns[name], dtype=float)
    notes: list[str] = []
    slope = float(fit.coefficients[place])
    point[place] = 0.0
    base = float(point @ fit.coefficients)
    found: dict[int, float | None] = {50: None, 90: None}
    bounds = Bounds()
    kept = {other: held[other] for other in fit.names if other != name}
    if slope <= 0:
        notes.append(f"POD does not rise with {name}: no a50 and no a90")
        return SizeAt(name=name, held=kept, a50=None, a90=None, a90_95=bounds, warnings=tuple(notes))
    for percent in (50, 90):
        x = (shape.eta_from_pod(percent / 100) - base) / slope
        found[percent], note = size_in_range(
            x, smallest=float(values.min()), largest=float(values.max()), log_size=log_size, percent=percent
        )
        if note:
            notes.append(note)
    if found[90] is not None:
        eta = shape.eta_from_pod(0.9)
        x90 = (eta - base) / slope
        point[place] = x90
        variance, z = float(point @ fit.covariance @ point), Z_ONE_SIDED
        if fit.clustered is not None:
            spread, freedom = fit.clustered.variance(point)
            variance, z = float(spread), float(student_quantile(ONE_SIDED, freedom))
        error = math.sqrt(variance) / slope
        ratio = None
        if fit.method == "ml":
            design = design_from_columns(
                columns, logs=tuple(n for n, log in zip(fit.names, fit.logs, strict=True) if log), rows=len(table.size)
            )
            ratio = _profile_bound(fit, table, design, place, point, eta, x90, z * error, shape, z * z * variance)
            if ratio is None:
                notes.append("the likelihood gives no upper bound on a90")
        bounds = Bounds(
            likelihood_ratio=size_from_x(ratio, log_size=log_size),
            wald=size_from_x(
                _wald_bound(fit, point, place, base, slope, eta, x90, z * error, values), log_size=log_size
            ),
        )
    return SizeAt(name=name, held=kept, a50=found[50], a90=found[90], a90_95=bounds, warnings=tuple(notes))


def design_from_columns(columns: Mapping[str, Array], *, logs: tuple[str, ...], rows: int) -> Array:
    """Columns of ones and of the properties, (row, 1 + property), checked."""
    parts = [np.ones(rows)]
    for name, values in columns.items():
        column = np.asarray(values, dtype=float)
        if column.shape != (rows,) or not np.all(np.isfinite(column)):
            raise InputError(name, received=f"shape {column.shape}", expected=f"{rows} finite numbers, one a row")
        if name in logs:
            if not np.all(column > 0):
                raise InputError(name, received=f"{column.min():g}", expected="values above 0 where its log is taken")
            column = np.log(column)
        if np.ptp(column) == 0:
            raise InputError(
                name, received=f"the same value {column[0]:g} in all rows", expected="a property that varies"
            )
        parts.append(column)
    design = np.stack(parts, axis=1)
    scaled = (design - design.mean(axis=0))[:, 1:] / design.std(axis=0)[1:]
    if scaled.shape[1] > 1 and np.linalg.matrix_rank(scaled, tol=1e-8 * len(design)) < scaled.shape[1]:
        raise InputError(
            "properties", received=", ".join(columns), expected="properties that are not sums of each other"
        )
    return design


def _inverse(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def _profile_bound(
    fit: CovariateFit,
    table: Trials,
    design: Array,
    place: int,
    point: Array,
    eta: float,
    x90: float,
    reach: float,
    link: Link,
    wide: float,
) -> float | None:
    """One-sided 95 % likelihood-ratio bound on x of one property, the curve held at eta there.

    reach: about how far from x90 it lies; wide: the squared quantile times the variance of eta at x90.
    """
    from scipy.optimize import brentq

    parts = link.log_parts(design @ fit.coefficients)
    weight = -(table.hits + table.misses) * parts.log_hit_1 * parts.log_miss_1
    plain = float(point @ _inverse((design * weight[:, None]).T @ design) @ point)
    allowed = wide / plain
    scale = np.maximum(np.abs(design[:, 1:] - point[1:]).max(axis=0), 1e-300)
    state = fit.coefficients[1:] * scale

    def excess(at: float) -> float:
        nonlocal state
        held = point.copy()
        held[place] = at
        # eta(x) = eta + sum_j c_j (x_j - held_j): the constant is gone
        columns = (design[:, 1:] - held[1:]) / scale
        state, value = _maximise(columns, eta, table, link, state)
        return 2 * (fit.log_likelihood - value) - allowed

    inside, outside = x90, x90 + reach
    for _ in range(30):
        if excess(outside) > 0:
            return float(brentq(excess, inside, outside, xtol=1e-10 * (1 + abs(x90))))
        inside, outside = outside, outside + 2 * (outside - x90)
    return None


def _wald_bound(
    fit: CovariateFit,
    point: Array,
    place: int,
    base: float,
    slope: float,
    eta: float,
    x90: float,
    reach: float,
    values: Array,
) -> float | None:
    """One-sided 95 % Wald bound on x of one property; where looks repeat, where Wald's test stops to reject (Fieller)."""
    clustered = fit.clustered
    if clustered is None:
        return x90 + reach

    def excess(at: float) -> tuple[float, float, float]:
        held = point.copy()
        held[place] = at
        variance, freedom = clustered.variance(held)
        return base + slope * at - eta, float(variance), float(freedom)

    return size_from_test(excess, below=ONE_SIDED, upper=True, start=x90, span=float(np.ptp(values)))


def _maximise(columns: Array, offset: float, table: Trials, link: Link, start: Array) -> tuple[Array, float]:
    current, best, step = start, -math.inf, np.zeros_like(start)
    for _ in range(200):
        trial = current + step
        parts = link.log_parts(offset + columns @ trial)
        value = float(table.hits @ parts.log_hit + table.misses @ parts.log_miss)
        if not value >= best - 1e-11 * (1 + abs(best)):
            step = 0.5 * step
            continue
        current, best = trial, value
        gradient = columns.T @ (table.hits * parts.log_hit_1 + table.misses * parts.log_miss_1)
        weight = -(table.hits * parts.log_hit_2 + table.misses * parts.log_miss_2)
        matrix = (columns * weight[:, None]).T @ columns
        step = np.linalg.solve(matrix + 1e-12 * np.trace(matrix) * np.eye(len(step)), gradient)
        if float(gradient @ step) < 1e-12 * (1 + abs(best)):
            break
    return current, best

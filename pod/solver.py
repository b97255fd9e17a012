"""Thousands of hit/miss fits at once: Newton's method on arrays (fit, row), maximum likelihood or mean-bias reduced.

log-likelihood  l = sum_k hits_k ln POD(eta_k) + misses_k ln(1 - POD(eta_k)),  eta_k = sum_j design_kj c_j

All rows share one design; each fit has its own hits and misses, which may be fractional weights (a bootstrap's counts).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .links import Link

Array = NDArray[np.float64]
_MOST_STEPS = 100  # of one fit
_CHUNK = 32_768  # elements of (fit, row) worked on at once: they stay in the processor's cache


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchFit:
    """Coefficients (fit, coefficient), expected information (fit, coefficient, coefficient), log-likelihood and
    convergence (fit,). Coefficients are per unit of the design's columns. A fit that did not converge holds NaN.
    """

    coefficients: Array
    information: Array
    log_likelihood: Array
    converged: NDArray[np.bool_]


def fit_batch(
    design: Array,
    hits: Array,
    misses: Array,
    *,
    link: Link,
    bias_reduced: bool = False,
    start: Array | None = None,
) -> BatchFit:
    """Fit many hit/miss regressions on one design; coefficients per unit of the design's columns.

    Newton's method with the observed information and step halving; with `bias_reduced`, Fisher scoring on the adjusted
    score U_j + 1/2 sum_k h_k (d2POD/deta2 / dPOD/deta)_k design_kj, h the leverages (AS_mean: Firth 1993, Kosmidis &
    Firth 2009, any link).

    Args:
        design: (row, coefficient), finite; the first column is the intercept's ones.
        hits, misses: (fit, row), 0 or more.
        link: the link function.
        bias_reduced: Firth's mean-bias reduction instead of maximum likelihood.
        start: coefficients to start from, (coefficient,) or (fit, coefficient).

    Returns:
        The fits. Separated data have no maximum: such fits hold NaN under maximum likelihood.

    Source: Kosmidis, Kenne Pagui & Sartori, Stat. Comput. 30 (2020) 43, doi:10.1007/s11222-019-09860-6.
    """
    fits, rows = hits.shape
    width = design.shape[1]
    centre = np.zeros(width)
    scale = np.ones(width)
    if width > 1:
        centre[1:] = design[:, 1:].mean(axis=0)
        spread = design[:, 1:].std(axis=0)
        scale[1:] = np.where(spread > 0, spread, 1.0)
    columns = (design - centre) / scale
    if start is None:
        share = (hits.sum(axis=1) + 0.5) / (hits.sum(axis=1) + misses.sum(axis=1) + 1.0)
        begin = np.zeros((fits, width))
        begin[:, 0] = [link.eta_from_pod(float(value)) for value in share]
        begin[:, 1:2] = 0.5
    else:
        begin = np.broadcast_to(np.asarray(start, float), (fits, width)) * scale
        begin[:, 0] += np.broadcast_to(np.asarray(start, float), (fits, width))[:, 1:] @ centre[1:]
    coefficients = np.full((fits, width), np.nan)
    information = np.full((fits, width, width), np.nan)
    log_likelihood = np.full(fits, np.nan)
    converged = np.zeros(fits, bool)
    step = max(8, _CHUNK // max(rows, 1))
    solve = _adjusted if bias_reduced else _newton
    for first in range(0, fits, step):
        part = slice(first, first + step)
        result = solve(columns, hits[part], misses[part], link, begin[part].copy())
        coefficients[part], information[part], log_likelihood[part], converged[part] = result
    # back to the units of the caller's columns: eta = sum_j b_j (x_j - centre_j) / scale_j
    back = np.diag(1.0 / scale)
    back[0, 1:] = -centre[1:] / scale[1:]
    forward = np.diag(scale)
    forward[0, 1:] = centre[1:]
    return BatchFit(
        coefficients=coefficients @ back.T,
        information=forward.T @ information @ forward,
        log_likelihood=log_likelihood,
        converged=converged,
    )


def _solve(matrices: Array, vectors: Array) -> Array:
    """Solve many small symmetric systems; a singular one gives NaN instead of an exception."""
    if vectors.shape[1] == 2:
        a, b, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
        determinant = a * d - b * b
        determinant = np.where(determinant > 1e-14 * a * d, determinant, np.nan)
        u, v = vectors[:, 0], vectors[:, 1]
        return np.stack(((d * u - b * v) / determinant, (a * v - b * u) / determinant), axis=1)
    try:
        return np.asarray(np.linalg.solve(matrices, vectors[..., None])[..., 0])
    except np.linalg.LinAlgError:
        return np.stack([_solve_one(m, v) for m, v in zip(matrices, vectors, strict=True)])


def _solve_one(matrix: Array, vector: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(matrix, vector))
    except np.linalg.LinAlgError:
        return np.full_like(vector, np.nan)


def _products(columns: Array) -> tuple[Array, NDArray[np.intp]]:
    """Distinct products of two columns, (row, product), and where they stand in the matrix of all."""
    upper = np.triu_indices(columns.shape[1])
    places = np.empty((columns.shape[1],) * 2, np.intp)
    places[upper] = places[upper[::-1]] = np.arange(len(upper[0]))
    return np.ascontiguousarray(columns[:, upper[0]] * columns[:, upper[1]]), places


def _newton(
    columns: Array, hits: Array, misses: Array, link: Link, begin: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    fits, width = begin.shape
    products, places = _products(columns)
    result = np.full((fits, width), np.nan)
    information = np.full((fits, width, width), np.nan)
    log_likelihood = np.full(fits, np.nan)
    converged = np.zeros(fits, bool)
    running = np.arange(fits)  # the arrays below hold these fits only
    shared = bool(np.all(begin == begin[:1]))
    current, step = begin, np.zeros_like(begin)
    best = np.full(fits, -np.inf)
    for _ in range(_MOST_STEPS):
        if shared:
            # all fits still stand at one point: one row of eta serves them all, and the sums are plain products
            parts = link.log_parts(current[:1] @ columns.T)
            value = hits @ parts.log_hit[0] + misses @ parts.log_miss[0]
            gradient = hits @ (parts.log_hit_1.T * columns) + misses @ (parts.log_miss_1.T * columns)
            curvature = hits @ (-parts.log_hit_2.T * products) + misses @ (-parts.log_miss_2.T * products)
        else:
            parts = link.log_parts((current + step) @ columns.T)
            value = np.einsum("fk,fk->f", hits, parts.log_hit) + np.einsum("fk,fk->f", misses, parts.log_miss)
            gradient = (hits * parts.log_hit_1 + misses * parts.log_miss_1) @ columns
            curvature = -(hits * parts.log_hit_2 + misses * parts.log_miss_2) @ products
        better = value >= best - 1e-10 * (1 + np.abs(best))
        hessian = curvature[:, places]
        newton = _solve(hessian, gradient)
        decrement = np.einsum("fj,fj->f", gradient, newton)
        # what is left is the square of the step: one more step without a look is exact to rounding
        done = better & (np.abs(decrement) < 1e-12 * (1 + np.abs(value)))
        if done.any():
            at = running[done]
            result[at] = current[done] + step[done] + newton[done]
            share = -parts.log_hit_1 * parts.log_miss_1
            information[at] = ((hits[done] + misses[done]) * (share if shared else share[done]) @ products)[:, places]
            log_likelihood[at] = value[done] + 0.5 * decrement[done]
            converged[at] = True
        shared = False
        if better.all():
            current, best, step = current + step, value, newton
        else:
            current = np.where(better[:, None], current + step, current)
            best = np.where(better, value, best)
            step = np.where(better[:, None], newton, 0.5 * step)
        going = ~done & np.isfinite(step).all(axis=1) & (np.abs(step).max(axis=1) > 1e-300)
        if not going.any():
            break
        if not going.all():
            running, current, step, best = running[going], current[going], step[going], best[going]
            hits, misses = hits[going], misses[going]
    # where the curve became a step on its way to infinity, the information has lost a direction: no maximum exists
    scale = np.sqrt(np.einsum("fjj->fj", information))
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.linalg.det(information / scale[:, :, None] / scale[:, None, :])
    converged &= (even > 1e-11) & (scale.max(axis=1) > 1e-5)
    result[~converged] = np.nan
    return result, information, np.where(converged, log_likelihood, np.nan), converged


def _adjusted(
    columns: Array, hits: Array, misses: Array, link: Link, begin: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    fits, width = begin.shape
    current = begin.copy()
    information = np.full((fits, width, width), np.nan)
    value = np.full(fits, np.nan)
    converged = np.zeros(fits, bool)
    running = np.arange(fits)
    for _ in range(_MOST_STEPS):
        step, size, matrix, log_likelihood = _scoring_step(
            columns, hits[running], misses[running], link, current[running]
        )
        information[running], value[running] = matrix, log_likelihood
        # a step longer than 2 standard deviations of x is a start that was too far off, not information
        step *= np.minimum(1.0, 2.0 / np.maximum(np.abs(step).max(axis=1), 1e-300))[:, None]
        going = np.isfinite(step).all(axis=1) & (size >= 1e-20)
        converged[running[size < 1e-20]] = True
        current[running[going]] += step[going]
        running = running[going]
        if not running.size:
            break
    for fit in np.flatnonzero(~converged):
        found = _adjusted_root(columns, hits[fit : fit + 1], misses[fit : fit + 1], link, begin[fit])
        if found is not None:
            current[fit] = found
            _, _, information[fit], value[fit] = (
                part[0]
                for part in _scoring_step(columns, hits[fit : fit + 1], misses[fit : fit + 1], link, found[None])
            )
            converged[fit] = True
    current[~converged] = np.nan
    return current, information, np.where(converged, value, np.nan), converged


def _scoring_step(
    columns: Array, hits: Array, misses: Array, link: Link, current: Array
) -> tuple[Array, Array, Array, Array]:
    """Step of Fisher scoring on the adjusted score, its squared length, the information and the log-likelihood."""
    width = columns.shape[1]
    products, places = _products(columns)
    eta = current @ columns.T
    parts = link.log_parts(eta)
    fisher = -(hits + misses) * parts.log_hit_1 * parts.log_miss_1
    matrix = (fisher @ products)[:, places]
    inverse = np.stack([_solve(matrix, np.tile(row, (len(current), 1))) for row in np.eye(width)], axis=1)
    leverage = fisher * np.einsum("fij,ki,kj->fk", inverse, columns, columns, optimize=True)
    adjusted = hits * parts.log_hit_1 + misses * parts.log_miss_1 + 0.5 * leverage * link.pod_curvature(eta)
    gradient = adjusted @ columns
    step = np.einsum("fij,fj->fi", inverse, gradient)
    size = np.einsum("fj,fj->f", gradient, step)
    log_likelihood = (hits * parts.log_hit + misses * parts.log_miss).sum(axis=1)
    return step, np.where(np.isfinite(size), np.abs(size), np.inf), matrix, log_likelihood


def _adjusted_root(columns: Array, hits: Array, misses: Array, link: Link, begin: Array) -> Array | None:
    """Root of the adjusted score by Powell's method, for the few fits in which scoring goes round in circles."""
    from scipy.optimize import root

    def step(current: Array) -> Array:
        found = _scoring_step(columns, hits, misses, link, current[None])[0][0]
        return np.where(np.isfinite(found), found, 1e6)

    starts = [begin * np.where(np.arange(len(begin)) > 0, stretch, 1.0) for stretch in (1.0, 0.3, 2.0, 4.0, -1.0)]
    if columns.shape[1] == 2:
        starts.insert(0, _likeliest_of_grid(columns, hits, misses, link))
    for start in starts:
        answer = root(step, start, method="hybr", options={"xtol": 1e-13})
        size = _scoring_step(columns, hits, misses, link, answer.x[None])[1][0]
        if size < 1e-14:
            return np.asarray(answer.x)
    return None


def _likeliest_of_grid(columns: Array, hits: Array, misses: Array, link: Link) -> Array:
    """Of curves with many middles and slopes, the one whose likelihood is largest with Jeffreys' prior, which the logit's adjusted
    score is the slope of (Firth, Biometrika 80 (1993) 27). Data that separate leave curves so steep that no descent gets there."""
    x = columns[:, 1]
    middles = np.linspace(x.min(), x.max(), 41)
    steps = np.diff(np.unique(x))
    slopes = np.geomspace(0.5 / np.ptp(x), 20.0 / max(float(np.median(steps)), 1e-3 * float(np.ptp(x))), 25)
    middle, slope = (values.ravel() for values in np.meshgrid(middles, np.concatenate([slopes, -slopes])))
    curves = np.stack([link.eta_from_pod(0.5) - slope * middle, slope], axis=1)
    every = np.ones((len(curves), 1))
    _, _, matrix, likelihood = _scoring_step(columns, every * hits, every * misses, link, curves)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = likelihood + 0.5 * np.log(np.linalg.det(matrix))
    return np.asarray(curves[int(np.argmax(np.where(np.isfinite(found), found, -np.inf)))])

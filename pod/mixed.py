"""Regression with crossed random effects: its Laplace likelihood, minimised, and means over the effects.

g(POD) = c0 + c1 x + u_network + v_image,  u ~ N(0, sd_network^2),  v ~ N(0, sd_image^2)

Source: Bates, Maechler, Bolker & Walker, J. Stat. Softw. 67 (2015) 1, doi:10.18637/jss.v067.i01.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError
from ._laplace import Laplace
from .links import Link

Array = NDArray[np.float64]
_NOT_CONVERGED = "the fit with crossed random effects did not converge"
_SLOW = 15  # steps that most minima take less than
Codes = NDArray[np.intp]

_FARTHEST = 8.5  # standard deviations to which means over a normal effect are taken
_STEP, _STEP_OF_LINK = 0.25, 0.4  # widest step of such a mean, in standard deviations and on the link's scale
_ZERO_SD = 1e-3  # a standard deviation (of eta) below it is reported and treated as 0
# on the link's scale: beyond it a level is all hits or all misses and its spread has no finite estimate
LARGEST_SD = 8.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MixedFit:
    """A regression with random effects: coefficients (coefficient,) and sd (factor,), on the scale of eta.

    covariance: of (coefficients, sd) together; rows and columns of an sd at 0 are 0. deviance: -2 ln L (Laplace).
    """

    coefficients: Array
    sd: Array
    covariance: Array
    deviance: float
    converged: bool


def averaged_pod(eta: Array, sd: float, *, link: Link) -> Array:
    """Population-averaged POD, E[g^-1(eta + sd Z)], for each eta.

    The trapezoidal rule over Z, whose error falls as exp(-const / step) for smooth links: the step follows sd, as fixed
    Gauss-Hermite nodes lie too far apart where sd is several times the link's own width.
    """
    eta = np.asarray(eta, dtype=float)
    step = min(_STEP, _STEP_OF_LINK / max(abs(sd), 1e-12))
    nodes, weights = _normal_nodes(2 * math.ceil(_FARTHEST / step) + 1)
    return np.asarray(link.pod_from_eta(eta[..., None] + sd * nodes) @ weights)


@lru_cache(maxsize=64)
def _normal_nodes(count: int) -> tuple[Array, Array]:
    nodes = np.linspace(-_FARTHEST, _FARTHEST, count)
    weights = np.exp(-0.5 * nodes**2)
    return nodes, weights / weights.sum()


def averaged_eta(pod: float, sd: float, *, link: Link) -> float:
    """The eta of an average network and image where the population-averaged POD is `pod` (inverse of
    `averaged_pod`).
    """
    eta = link.eta_from_pod(pod)
    if abs(sd) < 1e-12:
        return eta
    from scipy.optimize import brentq

    reach = 5 * abs(sd) + 5
    return float(
        brentq(lambda e: float(averaged_pod(np.array(e), sd, link=link)) - pod, eta - reach, eta + reach, xtol=1e-13)
    )


def fit_mixed(
    design: Array,
    hits: Array,
    misses: Array,
    *,
    factors: list[Codes],
    link: Link,
    start: Array | None = None,
    expected: bool = True,
) -> MixedFit:
    """Maximum (Laplace) likelihood of a hit/miss regression with one or two crossed random intercepts; scale of eta.

    Args:
        design: (row, coefficient).
        hits, misses: (row,), counts.
        factors: one or two arrays of codes (row,).
        link: the link function.
        start: coefficients (coefficient,) to start from.
        expected: Laplace's method with the expected information, as lme4; else with the observed one.

    Raises:
        FitError: the search did not converge.
    """
    width = design.shape[1]
    centre = np.zeros(width)
    scale = np.ones(width)
    centre[1:] = design[:, 1:].mean(axis=0)
    spread = design[:, 1:].std(axis=0)
    scale[1:] = np.where(spread > 0, spread, 1.0)
    columns = (design - centre) / scale
    laplace = Laplace(
        hits=hits,
        misses=misses,
        first=factors[0],
        second=factors[1] if len(factors) > 1 else None,
        link=link,
        expected=expected,
    )

    def deviance(parameters: Array) -> float:
        return laplace.deviance(columns @ parameters[:width], parameters[width:])

    begin = np.zeros(width + len(factors))
    if start is not None:
        begin[:width] = start * scale
        begin[0] += start[1:] @ centre[1:]
    begin[width:] = 0.7
    try:
        best, value, hessian, converged = minimise(deviance, begin)
    except np.linalg.LinAlgError:
        # the search ran to where a spread is endless and the curvature at the mode is lost in rounding
        raise FitError(_NOT_CONVERGED) from None
    sd = np.abs(best[width:])
    zero = sd < _ZERO_SD
    if zero.any():
        # the deviance is even in sd: at 0 it drops out of the quadratic form
        free = np.concatenate((np.ones(width, bool), ~zero))
        best = np.where(free, best, 0.0)
        value = deviance(best)
        reduced = second_differences(lambda p: deviance(_filled(best, free, p)), best[free])
        covariance = np.zeros((len(best), len(best)))
        covariance[np.ix_(free, free)] = 2 * _inverse(reduced)
    else:
        covariance = 2 * _inverse(hessian)
    if not converged:
        raise FitError(_NOT_CONVERGED)
    back = np.eye(len(best))
    back[:width, :width] = np.diag(1.0 / scale)
    back[0, 1:width] = -centre[1:] / scale[1:]
    sign = np.concatenate((np.ones(width), np.where(best[width:] < 0, -1.0, 1.0)))
    back = back * sign
    final = back @ best
    return MixedFit(
        coefficients=final[:width],
        sd=np.abs(final[width:]) * ~zero,
        covariance=back @ covariance @ back.T,
        deviance=value,
        converged=converged,
    )


def _inverse(hessian: Array) -> Array:
    """Inverse of the curvature at a maximum.

    Raises:
        FitError: the likelihood is flat in some direction there: nothing fixes the spreads.
    """
    try:
        return np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise FitError("the data do not fix the spread between networks and images (the likelihood is flat)") from None


def _filled(whole: Array, free: NDArray[np.bool_], part: Array) -> Array:
    result = whole.copy()
    result[free] = part
    return result


def minimise(
    function: Callable[[Array], float], start: Array, *, hessian: Array | None = None, tolerance: float = 1e-11
) -> tuple[Array, float, Array, bool]:
    """Minimum of a smooth function of a few parameters: point, value, Hessian, success.

    Second differences make the first model (or `hessian` does), BFGS updates follow it, and a last Newton step on fresh
    second differences confirms the minimum.
    """
    point = start.copy()
    value = function(point)
    model = second_differences(function, point, value) if hessian is None else hessian.copy()
    gradient = _gradient(function, point)
    fresh = hessian is None
    for iteration in range(200):
        step = -np.linalg.solve(_positive(model), gradient)
        longest = np.abs(step).max()
        step *= min(1.0, 2.0 / max(longest, 1e-300))
        gain = -float(gradient @ step)
        if gain < tolerance * (1 + abs(value)):
            if hessian is not None:
                return point, value, model, True
            if not fresh:
                model, fresh = second_differences(function, point, value), True
                continue
            return point, value, model, True
        length = 1.0
        for _ in range(30):
            trial = point + length * step
            trial_value = function(trial)
            if trial_value <= value - 1e-4 * length * gain:
                break
            length *= 0.5
        else:
            # no lower point along the step: a poor model of the curvature, or the minimum to rounding
            if fresh:
                return point, value, model, gain < 1e-5 * (1 + abs(value))
            model, fresh = second_differences(function, point, value), True
            continue
        moved = trial - point
        new_gradient = _gradient(function, trial)
        change = new_gradient - gradient
        along = float(moved @ change)
        stretched = model @ moved
        bent = float(moved @ stretched)
        # a step along which nothing bends, measured or modelled, says nothing of the curvature
        if along > 1e-10 * np.linalg.norm(moved) * np.linalg.norm(change) and bent > 1e-10 * float(
            np.linalg.norm(moved) * np.linalg.norm(stretched)
        ):
            model = model + np.outer(change, change) / along - np.outer(stretched, stretched) / bent
        elif iteration % 5 == 4:
            model = second_differences(function, trial, trial_value)
        if iteration % _SLOW == _SLOW - 1:
            # along a bent valley what earlier steps have shown of the curvature holds it up
            model = second_differences(function, trial, trial_value)
        point, value, gradient, fresh = trial, trial_value, new_gradient, False
    return point, value, model, False


def _positive(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    least = 1e-6 * max(float(np.abs(values).max()), 1e-6)
    return np.asarray((vectors * np.maximum(np.abs(values), least)) @ vectors.T)


def _gradient(function: Callable[[Array], float], point: Array, width: float = 1e-4) -> Array:
    result = np.empty_like(point)
    for i in range(len(point)):
        ahead, behind = point.copy(), point.copy()
        ahead[i] += width
        behind[i] -= width
        result[i] = (function(ahead) - function(behind)) / (2 * width)
    return result


def second_differences(
    function: Callable[[Array], float], point: Array, value: float | None = None, width: float = 3e-3
) -> Array:
    """Hessian (parameter, parameter) of a function by central second differences."""
    size = len(point)
    middle = function(point) if value is None else value
    result = np.empty((size, size))
    for i in range(size):
        step_i = np.zeros(size)
        step_i[i] = width
        result[i, i] = (function(point + step_i) - 2 * middle + function(point - step_i)) / width**2
        for j in range(i):
            step_j = np.zeros(size)
            step_j[j] = width
            result[i, j] = result[j, i] = (
                function(point + step_i + step_j)
                - function(point + step_i - step_j)
                - function(point - step_i + step_j)
                + function(point - step_i - step_j)
            ) / (4 * width**2)
    return result

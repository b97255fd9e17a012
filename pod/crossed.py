"""Crossed random effects: every network looks at every image, and both bring their own luck.

g(POD) = c0 + c1 x + u_network + v_image,  u ~ N(0, sd_network^2),  v ~ N(0, sd_image^2)

The likelihood is Laplace's. a50 and a90 are those of the population-averaged curve, POD(x) = E[g^-1(c0 + c1 x + s Z)]
with s^2 = sd_network^2 + sd_image^2 and Z standard normal: the chance that a network drawn from the population finds
the object in an image drawn from the population. Bounds come from the profile likelihood of the averaged a90, its Wald
form, and a modified form that also averages over slope and spreads (see `_averaged_size.py`): the one to trust.

Validity: networks and images are samples of what the curve is to speak for; with fewer than five or so of either, its
standard deviation is poorly known and the bounds are too low.

Source: Bates, Maechler, Bolker & Walker, J. Stat. Softw. 67 (2015) 1, doi:10.18637/jss.v067.i01.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from ._laplace import Laplace
from .hit_miss import (
    NO_BOUNDS,
    Z_ONE_SIDED,
    Z_TWO_SIDED,
    Bounds,
    CrossedEffects,
    PodFit,
    fit_pooled,
    size_from_x,
    size_in_range,
)
from .links import Link
from .trials import Trials

Array = NDArray[np.float64]
_SLOW = 15  # steps that most minima take less than
Codes = NDArray[np.intp]

_FARTHEST = 8.5  # standard deviations to which means over a normal effect are taken
_STEP, _STEP_OF_LINK = 0.25, 0.4  # widest step of such a mean, in standard deviations and on the link's scale
_ZERO_SD = 1e-3  # a standard deviation (of eta) below it is reported and treated as 0
LARGEST_SD = (
    8.0  # on the link's scale: beyond it a level is all hits or all misses and its spread has no finite estimate
)


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
    best, value, hessian, converged = minimise(deviance, begin)
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
        raise FitError("the fit with crossed random effects did not converge; use --repeats cluster")
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
        raise FitError(
            "the data do not fix the spread between networks and images (the likelihood is flat); use --repeats cluster"
        ) from None


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


def usable_factors(table: Trials) -> tuple[list[Codes], list[str], list[str]]:
    """Factors whose effect the data can tell from chance, their names, and why others were left out."""
    factors: list[Codes] = []
    names: list[str] = []
    notes: list[str] = []
    rows = table.n
    for name, codes in (("network", table.network), ("image", table.image)):
        if codes is None:
            continue
        levels = int(codes.max()) + 1
        if levels < 2:
            notes.append(f"only one {name}: the spread between {name}s is unknown and not in the intervals")
        elif levels == rows:
            notes.append(f"each {name} was looked at once: its effect cannot be told from chance and is not separate")
        else:
            factors.append(codes)
            names.append(name)
    return factors, names, notes


def fit_crossed(table: Trials, *, link: Link, log_size: bool, method: str) -> PodFit:
    """POD with crossed random effects of network and image; see the module. c0 and c1 are conditional (of an average
    network and image), the sizes population-averaged.

    Raises:
        InputError: neither network nor image is known, or `method` asks for bias reduction.
    """
    if table.network is None and table.image is None:
        raise InputError(
            "repeats crossed",
            received="no column of networks or images",
            expected="at least one of them",
            remedy="use --repeats pooled where each trial is independent",
        )
    if method == "firth":
        raise InputError(
            "method firth",
            received="with repeats crossed",
            expected="maximum likelihood where there are random effects",
            remedy="use --repeats cluster with --method firth",
        )
    naive = fit_pooled(table, link=link, log_size=log_size, method=method)
    factors, names, notes = usable_factors(table)
    if naive.curve is None or naive.separated or not factors:
        if naive.separated and naive.curve is not None:
            notes.append("no random effects could be fitted to separated data: the intervals ignore the repeats")
        return replace(naive, repeats="crossed", naive=naive, warnings=(*naive.warnings, *notes))
    x = np.log(table.size) if log_size else table.size
    design = np.stack((np.ones_like(x), x), axis=1)
    mixed = fit_mixed(
        design, table.hits, table.misses, factors=factors, link=link, start=np.array(naive.curve.coefficients)
    )
    sd = dict(zip(names, mixed.sd, strict=True))
    total = math.hypot(*mixed.sd)
    for name, value in sd.items():
        levels = int(factors[names.index(name)].max()) + 1
        if levels < 5:
            notes.append(
                f"only {levels} {name}s: the spread between {name}s is poorly known and the bounds are too low"
            )
        if value > LARGEST_SD:
            notes.append(
                f"the spread between {name}s is so large that {name}s are all hits or all misses; mind the fit"
            )
    c0, c1 = mixed.coefficients
    smallest, largest = float(x.min()), float(x.max())
    sizes: dict[int, float | None] = {50: None, 90: None}
    conditional: dict[int, float | None] = {50: None, 90: None}
    one = two = low = NO_BOUNDS
    reaches_90 = bool(averaged_pod(np.array(c0 + c1 * largest), total, link=link) >= 0.9)
    if not c1 > 0:
        notes.append("POD does not rise with size in these data: no a50 and no a90")
    else:
        for percent in (50, 90):
            at = (averaged_eta(percent / 100, total, link=link) - c0) / c1
            sizes[percent], note = size_in_range(
                at, smallest=smallest, largest=largest, log_size=log_size, percent=percent
            )
            if note:
                notes.append(note)
            plain = (link.eta_from_pod(percent / 100) - c0) / c1
            conditional[percent] = size_in_range(
                plain, smallest=smallest, largest=largest, log_size=log_size, percent=percent
            )[0]
        # along a likelihood that rises without end there is nothing to bound
        if sizes[90] is not None and float(mixed.sd.max()) <= LARGEST_SD:
            one, two, low = _bounds(mixed, design, table, factors=factors, link=link, log_size=log_size, notes=notes)
    return PodFit(
        link=link.name,
        method="ml",
        variant="maximum likelihood, Laplace approximation, crossed random intercepts of " + " and ".join(names),
        repeats="crossed",
        log_size=log_size,
        n=table.n,
        n_hits=table.n_hits,
        smallest_size=float(table.size.min()),
        largest_size=float(table.size.max()),
        c0=float(c0),
        c1=float(c1),
        se0=math.sqrt(mixed.covariance[0, 0]),
        se1=math.sqrt(mixed.covariance[1, 1]),
        log_likelihood=-0.5 * mixed.deviance,
        deviance=mixed.deviance,
        aic=mixed.deviance + 2 * (2 + len(factors)),
        a50=sizes[50],
        a90=sizes[90],
        a90_95=one,
        a90_95_two_sided=two,
        a90_low_two_sided=low,
        separated=False,
        reaches_90=reaches_90,
        warnings=tuple(notes),
        curve=naive.curve,
        crossed=CrossedEffects(
            sd_network=None if "network" not in sd else float(sd["network"]),
            sd_image=None if "image" not in sd else float(sd["image"]),
            n_networks=0 if table.network is None else int(table.network.max()) + 1,
            n_images=0 if table.image is None else int(table.image.max()) + 1,
            a50_conditional=conditional[50],
            a90_conditional=conditional[90],
            covariance=mixed.covariance,
        ),
        naive=naive,
    )


def _bounds(
    mixed: MixedFit,
    design: Array,
    table: Trials,
    *,
    factors: list[Codes],
    link: Link,
    log_size: bool,
    notes: list[str],
) -> tuple[Bounds, Bounds, Bounds]:
    """One-sided upper, two-sided upper and lower bounds on the averaged a90, in the data's unit."""
    from ._averaged_size import AveragedSize

    plain = AveragedSize(mixed=mixed, design=design, table=table, factors=factors, link=link, expected=True)
    sharper = plain
    if link.name != "logit":
        try:
            refit = fit_mixed(
                design,
                table.hits,
                table.misses,
                factors=factors,
                link=link,
                start=mixed.coefficients,
                expected=False,
            )
            sharper = AveragedSize(mixed=refit, design=design, table=table, factors=factors, link=link, expected=False)
        except FitError:
            notes.append("the modified bounds rest on the plain Laplace likelihood: the sharper one did not converge")
    asked = ((Z_ONE_SIDED, 1.0), (Z_TWO_SIDED, 1.0), (Z_TWO_SIDED, -1.0))
    results = [
        Bounds(
            likelihood_ratio=size_from_x(plain.likelihood_bound(z, side), log_size=log_size),
            wald=size_from_x(plain.estimate + side * z * plain.error, log_size=log_size),
            modified=size_from_x(modified, log_size=log_size),
        )
        for (z, side), modified in zip(asked, sharper.modified_bounds(asked), strict=True)
    ]
    if results[0].likelihood_ratio is None or results[1].likelihood_ratio is None:
        notes.append(
            "the likelihood gives no upper bound on a90: more images, networks or a wider range of sizes would"
        )
    largest_size = float(table.size.max())
    given = [value for value in (results[0].likelihood_ratio, results[0].wald) if value is not None]
    if given and max(given) > largest_size:
        notes.append(f"a 95 % bound on a90 lies beyond the largest size tested ({largest_size:g}): extrapolated")
    return results[0], results[1], results[2]

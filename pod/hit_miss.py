"""POD from hits and misses: generalised linear model g(POD) = c0 + c1 x, x the size or its natural logarithm.

Sizes: a_p = (g(p) - c0) / c1 on the scale of x, and its exponential on log size.
Likelihood-ratio bounds are those of the ordinary likelihood, for a bias-reduced fit too, so they do not depend on which
estimate is shown. Where the data separate they are far too short and are not given: Wald's upper bounds of the
bias-reduced fit stand. There are no lower ones then, as steep curves through any size of the gap fit alike.
Validity: independent trials (see `crossed`, `cluster` and `scaled` in `repeats.py` for repeated looks), POD that rises
from 0 to 1 with size (see `lapse.py` where it does not reach 1). A size outside the tested range is not given out.
Source: MIL-HDBK-1823A (2009) appendix G; Firth, Biometrika 80 (1993) 27, doi:10.1093/biomet/80.1.27.
"""

import math
import warnings as python_warnings
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError
from ..results import ByValue
from .few_groups import ONE_SIDED, TWO_SIDED, Levels, not_short_of_likelihood, size_from_test, student_quantile
from .likelihood import Curve, may_be_flat, size_bound
from .links import Link
from .modified import modified_bound
from .robust import Clustered
from .separation import check_separation
from .solver import fit_batch
from .trials import Trials, group_by_size

Array = NDArray[np.float64]

METHODS = ("auto", "ml", "firth")
FIRTH_VARIANT = "AS_mean (mean-bias-reducing adjusted score; Firth 1993, Kosmidis & Firth 2009)"
Z_ONE_SIDED = 1.6448536269514722
Z_TWO_SIDED = 1.959963984540054


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """One bound by each construction, in the size's unit; None where the data support none.

    modified: the likelihood ratio with a correction for few trials (see `modified.py`, `_averaged_size.py`); None for a
    bias-reduced fit and for scaled repeats. Where the data separate wald alone is given, and no lower bound. With clusters
    or random effects all three take Student's quantile (see `few_groups.py`), and wald is the bound of Wald's test at each
    size (Fieller), or `modified` where that lies farther out.
    """

    likelihood_ratio: float | None = None
    wald: float | None = None
    modified: float | None = None


NO_BOUNDS = Bounds()


def trusted_bound(bounds: Bounds, *, separated: bool) -> float | None:
    """The bound to show where one is shown: Wald's where the data separate, else modified, else the likelihood ratio."""
    if separated:
        return bounds.wald
    return bounds.modified if bounds.modified is not None else bounds.likelihood_ratio


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CrossedEffects(ByValue):
    """Random effects on the scale of eta: standard deviations between networks and between images (None: not fitted).

    `a50_conditional` and `a90_conditional` are the sizes of an average network at an average image. covariance: of
    (c0, c1, sd_network, sd_image), those that were fitted. levels: what few networks and images add to a variance.
    """

    sd_network: float | None
    sd_image: float | None
    n_networks: int
    n_images: int
    a50_conditional: float | None
    a90_conditional: float | None
    covariance: Array = field(repr=False)
    levels: Levels = field(repr=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PodFit(ByValue):
    """A fitted POD curve. Sizes in the unit of the data; None where the data cannot support a number (see `warnings`).

    a90_95: one-sided 95 % upper bound on a90. a90_95_two_sided: upper end of the two-sided 95 % interval;
    a90_low_two_sided: its lower end. c0, c1 with se0, se1: coefficients per unit of size (of ln size if `log_size`).
    deviance: against the saturated model of the rows as given. `curve`: what bands and plots need (None where no fit).
    `naive`: the same fit with the repeats ignored, beside a fit that heeds them. degrees_of_freedom: of Student's quantile in
    the bounds on a90 where networks or images repeat (None: the normal's quantile). clustered: the variances of repeats
    `cluster`. spread_unknown: networks or images repeat, and nothing tells how much they differ: no bounds and no band.
    """

    link: str
    method: str
    variant: str
    repeats: str
    log_size: bool
    n: int
    n_hits: int
    smallest_size: float
    largest_size: float
    c0: float | None = None
    c1: float | None = None
    se0: float | None = None
    se1: float | None = None
    log_likelihood: float | None = None
    deviance: float | None = None
    aic: float | None = None
    a50: float | None = None
    a90: float | None = None
    a90_95: Bounds = NO_BOUNDS
    a90_95_two_sided: Bounds = NO_BOUNDS
    a90_low_two_sided: Bounds = NO_BOUNDS
    separated: bool = False
    reaches_90: bool = False
    warnings: tuple[str, ...] = ()
    curve: Curve | None = field(default=None, repr=False)
    crossed: CrossedEffects | None = None
    degrees_of_freedom: float | None = None
    clustered: Clustered | None = field(default=None, repr=False)
    spread_unknown: bool = False
    naive: "PodFit | None" = field(default=None, repr=False)


def fit_pooled(table: Trials, *, link: Link, log_size: bool, method: str, divisor: float = 1.0) -> PodFit:
    """Fit with every trial taken as independent, the log-likelihood divided by `divisor` (1: as it is)."""
    x_rows = np.log(table.size) if log_size else table.size
    x, hits, misses = group_by_size(x_rows, table.hits, table.misses)
    design = np.stack((np.ones_like(x), x), axis=1)
    notes: list[str] = []
    separated = check_separation(design, hits, misses)
    used = method
    if method == "auto":
        used = "firth" if separated and 0 < table.n_hits < table.n and len(x) > 1 else "ml"
    common: dict[str, Any] = {
        "link": link.name,
        "method": used,
        "variant": FIRTH_VARIANT if used == "firth" else "maximum likelihood",
        "repeats": "pooled",
        "log_size": log_size,
        "n": table.n,
        "n_hits": table.n_hits,
        "smallest_size": float(table.size.min()),
        "largest_size": float(table.size.max()),
        "separated": separated,
    }

    def empty(reason: str) -> PodFit:
        return PodFit(**common, warnings=(*notes, reason))

    if len(x) < 2:
        return empty("all trials have the same size: a curve needs at least two sizes")
    if table.n_hits in (0, table.n):
        what = "a hit" if table.n_hits else "a miss"
        return empty(f"every trial is {what}: the data hold no sizes with POD between 0 and 1, so no curve and no a90")
    if separated and used == "ml":
        return empty(
            "hits and misses do not overlap in size (the data separate): no most likely curve exists; use method firth"
        )
    if used == "ml":
        coefficients = _fit_statsmodels(design, hits, misses, link)
    else:
        batch = fit_batch(design, hits[None], misses[None], link=link, bias_reduced=True)
        if not batch.converged[0]:
            why = "hits and misses do not overlap in size, and " if separated else ""
            return empty(f"{why}the bias-reduced fit did not converge")
        coefficients = batch.coefficients[0]
    eta = design @ coefficients
    parts = link.log_parts(eta)
    log_likelihood = float(hits @ parts.log_hit + misses @ parts.log_miss)
    weight = -(hits + misses) * parts.log_hit_1 * parts.log_miss_1
    covariance = _inverse((design * weight[:, None]).T @ design) * divisor
    saturated = _saturated_log_likelihood(table.hits, table.misses)
    constant = _log_arrangements(table.hits, table.misses)
    if separated:
        # an ever steeper curve fits all but the size that hits and misses share, if there is one
        supremum = _saturated_log_likelihood(hits, misses)
    else:
        supremum = log_likelihood if used == "ml" else _ml_supremum(design, hits, misses, link, log_likelihood)
    curve = Curve(
        x=x,
        hits=hits,
        misses=misses,
        link=link,
        coefficients=(float(coefficients[0]), float(coefficients[1])),
        covariance=covariance,
        supremum=supremum,
        divisor=divisor,
        at_maximum=used == "ml",
    )
    sizes = sizes_from_curve(curve, table=table, log_size=log_size, separated=separated)
    if method == "auto" and used == "firth":
        told = "hits and misses do not overlap in size (the data separate): no most likely curve exists; "
        told += "the curve is Firth's bias-reduced one"
        if sizes.a90 is not None:
            told += ", with Wald's upper bounds on a90 and no lower ones"
        notes.append(told + "; sizes with more overlap would say more")
    return PodFit(
        **common,
        c0=curve.coefficients[0],
        c1=curve.coefficients[1],
        se0=math.sqrt(covariance[0, 0]),
        se1=math.sqrt(covariance[1, 1]),
        log_likelihood=log_likelihood + constant,
        deviance=max(2 * (saturated - log_likelihood), 0.0),
        aic=2 * 2 - 2 * (log_likelihood + constant),
        a50=sizes.a50,
        a90=sizes.a90,
        a90_95=sizes.one_sided,
        a90_95_two_sided=sizes.two_sided,
        a90_low_two_sided=sizes.low,
        reaches_90=sizes.reaches_90,
        warnings=(*notes, *sizes.warnings),
        curve=curve,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """What a curve says about sizes, in the data's unit, with the reasons for what it cannot say."""

    a50: float | None
    a90: float | None
    one_sided: Bounds
    two_sided: Bounds
    low: Bounds
    reaches_90: bool
    warnings: tuple[str, ...]
    degrees_of_freedom: float | None = None


def sizes_from_curve(
    curve: Curve, *, table: Trials, log_size: bool, clustered: Clustered | None = None, separated: bool = False
) -> Sizes:
    """a50, a90 and its bounds in the data's unit; a size outside the tested range is None with its reason.

    Args:
        curve: the fitted curve.
        table: the trials it was fitted to.
        log_size: whether the curve is on ln size.
        clustered: variances to take in the place of the curve's own, with their degrees of freedom. Likelihood bounds are
            then those of as many independent trials as have this variance of eta at a90 (the design effect).
        separated: the data separate, so Wald's upper bounds alone are given, where the likelihood gives any.
    """
    notes: list[str] = []
    smallest, largest = float(curve.x[0]), float(curve.x[-1])
    c0, c1 = curve.coefficients
    if not c1 > 0:
        notes.append("POD does not rise with size in these data: no a50 and no a90")
        return Sizes(
            a50=None,
            a90=None,
            one_sided=NO_BOUNDS,
            two_sided=NO_BOUNDS,
            low=NO_BOUNDS,
            reaches_90=bool(curve.link.pod_from_eta(np.array(c0 + c1 * smallest)) >= 0.9),
            warnings=tuple(notes),
        )
    at: dict[int, float | None] = {}
    for percent in (50, 90):
        x = (curve.link.eta_from_pod(percent / 100) - c0) / c1
        at[percent], note = size_in_range(x, smallest=smallest, largest=largest, log_size=log_size, percent=percent)
        if note:
            notes.append(note)
    bounds, freedom = _Bounds90(one_sided=NO_BOUNDS, two_sided=NO_BOUNDS, low=NO_BOUNDS), None
    if at[90] is not None:
        x90 = math.log(at[90]) if log_size else at[90]
        bounds, freedom = _bounds_on_a90(curve, x90=x90, log_size=log_size, clustered=clustered, separated=separated)
        notes += _notes_on_bounds(bounds, separated=separated, largest_size=float(table.size.max()))
    return Sizes(
        a50=at[50],
        a90=at[90],
        one_sided=bounds.one_sided,
        two_sided=bounds.two_sided,
        low=bounds.low,
        reaches_90=bool((curve.link.eta_from_pod(0.9) - c0) / c1 <= largest),
        warnings=tuple(notes),
        degrees_of_freedom=None if clustered is None else freedom,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bounds90:
    """One-sided upper, two-sided upper and two-sided lower 95 % bounds on a90, in the data's unit."""

    one_sided: Bounds
    two_sided: Bounds
    low: Bounds


def _bounds_on_a90(
    curve: Curve, *, x90: float, log_size: bool, clustered: Clustered | None, separated: bool
) -> tuple[_Bounds90, float]:
    """Bounds on a90 = size at `x90`, and their degrees of freedom; other arguments as of `sizes_from_curve`."""
    toward = np.array([1.0, x90])
    variance = float(toward @ curve.covariance @ toward)
    error = math.sqrt(max(variance, 0.0)) / curve.coefficients[1]
    judged, freedom = curve, math.inf
    if clustered is not None:
        variance_of_clusters, degrees = clustered.variance(toward)
        freedom = float(degrees)
        judged = effective_trials(curve, float(variance_of_clusters) / variance)
    eta = curve.link.eta_from_pod(0.9)
    inside = x90 if separated else curve.most_likely_x(eta)

    def bound(below: float, *, upper: bool) -> Bounds:
        z = float(student_quantile(below, freedom))
        wald: float | None = x90 + z * error if upper else x90 - z * error
        if separated:
            if not upper or may_be_flat(judged, eta=eta, quantile=z * z, upper=upper):
                wald = None
            return Bounds(wald=size_from_x(wald, log_size=log_size))
        ratio = size_bound(judged, eta=eta, quantile=z * z, upper=upper, start=inside)
        modified = modified_bound(judged, eta=eta, z=z, upper=upper, start=ratio) if curve.at_maximum else None
        if clustered is not None:
            by_test = size_from_test(
                lambda at: _excess(curve, clustered, eta=eta, x=at),
                below=below,
                upper=upper,
                start=x90,
                span=float(curve.x[-1]) - float(curve.x[0]),
            )
            wald = not_short_of_likelihood(by_test, ratio if modified is None else modified, upper=upper)
        return Bounds(
            likelihood_ratio=size_from_x(ratio, log_size=log_size),
            wald=size_from_x(wald, log_size=log_size),
            modified=size_from_x(modified, log_size=log_size),
        )

    found = _Bounds90(
        one_sided=bound(ONE_SIDED, upper=True),
        two_sided=bound(TWO_SIDED, upper=True),
        low=bound(TWO_SIDED, upper=False),
    )
    return found, freedom


def _notes_on_bounds(bounds: _Bounds90, *, separated: bool, largest_size: float) -> list[str]:
    """Why a bound on a90 is not given, and that one is extrapolated."""
    notes = []
    if trusted_bound(bounds.two_sided, separated=separated) is None:
        neither = trusted_bound(bounds.one_sided, separated=separated) is None
        which = "one-sided or two-sided" if neither else "two-sided"
        notes.append(
            f"a flat curve is within the {which} 95 % likelihood region: the data give no upper likelihood-ratio"
            " bound on a90 (more trials, or sizes over a wider range, would)"
        )
    if not separated and trusted_bound(bounds.low, separated=separated) is None:
        notes.append(
            "a flat curve above 90 % is within the two-sided 95 % likelihood region: the data give no lower likelihood-ratio"
            " bound on a90 (more small sizes would)"
        )
    one = bounds.one_sided
    given = [value for value in (one.likelihood_ratio, one.wald, one.modified) if value is not None]
    if given and max(given) > largest_size:
        notes.append(f"a 95 % bound on a90 lies beyond the largest size tested ({largest_size:g}): extrapolated")
    return notes


def effective_trials(curve: Curve, design_effect: float) -> Curve:
    """The curve with its trials divided by the design effect: as many independent trials as would have its variance.

    Source: Rao & Scott, Biometrics 48 (1992) 577, doi:10.2307/2532311.
    """
    return replace(
        curve,
        hits=curve.hits / design_effect,
        misses=curve.misses / design_effect,
        supremum=curve.supremum / design_effect,
        covariance=curve.covariance * design_effect,
    )


def _excess(curve: Curve, clustered: Clustered, *, eta: float, x: float) -> tuple[float, float, float]:
    variance, freedom = clustered.variance(np.array([1.0, x]))
    return curve.coefficients[0] + curve.coefficients[1] * x - eta, float(variance), float(freedom)


def size_in_range(
    x: float, *, smallest: float, largest: float, log_size: bool, percent: int
) -> tuple[float | None, str]:
    """The size at x in the data's unit, or None with the reason where x lies outside the tested range."""
    low, high = (math.exp(smallest), math.exp(largest)) if log_size else (smallest, largest)
    margin = 1e-9 * (largest - smallest)
    if not x <= largest + margin:
        far = size_from_x(x, log_size=log_size)
        beyond = "" if far is None else f" (the curve would reach it at {far:.4g})"
        return None, f"POD does not reach {percent} % up to the largest size tested, {high:.4g}{beyond}: no a{percent}"
    if x < smallest - margin:
        return (
            None,
            f"POD is above {percent} % already at the smallest size tested, {low:.4g}: a{percent} lies below it",
        )
    return size_from_x(x, log_size=log_size), ""


def size_from_x(x: float | None, *, log_size: bool) -> float | None:
    """The size in the data's unit from the x of the fit (ln size if `log_size`); None stays None."""
    if x is None or not math.isfinite(x):
        return None
    if log_size:
        return math.exp(x) if x < 700 else None
    return float(x)


def _fit_statsmodels(design: Array, hits: Array, misses: Array, link: Link) -> Array:
    import statsmodels.api as sm

    families = sm.families
    links = {
        "cloglog": families.links.CLogLog,
        "loglog": families.links.LogLog,
        "logit": families.links.Logit,
        "probit": families.links.Probit,
    }
    # statsmodels' iteration has no step control: start it where Newton with step halving ends
    start = fit_batch(design, hits[None], misses[None], link=link)
    if not start.converged[0]:
        raise FitError("the maximum-likelihood fit of the POD curve did not converge; try another link or log size")
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore")
        model = sm.GLM(np.stack((hits, misses), axis=1), design, family=families.Binomial(link=links[link.name]()))
        answer = model.fit(start_params=start.coefficients[0], tol=1e-13, maxiter=50)
    coefficients = np.asarray(answer.params, dtype=float)
    # where the two disagree by more than rounding the one with the higher likelihood is the maximum
    parts = [link.log_likelihood(design @ c) for c in (coefficients, start.coefficients[0])]
    values = [float(hits @ up + misses @ down) for up, down in parts]
    return coefficients if values[0] >= values[1] - 1e-10 * abs(values[1]) else start.coefficients[0]


def _inverse(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    try:
        inverse = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        inverse = np.full_like(information, np.nan)
    if not np.all(np.diag(inverse) > 0):
        raise FitError(
            "the sizes differ too little beside their distance from 0 to tell the slope of the POD curve; subtract a constant"
            " from them"
        )
    return np.asarray(inverse)


def _saturated_log_likelihood(hits: Array, misses: Array) -> float:
    total = hits + misses
    with np.errstate(divide="ignore", invalid="ignore"):
        up = np.where(hits > 0, hits * np.log(hits / total), 0.0)
        down = np.where(misses > 0, misses * np.log(misses / total), 0.0)
    return float((up + down).sum())


def _log_arrangements(hits: Array, misses: Array) -> float:
    """ln of the number of orders in which grouped hits can come: 0 for single trials, and part of AIC as R prints
    it.
    """
    if not np.any(hits + misses > 1):
        return 0.0
    from scipy.special import gammaln

    return float((gammaln(hits + misses + 1) - gammaln(hits + 1) - gammaln(misses + 1)).sum())


def _ml_supremum(design: Array, hits: Array, misses: Array, link: Link, fitted: float) -> float:
    batch = fit_batch(design, hits[None], misses[None], link=link)
    return max(float(batch.log_likelihood[0]), fitted) if batch.converged[0] else fitted

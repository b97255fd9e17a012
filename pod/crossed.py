"""Crossed random effects: every network looks at every image, and both bring their own luck.

g(POD) = c0 + c1 x + u_network + v_image,  u ~ N(0, sd_network^2),  v ~ N(0, sd_image^2)

The likelihood is Laplace's. a50 and a90 are those of the population-averaged curve, POD(x) = E[g^-1(c0 + c1 x + s Z)]
with s^2 = sd_network^2 + sd_image^2 and Z standard normal: the chance that a network drawn from the population finds
the object in an image drawn from the population. Bounds come from the profile likelihood of the averaged a90, its Wald
form, and a modified form that also averages over slope and spreads (see `_averaged_size.py`): the one to trust. All three take
Student's quantile with the degrees of freedom of their variance (see `few_groups.py`): with few networks the spread
between them is poorly known, and the bounds say so by their width. They rest on Laplace's method with the observed
curvature; the expected one, which the estimate shares with lme4, puts a90 some 2 % low under links other than logit.

Validity: networks and images are samples of what the curve is to speak for. Two of each are the least that show a spread;
with one network the curve is of that network alone.

Source: Bates, Maechler, Bolker & Walker, J. Stat. Softw. 67 (2015) 1, doi:10.18637/jss.v067.i01.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from ._averaged_size import AveragedSize, CrossedTrials
from .few_groups import ONE_SIDED, TWO_SIDED, not_short_of_likelihood
from .hit_miss import (
    NO_BOUNDS,
    Bounds,
    CrossedEffects,
    PodFit,
    fit_pooled,
    size_from_x,
    size_in_range,
)
from .links import Link
from .mixed import LARGEST_SD, Codes, MixedFit, averaged_eta, averaged_pod
from .trials import Trials

Array = NDArray[np.float64]

ONE_NETWORK = "one network: curve and bounds are of this network alone, not of others trained alike"
SEPARATED = (
    "hits and misses do not overlap: nothing tells how much networks and images differ, so there are no bounds on a90"
)


def without_bounds(fit: PodFit) -> PodFit:
    """The fit with every bound on a90 taken out."""
    return replace(fit, spread_unknown=True, a90_95=NO_BOUNDS, a90_95_two_sided=NO_BOUNDS, a90_low_two_sided=NO_BOUNDS)


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
            notes.append(ONE_NETWORK if name == "network" else "one image: curve and bounds are of this image alone")
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
        FitError: the search did not converge, or it ended where the likelihood has no maximum.
    """
    if table.network is None and table.image is None:
        raise InputError(
            "repeats crossed",
            received="no column of networks or images",
            expected="at least one of them",
            remedy="use repeats='pooled' (--repeats pooled) where each trial is independent",
        )
    if method == "firth":
        raise InputError(
            "method firth",
            received="with repeats crossed",
            expected="maximum likelihood where there are random effects",
            remedy="use repeats='cluster' (--repeats cluster) with method firth",
        )
    naive = fit_pooled(table, link=link, log_size=log_size, method=method)
    factors, names, notes = usable_factors(table)
    if naive.curve is None or naive.separated or not factors:
        plain = replace(naive, repeats="crossed", naive=naive, warnings=(*naive.warnings, *notes))
        if not (naive.separated and naive.curve is not None and factors):
            return plain
        kept = (note for note in plain.warnings if "bound" not in note)
        return without_bounds(replace(plain, warnings=(*kept, SEPARATED)))
    x = np.log(table.size) if log_size else table.size
    design = np.stack((np.ones_like(x), x), axis=1)
    trials = CrossedTrials(table=table, design=design, factors=factors, link=link)
    mixed = trials.fit(np.array(naive.curve.coefficients))
    sd = dict(zip(names, mixed.sd, strict=True))
    total = math.hypot(*mixed.sd)
    for name, value in sd.items():
        if value > LARGEST_SD:
            notes.append(
                f"the spread between {name}s is larger than these looks can tell: nearly each is all hits or all misses"
            )
    c0, c1 = mixed.coefficients
    smallest, largest = float(x.min()), float(x.max())
    sizes: dict[int, float | None] = {50: None, 90: None}
    conditional: dict[int, float | None] = {50: None, 90: None}
    one = two = low = NO_BOUNDS
    freedom: float | None = None
    levels = trials.levels_of(mixed, trials.laplace(expected=True))
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
            one, two, low, freedom = _bounds(mixed, trials, log_size=log_size, notes=notes)
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
        se0=_error(mixed.covariance[0, 0]),
        se1=_error(mixed.covariance[1, 1]),
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
            levels=levels,
        ),
        degrees_of_freedom=freedom,
        naive=naive,
    )


def _error(variance: float) -> float | None:
    """Standard error; None where the likelihood has no maximum to take a curvature at."""
    return math.sqrt(variance) if variance >= 0 else None


def _bounds(
    mixed: MixedFit, trials: CrossedTrials, *, log_size: bool, notes: list[str]
) -> tuple[Bounds, Bounds, Bounds, float | None]:
    """One-sided upper, two-sided upper and lower bounds on the averaged a90, in the data's unit; degrees of freedom."""
    refit = mixed
    if trials.link.name != "logit":
        try:
            refit = trials.fit(mixed.coefficients, expected=False)
        except FitError:
            notes.append("the likelihood with its observed curvature did not converge: no bounds on a90")
            return NO_BOUNDS, NO_BOUNDS, NO_BOUNDS, None
    size = AveragedSize(refit, trials)
    asked = ((ONE_SIDED, 1.0), (TWO_SIDED, 1.0), (TWO_SIDED, -1.0))
    results = [
        Bounds(
            likelihood_ratio=size_from_x(size.likelihood_bound(below, side), log_size=log_size),
            wald=size_from_x(
                not_short_of_likelihood(size.wald_bound(below, side), modified, upper=side > 0), log_size=log_size
            ),
            modified=size_from_x(modified, log_size=log_size),
        )
        for (below, side), modified in zip(asked, size.modified_bounds(asked), strict=True)
    ]
    if results[0].likelihood_ratio is None or results[1].likelihood_ratio is None:
        notes.append(
            "the likelihood gives no upper bound on a90: more images, networks or a wider range of sizes would"
        )
    largest_size = float(trials.table.size.max())
    given = [v for v in (results[0].likelihood_ratio, results[0].wald, results[0].modified) if v is not None]
    if given and max(given) > largest_size:
        notes.append(f"a 95 % bound on a90 lies beyond the largest size tested ({largest_size:g}): extrapolated")
    return results[0], results[1], results[2], size.degrees_of_freedom

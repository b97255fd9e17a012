"""Repeated looks: many networks at the same images are not independent trials. One explicit table of what to do."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import FitError, InputError
from .crossed import ONE_NETWORK, SEPARATED, fit_crossed, without_bounds
from .hit_miss import METHODS, PodFit, fit_pooled, sizes_from_curve
from .links import Link, link_from_name
from .mixed import LARGEST_SD
from .robust import FEWEST_CLUSTERS, clustered_curve
from .trials import Trials, check_trials

__all__ = ["REPEATS", "fit_cluster", "fit_crossed_where_finite", "fit_pod", "fit_scaled", "fit_trials"]


def fit_scaled(table: Trials, *, link: Link, log_size: bool, method: str) -> PodFit:
    """The handbook's treatment: the log-likelihood is divided by the number of inspections of a site.

    The curve is the pooled one; its intervals are those of as many trials as there are sites.
    Source: MIL-HDBK-1823A (2009) G.3, example 5.

    Raises:
        InputError: no site (or image) is known.
    """
    site = table.site if table.site is not None else table.image
    if site is None:
        raise InputError(
            "repeats scaled",
            received="no column of sites",
            expected="the site (or image) of each trial",
            remedy="name its column: site=... (--site)",
        )
    sites = int(site.max()) + 1
    inspections = table.n / sites
    naive = fit_pooled(table, link=link, log_size=log_size, method=method)
    fit = fit_pooled(table, link=link, log_size=log_size, method=method, divisor=inspections)
    notes = fit.warnings
    if inspections <= 1:
        notes = (*notes, "each site was inspected once: scaling changes nothing")
    return replace(fit, repeats="scaled", naive=naive, warnings=notes)


def fit_cluster(table: Trials, *, link: Link, log_size: bool, method: str) -> PodFit:
    """The pooled curve with intervals robust to repeats: two-way clustered by network and by image (or site).

    Variances are jackknifed (`robust.Clustered`), quantiles Student's with Satterthwaite's degrees of freedom, likelihood
    bounds those of as many independent trials as have the same variance of eta at a90. The curve is a population-averaged
    one. There are no bounds where nothing tells the variance: with two networks or images, where hits and misses do not
    overlap, and where one network or image alone holds up the curve.
    Source: Cameron, Gelbach & Miller, J. Bus. Econ. Stat. 29 (2011) 238; Rao & Scott, Biometrics 48 (1992) 577.

    Raises:
        InputError: neither network, image nor site is known.
    """
    image = table.image if table.image is not None else table.site
    groups = [codes for codes in (table.network, image) if codes is not None and codes.max() > 0]
    if table.network is None and image is None:
        raise InputError(
            "repeats cluster",
            received="no column of networks, images or sites",
            expected="at least one of them",
            remedy="name the site's column: site=... (--site), or use repeats='pooled' (--repeats pooled)",
        )
    naive = fit_pooled(table, link=link, log_size=log_size, method=method)
    if naive.curve is None:
        return replace(naive, repeats="cluster", naive=naive)
    notes = [note for note in naive.warnings if "bound" not in note]
    if not groups:
        return replace(naive, repeats="cluster", naive=naive)
    if table.network is not None and table.network.max() == 0:
        notes.append(ONE_NETWORK)
    clustered = None
    if naive.separated:
        why = SEPARATED
    elif any(codes.max() + 1 < FEWEST_CLUSTERS for codes in groups):
        why = "two clusters (networks or images) differ in one way only, which tells no spread: no bounds on a90"
    else:
        why = "one network or image alone holds up the curve: no bounds on a90"
        clustered = clustered_curve(table, naive.curve, groups=groups, log_size=log_size)
    if clustered is None:
        return without_bounds(replace(naive, repeats="cluster", naive=naive, warnings=(*notes, why)))
    sizes = sizes_from_curve(naive.curve, table=table, log_size=log_size, clustered=clustered)
    error0, error1 = (math.sqrt(float(clustered.variance(unit)[0])) for unit in np.eye(2))
    return replace(
        naive,
        repeats="cluster",
        se0=error0,
        se1=error1,
        a90_95=sizes.one_sided,
        a90_95_two_sided=sizes.two_sided,
        a90_low_two_sided=sizes.low,
        degrees_of_freedom=sizes.degrees_of_freedom,
        clustered=clustered,
        warnings=tuple(dict.fromkeys((*notes, *sizes.warnings))),
        naive=naive,
    )


def fit_crossed_where_finite(table: Trials, *, link: Link, log_size: bool, method: str) -> PodFit:
    """Crossed random effects; the clustered curve, and said so, where they do not converge or a spread has no finite estimate.

    When every network hits or misses the same images, the likelihood rises with the images' spread without end. The
    averaged curve is then that of the assumed Gaussian's far tails rather than of the data, and its a90 lies far beyond the
    sizes at which anything is missed; the pooled curve is population-averaged without such an assumption.

    Raises:
        InputError: neither network nor image is known.
        FitError: the pooled curve has no fit either.
    """
    try:
        fit = fit_crossed(table, link=link, log_size=log_size, method=method)
    except FitError as error:
        why = str(error)
    else:
        if fit.crossed is None:
            return fit
        spreads = {"network": fit.crossed.sd_network, "image": fit.crossed.sd_image}
        endless = [name for name, sd in spreads.items() if sd is not None and sd > LARGEST_SD]
        if not endless:
            return fit
        which = " and ".join(f"{name}s" for name in endless)
        why = f"the spread between {which} is larger than these looks can tell"
    clustered = fit_cluster(table, link=link, log_size=log_size, method=method)
    told = f"{why}: curve and bounds are the clustered ones (repeats cluster)"
    return replace(clustered, warnings=(told, *clustered.warnings))


REPEATS: dict[str, Callable[..., PodFit]] = {
    "pooled": fit_pooled,
    "crossed": fit_crossed_where_finite,
    "scaled": fit_scaled,
    "cluster": fit_cluster,
}


def fit_pod(
    size: ArrayLike,
    hits: ArrayLike,
    *,
    trials: ArrayLike | None = None,
    link: str = "cloglog",
    log_size: bool = False,
    method: str = "auto",
    repeats: str = "pooled",
    network: ArrayLike | None = None,
    image: ArrayLike | None = None,
    site: ArrayLike | None = None,
) -> PodFit:
    """Fit a POD curve; sizes in the unit of `size`.

    g(POD) = c0 + c1 x by maximum likelihood (statsmodels), or with Firth's mean-bias reduction. `auto` is maximum
    likelihood, and the bias-reduced fit where hits and misses do not overlap (said in `warnings`).

    Args:
        size: (row,), finite, in any unit; above 0 with `log_size`.
        hits: (row,), 0 or 1, or counts where `trials` is given.
        trials: (row,), number of trials of each row.
        link: `cloglog`, `loglog`, `logit` or `probit`.
        log_size: fit on the natural logarithm of the size.
        method: `auto`, `ml` or `firth`.
        repeats: `pooled` (independent trials), `crossed` (random effects of network and image), `scaled` (the
            handbook's division by the number of inspections of a site), `cluster` (robust to repeats of networks and
            images).
        network, image, site: (row,), labels of who looked and at what; `site` defaults to `image`.

    Returns:
        The fit. Sizes that the data cannot support are None, with the reason in `warnings`.

    Raises:
        InputError: an unknown option, or columns that do not fit together (see `check_trials`).
    """
    if method not in METHODS:
        raise InputError("method", received=repr(method), expected="one of " + ", ".join(METHODS))
    table = check_trials(size, hits, trials=trials, network=network, image=image, site=site, log_size=log_size)
    return fit_trials(table, link=link, log_size=log_size, method=method, repeats=repeats)


def fit_trials(table: Trials, *, link: str, log_size: bool, method: str = "auto", repeats: str = "pooled") -> PodFit:
    """`fit_pod` on checked trials."""
    if repeats not in REPEATS:
        raise InputError("repeats", received=repr(repeats), expected="one of " + ", ".join(REPEATS))
    return REPEATS[repeats](table, link=link_from_name(link), log_size=log_size, method=method)

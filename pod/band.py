"""The curve at any size, with its band; rows to export."""

import csv
import math
import os

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FitError
from ..files import whole_file
from .few_groups import TWO_SIDED, student_quantile
from .hit_miss import PodFit
from .likelihood import eta_band
from .links import link_from_name
from .mixed import averaged_pod

Array = NDArray[np.float64]

CHI2_95 = {1: 3.841458820694124, 2: 5.991464547107979}


def curve_with_band(fit: PodFit, size: ArrayLike, *, simultaneous: bool = False) -> tuple[Array, Array, Array]:
    """POD with the ends of its two-sided 95 % band at each size, three arrays of the shape of `size`, 0 to 1.

    Likelihood-ratio band, each size for itself or (`simultaneous`) the whole curve at once, from the joint region. With
    crossed random effects the population-averaged curve, its band by the delta method on the logit scale. For `cluster`
    the pooled curve and the likelihood of as many trials as have its variance. Both take Student's quantile as the
    bounds on a90 do (Scheffe's F with 2 and as many degrees of freedom where simultaneous). Where the data separate the
    band is Wald's.

    Args:
        fit: a fit that has a curve.
        size: (size,), in the data's unit; above 0 on log size.

    Raises:
        FitError: the fit has no curve.

    >>> from raytwin.pod import fit_pod
    >>> fit = fit_pod([1, 2, 3, 4, 5, 6, 7, 8], [0, 0, 1, 0, 1, 0, 1, 1], link="logit")
    >>> [float(ends.round(2)[0]) for ends in curve_with_band(fit, [4.0])]
    [0.43, 0.09, 0.8]
    """
    if fit.curve is None or fit.c0 is None or fit.c1 is None:
        raise FitError("there is no curve to draw: " + "; ".join(fit.warnings))
    link = link_from_name(fit.link)
    sizes = np.asarray(size, dtype=float)
    x = np.log(sizes) if fit.log_size else sizes
    quantile = CHI2_95[2 if simultaneous else 1]
    if fit.crossed is None:
        curve = fit.curve
        allowed = np.full(x.size, quantile)
        if fit.clustered is not None:
            toward = np.stack((np.ones(x.size), x.ravel()), axis=1)
            variance, freedom = fit.clustered.variance(toward)
            allowed = _quantile(freedom, simultaneous=simultaneous)
            allowed = allowed * variance / np.einsum("ki,ij,kj->k", toward, curve.covariance, toward)
        if fit.separated:  # as the bounds on a90: likelihood regions are too narrow
            toward = np.stack((np.ones(x.size), x.ravel()), axis=1)
            spread = np.sqrt(quantile * np.einsum("ki,ij,kj->k", toward, curve.covariance, toward))
            middle = toward @ np.array(curve.coefficients)
            low, high = middle - spread, middle + spread
        else:
            low, high = eta_band(curve, x.ravel(), quantile=allowed)
        if fit.spread_unknown:
            low, high = np.full(x.size, -np.inf), np.full(x.size, np.inf)
        eta = curve.coefficients[0] + curve.coefficients[1] * x
        ends = (link.pod_from_eta(np.asarray(np.clip(end, -1e3, 1e3))).reshape(x.shape) for end in (low, high))
        return (np.asarray(link.pod_from_eta(eta)), *ends)  # type: ignore[return-value]
    parameters = np.array(
        [fit.c0, fit.c1, *(sd for sd in (fit.crossed.sd_network, fit.crossed.sd_image) if sd is not None)]
    )

    def pod_at(p: Array) -> Array:
        return averaged_pod(p[0] + p[1] * x, math.hypot(*p[2:]), link=link)

    pod = np.clip(pod_at(parameters), 1e-300, 1 - 1e-15)
    odds = np.log(pod) - np.log1p(-pod)
    rise = []
    for index, value in enumerate(parameters):
        width = 1e-5 * max(abs(value), 1e-2)
        ahead, behind = parameters.copy(), parameters.copy()
        ahead[index] += width
        behind[index] -= width
        rise.append((pod_at(ahead) - pod_at(behind)) / (2 * width) / np.maximum(pod * (1 - pod), 1e-300))
    gradient = np.stack(rise, axis=-1)
    variance = np.maximum(np.einsum("...i,ij,...j->...", gradient, fit.crossed.covariance, gradient), 0.0)
    variance, freedom = fit.crossed.levels.spread(variance, gradient[..., 0])
    spread = np.sqrt(_quantile(freedom, simultaneous=simultaneous) * variance)
    low, high = (1 / (1 + np.exp(-np.clip(odds + side * spread, -700, 700))) for side in (-1, 1))
    return pod, np.asarray(low), np.asarray(high)


def _quantile(freedom: Array, *, simultaneous: bool) -> Array:
    """What a squared deviation over its variance stays below with 95 %: of one size, or of all at once."""
    if not simultaneous:
        return student_quantile(TWO_SIDED, freedom) ** 2
    from scipy.special import fdtri

    known = np.isfinite(freedom)
    return np.asarray(np.where(known, 2 * fdtri(2, np.where(known, freedom, 1.0), 0.95), CHI2_95[2]))


def curve_rows(fit: PodFit, *, points: int = 101) -> dict[str, Array]:
    """The curve over the tested sizes: columns size (data's unit), pod, low, high (two-sided 95 %, each size for
    itself).
    """
    ends = fit.smallest_size, fit.largest_size
    size = np.geomspace(*ends, points) if fit.log_size else np.linspace(*ends, points)
    pod, low, high = curve_with_band(fit, size)
    return {"size": size, "pod": pod, "low": low, "high": high}


def write_curve_table(path: str | os.PathLike[str], fit: PodFit, *, size_name: str = "size") -> None:
    """Write `curve_rows` as comma-separated values, whole or not at all; the first column bears `size_name`."""
    rows = curve_rows(fit)
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow([size_name, "pod", "pod_low_95", "pod_high_95"])
        writer.writerows([f"{value:.9g}" for value in row] for row in zip(*rows.values(), strict=True))

"""Link functions g of hit/miss regression: g(POD) = c0 + c1 x. Everything the fits need of a link stands here.

| name | POD(eta) | eta at POD 50 % | comes from |
|---|---|---|---|
| cloglog | 1 - exp(-exp(eta)) | ln ln 2 | smallest extreme value; the paper's link |
| loglog | exp(-exp(-eta)) | -ln ln 2 | largest extreme value |
| logit | 1 / (1 + exp(-eta)) | 0 | logistic |
| probit | Phi(eta) | 0 | normal; a-hat with normal scatter |

All four have log-concave likelihoods, so a maximum is the only one and confidence regions are convex.
Source: MIL-HDBK-1823A (2009) appendix G; McCullagh & Nelder, Generalized Linear Models (1989), ch. 4.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Array = NDArray[np.float64]
_LIMIT = 690.0  # exp stays finite within it


@dataclass(frozen=True, slots=True, kw_only=True)
class LogParts:
    """ln POD and ln (1 - POD) with their first and second derivatives by eta; arrays of eta's shape, no unit."""

    log_hit: Array
    log_hit_1: Array
    log_hit_2: Array
    log_miss: Array
    log_miss_1: Array
    log_miss_2: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """A link function; `pod_curvature` is d2POD/deta2 over dPOD/deta (bias reduction uses it)."""

    name: str
    pod_from_eta: Callable[[Array], Array]
    eta_from_pod: Callable[[float], float]
    log_likelihood: Callable[[Array], tuple[Array, Array]]
    log_parts: Callable[[Array], LogParts]
    pod_curvature: Callable[[Array], Array]

    def __reduce__(self) -> tuple[Callable[[str], "Link"], tuple[str]]:
        """Pickled by name: functions are not."""
        return link_from_name, (self.name,)


def _hazard_parts(eta: Array) -> tuple[Array, Array, Array, Array]:
    """t = exp(eta), ln(1 - exp(-t)), r = t / (exp(t) - 1) and dr/d(eta), each without cancellation."""
    t = np.exp(np.clip(eta, -_LIMIT, 6.5))
    complement = -np.expm1(-t)
    r = t * (1 - complement) / complement
    slope = r * (1 - t - r)
    if t.min(initial=1.0) < 1e-4:
        slope = np.where(t < 1e-4, -t / 2 + t * t / 6, slope)
    return t, np.log(complement), r, slope


def _cloglog_parts(eta: Array) -> LogParts:
    t, log_hit, r, slope = _hazard_parts(eta)
    return LogParts(log_hit=log_hit, log_hit_1=r, log_hit_2=slope, log_miss=-t, log_miss_1=-t, log_miss_2=-t)


def _loglog_parts(eta: Array) -> LogParts:
    t, log_miss, r, slope = _hazard_parts(-eta)
    return LogParts(log_hit=-t, log_hit_1=t, log_hit_2=-t, log_miss=log_miss, log_miss_1=-r, log_miss_2=slope)


def _cloglog_log_likelihood(eta: Array) -> tuple[Array, Array]:
    t = np.exp(np.clip(eta, -_LIMIT, 6.5))
    return np.log(-np.expm1(-t)), -t


def _loglog_log_likelihood(eta: Array) -> tuple[Array, Array]:
    log_miss, log_hit = _cloglog_log_likelihood(-eta)
    return log_hit, log_miss


def _logit_parts(eta: Array) -> LogParts:
    hit, miss = _logit_pod(eta), _logit_pod(-eta)
    log_hit, log_miss = _logit_log_likelihood(eta)
    curvature = -hit * miss
    return LogParts(
        log_hit=log_hit, log_hit_1=miss, log_hit_2=curvature, log_miss=log_miss, log_miss_1=-hit, log_miss_2=curvature
    )


def _logit_pod(eta: Array) -> Array:
    return 0.5 * (1 + np.tanh(0.5 * eta))


def _logit_log_likelihood(eta: Array) -> tuple[Array, Array]:
    tail = np.log1p(np.exp(-np.abs(eta)))
    return np.minimum(eta, 0) - tail, np.minimum(-eta, 0) - tail


def _probit_pod(eta: Array) -> Array:
    from scipy.special import ndtr

    return np.asarray(ndtr(eta))


def _probit_log_likelihood(eta: Array) -> tuple[Array, Array]:
    from scipy.special import log_ndtr

    return np.asarray(log_ndtr(eta)), np.asarray(log_ndtr(-eta))


def _probit_parts(eta: Array) -> LogParts:
    eta = np.clip(eta, -1e8, 1e8)
    log_hit, log_miss = _probit_log_likelihood(eta)
    log_density = -0.5 * eta * eta - 0.5 * math.log(2 * math.pi)
    up = np.exp(np.minimum(log_density - log_hit, _LIMIT))
    down = np.exp(np.minimum(log_density - log_miss, _LIMIT))
    return LogParts(
        log_hit=log_hit,
        log_hit_1=up,
        log_hit_2=-up * (eta + up),
        log_miss=log_miss,
        log_miss_1=-down,
        log_miss_2=-down * (down - eta),
    )


def _normal_quantile(pod: float) -> float:
    from statistics import NormalDist

    return NormalDist().inv_cdf(pod)


LINKS: dict[str, Link] = {
    "cloglog": Link(
        name="cloglog",
        pod_from_eta=lambda eta: -np.expm1(-np.exp(np.clip(eta, -_LIMIT, 6.5))),
        eta_from_pod=lambda pod: math.log(-math.log1p(-pod)),
        log_likelihood=_cloglog_log_likelihood,
        log_parts=_cloglog_parts,
        pod_curvature=lambda eta: -np.expm1(np.clip(eta, -_LIMIT, 30.0)),
    ),
    "loglog": Link(
        name="loglog",
        pod_from_eta=lambda eta: np.exp(-np.exp(np.clip(-eta, -_LIMIT, 6.5))),
        eta_from_pod=lambda pod: -math.log(-math.log(pod)),
        log_likelihood=_loglog_log_likelihood,
        log_parts=_loglog_parts,
        pod_curvature=lambda eta: np.expm1(np.clip(-eta, -_LIMIT, 30.0)),
    ),
    "logit": Link(
        name="logit",
        pod_from_eta=_logit_pod,
        eta_from_pod=lambda pod: math.log(pod) - math.log1p(-pod),
        log_likelihood=_logit_log_likelihood,
        log_parts=_logit_parts,
        pod_curvature=lambda eta: -np.tanh(0.5 * eta),
    ),
    "probit": Link(
        name="probit",
        pod_from_eta=_probit_pod,
        eta_from_pod=_normal_quantile,
        log_likelihood=_probit_log_likelihood,
        log_parts=_probit_parts,
        pod_curvature=lambda eta: -eta,
    ),
}


def link_from_name(name: str) -> Link:
    """The link of that name.

    Raises:
        InputError: no link has that name.
    """
    if name not in LINKS:
        raise InputError("link", received=repr(name), expected="one of " + ", ".join(LINKS))
    return LINKS[name]

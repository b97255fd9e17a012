"""Modified likelihood-ratio bound: the directed deviance with Skovgaard's correction for few trials.

r* = r + ln(u / r) / r,  r = sign(a_hat - a) sqrt(2 (l_hat - l_p(a))),
u = [S^-1 Q]_a |j_hat|^(1/2) |i_hat|^-1 |S| |j_p|^(-1/2)

with S = cov(U(c_hat), U(c_a)) and Q = cov(U(c_hat), l(c_hat) - l(c_a)) under the fitted curve, exact for binomial
trials; i and j are expected and observed information, j_p that of the slope with a held. r* is closer to normal than
r, whose bound is too low below some 100 trials. Validity: maximum-likelihood fits of independent trials.
Source: Skovgaard, Bernoulli 2 (1996) 145, doi:10.2307/3318548; Brazzale, Davison & Reid, Applied Asymptotics (2007).
"""

import math

import numpy as np
from numpy.typing import NDArray

from .likelihood import Curve, profile

Array = NDArray[np.float64]


def modified_bound(curve: Curve, *, eta: float, z: float, upper: bool, start: float | None) -> float | None:
    """Bound on the x at which the curve reaches `eta`, from r* = -z (upper) or z (lower); x's own unit or None.

    Args:
        curve: a maximum-likelihood fit of independent trials (divisor 1).
        eta: g(POD) asked for.
        z: normal quantile (1.645 for a one-sided 95 % bound).
        upper: the bound above the estimate, else below.
        start: the plain likelihood-ratio bound; None gives None.
    """
    if start is None or curve.divisor != 1.0:
        return None
    estimate = (eta - curve.coefficients[0]) / curve.coefficients[1]
    side = 1.0 if upper else -1.0
    inner = start - estimate
    if not inner * side > 0:
        return None
    # secant on side r* + z, which rises away from the estimate
    points = [start, start + 0.2 * inner]
    values = [_excess(curve, at, eta, z, side) for at in points]
    for _ in range(40):
        if not (math.isfinite(values[-1]) and math.isfinite(values[-2])) or values[-1] == values[-2]:
            return None
        if abs(values[-1]) < 1e-8:
            return points[-1]
        step = -values[-1] * (points[-1] - points[-2]) / (values[-1] - values[-2])
        longest = 0.7 * abs(points[-1] - estimate)
        points.append(points[-1] + min(max(step, -longest), longest))
        values.append(_excess(curve, points[-1], eta, z, side))
        if abs(points[-1] - estimate) > 50 * abs(inner):
            return None
    return None


def _excess(curve: Curve, at: float, eta: float, z: float, side: float) -> float:
    c0, c1 = curve.coefficients
    x = curve.x
    total = curve.hits + curve.misses
    value, slope, _ = profile(curve, np.array([at]), np.array([eta]), np.array([c1]))
    held = float(slope[0])
    drop = 2 * (curve.supremum - float(value[0]))
    if not (drop > 0 and held > 0):
        return math.nan
    r = math.copysign(math.sqrt(drop), -side)
    full = curve.link.log_parts(c0 + c1 * x)
    part = curve.link.log_parts(eta + held * (x - at))
    design = np.stack((np.ones_like(x), x), axis=1)
    variance = total * np.exp(full.log_hit + full.log_miss)
    # derivatives of the log odds by eta, and the log odds themselves
    rate_full = full.log_hit_1 - full.log_miss_1
    rate_part = part.log_hit_1 - part.log_miss_1
    odds = (full.log_hit - full.log_miss) - (part.log_hit - part.log_miss)
    estimate = (eta - c0) / c1
    turn_full = np.array([[-c1, -estimate], [0.0, 1.0]])
    turn_part = np.array([[-held, -at], [0.0, 1.0]])
    spread = turn_full.T @ ((design * (variance * rate_full * rate_part)[:, None]).T @ design) @ turn_part
    cross = turn_full.T @ (design.T @ (variance * rate_full * odds))
    expected = turn_full.T @ ((design * (variance * rate_full**2)[:, None]).T @ design) @ turn_full
    observed_weight = -(curve.hits * full.log_hit_2 + curve.misses * full.log_miss_2)
    observed = turn_full.T @ ((design * observed_weight[:, None]).T @ design) @ turn_full
    slope_information = -float((curve.hits * part.log_hit_2 + curve.misses * part.log_miss_2) @ (x - at) ** 2)
    determinants = (np.linalg.det(observed), np.linalg.det(expected), np.linalg.det(spread), slope_information)
    if not all(value > 0 for value in determinants):
        return math.nan
    u = float(np.linalg.solve(spread, cross)[0])
    u *= math.sqrt(determinants[0]) / determinants[1] * determinants[2] / math.sqrt(determinants[3])
    if not u / r > 0:
        return math.nan
    return -side * (r + math.log(u / r) / r) - z

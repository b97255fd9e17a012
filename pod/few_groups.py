"""Variances that rest on few networks or images: Student's quantile with Satterthwaite's degrees of freedom.

A variance V is a sum of parts, and each part v_j is estimated from few groups, with m_j degrees of freedom. The estimate
divided by its standard error then follows Student's distribution with about

    m = V^2 / sum_j (v_j^2 / m_j)

degrees of freedom. Three networks thus widen a bound much where the networks' part is most of V, and little where the
images' part is.

Source: Satterthwaite, Biometrics Bull. 2 (1946) 110, doi:10.2307/3002019; for readers crossed with cases Hillis, Stat. Med.
26 (2007) 596, doi:10.1002/sim.2532; for mixed models Giesbrecht & Burns, Biometrics 41 (1985) 477, doi:10.2307/2530872.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ONE_SIDED, TWO_SIDED = 0.95, 0.975  # of the distribution that lies below the quantile
_FARTHEST = 50.0  # spans of the sizes beyond which a bound is taken as absent


def satterthwaite(variance: Array | float, parts: Sequence[tuple[Array | float, Array | float]]) -> Array:
    """Degrees of freedom of a variance, 1 or more; the shape of `variance`.

    Args:
        variance: the whole variance, in the square of any unit.
        parts: (variance, degrees of freedom) of each part that is estimated from few groups, in the same unit.

    >>> float(satterthwaite(3.0, [(1.0, 2.0), (2.0, 80.0)]).round(2))
    16.36
    """
    below = sum((np.asarray(v) ** 2 / m for v, m in parts), np.zeros(()))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.asarray(variance) ** 2 / below
    return np.asarray(np.where(np.isfinite(found), np.maximum(found, 1.0), np.inf))


def student_quantile(below: float, degrees_of_freedom: Array | float) -> Array:
    """Student's quantile with the share `below` of the distribution under it; the shape of `degrees_of_freedom`.

    >>> float(student_quantile(0.975, 2.0).round(3))
    4.303
    >>> float(student_quantile(0.975, float("inf")).round(3))
    1.96
    """
    from scipy.special import ndtri, stdtrit

    freedom = np.asarray(degrees_of_freedom, dtype=float)
    normal = float(ndtri(below))
    return np.asarray(
        np.where(np.isfinite(freedom), stdtrit(np.where(np.isfinite(freedom), freedom, 1.0), below), normal)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """What few networks and images add to the variance of a curve's constant, on the scale of eta squared.

    added: a spread sd of k levels is estimated by maximum likelihood as if the mean of the levels were known; its variance of
    the mean, sd^2 / k, is short by sd^2 / (k (k - 1)) (restricted likelihood makes the same correction). parts: the variance of
    the mean of each factor's levels, with what looks add to it, and its degrees of freedom k - 1.
    """

    added: float
    parts: tuple[tuple[float, float], ...]

    def spread(self, variance: Array | float, constant: Array | float) -> tuple[Array, Array]:
        """Corrected variance of a quantity and its degrees of freedom, both of the shape of `variance`.

        Args:
            variance: from the curvature of the likelihood, in the square of the quantity's unit.
            constant: the quantity's derivative by the curve's constant.
        """
        scale = np.asarray(constant, dtype=float) ** 2
        corrected = np.asarray(variance) + scale * self.added
        return corrected, satterthwaite(corrected, [(scale * part, m) for part, m in self.parts])


def levels_of(sd: Array, shares: Sequence[Array], information: float) -> Levels:
    """Corrections for factors of few levels.

    Args:
        sd: (factor,), spreads between levels on the scale of eta.
        shares: of each factor, (level,), the share of the looks at each level.
        information: on the constant, of all looks with the effects known; in 1 / eta squared.
    """
    added, parts = 0.0, []
    for value, share in zip(sd, shares, strict=True):
        of_mean = float(value**2 * (share**2).sum())
        more = len(share) - 1
        added += of_mean / more
        noise = 1 / information if information > 0 else math.inf
        parts.append((of_mean * (1 + 1 / more) + noise, float(more)))
    return Levels(added=added, parts=tuple(parts))


def not_short_of_likelihood(test: float | None, likelihood: float | None, *, upper: bool) -> float | None:
    """Wald's bound, grown to the likelihood's where that lies farther out: the likelihood is not quadratic there.

    Of 95 % bounds with three and five networks whose spread is 0.8 on the scale of eta, Wald's test alone gave 88 % (one-sided).

    >>> not_short_of_likelihood(0.21, 0.24, upper=True)
    0.24
    """
    if test is None or likelihood is None:
        return None
    return max(test, likelihood) if upper else min(test, likelihood)


def size_from_test(
    excess: Callable[[float], tuple[float, float, float]], *, below: float, upper: bool, start: float, span: float
) -> float | None:
    """Bound on the x of a90: where the Wald test of POD(x) = 90 % stops to reject (Fieller); x's own unit.

    The interval is not symmetric, and there is none where the slope itself is not known to be above 0.
    Source: Fieller, J. R. Stat. Soc. B 16 (1954) 175.

    Args:
        excess: of an x: how far eta there lies above that of POD 90 %, its variance, its degrees of freedom.
        below: share of Student's distribution under the quantile.
        upper: the bound above `start`, else below.
        start: the estimate, where the excess is 0.
        span: of the tested sizes, in x.
    """
    from scipy.optimize import brentq

    side = 1.0 if upper else -1.0

    def rejected(x: float) -> float:
        value, variance, freedom = excess(x)
        if not variance > 0:
            return math.nan
        return side * value / math.sqrt(variance) - float(student_quantile(below, freedom))

    inside, reach = start, 0.01 * span
    while reach < _FARTHEST * span:
        outside = start + side * reach
        value = rejected(outside)
        if math.isnan(value):
            return None
        if value > 0:
            return float(brentq(rejected, inside, outside, xtol=1e-10 * span))
        inside, reach = outside, 1.3 * reach
    return None

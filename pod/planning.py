"""Planning: how many foreign objects, images and networks for a wanted interval, and which sizes to make.

With an assumed curve and spread of networks and images, the expected covariance of the population-averaged curve is

V = A^-1 B A^-1,  A = sum d^2 x x' / (m (1 - m)),  B = var of sum d x (hit - m) / (m (1 - m))

with m the averaged POD and d its slope by eta; B holds the covariances of looks that share a network or an image, by
quadrature. Without repeats V is the usual Fisher information. Looks that repeat networks and images count as so many independent
ones as have the same spread of a90, and the expected bounds are those that `fit_pod` gives for these where hits and misses are as
expected: longer than Wald's, which the spread alone would give, and skewed upward.
Validity: below some 40 informative trials hits and misses may separate, and bounds are longer.
Source: Liang & Zeger, Biometrika 73 (1986) 13 (the estimating equation); MIL-HDBK-1823A (2009) 4.5.2 (sizes).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FitError, InputError, check_number
from .hit_miss import fit_pooled, trusted_bound
from .links import Link, link_from_name
from .mixed import averaged_eta, averaged_pod
from .trials import Trials

Array = NDArray[np.float64]

_MOST_IMAGES, _MOST_NETWORKS = 100_000, 1_000_000  # where searches end
_FINE = 60  # sizes of the pattern that stands for any number of images
_EXACT = 1e-6  # of the spread of a look at each of these: images without end and no spread of networks
FEW_TRIALS = 40  # informative ones; below, expect longer intervals than planned

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


@dataclass(frozen=True, slots=True, kw_only=True)
class AssumedCurve:
    """What one expects to find: averaged a50 and a90 (any unit, above 0), link, spread of networks and images on eta's scale."""

    a50: float
    a90: float
    link: str = "cloglog"
    log_size: bool = False
    sd_network: float = 0.0
    sd_image: float = 0.0

    def __post_init__(self) -> None:
        link_from_name(self.link)
        for name in ("a50", "a90", "sd_network", "sd_image"):
            check_number(name, getattr(self, name))
        if not 0.0 < self.a50 < self.a90 < math.inf:
            raise InputError(
                "a50 and a90",
                received=f"{self.a50:g} and {self.a90:g}",
                expected="finite sizes above 0, the a90 above the a50",
            )
        for name in ("sd_network", "sd_image"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(name, received=value, expected="a finite spread of 0 or more")

    def coefficients(self) -> tuple[float, float]:
        """c0 and c1 of an average network and image, per unit of size (of ln size)."""
        total = math.hypot(self.sd_network, self.sd_image)
        shape = link_from_name(self.link)
        low, high = (averaged_eta(p, total, link=shape) for p in (0.5, 0.9))
        a50, a90 = (math.log(a) if self.log_size else a for a in (self.a50, self.a90))
        c1 = (high - low) / (a90 - a50)
        return low - c1 * a50, c1

    def size_at(self, pod: float) -> float:
        """The size at which the averaged curve reaches `pod`."""
        c0, c1 = self.coefficients()
        total = math.hypot(self.sd_network, self.sd_image)
        x = (averaged_eta(pod, total, link=link_from_name(self.link)) - c0) / c1
        return math.exp(x) if self.log_size else x


@dataclass(frozen=True, slots=True, kw_only=True)
class Precision:
    """What a design may expect: sd of a90 in its unit, one-sided bound over a90, two-sided interval over a90; None: no such bound."""

    networks: int
    images: int
    sd_a90: float
    bound_over_a90: float | None
    low_over_a90: float | None
    high_over_a90: float | None


def expected_precision(curve: AssumedCurve, sizes: ArrayLike, *, networks: int = 1) -> Precision:
    """Expected precision of a90 when `networks` networks look at one image of each of the sizes.

    Args:
        curve: what is assumed.
        sizes: (image,), one foreign object an image, in the curve's unit.
        networks: number of networks, each looking at all images.

    Raises:
        InputError: sizes that cannot make a curve, or no network.
    """
    size = np.asarray(sizes, dtype=float)
    if size.ndim != 1 or len(size) < 2 or not np.all(np.isfinite(size)) or np.ptp(size) == 0:
        raise InputError("sizes", received=f"{size.size} sizes", expected="two or more different, finite sizes")
    if curve.log_size and not np.all(size > 0):
        raise InputError("sizes", received=f"{size.min():g}", expected="sizes above 0 on log size")
    if networks < 1:
        raise InputError("networks", received=networks, expected="1 or more")
    pieces = _pieces(curve, np.log(size) if curve.log_size else size)
    error = _spread_on_scale(curve, pieces, len(size), len(size), networks)
    alone = _spread_on_scale(curve, pieces, len(size), len(size), 1, independent=True)
    bound, low, high = _expected_bounds(curve, size, looks=(alone / error) ** 2)
    return Precision(
        networks=networks,
        images=len(size),
        sd_a90=error * (curve.a90 if curve.log_size else 1.0),
        bound_over_a90=bound,
        low_over_a90=low,
        high_over_a90=high,
    )


def recommended_sizes(curve: AssumedCurve, images: int, *, networks: int = 1) -> Array:
    """Sizes to make, (image,) rising, in the curve's unit: even on the fit's scale over the most informative range.

    The range runs from POD p to POD q, p within 2-30 % and q within 95-99.5 %, whichever pair makes the spread of a90
    smallest: sizes at both ends keep the slope, and the choice of link, checkable.
    """
    if images < 2:
        raise InputError("images", received=images, expected="2 or more")
    best, least = np.zeros(0), math.inf
    for low in (0.02, 0.05, 0.1, 0.2, 0.3):
        for high in (0.95, 0.97, 0.99, 0.995):
            ends = curve.size_at(low), curve.size_at(high)
            if ends[0] <= 0:
                ends = max(ends[0], 0.02 * curve.a50), ends[1]
            sizes = np.geomspace(*ends, images) if curve.log_size else np.linspace(*ends, images)
            spread = expected_precision(curve, sizes, networks=networks).sd_a90
            if spread < least:
                best, least = sizes, spread
    return np.asarray(best)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The smallest design that is expected to reach the wanted bound; `images` None where no number of images does.

    limit_over_a90: the bound over a90 with images without end, set by the number of networks alone.
    fewest_networks: networks needed for the wanted bound with images without end.
    """

    wanted_over_a90: float
    networks: int
    images: int | None
    sizes: Array
    expected: Precision | None
    limit_over_a90: float
    fewest_networks: int


def plan_pod(curve: AssumedCurve, *, wanted_over_a90: float, networks: int = 1) -> Plan:
    """Number of images for an expected one-sided 95 % bound of `wanted_over_a90` times a90.

    Args:
        curve: what is assumed.
        wanted_over_a90: bound over a90, above 1 (1.2: a90_95 some 20 % above a90).
        networks: number of networks, each looking at all images.

    Raises:
        InputError: a wanted bound that is not above 1.
    """
    if not (math.isfinite(wanted_over_a90) and wanted_over_a90 > 1):
        raise InputError("wanted_over_a90", received=wanted_over_a90, expected="a ratio above 1, for example 1.2")
    pattern = recommended_sizes(curve, 40, networks=networks)
    low, high = float(pattern[0]), float(pattern[-1])

    fine = np.asarray(np.geomspace(low, high, _FINE) if curve.log_size else np.linspace(low, high, _FINE))
    pieces = _pieces(curve, np.log(fine) if curve.log_size else fine)
    alone = _spread_on_scale(curve, pieces, _FINE, _FINE, 1, independent=True)

    def bound(images: float, looks: int) -> float:
        # what an image tells does not depend on their number, so one fine pattern serves every number
        error = _spread_on_scale(curve, pieces, _FINE, images, looks)
        if error < _EXACT * alone:
            return 1.0
        found = _expected_bounds(curve, fine, looks=(alone / error) ** 2)[0]
        return math.inf if found is None else found

    limit = bound(math.inf, networks)
    fewest = _smallest(lambda n: bound(math.inf, n) <= wanted_over_a90, _MOST_NETWORKS) or _MOST_NETWORKS
    images = (
        _smallest(lambda n: bound(n, networks) <= wanted_over_a90, _MOST_IMAGES) if limit < wanted_over_a90 else None
    )
    images = None if images is None else max(images, 4)
    chosen = recommended_sizes(curve, min(images, 2000), networks=networks) if images is not None else np.zeros(0)
    return Plan(
        wanted_over_a90=wanted_over_a90,
        networks=networks,
        images=images,
        sizes=chosen,
        expected=expected_precision(curve, chosen, networks=networks) if len(chosen) == images else None,
        limit_over_a90=limit,
        fewest_networks=fewest,
    )


def _smallest(reached: Callable[[int], bool], most: int) -> int | None:
    """Smallest number from 1 to `most` for which a condition that stays true once it is true holds."""
    if not reached(most):
        return None
    low, high = 0, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def _spread_on_scale(
    curve: AssumedCurve,
    pieces: tuple[Array, Array, Array],
    pattern: int,
    images: float,
    networks: int,
    *,
    independent: bool = False,
) -> float:
    """Standard deviation of a90 on the fit's scale for `images` images spread like the pattern of sizes that the pieces are of.

    independent: of so many looks that share neither network nor image.
    """
    unit_image, unit_network, information = (piece / pattern for piece in pieces)
    # the network's piece sums over pairs of images: it grows with their square
    unit_network = unit_network / pattern
    bread = np.linalg.inv(information)
    per_image = bread @ (information / networks + (networks - 1) / networks * unit_image) @ bread
    covariance = per_image / images if math.isfinite(images) else np.zeros((2, 2))
    if not independent:
        covariance = covariance + bread @ unit_network @ bread / networks
    c1 = curve.coefficients()[1]
    toward = np.array([1.0, math.log(curve.a90) if curve.log_size else curve.a90])
    return math.sqrt(max(float(toward @ covariance @ toward), 0.0)) / c1


def _expected_bounds(
    curve: AssumedCurve, size: Array, *, looks: float
) -> tuple[float | None, float | None, float | None]:
    """One-sided bound and two-sided interval over a90 where so many independent looks at each size go as expected; None: none."""
    link = link_from_name(curve.link)
    c0, c1 = curve.coefficients()
    eta = c0 + c1 * (np.log(size) if curve.log_size else size)
    pod = averaged_pod(eta, math.hypot(curve.sd_network, curve.sd_image), link=link)
    expected = Trials(size=size, hits=looks * pod, misses=looks * (1.0 - pod))
    try:
        fit = fit_pooled(expected, link=link, log_size=curve.log_size, method="ml")
    except FitError:
        return None, None, None
    bounds = (fit.a90_95, fit.a90_low_two_sided, fit.a90_95_two_sided)
    ends = [trusted_bound(one, separated=False) for one in bounds]
    if fit.a90 is None:
        return None, None, None
    bound, low, high = (None if end is None else end / fit.a90 for end in ends)
    return bound, low, high


def _pieces(curve: AssumedCurve, x: Array) -> tuple[Array, Array, Array]:
    """Covariance of a pair of looks at one image, of a network's looks at different images, and information; (2, 2)."""
    link: Link = link_from_name(curve.link)
    c0, c1 = curve.coefficients()
    total = math.hypot(curve.sd_network, curve.sd_image)
    eta = c0 + c1 * x
    mean = averaged_pod(eta, total, link=link)
    width = 1e-4
    slope = (averaged_pod(eta + width, total, link=link) - averaged_pod(eta - width, total, link=link)) / (2 * width)
    variance = np.maximum(mean * (1 - mean), 1e-12)
    design = np.stack((np.ones_like(x), x), axis=1)
    information = (design * (slope**2 / variance)[:, None]).T @ design
    weight = design * (slope / variance)[:, None]
    # POD at each node of one effect, averaged over the other
    by_image = averaged_pod(eta[:, None] + curve.sd_image * _NODES, curve.sd_network, link=link) - mean[:, None]
    by_network = averaged_pod(eta[:, None] + curve.sd_network * _NODES, curve.sd_image, link=link) - mean[:, None]
    same_image = (by_image**2) @ _WEIGHTS
    unit_image = (weight * same_image[:, None]).T @ weight
    sums = weight.T @ by_network
    own = ((weight * ((by_network**2) @ _WEIGHTS)[:, None]).T) @ weight
    unit_network = (sums * _WEIGHTS) @ sums.T - own
    return unit_image, unit_network, information

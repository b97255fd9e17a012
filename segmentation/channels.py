"""A dual-energy pair in units of its noise: what lies beyond the product, and in which direction foreign objects do."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .background import smooth_part
from .robust import biweight, robust_sd

# Air is left out of the fit of the product: there both channels are noise about zero.
_PRODUCT_SHARE = 0.2
# Passes of the robust fit; it settles to well under the noise on fillets with bones.
_PASSES = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseChannels:
    """A pair in units of its noise, each (row, column).

    Fields: residual (what the low image holds beyond the product); detail (what the high image holds beyond its smooth part, less
    what shares the residual's noise; 0 outside the product, and everywhere where it was not asked for); thickness (-1 to 1).
    """

    residual: NDArray[np.float64]
    detail: NDArray[np.float64]
    thickness: NDArray[np.float64]


def noise_channels(image: NDArray[Any], *, with_detail: bool = False) -> NoiseChannels:
    """Residual, detail and thickness of a pair; equations at `scale_residual` and `scale_matched`.

    Args:
        image: (2, row, column) -log(I/I0), low kV first.
        with_detail: False leaves the detail 0, and the work for it out.
    """
    low, high = pair_of(image)
    top = max(float(np.percentile(high, 99)), 1e-6)
    inside = high > _PRODUCT_SHARE * top
    x, y = high[inside], low[inside]
    curve = np.zeros(2)
    sd = 1.0
    if x.size >= 8:
        # From a straight line: a parabola through all pixels would bend towards a bone in the thickest place, where
        # nothing else holds it.
        curve = np.array([float(np.median(y / x)), 0.0])
        powers = np.stack([x, x * x])
        for _ in range(_PASSES):
            left = y - curve @ powers
            weighted = powers * biweight(left, sd=robust_sd(left))
            curve = np.linalg.lstsq(weighted @ powers.T, weighted @ y, rcond=None)[0]
        sd = robust_sd(y - curve @ powers)
    residual = (low - high * (curve[0] + curve[1] * high)) / sd
    detail = np.zeros_like(high)
    if with_detail and x.size >= 8:
        detail[inside] = _unshared((high - smooth_part(high, inside))[inside], residual[inside])
    return NoiseChannels(residual=residual, detail=detail, thickness=2.0 * high / top - 1.0)


def _unshared(detail: NDArray[np.float64], residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Detail less what noise of the high image puts into both, in units of its noise; a robust line through zero."""
    slope = 0.0
    for _ in range(_PASSES):
        left = detail - slope * residual
        weighted = residual * biweight(left, sd=robust_sd(left)) * biweight(residual, sd=1.0)
        slope = float(weighted @ detail) / max(float(weighted @ residual), 1e-12)
    left = detail - slope * residual
    return left / robust_sd(left)


def measure_direction(pairs: Iterable[tuple[NDArray[Any], NDArray[Any]]]) -> float:
    """Direction in which the foreign objects of some images stand out most, degrees (-180 to 180), for `scale_matched`.

    Each image gives the mean contrast over its mask in residual and detail. The direction is the main axis of these, towards
    the side on which most contrast lies. An image counts by its contrast, up to one standard deviation a pixel.

    Args:
        pairs: -log(I/I0) (2, row, column), mask of the foreign objects (row, column). Empty masks say nothing.

    Returns:
        A whole number of degrees, so that the last bits of a processor change nothing; 0 where no mask has a pixel.
    """
    found = []
    for image, mask in pairs:
        marked = np.asarray(mask) != 0
        if marked.any():
            channels = noise_channels(image, with_detail=True)
            contrast = np.array([channels.residual[marked].mean(), channels.detail[marked].mean()])
            found.append(contrast / max(1.0, float(np.hypot(*contrast))))
    if not found:
        return 0.0
    contrasts = np.stack(found)
    axis = np.linalg.eigh(contrasts.T @ contrasts)[1][:, -1]
    along = axis if float((contrasts @ axis).sum()) >= 0 else -axis
    return float(round(math.degrees(math.atan2(along[1], along[0]))))


def pair_of(image: NDArray[Any]) -> NDArray[np.float64]:
    """The pair as float64, (2, row, column).

    Raises:
        InputError: another shape, or values that are not finite.
    """
    pair = np.asarray(image, dtype=np.float64)
    if pair.ndim != 3 or pair.shape[0] != 2 or 0 in pair.shape:
        raise InputError("image", received=f"shape {pair.shape}", expected="(2, row, column), low kV first")
    if not bool(np.isfinite(pair).all()):
        raise InputError("image", received="a value that is not finite", expected="finite values of -log(I/I0)")
    return pair

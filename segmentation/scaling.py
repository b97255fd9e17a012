"""What a network sees: a dual-energy pair scaled image by image, padded to what the network divides.

A choice of scaling is a key of `SCALINGS`; a trained network keeps it in its recipe.
"""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

# Air is left out of the fit of `scale_residual`: there both channels are noise about zero.
_PRODUCT_SHARE = 0.2
# Passes of the robust fit; it settles to well under the noise on fillets with bones.
_PASSES = 8
# A pixel further than this from the curve, in standard deviations, has no say in it (Tukey's biweight).
_REJECTED = 4.0
_RESIDUAL_UNIT = 2.5
# A pixel that was not repaired stands a hundred s out; a bone is no less visible at ten than at twenty.
_RESIDUAL_LIMIT = 10.0


def scale_min_max(image: NDArray[Any]) -> NDArray[np.float32]:
    """Each channel brought to 0..1 (no unit), as published.

    x = (M - min M) / (max M - min M), for each channel of each image by itself. A channel of one value becomes 0.

    Args:
        image: (2, row, column) -log(I/I0), low kV first.

    Returns:
        (2, row, column) float32.

    Source: Andriiashen et al., per-image min-max scaling.
    """
    pair = _pair(image)
    low = pair.min(axis=(1, 2), keepdims=True)
    span = pair.max(axis=(1, 2), keepdims=True) - low
    return np.asarray((pair - low) / np.where(span > 0, span, 1.0), dtype=np.float32)


def scale_residual(image: NDArray[Any]) -> NDArray[np.float32]:
    """What the low-kV image holds beyond the product, in units of its own noise, and the product's thickness.

    The product alone puts M_low on a curve of M_high; a curve c1 M_high + c2 M_high^2 through zero is fitted robustly
    to the product's pixels (M_high above a fifth of its 99th percentile). Channel 0 is (M_low - curve) / (2.5 s), s the
    residual's standard deviation from its median absolute deviation in the product, clipped at 10 s; a foreign object
    stands out of it at any exposure. Channel 1 is 2 M_high / (its 99th percentile) - 1.

    A network from scratch learns from this within some hundred steps what it does not find in the scaled channels
    themselves, where the product outweighs the foreign object. The foreign object must be a small part of the product: in
    the thickest place, where the fit bends most easily, one of a twentieth of the product's pixels keeps nine tenths of
    its contrast where that is several s, and about seven tenths below two s; one of a fifth may be taken for the
    product and vanish.

    Args:
        image: (2, row, column) -log(I/I0), low kV first.

    Returns:
        (2, row, column) float32.

    Source of the robust fit: Beaton and Tukey 1974, Technometrics 16:147 (biweight).
    """
    low, high = _pair(image)
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
            sd = _robust_sd(y - curve @ powers)
            weights = np.clip(1.0 - ((y - curve @ powers) / (_REJECTED * sd)) ** 2, 0.0, None) ** 2
            weighted = powers * weights
            curve = np.linalg.lstsq(weighted @ powers.T, weighted @ y, rcond=None)[0]
        sd = _robust_sd(y - curve @ powers)
    beyond = np.clip((low - high * (curve[0] + curve[1] * high)) / sd, -_RESIDUAL_LIMIT, _RESIDUAL_LIMIT)
    thickness = np.clip(2.0 * high / top - 1.0, -3.0, 3.0)
    return np.stack([beyond / _RESIDUAL_UNIT, thickness]).astype(np.float32)


SCALINGS: MappingProxyType[str, Callable[[NDArray[Any]], NDArray[np.float32]]] = MappingProxyType(
    {"min_max": scale_min_max, "residual": scale_residual}
)


def pad_to_multiple(image: NDArray[Any], *, multiple: int) -> NDArray[Any]:
    """The image with its edge repeated until rows and columns are multiples of `multiple`; half on each side.

    Args:
        image: (..., row, column).
        multiple: pixels; 16 for a network of output stride 16.

    Returns:
        (..., row', column'); the image itself where nothing is missing. `crop_to_shape` is the inverse.
    """
    before_after = [_margins(length, -(-length // multiple) * multiple) for length in image.shape[-2:]]
    if not any(map(any, before_after)):
        return image
    return np.pad(image, [(0, 0)] * (image.ndim - 2) + before_after, mode="edge")


def crop_to_shape(image: NDArray[Any], *, shape: tuple[int, int]) -> NDArray[Any]:
    """The middle of an image, the inverse of `pad_to_multiple`.

    Args:
        image: (..., row', column').
        shape: (row, column) wanted, each at most that of the image.

    Returns:
        (..., row, column), a view.
    """
    cut = []
    for length, wanted in zip(image.shape[-2:], shape, strict=True):
        if wanted > length:
            raise InputError("shape", received=f"{wanted} of {length} pixels", expected="at most the image's own")
        first = _margins(wanted, length)[0]
        cut.append(slice(first, first + wanted))
    return image[..., cut[0], cut[1]]


def _robust_sd(residual: NDArray[np.float64]) -> float:
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-6)


def _margins(length: int, padded: int) -> tuple[int, int]:
    missing = padded - length
    return missing // 2, missing - missing // 2


def _pair(image: NDArray[Any]) -> NDArray[np.float64]:
    pair = np.asarray(image, dtype=np.float64)
    if pair.ndim != 3 or pair.shape[0] != 2 or 0 in pair.shape:
        raise InputError("image", received=f"shape {pair.shape}", expected="(2, row, column), low kV first")
    if not bool(np.isfinite(pair).all()):
        raise InputError("image", received="a value that is not finite", expected="finite values of -log(I/I0)")
    return pair

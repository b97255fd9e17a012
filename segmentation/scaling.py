"""What a network sees: a dual-energy pair scaled image by image, padded to what the network divides.

A scaling is a word that `scaling_named` understands; a trained network keeps it in its recipe.
"""

import math
from collections.abc import Callable
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .channels import noise_channels, pair_of

_RESIDUAL_UNIT = 2.5
# A pixel that was not repaired stands a hundred s out; a bone is no less visible at ten than at twenty.
_RESIDUAL_LIMIT = 10.0
MATCHED = "matched"  # `matched:DEGREES`; without a number the direction is still to be measured


def scale_min_max(image: NDArray[Any]) -> NDArray[np.float32]:
    """Each channel brought to 0..1 (no unit), as published.

    x = (M - min M) / (max M - min M), for each channel of each image by itself. A channel of one value becomes 0.

    Args:
        image: (2, row, column) -log(I/I0), low kV first.

    Returns:
        (2, row, column) float32.

    Source: Andriiashen et al., per-image min-max scaling.
    """
    pair = pair_of(image)
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
    channels = noise_channels(image)
    return _stacked(channels.residual, channels.thickness)


def scale_matched(image: NDArray[Any], *, direction_deg: float) -> NDArray[np.float32]:
    """As `scale_residual`, with channel 0 along a direction in the plane of residual and detail.

    Channel 0 is cos(d) residual + sin(d) detail (`noise_channels`), which share no noise: it has unit noise in any direction,
    and the largest contrast where d is the direction in which the foreign objects lie. At d = 0 it is the residual. Voids, which
    change both images as a thinner product does, lie near -90 degrees, bones between 30 and 80.

    Args:
        image: (2, row, column) -log(I/I0), low kV first.
        direction_deg: d; `measure_direction` says which.

    Returns:
        (2, row, column) float32.

    Source: the best linear combination of two channels of unit, unshared noise (Fisher 1936, Ann. Eugenics 7:179).
    """
    channels = noise_channels(image, with_detail=True)
    angle = math.radians(direction_deg)
    return _stacked(
        math.cos(angle) * channels.residual + math.sin(angle) * channels.detail,
        channels.thickness,
    )


SCALINGS: MappingProxyType[str, Callable[[NDArray[Any]], NDArray[np.float32]]] = MappingProxyType(
    {"min_max": scale_min_max, "residual": scale_residual}
)


def matched_along(direction_deg: float) -> str:
    """The word of `scale_matched` along a direction: `matched:-83`."""
    return f"{MATCHED}:{direction_deg:g}"


def scaling_named(word: str) -> Callable[[NDArray[Any]], NDArray[np.float32]]:
    """The scaling that a word stands for: a key of `SCALINGS`, or `matched:DEGREES`.

    Raises:
        InputError: another word, or a direction that is not a number.
    """
    if word in SCALINGS:
        return SCALINGS[word]
    name, _, number = word.partition(":")
    try:
        direction = float(number)
    except ValueError:
        direction = math.nan
    if name != MATCHED or not math.isfinite(direction):
        raise InputError(
            "scaling",
            received=repr(word),
            expected="one of " + ", ".join(SCALINGS) + f", or {MATCHED}:DEGREES",
            remedy="`raytwin train` measures the direction; run.json of its folder has it" if word == MATCHED else "",
        )
    return partial(scale_matched, direction_deg=direction)


def starts_alike(one: str, other: str) -> bool:
    """Whether a network of one scaling may start from one of the other: objects bright in units of noise, or the same word."""
    noise = ("residual", MATCHED)
    return one == other or all(word.partition(":")[0] in noise for word in (one, other))


def _stacked(contrast: NDArray[np.float64], thickness: NDArray[np.float64]) -> NDArray[np.float32]:
    beyond = np.clip(contrast, -_RESIDUAL_LIMIT, _RESIDUAL_LIMIT) / _RESIDUAL_UNIT
    return np.stack([beyond, np.clip(thickness, -3.0, 3.0)]).astype(np.float32)


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


def _margins(length: int, padded: int) -> tuple[int, int]:
    missing = padded - length
    return missing // 2, missing - missing // 2

"""Changed copies of a scaled image and its masks, so that a network does not learn places and orientations by heart.

A choice of augmentation is a key of `AUGMENTATIONS`; randomness is the caller's generator.
"""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SHIFT_SHARE = 0.1
_SCALE_SHARE = 0.1
_ROTATION_DEG = 10.0

Augmented = tuple[NDArray[np.float32], NDArray[np.uint8]]


def augment_exact(image: NDArray[np.float32], masks: NDArray[np.uint8], *, generator: np.random.Generator) -> Augmented:
    """Flips and whole-pixel shifts of up to a tenth of the field; the edge is repeated where the image moved away.

    Nothing is interpolated, so that noise keeps its strength and texture: a rotation by interpolation takes a third and
    more of white noise away and teaches a network images that no detector makes.

    Args:
        image: (channel, row, column).
        masks: (class, row, column).
        generator: source of randomness.

    Returns:
        image and masks of the same shapes, changed alike.
    """
    flipped_image, flipped_masks = _flip(image, masks, generator)
    rows, columns = (_shift_index(length, generator) for length in image.shape[-2:])
    grid = np.ix_(rows, columns)
    return (
        np.ascontiguousarray(flipped_image[:, grid[0], grid[1]]),
        np.ascontiguousarray(flipped_masks[:, grid[0], grid[1]]),
    )


def augment_as_published(
    image: NDArray[np.float32], masks: NDArray[np.uint8], *, generator: np.random.Generator
) -> Augmented:
    """Flips, then a shift of up to 10 %, a scale of 0.9-1.1 and a rotation of up to 10 degrees, every time.

    Bilinear for the image, nearest pixel for the masks, the edge repeated outside.

    Args and Returns: as `augment_exact`.

    Source: Andriiashen et al. (text: flips, shift/scale/rotate; ranges from the authors' published code).
    """
    from scipy import ndimage

    flipped_image, flipped_masks = _flip(image, masks, generator)
    size = np.asarray(image.shape[-2:], dtype=np.float64)
    angle = np.deg2rad(generator.uniform(-_ROTATION_DEG, _ROTATION_DEG))
    scale = 1.0 + generator.uniform(-_SCALE_SHARE, _SCALE_SHARE)
    shift = generator.uniform(-_SHIFT_SHARE, _SHIFT_SHARE, size=2) * size
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / scale
    centre = (size - 1.0) / 2.0
    offset = centre - turn @ (centre + shift)

    def moved(plane: NDArray[Any], order: int) -> NDArray[Any]:
        result: NDArray[Any] = ndimage.affine_transform(plane, turn, offset=offset, order=order, mode="nearest")
        return result

    return (
        np.stack([moved(plane, 1) for plane in flipped_image]),
        np.stack([moved(plane, 0) for plane in flipped_masks]),
    )


def crop_around_object(
    image: NDArray[np.float32], masks: NDArray[np.uint8], *, size_px: int, generator: np.random.Generator
) -> Augmented:
    """A square of the image that holds a pixel of the foreign object (the last mask), or any where there is none.

    Args:
        image: (channel, row, column).
        masks: (class, row, column), the foreign object last.
        size_px: side of the square; a side longer than the image is cut to the image.
        generator: source of randomness.

    Returns:
        image and masks of the square.
    """
    lengths = image.shape[-2:]
    marked = np.argwhere(masks[-1])
    cut = []
    anchor = marked[generator.integers(len(marked))] if len(marked) else None
    for axis, length in enumerate(lengths):
        last = max(0, length - size_px)
        first = int(generator.integers(last + 1)) if anchor is None else int(anchor[axis] - generator.integers(size_px))
        first = min(max(first, 0), last)
        cut.append(slice(first, first + size_px))
    return image[(slice(None), *cut)], masks[(slice(None), *cut)]


AUGMENTATIONS: MappingProxyType[str, Callable[..., Augmented]] = MappingProxyType(
    {"exact": augment_exact, "as_published": augment_as_published}
)


def _flip(image: NDArray[np.float32], masks: NDArray[np.uint8], generator: np.random.Generator) -> Augmented:
    axes = tuple(axis for axis in (1, 2) if generator.random() < 0.5)
    return (np.flip(image, axes), np.flip(masks, axes)) if axes else (image, masks)


def _shift_index(length: int, generator: np.random.Generator) -> NDArray[np.intp]:
    furthest = int(_SHIFT_SHARE * length)
    shift = int(generator.integers(-furthest, furthest + 1))
    return np.clip(np.arange(length) - shift, 0, length - 1)

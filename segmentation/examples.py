"""Labelled, scaled images, read when they are needed and kept while there is room."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .recipe import PRODUCT, Recipe
from .scaling import scaling_named

if TYPE_CHECKING:
    from ..acquisition.dataset_io import Dataset

CACHE_BYTES = 4 * 2**30

Example = tuple[NDArray[np.float32], NDArray[np.uint8]]


class Examples:
    """A sequence of (scaled image (2, row, column), masks (class, row, column)); made by `examples_from_...`."""

    def __init__(self, load: Callable[[int], Example], count: int, *, cache_bytes: int = CACHE_BYTES) -> None:
        self._load = load
        self._count = count
        self._room = cache_bytes
        self._kept: dict[int, Example] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, number: int) -> Example:
        if not 0 <= number < self._count:
            raise IndexError(number)
        found = self._kept.get(number)
        if found is None:
            found = self._load(number)
            size = found[0].nbytes + found[1].nbytes
            if size <= self._room:
                self._room -= size
                self._kept[number] = found
        return found

    def at_epoch(self, epoch: int) -> "Examples":
        """What an epoch sees: the same examples in all of them."""
        return self


class FreshExamples(Examples):
    """Examples that are made anew for every epoch; without an epoch they are those of epoch 0, which are kept."""

    def __init__(self, load: Callable[[int, int], Example], count: int) -> None:
        super().__init__(lambda number: load(number, 0), count)
        self._load_at = load

    def at_epoch(self, epoch: int) -> Examples:
        """Examples of one epoch; none is kept, for none comes again."""
        return Examples(lambda number: self._load_at(number, epoch), len(self), cache_bytes=0)


def examples_from_arrays(
    images: NDArray[Any],
    foreign_object_masks: NDArray[Any],
    product_masks: NDArray[Any] | None = None,
    *,
    recipe: Recipe,
    cache_bytes: int = CACHE_BYTES,
) -> Examples:
    """Examples from arrays.

    Args:
        images: (n, 2, row, column) -log(I/I0), low kV first.
        foreign_object_masks: (n, row, column), anything but 0 is inside.
        product_masks: the same shape; needed by a recipe that learns the product too.
        recipe: scaling and classes are used.
        cache_bytes: scaled examples kept in memory.
    """
    masks = {"foreign object": foreign_object_masks}
    if product_masks is not None:
        masks["product"] = product_masks
    if images.ndim != 4 or images.shape[1] != 2 or not len(images):
        raise InputError("images", received=f"shape {images.shape}", expected="(n, 2, row, column), n of 1 or more")
    for name, mask in masks.items():
        if mask.shape != (len(images), *images.shape[2:]):
            raise InputError(
                f"{name} masks",
                received=f"shape {mask.shape}",
                expected=f"shape {(len(images), *images.shape[2:])}, one mask an image",
            )
    if PRODUCT in recipe.classes and product_masks is None:
        raise InputError("product masks", received="none", expected=f"masks, for the recipe {recipe.name}")

    def load(number: int) -> Example:
        product = None if product_masks is None else product_masks[number]
        return _example(images[number], foreign_object_masks[number], product, recipe)

    return Examples(load, len(images), cache_bytes=cache_bytes)


def examples_from_dataset(
    dataset: "Dataset",
    numbers: Sequence[int] | NDArray[np.intp],
    *,
    recipe: Recipe,
    fresh: Callable[[int, int], NDArray[Any]] | None = None,
) -> Examples:
    """Examples of the pairs of a dataset file, by their numbers; the file must stay open.

    `fresh`, called with an image's number and the epoch, gives its log images (2, row, column) in place of the file's.

    Raises (when an example is read):
        FileFormatError: an image that cannot be read or is not finite.
    """
    wanted = [int(number) for number in numbers]

    def load(position: int, epoch: int = 0) -> Example:
        number = wanted[position]
        product = dataset.product_masks(number) if PRODUCT in recipe.classes else None
        image = dataset.images(number) if fresh is None else fresh(number, epoch)
        return _example(image, dataset.foreign_object_masks(number), product, recipe)

    if fresh is not None:
        return FreshExamples(load, len(wanted))
    return Examples(load, len(wanted))


def _example(
    image: NDArray[Any], foreign_object_mask: NDArray[Any], product_mask: NDArray[Any] | None, recipe: Recipe
) -> Example:
    planes = [product_mask, foreign_object_mask] if PRODUCT in recipe.classes else [foreign_object_mask]
    masks = np.stack([np.asarray(plane) != 0 for plane in planes]).astype(np.uint8)
    return scaling_named(recipe.scaling)(image), masks

"""Images whose noise is drawn when they are asked for: the same image of another epoch has other noise.

Seed, epoch and position decide the noise, so any number of processes may share the work in any order. Objects of these
classes go to other processes by pickle; each process opens the reference file for itself.
"""

import os
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...acquisition.dataset_io import Dataset, read_dataset
from ...acquisition.setting import Setting
from ...errors import InputError
from ..line.twin import Twin
from .generate import ReferenceImages

_FRESH = 5  # place of these random streams among those of a seed


@dataclass(frozen=True, slots=True, kw_only=True)
class FreshExample:
    """One image pair: log_images (2, row, column) float32, foreign_object_mask and product_mask (row, column)."""

    log_images: NDArray[np.float32] = field(repr=False)
    foreign_object_mask: NDArray[np.bool_] = field(repr=False)
    product_mask: NDArray[np.bool_] = field(repr=False)


class FreshSource(Protocol):
    """Where fresh images come from."""

    def __len__(self) -> int:
        """Images an epoch."""
        ...

    def example(self, position: int, *, epoch: int) -> FreshExample:
        """Image `position` of an epoch."""
        ...


def _checked(position: int, count: int, epoch: int) -> None:
    if not 0 <= position < count:
        raise IndexError(position)
    if epoch < 0:
        raise InputError("epoch", received=epoch, expected="0 or more")


class FreshReferences:
    """References of a dataset file at a target setting, with other noise in every epoch.

    Args:
        twin: the calibrated line.
        reference: path of the dataset file.
        low, high: target settings.
        seed: of the noise.
        options: as `ReferenceImages` takes them (`split`, `recipe`, materials, `registration_px`, ...).

    Raises:
        InputError: targets that the references cannot reach.
    """

    def __init__(
        self, twin: Twin, reference: str | os.PathLike[str], *, low: Setting, high: Setting, seed: int, **options: Any
    ) -> None:
        self._twin = twin
        self._path = str(reference)
        self._settings = (low, high)
        self._seed = seed
        self._options = options
        self._opened: tuple[int, Dataset, ReferenceImages] | None = None
        self._count = len(self._images()[1])

    def __len__(self) -> int:
        return self._count

    def __getstate__(self) -> dict[str, Any]:
        # an open file does not survive the way to another process
        return {**self.__dict__, "_opened": None}

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know about references and targets."""
        return self._images()[1].warnings

    @property
    def numbers(self) -> tuple[int, ...]:
        """Number in the dataset of each position."""
        return tuple(self._images()[1].numbers)

    def example(self, position: int, *, epoch: int) -> FreshExample:
        """Image `position` with the noise of an epoch."""
        _checked(position, self._count, epoch)
        dataset, images = self._images()
        counts, _ = images.counts(position, np.random.default_rng([self._seed, _FRESH, epoch, position]))
        number = images.numbers[position]
        return FreshExample(
            log_images=images.log_images(counts),
            foreign_object_mask=dataset.foreign_object_masks(number),
            product_mask=dataset.product_masks(number),
        )

    def _images(self) -> tuple[Dataset, ReferenceImages]:
        # a forked process must not read through its parent's handle
        if self._opened is None or self._opened[0] != os.getpid():
            dataset = read_dataset(self._path)
            low, high = self._settings
            images = ReferenceImages(self._twin, dataset, low=low, high=high, **self._options)
            self._opened = (os.getpid(), dataset, images)
        return self._opened[1], self._opened[2]

"""A dataset for torch whose images are made when they are asked for, so that a network never sees the same noise twice."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..generator.datasets.fresh import FreshSource

Arrays = tuple[NDArray[np.float32], NDArray[np.float32]]


class FreshNoiseDataset:
    """A map-style dataset for `torch.utils.data.DataLoader`: (image (2, row, column), masks (2, row, column)), float32.

    The masks are product and foreign object. An item is (epoch, position), as `EpochSampler` gives them, or a position alone,
    which is then of the epoch that `set_epoch` set. Seed, epoch and position decide everything, so any number of workers,
    kept alive or not, makes the same images.

        dataset = FreshNoiseDataset(FreshReferences(twin, "references.h5", low=low, high=high, seed=1))
        loader = DataLoader(dataset, batch_size=8, sampler=EpochSampler(dataset, seed=1), num_workers=4)
        for epoch in range(50):
            for images, masks in loader:
                ...

    Args:
        source: `FreshReferences`.
        transform: called with image, masks and a generator of its own for this item; crops, turns, scales.
        seed: of the transforms.
    """

    def __init__(
        self,
        source: FreshSource,
        *,
        transform: Callable[[NDArray[np.float32], NDArray[np.float32], np.random.Generator], Arrays] | None = None,
        seed: int = 0,
    ) -> None:
        self._source = source
        self._transform = transform
        self._seed = seed
        self._epoch = 0

    def __len__(self) -> int:
        return len(self._source)

    def set_epoch(self, epoch: int) -> None:
        """Epoch of items that are asked for by position alone."""
        if epoch < 0:
            raise InputError("epoch", received=epoch, expected="0 or more")
        self._epoch = epoch

    def __getitem__(self, item: int | tuple[int, int]) -> Arrays:
        epoch, position = item if isinstance(item, tuple) else (self._epoch, item)
        if position < 0:
            position += len(self)
        example = self._source.example(int(position), epoch=int(epoch))
        masks = np.stack([example.product_mask, example.foreign_object_mask]).astype(np.float32)
        if self._transform is None:
            return example.log_images, masks
        rng = np.random.default_rng([self._seed, int(epoch), int(position)])
        return self._transform(example.log_images, masks, rng)


class EpochSampler:
    """Gives (epoch, position) of all images once, in an order drawn for the epoch; each pass is the next epoch.

    Args:
        dataset: anything with a length.
        seed: of the order.
        first_epoch: of the first pass, to go on where training stopped.
        shuffle: False keeps the order of the dataset.
    """

    def __init__(self, dataset: Any, *, seed: int = 0, first_epoch: int = 0, shuffle: bool = True) -> None:
        if first_epoch < 0:
            raise InputError("first_epoch", received=first_epoch, expected="0 or more")
        self._count = len(dataset)
        self._seed = seed
        self._shuffle = shuffle
        self.epoch = first_epoch

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch, self.epoch = self.epoch, self.epoch + 1
        order = np.arange(self._count)
        if self._shuffle:
            order = np.random.default_rng([self._seed, epoch]).permutation(self._count)
        return iter([(epoch, int(position)) for position in order])

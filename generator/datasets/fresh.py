"""Images whose noise is drawn when they are asked for: the same image of another epoch has other noise.

Seed, epoch and position decide the noise, so images may be asked for in any order.
"""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.dataset_io import read_dataset
from ...acquisition.setting import Setting
from ...errors import InputError
from ..line.twin import Twin
from .generate import ReferenceImages

_FRESH = 5  # place of these random streams among those of a seed


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
        self._images = ReferenceImages(twin, read_dataset(reference), low=low, high=high, **options)
        self._seed = seed

    def __len__(self) -> int:
        return len(self._images)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know about references and targets."""
        return self._images.warnings

    def log_images(self, position: int, *, epoch: int) -> NDArray[np.float32]:
        """Log images (2, row, column) of a position with the noise of an epoch."""
        if not 0 <= position < len(self):
            raise IndexError(position)
        if epoch < 0:
            raise InputError("epoch", received=epoch, expected="0 or more")
        counts, _ = self._images.counts(position, np.random.default_rng([self._seed, _FRESH, epoch, position]))
        return self._images.log_images(counts)

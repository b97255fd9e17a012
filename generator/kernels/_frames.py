"""What is asked of the noise of frames, however it is computed: plain data."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatMap = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Frames:
    """What both ways of computing take: checked maps (frame or 1, row or 1, column or 1), float32, and numbers.

    The maps are arrays, or all of them torch tensors.
    """

    signal: Any
    relative: Any
    slope: Any  # quantum variance per signal: DN of a quantum
    read_variance: Any
    dark: Any
    white_fraction: float
    kernel: FloatMap
    reach: int
    electronics: bool
    steps_a_DN: float
    lowest: float
    highest: float
    key: int
    first_frame: int
    frames: int

    def of(self, name: str, frame: int) -> FloatMap:
        """One frame's map of `name` (row or 1, column or 1)."""
        values: FloatMap = getattr(self, name)
        return np.asarray(values[frame if len(values) > 1 else 0])

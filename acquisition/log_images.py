"""Logarithmic images and the light they stand for: frames of -log(I/I0), with I0 the open field."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .acquisition_io import Series

_LEAST_LOG = -5.0  # 150 times the open field: pixels that were dead in the flat


def transmitted_share(logarithms: NDArray[Any]) -> NDArray[np.float32]:
    """I/I0 of images -log(I/I0)."""
    return np.asarray(np.exp(-np.maximum(logarithms, _LEAST_LOG)), dtype=np.float32)


def logarithm_of_share(share: NDArray[Any]) -> NDArray[np.float32]:
    """-log(I/I0) of images I/I0; shares of 0 count as the least positive number of 32 bits."""
    return np.asarray(-np.log(np.maximum(share, np.finfo(np.float32).tiny)), dtype=np.float32)


def light_of_log(series: Series, open_DN: float) -> Series:
    """A series of -log(I/I0) as frames of `open_DN` I/I0, `offset` and `gain` corrected.

    It reads from the given series, whose file stays open.

    Args:
        series: whose `corrected` holds `log`.
        open_DN: signal of the open field.
    """
    corrected = (series.corrected - {"log"}) | {"offset", "gain"}
    return replace(series, corrected=corrected, _frames=_Light(series, open_DN))


class _Light:
    """Frames (frame, row, column) of light, DN; read as a dataset is."""

    def __init__(self, series: Series, open_DN: float) -> None:
        self.dtype = np.dtype(np.float32)
        self.chunks = None
        self.shape = (series.n_frames, *series.shape)
        self._series = series
        self._open_DN = np.float32(open_DN)

    def __getitem__(self, part: slice) -> NDArray[np.float32]:
        return self._open_DN * transmitted_share(self._series.read_frames(part.start, part.stop))

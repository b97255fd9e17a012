"""Images divided by the open field I0 and the light they stand for: frames of I/I0, or of -log(I/I0)."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .acquisition_io import Series

_LARGEST_SHARE = 5.0  # of the open field, in nearly all pixels: detector numbers are larger
_NOT_DEAD = 0.98  # share of the pixels
_LEAST_LOG = -5.0  # 150 times the open field: pixels that were dead in the flat


def transmitted_share(logarithms: NDArray[Any]) -> NDArray[np.float32]:
    """I/I0 of images -log(I/I0)."""
    return np.asarray(np.exp(-np.maximum(logarithms, _LEAST_LOG)), dtype=np.float32)


def logarithm_of_share(share: NDArray[Any]) -> NDArray[np.float32]:
    """-log(I/I0) of images I/I0; shares of 0 count as the least positive number of 32 bits."""
    return np.asarray(-np.log(np.maximum(share, np.finfo(np.float32).tiny)), dtype=np.float32)


def holds_shares(series: Series) -> bool:
    """Whether frames with a beam are I/I0 or -log(I/I0) and no detector numbers.

    Logarithms are declared. Frames that went through `gain` may have kept their detector numbers, or be shares of the open field:
    those are no whole numbers and nowhere far above 1.
    """
    if series.kind not in ("flat", "object"):
        return False
    if "log" in series.corrected:
        return True
    if "gain" not in series.corrected or series.n_frames == 0:
        return False
    first = series.read_frames(0, 1)
    return first.dtype.kind == "f" and float(np.quantile(first, _NOT_DEAD)) < _LARGEST_SHARE


def light_of_shares(series: Series, open_DN: float) -> Series:
    """A series of I/I0 or -log(I/I0) as frames of `open_DN` I/I0, `offset` and `gain` corrected.

    It reads from the given series, whose file stays open.

    Args:
        series: one that `holds_shares`.
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
        frames = self._series.read_frames(part.start, part.stop)
        return self._open_DN * (transmitted_share(frames) if "log" in self._series.corrected else frames)

"""One pass over the frames of a series, in pieces: all that `check` asks of them, in memory that does not grow with it."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import PIECE_BYTES, Series
from ..calibration.frames.frame_checks import CopyScan, SceneScan, with_median_at

_SAMPLE_FRAMES = 4  # whose values are kept whole, spread over the first piece
_SAMPLE_VALUES = 4_000_000
_DIFFERENCES = 4
_VARIANCE_PIXELS = 16384


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesScan:
    """What the frames of one series are.

    Fields: mean_DN (row, column); frame_mean_DN (n,); level_DN (median of the mean frame); variance_DN2 (temporal, of one
    frame as stored, from successive frames, common factor taken off; NaN for a single one); values (a sample of whole
    frames); differences (of some successive frames, (m, row, column), DN); copies; scene.
    """

    series: Series
    mean_DN: NDArray[np.float64]
    frame_mean_DN: NDArray[np.float64]
    level_DN: float
    variance_DN2: float
    values: NDArray[Any]
    differences: NDArray[np.float64]
    copies: CopyScan
    scene: SceneScan

    @property
    def constant(self) -> bool:
        """All values of the sample and all frame means are one number."""
        return bool(self.values.size and (self.values == self.values.flat[0]).all() and np.ptp(self.frame_mean_DN) == 0)


def scan_series(series: Series, *, unsteady: NDArray[np.bool_] | None = None) -> SeriesScan:
    """Read a series once.

    Args:
        series: of an open acquisition.
        unsteady: pixels (row, column) whose noise is no sign of another scene.

    Raises:
        FileFormatError: frames that cannot be read or hold values that are not finite.
    """
    copies, scene = CopyScan(), SceneScan()
    total = np.zeros(series.shape)
    means: list[float] = []
    squares: list[float] = []
    sample: list[NDArray[Any]] = []
    differences: list[NDArray[np.float64]] = []
    last = None
    last_sample: NDArray[np.float64] | None = None
    pixels = series.shape[0] * series.shape[1]
    step = max(1, pixels // _VARIANCE_PIXELS)
    most = max(1, min(_SAMPLE_FRAMES, _SAMPLE_VALUES // pixels))
    for piece in series.iter_frames(maximum_bytes=PIECE_BYTES):
        copies.add(piece)
        scene.add(piece if unsteady is None else with_median_at(piece, unsteady))
        total += piece.sum(axis=0, dtype=np.float64)
        means += piece.mean(axis=(1, 2), dtype=np.float64).tolist()
        for frame in piece:
            if len(sample) < most:
                sample.append(frame.copy())
            if last is not None and len(differences) < _DIFFERENCES:
                differences.append(frame.astype(np.float64) - last)
            last = frame if len(differences) < _DIFFERENCES else None
            values = frame.reshape(-1)[::step].astype(np.float64)
            if last_sample is not None and not np.array_equal(values, last_sample):
                squares.append(_variance_of_change(last_sample, values))
            last_sample = values
    mean_DN = total / len(means)
    return SeriesScan(
        series=series,
        mean_DN=mean_DN,
        frame_mean_DN=np.array(means),
        level_DN=float(np.median(mean_DN)),
        variance_DN2=float(np.median(squares)) if squares else math.nan,
        values=np.array(sample),
        differences=np.array(differences) if differences else np.zeros((0, *series.shape)),
        copies=copies,
        scene=scene,
    )


def _variance_of_change(earlier: NDArray[np.float64], later: NDArray[np.float64]) -> float:
    """Half the variance of a difference of two frames, outliers cut at six robust deviations, DN^2."""
    change = later - earlier
    change -= change.mean()
    squares = change**2
    return 0.5 * float(np.mean(np.minimum(squares, 36.0 * float(np.median(squares)) / 0.4549364 + 1.0)))

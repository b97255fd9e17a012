"""Correlation of neighbouring pixels' noise, as the forward model states it, summed over what probes average."""

from functools import lru_cache

import numpy as np

from ...generator.frames.line_model import ExpectedSeries
from ..arrays import FloatArray


def autocovariance(expected: ExpectedSeries, dr: int, dc: int) -> float:
    """Correlation of the quantum part at a lag; 0 beyond what the model gives."""
    table = expected.noise_autocovariance
    r, c = abs(dr), abs(dc)
    return float(table[r, c]) if r < table.shape[0] and c < table.shape[1] else 0.0


def correlation_sum(expected: ExpectedSeries, rows: int, columns: int) -> float:
    """Sum of the quantum part's correlations over lags with triangular weights of a rows x columns block."""
    table = expected.noise_autocovariance
    return _correlation_sum(table.tobytes(), table.shape, rows, columns)


@lru_cache(maxsize=512)
def _correlation_sum(table: bytes, shape: tuple[int, int], rows: int, columns: int) -> float:
    lags = np.frombuffer(table).reshape(shape)
    return float(_triangle(rows, shape[0]) @ lags @ _triangle(columns, shape[1]))


@lru_cache(maxsize=64)
def _triangle(length: int, lags: int) -> FloatArray:
    """Weights (lags,) of lags to both sides in the variance of a sum of `length` neighbours, over that of one."""
    lag = np.arange(lags)
    return np.asarray(np.where(lag == 0, 1.0, 2.0 * np.maximum(1.0 - lag / length, 0.0)))

"""Tails of the noise of frames: its excess kurtosis where quanta are few.

A signal S of quanta of g DN each, beside Gaussian noise of a variance r, has the cumulants g^(k-1) S. A difference of two frames has
the excess kurtosis g^3 S / (2 (g S + r)^2). Pixels are judged by their own variance, whose expansion goes on with the sixth cumulant
over the third power of the variance: the kurtosis serves where that lies below the probe's floor.
"""

import numpy as np

from ...generator.frames.line_model import ExpectedSeries
from ..session.summaries import SeriesSummary
from .probes import FLOORS
from .scalar_context import Areas


def tails_of_quanta(expected: ExpectedSeries, areas: Areas) -> float:
    """Excess kurtosis of differences of frames, mean over good pixels."""
    gain, white = _gain_and_white(expected, areas)
    signal = np.maximum(
        areas.pixels(expected.mean_DN - expected.dark_DN), gain
    )  # of less than a quantum nothing is said
    return float(np.mean(0.5 * gain**3 * signal / (gain * signal + white) ** 2))


def enough_quanta(expected: ExpectedSeries, areas: Areas, measured: SeriesSummary) -> bool:
    """Whether the quanta that measured frames show are so many that their tails are known."""
    gain, white = _gain_and_white(expected, areas)
    # a pixel without quanta may have had one in all frames
    signal = np.maximum(areas.pixels(measured.mean_DN) - areas.pixels(expected.dark_DN), gain / measured.frames)
    return float(np.mean(0.5 * gain**5 * signal / (gain * signal + white) ** 3)) <= FLOORS["kurtosis"]


def _gain_and_white(expected: ExpectedSeries, areas: Areas) -> tuple[float, float]:
    """DN of a quantum, and the variance (DN^2) of a pixel without any; of darks nothing and 1."""
    quantum, signal = areas.mean(expected.quantum_variance_DN2), areas.mean(expected.mean_DN - expected.dark_DN)
    white = float(np.min(areas.pixels(expected.white_variance_DN2)))
    return (quantum / signal, max(white, 1e-12)) if quantum > 0.0 < signal else (0.0, 1.0)

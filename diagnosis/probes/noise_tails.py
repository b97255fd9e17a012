"""Tails of the noise of frames: its excess kurtosis where quanta are few, and where numbers are rounded to coarse steps.

A signal S of quanta of g DN each, beside Gaussian noise of a variance r, has the cumulants g^(k-1) S. A difference of two frames has
the excess kurtosis g^3 S / (2 (g S + r)^2). Pixels are judged by their own variance, whose expansion goes on with the sixth cumulant
over the third power of the variance: the kurtosis serves where that lies below the probe's floor.

Of rounded numbers few pixels jump where steps are coarse, and the others stand still.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.rounding import variance_before_rounding
from ..session.summaries import PIECE_FRAMES, SeriesSummary, kurtosis_excess
from .probes import FLOORS
from .scalar_context import Areas, ScalarContext

_COARSEST, _FINEST = 0.04, 0.7  # noise in steps: below, hardly a pixel jumps; above, rounding leaves a Gaussian


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


def tails_of_rounding(expected: ExpectedSeries, context: ScalarContext, variance_DN2: float) -> float:
    """Excess kurtosis that the ADC's steps leave in noise of a variance, rounding included."""
    step, of_one = expected.quantisation_step_DN, context.averaged * variance_DN2
    if step <= 0.0 or of_one > step**2:
        return 0.0
    before = float(variance_before_rounding(of_one, step))
    return rounded_kurtosis(math.sqrt(before) / step, context.frames) / context.averaged


def rounded_kurtosis(sd_steps: float, frames: int) -> float:
    """Excess kurtosis that `summarise_series` finds in frames of rounded Gaussian noise, each pixel's mean anywhere between codes.

    sd_steps: standard deviation of a frame before rounding, in steps; frames: of the series. Error: 0.1 of the value,
    0.15 where more than 64 frames are looked at in pieces of unlike length.
    """
    if not 0.0 < sd_steps < _FINEST or frames < 3:
        return 0.0
    nodes, values = _table(min(frames, PIECE_FRAMES))
    return float(np.interp(math.log(max(sd_steps, _COARSEST)), nodes, values))


@lru_cache(maxsize=16)
def _table(frames: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Logarithms of the noise in steps, and the excess kurtosis there; an integral over a Latin hypercube.

    Its own lines: `scipy.stats` has such points, and takes a third of a second to import.
    """
    from scipy.special import ndtri

    points = 8192
    mean = (np.arange(points) + 0.5) / points
    noise = np.random.default_rng(0).permuted(np.tile(ndtri(mean), (frames, 1)), axis=1)
    nodes = np.geomspace(_COARSEST, _FINEST, 25)
    values = np.zeros(nodes.size)
    for number, sd in enumerate(nodes):
        steps = np.diff(np.rint(mean + sd * noise), axis=0) ** 2
        inside = steps / np.maximum(steps.mean(axis=0), 1e-12)
        values[number] = kurtosis_excess(float(np.sum(inside**2)), float(inside.size), frames - 1)
    values[-1] = 0.0  # a Gaussian at the fine end
    return np.log(nodes), values

"""Noise of few quanta: its tails are expected, and asked for only where they are a number."""

from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.diagnosis.probes.noise_tails import enough_quanta, tails_of_quanta
from raytwin.diagnosis.probes.probes import FLOORS
from raytwin.diagnosis.probes.scalar_context import Areas
from raytwin.diagnosis.session.summaries import summarise_series

SHAPE = (96, 96)
GOOD = np.ones(SHAPE, bool)
AREAS = Areas.of(GOOD, np.zeros(SHAPE, int), 1)


def counted(quanta, *, gain=1.0, read=0.0, frames=40, seed=1):
    """Frames of Poisson quanta (row, column), and what is expected of them."""
    rng = np.random.default_rng(seed)
    mean = np.broadcast_to(quanta, SHAPE).astype(float)
    images = gain * rng.poisson(mean, (frames, *SHAPE)) + read * rng.standard_normal((frames, *SHAPE))
    expected = SimpleNamespace(
        mean_DN=gain * mean,
        dark_DN=np.zeros((1, 1)),
        quantum_variance_DN2=gain**2 * mean,
        white_variance_DN2=np.full(SHAPE, read**2),
    )
    summary = summarise_series([images.astype(np.float32)], good=GOOD, labels=np.zeros(SHAPE, int))
    return expected, summary


@pytest.mark.parametrize(("quanta", "gain", "read"), [(8.0, 1.0, 0.0), (8.0, 3.0, 6.0), (400.0, 2.0, 3.0)])
def test_tails_of_poisson_numbers_are_those_expected(quanta, gain, read):
    expected, summary = counted(quanta, gain=gain, read=read)
    assert enough_quanta(expected, AREAS, summary)
    # a sixtieth of sampling, and the next term of the expansion
    assert summary.kurtosis_excess == pytest.approx(tails_of_quanta(expected, AREAS), abs=0.03)


def test_tails_are_not_asked_for_where_a_part_of_the_field_counts_nothing():
    quanta = np.full(SHAPE, 400.0)
    quanta[:7] = 0.0
    expected, summary = counted(quanta)
    assert abs(summary.kurtosis_excess - tails_of_quanta(expected, AREAS)) > FLOORS["kurtosis"]
    assert not enough_quanta(expected, AREAS, summary)
    # read noise of a panel hides them
    panel = counted(quanta, gain=0.5, read=3.0)
    assert enough_quanta(panel[0], AREAS, panel[1])

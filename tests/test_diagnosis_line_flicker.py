"""Lines that flicker with the light: what their scalar probes are, against frames drawn line by line."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.diagnosis.probes.line_scalars import LineNoise, bent_share
from raytwin.diagnosis.probes.scalar_context import Areas
from raytwin.generator.line.line_state import LineFlicker

SHAPE, FRAMES = (48, 64), 3000


@pytest.mark.parametrize(("column_share", "together_lines"), [(0.0, 0.5), (0.0, 6.0), (1.0, 4.0), (0.3, 2.0)])
def test_variances_of_pixels_lines_blocks_and_frames_are_those_of_drawn_frames(column_share, together_lines):
    rng = np.random.default_rng(5)
    row, column = np.indices(SHAPE)
    signal = 1000.0 + 300.0 * (row > 20) + 5.0 * column
    flicker = LineFlicker(rms=0.01, column_share=column_share, together_lines=together_lines)
    factor = np.zeros((FRAMES, *SHAPE))
    for axis, share in enumerate((1.0 - column_share, column_share)):
        # a Gaussian process by its covariance, not by the recursion of the samples
        apart = np.abs(np.subtract.outer(np.arange(SHAPE[axis]), np.arange(SHAPE[axis])))
        lower = np.linalg.cholesky(np.exp(-apart / together_lines))
        lines = 0.01 * math.sqrt(share) * rng.standard_normal((FRAMES, SHAPE[axis])) @ lower.T
        factor += np.expand_dims(lines, 2 - axis)
    frames = signal * factor + 3.0 * rng.standard_normal((FRAMES, SHAPE[0], 1))
    labels = (row > 20).astype(np.int64)
    expected = SimpleNamespace(row_variance_DN2=9.0, column_variance_DN2=0.0, flicker=flicker, signal_DN=signal)
    context = SimpleNamespace(areas=Areas.of(np.ones(SHAPE, dtype=bool), labels, 2))
    found = LineNoise.of(expected, context)
    blocks = frames.reshape(FRAMES, 6, 8, 8, 8).mean(axis=(2, 4))
    seen = {
        found.pixel(): np.mean(frames**2),
        found.pixel(0): np.mean(frames[:, labels == 0] ** 2),
        found.pixel(1): np.mean(frames[:, labels == 1] ** 2),
        found.together(0, 1): np.mean(frames[:, :, 1:] * frames[:, :, :-1]),
        found.together(1, 0): np.mean(frames[:, 1:] * frames[:, :-1]),
        found.block(8): np.mean(blocks**2),
        found.frame(*SHAPE): np.mean(frames.mean(axis=(1, 2)) ** 2),
    }
    for known, value in seen.items():
        assert value == pytest.approx(known, rel=0.12)
    if column_share == 0.0:
        assert np.mean(frames.mean(axis=2) ** 2) == pytest.approx(found.rows(), rel=0.08)
        bent = np.mean(np.diff(factor[:, :, 0], n=2, axis=1) ** 2) / 6.0
        assert bent == pytest.approx(1e-4 * bent_share(flicker), rel=0.08)
    if column_share == 1.0:
        assert np.mean(frames.mean(axis=1) ** 2) == pytest.approx(found.columns() + found.row / SHAPE[0], rel=0.08)


def test_without_light_or_flicker_only_offsets_are_left():
    expected = SimpleNamespace(row_variance_DN2=4.0, column_variance_DN2=1.0, flicker=None, signal_DN=np.zeros((1, 1)))
    found = LineNoise.of(expected, None)
    assert (found.pixel(), found.pixel(3), found.rows(), found.columns()) == (5.0, 5.0, 4.0, 1.0)
    assert (found.together(0, 1), found.together(2, 0), found.together(1, 1)) == (4.0, 1.0, 0.0)
    assert found.block(8) == pytest.approx(5.0 / 8.0) and found.frame(10, 20) == pytest.approx(0.4 + 0.05)

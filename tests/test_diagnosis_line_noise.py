"""Noise of lines, with the light or without: what its scalar probes are, against frames drawn line by line."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.diagnosis.model.changes import READ_TEXTURE_SD
from raytwin.diagnosis.probes.fixed_pattern import pattern_statistics
from raytwin.diagnosis.probes.line_scalars import LineNoise, bent_share, line_pattern, of_mean
from raytwin.diagnosis.probes.probes import noise_name
from raytwin.diagnosis.probes.scalar_context import Areas
from raytwin.diagnosis.problem.nuisance_columns import _read_texture
from raytwin.generator.line.line_state import EACH_LINE, LineFlicker

SHAPE, FRAMES = (48, 64), 3000


def drawn_lines(rng, count, together_lines):
    """Gaussian processes (frame, line) by their covariance, not by the recursion of the samples."""
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return rng.standard_normal((FRAMES, count)) @ np.linalg.cholesky(np.exp(-apart / together_lines)).T


@pytest.mark.parametrize(
    ("column_share", "together_lines", "in_bands"),
    [(0.0, 0.5, 2.0), (0.0, 6.0, EACH_LINE), (1.0, 4.0, 5.0), (0.3, 2.0, 1.0)],
)
def test_variances_of_pixels_lines_blocks_and_frames_are_those_of_drawn_frames(column_share, together_lines, in_bands):
    rng = np.random.default_rng(5)
    row, column = np.indices(SHAPE)
    signal = 1000.0 + 300.0 * (row > 20) + 5.0 * column
    flicker = LineFlicker(rms=0.01, column_share=column_share, together_lines=together_lines)
    factor = np.zeros((FRAMES, *SHAPE))
    for axis, share in enumerate((1.0 - column_share, column_share)):
        lines = 0.01 * math.sqrt(share) * drawn_lines(rng, SHAPE[axis], together_lines)
        factor += np.expand_dims(lines, 2 - axis)
    offsets = 3.0 * drawn_lines(rng, SHAPE[0], in_bands)
    frames = signal * factor + offsets[:, :, None]
    labels = (row > 20).astype(np.int64)
    expected = SimpleNamespace(
        row_variance_DN2=9.0,
        column_variance_DN2=0.0,
        offsets_together_lines=in_bands,
        flicker=flicker,
        signal_DN=signal,
    )
    context = SimpleNamespace(areas=Areas.of(np.ones(SHAPE, dtype=bool), labels, 2))
    found = LineNoise.of(expected, context)
    blocks = frames.reshape(FRAMES, 6, 8, 8, 8).mean(axis=(2, 4))
    seen = {
        found.pixel(): np.mean(frames**2),
        found.pixel(0): np.mean(frames[:, labels == 0] ** 2),
        found.pixel(1): np.mean(frames[:, labels == 1] ** 2),
        found.together(0, 1): np.mean(frames[:, :, 1:] * frames[:, :, :-1]),
        found.together(1, 0): np.mean(frames[:, 1:] * frames[:, :-1]),
        found.frame(8, 8): np.mean(blocks**2),
        found.frame(*SHAPE): np.mean(frames.mean(axis=(1, 2)) ** 2),
    }
    for known, value in seen.items():
        assert value == pytest.approx(known, rel=0.12)
    if column_share == 0.0:
        assert np.mean(frames.mean(axis=2) ** 2) == pytest.approx(found.rows(), rel=0.08)
        bent = np.mean(np.diff(factor[:, :, 0], n=2, axis=1) ** 2) / 6.0
        assert bent == pytest.approx(1e-4 * bent_share(together_lines), rel=0.08)
    assert np.mean(np.diff(offsets, n=2, axis=1) ** 2) / 6.0 == pytest.approx(9.0 * bent_share(in_bands), rel=0.08)
    if column_share == 1.0:
        assert np.mean(frames.mean(axis=1) ** 2) == pytest.approx(
            found.columns() + 9.0 * of_mean(SHAPE[0], in_bands), rel=0.08
        )


@pytest.mark.parametrize(("column_share", "together_lines"), [(0.0, 0.5), (1.0, 0.5), (0.4, 4.0)])
def test_a_fixed_pattern_shows_the_lines_of_its_few_frames(column_share, together_lines):
    rng = np.random.default_rng(6)
    shape = (64, 512)  # of few columns the smooth surface follows a part
    rms, offset_DN, level_DN = 0.01, 4.0, 1000.0
    lines = [drawn_lines(rng, length, together_lines)[:60] for length in shape]
    frames = level_DN * rms * math.sqrt(1.0 - column_share) * lines[0][:, :, None]
    frames = frames + level_DN * rms * math.sqrt(column_share) * lines[1][:, None, :]
    frames += offset_DN * rng.standard_normal((60, 1, shape[1]))
    everywhere = np.ones(shape, dtype=bool)
    seen = [pattern_statistics(one, np.full(shape, level_DN), clean=everywhere, good=everywhere) for one in frames]
    expected = SimpleNamespace(
        row_variance_DN2=0.0,
        column_variance_DN2=offset_DN**2,
        offsets_together_lines=EACH_LINE,
        flicker=LineFlicker(rms=rms, column_share=column_share, together_lines=together_lines),
    )
    wanted = line_pattern(expected, level_DN**2)
    np.testing.assert_allclose(np.mean(seen, axis=0), wanted, rtol=0.1, atol=1e-6 * level_DN)


def test_without_light_or_flicker_only_offsets_are_left():
    expected = SimpleNamespace(
        row_variance_DN2=4.0,
        column_variance_DN2=1.0,
        offsets_together_lines=EACH_LINE,
        flicker=None,
        signal_DN=np.zeros((1, 1)),
    )
    found = LineNoise.of(expected, SimpleNamespace(areas=SimpleNamespace(parts=range(4))))
    assert (found.pixel(), found.pixel(3), found.rows(), found.columns()) == (5.0, 5.0, 4.0, 1.0)
    assert [found.together(0, 1), found.together(2, 0), found.together(1, 1)] == pytest.approx(
        [4.0, 1.0, 0.0], abs=1e-3
    )
    assert found.frame(8, 8) == pytest.approx(5.0 / 8.0, rel=1e-3)
    assert found.frame(10, 20) == pytest.approx(0.4 + 0.05, rel=1e-3)


@pytest.mark.parametrize("lag", [(0, 1), (0, 3), (2, 0), (1, 1), (1, -1)])
def test_read_noise_that_neighbours_share_moves_their_correlation_lines_and_blocks(lag):
    """Against white noise of which each pixel takes a part of another one's."""
    share, white, quanta = 0.2, 9.0, 3.0
    rng = np.random.default_rng(8)
    drawn = rng.standard_normal((600, SHAPE[0] + 6, SHAPE[1] + 6))
    moved = (drawn + share * np.roll(drawn, lag, axis=(1, 2)))[:, 3:-3, 3:-3] / math.sqrt(1.0 + share**2)
    frames = math.sqrt(white) * moved + math.sqrt(quanta) * rng.standard_normal(moved.shape)
    rho = share / (1.0 + share**2)
    total = white + quanta
    lines = {
        "row_ratio": frames.mean(axis=2).var() * SHAPE[1] / total,
        "column_ratio": frames.mean(axis=1).var() * SHAPE[0] / total,
        "block_ratio": frames.reshape(600, 6, 8, 8, 8).mean(axis=(2, 4)).var() * 64 / total,
    }
    down, right = lag
    here = frames[:, : SHAPE[0] - down, max(-right, 0) : SHAPE[1] - max(right, 0)]
    there = frames[:, down:, max(right, 0) : SHAPE[1] + min(right, 0)]
    own, other = noise_name("field", lag), noise_name("field", (0, 2))
    scalars = [
        *(SimpleNamespace(name=name, label="", lag=None) for name in lines),
        SimpleNamespace(name=own, label="field", lag=lag),
        SimpleNamespace(name=other, label="field", lag=(0, 2)),
    ]
    context = SimpleNamespace(
        areas=Areas.of(np.ones(SHAPE, dtype=bool), np.zeros(SHAPE, np.int64), 1),
        label_names=("field",),
        good=np.ones(SHAPE, dtype=bool),
    )
    expected = SimpleNamespace(quantum_variance_DN2=np.full((1, 1), quanta), white_variance_DN2=np.full((1, 1), white))
    series = SimpleNamespace(expected=expected, context=context, scalars=dict.fromkeys(lines, 0.0))
    probes = SimpleNamespace(series=series, of_scalars=lambda change: np.array([change(one) for one in scalars]))
    moved_by = _read_texture(probes, lag) * rho / READ_TEXTURE_SD
    found = {one.name: value for one, value in zip(scalars, moved_by, strict=True)}
    for name, ratio in lines.items():
        assert ratio - 1.0 == pytest.approx(found[name], abs=0.04)
    assert np.mean(here * there) / total == pytest.approx(found[own], abs=0.005)
    assert found[other] == 0.0

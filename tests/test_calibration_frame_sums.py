"""Sums over frames against numpy; parts merge; drift and lag move the two variances as their laws say."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from raytwin.calibration.frames.frame_sums import effective_frames, sum_frames
from raytwin.errors import InputError


def in_pieces(frames, cuts):
    edges = [0, *sorted(cuts), len(frames)]
    return (frames[start:stop] for start, stop in pairwise(edges))


def steps_of(frames):
    """From each frame to the next; those to a copy are none, unless all are."""
    steps = np.diff(frames.astype(np.float64), axis=0)
    moved = steps.any(axis=(1, 2)) | (np.ptp(frames[1:], axis=(1, 2)) == 0)
    return steps[moved] if moved.any() else steps


stacks = st.integers(2, 12).flatmap(lambda n: arrays(np.uint16, (n, 3, 4), elements=st.integers(0, 65535)))


@given(stacks, st.lists(st.integers(0, 12), max_size=3))
def test_sums_are_numpy_s_however_the_frames_arrive(frames, cuts):
    total = sum_frames(in_pieces(frames, [min(cut, len(frames)) for cut in cuts]))
    exact = frames.astype(np.float64)
    assert total.frames == len(frames)
    assert total.mean_DN == pytest.approx(exact.mean(axis=0), rel=1e-12, abs=1e-9)
    assert total.stack_variance_DN2 == pytest.approx(exact.var(axis=0, ddof=1), rel=1e-9, abs=1e-4)
    assert total.pair_variance_DN2 == pytest.approx(np.mean(steps_of(exact) ** 2, axis=0) / 2, rel=1e-12)
    assert total.frame_mean_DN == pytest.approx(exact.mean(axis=(1, 2)))
    assert total.maximum_DN == frames.max()
    assert total.maximum_count == np.sum(frames == frames.max())
    assert total.integer


def test_large_offsets_do_not_cost_digits():
    noise = np.random.default_rng(0).standard_normal((50, 8, 8)).astype(np.float32)
    frames = (noise + np.float32(60000.0)).astype(np.float32)
    exact = frames.astype(np.float64).var(axis=0, ddof=1)
    assert sum_frames([frames]).stack_variance_DN2 == pytest.approx(exact, rel=1e-9)
    assert not sum_frames([frames]).integer


def test_effective_frames_is_von_neumann_s_variance_of_successive_differences():
    rng = np.random.default_rng(1)
    n, stacks_drawn = 10, 40000
    values = rng.standard_normal((stacks_drawn, n))
    estimates = np.mean(np.diff(values, axis=1) ** 2, axis=1) / 2
    assert 2.0 / effective_frames(n) == pytest.approx(estimates.var(), rel=5 * np.sqrt(4.0 / stacks_drawn))
    assert effective_frames(2) == 1.0
    assert effective_frames(1) == 0.0


def ratio_of(frames):
    """Stack and pair variance, means over pixels."""
    total = sum_frames([frames.astype(np.float32)])
    return float(total.stack_variance_DN2.mean()), float(total.pair_variance_DN2.mean())


def test_a_ramp_inflates_the_stack_variance_and_leaves_pairs_alone():
    """A ramp of 1 % adds (0.01 I)^2 / 12 to the stack variance: +1.7 % of the quantum variance at 2000 quanta."""
    rng = np.random.default_rng(2)
    level, frames = 2000.0, 60
    noise = np.sqrt(level) * rng.standard_normal((frames, 60, 60))
    ramp = 0.01 * level * np.linspace(-0.5, 0.5, frames)[:, None, None]
    still, drifting = ratio_of(level + noise), ratio_of(level + noise + ramp)
    law = (0.01 * level) ** 2 / 12
    allowed = 4 * 2 * np.sqrt(level * law / noise[0].size / frames)  # of the cross term ramp x noise
    assert drifting[0] - still[0] == pytest.approx(
        law * frames / (frames - 1) * (1 + 1 / frames), abs=allowed + 0.05 * law
    )
    assert law / level == pytest.approx(0.0167, abs=1e-4)
    assert drifting[1] == pytest.approx(still[1], rel=1e-3)


def test_lag_of_two_percent_lowers_the_stack_variance_to_0_961_and_the_pairs_to_0_941():
    rng = np.random.default_rng(3)
    frames, lag = 200, 0.02
    fresh = rng.standard_normal((frames + 20, 70, 70))
    lagged = np.empty_like(fresh)
    lagged[0] = fresh[0]
    for k in range(1, len(fresh)):
        lagged[k] = (1 - lag) * fresh[k] + lag * lagged[k - 1]
    stack, pair = ratio_of(lagged[20:])
    sampling = 4 * np.sqrt(3.0 / fresh[20:].size)
    assert stack == pytest.approx(0.961, abs=sampling + 5e-4)
    assert pair == pytest.approx(0.941, abs=sampling + 8e-4)


def test_a_single_frame_has_no_variance():
    total = sum_frames([np.ones((1, 4, 4), dtype=np.uint16)])
    assert np.all(np.isnan(total.stack_variance_DN2))
    assert np.all(np.isnan(total.pair_variance_DN2))


@pytest.mark.parametrize(
    ("pieces", "message"),
    [
        ([], "series a: got no frames; expected at least one frame"),
        ([np.zeros((0, 3, 3))], "series a: got no frames"),
        ([np.zeros((2, 3, 3)), np.zeros((2, 3, 4))], "frames .n, row, column. of one shape"),
        ([np.zeros((3, 3))], "got shape .3, 3."),
        ([np.full((2, 3, 3), np.nan)], "series a: got NaN or infinite detector numbers"),
        ([np.full((2, 3, 3), np.inf)], "NaN or infinite"),
    ],
)
def test_frames_that_cannot_be_summed_are_refused(pieces, message):
    with pytest.raises(InputError, match=message):
        sum_frames(pieces, name="series a")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_counts_have_the_sums_of_the_same_frames_as_float_over_blocks_and_pieces(dtype):
    """2500 pixels: two whole blocks of the compiled loop and a part of one; the highest value is met on purpose."""
    highest = np.iinfo(dtype).max
    frames = np.random.default_rng(4).integers(0, highest, size=(40, 50, 50), endpoint=True).astype(dtype)
    frames[3, 0, :5] = frames[30, 49, 7] = highest
    counts = sum_frames(in_pieces(frames, [1, 17]))
    floats = sum_frames(in_pieces(frames.astype(np.float64), [1, 17]))
    for name in ("frames", "pairs", "maximum_DN", "maximum_count", "integer"):
        assert getattr(counts, name) == getattr(floats, name), name
    for name in ("reference", "deviation_sum", "square_sum", "pair_square_sum"):
        assert np.array_equal(getattr(counts, name), getattr(floats, name)), name  # whole numbers: exact in both
    assert counts.frame_mean_DN == pytest.approx(floats.frame_mean_DN, rel=1e-12)
    assert counts.maximum_count == np.sum(frames == highest)


def test_counts_after_floats_keep_the_reference_of_the_floats():
    frames = np.random.default_rng(5).integers(0, 4000, size=(9, 4, 6))
    offset = frames + 0.25
    mixed = sum_frames([offset[:3], frames[3:].astype(np.uint16)])
    exact = np.concatenate([offset[:3], frames[3:].astype(np.float64)])
    assert mixed.stack_variance_DN2 == pytest.approx(exact.var(axis=0, ddof=1), rel=1e-12)
    assert mixed.pair_variance_DN2 == pytest.approx(np.mean(np.diff(exact, axis=0) ** 2, axis=0) / 2, rel=1e-12)
    assert not mixed.integer


@pytest.mark.parametrize("spread", [1, 3000, 65535])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_sums_of_many_frames_are_exact_whatever_the_spread_of_their_values(dtype, spread):
    """Quiet and wild stretches in turn, so that narrow sums fill up, are moved and go on."""
    rng = np.random.default_rng(3)
    top = np.iinfo(dtype).max
    wild = rng.integers(0, top, size=(151, 5, 7), endpoint=True)
    quiet = rng.integers(max(top - spread, 0), top, size=(2 * 151, 5, 7), endpoint=True)
    frames = np.concatenate([quiet[:151], wild, quiet[151:]]).astype(dtype)
    whole = frames.astype(np.int64)
    for total in (sum_frames([frames]), sum_frames([frames[:33], frames[33:]])):
        away = whole - whole[0]
        assert np.array_equal(total.deviation_sum, away.sum(axis=0))
        assert np.array_equal(total.square_sum, (away**2).sum(axis=0))
        assert np.array_equal(total.pair_square_sum, (np.diff(whole, axis=0) ** 2).sum(axis=0))
        assert (total.maximum_DN, total.maximum_count) == (whole.max(), np.sum(whole == whole.max()))


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_copies_of_frames_leave_the_variance_of_pairs_alone(dtype):
    rng = np.random.default_rng(8)
    frames = np.rint(1000 + 9 * rng.standard_normal((40, 12, 15))).astype(dtype)
    stored = np.repeat(frames, 1 + (np.arange(40) % 3 == 1), axis=0)
    for cuts in ([], [2], [3, 20]):
        total = sum_frames(in_pieces(stored, cuts))
        assert total.frames == len(stored) and total.pairs == 39
        np.testing.assert_allclose(total.pair_variance_DN2, sum_frames([frames]).pair_variance_DN2)
    still = sum_frames([np.repeat(frames[:1], 5, axis=0)])
    assert still.pairs == 4 and not still.pair_variance_DN2.any()

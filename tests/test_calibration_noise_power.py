"""Noise power of frame differences: known noise is found whatever changes smoothly beside it."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from raytwin.calibration.spread.noise_power import (
    compute_difference_power,
    compute_noise_power,
    correlation_of_quanta,
    rounding_variance,
    smeared,
    spread_of_bins,
    usable,
)
from raytwin.errors import InputError
from raytwin.generator.spread.noise import sample_frame_noise
from raytwin.generator.spread.psf import Spread

SHAPE = (96, 120)
SPREAD = Spread(sigma_px=0.5)
SIGNAL, GAIN, READ_DN2 = 1000.0, 8.0, 120.0
LEVEL = np.full(SHAPE, SIGNAL)


def frames_of(count, *, seed=0, spread=SPREAD, level=LEVEL):
    rng = np.random.default_rng(seed)
    noise = {"gain_DN": GAIN, "white_fraction": 0.0, "read_variance_DN2": READ_DN2, "spread": spread, "rng": rng}
    return np.stack([level + sample_frame_noise(level, **noise) for _ in range(count)])


def expected_power(side, spread=SPREAD):
    return smeared(GAIN * SIGNAL * spread.noise_power(side) + READ_DN2)


def misfit(found, expected):
    """Mean of measured over expected less 1, in its own standard deviations."""
    ratio = np.where(found.used, found.power_DN2 / expected - 1.0, 0.0)
    return float(np.sum(found.modes * ratio) / found.modes.sum()) * math.sqrt(found.modes.sum())


def smooth_change(seed):
    """A smooth map of zero mean and rms 1, over half of the field."""
    field = gaussian_filter(np.random.default_rng(seed).standard_normal(SHAPE), 40, mode="wrap")
    return (field - field.mean()) / field.std()


@pytest.mark.parametrize("spread", [SPREAD, Spread(sigma_px=0.4, aspect=1.3, tail_share=0.2, tail_px=1.0)])
def test_power_is_that_of_the_noise_within_sampling_error(spread):
    found = compute_noise_power([frames_of(12, spread=spread)], signal_DN=LEVEL, good=np.ones(SHAPE, bool))
    expected = expected_power(found.square_px, spread)
    assert abs(misfit(found, expected)) < 4.0
    assert found.common_mode == 0.0
    assert abs(found.row_variance_DN2) < 4.0 * found.row_sd_DN2


@pytest.mark.parametrize("blurred", [False, True], ids=["white", "blurred"])
def test_bad_pixels_take_nothing_from_the_power(blurred):
    """A dead column, a cluster and 2 % single bad pixels: the power at low and at other frequencies within its scatter.

    The same noise with and without holes: 60 frames of 64 x 64; the holes' own scatter is about 0.1 % at all frequencies and
    0.7 % at the lowest lines in use. Without account of the holes they are 1 % and 8 % too low.
    """
    shape = (64, 64)
    good = np.random.default_rng(1).random(shape) > 0.02
    good[:, 27] = False
    good[40:46, 10:16] = False
    spread = Spread(sigma_px=0.8, tail_share=0.1, tail_px=1.5)
    rng = np.random.default_rng(2)
    if blurred:
        noise = {"gain_DN": 1.0, "white_fraction": 0.0, "read_variance_DN2": 0.0, "spread": spread, "rng": rng}
        frames = np.stack([sample_frame_noise(np.ones(shape), **noise) for _ in range(60)])
    else:
        frames = rng.standard_normal((60, *shape))
    everywhere = np.ones(shape, bool)
    whole = compute_noise_power([frames], signal_DN=np.zeros(shape), good=everywhere)
    broken = compute_noise_power([np.where(good, frames, 0.0)], signal_DN=np.zeros(shape), good=good)
    power = spread.noise_power(whole.square_px) if blurred else np.ones_like(whole.power_DN2)
    shown = [item.smeared(power) for item in (whole, broken)]
    used = whole.used & broken.used
    order = np.arange(power.shape[0])
    lowest = np.minimum(order[:, None], order[None, :])
    for chosen, most in ((used, 0.004), (used & (lowest == 1), 0.025)):
        found = [np.sum(item.power_DN2[chosen]) for item in (whole, broken)]
        expected = [np.sum(item[chosen]) for item in shown]
        assert found[1] / found[0] == pytest.approx(expected[1] / expected[0], abs=most)


def test_the_variance_of_lines_is_neither_too_large_nor_surer_than_it_is():
    """White noise and offsets of rows of a tenth of it: 150 series of small frames, mean within four standard errors."""
    shape, rows_DN2 = (64, 64), 0.01
    rng = np.random.default_rng(11)
    found = []
    for _ in range(150):
        frames = rng.standard_normal((8, *shape)) + math.sqrt(rows_DN2) * rng.standard_normal((8, shape[0], 1))
        power = compute_noise_power([frames], signal_DN=np.zeros(shape), good=np.ones(shape, bool))
        found.append(
            [power.row_variance_DN2 - rows_DN2, power.row_sd_DN2, power.column_variance_DN2, power.column_sd_DN2]
        )
    off_rows, sd_rows, off_columns, sd_columns = np.array(found).T
    for off, sd in ((off_rows, sd_rows), (off_columns, sd_columns)):
        z = off / sd
        assert abs(z.mean()) < 4.0 / math.sqrt(z.size)
        # the standard deviation of a sample of 150: 6 %
        assert 0.75 < z.std() < 1.24


def test_drift_of_level_and_shape_and_offsets_of_lines_leave_the_power_alone():
    """Level 1 %, shape 0.3 % rms and lines of half a read noise from frame to frame: summed up, forty times the noise."""
    rng = np.random.default_rng(3)
    clean = frames_of(12)
    factors = 0.01 * rng.standard_normal(12)
    change = np.stack([0.003 * smooth_change(seed) + factor for seed, factor in enumerate(factors)])
    lines = 5.5 * rng.standard_normal((12, SHAPE[0], 1))
    good = np.ones(SHAPE, bool)
    found = compute_noise_power([clean + change * SIGNAL + lines], signal_DN=LEVEL, good=good)
    undisturbed = compute_noise_power([clean], signal_DN=LEVEL, good=good)
    above = np.where(found.used, np.abs(found.power_DN2 / undisturbed.power_DN2 - 1.0), 0.0)
    lowest = np.minimum.outer(*(np.arange(above.shape[0]),) * 2)
    assert above[lowest >= 2].max() < 0.02
    assert math.sqrt(found.row_variance_DN2) == pytest.approx(5.5, rel=0.25)
    assert math.sqrt(found.common_mode) == pytest.approx(math.sqrt(np.mean(np.diff(factors) ** 2) / 2), rel=0.05)


def test_what_the_projection_takes_is_given_back():
    """White noise has the same power at every frequency in use, also where a constant and a slope are projected out."""
    rng = np.random.default_rng(1)
    found = compute_noise_power(
        [rng.standard_normal((200, 48, 48))], signal_DN=np.zeros((48, 48)), good=np.ones((48, 48), bool)
    )
    sd = np.where(found.used, 1.0 / np.sqrt(np.where(found.used, found.modes * spread_of_bins(32), 1.0)), np.inf)
    assert np.all(np.abs(np.where(found.used, found.power_DN2, 1.0) - 1.0) < 6.0 * sd)
    assert usable(32)[1, 2] and not usable(32)[1, 1] and not usable(32)[0, 5]


def test_bad_pixels_leave_no_trace():
    frames = frames_of(12)
    good = np.random.default_rng(0).random(SHAPE) > 0.01
    good[:, 50] = False
    frames[:, ~good] = 65535.0 * np.random.default_rng(1).random((len(frames), int((~good).sum())))
    found = compute_noise_power([frames], signal_DN=LEVEL, good=good)
    assert abs(misfit(found, expected_power(found.square_px))) < 4.0


def test_pieces_do_not_matter():
    frames = frames_of(8)
    good = np.ones(SHAPE, bool)
    one = compute_noise_power([frames], signal_DN=LEVEL, good=good)
    many = compute_noise_power([frames[:1], frames[1:6], frames[6:]], signal_DN=LEVEL, good=good)
    assert many.power_DN2 == pytest.approx(one.power_DN2, nan_ok=True)


def test_single_averaged_flats_at_two_levels_hold_the_noise_of_one_exposure():
    """Pattern of the pixels and shape of the beam cancel; two levels weigh quanta and electronics by their own law."""
    rng = np.random.default_rng(5)
    gain = 1.0 + 0.02 * rng.standard_normal(SHAPE)
    count, ratio, levels, powers = 30, 0.4, [], []
    for seed in range(6):
        flats = []
        for factor, part in ((1.0, 0), (ratio, 1)):
            level = factor * LEVEL
            mean = frames_of(count, seed=100 + 2 * seed + part, level=level).mean(axis=0)
            flats.append(gain * (mean + factor * SIGNAL * 0.001 * smooth_change(seed)))
        powers.append(
            compute_difference_power(
                *flats,
                exposures=(count, count),
                dark_exposures=(0, 0),
                same_dark=True,
                good=np.ones(SHAPE, bool),
            )
        )
        levels.append(powers[-1].signal_DN)
    signal = (1 / SIGNAL + 1 / (ratio * SIGNAL)) / (1 / SIGNAL**2 + 1 / (ratio * SIGNAL) ** 2)
    assert levels == pytest.approx([signal] * 6, rel=0.02)
    side = powers[0].square_px
    expected = smeared(GAIN * signal * SPREAD.noise_power(side) + READ_DN2)
    mean = np.mean([item.power_DN2 for item in powers], axis=0)
    weight = powers[0].modes
    found = float(np.sum(weight * np.where(powers[0].used, mean / expected - 1.0, 0.0)) / weight.sum())
    # the pattern's own square (0.02^2) and sampling
    assert abs(found) < 4.0 / math.sqrt(6 * weight.sum()) + 0.003


def test_flats_no_brighter_than_their_noise_are_divided_by_the_beams_shape_and_not_by_themselves():
    rng = np.random.default_rng(8)
    level, count = 3.0, 20
    gain = 1.0 + 0.02 * rng.standard_normal(SHAPE)
    found, alone = [], []
    for seed in range(4):
        flats = [
            gain * frames_of(count, seed=300 + 2 * seed + part, level=level / SIGNAL * LEVEL).mean(axis=0)
            for part in (0, 1)
        ]
        known = {"exposures": (count, count), "dark_exposures": (0, 0), "same_dark": True, "good": np.ones(SHAPE, bool)}
        found.append(compute_difference_power(*flats, shape=gain, **known))
        alone.append(compute_difference_power(*flats, **known))
    expected = smeared(GAIN * found[0].signal_DN * SPREAD.noise_power(found[0].square_px) + READ_DN2)
    misfits = [
        float(np.mean([np.nanmean(item.power_DN2 / expected) for item in items])) - 1.0 for items in (found, alone)
    ]
    assert abs(misfits[0]) < 4.0 / np.sqrt(4 * found[0].modes.sum()) + 0.01
    assert misfits[1] > 0.2


def test_correlation_of_neighbours_is_that_of_the_spread_and_its_interval_holds_it():
    found = compute_noise_power([frames_of(20)], signal_DN=LEVEL, good=np.ones(SHAPE, bool))
    quanta = GAIN * SIGNAL * SPREAD.noise_power(found.square_px)
    rho = SPREAD.noise_autocovariance(2) / SPREAD.variance_share
    for row in correlation_of_quanta([found], [smeared(quanta) + READ_DN2], [quanta]):
        true = rho[2 + row["lag_row"], 2 + row["lag_column"]]
        assert abs(row["value"] - true) < 2.0 * (row["high"] - row["low"])
        assert row["high"] - row["low"] < 0.03


def test_too_few_frames_or_good_pixels_are_refused():
    with pytest.raises(InputError, match="at least two frames"):
        compute_noise_power([frames_of(1)], signal_DN=LEVEL, good=np.ones(SHAPE, bool))
    with pytest.raises(InputError, match="good pixels: got 0; expected squares of 64 x 64 px"):
        compute_noise_power([frames_of(2)], signal_DN=LEVEL, good=np.zeros(SHAPE, bool))


def test_copies_of_frames_leave_the_noise_power_alone():
    frames = frames_of(12)
    good = np.ones(SHAPE, bool)
    stored = np.repeat(frames, 1 + (np.arange(12) % 3 == 1), axis=0)
    found, once = (compute_noise_power([each], signal_DN=LEVEL, good=good) for each in (stored, frames))
    np.testing.assert_allclose(found.power_DN2, once.power_DN2)
    still = compute_noise_power([np.repeat(frames[:1], 4, axis=0)], signal_DN=LEVEL, good=good)
    assert not np.nan_to_num(still.power_DN2).any()


@pytest.mark.parametrize("sd_DN", [0.05, 0.1, 0.25, 0.5, 2.0])
def test_rounding_adds_a_twelfth_and_less_to_noise_far_below_a_step(sd_DN):
    rng = np.random.default_rng(12)
    levels = rng.random((20000, 1))
    stored = float(np.mean(np.var(np.rint(levels + sd_DN * rng.standard_normal((20000, 60))), axis=1, ddof=1)))
    assert stored - rounding_variance(stored) == pytest.approx(sd_DN**2, rel=0.02, abs=6e-4)


@pytest.mark.parametrize("averaged", [16, 64])
def test_means_that_were_rounded_give_the_noise_of_one_exposure(averaged):
    """Rounding comes once a mean: 64 times over it would be read noise of 2.3 DN."""
    rng = np.random.default_rng(averaged)
    exact = 400.0 + rng.random((128, 128)) + 2.0 / np.sqrt(averaged) * rng.standard_normal((20, 128, 128))
    good = np.ones((128, 128), dtype=bool)
    found = compute_noise_power([np.rint(exact)], signal_DN=np.zeros((128, 128)), good=good)
    one = found.as_exposure(averaged, whole=True)
    assert float(np.nanmean(one.power_DN2)) == pytest.approx(4.0, rel=0.02)
    assert float(np.nanmean(found.as_exposure(averaged, whole=False).power_DN2)) > 4.0 + 0.9 * averaged / 12.0

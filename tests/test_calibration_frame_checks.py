"""Frames that are copies are found and counted once; frames of one scene are one scene under noise, drift and flicker."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from raytwin.calibration.frames.frame_checks import (
    SceneChange,
    growth_of_noise,
    repeated_frame_indices,
    row_length_shown,
    same_scene,
)

WALNUT = Path(__file__).parents[2] / "shared" / "realdata" / "flexray_walnut"
DARK_DN = 300.0
GAIN_DN = 2.0


def flats(mean_DN, count, *, rng, spread_px=0.8, drift=0.0, shape=0.0, flicker=0.0, lines_DN=0.0):
    """Frames of a mean (row, column), DN above dark: correlated noise, and what a line does without a new scene."""
    rows, columns = mean_DN.shape
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    frames = []
    for part in np.linspace(0.0, 1.0, count):
        level = 1.0 + drift * part + flicker * rng.standard_normal()
        expected = mean_DN * level * (1.0 + shape * part * np.sin(2.0 * x + 1.0) * np.cos(1.5 * y))
        noise = gaussian_filter(np.sqrt(GAIN_DN * expected) * rng.standard_normal(expected.shape), spread_px)
        noise += 4.0 * rng.standard_normal(expected.shape)
        noise += lines_DN * (rng.standard_normal((rows, 1)) + rng.standard_normal((1, columns)))
        frames.append(np.rint(DARK_DN + expected + noise))
    return np.array(frames).astype(np.uint16)


def product(shape=(128, 160)):
    """A flat with a dense disc in it, DN above dark."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    inside = np.hypot(y - 60, x - 80) < 35
    return gaussian_filter(np.where(inside, 2000.0, 9000.0), 0.8)


def test_copies_are_found_wherever_they_stand_and_in_whatever_pieces():
    frames = flats(product(), 6, rng=np.random.default_rng(0))
    series = np.concatenate([frames[:3], frames[2:3], frames[2:], frames[1:2]])
    assert repeated_frame_indices([series]) == (3, 4, 8)
    assert repeated_frame_indices([series[:4], series[4:5], series[5:]]) == (3, 4, 8)
    assert repeated_frame_indices([frames]) == ()


def test_rows_of_another_length_are_told_by_the_light_that_neighbours_share():
    rng = np.random.default_rng(5)
    first, second = flats(np.full((48, 64), 9000.0), 2, rng=rng, lines_DN=30.0, shape=0.01)
    assert row_length_shown(first, second) is None
    assert row_length_shown(first.reshape(64, 48), second.reshape(64, 48)) == 64
    assert row_length_shown(first.reshape(96, 32), second.reshape(96, 32)) == 64
    # lines that share light along themselves alone, whose readout repeats every 16 pixels; noise that nobody shares
    taps = np.tile(60.0 * rng.standard_normal((2, 48, 16)), (1, 1, 4))
    along = taps + gaussian_filter(100.0 * rng.standard_normal((2, 48, 64)), (0.0, 0.0, 0.8))
    assert row_length_shown(*along) is None
    assert row_length_shown(*rng.standard_normal((2, 48, 64))) is None
    assert row_length_shown(*np.zeros((2, 48, 64))) is None


def test_saturated_frames_with_a_few_dead_pixels_are_no_copies():
    frames = np.full((8, 32, 32), 16383, dtype=np.uint16)
    frames[:, ::7, ::9] = 12
    assert repeated_frame_indices([frames]) == ()


def test_frames_that_are_equal_by_chance_are_no_copies():
    rng = np.random.default_rng(1)
    assert repeated_frame_indices([np.zeros((5, 8, 8), np.uint16)]) == ()
    # six pixels of half a DN of noise: many of 19900 pairs are equal
    small = np.rint(100.0 + 0.5 * rng.standard_normal((200, 2, 3))).astype(np.uint16)
    assert repeated_frame_indices([small]) == ()


@pytest.mark.parametrize("spread_px", [0.4, 2.0])
def test_noise_drift_flicker_shape_and_lines_are_one_scene(spread_px):
    rng = np.random.default_rng(2)
    for mean in (product(), np.full((24, 28), 6000.0)):
        frames = flats(mean, 8, rng=rng, spread_px=spread_px, drift=0.02, shape=0.01, flicker=0.005, lines_DN=6.0)
        found = same_scene([frames[:3], frames[3:]], offset_DN=DARK_DN)
        assert found.same is True, found


def test_a_turned_object_a_moved_table_and_a_shutter_are_other_scenes():
    rng = np.random.default_rng(3)
    still, mean = flats(product(), 4, rng=rng), product()
    moved = same_scene([still, flats(np.roll(mean, 1, axis=1), 4, rng=rng)], offset_DN=DARK_DN)
    assert (moved.same, moved.change, moved.frame) == (False, SceneChange.STRUCTURE, 4)
    covered = mean.copy()
    covered[30:60] = 1.0
    shut = same_scene([still, flats(covered, 4, rng=rng)], offset_DN=DARK_DN)
    assert (shut.same, shut.frame) == (False, 4)
    closed = same_scene([still, flats(0.0 * mean + 1.0, 2, rng=rng)], offset_DN=DARK_DN)
    assert (closed.same, closed.change) == (False, SceneChange.LEVEL)


@pytest.mark.parametrize("share", [0.08, 0.16, 0.3])
def test_light_that_strays_into_a_shadow_without_noise_is_one_scene(share):
    """Behind lead only the tail of the spread brings light: 0.7 % of the field's, the mean of so many pixels that it has no noise."""
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:80, :96]
    behind = np.hypot(y - 40, x - 48) < np.sqrt(share * y.size / np.pi)
    direct = gaussian_filter(np.where(behind, 0.0, 12000.0), 0.5)
    frames = []
    for _ in range(8):
        noise = gaussian_filter(np.sqrt(GAIN_DN * direct) * rng.standard_normal(direct.shape), 0.5)
        frames.append(np.rint(DARK_DN + direct + 80.0 + noise + 2.0 * rng.standard_normal(direct.shape)))
    found = same_scene([np.array(frames).astype(np.uint16)], offset_DN=DARK_DN)
    assert found.same is True, found
    frames[4:] = [np.roll(frame, 1, axis=1) for frame in frames[4:]]
    assert same_scene([np.array(frames).astype(np.uint16)], offset_DN=DARK_DN).same is False


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_counter_that_counts_nothing_in_a_shadow_shows_one_scene(seed):
    """Half of the field is silent: what noise there is beside it is no change of lines or edges."""
    rng = np.random.default_rng(seed)
    opaque = np.add.outer(0.06 * np.arange(88), np.arange(104)) > 50.0
    counts = rng.poisson(np.where(opaque, 0.0, 9000.0), (12, 88, 104)).astype(np.uint16)
    assert same_scene([counts]).same
    moved = counts.copy()
    moved[6:] = np.roll(moved[6:], 2, axis=2)
    assert same_scene([moved]).change == SceneChange.STRUCTURE


@pytest.mark.parametrize("signal", [1.0, 4.0, 16.0])
def test_dim_frames_whose_structure_is_noise_alone_are_one_scene(signal):
    """A frame that is judged by its own noise seems to fall back to the mean in the next one."""
    counts = np.random.default_rng(7).poisson(signal, (20, 128, 128))
    assert same_scene([counts.astype(np.uint16)]).same is True


def test_a_dim_flat_over_a_dark_whose_pattern_is_deeper_than_its_signal_is_one_scene():
    """A common factor of the frames would multiply the pattern of the dark as well."""
    rng = np.random.default_rng(3)
    across = 200.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, 128))
    frames = DARK_DN + across + 8.0 + 10.0 * rng.standard_normal((20, 96, 128))
    assert same_scene([np.rint(frames).astype(np.uint16)], offset_DN=DARK_DN).same is True


def test_a_speck_of_dust_is_named_but_is_no_other_scene():
    rng = np.random.default_rng(4)
    mean = np.full((128, 160), 9000.0)
    dusty = mean.copy()
    dusty[50:56, 70:76] *= 0.9
    found = same_scene([flats(mean, 4, rng=rng), flats(dusty, 4, rng=rng)], offset_DN=DARK_DN)
    assert found.same is True
    assert found.changed[53 // found.block_px, 74 // found.block_px]
    assert found.changed_share < 0.05


def test_a_single_frame_cannot_tell():
    assert same_scene([product()[None]]).same is None
    assert same_scene([]).same is None
    assert same_scene([np.zeros((5, 8, 8))]).same is None


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_stated():
    rng = np.random.default_rng(5)
    alarms = sum(
        same_scene([flats(np.full((48, 48), 5000.0), 6, rng=rng, spread_px=width)], offset_DN=DARK_DN).same is False
        for width in (0.5, 1.0, 2.0)
        for _ in range(1000)
    )
    # three judgements of 1e-3 each at most; 3000 series, upper 0.1 % point of a Poisson of 9
    assert alarms <= 20


def test_growth_of_noise_is_one_for_white_noise_and_rises_with_its_spread():
    assert growth_of_noise(8, 0.0) == pytest.approx(1.0)
    rising = [growth_of_noise(8, width) for width in (0.5, 1.0, 2.0, 3.0)]
    assert rising == sorted(rising)
    assert rising[0] > 1.0


@pytest.mark.realdata
@pytest.mark.skipif(not WALNUT.is_dir(), reason="no real FleX-ray frames beside the project")
def test_a_turning_walnut_is_not_one_scene_and_its_two_flats_are():
    from raytwin.acquisition._image_files import read_image

    scans = np.array([read_image(path) for path in sorted(WALNUT.glob("scan_*.tif"))])
    found = same_scene([scans], offset_DN=343.0)
    assert (found.same, found.frame) == (False, 1)
    assert same_scene([scans[:2]], offset_DN=343.0).same is False
    pair = np.array([read_image(WALNUT / name) for name in ("io000000.tif", "io000001.tif")])
    assert same_scene([pair], offset_DN=343.0).same is True

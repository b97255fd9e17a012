"""Pixels whose level lasts: how many there are by chance, and how many of those that jump are found."""

import numpy as np
import pytest

from raytwin.diagnosis.probes.lasting import BY_CHANCE, LEAST_FRAMES, chance_in_flat, chances, lasting_pixels
from raytwin.generator.frames.defects import Jumping
from raytwin.generator.line.line_state import TelegraphPixels


def variances(frames):
    stack = frames.var(axis=0, ddof=1)
    return stack, 0.5 * np.mean(np.diff(frames, axis=0) ** 2, axis=0)


def found_in(frames):
    stack, pair = variances(frames)
    good = np.ones(stack.shape, dtype=bool)
    return lasting_pixels(stack, pair, len(frames), good, least_DN2=1e-4)


@pytest.mark.parametrize("count", [LEAST_FRAMES, 20, 50])
def test_of_quiet_pixels_next_to_none_lasts_by_chance(count):
    frames = 6.0 * np.random.default_rng(count).standard_normal((count, 1000, 1000))
    # the bound holds a normal tail's share for a ratio whose own tail is a little other
    assert np.count_nonzero(found_in(frames)) <= 10 * BY_CHANCE * 1e6


def test_noisy_pixels_without_memory_do_not_last():
    rng = np.random.default_rng(3)
    frames = rng.standard_normal((20, 100, 100))
    frames[:, :, :5] *= 5.0
    assert np.count_nonzero(found_in(frames)) <= 500 * 0.03


@pytest.mark.parametrize(
    ("height", "stay", "count"), [(4.0, 4.0, 20), (8.0, 12.0, 20), (6.0, 7.0, 50), (8.0, 30.0, 12)]
)
def test_of_pixels_that_jump_as_many_last_and_stand_out_as_expected(height, stay, count):
    """Each pixel's stays are drawn one by one, with geometric lengths."""
    rng = np.random.default_rng(8)
    pixels, share = 40_000, 0.05
    jumping = int(share * pixels)
    up = np.zeros((count, pixels))
    for pixel in range(jumping):
        number, level = 0, int(rng.integers(2))
        while number < count:
            length = int(rng.geometric(1.0 / stay))
            up[number : number + length, pixel] = level
            number, level = number + length, 1 - level
    up = up[:, rng.permutation(pixels)]
    frames = 5.0 * (rng.standard_normal(up.shape) + height * up)
    lasting = found_in(frames.reshape(count, 200, 200)).ravel()
    out = (np.abs(frames.mean(axis=0)) > 8.0 * 5.0 / np.sqrt(count)) & ~lasting
    known, each, anywhere = chances(
        TelegraphPixels(share=share, amplitude_reads=height, stay_exposures=stay), ((count, 1),)
    )
    for seen, chance in ((lasting, known), (out, each[0]), (out, anywhere)):
        spread = np.sqrt(chance * (1.0 - chance) * (1.0 / jumping + 1.0 / 4000) + 1e-6)
        assert abs(np.count_nonzero(seen) / jumping - chance) < 4.0 * spread + 0.02
    assert known > 0.1


def test_pixels_that_jump_by_different_heights_last_and_stand_out_of_darks_and_flats_as_frames_that_are_drawn():
    """Frames of two darks and a flat of the generator's own pixels: 6 % of 40 000, heights of 2 to 8 read noises."""
    law = TelegraphPixels(share=0.06, amplitude_reads=4.0, stay_exposures=6.0, seed=3, differ=4.0)
    rng, shape, read_DN, flat_DN = np.random.default_rng(11), (200, 200), 5.0, 9.0

    def drawn(count, noise_DN):
        jumping = Jumping(law, shape, rng)
        return np.stack([jumping.added_to(noise_DN * rng.standard_normal(shape), read_DN, rng) for _ in range(count)])

    darks, flat = [drawn(20, read_DN), drawn(30, read_DN)], drawn(30, flat_DN)
    lasting = found_in(darks[0]) | found_in(darks[1])
    limit_DN = 7.0 * flat_DN / np.sqrt(30)
    out = (flat.mean(axis=0) > limit_DN) & ~lasting
    described = (20, 1), (30, 1)
    known = chances(law, described)[0]
    in_flat = chance_in_flat(law, described, 30, 1, limit_DN / read_DN)
    jumping = law.share * lasting.size
    for seen, chance in ((lasting, known), (out, in_flat)):
        spread = np.sqrt(chance * (1.0 - chance) * (1.0 / jumping + 1.0 / 4000))
        assert abs(np.count_nonzero(seen) / jumping - chance) < 4.0 * spread
    assert known > 0.3 and in_flat > 0.005


@pytest.mark.parametrize("columns", [3, 18])
def test_a_fading_picture_is_no_set_of_pixels_that_jump(columns):
    rng = np.random.default_rng(5)
    frames = rng.standard_normal((20, 60, 60))
    frames[:, :, 9 : 9 + columns] += 10.0 * np.exp(-np.arange(20) / 5.0)[:, None, None]
    assert np.count_nonzero(found_in(frames)) <= 1

"""Bad pixels: of a panel whose codes lie far apart, and such as go bad between two flats."""

from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.calibration.frames.bad_pixels import find_bad_pixels
from raytwin.calibration.frames.code_steps import least_change
from raytwin.calibration.frames.dark_frames import DarkFrames
from raytwin.generator.line.twin import BAD_PIXEL_CODES

SHAPE = (48, 48)


def series(frames):
    return SimpleNamespace(
        session=0,
        exposure_ms=10.0,
        averaged=1,
        n_frames=len(frames),
        corrected=frozenset(),
        read_frames=lambda first, last: frames[first:last],
    )


def frames_in_steps(step_DN, rng, *, count=20):
    """Darks of levels that differ by some DN from pixel to pixel, read noise 8 DN, and one hot pixel."""
    level = 1220.0 + 10.0 * rng.standard_normal(SHAPE)
    level[20, 30] += 2000.0
    exact = level + 8.0 * rng.standard_normal((count, *SHAPE))
    return np.rint(step_DN * np.floor(exact / step_DN)).astype(np.uint16)


@pytest.mark.parametrize("step_DN", [1.0, 16.0, 60.12])
def test_pixels_between_two_codes_are_not_bad(step_DN):
    rng = np.random.default_rng(5)
    frames = frames_in_steps(step_DN, rng)
    item = series(frames)
    assert least_change(frames[:2]) == pytest.approx(step_DN, abs=1.0)
    mean = frames.mean(axis=0)
    sums = SimpleNamespace(mean_DN=mean, frames=len(frames), pairs=len(frames) - 1)
    darks = DarkFrames(
        {(0, 10.0): mean}, [(item, sums)], np.zeros(SHAPE), frames.var(axis=0, ddof=1), len(frames) - 1.0
    )
    lit = mean + 20000.0 * (1.0 + 0.01 * rng.standard_normal(SHAPE))
    found = find_bad_pixels(darks, [(item, SimpleNamespace(mean_DN=lit))])
    assert found[20, 30] == BAD_PIXEL_CODES["hot"] and np.count_nonzero(found) == 1


def test_pixels_that_die_between_flats_are_found_in_any_but_the_dimmest():
    rng = np.random.default_rng(8)
    frames = frames_in_steps(1.0, rng)
    mean = frames.mean(axis=0)
    dark = series(frames)
    sums = SimpleNamespace(mean_DN=mean, frames=len(frames), pairs=len(frames) - 1)
    darks = DarkFrames(
        {(0, 10.0): mean}, [(dark, sums)], np.zeros(SHAPE), frames.var(axis=0, ddof=1), len(frames) - 1.0
    )
    # each beam has a shape of its own; single flats are as noisy as 3 DN a quantum makes them
    gain, tilt = 1.0 + 0.01 * rng.standard_normal(SHAPE), np.linspace(0.97, 1.03, SHAPE[1])

    def flat(level_DN, shape=1.0):
        lit = level_DN * gain * shape
        return series(frames), lit + np.sqrt(3.0 * level_DN) * rng.standard_normal(SHAPE)

    # and something stood in a part of one of them
    covered = np.ones(SHAPE)
    covered[:, 30:42] = 0.6
    bright, other, dim, dimmest = flat(20000.0), flat(4000.0, tilt * covered), flat(1000.0), flat(20.0)
    other[1][5, 7] = 30.0
    dim[1][9, 40] *= 0.3
    dimmest[1][30, 30] = 0.0
    flats = [(item, SimpleNamespace(mean_DN=mean + lit)) for item, lit in (bright, other, dim, dimmest)]
    found = find_bad_pixels(darks, flats)
    wrong = {tuple(int(at) for at in place): int(found[tuple(place)]) for place in np.argwhere(found)}
    dead = BAD_PIXEL_CODES["dead"]
    assert wrong == {(20, 30): BAD_PIXEL_CODES["hot"], (5, 7): dead, (9, 40): dead}


def test_frames_that_tell_no_distance_of_codes_have_one_of_1_DN():
    rng = np.random.default_rng(6)
    still = np.full((2, 16, 16), 1200, np.uint16)
    averaged = 1200.0 + rng.standard_normal((2, 16, 16))
    wide = (20000.0 + 3000.0 * rng.standard_normal((2, 64, 64))).astype(np.uint16)
    lost = averaged.copy()
    lost[0, :, 3:] = np.nan
    for frames in (still, still[:1], averaged, wide, lost):
        assert least_change(frames) == 1.0
    # a mended pixel among many is no code
    mended = (60 * rng.integers(0, 3, (2, 64, 64))).astype(np.uint16)
    mended[:, 5, 5] = 17, 40
    assert least_change(mended) == 60.0

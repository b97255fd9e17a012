"""Registration: images are moved without loss, and the shift between two tube voltages is found."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from raytwin.errors import FitError, InputError
from raytwin.generator.spread.registration import estimate_shift_px, shift_image


def structure(seed=0, shape=(80, 96)):
    """A band-limited log image with an object in the middle."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    body = np.exp(-(((y - 40) / 20) ** 2) - ((x - 48) / 25) ** 2)
    return body * (1 + gaussian_filter(rng.standard_normal(shape), 3))


def test_whole_pixels_move_exactly():
    image = structure()
    moved = shift_image(image, (3.0, -2.0))
    np.testing.assert_array_equal(moved[10:-10, 10:-10], image[7:-13, 12:-8])


def test_moving_there_and_back_changes_nothing_inside():
    image = structure()
    back = shift_image(shift_image(image, (0.37, -1.61)), (-0.37, 1.61))
    np.testing.assert_allclose(back[8:-8, 8:-8], image[8:-8, 8:-8], atol=1e-3 * image.max())


def test_half_a_pixel_leaves_the_variance_and_the_correlation_of_noise():
    noise = np.random.default_rng(1).standard_normal((256, 256))
    moved = shift_image(noise, (0.5, 0.5))[8:-8, 8:-8]
    # linear interpolation would leave a quarter; the highest frequencies alone lose something here
    assert moved.var() == pytest.approx(noise.var(), rel=5 * np.sqrt(2 / noise.size) + 0.01)
    assert abs(np.mean(moved[1:] * moved[:-1])) < 5 / np.sqrt(moved.size) + 0.01


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.7), (-2.3, 1.25), (9.6, -7.2)])
def test_the_shift_between_tube_voltages_is_found_to_a_twentieth_of_a_pixel(shift):
    rng = np.random.default_rng(2)
    low = structure() + 0.01 * rng.standard_normal((80, 96))
    high = shift_image(0.6 * structure() - 0.03 * structure() ** 2, shift) + 0.01 * rng.standard_normal((80, 96))
    np.testing.assert_allclose(estimate_shift_px(low, high), shift, atol=0.05)


def test_images_without_structure_have_no_shift():
    with pytest.raises(FitError, match="state it in pixels"):
        estimate_shift_px(np.zeros((30, 30)), np.zeros((30, 30)))


@pytest.mark.parametrize("shift", [(np.nan, 0.0), (0.0, 25.0)])
def test_shifts_beyond_reason_are_refused(shift):
    with pytest.raises(InputError, match="at most 20 px"):
        shift_image(np.zeros((30, 30)), shift)

"""Delta R: closed forms on drawn images, the ring by an independent construction, errors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition import delta_r, dilations_for_pixel
from raytwin.errors import InputError


def drawn(shape=(90, 110), quotient=1.8, shift=0.2):
    """A fillet of varying thickness with a constant quotient, and a bone whose quotient is `shift` higher."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    high = 0.5 * np.exp(-((row - 45) ** 2) / 2000 - ((column - 55) ** 2) / 3000)
    mask = (np.abs(row - 45) < 3) & (np.abs(column - 60) < 8)
    low = high * (quotient + shift * mask)
    return low, high, mask


def test_a_constant_quotient_with_a_shifted_object_gives_the_shift():
    low, high, mask = drawn()
    assert delta_r(low, high, mask) == pytest.approx(0.2, abs=1e-12)


@given(st.floats(1.0, 3.0), st.floats(-0.4, 0.4))
def test_the_contrast_is_the_shift_whatever_the_quotient_around(quotient, shift):
    assert delta_r(*drawn(quotient=quotient, shift=shift)) == pytest.approx(shift, abs=1e-9)


@given(st.floats(0.5, 5.0))
def test_the_contrast_scales_with_the_low_image_and_against_the_high_one(scale):
    low, high, mask = drawn()
    low, high = low + 0.2, high + 0.05  # all of it product, at any of these scales
    assert delta_r(low * scale, high, mask) == pytest.approx(scale * delta_r(low, high, mask), rel=1e-9)
    assert delta_r(low, high * scale, mask) == pytest.approx(delta_r(low, high, mask) / scale, rel=1e-9)


def test_the_ring_is_the_diamond_of_21_pixels_within_the_product_without_the_object():
    rng = np.random.default_rng(3)
    high = rng.uniform(0.05, 0.5, (80, 90))
    low = high * rng.uniform(1.0, 2.0, high.shape)
    mask = np.zeros(high.shape, bool)
    mask[38:42, 44:50] = True
    # The cross of four neighbours, 21 times, is the set within city-block distance 21 of the object.
    row, column = np.mgrid[:80, :90]
    objects = np.argwhere(mask)
    distance = np.min([np.abs(row - r) + np.abs(column - c) for r, c in objects], axis=0)
    ring = (distance <= 21) & ~mask & (low > 0.1)
    q = low / high
    assert delta_r(low, high, mask) == pytest.approx(q[mask].mean() - q[ring].mean(), abs=1e-12)


def test_pixels_outside_the_product_are_no_part_of_the_ring():
    low, high, mask = drawn()
    low[:40] = 0.09  # air reaches into the ring
    outside = low <= 0.1
    spoiled = low.copy()
    spoiled[outside] = -5.0
    assert delta_r(spoiled, high, mask) == delta_r(low, high, mask)


def test_pixels_without_a_quotient_are_left_out():
    low, high, mask = drawn()
    high[40, 50] = 0.0
    high[45, 60] = -0.1
    assert delta_r(low, high, mask) == pytest.approx(0.2, abs=1e-12)


def test_a_ring_of_other_pixels_is_as_wide_in_mm():
    assert dilations_for_pixel(0.15) == 21
    assert dilations_for_pixel(0.45) == 7
    assert dilations_for_pixel(10.0) == 1
    with pytest.raises(InputError, match="pixel_mm: got 0"):
        dilations_for_pixel(0)


def test_what_has_no_contrast_says_why():
    low, high, mask = drawn()
    with pytest.raises(InputError, match="foreign-object mask: got an empty mask"):
        delta_r(low, high, np.zeros_like(mask))
    with pytest.raises(InputError, match=r"images and mask: got shapes \(90, 110\), \(90, 110\) and \(2, 2\)"):
        delta_r(low, high, mask[:2, :2])
    with pytest.raises(InputError, match="contrast, ring of 21 pixels around it: got no pixel inside the product"):
        delta_r(low * 0 + 0.05, high, mask)
    with pytest.raises(InputError, match="contrast, foreign object: got no pixel"):
        delta_r(low, np.where(mask, 0, high), mask)
    with pytest.raises(InputError, match="dilations: got 0"):
        delta_r(low, high, mask, dilations=0)

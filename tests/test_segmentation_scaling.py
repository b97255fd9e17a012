"""Laws of what a network sees: scaling, padding, augmentation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytwin.errors import InputError
from raytwin.segmentation import (
    RECIPES,
    crop_to_shape,
    examples_from_arrays,
    measure_direction,
    noise_channels,
    pad_to_multiple,
    scale_matched,
    scale_min_max,
    scale_residual,
    scaling_named,
)
from raytwin.segmentation.augmentation import augment_as_published, augment_exact, crop_around_object


def _fillet(shape=(64, 80), *, exposure_ms=1000.0, bone=0.0, seed=0):
    """A dome whose M_low is a curve of M_high, a square of bone, and noise that falls with exposure."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    distance = np.hypot((rows - shape[0] / 2) / (0.45 * shape[0]), (columns - shape[1] / 2) / (0.45 * shape[1]))
    thickness = np.sqrt(np.clip(1.0 - distance**2, 0.0, None))
    high, low = 0.5 * thickness, 1.02 * thickness - 0.02 * thickness**2
    mask = np.zeros(shape, dtype=np.uint8)
    mask[30:36, 38:44] = 1
    generator = np.random.default_rng(seed)
    sd = 0.4 / np.sqrt(exposure_ms)
    low = low + 3.2 * bone * mask + sd * generator.standard_normal(shape)
    high = high + bone * mask + 0.3 * sd * generator.standard_normal(shape)
    return np.stack([low, high]), mask


def test_min_max_scaling_spans_0_to_1_in_each_channel_by_itself():
    image, _ = _fillet()
    scaled = scale_min_max(image)
    np.testing.assert_allclose(scaled.min(axis=(1, 2)), 0.0, atol=1e-7)
    np.testing.assert_allclose(scaled.max(axis=(1, 2)), 1.0, atol=1e-7)
    assert scaled.dtype == np.float32


def test_min_max_scaling_of_a_constant_channel_is_zero():
    assert not scale_min_max(np.full((2, 8, 8), 3.0)).any()


def test_residual_scaling_takes_the_product_away_and_leaves_noise_of_known_size():
    image, _ = _fillet()
    inside = image[1] > 0.2
    residual = scale_residual(image)[0][inside] * 2.5
    # about 1900 pixels: the standard deviation of a normal sample is known to 1.6 %, the robust one to about 2.7 %
    assert residual.std() == pytest.approx(1.0, abs=0.12)
    assert abs(residual.mean()) < 5 / np.sqrt(residual.size) + 0.05
    # nothing of the product's shape is left
    assert abs(np.corrcoef(residual, image[1][inside])[0, 1]) < 4 / np.sqrt(residual.size)


def test_residual_scaling_shows_a_bone_in_units_of_the_noise_at_every_exposure():
    for exposure_ms in (20.0, 100.0, 1000.0):
        bone = 1.0 / np.sqrt(exposure_ms)
        image, mask = _fillet(exposure_ms=exposure_ms, bone=bone)
        plain, _ = _fillet(exposure_ms=exposure_ms)
        raised = (scale_residual(image)[0] - scale_residual(plain)[0])[mask > 0].mean() * 2.5
        # M_low gains 3.2 b and the curve of M_high 2.0 b; noise of the difference is sd sqrt(1 + (2 x 0.3)^2)
        expected = (3.2 - 2.0) * bone / (0.4 / np.sqrt(exposure_ms) * np.hypot(1.0, 0.6))
        # noise in M_high flattens the fitted curve, by a tenth and more at 20 ms
        assert raised == pytest.approx(expected, rel=0.2)


def test_residual_scaling_keeps_a_bone_of_a_twentieth_of_the_product_in_its_thickest_place():
    image, _ = _fillet()
    mask = np.zeros(image.shape[1:])
    mask[26:38, 34:47] = 1.0
    assert 0.04 < mask.sum() / (image[1] > 0.1).sum() < 0.06
    image += 0.1 * np.array([3.2, 1.0])[:, None, None] * mask
    shown = scale_residual(image)[0][mask > 0].mean() * 2.5
    # 0.1 (3.2 - 2.0) over the noise of the difference, as above
    assert shown > 0.9 * 0.12 / (0.4 / np.sqrt(1000.0) * np.hypot(1.0, 0.6))


def test_residual_scaling_does_not_care_about_the_unit_of_attenuation():
    image, _ = _fillet(bone=0.05)
    np.testing.assert_allclose(scale_residual(image * 3.0), scale_residual(image), atol=2e-3)


def test_residual_scaling_of_an_empty_field_is_finite_and_bounded():
    for image in (np.zeros((2, 16, 16)), np.full((2, 16, 16), -0.01), np.zeros((2, 1, 1))):
        scaled = scale_residual(image)
        assert np.isfinite(scaled).all()
        assert np.abs(scaled[0]).max() <= 10.0 / 2.5


def _casting(*, void=0.0, bone=0.0, seed=0):
    """A wedge of M_high 0.4 to 0.5 with M_low = 2 M_high, and a square of 4 x 4 pixels; noise 0.02 and 0.006.

    Both images lose as less product would in a void: 2 and 1 times `void`. They gain 3.2 and 1 times `bone`.
    """
    high, mask = np.zeros((64, 80)), np.zeros((64, 80), dtype=np.uint8)
    high[8:56, 8:72] = np.linspace(0.4, 0.5, 64)
    mask[30:34, 38:42] = 1
    pair = np.stack([2.0 * high, high]) + (
        np.multiply.outer((3.2, 1.0), bone * mask) - np.multiply.outer((2.0, 1.0), void * mask)
    )
    noise = np.random.default_rng(seed).standard_normal((2, 64, 80))
    return pair + np.array([0.02, 0.006])[:, None, None] * noise, mask


# a pixel of noise in direction p is worth hypot(p_low / 0.02, p_high / 0.006) standard deviations of both images together, of which
# the residual shows (p_low - 2 p_high) / hypot(0.02, 0.012) and the detail the rest
_VOID = np.hypot(2.0 / 0.02, 1.0 / 0.006)
_BONE = np.array([1.2 / np.hypot(0.02, 0.012), (3.2 * 2.0 / 0.02**2 + 1 / 0.006**2) / _VOID])


def test_a_void_that_the_residual_does_not_show_stands_out_of_the_detail_as_an_ideal_observer_sees_it():
    plain, _ = _casting()
    image, mask = _casting(void=0.02)
    before, after = noise_channels(plain, with_detail=True), noise_channels(image, with_detail=True)
    assert abs((after.residual - before.residual)[mask > 0].mean()) < 0.3
    assert (before.detail - after.detail)[mask > 0].mean() == pytest.approx(0.02 * _VOID, rel=0.15)
    shown = scale_matched(image, direction_deg=-90)[0][mask > 0].mean() * 2.5
    assert shown == pytest.approx(0.02 * _VOID, rel=0.15)


def test_detail_and_residual_have_unit_noise_that_they_do_not_share_and_so_has_every_direction():
    image, _ = _casting()
    inside = np.s_[12:52, 12:68]
    channels = noise_channels(image, with_detail=True)
    # 2240 pixels: robust standard deviations are known to 2.5 %, and the background takes some noise with it
    np.testing.assert_allclose(
        np.cov(channels.residual[inside].ravel(), channels.detail[inside].ravel()), np.eye(2), atol=0.12
    )
    for direction in (-83.0, 30.0):
        assert scale_matched(image, direction_deg=direction)[0][inside].std() * 2.5 == pytest.approx(1.0, abs=0.06)
    np.testing.assert_array_equal(scale_matched(image, direction_deg=0.0), scale_residual(image))


def test_the_direction_is_that_of_the_objects_of_the_training_images():
    assert measure_direction([_casting(void=0.02, seed=seed) for seed in range(4)]) == pytest.approx(-90, abs=6)
    expected = np.degrees(np.arctan2(_BONE[1], _BONE[0]))
    assert measure_direction([_casting(bone=0.02, seed=seed) for seed in range(4)]) == pytest.approx(expected, abs=6)
    image, mask = _casting()
    assert measure_direction([(image, 0 * mask)]) == 0.0


def test_a_direction_that_was_not_measured_is_asked_for():
    image, _ = _fillet()
    np.testing.assert_array_equal(scaling_named("matched:-83")(image), scale_matched(image, direction_deg=-83.0))
    for word in ("matched", "matched:", "matched:up", "minmax", "residual:3"):
        with pytest.raises(InputError, match=r"scaling: got .*matched:DEGREES"):
            scaling_named(word)
    examples = examples_from_arrays(image[None], np.zeros((1, 64, 80)), recipe=RECIPES["raytwin"])
    with pytest.raises(InputError, match="`raytwin train` measures the direction"):
        examples[0]


@pytest.mark.parametrize("scale", [scale_min_max, scale_residual])
def test_scaling_refuses_what_is_no_finite_pair(scale):
    with pytest.raises(InputError, match=r"image: got a value that is not finite; expected finite values of -log"):
        scale(np.full((2, 8, 8), np.nan))
    with pytest.raises(InputError, match=r"image: got shape \(3, 8, 8\); expected \(2, row, column\), low kV first"):
        scale(np.zeros((3, 8, 8)))


@given(rows=st.integers(1, 70), columns=st.integers(1, 70), multiple=st.sampled_from([1, 8, 16, 32]))
@settings(max_examples=60, deadline=None)
def test_cropping_undoes_padding_for_every_shape(rows, columns, multiple):
    image = np.arange(2 * rows * columns, dtype=np.float32).reshape(2, rows, columns)
    padded = pad_to_multiple(image, multiple=multiple)
    assert padded.shape[-2] % multiple == 0
    assert padded.shape[-1] % multiple == 0
    assert padded.shape[-2] - rows < multiple
    np.testing.assert_array_equal(crop_to_shape(padded, shape=(rows, columns)), image)


def test_the_published_detector_needs_padding_to_768_by_960():
    assert pad_to_multiple(np.zeros((760, 956)), multiple=16).shape == (768, 960)


def test_cropping_to_more_than_there_is_is_refused():
    with pytest.raises(InputError, match="shape: got 9 of 8 pixels; expected at most the image's own"):
        crop_to_shape(np.zeros((8, 8)), shape=(9, 8))


def test_exact_augmentation_moves_image_and_masks_alike_and_only_copies_values():
    generator = np.random.default_rng(1)
    values = generator.random((40, 50)).astype(np.float32)
    image = np.stack([values, 2 * values])
    masks = (values[None] > 0.9).astype(np.uint8)
    changed_at_all = 0
    for _ in range(20):
        moved, moved_masks = augment_exact(image, masks, generator=generator)
        assert np.isin(moved[0], values).all()
        np.testing.assert_array_equal(moved_masks[0], moved[0] > 0.9)
        np.testing.assert_array_equal(moved[1], 2 * moved[0])
        changed_at_all += not np.array_equal(moved, image)
    assert changed_at_all > 15


def test_exact_augmentation_keeps_the_noise_that_interpolation_takes_away():
    generator = np.random.default_rng(2)
    noise = generator.standard_normal((2, 128, 128)).astype(np.float32)
    masks = np.zeros((1, 128, 128), dtype=np.uint8)
    exact = np.mean([augment_exact(noise, masks, generator=generator)[0][:, 32:96, 32:96].var() for _ in range(10)])
    rotated = [augment_as_published(noise, masks, generator=generator)[0][:, 32:96, 32:96].var() for _ in range(10)]
    # 10 x 8192 pixels that overlap: a tenth of them independent is 1.6 % of the variance
    assert exact == pytest.approx(1.0, abs=0.06)
    # bilinear interpolation at random sub-pixel places keeps (2/3)^2 of the variance of white noise
    assert np.mean(rotated) == pytest.approx(4 / 9, abs=0.06)


def test_published_augmentation_keeps_masks_of_0_and_1_on_the_object():
    generator = np.random.default_rng(3)
    image = np.zeros((2, 64, 64), dtype=np.float32)
    image[:, 20:40, 24:36] = 1.0
    masks = (image[:1] > 0).astype(np.uint8)
    for _ in range(5):
        moved, moved_masks = augment_as_published(image, masks, generator=generator)
        assert set(np.unique(moved_masks)) <= {0, 1}
        # bilinear against nearest: they differ by less than half a pixel along the outline
        assert np.abs((moved[0] > 0.5).astype(int) - moved_masks[0]).sum() < 0.5 * 2 * (20 + 12) * 1.2


@given(place=st.tuples(st.integers(0, 49), st.integers(0, 69)), seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_a_crop_holds_the_object_wherever_it_is(place, seed):
    masks = np.zeros((1, 50, 70), dtype=np.uint8)
    masks[0][place] = 1
    image = np.zeros((2, 50, 70), dtype=np.float32)
    cut, cut_masks = crop_around_object(image, masks, size_px=32, generator=np.random.default_rng(seed))
    assert cut.shape == (2, 32, 32)
    assert cut_masks.sum() == 1


def test_a_crop_larger_than_the_image_is_the_image():
    masks = np.zeros((1, 20, 40), dtype=np.uint8)
    image = np.ones((2, 20, 40), dtype=np.float32)
    cut, _ = crop_around_object(image, masks, size_px=32, generator=np.random.default_rng(0))
    assert cut.shape == (2, 20, 32)

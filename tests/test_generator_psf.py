"""Optical spread: autocovariances against quadrature and Monte Carlo, kernels against their laws."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import j0
from scipy.stats import norm

from raytwin.errors import InputError
from raytwin.generator.spread.psf import (
    PSF_MODELS,
    Spread,
    blur_variance_share,
    convolve_separable,
    noise_autocovariance,
    noise_autocovariance_1d,
    noise_kernel_1d,
    optical_kernel_1d,
    sampled_gaussian_1d,
)

widths = st.floats(0.05, 3.0)
models = st.sampled_from(PSF_MODELS)


@pytest.mark.parametrize("sigma", [0.1, 0.35, 0.6, 1.0, 2.5])
@pytest.mark.parametrize("lag", [0, 1, 2, 4])
def test_aperture_autocovariance_is_the_overlap_of_two_blurred_pixels(sigma, lag):
    def collected(x):
        return norm.cdf((x + 0.5) / sigma) - norm.cdf((x - 0.5) / sigma)

    reach = lag + 6 * sigma + 1
    kinks = sorted({-0.5, 0.5, lag - 0.5, lag + 0.5})
    expected = quad(lambda x: collected(x) * collected(x - lag), -reach, reach, points=kinks, limit=400)[0]
    assert noise_autocovariance_1d("aperture", sigma, lag)[lag] == pytest.approx(expected, abs=1e-9)


def test_aperture_autocovariance_agrees_with_quanta_that_land_anywhere():
    """Monte Carlo: photons at continuous positions, each spreading its light as a Gaussian over square pixels."""
    rng = np.random.default_rng(3)
    sigma, pixels, photons = 0.6, 4000, 400_000
    position = rng.uniform(0, pixels, photons)
    left = np.floor(position).astype(int)
    light = np.zeros(pixels + 12)
    for step in range(-5, 6):
        edge = left + step
        share = norm.cdf((edge + 1 - position) / sigma) - norm.cdf((edge - position) / sigma)
        np.add.at(light, edge + 6, share)
    inner = light[12:-12] - photons / pixels
    for lag, expected in enumerate(noise_autocovariance_1d("aperture", sigma, 2)):
        measured = np.mean(inner[: len(inner) - lag] * inner[lag:]) / (photons / pixels)
        assert measured == pytest.approx(expected, abs=4 * math.sqrt(2 * 1.5 / len(inner)))


@given(widths)
def test_sampled_autocovariance_is_the_discrete_kernel_with_itself(sigma):
    kernel = sampled_gaussian_1d(sigma, 30)
    expected = np.correlate(kernel, kernel, mode="full")[len(kernel) - 1 : len(kernel) + 4]
    assert noise_autocovariance_1d("sampled", sigma, 4) == pytest.approx(expected, abs=1e-12)


@given(models, widths)
def test_autocovariances_sum_to_one_and_fall_with_lag(model, sigma):
    reach = math.ceil(10 * sigma) + 3
    full = noise_autocovariance(model, sigma, reach)
    assert full.sum() == pytest.approx(1.0, abs=1e-9)
    half = noise_autocovariance_1d(model, sigma, reach)
    assert np.all(half >= -1e-12)
    assert np.all(np.diff(half) <= 1e-12)
    assert full == pytest.approx(full.T)
    assert full == pytest.approx(full[::-1, ::-1])


@given(models, widths)
def test_noise_kernel_gives_white_noise_the_autocovariance(model, sigma):
    kernel = noise_kernel_1d(model, sigma)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-9)
    own = np.correlate(kernel, kernel, mode="full")[len(kernel) - 1 : len(kernel) + 5]
    assert own[:6] == pytest.approx(noise_autocovariance_1d(model, sigma, 5), abs=2e-4)


@pytest.mark.parametrize(("sigma", "share"), [(0.8, 0.125), (0.5, 0.41)])
def test_sampled_share_is_the_sum_of_squares_of_the_discrete_kernel(sigma, share):
    """The two figures of a sampled Gaussian; the continuous 1 / (4 pi sigma^2) is 29 % off at 0.5 px, 22 % here."""
    assert blur_variance_share("sampled", sigma) == pytest.approx(share, rel=0.02)
    kernel = np.outer(sampled_gaussian_1d(sigma, 12), sampled_gaussian_1d(sigma, 12))
    assert blur_variance_share("sampled", sigma) == pytest.approx(np.sum(kernel**2), rel=1e-9)


def test_both_descriptions_meet_when_the_spread_is_wide():
    for sigma in (2.0, 3.0):
        continuous = 1.0 / (4.0 * math.pi * sigma**2)
        assert blur_variance_share("sampled", sigma) == pytest.approx(continuous, rel=0.02)
        # the pixel's aperture adds 1/12 to the variance of the spread
        assert blur_variance_share("aperture", sigma) == pytest.approx(
            1.0 / (4.0 * math.pi * (sigma**2 + 1.0 / 12.0)), rel=0.002
        )


@pytest.mark.parametrize("absorption", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("frequency", [0.02, 0.1, 0.4])
def test_a_layers_tail_is_diffusion_with_absorption_at_a_distance(absorption, frequency):
    """Of a point at a distance L: - d/dL of exp(-k s) / (2 pi s), s = sqrt(r^2 + L^2), with all its light in a sum of 1."""
    reach = 1.5

    def light(r):
        s = math.hypot(r, reach)
        return reach * (1.0 + absorption * s) * math.exp(absorption * (reach - s)) / (2.0 * math.pi * s**3)

    expected, _ = quad(
        lambda r: 2.0 * math.pi * r * light(r) * j0(2.0 * math.pi * frequency * r), 0.0, 400.0, limit=2000
    )
    spread = Spread(tail_share=1.0, tail_px=reach, tail_order=0.0, absorption_per_px=absorption)
    # a clear layer has a share L / R of its light beyond R
    assert float(spread.transfer(np.array(frequency), np.array(0.0))) == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize("model", PSF_MODELS)
@pytest.mark.parametrize("axes", ["row", "column"])
def test_light_of_a_line_camera_spreads_along_its_lines_alone(model, axes):
    sigma = 0.6
    spread = Spread(model=model, sigma_px=sigma, axes=axes)
    half = noise_autocovariance_1d(model, sigma, 3)
    expected = np.zeros((7, 7))
    expected[3] = np.concatenate([half[:0:-1], half])
    expected = expected if axes == "column" else expected.T
    np.testing.assert_allclose(spread.noise_autocovariance(3), expected, atol=1e-6)
    assert spread.variance_share == pytest.approx(half[0], rel=1e-6)
    across = np.linspace(0.0, 0.5, 5)
    along = spread.transfer(*((across, np.zeros(5)) if axes == "row" else (np.zeros(5), across)))
    same = spread.transfer(*((np.zeros(5), across) if axes == "row" else (across, np.zeros(5))))
    assert np.all(np.diff(along) < 0)
    assert same == pytest.approx(np.ones(5))


def test_the_noise_of_a_line_with_a_tail_is_that_of_quanta_that_land_anywhere():
    """Monte Carlo: each photon spreads a part of its light as exp(-|x| / L) along a line of pixels."""
    rng = np.random.default_rng(4)
    share, reach, pixels, photons = 0.4, 0.9, 4000, 400_000
    position = rng.uniform(0, pixels, photons)
    left = np.floor(position).astype(int)

    def tail_below(x):
        return np.where(x < 0, 0.5 * np.exp(np.minimum(x, 0) / reach), 1.0 - 0.5 * np.exp(-np.maximum(x, 0) / reach))

    def below(x):
        return (1.0 - share) * norm.cdf(x / 0.3) + share * tail_below(x)

    light = np.zeros(pixels + 20)
    for step in range(-9, 10):
        edge = left + step
        np.add.at(light, edge + 10, below(edge + 1 - position) - below(edge - position))
    inner = light[20:-20] - photons / pixels
    # 1 / (1 + (2 pi L f)^2) is the transform of exp(-|x| / L) / (2 L)
    found = Spread(sigma_px=0.3, tail_share=share, tail_px=reach, axes="column").noise_autocovariance(3)[3, 3:]
    for lag, expected in enumerate(found):
        measured = np.mean(inner[: len(inner) - lag] * inner[lag:]) / (photons / pixels)
        assert measured == pytest.approx(expected, abs=4 * math.sqrt(2 * 1.5 / len(inner)))


@pytest.mark.parametrize("model", PSF_MODELS)
def test_no_spread_leaves_white_noise_and_sharp_signal(model):
    assert noise_autocovariance_1d(model, 0.0, 3).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert blur_variance_share(model, 0.0) == 1.0
    assert optical_kernel_1d(model, 0.0).max() == 1.0
    image = np.random.default_rng(0).random((9, 7)).astype(np.float32)
    assert convolve_separable(image, noise_kernel_1d(model, 0.0)) == pytest.approx(image, abs=1e-6)


@given(models, widths)
def test_optical_kernel_keeps_the_signal_and_has_the_stated_width(model, sigma):
    kernel = optical_kernel_1d(model, sigma)
    position = np.arange(len(kernel)) - len(kernel) // 2
    assert kernel.sum() == pytest.approx(1.0)
    assert kernel == pytest.approx(kernel[::-1])
    if sigma > 0.6:  # Sheppard's correction: averaging over pixels adds 1/12
        extra = 1.0 / 12.0 if model == "aperture" else 0.0
        assert np.sum(kernel * position**2) == pytest.approx(sigma**2 + extra, rel=0.02)


def test_convolution_of_a_point_is_the_outer_product_of_the_kernel():
    kernel = sampled_gaussian_1d(0.9, 5)
    image = np.zeros((15, 17))
    image[7, 8] = 1.0
    blurred = convolve_separable(image, kernel)
    assert blurred[2:13, 3:14] == pytest.approx(np.outer(kernel, kernel), abs=1e-7)


@pytest.mark.parametrize(("model", "sigma"), [("box", 0.5), ("aperture", -0.1), ("sampled", math.nan)])
def test_unknown_models_and_impossible_widths_are_refused(model, sigma):
    with pytest.raises(InputError, match=r"psf model: got box|psf_sigma_px: got"):
        noise_autocovariance(model, sigma, 3)

"""Noise of a frame: variance, skew and covariance against the closed forms; no border seams; the ADC."""

import math

import numpy as np
import pytest
from scipy.stats import skew

from raytwin.errors import InputError
from raytwin.generator.spread.noise import digitise, sample_correlated_quanta, sample_frame_noise
from raytwin.generator.spread.psf import Spread, noise_autocovariance

SIGMA = 0.6
WHITE = 0.01


def noise_frames(count, *, signal=400.0, shape=(48, 48), seed=0, **changes):
    rng = np.random.default_rng(seed)
    options = {
        "gain_DN": 7.0,
        "white_fraction": WHITE,
        "read_variance_DN2": 150.0,
        "spread": Spread(sigma_px=SIGMA),
        **changes,
    }
    level = np.full(shape, signal)
    return np.stack([sample_frame_noise(level, rng=rng, **options) for _ in range(count)]).astype(np.float64)


def expected_covariance(lag, *, signal=400.0, gain=7.0, read=150.0):
    rho = noise_autocovariance("aperture", SIGMA, 3)[3 + lag[0], 3 + lag[1]]
    quantum = gain * signal / (1 + WHITE)
    delta = 1.0 if lag == (0, 0) else 0.0
    return quantum * rho + delta * (quantum * WHITE + read)


@pytest.mark.parametrize("lag", [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2)])
def test_noise_has_the_covariance_of_quanta_spread_and_electronics(lag):
    frames = noise_frames(60)
    dy, dx = lag
    products = frames[:, : 48 - dy, : 48 - dx] * frames[:, dy:, dx:]
    variance = expected_covariance((0, 0))
    # neighbours are correlated: 3 is more than the sum of squared correlations
    allowed = 4.5 * variance * math.sqrt(2 * 3.0 / frames.size)
    assert products.mean() == pytest.approx(expected_covariance(lag), abs=allowed)


def test_skewness_is_that_of_quanta_through_the_spread():
    from raytwin.generator.spread.psf import noise_kernel_1d

    signal, gain = 100.0, 20.0
    counts = noise_frames(150, signal=signal, gain_DN=gain, read_variance_DN2=0.0, white_fraction=0.0)
    kernel = noise_kernel_1d("aperture", SIGMA)
    third = gain**2 * signal * np.sum(kernel**3) ** 2
    variance = gain * signal * np.sum(kernel**2) ** 2
    assert skew(counts.ravel()) == pytest.approx(third / variance**1.5, abs=5 * math.sqrt(6 * 3 / counts.size))


def test_borders_have_the_variance_and_mean_of_the_middle():
    frames = noise_frames(2500, shape=(12, 12), read_variance_DN2=10.0)
    border = np.ones((12, 12), dtype=bool)
    border[1:-1, 1:-1] = False
    expected = expected_covariance((0, 0), read=10.0)
    n = len(frames)
    for mask in (border, ~border):
        variance = frames[:, mask].var()
        assert variance == pytest.approx(expected, rel=4.5 * math.sqrt(2 * 3.0 / (n * mask.sum())))
        assert abs(frames[:, mask].mean()) < 5 * math.sqrt(7.0 * 400 / (n * mask.sum()))
    # correlation across a border pixel and its inner neighbour is the same too
    edge = np.mean(frames[:, 0, :] * frames[:, 1, :])
    assert edge == pytest.approx(expected_covariance((1, 0), read=10.0), abs=5 * expected * math.sqrt(3.0 / (n * 12)))


def test_shares_scale_variance_skew_and_electronics_separately():
    part = noise_frames(60, quantum_share=0.3, third_cumulant_share=0.2, read_share=0.5, seed=5)
    expected = 0.3 * expected_covariance((0, 0), read=0.0) + 75.0
    assert part.var() == pytest.approx(expected, rel=4.5 * math.sqrt(2 * 3.0 / part.size))


def test_a_pixel_of_higher_gain_has_more_signal_and_noise_in_proportion():
    """relative gain r multiplies DN: signal r s comes from quanta worth s, so its variance is r^2 times theirs."""
    frames = noise_frames(60, signal=400.0 * 1.2, gain_relative=1.2, read_variance_DN2=0.0)
    assert frames.var() == pytest.approx(
        1.44 * expected_covariance((0, 0), read=0.0), rel=4.5 * math.sqrt(2 * 3.0 / frames.size)
    )


def test_no_signal_leaves_electronic_noise_alone():
    frames = noise_frames(40, signal=0.0)
    assert frames.var() == pytest.approx(150.0, rel=5 * math.sqrt(2 / frames.size))
    negative = noise_frames(40, signal=-50.0)
    assert negative.var() == pytest.approx(150.0, rel=5 * math.sqrt(2 / frames.size))


def test_same_generator_state_gives_the_same_noise():
    assert np.array_equal(noise_frames(2, seed=9), noise_frames(2, seed=9))
    assert not np.array_equal(noise_frames(2, seed=9), noise_frames(2, seed=10))


def test_impossible_variances_and_steps_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match=r"quantum variance: got -1.0; expected 0 DN\^2 or more"):
        sample_correlated_quanta(np.array([[1.0, -1.0]]), 1.0, spread=Spread(sigma_px=0.5), rng=rng)
    with pytest.raises(InputError, match="DN a quantum"):
        sample_correlated_quanta(np.ones((2, 2)), 0.0, spread=Spread(sigma_px=0.5), rng=rng)


def test_adc_rounds_to_its_steps_and_clips_to_its_range():
    counts = np.array([[-3.2, 0.4, 10.5, 300.0]])
    assert digitise(counts, bits=8, quantised=True).tolist() == [[0.0, 0.0, 10.0, 255.0]]
    assert digitise(counts, bits=8, quantised=True, averaged=4).tolist() == [[0.0, 0.5, 10.5, 255.0]]
    assert digitise(counts, bits=None, quantised=False) == pytest.approx(counts)

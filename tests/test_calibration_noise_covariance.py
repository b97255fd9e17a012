"""Neighbour covariances from frame differences, and the fit of spread, gain and read noise to them."""

import math

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from raytwin.calibration.noise_covariance import (
    POOR_FIT,
    compute_noise_covariance,
    fit_spread,
    sampling_covariance,
)
from raytwin.errors import FitError, InputError
from raytwin.generator.noise import sample_frame_noise
from raytwin.generator.psf import blur_variance_share, noise_autocovariance

SHAPE = (48, 48)
GOOD = np.ones(SHAPE, dtype=bool)


def frames_of(signal, *, sigma=0.6, gain=8.0, read=120.0, model="aperture", count=20, seed=0, white=0.01):
    rng = np.random.default_rng(seed)
    level = np.full(SHAPE, float(signal))
    return np.stack(
        [
            level
            + sample_frame_noise(
                level,
                gain_DN=gain,
                white_fraction=white,
                read_variance_DN2=read,
                psf_model=model,
                psf_sigma_px=sigma,
                rng=rng,
            )
            for _ in range(count)
        ]
    )


def covariance_of(signal, *, good=GOOD, radius=5, **options):
    frames = frames_of(signal, **options)
    return compute_noise_covariance([frames], signal_DN=np.full(SHAPE, float(signal)), good=good, radius=radius)


def session(model="aperture", sigma=0.6, seed=0, count=20, **options):
    """Covariances of four flats in two groups and a dark, with their groups."""
    plan = [(200.0, 8.0, 0), (1000.0, 8.0, 0), (500.0, 14.0, 1), (3000.0, 14.0, 1), (0.0, 8.0, -1)]
    series = [
        covariance_of(signal, gain=gain, sigma=sigma, model=model, seed=10 * seed + index, count=count, **options)
        for index, (signal, gain, _) in enumerate(plan)
    ]
    return series, [group for *_, group in plan]


@pytest.mark.parametrize("model", ["aperture", "sampled"])
def test_covariances_are_those_of_the_noise_within_sampling_error(model):
    signal, gain, read, white = 1000.0, 8.0, 120.0, 0.01
    found = covariance_of(signal, model=model)
    expected = gain * signal / (1 + white) * noise_autocovariance(model, 0.6, 5)
    expected[5, 5] += gain * signal * white / (1 + white) + read
    allowed = np.sqrt(np.diag(sampling_covariance(expected, found.samples, 2)))
    window = found.covariance_DN2[3:8, 3:8] - expected[3:8, 3:8]
    assert np.all(np.abs(window) < 5 * allowed.max())
    # summed over neighbours: the gain whatever the spread is
    assert found.covariance_DN2.sum() == pytest.approx(gain * signal + read, rel=0.1)
    assert found.common_mode == 0.0


def test_pieces_do_not_matter():
    frames = frames_of(500.0)
    signal = np.full(SHAPE, 500.0)
    one = compute_noise_covariance([frames], signal_DN=signal, good=GOOD, radius=3)
    many = compute_noise_covariance([frames[:1], frames[1:7], frames[7:]], signal_DN=signal, good=GOOD, radius=3)
    assert many.covariance_DN2 == pytest.approx(one.covariance_DN2)


def test_bad_pixels_leave_no_trace():
    frames = frames_of(500.0)
    good = np.random.default_rng(0).random(SHAPE) > 0.05
    signal = np.full(SHAPE, 500.0)
    clean = compute_noise_covariance([frames], signal_DN=signal, good=good, radius=3)
    frames[:, ~good] = 65535.0 * np.random.default_rng(1).random((len(frames), int((~good).sum())))
    spoiled = compute_noise_covariance([frames], signal_DN=signal, good=good, radius=3)
    assert spoiled.covariance_DN2 == pytest.approx(clean.covariance_DN2)


def test_tube_output_noise_is_found_and_leaves_the_covariances_alone():
    rng = np.random.default_rng(4)
    signal = np.full(SHAPE, 3000.0)
    frames = frames_of(3000.0, count=40)
    steady = compute_noise_covariance([frames], signal_DN=signal, good=GOOD, radius=3)
    factor = 0.01 * rng.standard_normal(40)
    shaking = compute_noise_covariance([frames + factor[:, None, None] * signal], signal_DN=signal, good=GOOD, radius=3)
    assert steady.common_mode < 1e-6
    assert math.sqrt(shaking.common_mode) == pytest.approx(0.01, rel=4 * math.sqrt(0.5 / 26))
    assert shaking.covariance_DN2 == pytest.approx(steady.covariance_DN2, abs=0.02 * float(steady.covariance_DN2.max()))


def test_too_few_frames_or_pixels_are_refused():
    with pytest.raises(InputError, match="at least two frames"):
        compute_noise_covariance([frames_of(10.0, count=1)], signal_DN=np.zeros(SHAPE), good=GOOD, radius=3)
    with pytest.raises(InputError, match="good pixels: got 0; expected at least 49"):
        compute_noise_covariance([frames_of(10.0)], signal_DN=np.zeros(SHAPE), good=~GOOD, radius=3)


@pytest.mark.parametrize(("model", "sigma"), [("aperture", 0.4), ("aperture", 0.9), ("sampled", 0.8)])
def test_fit_finds_spread_gains_and_read_noise_within_its_own_standard_deviations(model, sigma):
    series, groups = session(model=model, sigma=sigma, seed=round(10 * sigma))
    fit = fit_spread(series, group=groups)
    assert fit.model == model
    assert abs(fit.sigma_px - sigma) < 4.5 * fit.sigma_sd_px
    assert fit.sigma_sd_px < 0.03
    for found, sd, true in zip(fit.gain_DN, fit.gain_sd_DN, (8.0, 14.0), strict=True):
        assert abs(found - true) < 4.5 * sd
        assert sd < 0.03 * true
    assert abs(fit.read_variance_DN2 - 120.0) < 4.5 * fit.read_sd_DN2
    share = blur_variance_share(model, sigma)
    for found, sd, gain in zip(fit.slope_DN, fit.slope_sd_DN, (8.0, 14.0), strict=True):
        assert abs(found - gain * (share + 0.01) / 1.01) < 4.5 * sd
    assert fit.chi_square < fit.degrees + 5 * math.sqrt(2 * fit.degrees)


def test_reading_the_width_of_the_noise_as_that_of_the_spread_would_be_root_two_too_wide():
    series, _ = session(sigma=0.9)
    profile = series[3].covariance_DN2[5, :]
    lag = np.arange(-5, 6)
    width = math.sqrt(float(np.sum(profile * lag**2) / np.sum(profile)))
    assert width == pytest.approx(math.sqrt(2 * 0.9**2 + 1 / 6), rel=0.15)


def test_without_spread_the_slope_is_the_gain():
    series, groups = session(sigma=0.0)
    fit = fit_spread(series, group=groups)
    assert fit.sigma_px < 0.12
    assert fit.slope_DN == pytest.approx(fit.gain_DN, rel=0.02)
    assert fit.gain_DN == pytest.approx([8.0, 14.0], rel=0.02)


def repeated_fit(seed):
    series, groups = session(seed=100 + seed, count=6)
    return fit_spread(series, group=groups)


def test_stated_standard_deviations_are_those_of_repetition():
    """Spread of 16 repetitions against the stated one: a chi-square with 15 degrees within its 0.1 to 99.9 %."""
    from scipy.stats import chi2

    fits = [repeated_fit(seed) for seed in range(16)]
    for found, stated in (
        ([fit.sigma_px for fit in fits], [fit.sigma_sd_px for fit in fits]),
        ([fit.gain_DN[0] for fit in fits], [fit.gain_sd_DN[0] for fit in fits]),
        ([fit.gain_DN[1] for fit in fits], [fit.gain_sd_DN[1] for fit in fits]),
        ([fit.slope_DN[0] for fit in fits], [fit.slope_sd_DN[0] for fit in fits]),
        ([fit.read_variance_DN2 for fit in fits], [fit.read_sd_DN2 for fit in fits]),
    ):
        ratio = np.var(found, ddof=1) / np.mean(np.square(stated))
        low, high = chi2.ppf([0.001, 0.999], 15) / 15
        # the prior of the white share and the inflation by chi-square may widen what is stated, never narrow it
        assert ratio < high
        assert ratio > 0.3 * low


def test_darks_alone_cannot_give_a_gain():
    with pytest.raises(FitError, match="at least one flat series"):
        fit_spread([covariance_of(0.0)], group=[-1])


def test_a_spread_that_is_no_gaussian_still_gives_the_gain() -> None:
    """A three-pixel kernel with heavy corners: the fit says so, and the summed covariances restore the gain."""
    rng = np.random.default_rng(4)
    kernel = np.array([0.2, 0.6, 0.2])
    series, groups = [], []
    for signal in (500.0, 2000.0):
        quanta = 3.0 * rng.poisson(signal / 3.0, (60, 134, 134))
        frames = correlate1d(correlate1d(quanta.astype(float), kernel, axis=1), kernel, axis=2)[:, 3:-3, 3:-3]
        frames = frames + 5.0 * rng.standard_normal(frames.shape)
        good = np.ones((128, 128), dtype=bool)
        series.append(compute_noise_covariance([frames], signal_DN=np.full((128, 128), signal), good=good, radius=5))
        groups.append(0)
    dark = 5.0 * rng.standard_normal((60, 128, 128))
    series.append(compute_noise_covariance([dark], signal_DN=np.zeros((128, 128)), good=good, radius=5))
    groups.append(-1)
    fit = fit_spread(series, group=groups)
    assert fit.summed
    assert fit.chi_square / fit.degrees > POOR_FIT
    # 2 x 655 k independent samples: the sum over 49 lags is known to about 0.5 %
    assert fit.gain_DN[0] == pytest.approx(3.0, rel=0.015)
    assert abs(fit.gain_DN[0] - 3.0) < 4 * fit.gain_sd_DN[0]
    assert fit.slope_DN[0] == pytest.approx(3.0 * float((kernel @ kernel) ** 2), rel=0.01)

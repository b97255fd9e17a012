"""Widths of what calibration states: nothing counted twice, nothing left out."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import filters_from_text
from raytwin.calibration.flats.flat_levels import median_variance
from raytwin.calibration.spectrum.priors import SHARES_CORRELATION, TABLE_SHARE
from raytwin.calibration.spectrum.spectral_fit import _sd_of_mixture, fit_spectrum
from raytwin.generator.line.twin import Estimate, Level, NoiseModel, estimate_from_sd, gaussian_spread
from raytwin.generator.line.twin_spectrum import secondary_of_levels, slope_over_gain
from raytwin.generator.spread.psf import blur_variance_share


@pytest.mark.parametrize("spread", [0.0, 0.3, 1.0, 4.0])
def test_noise_of_a_median_over_pixels_grows_with_the_spread_of_the_map(spread):
    rng = np.random.default_rng(0)
    pixels, maps, draws = 900, 30, 60
    squares = []
    for _ in range(maps):
        exact = spread * rng.standard_normal(pixels)
        noisy = np.median(exact + rng.standard_normal((draws, pixels)), axis=1)
        squares.append(np.mean((noisy - np.median(exact)) ** 2))
    stated = float(median_variance(1.0, spread_sd=spread, pixels=pixels))
    # the maps are the independent ones
    error = np.std(squares) / math.sqrt(maps)
    assert np.mean(squares) == pytest.approx(stated, rel=0.15, abs=3.5 * error)


def test_sd_of_a_mixture_has_its_interval():
    sizes = np.exp(0.8 * np.random.default_rng(3).standard_normal(4000))
    sd = _sd_of_mixture(sizes)
    assert np.mean(norm.cdf(-1.959964 * sd / sizes)) == pytest.approx(0.025, abs=1e-6)
    assert sd > np.median(sizes)
    assert _sd_of_mixture(np.full(10, 0.3)) == pytest.approx(0.3)


def test_shares_of_two_other_tables_exclude_each_other():
    # one level: of the tables the data say nothing, so that the draws are the prior's
    level = Level(
        kV=90.0,
        filters=filters_from_text("Cu:0.05"),
        gain_DN=estimate_from_sd(5.0, 0.05),
        photon_transfer_slope_DN=estimate_from_sd(2.0, 0.02),
        rate_DN_per_mAs=estimate_from_sd(3000.0, 3.0),
        source_detector_mm=1059.0,
        saturation_DN=None,
        flat_shape=np.ones((1, 1), dtype=np.float32),
        series=("flat",),
        role="calibration",
    )
    instrument = Instrument(pixel_mm=0.15, source_detector_mm=1059.0, scintillator=filters_from_text("CsI:0.5"))
    posterior = fit_spectrum([level], instrument, rng=np.random.default_rng(4)).posterior
    first, second = posterior.column("chantler_Cu"), posterior.column("penelope_Cu")
    # 512 draws: 0.033 for a correlation of -0.5, 3 % for a standard deviation
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(SHARES_CORRELATION, abs=0.12)
    assert [first.std(), second.std()] == pytest.approx([TABLE_SHARE.sd] * 2, rel=0.15)


def levels_with(slope_of_gain, gains):
    return [
        Level(
            kV=40.0 + 10.0 * number,
            filters=(),
            gain_DN=estimate_from_sd(gain, 0.01),
            photon_transfer_slope_DN=estimate_from_sd(slope_of_gain(gain), 0.01),
            rate_DN_per_mAs=None,
            source_detector_mm=None,
            saturation_DN=None,
            flat_shape=np.ones((1, 1), dtype=np.float32),
            series=(f"{number}",),
            role="calibration",
        )
        for number, gain in enumerate(gains)
    ]


def noise_of(sigma_px, white_fraction):
    return NoiseModel(
        spread=gaussian_spread("aperture", Estimate(value=sigma_px, low=sigma_px, high=sigma_px)),
        white_fraction=white_fraction,
        read_noise_DN=estimate_from_sd(1.0, 0.01),
        quantised=True,
    )


@pytest.mark.parametrize("secondary", [0.02, 2.5])
def test_white_noise_of_secondary_quanta_is_the_same_in_every_beam(secondary):
    share = blur_variance_share("aperture", 0.7)
    gains = [4.0, 6.0]
    mean_gain = math.sqrt(math.prod(gains))
    noise = noise_of(0.7, secondary / (mean_gain - secondary))

    def slope(gain):
        return share * (gain - secondary) + secondary

    levels = levels_with(slope, gains)
    assert secondary_of_levels(levels, noise) == pytest.approx(secondary)
    found = slope_over_gain(levels, noise, np.array([3.5, 4.9, 8.0]))
    assert found is not None
    # the mean of the levels' ratios stands for that at their mean gain: right to second order in the spread of gains
    assert found == pytest.approx(
        [slope(gain) / gain for gain in (3.5, 4.9, 8.0)], rel=1e-3 if secondary < 1.0 else 0.02
    )
    assert found[0] > found[2]


def test_slopes_without_noise_of_secondary_quanta_keep_one_ratio_to_the_gain():
    noise = noise_of(0.9, 0.0)
    found = slope_over_gain(levels_with(lambda gain: 0.5 * gain, [4.0, 6.0]), noise, np.array([3.0, 9.0]))
    assert found == pytest.approx([0.5, 0.5])
    assert slope_over_gain([], noise, np.array([3.0])) is None
    assert secondary_of_levels([], noise) is None

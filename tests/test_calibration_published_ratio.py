"""The published levels at 90 and 40 kV: inside what is predicted before calibration, and what they say of the tube."""

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import Filter
from raytwin.calibration.spectrum.priors import draw_parameters, ripple_from_latent
from raytwin.calibration.spectrum.spectral_fit import fit_spectrum
from raytwin.calibration.spectrum.spectral_model import priors_for
from raytwin.generator.line.spectral_signal import OpenBeam, SpectralModel
from raytwin.generator.line.twin import Estimate, Level

COPPER = (Filter(material="Cu", thickness_mm=0.05),)
DECLARED_CSI = (Filter(material="CsI", thickness_mm=0.5),)
DRAWS = 20_000
# two levels, each reproducible to this: the printed digits (0.575 and 3.86 DN/W/ms) add 0.16 %
LEVEL_SD = 0.003
RATIO_SD = math.sqrt(2) * LEVEL_SD
SCALES = {"log_output", "log_DN_per_keV", "log_swank"}  # the same at both voltages, so not in the ratio


def published():
    """kV -> (DN per ms, tube current in mA) of the setting that the paper used."""
    path = Path(__file__).parents[1] / "data" / "calibration" / "flexray_2024.toml"
    levels = tomllib.loads(path.read_text(encoding="utf-8"))["level"]
    return {level["kV"]: (level["DN_per_W_ms"] * level["power_W"], level["power_W"] / level["kV"]) for level in levels}


def published_ratio():
    levels = published()
    return levels[90.0][0] / levels[40.0][0]


def model_of(scintillator=DECLARED_CSI):
    return SpectralModel(scintillator=scintillator, filter_materials=("Al", "Cu"))


def log_ratio(model, samples):
    """Logarithm of the level at 90 kV 45 W over that at 40 kV 40 W, per ms, behind 0.05 mm Cu (draw,)."""
    levels = published()
    high, low = (model.signal(samples, OpenBeam(kV=kV, filters=COPPER)).rate_DN_per_mAs for kV in (90.0, 40.0))
    return np.log(high / low * levels[90.0][1] / levels[40.0][1])


def prior_draws(model, *, known=(), scintillator_declared=True):
    """(draw, parameter) from the priors; parameters in `known` stay at their centre."""
    priors = priors_for(model, scintillator_declared=scintillator_declared)
    drawn = draw_parameters(priors, DRAWS, np.random.default_rng(7))
    for name in known:
        drawn[:, model.names.index(name)] = priors[name].centre
    return drawn


def filtration_given_ratio(model, samples, ratio):
    """Mean and sd of the inherent filtration (mm Al) when the ratio is measured, prior draws weighted by it."""
    weight = norm.pdf(log_ratio(model, samples), loc=math.log(ratio), scale=RATIO_SD)
    weight /= weight.sum()
    assert 1 / np.sum(weight**2) > 100
    filtration = samples[:, model.names.index("inherent_filtration_mm_Al")]
    mean = weight @ filtration
    return mean, math.sqrt(weight @ (filtration - mean) ** 2)


def information_limit(model, mean_mm, *, known=()):
    """The sd of the filtration (mm Al) that its own prior and those of everything else allow, by derivatives about `mean_mm`."""
    priors = priors_for(model, scintillator_declared=True)
    centre = np.array([prior.centre for prior in priors.values()])
    centre[model.names.index("inherent_filtration_mm_Al")] = mean_mm
    slopes = {}
    for index, (name, prior) in enumerate(priors.items()):
        step = min(0.2 * prior.sd, 0.1) if name != "kV_variance" else 0.3 * prior.sd
        sides = np.stack([centre, centre])
        sides[:, index] += [-step, step]
        below, above = log_ratio(model, sides)
        slopes[name] = (above - below) / (2 * step)
    others = [name for name in priors if name not in {"inherent_filtration_mm_Al", "kV_variance", *SCALES, *known}]
    variance = RATIO_SD**2 + sum((slopes[name] * priors[name].spread) ** 2 for name in others)
    if "kV_error" not in known:
        # a ripple moves the mean of the voltage and its variance together
        ripple = ripple_from_latent(norm.ppf((np.arange(1000) + 0.5) / 1000))
        variance += np.var(slopes["kV_error"] * -0.5 * ripple + slopes["kV_variance"] * ripple**2 / 8.0)
    by_ratio = slopes["inherent_filtration_mm_Al"] ** 2 / variance
    return 1.0 / math.sqrt(by_ratio + 1.0 / priors["inherent_filtration_mm_Al"].spread ** 2)


def test_published_constants_give_the_ratio_of_levels_that_the_paper_saw():
    assert published_ratio() == pytest.approx(7.55, abs=0.01)


@pytest.mark.parametrize(
    "scintillator",
    [DECLARED_CSI, (Filter(material="Gd2O2S@7.32", thickness_mm=0.1),)],
    ids=["CsI", "Gd2O2S"],
)
@pytest.mark.parametrize("declared", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_published_ratio_lies_inside_the_interval_predicted_before_calibration(scintillator, declared):
    model = model_of(scintillator)
    predicted = np.exp(log_ratio(model, prior_draws(model, scintillator_declared=declared)))
    low, high = np.quantile(predicted, [0.025, 0.975])
    assert low < published_ratio() < high
    # and the interval says something: within a factor of two and a half of the published one
    assert published_ratio() / 2.5 < low
    assert high < published_ratio() * 2.5


@pytest.mark.slow
def test_published_ratio_narrows_the_filtration_as_far_as_kV_and_scintillator_allow():
    model = model_of()
    before = prior_draws(model)[:, model.names.index("inherent_filtration_mm_Al")].std()
    widths, limits = {}, {}
    for label, known in {
        "nothing": (),
        "kV": ("kV_error", "kV_variance"),
        "scintillator": ("log_scintillator_thickness",),
        "both": ("kV_error", "kV_variance", "log_scintillator_thickness"),
    }.items():
        mean, widths[label] = filtration_given_ratio(model, prior_draws(model, known=known), published_ratio())
        limits[label] = information_limit(model, mean, known=known)
        assert widths[label] == pytest.approx(limits[label], rel=0.15), label
    assert before > 1.0
    assert widths["nothing"] < 0.4 * before
    # each finds another filtration, and thin ones are told better: only both together must narrow it
    assert widths["both"] < widths["nothing"]


@pytest.mark.slow
def test_fit_of_the_published_levels_finds_the_same_filtration_as_weighted_prior_draws():
    # gains at the two voltages are not published: they enter with no weight
    unknown_gain = Estimate(value=2.0, low=-40.0, high=44.0)
    levels = [
        Level(
            kV=kV,
            filters=COPPER,
            gain_DN=unknown_gain,
            photon_transfer_slope_DN=unknown_gain,
            rate_DN_per_mAs=_exactly(1000.0 * rate / current),
            source_detector_mm=1059.0,
            saturation_DN=None,
            flat_shape=np.ones((1, 1), dtype=np.float32),
            series=("published",),
            role="either",
        )
        for kV, (rate, current) in sorted(published().items())
    ]
    instrument = Instrument(scintillator=DECLARED_CSI, pixel_mm=0.15, source_detector_mm=1059.0)
    posterior = fit_spectrum(levels, instrument, rng=np.random.default_rng(3), level_discrepancy=LEVEL_SD).posterior
    filtration = posterior.column("inherent_filtration_mm_Al")
    model = model_of()
    mean, sd = filtration_given_ratio(model, prior_draws(model), published_ratio())
    # 512 draws on one side, some hundreds of effective ones on the other
    assert filtration.mean() == pytest.approx(mean, abs=0.3 * sd)
    assert filtration.std() == pytest.approx(sd, rel=0.2)


def _exactly(value):
    return Estimate(value=value, low=value, high=value)

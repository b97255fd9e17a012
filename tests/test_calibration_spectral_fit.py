"""The spectral posterior: derivatives, intervals that hold for lines drawn from the priors, tables, wedges, spectra."""

import math
from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom

from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import Filter, filters_from_text
from raytwin.calibration.spectrum import posterior_draws, spectral_fit
from raytwin.calibration.spectrum.posterior_draws import Draws, walked
from raytwin.calibration.spectrum.priors import GAIN_DISCREPANCY, LEVEL_DISCREPANCY, draw_parameters
from raytwin.calibration.spectrum.spectral_data import Transmission, geometry_factor, repeated_levels
from raytwin.calibration.spectrum.spectral_fit import fit_spectrum
from raytwin.calibration.spectrum.spectral_model import (
    OTHER_SCINTILLATOR,
    correction_from_spectra,
    model_for,
    priors_for,
)
from raytwin.calibration.spectrum.spectral_posterior import SHAPE_PARAMETERS, Posterior
from raytwin.errors import FitError, InputError
from raytwin.generator.line.spectral_signal import OpenBeam, SpectralModel
from raytwin.generator.line.twin import Estimate, Level, NoiseModel, SpreadEstimate, estimate_from_sd
from raytwin.generator.line.twin_spectrum import model_of_posterior
from raytwin.generator.spread.psf import Spread
from raytwin.materials import transmission
from raytwin.spectra import Spectrum, detector_response, energy_grid_keV, tube_spectrum

INSTRUMENT = Instrument(
    pixel_mm=0.15,
    source_detector_mm=1059.0,
    source_object_mm=990.0,
    scintillator=filters_from_text("CsI:0.5"),
    maximum_power_w=90.0,
)
BEAMS = tuple(
    OpenBeam(kV=kV, filters=filters_from_text(text)) for kV, text in ((40, "Cu:0.05"), (40, ""), (90, "Cu:0.05"))
)
FACTOR = geometry_factor(source_detector_mm=1059.0, pixel_mm=0.15)


@pytest.fixture(scope="module")
def model():
    return model_for(INSTRUMENT, materials=(), highest_kV=120.0)


def from_prior(model, rng):
    """One parameter set drawn from the priors."""
    full = draw_parameters(priors_for(model, scintillator_declared=True), 1, rng)[0]
    full[model.names.index("log_DN_per_keV")] = math.log(0.1)
    return full


def with_secondary(model, secondary_DN):
    """The same tube and detector, whose secondary quanta add this much variance per signal."""
    result = copy(model)
    result.secondary_DN = secondary_DN
    return result


def typical(model, **values):
    full = np.array([prior.centre for prior in priors_for(model, scintillator_declared=True).values()])
    full[model.names.index("log_DN_per_keV")] = math.log(0.1)
    for name, value in values.items():
        full[model.names.index(name)] = value
    return full


def level(kV, filters, rate, gain, *, rate_sd=0.001, gain_sd=0.01):
    """A measured level, rate per mAs at 1 m and 1 mm2, with relative standard deviations."""
    return Level(
        kV=kV,
        filters=filters,
        gain_DN=estimate_from_sd(gain, 1.5 * gain_sd * gain),
        photon_transfer_slope_DN=estimate_from_sd(0.4 * gain, gain_sd * 0.4 * gain),
        rate_DN_per_mAs=estimate_from_sd(rate * FACTOR, rate_sd * rate * FACTOR),
        source_detector_mm=1059.0,
        saturation_DN=None,
        flat_shape=np.ones((1, 1), dtype=np.float32),
        series=(f"{kV:g}",),
        role="calibration",
    )


def levels_of(model, parameters, beams, rng=None):
    """Levels of a parameter set, with sampling noise and discrepancy when a generator is given."""
    found = []
    for beam in beams:
        signal = model.signal(parameters[None, :], beam)
        rate, gain = float(signal.rate_DN_per_mAs[0]), float(signal.gain_DN[0])
        if rng is not None:
            rate *= math.exp(math.hypot(0.001, LEVEL_DISCREPANCY) * rng.standard_normal())
            gain *= math.exp(math.hypot(0.01, GAIN_DISCREPANCY) * rng.standard_normal())
        found.append(level(beam.kV, beam.filters, rate, gain))
    return found


@pytest.mark.parametrize("secondary_DN", [0.0, 2.0])
def test_derivatives_are_those_of_the_signal(model, secondary_DN):
    rng = np.random.default_rng(1)
    model = with_secondary(model, secondary_DN)
    names = [name for name in model.names if name not in SHAPE_PARAMETERS]
    # as the fit takes them: the filtration, scintillator and voltage of a draw, the rest at the prior's centre
    samples = np.array([typical(model) for _ in range(5)])
    drawn = [model.names.index(name) for name in model.names if name in SHAPE_PARAMETERS]
    samples[:, drawn] = np.array([from_prior(model, rng) for _ in range(5)])[:, drawn]
    for beam in (OpenBeam(kV=90.0, filters=filters_from_text("Cu:0.1+Al:1")), OpenBeam(kV=45.0, filters=())):
        logs, rates, gains = model.log_derivatives(samples, beam, names)
        signal = model.signal(samples, beam)
        assert logs[0] == pytest.approx(np.log(signal.rate_DN_per_mAs), abs=1e-12)
        assert logs[1] == pytest.approx(np.log(signal.gain_DN), abs=1e-12)
        for column, name in enumerate(names):
            step = np.zeros(len(model.names))
            # the voltage error is piecewise linear between its nodes, and the derivative takes both sides
            # and the spectrum's end is cut where the voltage would vary less than not at all
            size = 5e-5 if name == "kV_variance" else 2e-3
            step[model.names.index(name)] = size
            up, down = model.signal(samples + step, beam), model.signal(samples - step, beam)
            rate = np.log(up.rate_DN_per_mAs / down.rate_DN_per_mAs) / (2 * size)
            gain = np.log(up.gain_DN / down.gain_DN) / (2 * size)
            tolerance = {"rel": 1e-4, "abs": 1e-6}
            if name == "kV_tilt":
                tolerance = {"rel": 0.02, "abs": 1e-5}
            if name.startswith("log_mu"):
                tolerance = {"rel": 0.01}  # the tables' share of a scale is left out
            assert rates[:, column] == pytest.approx(rate, **tolerance), name
            assert gains[:, column] == pytest.approx(gain, **tolerance), name


@pytest.mark.parametrize("table", ["chantler", "penelope"])
def test_a_whole_share_of_another_table_is_that_table(model, table):
    filters = filters_from_text("Cu:0.1+Al:1")
    moved = np.zeros((1, len(model.names)))
    for material in ("Al", "Cu"):
        moved[0, model.names.index(f"{table}_{material}")] = 1.0
    bare = model.weights(np.zeros((1, len(model.names))), OpenBeam(kV=90.0, filters=()))[0]
    behind = model.weights(moved, OpenBeam(kV=90.0, filters=filters))[0]
    energies = model.energies_keV[: len(bare)]
    # near copper's K edge at 8.98 keV the tables' edges differ
    seen = (bare > 1e-6 * bare.max()) & (energies > 12)
    expected = transmission(filters, energies[seen], table=table)
    assert behind[seen] / bare[seen] == pytest.approx(expected, rel=2e-3)


def test_the_end_exponent_is_a_power_of_the_distance_to_the_end_point(model):
    unchanged, moved = np.zeros((2, 1, len(model.names)))
    moved[0, model.names.index("end_exponent")] = -0.2
    beam = OpenBeam(kV=90.0, filters=filters_from_text("Al:2"))
    before, after = model.weights(unchanged, beam)[0], model.weights(moved, beam)[0]
    share = model.energies_keV[: before.size] / 90.0
    seen = (before > 0) & (share < 0.98)
    assert after[seen] / before[seen] == pytest.approx((2.0 * (1.0 - share[seen])) ** -0.2, rel=1e-9)
    # and stands still at the end itself, where the voltage's own error moves the spectrum
    assert np.ptp(after[~seen & (before > 0)] / before[~seen & (before > 0)]) < 1e-9


def test_a_twin_calibrated_with_a_share_of_the_other_spectrum_model_keeps_it(model):
    model = model.with_parameters(["spectrum_model"])
    moved = np.zeros((1, len(model.names)))
    moved[0, model.names.index("spectrum_model")] = 1.0
    other = SpectralModel(model="kqp", filter_materials=("Al", "Cu"))
    for kV in (40.0, 90.0):
        beam = OpenBeam(kV=kV, filters=filters_from_text("Al:2"))
        ours = model.signal(moved, beam)
        theirs = other.signal(np.zeros((1, len(other.names))), beam)
        assert ours.rate_DN_per_mAs[0] == pytest.approx(theirs.rate_DN_per_mAs[0], rel=1e-3)
        assert ours.gain_DN[0] == pytest.approx(theirs.gain_DN[0], rel=1e-3)


def test_intervals_hold_for_lines_drawn_from_the_priors(model):
    rng = np.random.default_rng(5)
    new = [
        OpenBeam(kV=60.0, filters=filters_from_text("Al:2")),
        OpenBeam(kV=110.0, filters=filters_from_text("Cu:0.1")),
    ]
    inside, lines = 0, 8
    for _ in range(lines):
        truth = from_prior(model, rng)
        posterior = fit_spectrum(levels_of(model, truth, BEAMS, rng), INSTRUMENT, rng=rng).posterior
        for beam in new:
            draws = np.log(model.signal(posterior.samples, beam).rate_DN_per_mAs)
            exact = float(np.log(model.signal(truth[None, :], beam).rate_DN_per_mAs[0]))
            middle, low, high = np.quantile(draws, [0.5, 0.025, 0.975])
            inside += (
                middle - math.hypot(middle - low, 1.96 * 0.001) <= exact <= middle + math.hypot(high - middle, 0.002)
            )
    # two beams of a line go together: bounds as if only the lines counted, at 1e-3
    assert inside / 2 >= binom.ppf(1e-3, lines, 0.95)


def test_photons_are_counted_by_the_noise_of_quanta_alone(model):
    """Two electrons a photon at 60 kV double what the levels' gains say of noise, and change no number of photons."""
    truth = typical(model)
    quanta_DN = float(model.signal(truth[None, :], OpenBeam(kV=60.0, filters=())).gain_DN[0])
    spread = Spread(sigma_px=0.5)
    electron_DN, left = quanta_DN / 2.0, spread.variance_share
    levels = [
        replace(item, photon_transfer_slope_DN=estimate_from_sd(slope, 0.003 * slope))
        for item in levels_of(with_secondary(model, electron_DN), truth, BEAMS)
        for slope in [left * (item.gain_DN.value - electron_DN) + electron_DN]
    ]
    mean_gain = math.exp(float(np.mean([math.log(item.gain_DN.value) for item in levels])))
    noise = NoiseModel(
        spread=SpreadEstimate(value=spread),
        white_fraction=electron_DN / (mean_gain - electron_DN),
        read_noise_DN=estimate_from_sd(5.0, 0.01),
        quantised=False,
    )
    fit = fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(3), noise=noise)
    assert fit.posterior.secondary_DN == pytest.approx(electron_DN, rel=1e-9)
    assert fit.chi_square < 2.0 * fit.data
    for kV in (40.0, 60.0, 90.0):
        beam = OpenBeam(kV=kV, filters=())
        found = model_of_posterior(fit.posterior).signal(fit.posterior.samples, beam)
        exact = model.signal(truth[None, :], beam)
        low, high = np.quantile(found.absorbed_per_mAs, [0.025, 0.975])
        assert low < exact.absorbed_per_mAs[0] < high < 1.5 * low
        assert np.median(found.gain_DN) == pytest.approx(exact.gain_DN[0] + electron_DN, rel=0.02)


@pytest.mark.parametrize("escape", [-1.0, 0.1])
def test_draws_meet_the_levels_where_the_model_bends(model, escape):
    """Not to first order in light, covers and anode: to the levels' own noise, whatever escapes."""
    truth = typical(model, escape_scale=escape, light_nonproportionality=2.0, anode_roughness_um=3.0, cover_mm_C=1.5)
    posterior = fit_spectrum(
        levels_of(model, truth, BEAMS), INSTRUMENT, rng=np.random.default_rng(7), level_discrepancy=1e-4
    ).posterior
    for beam in BEAMS:
        draws = np.log(model.signal(posterior.samples, beam).rate_DN_per_mAs)
        exact = float(np.log(model.signal(truth[None, :], beam).rate_DN_per_mAs[0]))
        assert abs(float(np.mean(draws)) - exact) < 3e-4
        assert np.std(draws) == pytest.approx(0.001, rel=0.15)  # the sampling noise that the levels state


@pytest.mark.parametrize("factor", [0.25, 1000.0])
def test_labels_of_another_unit_are_named_and_bend_no_filtration(model, factor):
    """Exposures in s for ms, a current four times too high: the output cannot be the tube's."""
    full = typical(model, inherent_filtration_mm_Al=1.6)
    levels = levels_of(model, full, BEAMS)
    slipped = [
        replace(one, rate_DN_per_mAs=estimate_from_sd(factor * one.rate_DN_per_mAs.value, 0.001 * factor))
        for one in levels
    ]
    right, wrong = (fit_spectrum(one, INSTRUMENT, rng=np.random.default_rng(3)) for one in (levels, slipped))
    assert right.output is None
    assert wrong.output == pytest.approx(factor, rel=0.3)
    filtration = wrong.posterior.interval("inherent_filtration_mm_Al")
    assert filtration.low <= 1.6 <= filtration.high
    assert filtration.value == pytest.approx(right.posterior.interval("inherent_filtration_mm_Al").value, abs=0.4)


@pytest.mark.parametrize("wrong", ["filter", pytest.param("exchanged", marks=pytest.mark.slow)])
def test_levels_that_contradict_every_spectrum_leave_intervals_that_hold_the_truth(model, wrong):
    truth = typical(model, inherent_filtration_mm_Al=1.6)
    soft, bare, hard = levels_of(model, truth, BEAMS)
    if wrong == "filter":
        soft = replace(soft, filters=())
    else:
        soft, hard = replace(soft, kV=90.0), replace(hard, kV=40.0)
    fit = fit_spectrum([soft, bare, hard], INSTRUMENT, rng=np.random.default_rng(5))
    assert spectral_fit.contradicts(fit)
    filtration = fit.posterior.interval("inherent_filtration_mm_Al")
    assert filtration.low <= 1.6 <= filtration.high
    for beam in (*BEAMS, OpenBeam(kV=60.0, filters=())):
        rates = np.log(model.signal(fit.posterior.samples, beam).rate_DN_per_mAs)
        exact = float(np.log(model.signal(truth[None, :], beam).rate_DN_per_mAs[0]))
        low, high = np.quantile(rates, [0.025, 0.975])
        assert low <= exact <= high


def test_more_levels_narrow_the_prediction(model):
    truth = typical(model, inherent_filtration_mm_Al=0.8, kV_error=0.004)
    new = OpenBeam(kV=60.0, filters=filters_from_text("Al:2"))
    widths = []
    for count in (1, 2, 3):
        fit = fit_spectrum(levels_of(model, truth, BEAMS[:count]), INSTRUMENT, rng=np.random.default_rng(0))
        widths.append(float(np.std(np.log(model.signal(fit.posterior.samples, new).rate_DN_per_mAs))))
    assert widths[0] > 1.3 * widths[1]
    assert widths[1] > widths[2]


def test_a_wedge_at_one_kV_tells_what_levels_at_one_kV_do_not(model):
    truth = typical(model, inherent_filtration_mm_Al=0.6)
    beam = OpenBeam(kV=60.0, filters=())
    steps = []
    for thickness in (1.0, 2.0, 5.0):
        layer = Filter(material="Al", thickness_mm=thickness)
        behind = model.signal(truth[None, :], OpenBeam(kV=60.0, filters=(layer,))).rate_DN_per_mAs[0]
        value = float(behind / model.signal(truth[None, :], beam).rate_DN_per_mAs[0])
        steps.append(Transmission(kV=60.0, filters=(), layers=(layer,), value=value, relative_sd=0.002))
    levels = levels_of(model, truth, [beam])
    without = fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(0)).posterior
    with_wedge = fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(0), transmissions=steps).posterior
    before, after = (item.column("inherent_filtration_mm_Al") for item in (without, with_wedge))
    assert np.std(after) < 0.5 * np.std(before)
    assert abs(np.mean(after) - 0.6) < 3 * np.std(after)


@pytest.mark.slow
def test_levels_that_contradict_the_model_raise_the_learned_discrepancy(model):
    beams = [OpenBeam(kV=kV, filters=filters_from_text(text)) for kV in (40.0, 60.0, 90.0) for text in ("", "Cu:0.05")]
    truth = typical(model)
    smooth = levels_of(model, truth, beams)
    rough = [
        level(item.kV, item.filters, item.rate_DN_per_mAs.value / FACTOR * (1 + 0.02 * sign), item.gain_DN.value)
        for item, sign in zip(smooth, (1, -1, -1, 1, 1, -1), strict=True)
    ]
    found = [fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(2)) for levels in (smooth, rough)]
    assert found[0].discrepancy["level"][0] < 0.0015
    assert found[1].discrepancy["level"][0] > 0.004
    assert found[1].posterior.level_discrepancy > 4 * found[0].posterior.level_discrepancy


def repeated(scatter, *, sampling_percent=0.02):
    """Four settings measured three times each, as the evidence has them; `scatter` relative."""
    offsets = (scatter * math.sqrt(1.5), -scatter * math.sqrt(1.5), 0.0)  # of this standard deviation
    return [
        {"mean_signal_DN": [2000.0 * (1 + one) for one in offsets], "sampling_percent": [sampling_percent] * 3}
        for _ in range(4)
    ]


def test_repeats_of_a_setting_tell_how_well_the_line_repeats_itself(model):
    truth = typical(model)
    levels = levels_of(model, truth, BEAMS)
    found = [
        fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(2), repeats=repeats)
        for repeats in ((), repeated(1e-4), repeated(3e-3))
    ]
    alone, steady, unsteady = (one.discrepancy["level"] for one in found)
    assert steady[0] < 0.6 * alone[0] and steady[2] < alone[2]
    assert unsteady[1] < 3e-3 < unsteady[2] and unsteady[0] > 1.5e-3
    widths = [one.posterior.level_discrepancy for one in found]
    assert widths[1] < widths[0] < widths[2]


def test_likelihood_of_repeats_is_that_of_any_level(model):
    """Against the integral over the level, for series of different sampling noise."""
    logs, sampling = np.array([0.0, 0.002, -0.001]), np.array([5e-4, 1e-3, 7e-4])
    priors = priors_for(model, scintillator_declared=True)
    fit = Posterior(model, priors, [], [], {"level": None, "gain": None}, [(logs, sampling)])
    sizes = np.array([1e-4, 1e-3, 4e-3])
    level = np.linspace(-0.05, 0.05, 20001)
    exact = []
    for size in sizes:
        sd = np.hypot(sampling, size)[:, None]
        density = np.prod(np.exp(-0.5 * ((logs[:, None] - level) / sd) ** 2) / sd, axis=0)
        exact.append(math.log(np.sum(density) * (level[1] - level[0])))
    found = fit._log_likelihood_of_repeats(sizes)
    assert found - found[0] == pytest.approx(np.array(exact) - exact[0], abs=1e-6)


def test_rows_of_repeats_that_say_nothing_are_passed_over():
    rows = [
        {"mean_signal_DN": [100.0], "sampling_percent": [0.1]},
        {"mean_signal_DN": [100.0, 101.0]},
        {"mean_signal_DN": [100.0, -1.0], "sampling_percent": [0.1, 0.1]},
        {"mean_signal_DN": [100.0, 101.0], "sampling_percent": [0.1, 0.0]},
    ]
    assert repeated_levels(rows) == []


def test_without_a_declared_scintillator_both_kinds_are_weighed():
    instrument = Instrument(pixel_mm=0.15, source_detector_mm=1059.0)
    real = SpectralModel(scintillator=OTHER_SCINTILLATOR, filter_materials=("Al", "Cu"))
    beams = [
        OpenBeam(kV=kV, filters=filters_from_text(text)) for kV in (30.0, 45.0, 60.0, 90.0) for text in ("", "Al:2")
    ]
    truth = typical(real, inherent_filtration_mm_Al=0.8)
    few = fit_spectrum(levels_of(real, truth, beams[:1]), instrument, rng=np.random.default_rng(3)).posterior
    many = fit_spectrum(levels_of(real, truth, beams), instrument, rng=np.random.default_rng(3)).posterior
    assert few.alternative == OTHER_SCINTILLATOR
    shares = [np.mean(item.column("scintillator_alternative")) for item in (few, many)]
    assert 0.1 < shares[0] < 0.9
    assert shares[1] > 0.95  # caesium iodide's K edges at 33 and 36 keV are not there
    new = OpenBeam(kV=75.0, filters=filters_from_text("Cu:0.1"))
    wide = SpectralModel(alternative=OTHER_SCINTILLATOR, filter_materials=("Al", "Cu"))
    draws = np.log(wide.signal(many.samples, new).rate_DN_per_mAs)
    exact = math.log(real.signal(truth[None, :], new).rate_DN_per_mAs[0])
    assert abs(np.mean(draws) - exact) < 3 * np.std(draws) + 0.002


def test_the_swank_factor_stays_below_one_and_the_levels_where_they_were(model):
    truth = typical(model, log_swank=-0.001)
    posterior = fit_spectrum(levels_of(model, truth, BEAMS), INSTRUMENT, rng=np.random.default_rng(4)).posterior
    assert np.max(posterior.column("log_swank")) <= 0.0
    for beam, item in zip(BEAMS, levels_of(model, truth, BEAMS), strict=True):
        signal = model.signal(posterior.samples, beam)
        assert np.std(np.log(signal.rate_DN_per_mAs)) < 0.003
        assert np.median(signal.rate_DN_per_mAs) * FACTOR == pytest.approx(item.rate_DN_per_mAs.value, rel=0.003)


def test_the_most_probable_set_fits_the_levels(model):
    truth = typical(model, inherent_filtration_mm_Al=1.4, kV_error=-0.006)
    fit = fit_spectrum(levels_of(model, truth, BEAMS), INSTRUMENT, rng=np.random.default_rng(6))
    assert fit.chi_square < 0.5
    assert fit.effective_draws > 500
    assert fit.data == 2 * len(BEAMS)


def test_a_set_of_fewer_names_counts_what_it_lacks_as_nothing(model):
    names = model.names[:8]
    older = SpectralModel(scintillator=INSTRUMENT.scintillator, names=names, highest_kV=120.0)
    parameters = typical(model, inherent_filtration_mm_Al=0.9)[:8]
    full = np.zeros(len(model.names))
    full[:8] = parameters
    for beam in BEAMS:
        ours, theirs = older.signal(parameters[None, :], beam), model.signal(full[None, :], beam)
        assert ours.rate_DN_per_mAs == pytest.approx(theirs.rate_DN_per_mAs, rel=1e-9)
        assert ours.gain_DN == pytest.approx(theirs.gain_DN, rel=1e-9)


def measured_spectrum(kV, *, absolute=True):
    """A tube that the model does not know: another physics model, rough anode, 1.3 mm Al in its housing."""
    bare = tube_spectrum(kV=kV, model="kqp", filters=filters_from_text("Al:1.3+W:0.001"))
    return Spectrum(
        energies_keV=bare.energies_keV, fluence=1.2 * bare.fluence, kV=kV, model="file tube.csv", absolute=absolute
    )


@pytest.mark.parametrize("absolute", [True, False])
def test_a_measured_spectrum_stands_in_for_the_model_at_its_voltage(absolute):
    spectra = [measured_spectrum(kV, absolute=absolute) for kV in (50.0, 90.0)]
    correction = correction_from_spectra(spectra, INSTRUMENT)
    assert correction.relative is not absolute
    corrected = model_for(INSTRUMENT, materials=(), highest_kV=90.0, correction=correction)
    ratios = []
    for spectrum in spectra:
        for text in ("", "Al:2", "Cu:0.1"):
            filters = filters_from_text(text)
            response = detector_response(
                scintillator=INSTRUMENT.scintillator, energies_keV=energy_grid_keV(spectrum.kV)
            )
            passed = transmission(filters, spectrum.energies_keV)
            exact = np.sum(spectrum.fluence * passed * response.mean_deposited_keV) * spectrum.bin_width_keV / 100
            signal = corrected.signal(np.zeros((1, len(corrected.names))), OpenBeam(kV=spectrum.kV, filters=filters))
            ratios.append(float(signal.rate_DN_per_mAs[0] / exact))
    ratios = np.array(ratios).reshape(2, 3)
    if not absolute:
        ratios = ratios / ratios[:, :1]
    # half-keV bins of the file against the model's sums, smoothing over 1 keV, and the end point that is left out
    assert ratios == pytest.approx(1.0, abs=0.02)


def test_measured_spectra_fix_the_filtration_and_what_follows_from_it():
    spectra = [measured_spectrum(kV) for kV in (50.0, 90.0)]
    known = model_for(
        INSTRUMENT, materials=(), highest_kV=90.0, correction=correction_from_spectra(spectra, INSTRUMENT)
    )
    truth = typical(known, inherent_filtration_mm_Al=0.0, end_exponent=0.0)
    levels = levels_of(known, truth, [OpenBeam(kV=50.0, filters=()), OpenBeam(kV=90.0, filters=())])
    posterior = fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(0), spectra=spectra).posterior
    assert posterior.correction is not None
    assert posterior.interval("inherent_filtration_mm_Al").high < 0.3
    new = OpenBeam(kV=70.0, filters=filters_from_text("Al:1"))
    draws = np.log(known.signal(posterior.samples, new).rate_DN_per_mAs)
    exact = math.log(known.signal(truth[None, :], new).rate_DN_per_mAs[0])
    assert abs(np.median(draws) - exact) < 0.015


def test_a_posterior_that_is_hard_to_draw_is_drawn_by_walkers(model, monkeypatch):
    truth = typical(model, inherent_filtration_mm_Al=1.4, kV_error=-0.006)
    levels = levels_of(model, truth, BEAMS)
    easy = fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(5))
    monkeypatch.setattr(posterior_draws, "_ROUNDS", 1)
    for name in ("_ROUND_DRAWS", "_FINAL_DRAWS"):
        monkeypatch.setattr(posterior_draws, name, 64)
    fit = fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(6))
    assert fit.effective_draws >= 200
    assert fit.chi_square < 0.5
    for name in ("inherent_filtration_mm_Al", "log_output", "log_DN_per_keV", "kV_error"):
        one, other = (found.posterior.samples[:, found.posterior.names.index(name)] for found in (easy, fit))
        assert np.mean(other) == pytest.approx(np.mean(one), abs=0.25 * np.std(one))
        assert np.std(other) == pytest.approx(np.std(one), rel=0.2)
    # walkers that stay where they are are draws of nothing
    monkeypatch.setattr(posterior_draws, "_MOST_SWEEPS", 0)
    with pytest.raises(FitError, match="could not be drawn"):
        fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(6))


def test_walkers_follow_a_bent_posterior():
    class Bent:
        dimensions = 2

        def log_likelihood(self, u):
            inside = u[:, 0] > -1.0
            return np.where(inside, -0.5 * ((u[:, 1] - u[:, 0] ** 2) / 0.03) ** 2, -np.inf)

    rng = np.random.default_rng(8)
    u = rng.standard_normal((2048, 2))
    bent = Bent()
    start = Draws(u=u, likelihood=bent.log_likelihood(u), weight=np.full(2048, 1 / 2048), effective=0.0)
    found = walked(bent, start, np.zeros(2048), rng)
    walkers = found.u
    assert found.effective > 500
    assert found.likelihood == pytest.approx(bent.log_likelihood(walkers))
    # along the bend: exp(-x^2 / 2 - x^4 / 2) beyond -1
    x = np.linspace(-1.0, 4.0, 20001)
    density = np.exp(-0.5 * x**2 - 0.5 * x**4)
    mean = np.sum(x * density) / density.sum()
    square = np.sum(x**2 * density) / density.sum()
    assert walkers[:, 0].mean() == pytest.approx(mean, abs=0.08)
    assert (walkers[:, 0] ** 2).mean() == pytest.approx(square, abs=0.06)
    assert np.std(walkers[:, 1] - walkers[:, 0] ** 2) == pytest.approx(0.03, rel=0.15)


def test_what_cannot_be_fitted_is_said():
    with pytest.raises(FitError, match="no flat series states its kV"):
        fit_spectrum([], INSTRUMENT, rng=np.random.default_rng(0))
    nameless = Spectrum(energies_keV=energy_grid_keV(40.0), fluence=np.ones(energy_grid_keV(40.0).size))
    with pytest.raises(InputError, match="each spectrum with a tube voltage of its own"):
        correction_from_spectra([nameless], INSTRUMENT)
    twice = [measured_spectrum(50.0), measured_spectrum(50.0)]
    with pytest.raises(InputError, match="write FILE:kV"):
        correction_from_spectra(twice, INSTRUMENT)


def test_an_unknown_gain_carries_no_weight(model):
    truth = typical(model)
    levels = []
    for item in levels_of(model, truth, BEAMS[:2]):
        wide = Estimate(value=item.gain_DN.value, low=-40.0, high=60.0)
        levels.append(level(item.kV, item.filters, item.rate_DN_per_mAs.value / FACTOR, item.gain_DN.value))
        object.__setattr__(levels[-1], "gain_DN", wide)
        object.__setattr__(levels[-1], "photon_transfer_slope_DN", wide)
    posterior = fit_spectrum(levels, INSTRUMENT, rng=np.random.default_rng(0)).posterior
    assert np.std(posterior.column("log_DN_per_keV")) > 0.2


@pytest.mark.parametrize("ripple", [0.0, 0.11])
def test_a_voltage_that_ripples_is_met_by_its_mean_and_variance_together(model, ripple):
    """Mean and variance of a sine's dip, as far as two voltages tell them; the level at a third one lies in its interval."""
    truth = typical(model, kV_error=0.003 - 0.5 * ripple, kV_variance=ripple**2 / 8.0, inherent_filtration_mm_Al=1.2)
    posterior = fit_spectrum(levels_of(model, truth, BEAMS), INSTRUMENT, rng=np.random.default_rng(8)).posterior
    error, variance = posterior.column("kV_error"), posterior.column("kV_variance")
    # what the voltage lacks in the mean, beyond how well it is set, is its ripple
    own = error + 0.5 * np.sqrt(8.0 * variance)
    assert abs(np.mean(own)) < 0.01 and np.std(own) < 0.012
    assert np.corrcoef(error, variance)[0, 1] < -0.5
    for new in (OpenBeam(kV=60.0, filters=filters_from_text("Cu:0.05")), OpenBeam(kV=90.0, filters=())):
        draws = np.log(model.signal(posterior.samples, new).rate_DN_per_mAs)
        exact = float(np.log(model.signal(truth[None, :], new).rate_DN_per_mAs[0]))
        low, high = np.quantile(draws, [0.025, 0.975])
        assert low < exact < high


COUNTER = Instrument(
    pixel_mm=0.15,
    source_detector_mm=1059.0,
    source_object_mm=990.0,
    counting=True,
    scintillator=filters_from_text("CdTe:1"),
)


def kerma_of(posterior, beam):
    """Median and 95 % interval of a beam's air kerma, uGy a mAs at 1 m."""
    found = model_of_posterior(posterior, highest_kV=beam.kV).signal(posterior.samples, beam)
    return np.quantile(found.kerma_uGy_per_mAs, [0.5, 0.025, 0.975])


def counted(flat):
    """The flat of a counter: a pixel's variance is its mean, whatever neighbours share."""
    return replace(flat, photon_transfer_slope_DN=estimate_from_sd(1.0, 0.005))


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_charge_that_neighbours_share_makes_no_other_spectrum_or_dose(share):
    """Charge of each photon falls on one pixel, or at random on two, each of which counts a part above 20 keV."""
    beams = [OpenBeam(kV=kV, filters=filters_from_text(text)) for kV in (50.0, 80.0, 110.0) for text in ("", "Al:2")]
    tube, energies = SpectralModel(filter_materials=("Al", "Cu")), energy_grid_keV(112.0)
    best = typical(tube, inherent_filtration_mm_Al=1.5)
    stopped = transmission(filters_from_text("CdTe:0.003"), energies) * (
        1.0 - transmission(COUNTER.scintillator, energies)
    )
    above = np.maximum(1.0 - 20.0 / energies, 0.0), np.maximum(1.0 - 40.0 / energies, 0.0)
    counts = stopped * ((1.0 - share) * (energies > 20.0) + share * 2.0 * above[0])
    squares = stopped * ((1.0 - share) * (energies > 20.0) + share * 2.0 * (above[0] + above[1]))
    flats = []
    for beam in beams:
        found = tube.weights(best[None, :], beam)[0]
        photons = np.concatenate([found, np.zeros(energies.size)])[: energies.size]
        mean = float(photons @ counts)
        flats.append(counted(level(beam.kV, beam.filters, mean, float(photons @ squares) / mean)))
    bare = OpenBeam(kV=60.0, filters=())
    posterior = fit_spectrum(flats, replace(COUNTER, threshold_keV=20.0), rng=np.random.default_rng(3)).posterior
    truth = float(tube.signal(best[None, :], bare).kerma_uGy_per_mAs[0])
    _, low, high = kerma_of(posterior, bare)
    assert low < truth < high
    model = model_of_posterior(posterior, highest_kV=110.0)
    weights = model.weights(posterior.samples, bare)
    mean_keV = weights @ model.energies_keV[: weights.shape[1]] / weights.sum(axis=1)
    weights = tube.weights(best[None, :], bare)[0]
    low, high = np.quantile(mean_keV, [0.025, 0.975])
    assert low < weights @ tube.energies_keV[: weights.size] / weights.sum() < high
    assert np.median(posterior.column("shared_charge")) < 0.4 or share > 0.0


def test_the_threshold_of_a_counter_is_found_from_its_flats_and_the_dose_with_it():
    """A sum over energies of its own: photons that the layer stops and that leave more than 20 keV are counted."""
    beams = [
        OpenBeam(kV=kV, filters=filters_from_text(text))
        for kV in (40.0, 70.0, 110.0)
        for text in ("", "Al:2", "Cu:0.05")
    ]
    tube, energies = SpectralModel(filter_materials=("Al", "Cu")), energy_grid_keV(111.0)
    best = typical(tube, inherent_filtration_mm_Al=1.5)
    stopped = transmission(filters_from_text("C:0.5+CdTe:0.003"), energies) * (
        1.0 - transmission(COUNTER.scintillator, energies)
    )
    seen = stopped * (energies > 20.0)

    def photons(beam):
        found = tube.weights(best[None, :], beam)[0]
        return np.concatenate([found, np.zeros(energies.size)])[: energies.size]

    flats = [counted(level(beam.kV, beam.filters, float(photons(beam) @ seen), 1.0)) for beam in beams]
    bare = OpenBeam(kV=60.0, filters=())
    truth = float(tube.signal(best[None, :], bare).kerma_uGy_per_mAs[0])
    posterior = fit_spectrum(flats, COUNTER, rng=np.random.default_rng(3)).posterior
    low, high = np.quantile(posterior.column("threshold_keV"), [0.025, 0.975])
    assert low - 0.5 < 20.0 < high + 0.5
    assert high - low < 4.0
    _, low, high = kerma_of(posterior, bare)
    assert low < truth < high


def test_a_cover_that_nobody_declares_widens_the_dose_and_one_declared_does_not(model):
    beams = [OpenBeam(kV=kV, filters=filters_from_text(text)) for kV in (40.0, 70.0, 110.0) for text in ("", "Al:2")]
    cover = filters_from_text("Al:0.5")
    covered = SpectralModel(cover=cover, filter_materials=("Al", "Cu"))
    best = typical(covered, inherent_filtration_mm_Al=0.3)
    flats, bare = levels_of(covered, best, beams, np.random.default_rng(5)), OpenBeam(kV=60.0, filters=())
    truth = float(covered.signal(best[None, :], bare).kerma_uGy_per_mAs[0])
    width = {}
    for declared in (None, cover):
        instrument = replace(INSTRUMENT, detector_cover=declared)
        _, low, high = kerma_of(fit_spectrum(flats, instrument, rng=np.random.default_rng(6)).posterior, bare)
        assert low < truth < high
        width[declared] = math.log(high / low)
    assert width[cover] < 0.9 * width[None]


@pytest.mark.parametrize(("wanted", "taken"), [(-200.0, -6.0), (3.0, 3.0), (40.0, 6.0)])
def test_derivatives_are_taken_no_farther_than_where_the_model_has_numbers(wanted, taken):
    posterior = SimpleNamespace(about=np.zeros(2), _conditional=lambda u: (None, np.full((len(u), 2), wanted)))
    draws, weight = np.zeros((8, 3)), np.full(8, 0.125)
    Posterior.relinearise(posterior, draws, weight, np.random.default_rng(0))
    np.testing.assert_array_equal(posterior.about, [taken, taken])

"""The catalogue of effects: what each strength means, where each acts, and samples against expectation for all."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from scipy.optimize import brentq
from scipy.signal import fftconvolve

from raytwin.acquisition.setting import Filter, filters_from_text, setting_from_text
from raytwin.errors import InputError
from raytwin.generator.effects import EFFECTS, AppliedEffect, Parameter, effect_of, in_order
from raytwin.generator.effects._light_spread import spread_transfer
from raytwin.generator.effects.crosstalk import leaving_share
from raytwin.generator.effects.effect import Grid, Shows, Variation
from raytwin.generator.effects.focal_spot import _transfer_of_spot
from raytwin.generator.effects.k_fluorescence import line_energy_keV
from raytwin.generator.effects.misregistration import angles_of, parts_px
from raytwin.generator.frames._distortion import displacement_px, distorted
from raytwin.generator.frames.conditions import beam_conditions, session_conditions, with_conditions
from raytwin.generator.frames.defects import tile_gain
from raytwin.generator.frames.line_model import LineMemory, LineModel
from raytwin.generator.frames.model_cache import ModelCache
from raytwin.generator.frames.response import light_of, responded
from raytwin.generator.line.line_state import STAGES, LineState
from raytwin.generator.line.rounding import rounded_variance, variance_before_rounding, variance_kept_by_means
from raytwin.generator.line.series_request import SeriesRequest
from raytwin.generator.line.spectral_signal import OpenBeam
from raytwin.generator.predictions.predict import spectral_model_of
from raytwin.generator.spread.psf import blur_variance_share
from raytwin.materials import material_from_name, mu_per_mm

SHAPE = (40, 40)
MEASURED = "kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05"
SOFT = "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05"
# the catalogue of the project: id -> unit and plausible range of the strength
CATALOGUE = {
    "object_scatter": ("%", 1, 50),
    "veiling_glare": ("%", 0.5, 5),
    "focal_spot": ("mm", 0.05, 1.5),
    "mtf_tail": ("%", 2, 40),
    "k_fluorescence": ("%", 5, 40),
    "image_lag": ("%", 0.02, 5),
    "nonlinearity": ("%", 0.3, 5),
    "dark_drift": ("DN", 1, 100),
    "output_drift": ("%", 0.1, 3),
    "kv_error": ("%", 0.5, 5),
    "filtration_error": ("mm Al", 0.03, 1),
    "heel": ("%", 1, 20),
    "row_noise": ("read-noise sigmas", 0.05, 2),
    "bad_pixels": ("%", 0.02, 2),
    "excess_noise": ("%", 3, 100),
    "quantisation": ("DN", 2, 64),
    "motion_blur": ("px", 0.5, 10),
    "misregistration": ("px", 0.1, 3),
    "gain_map_error": ("%", 0.1, 3),
    "tile_gain": ("%", 0.2, 3),
    "composition_error": ("%", 0.5, 5),
    "crosstalk": ("%", 3, 40),
    "line_flicker": ("%", 0.03, 1),
    "grey_absorber": ("%", 0.5, 60),
    "dropped_frames": ("%", 0.5, 30),
    "off_focal": ("%", 2, 20),
    "random_telegraph": ("%", 0.1, 10),
    "burn_in": ("%", 0.05, 5),
    "pile_up": ("ns", 10, 1000),
    "threshold_error": ("keV", 0.2, 8),
}
CACHE = ModelCache()


def request(kind="flat", setting=MEASURED, **changes):
    parsed = None if setting is None else setting_from_text(setting)
    values = {
        "kind": kind,
        "setting": parsed,
        "frames": 10,
        "exposure_ms": 20.0 if parsed is None else parsed.exposure_ms,
        "frame_interval_ms": 22.0,
        "source_object_mm": 700.0,
        "source_detector_mm": 1059.0,
    }
    return SeriesRequest(**{**values, **changes})


def make_product():
    row, column = np.indices(SHAPE)
    radius = np.hypot(row - 20, column - 20)
    return {
        "water_liquid": 20 * np.sqrt(np.clip(1 - (radius / 16) ** 2, 0, None)),
        "Al": np.where((column > 24) & (row > 12), 3.0, 0.0),
    }


PRODUCT = make_product()
BEHIND = {"kind": "object", "thickness_mm": PRODUCT}


def applied(name, strength=None, since=None, options=None, **parameters):
    effect = EFFECTS[name]
    usual = "calibration" if effect.after_calibration else "always"
    value = effect.strength.default if strength is None else strength
    return (
        AppliedEffect(
            id=name, parameters={"strength": value, **parameters}, since=since or usual, options=options or {}
        ),
    )


def state_with(bends):
    """A state with a bent response."""
    one = np.ones((1, 1))
    return LineState(parameters=None, signal_DN=one, variance_DN2=one, flat_factor=one, bends=bends)


COUNTERS = {}


@pytest.fixture(autouse=True, scope="module")
def counters(as_counter):
    """How a line is made a counter."""
    COUNTERS["made"] = as_counter


def line_for(line, effects):
    """The line, as a counter where only counters can have an effect."""
    return COUNTERS["made"](line) if any("counting" in EFFECTS[item.id].needs for item in effects) else line


def expect(line, asked, effects=(), cache=CACHE):
    return LineModel(line_for(line, effects), effects=effects, cache=cache).expect(asked)


# ------------------------------------------------------------------------------------------------ the catalogue


def test_the_catalogue_is_whole_and_its_strengths_have_the_stated_units_and_ranges():
    assert set(EFFECTS) == set(CATALOGUE)
    for name, (unit, low, high) in CATALOGUE.items():
        strength = EFFECTS[name].strength
        assert (strength.name, strength.unit, strength.low, strength.high) == ("strength", unit, low, high), name


@pytest.mark.parametrize("name", EFFECTS)
def test_every_entry_says_what_it_is_and_where_it_comes_from(name):
    effect = EFFECTS[name]
    assert effect.title and effect.reference and effect.stage in STAGES
    assert len({item.name for item in effect.parameters}) == len(effect.parameters)
    assert all(item.source for item in effect.parameters)


def numbers(found):
    """All that an expectation holds, one vector of standardised size."""
    parts = [
        found.mean_DN / 100,
        found.quantum_variance_DN2 / 100,
        found.white_variance_DN2 / 100,
        found.noise_autocovariance,
        np.array(
            [
                found.row_variance_DN2,
                found.column_variance_DN2,
                found.bad_pixel_share,
                0.0 if found.gain_pattern is None else found.gain_pattern.rms,
                0.0 if found.tile_pattern is None else found.tile_pattern.rms,
                found.repeated_share,
            ]
        ),
        np.zeros(3)
        if found.telegraph is None
        else found.telegraph.share
        * 100
        * np.array([1.0, found.telegraph.amplitude_reads, found.telegraph.stay_exposures]),
        np.zeros(3)
        if found.flicker is None
        else found.flicker.rms * 1000 * np.array([1.0, found.flicker.column_share, found.flicker.correlation(1)]),
        np.array([found.frame_factor_rms * 100]),
        found.temporal_correlation * 100,
        *[image[..., None] * course / 10 for image, course in found.trend_DN or ()],
    ]
    return np.concatenate([np.ravel(part) for part in parts])


LATER = {
    "previous": (request(frames=30),),
    "start_s": 0.7,
}


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("asked", [request(**BEHIND, **LATER), request(**LATER), request("dark", setting=None)])
def test_strength_zero_is_no_effect_at_all(series_line, name, asked):
    line = line_for(series_line, applied(name))
    none = expect(line, asked)
    zero = expect(line, asked, applied(name, 0.0))
    np.testing.assert_array_equal(numbers(zero), numbers(none))


@pytest.mark.parametrize("name", [name for name in EFFECTS if name != "quantisation"])
def test_effects_are_smooth_in_every_fitted_parameter(series_line, name):
    """Central differences of step h and h/2 agree: a fit may use them."""
    asked = request(**BEHIND, **LATER)
    effect = EFFECTS[name]
    for item in (entry for entry in effect.parameters if entry.fitted):
        centre = math.sqrt(item.low * item.high) if item.log else item.default or 0.3 * item.high
        step = 0.02 * centre

        def slope(size, item=item, centre=centre):
            ends = [
                numbers(expect(series_line, asked, applied(name, **{item.name: centre + sign * size})))
                for sign in (1, -1)
            ]
            return (ends[0] - ends[1]) / (2 * size)

        coarse, fine = slope(step), slope(step / 2)
        scale = np.linalg.norm(fine)
        assert scale > 0 or item.name != "strength"
        # rounding of single precision in the projection leaves 1e-6 of 100 DN
        assert np.linalg.norm(coarse - fine) < 0.01 * scale + 1e-3 / abs(step), item.name


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_came_after_calibration_leaves_the_calibrating_series_alone(series_line, name):
    before = request(**BEHIND, after_calibration=False)
    effect = applied(name, since="calibration")
    line = line_for(series_line, effect)
    np.testing.assert_array_equal(numbers(expect(line, before, effect)), numbers(expect(line, before)))


def test_the_order_in_which_effects_are_given_does_not_matter(series_line):
    asked = request(**BEHIND)
    effects = applied("object_scatter") + applied("nonlinearity") + applied("kv_error") + applied("mtf_tail")
    one, other = expect(series_line, asked, effects), expect(series_line, asked, effects[::-1])
    np.testing.assert_array_equal(numbers(one), numbers(other))
    stages = [STAGES.index(entry.stage) for _, entry, _ in in_order(effects)]
    assert stages == sorted(stages)


@pytest.mark.parametrize("name", EFFECTS)
def test_samples_have_the_expected_mean_variance_and_covariance(series_line, name):
    """Strength at the top of its range; expected and sampled read one state, and this shows that both read all of it."""
    earlier = request(frames=50)
    asked = request(**BEHIND, frames=300, start_s=1.2, previous=(earlier,))
    effects = applied(name, EFFECTS[name].strength.high)
    expected = expect(series_line, asked, effects)
    rng = np.random.default_rng(7)
    frames = np.stack(
        list(
            LineModel(line_for(series_line, effects), effects=effects, cache=CACHE).sample(asked, rng=rng, memory=None)
        )
    ).astype(np.float64)
    residual = frames - expected.mean_DN
    for image, course in expected.trend_DN or ():
        residual = residual - course[:, None, None] * image
    if name == "dropped_frames":
        copies = np.all(frames[1:] == frames[:-1], axis=(1, 2))
        share = expected.repeated_share
        assert share == pytest.approx(EFFECTS[name].strength.high / 100)
        assert abs(copies.mean() - share) < 4 * math.sqrt(share * (1 - share) / copies.size)
        # what is left is a series like any other
        frames = frames[np.concatenate([[True], ~copies])]
        residual = frames - expected.mean_DN
        count = len(frames)
    quantum = expected.quantum_variance_DN2
    lines = expected.row_variance_DN2 + expected.column_variance_DN2
    common = expected.frame_factor_rms**2 * expected.signal_DN**2
    flicker = expected.flicker
    light = np.zeros(SHAPE) if flicker is None else flicker.rms * expected.signal_DN
    variance = quantum + expected.white_variance_DN2 + lines + common + light**2
    count = len(frames)
    good = np.ones(SHAPE, dtype=bool)
    if name == "bad_pixels":
        good = np.abs(residual.mean(axis=0)) < 6 * np.sqrt(variance / count)
        share = 1 - good.mean()
        assert abs(share - expected.bad_pixel_share) < 4 * math.sqrt(8 * expected.bad_pixel_share / good.size)
    if name == "random_telegraph":
        electronic = series_line.maps.read_variance_DN2 - 1.0 / 12.0
        height = expected.telegraph.amplitude_reads * np.sqrt(electronic)
        good = np.abs(residual.mean(axis=0)) < 0.25 * height
        share = 1 - good.mean()
        assert abs(share - expected.telegraph.share) < 4 * math.sqrt(expected.telegraph.share / good.size)
        # half of the time they are up; a stay of m exposures correlates them over m / 2, and 1 / m of the steps are jumps
        stay = expected.telegraph.stay_exposures
        up = (residual / height)[:, ~good]
        jumps = 0.5 * (np.diff(up, axis=0) ** 2).mean() - (variance / height**2)[~good].mean()
        assert abs(up.mean() - 0.5) < 4 * 0.5 / math.sqrt(up.size / stay)
        assert abs(jumps - 0.5 / stay) < 4 * 0.5 / stay / math.sqrt(up.size / stay) + 0.02
    if name == "gain_map_error":
        pattern = residual.mean(axis=0) / expected.signal_DN
        assert pattern.std() == pytest.approx(expected.gain_pattern.rms, rel=4 / math.sqrt(2 * good.size) + 0.02)
        residual = residual - residual.mean(axis=0)
    if name == "tile_gain":
        residual = residual - expected.signal_DN * (tile_gain(expected.tile_pattern, SHAPE) - 1.0)
    if name == "output_drift":
        factor = (residual / expected.signal_DN).mean(axis=(1, 2))
        rho = expected.frame_factor_correlation
        independent = count * (1 - rho[1]) / (1 + rho[1])
        assert abs(factor.std() / expected.frame_factor_rms - 1) < 4 / math.sqrt(2 * independent)
        residual = residual - factor[:, None, None] * expected.signal_DN
        # the tube's mean output during these frames moves their variance along
        variance = variance - common + factor.mean() * quantum
        quantum = (1 + factor.mean()) * quantum
    spread = residual - residual.mean(axis=0)
    independent = good.sum() / 4  # neighbours share noise; rows share theirs
    if name == "row_noise":
        independent = SHAPE[0]
    if name == "line_flicker":
        independent = SHAPE[0] * (1 - flicker.correlation(1)) / (1 + flicker.correlation(1))
    if name not in ("gain_map_error", "output_drift"):
        z = residual.mean(axis=0) / np.sqrt(variance / count)
        if name == "image_lag":
            z = z / math.sqrt(1 + 2 * expected.temporal_correlation.sum())
        assert abs(z[good].std() - 1) < 4 / math.sqrt(2 * independent) + 0.01
        assert abs(z[good].mean()) < 4 / math.sqrt(independent)
    ratio = (spread**2).sum(axis=0) / (count - 1) / variance
    assert abs(ratio[good].mean() - 1) < 4 * math.sqrt(2 / (count - 1) / independent)
    for down, right in ((0, 1), (1, 0)):
        left, beside = np.s_[: 40 - down, : 40 - right], np.s_[down:, right:]
        seen = (spread[:, *left] * spread[:, *beside]).mean(axis=0) * count / (count - 1)
        known = np.sqrt(quantum[left] * quantum[beside]) * expected.noise_autocovariance[down, right]
        known = known + (expected.row_variance_DN2 if right else expected.column_variance_DN2)
        known = known + light[left] * light[beside] * (1.0 if flicker is None else flicker.correlation(down))
        size = np.sqrt(variance[left] * variance[beside])
        pair = good[left] & good[beside]
        bias = 0.004 if name == "gain_map_error" else 0.0  # eta^2 of the variance
        assert abs(((seen - known) / size)[pair].mean()) < 4 / math.sqrt(count * independent) + bias
    between = (spread[1:] * spread[:-1]).mean(axis=0)
    known = expected.temporal_correlation[0] * quantum
    assert abs(((between - known) / variance)[good].mean() + 1 / count) < 4 / math.sqrt(count * independent) + 1 / count


# ------------------------------------------------------------------------------------------------ scatter and glare


def water_slab(line, strength, source_object_mm=None, width=50.0, **parameters):
    asked = request(
        "object",
        thickness_mm={"water_liquid": np.full(SHAPE, 20.0)},
        source_object_mm=source_object_mm or line.instrument.source_object_mm,
    )
    primary = expect(line, asked).signal_DN
    both = expect(line, asked, applied("object_scatter", strength, width_mm=width, **parameters)).signal_DN
    return (both - primary) / primary


@pytest.mark.parametrize("width", [10.0, 50.0, 300.0])
def test_scatter_over_primary_behind_20_mm_of_water_is_the_strength_at_the_field_s_centre(series_line, width):
    ratio = water_slab(series_line, 20.0, width=width, energy_exponent=0.0)
    assert ratio[19:21, 19:21].mean() == pytest.approx(0.20, rel=0.005)
    assert ratio[0, 0] < ratio[19, 19]


def test_scatter_falls_with_the_air_gap_and_adds_its_own_quanta(series_line):
    near, far = (water_slab(series_line, 20.0, mm, width=10.0)[20, 20] for mm in (990.0, 500.0))
    assert far < 0.2 * near
    asked = request("object", thickness_mm={"water_liquid": np.full(SHAPE, 20.0)})
    base, more = expect(series_line, asked), expect(series_line, asked, applied("object_scatter", 20.0))
    np.testing.assert_allclose(
        more.quantum_variance_DN2 / base.quantum_variance_DN2, more.signal_DN / base.signal_DN, rtol=1e-6
    )


def test_scatter_of_a_harder_beam_follows_the_exponent(series_line):
    soft, hard, reference = (
        water_slab(series_line, 20.0, energy_exponent=exponent)[20, 20] for exponent in (-0.5, 0.5, 0.0)
    )
    assert soft * hard == pytest.approx(reference**2, rel=1e-6)
    assert abs(soft / hard - 1.0) > 0.01


@pytest.mark.parametrize("width", [20.0, 300.0])
def test_scatter_into_water_s_own_directions_has_its_strength_too_and_gathers_in_the_middle(series_line, width):
    alike, own = (
        water_slab(series_line, 20.0, width=width, energy_exponent=0.0, own_directions=share) for share in (0.0, 1.0)
    )
    assert own[19:21, 19:21].mean() == pytest.approx(0.20, rel=0.005)
    assert own[0, 0] < alike[0, 0]


def test_harder_beams_scatter_more_forward_over_an_air_gap(series_line):
    def falls_off(setting, **parameters):
        asked = request("object", setting=setting, thickness_mm={"water_liquid": np.full(SHAPE, 20.0)})
        primary = expect(series_line, asked).signal_DN
        ratio = expect(series_line, asked, applied("object_scatter", 20.0, **parameters)).signal_DN / primary - 1.0
        return ratio[0, 0] / ratio[19, 19]

    assert falls_off(SOFT) == pytest.approx(falls_off(MEASURED), rel=1e-3)
    assert falls_off(SOFT, own_directions=1.0) > 1.002 * falls_off(MEASURED, own_directions=1.0)


def test_a_session_s_strength_is_that_at_the_middle_of_its_beams(series_line):
    slab = {"water_liquid": np.full(SHAPE, 20.0)}
    usual_mm = series_line.instrument.source_object_mm
    beams = [
        request("object", setting=setting, thickness_mm=slab, source_object_mm=usual_mm) for setting in (SOFT, MEASURED)
    ]
    found = beam_conditions(series_line, [*beams, beams[0], request("dark", setting=None)])
    (effect,) = applied("object_scatter", 20.0, energy_exponent=-0.6)
    scatter = (with_conditions(effect, found),)
    ratios = [
        (expect(series_line, asked, scatter).signal_DN / expect(series_line, asked).signal_DN - 1.0)[
            19:21, 19:21
        ].mean()
        for asked in beams
    ]
    assert math.sqrt(ratios[0] * ratios[1]) == pytest.approx(0.20, rel=0.005)
    assert 20.0 < found["reference_keV"] < 60.0
    assert beam_conditions(series_line, [request("dark", setting=None)]) == {}


def test_scatter_of_the_same_width_at_any_gap_is_as_strong_there(series_line):
    near, far = (water_slab(series_line, 20.0, mm, gap_exponent=0.0)[20, 20] for mm in (990.0, 500.0))
    assert near == pytest.approx(far, rel=1e-6)


@pytest.mark.parametrize("own", [0.0, 1.0])
def test_where_the_beam_goes_on_beyond_the_detector_an_even_slab_scatters_alike_everywhere(series_line, own):
    ratio = water_slab(series_line, 20.0, energy_exponent=0.0, beyond=1.0, own_directions=own)
    np.testing.assert_allclose(ratio, 0.20, rtol=0.005)


def test_what_scatters_beyond_the_borders_is_what_stands_at_them(series_line):
    water_mm = np.tile(30.0 * np.linspace(0, 1, SHAPE[1]) ** 2, (SHAPE[0], 1))
    usual_mm = series_line.instrument.source_object_mm
    asked = request("object", thickness_mm={"water_liquid": water_mm}, source_object_mm=usual_mm)
    primary, beam = expect(series_line, asked).signal_DN, expect(series_line, request()).signal_DN
    height_mm, around = 3.0, 20_000
    scatter = applied("object_scatter", 20.0, width_mm=1.533 * height_mm, beyond=1.0)
    scattered = (expect(series_line, asked, scatter).signal_DN - primary) / beam
    # along lines that are alike the kernel is the angle under which a pixel is seen
    source = np.pad((primary * np.log(beam / primary)).mean(axis=0), around, mode="edge")
    place_mm = series_line.instrument.pixel_mm * np.arange(-around, around + 1)
    spread = fftconvolve(source, 1.0 / (height_mm**2 + place_mm**2), mode="same")[around:-around]
    found = scattered.mean(axis=0)
    np.testing.assert_allclose(found / found.mean(), spread / spread.mean(), rtol=0.02)


def test_without_an_albedo_of_its_own_a_metal_scatters_as_much_as_it_attenuates(series_line):
    asked = request(kind="object", thickness_mm={"Fe": np.full(SHAPE, 0.3)})
    beam, primary = expect(series_line, request()).signal_DN, expect(series_line, asked).signal_DN
    scattered = expect(series_line, asked, applied("object_scatter", 20.0, own_albedo=0.0)).signal_DN - primary
    slab = request(kind="object", thickness_mm={"water_liquid": np.full(SHAPE, 20.0)})
    behind = expect(series_line, slab).signal_DN
    of_water = expect(series_line, slab, applied("object_scatter", 20.0, own_albedo=0.0)).signal_DN - behind
    np.testing.assert_allclose(
        scattered / (primary * np.log(beam / primary)), of_water / (behind * np.log(beam / behind)), rtol=1e-5
    )


@pytest.mark.parametrize(("order", "law"), [(0.5, "exponential"), (1.0, "Lorentzian"), (1e4, "Gaussian")])
def test_a_spread_s_order_is_its_shape(order, law):
    f = np.linspace(0.0, 0.5, 11)
    x = (2 * np.pi * 1.3 * f) ** 2
    found = spread_transfer(f, 0.0 * f, reach_px=1.3, order=order, usual_order=order)
    closed = {"exponential": (1 + x) ** -0.5, "Lorentzian": 1 / (1 + x)}
    if law in closed:
        np.testing.assert_allclose(found, closed[law], rtol=1e-12)
    else:
        same = spread_transfer(f, 0.0 * f, reach_px=1.3, order=order, usual_order=1.0)
        np.testing.assert_allclose(same, np.exp(-x), rtol=1e-2, atol=1e-6)


def test_there_is_no_scatter_without_an_object(series_line):
    asked = request()
    found = expect(series_line, asked, applied("object_scatter", 50.0))
    np.testing.assert_array_equal(found.mean_DN, expect(series_line, asked).mean_DN)


def test_an_opaque_plate_scatters_next_to_nothing_whatever_its_border_s_pixels_let_through(series_line):
    plate = np.zeros(SHAPE)
    plate[:, 20:] = 5.0
    plate[:, 19] = 2.0  # the border cuts these pixels
    asked = request(kind="object", thickness_mm={"W": plate})
    extra = expect(series_line, asked, applied("object_scatter", 20.0)).signal_DN
    extra = extra - expect(series_line, asked).signal_DN
    open_DN = float(np.max(expect(series_line, request()).signal_DN))
    slab = request(kind="object", thickness_mm={"water_liquid": np.full(SHAPE, 20.0)})
    of_water = (
        expect(series_line, slab, applied("object_scatter", 20.0)).signal_DN - expect(series_line, slab).signal_DN
    )
    assert float(of_water.min()) > 0.003 * open_DN
    assert float(np.abs(extra).max()) < 1e-3 * float(of_water.max())


def test_a_metal_scatters_less_than_water_that_attenuates_as_much(series_line):
    beam = expect(series_line, request()).signal_DN

    def behind(material, length_mm):
        asked = request(kind="object", thickness_mm={material: np.full(SHAPE, length_mm)})
        primary = expect(series_line, asked).signal_DN
        more = expect(series_line, asked, applied("object_scatter", 20.0)).signal_DN - primary
        return float(-np.log(primary / beam).mean()), float((more / primary).mean())

    water_depth, of_water = behind("water_liquid", 20.0)
    steel_depth, of_steel = behind("Fe", 0.3)
    assert of_steel / steel_depth < 0.3 * of_water / water_depth


def test_scatter_without_a_known_gap_is_refused(series_line):
    nowhere = replace(series_line, instrument=replace(series_line.instrument, source_object_mm=None))
    asked = request(**BEHIND, source_object_mm=None)
    with pytest.raises(InputError, match=r"source_object_mm: got unknown; .*object_scatter"):
        expect(nowhere, asked, applied("object_scatter"))


def disc(radius=8):
    row, column = np.indices(SHAPE)
    return {"W": np.where(np.hypot(row - 20, column - 20) <= radius, 2.0, 0.0)}


def test_glare_fills_opaque_shadows_whatever_the_gap_and_leaves_flats_alone(series_line):
    effect = applied("veiling_glare", 4.0, length_mm=2.0)
    flat = expect(series_line, request())
    np.testing.assert_allclose(expect(series_line, request(), effect).mean_DN, flat.mean_DN, rtol=1e-9)
    centres = []
    for distance in (500.0, 990.0):
        asked = request("object", thickness_mm=disc(), source_object_mm=distance)
        ratio = (expect(series_line, asked, effect).signal_DN - expect(series_line, asked).signal_DN) / flat.signal_DN
        centres.append(ratio[20, 20])
    assert centres[0] == pytest.approx(centres[1], rel=1e-9)
    # a disc of radius a takes the share 1 - exp(-a / L) of the glare of an even field away
    # the spread of light reaches the centre of the disc nowhere else
    outside = math.exp(-8.5 * 0.15 / 2.0)
    assert centres[0] == pytest.approx(0.04 * outside, rel=0.05)


def test_glare_of_the_whole_panel_adds_the_mean_everywhere(series_line):
    asked = request("object", thickness_mm=disc())
    flat = expect(series_line, request()).signal_DN  # the pixels' own gains act on what they receive
    bare = expect(series_line, asked).signal_DN / flat
    lit = expect(series_line, asked, applied("veiling_glare", 4.0, even_share=1.0)).signal_DN / flat
    np.testing.assert_allclose(lit, 0.96 * bare + 0.04 * bare.mean(), atol=1e-4)


@pytest.mark.parametrize(
    ("turn_deg", "covers"),
    [
        (180.0, lambda row, column: np.abs(row) < 0.2),
        (90.0, lambda row, column: (row > -0.2) & (column > -0.2)),
        (270.0, lambda row, column: (row > -0.2) & (column < 0.2)),
    ],
)
def test_an_absorber_lies_between_its_two_borders(series_line, turn_deg, covers):
    effect = applied(
        "grey_absorber",
        10.0,
        direction_deg=0.0,
        border=-0.2,
        turn_deg=turn_deg,
        second_border=-0.2,
        penumbra=0.004,
    )
    asked = request(after_calibration=True)
    passed = expect(series_line, asked, effect).signal_DN / expect(series_line, asked).signal_DN
    row, column = np.meshgrid(*(np.linspace(-0.5, 0.5, side) for side in SHAPE), indexing="ij")
    away = (np.abs(np.abs(row) - 0.2) > 0.1) & (np.abs(np.abs(column) - 0.2) > 0.1)
    np.testing.assert_allclose(passed[away], np.where(covers(row, column), 0.9, 1.0)[away], atol=2e-3)


@pytest.mark.parametrize("share", [0.4, 1.0])
def test_glare_of_scattered_x_rays_makes_the_same_picture_and_moves_the_noise_with_it(series_line, share):
    asked = request("object", thickness_mm=disc())
    light = expect(series_line, asked, applied("veiling_glare", 4.0, length_mm=2.0))
    found = expect(series_line, asked, applied("veiling_glare", 4.0, length_mm=2.0, xray_share=share))
    np.testing.assert_allclose(found.signal_DN, light.signal_DN, atol=1e-3 * light.signal_DN.max())
    flat, stays = (
        float(np.mean(expect(series_line, request(), *effects).quantum_variance_DN2))
        for effects in ((), [applied("veiling_glare", 4.0, length_mm=2.0, xray_share=share)])
    )
    assert stays / flat == pytest.approx((1.0 - 0.04 * (1.0 - share)) ** 2, rel=5e-3)
    # in the middle of the shadow each DN that was scattered there has the noise of a DN of the beam
    shadow, beam = (np.asarray(found.signal_DN)[20, place] for place in (20, 2))
    in_shadow, in_beam = (np.asarray(found.quantum_variance_DN2)[20, place] for place in (20, 2))
    scattered = in_shadow / in_beam * beam / shadow
    assert scattered == pytest.approx(share, rel=0.15)


def test_a_smaller_disc_lets_more_glare_into_its_middle(series_line):
    effect = applied("veiling_glare", 4.0, length_mm=2.0)
    small, large = (
        expect(series_line, request("object", thickness_mm=disc(radius)), effect).signal_DN[20, 20]
        for radius in (5, 12)
    )
    assert small > large


def test_glare_lowers_the_noise_by_the_square_of_what_stays(series_line):
    found = expect(series_line, request(), applied("veiling_glare", 5.0, length_mm=10.0))
    base = expect(series_line, request())
    ratio = found.quantum_variance_DN2 / base.quantum_variance_DN2
    np.testing.assert_allclose(ratio, 0.95**2, rtol=0.01)


# ------------------------------------------------------------------------------------------------ sharpness


def ripple(axis, order):
    """A plate with a weak cosine of `order` half periods across the field: blur lowers its height by the transfer."""
    place = (np.indices(SHAPE)[axis] + 0.5) / 40
    return {"water_liquid": 10.0 + 0.05 * np.cos(np.pi * order * place)}


def transfer(line, asked, effects, axis):
    """Height of the ripple with effects over that without, and its frequency in cycles per pixel."""
    order = 12
    heights = []
    for chosen in (effects, ()):
        plate = replace(asked, thickness_mm=ripple(axis, order))
        picture = expect(line, plate, chosen).signal_DN / expect(line, replace(asked, thickness_mm=None)).signal_DN
        wave = np.cos(np.pi * order * (np.indices(SHAPE)[axis] + 0.5) / 40)
        heights.append(float((picture * wave).mean()))
    return heights[0] / heights[1], order / 80


@pytest.mark.parametrize("source_object_mm", [990.0, 700.0, 530.0])
def test_the_focal_spot_blurs_by_a_times_magnification_less_one(series_line, source_object_mm):
    size_mm = 0.3
    asked = request("object", source_object_mm=source_object_mm)
    for axis in (0, 1):
        found, frequency = transfer(series_line, asked, applied("focal_spot", size_mm), axis)
        sigma_px = size_mm * (1059.0 / source_object_mm - 1.0) / 0.15 / 2.3548
        assert found == pytest.approx(math.exp(-2 * (math.pi * sigma_px * frequency) ** 2), rel=1e-3)


def test_the_focal_spot_that_the_instrument_states_blurs_objects_and_a_larger_one_adds_its_variance(series_line):
    stated = replace(series_line, instrument=replace(series_line.instrument, focal_spot_mm=0.4))
    asked = request("object", source_object_mm=700.0)
    order, place = 12, (np.indices(SHAPE)[0] + 0.5) / 40
    plate = replace(asked, thickness_mm=ripple(0, order))
    wave = np.cos(np.pi * order * place)
    flats = [expect(line, replace(asked, thickness_mm=None)).signal_DN for line in (series_line, stated)]
    np.testing.assert_array_equal(*flats)  # the open beam knows no spot
    heights = {
        (line is stated, size_mm): float(
            np.mean(wave * expect(line, plate, applied("focal_spot", size_mm)).signal_DN / flat)
        )
        for line, flat in zip((series_line, stated), flats, strict=True)
        for size_mm in (0.0, 0.3)
    }
    for size_mm, width_mm in ((0.0, 0.4), (0.3, 0.5)):
        sigma_px = width_mm * (1059.0 / 700.0 - 1.0) / 0.15 / 2.3548
        expected = math.exp(-2 * (math.pi * sigma_px * order / 80) ** 2)
        assert heights[True, size_mm] / heights[False, 0.0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("exposure_ms", [20, 50])
def test_the_belt_that_a_series_states_blurs_what_lies_on_it_along_its_axis(series_line, exposure_ms):
    """A wave loses sinc(path f); of a TDI detector the path is that of one stage; the open beam knows no belt."""
    order, place = 12, (np.indices(SHAPE)[0] + 0.5) / 40
    wave = np.cos(np.pi * order * place)
    setting = MEASURED.replace("exposure_ms=20", f"exposure_ms={exposure_ms}")
    still = request("object", setting, source_object_mm=700.0)
    moving = replace(still, belt_speed_mm_s=12.0)
    tdi = replace(series_line, instrument=replace(series_line.instrument, detector="tdi", tdi_stages=4))
    np.testing.assert_array_equal(*(expect(series_line, one).signal_DN for one in (still, moving)))

    def height(line, asked):
        open_DN = expect(line, asked).signal_DN
        return float(np.mean(wave * expect(line, replace(asked, thickness_mm=ripple(0, order))).signal_DN / open_DN))

    path_px = 12.0 * 1059.0 / 700.0 * exposure_ms / 1000.0 / 0.15
    before = height(series_line, still)
    assert height(series_line, moving) / before == pytest.approx(np.sinc(path_px * order / 80), rel=1e-3)
    assert height(series_line, replace(moving, belt_axis="column")) == pytest.approx(before, rel=1e-6)
    assert height(tdi, moving) / height(tdi, still) == pytest.approx(np.sinc(path_px / 4 * order / 80), rel=1e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_motion_blurs_along_the_belt_in_proportion_to_the_exposure(series_line, axis):
    for exposure_ms in (20, 50):
        setting = f"kv=90,power_w=45,exposure_ms={exposure_ms},filter=Cu:0.05"
        for along in (0, 1):
            asked = request("object", setting=setting, belt_axis=("row", "column")[axis], source_object_mm=990.0)
            found, frequency = transfer(series_line, asked, applied("motion_blur", 4.0), along)
            length = 4.0 * exposure_ms / 50.0 if along == axis else 0.0
            assert found == pytest.approx(float(np.sinc(length * frequency)), rel=1e-3)


@pytest.mark.parametrize(("power", "length_px"), [(0.0, 4.0), (0.5, 4.0 * 0.4**0.5)])
def test_a_vibration_goes_as_far_in_a_short_exposure_as_in_a_long_one(series_line, power, length_px):
    asked = request("object", setting="kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05", source_object_mm=990.0)
    found, frequency = transfer(series_line, asked, applied("motion_blur", 4.0, exposure_power=power), 0)
    assert found == pytest.approx(float(np.sinc(length_px * frequency)), rel=1e-3)


@pytest.mark.parametrize("uneven", [-0.7, 0.3, 1.0])
def test_an_object_that_moves_unevenly_is_the_mean_of_where_it_stands(series_line, uneven):
    """Pictures of the object, displaced from place to place, averaged over the exposure."""
    plate = {"Al": np.where(np.indices(SHAPE)[0] < 20, 8.0, 0.0)}
    asked = request("object", setting="kv=90,power_w=45,exposure_ms=50,filter=Cu:0.05", thickness_mm=plate)
    asked = replace(asked, source_object_mm=990.0)
    found = expect(series_line, asked, applied("motion_blur", 6.0, acceleration=uneven)).signal_DN
    time = (np.arange(60) + 0.5) / 60
    places = 6.0 * (time + uneven * (time**2 - time))
    places -= places.mean()
    stood = np.mean([expect(series_line, replace(asked, displacement_px=(d, 0.0))).signal_DN for d in places], axis=0)
    even = expect(series_line, asked, applied("motion_blur", 6.0)).signal_DN
    inside, step = slice(10, 30), float(np.ptp(stood))
    assert np.abs(found - stood)[inside].max() < 4e-3 * step
    assert np.abs(even - stood)[inside].max() > 0.015 * step


@pytest.mark.parametrize("axis", ["row", "column"])
def test_exposures_that_start_as_an_object_passes_have_it_half_a_path_further_on(series_line, axis):
    plate = {"Al": np.where(np.indices(SHAPE).sum(axis=0) < 40, 8.0, 0.0)}
    for exposure_ms in (20, 50):
        setting = f"kv=90,power_w=45,exposure_ms={exposure_ms},filter=Cu:0.05"
        asked = request("object", setting=setting, thickness_mm=plate, belt_axis=axis, source_object_mm=990.0)
        found = expect(series_line, asked, applied("motion_blur", 6.0, mean_place=0.5))
        away_px = 0.5 * 6.0 * exposure_ms / 50.0
        moved = replace(asked, displacement_px=(away_px, 0.0) if axis == "row" else (0.0, away_px))
        np.testing.assert_allclose(found.mean_DN, expect(series_line, moved, applied("motion_blur", 6.0)).mean_DN)


def test_a_standing_belt_blurs_and_displaces_nothing(series_line):
    asked = request(**BEHIND, belt_speed_mm_s=0.0)
    started = applied("motion_blur", 5.0, mean_place=0.5)
    np.testing.assert_array_equal(expect(series_line, asked, started).mean_DN, expect(series_line, asked).mean_DN)


@pytest.mark.parametrize("name", ["focal_spot", "motion_blur"])
def test_blur_of_the_object_leaves_flats_and_the_noise_s_texture_alone(series_line, name):
    base, found = expect(series_line, request(**BEHIND)), expect(series_line, request(**BEHIND), applied(name))
    np.testing.assert_array_equal(found.noise_autocovariance, base.noise_autocovariance)
    assert found.quantum_variance_DN2.sum() == pytest.approx(base.quantum_variance_DN2.sum(), rel=0.02)
    np.testing.assert_array_equal(
        expect(series_line, request(), applied(name)).mean_DN, expect(series_line, request()).mean_DN
    )


def test_an_mtf_tail_blurs_edges_and_noise_alike(series_line):
    effect = applied("mtf_tail", 30.0, reach_px=1.0)
    base, found = expect(series_line, request()), expect(series_line, request(), effect)
    assert found.quantum_variance_DN2.mean() < 0.8 * base.quantum_variance_DN2.mean()
    # what is lost in one pixel is found in the covariances: the sum over all lags is that of all frequencies, 1
    assert found.noise_autocovariance[0, 3] > 5 * base.noise_autocovariance[0, 3]
    for source_object_mm in (990.0, 530.0):
        seen, frequency = transfer(series_line, request("object", source_object_mm=source_object_mm), effect, 0)
        gauss = math.exp(-2 * (math.pi * 0.5 * frequency) ** 2)
        known = 0.7 + 0.3 / (1 + (2 * math.pi * 1.0 * frequency) ** 2) / gauss
        assert seen == pytest.approx(known, rel=1e-3)


def test_k_photons_spread_only_above_the_edge(series_line):
    effect = applied("k_fluorescence", 30.0)
    # all photons of 30 kV are below 33.2 keV
    soft = request(setting="kv=30,power_w=40,exposure_ms=20")
    np.testing.assert_allclose(
        expect(series_line, soft, effect).quantum_variance_DN2, expect(series_line, soft).quantum_variance_DN2
    )
    hard = expect(series_line, request(), effect).quantum_variance_DN2
    assert np.median(hard / expect(series_line, request()).quantum_variance_DN2) < 0.97
    np.testing.assert_allclose(
        line_energy_keV(np.array([30.0, 34.0, 60.0]), filters_from_text("CsI:0.5")), [0.0, 28.6, 29.8], atol=0.2
    )


# ------------------------------------------------------------------------------------------------ time


@pytest.mark.parametrize("frames", [10, 2000])
def test_the_first_frame_after_an_exposure_is_the_strength_of_the_lag(series_line, frames):
    effect = applied("image_lag", 2.0, release_s=0.1, spread=5.0, after_s=frames * 0.022)
    exposed = request(frames=frames)
    after = request("afterglow", setting=None, frames=1, start_s=frames * 0.022, previous=(exposed,))
    last = expect(series_line, exposed).signal_DN
    np.testing.assert_allclose(expect(series_line, after, effect).signal_DN, 0.02 * last, rtol=1e-6)


def test_lag_conserves_charge(series_line):
    effect = applied("image_lag", 5.0, release_s=0.2, spread=3.0)
    exposed = request(frames=20)
    after = request("afterglow", setting=None, frames=3000, start_s=20 * 0.022, previous=(exposed,))
    with_lag = expect(series_line, exposed, effect)
    collected = 20 * with_lag.signal_DN + 3000 * expect(series_line, after, effect).signal_DN
    np.testing.assert_allclose(collected, 20 * expect(series_line, exposed).signal_DN, rtol=1e-9)
    # the trend adds to the mean without changing it
    for _, course in with_lag.trend_DN:
        assert abs(course.sum()) < 1e-9


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_what_is_released_in_a_pause_is_found_in_the_next_frame_as_far_as_the_panel_is_not_read(series_line, share):
    effect = applied("image_lag", 5.0, release_s=0.2, spread=1.0, pause_share=share, after_s=1e4)
    exposed = request(frames=400)
    pause_s = 0.5
    after = request("dark", setting=None, frames=3, start_s=400 * 0.022 + pause_s, previous=(exposed,))
    found = expect(series_line, after, effect)
    first, second = (found.signal_DN + sum(image * course[n] for image, course in found.trend_DN) for n in (0, 1))
    held = 0.05 * expect(series_line, exposed).signal_DN / (1 - math.exp(-0.022 / 0.2))
    left = held * math.exp(-pause_s / 0.2)
    decay = math.exp(-0.022 / 0.2)
    np.testing.assert_allclose(first, left * (1 - decay) + share * (held - left), rtol=1e-9)
    np.testing.assert_allclose(second, left * decay * (1 - decay), rtol=1e-9)
    memory = LineMemory(trapped_DN=np.stack([held] * 4) / 4, time_s=400 * 0.022)
    sampled = next(LineModel(series_line, effects=effect).sample(after, rng=np.random.default_rng(0), memory=memory))
    assert (sampled - 1200.0).mean() == pytest.approx(first.mean(), abs=4 * 12 / 40)


def test_lag_lowers_the_variance_and_correlates_frames_as_its_impulse_response_says(series_line):
    effect = applied("image_lag", 5.0, release_s=0.05, spread=1.0, after_s=1e4)
    base, found = expect(series_line, request()), expect(series_line, request(), effect)
    decay = math.exp(-0.022 / 0.05)
    impulse = np.concatenate([[0.95], 0.05 * (1 - decay) * decay ** np.arange(500)])
    variance = float(np.sum(impulse**2))
    np.testing.assert_allclose(found.quantum_variance_DN2, variance * base.quantum_variance_DN2, rtol=1e-9)
    for lag in (1, 2, 3):
        known = float(np.sum(impulse[lag:] * impulse[:-lag])) / variance
        assert found.temporal_correlation[lag - 1] == pytest.approx(known, rel=1e-9)


def test_averaged_exposures_lag_among_themselves(series_line):
    effect = applied("image_lag", 5.0, release_s=0.05, spread=1.0, after_s=1e4)
    asked = request(setting=f"{MEASURED},averaged=4", frame_interval_ms=88.0)
    found, base = expect(series_line, asked, effect), expect(series_line, asked)
    decay = math.exp(-0.022 / 0.05)
    impulse = np.concatenate([[0.95], 0.05 * (1 - decay) * decay ** np.arange(500)])
    mean = np.convolve(impulse, np.ones(4)) / 4
    np.testing.assert_allclose(
        found.quantum_variance_DN2 / base.quantum_variance_DN2, float(np.sum(mean**2)) * 4, rtol=1e-9
    )


def test_a_ghost_of_the_last_object_lies_in_the_next_flat(series_line):
    effect = applied("image_lag", 3.0, release_s=1.0)
    earlier = request(**BEHIND, frames=100)
    asked = request(frames=1, start_s=2.2, previous=(earlier,))
    ghost = expect(series_line, asked, effect).signal_DN / expect(series_line, asked).signal_DN
    behind = expect(series_line, earlier).signal_DN
    assert np.corrcoef(ghost.ravel(), behind.ravel())[0, 1] > 0.99


def test_what_many_exposures_before_left_is_the_sum_of_what_each_left(series_line):
    effect = applied("image_lag", 3.0, release_s=2.0, spread=5.0, charge_ratio=0.8)
    earlier = []
    for number in range(6):
        scene = BEHIND if number % 2 else {}
        earlier.append(request(**{**scene, "frames": 20 + 10 * number, "start_s": 5.0 * number}))
    asked = request("dark", setting=None, frames=8, start_s=32.0, previous=tuple(earlier))
    found = expect(series_line, asked, effect)
    frames = [found.signal_DN + sum(image * course[n] for image, course in found.trend_DN) for n in range(8)]
    # frame by frame, trap by trap
    ((_, lag, values),) = in_order(effect)
    one = np.ones((1, 1))
    still = LineState(parameters=None, signal_DN=one, variance_DN2=one, flat_factor=one)
    law = lag.change(still, values, None).lag
    times, caught = np.array(law.time_s)[:, None, None], np.array(law.trapped)[:, None, None]
    held, clock = np.zeros((4, *SHAPE)), 0.0
    for one in earlier:
        held *= np.exp(-(one.start_s - clock) / times)
        brought = expect(series_line, one).signal_DN
        for _ in range(one.frames):
            held = held * np.exp(-0.022 / times) + caught * brought
        clock = one.start_s + one.frames * 0.022
    held *= np.exp(-(asked.start_s - clock) / times)
    known = []
    for _ in range(8):
        known.append(((1.0 - np.exp(-0.022 / times)) * held).sum(axis=0))
        held = held * np.exp(-0.022 / times)
    np.testing.assert_allclose(found.signal_DN, np.mean(known, axis=0), rtol=1e-9)
    # those of long ago fade together: within a hundredth of how much all fade
    np.testing.assert_allclose(frames, known, atol=0.01 * float(np.max(known[0] - known[-1])))


def test_exposures_before_a_lag_set_in_leave_nothing(series_line):
    earlier = request(frames=100, after_calibration=False)
    asked = request("dark", setting=None, frames=4, start_s=3.0, previous=(earlier,))
    always, since = (applied("image_lag", 3.0, release_s=1.0, since=since) for since in ("always", "calibration"))
    assert expect(series_line, asked, always).signal_DN.mean() > 1.0
    assert not expect(series_line, asked, since).signal_DN.any()
    # unless its traps were full already
    full = applied("image_lag", 3.0, release_s=1.0, since="calibration", before_share=0.5)
    np.testing.assert_allclose(
        expect(series_line, asked, full).signal_DN, 0.5 * expect(series_line, asked, always).signal_DN, rtol=1e-9
    )
    later = replace(asked, previous=(replace(earlier, after_calibration=True),))
    assert expect(series_line, later, since).signal_DN.mean() > 1.0


def test_sampled_lag_conserves_what_the_frames_and_the_traps_hold(series_line):
    effect = applied("image_lag", 5.0, release_s=0.5)
    quiet = replace(
        series_line,
        noise=replace(series_line.noise, quantised=False),
        maps=replace(series_line.maps, read_variance_DN2=np.zeros(SHAPE, np.float32)),
    )
    asked = request(frames=30)
    memory = LineMemory()
    with_lag = sum(LineModel(quiet, effects=effect).sample(asked, rng=np.random.default_rng(1), memory=memory))
    without = sum(LineModel(quiet, effects=()).sample(asked, rng=np.random.default_rng(1)))
    np.testing.assert_allclose(with_lag + memory.trapped_DN.sum(axis=0), without, rtol=1e-5)


def test_dark_drift_reaches_its_strength_at_the_session_s_end_and_longest_exposure(series_line):
    effect = applied("dark_drift", 20.0, session_s=100.0, longest_exposure_ms=200.0, warm_up=0.5)
    for exposure_ms, expected in ((200.0, 20.0), (50.0, 5.0)):
        ends = [
            expect(series_line, request("dark", setting=None, frames=1, exposure_ms=exposure_ms, start_s=time), effect)
            for time in (0.0, 100.0)
        ]
        np.testing.assert_allclose(ends[1].mean_DN - ends[0].mean_DN, expected, rtol=1e-9)
    later = applied("dark_drift", 20.0, session_s=100.0, longest_exposure_ms=200.0, warm_up=0.5, calibrated_s=30.0)
    dark = request("dark", setting=None, frames=1, exposure_ms=200.0, start_s=30.0)
    np.testing.assert_allclose(expect(series_line, dark, later).mean_DN, expect(series_line, dark).mean_DN, atol=1e-9)
    lit = request(start_s=100.0, frames=1)
    shift = expect(series_line, lit, effect).mean_DN - expect(series_line, lit).mean_DN
    np.testing.assert_allclose(shift, 2.0, rtol=1e-6)


def test_output_drift_is_one_factor_of_a_frame_with_its_correlation(series_line):
    effect = applied("output_drift", 2.0, correlation_s=0.1)
    found = expect(series_line, request(frames=50), effect)
    assert found.frame_factor_rms == pytest.approx(0.02)
    assert found.frame_factor_correlation[1] == pytest.approx(math.exp(-0.022 / 0.1))
    assert expect(series_line, request("dark", setting=None), effect).frame_factor_rms == 0
    averaged = expect(series_line, request(setting=f"{MEASURED},averaged=1000", frame_interval_ms=22000.0), effect)
    assert averaged.frame_factor_rms == pytest.approx(0.02 * math.sqrt(2 * 0.1 / 22.0), rel=0.02)


# ------------------------------------------------------------------------------------------------ beam


def test_a_kV_error_is_the_model_at_the_other_voltage(series_line):
    model, best = spectral_model_of(series_line), series_line.spectral.best[None, :]
    for name, setting in (("hard", MEASURED), ("soft", SOFT)):
        asked = request(setting=setting)
        parsed = asked.setting
        found = expect(series_line, asked, applied("kv_error", 2.0)).signal_DN / expect(series_line, asked).signal_DN
        at, higher = (
            model.signal(best, OpenBeam(kV=kV, filters=parsed.filters)).rate_DN_per_mAs[0]
            for kV in (parsed.kV, 1.02 * parsed.kV)
        )
        np.testing.assert_allclose(found, higher / at, rtol=2e-3, err_msg=name)


def test_large_kV_errors_go_on_where_small_ones_end(series_line):
    """At 6 % sums go on to higher energies: no step in level, gain or hardness."""
    for asked in (request(), request(**BEHIND)):
        below, above = (expect(series_line, asked, applied("kv_error", value)) for value in (5.9999, 6.0001))
        np.testing.assert_allclose(above.mean_DN, below.mean_DN, rtol=1e-4)
        np.testing.assert_allclose(above.quantum_variance_DN2, below.quantum_variance_DN2, rtol=1e-4)


def test_a_kV_error_beyond_the_tables_is_refused(series_line):
    with pytest.raises(InputError, match=r"strength of kv_error: got 25 %"):
        expect(series_line, request(), applied("kv_error", 25.0))


def test_a_filtration_error_is_another_sheet_of_aluminium(series_line):
    model, best = spectral_model_of(series_line), series_line.spectral.best[None, :]
    asked = request(setting=SOFT)
    copper = asked.setting.filters
    sheet = (*copper, Filter(material="Al", thickness_mm=0.5))
    known = [model.signal(best, OpenBeam(kV=40.0, filters=layers)) for layers in (copper, sheet)]
    base, found = expect(series_line, asked), expect(series_line, asked, applied("filtration_error", 0.5))
    np.testing.assert_allclose(
        found.signal_DN / base.signal_DN, known[1].rate_DN_per_mAs[0] / known[0].rate_DN_per_mAs[0], rtol=1e-6
    )


def test_a_composition_error_is_so_much_more_of_the_material(series_line):
    layers = {"water_liquid": PRODUCT["water_liquid"], "Al": np.full(SHAPE, 1.0)}
    thicker = {**layers, "water_liquid": 1.03 * layers["water_liquid"]}
    known = expect(series_line, request("object", thickness_mm=thicker)).mean_DN
    asked = request("object", thickness_mm=layers)
    for options in ({}, {"material": "water_liquid"}):
        found = expect(series_line, asked, applied("composition_error", 3.0, options=options))
        # borders of the object are looked for in its thickness, and lie a hair elsewhere
        np.testing.assert_allclose(found.mean_DN, known, rtol=1e-4)
    wedge = replace(asked, scene_kind="wedge")
    np.testing.assert_array_equal(
        expect(series_line, wedge, applied("composition_error", 3.0)).mean_DN, expect(series_line, wedge).mean_DN
    )
    other = expect(series_line, replace(asked, product_material="Al"), applied("composition_error", 3.0))
    assert np.abs(other.mean_DN / known - 1).max() > 1e-3


def across_field(line, asked, effects):
    """Change of the signal from the first to the last row, and column, over its mean."""
    ratio = expect(line, asked, effects).signal_DN / expect(line, asked).signal_DN
    down, right = ratio[-1].mean() - ratio[0].mean(), ratio[:, -1].mean() - ratio[:, 0].mean()
    return down / ratio.mean(), right / ratio.mean()


def test_the_heel_changes_the_unfiltered_signal_by_its_strength_across_the_field(series_line):
    bare = request(setting="kv=60,power_w=40,exposure_ms=20")
    down, right = across_field(series_line, bare, applied("heel", 5.0, direction_deg=0.0))
    assert down == pytest.approx(-0.05, abs=0.0015)
    assert right == pytest.approx(0.0, abs=1e-3)
    down, right = across_field(series_line, bare, applied("heel", 5.0, direction_deg=90.0))
    assert right == pytest.approx(-0.05, abs=0.0015)
    assert down == pytest.approx(0.0, abs=1e-3)


def test_a_heel_of_one_path_is_the_same_tungsten_at_every_voltage(series_line):
    heel = applied("heel", 20.0, direction_deg=0.0, offset=0.5, curvature=0.0, fixed_path=1.0)

    def passed(kV, filters, effects):
        bare = request(setting=f"kv={kV},power_w=10,exposure_ms=20")
        behind = request(setting=f"kv={kV},power_w=10,exposure_ms=20{filters}")
        return float((expect(series_line, behind, effects).signal_DN / expect(series_line, bare).signal_DN)[-1].mean())

    dimmed = passed(45, "", heel)
    path_mm = brentq(lambda mm: passed(45, f",filter=W:{mm:.7f}", []) - dimmed, 1e-4, 1e-2, xtol=1e-8)
    for kV in (60, 90):
        assert passed(kV, "", heel) == pytest.approx(passed(kV, f",filter=W:{path_mm:.7f}", []), rel=1e-3)
    # at the middle of the calibrated voltages it is the strength, as it is at each where the path is its own
    assert 0.1 < 1.0 - passed(90, "", heel) < 1.0 - passed(60, "", heel) < 0.25


@pytest.mark.parametrize(("turned", "expected"), [(180.0, (0.05, 0.0)), (90.0, (0.0, 0.05)), (360.0, (-0.05, 0.0))])
def test_a_turned_panel_sees_the_heel_turned(series_line, turned, expected):
    bare = request(setting="kv=60,power_w=40,exposure_ms=20", panel_rotation_deg=turned)
    assert across_field(series_line, bare, applied("heel", 5.0)) == pytest.approx(expected, abs=0.002)


def test_a_heel_that_calibration_saw_is_in_its_flat_but_its_hardness_shows_behind_objects(series_line):
    always = applied("heel", 10.0, since="always")
    flat = request(setting=SOFT)
    np.testing.assert_array_equal(expect(series_line, flat, always).mean_DN, expect(series_line, flat).mean_DN)
    asked = request("object", setting=SOFT, thickness_mm={"Al": np.full(SHAPE, 3.0)})
    down, _ = across_field(series_line, asked, always)
    # behind aluminium the beam is harder, and the anode takes less of it: the calibrated gradient is too steep
    assert 0.005 < down < 0.1
    turned = replace(flat, panel_rotation_deg=180.0)
    assert across_field(series_line, turned, always)[0] > 0.1


# ------------------------------------------------------------------------------------------------ response and readout


@pytest.mark.parametrize("order", [0.5, 1.0, 3.0])
def test_nonlinearity_departs_by_its_strength_at_half_of_the_highest_level(series_line, order):
    effect = applied("nonlinearity", 2.0, highest_signal_DN=40000.0, order=order)
    asked = request(setting="kv=90,exposure_ms=20,filter=Cu:0.05", open_signal_DN=20000.0)
    base, found = expect(series_line, asked), expect(series_line, asked, effect)
    at = np.abs(base.signal_DN - 20000.0) < 100
    np.testing.assert_allclose(found.signal_DN[at] / base.signal_DN[at], 0.98, rtol=2e-4 * order + 1e-4)
    # the slope of the response acts on the noise
    sloped = (1.0 - 0.02 * (1.0 + order)) ** 2
    np.testing.assert_allclose(
        found.quantum_variance_DN2[at] / base.quantum_variance_DN2[at], sloped, rtol=2e-3 * order
    )


@pytest.mark.parametrize("bends", [((-2e-6, 1.0),), ((1e-5, 0.6), (-3e-7, 1.0))])
def test_the_light_behind_a_response_that_rises_ever_more_is_found(bends):
    state, light = state_with(bends), np.linspace(-20.0, 60000.0, 400)
    np.testing.assert_allclose(light_of(state, responded(state, light)), light, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("bends", [((2e-6, 1.0),), ((1e-6, 1.0), (4e-4, 0.5)), ((1e-13, 3.0), (1e-6, 1.0))])
def test_the_light_behind_a_bent_response_is_found_and_the_highest_beyond_its_end(bends):
    state = state_with(bends)
    far = np.linspace(0.0, 1e6, 200_001)
    read = responded(state, far)
    top = int(np.argmax(read))
    light = np.linspace(-20.0, min(15000.0, 0.9 * far[top]), 400)
    np.testing.assert_allclose(light_of(state, responded(state, light)), light, rtol=1e-10, atol=1e-9)
    assert light_of(state, np.array([1.2 * read[top]]))[0] == pytest.approx(far[top], rel=0.05)


def test_nonlinearity_refers_to_the_full_scale_of_the_adc_unless_told(series_line):
    room = 65535 - 1200.0
    stated = expect(series_line, request(), applied("nonlinearity", 2.0, highest_signal_DN=room))
    np.testing.assert_allclose(expect(series_line, request(), applied("nonlinearity", 2.0)).mean_DN, stated.mean_DN)


@pytest.mark.parametrize(("columns", "together"), [(0.0, 0.1), (0.0, 2.0), (1.0, 5.0)])
def test_row_noise_of_frames_fades_from_line_to_line_as_expected(series_line, columns, together):
    asked = replace(request("dark", setting=None, frames=400), after_calibration=True)
    effect = applied("row_noise", 2.0, since="calibration", column_share=columns, together_lines=together)
    expected = expect(series_line, asked, effect)
    assert expected.offsets_together_lines == together
    frames = np.stack(list(LineModel(series_line, effects=effect).sample(asked, rng=np.random.default_rng(4))))
    lines = (frames - frames.mean(axis=0)).mean(axis=1 if columns else 2)
    variance = (
        expected.row_variance_DN2 + expected.column_variance_DN2 + np.mean(expected.white_variance_DN2) / SHAPE[0]
    )
    seen = [np.mean(lines[:, lag:] * lines[:, : lines.shape[1] - lag]) / variance for lag in (1, 2, 4)]
    known = np.exp(-np.array([1, 2, 4]) / together)
    np.testing.assert_allclose(seen, known, atol=5 * math.sqrt(2 * max(together, 0.5) / lines.size) + 0.02)


def test_row_noise_is_so_many_read_noises_in_rows_or_columns(series_line):
    since = {"since": "calibration"}
    asked = replace(request("dark", setting=None), after_calibration=True)
    rows = expect(series_line, asked, applied("row_noise", 0.5, **since))
    assert (rows.row_variance_DN2, rows.column_variance_DN2) == (pytest.approx(36.0), 0.0)
    columns = expect(series_line, asked, applied("row_noise", 0.5, column_share=1.0, **since))
    assert (columns.row_variance_DN2, columns.column_variance_DN2) == (0.0, pytest.approx(36.0))


@pytest.mark.parametrize("strength", [0.1, 1.0, 2.0])
def test_row_noise_that_was_always_there_is_part_of_the_calibrated_read_noise(series_line, strength):
    asked = request("dark", setting=None)
    plain, found = expect(series_line, asked), expect(series_line, asked, applied("row_noise", strength))
    white = found.white_variance_DN2
    # less the rounding, which is no part of the lines' reference
    assert found.row_variance_DN2 == pytest.approx(strength**2 * np.median(white - 1.0 / 12.0), rel=1e-6)
    np.testing.assert_allclose(white + found.row_variance_DN2, plain.white_variance_DN2, rtol=1e-6)


def test_excess_noise_is_quantum_noise_alone(series_line):
    base, found = expect(series_line, request()), expect(series_line, request(), applied("excess_noise", 40.0))
    np.testing.assert_allclose(found.quantum_variance_DN2, 1.4 * base.quantum_variance_DN2)
    np.testing.assert_array_equal(found.mean_DN, base.mean_DN)
    dark = request("dark", setting=None)
    np.testing.assert_array_equal(
        expect(series_line, dark, applied("excess_noise", 40.0)).white_variance_DN2,
        expect(series_line, dark).white_variance_DN2,
    )


@pytest.mark.parametrize("step", [2.0, 16.0, 40.0, 64.0])
def test_rounding_to_coarse_steps_has_the_moments_of_a_rounded_gaussian(series_line, step):
    """Mean and variance against the sum over all steps, where the noise is a fraction of a step: they swing with level."""
    from scipy.stats import norm

    for level in np.linspace(1200.0, 1264.0, 7):
        maps = replace(series_line.maps, dark_DN=np.full(SHAPE, level, dtype=np.float32))
        lost = applied("quantisation", step, since="calibration")
        found = expect(replace(series_line, maps=maps), request("dark", setting=None), lost)
        grid = step * np.arange(0, 3000 // step)
        sigma = math.sqrt(12.0**2)
        weight = norm.cdf(grid + step / 2, level, sigma) - norm.cdf(grid - step / 2, level, sigma)
        mean = float(weight @ grid)
        assert found.mean_DN[0, 0] == pytest.approx(mean, abs=2e-3)
        assert found.white_variance_DN2[0, 0] == pytest.approx(float(weight @ (grid - mean) ** 2), rel=1e-3)
        assert found.quantisation_step_DN == step


@pytest.mark.parametrize("sd", [0.0, 0.15, 0.3, 1.0])
def test_rounding_stays_in_means_where_noise_is_below_half_a_step(sd):
    """Means of 4000 rounded values, about what was rounded: their own scatter aside, the variance that is said to stay."""
    rng, step = np.random.default_rng(2), 3.0
    true = rng.uniform(100.0, 200.0, 800)
    values = step * np.round((true + sd * step * rng.standard_normal((4000, 800))) / step)
    stays = float(np.mean((values.mean(axis=0) - true) ** 2) - np.mean(values.var(axis=0)) / 4000)
    said = float(variance_kept_by_means(rounded_variance((sd * step) ** 2, step), step))
    assert stays == pytest.approx(said, rel=0.08, abs=2e-4 * step**2)
    assert said == pytest.approx(step**2 / 12.0, rel=1e-6) if sd == 0.0 else said < 0.05 * step**2


@pytest.mark.parametrize("sd_steps", [0.05, 0.15, 0.3, 0.6, 2.0])
def test_rounding_averaged_over_means_has_the_variance_of_rounded_numbers(sd_steps):
    """Against numbers that were rounded, their means anywhere between codes; and back."""
    rng, step = np.random.default_rng(4), 12.0
    sd = sd_steps * step
    mean = step * rng.random(40000)
    rounded = step * np.rint((mean + sd * rng.standard_normal((100, 40000))) / step)
    expected = float(np.mean(np.var(rounded, axis=0, ddof=1)))
    found = rounded_variance([sd**2], step)
    assert found[0] == pytest.approx(expected, rel=0.02)
    assert variance_before_rounding(found, step)[0] == pytest.approx(sd**2, rel=1e-3)


def test_bits_lost_before_the_calibration_leave_its_dark_noise_as_it_was(series_line):
    """The calibrated variance is that of rounded numbers, and is rounded numbers' again, whatever the step."""
    dark, cache = request("dark", setting=None), ModelCache(draft=True)
    pixels = np.full(SHAPE, 150.0, dtype=np.float32)
    line = replace(series_line, maps=replace(series_line.maps, read_variance_DN2=pixels))
    for step in (4.0, 20.0, 50.0):
        found = expect(line, dark, applied("quantisation", step, since="always"), cache=cache)
        assert float(np.mean(found.white_variance_DN2)) == pytest.approx(150.0, rel=1e-3)
        later = expect(line, dark, applied("quantisation", step, since="calibration"), cache=cache)
        before = 150.0 - 1.0 / 12.0
        assert float(np.mean(later.white_variance_DN2)) == pytest.approx(
            float(rounded_variance(before, step)), rel=1e-3
        )


def test_patterns_are_fixed_by_their_seed(series_line):
    quiet = request(setting=f"{MEASURED},averaged=400", frames=1)

    def pattern(name, seed):
        effect = applied(name, EFFECTS[name].strength.high, pattern_seed=seed)
        (frame,) = LineModel(series_line, effects=effect, cache=CACHE).sample(quiet, rng=np.random.default_rng(0))
        (base,) = LineModel(series_line, effects=(), cache=CACHE).sample(quiet, rng=np.random.default_rng(0))
        return (frame - base).ravel()

    for name in ("gain_map_error", "bad_pixels"):
        same, again, other = pattern(name, 1), pattern(name, 1), pattern(name, 2)
        np.testing.assert_array_equal(same, again)
        assert np.corrcoef(same, other)[0, 1] < 0.3


@pytest.mark.parametrize("name", ["gain_map_error", "bad_pixels"])
def test_a_pattern_that_calibration_saw_is_no_effect(series_line, name):
    always = applied(name, since="always")
    np.testing.assert_array_equal(
        numbers(expect(series_line, request(), always)), numbers(expect(series_line, request()))
    )


# ------------------------------------------------------------------------------------------------ registration


def test_a_whole_pixel_of_misregistration_is_the_object_one_pixel_on(series_line):
    effect = applied("misregistration", 2.0, direction_deg=90.0)
    found = expect(series_line, request(**BEHIND), effect).signal_DN
    moved = {name: np.roll(image, 2, axis=1) for name, image in PRODUCT.items()}
    known = expect(series_line, request("object", thickness_mm=moved)).signal_DN
    inside = np.s_[4:-4, 8:-8]
    np.testing.assert_allclose(found[inside], known[inside], rtol=1e-3)


@given(
    strength=st.floats(0.01, 5.0),
    magnification=st.floats(-90.0, 90.0),
    rotation=st.floats(-90.0, 90.0),
    rows=st.integers(2, 60),
    columns=st.integers(2, 60),
)
def test_the_rms_displacement_is_the_strength_for_any_mix(strength, magnification, rotation, rows, columns):
    shift, radial, turn = parts_px(strength, magnification_deg=magnification, rotation_deg=rotation)
    down, right = displacement_px((rows, columns), radial_px=radial, turn_px=turn)
    assert math.sqrt(shift**2 + np.mean(down**2 + right**2)) == pytest.approx(strength, rel=1e-9)


@given(strength=st.floats(0.01, 5.0), magnification=st.floats(-90.0, 90.0), rotation=st.floats(-89.9, 89.9))
def test_the_angles_of_a_misregistration_are_found_from_its_parts(strength, magnification, rotation):
    parts = parts_px(strength, magnification_deg=magnification, rotation_deg=rotation)
    found = angles_of(*parts)
    again = parts_px(
        found["strength"], magnification_deg=found["magnification_deg"], rotation_deg=found["rotation_deg"]
    )
    assert found["strength"] == pytest.approx(strength, rel=1e-9)
    assert again == pytest.approx(parts, abs=1e-9)


def test_a_turn_is_counter_clockwise_about_the_middle_and_leaves_the_middle_where_it_is():
    row, column = np.indices((41, 41)) - 20.0
    bar = np.exp(-0.5 * (row / 3.0) ** 2) * np.ones_like(column)  # lies along the columns' axis
    rms = math.sqrt(float(np.mean(row**2 + column**2)))
    angle = 0.05
    turned = distorted(bar, radial_px=0.0, turn_px=angle * rms)
    # counter-clockwise, the right end goes up: to smaller rows
    middle = [float(turned[:, at] @ np.arange(41) / turned[:, at].sum()) - 20.0 for at in (5, 20, 35)]
    assert middle == pytest.approx([15.0 * angle, 0.0, -15.0 * angle], abs=0.02)
    larger = distorted(bar, radial_px=angle * rms, turn_px=0.0)
    assert larger[:, 20] == pytest.approx(np.exp(-0.5 * ((np.arange(41) - 20.0) * (1.0 - angle) / 3.0) ** 2), abs=1e-3)


def test_a_turned_scene_is_the_turned_picture_of_it(series_line):
    behind = request(**BEHIND)
    beam = expect(series_line, request()).signal_DN
    still = expect(series_line, behind).signal_DN / beam
    turned = expect(series_line, behind, applied("misregistration", 0.8, rotation_deg=90.0)).signal_DN / beam
    np.testing.assert_allclose(turned, distorted(still, radial_px=0.0, turn_px=0.8), rtol=1e-6)
    assert np.abs(turned - still).max() > 0.01 * still.max()


# ------------------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("effect", "parameter", "value", "told"),
    [
        ("object_scatter", "reference_keV", 0.0, "a number above 0"),
        ("object_scatter", "width_mm", -3.0, "a number above 0"),
        ("veiling_glare", "length_mm", math.inf, "a finite number"),
    ],
)
def test_lengths_and_energies_of_0_are_told(effect, parameter, value, told):
    with pytest.raises(InputError, match=f"{parameter} of effect {effect}: .*{told}"):
        EFFECTS[effect].values({"strength": 5.0, parameter: value})


def test_unknown_effects_and_parameters_are_named_with_the_nearest(series_line):
    with pytest.raises(InputError, match=r"effect: got objekt_scatter; .*did you mean object_scatter"):
        effect_of(AppliedEffect(id="objekt_scatter", parameters={}))
    with pytest.raises(InputError, match=r"parameter of effect heel: got direction; .*did you mean direction_deg"):
        expect(series_line, request(), applied("heel", direction=3.0))


def test_effects_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="since: got yesterday; expected one of always, calibration"):
        AppliedEffect(id="heel", parameters={}, since="yesterday")
    with pytest.raises(InputError, match="strength of effect heel: got nan"):
        AppliedEffect(id="heel", parameters={"strength": math.nan})
    good = {"name": "strength", "unit": "%", "low": 1.0, "high": 2.0, "default": 1.5, "source": "x", "log": False}
    with pytest.raises(InputError, match="expected low <= default <= high"):
        Parameter(**{**good, "default": 3.0})
    with pytest.raises(InputError, match="above 0 and unsigned"):
        Parameter(**{**good, "log": True, "signed": True})
    heel = EFFECTS["heel"]
    with pytest.raises(InputError, match="stage: got nowhere"):
        replace(heel, stage="nowhere")
    with pytest.raises(InputError, match="no strength"):
        replace(heel, parameters=(Parameter(**{**good, "name": "size"}),))
    with pytest.raises(InputError, match="absorbed: got some of it"):
        replace(heel, absorbed="some of it")
    with pytest.raises(InputError, match="variants: got tilt; expected parameters: strength, direction_deg, curvature"):
        replace(heel, grid=Grid(variants=({"tilt": 1.0},)))
    with pytest.raises(InputError, match="random part lines: got no parameter column_share"):
        replace(heel, variation=Variation(random="lines"))
    with pytest.raises(InputError, match="random part of an effect: got much"):
        Variation(random="much")
    with pytest.raises(InputError, match=r"series of an effect: got .*film"):
        Shows(series=("film",), axis="level")
    with pytest.raises(InputError, match="axis of an effect: got colour"):
        Shows(series=("flat",), axis="colour")


def test_beam_effects_need_a_spectrum(series_line):
    bare = replace(series_line, spectral=None)
    for name in ("kv_error", "filtration_error", "heel"):
        with pytest.raises(InputError, match="twin without spectral part"):
            expect(bare, request(), applied(name))


# ------------------------------------------------------------------------------------------------ conditions


def test_what_a_session_states_goes_into_the_parameters_that_are_not_fitted():
    session = [
        request("dark", setting=None, exposure_ms=100.0, frames=50, start_s=10.0, after_calibration=False),
        request(frames=50, start_s=20.0, after_calibration=False),
        request("dark", setting=None, exposure_ms=50.0, frames=50, start_s=30.0, after_calibration=False),
        request(frames=100, start_s=100.0),
        request("afterglow", setting=None, frames=50, start_s=102.2),
    ]
    found = session_conditions(session)
    assert found == pytest.approx(
        {"session_s": 103.3, "longest_exposure_ms": 100.0, "calibrated_s": 20.55, "after_s": 2.2}
    )
    drift = with_conditions(AppliedEffect(id="dark_drift", parameters={"strength": 5.0, "session_s": 7.0}), found)
    assert drift.parameters == pytest.approx(
        {"strength": 5.0, "session_s": 7.0, "longest_exposure_ms": 100.0, "calibrated_s": 20.55}
    )
    assert with_conditions(AppliedEffect(id="heel", parameters={}), found).parameters == {}
    assert session_conditions([]) == {}
    assert "after_s" not in session_conditions(session[:4])


# ------------------------------------------------------------------------------------------------ texture


def light_pairs(name, parameters, line, rng, count):
    """Two light photons of each X-ray photon (row, column), px, as the effect's words have it, drawn one by one.

    The variance that quanta leave in a pixel is the chance that two light photons of one quantum land in it; the
    covariance of two pixels that one lands in each. No transfer function is used.
    """
    place = rng.random((2, count))
    sigma = line.noise.spread.value.sigma_px

    def disc(reach):
        distance, angle = rng.exponential(reach, count), rng.uniform(0, 2 * math.pi, count)
        return distance * np.stack([np.cos(angle), np.sin(angle)])

    landed = []
    origin = np.zeros((2, 2, count))
    if name == "k_fluorescence":
        model = spectral_model_of(line)
        beam = OpenBeam(kV=90.0, filters=filters_from_text("Cu:0.05"))
        weights = model.moment_weights(line.spectral.best, beam)[1]
        energies = model.energies_keV[: weights.size]
        energy = rng.choice(energies, size=count, p=weights / weights.sum())
        line_keV = line_energy_keV(energy, model.scintillator)
        splits = (rng.random(count) < parameters["strength"] / 100) & (line_keV > 0)
        away = disc(parameters["range_mm"] / line.instrument.pixel_mm)
        for photon in range(2):
            from_line = splits & (rng.random(count) < line_keV / energy)
            origin[photon] = np.where(from_line, away, 0.0)
    for photon in range(2):
        step = sigma * rng.standard_normal((2, count))
        if name == "mtf_tail":
            # a Gaussian of exponentially distributed variance has the transfer function 1 / (1 + H f^2)
            wide = parameters["reach_px"] * np.sqrt(2 * rng.exponential(1.0, count)) * rng.standard_normal((2, count))
            step = np.where(rng.random(count) < parameters["strength"] / 100, wide, step)
        if name == "veiling_glare":
            far = disc(parameters["length_mm"] / line.instrument.pixel_mm)
            step = step + np.where(rng.random(count) < parameters["strength"] / 100, far, 0.0)
        landed.append(np.floor(place + origin[photon] + step).astype(int))
    return landed


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("mtf_tail", {"strength": 30.0, "reach_px": 1.0}),
        ("veiling_glare", {"strength": 5.0, "length_mm": 1.0}),
        ("k_fluorescence", {"strength": 40.0, "range_mm": 0.2}),
    ],
)
def test_the_texture_of_the_noise_is_that_of_light_followed_photon_by_photon(series_line, name, parameters):
    count = 200_000
    first, second = light_pairs(name, parameters, series_line, np.random.default_rng(11), count)
    found, base = (expect(series_line, request(), effects) for effects in (applied(name, **parameters), ()))
    half = blur_variance_share("aperture", 0.5)
    share = half * np.median(found.quantum_variance_DN2 / base.quantum_variance_DN2)
    for lag in ((0, 0), (0, 1), (1, 1), (0, 2)):
        apart = second - first
        # by symmetry the four directions of a lag are alike
        seen = np.mean(
            [
                np.mean((apart[0] == down * lag[0]) & (apart[1] == right * lag[1]))
                for down in (-1, 1)
                for right in (-1, 1)
            ]
        )
        known = share * found.noise_autocovariance[lag]
        assert abs(seen - known) < 4 * math.sqrt(max(known, 1e-6) / count), lag


def test_crosstalk_of_more_quanta_than_leave_their_pixel_is_refused(series_line):
    most = 100.0 * leaving_share(0.5)
    expect(series_line, request(**BEHIND), applied("crosstalk", 0.99 * most, reach_px=0.5))
    with pytest.raises(InputError, match=r"at a reach of 0\.5 px; expected at most"):
        expect(series_line, request(**BEHIND), applied("crosstalk", 1.01 * most, reach_px=0.5))


def test_crosstalk_blurs_an_edge_as_quanta_that_move_one_by_one_and_leaves_noise_and_flats_alone(series_line):
    """Quanta are drawn on both sides of an edge, moved and spread by light; no transfer function is used."""
    strength, reach_px, count = 30.0, 1.2, 4_000_000
    effect = applied("crosstalk", strength, reach_px=reach_px)
    plate = {"Al": np.where(np.arange(40) < 20, 30.0, 0.0) * np.ones((40, 1))}
    asked = request("object", thickness_mm=plate)
    found, sharp = expect(series_line, asked, effect), expect(series_line, asked)
    even = series_line.level_nearest(asked.setting).flat_shape
    known, plain = ((one.signal_DN / even).mean(axis=0)[12:28] for one in (found, sharp))
    rng = np.random.default_rng(3)
    # it is the same all along the edge: of a place only the column counts
    column = rng.uniform(8.0, 32.0, count)
    column = column[rng.random(count) < np.where(column < 20.0, plain.min() / plain.max(), 1.0)]
    distance, angle = rng.exponential(reach_px, column.size), rng.uniform(0.0, 2.0 * math.pi, column.size)
    step = distance * np.stack([np.sin(angle), np.cos(angle)])
    left = np.any(np.floor(np.stack([rng.random(column.size), column % 1.0]) + step) != 0.0, axis=0)
    assert np.mean(left) == pytest.approx(leaving_share(reach_px), abs=1e-3)
    moves = rng.random(column.size) < strength / 100.0 / np.mean(left)
    assert np.mean(left & moves) == pytest.approx(0.30, abs=1.5e-3)
    light = series_line.noise.spread.value.sigma_px * rng.standard_normal(column.size)
    counts = np.histogram(column + np.where(moves, step[1], 0.0) + light, bins=np.arange(12, 29))[0]
    full = count / 24.0
    away = [(counts - full * image / plain.max()) / np.sqrt(full * image / plain.max()) for image in (known, plain)]
    assert np.abs(away[0]).max() < 4.5 and np.abs(away[1]).max() > 15.0
    # moved quanta are counts as the others: their noise is as correlated as before, and flats do not change
    np.testing.assert_array_equal(found.noise_autocovariance, sharp.noise_autocovariance)
    np.testing.assert_array_equal(
        numbers(expect(series_line, request(), effect)), numbers(expect(series_line, request()))
    )


@pytest.mark.parametrize("lasting", [0.0, 0.4])
def test_a_gain_that_remembers_exposure_is_that_of_traps_followed_in_small_steps(series_line, lasting):
    """Traps are filled and emptied step by step, a hundred steps an exposure."""
    strength, fade_s, fills = 4.0, np.array([12.0, np.inf])[:, None, None], 30.0
    shares = np.array([1.0 - lasting, lasting])[:, None, None]
    shadow, flat = request(**BEHIND, frames=40), request(frames=20, start_s=4.0)
    # what comes long before is remembered as what comes just before
    asked = request(frames=12, start_s=9.0, long_ago=(shadow,), previous=(flat,))
    effect = applied("burn_in", strength, fade_s=12.0, fills_after_exposures=fills, lasting_share=lasting)
    found, plain = expect(series_line, asked, effect), expect(series_line, asked)
    step_s = asked.interval_s(series_line.instrument.readout_ms)
    highest = 2.0**series_line.instrument.bits - 1 - series_line.dark_DN.value
    most = strength / 100.0 / (1.0 - math.exp(-100.0 / fills))
    full, clock_s, gain = np.zeros((2, *SHAPE)), 0.0, []
    for series in (shadow, flat, asked):
        bare = replace(series, frames=1, previous=(), long_ago=())
        light = expect(series_line, bare).signal_DN / (fills * highest)
        full = full * np.exp(-(series.start_s - clock_s) / fade_s)
        gain = []
        for _ in range(series.frames):
            gain.append(1.0 + most * (shares * full).sum(axis=0))
            for _ in range(100):
                full = full + (light * (1.0 - full) - full * step_s / fade_s) / 100.0
        clock_s = series.start_s + series.frames * step_s
    gain = np.array(gain)
    rise = gain[-1] - gain[0]
    known = found.signal_DN / plain.signal_DN
    np.testing.assert_allclose(known - 1.0, gain.mean(axis=0) - 1.0, rtol=2e-3)
    course = sum(image * profile[:, None, None] for image, profile in found.trend_DN) / plain.signal_DN
    assert np.abs(course - (gain - gain.mean(axis=0))).max() < 0.02 * np.abs(rise).max()
    np.testing.assert_allclose(found.quantum_variance_DN2, known**2 * plain.quantum_variance_DN2, rtol=1e-9)
    # where the object stood the later flat is darker
    assert known[20, 20] < known[1, 1] - 1e-4
    frames = LineModel(series_line, effects=effect).sample(replace(asked, frames=400), rng=np.random.default_rng(5))
    plain_frames = LineModel(series_line, effects=()).sample(replace(asked, frames=400), rng=np.random.default_rng(5))
    risen = np.mean([one.mean() for one in frames]) / np.mean([one.mean() for one in plain_frames]) - 1.0
    expected = expect(series_line, replace(asked, frames=400), effect).mean_DN.mean() / plain.mean_DN.mean() - 1.0
    assert risen == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("dead_ns", [5_000.0, 40_000.0])
def test_counts_lost_to_pile_up_are_those_of_photons_that_come_one_by_one(series_line, dead_ns):
    """Photons are drawn with their times; those within the dead time of the count before are lost."""
    effect = applied("pile_up", dead_ns)
    found, plain = expect(series_line, request(), effect), expect(series_line, request())
    light = float(plain.signal_DN.mean())
    photons, exposure_s = light / 10.0, 0.02  # 10 DN a count: the gain that this line states at 90 kV
    rng = np.random.default_rng(6)
    gaps = rng.exponential(exposure_s / photons, (4000, int(photons + 12 * math.sqrt(photons))))
    gaps[:, 1:] += 1e-9 * dead_ns
    counts = (np.cumsum(gaps, axis=1) < exposure_s).sum(axis=1)
    shares = found.signal_DN.mean() / light
    assert abs(shares - counts.mean() / photons) < 4 * counts.std() / photons / math.sqrt(4000) + 2e-4
    of_variance = float(found.quantum_variance_DN2.mean() / plain.quantum_variance_DN2.mean())
    assert abs(of_variance - counts.var() / photons) < 5 * math.sqrt(2 / 4000) * of_variance
    assert shares < 0.99


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("off_focal", {"peakedness": -0.6}),
        ("motion_blur", {"acceleration": 1.2}),
        ("veiling_glare", {"xray_share": 1.1}),
        ("burn_in", {"lasting_share": 1.1}),
        ("burn_in", {"lasting_share": -0.1}),
        ("random_telegraph", {"differ": 0.9}),
    ],
)
def test_a_parameter_that_no_line_can_have_is_refused(series_line, name, wrong):
    (parameter,) = wrong
    with pytest.raises(InputError, match=f"{parameter} of {name}: got"):
        expect(series_line, request(**BEHIND, source_object_mm=850.0), applied(name, **wrong))


def test_a_threshold_error_is_the_model_at_the_other_threshold(series_line, as_counter):
    """One pixel's variance stays that of counts."""
    line = as_counter(series_line)
    model, before = spectral_model_of(line), line.spectral.best
    for setting in (MEASURED, SOFT):
        asked = request(setting=setting)
        for moved_keV in (5.0, -5.0, -30.0):
            after = before.copy()
            after[model.names.index("threshold_keV")] = max(20.0 + moved_keV, 0.0)
            beam = OpenBeam(kV=asked.setting.kV, filters=asked.setting.filters)
            rates = model.signal(np.stack([before, after]), beam).rate_DN_per_mAs
            found, plain = expect(line, asked, applied("threshold_error", moved_keV)), expect(line, asked)
            share = found.signal_DN / plain.signal_DN
            np.testing.assert_allclose(share, rates[1] / rates[0], rtol=1e-6)
            np.testing.assert_allclose(found.quantum_variance_DN2 / plain.quantum_variance_DN2, share, rtol=1e-6)
            assert (share < 1.0).all() == (moved_keV > 0)


def test_a_threshold_that_no_counter_has_is_refused(series_line, as_counter):
    with pytest.raises(InputError, match="only counters have a threshold"):
        LineModel(series_line, effects=applied("threshold_error")).expect(request())
    counting = replace(series_line, instrument=replace(series_line.instrument, counting=True))
    with pytest.raises(InputError, match="a twin whose spectrum has no threshold"):
        LineModel(counting, effects=applied("threshold_error")).expect(request())
    with pytest.raises(InputError, match=r"strength of threshold_error: got 61 keV on top of a calibrated 20 keV"):
        LineModel(as_counter(series_line), effects=applied("threshold_error", 61.0)).expect(request())


def test_only_counters_lose_counts(series_line):
    with pytest.raises(InputError, match="only counters have a dead time"):
        LineModel(series_line, effects=applied("pile_up")).expect(request())


@pytest.mark.parametrize(
    ("peakedness", "source_object_mm", "aside_mm", "turned_deg"),
    [
        (0.0, 990.0, (0.0, 0.0), 0.0),
        (0.5, 990.0, (3.0, -4.0), 0.0),
        (1.0, 990.0, (0.0, 0.0), 0.0),
        (1.0, 990.0, (0.0, 5.0), 180.0),
        (0.0, 850.0, (5.0, 2.0), 90.0),
        (-1.0 / 3.0, 850.0, (0.0, 3.0), 0.0),
        (-0.5, 850.0, (0.0, 0.0), 0.0),
    ],
)
def test_off_focal_radiation_throws_the_shadows_of_many_source_points(
    series_line, peakedness, source_object_mm, aside_mm, turned_deg
):
    """Points are drawn on the source and shadows thrown one by one; no transfer function is used."""
    strength, width_mm, count = 15.0, 3.0, 4_000_000
    down_mm, right_mm = aside_mm
    effect = applied(
        "off_focal", strength, width_mm=width_mm, peakedness=peakedness, down_mm=down_mm, right_mm=right_mm
    )
    # what lies to the right of an upright panel lies to the left of one turned by 180 degrees
    across_mm = {0.0: right_mm, 90.0: -down_mm, 180.0: -right_mm}[turned_deg]
    plate = {"Al": np.where(np.arange(40) < 20, 30.0, 0.0) * np.ones((40, 1))}
    asked = request("object", thickness_mm=plate, source_object_mm=source_object_mm, panel_rotation_deg=turned_deg)
    found, sharp = expect(series_line, asked, effect), expect(series_line, asked)
    even = series_line.level_nearest(asked.setting).flat_shape
    known, plain = ((one.signal_DN / even).mean(axis=0) for one in (found, sharp))
    rng = np.random.default_rng(4)
    if peakedness < 0.0:
        # an even disc, or its rim alone: of such radii that the standard deviation along a line is the width
        radius = 2.0 * np.sqrt(rng.random(count)) if peakedness > -0.4 else math.sqrt(2.0)
        along = width_mm * radius * np.cos(2.0 * math.pi * rng.random(count)) + across_mm
    else:
        # Gaussians of variances that differ fall from a peak with a long tail; the wider ones lie farther aside
        size = rng.gamma(1.0 / peakedness, peakedness, count) if peakedness else np.ones(count)
        along = width_mm * np.sqrt(size) * rng.standard_normal(count) + across_mm * size
    place_mm = along * (rng.random(count) < strength / 100.0)
    border = 20.0 + (1059.0 / source_object_mm - 1.0) / series_line.instrument.pixel_mm * place_mm
    column, luck = rng.uniform(0.0, 40.0, count), rng.random(count)
    landed = column + series_line.noise.spread.value.sigma_px * rng.standard_normal(count)
    passed, before = (luck < np.where(column < side, plain.min() / plain.max(), 1.0) for side in (border, 20.0))
    # the same quanta with a point for a source: how the model draws a sharp edge is not asked here
    more, fewer = (
        np.histogram(landed[one & ~other], bins=np.arange(8, 33))[0]
        for one, other in ((passed, before), (before, passed))
    )
    wanted = count / 40.0 * (known - plain)[8:32] / plain.max()
    sd = np.sqrt(more + fewer + 1.0)
    assert np.abs((more - fewer - wanted) / sd).max() < 4.5 and np.abs(wanted / sd).max() > 30.0
    # noise is that of the quanta which arrive, and flats do not change
    np.testing.assert_array_equal(found.noise_autocovariance, sharp.noise_autocovariance)
    np.testing.assert_array_equal(
        numbers(expect(series_line, request(), effect)), numbers(expect(series_line, request()))
    )


def test_a_profile_of_off_focal_radiation_changes_steadily_with_its_peakedness(series_line):
    plate = {"Al": np.where(np.arange(40) < 20, 30.0, 0.0) * np.ones((40, 1))}
    asked = request("object", thickness_mm=plate, source_object_mm=850.0)

    def shown(peakedness):
        return expect(series_line, asked, applied("off_focal", 15.0, width_mm=3.0, peakedness=peakedness)).signal_DN

    pictures = [shown(peakedness) for peakedness in np.linspace(-0.05, 0.05, 11)]
    changes = [np.abs(after - before).max() for before, after in itertools.pairwise(pictures)]
    assert max(changes) < 1.3 * min(changes)


def test_a_draft_knows_the_noise_of_light_that_comes_from_afar(series_line):
    """What a model draws for comparisons must have the noise of the light that off-focal radiation brings into a shadow."""
    shadow = {"Al": np.where(np.arange(40) < 20, 60.0, 0.0) * np.ones((40, 1))}
    asked = request("object", thickness_mm=shadow, source_object_mm=850.0)
    far = applied("off_focal", 15.0, width_mm=6.0, peakedness=0.0)
    drafts, whole = (
        [
            LineModel(series_line, effects=effects, cache=ModelCache(draft=draft)).expect(asked).quantum_variance_DN2
            for effects in ((), far)
        ]
        for draft in (True, False)
    )
    deep = np.s_[10:30, 10:16]
    gained = [float((after - before)[deep].mean()) for before, after in (drafts, whole)]
    assert gained[1] > 0.02 * float(whole[0].max())
    assert gained[0] == pytest.approx(gained[1], rel=0.02)


def test_light_from_beyond_a_border_is_that_of_a_field_that_goes_on_there(series_line):
    """A slanted plate: the picture blurred with what lies beyond its borders drawn, against the same with mirrors there."""
    row, column = np.indices((40, 40))
    plate = {"Al": np.where(column + 0.4 * row < 30.0, 30.0, 0.0)}
    asked = request("object", thickness_mm=plate, source_object_mm=850.0)
    width_mm, strength = 2.0, 15.0
    line = LineModel(series_line, effects=applied("off_focal", strength, width_mm=width_mm, peakedness=0.0))
    found = line.from_beyond(asked)
    state = LineModel(series_line).light(asked).at_load().state
    width_px = width_mm * (1059.0 / 850.0 - 1.0) / series_line.instrument.pixel_mm
    outside = np.pad(state.signal_DN, 40, mode="edge") - np.pad(state.signal_DN, 40, mode="symmetric")
    own_px = series_line.noise.spread.value.sigma_px
    wide, narrow = (ndimage.gaussian_filter(outside, sd_px) for sd_px in (math.hypot(width_px, own_px), own_px))
    wanted = strength / 100.0 * (wide - narrow)[40:80, 40:80]
    assert np.abs(wanted).max() > 0.004 * state.signal_DN.max()
    # in the outermost pixels a border as sharp as pixels rings
    inner = np.s_[3:-3, 3:-3]
    np.testing.assert_allclose(found[inner], wanted[inner], atol=0.04 * np.abs(wanted).max())
    assert not LineModel(series_line).from_beyond(asked).any()


@pytest.mark.parametrize(("strength", "sheet"), [(5.0, 0.0), (5.0, 1.0), (60.0, 1.0), (40.0, 0.5)])
@pytest.mark.parametrize("setting", [SOFT, MEASURED])
def test_behind_an_absorber_passes_what_beer_lambert_says_energy_by_energy(series_line, strength, sheet, setting):
    asked = request("object", setting=setting, thickness_mm={"Al": np.full(SHAPE, 4.0)})
    effect = applied("grey_absorber", strength, border=0.0, penumbra=0.03, direction_deg=90.0, sheet_share=sheet)
    found = expect(series_line, asked, effect).signal_DN / expect(series_line, asked).signal_DN
    kV = 40.0 if setting is SOFT else 90.0
    model = spectral_model_of(series_line)
    weights = model.moment_weights(series_line.spectral.best, OpenBeam(kV=kV, filters=filters_from_text("Cu:0.05")))[0]
    mu = model.mu("Al")[: weights.size]
    # so much aluminium takes its share of 45 keV photons, whether the beam has any or not; a mesh takes the same of all
    tau = -math.log(1.0 - strength / 100.0)
    thick_mm = tau * sheet / float(mu_per_mm(material_from_name("Al"), [45.0])[0])
    behind = np.exp(-4.0 * mu)
    known = (
        np.sum(weights * behind * np.exp(-thick_mm * mu)) / np.sum(weights * behind) * math.exp(-tau * (1.0 - sheet))
    )
    # three sheets stand for all, and the border's penumbra for its blur
    assert found[:, :12] == pytest.approx(1.0, abs=2e-4)
    assert found[:, 28:] == pytest.approx(known, rel=3e-3)
    assert found[5, 19] > found[5, 20] > known


def test_an_absorber_that_was_always_there_is_in_the_flat_until_the_panel_turns(series_line):
    effect = applied("grey_absorber", 10.0, since="always", sheet_share=1.0)
    np.testing.assert_array_equal(
        numbers(expect(series_line, request(), effect)), numbers(expect(series_line, request()))
    )
    turned = request(panel_rotation_deg=180.0)
    ratio = expect(series_line, turned, effect).signal_DN / expect(series_line, turned).signal_DN
    assert ratio[:, 0].mean() < 0.95 and ratio[:, -1].mean() > 1.05


def test_a_share_of_an_output_s_drift_may_be_new_in_every_exposure(series_line):
    effect = applied("output_drift", 2.0, correlation_s=0.1, jitter_share=0.4)
    found = expect(series_line, request(frames=400), effect)
    assert found.frame_factor_rms == pytest.approx(0.02)
    assert found.frame_factor_correlation[1] == pytest.approx(0.6 * math.exp(-0.022 / 0.1))
    averaged = expect(series_line, request(setting=f"{MEASURED},averaged=1000", frame_interval_ms=22000.0), effect)
    variance = 0.02**2 * (0.6 * 2 * 0.1 / 22.0 + 0.4 / 1000)
    assert averaged.frame_factor_rms == pytest.approx(math.sqrt(variance), rel=0.02)
    frames = LineModel(series_line, effects=effect, cache=CACHE).sample(
        request(frames=400), rng=np.random.default_rng(3)
    )
    factor = np.array([float(np.mean(frame - found.dark_DN) / np.mean(found.signal_DN)) for frame in frames])
    steps = np.diff(factor)
    # a first-order process and white noise: 400 frames leave some 7 % of the steps' variance open
    assert np.mean(steps**2) / 2 == pytest.approx(0.02**2 * (1 - found.frame_factor_correlation[1]), rel=0.3)


def test_hot_pixels_are_their_share_of_the_bad_ones(series_line):
    effect = applied("bad_pixels", 2.0, hot_share=0.25)
    found = expect(series_line, request("dark", setting=None), effect)
    assert found.hot_pixel_share == pytest.approx(0.25 * found.bad_pixel_share)
    frames = np.stack(
        list(
            LineModel(series_line, effects=effect).sample(
                request("dark", setting=None, frames=20), rng=np.random.default_rng(5)
            )
        )
    )
    noise = np.sqrt(np.asarray(found.white_variance_DN2))
    hot = float(np.mean(np.abs(frames.mean(axis=0) - found.mean_DN) > 6 * noise / math.sqrt(20)))
    size = float(np.prod(SHAPE))
    # lines of eight come and go together
    assert abs(hot - found.hot_pixel_share) < 4 * math.sqrt(8 * found.hot_pixel_share / size)


@pytest.mark.parametrize("flatness", [0.0, 0.2, 0.5, 0.7, 1.0])
def test_every_profile_of_a_focal_spot_has_the_same_variance_and_flatter_ones_lighter_tails(flatness):
    f = np.linspace(0.0, 0.02, 41)
    transfer = _transfer_of_spot(f, flatness)
    # 1 - 2 pi^2 f^2 + (3 + kurtosis) (2 pi f)^4 / 24
    bend = np.polyfit(f**2, transfer, 3)[::-1]
    assert bend[1] == pytest.approx(-2.0 * np.pi**2, rel=1e-4)
    excess = 24.0 * bend[2] / (2.0 * np.pi) ** 4 - 3.0
    known = {0.0: 0.0, 0.5: -0.6, 1.0: -1.2}  # Gaussian, triangle, box
    if flatness in known:
        assert excess == pytest.approx(known[flatness], abs=0.02)
    else:
        assert -1.2 < excess < 0.0


def test_a_focal_spot_of_even_brightness_smears_an_edge_over_its_width():
    magnification, pitch_mm = 2.0, 0.1
    width_mm = 0.8
    strength = width_mm / math.sqrt(12.0) * 2.0 * math.sqrt(2.0 * math.log(2.0))
    sigma_px = strength / (2.0 * math.sqrt(2.0 * math.log(2.0))) * (magnification - 1.0) / pitch_mm
    f = np.fft.rfftfreq(4096, 1.0 / 16.0)  # sixteen samples a pixel
    profile = np.fft.irfft(_transfer_of_spot(sigma_px * f, 1.0), 4096)
    inside = profile > 0.5 * profile.max()
    assert inside.sum() / 16.0 == pytest.approx(width_mm / pitch_mm, abs=0.15)

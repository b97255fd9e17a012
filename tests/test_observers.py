"""Model observers: closed forms, order of the detectors, matched filters on drawn noise, search, motion, calibration to networks."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytwin.acquisition.setting import Filter, setting_from_text
from raytwin.api.observers import CalibratedObserver
from raytwin.errors import FileFormatError, InputError
from raytwin.generator.predictions.contrast import SlabContrasts
from raytwin.generator.spread.psf import whole_spectrum
from raytwin.observers import (
    DETECTORS,
    LineImages,
    MeasuredSize,
    Observer,
    ProductTexture,
    Shape,
    fit_efficiency,
    frequency_bins,
    independent_places,
    materials_seen,
    object_spectrum,
    objects_of_shape,
    observe_settings,
    predicted_sizes,
    read_efficiency,
    search_threshold,
    write_efficiency,
)
from raytwin.observers.objects import profile_of_shape
from raytwin.observers.search import chance_of_maximum


def pair_at(exposure_ms, *, kV=(40, 90), **more):
    words = "".join(f",{name}={value}" for name, value in more.items())
    return tuple(
        setting_from_text(f"kv={one},power_w=40,exposure_ms={exposure_ms},filter=Cu:0.05{words}") for one in kV
    )


@pytest.fixture(scope="module")
def line(make_model_twin):
    return LineImages(make_model_twin((64, 64), pixel_mm=0.45, source_object_mm=2970.0, source_detector_mm=3177.0))


def rods(line, *, sizes=np.geomspace(1.0, 25.0, 12), **more):
    given = {
        "product_mm": [16.0],
        "product_material": "chicken_breast",
        "foreign_material": "rib_bone",
        "area_px": 4096.0,
    }
    return objects_of_shape(
        Shape(kind="rod", width=0.2, height=0.2), sizes_mm=sizes, pixel_mm=line.object_pixel_mm, **(given | more)
    )


def disc(radius_px, cells=64):
    position = np.arange(cells) - cells // 2
    return (np.hypot(*np.meshgrid(position, position, indexing="ij")) <= radius_px).astype(float)


# ------------------------------------------------------------------------------------------------- closed forms


def test_a_disc_in_white_noise_has_the_closed_form():
    bins = frequency_bins(64)
    shape = disc(6)
    energy, amplitude = object_spectrum(shape, bins)
    contrast, sd = 0.02, 0.11
    expected = contrast**2 * shape.sum() / sd**2
    for name in ("ideal", "npw"):
        found = DETECTORS[name](contrast**2 * energy, contrast * amplitude, np.full(bins.share.size, sd**2), bins)
        assert found.d_squared == pytest.approx(expected, rel=1e-9)
    # a template that is the object itself: its output varies as its autocorrelation
    assert found.row_correlation == pytest.approx((shape[1:] * shape[:-1]).sum() / shape.sum(), abs=0.01)


@given(
    radius=st.floats(1.0, 9.0),
    slope=st.floats(0.0, 3.0),
    white=st.floats(0.01, 10.0),
    turn=st.floats(0.0, 90.0),
)
@settings(deadline=None, max_examples=40)
def test_no_linear_observer_is_better_than_the_ideal_one(radius, slope, white, turn):
    bins = frequency_bins(64)
    profile = profile_of_shape(Shape(kind="rod", width=0.4), length_mm=2 * radius, pixel_mm=1.0, turn_deg=turn)
    energy, amplitude = object_spectrum(profile, bins)
    power = white + np.hypot(np.hypot(bins.row, bins.column), 0.01) ** -slope
    found = {name: float(detect(energy, amplitude, power, bins).d_squared) for name, detect in DETECTORS.items()}
    assert found["ideal"] > 0
    assert all(value <= found["ideal"] * (1 + 1e-6) for value in found.values())


def test_channels_prewhiten_what_the_matched_filter_cannot():
    bins = frequency_bins(64)
    energy, amplitude = object_spectrum(disc(5), bins)
    power = 1e-3 + np.hypot(np.hypot(bins.row, bins.column), 0.01) ** -3
    ideal, hotelling, npw = (
        float(DETECTORS[name](energy, amplitude, power, bins).d_squared) for name in ("ideal", "hotelling", "npw")
    )
    assert ideal > hotelling > 2 * npw


# ------------------------------------------------------------------------------------------------- drawn noise


def filtered_noise(line, template, *, quantum, white, images, cells, rng):
    """Output of a template of unit noise gain all over images of the line's noise, (image, row, column)."""
    power = quantum * whole_spectrum(line.twin.noise.spread.value.noise_power(cells)) + white
    through = np.fft.fft2(template, s=(cells, cells)) * np.sqrt(power)
    scale = math.sqrt(np.mean(np.abs(through) ** 2))
    drawn = np.fft.fft2(rng.standard_normal((images, cells, cells)))
    return np.fft.ifft2(drawn * np.conj(through) / scale).real


@pytest.mark.parametrize("radius", [2.5, 6.0])
def test_the_threshold_keeps_the_rate_of_false_alarms_on_drawn_noise(line, radius):
    cells, images, rate = 64, 3000, 0.1
    bins = frequency_bins(cells)
    energy, amplitude = object_spectrum(disc(radius, cells), bins)
    power = line.noise_power(bins) + 0.1
    found = DETECTORS["npw"](energy, amplitude, power, bins)
    threshold = float(
        search_threshold(
            row_correlation=found.row_correlation,
            column_correlation=found.column_correlation,
            area_px=cells**2,
            false_alarm_rate=rate,
        )
    )
    outputs = filtered_noise(
        line, disc(radius, cells), quantum=1.0, white=0.1, images=images, cells=cells, rng=np.random.default_rng(1)
    )
    alarms = float((outputs.max(axis=(1, 2)) > threshold).mean())
    # correlations that do not fall off as Gaussians: a fifth of the rate, 0.05 of the threshold
    assert alarms == pytest.approx(rate, abs=0.2 * rate + 3 * math.sqrt(rate / images))
    assert 0 < float(independent_places(threshold, rate)) < cells**2


@pytest.mark.slow
def test_matched_filters_on_drawn_noise_find_what_the_curve_says(line):
    pair = pair_at(20)
    objects = rods(line)
    found = observe_settings(line, [pair], objects, observer=Observer(detector="npw", false_alarm_rate=0.1))
    images = line.pair_images([pair], objects)
    rng = np.random.default_rng(2)
    cells, count = 64, 4000
    tried = np.flatnonzero(np.abs(found.pod[0] - 0.5) < 0.45)[:3]
    assert len(tried) == 3
    for number in tried:
        place = number // 4
        profile = profile_of_shape(
            Shape(kind="rod", width=0.2, height=0.2),
            length_mm=float(objects.size[number]),
            pixel_mm=line.object_pixel_mm,
            turn_deg=(0.0, 30.0, 60.0, 90.0)[number % 4],
        )
        assert place == np.searchsorted(np.unique(objects.size), objects.size[number])
        frequency = np.fft.fftfreq(cells)
        transfer = line.twin.noise.spread.value.transfer(frequency[:, None], frequency[None, :])
        contrast = images.signal[0, :, 0, number].sum() / objects.object_mm[number]
        spectrum = np.fft.fft2(profile, s=(cells, cells)) * transfer * contrast
        power = images.quantum[0, 0, number] * whole_spectrum(line.twin.noise.spread.value.noise_power(cells))
        power += images.white[0, 0, number]
        noise = np.fft.fft2(rng.standard_normal((count, cells, cells))) * np.sqrt(power)
        values = np.fft.ifft2((noise + spectrum) * np.conj(spectrum)).real[:, 0, 0]
        values /= math.sqrt(np.sum(np.abs(spectrum) ** 2 * power) / cells**2)
        hits = float((values > found.threshold[0, number]).mean())
        pod = float(found.pod[0, number])
        assert hits == pytest.approx(pod, abs=4 * math.sqrt(pod * (1 - pod) / count) + 0.01)


# ------------------------------------------------------------------------------------------------- the line


def test_signal_and_noise_of_a_plate_are_those_of_the_predicted_contrast(line):
    product, thing = Filter(material="chicken_breast", thickness_mm=16.0), Filter(material="rib_bone", thickness_mm=1.0)
    plates = objects_of_shape(
        Shape(kind="plate", height_mm=1.0),
        sizes_mm=[3.0, 6.0],
        pixel_mm=line.object_pixel_mm,
        product_mm=[16.0],
        product_material=product.material,
        foreign_material=thing.material,
        area_px=4096.0,
    )
    assert plates.object_mm == pytest.approx(1.0, rel=0.2)  # border pixels are covered in part
    plates = dataclasses.replace(plates, object_mm=np.ones(2))
    low, high = pair_at(50)
    known = SlabContrasts(line.twin, product=product, foreign_object=thing).contrast(low, high, intervals=False)
    images = line.pair_images([(low, high)], plates, image="low")
    assert images.delta_R[0, 0] == pytest.approx(known.delta_R.value, rel=1e-3)
    assert images.signal[0, 0, 0, 0] == pytest.approx(known.low.M_object - known.low.M_product, rel=1e-3)
    share = line.twin.noise.spread.value.variance_share
    sd = math.sqrt(images.quantum[0, 0, 0] * share + images.white[0, 0, 0])
    assert sd == pytest.approx(known.low.sd_M_product, rel=0.01)


def test_both_images_are_seen_as_well_as_their_texture_allows(line):
    """No texture: all that each image shows; the more of it, the nearer to the combination that it drops out of."""
    objects, pair = rods(line), [pair_at(40)]

    def squared(image, texture=None):
        return observe_settings(line, pair, objects, observer=Observer(image=image), texture=texture).d_prime[0] ** 2

    def some(amount):
        return ProductTexture(amplitude_mm4=amount, exponent=0.0, lowest_per_mm=0.02)

    assert squared("both") == pytest.approx(squared("low") + squared("high"), rel=1e-9)
    assert squared("both", some(1e6)) == pytest.approx(squared("residual"), rel=1e-3)
    between = squared("both", some(0.01))
    for least in (squared("residual"), squared("low", some(0.01)), squared("high", some(0.01))):
        assert np.all(between > least)
    with pytest.raises(InputError, match="weighs two images"):
        Observer(image="both", detector="npw")


def test_exposure_motion_and_texture_move_a90_the_way_they_must(line):
    objects = rods(line)
    at_rest = observe_settings(line, [pair_at(exposure) for exposure in (10, 20, 40, 80)], objects)
    assert np.all(np.diff(at_rest.a90) < 0) and np.all(at_rest.a50 < at_rest.a90)
    moving = observe_settings(line, [pair_at(40, belt_speed_mm_s=speed) for speed in (1, 30, 60)], objects)
    assert moving.a90[0] == pytest.approx(at_rest.a90[2], rel=2e-3)
    assert at_rest.a90[2] < moving.a90[1] < moving.a90[2]
    texture = ProductTexture(amplitude_mm4=0.5, exponent=3.0, lowest_per_mm=0.02)
    plain, textured = (
        observe_settings(line, [pair_at(80)], objects, observer=Observer(image="low"), texture=one)
        for one in (None, texture)
    )
    assert np.all(textured.d_prime < plain.d_prime)
    # the product's thickness drops out of the residual
    again = observe_settings(line, [pair_at(80)], objects, texture=texture)
    assert again.d_prime[0] == pytest.approx(at_rest.d_prime[3], rel=1e-6)
    # few false alarms cost detection
    rare = observe_settings(line, [pair_at(40)], objects, observer=Observer(false_alarm_rate=1e-4))
    assert rare.a90[0] > at_rest.a90[2]


def test_delta_R_at_a90_is_that_of_the_object_found(line):
    objects = rods(line, sizes=np.geomspace(1.0, 25.0, 30), turns_deg=[0.0])
    pair = pair_at(30)
    found = observe_settings(line, [pair], objects)
    own = rods(line, sizes=[float(found.a90[0]), 28.0], turns_deg=[0.0])
    assert line.pair_images([pair], own).delta_R[0, 0] == pytest.approx(found.a90_delta_R[0], rel=0.02)


def test_what_no_size_reaches_is_no_number(line):
    found = observe_settings(line, [pair_at(0.05), pair_at(4000)], rods(line, sizes=[8.0, 12.0]))
    assert np.all(np.isnan(found.a90))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda line: Observer(detector="best"), "got best"),
        (lambda line: Observer(false_alarm_rate=0.0), "false-alarm rate"),
        (lambda line: Observer(efficiency=math.nan), "efficiency"),
        (lambda line: Shape(kind="cube"), "ellipsoid"),
        (lambda line: rods(line, sizes=[2.0, 1.0]), "rising"),
        (lambda line: rods(line, sizes=[1.0, 400.0]), "px long"),
        (lambda line: rods(line, product_mm=[1.0], displaces=True), "whose place it takes"),
        (lambda line: observe_settings(line, [], rods(line)), "one pair"),
        (lambda line: observe_settings(line, [pair_at(10, binning=2)], rods(line)), "binning"),
        (lambda line: observe_settings(line, [pair_at(10)], rods(line), observer=Observer(image="all")), "residual"),
        (
            lambda line: search_threshold(row_correlation=0, column_correlation=0, area_px=9, false_alarm_rate=2),
            "between 0 and 1",
        ),
        (lambda line: frequency_bins(7), "even number"),
        (lambda line: object_spectrum(np.zeros((4, 4)), frequency_bins(8)), "nothing in it"),
    ],
)
def test_bad_input_is_one_line(line, call, message):
    with pytest.raises(InputError, match=message):
        call(line)


@given(st.floats(-0.3, 0.99), st.floats(-0.3, 0.99), st.floats(100.0, 1e6), st.floats(1e-4, 0.3))
@settings(deadline=None, max_examples=50)
def test_the_threshold_is_where_the_chance_is_the_rate(row, column, area, rate):
    found = {"row_correlation": row, "column_correlation": column}
    threshold = float(search_threshold(**found, area_px=area, false_alarm_rate=rate))
    around = threshold + np.linspace(-0.05, 0.05, 11)
    chance = -np.expm1(-area * chance_of_maximum(around, **found))
    if threshold > -1.9:  # else the few maxima that there are do not suffice for so many alarms
        assert chance[0] > rate * 0.99 and chance[-1] < rate * 1.01
    # never more places than pixels
    assert float(independent_places(threshold, rate)) <= area * 1.02


# ------------------------------------------------------------------------------------------------- networks


PAIRS = [pair_at(exposure, kV=kV) for exposure in (10, 25, 60, 150) for kV in ((40, 90), (50, 80))]
TRUE = Observer(efficiency=0.8, internal_noise=0.1, false_alarm_rate=0.05)


def measured_sizes(line, objects, rng, *, scatter, error):
    truth = observe_settings(line, PAIRS, objects, observer=TRUE).a90
    found = truth * np.exp(scatter * rng.standard_normal(len(PAIRS)) + error * rng.standard_normal(len(PAIRS)))
    reach = math.exp(1.959964 * error)
    return [
        MeasuredSize(pair=pair, a90=value, low=value / reach, high=value * reach)
        for pair, value in zip(PAIRS, found, strict=True)
    ]


def test_efficiency_and_internal_noise_come_back_from_a90s_without_errors(line):
    objects = rods(line, sizes=np.geomspace(0.6, 28.0, 16), turns_deg=[0.0])
    truth = observe_settings(line, PAIRS, objects, observer=TRUE).a90
    assert np.all(np.isfinite(truth))
    measured = measured_sizes(line, objects, np.random.default_rng(3), scatter=0.0, error=0.002)
    found = fit_efficiency(line, measured, objects, observer=Observer(false_alarm_rate=0.05))
    assert found.observer.efficiency == pytest.approx(TRUE.efficiency, rel=0.05)
    assert found.observer.internal_noise == pytest.approx(TRUE.internal_noise, rel=0.1)
    assert found.left_out_rms < 0.01 and found.scatter < 0.01
    again = predicted_sizes(line, PAIRS, objects, found)
    assert again.a90 == pytest.approx(truth, rel=0.01)
    assert np.all((again.low < truth) & (truth < again.high))


def test_a_scatter_between_settings_is_in_the_interval(line):
    objects = rods(line, sizes=np.geomspace(0.6, 28.0, 16), turns_deg=[0.0])
    found = [
        fit_efficiency(
            line,
            measured_sizes(line, objects, np.random.default_rng(seed), scatter=0.15, error=0.03),
            objects,
            observer=Observer(false_alarm_rate=0.05),
        )
        for seed in range(4)
    ]
    # 4 x 8 departures of 0.15 tell their size to a fifth; left-out settings of such lie inside as they should
    assert float(np.sqrt(np.mean([one.scatter**2 for one in found]))) == pytest.approx(0.15, rel=0.5)
    inside = sum(row.inside for one in found for row in one.left_out)
    assert inside >= 28


def test_a_calibrated_observer_is_read_back_as_written(line, tmp_path):
    objects = rods(line, sizes=np.geomspace(0.6, 28.0, 10), turns_deg=[0.0])
    measured = measured_sizes(line, objects, np.random.default_rng(3), scatter=0.1, error=0.05)
    found = fit_efficiency(line, measured[:5], objects, observer=Observer(false_alarm_rate=0.05))
    write_efficiency(tmp_path / "observer.json", found)
    assert read_efficiency(tmp_path / "observer.json") == found
    assert (found.product_material, found.foreign_material) == (objects.product_material, objects.foreign_material)
    (tmp_path / "other.json").write_text("[1]")
    with pytest.raises(FileFormatError, match="raytwin-observer"):
        read_efficiency(tmp_path / "other.json")
    cut = json.loads((tmp_path / "observer.json").read_text())
    del cut["unit"]
    (tmp_path / "cut.json").write_text(json.dumps(cut))
    with pytest.raises(FileFormatError, match="incomplete"):
        read_efficiency(tmp_path / "cut.json")
    with pytest.raises(InputError, match="4 or more"):
        fit_efficiency(line, measured[:3], objects, observer=Observer())


def test_an_ideal_observer_that_networks_surpass_is_warned_of(line):
    objects = rods(line, sizes=np.geomspace(0.6, 28.0, 10), turns_deg=[0.0])
    measured = measured_sizes(line, objects, np.random.default_rng(3), scatter=0.0, error=0.05)
    found = fit_efficiency(line, measured[:5], objects, observer=Observer(false_alarm_rate=0.05))
    assert found.observer.efficiency < 1 and found.warnings == ()
    above = dataclasses.replace(found, observer=dataclasses.replace(found.observer, efficiency=2.8))
    (told,) = above.warnings
    assert told.startswith("efficiency 2.8 (95 %: ") and "is above 1: networks see more than" in told
    answer = CalibratedObserver(efficiency=above)
    assert answer.to_dict()["warnings"] == [told] and told in repr(answer)
    blind = dataclasses.replace(above, observer=dataclasses.replace(above.observer, detector="npw", image="low"))
    assert blind.warnings == ()


def references_of(attributes):
    return SimpleNamespace(path="references.h5", attributes=attributes)


def test_materials_are_those_that_the_references_state():
    casting = {"description": '[[product]]\nmaterial = "Al"\n[[foreign_object]]\nmaterial = "air"\n'}
    assert materials_seen(references_of(casting), None) == ("Al", "air")
    assert materials_seen(references_of(casting), None, foreign_material="air") == ("Al", "air")
    assert materials_seen(references_of(casting | {"product_material": "Mg"}), None) == ("Mg", "air")
    assert materials_seen(references_of({}), None) == ("chicken_breast", "rib_bone")
    with pytest.raises(InputError, match="product_material: got chicken_breast; expected Al, which references"):
        materials_seen(references_of(casting), None, product_material="chicken_breast")
    both = {"description": casting["description"] + '[[foreign_object]]\nmaterial = "glass"\n'}
    assert materials_seen(references_of(both), None, foreign_material="glass") == ("Al", "glass")
    with pytest.raises(InputError, match="of air and glass; expected one of these; state it"):
        materials_seen(references_of(both), None)
    with pytest.raises(FileFormatError, match="attribute description: got text that is not TOML"):
        materials_seen(references_of({"description": "[["}), None)


def test_a_calibrated_observer_looks_at_the_materials_it_was_calibrated_with(line):
    objects = rods(line, sizes=np.geomspace(0.6, 28.0, 10), turns_deg=[0.0])
    measured = measured_sizes(line, objects, np.random.default_rng(3), scatter=0.1, error=0.05)
    found = fit_efficiency(line, measured[:5], objects, observer=Observer(false_alarm_rate=0.05))
    jam = dataclasses.replace(found, product_material="C2.103H8.297O4.148@1.30", foreign_material="glass")
    silent = references_of({})
    assert materials_seen(silent, jam) == ("C2.103H8.297O4.148@1.30", "glass")
    assert materials_seen(silent, dataclasses.replace(found, product_material=None))[0] == "chicken_breast"
    with pytest.raises(InputError, match="with which the observer was calibrated"):
        materials_seen(silent, jam, product_material="chicken_breast")
    with pytest.raises(InputError, match="got rib_bone; expected glass, with which the observer was calibrated"):
        materials_seen(references_of({"foreign_material": "rib_bone"}), jam)
    with pytest.raises(InputError, match="with which the observer was calibrated"):
        predicted_sizes(line, PAIRS[:1], objects, jam)


def test_a_setting_that_the_line_cannot_have_gets_no_number(line, make_model_twin):
    import raytwin as rt

    words = {"product": "chicken_breast:16", "foreign_object": "rib_bone"}
    found = rt.observe(line.twin, [pair_at(20), pair_at(60000)], **words)
    assert found.rows[0]["a90"] is not None and 0 < found.pod[0][-1] <= 1
    assert found.rows[1]["a50"] is None and found.rows[1]["a90"] is None and found.rows[1]["a90_delta_R"] is None
    assert all(math.isnan(one) for one in found.pod[1])
    assert sum("saturates" in text for text in found.warnings) == 1
    assert not any("outside the calibrated range" in text for text in found.warnings)
    # next to no light: the logarithm of a pixel is no straight one, and noise added to it tells nothing
    dim = rt.observe(line.twin, [pair_at(0.2), pair_at(20)], **words)
    assert dim.rows[0]["a90"] is None and dim.rows[1]["a90"] is not None
    assert sum("noisier than 30 %" in text for text in dim.warnings) == 1
    # nothing is larger than the field
    assert max(dim.sizes) == pytest.approx(min(line.twin.maps.shape) * line.object_pixel_mm)
    beyond = rt.observe(line.twin, pair_at(5, kV=(40, 120)), **words)
    (told,) = (text for text in beyond.warnings if "outside the calibrated range" in text)
    assert told.startswith("kv=120") and "kV (" in told
    weak = dataclasses.replace(line.twin, instrument=dataclasses.replace(line.twin.instrument, maximum_kV=80.0))
    refused = rt.observe(weak, pair_at(20), **words)
    assert refused.rows[0]["a90"] is None and any("kV" in text for text in refused.warnings)

"""Images of a twin with effects: the picture, the noise and the readout are those of the series model."""

import math
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition.dataset_io import DatasetRow, read_dataset, write_dataset
from raytwin.acquisition.setting import Setting, setting_from_text
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.datasets.belt_motion import twin_on_belt
from raytwin.generator.datasets.fresh import FreshReferences
from raytwin.generator.datasets.generate import ChannelModel, ReferenceImages, generate_dataset
from raytwin.generator.datasets.generate_described import DescribedScenes
from raytwin.generator.datasets.render import render_expected
from raytwin.generator.effects import EFFECTS, AppliedEffect, effect_of
from raytwin.generator.frames.line_model import LineModel
from raytwin.generator.frames.response import responded
from raytwin.generator.line.series_request import SeriesRequest
from raytwin.generator.scenes.describe import read_description
from raytwin.generator.twins.twin_io import write_twin

NOT_IN_IMAGES = {name: effect.images.left_out for name, effect in EFFECTS.items() if effect.images.left_out}
COPPER = "exposure_ms=20,filter=Cu:0.05"
LOW = setting_from_text(f"kv=40,power_w=40,{COPPER}")
HIGH = setting_from_text(f"kv=90,power_w=45,{COPPER}")
REFERENCE = (
    setting_from_text("kv=40,power_w=40,exposure_ms=100,averaged=100,filter=Cu:0.05"),
    setting_from_text("kv=90,power_w=45,exposure_ms=100,averaged=100,filter=Cu:0.05"),
)
SHAPE = (40, 40)
FILLET = """
[[product]]
name = "fillet"
shape = "fillet"
material = "chicken_breast"
length_mm = [4.5, 5]
width_mm = [3, 3.5]
height_mm = [2, 4]
"""


def with_effect(twin, effect, since="calibration", **parameters):
    return replace(twin, effects=(AppliedEffect(id=effect, parameters=parameters, since=since),))


def hill(height_mm=15.0):
    row, column = np.indices(SHAPE)
    return height_mm * np.exp(-0.5 * ((row - 19.5) ** 2 + (column - 19.5) ** 2) / 7.0**2)


def channel(twin, effects, setting=HIGH):
    return ChannelModel(twin, setting, "water_liquid", "repaired", tuple(effects))


def fine_moments(twin, setting, thickness_mm):
    """Signal and variance over the open beam on three rays a pixel, and thickness maps of the pixels' middles."""
    from raytwin.generator.line.spectral_signal import OpenBeam
    from raytwin.generator.predictions.predict import spectral_model_of

    model = spectral_model_of(twin)
    weights = model.moment_weights(twin.spectral.best, OpenBeam(kV=setting.kV, filters=setting.filters))[:2]
    through = np.exp(-thickness_mm[..., None] * model.mu("water_liquid")[: weights.shape[1]])
    return [(through @ row / row.sum()).repeat(3, axis=0).repeat(3, axis=1) for row in weights]


# ------------------------------------------------------------------------------------------------ against the series model


# worked into the twin's numbers, before its images are drawn
WORKED_IN = {"kv_error", "filtration_error", "threshold_error"}


@pytest.mark.parametrize("effect", sorted(set(EFFECTS) - set(NOT_IN_IMAGES) - WORKED_IN))
@pytest.mark.parametrize("size", ["weak", "usual", "strong", "beyond"])
def test_the_mean_picture_with_any_effect_is_that_of_the_series_model(series_line, as_counter, effect, size):
    known = EFFECTS[effect].strength
    strength = {"weak": known.low, "usual": known.default, "strong": known.high, "beyond": 1.8 * known.high}[size]
    applied = AppliedEffect(id=effect, parameters={"strength": strength}, since="calibration")
    if "counting" in EFFECTS[effect].needs:
        series_line = as_counter(series_line)
    thickness = hill()
    effects = channel(series_line, [applied]).image_effects
    asked = SeriesRequest(
        kind="object",
        setting=HIGH,
        frames=1,
        exposure_ms=20.0,
        thickness_mm={"water_liquid": thickness},
        product_material="water_liquid",
        scene_kind="product",
    )
    try:
        wanted = LineModel(series_line, effects=(applied,)).expect(asked)
    except InputError as refused:
        # no line can have as much of it
        assert size == "beyond" and effects.warnings == (f"effect {effect} is not in the images: {refused}",)
        return
    thicker = thickness * effects.attenuation_scale(("water_liquid",)).get("water_liquid", 1.0)
    image = effects.image(*fine_moments(series_line, HIGH, thicker), {"water_liquid": thickness}, focal_blur_px=0.0)
    mean = responded(image.state, image.charge.mean)
    # a smooth hill: cells that are flat within a pixel are as good as the series' slopes within 2e-3; 1 DN where most is absorbed
    np.testing.assert_allclose(mean, wanted.signal_DN, rtol=3e-3, atol=3e-4 * float(effects.flat_DN.max()))
    flat = LineModel(series_line, effects=(applied,)).expect(replace(asked, kind="flat", thickness_mm=None))
    np.testing.assert_allclose(effects.flat_DN, flat.signal_DN * np.ones(SHAPE), rtol=3e-4)
    plain = LineModel(series_line, effects=()).expect(asked)
    if size == "usual" and effect in ("object_scatter", "composition_error", "heel", "veiling_glare"):
        assert np.abs(wanted.signal_DN / plain.signal_DN - 1).max() > 4e-3


def test_images_of_moving_objects_stay_where_their_masks_are(series_line):
    thickness = hill()
    found = []
    for mean_place in (0.0, 0.5):
        applied = AppliedEffect(id="motion_blur", parameters={"strength": 8.0, "mean_place": mean_place})
        effects = channel(series_line, [applied]).image_effects
        moments = fine_moments(series_line, HIGH, thickness)
        found.append(effects.image(*moments, {"water_liquid": thickness}, focal_blur_px=0.0).charge.mean)
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.parametrize(
    "effect", ["excess_noise", "mtf_tail", "k_fluorescence", "row_noise", "output_drift", "quantisation"]
)
def test_the_noise_of_images_with_an_effect_is_that_of_the_series_model(series_line, effect):
    applied = AppliedEffect(id=effect, parameters={}, since="calibration")
    thickness = np.full(SHAPE, 10.0)
    model = channel(series_line, [applied], LOW)
    image = model.image_effects.image(
        *fine_moments(series_line, LOW, thickness), {"water_liquid": thickness}, focal_blur_px=0.0
    )
    rng = np.random.default_rng(3)
    frames = np.stack([model.image_effects.sample(image, rng) for _ in range(150)]).astype(np.float64)
    asked = SeriesRequest(
        kind="object",
        setting=LOW,
        frames=150,
        exposure_ms=20.0,
        thickness_mm={"water_liquid": thickness},
        product_material="water_liquid",
        scene_kind="product",
    )
    drawn = LineModel(series_line, effects=(applied,)).sample(asked, rng=np.random.default_rng(4))
    series = np.stack(list(drawn)).astype(np.float64)
    inner = (slice(None), slice(4, -4), slice(4, -4))
    variances, neighbours = [], []
    for stack in (frames, series):
        departure = stack - stack.mean(axis=0)
        variances.append(departure[inner].var(ddof=1, axis=0).mean())
        neighbours.append((departure[inner][:, :, 1:] * departure[inner][:, :, :-1]).mean() / variances[-1])
    # 150 frames of 1024 pixels, five correlated neighbours each; a common factor has 150 draws alone
    few = 0.12 if effect == "output_drift" else 0.0
    assert variances[0] / variances[1] == pytest.approx(1.0, abs=4 * math.sqrt(2 * 2 * 5 / (150 * 1024)) + few)
    assert neighbours[0] == pytest.approx(neighbours[1], abs=0.015 + few)


@pytest.mark.parametrize("effect", ["mtf_tail", "row_noise", "quantisation", "veiling_glare"])
def test_what_was_always_there_correlates_noise_and_leaves_the_variance_as_calibrated(series_line, effect):
    parameters = {"strength": 1.0} if effect == "row_noise" else {"strength": 20.0}
    applied = AppliedEffect(id=effect, parameters=parameters, since="always")
    thickness = np.zeros(SHAPE)
    variances, rows = {}, {}
    for name, effects in (
        ("effect", (applied,)),
        ("plain", (AppliedEffect(id="row_noise", parameters={"strength": 0}),)),
    ):
        model = channel(series_line, effects, LOW)
        drawn = model.image_effects.image(
            *fine_moments(series_line, LOW, thickness), {"water_liquid": thickness}, focal_blur_px=0.0
        )
        rng = np.random.default_rng(5)
        frames = np.stack([model.image_effects.sample(drawn, rng) for _ in range(200)]).astype(np.float64)
        variances[name] = frames.var(ddof=1, axis=0).mean()
        rows[name] = frames.mean(axis=2).var(ddof=1, axis=0).mean()
    # the spread of 200 frames of 1600 pixels, a few of which share their noise; a row's noise counts 8000 times
    few = 0.05 if effect == "row_noise" else 0.03
    assert variances["effect"] / variances["plain"] == pytest.approx(1.0, abs=few)
    if effect == "row_noise":
        assert rows["effect"] > 1.5 * rows["plain"]


# ------------------------------------------------------------------------------------------------ described scenes


@pytest.fixture(scope="module")
def fillets(tmp_path_factory):
    path = tmp_path_factory.mktemp("description") / "fillets.toml"
    path.write_text(FILLET, encoding="utf-8")
    return read_description(path)


@pytest.mark.parametrize(("detector", "told"), [("line", False), ("tdi", False), ("area", True), (None, True)])
def test_the_direction_of_the_belt_is_in_doubt_on_panels_alone(make_model_twin, detector, told):
    twin = make_model_twin(SHAPE, pixel_mm=0.15, source_object_mm=900.0, source_detector_mm=1059.0, detector=detector)
    moving = Setting(kV=60.0, exposure_ms=5.0, power_W=10.0, belt_speed_mm_s=100.0)
    _, lines = twin_on_belt(twin, (moving, moving))
    assert any("belt_axis is not declared" in line for line in lines) == told


def test_the_way_through_the_effects_shows_the_same_picture_when_they_do_nothing(make_model_twin, fillets):
    twin = make_model_twin(SHAPE, pixel_mm=0.15, focal_spot_mm=0.8)
    pairs = {}
    for name, line in (("plain", twin), ("effects", with_effect(twin, "row_noise", strength=1e-9))):
        scenes = DescribedScenes(line, fillets, low=LOW, high=HIGH, seed=4)
        pairs[name] = (scenes, scenes.pair(0))
    for plane in (0, 1):
        plain, through = (pairs[name][1].expected[plane].log_image for name in ("plain", "effects"))
        # borders of the frame mirror in one and repeat in the other
        np.testing.assert_allclose(through[3:-3, 3:-3], plain[3:-3, 3:-3], atol=2e-4)
    rng = np.random.default_rng(1)
    noise = [
        np.stack([scenes.draw(pair, rng) for _ in range(40)]).var(ddof=1, axis=0, dtype=np.float64).mean(axis=(1, 2))
        for scenes, pair in pairs.values()
    ]
    # 40 frames of 1600 pixels, about three of which share their noise, twice
    np.testing.assert_allclose(noise[1] / noise[0], 1.0, atol=4 * math.sqrt(2 * 2 * 3 / (39 * 1600)))
    assert pairs["plain"][1].row.contrast != pairs["plain"][1].row.contrast  # no foreign object: NaN


def test_scatter_brightens_the_shadow_of_a_described_product(make_model_twin, tmp_path, capsys):
    import json

    twin = make_model_twin((32, 40), pixel_mm=0.6, source_object_mm=900.0, source_detector_mm=1059.0)
    text = FILLET.replace("[4.5, 5]", "[14, 15]").replace("[3, 3.5]", "[10, 11]").replace("[2, 4]", "[12, 14]")
    (tmp_path / "fillets.toml").write_text(text, encoding="utf-8")
    write_twin(tmp_path / "plain.h5", twin)
    write_twin(tmp_path / "scatter.h5", with_effect(twin, "object_scatter", since="always", strength=20.0))
    logs = {}
    for name in ("plain", "scatter"):
        options = ["--low", str(LOW), "--high", str(HIGH), "-n", "4", "--seed", "3", "--json"]
        out = tmp_path / f"{name}_images.h5"
        assert (
            main(["generate", str(tmp_path / f"{name}.h5"), str(tmp_path / "fillets.toml"), "-o", str(out), *options])
            == 0
        )
        assert json.loads(capsys.readouterr().out)["warnings"] == []
        with read_dataset(out) as dataset:
            masks = [dataset.product_masks(number) for number in range(4)]
            logs[name] = [np.median(dataset.images(number)[1][masks[number]]) for number in range(4)]
    lower = np.array(logs["plain"]) - np.array(logs["scatter"])
    # 20 % of the primary behind 20 mm of water in the middle of an even field; a fillet of 9 mm that fills a part gives less
    assert np.all(lower > 0.01) and np.all(lower < 0.15)


def test_effects_that_images_cannot_hold_are_named_once(series_line, fillets):
    effects = tuple(AppliedEffect(id=name, parameters={}, since="always") for name in sorted(NOT_IN_IMAGES))
    scenes = DescribedScenes(replace(series_line, effects=effects), fillets, low=LOW, high=HIGH, seed=1)
    told = [line for line in scenes.warnings if line.startswith("effect ")]
    assert told == [f"effect {name} is not in the images: {NOT_IN_IMAGES[name]}" for name in told_order(effects)]
    scenes.pair(0)


def told_order(effects):
    return [item.id for item in effects]


# ------------------------------------------------------------------------------------------------ references


@pytest.fixture(scope="module")
def references(series_line, tmp_path_factory):
    """Noiseless references of two hills of water, 10 s each."""
    path = tmp_path_factory.mktemp("references") / "references.h5"
    geometry = None
    with write_dataset(path, shape=SHAPE, provenance={}) as writer:
        for number, height in enumerate((8.0, 15.0)):
            thickness = hill(height)
            from raytwin.generator.datasets.render import geometry_of

            geometry = geometry_of(series_line, settings=(LOW, HIGH))
            images = render_expected(
                {"water_liquid": thickness.repeat(3, axis=0).repeat(3, axis=1)},
                twin=series_line,
                channels=[ChannelModel(series_line, one, "water_liquid").channel() for one in (LOW, HIGH)],
                geometry=geometry,
            )
            writer.append(
                image=np.stack([one.log_image for one in images]).astype(np.float32),
                foreign_object_mask=np.zeros(SHAPE),
                product_mask=thickness > 1.0,
                row=DatasetRow(image=f"hill{number}", setting=f"{REFERENCE[0]};{REFERENCE[1]}"),
            )
    return path


def mean_log(twin, references, *, low=LOW, high=HIGH, n=12, **options):
    with read_dataset(references) as dataset:
        images = ReferenceImages(twin, dataset, low=low, high=high, product_material="water_liquid", **options)
        counts = [images.counts(1, np.random.default_rng(seed))[0] for seed in range(n)]
        return np.stack([images.log_images(one) for one in counts]).mean(axis=0), np.stack(counts), images


def test_what_came_after_calibration_changes_references_and_what_was_always_there_does_not(series_line, references):
    plain, _, _ = mean_log(series_line, references)
    centre = (1, slice(14, 26), slice(14, 26))
    for since, sign in (("calibration", 1), ("always", 0)):
        twin = with_effect(series_line, "object_scatter", since=since, strength=30.0)
        found, _, _ = mean_log(twin, references)
        drop = float(np.mean(plain[centre] - found[centre]))
        if sign:
            # the series model says by how much
            thickness = hill(15.0)
            asked = SeriesRequest(
                kind="object", setting=HIGH, frames=1, exposure_ms=20.0, thickness_mm={"water_liquid": thickness}
            )
            with_it = LineModel(series_line, effects=twin.effects).expect(asked).signal_DN
            without = LineModel(series_line, effects=()).expect(asked).signal_DN
            wanted = float(np.mean(np.log(with_it / without)[centre[1:]]))
            assert drop == pytest.approx(wanted, rel=0.05) and wanted > 0.02
        else:
            assert abs(drop) < 0.002


@pytest.mark.parametrize(
    ("effect", "parameters"),
    [
        ("focal_spot", {}),
        ("mtf_tail", {}),
        ("veiling_glare", {}),
        ("motion_blur", {}),
        ("motion_blur", {"strength": 9.0, "acceleration": 1.0}),
        ("heel", {}),
    ],
)
def test_a_late_change_of_the_picture_reaches_references_as_the_series_model_has_it(
    series_line, references, effect, parameters
):
    applied = AppliedEffect(id=effect, parameters=parameters, since="calibration")
    model = channel(series_line, [applied])
    with read_dataset(references) as dataset:
        quiet = np.exp(-dataset.images(1)[1].astype(np.float64))
    change = model.image_effects.picture_change(quiet, model.thickness_behind(quiet))
    asked = SeriesRequest(
        kind="object", setting=HIGH, frames=1, exposure_ms=20.0, thickness_mm={"water_liquid": hill(15.0)}
    )
    shape = series_line.levels[1].flat_shape
    wanted = [LineModel(series_line, effects=one).expect(asked).signal_DN / shape for one in ((applied,), ())]
    level = model.image_effects.open_level_DN
    np.testing.assert_allclose(change, (wanted[0] - wanted[1]) / level, atol=2e-3, rtol=0.05)


def test_excess_noise_after_calibration_is_missing_in_references_and_added(series_line, references):
    _, plain, _ = mean_log(series_line, references, n=60)
    _, noisy, _ = mean_log(with_effect(series_line, "excess_noise", strength=80.0), references, n=60)
    read = 12.0**2 + 1 / 12
    inner = (slice(None), 1, slice(4, -4), slice(4, -4))
    before, after = (stack[inner].astype(np.float64).var(ddof=1, axis=0).mean() for stack in (plain, noisy))
    # the drawn noise is what the reference of 500 times the load lacks: of now's 1.8, 1/500 of then's 1
    share = 1 / 500
    assert after - read == pytest.approx((before - read) * (1.8 - share) / (1 - share), rel=0.03)


def test_quantisation_gain_pattern_bad_pixels_and_drift_show_in_images_from_references(series_line, references):
    _, counts, _ = mean_log(with_effect(series_line, "quantisation", strength=16.0), references)
    assert np.all(counts % 16 == 0)
    log, _, _ = mean_log(with_effect(series_line, "gain_map_error", strength=2.0), references, n=40)
    plain, _, _ = mean_log(series_line, references, n=40)
    assert float(np.std((log - plain)[1])) == pytest.approx(0.02, rel=0.1)
    _, counts, _ = mean_log(with_effect(series_line, "bad_pixels", strength=2.0), references)
    dead = np.abs(counts[:, 1].mean(axis=0) - 1200.0) < 40
    assert 0 < dead.mean() < 0.03
    _, counts, _ = mean_log(with_effect(series_line, "output_drift", strength=3.0), references, n=60)
    levels = np.median(counts[:, 1], axis=(1, 2)) - 1200.0
    assert np.std(levels) / np.mean(levels) == pytest.approx(0.03, rel=0.35)


def test_a_bent_response_that_was_always_there_is_not_bent_twice(series_line, references):
    twin = with_effect(series_line, "nonlinearity", since="always", strength=5.0)
    model = channel(series_line, twin.effects)
    charge = model.open_signal_DN
    true = np.full(SHAPE, 0.4)
    ((bend, _),) = model.image_effects._end.bends
    opened = charge * (1 - bend * charge)
    measured = 0.4 * charge * (1 - bend * 0.4 * charge) / opened
    np.testing.assert_allclose(model.image_effects.straightened(measured, open_signal_DN=opened), true, rtol=1e-9)
    assert np.abs(measured - true).max() > 1e-3
    # and the open field is the measured one
    np.testing.assert_allclose(model.image_effects.flat_DN, model.open_signal_DN, rtol=1e-9)


@pytest.mark.parametrize("effect", [pytest.param("filtration_error", marks=pytest.mark.slow), "kv_error"])
def test_a_beam_that_changed_after_calibration_hardens_references_as_the_model_says(series_line, references, effect):
    strength = 0.6 if effect == "filtration_error" else 4.0
    twin = with_effect(series_line, effect, strength=strength)
    found, _, images = mean_log(twin, references, foreign_material="Al", n=40)
    assert images.transfers
    asked = SeriesRequest(
        kind="object", setting=LOW, frames=1, exposure_ms=20.0, thickness_mm={"water_liquid": hill(15.0)}
    )
    for plane, setting in enumerate((LOW, HIGH)):
        objects = [
            LineModel(series_line, effects=one).expect(replace(asked, setting=setting)).signal_DN
            for one in (twin.effects, ())
        ]
        flats = [
            LineModel(series_line, effects=one)
            .expect(replace(asked, kind="flat", thickness_mm=None, setting=setting))
            .signal_DN
            for one in (twin.effects, ())
        ]
        logs = [-np.log(obj / flat)[16:24, 16:24].mean() for obj, flat in zip(objects, flats, strict=True)]
        assert found[plane, 16:24, 16:24].mean() == pytest.approx(logs[0], abs=0.25 * abs(logs[1] - logs[0]) + 0.001)
        assert abs(logs[1] - logs[0]) > 0.004


def test_the_published_recipe_says_that_it_leaves_effects_out(series_line, references, tmp_path):
    twin = with_effect(series_line, "excess_noise", strength=50.0)
    hashes = []
    for number, line in enumerate((series_line, twin)):
        with read_dataset(references) as dataset:
            summary = generate_dataset(
                line, dataset, tmp_path / f"{number}.h5", low=LOW, high=HIGH, images=2, seed=1, recipe="as_published"
            )
        with read_dataset(tmp_path / f"{number}.h5") as dataset:
            hashes.append(dataset.images(0).tobytes())
    assert hashes[0] == hashes[1]
    assert "the published recipe knows no effects: those of the twin are left out" in summary.warnings


def test_fresh_images_hold_the_effects(series_line, references):
    twin = with_effect(series_line, "row_noise", strength=2.0)
    fresh = FreshReferences(twin, str(references), low=LOW, high=HIGH, seed=1, product_material="water_liquid")
    plain = FreshReferences(series_line, str(references), low=LOW, high=HIGH, seed=1, product_material="water_liquid")
    rows = [one.log_images(0, epoch=0)[0][:, :6].mean(axis=1).std() for one in (fresh, plain)]
    assert rows[0] > 1.5 * rows[1]


def test_a_reference_twin_without_spectrum_says_which_effects_are_left_out(series_line, references):
    twin = with_effect(replace(series_line, spectral=None), "object_scatter")
    _, _, images = mean_log(twin, references, n=1)
    assert [line for line in images.warnings if "object_scatter" in line] == [
        "effect object_scatter is not in the images: the twin has no spectral part"
    ]


def test_every_effect_of_the_catalogue_has_its_place_in_images(series_line, as_counter, fillets):
    for name in EFFECTS:
        applied = AppliedEffect(id=name, parameters={}, since="calibration")
        line = as_counter(series_line) if "counting" in EFFECTS[name].needs else series_line
        line = replace(line, effects=(applied,))
        scenes = DescribedScenes(line, fillets, low=LOW, high=HIGH, seed=1)
        told = [line for line in scenes.warnings if name in line]
        assert bool(told) == (name in NOT_IN_IMAGES), (name, told, effect_of(applied).needs)
        counts = scenes.draw(scenes.pair(0), np.random.default_rng(1))
        assert counts.shape == (2, *SHAPE) and np.all(np.isfinite(counts))

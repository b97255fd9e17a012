"""Datasets from descriptions: scenes obey their rules, images are the exact projection with the detector's noise."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from raytwin.acquisition import Setting, read_dataset
from raytwin.acquisition.contrast import delta_r, object_and_ring
from raytwin.acquisition.setting import filters_from_text
from raytwin.cli import main
from raytwin.errors import FileFormatError, InputError
from raytwin.generator.datasets.generate_described import DescribedScenes, generate_from_description
from raytwin.generator.datasets.render import Geometry, geometry_of, render_expected
from raytwin.generator.line.spectral_signal import OpenBeam
from raytwin.generator.line.twin import estimate_from_sd, gaussian_spread
from raytwin.generator.predictions.predict import spectral_model_of
from raytwin.generator.scenes.describe import read_description, read_thickness_map, sample_individual, sample_scene
from raytwin.generator.scenes.kinds import KINDS
from raytwin.generator.spread.psf import blur_variance_share
from raytwin.generator.twins.twin_io import write_twin

SHAPE = (64, 80)
SIGMA, WHITE, READ = 0.5, 0.01, 12.0
COPPER = filters_from_text("Cu:0.05")
LOW = Setting(kV=40.0, power_W=40.0, exposure_ms=50.0, filters=COPPER)
HIGH = Setting(kV=90.0, power_W=45.0, exposure_ms=50.0, filters=COPPER)

PRODUCT = """
[[product]]
name = "fillet"
shape = "fillet"
material = "chicken_breast"
length_mm = [22, 26]
width_mm = [15, 18]
height_mm = [8, 14]
turn_deg = [-10, 10]
"""
ROD = """
[[foreign_object]]
name = "rib"
shape = "rod"
material = "rib_bone"
length_mm = [2, 5]
diameter_mm = [0.8, 1.5]
bend_mm = [10, 30]
"""
WIRE = """
[[foreign_object]]
name = "wire"
shape = "wire"
material = "Fe"
length_mm = [3, 6]
diameter_mm = 0.4
where = "on"
"""


@pytest.fixture(scope="module")
def twin(make_model_twin):
    return make_model_twin(SHAPE, pixel_mm=0.45, source_object_mm=2970.0, source_detector_mm=3177.0)


def described(folder, text):
    path = folder / "description.toml"
    path.write_text(text, encoding="utf-8")
    return read_description(path)


def exact_transmission(twin, setting, lengths):
    model = spectral_model_of(twin)
    signal = model.moment_weights(twin.spectral.best, OpenBeam(kV=setting.kV, filters=setting.filters))[0]
    depth = sum(length[..., None] * model.mu(name)[: len(signal)] for name, length in lengths.items())
    return np.exp(-depth) @ signal / signal.sum()


def channels_of(twin):
    from raytwin.generator.datasets.generate import ChannelModel

    return [ChannelModel(twin, one, "chicken_breast").channel() for one in (LOW, HIGH)]


def test_a_render_without_blur_is_the_sum_over_energies_within_1e_4(twin):
    sharp = replace(twin, noise=replace(twin.noise, spread=gaussian_spread("aperture", estimate_from_sd(0.0, 0.0))))
    geometry = geometry_of(sharp, settings=(LOW, HIGH))
    rng = np.random.default_rng(1)
    lengths = {"chicken_breast": rng.uniform(0, 30, SHAPE), "rib_bone": rng.uniform(0, 3, SHAPE)}
    images = render_expected(lengths, twin=sharp, channels=channels_of(sharp), geometry=geometry, supersampling=1)
    for image, setting in zip(images, (LOW, HIGH), strict=True):
        expected = exact_transmission(sharp, setting, lengths)
        np.testing.assert_allclose(image.transmission, expected, rtol=1e-4)


def test_signals_not_path_lengths_are_averaged_over_a_pixel(twin):
    """The planted fault would be the mean thickness: behind a step in a pixel more comes through than behind its mean."""
    sharp = replace(twin, noise=replace(twin.noise, spread=gaussian_spread("aperture", estimate_from_sd(0.0, 0.0))))
    geometry = geometry_of(sharp, settings=(LOW, HIGH))
    fine = np.zeros((3 * SHAPE[0], 3 * SHAPE[1]))
    fine[:, 1::3] = 30.0
    image = render_expected({"water": fine}, twin=sharp, channels=channels_of(sharp), geometry=geometry)[0]
    behind = exact_transmission(sharp, LOW, {"water": np.array(30.0)})
    np.testing.assert_allclose(image.transmission, (2 + behind) / 3, rtol=1e-4)
    assert image.transmission[0, 0] > 1.02 * exact_transmission(sharp, LOW, {"water": np.array(10.0)})


def test_an_edge_is_blurred_by_spread_and_focal_spot_together(twin):
    from scipy.special import ndtr

    geometry = Geometry(
        rows=SHAPE[0],
        columns=SHAPE[1],
        pixel_mm=0.45,
        source_object_mm=1000.0,
        source_detector_mm=2000.0,
        focal_spot_mm=1.5,
    )
    step = 5
    fine = np.zeros((step * SHAPE[0], step * SHAPE[1]))
    fine[:, step * SHAPE[1] // 2 :] = 10.0
    image = render_expected(
        {"water": fine}, twin=twin, channels=channels_of(twin), geometry=geometry, supersampling=step
    )[1]
    profile = image.transmission[20]
    sigma = math.hypot(SIGMA, 1.5 / 2.3548 / 0.45)
    edge = (np.arange(SHAPE[1] + 1) - SHAPE[1] / 2) / sigma
    integral = sigma * (edge * ndtr(edge) + np.exp(-0.5 * edge**2) / math.sqrt(2 * math.pi))
    expected = profile[0] - (profile[0] - profile[-1]) * np.diff(integral)
    np.testing.assert_allclose(profile[5:-5], expected[5:-5], atol=0.004 * (profile[0] - profile[-1]))


@hypothesis_settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_objects_lie_inside_away_from_the_edge_and_from_each_other(tmp_path_factory, twin, seed):
    text = PRODUCT + ROD + "[images]\nwith_foreign_object = 1\nobjects = [1, 3]\ndistance_between_mm = 1.5\n"
    description = described(tmp_path_factory.mktemp("d"), text)
    rays = geometry_of(twin, settings=(LOW, HIGH)).rays()
    rng = np.random.default_rng(seed)
    product = sample_individual(description.products[0], name="p", rng=rng)
    scene = sample_scene(description, product, rays=rays, rng=rng)
    assert 1 <= len(scene.foreign_objects) <= 3
    alone = scene.product.lengths_mm(rays)["chicken_breast"]
    total, foreign = scene.lengths_mm(rays)
    assert not alone[[0, -1]].any()
    # what lies inside takes the product's place: nothing is longer than the product
    np.testing.assert_allclose(total["chicken_breast"] + total["rib_bone"], alone, atol=1e-9)
    pitch = float(np.diff(rays.x_mm[0])[0])
    from_edge = distance_transform_edt(alone > 0) * pitch
    footprints = [one.lengths_mm(rays)["rib_bone"] > 0 for one in scene.foreign_objects]
    for number, footprint in enumerate(footprints):
        if footprint.any():
            assert from_edge[footprint].min() > 1.0
            for other in footprints[number + 1 :]:
                if other.any():
                    assert distance_transform_edt(~other)[footprint].min() * pitch > 1.5
    assert (foreign > 0).sum() > 0


def test_in_a_tilted_plate_a_rod_fits_between_its_faces(tmp_path, twin):
    sizes = "length_mm = 18\nwidth_mm = 14\nheight_mm = 5\n"
    plate = f'[[product]]\nshape = "box"\nmaterial = "Al"\n{sizes}orientation = "any"\n'
    rod = '[[foreign_object]]\nshape = "rod"\nmaterial = "Fe"\nlength_mm = 7\ndiameter_mm = 0.8\n'
    description = described(tmp_path, plate + rod + "[images]\nwith_foreign_object = 1\n")
    field = geometry_of(twin, settings=(LOW, HIGH), line=description.line).rays()
    tilts = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        product = sample_individual(description.products[0], name="p", rng=rng)
        scene = sample_scene(description, product, rays=field, rng=rng)
        normal, along = scene.product.rotation[:, 2], scene.foreign_objects[0].rotation[:, 0]
        assert 6.2 * abs(normal @ along) + 0.8 < 5.0
        tilts.append(abs(normal[2]))
    assert min(tilts) < 0.8


def test_an_object_inside_is_nowhere_higher_than_the_product_is_thick(tmp_path, twin):
    """Rods longer than their plate is thick lie flat enough; seen from the side, their shadow is no higher than the plate."""
    from raytwin.generator.scenes.shapes import Rays, path_lengths_mm

    sizes = "length_mm = 18\nwidth_mm = 14\nheight_mm = 5\n"
    plate = f'[[product]]\nshape = "box"\nmaterial = "Al"\n{sizes}'
    rod = '[[foreign_object]]\nshape = "rod"\nmaterial = "Fe"\nlength_mm = 10\ndiameter_mm = 0.8\n'
    description = described(tmp_path, plate + rod + "[images]\nwith_foreign_object = 1\n")
    field = geometry_of(twin, settings=(LOW, HIGH), line=description.line).rays()
    line = np.arange(-7.0, 7.0, 0.05)
    side = Rays(source_mm=1e7, y_mm=line[:, None], x_mm=line[None, :])
    from_the_side = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    heights = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        product = sample_individual(description.products[0], name="p", rng=rng)
        (placed,) = sample_scene(description, product, rays=field, rng=rng).foreign_objects
        shadow = path_lengths_mm(
            placed.individual.body, side, rotation=from_the_side @ placed.rotation, place_mm=np.zeros(3)
        )
        heights.append(np.ptp(line[shadow.any(axis=1)]))
    assert max(heights) < 5.0 and max(heights) > 3.0


def test_an_object_on_the_product_adds_to_it_and_a_void_takes_from_it(tmp_path, twin):
    rays = geometry_of(twin, settings=(LOW, HIGH)).rays()
    for text, sign in ((WIRE, 1), (ROD.replace("rib_bone", "air"), -1)):
        description = described(tmp_path, PRODUCT + text + "[images]\nwith_foreign_object = 1\n")
        rng = np.random.default_rng(3)
        product = sample_individual(description.products[0], name="p", rng=rng)
        scene = sample_scene(description, product, rays=rays, rng=rng)
        alone = scene.product.lengths_mm(rays)["chicken_breast"]
        total, foreign = scene.lengths_mm(rays)
        there = foreign > 0
        change = total["chicken_breast"] - alone
        assert foreign.max() > 0.3
        np.testing.assert_allclose(change, 0.0 if sign > 0 else -foreign, atol=1e-9)
        assert there.any()


def test_a_generated_frame_has_the_expected_mean_and_variance(tmp_path, twin):
    description = described(tmp_path, PRODUCT + ROD)
    scenes = DescribedScenes(twin, description, low=LOW, high=replace(HIGH, averaged=3), seed=5)
    pair = scenes.pair(2)
    rng = np.random.default_rng(8)
    frames = np.stack([scenes.draw(pair, rng) for _ in range(150)]).astype(np.float64)
    share = blur_variance_share("aperture", SIGMA)
    for plane, (image, model) in enumerate(zip(pair.expected, scenes.models, strict=True)):
        n = model.target.averaged
        signal = model.open_signal_DN * image.transmission
        # the variance of the quanta varies slowly: a window of the middle has no edge in it
        window = (slice(24, 40), slice(30, 50))
        variance = (image.gain_DN * signal * (share + WHITE) / (1 + WHITE) + READ**2 + 1 / 12) / n
        found = frames[:, plane].var(axis=0, ddof=1)[window].mean()
        count = 150 * 16 * 20
        assert found == pytest.approx(variance[window].mean(), rel=4 * math.sqrt(2 * 3 / count) + 0.01)
        mean = (frames[:, plane].mean(axis=0) - 1200.0)[window].mean()
        assert mean == pytest.approx(signal[window].mean(), abs=4 * math.sqrt(variance[window].mean() * 4 / count))


def test_images_repeat_byte_for_byte_and_do_not_depend_on_how_many_there_are(tmp_path, twin):
    description = described(tmp_path, PRODUCT + ROD + WIRE + "[images]\nproducts = 3\n")
    options = {"low": LOW, "high": HIGH, "seed": 4}
    few = generate_from_description(twin, description, tmp_path / "a.h5", images=3, **options)
    generate_from_description(twin, description, tmp_path / "b.h5", images=5, **options)
    again = generate_from_description(twin, description, tmp_path / "c.h5", images=3, **options)
    assert few.dataset_sha256 == again.dataset_sha256
    assert few.references == 3
    with read_dataset(tmp_path / "a.h5") as first, read_dataset(tmp_path / "b.h5") as second:
        np.testing.assert_array_equal(first.images(slice(0, 3)), second.images(slice(0, 3)))
        assert first.attributes["description_sha256"] == description.sha256
        assert 'shape = "rod"' in first.attributes["description"]


def test_rows_say_what_is_in_the_image(tmp_path, twin):
    description = described(tmp_path, PRODUCT + ROD + "[images]\nproducts = 4\nwith_foreign_object = 0.6\n")
    generate_from_description(twin, description, tmp_path / "a.h5", low=LOW, high=HIGH, images=16, seed=2)
    with read_dataset(tmp_path / "a.h5") as dataset:
        by_product = {}
        for number, row in enumerate(dataset.rows):
            by_product.setdefault(row.product, set()).add(row.split)
            mask = dataset.foreign_object_masks(number)
            assert bool(row.foreign_object) == bool(mask.any())
            assert np.all(dataset.product_masks(number)[mask])
            if row.foreign_object:
                assert 2.0 <= row.size_mm <= 5.0
                assert -0.01 < row.contrast < 1.0
            else:
                assert math.isnan(row.size_mm)
        assert len(by_product) == 4
        assert all(len(splits) == 1 for splits in by_product.values())
        assert {"train", "val", "test"} == set.union(*by_product.values())
        with_object = sum(bool(row.foreign_object) for row in dataset.rows)
        assert 4 <= with_object <= 15


def test_the_contrast_of_an_object_holds_nothing_of_an_edge_beside_it(tmp_path, twin):
    box = PRODUCT.replace("fillet", "box").replace("chicken_breast", "Al")
    ball = WIRE.replace('"wire"', '"ellipsoid"').replace('"on"', '"inside"').replace("[3, 6]", "1.2")
    ball = ball.replace("diameter_mm = 0.4", "width_mm = 1.2\nheight_mm = 1.2")
    scenes = DescribedScenes(twin, described(tmp_path, box + ball), low=LOW, high=HIGH, seed=5)
    off, depths_px = [], []
    for number in range(80):
        pair = scenes.pair(number)
        if pair.row.foreign_object:
            images = [image.log_image for image in pair.expected]
            _, ring = object_and_ring(*images, pair.foreign_object_mask, dilations=7)
            depths_px.append(distance_transform_edt(pair.product_mask)[ring].min())
            off.append(delta_r(*images, pair.foreign_object_mask, dilations=7) / pair.row.contrast - 1.0)
            assert pair.row.contrast == pytest.approx(-0.1, abs=0.06)  # balls of one size
    middle, beside = np.abs(off)[np.array(depths_px) > 4], np.abs(off)[np.array(depths_px) <= 1]
    assert middle.size > 3 and middle.max() < 0.01
    assert beside.size > 3 and np.median(beside) > 0.5


@pytest.mark.parametrize("ending", ["npz", "h5", "tiff"])
def test_a_user_s_thickness_map_is_a_product(tmp_path, twin, ending):
    y, x = np.mgrid[-1:1:60j, -1:1:80j]
    grid = 12.0 * np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    path = tmp_path / f"map.{ending}"
    if ending == "npz":
        np.savez(path, chicken_breast=grid)
    elif ending == "h5":
        import h5py

        with h5py.File(path, "w") as file:
            file["thickness_mm/chicken_breast"] = grid
    else:
        tifffile.imwrite(path, grid.astype(np.float32))
    text = f'[[product]]\nname = "mine"\nshape = "map"\nfile = "{path.name}"\npixel_mm = 0.35\nmaterial = "chicken_breast"\n'
    description = described(tmp_path, text)
    pair = DescribedScenes(twin, description, low=LOW, high=HIGH, seed=1).pair(0)
    assert pair.row.product.startswith("mine001:map")
    peak = exact_transmission(twin, LOW, {"chicken_breast": np.array(12.0)})
    assert pair.expected[0].transmission.min() == pytest.approx(float(peak), rel=2e-3)
    # a map is linear between its points, so its outline lies up to half a cell further out
    assert pair.product_mask.sum() * (0.45 / (3177 / 2970)) ** 2 == pytest.approx((grid > 0).sum() * 0.35**2, rel=0.06)


def test_every_kind_can_be_drawn_and_crosses_the_beam(tmp_path):
    rays = Geometry(rows=60, columns=60, pixel_mm=0.25, source_object_mm=500.0, source_detector_mm=550.0).rays()
    sizes = {"length_mm": 8.0, "width_mm": 5.0, "height_mm": 3.0, "diameter_mm": 2.0}
    for name, kind in KINDS.items():
        given_sizes = "".join(
            f"{word} = {sizes[word]}\n" for word, default in kind.parameters.items() if default is None
        )
        text = f'[[product]]\nshape = "{name}"\nmaterial = "water"\norientation = "any"\n{given_sizes}'
        description = described(tmp_path, text)
        for seed in range(4):
            rng = np.random.default_rng(seed)
            one = sample_individual(description.products[0], name=name, rng=rng)
            scene = sample_scene(description, one, rays=rays, rng=rng)
            lengths = scene.product.lengths_mm(rays)["water"]
            # a shard's or a cone's outline may lie away from its middle, never beyond its ball
            assert 0 < lengths.max() < 20
            assert np.isfinite(lengths).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"no \[\[product\]\]"),
        (PRODUCT.replace("length_mm", "lenght_mm"), "did you mean length_mm"),
        (PRODUCT.replace("width_mm = [15, 18]\n", ""), "no width_mm"),
        (PRODUCT.replace("[15, 18]", "[18, 15]"), "the smaller first"),
        (PRODUCT.replace("[15, 18]", "0"), "0.001 or more"),
        (PRODUCT.replace("[15, 18]", '"wide"'), "a number, or"),
        (PRODUCT.replace("[15, 18]", "true"), "a number, or"),
        (PRODUCT.replace("[15, 18]", "nan"), "finite numbers"),
        (PRODUCT.replace('"fillet"\nmaterial', '"filet"\nmaterial'), "did you mean fillet"),
        (PRODUCT.replace("chicken_breast", "chikken"), "chik"),
        (PRODUCT + ROD + "[images]\nwith_foreign_object = 2\n", "a share from 0 to 1"),
        (PRODUCT + "[images]\nwith_foreign_object = 0.5\n", r"no \[\[foreign_object\]\]"),
        (PRODUCT + ROD + "[images]\nvalidation = 0.6\ntest = 0.6\n", "together at most 1"),
        (PRODUCT + ROD + 'where = "under"\n', "one of inside, on"),
        (PRODUCT + "[lines]\npixel_mm = 1\n", "did you mean line"),
        ('[[product]]\nshape = "map"\nmaterial = "water"\npixel_mm = 1\n', "no file"),
        ('[[product]]\nshape = "map"\nmaterial = "water"\nfile = "a.npz"\n', "no pixel_mm"),
        ('[[product]]\nshape = "box"\nlength_mm = 1\nwidth_mm = 1\nheight_mm = 1\n', "no material"),
        ("[product]\nshape = 3\n", r"written \[\[product\]\]"),
    ],
)
def test_mistakes_in_a_description_are_named(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        described(tmp_path, text)


def test_text_that_is_no_toml_and_files_that_are_not_there_are_named(tmp_path):
    with pytest.raises(FileFormatError, match="not TOML"):
        described(tmp_path, "[[product\n")
    with pytest.raises(FileFormatError, match="no such file"):
        read_description(tmp_path / "absent.toml")
    for name, content in (("a.npz", b"nonsense"), ("b.h5", b"nonsense"), ("c.tiff", b"nonsense")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match="cannot be read"):
            read_thickness_map(tmp_path / name, material="water")
    np.savez(tmp_path / "d.npz", allow_pickle=True, water=np.array([{"a": 1}], dtype=object))
    with pytest.raises(FileFormatError):
        read_thickness_map(tmp_path / "d.npz", material="water")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PRODUCT.replace("[22, 26]", "200"), "fits into the field"),
        (PRODUCT + ROD.replace("[2, 5]", "90") + "[images]\nwith_foreign_object = 1\n", "room in the product"),
        (PRODUCT + ROD + "[images]\nwith_foreign_object = 1\ndistance_from_edge_mm = 20\n", "room in the product"),
        (
            PRODUCT + ROD.replace("[0.8, 1.5]", "20").replace("[2, 5]", "20") + "[images]\nwith_foreign_object = 1\n",
            "mm thick",
        ),
    ],
)
def test_what_finds_no_room_is_said_and_leaves_no_file(tmp_path, twin, text, message):
    description = described(tmp_path, text)
    with pytest.raises(InputError, match=message):
        generate_from_description(twin, description, tmp_path / "a.h5", low=LOW, high=HIGH, images=2, seed=1)
    assert not (tmp_path / "a.h5").exists()


def test_a_twin_that_lacks_spectrum_or_geometry_is_refused(tmp_path, twin):
    description = described(tmp_path, PRODUCT)
    with pytest.raises(InputError, match="without spectral part"):
        DescribedScenes(replace(twin, spectral=None), description, low=LOW, high=HIGH, seed=1)
    unknown = replace(twin, instrument=replace(twin.instrument, source_object_mm=None))
    with pytest.raises(InputError, match=r"state source_object_mm under \[line\]"):
        DescribedScenes(unknown, description, low=LOW, high=HIGH, seed=1)
    stated = described(tmp_path, PRODUCT + "[line]\nsource_object_mm = 2900\n")
    assert DescribedScenes(unknown, stated, low=LOW, high=HIGH, seed=1).geometry.magnification > 1
    with pytest.raises(InputError, match="low kV below high kV"):
        DescribedScenes(twin, description, low=HIGH, high=LOW, seed=1)


def test_the_command_takes_a_description_and_writes_tiff_folders(tmp_path, twin, capsys, refused_line):
    import json

    write_twin(tmp_path / "twin.h5", twin)
    (tmp_path / "d.toml").write_text(PRODUCT + ROD, encoding="utf-8")
    words = ["generate", str(tmp_path / "twin.h5"), str(tmp_path / "d.toml"), "-n", "2", "--seed", "1", "--json"]
    words += ["-o", str(tmp_path / "out.h5"), "--low", str(LOW), "--high", str(HIGH)]
    assert main([*words, "--tiff", str(tmp_path / "tiff")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["images"] == 2
    assert result["tiff"]["trees"] == ["40kV_40W_50ms", "90kV_45W_50ms"]
    assert "the option is about those" in refused_line(*words, "--split", "train")


def test_the_example_of_the_documentation_runs(tmp_path, twin):
    from pathlib import Path

    text = (Path(__file__).parents[1] / "docs" / "descriptions.md").read_text(encoding="utf-8")
    example = text.split("```toml\n")[1].split("```")[0]
    for large, small in (("[40, 46]", "[22, 26]"), ("[26, 31]", "[18, 20]"), ("[5, 15]", "[5, 9]")):
        example = example.replace(large, small)
    description = described(tmp_path, example)
    summary = generate_from_description(twin, description, tmp_path / "a.h5", low=LOW, high=HIGH, images=4, seed=1)
    assert summary.images == 4


def test_a_scene_rendered_with_few_sub_pixels_is_the_one_rendered_with_all(tmp_path, twin):
    from raytwin.generator.datasets.render import render_scene

    text = PRODUCT + ROD + WIRE + "[images]\nwith_foreign_object = 1\nobjects = [2, 2]\n"
    description = described(tmp_path, text)
    geometry = geometry_of(twin, settings=(LOW, HIGH))
    rng = np.random.default_rng(6)
    product = sample_individual(description.products[0], name="p", rng=rng)
    scene = sample_scene(description, product, rays=geometry.rays(), rng=rng)
    options = {"twin": twin, "channels": channels_of(twin), "geometry": geometry}
    few = render_scene(scene, **options)
    lengths, foreign = scene.lengths_mm(geometry.rays(3))
    for some, every in zip(few.images, render_expected(lengths, **options), strict=True):
        np.testing.assert_allclose(some.transmission, every.transmission, rtol=1e-3)
        np.testing.assert_allclose(some.gain_DN, every.gain_DN, rtol=1e-3)
    blocks = (foreign > 0).reshape(SHAPE[0], 3, SHAPE[1], 3).mean(axis=(1, 3))
    np.testing.assert_allclose(few.foreign_cover, blocks, atol=1e-12)
    inside = (sum(lengths.values()) > 0).reshape(SHAPE[0], 3, SHAPE[1], 3).mean(axis=(1, 3))
    np.testing.assert_allclose(few.cover, inside, atol=1e-12)

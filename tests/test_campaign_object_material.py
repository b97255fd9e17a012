"""What foreign objects are made of, from images whose objects are of another material than the library's."""

from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition.dataset_io import DatasetRow
from raytwin.acquisition.setting import setting_from_text
from raytwin.campaign.object_material import object_materials
from raytwin.generator.datasets.known_scenes import KnownScene, KnownScenes

LOW = setting_from_text("kv=40,power_w=40,exposure_ms=200,filter=Cu:0.05")
HIGH = setting_from_text("kv=90,power_w=45,exposure_ms=200,filter=Cu:0.05")
SHAPE = (40, 40)


def scenes(count, rng, a=1.0, b=0.0):
    """Rods of bone of known thickness in water, of which each mm is really a mm of bone and b mm of water."""
    row, column = np.indices(SHAPE)
    made = []
    for number in range(count):
        middle = rng.uniform(14, 26, 2)
        radius, height = rng.uniform(2.0, 5.0), rng.uniform(0.5, 2.5)
        inside = np.hypot(row - middle[0], column - middle[1]) < radius
        bone = height * inside
        water = 12.0 * np.exp(-0.5 * ((row - 20) ** 2 + (column - 20) ** 2) / 15.0**2)
        made.append(
            KnownScene(
                row=DatasetRow(
                    image=f"s{number}",
                    product=f"p{number}",
                    foreign_object="rod",
                    size_mm=height,
                    split="train",
                    contrast=0.1,
                ),
                thickness_mm={"water_liquid": water + b * bone, "bone_cortical_icru44": a * bone},
                foreign_object_mask=inside,
                product_mask=np.ones(SHAPE, dtype=bool),
            )
        )
    return made


@pytest.fixture(scope="module")
def line(series_line):
    instrument = replace(series_line.instrument, pixel_mm=0.15, source_object_mm=700.0, source_detector_mm=1059.0)
    twin = replace(series_line, instrument=instrument)
    return KnownScenes(twin, low=LOW, high=HIGH, product_material="water_liquid")


def images(line, made, rng):
    return {one.row.image: line.draw(line.expected(one.thickness_mm), rng) for one in made}


def materials(line, told, measured):
    return object_materials(line, told, measured, draws=(), steps=(), product="water_liquid", dilations=6)


@pytest.mark.parametrize(("a", "b"), [(1.0, 0.0), (1.15, 0.0), (0.85, 0.2)])
def test_what_objects_are_made_of_is_found_within_its_interval(line, a, b):
    real = scenes(30, np.random.default_rng(1), a, b)
    told = scenes(30, np.random.default_rng(1))
    (found,), unknown = materials(line, told, images(line, real, np.random.default_rng(2)))
    assert not unknown
    assert (found.material, found.product, found.objects) == ("bone_cortical_icru44", "water_liquid", 30)
    away = np.array([found.a - a, found.b - b])
    # two degrees of freedom: beyond 13.8 in one of a thousand
    assert away @ np.linalg.solve(found.covariance, away) < 13.8
    assert np.all(np.sqrt(np.diag(found.covariance)) < 0.3)
    # the contrast that images would have is known far better than either number
    low, _ = found.contrast_percent
    assert 0.5 * (low[2] - low[1]) < 4.0  # tables alone: 1.96 x 1.5 %
    assert (low[1] > 0) == (a > 1) or a == 1.0


def test_images_of_the_scene_as_found_have_the_measured_contrast(line):
    real = scenes(30, np.random.default_rng(1), 1.2, -0.1)
    told = scenes(30, np.random.default_rng(1))
    ((found,), _) = materials(line, told, images(line, real, np.random.default_rng(2)))
    left, before = [], []
    for truth, library in zip(real, told, strict=True):
        mask = truth.foreign_object_mask
        wanted, usual, own = (
            np.array([one.log_image[mask].mean() for one in line.expected(scene.thickness_mm)])
            for scene in (truth, library, found.scene(library))
        )
        left.append(np.abs(own - wanted).max())
        before.append(np.abs(usual - wanted).max())
    assert np.median(left) < 0.2 * np.median(before)


def test_what_is_not_known_of_the_twin_widens_the_interval(line, series_line):
    told = scenes(30, np.random.default_rng(1))
    measured = images(line, told, np.random.default_rng(2))
    harder = with_inherent_filtration(line.twin, 3.0)
    other = KnownScenes(harder, low=LOW, high=HIGH, product_material="water_liquid")
    widths = []
    for draws, steps in (((), ()), ((other,), ()), ((), (other,))):
        ((found,), _) = object_materials(
            line, told, measured, draws=draws, steps=steps, product="water_liquid", dilations=6
        )
        widths.append(found.contrast_percent[0][2] - found.contrast_percent[0][1])
    assert widths[1] == pytest.approx(widths[2])
    # 3 mm Al take 8 % and more of the contrast at 40 kV
    assert widths[1] > 2 * widths[0]


def with_inherent_filtration(twin, thicker_mm_Al):
    best = twin.spectral.best.copy()
    best[twin.spectral.names.index("inherent_filtration_mm_Al")] += thicker_mm_Al
    return replace(twin, spectral=replace(twin.spectral, best=best))


def test_too_few_objects_and_masks_of_other_images_are_told_and_not_used(line):
    rng = np.random.default_rng(1)
    told = scenes(30, rng)
    measured = images(line, told, rng)
    few = dict(list(measured.items())[:5])
    found, unknown = materials(line, told, few)
    assert not found and "5 objects among the images" in unknown[0]
    names = list(measured)
    shuffled = dict(zip(names, [measured[name] for name in names[7:] + names[:7]], strict=True))
    found, unknown = materials(line, told, shuffled)
    assert not found and "do not belong together" in unknown[0]

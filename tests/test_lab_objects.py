"""Fillets and bones of the lab: shapes, sizes, places."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytwin.errors import InputError
from raytwin.lab import Bone, LabSystem, Product
from raytwin.lab.bench import render
from raytwin.lab.objects import (
    field_mm,
    fine_grid_mm,
    pixel_means,
    place_bone,
    place_fillet,
    sample_bone,
    sample_fillet,
    thickness_on_fine_grid,
)
from raytwin.lab.protocols import make_plan

SYSTEM = LabSystem(rows=64, columns=80)


def some_product(seed, size_mm=3.0, system=SYSTEM):
    rng = np.random.default_rng(seed)
    height_mm, width_mm = field_mm(system)
    fillet = sample_fillet(rng, name="f", half_y_mm=0.35 * height_mm, half_x_mm=0.35 * width_mm)
    product = place_fillet(rng, fillet=fillet, system=system)
    return place_bone(rng, product=product, bone=sample_bone(rng, name="b", size_mm=size_mm))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_product_lies_whole_inside_the_field(seed):
    product = some_product(seed)
    maps = {material: pixel_means(SYSTEM, fine) for material, fine in thickness_on_fine_grid(SYSTEM, product).items()}
    total = sum(maps.values())
    assert (total >= 0).all() and np.isfinite(total).all()
    border = np.concatenate([total[0], total[-1], total[:, 0], total[:, -1]])
    assert not border.any()
    assert 5.0 < maps["chicken_breast"].max() < 40.0
    assert 0.1 < (total > 0).mean() < 0.8


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size_mm=st.floats(1.5, 11.0))
def test_a_bone_has_its_length_and_lies_over_meat(seed, size_mm):
    try:
        product = some_product(seed, size_mm)
    except InputError:
        return  # an outline too narrow for so long a bone
    y_mm, x_mm = fine_grid_mm(SYSTEM)
    bone = product.bone_mm(*np.broadcast_arrays(y_mm, x_mm))
    rows, columns = np.nonzero(bone > 0)
    points = np.stack([y_mm[rows, 0], x_mm[0, columns]], axis=1)
    step_mm = x_mm[0, 1] - x_mm[0, 0]
    longest = max(np.ptp(points @ [math.sin(a), math.cos(a)]) for a in np.linspace(0, np.pi, 90))
    # The chord of a bent rod is a little shorter than its arc, the grid coarser than its ends.
    assert size_mm * 0.88 - 2 * step_mm < longest < size_mm + 2 * step_mm
    assert bone.max() <= product.bone.height_mm + 1e-9
    meat = product.meat_mm(*np.broadcast_arrays(y_mm, x_mm))
    assert (meat[bone > 0] > 0).mean() > 0.95


def test_a_straight_bone_is_a_rod_with_rounded_ends():
    bone = Bone(name="b", size_mm=10.0, width_mm=2.0, height_mm=1.5, bend_mm=1e6)
    assert bone.profile_mm(np.array([0.0]), np.array([0.0]))[0] == pytest.approx(1.5)
    assert bone.profile_mm(np.array([0.5]), np.array([2.0]))[0] == pytest.approx(1.5 * math.sqrt(0.75), rel=1e-4)
    assert bone.profile_mm(np.array([0.0]), np.array([5.001]))[0] == 0.0
    assert bone.profile_mm(np.array([0.0]), np.array([4.99]))[0] > 0.0
    y, x = np.meshgrid(np.linspace(-2, 2, 401), np.linspace(-6, 6, 1201), indexing="ij")
    volume = bone.profile_mm(y, x).sum() * 0.01 * 0.01
    # Elliptic section times the straight part, and two half ellipsoids.
    assert volume == pytest.approx(math.pi / 4 * 2.0 * 1.5 * 8.0 + math.pi / 6 * 2.0 * 2.0 * 1.5, rel=2e-3)


def test_an_embedded_bone_takes_the_place_of_meat_and_one_on_top_adds():
    product = some_product(3)
    y_mm, x_mm = np.broadcast_arrays(*fine_grid_mm(SYSTEM))
    meat, bone = product.meat_mm(y_mm, x_mm), product.bone_mm(y_mm, x_mm)
    for embedded in (True, False):
        placed = Product(
            **{name: getattr(product, name) for name in Product.__slots__ if name != "embedded"}, embedded=embedded
        )
        lengths = placed.thickness_mm(y_mm, x_mm)
        np.testing.assert_array_equal(lengths["rib_bone"], bone)
        expected = np.maximum(meat - bone, 0) if embedded else meat
        np.testing.assert_allclose(lengths["chicken_breast"], expected)


def test_pixel_means_keep_the_volume():
    product = some_product(4)
    for fine in thickness_on_fine_grid(SYSTEM, product).values():
        assert pixel_means(SYSTEM, fine).sum() * 9 == pytest.approx(fine.sum(), rel=1e-5)


def test_a_rendered_scene_numbers_every_covered_sub_pixel_once():
    scene = render(SYSTEM, some_product(5))
    covered = scene.cell > 0
    assert np.array_equal(np.sort(scene.cell[covered]), np.arange(1, covered.sum() + 1))
    assert all(len(lengths) == covered.sum() for lengths in scene.covered_mm.values())
    assert all(not fine[~covered].any() for fine in scene.thickness_mm.values())


def test_the_first_set_holds_the_papers_numbers():
    plan = make_plan("set1", system=SYSTEM, rng=np.random.default_rng(1))
    products = list(plan.scenes.values())
    bones = [product.bone for product in products if product.bone is not None]
    assert len(products) == 254 and len(bones) == 163
    assert len({product.fillet.name for product in products}) == 14
    assert len({bone.name for bone in bones}) == 44
    sizes_mm = [bone.size_mm for bone in bones]
    assert 1.5 <= min(sizes_mm) < 2.0 and 9.5 < max(sizes_mm) <= 11.0
    assert all(1.0 <= bone.width_mm <= 3.0 for bone in bones)
    objects = [take for take in plan.takes if take.kind == "object"]
    assert len(objects) == 2 * 254
    assert {(take.setting.kV, take.setting.exposure_ms, take.setting.averaged) for take in objects} == {
        (40.0, 100.0, 10),
        (90.0, 100.0, 10),
    }


def test_the_second_set_holds_the_papers_numbers():
    plan = make_plan("set2", system=SYSTEM, rng=np.random.default_rng(1))
    products = list(plan.scenes.values())
    assert len(products) == 84
    assert sum(product.bone is None for product in products) == 2
    assert {product.bone.size_mm for product in products if product.bone is not None} == {2.0, 3.0}
    assert len({product.fillet.name for product in products}) == 2
    exposures = {(take.setting.exposure_ms, take.setting.averaged) for take in plan.takes if take.kind == "object"}
    assert exposures == {(100.0, 10), (100.0, 1), (50.0, 1), (20.0, 1)}
    flats = {take.setting.exposure_ms for take in plan.takes if take.kind == "flat"}
    darks = {take.setting.exposure_ms for take in plan.takes if take.kind == "dark"}
    assert flats == darks == {20.0, 50.0, 100.0}


def test_bones_and_fillets_of_the_second_set_are_all_combined():
    plan = make_plan("set2", system=SYSTEM, rng=np.random.default_rng(2))
    pairs = {(p.fillet.name, p.bone.name) for p in plan.scenes.values() if p.bone is not None}
    assert len(pairs) == 4


def test_the_second_set_has_the_exposures_clean_products_and_bones_that_were_asked_for():
    plan = make_plan(
        "set2",
        system=SYSTEM,
        products=24,
        rng=np.random.default_rng(3),
        exposures_ms=(200.0, 75.0),
        boneless=6,
        bones_mm=tuple(np.linspace(6.0, 12.0, 18)),
        bones_across_mm=(3.5, 4.0),
    )
    bones = [product.bone for product in plan.scenes.values()]
    assert sum(bone is None for bone in bones) == 6
    assert all(3.5 <= bone.width_mm <= 4.0 for bone in bones if bone is not None)
    objects = [take.setting for take in plan.takes if take.kind == "object"]
    assert {(one.exposure_ms, one.averaged) for one in objects} == {(100.0, 10), (200.0, 1), (75.0, 1)}
    # every exposure has the dark and flats that correct it
    assert {take.setting.exposure_ms for take in plan.takes if take.kind == "flat"} == {200.0, 100.0, 75.0}


@pytest.mark.parametrize(
    ("protocol", "words", "message"),
    [
        ("set2", {"exposures_ms": (50.0, 50.0)}, "exposures_ms"),
        ("set2", {"exposures_ms": (0.0,)}, "exposures_ms"),
        ("set2", {"boneless": 24}, "boneless"),
        ("set2", {"bones_across_mm": (3.0, 1.0)}, "bones_across_mm"),
        ("set1", {"boneless": 2}, "it belongs to set2"),
        ("calibration", {"bones_across_mm": (1.0, 3.0)}, "it belongs to a set of products"),
    ],
)
def test_a_set_refuses_what_it_cannot_be(protocol, words, message):
    with pytest.raises(InputError, match=message):
        make_plan(protocol, system=SYSTEM, rng=np.random.default_rng(1), products=24, **words)


def test_what_does_not_fit_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(
        InputError,
        match=r"product: got a fillet of .* fits into 25 x 32 mm, the field without its borders; take a smaller",
    ):
        make_plan("set1", system=SYSTEM, rng=rng, products=4, product_mm=80.0)
    with pytest.raises(InputError, match="foreign object: got a bone of 40 mm"):
        make_plan("set2", system=SYSTEM, rng=rng, products=4, bones_mm=(40.0,))
    with pytest.raises(InputError, match="products: got 1; expected 2 or more"):
        make_plan("set2", system=SYSTEM, rng=rng, products=1)
    with pytest.raises(InputError, match="one of calibration, set1, set2"):
        make_plan("set3", system=SYSTEM, rng=rng)


def test_the_papers_detector_takes_a_product_of_any_reasonable_length():
    system = LabSystem().at_size(rows=760, columns=956, pixel_mm=0.15)
    assert field_mm(system) == pytest.approx((106.6, 134.1), abs=0.1)
    plan = make_plan("set1", system=system, rng=np.random.default_rng(0), products=6, product_mm=100.0)
    assert len(plan.scenes) == 6

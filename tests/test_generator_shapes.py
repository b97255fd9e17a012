"""Path lengths through shapes: chords in closed form, volumes under any turn, unions and windows."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from raytwin.errors import InputError
from raytwin.generator.scenes.shapes import (
    Box,
    Capsule,
    Cone,
    Ellipsoid,
    Fillet,
    Heights,
    Polyhedron,
    Rays,
    Superellipsoid,
    Union,
    layer_lengths_mm,
    path_lengths_mm,
    rotation_about_z,
    sample_rotation,
)

FAR_MM = 1e7  # a source so far that rays are parallel
STEP_MM = 0.05
CENTRE = (0.0, 0.0, 0.0)


def rays(half_mm=6.0, step_mm=STEP_MM, source_mm=FAR_MM):
    count = round(2 * half_mm / step_mm)
    line = (np.arange(count) - (count - 1) / 2) * step_mm
    return Rays(source_mm=source_mm, y_mm=line[:, None], x_mm=line[None, :])


def octahedron(size_mm):
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / math.sqrt(3)
    corners = size_mm * np.concatenate([np.eye(3), -np.eye(3)])
    return Polyhedron(normals=signs, offsets_mm=np.full(8, size_mm / math.sqrt(3)), corners_mm=corners)


SHAPES = {
    "ellipsoid": (Ellipsoid(half_axes_mm=(1.0, 2.0, 3.0)), 4 / 3 * math.pi * 6),
    "octahedral superellipsoid": (Superellipsoid(half_axes_mm=(2.0, 1.5, 3.0), exponent=1.0), 4 / 3 * 9),
    "round superellipsoid": (Superellipsoid(half_axes_mm=(1.0, 2.0, 3.0), exponent=2.0), 4 / 3 * math.pi * 6),
    "box": (Box(half_sides_mm=(1.0, 0.5, 2.0)), 8.0),
    "rod": (Capsule(length_mm=6.0, diameter_mm=1.5), math.pi * 0.75**2 * (4.5 + 4 / 3 * 0.75)),
    "ball": (Capsule(length_mm=3.0, diameter_mm=3.0), 4 / 3 * math.pi * 1.5**3),
    "cylinder": (Cone(length_mm=3.0, radius_start_mm=1.2, radius_end_mm=1.2), math.pi * 1.44 * 3),
    "cone": (Cone(length_mm=3.0, radius_start_mm=2.0, radius_end_mm=0.0), math.pi * 4),
    "stump": (Cone(length_mm=1.5, radius_start_mm=0.5, radius_end_mm=2.5), math.pi * 0.5 * (0.25 + 1.25 + 6.25)),
    "polyhedron": (octahedron(2.0), 4 / 3 * 8),
}


@pytest.mark.parametrize("name", SHAPES)
@hypothesis_settings(max_examples=6)
@given(seed=st.integers(0, 1000))
def test_the_sum_of_path_lengths_is_the_volume_however_the_shape_is_turned(name, seed):
    shape, volume = SHAPES[name]
    field = rays()
    found = path_lengths_mm(shape, field, rotation=sample_rotation(np.random.default_rng(seed)), place_mm=CENTRE)
    assert np.all(found >= 0)
    assert np.sum(found) * STEP_MM**2 == pytest.approx(volume, rel=4e-3)
    assert found.max() <= 2 * shape.radius_mm + 1e-9


def test_a_ball_s_chord_is_that_of_geometry_in_a_diverging_beam():
    field = rays(half_mm=8.0, step_mm=0.25, source_mm=40.0)
    place = np.array([2.0, -1.0, 5.0])
    found = path_lengths_mm(Ellipsoid(half_axes_mm=(3.0, 3.0, 3.0)), field, rotation=np.eye(3), place_mm=place)
    x, y = np.broadcast_arrays(field.x_mm, field.y_mm)
    towards = np.stack([x, y, np.full(x.shape, 40.0)])
    towards = towards / np.linalg.norm(towards, axis=0)
    from_source = place + np.array([0.0, 0.0, 40.0])
    missed2 = np.sum(from_source**2) - np.tensordot(from_source, towards, axes=1) ** 2
    np.testing.assert_allclose(found, 2 * np.sqrt(np.maximum(9.0 - missed2, 0.0)), atol=1e-6)


@pytest.mark.parametrize("name", SHAPES)
def test_the_window_of_a_shape_misses_no_ray(name):
    shape, _ = SHAPES[name]
    field = rays(half_mm=12.0, step_mm=0.2, source_mm=60.0)
    turn = sample_rotation(np.random.default_rng(4))
    place = np.array([6.0, -5.0, 8.0])
    x, y = np.broadcast_arrays(field.x_mm, field.y_mm)
    direction = np.stack([x, y, np.full(x.shape, 60.0)])
    direction = direction / np.linalg.norm(direction, axis=0)
    start = np.stack([x, y, np.zeros(x.shape)]) - place[:, None, None]
    everywhere = shape.path_mm(np.tensordot(turn.T, start, axes=1), np.tensordot(turn.T, direction, axes=1))
    np.testing.assert_array_equal(path_lengths_mm(shape, field, rotation=turn, place_mm=place), everywhere)


def test_parts_that_overlap_are_counted_once():
    two = Union(
        parts=(Box(half_sides_mm=(1.0, 1.0, 1.0)), Box(half_sides_mm=(1.0, 1.0, 1.0))),
        rotations=np.stack([np.eye(3)] * 2),
        places_mm=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.5]]),
    )
    found = path_lengths_mm(two, rays(), rotation=np.eye(3), place_mm=CENTRE)
    assert found.max() == pytest.approx(3.5, abs=1e-6)
    apart = Union(parts=two.parts, rotations=two.rotations, places_mm=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 5.0]]))
    assert path_lengths_mm(apart, rays(), rotation=np.eye(3), place_mm=CENTRE).max() == pytest.approx(4.0, abs=1e-6)


def test_a_high_exponent_tends_to_the_box():
    size = (1.0, 0.5, 2.0)
    box = path_lengths_mm(Box(half_sides_mm=size), rays(), rotation=np.eye(3), place_mm=CENTRE)
    soft = path_lengths_mm(
        Superellipsoid(half_axes_mm=size, exponent=40.0), rays(), rotation=np.eye(3), place_mm=CENTRE
    )
    assert soft.sum() == pytest.approx(box.sum(), rel=0.03)


def test_a_map_of_thickness_is_found_again_where_it_lies():
    grid = np.zeros((40, 60))
    grid[10:30, 20:50] = 7.0
    layer = Heights(grid_mm=grid, pitch_mm=0.2)
    field = rays()
    straight = layer_lengths_mm(layer, field, angle=0.0, mirrored=False, place_mm=(0.0, 0.0))
    assert np.sum(straight) * STEP_MM**2 == pytest.approx(grid.sum() * 0.04, rel=1e-3)
    turned = layer_lengths_mm(layer, field, angle=math.pi / 2, mirrored=False, place_mm=(0.0, 0.0))
    np.testing.assert_allclose(turned, straight.T[:, ::-1], atol=1e-9)
    flipped = layer_lengths_mm(layer, field, angle=0.0, mirrored=True, place_mm=(0.0, 0.0))
    np.testing.assert_allclose(flipped, straight[:, ::-1], atol=1e-9)


def test_a_slanting_ray_crosses_a_layer_along_its_secant():
    field = rays(half_mm=5.0, step_mm=1.0, source_mm=10.0)
    layer = Heights(grid_mm=np.full((30, 30), 2.0), pitch_mm=1.0)
    found = layer_lengths_mm(layer, field, angle=0.0, mirrored=False, place_mm=(0.0, 0.0))
    x, y = np.broadcast_arrays(field.x_mm, field.y_mm)
    np.testing.assert_allclose(found, 2.0 * np.sqrt(1 + (x**2 + y**2) / 100.0), rtol=1e-12)


def test_a_fillet_has_its_peak_and_ends_at_its_outline():
    plain = Fillet(
        half_length_mm=5.0,
        half_width_mm=3.0,
        peak_mm=10.0,
        edge=0.5,
        outline=np.zeros((2, 2)),
        taper=0.0,
        relief=np.zeros((0, 4)),
    )
    found = layer_lengths_mm(plain, rays(), angle=0.0, mirrored=False, place_mm=(0.0, 0.0))
    assert found.max() == pytest.approx(10.0, rel=1e-3)
    # half an ellipsoid of semi-axes 5, 3 and 10
    assert np.sum(found) * STEP_MM**2 == pytest.approx(2 / 3 * math.pi * 150, rel=1e-3)


def test_rotations_keep_lengths_and_handedness():
    for seed in range(20):
        turn = sample_rotation(np.random.default_rng(seed))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation_about_z(math.pi / 2) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Ellipsoid(half_axes_mm=(1.0, 0.0, 1.0)), "above 0 mm"),
        (lambda: Box(half_sides_mm=(1.0, math.nan, 1.0)), "above 0 mm"),
        (lambda: Capsule(length_mm=1.0, diameter_mm=2.0), "2 mm or more"),
        (lambda: Cone(length_mm=1.0, radius_start_mm=-1.0, radius_end_mm=1.0), "0 mm or more"),
        (lambda: Superellipsoid(half_axes_mm=(1.0, 1.0, 1.0), exponent=0.5), "1 to 50"),
        (lambda: Heights(grid_mm=np.full((3, 3), -1.0), pitch_mm=1.0), "0 mm or more"),
        (lambda: Heights(grid_mm=np.full((3, 3), np.nan), pitch_mm=1.0), "0 mm or more"),
        (lambda: rays(source_mm=0.0), "more than 0 mm"),
    ],
)
def test_shapes_that_cannot_be_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()

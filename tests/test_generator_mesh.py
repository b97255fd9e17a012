"""Meshes: path lengths are those of the body they bound, whatever way they are stored, and holes are refused."""

import math
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from raytwin.errors import FileFormatError, InputError
from raytwin.generator.scenes.describe import read_description, sample_individual, sample_scene
from raytwin.generator.scenes.mesh import Mesh, read_mesh
from raytwin.generator.scenes.shapes import Box, Ellipsoid, Rays, levels_mm, path_lengths_mm, sample_rotation

CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-0.5, 0.5) for z in (-2.0, 2.0)])
FACES = [
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
]


def block():
    return CORNERS[np.array(FACES)]


def ball(radius_mm, steps=3):
    """An icosahedron refined onto a sphere."""
    golden = (1 + math.sqrt(5)) / 2
    points = [(0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    points = np.array([np.roll(one, k) for one in points for k in range(3)], dtype=float)
    from scipy.spatial import ConvexHull

    for _ in range(steps):
        hull = ConvexHull(points / np.linalg.norm(points, axis=1, keepdims=True))
        triangles = hull.points[hull.simplices]
        points = np.unique(
            np.concatenate([hull.points, *(0.5 * (triangles[:, i] + triangles[:, i - 1]) for i in range(3))]).round(12),
            axis=0,
        )
    hull = ConvexHull(points / np.linalg.norm(points, axis=1, keepdims=True))
    triangles = hull.points[hull.simplices] * radius_mm
    inward = (
        np.einsum(
            "ti,ti->t", np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), triangles[:, 0]
        )
        < 0
    )
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles


def rays(half_mm=4.0, step_mm=0.1, source_mm=60.0):
    count = round(2 * half_mm / step_mm)
    line = (np.arange(count) - (count - 1) / 2) * step_mm
    return Rays(source_mm=source_mm, y_mm=line[:, None], x_mm=line[None, :])


def binary(triangles):
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *one.ravel().astype(float), 0) for one in triangles)
    return b"raytwin".ljust(80) + struct.pack("<I", len(triangles)) + body


def text(triangles):
    facets = "".join(
        " facet normal 0 0 0\n  outer loop\n"
        + "".join("   vertex {:.9g} {:.9g} {:.9g}\n".format(*corner) for corner in one)
        + "  endloop\n endfacet\n"
        for one in triangles
    )
    return f"solid block\n{facets}endsolid block\n".encode()


@hypothesis_settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_a_mesh_of_a_block_is_the_block_for_every_ray(seed):
    rng = np.random.default_rng(seed)
    turn, place = sample_rotation(rng), np.array([*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)])
    field = rays()
    found = Mesh(corners_mm=block()).lengths_mm(field, rotation=turn, place_mm=place)
    expected = path_lengths_mm(Box(half_sides_mm=(1.0, 0.5, 2.0)), field, rotation=turn, place_mm=place)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    levels = Mesh(corners_mm=block()).levels_mm(field, rotation=turn, place_mm=place)
    of_block = levels_mm(Box(half_sides_mm=(1.0, 0.5, 2.0)), field, rotation=turn, place_mm=place)
    crossed = expected > 1e-6
    np.testing.assert_allclose(np.array(levels)[:, crossed], np.array(of_block)[:, crossed], atol=1e-6)


def test_rays_through_edges_and_corners_are_counted_once():
    """A block without a turn has its edges on the grid of the rays."""
    line = np.linspace(-2, 2, 81)
    field = Rays(source_mm=1e6, y_mm=line[:, None], x_mm=line[None, :])
    found = Mesh(corners_mm=block()).lengths_mm(field, rotation=np.eye(3), place_mm=np.zeros(3))
    assert found.max() <= 4.0 + 1e-6
    inside = (np.abs(line[:, None]) < 0.5 - 1e-3) & (np.abs(line[None, :]) < 1 - 1e-3)
    np.testing.assert_allclose(found[inside], 4.0, rtol=1e-6)
    outside = (np.abs(line[:, None]) > 0.5 + 1e-3) | (np.abs(line[None, :]) > 1 + 1e-3)
    np.testing.assert_array_equal(found[outside], 0.0)


def test_a_refined_ball_tends_to_the_ball():
    field = rays()
    place = np.array([0.4, -0.7, 2.0])
    found = Mesh(corners_mm=ball(2.0, steps=4)).lengths_mm(field, rotation=np.eye(3), place_mm=place)
    expected = path_lengths_mm(Ellipsoid(half_axes_mm=(2.0, 2.0, 2.0)), field, rotation=np.eye(3), place_mm=place)
    assert found.sum() == pytest.approx(expected.sum(), rel=5e-3)
    assert np.abs(found - expected)[expected > 1].max() < 0.05


@pytest.mark.parametrize("stored", [binary, text])
def test_stl_files_of_both_kinds_are_read_and_moved_to_their_middle(tmp_path, stored):
    path = tmp_path / "block.stl"
    path.write_bytes(stored(block() + np.array([5.0, 6.0, 7.0])))
    mesh = read_mesh(path, scale=2.0)
    assert mesh.longest_mm == pytest.approx(8.0)
    found = mesh.lengths_mm(rays(), rotation=np.eye(3), place_mm=np.zeros(3))
    expected = path_lengths_mm(Box(half_sides_mm=(2.0, 1.0, 4.0)), rays(), rotation=np.eye(3), place_mm=np.zeros(3))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_mesh_that_is_turned_inside_out_is_turned_back(tmp_path):
    path = tmp_path / "block.stl"
    path.write_bytes(binary(block()[:, ::-1]))
    assert read_mesh(path).lengths_mm(rays(), rotation=np.eye(3), place_mm=np.zeros(3)).max() == pytest.approx(
        4.0, rel=1e-3
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (binary(block()[:-1]), "surface with holes"),
        (binary(np.concatenate([block()[:-1], block()[-1:, ::-1]])), "turned triangles"),
        (b"solid nothing\nendsolid\n", "0 finite triangles"),
        (b"solid x\n vertex a b c\n vertex 1 2 3\n vertex 1 2 3\n", "no STL"),
        (b"\x00" * 100, "0 finite triangles"),
        (binary(np.full((4, 3, 3), np.nan)), "finite triangles"),
    ],
)
def test_files_that_are_no_closed_mesh_are_refused(tmp_path, content, message):
    path = tmp_path / "bad.stl"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_mesh(path)


def test_a_mesh_around_the_source_is_refused():
    with pytest.raises(InputError, match="the source"):
        Mesh(corners_mm=block()).lengths_mm(rays(source_mm=1.5), rotation=np.eye(3), place_mm=np.zeros(3))


def test_a_description_takes_a_mesh(tmp_path):
    (tmp_path / "part.stl").write_bytes(binary(block()))
    path = tmp_path / "d.toml"
    path.write_text(
        '[[product]]\nshape = "mesh"\nfile = "part.stl"\nscale_mm = [0.5, 1]\nmaterial = "water"\norientation = "any"\n'
    )
    description = read_description(path)
    rng = np.random.default_rng(0)
    one = sample_individual(description.products[0], name="part", rng=rng)
    assert one.name == "part:part"
    assert 2.0 <= one.size_mm <= 4.0
    lengths, _ = sample_scene(description, one, rays=rays(), rng=rng).lengths_mm(rays())
    assert 0.4 < lengths["water"].max() < 5
    path.write_text('[[product]]\nshape = "box"\nscale_mm = 1\nmaterial = "water"\n')
    with pytest.raises(InputError, match="the word 'scale_mm'"):
        read_description(path)


@pytest.mark.parametrize("ending", ["obj", "ply", "3mf"])
def test_other_formats_give_the_same_body_and_holes_are_refused(tmp_path, ending):
    trimesh = pytest.importorskip("trimesh", reason="OBJ, PLY and 3MF need the extra `meshes`")
    pytest.importorskip("networkx", reason="3MF needs the extra `meshes`")
    pytest.importorskip("lxml", reason="3MF needs the extra `meshes`")
    mesh = trimesh.Trimesh(vertices=CORNERS + 7.0, faces=FACES, process=False)
    path = tmp_path / f"block.{ending}"
    mesh.export(path)
    found = read_mesh(path, scale=2.0)
    assert found.longest_mm == pytest.approx(8.0, rel=1e-6) and len(found.corners_mm) == len(FACES)
    if ending == "3mf":
        in_inches(path)
        assert read_mesh(path).longest_mm == pytest.approx(4 * 25.4, rel=1e-6)
    trimesh.Trimesh(vertices=CORNERS, faces=FACES[1:], process=False).export(path)
    with pytest.raises(FileFormatError, match="holes"):
        read_mesh(path)
    path.write_bytes(b"\x00 no mesh")
    with pytest.raises(FileFormatError, match="block"):
        read_mesh(path)


def in_inches(path):
    """Restate the unit of a 3MF file, without a change of its numbers."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            assert not name.endswith(".model") or b'unit="millimeter"' in data
            archive.writestr(name, data.replace(b'unit="millimeter"', b'unit="inch"'))

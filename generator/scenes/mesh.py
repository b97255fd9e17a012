"""Closed meshes of triangles as shapes: STL, OBJ, PLY and 3MF files, and the path lengths of rays through them."""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FileFormatError, InputError, MissingDependencyError
from .shapes import Rays

Array = NDArray[np.float64]

TRIMESH_ENDINGS = (".obj", ".ply", ".3mf")
_HEADER = 84
_RECORD = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Mesh:
    """A closed surface of triangles, its middle at the origin.

    Fields: corners_mm (triangle, 3, 3), each triangle counter-clockwise as seen from outside.
    """

    corners_mm: Array = field(repr=False)

    @property
    def radius_mm(self) -> float:
        """Of a ball about the middle that holds all corners."""
        return float(np.sqrt((self.corners_mm**2).sum(axis=-1).max()))

    @property
    def longest_mm(self) -> float:
        """Longest side of the box around it."""
        return float(np.ptp(self.corners_mm.reshape(-1, 3), axis=0).max())

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        return float((self.corners_mm @ direction).max())

    def lengths_mm(self, rays: Rays, *, rotation: Array, place_mm: Array) -> Array:
        """Path lengths (row, column) of all rays through the mesh turned and moved, mm.

        The distances at which a ray leaves through triangles less those at which it enters; a ray through an edge meets one
        of the two triangles there.

        Raises:
            InputError: the mesh reaches behind the source.
        """
        total, _, _ = self._crossed(rays, rotation, place_mm)
        return np.maximum(total, 0.0)

    def levels_mm(self, rays: Rays, *, rotation: Array, place_mm: Array) -> tuple[Array, Array]:
        """z (row, column) in mm where rays first enter and last leave the mesh; those that miss it enter after they leave.

        Raises:
            InputError: the mesh reaches behind the source.
        """
        _, first, last = self._crossed(rays, rotation, place_mm)
        secant = rays.secant()
        return first / secant - rays.source_mm, last / secant - rays.source_mm

    def _crossed(self, rays: Rays, rotation: Array, place_mm: Array) -> tuple[Array, Array, Array]:
        """Length inside, and distances from the source of the first and last triangle (row, column), mm."""
        from ._mesh_loops import add_lengths

        corners = np.ascontiguousarray(self.corners_mm @ np.asarray(rotation).T + np.asarray(place_mm))
        if not corners[..., 2].min() > -rays.source_mm:
            raise InputError(
                "mesh",
                received=f"a radius of {self.radius_mm:.3g} mm",
                expected=f"less than {rays.source_mm:g} mm, the source",
                remedy="state scale_mm, the mm of one unit of the file",
            )
        total, first, last = np.zeros(rays.shape), np.full(rays.shape, np.inf), np.full(rays.shape, -np.inf)
        add_lengths(corners, rays.source_mm, rays.x_mm[0].copy(), rays.y_mm[:, 0].copy(), total, first, last)
        return total, first, last


def read_mesh(path: Path, *, scale: float = 1.0) -> Mesh:
    """A mesh from a file, moved to its middle; `scale` mm a unit of the file.

    STL, binary or text, is read here; OBJ, PLY and 3MF by trimesh (extra `meshes`). 3MF states its unit: its lengths are
    made mm before `scale` multiplies them.

    Raises:
        FileFormatError: no such mesh, a damaged one, or a surface with holes.
        MissingDependencyError: another format than STL, and trimesh is not installed.
    """
    ending = path.suffix.lower()
    if ending in TRIMESH_ENDINGS:
        corners = _by_trimesh(path)
    else:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise FileFormatError(
                str(path), received=f"a file that cannot be read ({error.strerror})", expected="a mesh"
            ) from None
        corners = _binary(data) if _is_binary(data) else _text(data, path)
    if not len(corners) or not bool(np.isfinite(corners).all()):
        raise FileFormatError(str(path), received=f"{len(corners)} finite triangles", expected="a mesh")
    corners = corners[_areas(corners) > 0]
    _check_closed(corners, path)
    # the sum of all corners' tetrahedra is the volume: negative where the triangles are seen from inside
    if np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        corners = corners[:, ::-1]
    flat = corners.reshape(-1, 3)
    middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    return Mesh(corners_mm=np.ascontiguousarray((corners - middle) * scale))


def _by_trimesh(path: Path) -> Array:
    """Corners (triangle, 3, 3) in the file's unit, of a 3MF in mm; several bodies are one mesh."""
    if not path.is_file():
        raise FileFormatError(str(path), received="no such file", expected="a mesh", remedy="check the path")
    try:
        import trimesh
    except ImportError:
        raise MissingDependencyError(
            f"{path}: got a mesh of kind {path.suffix}; expected STL, or the library that reads it; install it with"
            " `pip install 'raytwin[meshes]'`"
        ) from None
    try:
        options = {"skip_materials": True} if path.suffix.lower() == ".obj" else {}
        scene = trimesh.load_scene(path, file_type=path.suffix.lower().lstrip("."), process=False, **options)
        mesh = scene.to_mesh()
        corners = np.asarray(mesh.triangles, dtype=np.float64)
        units = scene.units
        factor = trimesh.units.unit_conversion(units, "millimeter") if units else 1.0
    except Exception as error:  # trimesh raises whatever it likes at damaged files
        raise FileFormatError(
            str(path),
            received=f"{path.stat().st_size} bytes that cannot be read ({error or type(error).__name__})",
            expected=f"a mesh of kind {path.suffix.lower()}",
            remedy="export it again, or as STL",
        ) from None
    return corners * float(factor)


def _is_binary(data: bytes) -> bool:
    return len(data) >= _HEADER and len(data) == _HEADER + _RECORD * int(struct.unpack_from("<I", data, 80)[0])


def _binary(data: bytes) -> Array:
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(data, record, offset=_HEADER)["corners"].astype(np.float64)


def _text(data: bytes, path: Path) -> Array:
    words = data.split()
    places = [number for number, word in enumerate(words) if word == b"vertex"]
    try:
        values = [[float(one) for one in words[place + 1 : place + 4]] for place in places]
        corners = np.array(values, dtype=np.float64).reshape(-1, 3, 3)
    except ValueError:
        raise FileFormatError(
            str(path), received="text that is no STL", expected="an STL mesh, binary or text"
        ) from None
    return corners


def _areas(corners: Array) -> Array:
    return np.asarray(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))


def _check_closed(corners: Array, path: Path) -> None:
    """Every edge is there once in each direction."""
    _, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = number.reshape(-1, 3)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    count = int(number.max()) + 1 if number.size else 1
    there, back = np.sort(edges[:, 0] * count + edges[:, 1]), np.sort(edges[:, 1] * count + edges[:, 0])
    if not np.array_equal(there, back):
        alone = np.setxor1d(there, back).size
        raise FileFormatError(
            str(path),
            received=f"a surface with holes or turned triangles ({alone} edges without their counterpart)",
            expected="a closed mesh",
            remedy="repair it in a mesh editor",
        )

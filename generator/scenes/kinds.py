"""The kinds of objects that a description can name: their parameters, and how one of them is drawn."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from .shapes import Box, Capsule, Cone, Convex, Ellipsoid, Fillet, Polyhedron, Shape, Superellipsoid, Union

Array = NDArray[np.float64]
Values = Mapping[str, float]

_ARC_PARTS = 8
_RELIEF_WAVES = 24
_RELIEF_MM = (3.0, 30.0)
_OUTLINE_HARMONICS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of object.

    Fields: text (what it is); parameters: name -> range from which a value is drawn where the description gives none, or
    None where it must; make: values and a generator -> shape or layer; flat: a layer across the beam, not a body in space.
    """

    text: str
    parameters: Mapping[str, tuple[float, float] | None]
    make: "Callable[[Values, np.random.Generator], Shape | Fillet]"
    flat: bool = False


def _half(values: Values) -> tuple[float, float, float]:
    return (values["length_mm"] / 2.0, values["width_mm"] / 2.0, values["height_mm"] / 2.0)


def _ellipsoid(values: Values, rng: np.random.Generator) -> Shape:
    return Ellipsoid(half_axes_mm=_half(values))


def _superellipsoid(values: Values, rng: np.random.Generator) -> Shape:
    return Superellipsoid(half_axes_mm=_half(values), exponent=values["exponent"])


def _box(values: Values, rng: np.random.Generator) -> Shape:
    return Box(half_sides_mm=_half(values))


def _cone(values: Values, rng: np.random.Generator) -> Shape:
    return Cone(
        length_mm=values["length_mm"],
        radius_start_mm=values["diameter_mm"] / 2.0,
        radius_end_mm=values["end_diameter_mm"] / 2.0,
    )


def _cylinder(values: Values, rng: np.random.Generator) -> Shape:
    radius_mm = values["diameter_mm"] / 2.0
    return Cone(length_mm=values["length_mm"], radius_start_mm=radius_mm, radius_end_mm=radius_mm)


def _rod(values: Values, rng: np.random.Generator) -> Shape:
    """A rod with round ends along a piece of circle of radius `bend_mm` (straight where it is 0), never thicker than long."""
    length_mm = values["length_mm"]
    diameter_mm = min(values["diameter_mm"], length_mm)
    line_mm = length_mm - diameter_mm
    if values["bend_mm"] <= 0 or line_mm <= 0:
        return Capsule(length_mm=length_mm, diameter_mm=diameter_mm)
    angles = np.linspace(-0.5, 0.5, _ARC_PARTS + 1) * min(line_mm / values["bend_mm"], 1.8 * math.pi)
    points = values["bend_mm"] * np.stack([np.sin(angles), np.cos(angles), np.zeros(angles.size)], axis=1)
    return _along(points - points.mean(axis=0), diameter_mm)


def _wire(values: Values, rng: np.random.Generator) -> Shape:
    """A wire of `pieces` straight pieces, each turned against the one before by up to `turn_deg`."""
    pieces = max(1, round(values["pieces"]))
    diameter_mm = min(values["diameter_mm"], values["length_mm"])
    step_mm = (values["length_mm"] - diameter_mm) / pieces
    heading = np.array([1.0, 0.0, 0.0])
    points = [np.zeros(3)]
    for _ in range(pieces):
        aside = np.cross(heading, rng.standard_normal(3))
        angle = math.radians(rng.uniform(0.0, values["turn_deg"]))
        heading = math.cos(angle) * heading + math.sin(angle) * aside / np.linalg.norm(aside)
        points.append(points[-1] + step_mm * heading)
    line = np.array(points)
    return _along(line - 0.5 * (line.min(axis=0) + line.max(axis=0)), diameter_mm)


def _bone(values: Values, rng: np.random.Generator) -> Shape:
    """A shaft with a thicker, rounded head at each end."""
    length_mm = values["length_mm"]
    head_mm = min(values["diameter_mm"] * values["head"], length_mm / 2.0)
    shaft_mm = min(values["diameter_mm"], head_mm)
    parts: list[Convex] = [Capsule(length_mm=max(length_mm - head_mm + shaft_mm, shaft_mm), diameter_mm=shaft_mm)]
    places = [np.zeros(3)]
    for side in (-1.0, 1.0):
        squeezed = head_mm / 2.0 * np.array([1.0, rng.uniform(0.8, 1.0), rng.uniform(0.7, 1.0)])
        parts.append(Ellipsoid(half_axes_mm=(float(squeezed[0]), float(squeezed[1]), float(squeezed[2]))))
        places.append(np.array([side * (length_mm - head_mm) / 2.0, 0.0, 0.0]))
    return Union(parts=tuple(parts), rotations=np.stack([np.eye(3)] * 3), places_mm=np.array(places))


def _along(points_mm: Array, diameter_mm: float) -> Shape:
    """Rods with round ends from each point (n, 3) to the next."""
    parts: list[Convex] = []
    rotations, places = [], []
    for first, last in pairwise(points_mm):
        step = last - first
        length_mm = float(np.linalg.norm(step))
        parts.append(Capsule(length_mm=length_mm + diameter_mm, diameter_mm=diameter_mm))
        rotations.append(_x_towards(step / length_mm))
        places.append(0.5 * (first + last))
    return Union(parts=tuple(parts), rotations=np.array(rotations), places_mm=np.array(places))


def _x_towards(direction: Array) -> Array:
    """A rotation matrix (3, 3) whose first column is `direction`."""
    helper = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    second = np.cross(helper, direction)
    second = second / np.linalg.norm(second)
    return np.stack([direction, second, np.cross(direction, second)], axis=1)


def _shard(values: Values, rng: np.random.Generator) -> Shape:
    """A splinter: an irregular convex outline of `corners` corners, `height_mm` thick, with slanting sides."""
    corners = max(3, round(values["corners"]))
    angles = 2.0 * np.pi * (np.arange(corners) + rng.uniform(0.3, 0.7, corners)) / corners
    points = np.stack([values["length_mm"] / 2.0 * np.cos(angles), values["width_mm"] / 2.0 * np.sin(angles)], axis=1)
    normals, offsets = [], []
    for first, last in zip(points, np.roll(points, -1, axis=0), strict=True):
        edge = last - first
        outward = np.array([edge[1], -edge[0], 0.0]) / np.linalg.norm(edge)
        slant = rng.uniform(-0.5, 0.5)
        normal = outward + np.array([0.0, 0.0, slant])
        normals.append(normal / np.linalg.norm(normal))
        offsets.append(float(normals[-1][:2] @ first))
    half_mm = values["height_mm"] / 2.0
    tilt = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.15, 0.15), 1.0])
    tilt /= np.linalg.norm(tilt)
    normals += [tilt, np.array([0.0, 0.0, -1.0])]
    offsets += [half_mm, half_mm]
    from scipy.spatial import HalfspaceIntersection

    # the middle is inside: corners lie less than half a turn apart
    planes = np.column_stack([np.array(normals), -np.array(offsets)])
    return Polyhedron(
        normals=np.array(normals),
        offsets_mm=np.array(offsets),
        corners_mm=HalfspaceIntersection(planes, np.zeros(3)).intersections,
    )


def _fillet(values: Values, rng: np.random.Generator) -> Fillet:
    """A soft piece of meat with an uneven outline and surface."""
    harmonics = np.arange(2, 2 + _OUTLINE_HARMONICS)
    outline = rng.standard_normal((harmonics.size, 2)) * (0.06 * values["irregularity"] / (harmonics - 1.0))[:, None]
    wavelengths_mm = np.exp(rng.uniform(math.log(_RELIEF_MM[0]), math.log(_RELIEF_MM[1]), _RELIEF_WAVES))
    headings = rng.uniform(0.0, 2.0 * np.pi, _RELIEF_WAVES)
    # longer waves are higher; together they have the standard deviation that was asked for
    amplitudes = rng.standard_normal(_RELIEF_WAVES) * wavelengths_mm**0.8
    amplitudes *= values["unevenness_percent"] / 100.0 * math.sqrt(2.0) / np.linalg.norm(amplitudes)
    return Fillet(
        half_length_mm=values["length_mm"] / 2.0,
        half_width_mm=values["width_mm"] / 2.0,
        peak_mm=values["height_mm"],
        edge=values["edge"],
        outline=outline,
        taper=values["taper"],
        relief=np.stack(
            [
                amplitudes,
                np.cos(headings) / wavelengths_mm,
                np.sin(headings) / wavelengths_mm,
                rng.uniform(0.0, 2.0 * np.pi, _RELIEF_WAVES),
            ],
            axis=1,
        ),
    )


_THREE_SIDES: dict[str, tuple[float, float] | None] = {"length_mm": None, "width_mm": None, "height_mm": None}

KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "ellipsoid": Kind(text="an ellipsoid: a void, a stone, a fruit", parameters=_THREE_SIDES, make=_ellipsoid),
        "superellipsoid": Kind(
            text="between an octahedron (exponent 1), an ellipsoid (2) and a box (large)",
            parameters={**_THREE_SIDES, "exponent": (2.0, 4.0)},
            make=_superellipsoid,
        ),
        "pit": Kind(
            text="a fruit's stone: an ellipsoid with drawn-out ends",
            parameters={**_THREE_SIDES, "exponent": (1.5, 1.8)},
            make=_superellipsoid,
        ),
        "box": Kind(text="a block", parameters=_THREE_SIDES, make=_box),
        "cylinder": Kind(
            text="a cylinder or disc, length along its axis",
            parameters={"length_mm": None, "diameter_mm": None},
            make=_cylinder,
        ),
        "cone": Kind(
            text="a cone or a piece of one",
            parameters={"length_mm": None, "diameter_mm": None, "end_diameter_mm": (0.0, 0.0)},
            make=_cone,
        ),
        "rod": Kind(
            text="a round rod with round ends, bent to a radius: a rib, a fish bone",
            parameters={"length_mm": None, "diameter_mm": None, "bend_mm": (0.0, 0.0)},
            make=_rod,
        ),
        "wire": Kind(
            text="a wire with kinks",
            parameters={"length_mm": None, "diameter_mm": None, "pieces": (3.0, 6.0), "turn_deg": (40.0, 40.0)},
            make=_wire,
        ),
        "bone": Kind(
            text="a shaft with a thicker head at each end",
            parameters={"length_mm": None, "diameter_mm": None, "head": (1.3, 1.8)},
            make=_bone,
        ),
        "shard": Kind(
            text="a splinter of glass, plastic or bone: flat, with straight irregular edges",
            parameters={**_THREE_SIDES, "corners": (4.0, 7.0)},
            make=_shard,
        ),
        "fillet": Kind(
            text="a soft piece of meat with an uneven outline and surface",
            parameters={
                **_THREE_SIDES,
                "edge": (0.4, 0.6),
                "taper": (-0.2, 0.2),
                "irregularity": (1.0, 1.0),
                "unevenness_percent": (2.0, 4.0),
            },
            make=_fillet,
            flat=True,
        ),
    }
)

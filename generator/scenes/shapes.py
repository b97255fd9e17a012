"""Shapes in the beam, and the path lengths of rays through them.

Coordinates are mm in the object's space: x along columns, y along rows, z along the beam, the origin in the middle of the
field where the beam's axis crosses the object's plane. A ray starts at the source and ends in a sub-pixel of the detector.
Convex shapes are crossed between two points, found in closed form (superellipsoids by bisection); unions of convex parts
add the lengths of their merged intervals. Heights over a plane (fillets, maps) are crossed along z, with the secant of the
ray's angle to it: exact for parallel rays.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError

Array = NDArray[np.float64]

_FAR = 1e30
_BISECTIONS = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class Rays:
    """Rays from one source to points of the object's plane.

    Fields: source_mm: distance of the source before the object's plane; y_mm (row, 1), x_mm (1, column): where rays cross
    that plane.
    """

    source_mm: float
    y_mm: Array = field(repr=False)
    x_mm: Array = field(repr=False)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.source_mm) and self.source_mm > 0):
            raise InputError("source-object distance", received=f"{self.source_mm} mm", expected="more than 0 mm")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.y_mm.shape[0], self.x_mm.shape[1])

    def part(self, rows: slice, columns: slice) -> "Rays":
        """The rays of a window."""
        return Rays(source_mm=self.source_mm, y_mm=self.y_mm[rows], x_mm=self.x_mm[:, columns])

    def secant(self) -> Array:
        """Path through a layer across the beam over the layer's thickness (row, column), no unit."""
        return np.asarray(np.sqrt(1.0 + (self.y_mm**2 + self.x_mm**2) / self.source_mm**2))

    def window(self, centre_mm: Array, radius_mm: float) -> tuple[slice, slice]:
        """Rows and columns whose rays can meet a ball about `centre_mm` (x, y, z)."""
        depths = self.source_mm + centre_mm[2] + np.array([-radius_mm, radius_mm])
        if depths[0] <= 0:
            return slice(0, self.shape[0]), slice(0, self.shape[1])
        slices = []
        for positions, middle in ((self.y_mm[:, 0], centre_mm[1]), (self.x_mm[0], centre_mm[0])):
            # a ray to (x, y, 0) is at (x, y) (1 + z / source) in the plane z
            ends = np.outer([middle - radius_mm, middle + radius_mm], self.source_mm / depths)
            slices.append(
                slice(
                    int(np.searchsorted(positions, ends.min(), side="left")),
                    int(np.searchsorted(positions, ends.max(), side="right")),
                )
            )
        return slices[0], slices[1]


class Shape(Protocol):
    """Anything that rays can cross, in its own coordinates about its own middle."""

    @property
    def radius_mm(self) -> float:
        """Of a ball about the middle that holds the shape."""
        ...

    def reach_mm(self, direction: Array) -> float:
        """How far the shape goes from its middle along a direction (3,) of length 1."""
        ...

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays first enter and last leave (s in mm); leaving before entering is missing the shape."""
        ...

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths (mm) of rays start + s direction, s in mm from -infinity; arrays (3, ...)."""
        ...


class Convex(Protocol):
    """A convex shape: a ray is inside from one point to another."""

    @property
    def radius_mm(self) -> float:
        """Of a ball about the middle that holds the shape."""
        ...

    def reach_mm(self, direction: Array) -> float:
        """How far the shape goes from its middle along a direction (3,) of length 1."""
        ...

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave (s in mm); leaving before entering is missing the shape."""
        ...


def _length(entry: Array, leave: Array) -> Array:
    return np.maximum(leave - entry, 0.0)


def _checked(name: str, *sizes_mm: float) -> None:
    if not all(math.isfinite(one) and one > 0 for one in sizes_mm):
        raise InputError(name, received=f"{sizes_mm} mm", expected="finite sizes above 0 mm")


def _roots(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Where a s^2 + 2 b s + c <= 0, for a > 0."""
    discriminant = b * b - a * c
    root = np.sqrt(np.maximum(discriminant, 0.0))
    hit = discriminant > 0
    return np.where(hit, (-b - root) / a, _FAR), np.where(hit, (-b + root) / a, -_FAR)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ellipsoid:
    """(x/a)^2 + (y/b)^2 + (z/c)^2 <= 1 with half axes a, b, c (mm)."""

    half_axes_mm: tuple[float, float, float]

    def __post_init__(self) -> None:
        _checked("half axes of an ellipsoid", *self.half_axes_mm)

    @property
    def radius_mm(self) -> float:
        """The largest half axis."""
        return max(self.half_axes_mm)

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        return float(np.linalg.norm(np.multiply(self.half_axes_mm, direction)))

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave, mm."""
        scale = np.reshape(self.half_axes_mm, (3,) + (1,) * (start.ndim - 1))
        o, d = start / scale, direction / scale
        return _roots((d * d).sum(axis=0), (o * d).sum(axis=0), (o * o).sum(axis=0) - 1.0)

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths, mm."""
        return _length(*self.interval_mm(start, direction))


@dataclass(frozen=True, slots=True, kw_only=True)
class Superellipsoid:
    """|x/a|^n + |y/b|^n + |z/c|^n <= 1: an ellipsoid at n = 2, ever more a box above; n from 1 (an octahedron) to 50."""

    half_axes_mm: tuple[float, float, float]
    exponent: float

    def __post_init__(self) -> None:
        _checked("half axes of a superellipsoid", *self.half_axes_mm)
        if not 1.0 <= self.exponent <= 50.0:
            raise InputError("exponent of a superellipsoid", received=self.exponent, expected="1 to 50")

    @property
    def radius_mm(self) -> float:
        """Half the diagonal of the box around it."""
        return float(np.linalg.norm(self.half_axes_mm))

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        # the dual norm of the one that bounds it
        steps = np.abs(np.multiply(self.half_axes_mm, direction))
        power = self.exponent / (self.exponent - 1.0) if self.exponent > 1.0 else math.inf
        return float(np.linalg.norm(steps, ord=power))

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave, mm, by bisection to 1e-10 of the size."""
        scale = np.reshape(self.half_axes_mm, (3,) + (1,) * (start.ndim - 1))
        o, d = start / scale, direction / scale

        def inside(s: Array) -> Array:
            return np.asarray((np.abs(o + s * d) ** self.exponent).sum(axis=0))

        # the level falls towards a least value and rises again: the point of least level lies in the box around the shape
        low, high = _slabs(start, direction, self.half_axes_mm)
        hit = low < high
        low, high = np.where(hit, low, 0.0), np.where(hit, high, 0.0)
        first, last = low.copy(), high.copy()
        golden = (math.sqrt(5.0) - 1.0) / 2.0
        for _ in range(2 * _BISECTIONS):
            left, right = last - golden * (last - first), first + golden * (last - first)
            lower = inside(left) < inside(right)
            first, last = np.where(lower, first, left), np.where(lower, right, last)
        middle = 0.5 * (first + last)
        hit &= inside(middle) < 1.0
        ends = []
        for outer in (low, high):
            near, far = middle.copy(), outer.copy()
            for _ in range(_BISECTIONS):
                half = 0.5 * (near + far)
                within = inside(half) < 1.0
                near, far = np.where(within, half, near), np.where(within, far, half)
            ends.append(near)
        return np.where(hit, ends[0], _FAR), np.where(hit, ends[1], -_FAR)

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths, mm."""
        return _length(*self.interval_mm(start, direction))


def _slabs(start: Array, direction: Array, half_mm: Sequence[float]) -> tuple[Array, Array]:
    """Where rays enter and leave the box |x| <= a, |y| <= b, |z| <= c."""
    entry = np.full(start.shape[1:], -_FAR)
    leave = np.full(start.shape[1:], _FAR)
    for o, d, half in zip(start, direction, half_mm, strict=True):
        level = np.abs(d) > 1e-14
        safe = np.where(level, d, 1.0)
        one, other = (-half - o) / safe, (half - o) / safe
        outside = np.abs(o) > half
        entry = np.maximum(entry, np.where(level, np.minimum(one, other), np.where(outside, _FAR, -_FAR)))
        leave = np.minimum(leave, np.where(level, np.maximum(one, other), np.where(outside, -_FAR, _FAR)))
    return entry, leave


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A block with half sides a, b, c (mm)."""

    half_sides_mm: tuple[float, float, float]

    def __post_init__(self) -> None:
        _checked("half sides of a box", *self.half_sides_mm)

    @property
    def radius_mm(self) -> float:
        """Half the diagonal."""
        return float(np.linalg.norm(self.half_sides_mm))

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        return float(np.abs(np.multiply(self.half_sides_mm, direction)).sum())

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave, mm."""
        return _slabs(start, direction, self.half_sides_mm)

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths, mm."""
        return _length(*self.interval_mm(start, direction))


@dataclass(frozen=True, slots=True, kw_only=True)
class Capsule:
    """A rod with round ends along x: all points within `diameter_mm / 2` of a piece of line.

    Fields: length_mm, ends included; diameter_mm.
    """

    length_mm: float
    diameter_mm: float

    def __post_init__(self) -> None:
        _checked("length and diameter of a rod", self.length_mm, self.diameter_mm)
        if self.length_mm < self.diameter_mm:
            raise InputError(
                "length of a rod with round ends",
                received=f"{self.length_mm:g} mm",
                expected=f"{self.diameter_mm:g} mm or more",
            )

    @property
    def radius_mm(self) -> float:
        """Half the length."""
        return self.length_mm / 2.0

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        radius = self.diameter_mm / 2.0
        return float((self.length_mm / 2.0 - radius) * abs(direction[0]) + radius)

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave, mm."""
        radius = self.diameter_mm / 2.0
        half = self.length_mm / 2.0 - radius
        across = (direction[1:] ** 2).sum(axis=0)
        along = across < 1e-14
        entry, leave = _roots(
            np.where(along, 1.0, across),
            np.where(along, 0.0, (start[1:] * direction[1:]).sum(axis=0)),
            (start[1:] ** 2).sum(axis=0) - radius**2,
        )
        in_pipe = np.where(along, (start[1:] ** 2).sum(axis=0) < radius**2, entry < leave)
        entry, leave = np.where(along & in_pipe, -_FAR, entry), np.where(along & in_pipe, _FAR, leave)
        low, high = _slabs(start[:1], direction[:1], (half,))
        entry, leave = np.maximum(entry, low), np.minimum(leave, high)
        for end in (-half, half):
            shifted = start - np.reshape([end, 0.0, 0.0], (3,) + (1,) * (start.ndim - 1))
            first, last = _roots(
                np.ones(start.shape[1:]), (shifted * direction).sum(axis=0), (shifted**2).sum(axis=0) - radius**2
            )
            ball = first < last
            pipe = entry < leave
            # convex: the whole crossing runs from the first to the last point of any part
            entry = np.where(ball, np.where(pipe, np.minimum(entry, first), first), entry)
            leave = np.where(ball, np.where(pipe, np.maximum(leave, last), last), leave)
        return entry, leave

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths, mm."""
        return _length(*self.interval_mm(start, direction))


@dataclass(frozen=True, slots=True, kw_only=True)
class Cone:
    """A cylinder or a piece of cone along x between two radii (mm), `length_mm` long; one radius may be 0."""

    length_mm: float
    radius_start_mm: float
    radius_end_mm: float

    def __post_init__(self) -> None:
        _checked("length and largest radius of a cone", self.length_mm, max(self.radius_start_mm, self.radius_end_mm))
        if not min(self.radius_start_mm, self.radius_end_mm) >= 0:
            raise InputError(
                "radii of a cone", received=(self.radius_start_mm, self.radius_end_mm), expected="0 mm or more"
            )

    @property
    def radius_mm(self) -> float:
        """Of the ball around it."""
        return math.hypot(self.length_mm / 2.0, max(self.radius_start_mm, self.radius_end_mm))

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        along, across = direction[0] * self.length_mm / 2.0, math.hypot(direction[1], direction[2])
        return float(max(self.radius_start_mm * across - along, self.radius_end_mm * across + along))

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave, mm."""
        half = self.length_mm / 2.0
        slope = (self.radius_end_mm - self.radius_start_mm) / self.length_mm
        at_middle = 0.5 * (self.radius_start_mm + self.radius_end_mm)
        entry, leave = _slabs(start[:1], direction[:1], (half,))
        # y^2 + z^2 - (m + k x)^2 <= 0 within the slab, where m + k x >= 0
        width, grows = at_middle + slope * start[0], slope * direction[0]
        a = (direction[1:] ** 2).sum(axis=0) - grows**2
        b = (start[1:] * direction[1:]).sum(axis=0) - width * grows
        c = (start[1:] ** 2).sum(axis=0) - width**2
        steep = np.abs(a) < 1e-12
        first, last = _roots(np.where(a > 1e-12, a, 1.0), np.where(a > 1e-12, b, 0.0), np.where(a > 1e-12, c, 1.0))
        # steeper than the cone's side: inside before one root and after the other; the slab keeps the right nappe
        discriminant = np.maximum(b * b - a * c, 0.0)
        safe = np.where(a < -1e-12, a, -1.0)
        low, high = (-b + np.sqrt(discriminant)) / safe, (-b - np.sqrt(discriminant)) / safe
        right_nappe = width + grows * high > width + grows * low
        first = np.where(a < -1e-12, np.where(right_nappe, high, -_FAR), first)
        last = np.where(a < -1e-12, np.where(right_nappe, _FAR, low), last)
        linear = np.where(np.abs(b) > 1e-14, -c / np.where(np.abs(b) > 1e-14, 2.0 * b, 1.0), 0.0)
        flat = np.abs(b) <= 1e-14
        first = np.where(steep, np.where(flat, np.where(c < 0, -_FAR, _FAR), np.where(b > 0, -_FAR, linear)), first)
        last = np.where(steep, np.where(flat, np.where(c < 0, _FAR, -_FAR), np.where(b > 0, linear, _FAR)), last)
        return np.maximum(entry, first), np.minimum(leave, last)

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths, mm."""
        return _length(*self.interval_mm(start, direction))


@dataclass(frozen=True, slots=True, kw_only=True)
class Polyhedron:
    """A convex body cut by planes: all points with normal . x <= offset (mm) for every plane.

    Fields: normals (plane, 3) of length 1; offsets_mm (plane,); corners_mm (corner, 3).
    """

    normals: Array
    offsets_mm: Array
    corners_mm: Array

    @property
    def radius_mm(self) -> float:
        """Distance of the farthest corner from the middle."""
        return float(np.linalg.norm(self.corners_mm, axis=1).max())

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        return float((self.corners_mm @ direction).max())

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave, mm."""
        entry = np.full(start.shape[1:], -_FAR)
        leave = np.full(start.shape[1:], _FAR)
        for normal, offset in zip(self.normals, self.offsets_mm, strict=True):
            along = np.tensordot(normal, direction, axes=1)
            room = offset - np.tensordot(normal, start, axes=1)
            crosses = np.abs(along) > 1e-14
            at = room / np.where(crosses, along, 1.0)
            entry = np.where(crosses & (along < 0), np.maximum(entry, at), entry)
            leave = np.where(crosses & (along > 0), np.minimum(leave, at), leave)
            leave = np.where(~crosses & (room < 0), -_FAR, leave)
        return entry, leave

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths, mm."""
        return _length(*self.interval_mm(start, direction))


@dataclass(frozen=True, slots=True, kw_only=True)
class Union:
    """Convex parts, each turned and moved, that may overlap.

    Fields: parts; rotations (part, 3, 3), columns are the part's axes; places_mm (part, 3).
    """

    parts: tuple[Convex, ...]
    rotations: Array
    places_mm: Array

    @property
    def radius_mm(self) -> float:
        """Of a ball about the middle that holds all parts."""
        return max(
            float(np.linalg.norm(place)) + part.radius_mm
            for part, place in zip(self.parts, self.places_mm, strict=True)
        )

    def reach_mm(self, direction: Array) -> float:
        """How far it goes from its middle along a direction, mm."""
        return max(
            float(place @ direction) + part.reach_mm(rotation.T @ direction)
            for part, rotation, place in zip(self.parts, self.rotations, self.places_mm, strict=True)
        )

    def _of_parts(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays enter and leave each part (part, ...), mm."""
        intervals = []
        for part, rotation, place in zip(self.parts, self.rotations, self.places_mm, strict=True):
            moved = start - np.reshape(place, (3,) + (1,) * (start.ndim - 1))
            intervals.append(
                part.interval_mm(np.tensordot(rotation.T, moved, axes=1), np.tensordot(rotation.T, direction, axes=1))
            )
        entry, leave = (np.stack(ends) for ends in zip(*intervals, strict=True))
        hit = entry < leave
        return np.where(hit, entry, _FAR), np.where(hit, leave, -_FAR)

    def interval_mm(self, start: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays first enter and last leave, mm."""
        entry, leave = self._of_parts(start, direction)
        return entry.min(axis=0), leave.max(axis=0)

    def path_mm(self, start: Array, direction: Array) -> Array:
        """Path lengths, mm: where parts overlap the ray is counted once."""
        entry, leave = self._of_parts(start, direction)
        order = np.argsort(entry, axis=0)
        entry, leave = np.take_along_axis(entry, order, axis=0), np.take_along_axis(leave, order, axis=0)
        total = np.zeros(entry.shape[1:])
        upto = np.full(entry.shape[1:], -_FAR)
        for first, last in zip(entry, leave, strict=True):
            begin = np.maximum(first, upto)
            total += np.maximum(last - begin, 0.0)
            upto = np.where(last > first, np.maximum(upto, last), upto)
        return total


@dataclass(frozen=True, slots=True, kw_only=True)
class Heights:
    """A thickness over the plane across the beam, as a function of x and y (mm).

    Fields: grid_mm (row, column) thickness at the middles of cells of `pitch_mm`; between them linear, outside 0.
    """

    grid_mm: Array
    pitch_mm: float

    def __post_init__(self) -> None:
        grid = np.asarray(self.grid_mm)
        _checked("pitch of a thickness map", self.pitch_mm)
        if grid.ndim != 2 or 0 in grid.shape or not bool(np.isfinite(grid).all()) or float(grid.min()) < 0:
            raise InputError(
                "thickness map",
                received=f"shape {grid.shape}" + ("" if grid.ndim != 2 else ", with values below 0 or not finite"),
                expected="(row, column) of finite thicknesses of 0 mm or more",
            )

    @property
    def radius_mm(self) -> float:
        """Half the diagonal of the map."""
        rows, columns = self.grid_mm.shape
        return 0.5 * math.hypot(rows + 1, columns + 1) * self.pitch_mm

    def on_grid_mm(self, x_mm: Array, y_mm: Array, angle: float, mirrored: bool) -> Array:
        """Thickness (row, column) of the map turned by `angle` (radians) on columns x (column,) and rows y (row,), mm."""
        from scipy.ndimage import map_coordinates

        cosine, sine = math.cos(angle), math.sin(angle)
        side = -1.0 if mirrored else 1.0
        along = side * (x_mm * cosine + y_mm[:, None] * sine)
        across = -x_mm * sine + y_mm[:, None] * cosine
        rows, columns = self.grid_mm.shape
        place = [across / self.pitch_mm + (rows - 1) / 2.0, along / self.pitch_mm + (columns - 1) / 2.0]
        return np.asarray(map_coordinates(self.grid_mm, place, order=1, mode="constant", cval=0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fillet:
    """A soft piece of meat: thickness = peak (1 - rho^2)^edge (1 + relief), rho the distance from the middle over the
    outline's in that direction; `taper` makes one end thicker.

    Fields: half_length_mm (x), half_width_mm (y), peak_mm; edge (0.3 steep, 1 flat towards the rim); outline (k, 2) cosine
    and sine of the k-th harmonic of the outline, from 2 on; taper (share of the peak from one end to the other); relief:
    waves (n, 4) of amplitude, cycles a mm along x and y, phase.
    """

    half_length_mm: float
    half_width_mm: float
    peak_mm: float
    edge: float
    outline: Array
    taper: float
    relief: Array

    def __post_init__(self) -> None:
        _checked("half length, half width and peak of a fillet", self.half_length_mm, self.half_width_mm, self.peak_mm)

    @property
    def radius_mm(self) -> float:
        """Of a circle that holds the outline."""
        return max(self.half_length_mm, self.half_width_mm) * (1.0 + float(np.abs(self.outline).sum()))

    def on_grid_mm(self, x_mm: Array, y_mm: Array, angle: float, mirrored: bool) -> Array:
        """Thickness (row, column) of the fillet turned by `angle` (radians) on columns x (column,) and rows y (row,), mm."""
        radius = self.radius_mm
        result = np.zeros((y_mm.size, x_mm.size))
        rows = slice(*np.searchsorted(y_mm, [-radius, radius]))
        columns = slice(*np.searchsorted(x_mm, [-radius, radius]))
        x_line, y_line = x_mm[columns], y_mm[rows]
        side = -1.0 if mirrored else 1.0
        cosine, sine = math.cos(angle), math.sin(angle)
        u = side * (x_line * cosine + y_line[:, None] * sine) / self.half_length_mm
        v = (-x_line * sine + y_line[:, None] * cosine) / self.half_width_mm
        rho2 = u * u + v * v
        near = rho2 < (1.0 + float(np.abs(self.outline).sum())) ** 2
        rho2, towards = rho2[near], u[near]
        # (cos, sin) of the k-th harmonic are the k-th power of the first
        turn = (towards + 1j * v[near]) / np.sqrt(np.maximum(rho2, 1e-300))
        power = turn.copy()
        rim = np.ones(rho2.shape)
        for cosine_k, sine_k in self.outline:
            power *= turn
            rim += cosine_k * power.real + sine_k * power.imag
        body = self.peak_mm * np.maximum(1.0 - rho2 / rim**2, 0.0) ** self.edge * (1.0 + self.taper * towards)
        thickness = np.zeros(near.shape)
        thickness[near] = body
        result[rows, columns] = thickness * np.maximum(1.0 + self._relief(x_line, y_line, angle, side), 0.2)
        return result

    def _relief(self, x_mm: Array, y_mm: Array, angle: float, side: float) -> Array:
        """Sum of the waves (row, column): a product of cosines and sines along rows and columns, no unit."""
        amplitude, along_x, along_y, phase = self.relief.T
        cosine, sine = math.cos(angle), math.sin(angle)
        by_x = 2 * np.pi * (side * along_x * cosine - along_y * sine)
        by_y = 2 * np.pi * (side * along_x * sine + along_y * cosine)
        rows = np.outer(y_mm, by_y) + phase
        columns = np.outer(by_x, x_mm)
        return np.asarray((amplitude * np.cos(rows)) @ np.cos(columns) - (amplitude * np.sin(rows)) @ np.sin(columns))


def rotation_about_z(angle: float) -> Array:
    """Rotation matrix (3, 3) that turns x towards y by `angle` (radians)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def sample_rotation(rng: np.random.Generator) -> Array:
    """A rotation matrix (3, 3), all orientations alike (a random unit quaternion)."""
    quaternion = rng.standard_normal(4)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def path_lengths_mm(shape: Shape, rays: Rays, *, rotation: Array, place_mm: Array) -> Array:
    """Path lengths (row, column) in mm of all rays through a shape that was turned and then moved.

    Args:
        shape: in its own coordinates.
        rays: of the field.
        rotation: (3, 3), columns are the shape's axes in the field.
        place_mm: (x, y, z) of its middle.
    """
    result = np.zeros(rays.shape)
    window = rays.window(np.asarray(place_mm, dtype=np.float64), shape.radius_mm)
    part = rays.part(*window)
    if 0 not in part.shape:
        result[window] = shape.path_mm(*_seen_by(part, rotation=rotation, place_mm=place_mm))
    return result


def levels_mm(shape: Shape, rays: Rays, *, rotation: Array, place_mm: Array) -> tuple[Array, Array]:
    """z (row, column) in mm where rays first enter and last leave a shape that was turned and then moved; as `path_lengths_mm`.

    Rays that miss it enter after they leave.
    """
    entry, leave = shape.interval_mm(*_seen_by(rays, rotation=rotation, place_mm=place_mm))
    return entry / rays.secant(), leave / rays.secant()


def _seen_by(rays: Rays, *, rotation: Array, place_mm: Array) -> tuple[Array, Array]:
    """Points of rays in the object's plane and their directions (3, row, column), in coordinates of a shape."""
    x, y = np.broadcast_arrays(rays.x_mm, rays.y_mm)
    to_plane = np.stack([x, y, np.full(x.shape, rays.source_mm)])
    direction = to_plane / np.linalg.norm(to_plane, axis=0)
    # from the middle of the crossing on, so that coordinates stay small
    start = np.stack([x, y, np.zeros(x.shape)]) - np.reshape(place_mm, (3, 1, 1))
    return np.tensordot(rotation.T, start, axes=1), np.tensordot(rotation.T, direction, axes=1)


def layer_lengths_mm(
    layer: "Heights | Fillet", rays: Rays, *, angle: float, mirrored: bool, place_mm: tuple[float, float]
) -> Array:
    """Path lengths (row, column) in mm of all rays through a thickness over the plane, turned about z and moved (x, y)."""
    x_mm, y_mm = rays.x_mm[0] - place_mm[0], rays.y_mm[:, 0] - place_mm[1]
    return np.asarray(layer.on_grid_mm(x_mm, y_mm, angle, mirrored) * rays.secant())

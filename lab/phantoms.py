"""Test objects of a session: step wedge, slanted edge, disc; and any scene as it really lies, not quite as stated."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .objects import Scene

Array = NDArray[np.float64]

OPAQUE = "W"
OPAQUE_MM = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Wedge:
    """Two crossed staircases of two materials on a square block, open field around it.

    Fields: half_mm (half side of the block); steps_mm: material -> thickness of its steps in mm; the first material's
    steps follow y, the second's x; turned: the block lies the other way round.
    """

    half_mm: float
    steps_mm: Mapping[str, tuple[float, ...]]
    turned: bool = False

    @property
    def materials(self) -> tuple[str, ...]:
        """What it is made of."""
        return tuple(self.steps_mm)

    def thickness_mm(self, y_mm: Array, x_mm: Array) -> dict[str, Array]:
        """Path lengths (mm) by material at points of the object's plane."""
        sign = -1.0 if self.turned else 1.0
        inside = (np.abs(y_mm) < self.half_mm) & (np.abs(x_mm) < self.half_mm)
        result = {}
        for (material, steps), along in zip(self.steps_mm.items(), (y_mm, x_mm), strict=True):
            place = (sign * along + self.half_mm) / (2.0 * self.half_mm) * len(steps)
            number = np.clip(np.floor(place), 0, len(steps) - 1).astype(np.intp)
            result[material] = np.where(inside, np.asarray(steps)[number], 0.0)
        return result


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """An opaque plate that covers one side of a straight line.

    Fields: angle (radians, direction of the edge's normal, from x towards y); offset_mm of the edge from the middle.
    """

    angle: float
    offset_mm: float = 0.0

    @property
    def materials(self) -> tuple[str, ...]:
        """What it is made of."""
        return (OPAQUE,)

    def thickness_mm(self, y_mm: Array, x_mm: Array) -> dict[str, Array]:
        """Path lengths (mm) by material at points of the object's plane."""
        along = x_mm * math.cos(self.angle) + y_mm * math.sin(self.angle)
        return {OPAQUE: np.where(along > self.offset_mm, OPAQUE_MM, 0.0)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Disc:
    """An opaque disc in the middle of the field."""

    radius_mm: float

    @property
    def materials(self) -> tuple[str, ...]:
        """What it is made of."""
        return (OPAQUE,)

    def thickness_mm(self, y_mm: Array, x_mm: Array) -> dict[str, Array]:
        """Path lengths (mm) by material at points of the object's plane."""
        return {OPAQUE: np.where(np.hypot(y_mm, x_mm) < self.radius_mm, OPAQUE_MM, 0.0)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Posed:
    """A scene as it really lies and is: moved, turned, magnified, its layers a little thicker or thinner than stated.

    Fields: scene; shift_y_mm, shift_x_mm; rotation (radians); magnification; scale: material -> true over stated.
    """

    scene: Scene
    shift_y_mm: float = 0.0
    shift_x_mm: float = 0.0
    rotation: float = 0.0
    magnification: float = 1.0
    scale: Mapping[str, float] = field(default_factory=dict)

    @property
    def materials(self) -> tuple[str, ...]:
        """What it is made of."""
        return self.scene.materials

    def thickness_mm(self, y_mm: Array, x_mm: Array) -> dict[str, Array]:
        """Path lengths (mm) by material at points of the object's plane."""
        y, x = (y_mm - self.shift_y_mm) / self.magnification, (x_mm - self.shift_x_mm) / self.magnification
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        lengths = self.scene.thickness_mm(y * cosine - x * sine, y * sine + x * cosine)
        return {material: length * self.scale.get(material, 1.0) for material, length in lengths.items()}

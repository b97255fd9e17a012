"""What the lab puts into the beam: slabs, chicken-like fillets and pieces of rib bone, as path lengths in mm.

Coordinates are mm in the object's plane, from the middle of the field; rays are taken as parallel (the true ones lean
by less than 5 degrees, 0.4 % in path length), so that a path length belongs to the ray that ends in a pixel.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .chain import SUBPIXELS, margin_px
from .system import LabSystem

Array = NDArray[np.float64]

PRODUCT_MATERIAL = "chicken_breast"
BONE_MATERIAL = "rib_bone"
RIB_ACROSS_MM = (1.0, 3.0)
TURN_DEGREES = 8.0  # how far a product may lie askew


class Scene(Protocol):
    """Anything that can stand in the beam."""

    @property
    def materials(self) -> tuple[str, ...]:
        """What it is made of."""
        ...

    def thickness_mm(self, y_mm: Array, x_mm: Array) -> Mapping[str, Array]:
        """Path lengths (mm) by material at points of the object's plane."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Slab:
    """Uniform layers over the whole field: material -> thickness in mm."""

    layers_mm: Mapping[str, float]

    @property
    def materials(self) -> tuple[str, ...]:
        """What it is made of."""
        return tuple(self.layers_mm)

    def thickness_mm(self, y_mm: Array, x_mm: Array) -> dict[str, Array]:
        """Path lengths (mm) by material at points of the object's plane."""
        shape = np.broadcast_shapes(y_mm.shape, x_mm.shape)
        return {material: np.full(shape, float(length)) for material, length in self.layers_mm.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fillet:
    """A rounded piece of meat with a smooth outline and a gently uneven surface.

    t = peak (1 - rho^3)^0.6 (1 + sum of waves), rho the distance from the middle over the outline's in that direction.

    Fields: name; half_y_mm, half_x_mm (half axes); peak_mm; outline (k, 2) cosine and sine of the k-th harmonic of the
    outline, from k = 2 on; waves (n, 4): amplitude, cycles per mm in y and x, phase.
    """

    name: str
    half_y_mm: float
    half_x_mm: float
    peak_mm: float
    outline: Array
    waves: Array

    def outline_at(self, angle: Array) -> Array:
        """Outline over the ellipse of the half axes, at angles in radians."""
        turn = np.exp(1j * np.asarray(angle))
        power = turn.copy()
        result: Array = np.ones(turn.shape)
        for cosine, sine in self.outline:
            power *= turn
            result += cosine * power.real + sine * power.imag
        return result

    def extent_mm(self, rotation: float) -> tuple[float, float]:
        """Half widths in y and x of the box around the fillet turned by `rotation` (radians) about its middle."""
        angle = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
        radius = self.outline_at(angle)
        y, x = radius * np.sin(angle) * self.half_y_mm, radius * np.cos(angle) * self.half_x_mm
        turned_y = y * math.cos(rotation) + x * math.sin(rotation)
        turned_x = -y * math.sin(rotation) + x * math.cos(rotation)
        return float(np.abs(turned_y).max()), float(np.abs(turned_x).max())

    def profile_mm(self, y_mm: Array, x_mm: Array) -> Array:
        """Thickness (mm) at points in the fillet's own coordinates."""
        v, u = y_mm / self.half_y_mm, x_mm / self.half_x_mm
        rho = np.hypot(v, u)
        thickness = np.zeros_like(rho)
        inside = rho < 2.0
        rho_in = rho[inside] / self.outline_at(np.arctan2(v[inside], u[inside]))
        body = self.peak_mm * np.maximum(1.0 - rho_in**3, 0.0) ** 0.6
        # Single precision: 1e-6 of a relief of a few per cent, in a third of the time.
        relief = np.ones(body.shape, dtype=np.float32)
        y_in, x_in = y_mm[inside].astype(np.float32), x_mm[inside].astype(np.float32)
        for amplitude, wave_y, wave_x, phase in self.waves.astype(np.float32):
            relief += amplitude * np.cos(np.float32(2.0 * np.pi) * (wave_y * y_in + wave_x * x_in) + phase)
        thickness[inside] = body * np.maximum(relief, 0.3)
        return thickness


@dataclass(frozen=True, slots=True, kw_only=True)
class Bone:
    """A piece of rib: a rod of elliptic section along a circular arc, with rounded ends.

    Fields: name; size_mm (length along the arc, ends included); width_mm (across, in the plane of the detector);
    height_mm (along the ray); bend_mm (radius of the arc).
    """

    name: str
    size_mm: float
    width_mm: float
    height_mm: float
    bend_mm: float

    def profile_mm(self, y_mm: Array, x_mm: Array) -> Array:
        """Path length (mm) at points in the bone's own coordinates, the rod lying along x through the middle."""
        half_width = self.width_mm / 2.0
        half_arc = max(self.size_mm / 2.0 - half_width, 0.0) / self.bend_mm
        y_from_centre = y_mm + self.bend_mm
        angle = np.clip(np.arctan2(x_mm, y_from_centre), -half_arc, half_arc)
        distance = np.hypot(x_mm - self.bend_mm * np.sin(angle), y_from_centre - self.bend_mm * np.cos(angle))
        result: Array = self.height_mm * np.sqrt(np.maximum(1.0 - (distance / half_width) ** 2, 0.0))
        return result


@dataclass(frozen=True, slots=True, kw_only=True)
class Product:
    """A fillet as it lies in the field, with or without a piece of bone.

    Fields: fillet; shift_y_mm, shift_x_mm, rotation (radians), mirrored: its pose; bone, or None; bone_y_mm, bone_x_mm,
    bone_rotation: the bone's pose in the field; embedded: the bone takes the place of meat, else it lies on top.
    """

    fillet: Fillet
    shift_y_mm: float = 0.0
    shift_x_mm: float = 0.0
    rotation: float = 0.0
    mirrored: bool = False
    bone: Bone | None = None
    bone_y_mm: float = 0.0
    bone_x_mm: float = 0.0
    bone_rotation: float = 0.0
    embedded: bool = True

    @property
    def materials(self) -> tuple[str, ...]:
        """What it is made of."""
        return (PRODUCT_MATERIAL,) if self.bone is None else (PRODUCT_MATERIAL, BONE_MATERIAL)

    def meat_mm(self, y_mm: Array, x_mm: Array) -> Array:
        """Path length (mm) in the meat without any bone."""
        y, x = _turned(y_mm - self.shift_y_mm, x_mm - self.shift_x_mm, -self.rotation)
        return self.fillet.profile_mm(y, -x if self.mirrored else x)

    def bone_mm(self, y_mm: Array, x_mm: Array) -> Array:
        """Path length (mm) in the bone."""
        if self.bone is None:
            return np.zeros(np.broadcast_shapes(y_mm.shape, x_mm.shape))
        y, x = _turned(y_mm - self.bone_y_mm, x_mm - self.bone_x_mm, -self.bone_rotation)
        return self.bone.profile_mm(y, x)

    def thickness_mm(self, y_mm: Array, x_mm: Array) -> dict[str, Array]:
        """Path lengths (mm) by material at points of the object's plane."""
        meat = self.meat_mm(y_mm, x_mm)
        if self.bone is None:
            return {PRODUCT_MATERIAL: meat}
        bone = self.bone_mm(y_mm, x_mm)
        if self.embedded:
            meat = np.maximum(meat - bone, 0.0)
        return {PRODUCT_MATERIAL: meat, BONE_MATERIAL: bone}


def _turned(y: Array, x: Array, rotation: float) -> tuple[Array, Array]:
    cosine, sine = math.cos(rotation), math.sin(rotation)
    return y * cosine + x * sine, -y * sine + x * cosine


def field_mm(system: LabSystem) -> tuple[float, float]:
    """Height and width (mm) of the field in the object's plane."""
    scale = system.pixel_mm / system.magnification
    return system.rows * scale, system.columns * scale


def clear_field_mm(system: LabSystem) -> tuple[float, float]:
    """Height and width (mm) that a product may take: the field without two pixels at every border."""
    height_mm, width_mm = field_mm(system)
    border_mm = 2.0 * system.pixel_mm / system.magnification
    return height_mm - 2.0 * border_mm, width_mm - 2.0 * border_mm


def fine_shape(system: LabSystem) -> tuple[int, int]:
    """Rows and columns of the grid of sub-pixels, margins of the light's spread included."""
    margin = margin_px(max(system.core_px))
    return (system.rows + 2 * margin) * SUBPIXELS, (system.columns + 2 * margin) * SUBPIXELS


def fine_grid_mm(system: LabSystem) -> tuple[Array, Array]:
    """Object-plane coordinates (mm) of the sub-pixels' middles, margins of the light's spread included.

    Returns:
        y (n, 1) and x (1, m).
    """
    step = system.pixel_mm / system.magnification / SUBPIXELS

    def line(count: int) -> Array:
        middles: Array = (np.arange(count, dtype=np.float64) - (count - 1) / 2.0) * step
        return middles

    rows, columns = fine_shape(system)
    return line(rows)[:, None], line(columns)[None, :]


def thickness_on_fine_grid(system: LabSystem, scene: Scene) -> dict[str, NDArray[np.float32]]:
    """Path lengths (mm) of a scene by material on the sub-pixels of the detector and its margins."""
    y_mm, x_mm = np.broadcast_arrays(*fine_grid_mm(system))
    return {material: length.astype(np.float32) for material, length in scene.thickness_mm(y_mm, x_mm).items()}


def pixel_means(system: LabSystem, fine: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean over the sub-pixels of each pixel of the detector, margins cut off; shape (rows, columns)."""
    margin = margin_px(max(system.core_px)) * SUBPIXELS
    inner = fine[margin : fine.shape[0] - margin, margin : fine.shape[1] - margin]
    blocks = inner.reshape(system.rows, SUBPIXELS, system.columns, SUBPIXELS)
    means: NDArray[np.float32] = blocks.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    return means


def sample_fillet(rng: np.random.Generator, *, name: str, half_y_mm: float, half_x_mm: float) -> Fillet:
    """A fillet of about the given half axes: 12 to 28 mm at its thickest, outline and surface drawn."""
    harmonics = np.arange(2, 7)
    outline = rng.standard_normal((harmonics.size, 2)) * (0.07 / (harmonics - 1.0))[:, None]
    wavelengths_mm = np.exp(rng.uniform(math.log(3.0), math.log(30.0), size=24))
    directions = rng.uniform(0.0, np.pi, size=24)
    amplitudes = 0.012 * (wavelengths_mm / 10.0) ** 0.8 * rng.standard_normal(24)
    waves = np.stack(
        [
            amplitudes,
            np.sin(directions) / wavelengths_mm,
            np.cos(directions) / wavelengths_mm,
            rng.uniform(0.0, 2.0 * np.pi, size=24),
        ],
        axis=1,
    )
    return Fillet(
        name=name,
        half_y_mm=half_y_mm,
        half_x_mm=half_x_mm,
        peak_mm=float(rng.uniform(12.0, 28.0)),
        outline=outline,
        waves=waves,
    )


def sample_bone(
    rng: np.random.Generator, *, name: str, size_mm: float, across_mm: tuple[float, float] = RIB_ACROSS_MM
) -> Bone:
    """A piece of bone of the given length, a rib's 1 to 3 mm across by default, never thicker than two thirds of its length."""
    width_mm = min(rng.uniform(*across_mm), size_mm / 1.5)
    return Bone(
        name=name,
        size_mm=size_mm,
        width_mm=width_mm,
        height_mm=width_mm * rng.uniform(0.6, 1.0),
        bend_mm=rng.uniform(15.0, 60.0),
    )


def place_fillet(rng: np.random.Generator, *, fillet: Fillet, system: LabSystem) -> Product:
    """A fillet in a random pose that leaves it whole inside the field.

    Raises:
        InputError: a product larger than the field.
    """
    height_mm, width_mm = clear_field_mm(system)
    for _ in range(50):
        rotation = math.radians(rng.uniform(-TURN_DEGREES, TURN_DEGREES))
        mirrored = bool(rng.random() < 0.5)
        # The mirror image turned by r is as large as the original turned by -r.
        half_y, half_x = fillet.extent_mm(-rotation if mirrored else rotation)
        slack_y, slack_x = height_mm / 2.0 - half_y, width_mm / 2.0 - half_x
        if slack_y >= 0 and slack_x >= 0:
            return Product(
                fillet=fillet,
                rotation=rotation + (math.pi if rng.random() < 0.5 else 0.0),
                mirrored=mirrored,
                shift_y_mm=rng.uniform(-1.0, 1.0) * min(slack_y, 0.1 * height_mm),
                shift_x_mm=rng.uniform(-1.0, 1.0) * min(slack_x, 0.1 * width_mm),
            )
    half_y, half_x = fillet.extent_mm(0.0)
    raise InputError(
        "product",
        received=f"a fillet of {2 * half_y:.0f} x {2 * half_x:.0f} mm",
        expected=f"one that fits into {height_mm:.0f} x {width_mm:.0f} mm, the field without its borders",
        remedy="take a smaller --product-mm, or a larger --size or --pixel-mm",
    )


def place_bone(rng: np.random.Generator, *, product: Product, bone: Bone) -> Product:
    """The same product with a bone in or on it, all of it where the meat is a fifth of its peak or more."""
    fillet = product.fillet
    reach_mm = max(fillet.half_y_mm, fillet.half_x_mm) * 1.3
    sag_mm = (bone.size_mm / 2.0) ** 2 / (2.0 * bone.bend_mm)
    corner_y, corner_x = np.meshgrid(
        np.linspace(-bone.width_mm / 2.0 - sag_mm, bone.width_mm / 2.0, 3), np.linspace(-0.5, 0.5, 5) * bone.size_mm
    )
    for _ in range(1000):
        y, x = rng.uniform(-reach_mm, reach_mm, size=2)
        turn = rng.uniform(0.0, 2.0 * np.pi)
        y_box, x_box = _turned(corner_y, corner_x, turn)
        y_mm, x_mm = product.shift_y_mm + y, product.shift_x_mm + x
        if product.meat_mm(y_mm + y_box, x_mm + x_box).min() > 0.2 * fillet.peak_mm:
            return Product(
                fillet=fillet,
                shift_y_mm=product.shift_y_mm,
                shift_x_mm=product.shift_x_mm,
                rotation=product.rotation,
                mirrored=product.mirrored,
                bone=bone,
                bone_y_mm=float(y_mm),
                bone_x_mm=float(x_mm),
                bone_rotation=float(turn),
                embedded=bool(rng.random() < 0.5),
            )
    raise InputError(
        "foreign object",
        received=f"a bone of {bone.size_mm:g} mm",
        expected=f"one that fits into the product of {2 * fillet.half_x_mm:.0f} x {2 * fillet.half_y_mm:.0f} mm",
        remedy="take a larger --product-mm, --size or --pixel-mm",
    )

"""The texture of a product: how its thickness varies from place to place, as a power spectrum read from reference images.

    T(f) = A (f / f0)^(-b),    f in cycles/mm, f0 = 0.1 cycles/mm

T is the power of the thickness (mm^2; its mean over all frequencies of the pixel grid is the variance of a pixel).
Outside the measured frequencies the law is continued; below the lowest one it is kept flat.

Source: Burgess, Jacobson & Judy, Med. Phys. 28 (2001) 419 (power laws of natural textures).
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..acquisition.dataset_io import Dataset
from ..acquisition.setting import Setting
from ..errors import InputError
from .frequencies import FrequencyBins

if TYPE_CHECKING:
    from .line_images import LineImages

FloatArray = NDArray[np.float64]
_F0_PER_MM = 0.1
_PATCH_PX = 16
_MOST_PATCHES = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class ProductTexture:
    """A power law. Fields: amplitude_mm4 (A times a pixel's area), exponent b, lowest_per_mm (flat below)."""

    amplitude_mm4: float
    exponent: float
    lowest_per_mm: float

    def power(self, bins: FrequencyBins, pixel_mm: float) -> FloatArray:
        """Power of the thickness in the bins (bin,), mm^2; pixel_mm: pitch in the object's plane."""
        frequency = np.maximum(np.hypot(bins.row, bins.column) / pixel_mm, self.lowest_per_mm)
        return np.asarray(self.amplitude_mm4 / pixel_mm**2 * (frequency / _F0_PER_MM) ** -self.exponent)


def texture_of_references(
    dataset: Dataset, line: "LineImages", *, pair: tuple[Setting, Setting], material: str
) -> ProductTexture:
    """Texture of the products of reference images, read from their high-kV images inside the product and away from objects.

    Squares of 16 pixels, a plane taken off each, weighted by a Hann window; the noise that the line puts into the references is
    subtracted; a power law is fitted to what stands above it, at least a tenth of it.

    Args:
        dataset: low-noise images with product masks.
        line: the twin.
        pair: setting of the references.
        material: the product's.

    Raises:
        InputError: no square of the product is large enough, or no texture stands above the noise.
    """
    squares, logs = _squares(dataset)
    if len(squares) < 4:
        raise InputError(
            dataset.path,
            received=f"{len(squares)} squares of {_PATCH_PX} px inside products",
            expected="4 or more",
            remedy="references with product masks",
        )
    _, slope, quantum, white = line.product_at(logs, pair[1], material)
    windowed, gain = _windowed(squares)
    power = np.abs(np.fft.fft2(windowed)) ** 2 / (_PATCH_PX**2 * gain)
    whole = line.noise_power_of_patch(_PATCH_PX)
    noise = quantum[:, None, None] * whole + white[:, None, None]
    frequency = np.hypot(*np.meshgrid(*(2 * [np.fft.fftfreq(_PATCH_PX)]), indexing="ij"))
    rings = np.round(frequency * _PATCH_PX).astype(int)
    rows = []
    for ring in range(2, _PATCH_PX // 2):
        chosen = rings == ring
        above = float(((power - noise)[:, chosen] / slope[:, None] ** 2).mean())
        level = float((noise[:, chosen] / slope[:, None] ** 2).mean())
        if above > 0.1 * level:
            rows.append((ring / _PATCH_PX / line.object_pixel_mm, above))
    if len(rows) < 3:
        raise InputError(
            dataset.path,
            received="products without texture above the noise",
            expected="texture at three frequencies or more",
        )
    at, found = np.log(np.array(rows)).T
    slope_b, level_b = np.polyfit(at - math.log(_F0_PER_MM), found, 1)
    return ProductTexture(
        amplitude_mm4=float(math.exp(level_b) * line.object_pixel_mm**2),
        exponent=float(-slope_b),
        lowest_per_mm=float(math.exp(at[0])),
    )


def _squares(dataset: Dataset) -> tuple[FloatArray, FloatArray]:
    """High-kV squares (square, row, column) inside products without object, and their means."""
    squares = []
    for number in range(len(dataset)):
        inside = dataset.product_masks(number) & ~dataset.foreign_object_masks(number)
        high = dataset.images(number)[1].astype(np.float64)
        for row in range(0, high.shape[0] - _PATCH_PX + 1, _PATCH_PX):
            for column in range(0, high.shape[1] - _PATCH_PX + 1, _PATCH_PX):
                place = (slice(row, row + _PATCH_PX), slice(column, column + _PATCH_PX))
                if inside[place].all():
                    squares.append(high[place])
        if len(squares) >= _MOST_PATCHES:
            break
    found = np.array(squares[:_MOST_PATCHES]).reshape(-1, _PATCH_PX, _PATCH_PX)
    return found, found.mean(axis=(1, 2))


def _windowed(squares: FloatArray) -> tuple[FloatArray, float]:
    """Squares less their planes, times a Hann window, and the window's mean square."""
    step = np.arange(_PATCH_PX) - 0.5 * (_PATCH_PX - 1)
    row, column = np.meshgrid(step, step, indexing="ij")
    plane = np.stack([np.ones(_PATCH_PX**2), row.ravel(), column.ravel()], axis=1)
    flat = squares.reshape(len(squares), -1)
    flat = flat - (flat @ plane / np.square(plane).sum(axis=0)) @ plane.T
    window = np.hanning(_PATCH_PX + 2)[1:-1]
    both = np.outer(window, window)
    return flat.reshape(squares.shape) * both, float((both**2).mean())

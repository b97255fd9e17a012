"""What stands in the beam: path lengths, and where a border cuts a pixel."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..kernels.projection import project_polychromatic
from ..line.line_state import FloatArray
from ..line.spectral_signal import SpectralModel
from ..spread._fine_picture import Borders, FineCells, cell_coverage, find_borders, fine_cells
from .model_cache import ModelCache

_BORDER_KEV = 40.0  # attenuation at this energy says where the border of an object lies
_BORDER_DEPTH = 0.02  # optical depth across a pixel's neighbourhood from which its border counts
_MOST_UNIQUE_PIXELS = 300_000
_SINGLE_PRECISION_CELLS = 2_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Objects of known thickness.

    Fields: materials; thickness_mm (material, point): the distinct points where that saves work; inverse (pixel,): point of each
    pixel, or None; borders; covered_cells (border pixel, 3, 3); shape of the detector.
    """

    materials: tuple[str, ...]
    thickness_mm: NDArray[np.float64]
    inverse: NDArray[np.intp] | None
    borders: Borders
    covered_cells: FloatArray
    shape: tuple[int, int]

    @property
    def nbytes(self) -> int:
        """Of the path lengths."""
        return self.thickness_mm.nbytes + (0 if self.inverse is None else self.inverse.nbytes)

    def project(
        self, weights: FloatArray, model: SpectralModel, attenuation_scale: Mapping[str, float], *, fine: bool
    ) -> tuple[FloatArray, FineCells | None]:
        """Maps (k, row, column) of sum_E weights exp(-mu t); the cells of the first one where there are steps and they are asked for.

        Args:
            weights: (k, energy).
            model: whose energies and attenuation they are.
            attenuation_scale: material -> factor.
            fine: whether cells are asked for.
        """
        top = weights.shape[1]
        mu = np.stack([model.mu(material)[:top] * attenuation_scale.get(material, 1.0) for material in self.materials])
        flat = project_polychromatic(self.thickness_mm, mu, weights).astype(np.float64)
        if self.inverse is not None:
            flat = flat[:, self.inverse]
        return _with_borders(flat, self, fine=fine)


def scene_of(
    thickness_mm: Mapping[str, NDArray[np.floating]], model: SpectralModel, shape: tuple[int, int], cache: ModelCache
) -> Scene:
    """Path lengths (row, column) of each material as a scene, kept for as long as they are asked for.

    Raises:
        InputError: another shape than the detector's, negative or infinite path lengths.
    """
    found: Scene = cache.made("scene", (thickness_mm,), shape, lambda: _scene(thickness_mm, model, shape))
    return found


def _scene(thickness_mm: Mapping[str, NDArray[np.floating]], model: SpectralModel, shape: tuple[int, int]) -> Scene:
    materials = tuple(thickness_mm)
    stack = np.stack([np.asarray(thickness_mm[name], dtype=np.float64) for name in materials])
    if stack.shape[1:] != shape:
        raise InputError(
            "thickness maps of a scene",
            received=f"{stack.shape[1:]}",
            expected=f"(row, column) of the twin's detector, {shape}",
        )
    if not np.all(np.isfinite(stack) & (stack >= 0)):
        raise InputError(
            "thickness maps of a scene",
            received="negative or not finite path lengths",
            expected="finite path lengths of 0 mm or more",
        )
    energy = int(np.searchsorted(model.energies_keV, _BORDER_KEV))
    depth = np.tensordot([model.mu(name)[energy] for name in materials], stack, axes=1)
    points = stack.reshape(len(materials), -1)
    inverse = None
    if points.shape[1] <= _MOST_UNIQUE_PIXELS:
        distinct, where = _distinct(points.astype(np.float32))
        if distinct.shape[1] < 0.7 * points.shape[1]:
            points, inverse = distinct.astype(np.float64), where
    borders = find_borders(depth, least_depth=_BORDER_DEPTH)
    covered = cell_coverage(borders.normal[0], borders.normal[1], borders.covered)
    return Scene(materials, points, inverse, borders, covered, shape)


def _with_borders(flat: FloatArray, scene: Scene, *, fine: bool) -> tuple[FloatArray, FineCells | None]:
    """Maps (k, row, column) of what was projected pixel by pixel (k, pixel), with the pixels that borders cut shared."""
    borders = scene.borders
    thick, thin = flat[:, borders.thick], flat[:, borders.thin]
    if borders.pixel.size:
        shared = borders.covered * thick + (1.0 - borders.covered) * thin
        flat[:, borders.pixel] += borders.sharpness * (shared - flat[:, borders.pixel])
    maps = flat.reshape(len(flat), *scene.shape)
    if not (fine and borders.any_steps):
        return maps, None
    cells = fine_cells(maps[0], thick[0], thin[0], borders, scene.covered_cells)
    return maps, FineCells(cells.astype(np.float32) if cells.size > _SINGLE_PRECISION_CELLS else cells)


def _distinct(points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Distinct columns of points (coordinate, point), in order, and the number of each point's column (point,).

    One or two coordinates are sorted as numbers, in a third of the time that columns take or less (16,384 points).
    """
    if len(points) > 2:
        distinct, where = np.unique(points, axis=1, return_inverse=True)
        return distinct, where.reshape(-1)
    numbers = points[0] if len(points) == 1 else points[0] + 1j * points[1]
    found, where = np.unique(numbers, return_inverse=True)
    distinct = found[None, :] if len(points) == 1 else np.stack([found.real, found.imag])
    return distinct, where.reshape(-1)

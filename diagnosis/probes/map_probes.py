"""Map probes: projections of a mean frame's residual on templates, of unit noise and independent of each other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, RealArray
from ._projection_loops import REACH, weigh_template
from .probes import ProbeName
from .registration import gradient

_INDEPENDENT = 1e-3  # share of a template's square that those before it must leave
_LEAST_NORM = 1e-6  # standard deviations that a template stands for; below it is rounding


@dataclass(frozen=True, slots=True)
class Template:
    """A map (row, column) to project on, DN, and what it stands for."""

    axis: str
    name: str
    unit: str
    image: RealArray


class MapProjection:
    """Projection of residual maps onto templates that are made orthogonal in their order; unit noise.

    q = T^T W r; Cov q = T^T W C W T = L L^T (Cholesky in the templates' order, dependent ones dropped); y = L^-1 q.
    """

    def __init__(
        self,
        templates: Sequence[Template],
        *,
        mask: BoolArray,
        quantum_DN2: RealArray,
        white_DN2: RealArray,
        autocovariance_table: RealArray,
    ) -> None:
        """`quantum_DN2`, `white_DN2` (row, column): variances of the mean frame's correlated and white parts."""
        weight = np.where(mask, 1.0 / np.maximum(np.asarray(quantum_DN2 + white_DN2, dtype=np.float64), 1e-30), 0.0)
        # a template counts by its shape: single precision is a ten-thousandth of what is left of one that is kept
        maps = (np.sqrt(weight), np.sqrt(np.maximum(quantum_DN2, 0.0)), white_DN2)
        sharper, root, white = (np.ascontiguousarray(one, dtype=np.float32) for one in maps)
        kernels = _separated(np.asarray(autocovariance_table, dtype=np.float64))
        used: list[Template] = []
        rows, spread = (np.empty((len(templates), *mask.shape), np.float32) for _ in range(2))
        for template in templates:
            # rows are 0 outside the mask, as the weights are
            image = np.ascontiguousarray(template.image, dtype=np.float32)
            norm = weigh_template(image, sharper, root, white, *kernels, rows[len(used)], spread[len(used)])
            if norm > _LEAST_NORM and math.isfinite(norm):
                used.append(template)
        rows, spread = (one[: len(used)].reshape(len(used), mask.size) for one in (rows, spread))
        left = np.asarray(rows @ spread.T, dtype=np.float64)
        own = np.diag(left).copy()
        chosen: list[int] = []
        columns: list[FloatArray] = []
        for number in range(len(used)):
            rest = float(left[number, number])
            if rest > _INDEPENDENT * own[number]:
                chosen.append(number)
                columns.append(left[number] / math.sqrt(rest))
                left -= np.outer(columns[-1], columns[-1])
        # one a probe; the images are not kept: fifty a series would be most of the memory
        self.names = tuple(
            ProbeName(axis=item.axis, statistic="mean frame", location=item.name, unit=item.unit)
            for item in (used[number] for number in chosen)
        )
        # (probe, pixel), 0 outside the mask: so maps are taken as they are
        self._shape = mask.shape
        self._rows = np.zeros((len(chosen), mask.size), np.float32)
        if chosen:
            from scipy.linalg import solve_triangular

            lower = np.tril(np.stack(columns, axis=1)[chosen])
            inverse = solve_triangular(lower, np.eye(len(chosen)), lower=True, check_finite=False)
            np.matmul(inverse.astype(np.float32), rows[chosen], out=self._rows)
        self.of_level = self._rows.sum(axis=1, dtype=np.float64)  # (probe,) of 1 DN in every pixel

    def __len__(self) -> int:
        return len(self.names)

    def apply(self, images: RealArray) -> FloatArray:
        """Standardised projections (..., probe) of maps (..., row, column), DN."""
        pixels = images.reshape(*images.shape[:-2], -1).astype(np.float32, copy=False)
        return np.asarray(pixels @ self._rows.T, dtype=np.float64)

    def apply_each(self, images: Sequence[RealArray]) -> FloatArray:
        """Standardised projections (image, probe) of maps, (row, column) or (1, 1) where all pixels are alike, DN."""
        result = np.empty((len(images), len(self)))
        wide = [number for number, image in enumerate(images) if image.size > 1]
        for number, image in enumerate(images):
            if image.size == 1:
                result[number] = float(image.flat[0]) * self.of_level
        if wide:
            result[wide] = self.apply(np.stack([images[number] for number in wide]))
        return result

    def pixel_noise(self, sd_DN: RealArray) -> FloatArray:
        """Variance (probe,) that independent noise of the pixels, sd_DN (row, column), gives the projections."""
        variance = np.asarray(sd_DN, dtype=np.float32).ravel() ** 2
        return np.array([np.square(row) @ variance for row in self._rows], dtype=np.float64)

    def field_noise(self, sd_DN: RealArray, side_px: float) -> FloatArray:
        """The same of noise that is alike over an area of side_px x side_px pixels: that of squares of about this side."""
        side = max(round(side_px), 1)
        if side == 1:
            return self.pixel_noise(sd_DN)
        over = side_px**2 / side**2
        sd = np.asarray(sd_DN, dtype=np.float32)
        result = np.empty(len(self))
        for number, row in enumerate(self._rows):
            squares = row.reshape(self._shape) * sd
            for axis, length in enumerate(self._shape):
                squares = np.add.reduceat(squares, np.arange(0, length, side), axis=axis)
            result[number] = over * float(np.sum(squares.astype(np.float64) ** 2))
        return result

    def column_noise(self, sd_DN: RealArray) -> FloatArray:
        """The same of noise that each column has in common."""
        sd = np.asarray(sd_DN, dtype=np.float32)
        result = np.empty(len(self))
        for number, row in enumerate(self._rows):
            result[number] = np.sum(np.sum(row.reshape(self._shape) * sd, axis=0, dtype=np.float64) ** 2)
        return result

    def line_noise(self) -> FloatArray:
        """Variance (2, probe) that noise of 1 DN, common to each row and then common to each column, gives the projections."""
        pixels = self._rows.reshape(len(self), *self._shape)
        return np.stack([np.sum(pixels.sum(axis=axis, dtype=np.float64) ** 2, axis=1) for axis in (2, 1)])


def _separated(table: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Kernels (part, tap) along rows and along columns whose products add up to an autocovariance, 0 beyond what its table holds."""
    taps = np.zeros((1 + REACH, 1 + REACH))
    known = table[: 1 + REACH, : 1 + REACH]
    taps[: known.shape[0], : known.shape[1]] = known
    across, sizes, along = np.linalg.svd(taps)
    parts = np.flatnonzero(sizes > 1e-12 * sizes[0])
    halves = (across[:, parts] * sizes[parts]).T, along[parts]
    rows, columns = (half.astype(np.float32) for half in halves)
    return rows, columns


def smooth_templates(signal_DN: RealArray, mask: BoolArray, *, kind: str) -> list[Template]:
    """Level, gradients and curvatures across the field, relative to the signal (darks: in DN)."""
    base, unit = np.asarray(signal_DN, dtype=np.float64), "1"
    if kind in ("dark", "afterglow"):
        base, unit = np.ones(mask.shape), "DN"
    y, x = np.meshgrid(*(np.linspace(-1.0, 1.0, length) for length in mask.shape), indexing="ij")
    shapes = {
        "along columns": x,
        "along rows": y,
        "curved along columns": x**2,
        "curved along rows": y**2,
        "diagonal": x * y,
        "cubic along columns": x**3,
        "cubic along rows": y**3,
    }
    # left half against right, upper against lower quarter: seams of tiles and panels
    for name, count in (("halves", 2), ("quarters", 4)):
        for along, place, length in zip(("rows", "columns"), np.indices(mask.shape), mask.shape, strict=True):
            shapes[f"{name} along {along}"] = np.where(place * count // length % 2 == 0, 1.0, -1.0)
    level = Template("level", "whole field", unit, base)
    return [level, *(Template("position", name, unit, base * shape) for name, shape in shapes.items())]


def transmission_templates(signal_DN: RealArray, open_DN: RealArray, mask: BoolArray) -> list[Template]:
    """Six bins of transmission: the signal where -log T lies in each, relative; the open field apart."""
    log_t = -np.log(np.clip(np.asarray(signal_DN / np.maximum(open_DN, 1e-12), dtype=np.float64), 1e-9, None))
    covered = mask & (log_t > 0.02)
    # behind 6 and more nothing of the primary is left to speak of: one bin, in DN of the open field
    shadow = covered & (log_t > 6.0)
    lit = covered & ~shadow
    parts = [("open field", mask & ~covered, signal_DN)]
    if covered.sum() >= 64 and shadow.sum() >= 32:
        parts.append(("shadow, -log T above 6", shadow, open_DN))
    if lit.sum() >= 64:
        for low, high in pairwise(np.unique(np.quantile(log_t[lit], np.linspace(0, 1, 7)))):
            inside = lit & (log_t >= low) & (log_t <= high)
            if inside.sum() >= 32:
                parts.append((f"-log T {low:.2f}-{high:.2f}", inside, signal_DN))
    return [Template("level", name, "1", np.where(inside, image, 0.0)) for name, inside, image in parts]


def edge_templates(signal_DN: RealArray) -> list[Template]:
    """Displacement, blur along each direction at three scales, ringing, and tails of several lengths."""
    from scipy.ndimage import gaussian_filter, gaussian_filter1d

    image = np.asarray(signal_DN, dtype=np.float64)
    dy, dx = gradient(image)
    rows, columns = image.shape
    y = (np.arange(rows) - (rows - 1) / 2)[:, None] / rows
    x = (np.arange(columns) - (columns - 1) / 2)[None, :] / columns
    result = [
        Template("sharpness", "shift along columns", "px", dx),
        Template("sharpness", "shift along rows", "px", dy),
        Template("sharpness", "magnification", "1", x * dx + y * dy),
        Template("sharpness", "rotation", "rad", x * dy - y * dx),
    ]
    for sigma in (0.6, 1.5, 4.0):
        for axis, name in ((1, "columns"), (0, "rows")):
            blurred = gaussian_filter1d(image, sigma, axis=axis, mode="nearest")
            result.append(Template("sharpness", f"blur of {sigma:g} px along {name}", "1", blurred - image))
    for sigma in (8.0, 20.0):
        if sigma < 0.4 * min(image.shape):
            blurred = gaussian_filter(image, sigma, mode="nearest")
            result.append(Template("sharpness", f"tail of {sigma:g} px", "1", blurred - image))
    return result

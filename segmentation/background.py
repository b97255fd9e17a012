"""The smooth part of an image: at every pixel the parabola that fits best around it, whatever stands out of it."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .robust import biweight, robust_sd

# The fit's Gaussian is a quarter of the product's side wide. On generated images a parabola of that width kept as much of voids in
# a box as a plane of half of it, and showed those in a dome, whose roundness hid them from planes.
_WIDTH_SHARE = 0.25
_ORDER = 2
_LEAST_WIDTH_PX = 1.5
# Wider fits are made on means of squares of pixels: a Gaussian of this width in cells is sampled well enough.
_WIDTH_CELLS = 8.0
_REACH = 2.5  # standard deviations of the Gaussian
_PASSES = 4


def smooth_part(image: NDArray[np.float64], inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Value of the parabola (six terms) that is fitted robustly around each pixel to the pixels inside.

    The weights fall off as a Gaussian whose standard deviation is a quarter of the square root of the product's area. A
    square of a twentieth of that area keeps 94 % of a contrast of five standard deviations a pixel and three quarters of one
    of a standard deviation; one of a seventh keeps less than half.

    Args:
        image: (row, column).
        inside: (row, column), the product's pixels.

    Returns:
        (row, column); without meaning where no product is near.

    Source: Cleveland 1979, J. Am. Stat. Assoc. 74:829 (robust locally weighted regression), in two dimensions.
    """
    width = max(_WIDTH_SHARE * math.sqrt(float(inside.sum())), _LEAST_WIDTH_PX)
    cell = max(1, int(width / _WIDTH_CELLS))
    share = _means(inside.astype(np.float64), cell)
    values = _means(np.where(inside, image, 0.0), cell) / np.maximum(share, 1e-12)
    weights = share
    fit = values
    for _ in range(_PASSES):
        fit = _local_fit(values, weights, width=width / cell)
        left = values - fit
        weights = share * biweight(left, sd=robust_sd(left[share > 0]))
    return _spread_out(fit, cell, image.shape)


def _local_fit(values: NDArray[np.float64], weights: NDArray[np.float64], *, width: float) -> NDArray[np.float64]:
    """The weighted parabola around each cell, at that cell."""
    from scipy import ndimage

    reach = math.ceil(_REACH * width)
    offset = np.arange(-reach, reach + 1) / width
    profile = np.exp(-0.5 * offset**2)

    def moment(of: NDArray[np.float64], down: int, across: int) -> NDArray[Any]:
        along_rows = ndimage.correlate1d(of, profile * offset**down, axis=0, mode="constant")
        return np.asarray(ndimage.correlate1d(along_rows, profile * offset**across, axis=1, mode="constant"))

    terms = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]
    moments = {(i, j): moment(weights, i, j) for i in range(2 * _ORDER + 1) for j in range(2 * _ORDER + 1 - i)}
    normal = np.stack([np.stack([moments[i + k, j + m] for k, m in terms], -1) for i, j in terms], -2)
    right = np.stack([moment(weights * values, i, j) for i, j in terms], -1)
    # a fit that too few pixels hold is level
    normal += 1e-6 * (moments[0, 0] + 1e-6)[..., None, None] * np.eye(len(terms))
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0, 0])


def _means(image: NDArray[np.float64], cell: int) -> NDArray[np.float64]:
    """Means of squares of cell x cell pixels; pixels that miss from the last ones count as 0."""
    if cell == 1:
        return image
    rows, columns = (-(-length // cell) for length in image.shape)
    whole = np.zeros((rows * cell, columns * cell))
    whole[: image.shape[0], : image.shape[1]] = image
    return np.asarray(whole.reshape(rows, cell, columns, cell).mean((1, 3)))


def _spread_out(fit: NDArray[np.float64], cell: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Values of cells at pixels, linearly between the cells' middles."""
    from scipy import ndimage

    if cell == 1:
        return fit
    places = np.meshgrid(*((np.arange(length) + 0.5) / cell - 0.5 for length in shape), indexing="ij")
    return np.asarray(ndimage.map_coordinates(fit, places, order=1, mode="nearest"))

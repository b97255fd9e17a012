"""Pictures enlarged and turned about the middle of the field."""

import math
from functools import lru_cache

import numpy as np

from ..line.line_state import FloatArray


def displacement_px(shape: tuple[int, int], *, radial_px: float, turn_px: float) -> tuple[FloatArray, FloatArray]:
    """Displacement (row, column) along rows and along columns, px, of an enlargement and a counter-clockwise turn of these sizes."""
    row = np.arange(shape[0])[:, None] - 0.5 * (shape[0] - 1)
    column = np.arange(shape[1])[None, :] - 0.5 * (shape[1] - 1)
    rms = math.sqrt(float(np.mean(row**2) + np.mean(column**2))) or 1.0
    return (radial_px * row - turn_px * column) / rms, (radial_px * column + turn_px * row) / rms


def distorted(picture: FloatArray, *, radial_px: float, turn_px: float) -> FloatArray:
    """A blurred picture (row, column) enlarged and turned, by cubic splines taken where each pixel comes from.

    Only after the blur: splines ring at steps, and a turned step then looks like no other turned step.
    """
    if picture.shape == (1, 1) or (radial_px == 0.0 and turn_px == 0.0):
        return picture
    shape = (picture.shape[0], picture.shape[1])
    down, right = displacement_px(shape, radial_px=radial_px, turn_px=turn_px)
    if turn_px == 0.0:
        # an enlargement moves rows alike in all columns, and columns alike in all rows
        rows, columns = (_resampling(np.ascontiguousarray(line).tobytes()) for line in (down[:, 0], right[0]))
        return np.asarray(rows @ picture @ columns.T)
    from scipy.ndimage import map_coordinates

    row, column = np.indices(shape, dtype=np.float64)
    return np.asarray(map_coordinates(picture, [row - down, column - right], order=3, mode="nearest"))


@lru_cache(maxsize=32)
def _resampling(displacement_px: bytes) -> FloatArray:
    """Cubic splines through the pixels of a line (pixel,), taken where each pixel comes from: (pixel, pixel)."""
    from scipy.ndimage import map_coordinates

    moved = np.frombuffer(displacement_px)
    line, pixel = np.indices((moved.size, moved.size), dtype=np.float64)
    places = np.stack([line - moved[:, None], pixel])
    return np.asarray(map_coordinates(np.eye(moved.size), places, order=3, mode="nearest"), dtype=np.float64)

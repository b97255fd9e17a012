"""Compiled: sums over the pixels of pictures that fade."""

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, fastmath={"contract", "nsz", "reassoc"})  # type: ignore[untyped-decorator]
def own_parts(pictures: Any, shape: Any) -> Any:
    """Take off each picture (picture, pixel), in place, its mean times `shape` (pixel,); returns the largest |left| (picture,)."""
    count, pixels = pictures.shape
    largest = np.zeros(count)
    for i in range(count):
        mean = 0.0
        for pixel in range(pixels):
            mean += pictures[i, pixel]
        mean /= max(pixels, 1)
        for pixel in range(pixels):
            own = pictures[i, pixel] - mean * shape[pixel]
            pictures[i, pixel] = own
            largest[i] = max(largest[i], abs(own))
    return largest


@njit(cache=True, fastmath={"contract", "nsz", "reassoc"})  # type: ignore[untyped-decorator]
def sums_of_products(pictures: Any, starts: Any) -> Any:
    """Sums of products (part, picture, picture) of pictures (picture, pixel) over pixels from each of `starts` to the next."""
    count = pictures.shape[0]
    result = np.zeros((len(starts) - 1, count, count))
    for part in range(len(starts) - 1):
        for i in range(count):
            for j in range(i + 1):
                total = 0.0
                for pixel in range(starts[part], starts[part + 1]):
                    total += pictures[i, pixel] * pictures[j, pixel]
                result[part, i, j] = total
                result[part, j, i] = total
    return result


@njit(cache=True)  # type: ignore[untyped-decorator]
def sums_of_lines(pictures: Any, order: Any, rows: int, columns: int) -> Any:
    """Sums (picture, row) and (picture, column) of pictures (picture, pixel) whose pixels have the flat indices `order` (pixel,)."""
    count = pictures.shape[0]
    of_rows, of_columns = np.zeros((count, rows)), np.zeros((count, columns))
    for i in range(count):
        for pixel in range(len(order)):
            row = order[pixel] // columns
            of_rows[i, row] += pictures[i, pixel]
            of_columns[i, order[pixel] - row * columns] += pictures[i, pixel]
    return of_rows, of_columns

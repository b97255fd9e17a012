"""Compiled: a template weighed by the noise, and what the noise's covariance makes of it."""

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True)  # type: ignore[untyped-decorator]
def weigh_template(
    image: Any, sharper: Any, root: Any, white: Any, across: Any, along: Any, row: Any, covered: Any
) -> Any:
    """Fill row with W t / |W^(1/2) t| and covered with C W t / |W^(1/2) t| of a template t; returns |W^(1/2) t|.

    The noise's covariance C is that of a correlated part and of a white one; borders: nothing beyond.

    Args:
        image: t (row, column).
        sharper: W^(1/2) (row, column).
        root: standard deviation (row, column) of the correlated part.
        white: variance (row, column) of the white part.
        across, along: (part, tap): kernels along rows and along columns whose products add up to the autocovariance.
        row, covered: to fill, (row, column).
    """
    rows, columns = image.shape
    total = 0.0
    for i in range(rows):
        for j in range(columns):
            value = image[i, j] * sharper[i, j]
            total += value * value
            row[i, j] = value
    norm = math.sqrt(total)
    if not (norm > 0.0 and math.isfinite(norm)):
        return norm
    reach = across.shape[1] // 2
    held = np.zeros((rows, columns))
    for i in range(rows):
        for j in range(columns):
            row[i, j] = row[i, j] * sharper[i, j] / norm
            held[i, j] = row[i, j] * root[i, j]
            covered[i, j] = 0.0
    line = np.zeros(columns + 2 * reach)
    for part in range(across.shape[0]):
        for i in range(rows):
            line[:] = 0.0
            for tap in range(2 * reach + 1):
                other = i + tap - reach
                if 0 <= other < rows:
                    weight = across[part, tap]
                    for j in range(columns):
                        line[j + reach] += weight * held[other, j]
            for tap in range(2 * reach + 1):
                weight = along[part, tap]
                for j in range(columns):
                    covered[i, j] += weight * line[j + tap]
    for i in range(rows):
        for j in range(columns):
            covered[i, j] = covered[i, j] * root[i, j] + row[i, j] * white[i, j]
    return norm

"""Compiled: a template weighed by the noise, and what the noise's covariance makes of it."""

import math
from typing import Any

import numpy as np
from numba import njit

REACH = 3  # pixels to each side over which noise is correlated


@njit(cache=True, fastmath={"contract", "nsz", "reassoc"})  # type: ignore[untyped-decorator]
def weigh_template(
    image: Any, sharper: Any, root: Any, white: Any, across: Any, along: Any, row: Any, covered: Any
) -> Any:
    """Fill row with W t / |W^(1/2) t| and covered with C W t / |W^(1/2) t| of a template t; returns |W^(1/2) t|.

    The noise's covariance C is that of a correlated part and of a white one; borders: nothing beyond. All in single precision.

    Args:
        image: t (row, column).
        sharper: W^(1/2) (row, column).
        root: standard deviation (row, column) of the correlated part.
        white: variance (row, column) of the white part.
        across, along: (part, 1 + REACH): kernels along rows and along columns, from their middle on, whose products add up to the
            autocovariance.
        row, covered: to fill, (row, column).
    """
    rows, columns = image.shape
    total = 0.0
    for i in range(rows):
        of_line = np.float32(0.0)
        for j in range(columns):
            value = image[i, j] * sharper[i, j]
            of_line += value * value
            row[i, j] = value
        total += float(of_line)
    norm = math.sqrt(total)
    if not norm > 0.0:
        return norm
    held = np.zeros((rows + 2 * REACH, columns + 2 * REACH), np.float32)
    line = np.empty(columns + 2 * REACH, np.float32)
    share = np.float32(1.0 / norm)
    for i in range(rows):
        for j in range(columns):
            row[i, j] = row[i, j] * sharper[i, j] * share
            held[i + REACH, j + REACH] = row[i, j] * root[i, j]
            covered[i, j] = row[i, j] * white[i, j]
    for part in range(across.shape[0]):
        # written out tap by tap: in loops over them it takes four times as long (128 x 128 pixels)
        a0, a1, a2, a3 = across[part, 0], across[part, 1], across[part, 2], across[part, 3]
        b0, b1, b2, b3 = along[part, 0], along[part, 1], along[part, 2], along[part, 3]
        for i in range(rows):
            for j in range(columns + 2 * REACH):
                near = a0 * held[i + 3, j] + a1 * (held[i + 2, j] + held[i + 4, j])
                far = a2 * (held[i + 1, j] + held[i + 5, j]) + a3 * (held[i, j] + held[i + 6, j])
                line[j] = near + far
            for j in range(columns):
                near = b0 * line[j + 3] + b1 * (line[j + 2] + line[j + 4])
                far = b2 * (line[j + 1] + line[j + 5]) + b3 * (line[j] + line[j + 6])
                covered[i, j] += root[i, j] * (near + far)
    return norm

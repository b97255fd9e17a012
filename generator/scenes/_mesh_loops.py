"""Compiled loop of the path lengths through meshes."""

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True)  # type: ignore[untyped-decorator]
def _side(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> float:
    """Twice the area of the triangle a, b, (x, y); exactly the opposite for b, a."""
    if ax < bx or (ax == bx and ay < by):
        return (bx - ax) * (y - ay) - (by - ay) * (x - ax)
    return -((ax - bx) * (y - by) - (ay - by) * (x - bx))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _left_of(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> bool:
    """Whether a point lies left of a -> b; a point on the edge belongs to one of the two triangles that share it."""
    side = _side(ax, ay, bx, by, x, y)
    if side != 0.0:
        return bool(side > 0.0)
    return bool(by < ay or (by == ay and bx > ax))


@njit(cache=True)  # type: ignore[untyped-decorator]
def add_lengths(corners: Any, source: float, x_mm: Any, y_mm: Any, total: Any, first: Any, last: Any) -> None:
    """Add to total (row, column) the signed distances along rays from (0, 0, -source) at which triangles are met.

    Leaving counts positive and entering negative, so that a closed surface sums to the length inside it. first and last (row, column)
    become the smallest and largest distance, where they were larger and smaller. corners
    (triangle, 3, 3) in mm, seen from outside counter-clockwise; x_mm and y_mm rise in even steps.
    """
    x_step, y_step = x_mm[1] - x_mm[0], y_mm[1] - y_mm[0]
    for number in range(corners.shape[0]):
        px, py = np.empty(3), np.empty(3)
        for k in range(3):
            scale = source / (source + corners[number, k, 2])
            px[k] = corners[number, k, 0] * scale
            py[k] = corners[number, k, 1] * scale
        area = _side(px[0], py[0], px[1], py[1], px[2], py[2])
        if area == 0.0:
            continue
        # normal of the triangle, and its distance from the source along the normal
        ux, uy, uz = corners[number, 1] - corners[number, 0]
        vx, vy, vz = corners[number, 2] - corners[number, 0]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        away = nx * corners[number, 0, 0] + ny * corners[number, 0, 1] + nz * (corners[number, 0, 2] + source)
        second, third = (1, 2) if area > 0 else (2, 1)
        first_column = max(0, math.ceil((px.min() - x_mm[0]) / x_step) - 1)
        last_column = min(x_mm.size - 1, math.floor((px.max() - x_mm[0]) / x_step) + 1)
        first_row = max(0, math.ceil((py.min() - y_mm[0]) / y_step) - 1)
        last_row = min(y_mm.size - 1, math.floor((py.max() - y_mm[0]) / y_step) + 1)
        for row in range(first_row, last_row + 1):
            y = y_mm[row]
            for column in range(first_column, last_column + 1):
                x = x_mm[column]
                if not (
                    _left_of(px[0], py[0], px[second], py[second], x, y)
                    and _left_of(px[second], py[second], px[third], py[third], x, y)
                    and _left_of(px[third], py[third], px[0], py[0], x, y)
                ):
                    continue
                slope = nx * x + ny * y + nz * source
                if slope == 0.0:
                    continue
                distance = away / slope * math.sqrt(x * x + y * y + source * source)
                total[row, column] += distance if slope > 0.0 else -distance
                first[row, column] = min(first[row, column], distance)
                last[row, column] = max(last[row, column], distance)

"""Compiled loops of the two-material solution: bicubic Hermite tables, and Newton's method pixel by pixel."""

from typing import Any

import numpy as np
from numba import njit, prange

_STEPS = 40
_SETTLED = 1e-10


@njit(cache=True, inline="always")  # type: ignore[untyped-decorator]
def _basis(u: float) -> Any:
    """Cubic Hermite basis at u in [0, 1]: values, then derivatives (value left, slope left, value right, slope right)."""
    v = u - 1.0
    return (
        (1.0 + 2.0 * u) * v * v,
        u * v * v,
        u * u * (3.0 - 2.0 * u),
        u * u * v,
        6.0 * u * v,
        v * (3.0 * u - 1.0),
        -6.0 * u * v,
        u * (3.0 * u - 2.0),
    )


@njit(cache=True)  # type: ignore[untyped-decorator]
def _look_up(tables: Any, low: Any, step: Any, first: float, second: float, wanted: int, out: Any) -> None:
    """Value and two slopes (function, 3) of the first `wanted` functions; outside the table they go on in straight lines."""
    nodes_1, nodes_2 = tables.shape[2], tables.shape[3]
    at_1 = min(max((first - low[0]) / step[0], 0.0), nodes_1 - 1.0)
    at_2 = min(max((second - low[1]) / step[1], 0.0), nodes_2 - 1.0)
    i = min(int(at_1), nodes_1 - 2)
    j = min(int(at_2), nodes_2 - 2)
    a0, a1, a2, a3, da0, da1, da2, da3 = _basis(at_1 - i)
    b0, b1, b2, b3, db0, db1, db2, db3 = _basis(at_2 - j)
    s1, s2 = step[0], step[1]
    beyond_1 = first - (low[0] + at_1 * s1)
    beyond_2 = second - (low[1] + at_2 * s2)
    for f in range(wanted):
        value = slope_1 = slope_2 = 0.0
        for side in range(2):
            jj = j + side
            bv, bs = (b0, b1 * s2) if side == 0 else (b2, b3 * s2)
            dv, ds = (db0 / s2, db1) if side == 0 else (db2 / s2, db3)
            # the function and its slope along the second axis, interpolated along the first
            level = (
                a0 * tables[f, 0, i, jj]
                + a1 * s1 * tables[f, 1, i, jj]
                + a2 * tables[f, 0, i + 1, jj]
                + a3 * s1 * tables[f, 1, i + 1, jj]
            )
            lean = (
                a0 * tables[f, 2, i, jj]
                + a1 * s1 * tables[f, 3, i, jj]
                + a2 * tables[f, 2, i + 1, jj]
                + a3 * s1 * tables[f, 3, i + 1, jj]
            )
            level_1 = (
                da0 / s1 * tables[f, 0, i, jj]
                + da1 * tables[f, 1, i, jj]
                + da2 / s1 * tables[f, 0, i + 1, jj]
                + da3 * tables[f, 1, i + 1, jj]
            )
            lean_1 = (
                da0 / s1 * tables[f, 2, i, jj]
                + da1 * tables[f, 3, i, jj]
                + da2 / s1 * tables[f, 2, i + 1, jj]
                + da3 * tables[f, 3, i + 1, jj]
            )
            value += bv * level + bs * lean
            slope_1 += bv * level_1 + bs * lean_1
            slope_2 += dv * level + ds * lean
        out[f, 0] = value + slope_1 * beyond_1 + slope_2 * beyond_2
        out[f, 1] = slope_1
        out[f, 2] = slope_2


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]
def look_up(tables: Any, low: Any, step: Any, thickness: Any, out: Any) -> None:
    """Values and slopes (function, 3, pixel) at thicknesses (2, pixel)."""
    functions = tables.shape[0]
    for p in prange(thickness.shape[1]):
        found = np.empty((functions, 3))
        _look_up(tables, low, step, thickness[0, p], thickness[1, p], functions, found)
        out[:, :, p] = found


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]
def solve(
    tables: Any, low: Any, step: Any, logs: Any, tolerance: float, thickness: Any, out: Any, settled: Any
) -> None:
    """Thicknesses (2, pixel) at which the first two functions equal `logs` (2, pixel), by damped Newton steps.

    Also filled: out (function, 3, pixel), values and slopes there; settled (pixel,), whether both agree to `tolerance`.
    """
    functions = tables.shape[0]
    for p in prange(logs.shape[1]):
        found = np.empty((functions, 3))
        trial = np.empty((functions, 3))
        wanted_1, wanted_2 = logs[0, p], logs[1, p]
        t1 = t2 = 0.0
        _look_up(tables, low, step, t1, t2, 2, found)
        off = max(abs(found[0, 0] - wanted_1), abs(found[1, 0] - wanted_2))
        for _ in range(_STEPS):
            if off < _SETTLED:
                break
            determinant = found[0, 1] * found[1, 2] - found[0, 2] * found[1, 1]
            if determinant == 0.0:
                break
            r1, r2 = wanted_1 - found[0, 0], wanted_2 - found[1, 0]
            d1 = (r1 * found[1, 2] - r2 * found[0, 2]) / determinant
            d2 = (r2 * found[0, 1] - r1 * found[1, 1]) / determinant
            share = 1.0
            better = False
            while share > 1e-4:
                _look_up(tables, low, step, t1 + share * d1, t2 + share * d2, 2, trial)
                new = max(abs(trial[0, 0] - wanted_1), abs(trial[1, 0] - wanted_2))
                if new < off:
                    better = True
                    break
                share *= 0.5
            if not better:
                break
            t1 += share * d1
            t2 += share * d2
            off = new
            found[:2] = trial[:2]
        _look_up(tables, low, step, t1, t2, functions, found)
        thickness[0, p] = t1
        thickness[1, p] = t2
        settled[p] = off < tolerance
        out[:, :, p] = found

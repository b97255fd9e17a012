"""Compiled: responses joined at strengths, and the likelihood of two effects over both strengths."""

from typing import Any

import numpy as np
from numba import njit

_ROUNDS = 7
_NEAR = 8.0  # log likelihood below the highest within which the likelihood lies
_ENOUGH = 6  # strengths of each effect in there


@njit(cache=True)  # type: ignore[untyped-decorator]
def node_weights(nodes: Any, strengths: Any) -> Any:
    """Weights (strength, node) with which responses at nodes > 0 add up: Lagrange through the four nearest of 0 and nodes."""
    count = len(nodes)
    result = np.zeros((len(strengths), count))
    used = min(count + 1, 4)
    for row in range(len(strengths)):
        strength = strengths[row]
        # points are 0 and the nodes: the interval's two and their neighbours; the point 0 adds nothing
        above = np.searchsorted(nodes, strength) + (1 if strength > 0.0 else 0)
        first = min(max(above - used // 2, 0), count + 1 - used)
        for at in range(max(first, 1), first + used):
            point = nodes[at - 1]
            weight = 1.0
            for other in range(first, first + used):
                if other != at:
                    there = 0.0 if other == 0 else nodes[other - 1]
                    weight *= (strength - there) / (point - there)
            result[row, at - 1] = weight
    return result


@njit(cache=True)  # type: ignore[untyped-decorator]
def pair_likelihood(nodes_a: Any, nodes_b: Any, linear: Any, gram: Any, at_a: Any, at_b: Any) -> Any:
    """Log likelihood over none (first, second) at strengths of two effects.

    linear (node,), gram (node, node): of the responses at the first's nodes and then at the second's with the residual, and with
    each other.
    """
    count = len(nodes_a)
    of_a, of_b = node_weights(nodes_a, at_a), node_weights(nodes_b, at_b)
    alone_a, alone_b = (
        _alone(of_a, linear[:count], gram[:count, :count]),
        _alone(of_b, linear[count:], gram[count:, count:]),
    )
    result = np.empty((len(at_a), len(at_b)))
    across = np.empty(len(nodes_b))
    for i in range(len(at_a)):
        for n in range(len(nodes_b)):
            across[n] = 0.0
            for m in range(count):
                across[n] += of_a[i, m] * gram[m, count + n]
        for j in range(len(at_b)):
            both = 0.0
            for n in range(len(nodes_b)):
                both += across[n] * of_b[j, n]
            result[i, j] = alone_a[i] + alone_b[j] - both
    return result


@njit(cache=True)  # type: ignore[untyped-decorator]
def _alone(weights: Any, linear: Any, gram: Any) -> Any:
    """Log likelihood over none of one effect at each of its strengths, by the weights (strength, node) of its nodes."""
    result = np.empty(len(weights))
    for row in range(len(weights)):
        value = 0.0
        for m in range(len(linear)):
            inner = 0.0
            for n in range(len(linear)):
                inner += gram[m, n] * weights[row, n]
            value += weights[row, m] * (linear[m] - 0.5 * inner)
        result[row] = value
    return result


@njit(cache=True)  # type: ignore[untyped-decorator]
def pair_integral(nodes_a: Any, nodes_b: Any, linear: Any, gram: Any, range_a: Any, range_b: Any, points: int) -> Any:
    """Mean likelihood of two effects on a grid of both strengths that closes in on the best.

    Args:
        nodes_a, nodes_b, linear, gram: as in `pair_likelihood`.
        range_a, range_b: lowest and highest logarithm of each strength; their prior is even in it.
        points: of the grid along each strength.

    Returns:
        Log of the mean likelihood, logarithms of the strengths of the first and of the second (points,), and the log likelihood
        there (first, second).
    """
    x_a, x_b = np.linspace(range_a[0], range_a[1], points), np.linspace(range_b[0], range_b[1], points)
    area = (range_a[1] - range_a[0]) * (range_b[1] - range_b[0])
    for _ in range(_ROUNDS):
        grid = pair_likelihood(nodes_a, nodes_b, linear, gram, np.exp(x_a), np.exp(x_b))
        top = grid.max()
        total = 0.0
        for i in range(points - 1):
            for j in range(points - 1):
                corners = 0.0
                for k in range(2):
                    for m in range(2):
                        corners += np.exp(grid[i + k, j + m] - top)
                total += 0.25 * corners * (x_a[i + 1] - x_a[i]) * (x_b[j + 1] - x_b[j])
        value = top + np.log(max(total, 1e-300) / area)
        first_a, last_a, count_a, first_b, last_b, count_b = _where(grid, top - _NEAR)
        done = x_a, x_b
        if count_a >= _ENOUGH and count_b >= _ENOUGH:
            break
        # closes in on where the likelihood lies, one node to each side
        x_a = np.linspace(x_a[max(first_a - 1, 0)], x_a[min(last_a + 1, points - 1)], points)
        x_b = np.linspace(x_b[max(first_b - 1, 0)], x_b[min(last_b + 1, points - 1)], points)
    return value, done[0], done[1], grid


@njit(cache=True)  # type: ignore[untyped-decorator]
def _where(grid: Any, level: float) -> Any:
    """First and last row and how many rows hold values above a level, and the same of columns; all where none does (NaN)."""
    rows, columns = np.zeros(grid.shape[0], np.bool_), np.zeros(grid.shape[1], np.bool_)
    for i in range(grid.shape[0]):
        for j in range(grid.shape[1]):
            if grid[i, j] > level:
                rows[i] = True
                columns[j] = True
    of_rows, of_columns = np.nonzero(rows)[0], np.nonzero(columns)[0]
    if len(of_rows) == 0:
        return 0, len(rows) - 1, len(rows), 0, len(columns) - 1, len(columns)
    return of_rows[0], of_rows[-1], len(of_rows), of_columns[0], of_columns[-1], len(of_columns)

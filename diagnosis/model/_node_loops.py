"""Compiled: responses joined at strengths."""

from typing import Any

import numpy as np
from numba import njit


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

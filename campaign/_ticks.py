"""Ticks of logarithmic axes that read as plain numbers."""

import math
from collections.abc import Sequence

_FEWEST_TICKS = 3


def few_ticks(values: Sequence[float]) -> tuple[dict[float, str], tuple[float, float]]:
    """Ticks (value, text) of a logarithmic axis at 1, 2 and 5, or at more numbers where it spans little, and the axis' ends.

    values: what is drawn on it, one at least.
    """
    lowest, highest = min(values) / 1.25, max(values) * 1.25
    decades = range(math.floor(math.log10(lowest)), math.ceil(math.log10(highest)) + 1)
    inside: list[float] = []
    for steps in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8), (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 3.5, 4, 5, 6, 7, 8, 9)):
        if len(inside) < _FEWEST_TICKS:
            ticks = [step * 10.0**power for power in decades for step in steps]
            inside = [tick for tick in ticks if lowest <= tick <= highest]
    return {tick: f"{tick:g}" for tick in inside}, (lowest, highest)

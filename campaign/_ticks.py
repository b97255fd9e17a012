"""Ticks of logarithmic axes that read as plain numbers."""

import math
from collections.abc import Sequence
from typing import Any

_FEWEST_TICKS = 3


def few_ticks(axis: Any, values: Sequence[float]) -> None:
    """Ticks of a logarithmic axis at 1, 2 and 5, or at more numbers where it spans little, in plain numbers."""
    if not values:
        return
    lowest, highest = min(values) / 1.25, max(values) * 1.25
    decades = range(math.floor(math.log10(lowest)), math.ceil(math.log10(highest)) + 1)
    inside: list[float] = []
    for steps in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8), (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 3.5, 4, 5, 6, 7, 8, 9)):
        if len(inside) < _FEWEST_TICKS:
            ticks = [step * 10.0**power for power in decades for step in steps]
            inside = [tick for tick in ticks if lowest <= tick <= highest]
    axis.set_xticks(inside, [f"{tick:g}" for tick in inside])
    axis.minorticks_off()
    axis.set_xlim(lowest, highest)

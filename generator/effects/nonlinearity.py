"""Nonlinearity: a response that bends.

y = x (1 - s (x / x_half)^p), x_half half of the highest level: s is the departure from a line there, and the response bends
evenly (`order` p = 1), ever more towards the highest levels (above 1) or mostly at the lowest (below).
"""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LineContext, LineState
from .effect import EVERY_SERIES, Effect, Grid, Parameter, Shows


def _bend(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    highest = parameters["highest_signal_DN"]
    if highest <= 0:
        bits = context.twin.instrument.bits or 16
        highest = 2.0**bits - 1.0 - context.twin.dark_DN.value
    order = parameters["order"]
    bend = parameters["strength"] / 100.0 / (0.5 * highest) ** order
    return state if bend == 0.0 else replace(state, bends=(*state.bends, (bend, order)))


NONLINEARITY = Effect(
    id="nonlinearity",
    title="response that bends",
    law=r"y = x\,\left[1 - s\,\left(\frac{x}{x_\mathrm{half}}\right)^p\right]",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.3,
            high=5.0,
            default=1.0,
            source="how far the response lies below its initial line (negative: above) at half of full scale; full scale is "
            "`highest_signal_DN`, the ADC's where that is 0",
            log=False,
            signed=True,
        ),
        Parameter(
            name="order",
            unit="",
            low=0.4,
            high=4.0,
            default=1.0,
            source="1: even bend, the first term of any; 2: a cubic term; 4: saturation close to full scale; 1/2: the first levels",
            log=True,
        ),
        Parameter(
            name="highest_signal_DN",
            unit="DN",
            low=0.0,
            high=2.0**24,
            default=0.0,
            source="highest level above dark that `strength` refers to; 0: full scale of the ADC",
            log=False,
            fitted=False,
        ),
    ),
    stage="response",
    reference="first term of a saturating response; EMVA Standard 1288, release 4.0, linearity error",
    after_calibration=False,
    change=_bend,
    isolated_by="flats at several exposure times and one current",
    shows=Shows(series=EVERY_SERIES, axis="level"),
    either_onset=True,
    absorbed="nothing",
    grid=Grid(shares=(0.8,), variants=({"order": 1.0},)),
)

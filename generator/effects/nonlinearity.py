"""Nonlinearity: a response that bends.

y = x (1 - s x / x_half), x_half half of the highest level: s is the departure from a line there
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
    return replace(state, bend_per_DN=state.bend_per_DN + parameters["strength"] / 100.0 / (0.5 * highest))


NONLINEARITY = Effect(
    id="nonlinearity",
    title="response that bends",
    law=r"y = x\,\left(1 - s\,\frac{x}{x_\mathrm{half}}\right)",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.3,
            high=5.0,
            default=1.0,
            source="departure from the initial line at half of the highest level",
            log=False,
            signed=True,
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
    grid=Grid(shares=(0.8,)),
)

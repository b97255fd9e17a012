"""Excess noise: more quantum noise than calibrated, variance x (1 + e)."""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LineContext, LineState
from ..line.twin import Twin
from ..line.twin_numbers import with_gain
from .effect import LIT_SERIES, Effect, Parameter, Shows


def _add_excess(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    factor = 1.0 + parameters["strength"] / 100.0
    return replace(state, variance_DN2=factor * state.variance_DN2, secondary_DN=factor * state.secondary_DN)


def _in_numbers(twin: Twin, strength: float) -> tuple[Twin, list[str]]:
    return with_gain(twin, 1.0 + strength / 100.0), []


EXCESS_NOISE = Effect(
    id="excess_noise",
    title="more quantum noise than calibrated",
    law=r"\mathrm{Var}_\mathrm{quantum} \to (1 + s)\,\mathrm{Var}_\mathrm{quantum}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=3.0,
            high=100.0,
            default=20.0,
            source="more quantum variance; a Swank factor that falls from 0.95 to 0.5 adds 90 %",
            log=False,
        ),
    ),
    stage="quanta",
    reference="Swank (1973), doi:10.1063/1.1662918",
    after_calibration=True,
    course="random",
    change=_add_excess,
    isolated_by="flats of many frames at several levels",
    shows=Shows(series=LIT_SERIES, axis="position"),
    absorbed="numbers",
    worked_in=_in_numbers,
)

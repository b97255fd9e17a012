"""Tube voltage that differs from the calibrated one: kV (1 + d)."""

import math
from collections.abc import Mapping
from dataclasses import replace

from ...errors import InputError
from ..line.line_state import LineContext, LineState
from ..line.twin import Twin
from ..line.twin_numbers import moved, with_spectrum
from ._spectrum import shifted_parameter
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows

# the spectral model's table of tube voltage errors ends at 6 %; larger ones are counted from a voltage 5 % off
_TABLE_END = 0.055
_REBASED = 0.05


def _shift_kV(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    before = 0.0
    if context.model is not None and state.parameters is not None:
        before = float(state.parameters[context.model.names.index("kV_error")])
    total = (1.0 + before) * (1.0 + parameters["strength"] / 100.0) - 1.0
    factor = 1.0 if abs(total) <= _TABLE_END else 1.0 + math.copysign(_REBASED, total)
    rest = (1.0 + total) / factor - 1.0
    if abs(rest) > _TABLE_END:
        raise InputError(
            "strength of kv_error",
            received=f"{parameters['strength']:g} % on top of a calibrated {100 * before:.2g} %",
            expected="together within 10 % of the tube voltage",
        )
    return replace(
        shifted_parameter(state, context, "kV_error", rest - before, "kv_error"), kV_factor=state.kV_factor * factor
    )


_MODEL_END = 0.06  # of the tube voltage: the spectral model's tables of other voltages end there


def _in_numbers(twin: Twin, strength: float) -> tuple[Twin, list[str]]:
    told: list[str] = []
    after = moved(twin, "kV_error", lambda values: (1.0 + values) * (1.0 + strength / 100.0) - 1.0)
    total = float(after.best[after.names.index("kV_error")])
    if abs(total) > _MODEL_END:
        told.append(
            f"effect kv_error: {100 * total:.2g} % off in all is taken as {math.copysign(100 * _MODEL_END, total):g} %,"
            " where the tables of spectra end"
        )
    return with_spectrum(twin, after), told


KV_ERROR = Effect(
    id="kv_error",
    title="tube voltage differs from the calibrated one",
    law=r"kV \to kV\,(1 + s)",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.5,
            high=5.0,
            default=1.0,
            source="IEC 61223 allows 5-10 % of the voltage",
            log=False,
            signed=True,
        ),
    ),
    stage="beam",
    reference="spectrum model at kV (1 + d)",
    after_calibration=True,
    change=_shift_kV,
    needs=("spectral",),
    isolated_by="flats and two materials of known thickness at several tube voltages",
    shows=Shows(series=LIT_SERIES, axis="energy"),
    absorbed="numbers",
    reading=Reading(law_sd=0.05),  # 34 sealed voltages and filters were off by 2 % rms
    grid=Grid(shares=(0.6, 1.0)),
    worked_in=_in_numbers,
)

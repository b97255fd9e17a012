"""Tube voltage that differs from the calibrated one: kV (1 + d)."""

from collections.abc import Mapping

from ...errors import InputError
from ..line.line_state import LineContext, LineState
from ..line.spectral_signal import LARGEST_KV_ERROR
from ..line.twin import Twin
from ..line.twin_numbers import moved, with_spectrum
from ._spectrum import shifted_parameter
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows


def _shift_kV(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    before = 0.0
    if context.model is not None and state.parameters is not None:
        before = float(state.parameters[context.model.names.index("kV_error")])
    total = _total(before, parameters["strength"])
    return shifted_parameter(state, context, "kV_error", total - before, "kv_error")


def _total(before: float, strength: float) -> float:
    """Relative error of the voltage in all.

    Raises:
        InputError: beyond the tables of spectra.
    """
    total = (1.0 + before) * (1.0 + strength / 100.0) - 1.0
    if abs(total) > LARGEST_KV_ERROR:
        raise InputError(
            "strength of kv_error",
            received=f"{strength:g} % on top of a calibrated {100 * before:.2g} %",
            expected=f"together within {100 * LARGEST_KV_ERROR:g} % of the tube voltage",
        )
    return total


def _in_numbers(twin: Twin, strength: float) -> tuple[Twin, list[str]]:
    after = moved(twin, "kV_error", lambda values: (1.0 + values) * (1.0 + strength / 100.0) - 1.0)
    if twin.spectral is not None:
        _total(float(twin.spectral.best[twin.spectral.names.index("kV_error")]), strength)
    return with_spectrum(twin, after), []


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
            source="relative change of the voltage; IEC 61223 allows 5-10 %",
            log=False,
            signed=True,
        ),
    ),
    stage="beam",
    reference="spectrum model at kV (1 + d)",
    after_calibration=True,
    course="steady",
    change=_shift_kV,
    needs=("spectral",),
    isolated_by="flats and two materials of known thickness at several tube voltages",
    shows=Shows(series=LIT_SERIES, axis="energy"),
    absorbed="numbers",
    # levels go as about kV^3, by an exponent that models of tubes leave open by 0.15 (spectrum.priors of the calibration)
    reading=Reading(law_sd=0.05),
    grid=Grid(shares=(0.6, 1.0)),
    worked_in=_in_numbers,
)

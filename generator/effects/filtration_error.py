"""Filtration that differs from the calibrated one: exp(-mu_Al t)."""

from collections.abc import Mapping

from ..line.line_state import LineContext, LineState
from ..line.twin import Twin
from ..line.twin_numbers import moved, with_spectrum
from ._spectrum import shifted_parameter
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows


def _shift_filtration(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    return shifted_parameter(state, context, "inherent_filtration_mm_Al", parameters["strength"], "filtration_error")


def _in_numbers(twin: Twin, strength: float) -> tuple[Twin, list[str]]:
    after = moved(twin, "inherent_filtration_mm_Al", lambda values: values + strength)
    return with_spectrum(twin, after), []


FILTRATION_ERROR = Effect(
    id="filtration_error",
    title="filtration differs from the calibrated one",
    law=r"N(E) \to N(E)\,e^{-\mu_\mathrm{Al}(E)\,s}",
    parameters=(
        Parameter(
            name="strength",
            unit="mm Al",
            low=0.03,
            high=1.0,
            default=0.2,
            source="aluminium that the beam crosses more than calibrated; a roughened anode, an exchanged window, a forgotten sheet",
            log=False,
        ),
    ),
    stage="beam",
    reference="Beer-Lambert with aluminium",
    after_calibration=True,
    course="steady",
    change=_shift_filtration,
    needs=("spectral",),
    isolated_by="flats at two tube voltages with and without a known filter",
    shows=Shows(series=LIT_SERIES, axis="energy"),
    absorbed="numbers",
    # tables of attenuation are known to 1 to 5 % (Hubbell 1999, Phys Med Biol 44:R1)
    reading=Reading(law_sd=0.05),
    grid=Grid(shares=(0.6, 1.0)),
    worked_in=_in_numbers,
)

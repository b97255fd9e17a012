"""A counter's energy threshold that differs from the calibrated one: T + s.

Below a threshold of 0 a counter counts all charge. Photon counters only.
"""

from collections.abc import Mapping

from ...acquisition.instrument import HIGHEST_THRESHOLD_KEV, Instrument
from ...errors import InputError
from ..line.line_state import LineContext, LineState
from ..line.spectral_signal import THRESHOLD
from ..line.twin import SpectralPosterior, Twin
from ..line.twin_numbers import moved, with_spectrum
from ._spectrum import shifted_parameter
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows


def _shift_threshold(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    spectral = context.twin.spectral
    _refuse_others(context.twin.instrument, spectral)
    before = 0.0
    if spectral is not None and context.model is not None and state.parameters is not None:
        before = float(state.parameters[context.model.names.index(THRESHOLD)])
    return shifted_parameter(
        state, context, THRESHOLD, _total(before, parameters["strength"]) - before, "threshold_error"
    )


def _refuse_others(instrument: Instrument, spectral: SpectralPosterior | None) -> None:
    """Raise where the detector is no counter, or was calibrated as none.

    Raises:
        InputError: what the twin is instead.
    """
    if not instrument.counting:
        raise InputError(
            "instrument counting",
            received="nothing" if instrument.counting is None else "false",
            expected="true, because only counters have a threshold",
            remedy="state it in the acquisition's instrument",
        )
    if spectral is not None and THRESHOLD not in spectral.names:
        raise InputError(
            "effect threshold_error",
            received="a twin whose spectrum has no threshold",
            expected="a twin that was calibrated as a counter",
            remedy="calibrate it again, with counting = true in the acquisition's instrument",
        )


def _total(before_keV: float, strength: float) -> float:
    """The threshold now, keV.

    Raises:
        InputError: beyond the tables.
    """
    total = max(before_keV + strength, 0.0)
    if total > HIGHEST_THRESHOLD_KEV:
        raise InputError(
            "strength of threshold_error",
            received=f"{strength:g} keV on top of a calibrated {before_keV:.3g} keV",
            expected=f"together at most {HIGHEST_THRESHOLD_KEV:g} keV",
        )
    return total


def _in_numbers(twin: Twin, strength: float) -> tuple[Twin, list[str]]:
    _refuse_others(twin.instrument, twin.spectral)
    if twin.spectral is not None:
        _total(float(twin.spectral.best[twin.spectral.names.index(THRESHOLD)]), strength)
    after = moved(twin, THRESHOLD, lambda values: (values + strength).clip(0.0, HIGHEST_THRESHOLD_KEV))
    return with_spectrum(twin, after), []


THRESHOLD_ERROR = Effect(
    id="threshold_error",
    title="the counter's threshold differs from the calibrated one",
    law=r"T \to T + s",
    parameters=(
        Parameter(
            name="strength",
            unit="keV",
            low=0.2,
            high=8.0,
            default=2.0,
            source="pixels are trimmed to some 0.2 keV (Kraft et al. 2009, IEEE Trans Nucl Sci 56:758); temperature and"
            " polarisation of CdTe move them by a few keV",
            log=False,
            signed=True,
        ),
    ),
    stage="beam",
    reference="counts of the charge above T: Schlomka et al. 2008, Phys Med Biol 53:4031; drift in CdTe: Astromskas et al. 2016, IEEE"
    " Trans Nucl Sci 63:252",
    after_calibration=True,
    course="steady",
    change=_shift_threshold,
    needs=("counting", "spectral"),
    isolated_by="flats at the same beam and several thresholds about the working one, or a threshold scan over a fluorescence line",
    shows=Shows(series=LIT_SERIES, axis="energy"),
    absorbed="numbers",
    reading=Reading(),
    grid=Grid(shares=(0.3, 0.6, 1.0)),
    worked_in=_in_numbers,
)

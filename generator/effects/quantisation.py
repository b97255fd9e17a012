"""Quantisation: an ADC with lost bits, a step in place of 1 DN."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line.line_state import LineContext, LineState
from ..line.rounding import variance_before_rounding
from .effect import EVERY_SERIES, Effect, Parameter, Reading, Shows, Variation


def _lose_bits(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    step = max(state.step_DN, parameters["strength"])
    taken = 0.0
    if context.since == "always" and step > 0.0:
        # the calibrated variance is that of rounded numbers
        twin = context.twin
        good = twin.maps.bad_pixels == 0
        calibrated = float(np.mean(np.asarray(twin.maps.read_variance_DN2, dtype=np.float64)[good]))
        finest = 1.0 / 12.0 if twin.noise.quantised else 0.0
        taken = max(calibrated - finest - float(variance_before_rounding(calibrated, step)), 0.0)
    return replace(state, step_DN=step, read_variance_taken_DN2=state.read_variance_taken_DN2 + taken)


QUANTISATION = Effect(
    id="quantisation",
    title="ADC with lost bits",
    law=r"y \to s\,\lfloor y / s \rceil",
    parameters=(
        Parameter(
            name="strength",
            unit="DN",
            low=2.0,
            high=64.0,
            default=4.0,
            source="step between codes; 1-6 bits lost",
            log=True,
        ),
    ),
    stage="readout",
    reference="uniform quantiser: Widrow (1956), doi:10.1109/TCT.1956.1086334",
    after_calibration=False,
    change=_lose_bits,
    isolated_by="darks and flats at finely spaced levels",
    shows=Shows(series=EVERY_SERIES, axis="position"),
    either_onset=True,
    absorbed="noise",
    reading=Reading(probes=("codes",), sd=0.06),
    variation=Variation(random="offset"),
    lost_by_binning="codes are lost where frames are averaged",
)

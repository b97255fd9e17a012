"""Readout: noise common to a row or column, an ADC with lost bits, bad pixels that calibration has not seen.

row noise      + r_i to each row (column) of a frame; the read noise of a calibration that saw it holds both
quantisation   step in place of 1 DN
bad pixels     dead, hot, in clusters and in lines
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line_state import LineContext, LineState
from ..rounding import variance_before_rounding
from .effect import Effect, Parameter


def _add_row_noise(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    ratio = parameters["strength"] ** 2
    variance = ratio * context.twin.noise.read_noise_DN.value**2
    if context.since == "always":
        variance /= 1.0 + ratio  # calibrated^2 = white^2 (1 + strength^2)
    columns = parameters["column_share"]
    return replace(
        state,
        read_variance_taken_DN2=state.read_variance_taken_DN2 + (variance if context.since == "always" else 0.0),
        row_variance_DN2=state.row_variance_DN2 + (1.0 - columns) * variance,
        column_variance_DN2=state.column_variance_DN2 + columns * variance,
    )


ROW_NOISE = Effect(
    id="row_noise",
    title="noise common to rows or columns",
    parameters=(
        Parameter(
            name="strength",
            unit="read-noise sigmas",
            low=0.05,
            high=2.0,
            default=0.3,
            source="rms of the line's offset over the white read noise",
            log=True,
        ),
        Parameter(
            name="column_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="share of the variance in columns; 0: rows only",
            log=False,
        ),
    ),
    stage="electronics",
    reference="correlated line noise of flat panels and CMOS; EMVA Standard 1288, release 4.0",
    after_calibration=False,
    change=_add_row_noise,
)


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
    parameters=(
        Parameter(
            name="strength",
            unit="DN",
            low=2.0,
            high=64.0,
            default=4.0,
            source="step; 1-6 bits lost",
            log=True,
        ),
    ),
    stage="readout",
    reference="uniform quantiser: Widrow (1956), doi:10.1109/TCT.1956.1086334",
    after_calibration=False,
    change=_lose_bits,
)


def _spoil_pixels(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    # those that calibration saw are in its map
    if parameters["strength"] == 0 or context.since == "always":
        return state
    return replace(
        state,
        bad_share=parameters["strength"] / 100.0,
        bad_hot_share=parameters["hot_share"],
        bad_seed=int(parameters["pattern_seed"]),
    )


BAD_PIXELS = Effect(
    id="bad_pixels",
    title="new bad pixels",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.02,
            high=2.0,
            default=0.2,
            source="share of the pixels; acceptance limits of flat panels are 0.1-1 %",
            log=True,
        ),
        Parameter(
            name="hot_share",
            unit="",
            low=0.1,
            high=0.9,
            default=0.5,
            source="of them, pixels that show without beam; the rest are dead",
            log=False,
        ),
        Parameter(
            name="pattern_seed",
            unit="",
            low=0.0,
            high=2.0**31,
            default=0.0,
            source="draws where they are",
            log=False,
            fitted=False,
        ),
    ),
    stage="readout",
    reference="defect classes of ASTM E2597",
    after_calibration=True,
    change=_spoil_pixels,
)

"""Lines that flicker with the light: a factor common to a row of one exposure, as a rolling readout makes of a beam that ripples.

x (1 + e_i), e_i of standard deviation s, new in each exposure, with correlation exp(-|i - j| / L) between lines; columns alike
(gains of column amplifiers). In the dark there is nothing: noise of rows that is there without light is `row_noise`.
"""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LineContext, LineFlicker, LineState
from .effect import LIT_SERIES, Effect, Grid, Parameter, Shows, Variation


def _flicker(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    return replace(
        state,
        flicker=LineFlicker(
            rms=parameters["strength"] / 100.0,
            column_share=parameters["column_share"],
            together_lines=parameters["together_lines"],
        ),
    )


LINE_FLICKER = Effect(
    id="line_flicker",
    title="lines flicker with the light",
    law=r"x_{ij} \to x_{ij}\,(1 + e_i),\quad \mathrm{sd}(e) = s,\quad \mathrm{corr}(e_i, e_j) = e^{-|i - j|/L}"
    r"\ \text{(new in each frame)}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.03,
            high=1.0,
            default=0.2,
            source="rms of a line's factor; ripple of 0.1-1 % of medium-frequency generators under a rolling shutter",
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
        Parameter(
            name="together_lines",
            unit="lines",
            low=0.3,
            high=30.0,
            default=3.0,
            source="bands: ripple of 1-100 kHz read at 10-100 us a line passes in a few lines",
            log=True,
            pixel_power=1.0,
        ),
    ),
    stage="exposure",
    reference="rolling shutter under modulated light: Liang, Chang, Chen (2008), doi:10.1109/TIP.2008.925384",
    after_calibration=False,
    course="random",
    change=_flicker,
    isolated_by="flats and darks of many frames: lines that darks do not show",
    shows=Shows(series=LIT_SERIES, axis="position"),
    either_onset=True,
    absorbed="nothing",
    grid=Grid(
        variants=(
            {"column_share": 0.0, "together_lines": 0.5},
            {"column_share": 0.0, "together_lines": 6.0},
            {"column_share": 1.0, "together_lines": 0.5},
        )
    ),
    variation=Variation(random="lines of light"),
)

"""Noise common to a row or column of a frame.

+ r_i to each row (column), with correlation exp(-|i - j| / L) between lines; the read noise of a calibration that saw it holds both
"""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import EACH_LINE, LineContext, LineState
from .effect import EVERY_SERIES, Effect, Grid, Parameter, Shows, Variation


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
        offsets_together_lines=parameters["together_lines"],
    )


ROW_NOISE = Effect(
    id="row_noise",
    title="noise common to rows or columns",
    law=r"y_{ij} \to y_{ij} + r_i,\quad \mathrm{sd}(r) = s\,\sigma_\mathrm{read}\ \text{(new in each frame; columns alike)}"
    r",\quad \mathrm{corr}(r_i, r_j) = e^{-|i - j|/L}",
    parameters=(
        Parameter(
            name="strength",
            unit="read-noise sigmas",
            low=0.05,
            high=2.0,
            default=0.3,
            source="rms of the line's offset over the white read noise",
            log=True,
            pixel_power=-0.5,  # the read noise falls with the side of the square, the line's with its root
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
            low=EACH_LINE,
            high=10.0,
            default=EACH_LINE,
            source="lines of their own, or bands: an offset of 10-100 kHz read at 10-100 us a line",
            log=True,
            pixel_power=1.0,
        ),
    ),
    stage="electronics",
    reference="correlated line noise of flat panels and CMOS; EMVA Standard 1288, release 4.0",
    after_calibration=False,
    course="random",
    change=_add_row_noise,
    isolated_by="darks",
    shows=Shows(series=EVERY_SERIES, axis="position"),
    either_onset=True,
    absorbed="noise",
    grid=Grid(
        variants=(
            {"column_share": 0.0, "together_lines": EACH_LINE},
            {"column_share": 0.0, "together_lines": 2.0},
            {"column_share": 1.0, "together_lines": EACH_LINE},
        )
    ),
    variation=Variation(random="lines"),
)

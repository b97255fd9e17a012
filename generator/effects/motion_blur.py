"""Motion during the exposure: it blurs what stands in the beam and leaves the noise alone.

Box of length v t M along the belt.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line.line_state import FloatArray, LineContext, LineState
from .effect import Effect, Grid, Parameter, Shows

STATED_MS = 50.0  # the strength is the path in this time


def _blur_by_motion(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    request = context.request
    if not context.has_scene or parameters["strength"] == 0 or request.belt_speed_mm_s == 0:
        return state
    usual = context.twin.instrument.magnification
    length_px = parameters["strength"] * request.exposure_ms / STATED_MS
    if usual is not None and context.source_detector_mm is not None and context.source_object_mm is not None:
        length_px *= context.source_detector_mm / context.source_object_mm / usual
    along_rows = request.belt_axis != "column"

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        return np.asarray(np.sinc(length_px * (f_row if along_rows else f_column)))

    return replace(state, object_transfers=(*state.object_transfers, transfer))


MOTION_BLUR = Effect(
    id="motion_blur",
    title="object moves during the exposure",
    law=r"H(f) = \mathrm{sinc}\!\left(\ell f\right),\quad \ell = s\,\frac{t}{50\ \mathrm{ms}}\,\frac{M}{M_\mathrm{usual}}",
    parameters=(
        Parameter(
            name="strength",
            unit="px",
            low=0.5,
            high=10.0,
            default=2.0,
            source="path on the detector in 50 ms at the line's usual magnification, along the belt",
            log=True,
            pixel_power=1.0,
        ),
    ),
    stage="object_blur",
    reference="uniform motion through the exposure: box of v t M; belts of 10-500 mm/s",
    after_calibration=False,
    change=_blur_by_motion,
    needs=("scene",),
    isolated_by="an edge at several exposure times of equal charge",
    shows=Shows(series=("object",), axis="sharpness", flats=False),
    in_some_series=True,
    absorbed="nothing",
    timed=True,
    grid=Grid(shares=(0.0, 0.25, 0.5, 0.75, 1.0)),
    # as of a tail: two panels without effect, in squares of pixels, showed 6
)

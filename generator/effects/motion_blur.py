"""Motion during the exposure: it blurs what stands in the beam and leaves the noise alone.

Box of length l = v t M along the belt; of an object that grows faster or slower by a share a of its mean speed, the places
l [u + a (u^2 - u)], u even from 0 to 1, about their mean.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState
from .effect import Effect, Grid, Parameter, Shows

STATED_MS = 50.0  # the strength is the path in this time
_STEPS_A_PX = 4.0  # of a path at uneven speed; each is a box of its own


def _blur_by_motion(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    request = context.request
    if not context.has_scene or parameters["strength"] == 0 or request.belt_speed_mm_s == 0:
        return state
    usual = context.twin.instrument.magnification
    length_px = parameters["strength"] * request.exposure_ms / STATED_MS
    if usual is not None and context.source_detector_mm is not None and context.source_object_mm is not None:
        length_px *= context.source_detector_mm / context.source_object_mm / usual
    along_rows = request.belt_axis != "column"
    uneven = parameters["acceleration"]
    if abs(uneven) > 1.0:
        raise InputError(
            "acceleration of motion_blur", received=uneven, expected="-1 to 1: the object does not turn back"
        )
    steps = 1 if uneven == 0.0 else max(math.ceil(_STEPS_A_PX * abs(length_px)), 2)

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        return np.asarray(np.sinc(length_px / steps * (f_row if along_rows else f_column)))

    state = replace(state, object_transfers=(*state.object_transfers, transfer))
    if uneven == 0.0:
        return state
    time = (np.arange(steps) + 0.5) / steps
    places_px = length_px * (time + uneven * (time**2 - time))
    course_px = tuple(float(place) for place in places_px - places_px.mean())
    return replace(state, course_px=(course_px, ()) if along_rows else ((), course_px))


MOTION_BLUR = Effect(
    id="motion_blur",
    title="object moves during the exposure",
    law=(
        r"H(f) = \int_0^1 e^{-2\pi i f \ell\,[u + a\,(u^2 - u)]}\,\mathrm{d}u,\quad "
        r"\ell = s\,\frac{t}{50\ \mathrm{ms}}\,\frac{M}{M_\mathrm{usual}},\quad H(f) = \mathrm{sinc}(\ell f)\ \text{at}\ a = 0"
    ),
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
        Parameter(
            name="acceleration",
            unit="",
            low=-1.0,
            high=1.0,
            default=0.0,
            source="speed at the end of an exposure over the mean one, less 1: from a start to a stop",
            log=False,
        ),
    ),
    stage="object_blur",
    reference="motion through the exposure: box of v t M, of uneven speed; belts of 10-500 mm/s",
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

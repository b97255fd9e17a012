"""Motion during the exposure: it blurs what stands in the beam and correlates no noise.

Box of length l = v t M along the belt; of an object that grows faster or slower by a share a of its mean speed, the places
l [u + a (u^2 - u)], u even from 0 to 1, about their mean. A vibration that is faster than the exposures goes as far in a short one
as in a long one: l = v t_0 (t / t_0)^p M, p from 1, a steady speed, to 0. The mean of the places lies l m from where the object is
stated to be: exposures that start as it passes there have it half a path further on, the longer ones farther.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState
from ..line.series_request import SeriesRequest
from ..line.twin import Twin
from .effect import Effect, Grid, Parameter, Shows

STATED_MS = 50.0  # the strength is the path in this time
_STEPS_A_PX = 4.0  # of a path at uneven speed; each is a box of its own


def _path_px(parameters: Mapping[str, float], request: SeriesRequest, twin: Twin) -> float:
    """Length of the path on the detector, px."""
    length_px: float = parameters["strength"] * (request.exposure_ms / STATED_MS) ** parameters["exposure_power"]
    usual, (to_object_mm, to_detector_mm) = twin.instrument.magnification, request.distances_mm(twin.instrument)
    if usual is None or to_object_mm is None or to_detector_mm is None:
        return length_px
    return length_px * to_detector_mm / to_object_mm / usual


def _mean_shift(parameters: Mapping[str, float], request: SeriesRequest, twin: Twin) -> tuple[float, float]:
    """How far the middle of the picture lies from where the object is stated to be, px along rows and columns."""
    if request.belt_speed_mm_s == 0:
        return 0.0, 0.0
    away_px = parameters["mean_place"] * _path_px(parameters, request, twin)
    return (0.0, away_px) if request.belt_axis == "column" else (away_px, 0.0)


def _blur_by_motion(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    request = context.request
    if not context.has_scene or parameters["strength"] == 0 or request.belt_speed_mm_s == 0:
        return state
    length_px = _path_px(parameters, request, context.twin)
    along_rows = request.belt_axis != "column"
    uneven = parameters["acceleration"]
    if abs(uneven) > 1.0:
        raise InputError(
            "acceleration of motion_blur", received=uneven, expected="-1 to 1: the object does not turn back"
        )
    steps = 1 if uneven == 0.0 else max(math.ceil(_STEPS_A_PX * abs(length_px)), 2)

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        return np.asarray(np.sinc(length_px / steps * (f_row if along_rows else f_column)))

    moved = zip(state.shift_px, _mean_shift(parameters, request, context.twin), strict=True)
    down_px, right_px = (lies + further for lies, further in moved)
    state = replace(state, object_transfers=(*state.object_transfers, transfer), shift_px=(down_px, right_px))
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
        r"\ell = s\left(\frac{t}{50\ \mathrm{ms}}\right)^p\frac{M}{M_\mathrm{usual}},\quad "
        r"H(f) = \mathrm{sinc}(\ell f)\ \text{at}\ a = 0"
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
        Parameter(
            name="exposure_power",
            unit="",
            low=0.0,
            high=1.0,
            default=1.0,
            source="of the path's growth with exposure: 1 at a steady speed, 0 of a vibration that is faster than the exposures",
            log=False,
        ),
        Parameter(
            name="mean_place",
            unit="",
            low=-0.5,
            high=0.5,
            default=0.0,
            source="of the picture's middle, in paths; 0: exposures are centred where the object is stated to be; 1/2: start there",
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
    mean_shift=_mean_shift,
    grid=Grid(
        shares=(0.0, 0.25, 0.5, 0.75, 1.0),
        variants=({"acceleration": -0.5}, {"acceleration": 0.5}, {"exposure_power": 0.0}),
    ),
    # as of a tail: two panels without effect, in squares of pixels, showed 6
)

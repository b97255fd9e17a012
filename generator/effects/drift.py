"""What changes with time: the dark level, and the output of the tube.

dark drift    + s (t_exposure / t_longest) (g(time) - g(time of calibration)),
              g = (1 - exp(-time / (w T))) / (1 - exp(-1 / w)), T the session's length
output drift  x (1 + e_n), e_n of standard deviation s, a share j of its variance new in every exposure, the rest with
              correlation exp(-|dt| / tau); the same for all pixels
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line_state import FloatArray, LineContext, LineState
from .effect import Effect, Parameter


def _drift_dark(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    session_s, warm_up = parameters["session_s"], parameters["warm_up"]
    calibrated = math.expm1(-parameters["calibrated_s"] / (warm_up * session_s))
    height = parameters["strength"] * context.request.exposure_ms / parameters["longest_exposure_ms"]

    def profile(time_s: FloatArray) -> FloatArray:
        moved = np.expm1(-time_s / (warm_up * session_s)) - calibrated
        return np.asarray(moved / math.expm1(-1.0 / warm_up))

    return replace(state, offsets=(*state.offsets, (height, profile)))


DARK_DRIFT = Effect(
    id="dark_drift",
    title="dark level drifts",
    parameters=(
        Parameter(
            name="strength",
            unit="DN",
            low=1.0,
            high=100.0,
            default=10.0,
            source="change over the session at the longest exposure; dark current doubles every 7-10 K",
            log=False,
            signed=True,
        ),
        Parameter(
            name="warm_up",
            unit="",
            low=0.1,
            high=10.0,
            default=1.0,
            source="time constant over the session's length: small settles early, large is a straight line",
            log=True,
        ),
        Parameter(
            name="session_s",
            unit="s",
            low=1.0,
            high=1e6,
            default=600.0,
            source="length of the session that `strength` refers to",
            log=True,
            fitted=False,
        ),
        Parameter(
            name="calibrated_s",
            unit="s",
            low=0.0,
            high=1e6,
            default=0.0,
            source="time in the session at which the twin's darks were taken: what had drifted by then is in them",
            log=False,
            fitted=False,
        ),
        Parameter(
            name="longest_exposure_ms",
            unit="ms",
            low=0.01,
            high=1e6,
            default=1000.0,
            source="exposure that `strength` refers to",
            log=True,
            fitted=False,
        ),
    ),
    stage="electronics",
    reference="thermal relaxation to a new temperature; dark current proportional to exposure time",
    after_calibration=False,
    change=_drift_dark,
)


def _drift_output(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    return replace(
        state,
        output_rms=parameters["strength"] / 100.0,
        output_correlation_s=parameters["correlation_s"],
        output_jitter_share=parameters["jitter_share"],
    )


OUTPUT_DRIFT = Effect(
    id="output_drift",
    title="tube output wanders from frame to frame",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.1,
            high=3.0,
            default=0.5,
            source="rms of the common factor of a frame; generators of 0.05-1 % ripple and drift",
            log=True,
        ),
        Parameter(
            name="correlation_s",
            unit="s",
            low=0.01,
            high=600.0,
            default=0.5,
            source="from frame to frame (short) to a trend over the session (long)",
            log=True,
        ),
        Parameter(
            name="jitter_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="share of the variance that is new in every exposure: ripple beside what wanders",
            log=False,
        ),
    ),
    stage="exposure",
    reference="AR(1) process and white noise sampled at the frames",
    after_calibration=False,
    change=_drift_output,
)

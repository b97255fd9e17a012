"""Dark level that drifts as the line warms up.

+ s (t_exposure / t_longest) (g(time) - g(time of calibration)),
g = (1 - exp(-time / (w T))) / (1 - exp(-1 / w)), T the session's length
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line.line_state import FloatArray, LineContext, LineState
from .effect import EVERY_SERIES, Effect, Grid, InImages, Parameter, Reading, Shows, Variation


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
    law=(
        r"D \to D + s\,\frac{t}{t_\mathrm{longest}}\,[g(\tau) - g(\tau_\mathrm{calibration})],\quad "
        r"g(\tau) = \frac{1 - e^{-\tau/(w\,T_\mathrm{session})}}{1 - e^{-1/w}}"
    ),
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
    isolated_by="darks in between, at the longest exposure time",
    shows=Shows(series=EVERY_SERIES, axis="level", flats=False),
    either_onset=True,
    absorbed="nothing",
    grid=Grid(shares=(0.8,)),
    variation=Variation(random="places"),
    reading=Reading(sd=0.0, last_dark=True),
    images=InImages(left_out="it depends on the time in a session"),
)

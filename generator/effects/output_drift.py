"""Tube output that wanders, the same for all pixels of a frame.

x (1 + e_n), e_n of standard deviation s, a share j of its variance new in every exposure, the rest with
correlation exp(-|dt| / tau)
"""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LineContext, LineState
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows, Variation


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
    law=r"x_n \to x_n\,(1 + e_n),\quad \mathrm{sd}(e) = s,\quad \mathrm{corr}(e_n, e_m) = (1 - j)\,e^{-|\tau_n - \tau_m|/\tau_c}",
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
        Parameter(
            name="idle_s",
            unit="s",
            low=0.1,
            high=1e5,
            default=1.0,
            source="pause before each series of a session that states no times: none to speak of, or an hour",
            log=True,
            fitted=False,
            tried_without_times=(1.0, 3600.0),
        ),
    ),
    stage="exposure",
    reference="AR(1) process and white noise sampled at the frames",
    after_calibration=False,
    change=_drift_output,
    isolated_by="frames with an open field beside the object",
    shows=Shows(series=LIT_SERIES, axis="position"),
    either_onset=True,
    absorbed="nothing",
    reading=Reading(sd=0.12, frame_levels=True),  # levels that calibration has taken in by beam
    # what it does by chance hangs on its inner parameters: they stay those of the grid
    grid=Grid(
        variants=(
            *({"correlation_s": 10.0, "jitter_share": share} for share in (0.06, 0.15, 0.35, 1.0)),
            # trends over the session, quiet within a series
            {"correlation_s": 77.0, "jitter_share": 0.0},
            {"correlation_s": 600.0, "jitter_share": 0.0},
        ),
        refined=False,
    ),
    variation=Variation(random="output"),
)

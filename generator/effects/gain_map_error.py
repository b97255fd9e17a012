"""Gain map error: a per-pixel gain that calibration does not know.

y = x (1 + eta), eta fixed from frame to frame, of pixel to pixel, alike over some pixels, or one for each column
"""

from collections.abc import Mapping
from dataclasses import replace

from ...errors import InputError
from ..line.line_state import FixedPattern, LineContext, LineState
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows, Variation, seed_of


def _change_gain(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    # a pattern that calibration saw is in its maps
    if parameters["strength"] == 0 or context.since == "always":
        return state
    if parameters["correlation_px"] < 0.0:
        raise InputError(
            "correlation_px of gain_map_error", received=parameters["correlation_px"], expected="0 px or more"
        )
    return replace(
        state,
        gain_pattern=FixedPattern(
            rms=parameters["strength"] / 100.0,
            seed=int(parameters["pattern_seed"]),
            correlation_px=parameters["correlation_px"],
            of_columns=parameters["of_columns"] > 0.5,
        ),
    )


GAIN_MAP_ERROR = Effect(
    id="gain_map_error",
    title="per-pixel gain has changed",
    law=r"y_{ij} = x_{ij}\,(1 + \eta_{ij}),\quad \mathrm{sd}(\eta) = s,\quad \mathrm{corr}(\eta) = e^{-d^2/(2\ell^2)}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.1,
            high=3.0,
            default=0.5,
            source="standard deviation over the pixels; flat panels between two gain calibrations",
            log=True,
            pixel_power=1.0,  # of a pattern from pixel to pixel
        ),
        Parameter(
            name="correlation_px",
            unit="px",
            low=0.0,
            high=16.0,
            default=0.0,
            source="pixels so far apart are alike by exp(-1/2); 0: each has its own. Screens and deposits are alike over some pixels",
            log=False,
            fitted=False,
            pixel_power=1.0,
        ),
        Parameter(
            name="of_columns",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="1: whole columns change, as their amplifiers do",
            log=False,
            fitted=False,
        ),
        seed_of("the pattern"),
    ),
    stage="response",
    reference="fixed-pattern noise (PRNU), EMVA Standard 1288, release 4.0",
    after_calibration=True,
    course="steady",
    pattern=True,
    change=_change_gain,
    isolated_by="flats repeated, and behind a filter",
    shows=Shows(series=LIT_SERIES, axis="position", flats=False),
    absorbed="maps",
    # a smooth effect beside it may take a tenth of the variance for its own
    reading=Reading(probes=("fixed_pattern",), sd=0.05, map_rms=True),
    # what it does by chance hangs on how far pixels are alike: that stays as in the grid
    grid=Grid(
        variants=(*({"correlation_px": length} for length in (0.0, 1.5, 5.0)), {"of_columns": 1.0}), refined=False
    ),
    variation=Variation(random="pixels"),
)

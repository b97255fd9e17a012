"""Bad pixels that calibration has not seen: dead, hot, in clusters and in lines."""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LineContext, LineState
from .effect import EVERY_SERIES, Effect, Parameter, Reading, Shows, seed_of


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
    law=r"\text{a share } s \text{ of the pixels is dead or hot}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.02,
            high=2.0,
            default=0.2,
            source="share of the pixels; acceptance limits of flat panels are 0.1-1 %",
            log=True,
            pixel_power=-2.0,  # a bad pixel spoils its square
            most=100.0,
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
        seed_of("where they are"),
    ),
    stage="readout",
    reference="defect classes of ASTM E2597",
    after_calibration=True,
    change=_spoil_pixels,
    isolated_by="darks and flats",
    shows=Shows(series=EVERY_SERIES, axis="position", flats=False),
    absorbed="maps",
    reading=Reading(probes=("outliers in any series",)),
)

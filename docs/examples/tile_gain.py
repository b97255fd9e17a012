"""Gains of detector tiles or readout channels that calibration does not know: blocks with a step at their seams.

y = x (1 + eta_tile), eta fixed from frame to frame; a share of its variance belongs to strips over whole columns

For panels that are made of tiles. It is not in raytwin's own catalogue: beside a strong change of the gain map from pixel to pixel
with a smooth part, tiles would be named that are not there.
"""

from collections.abc import Mapping
from dataclasses import replace

from raytwin.generator.effects import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows, Variation
from raytwin.generator.line.line_state import LineContext, LineState, TilePattern


def _change_tiles(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    # gains that calibration saw are in its maps
    if parameters["strength"] == 0 or context.since == "always":
        return state
    pattern = TilePattern(
        rms=parameters["strength"] / 100.0,
        side_px=parameters["side_px"],
        strips_share=parameters["strips_share"],
        seed=int(parameters["pattern_seed"]),
    )
    return replace(state, tile_pattern=pattern)


TILE_GAIN = Effect(
    id="tile_gain",
    title="gains of tiles or readout channels have changed",
    law=r"y_{ij} = x_{ij}\,(1 + \eta_{t(i,j)}),\quad \mathrm{sd}(\eta) = s\ \text{(one }\eta\text{ a tile, or a strip of columns)}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.2,
            high=3.0,
            default=0.5,
            source="standard deviation over the tiles; amplifiers and bias between two gain calibrations",
            log=True,
        ),
        Parameter(
            name="side_px",
            unit="px",
            low=16.0,
            high=256.0,
            default=32.0,
            source="side of a tile, columns of a readout chip: photon counters and CMOS tiles of 55 to 256, flat panels of 64 to 256",
            log=True,
            pixel_power=1.0,
        ),
        Parameter(
            name="strips_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="share of the variance in strips over whole columns (readout channels); 0: square tiles only",
            log=False,
        ),
        Parameter(
            name="pattern_seed",
            unit="",
            low=0.0,
            high=2.0**31,
            default=0.0,
            source="draws the gains",
            log=False,
            fitted=False,
        ),
    ),
    stage="response",
    reference="gains of readout chips beside each other: spatial nonuniformity, EMVA Standard 1288, release 4.0",
    after_calibration=True,
    course="steady",
    change=_change_tiles,
    isolated_by="flats repeated, and behind a filter: steps that stay at the seams",
    shows=Shows(series=LIT_SERIES, axis="position", flats=False),
    absorbed="maps",
    reading=Reading(law_sd=0.25),  # the rms of some nine gains, 1 / sqrt(2 n), is no better known by its own
    # what it does by chance hangs on where the seams are: they stay those of the grid
    grid=Grid(
        variants=tuple({"side_px": side, "strips_share": share} for side in (32.0, 64.0) for share in (0.0, 1.0)),
        refined=False,
    ),
    variation=Variation(random="tiles"),
)

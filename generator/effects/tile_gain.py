"""Gains of detector tiles or readout channels that calibration does not know: steps at the seams.

y = x (1 + eta_tile), eta fixed from frame to frame; channels are tiles over whole columns
"""

from collections.abc import Mapping
from dataclasses import replace

from ...errors import InputError
from ..line.line_state import LineContext, LineState, TilePattern
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows, Variation, seed_of


def _change_tiles(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    # gains that calibration saw are in its maps
    if parameters["strength"] == 0 or context.since == "always":
        return state
    for name in ("rows_px", "columns_px"):
        if 0.0 != parameters[name] < 1.0:
            raise InputError(
                f"{name} of tile_gain",
                received=parameters[name],
                expected="1 px or more, or 0 of tiles as long as the panel",
            )
    return replace(state, tile_pattern=TilePattern.of(parameters, rms=parameters["strength"] / 100.0))


def _lines(name: str, default: float, source: str) -> Parameter:
    return Parameter(
        name=name,
        unit="px",
        low=0.0,
        high=1024.0,
        default=default,
        source=source,
        log=False,
        fitted=False,
        pixel_power=1.0,
    )


_SIDE = (
    "lines of a tile, 0: of the panel. Photon counters and CMOS tiles 55 to 256, readout chips of flat panels 64 to 256"
)
_FIRST = "lines before the first seam, where the panel's border cuts the first tile"

TILE_GAIN = Effect(
    id="tile_gain",
    title="gains of tiles or readout channels have changed",
    law=r"y_{ij} = x_{ij}\,(1 + \eta_{t(i,j)}),\quad \mathrm{sd}(\eta) = s\ \text{(one }\eta\text{ a tile)}",
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
        _lines("rows_px", 32.0, _SIDE),
        _lines("columns_px", 32.0, _SIDE),
        _lines("first_rows_px", 0.0, _FIRST),
        _lines("first_columns_px", 0.0, _FIRST),
        seed_of("the gains"),
    ),
    stage="response",
    reference="gains of readout chips beside each other: spatial nonuniformity, EMVA Standard 1288, release 4.0",
    after_calibration=True,
    course="steady",
    pattern=True,
    change=_change_tiles,
    isolated_by="flats repeated, and behind a filter: steps that stay at the seams",
    shows=Shows(series=LIT_SERIES, axis="position", flats=False),
    absorbed="maps",
    # the rms of some nine gains, 1 / sqrt(2 n), is no better known by its own
    reading=Reading(law_sd=0.25, sd=0.05, map_rms=True),
    # where the seams are, later flats say
    grid=Grid(variants=({},), refined=False),
    variation=Variation(random="tiles"),
)

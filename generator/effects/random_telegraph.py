"""Random-telegraph pixels: a trap near the amplifier fills and empties, and the pixel's level jumps between two values.

y_n = x_n + A sigma b_n, b_n 0 or 1; it stays for m exposures on average, P(b_n+1 != b_n) = 1 / m, and both are as frequent. Heights A
and stays m of pixels differ.
"""

from collections.abc import Mapping
from dataclasses import replace

from ...errors import InputError
from ..line.line_state import LineContext, LineState, TelegraphPixels
from .effect import EVERY_SERIES, Effect, Grid, Parameter, Reading, Shows, seed_of


def _let_pixels_jump(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    # those that calibration saw are in its map
    if parameters["strength"] == 0 or context.since == "always":
        return state
    if not parameters["stay_exposures"] >= 1.0:
        raise InputError(
            "stay_exposures of random_telegraph", received=parameters["stay_exposures"], expected="1 exposure or more"
        )
    if not parameters["differ"] >= 1.0:
        raise InputError("differ of random_telegraph", received=parameters["differ"], expected="1 or more")
    return replace(
        state,
        telegraph=TelegraphPixels(
            share=min(parameters["strength"] / 100.0, 1.0),
            amplitude_reads=parameters["amplitude_reads"],
            stay_exposures=parameters["stay_exposures"],
            seed=int(parameters["pattern_seed"]),
            differ=parameters["differ"],
        ),
    )


RANDOM_TELEGRAPH = Effect(
    id="random_telegraph",
    title="pixels whose level jumps between two values",
    law=(
        r"y_n = x_n + A\,\sigma_e\,b_n,\quad b_n \in \{0, 1\},\quad "
        r"P(b_{n+1} \ne b_n) = 1/m,\ \text{in a share}\ s\ \text{of the pixels}"
    ),
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.1,
            high=10.0,
            default=1.0,
            source="share of the pixels; from few in cooled sensors to several in a hundred after irradiation",
            log=True,
            pixel_power=-2.0,  # one in a square makes it jump
            most=100.0,
        ),
        Parameter(
            name="amplitude_reads",
            unit="read noises",
            low=2.0,
            high=15.0,
            default=6.0,
            source="height of a jump; below twice the read noise a pixel is like any other",
            log=True,
            pixel_power=1.0,
        ),
        Parameter(
            name="stay_exposures",
            unit="exposures",
            low=2.0,
            high=50.0,
            default=7.0,
            source="mean stay in a level: time constants of traps spread over decades, those of a series' length are seen",
            log=True,
        ),
        Parameter(
            name="differ",
            unit="",
            low=1.0,
            high=10.0,
            default=1.0,
            source="ratio of largest to smallest height and of longest to shortest stay: traps lie at all depths and distances",
            log=True,
        ),
        seed_of("where they are"),
    ),
    stage="readout",
    reference="Hopkins, Hopkinson, IEEE Trans. Nucl. Sci. 40 (1993) 1567-1574; two levels",
    after_calibration=True,
    change=_let_pixels_jump,
    isolated_by="a long series of darks",
    shows=Shows(series=EVERY_SERIES, axis="tails", flats=False),
    absorbed="maps",
    reading=Reading(probes=("lasting pixels",)),
    # how many are found hangs on their height and stay, which counts alone do not tell well
    grid=Grid(
        variants=tuple(
            {"amplitude_reads": height, "stay_exposures": stay, "differ": differ}
            for height in (4.0, 8.0)
            for stay in (4.0, 12.0)
            for differ in (1.0, 4.0)
        ),
        refined=False,
    ),
)

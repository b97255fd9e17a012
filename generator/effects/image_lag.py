"""Image lag: charge that is trapped in one exposure and released in later ones.

    y_n = (1 - phi) x_n + sum_i (1 - a_i) R_i,n       R_i,n+1 = a_i R_i,n + phi_i x_n       a_i = exp(-interval / tau_i)

Charge is conserved: a steady exposure reads x in the end. After an exposure of length T the first beam-off frame reads
x sum_i phi_i (1 - exp(-T / tau_i)), which is the strength. Four traps, each s times as slow as the one before and with
a share q (`charge_ratio`) of its charge, have tau as their middle: release as a power of time over the decades. What is
released while nothing is exposed is thrown away by a panel that keeps being read, and found in the next frame by one
that is not.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LagLaw, LineContext, LineState
from .effect import EVERY_SERIES, Effect, Grid, InImages, Parameter, Reading, Shows

_STEPS = (-1.5, -0.5, 0.5, 1.5)


def _trap_charge(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    middle, spread = parameters["release_s"], parameters["spread"]
    times = tuple(middle * spread**step for step in _STEPS)
    charges = [parameters["charge_ratio"] ** number for number in range(len(times))]
    parts = [charge / sum(charges) for charge in charges]
    filled = sum(part * -math.expm1(-parameters["after_s"] / time) for part, time in zip(parts, times, strict=True))
    trapped = parameters["strength"] / 100.0 / filled
    law = LagLaw(
        trapped=tuple(part * trapped for part in parts),
        time_s=times,
        pause_share=parameters["pause_share"],
        idle_s=parameters["idle_s"],
        before_share=parameters["before_share"],
    )
    return replace(state, lag=law)


IMAGE_LAG = Effect(
    id="image_lag",
    title="image lag",
    law=(
        r"y_n = (1 - \sum_i \phi_i)\,x_n + \sum_i (1 - a_i)\,R_{i,n},\quad "
        r"R_{i,n+1} = a_i R_{i,n} + \phi_i x_n,\quad "
        r"a_i = e^{-\Delta t/\tau_i}"
    ),
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.02,
            high=5.0,
            default=1.0,
            source="first beam-off frame over the last exposed one, after 5 s of exposure; another time is `after_s`",
            log=True,
            most=100.0,
        ),
        Parameter(
            name="release_s",
            unit="s",
            low=0.1,
            high=10.0,
            default=1.0,
            source="middle of the traps' release times; those of amorphous silicon empty within frames to minutes",
            log=True,
        ),
        Parameter(
            name="pause_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="charge released in a pause that the next frame reads; 0: the panel is read on, 1: it is not",
            log=False,
        ),
        Parameter(
            name="charge_ratio",
            unit="",
            low=0.1,
            high=1.0,
            default=0.5,
            source="charge of a trap over that of the next quicker one; 1/2: Starman et al. (2012)",
            log=True,
        ),
        Parameter(
            name="spread",
            unit="",
            low=1.0,
            high=10.0,
            default=7.6,
            source="ratio of neighbouring release times, 1: all alike; Starman et al. (2012) find four of ratio 7.6",
            log=True,
            fitted=False,
        ),
        Parameter(
            name="after_s",
            unit="s",
            low=0.001,
            high=1e5,
            default=5.0,
            source="length of the exposure after which `strength` is seen",
            log=True,
            fitted=False,
        ),
        Parameter(
            name="idle_s",
            unit="s",
            low=0.1,
            high=300.0,
            default=1.0,
            source="pause before each series of a session that states no times; diagnoses of such sessions fit it",
            log=True,
            fitted=False,
            # quick traps still hold charge, slow ones have lost most
            tried_without_times=(1.0, 20.0),
        ),
        Parameter(
            name="before_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="of what exposures before the lag set in would have left; 0: its traps are new, 1: they were full already."
            " Diagnoses fit it where a lag came after the calibration",
            log=False,
            fitted=False,
            fitted_if_later=True,
        ),
    ),
    stage="lag",
    reference="Hsieh, Gurmen, King (2000), doi:10.1109/42.887837; Starman et al. (2012), doi:10.1118/1.4752087",
    after_calibration=False,
    change=_trap_charge,
    isolated_by="frames with the beam off straight after an exposure",
    shows=Shows(series=EVERY_SERIES, axis="time"),
    either_onset=True,
    absorbed="noise",
    reading=Reading(probes=("afterglow frames 0-0",), sd=0.08),
    grid=Grid(
        shares=(0.8,),
        variants=(
            *({"release_s": time_s, "pause_share": share} for time_s in (0.316, 3.16) for share in (0.0, 1.0)),
            {"release_s": 0.3, "pause_share": 0.0, "spread": 1.3},  # one kind of traps
        ),
    ),
    images=InImages(left_out="what was exposed before an image is not known"),
)

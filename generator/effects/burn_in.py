"""Burn-in: light that a pixel has seen changes its gain for a while. A scintillator's traps fill, and it gives more light.

y = x (1 + g [(1 - w) q + w p]),    dq = (1 - q) dQ / Q_1 - q dt / tau,    dp = (1 - p) dQ / Q_1,    g = s / (1 - exp(-Q_0 / Q_1))

Q is the light that the pixel has had, Q_0 that of 100 exposures at full scale; q is the share of its shallow traps that are full, p
that of its deep ones, which stay full for days. Where objects stood, the gain of the open field is another: their shadows are in
later flats.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from ...errors import InputError
from ..line.line_state import GainMemory, LineContext, LineState
from .effect import EVERY_SERIES, Effect, Grid, InImages, Parameter, Shows

_EXPOSURES = 100.0  # at full scale, after which `strength` is seen


def _remember_light(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    for name in ("fade_s", "fills_after_exposures"):
        if not parameters[name] > 0.0:
            raise InputError(f"{name} of burn_in", received=parameters[name], expected="above 0")
    if not 0.0 <= parameters["lasting_share"] <= 1.0:
        raise InputError("lasting_share of burn_in", received=parameters["lasting_share"], expected="0 to 1")
    bits = context.twin.instrument.bits or 16
    full_DN = 2.0**bits - 1.0 - context.twin.dark_DN.value
    fills_after = parameters["fills_after_exposures"]
    most = parameters["strength"] / 100.0 / -math.expm1(-_EXPOSURES / fills_after)
    law = GainMemory(
        most=most,
        filled_per_DN=1.0 / (fills_after * full_DN),
        fade_s=parameters["fade_s"],
        lasting_share=parameters["lasting_share"],
    )
    return replace(state, gain_memory=law)


BURN_IN = Effect(
    id="burn_in",
    title="gain that remembers exposure",
    law=(
        r"y = x\,(1 + g\,[(1 - w)\,q + w\,p]),\quad \dot q = (1 - q)\,\dot Q/Q_1 - q/\tau,\quad "
        r"\dot p = (1 - p)\,\dot Q/Q_1,\quad g = s\,/\,(1 - e^{-Q_0/Q_1})"
    ),
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.05,
            high=5.0,
            default=0.5,
            source="change of gain by 100 exposures at full scale; CsI:Tl gains light after high doses, up to several per cent",
            log=False,
            signed=True,
        ),
        Parameter(
            name="fade_s",
            unit="s",
            low=100.0,
            high=1e5,
            default=3000.0,
            source="time in which it fades: minutes to days, by the depth of the traps",
            log=True,
        ),
        Parameter(
            name="fills_after_exposures",
            unit="exposures",
            low=30.0,
            high=3000.0,
            default=300.0,
            source="exposures at full scale by which all traps but 1/e are full: from a short session's light to a long one's",
            log=True,
            sought_last=True,
        ),
        Parameter(
            name="lasting_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="share of traps so deep that they stay full for days",
            log=False,
        ),
    ),
    stage="response",
    reference="hysteresis of CsI:Tl: Nagarkar et al. (2009), doi:10.1109/TNS.2009.2016198; traps of two depths",
    after_calibration=False,
    change=_remember_light,
    isolated_by="a flat before and after objects, in one place",
    shows=Shows(series=EVERY_SERIES, axis="time"),
    either_onset=True,
    remembers_all=True,
    absorbed="nothing",
    grid=Grid(
        shares=(0.8,), variants=({"fade_s": 300.0, "lasting_share": 0.5}, {"fade_s": 10000.0, "lasting_share": 0.5})
    ),
    images=InImages(left_out="what was exposed before an image is not known"),
)

"""Pile-up: after a count a pixel is blind for a while, and photons that come meanwhile are lost.

y = x / (1 + x tau / t),    x, y in counts of one exposure of length t: a dead time that lost photons do not prolong

The variance of such counts is x / (1 + x tau / t)^3. Photon counters only.
"""

from collections.abc import Mapping
from dataclasses import replace

from ...errors import InputError
from ..line.line_state import LineContext, LineState
from .effect import LIT_SERIES, Effect, Grid, Parameter, Shows


def _lose_counts(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    light_DN, variance_DN2 = float(state.signal_DN.sum()), float(state.variance_DN2.sum())
    if parameters["strength"] == 0 or not context.request.beam_on or light_DN <= 0.0:
        return state
    counting = context.twin.instrument.counting
    if not counting:
        raise InputError(
            "instrument counting",
            received="nothing" if counting is None else "false",
            expected="true, because only counters have a dead time",
            remedy="state it in the acquisition's instrument",
        )
    if not parameters["strength"] > 0:
        raise InputError("strength of pile_up", received=parameters["strength"], expected="0 ns or more")
    count_DN = variance_DN2 / light_DN
    exposure_ns = 1e6 * context.request.exposure_ms
    return replace(state, blind_per_DN=state.blind_per_DN + parameters["strength"] / exposure_ns / count_DN)


PILE_UP = Effect(
    id="pile_up",
    title="counts that are lost to pile-up",
    law=r"y = \frac{x}{1 + x\,\tau/t},\quad \mathrm{var}(y) = \frac{x}{(1 + x\,\tau/t)^3}",
    parameters=(
        Parameter(
            name="strength",
            unit="ns",
            low=10.0,
            high=1000.0,
            default=100.0,
            source="dead time of a pixel's electronics: tens of nanoseconds in fast counters to a microsecond in slow ones",
            log=True,
        ),
    ),
    stage="response",
    reference="counter of constant dead time: Knoll, Radiation Detection and Measurement, chapter 4; variance: renewal theory (Cox)",
    after_calibration=False,
    change=_lose_counts,
    needs=("counting",),
    isolated_by="flats at several currents and one exposure time, and at several times and one current",
    shows=Shows(series=LIT_SERIES, axis="level"),
    either_onset=True,
    absorbed="nothing",
    grid=Grid(shares=(0.3, 0.7)),
)

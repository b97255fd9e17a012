"""Tails of the optical spread: they blur the picture and correlate the noise.

(1 - w) G(f) + w / (1 + H f^2) in place of the calibrated G(f) (`order` 1; other shapes: _light_spread.py)
"""

from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import FloatArray, LineContext, LineState
from ._light_spread import order_parameter, spread_transfer
from .effect import LIT_SERIES, AlwaysALittle, Effect, Grid, Parameter, Shows

_USUAL_ORDER = 1.0  # of the tail: a Lorentzian
_MOST_LIKE_A_GAUSSIAN = 6.0  # order of the tail, the largest


def _add_tail(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    weight = parameters["strength"] / 100.0
    if weight == 0:
        return state
    reach_px = parameters["reach_px"]

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        return spread_transfer(f_row, f_column, reach_px=reach_px, order=parameters["order"], usual_order=_USUAL_ORDER)

    return replace(state, tails=(*state.tails, (weight, transfer)))


MTF_TAIL = Effect(
    id="mtf_tail",
    title="optical spread with a long tail",
    law=r"H(f) = (1 - s)\,G(f) + \frac{s}{1 + (2\pi L f)^2}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=2.0,
            high=40.0,
            default=10.0,
            source="share w of the light in the Lorentzian part of the transfer function",
            log=False,
            most=100.0,
        ),
        Parameter(
            name="reach_px",
            unit="px",
            low=0.5,
            high=4.0,
            default=1.5,
            source="sqrt(H) / (2 pi): H about 40 to 250 px^2 for thick scintillator screens",
            log=True,
            pixel_power=1.0,
        ),
        order_parameter(_USUAL_ORDER),
    ),
    stage="optics",
    reference="Lorentzian transfer function of screens: Burgess (1978), doi:10.1118/1.594387",
    after_calibration=True,
    course="steady",
    change=_add_tail,
    isolated_by="an edge close to the detector, with flats",
    shows=Shows(series=LIT_SERIES, axis="sharpness"),
    absorbed="noise",
    grid=Grid(shares=(0.8,), variants=({"reach_px": 0.84}, {"reach_px": 2.4})),
    # screens have up to 20 % of their light there; of a clear layer's, (r^2 + L^2)^(-3/2) with L of 1 to 2 px, a fifth goes beyond
    # 5 px, where noise shows too little of it. A tail goes on as a Lorentzian does, or ends as a Gaussian: edges tell the two apart
    always_a_little=AlwaysALittle(
        name="tail of the spread",
        amounts=(
            ({"reach_px": 0.84}, 10.0),
            ({"reach_px": 2.4}, 10.0),
            ({"reach_px": 2.4, "order": _MOST_LIKE_A_GAUSSIAN}, 10.0),
            ({"reach_px": 5.0}, 3.0),
            ({"reach_px": 5.0, "order": _MOST_LIKE_A_GAUSSIAN}, 3.0),
        ),
    ),
)

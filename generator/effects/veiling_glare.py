"""Veiling glare: what travels far inside the detector. It knows nothing of gap or thickness.

h = (1 - r) delta + r exp(-R / L) / (2 pi L R),    transfer function (1 - r) + r / sqrt(1 + (2 pi L f)^2)
(`order` 1/2; other shapes: _light_spread.py). A share of r may be spread evenly over the whole panel, as by a cover or a housing.

Light of a quantum that strays is shared by many pixels: noise of flats falls by (1 - r)^2. X rays that
screen, cover or electronics scatter are quanta somewhere else: noise follows the signal (`xray_share` of r).
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState, needed
from ._light_spread import order_parameter, spread_transfer
from .effect import LIT_SERIES, Effect, Grid, Parameter, Shows, Variation

_USUAL_ORDER = 0.5


def _add_glare(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    share = parameters["strength"] / 100.0
    if share == 0:
        return state
    if not 0.0 <= parameters["xray_share"] <= 1.0:
        raise InputError("xray_share of veiling_glare", received=parameters["xray_share"], expected="0 to 1")
    of_quanta = share * parameters["xray_share"]
    of_light = share - of_quanta
    length_px = parameters["length_mm"] / needed(context.twin.instrument.pixel_mm, "pixel_mm", "veiling_glare")

    def strayed(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        spread = spread_transfer(
            f_row, f_column, reach_px=length_px, order=parameters["order"], usual_order=_USUAL_ORDER
        )
        even = (f_row == 0.0) & (f_column == 0.0)
        return np.where(even, 1.0, (1.0 - parameters["even_share"]) * spread)

    def blur(f_row: FloatArray, f_column: FloatArray, moved: float) -> FloatArray:
        return np.asarray((1.0 - moved) + moved * strayed(f_row, f_column))

    if of_quanta:
        state = replace(state, object_transfers=(*state.object_transfers, partial(blur, moved=of_quanta)))
    if of_light:
        state = replace(state, optical_transfers=(*state.optical_transfers, partial(blur, moved=of_light)))
    return state


VEILING_GLARE = Effect(
    id="veiling_glare",
    title="veiling glare in the detector",
    law=r"H(f) = (1 - s) + \frac{s\,(1 - e)}{\sqrt{1 + (2\pi L f)^2}},\quad H(0) = 1",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.5,
            high=5.0,
            default=2.0,
            source="share of the light that leaves its place; flat panels and image intensifiers",
            log=False,
            most=100.0,
        ),
        Parameter(
            name="length_mm",
            unit="mm",
            low=1.0,
            high=20.0,
            default=5.0,
            source="reach of glare in scintillator and cover glass",
            log=True,
        ),
        order_parameter(_USUAL_ORDER),
        Parameter(
            name="even_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="share of the glare that reaches all of the panel alike: light that a cover or a housing scatters back",
            log=False,
            sought_last=True,
        ),
        Parameter(
            name="xray_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="share of the glare that is scattered X rays, each a quantum; the rest is light",
            log=False,
            sought_last=True,
        ),
    ),
    stage="optics",
    reference="Seibert, Nalcioglu, Roeck (1984), doi:10.1118/1.595527",
    after_calibration=False,
    course="steady",
    change=_add_glare,
    needs=("pixel_mm",),
    isolated_by="opaque discs of several sizes",
    shows=Shows(series=LIT_SERIES, axis="sharpness"),
    either_onset=True,
    absorbed="noise",
    variation=Variation(random="surroundings"),
    grid=Grid(shares=(0.8,), variants=({"length_mm": 2.1}, {"length_mm": 9.5}, {"length_mm": 4.5, "even_share": 0.5})),
)

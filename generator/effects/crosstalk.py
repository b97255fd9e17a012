"""Crosstalk of quanta: some are counted in another pixel than the one where they arrived. They blur the picture, not its noise.

A quantum that moves as a whole (scattered X ray, K photon of a thick screen, charge that drifts) is one count somewhere else, and
counts that move independently stay independent: the noise stays white before the spread of light, and its variance moves with the
signal. Quanta that are shared between pixels correlate the noise as well; those are tails, glare and K fluorescence.

H(f) = 1 - w + w / sqrt(1 + (2 pi L f)^2),    w = s / p(L)

p(L): chance that a move takes a quantum out of its pixel; its distance has the density exp(-R / L) / L.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState
from ._light_spread import spread_transfer
from .effect import Effect, Grid, Parameter, Reading, Shows

_NODES = 48
_EXPONENTIAL = 0.5  # order of the transfer function


@lru_cache(maxsize=256)
def leaving_share(reach_px: float) -> float:
    """Chance that a quantum somewhere in a square pixel is outside after a move of mean length `reach_px`, in any direction.

    1 - int_0^sqrt(2) exp(-R / L) / L g(R) dR, g(R) the part of a square that it shares with itself moved by R, averaged over
    directions: 1 - 4 R / pi + R^2 / pi up to 1, 1 - (2 / pi) (2 arccos(1 / R) + 1 + R^2 / 2 - 2 sqrt(R^2 - 1)) beyond.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    stays = 0.0
    for low, high in ((0.0, 1.0), (1.0, math.sqrt(2.0))):
        length = 0.5 * (high - low) * nodes + 0.5 * (high + low)
        if high == 1.0:
            inside = 1.0 - 4.0 / math.pi * length + length**2 / math.pi
        else:
            root = np.sqrt(length**2 - 1.0)
            inside = 1.0 - 2.0 / math.pi * (2.0 * np.arccos(1.0 / length) + 1.0 + 0.5 * length**2 - 2.0 * root)
        density = np.exp(-length / reach_px) / reach_px
        stays += 0.5 * (high - low) * float(weights @ (density * inside))
    return 1.0 - stays


def _move_quanta(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if not context.has_scene or parameters["strength"] == 0:
        return state
    reach_px = parameters["reach_px"]
    leaving = leaving_share(reach_px)
    moved = parameters["strength"] / 100.0 / leaving
    if moved > 1.0:
        raise InputError(
            "strength of crosstalk",
            received=f"{parameters['strength']:g} % at a reach of {reach_px:g} px",
            expected=f"at most {100.0 * leaving:.3g} %, where all quanta move",
        )

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        passed = spread_transfer(f_row, f_column, reach_px=reach_px, order=_EXPONENTIAL, usual_order=_EXPONENTIAL)
        return np.asarray(1.0 - moved + moved * passed)

    return replace(state, object_transfers=(*state.object_transfers, transfer))


CROSSTALK = Effect(
    id="crosstalk",
    title="quanta counted in a neighbouring pixel",
    law=r"H(f) = 1 - w + \frac{w}{\sqrt{1 + (2\pi L f)^2}},\quad w = \frac{s}{p(L)},\quad N(f)\ \text{unchanged}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=3.0,
            high=40.0,
            default=12.0,
            source="share of the quanta of a pixel that another one counts; 3-8 % to each of four neighbours in pixelated CT screens",
            log=False,
            most=100.0,
        ),
        Parameter(
            name="reach_px",
            unit="px",
            low=0.5,
            high=2.5,
            default=1.0,
            source="mean distance of a move: free paths of scattered and K photons of 0.1-0.5 mm in pixels of 0.1-0.4 mm",
            log=True,
            pixel_power=1.0,
        ),
    ),
    stage="object_blur",
    reference="noise of quanta stays whiter than the picture's transfer function tells: Lubberts (1968), doi:10.1364/JOSA.58.001475",
    after_calibration=False,
    course="steady",
    change=_move_quanta,
    needs=("scene",),
    isolated_by="an edge close to the detector, with the noise power of flats",
    shows=Shows(series=("object",), axis="sharpness", flats=False),
    absorbed="nothing",
    reading=Reading(law_sd=0.36),  # share and reach trade against each other, as those of K fluorescence
    grid=Grid(shares=(0.8,), variants=({"reach_px": 0.7}, {"reach_px": 1.6})),
)

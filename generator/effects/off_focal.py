"""Off-focal radiation: electrons that bounce off the anode strike it elsewhere; a share of the beam comes from around the spot.

Seen from the object it is a second, wide source; its picture of an edge is as much larger as the detector lies behind the object:

H(f) = 1 - w + w P,    h = 2 (pi s_d f)^2,    u = 2 pi f a_d,    s_d = s (M - 1),    a_d = a (M - 1)

a is where the mean of its profile lies beside the spot: an anode goes on to one side of it, and so do the electrons that strike it
again. Where a is 0, s is the standard deviation of the profile along a line and p its peakedness, a third of the excess kurtosis.

p > 0: P = (1 + p (h + i u))^(-1 / p). Gaussians whose variances and places are in proportion to a number of a gamma law of relative
variance p. Without a the profile falls exponentially from the middle at p = 2/3, and has a peak and a long tail beyond; without s it
is nothing on one side of the spot and falls exponentially on the other at p = 1. p = 0: a Gaussian, P = exp(-h - i u).

p < 0: P = 0F1(n, -n h) exp(-i u), n = -1 - 1 / p. The profile (1 - R^2 / R_0^2)^(n - 2) ends at a rim R_0 = s sqrt(2 n): a ring at
p = -1/2 (n = 1), an even disc at p = -1/3 (n = 2).

The open field has the same light with it and without. Beyond the borders of the field the picture mirrors.

Sources: D. B. Madan, P. P. Carr, E. C. Chang (1998), The variance gamma process and option pricing, European Finance Review 2,
79-105 (p > 0); E. M. Stein, G. Weiss (1971), Introduction to Fourier Analysis on Euclidean Spaces, chapter IV, theorem 4.15 (p < 0).
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState, needed
from .effect import Effect, Grid, Parameter, Reading, Shows, Variation

# so little below 0 the first order of peakedness is enough: the transfer is off by less than 3e-4
_NEAR_GAUSSIAN = 0.02
# mm, to each side of the panel: a third of the plausible range
_SIDES = ((-5.0, 0.0), (5.0, 0.0), (0.0, -5.0), (0.0, 5.0))
_RING = -0.5  # peakedness of a source that is its rim alone; no even profile is flatter


def _transfer_of_source(half: FloatArray, turn: FloatArray, peakedness: float) -> NDArray[np.inexact]:
    """P of a profile, for h = 2 (pi s_d f)^2 and u = 2 pi f a_d; complex where any u is not 0."""
    away = bool(np.any(turn))
    if peakedness > 0.0:
        both = half + 1j * turn if away else half
        return np.asarray(np.exp(-np.log1p(peakedness * both) / peakedness))
    if peakedness > -_NEAR_GAUSSIAN:
        even = np.exp(-half) * (1.0 + 0.5 * peakedness * half**2)
    else:
        from scipy.special import hyp0f1

        order = -1.0 - 1.0 / peakedness
        even = hyp0f1(order, -order * half)
    return np.asarray(even * np.exp(-1j * turn) if away else even)


def _add_source(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if not context.has_scene or parameters["strength"] == 0:
        return state
    name = "off_focal"
    pitch = needed(context.twin.instrument.pixel_mm, "pixel_mm", name)
    magnification = needed(context.source_detector_mm, "source_detector_mm", name) / needed(
        context.source_object_mm, "source_object_mm", name
    )
    share = parameters["strength"] / 100.0
    px_per_mm = (magnification - 1.0) / pitch
    width_px = parameters["width_mm"] * px_per_mm
    # the tube stays where it is when the panel is turned
    turned = math.radians(context.request.panel_rotation_deg)
    down, right = parameters["down_mm"] * px_per_mm, parameters["right_mm"] * px_per_mm
    down_px = down * math.cos(turned) + right * math.sin(turned)
    right_px = right * math.cos(turned) - down * math.sin(turned)
    peakedness = parameters["peakedness"]
    if peakedness < _RING:
        raise InputError("peakedness of off_focal", received=peakedness, expected=f"{_RING:g} (a ring) or more")

    def transfer(f_row: FloatArray, f_column: FloatArray) -> NDArray[np.inexact]:
        half = 0.5 * (2.0 * math.pi * width_px) ** 2 * (f_row**2 + f_column**2)
        turn = 2.0 * math.pi * (down_px * f_row + right_px * f_column)
        return np.asarray(1.0 - share + share * _transfer_of_source(half, turn, peakedness))

    return replace(state, object_transfers=(*state.object_transfers, transfer))


OFF_FOCAL = Effect(
    id="off_focal",
    title="radiation from around the focal spot",
    law=(
        r"H = 1 - w + w\,P,\quad h = 2\,(\pi s f)^2 (M - 1)^2,\quad u = 2 \pi f a\,(M - 1),\quad "
        r"P = (1 + p\,(h + i u))^{-1/p}\ (p > 0),\quad P = {}_0F_1(n; -n h)\,e^{-i u},\ n = -1 - 1/p\ (p < 0)"
    ),
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=2.0,
            high=20.0,
            default=8.0,
            source="share of the output from outside the focal spot: some 5-20 % without a collimator close to the anode",
            log=False,
            most=100.0,
        ),
        Parameter(
            name="width_mm",
            unit="mm",
            low=0.5,
            high=15.0,
            default=5.0,
            source="standard deviation along a line: electrons strike the anode again anywhere from beside the spot to its rim",
            log=True,
        ),
        Parameter(
            name="peakedness",
            unit="",
            low=_RING,
            high=2.0,
            default=0.5,
            source="a third of the excess kurtosis of a profile: -1/2 a ring, -1/3 an even disc, 0 Gaussian, 2/3 exponential, then a"
            " peak and a long tail",
            log=False,
            sought_last=True,
        ),
        *(
            Parameter(
                name=name,
                unit="mm",
                low=-15.0,
                high=15.0,
                default=0.0,
                source=f"where the middle of these shadows lies, towards rising {line} index, over M - 1: the anode goes on for"
                " centimetres to one side of the focal spot",
                log=False,
                sought_last=True,
            )
            for name, line in (("down_mm", "row"), ("right_mm", "column"))
        ),
    ),
    stage="object_blur",
    reference="Birch, Br. J. Radiol. 49 (1976) 951-955; a second source behind the same object",
    after_calibration=False,
    course="steady",
    change=_add_source,
    needs=("scene", "pixel_mm", "source_object_mm", "source_detector_mm"),
    isolated_by="an opaque disc at two magnifications",
    shows=Shows(series=("object",), axis="sharpness", flats=False),
    absorbed="nothing",
    reading=Reading(law_sd=0.36),  # share and width trade against each other, as those of K fluorescence
    variation=Variation(random="surroundings"),
    grid=Grid(
        shares=(0.8,),
        variants=(
            # about the spot: in the middle of widths from 1.5 to 15 mm, in the logarithm
            {"width_mm": 4.7, "peakedness": 0.5, "down_mm": 0.0, "right_mm": 0.0},
            # from the spot to one side, falling exponentially: from a source about the spot no small step leads there
            *({"width_mm": 1.0, "peakedness": 1.0, "down_mm": down, "right_mm": right} for down, right in _SIDES),
        ),
    ),
)

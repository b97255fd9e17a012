"""Off-focal radiation: electrons that bounce off the anode strike it elsewhere; a share of the beam comes from around the spot.

Seen from the object it is a second, wide source; its picture of an edge is as much larger as the detector lies behind the object:

H(f) = 1 - w + w P(h),    h = 2 (pi s_d f)^2,    s_d = s (M - 1)

s is the standard deviation of its profile along a line, p its peakedness: a third of the excess kurtosis along a line.

p > 0: P(h) = (1 + p h)^(-1 / p). Gaussians whose variances are spread by a gamma law of relative variance p: the profile falls
exponentially from the middle at p = 2/3, and has a peak and a long tail beyond. p = 0: a Gaussian, P(h) = exp(-h).

p < 0: P(h) = 0F1(n, -n h), n = -1 - 1 / p. The profile (1 - R^2 / R_0^2)^(n - 2) ends at a rim R_0 = s sqrt(2 n): a ring at p = -1/2
(n = 1), an even disc at p = -1/3 (n = 2).

The open field has the same light with it and without. Beyond the borders of the field the picture mirrors.

Source: E. M. Stein, G. Weiss (1971), Introduction to Fourier Analysis on Euclidean Spaces, theorem 4.15 of chapter IV (p < 0).
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState, needed
from .effect import Effect, Grid, Parameter, Shows

_NEAR_GAUSSIAN = 0.02  # peakedness up to which first order is enough: the transfer is off by less than 3e-4
_RING = -0.5  # peakedness of a source that is its rim alone; no even profile is flatter


def _transfer_of_source(half: FloatArray, peakedness: float) -> FloatArray:
    """P(h) of a profile, for h = 2 (pi s_d f)^2."""
    if abs(peakedness) < _NEAR_GAUSSIAN:
        return np.asarray(np.exp(-half) * (1.0 + 0.5 * peakedness * half**2))
    if peakedness > 0.0:
        return np.asarray((1.0 + peakedness * half) ** (-1.0 / peakedness))
    from scipy.special import hyp0f1

    order = -1.0 - 1.0 / peakedness
    return np.asarray(hyp0f1(order, -order * half))


def _add_source(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if not context.has_scene or parameters["strength"] == 0:
        return state
    name = "off_focal"
    pitch = needed(context.twin.instrument.pixel_mm, "pixel_mm", name)
    magnification = needed(context.source_detector_mm, "source_detector_mm", name) / needed(
        context.source_object_mm, "source_object_mm", name
    )
    share = parameters["strength"] / 100.0
    width_px = parameters["width_mm"] * (magnification - 1.0) / pitch
    peakedness = parameters["peakedness"]
    if peakedness < _RING:
        raise InputError("peakedness of off_focal", received=peakedness, expected=f"{_RING:g} (a ring) or more")

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        half = 0.5 * (2.0 * math.pi * width_px) ** 2 * (f_row**2 + f_column**2)
        return np.asarray(1.0 - share + share * _transfer_of_source(half, peakedness))

    return replace(state, object_transfers=(*state.object_transfers, transfer))


OFF_FOCAL = Effect(
    id="off_focal",
    title="radiation from around the focal spot",
    law=(
        r"H = 1 - w + w\,P(h),\quad h = 2\,(\pi s_d f)^2,\quad s_d = s\,(M - 1),\quad "
        r"P = (1 + p h)^{-1/p}\ (p > 0),\quad P = {}_0F_1(n; -n h),\ n = -1 - 1/p\ (p < 0)"
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
            low=1.5,
            high=15.0,
            default=5.0,
            source="standard deviation along a line: electrons strike the anode again within millimetres to its rim",
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
    grid=Grid(shares=(0.8,), variants=tuple({"width_mm": width, "peakedness": 0.5} for width in (2.7, 8.3))),
)

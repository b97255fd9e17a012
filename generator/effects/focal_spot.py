"""Focal spot: it blurs what stands in the beam and correlates no noise.

Variance of a Gaussian of full width a (M - 1) at the detector, M = source-detector over source-object; profile from Gaussian to
even brightness. The spot that the instrument states is in every picture already; the effect adds to its variance.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line.line_state import FloatArray, LineContext, LineState, needed
from ..spread.spot import spot_image_px
from .effect import Effect, Grid, Parameter, Shows


def _transfer_of_spot(f: FloatArray, flatness: float) -> FloatArray:
    """Transfer of a spot of standard deviation 1: Gaussian (flatness 0), more and more triangle (0.5), trapezoids, box (1)."""
    if flatness <= 0.5:
        triangle = 2.0 * flatness  # share of the variance
        return np.asarray(
            np.exp(-2.0 * (1.0 - triangle) * (np.pi * f) ** 2) * np.sinc(math.sqrt(6.0 * triangle) * f) ** 2
        )
    slope = 2.0 * (1.0 - flatness)  # width of the second box over that of the first
    width = math.sqrt(12.0 / (1.0 + slope**2))
    return np.asarray(np.sinc(width * f) * np.sinc(slope * width * f))


def _blur_by_focal_spot(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if not context.has_scene or parameters["strength"] == 0:
        return state
    name = "focal_spot"
    pitch = needed(context.twin.instrument.pixel_mm, "pixel_mm", name)
    magnification = needed(context.source_detector_mm, "source_detector_mm", name) / needed(
        context.source_object_mm, "source_object_mm", name
    )
    flatness = parameters.get("flatness", 0.0)
    sigma_px = spot_image_px(parameters["strength"], magnification=magnification, pixel_mm=pitch)
    along_row, along_column = sigma_px * math.sqrt(parameters["aspect"]), sigma_px / math.sqrt(parameters["aspect"])

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        rows, columns = (_transfer_of_spot(s * f, flatness) for s, f in ((along_row, f_row), (along_column, f_column)))
        return np.asarray(rows * columns)

    return replace(state, object_transfers=(*state.object_transfers, transfer))


FOCAL_SPOT = Effect(
    id="focal_spot",
    title="focal spot larger than assumed",
    law=r"\sigma = \frac{s\,(M - 1)}{2\sqrt{2\ln 2}},\quad M = \frac{\text{source-detector}}{\text{source-object}}",
    parameters=(
        Parameter(
            name="strength",
            unit="mm",
            low=0.05,
            high=1.5,
            default=0.4,
            source="full width at half maximum of the Gaussian of equal variance; industrial tubes, EN 12543. A spot of even"
            " brightness is 1.47 times as wide",
            log=True,
        ),
        Parameter(
            name="aspect",
            unit="",
            low=0.5,
            high=2.0,
            default=1.0,
            source="width along the rows' index over width along the columns' index; EN 12543 states both",
            log=True,
        ),
        Parameter(
            name="flatness",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="profile of the spot: 0 Gaussian, 0.5 triangle, 1 even brightness; EN 12543 shows all of them",
            log=False,
        ),
    ),
    stage="object_blur",
    reference="geometric unsharpness, EN 12543; Gaussian to even brightness",
    after_calibration=False,
    course="steady",
    change=_blur_by_focal_spot,
    needs=("scene", "pixel_mm", "source_object_mm", "source_detector_mm"),
    isolated_by="an edge at two magnifications",
    shows=Shows(series=("object",), axis="sharpness", flats=False),
    absorbed="nothing",
    grid=Grid(
        shares=(0.25, 0.5, 0.75, 1.0), variants=tuple({"aspect": aspect, "flatness": 0.3} for aspect in (0.707, 1.414))
    ),
)

"""Blur of the picture: focal spot and motion (they leave the noise alone), and tails of the optical spread (they do not).

focal spot   variance of a Gaussian of full width a (M - 1) at the detector, M = source-detector over source-object; profile
             from Gaussian to even brightness
motion       box of length v t M along the belt
MTF tail     (1 - w) G(f) + w / (1 + H f^2) in place of the calibrated G(f) (`order` 1; other shapes: effect.py)
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line_state import FloatArray, LineContext, LineState, needed
from .effect import Effect, Parameter, order_parameter, spread_transfer

_USUAL_ORDER = 1.0  # of the tail: a Lorentzian
_SIGMA_OF_FWHM = 1.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))


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
    sigma_px = _SIGMA_OF_FWHM * parameters["strength"] * (magnification - 1.0) / pitch
    along_row, along_column = sigma_px * math.sqrt(parameters["aspect"]), sigma_px / math.sqrt(parameters["aspect"])

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        rows, columns = (_transfer_of_spot(s * f, flatness) for s, f in ((along_row, f_row), (along_column, f_column)))
        return np.asarray(rows * columns)

    return replace(state, object_transfers=(*state.object_transfers, transfer))


FOCAL_SPOT = Effect(
    id="focal_spot",
    title="focal spot larger than assumed",
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
    change=_blur_by_focal_spot,
    needs=("scene", "pixel_mm", "source_object_mm", "source_detector_mm"),
)


def _blur_by_motion(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    request = context.request
    if not context.has_scene or parameters["strength"] == 0 or request.belt_speed_mm_s == 0:
        return state
    usual = context.twin.instrument.magnification
    length_px = parameters["strength"] * request.exposure_ms / 50.0
    if usual is not None and context.source_detector_mm is not None and context.source_object_mm is not None:
        length_px *= context.source_detector_mm / context.source_object_mm / usual
    along_rows = request.belt_axis != "column"

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        return np.asarray(np.sinc(length_px * (f_row if along_rows else f_column)))

    return replace(state, object_transfers=(*state.object_transfers, transfer))


MOTION_BLUR = Effect(
    id="motion_blur",
    title="object moves during the exposure",
    parameters=(
        Parameter(
            name="strength",
            unit="px",
            low=0.5,
            high=10.0,
            default=2.0,
            source="path on the detector in 50 ms at the line's usual magnification, along the belt",
            log=True,
        ),
    ),
    stage="object_blur",
    reference="uniform motion through the exposure: box of v t M; belts of 10-500 mm/s",
    after_calibration=False,
    change=_blur_by_motion,
    needs=("scene",),
)


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
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=2.0,
            high=40.0,
            default=10.0,
            source="share w of the light in the Lorentzian part of the transfer function",
            log=False,
        ),
        Parameter(
            name="reach_px",
            unit="px",
            low=0.5,
            high=4.0,
            default=1.5,
            source="sqrt(H) / (2 pi): H about 40 to 250 px^2 for thick scintillator screens",
            log=True,
        ),
        order_parameter(_USUAL_ORDER),
    ),
    stage="optics",
    reference="Lorentzian transfer function of screens: Burgess (1978), doi:10.1118/1.594387",
    after_calibration=True,
    change=_add_tail,
)

"""Blur of what stands in the beam by the belt whose speed a series states."""

import numpy as np

from ..line.belt_path import belt_path_px
from ..line.line_state import FloatArray, Transfer
from ..line.series_request import SeriesRequest
from ..line.twin import Twin

_LEAST_PX = 0.07  # path: a variance of 0.0004 px^2, as small as a focal spot's that does not count


def stated_path_px(twin: Twin, request: SeriesRequest) -> float:
    """Path (px) of the object's image in one exposure.

    0 where speed or pitch is not stated, or nothing stands in the beam; a magnification that is not known counts as 1.
    """
    instrument, speed_mm_s = twin.instrument, request.belt_speed_mm_s
    if not (request.thickness_mm and speed_mm_s and instrument.pixel_mm):
        return 0.0
    to_object_mm, to_detector_mm = request.distances_mm(instrument)
    magnification = to_detector_mm / to_object_mm if to_object_mm and to_detector_mm else 1.0
    path_px = belt_path_px(
        instrument,
        speed_mm_s=abs(speed_mm_s),
        exposure_ms=request.exposure_ms,
        magnification=magnification,
        pixel_mm=instrument.pixel_mm,
    )
    return path_px if path_px >= _LEAST_PX else 0.0


def blur_by_belt(twin: Twin, request: SeriesRequest) -> tuple[Transfer, ...]:
    """The transfer of that path, none where it does not blur."""
    path_px = stated_path_px(twin, request)
    if path_px == 0.0:
        return ()
    along_rows = request.belt_axis != "column"

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        return np.asarray(np.sinc(path_px * (f_row if along_rows else f_column)))

    return (transfer,)

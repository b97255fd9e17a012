"""Blur of what stands in the beam by the focal spot that the instrument states."""

from ..line.line_state import Transfer
from ..line.series_request import SeriesRequest
from ..line.twin import Twin
from ..spread.spot import gaussian_transfer, spot_image_px

_LEAST_PX = 0.02  # standard deviation: a variance of 0.0004 px^2, one seventieth of what is unknown of any edge


def declared_spot_px(twin: Twin, request: SeriesRequest) -> float:
    """Standard deviation of the image of the instrument's focal spot behind the scene of a series, px.

    0 where spot, pitch or a distance is not stated, nothing stands in the beam, or it is less than 0.02 px.
    """
    spot_mm, pitch_mm = twin.instrument.focal_spot_mm, twin.instrument.pixel_mm
    to_object_mm, to_detector_mm = request.distances_mm(twin.instrument)
    if not (request.thickness_mm and spot_mm and pitch_mm and to_object_mm and to_detector_mm):
        return 0.0
    sigma_px = spot_image_px(spot_mm, magnification=to_detector_mm / to_object_mm, pixel_mm=pitch_mm)
    return sigma_px if sigma_px >= _LEAST_PX else 0.0


def blur_by_declared_spot(twin: Twin, request: SeriesRequest) -> tuple[Transfer, ...]:
    """The transfer of that image, none where it does not blur."""
    sigma_px = declared_spot_px(twin, request)
    return () if sigma_px == 0.0 else (gaussian_transfer(sigma_px),)

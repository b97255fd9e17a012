"""How far a belt takes the image of what lies on it while it is exposed."""

from ...acquisition.instrument import Instrument


def belt_path_px(
    instrument: Instrument, *, speed_mm_s: float, exposure_ms: float, magnification: float, pixel_mm: float
) -> float:
    """Path (px) on the detector in one exposure: v M t / pixel; of a TDI detector, whose charge moves along, in one stage's share."""
    path = speed_mm_s * magnification * exposure_ms / 1000.0 / pixel_mm
    return path / (instrument.tdi_stages or 1) if instrument.detector == "tdi" else path

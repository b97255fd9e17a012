"""The instrument as its owner describes it. Everything is optional: None means unknown."""

import math
from dataclasses import dataclass, fields

from ..errors import InputError
from .setting import Filter

DETECTORS = ("area", "line", "tdi")


@dataclass(frozen=True, slots=True, kw_only=True)
class Instrument:
    """Tube, geometry and detector of a line; the attributes of `/instrument` in an acquisition file.

    Fields: anode (element symbol), anode_angle_deg, inherent_filtration (layers from the vendor's sheet),
    source_object_mm, source_detector_mm, pixel_mm (pitch), detector (`area`, `line`, `tdi`), counting (photon-counting
    rather than energy-integrating), scintillator (layers), detector_cover (layers), focal_spot_mm, bits (of the ADC),
    maximum_power_w, readout_ms, belt_axis (`row` or `column`).
    """

    anode: str | None = None
    anode_angle_deg: float | None = None
    inherent_filtration: tuple[Filter, ...] | None = None
    source_object_mm: float | None = None
    source_detector_mm: float | None = None
    pixel_mm: float | None = None
    detector: str | None = None
    counting: bool | None = None
    scintillator: tuple[Filter, ...] | None = None
    detector_cover: tuple[Filter, ...] | None = None
    focal_spot_mm: float | None = None
    bits: int | None = None
    maximum_power_w: float | None = None
    readout_ms: float | None = None
    belt_axis: str | None = None

    def __post_init__(self) -> None:
        zero_allowed = {"focal_spot_mm", "readout_ms"}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            lowest_fits = value >= 0 if field.name in zero_allowed else value > 0
            if not (math.isfinite(value) and lowest_fits):
                raise InputError(f"instrument {field.name}", received=value, expected="a finite positive number")
        if self.detector is not None and self.detector not in DETECTORS:
            raise InputError("instrument detector", received=self.detector, expected="one of " + ", ".join(DETECTORS))
        if self.belt_axis not in (None, "row", "column"):
            raise InputError("instrument belt_axis", received=self.belt_axis, expected="row or column")

    @property
    def magnification(self) -> float | None:
        """Source-detector over source-object distance, or None where one is unknown."""
        if self.source_detector_mm is None or self.source_object_mm is None:
            return None
        return self.source_detector_mm / self.source_object_mm

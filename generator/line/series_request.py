"""What one series of frames states of itself: plain data."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Setting
from ...errors import InputError

KINDS = ("dark", "flat", "object", "afterglow")


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesRequest:
    """What one series of an acquisition states; None where unknown.

    Fields: kind (`dark`, `flat`, `object`, `afterglow`); setting (kV, filters, load, exposure, averaged, distance);
    frames; exposure_ms; frame_interval_ms (from the begin of a stored frame to the next one's); start_s (since the
    session's begin); index; thickness_mm: material of the scene -> (row, column); source_object_mm, source_detector_mm;
    belt_speed_mm_s, belt_axis (`row` or `column`: the axis along which the object moves); panel_rotation_deg;
    after_calibration (later than the series that calibrated the twin); previous: exposures before this one that lag may
    remember, oldest first; long_ago: those before these, which only what fades in hours remembers; averaged (exposures in
    a stored frame, where there is no setting to say so); open_signal_DN: level of the open beam in one
    exposure where the tube load is unknown; product_material: the
    material of the scene that is the product; scene_kind (`wedge`, `slab`, `edge`, `disc`, `product`);
    displacement_px: how far along rows and columns the scene is known to lie from where its thickness maps have it;
    pause_stated: start_s says how long nothing was exposed before the series.
    """

    kind: str
    setting: Setting | None
    frames: int
    exposure_ms: float
    frame_interval_ms: float | None = None
    start_s: float = 0.0
    index: int = 0
    thickness_mm: Mapping[str, NDArray[np.floating]] | None = None
    source_object_mm: float | None = None
    source_detector_mm: float | None = None
    belt_speed_mm_s: float | None = None
    belt_axis: str = "row"
    panel_rotation_deg: float = 0.0
    after_calibration: bool = True
    previous: tuple["SeriesRequest", ...] = ()
    long_ago: tuple["SeriesRequest", ...] = ()
    averaged: int = 1
    open_signal_DN: float | None = None
    product_material: str | None = None
    scene_kind: str | None = None
    displacement_px: tuple[float, float] = (0.0, 0.0)
    pause_stated: bool = True

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError("kind of series", received=self.kind, expected="one of " + ", ".join(KINDS))
        if self.frames < 1 or self.averaged < 1:
            raise InputError("frames of a series", received=min(self.frames, self.averaged), expected="1 or more")
        if not (math.isfinite(self.exposure_ms) and self.exposure_ms >= 0 and math.isfinite(self.start_s)):
            raise InputError("exposure_ms", received=self.exposure_ms, expected="a finite exposure of 0 ms or more")
        if not all(math.isfinite(value) for value in self.displacement_px):
            raise InputError("displacement_px", received=self.displacement_px, expected="two finite numbers, px")
        if self.belt_axis not in ("row", "column"):
            raise InputError("belt_axis", received=self.belt_axis, expected="row or column")

    @property
    def beam_on(self) -> bool:
        """Whether photons arrive."""
        return self.kind in ("flat", "object")

    @property
    def exposures_per_frame(self) -> int:
        """Exposures averaged into one stored frame."""
        return self.averaged if self.setting is None else max(self.setting.averaged, self.averaged)

    def distances_mm(self, instrument: Instrument) -> tuple[float | None, float | None]:
        """From the source to the object and to the detector; the instrument's where the series does not state them."""
        to_detector = self.source_detector_mm
        if to_detector is None and self.setting is not None:
            to_detector = self.setting.source_detector_mm
        return (
            instrument.source_object_mm if self.source_object_mm is None else self.source_object_mm,
            instrument.source_detector_mm if to_detector is None else to_detector,
        )

    def interval_s(self, readout_ms: float | None) -> float:
        """Time from the begin of one exposure to the next one's, s."""
        if self.frame_interval_ms is not None and self.frame_interval_ms > 0:
            return self.frame_interval_ms / 1000.0 / self.exposures_per_frame
        return max(self.exposure_ms + (readout_ms or 0.0), 1e-6) / 1000.0

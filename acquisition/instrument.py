"""The instrument as its owner describes it. Everything is optional: None means unknown."""

import math
from dataclasses import dataclass, fields, replace

from ..errors import LARGEST, InputError
from .setting import Filter

DETECTORS = ("area", "line", "tdi")
BINNINGS = ("mean", "sum", "charge")
LAYER_FIELDS = ("inherent_filtration", "scintillator", "detector_cover", "interlayer", "back_scintillator")
TEXT_FIELDS = ("anode", "detector", "belt_axis", "binning_adds")
WHOLE_FIELDS = ("bits", "tdi_stages")
BOOLEAN_FIELDS = ("counting", "readout_overlaps")
HIGHEST_THRESHOLD_KEV = 80.0  # of counters: above, nothing is left of most beams
MOST_BITS = 32  # of the numbers that detectors write
_SAME_PITCH = 0.01  # relative: pitches are stated to so much


@dataclass(frozen=True, slots=True, kw_only=True)
class Instrument:
    """Tube, geometry and detector of a line; the attributes of `/instrument` in an acquisition file.

    Fields: anode (element symbol), anode_angle_deg, inherent_filtration (layers from the vendor's sheet),
    source_object_mm, source_detector_mm, pixel_mm (pitch), detector (`area`, `line`, `tdi`), counting (photon-counting
    rather than energy-integrating), scintillator (layers), detector_cover (layers), focal_spot_mm, bits (of the ADC),
    maximum_power_w, maximum_kV, maximum_current_mA, focal_power_w_per_mm (power that the tube takes for each mm of focal
    spot); readout_ms, readout_overlaps (the detector reads one frame while it exposes the next); tdi_stages (lines over
    which a TDI detector adds up); maximum_counts_per_s (of a counting pixel, before counts pile up); interlayer and
    back_scintillator (layers behind the scintillator of a dual-layer panel: dead ones, then the second sensitive one);
    binning_adds (`mean`: pixels averaged after readout; `sum`: added after readout; `charge`: added before readout);
    belt_axis (`row` or `column`).
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
    maximum_kV: float | None = None
    maximum_current_mA: float | None = None
    focal_power_w_per_mm: float | None = None
    readout_ms: float | None = None
    readout_overlaps: bool | None = None
    tdi_stages: int | None = None
    maximum_counts_per_s: float | None = None
    threshold_keV: float | None = None
    interlayer: tuple[Filter, ...] | None = None
    back_scintillator: tuple[Filter, ...] | None = None
    binning_adds: str | None = None
    belt_axis: str | None = None

    def __post_init__(self) -> None:
        if self.scintillator == ():
            # a detector without a sensitive layer is none: what it is, is not stated
            object.__setattr__(self, "scintillator", None)
        zero_allowed = {"focal_spot_mm", "readout_ms", "threshold_keV"}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            lowest_fits = value >= 0 if field.name in zero_allowed else value > 0
            if not (value <= LARGEST and lowest_fits):
                raise InputError(
                    f"instrument {field.name}",
                    received=value,
                    expected=f"a finite positive number, at most {LARGEST:g}",
                )
        if self.source_object_mm and self.source_detector_mm and self.source_object_mm > self.source_detector_mm:
            raise InputError(
                "instrument source_object_mm",
                received=f"{self.source_object_mm:g} mm, with the detector at {self.source_detector_mm:g} mm",
                expected="an object between source and detector",
            )
        if self.bits is not None and self.bits > MOST_BITS:
            raise InputError("instrument bits", received=self.bits, expected=f"a whole number from 1 to {MOST_BITS}")
        if self.detector is not None and self.detector not in DETECTORS:
            raise InputError("instrument detector", received=self.detector, expected="one of " + ", ".join(DETECTORS))
        if self.binning_adds is not None and self.binning_adds not in BINNINGS:
            raise InputError(
                "instrument binning_adds", received=self.binning_adds, expected="one of " + ", ".join(BINNINGS)
            )
        if self.tdi_stages is not None and self.detector not in (None, "tdi"):
            raise InputError(
                "instrument tdi_stages",
                received=f"{self.tdi_stages} for a detector of kind {self.detector}",
                expected="no stages, or the detector kind tdi",
            )
        if self.maximum_counts_per_s is not None and self.counting is False:
            raise InputError(
                "instrument maximum_counts_per_s",
                received=f"{self.maximum_counts_per_s:g} counts/s for an integrating detector",
                expected="no count limit, or counting = true",
            )
        if self.threshold_keV is not None and self.threshold_keV > HIGHEST_THRESHOLD_KEV:
            raise InputError(
                "instrument threshold_keV",
                received=f"{self.threshold_keV:g} keV",
                expected=f"0 to {HIGHEST_THRESHOLD_KEV:g} keV",
            )
        if self.threshold_keV is not None and self.counting is False:
            raise InputError(
                "instrument threshold_keV",
                received=f"{self.threshold_keV:g} keV for an integrating detector",
                expected="no threshold, or counting = true",
            )
        if self.interlayer is not None and self.back_scintillator is None:
            raise InputError(
                "instrument interlayer",
                received="+".join(map(str, self.interlayer)) or "no layer",
                expected="back_scintillator beside it: the layer behind it that takes the second image",
            )
        if self.belt_axis not in (None, "row", "column"):
            raise InputError("instrument belt_axis", received=self.belt_axis, expected="row or column")

    @property
    def dual_layer(self) -> bool:
        """A second sensitive layer behind the first takes an image of its own."""
        return bool(self.back_scintillator)

    def of_layer(self, layer: str) -> "Instrument":
        """The instrument as one layer of a dual-layer panel sees it: what lies before the back layer is its cover.

        Raises:
            InputError: another word than front or back, or a back layer that was not declared.
        """
        if layer == "front":
            return self
        if layer != "back" or not self.dual_layer:
            raise InputError(
                "layer",
                received=layer,
                expected="front" if not self.dual_layer else "front or back",
                remedy=""
                if self.dual_layer
                else "declare the panel's back_scintillator to work with its back layer, or take a twin of the front one",
            )
        before = (*(self.detector_cover or ()), *(self.scintillator or ()), *(self.interlayer or ()))
        return replace(
            self, detector_cover=before, scintillator=self.back_scintillator, interlayer=None, back_scintillator=None
        )

    def unlike(self, other: "Instrument") -> tuple[str, str] | None:
        """What shows that another instrument is not this one: its word and this one's; None: nothing that both state.

        Pitch, bits, anode and whether photons are counted: what no change of setting or distance changes.
        """
        if self.pixel_mm and other.pixel_mm and abs(math.log(other.pixel_mm / self.pixel_mm)) > _SAME_PITCH:
            return f"pixels of {other.pixel_mm:g} mm", f"{self.pixel_mm:g} mm"
        for name, text in (("bits", "{} bits"), ("anode", "an anode of {}"), ("counting", "counting = {}")):
            own, there = getattr(self, name), getattr(other, name)
            if own is not None and there is not None and own != there:
                return text.format(there), text.format(own)
        return None

    @property
    def magnification(self) -> float | None:
        """Source-detector over source-object distance, or None where one is unknown."""
        if self.source_detector_mm is None or self.source_object_mm is None:
            return None
        return self.source_detector_mm / self.source_object_mm

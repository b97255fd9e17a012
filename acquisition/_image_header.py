"""The words of a header that raytwin has a place for, and metals by the names that headers give them."""

import math
from dataclasses import dataclass
from typing import Any

from .setting import Filter

# names of filter and target metals, as DICOM's terms (PS3.3 C.8.7.10, C.8.11.3) and scanner menus have them
_SYMBOLS = {
    "ALUMINUM": "Al",
    "ALUMINIUM": "Al",
    "BERYLLIUM": "Be",
    "CARBON": "C",
    "CHROMIUM": "Cr",
    "COPPER": "Cu",
    "IRON": "Fe",
    "LEAD": "Pb",
    "MOLYBDENUM": "Mo",
    "NICKEL": "Ni",
    "NIOBIUM": "Nb",
    "RHENIUM": "Re",
    "RHODIUM": "Rh",
    "SILVER": "Ag",
    "TANTALUM": "Ta",
    "TIN": "Sn",
    "TITANIUM": "Ti",
    "TUNGSTEN": "W",
    "ZINC": "Zn",
    "ZIRCONIUM": "Zr",
}
_ELEMENTS = frozenset(_SYMBOLS.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageHeader:
    """What one file says of itself; None: nothing.

    Fields: kV; current_mA; exposure_ms (of one frame); filters (in the beam's order; () = none); averaged; frame_interval_ms;
    anode (symbol); pixel_mm (pitch of the detector); bits; focal_spot_mm; source_detector_mm; source_object_mm; corrected
    (subset of `offset`, `gain`, `defects`, or None); time_s (of the first frame, by the file's clock); number (of the file in
    its series); series (identifier of the series); series_number (its place); label (text by
    which people know it); notes (what was not understood).
    """

    kV: float | None = None
    current_mA: float | None = None
    exposure_ms: float | None = None
    filters: tuple[Filter, ...] | None = None
    averaged: int | None = None
    frame_interval_ms: float | None = None
    anode: str | None = None
    pixel_mm: float | None = None
    bits: int | None = None
    focal_spot_mm: float | None = None
    source_detector_mm: float | None = None
    source_object_mm: float | None = None
    corrected: frozenset[str] | None = None
    time_s: float | None = None
    number: int | None = None
    shape: tuple[int, int] | None = None
    series: str = ""
    series_number: int | None = None
    label: str = ""
    notes: tuple[str, ...] = ()


def metal_of(name: str) -> str | None:
    """The material that a header's word means (`COPPER`, `Copper`, `Cu`), or None where it is none of those known."""
    text = name.strip()
    if text in _ELEMENTS:
        return text
    return _SYMBOLS.get(text.upper())


def number_of_text(value: Any) -> float | None:
    """A finite number of 0 or more out of a header's entry, or None; a unit behind the number is passed over."""
    try:
        number = float(str(value).split()[0])
    except (ValueError, IndexError):
        return None
    return number if math.isfinite(number) and number >= 0 else None

"""Words of an acquisition file: its format, and what kinds, roles and corrections of series it knows."""

from collections.abc import Mapping, Sequence
from typing import Any

FORMAT = "raytwin-acquisition"
VERSION = 1
KINDS = ("dark", "flat", "object", "afterglow")
SCENE_KINDS = ("wedge", "slab", "edge", "disc", "product")
CORRECTIONS = ("offset", "gain", "defects", "log")
ROLES = ("calibration", "evaluation")
PANEL_LAYERS = ("front", "back")
ERROR = "error"  # attribute of a series without frames: why an importer went on without it


# numbers of a series, each with its unit and the smallest that it may be (`lowest`) or may not (`above`)
_NUMBERS: Mapping[str, Mapping[str, Any]] = {
    "index": {"lowest": 0},
    "kV": {"above": 0, "unit": "kV"},
    "current_mA": {"above": 0, "unit": "mA"},
    "power_W": {"above": 0, "unit": "W"},
    # 0 ms: shorter than the clock tells, or the light is pulsed; there is then no load and no setting
    "exposure_ms": {"lowest": 0, "unit": "ms"},
    "averaged": {"lowest": 1},
    "binning": {"lowest": 1},
    "frame_interval_ms": {"above": 0, "unit": "ms"},
    "belt_speed_mm_s": {"unit": "mm/s"},
    "panel_rotation_deg": {"unit": "degrees"},
    "source_object_mm": {"above": 0, "unit": "mm"},
    "source_detector_mm": {"above": 0, "unit": "mm"},
    "photons_per_pixel": {"lowest": 0},
}


def bounds_of(word: str, kind: str) -> Mapping[str, Any]:
    """Unit and smallest value of a number of a series, as `checked_number` takes them; kind: of the series."""
    bounds = _NUMBERS[word]
    if kind in ("dark", "afterglow") and word in ("kV", "current_mA", "power_W"):
        # with the beam off, 0 kV, 0 mA or 0 W is how some systems write "no beam"
        return {"lowest": 0, "unit": bounds["unit"]}
    return bounds


def text_from_shape(shape: Sequence[int] | None) -> str:
    """A shape as messages tell it: `480 x 640`, or `?` where there is none."""
    return "?" if shape is None else " x ".join(str(length) for length in shape)

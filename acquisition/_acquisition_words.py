"""Words of an acquisition file: its format, and what kinds, roles and corrections of series it knows."""

from collections.abc import Sequence

FORMAT = "raytwin-acquisition"
VERSION = 1
KINDS = ("dark", "flat", "object", "afterglow")
SCENE_KINDS = ("wedge", "slab", "edge", "disc", "product")
CORRECTIONS = ("offset", "gain", "defects", "log")
ROLES = ("calibration", "evaluation")
PANEL_LAYERS = ("front", "back")
ERROR = "error"  # attribute of a series without frames: why an importer went on without it


def text_from_shape(shape: Sequence[int] | None) -> str:
    """A shape as messages tell it: `480 x 640`, or `?` where there is none."""
    return "?" if shape is None else " x ".join(str(length) for length in shape)

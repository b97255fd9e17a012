"""raytwin.lab: a virtual X-ray line whose truth is known. It shares no physics with the twin."""

from importlib import import_module
from typing import Any

_PLACES = {
    "Bench": "bench",
    "Bone": "objects",
    "Case": "cases",
    "EFFECTS": "effects",
    "EffectRequest": "effects",
    "FAMILIES": "families",
    "Family": "families",
    "Fillet": "objects",
    "GEOMETRIES": "session",
    "GROUPS": "session",
    "LabSystem": "system",
    "PROTOCOLS": "protocols",
    "Product": "objects",
    "RenderedScene": "bench",
    "SESSIONS": "session",
    "Slab": "objects",
    "Unkindness": "unkindness",
    "aperture_share": "response",
    "compute_incidence": "response",
    "compute_level": "response",
    "compute_truth": "truth",
    "detector_maps": "system",
    "draw_case": "cases",
    "request_from_text": "effects",
    "run_protocol": "protocols",
    "sample_system": "families",
    "sample_unkindness": "unkindness",
    "system_of_seed": "protocols",
}

__all__ = [
    "EFFECTS",
    "FAMILIES",
    "GEOMETRIES",
    "GROUPS",
    "PROTOCOLS",
    "SESSIONS",
    "Bench",
    "Bone",
    "Case",
    "EffectRequest",
    "Family",
    "Fillet",
    "LabSystem",
    "Product",
    "RenderedScene",
    "Slab",
    "Unkindness",
    "aperture_share",
    "compute_incidence",
    "compute_level",
    "compute_truth",
    "detector_maps",
    "draw_case",
    "request_from_text",
    "run_protocol",
    "sample_system",
    "sample_unkindness",
    "system_of_seed",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_PLACES[name]}", __name__), name)

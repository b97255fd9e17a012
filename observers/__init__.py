"""Model observers: detectability, POD and a90 of foreign objects at any setting from the twin alone, without images or training.

Files:
    observe             setting to a90
    detectors           detectability of linear observers
    objects             foreign objects as signals
    line_images         signals and noise of log images at many settings
    frequencies         spatial frequencies of a patch
    texture             power spectrum of a product's texture
    reference_objects   objects and texture of reference images
    search              threshold of a search
    efficiency          an observer brought to networks; efficiency_io: its file
    changes             what limits a setting
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .changes import factors_of_changes as factors_of_changes
    from .detectors import DETECTORS as DETECTORS
    from .efficiency import Efficiency as Efficiency
    from .efficiency import MeasuredSize as MeasuredSize
    from .efficiency import check_materials as check_materials
    from .efficiency import fit_efficiency as fit_efficiency
    from .efficiency import materials_seen as materials_seen
    from .efficiency import predicted_sizes as predicted_sizes
    from .efficiency_io import read_efficiency as read_efficiency
    from .efficiency_io import write_efficiency as write_efficiency
    from .frequencies import frequency_bins as frequency_bins
    from .frequencies import object_spectrum as object_spectrum
    from .line_images import IMAGES as IMAGES
    from .line_images import TEXTURED as TEXTURED
    from .line_images import LineImages as LineImages
    from .objects import ForeignObjects as ForeignObjects
    from .objects import Shape as Shape
    from .objects import objects_of_references as objects_of_references
    from .objects import objects_of_shape as objects_of_shape
    from .observe import Observed as Observed
    from .observe import Observer as Observer
    from .observe import observe_settings as observe_settings
    from .reference_objects import Sight as Sight
    from .reference_objects import sight_of_references as sight_of_references
    from .search import independent_places as independent_places
    from .search import search_threshold as search_threshold
    from .texture import ProductTexture as ProductTexture
    from .texture import texture_of_references as texture_of_references

# public name -> module; imported when first asked for
_HOME = {
    "DETECTORS": "detectors",
    "Efficiency": "efficiency",
    "ForeignObjects": "objects",
    "IMAGES": "line_images",
    "TEXTURED": "line_images",
    "LineImages": "line_images",
    "MeasuredSize": "efficiency",
    "Observed": "observe",
    "Observer": "observe",
    "ProductTexture": "texture",
    "Shape": "objects",
    "check_materials": "efficiency",
    "factors_of_changes": "changes",
    "fit_efficiency": "efficiency",
    "frequency_bins": "frequencies",
    "independent_places": "search",
    "materials_seen": "efficiency",
    "object_spectrum": "frequencies",
    "Sight": "reference_objects",
    "sight_of_references": "reference_objects",
    "objects_of_references": "objects",
    "objects_of_shape": "objects",
    "observe_settings": "observe",
    "predicted_sizes": "efficiency",
    "read_efficiency": "efficiency_io",
    "search_threshold": "search",
    "texture_of_references": "texture",
    "write_efficiency": "efficiency_io",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

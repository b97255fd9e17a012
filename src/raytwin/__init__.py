"""raytwin: a calibrated digital twin of an X-ray inspection line.

    import raytwin as rt
    twin = rt.calibrate("session.h5")
    twin.predict(kV=60, power_W=30, exposure_ms=20, filter="Cu:0.1")

Commands of `raytwin` have their functions here; docs/python.md lists them. Names are loaded when they are first asked for.
The packages (`raytwin.materials`, `raytwin.spectra`, ...) hold the functions on arrays; see ARCHITECTURE.md for the map.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from .errors import FileFormatError, FitError, InputError, MissingDependencyError, RaytwinError

if TYPE_CHECKING:
    from .acquisition.setting import Filter as Filter
    from .acquisition.setting import Setting as Setting
    from .api.about import export as export
    from .api.about import info as info
    from .api.beams import contrast as contrast
    from .api.beams import mu as mu
    from .api.beams import spectrum as spectrum
    from .api.campaigns import sweep as sweep
    from .api.comparisons import compare as compare
    from .api.curves import fit_pod as fit_pod
    from .api.images import detect as detect
    from .api.images import generate as generate
    from .api.images import read_dataset as read_dataset
    from .api.images import train as train
    from .api.imports import import_data as import_data
    from .api.observers import calibrate_observer as calibrate_observer
    from .api.observers import observe as observe
    from .api.reports import report as report
    from .api.sessions import check as check
    from .api.sessions import diagnose as diagnose
    from .api.sessions import lab_session as lab_session
    from .api.study_plans import plan as plan
    from .api.twins import calibrate as calibrate
    from .api.twins import open_acquisition as open_acquisition
    from .api.twins import predict as predict
    from .api.twins import read_twin as read_twin
    from .api.twins import validate as validate

__version__ = "0.2.0"

# public name -> module; imported when first asked for
_HOME = {
    "Filter": "acquisition.setting",
    "Setting": "acquisition.setting",
    "calibrate": "api.twins",
    "calibrate_observer": "api.observers",
    "check": "api.sessions",
    "compare": "api.comparisons",
    "contrast": "api.beams",
    "detect": "api.images",
    "diagnose": "api.sessions",
    "export": "api.about",
    "fit_pod": "api.curves",
    "generate": "api.images",
    "import_data": "api.imports",
    "info": "api.about",
    "lab_session": "api.sessions",
    "mu": "api.beams",
    "observe": "api.observers",
    "open_acquisition": "api.twins",
    "plan": "api.study_plans",
    "predict": "api.twins",
    "read_dataset": "api.images",
    "read_twin": "api.twins",
    "report": "api.reports",
    "spectrum": "api.beams",
    "sweep": "api.campaigns",
    "train": "api.images",
    "validate": "api.twins",
}

__all__ = [
    "FileFormatError",
    "Filter",
    "FitError",
    "InputError",
    "MissingDependencyError",
    "RaytwinError",
    "Setting",
    "__version__",
    "calibrate",
    "calibrate_observer",
    "check",
    "compare",
    "contrast",
    "detect",
    "diagnose",
    "export",
    "fit_pod",
    "generate",
    "import_data",
    "info",
    "lab_session",
    "mu",
    "observe",
    "open_acquisition",
    "plan",
    "predict",
    "read_dataset",
    "read_twin",
    "report",
    "spectrum",
    "sweep",
    "train",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f".{_HOME[name]}", __name__), name)
    # with name and object, Python's message asks `Did you mean`
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name, obj=sys.modules[__name__])


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])

"""raytwin: a calibrated digital twin of an X-ray inspection line.

The rooms (`raytwin.materials`, `raytwin.spectra`, ...) hold the functions; see ARCHITECTURE.md for the map.
"""

from .errors import FileFormatError, FitError, InputError, MissingDependencyError, RaytwinError

__version__ = "0.1.0"

__all__ = [
    "FileFormatError",
    "FitError",
    "InputError",
    "MissingDependencyError",
    "RaytwinError",
    "__version__",
]

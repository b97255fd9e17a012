"""Pixel size in the metadata of OME-TIFF and ImageJ files; the resolution of any other TIFF means nothing about a detector."""

import html
import logging
import re
from pathlib import Path
from typing import Any

from ._image_header import ImageHeader, number_of_text

_MM_PER = {"m": 1000.0, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "micron": 1e-3, "nm": 1e-6}
_PIXEL_SIZE = re.compile(r'PhysicalSizeX="([^"]+)"')
_PIXEL_UNIT = re.compile(r'PhysicalSizeXUnit="([^"]+)"')


def tiff_header(path: Path) -> ImageHeader:
    """Pixel size of an OME-TIFF (PhysicalSizeX, micrometres by default) or of an ImageJ file that states a unit.

    A file that cannot be read says nothing here; reading its picture names the fault.
    """
    import tifffile

    def nobody(_: logging.LogRecord) -> bool:
        return False

    logger = logging.getLogger("tifffile")
    logger.addFilter(nobody)
    try:
        with tifffile.TiffFile(path) as file:
            text = file.ome_metadata if file.is_ome else None
            if text:
                size, unit = _PIXEL_SIZE.search(text), _PIXEL_UNIT.search(text)
                factor = _MM_PER.get(html.unescape(unit.group(1)) if unit else "µm")
                return ImageHeader(pixel_mm=_size_mm(number_of_text(size.group(1)) if size else None, factor))
            if file.is_imagej:
                unit_text = str((file.imagej_metadata or {}).get("unit", "")).replace("\\u00B5", "µ")
                return ImageHeader(pixel_mm=_size_mm(_imagej_size(file.pages[0]), _MM_PER.get(unit_text)))
    except Exception:  # tifffile raises struct, value, index and codec errors at damaged files
        return ImageHeader()
    finally:
        logger.removeFilter(nobody)
    return ImageHeader()


def _imagej_size(page: Any) -> float | None:
    """ImageJ's unit for a pixel, from XResolution (pixels in a unit)."""
    tag = page.tags.get("XResolution")
    if tag is None:
        return None
    above, below = tag.value
    return below / above if above else None


def _size_mm(size: float | None, factor: float | None) -> float | None:
    return size * factor if size and factor else None

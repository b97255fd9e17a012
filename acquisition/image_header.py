"""What an image file says of itself beside its numbers: the setting, the geometry, the detector."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ._image_files import DICOM_ENDINGS, FABIO_ENDINGS, HIS_ENDINGS, TIFF_ENDINGS
from ._image_header import ImageHeader

SETTING_WORDS = ("kV", "current_mA", "exposure_ms", "filters", "averaged", "frame_interval_ms")
INSTRUMENT_WORDS = ("anode", "pixel_mm", "bits", "focal_spot_mm", "source_detector_mm", "source_object_mm")
# measured values scatter: what differs by less is one setting, as power and current of a setting may (setting.py)
_SAME = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """What several files say together: values (word -> value that all agree on), differing (word -> two values)."""

    values: dict[str, Any]
    differing: dict[str, tuple[Any, Any]]


def read_image_header(path: Path) -> ImageHeader:
    """What a file's header says; a format without such words says nothing.

    Args:
        path: an image file.

    Returns:
        Values that the file states; None where it does not.

    Raises:
        FileFormatError: a header that cannot be read.
        MissingDependencyError: a format whose library is not installed.
    """
    ending = path.suffix.lower()
    if ending in DICOM_ENDINGS:
        from ._dicom_files import dicom_header

        return dicom_header(path)
    if ending in HIS_ENDINGS:
        from ._his_files import his_header

        return his_header(path)
    if ending in FABIO_ENDINGS:
        from ._fabio_files import fabio_header

        return fabio_header(path)
    if ending in TIFF_ENDINGS:
        from ._tiff_header import tiff_header

        return tiff_header(path)
    return ImageHeader()


def agreement(headers: list[ImageHeader]) -> Agreement:
    """What the headers of one series say together.

    Numbers that differ by less than 1 % agree, and the first stands for all. A word that some files leave out is taken from
    the others.

    Example:
        >>> agreement([ImageHeader(kV=40.0), ImageHeader(kV=40.1)]).values["kV"]
        40.0
        >>> agreement([ImageHeader(kV=40.0), ImageHeader(kV=90.0)]).differing["kV"]
        (40.0, 90.0)
    """
    values: dict[str, Any] = {}
    differing: dict[str, tuple[Any, Any]] = {}
    for field in fields(ImageHeader):
        if field.name not in (*SETTING_WORDS, *INSTRUMENT_WORDS, "corrected"):
            continue
        told = [value for value in (getattr(header, field.name) for header in headers) if value is not None]
        other = next((value for value in told[1:] if not alike(told[0], value)), None)
        if other is not None:
            differing[field.name] = (told[0], other)
        elif told:
            values[field.name] = told[0]
    return Agreement(values=values, differing=differing)


def alike(first: Any, second: Any) -> bool:
    """Whether two entries of headers mean the same: numbers within 1 %, all else exactly."""
    if isinstance(first, int | float) and isinstance(second, int | float):
        return abs(first - second) <= _SAME * max(abs(first), abs(second))
    return bool(first == second)

"""DICOM and DICONDE images: detector numbers after the modality transformation, and the setting in their tags.

Tags are those of DICOM PS3.3 (X-Ray Acquisition, X-Ray Filtration, DX Detector, DX Image modules); DICONDE (ASTM E2339, E2699)
keeps them and adds group 0014. Names and numbers of persons or components are not taken over.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError, MissingDependencyError
from ._image_header import ImageHeader, metal_of
from ._picture_checks import damaged, missing_library, one_channel
from .setting import Filter


def is_dicom(path: Path) -> bool:
    """Whether a file begins as DICOM files do: `DICM` behind 128 bytes (PS3.10, 7.1)."""
    try:
        with path.open("rb") as stream:
            return stream.read(132)[128:] == b"DICM"
    except OSError:
        return False


def iter_dicom(path: Path) -> Iterator[NDArray[Any]]:
    """Yield the frames (row, column), in a direction in which more beam gives larger numbers.

    Rescale slope and intercept or the modality table are applied. The photometric interpretation only says how a picture is
    shown and changes no number; where Pixel Intensity Relationship Sign is -1, numbers are counted down from full scale.

    Raises:
        FileFormatError: no DICOM, damaged, in colour, or of values that are not proportional to the beam.
        MissingDependencyError: pydicom is not installed, or the decoder of a compression.
    """
    with _decoding(path) as dicom:
        from pydicom.pixels import apply_modality_lut, iter_pixels

        header = dicom.dcmread(path, stop_before_pixels=True)
        relation = str(header.get("PixelIntensityRelationship", "") or "LIN")
        if relation != "LIN":
            raise FileFormatError(
                str(path),
                received=f"values of Pixel Intensity Relationship {relation}",
                expected="LIN, proportional to the beam's intensity",
                remedy="export the images for processing, not those for display",
            )
        changed = any(name in header for name in ("RescaleSlope", "RescaleIntercept", "ModalityLUTSequence"))
        falling = _number(header, "PixelIntensityRelationshipSign") == -1

        def real(values: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(apply_modality_lut(values, header)) if changed else values

        for frame in iter_pixels(path, raw=True):
            values = real(np.asarray(frame))
            if falling:
                full = np.asarray([2 ** int(header.BitsStored) - 1], dtype=np.int64)
                values = real(full)[0] - values
            yield one_channel(path, values)


def dicom_header(path: Path) -> ImageHeader:
    """The setting, geometry and detector in a file's tags.

    Raises:
        FileFormatError: no DICOM file, or damaged.
        MissingDependencyError: pydicom is not installed.
    """
    with _decoding(path) as dicom:
        tags = dicom.dcmread(path, stop_before_pixels=True)
        return _header(tags)


def _header(tags: Any) -> ImageHeader:
    notes = []
    current_mA = _first(tags, ("XRayTubeCurrentInuA", 1e-3), ("XRayTubeCurrentInmA", 1.0), ("XRayTubeCurrent", 1.0))
    exposure_ms = _first(tags, ("ExposureTimeInuS", 1e-3), ("ExposureTimeInms", 1.0), ("ExposureTime", 1.0))
    load_mAs = _first(tags, ("ExposureInuAs", 1e-3), ("ExposureInmAs", 1.0), ("Exposure", 1.0))
    if load_mAs and current_mA and not exposure_ms:
        exposure_ms = 1000.0 * load_mAs / current_mA
    elif load_mAs and exposure_ms and not current_mA:
        current_mA = 1000.0 * load_mAs / exposure_ms
    filters, problem = _filters(tags)
    if problem:
        notes.append(problem)
    anode = metal_of(str(tags.get("AnodeTargetMaterial", "") or ""))
    integrated = _number(tags, "NumberOfFramesIntegrated")
    if integrated and integrated > 1:
        notes.append(f"{integrated:g} frames integrated (0014,3012): taken as their mean")
    if _number(tags, "PixelIntensityRelationshipSign") == -1:
        notes.append("numbers that fall with the beam (0028,1041): counted down from full scale")
    if str(tags.get("PresentationIntentType", "")) == "FOR PRESENTATION":
        notes.append("images for presentation (0008,0068): they may have been processed")
    if str(tags.get("LossyImageCompression", "")) == "01":
        notes.append("lossy compression (0028,2110): noise cannot be measured")
    pitch = next(
        (
            value
            for name in ("DetectorElementSpacing", "ImagerPixelSpacing", "PixelSpacing", "NominalScannedPixelSpacing")
            if (value := _number(tags, name))
        ),
        None,
    )
    words = [str(tags.get(name, "") or "") for name in ("SeriesDescription", "ProtocolName", "ImageComments")]
    return ImageHeader(
        kV=_number(tags, "KVP"),
        current_mA=current_mA,
        exposure_ms=exposure_ms,
        filters=filters,
        averaged=int(integrated) if integrated and integrated >= 1 and integrated == int(integrated) else None,
        frame_interval_ms=_number(tags, "FrameTime") or None,
        anode=anode,
        pixel_mm=pitch,
        bits=int(tags.BitsStored) if "BitsStored" in tags else None,
        focal_spot_mm=_number(tags, "FocalSpots"),
        source_detector_mm=_number(tags, "DistanceSourceToDetector") or None,
        source_object_mm=_number(tags, "DistanceSourceToPatient") or None,
        time_s=_time_s(tags),
        number=_whole(tags, "InstanceNumber"),
        shape=(int(tags.Rows), int(tags.Columns)) if "Rows" in tags and "Columns" in tags else None,
        series=str(tags.get("SeriesInstanceUID", "") or ""),
        series_number=_whole(tags, "SeriesNumber"),
        label=" ".join(word for word in words if word),
        notes=tuple(notes),
    )


@contextmanager
def _decoding(path: Path) -> Iterator[Any]:
    try:
        import pydicom
    except ImportError:
        raise missing_library(path, what="a DICOM file", extra="dicom") from None
    try:
        with warnings.catch_warnings():
            # values of a wrong form are common and are judged here, one by one
            warnings.simplefilter("ignore")
            yield pydicom
    except (InputError, MissingDependencyError, GeneratorExit):
        raise
    except Exception as error:  # pydicom and its decoders raise whatever they like at damaged files
        text = str(error)
        if "plugins" in text and "missing" in text:
            raise MissingDependencyError(
                f"{path}: got compressed images; expected a decoder for them; install it with"
                " `pip install pylibjpeg pylibjpeg-libjpeg pylibjpeg-openjpeg`, or export them uncompressed"
            ) from None
        raise damaged(path, error) from None


def _number(tags: Any, name: str) -> float | None:
    """The first value of a tag as a finite number, or None where it is absent, empty or no number."""
    value = tags.get(name)
    if value is None or value == "":
        return None
    if isinstance(value, list | tuple) or type(value).__name__ == "MultiValue":
        if not len(value):
            return None
        value = value[0]
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if np.isfinite(number) else None


def _whole(tags: Any, name: str) -> int | None:
    number = _number(tags, name)
    return None if number is None else int(number)


def _first(tags: Any, *places: tuple[str, float]) -> float | None:
    """The first of several tags that is there, each with the factor to the unit; the finer ones are named first."""
    for name, factor in places:
        number = _number(tags, name)
        if number is not None and number >= 0:
            return number * factor
    return None


def _list(tags: Any, name: str) -> list[Any]:
    value = tags.get(name)
    if value is None or value == "":
        return []
    return list(value) if isinstance(value, list | tuple) or type(value).__name__ == "MultiValue" else [value]


def _filters(tags: Any) -> tuple[tuple[Filter, ...] | None, str]:
    """Filter materials with the middle of their smallest and largest thickness (0018,7050; 7052; 7054, mm)."""
    names = [str(name) for name in _list(tags, "FilterMaterial")]
    if not names:
        return ((), "") if str(tags.get("FilterType", "")).upper() == "NONE" else (None, "")
    lowest = _list(tags, "FilterThicknessMinimum")
    highest = _list(tags, "FilterThicknessMaximum") or lowest
    lowest = lowest or highest
    if not len(names) == len(lowest) == len(highest):
        return None, f"filter {', '.join(names)} (0018,7050) without a thickness each: not taken"
    layers = []
    for name, low, high in zip(names, lowest, highest, strict=True):
        material = metal_of(name)
        if material is None:
            return None, f"filter {name} (0018,7050) is no material known: not taken"
        layers.append(Filter(material=material, thickness_mm=0.5 * (float(low) + float(high))))
    return tuple(layers), ""


def _time_s(tags: Any) -> float | None:
    text = str(tags.get("AcquisitionDateTime", "") or "")
    if not text:
        for day, hour in (("AcquisitionDate", "AcquisitionTime"), ("ContentDate", "ContentTime")):
            if tags.get(day) and tags.get(hour):
                text = f"{tags.get(day)}{tags.get(hour)}"
                break
    text = text.replace(":", "").split("+")[0].split("-")[0].strip()
    for form in ("%Y%m%d%H%M%S.%f", "%Y%m%d%H%M%S"):
        try:
            return datetime.strptime(text, form).replace(tzinfo=UTC).timestamp()
        except ValueError:
            continue
    return None

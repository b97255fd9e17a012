"""Acquisitions for other programs: DICONDE, NXtomo, and TIFF with pixel pitch and setting in its tags.

tiff    <series>.tif (OME-TIFF stacks) with a sidecar; `raytwin import images` reads the folder back
nxtomo  scan.nxs: raw frames of all series with image_key 0 object, 1 flat, 2 dark; `raytwin import nxtomo` reads it back
dicom   <series>/0001.dcm and on, digital X-ray images for processing with DICONDE's tags (extra `dicom`);
        `raytwin import dicom` reads the folder back
"""

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MissingDependencyError
from ..files import whole_folder
from .acquisition_io import AcquisitionFile, Series
from .instrument import LAYER_FIELDS
from .scenes import Scene
from .setting import Filter, text_from_filters
from .tiff_tags import write_tiff

ACQUISITION_FORMATS = ("tiff", "nxtomo", "dicom")
_IMAGE_KEYS = {"object": 0, "flat": 1, "dark": 2}
_NUMBERS = (
    *("kV", "current_mA", "power_W", "exposure_ms", "frame_interval_ms", "belt_speed_mm_s"),
    *("source_object_mm", "source_detector_mm", "photons_per_pixel"),
)
# DICOM's terms for filter and target materials (PS3.3 C.8.7.10 and C.8.11.3)
_DICOM_TERMS = {
    "Al": "ALUMINUM",
    "Cu": "COPPER",
    "Mo": "MOLYBDENUM",
    "Nb": "NIOBIUM",
    "Pb": "LEAD",
    "Rh": "RHODIUM",
    "Ag": "SILVER",
    "Sn": "TIN",
    "Ti": "TITANIUM",
    "W": "TUNGSTEN",
}

Count = Callable[[int], None]


def export_acquisition(
    acquisition: AcquisitionFile,
    folder: str | os.PathLike[str],
    *,
    to: str,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write an acquisition in the form that other programs read; the folder appears whole or not at all.

    Args:
        acquisition: an open acquisition file.
        folder: new or empty.
        to: `tiff`, `nxtomo` or `dicom`.
        progress: called with (frames done, frames in all).

    Returns:
        File name -> what it holds, and warnings.

    Raises:
        InputError: another form, a folder with something in it, frames that the form cannot hold.
        MissingDependencyError: `dicom` without pydicom.
    """
    writers = {"tiff": _write_tiffs, "nxtomo": _write_nxtomo, "dicom": _write_dicom}
    if to not in writers:
        raise InputError(
            "to", received=repr(to), expected="one of " + ", ".join(ACQUISITION_FORMATS) + ", zarr for an acquisition"
        )
    total = sum(series.n_frames for series in acquisition.series)
    done = 0

    def count(frames: int) -> None:
        nonlocal done
        done += frames
        if progress is not None:
            progress(done, total)

    with whole_folder(folder) as place:
        files, warnings = writers[to](acquisition, place, count)
    return files, tuple(warnings)


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name).strip(".") or "series"


def _safe_names(names: list[str]) -> dict[str, str]:
    """A file name for each of several names, unlike all others."""
    found: dict[str, str] = {}
    for number, name in enumerate(names):
        safe = _safe(name)
        found[name] = safe if safe.lower() not in {one.lower() for one in found.values()} else f"{safe}_{number}"
    return found


def _frames(series: Series, count: Count) -> Iterator[NDArray[Any]]:
    for piece in series.iter_frames():
        for frame in piece:
            yield frame
            count(1)


# TIFF


def _write_tiffs(acquisition: AcquisitionFile, place: Path, count: Count) -> tuple[dict[str, str], list[str]]:
    names = _safe_names([series.name for series in acquisition.series])
    lines = _instrument_lines(acquisition)
    for series in acquisition.series:
        file_name = f"{names[series.name]}.tif"
        words = _words(series)
        write_tiff(
            place / file_name,
            _frames(series, count),
            shape=(series.n_frames, *series.shape),
            dtype=series.dtype,
            pixel_mm=acquisition.instrument.pixel_mm,
            words={key: str(value) for key, value in words.items()},
        )
        lines += ["", "[[series]]", f"name = {_toml(series.name)}", f"files = {_toml(file_name)}"]
        lines += [f"{key} = {_toml(value)}" for key, value in words.items()]
    for name, scene in acquisition.scenes.items():
        lines += _write_scene(place, name, scene)
    (place / "raytwin.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    files = {"<series>.tif": "frames in DN (OME-TIFF), pitch and setting in the tags"}
    files["raytwin.toml"] = "`raytwin import images` reads the folder back"
    warnings = []
    if any(series.time_s is not None for series in acquisition.series):
        warnings.append("the times of the frames are left out")
    if acquisition.instrument.pixel_mm is None:
        warnings.append("the pixel pitch is not known: no scale in the tags")
    return files, warnings


def _instrument_lines(acquisition: AcquisitionFile) -> list[str]:
    lines = ["[instrument]"]
    for one in fields(acquisition.instrument):
        value = getattr(acquisition.instrument, one.name)
        if value is not None:
            lines.append(f"{one.name} = {_toml(text_from_filters(value) if one.name in LAYER_FIELDS else value)}")
    return lines


def _words(series: Series) -> dict[str, Any]:
    """The words of a series in a sidecar."""
    words: dict[str, Any] = {"kind": series.kind, "index": max(series.index, 0)}
    words |= {name: value for name in _NUMBERS if (value := getattr(series, name)) is not None}
    words["filter"] = text_from_filters(series.filters)
    words["averaged"] = series.averaged
    if series.panel_rotation_deg:
        words["panel_rotation_deg"] = series.panel_rotation_deg
    words |= {name: value for name in ("scene", "role") if (value := getattr(series, name))}
    if series.corrected:
        words["corrected"] = "+".join(sorted(series.corrected))
    return words


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    return repr(value.item() if isinstance(value, np.generic) else value)


def _write_scene(place: Path, name: str, scene: Scene) -> list[str]:
    import imageio.v3 as imageio

    folder = Path("scenes") / _safe(name)
    (place / folder).mkdir(parents=True, exist_ok=True)
    lines = ["", "[[scene]]", f"name = {_toml(name)}", f"kind = {_toml(scene.kind or 'product')}"]
    for word in ("product", "foreign_object"):
        if getattr(scene, word):
            lines.append(f"{word} = {_toml(getattr(scene, word))}")
    if np.isfinite(scene.size_mm):
        lines.append(f"size_mm = {_toml(float(scene.size_mm))}")
    for word in ("foreign_object_mask", "product_mask"):
        mask = getattr(scene, word)
        if mask is not None:
            path = folder / f"{word}.png"
            imageio.imwrite(place / path, mask.astype(np.uint8) * 255)
            lines.append(f"{word} = {_toml(path.as_posix())}")
    maps = {}
    for material, thickness_mm in scene.thickness_mm.items():
        path = folder / f"{_safe(material)}.tif"
        write_tiff(place / path, thickness_mm, words={"material": material, "unit": "mm"})
        maps[material] = path.as_posix()
    if maps:
        entries = ", ".join(f"{_toml(material)} = {_toml(path)}" for material, path in maps.items())
        lines.append(f"thickness_mm = {{ {entries} }}")
    return lines


# NXtomo


def _write_nxtomo(acquisition: AcquisitionFile, place: Path, count: Count) -> tuple[dict[str, str], list[str]]:
    taken = [series for series in acquisition.series if series.kind in _IMAGE_KEYS and not series.corrected]
    if not taken:
        raise InputError(acquisition.path, received="no raw dark, flat or object series", expected="one at least")
    shapes = {series.shape for series in taken}
    if len(shapes) > 1:
        told = " and ".join(f"{row} x {column}" for row, column in sorted(shapes))
        raise InputError(
            acquisition.path,
            received=f"frames of {told} pixels",
            expected="frames of one shape",
            remedy="write the series of each shape to an acquisition of their own",
        )
    shape = taken[0].shape
    total = sum(series.n_frames for series in taken)
    whole = all(series.dtype == np.uint16 for series in taken)
    instrument = acquisition.instrument
    with h5py.File(place / "scan.nxs", "w") as file:
        file.attrs.update({"NX_class": "NXroot", "default": "entry"})
        entry = _group(file, "entry", "NXentry")
        entry.attrs["default"] = "data"
        entry["definition"] = "NXtomo"
        described = _group(entry, "instrument", "NXinstrument")
        source = _group(described, "source", "NXsource")
        source["probe"] = "x-ray"
        source["type"] = "Fixed Tube X-ray"
        detector = _group(described, "detector", "NXdetector")
        frames = detector.create_dataset(
            "data", shape=(total, *shape), dtype=np.uint16 if whole else np.float32, chunks=(1, *shape)
        )
        frames.attrs["interpretation"] = "image"
        at = 0
        for series in taken:
            for piece in series.iter_frames():
                frames[at : at + len(piece)] = piece
                at += len(piece)
                count(len(piece))
        detector["image_key"] = np.concatenate(
            [np.full(series.n_frames, _IMAGE_KEYS[series.kind], dtype=np.int32) for series in taken]
        )
        if all(series.exposure_ms is not None for series in taken):
            _with_unit(detector, "count_time", _each(taken, lambda one: (one.exposure_ms or 0.0) / 1000.0), "s")
        if instrument.pixel_mm is not None:
            _with_unit(detector, "x_pixel_size", instrument.pixel_mm, "mm")
            _with_unit(detector, "y_pixel_size", instrument.pixel_mm, "mm")
        if instrument.source_object_mm is not None:
            _with_unit(source, "distance", -instrument.source_object_mm, "mm")
            if instrument.source_detector_mm is not None:
                _with_unit(detector, "distance", instrument.source_detector_mm - instrument.source_object_mm, "mm")
        sample = _group(entry, "sample", "NXsample")
        sample["name"] = next((series.scene for series in taken if series.scene), "sample")
        _with_unit(sample, "rotation_angle", np.zeros(total), "degree")
        data = _group(entry, "data", "NXdata")
        data.attrs.update({"signal": "data"})
        for name, target in (("data", frames), ("image_key", detector["image_key"])):
            data[name] = h5py.SoftLink(target.name)
        data["rotation_angle"] = h5py.SoftLink(sample["rotation_angle"].name)
    warnings = ["rotation angles are not known and stand as 0; kV, current and filter have no place in NXtomo"]
    left = [series.name for series in acquisition.series if series not in taken]
    if left:
        warnings.append("left out (corrected, or afterglow): " + ", ".join(left))
    return {"scan.nxs": f"{total} frames of {len(taken)} series, with image_key"}, warnings


def _group(parent: Any, name: str, nx_class: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group


def _with_unit(group: Any, name: str, value: Any, unit: str) -> None:
    group[name] = value
    group[name].attrs["units"] = unit


def _each(taken: list[Series], value: Callable[[Series], float]) -> NDArray[np.float64]:
    return np.concatenate([np.full(series.n_frames, value(series)) for series in taken])


# DICONDE


def _write_dicom(acquisition: AcquisitionFile, place: Path, count: Count) -> tuple[dict[str, str], list[str]]:
    try:
        import pydicom
        from pydicom.uid import generate_uid
    except ImportError:
        raise MissingDependencyError(
            "to: got 'dicom'; expected the library that writes it; install it with `pip install 'raytwin[dicom]'`"
        ) from None
    names = _safe_names([series.name for series in acquisition.series])
    study = generate_uid()
    warnings = [
        "patient tags hold `raytwin`; series and kind stand in the series description"
        " (component data are for you to fill in)"
    ]
    for number, series in enumerate(acquisition.series, start=1):
        (place / names[series.name]).mkdir()
        tags = _dicom_tags(acquisition, series, warnings)
        tags |= {"StudyInstanceUID": study, "SeriesInstanceUID": generate_uid(), "SeriesNumber": number}
        step, lowest = _stored_step(series)
        if step != 1.0:
            warnings.append(f"series {series.name}: stored in steps of {step:.3g} (rescale slope)")
        for frame_number, frame in enumerate(_frames(series, count), start=1):
            stored = np.rint((frame.astype(np.float64) - lowest) / step).astype("<u2")
            path = place / names[series.name] / f"{frame_number:04d}.dcm"
            _dicom_file(pydicom, tags, stored, frame_number, step, lowest).save_as(path, enforce_file_format=True)
    return {"<series>/*.dcm": "one frame each: digital X-ray image for processing, DICONDE tags"}, warnings


def _stored_step(series: Series) -> tuple[float, float]:
    """Step and lowest value of the 16-bit numbers in which frames are stored: 1 and 0 where they are whole already."""
    if series.dtype == np.uint16:
        return 1.0, 0.0
    lowest, highest, whole = np.inf, -np.inf, True
    for piece in series.iter_frames():
        lowest, highest = min(lowest, float(piece.min())), max(highest, float(piece.max()))
        whole = whole and bool(np.all(piece == np.rint(piece)))
    if whole and lowest >= 0 and highest <= 65535:
        return 1.0, 0.0
    # a DICOM number has 16 characters (VR DS): what is written is what is computed with, and rounding it stays within 16 bits
    step = float(f"{max((highest - lowest) / 65533, 1e-12):.8g}")
    return step, float(f"{lowest:.8g}") - step


def _dicom_tags(acquisition: AcquisitionFile, series: Series, warnings: list[str]) -> dict[str, Any]:
    instrument = acquisition.instrument
    current_mA = series.current_mA
    if current_mA is None and series.power_W is not None and series.kV:
        current_mA = series.power_W / series.kV
    lit = series.kind in ("flat", "object")
    tags: dict[str, Any] = {
        "KVP": series.kV if lit else 0,
        "XRayTubeCurrentInuA": None if current_mA is None else _short(1000 * current_mA),
        "ExposureTimeInuS": None if series.exposure_ms is None else _short(1000 * series.exposure_ms),
        "DistanceSourceToDetector": series.source_detector_mm or instrument.source_detector_mm,
        "DistanceSourceToPatient": series.source_object_mm or instrument.source_object_mm,
        "FocalSpots": None if instrument.focal_spot_mm is None else [instrument.focal_spot_mm],
        "AnodeTargetMaterial": _DICOM_TERMS.get(instrument.anode or ""),
        "DetectorElementSpacing": None if instrument.pixel_mm is None else [instrument.pixel_mm] * 2,
        "ImagerPixelSpacing": None if instrument.pixel_mm is None else [instrument.pixel_mm] * 2,
        "NumberOfFramesIntegrated": series.averaged if series.averaged > 1 else None,
        "SeriesDescription": f"{series.kind} {series.scene or series.name}"[:64],
    }
    if lit:
        tags |= _filter_tags(series.filters, series.name, warnings)
    return {name: value for name, value in tags.items() if value is not None}


def _filter_tags(filters: tuple[Filter, ...], name: str, warnings: list[str]) -> dict[str, Any]:
    if not filters:
        return {"FilterType": "NONE"}
    terms = [_DICOM_TERMS.get(layer.material) for layer in filters]
    if None in terms:
        warnings.append(f"series {name}: DICOM has no term for filter {text_from_filters(filters)}; it is left out")
        return {}
    thickness = [_short(layer.thickness_mm) for layer in filters]
    return {"FilterMaterial": terms, "FilterThicknessMinimum": thickness, "FilterThicknessMaximum": thickness}


def _short(value: float) -> float:
    """A number that fits DICOM's 16 characters."""
    return float(f"{value:.9g}")


def _dicom_file(
    pydicom: Any, tags: dict[str, Any], stored: NDArray[Any], number: int, step: float, lowest: float
) -> Any:
    from pydicom.uid import DigitalXRayImageStorageForProcessing, ExplicitVRLittleEndian, generate_uid

    data = pydicom.Dataset()
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = DigitalXRayImageStorageForProcessing
    data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    data.Modality, data.PresentationIntentType = "DX", "FOR PROCESSING"
    data.PatientName = data.PatientID = "raytwin"
    data.ImageType = ["ORIGINAL", "PRIMARY", ""]
    for name, value in tags.items():
        setattr(data, name, value)
    data.InstanceNumber = number
    data.Rows, data.Columns = stored.shape
    data.SamplesPerPixel, data.PixelRepresentation, data.PhotometricInterpretation = 1, 0, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit = 16, 16, 15
    data.PixelIntensityRelationship, data.PixelIntensityRelationshipSign = "LIN", 1
    data.RescaleSlope, data.RescaleIntercept, data.RescaleType = step, lowest, "US"
    data.PixelData = stored.tobytes()
    return data

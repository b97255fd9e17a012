"""Import of a Nikon XTekCT scan: the `.xtekct` file with its settings, and the TIFF projections beside it.

`SrcToObject`, `SrcToDetector`, `DetectorPixelSizeX` (mm), `XraykV`, `XrayuA`, `Filter_Material` and `Filter_ThicknessMM` are taken;
the projections are `<Name>_0001.tif` and on. Scanners write them corrected by dark and flat and scaled to `WhiteLevel`, and do
not write the exposure time: give it with `--exposure-ms`.
"""

import configparser
import os
import re
from collections.abc import Callable
from pathlib import Path

from ..errors import FileFormatError, InputError
from ._image_files import TIFF_ENDINGS, frame_dtype, iter_images, natural_key
from ._image_header import metal_of, number_of_text
from .acquisition_io import write_acquisition
from .acquisition_writer import SeriesWriter
from .import_report import ImportReport, Skipped
from .instrument import Instrument
from .setting import Filter, text_from_filters

_UNKNOWN = frozenset({"", "unknown", "please define a filter."})


def import_xtekct(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    exposure_ms: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Turn a Nikon scan into an acquisition file with one series of corrected projections.

    Args:
        source: the `.xtekct` file, or a folder that holds one.
        out: acquisition file to write.
        exposure_ms: of a projection, which the file does not state.
        progress: called with (projections done, projections in all).

    Raises:
        InputError: no such file, a folder with several, no projections beside it.
        FileFormatError: a text without [XTekCT], or damaged projections.
    """
    path = _settings_file(Path(source))
    words = _words(path)
    notes = ["projections count as corrected by offset and gain, as the scanner writes them"]
    skipped = []
    filters, problem = _filters(words)
    if problem:
        notes.append(problem)
    if exposure_ms is None:
        notes.append("the file does not state the exposure time: give it with --exposure-ms")
    files = _projections(path, words.get("name", "") or path.stem)
    wanted = number_of_text(words.get("projections", ""))
    if wanted and wanted != len(files):
        skipped.append(Skipped(what=path.name, reason=f"{wanted:g} projections announced, {len(files)} found"))

    def positive(word: str, factor: float = 1.0) -> float | None:
        value = number_of_text(words.get(word, ""))
        return value * factor if value else None

    instrument = Instrument(
        pixel_mm=positive("detectorpixelsizex"),
        source_object_mm=positive("srctoobject"),
        source_detector_mm=positive("srctodetector"),
    )
    kV, current_mA = positive("xraykv"), positive("xrayua", 1e-3)
    scene = re.sub(r"[/\s]+", "_", path.stem) or "sample"
    series: SeriesWriter | None = None
    frames = 0
    with write_acquisition(out, instrument) as writer:
        for number, file in enumerate(files, start=1):
            for image in iter_images(file):
                if series is None:
                    series = writer.add_series(
                        "001_object",
                        kind="object",
                        shape=(image.shape[0], image.shape[1]),
                        dtype=frame_dtype(image),
                        kV=kV,
                        current_mA=current_mA,
                        exposure_ms=exposure_ms,
                        filters=filters,
                        scene=scene,
                        corrected=("offset", "gain"),
                    )
                try:
                    series.append(image)
                except InputError as error:
                    raise FileFormatError(
                        str(file), received=error.received, expected=error.expected, remedy=error.remedy
                    ) from None
                frames += 1
            if progress is not None:
                progress(number, len(files))
    entry = {
        "name": "001_object",
        "kind": "object",
        "frames": frames,
        "kV": kV,
        "current_mA": current_mA,
        "filter": None if filters is None else text_from_filters(filters),
    }
    return ImportReport(
        layout="xtekct",
        source=str(source),
        written=str(out),
        format="acquisition",
        read=(entry,),
        frames=frames,
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


def _settings_file(source: Path) -> Path:
    if source.is_file():
        return source
    if not source.is_dir():
        raise InputError(
            str(source),
            received="no such file or folder",
            expected="an .xtekct file, or its folder",
            remedy="check the path",
        )
    found = sorted(path for path in source.iterdir() if path.suffix.lower() == ".xtekct")
    if len(found) != 1:
        raise InputError(
            str(source),
            received=f"a folder with {len(found)} .xtekct files",
            expected="one",
            remedy="name the file itself",
        )
    return found[0]


def _words(path: Path) -> dict[str, str]:
    parser = configparser.ConfigParser(interpolation=None, strict=False, delimiters=("=",), allow_no_value=True)
    try:
        parser.read_string(path.read_bytes().decode("latin-1"))
    except configparser.Error as error:
        raise FileFormatError(
            str(path), received=f"a text of another form ({str(error).splitlines()[0]})", expected="an .xtekct file"
        ) from None
    if not parser.has_section("XTekCT"):
        raise FileFormatError(
            str(path),
            received=f"sections {', '.join(parser.sections()) or 'none'}",
            expected="[XTekCT] among them",
        )
    words: dict[str, str] = {}
    for section in ("CTPro", "Xrays", "XTekCT"):
        if parser.has_section(section):
            words |= {key: (value or "").strip() for key, value in parser.items(section)}
    return words


def _filters(words: dict[str, str]) -> tuple[tuple[Filter, ...] | None, str]:
    name, thickness = words.get("filter_material"), words.get("filter_thicknessmm")
    if name is None or name.lower() in _UNKNOWN:
        return None, "the file does not state the filter"
    if name.lower() == "none":
        return (), ""
    material, thickness_mm = metal_of(name), number_of_text(thickness or "")
    if material is None or not thickness_mm:
        return None, f"filter {name} of {thickness or 'unknown'} mm is not understood: not taken"
    return (Filter(material=material, thickness_mm=thickness_mm),), ""


def _projections(path: Path, name: str) -> list[Path]:
    form = re.compile(rf"{re.escape(name)}_?\d+")
    found = [
        file
        for file in path.parent.iterdir()
        if file.suffix.lower() in TIFF_ENDINGS and form.fullmatch(file.stem) and file.is_file()
    ]
    if not found:
        raise InputError(
            str(path), received=f"no files {name}_0001.tif and on beside it", expected="the projections of the scan"
        )
    return sorted(found, key=natural_key)

"""Import of a folder of images (TIFF, PNG, FITS, DICOM, HIS, EDF, raw) that a sidecar describes.

The sidecar is `raytwin.toml` in the folder:

    [instrument]                      # every word optional: unknown where absent
    anode = "W"
    pixel_mm = 0.15
    source_object_mm = 990
    source_detector_mm = 1059
    scintillator = "CsI:0.6"
    bits = 16

    [raw]                             # only where there are .raw, .bin or .img files
    rows = 760
    columns = 956
    dtype = "uint16"                  # uint8, uint16, int16, uint32, int32, float32, float64
    byte_order = "little"
    header_bytes = 0

    [[series]]                        # in the order of time; one setting and one scene each
    kind = "dark"                     # dark, flat, object, afterglow
    files = "dark/*.tif"              # below the folder; a list of patterns is taken too
    exposure_ms = 20

    [[series]]
    kind = "flat"
    files = "flat_40kV/*.tif"
    setting = "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05"
    role = "calibration"

    [[series]]                        # one series for every folder that matches
    kind = "object"
    for_each = "products/*"           # its name becomes the scene
    files = "40kV*.tif"               # below that folder
    setting = "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05"

    [[scene]]
    kind = "product"                  # wedge, slab, edge, disc, product
    for_each = "products/*"
    foreign_object_mask = "bone.png"
    product_mask = "product.png"      # optional, as are the words below
    thickness_mm = { pmma = "thickness_pmma.tif" }
    product = "fillet"
    foreign_object = "rib bone"
    size_mm = 3.5
    rows = "rows.csv"                 # where these differ: columns scene, product, foreign_object, size_mm, split

Further words of a series: name, index, kV, current_mA, power_W, exposure_ms, filter, averaged, frame_interval_ms,
belt_speed_mm_s, panel_rotation_deg, source_object_mm, source_detector_mm, photons_per_pixel, scene, corrected
(`offset+gain`), dtype. A scene that is not `for_each` has a `name`.

What the sidecar leaves open is taken from the headers of DICOM, HIS and EDF files and from the pixel size of OME-TIFF and
ImageJ files; where both state it, the sidecar counts and the difference is told.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, InputError
from ..results import counted
from ._acquisition_words import bounds_of
from ._hdf5 import checked_number, named
from ._image_files import (
    IMAGE_ENDINGS,
    TIFF_ENDINGS,
    RawLayout,
    frame_dtype,
    images_left,
    iter_images,
    number_in_cell,
    read_image,
    read_mask,
)
from ._image_header import ImageHeader
from ._sidecar import (
    NAME,
    check_words,
    files_matching,
    folders_matching,
    instrument_of,
    number_of,
    raw_layout_of,
    read_sidecar,
    rows_of,
    tables_of,
    text_of,
)
from .acquisition_io import write_acquisition
from .acquisition_writer import AcquisitionWriter, SeriesWriter
from .image_header import INSTRUMENT_WORDS, SETTING_WORDS, agreement, alike, read_image_header
from .import_report import ImportReport, Skipped
from .instrument import Instrument
from .setting import Setting, filters_from_text, setting_from_text, text_from_filters

MINIMAL = "[[series]] kind='flat' files='*.tif' setting='kv=40,power_w=40,exposure_ms=20'"

_NUMBERS = (
    "kV",
    "current_mA",
    "power_W",
    "exposure_ms",
    "frame_interval_ms",
    "belt_speed_mm_s",
    "panel_rotation_deg",
    "source_object_mm",
    "source_detector_mm",
    "photons_per_pixel",
)
_WHOLE = ("index", "averaged")
_SERIES_WORDS = (
    *("name", "kind", "files", "for_each", "setting", "filter", "scene", "corrected", "role", "dtype"),
    *_NUMBERS,
    *_WHOLE,
)
_MASKS = ("foreign_object_mask", "product_mask")
_SCENE_WORDS = (
    "name",
    "kind",
    "for_each",
    *_MASKS,
    "thickness_mm",
    "product",
    "foreign_object",
    "size_mm",
    "split",
    "rows",
)


def import_images(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    sidecar: str | os.PathLike[str] | None = None,
    without_damaged: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Turn a folder of images into an acquisition file, as its sidecar says (see the module's text for its words).

    Args:
        source: the folder.
        out: acquisition file to write.
        sidecar: TOML file; None = `raytwin.toml` in the folder.
        without_damaged: go on without a series that has an image at fault; the file holds its error in its place.
        progress: called with (images used, images in the folder).

    Raises:
        InputError: no sidecar, a word that means nothing, a pattern without files, images of mixed shapes, damaged.
    """
    folder = Path(source)
    tables = read_sidecar(
        folder,
        None if sidecar is None else Path(sidecar),
        known=("instrument", "raw", "series", "scene"),
        minimal=MINIMAL,
    )
    images = [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in IMAGE_ENDINGS and path.is_file()]
    used = _Used(len(images), progress)
    stated = instrument_of(tables, where=NAME)
    plans = _plans(folder, tables, without_damaged=without_damaged)
    instrument, notes = _instrument(stated, plans)
    with write_acquisition(out, instrument) as writer:
        read, more = _write(writer, folder, tables, plans, used, without_damaged=without_damaged)
    skipped = [
        Skipped(what=path.relative_to(folder).as_posix(), reason="no series or scene of the sidecar names it")
        for path in images
        if path not in used
    ]
    return ImportReport(
        layout="images",
        source=str(source),
        written=str(out),
        format="acquisition",
        read=tuple(read),
        frames=sum(int(entry["frames"]) for entry in read),
        skipped=tuple(skipped),
        notes=(*notes, *more),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """One series to write: its table, where that stands, scene, name, files, and what the files' headers say."""

    table: Mapping[str, Any]
    where: str
    scene: str
    name: str
    files: list[Path]
    headers: list[ImageHeader]


def _plans(folder: Path, tables: Mapping[str, Any], *, without_damaged: bool) -> list[_Plan]:
    series = tables_of(tables, "series", where=NAME)
    if not series:
        raise InputError(NAME, received="no [[series]]", expected="at least one series", remedy=f"at least: {MINIMAL}")
    plans = []
    for number, table in enumerate(series, start=1):
        where = f"{NAME}, series {table.get('name', number)}"
        check_words(table, _SERIES_WORDS, where=where)
        for place, scene, name in _places(folder, table, number, where=where):
            patterns = table.get("files")
            if not isinstance(patterns, str | list) or not patterns:
                raise InputError(
                    f"{where}, files", received=repr(patterns), expected="a pattern such as 'flats/*.tif', or a list"
                )
            files = files_matching(place, patterns, where=f"{where}, files")
            # a TIFF says its pixel size alone: that of the first stands for the series
            told = [path for path in files if path.suffix.lower() not in TIFF_ENDINGS] or files[:1]
            headers = []
            for path in told:
                # a damaged file stops its series later
                with suppress(FileFormatError) if without_damaged else nullcontext():
                    headers.append(read_image_header(path))
            plans.append(_Plan(table=table, where=where, scene=scene, name=name, files=files, headers=headers))
    return plans


def _instrument(stated: Instrument, plans: list[_Plan]) -> tuple[Instrument, list[str]]:
    """The sidecar's instrument, with what the files' headers say where it is silent."""
    found = agreement([header for plan in plans for header in plan.headers])
    taken, notes = {}, []
    for word in INSTRUMENT_WORDS:
        value, own = found.values.get(word), getattr(stated, word)
        if word in found.differing:
            notes.append(f"{word}: {_two(found.differing[word])} in the files' headers; neither is taken")
        elif value and own is None:
            taken[word] = value
            notes.append(f"{word} = {value} from the files' headers")
        elif value and not alike(own, value):
            notes.append(f"{word}: {own} in the sidecar, {value} in the files' headers; the sidecar counts")
    return replace(stated, **taken), notes


def _two(values: tuple[Any, Any]) -> str:
    return " and ".join(text_from_filters(one) or "no filter" if isinstance(one, tuple) else f"{one}" for one in values)


def _from_headers(plan: _Plan, attributes: dict[str, Any], setting: Setting | None) -> list[str]:
    """Fill what the sidecar leaves open in a series' attributes with what its files' headers say.

    Raises:
        FileFormatError: files of several settings in one series, and no word of the sidecar that decides.
    """
    found = agreement(plan.headers)
    notes = [
        f"series {plan.name}: {text}" for text in dict.fromkeys(note for one in plan.headers for note in one.notes)
    ]
    dark = plan.table.get("kind") in ("dark", "afterglow")
    for word in SETTING_WORDS:
        if dark and word in ("kV", "current_mA"):
            continue
        own = attributes.get(word)
        load = attributes.get("power_W") if word == "current_mA" else None
        if setting is not None:
            own = getattr(setting, word) if word != "filters" else setting.filters
            load = setting.power_W if word == "current_mA" else None
            if own is None and word != "frame_interval_ms":
                continue  # a setting is stated as a whole
        if word in found.differing and own is None and load is None:
            raise FileFormatError(
                f"{plan.where}, {word}",
                received=f"{_two(found.differing[word])} in the headers of its files",
                expected="one setting a series",
                remedy=f"split the series, or state {'filter' if word == 'filters' else word} in the sidecar",
            )
        value = found.values.get(word)
        if value is None or (value == 0 and word != "exposure_ms"):
            continue
        if own is None and load is None:
            attributes[word] = value
        elif own is not None and not alike(own, value):
            told = text_from_filters(value) if word == "filters" else value
            notes.append(f"series {plan.name}: {word} {told or 'none'} in the files' headers; the sidecar counts")
    return notes


class _Used:
    """The files that the sidecar named so far."""

    def __init__(self, total: int, progress: Callable[[int, int], None] | None) -> None:
        self._total = total
        self._progress = progress
        self._paths: set[Path] = set()

    def __contains__(self, path: Path) -> bool:
        return path in self._paths

    def add(self, path: Path) -> None:
        self._paths.add(path)
        if self._progress is not None:
            self._progress(len(self._paths), max(self._total, len(self._paths)))


def _write(
    writer: AcquisitionWriter,
    folder: Path,
    tables: Mapping[str, Any],
    plans: list[_Plan],
    used: _Used,
    *,
    without_damaged: bool,
) -> tuple[list[dict[str, Any]], list[str]]:
    raw = raw_layout_of(tables, where=NAME)
    read: list[dict[str, Any]] = []
    notes: list[str] = []
    for plan in plans:
        try:
            read.append(_write_series(writer, plan, raw, used, notes))
        except FileFormatError as error:
            if not without_damaged:
                raise
            writer.leave_out(plan.name, error)
    for number, table in enumerate(tables_of(tables, "scene", where=NAME), start=1):
        where = f"{NAME}, scene {table.get('name', number)}"
        check_words(table, _SCENE_WORDS, where=where)
        rows = rows_of(folder, table, "scene", where=where)
        for place, scene, _ in _places(folder, table, number, where=where):
            if not scene:
                raise InputError(where, received="no name", expected="name or for_each")
            _write_scene(writer, place, table, used, known=rows.get(scene, {}), name=scene, where=where)
    named = {entry["scene"] for entry in read if entry["scene"]}
    notes += [f"scene {scene}: nothing is said about it" for scene in sorted(named - set(writer.scene_names))]
    return read, notes


def _places(folder: Path, table: Mapping[str, Any], number: int, *, where: str) -> Iterator[tuple[Path, str, str]]:
    """(folder to look in, scene, name of the series) for each thing that one table describes."""
    kind = text_of(table, "kind", where=where) or ""
    each = text_of(table, "for_each", where=where)
    if each is None:
        scene = text_of(table, "scene", where=where) if "scene" in table or "files" in table else table.get("name")
        yield folder, scene or "", text_of(table, "name", where=where) or f"{number:03d}_{kind}"
        return
    if "scene" in table:
        raise InputError(where, received="scene and for_each", expected="one of the two: for_each names the scenes")
    for place in folders_matching(folder, each, where=f"{where}, for_each"):
        suffix = text_of(table, "name", where=where) or f"{number:03d}_{kind}"
        yield place, place.name, f"{place.name}_{suffix}"


def _write_series(
    writer: AcquisitionWriter, plan: _Plan, raw: RawLayout | None, used: _Used, notes: list[str]
) -> dict[str, Any]:
    table, where, files = plan.table, plan.where, plan.files
    setting_text = text_of(table, "setting", where=where)
    kind = text_of(table, "kind", where=where) or ""
    attributes: dict[str, Any] = {word: number_of(table, word, where=where) for word in (*_NUMBERS, *_WHOLE)}
    for word, value in attributes.items():
        if word in _WHOLE and isinstance(value, float):
            raise InputError(f"{where}, {word}", received=value, expected="a whole number")
        if value is not None:
            checked_number(value, where=f"{where}, {word}", **bounds_of(word, kind))
    filter_text = text_of(table, "filter", where=where)
    if filter_text is not None:
        attributes["filters"] = filters_from_text(filter_text)
    with named(where, InputError):
        setting = None if setting_text is None else setting_from_text(setting_text)
    corrected = [word for word in (text_of(table, "corrected", where=where) or "").split("+") if word]
    if "corrected" not in table:
        corrected = sorted(agreement(plan.headers).values.get("corrected", ()))
    notes += _from_headers(plan, attributes, setting)
    series: SeriesWriter | None = None
    shape: tuple[int, int] | None = None
    for path in files:
        used.add(path)
        if left := images_left(path):
            notes.append(
                f"series {plan.name}: {counted(left, 'image')} behind the first of {path.name} not taken; a stack of three axes"
                " in one HDU is taken whole"
            )
        for image in iter_images(path, raw=raw):
            if series is None:
                shape = (image.shape[0], image.shape[1])
                with named(where, InputError):
                    series = writer.add_series(
                        plan.name,
                        kind=kind,
                        shape=shape,
                        dtype=text_of(table, "dtype", where=where) or frame_dtype(image),
                        setting=setting,
                        scene=plan.scene,
                        role=text_of(table, "role", where=where),
                        corrected=corrected,
                        **attributes,
                    )
            if image.shape != shape:
                raise FileFormatError(
                    str(path),
                    received=f"{image.shape[0]} x {image.shape[1]} pixels",
                    expected=f"{shape[0]} x {shape[1]} as in {files[0].name}" if shape else "one shape",
                    remedy="a series holds frames of one shape: split it in two",
                )
            try:
                series.append(image)
            except InputError as error:
                raise FileFormatError(
                    str(path), received=error.received, expected=error.expected, remedy=error.remedy
                ) from None
    entry: dict[str, Any] = {
        "name": plan.name,
        "kind": table.get("kind"),
        "frames": 0 if series is None else series.n_frames,
    }
    return entry | {"files": len(files), "scene": plan.scene}


def _write_scene(
    writer: AcquisitionWriter,
    place: Path,
    table: Mapping[str, Any],
    used: _Used,
    *,
    known: Mapping[str, str],
    name: str,
    where: str,
) -> None:
    def file_of(pattern: object, word: str) -> Path:
        found = files_matching(place, [pattern] if isinstance(pattern, str) else [], where=f"{where}, {word}")
        if len(found) != 1:
            raise InputError(f"{where}, {word}", received=f"{len(found)} files", expected="one file")
        used.add(found[0])
        return found[0]

    masks = {word: read_mask(file_of(table[word], word)) for word in _MASKS if word in table}
    maps = table.get("thickness_mm", {})
    if not isinstance(maps, dict):
        raise InputError(
            f"{where}, thickness_mm", received=repr(maps), expected='a table such as { pmma = "pmma.tif" }'
        )
    thickness_mm = {
        material: read_image(file_of(pattern, f"thickness_mm of {material}")) for material, pattern in maps.items()
    }
    told = {
        word: known.get(word) or text_of(table, word, where=where) for word in ("product", "foreign_object", "split")
    }
    size_mm = number_of(table, "size_mm", where=where)
    if "size_mm" in known:
        size_mm = number_in_cell(known["size_mm"], where=f"{where}, size_mm")
    if size_mm is not None and not math.isnan(size_mm):
        checked_number(size_mm, where=f"{where}, size_mm", lowest=0, unit="mm")
    writer.add_scene(
        name,
        kind=text_of(table, "kind", where=where) or "product",
        thickness_mm=thickness_mm,
        product=told["product"] or "",
        foreign_object=told["foreign_object"] or "",
        size_mm=size_mm,
        attributes=None if told["split"] is None else {"split": told["split"]},
        foreign_object_mask=masks.get("foreign_object_mask"),
        product_mask=masks.get("product_mask"),
    )

"""Import of the data that go with the paper (Andriiashen et al., 10.5281/zenodo.10579608, CC BY 4.0).

Three layouts are told apart by what lies in the folder, `<setting>` being `40kV_40W_100ms_10avg`:

- processed images, `<setting>/{train,val,test}/{NoBone,RibBone}/NNN.tiff` with `<class>_segm/NNN.tiff` and
  `<class>.csv` beside them, already -log(I/I0), one tube voltage a tree -> a dataset file;
- a raw session, `stats.csv`, `ff/<setting>.tif`, `NNN/<setting>.tif`, `di_pre.tif`, `NNN/segm.png` -> an acquisition;
- calibration flats, `<power>W/*.tif` with `di_pre.tif` and `di_post.tif` -> an acquisition.
"""

import csv
import io
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError
from ..files import CSV_UTF8, read_utf8
from ._image_files import TIFF_ENDINGS, frame_dtype, iter_images, natural_key, number_or_nan, read_image, read_mask
from .acquisition_io import write_acquisition
from .acquisition_writer import AcquisitionWriter
from .contrast import delta_r
from .dataset_io import SPLITS, DatasetRow, write_dataset
from .import_report import ImportReport, Skipped
from .instrument import Instrument
from .setting import Filter, Setting

# The paper's line: 50 um of copper before the object, 0.15 mm pixels, 990 and 1059 mm from the source.
FILTERS = (Filter(material="Cu", thickness_mm=0.05),)
INSTRUMENT = Instrument(
    anode="W", source_object_mm=990.0, source_detector_mm=1059.0, pixel_mm=0.15, detector="area", counting=False
)
BORDER_PX = 15

_NUMBER = r"\d+(?:\.\d+)?"
_SETTING = re.compile(
    rf"(?P<kV>{_NUMBER})kV_(?P<W>{_NUMBER})W_(?P<ms>{_NUMBER})ms(?:_(?P<averaged>\d+)avg)?", re.IGNORECASE
)
_POWER = re.compile(rf"(?P<W>{_NUMBER})W", re.IGNORECASE)
_CLEAN = "nobone"
_DARKS = ("di_pre", "di_post")


def import_zenodo(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    select: str | None = None,
    kV: float | None = None,
    exposure_ms: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Turn a folder of the paper's data into a dataset file (processed images) or an acquisition file (raw).

    Args:
        source: the folder, at any level: the unpacked archive, one data set, one session, the calibration flats.
        out: file to write.
        select: keep only settings or folders whose path holds this text, for example `Dataset #2` or `20ms`.
        kV, exposure_ms: of calibration flats, whose folders tell the power only.
        progress: called with (images done, images in all).

    Raises:
        InputError: none of the three layouts.
        FileFormatError: a damaged image, masks of another shape, a table without its columns.
    """
    folder = Path(source)
    if not folder.is_dir():
        given = "a file (unpack the archive first)" if folder.exists() else "no such folder"
        raise InputError(str(source), received=given, expected="a folder of the paper's data")
    trees = [
        path
        for path in _folders(folder)
        if _setting_of(path.name) is not None and (select is None or select in path.as_posix())
    ]
    if any(_classes(tree) for tree in trees):
        return _processed(folder, out, trees, progress=progress)
    sessions = [path.parent for path in sorted(folder.rglob("stats.csv"))]
    sessions = [path for path in sessions if select is None or select in path.as_posix()]
    if sessions:
        return _raw(folder, out, sessions, progress=progress)
    powers = [path for path in _folders(folder) if _POWER.fullmatch(path.name) and _tiffs(path)]
    powers = [path for path in powers if select is None or select in path.as_posix()]
    if powers:
        return _calibration(folder, out, powers, kV=kV, exposure_ms=exposure_ms)
    raise InputError(
        str(source),
        received="an empty folder" if not any(folder.iterdir()) else "a folder of another layout",
        expected="folders such as 40kV_40W_100ms_10avg/train/RibBone, a session with stats.csv, or 1W ... 45W",
        remedy="" if select is None else f"nothing may fit --select {select}",
    )


def _folders(folder: Path) -> list[Path]:
    return sorted((path for path in [folder, *folder.rglob("*")] if path.is_dir()), key=natural_key)


def _tiffs(folder: Path) -> list[Path]:
    return sorted((path for path in folder.iterdir() if path.suffix.lower() in TIFF_ENDINGS), key=natural_key)


def _setting_of(name: str) -> Setting | None:
    match = _SETTING.fullmatch(name)
    if match is None:
        return None
    return Setting(
        kV=float(match["kV"]),
        power_W=float(match["W"]),
        exposure_ms=float(match["ms"]),
        filters=FILTERS,
        averaged=int(match["averaged"] or 1),
    )


# Processed images


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tree:
    """One tube voltage of one data set at one exposure."""

    folder: Path
    setting: Setting


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    data_set: str
    settings: tuple[Setting, Setting]
    split: str
    class_folder: Path  # below a tree
    number: str
    low: Path
    high: Path
    mask: Path


def _classes(tree: Path) -> list[Path]:
    """Folders of images below a tree."""
    return [path.relative_to(tree) for path in _folders(tree) if not path.name.endswith("_segm") and _tiffs(path)]


def _by_number(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in _tiffs(folder)} if folder.is_dir() else {}


def _processed(
    source: Path, out: str | os.PathLike[str], trees: Sequence[Path], *, progress: Callable[[int, int], None] | None
) -> ImportReport:
    skipped: list[Skipped] = []
    notes = [
        f"settings taken from the folder names, with the paper's filter of {FILTERS[0]} mm",
        f"a border of {BORDER_PX} pixels of every real image is 0",
    ]
    pairs = list(_pairs(source, trees, skipped))
    if not pairs:
        raise InputError(
            str(source),
            received=f"{len(trees)} trees without a pair ({skipped[0].what}: {skipped[0].reason})"
            if skipped
            else "no pair",
            expected="the same image at two tube voltages",
        )
    tables: dict[Path, dict[str, dict[str, str]]] = {}
    several = len({pair.data_set for pair in pairs}) > 1
    counted: dict[tuple[str, str, str], int] = {}
    first = _log_image(pairs[0].low)
    shape = (first.shape[0], first.shape[1])
    with write_dataset(
        out,
        shape=shape,
        provenance={"source": "10.5281/zenodo.10579608", "licence": "CC BY 4.0", "border_px": BORDER_PX},
    ) as writer:
        for done, pair in enumerate(pairs):
            low, high = _log_image(pair.low), _log_image(pair.high)
            for path, plane in ((pair.low, low), (pair.high, high)):
                if plane.shape != shape:
                    raise FileFormatError(
                        str(path), received=f"shape {plane.shape}", expected=f"shape {shape} as in {pairs[0].low.name}"
                    )
            image = np.stack([low, high])
            product, bone = _masks(pair, shape)
            table = pair.low.parent.with_name(pair.low.parent.name + ".csv")
            if table not in tables:
                tables[table] = _table(table, skipped)
            row = _row(pair, tables[table], image, bone, notes, prefix=f"{pair.data_set}/" if several else "")
            writer.append(image=image, foreign_object_mask=bone, product_mask=product, row=row)
            key = (pair.data_set, row.setting, row.split)
            counted[key] = counted.get(key, 0) + 1
            if progress is not None:
                progress(done + 1, len(pairs))
    return ImportReport(
        layout="zenodo",
        source=str(source),
        written=str(out),
        format="dataset",
        read=tuple(
            {"data_set": data_set, "setting": setting, "split": split, "images": images, "shape": shape}
            for (data_set, setting, split), images in counted.items()
        ),
        frames=len(pairs),
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


def _pairs(source: Path, trees: Sequence[Path], skipped: list[Skipped]) -> Iterator[_Pair]:
    groups: dict[tuple[Path, float, int], list[_Tree]] = {}
    for path in trees:
        setting = _setting_of(path.name)
        if setting is not None:
            key = (path.parent, setting.exposure_ms, setting.averaged)
            groups.setdefault(key, []).append(_Tree(folder=path, setting=setting))
    for (parent, _, _), members in groups.items():
        members.sort(key=lambda tree: tree.setting.kV)
        low, high = members[0], members[-1]
        for tree in members[1:-1]:
            skipped.append(Skipped(what=_told(tree.folder, source), reason="a third tube voltage"))
        if low.setting.kV == high.setting.kV:
            for tree in members:
                skipped.append(
                    Skipped(what=_told(tree.folder, source), reason="no tree of another tube voltage beside it")
                )
            continue
        for class_folder in _classes(low.folder):
            lows, highs = _by_number(low.folder / class_folder), _by_number(high.folder / class_folder)
            masks = _by_number(low.folder / class_folder.with_name(class_folder.name + "_segm"))
            for number, path in lows.items():
                if number not in highs:
                    skipped.append(Skipped(what=_told(path, source), reason=f"not there at {high.setting.kV:g} kV"))
                elif number not in masks:
                    skipped.append(Skipped(what=_told(path, source), reason="no mask of this number"))
                else:
                    yield _Pair(
                        data_set=parent.name,
                        settings=(low.setting, high.setting),
                        split=next((part for part in class_folder.parts if part in SPLITS), "test"),
                        class_folder=class_folder,
                        number=number,
                        low=path,
                        high=highs[number],
                        mask=masks[number],
                    )
            for number in sorted(set(highs) - set(lows)):
                reason = f"not there at {low.setting.kV:g} kV"
                skipped.append(Skipped(what=_told(highs[number], source), reason=reason))


def _told(path: Path, source: Path) -> str:
    return path.relative_to(source).as_posix() if path != source else path.name


def _log_image(path: Path) -> NDArray[np.float32]:
    image = np.asarray(read_image(path), dtype=np.float32)
    if not bool(np.isfinite(image).all()):
        raise FileFormatError(str(path), received="a value that is not finite", expected="finite -log(I/I0)")
    return image


def _masks(pair: _Pair, shape: tuple[int, ...]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    planes = np.asarray(list(iter_images(pair.mask)))
    if planes.shape != (2, *shape):
        raise FileFormatError(
            str(pair.mask),
            received=f"masks of shape {planes.shape}",
            expected=f"{(2, *shape)}: product and bone on the image's own pixels",
        )
    return planes[0] != 0, planes[1] != 0


def _table(path: Path, skipped: list[Skipped]) -> dict[str, dict[str, str]]:
    """Rows of a class's csv by number without leading zeros."""
    if not path.is_file():
        skipped.append(Skipped(what=path.name, reason="no such table: products and sizes stay unknown"))
        return {}
    reader = _reader(path)
    if "ID" not in (reader.fieldnames or []):
        raise FileFormatError(
            str(path),
            received=f"columns {', '.join(reader.fieldnames or []) or 'none'}",
            expected="a column ID among them",
        )
    return {_plain_number(row["ID"]): row for row in reader if row["ID"]}


def _reader(path: Path) -> "csv.DictReader[str]":
    text = read_utf8(path, save_as=CSV_UTF8)
    return csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)


def _plain_number(text: str) -> str:
    text = text.strip()
    return str(int(float(text))) if re.fullmatch(r"\d+(\.0*)?", text) else text


def _row(
    pair: _Pair,
    table: Mapping[str, Mapping[str, str]],
    image: NDArray[np.float32],
    bone: NDArray[np.bool_],
    notes: list[str],
    *,
    prefix: str,
) -> DatasetRow:
    known = table.get(_plain_number(pair.number), {})
    name = f"{prefix}{pair.class_folder.as_posix()}/{pair.number}"
    class_name = pair.class_folder.name
    has_bone = bool(bone.any())
    size_mm, contrast = number_or_nan(known.get("FO_size")), number_or_nan(known.get("Contrast"))
    if has_bone and not contrast > -1:
        try:
            contrast = delta_r(image[0], image[1], bone)
            notes.append(f"image {name}: contrast computed from the image, the table has none")
        except InputError as error:
            contrast = math.nan
            notes.append(f"image {name}: no contrast ({error})")
    if not has_bone and class_name.lower() != _CLEAN:
        notes.append(f"image {name}: class {class_name} but an empty bone mask; taken as a product without bone")
    product = known.get("Chicken_ID") or ""
    bone_name = f"{known.get('Bone_Class') or class_name} {known.get('Bone_ID') or ''}".strip()
    return DatasetRow(
        image=name,
        product=f"{prefix}{product}" if product else "",
        foreign_object=bone_name if has_bone else "",
        size_mm=size_mm if has_bone and size_mm > 0 else math.nan,
        contrast=contrast if has_bone else math.nan,
        split=pair.split,
        setting=";".join(str(setting) for setting in pair.settings),
    )


# Raw sessions


def _raw(
    source: Path,
    out: str | os.PathLike[str],
    sessions: Sequence[Path],
    *,
    progress: Callable[[int, int], None] | None,
) -> ImportReport:
    skipped: list[Skipped] = []
    notes = [
        f"settings taken from the file names, with the paper's geometry and filter of {FILTERS[0]} mm",
        "the exposure time of di_pre.tif is not recorded: the one in ff is kept as dark of every exposure time used",
    ]
    read: list[dict[str, Any]] = []
    with write_acquisition(out, INSTRUMENT) as writer:
        writer.attributes["source"] = "10.5281/zenodo.10579608"
        for number, session in enumerate(sessions):
            prefix = f"{session.name}_" if len(sessions) > 1 else ""
            _session(writer, session, prefix, read, skipped, notes)
            if progress is not None:
                progress(number + 1, len(sessions))
    return ImportReport(
        layout="zenodo",
        source=str(source),
        written=str(out),
        format="acquisition",
        read=tuple(read),
        frames=sum(int(entry["frames"]) for entry in read),
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


def _session(
    writer: AcquisitionWriter,
    session: Path,
    prefix: str,
    read: list[dict[str, Any]],
    skipped: list[Skipped],
    notes: list[str],
) -> None:
    samples = _samples(session / "stats.csv")
    sizes_mm = _sizes(session)
    folders = {_plain_number(path.name): path for path in session.iterdir() if path.is_dir() and path.name != "ff"}
    flats = session / "ff"
    exposures_ms = set()
    for folder in [flats, *folders.values()]:
        if folder.is_dir():
            exposures_ms |= {
                setting.exposure_ms for setting in map(_setting_of, (path.stem for path in _tiffs(folder))) if setting
            }
    if flats.is_dir():
        for path in _tiffs(flats):
            setting = _setting_of(path.stem)
            if path.stem in _DARKS:
                for exposure_ms in sorted(exposures_ms):
                    name = f"{prefix}{path.stem}_{exposure_ms:g}ms"
                    read.append(_add(writer, name, path, kind="dark", exposure_ms=exposure_ms))
            elif setting is None:
                skipped.append(Skipped(what=_told(path, session), reason="its name is no setting"))
            else:
                read.append(_add(writer, f"{prefix}ff_{path.stem}", path, kind="flat", setting=setting))
    else:
        skipped.append(Skipped(what=session.name, reason="no folder ff: objects cannot be corrected"))
    for sample, known in samples.items():
        if sample not in folders:
            skipped.append(Skipped(what=f"{session.name}, sample {sample}", reason="in stats.csv but without a folder"))
            continue
        folder = folders.pop(sample)
        _sample(writer, folder, known, sizes_mm, prefix, exposures_ms, read, skipped, notes)
    for folder in folders.values():
        if any(_setting_of(path.stem) for path in _tiffs(folder)):
            skipped.append(Skipped(what=f"{session.name}/{folder.name}", reason="no row in stats.csv"))


def _sample(
    writer: AcquisitionWriter,
    folder: Path,
    known: Mapping[str, str],
    sizes_mm: Mapping[tuple[str, str], float],
    prefix: str,
    exposures_ms: set[float],
    read: list[dict[str, Any]],
    skipped: list[Skipped],
    notes: list[str],
) -> None:
    scene = f"{prefix}{folder.name}"
    shape: tuple[int, ...] | None = None
    for path in _tiffs(folder):
        setting = _setting_of(path.stem)
        if path.stem in _DARKS:
            # One exposure time in the session: the dark has it too. Otherwise it is kept without.
            exposure_ms = next(iter(exposures_ms)) if len(exposures_ms) == 1 else None
            read.append(_add(writer, f"{scene}_{path.stem}", path, kind="dark", exposure_ms=exposure_ms))
        elif setting is None:
            skipped.append(Skipped(what=f"{folder.name}/{path.name}", reason="its name is no setting"))
        else:
            read.append(_add(writer, f"{scene}_{path.stem}", path, kind="object", setting=setting, scene=scene))
            shape = read[-1]["shape"]
    bone_class, bone = known.get("Bone_Class", "").strip(), _plain_number(known.get("Bone", ""))
    mask_file = folder / "segm.png"
    mask = None
    if mask_file.is_file():
        mask = read_mask(mask_file)
    elif bone_class.lower() == _CLEAN and shape is not None:
        mask = np.zeros(shape, dtype=np.bool_)
    else:
        notes.append(f"sample {scene}: no segm.png, where its bone is stays unknown")
    clean = bone_class.lower() in ("", _CLEAN)
    writer.add_scene(
        scene,
        kind="product",
        foreign_object_mask=mask,
        product=_plain_number(known.get("Chicken", "")),
        foreign_object="" if clean else f"{bone_class} {bone}".strip(),
        size_mm=None if clean else sizes_mm.get((bone_class, bone)),
    )


def _samples(path: Path) -> dict[str, dict[str, str]]:
    reader = _reader(path)
    names = [name.strip() for name in reader.fieldnames or []]
    missing = {"Sample", "Chicken", "Bone_Class", "Bone"} - set(names)
    if missing:
        raise FileFormatError(
            str(path),
            received=f"columns {', '.join(names) or 'none'}",
            expected="Sample, Chicken, Bone_Class, Bone",
        )
    return {_plain_number(row["Sample"]): row for row in reader if row["Sample"]}


def _sizes(session: Path) -> dict[tuple[str, str], float]:
    for folder in (session, session.parent):
        path = folder / "bone_size.csv"
        if path.is_file():
            return {
                ((row.get("Bone_Class") or "").strip(), _plain_number(row.get("Bone") or "")): number_or_nan(
                    row.get("Size_mm")
                )
                for row in _reader(path)
            }
    return {}


def _add(
    writer: AcquisitionWriter,
    name: str,
    path: Path,
    *,
    kind: str,
    setting: Setting | None = None,
    exposure_ms: float | None = None,
    scene: str = "",
    role: str | None = None,
) -> dict[str, Any]:
    images = iter_images(path)
    first = next(images)
    series = writer.add_series(
        name,
        kind=kind,
        shape=(first.shape[0], first.shape[1]),
        dtype=frame_dtype(first),
        setting=setting,
        exposure_ms=exposure_ms,
        scene=scene,
        role=role,
    )
    series.append(first)
    for image in images:
        series.append(image)
    entry: dict[str, Any] = {"name": name, "kind": kind, "frames": series.n_frames, "shape": first.shape}
    if setting is not None:
        entry["setting"] = str(setting)
    if exposure_ms is not None:
        entry["exposure_ms"] = exposure_ms
    return entry


# Calibration flats


def _calibration(
    source: Path,
    out: str | os.PathLike[str],
    powers: Sequence[Path],
    *,
    kV: float | None,
    exposure_ms: float | None,
) -> ImportReport:
    notes = [f"the paper's geometry and filter of {FILTERS[0]} mm"]
    read: list[dict[str, Any]] = []
    with write_acquisition(out, INSTRUMENT) as writer:
        writer.attributes["source"] = "10.5281/zenodo.10579608"
        for folder in powers:
            power = _POWER.fullmatch(folder.name)
            power_W = float(power["W"]) if power else math.nan
            told = folder.relative_to(source).as_posix() if folder != source else folder.name
            own_kV = kV if kV is not None else _from_path(folder, rf"({_NUMBER})\s*kV")
            own_ms = exposure_ms if exposure_ms is not None else _from_path(folder, rf"({_NUMBER})\s*ms")
            prefix = told.replace("/", "_")
            darks = [path for path in _tiffs(folder) if path.stem in _DARKS]
            flats = [path for path in _tiffs(folder) if path.stem not in _DARKS]
            for path in [path for path in darks if path.stem == "di_pre"]:
                read.append(_add(writer, f"{prefix}_{path.stem}", path, kind="dark", exposure_ms=own_ms))
            if flats:
                read.append(_flats(writer, prefix, flats, power_W=power_W, kV=own_kV, exposure_ms=own_ms))
            for path in [path for path in darks if path.stem == "di_post"]:
                read.append(_add(writer, f"{prefix}_{path.stem}", path, kind="dark", exposure_ms=own_ms))
            if own_kV is None or own_ms is None:
                notes.append(f"{told}: tube voltage or exposure time unknown; give them with --kv and --exposure-ms")
    return ImportReport(
        layout="zenodo",
        source=str(source),
        written=str(out),
        format="acquisition",
        read=tuple(read),
        frames=sum(int(entry["frames"]) for entry in read),
        notes=tuple(notes),
    )


def _from_path(folder: Path, pattern: str) -> float | None:
    """A number with its unit out of the names of the folder and those above it, the nearest first."""
    for part in reversed(folder.parts):
        match = re.search(pattern, part, re.I)
        if match:
            return float(match[1])
    return None


def _flats(
    writer: AcquisitionWriter,
    name: str,
    files: Sequence[Path],
    *,
    power_W: float,
    kV: float | None,
    exposure_ms: float | None,
) -> dict[str, Any]:
    first = next(iter_images(files[0]))
    series = writer.add_series(
        f"{name}_flat",
        kind="flat",
        shape=(first.shape[0], first.shape[1]),
        dtype=frame_dtype(first),
        kV=kV,
        power_W=power_W,
        exposure_ms=exposure_ms,
        filters=FILTERS,
        role="calibration",
    )
    for path in files:
        for image in iter_images(path):
            try:
                series.append(image)
            except InputError as error:
                raise FileFormatError(str(path), received=error.received, expected=error.expected) from None
    entry: dict[str, Any] = {
        "name": f"{name}_flat",
        "kind": "flat",
        "frames": series.n_frames,
        "shape": first.shape,
        "power_W": power_W,
    }
    return entry | ({} if kV is None else {"kV": kV}) | ({} if exposure_ms is None else {"exposure_ms": exposure_ms})

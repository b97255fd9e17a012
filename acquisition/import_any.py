"""Which layout a folder or file of measurements is in, its import by that name, and a sidecar to start from."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..errors import InputError
from ._dicom_files import is_dicom
from ._image_files import DICOM_ENDINGS, IMAGE_ENDINGS, RAW_ENDINGS, iter_images, natural_key
from ._sidecar import NAME
from .import_report import ImportReport

_NEXUS_ENDINGS = (".nxs", ".nx", ".nexus")
_MOST_GROUPS = 24
_DARK_WORDS = re.compile(r"dark|^di\d|offset|bias|black", re.I)
_FLAT_WORDS = re.compile(r"flat|^io\d|white|open|bright|gain|air|ff", re.I)


def layout_of(place: Path) -> str | None:
    """`images`, `emva1288`, `nxtomo`, `dicom`, `xtekct` or `zenodo`, as `raytwin import` calls it; None: no layout that it reads."""
    if place.is_file():
        if place.name.lower() == "emva1288_data.txt":
            return "emva1288"
        if place.suffix.lower() == ".xtekct":
            return "xtekct"
        if place.suffix.lower() in DICOM_ENDINGS or is_dicom(place):
            return "dicom"
        return "nxtomo" if place.suffix.lower() in _NEXUS_ENDINGS else None
    if not place.is_dir():
        return None
    names = [path.name.lower() for path in place.iterdir()]
    if NAME in names:
        return "images"
    if "emva1288_data.txt" in names:
        return "emva1288"
    if sum(name.endswith(_NEXUS_ENDINGS) for name in names) == 1:
        return "nxtomo"
    if sum(name.endswith(".xtekct") for name in names) == 1:
        return "xtekct"
    if any(path.suffix.lower() in DICOM_ENDINGS for path in place.rglob("*")):
        return "dicom"
    if "stats.csv" in names or any(re.fullmatch(r"\d+(\.\d+)?w", name) for name in names):
        return "zenodo"
    return None


def import_folder(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    layout: str,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Import what `layout_of` recognised, without further options.

    Raises:
        InputError: another layout, or what the importer of this one raises.
    """
    if layout == "images":
        from .images import import_images

        return import_images(source, out, progress=progress)
    if layout == "emva1288":
        from .emva1288 import import_emva1288

        return import_emva1288(source, out, progress=progress)
    if layout == "nxtomo":
        from .nxtomo import import_nxtomo

        return import_nxtomo(source, out, progress=progress)
    if layout == "dicom":
        from .dicom import import_dicom

        return import_dicom(source, out, progress=progress)
    if layout == "xtekct":
        from .xtekct import import_xtekct

        return import_xtekct(source, out, progress=progress)
    if layout == "zenodo":
        from .zenodo import import_zenodo

        return import_zenodo(source, out, progress=progress)
    raise InputError("layout", received=repr(layout), expected="images, emva1288, nxtomo, dicom, xtekct or zenodo")


def draft_sidecar(folder: Path) -> str:
    """A `raytwin.toml` to start from, of the images in a folder; empty where there are none.

    Files that differ by a number make a series; what it shows is guessed from its name, else from its level: the lowest is
    taken for dark, the highest for a flat.
    """
    groups: dict[str, list[Path]] = {}
    images = [path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_ENDINGS and path.is_file()]
    for path in sorted(images, key=natural_key):
        relative = path.relative_to(folder)
        pattern = (relative.parent / re.sub(r"\d+(?=\D*$)", "*", relative.name)).as_posix()
        groups.setdefault(pattern, []).append(path)
    if not groups:
        return ""
    raw = any(path.suffix.lower() in RAW_ENDINGS for path in images)
    levels = {pattern: _level(paths[0]) for pattern, paths in list(groups.items())[:_MOST_GROUPS]}
    lines = [
        f"# draft of {NAME}: look at every line, and write what is known in place of 0",
        "[instrument]",
        "# pixel_mm = 0",
        "# source_detector_mm = 0",
        "# source_object_mm = 0",
        '# scintillator = "CsI:0.5"',
        "# bits = 16",
    ]
    if raw:
        lines += ["", "[raw]", "rows = 0", "columns = 0", 'dtype = "uint16"']
    for pattern, level in levels.items():
        kind = _kind(pattern, level, [value for value in levels.values() if value is not None])
        known = "" if level is None else f", level {level:.5g}"
        number = len(groups[pattern])
        # a file of its own name stays as it is
        files = pattern if number > 1 else groups[pattern][0].relative_to(folder).as_posix()
        lines += [
            "",
            "[[series]]",
            f'kind = "{kind}"',
            f'files = "{files}"  # {number} file{"s" * (number != 1)}{known}',
        ]
        lines.append("exposure_ms = 0" if kind == "dark" else 'setting = "kv=0,power_w=0,exposure_ms=0"')
    if len(groups) > _MOST_GROUPS:
        lines += ["", f"# and {len(groups) - _MOST_GROUPS} more patterns"]
    return "\n".join(lines) + "\n"


def _level(path: Path) -> float | None:
    try:
        return float(np.median(next(iter_images(path))))
    except (InputError, StopIteration):
        return None


def _kind(pattern: str, level: float | None, levels: list[float]) -> str:
    name = pattern.rsplit("/", 1)[-1]
    for words, kind in ((_DARK_WORDS, "dark"), (_FLAT_WORDS, "flat")):
        if words.search(name) or words.search(pattern.rsplit("/", 2)[-2] if "/" in pattern else ""):
            return kind
    if level is None or len(levels) < 2:
        return "object"
    if level <= min(levels) < 0.5 * max(levels):
        return "dark"
    return "flat" if level >= max(levels) else "object"

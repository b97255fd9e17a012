"""Which layout a folder or file of measurements is in, its import by that name, and a sidecar to start from."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ._dicom_files import is_dicom
from ._image_files import DICOM_ENDINGS, IMAGE_ENDINGS, RAW_ENDINGS, iter_images, natural_key
from ._sidecar import NAME
from .import_report import ImportReport

_NEXUS_ENDINGS = (".nxs", ".nx", ".nexus")
_MOST_GROUPS = 24
_DARK_WORDS = re.compile(r"dark|^di\d|offset|(?<![a-z])off(?![a-z])|bias|black", re.I)
_STATED = re.compile(r"(?<![A-Za-z0-9.])(\d+(?:\.\d+)?) ?(kV|W|mA|ms)(?![A-Za-z0-9])", re.I)
_WORD_OF_UNIT = {"kv": "kv", "w": "power_w", "ma": "current_ma", "ms": "exposure_ms"}
_UNSURE = "?"
# Open light: heel and distance make it smooth, and leave more than a third of it in the darkest corner; tiles of a panel differ
# by some per cent. A product leaves more than that beside a parabola.
_BLOCKS = 8
_EVEN = 0.03
_DROP = 1 / 3
_ALIKE = 1.1  # levels of one setting: output and offset wander by some per cent
_FLAT_WORDS = re.compile(r"flat|^io\d|white|open|bright|gain|(?<![a-z])(air|ff)(?![a-z])", re.I)


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
) -> ImportReport:
    """Import what `layout_of` recognised, without further options; of a folder of images the series that can be read.

    Raises:
        InputError: another layout, or what the importer of this one raises.
    """
    if layout == "images":
        from .images import import_images

        return import_images(source, out, without_damaged=True)
    if layout == "emva1288":
        from .emva1288 import import_emva1288

        return import_emva1288(source, out)
    if layout == "nxtomo":
        from .nxtomo import import_nxtomo

        return import_nxtomo(source, out)
    if layout == "dicom":
        from .dicom import import_dicom

        return import_dicom(source, out)
    if layout == "xtekct":
        from .xtekct import import_xtekct

        return import_xtekct(source, out)
    if layout == "zenodo":
        from .zenodo import import_zenodo

        return import_zenodo(source, out)
    raise InputError("layout", received=repr(layout), expected="images, emva1288, nxtomo, dicom, xtekct or zenodo")


def draft_sidecar(folder: Path) -> str:
    """A `raytwin.toml` to start from, of the images in a folder; empty where there are none.

    Files that differ by a number make a series. kV, W, mA and ms are those that names state (`40kV_10W_20ms`). What a series
    shows is guessed from its name, else from its first image: the lowest level is taken for dark, even light for a flat.
    """
    groups: dict[str, list[Path]] = {}
    images = [path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_ENDINGS and path.is_file()]
    for path in sorted(images, key=natural_key):
        relative = path.relative_to(folder)
        groups.setdefault((relative.parent / _starred(relative.name)).as_posix(), []).append(path)
    if not groups:
        return ""
    raw = any(path.suffix.lower() in RAW_ENDINGS for path in images)
    looks = {pattern: _look(paths[0]) for pattern, paths in list(groups.items())[:_MOST_GROUPS]}
    firsts = {pattern: groups[pattern][0].relative_to(folder).as_posix() for pattern in looks}
    stated = {pattern: _stated(first) for pattern, first in firsts.items()}
    kinds = _kinds(looks, stated)
    lines = [
        f"# draft of {NAME}: look at every line, and write what is known in place of 0 and ?",
        "[instrument]",
        "# pixel_mm = 0",
        "# source_detector_mm = 0",
        "# source_object_mm = 0",
        '# scintillator = "CsI:0.5"',
        "# bits = 16",
    ]
    if raw:
        lines += ["", "[raw]", "rows = 0", "columns = 0", 'dtype = "uint16"']
    for pattern, look in looks.items():
        kind, told = kinds[pattern], stated[pattern]
        known = "" if look is None else f", level {look.level_DN:.5g}"
        number = len(groups[pattern])
        lines += [
            "",
            "[[series]]",
            f'kind = "{kind}"' + ("  # dark, flat or object: its images do not tell" if kind == _UNSURE else ""),
            # a file of its own name stays as it is
            f'files = "{pattern if number > 1 else firsts[pattern]}"  # {number} file{"s" * (number != 1)}{known}',
        ]
        load = "current_ma" if "current_ma" in told and "power_w" not in told else "power_w"
        if kind == "dark":
            lines.append(f"exposure_ms = {told.get('exposure_ms', '0')}")
        else:
            words = ",".join(f"{word}={told.get(word, '0')}" for word in ("kv", load, "exposure_ms"))
            lines.append(f'setting = "{words}"')
    if len(groups) > _MOST_GROUPS:
        lines += ["", f"# and {len(groups) - _MOST_GROUPS} more patterns"]
    return "\n".join(lines) + "\n"


def _starred(name: str) -> str:
    """A file's name with a star in place of its last number; numbers with a unit stay."""
    stated = [found.span() for found in _STATED.finditer(name)]
    numbers = [
        found.span()
        for found in re.finditer(r"\d+", name)
        if not any(first <= found.start() < last for first, last in stated)
    ]
    if not numbers:
        return name
    first, last = numbers[-1]
    return f"{name[:first]}*{name[last:]}"


def _stated(path: str) -> dict[str, str]:
    """kv, power_w, current_ma and exposure_ms as the parts of a path state them, the file's name before its folders."""
    found: dict[str, str] = {}
    for part in reversed(path.split("/")):
        values: dict[str, set[str]] = {}
        for number, unit in _STATED.findall(part):
            values.setdefault(_WORD_OF_UNIT[unit.lower()], set()).add(number)
        for word, numbers in values.items():
            if len(numbers) == 1 and float(*numbers) > 0:
                found.setdefault(word, *numbers)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """The first image of a series: median level (DN), and medians of its blocks (row, column)."""

    level_DN: float
    blocks_DN: NDArray[np.float64]


def _look(path: Path) -> _Look | None:
    try:
        image = np.asarray(next(iter_images(path)), dtype=np.float64)
    except (InputError, StopIteration):
        return None
    blocks = [np.array_split(rows, _BLOCKS, axis=1) for rows in np.array_split(image, _BLOCKS)]
    medians = [[float(np.median(block)) for block in row] for row in blocks] if min(image.shape) >= _BLOCKS else [[]]
    return _Look(level_DN=float(np.median(image)), blocks_DN=np.array(medians))


def _kinds(looks: Mapping[str, _Look | None], stated: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """What each pattern's images show, by its name, else by their light; `?` where neither tells.

    Of patterns that state the same setting, or none, even light that is darker than the brightest flat's may be a slab's.
    """
    kinds = {pattern: _kind_of_name(pattern) for pattern in looks}
    levels = {pattern: look.level_DN for pattern, look in looks.items() if look is not None}
    lowest, highest = min(levels.values(), default=0.0), max(levels.values(), default=0.0)
    for pattern, level in levels.items():
        if not kinds[pattern] and "kv" not in stated[pattern] and level <= _ALIKE * lowest < 0.5 * highest:
            kinds[pattern] = "dark"
    dark_DN = min((level for pattern, level in levels.items() if kinds[pattern] == "dark"), default=0.0)
    guessed = [pattern for pattern, kind in kinds.items() if not kind]
    for pattern in guessed:
        look = looks[pattern]
        kinds[pattern] = _UNSURE if look is None else _kind_of_light(look, dark_DN)
    for pattern in guessed:
        alike = [levels[other] for other in levels if kinds[other] == "flat" and stated[other] == stated[pattern]]
        alone = len(levels) < 2 and "kv" not in stated[pattern]  # it may be a dark
        if kinds[pattern] == "flat" and (alone or _ALIKE * levels[pattern] < max(alike)):
            kinds[pattern] = _UNSURE
    return kinds


def _kind_of_name(pattern: str) -> str:
    name = pattern.rsplit("/", 1)[-1]
    for words, kind in ((_DARK_WORDS, "dark"), (_FLAT_WORDS, "flat")):
        if words.search(name) or words.search(pattern.rsplit("/", 2)[-2] if "/" in pattern else ""):
            return kind
    return ""


def _kind_of_light(look: _Look, dark_DN: float) -> str:
    """`flat` where the light above the dark is even, `object` where it is not, `?` between."""
    if look.blocks_DN.size == 0 or not look.level_DN > dark_DN:
        return _UNSURE
    light = (look.blocks_DN - dark_DN) / (look.level_DN - dark_DN)
    row, column = np.mgrid[-1 : 1 : light.shape[0] * 1j, -1 : 1 : light.shape[1] * 1j]
    shapes = np.stack([row**0, row, column, row * column, row**2, column**2], axis=-1).reshape(-1, 6)
    smooth = shapes @ np.linalg.lstsq(shapes, light.ravel(), rcond=None)[0]
    uneven = float(np.sqrt(np.mean((light.ravel() - smooth) ** 2)))
    if uneven < _EVEN and smooth.min() > _DROP * smooth.max():
        return "flat"
    return "object" if uneven > 2.0 * _EVEN else _UNSURE

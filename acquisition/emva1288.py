"""Import of EMVA 1288 measurement sets: `EMVA1288_Data.txt` and the images that it lists."""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import FileFormatError, InputError
from ..files import read_utf8
from ._image_files import frame_dtype, iter_images
from .acquisition_io import write_acquisition
from .import_report import ImportReport, Skipped
from .instrument import Instrument

DATA_FILE = "EMVA1288_Data.txt"


@dataclass(slots=True, kw_only=True)
class _Level:
    bright: bool
    exposure_ms: float
    photons_per_pixel: float | None
    bits: int | None
    shape: tuple[int, int] | None
    files: list[Path] = field(default_factory=list)


def import_emva1288(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Turn an EMVA 1288 set into an acquisition file: a flat or dark series a level, in the order of the list.

    Lines of the list: `n BITS WIDTH HEIGHT` holds for what follows, `b EXPOSURE_NS PHOTONS` opens a bright level,
    `d EXPOSURE_NS` a dark one, `i FILE` names an image of it, `#` comments, `v` the version. File names may have
    backslashes. There is no tube voltage: what comes out calibrates gain, noise and linearity, not the spectrum.

    Args:
        source: the list, or the folder that holds it.
        out: acquisition file to write.
        progress: called with (images done, images in all).

    Raises:
        FileFormatError: no list, a line that cannot be read, an image that is missing, damaged or of another size.
    """
    data_file = _data_file(Path(source))
    levels, skipped = _levels(data_file)
    if not levels:
        raise FileFormatError(
            str(data_file), received="no level with images", expected="lines b or d followed by lines i"
        )
    bits = {level.bits for level in levels if level.bits is not None}
    notes = ["no tube voltage in this layout: gain, noise and linearity can be calibrated, no spectral part"]
    if len(bits) > 1:
        notes.append(f"levels of {', '.join(f'{one} bits' for one in sorted(bits))}: the instrument's bits stay open")
    read = []
    frames = highest = done = 0
    total = sum(len(level.files) for level in levels)
    with write_acquisition(out, Instrument(bits=bits.pop() if len(bits) == 1 else None, detector="area")) as writer:
        writer.attributes["source"] = data_file.name
        for number, level in enumerate(levels):
            kind = "flat" if level.bright else "dark"
            name = f"{kind}_{number:03d}_{level.exposure_ms:g}ms"
            series = None
            for path in level.files:
                for image in iter_images(path):
                    if level.shape is not None and image.shape != level.shape:
                        raise FileFormatError(
                            str(path),
                            received=f"{image.shape[0]} x {image.shape[1]} pixels",
                            expected=f"{level.shape[0]} x {level.shape[1]} as line n says",
                        )
                    if series is None:
                        series = writer.add_series(
                            name,
                            kind=kind,
                            shape=(image.shape[0], image.shape[1]),
                            dtype=frame_dtype(image),
                            exposure_ms=level.exposure_ms,
                            photons_per_pixel=level.photons_per_pixel,
                        )
                    series.append(image)
                    highest = max(highest, int(np.max(image)))
                done += 1
                if progress is not None:
                    progress(done, total)
            if series is not None:
                frames += series.n_frames
                entry = {"name": name, "kind": kind, "frames": series.n_frames, "exposure_ms": level.exposure_ms}
                if level.photons_per_pixel is not None:
                    entry["photons_per_pixel"] = level.photons_per_pixel
                read.append(entry)
    known_bits = [level.bits for level in levels if level.bits is not None]
    if known_bits and highest >= 2 ** max(known_bits):
        notes.append(
            f"values up to {highest} DN do not fit {max(known_bits)} bits: the images may be left-aligned,"
            " then gain and saturation are scaled with them"
        )
    return ImportReport(
        layout="emva1288",
        source=str(source),
        written=str(out),
        format="acquisition",
        read=tuple(read),
        frames=frames,
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


def _data_file(source: Path) -> Path:
    if source.is_file():
        return source
    if not source.is_dir():
        raise InputError(str(source), received="no such file or folder", expected=f"a folder with {DATA_FILE}")
    named = [path for path in source.iterdir() if path.name.lower() == DATA_FILE.lower()]
    if not named:
        raise InputError(
            str(source),
            received=f"a folder without {DATA_FILE}",
            expected=f"a folder with {DATA_FILE}",
            remedy="name the list itself if it has another name",
        )
    return named[0]


def _levels(data_file: Path) -> tuple[list[_Level], list[Skipped]]:
    lines = read_utf8(data_file).splitlines()
    levels: list[_Level] = []
    skipped: list[Skipped] = []
    bits: int | None = None
    shape: tuple[int, int] | None = None
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{data_file.name}, line {number}"
        key = words[0].lower()
        if key == "v":
            continue
        if key == "n":
            bits, width, height = (
                int(value) for value in _numbers(words[1:], 3, where=where, form="n BITS WIDTH HEIGHT")
            )
            shape = (height, width)
        elif key in ("b", "d"):
            form = "b EXPOSURE_NS PHOTONS" if key == "b" else "d EXPOSURE_NS"
            values = _numbers(words[1:], 2 if key == "b" else 1, where=where, form=form)
            levels.append(
                _Level(
                    bright=key == "b",
                    exposure_ms=values[0] / 1e6,
                    photons_per_pixel=values[1] if key == "b" else None,
                    bits=bits,
                    shape=shape,
                )
            )
        elif key == "i":
            if not levels:
                raise FileFormatError(where, received="an image before any level", expected="a line b or d first")
            levels[-1].files.append(_image_path(data_file.parent, line.split(None, 1)[1:], where=where))
        else:
            skipped.append(Skipped(what=where, reason=f"unknown line {line.strip()[:40]!r}"))
    for level in levels:
        if not level.files:
            kind = "bright" if level.bright else "dark"
            skipped.append(Skipped(what=f"{kind} level of {level.exposure_ms:g} ms", reason="it lists no images"))
    return [level for level in levels if level.files], skipped


def _numbers(words: list[str], count: int, *, where: str, form: str) -> list[float]:
    try:
        values = [float(word) for word in words[:count]]
    except ValueError:
        values = []
    if len(values) < count or not all(np.isfinite(value) and value >= 0 for value in values):
        raise FileFormatError(where, received=" ".join(words) or "nothing", expected=f"{form}, numbers of 0 or more")
    return values


def _image_path(folder: Path, rest: list[str], *, where: str) -> Path:
    if not rest:
        raise FileFormatError(where, received="no file name", expected="i FILE")
    relative = re.sub(r"[\\/]+", "/", rest[0].strip())
    path = folder / relative
    if not path.is_file():
        # Sets are made on systems that do not tell upper from lower case.
        path = _ignoring_case(folder, relative) or path
    if not path.is_file():
        raise FileFormatError(
            where,
            received=f"image {relative}",
            expected="a file that exists below the list",
            remedy="copy the images beside the list, under the names that it gives",
        )
    return path


def _ignoring_case(folder: Path, relative: str) -> Path | None:
    path = folder
    for part in relative.split("/"):
        match = [child for child in path.iterdir() if child.name.lower() == part.lower()] if path.is_dir() else []
        if not match:
            return None
        path = match[0]
    return path

"""Import of DICOM and DICONDE images, whose tags say at which setting they were taken.

Files of one folder, one DICOM series and one setting make a series, in the order of their instance numbers. What a series
shows is told by its folder, its description or its comments: `dark` or `offset`, `flat`, `gain`, `air` or `open`; a beam of
0 kV, 0 mA or 0 mAs is dark; all else shows an object. Where that is not right, write a sidecar and use `raytwin import images`.
"""

import itertools
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, InputError
from ._dicom_files import dicom_header, is_dicom, iter_dicom
from ._image_files import DICOM_ENDINGS, frame_dtype, natural_key
from ._image_header import ImageHeader
from .acquisition_io import write_acquisition
from .acquisition_writer import AcquisitionWriter, SeriesWriter
from .image_header import INSTRUMENT_WORDS, SETTING_WORDS, agreement, alike
from .import_report import ImportReport, Skipped
from .instrument import Instrument
from .setting import text_from_filters

_DARK_WORDS = frozenset({"dark", "darks", "offset", "offsets", "bias", "black"})
_FLAT_WORDS = frozenset({"flat", "flats", "flatfield", "flood", "gain", "air", "open", "white", "bright", "ff"})


@dataclass(slots=True, kw_only=True)
class _Group:
    """Files of one series: key (folder, DICOM series, shape, kind), header of the first, files with their headers."""

    key: tuple[Any, ...]
    first: ImageHeader
    files: list[tuple[Path, ImageHeader]] = field(default_factory=list)

    @property
    def kind(self) -> str:
        return str(self.key[-1])

    @property
    def started(self) -> tuple[float, float, tuple[Any, ...]]:
        """Sorts groups in time, those without a clock by the number of their series, then by their names."""
        times = [header.time_s for _, header in self.files if header.time_s is not None]
        number = self.first.series_number
        infinite = float("inf")
        return min(times, default=infinite), infinite if number is None else number, natural_key(self.files[0][0])


def import_dicom(
    source: str | os.PathLike[str], out: str | os.PathLike[str], *, progress: Callable[[int, int], None] | None = None
) -> ImportReport:
    """Turn DICOM or DICONDE files into an acquisition file: a series for each folder, DICOM series and setting.

    Args:
        source: a folder, searched with all below it, or one file.
        out: acquisition file to write.
        progress: called with (files read, files in all).

    Returns:
        What was read, what was skipped and why.

    Raises:
        InputError: no such place, or no DICOM images in it.
        FileFormatError: a damaged file, or values that are not proportional to the beam.
        MissingDependencyError: pydicom is not installed.
    """
    root = Path(source)
    files = _files(root)
    groups, skipped = _groups(root, files)
    headers = [header for group in groups for _, header in group.files]
    found = agreement(headers)
    values = {word: value for word in INSTRUMENT_WORDS if (value := found.values.get(word))}
    notes = [
        f"{word}: several values in the tags; none is taken" for word in INSTRUMENT_WORDS if word in found.differing
    ]
    notes += dict.fromkeys(note for header in headers for note in header.notes)
    notes.append("kinds of series are told by folders, descriptions and tube load: look at them")
    times = [header.time_s for header in headers if header.time_s is not None]
    start_s = min(times, default=0.0)
    read, done = [], 0
    with write_acquisition(out, Instrument(**values)) as writer:
        for number, group in enumerate(sorted(groups, key=lambda one: one.started), start=1):
            read.append(_write(writer, group, number, root, start_s, varying=set(found.differing)))
            done += len(group.files)
            if progress is not None:
                progress(done, len(headers))
    return ImportReport(
        layout="dicom",
        source=str(source),
        written=str(out),
        format="acquisition",
        read=tuple(read),
        frames=sum(int(entry["frames"]) for entry in read),
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


def _files(root: Path) -> list[Path]:
    if not root.exists():
        raise InputError(
            str(root),
            received="no such file or folder",
            expected="DICOM files, or a folder of them",
            remedy="check the path",
        )
    places = [root] if root.is_file() else sorted((path for path in root.rglob("*") if path.is_file()), key=natural_key)
    found = [path for path in places if path.suffix.lower() in DICOM_ENDINGS or is_dicom(path)]
    if not found:
        raise InputError(
            str(root),
            received=f"{len(places)} files, none of them DICOM",
            expected="DICOM files (`DICM` behind 128 bytes)",
            remedy="other images are read by `raytwin import images`",
        )
    return found


def _groups(root: Path, files: list[Path]) -> tuple[list[_Group], list[Skipped]]:
    groups: list[_Group] = []
    skipped = []
    for path in files:
        header = dicom_header(path)
        name = path.name if path == root else path.relative_to(root).as_posix()
        if header.shape is None:
            skipped.append(Skipped(what=name, reason="no image in it"))
            continue
        key = (path.parent, header.series, header.shape, _kind(name, header))
        dark = key[-1] == "dark"
        words = [word for word in SETTING_WORDS if not (dark and word in ("kV", "current_mA", "filters"))]
        group = next(
            (
                one
                for one in groups
                if one.key == key and all(_same(getattr(one.first, word), getattr(header, word)) for word in words)
            ),
            None,
        )
        if group is None:
            group = _Group(key=key, first=header)
            groups.append(group)
        group.files.append((path, header))
    if not groups:
        told = files[0].name + (f" and {len(files) - 1} more" if len(files) > 1 else "")
        raise InputError(
            str(root),
            received=f"DICOM files without images ({told})",
            expected="images",
            remedy="export the images themselves, not reports or a directory of them",
        )
    for group in groups:
        group.files.sort(key=lambda one: (one[1].number is None, one[1].number or 0, natural_key(one[0])))
    return groups, skipped


def _same(first: Any, second: Any) -> bool:
    return first is None and second is None if first is None or second is None else alike(first, second)


def _kind(name: str, header: ImageHeader) -> str:
    if header.kV == 0 or header.current_mA == 0:
        return "dark"
    words = set(re.split(r"[^a-z]+", f"{name.rsplit('.', 1)[0]} {header.label}".lower()))
    if words & _DARK_WORDS:
        return "dark"
    return "flat" if words & _FLAT_WORDS else "object"


def _write(
    writer: AcquisitionWriter, group: _Group, number: int, root: Path, start_s: float, *, varying: set[str]
) -> dict[str, Any]:
    told = agreement([header for _, header in group.files]).values
    dark = group.kind == "dark"
    setting: dict[str, Any] = {
        word: told.get(word) for word in SETTING_WORDS if not (dark and word in ("kV", "current_mA", "filters"))
    }
    distances: dict[str, Any] = {
        word: told.get(word) or None for word in ("source_object_mm", "source_detector_mm") if word in varying
    }
    folder = group.files[0][0].parent
    label = group.first.label or (folder.name if folder != root else group.files[0][0].stem)
    scene = re.sub(r"[/\s]+", "_", label.strip()) if group.kind == "object" else ""
    name = f"{number:03d}_{group.kind}"
    clock = _clock(group)
    series: SeriesWriter | None = None
    dtype: Any = None
    for path, header in group.files:
        for place, image in enumerate(iter_dicom(path)):
            if series is None:
                dtype = frame_dtype(image)
                series = writer.add_series(
                    name,
                    kind=group.kind,
                    shape=(image.shape[0], image.shape[1]),
                    dtype=dtype,
                    scene="" if scene in (".", "..") else scene,
                    **setting,
                    **distances,
                )
            time_s = None
            if clock and header.time_s is not None:
                time_s = header.time_s - start_s + place * (header.frame_interval_ms or 0.0) / 1000.0
            try:
                series.append(image, time_s=time_s)
            except InputError as error:
                raise FileFormatError(
                    str(path), received=error.received, expected=error.expected, remedy=error.remedy
                ) from None
    entry = {word: value for word, value in setting.items() if word != "filters"}
    filters = setting.get("filters")
    return {
        "name": name,
        "kind": group.kind,
        "frames": 0 if series is None else series.n_frames,
        **entry,
        "filter": None if filters is None else text_from_filters(filters),
        "scene": scene,
    }


def _clock(group: _Group) -> bool:
    """Whether the tags tell when each frame began: times that rise from file to file, and the time between a file's frames."""
    times = [header.time_s for _, header in group.files]
    known = [time_s for time_s in times if time_s is not None]
    rising = all(before < after for before, after in itertools.pairwise(known))
    return len(known) == len(times) and rising and (len(times) > 1 or group.first.frame_interval_ms is not None)

"""Import of NeXus NXtomo files: frames told apart by `image_key`, in the order in which they were taken."""

import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError
from ._hdf5 import child, frames_per_piece, open_hdf5, reading
from .acquisition_io import PIECE_BYTES, write_acquisition
from .import_report import ImportReport, Skipped
from .instrument import Instrument

KIND_OF_KEY = {0: "object", 1: "flat", 2: "dark"}
SCENE = "sample"

_MS_PER = {"s": 1000.0, "sec": 1000.0, "second": 1000.0, "seconds": 1000.0, "ms": 1.0, "us": 1e-3}
_MM_PER = {"m": 1000.0, "mm": 1.0, "cm": 10.0, "um": 1e-3, "µm": 1e-3, "micron": 1e-3, "microns": 1e-3}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Detector:
    name: str
    group: Any
    frames: Any
    image_key: NDArray[np.int64]


def import_nxtomo(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    detector: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Turn an NXtomo file into an acquisition file: a series for each unbroken run of one kind of frame.

    Runs keep their order, so that flats and darks before and after the projections stay apart and drift can be seen.
    Projections become object series of one scene without known thickness. Frames with image_key 3 (invalid) are
    skipped. Frames may lie in another file that the NeXus file links to; where the link's folder does not exist, a
    file of the same name beside the NeXus file is taken.

    Args:
        source: NeXus file, or a folder that holds one (`.nxs`).
        out: acquisition file to write.
        detector: name of the detector group, needed where several hold frames.
        progress: called with (frames done, frames in all).

    Raises:
        FileFormatError: no image_key, no frames that can be reached, or a different number of the two.
    """
    path = _nexus_file(Path(source))
    opened: list[Any] = [open_hdf5(path, what="a NeXus file")]
    try:
        chosen, notes = _choose(opened, path, detector)
        return _write(chosen, notes, source=str(source), path=path, out=out, progress=progress)
    finally:
        for file in reversed(opened):
            file.close()


def _nexus_file(source: Path) -> Path:
    if not source.is_dir():
        return source
    found = sorted(path for ending in ("*.nxs", "*.nx", "*.nexus") for path in source.glob(ending))
    if len(found) != 1:
        raise InputError(
            str(source),
            received=f"a folder with {len(found)} NeXus files",
            expected="one",
            remedy="name the file itself",
        )
    return found[0]


def _choose(opened: list[Any], path: Path, wanted: str | None) -> tuple[_Detector, list[str]]:
    groups: dict[str, Any] = {}

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Group) and isinstance(child(node, "image_key"), h5py.Dataset):
            groups[name] = node

    with reading(str(path)):
        opened[0].visititems(visit)
    if not groups:
        raise FileFormatError(
            str(path),
            received="no image_key",
            expected="an NXtomo file: image_key (0 projection, 1 flat, 2 dark) beside the frames",
        )
    if wanted is not None:
        groups = {name: node for name, node in groups.items() if name.rsplit("/", 1)[-1] == wanted}
        if not groups:
            raise InputError("detector", received=repr(wanted), expected=f"a group of {path.name} with image_key")
    detectors, notes = [], []
    for name, node in groups.items():
        frames = _frames(opened, path, node)
        short = name.rsplit("/", 1)[-1]
        if frames is None:
            notes.append(f"detector {short}: its frames cannot be reached (a link that leads nowhere)")
            continue
        with reading(f"{path}, {name}/image_key"):
            image_key = np.asarray(node["image_key"][()]).astype(np.int64).reshape(-1)
        if len(image_key) != frames.shape[0]:
            raise FileFormatError(
                f"{path}, {name}",
                received=f"{len(image_key)} image_key values for {frames.shape[0]} frames",
                expected="one a frame",
            )
        detectors.append(_Detector(name=short, group=node, frames=frames, image_key=image_key))
    # The same frames may stand under several names (an NXdata group that links to the detector); h5py compares objects
    # by their place in the file.
    told_most = sorted(detectors, key=lambda one: len(one.group))
    unique = {one.frames: one for one in told_most}
    if not unique:
        raise FileFormatError(
            str(path),
            received="no frames: " + "; ".join(notes),
            expected="a dataset `data` (n, row, column), here or in a linked file",
            remedy="put the linked file beside the NeXus file",
        )
    if len(unique) > 1:
        raise InputError(
            str(path),
            received="frames of several detectors: " + ", ".join(one.name for one in unique.values()),
            expected="one",
            remedy="choose with --detector NAME",
        )
    return next(iter(unique.values())), notes


def _frames(opened: list[Any], path: Path, group: Any) -> Any:
    """The dataset (n, row, column) of a detector group, here or behind a link to another file; None if unreachable."""
    for name in ("data", "value", "image"):
        link = group.get(name, getlink=True) if name in group or name in list(group) else None
        if link is None:
            continue
        dataset = child(group, name)
        if dataset is None and isinstance(link, h5py.ExternalLink):
            beside = path.parent / Path(link.filename.replace("\\", "/")).name
            if beside.is_file():
                opened.append(open_hdf5(beside, what=f"the file with the frames of {path.name}"))
                dataset = child(opened[-1], link.path)
        if isinstance(dataset, h5py.Dataset) and dataset.ndim == 3 and 0 not in dataset.shape:
            if dataset.dtype.kind not in "iuf":
                raise FileFormatError(
                    f"{path}, {group.name}/{name}", received=f"values of type {dataset.dtype}", expected="numbers"
                )
            return dataset
    return None


def _write(
    detector: _Detector,
    notes: list[str],
    *,
    source: str,
    path: Path,
    out: str | os.PathLike[str],
    progress: Callable[[int, int], None] | None,
) -> ImportReport:
    frames = detector.frames
    exposures_ms = _exposures_ms(detector, notes)
    pixel_mm = _length_mm(detector.group, ("x_pixel_size", "y_pixel_size"))
    skipped: list[Skipped] = []
    read: list[dict[str, Any]] = []
    notes.append("no tube voltage in this layout: no spectral part")
    dtype: type[Any] = np.uint16 if frames.dtype in (np.uint8, np.uint16) else np.float32
    total = 0
    with write_acquisition(out, Instrument(pixel_mm=pixel_mm, detector="area")) as writer:
        writer.attributes["source"] = path.name
        for start, stop in _runs(detector.image_key, exposures_ms):
            key = int(detector.image_key[start])
            kind = KIND_OF_KEY.get(key)
            if kind is None:
                reason = "marked as invalid (image_key 3)" if key == 3 else f"image_key {key} is unknown"
                skipped.append(Skipped(what=f"frames {start} to {stop - 1}", reason=reason))
                continue
            exposure_ms = None if exposures_ms is None else float(exposures_ms[start])
            name = f"{len(read):03d}_{kind}"
            series = writer.add_series(
                name,
                kind=kind,
                shape=(int(frames.shape[1]), int(frames.shape[2])),
                dtype=dtype,
                exposure_ms=exposure_ms,
                scene=SCENE if kind == "object" else "",
            )
            for piece in _pieces(frames, start, stop, path=path):
                series.append(piece)
                if progress is not None:
                    progress(start + series.n_frames, len(detector.image_key))
            total += stop - start
            read.append({"name": name, "kind": kind, "frames": stop - start, "first_frame": start})
            if exposure_ms is not None:
                read[-1]["exposure_ms"] = exposure_ms
        if any(entry["kind"] == "object" for entry in read):
            writer.add_scene(SCENE, kind="product", attributes={"turning": True})
    return ImportReport(
        layout="nxtomo",
        source=source,
        written=str(out),
        format="acquisition",
        read=tuple(read),
        frames=total,
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


def _runs(image_key: NDArray[np.int64], exposures_ms: NDArray[np.float64] | None) -> Iterator[tuple[int, int]]:
    changes = np.diff(image_key) != 0
    if exposures_ms is not None:
        changes |= np.diff(exposures_ms) != 0
    edges = [0, *(np.flatnonzero(changes) + 1).tolist(), len(image_key)]
    yield from itertools.pairwise(edges)


def _pieces(frames: Any, start: int, stop: int, *, path: Path) -> Iterator[NDArray[Any]]:
    step = frames_per_piece(
        chunk_frames=None if frames.chunks is None else int(frames.chunks[0]),
        frame_bytes=int(np.prod(frames.shape[1:])) * max(4, frames.dtype.itemsize),
        maximum_bytes=PIECE_BYTES,
    )
    for first in range(start, stop, step):
        with reading(f"{path}, frames {first} to {min(first + step, stop) - 1}"):
            piece: NDArray[Any] = frames[first : min(first + step, stop)]
        yield piece


def _exposures_ms(detector: _Detector, notes: list[str]) -> NDArray[np.float64] | None:
    dataset = child(detector.group, "count_time")
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iuf":
        notes.append("no count_time: the exposure time is unknown")
        return None
    values = np.asarray(dataset[()], dtype=np.float64).reshape(-1) * _factor(dataset, _MS_PER, default=1000.0)
    n = len(detector.image_key)
    if len(values) not in (1, n) or not bool(np.all(np.isfinite(values) & (values > 0))):
        notes.append(f"count_time holds {len(values)} values that do not make exposure times: left out")
        return None
    return np.broadcast_to(values, (n,))


def _length_mm(group: Any, names: tuple[str, ...]) -> float | None:
    for name in names:
        dataset = child(group, name)
        if isinstance(dataset, h5py.Dataset) and dataset.size == 1 and dataset.dtype.kind in "iuf":
            length = float(np.asarray(dataset[()]).reshape(())) * _factor(dataset, _MM_PER, default=1000.0)
            if np.isfinite(length) and length > 0:
                return length
    return None


def _factor(dataset: Any, table: dict[str, float], *, default: float) -> float:
    """Into our unit; NeXus takes SI where no unit is written."""
    unit = dataset.attrs.get("units", "")
    text = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return table.get(text.strip().lower(), default)

"""The acquisition file: measured series with their settings, read in pieces, written whole or not at all."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import MappingProxyType, TracebackType
from typing import Any, Self, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError
from ..files import whole_file
from ..results import Table, counted
from ._acquisition_words import (
    CORRECTIONS,
    ERROR,
    FORMAT,
    KINDS,
    PANEL_LAYERS,
    ROLES,
    VERSION,
    bounds_of,
    text_from_shape,
)
from ._hdf5 import (
    check_format,
    check_open,
    check_stored,
    child,
    frames_per_piece,
    named,
    number_attribute,
    open_hdf5,
    plain_attributes,
    reading,
    text_attribute,
    whole_attribute,
)
from .acquisition_writer import AcquisitionWriter, written_acquisition
from .instrument import Instrument
from .instrument_io import filters_attribute, read_instrument
from .scenes import Scene, read_scene
from .setting import Filter, Setting

PIECE_BYTES = 64 * 2**20

_Made = TypeVar("_Made")
_LARGEST_EXACT_FLOAT32 = 2**24


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Frames taken one after the other at one setting of one scene; the frames stay in the file until they are read.

    Fields: name; index (order in time among the series); kind (`dark`, `flat`, `object`, `afterglow`); kV, exposure_ms,
    current_mA, power_W (None: unknown or beam off); filters; averaged (frames averaged into each one);
    frame_interval_ms; belt_speed_mm_s; panel_rotation_deg (counter-clockwise as the panel sees the source);
    source_object_mm and source_detector_mm (None: the instrument's); photons_per_pixel (None: not measured); scene
    (empty: none); layer (`front`, `back` of a dual-layer panel, or None); session (0, or its number where several were
    merged); corrected (subset of `offset`, `gain`, `defects`, `log`; empty = raw); role (`calibration`,
    `evaluation`, or None for either); setting (None where kV or exposure is unknown); n_frames; shape (row, column);
    time_s (n_frames,) or None; left_out (indices of stored frames that are passed over).
    """

    name: str
    index: int
    kind: str
    kV: float | None
    exposure_ms: float | None
    current_mA: float | None
    power_W: float | None
    filters: tuple[Filter, ...]
    averaged: int
    frame_interval_ms: float | None
    belt_speed_mm_s: float | None
    panel_rotation_deg: float
    source_object_mm: float | None
    source_detector_mm: float | None
    photons_per_pixel: float | None
    scene: str
    corrected: frozenset[str]
    role: str | None
    setting: Setting | None
    n_frames: int
    shape: tuple[int, int]
    time_s: NDArray[np.float64] | None
    _frames: Any
    _where: str
    layer: str | None = None
    session: int = 0
    left_out: frozenset[int] = frozenset()

    def without_frames(self, indices: Iterable[int]) -> "Series":
        """The series without some of its frames (by index): `iter_frames` passes them over, and `n_frames` counts the rest."""
        gone = frozenset(indices) | self.left_out
        return replace(self, left_out=gone, n_frames=self.n_frames - len(gone - self.left_out))

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the frames that are handed out: uint16 where the file holds uint8 or uint16, else float32."""
        return np.dtype(np.uint16 if self._frames.dtype in (np.uint8, np.uint16) else np.float32)

    def iter_frames(self, *, maximum_bytes: int = PIECE_BYTES) -> Iterator[NDArray[Any]]:
        """Yield the frames (DN) in time order as arrays (m, row, column), each of about `maximum_bytes` at most.

        A piece holds at least one frame, and whole chunks of the file where a chunk is not more than four times
        `maximum_bytes`.

        Raises:
            FileFormatError: a frame that cannot be read or holds a value that is not finite; the series is named.
        """
        check_open(self._frames, where=self._where)
        chunks = self._frames.chunks
        pixels = self.shape[0] * self.shape[1]
        step = frames_per_piece(
            chunk_frames=None if chunks is None else int(chunks[0]),
            frame_bytes=pixels * max(self.dtype.itemsize, self._frames.dtype.itemsize),
            maximum_bytes=maximum_bytes,
        )
        stored = self.n_frames + len(self.left_out)
        for start in range(0, stored, step):
            piece = self._read(start, min(start + step, stored))
            if self.left_out:
                kept = [place for place in range(len(piece)) if start + place not in self.left_out]
                if not kept:
                    continue
                piece = piece[kept]
            yield piece

    def read_frames(self, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Frames `start` up to but without `stop` (DN), one array (m, row, column); negative numbers as in a slice."""
        first, last, _ = slice(start, stop).indices(self.n_frames)
        return self._read(first, max(first, last))

    def _read(self, start: int, stop: int) -> NDArray[Any]:
        check_open(self._frames, where=self._where)
        with reading(self._where):
            frames: NDArray[Any] = self._frames[start:stop]
        wide = frames.dtype.kind in "iu" and frames.dtype not in (np.uint8, np.uint16) and frames.size > 0
        if wide and max(abs(int(frames.min())), abs(int(frames.max()))) > _LARGEST_EXACT_FLOAT32:
            raise FileFormatError(
                f"{self._where}/frames",
                received=f"a value beyond {_LARGEST_EXACT_FLOAT32} DN",
                expected="detector numbers of at most 24 bits",
            )
        frames = np.ascontiguousarray(frames, dtype=self.dtype)
        if frames.dtype.kind == "f" and not bool(np.isfinite(frames).all()):
            bad = np.argwhere(~np.isfinite(frames))[0]
            raise FileFormatError(
                f"{self._where}/frames",
                received=f"a value that is not finite in frame {start + int(bad[0])}, row {bad[1]}, column {bad[2]}",
                expected="finite detector numbers",
                remedy="remove the frame or mark the pixel as defect with its last good value",
            )
        return frames


@dataclass(slots=True, kw_only=True, repr=False)
class AcquisitionFile:
    """An open acquisition file; use it in a `with` block.

    Fields: path; paths (of the files, one a session where several were merged); instrument; series (in order of time);
    scenes (by name); attributes (of the file); missing (what the file does not hold, each with what cannot be done
    without it).
    """

    path: str
    paths: tuple[str, ...]
    instrument: Instrument
    series: tuple[Series, ...]
    scenes: dict[str, Scene]
    attributes: Mapping[str, Any]
    missing: tuple[str, ...]
    _file: Any

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return self._table().as_text()

    def _repr_html_(self) -> str:
        return self._table().as_html()

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        # opened again where it arrives: an HDF5 handle does not survive the way there
        return open_acquisition, (self.path,)

    def _table(self) -> Table:
        rows = tuple(
            (item.name, item.kind, str(item.n_frames), "" if item.setting is None else str(item.setting), item.scene)
            for item in self.series
        )
        closed = "" if self._file else ", closed"
        return Table(
            title=f"Acquisition {self.path}: {len(self.series)} series, {counted(len(self.scenes), 'scene')}{closed}",
            header=("series", "kind", "frames", "setting", "scene"),
            rows=rows,
        )

    def close(self) -> None:
        """Close the file; its series and scenes cannot be read afterwards."""
        self._file.close()

    def check_open(self) -> None:
        """Refuse a file that was closed.

        Raises:
            InputError: `close` was called, or the `with` block has ended.
        """
        check_open(self._file, where=self.path)

    def of_kind(self, *kinds: str) -> tuple[Series, ...]:
        """The series of these kinds, in order of time."""
        return tuple(series for series in self.series if series.kind in kinds)


def open_acquisition(path: str | os.PathLike[str], *, damage: list[FileFormatError] | None = None) -> AcquisitionFile:
    """Open an acquisition file and check everything but the frames' values; those are checked as they are read.

    Args:
        path: HDF5 file with root attributes `format = "raytwin-acquisition"`, `version = 1`.
        damage: where a list is given, series and scenes that cannot be read are left out and their errors put there.

    Returns:
        The open file, a context manager.

    Raises:
        FileFormatError: not there, truncated, not HDF5, another format or version, a series without frames, an
            attribute that is not a number or out of range, masks or maps of another shape than the frames.
    """
    file = open_hdf5(path, what="an acquisition file")
    try:
        with reading(str(path)):
            return _acquisition(file, path=str(path), damage=damage)
    except BaseException:
        file.close()
        raise


@contextmanager
def write_acquisition(
    path: str | os.PathLike[str], instrument: Instrument | None = None, *, compression: str | None = None
) -> Iterator[AcquisitionWriter]:
    """Write an acquisition file in a `with` block; it appears under its name when the block succeeds, or not at all.

    Args:
        path: the file to write; an existing one is replaced.
        instrument: what is known about the line.
        compression: None (fastest), `gzip`, or `lzf` (not the same bytes each time), for the frames.

    Raises:
        InputError: what was written does not make a valid file (no series, a series without frames, masks of
            another shape, an attribute out of range).
    """
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:

        def check() -> object:  # the reader's own checks, so that nothing is written that could not be read
            return _acquisition(file, path=str(path))

        with written_acquisition(file, instrument or Instrument(), compression=compression, check=check) as writer:
            yield writer


def _acquisition(file: Any, *, path: str, damage: list[FileFormatError] | None = None) -> AcquisitionFile:
    check_format(file, path=path, format_name=FORMAT, version=VERSION)
    group = child(file, "series")
    if not isinstance(group, h5py.Group) or len(group) == 0:
        raise FileFormatError(path, received="no series", expected="at least one series of frames below /series")
    found = [series for _, series in _each(group, path, _series, damage)]
    numbered = sorted((series for series in found if series.index >= 0), key=lambda series: (series.index, series.name))
    # Series without an index come last, in the order of their names.
    unnumbered = sorted((series for series in found if series.index < 0), key=lambda series: series.name)
    scenes = _scenes(file, path=path, damage=damage)
    for series in found:
        scene = scenes.get(series.scene)
        if scene is not None and scene.shape not in (None, series.shape):
            error = FileFormatError(
                f"{path}, scene {scene.name}",
                received=f"masks or maps of {text_from_shape(scene.shape)} pixels",
                expected=f"{text_from_shape(series.shape)} pixels as in the frames of series {series.name}",
                remedy="give masks on the detector's own pixels",
            )
            if damage is None:
                raise error
            damage.append(error)
            del scenes[series.scene]
    instrument = read_instrument(child(file, "instrument"), path=path)
    ordered = tuple(numbered + unnumbered)
    if instrument.counting and not any(series.kind == "dark" for series in ordered):
        # a detector that counts photons has a dark of 0 by declaration: its frames are as if a dark were taken off
        ordered = tuple(replace(series, corrected=series.corrected | {"offset"}) for series in ordered)
    return AcquisitionFile(
        path=path,
        paths=(path,),
        instrument=instrument,
        series=ordered,
        scenes=scenes,
        attributes=MappingProxyType(dict(plain_attributes(file, where=path))),
        missing=_missing(ordered, instrument, unnumbered=len(unnumbered)),
        _file=file,
    )


def _each(
    group: Any, path: str, make: Callable[..., _Made], damage: list[FileFormatError] | None
) -> list[tuple[str, _Made]]:
    """What `make` makes of every member of a group, by name; members at fault go to `damage` where that is a list."""
    made = []
    for name in group:
        try:
            if isinstance(name, bytes):  # h5py's way to hand out what is no text
                raise FileFormatError(path, received=f"a name that is no text, {name!r}", expected="names in UTF-8")
            with reading(f"{path}, {name}"):
                made.append((name, make(group, name, path=path)))
        except FileFormatError as error:
            if damage is None:
                raise
            damage.append(error)
    return made


_SERIES_WORDS = {
    word.lower(): word
    for word in [
        "kind",
        "index",
        "role",
        "layer",
        "scene",
        "corrected",
        "kV",
        "current_mA",
        "power_W",
        "exposure_ms",
        "filter",
        "averaged",
        "binning",
        "frame_interval_ms",
        "belt_speed_mm_s",
        "panel_rotation_deg",
        "source_object_mm",
        "source_detector_mm",
        "photons_per_pixel",
    ]
}


def _series(group: Any, name: str, *, path: str) -> Series:
    where = f"{path}, series {name}"
    node = child(group, name)
    frames = _frames(node, where=where)
    _check_spelling(node, where=where)
    kind = _one_of(node, "kind", KINDS, where=where)
    if kind is None:
        raise FileFormatError(f"{where}, attribute kind", received="nothing", expected="one of " + ", ".join(KINDS))

    def number(attribute: str) -> float | None:
        return number_attribute(node, attribute, where=where, **bounds_of(attribute, kind))

    def whole(attribute: str) -> int | None:
        return whole_attribute(node, attribute, where=where, **bounds_of(attribute, kind))

    kV, current_mA, power_W = (number(load) or None for load in ("kV", "current_mA", "power_W"))
    exposure_ms, source_detector_mm = number("exposure_ms"), number("source_detector_mm")
    filters = filters_attribute(node, "filter", where=where) or ()
    averaged = whole("averaged") or 1
    setting = None
    if kV is not None and exposure_ms:
        with named(where):
            setting = Setting(
                kV=kV,
                exposure_ms=exposure_ms,
                current_mA=current_mA,
                power_W=power_W,
                filters=filters,
                averaged=averaged,
                source_detector_mm=source_detector_mm,
                binning=whole("binning") or 1,
            )
    corrected = _corrections(node, where=where)
    role = _one_of(node, "role", ROLES, where=where)
    layer = _one_of(node, "layer", PANEL_LAYERS, where=where)
    index = whole("index")
    return Series(
        name=name,
        index=-1 if index is None else index,
        kind=kind,
        kV=kV,
        exposure_ms=exposure_ms,
        current_mA=current_mA,
        power_W=power_W,
        filters=filters,
        averaged=averaged,
        frame_interval_ms=number("frame_interval_ms"),
        belt_speed_mm_s=number("belt_speed_mm_s"),
        panel_rotation_deg=number("panel_rotation_deg") or 0.0,
        source_object_mm=number("source_object_mm"),
        source_detector_mm=source_detector_mm,
        photons_per_pixel=number("photons_per_pixel"),
        scene=text_attribute(node, "scene", where=where) or "",
        corrected=corrected,
        role=role,
        setting=setting,
        n_frames=int(frames.shape[0]),
        shape=(int(frames.shape[1]), int(frames.shape[2])),
        time_s=_times(node, n_frames=int(frames.shape[0]), where=where),
        _frames=frames,
        _where=where,
        layer=layer,
    )


def _frames(node: Any, *, where: str) -> Any:
    """The dataset of a series' frames, complete; the error of a series that an importer left out is raised again."""
    frames = child(node, "frames") if isinstance(node, h5py.Group) else None
    if not isinstance(frames, h5py.Dataset):
        if isinstance(node, h5py.Group) and ERROR in node.attrs:
            argument, received, expected, remedy = (str(text) for text in node.attrs[ERROR])
            raise FileFormatError(f"{where}, {argument}", received=received, expected=expected, remedy=remedy)
        raise FileFormatError(where, received="no dataset `frames`", expected="frames (n, row, column)")
    if frames.ndim != 3 or 0 in frames.shape:
        raise FileFormatError(
            f"{where}/frames",
            received=f"shape ({text_from_shape(frames.shape)})",
            expected="at least one frame, (n, row, column)",
        )
    if frames.dtype.kind not in "iuf":
        raise FileFormatError(
            f"{where}/frames", received=f"values of type {frames.dtype}", expected="uint16 or float32 detector numbers"
        )
    check_stored(frames, where=f"{where}/frames")
    return frames


def _check_spelling(node: Any, *, where: str) -> None:
    """Refuse a known attribute in other capitals: it would be passed over without a word."""
    for word in node.attrs:
        meant = _SERIES_WORDS.get(str(word).lower())
        if meant not in (None, word):
            raise FileFormatError(
                f"{where}, attribute {word}", received=repr(word), expected=f"{meant}, written like that"
            )


def _one_of(node: Any, attribute: str, known: Sequence[str], *, where: str) -> str | None:
    """A text attribute that is one of those known; None where it is absent or empty."""
    text = text_attribute(node, attribute, where=where) or None
    if text is not None and text not in known:
        raise FileFormatError(
            f"{where}, attribute {attribute}", received=repr(text), expected="one of " + ", ".join(known)
        )
    return text


def _corrections(node: Any, *, where: str) -> frozenset[str]:
    """What was done to the frames of a series."""
    corrected = frozenset(word for word in (text_attribute(node, "corrected", where=where) or "").split("+") if word)
    if not corrected <= set(CORRECTIONS):
        raise FileFormatError(
            f"{where}, attribute corrected",
            received="+".join(sorted(corrected)),
            expected="any of " + ", ".join(CORRECTIONS) + ", joined by +",
        )
    return corrected


def _times(node: Any, *, n_frames: int, where: str) -> NDArray[np.float64] | None:
    dataset = child(node, "time_s")
    if dataset is None:
        return None
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iuf":
        raise FileFormatError(f"{where}/time_s", received="something that is no list of numbers", expected="times in s")
    with reading(f"{where}/time_s"):
        time_s = np.asarray(dataset[()], dtype=np.float64)
    if time_s.shape != (n_frames,) or not bool(np.all(np.isfinite(time_s))) or bool(np.any(np.diff(time_s) < 0)):
        raise FileFormatError(
            f"{where}/time_s",
            received=f"{text_from_shape(time_s.shape)} values"
            if time_s.shape != (n_frames,)
            else "times that are not in order",
            expected=f"{n_frames} finite times in s that never fall",
        )
    time_s.setflags(write=False)
    return time_s


def _scenes(file: Any, *, path: str, damage: list[FileFormatError] | None) -> dict[str, Scene]:
    group = child(file, "scenes")
    return dict(_each(group, path, read_scene, damage)) if isinstance(group, h5py.Group) else {}


def _missing(series: tuple[Series, ...], instrument: Instrument, *, unnumbered: int) -> tuple[str, ...]:
    told = []
    kinds = {one.kind for one in series}
    lit = [one for one in series if one.kind in ("flat", "object")]
    if unnumbered:
        told.append(f"{unnumbered} series without index: their order in time is taken from their names")
    if "dark" not in kinds:
        told.append(
            "no dark series: a detector that counts photons has a dark of 0"
            if instrument.counting
            else "no dark series: dark level and read noise cannot be measured"
        )
    if "flat" not in kinds:
        told.append("no flat series: gain, flux and blur cannot be calibrated, nor objects be corrected")
    without_kV = sum(one.kV is None for one in lit)
    if without_kV:
        told.append(f"{without_kV} of {len(lit)} exposed series without kV: no spectral part for them")
    without_load = sum(one.current_mA is None and one.power_W is None for one in lit)
    if without_load:
        told.append(f"{without_load} of {len(lit)} exposed series without current or power: no flux scale from them")
    without_exposure = sum(one.exposure_ms is None for one in series)
    if without_exposure:
        told.append(f"{without_exposure} series without exposure time: no pairing with darks by exposure")
    if instrument.pixel_mm is None:
        told.append("no pixel size: lengths stay in pixels, photons per area unknown")
    if instrument.source_detector_mm is None and any(one.source_detector_mm is None for one in lit):
        told.append("no source-detector distance: the flux of the tube cannot be scaled to the detector")
    if instrument.scintillator is None:
        told.append("no scintillator: the default of the twin is assumed")
    return tuple(told)

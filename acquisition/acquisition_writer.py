"""Writing of an acquisition file: its instrument, its scenes, and series whose frames come piece by piece."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError, check_number
from ._acquisition_words import CORRECTIONS, ERROR, FORMAT, KINDS, ROLES, SCENE_KINDS, VERSION, text_from_shape
from ._hdf5 import QUICK_GZIP, mark_as_entry, mark_as_pictures
from .instrument import Instrument
from .instrument_io import write_instrument
from .setting import Filter, Setting, text_from_filters

_CHUNK_BYTES = 2**17


class SeriesWriter:
    """Appends frames to one series of the file being written."""

    def __init__(self, group: Any, *, name: str, dataset: Any) -> None:
        self.name = name
        self._group = group
        self._dataset = dataset
        self._time_s: list[float] = []

    @property
    def n_frames(self) -> int:
        """How many frames have been written."""
        return int(self._dataset.shape[0])

    def append(self, frames: NDArray[Any], *, time_s: float | Sequence[float] | NDArray[Any] | None = None) -> None:
        """Append one frame (row, column) or several (m, row, column), with their times (s) where they are known.

        Raises:
            InputError: another shape, a value that is not finite, or one that the series' type cannot hold.
        """
        block = np.asarray(frames)
        if block.ndim == 2:
            block = block[None]
        if block.ndim != 3 or block.shape[1:] != self._dataset.shape[1:]:
            raise InputError(
                f"frames of series {self.name}",
                received=f"shape ({text_from_shape(block.shape)})",
                expected=f"frames of {text_from_shape(self._dataset.shape[1:])} pixels as before",
            )
        block = _storable(block, self._dataset.dtype, name=self.name)
        times = [] if time_s is None else np.atleast_1d(np.asarray(time_s, dtype=np.float64)).tolist()
        if time_s is not None and len(times) != len(block):
            raise InputError(
                f"time_s of series {self.name}", received=f"{len(times)} times", expected=f"{len(block)}, one a frame"
            )
        before = self.n_frames
        self._dataset.resize(before + len(block), axis=0)
        self._dataset[before:] = block
        self._time_s += times

    def _finish(self) -> None:
        timed = len(self._time_s) == self.n_frames > 0
        if self._time_s:
            self._group.create_dataset("time_s", data=np.asarray(self._time_s, dtype=np.float64))
        mark_as_pictures(self._group, "frames", axes=("time_s", ".", ".") if timed else ())


class AcquisitionWriter:
    """An acquisition file being written; made by `write_acquisition`."""

    def __init__(self, file: Any, *, compression: str | None) -> None:
        self.attributes: Any = file.attrs
        self._compression = compression
        self._series = file.create_group("series")
        self._scenes = file.require_group("scenes")
        self._writers: list[SeriesWriter] = []
        self._left_out: dict[str, FileFormatError] = {}
        self._next_index = 0

    @property
    def scene_names(self) -> tuple[str, ...]:
        """The scenes that have been added."""
        return tuple(self._scenes)

    def leave_out(self, name: str, error: FileFormatError) -> None:
        """Put a series' error in its place, where an importer goes on without what it cannot read; readers raise it."""
        if name in self._series:
            del self._series[name]
        self._writers = [writer for writer in self._writers if writer.name != name]
        self._left_out[name] = error

    def _mark_left_out(self) -> None:
        for name, error in self._left_out.items():
            group = self._series.require_group(name)
            group.attrs[ERROR] = [error.argument, str(error.received), error.expected, error.remedy]

    def add_series(
        self,
        name: str,
        *,
        kind: str,
        frames: NDArray[Any] | Iterable[NDArray[Any]] | None = None,
        shape: tuple[int, int] | None = None,
        dtype: Any = None,
        chunk_frames: int | None = None,
        index: int | None = None,
        setting: Setting | None = None,
        kV: float | None = None,
        exposure_ms: float | None = None,
        current_mA: float | None = None,
        power_W: float | None = None,
        filters: Iterable[Filter] | None = None,
        averaged: int | None = None,
        frame_interval_ms: float | None = None,
        belt_speed_mm_s: float | None = None,
        panel_rotation_deg: float | None = None,
        source_object_mm: float | None = None,
        source_detector_mm: float | None = None,
        photons_per_pixel: float | None = None,
        scene: str = "",
        corrected: Iterable[str] = (),
        role: str | None = None,
        layer: str | None = None,
        time_s: NDArray[Any] | Sequence[float] | None = None,
    ) -> SeriesWriter:
        """Start a series, with its frames at once or with `append` on what is returned.

        Args:
            name: unique in the file, without `/`.
            kind: `dark`, `flat`, `object` or `afterglow`.
            frames: (n, row, column), one frame (row, column), or an iterable of such arrays; None: append later.
            shape: (row, column), needed where `frames` is None.
            dtype: uint16 or float32; by default uint16 for integers and float32 for the rest.
            chunk_frames: frames a chunk of the file holds; by default 1, more where frames are tiny.
            index: order in time; by default after the series added before.
            setting: the setting as one value; or the single attributes instead, each None where unknown: kV; exposure_ms;
                current_mA or power_W; filters; averaged (frames averaged into each); frame_interval_ms; belt_speed_mm_s.
            panel_rotation_deg: of the panel about its normal.
            source_object_mm, source_detector_mm: where they are not the instrument's.
            photons_per_pixel: of light whose photons were counted otherwise (EMVA 1288).
            scene: name of a scene added before; empty: the open beam.
            corrected: what was done to the frames (`offset`, `gain`, `defects`, `log`).
            role: `calibration` or `evaluation`; None: either.
            layer: `front` or `back`, of a dual-layer panel.
            time_s: (n,) times of the frames in s, where they are known.

        Returns:
            The writer of this series.

        Raises:
            InputError: a name used twice, an unknown kind, frames of mixed shapes or values the type cannot hold.
        """
        _check_name("series name", name, taken=self._series)
        words = tuple(corrected)
        _check_words(name, kind=kind, corrected=words, role=role)
        if kind in ("flat", "object"):
            for label, value in (("kV", kV), ("current_mA", current_mA), ("power_W", power_W)):
                if value is not None:
                    check_number(f"{label} of series {name}", value)
        group = self._series.create_group(name)
        number = self._next_index if index is None else int(index)
        self._next_index = max(self._next_index, number + 1)
        stated: dict[str, Any] = {
            "index": number,
            "kind": kind,
            "kV": kV,
            "exposure_ms": exposure_ms,
            "current_mA": current_mA,
            "power_W": power_W,
            "filter": None if filters is None else text_from_filters(filters),
            "averaged": averaged,
            "frame_interval_ms": frame_interval_ms,
            "belt_speed_mm_s": belt_speed_mm_s,
            "panel_rotation_deg": panel_rotation_deg,
            "source_object_mm": source_object_mm,
            "source_detector_mm": source_detector_mm,
            "photons_per_pixel": photons_per_pixel,
            "scene": scene or None,
            "corrected": "+".join(word for word in CORRECTIONS if word in words) or None,
            "role": role,
            "layer": layer,
        }
        given = {key: value for key, value in stated.items() if value is not None}
        for key, value in (given if setting is None else _attributes_of(setting) | given).items():
            if value is not None:
                group.attrs[key] = value
        pieces = _pieces(frames)
        first = next(pieces, None)
        shape, dtype = _layout(name, first, shape=shape, dtype=dtype)
        dataset = group.create_dataset(
            "frames",
            shape=(0, *shape),
            maxshape=(None, *shape),
            dtype=dtype,
            chunks=(chunk_frames or _chunk_frames(shape, np.dtype(dtype), frames), *shape),
            compression=self._compression,
            shuffle=self._compression is not None,
        )
        writer = SeriesWriter(group, name=name, dataset=dataset)
        self._writers.append(writer)
        while first is not None:
            writer.append(first)
            first = next(pieces, None)
        if time_s is not None:
            writer._time_s = np.asarray(time_s, dtype=np.float64).tolist()
        return writer

    def add_scene(
        self,
        name: str,
        *,
        kind: str,
        thickness_mm: Mapping[str, NDArray[Any]] | None = None,
        foreign_object_mask: NDArray[Any] | None = None,
        product_mask: NDArray[Any] | None = None,
        product: str = "",
        foreign_object: str = "",
        size_mm: float | None = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> None:
        """Add what stood in the beam: path lengths (mm) for every pixel by material, masks, identifiers.

        Args:
            name: what the series' `scene` says.
            kind: `wedge`, `slab`, `edge`, `disc` or `product`.
            thickness_mm: material -> (row, column) path length along the ray that ends in that pixel.
            foreign_object_mask, product_mask: (row, column), anything but 0 is inside.
            product, foreign_object: identifiers; empty = none or unknown.
            size_mm: size of the foreign object; None or NaN = unknown.
            attributes: further attributes to keep with the scene.
        """
        _check_name("scene name", name, taken=self._scenes)
        if kind not in SCENE_KINDS:
            raise InputError(f"kind of scene {name}", received=repr(kind), expected="one of " + ", ".join(SCENE_KINDS))
        group = self._scenes.create_group(name)
        told = {"kind": kind, "product": product or None, "foreign_object": foreign_object or None, "size_mm": size_mm}
        for key, value in {**(attributes or {}), **told}.items():
            if value is not None:
                group.attrs[key] = value
        for material, plane in (thickness_mm or {}).items():
            _check_name(f"material of scene {name}", material, taken=())
            lengths = np.asarray(plane, dtype=np.float32)
            if not bool(np.all(np.isfinite(lengths) & (lengths >= 0))):
                raise InputError(
                    f"thickness of {material} in scene {name}",
                    received="a negative or non-finite value",
                    expected="finite path lengths of 0 mm or more",
                )
            # Maps are smooth and mostly empty: compression costs little and saves most of the space.
            group.create_dataset(f"thickness_mm/{material}", data=lengths, shuffle=True, **QUICK_GZIP)
        for mask_name, mask in (("foreign_object_mask", foreign_object_mask), ("product_mask", product_mask)):
            if mask is not None:
                data = (np.asarray(mask) != 0).astype(np.uint8)
                group.create_dataset(mask_name, data=data, **QUICK_GZIP)

    def _finish(self) -> None:
        for writer in self._writers:
            writer._finish()
        if self._writers:
            # a flat shows more than a dark does
            shown = [name for name in self._series if self._series[name].attrs["kind"] in ("flat", "object")]
            mark_as_entry(self._series, next(iter(shown), self._writers[0].name))
        for group in self._scenes.values():
            maps = list(group.get("thickness_mm", ()))
            if maps:
                mark_as_pictures(group["thickness_mm"], maps[0], others=maps[1:])
            masks = [name for name in ("foreign_object_mask", "product_mask") if name in group]
            if masks:
                mark_as_pictures(group, masks[0], others=masks[1:])


@contextmanager
def written_acquisition(
    file: Any, instrument: Instrument, *, compression: str | None, check: Callable[[], object]
) -> Iterator[AcquisitionWriter]:
    """Write into an empty HDF5 file in a `with` block.

    Args:
        file: an empty HDF5 file that is open for writing.
        instrument: what is known about the line.
        compression: None, `gzip`, or `lzf` (not the same bytes each time), for the frames.
        check: reads the file when all is written but the errors of series that were left out.
    """
    file.attrs["format"] = FORMAT
    file.attrs["version"] = VERSION
    file.attrs.update({"NX_class": "NXroot", "default": "series"})
    write_instrument(file.create_group("instrument"), instrument)
    writer = AcquisitionWriter(file, compression=compression)
    yield writer
    writer._finish()
    if writer._writers or not writer._left_out:
        check()
    writer._mark_left_out()


def _check_words(name: str, *, kind: str, corrected: tuple[str, ...], role: str | None) -> None:
    """Refuse a kind, correction or role that readers do not know."""
    if kind not in KINDS:
        raise InputError(f"kind of series {name}", received=repr(kind), expected="one of " + ", ".join(KINDS))
    if not set(corrected) <= set(CORRECTIONS):
        raise InputError(
            f"corrected of series {name}", received="+".join(corrected), expected="any of " + ", ".join(CORRECTIONS)
        )
    if role is not None and role not in ROLES:
        raise InputError(f"role of series {name}", received=repr(role), expected="one of " + ", ".join(ROLES))


def _layout(
    name: str, first: NDArray[Any] | None, *, shape: tuple[int, int] | None, dtype: Any
) -> tuple[tuple[int, int], Any]:
    """Shape (row, column) and type of a series' frames: those stated, else those of the first frames."""
    if shape is None:
        if first is None:
            raise InputError(f"series {name}", received="no frames", expected="frames, or their shape to append later")
        shape = (int(first.shape[-2]), int(first.shape[-1])) if first.ndim >= 2 else (0, 0)
    if min(shape) < 1:
        raise InputError(
            f"frames of series {name}", received=f"{text_from_shape(shape)} pixels", expected="(row, column)"
        )
    if dtype is None:
        dtype = np.uint16 if first is None or first.dtype.kind in "iub" else np.float32
    if np.dtype(dtype) not in (np.uint16, np.float32):
        raise InputError(f"dtype of series {name}", received=str(np.dtype(dtype)), expected="uint16 or float32")
    return shape, dtype


def _attributes_of(setting: Setting) -> dict[str, Any]:
    attributes = {
        field.name: getattr(setting, field.name)
        for field in fields(Setting)
        if field.name not in ("filters", "averaged", "binning")
    }
    attributes["filter"] = text_from_filters(setting.filters)
    if setting.averaged != 1:
        attributes["averaged"] = int(setting.averaged)
    if setting.binning != 1:
        attributes["binning"] = int(setting.binning)
    return attributes


def _chunk_frames(shape: Sequence[int], dtype: np.dtype[Any], frames: object) -> int:
    fitting = max(1, _CHUNK_BYTES // max(1, math.prod(shape) * dtype.itemsize))
    return min(fitting, len(frames)) if isinstance(frames, np.ndarray) and frames.ndim == 3 else fitting


def _pieces(frames: NDArray[Any] | Iterable[NDArray[Any]] | None) -> Iterator[NDArray[Any]]:
    if frames is None:
        return
    if isinstance(frames, np.ndarray):
        yield frames
        return
    for piece in frames:
        yield np.asarray(piece)


def _storable(block: NDArray[Any], dtype: np.dtype[Any], *, name: str) -> NDArray[Any]:
    if block.dtype.kind not in "iufb":
        raise InputError(
            f"frames of series {name}", received=f"values of type {block.dtype}", expected="detector numbers"
        )
    if block.dtype.kind == "f" and not bool(np.isfinite(block).all()):
        raise InputError(
            f"frames of series {name}", received="a value that is not finite", expected="finite detector numbers"
        )
    if dtype == np.uint16 and block.dtype not in (np.uint16, np.uint8) and block.size:
        lowest, highest = block.min(), block.max()
        whole = block.dtype.kind != "f" or bool(np.all(block == np.rint(block)))
        if lowest < 0 or highest > 65535 or not whole:
            raise InputError(
                f"frames of series {name}",
                received=f"values from {lowest:g} to {highest:g}" if whole else "values that are not whole",
                expected="whole detector numbers from 0 to 65535 in a uint16 series",
                remedy="write the series as float32",
            )
    return block.astype(dtype, copy=False)


def _check_name(argument: str, name: str, *, taken: Any) -> None:
    if not name or "/" in name or name in (".", ".."):
        raise InputError(argument, received=repr(name), expected="a name without '/'")
    if name in taken:
        raise InputError(argument, received=f"{name!r} twice", expected="a name of its own for each")

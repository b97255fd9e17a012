"""Reading HDF5 files that others wrote: every fault is one FileFormatError that names the place."""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from .._guard import bounded
from ..errors import LARGEST, FileFormatError, InputError
from ..files import given_path

# What h5py and HDF5 raise at bytes that are not what they should be: whatever they like. `MemoryError` is an extent that
# no memory holds, `AttributeError` and `IndexError` come from h5py's own code after a call that failed.
HDF5_ERRORS = (
    OSError,
    RuntimeError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    MemoryError,
    SystemError,
)

# what viewers (h5web, silx) look at to show a file's arrays as pictures: words of NeXus, no measurements
NEXUS_WORDS = frozenset({"NX_class", "default", "signal", "axes", "auxiliary_signals", "interpretation"})

# raytwin's own files by their format: what each is, and the commands that make one
_KINDS_OF_FILES = {
    "raytwin-acquisition": ("an acquisition, frames of a session", "`raytwin import` and `raytwin lab`"),
    "raytwin-dataset": ("a dataset of image pairs", "`raytwin import reference` and `raytwin generate`"),
    "raytwin-twin": ("a twin", "`raytwin calibrate` and `raytwin diagnose`"),
}

# a dataset; HDF5 2 would keep 8 MiB of each, and frames are read once and in whole chunks
_CHUNK_CACHE_BYTES = 2**20
# of processor time, for what takes microseconds: a heap of texts whose sizes are 0 is read for ever
_ATTRIBUTE_S = 10.0

# of `create_dataset`: the same bytes each time, where LZF starts from memory that it does not clear
QUICK_GZIP: Mapping[str, Any] = MappingProxyType({"compression": "gzip", "compression_opts": 1})


def open_hdf5(path: str | os.PathLike[str], *, what: str) -> Any:
    """Open an HDF5 file for reading; `what` says in the message which kind of file was expected."""
    location = given_path(path, expected=what)
    if location.is_dir():
        raise FileFormatError(
            str(path), received="a folder", expected=what, remedy="folders of frames are read by `raytwin import`"
        )
    if not location.is_file():
        raise FileFormatError(str(path), received="no such file", expected=what, remedy="check the path")
    try:
        return h5py.File(location, "r", rdcc_nbytes=_CHUNK_CACHE_BYTES)
    except HDF5_ERRORS as error:
        if h5py.is_hdf5(location):
            raise FileFormatError(
                str(path),
                received=f"an HDF5 file that cannot be opened ({_reason(error)})",
                expected=f"{what}, complete",
                remedy="the file looks truncated or is still being written: copy or make it again",
            ) from None
        raise FileFormatError(
            str(path),
            received=f"a file of {location.stat().st_size} bytes that is not HDF5",
            expected=what,
            remedy="other layouts are read by `raytwin import`",
        ) from None


def check_open(handle: Any, *, where: str) -> None:
    """Refuse what belongs to a file that was closed.

    Raises:
        InputError: the file is closed.
    """
    if isinstance(handle, h5py.HLObject) and not handle:
        raise InputError(
            where, received="a closed file", expected="an open file", remedy="open it again, or give its path"
        )


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split())
    start, end = text.find("("), text.rfind(")")
    return text[start + 1 : end] if 0 <= start < end else text


def check_format(
    file: Any, *, path: str, format_name: str, version: int, remedy: str = "use a raytwin that knows this version"
) -> None:
    """Check the root attributes `format` and `version`; remedy: what to do about another version."""
    found = text_attribute(file, "format", where=path)
    if found != format_name:
        kind, maker = _KINDS_OF_FILES[format_name]
        received = "an HDF5 file without a `format` attribute" if found is None else f"format {found!r}"
        if found in _KINDS_OF_FILES:
            received = f"{_KINDS_OF_FILES[found][0]} ({received})"
        raise FileFormatError(
            path, received=received, expected=f"{kind} (format {format_name!r})", remedy=f"{maker} make one"
        )
    found_version = whole_attribute(file, "version", where=path)
    if found_version != version:
        raise FileFormatError(
            path, received=f"{format_name} version {found_version}", expected=f"version {version}", remedy=remedy
        )


def text_attribute(node: Any, name: str, *, where: str) -> str | None:
    """A text attribute, or None where it is absent."""
    value = _attribute(node, name, where=where)
    if value is None:
        return None
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str):
        raise FileFormatError(f"{where}, attribute {name}", received=repr(value), expected="text")
    return value


def number_attribute(
    node: Any, name: str, *, where: str, lowest: float | None = None, above: float | None = None, unit: str = ""
) -> float | None:
    """A finite number, or None where it is absent; `lowest` may be reached, `above` may not."""
    value = _attribute(node, name, where=where)
    if value is None:
        return None
    return checked_number(value, where=f"{where}, attribute {name}", lowest=lowest, above=above, unit=unit)


def checked_number(
    value: Any, *, where: str, lowest: float | None = None, above: float | None = None, unit: str = ""
) -> float:
    """A finite number; `lowest` may be reached, `above` may not.

    Raises:
        FileFormatError: another value, which stands at `where`.
    """
    expected = "a finite number"
    if above is not None:
        expected += f" above {above:g}"
    if lowest is not None:
        expected += f" of {lowest:g} or more"
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise FileFormatError(where, received=repr(value), expected=f"{expected} {unit}".rstrip()) from None
    too_low = (lowest is not None and number < lowest) or (above is not None and number <= above)
    too_high = abs(number) > LARGEST
    if too_high and math.isfinite(number):
        expected += f", at most {LARGEST:g}"
    if not math.isfinite(number) or too_low or too_high:
        raise FileFormatError(where, received=f"{number:g} {unit}".rstrip(), expected=f"{expected} {unit}".rstrip())
    return number


def whole_attribute(node: Any, name: str, *, where: str, lowest: int | None = None) -> int | None:
    """A whole number, or None where it is absent."""
    number = number_attribute(node, name, where=where, lowest=lowest)
    if number is None:
        return None
    if number != int(number):
        raise FileFormatError(f"{where}, attribute {name}", received=f"{number:g}", expected="a whole number")
    return int(number)


def _attribute(node: Any, name: str, *, where: str) -> Any:
    try:
        with bounded(_ATTRIBUTE_S):
            value = node.attrs.get(name)
    except HDF5_ERRORS as error:
        raise FileFormatError(
            f"{where}, attribute {name}", received=_reason(error), expected="a readable attribute"
        ) from None
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, h5py.Empty):
        return None
    return value.item() if isinstance(value, np.generic) else value


def plain_attributes(node: Any, *, where: str) -> Mapping[str, Any]:
    """All attributes as Python values, in a new dictionary; words for viewers are left out."""
    with reading(where):
        return {name: _plain(_attribute(node, name, where=where)) for name in node.attrs if name not in NEXUS_WORDS}


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value.tolist() if isinstance(value, np.ndarray) else value


def child(node: Any, name: str) -> Any:
    """The object called `name` below `node`, or None where it is absent or its link leads nowhere."""
    try:
        return node.get(name)
    except HDF5_ERRORS:
        return None


@contextmanager
def reading(where: str) -> Iterator[None]:
    """Turn whatever HDF5 raises within the block into one FileFormatError that names `where`."""
    try:
        yield
    except InputError:
        raise
    except HDF5_ERRORS as error:
        raise FileFormatError(
            where,
            received=f"data that cannot be read ({_reason(error)})",
            expected="a complete dataset",
            remedy="the file looks truncated or damaged: copy or make it again",
        ) from None


@contextmanager
def named(where: str, kind: type[InputError] = FileFormatError) -> Iterator[None]:
    """Errors of a setting or a label are told with the file and series they stand in; kind: as which they are raised."""
    try:
        yield
    except FileFormatError:
        raise
    except InputError as error:
        argument = error.argument if error.argument.startswith(where) else f"{where}, {error.argument}"
        raise kind(argument, received=error.received, expected=error.expected, remedy=error.remedy) from None


def real_numbers(values: Any, dtype: Any, *, where: str) -> NDArray[Any]:
    """An array of real numbers in a type of the caller's; what that type cannot hold becomes infinite, without a warning.

    Raises:
        FileFormatError: complex numbers, texts, tables.
    """
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise FileFormatError(where, received=f"values of type {array.dtype}", expected="real numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        return array.astype(dtype, copy=False)


def check_stored(dataset: Any, *, where: str) -> None:
    """Refuse a dataset that was never written to its end: HDF5 would hand out zeros in the gaps without a word."""
    if dataset.is_virtual or dataset.external:
        return
    with reading(where):
        if dataset.chunks is None:
            there, whole = dataset.id.get_storage_size(), dataset.size * dataset.dtype.itemsize
            unit = "bytes"
        else:
            there, unit = dataset.id.get_num_chunks(), "chunks"
            whole = math.prod(-(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    if there < whole:
        raise FileFormatError(
            where,
            received=f"{there} of {whole} {unit}",
            expected="data that were written to the end",
            remedy="the recording was cut off: measure or export again",
        )


def frames_per_piece(*, chunk_frames: int | None, frame_bytes: int, maximum_bytes: int) -> int:
    """How many frames to read at once: whole chunks of the file, within the memory allowed where possible."""
    fitting = max(1, maximum_bytes // max(1, frame_bytes))
    if not chunk_frames or chunk_frames == 1:
        return fitting
    # A chunk is the smallest thing the file can give: reading less decompresses it again for every piece.
    if chunk_frames * frame_bytes > 4 * maximum_bytes:
        return fitting
    return max(chunk_frames, fitting // chunk_frames * chunk_frames)


def format_of_file(path: str | os.PathLike[str]) -> str | None:
    """The root attribute `format` of an HDF5 file; None where it is no such file or has none."""
    try:
        with h5py.File(path, "r") as file:
            return text_attribute(file, "format", where=str(path))
    except (*HDF5_ERRORS, InputError):
        return None


def mark_as_pictures(group: Any, signal: str, *, others: Sequence[str] = (), axes: Sequence[str] = ()) -> None:
    """Say to viewers that an array of a group is what to show, as a picture or a stack of them.

    Args:
        group: that holds the arrays.
        signal: name of the array (..., row, column).
        others: arrays of the same shape that are shown beside it.
        axes: names of the arrays along its axes, `.` where there is none; empty: none.

    Source: NeXus, base class NXdata.
    """
    group.attrs["NX_class"] = "NXdata"
    group.attrs["signal"] = signal
    if others:
        group.attrs["auxiliary_signals"] = list(others)
    if axes:
        group.attrs["axes"] = list(axes)
    for name in (signal, *others):
        group[name].attrs["interpretation"] = "image"


def mark_as_entry(group: Any, default: str) -> None:
    """Say to viewers which member of a group to open first.

    Source: NeXus, base class NXentry.
    """
    group.attrs["NX_class"] = "NXentry"
    group.attrs["default"] = default

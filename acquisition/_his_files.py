"""HIS images of Varex and PerkinElmer panels: a header of 68 bytes, an image header, frames one after the other.

Little endian: file type 0x7000, header bytes, version (uint16 each); file bytes (uint32); image header bytes; left, top, right,
bottom (inclusive); frames; correction (1 offset, 2 gain, 4 bad pixels) (uint16 each); frame time in us (float64); number type
(uint16); 34 bytes. Source: header description of the X-ray Imaging Software Library, as the readers of RTK and GLADOS have it.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError
from ._image_header import ImageHeader

_LAYOUT = struct.Struct("<HHHIHHHHHHHdH34x")
_FILE_TYPE = 0x7000
_NUMBER_TYPES = {2: "<u1", 4: "<u2", 32: "<u4", 64: "<f8", 128: "<f4"}
_CORRECTIONS = {1: "offset", 2: "gain", 4: "defects"}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    rows: int
    columns: int
    frames: int
    dtype: np.dtype[Any]
    start: int
    correction: int
    frame_time_us: float


def iter_his(path: Path) -> Iterator[NDArray[Any]]:
    """Yield the frames (row, column).

    Raises:
        FileFormatError: another file type, number type or length than the header says.
    """
    layout = _layout(path)
    with path.open("rb") as stream:
        stream.seek(layout.start)
        for _ in range(layout.frames):
            block = stream.read(layout.rows * layout.columns * layout.dtype.itemsize)
            values = np.frombuffer(block, dtype=layout.dtype).reshape(layout.rows, layout.columns)
            yield values.astype(layout.dtype.newbyteorder("="))


def his_header(path: Path) -> ImageHeader:
    """Frame time and corrections; a HIS file says nothing of the tube.

    Raises:
        FileFormatError: as `iter_his`.
    """
    layout = _layout(path)
    done = frozenset(word for bit, word in _CORRECTIONS.items() if layout.correction & bit)
    time_us = layout.frame_time_us
    return ImageHeader(
        exposure_ms=time_us / 1000.0 if np.isfinite(time_us) and time_us > 0 else None, corrected=done or None
    )


def _layout(path: Path) -> _Layout:
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_LAYOUT.size)
    if len(head) < _LAYOUT.size:
        raise FileFormatError(str(path), received=f"{size} bytes", expected=f"a HIS header of {_LAYOUT.size} bytes")
    kind, header_bytes, _, _, image_bytes, left, top, right, bottom, frames, correction, time_us, number_type = (
        _LAYOUT.unpack(head)
    )
    if kind != _FILE_TYPE:
        raise FileFormatError(str(path), received=f"file type 0x{kind:04x}", expected=f"0x{_FILE_TYPE:04x} (HIS)")
    if number_type not in _NUMBER_TYPES:
        raise FileFormatError(
            str(path),
            received=f"numbers of type {number_type}",
            expected="one of " + ", ".join(map(str, _NUMBER_TYPES)),
            remedy="describe the file as raw: rename it to .raw and give [raw] in the sidecar",
        )
    rows, columns = bottom - top + 1, right - left + 1
    dtype = np.dtype(_NUMBER_TYPES[number_type])
    start = header_bytes + image_bytes
    expected = start + frames * rows * columns * dtype.itemsize
    if rows < 1 or columns < 1 or frames < 1 or size < expected:
        raise FileFormatError(
            str(path),
            received=f"{size} bytes",
            expected=f"at least {expected} for {frames} frames of {rows} x {columns} {dtype.name} as the header says",
            remedy="the file looks truncated: copy or export it again",
        )
    return _Layout(
        rows=rows,
        columns=columns,
        frames=frames,
        dtype=dtype,
        start=start,
        correction=correction,
        frame_time_us=time_us,
    )

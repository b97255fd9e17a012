"""TIFF files that state their pixel pitch and how they were taken: OME-TIFF with the words of a setting as its description."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def write_tiff(
    path: str | os.PathLike[str],
    frames: NDArray[Any] | Iterator[NDArray[Any]],
    *,
    shape: tuple[int, ...] | None = None,
    dtype: Any = None,
    pixel_mm: float | None = None,
    words: Mapping[str, str] | None = None,
) -> None:
    """Write one image or a stack as OME-TIFF; pitch in PhysicalSize and in the resolution tags, words in the description.

    Args:
        path: the file.
        frames: (row, column), or (frame, row, column), or frames one after the other with the `shape` and `dtype` of all.
        pixel_mm: pitch; None: no scale.
        words: what else is known, as `word: text` lines.

    Source: the OME data model, 2016-06 schema; TIFF 6.0 tags 282, 283, 296 (pixels a centimetre).
    """
    import tifffile

    from .. import __version__

    if isinstance(frames, np.ndarray):
        shape, dtype = frames.shape, frames.dtype
    metadata: dict[str, Any] = {
        "axes": "YX" if shape is not None and len(shape) == 2 else "TYX",
        "Name": Path(path).name.split(".")[0],
    }
    told = {name: text for name, text in (words or {}).items() if text}
    if told:
        metadata["Description"] = "\n".join(f"{name}: {text}" for name, text in told.items())
    options: dict[str, Any] = {}
    if pixel_mm is not None:
        for axis in "XY":
            metadata |= {f"PhysicalSize{axis}": pixel_mm, f"PhysicalSize{axis}Unit": "mm"}
        options = {"resolution": (10.0 / pixel_mm, 10.0 / pixel_mm), "resolutionunit": "CENTIMETER"}
    tifffile.imwrite(
        path,
        frames,
        shape=shape,
        dtype=dtype,
        ome=True,
        photometric="minisblack",
        metadata=metadata,
        software=f"raytwin {__version__}",
        **options,
    )

"""Acquisitions and datasets as Zarr groups, an image a chunk: for stores that many readers share (extra `zarr`).

The tree is that of the HDF5 file, with its attributes. Arrays bear the names of their axes, so that xarray opens them;
columns of texts are attributes of their group.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..errors import MissingDependencyError
from ..files import whole_folder
from ._hdf5 import open_hdf5, reading

_PIXELS = ("row", "column")
_SHARD_BYTES = 64 * 2**20  # of a file in the store: one image a file would be a folder of many thousands
_VIEWERS = frozenset({"NX_class", "signal", "axes", "default", "auxiliary_signals", "interpretation"})


def export_zarr(
    source: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Write the arrays and attributes of an acquisition or dataset file as Zarr (format 3); the folder appears whole or not at all.

    Args:
        source: the HDF5 file.
        folder: new or empty; holds `data.zarr`.
        progress: called with (images done, images in all).

    Returns:
        File name -> what it holds, and warnings.

    Raises:
        InputError: a folder with something in it.
        FileFormatError: a file that cannot be read to its end.
        MissingDependencyError: zarr is not installed.
    """
    try:
        import zarr
    except ImportError:
        raise MissingDependencyError(
            "zarr stores need the library zarr, which is not installed: pip install 'raytwin[zarr]'"
        ) from None
    with open_hdf5(source, what="an acquisition or dataset file") as file, whole_folder(folder) as place:
        stacks = [item for item in _datasets(file) if item.ndim > 2]
        total, done = sum(item.shape[0] for item in stacks), 0

        def count(images: int) -> None:
            nonlocal done
            done += images
            if progress is not None:
                progress(done, total)

        root = zarr.create_group(store=place / "data.zarr", zarr_format=3)
        _copy(file, root, Path(str(source)), count)
    return {"data.zarr": "groups, arrays and attributes as in the HDF5 file, an image a chunk"}, ()


def _datasets(group: Any) -> list[Any]:
    found: list[Any] = []
    group.visititems(lambda _, item: found.append(item) if isinstance(item, h5py.Dataset) else None)
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _attributes(item: Any) -> dict[str, Any]:
    return {name: _plain(value) for name, value in item.attrs.items() if name not in _VIEWERS}


def _copy(group: Any, target: Any, source: Path, count: Callable[[int], None]) -> None:
    target.attrs.update(_attributes(group))
    for name, item in group.items():
        if isinstance(item, h5py.Group):
            _copy(item, target.create_group(name), source, count)
        elif isinstance(item, h5py.Dataset):
            with reading(f"{source}, {item.name}"):
                _copy_array(name, item, target, count)


def _copy_array(name: str, item: Any, target: Any, count: Callable[[int], None]) -> None:
    if h5py.check_string_dtype(item.dtype) is not None:
        # the format has no arrays of texts yet that every reader knows: columns of texts are attributes of their group
        target.attrs[name] = _plain(np.asarray(item.asstr()[()], dtype=object))
        return
    if item.ndim < 2:
        values = np.asarray(item[()])
        plain = target.create_array(name, shape=values.shape, dtype=values.dtype)
        plain[...] = values
        plain.attrs.update(_attributes(item))
        return
    leading = ("image", "beam") if item.ndim == 4 else ("image",) if item.ndim == 3 else ()
    chunk = (*(1 for _ in item.shape[:-2]), *item.shape[-2:])
    image_bytes = math.prod(item.shape[1:]) * item.dtype.itemsize if item.ndim > 2 else 0
    together = min(item.shape[0], max(1, _SHARD_BYTES // max(image_bytes, 1))) if item.ndim > 2 else 1
    shard = (together, *item.shape[1:]) if item.ndim > 2 and together > 1 else None
    array = target.create_array(
        name,
        shape=item.shape,
        dtype=item.dtype,
        chunks=chunk,
        shards=shard,
        dimension_names=(*leading, *_PIXELS),
    )
    array.attrs.update(_attributes(item))
    if item.ndim == 2:
        array[...] = item[()]
        return
    for start in range(0, item.shape[0], together):
        piece = item[start : start + together]
        array[start : start + len(piece)] = piece
        count(len(piece))

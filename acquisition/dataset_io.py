"""The dataset file: dual-energy image pairs with masks and rows, read image by image, written whole or not at all."""

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from types import MappingProxyType, TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError
from ..files import whole_file
from ..results import Table, counted
from ._hdf5 import (
    QUICK_GZIP,
    check_format,
    check_open,
    check_stored,
    child,
    mark_as_pictures,
    open_hdf5,
    plain_attributes,
    reading,
    real_numbers,
)
from .instrument import Instrument

FORMAT = "raytwin-dataset"
VERSION = 1
SPLITS = ("train", "val", "test")

Selection = int | slice | Sequence[int] | NDArray[Any]

_MOST_LOG = 24 * math.log(2.0)  # of detector numbers of at most 24 bits


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetRow:
    """What is known about one image pair.

    Fields: image (identifier); product; foreign_object (empty = none); size_mm and contrast of the foreign object
    (NaN = unknown or none); split (`train`, `val`, `test`); setting (`LOW;HIGH`, each a SETTING of the command line).
    """

    image: str
    product: str = ""
    foreign_object: str = ""
    size_mm: float = math.nan
    contrast: float = math.nan
    split: str = "test"
    setting: str = ""

    def __post_init__(self) -> None:
        if not self.image:
            raise InputError("image of a dataset row", received="an empty text", expected="an identifier")
        if self.split not in SPLITS:
            raise InputError(
                f"split of image {self.image}", received=repr(self.split), expected="one of " + ", ".join(SPLITS)
            )
        if not (math.isnan(self.size_mm) or 0 <= self.size_mm < math.inf):
            raise InputError(
                f"size_mm of image {self.image}", received=self.size_mm, expected="0 mm or more, or NaN for unknown"
            )
        if math.isinf(self.contrast):
            raise InputError(
                f"contrast of image {self.image}",
                received=self.contrast,
                expected="a finite number, or NaN for unknown",
            )


_COLUMNS = tuple(field.name for field in fields(DatasetRow))
_NUMBERS = ("size_mm", "contrast")


@dataclass(slots=True, kw_only=True, repr=False)
class Dataset:
    """An open dataset file; use it in a `with` block. `len()` is the number of image pairs.

    Fields: path; rows (one a pair); shape (row, column); attributes (provenance and settings of the file).
    Every reading method takes a number, a slice, or numbers in any order, and reads only those images.
    """

    path: str
    rows: tuple[DatasetRow, ...]
    shape: tuple[int, int]
    attributes: Mapping[str, Any]
    _file: Any

    def refuse_other_pitch(self, pixel_mm: float | None) -> None:
        """Refuse images whose file states another pitch of the detector than `pixel_mm`.

        Raises:
            InputError: it does.
        """
        stated = self.attributes.get("pixel_mm")
        if not (pixel_mm and isinstance(stated, float | int)) or not stated > 0:
            return
        other = Instrument(pixel_mm=pixel_mm).unlike(Instrument(pixel_mm=float(stated)))
        if other is not None:
            raise InputError(
                self.path,
                received=f"images with {other[0]}",
                expected=f"the twin's: {other[1]}",
                remedy="take the twin of the detector that took them",
            )

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

    def _table(self) -> Table:
        groups: dict[tuple[str, str], list[DatasetRow]] = {}
        for row in self.rows:
            groups.setdefault((row.split, row.setting), []).append(row)
        rows = tuple(
            (split, setting, str(len(found)), str(sum(bool(row.foreign_object) for row in found)))
            for (split, setting), found in groups.items()
        )
        closed = "" if self._file else ", closed"
        return Table(
            title=f"Dataset {self.path}: {counted(len(self), 'image pair')} of {self.shape[0]} x {self.shape[1]} pixels{closed}",
            header=("split", "setting", "pairs", "with a foreign object"),
            rows=rows,
        )

    def close(self) -> None:
        """Close the file; nothing can be read afterwards."""
        self._file.close()

    def __len__(self) -> int:
        return len(self.rows)

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        # A worker process opens the file for itself: an HDF5 handle does not survive the way there.
        return read_dataset, (self.path,)

    @property
    def has_counts(self) -> bool:
        """Whether the file holds the images in DN too."""
        check_open(self._file, where=self.path)
        return "counts" in self._file

    def images(self, selection: Selection) -> NDArray[np.float32]:
        """-log(I/I0), low kV first: (2, row, column) for a number, else (m, 2, row, column).

        Raises:
            FileFormatError: an image that cannot be read or holds a value that is not finite; the image is named.
        """
        return self._finite("images", selection)

    def counts(self, selection: Selection) -> NDArray[np.float32] | None:
        """The same images in DN, or None where the file holds none."""
        return self._finite("counts", selection) if self.has_counts else None

    def foreign_object_masks(self, selection: Selection) -> NDArray[np.bool_]:
        """Where the foreign object is: (row, column) for a number, else (m, row, column)."""
        return self._mask("foreign_object_masks", selection)

    def product_masks(self, selection: Selection) -> NDArray[np.bool_]:
        """Where the product is, the foreign object included: (row, column) for a number, else (m, row, column)."""
        return self._mask("product_masks", selection)

    def column(self, name: str) -> NDArray[Any]:
        """One column of the rows, (n,): float64 for `size_mm` and `contrast`, texts for the others."""
        values = [getattr(row, name) for row in self.rows]
        return np.asarray(values, dtype=np.float64 if name in _NUMBERS else np.str_)

    def indices(self, *, split: str | None = None, setting: str | None = None) -> NDArray[np.intp]:
        """Numbers of the pairs of a split, of a setting, or of both, in the order of the file."""
        if split is not None and split not in SPLITS:
            raise InputError("split", received=repr(split), expected="one of " + ", ".join(SPLITS))
        chosen = [
            number
            for number, row in enumerate(self.rows)
            if split in (None, row.split) and setting in (None, row.setting)
        ]
        return np.asarray(chosen, dtype=np.intp)

    def _mask(self, name: str, selection: Selection) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = np.not_equal(self._take(name, selection), 0)
        return inside

    def _finite(self, name: str, selection: Selection) -> NDArray[np.float32]:
        values: NDArray[np.float32] = real_numbers(
            self._take(name, selection), np.float32, where=f"{self.path}, {name}"
        )
        if not bool(np.isfinite(values).all()):
            numbers = self._numbers(selection)
            stack = values.reshape(-1, *values.shape[-3:])
            first = int(np.flatnonzero(~np.isfinite(stack).all(axis=(1, 2, 3)))[0])
            raise FileFormatError(
                f"{self.path}, {name}, image {self.rows[numbers[first]].image}",
                received="a value that is not finite",
                expected="finite values",
                remedy="remove the image from the dataset or make it again",
            )
        if name == "images" and values.size and float(values.min()) < -_MOST_LOG:
            raise FileFormatError(
                f"{self.path}, images",
                received=f"-log(I/I0) of {float(values.min()):g}",
                expected=f"values above {-_MOST_LOG:.3g}: no pixel is brighter than the open beam by a whole range of 24 bits",
                remedy="the file looks damaged: make it again",
            )
        return values

    def _numbers(self, selection: Selection) -> NDArray[np.intp]:
        if isinstance(selection, slice):
            return np.arange(len(self))[selection]
        numbers = np.atleast_1d(np.asarray(selection))
        if numbers.dtype == np.bool_:
            if numbers.shape != (len(self),):
                raise InputError("selection", received=f"{numbers.size} flags", expected=f"{len(self)}, one an image")
            return np.flatnonzero(numbers)
        if numbers.size and (numbers.min() < -len(self) or numbers.max() >= len(self)):
            raise InputError(
                "image number", received=f"{numbers.min()} to {numbers.max()}", expected=f"0 to {len(self) - 1}"
            )
        return np.asarray(numbers % max(1, len(self)), dtype=np.intp)

    def _take(self, name: str, selection: Selection) -> NDArray[Any]:
        check_open(self._file, where=self.path)
        dataset = self._file[name]
        with reading(f"{self.path}, {name}"):
            if isinstance(selection, slice) and (selection.step or 1) > 0:
                piece: NDArray[Any] = dataset[selection]
                return piece
            numbers = self._numbers(selection)
            if not isinstance(selection, slice) and np.ndim(selection) == 0:
                single: NDArray[Any] = dataset[int(numbers[0])]
                return single
            # The file gives images in its own order, each once; the caller's order is restored afterwards.
            unique, places = np.unique(numbers, return_inverse=True)
            stack: NDArray[Any] = dataset[unique] if unique.size else dataset[0:0]
            return stack[places]


def read_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Open a dataset file and check its layout and rows; images are checked as they are read.

    Args:
        path: HDF5 file with root attributes `format = "raytwin-dataset"`, `version = 1`.

    Returns:
        The open dataset, a context manager.

    Raises:
        FileFormatError: not there, truncated, not HDF5, another format or version, no images, masks or rows that
            do not fit the images, a split that is unknown.
    """
    file = open_hdf5(path, what="a dataset file")
    try:
        with reading(str(path)):
            return _dataset(file, path=str(path))
    except BaseException:
        file.close()
        raise


def _shape_of(dataset: Any) -> str:
    """For messages."""
    shape = getattr(dataset, "shape", None)
    return "no such array" if shape is None else f"shape {shape}"


def _dataset(file: Any, *, path: str) -> Dataset:
    check_format(file, path=path, format_name=FORMAT, version=VERSION)
    images = child(file, "images")
    if not isinstance(images, h5py.Dataset) or images.ndim != 4 or images.shape[1] != 2 or 0 in images.shape:
        raise FileFormatError(
            f"{path}, images",
            received=_shape_of(images),
            expected="at least one image pair, (n, 2, row, column)",
        )
    n, _, row, column = (int(length) for length in images.shape)
    for name, shape in (
        ("counts", (n, 2, row, column)),
        ("foreign_object_masks", (n, row, column)),
        ("product_masks", (n, row, column)),
    ):
        dataset = child(file, name)
        if dataset is None and name == "counts":
            continue
        if not isinstance(dataset, h5py.Dataset) or dataset.shape != shape:
            raise FileFormatError(f"{path}, {name}", received=_shape_of(dataset), expected=f"shape {shape}")
    for name in ("images", "counts", "foreign_object_masks", "product_masks"):
        if name in file:
            check_stored(file[name], where=f"{path}, {name}")
    return Dataset(
        path=path,
        rows=_rows(child(file, "rows"), n=n, path=path),
        shape=(row, column),
        attributes=MappingProxyType(dict(plain_attributes(file, where=path))),
        _file=file,
    )


def _rows(group: Any, *, n: int, path: str) -> tuple[DatasetRow, ...]:
    if not isinstance(group, h5py.Group):
        raise FileFormatError(f"{path}, rows", received="nothing", expected="a group with one dataset a column")
    columns: dict[str, list[Any]] = {}
    for name in _COLUMNS:
        dataset = child(group, name)
        where = f"{path}, rows/{name}"
        if dataset is None:
            if name in ("image", "split"):
                raise FileFormatError(where, received="nothing", expected=f"{n} values, one an image")
            continue
        if not isinstance(dataset, h5py.Dataset) or dataset.shape != (n,):
            raise FileFormatError(where, received=_shape_of(dataset), expected=f"{n} values, one an image")
        with reading(where):
            if name in _NUMBERS:
                if dataset.dtype.kind not in "iuf":
                    raise FileFormatError(where, received=f"values of type {dataset.dtype}", expected="numbers")
                columns[name] = np.asarray(dataset[()], dtype=np.float64).tolist()
            else:
                if h5py.check_string_dtype(dataset.dtype) is None:
                    raise FileFormatError(where, received=f"values of type {dataset.dtype}", expected="texts")
                columns[name] = [str(text) for text in dataset.asstr(errors="replace")[()]]
    try:
        return tuple(DatasetRow(**{name: values[row] for name, values in columns.items()}) for row in range(n))
    except InputError as error:
        raise FileFormatError(
            f"{path}, {error.argument}", received=error.received, expected=error.expected, remedy=error.remedy
        ) from None


class DatasetWriter:
    """A dataset file being written; made by `write_dataset`."""

    def __init__(self, file: Any, *, shape: tuple[int, int]) -> None:
        self.attributes: Any = file.attrs
        self._file = file
        self._shape = shape
        self._rows: list[DatasetRow] = []
        self._images = _growing(file, "images", (2, *shape), np.float32)
        self._counts: Any = None
        self._foreign = _growing(file, "foreign_object_masks", shape, np.uint8)
        self._product = _growing(file, "product_masks", shape, np.uint8)

    def __len__(self) -> int:
        return len(self._rows)

    def append(
        self,
        *,
        image: NDArray[Any],
        foreign_object_mask: NDArray[Any] | None,
        product_mask: NDArray[Any],
        row: DatasetRow,
        counts: NDArray[Any] | None = None,
    ) -> None:
        """Append one image pair.

        Args:
            image: (2, row, column) -log(I/I0), low kV first.
            foreign_object_mask: (row, column), anything but 0 is inside; None = no foreign object.
            product_mask: (row, column), the foreign object included.
            row: what is known about the pair.
            counts: (2, row, column) the same in DN; for all pairs of a file or for none.

        Raises:
            InputError: another shape, a value that is not finite, counts for some pairs only.
        """
        name = row.image
        pair = _plane(image, (2, *self._shape), argument=f"image {name}")
        product = _plane(product_mask, self._shape, argument=f"product mask of image {name}") != 0
        foreign = np.zeros(self._shape, dtype=np.uint8)
        if foreign_object_mask is not None:
            mask = _plane(foreign_object_mask, self._shape, argument=f"foreign-object mask of image {name}")
            foreign = np.asarray(mask != 0, dtype=np.uint8)
        if self._rows and (counts is None) != (self._counts is None):
            raise InputError(
                f"counts of image {name}",
                received="none" if counts is None else "an image in DN",
                expected="counts for all images of a dataset or for none",
            )
        number = len(self._rows)
        if counts is not None:
            levels = _plane(counts, (2, *self._shape), argument=f"counts of image {name}")
            if self._counts is None:
                self._counts = _growing(self._file, "counts", (2, *self._shape), np.float32)
            _append(self._counts, number, levels)
        _append(self._images, number, pair)
        _append(self._foreign, number, foreign)
        _append(self._product, number, product.astype(np.uint8))
        self._rows.append(row)

    def _finish(self) -> None:
        # the arrays lie at the root, which is an entry of its own for viewers
        mark_as_pictures(self._file, "images")
        for name in ("counts", "foreign_object_masks", "product_masks"):
            if name in self._file:
                self._file[name].attrs["interpretation"] = "image"
        group = self._file.create_group("rows")
        for name in _COLUMNS:
            values = [getattr(row, name) for row in self._rows]
            if name in _NUMBERS:
                group.create_dataset(name, data=np.asarray(values, dtype=np.float64))
            else:
                group.create_dataset(name, data=values, dtype=h5py.string_dtype("utf-8"))


def _growing(file: Any, name: str, shape: tuple[int, ...], dtype: Any) -> Any:
    # an image is a chunk; with its bytes sorted by weight, counts shrink to a third, log images to nine tenths
    return file.create_dataset(
        name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=dtype,
        chunks=(1, *shape),
        **QUICK_GZIP,
        shuffle=np.dtype(dtype).itemsize > 1,
    )


def _append(dataset: Any, number: int, plane: NDArray[Any]) -> None:
    dataset.resize(number + 1, axis=0)
    dataset[number] = plane


def _plane(values: NDArray[Any], shape: tuple[int, ...], *, argument: str) -> NDArray[Any]:
    plane = np.asarray(values)
    if plane.shape != shape:
        raise InputError(argument, received=f"shape {plane.shape}", expected=f"shape {shape}")
    if not bool(np.isfinite(plane).all()):
        raise InputError(argument, received="a value that is not finite", expected="finite values")
    return plane


@contextmanager
def write_dataset(
    path: str | os.PathLike[str], *, shape: tuple[int, int], provenance: Mapping[str, Any] | None = None
) -> Iterator[DatasetWriter]:
    """Write a dataset file in a `with` block; it appears under its name when the block succeeds, or not at all.

    Args:
        path: the file to write; an existing one is replaced.
        shape: (row, column) of every image.
        provenance: root attributes (twin hash, settings, seed ...); mappings and lists are kept as JSON text. The
            version of raytwin is added.

    Raises:
        InputError: no image was appended, or one that does not fit.
    """
    from .. import __version__

    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.attrs["raytwin_version"] = __version__
        for key, value in (provenance or {}).items():
            if value is not None and key not in ("format", "version"):
                file.attrs[key] = json.dumps(value) if isinstance(value, Mapping | list | tuple) else value
        writer = DatasetWriter(file, shape=shape)
        yield writer
        if not len(writer):
            raise InputError(str(path), received="no images", expected="at least one image pair to write")
        writer._finish()


def write_selected(
    dataset: Dataset,
    path: str | os.PathLike[str],
    *,
    selection: Selection,
    split: str | None = None,
) -> None:
    """Write some pairs of a dataset, in the order given, to a dataset file of their own.

    Args:
        selection: numbers, a slice or flags (n,).
        split: give all of them this split; None keeps theirs.
    """
    _write_pairs(path, [(dataset, int(number)) for number in dataset._numbers(selection)], split=split)


def concatenate_datasets(datasets: Iterable[Dataset], path: str | os.PathLike[str]) -> None:
    """Write all pairs of several datasets, one after the other, to one dataset file.

    Images in DN are kept only where every dataset holds them.

    Raises:
        InputError: images of different shapes, or no dataset.
    """
    pairs = [(dataset, number) for dataset in datasets for number in range(len(dataset))]
    _write_pairs(path, pairs, split=None)


def _write_pairs(
    path: str | os.PathLike[str],
    pairs: Sequence[tuple[Dataset, int]],
    *,
    split: str | None,
) -> None:
    if not pairs:
        raise InputError(str(path), received="no images", expected="at least one image pair to write")
    first = pairs[0][0]
    different = next((dataset for dataset, _ in pairs if dataset.shape != first.shape), None)
    if different is not None:
        raise InputError(
            different.path,
            received=f"images of {different.shape[0]} x {different.shape[1]} pixels",
            expected=f"{first.shape[0]} x {first.shape[1]} as in {first.path}",
        )
    kept = dict(first.attributes) if all(dataset is first for dataset, _ in pairs) else {}
    with_counts = all(dataset.has_counts for dataset, _ in pairs)
    with write_dataset(path, shape=first.shape, provenance=kept) as writer:
        for dataset, number in pairs:
            row = dataset.rows[number]
            writer.append(
                image=dataset.images(number),
                counts=dataset.counts(number) if with_counts else None,
                foreign_object_mask=dataset.foreign_object_masks(number),
                product_mask=dataset.product_masks(number),
                row=row if split is None else replace(row, split=split),
            )

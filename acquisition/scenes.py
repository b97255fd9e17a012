"""What stood in the beam, as an acquisition file tells it: identifiers, masks, path lengths of each pixel's ray."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError
from ._acquisition_words import text_from_shape
from ._hdf5 import child, number_attribute, plain_attributes, reading, real_numbers, text_attribute


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What stood in the beam, as far as it is known.

    Fields: name; kind (`wedge`, `slab`, `edge`, `disc`, `product`); shape (row, column) or None where nothing is known
    pixel by pixel; thickness_mm (material -> path length along the ray of each pixel, (row, column), read when asked
    for); product, foreign_object (identifiers, empty = none or unknown); size_mm (of the foreign object, NaN =
    unknown); attributes (everything else that stands there).
    """

    name: str
    kind: str
    shape: tuple[int, int] | None
    thickness_mm: Mapping[str, NDArray[np.float32]]
    product: str
    foreign_object: str
    size_mm: float
    attributes: Mapping[str, Any]
    _foreign_object_mask: Any
    _product_mask: Any
    _where: str

    @property
    def foreign_object_mask(self) -> NDArray[np.bool_] | None:
        """Where a ray meets a foreign object, (row, column), or None where it is unknown."""
        return self._mask(self._foreign_object_mask)

    @property
    def product_mask(self) -> NDArray[np.bool_] | None:
        """Where a ray meets the product, foreign objects included, (row, column), or None where it is unknown."""
        return self._mask(self._product_mask)

    def _mask(self, dataset: Any) -> NDArray[np.bool_] | None:
        if dataset is None:
            return None
        with reading(self._where):
            values: NDArray[Any] = dataset[()]
        inside: NDArray[np.bool_] = np.not_equal(values, 0)
        return inside


def read_scene(group: Any, name: str, *, path: str) -> Scene:
    """A scene of the group of scenes; maps and masks stay in the file until they are asked for.

    Raises:
        FileFormatError: no group, maps or masks of different shapes or that are no pictures of numbers, an attribute at fault.
    """
    where = f"{path}, scene {name}"
    node = child(group, name)
    if not isinstance(node, h5py.Group):
        raise FileFormatError(where, received="no group", expected="a group with masks or thickness maps")
    maps = child(node, "thickness_mm")
    if maps is not None and not isinstance(maps, h5py.Group):
        raise FileFormatError(
            f"{where}/thickness_mm", received="one dataset", expected="a group with one map a material"
        )
    masks = {mask: child(node, mask) for mask in ("foreign_object_mask", "product_mask")}
    planes = {mask: dataset for mask, dataset in masks.items() if dataset is not None}
    planes |= {f"thickness_mm/{material}": child(maps, material) for material in (maps or ())}
    shapes = {}
    for plane, dataset in planes.items():
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 2 or dataset.dtype.kind not in "iufb":
            raise FileFormatError(
                f"{where}/{plane}",
                received=f"shape ({text_from_shape(getattr(dataset, 'shape', None))})",
                expected="an array of numbers (row, column)",
            )
        shapes[plane] = (int(dataset.shape[0]), int(dataset.shape[1]))
    if len(set(shapes.values())) > 1:
        told = ", ".join(f"{plane} {text_from_shape(shape)}" for plane, shape in shapes.items())
        raise FileFormatError(where, received=told, expected="masks and maps of one shape")
    known = {"kind", "product", "foreign_object", "size_mm"}
    size_mm = node.attrs.get("size_mm")
    unknown_size = size_mm is None or (isinstance(size_mm, float | np.floating) and math.isnan(size_mm))
    return Scene(
        name=name,
        kind=text_attribute(node, "kind", where=where) or "",
        shape=next(iter(shapes.values()), None),
        thickness_mm=_ThicknessMaps(maps, f"{where}/thickness_mm"),
        product=text_attribute(node, "product", where=where) or "",
        foreign_object=text_attribute(node, "foreign_object", where=where) or "",
        size_mm=math.nan
        if unknown_size
        else number_attribute(node, "size_mm", where=where, lowest=0, unit="mm") or 0.0,
        attributes=MappingProxyType(
            {key: value for key, value in plain_attributes(node, where=where).items() if key not in known}
        ),
        _foreign_object_mask=masks["foreign_object_mask"],
        _product_mask=masks["product_mask"],
        _where=where,
    )


class _ThicknessMaps(Mapping[str, NDArray[np.float32]]):
    """Material -> path length (mm) for every pixel; each map is read from the file when it is asked for."""

    def __init__(self, group: Any, where: str) -> None:
        self._group = group
        self._where = where

    def __getitem__(self, material: str) -> NDArray[np.float32]:
        dataset = None if self._group is None else child(self._group, material)
        if dataset is None:
            raise KeyError(material)
        with reading(self._where):
            thickness_mm: NDArray[np.float32] = real_numbers(dataset[()], np.float32, where=self._where)
        if not bool(np.all(np.isfinite(thickness_mm) & (thickness_mm >= 0))):
            raise FileFormatError(
                f"{self._where}/{material}",
                received="a negative or non-finite path length",
                expected="finite path lengths of 0 mm or more",
            )
        return thickness_mm

    def __iter__(self) -> Iterator[str]:
        return iter(()) if self._group is None else iter(self._group)

    def __len__(self) -> int:
        return 0 if self._group is None else len(self._group)

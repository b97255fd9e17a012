"""An acquisition with binned pixels: frames and thickness maps are means of squares of pixels.

What is averaged afterwards has the level of one pixel and less noise than one; the whole numbers of the ADC are lost.
"""

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .acquisition_io import AcquisitionFile, Series
from .log_images import logarithm_of_share, transmitted_share
from .scenes import Scene


def binned(acquisition: AcquisitionFile, factor: int) -> AcquisitionFile:
    """The acquisition with means of factor x factor pixels in place of pixels; it reads from the given one, which stays open.

    Rows and columns that fill no square are left out, evenly on both sides. A series is averaged when it is first read and
    then kept in a temporary file without a name.

    Args:
        acquisition: open acquisition file.
        factor: pixels along each side of a square, 1 or more.

    Raises:
        InputError: a factor below 1, or squares larger than the frames.
    """
    shapes = [item.shape for item in acquisition.series]
    if factor < 1 or any(min(shape) < factor for shape in shapes):
        raise InputError(
            "factor of binned pixels",
            received=factor,
            expected=f"from 1 to {min((min(shape) for shape in shapes), default=1)}, the shorter side of the frames",
        )
    if factor == 1:
        return acquisition
    pitch = acquisition.instrument.pixel_mm
    return replace(
        acquisition,
        instrument=replace(acquisition.instrument, pixel_mm=None if pitch is None else pitch * factor),
        series=tuple(
            replace(item, _frames=_MeanFrames(item, factor), shape=_smaller(item.shape, factor))
            for item in acquisition.series
        ),
        scenes={name: _binned_scene(scene, factor) for name, scene in acquisition.scenes.items()},
    )


def means_of_bins(images: NDArray[Any], factor: int) -> NDArray[np.float32]:
    """Means over factor x factor pixels of images (..., row, column)."""
    rows, columns = _smaller((images.shape[-2], images.shape[-1]), factor)
    top, left = (images.shape[-2] - rows * factor) // 2, (images.shape[-1] - columns * factor) // 2
    part = images[..., top : top + rows * factor, left : left + columns * factor]
    total = np.zeros((*images.shape[:-2], rows, columns), dtype=np.float32)
    for down in range(factor):
        for right in range(factor):
            total += part[..., down::factor, right::factor]
    total /= factor**2
    return total


def _smaller(shape: tuple[int, int], factor: int) -> tuple[int, int]:
    return shape[0] // factor, shape[1] // factor


class _MeanFrames:
    """Frames (frame, row, column) of binned pixels, averaged when first asked for; read as a dataset is."""

    def __init__(self, series: Series, factor: int) -> None:
        self.dtype = np.dtype(np.float32)
        self.chunks = None
        self.shape = (series.n_frames, *_smaller(series.shape, factor))
        self._series = series
        self._factor = factor
        self._kept: NDArray[np.float32] | None = None

    def __getitem__(self, part: slice) -> NDArray[np.float32]:
        if self._kept is None:
            # the mapping holds the file, which has no name and ends with it
            with tempfile.TemporaryFile() as file:
                kept = np.memmap(file, dtype=np.float32, mode="w+", shape=self.shape)
            start = 0
            for piece in self._series.iter_frames():
                kept[start : start + len(piece)] = self._means(piece)
                start += len(piece)
            self._kept = kept
        return np.array(self._kept[part])

    def _means(self, frames: NDArray[Any]) -> NDArray[np.float32]:
        if "log" in self._series.corrected:
            # light adds up, not its logarithm
            return logarithm_of_share(means_of_bins(transmitted_share(frames), self._factor))
        return means_of_bins(frames, self._factor)


def _binned_scene(scene: Scene, factor: int) -> Scene:
    return replace(
        scene,
        shape=None if scene.shape is None else _smaller(scene.shape, factor),
        thickness_mm=_MeanMaps(scene.thickness_mm, factor),
        _foreign_object_mask=_mask(scene.foreign_object_mask, factor),
        _product_mask=_mask(scene.product_mask, factor),
    )


def _mask(mask: NDArray[np.bool_] | None, factor: int) -> NDArray[np.bool_] | None:
    """A square belongs to what covers half of it."""
    return None if mask is None else means_of_bins(mask, factor) >= 0.5


class _MeanMaps(Mapping[str, NDArray[np.float32]]):
    """Material -> mean path length (mm) of each square, averaged when asked for."""

    def __init__(self, maps: Mapping[str, NDArray[np.float32]], factor: int) -> None:
        self._maps = maps
        self._factor = factor

    def __getitem__(self, material: str) -> NDArray[np.float32]:
        return means_of_bins(self._maps[material], self._factor)

    def __iter__(self) -> Iterator[str]:
        return iter(self._maps)

    def __len__(self) -> int:
        return len(self._maps)

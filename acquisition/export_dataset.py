"""Datasets for other trainers and viewers: COCO, YOLO, and TIFF with pixel pitch and setting in its tags.

coco   images/<split>/NAME.png or .tif, annotations/<split>.json with boxes and run lengths of every part of the masks
yolo   images/<split>/NAME.png or .tif, labels/<split>/NAME.txt with boxes or outlines, data.yaml
tiff   low/, high/ (-log(I/I0), float32, OME-TIFF), foreign_object/, product/ and a sidecar; `raytwin import reference` reads it back

The pictures for trainers hold the low kV image in red and the high kV image in green and blue. Grey 0 and full scale are the lowest
and highest -log(I/I0) of all images of the dataset at that voltage.
"""

import csv
import json
import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import whole_folder
from .dataset_io import SPLITS, Dataset
from .mask_shapes import iter_mask_shapes

DATASET_FORMATS = ("coco", "yolo", "tiff")
LABELS = ("polygons", "boxes")
CATEGORY = "foreign_object"
_GREY_BITS = (8, 16)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportedImages:
    """What was written: files (pattern -> what it holds), images (pairs), objects (parts of masks), warnings."""

    files: dict[str, str]
    images: int
    objects: int
    warnings: tuple[str, ...] = ()


def export_dataset(
    dataset: Dataset,
    folder: str | os.PathLike[str],
    *,
    to: str,
    labels: str = "polygons",
    bits: int | None = None,
    pixel_mm: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ExportedImages:
    """Write a dataset in the form that other programs read; the folder appears whole or not at all.

    Args:
        dataset: image pairs with masks.
        folder: new or empty.
        to: `coco`, `yolo` or `tiff`.
        labels: of YOLO: `polygons` (outlines, for segmentation) or `boxes`.
        bits: of a grey value for trainers: 8 (PNG, what most read) or 16 (TIFF); None: 8 for YOLO, 16 for COCO.
        pixel_mm: pitch, for the TIFF tags; None: the dataset's own, where it states one.
        progress: called with (pairs done, pairs in all).

    Returns:
        What was written.

    Raises:
        InputError: another form, a folder with something in it.
    """
    if to not in DATASET_FORMATS:
        raise InputError(
            "to", received=repr(to), expected="one of " + ", ".join(DATASET_FORMATS) + ", zarr for a dataset"
        )
    if labels not in LABELS:
        raise InputError("labels", received=repr(labels), expected="one of " + ", ".join(LABELS))
    if labels != LABELS[0] and to != "yolo":
        raise InputError("labels", received=f"{labels} with {to}", expected="none: the option is of yolo")
    if bits is not None and bits not in _GREY_BITS:
        raise InputError("bits", received=bits, expected="8 or 16")
    if pixel_mm is None:
        stated = dataset.attributes.get("pixel_mm")
        pixel_mm = float(stated) if isinstance(stated, int | float) else None
    if pixel_mm is not None and not (math.isfinite(pixel_mm) and pixel_mm > 0):
        raise InputError("pixel_mm", received=f"{pixel_mm} mm", expected="a finite pitch above 0 mm")

    def count(number: int) -> None:
        if progress is not None:
            progress(number + 1, len(dataset))

    with whole_folder(folder) as place:
        if to == "tiff":
            return _write_tiff(dataset, place, pixel_mm=pixel_mm, count=count)
        greys = _Greys.of(dataset, bits=bits or (8 if to == "yolo" else 16))
        if to == "coco":
            return _write_coco(dataset, place, greys, pixel_mm=pixel_mm, count=count)
        return _write_yolo(dataset, place, greys, labels=labels, count=count)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Greys:
    """How values become grey: lowest, highest (2,) of -log(I/I0), low kV first; bits of a grey value."""

    lowest: NDArray[np.float64]
    highest: NDArray[np.float64]
    bits: int

    @classmethod
    def of(cls, dataset: Dataset, *, bits: int) -> "_Greys":
        lowest, highest = np.full(2, np.inf), np.full(2, -np.inf)
        for number in range(len(dataset)):
            image = dataset.images(number)
            lowest = np.minimum(lowest, image.min(axis=(1, 2)))
            highest = np.maximum(highest, image.max(axis=(1, 2)))
        return cls(lowest=lowest, highest=np.maximum(highest, lowest + np.finfo(np.float32).eps), bits=bits)

    @property
    def ending(self) -> str:
        return ".png" if self.bits == 8 else ".tif"

    @property
    def step(self) -> NDArray[np.float64]:
        """-log(I/I0) of one grey level."""
        return np.asarray((self.highest - self.lowest) / (2**self.bits - 1))

    @property
    def warning(self) -> str:
        low, high = self.step
        return f"one grey level is {low:.2g} (low kV) and {high:.2g} (high kV) of -log(I/I0); --bits 16 is finer"

    def write(self, path: Path, image: NDArray[Any]) -> None:
        scaled = np.rint((image - self.lowest[:, None, None]) / self.step[:, None, None])
        low, high = scaled.astype(np.uint8 if self.bits == 8 else np.uint16)
        picture = np.stack([low, high, high], axis=-1)
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.bits == 8:
            import imageio.v3 as imageio

            imageio.imwrite(path, picture)
        else:
            import tifffile

            tifffile.imwrite(path, picture, photometric="rgb", metadata=None)


def _names(dataset: Dataset) -> list[str]:
    """A file name for each image, without an ending: its identifier where that can be one, and unlike all others."""
    names: list[str] = []
    taken: set[str] = set()
    for number, row in enumerate(dataset.rows):
        name = re.sub(r"[^\w.-]+", "_", row.image).strip("._") or "image"
        if name.lower() in taken:
            name = f"{name}_{number}"
        while name.lower() in taken:
            name += "_"
        taken.add(name.lower())
        names.append(name)
    return names


def _of_splits(dataset: Dataset) -> Iterator[tuple[str, list[int]]]:
    for split in SPLITS:
        numbers = [number for number, row in enumerate(dataset.rows) if row.split == split]
        if numbers:
            yield split, numbers


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _write_coco(
    dataset: Dataset, place: Path, greys: _Greys, *, pixel_mm: float | None, count: Callable[[int], None]
) -> ExportedImages:
    from .. import __version__

    names, rows, columns = _names(dataset), *dataset.shape
    objects = 0
    (place / "annotations").mkdir()
    for split, numbers in _of_splits(dataset):
        images, annotations = [], []
        for number in numbers:
            row = dataset.rows[number]
            file_name = f"images/{split}/{names[number]}{greys.ending}"
            greys.write(place / file_name, dataset.images(number))
            images.append(
                {
                    "id": number + 1,
                    "file_name": file_name,
                    "height": rows,
                    "width": columns,
                    "product": row.product,
                    "setting": row.setting,
                }
            )
            for shape in iter_mask_shapes(dataset.foreign_object_masks(number)):
                objects += 1
                annotations.append(
                    {
                        "id": objects,
                        "image_id": number + 1,
                        "category_id": 1,
                        "bbox": list(shape.box_px),
                        "area": shape.area_px,
                        "segmentation": {"size": [rows, columns], "counts": list(shape.counts)},
                        "iscrowd": 0,
                        "foreign_object": row.foreign_object,
                        "size_mm": _known(row.size_mm),
                        "contrast": _known(row.contrast),
                    }
                )
            count(number)
        info = {
            "description": f"raytwin dataset {Path(dataset.path).name}, {split}",
            "version": __version__,
            "channels": ["low kV", "high kV", "high kV"],
            "lowest": greys.lowest.tolist(),
            "highest": greys.highest.tolist(),
            "unit": "-log(I/I0)",
            "pixel_mm": pixel_mm,
        }
        categories = [{"id": 1, "name": CATEGORY, "supercategory": ""}]
        content = {"info": info, "licenses": [], "images": images, "annotations": annotations, "categories": categories}
        (place / "annotations" / f"{split}.json").write_text(json.dumps(content), encoding="utf-8")
    return ExportedImages(
        files={
            f"images/<split>/*{greys.ending}": f"{greys.bits} bits a channel: low kV, high kV, high kV",
            "annotations/<split>.json": "boxes, run lengths (RLE), areas; grey scale in `info`",
        },
        images=len(dataset),
        objects=objects,
        warnings=(greys.warning,) if greys.bits == 8 else (),
    )


def _write_yolo(
    dataset: Dataset, place: Path, greys: _Greys, *, labels: str, count: Callable[[int], None]
) -> ExportedImages:
    names, (rows, columns) = _names(dataset), dataset.shape
    objects = 0
    for split, numbers in _of_splits(dataset):
        (place / "labels" / split).mkdir(parents=True)
        for number in numbers:
            greys.write(place / "images" / split / f"{names[number]}{greys.ending}", dataset.images(number))
            lines = []
            for shape in iter_mask_shapes(dataset.foreign_object_masks(number)):
                objects += 1
                left, top, width, height = shape.box_px
                if labels == "boxes":
                    middle = ((left + 0.5 * width) / columns, (top + 0.5 * height) / rows)
                    values = [*middle, width / columns, height / rows]
                else:
                    values = (shape.outline_px / (columns, rows)).ravel().tolist()
                lines.append(" ".join(["0", *(f"{value:.6f}" for value in values)]) + "\n")
            # an image without object has an empty file: trainers take it for a clean one
            (place / "labels" / split / f"{names[number]}.txt").write_text("".join(lines), encoding="utf-8")
            count(number)
    there = [split for split, _ in _of_splits(dataset)]
    text = "".join(f"{split}: images/{split}\n" for split in there) + f"names:\n  0: {CATEGORY}\n"
    (place / "data.yaml").write_text(text, encoding="utf-8")
    missing = [split for split in ("train", "val") if split not in there]
    warnings = [f"no images of the split {' and '.join(missing)}: YOLO trainers want both"] if missing else []
    return ExportedImages(
        files={
            f"images/<split>/*{greys.ending}": f"{greys.bits} bits a channel: low kV, high kV, high kV",
            "labels/<split>/*.txt": "class 0 and "
            + ("box" if labels == "boxes" else "outline")
            + ", shares of the image",
            "data.yaml": "what trainers ask for",
        },
        images=len(dataset),
        objects=objects,
        warnings=(*warnings, *((greys.warning,) if greys.bits == 8 else ())),
    )


def _write_tiff(
    dataset: Dataset, place: Path, *, pixel_mm: float | None, count: Callable[[int], None]
) -> ExportedImages:
    import imageio.v3 as imageio

    from .tiff_tags import write_tiff

    names = _names(dataset)
    settings = {row.setting for row in dataset.rows}
    for name in ("low", "high", "foreign_object", "product"):
        (place / name).mkdir()
    objects = 0
    for number, row in enumerate(dataset.rows):
        images = dataset.images(number)
        both = row.setting.partition(";")
        for plane, (energy, setting) in enumerate((("low", both[0]), ("high", both[2]))):
            path = place / energy / f"{names[number]}.tif"
            write_tiff(path, images[plane], pixel_mm=pixel_mm, words={"setting": setting, "values": "-log(I/I0)"})
        foreign, product = dataset.foreign_object_masks(number), dataset.product_masks(number)
        objects += bool(foreign.any())
        for name, mask in (("foreign_object", foreign), ("product", product)):
            imageio.imwrite(place / name / f"{names[number]}.png", mask.astype(np.uint8) * 255)
        count(number)
    with (place / "rows.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["image", "product", "foreign_object", "size_mm", "contrast", "split", "setting"])
        for name, row in zip(names, dataset.rows, strict=True):
            numbers = ["" if math.isnan(value) else f"{value:.9g}" for value in (row.size_mm, row.contrast)]
            writer.writerow([name, row.product, row.foreign_object, *numbers, row.split, row.setting])
    files = {
        "low/*.tif, high/*.tif": "-log(I/I0), float32; pitch and setting in the tags (OME-TIFF)",
        "foreign_object/*.png, product/*.png": "masks, 255 inside",
        "rows.csv": "product, foreign object, size, contrast, split and setting of each",
    }
    warnings = []
    if pixel_mm is None:
        warnings.append("the pixel pitch is not known: no scale in the tags; give it with --pixel-mm")
    low, _, high = next(iter(settings)).partition(";")
    if len(settings) == 1 and low and high:
        (place / "raytwin.toml").write_text(_pairs_sidecar(low, high, pixel_mm), encoding="utf-8")
        files["raytwin.toml"] = "`raytwin import reference` reads the folder back"
    else:
        warnings.append("no sidecar, which states one setting: rows.csv states that of each image")
    return ExportedImages(
        files=files,
        images=len(dataset),
        objects=objects,
        warnings=tuple(warnings),
    )


def _pairs_sidecar(low: str, high: str, pixel_mm: float | None) -> str:
    lines = [] if pixel_mm is None else ["[instrument]", f"pixel_mm = {pixel_mm!r}", ""]
    lines += [
        "[pairs]",
        'low = "low/*.tif"',
        'high = "high/*.tif"',
        'foreign_object_mask = "foreign_object/*.png"',
        'product_mask = "product/*.png"',
        'values = "log"',
        'rows = "rows.csv"',
        f'low_setting = "{low}"',
        f'high_setting = "{high}"',
    ]
    return "\n".join(lines) + "\n"

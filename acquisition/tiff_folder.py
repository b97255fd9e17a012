"""Export of a dataset as TIFF folders in the layout of the paper's data; `raytwin import zenodo` reads it back.

    <kV>kV_<W>W_<ms>ms[_<n>avg]/{train,val,test}/{NoBone,RibBone}/NNN.tiff       -ln(I / I0), float32
                                                 {NoBone,RibBone}_segm/NNN.tiff  two pages, product and foreign object
                                                 {NoBone,RibBone}.csv            ID, FO_size, Contrast, Chicken_ID, ...

One tree a tube voltage; the same number is the same image in both. The names carry no filter and no distance.
"""

import csv
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import whole_folder
from .dataset_io import Dataset, DatasetRow
from .setting import Setting, setting_from_text, text_from_filters

CLASSES = ("NoBone", "RibBone")
COLUMNS = ("ID", "FO_size", "Contrast", "Chicken_ID", "Bone_Class", "Bone_ID", "Image")


@dataclass(frozen=True, slots=True, kw_only=True)
class TiffFolder:
    """What was written: folder, images (pairs), trees (names), notes (what the names do not carry)."""

    folder: str
    images: int
    trees: tuple[str, ...]
    notes: tuple[str, ...]


def setting_folder_name(setting: Setting) -> str:
    """Folder name of a setting, for example `40kV_40W_100ms_10avg`.

    Raises:
        InputError: the tube load is unknown.
    """
    current_mA = setting.tube_current_mA
    if current_mA is None:
        raise InputError(
            "setting",
            received=str(setting),
            expected="a tube load, which the folder's name states",
            remedy="power_w=...",
        )
    power_W = setting.power_W if setting.power_W is not None else current_mA * setting.kV
    averaged = f"_{setting.averaged}avg" if setting.averaged != 1 else ""
    words = [f"{value:.6g}{unit}" for value, unit in ((setting.kV, "kV"), (power_W, "W"), (setting.exposure_ms, "ms"))]
    name = "_".join(words) + averaged
    if "e" in name:
        raise InputError("setting", received=str(setting), expected="numbers that a folder's name can hold")
    return name


def write_tiff_folder(
    dataset: Dataset, folder: str | os.PathLike[str], *, progress: Callable[[int, int], None] | None = None
) -> TiffFolder:
    """Write a dataset as TIFF folders in the paper's layout; the folder appears whole or not at all.

    Args:
        dataset: pairs whose rows state their settings.
        folder: new or empty.
        progress: called with (pairs done, pairs in all).

    Raises:
        InputError: a folder with something in it, rows without settings, or two pairs of settings in one tree.
    """
    import tifffile

    partners: dict[str, str] = {}
    settings = [_settings(row) for row in dataset.rows]
    for low, high in settings:
        for own, other in ((low, high), (high, low)):
            name, partner = setting_folder_name(own), setting_folder_name(other)
            if partners.setdefault(name, partner) != partner or name == partner:
                raise InputError(
                    f"setting {own}",
                    received=f"pairs with {partners[name]} and with {partner}",
                    expected="one partner for each tree",
                    remedy="export the settings one by one",
                )
    with whole_folder(folder) as temporary:
        counted: dict[tuple[str, str, str], int] = {}
        tables: dict[Path, list[dict[str, str]]] = {}
        for number, (row, pair) in enumerate(zip(dataset.rows, settings, strict=True)):
            class_name = CLASSES[bool(row.foreign_object)]
            key = (setting_folder_name(pair[0]), row.split, class_name)
            counted[key] = counted.get(key, 0) + 1
            images = dataset.images(number)
            masks = np.stack([dataset.product_masks(number), dataset.foreign_object_masks(number)]).astype(np.uint8)
            for plane, setting in enumerate(pair):
                place = temporary / setting_folder_name(setting) / row.split
                for kind, values in ((class_name, images[plane]), (f"{class_name}_segm", masks)):
                    (place / kind).mkdir(parents=True, exist_ok=True)
                    tifffile.imwrite(
                        place / kind / f"{counted[key]:03d}.tiff", values, photometric="minisblack", metadata=None
                    )
                tables.setdefault(place / f"{class_name}.csv", []).append(_table_row(counted[key], row))
            if progress is not None:
                progress(number + 1, len(dataset))
        for path, rows in tables.items():
            with path.open("w", newline="", encoding="utf-8") as stream:
                writer = csv.DictWriter(stream, COLUMNS)
                writer.writeheader()
                writer.writerows(rows)
    filters = sorted({text_from_filters(one.filters) or "none" for pair in settings for one in pair})
    return TiffFolder(
        folder=str(folder),
        images=len(dataset),
        trees=tuple(sorted(partners)),
        notes=(f"the folders' names do not carry the filter: {', '.join(filters)}",),
    )


def _settings(row: DatasetRow) -> tuple[Setting, Setting]:
    low, semicolon, high = row.setting.partition(";")
    if not semicolon:
        raise InputError(f"image {row.image}", received=f"setting {row.setting!r}", expected="LOW;HIGH")
    return setting_from_text(low), setting_from_text(high)


def _table_row(number: int, row: DatasetRow) -> dict[str, str]:
    def text(value: float) -> str:
        return "" if math.isnan(value) else f"{value:.9g}"

    return {
        "ID": str(number),
        "FO_size": text(row.size_mm),
        "Contrast": text(row.contrast),
        "Chicken_ID": row.product,
        "Bone_Class": row.foreign_object,
        "Bone_ID": "",
        "Image": row.image,
    }

"""Import of a user's own reference images with masks -> a dataset file.

Either an acquisition file whose object series pair up by scene, or a folder with a sidecar `raytwin.toml`. The sidecar
describes raw series as for `images` ([[series]], [[scene]]), or images that are corrected already:

    [pairs]
    low = "low/*.tif"                     # the one * stands for the image; the same in all four
    high = "high/*.tif"
    foreign_object_mask = "bone/*.png"
    product_mask = "product/*.png"        # optional: else where M_low > 0.1
    values = "log"                        # log: -log(I/I0); transmission: I/I0
    low_setting = "kv=40,power_w=40,exposure_ms=100,averaged=10,filter=Cu:0.05"
    high_setting = "kv=90,power_w=45,exposure_ms=100,averaged=10,filter=Cu:0.05"
    without_mask = "skip"                 # or "clean": an image without mask holds no foreign object
    rows = "rows.csv"                     # optional; columns image, product, foreign_object, size_mm, contrast, split
"""

import math
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError
from ._image_files import number_in_cell, read_image, read_mask
from ._sidecar import NAME, check_words, instrument_of, raw_layout_of, read_sidecar, rows_of, starred, text_of
from .acquisition_io import open_acquisition
from .contrast import DILATIONS, PRODUCT_THRESHOLD, check_dilations, delta_r, dilations_for_pixel
from .dataset_io import SPLITS, DatasetRow, write_dataset
from .images import import_images
from .import_report import ImportReport, Skipped
from .pairs import dataset_from_acquisition, object_pairs, replace_bad_pixels, split_by_product
from .setting import Setting, setting_from_text

MINIMAL = "[pairs] low='low/*.tif' high='high/*.tif' foreign_object_mask='bone/*.png' low_setting=... high_setting=..."
SMALLEST_TRANSMISSION = 1e-5

_PAIR_WORDS = (
    *("low", "high", "foreign_object_mask", "product_mask"),
    *("values", "low_setting", "high_setting", "without_mask", "rows"),
)


def import_reference(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    sidecar: str | os.PathLike[str] | None = None,
    low: Setting | None = None,
    high: Setting | None = None,
    each_frame: bool = False,
    dilations: int = DILATIONS,
    validation: float | None = None,
    test: float | None = None,
    rng: np.random.Generator | None = None,
    bad_pixels: NDArray[np.bool_] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Turn reference images with masks into a dataset file.

    Args:
        source: an acquisition file, or a folder with a sidecar (see the module's text).
        out: dataset file to write.
        sidecar: TOML file; None = `raytwin.toml` in the folder.
        low, high: settings of the pair, where an acquisition holds several.
        each_frame: every frame of an acquisition makes an image; otherwise the frames of a series are averaged.
        dilations: width of the ring (pixels) that contrasts are measured against.
        validation, test: shares of the products to put into these splits; None keeps the splits that are given.
        rng: deals the products out to the splits; needed with `validation` or `test`.
        bad_pixels: (row, column), True where the log images are replaced by their neighbours.
        progress: called with (pairs done, pairs in all).

    Raises:
        InputError: no sidecar, no pair, settings that do not fit, masks of another shape.
    """
    path = Path(source)
    check_dilations(dilations)
    shares = None
    if validation is not None or test is not None:
        if rng is None:
            raise InputError("rng", received="none", expected="a random generator to deal products out to splits")
        shares = (validation or 0.0, test or 0.0, rng)
    wanted = _Wanted(
        low=low,
        high=high,
        each_frame=each_frame,
        dilations=dilations,
        shares=shares,
        bad_pixels=bad_pixels,
        progress=progress,
    )
    if path.is_file():
        return _from_acquisition(path, path, out, wanted)
    tables = read_sidecar(
        path,
        None if sidecar is None else Path(sidecar),
        known=("instrument", "raw", "series", "scene", "pairs"),
        minimal=MINIMAL,
    )
    if "pairs" in tables:
        return _from_images(path, out, tables, wanted)
    with tempfile.TemporaryDirectory(prefix="raytwin-") as folder:
        # The frames take the way of every raw series; the acquisition is not needed afterwards.
        step = Path(folder) / "acquisition.h5"
        images = import_images(path, step, sidecar=sidecar)
        report = _from_acquisition(path, step, out, wanted)
        return replace(report, skipped=(*images.skipped, *report.skipped), notes=(*images.notes, *report.notes))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Wanted:
    """The choices of one import, as `import_reference` explains them."""

    low: Setting | None
    high: Setting | None
    each_frame: bool
    dilations: int
    shares: tuple[float, float, np.random.Generator] | None
    bad_pixels: NDArray[np.bool_] | None
    progress: Callable[[int, int], None] | None


def _from_acquisition(source: Path, path: Path, out: str | os.PathLike[str], wanted: _Wanted) -> ImportReport:
    with open_acquisition(path) as acquisition:
        split = None
        if wanted.shares is not None:
            scenes = {pair.scene for pair in object_pairs(acquisition)} & set(acquisition.scenes)
            products = {scene: acquisition.scenes[scene].product or scene for scene in sorted(scenes)}
            validation, test, rng = wanted.shares
            split = split_by_product(products, validation=validation, test=test, rng=rng)
        summary = dataset_from_acquisition(
            acquisition,
            out,
            low=wanted.low,
            high=wanted.high,
            split=split,
            each_frame=wanted.each_frame,
            dilations=wanted.dilations,
            bad_pixels=wanted.bad_pixels,
            provenance={"source": source.name},
            progress=wanted.progress,
        )
        ring_note = _ring_note(wanted.dilations, acquisition.instrument.pixel_mm)
    return ImportReport(
        layout="reference",
        source=str(source),
        written=str(out),
        format="dataset",
        read=tuple(
            {"setting": setting, "images": summary.images, "with_foreign_object": summary.with_foreign_object}
            for setting in summary.settings
        ),
        frames=summary.images,
        skipped=tuple(Skipped(what=line.split(":", 1)[0], reason=_reason(line)) for line in summary.skipped),
        notes=(*summary.notes, *ring_note),
    )


def _reason(line: str) -> str:
    return line.split(":", 1)[1].strip() if ":" in line else line


def _ring_note(dilations: int, pixel_mm: float | None) -> tuple[str, ...]:
    if pixel_mm is None or dilations != DILATIONS or dilations_for_pixel(pixel_mm) == DILATIONS:
        return ()
    return (
        f"contrasts are measured against a ring of {dilations} pixels, here {dilations * pixel_mm:.2g} mm wide;"
        f" --ring-px {dilations_for_pixel(pixel_mm)} makes it as wide as the paper's",
    )


def _from_images(folder: Path, out: str | os.PathLike[str], tables: Mapping[str, Any], wanted: _Wanted) -> ImportReport:
    where = f"{NAME}, [pairs]"
    table = tables["pairs"]
    if not isinstance(table, dict):
        raise InputError(where, received="a list", expected="one table [pairs]")
    check_words(table, _PAIR_WORDS, where=where)
    for word in ("low", "high", "foreign_object_mask", "low_setting", "high_setting"):
        if word not in table:
            raise InputError(where, received=f"no {word}", expected=f"{word} = ...", remedy=f"at least: {MINIMAL}")
    values = _choice(table, "values", ("log", "transmission"), where=where)
    without_mask = _choice(table, "without_mask", ("skip", "clean"), where=where)
    settings = tuple(
        setting_from_text(text_of(table, word, where=where) or "") for word in ("low_setting", "high_setting")
    )
    if settings[0].kV >= settings[1].kV:
        raise InputError(
            where,
            received=f"{settings[0].kV:g} kV and {settings[1].kV:g} kV",
            expected="the lower tube voltage as low",
            remedy="exchange low and high, or give another kV",
        )
    patterns = {
        word: starred(folder, text_of(table, word, where=where) or "", where=f"{where}, {word}")
        for word in ("low", "high", "foreign_object_mask", "product_mask")
        if word in table
    }
    rows = rows_of(folder, table, "image", where=where)
    skipped: list[Skipped] = []
    names = []
    for name in sorted(patterns["low"].keys() | patterns["high"].keys(), key=lambda text: (len(text), text)):
        lacking = next((word for word in ("low", "high") if name not in patterns[word]), None)
        if lacking is not None:
            skipped.append(Skipped(what=f"image {name}", reason=f"no {lacking} image"))
        elif name not in patterns["foreign_object_mask"] and without_mask == "skip":
            skipped.append(Skipped(what=f"image {name}", reason="no foreign_object_mask (an empty one says: none)"))
        else:
            names.append(name)
    if not names:
        raise InputError(
            str(folder),
            received=f"no image pair with mask ({skipped[0].what}: {skipped[0].reason})" if skipped else "no images",
            expected="files that match low, high and foreign_object_mask",
            remedy='check the patterns in [pairs]; without_mask = "clean" takes images without mask as free of objects',
        )
    known_names = patterns["low"].keys() | patterns["high"].keys()
    skipped += [Skipped(what=f"row {name}", reason="no image of that name") for name in rows if name not in known_names]
    splits = {}
    if wanted.shares is not None:
        validation, test, rng = wanted.shares
        products = {name: rows.get(name, {}).get("product") or name for name in names}
        splits = split_by_product(products, validation=validation, test=test, rng=rng)
    raw = raw_layout_of(tables, where=NAME)
    pixel_mm = instrument_of(tables, where=NAME).pixel_mm
    notes = list(_ring_note(wanted.dilations, pixel_mm))
    counted = 0
    shape: tuple[int, int] | None = None

    def log_image(path: Path) -> NDArray[np.float32]:
        image = np.asarray(read_image(path, raw=raw), dtype=np.float32)
        if not bool(np.isfinite(image).all()):
            raise FileFormatError(str(path), received="a value that is not finite", expected="finite values")
        if shape is not None and image.shape != shape:
            raise FileFormatError(str(path), received=f"shape {image.shape}", expected=f"shape {shape} as the others")
        if values == "transmission":
            image = np.asarray(-np.log(np.maximum(image, SMALLEST_TRANSMISSION)), dtype=np.float32)
        if wanted.bad_pixels is not None and bool(wanted.bad_pixels.any()):
            image = np.asarray(replace_bad_pixels(image, wanted.bad_pixels), dtype=np.float32)
        return image

    first = log_image(patterns["low"][names[0]])
    shape = (first.shape[0], first.shape[1])
    provenance = {"source": folder.name, "values": values, "pixel_mm": pixel_mm}
    with write_dataset(out, shape=shape, provenance=provenance) as writer:
        for done, name in enumerate(names):
            image = np.stack([log_image(patterns[word][name]) for word in ("low", "high")])
            foreign = _mask(patterns["foreign_object_mask"].get(name), shape)
            product = _mask(patterns.get("product_mask", {}).get(name), shape)
            row = _row(name, rows.get(name, {}), image, foreign, wanted.dilations, notes)
            writer.append(
                image=image,
                foreign_object_mask=foreign,
                product_mask=image[0] > PRODUCT_THRESHOLD if product is None else product,
                row=replace(
                    row, split=splits.get(name, row.split), setting=";".join(str(setting) for setting in settings)
                ),
            )
            counted += bool(row.foreign_object)
            if wanted.progress is not None:
                wanted.progress(done + 1, len(names))
    read = {"setting": ";".join(map(str, settings)), "images": len(names), "with_foreign_object": counted}
    return ImportReport(
        layout="reference",
        source=str(folder),
        written=str(out),
        format="dataset",
        read=(read,),
        frames=len(names),
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


def _choice(table: Mapping[str, Any], word: str, choices: tuple[str, ...], *, where: str) -> str:
    value = text_of(table, word, where=where, default=choices[0]) or choices[0]
    if value not in choices:
        raise InputError(f"{where}, {word}", received=repr(value), expected="one of " + ", ".join(choices))
    return value


def _mask(path: Path | None, shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    if path is None:
        return None
    mask = read_mask(path)
    if mask.shape != shape:
        raise FileFormatError(
            str(path),
            received=f"a mask of {mask.shape[0]} x {mask.shape[1]} pixels",
            expected=f"{shape[0]} x {shape[1]} as the images",
            remedy="give masks on the image's own pixels",
        )
    return mask


def _row(
    name: str,
    known: Mapping[str, str],
    image: NDArray[np.float32],
    foreign: NDArray[np.bool_] | None,
    ring: int,
    notes: list[str],
) -> DatasetRow:
    has_object = foreign is not None and bool(foreign.any())
    contrast, size_mm = (
        number_in_cell(known.get(word), where=f"{word} of image {name}") for word in ("contrast", "size_mm")
    )
    if has_object and foreign is not None and math.isnan(contrast):
        try:
            contrast = delta_r(image[0], image[1], foreign, dilations=ring)
        except InputError as error:
            notes.append(f"image {name}: no contrast ({error})")
    split = known.get("split") or "test"
    if split not in SPLITS:
        raise InputError(f"split of image {name}", received=repr(split), expected="one of " + ", ".join(SPLITS))
    return DatasetRow(
        image=name,
        product=known.get("product") or name,
        foreign_object=(known.get("foreign_object") or "unnamed") if has_object else "",
        size_mm=size_mm if has_object else math.nan,
        contrast=contrast if has_object else math.nan,
        split=split,
    )

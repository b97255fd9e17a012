"""Dual-energy image pairs out of an acquisition: dark and flat correction, pairing by scene, one dataset a setting."""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ._acquisition_words import text_from_shape
from .acquisition_io import AcquisitionFile, Series
from .contrast import DILATIONS, PRODUCT_THRESHOLD, check_dilations, delta_r
from .dataset_io import DatasetRow, write_dataset
from .log_images import holds_shares, logarithm_of_share
from .scenes import Scene
from .setting import Setting

_SAME = 1e-6
_LEAST_SIGNAL_DN = 1.0


def flat_corrected_log(
    counts_DN: NDArray[Any], *, dark_DN: NDArray[Any] | float, flat_DN: NDArray[Any]
) -> NDArray[np.float32]:
    """-log(I/I0) (dimensionless) of raw detector numbers.

    Equation: M = -log(max(I - D, m) / max(F - D, m)), with I `counts_DN`, D `dark_DN`, F `flat_DN`, m = 1 DN.

    Validity: signals below 1 DN above dark are set to it, so that M stays finite behind opaque objects: there M
    is a lower bound, at most log((F - D) / m). A pixel whose flat does not rise above the dark (a dead one) gives 0 or
    less; replace such pixels with `replace_bad_pixels`. At few photons -log is biased upwards by var / (2 mean^2).

    Args:
        counts_DN: (..., row, column) raw frames, dark included.
        dark_DN: (row, column) mean of darks of the same exposure time.
        flat_DN: (row, column) mean of flats of the same setting, dark included.

    Returns:
        (..., row, column) float32.
    """
    dark = np.asarray(dark_DN, dtype=np.float64)
    open_field_DN = np.maximum(np.asarray(flat_DN, dtype=np.float64) - dark, _LEAST_SIGNAL_DN)
    signal_DN = np.maximum(np.asarray(counts_DN, dtype=np.float64) - dark, _LEAST_SIGNAL_DN)
    return np.asarray(-np.log(signal_DN / open_field_DN), dtype=np.float32)


def replace_bad_pixels(image: NDArray[Any], bad: NDArray[np.bool_]) -> NDArray[Any]:
    """A copy of an image with every bad pixel set to the median of the good pixels around it (unit of the image).

    The four nearest neighbours are used where at least two of them are good, else the eight, else the smallest square
    window that holds a good pixel.

    Args:
        image: (..., row, column).
        bad: (row, column), True where the pixel is to be replaced.

    Raises:
        InputError: shapes that differ, or no good pixel at all.
    """
    if image.shape[-2:] != bad.shape:
        raise InputError(
            "map of bad pixels",
            received=f"{text_from_shape(bad.shape)} pixels",
            expected=f"{text_from_shape(image.shape[-2:])} pixels as in the images",
            remedy="give the map, or the twin that holds it, of the detector that took these images",
        )
    if bool(bad.all()):
        raise InputError("map of bad pixels", received="every pixel bad", expected="at least one good pixel")
    repaired = np.array(image, dtype=np.result_type(image.dtype, np.float32))
    rows, columns = bad.shape
    for row, column in np.argwhere(bad):
        cross = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
        good = [(r, c) for r, c in cross if 0 <= r < rows and 0 <= c < columns and not bad[r, c]]
        if len(good) < 2:
            good = _good_in_smallest_window(bad, int(row), int(column))
        values = np.stack([image[..., r, c] for r, c in good])
        repaired[..., row, column] = np.median(values, axis=0)
    return repaired


def _good_in_smallest_window(bad: NDArray[np.bool_], row: int, column: int) -> list[tuple[int, int]]:
    for reach in range(1, max(bad.shape)):
        top, left = max(0, row - reach), max(0, column - reach)
        window = np.argwhere(~bad[top : row + reach + 1, left : column + reach + 1])
        if len(window):
            return [(top + int(r), left + int(c)) for r, c in window]
    return []


def mean_of_frames(series: Sequence[Series]) -> NDArray[np.float64]:
    """Mean frame (DN) of series of one shape, (row, column), read in pieces; averaged frames weigh as many."""
    total = np.zeros(series[0].shape)
    weight = 0.0
    for one in series:
        for frames in one.iter_frames():
            total += one.averaged * frames.sum(axis=0, dtype=np.float64)
            weight += one.averaged * len(frames)
    return total / weight


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectPair:
    """One scene at a low and a high tube voltage.

    Fields: scene (name); low, high (the two object series).
    """

    scene: str
    low: Series
    high: Series

    @property
    def settings(self) -> tuple[Setting, Setting]:
        """The settings of one frame of each, low kV first."""
        if self.low.setting is None or self.high.setting is None:
            raise InputError(
                f"series {self.low.name} and {self.high.name}",
                received="no exposure time",
                expected="kV and exposure of both",
                remedy="state exposure_ms of both series",
            )
        return self.low.setting, self.high.setting

    @property
    def seconds(self) -> float:
        """Exposure that went into the pair (s), all frames of both: the more, the less noise."""
        return sum((one.exposure_ms or 0.0) * one.averaged * one.n_frames / 1000.0 for one in (self.low, self.high))


def object_pairs(acquisition: AcquisitionFile) -> tuple[ObjectPair, ...]:
    """The object series of an acquisition, paired by scene: low kV with high kV.

    Within a scene, series with the same exposure, averaging and filters belong together; what stays single is paired
    with the same exposure and averaging, then with whatever is left of the scene. Repeats pair up in order of time. Of
    more than two tube voltages the lowest and the highest make the pair.
    """
    pairs: list[ObjectPair] = []
    for scene, members in _objects_by_scene(acquisition).items():
        pairs += _pairs_of_scene(scene, members)
    return tuple(sorted(pairs, key=lambda pair: (pair.low.index, pair.high.index)))


def unpaired_objects(acquisition: AcquisitionFile) -> tuple[str, ...]:
    """Why object series are in no pair, one line each."""
    paired = {one.name for pair in object_pairs(acquisition) for one in (pair.low, pair.high)}
    lines = []
    for series in acquisition.of_kind("object"):
        if series.name in paired:
            continue
        if not series.scene:
            reason = "it names no scene"
        elif series.setting is None:
            reason = "its tube voltage or exposure time is unknown"
        else:
            reason = f"scene {series.scene} has no partner for it at another tube voltage"
        lines.append(f"object series {series.name}: {reason}")
    return tuple(lines)


def _objects_by_scene(acquisition: AcquisitionFile) -> dict[str, list[Series]]:
    grouped: dict[str, list[Series]] = {}
    for series in acquisition.of_kind("object"):
        if series.scene and series.setting is not None:
            grouped.setdefault(series.scene, []).append(series)
    return grouped


def _pairs_of_scene(scene: str, members: list[Series]) -> list[ObjectPair]:
    left = list(members)
    pairs: list[ObjectPair] = []
    keys: tuple[Callable[[Series], Any], ...] = (
        lambda series: (series.exposure_ms, series.averaged, series.filters),
        lambda series: (series.exposure_ms, series.averaged),
        lambda series: None,
    )
    for key in keys:
        groups: dict[Any, list[Series]] = {}
        for series in left:
            groups.setdefault(key(series), []).append(series)
        for group in groups.values():
            voltages = [series.kV for series in group if series.kV is not None]
            low_kV, high_kV = min(voltages), max(voltages)
            if low_kV == high_kV:
                continue
            lows = [series for series in group if series.kV == low_kV]
            highs = [series for series in group if series.kV == high_kV]
            # The last stage has no common exposure to go by: it pairs only what cannot be mistaken.
            if key is keys[-1] and (len(lows) != 1 or len(highs) != 1):
                continue
            for low, high in zip(lows, highs, strict=False):
                pairs.append(ObjectPair(scene=scene, low=low, high=high))
                left.remove(low)
                left.remove(high)
    return pairs


def matching_darks(acquisition: AcquisitionFile, series: Series) -> tuple[Series, ...]:
    """The dark series of the same exposure time and shape.

    Raises:
        InputError: there is none; the message lists the exposure times that have darks.
    """
    darks = acquisition.of_kind("dark")
    found = tuple(
        one
        for one in darks
        if one.shape == series.shape and not one.corrected and _same(one.exposure_ms, series.exposure_ms)
    )
    if not found:
        there = sorted({f"{one.exposure_ms:g} ms" for one in darks if one.exposure_ms is not None})
        raise InputError(
            f"darks for series {series.name}",
            received="none at its exposure time" + (f" (only {', '.join(there)})" if there else ""),
            expected=f"a dark series of {series.exposure_ms or math.nan:g} ms and {series.shape} pixels",
            remedy="measure darks at every exposure time that is used",
        )
    return found


def matching_flats(acquisition: AcquisitionFile, series: Series) -> tuple[Series, ...]:
    """The flat series of the same setting, whatever their averaging.

    Raises:
        InputError: there is none; the message lists the settings that have flats.
    """
    flats = acquisition.of_kind("flat")
    found = tuple(
        one
        for one in flats
        if one.shape == series.shape
        and one.corrected == series.corrected
        and one.panel_rotation_deg == series.panel_rotation_deg
        and _same_setting(one.setting, series.setting)
    )
    if not found:
        there = sorted({str(one.setting) for one in flats if one.setting is not None})
        raise InputError(
            f"flats for series {series.name}",
            received=f"none at {series.setting}" + (f" (only {'; '.join(there)})" if there else ""),
            expected="a flat series of the same setting and shape",
            remedy="measure a flat at every setting that objects are measured at",
        )
    return found


def _same(first: float | None, second: float | None) -> bool:
    if first is None or second is None:
        return first is second
    return math.isclose(first, second, rel_tol=_SAME)


def _same_setting(first: Setting | None, second: Setting | None) -> bool:
    if first is None or second is None:
        return False
    return (
        _same(first.kV, second.kV)
        and _same(first.exposure_ms, second.exposure_ms)
        and first.filters == second.filters
        and _same(first.source_detector_mm, second.source_detector_mm)
        and _same_load(first, second)
    )


def _same_load(first: Setting, second: Setting) -> bool:
    if first.tube_current_mA is None or second.tube_current_mA is None:
        return first.tube_current_mA is second.tube_current_mA
    # Current and power are both rounded on most panels: 40 W at 90 kV is shown as 0.44 mA.
    return math.isclose(first.tube_current_mA, second.tube_current_mA, rel_tol=0.01)


class PairCorrector:
    """Corrects object series of one acquisition; the mean darks and flats it needs are made once and kept."""

    def __init__(self, acquisition: AcquisitionFile, *, bad_pixels: NDArray[np.bool_] | None = None) -> None:
        self._acquisition = acquisition
        self._bad_pixels = bad_pixels
        self._means: dict[tuple[str, ...], NDArray[np.float64]] = {}

    def dark_DN(self, series: Series) -> NDArray[np.float64]:
        """Mean dark (DN) for a series, (row, column)."""
        if "offset" in series.corrected:
            return np.zeros(series.shape)
        return self._mean(matching_darks(self._acquisition, series))

    def flat_DN(self, series: Series) -> NDArray[np.float64]:
        """Mean flat (DN, dark included unless it was subtracted before) for a series, (row, column)."""
        return self._mean(matching_flats(self._acquisition, series))

    def image(self, series: Series, counts_DN: NDArray[Any]) -> NDArray[np.float32]:
        """-log(I/I0) of frames of a series, (..., row, column).

        Raises:
            InputError: no dark or flat that matches, or frames that were divided by an unknown open field.
        """
        if "log" in series.corrected:
            image = np.asarray(counts_DN, dtype=np.float32)
        elif holds_shares(series):
            image = logarithm_of_share(counts_DN)
        elif "gain" in series.corrected:
            raise InputError(
                f"series {series.name}",
                received="frames that are flat-corrected but not logarithmic",
                expected="raw frames, or frames with corrected = offset+gain+log",
                remedy="the level of the open field is unknown: give raw frames with darks and flats, or log images",
            )
        else:
            image = flat_corrected_log(counts_DN, dark_DN=self.dark_DN(series), flat_DN=self.flat_DN(series))
        if self._bad_pixels is not None and bool(self._bad_pixels.any()):
            image = np.asarray(replace_bad_pixels(image, self._bad_pixels), dtype=np.float32)
        return image

    def _mean(self, series: tuple[Series, ...]) -> NDArray[np.float64]:
        key = tuple(one.name for one in series)
        if key not in self._means:
            self._means[key] = mean_of_frames(series)
        return self._means[key]


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSummary:
    """What went into a dataset.

    Fields: images; with_foreign_object (of them); settings (`LOW;HIGH` texts that occur); shape (row, column); skipped
    (what was left out, with the reason); notes (what to know about the rest).
    """

    images: int
    with_foreign_object: int
    settings: tuple[str, ...]
    shape: tuple[int, int]
    skipped: tuple[str, ...]
    notes: tuple[str, ...]


def dataset_from_acquisition(
    acquisition: AcquisitionFile,
    out: str | os.PathLike[str],
    *,
    low: Setting | None = None,
    high: Setting | None = None,
    with_counts: bool = True,
    split: str | Mapping[str, str] | None = None,
    each_frame: bool = False,
    dilations: int = DILATIONS,
    bad_pixels: NDArray[np.bool_] | None = None,
    provenance: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> DatasetSummary:
    """Write the object pairs of one setting pair to a dataset file, with their masks and contrasts.

    A scene needs a `foreign_object_mask` (an empty one says: no foreign object); without a `product_mask` the product
    is where M_low > 0.1 in the pair the contrast comes from: the scene's with the longest exposure.

    Args:
        acquisition: open acquisition file with objects, and darks and flats at their settings.
        out: dataset file to write.
        low, high: settings of the pair; None where the acquisition holds one pair of settings only. Tube current,
            power and distance are compared only where they are given, averaging and filters where that leaves a pair.
        with_counts: keep the raw frames (DN, dark included) beside the log images.
        split: one split for all, or scene -> split; None takes the scene's attribute `split`, else `test`.
        each_frame: every frame makes an image of its own; otherwise the frames of a series are averaged.
        dilations: width of the ring around a foreign object (pixels) that its contrast is measured against.
        bad_pixels: (row, column), True where pixels are replaced by their neighbours in the log images.
        provenance: kept as attributes of the file.
        progress: called with (pairs done, pairs in all).

    Returns:
        What was written and what was left out.

    Raises:
        InputError: no pair, several pairs of settings and none chosen, or no dark or flat that matches.
    """
    check_dilations(dilations)
    pairs = object_pairs(acquisition)
    if not pairs:
        raise InputError(
            acquisition.path,
            received=f"{len(acquisition.of_kind('object'))} object series that make no pair",
            expected="object series at two tube voltages that name the same scene",
            remedy="; ".join(unpaired_objects(acquisition)[:3]),
        )
    chosen = _choose(pairs, low, high)
    kinds = sorted({_text(pair) for pair in chosen})
    if len(kinds) != 1:
        there = kinds or sorted({_text(pair) for pair in pairs})
        raise InputError(
            "setting pair",
            received=(f"{len(kinds)} that fit" if kinds else _no_fit(pairs, low, high))
            + ("" if low or high else " (none was chosen)"),
            expected="one of " + " | ".join(there),
            remedy="choose one with low and high",
        )
    corrector = PairCorrector(acquisition, bad_pixels=bad_pixels)
    skipped, notes = list(unpaired_objects(acquisition)), []
    usable = []
    for pair in chosen:
        scene = acquisition.scenes.get(pair.scene)
        if scene is None or scene.foreign_object_mask is None:
            skipped.append(
                f"scene {pair.scene}: no foreign_object_mask (an empty one says that the product holds none)"
            )
        elif pair.low.shape != chosen[0].low.shape or pair.high.shape != pair.low.shape:
            skipped.append(f"scene {pair.scene}: {pair.low.shape} pixels, the first has {chosen[0].low.shape}")
        else:
            usable.append((pair, scene))
    if not usable:
        raise InputError(
            acquisition.path,
            received=f"{len(chosen)} pairs and no usable scene ({skipped[-1]})",
            expected="scenes with foreign_object_mask",
            remedy="give each scene a mask; an empty one says that it holds no object",
        )
    raw = all(not (pair.low.corrected or pair.high.corrected) for pair, _ in usable)
    if with_counts and not raw:
        notes.append("no counts: the frames are not raw")
    texts: set[str] = set()
    names: dict[str, int] = {}
    images = foreign = 0
    stated = {"pixel_mm": acquisition.instrument.pixel_mm, **(provenance or {})}
    with write_dataset(out, shape=usable[0][0].low.shape, provenance=stated) as writer:
        for done, (pair, scene) in enumerate(usable):
            reference = _reference(pairs, pair)
            truth = _truth(corrector, reference, scene, dilations=dilations, notes=notes)
            for counts, frames in _images_of(pair, each_frame=each_frame):
                image = np.stack(
                    [corrector.image(one, plane) for one, plane in zip((pair.low, pair.high), counts, strict=True)]
                )
                text = _text(pair, frames=frames)
                names[pair.scene] = names.get(pair.scene, 0) + 1
                number = names[pair.scene]
                row = replace(
                    truth.row,
                    image=pair.scene if number == 1 else f"{pair.scene}#{number}",
                    split=_split(split, scene),
                    setting=text,
                )
                writer.append(
                    image=image,
                    counts=counts if with_counts and raw else None,
                    foreign_object_mask=truth.foreign_object_mask,
                    product_mask=truth.product_mask,
                    row=row,
                )
                texts.add(text)
                images += 1
                foreign += bool(row.foreign_object)
            if progress is not None:
                progress(done + 1, len(usable))
    return DatasetSummary(
        images=images,
        with_foreign_object=foreign,
        settings=tuple(sorted(texts)),
        shape=usable[0][0].low.shape,
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Truth:
    row: DatasetRow
    foreign_object_mask: NDArray[np.bool_]
    product_mask: NDArray[np.bool_]


def _truth(
    corrector: PairCorrector, reference: ObjectPair, scene: Scene, *, dilations: int, notes: list[str]
) -> _Truth:
    mask = scene.foreign_object_mask
    if mask is None:
        raise InputError(f"scene {scene.name}", received="no foreign_object_mask", expected="one, empty where none is")
    M_low, M_high = (corrector.image(one, mean_of_frames([one])) for one in (reference.low, reference.high))
    contrast = math.nan
    if bool(mask.any()):
        try:
            contrast = delta_r(M_low, M_high, mask, dilations=dilations)
        except InputError as error:
            notes.append(f"scene {scene.name}: no contrast ({error})")
    elif scene.foreign_object:
        notes.append(f"scene {scene.name}: names foreign object {scene.foreign_object} but its mask is empty")
    product_mask = scene.product_mask
    return _Truth(
        row=DatasetRow(
            image=scene.name,
            product=scene.product or scene.name,
            foreign_object=(scene.foreign_object or "unnamed") if bool(mask.any()) else "",
            size_mm=scene.size_mm if bool(mask.any()) else math.nan,
            contrast=contrast,
        ),
        foreign_object_mask=mask,
        product_mask=(M_low > PRODUCT_THRESHOLD) if product_mask is None else product_mask,
    )


def _images_of(pair: ObjectPair, *, each_frame: bool) -> list[tuple[NDArray[np.float32], tuple[int, int]]]:
    if not each_frame:
        means = [mean_of_frames([one]) for one in (pair.low, pair.high)]
        return [(np.asarray(means, dtype=np.float32), (pair.low.n_frames, pair.high.n_frames))]
    frames = min(pair.low.n_frames, pair.high.n_frames)
    return [
        (np.stack([one.read_frames(k, k + 1)[0].astype(np.float32) for one in (pair.low, pair.high)]), (1, 1))
        for k in range(frames)
    ]


def _reference(pairs: Sequence[ObjectPair], pair: ObjectPair) -> ObjectPair:
    """The pair of the same scene with the least noise."""
    candidates = [other for other in pairs if other.scene == pair.scene and other.low.shape == pair.low.shape]
    return max(candidates, key=lambda other: other.seconds)


def _choose(pairs: Sequence[ObjectPair], low: Setting | None, high: Setting | None) -> list[ObjectPair]:
    """The pairs at the settings asked for; averaging and filters need not be named where nothing fits without them."""
    for unnamed in ((), ("averaged",), ("filter",), ("averaged", "filter")):
        found = [pair for pair in pairs if not any(_misfits(pair, low, high, unnamed=unnamed))]
        if found:
            return found
    return []


def _misfits(
    pair: ObjectPair, low: Setting | None, high: Setting | None, *, unnamed: Sequence[str] = ("averaged", "filter")
) -> tuple[list[str], list[str]]:
    """Words of the settings asked for that a pair does not have, of low and of high; unnamed: words that may be left out."""
    first, second = (
        [] if wanted is None else _differing(wanted, there, unnamed)
        for wanted, there in zip((low, high), (pair.low.setting, pair.high.setting), strict=True)
    )
    return first, second


def _differing(wanted: Setting, there: Setting | None, unnamed: Sequence[str]) -> list[str]:
    if there is None:
        return ["kv"]
    fits = {
        "kv": _same(wanted.kV, there.kV),
        "current_ma or power_w": wanted.tube_current_mA is None or _same_load(wanted, there),
        "exposure_ms": _same(wanted.exposure_ms, there.exposure_ms),
        "filter": wanted.filters == there.filters or ("filter" in unnamed and not wanted.filters),
        "averaged": wanted.averaged == there.averaged or ("averaged" in unnamed and wanted.averaged == 1),
        "source_detector_mm": wanted.source_detector_mm is None
        or _same(wanted.source_detector_mm, there.source_detector_mm),
    }
    return [word for word, fit in fits.items() if not fit]


def _no_fit(pairs: Sequence[ObjectPair], low: Setting | None, high: Setting | None) -> str:
    """What no pair has of the settings asked for: the words of the pair that is nearest."""
    nearest = min((_misfits(pair, low, high) for pair in pairs), key=lambda words: sum(map(len, words)))
    told = "; ".join(
        f"{', '.join(words)} of {side}" for side, words in zip(("low", "high"), nearest, strict=True) if words
    )
    return f"settings that no pair has (the nearest differs in {told})"


def _text(pair: ObjectPair, *, frames: tuple[int, int] = (1, 1)) -> str:
    return ";".join(
        str(replace(setting, averaged=setting.averaged * count))
        for setting, count in zip(pair.settings, frames, strict=True)
    )


def _split(split: str | Mapping[str, str] | None, scene: Scene) -> str:
    if split is None:
        return str(scene.attributes.get("split", "test"))
    return split if isinstance(split, str) else split.get(scene.name, "test")


def split_by_product(
    products: Mapping[str, str], *, validation: float, test: float, rng: np.random.Generator
) -> dict[str, str]:
    """Scene -> `train`, `val` or `test`; all scenes of a product share a split, so that no product is in two.

    Args:
        products: scene -> product.
        validation, test: shares of the products, each 0 or more, together at most 1.
        rng: source of the order in which products are dealt out.
    """
    if not (validation >= 0 and test >= 0 and validation + test <= 1):
        raise InputError(
            "validation and test shares", received=f"{validation} and {test}", expected="0 or more, together at most 1"
        )
    names = sorted(set(products.values()))
    order = [names[number] for number in rng.permutation(len(names))]
    n_test, n_val = round(test * len(names)), round(validation * len(names))
    splits = dict.fromkeys(order[:n_test], "test") | dict.fromkeys(order[n_test : n_test + n_val], "val")
    return {scene: splits.get(product, "train") for scene, product in products.items()}

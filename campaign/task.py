"""The gap followed to the end: POD of networks trained on images of the twin before and after a diagnosis, and on measured ones.

A designer trains networks on the twin's images, tries them on others of the twin's images and believes the a90 that comes out. So

    a90_before, a90_after   trained and tried on images of the twin as it was, and with the effects that were found
    a90_library             as a90_after, with objects made of the library's material where their own could be told
    a90_real                trained and tried on measured images

and, beside them, the twin's networks tried on the measured images. All are tried on the same objects where the measured
products' path lengths are known. All networks start from one network that learnt from both twins, which starts from the one that
comes with raytwin. The measured images must come from the line as it is now, with foreign objects whose masks are known.

Every file stands in one folder; what is there already is not made again, and training goes on where it stopped.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, open_acquisition
from ..acquisition.contrast import DILATIONS, dilations_for_pixel
from ..acquisition.dataset_io import (
    Dataset,
    DatasetRow,
    concatenate_datasets,
    read_dataset,
    write_selected,
)
from ..acquisition.pairs import ObjectPair, dataset_from_acquisition, object_pairs, split_by_product
from ..acquisition.setting import Setting, setting_from_text
from ..errors import FileFormatError, FitError, InputError
from ..files import sha256_of_file, whole_file
from ..generator.effects import effect_of
from ._plain import plain
from .trial import curve_of_table, detect_on_file, scene_of, thresholds_from_images, train_on_file, write_split

if TYPE_CHECKING:
    from ..generator.datasets.known_scenes import KnownScene
    from ..generator.line.twin import Twin

Tell = Callable[[str], None]

SIZES = {"size_mm": "mm", "contrast": ""}
ARMS = ("before", "after", "library", "measured")
# (networks of, tried on images of)
TRIALS = (
    ("before", "before"),
    ("before", "measured"),
    ("after", "after"),
    ("after", "measured"),
    ("library", "library"),
    ("measured", "measured"),
)
_FEWEST_TO_LEARN = 8  # measured images with a foreign object, below which networks of their own are not trained
_WORKERS = 2  # processes that share the networks of a kind; the weights do not depend on their number
_DRAWN = 16  # spectra: a standard deviation of so many is known to a sixth
_START_AVERAGED = 16  # the common start learns from images of as many frames: noisy ones teach a new network nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskPlan:
    """How large the trial is.

    Fields: networks of each kind; start_steps, steps (training of the common start, and of each network after it); batch;
    crop_px (side of the squares round the objects that networks learn from, 0 = whole images); draws (images of each known
    product, each with its own noise; of measured ones: at most as many frames); images (for training and again for trying,
    where products come from a description or from reference images); test_share, validation_share of the measured
    products, where the file does not say; marked_share (of the images a network learnt from that may show a mark away from
    objects: sets its threshold); size (`size_mm` or `contrast`); seed.
    """

    networks: int = 6
    start_steps: int = 60
    steps: int = 60
    batch: int = 8
    crop_px: int = 64
    draws: int = 2
    images: int = 120
    test_share: float = 0.5
    validation_share: float = 0.1
    marked_share: float = 0.1
    size: str = "contrast"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (
            ("networks", 1),
            ("start_steps", 1),
            ("steps", 1),
            ("batch", 2),
            ("crop_px", 0),
            ("draws", 1),
            ("images", 10),
        ):
            if getattr(self, name) < least:
                raise InputError(name, received=getattr(self, name), expected=f"a whole number, {least} or more")
        if not 0 < self.marked_share < 1:
            raise InputError("marked_share", received=self.marked_share, expected="a share between 0 and 1")
        if self.size not in SIZES:
            raise InputError("size of the objects", received=self.size, expected="one of " + ", ".join(SIZES))


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskInput:
    """What the user brings: measured images (acquisition or dataset), what to generate from, the pair of settings.

    Fields: measured; products: acquisition with path lengths, dataset of reference images, or a description (.toml); None: the
    path lengths in `measured`; low, high: settings; None: the only pair there is, or that of the shortest exposure.
    """

    measured: Path
    products: Path | None = None
    low: Setting | None = None
    high: Setting | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Measured:
    """Measured images at one pair of settings, with splits, as a dataset file."""

    path: Path
    low: Setting
    high: Setting
    warnings: tuple[str, ...]


def run_task(
    before: "Twin",
    after: "Twin",
    brought: TaskInput,
    directory: Path,
    *,
    plan: TaskPlan,
    device: str = "cpu",
    tell: Tell = lambda line: None,
) -> dict[str, Any]:
    """The answer's `task`: a90 on measured images, and as the two twins have it, each with its 95 % interval.

    Args:
        before, after: the twin as calibrated, and with the effects found; the same one where nothing was found.
        brought: measured images and what to generate from.
        directory: for images, networks and hit tables; made if absent.
        plan: sizes.
        device: for torch.
        tell: shows one line of progress.

    Raises:
        InputError: no foreign objects to try, settings that do not fit, a folder of another task.
    """
    if not brought.measured.is_file():
        raise InputError(
            str(brought.measured), received="no such file", expected="an acquisition or a dataset with measured images"
        )
    directory.mkdir(parents=True, exist_ok=True)
    _claim(directory, before, after, brought, plan)
    tell("measured images")
    measured = _measured_images(brought, directory, before, plan)
    source = _source(brought, measured, before, plan)
    warnings = list(measured.warnings)
    tell("what the objects are made of")
    materials, unknown = source.own_materials(after, measured)
    warnings += unknown
    tell("images of the twin before and after")
    for name, twin in (("before", before), ("after", after)):
        warnings += source.write(twin, directory / f"{name}_train.h5", directory / f"{name}_test.h5", directory)
    if materials:
        source.write_library(after, directory / "library_train.h5", directory / "library_test.h5")
    same = _same_images(directory / "before_test.h5", directory / "after_test.h5")
    effects = [item.id for item in after.effects if item not in before.effects]
    if same and effects:
        warnings.append("the effects found change no image: a90_after is a90_before")
    arms = [name for name in ARMS if not (same and name == "after") and (materials or name != "library")]
    learn = _with_objects(measured.path, ("train", "val"))
    if learn < _FEWEST_TO_LEARN:
        arms.remove("measured")
        warnings.append(
            f"{learn} measured images with a foreign object to learn from: a90_real is that of networks trained on the"
            f" {'twin' if same else 'improved twin'}'s images"
        )
    starts = [source.write_start(before, directory / "before_start.h5", directory)]
    if not same:
        starts.append(source.write_start(after, directory / "after_start.h5", directory))
    _joined(starts, directory / "start.h5")
    runs = _train(directory, arms, measured.path, plan, device=device, tell=tell)
    sizes = source.sizes()
    answers: dict[str, Any] = {}
    for networks, images in TRIALS:
        if networks not in arms:
            continue
        dataset = measured.path if images == "measured" else directory / f"{images}_test.h5"
        name = f"{networks}_on_{images}"
        table = directory / f"hits_{name}.csv"
        tell(f"networks of {networks} on images of {images}")
        learnt_from = measured.path if networks == "measured" else directory / f"{networks}_train.h5"
        thresholds = thresholds_from_images(
            runs[networks], learnt_from, directory / f"thresholds_{networks}.json", plan.marked_share, device=device
        )
        detect_on_file(runs[networks], dataset, table, sizes, thresholds, device=device)
        answers[name] = curve_of_table(table, plan.size)
    if same:
        for images in ("after", "measured"):
            told = "before" if images == "after" else images
            answers[f"after_on_{images}"] = answers[f"before_on_{told}"]
    real = "measured_on_measured" if "measured" in arms else "after_on_measured"
    result: dict[str, Any] = {}
    for key, name in (
        ("a90_real", real),
        ("a90_before", "before_on_before"),
        ("a90_after", "after_on_after"),
        ("a90_library", "library_on_library"),
    ):
        found = answers.get(name)
        if found is None:
            result[key] = result[f"{key}_95"] = None
            continue
        result[key] = found["a90"]
        result[f"{key}_95"] = found["a90_95_interval"]
        if found["a90"] is None:
            warnings.append(f"no {key}: {'; '.join(found['warnings']) or 'the curve has none'}")
    result |= {
        "size": plan.size,
        "unit": SIZES[plan.size],
        "setting": f"{measured.low};{measured.high}",
        "effects": effects,
        "networks": plan.networks,
        "real_networks": "measured" if "measured" in arms else "generated",
        "curves": answers,
        "compare": _comparisons(directory, real, plan, same=same, library=bool(materials)),
        "materials": materials,
        "products": source.text,
        "folder": directory.name,
        "warnings": list(dict.fromkeys(warnings)),
    }
    return dict(plain(result))


def check_task(brought: TaskInput) -> None:
    """Refuse what cannot be tried before anything long is begun.

    Raises:
        InputError: a file that is not there or is neither acquisition nor dataset, or knows of no foreign object.
    """
    for name, path in (("--task", brought.measured), ("--task-products", brought.products)):
        if path is not None and not path.is_file():
            raise InputError(name, received=f"{path}, which is not there", expected="a file")
    if (brought.low is None) != (brought.high is None):
        raise InputError("--task-low and --task-high", received="one of the two", expected="both or neither")
    try:
        with read_dataset(brought.measured) as dataset:
            found = any(row.foreign_object for row in dataset.rows)
    except FileFormatError:
        with open_acquisition(brought.measured) as acquisition:
            masks = (acquisition.scenes[pair.scene].foreign_object_mask for pair in _usable_pairs(acquisition))
            found = any(mask is not None and bool(mask.any()) for mask in masks)
    if not found:
        raise InputError(
            "--task",
            received=f"{brought.measured}, which holds no product with a foreign object of known mask",
            expected="measured images of products with and without known foreign objects",
        )


def _claim(directory: Path, before: "Twin", after: "Twin", brought: TaskInput, plan: TaskPlan) -> None:
    """Make the folder that of this task, or refuse one of another."""
    from ..generator.twins.twin_io import write_twin

    for name, twin in (("before", before), ("after", after)):
        with whole_file(directory / f"{name}.new.h5") as temporary:
            write_twin(temporary, twin)
    told = {
        "plan": asdict(plan),
        "measured_sha256": sha256_of_file(brought.measured),
        "products_sha256": None if brought.products is None else sha256_of_file(brought.products),
        "low": None if brought.low is None else str(brought.low),
        "high": None if brought.high is None else str(brought.high),
        **{f"{name}_sha256": sha256_of_file(directory / f"{name}.new.h5") for name in ("before", "after")},
    }
    kept = directory / "task.json"
    text = json.dumps(told, sort_keys=True, indent=1) + "\n"
    if kept.exists() and kept.read_text(encoding="utf-8") != text:
        old = json.loads(kept.read_text(encoding="utf-8"))
        other = sorted(key for key in told if told[key] != old.get(key))
        for name in ("before", "after"):
            (directory / f"{name}.new.h5").unlink()
        raise InputError(
            str(directory),
            received="a folder of another task (" + ", ".join(other) + ")",
            expected="the same twin, images and sizes as before, or a new folder",
            remedy="remove the folder, or choose another one with -o",
        )
    for name in ("before", "after"):
        (directory / f"{name}.new.h5").replace(directory / f"{name}.h5")
    with whole_file(kept) as temporary:
        temporary.write_text(text, encoding="utf-8")


# ---------------------------------------------------------------------------------------------------- measured images


def _measured_images(brought: TaskInput, directory: Path, twin: "Twin", plan: TaskPlan) -> _Measured:
    out = directory / "measured.h5"
    try:
        dataset = read_dataset(brought.measured)
    except FileFormatError:
        with open_acquisition(brought.measured) as acquisition:
            return _from_acquisition(acquisition, brought, out, twin, plan)
    with dataset:
        return _from_dataset(dataset, brought, out, plan)


def _from_acquisition(
    acquisition: AcquisitionFile, brought: TaskInput, out: Path, twin: "Twin", plan: TaskPlan
) -> _Measured:
    pairs = _usable_pairs(acquisition)
    if not pairs:
        raise InputError(
            acquisition.path,
            received="no object series at two tube voltages that name a scene with foreign_object_mask",
            expected="measured products whose foreign objects are known",
        )
    low, high = brought.low, brought.high
    if low is None or high is None:
        shortest = min(pairs, key=lambda pair: sum(one.exposure_ms * one.averaged for one in pair.settings))
        low, high = shortest.settings
    products = {pair.scene: acquisition.scenes[pair.scene].product or pair.scene for pair in pairs}
    stated = {scene: str(acquisition.scenes[scene].attributes.get("split", "")) for scene in products}
    split = stated
    if not all(stated.values()):
        split = split_by_product(
            products,
            validation=plan.validation_share,
            test=plan.test_share,
            rng=np.random.default_rng([plan.seed, 1]),
        )
    warnings: list[str] = []
    bad = twin.maps.bad_pixels > 0
    pixel_mm = acquisition.instrument.pixel_mm
    if not out.exists():
        everything = out.with_name("measured_frames.h5")
        summary = dataset_from_acquisition(
            acquisition,
            everything,
            low=low,
            high=high,
            with_counts=False,
            split=split,
            each_frame=True,
            dilations=DILATIONS if pixel_mm is None else dilations_for_pixel(pixel_mm),
            bad_pixels=bad if bad.shape == pairs[0].low.shape else None,
            provenance={"source": brought.measured.name},
        )
        warnings += [f"not used: {line}" for line in summary.skipped]
        with read_dataset(everything) as frames:
            _write_some(frames, range(len(frames)), out, draws=plan.draws)
        everything.unlink()
    return _Measured(path=out, low=low, high=high, warnings=tuple(warnings))


def _from_dataset(dataset: Dataset, brought: TaskInput, out: Path, plan: TaskPlan) -> _Measured:
    chosen = dataset.indices()
    settings = sorted({row.setting for row in dataset.rows})
    if brought.low is not None and brought.high is not None:
        low, high = brought.low, brought.high
        wanted = f"{low};{high}"
        if len(settings) > 1 or settings != [""]:
            chosen = np.array([k for k in chosen if dataset.rows[k].setting == wanted], dtype=np.intp)
    elif len(settings) == 1 and settings[0].count(";") == 1:
        low, high = (setting_from_text(part) for part in settings[0].split(";"))
    else:
        raise InputError(
            dataset.path,
            received=f"{len(settings)} pairs of settings"
            if len(settings) > 1
            else "images that do not say their setting",
            expected="one pair of settings",
            remedy="choose with --task-low and --task-high",
        )
    if not len(chosen):
        raise InputError(
            dataset.path, received="no images at this pair of settings", expected="one of " + " | ".join(settings)
        )
    splits = {dataset.rows[k].split for k in chosen}
    warnings: tuple[str, ...] = ()
    if "test" not in splits:
        raise InputError(
            dataset.path,
            received="no images of split test (" + ", ".join(sorted(splits)) + ")",
            expected="images that are held back to try networks on",
        )
    if not out.exists():
        _write_some(dataset, [int(k) for k in chosen], out, draws=plan.draws)
    return _Measured(path=out, low=low, high=high, warnings=warnings)


def _usable_pairs(acquisition: AcquisitionFile) -> list[ObjectPair]:
    return [
        pair
        for pair in object_pairs(acquisition)
        if pair.scene in acquisition.scenes and acquisition.scenes[pair.scene].foreign_object_mask is not None
    ]


def _write_some(dataset: Dataset, numbers: Sequence[int], out: Path, *, draws: int) -> None:
    """A dataset with at most `draws` images of each scene."""
    seen: dict[str, int] = {}
    chosen = []
    for number in numbers:
        scene = scene_of(dataset.rows[number].image)
        seen[scene] = seen.get(scene, 0) + 1
        if seen[scene] <= draws:
            chosen.append(number)
    write_selected(dataset, out, selection=chosen)


def _with_objects(path: Path, splits: Sequence[str]) -> int:
    with read_dataset(path) as dataset:
        return sum(bool(row.foreign_object) and row.split in splits for row in dataset.rows)


# ---------------------------------------------------------------------------------------------------- the twins' images


class _KnownSource:
    """Products whose path lengths stand in an acquisition: the measured ones themselves, or others."""

    text = "path lengths of the measured products"

    def __init__(self, path: Path, measured: _Measured, twin: "Twin", plan: TaskPlan, *, own: bool) -> None:
        from ..generator.datasets.known_scenes import KnownScene, KnownScenes

        self.plan, self.low, self.high = plan, measured.low, measured.high
        with read_dataset(measured.path) as dataset:
            split = {scene_of(row.image): row.split for row in dataset.rows}
        scenes: list[KnownScene] = []
        with open_acquisition(path) as acquisition:
            used = {pair.scene for pair in object_pairs(acquisition)}
            for name, scene in acquisition.scenes.items():
                mask = scene.foreign_object_mask
                if not scene.thickness_mm or mask is None or (own and name not in split) or name not in used:
                    continue
                inside = scene.product_mask
                thickness = dict(scene.thickness_mm)
                scenes.append(
                    KnownScene(
                        row=DatasetRow(
                            image=name,
                            product=scene.product or name,
                            foreign_object=(scene.foreign_object or "unnamed") if mask.any() else "",
                            size_mm=scene.size_mm if mask.any() else math.nan,
                            split=split[name] if own else "train",
                        ),
                        thickness_mm=thickness,
                        foreign_object_mask=mask,
                        product_mask=np.sum(list(thickness.values()), axis=0) > 0 if inside is None else inside,
                    )
                )
        if not scenes:
            raise InputError(
                str(path),
                received="no products whose path lengths (thickness_mm) and foreign_object_mask are known",
                expected="something to generate images from",
                remedy="give a description or reference images with --task-products",
            )
        if not own:
            self.text = f"path lengths of the products in {path.name}"
            names = {scene.row.image: scene.row.product for scene in scenes}
            dealt = split_by_product(
                names, validation=plan.validation_share, test=plan.test_share, rng=np.random.default_rng([plan.seed, 2])
            )
            scenes = [replace(one, row=replace(one.row, split=dealt[one.row.image])) for one in scenes]
        self.material = _largest_material(scenes)
        line = KnownScenes(twin, low=self.low, high=self.high, product_material=self.material)
        self.scenes = [
            replace(
                one,
                row=replace(one.row, contrast=line.contrast(line.expected(one.thickness_mm), one.foreign_object_mask)),
            )
            for one in scenes
        ]
        self.library = self.scenes
        self.own = own

    def own_materials(self, twin: "Twin", measured: _Measured) -> tuple[list[dict[str, Any]], list[str]]:
        """What the measured objects are made of, by those that networks learn from; scenes are made of that from now on."""
        from ..generator.datasets.known_scenes import KnownScenes
        from .object_material import object_materials

        if not self.own:
            return [], []
        images: dict[str, list[NDArray[np.floating]]] = {}
        with read_dataset(measured.path) as dataset:
            for number, row in enumerate(dataset.rows):
                if row.split in ("train", "val") and row.foreign_object:
                    images.setdefault(scene_of(row.image), []).append(dataset.images(number))

        def line_of(other: "Twin") -> KnownScenes:
            return KnownScenes(other, low=self.low, high=self.high, product_material=self.material)

        line = line_of(twin)
        draws = _drawn_twins(twin, np.random.default_rng([self.plan.seed, 3]))
        found, told = object_materials(
            line,
            self.library,
            {name: np.mean(frames, axis=0) for name, frames in images.items()},
            draws=[line_of(other) for other in draws],
            steps=[line_of(other) for other in _stepped_twins(twin)],
            product=self.material,
            dilations=dilations_for_pixel(line.geometry.pixel_mm),
        )
        for material in found:
            self.scenes = [material.scene(scene) for scene in self.scenes]
        return [material.as_dict() for material in found], [
            f"the objects' own material is not known: {one}" for one in told
        ]

    def write_library(self, twin: "Twin", train: Path, test: Path) -> None:
        """Images of the same scenes with objects of the library's material."""
        for path, splits in ((train, ("train", "val")), (test, ("test",))):
            self._write(twin, path, splits, self.low, self.high, self.plan.draws, scenes=self.library)

    def sizes(self) -> Mapping[str, float]:
        """Contrast of each scene in the images of the twin as it was, without noise: one number for all kinds of images."""
        return {one.row.image: one.row.contrast for one in self.scenes} if self.own else {}

    def write(self, twin: "Twin", train: Path, test: Path, directory: Path) -> tuple[str, ...]:
        told: tuple[str, ...] = ()
        for path, splits in ((train, ("train", "val")), (test, ("test",))):
            told += self._write(twin, path, splits, self.low, self.high, self.plan.draws)
        return tuple(dict.fromkeys(told))

    def write_start(self, twin: "Twin", path: Path, directory: Path) -> Path:
        low, high = (replace(one, averaged=one.averaged * _START_AVERAGED) for one in (self.low, self.high))
        self._write(twin, path, ("train", "val"), low, high, 1)
        return path

    def _write(
        self,
        twin: "Twin",
        path: Path,
        splits: Sequence[str],
        low: Setting,
        high: Setting,
        draws: int,
        *,
        scenes: "Sequence[KnownScene] | None" = None,
    ) -> tuple[str, ...]:
        from ..generator.datasets.known_scenes import KnownScenes, generate_known_scenes

        if path.exists():
            return tuple(KnownScenes(twin, low=low, high=high, product_material=self.material).warnings)
        chosen = [one for one in (self.scenes if scenes is None else scenes) if one.row.split in splits]
        if not chosen:
            raise InputError(
                "products",
                received=f"none of split {' or '.join(splits)}",
                expected="some to learn from and some to try",
            )
        return generate_known_scenes(
            twin,
            chosen,
            path,
            low=low,
            high=high,
            draws=draws,
            seed=self.plan.seed,
            product_material=self.material,
        )


class _DescribedSource:
    """Products drawn from a description."""

    def __init__(self, path: Path, measured: _Measured, plan: TaskPlan) -> None:
        from ..generator.scenes.describe import read_description

        self.description = read_description(path)
        self.plan, self.low, self.high = plan, measured.low, measured.high
        self.text = f"the description {path.name}"

    def own_materials(self, twin: "Twin", measured: _Measured) -> tuple[list[dict[str, Any]], list[str]]:
        return [], []

    def write_library(self, twin: "Twin", train: Path, test: Path) -> None:
        """Nothing: the objects' own material is not known."""

    def sizes(self) -> Mapping[str, float]:
        return {}

    def write(self, twin: "Twin", train: Path, test: Path, directory: Path) -> tuple[str, ...]:
        told: tuple[str, ...] = ()
        for path, part, place in ((train, "train", 0), (test, "test", 1)):
            told += self._write(twin, path, part, self.low, self.high, self.plan.images, place)
        return tuple(dict.fromkeys(told))

    def write_start(self, twin: "Twin", path: Path, directory: Path) -> Path:
        low, high = (replace(one, averaged=one.averaged * _START_AVERAGED) for one in (self.low, self.high))
        self._write(twin, path, "train", low, high, max(self.plan.images // 2, 10), 2)
        return path

    def _write(
        self, twin: "Twin", path: Path, part: str, low: Setting, high: Setting, images: int, place: int
    ) -> tuple[str, ...]:
        from ..generator.datasets.generate_described import generate_from_description

        if path.exists():
            return ()
        whole = path.with_name(f"{path.stem}_drawn.h5")
        summary = generate_from_description(
            twin,
            self.description,
            whole,
            low=low,
            high=high,
            images=images,
            seed=3 * self.plan.seed + place,
            with_counts=False,
        )
        write_split(whole, path, part)
        return summary.warnings


class _ReferenceSource:
    """Low-noise images of products, which lack only noise and what came after calibration."""

    def __init__(self, path: Path, measured: _Measured, plan: TaskPlan) -> None:
        self.path, self.plan, self.low, self.high = path, plan, measured.low, measured.high
        self.text = f"the reference images {path.name}"

    def own_materials(self, twin: "Twin", measured: _Measured) -> tuple[list[dict[str, Any]], list[str]]:
        return [], []

    def write_library(self, twin: "Twin", train: Path, test: Path) -> None:
        """Nothing: the objects' own material is not known."""

    def sizes(self) -> Mapping[str, float]:
        return {}

    def write(self, twin: "Twin", train: Path, test: Path, directory: Path) -> tuple[str, ...]:
        told: tuple[str, ...] = ()
        for path, part, place in ((train, "train", 0), (test, "test", 1)):
            told += self._write(twin, path, part, place)
        return tuple(dict.fromkeys(told))

    def write_start(self, twin: "Twin", path: Path, directory: Path) -> Path:
        self._write(twin, path, "train", 2)
        return path

    def _write(self, twin: "Twin", path: Path, part: str, place: int) -> tuple[str, ...]:
        from ..generator.datasets.generate import generate_dataset

        if path.exists():
            return ()
        chosen = path.with_name(f"{path.stem}_references.h5")
        whole = path.with_name(f"{path.stem}_drawn.h5")
        with read_dataset(self.path) as dataset:
            splits = {row.split for row in dataset.rows}
            wanted = ("test",) if part == "test" else ("train", "val")
            numbers = [k for k, row in enumerate(dataset.rows) if row.split in wanted]
            if not numbers:
                raise InputError(
                    str(self.path),
                    received="no images of split " + " or ".join(wanted) + " (" + ", ".join(sorted(splits)) + ")",
                    expected="products to learn from and others to try",
                    remedy="deal them out with `raytwin import reference --validation --test`",
                )
            write_selected(dataset, chosen, selection=numbers)
        with read_dataset(chosen) as reference:
            summary = generate_dataset(
                twin,
                reference,
                whole,
                low=self.low,
                high=self.high,
                images=self.plan.images,
                seed=3 * self.plan.seed + place,
                with_counts=False,
            )
        chosen.unlink()
        write_split(whole, path, part)
        return summary.warnings


def _drawn_twins(twin: "Twin", rng: np.random.Generator) -> list["Twin"]:
    """The twin with other spectra that its calibration allows."""
    spectral = twin.spectral
    if spectral is None:
        return []
    chosen = rng.choice(len(spectral.samples), min(_DRAWN, len(spectral.samples)), replace=False)
    return [replace(twin, spectral=replace(spectral, best=spectral.samples[number])) for number in chosen]


def _stepped_twins(twin: "Twin") -> list["Twin"]:
    """The twin with each of its effects one standard deviation stronger."""
    stepped = []
    for number, item in enumerate(twin.effects):
        strength = effect_of(item).values(item.parameters)["strength"] * (1.0 + item.sd)
        stronger = replace(item, parameters={**item.parameters, "strength": strength})
        stepped.append(replace(twin, effects=(*twin.effects[:number], stronger, *twin.effects[number + 1 :])))
    return stepped


_Source = _KnownSource | _DescribedSource | _ReferenceSource


def _source(brought: TaskInput, measured: _Measured, twin: "Twin", plan: TaskPlan) -> _Source:
    path = brought.products
    if path is not None and path.suffix.lower() == ".toml":
        return _DescribedSource(path, measured, plan)
    own = path is None
    place = brought.measured if path is None else path
    try:
        read_dataset(place).close()
    except FileFormatError:
        return _KnownSource(place, measured, twin, plan, own=own)
    if own:
        raise InputError(
            str(place),
            received="a dataset, which does not know its products' path lengths",
            expected="something to generate images from",
            remedy="give a description, an acquisition with thickness maps or reference images with --task-products",
        )
    return _ReferenceSource(place, measured, plan)


def _largest_material(scenes: "Sequence[KnownScene]") -> str:
    total: dict[str, float] = {}
    for scene in scenes:
        for material, values in scene.thickness_mm.items():
            total[material] = total.get(material, 0.0) + float(np.sum(values))
    return max(total, key=lambda name: total[name])


def _same_images(first: Path, second: Path) -> bool:
    with read_dataset(first) as one, read_dataset(second) as other:
        return len(one) == len(other) and all(
            np.array_equal(one.images(number), other.images(number)) for number in range(len(one))
        )


def _joined(parts: Sequence[Path], out: Path) -> None:
    if out.exists():
        return
    with ExitStack() as stack:
        concatenate_datasets([stack.enter_context(read_dataset(part)) for part in parts], out)


# ---------------------------------------------------------------------------------------------------- networks and hits


def _train(
    directory: Path, arms: Sequence[str], measured: Path, plan: TaskPlan, *, device: str, tell: Tell
) -> dict[str, Path]:
    """Folders of networks: one common start, then `networks` of each kind."""
    from ..segmentation import starter_recipe

    with read_dataset(measured) as images:
        crop = plan.crop_px if 0 < plan.crop_px < min(images.shape) else None
    recipe = replace(starter_recipe(), batch=plan.batch, crop_px=crop)
    # networks this small wait longer for a second thread than it saves
    workers = _WORKERS if device == "cpu" else None
    start = directory / "networks_start"
    train_on_file(
        directory / "start.h5",
        start,
        recipe=replace(recipe, steps=plan.start_steps),
        networks=1,
        seed=plan.seed,
        start_from="starter",
        device=device,
        workers=workers,
        tell=tell,
        name="common start",
    )
    folders = {}
    for arm in arms:
        dataset = measured if arm == "measured" else directory / f"{arm}_train.h5"
        folders[arm] = directory / f"networks_{arm}"
        train_on_file(
            dataset,
            folders[arm],
            recipe=replace(recipe, steps=plan.steps),
            networks=plan.networks,
            seed=plan.seed,
            start_from=start,
            device=device,
            workers=workers,
            tell=tell,
            name=f"networks of {arm}",
        )
    return folders


def _comparisons(directory: Path, real: str, plan: TaskPlan, *, same: bool, library: bool) -> dict[str, Any]:
    """a90 of pairs of tables against each other, images shared where they are of the same objects."""
    from ..pod import check_trials, compare_pod, read_pod_table

    wanted = {"before_against_real": ("before_on_before", real)}
    if not same:
        wanted |= {
            "after_against_real": ("after_on_after", real),
            "after_against_before": ("after_on_after", "before_on_before"),
        }
    elif real == "after_on_measured":
        wanted = {"before_against_real": ("before_on_before", "before_on_measured")}
    if library:
        wanted["after_against_library"] = ("before_on_before" if same else "after_on_after", "library_on_library")
    result: dict[str, Any] = {}
    for name, (second, first) in wanted.items():
        tables = [read_pod_table(directory / f"hits_{one}.csv", size=plan.size) for one in (first, second)]
        images = sorted({image for table in tables for image in table.image or ()})
        shared = set(tables[0].image or ()) == set(tables[1].image or ())
        code = {image: number for number, image in enumerate(images)}
        if any(table.hits is None or not len(table.size) for table in tables):
            continue
        trials = [
            check_trials(
                table.size,
                [] if table.hits is None else table.hits,
                network=table.network,
                image=[f"{code[image]:06d}" for image in table.image or ()],
            )
            for table in tables
        ]
        try:
            found = compare_pod(trials[0], trials[1], repeats="crossed", shared_images=shared)
        except (FitError, InputError) as error:
            result[name] = {"difference_a90": None, "warnings": [str(error)]}
            continue
        result[name] = {
            "difference_a90": asdict(found.difference_a90),
            "verdict": found.verdict,
            "paired": found.paired,
        }
    return result

"""The images of a task: the measured ones, and those that twins make of the products that it brings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, open_acquisition
from ..acquisition.contrast import DILATIONS, dilations_for_pixel
from ..acquisition.dataset_io import Dataset, DatasetRow, read_dataset, write_selected
from ..acquisition.pairs import ObjectPair, dataset_from_acquisition, object_pairs, split_by_product
from ..acquisition.setting import Setting, setting_from_text
from ..errors import FileFormatError, InputError
from ..generator.effects import effect_of
from .task_plan import TaskInput, TaskPlan
from .trial import scene_of, write_split

if TYPE_CHECKING:
    from ..generator.datasets.known_scenes import KnownScene
    from ..generator.line.twin import Twin

_DRAWN = 16  # spectra: a standard deviation of so many is known to a sixth
_START_AVERAGED = 16  # the common start learns from images of as many frames: noisy ones teach a new network nothing
# sets of images, each with random numbers of its own -> part of the products -> their splits
_TRAIN, _TEST, _START = range(3)
_PARTS = {_TRAIN: "train", _TEST: "test", _START: "train"}
_SPLITS = {"train": ("train", "val"), "test": ("test",)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Measured images at one pair of settings, with splits, as a dataset file."""

    path: Path
    low: Setting
    high: Setting
    warnings: tuple[str, ...]


def measured_images(brought: TaskInput, directory: Path, twin: "Twin", plan: TaskPlan) -> Measured:
    """The measured images at one pair of settings, written to `directory` if they are not there.

    Raises:
        InputError: no images of known foreign objects at one pair of settings, or none to try networks on.
    """
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
) -> Measured:
    pairs = usable_pairs(acquisition)
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
    return Measured(path=out, low=low, high=high, warnings=tuple(warnings))


def _from_dataset(dataset: Dataset, brought: TaskInput, out: Path, plan: TaskPlan) -> Measured:
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
    if "test" not in splits:
        raise InputError(
            dataset.path,
            received="no images of split test (" + ", ".join(sorted(splits)) + ")",
            expected="images that are held back to try networks on",
        )
    if not out.exists():
        _write_some(dataset, [int(k) for k in chosen], out, draws=plan.draws)
    return Measured(path=out, low=low, high=high, warnings=())


def usable_pairs(acquisition: AcquisitionFile) -> list[ObjectPair]:
    """Pairs of images of objects whose foreign objects are known, each with or without one."""
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


# ---------------------------------------------------------------------------------------------------- the twins' images


class Source:
    """Products that twins make images of.

    Args:
        measured: the images that those of the twins shall be like.
        plan: sizes.

    text: what the products are, in words.
    """

    text: str

    def __init__(self, measured: Measured, plan: TaskPlan) -> None:
        self.plan, self.low, self.high = plan, measured.low, measured.high

    def own_materials(self, twin: "Twin", measured: Measured) -> tuple[list[dict[str, Any]], list[str]]:
        """What the measured objects are made of, and why it is not known of some; nothing where it cannot be told."""
        return [], []

    def write_library(self, twin: "Twin", train: Path, test: Path) -> None:
        """Images with objects of the library's material, where the objects' own is known."""

    def sizes(self) -> Mapping[str, float]:
        """Image -> size that counts for it in the images of any twin; empty: that of the image itself."""
        return {}

    def write(self, twin: "Twin", train: Path, test: Path) -> tuple[str, ...]:
        """Images of a twin to train networks on and to try them on; warnings."""
        told = (*self._write(twin, train, _TRAIN), *self._write(twin, test, _TEST))
        return tuple(dict.fromkeys(told))

    def write_start(self, twin: "Twin", path: Path) -> Path:
        """Images of a twin for the common start of all networks, fewer than to train on."""
        self._write(twin, path, _START)
        return path

    def _write(self, twin: "Twin", path: Path, images: int) -> tuple[str, ...]:
        """Write one set of images (`_TRAIN`, `_TEST` or `_START`) if it is not there; warnings."""
        raise NotImplementedError

    def _settings(self, images: int) -> tuple[Setting, Setting]:
        """The pair of settings of a set of images whose noise is chosen freely."""
        more = _START_AVERAGED if images == _START else 1
        low, high = (replace(one, averaged=more * one.averaged) for one in (self.low, self.high))
        return low, high


class _KnownSource(Source):
    """Products whose path lengths stand in an acquisition: the measured ones themselves, or others."""

    text = "path lengths of the measured products"

    def __init__(self, path: Path, measured: Measured, twin: "Twin", plan: TaskPlan, *, own: bool) -> None:
        from ..generator.datasets.known_scenes import KnownScenes

        super().__init__(measured, plan)
        with read_dataset(measured.path) as dataset:
            split = {scene_of(row.image): row.split for row in dataset.rows}
        scenes = _known_scenes(path, split if own else None)
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

    def own_materials(self, twin: "Twin", measured: Measured) -> tuple[list[dict[str, Any]], list[str]]:
        """By the objects that networks learn from; scenes are made of what is found from now on."""
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
        self._write(twin, train, _TRAIN, scenes=self.library)
        self._write(twin, test, _TEST, scenes=self.library)

    def sizes(self) -> Mapping[str, float]:
        """Contrast of each scene in the images of the twin as it was, without noise: one number for all kinds of images."""
        return {one.row.image: one.row.contrast for one in self.scenes} if self.own else {}

    def _write(
        self, twin: "Twin", path: Path, images: int, *, scenes: "Sequence[KnownScene] | None" = None
    ) -> tuple[str, ...]:
        from ..generator.datasets.known_scenes import KnownScenes, generate_known_scenes

        low, high = self._settings(images)
        if path.exists():
            return tuple(KnownScenes(twin, low=low, high=high, product_material=self.material).warnings)
        splits = _SPLITS[_PARTS[images]]
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
            draws=1 if images == _START else self.plan.draws,
            seed=self.plan.seed,
            product_material=self.material,
        )


class _DescribedSource(Source):
    """Products drawn from a description."""

    def __init__(self, path: Path, measured: Measured, plan: TaskPlan) -> None:
        from ..generator.scenes.describe import read_description

        super().__init__(measured, plan)
        self.description = read_description(path)
        self.text = f"the description {path.name}"

    def _write(self, twin: "Twin", path: Path, images: int) -> tuple[str, ...]:
        from ..generator.datasets.generate_described import generate_from_description

        if path.exists():
            return ()
        low, high = self._settings(images)
        whole = path.with_name(f"{path.stem}_drawn.h5")
        summary = generate_from_description(
            twin,
            self.description,
            whole,
            low=low,
            high=high,
            images=max(self.plan.images // 2, 10) if images == _START else self.plan.images,
            seed=3 * self.plan.seed + images,
            with_counts=False,
        )
        write_split(whole, path, _PARTS[images])
        return summary.warnings


class _ReferenceSource(Source):
    """Low-noise images of products, which lack only noise and what came after calibration."""

    def __init__(self, path: Path, measured: Measured, plan: TaskPlan) -> None:
        super().__init__(measured, plan)
        self.path = path
        self.text = f"the reference images {path.name}"

    def _write(self, twin: "Twin", path: Path, images: int) -> tuple[str, ...]:
        from ..generator.datasets.generate import generate_dataset

        if path.exists():
            return ()
        chosen = path.with_name(f"{path.stem}_references.h5")
        whole = path.with_name(f"{path.stem}_drawn.h5")
        with read_dataset(self.path) as dataset:
            splits = {row.split for row in dataset.rows}
            wanted = _SPLITS[_PARTS[images]]
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
                seed=3 * self.plan.seed + images,
                with_counts=False,
            )
        chosen.unlink()
        write_split(whole, path, _PARTS[images])
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


def source_of(brought: TaskInput, measured: Measured, twin: "Twin", plan: TaskPlan) -> Source:
    """What the twins' images are made of: what was brought for them, else the measured products themselves."""
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


def _known_scenes(path: Path, split: Mapping[str, str] | None) -> list["KnownScene"]:
    """Products of an acquisition with known path lengths and objects; split: of the scenes to take, None takes all."""
    from ..generator.datasets.known_scenes import KnownScene

    scenes: list[KnownScene] = []
    with open_acquisition(path) as acquisition:
        used = {pair.scene for pair in object_pairs(acquisition)}
        for name, scene in acquisition.scenes.items():
            mask = scene.foreign_object_mask
            if not scene.thickness_mm or mask is None or name not in used or (split is not None and name not in split):
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
                        split="train" if split is None else split[name],
                    ),
                    thickness_mm=thickness,
                    foreign_object_mask=mask,
                    product_mask=np.sum(list(thickness.values()), axis=0) > 0 if inside is None else inside,
                )
            )
    return scenes


def _largest_material(scenes: "Sequence[KnownScene]") -> str:
    total: dict[str, float] = {}
    for scene in scenes:
        for material, values in scene.thickness_mm.items():
            total[material] = total.get(material, 0.0) + float(np.sum(values))
    return max(total, key=lambda name: total[name])

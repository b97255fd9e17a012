"""One setting of a sweep: images generated, networks trained and tried, POD; and the network that all settings start from.

A task is plain words and numbers with absolute paths, so that it can go to another process or machine. It works in a folder of
its own that holds what is finished; a task that was killed goes on where it stopped, and one that is done does nothing.

    learn.h5, test.h5    references, dealt out (shared by all)                                   `prepare_references`
    start/               the network that all start from                                         task of kind `start`
    <setting>/trial.json, hits.csv, pod.json, example.h5, networks/, thresholds.json, seconds.json   task of kind `setting`
"""

import hashlib
import json
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acquisition.dataset_io import (
    Dataset,
    DatasetRow,
    concatenate_datasets,
    read_dataset,
    write_dataset,
    write_selected,
)
from ..acquisition.pairs import split_by_product
from ..acquisition.setting import setting_from_text
from ..errors import FileFormatError, InputError, RaytwinError
from ..files import sha256_of_file, whole_file
from ..segmentation.recipe import STARTER
from ._leash import line_from_parent
from ._plain import canonical, digest, plain, read_object
from .sweep_file import SIZES, Campaign, CurveOptions, Pair, Training, Trying, text_of_pair
from .sweep_settings import open_references, start_pair
from .trial import LOWEST_THRESHOLD, curve_of_table, detect_on_file, thresholds_from_images, train_on_file, write_split

if TYPE_CHECKING:
    from ..generator.datasets.generate import GenerationSummary
    from ..generator.line.twin import Twin
    from ..segmentation import Recipe

Task = dict[str, Any]
Tell = Callable[[str], None]

EXAMPLE = "example.h5"  # a part of one test pair, for the report
_EXAMPLE_PX = 128
_SEED_BITS = 48
_FEWEST_START_IMAGES = 16
_ONE_AT_A_TIME = threading.Lock()  # torch's random state and number of threads belong to the process
_HELD_BACK = 1  # place of the random stream that deals references out


def seed_of(seed: int, *words: str) -> int:
    """A seed for one purpose: of the campaign's seed and words alone, so that no order or number of workers decides it."""
    text = "|".join([str(seed), *words]).encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:8], "big") >> (64 - _SEED_BITS)


# ------------------------------------------------------------------------------------------------ what decides a result


def basis_of(campaign: Campaign, *, version: str) -> dict[str, Any]:
    """What decides all results of a campaign alike: files by their hash, how they are dealt out, seed, version."""
    return {
        "raytwin_version": version,
        "twin_sha256": sha256_of_file(campaign.twin),
        "references_sha256": _content(campaign.references),
        "test_references_sha256": None if campaign.test_references is None else _content(campaign.test_references),
        "reference_setting": None if campaign.reference_setting is None else text_of_pair(campaign.reference_setting),
        "shares": [campaign.test_share, campaign.validation_share],
        "materials": [campaign.product_material, campaign.foreign_material],
        "seed": campaign.seed,
    }


def _content(path: Path) -> str:
    """Hash of a reference file; of a description with the maps and meshes that it names."""
    if path.suffix.lower() != ".toml":
        return sha256_of_file(path)
    from ..generator.scenes.describe import read_description

    described = read_description(path)
    files = sorted({file for kind in (*described.products, *described.foreign_objects) for file in kind.files})
    return digest([described.sha256, *(sha256_of_file(file) for file in files)])


def start_key(basis: Mapping[str, Any], training: Training) -> str:
    """Hash of what decides the network that all start from."""
    names = ("recipe", "batch", "crop_px", "start_steps", "mixed_steps", "start_shares", "images", "start")
    return digest({"basis": basis, "start": {name: asdict(training)[name] for name in names}})


def setting_key(basis: Mapping[str, Any], training: Training, trying: Trying, pair: Pair) -> str:
    """Hash of what decides the hits and misses of a setting."""
    return digest(
        {
            "basis": basis,
            "training": asdict(training),
            "trying": asdict(trying),
            "setting": text_of_pair(pair),
        }
    )


_BOUNDS = "student"  # how bounds are made: another word where that changes, so that kept curves are fitted anew


def curve_key(key: str, curve: CurveOptions) -> str:
    """Hash of what decides the POD of a setting."""
    return digest({"hits": key, "curve": asdict(curve), "sizes": SIZES, "bounds": _BOUNDS})


# ------------------------------------------------------------------------------------------------ tasks


def start_task(campaign: Campaign, folder: Path, key: str, common: Mapping[str, Any]) -> Task:
    """The task that trains the network all settings start from, in `folder`."""
    return {
        **common,
        "kind": "start",
        "folder": str(folder),
        "key": key,
        "seed": seed_of(campaign.seed, "start"),
    }


def setting_task(
    campaign: Campaign, pair: Pair, folder: Path, *, key: str, start: Path | None, common: Mapping[str, Any]
) -> Task:
    """The task of one setting, in `folder`; `start` is the folder of the network to start from."""
    text = text_of_pair(pair)
    return {
        **common,
        "kind": "setting",
        "folder": str(folder),
        "key": key,
        "curve_key": curve_key(key, campaign.curve),
        "low": str(pair[0]),
        "high": str(pair[1]),
        "start": None if start is None else str(start),
        "seeds": {
            "train": seed_of(campaign.seed, "train", text),
            "networks": seed_of(campaign.seed, "networks", text),
            # scenes of a description must be the same at all settings; references are
            "test": seed_of(campaign.seed, "test", *([] if campaign.described else [text])),
        },
    }


def common_words(campaign: Campaign, data: Path, *, device: str, threads: int, keep_images: bool) -> dict[str, Any]:
    """What all tasks of a campaign have in common; `data` is the folder of `prepare_references`."""
    described = campaign.described
    return {
        "twin": str(campaign.twin.resolve()),
        "learn": str(campaign.references.resolve() if described else data / "learn.h5"),
        "test": str((campaign.test_references or campaign.references).resolve() if described else data / "test.h5"),
        "reference_setting": None if campaign.reference_setting is None else list(map(str, campaign.reference_setting)),
        "materials": [campaign.product_material, campaign.foreign_material],
        "training": plain(asdict(campaign.training)),
        "trying": plain(asdict(campaign.trying)),
        "curve": plain(asdict(campaign.curve)),
        "device": device,
        "threads": threads,
        "keep_images": keep_images,
    }


def prepare_references(campaign: Campaign, folder: Path, basis: Mapping[str, Any]) -> None:
    """Write learn.h5 (train and val) and test.h5 of a campaign with reference images, once.

    Test images are those of `test_references` (their split test, or all), else the references' split test, else products that
    are held back; validation products are held back where the file has none.

    Raises:
        InputError: as `check_references`; images of another detector.
    """
    key = digest(basis)
    note = folder / "dealt.json"
    if read_object(note).get("key") == key and (folder / "learn.h5").exists() and (folder / "test.h5").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        dealt = _deal(campaign, stack)
        note.unlink(missing_ok=True)  # what is written from here on is another campaign's until all of it is there
        _write_dealt(dealt.references, folder / "learn.h5", dealt.learn, dealt.splits)
        write_selected(dealt.tests, folder / "test.h5", selection=dealt.tried, split="test")
    with whole_file(note) as temporary:
        temporary.write_bytes(canonical({"key": key}))


def check_references(campaign: Campaign) -> None:
    """Refuse references that leave nothing to learn from or to try on; nothing is written.

    Raises:
        InputError: files of another kind, no products left to learn from or to try on, no foreign objects among them, or fewer to
            try on than an observer needs that screens.
    """
    if campaign.described:
        return
    with ExitStack() as stack:
        dealt = _deal(campaign, stack)
        if campaign.screening is not None:
            _check_objects(dealt.tests.path, [dealt.tests.rows[number] for number in dealt.tried])


def _check_objects(path: str, rows: Sequence[DatasetRow]) -> None:
    """Refuse rows that hold fewer foreign objects than an observer reads."""
    from ..observers.objects import FEWEST_OBJECTS, is_readable

    found = sum(is_readable(row) for row in rows)
    if found < FEWEST_OBJECTS:
        raise InputError(
            path,
            received=f"{found} foreign objects of known contrast above 0 to try networks on",
            expected=f"{FEWEST_OBJECTS} or more, for the observer of [screening]",
            remedy="more products, or another test_share",
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Dealt:
    """References and the split of each; numbers to learn from, and of the images in tests to try networks on."""

    references: Dataset
    splits: list[str]
    learn: list[int]
    tests: Dataset
    tried: list[int]


def _deal(campaign: Campaign, stack: ExitStack) -> _Dealt:
    """Open the reference images of a campaign and deal them out."""
    references = stack.enter_context(open_references(campaign.references, "references"))
    tests = None
    if campaign.test_references is not None:
        tests = stack.enter_context(open_references(campaign.test_references, "test_references"))
    splits = _dealt(campaign, references, held_back=tests is None)
    learn = [number for number, split in enumerate(splits) if split in ("train", "val")]
    source, tried = references, [number for number, split in enumerate(splits) if split == "test"]
    if tests is not None:
        source, tried = tests, [int(n) for n in tests.indices(split="test")] or list(range(len(tests)))
    for name, dataset, numbers in (("to learn from", references, learn), ("to try networks on", source, tried)):
        found = sum(bool(dataset.rows[number].foreign_object) for number in numbers)
        if not found:
            raise InputError(
                dataset.path,
                received=f"{len(numbers)} images {name}, none with a foreign object",
                expected="images with and without foreign objects",
                remedy="more products, or other shares (test_share, validation_share)",
            )
    return _Dealt(references=references, splits=splits, learn=learn, tests=source, tried=tried)


def _dealt(campaign: Campaign, references: Dataset, *, held_back: bool) -> list[str]:
    """Split of each reference: the file's own where it has what is needed, else by product."""
    splits = [row.split for row in references.rows]
    if "train" not in splits:
        # a file that was not dealt out calls all its images test
        splits = ["train"] * len(splits)
    missing_test, missing_validation = held_back and "test" not in splits, "val" not in splits
    if not missing_test and not missing_validation:
        return splits
    free = [number for number, split in enumerate(splits) if split == "train" or (missing_test and split != "val")]
    products = {str(number): references.rows[number].product or str(number) for number in free}
    dealt = split_by_product(
        products,
        validation=campaign.validation_share if missing_validation else 0.0,
        test=campaign.test_share if missing_test else 0.0,
        rng=np.random.default_rng([campaign.seed, _HELD_BACK]),
    )
    return [dealt.get(str(number), split) for number, split in enumerate(splits)]


def _write_dealt(dataset: Dataset, path: Path, numbers: Sequence[int], splits: Sequence[str]) -> None:
    with write_dataset(path, shape=dataset.shape, provenance=dict(dataset.attributes)) as writer:
        for number in numbers:
            writer.append(
                image=dataset.images(number),
                foreign_object_mask=dataset.foreign_object_masks(number),
                product_mask=dataset.product_masks(number),
                row=replace(dataset.rows[number], split=splits[number]),
            )


# ------------------------------------------------------------------------------------------------ doing a task


def is_done(task: Task) -> bool:
    """Whether nothing of a task is left to do."""
    folder = Path(task["folder"])
    if task["kind"] == "start":
        return bool(read_object(folder / "start.json").get("key") == task["key"])
    trial = _tried(task)
    if not trial:
        return False
    return bool(trial["refused"]) or bool(read_object(folder / "pod.json").get("key") == task["curve_key"])


def _tried(task: Task) -> dict[str, Any]:
    """What a setting's trial left, if it is this one's and its hit table is the one it wrote; else nothing."""
    folder = Path(task["folder"])
    trial = read_object(folder / "trial.json")
    if trial.get("key") != task["key"]:
        return {}
    hits = folder / "hits.csv"
    if not trial["refused"] and not (hits.is_file() and sha256_of_file(hits) == trial["hits_sha256"]):
        hits.unlink(missing_ok=True)
        return {}
    return trial


def run_task(task: Task, *, tell: Tell = lambda line: None) -> None:
    """Do what is left of a task, with as many threads as it says.

    A process does one task at a time; another one waits.

    Raises:
        RaytwinError: the task cannot be done.
    """
    from ..segmentation import choose_device
    from ..segmentation._torch import load_torch

    if is_done(task):
        return
    with _ONE_AT_A_TIME:
        Path(task["folder"]).mkdir(parents=True, exist_ok=True)
        began = time.monotonic()
        # sums are rounded alike wherever the task runs
        load_torch().set_num_threads(task["threads"])
        task = {**task, "device": choose_device(task["device"])}
        (_run_start if task["kind"] == "start" else _run_setting)(task, tell)
    seconds = Path(task["folder"]) / "seconds.json"
    spent = read_object(seconds).get("seconds", 0.0) + time.monotonic() - began
    with whole_file(seconds) as temporary:
        temporary.write_text(json.dumps({"seconds": round(spent, 1)}) + "\n", encoding="utf-8")


def _run_start(task: Task, tell: Tell) -> None:
    """A network that learnt from the least noisy images, then from noisier ones (those teach a new network nothing)."""
    from ..generator.twins.twin_io import read_twin

    folder = Path(task["folder"])
    training = task["training"]
    twin = read_twin(task["twin"])
    clear = Path(task["learn"])
    described = clear.suffix.lower() == ".toml"
    own: Pair
    if described:
        own = _pair(training["start"])
        clear = folder / "clear.h5"
        _generate(task, twin, own, clear, images=training["images"], seed=task["seed"], part="train")
    else:
        own = _references_own(task)
    recipe = _recipe(training, clear)

    def train(path: Path, chosen: "Recipe", steps: int, *, name: str, said: str, start: str | Path | None) -> Path:
        train_on_file(
            path,
            folder / name,
            recipe=replace(chosen, steps=steps, epochs=None),
            networks=1,
            seed=task["seed"],
            start_from=start,
            device=task["device"],
            tell=tell,
            name=said,
        )
        return folder / name

    shipped = STARTER if training["recipe"] == STARTER else None
    learnt = train(clear, recipe, training["start_steps"], name="first", said="start", start=shipped)
    if training["mixed_steps"] and training["start_shares"]:
        parts = []
        images = max(training["images"] // len(training["start_shares"]), _FEWEST_START_IMAGES)
        for number, share in enumerate(training["start_shares"]):
            parts.append(folder / f"noisy_{number}.h5")
            seed = task["seed"] + 1 + number
            _generate(task, twin, start_pair(own, share), parts[-1], images=images, seed=seed, part="train")
        mixed = folder / "mixed.h5"
        if not mixed.exists():
            with ExitStack() as stack:
                concatenate_datasets([stack.enter_context(read_dataset(part)) for part in parts], mixed)
        later = _later(training, recipe)
        steps = training["mixed_steps"]
        learnt = train(mixed, later, steps, name="mixed", said="start, noisier images", start=learnt)
        _remove(*parts, mixed)
    if described:
        _remove(clear)
    with whole_file(folder / "start.json") as temporary:
        temporary.write_bytes(canonical({"key": task["key"], "networks": learnt.name}))


def _keep_example(tests: Path, path: Path) -> None:
    """Keep one test pair for the report: the foreign object of middling contrast with what lies around it."""
    if path.exists() or not tests.exists():
        return
    with read_dataset(tests) as dataset:
        contrast = np.nan_to_num(dataset.column("contrast"), nan=-np.inf)
        there = np.flatnonzero(np.isfinite(contrast))
        if there.size == 0:
            return
        number = int(there[np.argsort(contrast[there])[there.size // 2]])
        mask = dataset.foreign_object_masks(number)
        if not mask.any():
            return
        part = tuple(
            slice(max(0, min(int(middle) - _EXAMPLE_PX // 2, length - _EXAMPLE_PX)), None)
            for middle, length in zip(np.argwhere(mask).mean(axis=0), mask.shape, strict=True)
        )
        part = tuple(slice(one.start, one.start + _EXAMPLE_PX) for one in part)
        cut = mask[part]
        with write_dataset(path, shape=(cut.shape[0], cut.shape[1]), provenance={}) as writer:
            writer.append(
                image=dataset.images(number)[(slice(None), *part)],
                foreign_object_mask=cut,
                product_mask=dataset.product_masks(number)[part],
                row=dataset.rows[number],
            )


def _run_setting(task: Task, tell: Tell) -> None:
    folder = Path(task["folder"])
    if not _tried(task):
        found = _trial(task, folder, tell)
        with whole_file(folder / "trial.json") as temporary:
            temporary.write_bytes(canonical({"key": task["key"], **found}))
        if found["refused"]:
            return
    _keep_example(folder / "test.h5", folder / EXAMPLE)
    if not task["keep_images"]:
        _remove(folder / "train.h5", folder / "test.h5")
    words = {name: task["curve"][name] for name in ("link", "log_size", "method")}
    curve = curve_of_table(folder / "hits.csv", task["curve"]["size"], **words)
    curve["other_size"] = _of_other_size(
        curve_of_table(folder / "hits.csv", other_size(task["curve"]["size"]), **words)
    )
    with whole_file(folder / "pod.json") as temporary:
        temporary.write_bytes(canonical({"key": task["curve_key"], **curve}))


def other_size(size: str) -> str:
    """The size that objects have beside the campaign's: contrast and length in mm."""
    return next(name for name in SIZES if name != size)


def _of_other_size(curve: Mapping[str, Any]) -> dict[str, Any]:
    """What is kept of the curve over the other size; nothing is fitted where that is not known."""
    interval = curve["a90_95_interval"]
    return {
        "a50": curve["a50"],
        "a90": curve["a90"],
        "a90_low": interval["low"],
        "a90_high": interval["high"],
        "a90_upper": curve["a90_95"],
        "line": curve["line"],
        "points": curve["points"],
    }


def _trial(task: Task, folder: Path, tell: Tell) -> dict[str, Any]:
    """Hit table of a setting; what was told on the way."""
    from ..generator.datasets.belt_motion import twin_on_belt
    from ..generator.twins.twin_io import read_twin

    training, trying, seeds = task["training"], task["trying"], task["seeds"]
    pair = (setting_from_text(task["low"]), setting_from_text(task["high"]))
    twin, told = twin_on_belt(read_twin(task["twin"]), pair)
    warnings = list(told)
    train, test, hits = folder / "train.h5", folder / "test.h5", folder / "hits.csv"
    tell("images")
    described = task["test"].lower().endswith(".toml")
    looks = trying["images"] if described else trying["draws"]
    try:
        warnings += _generate(task, twin, pair, train, images=training["images"], seed=seeds["train"], part="train")
        warnings += _generate(task, twin, pair, test, images=looks, seed=seeds["test"], part="test")
    except FileFormatError:
        raise
    except InputError as error:
        # the setting cannot be, however often it is tried
        return {"refused": str(error), "warnings": warnings}
    recipe = _recipe(training, train)
    start: str | Path | None = STARTER if training["recipe"] == STARTER else None
    if task["start"] is not None:
        recipe = _later(training, recipe)
        start = Path(task["start"]) / read_object(Path(task["start"]) / "start.json")["networks"]
    networks = folder / "networks"
    train_on_file(
        train,
        networks,
        recipe=replace(recipe, steps=training["steps"], epochs=None),
        networks=training["networks"],
        seed=seeds["networks"],
        start_from=start,
        device=task["device"],
        tell=tell,
    )
    tell("trying networks")
    if trying["threshold"] is None:
        thresholds = thresholds_from_images(
            networks, train, folder / "thresholds.json", trying["marked_share"], device=task["device"]
        )
        warnings += said_of_reluctant(thresholds, trying["marked_share"])
    else:
        thresholds = dict.fromkeys(range(training["networks"]), trying["threshold"])
    detect_on_file(networks, test, hits, {}, thresholds, device=task["device"])
    return {
        "refused": "",
        "warnings": list(dict.fromkeys(warnings)),
        "thresholds": {str(number): value for number, value in thresholds.items()},
        "hits_sha256": sha256_of_file(hits),
    }


def said_of_reluctant(thresholds: Mapping[int, float], marked_share: float) -> list[str]:
    """One line where networks have the lowest threshold and so mark fewer images than they are asked to; thresholds: by network."""
    reluctant = sum(value <= LOWEST_THRESHOLD for value in thresholds.values())
    if not reluctant:
        return []
    return [
        f"{reluctant} of {len(thresholds)} networks mark fewer images than marked_share = {marked_share:g} asks for, even at the"
        f" lowest threshold, {LOWEST_THRESHOLD:g}: they were tried as less ready to mark than others"
    ]


def _generate(
    task: Task, twin: "Twin", pair: Pair, path: Path, *, images: int, seed: int, part: str
) -> tuple[str, ...]:
    """Images of split train and val, or of split test, unless they are there; warnings.

    `images` of split test from references are looks at each; otherwise the number of pairs.
    """
    source = Path(task["learn"] if part == "train" else task["test"])
    noted = path.with_suffix(".json")
    if path.exists() and noted.exists():
        return tuple(read_object(noted)["warnings"])
    whole = path.with_name(f"{path.stem}_drawn.h5")
    summary: GenerationSummary
    if source.suffix.lower() == ".toml":
        from ..generator.datasets.generate_described import generate_from_description
        from ..generator.scenes.describe import read_description

        summary = generate_from_description(
            twin,
            read_description(source),
            whole,
            low=pair[0],
            high=pair[1],
            images=images,
            seed=seed,
            with_counts=False,
        )
        write_split(whole, path, part)
    else:
        from ..generator.datasets.generate import generate_dataset

        fallback = task["reference_setting"]
        with read_dataset(source) as reference:
            summary = generate_dataset(
                twin,
                reference,
                whole,
                low=pair[0],
                high=pair[1],
                images=images if part == "train" else images * len(reference),
                seed=seed,
                product_material=task["materials"][0],
                foreign_material=task["materials"][1],
                with_counts=False,
                reference_setting=None if fallback is None else _pair(fallback),
            )
            known = {row.image for row in reference.rows}
        write_split(whole, path, part, name_of=_look_of(known) if part == "test" else None)
    with whole_file(noted) as temporary:
        temporary.write_text(json.dumps({"warnings": list(summary.warnings)}) + "\n", encoding="utf-8")
    return summary.warnings


def _remove(*images: Path) -> None:
    """Take generated images away, with what was noted beside them."""
    for path in images:
        path.unlink(missing_ok=True)
        path.with_suffix(".json").unlink(missing_ok=True)


def _look_of(known: set[str]) -> Callable[[str], str]:
    """Names of further images of a reference: `012-00093` becomes `012#2`, the second look at 012."""
    seen: dict[str, int] = {}

    def name(image: str) -> str:
        scene = image if image in known else image.rpartition("-")[0]
        seen[scene] = seen.get(scene, 0) + 1
        return scene if seen[scene] == 1 else f"{scene}#{seen[scene]}"

    return name


def _references_own(task: Task) -> Pair:
    """Settings that the references were taken at; those of the first one."""
    from ..generator.datasets.generate import reference_settings

    fallback = task["reference_setting"]
    with read_dataset(task["learn"]) as dataset:
        return reference_settings(dataset.rows[0], None if fallback is None else _pair(fallback))


def _pair(texts: Sequence[str]) -> Pair:
    return setting_from_text(texts[0]), setting_from_text(texts[1])


def _later(training: Mapping[str, Any], recipe: "Recipe") -> "Recipe":
    """How a network that has learnt already goes on; the shipped one's recipe is such a one."""
    from ..segmentation import recipe_for_fine_tuning

    return recipe if training["recipe"] == STARTER else recipe_for_fine_tuning(recipe)


def _recipe(training: Mapping[str, Any], dataset: Path) -> "Recipe":
    from ..segmentation import RECIPES, starter_recipe

    crop = int(training["crop_px"])
    with read_dataset(dataset) as images:
        smallest = min(images.shape)
    usual = starter_recipe() if training["recipe"] == STARTER else RECIPES[training["recipe"]]
    return replace(usual, batch=training["batch"], crop_px=crop if 0 < crop < smallest else None)


# ------------------------------------------------------------------------------------------------ a process of its own


def main() -> int:
    """Do the task that stands in the first line of standard input; its failure is the last line of standard error."""
    task = json.loads(line_from_parent())
    try:
        run_task(task)
    except RaytwinError as error:
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

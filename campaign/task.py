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
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acquisition.acquisition_io import open_acquisition
from ..acquisition.dataset_io import concatenate_datasets, read_dataset
from ..errors import FileFormatError, FitError, InputError
from ..files import sha256_of_file, whole_file
from ._plain import plain
from .task_images import measured_images, source_of, usable_pairs
from .task_plan import SIZES, TaskInput, TaskPlan
from .trial import curve_of_table, detect_on_file, thresholds_from_images, train_on_file

if TYPE_CHECKING:
    from ..generator.line.twin import Twin

Tell = Callable[[str], None]

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
    measured = measured_images(brought, directory, before, plan)
    source = source_of(brought, measured, before, plan)
    tell("what the objects are made of")
    materials, unknown = source.own_materials(after, measured)
    warnings = [*measured.warnings, *unknown]
    tell("images of the twin before and after")
    for name, twin in (("before", before), ("after", after)):
        warnings += source.write(twin, directory / f"{name}_train.h5", directory / f"{name}_test.h5")
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
    real = "measured_on_measured" if "measured" in arms else "after_on_measured"
    starts = [source.write_start(before, directory / "before_start.h5")]
    if not same:
        starts.append(source.write_start(after, directory / "after_start.h5"))
    _joined(starts, directory / "start.h5")
    runs = _train(directory, arms, measured.path, plan, device=device, tell=tell)
    curves = _curves(directory, runs, measured.path, source.sizes(), plan, device=device, tell=tell)
    if same:
        for images, alike in (("after", "before"), ("measured", "measured")):
            curves[f"after_on_{images}"] = curves[f"before_on_{alike}"]
    a90s, lacking = _a90s(curves, real)
    result = a90s | {
        "size": plan.size,
        "unit": SIZES[plan.size],
        "setting": f"{measured.low};{measured.high}",
        "effects": effects,
        "networks": plan.networks,
        "real_networks": "measured" if "measured" in arms else "generated",
        "curves": curves,
        "compare": _comparisons(directory, real, plan, same=same, library=bool(materials)),
        "materials": materials,
        "products": source.text,
        "folder": directory.name,
        "warnings": list(dict.fromkeys([*warnings, *lacking])),
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
            masks = (acquisition.scenes[pair.scene].foreign_object_mask for pair in usable_pairs(acquisition))
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


# ---------------------------------------------------------------------------------------------------- images


def _with_objects(path: Path, splits: Sequence[str]) -> int:
    with read_dataset(path) as dataset:
        return sum(bool(row.foreign_object) and row.split in splits for row in dataset.rows)


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


def _curves(
    directory: Path,
    runs: Mapping[str, Path],
    measured: Path,
    sizes: Mapping[str, float],
    plan: TaskPlan,
    *,
    device: str,
    tell: Tell,
) -> dict[str, Any]:
    """POD of the networks of `runs` on images of each kind (`TRIALS`), with their hit tables in the folder."""
    curves: dict[str, Any] = {}
    for networks, images in TRIALS:
        if networks not in runs:
            continue
        dataset = measured if images == "measured" else directory / f"{images}_test.h5"
        name = f"{networks}_on_{images}"
        table = directory / f"hits_{name}.csv"
        tell(f"networks of {networks} on images of {images}")
        learnt_from = measured if networks == "measured" else directory / f"{networks}_train.h5"
        thresholds = thresholds_from_images(
            runs[networks], learnt_from, directory / f"thresholds_{networks}.json", plan.marked_share, device=device
        )
        detect_on_file(runs[networks], dataset, table, sizes, thresholds, device=device)
        curves[name] = curve_of_table(table, plan.size)
    return curves


def _a90s(curves: Mapping[str, Any], real: str) -> tuple[dict[str, Any], list[str]]:
    """a90 with its interval, real and expected, None where there is no curve of it; and why a curve has none."""
    found: dict[str, Any] = {}
    lacking = []
    for key, name in (
        ("a90_real", real),
        ("a90_before", "before_on_before"),
        ("a90_after", "after_on_after"),
        ("a90_library", "library_on_library"),
    ):
        curve = curves.get(name)
        found[key] = None if curve is None else curve["a90"]
        found[f"{key}_95"] = None if curve is None else curve["a90_95_interval"]
        if curve is not None and curve["a90"] is None:
            lacking.append(f"no {key}: {'; '.join(curve['warnings']) or 'the curve has none'}")
    return found, lacking


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

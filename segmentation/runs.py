"""Networks on a dataset file: train a folder of them, and try every one of them on every image."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError
from ..files import only_one, sha256_of_file
from ._torch import load_torch
from .channels import measure_direction
from .detection import MARK_THRESHOLD, Detection, detect_on_row
from .examples import examples_from_dataset
from .network import probabilities_from_scaled
from .own_module import module_signature, network_of
from .recipe import OWN_MODULE, Recipe
from .runs_io import (
    OF_NETWORK,
    NetworkResult,
    Runs,
    create_or_resume_runs,
    finished_networks,
    gone_unless_begun,
    make_configuration,
    network_folder,
    read_result,
    read_state,
    read_weights,
    starting_weights_files,
    write_finished,
    write_state,
)
from .scaling import MATCHED, matched_along, starts_alike
from .training import EpochResult, TrainingState, iterate_training, load_weights

if TYPE_CHECKING:
    import os

    from ..acquisition.dataset_io import Dataset

_HELD_BACK_SHARE = 0.2
_DETECTION_BATCH = 8
_DIRECTION_IMAGES = 64
_SHARE_OF_KEEPING = 0.05  # of a training's time that goes into keeping states to go on from

# network number, epochs done, epochs wanted, the last epoch (None: nothing new, only where it stands)
Progress = Callable[[int, int, int, EpochResult | None], None]


def split_for_training(dataset: "Dataset", *, seed: int) -> tuple[NDArray[np.intp], NDArray[np.intp], str]:
    """Numbers of the training and validation images of a dataset, and a note where the split had to be made up.

    Without validation images a fifth of the training products (drawn from the seed, whole products, so that no product
    is in both) is held back; where all images are of one product, a fifth of the images.

    Raises:
        InputError: no training images, or a single one and none for validation.
    """
    train, validation = dataset.indices(split="train"), dataset.indices(split="val")
    if not len(train):
        raise InputError(
            dataset.path,
            received=f"no images of split train among {len(dataset)}",
            expected="training images",
            remedy="make a dataset with split train (and val)",
        )
    if len(validation):
        return train, validation, ""
    if len(train) < 2:
        raise InputError(
            dataset.path,
            received="one training image and no validation image",
            expected="at least two images to train and validate with",
        )
    products = dataset.column("product")[train]
    by_product = len(np.unique(products)) > 1
    groups = products if by_product else np.arange(len(train))
    names = np.random.default_rng([seed, len(train)]).permutation(np.unique(groups))
    held_back = np.isin(groups, names[: max(1, round(_HELD_BACK_SHARE * len(names)))])
    note = (
        f"{dataset.path} has no validation images: {int(held_back.sum())} training images"
        + (" (whole products)" if by_product else " of the only product")
        + " are held back for validation"
    )
    return train[~held_back], train[held_back], note


def train_networks(
    dataset: "Dataset",
    runs_path: "str | os.PathLike[str]",
    *,
    recipe: Recipe,
    networks: int = 1,
    seed: int = 0,
    device: str = "cpu",
    start_from: "str | os.PathLike[str] | None" = None,
    fresh: Callable[[int, int], NDArray[Any]] | None = None,
    fresh_noise: Mapping[str, Any] | None = None,
    only: Sequence[int] | None = None,
    network: Any = None,
    progress: Progress | None = None,
    warn: Callable[[str], None] | None = None,
) -> list[NetworkResult]:
    """Train networks 0 .. networks - 1 on a dataset; finished ones are kept, an unfinished one goes on.

    Args:
        dataset: open dataset file with training images.
        runs_path: RUNS folder, new or of the same configuration.
        recipe: how to train.
        networks: how many the folder holds afterwards, at least.
        seed: of the randomness.
        device: torch device (see `choose_device`).
        start_from: weights.pt or RUNS folder whose network(s) to start from instead of random weights.
        fresh: called with an image's number and the epoch, gives its log images (2, row, column) with noise of that epoch;
            validation images are those of epoch 0 throughout. None takes the file's images.
        fresh_noise: what decides `fresh`, kept with the folder so that it is not gone on with by other images.
        only: numbers of those among them that this call trains, for several processes that share a folder; None: all.
        network: a torch module of the user's own, or a function that makes one (`own_module`), for a recipe of
            `recipe_for_module`; None: the recipe's. Its weights are written as `weights.safetensors`, too.
        progress: called after every epoch.
        warn: called with what the user should know (a made-up split, an unreadable state).

    Returns:
        Records of networks 0 .. networks - 1, or of those in `only`.

    Raises:
        InputError: a folder of another configuration, or one that another training works in; unusable data or weights.
    """
    if networks < 1:
        raise InputError("networks", received=networks, expected="a whole number, 1 or more")
    if seed < 0:
        raise InputError("seed", received=seed, expected="a whole number, 0 or more")
    say = warn or (lambda line: None)
    torch = load_torch()
    _check_own(recipe, network)
    train, validation, note = split_for_training(dataset, seed=seed)
    if note:
        say(note)
    recipe = with_direction(recipe, dataset, train, fresh=fresh)
    started_from = starting_weights_files(start_from, range(networks)) if start_from is not None else {}
    starts = {number: _starting_weights(path, recipe) for number, path in started_from.items()}
    hashes = {number: sha256_of_file(path) for number, path in started_from.items()}
    configuration = make_configuration(
        recipe,
        seed=seed,
        dataset_sha256=sha256_of_file(dataset.path),
        started_from=hashes,
        fresh_noise=fresh_noise,
        network=None if network is None else module_signature(network, recipe=recipe, seed=seed),
    )
    train_examples = examples_from_dataset(dataset, train, recipe=recipe, fresh=fresh)
    validation_examples = examples_from_dataset(dataset, validation, recipe=recipe, fresh=fresh)
    if all(train_examples[number][1][-1].any() for number in range(len(train_examples))):
        say("no training image is without a foreign object: expect false alarms on clean products")
    with ExitStack() as stack:
        stack.enter_context(gone_unless_begun(runs_path))
        runs = create_or_resume_runs(runs_path, configuration)
        # processes that share a folder on purpose say which networks are theirs; whoever started them holds the lock
        if only is None:
            stack.enter_context(only_one(runs.path, "a training"))
        done = set(finished_networks(runs))
        results = []
        for number in range(networks) if only is None else only:
            if number in done:
                result = read_result(runs, number)
                if progress is not None:
                    progress(number, len(result.history), len(result.history), None)
                results.append(result)
                continue
            resume = _state_or_none(runs, number, say)
            if resume is not None and progress is not None:
                progress(number, resume.epochs_done, resume.epochs_wanted, None)
            state, due = resume, 0.0
            for state in iterate_training(
                train_examples,
                validation_examples,
                recipe=recipe,
                seed=seed,
                network_number=number,
                device=device,
                start_from=starts.get(number, starts.get(-1)),
                resume=resume,
                network=network,
            ):
                if time.monotonic() >= due:
                    began = time.monotonic()
                    write_state(runs, number, state)
                    due = time.monotonic() + (time.monotonic() - began) / _SHARE_OF_KEEPING
                if progress is not None:
                    progress(number, state.epochs_done, state.epochs_wanted, state.history[-1])
            if state is None or not state.best_weights:
                raise InputError(
                    "validation images",
                    received="a validation loss that is never finite",
                    expected="images on which the network can be judged",
                )
            notes = {
                "device": device,
                "torch": str(torch.__version__),
                "threads": torch.get_num_threads(),
                "n_train": len(train),
                "n_validation": len(validation),
            }
            results.append(write_finished(runs, number, state, notes=notes))
    return results


def say_who_is_blind(results: Sequence[NetworkResult]) -> str:
    """One line on networks that detect no foreign object of their validation images; empty where there are none."""
    blind = [str(result.network) for result in results if result.best.validation_hit_rate == 0.0]
    if not blind:
        return ""
    who = "network " + blind[0] if len(blind) == 1 else f"networks {', '.join(blind)}"
    return (
        f"{who} detected none of the foreign objects in the validation images and learnt nothing of use: give more steps, a higher"
        " learning rate, larger objects or less noise, and see with `raytwin observe` which objects can be seen at all"
    )


def detect_with_networks(
    runs: Runs,
    dataset: "Dataset",
    numbers: Sequence[int] | NDArray[np.intp],
    *,
    networks: Sequence[int] | None = None,
    threshold: float | Mapping[int, float] = MARK_THRESHOLD,
    device: str = "cpu",
    network: Any = None,
    progress: Callable[[int], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> Iterator[Detection]:
    """Try networks on images of a dataset and say of each what it found.

    Args:
        runs: open RUNS folder.
        dataset: open dataset file; images of any size.
        numbers: of the images to try.
        networks: numbers of networks, None = all finished ones.
        threshold: probability above which a pixel is marked, 0..1; or one for each network, by number.
        device: torch device.
        network: of a folder of networks of the user's own, the module or function that they were trained with.
        progress: called with the number of images done, after every batch.
        warn: called with what the user should know.

    Returns:
        Iterator, network by network.

    Raises:
        InputError: no finished network, an unknown one, no images, a threshold outside 0..1.
    """
    finished = finished_networks(runs)
    chosen = finished if networks is None else list(networks)
    thresholds = threshold if isinstance(threshold, Mapping) else dict.fromkeys(chosen, threshold)
    for value in thresholds.values():
        if not 0 <= value < 1:
            raise InputError("threshold", received=value, expected="a probability, 0 or more and below 1")
    if not chosen or not set(chosen) <= set(finished):
        raise InputError(
            str(runs.path),
            received=f"finished networks {finished or 'none'}",
            expected="at least one" if networks is None else f"networks {chosen}",
            remedy="run the same `raytwin train` again: it goes on where it stopped",
        )
    usable = images_with_pixels(dataset, numbers, warn=warn)
    recipe = runs.recipe
    _check_own(recipe, network)
    examples = examples_from_dataset(dataset, usable, recipe=recipe)
    for number in chosen:
        module = network_of(recipe, network, seed=0, pretrained=False)
        path = network_folder(runs, number) / "weights.pt"
        held_recipe, weights = read_weights(path)
        if held_recipe != recipe:
            raise FileFormatError(
                str(path), received="weights of another recipe", expected="weights of this folder's run.json"
            )
        load_weights(module, weights)
        module = module.to(device)
        for first in range(0, len(usable), _DETECTION_BATCH):
            places = range(first, min(first + _DETECTION_BATCH, len(usable)))
            pairs = [examples[place] for place in places]
            probabilities = probabilities_from_scaled(
                module, np.stack([image for image, _ in pairs]), recipe=recipe, device=device, batch=_DETECTION_BATCH
            )
            for place, (_, masks), found in zip(places, pairs, probabilities, strict=True):
                row = dataset.rows[usable[place]]
                yield detect_on_row(row, found, masks[-1], network=number, threshold=thresholds[number])
            if progress is not None:
                progress(len(pairs))


def with_direction(
    recipe: Recipe,
    dataset: "Dataset",
    numbers: NDArray[np.intp],
    *,
    fresh: Callable[[int, int], NDArray[Any]] | None = None,
) -> Recipe:
    """The recipe with the direction of scaling `matched` measured on training images; as it is where it has one, or needs none.

    Args:
        recipe: how networks are trained.
        dataset: open dataset file.
        numbers: of its training images; 64 of them with a foreign object tell the direction to a few degrees.
        fresh: as for `train_networks`; the images are then those of epoch 0.
    """
    if recipe.scaling != MATCHED:
        return recipe
    objects = [int(number) for number in numbers if dataset.rows[int(number)].foreign_object]
    some = objects[:: max(1, len(objects) // _DIRECTION_IMAGES)]
    pairs = (
        (dataset.images(number) if fresh is None else fresh(number, 0), dataset.foreign_object_masks(number))
        for number in some
    )
    return replace(recipe, scaling=matched_along(measure_direction(pairs)))


def _check_own(recipe: Recipe, network: Any) -> None:
    """A recipe of a module of the user's own needs that module, and no other recipe takes one."""
    if (recipe.architecture == OWN_MODULE) != (network is not None):
        raise InputError(
            "network",
            received="none" if network is None else f"a module, and a recipe of {recipe.architecture}",
            expected="the torch module, or the function that makes it, with a recipe of recipe_for_module",
            remedy="in Python give network=; the command line has no word for it" if network is None else "",
        )


def images_with_pixels(
    dataset: "Dataset", numbers: Sequence[int] | NDArray[np.intp], *, warn: Callable[[str], None] | None
) -> list[int]:
    """Numbers of the images that can be tried: an object that is there has a pixel in its mask.

    Raises:
        InputError: none.
    """
    if not len(numbers):
        raise InputError(dataset.path, received="no images to try the networks on", expected="at least one")
    usable, skipped = _with_pixels(dataset, numbers)
    if skipped and warn is not None:
        warn(f"{len(skipped)} images are left out: their foreign object has no pixel in its mask ({skipped[0]} ...)")
    return usable


def _with_pixels(dataset: "Dataset", numbers: Sequence[int] | NDArray[np.intp]) -> tuple[list[int], list[str]]:
    usable: list[int] = []
    skipped: list[str] = []
    for number in map(int, numbers):
        row = dataset.rows[number]
        if row.foreign_object and not dataset.foreign_object_masks(number).any():
            skipped.append(row.image)
        else:
            usable.append(number)
    if not usable:
        raise InputError(
            dataset.path, received="foreign objects without a pixel in their masks", expected="masks that mark them"
        )
    return usable, skipped


def _state_or_none(runs: Runs, number: int, say: Callable[[str], None]) -> TrainingState | None:
    try:
        return read_state(runs, number)
    except FileFormatError as error:
        say(f"network {number} starts again: {error}")
        return None


def _starting_weights(path: Any, recipe: Recipe) -> dict[str, Any]:
    held, weights = read_weights(path)
    different = [name for name in OF_NETWORK if getattr(held, name) != getattr(recipe, name)]
    if starts_alike(held.scaling, recipe.scaling):
        different = [name for name in different if name != "scaling"]

    def said(of: Recipe) -> str:
        values = ((name.replace("_", " "), getattr(of, name)) for name in different)
        return ", ".join(f"{name} {', '.join(value) if isinstance(value, tuple) else value}" for name, value in values)

    if different:
        raise InputError(
            "start from",
            received=f"{path}, trained with {said(held)}",
            expected=said(recipe),
            remedy="start from a network of the same recipe",
        )
    return weights

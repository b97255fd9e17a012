"""Train segmentation networks on a dataset.

Networks are numbered from 0 and differ in their random numbers. A run that was stopped goes on with the same command:
at most one epoch is lost. A folder holds networks of one dataset, recipe, seed and start; asking for more networks than
it has adds to them. The validation images decide which epoch's weights are kept (lowest loss).

With --fresh-noise DATASET holds reference images, and every epoch sees them with noise of its own at a setting: a network never
sees the same noise twice.
"""

import argparse
import dataclasses
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ._answer import answer, say

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from ..segmentation import EpochResult, NetworkResult, Recipe

EXAMPLE = """example:
  raytwin train images.h5 -o networks --networks 5 --seed 1
  raytwin train images_20ms.h5 -o networks_20ms --start-from networks
  raytwin train references.h5 -o fresh_20ms --fresh-noise twin.h5 \
    --low kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05 --high kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `raytwin train`."""
    parser.add_argument("dataset", metavar="DATASET", help="dataset file with images of split train (and val)")
    parser.add_argument(
        "-o", "--output", metavar="RUNS", required=True, help="folder of networks, new or to go on with"
    )
    parser.add_argument("--networks", type=int, default=1, help="how many networks the folder holds at the end (1)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all randomness (0)")
    parser.add_argument("--recipe", default="raytwin", help="raytwin (default) or as_published")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--epochs", type=int, help="passes over the training images")
    length.add_argument("--steps", type=int, help="training steps, rounded up to whole passes")
    parser.add_argument("--batch", type=int, help="images a step, 2 or more")
    parser.add_argument("--learning-rate", type=float, help="learning rate (the peak, where the recipe varies it)")
    parser.add_argument("--crop-px", type=int, help="train on squares of this side round the foreign objects")
    parser.add_argument(
        "--start-from",
        metavar="RUNS|WEIGHTS",
        help="start from trained networks: a folder (its only network, or the one of the same number) or a weights.pt;"
        " without --epochs or --steps a quarter of the recipe's steps, without --learning-rate a third of its rate",
    )
    parser.add_argument(
        "--encoder-weights",
        choices=("none", "imagenet"),
        default="none",
        help="start the encoder from ImageNet (downloaded once) instead of random weights",
    )
    parser.add_argument("--fresh-noise", metavar="TWIN", help="twin that draws other noise for every epoch")
    parser.add_argument("--low", metavar="SETTING", help="with --fresh-noise: target setting at the low kV")
    parser.add_argument("--high", metavar="SETTING", help="the same at the high kV")
    parser.add_argument("--device", default="auto", help="auto (default: a GPU where there is one), cpu, cuda, mps")
    parser.add_argument("--threads", type=int, help="processor threads (all)")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin train`."""
    from tqdm import tqdm

    from ..acquisition import read_dataset
    from ..segmentation import choose_device, train_networks

    recipe = _recipe(arguments)
    fresh, fresh_noise = _fresh(arguments)
    set_threads(arguments.threads)
    device = choose_device(arguments.device)
    with read_dataset(arguments.dataset) as dataset, tqdm(disable=None, unit="epoch") as bar:

        def progress(network: int, done: int, wanted: int, result: "EpochResult | None") -> None:
            bar.set_description(f"network {network + 1}/{arguments.networks}", refresh=False)
            bar.total = wanted
            bar.n = done
            if result is not None and result.validation_loss is not None:
                bar.set_postfix(loss=f"{result.loss:.3f}", validation=f"{result.validation_loss:.3f}", refresh=False)
            bar.refresh()
            if bar.disable and done == wanted and result is not None:
                say(f"network {network}: {done} epochs done")

        results = train_networks(
            dataset,
            arguments.output,
            recipe=recipe,
            networks=arguments.networks,
            seed=arguments.seed,
            device=device,
            start_from=arguments.start_from,
            fresh=fresh,
            fresh_noise=fresh_noise,
            progress=progress,
            warn=say,
        )
    summary = [_network_answer(result) for result in results]
    answer(
        {"runs": arguments.output, "recipe": dataclasses.asdict(recipe), "device": device, "networks": summary},
        as_json=arguments.json,
        text=f"{arguments.output}: {len(results)} networks\n" + "\n".join(map(_line, results)),
    )
    return 0


def _fresh(
    arguments: argparse.Namespace,
) -> "tuple[Callable[[int, int], NDArray[np.float32]] | None, dict[str, Any] | None]":
    """What makes the images of an epoch, and what decides them."""
    given = (arguments.fresh_noise, arguments.low, arguments.high)
    if given == (None, None, None):
        return None, None
    if None in given:
        raise InputError(
            "--fresh-noise",
            received="only a part of --fresh-noise, --low and --high",
            expected="all three: a twin and the two settings to train for",
        )
    from ..acquisition import setting_from_text
    from ..files import sha256_of_file
    from ..generator.fresh import FreshReferences
    from ..generator.twin_io import read_twin

    low, high = setting_from_text(arguments.low), setting_from_text(arguments.high)
    source = FreshReferences(
        read_twin(arguments.fresh_noise), arguments.dataset, low=low, high=high, seed=arguments.seed
    )
    for line in source.warnings:
        say(f"warning: {line}")

    def images(number: int, epoch: int) -> "NDArray[np.float32]":
        return source.example(number, epoch=epoch).log_images

    decided_by = {"twin_sha256": sha256_of_file(arguments.fresh_noise), "low": str(low), "high": str(high)}
    return images, decided_by


def set_threads(threads: int | None) -> None:
    """Let torch use that many processor threads; None leaves all."""
    if threads is None:
        return
    if threads < 1:
        raise InputError("--threads", received=threads, expected="a whole number, 1 or more")
    from ..segmentation._torch import load_torch

    load_torch().set_num_threads(threads)


def _recipe(arguments: argparse.Namespace) -> "Recipe":
    from ..segmentation import RECIPES, recipe_for_fine_tuning

    recipe = RECIPES.get(arguments.recipe)
    if recipe is None:
        raise InputError("--recipe", received=arguments.recipe, expected="one of " + ", ".join(RECIPES))
    if arguments.start_from is not None:
        recipe = recipe_for_fine_tuning(recipe)
    changes: dict[str, Any] = {}
    if arguments.epochs is not None or arguments.steps is not None:
        changes |= {"epochs": arguments.epochs, "steps": arguments.steps}
    for field in ("batch", "learning_rate", "crop_px"):
        if getattr(arguments, field) is not None:
            changes[field] = getattr(arguments, field)
    if arguments.encoder_weights != "none":
        changes["encoder_weights"] = arguments.encoder_weights
    return dataclasses.replace(recipe, **changes)


def _network_answer(result: "NetworkResult") -> dict[str, Any]:
    validated = [epoch for epoch in result.history if epoch.validation_loss is not None]
    return {
        "network": result.network,
        "best_epoch": result.best_epoch,
        "best_validation_loss": result.best_validation_loss,
        "validation_recall": result.best.validation_recall,
        "validation_hit_rate": result.best.validation_hit_rate,
        "validation_false_alarm_rate": result.best.validation_false_alarm_rate,
        "epochs": len(result.history),
        "losses": [epoch.loss for epoch in result.history],
        "validation_epochs": [epoch.epoch for epoch in validated],
        "validation_losses": [epoch.validation_loss for epoch in validated],
        "weights_sha256": result.weights_sha256,
    }


def _line(result: "NetworkResult") -> str:
    def percent(value: float | None) -> str:
        return "none to judge by" if value is None else f"{100 * value:.0f} %"

    return (
        f"network {result.network}: best epoch {result.best_epoch} of {len(result.history)},"
        f" validation loss {result.best_validation_loss:.3f},"
        f" objects detected {percent(result.best.validation_hit_rate)},"
        f" false alarms {percent(result.best.validation_false_alarm_rate)}"
    )

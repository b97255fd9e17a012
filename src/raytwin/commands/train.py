"""Train segmentation networks on a dataset.

Networks are numbered from 0 and differ in their random numbers. A run that was stopped goes on with the same command: what is lost is
the epoch under way, or some seconds of shorter ones. A folder holds networks of one dataset, recipe, seed and start; asking for more
networks than it has adds to them. The validation images decide which epoch's weights are kept (lowest loss).

With --fresh-noise DATASET holds reference images, and every epoch sees them with noise of its own at a setting: a network never
sees the same noise twice.
"""

import argparse
from typing import TYPE_CHECKING

from ..results import counted, percent_text
from ._answer import answer, say

if TYPE_CHECKING:
    from ..segmentation import NetworkResult

EXAMPLE = """example:
  raytwin train images.h5 -o networks --networks 5 --seed 1
  raytwin train images.h5 -o ten --networks 10 --workers 2 --start-from starter
  raytwin train images_20ms.h5 -o networks_20ms --start-from networks
  raytwin train images.h5 -o quick --start-from starter          # has learnt already: 60 steps of a small network
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
    parser.add_argument(
        "--recipe",
        help="raytwin (default), as_published; with --start-from that of the networks named there, by default",
    )
    parser.add_argument("--architecture", help="of segmentation-models-pytorch, such as FPN or Unet (DeepLabV3Plus)")
    parser.add_argument("--encoder", help="of segmentation-models-pytorch, such as resnet18 (efficientnet-b0)")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--epochs", type=int, help="passes over the training images")
    length.add_argument("--steps", type=int, help="training steps, rounded up to whole passes")
    parser.add_argument("--batch", type=int, help="images a step, 2 or more")
    parser.add_argument("--learning-rate", type=float, help="learning rate (the peak, where the recipe varies it)")
    parser.add_argument("--crop-px", type=int, help="train on squares of this side round the foreign objects")
    parser.add_argument(
        "--scaling",
        help="what networks see: matched (default: both images combined so that the training set's objects stand out most),"
        " matched:DEGREES, residual or min_max",
    )
    parser.add_argument(
        "--start-from",
        metavar="starter|RUNS|WEIGHTS",
        help="start from trained networks: starter (comes with raytwin), a folder (its only network, or the one of"
        " the same number) or a weights file;"
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
    parser.add_argument("--threads", type=int, help="processor threads (all; of several workers one each)")
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        help="processes that share the networks, a core each (1); any number, same weights",
    )
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin train`."""
    from ..api._progress import Bar
    from ..api.images import train

    with Bar(only_on_terminal=True, unit="epoch") as bar:

        def told(stage: str, done: int, total: int | None) -> None:
            bar(stage, done, total)
            if bar.hidden and done == total:
                say(f"{stage}: {done} epochs done")

        found = train(
            arguments.dataset,
            arguments.output,
            networks=arguments.networks,
            recipe=arguments.recipe,
            epochs=arguments.epochs,
            steps=arguments.steps,
            batch=arguments.batch,
            learning_rate=arguments.learning_rate,
            crop_px=arguments.crop_px,
            scaling=arguments.scaling,
            encoder_weights=None if arguments.encoder_weights == "none" else arguments.encoder_weights,
            architecture=arguments.architecture,
            encoder=arguments.encoder,
            start_from=arguments.start_from,
            fresh_noise=arguments.fresh_noise,
            low=arguments.low,
            high=arguments.high,
            device=arguments.device,
            threads=arguments.threads,
            workers=arguments.workers,
            seed=arguments.seed,
            progress=told,
        )
    for line in found.warnings:
        say(f"note: {line}")
    if found.recipe.scaling.startswith("matched:"):
        degrees = found.recipe.scaling.partition(":")[2]
        say(
            f"networks see the pair along {degrees} degrees: 0 is the residual, 90 more and -90 less thickness than around"
        )
    answer(
        found.to_dict(),
        as_json=arguments.json,
        text=f"{arguments.output}: {counted(len(found.networks), 'network')}\n" + "\n".join(map(_line, found.networks)),
    )
    return 0


def _line(result: "NetworkResult") -> str:
    return (
        f"network {result.network}: best epoch {result.best_epoch} of {len(result.history)},"
        f" validation loss {result.best_validation_loss:.3f},"
        f" objects detected {percent_text(result.best.validation_hit_rate)},"
        f" false alarms {percent_text(result.best.validation_false_alarm_rate)}"
    )

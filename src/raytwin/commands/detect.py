"""Try every network on every image: hit or miss, false alarm or not.

A pixel is marked where the network's probability is above the threshold. A foreign object is detected when more than a
tenth of its pixels are marked; an image without one is a false alarm when any pixel is marked. The table has one line
per network and image: contrast, size_mm, hit, network, image, foreign_object, setting, false_alarm, recall, response
(the highest probability in the object), product. Images without foreign object have an empty contrast and size.
"""

import argparse
import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ._answer import answer, say
from .train import set_threads

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..acquisition import Dataset
    from ..segmentation import Rate

EXAMPLE = """example:
  raytwin detect networks test_images.h5 -o hits.csv
"""

_SPLITS = ("train", "val", "test", "all")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `raytwin detect`."""
    parser.add_argument("runs", metavar="RUNS", help="folder of networks from `raytwin train`")
    parser.add_argument("dataset", metavar="DATASET", help="dataset file")
    parser.add_argument("-o", "--output", metavar="HITS.csv", required=True, help="the hit/miss table to write")
    parser.add_argument(
        "--split",
        choices=_SPLITS,
        help="images to try (default: test; all where the file has none and is not the one trained on)",
    )
    parser.add_argument("--setting", help="only images of this setting, as the file names it")
    parser.add_argument("--threshold", type=float, default=0.5, help="probability above which a pixel is marked (0.5)")
    parser.add_argument("--device", default="auto", help="auto (default: a GPU where there is one), cpu, cuda, mps")
    parser.add_argument("--threads", type=int, help="processor threads (all)")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin detect`."""
    from tqdm import tqdm

    from ..acquisition import read_dataset
    from ..files import sha256_of_file
    from ..segmentation import (
        choose_device,
        detect_with_networks,
        finished_networks,
        open_runs,
        summarise_detections,
        write_detections,
    )

    runs = open_runs(arguments.runs)
    set_threads(arguments.threads)
    device = choose_device(arguments.device)
    with read_dataset(arguments.dataset) as dataset:
        trained_on = sha256_of_file(arguments.dataset) == runs.configuration["dataset_sha256"]
        numbers = _numbers(dataset, split=arguments.split, setting=arguments.setting, trained_on=trained_on)
        networks = finished_networks(runs)
        unfinished = len(list(runs.path.glob("network_*/state.pt")))
        if unfinished:
            say(f"{unfinished} networks of {arguments.runs} are not finished and are left out")
        with tqdm(total=len(numbers) * len(networks), disable=None, unit="image") as bar:
            detections = list(
                detect_with_networks(
                    runs,
                    dataset,
                    numbers,
                    threshold=arguments.threshold,
                    device=device,
                    progress=bar.update,
                    warn=say,
                )
            )
    unknown = sum(row.recall is not None and row.contrast is None and row.size_mm is None for row in detections)
    if unknown:
        say(f"{unknown} lines have a foreign object of unknown contrast and size: no POD curve can be fitted to them")
    write_detections(arguments.output, detections)
    rates = summarise_detections(detections)
    answer(
        {
            "table": arguments.output,
            "networks": networks,
            "images": len({row.image for row in detections}),
            "threshold": arguments.threshold,
            **{name: dataclasses.asdict(rate) for name, rate in rates.items()},
        },
        as_json=arguments.json,
        text=f"{arguments.output}: {len(detections)} lines, {len(networks)} networks\n"
        f"recall of the objects' pixels  {_text(rates['recall'])}\n"
        f"objects detected               {_text(rates['hit_rate'])}\n"
        f"false alarms                   {_text(rates['false_alarm_rate'])}",
    )
    return 0


def _numbers(dataset: "Dataset", *, split: str | None, setting: str | None, trained_on: bool) -> "NDArray[np.intp]":
    chosen = split or "test"
    numbers = dataset.indices(split=None if chosen == "all" else chosen, setting=setting)
    if not len(numbers) and split is None and not trained_on:
        numbers = dataset.indices(setting=setting)
        say(f"{dataset.path} has no images of split test: all {len(numbers)} are tried")
    if not len(numbers):
        settings = sorted({row.setting for row in dataset.rows})
        raise InputError(
            dataset.path,
            received=f"no images of split {chosen}" + (f" at {setting}" if setting else ""),
            expected="at least one; its settings are " + " | ".join(settings),
            remedy="choose with --split and --setting",
        )
    if trained_on and chosen in ("train", "all"):
        say("these networks were trained on some of these images: the rates are too good")
    return numbers


def _text(rate: "Rate") -> str:
    if rate.value is None or rate.low is None or rate.high is None:
        return "no trials"
    return f"{100 * rate.value:.1f} % (95 %: {100 * rate.low:.1f}-{100 * rate.high:.1f} %, {rate.n} trials)"

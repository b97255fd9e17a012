"""Try every network on every image: hit or miss, false alarm or not.

A pixel is marked where the network's probability is above the threshold. A foreign object is detected when more than a
tenth of its pixels are marked; an image without one is a false alarm when any pixel is marked. The table has one line
per network and image: contrast, size_mm, hit, network, image, foreign_object, setting, false_alarm, recall, response
(the highest probability in the object), product. Images without foreign object have an empty contrast and size.
"""

import argparse
from typing import TYPE_CHECKING

from ..results import counted
from ._answer import answer, say

if TYPE_CHECKING:
    from ..segmentation import Rate

EXAMPLE = """examples:
  raytwin detect networks test_images.h5 -o hits.csv
  raytwin detect network.onnx test_images.h5 -o hits.csv --scaling min_max
"""

_SPLITS = ("train", "val", "test", "all")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `raytwin detect`."""
    parser.add_argument(
        "runs", metavar="RUNS", help="folder of networks from `raytwin train`, or a network made elsewhere (.onnx)"
    )
    parser.add_argument("dataset", metavar="DATASET", help="dataset file")
    parser.add_argument("-o", "--output", metavar="HITS.csv", required=True, help="the hit/miss table to write")
    parser.add_argument(
        "--split",
        choices=_SPLITS,
        help="images to try (default: test; all where the file has none and is not the one trained on)",
    )
    parser.add_argument("--setting", help="only images of this setting, as the file names it")
    parser.add_argument("--threshold", type=float, default=0.5, help="probability above which a pixel is marked (0.5)")
    parser.add_argument(
        "--scaling",
        help="of an ONNX file's images: min_max, residual or matched:DEGREES (default: log images as they are)",
    )
    parser.add_argument(
        "--probabilities", action="store_true", help="an ONNX file gives probabilities (default: logits)"
    )
    parser.add_argument(
        "--classes",
        choices=("exclusive", "independent"),
        help="of an ONNX file with several, the last one the foreign object: exclusive (softmax, the default) or independent",
    )
    parser.add_argument("--device", default="auto", help="auto (default: a GPU where there is one), cpu, cuda, mps")
    parser.add_argument("--threads", type=int, help="processor threads (all)")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin detect`."""
    from ..api._progress import Bar
    from ..api.images import detect

    with Bar(only_on_terminal=True, unit="image") as bar:
        found = detect(
            arguments.runs,
            arguments.dataset,
            output=arguments.output,
            split=arguments.split,
            setting=arguments.setting,
            threshold=arguments.threshold,
            scaling=arguments.scaling,
            probabilities=arguments.probabilities,
            classes=arguments.classes,
            device=arguments.device,
            threads=arguments.threads,
            progress=bar,
        )
    for line in found.warnings:
        say(line)
    rates = found.rates
    answer(
        found.to_dict(),
        as_json=arguments.json,
        text=f"{arguments.output}: {len(found.rows)} lines, {counted(len(found.networks), 'network')}\n"
        f"recall of the objects' pixels  {_text(rates['recall'])}\n"
        f"objects detected               {_text(rates['hit_rate'])}\n"
        f"false alarms                   {_text(rates['false_alarm_rate'])}",
    )
    return 0


def _text(rate: "Rate") -> str:
    if rate.value is None or rate.low is None or rate.high is None:
        return "no trials"
    return f"{100 * rate.value:.1f} % (95 %: {100 * rate.low:.1f}-{100 * rate.high:.1f} %, {rate.n} trials)"

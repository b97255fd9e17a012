"""The paper's table on the virtual lab's line: contrast at POD 90 %, generated against measured test images, at each exposure.

Networks learn from images that the twin generated and are tried on measured and on generated images of the same products, at
the same rate of false alarms; differences come with their 95 % intervals, and equivalence at a margin is stated or refused. Lines
with an effect in them follow: a90 as the twin has it before the effect was found, with it added, and as measured. A
table that was stopped goes on with the same command; the page and the numbers are written after every row.
"""

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError
from ._answer import answer, say
from ._size import size_from_text

EXAMPLE = """examples:
  raytwin table -o table --workers 2                          # ten networks an exposure, some hours on two cores
  raytwin table -o quick --networks 3 --exposures-ms 100,20 --test-products 120 --boneless 30
  raytwin table -o papers --start random --steps 600          # DeepLabV3Plus from random weights
  raytwin table -o table --networks 30 --device cuda --workers 10   # ten processes share the GPU
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin table`."""
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder, new or to go on with")
    parser.add_argument("--networks", type=int, help="networks for each exposure (10)")
    parser.add_argument(
        "--exposures-ms", metavar="MS,MS", help="beside 1 s (200,100,75,50,20); the paper measured at 100, 50 and 20"
    )
    parser.add_argument(
        "--start",
        choices=("starter", "random"),
        help="starter (default): the network that comes with raytwin, fine-tuned; random: DeepLabV3Plus with EfficientNet-B0",
    )
    parser.add_argument(
        "--steps", type=int, help="training steps of each network (120 from the starter, 600 from random)"
    )
    parser.add_argument("--products", type=int, help="products to learn from (120)")
    parser.add_argument("--generated", type=int, help="training pairs generated for each exposure (240)")
    parser.add_argument("--test-products", type=int, help="products to test on (1000)")
    parser.add_argument("--boneless", type=int, help="those among them without bone (a quarter)")
    parser.add_argument("--size", metavar="ROWSxCOLUMNS", help="detector, pixels (96x128)")
    parser.add_argument("--margin", type=float, help="of equivalence, in contrast (0.02)")
    parser.add_argument("--alarm-share", type=float, help="rate of false alarms that thresholds are set for (0.05)")
    parser.add_argument("--without-published", action="store_true", help="without images generated as published")
    parser.add_argument(
        "--effect",
        metavar="ID=STRENGTH",
        action="append",
        help="an effect that stands in a line of its own; repeatable"
        " (object_scatter=20, motion_blur=4, veiling_glare=3)",
    )
    parser.add_argument("--effect-networks", type=int, help="networks of each kind there (3)")
    parser.add_argument("--effect-products", type=int, help="products measured there, half of them to test on (240)")
    parser.add_argument("--without-effects", action="store_true", help="without lines with an effect")
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        help="processes that train, a core each (1); on a processor any number gives the same bytes",
    )
    parser.add_argument("--device", default="auto", help="auto (default: a GPU where there is one), cpu, cuda, mps")
    parser.add_argument("--seed", type=int, help="seed of everything (1)")
    parser.add_argument("--json", action="store_true", help="print the table as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin table`."""
    from .. import __version__
    from ..campaign.table import plan_of, run_table
    from ..campaign.table_effects import EffectsPlan
    from ..campaign.table_page import table_page
    from ..cli import main
    from ..reports import write_result_page
    from ..segmentation import choose_device

    if arguments.workers < 1:
        raise InputError("--workers", received=arguments.workers, expected="1 or more")
    plan = plan_of(**_plan_words(arguments))
    words = _effects_words(arguments)
    if arguments.without_effects and words.keys() - {"seed"}:
        raise InputError(
            "--without-effects", received="with options of lines with an effect", expected="one or the other"
        )
    effects = None if arguments.without_effects else EffectsPlan(**words)
    device = choose_device(arguments.device)  # says at once how to install torch where it is missing
    started = time.monotonic()

    def page(result: Any) -> None:
        write_result_page(arguments.output / "report.html", table_page(result), version=__version__)

    result = run_table(
        plan,
        arguments.output,
        run=main,
        version=__version__,
        effects=effects,
        workers=arguments.workers,
        device=device,
        tell=lambda line: say(f"[{time.monotonic() - started:5.0f} s] {line}"),
        each=page,
    )
    lines = [_line(row) for row in result["rows"]]
    lines += [_effect_line(line, row) for line in result["effects"] for row in line["rows"]]
    answer(result, as_json=arguments.json, text="\n".join([*lines, f"report: {arguments.output / 'report.html'}"]))
    return 0


def _plan_words(arguments: argparse.Namespace) -> dict[str, Any]:
    """The changes of the usual plan that the options ask for."""
    words: dict[str, Any] = {
        name: getattr(arguments, name)
        for name in ("networks", "start", "steps", "margin", "alarm_share")
        if getattr(arguments, name) is not None
    }
    if arguments.start == "random":
        # as the recipe has them
        words = {"steps": 600, "rate": 3e-3} | words
    line: dict[str, Any] = {
        name: getattr(arguments, name)
        for name in ("products", "generated", "test_products", "boneless", "seed")
        if getattr(arguments, name) is not None
    }
    if arguments.size is not None:
        line["size"] = size_from_text(arguments.size)
    if arguments.exposures_ms is not None:
        try:
            words["exposures_ms"] = tuple(float(word) for word in arguments.exposures_ms.split(","))
        except ValueError:
            raise InputError(
                "--exposures-ms", received=repr(arguments.exposures_ms), expected="times in ms joined by commas"
            ) from None
    return {**words, "line": line, "published": not arguments.without_published}


def _effects_words(arguments: argparse.Namespace) -> dict[str, Any]:
    """The changes of the usual lines with an effect that the options ask for."""
    given = {
        "effects": None if arguments.effect is None else tuple(arguments.effect),
        "networks": arguments.effect_networks,
        "products": arguments.effect_products,
        "seed": arguments.seed,
    }
    return {name: value for name, value in given.items() if value is not None}


def _effect_line(line: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    """One exposure of a line with an effect in a line of text."""
    told = ", ".join(
        f"{label} {_text(row[key]['a90'])}"
        for label, key in (("twin as calibrated", "before"), ("with what was found", "after"), ("measured", "real"))
    )
    return f"{line['effect']}, {row['exposure_ms']:g} ms: {told}"


def _line(row: dict[str, Any]) -> str:
    """One exposure in a line of text."""
    told = [f"{row['exposure_ms']:g} ms:"]
    for kind in ("generated", "measured"):
        curve = row[kind]
        if curve is not None:
            ends = curve["a90_95_interval"]
            value = (
                "no a90"
                if curve["a90"] is None
                else f"{curve['a90']:.3f} ({_text(ends['low'])} to {_text(ends['high'])})"
            )
            told.append(f"{kind} {value};")
    if row["compare"] is not None:
        told.append(f"{row['compare']['equivalence'].replace('_', ' ')}: {row['compare']['reason']}")
    return " ".join(told).rstrip(";")


def _text(value: float | None) -> str:
    return "none" if value is None else f"{value:.3f}"

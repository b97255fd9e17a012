"""The main job end to end on the virtual lab: calibrate, validate, generate, train, detect, POD, diagnose, one report.

Small but honest by default (minutes on two cores), with networks that start from the one that comes along; --paper-size is the
paper's detector, image and network numbers. A run that was stopped goes on where it stopped.
"""

import argparse
import dataclasses
import time
from pathlib import Path

from ._answer import answer, say
from ._size import size_from_text

EXAMPLE = """example:
  raytwin demo -o demo
  raytwin demo -o demo_large --size 192x256 --products 150 --networks 10
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin demo`."""
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, default=Path("demo"), help="folder (default demo)")
    parser.add_argument("--paper-size", action="store_true", help="start from the paper's sizes instead of small ones")
    parser.add_argument("--size", metavar="ROWSxCOLUMNS", help="detector, pixels")
    parser.add_argument("--pixel-mm", type=float, help="pixel pitch, mm")
    parser.add_argument("--products", type=int, help="images to learn from")
    parser.add_argument("--test-products", type=int, help="images to test on")
    parser.add_argument("--generated", type=int, help="training pairs generated for each exposure")
    parser.add_argument("--networks", type=int, help="networks for each exposure")
    parser.add_argument(
        "--first-steps",
        type=int,
        help="with --paper-size: training steps of the network that all start from, on the least noisy images",
    )
    parser.add_argument("--shared-steps", type=int, help="with --paper-size: its further steps on all exposures")
    parser.add_argument(
        "--steps",
        type=int,
        help="training steps of each network after that; without --paper-size of those at 1 s, doubled for each shorter"
        " exposure",
    )
    parser.add_argument("--batch", type=int, help="images a step")
    parser.add_argument("--seed", type=int, help="seed of everything (default 1)")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin demo`."""
    from .. import __version__
    from ..campaign.demo import PAPER_PLAN, DemoPlan, gap_summary, run_demo
    from ..campaign.demo_gap import answer_text
    from ..campaign.report import summary_text, write_report
    from ..cli import main
    from ..errors import InputError
    from ..segmentation import choose_device

    changes = {
        name: value
        for name in (
            "pixel_mm",
            "products",
            "test_products",
            "generated",
            "networks",
            "first_steps",
            "shared_steps",
            "steps",
            "batch",
            "seed",
        )
        if (value := getattr(arguments, name)) is not None
    }
    if arguments.size is not None:
        changes["size"] = size_from_text(arguments.size)
    ignored = [name for name in ("first_steps", "shared_steps") if name in changes]
    if ignored and not arguments.paper_size:
        raise InputError(
            f"--{ignored[0].replace('_', '-')}",
            received="without --paper-size",
            expected="--paper-size with it: the small demo's networks start from the one that comes with raytwin",
        )
    plan = dataclasses.replace(PAPER_PLAN if arguments.paper_size else DemoPlan(), **changes)
    choose_device("auto")  # says at once how to install torch where it is missing
    started = time.monotonic()
    result = run_demo(
        plan, arguments.output, run=main, tell=lambda line: say(f"[{time.monotonic() - started:5.0f} s] {line}")
    )
    report = write_report(result, arguments.output, version=__version__)
    summary = f"{summary_text(result)} {answer_text(result['gap'])}"
    found = {name: result["gap"]["diagnosis"][name] for name in ("verdict", "gap", "causes")}
    answer(
        {
            "paths": {
                "report": report,
                "twin": arguments.output / "twin.h5",
                "improved_twin": arguments.output / "diagnosis" / "twin.h5",
                "diagnosis": arguments.output / "diagnosis" / "diagnosis.json",
                "directory": arguments.output,
            },
            "a90_table": result["a90_table"],
            "validation": {
                "median_abs_error_percent": result["validation"]["median_abs_error_percent"],
                "coverage": result["validation"]["coverage"],
            },
            "diagnosis": gap_summary(result["validation"]),
            "planted_effect": {"truth": result["gap"]["truth"], **found},
            "summary": summary,
            "seconds": round(time.monotonic() - started, 1),
        },
        as_json=arguments.json,
        text=f"{summary}\nreport: {report}",
    )
    return 0

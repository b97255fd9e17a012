"""Where the gap between measured and simulated lies, which effect causes it, and how far it shrinks with that effect added.

Any acquisition file will do, from darks and two flats to the full protocol; what it does not allow is said. Writes
diagnosis.json, report.html and twin.h5 (the twin with the effect added) into the folder. With --task the gap is followed to
detection: POD of networks trained on the twin's images before and after, against measured images (docs/diagnosis.md). What
the task made stands in DIR/task, and a run that was stopped goes on there.
"""

import argparse
from pathlib import Path
from typing import Any

from ._answer import answer, say

EXAMPLE = """example:
  raytwin lab -o session.h5 --protocol full --effect object_scatter=10 --seed 1
  raytwin diagnose session.h5 -o diagnosis
  raytwin diagnose session.h5 -o plan --plan
  raytwin diagnose session.h5 -o again --also more.h5
  raytwin lab -o products.h5 --protocol products --session 1 --products 96 --bones-mm 1,1.5,2,2.5,3,4 \\
    --effect object_scatter=10 --seed 1
  raytwin diagnose session.h5 -o with_pod --task products.h5
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin diagnose`."""
    parser.add_argument("acquisition", metavar="ACQ", type=Path, help="acquisition file")
    parser.add_argument(
        "--twin",
        metavar="TWIN",
        type=Path,
        help="twin calibrated before, whose effects are part of what is expected (default: from this session's own series)",
    )
    parser.add_argument(
        "--also",
        metavar="MORE",
        type=Path,
        action="append",
        default=[],
        help="what was measured later on the same line, such as the answer's next measurement; calibrates nothing; repeatable",
    )
    parser.add_argument(
        "--layer",
        choices=("front", "back"),
        help="of a dual-layer panel, by the series' attribute `layer` (default: the twin's, front without one)",
    )
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder of the answer")
    parser.add_argument(
        "--without", metavar="ID", action="append", default=[], help="leave an effect out of the catalogue; repeatable"
    )
    parser.add_argument(
        "--plan",
        action="store_true",
        help="say which effects these series could distinguish, whatever the frames show, and write no diagnosis",
    )
    task = parser.add_argument_group(
        "POD before and after",
        "networks are trained on images of the twin without and with what was found, and on measured ones; all are tried on"
        " the same objects",
    )
    task.add_argument(
        "--task",
        metavar="MEASURED",
        type=Path,
        help="acquisition or dataset: images of the line as it is now, of products with and without known foreign objects",
    )
    task.add_argument(
        "--task-products",
        metavar="SOURCE",
        type=Path,
        help="what the twins' images are made from: a description (.toml), an acquisition with thickness maps, or a dataset"
        " of reference images (default: the thickness maps in MEASURED)",
    )
    task.add_argument("--task-low", metavar="SETTING", help="setting at the low kV (default: the shortest exposure)")
    task.add_argument("--task-high", metavar="SETTING", help="setting at the high kV")
    task.add_argument("--task-networks", type=int, help="networks of each kind (default 6)")
    task.add_argument("--task-start-steps", type=int, help="training steps of the network that all start from (60)")
    task.add_argument("--task-steps", type=int, help="training steps of each network after that (60)")
    task.add_argument("--task-crop-px", type=int, help="side of the squares they learn from, 0: whole images (64)")
    task.add_argument("--task-draws", type=int, help="images of each known product, each with its own noise (2)")
    task.add_argument(
        "--task-images", type=int, help="images from a description or references, to learn and to try (120)"
    )
    task.add_argument("--task-size", choices=("size_mm", "contrast"), help="what a90 is a size of (contrast)")
    task.add_argument("--device", default="auto", help="of the networks: auto, cpu, cuda, mps (default auto)")
    parser.add_argument("--seed", type=int, default=0, help="of the random draws (default 0)")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin diagnose`."""
    from ..api._progress import Bar
    from ..api.sessions import diagnose
    from ..campaign.task_page import task_text
    from ..diagnosis.advice.plan import table_text
    from ..diagnosis.advice.plan_session import SessionPlan
    from ..diagnosis.report.explanation import answer_text

    with Bar(only_on_terminal=True) as bar:
        found = diagnose(
            arguments.acquisition,
            twin=arguments.twin,
            also=arguments.also,
            layer=arguments.layer,
            without=arguments.without,
            plan_only=arguments.plan,
            output=arguments.output,
            task=None if arguments.plan else _task_of(arguments),
            device=arguments.device,
            seed=arguments.seed,
            progress=bar,
        )
    if isinstance(found, SessionPlan):
        for line in (item.line for item in found.findings):
            say(f"finding: {line}")
        missing = [f"{effect} cannot be judged: {reason}" for effect, reason in found.cannot_be_judged.items()]
        text = "\n".join([table_text(found.distinguishability), *missing])
        answer(found.to_dict(), as_json=arguments.json, text=text)
        return 0
    if arguments.json:  # the text has these and the notes
        for item in found.findings:
            say(f"finding: {item.line}")
    for line in found.warnings:
        say(f"not used: {line}")
    if arguments.json:
        for line in found.notes:
            say(line)
    text = answer_text(found)
    if found.task is not None:
        for line in found.task["warnings"]:
            say(f"warning: {line}")
        text += f"\n{task_text(found.task)}"
    answer(found.to_dict(), as_json=arguments.json, text=f"{text}\nreport: {arguments.output / 'report.html'}")
    return 0


def _task_of(arguments: argparse.Namespace) -> dict[str, Any] | None:
    """What `--task` and its companions ask for."""
    from ..errors import InputError

    given = {name: value for name, value in vars(arguments).items() if name.startswith("task_") and value is not None}
    if arguments.task is None:
        if given:
            option = "--" + min(given).replace("_", "-")
            raise InputError(
                option, received="without --task", expected="--task MEASURED, the images to try networks on"
            )
        return None
    return {"measured": arguments.task, **{name.removeprefix("task_"): value for name, value in given.items()}}

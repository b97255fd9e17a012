"""Where the gap between measured and simulated lies, which effect causes it, and how far it shrinks with that effect added.

Any acquisition file will do, from darks and two flats to the full protocol; what it does not allow is said. Writes
diagnosis.json, report.html and twin.h5 (the twin with the effect added) into the folder. With --task the gap is followed to
detection: POD of networks trained on the twin's images before and after, against measured images (docs/diagnosis.md). What
the task made stands in DIR/task, and a run that was stopped goes on there.
"""

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ._answer import answer, jsonable, say
from ._folder import check_effects, written_folder

if TYPE_CHECKING:
    from ..acquisition.acquisition_io import AcquisitionFile
    from ..campaign.task import TaskInput, TaskPlan
    from ..diagnosis.answer import Diagnosis
    from ..generator.twin import Twin

_LATER_S = 3600.0  # from the end of a session to what was measured later, which has a clock of its own

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
        help="of a dual-layer panel, by the series' attribute `layer` (default: front)",
    )
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder of the answer")
    parser.add_argument(
        "--without", metavar="ID", action="append", default=[], help="leave an effect out of the catalogue; repeatable"
    )
    parser.add_argument(
        "--plan",
        action="store_true",
        help="say which effects these series could tell apart, whatever the frames show, and write no diagnosis",
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
    task.add_argument("--task-networks", type=int, help="networks of each kind (default 3)")
    task.add_argument("--task-start-steps", type=int, help="training steps of the network that all start from (240)")
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
    from ..errors import InputError
    from ..generator.effects import EFFECTS
    from ..generator.twin_io import read_twin

    check_effects("--without", arguments.without, tuple(EFFECTS))
    if arguments.seed < 0:
        raise InputError("--seed", received=arguments.seed, expected="a whole number of 0 or more")
    twin = None if arguments.twin is None else read_twin(arguments.twin)
    with written_folder(arguments.output):
        return _plan(arguments, twin) if arguments.plan else _diagnose(arguments, twin)


def _diagnose(arguments: argparse.Namespace, twin: "Twin | None") -> int:
    import numpy as np
    from tqdm import tqdm

    from .. import __version__
    from ..diagnosis.answer import diagnosis_answer
    from ..diagnosis.diagnose import diagnose
    from ..diagnosis.explanation import paragraph, task_text
    from ..diagnosis.report import write_report
    from ..files import sha256_of_file, whole_file
    from ..generator.twin_io import write_twin

    task = _task_of(arguments)
    with _opened(arguments) as acquisition, tqdm(disable=None, bar_format="{desc}") as bar:
        result = diagnose(
            acquisition,
            twin=twin,
            rng=np.random.default_rng(arguments.seed),
            without=arguments.without,
            progress=bar.set_description_str,
        )
    doubts = len(result.mislabelled)
    for number, line in enumerate(result.warnings):
        say(f"label in doubt: {line}" if number < doubts else f"not used: {line}")
    for line in result.notes:
        say(line)
    inputs = {
        "acquisition_sha256": sha256_of_file(arguments.acquisition),
        **({"also_sha256": [sha256_of_file(path) for path in arguments.also]} if arguments.also else {}),
        "twin_sha256": None if arguments.twin is None else sha256_of_file(arguments.twin),
        "raytwin_version": __version__,
        "seed": arguments.seed,
    }
    data = diagnosis_answer(result, inputs=inputs)
    with whole_file(arguments.output / "twin.h5") as temporary:
        write_twin(temporary, result.twin)

    def write() -> None:
        write_report(result, data, arguments.output / "report.html", version=__version__)
        with whole_file(arguments.output / "diagnosis.json") as temporary:
            temporary.write_text(json.dumps(jsonable(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")

    write()
    text = paragraph(result)
    if task is not None:
        data["task"] = _run_task(arguments, task, result)
        write()
        text += f" {task_text(data['task'])}"
    answer(data, as_json=arguments.json, text=f"{text}\nreport: {arguments.output / 'report.html'}")
    return 0


def _opened(arguments: argparse.Namespace) -> "AcquisitionFile":
    """The session, with what was measured later behind it in time."""
    from ..acquisition import open_acquisition
    from ..acquisition.sessions import merge_sessions, one_layer

    first = open_acquisition(arguments.acquisition)
    if not arguments.also:
        return one_layer(first, arguments.layer)
    merged = one_layer(merge_sessions([first, *(open_acquisition(path) for path in arguments.also)]), arguments.layer)
    series, begins_s, session = [], 0.0, 0
    last_s = 0.0
    for item in merged.series:
        if item.session != session:
            session, begins_s = item.session, last_s + _LATER_S
        time_s = None if item.time_s is None else item.time_s + begins_s
        if time_s is not None:
            last_s = max(last_s, float(time_s[-1]))
        role = item.role if item.session == 0 else "evaluation"
        series.append(replace(item, time_s=time_s, role=role))
    return replace(merged, series=tuple(series))


def _task_of(arguments: argparse.Namespace) -> "tuple[TaskInput, TaskPlan] | None":
    """What `--task` and its companions ask for, checked before the diagnosis begins."""
    from ..errors import InputError

    given = {name: value for name, value in vars(arguments).items() if name.startswith("task_") and value is not None}
    if arguments.task is None:
        if given:
            option = "--" + min(given).replace("_", "-")
            raise InputError(
                option, received="without --task", expected="--task MEASURED, the images to try networks on"
            )
        return None
    from ..acquisition import setting_from_text
    from ..campaign.task import TaskInput, TaskPlan, check_task
    from ..segmentation import choose_device

    settings = {
        side: setting_from_text(given.pop(f"task_{side}")) for side in ("low", "high") if f"task_{side}" in given
    }
    brought = TaskInput(measured=arguments.task, products=given.pop("task_products", None), **settings)
    plan = TaskPlan(**{name.removeprefix("task_"): value for name, value in given.items()}, seed=arguments.seed)
    check_task(brought)
    choose_device(arguments.device)  # says at once how to install torch where it is missing
    return brought, plan


def _run_task(
    arguments: argparse.Namespace, task: "tuple[TaskInput, TaskPlan]", result: "Diagnosis"
) -> dict[str, object]:
    from tqdm import tqdm

    from ..campaign.task import run_task
    from ..segmentation import choose_device

    brought, plan = task
    before = replace(result.twin, effects=tuple(item for item in result.twin.effects if item not in result.added))
    with tqdm(disable=None, bar_format="{desc}") as bar:
        found = run_task(
            before,
            result.twin,
            brought,
            arguments.output / "task",
            plan=plan,
            device=choose_device(arguments.device),
            tell=bar.set_description_str,
        )
    for line in found["warnings"]:
        say(f"warning: {line}")
    return found


def _plan(arguments: argparse.Namespace, twin: "Twin | None") -> int:
    """`--plan`: the distinguishability matrix of the session's series."""
    import numpy as np
    from tqdm import tqdm

    from ..diagnosis.assemble import build_problem
    from ..diagnosis.changes import catalogue_variants
    from ..diagnosis.coarse import UNSEEN, pixels_in_square
    from ..diagnosis.known_effects import already_there
    from ..diagnosis.plan import distinguishability, table_text
    from ..diagnosis.preparation import mislabelled, prepare_session
    from ..files import whole_file
    from ..generator.effects import EFFECTS

    with _opened(arguments) as acquisition, tqdm(disable=None, bar_format="{desc}") as bar:
        session = prepare_session(acquisition, twin=twin, rng=np.random.default_rng(arguments.seed))
        suspects = tuple(item for item in session.suspects if not item.or_effects)
        if suspects:
            raise mislabelled(acquisition, suspects)
        unseen = {**({} if twin is None else already_there(twin.effects)), **(UNSEEN if session.factor > 1 else {})}
        problem = build_problem(
            session.acquisition,
            session.twin,
            variants=catalogue_variants(without=(*arguments.without, *unseen), side=session.factor),
            calibrated_elsewhere=session.calibrated_elsewhere,
            exposed=session.exposed,
            side=session.factor,
            progress=bar.set_description_str,
        )
    found = distinguishability(problem)
    shares = [pixels_in_square(effect, "strength", session.factor) for effect in found.effects]
    found = replace(found, strengths=found.strengths * shares, seen_from=found.seen_from * shares)
    cannot = {**problem.missing_effects, **unseen}
    data = {
        "effects": list(found.effects),
        "since": list(found.since),
        "units": [EFFECTS[effect].strength.unit for effect in found.effects],
        "strengths": found.strengths.tolist(),
        "from_none": found.from_none.tolist(),
        "seen_from": [value if math.isfinite(value) else None for value in found.seen_from.tolist()],
        "between": found.between.tolist(),
        "cannot_be_judged": cannot,
    }
    with whole_file(arguments.output / "plan.json") as temporary:
        temporary.write_text(json.dumps(jsonable(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    missing = [f"{effect} cannot be judged: {reason}" for effect, reason in cannot.items()]
    answer(data, as_json=arguments.json, text="\n".join([table_text(found), *missing]))
    return 0

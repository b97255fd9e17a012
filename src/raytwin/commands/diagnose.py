"""Where the gap between measured and simulated lies, which effect causes it, and how far it shrinks with that effect added.

Any acquisition file will do, from darks and two flats to the full protocol; what it does not allow is said. Writes
diagnosis.json, report.html and twin.h5 (the twin with the effect added) into the folder.
"""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from ._answer import answer, jsonable, say

if TYPE_CHECKING:
    from ..generator.twin import Twin

EXAMPLE = """example:
  raytwin lab -o session.h5 --protocol full --effect object_scatter=10 --seed 1
  raytwin diagnose session.h5 -o diagnosis
  raytwin diagnose session.h5 -o plan --plan
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin diagnose`."""
    parser.add_argument("acquisition", metavar="ACQ", type=Path, help="acquisition file")
    parser.add_argument(
        "--twin", metavar="TWIN", type=Path, help="twin calibrated before (default: from this session's own series)"
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
    parser.add_argument("--seed", type=int, default=0, help="of the random draws (default 0)")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin diagnose`."""
    import numpy as np
    from tqdm import tqdm

    from .. import __version__
    from ..acquisition import open_acquisition
    from ..diagnosis.diagnose import diagnose, diagnosis_answer
    from ..diagnosis.explanation import paragraph
    from ..diagnosis.report import write_report
    from ..errors import InputError
    from ..files import sha256_of_file, whole_file
    from ..generator.effects import EFFECTS
    from ..generator.twin_io import read_twin, write_twin

    for name in arguments.without:
        if name not in EFFECTS:
            raise InputError("--without", received=name, expected="one of " + ", ".join(EFFECTS))
    if arguments.output.exists() and not arguments.output.is_dir():
        raise InputError("-o", received=f"{arguments.output}, a file", expected="a folder, which may not exist yet")
    twin = None if arguments.twin is None else read_twin(arguments.twin)
    if arguments.plan:
        return _plan(arguments, twin)
    with open_acquisition(arguments.acquisition) as acquisition, tqdm(disable=None, bar_format="{desc}") as bar:
        result = diagnose(
            acquisition,
            twin=twin,
            rng=np.random.default_rng(arguments.seed),
            without=arguments.without,
            progress=bar.set_description_str,
        )
    for line in result.warnings:
        say(f"not used: {line}")
    inputs = {
        "acquisition_sha256": sha256_of_file(arguments.acquisition),
        "twin_sha256": None if arguments.twin is None else sha256_of_file(arguments.twin),
        "raytwin_version": __version__,
        "seed": arguments.seed,
    }
    data = diagnosis_answer(result, inputs=inputs)
    arguments.output.mkdir(parents=True, exist_ok=True)
    with whole_file(arguments.output / "twin.h5") as temporary:
        write_twin(temporary, result.twin)
    write_report(result, data, arguments.output / "report.html", version=__version__)
    with whole_file(arguments.output / "diagnosis.json") as temporary:
        temporary.write_text(json.dumps(jsonable(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    answer(data, as_json=arguments.json, text=f"{paragraph(result)}\nreport: {arguments.output / 'report.html'}")
    return 0


def _plan(arguments: argparse.Namespace, twin: "Twin | None") -> int:
    """`--plan`: the distinguishability matrix of the session's series."""
    import numpy as np
    from tqdm import tqdm

    from ..acquisition import open_acquisition
    from ..diagnosis.assemble import build_problem
    from ..diagnosis.changes import catalogue_variants
    from ..diagnosis.diagnose import calibrated_twin
    from ..diagnosis.plan import distinguishability, table_text
    from ..files import whole_file

    with open_acquisition(arguments.acquisition) as acquisition, tqdm(disable=None, bar_format="{desc}") as bar:
        known = twin or calibrated_twin(acquisition, rng=np.random.default_rng(arguments.seed))
        problem = build_problem(
            acquisition,
            known,
            variants=catalogue_variants(without=arguments.without),
            calibrated_elsewhere=twin is not None,
            progress=bar.set_description_str,
        )
    found = distinguishability(problem)
    data = {
        "effects": list(found.effects),
        "strengths": found.strengths.tolist(),
        "from_none": found.from_none.tolist(),
        "between": found.between.tolist(),
        "cannot_be_judged": dict(problem.missing_effects),
    }
    arguments.output.mkdir(parents=True, exist_ok=True)
    with whole_file(arguments.output / "plan.json") as temporary:
        temporary.write_text(json.dumps(jsonable(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    missing = [f"{effect} cannot be judged: {reason}" for effect, reason in problem.missing_effects.items()]
    answer(data, as_json=arguments.json, text="\n".join([table_text(found), *missing]))
    return 0

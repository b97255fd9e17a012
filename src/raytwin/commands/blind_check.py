"""The diagnosis on sealed cases: names, strengths and probabilities against what the virtual lab knows.

Labels are drawn from the seed, hashed (the hash is printed first) and kept from disk until every answer is in and hashed
too. Each session is diagnosed by a process of its own that gets the acquisition file and nothing else. Writes scores.json,
cases.csv and report.html into the folder; a run that was stopped goes on where it was.
"""

import argparse
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from ..api._folder import check_effects, written_folder
from ._answer import answer, say

EXAMPLE = """examples:
  raytwin blind-check -n 600 --seed 123456 -o blind --train-cases 300 --workers 2
  raytwin blind-check -n 100 --seed 123457 -o withheld --leave-one-out
  raytwin blind-check -n 20 --seed 7 -o trial --size 64 --only A --development
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin blind-check`."""
    parser.add_argument("-n", "--cases", type=int, required=True, metavar="N", help="how many cases")
    parser.add_argument("--seed", type=int, required=True, help="of the cases; fresh, not one that was developed with")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder of the check")
    parser.add_argument(
        "--size", type=int, default=128, metavar="N", help="rows and columns of the detector (default 128)"
    )
    parser.add_argument("--frames", type=int, metavar="K", help="frames a series (default: the protocol's)")
    parser.add_argument("--workers", type=int, default=1, metavar="W", help="cases at once (default 1)")
    parser.add_argument(
        "--without", metavar="ID", action="append", default=[], help="leave an effect out of the catalogue; repeatable"
    )
    parser.add_argument(
        "--leave-one-out",
        action="store_true",
        help="every case has one effect of the catalogue, which is withheld from its diagnosis",
    )
    parser.add_argument(
        "--only",
        metavar="SETS",
        nargs="+",
        default=[],
        help="draw effects from these sets (A to E) or ids alone",
    )
    parser.add_argument(
        "--train-cases",
        type=int,
        default=0,
        metavar="M",
        help="more cases, with other seeds, to teach the baselines that learn (default 0: those are left out)",
    )
    parser.add_argument(
        "--second-day",
        action="store_true",
        help="measure each line on another day too and see how far the improved twin shrinks the gap there (twice the time)",
    )
    parser.add_argument("--keep-sessions", action="store_true", help="keep the acquisition files (some 50 MB each)")
    parser.add_argument(
        "--development", action="store_true", help="allow a seed that was developed with; the report says so"
    )
    parser.add_argument("--json", action="store_true", help="print the scores as JSON")


def _interrupt(number: int, frame: object) -> None:
    """End as a key press does: processes are stopped, nothing half done is recorded."""
    raise KeyboardInterrupt


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin blind-check`."""
    from tqdm import tqdm

    from .. import __version__
    from ..campaign.blind_check import (
        BlindOptions,
        Processes,
        begin_check,
        frozen_code,
        open_check,
        run_check,
        unanswered,
    )
    from ..campaign.blind_report import summary_text, write_report
    from ..campaign.blind_results import case_rows, score_check, write_cases
    from ..errors import InputError
    from ..files import write_json
    from ..generator.effects import EFFECTS

    check_effects("--without", arguments.without, tuple(EFFECTS))
    if arguments.workers < 1:
        raise InputError("--workers", received=arguments.workers, expected="1 or more")
    options = BlindOptions(
        cases=arguments.cases,
        seed=arguments.seed,
        size=arguments.size,
        frames=arguments.frames,
        without=tuple(arguments.without),
        leave_one_out=arguments.leave_one_out,
        only=tuple(arguments.only),
        train_cases=arguments.train_cases,
        second_day=arguments.second_day,
    )
    folder: Path = arguments.output
    with written_folder(folder):
        pass
    seal, cases = begin_check(folder, options, development=arguments.development)
    say(f"sealed: {len(cases)} labels, sha256 {seal}")
    sys.stderr.flush()
    bar: Any = None

    def begin(count: int) -> None:
        nonlocal bar
        bar = tqdm(total=len(cases), initial=len(cases) - count, unit="case", disable=None, desc="sealed cases")

    def advance() -> None:
        bar.update()

    previous = signal.signal(signal.SIGTERM, _interrupt) if _in_main_thread() else None
    try:
        if unanswered(folder, cases):
            with frozen_code(folder) as code:
                run_check(
                    folder,
                    options,
                    cases,
                    Processes(options, code=code).work(),
                    workers=arguments.workers,
                    keep_sessions=arguments.keep_sessions,
                    begin=begin,
                    advance=advance,
                )
    finally:
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)
        if bar is not None:
            bar.close()
    check = open_check(folder, options, cases)
    if len(check.versions) > 1:
        say(f"the answers come from {len(check.versions)} versions of the code: it was changed while the check ran")
    result = score_check(check)
    rows = case_rows(check, result.outcomes)
    write_cases(folder / "cases.csv", rows)
    write_json(folder / "scores.json", result.scores)
    write_report(result, rows, folder / "report.html", version=__version__)
    answer(
        result.scores,
        as_json=arguments.json,
        text=f"{summary_text(result)}\nreport: {folder / 'report.html'}",
    )
    return 0

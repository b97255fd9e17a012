"""The diagnosing process of a blind check: it gets one acquisition file and writes what it thinks of it.

It runs in a folder of its own with a clean environment. It cannot look for the answer: importing the virtual lab, starting
another process, opening a connection or reading what belongs to another process is refused.
"""

import argparse
import json
import re
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from ._leash import line_from_parent

_SEED = 0  # of the diagnosis' own draws; says nothing about the case
_REFUSED = frozenset(
    (
        "subprocess.Popen",
        "os.system",
        "os.exec",
        "os.fork",
        "os.forkpty",
        "os.posix_spawn",
        "socket.connect",
        "pty.spawn",
    )
)
_HARMLESS = frozenset(("uname", "ldconfig", "lscpu"))  # libraries ask these about the machine when they are imported
_OTHER_PROCESS = re.compile(r"/proc/\d+/")


class BlindnessError(RuntimeError):
    """The diagnosing process reached for something that it may not see."""


def refuse_to_peek() -> None:
    """From now on this process may not import the lab, start processes, connect, or look into other processes."""

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "subprocess.Popen" and Path(str(arguments[1][0])).name in _HARMLESS:
            return
        if event in _REFUSED:
            raise BlindnessError(f"{event} is refused while a sealed case is diagnosed")
        if event == "import" and re.search(r"(^|\.)raytwin\.lab(\.|$)", str(arguments[0])):
            raise BlindnessError("the virtual lab is closed while a sealed case is diagnosed")
        if event == "open" and isinstance(arguments[0], str) and _OTHER_PROCESS.match(arguments[0]):
            raise BlindnessError(f"{arguments[0]} belongs to another process")

    sys.addaudithook(hook)


def judge_session(
    path: Path, *, without: list[str], features_only: bool, statistics_path: Path, second: Path | None = None
) -> dict[str, Any]:
    """The answer of `diagnose` for a session, with features for the baselines; inner products go to `statistics_path`.

    Args:
        path: acquisition file.
        without: effects to leave out of the catalogue.
        features_only: assemble probes but weigh no hypotheses.
        statistics_path: `.npz` file to write.
        second: acquisition file of another day, on which the improved twin is tried.
    """
    import numpy as np

    from ..acquisition import open_acquisition
    from ..diagnosis.diagnose_session import diagnose
    from ..diagnosis.judgement.answer import diagnosis_answer
    from ..diagnosis.problem.assemble import problem_of
    from ..diagnosis.session.preparation import prepare_session
    from .blind_code import code_digest
    from .blind_second_day import second_day_shrinkage
    from .blind_statistics import session_features, session_statistics, write_statistics

    result: dict[str, Any] = {"answer": None, "code_sha256": code_digest()}
    start = time.perf_counter()
    with open_acquisition(path) as acquisition:
        rng = np.random.default_rng(_SEED)
        if features_only:
            prepared = prepare_session(acquisition, twin=None, rng=rng)
            problem = problem_of(prepared)
        else:
            found = diagnose(acquisition, rng=rng, without=without)
            problem = found.compared
            result["answer"] = diagnosis_answer(found, inputs={"seed": _SEED})
        result["seconds"] = time.perf_counter() - start
        result["peak_memory_MB"] = _peak_memory_MB()
        # from here on nothing touches the answer any more
        try:
            if without and not features_only:
                # what was withheld must have a response too, to say afterwards how far it lay from all the others
                prepared = prepare_session(acquisition, twin=replace(found.twin, effects=()), rng=rng)
                problem = problem_of(prepared)
            result["features"] = session_features(problem)
            write_statistics(statistics_path, session_statistics(problem))
            if second is not None and not features_only:
                with open_acquisition(second) as another:
                    result["shrinkage_found"] = second_day_shrinkage(another, found.twin, found.added, without=without)
        except Exception as error:
            result["statistics_error"] = f"{type(error).__name__}: {error}"
    return result


def _peak_memory_MB() -> float | None:
    """Of this process so far; None where the system does not say."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> int:
    """Diagnose the file named on the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("acquisition", type=Path)
    parser.add_argument("--without", action="append", default=[])
    parser.add_argument("--features-only", action="store_true")
    parser.add_argument("--second", type=Path)
    words = parser.parse_args()
    line_from_parent()
    refuse_to_peek()
    from ._plain import plain

    result = judge_session(
        words.acquisition,
        without=words.without,
        features_only=words.features_only,
        statistics_path=Path("statistics.npz"),
        second=words.second,
    )
    Path("answer.json").write_text(json.dumps(plain(result), allow_nan=False), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

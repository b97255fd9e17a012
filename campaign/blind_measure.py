"""The measuring process of a blind check: one case from standard input, one acquisition file, no truth left behind."""

import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ._leash import line_from_parent


def measure_case(label: Mapping[str, Any], path: Path, *, size: int, frames: int | None, session: int = 0) -> None:
    """Measure the session of a label in the virtual lab; the truth is not kept.

    Args:
        label: as it is sealed.
        path: acquisition file to write.
        size: rows and columns of the detector.
        frames: frames a series; None: what is usual.
        session: another number is another day on the same line.
    """
    from ..lab.protocols import run_protocol
    from .blind_cases import case_from_label

    case = case_from_label(label)
    with tempfile.TemporaryDirectory() as folder:
        run_protocol(
            path,
            seed=case.session_seed,
            rows=size,
            columns=size,
            frames=frames,
            session=session,
            truth_file=Path(folder) / "truth.json",
            **case.case.arguments(),
        )


def main() -> int:
    """Read `{"label", "path", "size", "frames", "session"}`, one line of standard input, and measure."""
    task = json.loads(line_from_parent())
    measure_case(
        task["label"], Path(task["path"]), size=task["size"], frames=task["frames"], session=task.get("session", 0)
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())

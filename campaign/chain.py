"""Commands of raytwin run in order, each answer kept, so that a run that was stopped goes on where it was."""

import contextlib
import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import InputError, RaytwinError
from ..files import whole_file

Run = Callable[[Sequence[str]], int]
Tell = Callable[[str], None]


@dataclass(slots=True)
class Chain:
    """Runs commands in order; keeps each answer in DIR/answers and the words that produced it.

    Fields: directory; run (runs one raytwin command given as words and returns its exit code); tell (shows one line of
    progress); commands (records of those that were run or found).
    """

    directory: Path
    run: Run
    tell: Tell
    commands: list[dict[str, Any]] = field(default_factory=list)

    def path(self, name: str) -> str:
        """A file of the chain's folder, as a word of a command."""
        return str(self.directory / name)

    def step(self, name: str, words: Sequence[str], *, outputs: Sequence[str] = ()) -> dict[str, Any]:
        """Answer of a command, from the last run where that is complete.

        Raises:
            RaytwinError: the command failed.
        """
        text = "raytwin " + " ".join(words).replace(f"{self.directory}/", "")
        kept = self.directory / "answers" / f"{name}.json"
        if kept.exists() and all(Path(self.path(output)).exists() for output in outputs):
            record: dict[str, Any] = json.loads(kept.read_text())
            if record.get("command") == text:
                self.commands.append(record)
                return dict(record["answer"])
        self.tell(text)
        started = time.monotonic()
        answer = io.StringIO()
        with contextlib.redirect_stdout(answer):
            code = self.run([*words, "--json"])
        if code != 0:
            raise RaytwinError(f"the step `{text}` failed (exit code {code}); its message stands above")
        record = {
            "command": text,
            "seconds": round(time.monotonic() - started, 1),
            "answer": json.loads(answer.getvalue()),
        }
        with whole_file(kept) as temporary:
            temporary.write_text(json.dumps(record))
        self.commands.append(record)
        return dict(record["answer"])

    def step_or_reason(self, name: str, words: Sequence[str]) -> dict[str, Any]:
        """As `step`; where the command refuses, why, as a warning."""
        try:
            return self.step(name, words)
        except RaytwinError as error:
            self.tell(f"no answer of {name}: {error}")
            return {"warnings": [str(error)]}


def claim_folder(directory: Path, plan: Mapping[str, Any], *, what: str) -> None:
    """Make a folder that of one plan, or find it so.

    Args:
        directory: made if absent.
        plan: what decides all that the folder will hold, as JSON can hold it.
        what: what the folder is of, for the message (`a demo`).

    Raises:
        InputError: it holds files of another plan, or other files.
    """
    directory.mkdir(parents=True, exist_ok=True)
    fingerprint = json.dumps(plan, sort_keys=True)
    kept = directory / "plan.json"
    if kept.exists() and kept.read_text() != fingerprint:
        raise InputError(
            "-o",
            received=f"{directory}, {what} of another plan",
            expected="a new folder, or the same options as before",
        )
    if not kept.exists():
        if any(directory.iterdir()):
            raise InputError("-o", received=f"{directory}, a folder with files in it", expected="a new or empty folder")
        with whole_file(kept) as temporary:
            temporary.write_text(fingerprint)

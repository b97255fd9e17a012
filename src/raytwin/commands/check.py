"""What measurements allow, what is suspicious about them, and what to measure next: the first look at your own data.

Reads an acquisition file, a folder that `raytwin import` knows (or one of bare images, for which a sidecar is drafted), or
a twin. Nothing is fitted and nothing is written. Exit code 0 whatever is found; findings of severity `error` mislead a
calibration or stop it.
"""

import argparse
import shutil
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ._answer import answer, say

if TYPE_CHECKING:
    from ..checks.check_result import CheckResult
    from ..checks.findings import Finding

EXAMPLE = """example:
  raytwin check session.h5
  raytwin check measured/emva_ccd
  raytwin check twin.h5 --json
"""
_MOST_ROWS = 40
_MARKS = {"error": "ERROR  ", "warning": "warning", "note": "note   "}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin check`."""
    parser.add_argument("path", metavar="ACQ|FOLDER|TWIN", help="acquisition file, folder or twin")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin check`."""
    from ..api._progress import Bar
    from ..api.sessions import check

    with Bar(only_on_terminal=True) as bar:
        result = check(arguments.path, progress=bar)
    answer(result.to_dict(), as_json=arguments.json, text=text_of(result))
    return 0


def say_short(findings: "Sequence[Finding]") -> None:
    """The short form that an import ends with: the findings that matter, one line each, on standard error."""
    told = [item for item in findings if item.severity != "note"]
    for item in told[:8]:
        say(f"{item.severity}: {item.series + ': ' if item.series else ''}{item.text}")
    if len(told) > 8:
        say(f"{len(told) - 8} more findings (`raytwin check` shows all)")


def text_of(result: "CheckResult", width: int | None = None) -> str:
    """The answer for people."""
    columns = width or min(max(shutil.get_terminal_size((100, 24)).columns, 72), 132)
    counts = result.counts
    told = ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items() if count)
    lines = [f"{result.path}: {result.what}, {len(result.series)} series; {told or 'nothing suspicious'}"]
    if result.series:
        lines += ["", *_table(result)]
    if result.findings:
        lines += ["", "What is suspicious"]
        # one sentence that holds for many series is said once
        grouped: dict[tuple[str, str], list[str]] = {}
        for item in result.findings:
            grouped.setdefault((str(item.severity), item.text), []).append(item.series)
        for (severity, text), series in grouped.items():
            named = [name for name in series if name]
            who = ", ".join(named[:3]) + (f" and {len(named) - 3} more" if len(named) > 3 else "")
            lines += _wrapped(f"  {_MARKS[severity]} ", f"{who}: {text}" if who else text, columns)
    able = [item for item in result.allows if item.possible]
    unable = [item for item in result.allows if not item.possible]
    for title, items in (("What it allows", able), ("What it does not allow", unable)):
        if items:
            lines += ["", title]
            for one in items:
                lines += _wrapped("  - ", f"{one.what}: {one.why}", columns)
    if result.next_measurements:
        lines += ["", "What to measure or write down next"]
        for number, text in enumerate(result.next_measurements, start=1):
            lines += _wrapped(f"  {number}. ", text, columns)
    if result.draft:
        lines += ["", result.draft.rstrip("\n")]
    return "\n".join(lines)


def _wrapped(start: str, text: str, columns: int) -> list[str]:
    return textwrap.wrap(
        text, columns, initial_indent=start, subsequent_indent=" " * len(start), break_on_hyphens=False
    )


def _table(result: "CheckResult") -> list[str]:
    head = ("series", "kind", "frames", "level", "noise", "setting", "serves for")
    rows: list[tuple[str, ...]] = [
        (
            row.name,
            row.kind,
            f"{row.frames}" if row.frames else "",
            _number(row.level_DN),
            _number(row.noise_DN),
            row.setting,
            ", ".join(row.serves_for) or "nothing as it stands",
        )
        for row in result.series[:_MOST_ROWS]
    ]
    used = [index for index in range(len(head)) if any(row[index] for row in rows)]
    widths = {index: max(len(head[index]), *(len(row[index]) for row in rows)) for index in used}

    def line(cells: tuple[str, ...]) -> str:
        numeric = (2, 3, 4)
        return "  ".join(
            cells[index].rjust(widths[index]) if index in numeric else cells[index].ljust(widths[index])
            for index in used
        ).rstrip()

    lines = [line(head), *(line(row) for row in rows)]
    if len(result.series) > _MOST_ROWS:
        lines.append(f"and {len(result.series) - _MOST_ROWS} more series (all of them with --json)")
    return lines


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if abs(value) < 1e5 else f"{value:.0f}"

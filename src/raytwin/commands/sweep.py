"""Choose a setting by its a90: images, networks, hits and POD for every setting of a campaign file, and one recommended.

CAMPAIGN.toml names a twin, reference images, the settings (a list, a grid or both), limits of tube, belt, dose and throughput,
and how networks are trained (docs/campaigns.md has an example and every word). Settings that line, limits or references rule
out are rows with the reason. Writes sweep.json, sweep.csv and report.html into the folder; a sweep that was stopped goes on
where it was, and only what a changed campaign changes is done again.
"""

import argparse
import signal
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError
from ._answer import answer, say

EXAMPLE = """examples:
  raytwin sweep campaign.toml --plan
  raytwin sweep campaign.toml -o sweep --workers 2
  raytwin sweep campaign.toml -o sweep --scheduler tcp://10.0.0.1:8786
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin sweep`."""
    parser.add_argument("campaign", metavar="CAMPAIGN.toml", type=Path, help="what is asked (docs/campaigns.md)")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, help="folder of the sweep, new or to go on with")
    parser.add_argument(
        "--plan",
        action="store_true",
        help="train nothing: print feasibility, dose, throughput and contrast-to-noise of every setting, and the a90 that an observer"
        " named under [screening] expects",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=int, default=1, metavar="N", help="settings at once, a process each (default 1)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster that sees the same files: tcp://host:8786 or its file"
    )
    parser.add_argument("--device", default="auto", help="auto (default: a GPU where there is one), cpu, cuda, mps")
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="processor threads of a setting (default 1); may change last digits",
    )
    parser.add_argument("--keep-images", action="store_true", help="keep the images generated for each setting")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin sweep`."""
    from ..api._progress import Bar
    from ..api.campaigns import SweepPlan, sweep
    from ..campaign.sweep_report import by_upper_bound

    if arguments.output is None and not arguments.plan:
        raise InputError("-o", received="none", expected="a folder for the sweep, or --plan to look ahead only")
    main_thread = threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGTERM, _interrupt) if main_thread else None
    counts: list[int] = []
    try:
        with Bar(only_on_terminal=True, unit="setting") as bar:

            def told(stage: str, done: int, total: int | None) -> None:
                bar(stage, done, total)
                if stage == "settings" and bar.hidden:
                    if not counts and done:
                        say(f"{done} of {total} settings are done already")
                    counts[:] = (done, total or 0)  # a screened sweep learns round by round how many there are

            def finished(row: Mapping[str, Any]) -> None:
                if bar.hidden and counts:
                    say(f"[{counts[0]}/{counts[1]}] {row['label']}: {_told(row)}")

            found = sweep(
                arguments.campaign,
                output=arguments.output,
                plan_only=arguments.plan,
                workers=arguments.workers,
                scheduler=arguments.scheduler,
                device=arguments.device,
                threads=arguments.threads,
                keep_images=arguments.keep_images,
                progress=told,
                tell=say,
                each=finished,
            )
    finally:
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)
    result = found.to_dict()
    if isinstance(found, SweepPlan):
        rows = result["rows"]
        count = f"{len(rows)} setting{'s' * (len(rows) != 1)}"
        lines = [
            *_plan_lines(rows),
            *(f"warning: {text}" for text in result["warnings"]),
            f"{count}, {result['feasible']} feasible, {result['to_train']} to train",
        ]
    else:
        lines = [*_result_lines(by_upper_bound(result["rows"]), result["other_size"]), result["sentence"]]
        lines += _measurement_lines(result["decision"])
        lines.append(f"report: {result['paths']['report']}")
    answer(result, as_json=arguments.json, text="\n".join(lines))
    return 0


def _interrupt(number: int, frame: object) -> None:
    """End as a key press does: processes are stopped, nothing half done counts."""
    raise KeyboardInterrupt


def _told(row: Mapping[str, Any]) -> str:
    if row["a90"] is None:
        return str(row["reason"])
    if row["a90_low"] is None and row["a90_high"] is None:
        return f"a90 {row['a90']:.3g}, no interval"
    return f"a90 {row['a90']:.3g} ({_shown(row['a90_low'])} to {_shown(row['a90_high'])})"


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], notes: Sequence[str]) -> list[str]:
    """Columns as wide as they must be; the notes stand behind them."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    shown = []
    for number, (line, note) in enumerate(zip(lines, ["", *notes], strict=True)):
        cells = [
            line[0].ljust(widths[0]),
            *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)),
        ]
        shown.append(("  ".join(cells) + (f"  {note}" if note and number else "")).rstrip())
    return shown


def _costs(row: Mapping[str, Any]) -> list[str]:
    dose = (row["dose_uGy"] or {}).get("value")
    return [_shown(row["throughput_per_s"]), _shown(row["motion_px"]), _shown(dose), _shown(row["cnr_object"])]


def _plan_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    header = ["setting", "products/s", "motion px", "dose uGy", "CNR"]
    seen = any(row["predicted"] is not None for row in rows)
    if seen:
        header += ["a90", "low", "high"]
    body = []
    for row in rows:
        expected = row["predicted"] or {}
        ends = [_shown(expected.get(name)) for name in ("value", "low", "high")] if seen else []
        body.append([str(row["label"]), *_costs(row), *ends])
    return [*_table(header, body, [_note(row, []) for row in rows]), *_warning_lines(rows)]


def _warning_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Each warning once, with the first of the feasible settings that it is of and how many more there are."""
    of: dict[str, list[str]] = {}
    for row in rows:
        if row["feasible"]:
            for text in row["warnings"]:
                of.setdefault(str(text), []).append(str(row["label"]))
    return [
        f"warning: {labels[0]}{f' and {len(labels) - 1} more' if len(labels) > 1 else ''}: {text}"
        for text, labels in of.items()
    ]


def _note(row: Mapping[str, Any], marks: Sequence[str]) -> str:
    """Why a setting has no a90, its verdict on the requirement, and other marks."""
    verdict = {None: "", "meets": "meets the requirement"}.get(row["verdict"], str(row["verdict"]))
    return ", ".join(part for part in (str(row["reason"]), verdict, *marks) if part)


def _result_lines(rows: Sequence[Mapping[str, Any]], other_size: str) -> list[str]:
    body, notes = [], []
    for row in rows:
        alarms = row["false_alarm_rate"]
        expected, other = row["predicted"] or {}, row["other_size"] or {}
        body.append(
            [
                str(row["label"]),
                _shown(row["a90"]),
                _shown(row["a90_low"]),
                _shown(row["a90_high"]),
                _shown(row["a90_upper"]),
                _shown(other.get("a90")),
                _shown(expected.get("value")),
                "-" if alarms is None else f"{100 * alarms['value']:.3g} %",
                *_costs(row),
            ]
        )
        marks = [word for word in ("recommended", "pareto", "alike") if row[word]]
        notes.append(_note(row, marks))
    other_name = "a90 mm" if other_size == "size_mm" else "a90 contrast"
    header = ["setting", "a90", "low", "high", "a90/95", other_name, "expected"]
    header += ["false al.", "products/s", "motion px", "dose uGy", "CNR"]
    # columns that no setting fills are left out
    kept = [
        0,
        *(
            column
            for column in range(1, len(header))
            if column not in (5, 6) or any(line[column] != "-" for line in body)
        ),
    ]
    return _table([header[column] for column in kept], [[line[column] for column in kept] for line in body], notes)


def _measurement_lines(decision: Mapping[str, Any] | None) -> list[str]:
    if decision is None or not decision["measurements"]:
        return []
    return ["To be surer, measure on the real line:", *(f"  {one['text']}" for one in decision["measurements"])]

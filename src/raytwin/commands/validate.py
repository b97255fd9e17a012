"""Compare a twin's predictions with measured flats and wedges, series by series.

Series held back for evaluation are compared where there are any, else all flats; wedges and slabs with thickness maps by
their transmissions. Intervals include the measured series' own sampling noise. With `--leave-one-out` the spectrum is also
fitted again without each of the twin's levels in turn, which is then predicted from the others.
"""

import argparse
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import whole_file
from ._answer import answer, say
from ._twin_file import HELP, twin_file

EXAMPLE = """example:
  raytwin validate twin.h5 session.h5
  raytwin validate twin.h5 session.h5 --leave-one-out --plot errors.png
"""

_FORMATS = (".png", ".pdf", ".svg")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin validate`."""
    parser.add_argument("twin", metavar="TWIN", type=twin_file, help=HELP)
    parser.add_argument("acquisition", metavar="ACQ", type=Path, help="acquisition file with flats")
    parser.add_argument(
        "--layer",
        choices=("front", "back"),
        help="of a dual-layer panel, by the series' attribute `layer` (default: the twin's, front without one)",
    )
    parser.add_argument(
        "--leave-one-out", action="store_true", help="predict each level of the twin from its other levels"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the fits that leave a level out (default 0)")
    parser.add_argument("--plot", metavar="FILE", type=Path, help="draw the errors (png, pdf or svg)")
    parser.add_argument("--report", metavar="PAGE.html", type=Path, help="write the answer as a page")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin validate`."""
    from ..api._progress import Bar
    from ..api.reports import checked_page, report
    from ..api.twins import validate
    from ..calibration.validate import plot_validation

    if arguments.plot is not None and arguments.plot.suffix.lower() not in _FORMATS:
        raise InputError("--plot", received=arguments.plot.name, expected="a name that ends in " + ", ".join(_FORMATS))
    if arguments.report is not None:
        checked_page(arguments.report, argument="--report")
    with Bar(only_on_terminal=True, unit="level") as bar:
        found = validate(
            arguments.twin,
            arguments.acquisition,
            layer=arguments.layer,
            leave_one_out=arguments.leave_one_out,
            seed=arguments.seed,
            progress=bar,
        )
    if found.left_out == ():
        say("nothing can be left out: fewer than two levels with kV and tube load")
    result = found.to_dict()
    for line in result["skipped"]:
        say(f"skipped: {line}")
    if arguments.plot is not None:
        with whole_file(arguments.plot) as temporary:
            plot_validation(found).savefig(temporary, format=arguments.plot.suffix[1:].lower(), dpi=150)
        result["plot"] = str(arguments.plot)
    if arguments.report is not None:
        result["report"] = str(report(found, arguments.report))
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _text(result: dict[str, Any]) -> str:
    lines = _table(result["rows"]) if result["rows"] else []
    if result["rows"]:
        lines.append(_summary(result))
        seen = sum(row["used_in_calibration"] for row in result["rows"])
        if seen:
            lines.append(
                f"{seen} of {len(result['rows'])} series calibrated this twin: their errors say how well it fits, not how well it"
                " predicts (hold series back with role = evaluation, or say --leave-one-out)"
            )
    if "wedges" in result:
        lines.append(f"{'wedge':<52} {'measured':>9} {'predicted (95 %)':>28}  inside")
        for row in result["wedges"]["rows"]:
            value = row["transmission"]
            lines.append(
                f"{row['kV']:g} kV {row['layers']} ({row['series']})".ljust(52)
                + f" {row['measured_transmission']:9.4f} {value['value']:.4f} ({value['low']:.4f}-{value['high']:.4f})".ljust(
                    39
                )
                + f"  {'yes' if row['inside'] else 'NO'}"
            )
        lines.append(
            f"median error {result['wedges']['median_abs_error_percent']:.2f} %; inside the interval:"
            f" {100 * result['wedges']['coverage']:.0f} % of {len(result['wedges']['rows'])} steps"
        )
    if result.get("leave_one_out", {}).get("rows"):
        lines.append("each level predicted from the others:")
        lines += _table(result["leave_one_out"]["rows"])
        lines.append(_summary(result["leave_one_out"]))
    if "plot" in result:
        lines.append(f"errors drawn in {result['plot']}")
    return "\n".join(lines)


def _table(rows: list[dict[str, Any]]) -> list[str]:
    lines = [f"{'setting':<52} {'mean DN':>9} {'predicted (95 %)':>28} {'sd DN':>8} {'predicted (95 %)':>26}  inside"]
    for row in rows:
        mean, sd = row["mean_DN"], row["sd_DN"]
        inside = "/".join({True: "yes", False: "NO", None: "-"}[row["inside"][name]] for name in ("mean", "sd"))
        measured_sd = "-" if row["measured_sd_DN"] is None else f"{row['measured_sd_DN']:.2f}"
        lines.append(
            f"{row['setting']:<52} {row['measured_mean_DN']:9.1f} "
            f"{mean['value']:9.1f} ({mean['low']:.1f}-{mean['high']:.1f})".ljust(90)
            + f" {measured_sd:>8} {sd['value']:8.2f} ({sd['low']:.2f}-{sd['high']:.2f})".ljust(36)
            + f"  {inside}"
        )
    return lines


def _summary(result: dict[str, Any]) -> str:
    error, coverage = result["median_abs_error_percent"], result["coverage"]
    parts = [
        f"{name}: median error {error[name]:.2f} %, inside the interval {100 * coverage[name]:.0f} %"
        for name in ("mean", "sd")
        if error[name] is not None
    ]
    return f"{'; '.join(parts)} ({coverage['rows']} series)"

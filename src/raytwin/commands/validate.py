"""Compare a twin's predictions with measured flats, series by series.

Series held back for evaluation are compared where there are any, else all flats. Intervals include the measured series'
own sampling noise.
"""

import argparse
from pathlib import Path
from typing import Any

from ._answer import answer, say

EXAMPLE = """example:
  raytwin validate twin.h5 session.h5
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin validate`."""
    parser.add_argument("twin", metavar="TWIN", type=Path, help="twin file")
    parser.add_argument("acquisition", metavar="ACQ", type=Path, help="acquisition file with flats")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin validate`."""
    from ..acquisition import open_acquisition
    from ..calibration.validate import validate_twin
    from ..generator.twin_io import read_twin

    twin = read_twin(arguments.twin)
    with open_acquisition(arguments.acquisition) as acquisition:
        result = validate_twin(twin, acquisition).as_dict()
    for line in result["skipped"]:
        say(f"skipped: {line}")
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _text(result: dict[str, Any]) -> str:
    lines = [f"{'setting':<52} {'mean DN':>9} {'predicted (95 %)':>28} {'sd DN':>8} {'predicted (95 %)':>26}  inside"]
    for row in result["rows"]:
        mean, sd = row["mean_DN"], row["sd_DN"]
        inside = ("yes" if row["inside"]["mean"] else "NO") + "/" + ("yes" if row["inside"]["sd"] else "NO")
        lines.append(
            f"{row['setting']:<52} {row['measured_mean_DN']:9.1f} "
            f"{mean['value']:9.1f} ({mean['low']:.1f}-{mean['high']:.1f})".ljust(90)
            + f" {row['measured_sd_DN']:8.2f} {sd['value']:8.2f} ({sd['low']:.2f}-{sd['high']:.2f})".ljust(36)
            + f"  {inside}"
        )
    error, coverage = result["median_abs_error_percent"], result["coverage"]
    lines.append(
        f"median error: mean {error['mean']:.2f} %, sd {error['sd']:.2f} %; inside the interval: mean"
        f" {100 * coverage['mean']:.0f} %, sd {100 * coverage['sd']:.0f} % of {coverage['rows']} series"
    )
    return "\n".join(lines)

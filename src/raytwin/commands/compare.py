"""Are two POD curves the same? Difference and ratio of a90 with intervals, a test of the whole curves, and a verdict.

The verdict is that of two one-sided tests at the margin: `equivalent` when the 90 % interval of the ratio of the two
a90 lies within 1 / (1 + margin) and 1 + margin, `different` when its 95 % interval excludes 1, `different within the
margin` when both hold, else `inconclusive`. Images and networks of the same name in both tables pair the comparison.
"""

import argparse
from pathlib import Path
from typing import Any

from ..api.comparisons import compare
from ..files import whole_file
from ._answer import answer, say
from ._pod_answer import shown, where_from_options

EXAMPLE = """examples:
  raytwin compare REAL.csv GENERATED.csv --margin 0.1 --json
  raytwin compare BEFORE.csv AFTER.csv --size size_mm --log-size --where setting=20ms
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("first", metavar="REAL.csv")
    parser.add_argument("second", metavar="GENERATED.csv")
    parser.add_argument("--margin", type=float, default=0.1, help="margin on a90 as a share of it (default 0.1)")
    parser.add_argument(
        "--size-margin",
        type=float,
        metavar="SIZE",
        help="also a margin on the difference of the two a90, in the tables' unit",
    )
    parser.add_argument("--size", metavar="COLUMN", help="default: contrast, size, size_mm, ... the first there")
    parser.add_argument("--hit", metavar="COLUMN", help="0 or 1; default: hit")
    parser.add_argument("--trials", metavar="COLUMN", help="number of trials of each row (grouped data)")
    parser.add_argument(
        "--link",
        choices=("cloglog", "loglog", "logit", "probit"),
        help="default: cloglog, with the bounds of all links that fit where another fits better",
    )
    parser.add_argument("--log-size", action="store_true", help="curves on the logarithm of the size")
    parser.add_argument("--method", choices=("ml", "firth"))
    parser.add_argument("--repeats", choices=("crossed", "scaled", "cluster", "pooled"))
    parser.add_argument("--site", metavar="COLUMN", help="the inspected site")
    parser.add_argument("--where", metavar="COLUMN=VALUE", action="append", default=[], help="only these rows of both")
    parser.add_argument("--unpaired", action="store_true", help="take equal names of images and networks as chance")
    parser.add_argument("--plots", metavar="DIR", help="write the figure of both curves")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    found = compare(
        arguments.first,
        arguments.second,
        margin=arguments.margin,
        size_margin=arguments.size_margin,
        size=arguments.size,
        hit=arguments.hit,
        trials=arguments.trials,
        site=arguments.site,
        where=where_from_options(arguments.where),
        link=arguments.link,
        log_size=arguments.log_size or None,
        method=arguments.method,
        repeats=arguments.repeats,
        unpaired=arguments.unpaired,
    )
    result = found.to_dict()
    if arguments.plots:
        from ..pod.plots import plot_comparison

        figure = plot_comparison(found.comparison, size_label=found.size_name, names=found.names)
        path = Path(arguments.plots) / "compare.png"
        with whole_file(path) as temporary:
            figure.savefig(temporary, format="png", dpi=150)
        result["plots"] = [str(path)]
    for line in result["warnings"]:
        say(f"warning: {line}")
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _text(result: dict[str, Any]) -> str:
    lines = [
        f"a90 {shown(result['first']['a90'])} (first), {shown(result['second']['a90'])} (second), {result['size']}",
    ]
    for label, key in (("difference, second - first", "difference_a90"), ("ratio, second / first", "ratio_a90")):
        found = result[key]
        lines.append(f"{label}: {shown(found['value'])} ({shown(found['low'])} to {shown(found['high'])}, 95 %)")
    test = result["curve_test"]
    if test is not None:
        below = test["denominator_degrees"]
        name, ends = ("chi-square", "") if below is None else ("F", f" and {below}")
        lines.append(
            f"one curve for both: {name} {test['statistic']:.3g} on {test['degrees_of_freedom']}{ends}, p = {test['p']:.3g}"
            f" ({test['kind']})"
        )
    equal = result["equivalence"]
    lines.append(
        f"at a margin of {100 * equal['margin']:g} % on a90: {equal['verdict']}"
        f" (90 % interval of the ratio {shown(equal['low'])} to {shown(equal['high'])}, p {shown(equal['p'])})"
    )
    held = result["size_equivalence"]
    if held is not None:
        lines.append(
            f"at a margin of {held['margin']:g} on the difference: {held['verdict']}"
            f" (90 % interval {shown(held['low'])} to {shown(held['high'])})"
        )
    lines.append(f"paired by {result['paired']}; correlation of the two a90 {result['correlation']:.2f}")
    return "\n".join(lines)

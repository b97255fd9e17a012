"""Are two POD curves the same? Difference and ratio of a90 with intervals, a test of the whole curves, and a verdict.

The verdict is that of two one-sided tests at the margin: `equivalent` when the 90 % interval of the ratio of the two
a90 lies within 1 / (1 + margin) and 1 + margin, `different` when its 95 % interval excludes 1, `different within the
margin` when both hold, else `inconclusive`. Images and networks of the same name in both tables pair the comparison.
"""

import argparse
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import whole_file
from ..pod import PodTable, Trials, check_trials, compare_pod, read_pod_table
from ._answer import answer, say
from ._pod_answer import default_repeats, fit_answer, shown, where_from_options

EXAMPLE = """examples:
  raytwin compare REAL.csv GENERATED.csv --margin 0.1 --json
  raytwin compare BEFORE.csv AFTER.csv --size size_mm --log-size --where setting=20ms
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("first", metavar="REAL.csv")
    parser.add_argument("second", metavar="GENERATED.csv")
    parser.add_argument("--margin", type=float, default=0.1, help="margin on a90 as a share of it (default 0.1)")
    parser.add_argument("--size", metavar="COLUMN", help="default: contrast, size, size_mm, ... the first there")
    parser.add_argument("--hit", metavar="COLUMN", help="0 or 1; default: hit")
    parser.add_argument("--trials", metavar="COLUMN", help="number of trials of each row (grouped data)")
    parser.add_argument("--link", default="cloglog", choices=("cloglog", "loglog", "logit", "probit"))
    parser.add_argument("--log-size", action="store_true", help="curves on the logarithm of the size")
    parser.add_argument("--method", choices=("ml", "firth"))
    parser.add_argument("--repeats", choices=("crossed", "scaled", "cluster", "pooled"))
    parser.add_argument("--site", metavar="COLUMN", help="the inspected site")
    parser.add_argument("--where", metavar="COLUMN=VALUE", action="append", default=[], help="only these rows of both")
    parser.add_argument("--unpaired", action="store_true", help="take equal names of images and networks as chance")
    parser.add_argument("--plots", metavar="DIR", help="write the figure of both curves")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    tables = [
        read_pod_table(
            path,
            size=arguments.size,
            hit=arguments.hit,
            trials=arguments.trials,
            site=arguments.site,
            where=where_from_options(arguments.where),
        )
        for path in (arguments.first, arguments.second)
    ]
    if tables[0].size_name != tables[1].size_name:
        raise InputError(
            "--size",
            received=f"{tables[0].size_name} and {tables[1].size_name}",
            expected="the same size column in both tables",
            remedy="name it with --size",
        )
    repeats = arguments.repeats
    if repeats is None:
        chosen = {default_repeats(table) for table in tables}
        repeats = "crossed" if chosen == {"crossed"} else "pooled"
    trials, shared = paired_trials(tables, log_size=arguments.log_size)
    comparison = compare_pod(
        trials[0],
        trials[1],
        link=arguments.link,
        log_size=arguments.log_size,
        method=arguments.method or "auto",
        repeats=repeats,
        margin=arguments.margin,
        shared_images=shared["image"] and not arguments.unpaired,
        shared_networks=shared["network"] and not arguments.unpaired,
    )
    result: dict[str, Any] = {
        "size": tables[0].size_name,
        "first": fit_answer(comparison.first),
        "second": fit_answer(comparison.second),
        "difference_a90": _interval(comparison.difference_a90),
        "ratio_a90": _interval(comparison.ratio_a90),
        "equivalence": {
            "margin": comparison.margin,
            "low": comparison.equivalence_low,
            "high": comparison.equivalence_high,
            "p": comparison.p_equivalence,
            "verdict": comparison.verdict,
        },
        "verdict": comparison.verdict,
        "margin": comparison.margin,
        "curve_test": None
        if comparison.curve_test is None
        else {name: getattr(comparison.curve_test, name) for name in ("statistic", "degrees_of_freedom", "p", "kind")},
        "paired": comparison.paired,
        "correlation": comparison.correlation,
        "repeats": repeats,
        "warnings": [*(note for table in tables for note in table.notes), *comparison.warnings],
    }
    if arguments.plots:
        from ..pod.plots import plot_comparison

        names = Path(arguments.first).stem, Path(arguments.second).stem
        figure = plot_comparison(comparison, size_label=tables[0].size_name, names=names)
        path = Path(arguments.plots) / "compare.png"
        with whole_file(path) as temporary:
            figure.savefig(temporary, format="png", dpi=150)
        result["plots"] = [str(path)]
    for line in result["warnings"]:
        say(f"warning: {line}")
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def paired_trials(tables: list[PodTable], *, log_size: bool) -> tuple[list[Trials], dict[str, bool]]:
    """Trials of both tables with labels coded alike, and which labels the two share (more than half of the fewer)."""
    shared = {}
    for name in ("network", "image"):
        one, two = (getattr(table, name) for table in tables)
        names = [set(labels or ()) for labels in (one, two)]
        shared[name] = bool(names[0] and names[1] and 2 * len(names[0] & names[1]) > min(len(names[0]), len(names[1])))
    trials = []
    for table in tables:
        trials.append(
            check_trials(
                table.size,
                table.hits if table.hits is not None else [],
                trials=table.trials,
                network=table.network,
                image=table.image,
                site=table.site,
                log_size=log_size,
            )
        )
    return _coded_alike(trials, tables), shared


def _coded_alike(trials: list[Trials], tables: list[PodTable]) -> list[Trials]:
    from dataclasses import replace

    import numpy as np

    result = list(trials)
    for name in ("network", "image"):
        labels = [getattr(table, name) for table in tables]
        if any(column is None for column in labels):
            continue
        codes = np.unique(np.array([*labels[0], *labels[1]]), return_inverse=True)[1].astype(np.intp)
        cut = len(labels[0])
        result = [
            replace(one, **{name: part})  # type: ignore[arg-type]
            for one, part in zip(result, (codes[:cut], codes[cut:]), strict=True)
        ]
    return result


def _interval(interval: Any) -> dict[str, float | None]:
    return {"value": interval.value, "low": interval.low, "high": interval.high}


def _text(result: dict[str, Any]) -> str:
    lines = [
        f"a90 {shown(result['first']['a90'])} (first), {shown(result['second']['a90'])} (second), {result['size']}",
    ]
    for label, key in (("difference, second - first", "difference_a90"), ("ratio, second / first", "ratio_a90")):
        found = result[key]
        lines.append(f"{label}: {shown(found['value'])} ({shown(found['low'])} to {shown(found['high'])}, 95 %)")
    test = result["curve_test"]
    if test is not None:
        lines.append(
            f"one curve for both: chi-square {test['statistic']:.3g} on 2, p = {test['p']:.3g} ({test['kind']})"
        )
    equal = result["equivalence"]
    lines.append(
        f"at a margin of {100 * equal['margin']:g} % on a90: {equal['verdict']}"
        f" (90 % interval of the ratio {shown(equal['low'])} to {shown(equal['high'])}, p {shown(equal['p'])})"
    )
    lines.append(f"paired by {result['paired']}; correlation of the two a90 {result['correlation']:.2f}")
    return "\n".join(lines)

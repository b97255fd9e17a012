"""Probability-of-detection curve of a table of hits and misses, or of a continuous response, with a90 and its bounds.

Sizes that the data cannot support are null, with the reason in the warnings. With repeated looks (columns network and
image) the intervals carry both; what they would be if every look were independent stands beside them as `naive`.
Bounds: likelihood_ratio and wald as the handbook's, modified = likelihood ratio corrected for few trials (the one to
trust below some 400). Rows with an empty size are products without foreign object: they count as false alarms or not.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..api.curves import PodCurve, fit_pod, roc_of
from ..errors import InputError
from ..files import whole_file
from ._answer import answer, say
from ._pod_answer import text_from_answer, where_from_options

EXAMPLE = """examples:
  raytwin pod HITS.csv --json
  raytwin pod HITS.csv --size size_mm --log-size --where setting=20ms --plots figures
  raytwin pod HITS.csv --explain contrast,size_mm,thickness_mm
  raytwin pod beetles.csv --size log10_dose --hit killed --trials n --link logit
  raytwin pod sites.csv --link logit --log-size --repeats scaled --site target
  raytwin pod echoes.csv --response ahat --decision 200 --left-censored 50 --right-censored 1375 --log-size
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("table", metavar="TABLE.csv", help="a row per trial, or per size with --trials")
    add("--size", metavar="COLUMN", help="default: contrast, size, size_mm, ... the first there")
    add("--hit", metavar="COLUMN", help="0 or 1; A,B,C = one inspection each; default: hit")
    add("--trials", metavar="COLUMN", help="number of trials of each row (grouped data)")
    add(
        "--link",
        choices=("cloglog", "loglog", "logit", "probit"),
        help="default: cloglog, with the bounds of all links that fit where another fits better",
    )
    add("--log-size", action="store_true", help="curve on the logarithm of the size")
    add("--method", choices=("ml", "firth"), help="default: ml, and firth where hits and misses do not overlap")
    add(
        "--repeats",
        choices=("crossed", "scaled", "cluster", "pooled"),
        help="repeated looks; default: crossed where columns network and image exist, else pooled",
    )
    add("--site", metavar="COLUMN", help="the inspected site (for --repeats scaled and cluster)")
    add("--network", metavar="COLUMN", help="who looked; default: network")
    add("--image", metavar="COLUMN", help="at what; default: image")
    add("--where", metavar="COLUMN=VALUE", action="append", default=[], help="only these rows; repeatable")
    response = parser.add_argument_group("continuous response (a-hat against a)")
    add = response.add_argument
    add("--response", metavar="COLUMN", help="a continuous response in the place of hits")
    add("--decision", type=float, metavar="R", help="responses above R are detections")
    add("--left-censored", type=float, metavar="R", help="responses at or below R say only that")
    add("--right-censored", type=float, metavar="R", help="responses at or above R say only that")
    add("--log-response", action="store_true", help="line on the logarithm of the response")
    add("--box-cox", metavar="LAMBDA", help="power of the response, or auto for the most likely one")
    more = parser.add_argument_group("more about the curve")
    add = more.add_argument
    add("--ceiling", action="store_true", help="let the curve end below 1 (lapses)")
    add("--floor", action="store_true", help="let the curve begin above 0 (false calls)")
    add("--bootstrap", type=int, metavar="N", help="N refits to resampled data")
    add(
        "--by",
        choices=("row", "image", "network", "both"),
        help="what to resample; default: both where known, else row",
    )
    add("--covariate", action="append", default=[], metavar="COLUMN[=VALUE]", help="held at VALUE (median); repeatable")
    add("--explain", metavar="COLUMN,...", help="which of these properties explains detection best")
    add("--as-published", action="store_true", help="the paper's average of one curve per network beside the answer")
    add("--seed", type=int, default=1, help="for --bootstrap and --explain (default 1)")
    files = parser.add_argument_group("files")
    files.add_argument("--export", metavar="CURVE.csv", help="write the curve with its 95 %% band")
    files.add_argument("--plots", metavar="DIR", help="write the figures")
    files.add_argument("--report", metavar="PAGE.html", type=Path, help="write the answer as a page")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    from ..api.reports import checked_page, report

    if arguments.report is not None:
        checked_page(arguments.report, argument="--report")
    curve = fit_pod(
        arguments.table,
        size=arguments.size,
        hit=arguments.hit,
        trials=arguments.trials,
        link=arguments.link,
        log_size=arguments.log_size,
        method=arguments.method,
        repeats=arguments.repeats,
        site=arguments.site,
        network=arguments.network,
        image=arguments.image,
        where=where_from_options(arguments.where),
        response=arguments.response,
        decision=arguments.decision,
        left_censored=arguments.left_censored,
        right_censored=arguments.right_censored,
        log_response=arguments.log_response,
        box_cox=arguments.box_cox,
        ceiling=arguments.ceiling,
        floor=arguments.floor,
        bootstrap=arguments.bootstrap,
        by=arguments.by,
        covariates=_covariates(arguments.covariate),
        explain=[name.strip() for name in (arguments.explain or "").split(",") if name.strip()],
        as_published=arguments.as_published,
        seed=arguments.seed,
    )
    result = curve.to_dict()
    if arguments.export:
        curve.save_table(arguments.export)
        result["export"] = arguments.export
    if arguments.plots:
        result["plots"] = [_saved(figure, Path(arguments.plots) / name) for name, figure in _figures(curve).items()]
    if arguments.report is not None:
        result["report"] = str(report(curve, arguments.report))
    for line in result["warnings"]:
        say(f"warning: {line}")
    answer(result, as_json=arguments.json, text=text_from_answer(result, curve.table.size_name))
    return 0


def _covariates(options: list[str]) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for option in options:
        name, equals, value = option.partition("=")
        try:
            found[name] = float(value) if equals else None
        except ValueError:
            raise InputError("--covariate", received=repr(option), expected="COLUMN or COLUMN=NUMBER") from None
    return found


def _figures(curve: PodCurve) -> dict[str, Any]:
    """File name -> figure."""
    from matplotlib.figure import Figure

    from ..pod import PodFit, compare_models
    from ..pod.plots import plot_joint_region, plot_models, plot_roc

    def drawn(plot: Callable[..., Any]) -> Figure:
        figure = Figure(figsize=(6.4, 4.4), layout="constrained")
        plot(ax=figure.subplots())
        return figure

    fit = curve.fit
    if not isinstance(fit, PodFit):
        figures = {"response.png": drawn(curve.plot)}
        roc = roc_of(curve)
        return figures if roc is None else {**figures, "roc.png": plot_roc(roc)}
    figures = {"pod.png": drawn(curve.plot)}
    if fit.curve is not None and not fit.separated and fit.curve.at_maximum:
        figures["region.png"] = plot_joint_region(fit)
    alternatives = compare_models(curve.trials)
    if any(one.aic is not None for one in alternatives):
        figures["models.png"] = plot_models(alternatives)
    return figures


def _saved(figure: Any, path: Path) -> str:
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)
    return str(path)

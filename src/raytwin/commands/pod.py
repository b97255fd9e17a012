"""Probability-of-detection curve of a table of hits and misses, or of a continuous response, with a90 and its bounds.

Sizes that the data cannot support are null, with the reason in the warnings. With repeated looks (columns network and
image) the intervals carry both; what they would be if every look were independent stands beside them as `naive`.
Bounds: likelihood_ratio and wald as the handbook's, modified = likelihood ratio corrected for few trials (the one to
trust below some 400). Rows with an empty size are products without foreign object: they count as false alarms or not.
"""

import argparse
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FitError, InputError
from ..files import whole_file
from ..pod import (
    PodFit,
    PodTable,
    Trials,
    bootstrap_pod,
    compare_models,
    compute_roc,
    explain_detection,
    false_alarm_rate,
    fit_as_published,
    fit_covariates,
    fit_lapse_pod,
    fit_pod,
    fit_response_pod,
    read_pod_table,
    size_at,
    write_curve_table,
)
from ._answer import answer, say
from ._pod_answer import (
    default_repeats,
    fit_answer,
    notes_on_table,
    response_answer,
    text_from_answer,
    trials_from_table,
    where_from_options,
)

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
    add("--link", default="cloglog", choices=("cloglog", "loglog", "logit", "probit"))
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
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    table = read_pod_table(
        arguments.table,
        size=arguments.size,
        hit=arguments.hit,
        trials=arguments.trials,
        response=arguments.response,
        site=arguments.site,
        network=arguments.network,
        image=arguments.image,
        where=where_from_options(arguments.where),
    )
    result = _response(table, arguments) if arguments.response else _hit_miss(table, arguments)
    if len(table.false_alarm) and "false_alarms" not in result:
        result["false_alarms"] = asdict(
            false_alarm_rate(table.false_alarm, network=table.false_alarm_network, image=table.false_alarm_image)
        )
    for line in result["warnings"]:
        say(f"warning: {line}")
    answer(result, as_json=arguments.json, text=text_from_answer(result, table.size_name))
    return 0


def _hit_miss(table: PodTable, arguments: argparse.Namespace) -> dict[str, Any]:
    for name in ("decision", "left_censored", "right_censored", "box_cox"):
        if getattr(arguments, name) is not None:
            raise InputError("--" + name.replace("_", "-"), received="without --response", expected="--response COLUMN")
    repeats = arguments.repeats or default_repeats(table)
    fit = fit_pod(
        table.size,
        table.hits if table.hits is not None else [],
        trials=table.trials,
        link=arguments.link,
        log_size=arguments.log_size,
        method=arguments.method or "auto",
        repeats=repeats,
        network=table.network,
        image=table.image,
        site=table.site,
    )
    result = fit_answer(fit)
    result["size"] = table.size_name
    result["warnings"] = [*notes_on_table(table, repeats), *fit.warnings]
    trials = trials_from_table(table, log_size=arguments.log_size)
    result["alternatives"] = [asdict(one) for one in compare_models(trials)]
    extras: dict[str, Callable[[], Any]] = {}
    if arguments.ceiling or arguments.floor:
        extras["lapse"] = lambda: _lapse(trials, arguments, repeats, result)
    if arguments.bootstrap is not None:
        extras["bootstrap"] = lambda: _bootstrap(table, arguments)
    if arguments.covariate:
        extras["covariates"] = lambda: _covariates(table, arguments, result)
    if arguments.explain:
        extras["explanation"] = lambda: _explanation(table, arguments, repeats)
    for name, make in extras.items():
        try:
            result[name] = make()
        except FitError as error:  # the curve stands; what cannot be added to it is null with its reason
            result[name] = None
            result["warnings"].append(f"no {name}: {error}")
    if arguments.as_published:
        result["as_published"] = asdict(fit_as_published(trials))
    if arguments.export:
        write_curve_table(arguments.export, fit, size_name=table.size_name)
        result["export"] = arguments.export
    if arguments.plots:
        result["plots"] = _plots(fit, table, arguments)
    return result


def _lapse(trials: Trials, arguments: argparse.Namespace, repeats: str, result: dict[str, Any]) -> dict[str, Any]:
    fit = fit_lapse_pod(
        trials, link=arguments.link, log_size=arguments.log_size, ceiling=arguments.ceiling, floor=arguments.floor
    )
    if repeats != "pooled":
        result["warnings"].append("ceiling and floor take all looks as independent: their intervals are too narrow")
    result["warnings"] += [f"with ceiling or floor: {note}" for note in fit.warnings]
    return asdict(fit)


def _bootstrap(table: PodTable, arguments: argparse.Namespace) -> dict[str, Any]:
    if arguments.bootstrap < 20:
        raise InputError("--bootstrap", received=arguments.bootstrap, expected="20 refits or more (1000 is usual)")
    by = arguments.by
    if by is None:
        known = table.network is not None, table.image is not None
        by = {(True, True): "both", (True, False): "network", (False, True): "image"}.get(known, "row")
    if by == "row" and table.trials is not None:
        raise InputError("--bootstrap", received="grouped trials", expected="one trial a row, or a column of images")
    found = bootstrap_pod(
        trials_from_table(table, log_size=arguments.log_size),
        link=arguments.link,
        log_size=arguments.log_size,
        by=by,
        replicates=arguments.bootstrap,
        rng=np.random.default_rng(arguments.seed),
    )
    return {
        "by": by,
        "replicates": arguments.bootstrap,
        "a90_95": found.a90_95,
        "a90_low": found.a90_low,
        "a90_high": found.a90_high,
        "unknown": found.unknown,
    }


def _covariates(table: PodTable, arguments: argparse.Namespace, result: dict[str, Any]) -> dict[str, Any]:
    columns = {table.size_name: table.size}
    held: dict[str, float] = {}
    for option in arguments.covariate:
        name, equals, value = option.partition("=")
        if name == table.size_name:
            raise InputError("--covariate", received=repr(option), expected="another property than the size")
        columns[name] = table.numbers(name)
        try:
            held[name] = float(value) if equals else float(np.median(columns[name]))
        except ValueError:
            raise InputError("--covariate", received=repr(option), expected="COLUMN or COLUMN=NUMBER") from None
    trials = trials_from_table(table, log_size=arguments.log_size)
    logs = (table.size_name,) if arguments.log_size else ()
    fit = fit_covariates(trials, columns, link=arguments.link, logs=logs, method=arguments.method or "auto")
    at = size_at(fit, trials, columns, name=table.size_name, held=held)
    result["warnings"] += [f"with covariates: {note}" for note in at.warnings]
    names = ("constant", *fit.names)
    scales = (False, *fit.logs)
    return {
        "coefficients": [
            {"name": name, "log": log, "value": value, "error": error, "p": p}
            for name, log, value, error, p in zip(
                names, scales, fit.coefficients.tolist(), fit.errors.tolist(), fit.p.tolist(), strict=True
            )
        ],
        "method": fit.method,
        "deviance": fit.deviance,
        "aic": fit.aic,
        "held": dict(at.held),
        "a50": at.a50,
        "a90": at.a90,
        "a90_95": asdict(at.a90_95),
    }


def _explanation(table: PodTable, arguments: argparse.Namespace, repeats: str) -> list[dict[str, Any]]:
    names = [name.strip() for name in arguments.explain.split(",") if name.strip()]
    columns = {name: table.numbers(name) for name in names}
    found, _ = explain_detection(
        trials_from_table(table, log_size=False),
        columns,
        rng=np.random.default_rng(arguments.seed),
        link=arguments.link,
        repeats=repeats,
    )
    return [
        {
            "name": one.name,
            "log": one.log,
            "gain": one.gain,
            "behind": one.behind,
            "behind_error": one.behind_error,
            "area": one.area,
            "rising": one.rising,
            "aic": one.aic,
            "a50": one.fit.a50,
            "a90": one.fit.a90,
            "a90_95": asdict(one.fit.a90_95),
            "p_beyond": one.p_beyond,
        }
        for one in found
    ]


def _plots(fit: PodFit, table: PodTable, arguments: argparse.Namespace) -> list[str]:
    from ..pod.plots import plot_joint_region, plot_models, plot_pod

    trials = trials_from_table(table, log_size=arguments.log_size)
    figures = {"pod.png": plot_pod(fit, trials, size_label=table.size_name)}
    if fit.curve is not None and not fit.separated and fit.curve.at_maximum:
        figures["region.png"] = plot_joint_region(fit)
    alternatives = compare_models(trials)
    if any(one.aic is not None for one in alternatives):
        figures["models.png"] = plot_models(alternatives)
    return [_saved(figure, Path(arguments.plots) / name) for name, figure in figures.items()]


def _saved(figure: Any, path: Path) -> str:
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)
    return str(path)


def _response(table: PodTable, arguments: argparse.Namespace) -> dict[str, Any]:
    if arguments.decision is None:
        raise InputError(
            "--decision",
            received="none",
            expected="the response above which an object counts as detected",
            remedy="for example --decision 200",
        )
    power: float | None = 0.0 if arguments.log_response else 1.0
    if arguments.box_cox is not None:
        try:
            power = None if arguments.box_cox == "auto" else float(arguments.box_cox)
        except ValueError:
            raise InputError("--box-cox", received=repr(arguments.box_cox), expected="a number or auto") from None
    repeats = arguments.repeats
    notes: list[str] = []
    if repeats is None:
        repeats = "cluster" if table.network is not None and table.image is not None else "pooled"
    elif repeats in ("crossed", "scaled"):
        notes.append(f"repeats {repeats} is not there for a response: bounds robust to networks and images instead")
        repeats = "cluster"
    response = table.response if table.response is not None else np.zeros(0)
    fit = fit_response_pod(
        table.size,
        response,
        decision=arguments.decision,
        left=arguments.left_censored,
        right=arguments.right_censored,
        log_size=arguments.log_size,
        box_cox=power,
        network=table.network,
        image=table.image,
        repeats=repeats,
    )
    result = response_answer(fit)
    result["size"] = table.size_name
    result["warnings"] = [*notes, *notes_on_table(table, repeats), *fit.warnings]
    roc = None
    if len(table.noise_response) > 1:
        roc = compute_roc(table.noise_response, response)
        alarms = (table.noise_response > arguments.decision).astype(float)
        result["roc"] = {"area": roc.area, "low": roc.area_low, "high": roc.area_high}
        result["false_alarms"] = asdict(false_alarm_rate(alarms))
    if arguments.plots:
        from ..pod.plots import plot_response, plot_roc

        folder = Path(arguments.plots)
        figure = plot_response(
            fit,
            table.size,
            response,
            size_label=table.size_name,
            response_label=arguments.response,
            left=arguments.left_censored,
            right=arguments.right_censored,
        )
        result["plots"] = [_saved(figure, folder / "response.png")]
        if roc is not None:
            result["plots"].append(_saved(plot_roc(roc), folder / "roc.png"))
    return result

"""Probability-of-detection curve of a table of hits and misses, or of a continuous response, with a90 and its bounds.

Sizes that the data cannot support are null, with the reason in the warnings. With repeated looks (columns network and
image) the intervals carry both; what they would be if every look were independent stands beside them as `naive`.
"""

import argparse
from dataclasses import asdict
from typing import Any

from ..errors import InputError
from ..pod import PodFit, PodTable, Trials, check_trials, compare_models, false_alarm_rate, fit_pod, read_pod_table
from ._answer import answer, say

EXAMPLE = """examples:
  raytwin pod HITS.csv --json
  raytwin pod HITS.csv --size size_mm --log-size --where setting=20ms
  raytwin pod beetles.csv --size log10_dose --hit killed --trials n --link logit
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("table", metavar="TABLE.csv", help="a row per trial, or per size with --trials")
    parser.add_argument("--size", metavar="COLUMN", help="default: contrast, size, size_mm, ... the first there")
    parser.add_argument("--hit", metavar="COLUMN", help="0 or 1; A,B,C = one inspection each; default: hit")
    parser.add_argument("--trials", metavar="COLUMN", help="number of trials of each row (grouped data)")
    parser.add_argument("--link", default="cloglog", choices=("cloglog", "loglog", "logit", "probit"))
    parser.add_argument("--log-size", action="store_true", help="curve on the logarithm of the size")
    parser.add_argument(
        "--method", choices=("ml", "firth"), help="default: ml, and firth where hits and misses do not overlap"
    )
    parser.add_argument(
        "--repeats",
        choices=("crossed", "scaled", "cluster", "pooled"),
        help="repeated looks; default: crossed where columns network and image exist, else pooled",
    )
    parser.add_argument("--site", metavar="COLUMN", help="the inspected site (for --repeats scaled and cluster)")
    parser.add_argument(
        "--where", metavar="COLUMN=VALUE", action="append", default=[], help="only these rows; repeatable"
    )
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    table = read_pod_table(
        arguments.table,
        size=arguments.size,
        hit=arguments.hit,
        trials=arguments.trials,
        site=arguments.site,
        where=where_from_options(arguments.where),
    )
    repeats = arguments.repeats or default_repeats(table)
    result, _ = hit_miss_answer(
        table,
        link=arguments.link,
        log_size=arguments.log_size,
        method=arguments.method or "auto",
        repeats=repeats,
    )
    for line in result["warnings"]:
        say(f"warning: {line}")
    answer(result, as_json=arguments.json, text=text_from_answer(result, table.size_name))
    return 0


def where_from_options(options: list[str]) -> dict[str, str]:
    """Column -> value from COLUMN=VALUE texts."""
    chosen = {}
    for option in options:
        name, equals, value = option.partition("=")
        if not equals or not name.strip():
            raise InputError("--where", received=repr(option), expected="COLUMN=VALUE, for example setting=20ms")
        chosen[name.strip()] = value.strip()
    return chosen


def default_repeats(table: PodTable) -> str:
    """`crossed` where both a network and an image are known, else `pooled`."""
    return "crossed" if table.network is not None and table.image is not None else "pooled"


def trials_from_table(table: PodTable, *, log_size: bool) -> Trials:
    """The table's rows as checked trials."""
    return check_trials(
        table.size,
        table.hits if table.hits is not None else [],
        trials=table.trials,
        network=table.network,
        image=table.image,
        site=table.site,
        log_size=log_size,
    )


def hit_miss_answer(
    table: PodTable, *, link: str, log_size: bool, method: str, repeats: str
) -> tuple[dict[str, Any], PodFit]:
    """The POD answer of a table of hits and misses, and the fit behind it."""
    fit = fit_pod(
        table.size,
        table.hits if table.hits is not None else [],
        trials=table.trials,
        link=link,
        log_size=log_size,
        method=method,
        repeats=repeats,
        network=table.network,
        image=table.image,
        site=table.site,
    )
    notes = [*table.notes, *fit.warnings]
    settings = set(table.other.get("setting", ()))
    if len(settings) > 1:
        notes.append(f"{len(settings)} settings in one curve; choose one with --where setting=...")
    result = fit_answer(fit)
    result["size"] = table.size_name
    result["warnings"] = notes
    if fit.naive is not None:
        result["naive"] = {
            key: value
            for key, value in fit_answer(fit.naive).items()
            if key in ("a50", "a90", "a90_95", "a90_95_two_sided")
        }
    if len(table.false_alarm):
        result["false_alarms"] = asdict(
            false_alarm_rate(table.false_alarm, network=table.false_alarm_network, image=table.false_alarm_image)
        )
    result["alternatives"] = [asdict(one) for one in compare_models(trials_from_table(table, log_size=log_size))]
    return result, fit


def fit_answer(fit: PodFit) -> dict[str, Any]:
    """A fit as the POD answer."""
    result: dict[str, Any] = {
        "link": fit.link,
        "method": fit.method,
        "variant": fit.variant,
        "repeats": fit.repeats,
        "log_size": fit.log_size,
        "n": fit.n,
        "n_hits": fit.n_hits,
        "c0": fit.c0,
        "c1": fit.c1,
        "se0": fit.se0,
        "se1": fit.se1,
        "log_likelihood": fit.log_likelihood,
        "deviance": fit.deviance,
        "aic": fit.aic,
        "a50": fit.a50,
        "a90": fit.a90,
        "a90_95": asdict(fit.a90_95),
        "a90_95_two_sided": asdict(fit.a90_95_two_sided),
        "a90_low_two_sided": asdict(fit.a90_low_two_sided),
        "separated": fit.separated,
        "reaches_90": fit.reaches_90,
        "warnings": list(fit.warnings),
    }
    if fit.crossed is not None:
        result |= asdict(fit.crossed)
    return result


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"


def text_from_answer(result: dict[str, Any], size_name: str) -> str:
    """The POD answer for people; sizes in the unit of the size column."""
    lines = [
        f"{result['n_hits']} hits of {result['n']} trials; link {result['link']} on"
        f" {'ln ' if result['log_size'] else ''}{size_name}; {result['variant']}; repeats {result['repeats']}",
        f"c0 {_shown(result['c0'])} +- {_shown(result['se0'])}, c1 {_shown(result['c1'])} +- {_shown(result['se1'])},"
        f" deviance {_shown(result['deviance'])}",
        f"a50 {_shown(result['a50'])}   a90 {_shown(result['a90'])}",
    ]
    for label, key in (("a90/95, one-sided", "a90_95"), ("a90, upper end of two-sided 95 %", "a90_95_two_sided")):
        bound = result[key]
        line = f"{label}: {_shown(bound['likelihood_ratio'])} (likelihood ratio), {_shown(bound['wald'])} (Wald)"
        if "naive" in result:
            line += f"; if looks were independent {_shown(result['naive'][key]['likelihood_ratio'])}"
        lines.append(line)
    if "sd_network" in result:
        lines.append(
            f"spread on the link's scale: networks {_shown(result['sd_network'])}, images {_shown(result['sd_image'])};"
            f" average network and image: a90 {_shown(result['a90_conditional'])}"
        )
    if "false_alarms" in result:
        alarm = result["false_alarms"]
        lines.append(
            f"false alarms: {alarm['false_alarms']} of {alarm['n']}, {100 * alarm['rate']:.3g} %"
            f" ({100 * alarm['low']:.3g} to {100 * alarm['high']:.3g} %, 95 %)"
        )
    lines.append("link        size  deviance      AIC      a90   p(link)  p(fit)")
    for one in result["alternatives"]:
        lines.append(
            f"{one['link']:<10}{'ln' if one['log_size'] else '':>6}{_shown(one['deviance']):>10}{_shown(one['aic']):>9}"
            f"{_shown(one['a90']):>9}{_shown(one['p_link']):>10}{_shown(one['p_fit']):>8}"
        )
    return "\n".join(lines)

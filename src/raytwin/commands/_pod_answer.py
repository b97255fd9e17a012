"""The POD answer for people, shared by the commands that give one."""

from typing import Any

from ..errors import InputError


def where_from_options(options: list[str]) -> dict[str, str]:
    """Column -> value from COLUMN=VALUE texts."""
    chosen = {}
    for option in options:
        name, equals, value = option.partition("=")
        if not equals or not name.strip():
            raise InputError("--where", received=repr(option), expected="COLUMN=VALUE, for example setting=20ms")
        chosen[name.strip()] = value.strip()
    return chosen


def shown(value: float | None) -> str:
    """A number for people, `none` where there is none."""
    return "none" if value is None else f"{value:.4g}"


def text_from_answer(result: dict[str, Any], size_name: str) -> str:
    """The POD answer for people; sizes in the unit of the size column."""
    lines = [
        f"{result['n_hits']} hits of {result['n']} trials; link {result['link']} on"
        f" {'ln ' if result['log_size'] else ''}{size_name}; {result['variant']}; repeats {result['repeats']}",
        f"c0 {shown(result['c0'])} +- {shown(result['se0'])}, c1 {shown(result['c1'])} +- {shown(result['se1'])},"
        f" deviance {shown(result['deviance'])}",
        f"a50 {shown(result['a50'])}   a90 {shown(result['a90'])}",
    ]
    for label, key in (("a90/95, one-sided", "a90_95"), ("a90, upper end of two-sided 95 %", "a90_95_two_sided")):
        bound = result[key]
        line = f"{label}: {shown(bound['likelihood_ratio'])} (likelihood ratio), {shown(bound['wald'])} (Wald)"
        if bound["modified"] is not None:
            line += f", {shown(bound['modified'])} (modified likelihood ratio)"
        if "naive" in result:
            line += f"; if looks were independent {shown(result['naive'][key]['likelihood_ratio'])}"
        lines.append(line)
    if "sd_network" in result:
        lines.append(
            f"spread on the link's scale: networks {shown(result['sd_network'])}, images {shown(result['sd_image'])};"
            f" average network and image: a90 {shown(result['a90_conditional'])}"
        )
    if "response" in result:
        line = result["response"]
        lines.append(
            f"response = {shown(line['intercept'])} + {shown(line['slope'])} x, scatter {shown(line['scatter'])}"
            f" (Box-Cox {line['box_cox']:.3g}); decision {shown(line['decision'])}; censored {line['n_left_censored']} below,"
            f" {line['n_right_censored']} above; mu {shown(line['mu'])}, sigma {shown(line['sigma'])}"
        )
    if "false_alarms" in result:
        alarm = result["false_alarms"]
        lines.append(
            f"false alarms: {alarm['false_alarms']} of {alarm['n']}, {100 * alarm['rate']:.3g} %"
            f" ({100 * alarm['low']:.3g} to {100 * alarm['high']:.3g} %, 95 %)"
        )
    lines += _further_lines(result)
    joined = result.get("over_links")
    if joined and len(joined["curves"]) > 1 and joined["a90_lowest"] is not None:
        lines.append(
            f"over {', '.join(joined['curves'])} (AIC within 2 of the best, and the one chosen): a90 {shown(joined['a90_lowest'])} to"
            f" {shown(joined['a90_highest'])}, a90/95 {shown(joined['a90_95'])}, two-sided 95 % {shown(joined['a90_low'])} to"
            f" {shown(joined['a90_high'])}"
        )
    if result.get("alternatives"):
        lines.append("other links and scales" + (", looks taken as independent:" if "naive" in result else ":"))
        lines.append(f"{'link':<22}{'size':>5}{'deviance':>11}{'AIC':>10}{'a90':>10}{'p(link)':>11}{'p(fit)':>11}")
        for one in result["alternatives"]:
            lines.append(
                f"{_with_end(one):<22}{'ln' if one['log_size'] else '':>5}{shown(one['deviance']):>11}{shown(one['aic']):>10}"
                f"{shown(one['a90']):>10}{_p(one['p_link']):>11}{_p(one['p_fit']):>11}"
            )
    return "\n".join(lines)


def _with_end(one: dict[str, Any]) -> str:
    ends = [f" {name} {one[name]:.3g}" for name in ("ceiling", "floor") if one[name] is not None]
    return "".join([one["link"], *ends])


def _p(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"


def _further_lines(result: dict[str, Any]) -> list[str]:
    lines = []
    if result.get("lapse"):
        lapse = result["lapse"]
        words = [
            f"{name} {shown(lapse[name]['value'])} ({shown(lapse[name]['low'])} to {shown(lapse[name]['high'])})"
            for name in ("ceiling", "floor")
        ]
        lines.append(
            f"with {' and '.join(words)}: a90 {shown(lapse['a90'])}, a90/95 {shown(lapse['a90_95'])};"
            f" p that 0 and 1 are enough: {_p(lapse['p_plain'])}"
        )
    if result.get("bootstrap"):
        boot = result["bootstrap"]
        lines.append(
            f"bootstrap by {boot['by']}, {boot['replicates']} refits: a90/95 {shown(boot['a90_95'])}, two-sided"
            f" {shown(boot['a90_low'])} to {shown(boot['a90_high'])}; without a90: {100 * boot['unknown']:.3g} %"
        )
    if result.get("covariates"):
        fit = result["covariates"]
        for one in fit["coefficients"]:
            scale = "ln " if one["log"] else ""
            lines.append(f"  {scale}{one['name']}: {shown(one['value'])} +- {shown(one['error'])}, p {_p(one['p'])}")
        at = ", ".join(f"{name} {shown(value)}" for name, value in fit["held"].items())
        lines.append(
            f"  at {at}: a90 {shown(fit['a90'])}, a90/95 {shown(fit['a90_95']['likelihood_ratio'])} (likelihood ratio),"
            f" {shown(fit['a90_95']['wald'])} (Wald)"
        )
    if result.get("explanation"):
        lines.append(f"{'property':<22}{'gain/trial':>11}{'behind':>10}{'+-':>9}{'area':>8}{'a90':>10}{'p beyond':>10}")
        for one in result["explanation"]:
            name = ("ln " if one["log"] else "") + one["name"] + ("" if one["rising"] else " (falling)")
            lines.append(
                f"{name:<22}{one['gain']:>11.4f}{one['behind']:>10.4f}{one['behind_error']:>9.4f}{one['area']:>8.3f}"
                f"{shown(one['a90']):>10}{_p(one['p_beyond']):>10}"
            )
    if "as_published" in result:
        paper = result["as_published"]
        lines.append(
            f"as published ({paper['link']}, a curve per network): a90 {shown(paper['a90_mean'])} +- {shown(paper['a90_sd'])}"
            f" over {paper['n_fitted']} networks; {paper['n_failed']} without a curve"
        )
    return lines

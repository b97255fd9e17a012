"""A blind check as one self-contained HTML page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..reports import Figure, write_page
from .blind_figures import (
    accuracy_charts,
    confusion_table,
    distance_table,
    limit_charts,
    reliability_charts,
    strength_chart,
    unknown_chart,
    verdict_table,
)
from .blind_results import CheckResult
from .blind_scores import SIGMA_BINS, exactly_right, top1_right

_DASH = "–"
_MOST_WRONG = 200


def share_text(entry: Mapping[str, Any]) -> str:
    """`93 % (85 to 97, 41 of 44)`."""
    if entry["share"] is None:
        return f"no cases {_DASH}"
    return f"{100 * entry['share']:.0f} % ({100 * entry['low']:.0f} to {100 * entry['high']:.0f}, {entry['hits']} of {entry['n']})"


def summary_text(result: CheckResult) -> str:
    """One paragraph in plain words: what was tried and what came out."""
    scores = result.scores
    every = scores["scores"]
    cases = every["cases"]
    parts = [
        f"{cases['all']} sealed sessions of the virtual lab were diagnosed: {cases['none']} without any effect, {cases['single']}"
        f" with one, {cases['pair']} with two, {cases['unknown']} with one that the catalogue does not hold."
    ]
    if scores["development_seed"]:
        parts.insert(0, "This seed was used while the diagnosis was developed: these figures prove nothing.")
    if cases["failed"]:
        parts.append(f"{cases['failed']} could not be diagnosed and count as wrong.")
    if scores["leave_one_out"] is not None:
        left = scores["leave_one_out"]
        parts.append(
            "The effect of each case was withheld from the catalogue. Where it lay 5 standard deviations or more from all the others,"
            f" it came back as unknown in {share_text(left['unknown_from_5_sigma'])} and under a wrong name with confidence in"
            f" {share_text(left['confident_wrong_name_from_5_sigma'])}."
        )
        return " ".join(parts)
    full = scores["full_measurement_set"]
    first, alone = share_text(full["top1"]["single_from_5_sigma"]), share_text(full["exact"]["single_from_5_sigma"])
    if full["top1"]["single_from_5_sigma"]["n"]:
        parts.append(
            "With the full measurement set, a single effect that lay 5 standard deviations or more from every other"
            f" explanation was named first in {first}, and alone in {alone}."
        )
    if every["none"]["false_alarms"]["n"]:
        parts.append(f"Where nothing was wrong, something was claimed in {share_text(every['none']['false_alarms'])}.")
    if every["pairs"]["both_named"]["n"]:
        parts.append(f"Both effects of a pair were named in {share_text(every['pairs']['both_named'])}.")
    if every["unknown"]["found"]["n"]:
        parts.append(f"Effects outside the catalogue were called unknown in {share_text(every['unknown']['found'])}.")
    strong = every["strength"]["from_10_sigma"]
    if strong["within_10_percent"]["n"]:
        close, held = share_text(strong["within_10_percent"]), share_text(strong["coverage_95"])
        parts.append(
            f"Strengths of effects of 10 standard deviations or more were right within 10 % in {close}; their 95 %"
            f" intervals held the truth in {held}."
        )
    error = every["leading_hypothesis"]["error"]
    if error is not None:
        honest = every["leading_hypothesis"]["error_if_honest"]
        parts.append(
            f"Stated probabilities of the leading explanation were off by {error:.2f} on average"
            f" (honest ones would show {honest['mean']:.2f} in so many cases)."
        )
    return " ".join(parts)


def write_report(result: CheckResult, rows: Sequence[Mapping[str, Any]], path: Path, *, version: str) -> Path:
    """Write the page; returns its path."""
    scores = result.scores
    outcomes = result.outcomes
    full, every = scores["full_measurement_set"], scores["scores"]
    chapters: dict[str, Sequence[Figure]] = {
        "accuracy": accuracy_charts(full, scores["baselines"]),
        "reliability": reliability_charts(every, scores["baselines"]),
        "limits": limit_charts(outcomes),
        "strengths": [strength_chart(outcomes)],
        "unknown": [unknown_chart(outcomes)],
    }
    wrong = [row for row, outcome in zip(rows, outcomes, strict=True) if not exactly_right(outcome)]
    return write_page(
        path,
        Path(__file__).parent / "blind_report.html",
        figures={f"{name}_{place}": one for name, several in chapters.items() for place, one in enumerate(several)},
        chapters={name: [f"{name}_{place}" for place in range(len(several))] for name, several in chapters.items()},
        confusion=confusion_table(outcomes),
        distances=distance_table(every["distances"]),
        verdicts=verdict_table(outcomes),
        version=version,
        summary=summary_text(result),
        development=scores["development_seed"],
        seal=scores["seal_sha256"],
        options=scores["options"],
        statistics_errors=scores["statistics_errors"],
        without_statistics=scores["without_statistics"],
        code_versions=scores["code_versions"],
        aims=[
            row
            | {
                "value": _value(row),
                "verdict": "not judged" if row["met"] is None else "met" if row["met"] else "not met",
            }
            for row in scores["aims"]
        ],
        baselines=[_baseline_row("diagnosis", every), *(_baseline_row(n, s) for n, s in scores["baselines"].items())],
        trained_on=scores["trained_on"],
        effects=[_effect_row(name, entry) for name, entry in every["by_effect"].items() if entry["top1"]["n"]],
        wrong_names=every["wrong_names"],
        sets=every["confusion_by_set"],
        unknown_effects=every["unknown"]["by_effect"],
        session_rows=[
            {
                "name": name,
                "n": entry["cases"]["all"],
                "top1": share_text(entry["top1"]["single"]),
                "all": share_text(entry["exact"]["all"]),
                "false": share_text(entry["none"]["false_alarms"]),
            }
            for name, entry in [
                *((f"full, {geometry} pixels", part) for geometry, part in scores["by_geometry"].items()),
                *scores["reduced_measurement_set"]["by_protocol"].items(),
            ]
        ],
        withheld=scores["leave_one_out"],
        share_text=share_text,
        sigma_bins=[f"{low:g} to {high:g}" if high < 1e9 else f"{low:g} and more" for low, high in SIGMA_BINS],
        wrong=wrong[:_MOST_WRONG],
        n_wrong=len(wrong),
        n_first_wrong=sum(not top1_right(item) for item in outcomes),
        seconds=every["seconds"],
        memory=every["peak_memory_MB"],
    )


def _value(row: Mapping[str, Any]) -> str:
    if row["found"] is None:
        return _DASH
    if row["n"] is None:
        return f"{row['found']:.3f}"
    return f"{100 * row['found']:.0f} % ({100 * row['low']:.0f} to {100 * row['high']:.0f}, n = {row['n']})"


def _baseline_row(name: str, scores: Mapping[str, Any]) -> dict[str, str]:
    area = scores["unknown"]["auroc"]["value"]
    leading = scores["leading_hypothesis"]
    return {
        "name": name.replace("_", " "),
        "all": share_text(scores["exact"]["all"]),
        "single": share_text(scores["top1"]["single"]),
        "five": share_text(scores["top1"]["single_from_5_sigma"]),
        "false": share_text(scores["none"]["false_alarms"]),
        "area": _DASH if area is None else f"{area:.2f}",
        "brier": _DASH if leading["brier"] is None else f"{leading['brier']:.3f}",
        "error": _DASH if leading["error"] is None else f"{leading['error']:.3f}",
    }


def _effect_row(name: str, entry: Mapping[str, Any]) -> dict[str, str]:
    median = entry["median_sigma"]
    return {
        "name": name,
        "top1": share_text(entry["top1"]),
        "five": share_text(entry["top1_from_5_sigma"]),
        "sigma": _DASH if median is None else f"{median:.1f}",
        "nearest": ", ".join(f"{other} {count}" for other, count in list(entry["nearest"].items())[:3]),
    }

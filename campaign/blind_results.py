"""From opened labels and answers to `cases.csv` and `scores.json`."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..files import whole_file
from ..generator.effects import EFFECTS
from ._plain import plain
from .blind_baselines import Example, baseline_outcomes, baseline_scores, example_of
from .blind_cases import case_from_label, is_development_seed
from .blind_check import OpenedCheck, statistics_path, withheld
from .blind_scores import (
    Outcome,
    compute_scores,
    exactly_right,
    outcome_of,
    top1_right,
    top_set_right,
    withheld_scores,
)
from .blind_separation import Separation, separation_of
from .blind_statistics import SessionStatistics, read_statistics


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckResult:
    """Scored cases. Fields: outcomes; baselines (outcomes by name); scores (what `scores.json` holds)."""

    outcomes: tuple[Outcome, ...]
    baselines: Mapping[str, Sequence[Outcome]]
    scores: Mapping[str, Any]


def score_check(check: OpenedCheck) -> CheckResult:
    """Score an opened check."""
    outcomes: list[Outcome] = []
    sessions: list[Example] = []
    training: list[Example] = []
    for label, answer in zip(check.labels, check.answers, strict=True):
        path = statistics_path(check.folder, label["stream"], label["index"])
        statistics = read_statistics(path) if path.exists() else None
        truth = tuple(item["id"] for item in label["effects"])
        example = example_of(label["label"], truth, answer.get("features", {}), statistics)
        if label["stream"] == "train":
            training.append(example)
            continue
        without = withheld(case_from_label(label), check.options)
        outcomes.append(
            outcome_of(
                label,
                answer,
                separations=_separations(label, statistics, without),
                withheld=without,
                misfit=_misfit(statistics),
            )
        )
        sessions.append(example)
    effects = tuple(EFFECTS)
    baselines = baseline_outcomes(outcomes, sessions, training, effects)
    full = [item for item in outcomes if item.full]
    reduced = [item for item in outcomes if not item.full]
    scores: dict[str, Any] = {
        "format": "raytwin-blind-check-scores",
        "version": 1,
        "seal_sha256": check.seal,
        "options": asdict(check.options),
        "development_seed": is_development_seed(check.options.seed),
        "code_versions": list(check.versions),
        "without_statistics": sum(bool(answer.get("statistics_error")) for answer in check.answers),
        "statistics_errors": sorted(
            {str(answer["statistics_error"]) for answer in check.answers if answer.get("statistics_error")}
        ),
        "trained_on": sum(bool(item.features) for item in training),
        "scores": compute_scores(outcomes, effects),
        "full_measurement_set": compute_scores(full, effects),
        "reduced_measurement_set": compute_scores(reduced, effects) | {"by_protocol": _by_protocol(reduced, effects)},
        "by_geometry": {
            name: _few(compute_scores([item for item in full if item.geometry == name], effects))
            for name in ("fine", "coarse")
        },
        "leave_one_out": withheld_scores(outcomes) if check.options.leave_one_out else None,
        "baselines": baseline_scores(baselines, effects),
    }
    scores["aims"] = aims_of(scores)
    return CheckResult(outcomes=tuple(outcomes), baselines=baselines, scores=plain(scores))


def _separations(
    label: Mapping[str, Any], statistics: SessionStatistics | None, without: Sequence[str]
) -> dict[str, Separation]:
    if statistics is None:
        return {}
    effects = label["effects"]
    result = {}
    for number, item in enumerate(effects):
        other = effects[1 - number] if len(effects) == 2 else None
        found = separation_of(
            statistics,
            item["id"],
            item["strength"],
            since=item["since"],
            partner=None if other is None else (other["id"], other["strength"], other["since"]),
            without=without,
        )
        if found is not None:
            result[item["id"]] = found
    return result


def _misfit(statistics: SessionStatistics | None) -> float | None:
    if statistics is None or statistics.probes == 0:
        return None
    return (statistics.chi_square - statistics.probes) / math.sqrt(2.0 * statistics.probes)


def _few(scores: Mapping[str, Any]) -> dict[str, Any]:
    return {key: scores[key] for key in ("cases", "top1", "exact", "none", "leading_hypothesis")}


def _by_protocol(outcomes: Sequence[Outcome], effects: Sequence[str]) -> dict[str, Any]:
    result = {}
    for name in ("full", "short", "products"):
        own = [item for item in outcomes if item.protocol == name]
        label = "full, series left out" if name == "full" else name
        if own:
            result[label] = _few(compute_scores(own, effects))
    return result


def aims_of(scores: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What was aimed at, what was found, and whether it was met; None where there was nothing to judge by."""
    if scores["leave_one_out"] is not None:
        left = scores["leave_one_out"]
        unknown, confident = left["unknown_from_5_sigma"], left["confident_wrong_name_from_5_sigma"]
        return [
            _aim("withheld effects come back unknown, from 5 sigma", unknown, "at least 80 %", lambda x: x >= 0.80),
            _aim("confident wrong names, from 5 sigma", confident, "at most 10 %", lambda x: x <= 0.10),
        ]
    full, every = scores["full_measurement_set"], scores["scores"]
    four = next(row for row in full["top1"]["single_by_sigma"] if row["sigma_from"] == 4)
    strong = full["strength"]["from_10_sigma"]
    return [
        _aim(
            "first name right, from 5 sigma", full["top1"]["single_from_5_sigma"], "at least 95 %", lambda x: x >= 0.95
        ),
        _aim("first name right, 4 to 5 sigma", four, "at least 80 %", lambda x: x >= 0.80),
        _number(
            "calibration error of the leading hypothesis",
            every["leading_hypothesis"]["error"],
            "at most 0.05",
            lambda x: x <= 0.05,
        ),
        _number(
            "calibration error of the effects' probabilities",
            every["effect_probabilities"]["error"],
            "at most 0.05",
            lambda x: x <= 0.05,
        ),
        _aim("false alarms without effect", every["none"]["false_alarms"], "at most 5 %", lambda x: x <= 0.05),
        _number(
            "area under the open-set curve", every["unknown"]["auroc"]["value"], "at least 0.95", lambda x: x >= 0.95
        ),
        _aim("both effects of a pair named, all", every["pairs"]["both_named"], "at least 80 %", lambda x: x >= 0.80),
        _aim(
            "both effects of a pair named, from 5 sigma",
            full["pairs"]["both_named_from_5_sigma"],
            "at least 80 %",
            lambda x: x >= 0.80,
        ),
        _aim("strength within 10 %, from 10 sigma", strong["within_10_percent"], "two thirds", lambda x: x >= 2 / 3),
        _aim(
            "95 % intervals of strength that hold it", strong["coverage_95"], "90 to 98 %", lambda x: 0.90 <= x <= 0.98
        ),
        _aim(
            "shrinkage right within 5 points", every["shrinkage"]["within_5_points"], "two thirds", lambda x: x >= 2 / 3
        ),
    ]


def _aim(name: str, found: Mapping[str, Any], aim: str, good: Any) -> dict[str, Any]:
    value = found["share"]
    return {
        "what": name,
        "aim": aim,
        "found": value,
        "low": found["low"] if value is not None else None,
        "high": found["high"] if value is not None else None,
        "n": found["n"],
        "met": None if value is None else bool(good(value)),
    }


def _number(name: str, value: float | None, aim: str, good: Any) -> dict[str, Any]:
    return {
        "what": name,
        "aim": aim,
        "found": value,
        "low": None,
        "high": None,
        "n": None,
        "met": None if value is None else bool(good(value)),
    }


def case_rows(check: OpenedCheck, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row a case, as `cases.csv` has them; several values of a cell are joined by `;`."""
    rows = []
    labels = [label for label in check.labels if label["stream"] == "case"]
    for label, outcome in zip(labels, outcomes, strict=True):
        truth = outcome.truth
        found = [outcome.found.get(name) for name in truth]
        detection = [outcome.separations[name].detection for name in truth if name in outcome.separations]
        rows.append(
            {
                "case": outcome.index,
                "label": outcome.label,
                "truth": ";".join(truth),
                "strength": _joined(outcome.strengths[name] for name in truth),
                "since": ";".join(outcome.since[name] for name in truth),
                "protocol": outcome.protocol,
                "geometry": outcome.geometry,
                "left_out": ";".join(outcome.leave_out),
                "withheld": ";".join(outcome.withheld),
                "sigma": _cell(outcome.sigma),
                "nearest": outcome.nearest,
                "sigma_from_top1": _cell(outcome.sigma_from_top1),
                "misfit": _cell(outcome.misfit),
                "detection_sigma": _cell(min(detection, default=None)),
                "verdict": outcome.verdict,
                "top1": outcome.top1,
                "named": ";".join(sorted(outcome.named)),
                "top1_right": int(top1_right(outcome)),
                "top_set_right": int(top_set_right(outcome)),
                "exactly_right": int(exactly_right(outcome)),
                "leading": ";".join(outcome.leading) or "none",
                "leading_probability": _cell(outcome.leading_probability),
                "p_truth": _joined(outcome.marginal.get(name, 0.0) for name in truth),
                "p_none": _cell(outcome.p_none),
                "p_unknown": _cell(outcome.p_unknown),
                "strength_found": _joined(None if item is None else item[0] for item in found),
                "strength_low": _joined(None if item is None else item[1] for item in found),
                "strength_high": _joined(None if item is None else item[2] for item in found),
                "shrinks_by": _cell(outcome.shrinks_by[0] if outcome.shrinks_by else None),
                "shrinkage_found": _cell(outcome.shrinkage_found[0] if outcome.shrinkage_found else None),
                "measured_s": _cell(outcome.measured_s),
                "seconds": _cell(outcome.seconds),
                "peak_memory_MB": _cell(outcome.peak_memory_MB),
                "error": outcome.error,
                "again": lab_command(label, size=check.options.size, frames=check.options.frames),
            }
        )
    return rows


def lab_command(label: Mapping[str, Any], *, size: int, frames: int | None) -> str:
    """The command that measures a case's session again."""
    words = ["raytwin lab -o session.h5", f"--protocol {label['protocol']}", f"--seed {label['session_seed']}"]
    words += [f"--size {size}", f"--geometry {label['geometry']}"]
    if frames is not None:
        words.append(f"--frames {frames}")
    words += [f"--effect {item['id']}={item['strength']!r}@{item['since']}" for item in label["effects"]]
    words += [f"--leave-out {name}" for name in label["leave_out"]]
    return " ".join(words)


def write_cases(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write `cases.csv`."""
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]) if rows else ["case"])
        writer.writeheader()
        writer.writerows(rows)


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _joined(values: Any) -> str:
    cells = [_cell(value) for value in values]
    return ";".join(cells) if any(cells) else ""

"""The part of a sweep's page that answers the requirement: verdicts, margins, what would help, the front, the screening."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..generator.line.twin import Z95
from ..reports import AFTER, BEFORE, QUIET, Chart, Figure, Line, Points, Rule
from ..reports.chart import Shape
from ._ticks import few_ticks
from .decision import FAILS, IMPOSSIBLE, LIKELY, MEETS, OPEN, WORDS, Change, change_text
from .pod_page import curve_marks

_DASH = "–"
_ORDER = (MEETS, LIKELY, OPEN, FAILS, IMPOSSIBLE)
_MOST_ROWS = 200
# settings by what is known of them, and how they are drawn
_POINTS: dict[str, tuple[str, Shape]] = {
    "recommended": (BEFORE, "square"),
    "on the front": (BEFORE, "circle"),
    "on the front, expected": (BEFORE, "diamond"),
    "not on the front": (AFTER, "circle"),
    "not on the front, expected": (QUIET, "diamond"),
}


def decision_part(answer: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Figure]]:
    """What `decision_report.html` needs, all None where the answer has no decision, no screening and one size alone; its figures."""
    decision, screening = answer["decision"], answer["screening"]
    both = next((row for row in answer["rows"] if row["recommended"] and (row["other_size"] or {}).get("line")), None)
    front = [] if decision is None else [_front_row(row) for row in decision["front"]]
    figures: dict[str, Figure] = {}
    if front:
        figures |= {f"expected_{name}": chart for name, chart in expected_charts(answer).items()}
    if both is not None:
        figures |= {f"both_{number}": chart for number, chart in enumerate(charts_of_both_sizes(both, answer))}
    if screening is not None and screening["observer"] is not None:
        figures["left_out"] = left_out_chart(screening["observer"]["left_out"])
    values = {
        "decided": None if decision is None else _decision(decision, answer["unit"]),
        "front": front,
        "both": None if both is None else both["label"],
        "screening": None if screening is None else _screening_text(screening),
    }
    return values, figures


def _decision(decision: Mapping[str, Any], unit: str) -> dict[str, Any]:
    settings = decision["settings"]
    taken = next((one for one in settings if one["setting"] == decision["recommended"]), None)
    ordered = sorted(
        settings,
        key=lambda one: (one is not taken, _ORDER.index(one["verdict"]), -_detection_margin(one), one["label"]),
    )
    counts = [(kind, sum(one["verdict"] == kind for one in settings)) for kind in _ORDER]
    return {
        "tally": [(kind, count) for kind, count in counts if count],
        "taken": None
        if taken is None
        else {
            "label": taken["label"],
            "verdict": taken["verdict"],
            "parts": [_part(one, unit) for one in taken["criteria"]],
            "changes": [change_text(Change(**one)) for one in taken["changes"]],
        },
        "changes_by": decision["changes_by"],
        "measurements": [one["text"] for one in decision["measurements"]],
        "names": [WORDS[one["name"]] for one in settings[0]["criteria"]] if settings else [],
        "settings": [_setting_row(one, one is taken) for one in ordered[:_MOST_ROWS]],
    }


def _detection_margin(one: Mapping[str, Any]) -> float:
    margin = one["criteria"][0]["margin"]
    return -math.inf if margin is None else float(margin)


def _part(one: Mapping[str, Any], unit: str) -> dict[str, str]:
    factor, digits, told = {
        "detection": (1.0, ".3g", f" {unit}".rstrip()),
        "false_alarms": (100.0, ".2g", " %"),
        "throughput": (60.0, ".3g", " a minute"),
        "dose": (1.0, ".3g", " uGy"),
    }[one["name"]]

    def shown(value: float | None) -> str:
        if value is None:
            return _DASH
        return (f"{factor * value:.0f}" if factor * value >= 1000 else f"{factor * value:{digits}}") + told

    return {
        "name": WORDS[one["name"]],
        "required": shown(one["required"]),
        "value": shown(one["value"]),
        "bound": shown(one["bound"]),
        "margin": _percent(one["margin"]),
        "verdict": one["verdict"],
    }


def _percent(margin: float | None, *, mark: str = "") -> str:
    return _DASH if margin is None else f"{100 * margin:+.0f} %{mark}"


def _setting_row(one: Mapping[str, Any], taken: bool) -> dict[str, Any]:
    return {
        "setting": one["setting"],
        "label": one["label"],
        "verdict": one["verdict"],
        "taken": taken,
        "margins": [_percent(part["margin"], mark=" *" if part["predicted"] else "") for part in one["criteria"]],
        "limited_by": ", ".join(WORDS[name] for name in one["limited_by"]),
        "not_yet_known": ", ".join(WORDS[name] for name in one["not_yet_known"]),
        "helps": change_text(Change(**one["changes"][0])) if one["changes"] and one["verdict"] != MEETS else "",
    }


def _front_row(row: Mapping[str, Any]) -> dict[str, str]:
    dose = row["dose_uGy"]
    return {
        "setting": row["setting"],
        "label": row["label"],
        "a90": f"{row['a90']:.3g}",
        "source": "observer" if row["predicted"] else "networks",
        "throughput": _DASH if row["throughput_per_s"] is None else f"{row['throughput_per_s']:.3g}",
        "dose": _DASH if dose is None else f"{dose['value']:.3g}",
    }


def _screening_text(screening: Mapping[str, Any]) -> str:
    observer = screening["observer"]
    text = f"{screening['trained']} settings were trained; a model observer decided {screening['screened']} others without training."
    if screening["undecided"]:
        text += f" {screening['undecided']} are undecided."
    if observer is None:
        return f"{text} It could not be calibrated: {screening['why_none']}"
    who = observer["observer"]
    text += (
        f" It is the {who['detector']} observer of the {who['image']} image, with an efficiency of {who['efficiency']:.3g} and an"
        f" internal noise of {who['internal_noise']:.3g}; settings left out of its calibration are met to"
        f" {100 * screening['left_out_rms']:.0f} % (rms, the networks' own error included)."
    )
    return " ".join([text, *(f"Its {warning}." for warning in screening["warnings"])])


def charts_of_both_sizes(row: Mapping[str, Any], answer: Mapping[str, Any]) -> list[Chart]:
    """POD of a setting over contrast and over length in mm, each with its 95 % band."""
    charts = []
    for size, curve in ((answer["size"], row), (answer["other_size"], row["other_size"])):
        title = "contrast" if size == "contrast" else "length of the object, mm"
        charts.append(
            Chart(
                name=f"pod_over_{'contrast' if size == 'contrast' else 'length'}",
                alt=f"POD over {title} with its 95 % band; dots: share of hits in groups of like size.",
                marks=[Rule(at=0.9), *curve_marks(curve)],
                x_label=title,
                y_label="probability of detection",
                y_ends=(-0.03, 1.03),
            )
        )
    return charts


def left_out_chart(rows: Sequence[Mapping[str, Any]]) -> Chart:
    """a90 of networks against what an observer calibrated on the other settings expects."""
    errors = [math.exp(Z95 * row["log_sd"]) for row in rows]
    predicted, measured = ([row[name] for row in rows] for name in ("predicted", "measured"))
    low = [value / error for value, error in zip(measured, errors, strict=True)]
    high = [value * error for value, error in zip(measured, errors, strict=True)]
    expected = [row["low"] for row in rows], [row["high"] for row in rows]
    every = [*low, *high, *predicted, *expected[0]]
    ends = 0.9 * min(every), 1.1 * max(every)
    return Chart(
        name="left_out_settings",
        alt="a90 of each trained setting against what the observer, calibrated on the others, expects; 95 % intervals of both.",
        marks=[
            Line(x=ends, y=ends, colour=QUIET, dashed=True, label="as expected"),
            Points(
                x=predicted,
                y=measured,
                x_ends=expected,
                y_ends=(low, high),
                names=[
                    str(row["label"]) if "label" in row else f"setting {number + 1}" for number, row in enumerate(rows)
                ],
            ),
        ],
        x_label="a90 that the observer expects",
        y_label="a90 of networks",
        x_ends=ends,
        y_ends=ends,
        height_px=400,
    )


def expected_charts(answer: Mapping[str, Any]) -> dict[str, Chart]:
    """a90 against throughput and against dose: of networks, and as the observer expects it; what is asked for."""
    front = {one["setting"] for one in answer["decision"]["front"]}
    required = answer["decision"]["requirement"]
    panels = {
        "pace": ("throughput_per_s", "products a minute", required["throughput_per_s"], 60.0),
        "dose": ("dose_uGy", "air kerma of a pair, µGy", required["dose_uGy"], 1.0),
    }
    charts = {}
    for panel, (name, title, limit, factor) in panels.items():
        groups: dict[str, list[tuple[float, float, str]]] = {kind: [] for kind in _POINTS}
        for row in answer["rows"]:
            a90 = row["a90"] if row["a90"] is not None else (row["predicted"] or {}).get("value")
            at = row[name]["value"] if isinstance(row[name], Mapping) else row[name]
            if a90 is None or at is None or not row["feasible"]:
                continue
            best = "on the front" if row["setting"] in front else "not on the front"
            kind = "recommended" if row["recommended"] else best if row["a90"] is not None else f"{best}, expected"
            groups[kind].append((factor * at, a90, str(row["label"])))
        marks: list[Any] = [Rule(at=required["size"], colour="#111111", label="asked for")]
        if limit is not None:
            marks.append(Rule(at=factor * limit, along="x", colour="#111111"))
        for kind, (colour, shape) in _POINTS.items():
            if groups[kind]:
                x, y, names = (list(column) for column in zip(*groups[kind], strict=True))
                size_px = 11.0 if kind == "recommended" else 7.0
                marks.append(Points(x=x, y=y, names=names, colour=colour, shape=shape, label=kind, size_px=size_px))
        found = [one for members in groups.values() for one in members]
        if not found:
            continue
        ticks, ends = few_ticks([*(one[0] for one in found), *([] if limit is None else [factor * limit])])
        charts[panel] = Chart(
            name=f"expected_a90_against_{panel}",
            alt=f"a90 against {title.partition(',')[0]}; expected: by the observer, where no networks were trained.",
            marks=marks,
            x_label=title,
            y_label="a90" + (f", {answer['unit']}" if answer["unit"] else ""),
            x_scale="log",
            x_ticks=ticks,
            x_ends=ends,
            y_ends=(0.0, 1.1 * max(*(one[1] for one in found), required["size"])),
            height_px=380,
        )
    return charts

"""The part of a sweep's page that answers the requirement: verdicts, margins, what would help, the front, the screening."""

import base64
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ._ticks import few_ticks
from .decision import FAILS, IMPOSSIBLE, LIKELY, MEETS, OPEN, WORDS, Change, change_text
from .figures import GENERATED, PUBLISHED, REAL, figure_with_axes, png_of

_DASH = "–"
_ORDER = (MEETS, LIKELY, OPEN, FAILS, IMPOSSIBLE)
_MOST_ROWS = 200


def decision_section(answer: Mapping[str, Any]) -> str:
    """The section as HTML, every text escaped; empty where the answer has no decision, no screening and one size alone."""
    import jinja2

    template = jinja2.Template(
        (Path(__file__).parent / "decision_report.html").read_text(encoding="utf-8"), autoescape=True
    )
    decision, screening = answer["decision"], answer["screening"]
    both = next((row for row in answer["rows"] if row["recommended"] and (row["other_size"] or {}).get("line")), None)
    if decision is None and screening is None and both is None:
        return ""
    front = [] if decision is None else [_front_row(row) for row in decision["front"]]
    section: str = template.render(
        decision=None if decision is None else _decision(decision, answer["unit"]),
        front=front,
        front_figure=_inline(plot_front_with_expected(answer)) if front else "",
        both=None if both is None else {"label": both["label"], "figure": _inline(plot_both_sizes(both, answer))},
        screening=None if screening is None else _screening(screening),
    )
    return section


def _inline(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()


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


def _screening(screening: Mapping[str, Any]) -> dict[str, Any]:
    observer = screening["observer"]
    text = f"{screening['trained']} settings were trained; a model observer decided {screening['screened']} others without training."
    if screening["undecided"]:
        text += f" {screening['undecided']} are undecided."
    if observer is None:
        return {"text": f"{text} It could not be calibrated: {screening['why_none']}", "figure": ""}
    who = observer["observer"]
    text += (
        f" It is the {who['detector']} observer of the {who['image']} image, with an efficiency of {who['efficiency']:.3g} and an"
        f" internal noise of {who['internal_noise']:.3g}; settings left out of its calibration are met to"
        f" {100 * screening['left_out_rms']:.0f} % (rms, the networks' own error included)."
    )
    return {"text": text, "figure": _inline(plot_left_out(observer["left_out"]))}


def plot_both_sizes(row: Mapping[str, Any], answer: Mapping[str, Any]) -> bytes:
    """POD of a setting over contrast and over length in mm, each with its 95 % band. PNG."""
    figure, axes = figure_with_axes(8.4, 3.2, 1, 2)
    curves = ((answer["size"], row), (answer["other_size"], row["other_size"]))
    for axis, (size, curve) in zip(axes[0], curves, strict=True):
        line = curve["line"]
        if line:
            at, pod, low, high = (np.array(line[name], dtype=float) for name in ("size", "pod", "low", "high"))
            axis.plot(at, pod, color=REAL)
            axis.fill_between(at, low, high, color=REAL, alpha=0.15, linewidth=0)
        for point in curve["points"]:
            axis.plot([point["size"]], [point["hits"] / point["n"]], "o", color="black", markersize=3)
        axis.axhline(0.9, color=PUBLISHED, linewidth=0.7, linestyle=":")
        axis.set(ylim=(-0.03, 1.03), xlabel="contrast" if size == "contrast" else "length of the object, mm")
    axes[0, 0].set_ylabel("probability of detection")
    return png_of(figure)


def plot_left_out(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """a90 of networks against what an observer calibrated on the other settings expects. PNG."""
    figure, axes = figure_with_axes(5.2, 4.6)
    axis = axes[0, 0]
    ends = []
    for row in rows:
        error = math.exp(1.96 * row["log_sd"])
        low, high = row["measured"] / error, row["measured"] * error
        axis.plot([row["predicted"]] * 2, [low, high], color=REAL, linewidth=1)
        axis.plot([row["low"], row["high"]], [row["measured"]] * 2, color=REAL, linewidth=1)
        axis.plot([row["predicted"]], [row["measured"]], "o", color=REAL, markersize=5)
        ends += [low, high, row["predicted"], row["low"], row["high"]]
    span = [0.9 * min(ends), 1.1 * max(ends)]
    axis.plot(span, span, color=PUBLISHED, linewidth=0.8, linestyle=":")
    axis.set(xlabel="a90 that the observer expects", ylabel="a90 of networks", xlim=span, ylim=span)
    return png_of(figure)


def plot_front_with_expected(answer: Mapping[str, Any]) -> bytes:
    """a90 against throughput and against dose: of networks (full), expected by the observer (empty), the front joined. PNG."""
    front = {one["setting"] for one in answer["decision"]["front"]}
    required = answer["decision"]["requirement"]
    figure, axes = figure_with_axes(11, 4.4, 1, 2)
    panels = (
        ("throughput_per_s", "products a minute", required["throughput_per_s"], 60.0),
        ("dose_uGy", "air kerma of a pair, uGy", required["dose_uGy"], 1.0),
    )
    for axis, (name, title, limit, factor) in zip(axes[0], panels, strict=True):
        points = []
        for row in answer["rows"]:
            a90 = row["a90"] if row["a90"] is not None else (row["predicted"] or {}).get("value")
            at = row[name]["value"] if isinstance(row[name], Mapping) else row[name]
            if a90 is None or at is None or not row["feasible"]:
                continue
            points.append((factor * at, a90, row["a90"] is not None, row["setting"] in front, row["recommended"]))
        for at, a90, trained, best, taken in points:
            colour = GENERATED if best else PUBLISHED
            face = colour if trained else "white"
            axis.plot(
                [at], [a90], "s" if taken else "o", color=colour, markerfacecolor=face, markersize=9 if taken else 5
            )
        axis.axhline(required["size"], color="black", linewidth=0.8, linestyle=":")
        if limit is not None:
            axis.axvline(factor * limit, color="black", linewidth=0.8, linestyle=":")
        axis.set(xscale="log", xlabel=title, ylabel="a90" + (f", {answer['unit']}" if answer["unit"] else ""))
        if points:
            ticks, ends = few_ticks([*(point[0] for point in points), *([] if limit is None else [factor * limit])])
            axis.set_xticks(list(ticks), list(ticks.values()))
            axis.minorticks_off()
            axis.set_xlim(*ends)
            axis.set_ylim(0, 1.1 * max(*(point[1] for point in points), required["size"]))
    for label, colour, face, marker in (
        ("recommended", GENERATED, GENERATED, "s"),
        ("on the front", GENERATED, GENERATED, "o"),
        ("beaten in all three", PUBLISHED, PUBLISHED, "o"),
        ("expected by the observer", PUBLISHED, "white", "o"),
        ("asked for", "black", "black", ":"),
    ):
        style = {"linestyle": ":"} if marker == ":" else {"marker": marker, "linestyle": "none"}
        axes[0, 0].plot([], [], color=colour, markerfacecolor=face, label=label, **style)
    figure.legend(fontsize=8, loc="outside upper left", ncols=5, frameon=False)
    return png_of(figure)

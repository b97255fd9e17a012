"""A sweep's answer as one self-contained HTML page."""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..files import whole_file
from ._ticks import few_ticks
from .decision_report import decision_section
from .figures import figure_with_axes, figure_with_panels, png_of
from .sweep_choice import paces
from .sweep_file import Campaign

_DASH = "–"
_TAKEN, _ALIKE, _OTHER, _FRONT = "#1b7f3b", "#335588", "#8a8a8a", "#c23b22"
_MOST_CURVES = 8
_CURVES_A_LINE = 4
_MOST_BARS = 60


def write_report(
    answer: Mapping[str, Any], path: Path, *, campaign: Campaign, seconds: Mapping[str, float], version: str
) -> Path:
    """Write the report of a sweep's answer (what `run_sweep` returns); returns its path.

    Args:
        answer: rows, recommendation and what it rests on.
        path: the page to write.
        campaign: whose settings of training and limits are told.
        seconds: what each setting took, by its text.
        version: of raytwin.
    """
    import jinja2

    rows = answer["rows"]
    shown = [row for row in rows if row["a90"] is not None]
    figures = {}
    if shown:
        figures["a90"] = plot_intervals(shown, size=_size_label(answer), goal=answer["goal"])
        figures["front"] = plot_front(shown, size=_size_label(answer))
    if any(row["line"] or row["points"] for row in rows):
        figures["pod"] = plot_curves(rows, size=_size_label(answer))
    template = jinja2.Template(
        (Path(__file__).parent / "sweep_report.html").read_text(encoding="utf-8"), autoescape=True
    )
    page = template.render(
        version=version,
        answer=answer,
        sentence=answer["sentence"],
        decision=decision_section(answer),
        size=_size_label(answer),
        other_size="contrast" if answer["other_size"] == "contrast" else "mm",
        trained=[_trained_row(row, seconds) for row in _in_order(rows) if row["trained"]],
        columns={
            name: any(row[name] is not None for row in rows if row["trained"]) for name in ("motion_px", "cnr_object")
        }
        | {"other": any(row["other_size"]["a90"] is not None for row in rows if row["trained"])},
        left_out=[_left_out_row(row) for row in rows if not row["trained"]],
        bars=_MOST_BARS if len(shown) > _MOST_BARS else 0,
        curves=_MOST_CURVES if sum(bool(row["line"] or row["points"]) for row in rows) > _MOST_CURVES else 0,
        notes=_notes(rows),
        recommended=next((row for row in rows if row["recommended"]), None),
        facts=_facts(campaign, answer),
        limits=_limits(campaign),
        figures={name: "data:image/png;base64," + base64.b64encode(png).decode() for name, png in figures.items()},
    )
    with whole_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def plot_intervals(rows: Sequence[Mapping[str, Any]], *, size: str, goal: float | None) -> bytes:
    """a90 of each setting with its two-sided 95 % interval and one-sided bound, the smallest bound first. PNG."""
    ordered = _in_order(rows)
    taken = [row for row in ordered[_MOST_BARS:] if row["recommended"]]
    ordered = [*ordered[: _MOST_BARS - len(taken)], *taken]
    figure, axes = figure_with_axes(10, 1.4 + 0.32 * len(ordered))
    axis = axes[0, 0]
    height = np.arange(len(ordered))[::-1]
    ends = [row[name] for row in ordered for name in ("a90", "a90_high", "a90_upper") if row[name] is not None]
    # bounds far beyond all estimates would squeeze the others; they stand in the table
    largest = max(*(row["a90"] for row in ordered), goal or 0.0, 0.0)
    end = min(1.06 * max([*ends, goal or 0.0]), 2.0 * largest)
    if any(row["a90_high"] is None for row in ordered):
        end = max(end, 1.4 * largest)  # room for the words beside an interval without an end
    for y, row in zip(height, ordered, strict=True):
        colour = _colour(row)
        low = 0.0 if row["a90_low"] is None else row["a90_low"]
        high = end if row["a90_high"] is None else min(row["a90_high"], end)
        axis.plot([low, high], [y, y], color=colour, linewidth=2.2 if row["recommended"] else 1.4)
        axis.plot([row["a90"]], [y], "o", color=colour, markerfacecolor=colour if row["recommended"] else "white")
        if row["a90_upper"] is not None:
            axis.plot([row["a90_upper"]], [y], "|", color=colour, markersize=11, markeredgewidth=1.6)
        if row["a90_high"] is None or row["a90_high"] > end:
            open_ended = "no upper end" if row["a90_low"] is not None else "no interval"
            told = open_ended if row["a90_high"] is None else f"to {row['a90_high']:.3g}"
            axis.annotate(
                told,
                (1.0, y),
                (-3, 4),
                xycoords=("axes fraction", "data"),
                textcoords="offset points",
                fontsize=7,
                color=colour,
                ha="right",
            )
    if goal is not None:
        axis.axvline(goal, color="black", linewidth=0.9, linestyle=":")
        axis.annotate(
            "goal", (goal, 0.0), (3, 3), xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8
        )
    axis.set_yticks(height, [row["label"] for row in ordered], fontsize=9)
    axis.set(xlim=(0, end), ylim=(-0.7, len(ordered) - 0.3))
    axis.set_xlabel(f"{size} at POD 90 %: estimate, two-sided 95 % interval, one-sided 95 % bound (tick)")
    for colour, label in ((_TAKEN, "recommended"), (_ALIKE, "not shown to be worse than the best"), (_OTHER, "worse")):
        if any(_colour(row) == colour for row in ordered):
            axis.plot([], [], "o-", color=colour, label=label)
    # below the axis: a legend inside would cover intervals
    axis.legend(fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    return png_of(figure)


def plot_front(rows: Sequence[Mapping[str, Any]], *, size: str) -> bytes:
    """a90 against pace and against dose, with those that no other setting beats in all three. PNG."""
    pace = paces(rows)
    belt = not any(row["throughput_per_s"] is not None for row in rows)
    panels = [
        (pace, "belt speed, mm/s" if belt else "throughput, products/s"),
        (
            [math.nan if row["dose_uGy"] is None else row["dose_uGy"]["value"] for row in rows],
            "air kerma of a pair, uGy",
        ),
    ]
    largest = max(row["a90"] for row in rows)
    ends = [row["a90_high"] for row in rows if row["a90_high"] is not None]
    top = min(1.06 * max([*ends, 1.1 * largest]), 2.0 * largest)
    figure, axes = figure_with_axes(11, 4.2, 1, 2)
    for column, (values, title) in enumerate(panels):
        axis = axes[0, column]
        for value, row in zip(values, rows, strict=True):
            if not (math.isfinite(value) and value > 0):
                continue
            # an interval without an end leaves the picture
            low, high = (end if row[name] is None else row[name] for name, end in (("a90_low", 0.0), ("a90_high", top)))
            colour = _TAKEN if row["recommended"] else _FRONT if row["pareto"] else _OTHER
            axis.plot([value, value], [low, high], color=colour, linewidth=1, alpha=0.6)
            axis.plot([value], [row["a90"]], "o", color=colour, markersize=9 if row["recommended"] else 6)
        axis.set(xscale="log", xlabel=title, ylabel=f"{size} at POD 90 %" if column == 0 else "")
        axis.set_ylim(0, top)
        few_ticks(axis, [value for value in values if math.isfinite(value) and value > 0])
    others = [row for row in rows if not row["recommended"]]
    kinds = [
        ("recommended", _TAKEN, len(others) < len(rows)),
        ("no other beats it in a90, dose and throughput", _FRONT, any(row["pareto"] for row in others)),
        ("beaten by another", _OTHER, any(not row["pareto"] for row in others)),
    ]
    for label, colour, there in kinds:
        if there:
            axes[0, 0].plot([], [], "o", color=colour, label=label)
    # of the whole figure: a legend of one panel would make that panel narrower
    figure.legend(fontsize=8, loc="outside upper left", ncols=3, frameon=False)
    return png_of(figure)


def plot_curves(rows: Sequence[Mapping[str, Any]], *, size: str) -> bytes:
    """POD curves with 95 % bands of the recommended setting, of those that no other beats, and of others up to eight. PNG."""
    fitted = [row for row in rows if row["line"] or row["points"]]
    ranked = sorted(
        fitted, key=lambda row: (not row["recommended"], not row["pareto"], row["a90"] is None, row["a90"] or 0.0)
    )
    chosen = ranked[:_MOST_CURVES]
    figure, axes = figure_with_panels(len(chosen), _CURVES_A_LINE, width=3.1, height=2.9)
    for number, (axis, row) in enumerate(zip(axes, chosen, strict=True)):
        colour = _colour(row)
        line = row["line"]
        if line:
            # where a band has no end there is null
            at, pod, low, high = (np.array(line[name], dtype=float) for name in ("size", "pod", "low", "high"))
            axis.plot(at, pod, color=colour)
            axis.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
        for point in row["points"]:
            axis.plot([point["size"]], [point["hits"] / point["n"]], "o", color="black", markersize=3)
        axis.axhline(0.9, color="grey", linewidth=0.7, linestyle=":")
        if row["a90"] is not None:
            axis.plot([row["a90"]], [0.9], "o", color=colour, markersize=5)
        axis.set(ylim=(-0.03, 1.03))
        axis.locator_params(axis="x", nbins=4)
        axis.set_title(str(row["label"]) + (" *" if row["recommended"] else ""), fontsize=9)
        if number + _CURVES_A_LINE >= len(chosen):
            axis.set_xlabel(size)
        if number % _CURVES_A_LINE == 0:
            axis.set_ylabel("probability of detection")
    return png_of(figure)


def _colour(row: Mapping[str, Any]) -> str:
    return _TAKEN if row["recommended"] else _ALIKE if row["alike"] or row["best"] else _OTHER


def _in_order(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Smallest upper bound first; those without a bound, then those without a90, last."""
    return sorted(
        rows,
        key=lambda row: (
            row["a90"] is None,
            row["a90_upper"] is None,
            row["a90_upper"] or row["a90"] or 0.0,
            str(row["label"]),
        ),
    )


def _size_label(answer: Mapping[str, Any]) -> str:
    return "contrast" if answer["size"] == "contrast" else "size, mm"


def _number(value: float | None, digits: str = ".3g") -> str:
    return _DASH if value is None else format(value, digits)


def _interval(low: float | None, high: float | None) -> str:
    return f"{_number(low)} to {_number(high)}"


def _ratio(ratio: Mapping[str, Any] | None) -> str:
    if not ratio or ratio["value"] is None:
        return _DASH
    if ratio["low"] is None and ratio["high"] is None:
        return f"{ratio['value']:.2f}"
    return f"{ratio['value']:.2f} ({_interval(ratio['low'], ratio['high'])})"


def _trained_row(row: Mapping[str, Any], seconds: Mapping[str, float]) -> dict[str, Any]:
    alarms, dose, ratio = row["false_alarm_rate"], row["dose_uGy"], row["ratio_to_best"]
    marks = []
    if row["recommended"]:
        marks.append("recommended")
    if row["best"] and not row["recommended"]:
        marks.append("smallest bound")
    if row["alike"]:
        marks.append("not shown to be worse")
    if row["pareto"]:
        marks.append("front")
    if row["reason"]:
        # the figures in brackets stand among the warnings
        marks.append(str(row["reason"]).partition(" (")[0])
    spent = seconds.get(row["setting"])
    return {
        "label": row["label"],
        "setting": f"{row['low']}; {row['high']}",
        "recommended": row["recommended"],
        "a90": _DASH if row["a90"] is None else f"{row['a90']:.3g} ({_interval(row['a90_low'], row['a90_high'])})",
        "upper": _number(row["a90_upper"]),
        "other": _other_size(row["other_size"]),
        "ratio": _ratio(ratio),
        "hits": f"{row['n_hits']}/{row['n']}",
        "alarms": _DASH
        if alarms is None
        else f"{100 * alarms['value']:.3g} % ({100 * alarms['low']:.2g} to {100 * alarms['high']:.2g})",
        "dose": _number(None if dose is None else dose["value"]),
        "throughput": _number(row["throughput_per_s"]),
        "motion": _number(row["motion_px"]),
        "cnr": _number(row["cnr_object"]),
        "extrapolated": "yes" if row["extrapolated"] else "no",
        "seconds": _DASH if spent is None else f"{spent:.0f}",
        "marks": "; ".join(marks),
    }


def _other_size(other: Mapping[str, Any]) -> str:
    return _DASH if other["a90"] is None else f"{other['a90']:.3g} ({_interval(other['a90_low'], other['a90_high'])})"


def _left_out_row(row: Mapping[str, Any]) -> dict[str, str]:
    dose = row["dose_uGy"]
    return {
        "label": row["label"],
        "setting": f"{row['low']}; {row['high']}",
        "kind": "cannot be" if not row["feasible"] else "not tried",
        "throughput": _number(row["throughput_per_s"]),
        "dose": _number(None if dose is None else dose["value"]),
        "cnr": _number(row["cnr_object"]),
        "reason": row["reason"],
    }


def _notes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Each warning once, with the settings that it belongs to."""
    where: dict[str, list[str]] = {}
    for row in rows:
        for line in row["warnings"]:
            where.setdefault(line, []).append(str(row["label"]))
    everywhere = len(rows)
    return [
        (line if len(labels) == everywhere else f"{'; '.join(labels[:4])}{' ...' if len(labels) > 4 else ''}: {line}")
        for line, labels in where.items()
    ]


def _facts(campaign: Campaign, answer: Mapping[str, Any]) -> list[str]:
    training, trying = campaign.training, campaign.trying
    marked = (
        f"a pixel is marked above a probability of {trying.threshold:g}"
        if trying.threshold is not None
        else f"each network's threshold lets {100 * trying.marked_share:g} % of the images it learnt from show a mark away from"
        " objects"
    )
    start = (
        f"they start from one network that learnt for {training.start_steps} steps from the"
        f" {'clearest images' if campaign.described else 'references'} and {training.mixed_steps} from noisier ones"
        if training.start_steps
        else "they start from random weights"
    )
    tests = "other products of it" if campaign.test_references is None else campaign.test_references.name
    counts = {row["objects"] for row in answer["rows"] if row["trained"]}
    tried = (
        f"Tried on {counts.pop()} foreign objects, the same at every setting"
        if len(counts) == 1
        else "Tried on held-back images"
    )
    return [
        f"Twin {campaign.twin.name}; images for training come from {campaign.references.name}, those to try networks on from"
        f" {tests}.",
        f"Each setting has {training.networks} networks, trained for {training.steps} steps on {training.images} pairs generated"
        f" at it (recipe {training.recipe}, batch {training.batch}); {start}.",
        f"{tried}; {marked}.",
    ]


def _limits(campaign: Campaign) -> list[str]:
    """The limits that the campaign states, in its own words."""
    stated = [f"{name} = {value:g}" for name, value in asdict(campaign.limits).items() if isinstance(value, float)]
    return stated if campaign.limits.extrapolation else [*stated, "extrapolation = false"]

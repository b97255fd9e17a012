"""What a gap means for detection, for the page of a diagnosis: POD before, after and as measured."""

from collections.abc import Mapping
from typing import Any

from ..diagnosis.report.report import Detection
from ..reports import AFTER, BEFORE, MEASURED, Band, Chart, Line, Points, Rule, SortedTable
from ..reports.chart import Shape
from ..results import between_text


def detection_of(task: Mapping[str, Any] | None) -> Detection | None:
    """The part of the page on a task (`campaign.task.run_task`); None without one."""
    if task is None:
        return None
    return Detection(
        text=task_text(task),
        rows=_rows(task),
        charts=pod_charts(task),
        warnings=task["warnings"],
        setting=task["setting"],
    )


def task_text(task: Mapping[str, Any]) -> str:
    """What the gap means for detection: a90 as the twin had it, as the improved twin has it, as measured."""
    unit = f" {task['unit']}" if task["unit"] else ""

    def told(name: str) -> str:
        return "none that the data support" if task[name] is None else _a90_text(task[name], task[f"{name}_95"], unit)

    what = "the size" if task["size"] == "size_mm" else "the contrast"
    start = f"In detection, {what} found in nine of ten cases (a90)"
    if not task["effects"]:
        text = f"{start} is {told('a90_before')} by the twin; measured: {told('a90_real')}."
    else:
        text = f"{start} moves from {told('a90_before')} to {told('a90_after')}; measured: {told('a90_real')}."
    for found in task.get("materials", ()):
        low, high = (found["contrast_change_percent"][name] for name in ("low_kV", "high_kV"))
        at_low, at_high = (f"{one['value']:+.2g} % ({one['low']:+.2g} to {one['high']:+.2g})" for one in (low, high))
        text += (
            f" The contrast of {found['material']} differs from the library's by {at_low} at the low voltage and by {at_high} at the"
            " high one."
        )
    if task.get("materials"):
        text += f" Images of the twin have it so; with the library's material a90 is {told('a90_library')}."
    return text


def pod_charts(task: Mapping[str, Any]) -> list[Chart]:
    """Share of objects detected against their size: the two twins' networks on their own images, and measured ones."""
    real = "measured_on_measured" if task["real_networks"] == "measured" else "after_on_measured"
    left: tuple[tuple[str, str, str, Shape], ...] = (
        ("before_on_before", "twin before", BEFORE, "square"),
        ("after_on_after", "twin after", AFTER, "circle"),
        (real, "measured", MEASURED, "triangle"),
    )
    right: tuple[tuple[str, str, str, Shape], ...] = (
        ("before_on_measured", "learnt from the twin before", BEFORE, "square"),
        ("after_on_measured", "learnt from the twin after", AFTER, "circle"),
        ("measured_on_measured", "learnt from measured images", MEASURED, "triangle"),
    )
    charts = []
    for name, which, title in (
        ("expected", left, "As expected, and as measured"),
        ("tried", right, "Tried on measured images"),
    ):
        marks: list[Any] = [Rule(at=0.9)]
        for key, label, colour, shape in which:
            curve = task["curves"].get(key)
            if curve is None:
                continue
            points, line = curve["points"], curve["line"]
            if line is not None:
                marks.append(Band(x=line["size"], low=line["low"], high=line["high"], colour=colour))
                marks.append(Line(x=line["size"], y=line["pod"], colour=colour, label=label))
            share = [one["hits"] / one["n"] for one in points]
            told = [f"{label}: {one['hits']} of {one['n']}" for one in points]
            without = label if line is not None else f"{label} (no curve)"
            marks.append(
                Points(
                    x=[one["size"] for one in points], y=share, colour=colour, shape=shape, label=without, names=told
                )
            )
        charts.append(
            Chart(
                name=f"pod_{name}",
                title=title,
                alt="Share of foreign objects detected against their size, with 95 % bands; dotted: 90 %.",
                marks=marks,
                x_label="longest side, mm" if task["size"] == "size_mm" else "contrast",
                y_label="share detected",
                y_ends=(-0.03, 1.03),
            )
        )
    return charts


def _rows(task: Mapping[str, Any]) -> SortedTable:
    """One line for each kind of networks and of images that they were tried on."""
    names = {
        "before": "twin before",
        "after": "twin after",
        "library": "twin after, objects of the library's material",
        "measured": "measured images",
    }

    rows = []
    for name, curve in task["curves"].items():
        networks, _, images = name.partition("_on_")
        interval, alarms = curve["a90_95_interval"], curve["false_alarms"]
        rows.append(
            (
                names[networks],
                names[images],
                f"{curve['n_hits']} of {curve['n']} ({curve['objects']} objects)",
                "none" if curve["a90"] is None else _a90_text(curve["a90"], interval),
                "" if alarms is None else f"{alarms['false_alarms']} of {alarms['n']}",
            )
        )
    header = ("networks learnt from", "tried on", "hits", "a90 (95 %)", "false alarms")
    return SortedTable(header=header, rows=tuple(rows), words=frozenset({0, 1}))


def _a90_text(value: float, interval: Mapping[str, float | None], unit: str = "") -> str:
    """An a90 with its interval, of which the data may give no end."""
    low, high = (None if end is None else f"{end:.3g}" for end in (interval["low"], interval["high"]))
    return f"{value:.3g}{unit} ({between_text(low, high)})"

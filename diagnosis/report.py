"""The diagnosis as one self-contained HTML page."""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files import whole_file
from .answer import Diagnosis
from .assemble import map_changes
from .explanation import location_text, paragraph, strained_text, strength_text, task_text, title_of
from .figures import plot_by_axis, plot_gap_maps, plot_hypotheses, plot_places, plot_task, plot_transmission_curves
from .inference import UNKNOWN

_VERDICTS = {
    "no_gap": "No gap",
    "explained": "Explained",
    "ambiguous": "These data cannot tell",
    "unknown_effect": "An effect that is not in the catalogue",
}


def residuals_after(diagnosis: Diagnosis) -> list[NDArray[np.float32]]:
    """Residual maps of each series with the leading hypothesis' effects added, DN."""
    problem = diagnosis.compared
    if not diagnosis.added:
        return [view.residual_DN for view in problem.views]
    changes = map_changes(problem, diagnosis.added)
    return [
        np.asarray(view.residual_DN - change, dtype=np.float32)
        for view, change in zip(problem.views, changes, strict=True)
    ]


def write_report(diagnosis: Diagnosis, answer: Mapping[str, Any], path: Path, *, version: str) -> Path:
    """Write the page; returns its path."""
    import jinja2

    after = residuals_after(diagnosis)
    figures = {
        "hypotheses": plot_hypotheses(diagnosis),
        "axes": plot_by_axis(diagnosis),
        "places": plot_places(diagnosis),
        "maps": plot_gap_maps(diagnosis, after),
        "curves": plot_transmission_curves(diagnosis, after),
    }
    task = answer.get("task")
    if task is not None:
        figures["task"] = plot_task(task)
    template = jinja2.Template((Path(__file__).parent / "report.html").read_text(encoding="utf-8"), autoescape=True)
    page = template.render(
        version=version,
        verdict="Labels look wrong" if diagnosis.mislabelled else _VERDICTS[diagnosis.verdict],
        doubts=[item.text for item in diagnosis.mislabelled],
        paragraph=paragraph(diagnosis) + ("" if task is None else f" {task_text(task)}"),
        task=None if task is None else _task_rows(task),
        task_warnings=[] if task is None else task["warnings"],
        task_setting="" if task is None else task["setting"],
        causes=[
            {
                "title": title_of(cause.effect),
                "id": cause.effect,
                "probability": f"{cause.probability:.3f}",
                "strength": strength_text(cause),
                "parameters": ", ".join(f"{name} {value:.3g}" for name, value in cause.parameters.items()),
                "since": "since the calibration" if cause.since == "calibration" else "always there",
            }
            for cause in diagnosis.causes
        ],
        hypotheses=[
            {
                "name": "no gap"
                if not item.effects
                else "an unknown effect"
                if item.effects == (UNKNOWN,)
                else " + ".join(title_of(effect) for effect in item.effects),
                "probability": f"{item.probability:.4f}",
            }
            for item in diagnosis.hypotheses
            if item.probability > 1e-4
        ][:12],
        where=[{**place, "location": location_text(place["location"])} for place in answer["where"]],
        threshold=f"{diagnosis.threshold_z:.1f}",
        missing=list(diagnosis.not_tested.items()),
        notes=diagnosis.notes,
        strained=strained_text(diagnosis),
        skipped=diagnosis.warnings[len(diagnosis.mislabelled) :],
        probes=len(diagnosis.compared.residual),
        nuisances=len(diagnosis.compared.factor_names),
        series=len(diagnosis.compared.views),
        next_measurement=diagnosis.next_measurement,
        inputs=answer["inputs"],
        figures={name: "data:image/png;base64," + base64.b64encode(png).decode() for name, png in figures.items()},
    )
    with whole_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def _task_rows(task: Mapping[str, Any]) -> list[dict[str, str]]:
    """One line for each kind of networks and of images that they were tried on."""
    names = {"before": "twin before", "after": "twin after", "measured": "measured images"}

    def shown(value: float | None) -> str:
        return "none" if value is None else f"{value:.3g}"

    rows = []
    for name, curve in task["curves"].items():
        networks, _, images = name.partition("_on_")
        interval, alarms = curve["a90_95_interval"], curve["false_alarms"]
        rows.append(
            {
                "networks": names[networks],
                "images": names[images],
                "hits": f"{curve['n_hits']} of {curve['n']} ({curve['objects']} objects)",
                "a90": f"{shown(curve['a90'])} ({shown(interval['low'])} to {shown(interval['high'])})",
                "false_alarms": "" if alarms is None else f"{alarms['false_alarms']} of {alarms['n']}",
            }
        )
    return rows

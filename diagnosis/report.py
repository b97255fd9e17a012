"""The diagnosis as one self-contained HTML page."""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files import whole_file
from .assemble import map_changes
from .diagnose import Diagnosis
from .explanation import paragraph, strength_text, title_of
from .figures import plot_by_axis, plot_gap_maps, plot_hypotheses, plot_places, plot_transmission_curves
from .inference import UNKNOWN

_VERDICTS = {
    "no_gap": "No gap",
    "explained": "Explained",
    "ambiguous": "These data cannot tell",
    "unknown_effect": "An effect that is not in the catalogue",
}


def residuals_after(diagnosis: Diagnosis) -> list[NDArray[np.float32]]:
    """Residual maps of each series with the leading hypothesis' effects added, DN."""
    problem = diagnosis.problem
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
    template = jinja2.Template((Path(__file__).parent / "report.html").read_text(encoding="utf-8"), autoescape=True)
    page = template.render(
        version=version,
        verdict=_VERDICTS[diagnosis.verdict],
        paragraph=paragraph(diagnosis),
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
        where=answer["where"],
        threshold=f"{diagnosis.threshold_z:.1f}",
        missing=sorted(diagnosis.problem.missing_effects.items()),
        skipped=diagnosis.warnings,
        probes=len(diagnosis.problem.residual),
        nuisances=len(diagnosis.problem.factor_names),
        series=len(diagnosis.problem.views),
        next_measurement=diagnosis.next_measurement,
        inputs=answer["inputs"],
        figures={name: "data:image/png;base64," + base64.b64encode(png).decode() for name, png in figures.items()},
    )
    with whole_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path

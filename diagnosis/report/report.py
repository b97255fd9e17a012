"""The diagnosis as one self-contained HTML page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...checks.findings import FindingCode
from ...generator.effects import EFFECTS
from ...reports import Figure, Picture, SortedTable, write_page
from ..inference.inference import title_of
from ..judgement.answer import Cause, Diagnosis
from ..judgement.held_out import MOST
from ..problem.assemble import map_changes
from ..session.binned_twin import effect_in_squares
from .explanation import compared_text, headline, lead_text, strained_text, verdict_text
from .figures import gap_maps, held_out_chart, hypotheses_chart, places_chart, transmission_curves
from .words import axis_text, location_text, share_text, statistic_text, strength_text, when_text


def residuals_after(diagnosis: Diagnosis) -> list[NDArray[np.float32]]:
    """Residual maps of each series with the leading hypothesis' effects added, DN; of the squares that were compared."""
    problem = diagnosis.compared
    if not diagnosis.added:
        return [view.residual_DN for view in problem.views]
    changes = map_changes(problem, [effect_in_squares(item, problem.side) for item in diagnosis.added])
    return [
        np.asarray(view.residual_DN - change, dtype=np.float32)
        for view, change in zip(problem.views, changes, strict=True)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """What the gap means for detection: in words, a line each kind of networks and images, POD curves, warnings, the setting."""

    text: str
    rows: SortedTable
    charts: Sequence[Figure]
    warnings: Sequence[str]
    setting: str


def write_report(
    diagnosis: Diagnosis,
    answer: Mapping[str, Any],
    path: Path,
    *,
    version: str,
    detection: Detection | None = None,
    interactive: bool | None = None,
) -> Path:
    """Write the page of a diagnosis and its plain values; returns its path.

    detection: of the task that was asked, if one was; interactive: figures answer to the pointer; None: where Bokeh is installed.
    """
    after = residuals_after(diagnosis)
    maps = gap_maps(diagnosis, after)
    # of the series with most gap; what changes the noise of frames or one line of pixels takes little of such a picture
    first = (2 if _shows(maps) else 0) if diagnosis.added else 1
    groups: dict[str, Sequence[Figure]] = {
        "map": maps,
        "curve": transmission_curves(diagnosis, after),
        "task": () if detection is None else detection.charts,
    }
    figures: dict[str, Figure] = {
        "held_out": held_out_chart(diagnosis),
        "places": places_chart(diagnosis),
        "hypotheses": hypotheses_chart(diagnosis),
    }
    names = {group: [f"{group}_{number}" for number in range(len(items))] for group, items in groups.items()}
    for group, items in groups.items():
        figures |= dict(zip(names[group], items, strict=True))
    return write_page(
        path,
        Path(__file__).parent / "report.html",
        version=version,
        figures=figures,
        interactive=interactive,
        headline=headline(diagnosis),
        paragraph=lead_text(diagnosis),
        whole_text=verdict_text(diagnosis),
        doubts=[item.line for item in diagnosis.findings],
        key_figures=_key_figures(diagnosis),
        proof=[*names["map"][:first], "held_out"],
        maps=names["map"][first:],
        curves=names["curve"],
        steps=next_steps(diagnosis),
        detection=detection,
        task_figures=names["task"],
        causes=_causes(diagnosis),
        where=_where(answer),
        threshold=f"{diagnosis.threshold_z:.1f}",
        missing=SortedTable(
            header=("effect that these series could not show", "why"),
            rows=tuple((title_of(effect), reason) for effect, reason in diagnosis.not_tested.items()),
            words=frozenset({0, 1}),
        ),
        compared=compared_text(diagnosis),
        notes=diagnosis.notes,
        strained=strained_text(diagnosis),
        skipped=diagnosis.warnings,
        probes=len(diagnosis.compared.residual),
        nuisances=len(diagnosis.compared.factor_names),
        inputs=answer["inputs"],
    )


def _shows(maps: Sequence[Picture]) -> bool:
    """Whether the first picture loses most of what it holds to the second, the same with what was found added."""
    squares = [float(np.nanmean(picture.values**2)) for picture in maps[:2]]
    return len(squares) == 2 and squares[1] < MOST * squares[0]


_LABELS = (
    "Check the series named above against the log of the measurement, correct them in the sidecar and import again."
)
_REMEDIES = {
    FindingCode.STOPS: "Find what cuts the numbers off (a lookup table, another bit depth, an export), and measure those series again"
    " without it.",
    FindingCode.SHADOW: "Clear the beam and measure those flats again; or declare them as what stood in it.",
}


def _step(text: str, command: str = "") -> dict[str, str]:
    return {"text": text, "command": command}


def next_steps(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """What to do with the answer, most useful first: a sentence each, with a command where there is one."""
    measure = diagnosis.next_measurement
    measured = (
        [_step(f"Measure: {measure['text']}.", "raytwin diagnose SESSION -o again --also NEW_SESSION")]
        if measure and measure.get("text")
        else []
    )
    if diagnosis.findings:
        measured = [
            *(_step(text) for text in dict.fromkeys(_REMEDIES.get(item.code, _LABELS) for item in diagnosis.findings)),
            _step("Diagnose the session again.", "raytwin diagnose SESSION -o diagnosis"),
            *measured,
        ]
    if diagnosis.no_gap_but_findings:
        return measured
    if diagnosis.verdict == "no_gap":
        return [
            _step(
                "Use the twin as it is.",
                "raytwin generate TWIN REFERENCES --low SETTING --high SETTING -n 80 -o images.h5",
            ),
            *measured,
        ]
    if diagnosis.verdict == "unknown_effect":
        return [
            *measured,
            _step("Look at the maps and probes below: the place of the gap says which part of the line to inspect."),
            _step("Describe the effect in a file of your own, if you know its equation (documentation: effects)."),
        ]
    if diagnosis.verdict == "ambiguous":
        return [*measured, *_confirmed_by(diagnosis.causes[:3])]
    if diagnosis.gap.tested and not (diagnosis.gap.falls or diagnosis.gap.at_floor):
        return [
            _step(
                "Keep the twin as it was: the gap on series that the fit did not use does not fall with the improved twin beside"
                " this page."
            ),
            *measured,
            _step("Look at the maps and probes below: what is left says where the law is off."),
            *_confirmed_by(diagnosis.leading),
        ]
    use = _step(
        "Use the improved twin that lies beside this page; every command takes it.",
        "raytwin predict twin.h5 --kv 60 --power-w 40 --exposure-ms 20",
    )
    return [*([use] if diagnosis.added else []), *measured, *_confirmed_by(diagnosis.leading)]


def _confirmed_by(causes: Sequence[Cause]) -> list[dict[str, str]]:
    """The measurement that shows each cause by itself."""
    known = [cause.effect for cause in causes if cause.effect in EFFECTS]
    return [_step(f"To confirm {title_of(effect).lower()}: {EFFECTS[effect].isolated_by}.") for effect in known]


def _key_figures(diagnosis: Diagnosis) -> list[dict[str, str]]:
    gap = diagnosis.gap
    found = [
        {"value": f"{cause.probability:.2f}", "text": f"probability of {title_of(cause.effect).lower()}"}
        for cause in diagnosis.leading
    ]
    if diagnosis.verdict == "no_gap" or diagnosis.no_gap_but_findings:
        where = " in the other series" if diagnosis.findings else ""
        found = [
            {"value": f"{diagnosis.probability_no_gap:.2f}", "text": f"probability that nothing is missing{where}"}
        ]
    elif diagnosis.verdict == "unknown_effect":
        found = [
            {"value": f"{diagnosis.probability_unknown:.2f}", "text": "probability of an effect outside the catalogue"}
        ]
    removes = bool(diagnosis.added) and gap.tested
    if removes:
        found.append(
            {
                "value": f"{gap.before:.2f} → {gap.after:.2f}",
                "text": f"gap on series that the fit did not use (noise alone: {gap.floor:.2f})",
            }
        )
    else:
        found.append({"value": f"{gap.before:.2f}", "text": f"gap (noise alone: {gap.floor:.2f})"})
    if removes and gap.shrinks_by is not None:
        value, low, high = (100.0 * min(one, 1.0) for one in gap.shrinks_by)
        text = f"of the gap above noise is removed (95 %: {low:.0f} to {high:.0f} %)"
        if not gap.falls:
            value, text = -value, f"more gap above noise, none is removed (95 %: {-high:.0f} to {-low:.0f} %)"
        found.append({"value": f"{value:.0f} %", "text": text})
    return found


def _causes(diagnosis: Diagnosis) -> SortedTable:
    rows = [
        (
            title_of(cause.effect),
            cause.effect,
            f"{cause.probability:.3f}",
            strength_text(cause),
            ", ".join(f"{name} {value:.3g}" for name, value in cause.parameters.items()),
            when_text(cause),
            share_text(cause.shrinks_by) if diagnosis.gap.tested else "",
            f"{100.0 * cause.level:.0f} %",
        )
        for cause in diagnosis.causes
    ]
    header = ("effect", "id", "probability", "strength (95 %)", "inner parameters", "when", "gap removed", "law off by")
    return SortedTable(header=header, rows=tuple(rows), words=frozenset({0, 1, 3, 4, 5}))


def _where(answer: Mapping[str, Any]) -> SortedTable:
    rows = [
        (
            axis_text(place["axis"]),
            place["series"],
            statistic_text(place["statistic"]),
            location_text(place["location"]),
            f"{place['z']:+.1f}",
        )
        for place in answer["where"]
    ]
    header = ("axis", "series", "statistic", "location", "z")
    return SortedTable(header=header, rows=tuple(rows), words=frozenset({0, 1, 2, 3}))

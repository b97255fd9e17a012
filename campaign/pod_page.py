"""Page of a probability-of-detection curve."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import FitError
from ..pod import PodFit, ResponseFit, Trials
from ..pod.answer import trusted_from_answer
from ..pod.band import curve_rows
from ..pod.plots import grouped_hits
from ..reports import AFTER, BEFORE, Band, Chart, KeyFigure, Line, Points, ResultPage, Rule, Section, SortedTable, Step
from ..reports.chart import Mark, Shape

_BOUNDS = {"modified": "likelihood ratio, for few trials", "likelihood_ratio": "likelihood ratio", "wald": "Wald"}


def pod_page(
    fit: PodFit | ResponseFit,
    trials: Trials | None,
    answer: Mapping[str, Any],
    *,
    response: tuple[Sequence[float], Sequence[float]] | None = None,
) -> ResultPage:
    """The curve with its a90 and bounds, or why there is none.

    Args:
        fit: of hits, or of a continuous response.
        trials: hits and misses; None for a response.
        answer: what `raytwin pod --json` prints.
        response: sizes and responses (row,), of a continuous response.
    """
    size = str(answer["size"])
    a90, bound = answer["a90"], trusted_from_answer(answer, "a90_95")
    key = []
    if a90 is None:
        lines = [f"These data support no a90: {_reason(answer)}."]
    else:
        lines = [f"An object of {size} {a90:.3g} is found nine times in ten."]
        key.append(KeyFigure(value=f"{a90:.3g}", text=f"a90, {size}"))
    if bound is not None:
        lines.append(f"With 95 % confidence the {size} at which that holds lies below {bound:.3g}.")
        key.append(KeyFigure(value=f"{bound:.3g}", text="a90/95, its one-sided 95 % bound"))
    if "n_hits" in answer:
        key.append(KeyFigure(value=f"{answer['n_hits']} of {answer['n']}", text="objects detected"))
    alarms = answer.get("false_alarms")
    if alarms:
        ends = f"95 %: {100 * alarms['low']:.3g} to {100 * alarms['high']:.3g} %"
        key.append(KeyFigure(value=f"{100 * alarms['rate']:.3g} %", text=f"false alarms ({ends})"))
    steps = []
    if a90 is None or bound is None:
        steps.append(
            Step(
                text="Ask how many images and networks an a90 needs.",
                command="raytwin plan --pilot HITS.csv --wanted SIZE",
            )
        )
    steps.append(
        Step(text="Compare this curve with that of measured images.", command="raytwin compare REAL.csv HITS.csv")
    )
    charts = [_response_chart(fit, response, size)] if response is not None and isinstance(fit, ResponseFit) else []
    if trials is not None and isinstance(fit, PodFit):
        charts.append(pod_chart(fit, trials, size=size, bound=bound))
    warnings = tuple(str(line) for line in answer["warnings"])
    return ResultPage(
        heading="Probability of detection",
        answer=tuple(lines),
        key_figures=tuple(key),
        proof=tuple(charts),
        steps=tuple(steps),
        sections=(
            *([Section(title=f"Warnings ({len(warnings)})", items=warnings)] if warnings else []),
            Section(title="Numbers", text=(_method(answer),), table=_numbers(answer)),
        ),
        doubtful=a90 is None,
    )


def pod_chart(fit: PodFit, trials: Trials, *, size: str, bound: float | None) -> Chart:
    """The curve with its 95 % band, the share of hits in groups of like size, a90 and its bound."""
    marks: list[Any] = [Rule(at=0.9)]
    try:
        line = curve_rows(fit)
    except FitError:
        line = None  # the page says why
    if line is not None:
        marks += [
            Band(x=line["size"], low=line["low"], high=line["high"], label="95 % band"),
            Line(x=line["size"], y=line["pod"], label="POD"),
        ]
    groups = grouped_hits(trials, log_size=fit.log_size)
    told = [f"{hits:g} of {total:g}" for hits, total in zip(groups["hits"], groups["n"], strict=True)]
    share = groups["hits"] / groups["n"]
    marks.append(Points(x=groups["size"], y=share, names=told, colour="#111111", label="share of hits, grouped"))
    if fit.a90 is not None:
        marks.append(Rule(at=fit.a90, along="x", colour=AFTER, label="a90"))
    if bound is not None:
        marks.append(Rule(at=bound, along="x", colour=BEFORE, label="a90/95"))
    return Chart(
        name="pod_curve",
        alt="POD against size with its two-sided 95 % band, each size for itself; dots: share of hits in groups of like size.",
        marks=marks,
        x_label=size,
        y_label="probability of detection",
        x_scale="log" if fit.log_size else "linear",
        y_ends=(-0.03, 1.03),
        wide=True,
        height_px=420,
    )


def curve_marks(
    curve: Mapping[str, Any],
    *,
    colour: str = AFTER,
    label: str = "",
    dashed: bool = False,
    band: bool = True,
    of_points: tuple[str, Shape] = ("#111111", "circle"),
) -> list[Mark]:
    """A fitted curve with its 95 % band, and the share of hits in groups of like size; empty where there is neither.

    curve: `line` (columns size, pod, low, high; None where a band has no end) and `points` (size, hits, n) of a fit's answer.
    """
    marks: list[Mark] = []
    line, points = curve["line"], curve["points"]
    if line:
        size, pod, low, high = (np.array(line[name], dtype=float) for name in ("size", "pod", "low", "high"))
        marks += [Band(x=size, low=low, high=high, colour=colour)] if band else []
        marks.append(Line(x=size, y=pod, colour=colour, label=label, dashed=dashed))
    if points:
        marks.append(
            Points(
                x=[one["size"] for one in points],
                y=[one["hits"] / one["n"] for one in points],
                names=[f"{one['hits']} of {one['n']}" for one in points],
                colour=of_points[0],
                shape=of_points[1],
                label="" if line else label,
                size_px=6.0,
            )
        )
    return marks


def a90_chart(kinds: Sequence[tuple[str, str, Shape, Mapping[float, tuple[float, float, float]]]]) -> Chart:
    """Contrast at POD 90 % with its 95 % interval against exposure.

    kinds: of test images: label, colour, shape, and exposure, ms -> (a90, low, high).
    """
    marks: list[Mark] = []
    for place, (label, colour, shape, found) in enumerate(kinds):
        if found:
            a90, low, high = (list(column) for column in zip(*found.values(), strict=True))
            marks.append(
                Points(
                    # side by side: intervals of one exposure must not hide each other
                    x=[exposure * (1.0 + 0.06 * (place - 0.5 * (len(kinds) - 1))) for exposure in found],
                    y=a90,
                    y_ends=(low, high),
                    names=[f"{exposure:g} ms" for exposure in found],
                    colour=colour,
                    shape=shape,
                    label=label,
                )
            )
    exposures = sorted({exposure for *_, found in kinds for exposure in found})
    return Chart(
        name="a90_of_exposure",
        title="a90 against exposure",
        alt="Contrast at POD 90 % with its 95 % interval against exposure, by kind of test images.",
        marks=marks,
        x_label="exposure, ms",
        y_label="contrast at POD 90 %",
        x_scale="log",
        x_ticks={exposure: f"{exposure:g}" for exposure in exposures},
        x_ends=(exposures[0] / 1.3, exposures[-1] * 1.3) if exposures else None,
    )


def _response_chart(fit: ResponseFit, response: tuple[Sequence[float], Sequence[float]], size: str) -> Chart:
    """Responses against size with the decision threshold."""
    sizes, values = (np.asarray(column, float) for column in response)
    return Chart(
        name="responses",
        alt="Response of every object against its size, with the threshold above which it counts as detected.",
        marks=[Points(x=sizes, y=values, label="measured"), Rule(at=float(fit.decision), label="decision")],
        x_label=size,
        y_label="response",
        x_scale="log" if fit.log_size else "linear",
        wide=True,
        height_px=420,
    )


def _reason(answer: Mapping[str, Any]) -> str:
    return (
        str(answer["warnings"][0]).rstrip(".")
        if answer["warnings"]
        else "the curve does not reach 90 % within the tested sizes"
    )


def _method(answer: Mapping[str, Any]) -> str:
    words = {"link": "link", "method": "fitted by", "repeats": "repeated looks"}
    told = [f"{label} {answer[name]}" for name, label in words.items() if answer.get(name)]
    return f"{'; '.join(told)}.".capitalize() if told else ""


def _numbers(answer: Mapping[str, Any]) -> SortedTable:
    def told(value: float | None) -> str:
        return "none" if value is None else f"{value:.5g}"

    rows = [("a50", told(answer["a50"])), ("a90", told(answer["a90"]))]
    for key, title in (("a90_95", "a90/95, one-sided"), ("a90_95_two_sided", "a90, upper end of the two-sided 95 %")):
        bounds = answer[key]
        rows += [(f"{title} ({text})", told(bounds[name])) for name, text in _BOUNDS.items() if name in bounds]
    rows += [
        (name, told(answer[key]))
        for name, key in (("intercept", "c0"), ("slope", "c1"), ("deviance", "deviance"))
        if key in answer
    ]
    return SortedTable(header=("quantity", "value"), rows=tuple(rows))

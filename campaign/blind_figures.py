"""Charts and tables of a blind check's page."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..generator.effects import EFFECTS
from ..reports import AFTER, BEFORE, MEASURED, QUIET, Chart, Line, Points, Rule, SortedTable
from ..reports.chart import SERIES_COLOURS, SHAPES, Shape
from .blind_scores import FAILED, NONE, UNKNOWN, Outcome, strength_rows, top1_right
from .blind_separation import NO_EFFECT

_LIMIT = 3.05  # sigma at which a perfect method with 20 orthogonal signatures and 5 % false alarms names half
_TICKS = {float(one): str(one) for one in (1, 2, 3, 4, 5, 10, 20, 50)}
_RATIOS = {one: f"{one:g}" for one in (0.2, 0.5, 0.9, 1.1, 2.0, 5.0)}
_LABELS: dict[str, tuple[str, Shape]] = {"single": (AFTER, "circle"), "pair": (BEFORE, "triangle")}
_VERDICTS = ("no_gap", "explained", "explained_in_part", "ambiguous", UNKNOWN, FAILED)


def _words(name: str) -> str:
    return name.replace("_", " ")


def accuracy_charts(scores: Mapping[str, Any], baselines: Mapping[str, Mapping[str, Any]]) -> tuple[Chart, Chart]:
    """Share of right first names against the separation, with 95 % intervals, and the same for baselines."""
    sigma = np.geomspace(0.5, 60, 120)
    perfect = [0.5 * (1.0 + math.erf((value - _LIMIT) / math.sqrt(2.0))) for value in sigma]
    marks: list[Any] = [
        Line(x=sigma, y=perfect, colour=QUIET, dashed=True, label="a perfect method, 20 orthogonal signatures")
    ]
    for place, (key, label) in enumerate(
        (("top1", "first name right"), ("top_set", "truth among the names"), ("exact", "truth and nothing else"))
    ):
        rows = [row for row in scores[key]["single_by_sigma"] if row["n"]]
        if rows:
            marks.append(
                Points(
                    # side by side: intervals of one group must not hide each other
                    x=[_middle(row) * (1.0 + 0.04 * (place - 1)) for row in rows],
                    y=[row["share"] for row in rows],
                    y_ends=([row["low"] for row in rows], [row["high"] for row in rows]),
                    names=[f"{row['hits']} of {row['n']}" for row in rows],
                    colour=(AFTER, MEASURED, BEFORE)[place],
                    shape=SHAPES[place],
                    label=label,
                )
            )
    beside: list[Any] = []
    for place, (name, entry) in enumerate([("diagnosis", scores), *baselines.items()]):
        rows = [row for row in entry["top1"]["single_by_sigma"] if row["n"]]
        if rows:
            x, y = [_middle(row) for row in rows], [row["share"] for row in rows]
            colour, names = SERIES_COLOURS[place % len(SERIES_COLOURS)], [f"n = {row['n']}" for row in rows]
            shape = SHAPES[place % len(SHAPES)]
            beside += [
                Line(x=x, y=y, colour=colour, thin=name != "diagnosis"),
                Points(x=x, y=y, colour=colour, shape=shape, names=names, label=_words(name)),
            ]
    common: dict[str, Any] = {
        "x_label": "separation from the nearest other model, sigma",
        "x_scale": "log",
        "x_ticks": _TICKS,
        "x_ends": (0.5, 60.0),
        "y_ends": (-0.02, 1.04),
        "height_px": 400,
    }
    return (
        Chart(
            name="accuracy",
            title="Single effects, full measurement set",
            alt="Share of cases against the separation, with 95 % intervals.",
            marks=marks,
            y_label="share of cases",
            **common,
        ),
        Chart(
            name="accuracy_of_baselines",
            title="Beside simple methods",
            alt="Share of single effects whose first name is right.",
            marks=beside,
            y_label="first name right",
            **common,
        ),
    )


def _middle(row: Mapping[str, Any]) -> float:
    low, high = max(row["sigma_from"], 1.0), row["sigma_to"] or 30.0
    return math.sqrt(low * high)


def reliability_charts(scores: Mapping[str, Any], baselines: Mapping[str, Mapping[str, Any]]) -> tuple[Chart, ...]:
    """Share of cases that were right against the probability that was stated."""
    charts = []
    for key, title in (
        ("leading_hypothesis", "The most probable hypothesis"),
        ("effect_probabilities_offered", "Each effect that was offered with 2 % or more"),
    ):
        marks: list[Any] = [Line(x=[0, 1], y=[0, 1], colour=QUIET, dashed=True, label="honest")]
        curve = scores[key]["curve"]
        if curve:
            marks.append(
                Points(
                    x=[row["probability"] for row in curve],
                    y=[row["share"] for row in curve],
                    y_ends=([row["low"] for row in curve], [row["high"] for row in curve]),
                    names=[f"n = {row['n']}" for row in curve],
                    label="diagnosis",
                )
            )
        other = baselines["classifier"][key]["curve"] if "classifier" in baselines else []
        if other:
            marks.append(
                Points(
                    x=[row["probability"] for row in other],
                    y=[row["share"] for row in other],
                    names=[f"n = {row['n']}" for row in other],
                    colour=BEFORE,
                    shape="square",
                    label="classifier",
                )
            )
        charts.append(
            Chart(
                name=f"reliability_{key}",
                title=title,
                alt="Share that was true against the stated probability, with 95 % intervals.",
                marks=marks,
                x_label="stated probability",
                y_label="share that was true",
                x_ends=(-0.02, 1.02),
                y_ends=(-0.02, 1.06),
                height_px=380,
            )
        )
    return tuple(charts)


def confusion_table(outcomes: Sequence[Outcome]) -> SortedTable:
    """First names by what was true: singles, no effect and unknown ones."""
    rows: dict[str, Counter[str]] = {}
    for item in outcomes:
        if item.label != "pair":
            rows.setdefault(item.truth[0] if item.truth else NONE, Counter())[item.top1] += 1
    order = [name for name in (NONE, *EFFECTS, *sorted(set(rows) - {NONE, *EFFECTS})) if name in rows]
    return SortedTable(
        header=("planted", "cases", "first names"),
        rows=tuple(
            (
                _words(name),
                str(rows[name].total()),
                ", ".join(f"{_words(top1)} {count}" for top1, count in rows[name].most_common()),
            )
            for name in order
        ),
        words=frozenset({0, 2}),
    )


def distance_table(distances: Mapping[str, Mapping[str, float]]) -> SortedTable:
    """Median distance of planted effects from none and from the other effects, the nearest first."""
    rows = []
    for name, others in distances.items():
        known = {other: value for other, value in others.items() if math.isfinite(value)}
        none = known.pop(NO_EFFECT, math.nan)
        nearest = sorted(known.items(), key=lambda item: item[1])
        rows.append(
            (
                _words(name),
                f"{none:.3g}" if math.isfinite(none) else "–",
                ", ".join(f"{_words(other)} {value:.3g}" for other, value in nearest),
            )
        )
    header = ("planted", "from none, sigma", "from each other effect, sigma")
    return SortedTable(header=header, rows=tuple(rows), words=frozenset({0, 2}))


def strength_chart(outcomes: Sequence[Outcome]) -> Chart:
    """Strength found over strength planted, of named effects, against their separation."""
    rows = [row for row in strength_rows(outcomes) if row["sigma"] is not None and row["value"] * row["true"] > 0]
    marks: list[Any] = [Rule(at=1.0), Rule(at=0.9), Rule(at=1.1), Rule(at=10.0, along="x")]
    for number, name in enumerate(dict.fromkeys(row["effect"] for row in rows)):
        own = [row for row in rows if row["effect"] == name]
        ends = [sorted((row["low"] / row["true"], row["high"] / row["true"])) for row in own]
        marks.append(
            Points(
                x=[max(row["sigma"], 0.5) for row in own],
                y=[row["value"] / row["true"] for row in own],
                y_ends=([low for low, _ in ends], [high for _, high in ends]),
                names=[f"{_words(name)}, planted {row['true']:.3g}" for row in own],
                colour=SERIES_COLOURS[number % len(SERIES_COLOURS)],
                shape=SHAPES[number % len(SHAPES)],
                label=_words(name),
                size_px=5.0,
            )
        )
    return Chart(
        name="strengths",
        alt="Strength found over planted, with 95 % intervals; 0.5 sigma and less at 0.5. Dotted: 10 % off.",
        marks=marks,
        x_label="separation, sigma",
        y_label="strength found / planted",
        x_scale="log",
        y_scale="log",
        x_ticks=_TICKS,
        y_ticks=_RATIOS,
        y_ends=(0.2, 5.0),
        wide=True,
        height_px=520,
    )


def limit_charts(outcomes: Sequence[Outcome]) -> tuple[Chart, ...]:
    """Probability given to each planted effect against its strength, a chart an effect that was planted."""
    charts = []
    for name, effect in EFFECTS.items():
        marks = []
        for label, (colour, shape) in _LABELS.items():
            own = [item for item in outcomes if name in item.truth and item.label == label]
            if own:
                right = [top1_right(item) if label == "single" else name in item.named for item in own]
                marks.append(
                    Points(
                        x=[abs(item.strengths[name]) for item in own],
                        y=[item.marginal.get(name, 0.0) for item in own],
                        names=[
                            "named" if one else f"not named: {_words(item.top1)}"
                            for one, item in zip(right, own, strict=True)
                        ],
                        colour=colour,
                        shape=shape,
                        label={"single": "alone", "pair": "in a pair"}[label],
                    )
                )
        if marks:
            low, high = effect.strength.low, effect.strength.high
            charts.append(
                Chart(
                    name=f"limit_{name}",
                    title=_words(name),
                    alt="Probability given to the planted effect against its strength.",
                    marks=marks,
                    x_label=f"strength, {effect.strength.unit}",
                    y_label="probability",
                    x_scale="log",
                    x_ticks={value: f"{float(f'{value:.2g}'):g}" for value in (low, math.sqrt(low * high), high)},
                    x_ends=(low * 0.8, high * 1.25),
                    y_ends=(-0.05, 1.05),
                    height_px=260,
                )
            )
    return tuple(charts)


def unknown_chart(outcomes: Sequence[Outcome]) -> Chart:
    """Share of cases in which an unknown effect has a probability up to so much, by what was true."""
    marks = []
    for label, colour in zip(("none", "single", "pair", "unknown"), SERIES_COLOURS, strict=False):
        values = np.sort([item.p_unknown for item in outcomes if item.label == label])
        if values.size:
            x = np.concatenate([[0.0], np.repeat(values, 2), [1.0]])
            y = np.repeat(np.arange(values.size + 1) / values.size, 2)
            marks.append(Line(x=x, y=y, colour=colour, label=label))
    return Chart(
        name="unknown",
        alt="Share of cases up to a stated probability of an unknown effect, by what was true.",
        marks=marks,
        x_label="stated probability of an unknown effect",
        y_label="share of cases up to it",
        x_ends=(-0.02, 1.02),
        y_ends=(0.0, 1.02),
    )


def verdict_table(outcomes: Sequence[Outcome]) -> SortedTable:
    """Cases by what was true and by the verdict."""
    labels = [label for label in ("none", "single", "pair", "unknown") if any(item.label == label for item in outcomes)]
    counts = Counter((item.label, item.verdict) for item in outcomes)
    return SortedTable(
        header=("planted", *map(_words, _VERDICTS)),
        rows=tuple((label, *(str(counts[label, verdict]) for verdict in _VERDICTS)) for label in labels),
    )

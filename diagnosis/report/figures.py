"""Pictures of a diagnosis: gap maps, curves by axis, before and after, hypotheses."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ...reports import AFTER, BEFORE, Bars, Chart, Line, Picture, Points, Rule
from ...reports.chart import SERIES_COLOURS, SHAPES, asinh_ticks, rows_px
from ..arrays import FloatArray, RealArray
from ..inference.inference import title_of
from ..judgement.answer import Diagnosis
from ..problem.series_block import SeriesView
from ..session.even_maps import NEIGHBOURS_PX
from .words import axis_text, statistic_text

_MAPS = 4  # series whose maps are drawn
# of -log transmission, evenly up to 2 and by its logarithm beyond
_DEPTH_TICKS = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0)
_EVEN_DEPTH, _EVEN_Z = 2.0, 5.0
_WIDEST_LINEAR = 20.0  # times noise: beyond it bars are drawn on a logarithm
_MOST_HYPOTHESES, _LEAST_PROBABILITY = 6, 1e-4


def _smoothed_z(view: SeriesView, residual: RealArray) -> FloatArray:
    """Residual over noise after averaging over neighbours (row, column)."""
    from scipy.ndimage import uniform_filter

    inside = view.mask.astype(np.float64)
    weight = uniform_filter(inside, NEIGHBOURS_PX)

    def smoothed(image: RealArray) -> FloatArray:
        kept = np.where(view.mask, image, 0.0).astype(np.float64)
        return np.asarray(uniform_filter(kept, NEIGHBOURS_PX) / np.maximum(weight, 1e-9))

    value, noise = smoothed(residual), smoothed(np.asarray(view.noise_DN, dtype=np.float64) ** 2)
    return np.asarray(np.where(weight > 0.2, value / np.sqrt(np.maximum(noise, 1e-30)), np.nan))


def gap_maps(diagnosis: Diagnosis, after: Sequence[RealArray]) -> list[Picture]:
    """Residual mean frames in units of one pixel's noise, 5 x 5 average: before, and after with residuals (row, column), DN.

    Series of which the effects take most away come first; where there are none, those with most gap.
    """
    views = diagnosis.compared.views
    pictures = []
    for index in _telling_views(diagnosis, after):
        view = views[index]
        before = _smoothed_z(view, view.residual_DN)
        limit = max(3.0, float(np.nanquantile(np.abs(before), 0.98)))
        parts = (("before", before), ("after", _smoothed_z(view, after[index])))
        for word, values in parts if diagnosis.added else parts[:1]:
            rms = math.sqrt(float(np.nanmean(values**2)))
            told = {"before": "the twin", "after": "the twin with what was found"}[word]
            pictures.append(
                Picture(
                    name=f"gap_{word}_{view.session.name}",
                    title=f"{view.session.name}: {word}" if diagnosis.added else view.session.name,
                    alt=f"Measured less {told}, in units of one pixel's noise: {rms:.3g} rms. Means of 5 x 5 pixels.",
                    values=values,
                    label="measured less twin, in noise",
                    ends=(-limit, limit),
                    height_px=290,
                )
            )
    return pictures


def _telling_views(diagnosis: Diagnosis, after: Sequence[RealArray]) -> list[int]:
    """Views with the most to show, one a kind, scene and voltage: what is taken of the gap, or the gap where that is nothing."""
    problem = diagnosis.compared
    power, taken = np.zeros(len(problem.views)), np.zeros(len(problem.views))
    is_map = np.array([name.statistic == "mean frame" for name in problem.names])
    for index in range(len(problem.views)):
        chosen = (problem.series_of == index) & is_map
        power[index] = float(np.mean(problem.residual[chosen] ** 2)) if chosen.any() else 0.0
        view = problem.views[index]
        if diagnosis.added and view.mask.any():
            less = (view.residual_DN**2 - after[index] ** 2) / np.maximum(view.noise_DN, 1e-12) ** 2
            taken[index] = float(np.mean(less[view.mask]))
    if float(taken.max(initial=0.0)) > 0.0:
        power = taken
    first: dict[tuple[Any, ...], int] = {}
    for index in np.argsort(-power):
        series = problem.views[index].session.series
        first.setdefault((series.kind, series.scene, series.kV), int(index))
    return list(first.values())[:_MAPS]


def transmission_curves(diagnosis: Diagnosis, after: Sequence[RealArray]) -> list[Chart]:
    """Gap in percent of the open field against -log transmission, every scene with known thickness; before and after."""
    lines: tuple[list[Line], list[Line]] = ([], [])
    colours: dict[str, str] = {}  # of a sort of scene
    deepest = 1.0
    for index, view in enumerate(diagnosis.compared.views):
        if view.session.series.kind != "object":
            continue
        open_DN = float(view.signal_DN.max())
        depth = -np.log(np.clip(view.signal_DN / open_DN, 1e-6, None))
        edges = np.unique(np.quantile(depth[view.mask], np.linspace(0, 1, 13)))
        middle: list[float] = []
        values: tuple[list[float], list[float]] = ([], [])
        for low, high in pairwise(edges):
            inside = view.mask & (depth >= low) & (depth <= high)
            if inside.sum() < 16:
                continue
            middle.append(0.5 * (low + high))
            for part, residual in zip(values, (view.residual_DN, after[index]), strict=True):
                part.append(100.0 * float(np.mean(residual[inside])) / open_DN)
        if len(middle) > 1:
            sort = view.session.request.scene_kind or "object"
            colour = colours.setdefault(sort, SERIES_COLOURS[len(colours) % len(SERIES_COLOURS)])
            dashed = list(colours).index(sort) % 2 == 1
            deepest = max(deepest, middle[-1])
            for mine, part in zip(lines, values, strict=True):
                mine.append(Line(x=middle, y=part, colour=colour, label=sort, dashed=dashed, thin=True))
    if not colours:
        return []
    largest = max(float(np.max(np.abs(line.y))) for line in lines[0])
    ticks = {tick: f"{tick:g}" for tick in _DEPTH_TICKS if tick <= max(1.05 * deepest, 0.5)}
    shown = (("before", lines[0]), ("after", lines[1])) if diagnosis.added else (("before", lines[0]),)
    return [
        Chart(
            name=f"gap_against_transmission_{word}",
            title=word,
            alt="Measured less twin against depth in the object, a line a series."
            if word == "before"
            else "The same with what was found added.",
            marks=[Rule(at=0.0), *mine],
            x_label="-log transmission of the twin",
            y_label="measured less twin, % of open field",
            x_scale="asinh",
            linear_within=_EVEN_DEPTH,
            x_ticks=ticks,
            y_ends=(-1.1 * largest, 1.1 * largest),
        )
        for word, mine in shown
    ]


def held_out_chart(diagnosis: Diagnosis) -> Chart:
    """Held-out gap as a whole and by axis, before and after, with the floor of measured against measured."""
    gap = diagnosis.gap
    return gap_chart([("all", gap.before, gap.after, gap.floor), *diagnosis.held_out], added=bool(diagnosis.added))


def gap_chart(parts: Sequence[tuple[str, float, float, float]], *, added: bool) -> Chart:
    """Gap on data that the fit did not use: parts as (`all` or an axis, before, after, floor); after where an effect was added."""
    rows = [(name if name == "all" else axis_text(name), before, after, floor) for name, before, after, floor in parts]
    y = np.arange(len(rows), dtype=float)
    names = [row[0] for row in rows]
    largest = max(max(row[1:]) for row in rows)
    long = largest > _WIDEST_LINEAR
    smallest = 0.7 * min(min(value for value in row[1:] if value > 0) for row in rows)
    before, after, floor = ([row[column] for row in rows] for column in (1, 2, 3))
    bars = [(y - 0.19, before, BEFORE, "before"), (y + 0.19, after, AFTER, "after")][: 2 if added else 1]
    marks: list[Any] = [
        Bars(y=place, length=value, thickness=0.34, colour=colour, label=label, names=names, numbers=True)
        for place, value, colour, label in bars
    ]
    marks.append(Points(x=floor, y=y, colour="#111111", label="noise alone", shape="diamond", names=names))
    return Chart(
        name="held_out_gap",
        title="Gap on series that the fit did not use",
        alt="Root mean square of measured less expected, in units of what noise and calibration allow; diamonds: noise alone.",
        marks=marks,
        x_label="gap (rms, in standard deviations)",
        x_scale="log" if long else "linear",
        x_ends=(smallest, 2.6 * largest) if long else (0.0, 1.15 * largest),
        y_ticks=dict(zip(map(float, y), names, strict=True)),
        y_ends=(-0.6, len(rows) - 0.4),
        downwards=True,
        height_px=110 + 42 * len(rows),
    )


def places_chart(diagnosis: Diagnosis) -> Chart:
    """Every probe's z over the series in time order, by axis, with the threshold of chance."""
    from ..inference.nuisances import LocalNuisances

    problem = diagnosis.compared
    z = LocalNuisances(problem.factors, problem.blocks).given_others(problem.residual)
    axes = list(dict.fromkeys(name.axis for name in problem.names))
    series = [view.session.name for view in problem.views]
    marks: list[Any] = [
        Rule(at=sign * diagnosis.threshold_z, label="chance, 5 % of sessions" if sign > 0 else "") for sign in (1, -1)
    ]
    for number, axis in enumerate(axes):
        chosen = np.flatnonzero([probe.axis == axis for probe in problem.names])
        jitter = (number - len(axes) / 2) / (1.4 * len(axes))
        named = [
            f"{series[problem.series_of[one]]}: {statistic_text(problem.names[one].statistic, problem.names[one].location)}"
            for one in chosen
        ]
        marks.append(
            Points(
                x=problem.series_of[chosen] + jitter,
                y=z[chosen],
                names=named,
                label=axis_text(axis),
                colour=SERIES_COLOURS[number % len(SERIES_COLOURS)],
                shape=SHAPES[number % len(SHAPES)],
                size_px=4.5,
            )
        )
    largest = float(np.max(np.abs(z), initial=diagnosis.threshold_z))
    step = math.ceil(len(series) / 12)
    return Chart(
        name="probes",
        alt="Departure of every probe from the twin, series by series in time order. Beyond the dotted lines lies what chance"
        " hardly gives.",
        marks=marks,
        x_label="series, by number",
        y_label="z given all other probes",
        y_scale="asinh",
        linear_within=_EVEN_Z,
        y_ticks=asinh_ticks(largest, linear_within=_EVEN_Z),
        x_ticks={float(number): f"{number + 1}" for number in range(0, len(series), step)},
        wide=True,
        height_px=420,
    )


def hypotheses_chart(diagnosis: Diagnosis) -> Chart:
    """Probabilities of the leading hypotheses."""
    shown = [item for item in diagnosis.hypotheses if item.probability > _LEAST_PROBABILITY][:_MOST_HYPOTHESES]
    names = [" + ".join(map(title_of, item.effects)) or "no gap" for item in shown]
    y = np.arange(len(shown), dtype=float)
    return Chart(
        name="hypotheses",
        title="What may cause the gap",
        alt="Probability of each explanation that was weighed.",
        marks=[Bars(y=y, length=[item.probability for item in shown], names=names, numbers=True)],
        x_label="probability",
        x_ends=(0.0, 1.12),
        x_ticks={value: f"{value:g}" for value in (0.0, 0.25, 0.5, 0.75, 1.0)},
        y_ticks=dict(zip(map(float, y), names, strict=True)),
        y_ends=(-0.6, max(len(shown), 2) - 0.4),
        downwards=True,
        height_px=90 + max(rows_px(names), 68),
    )

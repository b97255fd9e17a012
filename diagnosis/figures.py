"""Pictures of a diagnosis: gap maps, curves by axis, before and after, hypotheses."""

import io
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .answer import Diagnosis
from .inference import UNKNOWN
from .problem import SeriesView

_BEFORE, _AFTER, _FLOOR = "#b3402a", "#2a6fb3", "#777777"
_DEPTH_TICKS = (
    0.0,
    0.2,
    0.5,
    1.0,
    1.5,
    2.0,
    5.0,
    10.0,
)  # of -log transmission, evenly up to 2 and by its logarithm beyond


def _figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def _legend_above(figure: Any, axis: Any) -> None:
    """The legend of one of a figure's axes above all of them: within them it would lie on what is shown."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=8, frameon=False)


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _smoothed_z(view: SeriesView, residual: NDArray[np.floating]) -> NDArray[np.float64]:
    """Residual over noise after averaging over 5 x 5 pixels (row, column)."""
    from scipy.ndimage import uniform_filter

    inside = view.mask.astype(np.float64)
    weight = uniform_filter(inside, 5)
    value = uniform_filter(np.where(view.mask, residual, 0.0).astype(np.float64), 5) / np.maximum(weight, 1e-9)
    noise = uniform_filter(np.where(view.mask, view.noise_DN, 0.0).astype(np.float64) ** 2, 5) / np.maximum(
        weight, 1e-9
    )
    return np.asarray(np.where(weight > 0.2, value / np.sqrt(np.maximum(noise, 1e-30)), np.nan))


def plot_gap_maps(diagnosis: Diagnosis, after: Sequence[NDArray[np.floating]], *, count: int = 4) -> bytes:
    """Residual mean frames in units of one pixel's noise, 5 x 5 average: before and after, the series with most gap."""
    views = diagnosis.compared.views
    chosen = _worst_views(diagnosis, count)
    figure, axes = _figure(3.1 * len(chosen) + 0.8, 6.0, 2, len(chosen))
    image = None
    for column, index in enumerate(chosen):
        view = views[index]
        before = _smoothed_z(view, view.residual_DN)
        limit = max(3.0, float(np.nanquantile(np.abs(before), 0.98)))
        for row, residual in enumerate((view.residual_DN, after[index])):
            axis = axes[row][column]
            image = axis.imshow(_smoothed_z(view, residual), cmap="RdBu_r", vmin=-limit, vmax=limit)
            axis.set_xticks([])
            axis.set_yticks([])
            if row == 0:
                axis.set_title(view.session.name, fontsize=8)
            if column == 0:
                axis.set_ylabel("before" if row == 0 else "after", fontsize=10)
            figure.colorbar(image, ax=axis, fraction=0.046, pad=0.03).ax.tick_params(labelsize=7)
    figure.suptitle("Measured less twin, in units of one pixel's noise", fontsize=10)
    return _png(figure)


def _worst_views(diagnosis: Diagnosis, count: int) -> list[int]:
    problem = diagnosis.compared
    power = np.zeros(len(problem.views))
    is_map = np.array([name.statistic == "mean frame" for name in problem.names])
    for index in range(len(problem.views)):
        chosen = (problem.series_of == index) & is_map
        power[index] = float(np.mean(problem.residual[chosen] ** 2)) if chosen.any() else 0.0
    seen: set[tuple[Any, ...]] = set()
    result = []
    for index in np.argsort(-power):
        series = problem.views[index].session.series
        key = (series.kind, series.scene, series.kV)
        if key in seen:
            continue
        seen.add(key)
        result.append(int(index))
        if len(result) == count:
            break
    return result


def plot_transmission_curves(diagnosis: Diagnosis, after: Sequence[NDArray[np.floating]]) -> bytes:
    """Gap in percent of the open field against -log transmission, every scene with known thickness; before and after."""
    figure, grid = _figure(9.0, 3.6, 1, 2, sharey=True)
    axes = grid[0]
    colours: dict[str, str] = {}  # of a sort of scene
    for index, view in enumerate(diagnosis.compared.views):
        if view.session.series.kind != "object":
            continue
        open_DN = float(view.signal_DN.max())
        depth = -np.log(np.clip(view.signal_DN / open_DN, 1e-6, None))
        edges = np.unique(np.quantile(depth[view.mask], np.linspace(0, 1, 13)))
        middle, values = [], ([], [])  # type: ignore[var-annotated]
        for low, high in pairwise(edges):
            inside = view.mask & (depth >= low) & (depth <= high)
            if inside.sum() < 16:
                continue
            middle.append(0.5 * (low + high))
            for part, residual in zip(values, (view.residual_DN, after[index]), strict=True):
                part.append(100.0 * float(np.mean(residual[inside])) / open_DN)
        if len(middle) > 1:
            sort = view.session.request.scene_kind or "object"
            label = None if sort in colours else sort
            colour = colours.setdefault(sort, f"C{len(colours)}")
            for axis, part in zip(axes, values, strict=True):
                axis.plot(middle, part, "o-", ms=2.5, lw=0.8, alpha=0.8, color=colour, label=label)
    for axis, title in zip(axes, ("before", "after"), strict=True):
        axis.axhline(0, color="k", lw=0.6)
        axis.set_title(title, fontsize=10)
        deepest = axis.dataLim.x1 if colours else 1.0
        axis.set_xscale("symlog", linthresh=2.0)
        ticks = [tick for tick in _DEPTH_TICKS if tick <= max(1.05 * deepest, 0.5)]
        axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.set_xlim(-0.05 * deepest, 1.05 * deepest)
        axis.set_xlabel("-log transmission (twin)")
    axes[0].set_ylabel("measured less twin, % of open field")
    if colours:
        _legend_above(figure, axes[1])
    else:
        axes[0].text(0.5, 0.5, "no scene of known thickness", transform=axes[0].transAxes, ha="center")
    return _png(figure)


def plot_by_axis(diagnosis: Diagnosis) -> bytes:
    """Held-out gap by axis, before and after, and the noise floor."""
    rows = diagnosis.held_out
    figure, grid = _figure(6.4, 0.45 * max(len(rows), 2) + 1.2)
    axis = grid[0, 0]
    y = np.arange(len(rows))
    axis.barh(y - 0.18, [row[1] for row in rows], 0.34, color=_BEFORE, label="before")
    axis.barh(y + 0.18, [row[2] for row in rows], 0.34, color=_AFTER, label="after")
    axis.axvline(1.0, color=_FLOOR, lw=1, ls="--", label="noise")
    axis.set_yticks(y, [row[0] for row in rows])
    axis.invert_yaxis()
    if rows and max(row[1] for row in rows) > 20:
        axis.set_xscale("log")
    axis.set_xlabel("root mean square of standardised residuals, held-out series")
    _legend_above(figure, axis)
    return _png(figure)


def plot_places(diagnosis: Diagnosis) -> bytes:
    """Every probe's z over the series in time order, coloured by axis, with the threshold of chance."""
    from .local_nuisances import LocalNuisances

    problem = diagnosis.compared
    z = LocalNuisances(problem.factors, problem.blocks).given_others(problem.residual)
    figure, grid = _figure(9.0, 4.4)
    axis = grid[0, 0]
    axes_names = list(dict.fromkeys(name.axis for name in problem.names))
    for number, name in enumerate(axes_names):
        chosen = np.array([probe.axis == name for probe in problem.names])
        jitter = (number - len(axes_names) / 2) / (1.4 * len(axes_names))
        axis.plot(problem.series_of[chosen] + jitter, z[chosen], ".", ms=4, label=name, color=f"C{number}")
    for sign in (-1, 1):
        axis.axhline(sign * diagnosis.threshold_z, color=_FLOOR, lw=1, ls="--")
    if float(np.max(np.abs(z))) > 30:
        axis.set_yscale("symlog", linthresh=10)
    axis.set_xticks(range(len(problem.views)), [view.session.name for view in problem.views], rotation=90, fontsize=5)
    axis.set_ylabel("z given all other probes")
    axis.set_xlim(-1, len(problem.views))
    _legend_above(figure, axis)
    return _png(figure)


def plot_hypotheses(diagnosis: Diagnosis) -> bytes:
    """Probabilities of the leading hypotheses."""
    shown = [item for item in diagnosis.hypotheses if item.probability > 1e-4][:10]
    labels = [
        "no gap" if not item.effects else "unknown effect" if item.effects == (UNKNOWN,) else " + ".join(item.effects)
        for item in shown
    ]
    figure, grid = _figure(6.4, 0.36 * len(shown) + 1.0)
    axis = grid[0, 0]
    y = np.arange(len(shown))
    axis.barh(y, [item.probability for item in shown], color=_AFTER)
    for position, item in zip(y, shown, strict=True):
        axis.text(min(item.probability + 0.01, 0.9), position, f"{item.probability:.3f}", va="center", fontsize=8)
    axis.set_yticks(y, labels)
    axis.invert_yaxis()
    axis.set_xlim(0, 1)
    axis.set_xlabel("probability")
    return _png(figure)


def rms(values: NDArray[np.floating]) -> float:
    """Root mean square of finite values."""
    finite = values[np.isfinite(values)]
    return math.sqrt(float(np.mean(finite**2))) if finite.size else float("nan")


def plot_task(task: Mapping[str, Any]) -> bytes:
    """Share of objects detected against their size: the two twins' networks on their own images, and measured ones."""
    real = "measured_on_measured" if task["real_networks"] == "measured" else "after_on_measured"
    figure, axes = _figure(9.0, 4.4, 1, 2, sharey=True)
    left = (
        ("before_on_before", "twin before", _BEFORE),
        ("after_on_after", "twin after", _AFTER),
        (real, "measured", "#1b7f3b"),
    )
    right = (
        ("before_on_measured", "learnt from the twin before", _BEFORE),
        ("after_on_measured", "learnt from the twin after", _AFTER),
        ("measured_on_measured", "learnt from measured images", "#1b7f3b"),
    )
    for axis, which, title in (
        (axes[0][0], left, "As expected, and as measured"),
        (axes[0][1], right, "Tried on measured images"),
    ):
        for name, label, colour in which:
            curve = task["curves"].get(name)
            if curve is None:
                continue
            points = curve["points"]
            axis.plot(
                [one["size"] for one in points],
                [one["hits"] / one["n"] for one in points],
                "o",
                color=colour,
                markersize=4,
            )
            if curve["line"] is not None:
                line = curve["line"]
                axis.plot(line["size"], line["pod"], color=colour, label=label)
                axis.fill_between(line["size"], line["low"], line["high"], color=colour, alpha=0.12, linewidth=0)
            else:
                axis.plot([], [], "o", color=colour, label=f"{label} (no curve)")
        axis.axhline(0.9, color=_FLOOR, linewidth=0.7, linestyle=":")
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("longest side, mm" if task["size"] == "size_mm" else "contrast")
        axis.set_ylim(-0.03, 1.03)
        axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.18), frameon=False)
    axes[0][0].set_ylabel("share detected")
    return _png(figure)

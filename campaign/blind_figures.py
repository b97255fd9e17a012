"""Figures of a blind check; each returns a PNG. Matplotlib is imported only here, without touching its global state."""

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..generator.effects import EFFECTS
from .blind_scores import FAILED, NONE, UNKNOWN, Outcome, strength_rows, top1_right
from .blind_separation import NO_EFFECT

RIGHT, WRONG, MUTED = "#1b7f3b", "#c23b22", "#7a7a7a"
_BASELINE_COLOURS = {
    "commonest": "#aaaaaa",
    "nearest_template": "#c98a1b",
    "matched_filter": "#8a5fb0",
    "nearest_signature": "#5f9ea0",
    "classifier": "#2a6fb3",
}
_DPI = 110
_LIMIT = 3.05  # sigma at which a perfect method with 20 orthogonal signatures and 5 % false alarms names half


def _figure(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def _legend(axis: Any, **more: Any) -> None:
    """A legend where there is anything to explain."""
    if axis.get_legend_handles_labels()[0]:
        axis.legend(**more)


def _middle(row: Mapping[str, Any]) -> float:
    low, high = max(row["sigma_from"], 1.0), row["sigma_to"] or 30.0
    return math.sqrt(low * high)


def plot_accuracy(scores: Mapping[str, Any], baselines: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Share of right first names against the separation, with 95 % intervals, and the same for baselines. PNG."""
    figure, axes = _figure(12.5, 4.6, 1, 2)
    axis = axes[0, 0]
    sigma = np.geomspace(0.5, 60, 200)
    perfect = [0.5 * (1.0 + math.erf((value - _LIMIT) / math.sqrt(2.0))) for value in sigma]
    axis.plot(
        sigma, perfect, color="black", linestyle=":", linewidth=1, label="a perfect method, 20 orthogonal signatures"
    )
    for key, colour, label, shift in (
        ("top1", RIGHT, "first name right", 0.97),
        ("top_set", "#2a6fb3", "truth among the names", 1.0),
        ("exact", "#c98a1b", "truth and nothing else", 1.03),
    ):
        rows = [row for row in scores[key]["single_by_sigma"] if row["n"]]
        if rows:
            share = np.array([row["share"] for row in rows])
            low, high = np.array([row["low"] for row in rows]), np.array([row["high"] for row in rows])
            place = np.array([_middle(row) for row in rows]) * shift
            bars = np.maximum(np.array([share - low, high - share]), 0.0)
            axis.errorbar(place, share, bars, fmt="o-", color=colour, capsize=3, label=label)
    for row in scores["top1"]["single_by_sigma"]:
        axis.text(_middle(row), 0.02, f"n={row['n']}", ha="center", fontsize=8, color=MUTED)
    axis.set(
        xscale="log", ylim=(0, 1.02), xlabel="separation from the nearest other model, sigma", ylabel="share of cases"
    )
    axis.set_xticks([1, 2, 3, 4, 5, 10, 20, 50], ["1", "2", "3", "4", "5", "10", "20", "50"])
    axis.set_xticks([], minor=True)
    axis.set_title("single effects, full measurement set", fontsize=10)
    _legend(axis, fontsize=8, loc="center right")
    axis = axes[0, 1]
    for name, entry in [("diagnosis", scores), *baselines.items()]:
        rows = [row for row in entry["top1"]["single_by_sigma"] if row["n"]]
        if rows:
            colour = RIGHT if name == "diagnosis" else _BASELINE_COLOURS.get(name, MUTED)
            axis.plot(
                [_middle(row) for row in rows],
                [row["share"] for row in rows],
                "o-",
                color=colour,
                linewidth=2.2 if name == "diagnosis" else 1.2,
                label=name.replace("_", " "),
            )
    axis.set(xscale="log", ylim=(0, 1.02), xlabel="separation, sigma", ylabel="first name right")
    axis.set_xticks([1, 2, 3, 4, 5, 10, 20, 50], ["1", "2", "3", "4", "5", "10", "20", "50"])
    axis.set_xticks([], minor=True)
    axis.set_title("beside baselines", fontsize=10)
    _legend(axis, fontsize=8)
    return _png(figure)


def plot_reliability(scores: Mapping[str, Any], baselines: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Share of cases that were right against the probability that was stated. PNG."""
    figure, axes = _figure(12.5, 4.6, 1, 2)
    for column, (key, title) in enumerate(
        (
            ("leading_hypothesis", "the most probable hypothesis"),
            ("effect_probabilities_offered", "each effect that was offered with 2 % or more"),
        )
    ):
        axis = axes[0, column]
        axis.plot([0, 1], [0, 1], color="black", linestyle=":", linewidth=1)
        curve = scores[key]["curve"]
        if curve:
            p, share = np.array([row["probability"] for row in curve]), np.array([row["share"] for row in curve])
            low, high = np.array([row["low"] for row in curve]), np.array([row["high"] for row in curve])
            bars = np.maximum(np.array([share - low, high - share]), 0.0)
            axis.errorbar(p, share, bars, fmt="o-", color=RIGHT, capsize=3, label="diagnosis")
            for row in curve:
                axis.text(row["probability"], min(row["high"] + 0.02, 1.0), str(row["n"]), ha="center", fontsize=8)
        if "classifier" in baselines and baselines["classifier"][key]["curve"]:
            other = baselines["classifier"][key]["curve"]
            axis.plot(
                [row["probability"] for row in other],
                [row["share"] for row in other],
                "s--",
                color=_BASELINE_COLOURS["classifier"],
                markersize=4,
                label="classifier",
            )
        axis.set(xlim=(0, 1.02), ylim=(0, 1.06), xlabel="stated probability", ylabel="share that was true", title=title)
        _legend(axis, fontsize=8)
    return _png(figure)


def plot_confusion(outcomes: Sequence[Outcome]) -> bytes:
    """First names by what was true, singles, no effect and unknown ones; numbers are cases. PNG."""
    true_names = [NONE, *EFFECTS]
    extra = sorted({name for item in outcomes if item.label == "unknown" for name in item.truth})
    rows = [*true_names, *extra]
    columns = [NONE, *EFFECTS, UNKNOWN, FAILED]
    table = np.zeros((len(rows), len(columns)), dtype=int)
    for item in outcomes:
        if item.label != "pair":
            table[rows.index(item.truth[0] if item.truth else NONE), columns.index(item.top1)] += 1
    figure, axes = _figure(12.0, 10.5)
    axis = axes[0, 0]
    shares = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    axis.imshow(shares, cmap="Blues", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
    for row in range(len(rows)):
        for column in range(len(columns)):
            if table[row, column]:
                dark = shares[row, column] > 0.55
                axis.text(
                    column,
                    row,
                    str(table[row, column]),
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if dark else "black",
                )
    axis.set_xticks(range(len(columns)), [name.replace("_", " ") for name in columns], rotation=60, ha="right")
    axis.set_yticks(range(len(rows)), [name.replace("_", " ") for name in rows])
    axis.axhline(len(true_names) - 0.5, color=MUTED, linewidth=1)
    axis.set(xlabel="first name", ylabel="planted (none, one effect, or one outside the catalogue)")
    return _png(figure)


def plot_distances(distances: Mapping[str, Mapping[str, float]]) -> bytes:
    """Median distance of planted effects (rows) from every other effect and from none (columns), sigma. PNG."""
    rows = list(distances)
    columns = [NO_EFFECT, *EFFECTS]
    table = np.array([[distances[row].get(column, math.nan) for column in columns] for row in rows], dtype=float)
    table = table.reshape(len(rows), len(columns))
    figure, axes = _figure(12.0, 1.8 + 0.42 * max(len(rows), 1))
    axis = axes[0, 0]
    if rows:
        shown = axis.imshow(
            np.log10(np.clip(table, 0.3, 300)),
            cmap="RdYlGn",
            vmin=-0.3,
            vmax=1.7,
            interpolation="nearest",
            aspect="auto",
        )
        bar = figure.colorbar(shown, ax=axis, shrink=0.8, ticks=[0, math.log10(3), math.log10(5), 1, math.log10(30)])
        bar.ax.set_yticklabels(["1", "3", "5", "10", "30"])
        bar.set_label("distance, sigma")
    for row in range(len(rows)):
        for column in range(len(columns)):
            if math.isfinite(table[row, column]):
                axis.text(column, row, f"{table[row, column]:.3g}", ha="center", va="center", fontsize=6.5)
    axis.set_xticks(range(len(columns)), [name.replace("_", " ") for name in columns], rotation=60, ha="right")
    axis.set_yticks(range(len(rows)), [name.replace("_", " ") for name in rows])
    axis.set(xlabel="other model, refitted", ylabel="planted")
    return _png(figure)


def plot_strengths(outcomes: Sequence[Outcome]) -> bytes:
    """Strength found over strength planted, of named effects, against their separation. PNG."""
    rows = [row for row in strength_rows(outcomes) if row["sigma"] is not None and row["value"] * row["true"] > 0]
    figure, axes = _figure(12.5, 5.0)
    axis = axes[0, 0]
    markers = "osD^v<>P"
    for number, name in enumerate(dict.fromkeys(row["effect"] for row in rows)):
        own = [row for row in rows if row["effect"] == name]
        ratio = np.array([row["value"] / row["true"] for row in own])
        edges = np.array([sorted((row["low"] / row["true"], row["high"] / row["true"])) for row in own])
        bars = np.maximum(np.array([ratio - edges[:, 0], edges[:, 1] - ratio]), 0.0)
        axis.errorbar(
            [max(row["sigma"], 0.5) for row in own],
            ratio,
            bars,
            fmt=markers[number % len(markers)],
            color=f"C{number % 10}",
            markersize=4,
            linewidth=0.8,
            label=name.replace("_", " "),
        )
    axis.axhspan(0.9, 1.1, color=RIGHT, alpha=0.12)
    axis.axhline(1.0, color="black", linewidth=0.8)
    axis.axvline(10.0, color=MUTED, linewidth=0.8, linestyle=":")
    axis.set(
        xscale="log",
        yscale="log",
        ylim=(0.2, 5.0),
        xlabel="separation, sigma (0.5 and less at 0.5)",
        ylabel="strength found / planted",
    )
    axis.set_yticks([0.2, 0.5, 0.9, 1.1, 2, 5], ["0.2", "0.5", "0.9", "1.1", "2", "5"])
    axis.set_yticks([], minor=True)
    if rows:
        _legend(axis, fontsize=7, ncols=2, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return _png(figure)


def plot_limits(outcomes: Sequence[Outcome]) -> bytes:
    """Probability given to each planted effect against its strength, one panel an effect. PNG."""
    names = list(EFFECTS)
    columns = 5
    lines = math.ceil(len(names) / columns)
    figure, axes = _figure(13.0, 2.1 * lines, lines, columns)
    for place, name in enumerate(names):
        axis = axes[place // columns, place % columns]
        for label, marker, size in (("single", "o", 22), ("pair", "^", 16)):
            own = [item for item in outcomes if name in item.truth and item.label == label]
            colours = [
                RIGHT if (top1_right(item) if label == "single" else name in item.named) else WRONG for item in own
            ]
            axis.scatter(
                [abs(item.strengths[name]) for item in own],
                [item.marginal.get(name, 0.0) for item in own],
                c=colours,
                marker=marker,
                s=size,
                alpha=0.75,
                linewidths=0,
            )
        strength = EFFECTS[name].strength
        axis.set(xscale="log", ylim=(-0.05, 1.05), xlim=(strength.low * 0.8, strength.high * 1.25))
        ticks = [strength.low, math.sqrt(strength.low * strength.high), strength.high]
        axis.set_xticks(ticks, [f"{float(f'{value:.2g}'):g}" for value in ticks])
        axis.set_xticks([], minor=True)
        axis.set_title(f"{name.replace('_', ' ')}, {strength.unit}", fontsize=8)
        axis.tick_params(labelsize=7, which="both")
        if place % columns == 0:
            axis.set_ylabel("probability", fontsize=8)
    for place in range(len(names), lines * columns):
        axes[place // columns, place % columns].set_axis_off()
    return _png(figure)


def plot_unknown(outcomes: Sequence[Outcome]) -> bytes:
    """Probability of an unknown effect by what was true, and the verdicts. PNG."""
    figure, axes = _figure(12.5, 4.2, 1, 2)
    groups = {
        label: [item for item in outcomes if item.label == label] for label in ("none", "single", "pair", "unknown")
    }
    axis = axes[0, 0]
    for label, colour in zip(groups, (MUTED, "#2a6fb3", "#c98a1b", WRONG), strict=True):
        values = np.sort([item.p_unknown for item in groups[label]])
        if values.size:
            axis.step(values, np.arange(1, values.size + 1) / values.size, where="post", color=colour, label=label)
    axis.set(
        xlim=(-0.02, 1.02),
        ylim=(0, 1.02),
        xlabel="stated probability of an unknown effect",
        ylabel="share of cases up to",
    )
    _legend(axis, fontsize=8)
    axis = axes[0, 1]
    verdicts = ("no_gap", "explained", "explained_in_part", "ambiguous", UNKNOWN, FAILED)
    left = np.zeros(len(groups))
    for verdict, colour in zip(verdicts, (MUTED, RIGHT, "#7fb08a", "#c98a1b", "#8a5fb0", "black"), strict=True):
        share = np.array(
            [sum(item.verdict == verdict for item in members) / max(len(members), 1) for members in groups.values()]
        )
        axis.barh(list(groups), share, left=left, color=colour, label=verdict.replace("_", " "))
        left += share
    axis.set(xlim=(0, 1), xlabel="share of cases by verdict")
    axis.invert_yaxis()
    _legend(axis, fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return _png(figure)

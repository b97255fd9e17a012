"""Plots that people in non-destructive testing expect: `plot_` returns a matplotlib figure, `draw_` draws on the axes given."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError
from .band import CHI2_95, curve_with_band
from .comparison import Comparison
from .hit_miss import Z_TWO_SIDED, PodFit, trusted_bound
from .likelihood import joint_region
from .models import Alternative
from .response import ResponseFit
from .roc import Roc
from .trials import Trials

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_BLUE, _ORANGE, _GREY, _RED = "#1f5fa8", "#d9822b", "#6b7280", "#b3261e"


def draw_pod(axes: Any, fit: PodFit, table: Trials, *, size_label: str) -> None:
    """POD curve with its 95 % band, the share of hits in groups of sizes, hits and misses as ticks, a90 and a90/95."""
    _draw_hits(axes, table, log_size=fit.log_size)
    _draw_curve(axes, fit, color=_BLUE, label=f"POD ({fit.link}, {fit.repeats})")
    bound = trusted_bound(fit.a90_95, separated=fit.separated)
    if fit.a90 is not None:
        axes.plot([fit.a90] * 2, [0, 0.9], color=_GREY, lw=1, ls="--")
        axes.axhline(0.9, color=_GREY, lw=0.6, ls=":")
        axes.annotate(
            f"a90 = {fit.a90:.3g}", (fit.a90, 0.0), xytext=(-3, 22), textcoords="offset points", rotation=90, ha="right"
        )
    if bound is not None:
        axes.plot([bound] * 2, [0, 0.9], color=_RED, lw=1, ls="--")
        axes.annotate(
            f"a90/95 = {bound:.3g}",
            (bound, 0.0),
            xytext=(3, 22),
            textcoords="offset points",
            rotation=90,
            ha="left",
            color=_RED,
            va="bottom",
        )
    _finish(axes, size_label, "probability of detection", log=fit.log_size)
    axes.set_ylim(-0.06, 1.06)
    axes.legend(loc="center right", frameon=False, fontsize=8)


def plot_joint_region(fit: PodFit) -> "Figure":
    """Joint 50, 90 and 95 % likelihood regions of (c0, c1), with the estimate and the line of equal a90.

    Raises:
        FitError: the fit has no curve, or its likelihood no maximum (separated data).
    """
    if fit.curve is None or fit.separated or not fit.curve.at_maximum:
        raise FitError("there is no joint region: the likelihood of these data has no maximum")
    figure, axes = _figure(5.0, 4.4)
    for share, quantile in ((95, CHI2_95[2]), (90, 4.605170185988092), (50, 1.3862943611198906)):
        border = joint_region(fit.curve, quantile=quantile)
        border = np.concatenate((border, border[:1]))
        axes.plot(border[:, 0], border[:, 1], color=_BLUE, lw=1.4 if share == 95 else 0.8, label=f"{share} %")
    c0, c1 = fit.curve.coefficients
    axes.plot(c0, c1, "+", color=_RED, ms=10)
    x90 = (fit.curve.link.eta_from_pod(0.9) - c0) / c1
    low, high = axes.get_xlim()
    line = np.linspace(low, high, 50)
    if x90 != 0:
        axes.plot(line, (fit.curve.link.eta_from_pod(0.9) - line) / x90, color=_GREY, lw=0.8, ls="--", label="same a90")
    axes.set_xlim(low, high)
    _finish(axes, "c0", "c1" + (" (per ln size)" if fit.log_size else " (per size)"), log=False)
    axes.legend(frameon=False, fontsize=8)
    return figure


def plot_models(alternatives: Sequence[Alternative]) -> "Figure":
    """AIC of every link and scale above the best, as bars; what was chosen is never silent."""
    shown = [one for one in alternatives if one.aic is not None]
    if not shown:
        raise FitError("no link fits these data: nothing to compare")
    figure, axes = _figure(5.6, 0.35 * len(shown) + 1.2)
    names = [one.name for one in shown]
    best = min(one.aic for one in shown if one.aic is not None)
    axes.barh(names[::-1], [(one.aic or 0.0) - best for one in shown][::-1], color=_BLUE, height=0.6)
    for place, one in enumerate(shown[::-1]):
        text = "no a90" if one.a90 is None else f"a90 {one.a90:.3g}"
        axes.annotate(
            text, ((one.aic or 0.0) - best, place), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8
        )
    axes.margins(x=0.18)
    _finish(axes, "AIC above the best", "", log=False)
    return figure


def draw_response(
    axes: Any,
    fit: ResponseFit,
    size: Array,
    response: Array,
    *,
    size_label: str,
    response_label: str,
    left: float | None = None,
    right: float | None = None,
) -> None:
    """Response against size with the fitted line, its 95 % scatter, the decision and censored responses marked."""
    size, response = np.asarray(size, dtype=float), np.asarray(response, dtype=float)
    cut = np.zeros(len(size), bool)
    if left is not None:
        cut |= response <= left
        axes.axhline(left, color=_GREY, lw=0.7, ls=":")
    if right is not None:
        cut |= response >= right
        axes.axhline(right, color=_GREY, lw=0.7, ls=":")
    axes.plot(size[~cut], response[~cut], "o", ms=4, color=_BLUE, mec="none", alpha=0.7, label="measured")
    if cut.any():
        axes.plot(size[cut], response[cut], "^", ms=5, color=_ORANGE, mec="none", label="censored")
    ends = float(size.min()), float(size.max())
    line = np.geomspace(*ends, 100) if fit.log_size else np.linspace(*ends, 100)
    x = np.log(line) if fit.log_size else line
    for offset, style in ((0.0, "-"), (-Z_TWO_SIDED, "--"), (Z_TWO_SIDED, "--")):
        y = _untransformed(fit.intercept + fit.slope * x + offset * fit.scatter, fit.box_cox)
        axes.plot(line, y, color=_RED, lw=1.3 if offset == 0 else 0.8, ls=style)
    axes.axhline(fit.decision, color="black", lw=0.9, label="decision")
    low, high = float(response.min()), float(response.max())
    axes.set_ylim(low - 0.1 * (high - low) if fit.box_cox == 1 else 0.7 * low, high + 0.1 * (high - low))
    _finish(axes, size_label, response_label, log=fit.log_size)
    if abs(fit.box_cox) < 0.25:
        axes.set_yscale("log")
    axes.legend(frameon=False, fontsize=8)


def plot_comparison(
    comparison: Comparison, *, size_label: str, names: tuple[str, str] = ("first", "second")
) -> "Figure":
    """Both curves with their bands, and the ratio of a90 with its 95 and 90 % intervals against the margin."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[3, 1.3])
    draw_both_curves(left, comparison, size_label=size_label, names=names)
    draw_ratio(right, comparison)
    return figure


def draw_both_curves(left: Any, comparison: Comparison, *, size_label: str, names: tuple[str, str]) -> None:
    """Both curves with their bands on the axes given."""
    for fit, color, name in zip((comparison.first, comparison.second), (_BLUE, _ORANGE), names, strict=True):
        if fit.curve is not None:
            _draw_curve(left, fit, color=color, label=name)
        if fit.a90 is not None:
            left.plot([fit.a90] * 2, [0, 0.9], color=color, lw=0.9, ls="--")
    left.axhline(0.9, color=_GREY, lw=0.6, ls=":")
    left.set_ylim(-0.03, 1.03)
    _finish(left, size_label, "probability of detection", log=comparison.first.log_size)
    if left.get_legend_handles_labels()[1]:
        left.legend(frameon=False, fontsize=8)


def draw_ratio(right: Any, comparison: Comparison) -> None:
    """The ratio of a90 with its 95 and 90 % intervals against the margin, on the axes given."""
    margin = comparison.margin
    right.axhspan(1 / (1 + margin), 1 + margin, color="#dfe7ef", zorder=0)
    right.axhline(1, color=_GREY, lw=0.7)
    ratio = comparison.ratio_a90
    if ratio.value is not None:
        right.plot([0], [ratio.value], "o", color=_RED, ms=6)
        if ratio.low is not None and ratio.high is not None:
            right.plot([0, 0], [ratio.low, ratio.high], color=_RED, lw=1.2)
        if comparison.equivalence_low is not None and comparison.equivalence_high is not None:
            right.plot([0, 0], [comparison.equivalence_low, comparison.equivalence_high], color=_RED, lw=4, alpha=0.5)
    right.set_xticks([])
    right.set_xlim(-1, 1)
    right.margins(y=0.3)
    _finish(right, comparison.verdict, "ratio of a90 (bars 95 and 90 %)", log=False)


def plot_roc(roc: Roc) -> "Figure":
    """Detection against false alarm over all decisions, with the area under the curve."""
    figure, axes = _figure(4.6, 4.4)
    axes.plot(roc.false_alarm, roc.detected, color=_BLUE, lw=1.5, drawstyle="steps-post")
    axes.plot([0, 1], [0, 1], color=_GREY, lw=0.7, ls=":")
    axes.set_title(f"area {roc.area:.3f} ({roc.area_low:.3f} to {roc.area_high:.3f})", fontsize=9)
    _finish(axes, "false-alarm rate", "share detected", log=False)
    return figure


def _figure(width: float, height: float) -> tuple["Figure", Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _finish(axes: Any, x_label: str, y_label: str, *, log: bool) -> None:
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    if log:
        from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.spines[["top", "right"]].set_visible(False)


def _draw_curve(axes: Any, fit: PodFit, *, color: str, label: str) -> None:
    if fit.curve is None:
        axes.set_title("no curve: " + "; ".join(fit.warnings), fontsize=7, wrap=True)
        return
    ends = fit.smallest_size, fit.largest_size
    size = np.geomspace(*ends, 200) if fit.log_size else np.linspace(*ends, 200)
    pod, low, high = curve_with_band(fit, size)
    axes.fill_between(
        size, low, high, color=color, alpha=0.18, lw=0, label="95 % band" if label.startswith("POD") else None
    )
    axes.plot(size, pod, color=color, lw=1.6, label=label)


def _draw_hits(axes: Any, table: Trials, *, log_size: bool) -> None:
    up, down = table.hits > 0, table.misses > 0
    axes.plot(table.size[up], np.full(up.sum(), 1.035), "|", color=_GREY, ms=6, alpha=0.5)
    axes.plot(table.size[down], np.full(down.sum(), -0.035), "|", color=_GREY, ms=6, alpha=0.5)
    groups = grouped_hits(table, log_size=log_size)
    share = groups["hits"] / groups["n"]
    axes.plot(groups["size"], share, "o", color="black", ms=4, label="share of hits, grouped")


def grouped_hits(table: Trials, *, log_size: bool) -> dict[str, Array]:
    """Trials in at most ten groups of like size and number: mean size (on log size its geometric mean), hits and n of each."""
    order = np.argsort(table.size, kind="stable")
    total = (table.hits + table.misses)[order]
    groups = int(min(10, max(len(np.unique(table.size)) // 4, 1)))
    where = np.minimum((np.cumsum(total) - 0.5 * total) / total.sum() * groups, groups - 1).astype(int)
    weight = np.bincount(where, weights=total, minlength=groups)
    x = np.log(table.size) if log_size else table.size
    filled = weight > 0
    hits = np.bincount(where, weights=table.hits[order], minlength=groups)[filled]
    middle = np.bincount(where, weights=x[order] * total, minlength=groups)[filled] / weight[filled]
    return {
        "size": np.exp(middle) if log_size else middle,
        "hits": hits.astype(float),
        "n": weight[filled].astype(float),
    }


def _untransformed(values: Array, box_cox: float) -> Array:
    if box_cox == 1:
        return values
    if abs(box_cox) < 1e-12:
        return np.asarray(np.exp(values))
    return np.asarray(np.power(np.maximum(box_cox * values + 1, 1e-12), 1 / box_cox))

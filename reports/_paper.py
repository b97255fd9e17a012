"""Charts as PNG, by matplotlib, without touching its global state: for readers without scripts and for paper."""

import io
from typing import Any

import numpy as np

from .chart import Band, Bars, Chart, Figure, Line, Picture, Points, Rule, wrapped

_DPI = 150
_WIDTH, _WIDE = 4.8, 9.6  # inches: at 360 css pixels, a phone's width, the letters are 10 pixels high
_PIXELS_AN_INCH = 100.0
_MARKERS = {"circle": "o", "square": "s", "triangle": "^", "diamond": "D"}


def png_of(figure: Figure) -> bytes:
    """A figure as PNG, the same bytes whenever it is made."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    size = (_WIDE if figure.wide else _WIDTH, figure.height_px / _PIXELS_AN_INCH)
    canvas = Canvas(figsize=size, layout="constrained")
    FigureCanvasAgg(canvas)
    axis = canvas.subplots()
    if isinstance(figure, Picture):
        _draw_picture(canvas, axis, figure)
    else:
        _draw_chart(canvas, axis, figure)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def _draw_picture(canvas: Any, axis: Any, picture: Picture) -> None:
    shown = picture.shown()
    rows, columns = picture.values.shape
    image = axis.imshow(
        shown,
        cmap="gray" if picture.grey else "cividis",
        vmin=picture.ends[0],
        vmax=picture.ends[1],
        extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
        interpolation="nearest",
    )
    if picture.outline is not None and picture.outline.any():
        axis.contour(picture.outline, [0.5], colors="#e69f00", linewidths=1.2)
    canvas.colorbar(image, ax=axis, shrink=0.9).set_label(picture.label)
    axis.set(xlabel="column, px", ylabel="row, px")


def _draw_chart(canvas: Any, axis: Any, chart: Chart) -> None:
    for name, scale in (("x", chart.x_scale), ("y", chart.y_scale)):
        if scale == "log":
            getattr(axis, f"set_{name}scale")("log")
    for mark in chart.marks:
        _draw_mark(axis, chart, mark)
    for name, ticks, ends in (("x", chart.x_ticks, chart.x_ends), ("y", chart.y_ticks, chart.y_ends)):
        if ends is not None:
            getattr(axis, f"set_{name}lim")(*chart.place(ends, name))  # type: ignore[arg-type]
        if ticks is not None:
            places = chart.place(list(ticks), name)  # type: ignore[arg-type]
            getattr(axis, f"set_{name}ticks")(places, [wrapped(text) for text in ticks.values()], fontsize=8.5)
            getattr(axis, f"{name}axis").set_minor_locator(_no_ticks())
    if chart.downwards:
        axis.invert_yaxis()
    axis.set(xlabel=chart.x_label, ylabel=chart.y_label)
    axis.spines[["top", "right"]].set_visible(False)
    handles, labels = axis.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    if once:
        columns = min(len(once), 4 if chart.wide else 2)
        canvas.legend(once.values(), once, loc="outside lower left", ncols=columns, frameon=False, fontsize=8.5)


def _no_ticks() -> Any:
    from matplotlib.ticker import NullLocator

    return NullLocator()


def _draw_mark(axis: Any, chart: Chart, mark: Any) -> None:
    label = mark.label or None
    match mark:
        case Line():
            style = {"linestyle": "--" if mark.dashed else "-", "linewidth": 0.9 if mark.thin else 1.8}
            axis.plot(chart.place(mark.x, "x"), chart.place(mark.y, "y"), color=mark.colour, label=label, **style)
        case Band():
            low, high = chart.place(mark.low, "y"), chart.place(mark.high, "y")
            axis.fill_between(
                chart.place(mark.x, "x"), low, high, color=mark.colour, alpha=0.2, linewidth=0, label=label
            )
        case Bars():
            at, length = chart.place(mark.y, "y"), chart.place(mark.length, "x")
            axis.barh(at, length, mark.thickness, color=mark.colour, label=label)
            if mark.numbers:
                for y, x, value in zip(at, length, np.atleast_1d(np.asarray(mark.length, float)), strict=True):
                    axis.annotate(f"{value:.2g}", (x, y), (4, 0), textcoords="offset points", va="center", fontsize=8)
        case Rule():
            draw = axis.axvline if mark.along == "x" else axis.axhline
            draw(
                float(chart.place(mark.at, mark.along)[0]), color=mark.colour, linewidth=1.0, linestyle=":", label=label
            )
        case Points():
            x, y = chart.place(mark.x, "x"), chart.place(mark.y, "y")
            for name, ends in (("x", mark.x_ends), ("y", mark.y_ends)):
                if ends is not None:
                    low, high = (chart.place(end, name) for end in ends)  # type: ignore[arg-type]
                    draw = axis.hlines if name == "x" else axis.vlines
                    draw(y if name == "x" else x, low, high, color=mark.colour, linewidth=1.4)
            style = {"marker": _MARKERS[mark.shape], "markersize": 0.7 * mark.size_px, "markeredgewidth": 0.0}
            axis.plot(x, y, linestyle="none", color=mark.colour, label=label, **style)

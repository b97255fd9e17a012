"""Charts that answer to the pointer, by Bokeh: hover, zoom, a click that shows a point's row and images; without any request."""

import importlib.util
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from .chart import Band, Bars, Chart, Figure, Line, Picture, Rule, wrapped

_MARKERS = {"circle": "circle", "square": "square", "triangle": "triangle", "diamond": "diamond"}
_TOOLS = "pan,box_zoom,wheel_zoom,reset,save"
_OPEN = """
const chosen = source.selected.indices
if (chosen.length > 0) {
  const name = source.data.anchor[chosen[0]]
  const parts = ['images-' + name, name].map((one) => document.getElementById(one)).filter((one) => one != null)
  document.querySelectorAll('.chosen').forEach((one) => one.classList.remove('chosen'))
  for (const part of parts) {
    for (let one = part; one != null; one = one.parentElement) { if (one.tagName == 'DETAILS') { one.open = true } }
    part.classList.add('chosen')
  }
  if (parts.length > 0) { parts[0].scrollIntoView({behavior: 'smooth', block: 'center'}) }
  source.selected.indices = []
}
"""


def is_there() -> bool:
    """Whether Bokeh is installed (extra `explore`)."""
    return importlib.util.find_spec("bokeh") is not None


def library_html() -> str:
    """BokehJS itself as inline scripts: a page that has it asks nobody for it."""
    from bokeh.resources import Resources

    return str(Resources(mode="inline", components=["bokeh"], log_level="error").render())


def drawn(figures: Sequence[Figure]) -> tuple[str, list[str]]:
    """Script of all figures, and for each the element that it is drawn in; the same texts whenever they are made."""
    from bokeh.embed import components

    models = [_picture(item) if isinstance(item, Picture) else _chart(item) for item in figures]
    script, elements = components(models)
    return _renumbered(script, list(elements))


def _renumbered(script: str, elements: Sequence[str]) -> tuple[str, list[str]]:
    """Ids that Bokeh draws at random or counts through the process, counted from 1 in the order in which they appear."""
    seen: dict[str, str] = {}

    def name(found: re.Match[str]) -> str:
        return seen.setdefault(found[0], f"b{len(seen) + 1}")

    ids = re.compile(r"\b(?:p\d{4,}|[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12})\b")
    return ids.sub(name, script), [ids.sub(name, text) for text in elements]


def _blank(figure: Figure, **options: Any) -> Any:
    from bokeh.plotting import figure as canvas

    plot = canvas(
        sizing_mode="stretch_width",
        height=figure.height_px,
        tools=_TOOLS,
        active_drag=None,  # a finger on the figure scrolls the page
        active_scroll=None,
        toolbar_location="above",
        min_border_left=4,
        min_border_right=12,
        output_backend="canvas",
        **options,
    )
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    return plot


def _picture(picture: Picture) -> Any:
    from bokeh.models import ColorBar, HoverTool, LinearColorMapper, Range1d
    from bokeh.palettes import cividis, gray

    rows, columns = picture.values.shape
    plot = _blank(
        picture,
        x_range=Range1d(-0.5, columns - 0.5, bounds="auto"),
        y_range=Range1d(rows - 0.5, -0.5, bounds="auto"),
        match_aspect=True,
        x_axis_label="column, px",
        y_axis_label="row, px",
    )
    colours = LinearColorMapper(
        palette=(gray if picture.grey else cividis)(256), low=picture.ends[0], high=picture.ends[1], nan_color="white"
    )
    side = picture.square
    shown = picture.shown().astype(np.float32)
    # the axis runs down, and the first row lies where it begins
    drawn_image = plot.image(
        image=[shown],
        x=-0.5,
        y=-0.5,
        dw=shown.shape[1] * side,
        dh=shown.shape[0] * side,
        color_mapper=colours,
    )
    plot.add_tools(
        HoverTool(renderers=[drawn_image], tooltips=[(picture.label, "@image{0.000}"), ("column, row", "$x{0}, $y{0}")])
    )
    plot.add_layout(ColorBar(color_mapper=colours, title=None, width=12, padding=4), "right")
    if picture.outline is not None and picture.outline.any():
        for x, y in _outlines(picture.outline):
            plot.line(x, y, color="#e69f00", line_width=1.5)
    return plot


def _outlines(mask: Any) -> list[tuple[list[float], list[float]]]:
    import contourpy

    lines = contourpy.contour_generator(z=mask.astype(np.float64)).lines(0.5)
    return [([float(one) for one in line[:, 0]], [float(one) for one in line[:, 1]]) for line in lines]


def _chart(chart: Chart) -> Any:
    from bokeh.models import FixedTicker

    plot = _blank(
        chart,
        x_axis_type="log" if chart.x_scale == "log" else "linear",
        y_axis_type="log" if chart.y_scale == "log" else "linear",
        x_axis_label=chart.x_label,
        y_axis_label=chart.y_label,
    )
    labelled = False
    for mark in chart.marks:
        labelled |= bool(mark.label)
        _draw(plot, chart, mark)
    for name, axis, ticks in (("x", plot.xaxis, chart.x_ticks), ("y", plot.yaxis, chart.y_ticks)):
        if ticks is not None:
            places = [float(value) for value in chart.place(list(ticks), name)]  # type: ignore[arg-type]
            axis.ticker = FixedTicker(ticks=places, minor_ticks=[])
            # Bokeh looks a label up by the number itself; whole numbers are looked up without their point
            axis.major_label_overrides = {
                (int(place) if place.is_integer() else place): wrapped(text)
                for place, text in zip(places, ticks.values(), strict=True)
            }
        elif short := chart.ticks_of_short_log(name):  # type: ignore[arg-type]
            axis.ticker = FixedTicker(ticks=list(short), minor_ticks=[])
    for name, box, ends in (("x", plot.x_range, chart.x_ends), ("y", plot.y_range, chart.y_ends)):
        if ends is not None:
            box.start, box.end = (float(value) for value in chart.place(ends, name))  # type: ignore[arg-type]
    plot.y_range.flipped = chart.downwards if chart.y_ends is None else False
    if chart.downwards and chart.y_ends is not None:
        plot.y_range.start, plot.y_range.end = plot.y_range.end, plot.y_range.start
    if labelled:
        legend = plot.legend[0]
        plot.add_layout(legend, "below")
        legend.orientation = "horizontal"
        legend.ncols = 4 if chart.wide else 2
        legend.click_policy = "mute"
        legend.border_line_color = None
        legend.label_text_font_size = "12px"
        legend.padding = legend.margin = 2
    plot.grid.grid_line_color = "#e8eaee"
    return plot


def _source(chart: Chart, mark: Any) -> Any:
    """The numbers of points, lines or bars: their places, and under `x_value`, `y_value` what the pointer tells."""
    from bokeh.models import ColumnDataSource

    x = mark.length if isinstance(mark, Bars) else mark.x
    columns: dict[str, Any] = {
        "x": chart.place(x, "x"),
        "y": chart.place(mark.y, "y"),
        "x_value": np.atleast_1d(np.asarray(x, np.float64)),
        "y_value": np.atleast_1d(np.asarray(mark.y, np.float64)),
    }
    for name in ("x", "y"):
        ends = getattr(mark, f"{name}_ends", None)
        if ends is not None:
            columns |= {f"{name}_low": chart.place(ends[0], name), f"{name}_high": chart.place(ends[1], name)}
            columns[f"{name}_told"] = [f"{a:.4g} to {b:.4g}" for a, b in zip(*map(np.atleast_1d, ends), strict=True)]
    names = getattr(mark, "names", ())
    columns["name"] = list(names) if len(names) else [mark.label] * len(columns["x"])
    if getattr(mark, "anchors", ()):
        columns["anchor"] = list(mark.anchors)
    return ColumnDataSource(columns)


def _draw(plot: Any, chart: Chart, mark: Any) -> None:
    from bokeh.models import CustomJS, HoverTool, Span, TapTool

    label = {"legend_label": mark.label} if mark.label else {}
    if isinstance(mark, Rule):
        at = float(chart.place(mark.at, mark.along)[0])
        dimension = "height" if mark.along == "x" else "width"
        plot.add_layout(
            Span(location=at, dimension=dimension, line_color=mark.colour, line_dash="dotted", line_width=1.4)
        )
        if label:
            nowhere = [float("nan")] * 2
            plot.line(nowhere, nowhere, color=mark.colour, line_dash="dotted", **label)
        return
    if isinstance(mark, Band):
        low, high = chart.place(mark.low, "y"), chart.place(mark.high, "y")
        plot.varea(chart.place(mark.x, "x"), low, high, color=mark.colour, fill_alpha=0.18, **label)
        return
    source = _source(chart, mark)
    if isinstance(mark, Line):
        style = {"line_dash": "dashed" if mark.dashed else "solid", "line_width": 1 if mark.thin else 2}
        shown = plot.line("x", "y", source=source, color=mark.colour, **style, **label)
    elif isinstance(mark, Bars):
        start = 0.0 if chart.x_ends is None else chart.place(chart.x_ends, "x")[0]
        shown = plot.hbar(
            y="y", left=start, right="x", height=mark.thickness, source=source, color=mark.colour, **label
        )
        if mark.numbers:
            texts = [f"{value:.2g}" for value in source.data["x_value"]]
            source.data["told"] = texts
            plot.text("x", "y", "told", source=source, x_offset=4, text_baseline="middle", text_font_size="11px")
    else:
        for name, ends in (("x", mark.x_ends), ("y", mark.y_ends)):
            if ends is not None:
                corners = ("x_low", "y", "x_high", "y") if name == "x" else ("x", "y_low", "x", "y_high")
                plot.segment(*corners, source=source, color=mark.colour, line_width=1.6)
        shown = plot.scatter(
            "x", "y", source=source, color=mark.colour, size=mark.size_px, marker=_MARKERS[mark.shape], **label
        )
        if mark.anchors:
            if not plot.select(type=TapTool):
                plot.add_tools(TapTool())
            source.selected.js_on_change("indices", CustomJS(args={"source": source}, code=_OPEN))
    x_label, y_label = (text or name for name, text in (("x", chart.x_label), ("y", chart.y_label)))
    told = [("", "@name")] if any(source.data["name"]) else []
    told.append((x_label, "@x_value{0.[0000]}" + (" (@x_told)" if "x_told" in source.data else "")))
    if chart.y_ticks is None:
        told.append((y_label, "@y_value{0.[0000]}" + (" (@y_told)" if "y_told" in source.data else "")))
    plot.add_tools(HoverTool(renderers=[shown], tooltips=told, visible=False))

"""What a figure of a page shows, whoever draws it: marks in the data's own numbers, axes with units, and the numbers as a table."""

import csv
import io
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

Array: TypeAlias = NDArray[np.float64]
Scale: TypeAlias = Literal["linear", "log", "asinh"]
Shape: TypeAlias = Literal["circle", "square", "triangle", "diamond"]

# Orange, bluish green and grey of Okabe and Ito, "Color universal design" (2008), and their blue made darker: apart for
# colour-blind readers by hue, and on a grey printer by lightness (CIE L* 71, 32, 57 and 45)
BEFORE, AFTER, MEASURED, QUIET = "#e69f00", "#00507d", "#009e73", "#6b6b6b"
SERIES_COLOURS = (AFTER, BEFORE, MEASURED, "#cc79a7", "#56b4e9", "#8a3b00", QUIET, "#111111")
SHAPES: tuple[Shape, ...] = ("circle", "square", "triangle", "diamond")


def _numbers(values: ArrayLike) -> Array:
    return np.atleast_1d(np.asarray(values, dtype=np.float64))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """A line through points (point,); gaps where a number is not finite."""

    x: ArrayLike
    y: ArrayLike
    colour: str = AFTER
    label: str = ""
    dashed: bool = False
    thin: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points:
    """Points (point,) with intervals along x or y where their ends are given, and a name each for the pointer."""

    x: ArrayLike
    y: ArrayLike
    colour: str = AFTER
    label: str = ""
    shape: Shape = "circle"
    names: Sequence[str] = ()
    x_ends: tuple[ArrayLike, ArrayLike] | None = None
    y_ends: tuple[ArrayLike, ArrayLike] | None = None
    anchors: Sequence[str] = ()  # ids of the page's parts that a click on a point opens
    size_px: float = 7.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Band:
    """An area between two lines (point,)."""

    x: ArrayLike
    low: ArrayLike
    high: ArrayLike
    colour: str = AFTER
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bars:
    """Horizontal bars from 0 (or from the axis' start, on a logarithm) to `length` at the heights `y` (bar,)."""

    y: ArrayLike
    length: ArrayLike
    thickness: float = 0.7
    colour: str = AFTER
    label: str = ""
    names: Sequence[str] = ()
    numbers: bool = False  # written at the end of each bar


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rule:
    """A straight line across the figure at one value of an axis."""

    at: float
    along: Literal["x", "y"] = "y"  # the axis that `at` is read on
    colour: str = QUIET
    label: str = ""


Mark: TypeAlias = Line | Points | Band | Bars | Rule


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """A chart of one panel.

    Fields: name (of the file of its numbers); alt (what is seen, for those who cannot); marks; x_label and y_label with units;
    scales (`asinh`: linear about 0, logarithmic far from it); ticks (place -> text; None: chosen); ends of the axes; downwards
    (the first row on top); height_px; wide (as wide as the page).
    """

    name: str
    alt: str
    marks: Sequence[Mark]
    title: str = ""
    x_label: str = ""
    y_label: str = ""
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    x_ticks: Mapping[float, str] | None = None
    y_ticks: Mapping[float, str] | None = None
    x_ends: tuple[float, float] | None = None
    y_ends: tuple[float, float] | None = None
    downwards: bool = False
    height_px: int = 320
    wide: bool = False
    linear_within: float = 1.0  # of the scale `asinh`

    def __post_init__(self) -> None:
        for mark in self.marks:
            sizes = {len(_numbers(value)) for value in _columns(mark).values()}
            if len(sizes) > 1:
                raise InputError(
                    f"chart {self.name}",
                    received=f"a mark with columns of {sizes} numbers",
                    expected="columns of one length",
                )

    def place(self, values: ArrayLike, axis: Literal["x", "y"]) -> Array:
        """Where values lie along an axis: themselves, or on the scale `asinh` their place on it."""
        numbers = _numbers(values)
        if (self.x_scale if axis == "x" else self.y_scale) != "asinh":
            return numbers
        return np.asarray(np.arcsinh(numbers / self.linear_within))

    def ticks_of_short_log(self, axis: Literal["x", "y"]) -> tuple[float, ...]:
        """1, 2 and 5 times powers of ten, for a logarithmic axis whose values span one to two decades; else empty.

        Between one and two decades equal steps crowd at the upper end and powers of ten are too few.
        """
        scale, ends, ticks = (getattr(self, f"{axis}_{word}") for word in ("scale", "ends", "ticks"))
        if scale != "log" or ticks is not None:
            return ()
        values = _numbers(ends) if ends is not None else np.concatenate([_along(mark, axis) for mark in self.marks])
        values = values[np.isfinite(values) & (values > 0.0)]
        if not values.size or not 10.0 <= values.max() / values.min() <= 100.0:
            return ()
        first, last = (int(np.floor(np.log10(value))) for value in (values.min(), values.max()))
        return tuple(float(f"{step}e{power}") for power in range(first - 1, last + 2) for step in (1, 2, 5))

    def numbers_csv(self) -> str:
        """The numbers that the chart shows, a row a point: mark, name, and the columns that the marks have."""
        rows = [row for number, mark in enumerate(self.marks) for row in _rows(mark, number)]
        names = list(dict.fromkeys(key for row in rows for key in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """A map (row, column) in colours; large ones are shown as means of squares of pixels.

    Fields: name; alt; values; label (of the colours, with unit); ends of the colours; grey (an image rather than a map);
    outline (row, column): what to draw a line around; title.
    """

    name: str
    alt: str
    values: NDArray[np.floating] = field(repr=False)
    label: str
    ends: tuple[float, float]
    title: str = ""
    grey: bool = False
    outline: NDArray[np.bool_] | None = field(default=None, repr=False)
    wide: bool = False
    height_px: int = 320

    @property
    def square(self) -> int:
        """Pixels along each side of what is one point of the picture."""
        return max(1, -(-int(max(self.values.shape)) // _MOST_POINTS))

    def shown(self) -> Array:
        """Means of squares of pixels (row, column), at most 160 a side; what is not finite is left out of them."""
        return mean_of_squares(np.asarray(self.values, np.float64), self.square)

    def numbers_csv(self) -> str:
        """The values that the picture shows, a line a row."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([[_plain(value) for value in row] for row in self.shown()])
        return text.getvalue()


Figure: TypeAlias = Chart | Picture

_MOST_POINTS = 160  # along a side: what a screen shows of one picture of several


def _along(mark: Mark, axis: Literal["x", "y"]) -> Array:
    """All numbers of a mark that lie along an axis."""
    if isinstance(mark, Rule):
        return _numbers(mark.at if mark.along == axis else [])
    if isinstance(mark, Bars):
        return _numbers(mark.length if axis == "x" else mark.y)
    if isinstance(mark, Band) and axis == "y":
        return np.concatenate([_numbers(mark.low), _numbers(mark.high)])
    ends = getattr(mark, f"{axis}_ends", None)
    return np.concatenate([_numbers(getattr(mark, axis)), *(map(_numbers, ends) if ends is not None else ())])


def mean_of_squares(values: Array, side: int) -> Array:
    """Means over squares of pixels (row, column) of the values in them that are finite; the last squares may be smaller."""
    if side == 1:
        return values
    rows, columns = (-(-length // side) for length in values.shape)
    padded = np.full((rows * side, columns * side), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    squares = padded.reshape(rows, side, columns, side)
    there = np.isfinite(squares)
    count = there.sum(axis=(1, 3))
    total = np.where(there, squares, 0.0).sum(axis=(1, 3))
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _columns(mark: Mark) -> dict[str, ArrayLike]:
    """Columns of a mark by their names."""
    match mark:
        case Line():
            return {"x": mark.x, "y": mark.y}
        case Points():
            ends: dict[str, ArrayLike] = {}
            for axis, given in (("x", mark.x_ends), ("y", mark.y_ends)):
                if given is not None:
                    ends |= {f"{axis}_low": given[0], f"{axis}_high": given[1]}
            return {"x": mark.x, "y": mark.y, **ends}
        case Band():
            return {"x": mark.x, "low": mark.low, "high": mark.high}
        case Bars():
            return {"y": mark.y, "x": mark.length}
        case Rule():
            return {mark.along: [mark.at]}


def _rows(mark: Mark, number: int) -> Iterator[dict[str, str]]:
    columns = {name: _numbers(values) for name, values in _columns(mark).items()}
    names = mark.names if isinstance(mark, Points | Bars) else ()
    for place in range(len(next(iter(columns.values())))):
        row = {"mark": mark.label or f"{type(mark).__name__.lower()} {number + 1}"}
        if names:
            row["name"] = names[place]
        yield row | {name: _plain(values[place]) for name, values in columns.items()}


def _plain(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else ""


def wrapped(text: str) -> str:
    """The text of a tick in lines of at most some 24 letters: a phone has no room for more beside a figure."""
    return "\n".join(textwrap.wrap(text, 24, break_long_words=True)) or text


def rows_px(names: Sequence[str]) -> int:
    """Height (px) of rows that are named at an axis: all as high as the name of most lines, so that none runs into the next."""
    lines = max((wrapped(name).count("\n") + 1 for name in names), default=1)
    return len(names) * (8 + 14 * lines)


def asinh_ticks(largest: float, *, linear_within: float) -> dict[float, str]:
    """Ticks of an axis of scale `asinh` from -largest to largest: 0, and powers of ten times the linear part."""
    steps = [0.0]
    step = linear_within
    while step <= max(largest, linear_within) * 1.01:
        steps.append(step)
        step *= 10.0 if largest > 30.0 * linear_within else 2.0
    return {sign * value: f"{sign * value:g}" for value in steps for sign in (-1.0, 1.0) if value or sign > 0}

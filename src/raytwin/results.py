"""What all results have in common: a short table as text and HTML, equality by value, plain numbers, data frames."""

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas

LINES = 20  # of a repr: what a notebook or a prompt shows without scrolling
_WIDEST = 118


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """What a result shows of itself.

    Fields: title (one line); header and rows (texts, a row as long as the header); notes (lines below); more: rows that exist
    beyond those given.
    """

    title: str
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    more: int = 0

    def as_text(self, *, lines: int = LINES, widest: int = _WIDEST) -> str:
        """At most `lines` lines of `widest` characters; rows that do not fit are counted."""
        notes = list(self.notes)
        kept_notes = notes if len(notes) <= 4 else [*notes[:3], f"... and {len(notes) - 3} more"]
        room = lines - 1 - bool(any(self.header)) - len(kept_notes)
        rows = list(self.rows)
        left = self.more
        if len(rows) + bool(left) > room:
            left += len(rows) - (room - 1)
            rows = rows[: room - 1]
        table = [self.header, *rows] if any(self.header) else rows
        widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))] if table else []
        body = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in table]
        if left:
            body.append(f"... and {left} more")
        return "\n".join(_cut(line, widest) for line in [self.title, *body, *kept_notes])

    def as_html(self) -> str:
        """A table with its title and notes; every text is escaped."""

        def row(cells: Sequence[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

        head = f"<thead>{row(self.header, 'th')}</thead>" if any(self.header) else ""
        body = "".join(row(cells, "td") for cells in self.rows[: 5 * LINES])
        left = self.more + max(len(self.rows) - 5 * LINES, 0)
        notes = [*([f"... and {left} more"] if left else []), *self.notes]
        below = "".join(f"<div>{html.escape(note)}</div>" for note in notes)
        return f"<div><strong>{html.escape(self.title)}</strong><table>{head}<tbody>{body}</tbody></table>{below}</div>"


def _cut(line: str, widest: int) -> str:
    line = " ".join(line.splitlines()).rstrip()
    return line if len(line) <= widest else line[: widest - 3] + "..."


class ByValue:
    """Base of dataclasses that hold arrays: equal where all their fields are; made with `eq=False`."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return self is other or (type(self) is type(other) and same_fields(self, other))

    __hash__ = None  # type: ignore[assignment]


class Result(ByValue):
    """Base of what the public functions return: frozen dataclasses that are made with `eq=False` and `repr=False`.

    A subclass defines `to_dict` (what its command prints with `--json`) and `_table` (what it shows of itself).
    """

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, texts, lists and dictionaries; NaN and infinities are None."""
        raise NotImplementedError

    def _table(self) -> Table:
        raise NotImplementedError

    def __repr__(self) -> str:
        return self._table().as_text()

    def _repr_html_(self) -> str:
        return self._table().as_html()


def same_fields(one: Any, other: Any) -> bool:
    """Whether two dataclass instances of one type agree in every field that takes part in comparisons."""
    return all(
        same_value(getattr(one, field.name), getattr(other, field.name))
        for field in dataclasses.fields(one)
        if field.compare
    )


def same_value(one: Any, other: Any) -> bool:
    """Equality by value: arrays of one type and shape by their elements, NaN equal to NaN, dataclasses field by field."""
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return _same_arrays(one, other)
    if dataclasses.is_dataclass(one) and not isinstance(one, type):
        return type(one) is type(other) and same_fields(one, other)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same_value(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(same_value(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return bool(one == other)


def _same_arrays(one: Any, other: Any) -> bool:
    if not (isinstance(one, np.ndarray) and isinstance(other, np.ndarray)):
        return False
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    return bool(np.array_equal(one, other, equal_nan=one.dtype.kind in "fc"))


def counted(number: int, name: str) -> str:
    """A number with its noun: `1 network`, `2 networks`."""
    return f"{number} {name}{'s' * (number != 1)}"


def plain(value: Any) -> Any:
    """The value in JSON's own types: numpy's become Python's, NaN and infinities None (JSON has no word for them)."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row for a data frame: `{value, low, high}` under `mean_DN` becomes the columns mean_DN, mean_DN_low, mean_DN_high; other
    mappings are joined by an underscore, lists by semicolons."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            for key, item in flat(value).items():
                found[name if key == "value" else f"{name}_{key}"] = item
        elif isinstance(value, list | tuple):
            found[name] = "; ".join(str(item) for item in value)
        else:
            found[name] = value
    return found


def frame(rows: Sequence[Mapping[str, Any]], *, columns: Sequence[str] = ()) -> "pandas.DataFrame":
    """Rows as a pandas data frame, intervals as three columns; None is NaN in columns of numbers. columns: where no row is."""
    import pandas

    return pandas.DataFrame([flat(plain(row)) for row in rows], columns=None if rows else list(columns))


def number_text(value: float | None, digits: int = 4) -> str:
    """A number for people; `not known` where there is none."""
    return "not known" if value is None else f"{value:.{digits}g}"


def percent_text(share: float | None) -> str:
    """A share in whole per cent for people; None: of nothing."""
    return "none to judge by" if share is None else f"{100 * share:.0f} %"


def between_text(low: str | None, high: str | None) -> str:
    """The ends of an interval for people, each already in words; None: an end that the data do not give."""
    if low is None:
        return "no interval" if high is None else f"up to {high}"
    return f"{low} and more" if high is None else f"{low} to {high}"


def interval_text(value: Mapping[str, Any] | None, digits: int = 4) -> tuple[str, str]:
    """A value and its interval for two columns of a table."""
    if value is None:
        return "not known", ""
    ends = (value.get("low"), value.get("high"))
    if all(end is None for end in ends):
        return number_text(value.get("value"), digits), ""
    low, high = (None if end is None else f"{end:.{digits}g}" for end in ends)
    return number_text(value.get("value"), digits), between_text(low, high)


def axes_or_new(ax: Any, *, size_inches: tuple[float, float] = (6.4, 4.4)) -> Any:
    """The axes given, or those of a new pyplot figure, which notebooks show."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=size_inches, layout="constrained")[1]

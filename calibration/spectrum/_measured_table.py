"""Tables of measurements as people keep them: CSV with a header, a measurement a row."""

import csv
import difflib
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ...acquisition.setting import Filter, filters_from_text
from ...errors import InputError
from ...files import CSV_UTF8, read_utf8, with_decimal_points
from ...materials import material_from_name
from ...spectra import checked_kV

MOST_ROWS = 20_000
# Readings that scatter by 0.1 % or more agree to this resolution by chance in three cases of a hundred at most,
# 1e-4 / (2 root(pi) 1e-3): two rows so alike are one row, copied.
_COPY_RESOLUTION = 1e-4
_DECIMAL_COMMA = re.compile(r"(:\s*\d+),(\d)")  # of a thickness: Cu:0,1
_REMEDY = "write decimals with a point, or separate columns by semicolons"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A number as it was written: value, and the step of its last digit (`resolution`, same unit)."""

    value: float
    resolution: float

    @property
    def relative_sd(self) -> float:
        """Standard deviation of its rounding over the value: a step wide and flat, 1 / root 12 of it."""
        return self.resolution / math.sqrt(12.0) / self.value


@dataclass(frozen=True, slots=True, kw_only=True)
class TableRow:
    """One row: where it stands (`place`, for messages; `line` of the file) and its cells, by lower-case column."""

    place: str
    line: int
    cells: Mapping[str, str]

    def has(self, column: str) -> bool:
        """Whether something is written in the column."""
        return bool(self.cells.get(column.lower(), ""))

    def text(self, column: str) -> str:
        """What is written in the column; empty where nothing is."""
        return self.cells.get(column.lower(), "")

    def reading(self, column: str, *, unit: str, below: float = math.inf) -> Reading:
        """The positive number in a column.

        Raises:
            InputError: nothing, no number, or one that is not above 0 and below `below`.
        """
        text = self.text(column)
        try:
            value = float(text)
        except ValueError:
            raise InputError(
                f"{self.place}: {column}",
                received=repr(text) if text else "nothing",
                expected=f"a number in {unit}",
                remedy=_REMEDY if "," in text else "",
            ) from None
        if not (math.isfinite(value) and 0.0 < value < below):
            upper = "" if below == math.inf else f" and below {below:g}"
            raise InputError(f"{self.place}: {column}", received=f"{text} {unit}", expected=f"more than 0{upper}")
        return Reading(value=value, resolution=_resolution(text))

    def number(self, column: str, *, unit: str) -> float:
        """The value of `reading`."""
        return self.reading(column, unit=unit).value

    def kV(self, anode: str) -> float:
        """Tube voltage, where spectra of the anode are known."""
        try:
            return checked_kV(self.number("kV", unit="kV"), anode=anode)
        except InputError as error:
            raise self._told(error) from None

    def filters(self) -> tuple[Filter, ...]:
        """The layers of the column `filter`, every material known."""
        try:
            layers = filters_from_text(_DECIMAL_COMMA.sub(r"\1.\2", self.text("filter")))
            for layer in layers:
                material_from_name(layer.material)
        except InputError as error:
            raise self._told(error) from None
        return tuple(layer for layer in layers if layer.thickness_mm > 0)

    def _told(self, error: InputError) -> InputError:
        if error.argument.startswith(self.place):
            return error
        return InputError(
            f"{self.place}: {error.argument}", received=error.received, expected=error.expected, remedy=error.remedy
        )


def read_rows(
    path: str | os.PathLike[str], *, option: str, required: Sequence[str], known: Sequence[str]
) -> list[TableRow]:
    """Rows of a CSV file with a header; lines that start with # and empty ones are passed over.

    Args:
        path: the file, UTF-8, columns separated by commas, semicolons or tabs; decimals with a point, or with a comma where
            no comma separates columns.
        option: the option that it was given by, for messages.
        required: columns that must be there.
        known: all columns that have a meaning; capital letters do not matter.

    Raises:
        InputError: no such file, no text, no row, columns missing or unknown (the nearest known one is named).
    """
    name = os.path.basename(os.fspath(path))
    try:
        text = read_utf8(path, argument=f"{option} {name}", save_as=CSV_UTF8)
    except OSError:
        raise InputError(
            f"{option} {name}", received="no file that can be read", expected="a CSV file with a header"
        ) from None
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]
    expected = "a header with the columns " + ", ".join(required)
    if not lines:
        raise InputError(f"{option} {name}", received="an empty table", expected=expected)
    delimiter = max(",;\t", key=lines[0][1].count)
    try:
        cells = list(csv.reader([line for _, line in lines], delimiter=delimiter, strict=True))
    except csv.Error as error:
        raise InputError(f"{option} {name}", received=f"no table ({error})", expected="a CSV file") from None
    header = [cell.strip().lower() for cell in cells[0]]
    _check_columns(f"{option} {name}", cells[0], required=required, known=known)
    if len(cells) == 1:
        raise InputError(f"{option} {name}", received="a header without rows", expected="a measurement a row")
    if len(cells) > MOST_ROWS:
        raise InputError(f"{option} {name}", received=f"{len(cells) - 1} rows", expected=f"at most {MOST_ROWS}")
    body = cells[1:]
    if delimiter != ",":
        numbers = [line for line, _ in lines[1 : len(cells)]]
        body = with_decimal_points(cells[0], body, lines=numbers, argument=f"{option} {name}")
    rows = []
    for (line, _), row in zip(lines[1:], body, strict=False):
        if len(row) > len(header):
            raise InputError(
                f"{option} {name}, line {line}",
                received=f"{len(row)} cells",
                expected=f"{len(header)}, as in the header",
                remedy=f"join filters by +; {_REMEDY}",
            )
        values = {column: cell.strip() for column, cell in zip(header, row, strict=False)}
        rows.append(TableRow(place=f"{option} {name}, line {line}", line=line, cells=values))
    return rows


def refuse_copies(rows: Sequence[TableRow], columns: Sequence[str], resolutions: Sequence[float]) -> tuple[str, ...]:
    """Refuse rows alike in every one of `columns`, where the finest relative resolution (row,) leaves hardly a chance of it.

    Returns:
        A line for each other row that repeats one: it counts as a reading.

    Raises:
        InputError: two such rows.
    """
    seen: dict[tuple[str, ...], TableRow] = {}
    told = []
    for row, resolution in zip(rows, resolutions, strict=True):
        key = tuple(row.text(column) for column in columns)
        if key in seen and resolution < _COPY_RESOLUTION:
            raise InputError(
                row.place,
                received=f"the same numbers as in line {seen[key].line}, digit by digit",
                expected="a measurement a row",
                remedy="delete the copy",
            )
        if key in seen:
            told.append(
                f"line {row.line} repeats line {seen[key].line} digit by digit; it counts as a reading of its own"
            )
        seen.setdefault(key, row)
    return tuple(told)


def _resolution(text: str) -> float:
    mantissa, _, exponent = text.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(10.0 ** (int(exponent or 0) - decimals))


def _check_columns(argument: str, header: Sequence[str], *, required: Sequence[str], known: Sequence[str]) -> None:
    given = [cell.strip().lower() for cell in header]
    lower = {name.lower(): name for name in known}
    for cell, column in zip(header, given, strict=True):
        if column and column not in lower:
            near = difflib.get_close_matches(column, list(lower), n=1, cutoff=0.4)
            raise InputError(
                argument,
                received=f"a column {cell.strip()!r}",
                expected="columns out of " + ", ".join(known),
                remedy=f"did you mean {lower[near[0]]}?" if near else "rename or remove it",
            )
    doubled = sorted({column for column in given if column and given.count(column) > 1})
    if doubled:
        raise InputError(argument, received=f"the column {lower[doubled[0]]} twice", expected="each column once")
    missing = [name for name in required if name.lower() not in given]
    if missing:
        raise InputError(argument, received=f"no column {missing[0]}", expected="the columns " + ", ".join(required))

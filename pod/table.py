"""Read hit/miss and response tables: HITS.csv of `raytwin detect`, mh1823 files, spreadsheets' exports.

Comma, semicolon or tab; decimal comma where the separator is not a comma; lines that begin with # are comments. One
trial a row, counts of trials a row, or one column of hits per inspection (as mh1823 writes them). An empty size (or NaN, NA) is a
product without foreign object: it is left out of the curve, and its false alarm is counted.
"""

import csv
import difflib
import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError
from ..files import CSV_UTF8, is_number, read_utf8, with_decimal_points
from ..results import ByValue, counted

if TYPE_CHECKING:
    import pandas

Array = NDArray[np.float64]

SIZE_NAMES = ("contrast", "size", "size_mm", "a", "flaw_size", "flawsize", "depth", "length", "diameter")
HIT_NAMES = ("hit", "hits", "hit_miss", "hitmiss", "hit/miss", "detected", "detection")
SITE_NAMES = ("site", "target", "target_id", "id")
_MISSING = ("NaN", "nan", "NA", "NaT", "<NA>")  # an empty cell, as pandas and R write it
_EXCEL_SEPARATOR = ("sep=,", "sep=;")
_HIT_WORDS = {
    "0": 0.0,
    "1": 1.0,
    "miss": 0.0,
    "hit": 1.0,
    "false": 0.0,
    "true": 1.0,
    "no": 0.0,
    "yes": 1.0,
}


# columns of a table whose inspections stood side by side
_MELTED_ROW, _MELTED_INSPECTION, _MELTED_HIT = "raytwin_row", "raytwin_inspection", "raytwin_hit"


class HitError(InputError):
    """A cell in the column of hits is neither a hit nor a miss."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PodTable(ByValue):
    """Rows with a foreign object, and the count of those without. Labels are text, None where there is no such column.

    size (row,) in the column's own unit, or None; hits (row,), trials (row,) or None; response (row,) or None;
    other: every remaining column as text, for the rows with an object. false_alarm (product,): 1 where a product
    without object was marked; its labels beside it; noise_response: their
    responses. notes: what was read in another way than one might think. places: what messages call each row with an object, `line 3`
    of a file or `row 3` of columns in memory.
    """

    size_name: str
    size: Array
    hits: Array | None = None
    trials: Array | None = None
    response: Array | None = None
    network: tuple[str, ...] | None = None
    image: tuple[str, ...] | None = None
    site: tuple[str, ...] | None = None
    other: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    false_alarm: Array = field(default_factory=lambda: np.zeros(0))
    false_alarm_network: tuple[str, ...] | None = None
    false_alarm_image: tuple[str, ...] | None = None
    noise_response: Array = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()
    places: tuple[str, ...] = ()

    def numbers(self, name: str) -> Array:
        """A column of the table as numbers (row,).

        Raises:
            InputError: there is no such column, or it holds something else than finite numbers.
        """
        if name == self.size_name:
            return self.size
        column = _chosen(name, list(self.other), "covariate or explaining column")
        values = np.empty(len(self.size))
        for row, text in enumerate(self.other[column]):
            values[row] = _number(text, column, self.places[row] if self.places else f"row {row + 1}")
        return values


def read_pod_table(
    source: "str | os.PathLike[str] | Mapping[str, Sequence[Any]] | pandas.DataFrame",
    *,
    size: str | None = None,
    hit: str | Sequence[str] | None = None,
    trials: str | None = None,
    response: str | None = None,
    site: str | None = None,
    network: str | None = None,
    image: str | None = None,
    where: Mapping[str, str] | None = None,
) -> PodTable:
    """Read a table of trials; sizes in the unit of their column.

    Args:
        source: the file, text with a header line; or a pandas data frame, or column -> values, with a row a trial.
        size: the size's column; None = the first of contrast, size, size_mm, ...
        hit: the column of hits; several (or comma-separated) = one inspection each; None = `hit` or the like, else the
            inspections of mh1823's layout: two or more columns of 0 and 1, with nothing else but labels after the size.
        trials: the column of the number of trials of a row.
        response: the column of a continuous response; then no hits are read.
        site, network, image: columns of labels; None = `site` (or target), `network`, `image` where they exist.
        where: column -> value; other rows are left out.

    Raises:
        FileFormatError: no such file, not text, no header, a row with another number of columns.
        InputError: a column is missing or holds something that cannot be used; the message gives the line of a file, or the row
            of columns in memory.
    """
    sheet = _sheet_of(source)
    if where:
        sheet = _filtered(sheet, where)
    notes: list[str] = []
    size_name = _chosen(size, sheet.header, "size") if size else _default(sheet.header, SIZE_NAMES, "size")
    labels = {
        "network": _label_column("network", network, sheet.header, ("network",)),
        "image": _label_column("image", image, sheet.header, ("image",)),
        "site": _label_column("site", site, sheet.header, SITE_NAMES),
    }
    trials_name = _chosen(trials, sheet.header, "trials") if trials else None
    response_name = _chosen(response, sheet.header, "response") if response else None
    hit_name = None
    if response_name is None:
        taken = [name for name in (*labels.values(), trials_name) if name]
        hit_names = _hit_columns(hit, sheet, sheet.header.index(size_name), taken)
        hit_name = hit_names[0] if hit_names else None
        if len(hit_names) > 1:
            if trials_name:
                raise InputError(
                    "trials", received=f"with {len(hit_names)} columns of hits", expected="one column of hits"
                )
            sheet = _melted(sheet, hit_names)
            hit_name = _MELTED_HIT
            labels["image"] = labels["image"] or labels["site"] or _MELTED_ROW
            labels["network"] = _MELTED_INSPECTION
            notes.append(f"columns {', '.join(hit_names)} read as {len(hit_names)} inspections of each row")
    with_object, without = _rows_with_and_without(sheet, size_name, notes)
    sizes = sheet.numbers(size_name, with_object)
    zeros = int((sizes == 0).sum())
    if 1 < zeros < len(sizes) and not trials_name and np.all(sizes >= 0):
        notes.append(
            f"{zeros} rows of {size_name} 0 taken as foreign objects of that size; a product without one has an empty {size_name}"
        )
    hits = None
    if hit_name is not None:
        read = sheet.numbers if trials_name else sheet.hits
        hits = read(hit_name, with_object)
    alarms, without = _false_alarms(sheet, _present(sheet.header, ("false_alarm",)) or hit_name, without, notes)
    noise = np.zeros(0)
    if response_name and without:
        noise = sheet.numbers(response_name, sheet.filled(response_name, without))
    own = {size_name, *(name for name in (hit_name, trials_name, response_name) if name)}
    return PodTable(
        size_name=size_name,
        size=sizes,
        hits=hits,
        trials=sheet.numbers(trials_name, with_object) if trials_name else None,
        response=sheet.numbers(response_name, with_object) if response_name else None,
        **{role: sheet.texts(name, with_object) if name else None for role, name in labels.items()},
        other={name: sheet.texts(name, with_object) for name in sheet.header if name not in own},
        false_alarm=alarms,
        false_alarm_network=sheet.texts(labels["network"], without) if labels["network"] and len(alarms) else None,
        false_alarm_image=sheet.texts(labels["image"], without) if labels["image"] and len(alarms) else None,
        noise_response=noise,
        notes=tuple(notes),
        places=tuple(sheet.places[number] for number in with_object),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sheet:
    """A table as it stands in a file: names of columns, rows of texts, and what each row is called in a message."""

    header: list[str]
    rows: list[list[str]]
    places: list[str]

    def texts(self, name: str, chosen: Sequence[int]) -> tuple[str, ...]:
        """A column of the rows chosen."""
        at = self.header.index(name)
        return tuple(self.rows[number][at].strip() for number in chosen)

    def numbers(self, name: str, chosen: Sequence[int]) -> Array:
        """A column of the rows chosen as finite numbers."""
        return np.array([_number(text, name, place) for text, place in self._told(name, chosen)])

    def hits(self, name: str, chosen: Sequence[int]) -> Array:
        """A column of the rows chosen as 0 and 1."""
        shown = name.replace(_MELTED_HIT, "hit")
        return np.array([_hit(text, shown, place) for text, place in self._told(name, chosen)])

    def filled(self, name: str, chosen: Sequence[int]) -> list[int]:
        """Those of the rows chosen where a column is not empty."""
        return [number for number, text in zip(chosen, self.texts(name, chosen), strict=True) if text != ""]

    def _told(self, name: str, chosen: Sequence[int]) -> list[tuple[str, str]]:
        return [(text, self.places[number]) for number, text in zip(chosen, self.texts(name, chosen), strict=True)]


def _label_column(role: str, name: str | None, header: list[str], usual: Sequence[str]) -> str | None:
    """The column that was named for a role, else the usual one, if there is one."""
    return _chosen(name, header, role) if name else _present(header, usual)


def _rows_with_and_without(sheet: _Sheet, size_name: str, notes: list[str]) -> tuple[list[int], list[int]]:
    """Rows with a foreign object of known size, and rows of products without one."""
    with_size = set(sheet.filled(size_name, range(len(sheet.rows))))
    object_name = _present(sheet.header, ("foreign_object",))
    without_size = [number for number in range(len(sheet.rows)) if number not in with_size]
    unknown = set(sheet.filled(object_name, without_size)) if object_name else set()
    if unknown:
        notes.append(f"left out: {counted(len(unknown), 'row')} with a foreign object but no {size_name}")
    if not with_size:
        raise InputError(size_name, received="no row with a size", expected="sizes of foreign objects in this column")
    return sorted(with_size), [number for number in without_size if number not in unknown]


def _false_alarms(sheet: _Sheet, name: str | None, without: list[int], notes: list[str]) -> tuple[Array, list[int]]:
    """False alarms (0 or 1) of the products without foreign object, and those of these rows that tell of one."""
    if name is None or not without:
        return np.zeros(0), without
    told = sheet.filled(name, without)
    alarms = sheet.hits(name, told)
    if len(told) < len(without):
        notes.append(f"no word of a false alarm in {counted(len(without) - len(told), 'row')} without foreign object")
    return alarms, told


def _sheet_of(source: Any) -> _Sheet:
    """The sheet of a file, or of columns in memory."""
    if isinstance(source, str | os.PathLike):
        return _read_sheet(Path(source))
    if not (isinstance(source, Mapping) or hasattr(source, "columns")):
        raise InputError(
            "table", received=type(source).__name__, expected="a path, a data frame or a mapping of columns"
        )
    names = list(source) if isinstance(source, Mapping) else list(source.columns)
    columns = [[_cell_text(value) for value in source[name]] for name in names]
    if not columns:
        raise InputError("table", received="a table without columns", expected="columns of sizes and hits")
    if len({len(column) for column in columns}) != 1:
        raise InputError(
            "table", received=f"columns of {[len(column) for column in columns]} rows", expected="columns of one length"
        )
    if not columns[0]:
        raise InputError("table", received="an empty table", expected="a row for each trial")
    header = [str(name).strip() for name in names]
    if len(set(header)) != len(header) or "" in header:
        raise InputError("table", received=", ".join(header), expected="distinct, non-empty column names")
    rows = [list(row) for row in zip(*columns, strict=True)]
    return _Sheet(header=header, rows=rows, places=[f"row {number}" for number in range(1, len(rows) + 1)])


def _cell_text(value: Any) -> str:
    """A value as the cell of a file would have it; what is missing is empty."""
    return "" if value is None or str(value) in _MISSING else str(value)


def _read_sheet(path: Path) -> _Sheet:
    try:
        text = read_utf8(path, argument=f"table {path}", save_as=CSV_UTF8)
    except FileNotFoundError:
        raise FileFormatError("table", received=path, expected="a file that exists") from None
    except (IsADirectoryError, PermissionError):
        raise FileFormatError(
            "table", received=path, expected="a readable text file of comma-separated values"
        ) from None
    kept = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if len(kept) < 2:
        raise FileFormatError(
            "table", received=f"{path} with {counted(len(kept), 'line')}", expected="a header and rows of trials"
        )
    first = kept[0][1]
    separator = max(",;\t", key=first.count)
    if (
        first.strip().lower() in _EXCEL_SEPARATOR and len(kept) > 2
    ):  # the line that tells Excel how columns are separated
        separator = first.strip()[-1]
        kept = kept[1:]
        first = kept[0][1]
    reader = csv.reader(io.StringIO("\n".join(line for _, line in kept)), delimiter=separator, skipinitialspace=True)
    try:
        cells = [list(row) for row in reader]
    except csv.Error as error:
        raise FileFormatError("table", received=f"{path} ({error})", expected="comma-separated values") from None
    while cells[0][-1:] == [""] and not any("".join(row[len(cells[0]) - 1 :]).strip() for row in cells):
        cells = [row[: len(cells[0]) - 1] for row in cells]  # an empty column at the right edge of a sheet
    header = [name.strip() for name in cells[0]]
    numbers = [n for n, _ in kept][1:]
    if all(is_number(name) for name in header):
        raise FileFormatError(
            "table header",
            received=first,
            expected="column names in the first line",
            remedy="add a line such as size,hit",
        )
    if len(set(header)) != len(header) or "" in header:
        raise FileFormatError("table header", received=", ".join(header), expected="distinct, non-empty column names")
    for number, row in zip(numbers, cells[1:], strict=False):
        if len(row) != len(header):
            raise FileFormatError(
                f"table line {number}", received=counted(len(row), "column"), expected=f"{len(header)} as in the header"
            )
    body = cells[1:]
    if separator != ",":
        body = with_decimal_points(header, body, lines=numbers, argument=f"table {path}")
    rows = [["" if cell.strip() in _MISSING else cell for cell in row] for row in body]
    return _Sheet(header=header, rows=rows, places=[f"line {number}" for number in numbers])


def _filtered(sheet: _Sheet, where: Mapping[str, str]) -> _Sheet:
    if not isinstance(where, Mapping):
        raise InputError("where", received=repr(where), expected="column -> value, for example {'setting': '20ms'}")
    rows = sheet.rows
    kept = list(range(len(rows)))
    for name, wanted in where.items():
        at, value = sheet.header.index(_chosen(name, sheet.header, "where")), str(wanted).strip()
        known = sorted({rows[i][at].strip() for i in kept})
        kept = [i for i in kept if rows[i][at].strip() == value]
        if not kept:
            raise InputError("where", received=f"{name}={value}", expected=f"one of {', '.join(known[:12])}")
    return replace(sheet, rows=[rows[i] for i in kept], places=[sheet.places[i] for i in kept])


def _chosen(name: str, header: list[str], option: str) -> str:
    if name in header:
        return name
    same = [known for known in header if known.lower() == name.lower()]
    if len(same) == 1:
        return same[0]
    near = difflib.get_close_matches(name.lower(), [known.lower() for known in header], n=1, cutoff=0.5)
    hint = next((known for known in header if near and known.lower() == near[0]), None)
    raise InputError(
        option,
        received=repr(name),
        expected="a column of the table: " + ", ".join(header)
        if header
        else "a column of the table, which has no further ones",
        remedy=f"did you mean {hint}?" if hint else "",
    )


def _present(header: list[str], names: Sequence[str]) -> str | None:
    lower = {known.lower(): known for known in header}
    return next((lower[name] for name in names if name in lower), None)


def _default(header: list[str], names: Sequence[str], option: str) -> str:
    found = _present(header, names)
    if found is None:
        near = _near(names, header)
        raise InputError(
            option,
            received="columns " + ", ".join(header),
            expected="one of " + ", ".join(names),
            remedy=f"did you mean {near}? name it: {option}={near!r} (--{option} {near})"
            if near
            else f"name the column: {option}=... (--{option})",
        )
    return found


def _near(names: Sequence[str], header: list[str]) -> str | None:
    """The column whose name is nearly one of `names`, the nearest of several; None: there is none."""
    lower = {known.lower(): known for known in header}
    found = [
        (difflib.SequenceMatcher(None, name, one).ratio(), one)
        for name in names
        for one in difflib.get_close_matches(name, lower, n=1, cutoff=0.65)
    ]
    return lower[max(found)[1]] if found else None


def _hit_columns(hit: str | Sequence[str] | None, sheet: _Sheet, at_size: int, taken: list[str]) -> list[str]:
    """The columns of hits, one or more; those already taken for something else are none."""
    header = sheet.header
    if hit is not None:
        asked = [hit] if isinstance(hit, str) else list(hit)
        names = [part.strip() for name in asked for part in (name.split(",") if name not in header else [name])]
        return [_chosen(name, header, "hit") for name in names]
    found = _present(header, HIT_NAMES)
    if found is not None:
        return [found]
    after = [name for name in header[at_size + 1 :] if name not in taken]
    # a single column of 0 and 1, or one beside numbers of another kind, may be anything
    if len(after) > 1 and all(set(sheet.texts(name, range(len(sheet.rows)))) <= {"0", "1"} for name in after):
        return after
    return [_default(header, HIT_NAMES, "hit")]


def _melted(sheet: _Sheet, hits: list[str]) -> _Sheet:
    """A row for each inspection, of a sheet with a column of hits for each."""
    keep = [at for at, name in enumerate(sheet.header) if name not in hits]
    place = [(name, sheet.header.index(name)) for name in hits]
    melted: list[list[str]] = []
    places: list[str] = []
    for order, (row, its_place) in enumerate(zip(sheet.rows, sheet.places, strict=True)):
        for name, at in place:
            if row[at].strip() == "":
                continue  # this inspector did not look at this site
            melted.append([*(row[k] for k in keep), str(order), name, row[at]])
            places.append(its_place)
    header = [*(sheet.header[k] for k in keep), _MELTED_ROW, _MELTED_INSPECTION, _MELTED_HIT]
    return _Sheet(header=header, rows=melted, places=places)


def _number(text: str, name: str, place: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"column {name}, {place}", received=repr(text), expected="a finite number")
    return value


def _hit(text: str, name: str, place: str) -> float:
    word = text.strip().lower()
    if word in _HIT_WORDS:
        return _HIT_WORDS[word]
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if value not in (0.0, 1.0):
        raise HitError(
            f"column {name}, {place}",
            received=repr(text),
            expected="0 (miss) or 1 (hit)",
            remedy="counts of hits need trials=... (--trials), a continuous response response=... (--response)"
            if math.isfinite(value)
            else "",
        )
    return value

"""Reading a sidecar (TOML) that a person wrote: unknown words are found out, not passed over."""

import csv
import difflib
import io
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, InputError
from ..files import CSV_UTF8, read_utf8
from ._hdf5 import named
from ._image_files import RawLayout, natural_key
from .instrument import BOOLEAN_FIELDS, LAYER_FIELDS, TEXT_FIELDS, WHOLE_FIELDS, Instrument
from .setting import filters_from_text

NAME = "raytwin.toml"


def read_sidecar(source: Path, sidecar: Path | None, *, known: Iterable[str], minimal: str) -> dict[str, Any]:
    """The tables of the sidecar of a folder.

    Args:
        source: the folder with the images.
        sidecar: the TOML file; None = `raytwin.toml` in the folder.
        known: names of the tables that may stand in it.
        minimal: a short valid sidecar, shown where none is found.
    """
    if not source.is_dir():
        given = "a file" if source.exists() else "no such folder"
        raise InputError(str(source), received=given, expected=f"a folder of images with a {NAME}")
    path = source / NAME if sidecar is None else sidecar
    if not path.is_file():
        empty = not any(source.iterdir())
        raise InputError(
            str(path),
            received="an empty folder" if empty and sidecar is None else "no such file",
            expected="a sidecar that says what the images are",
            remedy=f"write one, at least: {minimal}",
        )
    try:
        tables = tomllib.loads(read_utf8(path))
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(
            str(path),
            received=f"text that is not TOML ({error})",
            expected="a TOML file",
            remedy="write texts in quotes and numbers with a decimal point",
        ) from None
    check_words(tables, known, where=path.name)
    return tables


def check_words(table: Mapping[str, Any], known: Iterable[str], *, where: str) -> None:
    """Refuse words that mean nothing here, with the nearest that do."""
    allowed = sorted(known)
    for word in table:
        if word not in allowed:
            near = difflib.get_close_matches(word, allowed, n=2)
            raise InputError(
                f"{where}",
                received=f"the word {word!r}",
                expected="one of " + ", ".join(allowed),
                remedy=f"did you mean {' or '.join(near)}?" if near else "",
            )


def tables_of(tables: Mapping[str, Any], name: str, *, where: str) -> list[dict[str, Any]]:
    """A list of tables written `[[name]]`; empty where there is none."""
    found = tables.get(name, [])
    if not isinstance(found, list) or not all(isinstance(table, dict) for table in found):
        raise InputError(f"{where}, {name}", received="one table", expected=f"tables written [[{name}]]")
    return found


def text_of(table: Mapping[str, Any], word: str, *, where: str, default: str | None = None) -> str | None:
    """A text, or the default."""
    value = table.get(word, default)
    if value is not None and not isinstance(value, str):
        raise InputError(f"{where}, {word}", received=repr(value), expected="a text in quotes")
    return value


def number_of(table: Mapping[str, Any], word: str, *, where: str) -> float | None:
    """A number, or None where it is absent."""
    value = table.get(word)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}, {word}", received=repr(value), expected="a number without quotes")
    return value


def instrument_of(tables: Mapping[str, Any], *, where: str) -> Instrument:
    """The table [instrument]; layers are written as `CsI:0.6`."""
    table = tables.get("instrument", {})
    where = f"{where}, [instrument]"
    if not isinstance(table, dict):
        raise InputError(where, received=repr(table), expected="a table")
    check_words(table, (field.name for field in fields(Instrument)), where=where)
    values: dict[str, Any] = {}
    for word, value in table.items():
        if word in LAYER_FIELDS:
            values[word] = filters_from_text(text_of(table, word, where=where) or "")
        elif word in TEXT_FIELDS:
            values[word] = text_of(table, word, where=where)
        elif word in BOOLEAN_FIELDS:
            if not isinstance(value, bool):
                raise InputError(f"{where}, {word}", received=repr(value), expected="true or false")
            values[word] = value
        elif word in WHOLE_FIELDS:
            if isinstance(value, bool) or not isinstance(value, int):
                raise InputError(f"{where}, {word}", received=repr(value), expected="a whole number")
            values[word] = value
        else:
            values[word] = number_of(table, word, where=where)
    with named(where, InputError):
        return Instrument(**values)


def raw_layout_of(tables: Mapping[str, Any], *, where: str) -> RawLayout | None:
    """The table [raw], or None."""
    table = tables.get("raw")
    if table is None:
        return None
    where = f"{where}, [raw]"
    if not isinstance(table, dict):
        raise InputError(where, received=repr(table), expected="a table")
    check_words(table, ("rows", "columns", "dtype", "byte_order", "header_bytes"), where=where)
    for word in ("rows", "columns"):
        if not isinstance(table.get(word), int):
            raise InputError(f"{where}, {word}", received=repr(table.get(word)), expected="a whole number of pixels")
    if not isinstance(table.get("header_bytes", 0), int):
        raise InputError(f"{where}, header_bytes", received=repr(table["header_bytes"]), expected="a whole number")
    return RawLayout(**table)


def rows_of(folder: Path, table: Mapping[str, Any], key: str, *, where: str) -> dict[str, dict[str, str]]:
    """Rows of the csv file that the word `rows` names, by their column `key`; empty where the word is absent."""
    name = text_of(table, "rows", where=where)
    if name is None:
        return {}
    path = folder / name
    if not path.is_file():
        raise InputError(f"{where}, rows", received=name, expected="a csv file in the folder")
    text = read_utf8(path, save_as=CSV_UTF8)
    reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    if key not in (reader.fieldnames or []):
        there = ", ".join(reader.fieldnames or []) or "none"
        raise FileFormatError(str(path), received=f"columns {there}", expected=f"a column {key} among them")
    return {row[key]: {word: value for word, value in row.items() if value} for row in reader}


def files_matching(folder: Path, patterns: str | list[str], *, where: str) -> list[Path]:
    """The files that one or several patterns name, each once, in the order in which people count."""
    found: list[Path] = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        _check_pattern(pattern, where=where)
        matches = sorted((path for path in folder.glob(pattern) if path.is_file()), key=natural_key)
        if not matches:
            raise InputError(
                where,
                received=f"no file that matches {pattern!r}",
                expected=f"images below {folder.name}/",
                remedy="check folder and ending: upper and lower case count",
            )
        found += [path for path in matches if path not in found]
    return found


def folders_matching(folder: Path, pattern: str, *, where: str) -> list[Path]:
    """The folders that a pattern names, in the order in which people count."""
    _check_pattern(pattern, where=where)
    found = sorted((path for path in folder.glob(pattern) if path.is_dir()), key=natural_key)
    if not found:
        raise InputError(
            where, received=f"no folder that matches {pattern!r}", expected=f"folders below {folder.name}/"
        )
    return found


def starred(folder: Path, pattern: str, *, where: str) -> dict[str, Path]:
    """Files by the part of their path that the one `*` of the pattern stands for."""
    _check_pattern(pattern, where=where)
    if pattern.count("*") != 1 or any(letter in pattern for letter in "?["):
        raise InputError(where, received=repr(pattern), expected="a pattern with one '*', which stands for the image")
    before, after = (re.escape(part) for part in pattern.split("*"))
    shape = re.compile(f"{before}([^/]*){after}")
    found = {}
    for path in sorted((path for path in folder.glob(pattern) if path.is_file()), key=natural_key):
        match = shape.fullmatch(path.relative_to(folder).as_posix())
        if match:
            found[match.group(1)] = path
    return found


def _check_pattern(pattern: object, *, where: str) -> None:
    if not isinstance(pattern, str) or not pattern or Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise InputError(where, received=repr(pattern), expected="a pattern below the folder, such as flats/*.tif")

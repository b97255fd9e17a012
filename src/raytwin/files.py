"""Files appear whole or not at all, and are known by their hash; texts of others are UTF-8."""

import codecs
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import FileFormatError, InputError

CSV_UTF8 = "CSV UTF-8"  # as spreadsheets name the encoding
_PART = ".part"  # ending of a file that is not whole yet


def given_path(value: object, *, expected: str, argument: str = "path") -> Path:
    """What a user gave as a path.

    Args:
        value: a text or a path.
        expected: what the path should lead to, for the message.
        argument: name of the argument, for the message.

    Raises:
        InputError: neither a text nor a path.
    """
    if not isinstance(value, str | os.PathLike):
        raise InputError(argument, received=f"{value!r} ({type(value).__name__})", expected=f"the path of {expected}")
    if not os.fspath(value).strip():
        raise InputError(argument, received="a blank path", expected=f"the path of {expected}")
    return Path(value)


def read_utf8(path: str | os.PathLike[str], *, argument: str | None = None, save_as: str = "UTF-8") -> str:
    """Text of a file in UTF-8, with or without a byte-order mark.

    Args:
        path: the file.
        argument: what the file is to the user, for the message; None: its path.
        save_as: the name of the encoding where people choose it, for the message.

    Raises:
        FileFormatError: another encoding, or no text.
        OSError: no such file, or one that cannot be read.
    """
    content = Path(path).read_bytes()
    received = "a file that is not text"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        received = "text in UTF-16"
    elif b"\0" not in content:
        try:
            return content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = content.count(b"\n", 0, error.start) + 1
            received = f"text in another encoding than UTF-8 (line {line}, byte {error.object[error.start]:#04x})"
    raise FileFormatError(
        argument or str(path), received=received, expected="text in UTF-8", remedy=f"save it as {save_as}"
    )


def with_decimal_points(
    header: Sequence[str], rows: Sequence[Sequence[str]], *, lines: Sequence[int], argument: str
) -> list[list[str]]:
    """Cells of a table whose columns are not separated by commas: `0,885` becomes `0.885`.

    Args:
        header: names of the columns.
        rows: cells (row, column); a row may be short.
        lines: (row,), where the rows stand in the file, for the message.
        argument: what the table is to the user, for the message.

    Raises:
        FileFormatError: a column with decimal commas and decimal points, one of which may separate thousands.
    """
    changed = [[_with_decimal_point(cell) for cell in row] for row in rows]
    for at, name in enumerate(header):
        written: dict[str, str] = {}
        for row, new, line in zip(rows, changed, lines, strict=False):
            if at < len(row) and "." in new[at] and is_number(new[at]):
                written.setdefault("comma" if new[at] != row[at] else "point", f"{row[at].strip()!r} in line {line}")
        if len(written) > 1:
            raise FileFormatError(
                f"{argument}, column {name.strip()}",
                received=f"{written['comma']} and {written['point']}",
                expected="decimal commas or decimal points, not both",
            )
    return changed


def _with_decimal_point(cell: str) -> str:
    changed = cell.replace(",", ".")
    return changed if cell.count(",") == 1 and is_number(changed) else cell


def is_number(text: str) -> bool:
    """Whether a text is a number, as `float` reads it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def check_writable(path: str | os.PathLike[str]) -> None:
    """Refuse a file that could not be written, before the work that makes it; nothing is made.

    Raises:
        InputError: `path` is a folder, or lies where nothing can be written.
    """
    final = given_path(path, expected="a file to write").absolute()
    if final.is_dir():
        raise InputError(str(path), received="a folder", expected="the name of a file to write")
    place = next(folder for folder in final.parents if folder.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        reason = "Permission denied" if place.is_dir() else "Not a directory"
        raise InputError(
            str(path), received=f"a place that cannot be written ({reason})", expected="a file in a folder of yours"
        )


def check_not_read(path: object, *, read: Iterable[object], argument: str = "output") -> None:
    """Refuse to write a file that is read as well: what it held would be lost.

    Args:
        path: of a file to write; anything else is let pass.
        read: what is read; paths count, and objects with a `path`, everything else does not.
        argument: what the file to write is to the user, for the message.

    Raises:
        InputError: `path` is one of `read`.
    """
    if not isinstance(path, str | os.PathLike) or not Path(path).is_file():
        return
    for given in read:
        one = getattr(given, "path", given)
        if isinstance(one, str | os.PathLike) and Path(one).is_file() and Path(one).samefile(path):
            raise InputError(
                argument, received=f"{path}, which is read", expected="another one: what it holds would be lost"
            )


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside `path` that becomes `path` when the block succeeds and disappears when it fails.

    Raises:
        InputError: `path` is a folder, or lies where nothing can be written.
    """
    final = given_path(path, expected="a file to write")
    if final.is_dir():
        raise InputError(str(path), received="a folder", expected="the name of a file to write")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{final.name}.", suffix=_PART, dir=final.parent)
        os.close(handle)
    except OSError as error:
        raise InputError(
            str(path),
            received=f"a place that cannot be written ({error.strerror})",
            expected="a file in a folder of yours",
        ) from None
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, final)
    finally:
        temporary.unlink(missing_ok=True)


def remove_parts(folder: str | os.PathLike[str]) -> None:
    """Remove what `whole_file` had begun in a folder, or in folders in it, when its process was ended.

    Args:
        folder: in which nothing else is being written, as after `only_one`.
    """
    for path in Path(folder).rglob(f".*.*{_PART}"):
        path.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], data: Mapping[str, Any]) -> None:
    """Write a JSON object for people to read, whole or not at all; what has no value (NaN) is null.

    Raises:
        InputError: `path` is a folder, or lies where nothing can be written.
    """
    from .results import plain  # numpy, which the command line's help does without

    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(plain(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def sha256_of_file(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes, as 64 hexadecimal digits; read in pieces."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_new_folder(path: str | os.PathLike[str]) -> None:
    """Refuse a folder to write that holds something, before the work that fills it.

    Raises:
        InputError: a file, or a folder with something in it.
    """
    final = given_path(path, expected="a folder to write")
    if final.exists() and (not final.is_dir() or any(final.iterdir())):
        raise InputError(
            str(path), received="a file or a folder with something in it", expected="a new or empty folder"
        )


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder beside `path` that becomes `path` when the block succeeds and disappears when it fails.

    Raises:
        InputError: `path` is a file or a folder with something in it, or lies where nothing can be written.
    """
    check_new_folder(path)
    final = Path(path)
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{final.name}.", dir=final.parent))
    except OSError as error:
        raise InputError(
            str(path),
            received=f"a place that cannot be written ({error.strerror})",
            expected="a folder in a folder of yours",
        ) from None
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o777 & ~umask)
        if final.exists():
            final.rmdir()
        os.replace(temporary, final)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


@contextmanager
def only_one(folder: str | os.PathLike[str], what: str) -> Iterator[None]:
    """No second run in the same folder at the same time, on any system; the file `.lock` in it is the lock.

    Args:
        folder: must exist.
        what: is running there, for the message: `a sweep`.

    Raises:
        InputError: another run works in the folder.
    """
    from filelock import FileLock, Timeout

    # a second thread of this process is another run, too
    lock = FileLock(Path(folder) / ".lock", timeout=0, is_singleton=False)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(
            "-o", received=f"{folder}, where {what} is running", expected="a folder that no other run works in"
        ) from None
    try:
        yield
    finally:
        lock.release()

"""One run at a time in a folder."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from ..errors import InputError


@contextlib.contextmanager
def only_one(folder: Path, what: str) -> Iterator[None]:
    """No second run in the same folder at the same time, where the system can say so.

    Args:
        folder: must exist.
        what: is running there, for the message: `a sweep`.

    Raises:
        InputError: another run works in the folder.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(folder / ".lock", "w", encoding="ascii") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                "-o", received=f"{folder}, where {what} is running", expected="a folder that no other run works in"
            ) from None
        yield

"""What a command says, kept in a file: `raytwin --log FILE COMMAND ...`, or the variable RAYTWIN_LOG."""

import contextlib
import io
import logging
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TextIO

from .errors import InputError

_FORMAT = "%(asctime)s %(process)d %(levelname)s %(name)s: %(message)s"


class _Copied(io.TextIOBase):
    """A stream that passes everything on and logs each whole line; of a line that is drawn over, its last state."""

    def __init__(self, stream: TextIO, logger: logging.Logger) -> None:
        self._stream, self._logger, self._line = stream, logger, ""

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    def writable(self) -> bool:
        return True

    def flush(self) -> None:
        self._stream.flush()

    def write(self, text: str) -> int:
        self._stream.write(text)
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            shown = line.rsplit("\r", 1)[-1].rstrip()
            if shown:
                self._logger.info("%s", shown)
        self._line = self._line.rsplit("\r", 1)[-1]
        return len(text)


def taken_out(words: Sequence[str]) -> tuple[str | None, list[str]]:
    """The file that `--log FILE` or `--log=FILE` before the command names, or RAYTWIN_LOG does, and the other words.

    Raises:
        InputError: `--log` without a file.
    """
    rest = list(words)
    if rest and rest[0].startswith("--log="):
        return rest[0].partition("=")[2], rest[1:]
    if rest and rest[0] == "--log":
        if len(rest) == 1:
            raise InputError("--log", received="nothing", expected="a file: raytwin --log FILE COMMAND")
        return rest[1], rest[2:]
    return os.environ.get("RAYTWIN_LOG") or None, rest


@contextlib.contextmanager
def kept_in(file: str | None, words: Sequence[str], *, version: str) -> Iterator[Callable[[str], None]]:
    """Within the block, what goes to standard error and what libraries log goes to the end of a file, too; gives a writer of lines.

    Args:
        file: to add to; None: nothing is kept.
        words: of the command, for the first line.
        version: of raytwin, for the first line.

    Raises:
        InputError: a file that cannot be written.
    """
    if file is None:
        yield lambda line: None
        return
    try:
        handler = logging.FileHandler(file, encoding="utf-8", delay=False)
    except OSError as error:
        raise InputError(
            "--log", received=f"{file} ({error.strerror})", expected="a file in a folder of yours"
        ) from None
    handler.setFormatter(logging.Formatter(_FORMAT))
    logger, root = logging.getLogger("raytwin"), logging.getLogger()
    level = logger.level
    root.addHandler(handler)
    logger.setLevel(logging.INFO)
    before = sys.stderr
    sys.stderr = _Copied(before, logger)
    logger.info("raytwin %s: %s", version, shlex.join(["raytwin", *words]))
    try:
        yield lambda line: logger.info("%s", line)
    finally:
        sys.stderr.flush()
        sys.stderr = before
        root.removeHandler(handler)
        handler.close()
        logger.setLevel(level)

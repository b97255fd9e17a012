"""A command in a process of its own: where a library dies at a damaged file, that is one line and exit code 2 too.

HDF5 is written in C and trusts what a file says of itself; some damaged files end the process without any error to catch, and
at some it reads on without end (`bounded`). The copy is made before anything heavy is loaded, and costs a millisecond.
"""

import itertools
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_DIED = ("SIGSEGV", "SIGBUS", "SIGABRT", "SIGFPE", "SIGILL", "SIGVTALRM")
_is_copy = False


@contextmanager
def bounded(seconds: float) -> Iterator[None]:
    """End the copy that runs a command if the block takes more processor time (s); nothing where there is no copy.

    For calls into a library that holds the interpreter: no handler in Python would be asked. A block within another counts for
    both.
    """
    if not _is_copy:
        yield
        return
    outer = signal.getitimer(signal.ITIMER_VIRTUAL)[0]
    own = min(seconds, outer) if outer > 0 else seconds
    signal.setitimer(signal.ITIMER_VIRTUAL, own)
    try:
        yield
    finally:
        left = signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)[0]
        if outer > 0:
            signal.setitimer(signal.ITIMER_VIRTUAL, max(outer - (own - left), 1e-3))


def code_of_child(words: Sequence[str]) -> int | None:
    """Go on in a copy of this process. In the copy: None. Here, once it has ended: the exit code to end with.

    None too where no copy can be made (no `fork` on this system, or several threads).
    """
    if not hasattr(os, "fork") or threading.active_count() > 1:
        return None
    start = time.time()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        global _is_copy  # noqa: PLW0603 - what this process is
        _is_copy = True
        signal.signal(signal.SIGVTALRM, signal.SIG_DFL)
        return None

    def pass_on(number: int, _: FrameType | None) -> None:
        os.kill(child, number)

    # the terminal sends an interrupt to both
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in ("SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), pass_on)
    while True:
        try:
            _, status = os.waitpid(child, 0)
            break
        except InterruptedError:
            continue
    code = os.waitstatus_to_exitcode(status)
    if code >= 0:
        return code
    _remove_halves(words, since=start)
    died = signal.Signals(-code).name
    if died not in _DIED:
        sys.stderr.write(f"raytwin {words[0]}: ended by {died}\n")
        return 1
    files = [word for word in words if _is_hdf5(word)]
    if not files:
        sys.stderr.write(f"raytwin {words[0]}: internal failure: the process died ({died})\n")
        return 1
    fails = "reads on without end" if died == "SIGVTALRM" else "itself fails"
    sys.stderr.write(
        f"raytwin {words[0]}: error: {' or '.join(files)}: got a file at which the HDF5 library {fails} ({died});"
        " expected a complete file; the file looks damaged: copy or make it again\n"
    )
    return 2


def _is_hdf5(word: str) -> bool:
    """Whether a word of the command line is an HDF5 file, or a folder with one."""
    path = Path(word)
    try:
        if path.is_dir():
            return any(_is_hdf5(str(inner)) for inner in path.iterdir() if inner.is_file())
        with path.open("rb") as stream:
            return stream.read(len(_SIGNATURE)) == _SIGNATURE
    except OSError:
        return False


def _remove_halves(words: Sequence[str], *, since: float) -> None:
    """Remove what the process that died was writing under a temporary name (see `files.whole_file`)."""
    for option, word in itertools.pairwise(words):
        if option in ("-o", "--out", "--output"):
            final = Path(word)
            for path in final.parent.glob(f".{final.name}.*.part"):
                if path.stat().st_mtime >= since - 1.0:
                    path.unlink(missing_ok=True)
            # a folder that it made and had not come to fill
            if final.is_dir() and not any(final.iterdir()) and final.stat().st_mtime >= since:
                final.rmdir()

"""Processes of their own, each for one piece of work: one that dies takes nothing along, and all end when the run is stopped."""

import contextlib
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

THREAD_VARIABLES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class StoppedError(Exception):
    """The run was stopped; nothing is recorded."""


class ChildError(RuntimeError):
    """A process failed; the message is the last line of its standard error, or says what ended it."""


class KilledError(ChildError):
    """A process was ended by a signal from outside; another one may well succeed."""


class Children:
    """Processes that run modules of this room; any number of threads may run one each."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[str]] = set()
        self._lock = threading.Lock()
        self._stopped = threading.Event()

    def run(
        self,
        module: str,
        words: Sequence[str] = (),
        *,
        given: str,
        environment: Mapping[str, str],
        folder: Path | None = None,
        timeout_s: float | None = None,
    ) -> None:
        """Run a module to its end.

        Args:
            module: of this room.
            words: its arguments.
            given: a line for its standard input, which stays open while this process lives (`_leash`).
            environment: its variables, and no others.
            folder: where it runs; None: where this process does.
            timeout_s: after which it is ended; None: never.

        Raises:
            StoppedError: the run was stopped, before or meanwhile.
            ChildError: the process failed; a KilledError: by a signal.
        """
        with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
            with self._lock:
                if self._stopped.is_set():
                    raise StoppedError
                process = subprocess.Popen(
                    [sys.executable, "-P", "-m", f"{__package__}.{module}", *words],
                    cwd=folder,
                    env=dict(environment),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=errors,
                    text=True,
                    start_new_session=True,  # a key press reaches the parent alone, which then ends its children
                )
                self._running.add(process)
            try:
                code = _wait(process, given, timeout_s=timeout_s)
            finally:
                with self._lock:
                    self._running.discard(process)
            if self._stopped.is_set():
                raise StoppedError
            if code:
                errors.seek(0)
                raise _failure(code, errors.read())

    def stop(self) -> None:
        """End every process that runs; later ones are not started."""
        with self._lock:
            self._stopped.set()
            for process in self._running:
                process.kill()


def _wait(process: "subprocess.Popen[str]", given: str, *, timeout_s: float | None) -> int:
    """Give a process its line and wait for its exit code."""
    try:
        # a child that is gone already says why by its exit code and last line
        with contextlib.suppress(BrokenPipeError):
            if process.stdin is not None:
                process.stdin.write(given + "\n")
                process.stdin.flush()
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise ChildError(f"took longer than {timeout_s:g} s") from None
    finally:
        if process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()


def _failure(code: int, errors: str) -> ChildError:
    if code < 0:
        known = {number.value: number.name for number in signal.Signals}
        return KilledError(f"ended by {known.get(-code, f'signal {-code}')}")
    lines = [line for line in errors.splitlines() if line.strip()]
    return ChildError(lines[-1].strip() if lines else f"exit code {code}")

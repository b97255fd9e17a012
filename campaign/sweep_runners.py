"""Where the tasks of a sweep are done: in processes of their own, or on a Dask cluster.

A task that fails is tried once more; one that fails twice is told as failed and does not stop the others. Tasks decide their own
randomness and threads, so that what they write does not depend on where, in which order or beside what they run.
"""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol

from ..errors import InputError, MissingDependencyError, RaytwinError
from ._children import THREAD_VARIABLES, Children, StoppedError
from .sweep_trial import Task, run_task

Done = Callable[[Task, str], None]  # the task, and why it failed (empty: it did not)

TRIES = 2
_ERROR_LETTERS = 400
INSTALL_COMMAND = "pip install 'raytwin[cluster]'"


class Runner(Protocol):
    """Does tasks; `done` is called after each, in the thread that called `run`."""

    def run(self, tasks: Sequence[Task], done: Done) -> None: ...

    def close(self) -> None: ...


class Processes:
    """In processes of their own, `workers` at once; each task has its own, so that one that dies takes nothing along."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._children = Children()

    def run(self, tasks: Sequence[Task], done: Done) -> None:
        """Do all tasks; when this is interrupted the processes are ended."""
        with ThreadPoolExecutor(max_workers=self._workers) as pool:
            waiting = {pool.submit(self._attempts, task): task for task in tasks}
            try:
                while waiting:
                    finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
                    for future in finished:
                        done(waiting.pop(future), future.result())
            except BaseException:
                for future in waiting:
                    future.cancel()
                self.close()
                raise

    def close(self) -> None:
        """End what runs; later tasks are not started."""
        self._children.stop()

    def _attempts(self, task: Task) -> str:
        return _tried(lambda: self._one(task))

    def _one(self, task: Task) -> None:
        environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(task["threads"]))
        self._children.run("sweep_trial", given=json.dumps(task), environment=environment)


class DaskCluster:
    """On the workers of a Dask cluster, which must see the same files under the same names and have the same raytwin.

    Args:
        address: of the scheduler (`tcp://host:8786`), or a scheduler file.
        timeout_s: after which an address does not answer, and a cluster has no workers.

    Raises:
        MissingDependencyError: dask.distributed is not installed.
        InputError: the address does not answer, or has no workers.
    """

    def __init__(self, address: str, *, timeout_s: float = 15.0) -> None:
        distributed = _distributed()
        scheduler = {"scheduler_file": address} if Path(address).is_file() else {"address": address}
        try:
            self._client = distributed.Client(**scheduler, timeout=timeout_s, set_as_default=False)
        except (OSError, TimeoutError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                "--scheduler",
                received=f"{address}, which does not answer ({_line(error) or type(error).__name__})",
                expected="the address of a running Dask scheduler, for example tcp://host:8786, or its scheduler file",
                remedy="start one with `dask scheduler` and workers with `dask worker ADDRESS --nthreads 1`",
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=timeout_s)
        except TimeoutError:
            self.close()
            raise InputError(
                "--scheduler",
                received=f"{address}, a scheduler without workers",
                expected="one worker or more",
                remedy=f"start some with `dask worker {address} --nthreads 1`",
            ) from None

    def check(self, marker: Path, *, version: str) -> None:
        """Whether every worker sees the file `marker` and has this version of raytwin.

        Raises:
            InputError: one that does not.
        """
        for worker, (own, sees) in self._client.run(_look_round, str(marker)).items():
            if own != version:
                raise InputError(
                    "--scheduler", received=f"worker {worker} with raytwin {own}", expected=f"raytwin {version}"
                )
            if not sees:
                raise InputError(
                    "--scheduler",
                    received=f"worker {worker}, which does not see {marker}",
                    expected="workers that see the sweep's folder and files under the same names",
                    remedy="put them on a file system that all machines share",
                )

    def run(self, tasks: Sequence[Task], done: Done) -> None:
        """Do all tasks; when this is interrupted those that wait are taken back.

        Raises:
            RaytwinError: the scheduler went away.
        """
        distributed = _distributed()
        waiting = {self._submit(task, 1): (task, 1) for task in tasks}
        finished = distributed.as_completed(list(waiting), loop=self._client.loop, raise_errors=False)
        try:
            for future in finished:
                task, attempt = waiting.pop(future)
                if future.status == "finished":
                    done(task, "")
                elif self._client.status != "running":
                    raise RaytwinError(
                        "the Dask scheduler went away; what is finished is kept, and the same command goes on"
                    )
                elif attempt < TRIES:
                    again = self._submit(task, attempt + 1)
                    waiting[again] = (task, attempt + 1)
                    finished.add(again)
                else:
                    error = future.exception() if future.status == "error" else None
                    done(task, f"failed {TRIES} times: {_line(error) if error else f'the task was {future.status}'}")
                future.release()
        except BaseException:
            if self._client.status == "running":
                self._client.cancel(list(waiting), force=True)
            raise

    def close(self) -> None:
        """Leave the cluster; it goes on without us."""
        self._client.close()

    def _submit(self, task: Task, attempt: int) -> Any:
        name = f"raytwin-sweep-{Path(task['folder']).name}-{attempt}-{os.getpid()}"
        return self._client.submit(_on_worker, task, key=name, pure=False)


def _on_worker(task: Task) -> None:
    """Do a task on a worker; an error goes home as plain words, which survive the way."""
    try:
        run_task(task)
    except Exception as error:
        raise RuntimeError(_line(error)) from None


def _look_round(marker: str) -> tuple[str, bool]:
    from .. import __version__

    return __version__, Path(marker).is_file()


def _tried(work: Callable[[], None]) -> str:
    """Why work failed, each time it was tried; nothing where it did not."""
    error: Exception | None = None
    for _ in range(TRIES):
        try:
            work()
        except (StoppedError, MissingDependencyError):
            raise
        except Exception as failure:
            error = failure
        else:
            return ""
    return f"failed {TRIES} times: {_line(error)}"


def _line(error: BaseException | None) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    if not isinstance(error, RaytwinError | RuntimeError | OSError):
        text = f"{type(error).__name__}: {text}"
    return text[:_ERROR_LETTERS]


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise MissingDependencyError(
            f"--scheduler needs dask.distributed, which cannot be imported ({error}); install it with"
            f" `{INSTALL_COMMAND}`"
        ) from None
    return distributed

"""Networks of one recipe as one job: several processes of one thread each share the networks of a folder.

On two cores the small networks of a campaign wait longer for a second thread than it saves, so that a process a core is
faster than threads. The weights depend on a network's number and on the threads of its process, not on how many processes
there are or which of them trained it.
"""

import dataclasses
import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, RaytwinError
from ..files import only_one
from ._children import THREAD_VARIABLES, ChildError, Children
from ._leash import line_from_parent

if TYPE_CHECKING:
    from ..acquisition.dataset_io import Dataset
    from ..segmentation import EpochResult, NetworkResult, Recipe

    Progress = Callable[[int, int, int, EpochResult | None], None]

_LOOK_EVERY_S = 0.5


def train_together(
    dataset: "Dataset",
    folder: "str | os.PathLike[str]",
    *,
    recipe: "Recipe",
    networks: int,
    workers: int,
    seed: int = 0,
    device: str = "cpu",
    start_from: "str | os.PathLike[str] | None" = None,
    threads: int = 1,
    progress: "Progress | None" = None,
    warn: Callable[[str], None] | None = None,
) -> "list[NetworkResult]":
    """Train networks 0 .. networks - 1 of a folder in several processes; finished ones are kept, unfinished ones go on.

    The same arguments give the same weights, to the byte, for any number of workers.

    Args:
        dataset: open dataset file with training images.
        folder: of the networks, new or of the same configuration.
        recipe, networks, seed, device, start_from: as for `train_networks`.
        workers: processes at once; 1 trains in this process.
        threads: processor threads of each process.
        progress: called as by `train_networks`; with several workers only when a network is finished.
        warn: called with what the user should know.

    Returns:
        Records of networks 0 .. networks - 1.

    Raises:
        InputError: fewer than one worker, or what `train_networks` refuses.
        RaytwinError: a process failed; what was trained is kept, and the same call goes on.

    Example:
        >>> from raytwin.acquisition import read_dataset
        >>> from raytwin.segmentation import starter_recipe
        >>> with read_dataset("references.h5") as dataset:  # doctest: +SKIP
        ...     train_together(dataset, "networks", recipe=starter_recipe(), networks=10, workers=2, start_from="starter")
    """
    from ..segmentation import finished_networks, open_runs, train_networks
    from ..segmentation._torch import load_torch
    from ..segmentation.runs_io import gone_unless_begun

    for name, value in (("workers", workers), ("threads", threads)):
        if value < 1:
            raise InputError(name, received=value, expected="a whole number, 1 or more")
    words: dict[str, Any] = {
        "recipe": recipe,
        "networks": networks,
        "seed": seed,
        "device": device,
        "start_from": start_from,
    }
    if workers == 1:
        load_torch().set_num_threads(threads)
        return train_networks(dataset, folder, **words, progress=progress, warn=warn)
    with gone_unless_begun(folder):
        # what is wrong with folder, data or start shows here, before any process is started
        train_networks(dataset, folder, **words, only=(), warn=warn)
        runs = open_runs(folder)
        done = set(finished_networks(runs))
        left = [number for number in range(networks) if number not in done]
        hands = [left[place::workers] for place in range(min(workers, len(left)))]
        task = {
            **words,
            "recipe": dataclasses.asdict(recipe),
            "dataset": str(Path(dataset.path).resolve()),
            "folder": str(Path(folder).resolve()),
            "start_from": None if start_from is None else str(start_from),
            "threads": threads,
        }
        environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(threads))

        def told() -> None:
            from ..segmentation import read_result

            if progress is None:
                return
            for number in sorted(set(finished_networks(runs)) - done):
                done.add(number)
                history = read_result(runs, number).history
                progress(number, len(history), len(history), history[-1])

        children = Children()
        with only_one(runs.path, "a training"), ThreadPoolExecutor(max_workers=max(1, len(hands))) as pool:
            running: list[Future[None]] = [
                pool.submit(
                    children.run, "ensemble", given=json.dumps({**task, "only": numbers}), environment=environment
                )
                for numbers in hands
            ]
            try:
                waiting = set(running)
                while waiting:
                    finished, waiting = wait(waiting, timeout=_LOOK_EVERY_S)
                    for future in finished:
                        future.result()
                    told()
            except BaseException as error:
                children.stop()
                if isinstance(error, ChildError):
                    raise RaytwinError(
                        f"a process that trained networks in {folder} failed: {error}; what is trained is kept,"
                        " and the same call goes on"
                    ) from None
                raise
            return train_networks(dataset, folder, **words, only=range(networks))


def main() -> int:
    """Train the networks that the first line of standard input names; a failure is the last line of standard error."""
    from ..acquisition.dataset_io import read_dataset
    from ..segmentation import train_networks
    from ..segmentation._torch import load_torch
    from ..segmentation.recipe import recipe_from_mapping

    task = json.loads(line_from_parent())
    try:
        load_torch().set_num_threads(task["threads"])
        with read_dataset(task["dataset"]) as dataset:
            train_networks(
                dataset,
                task["folder"],
                recipe=recipe_from_mapping(task["recipe"]),
                networks=task["networks"],
                seed=task["seed"],
                device=task["device"],
                start_from=task["start_from"],
                only=task["only"],
            )
    except RaytwinError as error:
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

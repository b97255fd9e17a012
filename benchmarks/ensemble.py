"""Ten networks of one recipe against one: processes of one thread each, and all in one batched step (torch.func.vmap).

The starter's network on the same stored images, each way in the same run: one network; ten in two processes, as
`raytwin train --workers 2` trains them; one batched step of ten against a step of one. Ratios of seconds by the clock, and
of processor seconds, which other work on the machine disturbs less. With w idle cores the clock's ratio is the processor's
over w. On a GPU (`--device cuda`) the processes share it, and the batched step is left out.

    OMP_NUM_THREADS=1 python benchmarks/ensemble.py [--networks 10] [--workers 2] [--steps 60] [--device cuda]
"""

import argparse
import dataclasses
import json
import math
import resource
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from training_step import BATCH, SHAPE, images_and_masks

from raytwin.acquisition import DatasetRow, read_dataset, write_dataset
from raytwin.campaign.ensemble import train_together
from raytwin.segmentation import Recipe, build_network, cross_entropy_and_dice, starter_recipe


def seconds_of(work: Callable[[], object]) -> dict[str, float]:
    """Seconds by the clock and of the processor, children included."""

    def spent() -> float:
        own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime

    clock, processor = time.perf_counter(), spent()
    work()
    return {"clock": time.perf_counter() - clock, "processor": spent() - processor}


def write_images(path: Path, *, n: int) -> None:
    """A dataset file of `n` pairs to learn from and a few to validate with."""
    images, masks = images_and_masks(n + BATCH)
    with write_dataset(path, shape=SHAPE) as writer:
        for number in range(len(images)):
            writer.append(
                image=images[number],
                foreign_object_mask=masks[number],
                product_mask=np.ones(SHAPE, dtype=np.uint8),
                row=DatasetRow(
                    image=f"i{number}",
                    product=f"p{number}",
                    foreign_object="block",
                    size_mm=2.0,
                    contrast=math.nan,
                    split="train" if number < n else "val",
                    setting="low;high",
                ),
            )


def batched_step(recipe: Recipe, networks: int, *, steps: int) -> tuple[dict[str, float], dict[str, float]]:
    """Seconds of `steps` steps of one network, and of `networks` networks whose weights are stacked."""
    import torch
    from torch.func import functional_call, stack_module_state, vmap

    images, masks = images_and_masks(BATCH)
    x = torch.from_numpy(images)
    y = torch.from_numpy(masks)[:, None].float()
    modules = [build_network(recipe, seed=number) for number in range(networks)]
    one = modules[0].train()
    parameters, buffers = stack_module_state(modules)
    stacked = {name: value.detach().requires_grad_() for name, value in parameters.items()}

    def single() -> object:
        return cross_entropy_and_dice(one(x.to(memory_format=torch.channels_last)), y)

    def together() -> object:
        def of_one(weights: object, state: object, batch: object) -> object:
            return functional_call(one, (weights, state), (batch,))

        several = vmap(of_one, in_dims=(0, 0, None), randomness="different")(stacked, buffers, x)
        return cross_entropy_and_dice(several.flatten(0, 1), y.repeat(networks, 1, 1, 1)) * networks

    def stepped(loss_of: Callable[[], object], weights: list[object]) -> Callable[[], None]:
        optimizer = torch.optim.AdamW(weights, lr=1e-4)

        def work() -> None:
            for _ in range(steps):
                optimizer.zero_grad()
                loss_of().backward()
                optimizer.step()

        work()  # warms up
        return work

    return (
        seconds_of(stepped(single, list(one.parameters()))),
        seconds_of(stepped(together, list(stacked.values()))),
    )


def main() -> None:
    """Print seconds and ratios as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--networks", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    recipe = dataclasses.replace(starter_recipe(), batch=BATCH, steps=given.steps)
    found: dict[str, list[dict[str, float]]] = {"one": [], "processes": [], "one_step": [], "batched_step": []}
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "images.h5"
        write_images(images, n=BATCH * 6)
        with read_dataset(images) as dataset:

            def train(name: str, networks: int, workers: int) -> dict[str, float]:
                return seconds_of(
                    lambda: train_together(
                        dataset,
                        Path(folder) / name,
                        recipe=recipe,
                        networks=networks,
                        workers=workers,
                        start_from="starter",
                        device=given.device,
                    )
                )

            train("warm", 1, 1)
            for turn in range(given.turns):
                found["one"].append(train(f"one_{turn}", 1, 1))
                found["processes"].append(train(f"processes_{turn}", given.networks, given.workers))
                if given.device == "cpu":
                    one, several = batched_step(recipe, given.networks, steps=3)
                    found["one_step"].append(one)
                    found["batched_step"].append(several)

    def ratio(much: str, little: str, kind: str) -> float:
        return round(sum(item[kind] for item in found[much]) / sum(item[kind] for item in found[little]), 2)

    kinds = ("clock", "processor")
    answer = {
        "networks": given.networks,
        "workers": given.workers,
        "seconds": {
            name: [{kind: round(one[kind], 2) for kind in kinds} for one in rows] for name, rows in found.items()
        },
        "processes_over_one": {kind: ratio("processes", "one", kind) for kind in kinds},
        "batched_over_one": {kind: ratio("batched_step", "one_step", kind) for kind in kinds}
        if found["one_step"]
        else None,
    }
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main()

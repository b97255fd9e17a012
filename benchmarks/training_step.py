"""A training step of raytwin against a plain loop of segmentation-models-pytorch and a DataLoader on the same device.

Same network, batch and stored images; the two take turns, so that both see the same load of the machine. Ratios above 1 mean
that raytwin's step is faster. The second line is the starter's network against the plain loop with DeepLabV3Plus. Seconds are
the processor's; on a GPU those of the clock, read when the device has finished, and of the second pass: during the first one
raytwin's step is recorded. There each pass of the plain loop begins with a new network, whose first steps are slower.

    python benchmarks/training_step.py [--steps 6] [--turns 3] [--device cuda]
"""

import argparse
import dataclasses
import json
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from raytwin.segmentation import RECIPES, Recipe, build_network, examples_from_arrays, starter_recipe
from raytwin.segmentation.training import _train_epoch
from raytwin.segmentation.training_step import TrainingStep

SHAPE = (96, 128)
BATCH = 8
SCALING = "matched:45"  # any direction costs the same


def images_and_masks(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Slabs with noise and a block in each."""
    rng = np.random.default_rng(1)
    images = np.stack([np.full((n, *SHAPE), 1.0), np.full((n, *SHAPE), 0.5)], axis=1)
    images += 0.02 * rng.standard_normal(images.shape)
    masks = np.zeros((n, *SHAPE), dtype=np.uint8)
    masks[:, 40:46, 60:68] = 1
    images[:, 0] += 0.3 * masks
    return images.astype(np.float32), masks


def clock_of(device: str) -> Callable[[], float]:
    """Seconds of the processor, or on a GPU of the clock once all that was asked of the device is done."""
    if device == "cpu":
        return time.process_time
    import torch

    def wall() -> float:
        torch.cuda.synchronize()
        return time.perf_counter()

    return wall


def plain_seconds(images: np.ndarray, masks: np.ndarray, device: str) -> float:
    """Seconds a step of the loop that a user would write."""
    import segmentation_models_pytorch as models
    import torch

    network = models.DeepLabV3Plus("efficientnet-b0", encoder_weights=None, in_channels=2, classes=1).to(device)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    loss_function = models.losses.DiceLoss("binary", from_logits=True)
    data = torch.utils.data.TensorDataset(torch.from_numpy(images), torch.from_numpy(masks)[:, None].float())
    loader = torch.utils.data.DataLoader(data, batch_size=BATCH, shuffle=True)
    network.train()
    clock = clock_of(device)
    started = clock()
    for batch, target in loader:
        loss = loss_function(network(batch.to(device)), target.to(device))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return (clock() - started) / len(loader)


def raytwin_seconds(images: np.ndarray, masks: np.ndarray, recipe: Recipe, device: str) -> float:
    """Seconds a step of raytwin's loop, scaling and augmentation included."""
    examples = examples_from_arrays(images, masks, recipe=recipe)
    step = TrainingStep(build_network(recipe, seed=1).to(device), recipe=recipe, device=device)
    steps = len(images) // BATCH
    rng = np.random.default_rng(1)
    if device != "cpu":
        _train_epoch(step, examples, recipe=recipe, generator=rng, first_step=0, steps=steps)
    clock = clock_of(device)
    started = clock()
    _train_epoch(step, examples, recipe=recipe, generator=rng, first_step=0, steps=steps)
    return (clock() - started) / steps


def main() -> None:
    """Print seconds and ratios as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    images, masks = images_and_masks(BATCH * given.steps)
    device = given.device
    networks = {
        "same_network": dataclasses.replace(RECIPES["raytwin"], scaling=SCALING),
        "starter_network": dataclasses.replace(starter_recipe(), scaling=SCALING, batch=BATCH),
    }
    work: dict[str, Callable[[], float]] = {"plain": partial(plain_seconds, images, masks, device)}
    for name, recipe in networks.items():
        work[name] = partial(raytwin_seconds, images, masks, recipe, device)
    found: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(given.turns + 1):
        for name, one in work.items():
            seconds = one()
            if turn:  # the first turn warms up
                found[name].append(seconds)
    median = {name: float(np.median(values)) for name, values in found.items()}
    answer: dict[str, Any] = {
        "seconds_of": "the processor" if device == "cpu" else "the clock",
        "seconds_a_step": median,
        "plain_over_raytwin": {name: median["plain"] / value for name, value in median.items() if name != "plain"},
    }
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main()

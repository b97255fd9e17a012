"""A training step of raytwin against a plain loop of segmentation-models-pytorch and a DataLoader, in processor time.

Same network, batch and stored images; the two take turns, so that both see the same load of the machine. Ratios above 1 mean
that raytwin's step is faster. The second line is the starter's network against the plain loop with DeepLabV3Plus.

    python benchmarks/training_step.py [--steps 6] [--turns 3]
"""

import argparse
import dataclasses
import json
import time
import warnings

import numpy as np

from raytwin.segmentation import RECIPES, Recipe, build_network, examples_from_arrays, starter_recipe
from raytwin.segmentation.training import _train_epoch

SHAPE = (96, 128)
BATCH = 8


def images_and_masks(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Slabs with noise and a block in each."""
    rng = np.random.default_rng(1)
    images = np.stack([np.full((n, *SHAPE), 1.0), np.full((n, *SHAPE), 0.5)], axis=1)
    images += 0.02 * rng.standard_normal(images.shape)
    masks = np.zeros((n, *SHAPE), dtype=np.uint8)
    masks[:, 40:46, 60:68] = 1
    images[:, 0] += 0.3 * masks
    return images.astype(np.float32), masks


def plain_seconds(images: np.ndarray, masks: np.ndarray) -> float:
    """Processor seconds a step of the loop that a user would write."""
    import segmentation_models_pytorch as models
    import torch

    network = models.DeepLabV3Plus("efficientnet-b0", encoder_weights=None, in_channels=2, classes=1)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    loss_function = models.losses.DiceLoss("binary", from_logits=True)
    data = torch.utils.data.TensorDataset(torch.from_numpy(images), torch.from_numpy(masks)[:, None].float())
    loader = torch.utils.data.DataLoader(data, batch_size=BATCH, shuffle=True)
    network.train()
    started = time.process_time()
    for batch, target in loader:
        loss = loss_function(network(batch), target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return (time.process_time() - started) / len(loader)


def raytwin_seconds(images: np.ndarray, masks: np.ndarray, recipe: Recipe) -> float:
    """Processor seconds a step of raytwin's loop, scaling and augmentation included."""
    import torch

    examples = examples_from_arrays(images, masks, recipe=recipe)
    network = build_network(recipe, seed=1)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    steps = len(images) // BATCH
    started = time.process_time()
    _train_epoch(
        network,
        optimizer,
        examples,
        recipe=recipe,
        generator=np.random.default_rng(1),
        device="cpu",
        first_step=0,
        steps=steps,
    )
    return (time.process_time() - started) / steps


def main() -> None:
    """Print seconds and ratios as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--turns", type=int, default=3)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    images, masks = images_and_masks(BATCH * given.steps)
    paper = RECIPES["raytwin"]
    starter = dataclasses.replace(starter_recipe(), batch=BATCH)
    found: dict[str, list[float]] = {"plain": [], "same_network": [], "starter_network": []}
    for turn in range(given.turns + 1):
        seconds = {
            "plain": plain_seconds(images, masks),
            "same_network": raytwin_seconds(images, masks, paper),
            "starter_network": raytwin_seconds(images, masks, starter),
        }
        if turn:  # the first turn warms up
            for name, value in seconds.items():
                found[name].append(value)
    median = {name: float(np.median(values)) for name, values in found.items()}
    ratios = {name: median["plain"] / median[name] for name in ("same_network", "starter_network")}
    print(json.dumps({"cpu_seconds_a_step": median, "plain_over_raytwin": ratios}, indent=1))


if __name__ == "__main__":
    main()

"""Classifiers that are told to separate two kinds of image patches, and how well they do on objects they have not seen.

Two of them: logistic regression on statistics of a patch and their products, and a small convolutional network. Both
see a patch of both channels (low and high kV) of log images.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Patches = NDArray[np.float32]


def auc(first: Array, second: Array) -> float:
    """Probability that a score of `second` lies above one of `first`, ties counted half."""
    scores = np.concatenate([first, second])
    order = scores.argsort(kind="stable")
    ranks = np.empty(scores.size)
    ranks[order] = np.arange(1, scores.size + 1)
    values, inverse, counts = np.unique(scores, return_inverse=True, return_counts=True)
    if values.size < scores.size:
        ranks = (np.bincount(inverse, weights=ranks) / counts)[inverse]
    above = ranks[first.size :].sum() - second.size * (second.size + 1) / 2.0
    return float(above / (first.size * second.size))


def patches_of(images: NDArray[np.floating], size: int, step: int) -> Patches:
    """Patches (image, place, channel, size, size) of images (image, channel, row, column), on a grid."""
    rows, columns = images.shape[-2:]
    places = [(y, x) for y in range(0, rows - size + 1, step) for x in range(0, columns - size + 1, step)]
    cut = [images[..., y : y + size, x : x + size] for y, x in places]
    return np.stack(cut, axis=1).astype(np.float32)


def statistics_of(patches: Patches) -> Array:
    """Statistics (patch, feature) of patches (patch, channel, size, size)."""
    n, channels, size, _ = patches.shape
    line = np.linspace(-1, 1, size)
    plane = np.stack([np.ones((size, size)), *np.broadcast_arrays(line[:, None], line[None, :])]).reshape(3, -1)
    projector = np.linalg.pinv(plane.T)
    features: list[Array] = []
    rest_of = []
    for channel in range(channels):
        values = patches[:, channel].reshape(n, -1).astype(np.float64)
        fit = values @ projector.T
        rest = (values - fit @ plane).reshape(n, size, size)
        rest_of.append(rest)
        variance = np.maximum((rest**2).mean(axis=(1, 2)), 1e-12)
        features += [fit[:, 0], np.log(variance)]
        for dy, dx in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (2, 2)):
            product = rest[:, dy:, dx:] * rest[:, : size - dy, : size - dx]
            features.append(product.mean(axis=(1, 2)) / variance)
        features.append(np.clip((rest**3).mean(axis=(1, 2)) / variance**1.5, -5, 5))
        features.append(np.log((rest**4).mean(axis=(1, 2)) / variance**2))
        features.append((rest.max(axis=(1, 2)) - rest.min(axis=(1, 2))) / np.sqrt(variance))
        # noise without structure: what second differences leave
        second = rest[:, 2:, :] - 2 * rest[:, 1:-1, :] + rest[:, :-2, :]
        features.append(np.log(np.maximum(np.median(np.abs(second), axis=(1, 2)), 1e-9)))
    if channels == 2:
        product = (rest_of[0] * rest_of[1]).mean(axis=(1, 2))
        features.append(product / np.sqrt((rest_of[0] ** 2).mean(axis=(1, 2)) * (rest_of[1] ** 2).mean(axis=(1, 2))))
    return np.stack(features, axis=1)


def logistic_scores(
    train: tuple[Array, Array], test: tuple[Array, Array], *, ridge: float = 30.0
) -> tuple[Array, Array]:
    """Scores of the two kinds of test patches by logistic regression on statistics and their products."""

    def expand(values: Array) -> Array:
        row, column = np.triu_indices(values.shape[1])
        return np.concatenate([values, values[:, row] * values[:, column]], axis=1)

    whole = np.concatenate(train)
    middle, scale = whole.mean(axis=0), whole.std(axis=0) + 1e-12
    design = expand(np.clip((whole - middle) / scale, -4, 4))
    centre, width = design.mean(axis=0), design.std(axis=0) + 1e-12
    design = np.concatenate([np.ones((len(design), 1)), (design - centre) / width], axis=1)
    label = np.concatenate([np.zeros(len(train[0])), np.ones(len(train[1]))])
    weights = np.zeros(design.shape[1])
    penalty = ridge * np.eye(design.shape[1])
    penalty[0, 0] = 0.0
    for _ in range(12):
        chance = 1.0 / (1.0 + np.exp(-np.clip(design @ weights, -30, 30)))
        slope = chance * (1 - chance) + 1e-6
        gradient = design.T @ (label - chance) - penalty @ weights
        step = np.linalg.solve((design * slope[:, None]).T @ design + penalty, gradient)
        weights += step
        if np.abs(step).max() < 1e-6:
            break

    def score(values: Array) -> Array:
        wide = (expand(np.clip((values - middle) / scale, -4, 4)) - centre) / width
        return np.asarray(wide @ weights[1:])

    return score(test[0]), score(test[1])


def _layers_of(patches: Patches) -> Patches:
    """What a network sees (patch, layer, size, size): log images, their fine detail over its rms, and that rms."""
    from scipy.ndimage import uniform_filter

    detail = patches - uniform_filter(patches, (0, 0, 5, 5), mode="nearest")
    rms = np.sqrt((detail**2).mean(axis=(2, 3), keepdims=True)) + 1e-9
    return np.concatenate([patches, detail / rms, np.log(rms) + 0.0 * patches], axis=1).astype(np.float32)


def network_scores(
    train: tuple[Patches, Patches],
    test: tuple[Patches, Patches],
    *,
    epochs: int,
    seed: int,
    detail: bool = True,
    device: str = "cpu",
) -> tuple[Array, Array]:
    """Scores of the two kinds of test patches (patch, channel, size, size) by a small convolutional network.

    With `detail` it sees, besides the log images, their fine detail over its rms, and that rms; without, the log images alone,
    in which it finds the relation of both channels more easily and noise hardly.
    """
    import torch
    from torch import nn

    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    see = _layers_of if detail else np.asarray
    whole = see(np.concatenate(train))
    middle, scale = whole.mean(axis=(0, 2, 3), keepdims=True), whole.std(axis=(0, 2, 3), keepdims=True) + 1e-6
    label = np.concatenate([np.zeros(len(train[0])), np.ones(len(train[1]))]).astype(np.float32)
    size = whole.shape[-1]
    layers: list[nn.Module] = [nn.Conv2d(whole.shape[1], 16, 3, padding=1), nn.ReLU()]
    if size > 32:
        layers.append(nn.AvgPool2d(2))
    layers += [nn.Conv2d(16, 16, 3, padding=1), nn.ReLU(), nn.AvgPool2d(2), nn.Conv2d(16, 32, 3, padding=1), nn.ReLU()]
    layers += [nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(32, 1)]
    network = nn.Sequential(*layers).to(device)
    batch = 64 if size <= 32 else 16
    steps = epochs * (len(whole) // batch)
    optimiser = torch.optim.Adam(network.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=4e-3, total_steps=max(steps, 1))
    loss_of = nn.BCEWithLogitsLoss()
    for _ in range(epochs):
        order = rng.permutation(len(whole))
        for start in range(0, len(whole) - batch + 1, batch):
            chosen = order[start : start + batch]
            values = (whole[chosen] - middle) / scale
            if rng.random() < 0.5:
                values = values[..., ::-1]
            if rng.random() < 0.5:
                values = values[..., ::-1, :]
            images = torch.from_numpy(np.ascontiguousarray(values)).to(device)
            loss = loss_of(network(images)[:, 0], torch.from_numpy(label[chosen]).to(device))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    network.eval()

    def score(values: Patches) -> Array:
        found = []
        with torch.no_grad():
            for start in range(0, len(values), 256):
                piece = np.ascontiguousarray((see(values[start : start + 256]) - middle) / scale)
                found.append(network(torch.from_numpy(piece).to(device))[:, 0].cpu().numpy())
        return np.concatenate(found).astype(np.float64)

    return score(test[0]), score(test[1])

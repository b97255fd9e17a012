"""Networks trained on one dataset file and tried on another: the steps that every POD trial of a campaign shares.

What a step writes appears whole or not at all; where its file is there already, the step is not done again.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.dataset_io import Dataset, read_dataset, write_dataset
from ..errors import FitError
from ..files import whole_file

if TYPE_CHECKING:
    import os

    from ..segmentation import EpochResult, Recipe

_FEWEST_TO_TRY = 5  # objects
LOWEST_THRESHOLD = 0.01  # probability above which pixels are marked: what a network is less sure of it does not see
_AT_ONCE = 8  # images through a network
_NEAR_PX = 3  # a mark this close to an object belongs to it


def scene_of(image: str) -> str:
    """The scene of an image: `product1#2` is the second image of `product1`."""
    return image.partition("#")[0]


def write_split(whole: Path, path: Path, part: str, *, name_of: Callable[[str], str] | None = None) -> None:
    """All images of a file as split test, or as train and val, under other names where `name_of` gives them."""
    with (
        read_dataset(whole) as dataset,
        write_dataset(path, shape=dataset.shape, provenance=dict(dataset.attributes)) as writer,
    ):
        for number, row in enumerate(dataset.rows):
            split = part if part == "test" else ("val" if row.split == "val" else "train")
            writer.append(
                image=dataset.images(number),
                foreign_object_mask=dataset.foreign_object_masks(number),
                product_mask=dataset.product_masks(number),
                row=replace(row, split=split, image=row.image if name_of is None else name_of(row.image)),
            )
    whole.unlink()


def train_on_file(
    path: Path,
    folder: Path,
    *,
    recipe: "Recipe",
    networks: int,
    seed: int,
    start_from: "str | os.PathLike[str] | None" = None,
    device: str = "cpu",
    workers: int | None = None,
    tell: Callable[[str], None] = lambda line: None,
    name: str = "networks",
) -> None:
    """Train `networks` networks on a dataset file; a folder that is not finished is gone on with.

    Args:
        path: dataset with images of split train (and val).
        folder: of the networks.
        recipe, networks, seed, start_from, device: as `train_networks` has them.
        workers: processes of one thread each that share the networks (`ensemble`); None: this process, with its threads.
        tell: shows one line of progress.
        name: what the lines call these networks.
    """
    from ..segmentation import say_who_is_blind, train_networks
    from .ensemble import train_together

    def progress(network: int, done: int, wanted: int, result: "EpochResult | None") -> None:
        tell(f"{name}: network {network + 1}, epoch {done} of {wanted}")

    with read_dataset(path) as dataset:
        words: dict[str, Any] = {
            "recipe": recipe,
            "networks": networks,
            "seed": seed,
            "device": device,
            "start_from": start_from,
            "progress": progress,
        }
        if workers is None:
            found = train_networks(dataset, folder, **words)
        else:
            found = train_together(dataset, folder, workers=workers, **words)
    blind = say_who_is_blind(found)
    if blind:
        tell(f"{name}: {blind}")


def thresholds_from_images(
    runs_path: Path,
    learnt_from: Path,
    out: Path,
    share: float,
    *,
    device: str,
    numbers: Sequence[int] | None = None,
    lowest: float = LOWEST_THRESHOLD,
) -> dict[int, float]:
    """Probability above which each network's pixels are marked, by network.

    Networks that learnt little differ in how readily they mark. Each gets the threshold at which `share` of the images that
    it learnt from show a mark away from objects: something its owner knows, whatever images it is tried on later.

    Args:
        runs_path: of the networks.
        learnt_from: dataset file.
        out: JSON file of the thresholds; where it is there already, it is read.
        share: of the images, 0 to 1.
        device: torch device.
        numbers: of other images of the file to take in place of those of split train and val.
        lowest: threshold; with 0 the share is met by networks that hardly mark anything, too.

    Returns:
        Network number -> threshold, `lowest` or more and below 1.
    """
    from scipy.ndimage import binary_dilation

    from ..segmentation import build_network, examples_from_dataset, finished_networks, open_runs, read_weights
    from ..segmentation.network import probabilities_from_scaled

    if out.exists():
        return {int(number): float(value) for number, value in json.loads(out.read_text(encoding="utf-8")).items()}
    runs = open_runs(runs_path)
    found: dict[int, float] = {}
    with read_dataset(learnt_from) as dataset:
        if numbers is None:
            numbers = [number for number, row in enumerate(dataset.rows) if row.split in ("train", "val")]
        examples = examples_from_dataset(dataset, numbers, recipe=runs.recipe)  # scaled once for all networks
        for network_number in finished_networks(runs):
            _, weights = read_weights(runs.path / f"network_{network_number:03d}" / "weights.pt")
            network = build_network(runs.recipe, seed=0, pretrained=False)
            network.load_state_dict(weights)
            network = network.to(device)
            highest = []
            for first in range(0, len(numbers), _AT_ONCE):
                pairs = [examples[place] for place in range(first, min(first + _AT_ONCE, len(numbers)))]
                scaled = np.stack([image for image, _ in pairs])
                maps = probabilities_from_scaled(network, scaled, recipe=runs.recipe, device=device)
                for values, mask in zip(maps, (masks[-1] != 0 for _, masks in pairs), strict=True):
                    away = (
                        ~binary_dilation(mask, iterations=_NEAR_PX) if mask.any() else np.ones(mask.shape, dtype=bool)
                    )
                    highest.append(float(values[away].max()) if away.any() else 0.0)
            found[network_number] = float(np.clip(np.quantile(highest, 1.0 - share), lowest, 1.0 - 1e-6))
    with whole_file(out) as temporary:
        temporary.write_text(json.dumps(found) + "\n", encoding="utf-8")
    return found


def detect_on_file(
    runs_path: Path,
    dataset_path: Path,
    out: Path,
    contrast: Mapping[str, float],
    thresholds: Mapping[int, float],
    *,
    device: str,
    numbers: Sequence[int] | None = None,
) -> None:
    """Hit table of all networks on the images of split test, or of these numbers; images of one scene share its name."""
    from ..segmentation import Detection, detect_with_networks, open_runs, write_detections

    if out.exists():
        return

    def rows(dataset: Dataset, numbers: NDArray[np.intp]) -> Iterator[Detection]:
        runs = open_runs(runs_path)
        for found in detect_with_networks(
            runs, dataset, numbers, networks=list(thresholds), threshold=thresholds, device=device
        ):
            scene = scene_of(found.image)
            value = contrast.get(scene, found.contrast)
            known = value is not None and math.isfinite(value) and found.recall is not None
            yield replace(found, image=scene, contrast=value if known else None)

    with read_dataset(dataset_path) as dataset:
        chosen = dataset.indices(split="test") if numbers is None else np.asarray(numbers, dtype=np.intp)
        write_detections(out, rows(dataset, chosen))


def curve_of_table(
    table_path: Path, size: str, *, link: str = "cloglog", log_size: bool = False, method: str = "auto"
) -> dict[str, Any]:
    """What an answer says of a hit table: counts, a90 with its bounds, the curve; null where the data support none.

    `a90_95_interval` is two-sided, `a90_95` the upper bound that a90 is below with 95 %; each by the modified likelihood
    ratio where there is one, else by the likelihood ratio. Networks and images are crossed random effects.

    Args:
        table_path: hit table with columns network and image.
        size: its column of sizes.
        link, log_size, method: see `pod.fit_pod`.
    """
    from ..pod import curve_rows, false_alarm_rate, fit_pod, read_pod_table
    from ..pod.hit_miss import trusted_bound

    table = read_pod_table(table_path, size=size)
    objects = len(set(table.image or ()))
    alarms = None
    if len(table.false_alarm):
        alarms = asdict(
            false_alarm_rate(table.false_alarm, network=table.false_alarm_network, image=table.false_alarm_image)
        )
    told: dict[str, Any] = {
        "n": len(table.size),
        "n_hits": 0 if table.hits is None else int(table.hits.sum()),
        "objects": objects,
        "a50": None,
        "a90": None,
        "a90_95_interval": {"low": None, "high": None},
        "a90_95": None,
        "false_alarms": alarms,
        "points": _hits_by_size(table.size, table.hits),
        "line": None,
        "table": table_path.name,
        "warnings": [],
    }
    if objects < _FEWEST_TO_TRY or table.hits is None:
        told["warnings"] = [f"{objects} foreign objects of known {size}: too few for a curve"]
        return told
    try:
        fit = fit_pod(
            table.size,
            table.hits,
            link=link,
            log_size=log_size,
            method=method,
            repeats="crossed",
            network=table.network,
            image=table.image,
        )
    except FitError as error:
        told["warnings"] = [str(error)]
        return told
    low, high, upper = (
        trusted_bound(bounds, separated=fit.separated)
        for bounds in (fit.a90_low_two_sided, fit.a90_95_two_sided, fit.a90_95)
    )
    told |= {
        "a50": fit.a50,
        "a90": fit.a90,
        "a90_95_interval": {"low": low, "high": high},
        "a90_95": upper,
        "line": None
        if fit.curve is None
        else {key: value.tolist() for key, value in curve_rows(fit, points=41).items()},
        "link": fit.link,
        "repeats": fit.repeats,
        "warnings": list(fit.warnings),
    }
    return told


def _hits_by_size(size: NDArray[np.float64], hits: NDArray[np.float64] | None) -> list[dict[str, float]]:
    """Share of hits in up to eight groups of like size."""
    if hits is None or not len(size):
        return []
    groups = np.unique(size)
    edges = groups if len(groups) <= 8 else np.unique(np.quantile(size, np.linspace(0.0, 1.0, 9)[:-1]))
    place = np.searchsorted(edges, size, side="right") - 1
    return [
        {
            "size": float(size[place == number].mean()),
            "hits": int(hits[place == number].sum()),
            "n": int((place == number).sum()),
        }
        for number in range(len(edges))
        if (place == number).any()
    ]

"""The images that the starter network learns from: lines of the virtual lab, settings and described products, drawn at random.

Each block of images is a file of its own, of one line, one pair of settings, one product and several foreign objects; a
block that is there is not made again. What is drawn depends on the seed and the block's number alone.
"""

import argparse
import dataclasses
import math
import sys
import tomllib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from ..generator.line.twin import Twin
from ..generator.scenes.describe import read_description

if TYPE_CHECKING:
    from ..segmentation import Recipe

STARTER_FOLDER = Path(__file__).parents[1] / "data" / "starter"
_LINE, _BLOCK = 1, 2  # places of the random streams of a seed
_VALIDATION_EVERY = 8
_TRIES = 200


def read_starter_plan() -> dict[str, Any]:
    """What the starter learns from, as its TOML file says."""
    return tomllib.loads((STARTER_FOLDER / "starter.toml").read_text(encoding="utf-8"))


def make_starter_line(plan: Mapping[str, Any], number: int, folder: Path) -> Path:
    """The twin file of line `number`, calibrated from flats that the virtual lab measures; made if it is not there."""
    from ..acquisition.acquisition_io import open_acquisition
    from ..calibration.calibrate import calibrate_twin
    from ..generator.twins.twin_io import write_twin
    from ..lab.protocols import run_protocol

    path = folder / f"line_{number}.h5"
    if path.exists():
        return path
    flats = folder / f"flats_{number}.h5"
    lines = plan["lines"]
    rows, columns = plan["image_px"]
    if not flats.exists():
        run_protocol(
            flats,
            protocol="calibration",
            seed=plan["seed"] + number,
            rows=rows,
            columns=columns,
            pixel_mm=lines["pixel_mm"][number],
            source_detector_mm=lines["source_detector_mm"][number],
            frames=lines["frames"],
        )
    with open_acquisition(flats) as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng([plan["seed"], _LINE, number]), advise=False)
    write_twin(path, twin)
    flats.unlink()
    return path


def make_starter_block(plan: Mapping[str, Any], number: int, twin: Twin, folder: Path) -> Path:
    """The dataset file of block `number`; made if it is not there.

    Raises:
        InputError: a plan whose settings the line cannot reach, or whose objects find no room.
    """
    from ..generator.datasets.generate_described import generate_from_description

    path = folder / f"block_{number:04d}.h5"
    if path.exists():
        return path
    refused = ""
    for attempt in range(_TRIES):
        rng = np.random.default_rng([plan["seed"], _BLOCK, number, attempt])
        low, high = _settings(plan["settings"], twin, rng)
        described = folder / f"block_{number:04d}.toml"
        described.write_text(_description(plan, twin, number, rng), encoding="utf-8")
        try:
            generate_from_description(
                twin,
                read_description(described),
                path,
                low=low,
                high=high,
                images=plan["settings"]["images"],
                seed=plan["seed"] + number,
                supersampling=2,
                with_counts=False,
            )
        except InputError as error:
            refused = str(error)  # as a rule a drawn object that finds no room in the drawn product
            continue
        return path
    raise InputError(
        f"block {number}",
        received=f"{_TRIES} draws that were refused, the last one for: {refused}",
        expected="objects that fit the products",
    )


def make_starter_images(
    plan: Mapping[str, Any], folder: Path, out: Path, *, tell: Callable[[str], None] = lambda line: None
) -> None:
    """All blocks of a plan in one dataset file."""
    from ..acquisition.dataset_io import concatenate_datasets, read_dataset
    from ..generator.twins.twin_io import read_twin

    folder.mkdir(parents=True, exist_ok=True)
    twins = [read_twin(make_starter_line(plan, number, folder)) for number in range(len(plan["lines"]["pixel_mm"]))]
    blocks = []
    for number in range(plan["settings"]["blocks"]):
        blocks.append(make_starter_block(plan, number, twins[number % len(twins)], folder))
        tell(f"block {number + 1} of {plan['settings']['blocks']}")
    with ExitStack() as stack:
        concatenate_datasets([stack.enter_context(read_dataset(path)) for path in blocks], out)


def _settings(ranges: Mapping[str, Any], twin: Twin, rng: np.random.Generator) -> tuple[Setting, Setting]:
    """A pair of settings whose flats lie within the detector's range."""
    from ..generator.predictions.predict import full_scale, predict_flatfield

    for _ in range(_TRIES):
        material = str(rng.choice(list(ranges["filter_mm"])))
        most = ranges["filter_mm"][material]
        filters = (
            (Filter(material=material, thickness_mm=round(float(rng.uniform(0.1, 1.0) * most), 3)),) if most else ()
        )
        exposure_ms = round(float(np.exp(rng.uniform(*np.log(ranges["exposure_ms"])))), 1)
        pair = tuple(
            Setting(
                kV=round(float(rng.uniform(*ranges[name]))),
                power_W=round(float(rng.uniform(*ranges["power_W"]))),
                exposure_ms=exposure_ms,
                filters=filters,
            )
            for name in ("low_kV", "high_kV")
        )
        shares = []
        for setting in pair:
            mean = predict_flatfield(twin, setting).mean_DN.value
            scale = full_scale(twin, setting, mean)
            shares.append(mean / (scale[1] if scale is not None else 65535.0))
        if all(ranges["level_share"][0] < share < ranges["level_share"][1] for share in shares):
            return pair[0], pair[1]
    raise InputError(
        "settings", received=f"{_TRIES} draws outside level_share", expected="exposures that the line can take"
    )


def _description(plan: Mapping[str, Any], twin: Twin, number: int, rng: np.random.Generator) -> str:
    """The text of a block's description: one product, four kinds of foreign objects."""
    products, foreign = plan["products"], plan["foreign_objects"]
    instrument = twin.instrument
    distances = (instrument.source_detector_mm, instrument.source_object_mm)
    magnification = distances[0] / distances[1] if distances[0] and distances[1] else 1.0
    pixel_mm = (instrument.pixel_mm or 0.0) / magnification
    field_mm = [pixel_mm * side for side in twin.maps.shape]

    def between(text: str, low: float, high: float) -> str:
        return f"{text} = [{low:.3g}, {high:.3g}]"

    def one(names: Any) -> str:
        if isinstance(names, dict):
            weights = np.array(list(names.values()), dtype=float)
            return str(rng.choice(list(names), p=weights / weights.sum()))
        return str(rng.choice(names))

    height = float(np.exp(rng.uniform(*np.log(products["height_mm"]))))
    height = min(height, 1.2 * min(field_mm))
    lines = [
        "[[product]]",
        f'name = "product{number:04d}_"',
        f'shape = "{one(products["shapes"])}"',
        f'material = "{one(products["materials"])}"',
        between("length_mm", *(share * field_mm[1] for share in products["length_share"])),
        between("width_mm", *(share * field_mm[0] for share in products["width_share"])),
        between("height_mm", 0.6 * height, height),
        "turn_deg = [-10, 10]",
    ]
    for _ in range(4):
        shape = one(foreign["shapes"])
        length = [share * pixel_mm for share in foreign["length_px"]]
        across = [share * pixel_mm for share in foreign["diameter_px"]]
        # as thick as half the product at most: it must find room
        across[1] = min(across[1], 0.5 * height)
        across[0] = min(across[0], 0.5 * across[1])
        centre = float(np.exp(rng.uniform(math.log(length[0]), math.log(length[1]))))
        lines += [
            "[[foreign_object]]",
            f'name = "{shape}"',
            f'shape = "{shape}"',
            f'material = "{one(foreign["materials"])}"',
            between("length_mm", 0.6 * centre, 1.2 * centre),
        ]
        thin = [min(across[0], 0.5 * centre), min(across[1], 0.6 * centre)]
        if shape in ("shard", "ellipsoid"):
            lines += [between("width_mm", *thin), between("height_mm", *thin)]
        else:
            wire = 0.5 if shape == "wire" else 1.0
            lines.append(between("diameter_mm", *(wire * side for side in thin)))
        if rng.random() < 0.3:
            lines.append('where = "on"')
    lines += [
        "[images]",
        f"with_foreign_object = {foreign['with_foreign_object']}",
        f"objects = {list(foreign['objects'])}",
        f"distance_from_edge_mm = {2 * pixel_mm:.3g}",
        f"distance_between_mm = {3 * pixel_mm:.3g}",
        f"validation = {1.0 if number % _VALIDATION_EVERY == _VALIDATION_EVERY - 1 else 0.0}",
        "test = 0.0",
    ]
    return "\n".join(lines) + "\n"


def starter_training_recipe(plan: Mapping[str, Any]) -> "Recipe":
    """How the starter itself is trained: the shipped recipe with the plan's network, steps and rate."""
    from ..segmentation import RECIPES

    words = plan["training"]
    return dataclasses.replace(
        RECIPES["raytwin"],
        name="starter",
        scaling="residual",  # its foreign objects are of many materials: no direction is all of theirs
        architecture=words["architecture"],
        encoder=words["encoder"],
        encoder_depth=words["encoder_depth"],
        steps=words["steps"],
        batch=words["batch"],
        learning_rate=words["learning_rate"],
    )


def make_starter(plan: Mapping[str, Any], folder: Path, out: Path, *, tell: Callable[[str], None]) -> None:
    """Make images and network, and write the weights; what an earlier run left in `folder` is used."""
    from ..segmentation import open_runs, read_weights, write_safetensors
    from .trial import train_on_file

    images, runs = folder / "images.h5", folder / "runs"
    if not images.exists():
        make_starter_images(plan, folder, images, tell=tell)
    recipe = starter_training_recipe(plan)
    train_on_file(images, runs, recipe=recipe, networks=1, seed=plan["training"]["seed"], tell=tell, name="starter")
    held, weights = read_weights(open_runs(runs).path / "network_000" / "weights.pt")
    write_safetensors(out, held, weights)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=STARTER_FOLDER / "starter.safetensors")
    parser.add_argument("--folder", type=Path, default=Path("build/starter"), help="of the images and the training")
    given = parser.parse_args()
    make_starter(read_starter_plan(), given.folder, given.output, tell=lambda line: print(line, file=sys.stderr))

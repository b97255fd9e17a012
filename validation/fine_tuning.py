"""Fine-tuning of the starter network against random weights, on three products that the starter never saw.

Products, foreign objects and line are none that the starter learnt from (`data/starter/starter.toml`): other shapes, other
materials, another hidden system of the lab. For each product images are generated from a description. Networks of the
starter's kind are trained for several numbers of steps, from the starter's weights and from random ones, and tried on other
images of the product. Each network's threshold is set so that 5 % of the images it learnt from show a mark away from objects.

The answer gives objects found, a90 in contrast with its 95 % interval, and processor seconds of training. A network is called
usable when it finds nine tenths of what the longest training from random weights finds.

    OMP_NUM_THREADS=1 python validation/fine_tuning.py --output build/fine_tuning --json build/fine_tuning.json

Half an hour on one core. What is there already is not done again.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np

from raytwin.acquisition import read_dataset
from raytwin.acquisition.setting import setting_from_text
from raytwin.campaign.trial import (
    curve_of_table,
    detect_on_file,
    thresholds_from_images,
    train_on_file,
    write_split,
)
from raytwin.cli import main as raytwin
from raytwin.files import whole_file
from raytwin.generator.datasets.generate_described import generate_from_description
from raytwin.generator.scenes.describe import read_description
from raytwin.generator.twins.twin_io import read_twin
from raytwin.segmentation import starter_recipe
from raytwin.segmentation._torch import load_torch

PAIR = tuple(
    setting_from_text(f"kv={kV},power_w={power_W},exposure_ms=50,filter=Cu:0.05")
    for kV, power_W in ((40, 40), (90, 45))
)
# (start, peak rate, steps): the rates are those that `raytwin train` and the demo have
TRAININGS = (
    *(("starter", 2e-3, steps) for steps in (15, 30, 60, 120)),
    *(("random", 4e-3, steps) for steps in (120, 300)),
)
ALARM_SHARE = 0.05
USABLE = 0.9  # of what the longest training from random weights finds
_OBJECTS = """
with_foreign_object = 0.8
objects = 1
distance_from_edge_mm = 0.8
distance_between_mm = 1
"""
PRODUCTS = {
    "cylinders of polyoxymethylene with borosilicate glass": """
[[product]]
name = "cylinder"
shape = "cylinder"
material = "polyoxymethylene"
diameter_mm = [24, 30]
length_mm = [8, 16]

[[foreign_object]]
name = "shard"
shape = "shard"
material = "glass_borosilicate"
length_mm = [1.5, 7]
width_mm = [1, 4]
height_mm = [0.8, 4]
""",
    "cones of liver with granite": """
[[product]]
name = "cone"
shape = "cone"
material = "liver_icru44"
diameter_mm = [26, 31]
length_mm = [14, 24]

[[foreign_object]]
name = "stone"
shape = "superellipsoid"
material = "granite"
length_mm = [0.8, 3]
width_mm = [0.6, 2]
height_mm = [0.3, 1.5]
""",
    "heaps of nylon beads with spongy bone": """
[[product]]
name = "heap"
shape = "map"
files = ["heap_0.npz", "heap_1.npz", "heap_2.npz", "heap_3.npz", "heap_4.npz", "heap_5.npz"]
pixel_mm = 0.25

[[foreign_object]]
name = "bone"
shape = "cone"
material = "spongiosa_icru44"
diameter_mm = [1, 5]
length_mm = [1, 5]
""",
}


def write_heaps(folder: Path) -> None:
    """Maps of beads (thickness in mm, 0.25 mm pitch) that lie beside and on one another."""
    rows, columns = np.mgrid[:104, :128] * 0.25
    for number in range(6):
        rng = np.random.default_rng([17, number])
        total = np.zeros(rows.shape)
        for _ in range(260):
            radius, angle = np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
            centre = (13 + 10.5 * radius * np.sin(angle), 16 + 13.5 * radius * np.cos(angle))
            size = rng.uniform(1.2, 2.2)
            squared = size**2 - (rows - centre[0]) ** 2 - (columns - centre[1]) ** 2
            total += 2.0 * np.sqrt(np.clip(squared, 0.0, None))
        np.savez(folder / f"heap_{number}.npz", nylon_6=total.astype(np.float32))


def images_of(name: str, text: str, twin, folder: Path) -> tuple[Path, Path]:
    """Images to learn from (train and val) and others to try, of one product."""
    paths = folder / "train.h5", folder / "test.h5"
    folder.mkdir(parents=True, exist_ok=True)
    write_heaps(folder)
    for path, part, images, seed in ((paths[0], "train", 240, 1), (paths[1], "test", 240, 2)):
        if path.exists():
            continue
        described = folder / f"{part}.toml"
        shares = "validation = 0.2\ntest = 0\n" if part == "train" else "validation = 0\ntest = 1\n"
        described.write_text(f"{text}\n[images]\nproducts = 0{_OBJECTS}{shares}", encoding="utf-8")
        whole = path.with_name(f"{part}_drawn.h5")
        generate_from_description(
            twin,
            read_description(described),
            whole,
            low=PAIR[0],
            high=PAIR[1],
            images=images,
            seed=seed,
            supersampling=2,
            with_counts=False,
        )
        write_split(whole, path, part)
        print(f"{name}: {path.name}", file=sys.stderr)
    return paths


def trial(train: Path, test: Path, folder: Path, *, start: str, rate: float, steps: int, networks: int) -> dict:
    """Objects found, a90 and processor seconds of networks of one start and length."""
    kept = folder / f"{start}_{steps}.json"
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    recipe = dataclasses.replace(starter_recipe(), steps=steps, learning_rate=rate)
    runs = folder / f"{start}_{steps}"
    clock, processor = time.perf_counter(), time.process_time()
    train_on_file(
        train, runs, recipe=recipe, networks=networks, seed=1, start_from="starter" if start == "starter" else None
    )
    spent = time.process_time() - processor, time.perf_counter() - clock
    thresholds = thresholds_from_images(
        runs, train, folder / f"{start}_{steps}_thresholds.json", ALARM_SHARE, device="cpu"
    )
    hits = folder / f"{start}_{steps}.csv"
    detect_on_file(runs, test, hits, {}, thresholds, device="cpu")
    curve = curve_of_table(hits, "contrast")
    found = {
        "start": start,
        "steps": steps,
        "rate": rate,
        "networks": networks,
        "processor_s_a_network": round(spent[0] / networks, 1),
        "clock_s_a_network": round(spent[1] / networks, 1),
        "found": curve["n_hits"],
        "looks": curve["n"],
        "a90": curve["a90"],
        "a90_95_interval": curve["a90_95_interval"],
        "false_alarms": None if curve["false_alarms"] is None else curve["false_alarms"]["rate"],
        "warnings": curve["warnings"],
    }
    with whole_file(kept) as temporary:
        temporary.write_text(json.dumps(found), encoding="utf-8")
    return found


def until_usable(rows: list[dict]) -> dict:
    """Processor seconds of the shortest training of each start that finds nine tenths of what the longest random one finds."""
    longest = max((row for row in rows if row["start"] == "random"), key=lambda row: row["steps"])
    enough = USABLE * longest["found"]
    seconds = {}
    for start in ("starter", "random"):
        usable = [row for row in rows if row["start"] == start and row["found"] >= enough > 0]
        seconds[start] = min((row["processor_s_a_network"] for row in usable), default=None)
    known = None not in seconds.values()
    return {"seconds": seconds, "random_over_starter": seconds["random"] / seconds["starter"] if known else None}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("build/fine_tuning"))
    parser.add_argument("--networks", type=int, default=3, help="of each start and length (3)")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder = options.output
    folder.mkdir(parents=True, exist_ok=True)
    load_torch().set_num_threads(1)
    if not (folder / "twin.h5").exists():
        line = ["--seed", "4711", "--size", "96x128", "--source-detector-mm", "2500", "--frames", "8"]
        for words in (
            ["lab", "-o", str(folder / "flats.h5"), "--protocol", "calibration", *line],
            ["calibrate", str(folder / "flats.h5"), "-o", str(folder / "twin.h5")],
        ):
            if raytwin(words):
                raise SystemExit(f"raytwin {words[0]} failed")
    twin = read_twin(folder / "twin.h5")
    answer = {}
    for number, (name, text) in enumerate(PRODUCTS.items()):
        place = folder / f"product_{number}"
        train, test = images_of(name, text, twin, place)
        rows = []
        for start, rate, steps in TRAININGS:
            row = trial(train, test, place, start=start, rate=rate, steps=steps, networks=options.networks)
            print(
                f"{name}: {start}, {steps} steps, {row['processor_s_a_network']:.0f} s: {row['found']} of {row['looks']},"
                f" a90 {row['a90']}, false alarms {row['false_alarms']}",
                file=sys.stderr,
            )
            rows.append(row)
        with read_dataset(test) as dataset:
            contrast = dataset.column("contrast")
        known = np.sort(contrast[np.isfinite(contrast)])
        answer[name] = {
            "contrast": [round(float(known[0]), 4), round(float(known[-1]), 4)],
            "rows": rows,
            "usable": until_usable(rows),
        }
    text = json.dumps(answer, indent=1)
    if options.json is None:
        print(text)
    else:
        with whole_file(options.json) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

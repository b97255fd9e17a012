"""Model observers against networks: a90 at settings whose networks took no part in the observer's calibration.

On a line of the virtual lab: its twin, 300 fillets with and without rib bones, and 20 pairs of settings that differ in kV, filter,
exposure and belt speed. At each `raytwin sweep` trains three networks. They are then tried on other products, each seen several
times with its own noise, at thresholds that give the same share of marked images without their objects. The observer's two numbers
are fitted to some settings; a90 of the others is predicted with its interval. A stopped run goes on where it was.

    python validation/observers.py --output build/observers --json build/observers.json
"""

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np

from raytwin.acquisition.dataset_io import read_dataset
from raytwin.acquisition.setting import setting_from_text
from raytwin.campaign.trial import curve_of_table, detect_on_file, thresholds_from_images, write_split
from raytwin.cli import main as raytwin
from raytwin.files import whole_file
from raytwin.generator.datasets.belt_motion import twin_on_belt
from raytwin.generator.datasets.generate import generate_dataset
from raytwin.generator.line.twin import Z95
from raytwin.generator.twins.twin_io import read_twin
from raytwin.observers import DETECTORS, LineImages, MeasuredSize, Observer, fit_efficiency, objects_of_references
from raytwin.observers.efficiency import predicted_sizes

FALSE_ALARMS = 0.1
DRAWS = 3  # looks at each product
CALIBRATING = 6
SIZE = "--size 96x128 --pixel-mm 0.45 --seed 11 --family none --no-unkindness --source-detector-mm 2000"
THIN, THICK = "Cu:0.05", "Cu:0.3"
# kV low and high, filters, exposure (ms), belt (mm/s)
SETTINGS = (
    *((40, 90, THIN, THIN, exposure, None) for exposure in (15, 25, 40, 100)),
    *((40, 90, THIN, THICK, exposure, None) for exposure in (50, 25)),
    (50, 90, THIN, THIN, 25, None),
    (50, 90, THIN, THIN, 60, None),
    (60, 90, THIN, THIN, 100, None),
    (35, 80, THIN, THIN, 60, None),
    (45, 110, THIN, THIN, 30, None),
    (45, 110, THIN, THICK, 80, None),
    (40, 70, THIN, THIN, 60, None),
    (40, 90, "Al:1", THIN, 20, None),
    (40, 90, THIN, THIN, 30, 30),
    (40, 90, THIN, THIN, 30, 60),
    (40, 90, THIN, THIN, 60, 30),
    (50, 100, THIN, THIN, 60, 60),
    (45, 90, THIN, "Cu:0.2", 100, 20),
    (40, 90, THIN, THIN, 20, 40),
)
CAMPAIGN = """twin = "twin.h5"
references = "references.h5"
seed = 1
product_material = "chicken_breast"
foreign_material = "rib_bone"
{settings}
[training]
networks = 3
images = 144
steps = 50
start_steps = 240
mixed_steps = 120
start_shares = [0.2, 0.08, 0.03]
[detection]
draws = 1
[contrast]
product = "chicken_breast:20"
object = "rib_bone:2"
object_pixels = 30
"""


def setting_text(kV, power_W, filters, exposure_ms, belt):
    moving = f",belt_speed_mm_s={belt}" if belt else ""
    return f"kv={kV},power_w={power_W},exposure_ms={exposure_ms},filter={filters}{moving}"


def campaign_text():
    blocks = []
    for low, high, low_filter, high_filter, exposure, belt in SETTINGS:
        first, second = (
            setting_text(low, 40, low_filter, exposure, belt),
            setting_text(high, 45, high_filter, exposure, belt),
        )
        blocks.append(f'[[setting]]\nlow = "{first}"\nhigh = "{second}"')
    return CAMPAIGN.format(settings="\n".join(blocks))


def run(*words):
    if raytwin([str(word) for word in words]) != 0:
        sys.exit(f"raytwin {' '.join(map(str, words))} failed")


def prepare(folder):
    """The line, its twin, the products and the campaign file."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "calibration.h5").exists():
        run("lab", "-o", folder / "calibration.h5", "--protocol", "calibration", *SIZE.split(), "--frames", 16)
    if not (folder / "twin.h5").exists():
        run("calibrate", folder / "calibration.h5", "-o", folder / "twin.h5")
    if not (folder / "set1.h5").exists():
        run("lab", "-o", folder / "set1.h5", "--protocol", "set1", *SIZE.split(), "--products", 300)
    if not (folder / "references.h5").exists():
        shares = ["--validation", 0.1, "--test", 0.55, "--seed", 1, "--ring-px", 7]
        run(
            "import",
            "reference",
            folder / "set1.h5",
            "-o",
            folder / "references.h5",
            "--twin",
            folder / "twin.h5",
            *shares,
        )
    if not (folder / "campaign.toml").exists():
        (folder / "campaign.toml").write_text(campaign_text())


def tried(twin, references, trained, folder, pair, number):
    """Curve of a setting's networks on `DRAWS` looks at every test product, at thresholds of equal readiness."""
    folder.mkdir(parents=True, exist_ok=True)
    hits = folder / "hits.csv"
    if not hits.exists():
        at, _ = twin_on_belt(twin, pair)
        for part, source in (("train", "learn"), ("test", "test")):
            with read_dataset(references / f"{source}.h5") as reference:
                known = {row.image for row in reference.rows}
                count = DRAWS * len(reference)
                generate_dataset(
                    at, reference, folder / "drawn.h5", low=pair[0], high=pair[1], images=count,
                    seed=10_000 + 10 * number + len(part), product_material="chicken_breast", foreign_material="rib_bone",
                    with_counts=False,
                )  # fmt: skip
            looks = {}

            def name(image, known=known, looks=looks):
                scene = image if image in known else image.rpartition("-")[0]
                looks[scene] = looks.get(scene, 0) + 1
                return f"{scene}#{looks[scene]}"

            write_split(folder / "drawn.h5", folder / f"{part}.h5", part, name_of=name)
        networks = trained / "networks"
        thresholds = thresholds_from_images(
            networks, folder / "train.h5", folder / "thresholds.json", FALSE_ALARMS, device="cpu"
        )
        detect_on_file(networks, folder / "test.h5", hits, {}, thresholds, device="cpu")
        for part in ("train", "test"):
            (folder / f"{part}.h5").unlink()
    return curve_of_table(hits, "contrast")


def calibrating(measured):
    """Numbers of the settings that the observer is calibrated on: without motion, spread evenly over the order of their a90."""
    still = [n for n, one in enumerate(measured) if one is not None and one.pair[0].belt_speed_mm_s is None]
    still.sort(key=lambda n: measured[n].a90)
    places = np.linspace(0, len(still) - 1, min(CALIBRATING, len(still))).round().astype(int)
    return sorted({still[place] for place in places})


def compared(line, objects, measured, chosen, detector):
    """A row for each setting that was left out; what the fit says of itself."""
    observer = Observer(detector=detector, false_alarm_rate=FALSE_ALARMS)
    efficiency = fit_efficiency(line, [measured[n] for n in chosen], objects, observer=observer)
    others = [n for n, one in enumerate(measured) if one is not None and n not in chosen]
    found = predicted_sizes(line, [measured[n].pair for n in others], objects, efficiency)
    rows = []
    for place, number in enumerate(others):
        one = measured[number]
        value, low, high = (float(end[place]) for end in (found.a90, found.low, found.high))
        sd = math.hypot(math.log(high / low) / (2 * Z95), one.log_sd)
        rows.append({
            "setting": f"{one.pair[0]};{one.pair[1]}", "networks": one.a90, "networks_low": one.low, "networks_high": one.high,
            "observer": value, "low": low, "high": high, "inside": low <= one.a90 <= high,
            "inside_with_measured_error": abs(math.log(one.a90 / value)) <= Z95 * sd,
        })  # fmt: skip
    ratio = np.log([row["networks"] / row["observer"] for row in rows])
    errors = np.array([measured[number].log_sd for number in others])
    return {
        "detector": detector,
        "efficiency": efficiency.observer.efficiency,
        "internal_noise": efficiency.observer.internal_noise,
        "scatter": efficiency.scatter,
        "calibrating": len(chosen),
        "left_out": len(rows),
        "rms_percent": 100 * float(np.sqrt(np.mean(ratio**2))),
        "bias_percent": 100 * float(np.mean(ratio)),
        "measured_error_percent": 100 * float(np.sqrt(np.mean(errors**2))),
        "inside": sum(row["inside"] for row in rows),
        "inside_with_measured_error": sum(row["inside_with_measured_error"] for row in rows),
        "rows": rows,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("build/observers"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-training", action="store_true", help="compare with what is trained already")
    options = parser.parse_args()
    folder = options.output
    prepare(folder)
    if not options.no_training:
        run("sweep", folder / "campaign.toml", "-o", folder / "sweep")
    twin = read_twin(folder / "twin.h5")
    line = LineImages(twin)
    references = folder / "sweep" / "references"
    with read_dataset(references / "test.h5") as dataset:
        found = objects_of_references(dataset, pixel_mm=line.pixel_mm)
    own = tuple(setting_from_text(text) for text in found.setting.split(";"))
    objects = line.objects_from_references(
        found, pair=own, product_material="chicken_breast", foreign_material="rib_bone"
    )
    measured, curves = [], []
    trained = {
        (row["low"], row["high"]): file.parent
        for file in sorted((folder / "sweep" / "settings").glob("*/row.json"))
        for row in [json.loads(file.read_text())]
    }
    for number, (low, high, low_filter, high_filter, exposure, belt) in enumerate(SETTINGS):
        pair = (
            setting_from_text(setting_text(low, 40, low_filter, exposure, belt)),
            setting_from_text(setting_text(high, 45, high_filter, exposure, belt)),
        )
        place = trained.get((str(pair[0]), str(pair[1])))
        if place is None:
            continue
        curve = tried(twin, references, place, folder / "tried" / place.name, pair, number)
        ends = curve["a90_95_interval"]
        curves.append({"setting": f"{pair[0]};{pair[1]}", "false_alarms": curve["false_alarms"], "a90": curve["a90"]})
        if curve["a90"] is None:
            continue
        measured.append(MeasuredSize(pair=pair, a90=curve["a90"], low=ends["low"], high=ends["high"]))
        print(f"{pair[0]};{pair[1]}: a90 {curve['a90']:.4g} ({ends['low']} to {ends['high']})", file=sys.stderr)
    measured = [one for one in measured if one.log_sd is not None]
    chosen = calibrating(measured)
    answers = [compared(line, objects, measured, chosen, detector) for detector in DETECTORS]
    for answer in answers:
        print(
            f"{answer['detector']:>10}: efficiency {answer['efficiency']:.3g}, internal noise {answer['internal_noise']:.3g},"
            f" rms {answer['rms_percent']:.1f} % (networks' own error {answer['measured_error_percent']:.1f} %),"
            f" inside {answer['inside']} of {answer['left_out']},"
            f" with the networks' error {answer['inside_with_measured_error']}"
        )
    for row in answers[0]["rows"]:
        print(
            f"  {row['networks']:.4f} against {row['observer']:.4f} ({row['low']:.4f} to {row['high']:.4f})  {row['setting']}"
        )
    if options.json:
        with whole_file(options.json) as temporary:
            temporary.write_text(json.dumps({"curves": curves, "answers": answers}, indent=1) + "\n")


if __name__ == "__main__":
    main()

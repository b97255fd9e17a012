"""The main job end to end on the virtual lab, as a chain of raytwin's own commands.

Every step is a command that a person could type; its answer is kept, and a step whose answer and outputs are there
already is not done again, so that a killed run goes on where it stopped.
"""

import contextlib
import csv
import io
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..acquisition.setting import Filter, Setting
from ..errors import InputError, RaytwinError
from ..files import whole_file
from .demo_gap import GapPlan, run_gap

Run = Callable[[Sequence[str]], int]
Tell = Callable[[str], None]

_FILTERS = (Filter(material="Cu", thickness_mm=0.05),)
LOW = Setting(kV=40, power_W=40, exposure_ms=100, averaged=10, filters=_FILTERS)
HIGH = Setting(kV=90, power_W=45, exposure_ms=100, averaged=10, filters=_FILTERS)


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoPlan:
    """How large the demo is.

    Fields: size (row, column) and pixel_mm of the detector; source_detector_mm (None: as many photons a pixel as the paper's
    line, whatever the pixel); bones_mm of the test set, each bone as thick as it is drawn (None: the paper's two);
    calibration_frames a series; products, test_products (images of the two sets); exposures_ms of the fast settings; generated
    (training pairs an exposure); networks an exposure; start (`starter`: networks start from the one that comes with raytwin;
    `shared`: from one that is trained first, with first_steps on the least noisy images, then shared_steps on all exposures);
    steps (of each network after its start; from the starter those at 1 s, doubled for each shorter exposure); rate (of
    learning, peak, from the starter); batch; threads of each training and trial (None: all; networks this small wait longer for
    a second thread than it saves, and the weights depend on the number); seed; recipe of the training where the start is
    `shared`; gap (of the chapter that plants an effect).
    """

    size: tuple[int, int] = (96, 128)
    pixel_mm: float = 0.45
    source_detector_mm: float | None = 2000.0
    bones_mm: tuple[float, ...] | None = 2 * (1.5, 2.5, 4.0, 7.0, 11.0, 15.0)
    calibration_frames: int = 16
    products: int = 72
    test_products: int = 86
    exposures_ms: tuple[float, ...] = (100.0, 50.0)
    generated: int = 144
    networks: int = 3
    start: str = "starter"
    first_steps: int = 200
    shared_steps: int = 60
    steps: int = 30
    rate: float = 2e-3
    batch: int = 8
    threads: int | None = 1
    seed: int = 1
    recipe: str = "raytwin"
    gap: GapPlan = field(default_factory=GapPlan)

    def __post_init__(self) -> None:
        if self.start not in ("starter", "shared"):
            raise InputError("start", received=self.start, expected="starter or shared")
        for name in ("products", "test_products", "generated", "networks", "first_steps", "shared_steps", "steps"):
            if getattr(self, name) < 1:
                raise InputError(name, received=getattr(self, name), expected="1 or more")


PAPER_PLAN = DemoPlan(
    size=(760, 956),
    pixel_mm=0.15,
    source_detector_mm=None,
    bones_mm=None,
    calibration_frames=200,
    products=254,
    test_products=84,
    exposures_ms=(100.0, 50.0, 20.0),
    generated=254,
    networks=100,
    start="shared",
    first_steps=4000,
    shared_steps=2000,
    steps=2000,
    batch=2,
    threads=None,
)


@dataclass(slots=True)
class _Chain:
    """Runs commands in order; keeps each answer in DIR/answers and the words that produced it."""

    directory: Path
    run: Run
    tell: Tell
    commands: list[dict[str, Any]] = field(default_factory=list)

    def path(self, name: str) -> str:
        return str(self.directory / name)

    def step(self, name: str, words: Sequence[str], *, outputs: Sequence[str] = ()) -> dict[str, Any]:
        """Answer of a command, from the last run where that is complete."""
        text = "raytwin " + " ".join(words).replace(f"{self.directory}/", "")
        kept = self.directory / "answers" / f"{name}.json"
        if kept.exists() and all(Path(self.path(output)).exists() for output in outputs):
            record: dict[str, Any] = json.loads(kept.read_text())
            if record.get("command") == text:
                self.commands.append(record)
                return dict(record["answer"])
        self.tell(text)
        started = time.monotonic()
        answer = io.StringIO()
        with contextlib.redirect_stdout(answer):
            code = self.run([*words, "--json"])
        if code != 0:
            raise RaytwinError(f"the step `{text}` failed (exit code {code}); its message stands above")
        record = {
            "command": text,
            "seconds": round(time.monotonic() - started, 1),
            "answer": json.loads(answer.getvalue()),
        }
        with whole_file(kept) as temporary:
            temporary.write_text(json.dumps(record))
        self.commands.append(record)
        return dict(record["answer"])


def run_demo(plan: DemoPlan, directory: Path, *, run: Run, tell: Tell) -> dict[str, Any]:
    """Do the whole chain in `directory` and return everything the report shows.

    Args:
        plan: sizes.
        directory: made if absent; what an earlier run of the same plan left is used.
        run: runs one raytwin command given as words and returns its exit code.
        tell: shows one line of progress.

    Raises:
        InputError: the directory holds a demo of another plan.
        RaytwinError: a step failed.
    """
    _claim(directory, plan)
    chain = _Chain(directory=directory, run=run, tell=tell)
    exposures = [1000.0, *plan.exposures_ms]
    line = _measured_line(chain, plan)
    _datasets(chain, plan, exposures)
    found = _networks(chain, plan, exposures)
    gap = run_gap(directory, plan.gap, seed=plan.seed, step=chain.step)
    return {
        "plan": asdict(plan),
        **line,
        **found,
        "gap": gap,
        "a90_table": a90_table(found["pod"], found["compare"], exposures),
        "noise": {f"{exposure:g}ms": noise_comparison(directory, f"{exposure:g}ms") for exposure in plan.exposures_ms},
        "commands": chain.commands,
    }


def _claim(directory: Path, plan: DemoPlan) -> None:
    """Make the folder one of this plan.

    Raises:
        InputError: it holds a demo of another plan, or other files.
    """
    directory.mkdir(parents=True, exist_ok=True)
    fingerprint = json.dumps(asdict(plan), sort_keys=True)
    kept = directory / "plan.json"
    if kept.exists() and kept.read_text() != fingerprint:
        raise InputError(
            "-o",
            received=f"{directory}, a demo of another plan",
            expected="a new folder, or the same options as before",
        )
    if not kept.exists():
        if any(directory.iterdir()):
            raise InputError("-o", received=f"{directory}, a folder with files in it", expected="a new or empty folder")
        with whole_file(kept) as temporary:
            temporary.write_text(fingerprint)


def _measured_line(chain: _Chain, plan: DemoPlan) -> dict[str, Any]:
    """The line that is measured, its twin, and how well that predicts flats."""
    at = chain.path
    size = ["--size", f"{plan.size[0]}x{plan.size[1]}", "--pixel-mm", f"{plan.pixel_mm:g}", "--seed", str(plan.seed)]
    # the main job end to end, on a line without surprises
    size += ["--family", "none", "--no-unkindness"]
    if plan.source_detector_mm is not None:
        size += ["--source-detector-mm", f"{plan.source_detector_mm:g}"]
    bones = [] if plan.bones_mm is None else ["--bones-mm", ",".join(f"{length:g}" for length in plan.bones_mm)]
    truth = chain.step(
        "lab_calibration",
        ["lab", "-o", at("calibration.h5"), "--protocol", "calibration", *size,
         "--frames", str(plan.calibration_frames)],
        outputs=["calibration.h5"],
    )  # fmt: skip
    calibration = chain.step("calibrate", ["calibrate", at("calibration.h5"), "-o", at("twin.h5")], outputs=["twin.h5"])
    validation = chain.step("validate", ["validate", at("twin.h5"), at("calibration.h5")])
    for name, count, more in (("set1", plan.products, []), ("set2", plan.test_products, bones)):
        chain.step(
            f"lab_{name}",
            ["lab", "-o", at(f"{name}.h5"), "--protocol", name, *size, "--products", str(count), *more],
            outputs=[f"{name}.h5"],
        )
    return {"truth": truth, "calibration": calibration, "validation": validation}


def _datasets(chain: _Chain, plan: DemoPlan, exposures: Sequence[float]) -> None:
    """Measured images as datasets; generated ones, for training from set 1, for testing from the 1 s images of set 2."""
    at = chain.path
    twin = ["--twin", at("twin.h5")]
    chain.step(
        "references",
        ["import", "reference", at("set1.h5"), "-o", at("references.h5"), *twin, "--validation", "0.2",
         "--seed", str(plan.seed)],
        outputs=["references.h5"],
    )  # fmt: skip
    for exposure in exposures:
        low, high = setting_pair(exposure)
        chain.step(
            f"real_{exposure:g}ms",
            ["import", "reference", at("set2.h5"), "-o", at(f"real_{exposure:g}ms.h5"), *twin,
             "--low", str(low), "--high", str(high)],
            outputs=[f"real_{exposure:g}ms.h5"],
        )  # fmt: skip
    for exposure in plan.exposures_ms:
        low, high = setting_pair(exposure)
        setting = ["--low", str(low), "--high", str(high)]
        number = f"{exposure:g}ms"
        seed = 1000 * plan.seed + 10 * int(exposure)
        for kind, source, count, offset in (
            ("train", "references.h5", plan.generated, 0),
            ("test", "real_1000ms.h5", plan.test_products, 1),
        ):
            chain.step(
                f"generate_{kind}_{number}",
                ["generate", at("twin.h5"), at(source), *setting, "-n", str(count),
                 "--seed", str(seed + offset), "--no-counts", "-o", at(f"{kind}_{number}.h5")],
                outputs=[f"{kind}_{number}.h5"],
            )  # fmt: skip
        chain.step(
            f"published_{number}",
            ["generate", at("twin.h5"), at("real_1000ms.h5"), *setting, "-n", str(plan.test_products),
             "--recipe", "as_published", "--seed", str(seed + 2), "--no-counts", "-o", at(f"published_{number}.h5")],
            outputs=[f"published_{number}.h5"],
        )  # fmt: skip


def _networks(chain: _Chain, plan: DemoPlan, exposures: Sequence[float]) -> dict[str, Any]:
    """Networks trained, tried and compared.

    Each starts from the network that comes with raytwin, or from one shared by all that is trained before. From the one that
    comes with raytwin, noisier images take longer: each shorter exposure twice the steps.
    """
    at = chain.path
    threads = [] if plan.threads is None else ["--threads", str(plan.threads)]
    common = ["--batch", str(plan.batch), "--seed", str(plan.seed), *threads]
    training: dict[str, Any] = {}
    start = "starter"
    if plan.start == "starter":
        common += ["--learning-rate", f"{plan.rate:g}"]
    else:
        common += ["--recipe", plan.recipe]
        training = _shared_start(chain, plan, common)
        start = at("runs_shared")
    detection: dict[str, Any] = {}
    pod: dict[str, Any] = {}
    compared: dict[str, Any] = {}
    for place, exposure in enumerate(exposures):
        number = f"{exposure:g}ms"
        steps = plan.steps * (2**place if plan.start == "starter" else 1)
        dataset = "references.h5" if exposure == 1000.0 else f"train_{number}.h5"
        training[number] = chain.step(
            f"train_{number}",
            ["train", at(dataset), "-o", at(f"runs_{number}"), *common, "--networks", str(plan.networks),
             "--steps", str(steps), "--start-from", start],
            outputs=[f"runs_{number}"],
        )  # fmt: skip
        kinds = ["real"] if exposure == 1000.0 else ["real", "test"]
        for kind in kinds:
            name = f"{kind}_{number}"
            detection[name] = chain.step(
                f"detect_{name}",
                [
                    "detect",
                    at(f"runs_{number}"),
                    at(f"{name}.h5"),
                    "--split",
                    "all",
                    "-o",
                    at(f"hits_{name}.csv"),
                    *threads,
                ],
                outputs=[f"hits_{name}.csv"],
            )
            pod[name] = _pod(chain, name)
        if len(kinds) == 2:
            compared[number] = _compared(chain, number)
    return {"training": training, "detection": detection, "pod": pod, "compare": compared}


def _shared_start(chain: _Chain, plan: DemoPlan, common: Sequence[str]) -> dict[str, Any]:
    """One network that all others start from, `runs_shared`.

    First from the least noisy images (noisier ones teach a new network nothing for hundreds of steps), then from all exposures.
    """
    at = chain.path
    _mix(chain, ["references.h5", f"train_{max(plan.exposures_ms):g}ms.h5"], "train_clear.h5")
    _mix(chain, [f"train_{exposure:g}ms.h5" for exposure in plan.exposures_ms], "train_mixed.h5")
    first = chain.step(
        "train_first",
        ["train", at("train_clear.h5"), "-o", at("runs_first"), *common, "--networks", "1",
         "--steps", str(plan.first_steps)],
        outputs=["runs_first"],
    )  # fmt: skip
    shared = chain.step(
        "train_shared",
        ["train", at("train_mixed.h5"), "-o", at("runs_shared"), *common, "--networks", "1",
         "--steps", str(plan.shared_steps), "--start-from", at("runs_first")],
        outputs=["runs_shared"],
    )  # fmt: skip
    return {"first": first, "shared": shared}


def setting_pair(exposure_ms: float) -> tuple[Setting, Setting]:
    """Low and high setting of the paper's line at an exposure; 1000 ms is ten averaged frames of 100 ms."""
    if exposure_ms == 1000.0:
        return LOW, HIGH
    return (
        replace(LOW, exposure_ms=exposure_ms, averaged=1),
        replace(HIGH, exposure_ms=exposure_ms, averaged=1),
    )


def _mix(chain: _Chain, sources: Sequence[str], out: str) -> None:
    """One dataset out of several, made by the library: the command line has no word for it."""
    from ..acquisition.dataset_io import concatenate_datasets, read_dataset

    if Path(chain.path(out)).exists():
        return
    chain.tell(f"joining {', '.join(sources)} into {out}")
    with contextlib.ExitStack() as stack:
        opened = [stack.enter_context(read_dataset(chain.path(source))) for source in sources]
        concatenate_datasets(opened, chain.path(out))


def _pod(chain: _Chain, name: str) -> dict[str, Any]:
    """POD answer of a hit table, or why there is none (all hit, all missed)."""
    try:
        return chain.step(f"pod_{name}", ["pod", chain.path(f"hits_{name}.csv"), "--size", "contrast"])
    except RaytwinError as error:
        chain.tell(f"no POD curve for {name}: {error}")
        return {"a90": None, "warnings": [str(error)]}


def _compared(chain: _Chain, number: str) -> dict[str, Any]:
    words = ["compare", chain.path(f"hits_real_{number}.csv"), chain.path(f"hits_test_{number}.csv")]
    try:
        return chain.step(f"compare_{number}", words)
    except RaytwinError as error:
        chain.tell(f"no comparison at {number}: {error}")
        return {"warnings": [str(error)]}


def a90_table(pod: dict[str, Any], compared: dict[str, Any], exposures: Sequence[float]) -> list[dict[str, Any]]:
    """The paper's Table 1 for this system: contrast at POD 90 %, generated against real, with 95 % intervals."""

    def entry(name: str) -> dict[str, Any] | None:
        if name not in pod:
            return None
        answer = pod[name]
        low = (answer.get("a90_low_two_sided") or {}).get("likelihood_ratio")
        high = (answer.get("a90_95_two_sided") or {}).get("likelihood_ratio")
        return {
            "a50": answer.get("a50"),
            "a90": answer.get("a90"),
            "low": low,
            "high": high,
            "n": answer.get("n"),
            "n_hits": answer.get("n_hits"),
            "warnings": answer.get("warnings", []),
        }

    return [
        {
            "exposure_ms": exposure,
            "real": entry(f"real_{exposure:g}ms"),
            "generated": entry(f"test_{exposure:g}ms"),
            "compare": compared.get(f"{exposure:g}ms"),
        }
        for exposure in exposures
    ]


def noise_comparison(directory: Path, number: str) -> dict[str, dict[str, list[float]]]:
    """Noise of the log images inside the products: standard deviation, and correlation of neighbours along a row.

    Taken from differences to the same product's 1 s image. With v the variance of the image's noise and r its share of the
    1 s exposure, the 1 s image holds about r v of its own: a measured difference has v (1 + r), a topped-up one, which shares
    its reference's noise, v (1 - r), and one with full noise on top v - r v again. Per channel (low kV, high kV).
    """
    from ..acquisition.dataset_io import read_dataset

    share = float(number.removesuffix("ms")) / 1000.0
    result: dict[str, dict[str, list[float]]] = {}
    with read_dataset(directory / "real_1000ms.h5") as reference:
        position = {row.image: index for index, row in enumerate(reference.rows)}
        for kind, name, factor in (
            ("real", f"real_{number}", 1.0 / (1.0 + share)),
            ("raytwin", f"test_{number}", 1.0 / (1.0 - share)),
            ("as_published", f"published_{number}", 1.0),
        ):
            variances: list[list[float]] = [[], []]
            correlations: list[list[float]] = [[], []]
            with read_dataset(directory / f"{name}.h5") as dataset:
                for index, row in enumerate(dataset.rows):
                    original = row.image if row.image in position else row.image.rpartition("-")[0]
                    inside = dataset.product_masks(index)
                    difference = dataset.images(index) - reference.images(position[original])
                    both = inside[:, 1:] & inside[:, :-1]
                    for channel in range(2):
                        plane = difference[channel] - difference[channel][inside].mean()
                        variance = float(np.mean(plane[inside] ** 2))
                        variances[channel].append(variance * factor)
                        neighbours = float(np.mean((plane[:, 1:] * plane[:, :-1])[both]))
                        correlations[channel].append(neighbours / variance)
            held = [share * value**2 for value in result["real"]["rms"]] if kind == "as_published" else [0.0, 0.0]
            result[kind] = {
                "rms": [math.sqrt(float(np.mean(v)) + extra) for v, extra in zip(variances, held, strict=True)],
                "neighbour_correlation": [float(np.mean(values)) for values in correlations],
            }
    return result


def gap_summary(validation: dict[str, Any]) -> dict[str, Any]:
    """Where the twin and the measured flats that it never saw differ, in standard deviations of the prediction.

    `gap_before` is the root mean square over means and noise levels of all held-back series (1 = nothing but the stated
    uncertainty). Which effect causes a gap is not asked here.
    """
    rows = []
    for row in validation["rows"]:
        for key, axis in (("mean_DN", "level"), ("sd_DN", "noise")):
            estimate = row[key]
            sd = (estimate["high"] - estimate["low"]) / (2 * 1.959964)
            z = (row[f"measured_{key}"] - estimate["value"]) / sd if sd > 0 else 0.0
            rows.append({"axis": axis, "series": row["series"], "statistic": key, "z": z, "location": row["setting"]})
    rows.sort(key=lambda row: -abs(row["z"]))
    return {
        "verdict": None,
        "gap_before": math.sqrt(float(np.mean([row["z"] ** 2 for row in rows]))) if rows else None,
        "where": rows[:5],
    }


def read_hits(path: Path) -> list[dict[str, str]]:
    """Rows of a hit table."""
    with open(path, newline="") as stream:
        return list(csv.DictReader(stream))

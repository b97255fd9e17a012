"""The main job end to end on the virtual lab, as a chain of raytwin's own commands.

Every step is a command that a person could type; its answer is kept, and a step whose answer and outputs are there
already is not done again, so that a killed run goes on where it stopped.
"""

import contextlib
import csv
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import only_one, remove_parts
from ..generator.line.twin import Z95
from .chain import Chain, Run, Tell, claim_folder
from .demo_gap import GapPlan, run_gap
from .lab_line import LabLine, measure_line, write_generated, write_measured


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoPlan:
    """How large the demo is.

    Fields: size (row, column) and pixel_mm of the detector; source_detector_mm (None: as many photons a pixel as the paper's
    line, whatever the pixel); bones_mm of the test set, each bone as thick as it is drawn (None: the paper's two);
    calibration_frames a series; products, test_products (images of the two sets); exposures_ms of the fast settings; generated
    (training pairs an exposure); networks an exposure; start (`starter`: networks start from the one that comes with raytwin;
    `shared`: from one that is trained first, with first_steps on the least noisy images, then shared_steps on all exposures);
    steps (of each network after its start; from the starter those at 1 s, twice as many for shorter exposures); rate (of
    learning, peak, from the starter); batch; threads of each training and trial (None: all; networks this small wait longer for
    a second thread than it saves, and the weights depend on the number); workers (processes that share the networks of an exposure);
    seed; recipe of the training where the start is `shared`; gap (of the chapter that plants an effect).
    """

    size: tuple[int, int] = (96, 128)
    pixel_mm: float = 0.45
    source_detector_mm: float | None = 1700.0
    bones_mm: tuple[float, ...] | None = 2 * (1.5, 2.5, 4.0, 7.0, 12.0, 20.0)
    calibration_frames: int = 16
    products: int = 72
    test_products: int = 86
    exposures_ms: tuple[float, ...] = (100.0, 50.0, 20.0)
    generated: int = 144
    networks: int = 3
    start: str = "starter"
    first_steps: int = 200
    shared_steps: int = 60
    steps: int = 30
    rate: float = 2e-3
    batch: int = 8
    threads: int | None = 1
    workers: int = 2
    seed: int = 1
    recipe: str = "raytwin"
    gap: GapPlan = field(default_factory=GapPlan)

    def __post_init__(self) -> None:
        if self.start not in ("starter", "shared"):
            raise InputError("start", received=self.start, expected="starter or shared")
        for name in (
            "products",
            "test_products",
            "generated",
            "networks",
            "first_steps",
            "shared_steps",
            "steps",
            "workers",
        ):
            if getattr(self, name) < 1:
                raise InputError(name, received=getattr(self, name), expected="1 or more")

    @property
    def line(self) -> LabLine:
        """What is measured and generated."""
        return LabLine(
            size=self.size,
            pixel_mm=self.pixel_mm,
            source_detector_mm=self.source_detector_mm,
            bones_mm=self.bones_mm,
            calibration_frames=self.calibration_frames,
            products=self.products,
            test_products=self.test_products,
            exposures_ms=self.exposures_ms,
            generated=self.generated,
            seed=self.seed,
        )


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
    workers=1,
)


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
    claim_folder(directory, asdict(plan), what="a demo")
    with only_one(directory, "a demo"):
        remove_parts(directory)
        chain = Chain(directory=directory, run=run, tell=tell)
        exposures = [1000.0, *plan.exposures_ms]
        line = measure_line(chain, plan.line)
        write_measured(chain, plan.line, exposures)
        for exposure in plan.exposures_ms:
            for name in ("train", "test", "published"):
                write_generated(chain, plan.line, exposure, name)
        found = _networks(chain, plan, exposures)
        gap = run_gap(directory, plan.gap, seed=plan.seed, step=chain.step)
        return {
            "plan": asdict(plan),
            **line,
            **found,
            "gap": gap,
            "a90_table": a90_table(found["pod"], found["compare"], exposures),
            "noise": {
                f"{exposure:g}ms": noise_comparison(directory, f"{exposure:g}ms") for exposure in plan.exposures_ms
            },
            "commands": chain.commands,
        }


def _networks(chain: Chain, plan: DemoPlan, exposures: Sequence[float]) -> dict[str, Any]:
    """Networks trained, tried and compared.

    Each starts from the network that comes with raytwin, or from one shared by all that is trained before. From the one that
    comes with raytwin, noisier images than those at 1 s take twice the steps.
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
    for exposure in exposures:
        number = f"{exposure:g}ms"
        steps = plan.steps * (2 if plan.start == "starter" and exposure < max(exposures) else 1)
        dataset = "references.h5" if exposure == 1000.0 else f"train_{number}.h5"
        training[number] = chain.step(
            f"train_{number}",
            ["train", at(dataset), "-o", at(f"runs_{number}"), *common, "--networks", str(plan.networks),
             "--workers", str(plan.workers), "--steps", str(steps), "--start-from", start],
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


def _shared_start(chain: Chain, plan: DemoPlan, common: Sequence[str]) -> dict[str, Any]:
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


def _mix(chain: Chain, sources: Sequence[str], out: str) -> None:
    """One dataset out of several, made by the library: the command line has no word for it."""
    from ..acquisition.dataset_io import concatenate_datasets, read_dataset

    if Path(chain.path(out)).exists():
        return
    chain.tell(f"joining {', '.join(sources)} into {out}")
    with contextlib.ExitStack() as stack:
        opened = [stack.enter_context(read_dataset(chain.path(source))) for source in sources]
        concatenate_datasets(opened, chain.path(out))


def _pod(chain: Chain, name: str) -> dict[str, Any]:
    """POD answer of a hit table, or why there is none (all hit, all missed)."""
    return {"a90": None} | chain.step_or_reason(
        f"pod_{name}", ["pod", chain.path(f"hits_{name}.csv"), "--size", "contrast"]
    )


def _compared(chain: Chain, number: str) -> dict[str, Any]:
    words = ["compare", chain.path(f"hits_real_{number}.csv"), chain.path(f"hits_test_{number}.csv")]
    return chain.step_or_reason(f"compare_{number}", words)


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
            sd = (estimate["high"] - estimate["low"]) / (2 * Z95)
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

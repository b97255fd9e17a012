"""Generated frames against the virtual lab's own frames of the same scenes: mean, variance, neighbour covariances.

    python validation/generated_against_lab.py [--seeds 3] [--frames 200] [--size 64x80] [--json FILE]

For each hidden system: calibrate a twin; measure two products (one with bone) at 20, 50 and 100 ms, many frames each,
and as many independent 1 s references (ten frames of 100 ms); generate frames at the three exposures from the references,
each of which is used once. Pixels are sorted by signal: open field, then four bands inside the product. Variances and
covariances are over frames, pixel by pixel, then averaged over the band. `as_published` is the paper's recipe on the
same references. Errors of a covariance are in % of the lab's variance; the last columns are what chance alone gives.
"""

import argparse
import json
import math
import re
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.dataset_io import DatasetRow, read_dataset, write_dataset
from raytwin.acquisition.pairs import flat_corrected_log, replace_bad_pixels
from raytwin.acquisition.setting import Setting
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.generator.datasets.generate import RECIPES, generate_dataset
from raytwin.generator.line.twin import Twin
from raytwin.generator.spread.psf import noise_autocovariance
from raytwin.lab.bench import Bench, render
from raytwin.lab.protocols import CORRECTION_FRAMES, make_plan, run_protocol, system_of_seed
from raytwin.lab.unkindness import NONE

EXPOSURES_MS = (20.0, 50.0, 100.0)
LAGS = ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2))
BANDS = 4


class Moments:
    """Sums over frames of one channel: mean and lagged temporal covariances per pixel."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.n = 0
        self.shape = shape
        self.total = np.zeros(shape)
        self.products = [np.zeros(shape) for _ in LAGS]
        self.centre: NDArray[np.float64] | None = None

    def add(self, frame: NDArray[Any]) -> None:
        if self.centre is None:
            self.centre = frame.astype(np.float64)
        deviation = frame - self.centre
        self.n += 1
        self.total += deviation
        for (dy, dx), product in zip(LAGS, self.products, strict=True):
            rows, columns = self.shape
            product[: rows - dy, : columns - dx] += deviation[: rows - dy, : columns - dx] * deviation[dy:, dx:]

    @property
    def mean(self) -> NDArray[np.float64]:
        assert self.centre is not None
        return np.asarray(self.centre + self.total / self.n)

    def covariance(self, lag: tuple[int, int]) -> NDArray[np.float64]:
        """Unbiased covariance of each pixel with its neighbour at `lag`; NaN beyond the border."""
        dy, dx = lag
        rows, columns = self.shape
        result = np.full(self.shape, np.nan)
        first = self.total[: rows - dy, : columns - dx]
        second = self.total[dy:, dx:]
        product = self.products[LAGS.index(lag)][: rows - dy, : columns - dx]
        result[: rows - dy, : columns - dx] = (product - first * second / self.n) / (self.n - 1)
        return result


def run_seed(seed: int, *, rows: int, columns: int, frames: int) -> list[dict[str, Any]]:
    """Rows `{seed, scene, kV, exposure_ms, band, signal_DN, recipe, mean, variance, covariances}` of one system."""
    # the plain line: what is compared is the generation, not how well a line is calibrated
    system = replace(system_of_seed(seed, rows=rows, columns=columns, families=()), unkindness=NONE)
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session.h5"
        run_protocol(session, protocol="calibration", seed=seed, system=system, frames=20)
        with open_acquisition(session) as acquisition:
            twin = calibrate_twin(acquisition, rng=np.random.default_rng(seed))
        plan = make_plan("set2", system=system, rng=np.random.default_rng([seed, 9]), products=2)
        bench = Bench(system, rng=np.random.default_rng([seed, 10]))
        bad = twin.maps.bad_pixels > 0
        pair = {
            plane: next(take.setting for take in plan.takes if take.kind == "object" and take.setting.kV == kV)
            for plane, kV in enumerate((40.0, 90.0))
        }
        reference = {plane: replace(setting, exposure_ms=100.0, averaged=10) for plane, setting in pair.items()}
        dark = next(bench.dark(100.0, frames=1, averaged=CORRECTION_FRAMES))[0]
        flat = {
            plane: next(bench.expose(replace(setting, exposure_ms=100.0, averaged=CORRECTION_FRAMES), frames=1))[0]
            for plane, setting in pair.items()
        }
        for name, product in plan.scenes.items():
            scene = render(system, product)
            inside = np.zeros((rows, columns), dtype=bool)
            path = Path(folder) / f"references_{name}.h5"
            with write_dataset(path, shape=(rows, columns), provenance={}) as writer:
                streams = [bench.expose(reference[plane], frames=frames, scene=scene) for plane in (0, 1)]
                for number, ((low, _), (high, _)) in enumerate(zip(*streams, strict=True)):
                    images = [
                        replace_bad_pixels(flat_corrected_log(counts, dark_DN=dark, flat_DN=flat[plane]), bad)
                        for plane, counts in enumerate((low, high))
                    ]
                    inside = images[0] > 0.05 if number == 0 else inside
                    writer.append(
                        image=np.stack(images),
                        foreign_object_mask=np.zeros((rows, columns)),
                        product_mask=inside,
                        row=DatasetRow(image=f"{name}-{number}", setting=f"{reference[0]};{reference[1]}"),
                    )
            for exposure_ms in EXPOSURES_MS:
                targets = [replace(pair[plane], exposure_ms=exposure_ms, averaged=1) for plane in (0, 1)]
                lab = []
                for target in targets:
                    moments = Moments((rows, columns))
                    for frame, _ in bench.expose(target, frames=frames, scene=scene):
                        moments.add(frame)
                    lab.append(moments)
                generated = {recipe: generate(twin, path, targets, recipe, frames, folder) for recipe in RECIPES}
                dark_here = bench.maps.dark_DN + bench.maps.dark_current_DN_per_ms * exposure_ms
                for plane in (0, 1):
                    results += compare_bands(
                        lab[plane],
                        {recipe: generated[recipe][plane] for recipe in RECIPES},
                        dark_here=dark_here,
                        good=~bad & ~_near(bad),
                        sigma_px=system.psf_sigma_px,
                        labels={"seed": seed, "scene": name, "kV": pair[plane].kV, "exposure_ms": exposure_ms},
                    )
    return results


def _near(bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(bad, iterations=2))


def generate(
    twin: Twin, references: Path, targets: list[Setting], recipe: str, frames: int, folder: str
) -> list[Moments]:
    """Moments of the generated counts, one a channel."""
    out = Path(folder) / "generated.h5"
    with read_dataset(references) as dataset:
        generate_dataset(twin, dataset, out, low=targets[0], high=targets[1], images=frames, seed=1, recipe=recipe)
    with read_dataset(out) as dataset:
        moments = [Moments(dataset.shape), Moments(dataset.shape)]
        for number in range(len(dataset)):
            counts = dataset.counts(number)
            assert counts is not None
            for plane in (0, 1):
                moments[plane].add(counts[plane])
    return moments


def compare_bands(
    lab: Moments,
    generated: dict[str, Moments],
    *,
    dark_here: NDArray[np.floating],
    good: NDArray[np.bool_],
    sigma_px: float,
    labels: dict[str, Any],
) -> list[dict[str, Any]]:
    """Errors of each recipe per band of signal, in %."""
    signal = lab.mean - dark_here
    top = float(np.quantile(signal[good], 0.99))
    product = good & (signal < 0.9 * top)
    edges = np.quantile(signal[product], np.linspace(0, 1, BANDS + 1))
    bands = {"open field": good & (signal >= 0.93 * top)}
    for index in range(BANDS):
        bands[f"product {index + 1}"] = product & (signal >= edges[index]) & (signal <= edges[index + 1])
    rho = noise_autocovariance("aperture", sigma_px, 8)
    correlated = float(np.sum(rho**2) / rho[8, 8] ** 2)
    rows = []
    for band, mask in bands.items():
        pixels = int(mask.sum())
        if pixels < 20:
            continue
        variance = float(np.mean(lab.covariance((0, 0))[mask]))
        chance_variance = 100 * math.sqrt(2.0 * 2.0 * correlated / (lab.n * pixels))
        for recipe, moments in generated.items():
            row = {
                **labels,
                "band": band,
                "pixels": pixels,
                "signal_DN": float(np.mean(signal[mask])),
                "recipe": recipe,
                "mean_percent": 100 * float(np.mean((moments.mean - lab.mean)[mask]) / np.mean(signal[mask])),
                "chance_mean_percent": 100
                * math.sqrt(2 * variance / rho[8, 8] / (lab.n * pixels))
                / float(np.mean(signal[mask])),
                "chance_variance_percent": chance_variance,
            }
            for lag in LAGS:
                difference = (moments.covariance(lag) - lab.covariance(lag))[mask]
                row[f"covariance_{lag[0]}{lag[1]}_percent"] = 100 * float(np.nanmean(difference)) / variance
            rows.append(row)
    return rows


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean and rms error over seeds and scenes, per recipe, kV, exposure and band."""
    keys = ("recipe", "kV", "exposure_ms", "band")
    table = []
    for key in dict.fromkeys(tuple(row[k] for k in keys) for row in rows):
        chosen = [row for row in rows if tuple(row[k] for k in keys) == key]
        entry: dict[str, Any] = dict(zip(keys, key, strict=True))
        weight = np.array([row["pixels"] for row in chosen], dtype=np.float64)
        for name in ("signal_DN", "mean_percent", *(f"covariance_{dy}{dx}_percent" for dy, dx in LAGS)):
            entry[name] = float(np.average([row[name] for row in chosen], weights=weight))
        for name in ("chance_mean_percent", "chance_variance_percent"):
            entry[name] = 1.0 / math.sqrt(sum(1.0 / row[name] ** 2 for row in chosen))
        table.append(entry)
    return sorted(table, key=lambda entry: RECIPES.index(entry["recipe"]))


def print_table(table: list[dict[str, Any]]) -> None:
    """The summary for people."""
    lags = "".join(f"{f'cov {dy},{dx}':>9}" for dy, dx in LAGS[1:])
    heads = f"{'recipe':<13}{'kV':>4}{'ms':>5} {'band':<12}{'DN':>8}{'mean':>8}{'variance':>10}"
    print(f"{heads}{lags}  chance: mean, variance")
    for row in table:
        covariances = "".join(f"{row[f'covariance_{dy}{dx}_percent']:>9.2f}" for dy, dx in LAGS[1:])
        print(
            f"{row['recipe']:<13}{row['kV']:>4.0f}{row['exposure_ms']:>5.0f} {row['band']:<12}{row['signal_DN']:>8.0f}"
            f"{row['mean_percent']:>8.2f}{row['covariance_00_percent']:>10.2f}{covariances}"
            f"  {row['chance_mean_percent']:.2f}, {row['chance_variance_percent']:.2f}"
        )


def main() -> int:
    """Run the seeds and print the table (all errors in %)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", default="64x80")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    match = re.fullmatch(r"(\d+)x(\d+)", arguments.size)
    if match is None:
        parser.error("--size is ROWSxCOLUMNS")
    rows: list[dict[str, Any]] = []
    for seed in tqdm(range(arguments.first, arguments.first + arguments.seeds), disable=None, file=sys.stderr):
        rows += run_seed(seed, rows=int(match[1]), columns=int(match[2]), frames=arguments.frames)
    table = summarise(rows)
    print_table(table)
    ours = [entry for entry in table if entry["recipe"] == "raytwin"]
    for name in ("mean_percent", *(f"covariance_{dy}{dx}_percent" for dy, dx in LAGS)):
        print(f"largest |{name}|, raytwin: {max(abs(entry[name]) for entry in ours):.2f}")
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"table": table, "rows": rows}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Reference images brought to another tube voltage and filter, against the virtual lab's own images there.

    python validation/reference_transfer.py [--seeds 3] [--frames 60] [--size 64x80] [--json FILE]

For each hidden system: calibrate a twin (flats at 40 and 90 kV behind 50 um Cu only); measure products with bones of 1.5, 2
and 3 mm as many independent 1 s pairs at 40 and 90 kV; bring each pair to 60 and 120 kV, and to 40 and 90 kV behind 2 mm Al,
at 20 and 100 ms; and expose the same products there. What is right on average is the mean of 30 000 exposures of 100 ms.

Per system, target, tube voltage and quarter of the product's thickness: bias of the log image in % of M; standard deviation
of the transmission over frames, generated over measured, in %; covariance with the neighbours less the lab's, in % of the
variance; correlation of the two channels (a detector has none). For each bone: its contrast in M against the ring around
it, and Delta R, transferred from a reference of 30 000 frames, so that neither noise nor its bias enters, over measured.
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
from scipy.ndimage import binary_dilation
from tqdm import tqdm

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.contrast import delta_r, dilations_for_pixel
from raytwin.acquisition.pairs import flat_corrected_log, replace_bad_pixels
from raytwin.acquisition.setting import Filter, Setting
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.generator.datasets.generate import PairTransfer
from raytwin.lab.bench import Bench, render
from raytwin.lab.objects import BONE_MATERIAL, pixel_means
from raytwin.lab.protocols import CORRECTION_FRAMES, make_plan, run_protocol, system_of_seed
from raytwin.lab.unkindness import NONE

COPPER = (Filter(material="Cu", thickness_mm=0.05),)
REFERENCE = (
    Setting(kV=40, power_W=40, exposure_ms=100, filters=COPPER, averaged=10),
    Setting(kV=90, power_W=45, exposure_ms=100, filters=COPPER, averaged=10),
)
TARGETS = {
    "60/120 kV Cu": (
        Setting(kV=60, power_W=40, exposure_ms=20, filters=COPPER),
        Setting(kV=120, power_W=45, exposure_ms=20, filters=COPPER),
    ),
    "40/90 kV Al 2": (
        Setting(kV=40, power_W=20, exposure_ms=20, filters=(Filter(material="Al", thickness_mm=2),)),
        Setting(kV=90, power_W=20, exposure_ms=20, filters=(Filter(material="Al", thickness_mm=2),)),
    ),
}
EXPOSURES_MS = (20.0, 100.0)
BONES_MM = (1.5, 2.0, 3.0)
BANDS = 4
LAB_FRAMES = 30000
LAGS = ((0, 1), (1, 0), (1, 1), (0, 2))


class Spread:
    """Mean, variance, neighbour and cross-channel covariance over frames of pairs (2, row, column)."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.n = 0
        self.total = np.zeros(shape)
        self.square = np.zeros(shape)
        self.cross = np.zeros(shape[1:])
        self.lagged = [np.zeros(shape) for _ in LAGS]
        self.centre = np.zeros(shape)

    def add(self, pair: NDArray[Any]) -> None:
        if self.n == 0:
            self.centre = pair.astype(np.float64)
        deviation = pair - self.centre
        self.n += 1
        self.total += deviation
        self.square += deviation**2
        self.cross += deviation[0] * deviation[1]
        for (dy, dx), sums in zip(LAGS, self.lagged, strict=True):
            rows, columns = deviation.shape[1:]
            sums[:, : rows - dy, : columns - dx] += deviation[:, : rows - dy, : columns - dx] * deviation[:, dy:, dx:]

    @property
    def mean(self) -> NDArray[np.float64]:
        return np.asarray(self.centre + self.total / self.n)

    @property
    def variance(self) -> NDArray[np.float64]:
        return np.asarray((self.square - self.total**2 / self.n) / (self.n - 1))

    @property
    def covariance(self) -> NDArray[np.float64]:
        return np.asarray((self.cross - self.total[0] * self.total[1] / self.n) / (self.n - 1))

    def neighbours(self, number: int) -> NDArray[np.float64]:
        """Covariance with the neighbour at LAGS[number]; NaN beyond the border."""
        dy, dx = LAGS[number]
        rows, columns = self.total.shape[1:]
        result = np.full(self.total.shape, np.nan)
        first, second = self.total[:, : rows - dy, : columns - dx], self.total[:, dy:, dx:]
        result[:, : rows - dy, : columns - dx] = (
            self.lagged[number][:, : rows - dy, : columns - dx] - first * second / self.n
        ) / (self.n - 1)
        return result


def run_seed(seed: int, *, rows: int, columns: int, frames: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows per band and rows per bone of one system."""
    # the plain line: what is compared is the generation, not how well a line is calibrated
    system = replace(system_of_seed(seed, rows=rows, columns=columns, families=()), unkindness=NONE)
    bands: list[dict[str, Any]] = []
    bones: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session.h5"
        run_protocol(session, protocol="calibration", seed=seed, system=system, frames=20)
        with open_acquisition(session) as acquisition:
            twin = calibrate_twin(acquisition, rng=np.random.default_rng(seed))
    plan = make_plan(
        "set2", system=system, rng=np.random.default_rng([seed, 9]), products=len(BONES_MM) + 1, bones_mm=BONES_MM
    )
    bench = Bench(system, rng=np.random.default_rng([seed, 10]))
    bad = twin.maps.bad_pixels > 0
    good = ~np.asarray(binary_dilation(bad, iterations=2))
    dilations = dilations_for_pixel(system.pixel_mm)

    def averaged(setting: Setting, count: int, scene: Any = None) -> NDArray[np.float64]:
        frame, _ = next(bench.expose(replace(setting, averaged=count), frames=1, scene=scene))
        return frame.astype(np.float64)

    dark = {
        exposure_ms: next(bench.dark(exposure_ms, frames=1, averaged=LAB_FRAMES))[0].astype(np.float64)
        for exposure_ms in {100.0, *EXPOSURES_MS}
    }
    reference_dark = next(bench.dark(100.0, frames=1, averaged=CORRECTION_FRAMES))[0]
    reference_flat = [averaged(setting, CORRECTION_FRAMES) for setting in REFERENCE]
    scenes = {name: (render(system, product), product) for name, product in plan.scenes.items()}
    pairs: dict[str, list[NDArray[np.float32]]] = {}
    for name, (scene, _) in scenes.items():
        planes = [
            [
                replace_bad_pixels(
                    flat_corrected_log(counts, dark_DN=reference_dark, flat_DN=reference_flat[plane]), bad
                )
                for counts, _ in bench.expose(setting, frames=frames, scene=scene)
            ]
            for plane, setting in enumerate(REFERENCE)
        ]
        pairs[name] = [np.stack(both) for both in zip(*planes, strict=True)]
    quiet = {
        name: np.stack(
            [
                replace_bad_pixels(
                    flat_corrected_log(
                        averaged(setting, LAB_FRAMES, scene), dark_DN=dark[100.0], flat_DN=averaged(setting, LAB_FRAMES)
                    ),
                    bad,
                )
                for setting in REFERENCE
            ]
        )
        for name, (scene, _) in scenes.items()
    }
    quiet_settings = (replace(REFERENCE[0], averaged=LAB_FRAMES), replace(REFERENCE[1], averaged=LAB_FRAMES))
    for label, base in TARGETS.items():
        long = tuple(replace(one, exposure_ms=100.0) for one in base)
        flat_long = np.stack([averaged(one, LAB_FRAMES) for one in long]) - dark[100.0]
        exact_of = {
            name: np.stack([averaged(one, LAB_FRAMES, scene) for one in long]) - dark[100.0]
            for name, (scene, _) in scenes.items()
        }
        for exposure_ms in EXPOSURES_MS:
            targets = tuple(replace(one, exposure_ms=exposure_ms) for one in base)
            transfer = PairTransfer(twin, low=targets[0], high=targets[1])
            flat = flat_long * exposure_ms / 100.0
            for name, (scene, product) in scenes.items():
                exact = exact_of[name]
                exact_log = -np.log(np.maximum(exact, 1) / np.maximum(flat_long, 1))
                lab, made, carried = (Spread(exact.shape) for _ in range(3))
                streams = [bench.expose(one, frames=frames, scene=scene) for one in targets]
                open_DN = np.stack([model.open_signal_DN for model in transfer.models])
                target_dark = np.stack([model.dark_DN for model in transfer.models])
                rng = np.random.default_rng([seed, 11])
                warnings: tuple[str, ...] = ()
                for (low, _), (high, _), pair in zip(*streams, pairs[name], strict=True):
                    lab.add((np.stack([low, high]) - dark[exposure_ms]) / np.maximum(flat, 1))
                    transferred, warnings = transfer.transfer(pair, REFERENCE)
                    carried.add(transferred.transmission)
                    made.add((transfer.draw(transferred, rng) - target_dark) / open_DN)
                inside = exact_log[0] > 0.05
                edges = np.quantile(exact_log[0][inside & good], np.linspace(0, 1, BANDS + 1))
                common = {"seed": seed, "target": label, "exposure_ms": exposure_ms, "scene": name}
                for band in range(-1, BANDS):
                    if band < 0:
                        mask = good & (exact_log[0] < 0.005)
                    else:
                        mask = good & inside & (exact_log[0] >= edges[band]) & (exact_log[0] <= edges[band + 1])
                    for plane, setting in enumerate(targets):
                        M_lab = exact_log[plane][mask]
                        variance = float(np.mean(lab.variance[plane][mask]))
                        row = {
                            **common,
                            "kV": setting.kV,
                            "band": "open field" if band < 0 else f"product {band + 1}",
                            "pixels": int(mask.sum()),
                            "M": float(np.mean(M_lab)),
                            "bias_M": float(-np.mean(np.log(made.mean[plane][mask])) - np.mean(M_lab)),
                            "bias_carried_M": float(-np.mean(np.log(carried.mean[plane][mask])) - np.mean(M_lab)),
                            "sd_percent": 100 * (math.sqrt(float(np.mean(made.variance[plane][mask])) / variance) - 1),
                            "carried_variance_percent": 100 * float(np.mean(carried.variance[plane][mask])) / variance,
                            "sd_chance_percent": 100 * math.sqrt(2.0 / (frames * int(mask.sum()))),
                            "correlation": float(
                                np.mean(made.covariance[mask])
                                / math.sqrt(np.mean(made.variance[0][mask]) * np.mean(made.variance[1][mask]))
                            ),
                            "warnings": list(warnings),
                        }
                        for number, lag in enumerate(LAGS):
                            difference = (made.neighbours(number) - lab.neighbours(number))[plane][mask]
                            row[f"covariance_{lag[0]}{lag[1]}_percent"] = 100 * float(np.nanmean(difference)) / variance
                        bands.append(row)
                if product.bone is not None:
                    thickness = pixel_means(system, scene.thickness_mm[BONE_MATERIAL])
                    made_log = -np.log(transfer.transfer(quiet[name], quiet_settings)[0].transmission)
                    bones.append(
                        {
                            **common,
                            "size_mm": product.bone.size_mm,
                            **_bone_contrast(exact_log, made_log, thickness > 0.3 * thickness.max(), dilations, good),
                        }
                    )
    return bands, bones


def _bone_contrast(
    lab: NDArray[np.float64],
    made: NDArray[np.float64],
    mask: NDArray[np.bool_],
    dilations: int,
    good: NDArray[np.bool_],
) -> dict[str, float]:
    """Contrast of the bone in M and Delta R of lab and generated images."""
    outer = binary_dilation(mask, iterations=2 + max(2, dilations // 2))
    ring = outer & ~binary_dilation(mask, iterations=2) & good
    answer: dict[str, float] = {"pixels": float(mask.sum())}
    for plane, name in enumerate(("low", "high")):
        values = []
        for image in (lab, made):
            # what the bone adds to a product that goes on as a plane of the ring's pixels
            y, x = np.nonzero(ring)
            columns = np.stack([np.ones_like(y), y, x], axis=1).astype(float)
            found = np.linalg.lstsq(columns, image[plane][ring], rcond=None)[0]
            y, x = np.nonzero(mask & good)
            values.append(float(np.mean(image[plane][mask & good] - (found[0] + found[1] * y + found[2] * x))))
        answer[f"contrast_{name}_lab"], answer[f"contrast_{name}_made"] = values
    answer["delta_r_lab"], answer["delta_r_made"] = (
        delta_r(image[0], image[1], mask, dilations=dilations) for image in (lab, made)
    )
    return answer


def summarise(bands: list[dict[str, Any]], bones: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per target, exposure and kV over systems and scenes: biases, noise and contrasts with their scatter."""
    table = []
    for key in dict.fromkeys((row["target"], row["exposure_ms"], row["kV"]) for row in bands):
        chosen = [row for row in bands if (row["target"], row["exposure_ms"], row["kV"]) == key]
        product = [row for row in chosen if row["band"] != "open field"]
        opened = [row for row in chosen if row["band"] == "open field"]
        weight = np.array([row["pixels"] for row in product], dtype=float)

        def mean(name: str, rows: list[dict[str, Any]] = product, weight: NDArray[Any] = weight) -> float:
            return float(np.average([row[name] for row in rows], weights=weight))

        by_system = [
            [100 * row["bias_carried_M"] / row["M"] for row in product if row["seed"] == seed and row["M"] > 0]
            for seed in sorted({row["seed"] for row in product})
        ]
        name = "low" if key[2] == min(row["kV"] for row in bands if row["target"] == key[0]) else "high"
        rated = [bone for bone in bones if (bone["target"], bone["exposure_ms"]) == key[:2]]
        lab = np.array([bone[f"contrast_{name}_lab"] for bone in rated])
        made = np.array([bone[f"contrast_{name}_made"] for bone in rated])
        table.append(
            {
                "target": key[0],
                "exposure_ms": key[1],
                "kV": key[2],
                "bias_percent_of_M": [float(np.mean(one)) for one in by_system],
                "bias_percent_of_M_worst_band": float(max((abs(v) for one in by_system for v in one), default=0.0)),
                "open_field_bias_M": float(np.mean([row["bias_carried_M"] for row in opened])) if opened else None,
                "sd_percent": mean("sd_percent"),
                "sd_percent_worst_system": float(
                    max(
                        (
                            np.average(
                                [row["sd_percent"] for row in product if row["seed"] == seed],
                                weights=[row["pixels"] for row in product if row["seed"] == seed],
                            )
                            for seed in {row["seed"] for row in product}
                        ),
                        key=abs,
                    )
                ),
                "sd_chance_percent": float(
                    100 * math.sqrt(1 / sum((100 / row["sd_chance_percent"]) ** 2 for row in product))
                ),
                "carried_variance_percent": mean("carried_variance_percent"),
                "correlation": mean("correlation"),
                **{f"covariance_{a}{b}_percent": mean(f"covariance_{a}{b}_percent") for a, b in LAGS},
                "contrast_percent": float(100 * (made.sum() / lab.sum() - 1)) if rated else None,
                "contrast_percent_each": (100 * (made / lab - 1)).round(2).tolist(),
                "bone_mm": [bone["size_mm"] for bone in rated],
                "delta_r_difference": [round(bone["delta_r_made"] - bone["delta_r_lab"], 5) for bone in rated],
                "delta_r_lab": [round(bone["delta_r_lab"], 4) for bone in rated],
            }
        )
    return table


def print_table(table: list[dict[str, Any]]) -> None:
    """The summary for people."""
    for row in table:
        print(f"{row['target']}, {row['exposure_ms']:g} ms, {row['kV']:g} kV")
        biases = ", ".join(f"{value:+.2f}" for value in row["bias_percent_of_M"])
        print(f"  bias, % of M, by system: {biases}; worst band {row['bias_percent_of_M_worst_band']:.2f}")
        print(
            f"  noise {row['sd_percent']:+.2f} % (worst system {row['sd_percent_worst_system']:+.2f}, chance"
            f" {row['sd_chance_percent']:.2f}); from the reference {row['carried_variance_percent']:.1f} % of the variance;"
            f" correlation of channels {row['correlation']:+.4f}; neighbours "
            + " ".join(f"{row[f'covariance_{a}{b}_percent']:+.2f}" for a, b in LAGS)
        )
        each = ", ".join(
            f"{size:g} mm {value:+.1f}"
            for size, value in zip(row["bone_mm"], row["contrast_percent_each"], strict=True)
        )
        print(f"  bones, % of contrast: all {row['contrast_percent']:+.2f}; {each}")
        print(f"  open field: bias of M {row['open_field_bias_M']:+.5f}")
        print(f"  Delta R {row['delta_r_lab']} off by {row['delta_r_difference']}")


def main() -> int:
    """Run the systems and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", default="64x80")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    match = re.fullmatch(r"(\d+)x(\d+)", arguments.size)
    if match is None:
        parser.error("--size is ROWSxCOLUMNS")
    bands: list[dict[str, Any]] = []
    bones: list[dict[str, Any]] = []
    for seed in tqdm(range(arguments.first, arguments.first + arguments.seeds), disable=None, file=sys.stderr):
        more = run_seed(seed, rows=int(match[1]), columns=int(match[2]), frames=arguments.frames)
        bands += more[0]
        bones += more[1]
    table = summarise(bands, bones)
    print_table(table)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"table": table, "bands": bands, "bones": bones}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

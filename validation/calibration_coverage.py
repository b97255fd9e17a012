"""Calibration against the truth of the virtual lab: errors, and how often the stated 95 % intervals hold the truth.

    python validation/calibration_coverage.py [--seeds 40] [--first 0] [--size 64] [--frames 20] [--json FILE]
        [--sessions FOLDER] [--protocol two_voltages] [--family NAME]... [--leave-out NAME]... [--no-unkindness]

Each seed is another hidden system with its unkindness, drawn from all families of tubes and detectors, from those that
`--family` names alone (none: the plain line), or from all but those that `--leave-out` names. Protocols say which flats
calibrate (40 and 90 kV behind 0.05 mm Cu; these and 1 mm Al; these and 60 kV; 90 kV alone), the others being predicted; or
that flats are stored as averages, once or in pairs. A system that could not be calibrated is a row of its own:
what is not answered covers nothing. `z` is (answer - truth) over the interval's half width / 1.96: its spread should be
1 where only sampling noise is at work and below 1 where the interval carries systematic uncertainty. `predicted` rows
compare predictions at settings that the calibration never saw with the lab's noise-free expectation, `validate` rows
compare with measured frames as `raytwin validate` does.
"""

import argparse
import json
import math
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta
from tqdm import tqdm

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.setting import text_from_filters
from raytwin.calibration.calibrate import calibrate_twin, calibration_answer
from raytwin.calibration.validate import validate_twin
from raytwin.errors import InputError, RaytwinError
from raytwin.files import whole_file
from raytwin.generator.line.twin import Z95
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.lab.families import FAMILIES
from raytwin.lab.protocols import run_protocol, truth_path
from raytwin.lab.unkindness import NONE

# beams that calibrate; the lab's session is the same for all of them
COPPER = "Cu:0.05"
PROTOCOLS: dict[str, tuple[tuple[float, str], ...]] = {
    "two_voltages": ((40.0, COPPER), (90.0, COPPER)),
    "foils": ((40.0, COPPER), (90.0, COPPER), (40.0, "Al:1"), (90.0, "Al:1")),
    "three_voltages": ((40.0, COPPER), (60.0, COPPER), (90.0, COPPER)),
    "one_voltage": ((90.0, COPPER),),
}


class Part:
    """A session whose flats calibrate where their beam is among some; of beams that are not, one series of each is predicted."""

    def __init__(self, acquisition: Any, beams: tuple[tuple[float, str], ...]) -> None:
        self.path, self.paths = acquisition.path, acquisition.paths
        self.instrument, self.scenes = acquisition.instrument, acquisition.scenes
        kept: list[Any] = []
        longest: dict[tuple[float, str], Any] = {}
        for item in acquisition.series:
            beam = (item.kV, text_from_filters(item.filters))
            if item.kind != "flat" or (beam in beams and item.role == "calibration"):
                kept.append(item)
            elif beam in beams and beam not in {(40.0, COPPER), (90.0, COPPER)}:
                kept.append(replace(item, role="calibration"))
            elif item.role == "evaluation":
                kept.append(item)
            else:
                longest[beam] = replace(item, role="evaluation")
        self.series = tuple(sorted([*kept, *longest.values()], key=lambda item: item.index))

    def of_kind(self, *kinds: str) -> tuple[Any, ...]:
        """Series of some kinds."""
        return tuple(item for item in self.series if item.kind in kinds)


def measure_seed(
    seed: int,
    *,
    size: int,
    frames: int,
    sessions: Path | None = None,
    protocol: str = "two_voltages",
    families: tuple[str, ...] | None = None,
    unkind: bool = True,
) -> list[dict[str, Any]]:
    """Rows `{quantity, seed, truth, value, low, high}` of one hidden system."""
    rows: list[dict[str, Any]] = []

    def add(quantity: str, truth: float | None, estimate: dict[str, float] | None, label: str = "") -> None:
        if estimate is not None and truth is not None:
            rows.append({"quantity": quantity, "seed": seed, "label": label, "truth": truth, **estimate})

    with tempfile.TemporaryDirectory() as folder:
        drawn = "all" if families is None else "_".join(families) or "none"
        session = "calibration" if protocol in PROTOCOLS else protocol
        name = f"{session}_{seed}_{size}_{frames}_{drawn}{'' if unkind else '_plain'}.h5"
        path = (sessions or Path(folder)) / name
        if truth_path(path).exists():
            truth = json.loads(truth_path(path).read_text(encoding="utf-8"))
        else:
            truth = run_protocol(
                path,
                protocol=session,
                seed=seed,
                rows=size,
                columns=size,
                frames=frames,
                families=families,
                unkindness=None if unkind else NONE,
            )
        with open_acquisition(path) as whole:
            acquisition: Any = Part(whole, PROTOCOLS[protocol]) if protocol in PROTOCOLS else whole
            twin = calibrate_twin(acquisition, rng=np.random.default_rng(seed))
            try:
                compared = validate_twin(twin, acquisition).rows
            except InputError:  # single averaged flats have no noise to compare
                compared = ()
            settings = {item.name: item.setting for item in acquisition.series}
    answer = calibration_answer(twin)
    add("psf_sigma_px", truth["psf_sigma_px"], answer["psf_sigma_px"])
    add("read_noise_DN", truth["read_noise_DN"], answer["read_noise_DN"])
    dark = {entry["exposure_ms"]: entry["dark_DN"] for entry in truth["dark_DN_at"]}
    add("dark_DN", dark[twin.maps.dark_exposure_ms], answer["dark_DN"])
    add("inherent_filtration_mm_Al", truth["inherent_filtration_mm_Al"], answer["inherent_filtration_mm_Al"])
    add("flux_scale", truth["flux_scale"], answer["flux_scale"])
    exact = {(level["kV"], level["filter"]): level for level in truth["levels"]}
    measured = [exact[level["kV"], level["filter"]]["photon_transfer_slope_DN"] for level in answer["levels"]]
    # what follows the signal is quanta, whose correlation the truth has, and the white noise of electrons
    of_quanta = float(np.mean([1.0 - truth["DN_per_electron"] / slope for slope in measured]))
    exact_at = {(one["lag_row"], one["lag_column"]): of_quanta * one["value"] for one in truth["noise_correlation"]}
    for one in answer["evidence"].get("noise_correlation") or []:
        lag = one["lag_row"], one["lag_column"]
        if lag in exact_at:
            estimate = {name: one[name] for name in ("value", "low", "high")}
            add("noise_correlation", exact_at[lag], estimate, f"{lag[0]},{lag[1]}")
    for level in answer["levels"]:
        true_level = exact[level["kV"], level["filter"]]
        for name in ("gain_DN", "photon_transfer_slope_DN"):
            if level[name] is None:
                continue
            estimate = {"value": level[name], "low": level[f"{name}_low"], "high": level[f"{name}_high"]}
            add(name, true_level[name], estimate, f"{level['kV']:g} kV")
    for row in compared:
        expected = truth["series"][row.series]
        prediction = predict_flatfield(twin, settings[row.series])
        new = "measured beam" if prediction.measured_level else "new beam"
        for name in ("mean_DN", "sd_DN", "gain_DN", "photons_absorbed"):
            estimate = getattr(prediction, name)
            if estimate is None:
                continue
            add(f"predicted {name}, {new}", expected[name], estimate.as_dict(), row.series)
        add(f"validate mean_DN, {new}", row.measured_mean_DN, row.predicted_mean_DN.as_dict(), row.series)
        add(f"validate sd_DN, {new}", row.measured_sd_DN, row.predicted_sd_DN.as_dict(), row.series)
    return rows


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per quantity: number, bias and rms error (%), coverage (%) with its 95 % interval, mean width, spread of z."""
    table = []
    for quantity in dict.fromkeys(row["quantity"] for row in rows):
        chosen = [row for row in rows if row["quantity"] == quantity]
        truth, value, low, high = (np.array([row[key] for row in chosen]) for key in ("truth", "value", "low", "high"))
        relative = value / truth - 1.0
        inside = int(np.sum((low <= truth) & (truth <= high)))
        n = len(chosen)
        z = (value - truth) / np.maximum((high - low) / (2 * Z95), 1e-300)
        table.append(
            {
                "quantity": quantity,
                "n": n,
                "bias_percent": 100 * float(np.mean(relative)),
                "rms_percent": 100 * math.sqrt(float(np.mean(relative**2))),
                "coverage_percent": 100 * inside / n,
                "coverage_low": 100 * float(beta.ppf(0.025, inside, n - inside + 1)) if inside else 0.0,
                "coverage_high": 100 * float(beta.ppf(0.975, inside + 1, n - inside)) if inside < n else 100.0,
                "half_width_percent": 100 * float(np.mean((high - low) / 2 / truth)),
                "z_mean": float(np.mean(z)),
                "z_sd": float(np.std(z)),
                # in half-widths: no value may be off by more than three
                "worst_half_widths": float(np.max(np.abs(z))) / Z95,
            }
        )
    return table


def print_table(table: list[dict[str, Any]]) -> None:
    """The summary for people."""
    print(
        f"{'quantity':<42} {'n':>4} {'bias %':>8} {'rms %':>7} {'half width %':>12} {'coverage % (95 %)':>22} {'z':>13}"
        f" {'worst':>6}"
    )
    for row in table:
        coverage = f"{row['coverage_percent']:.1f} ({row['coverage_low']:.0f}-{row['coverage_high']:.0f})"
        print(
            f"{row['quantity']:<42} {row['n']:>4} {row['bias_percent']:>8.3f} {row['rms_percent']:>7.3f}"
            f" {row['half_width_percent']:>12.3f} {coverage:>22} {row['z_mean']:>6.2f} +-{row['z_sd']:.2f}"
            f" {row['worst_half_widths']:>6.2f}"
        )


def kept_rows(path: Path | None, drawn: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows and failures of systems that an earlier run of the same options left in the file."""
    if path is None or not path.exists():
        return [], []
    kept = json.loads(path.read_text(encoding="utf-8"))
    if kept["drawn"] != drawn:
        raise SystemExit(f"{path} holds systems drawn otherwise: {kept['drawn']}")
    return kept["rows"], kept["failed"]


def keep(path: Path, drawn: dict[str, Any], rows: list[dict[str, Any]], failed: list[dict[str, Any]]) -> None:
    """Write what there is, so that a stopped run goes on from there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    answer = {"drawn": drawn, "table": summarise(rows), "rows": rows, "failed": failed}
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(answer, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    """Run the seeds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--sessions", type=Path, help="folder where lab sessions are kept for the next run")
    parser.add_argument("--protocol", default="two_voltages", choices=(*PROTOCOLS, "averaged", "averaged_pairs"))
    parser.add_argument("--family", action="append", help="draw from these families alone; none: the plain line")
    parser.add_argument("--leave-out", action="append", default=[], help="families not to draw from")
    parser.add_argument("--no-unkindness", action="store_true")
    parser.add_argument("--minutes", type=float, help="begin no system after so long")
    parser.add_argument("--json", type=Path, help="results; a stopped run goes on from what stands there")
    arguments = parser.parse_args()
    families = None if arguments.family is None else tuple(name for name in arguments.family if name != "none")
    if arguments.leave_out:
        families = tuple(name for name in families or FAMILIES if name not in arguments.leave_out)
    drawn = {
        "size": arguments.size,
        "frames": arguments.frames,
        "protocol": arguments.protocol,
        "families": None if families is None else list(families),
        "unkind": not arguments.no_unkindness,
    }
    rows, failed = kept_rows(arguments.json, drawn)
    done = {row["seed"] for row in (*rows, *failed)}
    wanted = range(arguments.first, arguments.first + arguments.seeds)
    started = time.perf_counter()
    for seed in tqdm([seed for seed in wanted if seed not in done], disable=None, file=sys.stderr):
        if arguments.minutes is not None and time.perf_counter() - started > 60.0 * arguments.minutes:
            break
        try:
            rows += measure_seed(
                seed,
                size=arguments.size,
                frames=arguments.frames,
                sessions=arguments.sessions,
                protocol=arguments.protocol,
                families=families,
                unkind=not arguments.no_unkindness,
            )
        except RaytwinError as error:
            failed.append({"seed": seed, "error": str(error)})
        if arguments.json is not None:
            keep(arguments.json, drawn, rows, failed)
    table = summarise(rows)
    systems = len({row["seed"] for row in (*rows, *failed)})
    print(
        f"{systems} hidden systems, {arguments.size} x {arguments.size} pixels, {arguments.frames} frames a"
        f" series, {time.perf_counter() - started:.0f} s"
    )
    print_table(table)
    for one in failed:
        print(f"seed {one['seed']}: {one['error']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Predictions at settings never measured, against the virtual lab's truth and against what any method could reach.

    python validation/prediction_limit.py [--systems 200] [--first 1000] [--processes 2] [--adc fine|coarse]
        [--folder build/prediction_limit] [--json FILE] [--no-next]

Each system is drawn: tube filtration, scintillator, kV offset, output, gain, Swank factor, spread, read noise. One
session a system holds darks and flats; a protocol is a part of them:

    A  40 and 90 kV behind 0.05 mm Cu             B  40 and 90 kV, with 0.05 mm Cu and without
    C  40, 70 and 110 kV, with and without        D  90 kV behind 0.05 mm Cu

A twin is calibrated from each part and predicts twelve settings (50 to 120 kV; Cu 0 to 0.5 mm, Al 0 to 2 mm; other
currents, exposures, distances, averages). The truth is the lab's own noise-free expectation.

The limit of a system and setting is the standard deviation that a linear and Gaussian estimate reaches, knowing all
derivatives: measured levels and noise with their sampling errors, priors of the unknowns as they are stated, nuisances
for attenuation tables, spectrum models, escape, voltage and single levels' discrepancy. It is computed here from the
lab's own sums over energy, without the twin's code; only the priors' widths are the twin's.

Results of a system are kept as one line of a file in `--folder`, so that a run that was stopped goes on.
"""

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.setting import Filter, Setting, filters_from_text, setting_from_text, text_from_filters
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.calibration.priors import ATTENUATION_SCALE, GAIN_DISCREPANCY, LEVEL_DISCREPANCY, PRIORS, TABLE_SHARE
from raytwin.generator.predict import predict_flatfield
from raytwin.lab.attenuation import composition, mu_per_mm
from raytwin.lab.bench import Bench
from raytwin.lab.response import beam_of, compute_deposits
from raytwin.lab.system import LabSystem, detector_maps, sample_system
from raytwin.lab.truth import flat_truth

SIZE = 28
FRAMES = 96
POWER_W = {40.0: 60.0, 70.0: 50.0, 90.0: 40.0, 110.0: 40.0}
COPPER = "Cu:0.05"
PROTOCOLS: dict[str, tuple[tuple[float, str], ...]] = {
    "A": ((40.0, COPPER), (90.0, COPPER)),
    "B": ((40.0, COPPER), (90.0, COPPER), (40.0, ""), (90.0, "")),
    "C": tuple((kV, layers) for kV in (40.0, 70.0, 110.0) for layers in (COPPER, "")),
    "D": ((90.0, COPPER),),
}
SETTINGS = tuple(
    setting_from_text(text)
    for text in (
        "kv=50,power_w=40,exposure_ms=20",
        "kv=50,power_w=60,exposure_ms=50,filter=Cu:0.1",
        "kv=60,power_w=30,exposure_ms=20,filter=Cu:0.05",
        "kv=60,power_w=50,exposure_ms=30,filter=Al:1,averaged=4",
        "kv=70,power_w=80,exposure_ms=100,filter=Cu:0.5",
        "kv=75,power_w=40,exposure_ms=10,filter=Al:2",
        "kv=80,power_w=20,exposure_ms=20,filter=Cu:0.1,source_detector_mm=4000",
        "kv=90,power_w=60,exposure_ms=50,filter=Cu:0.05+Al:1",
        "kv=100,power_w=25,exposure_ms=20",
        "kv=100,power_w=85,exposure_ms=50,filter=Cu:0.5,averaged=10",
        "kv=120,power_w=30,exposure_ms=15,filter=Al:2",
        "kv=120,power_w=40,exposure_ms=20,filter=Cu:0.1",
    )
)
DARK_MS = 20.0
Z95 = 1.959964
Array = NDArray[np.float64]


def draw_system(seed: int, *, coarse: bool) -> LabSystem:
    """The hidden system of a seed; with a coarse ADC one DN is half to four times the read noise."""
    rng = np.random.default_rng([seed, 77])
    system = sample_system(rng).at_size(rows=SIZE, columns=SIZE, pixel_mm=0.45)
    system = replace(
        system,
        inherent_filtration=(
            Filter(material="Al", thickness_mm=round(math.exp(rng.uniform(math.log(0.3), math.log(3))), 3)),
        ),
        scintillator_mm=rng.uniform(0.36, 0.66),
        dead_pixels=0,
        hot_pixels=0,
    )
    step = math.exp(rng.uniform(math.log(0.5), math.log(4.0)))
    if coarse:
        smaller = step * system.read_noise_DN
        system = replace(
            system,
            DN_per_electron=system.DN_per_electron / smaller,
            read_noise_DN=system.read_noise_DN / smaller,
            dark_DN=system.dark_DN / smaller,
            dark_spread_DN=system.dark_spread_DN / smaller,
            dark_current_DN_per_ms=system.dark_current_DN_per_ms / smaller,
        )
    return system


def measure(path: Path, system: LabSystem, seed: int, beams: Iterable[tuple[float, str]]) -> None:
    """A session of darks and flats, one series a beam."""
    bench = Bench(system, rng=np.random.default_rng([seed, 78]))
    shape = (system.rows, system.columns)
    with write_acquisition(path, system.instrument()) as writer:

        def put(name: str, frames: Iterable[Any], **attributes: Any) -> None:
            sink = writer.add_series(name, shape=shape, dtype=np.uint16, **attributes)
            for frame, began_s in frames:
                sink.append(frame, time_s=began_s)

        put("dark_0", bench.dark(DARK_MS, frames=FRAMES), kind="dark", exposure_ms=DARK_MS)
        for kV, layers in beams:
            setting = Setting(kV=kV, power_W=POWER_W[kV], exposure_ms=DARK_MS, filters=filters_from_text(layers))
            name = f"flat_{kV:g}_{layers.replace(':', '') or 'open'}"
            put(name, bench.expose(setting, frames=FRAMES), kind="flat", setting=setting)
        put("dark_1", bench.dark(DARK_MS, frames=FRAMES), kind="dark", exposure_ms=DARK_MS)


class Part:
    """The series of an acquisition that belong to some beams, as calibration reads an acquisition."""

    def __init__(self, acquisition: Any, beams: Iterable[tuple[float, str]]) -> None:
        wanted = {(kV, layers) for kV, layers in beams}
        self.path = acquisition.path
        self.instrument = acquisition.instrument
        self.scenes = acquisition.scenes
        self.series = tuple(
            item
            for item in acquisition.series
            if item.kind != "flat" or (item.kV, text_from_filters(item.filters)) in wanted
        )

    def of_kind(self, *kinds: str) -> tuple[Any, ...]:
        """Series of some kinds."""
        return tuple(item for item in self.series if item.kind in kinds)


class Forward:
    """Logarithms of level and gain of a lab system and their derivatives in all unknowns and nuisances."""

    def __init__(self, system: LabSystem) -> None:
        self.system = system
        # unknowns by name -> prior sd; those of the twin's priors, and 1 for what is free
        self.sd = {
            # cut at 0, the prior is narrower than its sd says
            "filtration": 0.72 * PRIORS["inherent_filtration_mm_Al"].sd,
            "thickness": PRIORS["log_scintillator_thickness"].sd,
            "voltage": PRIORS["kV_error"].sd,
            "voltage tilt": PRIORS["kV_tilt"].sd,
            "output": PRIORS["log_output"].sd,
            "scale": 20.0,
            "swank": PRIORS["log_swank"].sd,
            "yield": PRIORS["yield_exponent"].sd,
            "hardness": PRIORS["hardness_exponent"].sd,
            "model": PRIORS["spectrum_model"].sd,
            "escape": PRIORS["escape_scale"].sd,
            "scintillator table": PRIORS["scintillator_table"].sd,
            **{
                f"{material} {what}": sd
                for material in ("Al", "Cu")
                for what, sd in (
                    ("scale", ATTENUATION_SCALE.sd),
                    ("first table", TABLE_SHARE.sd),
                    ("second table", TABLE_SHARE.sd),
                )
            },
        }
        self.names = list(self.sd)
        self._kept: dict[tuple[float, tuple[Filter, ...]], tuple[Array, Array]] = {}

    def derivatives(self, kV: float, filters: tuple[Filter, ...]) -> tuple[Array, Array]:
        """d ln level and d ln gain by each unknown (unknown,) each, by central differences or means over the spectrum."""
        if (kV, filters) not in self._kept:
            self._kept[kV, filters] = self._derivatives(kV, filters)
        return self._kept[kV, filters]

    def _derivatives(self, kV: float, filters: tuple[Filter, ...]) -> tuple[Array, Array]:
        rows = {name: np.zeros(2) for name in self.names}
        for name, step in (("filtration", 0.02), ("thickness", 0.02), ("voltage", 0.0025), ("escape", 0.05)):
            up, down = (self._sums(kV, filters, **{name: sign * step}) for sign in (1.0, -1.0))
            rows[name] = (up - down) / (2 * step)
        rows["voltage tilt"] = rows["voltage"] * math.log(kV / 60.0)
        rows["output"][0] = rows["scale"][0] = rows["scale"][1] = 1.0
        rows["swank"][1] = -1.0
        rows["yield"][0] = math.log(kV / 60.0)
        light, first, second = self._moments(kV, filters)
        energy = light.energy_keV
        photons = light.photons_per_mAs_mm2

        def by(row: Array) -> Array:
            mean = float(np.sum(photons * first * row) / np.sum(photons * first))
            square = float(np.sum(photons * second * row) / np.sum(photons * second))
            return np.array([mean, square - mean])

        rows["hardness"] = by(np.log(energy / 50.0))
        rows["model"] = by(_other_spectrum_model(kV, self.system.anode_angle_deg, energy))
        for material in ("Al", "Cu"):
            thickness = sum(layer.thickness_mm for layer in filters if layer.material == material)
            depth = mu_per_mm(material, energy) * thickness
            rows[f"{material} scale"] = by(-depth)
            inherent = sum(
                layer.thickness_mm for layer in self.system.inherent_filtration if layer.material == material
            )
            whole = mu_per_mm(material, energy) * (thickness + inherent)
            for what, table in (("first table", "xraylib"), ("second table", "penelope")):
                rows[f"{material} {what}"] = by(-whole * _other_attenuation(material, table, energy))
        departure = np.mean([_other_attenuation("CsI", table, energy) for table in ("xraylib", "penelope")], axis=0)
        thick, thin = (self._moments(kV, filters, thickness=sign * 0.02) for sign in (1.0, -1.0))
        moved = [(a - b) / 0.04 * departure for a, b in zip(thick[1:], thin[1:], strict=True)]
        mean = float(np.sum(photons * moved[0]) / np.sum(photons * first))
        rows["scintillator table"] = np.array(
            [mean, float(np.sum(photons * moved[1]) / np.sum(photons * second)) - mean]
        )
        table = np.stack([rows[name] for name in self.names], axis=1)
        return table[0], table[1]

    def _moments(self, kV: float, filters: tuple[Filter, ...], **moved: float) -> tuple[Any, Array, Array]:
        system = self.system
        if "thickness" in moved:
            system = replace(system, scintillator_mm=system.scintillator_mm * math.exp(moved["thickness"]))
        if "voltage" in moved:
            system = replace(system, kV_offset_percent=system.kV_offset_percent + 100.0 * moved["voltage"])
        extra = (Filter(material="Al", thickness_mm=1.0),) if moved.get("filtration") else ()
        light = beam_of(system, kV=kV, filters=filters)
        if extra:
            passed = np.exp(-mu_per_mm("Al", light.energy_keV) * moved["filtration"])
            light = replace(light, photons_per_mAs_mm2=light.photons_per_mAs_mm2 * passed)
        deposits = compute_deposits(light.energy_keV, scintillator_mm=system.scintillator_mm)
        size = light.energy_keV.size
        probability = deposits.probability.copy()
        if "escape" in moved:
            # a larger share of K photons leaves: taken from the full deposits of the same energy
            leaving = np.arange(probability.size) >= size
            more = moved["escape"] * probability * leaving
            probability = probability + more
            np.subtract.at(probability, deposits.energy_index[leaving], more[leaving])
        first = np.bincount(deposits.energy_index, deposits.deposit_keV * probability, size)
        second = np.bincount(deposits.energy_index, deposits.deposit_keV**2 * probability, size)
        return light, first, second

    def _sums(self, kV: float, filters: tuple[Filter, ...], **moved: float) -> Array:
        light, first, second = self._moments(kV, filters, **moved)
        level = float(np.sum(light.photons_per_mAs_mm2 * first))
        return np.array([math.log(level), math.log(float(np.sum(light.photons_per_mAs_mm2 * second)) / level)])


_KEPT: dict[Any, Array] = {}


def _other_attenuation(material: str, table: str, energy_keV: Array) -> Array:
    """Another table's attenuation over the lab's own, less 1; edges a few eV apart are left out."""
    key = (material, table, energy_keV.size, float(energy_keV[0]))
    if key not in _KEPT:
        fractions = {"Al": {13: 1.0}, "Cu": {29: 1.0}, "CsI": {55: 0.51155, 53: 0.48845}}[material]
        if table == "xraylib":
            import xraylib

            values = sum(
                share * np.array([xraylib.CS_Total(number, float(energy)) for energy in energy_keV])
                for number, share in fractions.items()
            )
        else:
            from spekpy.SpekTools import load_mu_data

            penelope = load_mu_data("pene")[0]
            values = sum(
                share * np.asarray(penelope.get_mu_over_rho(number, energy_keV)) for number, share in fractions.items()
            )
        ratio = np.asarray(values) * composition(material)[1] / 10.0 / mu_per_mm(material, energy_keV)
        _KEPT[key] = np.clip(ratio - 1.0, -0.1, 0.1)
    return _KEPT[key]


def _other_spectrum_model(kV: float, anode_angle_deg: float, energy_keV: Array) -> Array:
    """Logarithm of SpekPy's casim over its kqp at a whole kV, on the lab's energies; constant beyond the end."""
    key = (kV, anode_angle_deg)
    if key not in _KEPT:
        import spekpy

        both = [
            spekpy.Spek(kvp=kV, th=anode_angle_deg, dk=0.5, physics=model, targ="W").get_spectrum(edges=False)
            for model in ("casim", "kqp")
        ]
        seen = (both[0][1] > 0) & (both[1][1] > 0)
        _KEPT[key] = np.array([both[0][0][seen], np.clip(np.log(both[0][1][seen] / both[1][1][seen]), -0.15, 0.15)])
    return np.interp(energy_keV, *_KEPT[key])


def information_limit(
    forward: Forward,
    truth: dict[str, float],
    setting: Setting,
    beams: Iterable[tuple[float, str]],
    errors: dict[tuple[float, str], tuple[float, float]],
    *,
    discrepancies: tuple[float, float],
    read_share: float,
) -> tuple[float, float]:
    """Relative standard deviations of mean and temporal noise at a setting that no linear estimate can undercut.

    Args:
        forward: derivatives of the system.
        truth: of the setting.
        setting: to predict.
        beams: measured.
        errors: of each measured beam, the relative sd of level and of gain.
        discrepancies: relative sd of a single level and gain beyond the unknowns, of measured and predicted beams.
        read_share: share of the setting's variance that is not quantum noise.
    """
    prior = np.diag([1.0 / forward.sd[name] ** 2 for name in forward.names])
    information = prior
    for kV, layers in beams:
        level, gain = forward.derivatives(kV, filters_from_text(layers))
        for row, sd, extra in zip((level, gain), errors[kV, layers], discrepancies, strict=True):
            information = information + np.outer(row, row) / (sd**2 + extra**2)
    covariance = np.linalg.inv(information)
    level, gain = forward.derivatives(setting.kV, setting.filters)
    mean = math.sqrt(level @ covariance @ level + discrepancies[0] ** 2)
    both = level + gain
    extra = discrepancies[0] ** 2 + discrepancies[1] ** 2
    noise = 0.5 * (1.0 - read_share) * math.sqrt(both @ covariance @ both + extra)
    return mean, noise


def run_system(seed: int, *, coarse: bool) -> dict[str, Any]:
    """Everything that is kept of one system."""
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    system = draw_system(seed, coarse=coarse)
    maps = detector_maps(system)
    beams = sorted({beam for protocol in PROTOCOLS.values() for beam in protocol})
    truths = [flat_truth(system, maps, setting) for setting in SETTINGS]
    forward = Forward(system)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        measure(path, system, seed, beams)
        with open_acquisition(path) as acquisition:
            for protocol, chosen in PROTOCOLS.items():
                twin = calibrate_twin(
                    Part(acquisition, chosen),  # type: ignore[arg-type]
                    rng=np.random.default_rng([seed, 79]),
                    advise=False,
                )
                if twin.spectral is None:
                    rows.append({"protocol": protocol, "failed": list(twin.warnings)})
                    continue
                errors = {}
                for level in twin.levels:
                    rate, slope = level.rate_DN_per_mAs, level.photon_transfer_slope_DN
                    assert rate is not None
                    key = (level.kV or 0.0, text_from_filters(level.filters))
                    errors[key] = tuple((e.high - e.low) / (2 * Z95) / e.value for e in (rate, slope))
                for number, (setting, truth) in enumerate(zip(SETTINGS, truths, strict=True)):
                    found = predict_flatfield(twin, setting)
                    quantum = truth["photon_transfer_slope_DN"] * truth["mean_DN"] / setting.averaged
                    read_share = max(0.0, 1.0 - quantum / truth["sd_DN"] ** 2)
                    limits = {
                        name: information_limit(
                            forward, truth, setting, chosen, errors, discrepancies=extra, read_share=read_share
                        )
                        for name, extra in (
                            ("limit", (LEVEL_DISCREPANCY, GAIN_DISCREPANCY)),
                            ("bare_limit", (0.0, 0.0)),
                        )
                    }
                    row: dict[str, Any] = {"protocol": protocol, "setting": number, "extrapolated": found.extrapolated}
                    for index, name in enumerate(("mean_DN", "sd_DN")):
                        estimate = getattr(found, name)
                        row[name] = [truth[name], estimate.value, estimate.low, estimate.high]
                        row[f"{name}_limit"] = limits["limit"][index]
                        row[f"{name}_bare_limit"] = limits["bare_limit"][index]
                    rows.append(row)
                rows.append({"protocol": protocol, "errors": [[*key, *value] for key, value in errors.items()]})
    return {"seed": seed, "coarse": coarse, "rows": rows}


def summarise(results: list[dict[str, Any]], *, draws: int = 1000) -> list[dict[str, Any]]:
    """Per protocol and quantity: errors, limit, their ratio, coverage with a bootstrap over systems."""
    rng = np.random.default_rng(0)
    table = []
    for protocol in PROTOCOLS:
        for name in ("mean_DN", "sd_DN"):
            truth, value, low, high, limit, bare = (np.full((len(results), len(SETTINGS)), np.nan) for _ in range(6))
            for number, result in enumerate(results):
                for row in result["rows"]:
                    if row["protocol"] == protocol and "setting" in row:
                        place = (number, row["setting"])
                        truth[place], value[place], low[place], high[place] = row[name]
                        limit[place], bare[place] = row[f"{name}_limit"], row[f"{name}_bare_limit"]
            kept = np.isfinite(truth).all(axis=1)
            truth, value, low, high, limit, bare = (item[kept] for item in (truth, value, low, high, limit, bare))
            systems = len(truth)
            error = np.log(value / truth)
            inside = (low <= truth) & (truth <= high)
            squared, bare_squared = (error / limit) ** 2, (error / bare) ** 2
            picks = rng.integers(0, systems, size=(draws, systems))
            coverage = inside.mean(axis=1)[picks].mean(axis=1)
            ratio = np.sqrt(squared.mean(axis=1)[picks].mean(axis=1))
            per_setting = 100 * np.sqrt((error**2).mean(axis=0))
            limits = 100 * np.sqrt((limit**2).mean(axis=0))
            table.append(
                {
                    "protocol": protocol,
                    "quantity": name,
                    "systems": systems,
                    "failed": int(len(results) - systems),
                    "median_error_percent": 100 * float(np.median(np.abs(error))),
                    "rms_error_percent": 100 * float(np.sqrt(np.mean(error**2))),
                    "rms_per_setting_percent": [float(item) for item in per_setting],
                    "limit_per_setting_percent": [float(item) for item in limits],
                    "bias_percent": 100 * float(np.mean(error)),
                    "ratio": float(np.sqrt(np.mean(squared))),
                    "ratio_interval": [float(item) for item in np.quantile(ratio, [0.025, 0.975])],
                    "ratio_bare": float(np.sqrt(np.mean(bare_squared))),
                    "worst_setting_ratio": float(np.max(np.sqrt(squared.mean(axis=0)))),
                    "half_width_percent": 50 * float(np.mean((high - low) / truth)),
                    "coverage_percent": 100 * float(np.mean(inside)),
                    "coverage_interval": [100 * float(item) for item in np.quantile(coverage, [0.025, 0.975])],
                    "coverage_per_setting_percent": [100 * float(item) for item in inside.mean(axis=0)],
                }
            )
    return table


def print_table(table: list[dict[str, Any]]) -> None:
    """The summary for people."""
    print(
        f"{'':<3}{'':<8}{'systems':>8}{'median %':>10}{'rms %':>8}{'limit, per setting %':>22}"
        f"{'rms / limit (95 %)':>24}{'bare':>6}{'worst':>7}{'width %':>9}{'coverage % (95 %)':>24}{'per setting':>14}"
    )
    for row in table:
        limits, coverage = row["limit_per_setting_percent"], row["coverage_per_setting_percent"]
        ratio = f"{row['ratio']:.2f} ({row['ratio_interval'][0]:.2f}-{row['ratio_interval'][1]:.2f})"
        covered = f"{row['coverage_percent']:.1f} ({row['coverage_interval'][0]:.1f}-{row['coverage_interval'][1]:.1f})"
        print(
            f"{row['protocol']:<3}{row['quantity']:<8}{row['systems']:>8}{row['median_error_percent']:>10.2f}"
            f"{row['rms_error_percent']:>8.2f}{min(limits):>14.2f} - {max(limits):.2f}{ratio:>24}"
            f"{row['ratio_bare']:>6.2f}{row['worst_setting_ratio']:>7.2f}{row['half_width_percent']:>9.2f}{covered:>24}"
            f"{min(coverage):>8.0f}-{max(coverage):.0f}"
        )


def _job(seed: int, coarse: bool) -> dict[str, Any]:
    return run_system(seed, coarse=coarse)


def run(seeds: Iterable[int], *, coarse: bool, processes: int = 1, folder: Path | None = None) -> list[dict[str, Any]]:
    """Results of all seeds, those kept in the folder included."""
    done: dict[int, dict[str, Any]] = {}
    file = None if folder is None else folder / ("coarse.jsonl" if coarse else "fine.jsonl")
    if file is not None and file.exists():
        for line in file.read_text(encoding="utf-8").splitlines():
            try:
                result = json.loads(line)
            except json.JSONDecodeError:
                continue  # cut off when the run was stopped
            done[result["seed"]] = result
    wanted = list(seeds)
    missing = [seed for seed in wanted if seed not in done]

    def keep(result: dict[str, Any]) -> None:
        done[result["seed"]] = result
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("a", encoding="utf-8") as out:
                out.write(json.dumps(result) + "\n")

    if processes > 1:
        with ProcessPoolExecutor(processes) as pool:
            jobs = [pool.submit(_job, seed, coarse) for seed in missing]
            for job in tqdm(as_completed(jobs), total=len(jobs), disable=None, file=sys.stderr):
                keep(job.result())
    else:
        for seed in tqdm(missing, disable=None, file=sys.stderr):
            keep(run_system(seed, coarse=coarse))
    return [done[seed] for seed in wanted]


def main() -> int:
    """Run the systems and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=200)
    parser.add_argument("--first", type=int, default=1000, help="first seed; development used seeds below 1000")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--adc", choices=("fine", "coarse"), default="fine")
    parser.add_argument("--folder", type=Path, help="where finished systems are kept")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    started = time.perf_counter()
    seeds = range(arguments.first, arguments.first + arguments.systems)
    results = run(seeds, coarse=arguments.adc == "coarse", processes=arguments.processes, folder=arguments.folder)
    table = summarise(results)
    print(f"{len(results)} systems, {arguments.adc} ADC, {time.perf_counter() - started:.0f} s")
    print_table(table)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"table": table}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Tubes calibrated with a dosimeter, against the truth of drawn systems: errors, and how often 95 % intervals hold it.

    python validation/dosimeter.py [--systems 40] [--first 0] [--family NAME]... [--protocol NAME]... [--json FILE]
    python validation/dosimeter.py --real ../shared/realdata

Each system is a tube of the virtual lab (SpekPy's `kqp` at the voltage itself, the lab's own attenuation: no physics of the
twin's) with inherent filtration, output, true voltage and anode angle of its own, read with a dosimeter whose calibration and
response over energy are wrong within IEC 61674's limits. Every setting strays on its own, filters are not quite as thick as
stated, readings scatter and are rounded. Families add what no label says: a worn anode, a rippling voltage.

Protocols: `kermas` (4 kV, with and without 2 mm Al, one repeated), `half_values` (kermas at 3 kV and half-value layers there),
`ratios` (half-value layers alone). Rows compare inherent filtration, output (air kerma at 80 kV behind 3 mm Al), and air kerma
and half-value layer at settings that were not measured. --real fits the published dose reports and transmissions.
"""

import argparse
import csv
import json
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta
from tqdm import tqdm

from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import Filter, Setting, filters_from_text, text_from_filters
from raytwin.calibration.spectrum.output_table import OutputTable, read_output_table
from raytwin.calibration.spectrum.transmission_table import read_transmission_table
from raytwin.calibration.spectrum.tube import calibrate_tube, predict_ratio
from raytwin.generator.predictions.tube_twin import TubeTwin, predict_spectrum, predict_tube
from raytwin.generator.twins.twin_answer import equivalent_filtration
from raytwin.lab.attenuation import mu_per_mm
from raytwin.lab.tube import beam
from raytwin.materials import mass_energy_absorption_cm2_g, material_from_name

STATED_ANGLE_DEG = 12.0
FAMILIES = ("plain", "worn", "ripple")
PROTOCOLS = ("kermas", "half_values", "ratios")
UNMEASURED = ((50.0, "Al:1"), (70.0, "Cu:0.1"), (90.0, ""), (120.0, "Al:2"))
_UGY_PER_KEV_PER_G_MM2 = 1.602176634e-7 * 100.0


@dataclass(frozen=True, kw_only=True)
class System:
    """A tube and a dosimeter as they are; relative errors unless a unit is named."""

    family: str
    filtration_mm_Al: float
    log_output: float
    kV_error: float
    anode_angle_deg: float
    tungsten_um: float
    ripple: float
    setting_sd: float
    filter_error: float
    calibration: float
    hardness: float
    scatter: float
    digits: int


def draw_system(seed: int, family: str) -> System:
    """A system of a family; what the twin's priors are centred on is not used."""
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    return System(
        family=family,
        filtration_mm_Al=rng.uniform(0.3, 4.5),
        log_output=rng.normal(0.0, 0.15),
        kV_error=rng.normal(0.0, 0.008),
        anode_angle_deg=rng.uniform(10.5, 14.0),
        tungsten_um=rng.uniform(0.3, 2.0) if family == "worn" else 0.0,
        ripple=rng.uniform(0.02, 0.10) if family == "ripple" else 0.0,
        setting_sd=0.01 * math.exp(0.7 * rng.standard_normal()),
        filter_error=rng.normal(0.0, 0.01),
        calibration=rng.uniform(-0.05, 0.05),
        hardness=rng.uniform(-0.05, 0.05) / 0.35,
        scatter=rng.uniform(0.002, 0.02),
        digits=int(rng.integers(3, 5)),
    )


def equivalent_mm(system: System) -> float:
    """Filtration with the worn anode's own metal, mm of aluminium at 30 keV."""
    tungsten, aluminium = (float(mu_per_mm(name, np.array([30.0]))[0]) for name in ("W", "Al"))
    return system.filtration_mm_Al + 1e-3 * system.tungsten_um * tungsten / aluminium


class Truth:
    """Kerma per mAs at 1 m and half-value layers of a system, each setting with its own departure."""

    def __init__(self, system: System, seed: int) -> None:
        self.system = system
        self._own = np.random.default_rng([seed, 7])
        self._departures: dict[tuple[float, str], float] = {}

    def kerma_of_energies(self, kV: float, filters: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Energies and kerma per bin, uGy per mAs at 1 m, without the setting's own departure."""
        system = self.system
        layers = [Filter(material="Al", thickness_mm=system.filtration_mm_Al)]
        layers += [
            Filter(material=layer.material, thickness_mm=layer.thickness_mm * (1.0 + system.filter_error))
            for layer in filters_from_text(filters)
        ]
        peak = kV * (1.0 + system.kV_error)
        # a voltage that falls in a straight line from its peak and back, as a converter's ripple does
        steps = np.linspace(0.0, system.ripple, 4) if system.ripple else np.zeros(1)
        total: NDArray[np.float64] | None = None
        for step in steps:
            found = beam(kV=round(peak * (1.0 - step), 1), anode_angle_deg=system.anode_angle_deg, filters=layers)
            part = np.array(found.photons_per_mAs_mm2)
            if total is None:
                energies, total = np.array(found.energy_keV), np.zeros(part.size)
            total[: part.size] += part / steps.size
        assert total is not None
        total *= np.exp(system.log_output - 1e-3 * system.tungsten_um * mu_per_mm("W", energies))
        absorption = mass_energy_absorption_cm2_g(material_from_name("air"), energies)
        return energies, _UGY_PER_KEV_PER_G_MM2 * energies * absorption * total

    def kerma(self, kV: float, filters: str) -> float:
        """What the setting gives, uGy per mAs at 1 m."""
        key = (kV, filters)
        if key not in self._departures:
            self._departures[key] = self._own.normal(0.0, self.system.setting_sd)
        return float(np.sum(self.kerma_of_energies(kV, filters)[1])) * math.exp(self._departures[key])

    def read(self, kV: float, filters: str) -> float:
        """What the dosimeter shows at a setting, uGy per mAs at 1 m, before scatter and rounding."""
        energies, kerma = self.kerma_of_energies(kV, filters)
        response = float(np.sum(kerma * (energies / 50.0) ** self.system.hardness) / np.sum(kerma))
        return self.kerma(kV, filters) * response * (1.0 + self.system.calibration)

    def half_value_mm_Al(self, kV: float, filters: str, *, as_read: bool = False) -> float:
        """Half-value layer, mm Al; `as_read`: by the dosimeter's response."""
        energies, kerma = self.kerma_of_energies(kV, filters)
        if as_read:
            kerma = kerma * (energies / 50.0) ** self.system.hardness
        mu = mu_per_mm("Al", energies)
        low, high = 0.0, 60.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if np.sum(kerma * np.exp(-mu * middle)) < 0.5 * np.sum(kerma) else (middle, high)
        return high


def measured_table(truth: Truth, protocol: str, seed: int, path: Path) -> None:
    """What the owner of a system writes down."""
    rng = np.random.default_rng([seed, 11])
    system = truth.system

    def written(value: float) -> str:
        return f"{value * (1.0 + rng.normal(0.0, system.scatter)):#.{system.digits}g}".rstrip(".")

    rows = ["kV,filter,mAs,distance_mm,air_kerma_uGy,hvl_mm_Al"]
    if protocol == "kermas":
        settings = [(kV, filters) for kV in (40.0, 60.0, 80.0, 110.0) for filters in ("", "Al:2")]
        for kV, filters in (*settings, (80.0, ""), (80.0, "")):
            rows.append(f"{kV:g},{filters},10,700,{written(10.0 * truth.read(kV, filters) / 0.49)},")
    if protocol == "half_values":
        for kV in (50.0, 80.0, 110.0):
            rows.append(f"{kV:g},Al:1,10,700,{written(10.0 * truth.read(kV, 'Al:1') / 0.49)},")
    if protocol in ("half_values", "ratios"):
        for kV in (50.0, 80.0, 110.0):
            rows.append(f"{kV:g},Al:1,,,,{written(truth.half_value_mm_Al(kV, 'Al:1', as_read=True))}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def measure_system(seed: int, family: str, protocols: Sequence[str] = PROTOCOLS) -> Iterator[dict[str, Any]]:
    """Rows `{quantity, protocol, family, seed, truth, value, low, high}` of one system."""
    truth = Truth(draw_system(seed, family), seed)
    for protocol in protocols:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "doses.csv"
            measured_table(truth, protocol, seed, path)
            twin = calibrate_tube(
                rng=np.random.default_rng(seed),
                output=read_output_table(path),
                instrument=Instrument(anode="W", anode_angle_deg=STATED_ANGLE_DEG),
            )

        def row(quantity: str, value: float, estimate: Any, protocol: str = protocol) -> dict[str, Any]:
            common = {"quantity": quantity, "protocol": protocol, "family": family, "seed": seed, "truth": value}
            return common | estimate.as_dict()

        yield row(
            "inherent_filtration_mm_Al",
            equivalent_mm(truth.system),
            equivalent_filtration(twin.spectral, seen_by_detector=False),
        )
        for kV, filters in UNMEASURED:
            layers = filters_from_text(filters)
            spectrum = predict_spectrum(twin, kV=kV, filters=layers)
            yield row("hvl_mm_Al", truth.half_value_mm_Al(kV, filters), spectrum.hvl_mm_Al)
            if twin.output_known:
                setting = Setting(kV=kV, filters=layers, current_mA=1000.0, exposure_ms=1.0, source_detector_mm=1000.0)
                yield row("air_kerma_uGy", truth.kerma(kV, filters), predict_tube(twin, setting).air_kerma_uGy)
        if twin.output_known:
            yield row("output", *_output(truth, twin))


def _output(truth: Truth, twin: TubeTwin) -> tuple[float, Any]:
    """Air kerma behind 3 mm Al at 80 kV: what `output` means when the filtration is shared out otherwise."""
    setting = Setting(
        kV=80.0,
        filters=filters_from_text("Al:3"),
        current_mA=1000.0,
        exposure_ms=1.0,
        source_detector_mm=1000.0,
    )
    return truth.kerma(80.0, "Al:3"), predict_tube(twin, setting).air_kerma_uGy


def summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each quantity, protocol and family: coverage with its 95 % interval, median error, half width."""
    lines = [
        f"{'quantity':<26}{'protocol':<13}{'family':<8}{'n':>5} {'held, %':>17} {'error, %':>9} {'half width, %':>14}"
    ]
    keys = sorted({(row["quantity"], row["protocol"], row["family"]) for row in rows})
    for key in keys:
        own = [row for row in rows if (row["quantity"], row["protocol"], row["family"]) == key]
        held, n = sum(row["low"] <= row["truth"] <= row["high"] for row in own), len(own)
        low = 100.0 * float(beta.ppf(0.025, held, n - held + 1)) if held else 0.0
        high = 100.0 * float(beta.ppf(0.975, held + 1, n - held)) if held < n else 100.0
        error = 100.0 * float(np.median([abs(row["value"] / row["truth"] - 1.0) for row in own]))
        half = 100.0 * float(np.median([0.5 * (row["high"] - row["low"]) / row["value"] for row in own]))
        quantity, protocol, family = key
        lines.append(
            f"{quantity:<26}{protocol:<13}{family:<8}{n:>5} {100 * held / n:>5.1f} ({low:.0f} to {high:.0f}) {error:>9.2f}"
            f" {half:>14.2f}"
        )
    return lines


def real_tables(folder: Path) -> Iterator[str]:
    """What the published dose reports and transmissions give, a line each."""
    rows = list(csv.DictReader((folder / "dose_reports" / "events.csv").open(encoding="utf-8")))
    for name, prefix, distance_mm in (("Philips", "RF-Pat", 615), ("Siemens", "siemens", 635)):
        own = [row for row in rows if row["file"].startswith(prefix)]
        for angle_deg in (8.0, 12.0):
            twin = _tube_of_reports(own, distance_mm, angle_deg)
            yield f"{name}, {angle_deg:g} degrees: {twin!r}, {_strays_text(twin.evidence['output_table'])}"
    thin = [row for row in rows if row["file"].startswith("RF-Pat") and float(row["filter_Cu_mm"]) == 0.1]
    thick = _table_of_reports([row for row in rows if row["filter_Cu_mm"] == "0.4"], 615)
    for angle_deg in (8.0, 12.0):
        twin = _tube_of_reports(thin, 615, angle_deg)
        for reading in thick.kermas:
            if len(reading.rows) > 1:
                setting = Setting(
                    kV=reading.kV,
                    filters=reading.filters,
                    current_mA=1000.0,
                    exposure_ms=1.0,
                    source_detector_mm=1000.0,
                )
                kerma = predict_tube(twin, setting).air_kerma_uGy
                assert kerma is not None
                yield (
                    f"Philips, {angle_deg:g} degrees, calibrated behind 0.1 mm Cu: {reading.kV:g} kV"
                    f" {text_from_filters(reading.filters)} measured over predicted {reading.value / kerma.value:.3f}"
                    f" ({kerma.low / kerma.value:.3f} to {kerma.high / kerma.value:.3f} stated)"
                )
    yield _transmission_line(folder / "table_transmission" / "correction_table_and_pad_attenuation.csv")


def _table_of_reports(rows: Sequence[dict[str, str]], distance_mm: float) -> OutputTable:
    lines = ["kV,filter,mAs,distance_mm,air_kerma_uGy"]
    for row in rows:
        layers = [(material, row[f"filter_{material}_mm"]) for material in ("Al", "Cu")]
        filters = "+".join(f"{material}:{text}" for material, text in layers if float(text) > 0)
        lines.append(f"{row['kV']},{filters},{row['mAs']},{distance_mm:g},{row['dose_rp_mGy']}e3")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "doses.csv"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return read_output_table(path)


def _tube_of_reports(rows: Sequence[dict[str, str]], distance_mm: float, angle_deg: float) -> TubeTwin:
    return calibrate_tube(
        rng=np.random.default_rng(1),
        output=_table_of_reports(rows, distance_mm),
        instrument=Instrument(anode="W", anode_angle_deg=angle_deg),
    )


def _strays_text(evidence: dict[str, Any]) -> str:
    found = [row["departure_percent"] for row in evidence["departures"]]
    return f"settings depart by {np.sqrt(np.mean(np.square(found))):.1f} % rms, {max(found, key=abs):+.0f} % at most"


def _transmission_line(path: Path) -> str:
    rows = [row for row in csv.DictReader(path.open(encoding="utf-8")) if row["device_model"] == "AXIOM-Artis"]
    with tempfile.TemporaryDirectory() as folder:

        def written(name: str, copper_mm: Sequence[str], step_kV: int) -> Path:
            lines = ["kV,filter,transmission"]
            for row in rows:
                if row["filtration_added_mmcu"] in copper_mm and (float(row["kvp_kv"]) - 50.0) % step_kV == 0:
                    filters = "" if row["filtration_added_mmcu"] == "0" else f"Cu:{row['filtration_added_mmcu']}"
                    lines.append(f"{row['kvp_kv']},{filters},{row['k_patient_support']}")
            (Path(folder) / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
            return Path(folder) / name

        fitted = read_transmission_table(written("fitted.csv", ("0", "0.9"), 25))
        others = read_transmission_table(written("others.csv", ("0.1", "0.2", "0.3", "0.6"), 5))
    twin = calibrate_tube(
        rng=np.random.default_rng(1),
        transmission=fitted,
        instrument=Instrument(anode="W", anode_angle_deg=8.0),
    )
    errors = [item.value - math.exp(float(np.median(predict_ratio(twin.spectral, item)))) for item in others.ratios]
    return f"table, fitted behind 0 and 0.9 mm Cu: {twin!r}; the other four filters {np.sqrt(np.mean(np.square(errors))):.4f} rms"


def main() -> int:
    """Run the validation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--family", action="append", choices=FAMILIES)
    parser.add_argument("--protocol", action="append", choices=PROTOCOLS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--real", type=Path)
    arguments = parser.parse_args()
    if arguments.real is not None:
        for line in real_tables(arguments.real):
            print(line, flush=True)
        return 0
    rows: list[dict[str, Any]] = []
    cases = [
        (seed, family)
        for seed in range(arguments.first, arguments.first + arguments.systems)
        for family in arguments.family or FAMILIES
    ]
    for seed, family in tqdm(cases, desc="systems", unit="system", disable=None):
        rows += measure_system(seed, family, arguments.protocol or PROTOCOLS)
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(rows), encoding="utf-8")
    print("\n".join(summary(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

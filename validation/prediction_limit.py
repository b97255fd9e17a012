"""Predictions at settings never measured, against the virtual lab's truth and against what any method could reach.

    python validation/prediction_limit.py [--systems 200] [--first 1000] [--kind nominal|departing|coarse]
        [--repeats 1] [--processes 1] [--folder build/prediction_limit] [--fresh] [--prepare] [--next N] [--json FILE]

Each system is drawn: tube filtration, scintillator, kV offset, output, gain, Swank factor, spread, read noise. One session a
system holds darks and flats; a protocol is a part of them:

    A  40 and 90 kV behind 0.05 mm Cu             B  40 and 90 kV, with 0.05 mm Cu and without
    C  40, 70 and 110 kV, with and without        D  90 kV behind 0.05 mm Cu

A twin is calibrated from each part and predicts twelve settings (50 to 120 kV; Cu 0 to 0.5 mm, Al 0 to 2 mm; other
currents, exposures, distances, averages). The truth is the lab's own noise-free expectation.

The limit of a system and setting is the standard deviation that a linear and Gaussian estimate reaches, knowing all
derivatives: measured levels and noise with their sampling errors, priors of the unknowns as they are stated, nuisances
for attenuation tables, spectrum models, escape, voltage and single levels' discrepancy. It is computed here from the
lab's own sums over energy, without the twin's code; only the priors' widths, and the shape of light against energy, are the
twin's. Lines whose physics is not the lab's either: validation/foreign_lines.py.

With `--repeats N` the frames of each flat come in N series, all settings in turn, N times: what a session then shows of the
line's steadiness is used. As many frames in all.

`departing` lines show in full what the priors allow beside (see `Line`); `coarse` ones have an ADC whose step is half to
four times the read noise. Sessions and results are kept in `--folder`, so that a run that was stopped goes on.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.setting import Filter, Setting, filters_from_text, setting_from_text, text_from_filters
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.calibration.next_measurement import rank_measurements
from raytwin.calibration.spectrum.priors import (
    ATTENUATION_SCALE,
    GAIN_DISCREPANCY,
    LEVEL_DISCREPANCY,
    PRIORS,
    SHARES_CORRELATION,
    TABLE_SHARE,
    draw_parameters,
    spread_of,
)
from raytwin.generator.line.twin import Z95, Twin
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.lab.attenuation import composition, mu_per_mm
from raytwin.lab.bench import Bench
from raytwin.lab.families import sample_system
from raytwin.lab.response import Deposits, beam_of, compute_deposits
from raytwin.lab.system import LabSystem, detector_maps
from raytwin.lab.truth import flat_truth
from raytwin.lab.unkindness import NONE
from raytwin.spectra import light_per_keV

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
Array = NDArray[np.float64]


class Line:
    """A hidden line: its system, and how far it departs from what is dialled in.

    A `nominal` line has one kV offset, true filters and a steady output. One that departs has another offset at each
    kV, filters 1 % off their nominal thickness, a rough anode and an output that differs by 0.1 % from series to
    series: the size that the priors take for a line that shows such things in full.
    """

    def __init__(self, seed: int, kind: str) -> None:
        rng = np.random.default_rng([seed, 77])
        # the limit knows the plain line and the departures below alone
        system = sample_system(rng, families=()).at_size(rows=SIZE, columns=SIZE, pixel_mm=0.45)
        aluminium = Filter(material="Al", thickness_mm=round(math.exp(rng.uniform(math.log(0.3), math.log(3.0))), 3))
        system = replace(
            system,
            inherent_filtration=(aluminium,),
            scintillator_mm=rng.uniform(0.36, 0.66),
            dead_pixels=0,
            hot_pixels=0,
            unkindness=NONE,
        )
        # one DN is half to four times the read noise
        step = math.exp(rng.uniform(math.log(0.5), math.log(4.0)))
        departures = rng.standard_normal(4)
        if kind == "coarse":
            smaller = step * system.read_noise_DN
            system = replace(
                system,
                DN_per_electron=system.DN_per_electron / smaller,
                read_noise_DN=system.read_noise_DN / smaller,
                dark_DN=system.dark_DN / smaller,
                dark_spread_DN=system.dark_spread_DN / smaller,
                dark_current_DN_per_ms=system.dark_current_DN_per_ms / smaller,
            )
        self.system = system
        self.tilt = self.output_sd = 0.0
        self.scale = {}
        if kind == "departing":
            self.tilt = 0.002 * float(departures[0])
            self.scale = {"Cu": 1.0 + 0.01 * float(departures[1]), "Al": 1.0 + 0.01 * float(departures[2])}
            self.output_sd = 0.001
            tungsten = Filter(material="W", thickness_mm=3e-4 * abs(float(departures[3])))
            self.system = replace(system, inherent_filtration=(aluminium, tungsten))

    def at(self, kV: float) -> LabSystem:
        """The system at a tube voltage, whose offset may be its own; in quarters of a per cent, as spectra take long."""
        offset = self.system.kV_offset_percent + 100.0 * self.tilt * math.log(kV / 60.0)
        return replace(self.system, kV_offset_percent=round(4.0 * offset) / 4.0)

    def true(self, setting: Setting) -> Setting:
        """What is in the beam when a setting is dialled in."""
        layers = tuple(
            replace(layer, thickness_mm=layer.thickness_mm * self.scale.get(layer.material, 1.0))
            for layer in setting.filters
        )
        return replace(setting, filters=layers)


def measure(
    path: Path, line: Line, seed: int, beams: Iterable[tuple[float, str]], *, part: int = 0, repeats: int = 1
) -> None:
    """A session of darks and flats, one series a beam, or as many as it is repeated, all beams in turn."""
    rng = np.random.default_rng([seed, 78, part] if repeats == 1 else [seed, 78, part, repeats])
    every = list(beams)
    shape = (line.system.rows, line.system.columns)
    with write_acquisition(path, line.system.instrument()) as writer:

        def put(name: str, frames: Iterable[Any], **attributes: Any) -> None:
            sink = writer.add_series(name, shape=shape, dtype=np.uint16, **attributes)
            for frame, began_s in frames:
                sink.append(frame, time_s=began_s)

        def dark(name: str) -> None:
            frames = Bench(line.system, rng=rng).dark(DARK_MS, frames=FRAMES)
            put(name, frames, kind="dark", exposure_ms=DARK_MS)

        dark("dark_0")
        for number, (kV, layers) in enumerate(every * repeats):
            power_W = POWER_W.get(kV, 50.0)
            setting = Setting(kV=kV, power_W=power_W, exposure_ms=DARK_MS, filters=filters_from_text(layers))
            real = line.true(setting)
            real = replace(real, power_W=power_W * (1.0 + line.output_sd * float(rng.standard_normal())))
            name = f"flat_{kV:g}_{layers.replace(':', '') or 'open'}"
            name += f"_{number // len(every)}" if repeats > 1 else ""
            frames = Bench(line.at(kV), rng=rng).expose(real, frames=FRAMES // repeats)
            put(name, frames, kind="flat", setting=setting)
        dark("dark_1")


def prepare(seed: int, kind: str, folder: Path, *, repeats: int = 1) -> tuple[Path, dict[str, Any]]:
    """The session of a line, and what the lab knows of it: truths of the settings and derivatives at all beams."""
    repeated = f"_x{repeats}" if repeats > 1 else ""
    session, known = folder / f"{kind}{repeated}_{seed}.h5", folder / f"{kind}_{seed}.json"
    if known.exists() and not session.exists():
        beams = sorted({beam for protocol in PROTOCOLS.values() for beam in protocol})
        measure(session, Line(seed, kind), seed, beams, repeats=repeats)
    if not known.exists():
        folder.mkdir(parents=True, exist_ok=True)
        line = Line(seed, kind)
        maps = detector_maps(line.system)
        measured = sorted({beam for protocol in PROTOCOLS.values() for beam in protocol})
        measure(session, line, seed, measured, repeats=repeats)
        truths = [flat_truth(line.at(setting.kV), maps, line.true(setting)) for setting in SETTINGS]
        beams = {(beam[0], filters_from_text(beam[1])) for protocol in PROTOCOLS.values() for beam in protocol}
        beams |= {(setting.kV, setting.filters) for setting in SETTINGS}
        forward = Forward(line.system)
        lab = {
            "truths": truths,
            "unknowns": forward.names,
            "derivatives": [
                [kV, text_from_filters(filters), *(list(map(float, row)) for row in forward.derivatives(kV, filters))]
                for kV, filters in sorted(beams, key=str)
            ],
        }
        known.write_text(json.dumps(lab), encoding="utf-8")
    return session, json.loads(known.read_text(encoding="utf-8"))


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


def prior_sd() -> dict[str, float]:
    """Prior standard deviation of each unknown: the twin's widths; this script's names."""
    tables = {"scale": ATTENUATION_SCALE.sd, "first table": TABLE_SHARE.sd, "second table": TABLE_SHARE.sd}
    of_twin = {
        "filtration": "inherent_filtration_mm_Al",
        "thickness": "log_scintillator_thickness",
        "voltage": "kV_error",
        "voltage tilt": "kV_tilt",
        "voltage variance": "kV_variance",
        "output": "log_output",
        "swank": "log_swank",
        "swank exponent": "swank_exponent",
        "yield": "yield_exponent",
        "hardness": "hardness_exponent",
        "hardness tilt": "hardness_tilt",
        "roughness": "anode_roughness_um",
        "end point": "end_exponent",
        "escape": "escape_scale",
        "scintillator table": "scintillator_table",
        "cover": "cover_mm_C",
        "dead layer": "dead_layer_um",
        "light": "light_nonproportionality",
        "light exponent": "light_exponent",
        "light depth": "light_depth_slope",
    }
    return {
        **{name: spread_of(PRIORS[parameter]) for name, parameter in of_twin.items()},
        "scale": 20.0,
        **{f"{material} {what}": sd for material in ("Al", "Cu") for what, sd in tables.items()},
    }


def prior_covariance(names: Sequence[str]) -> Array:
    """Prior covariance (unknown, unknown): of three tables one is right, whichever the other two are measured from."""
    sd = prior_sd()
    covariance = np.diag([sd[name] ** 2 for name in names])
    for material in ("Al", "Cu"):
        first, second = names.index(f"{material} first table"), names.index(f"{material} second table")
        covariance[first, second] = covariance[second, first] = SHARES_CORRELATION * TABLE_SHARE.sd**2
    # a ripple takes from the voltage's mean and adds to its variance
    both = names.index("voltage"), names.index("voltage variance")
    drawn = draw_parameters(
        {name: PRIORS[name] for name in ("kV_error", "kV_variance")}, 100_000, np.random.default_rng(0)
    )
    covariance[np.ix_(both, both)] = np.cov(drawn.T)
    return covariance


class Forward:
    """Derivatives of level and gain of a lab system in all unknowns and nuisances, from the lab's sums over energy."""

    def __init__(self, system: LabSystem) -> None:
        self.system = system
        self.names = list(prior_sd())

    def derivatives(self, kV: float, filters: tuple[Filter, ...]) -> tuple[Array, Array]:
        """d ln level and d ln gain by each unknown (unknown,) each, by central differences or means over the spectrum."""
        rows = {name: np.zeros(2) for name in self.names}
        for name, step in (("filtration", 0.02), ("thickness", 0.02), ("voltage", 0.0025), ("escape", 0.05)):
            up, down = (self._sums(kV, filters, **{name: sign * step}) for sign in (1.0, -1.0))
            rows[name] = (up - down) / (2 * step)
        rows["voltage tilt"] = rows["voltage"] * math.log(kV / 60.0)
        beside = [self._sums(kV, filters, voltage=sign * 0.02) for sign in (1.0, 0.0, -1.0)]
        levels = [math.exp(item[0] - beside[1][0]) for item in beside]
        squares = [math.exp(item.sum() - beside[1].sum()) for item in beside]
        bent = [(item[0] - 2.0 * item[1] + item[2]) / (2 * 0.02**2) for item in (levels, squares)]
        rows["voltage variance"] = np.array([bent[0], bent[1] - bent[0]])
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
        rows["hardness tilt"] = rows["hardness"] * math.log(kV / 60.0)
        rows["roughness"] = by(-1e-3 * _mu_per_mm("W", energy))
        rows["cover"] = by(-_mu_per_mm("C@2.2", energy))
        own = _mu_per_mm("CsI", energy)
        rows["dead layer"] = by(-1e-3 * own)
        depth = own * self.system.scintillator_mm
        for name, row in (
            ("light", light_per_keV("CsI", energy)),
            ("light exponent", np.log(energy / 50.0)),
            ("light depth", 1.0 / depth - 1.0 / np.expm1(np.minimum(depth, 500.0)) - 0.5),
        ):
            once = by(row)
            # light counts twice in the square
            rows[name] = np.array([once[0], once[0] + 2.0 * once[1]])
        rows["swank exponent"] = np.array([0.0, -by(np.log(energy / 50.0)).sum()])
        rows["end point"] = by(np.log(2.0 * np.maximum(1.0 - energy / kV, 0.02)))
        for material in ("Al", "Cu"):
            thickness = sum(layer.thickness_mm for layer in filters if layer.material == material)
            depth = _mu_per_mm(material, energy) * thickness
            rows[f"{material} scale"] = by(-depth)
            inherent = sum(
                layer.thickness_mm for layer in self.system.inherent_filtration if layer.material == material
            )
            whole = _mu_per_mm(material, energy) * (thickness + inherent)
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
            passed = np.exp(-_mu_per_mm("Al", light.energy_keV) * moved["filtration"])
            light = replace(light, photons_per_mAs_mm2=light.photons_per_mAs_mm2 * passed)
        deposits = _deposits(light.energy_keV, system.scintillator_mm)
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


_KEPT: dict[Any, Any] = {}


def _mu_per_mm(material: str, energy_keV: Array) -> Array:
    """The lab's attenuation, kept: its table reads a database at every call."""
    key = ("attenuation", material, energy_keV.size, float(energy_keV[0]), float(energy_keV[-1]))
    if key not in _KEPT:
        _KEPT[key] = mu_per_mm(material, energy_keV)
    return np.asarray(_KEPT[key])


def _deposits(energy_keV: Array, scintillator_mm: float) -> Deposits:
    """The lab's deposits in a scintillator, those of the last line kept."""
    key = ("deposits", energy_keV.size, float(energy_keV[0]), float(energy_keV[-1]), scintillator_mm)
    if key not in _KEPT:
        for old in [name for name in _KEPT if name[0] == "deposits"][:-200]:
            del _KEPT[old]
        _KEPT[key] = compute_deposits(energy_keV, scintillator_mm=scintillator_mm)
    found: Deposits = _KEPT[key]
    return found


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
        ratio = np.asarray(values) * composition(material)[1] / 10.0 / _mu_per_mm(material, energy_keV)
        _KEPT[key] = np.clip(ratio - 1.0, -0.1, 0.1)
    return _KEPT[key]


def information_limit(
    derivatives: dict[tuple[float, str], tuple[Array, Array]],
    beam: tuple[float, str],
    errors: dict[tuple[float, str], tuple[float, float]],
    *,
    prior: Array,
    discrepancies: tuple[float, float],
    read_share: float,
) -> tuple[float, float]:
    """Relative standard deviations of mean and temporal noise of a beam that no linear estimate can undercut.

    Args:
        derivatives: of level and gain by the unknowns, of all beams.
        beam: to predict.
        errors: of each measured beam, the relative sd of level and of gain.
        prior: covariance of the unknowns before any measurement.
        discrepancies: relative sd of a single level and gain beyond the unknowns, of measured and predicted beams.
        read_share: share of the setting's variance that is not quantum noise.
    """
    information = np.linalg.inv(prior)
    for measured, known in errors.items():
        for row, own, extra in zip(derivatives[measured], known, discrepancies, strict=True):
            information = information + np.outer(row, row) / (own**2 + extra**2)
    covariance = np.linalg.inv(information)
    level, gain = derivatives[beam]
    mean = math.sqrt(level @ covariance @ level + discrepancies[0] ** 2)
    both = level + gain
    extra = discrepancies[0] ** 2 + discrepancies[1] ** 2
    noise = 0.5 * (1.0 - read_share) * math.sqrt(both @ covariance @ both + extra)
    return mean, noise


def calibrated(path: Path, beams: Iterable[tuple[float, str]] | None, seed: int) -> Twin:
    """The twin of a session, or of the part of it that belongs to some beams."""
    with open_acquisition(path) as acquisition:
        part: Any = acquisition if beams is None else Part(acquisition, beams)
        return calibrate_twin(part, rng=np.random.default_rng([seed, 79]), advise=False)


def run_system(seed: int, *, kind: str, folder: Path, repeats: int = 1) -> dict[str, Any]:
    """Everything that is kept of one system."""
    session, lab = prepare(seed, kind, folder, repeats=repeats)
    derivatives = {(kV, layers): (np.array(level), np.array(gain)) for kV, layers, level, gain in lab["derivatives"]}
    prior = prior_covariance(lab["unknowns"])
    rows: list[dict[str, Any]] = []
    for protocol, chosen in PROTOCOLS.items():
        twin = calibrated(session, chosen, seed)
        if twin.spectral is None:
            rows.append({"protocol": protocol, "failed": list(twin.warnings)})
            continue
        errors = {}
        for level in twin.levels:
            pair = (level.rate_DN_per_mAs, level.photon_transfer_slope_DN)
            known = [(item.high - item.low) / (2 * Z95) / item.value for item in pair if item is not None]
            errors[level.kV or 0.0, text_from_filters(level.filters)] = (known[0], known[1])
        for number, (setting, truth) in enumerate(zip(SETTINGS, lab["truths"], strict=True)):
            found = predict_flatfield(twin, setting)
            quantum = truth["photon_transfer_slope_DN"] * truth["mean_DN"] / setting.averaged
            row: dict[str, Any] = {"protocol": protocol, "setting": number, "extrapolated": found.extrapolated}
            for name, extra in (("limit", (LEVEL_DISCREPANCY, GAIN_DISCREPANCY)), ("bare_limit", (0.0, 0.0))):
                limits = information_limit(
                    derivatives,
                    (setting.kV, text_from_filters(setting.filters)),
                    errors,
                    prior=prior,
                    discrepancies=extra,
                    read_share=max(0.0, 1.0 - quantum / truth["sd_DN"] ** 2),
                )
                row[f"mean_DN_{name}"], row[f"sd_DN_{name}"] = limits
            for name in ("mean_DN", "sd_DN"):
                estimate = getattr(found, name)
                row[name] = [truth[name], estimate.value, estimate.low, estimate.high]
            rows.append(row)
        rows.append({"protocol": protocol, "errors": [[*key, *value] for key, value in errors.items()]})
    return {"seed": seed, "kind": kind, "rows": rows}


def take_next(seed: int, *, kind: str, folder: Path, protocol: str) -> dict[str, Any]:
    """Errors and widths of the levels' predictions before and after the measurement that calibration names is taken."""
    session, lab = prepare(seed, kind, folder)
    before = calibrated(session, PROTOCOLS[protocol], seed)
    named = next(item for item in rank_measurements(before) if item.kind == "flats")
    beam = (named.setting.kV, text_from_filters(named.setting.filters))
    again = folder / f"{kind}_{seed}_{protocol}_next.h5"
    measure(again, Line(seed, kind), seed, [*PROTOCOLS[protocol], beam], part=1)
    after = calibrated(again, None, seed)
    again.unlink()
    rows = []
    for twin in (before, after):
        found = [predict_flatfield(twin, setting).mean_DN for setting in SETTINGS]
        truth = np.array([item["mean_DN"] for item in lab["truths"]])
        rows.append(
            {
                "errors": [math.log(item.value / exact) for item, exact in zip(found, truth, strict=True)],
                "width": float(np.mean([(item.high - item.low) / item.value for item in found])),
            }
        )
    return {"seed": seed, "measurement": str(named.setting), "shrinks_to": named.shrinks_to, "rows": rows}


def print_next(protocol: str, taken: list[dict[str, Any]]) -> dict[str, Any]:
    """What the named measurement promised, and what it did to intervals and errors, over all systems."""
    promised = float(np.median([item["shrinks_to"] for item in taken]))
    widths = [item["rows"][1]["width"] / item["rows"][0]["width"] for item in taken]
    errors = [100 * math.sqrt(float(np.mean(np.square([item["rows"][n]["errors"] for item in taken])))) for n in (0, 1)]
    print(
        f"{protocol}, {len(taken)} systems: the named measurement takes the intervals to {100 * promised:.0f} % (promised),"
        f" {100 * float(np.median(widths)):.0f} % (found; medians); rms error of the level {errors[0]:.2f} % -> {errors[1]:.2f} %"
    )
    return {"protocol": protocol, "systems": len(taken), "promised": promised, "widths": widths, "rms_percent": errors}


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


def run(
    seeds: Iterable[int], *, kind: str, folder: Path, processes: int = 1, fresh: bool = False, repeats: int = 1
) -> list[dict[str, Any]]:
    """Results of all seeds; those kept in the folder are not computed again, unless `fresh`."""
    done: dict[int, dict[str, Any]] = {}
    file = folder / (f"{kind}_x{repeats}_results.jsonl" if repeats > 1 else f"{kind}_results.jsonl")
    if fresh:
        file.unlink(missing_ok=True)
    if file.exists():
        for text in file.read_text(encoding="utf-8").splitlines():
            try:
                result = json.loads(text)
            except json.JSONDecodeError:
                continue  # cut off when the run was stopped
            done[result["seed"]] = result
    wanted = list(seeds)
    missing = [seed for seed in wanted if seed not in done]
    folder.mkdir(parents=True, exist_ok=True)
    job = partial(run_system, kind=kind, folder=folder, repeats=repeats)
    with ExitStack() as stack, file.open("a", encoding="utf-8") as out:
        # a process of its own keeps the spectra that it has computed
        finished = (
            map(job, missing)
            if processes == 1
            else stack.enter_context(ProcessPoolExecutor(processes)).map(job, missing)
        )
        for result in tqdm(finished, total=len(missing), disable=None, file=sys.stderr):
            done[result["seed"]] = result
            out.write(json.dumps(result) + "\n")
            out.flush()
    return [done[seed] for seed in wanted]


def main() -> int:
    """Run the systems and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=200)
    parser.add_argument("--first", type=int, default=1000, help="first seed; development used seeds below 1000")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--kind", choices=("nominal", "departing", "coarse"), default="nominal")
    parser.add_argument("--repeats", type=int, default=1, help="series that each flat's frames come in")
    parser.add_argument("--folder", type=Path, default=Path("build/prediction_limit"), help="sessions and results")
    parser.add_argument("--fresh", action="store_true", help="calibrate again; the lab's sessions are kept")
    parser.add_argument("--prepare", action="store_true", help="only measure the sessions")
    parser.add_argument("--next", type=int, default=0, help="systems in which the measurement named next is taken")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    started = time.perf_counter()
    seeds = range(arguments.first, arguments.first + arguments.systems)
    if arguments.prepare:
        for seed in tqdm(seeds, disable=None, file=sys.stderr):
            prepare(seed, arguments.kind, arguments.folder, repeats=arguments.repeats)
        return 0
    results = run(
        seeds,
        kind=arguments.kind,
        folder=arguments.folder,
        processes=arguments.processes,
        fresh=arguments.fresh,
        repeats=arguments.repeats,
    )
    table = summarise(results)
    print(f"{len(results)} {arguments.kind} systems, {time.perf_counter() - started:.0f} s")
    print_table(table)
    taken = [
        print_next(
            protocol,
            [
                take_next(seed, kind=arguments.kind, folder=arguments.folder, protocol=protocol)
                for seed in tqdm(seeds[: arguments.next], disable=None, file=sys.stderr)
            ],
        )
        for protocol in ("A", "D")
        if arguments.next
    ]
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"table": table, "next": taken}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Predictions at settings never measured, on lines whose physics is not the twin's: coverage, errors, information limit.

    python validation/foreign_lines.py [--lines 20] [--first 1] [--families kqp,no_escape,...] [--protocols A,B,C,D]
        [--processes 1] [--folder build/foreign_lines] [--fresh] [--summary] [--json FILE]

Numbers, not frames: each line has levels and gains with sampling noise, as photon transfer would give them. Its truth is a sum
over energies that shares no formula with the posterior: attenuation from Chantler's tables and escape from the lab, SpekPy's
spectra, light from electrons followed through a cascade by a table of light against electron energy, light dimmed with the
depth of each interaction, voltages averaged over a waveform, anodes grooved to random depths. Each family shows one of these in
full beside what any line has (filtration, thickness, 1 % of voltage, 1 % of filters, output off by 2 % an e-fold of voltage):

    kqp          SpekPy's kqp and nothing else         spekcalc     the semi-empirical model before casim and kqp
    no_escape    no K photon leaves                    some_escape  10 to 80 % of those of a flat slab leave
    light        light not proportional to energy      depth        light from the far side dimmer by 10 to 35 %
    ripple       12 pulses, or 2 to 10 % of a converter worn        1 to 6 um of the anode to cross, exponentially spread
    cover        plastic, carbon, aluminium; 2 to 15 um of dead scintillator
    counter      a counter of 0.75 to 2 mm CdTe; its threshold of 5 to 35 keV and its resolution are not declared
    window       a beryllium window (0 to 0.1 mm Al), and 0.2 to 1 mm of aluminium or 0.6 to 3 mm of carbon before the panel
    thin         60 to 80 % of the label's scintillator gadox       Gd2O2S, filled to 50 to 70 %
    mixed        each of these with a chance of one half

No size in `calibration.spectrum.priors` was learned on any of them: each has its own source there.

Protocols: A  40 and 90 kV, with 2 mm Al and without;  B  90 kV, with 2 mm Al and without;
           C  40, 70 and 110 kV, with 2 mm Al and without;  D  40 and 90 kV behind 0.05 mm Cu (the paper's).

The limit is the standard deviation that a linear and Gaussian estimate with the same priors reaches at the fitted point. Results
are kept in `--folder`, so that a run that was stopped goes on.
"""

import argparse
import json
import math
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from tqdm import tqdm

from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import Filter, Setting, filters_from_text
from raytwin.calibration.spectrum.priors import GAIN_DISCREPANCY, LEVEL_DISCREPANCY, SHARES_CORRELATION, TABLE_SHARE
from raytwin.calibration.spectrum.spectral_data import geometry_factor
from raytwin.calibration.spectrum.spectral_fit import fit_spectrum
from raytwin.calibration.spectrum.spectral_model import model_for, priors_for
from raytwin.generator.line.photon_tables import OTHER_TABLES
from raytwin.generator.line.spectral_signal import OpenBeam, SpectralModel
from raytwin.generator.line.twin import DetectorMaps, Level, NoiseModel, Twin, estimate_from_sd, gaussian_spread
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.lab.attenuation import composition, mu_per_mm
from raytwin.spectra import air_kerma_uGy_per_mAs, energy_grid_keV, tube_fluence_interpolated
from raytwin.spectra.spectrum import Spectrum

Array = NDArray[np.float64]
FAMILIES = (
    "kqp",
    "spekcalc",
    "no_escape",
    "some_escape",
    "light",
    "depth",
    "ripple",
    "worn",
    "cover",
    "thin",
    "gadox",
    "mixed",
    "window",
    "counter",
)
QUANTITIES = ("mean_DN", "sd_DN", "air_kerma_uGy")
COPPER, ALUMINIUM = "Cu:0.05", "Al:2"
PROTOCOLS: dict[str, tuple[tuple[float, str], ...]] = {
    "A": tuple((kV, layers) for kV in (40.0, 90.0) for layers in ("", ALUMINIUM)),
    "B": ((90.0, ""), (90.0, ALUMINIUM)),
    "C": tuple((kV, layers) for kV in (40.0, 70.0, 110.0) for layers in ("", ALUMINIUM)),
    "D": ((40.0, COPPER), (90.0, COPPER)),
}
SETTINGS = (
    (50.0, ""),
    (50.0, "Cu:0.1"),
    (60.0, COPPER),
    (60.0, "Al:1"),
    (70.0, "Cu:0.5"),
    (75.0, "Al:2"),
    (80.0, "Cu:0.1"),
    (90.0, "Cu:0.05+Al:1"),
    (100.0, ""),
    (100.0, "Cu:0.5"),
    (120.0, "Al:2"),
    (120.0, "Cu:0.1"),
)
PIXEL_MM, DISTANCE_MM = 0.15, 1059.0
LEVEL_SAMPLING, SLOPE_SAMPLING, GAIN_SAMPLING = 0.0005, 0.004, 0.01  # relative sd that 100 frames of a small panel give
REPEATS = 0.001  # relative sd of a line's output between series
SHARE = 0.4  # photon-transfer slope over gain; of a counter 1: a pixel's counts have the variance of their mean
Z95 = 1.959964
# Light for each keV of stopped electrons against their energy (keV), rounded from published curves of CsI(Tl): a broad
# maximum between 8 and 20 keV, some 15 % above the light at 662 keV, and a steep fall below 3 keV
ELECTRON_KEV = (0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 40.0, 80.0, 160.0, 662.0)
ELECTRON_LIGHT = (0.55, 0.70, 0.88, 0.99, 1.05, 1.11, 1.14, 1.15, 1.145, 1.12, 1.09, 1.06, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignLine:
    """A line that no formula of the twin describes; lengths in mm unless the name says otherwise.

    electron_light: power of the electron response, 1 as published; depth_dimming: light from the entrance side is dimmer
    by exp(-dimming); waveform: tube voltages over the set one, equally long; threshold_keV: of a counter, whose pulse heights
    have the standard deviation resolution_keV.
    """

    family: str
    model: str = "kqp"
    filtration_mm_Al: float = 1.0
    kV_error: float = 0.0
    kV_tilt: float = 0.0
    output: float = 1.0
    output_exponent: float = 0.0
    DN_per_keV: float = 0.1
    light_swank: float = 0.9
    scintillator: str = "CsI"
    label_mm: float = 0.5
    thickness_mm: float = 0.5
    escape: float = 1.0
    electron_light: float = 0.0
    depth_dimming: float = 0.0
    waveform: tuple[float, ...] = (1.0,)
    groove_um: float = 0.0
    cover: tuple[Filter, ...] = ()
    dead_um: float = 0.0
    threshold_keV: float | None = None
    resolution_keV: float = 1.5
    filter_scale: dict[str, float] = field(default_factory=dict)

    def instrument(self) -> Instrument:
        """What the line's owner declares."""
        name = "CsI" if self.scintillator == "CsI" else self.scintillator
        return Instrument(
            pixel_mm=PIXEL_MM,
            source_detector_mm=DISTANCE_MM,
            source_object_mm=DISTANCE_MM,
            scintillator=(Filter(material=name, thickness_mm=self.label_mm),),
            maximum_power_w=90.0,
            counting=self.threshold_keV is not None,
        )


def draw_line(family: str, seed: int) -> ForeignLine:
    """A line of a family: what any line has, and the family's own feature in full."""
    rng = np.random.default_rng([seed, FAMILIES.index(family), 91])

    def has(name: str) -> bool:
        return family == name or (family == "mixed" and bool(rng.random() < 0.5))

    features: dict[str, Any] = {}
    if has("no_escape"):
        features["escape"] = 0.0
    if has("some_escape"):
        features["escape"] = rng.uniform(0.1, 0.8)
    if has("light"):
        features["electron_light"] = rng.uniform(0.4, 1.5)
    if has("depth"):
        features["depth_dimming"] = rng.uniform(0.1, 0.35)
    if has("ripple"):
        phase = (np.arange(8) + 0.5) / 8
        ripple = rng.uniform(0.02, 0.10)
        twelvefold = np.cos((phase - 0.5) * math.pi / 6)
        waveform = twelvefold if rng.random() < 0.3 else 1.0 - ripple * phase
        features["waveform"] = tuple(float(item) for item in waveform)
    if has("worn"):
        features["groove_um"] = rng.uniform(1.0, 6.0)
    if has("cover"):
        material, most_mm = (("pmma", 2.0), ("C@1.8", 1.5), ("Al", 0.3))[int(rng.integers(3))]
        features["cover"] = (Filter(material=material, thickness_mm=float(rng.uniform(0.2, 1.0)) * most_mm),)
        features["dead_um"] = rng.uniform(2.0, 15.0)
    gadox = family == "gadox" or (family == "mixed" and rng.random() < 0.3)
    label_mm = 0.15 if gadox else 0.5
    share = math.exp(0.12 * rng.standard_normal()) * 0.95
    if gadox:
        share, features["scintillator"] = rng.uniform(0.5, 0.7), "Gd2O2S@7.32"
    elif has("thin"):
        share = rng.uniform(0.6, 0.8)
    model = "spekcalc" if has("spekcalc") else "kqp" if family != "mixed" or rng.random() < 0.5 else "casim"
    filtration_mm_Al = math.exp(rng.uniform(math.log(0.3), math.log(3.0)))
    if family == "window":
        material, most_mm = (("C@1.8", 3.0), ("Al", 1.0))[int(rng.integers(2))]
        features["cover"] = (Filter(material=material, thickness_mm=float(rng.uniform(0.2, 1.0)) * most_mm),)
        filtration_mm_Al = rng.uniform(0.0, 0.1)
    if family == "counter":
        label_mm, share, features["scintillator"] = rng.uniform(0.75, 2.0), 1.0, "CdTe@5.85"
        features |= {"escape": rng.uniform(0.0, 1.0), "dead_um": rng.uniform(0.0, 5.0)}
        features |= {"threshold_keV": rng.uniform(5.0, 35.0), "resolution_keV": rng.uniform(1.0, 2.5)}
    return ForeignLine(
        family=family,
        model=model,
        filtration_mm_Al=filtration_mm_Al,
        kV_error=0.005 * round(float(np.clip(rng.standard_normal(), -2.5, 2.5)) / 0.5),
        kV_tilt=0.002 * float(rng.standard_normal()) if family != "spekcalc" else 0.0,
        output=math.exp(0.2 * rng.standard_normal()),
        output_exponent=0.02 * float(rng.standard_normal()),
        DN_per_keV=0.1 * math.exp(0.5 * rng.standard_normal()) if family != "counter" else 1.0,
        light_swank=rng.uniform(0.82, 0.98) if family != "counter" else 1.0,
        label_mm=label_mm,
        thickness_mm=label_mm * share,
        filter_scale={name: 1.0 + 0.01 * float(rng.standard_normal()) for name in ("Al", "Cu")},
        **features,
    )


@lru_cache(maxsize=512)
def _old_spectrum(kV: float) -> Array:
    """SpekCalc's fluence (energy,) on the common grid, as SpekPy has it, photons / keV / cm2 / mAs at 1 m."""
    import spekpy

    energies, fluence = spekpy.Spek(kvp=kV, th=12.0, dk=0.5, physics="spekcalc", targ="W", z=100, mas=1).get_spectrum()
    return np.interp(energy_grid_keV(kV), energies, fluence, left=0.0, right=0.0)


def photons_of(line: ForeignLine, kV: float, filters: tuple[Filter, ...]) -> tuple[Array, Array]:
    """Energies (energy,) keV and photons behind the filters a 0.5 keV bin, mAs and mm2 at 1 m (energy,)."""
    mean_error = line.kV_error + line.kV_tilt * math.log(kV / 60.0)
    energies = energy_grid_keV(kV * (1.0 + max(mean_error, 0.0)) + 0.5)
    total = np.zeros(energies.size)
    for share in line.waveform:
        real_kV = kV * (1.0 + mean_error) * share
        if line.model == "spekcalc":
            # whole kV about the wanted one, linearly
            below = math.floor(real_kV)
            for node, weight in ((below, below + 1 - real_kV), (below + 1, real_kV - below)):
                found = _old_spectrum(float(node))[: energies.size]
                total[: found.size] += weight * found
        else:
            grid = energy_grid_keV(real_kV)
            total[: grid.size] += tube_fluence_interpolated(real_kV, energies_keV=grid, model=line.model, for_sums=True)
    total *= line.output * (kV / 60.0) ** line.output_exponent / len(line.waveform) * 0.5 / 100.0
    total *= np.exp(-mu_per_mm("Al", energies) * line.filtration_mm_Al)
    if line.groove_um:
        total /= 1.0 + mu_per_mm("W", energies) * 1e-3 * line.groove_um
    for layer in filters:
        scale = line.filter_scale.get(layer.material, 1.0)
        total *= np.exp(-mu_per_mm(layer.material, energies) * layer.thickness_mm * scale)
    return energies, np.clip(total, 0.0, None)


def _electron_light(energy_keV: Array, power: float) -> Array:
    """Light of stopped electrons (keV-equivalents), by their energies."""
    each = np.interp(np.log(np.maximum(energy_keV, 0.1)), np.log(ELECTRON_KEV), ELECTRON_LIGHT)
    return np.asarray(np.maximum(energy_keV, 0.0) * each**power)


def moments_of(line: ForeignLine, energies: Array) -> tuple[Array, Array, Array]:
    """First and second moment of the light of a photon (energy,), in keV and keV2, and the share that interacts."""
    import xraydb

    fractions, density = composition(line.scintillator)
    mu = mu_per_mm(line.scintillator, energies)
    reaching = np.exp(-mu * 1e-3 * line.dead_um)
    for layer in line.cover:
        reaching *= np.exp(-mu_per_mm(layer.material, energies) * layer.thickness_mm)
    # depths in equal steps of the layer; the light of each depth
    depth = (np.arange(60) + 0.5) / 60 * line.thickness_mm
    stopped = np.exp(-mu[:, None] * depth) * -np.expm1(-mu[:, None] * line.thickness_mm / 60)
    stopped /= np.exp(-0.5 * mu[:, None] * line.thickness_mm / 60)
    dimming = np.exp(-line.depth_dimming * (1.0 - depth / line.thickness_mm))
    first_light, second_light = stopped @ dimming, stopped @ dimming**2
    interacting = stopped.sum(axis=1)

    def light(energy_keV: Array) -> Array:
        return _electron_light(np.asarray(energy_keV, dtype=float), line.electron_light)

    shells = []
    for element, fraction in fractions.items():
        edge = xraydb.xray_edge(element, "K")
        edge_keV = edge.energy / 1000.0
        if xraydb.atomic_number(element) < 30 or not np.any(energies > edge_keV):
            continue
        l_keV = xraydb.xray_edge(element, "L3").energy / 1000.0
        above = energies > edge_keV
        photo = np.zeros(energies.size)
        photo[above] = np.asarray(xraydb.mu_chantler(element, energies[above] * 1000.0, photo=True))
        share = fraction * photo * density / 10.0 / mu * (1.0 - 1.0 / edge.jump_ratio)
        lines = xraydb.xray_lines(element, "K")
        total = sum(item.intensity for item in lines.values())
        alpha = [item for name, item in lines.items() if name.startswith("Ka")]
        part = sum(item.intensity for item in alpha) / total
        line_keV = sum(item.intensity * item.energy for item in alpha) / sum(item.intensity for item in alpha) / 1000.0
        shells.append((edge_keV, l_keV, share, edge.fyield, line_keV, part))
    leaves_of = _slab_escape(line)
    if line.threshold_keV is not None:
        lost = [
            (share * of_k * line.escape * leaves_of(mu, line_keV), line_keV)
            for _, _, share, of_k, line_keV, _ in shells
        ]
        left = [(1.0 - sum(chance for chance, _ in lost), 0.0), *lost]
        counted = sum(
            chance * ndtr((energies - gone_keV - line.threshold_keV) / line.resolution_keV) for chance, gone_keV in left
        )
        return reaching * interacting * counted, reaching * interacting * counted, reaching * interacting
    mean_l = float(np.mean([shell[1] for shell in shells])) if shells else 5.0
    outer = light(energies - mean_l) + light(np.full(energies.size, mean_l))
    first = np.ones(energies.size) * outer
    second = outer**2
    for edge_keV, l_keV, share, fluorescence, line_keV, _ in shells:
        electron = light(energies - edge_keV)
        rest = light(np.array([l_keV]))[0]
        kept = electron + rest + light(np.array([line_keV - l_keV]))[0] + rest
        auger = electron + light(np.array([edge_keV - 2 * l_keV]))[0] + 2 * rest
        gone = electron + light(np.array([edge_keV - line_keV]))[0]
        escaping = line.escape * leaves_of(mu, line_keV)
        for probability, amount in (
            (share * fluorescence * escaping, gone),
            (share * fluorescence * (1.0 - escaping), kept),
            (share * (1.0 - fluorescence), auger),
        ):
            first += probability * (amount - outer)
            second += probability * (amount**2 - outer**2)
    return reaching * first * first_light, reaching * second * second_light, reaching * interacting


def _slab_escape(line: ForeignLine) -> Any:
    """Chance that a K photon of some energy leaves the slab, by Gauss-Legendre over depth and direction."""
    depth, depth_weight = np.polynomial.legendre.leggauss(40)
    cosine, cosine_weight = np.polynomial.legendre.leggauss(40)
    depth, depth_weight = 0.5 * (depth + 1.0), 0.5 * depth_weight
    cosine, cosine_weight = 0.5 * (cosine + 1.0), 0.5 * cosine_weight

    def leaves(mu: Array, line_keV: float) -> Array:
        own = float(mu_per_mm(line.scintillator, np.array([line_keV]))[0]) * line.thickness_mm
        out = np.exp(-own * depth[:, None] / cosine) + np.exp(-own * (1.0 - depth[:, None]) / cosine)
        by_depth = 0.5 * out @ cosine_weight
        density = np.exp(-np.outer(mu * line.thickness_mm, depth)) * depth_weight
        return np.asarray(density @ by_depth / density.sum(axis=1))

    return leaves


def truth_of(line: ForeignLine, kV: float, layers: str) -> dict[str, float]:
    """Level (DN a mAs), gain (DN) and air kerma (uGy a mAs at 1 m) of a beam, without noise; 1 m and 1 mm2."""
    energies, photons = photons_of(line, kV, filters_from_text(layers))
    first, second, _ = moments_of(line, energies)
    signal, square = float(photons @ first), float(photons @ second)
    spectrum = Spectrum(energies_keV=energies, fluence=photons * 100.0 / 0.5, kV=kV)
    return {
        "rate": line.DN_per_keV * signal,
        "gain": line.DN_per_keV * square / signal / line.light_swank,
        "kerma": air_kerma_uGy_per_mAs(spectrum),
    }


def share_of(line: ForeignLine) -> float:
    """Photon-transfer slope over gain."""
    return 1.0 if line.threshold_keV else SHARE


def measured_twin(line: ForeignLine, beams: tuple[tuple[float, str], ...], rng: np.random.Generator) -> Twin:
    """A twin calibrated from levels and gains of some beams, with noise."""
    instrument = line.instrument()
    factor = geometry_factor(source_detector_mm=DISTANCE_MM, pixel_mm=PIXEL_MM)
    levels, points, share = [], [], share_of(line)
    common = math.exp(GAIN_SAMPLING * rng.standard_normal())  # of the spread, which all gains share
    for kV, layers in beams:
        exact = truth_of(line, kV, layers)
        rate = exact["rate"] * factor * math.exp(math.hypot(LEVEL_SAMPLING, REPEATS) * rng.standard_normal())
        slope = share * exact["gain"] * math.exp(SLOPE_SAMPLING * rng.standard_normal())
        gain = slope / share * common
        levels.append(
            Level(
                kV=kV,
                filters=filters_from_text(layers),
                gain_DN=estimate_from_sd(gain, math.hypot(GAIN_SAMPLING, SLOPE_SAMPLING) * gain),
                photon_transfer_slope_DN=estimate_from_sd(slope, SLOPE_SAMPLING * slope),
                rate_DN_per_mAs=estimate_from_sd(rate, LEVEL_SAMPLING * rate),
                source_detector_mm=DISTANCE_MM,
                saturation_DN=None,
                flat_shape=np.ones((8, 8), dtype=np.float32),
                series=(f"{kV:g} {layers}",),
                role="calibration",
            )
        )
        load = 30.0 / kV * 0.02
        points.append(
            {
                "series": levels[-1].series[0],
                "kV": kV,
                "used": True,
                "load_mAs": load,
                "exposure_ms": 20.0,
                "signal_DN": rate * load,
            }
        )
    fit = fit_spectrum(levels, instrument, rng=rng)
    zero = np.zeros((8, 8), dtype=np.float32)
    return Twin(
        instrument=instrument,
        maps=DetectorMaps(
            dark_DN=zero,
            dark_exposure_ms=20.0,
            dark_DN_per_ms=zero,
            gain_relative=zero + 1,
            read_variance_DN2=zero,
            bad_pixels=np.zeros((8, 8), dtype=np.uint8),
        ),
        noise=NoiseModel(
            spread=gaussian_spread("aperture", estimate_from_sd(0.5, 0.005)),
            white_fraction=0.0,
            read_noise_DN=estimate_from_sd(0.01, 0.001),
            quantised=False,
        ),
        dark_DN=estimate_from_sd(10.0, 0.1),
        levels=tuple(levels),
        spectral=fit.posterior,
        evidence={"photon_transfer": points, "chi_square": fit.chi_square},
        warnings=(),
    )


def information_limit(twin: Twin, settings: tuple[tuple[float, str], ...]) -> Array:
    """Relative sd of level and of noise (setting, 2) that a linear estimate with the twin's priors reaches at its best point."""
    posterior = twin.spectral
    if posterior is None:
        raise ValueError("a twin without spectral part has no limit")
    model = model_for(twin.instrument, materials=("Al", "Cu"), highest_kV=160.0)
    priors = priors_for(model, scintillator_declared=True)
    covariance = np.diag([priors[name].spread ** 2 for name in model.names])
    for material in model.filter_materials:
        first, second = (model.names.index(f"{table}_{material}") for table in OTHER_TABLES)
        covariance[first, second] = covariance[second, first] = SHARES_CORRELATION * TABLE_SHARE.sd**2
    information = np.linalg.inv(covariance)
    for level in twin.levels:
        rows = _slopes(model, posterior.best, priors, (level.kV or 0.0, level.filters))
        rate, slope = level.rate_DN_per_mAs, level.photon_transfer_slope_DN
        if rate is None:
            continue
        for row, item, extra in zip(rows, (rate, slope), (LEVEL_DISCREPANCY, GAIN_DISCREPANCY), strict=True):
            sd = (item.high - item.low) / (2 * Z95) / item.value
            information += np.outer(row, row) / (sd**2 + extra**2)
    left = np.linalg.inv(information)
    found = []
    for kV, layers in settings:
        level_row, gain_row = _slopes(model, posterior.best, priors, (kV, filters_from_text(layers)))
        both = level_row + gain_row
        found.append(
            (
                math.sqrt(level_row @ left @ level_row + LEVEL_DISCREPANCY**2),
                0.5 * math.sqrt(both @ left @ both + LEVEL_DISCREPANCY**2 + GAIN_DISCREPANCY**2),
            )
        )
    return np.array(found)


def _slopes(
    model: SpectralModel, best: Array, priors: dict[str, Any], beam: tuple[float, tuple[Filter, ...]]
) -> tuple[Array, Array]:
    """d ln level and d ln gain by each parameter (parameter,), over a tenth of the prior's sd to both sides."""
    steps = np.array([min(0.1 * priors[name].sd, 0.02) for name in model.names])
    steps[model.names.index("kV_error")] = 0.0025
    sets = np.concatenate([best + np.diag(steps), best - np.diag(steps)])
    found = model.signal(sets, OpenBeam(kV=beam[0], filters=beam[1]))
    count = len(best)
    logs = [np.log(found.rate_DN_per_mAs), np.log(found.gain_DN)]
    level, gain = ((item[:count] - item[count:]) / (2 * steps) for item in logs)
    return level, gain


def run_line(job: tuple[str, int, tuple[str, ...]]) -> dict[str, Any]:
    """Everything that is kept of one line."""
    family, seed, protocols = job
    line = draw_line(family, seed)
    factor = geometry_factor(source_detector_mm=DISTANCE_MM, pixel_mm=PIXEL_MM)
    truths = [truth_of(line, *setting) for setting in SETTINGS]
    rows = []
    for name in protocols:
        rng = np.random.default_rng([seed, FAMILIES.index(family), ord(name)])
        twin = measured_twin(line, PROTOCOLS[name], rng)
        limits = information_limit(twin, SETTINGS)
        row: dict[str, Any] = {"protocol": name, "chi_square": twin.evidence["chi_square"], "settings": []}
        for (kV, layers), truth, limit in zip(SETTINGS, truths, limits, strict=True):
            setting = Setting(kV=kV, current_mA=0.5, exposure_ms=20.0, filters=filters_from_text(layers))
            found = predict_flatfield(twin, setting)
            mean = truth["rate"] * factor * 0.01
            exact = {
                "mean_DN": mean,
                "sd_DN": math.sqrt(share_of(line) * truth["gain"] * mean),
                "air_kerma_uGy": truth["kerma"] * (1000.0 / DISTANCE_MM) ** 2 * 0.01,
            }
            row["settings"].append(
                {
                    quantity: [
                        *(math.log(one / exact[quantity]) for one in (estimate.value, estimate.low, estimate.high)),
                        # no limit is known of the kerma, which the output's prior decides
                        float(limit[at]) if at < len(limit) else None,
                    ]
                    for at, quantity in enumerate(QUANTITIES)
                    if (estimate := getattr(found, quantity)) is not None
                }
            )
        rows.append(row)
    return {"family": family, "seed": seed, "rows": rows}


def summarise(results: list[dict[str, Any]], *, draws: int = 1000) -> list[dict[str, Any]]:
    """Per protocol, family and quantity: errors, half widths, coverage with a bootstrap over lines, errors over the limit."""
    rng = np.random.default_rng(0)
    table = []
    for protocol in PROTOCOLS:
        for family in (*FAMILIES, "all"):
            for quantity in QUANTITIES:
                values = np.array(
                    [
                        [setting[quantity] for setting in row["settings"]]
                        for result in results
                        for row in result["rows"]
                        if row["protocol"] == protocol and family in ("all", result["family"])
                    ],
                    dtype=np.float64,  # None: not a number
                )
                if not len(values):
                    continue
                error, low, high, limit = (values[:, :, column] for column in range(4))
                inside = (low <= 0) & (high >= 0)
                half = np.where(error > 0, error - low, high - error)
                picks = rng.integers(0, len(values), size=(draws, len(values)))
                coverage = inside.mean(axis=1)[picks].mean(axis=1)
                table.append(
                    {
                        "protocol": protocol,
                        "family": family,
                        "quantity": quantity,
                        "lines": len(values),
                        "median_error_percent": 100 * float(np.median(np.abs(error))),
                        "worst_error_percent": 100 * float(np.max(np.abs(error))),
                        "half_width_percent": 50 * float(np.mean(high - low)),
                        "coverage_percent": 100 * float(np.mean(inside)),
                        "coverage_interval": [100 * float(item) for item in np.quantile(coverage, [0.025, 0.975])],
                        "worst_half_widths": float(np.max(np.abs(error) / half)),
                        "ratio": None if np.isnan(limit).any() else float(np.sqrt(np.mean((error / limit) ** 2))),
                    }
                )
    return table


def print_table(table: list[dict[str, Any]]) -> None:
    """The summary for people."""
    print(
        f"{'':<3}{'family':<13}{'':<15}{'lines':>6}{'median %':>10}{'worst %':>9}{'width %':>9}"
        f"{'coverage % (95 %)':>24}{'worst/half':>12}{'rms/limit':>11}"
    )
    for row in table:
        covered = f"{row['coverage_percent']:.1f} ({row['coverage_interval'][0]:.0f}-{row['coverage_interval'][1]:.0f})"
        print(
            f"{row['protocol']:<3}{row['family']:<13}{row['quantity']:<15}{row['lines']:>6}"
            f"{row['median_error_percent']:>10.2f}{row['worst_error_percent']:>9.2f}{row['half_width_percent']:>9.2f}"
            f"{covered:>24}{row['worst_half_widths']:>12.2f}"
            + ("" if row["ratio"] is None else f"{row['ratio']:>11.2f}")
        )


def run(
    jobs: list[tuple[str, int, tuple[str, ...]]], *, folder: Path, processes: int = 1, fresh: bool = False
) -> list[dict[str, Any]]:
    """Results of all jobs; those kept in the folder are not computed again, unless `fresh`."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "results.jsonl"
    if fresh:
        file.unlink(missing_ok=True)
    done: dict[tuple[str, int], dict[str, Any]] = {}
    if file.exists():
        for text in file.read_text(encoding="utf-8").splitlines():
            try:
                result = json.loads(text)
            except json.JSONDecodeError:
                continue  # cut off when the run was stopped
            done[result["family"], result["seed"]] = result

    def missing(job: tuple[str, int, tuple[str, ...]]) -> bool:
        kept = done.get(job[:2])
        return kept is None or not set(job[2]) <= {row["protocol"] for row in kept["rows"]}

    wanted = [job for job in jobs if missing(job)]
    with ExitStack() as stack, file.open("a", encoding="utf-8") as out:
        finished = (
            map(run_line, wanted)
            if processes == 1
            else stack.enter_context(ProcessPoolExecutor(processes)).map(run_line, wanted)
        )
        for result in tqdm(finished, total=len(wanted), disable=None, file=sys.stderr):
            done[result["family"], result["seed"]] = result
            out.write(json.dumps(result) + "\n")
            out.flush()
    return [done[job[:2]] for job in jobs]


def main() -> int:
    """Run the lines and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=20, help="lines of each family")
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--families", default=",".join(FAMILIES))
    parser.add_argument("--protocols", default=",".join(PROTOCOLS))
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("build/foreign_lines"), help="where results are kept")
    parser.add_argument("--fresh", action="store_true", help="compute all lines again")
    parser.add_argument("--summary", action="store_true", help="print only the rows of all families together")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    started = time.perf_counter()
    protocols = tuple(arguments.protocols.split(","))
    jobs = [
        (family, seed, protocols)
        for seed in range(arguments.first, arguments.first + arguments.lines)
        for family in arguments.families.split(",")
    ]
    results = run(jobs, folder=arguments.folder, processes=arguments.processes, fresh=arguments.fresh)
    table = summarise(results)
    print(f"{len(results)} lines, {time.perf_counter() - started:.0f} s")
    print_table([row for row in table if row["family"] == "all"] if arguments.summary else table)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

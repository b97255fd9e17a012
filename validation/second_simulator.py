"""Diagnoses of sessions that another, plain simulator makes: one planted effect each, two, and none.

The simulator shares no code with the twin or the virtual lab but the file format. It does share xraylib's cross sections
with the twin, so that wrong attenuation tables are not tried here, and SpekPy, of which it takes another model and table
(`kqp`, NIST). A panel that adds up energies, Gaussian noise of the compound Poisson's variance, objects sampled at points
(no pixel is cut by an edge), a Gaussian spread, no times; five lines of other pixels, distances, beams and scintillators
(`LINES`), a panel whose pixels are all alike and see no farther than themselves (`even`), two that count (`counting`: darks
of zeros; `threshold`: from 20 keV on, as declared), and any number of lines of which all is drawn (`random`). Its effects
are laws of its own: scatter and tails are Gaussians, glare is two of them, lag is one exponential, the focal spot a
Gaussian, drift is white, tiles are steps of gain; K photons are caught under two Gaussians, a moving object is seen in nine
places, a heel is a wedge of tungsten, displaced objects have shifted path lengths.

    python validation/second_simulator.py --seed 1 --json build/second_simulator.json
    python validation/second_simulator.py --line coarse
    python validation/second_simulator.py --line random --seed 200 --frames 12
    python validation/second_simulator.py --only none kv_error tiles veiling_glare+kv_error
"""

import argparse
import contextlib
import copy
import dataclasses
import json
import math
import tempfile
import zlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import xraylib
from scipy.ndimage import gaussian_filter, shift
from scipy.special import ndtr

from raytwin.acquisition import open_acquisition, write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import filters_from_text
from raytwin.diagnosis.diagnose_session import diagnose

DARK_SLOPE_DN_PER_MS, OPTICAL = 0.02, 1.05
DENSITY = {"Al": 2.699, "Pb": 11.35, "H2O": 1.0, "Cu": 8.96, "W": 19.3, "Gd2O2S": 4.38, "CsI": 4.51, "CdTe": 5.85}
NAMES = {"Al": "Al", "Pb": "Pb", "H2O": "water"}


@dataclass(frozen=True, kw_only=True)
class LineOf:
    """A line: pixels, distances, panel and beams.

    Fields: shape (rows, columns); pixel_mm; near_mm, far_mm (of objects from the source), detector_mm; spread_px; read_DN; dark_DN;
    bits; DN_per_keV; photons: scale of SpekPy's; scintillator: material and mm; edge_keV, line_keV: its K edge and K line; lag_s;
    pause_s (between series); readout_ms; current_mA by kV, copper_times: of it behind copper; anode_deg; beryllium_mm; wedge_mm,
    water_mm, lead_mm: a step, the slab, the edge; counting: numbers of photons instead of their energies, and darks of zeros;
    threshold_keV: from where on they count; even: all pixels alike; declared: whether the scintillator and what filters the beam are.
    """

    shape: tuple[int, int]
    pixel_mm: float
    near_mm: float
    far_mm: float
    detector_mm: float
    spread_px: float
    read_DN: float
    dark_DN: float
    bits: int
    DN_per_keV: float
    photons: float
    scintillator: tuple[str, float]
    edge_keV: float
    line_keV: float
    lag_s: float
    pause_s: float
    readout_ms: float
    current_mA: dict[float, float]
    copper_times: float
    anode_deg: float
    beryllium_mm: float
    wedge_mm: float
    water_mm: float
    lead_mm: float
    counting: bool = False
    threshold_keV: float = 0.0
    even: bool = False
    declared: bool = True

    @property
    def highest_DN(self) -> int:
        """The largest number that the ADC gives."""
        return 2**self.bits - 1

    @property
    def tile_px(self) -> tuple[int, int]:
        """A sixteenth of the panel."""
        return self.shape[0] // 4, self.shape[1] // 4


LINES = {
    "usual": LineOf(
        shape=(104, 136),
        pixel_mm=0.2,
        near_mm=480.0,
        far_mm=360.0,
        detector_mm=700.0,
        spread_px=0.55,
        read_DN=6.0,
        dark_DN=300.0,
        bits=14,
        DN_per_keV=0.012,
        photons=7e-4,
        scintillator=("Gd2O2S", 0.18),
        edge_keV=50.24,
        line_keV=42.8,
        lag_s=0.2,
        pause_s=6.0,
        readout_ms=5.0,
        current_mA={50.0: 6.0, 100.0: 1.0},
        copper_times=2.0,
        anode_deg=16.0,
        beryllium_mm=2.5,
        wedge_mm=1.5,
        water_mm=20.0,
        lead_mm=3.0,
    ),
    "coarse": LineOf(
        shape=(120, 104),
        pixel_mm=0.4,
        near_mm=1000.0,
        far_mm=850.0,
        detector_mm=1300.0,
        spread_px=0.4,
        read_DN=4.0,
        dark_DN=500.0,
        bits=16,
        DN_per_keV=0.038,
        photons=7e-4,
        scintillator=("CsI", 0.5),
        edge_keV=34.5,
        line_keV=29.5,
        lag_s=0.5,
        pause_s=8.0,
        readout_ms=10.0,
        current_mA={40.0: 8.0, 80.0: 1.5},
        copper_times=2.0,
        anode_deg=12.0,
        beryllium_mm=1.0,
        wedge_mm=2.0,
        water_mm=25.0,
        lead_mm=1.5,
    ),
    "hard": LineOf(
        shape=(128, 128),
        pixel_mm=0.127,
        near_mm=300.0,
        far_mm=200.0,
        detector_mm=420.0,
        spread_px=0.9,
        read_DN=12.0,
        dark_DN=1500.0,
        bits=16,
        DN_per_keV=0.095,
        photons=7e-4,
        scintillator=("Gd2O2S", 0.2),
        edge_keV=50.24,
        line_keV=42.8,
        lag_s=0.1,
        pause_s=4.0,
        readout_ms=20.0,
        current_mA={60.0: 2.0, 140.0: 0.3},
        copper_times=1.0,
        anode_deg=12.0,
        beryllium_mm=1.0,
        wedge_mm=2.0,
        water_mm=25.0,
        lead_mm=1.5,
    ),
    "soft": LineOf(
        shape=(96, 160),
        pixel_mm=0.075,
        near_mm=360.0,
        far_mm=250.0,
        detector_mm=420.0,
        spread_px=0.75,
        read_DN=1.5,
        dark_DN=80.0,
        bits=12,
        DN_per_keV=0.0055,
        photons=7e-4,
        scintillator=("CsI", 0.15),
        edge_keV=34.5,
        line_keV=29.5,
        lag_s=0.05,
        pause_s=2.0,
        readout_ms=2.0,
        current_mA={30.0: 20.0, 60.0: 2.0},
        copper_times=1.0,
        anode_deg=20.0,
        beryllium_mm=0.5,
        wedge_mm=0.5,
        water_mm=10.0,
        lead_mm=0.5,
    ),
    "three": LineOf(
        shape=(112, 144),
        pixel_mm=0.15,
        near_mm=600.0,
        far_mm=400.0,
        detector_mm=900.0,
        spread_px=0.6,
        read_DN=3.0,
        dark_DN=200.0,
        bits=14,
        DN_per_keV=0.0065,
        photons=7e-4,
        scintillator=("Gd2O2S", 0.3),
        edge_keV=50.24,
        line_keV=42.8,
        lag_s=1.0,
        pause_s=15.0,
        readout_ms=30.0,
        current_mA={60.0: 5.0, 90.0: 2.0, 120.0: 1.0},
        copper_times=2.0,
        anode_deg=10.0,
        beryllium_mm=0.8,
        wedge_mm=2.5,
        water_mm=40.0,
        lead_mm=2.0,
    ),
    "even": LineOf(
        shape=(96, 112),
        pixel_mm=0.25,
        near_mm=700.0,
        far_mm=500.0,
        detector_mm=1000.0,
        spread_px=0.0,
        read_DN=0.6,
        dark_DN=10.0,
        bits=16,
        DN_per_keV=0.012,
        photons=7e-4,
        scintillator=("CsI", 3.0),
        edge_keV=34.5,
        line_keV=29.5,
        lag_s=0.3,
        pause_s=5.0,
        readout_ms=0.0,
        current_mA={70.0: 6.0, 120.0: 2.0},
        copper_times=1.0,
        anode_deg=14.0,
        beryllium_mm=0.0,
        wedge_mm=2.0,
        water_mm=30.0,
        lead_mm=1.0,
        even=True,
        declared=False,
    ),
    "counting": LineOf(
        shape=(104, 136),
        pixel_mm=0.2,
        near_mm=480.0,
        far_mm=360.0,
        detector_mm=700.0,
        spread_px=0.0,
        read_DN=0.0,
        dark_DN=0.0,
        bits=16,
        DN_per_keV=1.0,
        photons=7e-4,
        scintillator=("CdTe", 1.0),
        edge_keV=26.7,
        line_keV=23.0,
        lag_s=0.2,
        pause_s=6.0,
        readout_ms=5.0,
        current_mA={50.0: 6.0, 100.0: 1.0},
        copper_times=2.0,
        anode_deg=16.0,
        beryllium_mm=2.5,
        wedge_mm=1.5,
        water_mm=20.0,
        lead_mm=3.0,
        counting=True,
    ),
}
LINES["threshold"] = dataclasses.replace(LINES["counting"], threshold_keV=20.0)
COMPARATOR_KEV = 1.0  # standard deviation of a pulse's height
ALWAYS = (
    "object_scatter",
    "veiling_glare",
    "focal_spot",
    "mtf_tail",
    "image_lag",
    "k_fluorescence",
    "motion_blur",
    "misregistration",
    "composition_error",
    "motion_in_some",
    "vibration",
)
# effect: strength, and whether it has the catalogue's definition (else it is only asked whether it is named)
CASES = {
    "none": (0.0, True),
    "object_scatter": (10.0, False),
    "veiling_glare": (2.0, True),
    "kv_error": (1.5, True),
    "filtration_error": (0.2, True),
    "image_lag": (0.4, True),
    "image_lag_later": (1.0, True),
    "focal_spot": (0.8, True),
    "mtf_tail": (12.0, False),
    "excess_noise": (15.0, True),
    "nonlinearity": (1.0, True),
    "gain_map_error": (0.5, True),
    "row_noise": (0.4, True),
    "quantisation": (8.0, True),
    "output_drift": (0.6, True),
    "dark_drift": (9.6, True),
    "bad_pixels": (0.4, True),
    "k_fluorescence": (25.0, True),
    "motion_blur": (0.8, True),
    "motion_in_some": (4.0, True),
    "vibration": (2.0, False),
    "misregistration": (0.6, True),
    "heel": (5.0, True),
    "composition_error": (5.0, True),
    "tiles": (0.5, False),
    "wandering_tiles": (0.4, False),
    "threshold_error": (2.0, True),
}
PAIRS = (
    "image_lag+kv_error",
    "veiling_glare+kv_error",
    "veiling_glare+excess_noise",
    "heel+misregistration",
    "object_scatter+filtration_error",
    "gain_map_error+veiling_glare",
    "row_noise+focal_spot",
    "dark_drift+mtf_tail",
    "quantisation+misregistration",
    "nonlinearity+motion_blur",
)
UNKNOWN = ("wandering_tiles",)
# of products alone: the table moved there; to and fro, as far in a short exposure as in a long one
NAMED = {"motion_in_some": "motion_blur", "vibration": "motion_blur", "tiles": "tile_gain"}
NOT_OF_COUNTS = (
    "row_noise",
    "dark_drift",
    "k_fluorescence",
)  # electronics' and energies', of which numbers of photons are free
OF_THRESHOLDS = ("threshold_error",)  # of counters that have one


def cases_of(of: LineOf) -> list[str]:
    """Effects, and pairs of them, that a line can have."""
    never = {*(NOT_OF_COUNTS if of.counting else ()), *(() if of.threshold_keV else OF_THRESHOLDS)}
    return [case for case in (*CASES, *PAIRS) if not set(case.split("+")) & never]


def attenuation_per_mm(material: str, energies_keV: np.ndarray) -> np.ndarray:
    """Linear attenuation, 1/mm."""
    return (
        DENSITY[material] / 10.0 * np.array([xraylib.CS_Total_CP(material, float(energy)) for energy in energies_keV])
    )


@lru_cache(maxsize=16)
def emitted(anode_deg: float, kV: float):
    """SpekPy's beam of a tube, ten seconds' work.

    Ten bins a keV: with one the end of the spectrum moves in steps of a bin when the voltage does.
    """
    import spekpy

    return spekpy.Spek(kvp=kV, th=anode_deg, dk=0.1, physics="kqp", mu_data_source="nist", z=100.0)


@lru_cache(maxsize=64)
def spectrum(name: str, kV: float, aluminium_mm: float, copper_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Energies, keV, and photons a pixel and mAs that the panel of a line absorbs."""
    of = LINES[name]
    beam = copy.deepcopy(emitted(of.anode_deg, kV)).filter("Be", of.beryllium_mm).filter("Al", aluminium_mm)
    if copper_mm:
        beam.filter("Cu", copper_mm)
    energies, photons = beam.get_spectrum(edges=False)
    material, thickness_mm = of.scintillator
    stopped = 1.0 - np.exp(-thickness_mm * attenuation_per_mm(material, energies))
    # a number in each bin, density times 0.1 keV; one mean energy a keV behind objects
    absorbed = 0.1 * np.asarray(photons) * of.photons * stopped
    whole = np.floor(energies).astype(int)
    sums = np.bincount(whole, absorbed)
    seen = sums > 0
    return np.bincount(whole, absorbed * energies)[seen] / sums[seen], sums[seen]


def random_line(seed: int) -> str:
    """Name of a line whose pixels, distances, beams, panel and noise are all drawn; it joins LINES."""
    rng = np.random.default_rng([99, seed])

    def one_of(*choices):
        return choices[rng.integers(len(choices))]

    shape = one_of(
        (64, 64), (96, 96), (128, 128), (80, 200), (160, 72), (48, 256), (100, 132), (192, 192)
    )  # the last is compared in squares of two pixels
    pixel_mm = math.exp(rng.uniform(math.log(0.05), math.log(0.8)))
    detector_mm = pixel_mm * max(shape) * rng.uniform(5, 25)
    near = rng.uniform(1.05, 2.2)
    far = near * rng.uniform(1.1, 1.5)
    voltages = one_of(
        (40.0, 80.0),
        (50.0, 100.0),
        (60.0, 120.0),
        (45.0, 75.0, 110.0),
        (80.0, 160.0),
        (35.0, 50.0),
        (70.0, 140.0),
        (30.0, 60.0, 90.0),
    )
    bits = one_of(12, 14, 16, 16)
    material, thickness_mm, edge_keV, line_keV = one_of(
        ("CsI", 0.15, 34.5, 29.5), ("CsI", 0.6, 34.5, 29.5), ("Gd2O2S", 0.1, 50.24, 42.8), ("Gd2O2S", 0.3, 50.24, 42.8)
    )
    most_photons = math.exp(rng.uniform(math.log(2e3), math.log(4e5)))
    full_DN = rng.uniform(0.4, 0.85) * (2**bits - 1)
    soft = voltages[0] < 40.0
    name = f"random {seed}"
    drawn = LineOf(
        shape=shape,
        pixel_mm=round(pixel_mm, 4),
        near_mm=round(detector_mm / near, 1),
        far_mm=round(detector_mm / far, 1),
        detector_mm=round(detector_mm, 1),
        spread_px=one_of(0.0, 0.3, 0.5, 0.8, 1.2),
        read_DN=0.0,
        dark_DN=0.0,
        bits=bits,
        DN_per_keV=1.0,
        photons=7e-4,
        scintillator=(material, thickness_mm),
        edge_keV=edge_keV,
        line_keV=line_keV,
        lag_s=one_of(0.05, 0.2, 0.5, 1.5),
        pause_s=one_of(2.0, 6.0, 20.0),
        readout_ms=one_of(0.0, 5.0, 30.0),
        current_mA=dict.fromkeys(voltages, 1.0),
        copper_times=1.0,
        anode_deg=one_of(8.0, 12.0, 16.0, 22.0),
        beryllium_mm=one_of(0.5, 1.0, 2.5),
        wedge_mm=0.5 if soft else round(rng.uniform(1.0, 3.0), 1),
        water_mm=round(rng.uniform(8, 20) if soft else rng.uniform(15, 45), 0),
        lead_mm=round(rng.uniform(0.5, 3.0), 1),
        declared=bool(rng.uniform() < 0.75),
    )
    LINES[name] = drawn
    # photons and keV of a mAs at each voltage, and keV behind copper
    sums = {}
    for kV in voltages:
        energies, photons = spectrum(name, kV, 2.1, 0.0)
        behind_copper = spectrum(name, kV, 2.1, 0.1)
        sums[kV] = float(photons.sum()), float(photons @ energies), float(behind_copper[0] @ behind_copper[1])
    spectrum.cache_clear()
    count, energy_keV, _ = sums[max(voltages)]
    DN_per_keV = full_DN / (most_photons * energy_keV / count)
    # SpekPy's photons are those on a square centimetre at a metre
    photons = 0.01 * pixel_mm**2 * (1000.0 / detector_mm) ** 2 * math.exp(0.25 * rng.standard_normal())
    current_mA = most_photons / (count * photons / drawn.photons * 0.16)
    noise_DN = DN_per_keV * 60.0 * math.sqrt(most_photons)
    LINES[name] = dataclasses.replace(
        drawn,
        DN_per_keV=DN_per_keV,
        photons=photons,
        current_mA={kV: float(f"{current_mA * energy_keV / sums[kV][1]:.4g}") for kV in voltages},
        copper_times=round(min(energy / behind for _, energy, behind in sums.values()) * 0.9, 2),
        read_DN=max(noise_DN * rng.uniform(0.03, 0.3), 0.6),
        dark_DN=round((2**bits - 1) * rng.uniform(0.01, 0.06)),
    )
    CASES["dark_drift"] = max(1.6 * LINES[name].read_DN, 3.0), True
    return name


def random_cases(seed: int) -> list[str]:
    """No effect, two single ones, and a pair."""
    rng = np.random.default_rng([98, seed])
    single = rng.choice([case for case in CASES if case not in ("none", *OF_THRESHOLDS)], 2, replace=False)
    return ["none", *map(str, single), str(rng.choice(PAIRS))]


class Line:
    """A line with its effects, drawn from a generator; what charge the panel still holds goes from series to series."""

    optical = OPTICAL  # noise of the light over that of its photons

    def __init__(self, name: str, effects: tuple[str, ...], rng: np.random.Generator) -> None:
        self.name, self.of, self.rng = name, LINES[name], rng
        self.effects = {name.removesuffix("_later"): CASES[name][0] for name in effects if name != "none"}
        self.always = {name.removesuffix("_later") for name in effects if name in ALWAYS}
        pattern = 0.02 * rng.standard_normal(self.of.shape)
        pattern = pattern + 0.36 * gaussian_filter(rng.standard_normal(self.of.shape), 12)
        self.gain = np.ones(self.of.shape) if self.of.even else 1.0 + pattern
        each_DN = 8.0 * rng.standard_normal(self.of.shape)
        self.dark_DN = self.of.dark_DN + (0.0 if self.of.even or self.of.counting else each_DN)
        self.aluminium_mm = 2.1 + 0.2 * rng.standard_normal()
        self.kV_share = 1.0 + 0.004 * rng.standard_normal()
        y, x = np.indices(self.of.shape)
        apart_mm2 = ((y - self.of.shape[0] / 2) ** 2 + (x - self.of.shape[1] / 2) ** 2) * self.of.pixel_mm**2
        self.illumination = (1.0 + apart_mm2 / self.of.detector_mm**2) ** -1.5
        self.charge_DN = np.zeros(self.of.shape)
        self.changed_gain = np.ones(self.of.shape)
        if "gain_map_error" in self.effects:
            self.changed_gain += self.effects["gain_map_error"] / 100.0 * rng.standard_normal(self.of.shape)
        for one in ("tiles", "wandering_tiles"):
            if one in self.effects:
                tiles = np.kron(rng.standard_normal((4, 4)), np.ones(self.of.tile_px))
                self.changed_gain += self.effects[one] / 100.0 * tiles
        if "bad_pixels" in self.effects:
            count = round(self.effects["bad_pixels"] / 100.0 * self.of.shape[0] * self.of.shape[1])
            self.changed_gain.flat[rng.choice(self.of.shape[0] * self.of.shape[1], count, replace=False)] = 0.0
        self.direction = rng.uniform(0.0, 2.0 * math.pi)
        self.scenes = self.placed()

    def placed(self) -> dict[str, tuple[str, dict[str, np.ndarray]]]:
        """Kind and path lengths, mm, of what stands in the beam, by scene."""
        return scenes(self.of)

    def signals(self, arriving: np.ndarray, energies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance, DN and DN^2, of photons (row, column, energy)."""
        if self.of.counting:
            counts = arriving.sum(axis=-1)
            return counts, counts
        optical = 1.0 if self.of.even else self.optical
        return self.of.DN_per_keV * (arriving @ energies), optical * self.of.DN_per_keV**2 * (arriving @ energies**2)

    def scattered(self, source: np.ndarray) -> np.ndarray:
        """Light scattered by objects, DN, that a source of it (row, column), DN, sends to the panel."""
        return gaussian_filter(np.pad(source, 200), 18.0 / self.of.pixel_mm)[200:-200, 200:-200]

    def spread(self, image: np.ndarray, *, mode: str = "reflect") -> np.ndarray:
        """The panel's spread of light; mode: what lies beyond its borders."""
        return gaussian_filter(image, self.of.spread_px, mode=mode)

    def counted(self, energies: np.ndarray, moved_keV: float) -> np.ndarray:
        """Share of the photons (row, column, energy) or (energy,) that a counter counts whose threshold has moved."""
        return ndtr((energies - self.of.threshold_keV - moved_keV) / COMPARATOR_KEV)

    def open_light(self, kV: float, mAs: float, copper_mm: float, on: dict) -> tuple[np.ndarray, np.ndarray]:
        """Energies, keV, and photons (row, column, energy) that the panel absorbs of an exposure of the open field."""
        voltage = kV * self.kV_share * (1.0 + on.get("kv_error", 0.0) / 100.0)
        energies, photons = spectrum(self.name, voltage, self.aluminium_mm + on.get("filtration_error", 0.0), copper_mm)
        arriving = photons * mAs * self.illumination[..., None]
        if self.of.threshold_keV:
            arriving = arriving * self.counted(energies, on.get("threshold_error", 0.0))
        if "heel" in on:
            tungsten = attenuation_per_mm("W", energies)
            signal = photons if self.of.counting else photons * energies
            # so much more tungsten from one side to the other as takes away that share of the beam
            thick_mm = on["heel"] / 100.0 * float(signal.sum()) / float(signal @ tungsten)
            along = (np.arange(self.of.shape[1]) / (self.of.shape[1] - 1) - 0.5)[None, :, None]
            arriving = arriving * np.exp(-along * thick_mm * tungsten)
        return energies, arriving

    def transmitted(self, scene: str, energies: np.ndarray, on: dict, exposure_ms: float) -> np.ndarray:
        """Share of the photons (row, column, energy) that gets through a scene."""
        depth = np.zeros((*self.of.shape, 1))
        apart_px = [on.get("misregistration", 0.0) * turn(self.direction) for turn in (math.cos, math.sin)]
        for material, stated_mm in self.scenes[scene][1].items():
            thickness_mm = shift(stated_mm, apart_px, order=1, mode="nearest")
            denser = 1.0 + on.get("composition_error", 0.0) / 100.0 if material == "H2O" else 1.0
            depth = depth + denser * thickness_mm[..., None] * attenuation_per_mm(material, energies)
        return np.exp(-depth)

    def blurred(
        self, signal: np.ndarray, variance: np.ndarray, far: bool, on: dict, exposure_ms: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """What focal spot and motion make of a scene's picture and its variance, DN and DN^2."""
        if "focal_spot" in on:
            magnified = self.of.detector_mm / (self.of.far_mm if far else self.of.near_mm) - 1.0
            width_px = on["focal_spot"] * magnified / self.of.pixel_mm / math.sqrt(8.0 * math.log(2.0))
            signal, variance = gaussian_filter(signal, width_px), gaussian_filter(variance, width_px)
        if "motion_blur" in on or "vibration" in on:
            places = np.linspace(-0.5, 0.5, 9) * on.get("motion_blur", 0.0) * exposure_ms / 50.0
            if "vibration" in on:
                places = on["vibration"] / 2.0 * np.sin(np.linspace(0.0, 2.0 * math.pi, 32, endpoint=False))
            signal = np.mean([shift(signal, (place, 0.0), order=1, mode="nearest") for place in places], axis=0)
        return signal, variance

    def light(self, kV: float, mAs: float, copper_mm: float, scene: str, on: dict, exposure_ms: float) -> tuple:
        """Mean and variance of one exposure before the spread of light, DN and DN^2, and K photons and what they leave.

        scene: what stands in the beam; empty: nothing.
        """
        energies, arriving = self.open_light(kV, mAs, copper_mm, on)
        open_DN, _ = self.signals(arriving, energies)
        if scene:
            arriving = arriving * self.transmitted(scene, energies, on, exposure_ms)
        remote = None
        if "k_fluorescence" in on:
            share = np.where(energies > self.of.edge_keV, on["k_fluorescence"] / 100.0, 0.0)
            caught = arriving @ share
            remote = caught, (arriving @ (share * (energies - self.of.line_keV))) / np.maximum(caught, 1e-30)
            arriving = arriving * (1.0 - share)
        signal, variance = self.signals(arriving, energies)
        if scene and "object_scatter" in on:
            source = signal * -np.log(np.clip(signal / open_DN, 1e-6, 1.0))
            added = on["object_scatter"] / 100.0 * self.scattered(source) / 0.38
            added = added * (0.55 if scene.endswith("far") else 1.0)
            signal, variance = signal + added, variance * (1.0 + added / signal)
        if scene:
            signal, variance = self.blurred(signal, variance, scene.endswith("far"), on, exposure_ms)
        if "veiling_glare" in on:
            share = on["veiling_glare"] / 100.0
            wide = [gaussian_filter(signal, length_mm / self.of.pixel_mm) for length_mm in (4.0, 12.0)]
            signal = (1.0 - share) * signal + 0.5 * share * (wide[0] + wide[1])
        return signal, variance, remote

    def frames(self, count: int, kind: str, exposure_ms: float, after: bool, lit: tuple | None) -> np.ndarray:
        """Frames (n, row, column), DN; lit: mean and variance, None without a beam."""
        on = self.on(after)
        if kind != "afterglow":
            self.charge_DN = self.charge_DN * math.exp(-self.of.pause_s / self.of.lag_s)
        released = 1.0 - math.exp(-(exposure_ms + self.of.readout_ms) / 1000.0 / self.of.lag_s)
        lag = self.effects.get("image_lag", 0.0) / 100.0
        shown = []
        for _ in range(count):
            level = np.zeros(self.of.shape) if lit is None else self._exposure(*lit, on, after)
            freed = released * self.charge_DN
            held = level * (1.0 - lag) + (self.rng.poisson(freed) if self.of.counting else freed)
            self.charge_DN = (1.0 - released) * self.charge_DN + lag * level
            level = held if "image_lag" in on else level
            level = (
                level
                + self.dark_DN
                + (0.0 if self.of.counting else DARK_SLOPE_DN_PER_MS) * exposure_ms
                + on.get("dark_drift", 0.0) * exposure_ms / 160.0
            )
            level = level + self.of.read_DN * self.rng.standard_normal(self.of.shape)
            level = level + self.of.read_DN * on.get("row_noise", 0.0) * self.rng.standard_normal((self.of.shape[0], 1))
            if "wandering_tiles" in on:
                level = level + 3.0 * np.kron(self.rng.standard_normal((4, 4)), np.ones(self.of.tile_px))
            step = on.get("quantisation", 1.0)
            shown.append(
                np.clip(np.floor(level / step) * step if step > 1.0 else np.round(level), 0, self.of.highest_DN)
            )
        return np.array(shown, dtype=np.uint16)

    def on(self, after: bool) -> dict[str, float]:
        """The effects and their strengths, where they act."""
        return {name: strength for name, strength in self.effects.items() if after or name in self.always}

    def _exposure(
        self, signal: np.ndarray, variance: np.ndarray, remote: tuple | None, on: dict, after: bool
    ) -> np.ndarray:
        variance = variance * (1.0 + on.get("excess_noise", 0.0) / 100.0)
        if (
            self.of.counting
        ):  # none is seen of a fraction of a photon: a Gaussian cut off at 0 would brighten deep shadows
            quanta = self.rng.poisson(variance) - variance
        else:
            quanta = np.sqrt(variance) * self.rng.standard_normal(self.of.shape)
        level = self.spread(signal) + self.spread(quanta, mode="wrap")
        if remote is not None:
            photons = remote[0] + np.sqrt(remote[0]) * self.rng.standard_normal(self.of.shape)
            away = 0.5 * sum(gaussian_filter(photons, sigma_mm / self.of.pixel_mm) for sigma_mm in (0.12, 0.3))
            level = level + self.spread(self.of.DN_per_keV * (photons * remote[1] + self.of.line_keV * away))
        if "mtf_tail" in on:
            share = on["mtf_tail"] / 100.0
            level = (1.0 - share) * level + share * gaussian_filter(level, 2.5)
        level = level * (1.0 - on.get("nonlinearity", 0.0) / 100.0 * level / (0.5 * self.of.highest_DN))
        level = level * self.gain * (self.changed_gain if after else 1.0)
        return level * (1.0 + on.get("output_drift", 0.0) / 100.0 * self.rng.standard_normal())


def scenes(of: LineOf) -> dict[str, tuple[str, dict[str, np.ndarray]]]:
    """Kind and path lengths, mm, of what stands in the beam."""
    y, x = np.indices(of.shape)
    rows, columns = of.shape
    inside = (104 * y > 15 * rows) & (104 * y < 90 * rows)
    wedge = np.where(inside, np.clip((x - 8) * 136 // (16 * columns), 0, 7) * of.wedge_mm, 0.0)
    edge = np.where(x + 0.06 * y > 70 / 136 * columns, of.lead_mm, 0.0)
    found = {"wedge": ("wedge", {"Al": wedge})}
    for place in ("near", "far"):
        found[f"slab_{place}"] = ("slab", {"H2O": np.full(of.shape, of.water_mm)})
        found[f"edge_{place}"] = ("edge", {"Pb": edge})
    radius_px = 38 / 136 * columns
    for number in range(1, 4):
        round_px2 = radius_px**2 - ((y - rows / 2) ** 2 + (x - 60 / 136 * columns - 4 * number) ** 2) * 0.6
        water_mm = 1.14 * of.water_mm / radius_px * np.sqrt(np.clip(round_px2, 0.0, None))
        found[f"product{number}"] = ("product", {"H2O": water_mm})
    return found


def make_session(
    path: Path, name: str, effect: str, rng: np.random.Generator, frames: int, line_of: type[Line] = Line
) -> None:
    """A session of a line with calibrating and later series, and its effects, joined by `+`."""
    line = line_of(name, tuple(effect.split("+")), rng)
    of = line.of
    scintillator = "{}:{:g}".format(*of.scintillator)
    instrument = Instrument(
        anode="W",
        anode_angle_deg=of.anode_deg,
        inherent_filtration=filters_from_text(f"Be:{of.beryllium_mm:g}") if of.declared else (),
        source_object_mm=of.near_mm,
        source_detector_mm=of.detector_mm,
        pixel_mm=of.pixel_mm,
        detector="area",
        counting=of.counting,
        threshold_keV=of.threshold_keV or None,
        scintillator=filters_from_text(scintillator) if of.declared else (),
        bits=of.bits,
        readout_ms=of.readout_ms if of.declared else None,
    )
    known, highest_kV = line.scenes, max(of.current_mA)
    with write_acquisition(path, instrument) as writer:

        def add(name, kind, exposure_ms, *, kV=None, copper_mm=0.0, scene="", after=False):
            lit = None
            current_mA = None if kV is None else of.current_mA[kV] * (of.copper_times if copper_mm else 1.0)
            if kV is not None:
                mAs = current_mA * exposure_ms / 1000.0
                on = line.on(after)
                if scene.startswith("product") and "motion_in_some" in on:
                    on = {**on, "motion_blur": on["motion_in_some"]}
                lit = line.light(kV, mAs, copper_mm, scene, on, exposure_ms)
            writer.add_series(
                name,
                kind=kind,
                frames=line.frames(frames, kind, exposure_ms, after, lit),
                kV=kV,
                current_mA=current_mA,
                exposure_ms=exposure_ms,
                filters=None if kV is None else filters_from_text(f"Cu:{copper_mm}" if copper_mm else ""),
                frame_interval_ms=exposure_ms + of.readout_ms,
                source_object_mm=of.far_mm if scene.endswith("far") else of.near_mm if scene else None,
                scene=scene,
                role="evaluation" if after else "calibration",
            )

        for scene, (kind, thickness_mm) in known.items():
            writer.add_scene(scene, kind=kind, thickness_mm={NAMES[key]: map_ for key, map_ in thickness_mm.items()})
        for exposure_ms in (40.0, 160.0):
            add(f"dark_{exposure_ms:g}", "dark", exposure_ms)
        for kV in of.current_mA:
            for exposure_ms in (20.0, 40.0, 80.0, 160.0):
                add(f"flat_{kV:g}_{exposure_ms:g}", "flat", exposure_ms, kV=kV)
            add(f"flat_{kV:g}_copper", "flat", 160.0, kV=kV, copper_mm=0.1)
        add("afterglow", "afterglow", 160.0, after=True)
        add("dark_later", "dark", 160.0, after=True)
        for kV in of.current_mA:
            for exposure_ms in (160.0, 40.0):
                add(f"flat_{kV:g}_{exposure_ms:g}_later", "flat", exposure_ms, kV=kV, after=True)
            add(f"flat_{kV:g}_copper_later", "flat", 160.0, kV=kV, copper_mm=0.1, after=True)
            for scene in known:
                add(f"{scene}_{kV:g}", "object", 160.0, kV=kV, scene=scene, after=True)
        for scene in ("product1", "edge_near"):
            add(f"{scene}_{highest_kV:g}_40", "object", 40.0, kV=highest_kV, scene=scene, after=True)
        add("dark_last", "dark", 160.0, after=True)


def _named(case: str) -> str:
    """The effect of the catalogue that a case is of."""
    return NAMED.get(case, case.removesuffix("_later"))


def judged(name: str, effect: str, seed: int, frames: int, line_of: type[Line] = Line) -> dict:
    """What the diagnosis says of one session."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        rng = np.random.default_rng([seed, zlib.crc32(effect.encode())])
        make_session(path, name, effect, rng, frames, line_of)
        with open_acquisition(path) as acquisition:
            found = diagnose(acquisition, rng=np.random.default_rng(seed))
    names = effect.split("+")
    wanted = sorted(_named(one) for one in names if one not in ("none", *UNKNOWN))
    verdict = {"none": "no_gap", **dict.fromkeys(UNKNOWN, "unknown_effect")}.get(effect, "explained")
    strengths = {item.effect: list(item.strength) for item in found.causes}
    return {
        "effect": effect,
        "planted": [CASES[one][0] for one in names],
        "verdict": found.verdict,
        "named": list(found.named),
        "right": found.verdict == verdict and sorted(found.named) == wanted,
        "strengths": {
            one: strengths[one] for one in (_named(part) for part in names if CASES[part][1]) if one in found.named
        },
    }


def run_cases(
    line: str, cases: list[str], seed: int, frames: int, json_file: Path | None, line_of: type[Line] = Line
) -> None:
    """The rows of a line's cases on the terminal, and as JSON where a file is named."""
    rows = []
    for effect in cases:
        row = judged(line, effect, seed, frames, line_of)
        rows.append(row)
        told = "; ".join("{:.3g} ({:.3g} to {:.3g})".format(*one) for one in row["strengths"].values())
        named = ", ".join(row["named"]) or row["verdict"]
        planted = "+".join(f"{one:g}" for one in row["planted"])
        print(f"{effect:32s} {planted:>8s}  {'right' if row['right'] else 'WRONG'}  {named}  {told}", flush=True)
    print(f"{sum(row['right'] for row in rows)} of {len(rows)} named rightly and alone")
    if json_file:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(rows, indent=1))


def run() -> None:
    """The table on the terminal, and the rows as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--line",
        choices=[*LINES, "random"],
        default="usual",
        help="which line (default usual); random: all of it drawn from the seed, and four of the cases",
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=20, help="of a series (default 20)")
    parser.add_argument("--only", nargs="+", choices=[*sorted(CASES), *PAIRS], metavar="EFFECT")
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args()
    line = random_line(options.seed) if options.line == "random" else options.line
    if line != options.line:
        print(LINES[line])
    cases = options.only or (random_cases(options.seed) if line != options.line else cases_of(LINES[line]))
    run_cases(line, cases, options.seed, options.frames, options.json)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        run()

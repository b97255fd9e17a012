"""Diagnoses of sessions of two lines whose simulator draws every deposit of energy: one planted effect, two, and none.

Nothing in the simulation is raytwin's; h5py writes the file format. It shares xraylib's cross sections with the twin, and SpekPy,
of which it takes another model (`kqp`). Deposits are Poisson numbers in ten bins of light and seven by seven samples a pixel: K
photons escape, light depends on depth, two values stand for its spread (Swank). A sample is the mean of twelve rays, a thickness map
the mean over each pixel. Light has a tail from the start. Gains, darks and series wander a little; attenuation is off by 0.5 %,
thickness by 0.3 % (sd). The declarations are not quite true: line `A` (CsI, 0.139 mm) has a film of tungsten in the beam, packing of
82 % and 0.3 % + 0.15 kV more voltage; line `B` (Gd2O2S, 0.4 mm, stated as 0.2 mm of powder) a voltage that ripples by 4 %.

Numbers without a source describe the lines and the effects; they are choices, not measurements. Three cases plant nothing that
should be named: noise that is correlated along rows, a generator without ripple or error, another spread of light. Strengths are
the catalogue's, with these exceptions: scatter fills an endless field; lag adds what series before leave; a dark drifts by its
strength in endless time; nonlinearity, heel and absorber are of the middle beam's signal; a focal spot is as wide as stated along
the columns' index, and 0.8 times along the rows'; motion is that on the panel, the same at both distances.

    python validation/third_simulator.py A
    python validation/third_simulator.py B --cases none,heel,heel+image_lag --seed 7 --keep build/third_simulator
"""

import argparse
import contextlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import h5py
import numpy as np
import xraylib
from scipy.ndimage import gaussian_filter

from raytwin.acquisition import open_acquisition
from raytwin.diagnosis.diagnose_session import diagnose
from raytwin.diagnosis.judgement.answer import Diagnosis
from raytwin.errors import InputError

ENERGY_keV = np.arange(5, 121) + 0.5  # middles of bins of 1 keV
BINS = 10  # of deposited light
# along each side of a pixel. The light of a deposit starts at the middle of its sample, so that a picture is averaged over a sample
# and noise is not: with 3 that is a blur before the quanta as a crosstalk of 2 % has, with 7 one of 0.3 %
SAMPLES = 7
MARGIN_px, WIDE_px = 5, 64  # around the panel: of the picture, of what glare and scatter reach in from
PADDING = 24  # samples around the picture in a Fourier transform
# at room temperature: NIST X-ray mass attenuation coefficients, tables 1 and 2; Gd2O2S as a crystal
DENSITY_g_cm3 = {
    "Al": 2.699, "Cu": 8.96, "Fe": 7.874, "Pb": 11.35, "W": 19.3, "Be": 1.848, "pmma": 1.19, "CsI": 4.51, "Gd2O2S": 7.32,
    "water": 1.0,
}  # fmt: skip
FORMULA = {"pmma": "C5H8O2", "water": "H2O"}
# K edge and mean K photon, keV (CsI: means of both elements'), and share of absorptions that send one: 1 - 1 / jump ratio of the
# K edge (xraylib 0.83, 0.83 and, for Gd, 0.82), times the fluorescence yield, Krause (1979), doi:10.1063/1.555594
K_SHELL = {"CsI": (34.5, 29.5, 0.83 * 0.88), "Gd2O2S": (50.24, 43.5, 0.80 * 0.93)}
FWHM_PER_SD = 2.355  # of a Gaussian
FOCAL_mm = 0.01  # full width at half maximum, declared


@dataclass(frozen=True, kw_only=True)
class LineOf:
    """A line: tube, distances, panel, beams and objects."""

    shape: tuple[int, int]  # rows, columns
    pixel_mm: float
    bits: int
    anode_deg: float
    inherent: tuple[tuple[str, float], ...]  # material and mm of what the beam passes; tungsten is not declared
    volt_scale: float  # true voltage from the stated one
    volt_offset_kV: float
    ripple: float  # of the voltage: highest less lowest, relative, of an unsmoothed wave
    scintillator: tuple[str, float]  # material and mm at full density
    declared: str  # of it
    light_sd: float  # relative, of light a keV
    depth_slope: float  # relative change of light from front to back
    DN_per_keV: float  # of light
    dark_DN: float
    dark_DN_per_ms: float
    read_DN: float
    row_share: float  # of it, of whole rows
    electrons_per_DN: float
    detector_mm: float  # from the source
    object_mm: tuple[float, float]  # from the source: far, near
    spread_px: float  # sd of the light's core
    tail_share: float
    tail_px: float
    layer_tail: bool = False  # Lorentz-like instead of exponential
    tiles: bool  # gain varies in squares of 16 px, else in columns
    exposures_ms: tuple[float, float]  # short, long
    interval_ms: float  # of frames
    beams: tuple[tuple[float, str], ...]  # kV and filters
    current_mA: dict[float, float]  # by kV
    wedge_mm: float  # two steps
    slab_mm: float
    product_mm: float


LINES = {
    "A": LineOf(
        shape=(72, 88), pixel_mm=0.139, bits=16, dark_DN=900.0, anode_deg=12.0, inherent=(("Be", 0.8), ("Al", 1.2), ("W", 0.002)),
        volt_scale=1.003, volt_offset_kV=0.15, ripple=0.0, scintillator=("CsI", 0.5 * 0.82), declared="CsI:0.5", light_sd=0.13,
        depth_slope=0.25, DN_per_keV=0.28, read_DN=6.5, row_share=0.08, dark_DN_per_ms=0.12, electrons_per_DN=30.0,
        detector_mm=400.0, object_mm=(300.0, 200.0), spread_px=0.52, tail_share=0.13, tail_px=1.6, tiles=False,
        exposures_ms=(30.0, 60.0),
        interval_ms=66.667, beams=((40.0, ""), (70.0, ""), (100.0, "Cu:0.2")), current_mA={40.0: 3.0, 70.0: 0.55, 100.0: 0.44},
        wedge_mm=2.0, slab_mm=20.0, product_mm=14.0,
    ),
    "B": LineOf(
        shape=(64, 80), pixel_mm=0.4, bits=14, dark_DN=310.0, anode_deg=20.0, inherent=(("Be", 1.0), ("Al", 0.8)),
        volt_scale=0.997, volt_offset_kV=0.0, ripple=0.04, scintillator=("Gd2O2S", 0.12), declared="Gd2O2S:0.2", light_sd=0.28,
        depth_slope=-0.15, DN_per_keV=0.075, read_DN=2.2, row_share=0.05, dark_DN_per_ms=0.01, electrons_per_DN=60.0,
        detector_mm=750.0, object_mm=(650.0, 450.0), spread_px=0.36, tail_share=0.1, tail_px=0.9, tiles=True,
        exposures_ms=(20.0, 80.0),
        interval_ms=100.0, beams=((50.0, ""), (80.0, "Al:1"), (120.0, "Cu:0.3")), current_mA={50.0: 0.46, 80.0: 0.21, 120.0: 0.168},
        wedge_mm=3.0, slab_mm=40.0, product_mm=25.0,
    ),
}  # fmt: skip
UNITS = {
    "dark_drift": "DN", "filtration_error": "mm Al", "focal_spot": "mm", "motion_blur": "px", "misregistration": "px",
    "row_noise": "read-noise sigmas", "quantisation": "DN",
}  # fmt: skip
NOT_NAMED = ("correlated_noise", "layer_tail", "no_ripple")
# what a line has from the start, for calibration to find; all else acts after it
ALWAYS = (
    "object_scatter", "veiling_glare", "crosstalk", "focal_spot", "motion_blur", "misregistration", "image_lag", "nonlinearity",
    "dark_drift", "output_drift",
)  # fmt: skip
_EFFECTS: dict[str, tuple[dict[str, float], ...]] = {
    "A": (
        {}, {"correlated_noise": 0.25}, {"object_scatter": 18.0}, {"image_lag": 0.8}, {"veiling_glare": 2.5}, {"crosstalk": 4.0},
        {"nonlinearity": 1.2}, {"gain_map_error": 0.5}, {"dark_drift": 9.0}, {"output_drift": 0.5}, {"filtration_error": 0.15},
        {"kv_error": -1.6}, {"focal_spot": 0.3}, {"motion_blur": 2.4}, {"row_noise": 0.35}, {"excess_noise": 9.0},
        {"bad_pixels": 0.3}, {"image_lag": 1.0, "object_scatter": 20.0}, {"kv_error": 2.0, "gain_map_error": 0.8},
        {"veiling_glare": 3.0, "focal_spot": 0.4}, {"nonlinearity": 1.5, "row_noise": 0.5},
    ),
    "B": (
        {}, {"layer_tail": 1.0}, {"no_ripple": 1.0}, {"object_scatter": 15.0}, {"image_lag": 0.5}, {"veiling_glare": 2.0},
        {"nonlinearity": 1.0}, {"gain_map_error": 0.4}, {"filtration_error": 0.2}, {"kv_error": 1.5}, {"bad_pixels": 0.4},
        {"heel": 4.0}, {"misregistration": 0.5}, {"quantisation": 8.0}, {"mtf_tail": 8.0}, {"output_drift": 0.8},
        {"grey_absorber": 3.0}, {"focal_spot": 0.9}, {"object_scatter": 20.0, "filtration_error": 0.3},
        {"heel": 6.0, "image_lag": 0.7}, {"misregistration": 0.7, "bad_pixels": 0.5}, {"output_drift": 0.8, "veiling_glare": 3.0},
    ),
}  # fmt: skip
CASES = {line: {"+".join(effects) or "none": effects for effects in cases} for line, cases in _EFFECTS.items()}


@lru_cache
def attenuation_per_mm(material: str, coherent: bool = True) -> np.ndarray:
    """Linear attenuation at each energy, 1/mm; without coherent scattering it is what deposits energy."""
    formula = FORMULA.get(material, material)
    mass = [xraylib.CS_Total_CP(formula, e) - (0 if coherent else xraylib.CS_Rayl_CP(formula, e)) for e in ENERGY_keV]
    return np.array(mass) * DENSITY_g_cm3[material] / 10


@lru_cache(maxsize=64)
def emitted(kV: float, anode_deg: float) -> np.ndarray:
    """SpekPy's photons a cm^2, mAs and keV at 1 m, a second's work.

    Where the voltage is no whole number SpekPy's bins are none either: the cumulative spectrum is read at bins of ours.
    """
    import spekpy

    tube = spekpy.Spek(kvp=kV, th=anode_deg, dk=1.0, physics="kqp", z=100)
    middles, density = tube.get_spectrum(edges=False)
    width = middles[1] - middles[0]
    below = np.concatenate([[0], np.cumsum(density) * width])
    edges = np.concatenate([middles - width / 2, [middles[-1] + width / 2]])
    return np.interp(ENERGY_keV + 0.5, edges, below) - np.interp(ENERGY_keV - 0.5, edges, below)


def spectrum(of: LineOf, kV: float, filters: str, more_aluminium_mm: float = 0.0) -> np.ndarray:
    """Photons a pixel, mAs and keV that reach the panel."""
    true_kV = kV * of.volt_scale + of.volt_offset_kV
    if of.ripple:  # the mean over a period of a rectified wave
        phases = (np.arange(5) + 0.5) / 5
        voltages = true_kV * (1 - of.ripple * (1 - np.abs(np.cos(np.pi * (phases - 0.5)))))
        photons = sum(emitted(round(one, 2), of.anode_deg) for one in voltages) / 5
    else:
        photons = emitted(round(true_kV, 2), of.anode_deg)
    layers = [layer.split(":") for layer in filters.split("+") if layer]
    for material, thickness in [*of.inherent, *layers, ("Al", more_aluminium_mm)]:
        photons = photons * np.exp(-attenuation_per_mm(material) * float(thickness))
    return photons * (of.pixel_mm / 10) ** 2 * (1000 / of.detector_mm) ** 2


def response(of: LineOf) -> tuple[np.ndarray, np.ndarray]:
    """Probability of each bin of deposited light, (energy, bin), and the light of the bins, keV.

    K photons escape from the front as Reed and Ware (1972), J. Phys. E 5, 582, have it for a thick layer, and 12 % behind or aside.
    """
    material, thickness_mm = of.scintillator
    absorbed = attenuation_per_mm(material, coherent=False)
    edge_keV, line_keV, share = K_SHELL[material]
    at_line = np.interp(line_keV, ENERGY_keV, absorbed)
    light_keV = np.linspace(3, ENERGY_keV[-1] * 1.25, BINS)
    step_keV = light_keV[1] - light_keV[0]
    found = np.zeros((len(ENERGY_keV), BINS))
    layers = 8
    depth_mm = (np.arange(layers) + 0.5) / layers * thickness_mm
    collected = 1 + of.depth_slope * (depth_mm / thickness_mm - 0.5)
    for row, (energy, mu) in enumerate(zip(ENERGY_keV, absorbed, strict=True)):
        layer_mm = thickness_mm / layers
        stopped = np.exp(-mu * depth_mm) * (1 - np.exp(-mu * thickness_mm / layers)) * np.exp(mu * layer_mm / 2)
        escaping = 0.0
        if energy > edge_keV:
            ratio = at_line / mu
            escaping = share * 0.5 * (1 - ratio * np.log(1 + 1 / ratio)) + share * 0.12
        for part, gain in zip(stopped, collected, strict=True):
            for kept_keV, probability in ((energy, 1 - escaping), (energy - line_keV, escaping)):
                if probability <= 0:
                    continue
                for sign in (-1, 1):
                    light = kept_keV * gain * (1 + sign * of.light_sd)
                    light = min(max(light, light_keV[0]), light_keV[-1] - 1e-6)
                    column = int((light - light_keV[0]) / step_keV)
                    above = (light - light_keV[column]) / step_keV
                    found[row, column] += part * probability * 0.5 * (1 - above)
                    found[row, column + 1] += part * probability * 0.5 * above
    return found, light_keV


def path_mm(of: LineOf, name: str, y: np.ndarray, x: np.ndarray) -> tuple[str, np.ndarray]:
    """Material and path length, mm, of an object at pixels from the middle of the panel."""
    rows, columns = of.shape
    if name == "wedge":
        steps = np.clip(np.floor((x + columns / 2) / (columns / 6)), 0, 5)
        return "Al", np.where(np.abs(y) < rows * 0.42, steps * of.wedge_mm * 0.5, 0.0)
    if name == "slab":
        return "pmma", np.full(np.broadcast(y, x).shape, of.slab_mm)
    if name in ("edge_r", "edge_c"):
        across, along = (x, y) if name == "edge_c" else (y, x)
        return "Fe", np.where(across + np.tan(np.radians(3.7)) * along > 3.2, 1.0, 0.0)
    if name in ("disc_s", "disc_l"):
        radius_px = rows * (0.09 if name == "disc_s" else 0.22)
        return "Pb", np.where((y - 1.3) ** 2 + (x + 2.4) ** 2 < radius_px * radius_px, 3.0, 0.0)
    across = x * (1 / (rows * 0.36))
    chord = 2 * np.sqrt(np.clip(1 - across**2, 0, None))
    return "pmma", np.where(np.abs(y) < rows * 0.4, chord * of.product_mm / 2, 0.0)


KINDS = {"edge_r": "edge", "edge_c": "edge", "disc_s": "disc", "disc_l": "disc", "cylinder": "product"}


def grid_px(of: LineOf, margin_px: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n, 1) and columns (1, m) of samples, pixels from the middle of the panel."""
    y, x = (((np.arange((n + 2 * margin_px) * samples) + 0.5) / samples - margin_px - n / 2) for n in of.shape)
    return y[:, None], x[None]


def frequencies(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Of a real Fourier transform along rows' and columns' index, cycles a sample."""
    return np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]


def light_transfer(of: LineOf, shape: tuple[int, int], tail_share: float, tail_px: float) -> np.ndarray:
    """Transfer function of the light's spread on the fine grid: a Gaussian, and an exponential or Lorentz-like tail."""
    fy, fx = (one * SAMPLES for one in frequencies(shape))
    squared = (2 * np.pi) ** 2 * (fy**2 + fx**2)
    core = np.exp(-0.5 * of.spread_px * of.spread_px * squared)
    tail = np.exp(-np.sqrt(squared) * tail_px) if of.layer_tail else (1 + squared * tail_px * tail_px) ** -1.5
    return (1 - tail_share) * core + tail_share * tail


def through_spot(picture: np.ndarray, width: float, *, lobes: bool) -> np.ndarray:
    """A picture (row, column, bin) through a focal spot of a width in samples: a Gaussian, or four blurred points."""
    if width < 0.05:
        return picture
    fy, fx = frequencies(picture.shape)
    transfer = np.exp(-0.5 * (2 * np.pi) ** 2 * (width / (3.1 if lobes else FWHM_PER_SD)) ** 2 * (fy**2 + fx**2))
    if lobes:
        transfer = transfer * np.cos(2 * np.pi * fx * width * 0.28) * np.cos(2 * np.pi * fy * width * 0.1)
    seen = np.fft.rfft2(picture, axes=(0, 1)) * transfer[..., None]
    return np.maximum(np.fft.irfft2(seen, s=picture.shape[:2], axes=(0, 1)), 0)


def far_spread(picture: np.ndarray, transfer: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A wide picture through a transfer function of cycles a pixel, mirrored at its borders."""
    rows, columns = picture.shape
    around = ((rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2))
    fy, fx = frequencies((2 * rows, 2 * columns))
    seen = np.fft.rfft2(np.pad(picture, around, mode="reflect")) * transfer(np.sqrt(fy**2 + fx**2))
    return np.fft.irfft2(seen, s=(2 * rows, 2 * columns))[rows // 2 :, columns // 2 :][:rows, :columns]


@dataclass(frozen=True, kw_only=True)
class Shot:
    """How frames are taken; scene: its name, or none; after: the calibration; turned: the panel, by 180 degrees."""

    exposure_ms: float
    kV: float = 0.0
    filters: str = ""
    current_mA: float = 0.0
    scene: str = ""
    source_object_mm: float = 0.0
    after: bool = True
    turned: bool = False


class Session:
    """A session of a line with its effects: what the panel is, what its traps hold, and the series so far."""

    def __init__(self, of: LineOf, effects: dict[str, float], rng: np.random.Generator) -> None:
        self.effects, self.rng = effects, rng
        self.response, self.light_keV = response(of)
        if "no_ripple" in effects:
            of = replace(of, ripple=0.0, volt_scale=1.0, volt_offset_kV=0.0)
        if "layer_tail" in effects:
            of = replace(of, layer_tail=True)
        self.of = of
        rows, columns = shape = of.shape
        gain = 1 + 0.008 * rng.normal(size=shape) + 0.03 * gaussian_filter(rng.normal(size=shape), 12) * 12
        if of.tiles:
            tiles = np.kron(0.02 * rng.normal(size=(rows // 16, columns // 16)), np.ones((16, 16)))
            self.gain = gain + tiles + 0.008 * rng.normal(size=shape)
        else:
            self.gain = gain * (1 + 0.004 * rng.normal(size=(1, columns)))
        self.dark_DN = of.dark_DN * (1 + 0.012 * rng.normal(size=shape) + 0.01 * rng.normal(size=(1, columns)))
        self.dark_DN_per_ms = of.dark_DN_per_ms * np.exp(0.4 * rng.normal(size=shape))
        bad = rng.random(shape) < 0.0006
        self.bad_gain = np.where(bad, np.where(rng.random(shape) < 0.5, 0.0, 3.0), 1.0)
        self.later_gain = np.ones(shape)
        if "bad_pixels" in effects:  # four fifths of them anywhere, a fifth along a column
            share = effects["bad_pixels"] / 100
            new = rng.random(shape) < share * 0.8
            column, row = rng.integers(10, columns - 10), rng.integers(5, rows - 25)
            new[row : row + round(share * 0.2 * rows * columns), column] = True
            values = np.where(rng.random(shape) < 0.4, 0.0, np.exp(0.5 * rng.normal(size=shape)) * 0.5)
            self.later_gain = np.where(new & ~bad, values, 1.0)
        if "gain_map_error" in effects:
            near = gaussian_filter(rng.normal(size=shape), 0.9)
            pattern = near / near.std() * 0.6 + 0.8 * rng.normal(size=shape)
            self.later_gain = self.later_gain * (1 + effects["gain_map_error"] / 100 * pattern / pattern.std())
        self.attenuation_factor = {material: 1 + 0.005 * rng.normal() for material in ("Al", "pmma", "Fe", "Pb")}
        # traps release over 1.2 to 400 frames
        self.release_s = np.array([1.2, 5, 22, 90, 400.0]) * of.interval_ms / 1000
        caught = self.release_s**-0.15
        self.caught = caught / caught.sum()
        self.held_keV = np.zeros((5, *shape))
        freed, held = 1 - np.exp(-of.interval_ms / 1000 / self.release_s), np.zeros(5)
        for _ in range(14):  # its strength is that of the first frame after fourteen exposed ones
            held = held * (1 - freed) + self.caught
        self.lag = effects.get("image_lag", 0.0) / 100 / (held * freed).sum()
        middle_kV, filters = of.beams[1]
        self.middle = spectrum(of, middle_kV, filters)
        mAs = of.current_mA[middle_kV] * of.exposures_ms[1] / 1000
        self.brightest_DN = self.middle @ self.response @ self.light_keV * mAs * of.DN_per_keV
        self.heel_mm = self._mm_for("W", effects.get("heel", 0.0))
        self.absorber_mm = self._mm_for("pmma", effects.get("grey_absorber", 0.0))
        self.time_s, self.drift, self.wander_DN = 0.0, 0.0, 0.0
        self.series: list[tuple[str, dict, np.ndarray, np.ndarray]] = []
        self.scenes: dict[str, tuple[str, str, np.ndarray]] = {}
        self.place: dict[str, tuple[float, float, float, float]] = {}

    def _mm_for(self, material: str, percent: float) -> float:
        """Thickness that takes a percentage of the middle beam's signal."""
        low, high = 0.0, 50.0
        seen = self.response @ self.light_keV
        for _ in range(60):
            middle = (low + high) / 2
            taken = 1 - (self.middle * np.exp(-attenuation_per_mm(material) * middle)) @ seen / (self.middle @ seen)
            low, high = (middle, high) if taken * 100 < percent else (low, middle)
        return low

    def on(self, after: bool) -> dict[str, float]:
        """The effects and their strengths, where they act."""
        return {name: strength for name, strength in self.effects.items() if after or name in ALWAYS}

    def deposits(self, shot: Shot, *, wide: bool = False) -> np.ndarray:
        """Mean deposits a pixel in each bin of light, (row, column, bin): on the fine grid, or in a wide field without blur."""
        of, on = self.of, self.on(shot.after)
        kV = shot.kV * (1 + on["kv_error"] / 100) if "kv_error" in on else shot.kV
        photons = spectrum(of, kV, shot.filters, on.get("filtration_error", 0.0))
        photons = photons * (shot.current_mA * shot.exposure_ms / 1000)
        some = photons > photons.max() * 1e-6
        y, x = grid_px(of, WIDE_px, 1) if wide else grid_px(of, MARGIN_px, SAMPLES)
        size = np.broadcast(y, x).shape
        rays = [(0.0, 0.0)]
        if shot.scene and not wide:  # a lattice of twelve in each sample
            rays = [(((i + 0.5) / 12 - 0.5) / SAMPLES, ((i * 5 % 12 + 0.5) / 12 - 0.5) / SAMPLES) for i in range(12)]
        total: np.ndarray | float = 0.0
        for down, aside in rays:
            paths: dict[str, np.ndarray] = {}
            if shot.scene:
                dy, dx, magnified, thickness_factor = self.place[shot.scene]
                at = (y + down - dy) / magnified, (x + aside - dx) / magnified
                material, thickness_mm = path_mm(of, shot.scene.rsplit("@", 1)[0], *at)
                paths[material] = thickness_mm * self.attenuation_factor[material] * thickness_factor
            if "heel" in on:
                across = x / of.shape[1] + 0.5
                across = np.clip(1 - across if shot.turned else across, 0, 1.3)
                paths["W"] = self.heel_mm * across**1.4 * np.ones_like(y)
            if "grey_absorber" in on:  # half a plane with a soft border, which stays in the beam
                beam_y, beam_x = (-y, -x) if shot.turned else (y, x)
                covered = 1 / (1 + np.exp(-(beam_x * 0.8 + beam_y * 0.6 - 8) / 1.2))
                paths["pmma"] = paths.get("pmma", 0) + covered * self.absorber_mm
            if not paths:
                total = total + np.broadcast_to(photons @ self.response, (*size, BINS))
                continue
            thick = np.stack([np.broadcast_to(one, size).ravel() for one in paths.values()]).astype(np.float32)
            mu = np.stack([attenuation_per_mm(material) for material in paths])
            if len(paths) == 1:
                levels, which = np.unique(np.round(thick[0], 5), return_inverse=True)
                levels = levels[None]
            else:
                levels, which = np.unique(np.round(thick, 5), axis=1, return_inverse=True)
            seen = ((np.exp(-mu[:, some].T @ levels)).T * photons[some]) @ self.response[some]
            total = total + seen[which.ravel()].reshape((*size, BINS))
        picture = total / len(rays)
        # inverse squares and slant: the cosine's cube
        picture = picture * (1 - 0.5 * ((x * x + y * y) * of.pixel_mm**2 / of.detector_mm**2 * 3))[..., None]
        return picture if wide or not shot.scene else self._blurred(picture, shot, on)

    def _blurred(self, picture: np.ndarray, shot: Shot, on: dict[str, float]) -> np.ndarray:
        """A scene through focal spot and motion."""
        around = (PADDING, PADDING)
        picture = np.pad(picture, (around, around, (0, 0)), mode="edge")
        magnified = self.of.detector_mm / shot.source_object_mm - 1
        picture = through_spot(picture, FOCAL_mm * magnified / self.of.pixel_mm * SAMPLES, lobes=False)
        if "focal_spot" in on:
            picture = through_spot(picture, on["focal_spot"] * magnified / self.of.pixel_mm * SAMPLES, lobes=True)
        if "motion_blur" in on:  # slowing down, along the rows' index
            places = round(on["motion_blur"] * shot.exposure_ms / 50 * SAMPLES)
            times = np.linspace(0.7, 1.3, max(places, 1))
            times /= times.sum()
            picture = sum(time * np.roll(picture, i - (places - 1) // 2, axis=0) for i, time in enumerate(times))
        return picture[PADDING:-PADDING, PADDING:-PADDING]

    def scattered_keV(self, shot: Shot) -> np.ndarray:
        """Light a pixel, on the fine grid, of photons that a scene scatters once: spread as by a layer at a third of the gap."""
        of = self.of
        behind, open_beam = (self.deposits(one, wide=True) @ self.light_keV for one in (shot, replace(shot, scene="")))
        depth = np.clip(-np.log(np.maximum(behind / open_beam, 1e-4)), 0, 6)
        gap_mm = of.detector_mm - shot.source_object_mm
        gap_px = gap_mm * 0.9 / of.pixel_mm
        spread = far_spread(behind * (1 - np.exp(-depth * 0.9)), lambda f: np.exp(-2 * np.pi * f * gap_px * 0.35))
        # the strength is that of 20 mm of water at the smaller gap
        photons = spectrum(of, of.beams[1][0], "")
        water = photons * np.exp(-attenuation_per_mm("water") * 20.0)
        seen = self.response, self.light_keV
        water_depth = np.log((photons @ seen[0] @ seen[1]) / (water @ seen[0] @ seen[1]))
        nearer = ((of.detector_mm - max(of.object_mm) + 25) / (gap_mm + 25)) ** 1.6
        spread = spread * (self.effects["object_scatter"] / 100 / (1 - np.exp(-water_depth * 0.9)) * nearer)
        inside = slice(WIDE_px - MARGIN_px, MARGIN_px - WIDE_px)
        return np.kron(spread[inside, inside], np.ones((SAMPLES, SAMPLES)))

    def glare_keV(self, shot: Shot) -> np.ndarray:
        """Light a pixel that glare spreads over 4.5 and 8.1 mm."""

        def transfer(f: np.ndarray) -> np.ndarray:
            reach = 2 * np.pi * f * 4.5 / self.of.pixel_mm
            return 0.6 * (1 + reach**2) ** -1.5 + 0.4 / (1 + (reach * 1.8) ** 2)

        return far_spread(self.deposits(shot, wide=True) @ self.light_keV, transfer)[WIDE_px:-WIDE_px, WIDE_px:-WIDE_px]

    def lit(self, shot: Shot, output: float) -> tuple[np.ndarray, np.ndarray | None]:
        """Mean deposits (row, column, bin) with scatter and crosstalk, and glare's light, keV."""
        picture, on = self.deposits(shot) * output, self.on(shot.after)
        if "object_scatter" in on and shot.scene:
            light = self.scattered_keV(shot)
            softened = picture.mean((0, 1)) * np.exp(-(((self.light_keV - 35) / 60) ** 2) * 0.3)
            picture = picture + light[..., None] * (softened / (softened @ self.light_keV))
        if "crosstalk" in on:
            share, pixel = on["crosstalk"] / 100, SAMPLES
            n = np.pad(picture, ((pixel, pixel), (pixel, pixel), (0, 0)), mode="edge")
            q = slice(pixel, -pixel)
            aside = n[q, 2 * pixel :] * 0.28 + n[q, : -2 * pixel] * 0.28
            picture = (1 - share) * picture + share * (aside + n[2 * pixel :, q] * 0.22 + n[: -2 * pixel, q] * 0.22)
        return picture, self.glare_keV(shot) * output if "veiling_glare" in on else None

    def _light(self, means: np.ndarray, transfer: np.ndarray, on: dict) -> np.ndarray:
        """Light of one frame's deposits, keV a pixel."""
        if "excess_noise" in on:
            more = np.sqrt(on["excess_noise"] / 100)
            bright, faint = self.light_keV * (1 + more), self.light_keV * (1 - more)
            light = self.rng.poisson(means / 2) @ bright + self.rng.poisson(means / 2) @ faint
        else:
            light = self.rng.poisson(means) @ self.light_keV
        padded = np.pad(light, PADDING, mode="reflect")
        light = np.fft.irfft2(np.fft.rfft2(padded) * transfer, s=padded.shape)
        rows, columns = self.of.shape
        first = PADDING + MARGIN_px * SAMPLES
        light = light[first : first + rows * SAMPLES, first : first + columns * SAMPLES]
        return light.reshape(rows, SAMPLES, columns, SAMPLES).sum((1, 3))

    def _lagged(self, light: np.ndarray, pause_s: float) -> np.ndarray:
        """Light, keV a pixel, that a frame shows, with what traps free in it."""
        self.held_keV *= np.exp(-pause_s / self.release_s)[:, None, None]
        kept = np.exp(-self.of.interval_ms / 1000 / self.release_s)[:, None, None]
        freed = (self.held_keV * (1 - kept)).sum(0)
        self.held_keV = self.held_keV * kept + self.lag * self.caught[:, None, None] * light
        return light * (1 - self.lag) + freed

    def _read(self, light: np.ndarray, exposure_ms: float, slow: np.ndarray, after: bool) -> np.ndarray:
        """Numbers, DN, that the panel gives for light, keV a pixel."""
        of, on, rng = self.of, self.on(after), self.rng
        rows, columns = of.shape
        level = np.maximum(light, 0) * of.DN_per_keV
        level = level + np.sqrt(level / of.electrons_per_DN) * rng.normal(size=of.shape)
        level = level * self.gain * slow * self.bad_gain * (self.later_gain if after else 1.0)
        if "nonlinearity" in on:
            level = level / (1 + level / (0.5 * self.brightest_DN / (on["nonlinearity"] / 100)))
        dark = self.dark_DN + self.dark_DN_per_ms * exposure_ms + self.wander_DN
        if "dark_drift" in on:
            warm = 1 - np.exp(-self.time_s / 400.0)
            across = 1 + 0.5 * (np.arange(columns) / columns - 0.5)
            dark = dark + on["dark_drift"] * exposure_ms / max(of.exposures_ms) * warm * across
        level = level + dark + of.read_DN * rng.normal(size=of.shape)
        level = level + of.row_share * of.read_DN * rng.normal(size=(rows, 1))
        if "correlated_noise" in self.effects:
            noise = gaussian_filter(rng.normal(size=of.shape), (0, 3))
            level = level + of.read_DN * self.effects["correlated_noise"] * noise / noise.std()
        if "row_noise" in on:  # of rows, and of groups of four
            noise = 0.8 * rng.normal(size=(rows, 1)) + 0.6 * np.repeat(rng.normal(size=(rows // 4, 1)), 4, axis=0)
            level = level + of.read_DN * on["row_noise"] * noise
        level = np.floor(level + 0.5)
        if "quantisation" in on:
            level = np.floor(level / on["quantisation"]) * on["quantisation"]
        return np.clip(level, 0, 2**of.bits - 1).astype(np.uint16)

    def add(self, name: str, kind: str, frames: int, shot: Shot, *, pause_s: float = 25.0, wander: bool = True) -> None:
        """Frames of a series, after a pause in which the dark level wanders."""
        of, rng, on = self.of, self.rng, self.on(shot.after)
        if wander:
            self.wander_DN += 0.03 * rng.normal()
        series_output = 1 + 0.001 * rng.normal()
        slow = gaussian_filter(rng.normal(size=of.shape), 25)
        slow = 1 + 0.0003 * slow / slow.std()
        lit = kind in ("flat", "object")
        means, glare = self.lit(shot, series_output) if lit else (None, None)
        fine = tuple((n + 2 * MARGIN_px) * SAMPLES + 2 * PADDING for n in of.shape)
        transfer = light_transfer(of, fine, of.tail_share, of.tail_px)
        if "mtf_tail" in on:
            share = on["mtf_tail"] / 100
            transfer = transfer * ((1 - share) + share * light_transfer(of, fine, 1.0, 2.2))
        shown, times_s = [], []
        self.time_s += pause_s
        for number in range(frames):
            if number:
                self.time_s += of.interval_ms / 1000
            output = 1 + 0.00015 * rng.normal()
            if "output_drift" in on and lit:  # forgotten over 14 frames
                kept = 0.93 if number else 0.5
                self.drift = kept * self.drift + np.sqrt(1 - kept**2) * rng.normal()
                output *= 1 + on["output_drift"] / 100 * self.drift
            light = np.zeros(of.shape)
            if means is not None:
                light = self._light(means * (output / SAMPLES**2), transfer, on)
            if glare is not None:
                share = on["veiling_glare"] / 100
                light = (1 - share) * light + share * glare * output
            if "image_lag" in on:
                light = self._lagged(light, 0.0 if number else pause_s)
            shown.append(self._read(light, shot.exposure_ms, slow, shot.after))
            times_s.append(self.time_s)
        self.time_s += of.interval_ms / 1000
        told = {"index": len(self.series), "kind": kind, "exposure_ms": shot.exposure_ms}
        told |= {"frame_interval_ms": of.interval_ms, "role": "evaluation" if shot.after else "calibration"}
        if lit:
            told |= {"kV": shot.kV, "current_mA": shot.current_mA, "filter": shot.filters}
        if shot.scene:
            told |= {"scene": shot.scene, "source_object_mm": shot.source_object_mm}
        if shot.turned:
            told["panel_rotation_deg"] = 180.0
        self.series.append((name, told, np.array(shown), np.array(times_s)))

    def set_up(self, name: str, source_object_mm: float) -> str:
        """Name of the scene of an object at a distance, which then lies where it lies, with its map of path lengths."""
        scene = f"{name}@{source_object_mm:.0f}"
        if scene in self.place:
            return scene
        of, rng = self.of, self.rng
        (dy, dx), magnified = 0.02 * rng.normal(size=2), 1.0
        if "misregistration" in self.effects:  # rms px over the field: 0.8 of it a shift, 0.6 a magnification
            px, angle = self.effects["misregistration"], rng.uniform(0, 2 * np.pi)
            dy, dx = dy + 0.8 * px * np.sin(angle), dx + 0.8 * px * np.cos(angle)
            magnified = 1 + 0.6 * px / np.hypot(*of.shape) * 3.4
        self.place[scene] = dy, dx, magnified, 1 + 0.003 * rng.normal()
        rows, columns = of.shape
        material, thickness_mm = path_mm(of, name, *grid_px(of, 0, 24))
        thickness_mm = np.broadcast_to(thickness_mm, (rows * 24, columns * 24)).reshape(rows, 24, columns, 24)
        self.scenes[scene] = KINDS.get(name, name), material, thickness_mm.mean((1, 3))
        return scene

    def take(self) -> None:
        """All series: darks and flats that calibrate, then darks, flats, afterglow and objects."""
        of = self.of
        short, long = of.exposures_ms
        for exposure_ms in of.exposures_ms:
            self.add(f"dark_{exposure_ms:g}", "dark", 24, Shot(exposure_ms=exposure_ms, after=False))
        lit = {
            kV: Shot(exposure_ms=long, kV=kV, filters=filters, current_mA=of.current_mA[kV]) for kV, filters in of.beams
        }
        for kV, shot in lit.items():
            full = replace(shot, after=False)
            for share in (0.1, 0.4):
                weak = replace(full, exposure_ms=short, current_mA=shot.current_mA * share * long / short)
                self.add(f"flat_{kV:g}_{100 * share:.0f}", "flat", 14, weak)
            self.add(f"flat_{kV:g}_100", "flat", 14, full)
        dark = Shot(exposure_ms=long)
        self.add("dark_mid", "dark", 14, dark)
        middle = lit[of.beams[1][0]]
        for kV, shot in lit.items():
            for share in (0.5, 0.95) if shot is middle else (0.95,):
                part = replace(shot, current_mA=shot.current_mA * share)
                self.add(f"flat2_{kV:g}_{100 * share:.0f}", "flat", 12, part)
        self.add("afterglow", "afterglow", 12, dark, pause_s=0.0, wander=False)
        behind = replace(middle, filters=f"{middle.filters}+Cu:0.1".strip("+"))
        self.add("flat_filter", "flat", 12, behind, wander=False)
        usual = {kV: replace(shot, current_mA=shot.current_mA * 0.9) for kV, shot in lit.items()}
        flat = usual[middle.kV]
        self.add("flat_turned", "flat", 12, replace(flat, turned=True), wander=False)
        self.add("flat_short", "flat", 12, replace(flat, exposure_ms=short), wander=False)
        far, near = of.object_mm
        for name, at_mm in (
            ("wedge", far), ("wedge", near), ("slab", far), ("slab", near), ("edge_r", far), ("edge_r", near), ("edge_c", near),
            ("disc_l", far), ("disc_s", near), ("cylinder", far),
        ):  # fmt: skip
            place = {"scene": self.set_up(name, at_mm), "source_object_mm": at_mm}
            shots = [replace(flat, **place)]
            if (name, at_mm) == ("wedge", far):  # two beams
                shots.insert(0, replace(usual[of.beams[0][0]], **place))
            if (name, at_mm) == ("edge_r", far):  # two exposures, of one mAs where they differ little
                times = long / short if long / short < 2.5 else 1.0
                shots.insert(0, replace(shots[0], exposure_ms=short, current_mA=flat.current_mA * times))
            for shot in shots:
                self.add(f"{name}_{at_mm:.0f}_{shot.kV:g}_{shot.exposure_ms:g}", "object", 8, shot)
        self.add("flat_end", "flat", 12, replace(middle, current_mA=middle.current_mA * 0.95))
        self.add("dark_end", "dark", 14, dark)
        self.add("dark_end_lo", "dark", 14, replace(dark, exposure_ms=short))

    def write(self, path: Path) -> None:
        """The acquisition file of docs/formats.md."""
        of = self.of
        inherent = "+".join(f"{name}:{mm}" for name, mm in of.inherent if name != "W")
        with h5py.File(path, "w") as file:
            file.attrs.update({"format": "raytwin-acquisition", "version": 1})
            file.create_group("instrument").attrs.update({
                "anode": "W", "anode_angle_deg": of.anode_deg, "inherent_filtration": inherent, "source_object_mm": of.object_mm[0],
                "source_detector_mm": of.detector_mm, "pixel_mm": of.pixel_mm, "focal_spot_mm": FOCAL_mm, "detector": "area",
                "scintillator": of.declared, "bits": of.bits,
            })  # fmt: skip
            for name, told, frames, times_s in self.series:
                group = file.create_group(f"series/{name}")
                group.attrs.update(told)
                group.create_dataset("frames", data=frames, compression="lzf")
                group.create_dataset("time_s", data=times_s)
            for name, (kind, material, thickness_mm) in self.scenes.items():
                group = file.create_group(f"scenes/{name}")
                group.attrs["kind"] = kind
                group.create_dataset(f"thickness_mm/{material}", data=thickness_mm.astype(np.float32))


def diagnosis_of(session: Session, path: Path, seed: int) -> Diagnosis:
    """The diagnosis of a session, once it is taken and written."""
    session.take()
    session.write(path)
    with open_acquisition(path) as acquisition:
        return diagnose(acquisition, rng=np.random.default_rng(seed))


def answer_text(found: Diagnosis) -> str:
    """Verdict, what is named, and with which strengths."""
    nothing = {"no_gap": found.probability_no_gap, "unknown_effect": found.probability_unknown}
    words = found.verdict + (f" {nothing[found.verdict]:.2f}" if found.verdict in nothing else "")
    for cause in found.leading:
        low, value, high = sorted(cause.sign * one for one in cause.strength)
        words += (
            f"; {cause.effect} {cause.probability:.2f}, {value:.3g} ({low:.3g} to {high:.3g}) {cause.unit}".rstrip()
        )
    return words


def judged(line: str, case: str, seed: int, folder: Path) -> tuple[bool, str]:
    """Whether the planted effects, and nothing else, are named in the session of a case, and what was planted and found in words."""
    planted = {name: strength for name, strength in CASES[line][case].items() if name not in NOT_NAMED}
    words = "planted " + (
        " + ".join(f"{name} {one:g} {UNITS.get(name, '%')}" for name, one in planted.items()) or "nothing"
    )
    session = Session(LINES[line], CASES[line][case], np.random.default_rng(seed))
    try:
        found = diagnosis_of(session, folder / f"{line}_{case}_{seed}.h5", seed)
    except InputError as error:
        return False, f"{words}; refused: {error}"
    words += f"; {answer_text(found)}"
    verdicts = ("explained", "explained_in_part") if planted else ("no_gap",)
    return found.verdict in verdicts and set(found.named) == set(planted), words


def run() -> None:
    """A line a case on the terminal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("line", choices=LINES)
    parser.add_argument("--cases", help="joined by commas (default all); two effects of one case are joined by +")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for the sessions (default: a temporary one)")
    options = parser.parse_args()
    cases = options.cases.split(",") if options.cases else list(CASES[options.line])
    for case in cases:
        if case not in CASES[options.line]:
            parser.error(f"{case}: line {options.line} has {', '.join(CASES[options.line])}")
    rights = []
    with contextlib.ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        for case in cases:
            right, words = judged(options.line, case, options.seed, folder)
            rights.append(right)
            print(f"{case:32s} {'right' if right else 'WRONG'}  {words}", flush=True)
    print(f"{sum(rights)} of {len(rights)} right: the planted effects named, and nothing else")


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        run()

"""The system that stands in the virtual lab: its true parameters, fixed or drawn, and its per-pixel maps."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.instrument import Instrument
from ..acquisition.setting import Filter
from ..errors import InputError
from .unkindness import NONE, Unkindness

PAPER_PIXEL_MM = 0.15
PAPER_SOURCE_OBJECT_MM = 990.0
PAPER_SOURCE_DETECTOR_MM = 1059.0
SCINTILLATORS = ("CsI", "Gd2O2S@7.32")
TAIL_LAWS = ("exponential", "lorentzian")


@dataclass(frozen=True, slots=True, kw_only=True)
class LabSystem:
    """The truth about one X-ray line; what a calibration has to find out.

    The defaults give what the paper's line gives: 23 DN/ms at 40 kV 40 W and 174 DN/ms at 90 kV 45 W behind 50 um Cu, a
    photon-transfer slope near 1.95 DN at 40 kV (the gain with the blur's share restored is near 6 DN), a dark variance
    of 165.63 DN2 and a dark level of 1250 DN. The defaults have no unkindness and no departure of any family.

    Fields:
        rows, columns: pixels of the detector.
        pixel_mm: pitch; the sensitive area fills it.
        source_object_mm, source_detector_mm: distances. `LabSystem.at_size` scales them with the pitch, so that every
            pitch gets the photons per pixel of the paper's line at the same power.
        anode_angle_deg: of the tungsten anode; labelled_angle_deg: what the sheet says.
        kV_offset_percent: how much the true voltage exceeds the set one.
        tube_output: photons emitted, relative to the tube model.
        inherent_filtration: layers between anode and filter wheel.
        tube_model: whose bremsstrahlung it is, of `tube.MODELS`.
        kV_ripple_percent: by how much the voltage dips between its peaks.
        anode_rough_um: tungsten that photons cross on their way out of a rough anode, beyond a smooth one's.
        output_exponent: output over the tube model's goes as (kV / 60)^exponent.
        cover: layers in front of the scintillator (housing, glue, dead layer).
        scintillator: `CsI` or `Gd2O2S@7.32`.
        scintillator_mm: solid-density thickness; labelled_scintillator_mm: what the sheet says.
        k_escape_share: of the K photons that would leave a bare slab, how many do.
        light_curve: how far the light goes with the published non-proportional curve (0 = proportional, 1 = as published).
        depth_light: how much more light a photon gives at the exit face than at the entrance, relative to the mean.
        light_swank: Swank factor of the light of one photon of fixed deposit and depth (1 = no spread).
        electrons_per_keV: electrons that one keV of deposit frees in the photodiodes, in all pixels together.
        DN_per_electron: conversion, detector median.
        gain_spread_percent: standard deviation of the per-pixel conversion.
        psf_sigma_px: standard deviation of the Gaussian core of the spread of light, without the pixel's own aperture: the
            geometric mean of that along rows and that along columns; psf_aspect: the former over the latter.
        tail_share, tail_length_px, tail_law: light beyond the core, `exponential` exp(-r / length) or `lorentzian`
            (1 + (r / length)^2)^-3/2 over the pixels around, cut off at 12 px.
        read_noise_DN: standard deviation of the electronic noise of a frame.
        dark_DN: median dark level at zero exposure; dark_spread_DN: its standard deviation over pixels.
        dark_current_DN_per_ms: growth of the dark level.
        bits: of the ADC.
        dead_pixels, hot_pixels: how many of each; bad_clusters: clusters of 4 to 9 dead ones; dead_lines: stretches of a row or
            column.
        maximum_power_W, readout_ms: as on the vendor's sheet.
        maps_seed: draws the per-pixel maps.
        unkindness: what the line does a little all the time.
    """

    rows: int = 128
    columns: int = 160
    pixel_mm: float = 0.45
    source_object_mm: float = 3.0 * PAPER_SOURCE_OBJECT_MM
    source_detector_mm: float = 3.0 * PAPER_SOURCE_DETECTOR_MM
    anode_angle_deg: float = 12.0
    labelled_angle_deg: float = 12.0
    kV_offset_percent: float = 0.0
    tube_output: float = 1.13
    inherent_filtration: tuple[Filter, ...] = (Filter(material="Al", thickness_mm=1.0),)
    tube_model: str = "kqp"
    kV_ripple_percent: float = 0.0
    anode_rough_um: float = 0.0
    output_exponent: float = 0.0
    cover: tuple[Filter, ...] = ()
    scintillator: str = "CsI"
    scintillator_mm: float = 0.5
    labelled_scintillator_mm: float = 0.5
    k_escape_share: float = 1.0
    light_curve: float = 0.0
    depth_light: float = 0.0
    light_swank: float = 0.94
    electrons_per_keV: float = 16.0
    DN_per_electron: float = 0.0129
    gain_spread_percent: float = 1.5
    psf_sigma_px: float = 0.42
    psf_aspect: float = 1.0
    tail_share: float = 0.0
    tail_length_px: float = 1.0
    tail_law: str = "exponential"
    read_noise_DN: float = 12.87
    dark_DN: float = 1250.0
    dark_spread_DN: float = 45.0
    dark_current_DN_per_ms: float = 0.05
    bits: int = 16
    dead_pixels: int = 3
    hot_pixels: int = 3
    bad_clusters: int = 0
    dead_lines: int = 0
    maximum_power_W: float = 90.0
    readout_ms: float = 2.0
    maps_seed: int = 0
    unkindness: Unkindness = NONE

    def __post_init__(self) -> None:
        zero_allowed = {
            "kV_ripple_percent",
            "anode_rough_um",
            "k_escape_share",
            "light_curve",
            "tail_share",
            "bad_clusters",
            "dead_lines",
            "dead_pixels",
            "hot_pixels",
            "maps_seed",
            "gain_spread_percent",
            "psf_sigma_px",
            "read_noise_DN",
            "dark_spread_DN",
            "dark_current_DN_per_ms",
            "readout_ms",
        }
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, int | float):
                continue
            lowest_fits = (
                value > -50
                if field.name in ("kV_offset_percent", "output_exponent", "depth_light")
                else value >= 0
                if field.name in zero_allowed
                else value > 0
            )
            if not (math.isfinite(value) and lowest_fits):
                raise InputError(f"lab system {field.name}", received=value, expected="a finite positive number")
        if not self.source_object_mm < self.source_detector_mm:
            raise InputError(
                "lab system source_object_mm",
                received=f"{self.source_object_mm:g} mm",
                expected=f"less than the source-detector distance of {self.source_detector_mm:g} mm",
            )
        if not 0.2 <= self.light_swank <= 1.0:
            raise InputError("lab system light_swank", received=self.light_swank, expected="0.2 to 1")
        if self.psf_sigma_px > 3.0:
            raise InputError("lab system psf_sigma_px", received=self.psf_sigma_px, expected="0 to 3 px")
        for name, value, known in (
            ("scintillator", self.scintillator, SCINTILLATORS),
            ("tail_law", self.tail_law, TAIL_LAWS),
        ):
            if value not in known:
                raise InputError(f"lab system {name}", received=repr(value), expected="one of " + ", ".join(known))
        if not (self.tail_share < 1.0 and self.k_escape_share <= 1.0 and abs(self.depth_light) <= 1.0):
            raise InputError(
                "lab system tail_share, k_escape_share, depth_light",
                received=f"{self.tail_share:g}, {self.k_escape_share:g}, {self.depth_light:g}",
                expected="shares below 1, of 0 to 1, and -1 to 1",
            )
        if not 1 <= self.bits <= 16:
            raise InputError("lab system bits", received=self.bits, expected="1 to 16")
        if min(self.rows, self.columns) < 8:
            raise InputError(
                "size of the lab's detector", received=f"{self.rows}x{self.columns}", expected="8x8 pixels or more"
            )

    @property
    def magnification(self) -> float:
        """Source-detector over source-object distance."""
        return self.source_detector_mm / self.source_object_mm

    @property
    def core_px(self) -> tuple[float, float]:
        """Standard deviations of the spread's core: from row to row, and from column to column."""
        root = math.sqrt(self.psf_aspect)
        return self.psf_sigma_px * root, self.psf_sigma_px / root

    @property
    def saturation_DN(self) -> int:
        """Highest number of the ADC (DN)."""
        return int(2**self.bits) - 1

    def at_size(
        self, *, rows: int, columns: int, pixel_mm: float, source_detector_mm: float | None = None
    ) -> "LabSystem":
        """The same tube and the same electronics with another detector, distances scaled with the pitch.

        Flux at the detector falls with the square of the distance and a pixel's area grows with the square of the
        pitch, so the photons per pixel at a given power stay, and the paper's settings keep their meaning. Another
        distance can be asked for (magnification unchanged): half of it means four times the photons.
        """
        if source_detector_mm is None:
            source_detector_mm = pixel_mm / PAPER_PIXEL_MM * PAPER_SOURCE_DETECTOR_MM
        if not (math.isfinite(source_detector_mm) and 100.0 <= source_detector_mm <= 100000.0):
            raise InputError(
                "source_detector_mm", received=f"{source_detector_mm:g} mm", expected="a distance of 100 to 100000 mm"
            )
        return replace(
            self,
            rows=rows,
            columns=columns,
            pixel_mm=pixel_mm,
            source_object_mm=source_detector_mm * PAPER_SOURCE_OBJECT_MM / PAPER_SOURCE_DETECTOR_MM,
            source_detector_mm=source_detector_mm,
        )

    def instrument(self) -> Instrument:
        """What the vendor's sheet says about the line: labels, not the truth; covers and tails are not on it."""
        return Instrument(
            anode="W",
            anode_angle_deg=self.labelled_angle_deg,
            source_object_mm=self.source_object_mm,
            source_detector_mm=self.source_detector_mm,
            pixel_mm=self.pixel_mm,
            detector="area",
            counting=False,
            scintillator=(Filter(material=self.scintillator, thickness_mm=self.labelled_scintillator_mm),),
            bits=self.bits,
            maximum_power_w=self.maximum_power_W,
            readout_ms=self.readout_ms,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorMaps:
    """The detector pixel by pixel.

    Fields: DN_per_electron (row, column), 0 for a dead pixel; dark_DN (row, column) at zero exposure;
    dark_current_DN_per_ms (row, column); read_noise_DN (row, column); bad_pixels: (row, column, `dead` or `hot`).
    """

    DN_per_electron: NDArray[np.float32]
    dark_DN: NDArray[np.float32]
    dark_current_DN_per_ms: NDArray[np.float32]
    read_noise_DN: NDArray[np.float32]
    bad_pixels: tuple[tuple[int, int, str], ...]


def _smooth_pattern(rng: np.random.Generator, *, rows: int, columns: int) -> NDArray[np.float64]:
    """A slowly varying pattern over the detector, mean 0 and standard deviation 1."""
    y, x = np.mgrid[0:rows, 0:columns] / max(rows, columns)
    pattern = np.zeros((rows, columns))
    for _ in range(6):
        wave_y, wave_x = rng.uniform(-3.0, 3.0, size=2)
        pattern += rng.standard_normal() * np.cos(2 * np.pi * (wave_y * y + wave_x * x) + rng.uniform(0, 2 * np.pi))
    scaled: NDArray[np.float64] = (pattern - pattern.mean()) / max(float(pattern.std()), 1e-12)
    return scaled


def _grouped_defects(rng: np.random.Generator, system: LabSystem) -> set[tuple[int, int]]:
    """Pixels of clusters (4 to 9 within 3 x 3) and of stretches of a line (a quarter of it to all)."""
    found: set[tuple[int, int]] = set()
    for _ in range(system.bad_clusters):
        row, column = int(rng.integers(system.rows - 2)), int(rng.integers(system.columns - 2))
        for place in rng.permutation(9)[: int(rng.integers(4, 10))]:
            found.add((row + int(place) // 3, column + int(place) % 3))
    for _ in range(system.dead_lines):
        along_rows = bool(rng.random() < 0.5)
        length, lines = (system.columns, system.rows) if along_rows else (system.rows, system.columns)
        line, share = int(rng.integers(lines)), rng.uniform(0.25, 1.0)
        start = int(rng.uniform(0.0, 1.0 - share) * length)
        for step in range(start, min(start + round(share * length), length)):
            found.add((line, step) if along_rows else (step, line))
    return found


def detector_maps(system: LabSystem) -> DetectorMaps:
    """The per-pixel maps of a system (DN per electron, dark level, dark current, read noise), drawn from its seed.

    Conversion and dark level are half smooth pattern, half independent pixels (by variance). A hot pixel has 200 times
    the dark current (1 DN/ms at least) and ten times the read noise; a dead one gives the dark level whatever falls on
    it.
    """
    rng = np.random.default_rng(system.maps_seed)
    shape = (system.rows, system.columns)

    def pattern() -> NDArray[np.float64]:
        smooth = _smooth_pattern(rng, rows=system.rows, columns=system.columns)
        mixed: NDArray[np.float64] = (smooth + rng.standard_normal(shape)) / math.sqrt(2.0)
        return mixed - float(np.median(mixed))

    conversion = system.DN_per_electron * (1.0 + system.gain_spread_percent / 100.0 * pattern())
    dark_DN = np.maximum(system.dark_DN + system.dark_spread_DN * pattern(), 0.0)
    current = np.full(shape, system.dark_current_DN_per_ms)
    read_noise_DN = np.full(shape, system.read_noise_DN)
    count = min(system.dead_pixels + system.hot_pixels, conversion.size)
    places = rng.choice(conversion.size, size=count, replace=False)
    bad: list[tuple[int, int, str]] = []
    for number, place in enumerate(places):
        row, column = divmod(int(place), system.columns)
        if number < system.dead_pixels:
            conversion[row, column] = 0.0
            bad.append((row, column, "dead"))
        else:
            current[row, column] = max(200.0 * system.dark_current_DN_per_ms, 1.0)
            read_noise_DN[row, column] *= 10.0
            bad.append((row, column, "hot"))
    for row, column in sorted(_grouped_defects(rng, system) - {(row, column) for row, column, _ in bad}):
        conversion[row, column] = 0.0
        bad.append((row, column, "dead"))
    return DetectorMaps(
        DN_per_electron=np.maximum(conversion, 0.0).astype(np.float32),
        dark_DN=dark_DN.astype(np.float32),
        dark_current_DN_per_ms=current.astype(np.float32),
        read_noise_DN=read_noise_DN.astype(np.float32),
        bad_pixels=tuple(sorted(bad)),
    )

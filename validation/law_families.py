"""Sessions of the second simulator with laws of other shapes: for each effect two or three families, the shape drawn each time.

A real effect of a kind does not follow the catalogue's formula, nor the second simulator's. The strength keeps its meaning; the
law's form is drawn: kernels of scatter, glare and tails, traps of a lag, responses, patterns, courses, profiles of motion.

    python validation/law_families.py --list
    python validation/law_families.py --line coarse --only object_scatter image_lag --seed 7
    python validation/law_families.py --line usual --pairs 10 --seed 7
"""

import argparse
import json
import math
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np
import second_simulator as plain
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates, shift
from scipy.special import ndtr

from raytwin.acquisition import open_acquisition
from raytwin.diagnosis.diagnose_session import diagnose

FAMILIES: dict[str, tuple[str, ...]] = {
    "object_scatter": ("two Gaussians, saturating source", "exponential, other law of the gap"),
    "veiling_glare": ("one exponential", "Gaussian and pedestal"),
    "image_lag": ("power law", "two exponentials"),
    "nonlinearity": ("cubic", "kinked", "square root of a sum"),
    "tile_gain": ("one tile alone", "a slope in each", "of unlike widths"),
    "gain_map_error": ("correlated over some pixels", "columns", "smooth and fine"),
    "heel": ("one-sided", "bent"),
    "focal_spot": ("two peaks", "flat"),
    "mtf_tail": ("exponential", "two Gaussians"),
    "motion_blur": ("to and fro", "accelerated"),
    "output_drift": ("random walk", "trend"),
    "dark_drift": ("stronger at one side", "rising"),
    "row_noise": ("columns as well", "bands of rows"),
    "excess_noise": ("a share of the signal as well",),
    "quantisation": ("rounded",),
    "bad_pixels": ("clusters", "lines"),
    "misregistration": ("enlarged", "turned"),
    "k_fluorescence": ("one exponential",),
    "kv_error": ("with ripple",),
    "filtration_error": ("copper",),
    "composition_error": ("in all objects",),
    "crosstalk": ("corners as well", "more along rows"),
    "line_flicker": ("sine of any phase", "columns", "bands of rows"),
    "grey_absorber": ("copper from a slanted border on", "strip", "corner"),
    "dropped_frames": ("every few frames", "some in a row"),
    "off_focal": ("ring", "towards one side"),
    "random_telegraph": ("three levels", "heights that fall exponentially"),
    "burn_in": ("two kinds of traps", "fades as a power of time"),
    "pile_up": ("prolonged by each photon", "pixels of unlike dead times"),
    "threshold_error": ("pixels of unlike shifts", "in proportion to unlike thresholds", "of more noise"),
}
# what the plain simulator has no law of: a middling strength (unit of the catalogue)
ADDED = {
    "crosstalk": 10.0,
    "line_flicker": 0.2,
    "grey_absorber": 4.0,
    "dropped_frames": 5.0,
    "off_focal": 7.0,
    "random_telegraph": 1.5,
    "tile_gain": 0.5,
    "burn_in": 2.0,
    "pile_up": 400.0,
}
ADDED_ALWAYS = frozenset(ADDED) - {"grey_absorber", "random_telegraph", "tile_gain"}
_SOURCE_POINTS = 24


def correlated(rng: np.random.Generator, shape: tuple[int, int], px: float) -> np.ndarray:
    """White noise filtered to a correlation length, standard deviation 1 (row, column)."""
    found = gaussian_filter(rng.standard_normal(shape), px, mode="wrap")
    return np.asarray(found / found.std())


def exponential(image: np.ndarray, length_px: float) -> np.ndarray:
    """An image spread by exp(-r / length) / r (row, column), what lies beyond its borders as at them."""
    pad = min(int(6 * length_px) + 2, 250)
    wide = np.pad(image, pad, mode="edge")
    frequency = np.hypot(np.fft.fftfreq(wide.shape[0])[:, None], np.fft.rfftfreq(wide.shape[1])[None, :])
    passed = 1.0 / np.sqrt(1.0 + (2.0 * math.pi * frequency * length_px) ** 2)
    return np.asarray(np.fft.irfft2(np.fft.rfft2(wide) * passed, s=wide.shape)[pad:-pad, pad:-pad])


class FamilyLine(plain.Line):
    """A line whose effects follow laws of drawn families; `families` by effect (`FAMILIES`), the rest as the plain line has it."""

    def __init__(self, name: str, effects: tuple[str, ...], rng: np.random.Generator) -> None:
        super().__init__(name, effects, rng)
        self.law = np.random.default_rng(rng.integers(2**62))
        self.families = {one: str(self.law.choice(FAMILIES[one])) for one in self.effects if one in FAMILIES}
        self.always |= ADDED_ALWAYS & set(self.effects)
        self.u = {key: self.law.uniform() for key in "abcd"}
        if "gain_map_error" in self.effects:
            self.changed_gain = 1.0 + self.effects["gain_map_error"] / 100.0 * self._pattern()
        if "tile_gain" in self.effects:
            self.changed_gain = 1.0 + self.effects["tile_gain"] / 100.0 * self._tiles()
        if "bad_pixels" in self.effects:
            self.changed_gain = self._dead()
        self.jumpy = self.law.random(self.of.shape) if "random_telegraph" in self.effects else np.ones(self.of.shape)
        self.slow_pixels = np.ones(self.of.shape)
        if self._is("pile_up", "pixels of unlike dead times"):
            self.slow_pixels = np.exp(0.2 * self.law.standard_normal(self.of.shape))
        self.unlike = self.law.standard_normal((*self.of.shape, 1)) if "threshold_error" in self.effects else 0.0
        self.seen: list[np.ndarray] = []
        self.walk = 0.0
        self.taken = 0

    def _is(self, effect: str, family: str) -> bool:
        return self.families.get(effect) == family

    def _pattern(self) -> np.ndarray:
        shape, family = self.of.shape, self.families["gain_map_error"]
        if family == "columns":
            return np.broadcast_to(self.law.standard_normal((1, shape[1])), shape).copy()
        if family == "smooth and fine":
            return 0.8 * correlated(self.law, shape, 12.0) + 0.6 * self.law.standard_normal(shape)
        return correlated(self.law, shape, 0.5 + 5.5 * self.u["a"])

    def _tiles(self) -> np.ndarray:
        """Gains of tiles (row, column), standard deviation 1 over the panel."""
        (rows, columns), family = self.of.shape, self.families["tile_gain"]
        wide = int(20 + 30 * self.u["a"])
        first = int(wide * self.u["b"])
        row_of, column_of = ((np.arange(side) + first) // wide for side in (rows, columns))
        if family == "of unlike widths":
            column_of = np.searchsorted(np.cumsum(self.law.uniform(0.6, 1.4, size=columns) * wide), np.arange(columns))
        gains = self.law.standard_normal((row_of[-1] + 1, column_of[-1] + 1))[row_of][:, column_of]
        if family == "one tile alone":
            gains = ((row_of == row_of[rows // 2])[:, None] & (column_of == column_of[columns // 2])).astype(float)
        if family == "a slope in each":
            gains = gains + 1.5 * (((np.arange(columns) + first) % wide) / wide - 0.5)
        return np.asarray((gains - gains.mean()) / gains.std())

    def _passed(self, energies: np.ndarray, share: float) -> np.ndarray:
        """What an absorber in a part of the beam leaves of the light, (row, column, energy) or (row, column, 1)."""
        y, x = (np.arange(side) / (side - 1) - 0.5 for side in self.of.shape)
        turn = 2.0 * math.pi * self.u["a"]
        along = y[:, None] * math.cos(turn) + x[None, :] * math.sin(turn)
        if self._is("grey_absorber", "strip"):
            covered = np.clip((0.2 - np.abs(along - 0.2 * self.u["b"])) / 0.04 + 0.5, 0.0, 1.0)
        elif self._is("grey_absorber", "corner"):
            covered = np.clip((y[:, None] - 0.1) / 0.04, 0.0, 1.0) * np.clip((x[None, :] - 0.1) / 0.04, 0.0, 1.0)
        else:
            # so much copper as 45 keV lose the share
            covered = np.clip((along - 0.2 * self.u["b"]) / 0.06 + 0.5, 0.0, 1.0)
            copper = plain.attenuation_per_mm("Cu", np.array([45.0, *energies]))
            return np.exp(math.log1p(-share) * covered[..., None] * copper[1:] / copper[0])
        return (1.0 - share * covered)[..., None]

    def _dead(self) -> np.ndarray:
        shape = self.of.shape
        found = np.ones(shape)
        wanted = max(round(self.effects["bad_pixels"] / 100.0 * found.size), 1)
        while np.count_nonzero(found != 1.0) < wanted:
            row, column = (int(self.law.integers(0, side)) for side in shape)
            if self.families["bad_pixels"] == "lines":
                found[row, column : column + 24] = self.law.uniform(0.0, 0.5)
            else:
                found[row : row + 2, column : column + 2] = self.law.uniform(0.0, 0.5)
        return found

    def scattered(self, source: np.ndarray) -> np.ndarray:
        pixel_mm = self.of.pixel_mm
        if self._is("object_scatter", "two Gaussians, saturating source"):
            top = float(source.max())
            bent = source / (1.0 + (0.3 + self.u["a"]) * source / max(top, 1e-9)) * (1.3 + self.u["a"]) ** 0.7
            wide = np.pad(bent, 200)
            narrow_mm, broad_mm = 5.0 + 5.0 * self.u["b"], 20.0 + 20.0 * self.u["c"]
            mixed = 0.4 * gaussian_filter(wide, narrow_mm / pixel_mm) + 0.6 * gaussian_filter(wide, broad_mm / pixel_mm)
            return np.asarray(mixed[200:-200, 200:-200])
        if self._is("object_scatter", "exponential, other law of the gap"):
            wide = np.pad(source, 200)
            return exponential(wide, (8.0 + 12.0 * self.u["b"]) / pixel_mm)[200:-200, 200:-200]
        return super().scattered(source)

    def counted(self, energies: np.ndarray, moved_keV: float) -> np.ndarray:
        at_keV, width_keV = self.of.threshold_keV, plain.COMPARATOR_KEV
        if self._is("threshold_error", "pixels of unlike shifts"):
            return ndtr((energies - at_keV - moved_keV * (1.0 + 0.3 * self.unlike)) / width_keV)
        if self._is("threshold_error", "in proportion to unlike thresholds"):
            own_keV = at_keV * (1.0 + 0.03 * self.unlike)
            return ndtr((energies - own_keV * (1.0 + moved_keV / at_keV)) / width_keV)
        if self._is("threshold_error", "of more noise") and moved_keV:
            return ndtr((energies - at_keV - moved_keV) / (2.0 * width_keV))
        return super().counted(energies, moved_keV)

    def open_light(self, kV: float, mAs: float, copper_mm: float, on: dict) -> tuple[np.ndarray, np.ndarray]:
        if "kv_error" in on and self._is("kv_error", "with ripple"):
            low = {**on, "kv_error": on["kv_error"] - 2.0}
            high = {**on, "kv_error": on["kv_error"] + 2.0}
            parts = [super(FamilyLine, self).open_light(kV, mAs / 2.0, copper_mm, one) for one in (low, high)]
            (energies, first), (others, second) = parts
            grid = energies if len(energies) >= len(others) else others
            first, second = (np.pad(one, ((0, 0), (0, 0), (0, len(grid) - one.shape[2]))) for one in (first, second))
            return grid, first + second
        plain_on = {key: value for key, value in on.items() if key != "heel"}
        if "filtration_error" in on and self._is("filtration_error", "copper"):
            plain_on["filtration_error"] = 0.0
        energies, arriving = super().open_light(kV, mAs, copper_mm, plain_on)
        if "filtration_error" in on and self._is("filtration_error", "copper"):
            # so much copper as 50 keV pass like the aluminium
            ratio = plain.attenuation_per_mm("Al", np.array([50.0])) / plain.attenuation_per_mm("Cu", np.array([50.0]))
            thick_mm = on["filtration_error"] * float(ratio[0])
            arriving = arriving * np.exp(-thick_mm * plain.attenuation_per_mm("Cu", energies))
        if "heel" in on:
            tungsten = plain.attenuation_per_mm("W", energies)
            photons = arriving.sum(axis=(0, 1))
            signal = photons * energies
            thick_mm = on["heel"] / 100.0 * float(signal.sum()) / float(signal @ tungsten)
            along = np.arange(self.of.shape[1]) / (self.of.shape[1] - 1)
            course = along if self._is("heel", "one-sided") else along ** (1.5 + self.u["a"])
            arriving = arriving * np.exp(-course[None, :, None] * thick_mm * tungsten)
        if "grey_absorber" in on:
            arriving = arriving * self._passed(energies, on["grey_absorber"] / 100.0)
        return energies, arriving

    def transmitted(self, scene: str, energies: np.ndarray, on: dict, exposure_ms: float) -> np.ndarray:
        apart_px = on.get("misregistration", 0.0)
        depth = np.zeros((*self.of.shape, 1))
        rows, columns = self.of.shape
        y, x = np.indices(self.of.shape, dtype=float)
        y, x = y - rows / 2, x - columns / 2
        typical = math.sqrt(float(np.mean(y**2 + x**2)))
        for material, stated_mm in self.scenes[scene][1].items():
            thickness_mm = stated_mm
            if apart_px:
                across = (y, x) if self._is("misregistration", "enlarged") else (-x, y)
                at = [y + rows / 2 + apart_px / typical * across[0], x + columns / 2 + apart_px / typical * across[1]]
                thickness_mm = map_coordinates(stated_mm, at, order=1, mode="nearest")
            denser = 1.0 + on.get("composition_error", 0.0) / 100.0 if material in ("H2O", "Al") else 1.0
            depth = depth + denser * thickness_mm[..., None] * plain.attenuation_per_mm(material, energies)
        return np.exp(-depth)

    def blurred(
        self, signal: np.ndarray, variance: np.ndarray, far: bool, on: dict, exposure_ms: float
    ) -> tuple[np.ndarray, np.ndarray]:
        if "focal_spot" in on:
            magnified = self.of.detector_mm / (self.of.far_mm if far else self.of.near_mm) - 1.0
            width_px = on["focal_spot"] * magnified / self.of.pixel_mm
            if self._is("focal_spot", "two peaks"):
                places = np.array([-0.4, 0.4]) * width_px
            else:
                places = np.linspace(-0.5, 0.5, 15) * width_px

            def spot(image: np.ndarray) -> np.ndarray:
                along = np.mean([shift(image, (0.0, place), order=1, mode="nearest") for place in places], axis=0)
                return gaussian_filter(along, (0.42 * width_px, 0.15 * width_px))

            signal, variance = spot(signal), spot(variance)
        if "off_focal" in on:
            signal, variance = (self._beside(one, far, on["off_focal"] / 100.0) for one in (signal, variance))
        if "crosstalk" in on:
            signal, variance = (self._hopped(one, on["crosstalk"] / 100.0) for one in (signal, variance))
        if "motion_blur" in on:
            time = np.linspace(0.0, 1.0, 25)
            course = np.sin(2.0 * math.pi * time) / 2.0 if self._is("motion_blur", "to and fro") else time**2 - 0.5
            places = course * on["motion_blur"] * exposure_ms / 50.0
            signal = np.mean([shift(signal, (place, 0.0), order=1, mode="nearest") for place in places], axis=0)
        return signal, variance

    def _beside(self, image: np.ndarray, far: bool, share: float) -> np.ndarray:
        """A picture with the shadows that points beside the focal spot throw."""
        magnified = self.of.detector_mm / (self.of.far_mm if far else self.of.near_mm) - 1.0
        reach_px = (3.0 + 5.0 * self.u["a"]) * magnified / self.of.pixel_mm
        steps = (np.arange(_SOURCE_POINTS) + 0.5) / _SOURCE_POINTS
        if self._is("off_focal", "ring"):
            turns = 2.0 * math.pi * steps
            places = reach_px * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        else:
            # the anode goes on to one side: ever fewer electrons strike it
            places = np.stack([-reach_px * np.log(steps), np.zeros(_SOURCE_POINTS)], axis=1)
        wide = np.mean([shift(image, place, order=1, mode="nearest") for place in places], axis=0)
        return (1.0 - share) * image + share * wide

    def _hopped(self, image: np.ndarray, share: float) -> np.ndarray:
        """A picture of which each pixel's neighbours count a share."""
        weights = np.zeros((3, 3))
        if self._is("crosstalk", "corners as well"):
            weights[1, ::2] = weights[::2, 1] = 0.19
            weights[::2, ::2] = 0.06
        else:
            weights[1, ::2], weights[::2, 1] = 0.4, 0.1
        wide = np.pad(image, 1, mode="edge")
        rows, columns = image.shape
        moved = sum(
            weights[down, right] * wide[down : down + rows, right : right + columns]
            for down in range(3)
            for right in range(3)
        )
        return (1.0 - share) * image + share * np.asarray(moved)

    def light(self, kV: float, mAs: float, copper_mm: float, scene: str, on: dict, exposure_ms: float) -> tuple:
        far_share = 0.3 + 0.5 * self.u["d"]
        held = {key: value for key, value in on.items() if key not in ("veiling_glare", "object_scatter")}
        signal, variance, remote = super().light(kV, mAs, copper_mm, scene, held, exposure_ms)
        if scene and "object_scatter" in on:
            energies, arriving = self.open_light(kV, mAs, copper_mm, held)
            open_DN, _ = self.signals(arriving, energies)
            source = signal * -np.log(np.clip(signal / open_DN, 1e-6, 1.0))
            added = on["object_scatter"] / 100.0 * self.scattered(source) / 0.38
            added = added * (far_share if scene.endswith("far") else 1.0)
            signal, variance = signal + added, variance * (1.0 + added / np.maximum(signal, 1e-9))
        if "veiling_glare" in on:
            share = on["veiling_glare"] / 100.0
            if self._is("veiling_glare", "one exponential"):
                spread = exponential(signal, (3.0 + 12.0 * self.u["a"]) / self.of.pixel_mm)
            else:
                wide = gaussian_filter(signal, (3.0 + 6.0 * self.u["a"]) / self.of.pixel_mm)
                spread = 0.6 * wide + 0.4 * float(signal.mean())
            signal = (1.0 - share) * signal + share * spread
        return signal, variance, remote

    def frames(self, count: int, kind: str, exposure_ms: float, after: bool, lit: tuple | None) -> np.ndarray:
        self.exposed_ms = exposure_ms
        shown = self._exposed(count, kind, exposure_ms, after, lit)
        if "random_telegraph" in self.on(after):
            shown = self._jumped(shown, self.on(after)["random_telegraph"] / 100.0)
        share = self.on(after).get("dropped_frames", 0.0) / 100.0
        if share and self._is("dropped_frames", "some in a row"):
            for number in np.flatnonzero(self.law.random(count - 1) < share / 3.0) + 1:
                shown[number : number + 3] = shown[number - 1]
        elif share:
            every = max(round(1.0 / share), 2)
            for number in range(int(self.law.integers(1, every + 1)), count, every):
                shown[number] = shown[number - 1]
        return shown

    def _jumped(self, shown: np.ndarray, share: float) -> np.ndarray:
        """Frames of which the same pixels jump between levels, some frames in each."""
        pixels = np.flatnonzero(self.jumpy < share)
        three = self._is("random_telegraph", "three levels")
        heights = 7.0 if three else 2.0 + 6.0 * -np.log(np.maximum(self.jumpy.flat[pixels] / share, 1e-6))
        level = self.law.integers(0, 3 if three else 2, len(pixels)).astype(float)
        out = shown.astype(float)
        for frame in out:
            frame.flat[pixels] += np.round(self.of.read_DN * heights * level)
            moves = self.law.random(len(pixels)) < 1.0 / (4.0 + 8.0 * self.u["a"])
            level = np.where(moves, self.law.integers(0, 3, len(pixels)) if three else 1.0 - level, level)
        return np.clip(out, 0, self.of.highest_DN).astype(np.uint16)

    def _exposed(self, count: int, kind: str, exposure_ms: float, after: bool, lit: tuple | None) -> np.ndarray:
        on = self.on(after)
        if not set(on) & {"image_lag", "quantisation", "dark_drift", "row_noise"} and "image_lag" not in self.effects:
            return super().frames(count, kind, exposure_ms, after, lit)
        shape, of = self.of.shape, self.of
        if self._is("image_lag", "power law"):
            lives_s = np.geomspace(0.1, 60.0, 7)
            shares = lives_s ** -(0.2 + 0.5 * self.u["a"])
        else:
            lives_s = np.array([0.2 + 0.8 * self.u["a"], 5.0 + 20.0 * self.u["b"]])
            shares = np.array([0.7, 0.3])
        shares = shares / shares.sum()
        if not hasattr(self, "traps"):
            self.traps = np.zeros((len(lives_s), *shape))
        pause = np.exp(-of.pause_s / lives_s)
        if kind != "afterglow":
            self.traps *= pause[:, None, None]
        step_s = (exposure_ms + of.readout_ms) / 1000.0
        out = 1.0 - np.exp(-step_s / lives_s)
        # of the charge that is trapped so much comes back in the next frame
        strength = self.effects.get("image_lag", 0.0) / 100.0
        lag = strength if not self.families.get("image_lag") else strength / max(float(shares @ out), 1e-3) * 0.25
        shown = []
        for _ in range(count):
            level = np.zeros(shape) if lit is None else self._exposure(*lit, on, after)
            freed = np.tensordot(out, self.traps, axes=1)
            self.traps += shares[:, None, None] * lag * level - out[:, None, None] * self.traps
            level = level * (1.0 - lag) + freed if "image_lag" in on else level
            level = level + self.dark_DN + (0.0 if of.counting else plain.DARK_SLOPE_DN_PER_MS) * exposure_ms
            level = level + self._dark_course(on, exposure_ms)
            level = level + of.read_DN * self.law.standard_normal(shape)
            rows = on.get("row_noise", 0.0)
            if rows:
                lines = self.law.standard_normal((shape[0], 1))
                if self._is("row_noise", "bands of rows"):
                    lines = gaussian_filter1d(lines, 0.8, axis=0)
                    lines = lines / lines.std()
                else:
                    lines = 0.8 * lines + 0.6 * self.law.standard_normal((1, shape[1]))
                level = level + of.read_DN * rows * lines
            step = on.get("quantisation", 1.0)
            shown.append(np.clip(np.round(level / step) * step, 0, of.highest_DN))
            self.taken += 1
        return np.array(shown, dtype=np.uint16)

    def _dark_course(self, on: dict, exposure_ms: float) -> np.ndarray | float:
        if "dark_drift" not in on:
            return 0.0
        level = on["dark_drift"] * exposure_ms / 160.0
        if self._is("dark_drift", "stronger at one side"):
            return np.broadcast_to(level * (0.5 + np.arange(self.of.shape[1]) / self.of.shape[1]), self.of.shape)
        return level * min(1.0, 0.4 + 0.002 * self.taken)

    def _exposure(
        self, signal: np.ndarray, variance: np.ndarray, remote: tuple | None, on: dict, after: bool
    ) -> np.ndarray:
        held = {key: value for key, value in on.items() if key not in ("nonlinearity", "output_drift", "mtf_tail")}
        if "excess_noise" in held:
            top = float(signal.max())
            held["excess_noise"] = on["excess_noise"] * float(0.5 + 0.5 * signal.mean() / max(top, 1e-9))
        gain = self.gain * (self.changed_gain if after else 1.0)
        level = super()._exposure(signal, variance, remote, held, after) / np.where(gain > 0, gain, 1.0)
        if "mtf_tail" in on:
            share = on["mtf_tail"] / 100.0
            if self._is("mtf_tail", "exponential"):
                spread = exponential(level, 1.0 + 3.0 * self.u["a"])
            else:
                spread = 0.5 * gaussian_filter(level, 1.5) + 0.5 * gaussian_filter(level, 4.0 + 3.0 * self.u["a"])
            level = (1.0 - share) * level + share * spread
        if "nonlinearity" in on:
            level = self._bent(level, on["nonlinearity"] / 100.0)
        level = level * gain
        if "burn_in" in on:
            level = self._burnt(level, on["burn_in"] / 100.0)
        if "pile_up" in on:
            level = self._piled(
                level, signal * gain, signal * self.slow_pixels * on["pile_up"] * 1e-6 / self.exposed_ms
            )
        if "output_drift" in on:
            size = on["output_drift"] / 100.0
            if self._is("output_drift", "random walk"):
                self.walk = 0.98 * self.walk + 0.2 * self.law.standard_normal()
            else:
                self.walk += 0.012
            level = level * (1.0 + size * (self.walk if self._is("output_drift", "random walk") else self.walk - 1.5))
        if "line_flicker" in on:
            level = level * (1.0 + on["line_flicker"] / 100.0 * self._flickering())
        return np.asarray(level)

    def _flickering(self) -> np.ndarray:
        """Factors of the lines of one exposure, mean square 1: (row, 1) or (1, column)."""
        rows, columns = self.of.shape
        if self._is("line_flicker", "columns"):
            return self.law.standard_normal((1, columns))
        if self._is("line_flicker", "bands of rows"):
            lines = gaussian_filter1d(self.law.standard_normal(rows), 1.5, mode="wrap")
            return (lines / lines.std())[:, None]
        cycles_a_line = 0.02 + 0.2 * self.u["a"]
        phase = self.law.uniform(0.0, 2.0 * math.pi)
        return math.sqrt(2.0) * np.sin(2.0 * math.pi * cycles_a_line * np.arange(rows) + phase)[:, None]

    def _piled(self, level: np.ndarray, mean: np.ndarray, photons: np.ndarray) -> np.ndarray:
        """Counts (row, column) of which each photon prolongs the dead time, `photons` of which come in one.

        Of n photons n exp(-photons) are counted, with the variance n exp(-photons) (1 - 2 photons exp(-photons)).
        """
        left = np.exp(-photons)
        return left * mean + np.sqrt(left * np.maximum(1.0 - 2.0 * photons * left, 0.0)) * (level - mean)

    def _burnt(self, level: np.ndarray, share: float) -> np.ndarray:
        """A frame (row, column) of a screen that the light before has made brighter, by `share` after 100 full frames."""
        age_s = 0.1 * (len(self.seen) - np.arange(len(self.seen)))
        if self._is("burn_in", "fades as a power of time"):
            left = (1.0 + age_s / 30.0) ** -0.4
        else:
            left = 0.4 * np.exp(-age_s / 60.0) + 0.6
        before = np.tensordot(left, np.array(self.seen), axes=1) if self.seen else np.zeros_like(level)
        self.seen.append(level / self.of.highest_DN)
        return level * (1.0 + share * before / 100.0)

    def _bent(self, level: np.ndarray, departure: float) -> np.ndarray:
        """`departure` from a line at half of the highest level."""
        at = level / (0.5 * self.of.highest_DN)
        if self._is("nonlinearity", "cubic"):
            return level * (1.0 - departure * at**2)
        if self._is("nonlinearity", "kinked"):
            knee = 0.2 + 0.3 * self.u["a"]
            return level * (1.0 - departure * np.maximum(at - knee, 0.0) / (1.0 - knee))
        return level * (1.0 - departure * np.sqrt(np.maximum(at, 0.0)))


def effects_of(line: str) -> list[str]:
    """Effects of which a line can have a law of a drawn family."""
    counting = plain.LINES[line].counting
    added = [one for one in ADDED if one not in (("random_telegraph", "burn_in") if counting else ("pile_up",))]
    return [one for one in plain.cases_of(plain.LINES[line]) if one in FAMILIES and one not in ADDED] + added


STRONGER = {
    "quantisation": 48.0,
    "focal_spot": 1.0,
    "mtf_tail": 20.0,
    "misregistration": 0.8,
    "motion_blur": 3.0,
    "excess_noise": 30.0,
}
MOST = {"k_fluorescence": 60.0}  # a share of all photons above the K edge


def clear_strength(effect: str, rng: np.random.Generator) -> float:
    """A strength (unit of the catalogue) that the plain simulator's lines show clearly, spread over a factor of three."""
    usual = ADDED[effect] if effect in ADDED else STRONGER.get(effect, plain.CASES[effect][0] * 1.5)
    return min(float(f"{usual * math.exp(rng.uniform(-0.35, 0.75)):.3g}"), MOST.get(effect, math.inf))


# calibration takes these in, or a session like these hardly shows them: they are no half of a clear pair
HARDLY_SHOWN = ("mtf_tail", "crosstalk", "composition_error", "k_fluorescence")


def pairs_of(line: str, count: int, seed: int) -> list[tuple[str, ...]]:
    """Pairs of a line's effects, drawn."""
    rng = np.random.default_rng([seed, zlib.crc32(line.encode())])
    shown = [effect for effect in effects_of(line) if effect not in HARDLY_SHOWN]
    return [tuple(sorted(map(str, rng.choice(shown, 2, replace=False)))) for _ in range(count)]


def judged(line: str, effects: Sequence[str], seed: int, frames: int) -> dict:
    """What is planted in one session, and what the diagnosis says of it."""
    case = "+".join(effects)
    rng = np.random.default_rng([seed, zlib.crc32((line + case).encode())])
    strengths = {effect: clear_strength(effect, rng) for effect in effects}
    families: dict[str, str] = {}

    class Drawn(FamilyLine):
        def __init__(self, *given) -> None:
            super().__init__(*given)
            families.update(self.families)

    with (
        tempfile.TemporaryDirectory() as folder,
        patch.dict(plain.CASES, {effect: (strength, True) for effect, strength in strengths.items()}),
    ):
        path = Path(folder) / "session.h5"
        plain.make_session(path, line, case, rng, frames, Drawn)
        with open_acquisition(path) as acquisition:
            found = diagnose(acquisition, rng=np.random.default_rng(0))
    return {
        "effects": list(effects),
        "families": {effect: families[effect] for effect in effects},
        "strengths": strengths,
        "verdict": found.verdict,
        "named": list(found.named),
        "causes": {item.effect: [item.probability, *item.strength] for item in found.causes},
    }


def main() -> None:
    """Diagnose sessions of drawn families and print a row each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print the families")
    parser.add_argument("--line", choices=list(plain.LINES), default="usual")
    parser.add_argument("--only", nargs="+", choices=sorted(FAMILIES), default=list(FAMILIES), metavar="EFFECT")
    parser.add_argument(
        "--pairs", type=int, metavar="N", help="so many pairs of effects, drawn, in place of single ones"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.list:
        for effect, families in FAMILIES.items():
            print(f"{effect:18s} {'; '.join(families)}")
        return
    possible = set(effects_of(options.line))
    cases: list[tuple[str, ...]] = [(one,) for one in options.only if one in possible]
    if options.pairs:
        cases = pairs_of(options.line, options.pairs, options.seed)
    rows = []
    for effects in cases:
        row = judged(options.line, effects, options.seed, options.frames)
        rows.append(row)
        planted = ", ".join(
            f"{effect} {row['strengths'][effect]:.3g} ({row['families'][effect]})" for effect in effects
        )
        print(f"{planted:90s} {', '.join(row['named']) or row['verdict']}", flush=True)
    right = sum(sorted(row["named"]) == row["effects"] for row in rows)
    print(f"{right} of {len(rows)} named rightly, and nothing else")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()

"""Calibration of panels that the virtual lab does not draw: what is given, and whether the truth lies inside.

Nothing in the simulation is raytwin's. Spectra are SpekPy's (`kqp`), attenuation is xraylib's; quanta are Poisson numbers times the
gain of the beam, so that their first two moments are right and no more. Frames of 128 x 128 px, 20 a series; darks, flats of three
voltages at four currents, two more currents and a fourth voltage held back. Numbers without a source describe the panels; they are
choices.

    python validation/other_panels.py
    python validation/other_panels.py --cases lag,flicker --seed 7
"""

import argparse
import contextlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import h5py
import numpy as np
import spekpy
import xraylib
from scipy.ndimage import gaussian_filter

import raytwin as rt
from raytwin.errors import RaytwinError

SHAPE, FRAMES = (128, 128), 20
PIXEL_mm, DISTANCE_mm, EXPOSURE_ms = 0.15, 1000.0, 100.0
DARK_DN, DN_PER_keV, SWANK = 400.0, 0.09, 0.9
SPREAD_px = 0.6
CALIBRATING_kV, HELD_BACK_kV = (50.0, 80.0, 110.0), 65.0
CALIBRATING_mA, HELD_BACK_mA = (0.5, 1.0, 2.0, 4.0), (0.75, 3.0)


@lru_cache(maxsize=8)
def beam(kV: float) -> tuple[float, float, float]:
    """Photons that a pixel absorbs a mAs, behind 2 mm Al, and sums of their energies (keV) and squares of these."""
    energy, fluence = spekpy.Spek(kvp=kV, th=12, physics="kqp", dk=0.5, z=100, mas=1).get_spectrum(edges=False)
    aluminium = np.exp([-xraylib.CS_Total(13, float(one)) * 2.699 * 0.2 for one in energy])
    absorbed = -np.expm1([-xraylib.CS_Total_CP("CsI", float(one)) * 4.51 * 0.85 * 0.05 for one in energy])
    photons = fluence * 0.5 * aluminium * absorbed * (PIXEL_mm / 10) ** 2
    return float(photons.sum()), float(photons @ energy), float(photons @ energy**2)


@dataclass(frozen=True, kw_only=True)
class Panel:
    """What differs from a plain panel.

    Fields: on_light: frames (frame, row, column) of light, DN, with a generator; on_frames: the same with dark and electronic noise;
    read_DN; averaged: exposures a frame; dark_DN_per_ms with its shot noise (gain of 1 DN); electron_DN: what one of few electrons
    gives, 0: there are many; currents_mA: of the calibrating flats.
    """

    on_light: Callable[[np.ndarray, np.random.Generator], np.ndarray] = lambda light, _: light
    on_frames: Callable[[np.ndarray, np.random.Generator], np.ndarray] = lambda frames, _: frames
    read_DN: float = 8.0
    averaged: int = 1
    dark_DN_per_ms: float = 0.0
    electron_DN: float = 0.0
    currents_mA: tuple[float, ...] = CALIBRATING_mA


def recursive(share: float) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
    """Each frame holds a share of what was shown before."""

    def filtered(frames: np.ndarray, _: np.random.Generator) -> np.ndarray:
        shown = []
        state = frames[-1]
        for frame in (*frames, *frames):  # as if it had run before
            state = share * state + (1 - share) * frame
            shown.append(state)
        return np.array(shown[len(frames) :])

    return filtered


def flickering(rms: float, *shape: int) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
    """Factors that a frame (shape 1, 1) or a row (-1, 1) shares."""

    def changed(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        drawn = [len(light), *(light.shape[axis + 1] if side < 0 else side for axis, side in enumerate(shape))]
        return light * (1 + rms * rng.standard_normal(drawn))

    return changed


def wandering(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A gradient along rows and columns, 0.5 % rms over the field, anew in each frame."""
    slopes = 0.005 * np.sqrt(12) * rng.standard_normal((2, len(light), 1, 1)) / np.sqrt(2)
    down, right = np.meshgrid(*(np.linspace(-0.5, 0.5, side) for side in SHAPE), indexing="ij")
    return light * (1 + slopes[0] * down + slopes[1] * right)


def shaded(light: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """A level that falls by 30 % over the rows, most at the end."""
    return light * (1 - 0.3 * np.linspace(0, 1, SHAPE[0]) ** 3)[:, None]


def bent(frames: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """A response that has lost 3 % at 60,000 DN."""
    signal = frames - DARK_DN
    return frames - 0.03 * signal * np.abs(signal) / 60000.0


def in_patches(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Half of the electronic noise is common to patches of some 2 px."""
    smooth = gaussian_filter(rng.standard_normal(frames.shape), (0, 1, 1), mode="wrap")
    return frames + 12.0 / np.sqrt(2) * smooth / smooth.std()


CASES = {
    "plain": Panel(),
    "recursive_0.05": Panel(on_frames=recursive(0.05)),
    "recursive_0.7": Panel(on_frames=recursive(0.7)),
    "flicker": Panel(on_light=flickering(0.02, 1, 1)),
    "flicker_of_rows": Panel(on_light=flickering(0.01, -1, 1)),
    "wandering": Panel(on_light=wandering),
    "shaded": Panel(on_light=shaded),
    "means_of_64": Panel(averaged=64),
    "means_of_4": Panel(averaged=4, read_DN=1.5),
    "dim": Panel(read_DN=12.0, currents_mA=(0.02, 0.05, 0.1, 0.2)),
    "dark_current": Panel(dark_DN_per_ms=0.1),
    "bent": Panel(on_frames=bent),
    "few_electrons": Panel(electron_DN=2.3),  # two a photon at 80 kV
    "noise_in_patches": Panel(read_DN=12.0 / np.sqrt(2), on_frames=in_patches),
}


class Lab:
    """Frames of a panel, and the file of its session."""

    def __init__(self, panel: Panel, rng: np.random.Generator) -> None:
        self.panel, self.rng = panel, rng
        self.offset_DN = DARK_DN + rng.uniform(-0.5, 0.5, SHAPE)

    def frames(self, kV: float | None, current_mA: float) -> np.ndarray:
        """Whole numbers (frame, row, column), of a dark without kV."""
        panel, rng, count = self.panel, self.rng, self.panel.averaged
        light = np.zeros((FRAMES, *SHAPE))
        if kV is not None:
            _, energy, squares = beam(kV)
            gain = DN_PER_keV * squares / energy / SWANK
            mean = DN_PER_keV * energy * current_mA * EXPOSURE_ms / 1000
            light = gain / count * rng.poisson(mean * count / gain, light.shape)
            light = panel.on_light(gaussian_filter(light, (0, SPREAD_px, SPREAD_px), mode="wrap"), rng)
            if panel.electron_DN > 0:
                light = panel.electron_DN / count * rng.poisson(np.maximum(light, 0) * count / panel.electron_DN)
        dark = panel.dark_DN_per_ms * EXPOSURE_ms
        noise = np.sqrt((panel.read_DN**2 + 1 / 12 * (count > 1) + dark) / count) * rng.standard_normal(light.shape)
        return np.clip(np.rint(panel.on_frames(light + self.offset_DN + dark + noise, rng)), 0, 65535)

    def write(self, path: Path) -> None:
        """The session."""
        with h5py.File(path, "w") as file:
            file.attrs.update({"format": "raytwin-acquisition", "version": 1})
            file.create_group("instrument").attrs.update({
                "anode": "W", "anode_angle_deg": 12.0, "source_detector_mm": DISTANCE_mm, "source_object_mm": 940.0,
                "pixel_mm": PIXEL_mm, "scintillator": "CsI:0.5", "bits": 16,
            })  # fmt: skip
            shots = [("dark", None, 0.0, "calibration")]
            shots += [("flat", kV, one, "calibration") for kV in CALIBRATING_kV for one in self.panel.currents_mA]
            shots += [("flat", kV, one, "evaluation") for kV in (*CALIBRATING_kV, HELD_BACK_kV) for one in HELD_BACK_mA]
            for number, (kind, kV, current_mA, role) in enumerate([*shots, ("dark", None, 0.0, "calibration")]):
                group = file.create_group(f"series/{number:02d}")
                group.attrs.update({"index": number, "kind": kind, "exposure_ms": EXPOSURE_ms, "role": role})
                group.attrs["averaged"] = self.panel.averaged
                if kV is not None:
                    group.attrs.update({"kV": kV, "current_mA": current_mA, "filter": "Al:2"})
                group.create_dataset("frames", data=self.frames(kV, current_mA).astype(np.uint16))


def judged(name: str, seed: int, folder: Path) -> str:
    """Gains, read noise and held-back flats inside their intervals, and by how many half widths the worst gain is off."""
    path, panel = folder / f"{name}.h5", CASES[name]
    Lab(panel, np.random.default_rng(seed)).write(path)
    try:
        twin = rt.calibrate(path, seed=seed)
    except RaytwinError as error:
        return f"refused: {error}"
    found = twin.to_dict()
    off = []
    for level in found["levels"]:
        _, energy, squares = beam(level["kV"])
        half = (level["gain_DN_high"] - level["gain_DN_low"]) / 2
        off.append((level["gain_DN"] - DN_PER_keV * squares / energy / SWANK - panel.electron_DN) / half)
    width = half / level["gain_DN"]
    truth = {"noise_in_patches": 12.0}.get(name, panel.read_DN)
    read = found["read_noise_DN"]
    text = f"worst gain {max(off, key=abs):+.1f} half widths of {100 * width:.1f} %; read noise {read['value']:.4g}"
    text += f" ({read['low']:.4g} to {read['high']:.4g}) of {truth:.4g} DN"
    load = {"current_mA": 1.0, "exposure_ms": EXPOSURE_ms}
    photons = rt.predict(twin, kV=80.0, filter="Al:2", **load).to_dict()["photons_absorbed"]
    text += f"; {photons['value']:.0f} photons ({photons['low']:.0f} to {photons['high']:.0f})"
    text += f" of {beam(80.0)[0] * EXPOSURE_ms / 1000:.0f}"
    share = rt.validate(twin, path).to_dict()["coverage"]
    return f"{text}; held back inside: means {100 * share['mean']:.0f} %, noise {100 * share['sd']:.0f} % of {share['rows']}"


def run() -> None:
    """A line a case on the terminal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="joined by commas (default all)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in options.cases.split(","):
            if name not in CASES:
                parser.error(f"{name}: there are {', '.join(CASES)}")
            print(f"{name:18s} {judged(name, options.seed, Path(folder))}", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        run()

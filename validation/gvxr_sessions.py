"""Diagnoses of sessions whose objects gVirtualXRay traces: meshes in a cone of rays, one effect each, two, and none.

gVirtualXRay (PyPI `gvxr`; Vidal and others) gives path lengths through triangle meshes from a point source to the middle of each
pixel, where other validations shift and blur pictures: here a focal spot is many sources, an object that moves or lies elsewhere
is traced again where it is, and what lies nearer to the source is larger. Spectra, panel, noise, labels and the other effects are
those of `second_simulator.py`, which this script drives.

    pip install gvxr
    python validation/gvxr_sessions.py --line curved
    python validation/gvxr_sessions.py --line points --only none focal_spot

Without a display it draws on a software renderer (Mesa's EGL, `EGL_PLATFORM=surfaceless`). The script ends with exit code 0 and
the reason where gvxr is not installed or cannot draw.
"""

import argparse
import contextlib
import math
import os
from pathlib import Path

import numpy as np
import second_simulator as plain

_FIELDS = {
    "near_mm": 420.0,
    "far_mm": 300.0,
    "detector_mm": 700.0,
    "read_DN": 5.0,
    "dark_DN": 400.0,
    "bits": 16,
    "photons": 7e-4,
    "scintillator": ("CsI", 0.4),
    "edge_keV": 34.5,
    "line_keV": 29.5,
    "lag_s": 0.4,
    "pause_s": 8.0,
    "readout_ms": 10.0,
    "copper_times": 1.5,
    "anode_deg": 14.0,
    "beryllium_mm": 1.0,
    "wedge_mm": 2.0,
    "water_mm": 30.0,
    "lead_mm": 2.0,
}
# curved: light spreads as in most panels; points: pixels see no farther than the ray to their middle; areas: and those to nine
# places in them, of which both picture and thickness maps are means
LINES = {
    "curved": plain.LineOf(
        **_FIELDS,
        shape=(112, 128),
        pixel_mm=0.2,
        spread_px=0.6,
        DN_per_keV=0.022,
        current_mA={60.0: 4.0, 110.0: 1.2},
    ),
    "points": plain.LineOf(
        **_FIELDS,
        shape=(128, 112),
        pixel_mm=0.3,
        spread_px=0.0,
        DN_per_keV=0.022,
        current_mA={50.0: 6.0, 90.0: 2.0},
    ),
}
LINES["areas"] = LINES["points"]
RAYS = {"areas": 3}  # along each side of a pixel
SPOTS = 7  # sources along each side of a focal spot, over 2.4 standard deviations either way
PLACES = 9  # of an object that moves
_RINGS = 240  # of round meshes: their facets stray from the round by 1e-4 of the radius
_FINE_MM = 1e-9


def renderer():
    """gVirtualXRay ready to draw, or None and the reason."""
    os.environ.setdefault("EGL_PLATFORM", "surfaceless")
    os.environ.setdefault("LIBGL_ALWAYS_SOFTWARE", "1")
    try:
        from gvxrPython3 import gvxr
    except ImportError as error:
        return None, f"gvxr is not installed or cannot be loaded ({error}); pip install gvxr"
    gvxr.createWindow(-1, 0, "EGL")
    gvxr.usePointSource()
    gvxr.setMonoChromaticPerPixelAtSDD(60.0, "keV", 1.0)  # path lengths are all that is asked for, but it wants a beam
    return gvxr, ""


class TracedLine(plain.Line):
    """A line whose objects are meshes about the origin, between a source at negative and a panel at positive x."""

    gvxr = None
    _traced: dict = {}  # noqa: RUF012  by line, scene and pose: path lengths that every session of a run shares
    _meshes: dict = {}  # noqa: RUF012

    def __init__(self, name, effects, rng):
        self.rays = RAYS.get(name, 1)
        super().__init__(name, effects, rng)

    def placed(self):
        """Kind and path lengths, mm, of each scene where it should lie."""
        kinds = {"wedge": "wedge", "slab": "slab", "edge": "edge", "product": "product"}
        if self.name not in self._meshes:
            self._meshes[self.name] = self._made()
        found = {}
        for scene in self._meshes[self.name]:
            lengths = self._lengths(scene, (0.0, 0.0), (0.0, 0.0))
            found[scene] = (
                kinds[scene.rstrip("0123456789").split("_")[0]],
                {material: self._means(each) for material, each in lengths.items()},
            )
        return found

    def _means(self, rays):
        """Means over the rays of each pixel (row, column, ...)."""
        rows, columns = self.of.shape
        return rays.reshape(rows, self.rays, columns, self.rays, *rays.shape[2:]).mean(axis=(1, 3))

    def _made(self):
        """Meshes of each scene by material; sizes are those that fill the field at the scene's distance."""
        gvxr, of = self.gvxr, self.of
        made = {}

        def add(scene, material, shape, sizes, at=(0.0, 0.0, 0.0), turn_deg=0.0):
            label = f"{self.name}/{scene}/{len(made.get(scene, {}).get(material, []))}/{material}"
            getattr(gvxr, shape)(label, *sizes, "mm")
            if turn_deg:
                gvxr.rotateNode(label, turn_deg, 1.0, 0.0, 0.0)
                gvxr.applyCurrentLocalTransformation(label)
            gvxr.translateNode(label, *at, "mm")
            gvxr.applyCurrentLocalTransformation(label)
            gvxr.setElement(label, "Al")  # of no consequence for path lengths
            gvxr.addPolygonMeshAsInnerSurface(label)
            made.setdefault(scene, {}).setdefault(material, []).append(label)

        for place, distance_mm in (("near", of.near_mm), ("far", of.far_mm)):
            high, wide = (count * of.pixel_mm * distance_mm / of.detector_mm for count in of.shape)
            add(f"slab_{place}", "H2O", "makeCuboid", (of.water_mm, 2.0 * wide, 2.0 * high))
            add(f"edge_{place}", "Pb", "makeCuboid", (of.lead_mm, wide, 2.0 * high), (0.0, 0.52 * wide, 0.0), 3.4)
        high, wide = (count * of.pixel_mm * of.near_mm / of.detector_mm for count in of.shape)
        step_mm = wide / 8.0
        for step in range(1, 8):
            size = (step * of.wedge_mm, step_mm - _FINE_MM, 0.7 * high)
            add("wedge", "Al", "makeCuboid", size, (0.0, (step - 3.5) * step_mm, 0.0))
        radius_mm = 0.3 * min(high, wide)
        add("product1", "H2O", "makeSphere", (_RINGS, _RINGS, radius_mm), (0.0, -0.05 * wide, 0.02 * high))
        add(
            "product2", "H2O", "makeCylinder", (_RINGS, 1.1 * radius_mm, 0.9 * radius_mm), (0.0, 0.06 * wide, 0.0), 25.0
        )
        add("product3", "H2O", "makeSphere", (_RINGS, _RINGS, radius_mm), (0.0, 0.1 * wide, 0.0))
        small_mm = 0.12 * min(high, wide)
        add("product3", "Al", "makeSphere", (_RINGS, _RINGS, small_mm), (0.0, -0.34 * wide, 0.2 * high))
        return made

    def _lengths(self, scene, object_mm, source_mm):
        """Path lengths of all rays (row, column), mm, by material; places across the beam, mm, of scene and source, (y, z)."""
        key = (self.name, scene, object_mm, source_mm)
        if key not in self._traced:
            gvxr, of = self.gvxr, self.of
            distance_mm = of.far_mm if scene.endswith("far") else of.near_mm
            (right, up), (y, z) = object_mm, source_mm
            # the scene stays where it is, and the line moves the other way
            gvxr.setSourcePosition(-distance_mm, y - right, z - up, "mm")
            gvxr.setDetectorPosition(of.detector_mm - distance_mm, -right, -up, "mm")
            gvxr.setDetectorUpVector(0, 0, -1)
            gvxr.setDetectorNumberOfPixels(self.rays * of.shape[1], self.rays * of.shape[0])
            gvxr.setDetectorPixelSize(of.pixel_mm / self.rays, of.pixel_mm / self.rays, "mm")
            self._traced[key] = {
                material: sum(10.0 * np.array(gvxr.computeLBuffer(label), dtype=np.float64) for label in labels)
                for material, labels in self._meshes[self.name][scene].items()
            }
        return self._traced[key]

    def transmitted(self, scene, energies, on, exposure_ms):
        """Share of the photons that gets through, on average over sources and places of the scene."""
        of = self.of
        distance_mm = of.far_mm if scene.endswith("far") else of.near_mm
        pixel_mm = of.pixel_mm * distance_mm / of.detector_mm  # at the scene
        sources = [(0.0, 0.0, 1.0)]
        if "focal_spot" in on:
            sd_mm = on["focal_spot"] / math.sqrt(8.0 * math.log(2.0))
            at = np.linspace(-2.4, 2.4, SPOTS)
            weight = np.exp(-0.5 * at**2)
            weight /= weight.sum()
            at = at * sd_mm / math.sqrt(float(weight @ at**2))  # as wide as the spot although it ends
            sources = [(a, b, p * q) for a, p in zip(at, weight, strict=True) for b, q in zip(at, weight, strict=True)]
        apart_mm = on.get("misregistration", 0.0) * pixel_mm
        across, along = apart_mm * math.sin(self.direction), -apart_mm * math.cos(self.direction)
        moves = [0.0]
        if "motion_blur" in on:
            moves = list(np.linspace(-0.5, 0.5, PLACES) * on["motion_blur"] * exposure_ms / 50.0 * pixel_mm)
        denser = {"H2O": 1.0 + on.get("composition_error", 0.0) / 100.0}
        attenuation = {
            material: denser.get(material, 1.0) * plain.attenuation_per_mm(material, energies)
            for material in self.scenes[scene][1]
        }
        result = 0.0
        for y, z, share in sources:
            for move in moves:
                lengths = self._lengths(scene, (across, along - move), (y, z))
                depth = sum(lengths[material][..., None] * per_mm for material, per_mm in attenuation.items())
                result = result + share / len(moves) * self._means(np.exp(-depth))
        return result

    def blurred(self, signal, variance, far, on, exposure_ms):
        """As it is: what focal spot and motion do is traced."""
        return signal, variance


def run() -> None:
    """The table on the terminal, and the rows as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--line", choices=list(LINES), default="curved", help="which line (default curved)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=12, help="of a series (default 12)")
    parser.add_argument("--only", nargs="+", choices=[*sorted(plain.CASES), *plain.PAIRS], metavar="EFFECT")
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args()
    gvxr, reason = renderer()
    if gvxr is None:
        print(f"nothing compared: {reason}")
        return
    TracedLine.gvxr = gvxr
    plain.LINES[options.line] = LINES[options.line]
    cases = options.only or plain.cases_of(LINES[options.line])
    plain.run_cases(options.line, cases, options.seed, options.frames, options.json, TracedLine)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        run()

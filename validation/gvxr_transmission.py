"""Transmission of step wedges and of a two-material slab against gVirtualXRay's ray tracing.

    python validation/gvxr_transmission.py [--json FILE]

gVirtualXRay (PyPI `gvxr`; Vidal and others) traces rays through triangle meshes on OpenGL; it runs without a display on
EGL, software rendering included. Both get the same spectra, densities and compositions; the detector takes all the energy
that reaches it. Path lengths, the coefficients of mixtures and the sum over energies are compared:

    T = sum(E N exp(-sum mu t)) / sum(E N)

gVirtualXRay reads xraylib's tables as raytwin does, so this says nothing of the tables.

The script ends with exit code 0 and the reason where gvxr is not installed or cannot draw, and with 1 where a
transmission differs by more than 0.5 %.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytwin.acquisition.setting import Filter, filters_from_text
from raytwin.materials import material_from_name, transmission
from raytwin.spectra import Spectrum, tube_spectrum

LIBRARIES = (
    "its wheel wants the system's X and EGL libraries, on Debian libxcb-res0 libxcb-ewmh2 libxcb-composite0"
    " libxcb-xinerama0 libegl1 libgl1 libglu1-mesa libgl1-mesa-dri"
)
BEAMS = ((40.0, "Al:1+Cu:0.05"), (60.0, "Al:2"), (90.0, "Al:1+Cu:0.05"), (150.0, "Al:1+Cu:0.5"))
# each line of a wedge: layers one behind the other, in the order of the beam
OBJECTS: dict[str, tuple[tuple[Filter, ...], ...]] = {
    "aluminium wedge": tuple(filters_from_text(f"Al:{mm}") for mm in (1, 2, 4, 8, 12)),
    "PMMA wedge": tuple(filters_from_text(f"pmma:{mm}") for mm in (5, 10, 20, 40, 60)),
    "PMMA and aluminium": tuple(filters_from_text(f"pmma:20+Al:{mm}") for mm in (1, 5)),
    "water and bone": tuple(filters_from_text(f"water_liquid:{mm}+bone_cortical_icru44:2") for mm in (10, 30)),
}
LARGEST_DIFFERENCE = 0.005
STEP_MM = 8.0
PIXEL_MM = 0.5
LOWEST_KEV = 5.0


def expected_transmission(spectrum: Spectrum, layers: tuple[Filter, ...]) -> float:
    """Share of the beam's energy that the layers let through; no unit."""
    used = spectrum.energies_keV >= LOWEST_KEV
    energy = (spectrum.energies_keV * spectrum.fluence)[used]
    return float(energy @ transmission(layers, spectrum.energies_keV[used]) / energy.sum())


def _declare(gvxr: Any, name: str, layer: Filter) -> None:
    material = material_from_name(layer.material)
    if len(material.mass_fractions) == 1:
        gvxr.setElement(name, next(iter(material.mass_fractions)))
    else:
        gvxr.setMixture(name, list(material.mass_fractions), list(material.mass_fractions.values()))
    gvxr.setDensity(name, material.density_g_cm3, "g/cm3")


def _place(gvxr: Any, lines: tuple[tuple[Filter, ...], ...]) -> None:
    """Cuboids for every layer of every step: steps side by side along y, layers one behind the other along x."""
    gvxr.removePolygonMeshesFromXRayRenderer()
    for row, layers in enumerate(lines):
        x_mm = -60.0
        for number, layer in enumerate(layers):
            name = f"step{row}_layer{number}"
            gvxr.makeCuboid(name, layer.thickness_mm, STEP_MM, STEP_MM, "mm")
            gvxr.translateNode(
                name, x_mm + 0.5 * layer.thickness_mm, (row - 0.5 * (len(lines) - 1)) * STEP_MM, 0.0, "mm"
            )
            gvxr.applyCurrentLocalTransformation(name)
            x_mm += layer.thickness_mm + 1.0
            _declare(gvxr, name, layer)
            gvxr.addPolygonMeshAsInnerSurface(name)


def traced_transmissions(gvxr: Any, spectrum: Spectrum, lines: tuple[tuple[Filter, ...], ...]) -> NDArray[np.float64]:
    """gVirtualXRay's transmission in the middle of each step (step,)."""
    gvxr.resetBeamSpectrum()
    heights = spectrum.fluence / spectrum.fluence.max() * 1e4
    for energy, height in zip(spectrum.energies_keV, heights, strict=True):
        if energy >= LOWEST_KEV and height > 0:
            gvxr.addEnergyBinToSpectrumPerPixelAtSDD(float(energy), "keV", float(height))
    _place(gvxr, lines)
    image = np.array(gvxr.computeXRayImage(), dtype=np.float64)
    open_beam = float(gvxr.getTotalEnergyWithDetectorResponse())
    rows, columns = image.shape
    centre = rows // 2
    found = []
    for step in range(len(lines)):
        middle = 0.5 * columns + (step - 0.5 * (len(lines) - 1)) * STEP_MM / PIXEL_MM
        inside = image[centre - 2 : centre + 2, int(middle) - 2 : int(middle) + 2]
        found.append(float(inside.mean()) / open_beam)
    return np.array(found)


def _renderer() -> tuple[Any, str]:
    """gVirtualXRay ready to draw, or None and the reason."""
    try:
        from gvxrPython3 import gvxr
    except ModuleNotFoundError:
        return None, "gvxr is not installed; pip install gvxr"
    except ImportError as error:
        return None, f"gvxr cannot be loaded ({error}); {LIBRARIES}"
    try:
        gvxr.createWindow(-1, 0, "EGL")
        gvxr.setSourcePosition(-1000.0, 0.0, 0.0, "mm")
        gvxr.useParallelBeam()
        gvxr.setDetectorPosition(100.0, 0.0, 0.0, "mm")
        gvxr.setDetectorUpVector(0, 0, -1)
        gvxr.setDetectorNumberOfPixels(128, 32)  # columns along y
        gvxr.setDetectorPixelSize(PIXEL_MM, PIXEL_MM, "mm")
    except Exception as error:
        return None, f"gvxr cannot draw here ({error}); it needs EGL (libegl1, libgl1-mesa-dri)"
    return gvxr, f"{gvxr.getVersionOfCoreGVXR()}, {gvxr.getOpenGlVersion()}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the rows there")
    arguments = parser.parse_args()
    gvxr, told = _renderer()
    if gvxr is None:
        print(f"skipped: {told}")
        return 0
    print(told)
    rows: list[dict[str, Any]] = []
    for kV, filters in BEAMS:
        spectrum = tube_spectrum(kV=kV, filters=filters_from_text(filters))
        for name, lines in OBJECTS.items():
            traced = traced_transmissions(gvxr, spectrum, lines)
            for layers, theirs in zip(lines, traced, strict=True):
                ours = expected_transmission(spectrum, layers)
                rows.append(
                    {
                        "kV": kV,
                        "filter": filters,
                        "object": name,
                        "layers": "+".join(map(str, layers)),
                        "raytwin": ours,
                        "gvxr": float(theirs),
                        "difference_percent": 100.0 * (ours / float(theirs) - 1.0),
                    }
                )
                row = rows[-1]
                print(
                    f"{kV:5g} kV {filters:<13} {name:<19} {row['layers']:<36} {ours:.5f} {theirs:.5f}"
                    f" {row['difference_percent']:+.3f} %"
                )
    worst = max(abs(row["difference_percent"]) for row in rows)
    print(f"largest difference {worst:.5f} % over {len(rows)} transmissions")
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps({"gvxr": told, "largest_percent": worst, "rows": rows}, indent=1))
    return int(worst > 100.0 * LARGEST_DIFFERENCE)


if __name__ == "__main__":
    sys.exit(main())

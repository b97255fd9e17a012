"""Diagnoses of sessions whose spectra, cross sections and panel are those of CatSim (XCIST): one effect each, two, and none.

CatSim (PyPI `gecatsim`; De Man and others) brings spectra of its own (Xspect, 70-140 kV), cross sections that are not xraylib's, a
panel that adds up energies, crosstalk between neighbours or a Lorentzian transfer function, and a scatter kernel. Objects, labels,
noise and the other effects are those of `second_simulator.py`, which this script drives.

    pip install gecatsim
    python validation/catsim_sessions.py --line csi
    python validation/catsim_sessions.py --line gos --only none kv_error

`--catsim FOLDER` takes gecatsim from where it was unpacked, for machines on which its own build fails. The script ends with exit
code 0 and the reason where gecatsim is not there.
"""

import argparse
import contextlib
import importlib.util
import sys
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import second_simulator as plain
from scipy.fft import dctn, idctn
from scipy.ndimage import convolve

MATERIALS = {"Al": "Al", "Pb": "Pb", "H2O": "water", "Cu": "Cu", "W": "W", "Gd2O2S": "GOS", "CsI": "CsI", "Be": "Be"}
LOWEST_KV, HIGHEST_KV = 70.0, 140.0  # of CatSim's files, one every 10 kV
ANODE_DEG = 10.0
# crosstalk: share of its light that a pixel gives to each neighbour along rows and along columns; lorentzian_mm2: H of a transfer
# function 1 / (1 + H f^2)
LINES = {
    "csi": (
        {
            "shape": (96, 128),
            "pixel_mm": 0.3,
            "near_mm": 600.0,
            "far_mm": 450.0,
            "detector_mm": 900.0,
            "scintillator": ("CsI", 0.5),
            "edge_keV": 34.5,
            "line_keV": 29.5,
            "current_mA": {80.0: 2.0, 120.0: 1.0},
            "wedge_mm": 2.0,
            "water_mm": 30.0,
        },
        {"crosstalk": (0.04, 0.045)},
    ),
    "gos": (
        {
            "shape": (112, 112),
            "pixel_mm": 0.15,
            "near_mm": 420.0,
            "far_mm": 300.0,
            "detector_mm": 600.0,
            "scintillator": ("Gd2O2S", 0.2),
            "edge_keV": 50.24,
            "line_keV": 42.8,
            "current_mA": {70.0: 4.0, 100.0: 2.0, 140.0: 1.0},
            "wedge_mm": 2.5,
            "water_mm": 25.0,
        },
        {"crosstalk": (0.08, 0.08)},
    ),
    "flat panel": (
        {
            "shape": (104, 120),
            "pixel_mm": 0.2,
            "near_mm": 500.0,
            "far_mm": 380.0,
            "detector_mm": 750.0,
            "scintillator": ("CsI", 0.6),
            "edge_keV": 34.5,
            "line_keV": 29.5,
            "current_mA": {70.0: 3.0, 110.0: 1.0},
            "wedge_mm": 2.0,
            "water_mm": 30.0,
        },
        {"lorentzian_mm2": 0.25},
    ),
}


def catsim(folder: Path | None):
    """CatSim's GetMu and spectrum reader, and the folder of its files; None with the reason where it is not there."""
    if folder is not None:
        sys.path.insert(0, str(folder))
    found = importlib.util.find_spec("gecatsim")
    if found is None or not found.submodule_search_locations:
        return None, "gecatsim is not installed; pip install gecatsim, or --catsim FOLDER"
    try:
        from gecatsim.pyfiles.GetMu import GetMu
        from gecatsim.pyfiles.Spectrum import spectrum_read
    except (ImportError, OSError) as error:
        return None, f"gecatsim cannot be loaded: {error}"
    return (GetMu, spectrum_read, Path(found.submodule_search_locations[0])), ""


class CatSimLine(plain.Line):
    """A line whose light spreads and scatters as CatSim has it."""

    optical = 1.0  # CatSim's panels have no noise of the light
    panel: ClassVar[dict] = {}
    kernel = np.ones((1, 1))  # of scatter

    def spread(self, image: np.ndarray, *, mode: str = "reflect") -> np.ndarray:
        """Crosstalk between neighbours, or a Lorentzian in the frequency."""
        if "crosstalk" in self.panel:
            for axis, share in enumerate(self.panel["crosstalk"]):
                line = np.array([share, 1.0 - 2.0 * share, share])
                image = convolve(image, line[:, None] if axis == 0 else line[None, :], mode=mode)
            return image
        row, column = (np.arange(length) / (2.0 * length * self.of.pixel_mm) for length in image.shape)
        transfer = 1.0 / (1.0 + self.panel["lorentzian_mm2"] * (row[:, None] ** 2 + column[None, :] ** 2))
        return idctn(dctn(image, type=2) * transfer, type=2)

    def scattered(self, source: np.ndarray) -> np.ndarray:
        """CatSim's kernel of 49 x 65 mm."""
        from scipy.ndimage import zoom
        from scipy.signal import oaconvolve

        kernel = zoom(self.kernel, 1.0 / self.of.pixel_mm, order=1)
        return oaconvolve(source, kernel / kernel.sum(), mode="same")


def as_catsim(name: str, tools: tuple) -> str:
    """A line of this script joins `second_simulator.LINES`, whose spectra and attenuation are CatSim's from here on."""
    attenuation, read, folder = tools

    @lru_cache(maxsize=64)
    def per_mm(material: str, energies: bytes) -> np.ndarray:
        return np.asarray(attenuation(MATERIALS[material], np.frombuffer(energies).copy()), dtype=np.float64) / 10.0

    def attenuation_per_mm(material: str, energies_keV: np.ndarray) -> np.ndarray:
        return per_mm(material, np.asarray(energies_keV, dtype=np.float64).tobytes())

    @lru_cache(maxsize=16)
    def stated(kV: float) -> tuple[np.ndarray, np.ndarray]:
        energies, photons, _ = read(str(folder / "spectrum" / f"tungsten_tar{ANODE_DEG:.1f}_{kV:.0f}_filt.dat"))
        return np.asarray(energies, dtype=np.float64), np.asarray(photons, dtype=np.float64)

    @lru_cache(maxsize=64)
    def spectrum(name: str, kV: float, aluminium_mm: float, copper_mm: float) -> tuple[np.ndarray, np.ndarray]:
        of = plain.LINES[name]
        # between two voltages: both drawn out to this one, joined by how near they are
        low = min(max(10.0 * (kV // 10.0), LOWEST_KV), HIGHEST_KV - 10.0)
        share = (kV - low) / 10.0
        edges = np.arange(1.0, np.ceil(kV) + 1.0, 0.5)
        energies, photons = 0.5 * (edges[1:] + edges[:-1]), np.zeros(len(edges) - 1)
        for own, weight in ((low, 1.0 - share), (low + 10.0, share)):
            at, there = stated(own)
            half = 0.5 * (at[1] - at[0])
            whole = np.concatenate([[0.0], np.cumsum(there)])
            photons += weight * np.diff(np.interp(edges * own / kV, np.append(at - half, at[-1] + half), whole))
        depth = aluminium_mm * attenuation_per_mm("Al", energies) + copper_mm * attenuation_per_mm("Cu", energies)
        material, thickness_mm = of.scintillator
        stopped = 1.0 - np.exp(-thickness_mm * attenuation_per_mm(material, energies))
        absorbed = np.maximum(photons, 0.0) * np.exp(-depth) * stopped * of.photons
        seen = absorbed > 1e-12 * absorbed.max()
        return energies[seen], absorbed[seen]

    plain.attenuation_per_mm, plain.spectrum = attenuation_per_mm, spectrum
    fields, CatSimLine.panel = LINES[name]
    CatSimLine.kernel = np.fromfile(folder / "scatter" / "scatter_kernel.dat", np.float32).reshape(49, 65)
    # photons on a square centimetre at a metre, a mAs
    of_pixel = 0.01 * fields["pixel_mm"] ** 2 * (1000.0 / fields["detector_mm"]) ** 2
    line = {
        "spread_px": 0.0,
        "read_DN": 5.0,
        "dark_DN": 300.0,
        "bits": 14,
        "DN_per_keV": 1.0,
        "photons": of_pixel,
        "lag_s": 0.3,
        "pause_s": 6.0,
        "readout_ms": 5.0,
        "copper_times": 1.0,
        "anode_deg": ANODE_DEG,
        "beryllium_mm": 1.0,
        "lead_mm": 2.0,
    }
    plain.LINES[name] = of = plain.LineOf(**{**line, **fields})
    most = 0.0
    for kV, current_mA in of.current_mA.items():
        energies, photons = spectrum(name, kV, 2.1, 0.0)
        most = max(most, float(photons @ energies) * current_mA * 0.16)
    plain.LINES[name] = plain.LineOf(**{**line, **fields, "DN_per_keV": 0.6 * of.highest_DN / most})
    return name


def run() -> None:
    """The table on the terminal, and the rows as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--line", choices=list(LINES), default="csi", help="which line (default csi)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=12, help="of a series (default 12)")
    parser.add_argument("--only", nargs="+", choices=[*sorted(plain.CASES), *plain.PAIRS], metavar="EFFECT")
    parser.add_argument("--catsim", type=Path, help="folder that holds gecatsim, where it is not installed")
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args()
    tools, reason = catsim(options.catsim)
    if tools is None:
        print(f"nothing compared: {reason}")
        return
    line = as_catsim(options.line, tools)
    plain.run_cases(
        line, options.only or plain.cases_of(plain.LINES[line]), options.seed, options.frames, options.json, CatSimLine
    )


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        run()

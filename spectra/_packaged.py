"""Tube spectra that come with the package: SpekPy's answers for the default tube at every whole kV, but for last bits."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .grid import BIN_WIDTH_KEV, energy_grid_keV

FILE = "tube_spectra.npz"
FORMAT = 1


@lru_cache(maxsize=1)
def packaged_version() -> str | None:
    """SpekPy's version that the packaged spectra were made with; None where there are none."""
    stored = _read("version")
    return None if stored is None else str(stored)


def is_packaged(anode: str, anode_angle_deg: float, model: str) -> bool:
    """Whether the spectra of a tube come with the package, so that any voltage takes milliseconds."""
    return _tube(tube_name(anode, anode_angle_deg, model)) is not None


def packaged_fluence(anode: str, anode_angle_deg: float, model: str, kV: int) -> NDArray[np.float64] | None:
    """Bremsstrahlung and lines (2, n) at a whole kV, photons / keV / cm2 / mAs at 1 m on the common grid; None: not packaged."""
    table = _tube(tube_name(anode, anode_angle_deg, model))
    if table is None:
        return None
    first_kV, starts, bremsstrahlung, line_bins, lines = table
    row = kV - first_kV
    if not 0 <= row < len(lines):
        return None
    bins = energy_grid_keV(float(kV)).size
    values = np.zeros((2, bins))
    values[0] = bremsstrahlung[starts[row] : starts[row] + bins]
    seen = line_bins < bins
    values[1, line_bins[seen]] = lines[row, seen]
    return values


def packaged_lines(anode: str, anode_angle_deg: float, model: str) -> NDArray[np.float64] | None:
    """Height and mean energy of the lines in each bin of the whole grid (2, n); None: not packaged."""
    stored = _read(f"{tube_name(anode, anode_angle_deg, model)}/places")
    return None if stored is None else np.asarray(stored, dtype=float)


def tube_name(anode: str, anode_angle_deg: float, model: str) -> str:
    """What a tube is called in the file."""
    return f"{anode}_{anode_angle_deg:g}deg_{model}"


def table_from_spectra(spectra: dict[int, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Arrays of one tube in the file, from bremsstrahlung and lines (2, n) at consecutive whole kV."""
    voltages = sorted(spectra)
    last = np.zeros(spectra[voltages[-1]].shape[1], dtype=bool)
    for one in spectra.values():
        last[: one.shape[1]] |= one[1] > 0
    line_bins = np.flatnonzero(last)
    lines = np.zeros((len(voltages), line_bins.size))
    for row, kV in enumerate(voltages):
        there = line_bins < spectra[kV].shape[1]
        lines[row, there] = spectra[kV][1, line_bins[there]]
    bremsstrahlung = np.concatenate([spectra[kV][0] for kV in voltages])
    return {
        "first_kV": np.array(voltages[0]),
        # bytes of equal rank together: what is alike in neighbours compresses
        "bremsstrahlung": bremsstrahlung.view(np.uint8).reshape(-1, 8).T.copy(),
        "line_bins": line_bins,
        "lines": lines,
    }


@lru_cache(maxsize=4)
def _tube(
    name: str,
) -> tuple[int, NDArray[np.intp], NDArray[np.float64], NDArray[np.intp], NDArray[np.float64]] | None:
    first = _read(f"{name}/first_kV")
    if first is None:
        return None
    planes = np.asarray(_read(f"{name}/bremsstrahlung"), dtype=np.uint8)
    bremsstrahlung = np.ascontiguousarray(planes.T).view(np.float64).ravel()
    lines = np.asarray(_read(f"{name}/lines"), dtype=float)
    first_kV = int(first)
    sizes = [energy_grid_keV(float(first_kV + row)).size for row in range(len(lines))]
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.intp)
    return first_kV, starts, bremsstrahlung, np.asarray(_read(f"{name}/line_bins"), dtype=np.intp), lines


def _read(name: str) -> NDArray[np.generic] | None:
    path = Path(__file__).with_name(FILE)
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as stored:
        if int(stored["format"]) != FORMAT or float(stored["bin_width_keV"]) != BIN_WIDTH_KEV:
            return None
        return stored[name] if name in stored.files else None

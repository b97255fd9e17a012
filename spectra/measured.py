"""Measured spectra: a two-column text file in place of the tube model."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError
from .grid import BIN_WIDTH_KEV, energy_grid_keV
from .spectrum import Spectrum

_ANCHORS = {"centre": 0.5, "center": 0.5, "top": 1.0, "bottom": 0.0}
_ABSOLUTE_UNIT = "photons/kev/cm2/mas"


def spectrum_from_file(
    path: str | os.PathLike[str], *, energy_at: str | None = None, kV: float | None = None
) -> Spectrum:
    """Read a spectrum (fluence per keV) and put it on the common grid; photons are conserved.

    Text, two columns: energy in keV on equal steps, and fluence per keV. Column names may stand above them. Lines with `#`
    are a header; three of them say something when they are there:

        # energy: centre | top | bottom        which point of its bin the energy is (also as words: "top of bin")
        # unit: photons/keV/cm2/mAs            the scale is absolute, at 1 m in vacuum; otherwise it is arbitrary
        # kV: 40                               tube voltage (also as "tube voltage: 40 kV")

    Each bin's photons are spread evenly over it and collected in the bins of the grid, from 1 keV upward.

    Args:
        path: the file.
        energy_at: `centre`, `top` or `bottom`; overrides the header; `centre` where neither says.
        kV: tube voltage; overrides the header. Photons above it are kept: they were measured.

    Raises:
        FileFormatError: missing file, not two columns of numbers, steps that differ, negative or no photons.
    """
    where = Path(path)
    header, energies, fluence = _columns(where)
    said = header.get("energy", "centre") if energy_at is None else energy_at
    anchor = next((share for word, share in _ANCHORS.items() if word in said.lower()), None)
    if anchor is None:
        raise FileFormatError(f"{where.name}, energy", received=repr(said), expected="centre, top or bottom")
    steps = np.diff(energies)
    width = float(np.median(steps))
    if not (width > 0 and np.all(np.abs(steps - width) <= 0.01 * width)):
        raise FileFormatError(
            f"{where.name}, energies",
            received=f"steps from {steps.min():g} to {steps.max():g} keV",
            expected="energies that rise in equal steps",
        )
    if not (np.all(np.isfinite(fluence)) and np.all(fluence >= 0)):
        raise FileFormatError(
            f"{where.name}, fluence", received="negative values or NaN", expected="values of 0 or more"
        )
    edges = energies[0] + width * (np.arange(energies.size + 1) - anchor)
    occupied = np.flatnonzero(fluence > 0)
    if occupied.size == 0 or edges[occupied[-1] + 1] <= 1.0:
        raise FileFormatError(f"{where.name}, fluence", received="no photons above 1 keV", expected="a spectrum")
    if edges[occupied[-1] + 1] > 500.0:
        raise FileFormatError(
            f"{where.name}, energies",
            received=f"photons at {edges[occupied[-1] + 1]:g} keV",
            expected="energies in keV, 500 keV at most",
            remedy="convert eV to keV",
        )
    voltage = kV if kV is not None else _number(header.get("kv") or header.get("tube voltage"))
    grid = energy_grid_keV(max(float(edges[occupied[-1] + 1]), 2.0))
    collected = np.concatenate([[0.0], np.cumsum(fluence * width)])
    grid_edges = np.append(grid - 0.5 * BIN_WIDTH_KEV, grid[-1] + 0.5 * BIN_WIDTH_KEV)
    photons = np.diff(np.interp(grid_edges, edges, collected))
    unit = header.get("unit", "").lower().replace(" ", "")
    return Spectrum(
        energies_keV=grid,
        fluence=np.clip(photons, 0.0, None) / BIN_WIDTH_KEV,
        kV=voltage,
        model=f"file {where.name}",
        absolute=unit.startswith(_ABSOLUTE_UNIT),
    )


def _columns(where: Path) -> tuple[dict[str, str], NDArray[np.float64], NDArray[np.float64]]:
    header: dict[str, str] = {}
    rows: list[tuple[float, float]] = []
    try:
        lines = where.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise FileFormatError("spectrum file", received=where, expected=f"a readable file ({error.strerror})") from None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if text.startswith("#"):
            word, colon, value = text.lstrip("# \t").partition(":")
            if colon:
                header.setdefault(word.strip().lower(), value.strip())
            if "top of bin" in text.lower() or "top of the bin" in text.lower():
                header.setdefault("energy", "top")
            continue
        words = text.replace(",", " ").replace(";", " ").split()
        if not words or not (rows or any(map(_is_number, words))):
            continue  # empty, or the columns' names
        try:
            energy, value = words[:2]
            rows.append((float(energy), float(value)))
        except ValueError:
            raise FileFormatError(
                f"{where.name}, line {number}",
                received=repr(text),
                expected="two numbers: energy in keV and fluence per keV",
            ) from None
    if len(rows) < 2:
        raise FileFormatError(
            "spectrum file", received=f"{len(rows)} lines of numbers in {where}", expected="at least two"
        )
    table = np.array(rows)
    return header, table[:, 0], table[:, 1]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text.split()[0])
    except (ValueError, IndexError):
        return None

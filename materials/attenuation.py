"""Attenuation and energy absorption of materials, by energy."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..acquisition.setting import Filter
from ..errors import InputError
from .library import Library, library_from_files, material_from_name
from .material import Material, atomic_number_from_symbol

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# The common range of the tables; each table's own limits are checked on top.
MINIMUM_ENERGY_KEV = 1.0
MAXIMUM_ENERGY_KEV = 500.0

_ELECTRON_MASS_KEV = 510.99895
# Gauss-Legendre nodes over the cosine of the Compton angle; the integrand is smooth.
_COMPTON_DIRECTIONS = 48
# xraylib numbers its lines downwards, K lines first; this is the last of the L3 lines.
_LAST_L_LINE = -113

_ENERGIES_INSIDE_A_BIN = 25

# Longer energy arrays are looked up afresh: keeping them would cost more memory than it saves time.
_KEPT_ENERGIES = 4096


def _row(values: ArrayLike) -> FloatArray:
    # xraylib_np answers (element, energy)
    return np.asarray(values, dtype=float).reshape(-1)


def _xraylib_total(number: int, energies_keV: FloatArray) -> FloatArray:
    import xraylib_np

    return _row(xraylib_np.CS_Total(np.array([number]), energies_keV))


def _xraylib_photoelectric(number: int, energies_keV: FloatArray) -> FloatArray:
    import xraylib_np

    return _row(xraylib_np.CS_Photo(np.array([number]), energies_keV))


def _energy_absorption(number: int, energies_keV: FloatArray) -> FloatArray:
    """mu_en/rho of an element from its parts; xraylib's own CS_Energy is up to 34 % low for air from 11 to 60 keV."""
    import xraylib
    import xraylib_np

    element = np.array([number])
    absorbed = _row(xraylib_np.CS_Photo(element, energies_keV))
    lines = {}
    for line in range(xraylib.KL1_LINE, _LAST_L_LINE - 1, -1):
        try:
            lines[line] = float(xraylib.LineEnergy(number, line))
        except ValueError:
            continue  # this element has no such line
    if lines:
        produced = xraylib_np.CS_FluorLine_Kissel_Cascade(element, np.array(list(lines)), energies_keV)
        produced_cm2_g = np.asarray(produced, dtype=float).reshape(len(lines), -1)
        absorbed = absorbed - np.array(list(lines.values())) @ produced_cm2_g / energies_keV
    cosines, weights = np.polynomial.legendre.leggauss(_COMPTON_DIRECTIONS)
    scattered = np.asarray(xraylib_np.DCS_Compt(element, energies_keV, np.arccos(cosines)), dtype=float)
    kept_share = 1.0 - 1.0 / (1.0 + energies_keV[:, None] / _ELECTRON_MASS_KEV * (1.0 - cosines))
    compton = 2.0 * np.pi * (scattered.reshape(energies_keV.size, -1) * kept_share) @ weights
    return np.asarray(absorbed + compton, dtype=float)


def _chantler_total(number: int, energies_keV: FloatArray) -> FloatArray:
    # Chantler's table begins at 1.01 keV; the last hundredth of a keV is held
    eV, total = _chantler_table(number)
    found = np.interp(np.log(1000.0 * np.maximum(energies_keV, 1.0102)), np.log(eV), np.log(np.maximum(total, 1e-99)))
    return np.asarray(np.exp(found), dtype=float)


@lru_cache(maxsize=128)
def _chantler_table(number: int) -> tuple[FloatArray, FloatArray]:
    """Energies (eV) and mu/rho (cm2/g) of an element, read from xraydb's file: importing xraydb takes a second."""
    import json
    import sqlite3
    from contextlib import closing
    from importlib.util import find_spec
    from pathlib import Path

    import xraylib

    package = find_spec("xraydb")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("xraydb is not installed")
    file = Path(package.origin).with_name("xraydb.sqlite").as_uri() + "?mode=ro"
    with closing(sqlite3.connect(file, uri=True)) as tables:
        row = tables.execute(
            "SELECT energy, mu_total FROM Chantler WHERE element = ?", (xraylib.AtomicNumberToSymbol(number),)
        ).fetchone()
    if row is None:
        raise InputError("element", received=f"Z = {number}", expected="one of Chantler's table: 1 to 92")
    eV, total = (np.array(json.loads(column), dtype=float) for column in row)
    return eV, total


def _penelope_total(number: int, energies_keV: FloatArray) -> FloatArray:
    MeV, total = (column[number - 1] for column in _penelope_table())
    known = np.log(1000.0 * np.array(MeV, dtype=float))
    found = np.interp(np.log(energies_keV), known, np.log(np.array(total, dtype=float)), left=np.nan, right=np.nan)
    return np.asarray(np.exp(found), dtype=float)


@lru_cache(maxsize=1)
def _penelope_table() -> tuple[list[list[float]], list[list[float]]]:
    """Energies (MeV) and mu/rho (cm2/g) of each element, read from SpekPy's file: importing SpekPy takes a second."""
    import json
    from importlib.util import find_spec
    from pathlib import Path

    package = find_spec("spekpy")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("spekpy is not installed")
    table = json.loads(Path(package.origin).with_name("data").joinpath("tables", "pene_mu.dat").read_text("utf-8"))
    return table["photon energy"], table["mu_over_rho"]


# xraydb's Elam table is xraylib's, so it is no second opinion and is not offered.
TABLES: Mapping[str, Callable[[int, FloatArray], FloatArray]] = {
    "xraylib": _xraylib_total,
    "chantler": _chantler_total,
    "penelope": _penelope_total,
}
_OTHER_TABLES: Mapping[str, Callable[[int, FloatArray], FloatArray]] = {
    "photoelectric": _xraylib_photoelectric,
    "energy absorption": _energy_absorption,
}


@lru_cache(maxsize=2048)
def _kept_element_table(table: str, number: int, energies: bytes) -> FloatArray:
    values = _element_table(table, number, np.frombuffer(energies))
    values.setflags(write=False)
    return values


def _element_table(table: str, number: int, energies_keV: FloatArray) -> FloatArray:
    function = TABLES.get(table) or _OTHER_TABLES[table]
    return function(number, energies_keV)


def _summed(material: Material, energy_keV: ArrayLike, table: str) -> FloatArray:
    energies = np.asarray(energy_keV, dtype=float)
    if not np.all((energies >= MINIMUM_ENERGY_KEV) & (energies <= MAXIMUM_ENERGY_KEV)):
        outside = energies[~((energies >= MINIMUM_ENERGY_KEV) & (energies <= MAXIMUM_ENERGY_KEV))]
        raise InputError(
            "energy_keV",
            received=f"{outside.flat[0]:g} keV",
            expected=f"energies from {MINIMUM_ENERGY_KEV:g} to {MAXIMUM_ENERGY_KEV:g} keV, where the tables are",
        )
    flat = np.ascontiguousarray(energies.ravel())
    kept = flat.size <= _KEPT_ENERGIES
    key = flat.tobytes() if kept else b""
    total = np.zeros(flat.shape)
    for symbol, fraction in material.mass_fractions.items():
        number = atomic_number_from_symbol(symbol)
        values = _kept_element_table(table, number, key) if kept else _element_table(table, number, flat)
        total += fraction * values
    return total.reshape(energies.shape)


def mass_attenuation_cm2_g(material: Material, energy_keV: ArrayLike, *, table: str = "xraylib") -> FloatArray:
    """Mass attenuation coefficient mu/rho in cm2/g, coherent scattering included.

    mu/rho = sum_i w_i (mu/rho)_i over the elements (mixture rule; chemical binding is left out, which matters within
    a few eV of an edge only).

    Args:
        material: what the beam crosses.
        energy_keV: photon energies, any shape, 1 to 500 keV.
        table: `xraylib` (CS_Total of xraylib: photoelectric, Compton and Rayleigh); `chantler` (xraydb) and `penelope`
            (the table that SpekPy ships) are second opinions: they differ from it by 1-4 %, which is the honest
            uncertainty of the data.

    Returns:
        Array of the shape of `energy_keV`.

    Raises:
        InputError: an energy outside 1-500 keV, or an unknown table.

    Source: Hubbell and Seltzer, NISTIR 5632 (2004), eq. 5; Schoonjans et al. (2011), doi:10.1016/j.sab.2011.09.011.
    Checked against: NIST values of five materials, 2 % (tests/test_materials_attenuation.py).
    """
    if table not in TABLES:
        raise InputError("table", received=repr(table), expected=f"one of {', '.join(TABLES)}")
    return _summed(material, energy_keV, table)


def mass_photoelectric_cm2_g(material: Material, energy_keV: ArrayLike) -> FloatArray:
    """Photoelectric part of mu/rho in cm2/g (xraylib CS_Photo, mixture rule), 1 to 500 keV.

    Raises:
        InputError: an energy outside 1-500 keV.
    """
    return _summed(material, energy_keV, "photoelectric")


def mass_energy_absorption_cm2_g(material: Material, energy_keV: ArrayLike) -> FloatArray:
    """Mass energy-absorption coefficient mu_en/rho in cm2/g.

    mu_en/rho = tau/rho - sum_j sigma_j E_j / E + int (d sigma_C / d Omega) (1 - E'/E) d Omega: photoelectric absorption
    less the energy of the K and L fluorescence it leads to (with cascades), plus what Compton electrons receive
    (bound electrons: Klein-Nishina times the incoherent scattering function). Bremsstrahlung of the electrons is left
    out: below 0.1 % in air to 300 keV, 2 % in lead at 200 keV.

    Args:
        material: what absorbs.
        energy_keV: photon energies, any shape, 1 to 500 keV.

    Returns:
        Array of the shape of `energy_keV`.

    Raises:
        InputError: an energy outside 1-500 keV.

    Source: Seltzer (1993), Radiat Res 136:147, eqs. 2-6; cross sections of xraylib. (xraylib's own CS_Energy is a
        spline through too few points: 34 % low for air at 20 keV.)
    Checked against: NIST (NISTIR 5632) for air, carbon and aluminium, 0.5 %; copper, 2.5 %
        (tests/test_materials_attenuation.py).
    """
    return _summed(material, energy_keV, "energy absorption")


def mu_per_mm(material: Material, energy_keV: ArrayLike, *, table: str = "xraylib") -> FloatArray:
    """Linear attenuation coefficient mu in 1/mm: mu/rho (`mass_attenuation_cm2_g`) times the density.

    Raises:
        InputError: an energy outside 1-500 keV, or an unknown table.
    """
    return mass_attenuation_cm2_g(material, energy_keV, table=table) * (material.density_g_cm3 / 10.0)


def transmission(
    filters: Sequence[Filter],
    energy_keV: ArrayLike,
    *,
    table: str = "xraylib",
    library: Library | None = None,
    bin_width_keV: float = 0.0,
) -> FloatArray:
    """Fraction of photons (0 to 1) that cross all layers without interacting: exp(-sum_i mu_i t_i).

    Narrow beam: whatever scatters is lost. The order of the layers does not matter.

    Args:
        filters: layers by name and thickness in mm; none transmit everything.
        energy_keV: photon energies, any shape, 1 to 500 keV.
        table: see `mass_attenuation_cm2_g`.
        library: where the names are looked up; None: as `material_from_name`.
        bin_width_keV: energies are the centres of bins this wide, and a bin that an absorption edge of a layer cuts
            gets the mean over the bin instead of the value on one side of the edge; 0: the value at the energy.

    Returns:
        Array of the shape of `energy_keV`.

    Raises:
        InputError: an unknown material, an energy outside 1-500 keV, or an unknown table.
    """
    passed = np.exp(-optical_depth(filters, energy_keV, table=table, library=library))
    if bin_width_keV > 0:
        energies = np.asarray(energy_keV, dtype=float)
        look_up = library_from_files() if library is None else library
        materials = [material_from_name(layer.material, library=look_up) for layer in filters]
        cut = bins_cut_by_edges(materials, energies, bin_width_keV=bin_width_keV)
        if np.any(cut):
            inside = energies_inside_bins(energies[cut], bin_width_keV=bin_width_keV)
            depth = optical_depth(filters, inside, table=table, library=library)
            passed[cut] = np.exp(-depth).mean(axis=-1)
    return passed


def absorption_edges_keV(material: Material) -> FloatArray:
    """K and L absorption edges in keV above 1 keV of a material's elements, rising."""
    edges = [edge for symbol in material.mass_fractions for edge in _element_edges(atomic_number_from_symbol(symbol))]
    return np.unique(np.array(edges, dtype=float))


@lru_cache(maxsize=128)
def _element_edges(number: int) -> tuple[float, ...]:
    import xraylib

    edges = []
    for shell in (xraylib.K_SHELL, xraylib.L1_SHELL, xraylib.L2_SHELL, xraylib.L3_SHELL):
        try:
            edges.append(float(xraylib.EdgeEnergy(number, shell)))
        except ValueError:
            continue  # light elements have no L edges in the table
    return tuple(edge for edge in edges if edge > MINIMUM_ENERGY_KEV)


def bins_cut_by_edges(materials: Iterable[Material], energy_keV: ArrayLike, *, bin_width_keV: float) -> BoolArray:
    """True where the bin around an energy (any shape, keV) holds an absorption edge of one of the materials."""
    energies = np.asarray(energy_keV, dtype=float)
    cut = np.zeros(energies.shape, dtype=bool)
    for material in materials:
        for edge in absorption_edges_keV(material):
            cut |= np.abs(energies - edge) < 0.5 * bin_width_keV
    return cut


def energies_inside_bins(energy_keV: ArrayLike, *, bin_width_keV: float) -> FloatArray:
    """Energies (..., 25) in keV spread evenly over bins with these centres (...), for means over a bin."""
    offsets = (np.arange(_ENERGIES_INSIDE_A_BIN) + 0.5) / _ENERGIES_INSIDE_A_BIN - 0.5
    inside = np.asarray(energy_keV, dtype=float)[..., None] + bin_width_keV * offsets
    return np.clip(inside, MINIMUM_ENERGY_KEV, MAXIMUM_ENERGY_KEV)


def optical_depth(
    filters: Sequence[Filter], energy_keV: ArrayLike, *, table: str = "xraylib", library: Library | None = None
) -> FloatArray:
    """sum_i mu_i t_i of the layers (no unit), for the same arguments as `transmission`."""
    look_up = library_from_files() if library is None else library
    depth: Any = np.zeros(np.shape(energy_keV))
    for layer in filters:
        material = material_from_name(layer.material, library=look_up)
        depth = depth + mu_per_mm(material, energy_keV, table=table) * layer.thickness_mm
    return np.asarray(depth, dtype=float)

"""Attenuation as the virtual lab knows it: Chantler's tables, through xraydb, and the lab's own compositions."""

import tomllib
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Array = NDArray[np.float64]

# IUPAC 2021 standard atomic weights, through xraydb; the lab takes the elements that the tables cover.
_HIGHEST_Z = 92


@lru_cache(maxsize=1)
def _compositions() -> dict[str, dict[str, Any]]:
    text = (files(__package__) / "compositions.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _elements_of_formula(formula: str, *, name: str) -> dict[str, float]:
    """Mass fractions of the elements of a chemical formula."""
    import xraydb

    try:
        counts = xraydb.chemparse(formula)
        masses = {element: count * xraydb.atomic_mass(element) for element, count in counts.items()}
        heaviest = max(xraydb.atomic_number(element) for element in counts)
    except (
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        AttributeError,
    ):  # all that xraydb raises on names it cannot read
        masses, heaviest = {}, 0
    if not masses or heaviest > _HIGHEST_Z:
        known = sorted(_compositions())
        raise InputError(
            "material in the virtual lab",
            received=repr(name),
            expected="an element symbol, a formula with density such as Gd2O2S@7.32, or one of " + ", ".join(known),
        )
    total = sum(masses.values())
    return {element: mass / total for element, mass in masses.items()}


def _elements(name: str) -> dict[str, float]:
    """Mass fractions of the elements of a material of the lab, or of a bare formula."""
    entry = _compositions().get(name)
    if entry is None:
        return _elements_of_formula(name, name=name)
    if "elements" in entry:
        total = sum(entry["elements"].values())
        return {element: share / total for element, share in entry["elements"].items()}
    if "formula" in entry:
        return _elements_of_formula(entry["formula"], name=name)
    result: dict[str, float] = {}
    total = sum(entry["mixture"].values())
    for part, share in entry["mixture"].items():
        for element, fraction in _elements(part).items():
            result[element] = result.get(element, 0.0) + fraction * share / total
    return result


@lru_cache(maxsize=64)
def composition(material: str) -> tuple[dict[str, float], float]:
    """Mass fractions of the elements, and density in g/cm3, of a material.

    Args:
        material: a name of `compositions.toml`, an element symbol, or FORMULA@density.

    Raises:
        InputError: a name that is none of these.
    """
    formula, at, density = material.partition("@")
    if at:
        try:
            density_g_cm3 = float(density)
        except ValueError:
            density_g_cm3 = float("nan")
        if not density_g_cm3 > 0:
            raise InputError(f"density of {material}", received=repr(density), expected="a density above 0 g/cm3")
        return _elements_of_formula(formula, name=material), density_g_cm3
    entry = _compositions().get(material)
    if entry is not None:
        return _elements(material), float(entry["density_g_cm3"])
    fractions = _elements_of_formula(material, name=material)
    if len(fractions) != 1:
        raise InputError(
            "material in the virtual lab",
            received=repr(material),
            expected="a density with a formula",
            remedy=f"write {material}@DENSITY, in g/cm3",
        )
    import xraydb

    return fractions, float(xraydb.atomic_density(material))


def mu_per_mm(material: str, energy_keV: Array) -> Array:
    """Linear attenuation coefficient of a material, per mm.

    mu = density sum_i w_i (mu/rho)_i, the total of Chantler's tables (photoelectric and scattering).

    Args:
        material: as in `composition`.
        energy_keV: photon energies, any shape, 1 to 400 keV.

    Returns:
        Coefficients in 1/mm, of the shape of `energy_keV`.

    Raises:
        InputError: an unknown material or an energy out of range.

    Source: C. T. Chantler, J. Phys. Chem. Ref. Data 24 (1995) 71 and 29 (2000) 597, as tabulated in xraydb.
    """
    import xraydb

    energies = np.asarray(energy_keV, dtype=np.float64)
    if not np.all((energies >= 1.0) & (energies <= 400.0)):
        raise InputError(
            "energy_keV", received=f"{np.min(energies):g} to {np.max(energies):g}", expected="1 to 400 keV"
        )
    fractions, density_g_cm3 = composition(material)
    total = np.zeros(energies.size)
    for element, fraction in fractions.items():
        total += fraction * np.asarray(xraydb.mu_chantler(element, energies.ravel() * 1000.0))
    return (total * density_g_cm3 / 10.0).reshape(energies.shape)

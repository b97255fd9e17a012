"""A material: what it is made of by mass, how dense it is, and who says so."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from ..errors import InputError

# A table rounded to three digits per element can miss 1 by this much.
SUM_TOLERANCE = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """A homogeneous material.

    Fields: name; density_g_cm3; mass_fractions (element symbol -> fraction of the mass; a sum within 0.2 % of 1 is
    scaled to exactly 1, read-only afterwards); source (where composition and density come from).
    """

    name: str
    density_g_cm3: float
    mass_fractions: Mapping[str, float] = field(hash=False)
    source: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.density_g_cm3) and self.density_g_cm3 > 0):
            raise InputError(
                f"density of {self.name}",
                received=f"{self.density_g_cm3} g/cm3",
                expected="a finite density above 0 g/cm3",
            )
        for symbol, fraction in self.mass_fractions.items():
            atomic_number_from_symbol(symbol)
            if not (math.isfinite(fraction) and fraction >= 0):
                raise InputError(
                    f"mass fraction of {symbol} in {self.name}", received=fraction, expected="a number from 0 to 1"
                )
        total = math.fsum(self.mass_fractions.values())
        if not abs(total - 1.0) <= SUM_TOLERANCE:
            raise InputError(
                f"mass fractions of {self.name}",
                received=f"a sum of {total:.6g}",
                expected=f"a sum of 1 within {SUM_TOLERANCE:g}",
                remedy="give fractions of the mass, not percents or atoms",
            )
        scaled = {symbol: fraction / total for symbol, fraction in self.mass_fractions.items() if fraction > 0}
        object.__setattr__(self, "mass_fractions", MappingProxyType(scaled))

    def __reduce__(self) -> tuple[object, ...]:
        # a read-only mapping does not pickle by itself
        return _material, (self.name, self.density_g_cm3, dict(self.mass_fractions), self.source)


def _material(name: str, density_g_cm3: float, mass_fractions: Mapping[str, float], source: str) -> Material:
    return Material(name=name, density_g_cm3=density_g_cm3, mass_fractions=mass_fractions, source=source)


def atomic_number_from_symbol(symbol: str) -> int:
    """Atomic number of an element (1 hydrogen ... 92 uranium, as far as the tables go).

    Raises:
        InputError: `symbol` is no element up to uranium, written as in the periodic table (`Cu`, not `CU`).
    """
    import xraylib

    try:
        number = int(xraylib.SymbolToAtomicNumber(symbol))
    except ValueError:
        number = 0
    if not 1 <= number <= 92:
        raise InputError("element", received=repr(symbol), expected="an element symbol from H to U, such as Al or Cu")
    return number


def mass_fractions_from_formula(formula: str) -> dict[str, float]:
    """Mass fractions by element of a chemical formula such as `Ca10(PO4)6(OH)2` (subscripts may be decimal).

    Raises:
        InputError: `formula` cannot be read as a chemical formula.
    """
    import xraylib

    try:
        compound = xraylib.CompoundParser(formula)
    except ValueError:
        raise InputError(
            "formula", received=repr(formula), expected="a chemical formula such as H2O, Gd2O2S or Ca10(PO4)6(OH)2"
        ) from None
    return {
        str(xraylib.AtomicNumberToSymbol(number)): float(fraction)
        for number, fraction in zip(compound["Elements"], compound["massFractions"], strict=True)
    }


def mixture_by_mass(
    parts: Mapping[Material, float], *, name: str, density_g_cm3: float | None = None, source: str = ""
) -> Material:
    """Mix materials by parts of mass (any total).

    w_element = sum_i p_i w_i,element / sum_i p_i. Where no density is given the volumes add:
    1 / rho = sum_i p_i / rho_i / sum_i p_i, which real mixtures keep to a few percent.

    Args:
        parts: material -> parts by mass, each 0 or more, at least one above 0.
        name: name of the mixture.
        density_g_cm3: measured density; None: volumes add.
        source: where the recipe comes from.

    Raises:
        InputError: no part above 0, or a part that is negative or not finite.
    """
    total = math.fsum(parts.values())
    if not (all(math.isfinite(part) and part >= 0 for part in parts.values()) and total > 0):
        raise InputError(
            f"parts by mass of {name}",
            received={material.name: part for material, part in parts.items()},
            expected="parts of 0 or more with at least one above 0",
        )
    fractions: dict[str, float] = {}
    volume = 0.0
    for material, part in parts.items():
        volume += part / total / material.density_g_cm3
        for symbol, fraction in material.mass_fractions.items():
            fractions[symbol] = fractions.get(symbol, 0.0) + part / total * fraction
    return Material(
        name=name,
        density_g_cm3=1.0 / volume if density_g_cm3 is None else density_g_cm3,
        mass_fractions=fractions,
        source=source,
    )

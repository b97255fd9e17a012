"""Light that a photon makes in a scintillator, for each keV that it leaves there, against its energy.

An electron of energy e makes light in proportion to e f(e), and f is not constant: where ionisation is dense, excitations
quench each other (Birks), where it is sparse, electrons and holes miss each other (Onsager). A photon hands its energy
to several electrons. Just above a K edge these are slow ones, so that the light for each keV dips there.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..materials import Material, atomic_number_from_symbol, mass_photoelectric_cm2_g, material_from_name

FloatArray = NDArray[np.float64]

# Mass stopping powers (MeV cm2 / g) at which quenching sets in and recombination is complete, and the share of pairs that
# can miss each other: the curve for CsI then dips by 3 % above the K edges and falls by 4 % from 20 to 15 keV, the middle
# of what the reviews show. Samples differ; the size of the curve, and a power of energy beside it, are for a calibration.
_BIRKS_MEV_CM2_G = 40.0
_ONSAGER_MEV_CM2_G = 8.0
_MISSING_SHARE = 0.4
_SMALLEST_KEV = 0.05
_REFERENCE_KEV = 50.0
_L_SHARE = 0.5  # L vacancies: half of the binding energy goes to one Auger electron, the rest to slower ones


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shell:
    """A K shell: which part of the photoelectric interactions above its edge it takes, and what follows from its vacancy."""

    edge_keV: float
    share: FloatArray
    fluorescence: float
    line_keV: float
    l_edge_keV: float


def electron_response(material: Material, energy_keV: ArrayLike) -> FloatArray:
    """Light for each keV of an electron stopped in the material, relative (any shape), by energy (keV).

    f(e) = (1 / e) int_0^e (1 - w exp(-S / S_O)) / (1 + S / S_B) de', with S(e') the mass stopping power of slow electrons
    (Joy and Luo's form of Bethe's). f is normalised to 1 at 662 keV.

    Source: form, Payne et al. (2009), IEEE Trans Nucl Sci 56:2506; stopping power, Joy and Luo (1989), Scanning 11:176.
    """
    nodes, response = _electron_curve(material.name, _atoms(material))
    energy = np.maximum(np.asarray(energy_keV, dtype=float), _SMALLEST_KEV)
    return np.asarray(np.interp(np.log(energy), np.log(nodes), response))


def light_per_keV(material: Material | str, energies_keV: ArrayLike) -> FloatArray:
    """Logarithm of the light for each keV that photons (n,) leave in a scintillator, over that at 50 keV.

    A photoelectric interaction in the L shells or further out makes an electron of E less the L edge and slower ones with
    the rest. In the K shell it makes an electron of E less the K edge; the vacancy gives a K photon, which is stopped as
    one in the L shell, or an Auger electron with two L vacancies. What a K photon takes away by escape is not in it.

    Args:
        material: the scintillator, or its name.
        energies_keV: photon energies (n,), above 1 keV.

    Returns:
        (n,), 0 at 50 keV; of the published size, which samples and readout times vary by as much.

    Example:
        >>> import numpy as np
        >>> below, above = light_per_keV("CsI", np.array([32.0, 37.0]))
        >>> bool(-0.06 < above - below < -0.01)
        True

    Source: Dorenbos, de Haas and van Eijk (1995), IEEE Trans Nucl Sci 42:2190; Mengesha et al. (1998), 45:456; slow
        readout is closer to proportional: Syntfeld-Kazuch et al. (2006), doi:10.1109/NSSMIC.2006.356047.
    """
    known = material_from_name(material) if isinstance(material, str) else material
    energies = np.asarray(energies_keV, dtype=float)
    both = _photon_light(known, np.append(energies, _REFERENCE_KEV))
    return np.asarray(np.log(both[:-1] / both[-1]))


def _photon_light(material: Material, energies_keV: FloatArray) -> FloatArray:
    """Light for each keV of photons (n,) whose whole energy stays."""

    def light(energy_keV: ArrayLike) -> FloatArray:
        energy = np.maximum(np.asarray(energy_keV, dtype=float), 0.0)
        return np.asarray(energy * electron_response(material, energy))

    shells = _k_shells(material, energies_keV)
    l_keV = sum(shell.l_edge_keV for shell in shells) / len(shells) if shells else 0.0

    def outside_k(energy_keV: ArrayLike, l_edge_keV: float) -> FloatArray:
        energy = np.asarray(energy_keV, dtype=float)
        bound = np.where(energy > l_edge_keV, l_edge_keV, 0.0)
        return light(energy - bound) + 2.0 * light(_L_SHARE * bound)

    total = outside_k(energies_keV, l_keV)
    result = total.copy()
    for shell in shells:
        vacancy_l = 2.0 * light(_L_SHARE * shell.l_edge_keV)
        auger = light(shell.edge_keV - 2.0 * shell.l_edge_keV) + 2.0 * vacancy_l
        # a K photon leaves the atom with one L vacancy
        photon = outside_k(shell.line_keV, shell.l_edge_keV) + light(shell.edge_keV - shell.line_keV)
        above = light(energies_keV - shell.edge_keV) + shell.fluorescence * photon + (1.0 - shell.fluorescence) * auger
        result += shell.share * (above - total)
    return np.asarray(result / energies_keV)


def _k_shells(material: Material, energies_keV: FloatArray) -> list[_Shell]:
    import xraylib

    numbers = {symbol: atomic_number_from_symbol(symbol) for symbol in material.mass_fractions}
    parts = {
        symbol: fraction
        * mass_photoelectric_cm2_g(Material(name=symbol, density_g_cm3=1.0, mass_fractions={symbol: 1.0}), energies_keV)
        for symbol, fraction in material.mass_fractions.items()
    }
    whole = np.sum(list(parts.values()), axis=0)
    found = []
    for symbol, number in numbers.items():
        if number < 20:
            continue
        edge_keV = float(xraylib.EdgeEnergy(number, xraylib.K_SHELL))
        jump = 1.0 - 1.0 / float(xraylib.JumpFactor(number, xraylib.K_SHELL))
        found.append(
            _Shell(
                edge_keV=edge_keV,
                share=np.where(energies_keV > edge_keV, jump * parts[symbol] / whole, 0.0),
                fluorescence=float(xraylib.FluorYield(number, xraylib.K_SHELL)),
                line_keV=float(xraylib.LineEnergy(number, xraylib.KA_LINE)),
                l_edge_keV=float(xraylib.EdgeEnergy(number, xraylib.L3_SHELL)),
            )
        )
    return found


def _atoms(material: Material) -> tuple[tuple[int, float], ...]:
    return tuple((atomic_number_from_symbol(symbol), share) for symbol, share in material.mass_fractions.items())


@lru_cache(maxsize=16)
def _electron_curve(name: str, atoms: tuple[tuple[int, float], ...]) -> tuple[FloatArray, FloatArray]:
    """Energies (node,) keV and electron response there, of a material of these (atomic number, mass fraction)."""
    import xraylib

    energy = np.geomspace(_SMALLEST_KEV, 1000.0, 400)
    stopping = np.zeros_like(energy)
    for number, share in atoms:
        weight = float(xraylib.AtomicWeight(number))
        ionisation_keV = 1e-3 * (9.76 * number + 58.5 * number**-0.19 if number > 12 else 11.5 * number)
        inside = 1.166 * (energy + 0.85 * ionisation_keV) / ionisation_keV
        # 78500 keV/cm for unit density, Z / A and keV
        stopping += share * 78.5 * number / weight / energy * np.log(inside)
    local = (1.0 - _MISSING_SHARE * np.exp(-stopping / _ONSAGER_MEV_CM2_G)) / (1.0 + stopping / _BIRKS_MEV_CM2_G)
    light = np.concatenate([[0.0], np.cumsum(0.5 * (local[1:] + local[:-1]) * np.diff(energy))])
    response = (local[0] * energy[0] + light) / energy
    response /= np.interp(662.0, energy, response)
    return energy, np.asarray(response)

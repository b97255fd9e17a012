"""What a detector keeps of each photon: absorption in the sensitive layer, less the K-fluorescence that escapes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..acquisition.setting import Filter
from ..errors import InputError
from ..materials import (
    Library,
    Material,
    atomic_number_from_symbol,
    bins_cut_by_edges,
    energies_inside_bins,
    mass_photoelectric_cm2_g,
    material_from_name,
    mu_per_mm,
    transmission,
)
from .grid import BIN_WIDTH_KEV, energy_grid_keV

FloatArray = NDArray[np.float64]

DEFAULT_SCINTILLATOR = (Filter(material="CsI", thickness_mm=0.5),)

# Elements whose K photons matter: below this energy they travel micrometres and stay.
_LOWEST_K_LINE_KEV = 5.0
# Standard deviation of a counter's pulse height: makers of CdTe and Si counters state 2 to 5 keV full width at half maximum.
COUNTER_SD_KEV = 1.5
# Gauss-Legendre nodes over the cosine of the direction in which a K photon leaves.
_DIRECTIONS = 48


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Response:
    """What one photon of each energy leaves in the detector, averaged over photons that arrive at the cover.

    Fields: energies_keV (n,); interacting_fraction (n,), share that interacts in the sensitive layers;
    absorbed_fraction (n,), D(E), share of the photon's energy that stays; mean_deposited_keV (n,), first moment D E;
    mean_square_deposited_keV2 (n,), second moment; counting. For a counting detector the two moments are counts per
    photon (each photon that interacts weighs 1, so both equal interacting_fraction) although their names keep the keV.
    """

    energies_keV: FloatArray = field(repr=False)
    interacting_fraction: FloatArray = field(repr=False)
    absorbed_fraction: FloatArray = field(repr=False)
    mean_deposited_keV: FloatArray = field(repr=False)
    mean_square_deposited_keV2: FloatArray = field(repr=False)
    counting: bool = False

    def __post_init__(self) -> None:
        for name in (
            "energies_keV",
            "interacting_fraction",
            "absorbed_fraction",
            "mean_deposited_keV",
            "mean_square_deposited_keV2",
        ):
            values = np.array(getattr(self, name), dtype=float)
            values.setflags(write=False)
            object.__setattr__(self, name, values)


def detector_response(
    *,
    energies_keV: ArrayLike,
    scintillator: Sequence[Filter] = DEFAULT_SCINTILLATOR,
    cover: Sequence[Filter] = (),
    counting: bool = False,
    escape: bool = True,
    table: str = "xraylib",
    library: Library | None = None,
    bin_width_keV: float | None = None,
) -> Response:
    """Moments of the energy (keV, keV2) that a photon of each energy leaves in the detector.

    Layer by layer, with A the share that interacts in it, T the share that reaches it, and for each K line j of energy
    E_j the chance p_j that an interaction in the layer ends with a K photon of that line outside the layer:

        interacting = T A,  A = 1 - exp(-mu L)
        mean        = T A (E - sum_j p_j E_j)
        mean square = T A ((1 - sum_j p_j) E^2 + sum_j p_j (E - E_j)^2)
        D           = mean / E

    An interaction leaves the photon's whole energy but for what escapes as K-fluorescence: Compton photons count as
    kept. `k_escape_fractions` gives p_j. A K photon that escapes one layer is not caught in the next one.

    Args:
        energies_keV: (n,) photon energies, 1 to 500 keV.
        scintillator: sensitive layers, the first one met first.
        cover: layers in front of them (dead), the first one met first.
        counting: photon-counting detector: each interacting photon is one count, whatever it leaves.
        escape: False leaves the K-fluorescence out.
        table: attenuation table.
        library: where the names are looked up.
        bin_width_keV: energies are the centres of bins this wide, and a bin that an absorption edge cuts gets the mean
            over the bin; 0: values at the energies; None: the bin width where the energies are the common grid, else 0.

    Raises:
        InputError: no sensitive layer, an unknown material or table, an energy outside 1-500 keV.
    """
    energies = np.asarray(energies_keV, dtype=float)
    if not any(layer.thickness_mm > 0 for layer in scintillator):
        raise InputError(
            "scintillator",
            received="+".join(map(str, scintillator)) or "none",
            expected="at least one layer of more than 0 mm",
            remedy="for example CsI:0.5",
        )
    moments = _moments(energies, scintillator, cover, escape=escape, table=table, library=library)
    if bin_width_keV is None:
        on_grid = np.array_equal(energies, energy_grid_keV(500.0)[: energies.size])
        bin_width_keV = BIN_WIDTH_KEV if on_grid else 0.0
    if bin_width_keV > 0:
        materials = [material_from_name(layer.material, library=library) for layer in (*cover, *scintillator)]
        cut = bins_cut_by_edges(materials, energies, bin_width_keV=bin_width_keV)
        if np.any(cut):
            inside = energies_inside_bins(energies[cut], bin_width_keV=bin_width_keV)
            finer = _moments(inside.ravel(), scintillator, cover, escape=escape, table=table, library=library)
            moments[:, cut] = finer.reshape(3, *inside.shape).mean(axis=-1)
    interacting, mean, mean_square = moments
    return Response(
        energies_keV=energies,
        interacting_fraction=interacting,
        absorbed_fraction=mean / energies,
        mean_deposited_keV=interacting if counting else mean,
        mean_square_deposited_keV2=interacting if counting else mean_square,
        counting=counting,
    )


def _moments(
    energies: FloatArray,
    scintillator: Sequence[Filter],
    cover: Sequence[Filter],
    *,
    escape: bool,
    table: str,
    library: Library | None,
) -> FloatArray:
    """(3, n): share that interacts, first and second moment of the deposited energy, at the energies themselves."""
    reaching = transmission(cover, energies, table=table, library=library)
    moments = np.zeros((3, energies.size))
    for layer in scintillator:
        if layer.thickness_mm == 0:
            continue
        material = material_from_name(layer.material, library=library)
        passed = np.exp(-mu_per_mm(material, energies, table=table) * layer.thickness_mm)
        share = reaching * (1.0 - passed)
        kept_keV = energies.copy()
        kept_keV2 = energies**2
        if escape:
            escaping = k_escape_fractions(material, energies, thickness_mm=layer.thickness_mm, table=table)
            for line_keV, fraction in escaping:
                kept_keV -= fraction * line_keV
                kept_keV2 += fraction * ((energies - line_keV) ** 2 - energies**2)
        moments += share * np.stack([np.ones_like(energies), kept_keV, kept_keV2])
        reaching = reaching * passed
    return moments


def counted_fraction(
    *,
    energies_keV: ArrayLike,
    threshold_keV: ArrayLike,
    layer: Filter,
    escape: bool = True,
    shared: bool = False,
    library: Library | None = None,
) -> FloatArray:
    """Counts that a photon makes which interacts in a counter's sensitive layer: of the charges that lie above the threshold.

    With p_j the chance that a K photon of energy E_j leaves the layer, and c(E) the counts of an energy E that stays:

        (1 - sum_j p_j) c(E) + sum_j p_j c(E - E_j)

    c = Phi(z), z = (E - T) / s, the normal distribution, where one pixel has all of the charge. Where two pixels share it, at
    random, each of them counts if its part lies above T: c = 2 <max(0, 1 - T / E)> = 2 (s / E) (z Phi(z) + phi(z)).

    Args:
        energies_keV: (n,) photon energies.
        threshold_keV: (m,) thresholds T; 0 counts all charge, in each pixel that has some.
        layer: the sensitive layer.
        escape: False leaves the K photons out.
        shared: whether two pixels share every charge.
        library: where the name is looked up.

    Returns:
        (m, n), 0 to 1; 0 to 2 of shared charges.

    Raises:
        InputError: an unknown material, or a layer without thickness.

    Example:
        >>> from raytwin.acquisition.setting import Filter
        >>> from raytwin.spectra.detector import counted_fraction
        >>> found = counted_fraction(energies_keV=[15.0, 60.0], threshold_keV=[20.0], layer=Filter(material="Si", thickness_mm=0.3))
        >>> [float(round(one, 3)) for one in found[0]]
        [0.0, 1.0]
    """
    from scipy.special import ndtr

    if not layer.thickness_mm > 0:
        raise InputError("layer", received=str(layer), expected="a thickness above 0 mm", remedy="for example CdTe:1")
    energies = np.asarray(energies_keV, dtype=float)
    thresholds = np.asarray(threshold_keV, dtype=float)[:, None]
    material = material_from_name(layer.material, library=library)
    escaping = k_escape_fractions(material, energies, thickness_mm=layer.thickness_mm) if escape else []
    kept = 1.0 - np.sum([fraction for _, fraction in escaping], axis=0) if escaping else np.ones_like(energies)

    def counts(left_keV: FloatArray) -> FloatArray:
        z = (left_keV - thresholds) / COUNTER_SD_KEV
        if not shared:
            return np.asarray(ndtr(z))
        above_keV = COUNTER_SD_KEV * (z * ndtr(z) + np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi))
        return np.asarray(2.0 * above_keV / np.maximum(left_keV, COUNTER_SD_KEV))

    found = kept * counts(energies)
    for line_keV, fraction in escaping:
        found += fraction * counts(energies - line_keV)
    return np.where(thresholds > 0, found, 2.0 if shared else 1.0)


def k_escape_fractions(
    material: Material, energies_keV: ArrayLike, *, thickness_mm: float, table: str = "xraylib"
) -> list[tuple[float, FloatArray]]:
    """Energy (keV) of each K line of a layer, and the chance that an interaction in it sends one such photon out.

    p_j(E) = (w_i tau_i / (mu/rho)) (1 - 1/J_i) omega_i f_j G_j(E) above the K edge of element i, 0 below, with tau_i
    the photoelectric coefficient, J_i the K jump ratio, omega_i the K yield, f_j the share of the line group (K-alpha,
    K-beta) and G_j the geometric escape: interactions lie along the depth z as mu exp(-mu z), K photons leave in all
    directions alike and are kept at their first interaction (mu_j), in a layer without edges:

        G = 1/2 int_0^1 dc int_0^L dz mu exp(-mu z) / (1 - exp(-mu L)) [exp(-mu_j z / c) + exp(-mu_j (L - z) / c)]

    The layer is flat and as wide as needed; a K photon that excites another element (cadmium and tellurium) is kept.

    Args:
        material: the layer's material.
        energies_keV: (n,) photon energies.
        thickness_mm: its thickness, above 0.
        table: attenuation table.

    Returns:
        One (line_keV, fraction (n,)) for each line group of each element whose K lines are above 5 keV.

    Source: Chan and Doi (1983), Phys Med Biol 28:565, for the geometry; line data of xraylib (JumpFactor, FluorYield,
        RadRate, LineEnergy).
    Checked against: photons followed one by one (tests/test_spectra_detector.py).
    """
    import xraylib

    energies = np.asarray(energies_keV, dtype=float)
    mu = mu_per_mm(material, energies, table=table)
    cosines, weights = np.polynomial.legendre.leggauss(_DIRECTIONS)
    cosines, weights = 0.5 * (cosines + 1.0), 0.5 * weights
    found: list[tuple[float, FloatArray]] = []
    for symbol, mass_fraction in material.mass_fractions.items():
        number = atomic_number_from_symbol(symbol)
        if number < 20:
            continue  # K lines below 4 keV
        edge_keV = float(xraylib.EdgeEnergy(number, xraylib.K_SHELL))
        if not np.any(energies > edge_keV):
            continue
        element = Material(name=symbol, density_g_cm3=1.0, mass_fractions={symbol: 1.0})
        photoelectric = mass_fraction * mass_photoelectric_cm2_g(element, energies) * material.density_g_cm3 / 10.0
        vacancy = (1.0 - 1.0 / float(xraylib.JumpFactor(number, xraylib.K_SHELL))) * np.where(
            energies > edge_keV, photoelectric / mu, 0.0
        )
        fluorescence = float(xraylib.FluorYield(number, xraylib.K_SHELL))
        for group in (xraylib.KA_LINE, xraylib.KB_LINE):
            line_keV = float(xraylib.LineEnergy(number, group))
            if line_keV < _LOWEST_K_LINE_KEV:
                continue
            share = float(xraylib.RadRate(number, group))
            mu_line = float(mu_per_mm(material, line_keV, table=table))
            escape = _escape(mu, mu_line, thickness_mm, cosines) @ weights
            found.append((line_keV, vacancy * fluorescence * share * escape))
    return found


def _escape(mu: FloatArray, mu_line: float, thickness_mm: float, cosines: FloatArray) -> FloatArray:
    """(n, directions) chance of escape to front and back, each direction taken half of the time."""
    depth = (mu * thickness_mm)[:, None]
    slant = (mu_line * thickness_mm / cosines)[None, :]
    # int_0^1 x exp(-x s) exp(-a s) ds for depth x and slant a, and with a (1 - s) in place of a s
    front = depth * _mean_exponential(depth + slant)
    back = depth * np.exp(-np.minimum(depth, slant)) * _mean_exponential(np.abs(slant - depth))
    return np.asarray(0.5 * (front + back) / -np.expm1(-depth), dtype=float)


def _mean_exponential(x: FloatArray) -> FloatArray:
    """int_0^1 exp(-x s) ds = (1 - exp(-x)) / x, for x >= 0."""
    return np.where(x > 1e-12, -np.expm1(-x) / np.where(x > 1e-12, x, 1.0), 1.0)

"""What the lab's scintillator does with a photon, and the few classes of photons that the sampling draws from."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from .attenuation import composition, mu_per_mm
from .chain import tail_kernel
from .light import relative_yield
from .system import LabSystem
from .tube import Beam, beam

Array = NDArray[np.float64]

OUTPUT_KV = 60.0  # where `output_exponent` changes nothing
ENERGY_GROUPS = 40
DEPOSIT_CLASSES = 10
# A class of object thickness in the middle of what is inspected: groups are merged so that they are best there.
_TYPICAL_MM = 12.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Deposits:
    """What photons of each energy leave in the scintillator.

    Fields: energy_index (n,) which energy of the beam; deposit_keV (n,), as light; probability (n,) per photon that arrives, so
    that the sum over one energy is the fraction absorbed.
    """

    energy_index: NDArray[np.intp]
    deposit_keV: Array
    probability: Array


def _k_lines(element: str) -> list[tuple[float, float]]:
    """The K lines as two, alpha and beta: (energy in keV, share of K fluorescence)."""
    import xraydb

    lines = xraydb.xray_lines(element, "K")
    result = []
    for letter in ("a", "b"):
        chosen = [line for name, line in lines.items() if name.startswith(f"K{letter}")]
        share = sum(line.intensity for line in chosen)
        result.append((sum(line.energy * line.intensity for line in chosen) / share / 1000.0, share))
    total = sum(share for _, share in result)
    return [(energy, share / total) for energy, share in result]


def _escape_probability(
    mu_in: Array, mu_line_per_mm: float, thickness_mm: float, *, layer_mm: tuple[float, float] | None = None
) -> Array:
    """Chance that a fluorescence photon leaves a slab through either face, for photons absorbed with `mu_in` (per mm).

    Mean over the depth z, of density mu exp(-mu z) / (1 - exp(-mu L)), of [E2(mu_k z) + E2(mu_k (L - z))] / 2; of photons
    absorbed in a layer (from, to) of the depth alone where one is given.
    """
    from scipy.special import expn

    begin_mm, end_mm = layer_mm or (0.0, thickness_mm)
    nodes, weights = np.polynomial.legendre.leggauss(96)
    # A square maps the nodes towards the entrance face, where nearly all photons stop when the slab is thick.
    u = 0.5 * (nodes + 1.0)
    depth_mm = begin_mm + (end_mm - begin_mm) * u**2
    measure_mm = 0.5 * weights * 2.0 * (end_mm - begin_mm) * u
    leave = 0.5 * (expn(2, mu_line_per_mm * depth_mm) + expn(2, mu_line_per_mm * (thickness_mm - depth_mm)))
    density = mu_in[:, None] * np.exp(-mu_in[:, None] * depth_mm[None, :])
    result: Array = (density * leave * measure_mm).sum(axis=1) / (density * measure_mm).sum(axis=1)
    return result


DEPTH_LAYERS = 4
_LOWEST_EDGE_KEV = 10.0  # K photons of lighter elements never get out


def compute_deposits(
    energy_keV: Array,
    *,
    scintillator_mm: float,
    scintillator: str = "CsI",
    k_escape_share: float = 1.0,
    light_curve: float = 0.0,
    depth_light: float = 0.0,
) -> Deposits:
    """Energies left in a scintillator, as light in keV, and their probabilities per arriving photon.

    A photon is absorbed with D = 1 - exp(-mu L). Above a K edge, the share tau_i / mu (1 - 1/J) omega of the absorbed
    ones makes a K photon, which leaves through a face with the probability of `_escape_probability` and takes its
    energy along; everything else deposits all of E. Scattered photons that leave are not followed. Light is in proportion
    to the deposit unless `light_curve` or `depth_light` say otherwise.

    Args:
        energy_keV: (n,) energies of the beam, 3 to 300 keV.
        scintillator_mm: solid-density thickness L.
        scintillator: material.
        k_escape_share: of the K photons that would leave a bare slab, how many do (columns and covers catch some).
        light_curve: how far the light goes with `light.relative_yield` (0: in proportion to the deposit).
        depth_light: light of the exit face over that of the entrance, less 1; linear in the depth, 1 in the middle.

    Source: edge jumps, yields and lines from xraydb (Elam, Ravel and Sieber 2002), attenuation from Chantler.
    """
    import xraydb

    mu = mu_per_mm(scintillator, energy_keV)
    fractions, density_g_cm3 = composition(scintillator)
    index, deposit, probability = [], [], []
    everywhere = np.arange(energy_keV.size)

    def light_keV(left_keV: Array, *, of_photon: bool) -> Array:
        if light_curve == 0.0:
            return left_keV
        return left_keV * (1.0 + light_curve * (relative_yield(scintillator, left_keV, of_photon=of_photon) - 1.0))

    bounds_mm = np.linspace(0.0, scintillator_mm, (DEPTH_LAYERS if depth_light else 1) + 1)
    for begin_mm, end_mm in pairwise(bounds_mm):
        bright = 1.0 + depth_light * (0.5 * (begin_mm + end_mm) / scintillator_mm - 0.5)
        absorbed = np.exp(-mu * begin_mm) * -np.expm1(-mu * (end_mm - begin_mm))
        full = absorbed.copy()
        # what leaves it all first, the array filled below
        index.append(everywhere)
        deposit.append(bright * light_keV(energy_keV, of_photon=True))
        probability.append(full)
        for element, fraction in fractions.items():
            edge = xraydb.xray_edge(element, "K")
            above = np.flatnonzero(energy_keV > edge.energy / 1000.0)
            if above.size == 0 or edge.energy / 1000.0 < _LOWEST_EDGE_KEV or k_escape_share == 0.0:
                continue
            photo = np.asarray(xraydb.mu_chantler(element, energy_keV[above] * 1000.0, photo=True))
            share = fraction * photo * density_g_cm3 / 10.0 / mu[above] * (1.0 - 1.0 / edge.jump_ratio) * edge.fyield
            for line_keV, line_share in _k_lines(element):
                mu_line = float(mu_per_mm(scintillator, np.array([line_keV]))[0])
                out = _escape_probability(mu[above], mu_line, scintillator_mm, layer_mm=(begin_mm, end_mm))
                leaves = absorbed[above] * share * line_share * k_escape_share * out
                # Chantler's edge may lie a few eV off the line table's: no deposit may be negative.
                left_keV = energy_keV[above] - line_keV
                leaves = np.where(left_keV > 0, leaves, 0.0)
                full[above] -= leaves
                index.append(above)
                deposit.append(bright * light_keV(np.maximum(left_keV, 0.0), of_photon=False))
                probability.append(leaves)
    return Deposits(
        energy_index=np.concatenate(index),
        deposit_keV=np.concatenate(deposit),
        probability=np.concatenate(probability),
    )


def deposits_of(system: LabSystem, energy_keV: Array) -> Deposits:
    """Deposits in a system's scintillator, as `compute_deposits`."""
    return compute_deposits(
        energy_keV,
        scintillator_mm=system.scintillator_mm,
        scintillator=system.scintillator,
        k_escape_share=system.k_escape_share,
        light_curve=system.light_curve,
        depth_light=system.depth_light,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Incidence:
    """The beam at the detector, in classes that can be sampled.

    Energies are merged into groups for the transmission of objects (mean attenuation of the group's detected energy
    behind 12 mm of chicken), deposits into classes for the sampling. The rate of a class is the photons absorbed into
    it, scaled so that each class keeps its sum of deposits exactly, behind any object, and its sum of squared deposits
    exactly for the typical object. With 40 groups and 10 classes the signal stays within 0.1 % and the variance within
    0.3 % of the sums over 0.5 keV bins, from 0 to 30 mm of chicken with up to 3 mm of bone, 40 to 90 kV behind 50 um of
    copper (checked in tests/test_lab_response.py; 0.05 % and 0.15 % in the default system).

    Fields: photons_per_mAs (group,) arriving in a pixel without object; group_keV (group,) mean energies;
    class_share (group, class) rate of each class per arriving photon; deposit_keV (class,);
    mu_of: material -> (group,) attenuation per mm.
    """

    photons_per_mAs: Array
    group_keV: Array
    class_share: Array
    deposit_keV: Array
    mu_of: Mapping[str, Array]

    def rates_per_mAs(self, thickness_mm: Mapping[str, Array] | None = None) -> Array:
        """Photons absorbed per pixel and mAs, by class (..., class), behind path lengths of materials (...)."""
        thickness_mm = thickness_mm or {}
        shape = np.broadcast_shapes(*(np.shape(length) for length in thickness_mm.values()))
        exponent = np.zeros((*shape, self.photons_per_mAs.size))
        for material, length in thickness_mm.items():
            exponent = exponent + np.asarray(length)[..., None] * self.mu_of[material]
        rates: Array = (self.photons_per_mAs * np.exp(-exponent)) @ self.class_share
        return rates


def photons_per_pixel_mAs(system: LabSystem, light: Beam) -> Array:
    """Photons per energy bin, pixel and mAs at the detector: Phi kappa a^2 (1 m / d)^2."""
    solid = (1000.0 / system.source_detector_mm) ** 2 * system.pixel_mm**2
    result: Array = light.photons_per_mAs_mm2 * system.tube_output * solid
    return result


def beam_of(system: LabSystem, *, kV: float, filters: tuple[Filter, ...]) -> Beam:
    """The beam of a system at a voltage that was set, as it falls on the scintillator: anode, filters and covers applied."""
    rough = (Filter(material="W", thickness_mm=system.anode_rough_um / 1000.0),) if system.anode_rough_um else ()
    light = beam(
        kV=kV * (1.0 + system.kV_offset_percent / 100.0),
        anode_angle_deg=system.anode_angle_deg,
        filters=(*rough, *system.inherent_filtration, *filters, *system.cover),
        model=system.tube_model,
        ripple_percent=system.kV_ripple_percent,
    )
    if system.output_exponent == 0.0:
        return light
    factor = (kV / OUTPUT_KV) ** system.output_exponent
    return Beam(energy_keV=light.energy_keV, photons_per_mAs_mm2=light.photons_per_mAs_mm2 * factor)


def _edges_of_equal_share(weights: Array, count: int) -> NDArray[np.intp]:
    """Group number of each of the ordered entries, in at most `count` contiguous groups of about equal weight."""
    upto = np.cumsum(weights) - 0.5 * weights
    group = np.minimum((upto / weights.sum() * count).astype(np.intp), count - 1)
    # Numbers without a member are closed up.
    _, renumbered = np.unique(group, return_inverse=True)
    return renumbered.astype(np.intp)


def compute_incidence(
    system: LabSystem,
    *,
    kV: float,
    filters: tuple[Filter, ...],
    materials: tuple[str, ...] = (),
) -> Incidence:
    """The beam of a system at a kV and filter in sampling classes.

    Args:
        system: the truth.
        kV: as set.
        filters: as set.
        materials: what objects are made of.
    """
    return _incidence(system, float(kV), tuple(filters), tuple(materials))


@lru_cache(maxsize=32)
def _incidence(
    system: LabSystem,
    kV: float,
    filters: tuple[Filter, ...],
    materials: tuple[str, ...],
) -> Incidence:
    light = beam_of(system, kV=kV, filters=filters)
    photons = photons_per_pixel_mAs(system, light)
    heard = photons > 1e-12 * photons.max()
    if not heard.any():
        raise InputError(
            "filter", received="+".join(map(str, filters)), expected="a filter that lets some of the beam through"
        )
    light = Beam(energy_keV=light.energy_keV[heard], photons_per_mAs_mm2=light.photons_per_mAs_mm2[heard])
    photons = photons[heard]
    deposits = deposits_of(system, light.energy_keV)
    # A trace of the open beam, so that energies of which the typical object leaves nothing still have a mean.
    typical = photons * (np.exp(-mu_per_mm("chicken_breast", light.energy_keV) * _TYPICAL_MM) + 1e-9)
    energy_signal = np.bincount(deposits.energy_index, deposits.deposit_keV * deposits.probability)

    # Groups hold equal shares of the detected energy, half counted in the open beam, half behind the typical object.
    open_signal, typical_signal = photons * energy_signal, typical * energy_signal
    group = _edges_of_equal_share(
        open_signal / open_signal.sum() + typical_signal / typical_signal.sum(), ENERGY_GROUPS
    )
    n_groups = int(group[-1]) + 1
    in_group: Array = np.bincount(group, photons, n_groups).astype(np.float64)
    signal_in_group = np.bincount(group, typical_signal, n_groups)
    mu_of = {
        material: np.bincount(group, typical_signal * mu_per_mm(material, light.energy_keV), n_groups) / signal_in_group
        for material in materials
    }
    group_keV = np.bincount(group, typical_signal * light.energy_keV, n_groups) / signal_in_group

    rate = photons[deposits.energy_index] * deposits.probability
    typical_rate = typical[deposits.energy_index] * deposits.probability
    order = np.argsort(deposits.deposit_keV, kind="stable")
    # Half equal shares of the variance behind the typical object, half equal steps of energy: no class is wide.
    spread = typical_rate * deposits.deposit_keV**2
    steps = np.diff(deposits.deposit_keV[order], prepend=0.0)
    klass = np.empty(order.size, dtype=np.intp)
    klass[order] = _edges_of_equal_share(spread[order] / spread.sum() + steps / steps.sum(), DEPOSIT_CLASSES)
    n_classes = int(klass.max()) + 1
    deposit_keV = np.bincount(klass, typical_rate * deposits.deposit_keV**2, n_classes) / np.bincount(
        klass, typical_rate * deposits.deposit_keV, n_classes
    )
    share = np.zeros((n_groups, n_classes))
    np.add.at(
        share,
        (group[deposits.energy_index], klass),
        rate * deposits.deposit_keV / deposit_keV[klass] / in_group[group[deposits.energy_index]],
    )
    return Incidence(
        photons_per_mAs=in_group,
        group_keV=group_keV,
        class_share=share,
        deposit_keV=deposit_keV,
        mu_of=mu_of,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """What the lab itself expects of one pixel at one kV and filter, per mAs, without object.

    Fields: photons_absorbed_per_mAs, energy_keV_per_mAs (sum of deposits), squared_keV2_per_mAs (sum of their squares).
    """

    photons_absorbed_per_mAs: float
    energy_keV_per_mAs: float
    squared_keV2_per_mAs: float


def compute_level(
    system: LabSystem, *, kV: float, filters: tuple[Filter, ...], thickness_mm: Mapping[str, float] | None = None
) -> Level:
    """Sums over all 0.5 keV bins (no groups) of what a pixel absorbs per mAs, behind uniform layers."""
    light = beam_of(system, kV=kV, filters=filters)
    photons = photons_per_pixel_mAs(system, light)
    for material, length in (thickness_mm or {}).items():
        photons = photons * np.exp(-mu_per_mm(material, light.energy_keV) * length)
    deposits = deposits_of(system, light.energy_keV)
    rate = photons[deposits.energy_index] * deposits.probability
    return Level(
        photons_absorbed_per_mAs=float(rate.sum()),
        energy_keV_per_mAs=float((rate * deposits.deposit_keV).sum()),
        squared_keV2_per_mAs=float((rate * deposits.deposit_keV**2).sum()),
    )


def level_of_groups(incidence: Incidence, thickness_mm: Mapping[str, float] | None = None) -> Level:
    """The same sums over the classes that are sampled: what the frames really are drawn from."""
    lengths = {material: np.asarray(float(length)) for material, length in (thickness_mm or {}).items()}
    rates = incidence.rates_per_mAs(lengths)
    return Level(
        photons_absorbed_per_mAs=float(rates.sum()),
        energy_keV_per_mAs=float((rates * incidence.deposit_keV).sum()),
        squared_keV2_per_mAs=float((rates * incidence.deposit_keV**2).sum()),
    )


def gain_DN(system: LabSystem, level: Level, *, DN_per_electron: float) -> float:
    """Variance over signal (DN) with the blur's share restored, electronic noise left out.

    g = c y <l^2> / (A <l>) + c, with c DN per electron, y electrons per keV, l the deposit, A the Swank factor of the
    light; the last c is the electrons' own Poisson noise.
    """
    quantum_keV = level.squared_keV2_per_mAs / level.energy_keV_per_mAs / system.light_swank
    return DN_per_electron * system.electrons_per_keV * quantum_keV + DN_per_electron


def aperture_share(psf_sigma_px: float, lag_px: int = 0) -> float:
    """Autocovariance along one axis of white quanta seen through pixel and Gaussian, per variance of the quanta.

    C(n) = int H(x) H(x + n) dx, H(x) = Phi((x + 1/2) / sigma) - Phi((x - 1/2) / sigma): the second difference of
    F(n) = n/2 erf(n / (2 sigma)) + sigma / sqrt(pi) exp(-n^2 / (4 sigma^2)). In two dimensions the shares multiply.
    """

    def primitive(n: float) -> float:
        if psf_sigma_px < 1e-6:  # sharper than any sum could tell, and beyond it the squares overflow
            return abs(n) / 2.0
        return n / 2.0 * math.erf(n / (2.0 * psf_sigma_px)) + psf_sigma_px / math.sqrt(math.pi) * math.exp(
            -((n / (2.0 * psf_sigma_px)) ** 2)
        )

    return primitive(lag_px + 1.0) - 2.0 * primitive(float(lag_px)) + primitive(lag_px - 1.0)


def noise_shares(system: LabSystem, lag_rows: int = 0, lag_columns: int = 0) -> float:
    """Autocovariance of white quanta seen through pixel, core and tail at a lag, per variance of the quanta.

    The core's share of `aperture_share` along rows and columns, summed over the autocorrelation of the shares of light
    that stay and that the tail takes elsewhere: exact far from the borders.
    """
    down, across = system.core_px
    if system.tail_share == 0.0:
        return aperture_share(down, lag_rows) * aperture_share(across, lag_columns)
    kernel = system.tail_share * tail_kernel(system.tail_law, system.tail_length_px)
    middle = kernel.shape[0] // 2
    kernel[middle, middle] += 1.0 - system.tail_share
    spectrum = np.abs(np.fft.rfft2(kernel, s=(4 * middle + 2, 4 * middle + 2))) ** 2
    alike = np.fft.irfft2(spectrum, s=(4 * middle + 2, 4 * middle + 2))
    lags = np.arange(-2 * middle, 2 * middle + 1)
    by_row = np.array([aperture_share(down, int(lag_rows - lag)) for lag in lags])
    by_column = np.array([aperture_share(across, int(lag_columns - lag)) for lag in lags])
    return float(by_row @ alike[np.ix_(lags, lags)] @ by_column)


def equivalent_sigma_px(system: LabSystem) -> float:
    """Width of the Gaussian that would leave the same share of the quanta's variance in a pixel (px)."""
    from scipy.optimize import brentq

    wanted = math.sqrt(noise_shares(system))
    if wanted >= aperture_share(0.0):
        return 0.0
    return float(brentq(lambda sigma: aperture_share(sigma) - wanted, 1e-6, 20.0))


def tube_load_mAs(setting: Setting) -> float:
    """Charge of one frame (mAs); a setting without current or power cannot be measured."""
    load = setting.tube_load_mAs
    if load is None:
        raise InputError(
            "setting",
            received=str(setting),
            expected="a tube current or power",
            remedy="add power_w=... or current_ma=...",
        )
    return load

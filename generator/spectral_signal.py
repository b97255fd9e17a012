"""Signal, gain and photon number of an open beam from tube, filters and scintillator, for many parameter sets at once.

Per mAs, at distance d, on a pixel of pitch a (mean deposited energy m1(E), its mean square m2(E), interacting
fraction D(E)):

    N(E)    = kappa Phi(E; kV (1 + e)) (kV / 60)^x (E / 50)^h exp(-sum mu t) (1000 / d)^2 a^2
    signal  = gamma sum N m1            gain = (gamma / A_S) sum N m2 / sum N m1            absorbed = sum N D

for energy-integrating detectors; a counting detector has m1 = m2 = D. gamma is in DN per keV absorbed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter
from ..errors import InputError
from ..materials import material_from_name, mu_per_mm, transmission
from ..spectra import (
    BIN_WIDTH_KEV,
    MAXIMUM_KV,
    MAXIMUM_KV_OF_ANODE,
    MINIMUM_KV,
    detector_response,
    energy_grid_keV,
    tube_fluence_interpolated,
)

REFERENCE_KV = 60.0
REFERENCE_KEV = 50.0
FIXED_PARAMETERS = (
    "inherent_filtration_mm_Al",
    "log_scintillator_thickness",
    "kV_error",
    "log_output",
    "log_DN_per_keV",
    "log_swank",
    "yield_exponent",
    "hardness_exponent",
)
_KV_ERRORS = np.linspace(-0.06, 0.06, 25)  # nodes of the tube voltage error; between them linear, 3e-6 of the signal
_LOG_THICKNESS = np.linspace(-1.6, 1.6, 33)  # nodes of the scintillator thickness


def attenuation_scale_name(material: str) -> str:
    """Name of the parameter that scales a filter material's attenuation table."""
    return f"log_mu_{material}"


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenBeam:
    """One open-beam setting as the spectrum sees it: kV and filters; rates are per mAs at 1 m and 1 mm2 of pixel."""

    kV: float
    filters: tuple[Filter, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamSignal:
    """What a beam gives (draw,): rate_DN_per_mAs, gain_DN (variance per signal), absorbed_per_mAs, kerma_uGy_per_mAs,
    mean_square_energy ratio folded into the gain; all at 1 m and 1 mm2."""

    rate_DN_per_mAs: NDArray[np.float64]
    gain_DN: NDArray[np.float64]
    absorbed_per_mAs: NDArray[np.float64]
    kerma_uGy_per_mAs: NDArray[np.float64]


class SpectralModel:
    """Tables of one tube and scintillator, from which signals of many parameter sets follow by sums over energy.

    The state is a cache: what each kV and material looks like on the common energy grid.
    """

    def __init__(
        self,
        *,
        anode: str = "W",
        anode_angle_deg: float = 12.0,
        model: str = "casim",
        inherent: Sequence[Filter] = (),
        scintillator: Sequence[Filter] = (Filter(material="CsI", thickness_mm=0.5),),
        cover: Sequence[Filter] = (),
        counting: bool = False,
        filter_materials: Sequence[str] = (),
        highest_kV: float = 160.0,
    ) -> None:
        self.anode = anode
        self.anode_angle_deg = anode_angle_deg
        self.model = model
        self.inherent = tuple(inherent)
        self.scintillator = tuple(scintillator)
        self.cover = tuple(cover)
        self.counting = counting
        self.filter_materials = tuple(filter_materials)
        self.names = (*FIXED_PARAMETERS, *(attenuation_scale_name(name) for name in self.filter_materials))
        self._index = {name: position for position, name in enumerate(self.names)}
        self.highest_kV = min(highest_kV, MAXIMUM_KV_OF_ANODE.get(anode, MAXIMUM_KV))
        self.energies_keV = energy_grid_keV(1.07 * self.highest_kV)
        self._mu: dict[str, NDArray[np.float64]] = {}
        self._fluence: dict[float, NDArray[np.float64]] = {}
        energies = self.energies_keV
        first, second, share = [], [], []
        for log_scale in _LOG_THICKNESS:
            layers = tuple(
                Filter(material=layer.material, thickness_mm=layer.thickness_mm * float(np.exp(log_scale)))
                for layer in self.scintillator
            )
            response = detector_response(
                scintillator=layers, cover=self.cover, counting=counting, energies_keV=energies
            )
            first.append(response.mean_deposited_keV)
            second.append(response.mean_square_deposited_keV2)
            share.append(response.interacting_fraction)
        self._first, self._second, self._share = np.array(first), np.array(second), np.array(share)
        air = material_from_name("air")
        from ..materials import mass_energy_absorption_cm2_g

        # keV / cm2 -> uGy: 1.602e-16 J / 1e-3 kg; fluence is per cm2
        self._kerma = energies * mass_energy_absorption_cm2_g(air, energies) * 1.602176634e-13 * 1e6
        self._inherent = transmission(self.inherent, energies, bin_width_keV=BIN_WIDTH_KEV)
        self._depth: dict[Filter, NDArray[np.float64]] = {}

    def mu(self, material: str) -> NDArray[np.float64]:
        """Linear attenuation (energy,), 1/mm."""
        if material not in self._mu:
            self._mu[material] = mu_per_mm(material_from_name(material), self.energies_keV)
        return self._mu[material]

    def depth(self, layer: Filter) -> NDArray[np.float64]:
        """Optical depth of a layer (energy,); a bin that an absorption edge cuts has that of its mean transmission."""
        if layer not in self._depth:
            passed = transmission([layer], self.energies_keV, bin_width_keV=BIN_WIDTH_KEV)
            self._depth[layer] = -np.log(np.maximum(passed, 1e-300))
        return self._depth[layer]

    def fluence(self, kV: float) -> NDArray[np.float64]:
        """Unfiltered fluence at the nodes of the kV error (node, energy), photons / keV / cm2 / mAs at 1 m."""
        if kV not in self._fluence:
            if kV > self.highest_kV:
                raise InputError(
                    "kV", received=f"{kV:g} kV", expected=f"at most {self.highest_kV:g} kV, this model's range"
                )
            # beyond the tube's table the nodes stand still; a kV outside it is refused at the node without error
            lowest, highest = MINIMUM_KV, MAXIMUM_KV_OF_ANODE.get(self.anode, MAXIMUM_KV)
            if kV < lowest:
                lowest = 0.0
            self._fluence[kV] = np.array(
                [
                    tube_fluence_interpolated(
                        min(max(kV * (1.0 + float(error)), lowest), highest),
                        energies_keV=self.energies_keV,
                        anode=self.anode,
                        anode_angle_deg=self.anode_angle_deg,
                        model=self.model,
                    )
                    for error in _KV_ERRORS
                ]
            )
        return self._fluence[kV]

    def default_parameters(self) -> NDArray[np.float64]:
        """The parameter set of an uncalibrated line (parameter,): no error, 1 DN a keV, Swank factor 1."""
        return np.zeros(len(self.names))

    def weights(self, samples: NDArray[np.float64], beam: OpenBeam) -> NDArray[np.float64]:
        """Photons of the beam (draw, energy) a bin, mAs and mm2 of pixel at 1 m, for samples (draw, parameter)."""
        kV_error = self._column(samples, "kV_error")
        nodes = self.fluence(beam.kV)
        top = int(np.searchsorted(self.energies_keV, 1.07 * beam.kV)) + 1
        fluence = _interpolate(_KV_ERRORS, nodes[:, :top], kV_error)
        energies = self.energies_keV[:top]
        exponent = -self._column(samples, "inherent_filtration_mm_Al")[:, None] * self.mu("Al")[:top]
        for layer in beam.filters:
            name = attenuation_scale_name(layer.material)
            scale = np.exp(self._column(samples, name)) if name in self._index else np.ones(len(samples))
            exponent = exponent - scale[:, None] * self.depth(layer)[:top]
        exponent = exponent + self._column(samples, "hardness_exponent")[:, None] * np.log(energies / REFERENCE_KEV)
        exponent = (
            exponent
            + (
                self._column(samples, "log_output")
                + self._column(samples, "yield_exponent") * np.log(beam.kV / REFERENCE_KV)
            )[:, None]
        )
        width = energies[1] - energies[0]
        return np.asarray(fluence * self._inherent[:top] * np.exp(exponent) * (width / 100.0))

    def signal(
        self, samples: NDArray[np.float64], beam: OpenBeam, through: NDArray[np.float64] | None = None
    ) -> BeamSignal:
        """Rate, gain and photons of a beam for parameter sets (draw, parameter).

        Args:
            samples: (draw, parameter) in the order of `names`.
            beam: kV and filters.
            through: transmission of an object (energy,) on `energies_keV`, or None.
        """
        photons = self.weights(samples, beam)
        top = photons.shape[1]
        if through is not None:
            photons = photons * through[:top]
        return self._signal_of_photons(samples, photons)

    def signal_of_stacks(
        self, parameters: NDArray[np.float64], *, kV: float, stacks: Sequence[Sequence[Filter]]
    ) -> BeamSignal:
        """Rate, gain and photons (stack,) behind many filter stacks at one kV, for one parameter set (parameter,).

        The same numbers as `signal` gives one by one; the tube's part is made once.
        """
        photons = self.weights(parameters[None, :], OpenBeam(kV=kV, filters=()))
        top = photons.shape[1]
        layers = {layer: row for row, layer in enumerate(dict.fromkeys(layer for one in stacks for layer in one))}
        if layers:
            crossed = np.zeros((len(stacks), len(layers)))
            for row, stack in enumerate(stacks):
                for layer in stack:
                    name = attenuation_scale_name(layer.material)
                    scale = np.exp(parameters[self._index[name]]) if name in self._index else 1.0
                    crossed[row, layers[layer]] += scale
            photons = photons * np.exp(-crossed @ np.array([self.depth(layer)[:top] for layer in layers]))
        else:
            photons = np.repeat(photons, len(stacks), axis=0)
        return self._signal_of_photons(np.repeat(parameters[None, :], len(stacks), axis=0), photons)

    def _signal_of_photons(self, samples: NDArray[np.float64], photons: NDArray[np.float64]) -> BeamSignal:
        """What photons (draw, energy) give, with the scintillator and gains of samples (draw, parameter)."""
        top = photons.shape[1]
        log_thickness = self._column(samples, "log_scintillator_thickness")
        first = _sum_interpolated(_LOG_THICKNESS, self._first[:, :top], log_thickness, photons)
        second = _sum_interpolated(_LOG_THICKNESS, self._second[:, :top], log_thickness, photons)
        absorbed = _sum_interpolated(_LOG_THICKNESS, self._share[:, :top], log_thickness, photons)
        log_gamma = self._column(samples, "log_DN_per_keV")
        gamma = np.exp(log_gamma)
        excess = np.exp(log_gamma - self._column(samples, "log_swank"))
        return BeamSignal(
            rate_DN_per_mAs=gamma * first,
            gain_DN=excess * second / first,
            absorbed_per_mAs=absorbed,
            # photons are per mm2, kerma counts per cm2
            kerma_uGy_per_mAs=100.0 * photons @ self._kerma[:top],
        )

    def _column(self, samples: NDArray[np.float64], name: str) -> NDArray[np.float64]:
        return np.asarray(samples[:, self._index[name]])


def _brackets(nodes: NDArray[np.float64], at: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    clipped = np.clip(at, nodes[0], nodes[-1])
    below = np.clip(np.searchsorted(nodes, clipped, side="right") - 1, 0, len(nodes) - 2)
    share = (clipped - nodes[below]) / (nodes[below + 1] - nodes[below])
    return below, share


def _interpolate(
    nodes: NDArray[np.float64], table: NDArray[np.float64], at: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rows of `table` (node, energy) at positions `at` (draw,), linear between nodes."""
    below, share = _brackets(nodes, at)
    return np.asarray(table[below] * (1.0 - share)[:, None] + table[below + 1] * share[:, None])


def _sum_interpolated(
    nodes: NDArray[np.float64], table: NDArray[np.float64], at: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """sum over energy of weight (draw, energy) times `table` interpolated at `at` (draw,)."""
    below, share = _brackets(nodes, at)
    lowest = int(below.min())
    every = weight @ table[lowest : int(below.max()) + 2].T  # the nodes in use: draws lie close together
    rows = np.arange(len(at))
    column = below - lowest
    return np.asarray(every[rows, column] * (1.0 - share) + every[rows, column + 1] * share)


def gain_behind_object(
    model: SpectralModel,
    parameters: NDArray[np.float64],
    beam: OpenBeam,
    *,
    material: str,
    thickness_mm: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Transmission of the signal and gain over that of the open beam (thickness,), behind a slab of `material`.

    The gain follows <E^2>/<E> of what is absorbed, which rises as the object hardens the beam.
    """
    samples = parameters[None, :]
    open_beam = model.signal(samples, beam)
    mu = model.mu(material)
    rates, gains = [], []
    for thickness in thickness_mm:
        behind = model.signal(samples, beam, through=np.exp(-mu * thickness))
        rates.append(float(behind.rate_DN_per_mAs[0] / open_beam.rate_DN_per_mAs[0]))
        gains.append(float(behind.gain_DN[0] / open_beam.gain_DN[0]))
    return np.array(rates), np.array(gains)

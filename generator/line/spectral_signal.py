"""Signal, gain and photon number of an open beam from tube, filters and scintillator, for many parameter sets at once.

Per mAs, at distance d, on a pixel of pitch a (mean deposited energy m1(E), its mean square m2(E), interacting
fraction D(E)):

    N(E)    = kappa Phi(E; kV (1 + e)) (kV / 60)^x (E / 50)^(h + u ln(kV / 60)) (2 - 2 E / kV)^s exp(-sum mu t) (1000 / d)^2 a^2
    signal  = gamma sum N c l m1    gain = (gamma / A_S) sum N c l^2 m2 (E / 50)^-w / sum N c l m1 + W    absorbed = sum N c D

for energy-integrating detectors; a counting detector has m1 = m2 = D q and l = 1, with q the counts
of a photon that is stopped (`spectra.counted_fraction`). gamma is in DN per keV absorbed or count, s how much
steeper than SpekPy's a spectrum falls to its end point (E below 0.98 kV), e = kV_error + kV_tilt ln(kV / 60), and mu that of
xraylib moved by shares of its differences to two other tables: mu (1 + c (Chantler / xraylib - 1) + p (PENELOPE / xraylib - 1)).
The layers t are those in the beam, the inherent filtration, and micrometres of the anode's own metal (a rough or worn anode). A
tube voltage that varies during an exposure, by a relative variance v about its mean, adds v / 2 kV^2 d2 Phi / d kV2.

c(E) is what covers, glue and dead layers let through, l(E) the light for each keV that stays, over that at 50 keV: the
scintillator's own (`spectra.light_per_keV`), a power of energy, and the depth at which photons of each energy are stopped
(light made nearer to the diodes is less dimmed). w is how the Swank factor goes with energy. K photons that leave take
(1 + escape_scale) of what `spectra.detector_response` says: none at -1.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Filter
from ...errors import InputError
from ...materials import material_from_name, mu_per_mm, transmission
from ...spectra import BIN_WIDTH_KEV, MAXIMUM_KV, MAXIMUM_KV_OF_ANODE, MINIMUM_KV, checked_kV, energy_grid_keV
from .photon_tables import (
    LOG_THICKNESS,
    NODES_KV,
    OTHER_TABLES,
    REFERENCE_KEV,
    THRESHOLDS_KEV,
    brackets,
    counted_tables,
    fluence_at_nodes,
    interpolate,
    levelled,
    log_ratio_of_models,
    response_rows,
    response_tables,
    table_departure,
)

REFERENCE_KV = 60.0
FIXED_PARAMETERS = (
    "inherent_filtration_mm_Al",
    "log_scintillator_thickness",
    "kV_error",
    "log_output",
    "log_DN_per_keV",
    "log_swank",
    "yield_exponent",
    "hardness_exponent",
    "kV_tilt",
    "end_exponent",
    "escape_scale",
    "scintillator_table",
    "anode_roughness_um",
    "kV_variance",
    "hardness_tilt",
)
# what a detector does to photons of each energy beside absorbing them: the powers of exp(parameter x row) in the first and
# second moment of the deposit and in the absorbed share
RESPONSE_PARAMETERS: dict[str, tuple[float, float, float]] = {
    "cover_mm_C": (1.0, 1.0, 1.0),
    "cover_mm_Al": (1.0, 1.0, 1.0),
    "dead_layer_um": (1.0, 1.0, 1.0),
    "light_nonproportionality": (1.0, 2.0, 0.0),
    "light_exponent": (1.0, 2.0, 0.0),
    "light_depth_slope": (1.0, 2.0, 0.0),
    "swank_exponent": (0.0, -1.0, 0.0),
}
_RESPONSE_OF_COUNTERS = ("cover_mm_C", "cover_mm_Al", "dead_layer_um")
_OF_UNDECLARED_COVER = "cover_mm_Al"
THRESHOLD = "threshold_keV"
SHARED_CHARGE = "shared_charge"  # share of the photons of a counter whose charge two pixels share
ALTERNATIVE_SCINTILLATOR = "scintillator_alternative"
# of a tube whose kerma was measured: its output over the flux that the flats saw (fill factor, distances), logarithm
KERMA_OUTPUT = "log_kerma_over_flats"
# parameters that say nothing of the tube: a dosimeter does not notice them
_OF_DETECTOR = (
    "log_DN_per_keV",
    "log_swank",
    "scintillator_table",
    "escape_scale",
    THRESHOLD,
    SHARED_CHARGE,
    *RESPONSE_PARAMETERS,
)
_ABSORBER = "absorber_mm:"
LARGEST_KV_ERROR = 0.2
_USUAL_KV_ERROR = 0.06  # up to it sums end 7 % above the voltage
KV_STEP = 0.02  # relative, of the second difference that a varying voltage takes
_TILT_STEP = 0.002  # relative, of the derivative by the voltage: both sides of a node
_NEAREST_TO_END = 0.02  # of the kV: nearer to the end point it is the voltage that shapes a spectrum
_OTHER_MODEL = "spectrum_model"  # of twins calibrated before 0.3: a share of the other of SpekPy's models
_Term = tuple[NDArray[np.float64], NDArray[np.float64]]  # error of the tube voltage, relative, and weight (draw,) each
_DRAWS_KEPT = 4  # sets of draws whose moments a model remembers: a twin asks with the same ones again and again


def attenuation_scale_name(material: str) -> str:
    """Name of the parameter that scales a filter material's attenuation table."""
    return f"log_mu_{material}"


def table_share_name(table: str, material: str) -> str:
    """Name of the parameter that moves a material's attenuation towards another table."""
    return f"{table}_{material}"


def absorber_thickness_name(absorber: str, material: str) -> str:
    """Name of the parameter that holds how much (mm) of a material an absorber of unknown composition amounts to."""
    return f"{_ABSORBER}{absorber}:{material}"


def absorber_of_parameter(name: str) -> tuple[str, str] | None:
    """The absorber and the material whose thickness a parameter is (`absorber_thickness_name`), or None."""
    if not name.startswith(_ABSORBER):
        return None
    absorber, _, material = name.removeprefix(_ABSORBER).rpartition(":")
    return absorber, material


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenBeam:
    """One open-beam setting as the spectrum sees it: kV and filters; rates are per mAs at 1 m and 1 mm2 of pixel.

    absorber: name of an absorber of unknown composition behind the filters, whose thicknesses are parameters; empty: none.
    """

    kV: float
    filters: tuple[Filter, ...]
    absorber: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpectrumCorrection:
    """Measured spectra over the model's at the same tube voltages: kV (spectrum,), rising, and log_ratio (spectrum, energy).

    The ratio holds at fixed photon energy, as what filters and anodes do; between the measured voltages it is
    interpolated linearly in kV, outside the nearest is kept. relative: the spectra have no absolute scale.
    """

    kV: tuple[float, ...]
    log_ratio: NDArray[np.float64]
    relative: bool

    def at(self, kV: float, bins: int) -> NDArray[np.float64]:
        """Logarithm of the correction on the first `bins` of the common grid (energy,)."""
        below, share = brackets(np.array(self.kV), np.array([kV])) if len(self.kV) > 1 else (np.array([0]), np.zeros(1))
        first = self.log_ratio[below[0]]
        last = self.log_ratio[min(int(below[0]) + 1, len(self.kV) - 1)]
        row = first + share[0] * (last - first)
        if bins > row.size:
            row = np.concatenate([row, np.full(bins - row.size, row[-1])])
        return np.asarray(row[:bins])


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

    `names` are the parameters, in the order of a parameter set; a set of fewer names (an older twin's) can be given, and
    what it lacks counts as 0. A `cover` of None is not declared: how much aluminium it holds is a parameter. `correction`
    brings the tube model to measured spectra. `alternative` is another scintillator, which a parameter of value 1 puts in place
    of the first where the sheet does not say. `secondary_DN` is what secondary quanta add to the variance per signal in every
    beam. The state is a cache: what each kV and material looks like on the common grid.
    """

    def __init__(
        self,
        *,
        anode: str = "W",
        anode_angle_deg: float = 12.0,
        model: str = "casim",
        inherent: Sequence[Filter] = (),
        scintillator: Sequence[Filter] = (Filter(material="CsI", thickness_mm=0.5),),
        alternative: Sequence[Filter] = (),
        cover: Sequence[Filter] | None = (),
        counting: bool = False,
        filter_materials: Sequence[str] = (),
        highest_kV: float = 160.0,
        names: Sequence[str] | None = None,
        correction: SpectrumCorrection | None = None,
        secondary_DN: float = 0.0,
    ) -> None:
        self.anode = anode
        self.anode_angle_deg = anode_angle_deg
        self.model = model
        self.inherent = tuple(inherent)
        self.scintillator = tuple(scintillator)
        self.alternative = tuple(alternative)
        self.cover = tuple(cover or ())
        self.counting = counting
        self.filter_materials = tuple(filter_materials)
        self.correction = correction
        self.secondary_DN = secondary_DN
        every = [*FIXED_PARAMETERS, *(_RESPONSE_OF_COUNTERS if counting else RESPONSE_PARAMETERS)]
        if cover is not None:
            every.remove(_OF_UNDECLARED_COVER)
        every += [ALTERNATIVE_SCINTILLATOR] if self.alternative else []
        every += [THRESHOLD, SHARED_CHARGE] if counting else []
        for material in self.filter_materials:
            every.append(attenuation_scale_name(material))
            every += [table_share_name(table, material) for table in OTHER_TABLES]
        self._named(every if names is None else names)
        self.highest_kV = min(highest_kV, MAXIMUM_KV_OF_ANODE.get(anode, MAXIMUM_KV))
        self.energies_keV = energy_grid_keV((1.01 + LARGEST_KV_ERROR) * self.highest_kV)
        self._mu: dict[str, NDArray[np.float64]] = {}
        self._departures: dict[tuple[str, str], NDArray[np.float64]] = {}
        self._moments_kept: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
        self._other_model: dict[float, NDArray[np.float64]] = {}
        self._responses = [
            response_tables(layers, self.cover, self.counting, self.energies_keV.size)
            for layers in (self.scintillator, self.alternative)
            if layers
        ]
        self._response_names = tuple(name for name in RESPONSE_PARAMETERS if name in self._index)
        self._response_rows = [
            response_rows(layers[0], self.energies_keV.size)
            for layers in (self.scintillator, self.alternative)
            if layers
        ]
        energies = self.energies_keV
        air = material_from_name("air")
        from ...materials import mass_energy_absorption_cm2_g

        # keV / cm2 -> uGy: 1.602e-16 J / 1e-3 kg; fluence is per cm2
        self._kerma = energies * mass_energy_absorption_cm2_g(air, energies) * 1.602176634e-13 * 1e6
        self._inherent = transmission(self.inherent, energies, bin_width_keV=BIN_WIDTH_KEV)
        self._depth: dict[Filter, NDArray[np.float64]] = {}

    @property
    def _tube(self) -> dict[str, Any]:
        """What tables of fluence are asked with."""
        return {
            "anode": self.anode,
            "anode_angle_deg": self.anode_angle_deg,
            "model": self.model,
            "energies_keV": self.energies_keV,
        }

    def _departure(self, material: str, table: str) -> NDArray[np.float64]:
        """Another table's attenuation over xraylib's, less 1 (energy,)."""
        key = (material, table)
        if key not in self._departures:
            self._departures[key] = table_departure(material, table, self.energies_keV)
        return self._departures[key]

    def with_parameters(self, names: Sequence[str]) -> "SpectralModel":
        """The same model with more parameters, behind its own; the tables are shared."""
        result = copy(self)
        result._named((*self.names, *(name for name in names if name not in self._index)))
        return result

    def _named(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self._index = {name: position for position, name in enumerate(self.names)}
        self._absorbers: dict[str, dict[str, str]] = {}
        for name in self.names:
            found = absorber_of_parameter(name)
            if found is not None:
                self._absorbers.setdefault(found[0], {})[name] = found[1]

    @property
    def kerma_weights(self) -> NDArray[np.float64]:
        """Air kerma of a photon per cm2 (energy,), uGy cm2."""
        return self._kerma

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

    def _fluence_at(self, kV: float, terms: Sequence[_Term], top: int) -> NDArray[np.float64]:
        """Unfiltered fluence (draw, energy), photons / keV / cm2 / mAs at 1 m, on the first `top` energies.

        The sum over `terms` of a weight (draw,) times the fluence at an error (draw,) of the tube voltage. Beyond the tube's
        table the voltage stands still; a kV outside it is refused.
        """
        if kV > self.highest_kV:
            raise InputError(
                "kV", received=f"{kV:g} kV", expected=f"at most {self.highest_kV:g} kV, this model's range"
            )
        checked_kV(kV, anode=self.anode)
        highest = MAXIMUM_KV_OF_ANODE.get(self.anode, MAXIMUM_KV)
        found = [
            (*brackets(NODES_KV, np.clip(kV * (1.0 + _within(error)), MINIMUM_KV, highest)), weight)
            for error, weight in terms
        ]
        first = min(int(below.min()) for below, _, _ in found)
        shares = np.zeros((len(found[0][0]), max(int(below.max()) for below, _, _ in found) + 2 - first))
        rows = np.arange(len(shares))
        for below, share, weight in found:
            shares[rows, below - first] += weight * (1.0 - share)
            shares[rows, below - first + 1] += weight * share
        # each node may cost spectra that nobody has computed yet
        used = np.flatnonzero(np.any(shares != 0.0, axis=0))
        return np.asarray(shares[:, used] @ fluence_at_nodes(first + used, top, **self._tube))

    def _towards_other_model(self, kV: float) -> NDArray[np.float64]:
        """Logarithm of the other of SpekPy's models over this one (energy,), held constant beyond the end point."""
        if kV not in self._other_model:
            self._other_model[kV] = log_ratio_of_models(kV, **self._tube)
        return self._other_model[kV]

    def default_parameters(self) -> NDArray[np.float64]:
        """The parameter set of an uncalibrated line (parameter,): no error, 1 DN a keV, Swank factor 1."""
        return np.zeros(len(self.names))

    def _kV_error(self, samples: NDArray[np.float64], kV: float) -> NDArray[np.float64]:
        return self._column(samples, "kV_error") + self._column(samples, "kV_tilt") * math.log(kV / REFERENCE_KV)

    def weights(self, samples: NDArray[np.float64], beam: OpenBeam) -> NDArray[np.float64]:
        """Photons of the beam (draw, energy) a bin, mAs and mm2 of pixel at 1 m, for samples (draw, parameter)."""
        behind = self._behind_the_anode(samples, beam)
        kV_error, variance = self._kV_error(samples, beam.kV), self._column(samples, "kV_variance")
        behind *= self._fluence_at(beam.kV, _varying(kV_error, variance), behind.shape[1])
        return np.maximum(behind, 0.0, out=behind)

    def _behind_the_anode(self, samples: NDArray[np.float64], beam: OpenBeam) -> NDArray[np.float64]:
        """What all but the tube voltage makes of the fluence (draw, energy): output, layers, models; a bin, mAs and mm2."""
        usual = float(np.max(self._kV_error(samples, beam.kV), initial=0.0)) <= _USUAL_KV_ERROR
        end_keV = (1.01 + (_USUAL_KV_ERROR if usual else LARGEST_KV_ERROR)) * beam.kV
        top = min(int(np.searchsorted(self.energies_keV, end_keV)) + 1, self.energies_keV.size)
        energies = self.energies_keV[:top]
        factors, rows = [], []
        for layer, thickness in (
            (Filter(material="Al", thickness_mm=1.0), self._column(samples, "inherent_filtration_mm_Al")),
            *((layer, None) for layer in beam.filters),
        ):
            material = layer.material
            if thickness is None:
                depth = self.depth(layer)[:top]
                amount = np.exp(self._column(samples, attenuation_scale_name(material)))
            else:
                depth, amount = self.mu(material)[:top], thickness
            factors.append(amount)
            rows.append(-depth)
            for table in OTHER_TABLES:
                name = table_share_name(table, material)
                if name in self._index:
                    factors.append(amount * self._column(samples, name))
                    rows.append(-depth * self._departure(material, table)[:top])
        for name in ("hardness_exponent", "hardness_tilt", "end_exponent", _OTHER_MODEL, "anode_roughness_um"):
            row = self._row_of(name, beam, top) if name in self._index else None
            if row is not None:
                factors.append(self._column(samples, name))
                rows.append(row)
        for name, material in self._absorbers.get(beam.absorber, {}).items():
            factors.append(self._column(samples, name))
            rows.append(-self.mu(material)[:top])
        width = energies[1] - energies[0]
        factors.append(
            self._column(samples, "log_output")
            + self._column(samples, "yield_exponent") * np.log(beam.kV / REFERENCE_KV)
            + np.log(width / 100.0)
        )
        rows.append(np.ones(top))
        photons = np.exp(np.stack(factors, axis=1) @ np.stack(rows))
        photons *= self._inherent[:top]
        if self.correction is not None:
            photons *= np.exp(self.correction.at(beam.kV, top))
        return np.asarray(photons)

    # draws that no beam has give infinities, which the caller refuses in words
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
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
        return self.signal_of_photons(samples, photons)

    def depth_of_parameters(self, layer: Filter, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Optical depth of a layer (energy,) with the scale and the table shares of one parameter set (parameter,)."""

        def value(name: str) -> float:
            return float(parameters[self._index[name]]) if name in self._index else 0.0

        moved = np.ones(self.energies_keV.size)
        for table in OTHER_TABLES:
            share = value(table_share_name(table, layer.material))
            if share != 0.0:
                moved = moved + share * self._departure(layer.material, table)
        return np.asarray(self.depth(layer) * moved * math.exp(value(attenuation_scale_name(layer.material))))

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
                    crossed[row, layers[layer]] += 1.0
            depths = np.array([self.depth_of_parameters(layer, parameters)[:top] for layer in layers])
            photons = photons * np.exp(-crossed @ depths)
        else:
            photons = np.repeat(photons, len(stacks), axis=0)
        return self.signal_of_photons(parameters[None, :], photons)

    def moment_weights(
        self, parameters: NDArray[np.float64], beam: OpenBeam, *, secondary: bool = True
    ) -> NDArray[np.float64]:
        """What each energy of an open beam adds to signal (DN), its variance (DN^2) and photons absorbed.

        Args:
            parameters: (parameter,), one set.
            beam: kV and filters.
            secondary: whether the variance holds that of secondary quanta.

        Returns:
            (3, energy) a mAs and mm2 of pixel at 1 m, on the first of `energies_keV`, for one parameter set (parameter,).
            Behind an object of transmission T(E) the three sums are those of the rows times T.
        """
        samples = parameters[None, :]
        photons = self.weights(samples, beam)[0]
        first, second, share = self._moments(samples)[:, 0, : len(photons)]
        log_gamma = float(self._column(samples, "log_DN_per_keV")[0])
        log_swank = float(self._column(samples, "log_swank")[0])
        signal = photons * first * np.exp(log_gamma)
        variance = photons * second * np.exp(2 * log_gamma - log_swank)
        if secondary:
            variance = variance + self.secondary_DN * signal
        return np.stack([signal, variance, photons * share])

    def deposit_tables(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """What each draw's scintillator does at each energy (6, draw, energy): see `response_tables`, the share left out.

        The first two hold the draw's own table and escape parameters; the next ones are the derivatives by these.
        """
        log_thickness = self._column(samples, "log_scintillator_thickness")
        other = self._column(samples, ALTERNATIVE_SCINTILLATOR) > 0.5
        found = np.empty((6, len(samples), self.energies_keV.size))
        for chosen, tables in zip((~other, other), self._responses, strict=False):
            if chosen.any():
                for row, table in enumerate((*tables[:2], *tables[3:])):
                    found[row, chosen] = interpolate(LOG_THICKNESS, table, log_thickness[chosen])
        by_table, by_escape = (self._column(samples, name)[:, None] for name in ("scintillator_table", "escape_scale"))
        found[0] += by_table * found[2] + by_escape * found[4]
        found[1] += by_table * found[3] + by_escape * found[5]
        if THRESHOLD in self._index:
            thresholds = self._column(samples, THRESHOLD)
            tables = counted_tables(self.scintillator[0], self.energies_keV.size)
            alone, shared = (
                escaping + by_escape * (escaping - kept)
                for escaping, kept in (
                    [interpolate(THRESHOLDS_KEV, table, thresholds) for table in pair] for pair in tables
                )
            )
            found *= alone + self._column(samples, SHARED_CHARGE)[:, None] * (shared - alone)
        powers = self._response_powers(samples, self.energies_keV.size)
        if powers is not None:
            found[::2] *= powers[0]
            found[1::2] *= powers[1]
        return found

    def _response_powers(
        self, samples: NDArray[np.float64], top: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
        """What covers and light do to first and second moment and to the absorbed share (draw, energy) each; None: nothing."""
        names = [name for name in self._response_names if np.any(self._column(samples, name))]
        if not names:
            return None
        other = self._column(samples, ALTERNATIVE_SCINTILLATOR) > 0.5
        factors: list[NDArray[np.float64] | None] = []  # of each kind of parameter, as its powers have it
        for kind in ((1.0, 1.0, 1.0), (1.0, 2.0, 0.0), (0.0, -1.0, 0.0)):
            own = [name for name in names if RESPONSE_PARAMETERS[name] == kind]
            if not own:
                factors.append(None)
                continue
            columns = np.stack([self._column(samples, name) for name in own], axis=1)
            logarithm = columns @ np.stack([self._response_rows[0][name][:top] for name in own])
            if np.any(other):
                rows = np.stack([self._response_rows[1][name][:top] for name in own])
                logarithm[other] = columns[other] @ rows
            factors.append(np.exp(logarithm, out=logarithm))
        passed, light, swank = factors
        share = np.ones((len(samples), top)) if passed is None else passed
        first = share if light is None else share * light
        second = first if light is None else first * light
        return first, second if swank is None else second / swank, share

    def _moments(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """What a photon of each energy leaves in each draw's scintillator (3, draw, energy): deposit, its square, share stopped.

        Those of the last sets of draws are kept.
        """
        for known, moments in self._moments_kept:
            if np.array_equal(known, samples):
                return moments
        bins = self.energies_keV.size
        other = self._column(samples, ALTERNATIVE_SCINTILLATOR) > 0.5
        log_thickness = self._column(samples, "log_scintillator_thickness")
        moments = np.empty((3, len(samples), bins))
        moments[:2] = self.deposit_tables(samples)[:2]
        for chosen, tables in zip((~other, other), self._responses, strict=False):
            if chosen.any():
                moments[2, chosen] = interpolate(LOG_THICKNESS, tables[2], log_thickness[chosen])
        powers = self._response_powers(samples, bins)
        if powers is not None:
            moments[2] *= powers[2]
        self._moments_kept = [(samples.copy(), moments), *self._moments_kept[: _DRAWS_KEPT - 1]]
        return moments

    def signal_of_photons(self, samples: NDArray[np.float64], photons: NDArray[np.float64]) -> BeamSignal:
        """What photons (draw, energy), as `weights` gives them, leave behind an object or without one.

        Args:
            samples: (draw, parameter) in the order of `names`: scintillator and gains; one for all of the photons, or each its own.
            photons: (draw, energy) on the first of `energies_keV`, a bin, mAs and mm2 of pixel at 1 m.
        """
        top = photons.shape[1]
        moments = self._moments(samples)[:, :, :top]
        if len(samples) == 1:
            first, second, absorbed = moments[:, 0] @ photons.T
        else:
            first, second, absorbed = np.einsum("qde,de->qd", moments, photons)
        log_gamma = self._column(samples, "log_DN_per_keV")
        gamma = np.exp(log_gamma)
        excess = np.exp(log_gamma - self._column(samples, "log_swank"))
        return BeamSignal(
            rate_DN_per_mAs=gamma * first,
            gain_DN=excess * second / first + self.secondary_DN,
            absorbed_per_mAs=absorbed,
            # photons are per mm2, kerma counts per cm2
            kerma_uGy_per_mAs=100.0 * (photons @ self._kerma[:top]) * np.exp(self._column(samples, KERMA_OUTPUT)),
        )

    def log_kerma_derivatives(
        self, samples: NDArray[np.float64], beam: OpenBeam, names: Sequence[str]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Logarithm of the air kerma of a beam (draw,), uGy per mAs at 1 m, and how each of `names` moves it (draw, name).

        The third is the mean of ln(E / 50 keV) over the kerma (draw,): the derivative by the exponent of a dosimeter whose
        response goes as a power of the energy. Arguments as in `log_derivatives`.
        """
        weight = np.zeros((6, self.energies_keV.size))
        weight[:2] = 100.0 * self._kerma
        deposits = np.broadcast_to(weight[:, None, :], (6, len(samples), self.energies_keV.size))
        asked = list(dict.fromkeys([*names, "hardness_exponent"]))
        logs, found, _ = self.log_derivatives(samples, beam, asked, deposits=deposits)
        hardness, slope = found[:, asked.index("hardness_exponent")].copy(), found[:, : len(names)].copy()
        for column, name in enumerate(names):
            if name in _OF_DETECTOR:
                slope[:, column] = 0.0
            elif name == KERMA_OUTPUT:
                slope[:, column] = 1.0
        value = logs[0] - self._column(samples, "log_DN_per_keV") + self._column(samples, KERMA_OUTPUT)
        return value, slope, hardness

    def log_derivatives(
        self,
        samples: NDArray[np.float64],
        beam: OpenBeam,
        names: Sequence[str],
        deposits: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Logarithms of rate and gain (2, draw) of a beam, and how each of `names` moves them (draw, name) each.

        The derivatives of ln(sum N m1) and ln(sum N m2 / sum N m1): means over the spectrum of what the parameter does
        at each energy. They hold for parameters that act a little: tables, models, exponents, escape, scales, voltage.

        Args:
            samples: (draw, parameter), the point at which the derivatives are taken.
            beam: kV and filters.
            names: parameters, not the filtration or the scintillator's thickness.
            deposits: `deposit_tables` of the same samples, where several beams share them.

        Returns:
            (rate and gain) (2, draw), derivatives of the rate (draw, name), derivatives of the gain (draw, name).
        """
        behind = self._behind_the_anode(samples, beam)
        top = behind.shape[1]
        kV_error, variance = self._kV_error(samples, beam.kV), self._column(samples, "kV_variance")[:, None]
        photons = behind * self._fluence_at(beam.kV, [(kV_error, np.ones(len(samples)))], top)
        varied = np.zeros_like(photons)
        if "kV_variance" in names or np.any(variance):
            varied = behind * self._fluence_at(beam.kV, _second_difference(kV_error, np.ones(len(samples))), top)
            photons = np.maximum(photons + variance * varied, 0.0)
        tables = (self.deposit_tables(samples) if deposits is None else deposits)[:, :, :top]
        first, second = tables[:2]
        by_first, by_second = photons * first, photons * second
        sums = np.stack([by_first.sum(axis=1), by_second.sum(axis=1)])
        gamma = self._column(samples, "log_DN_per_keV")
        logs = np.stack(
            [gamma + np.log(sums[0]), gamma - self._column(samples, "log_swank") + np.log(sums[1] / sums[0])]
        )
        rate = np.zeros((len(samples), len(names)))
        gain = np.zeros((len(samples), len(names)))
        # parameters of one row over energy, the same for all draws
        rows = {name: row for name, row in ((name, self._row_of(name, beam, top)) for name in names) if row is not None}
        if rows:
            acts = np.stack(list(rows.values()), axis=1)
            columns = [list(names).index(name) for name in rows]
            means = by_first @ acts / sums[0][:, None]
            rate[:, columns] = means
            gain[:, columns] = by_second @ acts / sums[1][:, None] - means
        filtration = self._column(samples, "inherent_filtration_mm_Al")
        for column, name in enumerate(names):
            for table_name in OTHER_TABLES:
                if name == table_share_name(table_name, "Al"):
                    row = -self.mu("Al")[:top] * self._departure("Al", table_name)[:top]
                    mean = by_first @ row / sums[0]
                    rate[:, column] += filtration * mean
                    gain[:, column] += filtration * (by_second @ row / sums[1] - mean)
            if name in {"log_output", "log_DN_per_keV"}:
                rate[:, column] = 1.0
                gain[:, column] = float(name == "log_DN_per_keV")
            elif name == "log_swank":
                gain[:, column] = -1.0
            elif name == "yield_exponent":
                rate[:, column] = np.log(beam.kV / REFERENCE_KV)
            elif name in {"scintillator_table", "escape_scale"}:
                moved = tables[2:4] if name == "scintillator_table" else tables[4:6]
                mean = np.einsum("de,de->d", photons, moved[0]) / sums[0]
                rate[:, column] = mean
                gain[:, column] = np.einsum("de,de->d", photons, moved[1]) / sums[1] - mean
            elif name in {"kV_tilt", "kV_variance"}:
                if name == "kV_tilt":
                    above, below = (
                        self._fluence_at(beam.kV, _varying(kV_error + step, variance[:, 0]), top)
                        for step in (_TILT_STEP, -_TILT_STEP)
                    )
                    moved_photons = behind * (above - below)
                    scale = math.log(beam.kV / REFERENCE_KV) / (2.0 * _TILT_STEP)
                else:
                    moved_photons, scale = varied, 1.0
                mean = np.einsum("de,de->d", moved_photons, first) / sums[0] * scale
                rate[:, column] = mean
                gain[:, column] = np.einsum("de,de->d", moved_photons, second) / sums[1] * scale - mean
            elif name in self._response_names:
                powers = RESPONSE_PARAMETERS[name]
                mean = powers[0] * self._mean_of_row(name, by_first, samples) / sums[0] if powers[0] else 0.0
                rate[:, column] = mean
                gain[:, column] = powers[1] * self._mean_of_row(name, by_second, samples) / sums[1] - mean
        quanta = np.exp(logs[1])
        logs[1] = np.log(quanta + self.secondary_DN)
        return logs, rate, gain * (quanta / (quanta + self.secondary_DN))[:, None]

    def _mean_of_row(self, name: str, weight: NDArray[np.float64], samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum over energy of a response parameter's row times weights (draw, energy), each draw's own scintillator (draw,)."""
        rows = np.stack([found[name][: weight.shape[1]] for found in self._response_rows], axis=1)
        sums = weight @ rows
        if rows.shape[1] == 1:
            return np.asarray(sums[:, 0])
        return np.where(self._column(samples, ALTERNATIVE_SCINTILLATOR) > 0.5, sums[:, 1], sums[:, 0])

    def _row_of(self, name: str, beam: OpenBeam, top: int) -> NDArray[np.float64] | None:
        """What a unit of a parameter adds to the logarithm of the photons at each energy (energy,)."""
        if name == "hardness_exponent":
            return np.log(self.energies_keV[:top] / REFERENCE_KEV)
        if name == "hardness_tilt":
            return math.log(beam.kV / REFERENCE_KV) * np.log(self.energies_keV[:top] / REFERENCE_KEV)
        if name == "end_exponent":
            return np.log(2.0 * np.maximum(1.0 - self.energies_keV[:top] / beam.kV, _NEAREST_TO_END))
        if name == _OTHER_MODEL:
            return self._towards_other_model(beam.kV)[:top]
        if name == "anode_roughness_um":
            return -1e-3 * levelled(self.mu(self.anode), self.energies_keV)[:top]
        row = None
        for layer in beam.filters:
            if name == attenuation_scale_name(layer.material):
                row = (0.0 if row is None else row) - self.depth(layer)[:top]
            for table in OTHER_TABLES:
                if name == table_share_name(table, layer.material):
                    departure = self._departure(layer.material, table)[:top]
                    row = (0.0 if row is None else row) - self.depth(layer)[:top] * departure
        return row

    def _column(self, samples: NDArray[np.float64], name: str) -> NDArray[np.float64]:
        if name not in self._index:
            return np.zeros(len(samples))
        return np.asarray(samples[:, self._index[name]])


def _within(kV_error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors of the tube voltage (draw,), none larger than LARGEST_KV_ERROR."""
    return np.clip(kV_error, -LARGEST_KV_ERROR, LARGEST_KV_ERROR)


def _second_difference(kV_error: NDArray[np.float64], weight: NDArray[np.float64]) -> list[_Term]:
    """Terms of a weight (draw,) times kV^2 / 2 d2 Phi / d kV2, over a step to both sides."""
    inside = np.clip(kV_error, KV_STEP - LARGEST_KV_ERROR, LARGEST_KV_ERROR - KV_STEP)
    each = weight / (2.0 * KV_STEP**2)
    return [(inside - KV_STEP, each), (inside, -2.0 * each), (inside + KV_STEP, each)]


def _varying(kV_error: NDArray[np.float64], variance: NDArray[np.float64]) -> list[_Term]:
    """Terms of the fluence at errors (draw,) of a voltage that varies about them by relative variances (draw,)."""
    mean = (kV_error, np.ones(len(kV_error)))
    return [mean, *_second_difference(kV_error, variance)] if np.any(variance) else [mean]


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
    weights = model.moment_weights(parameters, beam)[:2]
    mu = model.mu(material)[: weights.shape[1]]
    open_rate, open_variance = weights.sum(axis=1)
    # one thickness at a time: sums of one order, however many are asked for
    behind = np.array([weights @ np.exp(-mu * thickness) for thickness in thickness_mm])
    rate = behind[:, 0] / open_rate
    return rate, behind[:, 1] / behind[:, 0] / (open_variance / open_rate)


def mean_signal_energy_keV(weights: NDArray[np.float64], energies_keV: NDArray[np.float64]) -> float:
    """Mean energy of a beam's signal, keV; weights (energy,) of the signal."""
    return float(weights @ energies_keV[: weights.size] / weights.sum())

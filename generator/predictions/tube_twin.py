"""The twin of a tube alone: a spectrum and an output calibrated with a dosimeter, and what they say of a setting."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Filter, Setting, text_from_filters
from ...errors import InputError
from ...materials import TABLES, material_from_name, mu_per_mm
from ...results import Result, Table, interval_text, plain
from ...spectra import BIN_WIDTH_KEV, Response, Spectrum, checked_kV, half_value_layer_mm, mean_energy_keV
from ..line.line_limits import check_limits
from ..line.spectral_signal import KERMA_OUTPUT, OpenBeam
from ..line.twin import Estimate, SpectralPosterior, Twin, estimate_from_log_draws
from ..line.twin_spectrum import model_of_posterior
from .predict import spectrum_outside

FloatArray = NDArray[np.float64]

NO_DETECTOR = "the twin is of the tube alone: flats would calibrate a detector"
NO_OUTPUT = "no air kerma was measured, only ratios: the tube's output is not known"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class TubeTwin(Result):
    """A calibrated tube without a detector.

    Fields: instrument (anode, angle, limits; what its owner declares), spectral (posterior of the tube's parameters; those of
    a detector in it are the priors'), output_known (whether air kerma was measured), evidence, warnings, provenance.
    """

    instrument: Instrument
    spectral: SpectralPosterior
    output_known: bool
    evidence: Mapping[str, Any]
    warnings: tuple[str, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def predict(self, settings: Any = None, /, **words: Any) -> Any:
        """Air kerma of a setting or of several, with 95 % intervals; settings and words as for `Twin.predict`.

        Raises:
            InputError: an unknown word or material, no tube load, or a setting that the tube cannot have.
        """
        from .. import asked_settings

        asked = asked_settings(settings, words)
        if isinstance(asked, Setting):
            return predict_tube(self, asked)
        return tuple(predict_tube(self, item) for item in asked)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the twin to a file (HDF5), whole or not at all; `raytwin.read_twin` reads it."""
        from .. import write_twin

        write_twin(path, self)

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin calibrate --json` prints."""
        from .. import calibration_answer

        found: dict[str, Any] = plain(calibration_answer(self))
        return found

    def _table(self) -> Table:
        from .. import tube_table

        return tube_table(self)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class TubePrediction(Result):
    """What a tube alone says of a setting: air kerma of one exposure, uGy (None: not known); warnings say why."""

    setting: Setting
    air_kerma_uGy: Estimate | None
    extrapolated: bool
    warnings: tuple[str, ...]

    def _table(self) -> Table:
        kerma = None if self.air_kerma_uGy is None else self.air_kerma_uGy.as_dict()
        notes = tuple(f"warning: {text}" for text in self.warnings)
        rows = (("air_kerma_uGy", *interval_text(kerma), "uGy a frame"),)
        return Table(title=str(self.setting), header=("", "value", "95 % interval", "unit"), rows=rows, notes=notes)

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin predict --json` prints: what needs a detector is null."""
        return {
            "setting": str(self.setting),
            "mean_DN": None,
            "sd_DN": None,
            "gain_DN": None,
            "photons_absorbed": None,
            "air_kerma_uGy": None if self.air_kerma_uGy is None else self.air_kerma_uGy.as_dict(),
            "extrapolated": self.extrapolated,
            "measured_level": False,
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectrumPrediction:
    """A calibrated tube's spectrum at a kV and filter, with 95 % intervals.

    Fields: spectrum (median over the posterior at each energy; relative where the output is not known), mean_energy_keV,
    hvl_mm_Al, hvl_mm_Cu, air_kerma_uGy_per_mAs (at 1 m; None: output not known), extrapolated, warnings.
    """

    spectrum: Spectrum
    mean_energy_keV: Estimate
    hvl_mm_Al: Estimate
    hvl_mm_Cu: Estimate
    air_kerma_uGy_per_mAs: Estimate | None
    extrapolated: bool
    warnings: tuple[str, ...]

    def intervals(self) -> dict[str, dict[str, float] | None]:
        """Value and interval of each quantity, by its name."""
        kerma = self.air_kerma_uGy_per_mAs
        return {
            "mean_energy_keV": self.mean_energy_keV.as_dict(),
            "hvl_mm_Al": self.hvl_mm_Al.as_dict(),
            "hvl_mm_Cu": self.hvl_mm_Cu.as_dict(),
            "air_kerma_uGy_per_mAs": None if kerma is None else kerma.as_dict(),
        }


def predict_tube(twin: TubeTwin, setting: Setting) -> TubePrediction:
    """Air kerma of a setting's exposure, one frame, in vacuum, with its 95 % interval, without a dosimeter's own noise.

    It is given at `setting.source_detector_mm`, else where the instrument's object stands, else at 1 m. Outside the kV and
    filters that were measured the learned departure of a setting counts once more for each.

    Raises:
        InputError: no tube load, a setting beyond the tube's limits, a kV without spectra, or no photons behind the filters.
    """
    warnings = [NO_DETECTOR, *check_limits(twin.instrument, setting)]
    load_mAs = setting.stated_load_mAs()
    kerma, outside = _kerma_per_mAs(twin.spectral, setting.kV, setting.filters)
    distance_mm = setting.source_detector_mm or twin.instrument.source_object_mm
    if distance_mm is None:
        distance_mm = 1000.0
        warnings.append("air kerma is given at 1 m: no distance is stated")
    if outside:
        warnings.append(
            f"outside the calibrated range of {', '.join(outside)}: the interval rests on the spectral model"
        )
    if not twin.output_known:
        warnings.append(NO_OUTPUT)
    return TubePrediction(
        setting=setting,
        air_kerma_uGy=kerma.times(load_mAs * (1000.0 / distance_mm) ** 2) if twin.output_known else None,
        extrapolated=bool(outside),
        warnings=tuple(warnings),
    )


def _kerma_per_mAs(
    posterior: SpectralPosterior, kV: float, filters: tuple[Filter, ...]
) -> tuple[Estimate, tuple[str, ...]]:
    photons, energies = _photons(posterior, kV, filters)
    model = model_of_posterior(posterior, highest_kV=kV)
    output = np.exp(posterior.column(KERMA_OUTPUT)) if KERMA_OUTPUT in posterior.names else 1.0
    draws = 100.0 * (photons @ model.kerma_weights[: energies.size]) * output
    outside = spectrum_outside(posterior, kV=kV, filters=filters)
    own = posterior.kerma_discrepancy if posterior.kerma_discrepancy is not None else posterior.level_discrepancy
    return estimate_from_log_draws(np.log(draws), math.sqrt(1.0 + len(outside)) * own), outside


def _photons(posterior: SpectralPosterior, kV: float, filters: tuple[Filter, ...]) -> tuple[FloatArray, FloatArray]:
    """Photons (draw, energy) a bin, mAs and mm2 at 1 m, and their energies (energy,).

    Raises:
        InputError: no spectra are known at the voltage, or nothing gets through the filters.
    """
    checked_kV(kV, anode=posterior.anode)
    model = model_of_posterior(posterior, highest_kV=kV)
    photons = model.weights(posterior.samples, OpenBeam(kV=kV, filters=filters))
    bare = model.weights(posterior.best[None, :], OpenBeam(kV=kV, filters=()))
    # fewer than one photon in 1e30 is no beam, whatever floating point can still hold
    if not np.all(photons.sum(axis=1) > 1e-30 * bare.sum()):
        raise InputError("filter", received=text_from_filters(filters), expected="layers that let some photons through")
    return photons, model.energies_keV[: photons.shape[1]]


def predict_spectrum(twin: Twin | TubeTwin, *, kV: float, filters: tuple[Filter, ...] = ()) -> SpectrumPrediction:
    """The spectrum of a calibrated tube at a kV and filter, at 1 m in vacuum, with its numbers and 95 % intervals.

    Half-value layers and mean energy are of the posterior's draws; their intervals leave out what single settings stray.

    Raises:
        InputError: a twin without spectral part, a kV without spectra, or no photons behind the filters.
    """
    posterior = _posterior(twin)
    photons, energies = _photons(posterior, kV, filters)
    fluence = photons * (100.0 / BIN_WIDTH_KEV)
    absolute = twin.output_known if isinstance(twin, TubeTwin) else _output_known(twin)
    beams = [Spectrum(energies_keV=energies, fluence=row, kV=kV) for row in fluence]
    aluminium, copper = material_from_name("aluminium"), material_from_name("copper")
    kerma, outside = _kerma_per_mAs(posterior, kV, filters)
    warnings = []
    if outside:
        warnings.append(
            f"outside the calibrated range of {', '.join(outside)}: the intervals rest on the spectral model"
        )
    if not absolute:
        warnings.append("the tube's output is not known: fluence is relative, air kerma is null")
    return SpectrumPrediction(
        spectrum=Spectrum(
            energies_keV=energies,
            fluence=np.median(fluence, axis=0),
            kV=kV,
            anode=posterior.anode,
            anode_angle_deg=posterior.anode_angle_deg,
            model=f"{posterior.model}, calibrated",
            filters=filters,
            absolute=absolute,
        ),
        mean_energy_keV=_interval([mean_energy_keV(beam) for beam in beams]),
        hvl_mm_Al=_interval([half_value_layer_mm(beam, aluminium) for beam in beams]),
        hvl_mm_Cu=_interval([half_value_layer_mm(beam, copper) for beam in beams]),
        air_kerma_uGy_per_mAs=kerma if absolute else None,
        extrapolated=bool(outside),
        warnings=tuple(warnings),
    )


def predict_effective_mu(
    twin: Twin | TubeTwin,
    *,
    material: str,
    kV: float,
    filters: tuple[Filter, ...] = (),
    response: Response | None = None,
    thickness_mm: float = 0.0,
) -> Estimate:
    """Effective attenuation of a material in a calibrated tube's beam, 1/mm, with its 95 % interval.

    -ln(sum(w exp(-mu L)) / sum(w)) / L, at L = 0 the thin limit sum(w mu) / sum(w); w photons times what the detector makes
    of them. xraylib's attenuation; how far tables differ for the material is in the interval.

    Args:
        twin: with a spectral part.
        material: of the object.
        kV, filters: the beam.
        response: of the detector; None: the twin's own, draw by draw, which a tube alone has not.
        thickness_mm: L.

    Raises:
        InputError: no spectral part, no detector, an unknown material, a kV without spectra.
    """
    posterior = _posterior(twin)
    photons, energies = _photons(posterior, kV, filters)
    if response is not None:
        weights = photons * response.mean_deposited_keV[: energies.size]
    elif isinstance(twin, TubeTwin):
        raise InputError(
            "twin", received="a twin of the tube alone", expected="a detector", remedy="state its response"
        )
    else:
        model = model_of_posterior(posterior, highest_kV=kV)
        weights = photons * model.deposit_tables(posterior.samples)[0, :, : energies.size]
    weights = weights / weights.sum(axis=1, keepdims=True)

    def effective(of: FloatArray, table: str = "xraylib") -> FloatArray:
        mu = mu_per_mm(material_from_name(material), energies, table=table)
        return of @ mu if thickness_mm == 0 else -np.log(of @ np.exp(-mu * thickness_mm)) / thickness_mm

    by_table = [float(effective(weights.mean(axis=0), table)) for table in TABLES]
    spread_of_tables = float(np.std(by_table, ddof=1) / np.mean(by_table))
    return _interval(effective(weights)).widened(spread_of_tables)


def _posterior(twin: Twin | TubeTwin) -> SpectralPosterior:
    if twin.spectral is None:
        raise InputError(
            "twin",
            received="a twin without spectral part",
            expected="one calibrated from flats that state kV and tube load, or from a dose table",
        )
    return twin.spectral


def _output_known(twin: Twin) -> bool:
    if KERMA_OUTPUT in (() if twin.spectral is None else twin.spectral.names):
        return True
    instrument = twin.instrument
    return instrument.pixel_mm is not None and any(
        level.rate_DN_per_mAs is not None and level.source_detector_mm is not None for level in twin.levels
    )


def _interval(draws: Any) -> Estimate:
    low, middle, high = np.quantile(np.asarray(draws, dtype=np.float64), [0.025, 0.5, 0.975])
    return Estimate(value=float(middle), low=float(low), high=float(high))

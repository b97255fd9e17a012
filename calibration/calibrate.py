"""Measured flats and darks -> a calibrated twin."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.cut_off import without_cut_off_darks
from ..acquisition.setting import Filter
from ..errors import FitError, InputError
from ..generator.line.photon_tables import OTHER_TABLES
from ..generator.line.spectral_signal import KV_STEP, OpenBeam
from ..generator.line.twin import BAD_PIXEL_CODES, BAD_PIXEL_MAP, Twin
from ..generator.twins.twin_answer import calibration_answer
from ..spectra import (
    DEFAULT_ANGLE_DEG,
    MAXIMUM_KV_OF_ANODE,
    Spectrum,
    checked_kV,
    energy_grid_keV,
    tube_fluence_interpolated,
)
from .flats.photon_transfer import PhotonTransfer, compute_photon_transfer
from .flats.setting_errors import allowing_for_darks, allowing_for_settings, mean_change
from .next_measurement import advice, voltages_within_reach
from .spectrum.output_table import OutputTable
from .spectrum.priors import PRIORS
from .spectrum.spectral_data import Transmission
from .spectrum.spectral_fit import SpectralFit, contradicts, fit_evidence, fit_spectrum, unlike_output, wedges_depart
from .spectrum.spectral_model import model_for
from .spectrum.transmission_table import TransmissionTable
from .spectrum.tube import DoseData, dose_data, fit_without_strays, table_evidence
from .spectrum.wedges import measure_transmissions, wedge_evidence

__all__ = ["bad_pixel_counts", "calibrate_twin", "calibration_answer"]


def calibrate_twin(
    acquisition: AcquisitionFile,
    *,
    rng: np.random.Generator,
    progress: Callable[[str], None] | None = None,
    provenance: dict[str, Any] | None = None,
    advise: bool = True,
    spectra: Sequence[Spectrum] = (),
    estimator: str = "pairs",
    repeated: Sequence[Series] | None = None,
    output_table: OutputTable | None = None,
    transmission_table: TransmissionTable | None = None,
) -> Twin:
    """The twin of a measured session; without kV or tube load it has no spectral part, and says so.

    Args:
        acquisition: open acquisition file; series held back for evaluation are not looked at, but for the noise of beams
            whose flats are single frames and that nothing else repeats.
        rng: source of randomness of the posterior's draws.
        progress: called with the name of each stage.
        provenance: kept in the twin.
        spectra: measured ones, in place of the tube model at their voltages.
        estimator: variances from `pairs` of successive frames, or from the `stack` about its mean.
        repeated: flats and objects that the noise of single-frame flats may be read from, in place of the acquisition's.
        output_table, transmission_table: what a dosimeter read on this line; `calibrate_tube` does without an acquisition.
        advise: also find the measurement that would narrow the predictions most (spectra at some more kV).

    Raises:
        InputError: the session cannot calibrate anything; the message says what is missing.
    """
    tell = progress or (lambda stage: None)
    acquisition, cut_off = without_cut_off_darks(acquisition)
    _check_voltages(acquisition)
    _prepare_spectra(acquisition, tell=tell, advise=advise)
    transfer = compute_photon_transfer(acquisition, estimator=estimator, repeated=repeated, progress=tell)
    warnings = [*cut_off, *transfer.warnings]
    evidence = dict(transfer.evidence)
    spectral = None
    doses = dose_data(output_table, transmission_table)
    if any(level.kV is not None for level in transfer.levels) or doses.any:
        tell("spectrum")
        warnings += _notes_on_beams(acquisition, transfer, dosimeter=doses.any)
        wedges = measure_transmissions(acquisition, transfer.maps)
        evidence["wedges"] = wedge_evidence(wedges)
        warnings += [f"wedge left out: {item.skipped}" for item in wedges if item.skipped]
        transmissions = [value for item in wedges for value in item.transmissions]
        levels = allowing_for_settings(transfer.levels, transfer.points, transfer.evidence["setting_errors"])

        def fit_of(chosen: DoseData, behind: Sequence[Transmission] = transmissions) -> SpectralFit:
            return fit_spectrum(
                levels,
                acquisition.instrument,
                rng=rng,
                dark_changes=[mean_change(level, transfer.dark_changes) for level in levels],
                spectra=spectra,
                transmissions=behind,
                noise=transfer.noise,
                repeats=transfer.evidence["repeated_settings"],
                kermas=chosen.kermas,
                ratios=chosen.ratios,
            )

        try:
            fit, doses, told = fit_without_strays(doses, fit_of)
            warnings += told
            if transmissions and (contradicts(fit) or wedges_depart(fit)):
                without = fit_of(doses, ())
                if not contradicts(without):
                    fit = without
                    evidence["wedges"] = [{**row, "used": False} for row in evidence["wedges"]]
                    warnings.append(
                        "the wedges contradict the flats (scatter behind them, or another thickness than stated) and were"
                        " left out of the spectral fit; a larger gap behind a wedge lowers its scatter"
                    )
        except FitError as error:
            evidence["no_spectrum"] = str(error)
            warnings.append(f"no spectral part: {error}")
        else:
            spectral = fit.posterior
            evidence["spectrum"] = fit_evidence(fit)
            evidence |= table_evidence(spectral, doses, output=output_table, transmission=transmission_table)
            warnings += _notes_on_fit(fit)
    else:
        warnings.append("no series states its kV: no spectral part, no prediction at other settings")
    evidence[BAD_PIXEL_MAP] = bad_pixel_counts(transfer)
    twin = Twin(
        instrument=acquisition.instrument,
        maps=transfer.maps,
        noise=transfer.noise,
        dark_DN=transfer.dark_DN,
        levels=allowing_for_darks(transfer.levels, transfer.dark_changes),
        spectral=spectral,
        evidence=evidence,
        warnings=tuple(warnings),
        provenance=provenance or {},
        layer=next((item.layer for item in acquisition.series if item.layer), None),
    )
    if advise and spectral is not None:
        tell("next measurement")
        twin = replace(twin, evidence=evidence | {"next_measurement": advice(twin)})
    return twin


def _notes_on_beams(acquisition: AcquisitionFile, transfer: PhotonTransfer, *, dosimeter: bool) -> list[str]:
    """What the flats' beams leave open: loads, distances, too few voltages where no dosimeter read others."""
    notes = []
    with_kV = [level for level in transfer.levels if level.kV is not None]
    if not any(level.rate_DN_per_mAs for level in with_kV):
        notes.append("no tube current or power in the flats: levels cannot be predicted, only gains")
    if acquisition.instrument.pixel_mm is None or acquisition.instrument.source_detector_mm is None:
        notes.append(
            "pixel pitch or source-detector distance unknown: the flux scale is not absolute (1 mm and 1 m assumed)"
        )
    voltages = {level.kV for level in with_kV}
    beams = {(level.kV, level.filters) for level in with_kV}
    if len(beams) == 1 and not dosimeter:
        notes.append(
            "flats at one kV and filter only: filtration, scintillator and kV are hardly known; add a second kV or"
            " the same kV with a known filter"
        )
    elif len(voltages) == 1 and not dosimeter:
        notes.append("flats at one kV only: other tube voltages rest on the spectrum model; add a second kV")
    return notes


def _notes_on_fit(fit: SpectralFit) -> list[str]:
    """What to know of the spectral part: where spectra were measured, an output that cannot be, data that do not fit."""
    notes = []
    correction = fit.posterior.correction
    if correction is not None:
        voltages_kV = ", ".join(f"{kV:g}" for kV in correction.kV)
        notes.append(
            f"spectra were measured at {voltages_kV} kV; at other voltages the tube model is corrected as between or"
            " nearest to these"
        )
    notes += unlike_output(fit)
    if contradicts(fit):
        notes.append(
            f"levels and gains do not fit the spectral model (chi-square {fit.chi_square:.0f} for {fit.data}"
            " data), and intervals are widened for it: check kV, filter and power of the series (`raytwin check` looks for"
            " wrong labels)"
        )
    return notes


def _check_voltages(acquisition: AcquisitionFile) -> None:
    """Refuse a flat whose tube voltage no spectrum is known for, by its name."""
    anode = acquisition.instrument.anode or "W"
    for item in acquisition.of_kind("flat"):
        if item.kV is None or item.role == "evaluation" or anode not in MAXIMUM_KV_OF_ANODE:
            continue
        try:
            checked_kV(float(item.kV), anode=anode)
        except InputError as error:
            raise InputError(
                f"series {item.name}: kV", received=error.received, expected=error.expected, remedy="correct its label"
            ) from None


def _prepare_spectra(acquisition: AcquisitionFile, *, tell: Callable[[str], None], advise: bool) -> None:
    """Compute and keep the spectra and attenuation tables of a session before its frames fill the memory.

    SpekPy takes 150 to 250 MB for a moment whenever it computes a spectrum or reads its tables; beside the maps of a
    full-size detector that would be the peak of the whole calibration.
    """
    flats = [item for item in acquisition.of_kind("flat") if item.kV is not None and item.role != "evaluation"]
    anode = acquisition.instrument.anode or "W"
    measured = sorted({float(item.kV or 0.0) for item in flats})
    if not measured or anode not in MAXIMUM_KV_OF_ANODE:
        return  # whatever is wrong is said where it belongs
    tell("spectra")
    # the finest of SpekPy's spectra, where the lines lie, takes most and comes first
    tube_fluence_interpolated(
        measured[0],
        energies_keV=energy_grid_keV(measured[0]),
        anode=anode,
        anode_angle_deg=acquisition.instrument.anode_angle_deg or DEFAULT_ANGLE_DEG,
        for_sums=True,
    )
    materials = [layer.material for item in flats for layer in item.filters]
    # as far as errors of the voltage go, their tilt between voltages, and what a varying voltage takes to both sides
    beyond = 6.0 * PRIORS["kV_tilt"].sd + KV_STEP
    lowest, highest = PRIORS["kV_error"].low - beyond, PRIORS["kV_error"].high + beyond
    wanted = sorted({*measured, *(voltages_within_reach(measured, anode) if advise else ())})
    for highest_kV in sorted({measured[-1], wanted[-1]}):
        model = model_for(acquisition.instrument, materials=materials, highest_kV=highest_kV)
        stack = tuple(Filter(material=material, thickness_mm=0.1) for material in sorted({*materials, "Al", "Cu"}))
        for kV in wanted:
            if kV <= model.highest_kV:
                # one between any two whole kV
                errors = np.linspace(lowest, highest, math.ceil((highest - lowest) * kV) + 2)
                samples = np.repeat(model.default_parameters()[None, :], len(errors), axis=0)
                samples[:, model.names.index("kV_error")] = errors
                model.log_derivatives(samples, OpenBeam(kV=kV, filters=stack), _shares(model.names))


def _shares(names: Sequence[str]) -> list[str]:
    return [name for name in names if name.startswith(OTHER_TABLES)]


def bad_pixel_counts(transfer: PhotonTransfer) -> dict[str, int]:
    """Number of bad pixels by reason."""
    return {
        reason: int(np.count_nonzero(transfer.maps.bad_pixels == code))
        for reason, code in BAD_PIXEL_CODES.items()
        if code != 0
    }

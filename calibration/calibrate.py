"""Measured flats and darks -> a calibrated twin."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..acquisition.acquisition_io import AcquisitionFile
from ..acquisition.setting import text_from_filters
from ..errors import FitError
from ..generator.twin import BAD_PIXEL_CODES, Estimate, Twin
from ..spectra import Spectrum
from .next_measurement import rank_measurements
from .photon_transfer import PhotonTransfer, compute_photon_transfer
from .spectral_fit import SpectralFit, fit_spectrum
from .wedges import measure_transmissions, wedge_evidence


def calibrate_twin(
    acquisition: AcquisitionFile,
    *,
    rng: np.random.Generator,
    progress: Callable[[str], None] | None = None,
    provenance: dict[str, Any] | None = None,
    advise: bool = True,
    spectra: Sequence[Spectrum] = (),
    estimator: str = "pairs",
) -> Twin:
    """The twin of a measured session; without kV or tube load it has no spectral part, and says so.

    Args:
        acquisition: open acquisition file; series held back for evaluation are not looked at.
        rng: source of randomness of the posterior's draws.
        progress: called with the name of each stage.
        provenance: kept in the twin.
        spectra: measured ones, in place of the tube model at their voltages.
        estimator: variances from `pairs` of successive frames, or from the `stack` about its mean.
        advise: also find the measurement that would narrow the predictions most (spectra at some more kV).

    Raises:
        InputError: the session cannot calibrate anything; the message says what is missing.
    """
    tell = progress or (lambda stage: None)
    transfer = compute_photon_transfer(acquisition, estimator=estimator, progress=tell)
    warnings = list(transfer.warnings)
    evidence = dict(transfer.evidence)
    spectral = None
    if any(level.kV is not None for level in transfer.levels):
        tell("spectrum")
        if not any(level.rate_DN_per_mAs for level in transfer.levels if level.kV is not None):
            warnings.append("no tube current or power in the flats: levels cannot be predicted, only gains")
        if acquisition.instrument.pixel_mm is None or acquisition.instrument.source_detector_mm is None:
            warnings.append(
                "pixel pitch or source-detector distance unknown: the flux scale is not absolute (1 mm and 1 m assumed)"
            )
        voltages = {level.kV for level in transfer.levels if level.kV is not None}
        beams = {(level.kV, level.filters) for level in transfer.levels if level.kV is not None}
        if len(beams) == 1:
            warnings.append(
                "flats at one kV and filter only: filtration, scintillator and kV are hardly known; add a second kV or"
                " the same kV with a known filter"
            )
        elif len(voltages) == 1:
            warnings.append("flats at one kV only: other tube voltages rest on the spectrum model; add a second kV")
        wedges = measure_transmissions(acquisition, transfer.maps)
        evidence["wedges"] = wedge_evidence(wedges)
        warnings += [f"wedge left out: {item.skipped}" for item in wedges if item.skipped]
        transmissions = [value for item in wedges for value in item.transmissions]
        try:
            fit = fit_spectrum(
                transfer.levels, acquisition.instrument, rng=rng, spectra=spectra, transmissions=transmissions
            )
            if transmissions and _contradicts(fit):
                without = fit_spectrum(transfer.levels, acquisition.instrument, rng=rng, spectra=spectra)
                if not _contradicts(without):
                    fit = without
                    evidence["wedges"] = [{**row, "used": False} for row in evidence["wedges"]]
                    warnings.append(
                        "the wedges contradict the flats (scatter behind them, or another thickness than stated) and were"
                        " left out of the spectral fit; a larger gap behind a wedge lowers its scatter"
                    )
        except FitError as error:
            warnings.append(f"no spectral part: {error}")
        else:
            spectral = fit.posterior
            if spectral.correction is not None:
                voltages_kV = ", ".join(f"{kV:g}" for kV in spectral.correction.kV)
                warnings.append(
                    f"spectra were measured at {voltages_kV} kV; at other voltages the tube model is corrected as between or"
                    " nearest to these"
                )
            evidence["spectrum"] = {
                "chi_square": fit.chi_square,
                "data": fit.data,
                "effective_draws": fit.effective_draws,
                "undetermined": list(spectral.undetermined),
                "discrepancy": {name: list(values) for name, values in fit.discrepancy.items()},
                "prior": dict(spectral.prior),
            }
            if _contradicts(fit):
                warnings.append(
                    f"levels and gains do not fit the spectral model (chi-square {fit.chi_square:.0f} for {fit.data}"
                    " data): check kV, filter and power of the series"
                )
    else:
        warnings.append("no series states its kV: no spectral part, no prediction at other settings")
    evidence["bad_pixels"] = bad_pixel_counts(transfer)
    twin = Twin(
        instrument=acquisition.instrument,
        maps=transfer.maps,
        noise=transfer.noise,
        dark_DN=transfer.dark_DN,
        levels=transfer.levels,
        spectral=spectral,
        evidence=evidence,
        warnings=tuple(warnings),
        provenance=provenance or {},
    )
    if advise and spectral is not None:
        tell("next measurement")
        ranked = rank_measurements(twin)
        twin = replace(twin, evidence=evidence | {"next_measurement": ranked[0].as_dict() if ranked else None})
    return twin


def _contradicts(fit: SpectralFit) -> bool:
    """Whether the data lie farther from the best point than their noise allows, by four standard deviations of chi-square."""
    return fit.chi_square > fit.data + 4 * math.sqrt(2 * fit.data)


def bad_pixel_counts(transfer: PhotonTransfer) -> dict[str, int]:
    """Number of bad pixels by reason."""
    return {
        reason: int(np.count_nonzero(transfer.maps.bad_pixels == code))
        for reason, code in BAD_PIXEL_CODES.items()
        if code != 0
    }


def calibration_answer(twin: Twin) -> dict[str, Any]:
    """The answer of `raytwin calibrate --json`."""

    def plain(estimate: Estimate | None) -> dict[str, float] | None:
        return None if estimate is None else estimate.as_dict()

    spectral = twin.spectral
    filtration = flux = None
    warnings = list(twin.warnings)
    if spectral is not None:
        filtration = spectral.interval("inherent_filtration_mm_Al")
        if any(level.rate_DN_per_mAs for level in twin.levels):
            draws = np.exp(spectral.column("log_output"))
            low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975])
            flux = Estimate(value=float(middle), low=float(low), high=float(high))
    if filtration is None:
        warnings.append("inherent_filtration_mm_Al is null: the twin has no spectral part")
    if flux is None:
        warnings.append("flux_scale is null: it needs kV and tube load")
    return {
        "psf_sigma_px": plain(twin.noise.psf_sigma_px),
        "psf_model": twin.noise.psf_model,
        "read_noise_DN": plain(twin.noise.read_noise_DN),
        "dark_DN": plain(twin.dark_DN),
        "inherent_filtration_mm_Al": plain(filtration),
        "flux_scale": plain(flux),
        "levels": [
            {
                "kV": level.kV,
                "filter": text_from_filters(level.filters),
                "gain_DN": level.gain_DN.value,
                "gain_DN_low": level.gain_DN.low,
                "gain_DN_high": level.gain_DN.high,
                "photon_transfer_slope_DN": level.photon_transfer_slope_DN.value,
                "photon_transfer_slope_DN_low": level.photon_transfer_slope_DN.low,
                "photon_transfer_slope_DN_high": level.photon_transfer_slope_DN.high,
                "rate_DN_per_mAs": plain(level.rate_DN_per_mAs),
                "saturation_DN": level.saturation_DN,
                "series": list(level.series),
            }
            for level in twin.levels
        ],
        "bad_pixels": {
            "count": int(np.count_nonzero(twin.maps.bad_pixels)),
            "share_percent": 100.0 * float(np.mean(twin.maps.bad_pixels > 0)),
            "reasons": twin.evidence.get("bad_pixels", {}),
        },
        "undetermined": list(spectral.undetermined) if spectral is not None else [],
        "next_measurement": twin.evidence.get("next_measurement"),
        "evidence": dict(twin.evidence),
        "warnings": warnings,
    }

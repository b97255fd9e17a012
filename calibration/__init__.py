"""From measured darks and flats to a twin: frame sums, photon transfer, optical spread, spectral posterior, validation.

Files:
    calibrate             a session to a twin, top to bottom
    photon_transfer       darks and flats to maps, noise and levels, top to bottom
    frame_sums            sums over the frames of a series, in one pass
    dark_frames           dark level, growth with exposure, read noise
    bad_pixels            pixels that are bad, and why
    interpolated_pixels   pixels that hold means of their neighbours
    full_scale            series that reach the end of the ADC's range
    flat_levels           each series as photon transfer sees it, the level of each beam, the gain map
    flat_evidence         drift, lag, linearity, repeats, shape of the noise
    setting_errors        exposures, distances and a response that are not as stated
    noise_power           noise power of one series
    spread_families       forms that the optical spread may have, and how likely each is
    spread_cells          cells of the frequency plane, electronic noise and slow changes in them
    spread_normal         normal equations, and the prior of white noise that follows the signal
    spread_problem        the noise power of all series as one problem, linear in all but the spread
    spread_candidates     one family of spreads at its best
    spread_changes        slow changes between frames: which series have them, how large they are
    spread_members        spreads that the noise leaves open
    spread_average        the average over these, and the one that stands for all
    spread_agreement      measured noise power against the fitted, and a second route to the gain
    series_scatter        whether the noise of series agrees with what is fitted to all
    spread_fit            optical spread, gain and read noise from the noise power of all series
    noise_sources         the series that this fit takes
    noise_of_flats        the fit to these, less flats that bend away from the line
    repeated_frames       noise where flats are single frames
    common_noise          noise that the pixels of a frame share
    frame_memory          noise that frames take over from those before them
    spectral_fit          posterior of tube, filtration and scintillator
    spectral_data         what flats, wedges and dosimeters say of it
    spectral_model        the declared tube and detector, and priors
    spectral_posterior    the posterior given these
    posterior_draws       draws from it
    priors                what is known before flats are looked at
    wedges                plates of known thickness
    tube                  a tube calibrated with a dosimeter
    dose_data             dosimeter readings as data of the spectral fit
    output_table          dose tables
    transmission_table    transmission tables
    validate              predictions against measured flats and wedges
    next_measurement      the measurement that would narrow predictions most
    frame_checks          copies of frames, change of scene
    code_steps            distance of the ADC's codes
    _measured_table       CSV tables
    _kept_sums            sums of many series, on disk where they are large
    _kernels              compiled loops

Names are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .calibrate import (
        calibrate_twin,
        calibration_answer,
    )
    from .flat_levels import (
        SeriesPoint,
    )
    from .frame_checks import (
        SceneCheck,
        repeated_frame_indices,
        same_scene,
    )
    from .frame_sums import (
        FrameSums,
        effective_frames,
        sum_frames,
    )
    from .next_measurement import (
        NextMeasurement,
        advice,
        rank_measurements,
    )
    from .noise_power import (
        NoisePower,
        compute_difference_power,
        compute_noise_power,
    )
    from .photon_transfer import (
        PhotonTransfer,
        compute_photon_transfer,
    )
    from .priors import (
        PRIORS,
        Prior,
    )
    from .spectral_data import geometry_factor
    from .spectral_fit import (
        SpectralFit,
        fit_spectrum,
    )
    from .spread_fit import (
        SpreadFit,
        fit_spread,
    )
    from .validate import (
        Validation,
        ValidationRow,
        validate_twin,
    )

_LAZY = {
    "SceneCheck": "frame_checks",
    "repeated_frame_indices": "frame_checks",
    "same_scene": "frame_checks",
    "FrameSums": "frame_sums",
    "NextMeasurement": "next_measurement",
    "NoisePower": "noise_power",
    "PRIORS": "priors",
    "PhotonTransfer": "photon_transfer",
    "Prior": "priors",
    "SeriesPoint": "flat_levels",
    "SpectralFit": "spectral_fit",
    "SpreadFit": "spread_fit",
    "Validation": "validate",
    "ValidationRow": "validate",
    "advice": "next_measurement",
    "calibrate_twin": "calibrate",
    "calibration_answer": "calibrate",
    "compute_difference_power": "noise_power",
    "compute_noise_power": "noise_power",
    "compute_photon_transfer": "photon_transfer",
    "effective_frames": "frame_sums",
    "fit_spectrum": "spectral_fit",
    "fit_spread": "spread_fit",
    "geometry_factor": "spectral_data",
    "rank_measurements": "next_measurement",
    "sum_frames": "frame_sums",
    "validate_twin": "validate",
}

__all__ = [
    "PRIORS",
    "FrameSums",
    "NextMeasurement",
    "NoisePower",
    "PhotonTransfer",
    "Prior",
    "SceneCheck",
    "SeriesPoint",
    "SpectralFit",
    "SpreadFit",
    "Validation",
    "ValidationRow",
    "advice",
    "calibrate_twin",
    "calibration_answer",
    "compute_difference_power",
    "compute_noise_power",
    "compute_photon_transfer",
    "effective_frames",
    "fit_spectrum",
    "fit_spread",
    "geometry_factor",
    "rank_measurements",
    "repeated_frame_indices",
    "same_scene",
    "sum_frames",
    "validate_twin",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)

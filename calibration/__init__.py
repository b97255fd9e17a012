"""From measured darks and flats to a twin: frame sums, photon transfer, optical spread, spectral posterior, validation.

Files:
    calibrate           a session to a twin, top to bottom
    validate            predictions against measured flats and wedges
    next_measurement    the measurement that would narrow predictions most

Packages, in the order in which a frame passes them: `frames`, `spread`, `flats`, `spectrum`.

Names are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .calibrate import (
        calibrate_twin,
        calibration_answer,
    )
    from .flats.flat_levels import (
        SeriesPoint,
    )
    from .flats.photon_transfer import (
        PhotonTransfer,
        compute_photon_transfer,
    )
    from .frames.frame_checks import (
        SceneCheck,
        repeated_frame_indices,
        same_scene,
    )
    from .frames.frame_sums import (
        FrameSums,
        effective_frames,
        sum_frames,
    )
    from .next_measurement import (
        NextMeasurement,
        advice,
        rank_measurements,
    )
    from .spectrum.priors import (
        PRIORS,
        Prior,
    )
    from .spectrum.spectral_data import geometry_factor
    from .spectrum.spectral_fit import (
        SpectralFit,
        fit_spectrum,
    )
    from .spread.noise_power import (
        NoisePower,
        compute_difference_power,
        compute_noise_power,
    )
    from .spread.spread_fit import (
        SpreadFit,
        fit_spread,
    )
    from .validate import (
        Validation,
        ValidationRow,
        validate_twin,
    )

_LAZY = {
    "SceneCheck": "frames.frame_checks",
    "repeated_frame_indices": "frames.frame_checks",
    "same_scene": "frames.frame_checks",
    "FrameSums": "frames.frame_sums",
    "NextMeasurement": "next_measurement",
    "NoisePower": "spread.noise_power",
    "PRIORS": "spectrum.priors",
    "PhotonTransfer": "flats.photon_transfer",
    "Prior": "spectrum.priors",
    "SeriesPoint": "flats.flat_levels",
    "SpectralFit": "spectrum.spectral_fit",
    "SpreadFit": "spread.spread_fit",
    "Validation": "validate",
    "ValidationRow": "validate",
    "advice": "next_measurement",
    "calibrate_twin": "calibrate",
    "calibration_answer": "calibrate",
    "compute_difference_power": "spread.noise_power",
    "compute_noise_power": "spread.noise_power",
    "compute_photon_transfer": "flats.photon_transfer",
    "effective_frames": "frames.frame_sums",
    "fit_spectrum": "spectrum.spectral_fit",
    "fit_spread": "spread.spread_fit",
    "geometry_factor": "spectrum.spectral_data",
    "rank_measurements": "next_measurement",
    "sum_frames": "frames.frame_sums",
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

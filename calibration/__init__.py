"""From measured darks and flats to a twin: frame sums, photon transfer, optical spread, spectral posterior, validation.

Names are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .calibrate import (
        calibrate_twin,
        calibration_answer,
    )
    from .check import (
        CheckResult,
        check_acquisition,
    )
    from .findings import (
        Finding,
        FindingCode,
        Severity,
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
        merge_frame_sums,
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
    from .spectral_fit import (
        SpectralFit,
        fit_spectrum,
        geometry_factor,
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
    "CheckResult": "check",
    "check_acquisition": "check",
    "Finding": "findings",
    "FindingCode": "findings",
    "Severity": "findings",
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
    "geometry_factor": "spectral_fit",
    "merge_frame_sums": "frame_sums",
    "rank_measurements": "next_measurement",
    "sum_frames": "frame_sums",
    "validate_twin": "validate",
}

__all__ = [
    "PRIORS",
    "CheckResult",
    "Finding",
    "FindingCode",
    "FrameSums",
    "NextMeasurement",
    "NoisePower",
    "PhotonTransfer",
    "Prior",
    "SceneCheck",
    "SeriesPoint",
    "Severity",
    "SpectralFit",
    "SpreadFit",
    "Validation",
    "ValidationRow",
    "advice",
    "calibrate_twin",
    "calibration_answer",
    "check_acquisition",
    "compute_difference_power",
    "compute_noise_power",
    "compute_photon_transfer",
    "effective_frames",
    "fit_spectrum",
    "fit_spread",
    "geometry_factor",
    "merge_frame_sums",
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

"""The forward model: the twin and its file, optical spread, noise, top-up of references, prediction of flatfields
and of the contrast of foreign objects.

Names are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .as_published import (
        published_parameters,
        sample_as_published,
    )
    from .contrast import (
        Contrast,
        ContrastChannel,
        UncalibratedLine,
        compute_contrast_map,
        predict_contrast,
        published_delta_r,
    )
    from .generate import (
        GenerationSummary,
        generate_dataset,
    )
    from .noise import (
        digitise,
        frame_sd_DN,
        sample_correlated_quanta,
        sample_frame_noise,
    )
    from .predict import (
        Prediction,
        predict_flatfield,
        predict_flatfields,
        slope_share,
        spectral_model_of,
    )
    from .predict_many import (
        Levels,
        predict_levels,
    )
    from .projection import project_polychromatic
    from .psf import (
        PSF_MODELS,
        blur_variance_share,
        noise_autocovariance,
        noise_kernel_1d,
        optical_kernel_1d,
    )
    from .spectral_signal import (
        BeamSignal,
        OpenBeam,
        SpectralModel,
        gain_behind_object,
    )
    from .topup import (
        TopUp,
        apply_top_up,
        plan_top_up,
    )
    from .twin import (
        BAD_PIXEL_CODES,
        DetectorMaps,
        Estimate,
        Level,
        NoiseModel,
        SpectralPosterior,
        Twin,
        estimate_from_sd,
    )
    from .twin_io import (
        read_twin,
        write_twin,
    )

_LAZY = {
    "BAD_PIXEL_CODES": "twin",
    "BeamSignal": "spectral_signal",
    "Contrast": "contrast",
    "ContrastChannel": "contrast",
    "DetectorMaps": "twin",
    "Estimate": "twin",
    "GenerationSummary": "generate",
    "Level": "twin",
    "Levels": "predict_many",
    "NoiseModel": "twin",
    "OpenBeam": "spectral_signal",
    "PSF_MODELS": "psf",
    "Prediction": "predict",
    "SpectralModel": "spectral_signal",
    "SpectralPosterior": "twin",
    "TopUp": "topup",
    "Twin": "twin",
    "UncalibratedLine": "contrast",
    "apply_top_up": "topup",
    "blur_variance_share": "psf",
    "compute_contrast_map": "contrast",
    "digitise": "noise",
    "estimate_from_sd": "twin",
    "frame_sd_DN": "noise",
    "gain_behind_object": "spectral_signal",
    "generate_dataset": "generate",
    "noise_autocovariance": "psf",
    "noise_kernel_1d": "psf",
    "optical_kernel_1d": "psf",
    "plan_top_up": "topup",
    "predict_contrast": "contrast",
    "predict_flatfield": "predict",
    "predict_flatfields": "predict",
    "predict_levels": "predict_many",
    "project_polychromatic": "projection",
    "published_delta_r": "contrast",
    "published_parameters": "as_published",
    "read_twin": "twin_io",
    "sample_as_published": "as_published",
    "sample_correlated_quanta": "noise",
    "sample_frame_noise": "noise",
    "slope_share": "predict",
    "spectral_model_of": "predict",
    "write_twin": "twin_io",
}

__all__ = [
    "BAD_PIXEL_CODES",
    "PSF_MODELS",
    "BeamSignal",
    "Contrast",
    "ContrastChannel",
    "DetectorMaps",
    "Estimate",
    "GenerationSummary",
    "Level",
    "Levels",
    "NoiseModel",
    "OpenBeam",
    "Prediction",
    "SpectralModel",
    "SpectralPosterior",
    "TopUp",
    "Twin",
    "UncalibratedLine",
    "apply_top_up",
    "blur_variance_share",
    "compute_contrast_map",
    "digitise",
    "estimate_from_sd",
    "frame_sd_DN",
    "gain_behind_object",
    "generate_dataset",
    "noise_autocovariance",
    "noise_kernel_1d",
    "optical_kernel_1d",
    "plan_top_up",
    "predict_contrast",
    "predict_flatfield",
    "predict_flatfields",
    "predict_levels",
    "project_polychromatic",
    "published_delta_r",
    "published_parameters",
    "read_twin",
    "sample_as_published",
    "sample_correlated_quanta",
    "sample_frame_noise",
    "slope_share",
    "spectral_model_of",
    "write_twin",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)

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
    from .describe import (
        Description,
        Scene,
        read_description,
        sample_scene,
    )
    from .effects import (
        EFFECTS,
        AppliedEffect,
        Effect,
        Parameter,
    )
    from .generate import (
        GenerationSummary,
        PairTransfer,
        generate_dataset,
    )
    from .generate_described import (
        DescribedScenes,
        generate_from_description,
    )
    from .kernels import (
        deposit_spread_from_photons,
        draw_key,
        gamma_step_DN,
        sample_frames,
        sample_quanta,
    )
    from .noise import (
        digitise,
        frame_sd_DN,
        sample_correlated_quanta,
        sample_frame_noise,
    )
    from .predict import (
        Prediction,
        Predictions,
        predict_flatfield,
        predict_flatfields,
        slope_share,
        spectral_model_of,
    )
    from .predict_many import (
        Levels,
        predict_levels,
    )
    from .predict_settings import asked_settings, predict_words
    from .projection import (
        project_polychromatic,
    )
    from .psf import (
        PSF_MODELS,
        Spread,
        blur_variance_share,
        noise_autocovariance,
        noise_kernel_1d,
        optical_kernel_1d,
    )
    from .registration import (
        estimate_shift_px,
        shift_image,
    )
    from .render import (
        ExpectedImage,
        Geometry,
        render_expected,
    )
    from .series import (
        ExpectedSeries,
        LineMemory,
        ModelCache,
        SeriesRequest,
        beam_conditions,
        expected_series,
        sample_series,
        session_conditions,
        with_conditions,
    )
    from .shipped import (
        shipped_calibration,
        shipped_calibrations,
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
    from .transfer import (
        TransferredPair,
        transfer_pair,
    )
    from .twin import (
        BAD_PIXEL_CODES,
        DetectorMaps,
        Estimate,
        Level,
        NoiseModel,
        SpectralPosterior,
        SpreadEstimate,
        Twin,
        estimate_from_sd,
        gaussian_spread,
    )
    from .twin_answer import calibration_answer, tube_table, twin_table
    from .twin_io import (
        read_twin,
        write_twin,
    )
    from .twin_plot import plot_levels
    from .two_material import (
        TwoMaterialSolution,
        TwoMaterialTables,
        solve_two_materials,
        tabulate_two_materials,
    )

_LAZY = {
    "AppliedEffect": "effects",
    "BAD_PIXEL_CODES": "twin",
    "BeamSignal": "spectral_signal",
    "Contrast": "contrast",
    "ContrastChannel": "contrast",
    "DescribedScenes": "generate_described",
    "Description": "describe",
    "DetectorMaps": "twin",
    "EFFECTS": "effects",
    "Effect": "effects",
    "Estimate": "twin",
    "ExpectedImage": "render",
    "ExpectedSeries": "series",
    "GenerationSummary": "generate",
    "Geometry": "render",
    "Level": "twin",
    "Levels": "predict_many",
    "LineMemory": "series",
    "ModelCache": "series",
    "NoiseModel": "twin",
    "OpenBeam": "spectral_signal",
    "PSF_MODELS": "psf",
    "PairTransfer": "generate",
    "Parameter": "effects",
    "Prediction": "predict",
    "Predictions": "predict",
    "Scene": "describe",
    "SeriesRequest": "series_request",
    "SpectralModel": "spectral_signal",
    "SpectralPosterior": "twin",
    "TopUp": "topup",
    "TransferredPair": "transfer",
    "SpreadEstimate": "twin",
    "Twin": "twin",
    "gaussian_spread": "twin",
    "TwoMaterialSolution": "two_material",
    "TwoMaterialTables": "two_material",
    "UncalibratedLine": "contrast",
    "apply_top_up": "topup",
    "beam_conditions": "series",
    "Spread": "psf",
    "blur_variance_share": "psf",
    "compute_contrast_map": "contrast",
    "deposit_spread_from_photons": "kernels",
    "digitise": "noise",
    "draw_key": "kernels",
    "estimate_from_sd": "twin",
    "estimate_shift_px": "registration",
    "expected_series": "series",
    "frame_sd_DN": "noise",
    "gain_behind_object": "spectral_signal",
    "gamma_step_DN": "kernels",
    "generate_dataset": "generate",
    "generate_from_description": "generate_described",
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
    "read_description": "describe",
    "read_twin": "twin_io",
    "render_expected": "render",
    "sample_as_published": "as_published",
    "sample_correlated_quanta": "noise",
    "sample_frame_noise": "noise",
    "sample_frames": "kernels",
    "sample_quanta": "kernels",
    "sample_scene": "describe",
    "sample_series": "series",
    "session_conditions": "series",
    "shift_image": "registration",
    "shipped_calibration": "shipped",
    "shipped_calibrations": "shipped",
    "slope_share": "predict",
    "solve_two_materials": "two_material",
    "spectral_model_of": "predict",
    "tabulate_two_materials": "two_material",
    "transfer_pair": "transfer",
    "with_conditions": "series",
    "write_twin": "twin_io",
    "asked_settings": "predict_settings",
    "calibration_answer": "twin_answer",
    "plot_levels": "twin_plot",
    "predict_words": "predict_settings",
    "tube_table": "twin_answer",
    "twin_table": "twin_answer",
}

__all__ = [
    "BAD_PIXEL_CODES",
    "EFFECTS",
    "PSF_MODELS",
    "AppliedEffect",
    "BeamSignal",
    "Contrast",
    "ContrastChannel",
    "DescribedScenes",
    "Description",
    "DetectorMaps",
    "Effect",
    "Estimate",
    "ExpectedImage",
    "ExpectedSeries",
    "GenerationSummary",
    "Geometry",
    "Level",
    "Levels",
    "LineMemory",
    "ModelCache",
    "NoiseModel",
    "OpenBeam",
    "PairTransfer",
    "Parameter",
    "Prediction",
    "Predictions",
    "Scene",
    "SeriesRequest",
    "SpectralModel",
    "SpectralPosterior",
    "Spread",
    "SpreadEstimate",
    "TopUp",
    "TransferredPair",
    "Twin",
    "TwoMaterialSolution",
    "TwoMaterialTables",
    "UncalibratedLine",
    "apply_top_up",
    "asked_settings",
    "beam_conditions",
    "blur_variance_share",
    "calibration_answer",
    "compute_contrast_map",
    "deposit_spread_from_photons",
    "digitise",
    "draw_key",
    "estimate_from_sd",
    "estimate_shift_px",
    "expected_series",
    "frame_sd_DN",
    "gain_behind_object",
    "gamma_step_DN",
    "gaussian_spread",
    "generate_dataset",
    "generate_from_description",
    "noise_autocovariance",
    "noise_kernel_1d",
    "optical_kernel_1d",
    "plan_top_up",
    "plot_levels",
    "predict_contrast",
    "predict_flatfield",
    "predict_flatfields",
    "predict_levels",
    "predict_words",
    "project_polychromatic",
    "published_delta_r",
    "published_parameters",
    "read_description",
    "read_twin",
    "render_expected",
    "sample_as_published",
    "sample_correlated_quanta",
    "sample_frame_noise",
    "sample_frames",
    "sample_quanta",
    "sample_scene",
    "sample_series",
    "session_conditions",
    "shift_image",
    "shipped_calibration",
    "shipped_calibrations",
    "slope_share",
    "solve_two_materials",
    "spectral_model_of",
    "tabulate_two_materials",
    "transfer_pair",
    "tube_table",
    "twin_table",
    "with_conditions",
    "write_twin",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)

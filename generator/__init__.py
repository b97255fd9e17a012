"""The forward model: the twin and its file, optical spread, noise, top-up of references, prediction of flatfields
and of the contrast of foreign objects.

Names are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .datasets.generate import (
        GenerationSummary,
        PairTransfer,
        generate_dataset,
    )
    from .datasets.generate_described import (
        DescribedScenes,
        generate_from_description,
    )
    from .datasets.render import (
        ExpectedImage,
        Geometry,
        render_expected,
    )
    from .effects import (
        EFFECTS,
        AppliedEffect,
        Effect,
        Parameter,
    )
    from .frames.conditions import (
        beam_conditions,
        session_conditions,
        with_conditions,
    )
    from .frames.line_model import (
        ExpectedSeries,
        LineMemory,
        LineModel,
    )
    from .frames.model_cache import ModelCache
    from .kernels.kernels import (
        draw_key,
        sample_frames,
    )
    from .kernels.projection import (
        project_polychromatic,
    )
    from .line.series_request import SeriesRequest
    from .line.spectral_signal import (
        BeamSignal,
        OpenBeam,
        SpectralModel,
        gain_behind_object,
    )
    from .line.twin import (
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
    from .predictions.contrast import (
        Contrast,
        ContrastChannel,
        UncalibratedLine,
        compute_contrast_map,
        predict_contrast,
        published_delta_r,
    )
    from .predictions.predict import (
        Prediction,
        Predictions,
        predict_flatfield,
        slope_share,
        spectral_model_of,
    )
    from .predictions.predict_many import (
        Levels,
        predict_levels,
    )
    from .predictions.predict_settings import asked_settings, predict_words
    from .references.as_published import (
        published_parameters,
        sample_as_published,
    )
    from .references.topup import (
        TopUp,
        apply_top_up,
        plan_top_up,
    )
    from .references.transfer import (
        TransferredPair,
        transfer_pair,
    )
    from .references.two_material import (
        TwoMaterialSolution,
        TwoMaterialTables,
        solve_two_materials,
        tabulate_two_materials,
    )
    from .scenes.describe import (
        Description,
        Scene,
        read_description,
        sample_scene,
    )
    from .spread.noise import (
        digitise,
        sample_correlated_quanta,
        sample_frame_noise,
    )
    from .spread.psf import (
        PSF_MODELS,
        Spread,
        blur_variance_share,
        noise_autocovariance,
        noise_kernel_1d,
        optical_kernel_1d,
    )
    from .spread.registration import (
        estimate_shift_px,
        shift_image,
    )
    from .twins.shipped import (
        shipped_calibration,
        shipped_calibrations,
    )
    from .twins.twin_answer import calibration_answer, tube_table, twin_table
    from .twins.twin_io import (
        read_twin,
        write_twin,
    )
    from .twins.twin_plot import plot_levels

_LAZY = {
    "AppliedEffect": "effects",
    "BAD_PIXEL_CODES": "line.twin",
    "BeamSignal": "line.spectral_signal",
    "Contrast": "predictions.contrast",
    "ContrastChannel": "predictions.contrast",
    "DescribedScenes": "datasets.generate_described",
    "Description": "scenes.describe",
    "DetectorMaps": "line.twin",
    "EFFECTS": "effects",
    "Effect": "effects",
    "Estimate": "line.twin",
    "ExpectedImage": "datasets.render",
    "ExpectedSeries": "frames.line_model",
    "GenerationSummary": "datasets.generate",
    "Geometry": "datasets.render",
    "Level": "line.twin",
    "Levels": "predictions.predict_many",
    "LineMemory": "frames.line_model",
    "LineModel": "frames.line_model",
    "ModelCache": "frames.model_cache",
    "NoiseModel": "line.twin",
    "OpenBeam": "line.spectral_signal",
    "PSF_MODELS": "spread.psf",
    "PairTransfer": "datasets.generate",
    "Parameter": "effects",
    "Prediction": "predictions.predict",
    "Predictions": "predictions.predict",
    "Scene": "scenes.describe",
    "SeriesRequest": "line.series_request",
    "SpectralModel": "line.spectral_signal",
    "SpectralPosterior": "line.twin",
    "TopUp": "references.topup",
    "TransferredPair": "references.transfer",
    "SpreadEstimate": "line.twin",
    "Twin": "line.twin",
    "gaussian_spread": "line.twin",
    "TwoMaterialSolution": "references.two_material",
    "TwoMaterialTables": "references.two_material",
    "UncalibratedLine": "predictions.contrast",
    "apply_top_up": "references.topup",
    "beam_conditions": "frames.conditions",
    "Spread": "spread.psf",
    "blur_variance_share": "spread.psf",
    "compute_contrast_map": "predictions.contrast",
    "digitise": "spread.noise",
    "draw_key": "kernels.kernels",
    "estimate_from_sd": "line.twin",
    "estimate_shift_px": "spread.registration",
    "gain_behind_object": "line.spectral_signal",
    "generate_dataset": "datasets.generate",
    "generate_from_description": "datasets.generate_described",
    "noise_autocovariance": "spread.psf",
    "noise_kernel_1d": "spread.psf",
    "optical_kernel_1d": "spread.psf",
    "plan_top_up": "references.topup",
    "predict_contrast": "predictions.contrast",
    "predict_flatfield": "predictions.predict",
    "predict_levels": "predictions.predict_many",
    "project_polychromatic": "kernels.projection",
    "published_delta_r": "predictions.contrast",
    "published_parameters": "references.as_published",
    "read_description": "scenes.describe",
    "read_twin": "twins.twin_io",
    "render_expected": "datasets.render",
    "sample_as_published": "references.as_published",
    "sample_correlated_quanta": "spread.noise",
    "sample_frame_noise": "spread.noise",
    "sample_frames": "kernels.kernels",
    "sample_scene": "scenes.describe",
    "session_conditions": "frames.conditions",
    "shift_image": "spread.registration",
    "shipped_calibration": "twins.shipped",
    "shipped_calibrations": "twins.shipped",
    "slope_share": "predictions.predict",
    "solve_two_materials": "references.two_material",
    "spectral_model_of": "predictions.predict",
    "tabulate_two_materials": "references.two_material",
    "transfer_pair": "references.transfer",
    "with_conditions": "frames.conditions",
    "write_twin": "twins.twin_io",
    "asked_settings": "predictions.predict_settings",
    "calibration_answer": "twins.twin_answer",
    "plot_levels": "twins.twin_plot",
    "predict_words": "predictions.predict_settings",
    "tube_table": "twins.twin_answer",
    "twin_table": "twins.twin_answer",
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
    "LineModel",
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
    "digitise",
    "draw_key",
    "estimate_from_sd",
    "estimate_shift_px",
    "gain_behind_object",
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
    "sample_scene",
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

"""Segmentation: networks that mark foreign objects, how they are trained, and when an object counts as detected.

Nothing here needs torch before a network is built: without the extra `segmentation` the rules of detection still work.
Names are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .channels import NoiseChannels, measure_direction, noise_channels
    from .detection import (
        DETECTION_RECALL,
        MARK_THRESHOLD,
        Detection,
        Rate,
        detect_in_image,
        detect_on_row,
        rate_of_crossed_trials,
        recall_in_mask,
        summarise_detections,
        write_detections,
    )
    from .examples import Examples, examples_from_arrays, examples_from_dataset
    from .losses import LOSSES, cross_entropy_and_dice, dice_as_published
    from .network import build_network, choose_device
    from .own_module import build_module, recipe_for_module
    from .recipe import RECIPES, Recipe, recipe_for_fine_tuning
    from .runs import detect_with_networks, say_who_is_blind, split_for_training, train_networks
    from .runs_io import (
        NetworkResult,
        Runs,
        finished_networks,
        open_runs,
        read_result,
        read_weights,
        recipe_of_start,
    )
    from .scaling import (
        SCALINGS,
        crop_to_shape,
        pad_to_multiple,
        scale_matched,
        scale_min_max,
        scale_residual,
        scaling_named,
    )
    from .segmenters import Segmenter, detect_with_segmenters, segmenter_from_module, segmenter_from_onnx
    from .training import EpochResult, TrainingState, count_epochs, iterate_training, learning_rate_at
    from .weights_io import STARTER_PATH, read_safetensors, starter_recipe, write_safetensors

_LAZY = {
    "channels": ("NoiseChannels", "measure_direction", "noise_channels"),
    "detection": (
        "DETECTION_RECALL",
        "MARK_THRESHOLD",
        "Detection",
        "Rate",
        "detect_in_image",
        "detect_on_row",
        "rate_of_crossed_trials",
        "recall_in_mask",
        "summarise_detections",
        "write_detections",
    ),
    "examples": ("Examples", "examples_from_arrays", "examples_from_dataset"),
    "losses": ("LOSSES", "cross_entropy_and_dice", "dice_as_published"),
    "network": ("build_network", "choose_device"),
    "own_module": ("build_module", "recipe_for_module"),
    "recipe": ("RECIPES", "Recipe", "recipe_for_fine_tuning"),
    "runs": ("detect_with_networks", "say_who_is_blind", "split_for_training", "train_networks"),
    "runs_io": (
        "NetworkResult",
        "Runs",
        "finished_networks",
        "open_runs",
        "read_result",
        "read_weights",
        "recipe_of_start",
    ),
    "scaling": (
        "SCALINGS",
        "crop_to_shape",
        "pad_to_multiple",
        "scale_matched",
        "scale_min_max",
        "scale_residual",
        "scaling_named",
    ),
    "segmenters": ("Segmenter", "detect_with_segmenters", "segmenter_from_module", "segmenter_from_onnx"),
    "training": ("EpochResult", "TrainingState", "count_epochs", "iterate_training", "learning_rate_at"),
    "weights_io": ("STARTER_PATH", "read_safetensors", "starter_recipe", "write_safetensors"),
}
_MODULE_OF_NAME = {name: module for module, names in _LAZY.items() for name in names}

__all__ = [
    "DETECTION_RECALL",
    "LOSSES",
    "MARK_THRESHOLD",
    "RECIPES",
    "SCALINGS",
    "STARTER_PATH",
    "Detection",
    "EpochResult",
    "Examples",
    "NetworkResult",
    "NoiseChannels",
    "Rate",
    "Recipe",
    "Runs",
    "Segmenter",
    "TrainingState",
    "build_module",
    "build_network",
    "choose_device",
    "count_epochs",
    "crop_to_shape",
    "cross_entropy_and_dice",
    "detect_in_image",
    "detect_on_row",
    "detect_with_networks",
    "detect_with_segmenters",
    "dice_as_published",
    "examples_from_arrays",
    "examples_from_dataset",
    "finished_networks",
    "iterate_training",
    "learning_rate_at",
    "measure_direction",
    "noise_channels",
    "open_runs",
    "pad_to_multiple",
    "rate_of_crossed_trials",
    "read_result",
    "read_safetensors",
    "read_weights",
    "recall_in_mask",
    "recipe_for_fine_tuning",
    "recipe_for_module",
    "recipe_of_start",
    "say_who_is_blind",
    "scale_matched",
    "scale_min_max",
    "scale_residual",
    "scaling_named",
    "segmenter_from_module",
    "segmenter_from_onnx",
    "split_for_training",
    "starter_recipe",
    "summarise_detections",
    "train_networks",
    "write_detections",
    "write_safetensors",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_MODULE_OF_NAME[name]}", __name__), name)
    globals()[name] = value
    return value

"""Networks by name, two channels in; DeepLabV3Plus with an EfficientNet-B0 encoder by default. torch is loaded when first used."""

import math
import re
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ._torch import load_segmentation_models, load_torch
from .recipe import Recipe
from .scaling import crop_to_shape, pad_to_multiple

_UNET_CHANNELS = (64, 32, 16, 16, 16)


def _first_sentence(error: Exception) -> str:
    """What a library said, without its lists of names."""
    return re.split(r"[.:\[]\s", " ".join(str(error).strip("\"' ").split()) + " ", maxsplit=1)[0].strip()[:90]


def build_network(recipe: Recipe, *, seed: int, pretrained: bool = True) -> Any:
    """A network with its starting weights: random from the seed, the encoder's from ImageNet where the recipe says.

    Args:
        recipe: classes, BatchNorm momentum, initial probability and encoder weights are used.
        seed: of the random weights; the caller's torch random state is left as it was.
        pretrained: False skips the recipe's encoder weights, for a network whose weights are loaded afterwards.

    Returns:
        torch.nn.Module: (image, 2, row, column) -> logits (image, class, row, column), rows and columns multiples of
        16.

    Raises:
        MissingDependencyError: torch or segmentation-models-pytorch is not installed.
        InputError: the encoder weights cannot be downloaded.

    Source: Chen et al. 2018 (arXiv:1802.02611), Tan and Le 2019 (arXiv:1905.11946), as published by Andriiashen et al.
    """
    torch = load_torch()
    models = load_segmentation_models()
    encoder_weights = recipe.encoder_weights if pretrained else None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                network = models.create_model(
                    recipe.architecture,
                    recipe.encoder,
                    encoder_depth=recipe.encoder_depth,
                    encoder_weights=encoder_weights,
                    in_channels=2,
                    classes=len(recipe.classes),
                    **_decoder_options(recipe),
                )
        except Exception as error:
            if encoder_weights is None:
                raise InputError(
                    "network",
                    received=f"{recipe.architecture} with the encoder {recipe.encoder} ({_first_sentence(error)})",
                    expected="an architecture and an encoder of segmentation-models-pytorch, such as FPN and resnet18",
                ) from None
            raise InputError(
                "encoder weights",
                received=f"{encoder_weights}, which could not be fetched ({type(error).__name__}: {error})",
                expected="a connection to the model hub, or its files in the local cache",
                remedy="leave the option out to train from random weights",
            ) from None
    if recipe.batch_norm_momentum is not None:
        # The encoder's 0.01 forgets its starting statistics only after hundreds of steps: until then a network that
        # has learnt marks nothing when it is evaluated.
        for module in network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.momentum = recipe.batch_norm_momentum
    if recipe.initial_probability is not None:
        odds = recipe.initial_probability / (1.0 - recipe.initial_probability)
        torch.nn.init.constant_(network.segmentation_head[0].bias, math.log(odds))
    return network.to(memory_format=torch.channels_last)


def _decoder_options(recipe: Recipe) -> dict[str, Any]:
    """What an architecture needs to be told so that its decoder fits the encoder's depth."""
    if recipe.architecture in ("Unet", "UnetPlusPlus", "MAnet"):
        return {"decoder_channels": _UNET_CHANNELS[: recipe.encoder_depth]}
    return {}


def choose_device(name: str) -> str:
    """The torch device for `auto`, `cpu`, `cuda`, `cuda:1`, `mps`; `auto` takes a GPU where there is one.

    Raises:
        InputError: a device that torch does not have here.
    """
    torch = load_torch()
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError, ValueError) as error:
        raise InputError(
            "device",
            received=f"{name} ({str(error).splitlines()[0] if str(error) else type(error).__name__})",
            expected="auto, cpu, or a GPU that torch finds on this machine",
        ) from None
    return name


def probabilities_from_scaled(
    network: Any, scaled: NDArray[np.float32], *, recipe: Recipe, device: str = "cpu", batch: int = 8
) -> NDArray[np.float32]:
    """Probability of a foreign object in every pixel (0..1), from scaled pairs of any size.

    Args:
        network: from `build_network`; it is put into evaluation mode.
        scaled: (image, 2, row, column) -log(I/I0), low kV first, each scaled by `scaling_named(recipe.scaling)`.
        recipe: the recipe that the network was trained with (scaling, classes).
        device: torch device on which the network is.
        batch: images at a time.

    Returns:
        (image, row, column) float32.
    """
    torch = load_torch()
    shape = (int(scaled.shape[-2]), int(scaled.shape[-1]))
    padded = pad_to_multiple(scaled, multiple=recipe.multiple_px)
    network.eval()
    pieces = []
    with torch.inference_mode():
        for first in range(0, len(padded), batch):
            logits = network(tensor_from_array(padded[first : first + batch], device=device))
            pieces.append(logits[:, recipe.foreign_object_channel].sigmoid().float().cpu().numpy())
    return np.asarray(crop_to_shape(np.concatenate(pieces), shape=shape), dtype=np.float32)


def tensor_from_array(images: NDArray[Any], *, device: str) -> Any:
    """A channels-last torch tensor on a device, from (image, channel, row, column)."""
    torch = load_torch()
    tensor = torch.from_numpy(np.ascontiguousarray(images))
    return tensor.to(device=device, memory_format=torch.channels_last)

"""A torch module of the user's own, trained and tried as raytwin's networks are.

Protocol: the module is called with scaled log images (image, 2, row, column), low kV first, float32, rows and columns
multiples of the recipe's `multiple_px`, and gives logits (image, class, row, column) of the recipe's classes, the foreign
object last. How images are scaled, augmented and batched, the loss and the optimizer are the recipe's.

A module can be given, or a function without arguments that makes one. Networks from a function start from different random
weights; a module is copied, so that all networks start from its weights.
"""

import copy
import dataclasses
import hashlib
from typing import Any

from ..errors import InputError
from ._torch import load_torch
from .network import build_network
from .recipe import OWN_MODULE, Recipe


def recipe_for_module(recipe: Recipe) -> Recipe:
    """The same recipe for a module of the user's own: it names no architecture and no encoder.

    Raises:
        InputError: a recipe with encoder weights, which such a module does not have.
    """
    if recipe.encoder_weights is not None:
        raise InputError(
            "encoder weights",
            received=f"{recipe.encoder_weights} with a module of your own",
            expected="none of raytwin's",
        )
    return dataclasses.replace(
        recipe, architecture=OWN_MODULE, encoder="none", batch_norm_momentum=None, initial_probability=None
    )


def build_module(network: Any, *, recipe: Recipe, seed: int) -> Any:
    """One network from what the user gave; the caller's torch random state is left as it was.

    Args:
        network: a torch.nn.Module, which is copied, or a function without arguments that makes one.
        recipe: classes and `multiple_px` are used.
        seed: of the random weights that a function draws.

    Returns:
        torch.nn.Module as the module's head says, in training mode.

    Raises:
        InputError: something else, or an answer of another shape.

    Example:
        >>> import torch
        >>> from raytwin.segmentation import RECIPES, build_module
        >>> make = lambda: torch.nn.Conv2d(2, 1, 5, padding=2)
        >>> build_module(make, recipe=RECIPES["raytwin"], seed=1)
        Conv2d(2, 1, kernel_size=(5, 5), stride=(1, 1), padding=(2, 2))
    """
    torch = load_torch()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if isinstance(network, torch.nn.Module):
            module = copy.deepcopy(network)
        elif callable(network):
            module = network()
        else:
            module = network
    if not isinstance(module, torch.nn.Module):
        raise InputError(
            "network",
            received=f"a {type(module).__name__}",
            expected="a torch.nn.Module, or a function without arguments that makes one",
        )
    _check_answer(module, recipe)
    # images come channels last, which a module that reshapes them may not take
    module.register_forward_pre_hook(lambda _, given: tuple(one.contiguous() for one in given))
    return module.train()


def network_of(recipe: Recipe, network: Any, *, seed: int, pretrained: bool = True) -> Any:
    """The recipe's network where `network` is None, else the user's module; arguments as of `build_network` and `build_module`."""
    if network is None:
        return build_network(recipe, seed=seed, pretrained=pretrained)
    return build_module(network, recipe=recipe, seed=seed)


def module_signature(network: Any, *, recipe: Recipe, seed: int) -> dict[str, Any]:
    """What tells the modules of a folder from others: a hash of the names and shapes of their weights, and of a given start."""
    torch = load_torch()
    weights = build_module(network, recipe=recipe, seed=seed).state_dict()
    shapes = "|".join(f"{name} {tuple(value.shape)} {value.dtype}" for name, value in weights.items())
    start = hashlib.sha256()
    for value in weights.values():
        start.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return {"weights": hashlib.sha256(shapes.encode()).hexdigest(), "first_start": start.hexdigest()}


def _check_answer(module: Any, recipe: Recipe) -> None:
    """Refuse a module whose answer the loss could not take, before anything long is begun."""
    torch = load_torch()
    side = max(2 * recipe.multiple_px, 32)
    wanted = (1, len(recipe.classes), side, side)
    try:
        with torch.inference_mode():
            found = module.eval()(torch.zeros(1, 2, side, side))
    except Exception as error:
        raise InputError(
            "network",
            received=f"a module that fails on images (1, 2, {side}, {side}): {' '.join(str(error).split())[:120]}",
            expected="log images (image, 2, row, column) -> logits (image, class, row, column)",
        ) from None
    shape = tuple(found.shape) if isinstance(found, torch.Tensor) else type(found).__name__
    if shape != wanted:
        raise InputError(
            "network",
            received=f"an answer of {shape} to images (1, 2, {side}, {side})",
            expected=f"logits {wanted} (image, class, row, column) of {' and '.join(recipe.classes)}",
        )

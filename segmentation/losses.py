"""Losses on logits; a choice of loss is a key of `LOSSES`. Functions on torch tensors; torch is loaded when first used.

Shapes: logits and targets (image, class, row, column), targets 0 or 1.
"""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any

from ._torch import load_segmentation_models, load_torch

# One pixel: smaller, and the Dice term of a boneless image is blind; larger, and small bones count for less.
_SMOOTH_PX = 1.0


def cross_entropy_and_dice(logits: Any, targets: Any) -> Any:
    """Binary cross-entropy plus soft Dice, image by image and class by class, then averaged (no unit).

    loss = mean BCE + 1 - (2 sum(p y) + s) / (sum p + sum y + s), p = sigmoid(logit), sums over one image, s = 1 pixel.
    For an image without the class this is mean BCE + sum p / (sum p + s): every marked pixel costs, so boneless
    products teach a network not to cry wolf. It is 0 where nothing is marked and nothing is there.

    Args:
        logits: (image, class, row, column) tensor.
        targets: the same shape, 0 or 1.

    Returns:
        Scalar tensor.

    Source: V-Net's soft Dice (Milletari et al. 2016, arXiv:1606.04797) per image, with the smoothing inside.
    """
    functional = load_torch().nn.functional
    targets = targets.to(logits.dtype)
    entropy = functional.binary_cross_entropy_with_logits(logits, targets)
    probabilities = logits.sigmoid()
    overlap = (probabilities * targets).sum((-2, -1))
    total = probabilities.sum((-2, -1)) + targets.sum((-2, -1))
    return entropy + (1.0 - (2.0 * overlap + _SMOOTH_PX) / (total + _SMOOTH_PX)).mean()


def dice_as_published(logits: Any, targets: Any) -> Any:
    """Dice loss of segmentation-models-pytorch over the whole batch, as published (no unit).

    A class that no image of the batch holds is left out of it, so that it has no gradient: a batch of boneless products
    teaches nothing about bones.

    Args and Returns: as `cross_entropy_and_dice`.
    """
    losses = load_segmentation_models().losses
    return losses.DiceLoss(losses.MULTILABEL_MODE, from_logits=True)(logits, targets)


LOSSES: MappingProxyType[str, Callable[[Any, Any], Any]] = MappingProxyType(
    {"cross_entropy_and_dice": cross_entropy_and_dice, "dice": dice_as_published}
)

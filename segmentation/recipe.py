"""How a network is trained: one frozen table of choices, with the two recipes that raytwin ships."""

import dataclasses
import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from ..errors import InputError
from .augmentation import AUGMENTATIONS
from .losses import LOSSES
from .scaling import MATCHED, scaling_named

FOREIGN_OBJECT = "foreign_object"
PRODUCT = "product"
ARCHITECTURE = "DeepLabV3Plus"
ENCODER = "efficientnet-b0"
OWN_MODULE = "own module"  # in the place of an architecture: a torch module that the user passes
_DILATED = ("DeepLabV3", "DeepLabV3Plus")  # the encoder stops at a sixteenth (DeepLabV3: an eighth) of the resolution

_CHOICES = {
    "augmentation": tuple(AUGMENTATIONS),
    "loss": tuple(LOSSES),
    "optimizer": ("adam", "adamw"),
    "schedule": ("constant", "one_cycle"),
    "encoder_weights": (None, "imagenet"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """What decides a training run, apart from the data, the seed and the weights it starts from.

    Fields: name; scaling (`min_max`, `residual`, `matched:DEGREES`, or `matched`, whose direction `train_networks` measures);
    augmentation, loss (keys of their tables); classes (output channels, the foreign object
    last); optimizer; learning_rate (peak of a one-cycle schedule); weight_decay; schedule; steps or epochs (exactly
    one; an epoch is one pass over the training images, steps are rounded up to whole epochs); batch (images a step, 2
    or more); crop_px (side of the square cut round the foreign object, None = whole images); batch_norm_momentum (None
    = the encoder's own 0.01); initial_probability (of a marked pixel before training, None = 0.5); encoder_weights;
    architecture and encoder (names of segmentation-models-pytorch, such as `FPN` and `resnet18`); encoder_depth (halvings of
    the resolution, 3 to 5).
    """

    name: str
    scaling: str
    augmentation: str
    loss: str
    classes: tuple[str, ...]
    optimizer: str
    learning_rate: float
    weight_decay: float = 0.0
    schedule: str = "constant"
    steps: int | None = None
    epochs: int | None = None
    batch: int = 2
    crop_px: int | None = None
    batch_norm_momentum: float | None = None
    initial_probability: float | None = None
    encoder_weights: str | None = None
    architecture: str = ARCHITECTURE
    encoder: str = ENCODER
    encoder_depth: int = 5

    def __post_init__(self) -> None:
        for field, choices in _CHOICES.items():
            if getattr(self, field) not in choices:
                raise InputError(
                    field, received=repr(getattr(self, field)), expected="one of " + ", ".join(map(str, choices))
                )
        if self.scaling != MATCHED:
            scaling_named(self.scaling)
        if self.classes not in ((FOREIGN_OBJECT,), (PRODUCT, FOREIGN_OBJECT)):
            raise InputError("classes", received=self.classes, expected="(product and) foreign_object")
        if not (math.isfinite(self.learning_rate) and 0 < self.learning_rate <= 1):
            raise InputError("learning rate", received=self.learning_rate, expected="a number above 0, at most 1")
        if not (math.isfinite(self.weight_decay) and self.weight_decay >= 0):
            raise InputError("weight decay", received=self.weight_decay, expected="0 or more")
        if (self.steps is None) == (self.epochs is None):
            raise InputError(
                "steps and epochs",
                received=f"{self.steps} and {self.epochs}",
                expected="exactly one of the two",
            )
        for field, least in (("steps", 1), ("epochs", 1), ("batch", 2), ("crop_px", 16)):
            value = getattr(self, field)
            if value is not None and value < least:
                raise InputError(field, received=value, expected=f"a whole number, {least} or more")
        if not 3 <= self.encoder_depth <= 5:
            raise InputError("encoder depth", received=self.encoder_depth, expected="3, 4 or 5")
        for field in ("batch_norm_momentum", "initial_probability"):
            value = getattr(self, field)
            if value is not None and not 0 < value < 1:
                raise InputError(field, received=value, expected="a number between 0 and 1")

    @property
    def foreign_object_channel(self) -> int:
        """Index of the network's output channel that marks the foreign object."""
        return len(self.classes) - 1

    @property
    def multiple_px(self) -> int:
        """Rows and columns of what the network is given are multiples of it."""
        return 16 if self.architecture in _DILATED else 2**self.encoder_depth


# The paper does not say so, but the authors' code starts its encoder from ImageNet, its library's default: the option
# `--encoder-weights imagenet` does the same.
STARTER = "starter"  # the network that comes with raytwin, see `weights_io`; and what is trained from it
RECIPES: MappingProxyType[str, Recipe] = MappingProxyType(
    {
        "raytwin": Recipe(
            name="raytwin",
            scaling=MATCHED,
            augmentation="exact",
            loss="cross_entropy_and_dice",
            classes=(FOREIGN_OBJECT,),
            optimizer="adamw",
            learning_rate=3e-3,
            weight_decay=1e-2,
            schedule="one_cycle",
            steps=600,
            batch=8,
            batch_norm_momentum=0.1,
            initial_probability=0.02,
        ),
        "as_published": Recipe(
            name="as_published",
            scaling="min_max",
            augmentation="as_published",
            loss="dice",
            classes=(PRODUCT, FOREIGN_OBJECT),
            optimizer="adam",
            learning_rate=1e-4,
            epochs=500,
            batch=2,
        ),
    }
)


def recipe_for_fine_tuning(recipe: Recipe) -> Recipe:
    """The same recipe for a network that starts from a trained one: a quarter of the steps at a third of the rate.

    A recipe counted in epochs stays as it is: the published one has no such stage.
    """
    if recipe.steps is None:
        return recipe
    return dataclasses.replace(recipe, steps=math.ceil(recipe.steps / 4), learning_rate=recipe.learning_rate / 3)


def recipe_from_mapping(values: dict[str, Any]) -> Recipe:
    """The recipe that `dataclasses.asdict` and JSON made a mapping of.

    Raises:
        InputError: unknown or missing fields, or a value that a recipe cannot have.
    """
    known = {field.name for field in dataclasses.fields(Recipe)}
    needed = {field.name for field in dataclasses.fields(Recipe) if field.default is dataclasses.MISSING}
    if not needed <= set(values) <= known:
        raise InputError(
            "recipe",
            received="fields " + ", ".join(sorted(values)),
            expected="those of this version of raytwin: " + ", ".join(sorted(known)),
        )
    return Recipe(**{**values, "classes": tuple(values["classes"])})

"""Training of one network, epoch by epoch; each epoch's state is enough to go on from, and gives the same network.

Functions on arrays and torch tensors: no files, no printing. Randomness is drawn anew for every epoch from (seed,
network, epoch), so that a run that was stopped and resumed draws what an uninterrupted one would have drawn.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError
from ._torch import load_torch
from .augmentation import AUGMENTATIONS, crop_around_object
from .detection import DETECTION_RECALL, MARK_THRESHOLD, recall_in_mask
from .examples import Examples
from .losses import LOSSES
from .network import tensor_from_array
from .own_module import network_of
from .recipe import Recipe
from .scaling import crop_to_shape, pad_to_multiple
from .training_step import TrainingStep

# Validation costs about a third of a training step an image: small sets are not validated after every short epoch.
_STEPS_BETWEEN_VALIDATIONS = 25
_WARM_UP_SHARE = 0.2
_FIRST_RATE_SHARE = 0.04
_VALIDATION_BATCH = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class EpochResult:
    """One epoch: number (from 1), mean training loss, and where it was validated: loss, mean recall of the foreign
    objects' pixels, share of them detected, share of images without one in which anything is marked (None where the
    validation images hold none of the kind).
    """

    epoch: int
    loss: float
    validation_loss: float | None = None
    validation_recall: float | None = None
    validation_hit_rate: float | None = None
    validation_false_alarm_rate: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingState:
    """Where training stands after an epoch: epochs done and wanted, history, weights, optimizer, best weights so far.

    `weights` and `optimizer` are those of the running training, not copies: use or save them before the next epoch.
    """

    epochs_done: int
    epochs_wanted: int
    history: tuple[EpochResult, ...]
    weights: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    best_weights: Mapping[str, Any]
    best_epoch: int
    best_loss: float

    @property
    def finished(self) -> bool:
        """Whether all epochs are done."""
        return self.epochs_done >= self.epochs_wanted


def count_epochs(recipe: Recipe, *, n_images: int) -> int:
    """Passes over `n_images` training images that a recipe asks for; steps are rounded up to whole passes."""
    if recipe.epochs is not None:
        return recipe.epochs
    return math.ceil((recipe.steps or 1) / _steps_per_epoch(recipe, n_images))


def learning_rate_at(step: int, *, recipe: Recipe, steps: int) -> float:
    """Learning rate of a step (from 0) among `steps`: constant, or one cycle.

    One cycle: up along half a cosine from 4 % of the peak during the first fifth, then down along half a cosine to 0.

    Source: Smith and Topin 2017 (arXiv:1708.07120), the cosine form.
    """
    if recipe.schedule == "constant":
        return recipe.learning_rate
    rise = _WARM_UP_SHARE * steps
    if step < rise:
        share = _FIRST_RATE_SHARE + (1.0 - _FIRST_RATE_SHARE) * 0.5 * (1.0 - math.cos(math.pi * step / rise))
    else:
        share = 0.5 * (1.0 + math.cos(math.pi * (step - rise) / max(steps - rise, 1.0)))
    return recipe.learning_rate * share


def iterate_training(
    train: Examples,
    validation: Examples,
    *,
    recipe: Recipe,
    seed: int,
    network_number: int = 0,
    device: str = "cpu",
    start_from: Mapping[str, Any] | None = None,
    resume: TrainingState | None = None,
    network: Any = None,
) -> Iterator[TrainingState]:
    """Train one network, giving its state after every epoch; the best weights are those of the lowest validation loss.

    The same arguments give the same weights on the same processor, torch and number of threads, resumed or not. A GPU
    adds in an order that changes: there the last bits differ from run to run, and what grows from them, unless torch is told to
    use deterministic algorithms (`torch.use_deterministic_algorithms(True)`).

    Args:
        train, validation: labelled images.
        recipe: what to do.
        seed, network_number: of the randomness; networks of other numbers start and are trained differently.
        device: torch device.
        start_from: weights of a trained network to start with instead of random ones.
        resume: state to go on from.
        network: a module of the user's own, or what makes one (`own_module`); None: the recipe's.

    Returns:
        Iterator of states, the last one `finished`; nothing where `resume` is finished already.

    Raises:
        InputError: no foreign object in the training images, no images, or weights that do not fit the network.
        FitError: the loss is no longer finite.
    """
    torch = load_torch()
    _check_examples(train, validation)
    epochs = count_epochs(recipe, n_images=len(train))
    steps_per_epoch = _steps_per_epoch(recipe, len(train))
    interval = max(1, _STEPS_BETWEEN_VALIDATIONS // steps_per_epoch)

    fresh = start_from is None and resume is None
    module = network_of(recipe, network, seed=_seed(seed, network_number, 0), pretrained=fresh)
    load_weights(module, resume.weights if resume is not None else start_from)
    module = module.to(device)
    step = TrainingStep(module, recipe=recipe, device=device, record=network is None)
    history: list[EpochResult] = []
    best_weights: Mapping[str, Any] = {}
    best_epoch, best_loss = 0, math.inf
    if resume is not None:
        step.go_on_from(resume.optimizer)
        history = list(resume.history)
        best_weights, best_epoch, best_loss = resume.best_weights, resume.best_epoch, resume.best_loss

    for epoch in range(len(history) + 1, epochs + 1):
        gpus = [device] if device.startswith("cuda") else []
        module.train()
        with torch.random.fork_rng(devices=gpus):
            torch.manual_seed(_seed(seed, network_number, epoch))
            loss = _train_epoch(
                step,
                train.at_epoch(epoch),
                recipe=recipe,
                generator=np.random.default_rng([seed, network_number, epoch]),
                first_step=(epoch - 1) * steps_per_epoch,
                steps=epochs * steps_per_epoch,
            )
        if not math.isfinite(loss):
            raise FitError(
                f"training of network {network_number}: the loss is not finite in epoch {epoch};"
                " lower the learning rate or look at the images"
            )
        if epoch % interval == 0 or epoch == epochs:
            result = _validate(module, validation, recipe=recipe, device=device, epoch=epoch, loss=loss)
            if result.validation_loss is not None and result.validation_loss < best_loss:
                best_loss, best_epoch = result.validation_loss, epoch
                best_weights = {name: value.detach().clone() for name, value in module.state_dict().items()}
        else:
            result = EpochResult(epoch=epoch, loss=loss)
        history.append(result)
        yield TrainingState(
            epochs_done=epoch,
            epochs_wanted=epochs,
            history=tuple(history),
            weights=module.state_dict(),
            optimizer=step.optimizer.state_dict(),
            best_weights=best_weights,
            best_epoch=best_epoch,
            best_loss=best_loss,
        )


def _train_epoch(
    step: TrainingStep,
    train: Examples,
    *,
    recipe: Recipe,
    generator: np.random.Generator,
    first_step: int,
    steps: int,
) -> float:
    """One pass; returns the mean loss."""
    losses = []
    batches = _batches(len(train), recipe.batch, generator)
    for number, chosen in enumerate(batches, start=first_step):
        pairs = [_augmented(train[one], recipe, generator) for one in chosen]
        images, masks = (np.stack(arrays) for arrays in zip(*pairs, strict=True))
        losses.append(step(images, masks, rate=learning_rate_at(number, recipe=recipe, steps=steps)))
    # read once an epoch: so a GPU works on while the next batch is made
    return float(sum(load_torch().stack(losses).tolist()) / len(batches))


def _augmented(
    example: tuple[NDArray[np.float32], NDArray[np.uint8]], recipe: Recipe, generator: np.random.Generator
) -> tuple[NDArray[Any], NDArray[Any]]:
    image, masks = AUGMENTATIONS[recipe.augmentation](*example, generator=generator)
    if recipe.crop_px is not None:
        image, masks = crop_around_object(image, masks, size_px=recipe.crop_px, generator=generator)
    return pad_to_multiple(image, multiple=recipe.multiple_px), pad_to_multiple(masks, multiple=recipe.multiple_px)


def _batches(count: int, batch: int, generator: np.random.Generator) -> list[NDArray[np.intp]]:
    # Every batch is full, the last one filled up from the front of the order: BatchNorm on a single image fails.
    order = generator.permutation(count)
    length = -(-count // batch) * batch
    return list(np.resize(order, length).reshape(-1, batch))


def _validate(
    network: Any, validation: Examples, *, recipe: Recipe, device: str, epoch: int, loss: float
) -> EpochResult:
    torch = load_torch()
    loss_function = LOSSES[recipe.loss]
    network.eval()
    losses: list[float] = []
    recalls: list[float] = []
    alarms: list[bool] = []
    with torch.inference_mode():
        for first in range(0, len(validation), _VALIDATION_BATCH):
            pairs = [validation[number] for number in range(first, min(first + _VALIDATION_BATCH, len(validation)))]
            images = np.stack([pad_to_multiple(image, multiple=recipe.multiple_px) for image, _ in pairs])
            masks = np.stack([pad_to_multiple(mask, multiple=recipe.multiple_px) for _, mask in pairs])
            logits = network(tensor_from_array(images, device=device))
            # Weighted by images, so that a short last batch does not count for more.
            losses += [float(loss_function(logits, tensor_from_array(masks, device=device)))] * len(pairs)
            marked = logits[:, recipe.foreign_object_channel].sigmoid().cpu().numpy() > MARK_THRESHOLD
            for (image, mask), inside in zip(pairs, marked, strict=True):
                cropped = crop_to_shape(inside, shape=(image.shape[-2], image.shape[-1]))
                if mask[-1].any():
                    recalls.append(recall_in_mask(cropped, mask[-1]))
                else:
                    alarms.append(bool(cropped.any()))
    return EpochResult(
        epoch=epoch,
        loss=loss,
        validation_loss=_finite_mean(losses),
        validation_recall=_finite_mean(recalls),
        validation_hit_rate=_finite_mean([recall > DETECTION_RECALL for recall in recalls]),
        validation_false_alarm_rate=_finite_mean(alarms),
    )


def _finite_mean(values: list[float] | list[bool]) -> float | None:
    return float(np.mean(values)) if values and bool(np.isfinite(values).all()) else None


def _check_examples(train: Examples, validation: Examples) -> None:
    for name, examples in (("training", train), ("validation", validation)):
        if not len(examples):
            raise InputError(f"{name} images", received="none", expected="at least one image pair")
    if not any(train[number][1][-1].any() for number in range(len(train))):
        raise InputError(
            "training images",
            received=f"{len(train)} without a foreign object in their masks",
            expected="some with one: a network cannot learn what it never sees",
        )


def _steps_per_epoch(recipe: Recipe, n_images: int) -> int:
    return -(-n_images // recipe.batch)


def _seed(*entropy: int) -> int:
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> 1)


def load_weights(network: Any, weights: Mapping[str, Any] | None) -> None:
    """Give a network its weights; None leaves it as it is.

    Raises:
        InputError: weights of another network.
    """
    if weights is None:
        return
    try:
        network.load_state_dict(weights)
    except (RuntimeError, TypeError) as error:
        raise InputError(
            "weights",
            received=str(error)[:120],
            expected="weights of a network of the same classes and architecture",
        ) from None

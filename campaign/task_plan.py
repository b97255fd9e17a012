"""What a task is asked: how large its trial is, and what the user brings."""

from dataclasses import dataclass
from pathlib import Path

from ..acquisition.setting import Setting
from ..errors import InputError

SIZES = {"size_mm": "mm", "contrast": ""}


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskPlan:
    """How large the trial is.

    Fields: networks of each kind; start_steps, steps (training of the common start, and of each network after it); batch;
    crop_px (side of the squares round the objects that networks learn from, 0 = whole images); draws (images of each known
    product, each with its own noise; of measured ones: at most as many frames); images (for training and again for trying,
    where products come from a description or from reference images); test_share, validation_share of the measured
    products, where the file does not say; marked_share (of the images a network learnt from that may show a mark away from
    objects: sets its threshold); size (`size_mm` or `contrast`); seed.
    """

    networks: int = 6
    start_steps: int = 60
    steps: int = 60
    batch: int = 8
    crop_px: int = 64
    draws: int = 2
    images: int = 120
    test_share: float = 0.5
    validation_share: float = 0.1
    marked_share: float = 0.1
    size: str = "contrast"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (
            ("networks", 1),
            ("start_steps", 1),
            ("steps", 1),
            ("batch", 2),
            ("crop_px", 0),
            ("draws", 1),
            ("images", 10),
        ):
            if getattr(self, name) < least:
                raise InputError(name, received=getattr(self, name), expected=f"a whole number, {least} or more")
        if not 0 < self.marked_share < 1:
            raise InputError("marked_share", received=self.marked_share, expected="a share between 0 and 1")
        if self.size not in SIZES:
            raise InputError("size of the objects", received=self.size, expected="one of " + ", ".join(SIZES))


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskInput:
    """What the user brings: measured images (acquisition or dataset), what to generate from, the pair of settings.

    Fields: measured; products: acquisition with path lengths, dataset of reference images, or a description (.toml); None: the
    path lengths in `measured`; low, high: settings; None: the only pair there is, or that of the shortest exposure.
    """

    measured: Path
    products: Path | None = None
    low: Setting | None = None
    high: Setting | None = None

"""Networks that were made elsewhere: a torch module, an ONNX file, or any function of images, tried as raytwin's own are.

One protocol: a segmenter is called with log images (image, 2, row, column), -log(I/I0), low kV first, float32, and gives the
probability of a foreign object in each pixel (image, row, column), 0 to 1. Masks from another program come from a function that
returns them. A torch module that is trained here first: `own_module`.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MissingDependencyError
from ._torch import load_torch
from .detection import MARK_THRESHOLD, Detection, detect_on_row
from .scaling import crop_to_shape, pad_to_multiple, scaling_named

if TYPE_CHECKING:
    from ..acquisition.dataset_io import Dataset

_BATCH = 8
CLASSES = ("exclusive", "independent")  # how the classes of one pixel stand to each other


class Segmenter(Protocol):
    """Whatever gives the probability of a foreign object (image, row, column) of log images (image, 2, row, column)."""

    def __call__(self, images: NDArray[np.float32], /) -> NDArray[Any]: ...


def segmenter_from_module(
    module: Any,
    *,
    scaling: str | None = None,
    probabilities: bool = False,
    classes: str | None = None,
    device: str = "cpu",
    multiple_px: int = 32,
    warn: Callable[[str], None] | None = None,
) -> Segmenter:
    """A torch module as a segmenter; it is put into evaluation mode.

    What its answer means follows from its shape:

    - (image, row, column) or one class, (image, 1, row, column): a sigmoid makes probabilities of logits.
    - several classes, (image, class, row, column): the last one is the foreign object. Logits do not tell whether a pixel has one
      class or may have several, so `classes` says it: `exclusive` takes a softmax over the classes, `independent` a sigmoid of
      the last. Without it they are taken as exclusive, and `warn` is told so.
    - whole numbers or truth values, (image, row, column): marks, 0 or 1 (an argmax over two classes).

    Args:
        module: called with (image, 2, row, column) float32.
        scaling: of the images that it was trained on, `min_max`, `residual` or `matched:DEGREES`; None: log images as they are.
        probabilities: whether it gives these; False: logits.
        classes: `exclusive`, `independent`, or None.
        device: torch device that it is brought to.
        multiple_px: images are padded to a multiple of it, as networks with a stride ask for; 1: not at all.
        warn: called once with a line where the classes were taken as exclusive without being told.

    Raises:
        InputError: an unknown scaling or word for the classes; when called, an answer of another shape, or labels above 1.

    Example:
        >>> import numpy as np, torch
        >>> from raytwin.segmentation import segmenter_from_module
        >>> network = torch.nn.Conv2d(2, 1, 3, padding=1)
        >>> segmenter_from_module(network)(np.zeros((1, 2, 40, 50), dtype=np.float32)).shape
        (1, 40, 50)
    """
    torch = load_torch()
    network = module.to(device).eval()

    def run(batch: NDArray[np.float32]) -> NDArray[Any]:
        with torch.inference_mode():
            found = network(torch.from_numpy(batch).to(device))
            if not isinstance(found, torch.Tensor):
                raise InputError(
                    "torch module", received=f"an answer that is a {type(found).__name__}", expected="one tensor"
                )
            return np.asarray((found.float() if found.is_floating_point() else found).cpu().numpy())

    return _scaled(
        run, scaling=scaling, multiple_px=multiple_px, probabilities=probabilities, classes=classes, warn=warn
    )


def segmenter_from_onnx(
    path: str | os.PathLike[str],
    *,
    scaling: str | None = None,
    probabilities: bool = False,
    classes: str | None = None,
    multiple_px: int = 32,
    warn: Callable[[str], None] | None = None,
) -> Segmenter:
    """The network of an ONNX file as a segmenter, run by onnxruntime on the processor; arguments as of `segmenter_from_module`.

    Its one input is (image, 2, row, column) float32; a fixed batch or size must be that of the images.

    Raises:
        InputError: no such file, or one that onnxruntime does not read.
        MissingDependencyError: onnxruntime is not installed.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(str(path), received="no such file", expected="a network (.onnx)")
    try:
        import onnxruntime
    except ImportError:
        raise MissingDependencyError(
            "ONNX files need onnxruntime, which is not installed; install it with `pip install 'raytwin[onnx]'`"
        ) from None
    try:
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    except Exception as error:
        line = str(error).strip().splitlines()
        raise InputError(
            str(path),
            received=f"a file that onnxruntime does not read ({line[0] if line else type(error).__name__})",
            expected="a network (.onnx)",
        ) from None
    inputs = session.get_inputs()
    if len(inputs) != 1:
        raise InputError(
            str(path), received=f"a network of {len(inputs)} inputs", expected="one input, (image, 2, row, column)"
        )
    one_by_one = inputs[0].shape[0] == 1  # exported with a batch of one

    def run(batch: NDArray[np.float32]) -> NDArray[Any]:
        parts = [batch[place : place + 1] for place in range(len(batch))] if one_by_one else [batch]
        try:
            found = np.concatenate([session.run(None, {inputs[0].name: part})[0] for part in parts])
        except Exception as error:
            raise InputError(
                str(path),
                received=f"images of {batch.shape[1:]} that the network refuses ({str(error).strip().splitlines()[0]})",
                expected=f"its input, {inputs[0].shape}",
            ) from None
        return np.asarray(found)

    return _scaled(
        run, scaling=scaling, multiple_px=multiple_px, probabilities=probabilities, classes=classes, warn=warn
    )


def _scaled(
    run: Callable[[NDArray[np.float32]], NDArray[Any]],
    *,
    scaling: str | None,
    multiple_px: int,
    probabilities: bool,
    classes: str | None,
    warn: Callable[[str], None] | None,
) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    scale = None if scaling is None else scaling_named(scaling)

    if classes is not None and classes not in CLASSES:
        raise InputError("classes", received=repr(classes), expected="None or one of " + ", ".join(CLASSES))
    told = False

    def segment(images: NDArray[np.float32]) -> NDArray[np.float32]:
        wanted = images if scale is None else np.stack([scale(image) for image in images])
        padded = pad_to_multiple(np.asarray(wanted, dtype=np.float32), multiple=multiple_px)
        nonlocal told
        answer = run(np.ascontiguousarray(padded))
        found = _object_probability(answer, probabilities=probabilities, classes=classes)
        if classes is None and not probabilities and answer.ndim == 4 and answer.shape[1] > 1 and not told:
            told = True
            if warn is not None:
                warn(
                    f"logits of {answer.shape[1]} classes: taken as exclusive (softmax), the last one as the foreign object;"
                    " say classes independent where a pixel may have several"
                )
        return np.asarray(crop_to_shape(found, shape=images.shape[-2:]), dtype=np.float32)

    return segment


def _object_probability(answer: NDArray[Any], *, probabilities: bool, classes: str | None) -> NDArray[Any]:
    """Probability of the foreign object (image, row, column) from a network's answer; see `segmenter_from_module`."""
    if answer.dtype.kind in "bui":
        if answer.ndim != 3 or not np.all((answer == 0) | (answer == 1)):
            raise InputError(
                "network",
                received=f"whole numbers of shape {answer.shape} up to {np.max(answer)}",
                expected="marks 0 or 1, (image, row, column)",
                remedy="give a function that marks the foreign object's class, or the network before its argmax",
            )
        return answer.astype(np.float64)
    values = answer.astype(np.float64)
    several = values.ndim == 4 and values.shape[1] > 1
    if not probabilities:
        if several and classes != "independent":
            values = np.exp(values - values.max(axis=1, keepdims=True))
            values /= values.sum(axis=1, keepdims=True)
        else:
            values = 1.0 / (1.0 + np.exp(-np.clip(values, -700, 700)))
    return np.asarray(values[:, -1] if values.ndim == 4 else values)


def detect_with_segmenters(
    segmenters: Mapping[int, Segmenter],
    dataset: "Dataset",
    numbers: Sequence[int] | NDArray[np.intp],
    *,
    threshold: float = MARK_THRESHOLD,
    progress: Callable[[int], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> Iterator[Detection]:
    """Try segmenters on images of a dataset, as `detect_with_networks` tries networks.

    Args:
        segmenters: by the number that stands in the table.
        dataset, numbers, threshold, progress, warn: as there.

    Raises:
        InputError: no images, a threshold outside 0..1, a segmenter whose answer has another shape or is no probability.
    """
    if not 0 <= threshold < 1:
        raise InputError("threshold", received=threshold, expected="a probability, 0 or more and below 1")
    from .runs import images_with_pixels

    usable = images_with_pixels(dataset, numbers, warn=warn)
    for number, segmenter in segmenters.items():
        for first in range(0, len(usable), _BATCH):
            chosen = usable[first : first + _BATCH]
            images = np.asarray(dataset.images(chosen), dtype=np.float32)
            found = _checked(segmenter(images), images, number)
            for one, probabilities in zip(chosen, found, strict=True):
                mask = dataset.foreign_object_masks(one)
                yield detect_on_row(dataset.rows[one], probabilities, mask, network=number, threshold=threshold)
            if progress is not None:
                progress(len(chosen))


def _checked(found: Any, images: NDArray[np.float32], number: int) -> NDArray[np.float32]:
    values = np.asarray(found)
    wanted = (len(images), *images.shape[-2:])
    if values.shape != wanted:
        raise InputError(
            f"segmenter {number}",
            received=f"an answer of shape {values.shape}",
            expected=f"{wanted} (image, row, column)",
        )
    if not np.all((values >= 0) & (values <= 1)):
        raise InputError(
            f"segmenter {number}",
            received=f"values from {np.min(values):.3g} to {np.max(values):.3g}",
            expected="probabilities, 0 to 1",
            remedy="a network that gives logits: probabilities=False",
        )
    return np.asarray(values, dtype=np.float32)

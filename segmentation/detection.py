"""When a foreign object counts as detected, and how often there is a false alarm. numpy only, scipy for intervals."""

import csv
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import whole_file

if TYPE_CHECKING:
    from ..acquisition.dataset_io import DatasetRow

MARK_THRESHOLD = 0.5
DETECTION_RECALL = 0.1
_CONFIDENCE = 0.95  # of intervals
_BY_CHANCE = 0.05  # level at which networks are said to differ, as in `pod`


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """One network on one image, a line of the hit/miss table.

    Fields: contrast and size_mm of the foreign object (None = none there, or unknown); hit (the object is detected; in
    an image without one: anything is marked); network; image; foreign_object; setting; false_alarm (None where there is
    a foreign object); recall (share of its pixels marked, None without one); response (highest probability in it, or in
    the whole image without one); product.
    """

    contrast: float | None
    size_mm: float | None
    hit: bool
    network: int
    image: str
    foreign_object: str
    setting: str
    false_alarm: bool | None
    recall: float | None
    response: float
    product: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A share with its 95 % interval; value, low and high are None where nothing was counted."""

    value: float | None
    low: float | None
    high: float | None
    n: int


def recall_in_mask(marked: NDArray[Any], mask: NDArray[Any]) -> float:
    """Share of a mask's pixels that are marked (0..1); NaN for an empty mask."""
    inside = np.asarray(mask) != 0
    return float(np.asarray(marked, dtype=bool)[inside].mean()) if inside.any() else math.nan


def detect_in_image(
    probabilities: NDArray[Any], foreign_object_mask: NDArray[Any], *, threshold: float = MARK_THRESHOLD
) -> tuple[bool, bool | None, float | None, float]:
    """Whether the foreign object of one image is detected, or whether an image without one raises a false alarm.

    A pixel is marked where its probability is above the threshold. Detected: more than a tenth of the object's pixels
    are marked. False alarm: an image without foreign object with any pixel marked.

    Args:
        probabilities: (row, column) 0..1.
        foreign_object_mask: (row, column), anything but 0 is inside; empty = no foreign object.
        threshold: 0..1.

    Returns:
        hit (without object: anything is marked), false alarm (None with an object), recall of the object's pixels (None
        without), response: the highest probability in the object, or in the image without one.

    Raises:
        InputError: shapes differ, or a probability is not a number.

    Source: Andriiashen et al., recall above 0.1.
    """
    values = np.asarray(probabilities)
    mask = np.asarray(foreign_object_mask) != 0
    if values.shape != mask.shape:
        raise InputError("foreign-object mask", received=f"shape {mask.shape}", expected=f"shape {values.shape}")
    if not np.all((values >= 0) & (values <= 1)):
        raise InputError("probabilities", received="a value outside 0..1", expected="numbers from 0 to 1")
    marked = values > threshold
    if not mask.any():
        alarm = bool(marked.any())
        return alarm, alarm, None, float(values.max())
    recall = recall_in_mask(marked, mask)
    return recall > DETECTION_RECALL, None, recall, float(values[mask].max())


def detect_on_row(
    row: "DatasetRow",
    probabilities: NDArray[Any],
    foreign_object_mask: NDArray[Any],
    *,
    network: int,
    threshold: float = MARK_THRESHOLD,
) -> Detection:
    """`detect_in_image` as a line of the hit/miss table, with what a dataset says of the image.

    Args:
        row: of the dataset.
        probabilities, foreign_object_mask: (row, column), as there.
        network: its number.
        threshold: 0..1.
    """
    hit, false_alarm, recall, response = detect_in_image(probabilities, foreign_object_mask, threshold=threshold)
    return Detection(
        contrast=_known(row.contrast) if recall is not None else None,
        size_mm=_known(row.size_mm) if recall is not None else None,
        hit=hit,
        network=network,
        image=row.image,
        foreign_object=row.foreign_object,
        setting=row.setting,
        false_alarm=false_alarm,
        recall=recall,
        response=response,
        product=row.product,
    )


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def rate_of_crossed_trials(successes: NDArray[Any], *, networks: NDArray[Any], images: NDArray[Any]) -> Rate:
    """Share of successes of every network on every image, with an interval that knows that these are not independent.

    The variance of the mean is that of crossed random effects, S_image^2 / M + S_network^2 / N - S_rest^2 / (N M), with
    S^2 the sample variances of the image means, of the network means and of what is left; it is never less than that of
    N M independent trials. It gives the number n* = p (1 - p) / variance of independent trials worth the same (the
    number of images M where p is 0 or 1, or where there is one network), times (t(N M - 1) / t(m))^2 for a variance known
    with m degrees of freedom (Satterthwaite), t Student's quantile. Clopper-Pearson's interval is taken at n*. Networks whose
    shares differ by no more than chance (F test, 5 %) add no variance: the interval is then of the mean of these networks. With
    one network it is of that network.

    Args:
        successes: (trial,) 0 or 1 (or shares, such as recalls), each network on each image once.
        networks, images: (trial,) identifiers.

    Returns:
        The share with its interval; None without trials. `n` counts trials.

    Source: Clopper and Pearson 1934; Korn and Graubard 1998, Survey Methodology 24:193 (effective sample size); Owen
    2007, Ann. Appl. Stat. 1:386 (crossed effects).
    """
    from scipy.special import betaincinv, fdtri, stdtrit

    values = np.asarray(successes, dtype=np.float64)
    if not values.size:
        return Rate(value=None, low=None, high=None, n=0)
    _, image = np.unique(np.asarray(images), return_inverse=True)
    _, network = np.unique(np.asarray(networks), return_inverse=True)
    n_images, n_networks = int(image.max()) + 1, int(network.max()) + 1
    share = float(values.mean())
    effective = float(n_images)
    if 0 < share < 1 and n_networks > 1 and n_images > 1:
        image_mean = np.bincount(image, values) / np.bincount(image)
        network_mean = np.bincount(network, values) / np.bincount(network)
        rest = values - image_mean[image] - network_mean[network] + share
        rest_variance = float((rest**2).sum()) / ((n_images - 1) * (n_networks - 1))
        from_images = float(image_mean.var(ddof=1)) / n_images
        from_networks = float(network_mean.var(ddof=1)) / n_networks
        variance = from_images + from_networks - rest_variance / (n_images * n_networks)
        binomial = share * (1.0 - share) / values.size
        degrees = n_networks - 1, (n_networks - 1) * (n_images - 1)
        if from_networks * n_networks * n_images <= rest_variance * float(fdtri(*degrees, 1.0 - _BY_CHANCE)):
            variance, from_networks = from_images, 0.0
        variance = max(variance, from_images, from_networks, binomial)
        parts = from_images**2 / (n_images - 1) + from_networks**2 / (n_networks - 1)
        freedom = max(variance**2 / parts, 1.0) if parts > 0 else np.inf
        few = (float(stdtrit(values.size - 1, 0.975)) / float(stdtrit(min(freedom, values.size - 1), 0.975))) ** 2
        effective = few * share * (1.0 - share) / variance
    tail = (1.0 - _CONFIDENCE) / 2.0
    count = share * effective
    low = float(betaincinv(count, effective - count + 1.0, tail)) if count > 0 else 0.0
    high = float(betaincinv(count + 1.0, effective - count, 1.0 - tail)) if share < 1 else 1.0
    return Rate(value=share, low=low, high=high, n=values.size)


def summarise_detections(detections: Iterable[Detection]) -> dict[str, Rate]:
    """Mean recall, share of foreign objects detected and share of false alarms, each with its 95 % interval."""
    table = list(detections)
    with_object = [row for row in table if row.recall is not None]

    def rate(name: str, rows_of_kind: list[Detection]) -> Rate:
        rows = [(getattr(row, name), row.network, row.image) for row in rows_of_kind]
        values, networks, images = zip(*rows, strict=True) if rows else ((), (), ())
        return rate_of_crossed_trials(
            np.asarray(values, dtype=np.float64), networks=np.asarray(networks), images=np.asarray(images)
        )

    return {
        "recall": rate("recall", with_object),
        "hit_rate": rate("hit", with_object),
        "false_alarm_rate": rate("false_alarm", [row for row in table if row.false_alarm is not None]),
    }


def write_detections(path: str | os.PathLike[str], detections: Iterable[Detection]) -> int:
    """Write the hit/miss table as CSV, whole or not at all, and return its number of lines below the header."""
    names = [field.name for field in fields(Detection)]
    count = 0
    with whole_file(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(names)
        for row in detections:
            writer.writerow([_cell(getattr(row, name)) for name in names])
            count += 1
    return count


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool | np.bool_):
        return str(int(value))
    return f"{value:.7g}" if isinstance(value, float) else str(value)

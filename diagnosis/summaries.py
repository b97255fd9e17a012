"""What the frames of one series say, in one pass: the raw material of every probe.

The common factor of each frame (tube output, global offset) is taken out before anything is said of single pixels, and is
kept beside it. Noise is judged from differences of successive frames, so that slow drift stays out of it.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

LAGS: tuple[tuple[int, int], ...] = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (0, 3), (3, 0))
BLOCK_PX = 8  # side of the blocks whose means show slow texture
TIME_TILES = 4  # tiles a side whose means are kept frame by frame
_PIECE_FRAMES = 64
_CODES_FRAMES = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesSummary:
    """Statistics of the n frames of one series; DN throughout.

    Fields: frames; mean_DN (row, column); pair_variance_DN2, stack_variance_DN2 (row, column), common factor removed;
    label_variance_DN2 (label,), label_autocovariance_DN2 (label, lag) over LAGS, label_pixels (label,): averages over
    the pixels of each noise label; row_variance_DN2, column_variance_DN2, block_variance_DN2: variance in time of the
    means of rows, columns and blocks of BLOCK_PX; temporal_covariance_DN2 (2,): mean product of a pixel's deviations one
    and two frames apart; kurtosis_excess of differences, pooled over standardised pixels; frame_mean_DN (n,);
    tile_mean_DN (n, TIME_TILES, TIME_TILES); distinct_codes, code_range: how many whole numbers occur between the 1st and
    99th percentile, and how many there are from the first to the last of them; highest_DN, saturated_share.
    """

    frames: int
    mean_DN: NDArray[np.float64]
    pair_variance_DN2: NDArray[np.float64]
    stack_variance_DN2: NDArray[np.float64]
    label_variance_DN2: NDArray[np.float64]
    label_autocovariance_DN2: NDArray[np.float64]
    label_pixels: NDArray[np.int64]
    row_variance_DN2: float
    column_variance_DN2: float
    block_variance_DN2: float
    temporal_covariance_DN2: NDArray[np.float64]
    kurtosis_excess: float
    frame_mean_DN: NDArray[np.float64]
    tile_mean_DN: NDArray[np.float64]
    distinct_codes: int
    code_range: int
    highest_DN: float
    saturated_share: float


def _pieces(pieces: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    for piece in pieces:
        for start in range(0, len(piece), _PIECE_FRAMES):
            yield piece[start : start + _PIECE_FRAMES]


def _tiles(frames: NDArray[np.float32], good: NDArray[np.bool_], count: int) -> NDArray[np.float64]:
    """Means of good pixels in count x count tiles (n, count, count)."""
    rows, columns = good.shape
    row_edges = np.linspace(0, rows, count + 1).astype(int)[:-1]
    column_edges = np.linspace(0, columns, count + 1).astype(int)[:-1]
    weight = good.astype(np.float32)

    def add(array: NDArray[np.float32]) -> NDArray[np.float64]:
        return np.asarray(
            np.add.reduceat(np.add.reduceat(array, row_edges, axis=-2), column_edges, axis=-1), dtype=np.float64
        )

    return np.asarray(add(frames * weight) / np.maximum(add(weight), 1e-9))


def summarise_series(
    pieces: Iterable[NDArray[Any]],
    *,
    good: NDArray[np.bool_],
    labels: NDArray[np.integer[Any]],
    pattern: NDArray[np.floating[Any]] | None = None,
    name: str = "frames",
    saturation_DN: float | None = None,
) -> SeriesSummary:
    """Statistics of a series, from pieces (m, row, column) in time order, DN.

    Args:
        pieces: frames in time order.
        good: pixels to use (row, column).
        labels: noise label of each pixel (row, column), -1 for none; labels count from 0.
        pattern: how one unit of the common factor looks (row, column), mean 1 over good pixels: the signal's shape with
            the beam on, None (1 everywhere) without.
        name: for errors.
        saturation_DN: full scale, where known.

    Raises:
        InputError: no frames, frames of another shape than `good`, or values that are not finite.
    """
    shape = good.shape
    use = good.astype(np.float32)
    n_good = int(good.sum())
    if n_good < 16:
        raise InputError(name, received=f"{n_good} usable pixels", expected="at least 16")
    shape_of_one = np.ones(shape, np.float32) if pattern is None else np.asarray(pattern, dtype=np.float32)
    n_labels = max(int(labels.max()) + 1, 1)
    flat_labels = np.where(good, labels, -1)
    masks = [flat_labels == label for label in range(n_labels)]
    pairs_of_lag = []
    for dr, dc in LAGS:
        first, second = _shifted(shape, dr, dc)
        pairs_of_lag.append((first, second, [mask[first] & (mask[second]) for mask in masks]))

    frames = 0
    reference: NDArray[np.float32] | None = None
    total = np.zeros(shape)
    cleaned_total, cleaned_square = np.zeros(shape), np.zeros(shape)
    pair_square = np.zeros(shape)
    pair_fourth = 0.0
    pair_second = 0.0
    n_pairs = 0
    label_covariance = np.zeros((n_labels, len(LAGS)))
    row_sum = column_sum = block_sum = 0.0
    temporal = np.zeros(2)
    temporal_pairs = np.zeros(2)
    frame_means, tiles = [], []
    codes: NDArray[np.int64] | None = np.zeros(0, dtype=np.int64)
    highest, saturated = -np.inf, 0
    tail: NDArray[np.float32] | None = None
    blocks = _block_weights(good)
    row_count = np.maximum(use.sum(axis=1), 1.0)
    column_count = np.maximum(use.sum(axis=0), 1.0)
    code_parts: list[NDArray[Any]] = []
    coded = 0
    for raw in _pieces(pieces):
        if raw.ndim != 3 or raw.shape[1:] != shape:
            raise InputError(name, received=f"frames of {raw.shape[1:]}", expected=f"frames of {shape}")
        if raw.dtype.kind == "f" and not np.all(np.isfinite(raw)):
            raise InputError(name, received="NaN or infinite detector numbers", expected="finite values")
        if codes is not None:
            if raw.dtype.kind in "ui":
                if coded < _CODES_FRAMES:
                    code_parts.append(raw[: _CODES_FRAMES - coded][:, good].ravel())
                    coded += min(len(raw), _CODES_FRAMES - coded)
            else:
                codes = None
        highest = max(highest, float(raw[:, good].max()))
        if saturation_DN is not None:
            saturated += int(np.count_nonzero(raw[:, good] >= saturation_DN))
        x = raw.astype(np.float32)
        if reference is None:
            reference = x[0].copy()
        means = np.tensordot(x, use, axes=2).astype(np.float64) / n_good
        frame_means.append(means)
        tiles.append(_tiles(x, good, TIME_TILES))
        total += x.sum(axis=0, dtype=np.float64)
        # deviations from the first frame with the common factor taken out
        x -= reference
        own = np.tensordot(x, use, axes=2) / n_good
        x -= own[:, None, None].astype(np.float32) * shape_of_one
        x *= use
        cleaned_total += x.sum(axis=0, dtype=np.float64)
        cleaned_square += np.einsum("nrc,nrc->rc", x, x)
        chain = x if tail is None else np.concatenate([tail, x])
        if len(chain) > 1:
            start = 0 if tail is None else len(tail) - 1
            d = np.diff(chain[start:], axis=0)
            n_pairs += len(d)
            d2 = np.einsum("nrc,nrc->rc", d, d)
            pair_square += d2
            square = d * d
            sd2 = np.maximum(d2 / len(d), 1e-12)
            if len(d) > 3:
                inside = square[:, good] / sd2[good]
                pair_fourth += float(np.sum(inside * inside))
                pair_second += inside.size * (1.0 + 0.0)
            for index, (first, second, selected) in enumerate(pairs_of_lag):
                product = np.einsum("nrc,nrc->rc", d[(slice(None), *first)], d[(slice(None), *second)])
                for label, mask in enumerate(selected):
                    label_covariance[label, index] += float(product[mask].sum()) / 2.0
            row_sum += float(np.mean((d.sum(axis=2) / row_count) ** 2)) / 2.0 * len(d)
            column_sum += float(np.mean((d.sum(axis=1) / column_count) ** 2)) / 2.0 * len(d)
            block = _block_means(d, good, blocks)
            block_sum += float(np.mean(block**2)) / 2.0 * len(d) if block.size else 0.0
        frames += len(x)
        tail = chain[-2:].copy()
        if len(x) > 3:
            centred = x - x.mean(axis=0)
            for step in (1, 2):
                temporal[step - 1] += float(np.sum(centred[:-step] * centred[step:])) / n_good
                temporal_pairs[step - 1] += len(x) - step
                # a stack's own mean takes a share of the variance out of each product
                share = float(np.sum(centred * centred)) / n_good / max(len(x) - 1, 1)
                temporal[step - 1] += share * (len(x) - step) / len(x)
    if frames == 0 or reference is None:
        raise InputError(name, received="no frames", expected="at least one frame")
    nan = np.full(shape, np.nan)
    pair_variance = pair_square / (2 * n_pairs) if n_pairs else nan
    stack = np.clip(cleaned_square - cleaned_total**2 / frames, 0.0, None) / (frames - 1) if frames > 1 else nan.copy()
    counts = np.array([mask.sum() for mask in masks])
    variances = np.array([pair_variance[mask].mean() if mask.any() else np.nan for mask in masks])
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = (
            label_covariance
            / max(n_pairs, 1)
            / np.array([[selected[label].sum() for _, _, selected in pairs_of_lag] for label in range(n_labels)])
        )
    distinct = span = 0
    if codes is not None and code_parts:
        distinct, span = _codes(np.concatenate(code_parts))
    one = max(n_pairs, 1)
    return SeriesSummary(
        frames=frames,
        mean_DN=total / frames,
        pair_variance_DN2=pair_variance,
        stack_variance_DN2=stack,
        label_variance_DN2=variances,
        label_autocovariance_DN2=covariance,
        label_pixels=counts,
        row_variance_DN2=row_sum / one,
        column_variance_DN2=column_sum / one,
        block_variance_DN2=block_sum / one,
        temporal_covariance_DN2=temporal / np.maximum(temporal_pairs, 1),
        kurtosis_excess=_kurtosis_excess(pair_fourth, pair_second, min(n_pairs, _PIECE_FRAMES)),
        frame_mean_DN=np.concatenate(frame_means),
        tile_mean_DN=np.concatenate(tiles),
        distinct_codes=distinct,
        code_range=span,
        highest_DN=highest,
        saturated_share=saturated / (frames * n_good),
    )


def _codes(values: NDArray[np.integer[Any]]) -> tuple[int, int]:
    """How many whole numbers occur between the 1st and 99th percentile, and how many there are from first to last of them."""
    least = int(values.min())
    counts = np.bincount((values - values.min()).astype(np.intp))
    below = np.cumsum(counts)

    def percentile(share: float) -> float:
        place = share * (values.size - 1)
        first, second = np.searchsorted(below, [math.floor(place), math.ceil(place)], side="right")
        return float(first + (second - first) * (place - math.floor(place)))

    low, high = int(percentile(0.01) + least) - least, int(percentile(0.99) + least) - least
    there = np.flatnonzero(counts[max(low, 0) : high + 1])
    return there.size, int(there[-1] - there[0]) + 1


def _kurtosis_excess(fourth: float, count: float, pairs: int) -> float:
    """Excess kurtosis of standardised differences; each pixel was scaled by its own variance of `pairs` differences."""
    if count == 0:
        return 0.0
    # Gaussian: E[d^4] / E[s^4] with s^2 of m differences that share frames (about 2 m / 3 degrees of freedom)
    freedom = 2.0 * pairs / 3.0
    return fourth / count * (1.0 + 2.0 / freedom) - 3.0


def _shifted(shape: tuple[int, int], dr: int, dc: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    rows, columns = shape
    first = (slice(0, rows - dr), slice(max(0, -dc), columns - max(0, dc)))
    second = (slice(dr, rows), slice(max(0, dc), columns - max(0, -dc)))
    return first, second


def _block_weights(good: NDArray[np.bool_]) -> NDArray[np.float32]:
    rows, columns = (side - side % BLOCK_PX for side in good.shape)
    part = good[:rows, :columns].reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
    return np.asarray(part.sum(axis=(1, 3)), dtype=np.float32)


def _block_means(d: NDArray[np.float32], good: NDArray[np.bool_], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over blocks (n, block): only blocks with three good pixels in four."""
    rows, columns = (side - side % BLOCK_PX for side in good.shape)
    if rows == 0 or columns == 0:
        return np.zeros((len(d), 0), np.float32)
    part = d[:, :rows, :columns].reshape(len(d), rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
    keep = weights >= 0.75 * BLOCK_PX**2
    return np.asarray((part.sum(axis=(2, 4)) / np.maximum(weights, 1.0))[:, keep], dtype=np.float32)

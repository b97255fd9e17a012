"""What the frames of one series say, in one pass: the raw material of every probe.

The common factor of each frame (tube output, global offset) is taken out before anything is said of single pixels, and is
kept beside it. Noise is judged from differences of successive frames, so that slow drift stays out of it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...calibration.frames.frame_checks import CopyScan, repeats_the_last
from ...errors import InputError
from ...generator.line.twin import LEAST_PIXELS
from ..arrays import BoolArray, FloatArray, RealArray

LAGS: tuple[tuple[int, int], ...] = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (0, 3), (3, 0))
BLOCK_PX = 8  # side of the blocks whose means show slow texture
LEAST_NOISE_DN2 = 1e-4  # of a pixel: noise below the ADC's step can vanish, and a simulated dark may have none
PIECE_FRAMES = 64  # at most, that are looked at together: each pixel is scaled by its own variance within them
CODES_FRAMES = 16  # the first, in which codes are counted

# of steps from frame to frame that change nothing: Gaussian noise of 0.7 steps of the ADC; of wider noise rounding leaves a Gaussian
# (0.02 of excess kurtosis more, at the most) whose variance does not depend on where values lie between codes (0.1 %)
ROUNDED_SHARE = 0.37


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesSummary:
    """Statistics of the n frames of one series; DN throughout."""

    frames: int  # copies of the one before left out
    mean_DN: FloatArray  # (row, column)
    pair_variance_DN2: FloatArray  # (row, column), common factor removed
    stack_variance_DN2: FloatArray  # (row, column), alike
    label_variance_DN2: FloatArray  # (label,): average over the pixels of each noise label
    label_autocovariance_DN2: FloatArray  # (label, lag) over LAGS, alike
    label_pixels: NDArray[np.int64]  # (label,)
    label_pairs: NDArray[np.int64]  # (label, lag): of neighbours
    row_variance_DN2: float  # in time, of the means of rows
    column_variance_DN2: float  # and of columns
    block_variance_DN2: float  # and of blocks of BLOCK_PX
    temporal_covariance_DN2: FloatArray  # (2,): mean product of a pixel's deviations one and two frames apart
    kurtosis_excess: float  # of differences, pooled over standardised pixels
    frame_mean_DN: FloatArray  # (n,)
    distinct_codes: int  # whole numbers that occur between the 1st and 99th percentile
    code_range: int  # whole numbers from the first to the last of them
    # (row, column): of a pixel's steps from frame to frame, those that change nothing
    unchanged_share: NDArray[np.float32]

    def without_lines(self, rows_DN2: float, columns_DN2: float) -> "SeriesSummary":
        """What the frames would say without offsets of rows and columns of these variances (DN^2), new in every frame.

        The variance of pixels keeps them: calibration counts them as read noise.
        """
        covariance = self.label_autocovariance_DN2.copy()
        for index, (down, across) in enumerate(LAGS):
            covariance[:, index] -= (rows_DN2 if down == 0 else 0.0) + (columns_DN2 if across == 0 else 0.0)
        rows, columns = self.mean_DN.shape
        return replace(
            self,
            label_autocovariance_DN2=covariance,
            row_variance_DN2=max(self.row_variance_DN2 - rows_DN2 * (1.0 - 1.0 / columns), 0.0),
            column_variance_DN2=max(self.column_variance_DN2 - columns_DN2 * (1.0 - 1.0 / rows), 0.0),
            block_variance_DN2=max(self.block_variance_DN2 - (rows_DN2 + columns_DN2) / BLOCK_PX, 0.0),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstLook:
    """What says which pixels and series can be used; others are as in `SeriesSummary`."""

    frames: int
    copies: int  # frames that equal an earlier one
    mean_DN: FloatArray
    pair_variance_DN2: FloatArray
    stack_variance_DN2: FloatArray
    unchanged_share: NDArray[np.float32]
    saturated_share: float  # of the numbers of good pixels


_Piece = tuple[NDArray[Any], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


def _pieces(pieces: Iterable[NDArray[Any]], good: BoolArray, pattern: RealArray | None, name: str) -> Iterator[_Piece]:
    """Frames, none a copy of the one before, in single precision, less the first one and their common factor, and steps of these."""
    use = good.astype(np.float32)
    n_good = int(good.sum())
    if n_good < LEAST_PIXELS:
        raise InputError(name, received=f"{n_good} usable pixels", expected=f"at least {LEAST_PIXELS}")
    shape_of_one = np.ones(good.shape, np.float32) if pattern is None else np.asarray(pattern, dtype=np.float32)
    reference: NDArray[np.float32] | None = None
    last: NDArray[np.float32] | None = None
    before: NDArray[Any] | None = None
    for piece in pieces:
        for start in range(0, len(piece), PIECE_FRAMES):
            raw = piece[start : start + PIECE_FRAMES]
            if raw.ndim != 3 or raw.shape[1:] != good.shape:
                raise InputError(name, received=f"frames of {raw.shape[1:]}", expected=f"frames of {good.shape}")
            if raw.dtype.kind == "f" and not np.all(np.isfinite(raw)):
                raise InputError(name, received="NaN or infinite detector numbers", expected="finite values")
            copied = repeats_the_last(raw, before)
            before = raw[-1].copy()
            if copied.any():
                raw = raw[~copied]
                if not len(raw):
                    continue
            x = raw.astype(np.float32)
            if reference is None:
                reference = x[0].copy()
            cleaned = x - reference
            own = np.tensordot(cleaned, use, axes=2) / n_good
            cleaned -= own[:, None, None].astype(np.float32) * shape_of_one
            cleaned *= use
            steps = np.diff(cleaned if last is None else np.concatenate([last, cleaned]), axis=0)
            last = cleaned[-1:].copy()
            yield raw, x, cleaned, steps
    if reference is None:
        raise InputError(name, received="no frames", expected="at least one frame")


class _Variances:
    """Mean frame, and variances of pixels from steps and from whole stacks, piece by piece."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.frames = self.n_steps = 0
        self._total, self._sum, self._square, self._steps, self._unchanged = (np.zeros(shape) for _ in range(5))

    def add(
        self, raw: NDArray[Any], x: NDArray[np.float32], cleaned: NDArray[np.float32], steps: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Sums of a piece taken in; returns that of the squares of its steps."""
        self.frames += len(x)
        self._unchanged += np.count_nonzero(raw[1:] == raw[:-1], axis=0)
        self.n_steps += len(steps)
        self._total += x.sum(axis=0, dtype=np.float64)
        self._sum += cleaned.sum(axis=0, dtype=np.float64)
        self._square += np.einsum("nrc,nrc->rc", cleaned, cleaned)
        squares: NDArray[np.float32] = np.einsum("nrc,nrc->rc", steps, steps)
        self._steps += squares
        return squares

    @property
    def mean(self) -> FloatArray:
        return np.asarray(self._total / self.frames)

    @property
    def unchanged_share(self) -> NDArray[np.float32]:
        return (self._unchanged / max(self.n_steps, 1)).astype(np.float32)

    @property
    def of_pairs(self) -> FloatArray:
        return self._steps / (2 * self.n_steps) if self.n_steps else np.full(self._steps.shape, np.nan)

    @property
    def of_stack(self) -> FloatArray:
        if self.frames < 2:
            return np.full(self._sum.shape, np.nan)
        return np.clip(self._square - self._sum**2 / self.frames, 0.0, None) / (self.frames - 1)


def look_at_series(
    pieces: Iterable[NDArray[Any]],
    *,
    good: BoolArray,
    pattern: RealArray | None = None,
    name: str = "frames",
    saturation_DN: float | None = None,
) -> FirstLook:
    """Mean, variances and saturation of a series; saturation_DN: full scale, where known; else as `summarise_series`."""
    found, scan = _Variances(good.shape), CopyScan()
    saturated = 0

    def scanned() -> Iterator[NDArray[Any]]:
        for piece in pieces:
            scan.add(piece)
            yield piece

    for raw, x, cleaned, steps in _pieces(scanned(), good, pattern, name):
        found.add(raw, x, cleaned, steps)
        if saturation_DN is not None and float(raw.max()) >= saturation_DN:
            saturated += int(np.count_nonzero(raw[:, good] >= saturation_DN))
    return FirstLook(
        frames=found.frames,
        copies=len(scan.copies()),
        mean_DN=found.mean,
        pair_variance_DN2=found.of_pairs,
        stack_variance_DN2=found.of_stack,
        unchanged_share=found.unchanged_share,
        saturated_share=saturated / (found.frames * int(good.sum())),
    )


def summarise_series(
    pieces: Iterable[NDArray[Any]],
    *,
    good: BoolArray,
    labels: NDArray[np.integer[Any]],
    pattern: RealArray | None = None,
    name: str = "frames",
) -> SeriesSummary:
    """Statistics of a series, from pieces (m, row, column) in time order, DN.

    Args:
        pieces, name: frames, and what errors call them.
        good, labels: pixels to use, and their noise labels from 0, -1 for none (row, column).
        pattern: how one unit of the common factor looks (row, column), mean 1 over good pixels; None: 1 everywhere.

    Raises:
        InputError: no frames, frames of another shape than `good`, or values that are not finite.
    """
    shape, n_good = good.shape, int(good.sum())
    use = good.astype(np.float32)
    masks = [good & (labels == label) for label in range(max(int(labels.max()) + 1, 1))]
    shifted = [_shifted(shape, dr, dc) for dr, dc in LAGS]
    pairs_of_lag = [(first, second, [mask[first] & mask[second] for mask in masks]) for first, second in shifted]
    variances, label_covariance = _Variances(shape), np.zeros((len(masks), len(LAGS)))
    pair_fourth = pair_second = row_sum = column_sum = block_sum = 0.0
    temporal, temporal_pairs = np.zeros(2), np.zeros(2)
    frame_means = []
    blocks = in_blocks(good).sum(axis=(1, 3), dtype=np.float32)
    row_count = np.maximum(use.sum(axis=1), 1.0)
    column_count = np.maximum(use.sum(axis=0), 1.0)
    code_parts: list[NDArray[Any]] = []  # whole numbers alone: others have no codes
    coded = 0
    for raw, x, cleaned, d in _pieces(pieces, good, pattern, name):
        if raw.dtype.kind in "ui" and coded < CODES_FRAMES:
            code_parts.append(raw[: CODES_FRAMES - coded][:, good].ravel())
            coded += min(len(raw), CODES_FRAMES - coded)
        frame_means.append(np.tensordot(x, use, axes=2).astype(np.float64) / n_good)
        d2 = variances.add(raw, x, cleaned, d)
        if len(d):
            if len(d) > 3:
                inside = (d * d)[:, good] / np.maximum(d2 / len(d), 1e-12)[good]
                pair_fourth += float(np.sum(inside * inside))
                pair_second += float(inside.size)
            for index, (first, second, selected) in enumerate(pairs_of_lag):
                product = np.einsum("nrc,nrc->rc", d[(slice(None), *first)], d[(slice(None), *second)])
                for label, mask in enumerate(selected):
                    label_covariance[label, index] += float(product[mask].sum()) / 2.0
            # each line counts as it has pixels: of a dead one few are left, whose mean is as noisy as a pixel
            row_sum += float(np.mean(d.sum(axis=2) ** 2 / row_count)) / shape[1] / 2.0 * len(d)
            column_sum += float(np.mean(d.sum(axis=1) ** 2 / column_count)) / shape[0] / 2.0 * len(d)
            block = _block_means(d, blocks)
            block_sum += float(np.mean(block**2)) / 2.0 * len(d) if block.size else 0.0
        if len(x) > 3:
            centred = cleaned - cleaned.mean(axis=0)
            # a stack's own mean takes a share of the variance out of each product
            share = float(np.sum(centred * centred)) / n_good / (len(x) - 1)
            for step in (1, 2):
                temporal[step - 1] += float(np.sum(centred[:-step] * centred[step:])) / n_good
                temporal_pairs[step - 1] += len(x) - step
                temporal[step - 1] += share * (len(x) - step) / len(x)
    n_pairs, pair_variance = variances.n_steps, variances.of_pairs
    of_labels = np.array([pair_variance[mask].mean() if mask.any() else np.nan for mask in masks])
    pixel_pairs = np.array([[selected[label].sum() for _, _, selected in pairs_of_lag] for label in range(len(masks))])
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = label_covariance / max(n_pairs, 1) / pixel_pairs
    distinct, span = _codes(np.concatenate(code_parts)) if code_parts else (0, 0)
    one = max(n_pairs, 1)
    return SeriesSummary(
        frames=variances.frames,
        mean_DN=variances.mean,
        pair_variance_DN2=pair_variance,
        stack_variance_DN2=variances.of_stack,
        label_variance_DN2=of_labels,
        label_autocovariance_DN2=covariance,
        label_pixels=np.array([mask.sum() for mask in masks]),
        label_pairs=pixel_pairs,
        row_variance_DN2=row_sum / one,
        column_variance_DN2=column_sum / one,
        block_variance_DN2=block_sum / one,
        temporal_covariance_DN2=temporal / np.maximum(temporal_pairs, 1),
        kurtosis_excess=kurtosis_excess(pair_fourth, pair_second, min(n_pairs, PIECE_FRAMES)),
        frame_mean_DN=np.concatenate(frame_means),
        distinct_codes=distinct,
        code_range=span,
        unchanged_share=variances.unchanged_share,
    )


def _codes(values: NDArray[np.integer[Any]]) -> tuple[int, int]:
    """How many whole numbers occur between the 1st and 99th percentile, and how many there are from first to last of them."""
    low, high = (int(one) for one in np.percentile(values, [1, 99]))
    there = np.unique(values[(values >= low) & (values <= high)])
    return there.size, int(there[-1]) - int(there[0]) + 1


def rounded_away(seen: SeriesSummary | FirstLook, good: BoolArray) -> bool:
    """Whether most of what the noise of the good pixels (row, column) would do is lost in the steps of the ADC."""
    return float(np.mean(seen.unchanged_share[good])) > ROUNDED_SHARE


def kurtosis_excess(fourth: float, count: float, pairs: int) -> float:
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


def in_blocks(images: NDArray[Any]) -> NDArray[Any]:
    """Whole blocks of BLOCK_PX of images (..., row, column), as (..., block row, row, block column, column)."""
    rows, columns = (side // BLOCK_PX for side in images.shape[-2:])
    whole = images[..., : rows * BLOCK_PX, : columns * BLOCK_PX]
    return whole.reshape(*images.shape[:-2], rows, BLOCK_PX, columns, BLOCK_PX)


def _block_means(d: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over blocks (n, block) that have three good pixels in four; weights (block row, block column): how many they have."""
    keep = weights >= 0.75 * BLOCK_PX**2
    return np.asarray((in_blocks(d).sum(axis=(2, 4)) / np.maximum(weights, 1.0))[:, keep], dtype=np.float32)

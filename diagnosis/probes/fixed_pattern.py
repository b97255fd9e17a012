"""Fixed patterns of mean frames: from pixel to pixel, between blocks, from line to line; and pixels that stand out.

A gain map that changed pixel by pixel shows in all of them as its grain does. Lines that changed as a whole (seams of tiles,
readout lines) show in the means of rows or columns far above what single pixels' changes leave there.

A pattern is an array (4,) of variances, DN^2, NaN where one cannot be seen: half the mean square of differences of neighbours along
rows; the same of means of blocks of BLOCK_PX; of rows and of columns a sixth of the mean square of second differences of the lines'
means (smooth shapes leave nothing there). Of independent patterns in one frame they add up.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.line_state import FixedPattern, TilePattern
from ..arrays import BoolArray, FloatArray, RealArray
from ..session.even_maps import NEIGHBOURS_PX, mean_over
from ..session.summaries import BLOCK_PX, LEAST_NOISE_DN2, in_blocks
from .noise_correlation import autocovariance, correlation_sum

OUTLIER_SD = 7.0
_LEAST_BLOCKS, _LEAST_LINES = 8, 16
_LEAST_SURFACE = 5 * BLOCK_PX  # side of a panel, px, through which a cubic surface can be laid
_OUT_OF_NEIGHBOURS = 3.0  # times the distance of their quartiles; of noise 7 standard deviations are 5
_LINE_CLEAN = 0.2  # share of a line's pixels that do not stand out, below which the line as a whole may have changed
_LINE_CHANGE = 0.15  # relative change of a line's gain beyond which it counts as a defect

Pattern = FloatArray  # (4,), variances, DN^2, in the order that the module's docstring gives


def pattern_noise(
    model: ExpectedSeries, mask: BoolArray, frames: int, map_quantum_DN2: float, map_white_DN2: float, *, lines: bool
) -> Pattern:
    """What noise of frames and of maps (correlated as quanta are, and white) leaves in the corrected mean frame."""
    q = mean_over(model.quantum_variance_DN2, mask) / frames + map_quantum_DN2
    w = max(mean_over(model.white_variance_DN2, mask), LEAST_NOISE_DN2) / frames + map_white_DN2
    # fewer pixels of a line count than it has
    rows, columns = (max(float(mask.mean()) * length, 1.0) for length in mask.shape)
    pixel = q * (1.0 - autocovariance(model, 0, 1)) + w
    block = (q * correlation_sum(model, BLOCK_PX, BLOCK_PX) + w) / BLOCK_PX**2
    if not lines:
        return np.array([pixel, block, math.nan, math.nan])
    of_rows = (q * _second_difference(model, mask.shape[1], along=1) + w) / columns
    of_columns = (q * _second_difference(model, mask.shape[0], along=0) + w) / rows
    return np.array([pixel, block, of_rows, of_columns])


def _second_difference(model: ExpectedSeries, length: int, *, along: int) -> float:
    """A sixth of the variance of second differences of lines' sums over that of as many pixels without correlation."""
    one, two, three = (
        correlation_sum(model, *((number, length) if along == 1 else (length, number))) for number in (1, 2, 3)
    )
    # sums of two and three lines hold the covariances of lines one and two apart
    next_to = two - one
    two_apart = 1.5 * (three - one) - 2.0 * next_to
    return one - (4.0 * next_to - two_apart) / 3.0


@lru_cache(maxsize=64)
def shares_of_pixels(shape: tuple[int, int], field: FixedPattern) -> Pattern:
    """What gains of variance 1 DN^2, of pixels or columns alike as in `field`, add to a pattern over a panel of `shape`."""
    if field.of_columns:
        return np.array([1.0, 1.0 / BLOCK_PX, 0.0, 1.0])

    def of_means(length: int, apart: int = 0) -> float:
        """Covariance of means over so many pixels in line, which begin so far apart."""
        lag = np.arange(1.0 - length, length)
        return float(np.sum((length - np.abs(lag)) * field.correlation(lag + apart))) / length**2

    one, two = field.correlation(1.0), field.correlation(2.0)
    bent = float(6.0 - 8.0 * one + 2.0 * two) / 6.0
    block = of_means(BLOCK_PX)
    of_blocks = block * (block - of_means(BLOCK_PX, BLOCK_PX))
    return np.array([1.0 - one, of_blocks, bent * of_means(shape[1]), bent * of_means(shape[0])])


@lru_cache(maxsize=64)
def shares_of_tiles(shape: tuple[int, int], tiles: TilePattern) -> Pattern:
    """What gains of tiles of variance 1 DN^2 add to a pattern over a panel: of each tile, differences of neighbours' shares in it."""
    of_axes = tiles.rows.tile_of(shape[0]), tiles.columns.tile_of(shape[1])
    row_in, column_in = (np.eye(int(number[-1]) + 1)[number] for number in of_axes)

    def blocks(inside: FloatArray) -> FloatArray:
        whole = inside[: len(inside) - len(inside) % BLOCK_PX]
        return np.asarray(whole.reshape(-1, BLOCK_PX, inside.shape[1]).mean(axis=1))

    def differing(inside: FloatArray) -> float:
        return float(np.mean(np.sum(np.diff(inside, axis=0) ** 2, axis=1))) / 2.0

    def bent(inside: FloatArray) -> float:
        return float(np.mean(np.sum(np.diff(inside, n=2, axis=0) ** 2, axis=1))) / 6.0

    def of_mean(inside: FloatArray) -> float:
        return float(np.sum(inside.mean(axis=0) ** 2))

    of_blocks = differing(blocks(column_in)) * float(np.mean(np.sum(blocks(row_in) ** 2, axis=1)))
    of_rows, of_columns = bent(row_in) * of_mean(column_in), bent(column_in) * of_mean(row_in)
    return np.array([differing(column_in), of_blocks, of_rows, of_columns])


def smooth_part(residual: FloatArray, mask: BoolArray) -> FloatArray:
    """Cubic surface (row, column) through the medians of blocks: what map probes hold, and what is no pixel's own."""
    rows, columns = residual.shape
    if min(rows, columns) < _LEAST_SURFACE:
        return np.zeros(residual.shape)
    part = in_blocks(np.where(mask, residual, np.nan))
    filled = np.moveaxis(part, 1, 2).reshape(part.shape[0], part.shape[2], -1)
    known = np.count_nonzero(np.isfinite(filled), axis=-1) > BLOCK_PX**2 // 2
    if np.count_nonzero(known) < 16:
        return np.zeros(residual.shape)
    medians = np.nanmedian(filled[known], axis=-1)

    at_blocks, at_pixels = _cubic_terms(rows, columns)
    solved = np.linalg.lstsq(at_blocks[known], medians, rcond=None)[0]
    return np.asarray(at_pixels @ solved)


@lru_cache(maxsize=4)
def _cubic_terms(rows: int, columns: int) -> tuple[FloatArray, FloatArray]:
    """Terms of the cubic surface at the middles of blocks (block row, block column, term) and at pixels (row, column, term)."""

    def terms(places: Sequence[RealArray]) -> FloatArray:
        y, x = np.meshgrid(
            *(2.0 * at / length - 1.0 for at, length in zip(places, (rows, columns), strict=True)), indexing="ij"
        )
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, y**3], axis=-1)

    middles = [np.arange(length // BLOCK_PX) * BLOCK_PX + 0.5 * (BLOCK_PX - 1) for length in (rows, columns)]
    return terms(middles), terms([np.arange(float(length)) for length in (rows, columns)])


def pattern_statistics(
    residual: FloatArray, signal_DN: FloatArray | None, *, clean: BoolArray, good: BoolArray
) -> Pattern:
    """What stands in a flat's or dark's residual map (row, column), DN.

    signal_DN: expected of a flat (row, column), None: lines are not judged; clean: pixels in use (`good`) that do not stand out.
    """
    level = residual - smooth_part(residual, clean)
    pair = clean[:, 1:] & clean[:, :-1]
    step = (level[:, 1:] - level[:, :-1])[pair]
    pixel = float(np.mean(step**2)) / 2.0
    weight = in_blocks(clean).sum(axis=(1, 3))
    values = in_blocks(np.where(clean, level, 0.0)).sum(axis=(1, 3))
    means = values / np.maximum(weight, 1)
    # neighbouring blocks' differences: free of the smooth shapes that the map probes hold
    across = (means[:, 1:] - means[:, :-1])[(weight[:, 1:] > 32) & (weight[:, :-1] > 32)]
    of_blocks = float(np.mean(across**2)) / 2.0 if across.size >= _LEAST_BLOCKS else math.nan
    if signal_DN is None:
        return np.array([pixel, of_blocks, math.nan, math.nan])
    # a whole line that changed a little is a line, not a row of defects
    changed = good & (np.abs(residual) < _LINE_CHANGE * signal_DN)
    return np.array([pixel, of_blocks, _of_lines(level, clean, changed), _of_lines(level.T, clean.T, changed.T)])


def _of_lines(residual: FloatArray, clean: BoolArray, changed: BoolArray) -> float:
    """A sixth of the mean square of second differences of the means of rows, DN^2; NaN: too few can be seen."""
    # a stretch of defects is no line that changed: of that nearly all stands out
    use = np.where((clean.mean(axis=1) >= _LINE_CLEAN)[:, None], clean, changed)
    seen = use.mean(axis=1) >= 0.5
    means = np.where(use, residual, 0.0).sum(axis=1) / np.maximum(use.sum(axis=1), 1)
    bent = (means[2:] - 2.0 * means[1:-1] + means[:-2])[seen[2:] & seen[1:-1] & seen[:-2]]
    return float(np.mean(bent**2)) / 6.0 if bent.size >= _LEAST_LINES else math.nan


def pattern_of(change_DN: RealArray) -> Pattern:
    """What a change of the mean frame (row, column or 1, 1), DN, leaves in a pattern."""
    if change_DN.size == 1:
        return np.zeros(4)
    change = change_DN.astype(np.float64)
    bent = (np.diff(change.mean(axis=axis), n=2) for axis in (1, 0))
    rows, columns = (float(np.mean(one**2)) / 6.0 if one.size else 0.0 for one in bent)
    if min(change.shape) >= _LEAST_SURFACE:
        to_surface, at_pixels = _to_surface(*change.shape)
        change = change - at_pixels @ (to_surface @ in_blocks(change).mean(axis=(1, 3)).ravel())
    across = np.diff(in_blocks(change).mean(axis=(1, 3)), axis=1)
    pixel, block = (float(np.mean(one**2)) / 2.0 if one.size else 0.0 for one in (np.diff(change, axis=1), across))
    return np.array([pixel, block, rows, columns])


@lru_cache(maxsize=4)
def _to_surface(rows: int, columns: int) -> tuple[FloatArray, FloatArray]:
    """What makes of means of blocks the cubic surface's factors (term, block), and its terms at pixels (row, column, term)."""
    at_blocks, at_pixels = _cubic_terms(rows, columns)
    return np.asarray(np.linalg.pinv(at_blocks.reshape(-1, at_blocks.shape[2])), dtype=np.float64), at_pixels


def count_outliers(
    residual: FloatArray,
    variance: FloatArray,
    pixel_DN2: float,
    *,
    clean: BoolArray,
    good: BoolArray,
    least_DN: FloatArray | None = None,
) -> int:
    """Good pixels of a residual map (row, column) that stand out of noise (variance, DN^2), pattern and the clean ones around.

    Beside an edge that a picture left neighbours differ as much. least_DN (row, column): departures below it are dust, no bad pixel.
    """
    level = residual - smooth_part(residual, clean)
    limit = OUTLIER_SD * np.sqrt(variance)
    limit = limit * max(1.0, math.sqrt(pixel_DN2 / max(float(np.mean(variance[clean])), 1e-30)))
    if least_DN is not None:
        limit = np.maximum(limit, least_DN)
    out = (np.abs(level - float(np.median(level[clean]))) > limit) & good
    if not out.any():
        return 0
    around = np.pad(np.where(clean, level, np.nan), NEIGHBOURS_PX // 2, constant_values=np.nan)
    windows = sliding_window_view(around, (NEIGHBOURS_PX, NEIGHBOURS_PX))[out]
    ordered = np.sort(windows.reshape(len(windows), -1), axis=1)  # pixels that are not clean come last
    known = np.count_nonzero(np.isfinite(ordered), axis=1)
    places = (np.maximum(known - 1, 0) * quarter // 4 for quarter in (1, 2, 3))
    low, middle, high = (ordered[np.arange(len(ordered)), place] for place in places)
    beside = np.maximum(limit[out], _OUT_OF_NEIGHBOURS * (high - low))
    return int(np.count_nonzero((known == 0) | (np.abs(level[out] - middle) > beside)))

"""Where a scene really lies: the displacement of measured pictures against their thickness maps.

A wedge or an edge is put down within fractions of a pixel, and at a sharp edge a tenth of a pixel is hundreds of standard
deviations. So each placement of a scene is registered first, over all its series together, and pictures are compared
where they lie; the displacement itself stays as a probe.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ...generator.spread._fine_picture import FINE
from ..arrays import BoolArray, FloatArray, RealArray
from ..session.even_maps import local_range

RENDER_SHARE = 0.1  # of the local range: how well a pixel that an edge cuts is rendered
# shares of the local range that count as noise, round by round: far from the solution a picture's curvature is no evidence
_CAUTION = (0.5, 0.3, 0.15, *(RENDER_SHARE,) * 3)
_SETTLED_PX = 0.0005  # step below which a further one with the same share changes nothing
LARGEST_PX = 6.0  # displacement beyond which a scene is not where it is said to be
SEEN_PX = 0.3  # standard deviation below which a displacement is seen
_STRAY_PX = 2.0  # radius over which light that strays is taken as even
_WEAK = 0.05  # of what shows along the other direction
_BEYOND_PX = 12  # of a picture's border that its splines hold
_FAR_SHARES = ((4, 0.01), (12, 0.003))  # (pixels to each side, share)
SHARP_PX = 0.3  # spread below which a picture's splines ring more than a displacement shows
_DRAWN_ROUNDS = 6  # of drawing anew
_DRAWN_STEP_PX = 0.03  # of differences of drawn pictures
_DRAWN_ENOUGH_PX = 0.002  # step below which a further one changes nothing
_LARGEST_STEP_PX = 0.25
_SAME_SLOPES_PX = 0.1  # step after which slopes are drawn anew
_WORTH_A_CELL = 0.98  # share of what is left from which a step further on helps
_SHARP_BLUR_PX = 1.5  # standard deviation; the parabola through what an edge of it leaves errs by 0.004 px at most
ANYWHERE_SD_PX = 1.0 / math.sqrt(12.0)  # of a place that may be anywhere in a pixel
CELL_SD_PX = ANYWHERE_SD_PX / FINE  # of a displacement that is known to a cell of the drawing


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Displacement of the measured picture along rows and columns, px, with standard deviations."""

    row_px: float
    column_px: float
    row_sd_px: float
    column_sd_px: float

    @property
    def found(self) -> bool:
        """Whether anything in the scene has shown where it lies."""
        return min(self.row_sd_px, self.column_sd_px) < SEEN_PX


def gradient(image: RealArray) -> tuple[FloatArray, FloatArray]:
    """Slopes along rows and along columns (row, column), a pixel."""
    along_rows, along_columns = np.gradient(np.asarray(image, dtype=np.float64))
    return np.asarray(along_rows, dtype=np.float64), np.asarray(along_columns, dtype=np.float64)


def render_variance(signal_DN: RealArray, *, far: bool = True, side: int = 1, cut: float = RENDER_SHARE) -> FloatArray:
    """Variance (row, column), DN^2, with which pixels at edges are rendered from thickness maps and blur.

    far: in the shadow beside an edge the noise is so low that the far end of a blur, which no law has right, would outweigh all
    else: a share of the range within some of the panel's pixels stays open; side: of the squares that the picture has for
    pixels; cut: share of the local range to which a pixel that an edge cuts is rendered.
    """
    result = cut * local_range(signal_DN)
    for reach, share in _FAR_SHARES if far else ():
        result = np.maximum(result, share * local_range(signal_DN, math.ceil(reach / side)))
    return np.asarray(result**2, dtype=np.float64)


def without_border(mask: BoolArray, margin_px: int = 3) -> BoolArray:
    """The mask (row, column) less its outermost pixels."""
    inner = (slice(margin_px, -margin_px),) * 2
    left = np.zeros_like(mask)
    left[inner] = mask[inner]
    return left


def fill(image: RealArray, mask: BoolArray) -> FloatArray:
    """The image with pixels outside the mask taken from the median of their neighbours."""
    if mask.all():
        return np.asarray(image, dtype=np.float64)
    rough = np.where(mask, image, float(np.median(image[mask]))).astype(np.float64)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(rough, 2, mode="symmetric"), (5, 5))
    rough[~mask] = np.median(around[~mask], axis=(-2, -1))
    return rough


def _splines(image: FloatArray) -> FloatArray:
    """Coefficients of the cubic splines through a picture that goes on beyond its borders as it ends there."""
    from scipy.ndimage import spline_filter

    return np.asarray(spline_filter(np.pad(image, _BEYOND_PX, mode="edge"), order=3, mode="nearest"), dtype=np.float64)


def resample(image: RealArray, placement: Placement) -> FloatArray:
    """The measured picture brought to where the thickness maps are (cubic splines)."""
    return _resampled(_splines(np.asarray(image, dtype=np.float64)), placement)


def _resampled(splines: FloatArray, placement: Placement) -> FloatArray:
    """The measured picture (row, column) brought to where the thickness maps are, from its splines' coefficients."""
    for along in (placement.row_px, placement.column_px):
        whole = math.floor(along)
        t = along - whole
        weights = (
            (1.0 - t) ** 3,
            3.0 * t**3 - 6.0 * t**2 + 4.0,
            3.0 * (1.0 - t) ** 3 - 6.0 * (1.0 - t) ** 2 + 4.0,
            t**3,
        )
        first, length = _BEYOND_PX + whole - 1, len(splines) - 2 * _BEYOND_PX
        moved = np.zeros((length, splines.shape[1]))
        for k, weight in enumerate(weights):
            moved += weight / 6.0 * splines[first + k : first + k + length]
        splines = moved.T  # the other axis comes first in turn, and first again after both
    return splines


def register(
    measured: Sequence[RealArray], expected: Sequence[RealArray], variance: Sequence[RealArray], mask: BoolArray
) -> Placement:
    """Placement of a scene from the pictures of all its series: Gauss-Newton, level and smooth light left free.

    A displacement has a standard deviation of one pixel along either side before looking. measured, expected: signals (row, column),
    DN, of each series; variance: of the measured ones; mask: pixels to use, but for the outermost three.
    """
    inner = without_border(mask)
    current = np.zeros(2)
    covariance: FloatArray = np.eye(2)
    splines = [_splines(fill(image, mask)) for image in measured]
    models = [np.asarray(model, dtype=np.float64) for model in expected]
    slopes = [np.stack(gradient(model))[:, inner] for model in models]
    doubts = [render_variance(model, far=False) / RENDER_SHARE**2 for model in models]
    # edges are rendered with errors that any number of series share
    share = 1.0 / max(len(measured), 1)
    settled = False
    for caution, before in zip(_CAUTION, (math.inf, *_CAUTION), strict=False):
        if settled and caution == before:
            break
        placement = _placement(current, covariance)
        normal, right = np.zeros((2, 2)), current.copy()
        for image, model, noise, design, doubtful in zip(splines, models, variance, slopes, doubts, strict=True):
            doubt = doubtful * caution**2
            weight = share / (noise + doubt)[inner]
            away = _away(inner / (noise + 100.0 * doubt))
            residual, level = _left(_resampled(image, placement), model, inner=inner, weight=weight, away=away)
            more, toward = _slope(residual, level, design, weight)
            normal += more
            right += toward
        inverse, covariance = _inverse(normal)
        # where the measured picture still lies further on than the model, the residual falls along the model's slope
        step = -inverse @ right
        current = np.clip(current + np.clip(step, -1.0, 1.0), -LARGEST_PX, LARGEST_PX)
        settled = float(np.hypot(*step)) < _SETTLED_PX
    return _placement(current, covariance)


def left_over(
    measured: Sequence[RealArray], expected: Sequence[RealArray], mask: BoolArray, placement: Placement
) -> float:
    """Sum of the squares that pictures leave of measured ones (row, column), levels free, each over its highest signal squared."""
    total = 0.0
    for image, model in zip(measured, expected, strict=True):
        picture, level = resample(fill(image, mask), placement)[mask], np.asarray(model, dtype=np.float64)[mask]
        power = float(level @ level) + 1e-30
        total += (
            max(float(picture @ picture) - float(level @ picture) ** 2 / power, 0.0)
            / max(float(level.max()), 1e-30) ** 2
        )
    return total


def register_drawn(
    measured: Sequence[RealArray],
    draw: Callable[[tuple[float, float]], Sequence[RealArray]],
    variance: Sequence[RealArray],
    mask: BoolArray,
    start: Placement,
    *,
    whole_cells: bool,
) -> Placement:
    """Placement of a scene by drawing it where it may lie: nothing that was measured is resampled.

    First from `start` or from no displacement, whichever leaves less, to the neighbour that leaves least until none leaves less:
    by cells of the drawing, or by whole pixels. Then by Gauss-Newton with slopes by differences of drawn pictures; a step is taken
    only where less is left after it.

    Args:
        measured, variance, mask: as in `register`.
        draw: pictures (row, column) of all series with the scene displaced along rows and columns, px.
        start: where splines have it.
        whole_cells: pixels see no farther than themselves: to a cell, see `_vertex`; a picture with little blur cannot be moved by
            a part of a cell without ringing, and moved by a part of a pixel it is blurred.
    """
    from scipy.ndimage import gaussian_filter

    inner = without_border(mask)
    images = [fill(image, mask) for image in measured]
    blur_px = _SHARP_BLUR_PX if whole_cells else 0.0

    def drawn(at: FloatArray) -> list[FloatArray]:
        pictures = [np.asarray(model, dtype=np.float64) for model in draw((float(at[0]), float(at[1])))]
        return [gaussian_filter(one, blur_px) for one in pictures] if blur_px else pictures

    models = drawn(np.zeros(2))
    # every pixel alike: with the noise of the shadow, or with edges taken as doubtful, a blur that the twin does not know
    # would pull an edge away; doubts of rendering are those that any number of series share
    doubts = [render_variance(model, far=False) / RENDER_SHARE**2 for model in models]
    fit = _LeftOver(
        images=[gaussian_filter(image, blur_px) for image in images],
        inner=inner,
        weights=[
            1.0 / len(images) / (float(np.max(noise[inner])) + _CAUTION[-1] ** 2 * float(np.max(doubt[inner])))
            for noise, doubt in zip(variance, doubts, strict=True)
        ],
        away=[_away(inner / (noise + 100.0 * doubt)) for noise, doubt in zip(variance, doubts, strict=True)],
    )
    known: dict[tuple[int, int], float] = {}
    parts = 1 if whole_cells else FINE

    def left(step: tuple[int, int]) -> float:
        if step not in known:
            known[step] = fit.of(drawn(np.array(step) / parts))
        return known[step]

    most = round(LARGEST_PX * parts)
    step = min(((0, 0), (round(start.row_px * parts), round(start.column_px * parts))), key=left)
    while True:
        around = [(step[0] + row, step[1] + column) for row, column in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        best = min((one for one in around if max(map(abs, one)) <= most), key=left)
        if not left(best) < _WORTH_A_CELL * left(step):
            break
        step = best
    if whole_cells:
        current = np.round(FINE * (np.array(step) + _vertex(left, step))) / FINE
        sds = np.maximum([start.row_sd_px, start.column_sd_px], CELL_SD_PX)
        return _placement(current, np.diag(sds**2))
    current = np.array(step) / FINE
    models = drawn(current)
    rest = fit.of(models)
    covariance: FloatArray = np.eye(2)
    slopes: list[FloatArray] = []
    for _ in range(_DRAWN_ROUNDS):
        if not slopes:
            moved = [drawn(at) for at in current + _DRAWN_STEP_PX * np.eye(2)]
            slopes = [
                np.stack([one - model for one in pair])[:, inner] / _DRAWN_STEP_PX
                for model, *pair in zip(models, *moved, strict=True)
            ]
        normal, right = fit.slope(models, slopes)
        inverse, covariance = _inverse(normal)
        onward = np.clip(inverse @ right, -_LARGEST_STEP_PX, _LARGEST_STEP_PX)
        for part in (1.0, 0.4, 0.1):
            there = np.clip(current + part * onward, -LARGEST_PX, LARGEST_PX)
            pictures = drawn(there)
            after = fit.of(pictures)
            if after < rest:
                break
        else:
            break
        moved_px = float(np.hypot(*(there - current)))
        rest, current, models = after, there, pictures
        if moved_px < _DRAWN_ENOUGH_PX:
            break
        if moved_px > _SAME_SLOPES_PX:
            slopes = []
    return _placement(current, covariance)


def _vertex(left: Callable[[tuple[int, int]], float], step: tuple[int, int]) -> FloatArray:
    """Where beside a whole displacement (2,), px, a parabola through what whole pixels around it leave is least."""
    around = np.array([[left((step[0] + row, step[1] + column)) for column in (-1, 0, 1)] for row in (-1, 0, 1)])
    cross = 0.25 * (around[2, 2] - around[2, 0] - around[0, 2] + around[0, 0])
    curved = np.array(
        [
            [around[2, 1] + around[0, 1] - 2.0 * around[1, 1], cross],
            [cross, around[1, 2] + around[1, 0] - 2.0 * around[1, 1]],
        ]
    )
    slope = 0.5 * np.array([around[2, 1] - around[0, 1], around[1, 2] - around[1, 0]])
    values, vectors = np.linalg.eigh(curved)
    # along a single edge nothing shows the displacement
    known = values > max(_WEAK * values[-1], 1e-30)
    onward = -(vectors * np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)) @ (vectors.T @ slope)
    if 0.5 * float(-slope @ onward) < (1.0 - _WORTH_A_CELL) * around[1, 1]:
        return np.zeros(2)
    return np.asarray(np.clip(onward, -0.5, 0.5), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class _LeftOver:
    """What pictures leave of measured ones, level and smooth light left free."""

    images: Sequence[FloatArray]  # measured (row, column)
    inner: BoolArray  # pixels that count (row, column)
    weights: Sequence[float]  # of the pixels of each image
    away: Sequence[tuple[FloatArray, FloatArray]]  # see `_away`

    def _each(self, models: Sequence[FloatArray]) -> Iterator[tuple[FloatArray, FloatArray, float]]:
        """Residual, level (pixel,) and weight of each image."""
        for image, model, weight, away in zip(self.images, models, self.weights, self.away, strict=True):
            yield *_left(image, model, inner=self.inner, weight=weight, away=away), weight

    def of(self, models: Sequence[FloatArray]) -> float:
        """Sum of squares."""
        return sum(weight * float(residual @ residual) for residual, _, weight in self._each(models))

    def slope(self, models: Sequence[FloatArray], slopes: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """The sum of `_slope` over all pictures, for slopes (2, pixel) of each."""
        each = zip(self._each(models), slopes, strict=True)
        found = [_slope(residual, level, design, weight) for (residual, level, weight), design in each]
        normal, right = (np.sum(parts, axis=0) for parts in zip(*found, strict=True))
        return normal, right


def _left(
    picture: FloatArray,
    model: FloatArray,
    *,
    inner: BoolArray,
    weight: FloatArray | float,
    away: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """What a model leaves of a picture in the inner pixels, level and smooth light left free, and its level there, each (pixel,)."""
    level = model[inner]
    weighed = weight * level
    power = float(weighed @ level) + 1e-30
    # a brighter beam is no light that strays: smoothed, what it leaves at an edge would look like a displacement
    apart = picture - float(weighed @ picture[inner]) / power * model
    residual = (apart - _stray(apart, *away))[inner]
    return residual - float(weighed @ residual) / power * level, level


def _slope(
    residual: FloatArray, level: FloatArray, design: FloatArray, weight: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (2, 2) and right side (2,) of the step that leaves least, the level free; design: slopes (2, pixel)."""
    weighed = weight * design
    cross = weighed @ level
    normal = weighed @ design.T - np.outer(cross, cross) / (float((weight * level) @ level) + 1e-30)
    return normal, np.asarray(weighed @ residual)


def _inverse(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What makes of a right side a step, 0 along a weak direction, and its covariance, each (2, 2), with a prior of one pixel."""
    values, vectors = np.linalg.eigh(normal)
    weak = values < _WEAK * values[-1]
    inverse = np.where(weak, 0.0, 1.0 / (np.maximum(values, 0.0) + 1.0))
    step, covariance = ((vectors * one) @ vectors.T for one in (inverse, np.where(weak, 1.0, inverse)))
    return step, covariance


def _away(weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights (row, column) of pixels away from edges, and their smooth sum."""
    from scipy.ndimage import gaussian_filter

    return weight, np.maximum(gaussian_filter(weight, _STRAY_PX, mode="constant"), 1e-30)


def _stray(residual: FloatArray, weight: FloatArray, total: FloatArray) -> FloatArray:
    """The smooth part of a residual, as pixels away from edges show it; weight, total: see `_away`."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(weight * residual, _STRAY_PX, mode="constant") / total)


def _placement(values: FloatArray, covariance: FloatArray) -> Placement:
    sds = np.sqrt(np.diag(covariance) + 1e-3**2)  # none is known better than that
    return Placement(
        row_px=float(values[0]), column_px=float(values[1]), row_sd_px=float(sds[0]), column_sd_px=float(sds[1])
    )

"""What the frames of a series say about themselves: copies of one frame, and whether all of them show one scene.

Functions on frames that arrive in pieces; memory does not grow with their number. Thresholds are false-alarm
probabilities under the noise law, widened by what a panel that works does without anything being wrong.
"""

import enum
import hashlib
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .robust import robust_sd

FALSE_ALARM = 1e-3  # probability that a series without fault is reported, per check
# What a panel and a tube that work may do between frames of one series, relative to the signal. Level and smooth shape:
# three times the largest plausible rms of output drift and of a smooth gain change (3 %). Pattern: what the flats of a
# CMOS panel (Zenodo 10.5281/zenodo.2686726) change by from before to after a scan, 0.1 %.
LEVEL_CHANGE = 0.5
SHAPE_CHANGE = 0.03
PATTERN_CHANGE = 1e-3
DARK_PATTERN_SIGMAS = 0.1  # of darks, over the noise of a pixel: the row noise that any panel has
# Largest offset of a block of rows or columns over the noise of a pixel: rows of the largest plausible noise (2 sigmas
# each) reach less, averaged over a block, in any field. Where it jumps once, to more than half of that noise and ...
LINE_SIGMAS, LINE_JUMP_SIGMAS = 3.0, 0.5
_JUMPS = 6.0  # ... this many times the usual offset: the largest of a thousand normal numbers is 3.2 times that of ten
_ENOUGH_PAIRS = 4
_SPECKS = 2  # dust and cosmic rays: single places that differ do not make another scene, ...
_SPECK_SHARE = 0.01  # ... nor does this share of the field
_TESTS_A_SPECK = 4  # mixed differences that one block is part of
WIDEST_SPREAD_PX = 3.0  # Gaussian width of the optical spread: wider than that of any screen on pixels that resolve it
_MOST_FRAMES = 512  # block means kept: longer series are thinned evenly
_LONG_PAIRS = 8  # differences from the first frame, over the whole series
_SHAPE_DEGREE = 4
_WEIGHINGS = 5  # of the variance law: weights follow the fitted variances
_KEPT_PIXELS = 4096  # for the noise of a pixel and the chance of equal numbers


_RASTER_PIXELS = 2**20  # looked at for the length of rows: correlations to a thousandth
_SHORTEST_ROW_PX = 8
_BY_CHANCE = 6.0  # standard deviations of a correlation: one in 1e9, for there are hundreds of lengths


class SceneChange(enum.StrEnum):
    """How frames of one series differ beyond noise, drift and flicker."""

    STRUCTURE = "structure"  # edges have moved: an object turned or shifted
    SHAPE = "shape"  # the field as a whole has another shape
    LINES = "lines"  # rows or columns as a whole: a shutter, a collimator
    LEVEL = "level"  # another exposure, current, or the beam off


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneCheck:
    """Whether the frames of a series show one scene.

    Fields: same (None: cannot be told); change (None where the scene is the same); frame (index of the first frame that
    differs, None where it is the same); changed_share (of the field); level_change and shape_change (largest, relative to
    the signal; rms of the smooth part); block_px (side of a block); changed (block rows, block columns): blocks that differ.
    """

    same: bool | None
    change: SceneChange | None
    frame: int | None
    changed_share: float
    level_change: float
    shape_change: float
    block_px: int
    changed: NDArray[np.bool_]


def repeated_frame_indices(pieces: Iterable[NDArray[Any]]) -> tuple[int, ...]:
    """Indices of frames that are copies of an earlier frame of the same series, in order.

    A copy equals an earlier frame in every pixel. Two exposures are equal by chance with p^N, N pixels that each repeat
    their number with probability p; p is the share of equal pixels in successive frames that are not copies. Where the
    expected number of chance copies exceeds `FALSE_ALARM` (frames of few counts), none is reported, nor where half of a frame's
    pixels hold its largest number (frames of nothing but zeros, saturated ones).

    Args:
        pieces: frames in time order, arrays (m, row, column), DN; read once.

    Returns:
        Indices from 0; empty where every frame is an exposure of its own. Counting such frames once makes a grabber's
        repeated frames harmless.
    """
    scan = CopyScan()
    for piece in pieces:
        scan.add(piece)
    return tuple(sorted(scan.copies()))


def repeats_the_last(frames: NDArray[Any], last: NDArray[Any] | None) -> NDArray[np.bool_]:
    """Which frames (m, row, column) or (m, pixel) equal the one before them in every pixel (m,); `last`: the one before the first.

    Between a frame and its copy there is no step of noise. A frame whose pixels are all equal, such as a blank one, is no copy.
    """
    before = [last, *frames[:-1]]
    return np.array(
        [
            one is not None and one.flat[0] == frame.flat[0] and np.array_equal(one, frame) and bool(np.ptp(frame) > 0)
            for one, frame in zip(before, frames, strict=True)
        ],
        dtype=bool,
    )


class CopyScan:
    """Finds copies among frames that are handed over one piece after the other."""

    def __init__(self) -> None:
        self._digests: list[bytes] = []
        self._equal = self._compared = 0
        self._last: NDArray[Any] | None = None
        self._saturated: list[bool] = []
        self._pixels = 0

    @property
    def digests(self) -> tuple[bytes, ...]:
        """One digest a frame, in order."""
        return tuple(self._digests)

    def add(self, piece: NDArray[Any]) -> None:
        """Take the next frames (m, row, column)."""
        for frame in piece:
            values = np.ascontiguousarray(frame)
            self._digests.append(hashlib.blake2b(values.data, digest_size=16).digest())
            self._pixels = values.size
            step = max(1, values.size // _KEPT_PIXELS)
            kept = values.reshape(-1)[::step].copy()
            # half of the pixels at the largest number: saturated, and the rest are defects that may never change
            self._saturated.append(bool(np.median(kept) == kept.max()) and bool(np.median(values) == values.max()))
            if self._last is not None and self._digests[-1] != self._digests[-2]:
                self._equal += int(np.count_nonzero(kept == self._last))
                self._compared += kept.size
            self._last = kept

    def copies(self) -> dict[int, int]:
        """Index of each copy -> index of the frame that it copies."""
        first: dict[bytes, int] = {}
        found = {}
        for index, digest in enumerate(self._digests):
            origin = first.setdefault(digest, index)
            if origin != index and not self._saturated[index]:
                found[index] = origin
        if not found:
            return found
        # log of the expected number of pairs that are equal by chance
        share = (self._equal + 0.5) / (self._compared + 1.0) if self._compared else 0.0
        pairs = 0.5 * len(self._digests) * (len(self._digests) - 1)
        chance = math.log(pairs) + self._pixels * math.log(share) if share > 0 else -math.inf
        return found if chance < math.log(FALSE_ALARM) else {}


def same_scene(pieces: Iterable[NDArray[Any]], *, offset_DN: float = 0.0) -> SceneCheck:
    """Whether all frames show one scene, so that they differ by noise, drift and flicker alone.

    Each frame is reduced to means of blocks. From the difference of two frames a common factor, a smooth change of shape
    and offsets are fitted away, and mixed second differences of neighbouring blocks (B00 - B01 - B10 + B11) leave neither
    row nor column offsets. What is left is noise of a variance that is linear in the signal, however it is correlated
    over a few pixels, if the scene is the same. It is not the same where

    - more of the field than specks of dust take departs by more standard deviations than `FALSE_ALARM` allows over all
      tests, or where the variance of block means does not fall with their size as noise does (`STRUCTURE`);
    - the smooth change exceeds `SHAPE_CHANGE`, whole rows or columns exceed `LINE_SIGMAS`, or the level `LEVEL_CHANGE`.

    Args:
        pieces: frames in time order, arrays (m, row, column), DN; read once.
        offset_DN: level without light, so that changes are relative to the signal.

    Returns:
        The answer; `same` is None for a single frame and for fields of fewer than 16 pixels a side.
    """
    scan = SceneScan()
    for piece in pieces:
        scan.add(piece)
    return scan.result(offset_DN=offset_DN)


def with_median_at(frames: NDArray[Any], pixels: NDArray[np.bool_]) -> NDArray[Any]:
    """The frames (m, row, column) with the median of each at these pixels (row, column)."""
    if not pixels.any() or pixels.all():
        return frames
    result = frames.copy()
    result[:, pixels] = np.median(frames[:, ~pixels], axis=1, keepdims=True)
    return result


class SceneScan:
    """`same_scene` for frames that are handed over one piece after the other."""

    def __init__(self) -> None:
        self._side = 1
        self._kept: list[NDArray[np.float64]] = []
        self._indices: list[int] = []
        self._spreads: list[float] = []
        self._last: NDArray[np.float64] | None = None
        self._stride, self._number = 1, 0

    def add(self, piece: NDArray[Any]) -> None:
        """Take the next frames (m, row, column), DN."""
        if self._number == 0:
            self._side = _block_side(piece.shape[1:])
        step = max(1, int(np.prod(piece.shape[1:])) // _KEPT_PIXELS)
        for frame in piece if self._side else ():
            sample = frame.reshape(-1)[::step].astype(np.float64)
            if self._last is not None and len(self._spreads) < _MOST_FRAMES:
                change = sample - self._last
                self._spreads.append(float(np.median(np.abs(change - np.median(change)))))
            self._last = sample
            if self._number % self._stride == 0:
                self._kept.append(block_means(frame[None], self._side)[0])
                self._indices.append(self._number)
            self._number += 1
            if len(self._kept) > _MOST_FRAMES:
                self._kept, self._indices, self._stride = self._kept[::2], self._indices[::2], 2 * self._stride

    def result(self, *, offset_DN: float = 0.0, lit: bool = True) -> SceneCheck:
        """The answer for the frames taken so far; see `same_scene`.

        lit: False for darks, whose level and shape have no scale: only structure and lines are judged.
        """
        if len(self._kept) < 2:
            return _cannot_tell(self._side, (0, 0))
        sigma_DN = 1.4826 * float(np.median(self._spreads)) / math.sqrt(2.0)
        indices = np.array(self._indices, dtype=np.intp)
        return _judged(indices, np.array(self._kept) - offset_DN, sigma_DN, self._side, lit=lit)


def _cannot_tell(block: int, shape: tuple[int, ...]) -> SceneCheck:
    return SceneCheck(
        same=None,
        change=None,
        frame=None,
        changed_share=0.0,
        level_change=0.0,
        shape_change=0.0,
        block_px=block,
        changed=np.zeros(shape, dtype=bool),
    )


def _block_side(shape: tuple[int, ...]) -> int:
    """Side of a block, px: wide enough that noise of neighbours averages out, with four blocks a side at least."""
    shorter = min(shape)
    return next((side for side, least in ((16, 256), (8, 96), (4, 16)) if shorter >= least), 0)


def block_means(frames: NDArray[Any], side: int) -> NDArray[np.float64]:
    """Means over blocks of `side` x `side` pixels (m, block row, block column), DN; what does not fill a block is left out."""
    count, rows, columns = frames.shape[0], frames.shape[1] // side, frames.shape[2] // side
    used = frames[:, : rows * side, : columns * side].reshape(count, rows, side, columns * side)
    lines = used.sum(axis=2, dtype=np.float64)
    return np.asarray(lines.reshape(count, rows, columns, side).sum(axis=3) / side**2)


def _mixed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mixed second differences of neighbours (..., row - 1, column - 1): row and column offsets leave no trace."""
    down = values[..., 1:, :] - values[..., :-1, :]
    return np.asarray(down[..., 1:] - down[..., :-1])


def _smooth_terms(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Products of Legendre polynomials up to `_SHAPE_DEGREE` in all, (terms, row, column); the constant first."""
    rows, columns = (np.linspace(-1.0, 1.0, length) for length in shape)
    degree = min(_SHAPE_DEGREE, min(shape) // 4)
    along = [np.polynomial.legendre.legvander(axis, degree).T for axis in (rows, columns)]
    return np.array(
        [
            along[0][total - power][:, None] * along[1][power][None, :]
            for total in range(degree + 1)
            for power in range(total + 1)
        ]
    )


@dataclass(frozen=True, slots=True)
class _Change:
    """Of one frame to another: level and smooth shape (relative), largest offset of lines (DN), what is left (block row, column)."""

    level: float
    shape: float
    lines_DN: float
    left: NDArray[np.float64]


def _change(
    earlier: NDArray[np.float64],
    later: NDArray[np.float64],
    terms: NDArray[np.float64],
    *,
    lit: bool,
    noise_growth: float,
) -> _Change:
    """Fit the difference of two frames as their mean times a smooth surface, and an offset; blocks that stand out are left out.

    The noise of the mean is independent of the difference's: of the earlier frame alone it would look like a change of shape.

    `noise_growth` is how much more noise a mean over many blocks may have than white noise of the blocks' variance has.
    """
    from scipy.special import chdtri  # of chi-square's upper tail

    difference, middle = later - earlier, 0.5 * (earlier + later)
    signal = float(np.mean(middle))
    count = len(terms)
    rows = terms * middle if lit else terms
    design = np.concatenate([rows, terms[:1]]) if lit else rows
    matrix = design.reshape(len(design), -1).T
    target = difference.reshape(-1)
    use = np.ones(target.size, dtype=bool)
    scale = np.linalg.norm(matrix, axis=0) + 1e-30
    # behind opaque things a counter counts nothing, and that tells no noise of what is beside them
    alive = (earlier.reshape(-1) != 0.0) | (later.reshape(-1) != 0.0)
    alive = alive if alive.any() else use
    solution = np.zeros(len(design))
    for _ in range(3):
        # by normal equations: a few unknowns and thousands of blocks
        rows_in_use = (matrix / scale)[use]
        gram = rows_in_use.T @ rows_in_use
        solution = np.linalg.lstsq(gram, rows_in_use.T @ target[use], rcond=1e-11)[0] / scale
        left = target - matrix @ solution
        spread = robust_sd(left[use & alive], about=0.0)
        use = np.abs(left) <= max(5.0 * spread, 1e-12)
        if np.count_nonzero(use & alive) < 2 * len(design):
            break
    left = (target - matrix @ solution).reshape(difference.shape)
    level = shape = 0.0
    if lit and signal > 0:
        level = float(np.mean(difference)) / signal
        surface = np.tensordot(solution[:count], terms, 1)
        smooth = surface * middle + solution[count]
        # what noise alone gives to the coefficients, so that only more than that is a change
        spread = robust_sd(left.reshape(-1)[alive], about=0.0) * noise_growth / math.sqrt(left.size)
        by_noise = spread**2 * float(chdtri(len(design), FALSE_ALARM))
        # of another level are a factor and an offset: beside a dark whose pattern is deeper than the signal it is no factor
        unlike = min(float(np.var(smooth - level * middle)), float(np.var(smooth)))
        shape = math.sqrt(max(unlike - by_noise, 0.0)) / signal
        level = math.copysign(max(abs(level) - _two_sided_limit(FALSE_ALARM) * spread / signal, 0.0), level)
    lines = max(float(np.max(np.abs(np.median(left, axis=axis)))) for axis in (0, 1))
    return _Change(level=level, shape=shape, lines_DN=lines, left=left)


def _judged(
    indices: NDArray[np.intp], means: NDArray[np.float64], sigma_DN: float, block: int, *, lit: bool
) -> SceneCheck:
    shape = (int(means.shape[1]), int(means.shape[2]))
    count = len(means)
    # frames with next to no light have no scale for level and shape
    lit = lit and float(np.median(means)) > 0.5 * sigma_DN
    terms = _smooth_terms(shape)
    moving = [number for number in range(1, count) if not np.array_equal(means[number], means[number - 1])]
    later = sorted({round(value) for value in np.linspace(1, count - 1, min(_LONG_PAIRS, count - 1))} - {1})
    pairs = [(number - 1, number) for number in moving]
    pairs += [(0, number) for number in later if not np.array_equal(means[number], means[0])]
    if not pairs:
        return _cannot_tell(block, shape)
    # from the blocks to the whole field: twice the side and twice again
    widest = math.sqrt(growth_of_noise(block, WIDEST_SPREAD_PX) * growth_of_noise(2 * block, WIDEST_SPREAD_PX))
    changes = [_change(means[early], means[late], terms, lit=lit, noise_growth=widest) for early, late in pairs]
    left = np.array([item.left for item in changes])
    local = _four_mean(np.abs(means.mean(axis=0)))
    mixed = _mixed(left)
    consecutive = max(len(moving), 1)
    # what the smooth surface itself has of the noise is left where there is none
    noise = _variance_law(mixed[:consecutive], local)
    noise = np.maximum(noise, float(noise.max()) * len(terms) / terms[0].size)
    pattern_DN = PATTERN_CHANGE * local if lit else np.full(local.shape, DARK_PATTERN_SIGMAS * sigma_DN)
    variance = noise + 4.0 * pattern_DN**2
    tests = mixed.size
    limit = _two_sided_limit(FALSE_ALARM / tests)
    beyond = np.abs(mixed) > limit * np.sqrt(variance)
    places = beyond.any(axis=0)
    changed = np.zeros(shape, dtype=bool)
    for down in (0, 1):
        for right in (0, 1):
            changed[down : down + places.shape[0], right : right + places.shape[1]] |= places
    grows = _grows(left, local, noise, pattern_DN, consecutive, block)
    level = max((item.level for item in changes), key=abs, default=0.0)
    smooth = max(item.shape for item in changes)
    lines_DN = np.array([item.lines_DN for item in changes])
    # of a pixel where it is brightest (mixed differences hold the noise of eight blocks): lines run through light and shadow
    brightest_DN = max(sigma_DN, block * math.sqrt(float(noise.max()) / 8.0))
    odd_lines = lines_DN > LINE_SIGMAS * math.sqrt(2.0) * brightest_DN
    if len(moving) >= _ENOUGH_PAIRS:
        # row noise is in every pair: what jumps once is no noise
        usual = float(np.median(lines_DN[: len(moving)]))
        jumps = lines_DN > max(_JUMPS * usual, LINE_JUMP_SIGMAS * math.sqrt(2.0) * brightest_DN)
        odd_lines |= jumps & (np.arange(len(pairs)) < len(moving))
    most = max(_SPECK_SHARE * places.size, _SPECKS * _TESTS_A_SPECK)
    change: SceneChange | None = None
    at = None

    def first_of(flags: NDArray[np.bool_]) -> int:
        return int(indices[pairs[int(np.argmax(flags))][1]])

    if lit and abs(level) > LEVEL_CHANGE:
        change = SceneChange.LEVEL
        at = first_of(np.array([abs(item.level) > LEVEL_CHANGE for item in changes]))
    elif places.sum() > most or grows:
        change = SceneChange.STRUCTURE
        counts = beyond.reshape(len(pairs), -1).sum(axis=1)
        at = first_of(counts > 0.5 * counts.max())
    elif sigma_DN > 0 and odd_lines.any():
        change = SceneChange.LINES
        at = first_of(odd_lines)
    elif lit and smooth > SHAPE_CHANGE:
        change = SceneChange.SHAPE
        at = first_of(np.array([item.shape > SHAPE_CHANGE for item in changes]))
    return SceneCheck(
        same=change is None,
        change=change,
        frame=at,
        changed_share=float(changed.mean()),
        level_change=float(level),
        shape_change=float(smooth),
        block_px=block,
        changed=changed,
    )


def _four_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the four blocks of each mixed difference."""
    pairs = values[1:, :] + values[:-1, :]
    return np.asarray(0.25 * (pairs[:, 1:] + pairs[:, :-1]))


def _robust_variance(values: NDArray[np.float64]) -> float:
    """Variance from the median of squares about zero."""
    return float(np.median(np.asarray(values) ** 2)) / 0.4549364


def _variance_law(mixed: NDArray[np.float64], local: NDArray[np.float64]) -> NDArray[np.float64]:
    """Noise variance of each place, a + s x signal with both 0 or more, from medians within bins of the signal, DN^2."""
    from scipy.optimize import nnls

    flat = local.reshape(-1)
    squares = mixed.reshape(len(mixed), -1)
    bins = int(np.clip(flat.size // 40, 1, 12))
    edges = np.quantile(flat, np.linspace(0.0, 1.0, bins + 1))
    rows = []
    for low, high in itertools.pairwise(edges):
        inside = (flat >= low) & (flat <= high)
        if inside.any():
            rows.append((float(np.median(flat[inside])), _robust_variance(squares[:, inside])))
    signal, found = np.array(rows).T
    floor = max(float(np.max(found)) * 1e-6, 1e-12)
    if bins == 1:
        return np.full(local.shape, max(float(found[0]), floor))
    # Errors are relative to the law, not to what was found: light that strays from afar brings signal with little noise, and a
    # bin in such a shadow would pull the noise of all others down to its own.
    expected = np.full(len(found), float(np.median(found)))
    solution = np.zeros(2)
    for _ in range(_WEIGHINGS):
        weight = 1.0 / np.maximum(expected, floor)
        solution, _ = nnls(np.stack([np.ones_like(signal), signal], axis=1) * weight[:, None], found * weight)
        expected = solution[0] + solution[1] * signal
    return np.asarray(np.maximum(solution[0] + solution[1] * local, floor))


def _grows(
    left: NDArray[np.float64],
    local: NDArray[np.float64],
    noise: NDArray[np.float64],
    pattern_DN: NDArray[np.float64],
    consecutive: int,
    block: int,
) -> bool:
    """Whether block means at twice the side vary more than noise can, over a quarter of their variance at the side.

    Noise has what a spread of `WIDEST_SPREAD_PX` gives it at most, and a pattern that changes does not average out; the
    sampling error of both robust variances is added at `FALSE_ALARM`.

    Args:
        left: what is left of the differences (pair, block row, block column), DN.
        local, noise, pattern_DN: signal (DN), variance of mixed differences (DN^2) and pattern change (DN) at each place.
        consecutive: how many pairs are successive frames; the others are judged by themselves.
        block: side of a block, px.
    """
    rows, columns = left.shape[1] // 2, left.shape[2] // 2
    if rows < 2 or columns < 2:
        return False
    # places of the larger blocks: every second of the smaller ones' places, in the middle of four
    middle = (slice(1, 2 * rows - 1, 2), slice(1, 2 * columns - 1, 2))
    coarse = _mixed(block_means(left, 2))
    noise_here, pattern_here = noise[middle], pattern_DN[middle]
    most = growth_of_noise(block, WIDEST_SPREAD_PX) * noise_here / 4.0 + 4.0 * pattern_here**2
    grows = False
    for part in (slice(0, consecutive), slice(consecutive, None)):
        if not coarse[part].size:
            continue
        # the efficiency of a median of squares is 0.37, and overlapping differences count about half
        sd = math.sqrt(2.0 / 0.37 * 2.0 * (1.0 / coarse[part].size + 1.0 / (local.size * consecutive)))
        limit = math.exp(_two_sided_limit(FALSE_ALARM) * sd)
        grows = grows or _robust_variance(coarse[part] / np.sqrt(most)) > limit
    return grows


def growth_of_noise(side: int, spread_px: float) -> float:
    """Variance of mixed differences of block means at twice the side over a quarter of that at the side, for noise that a
    Gaussian spread of width `spread_px` correlates; 1 for white noise.
    """
    lags = np.arange(-6 * side, 6 * side + 1)
    correlation = np.exp(-(lags**2) / (4.0 * spread_px**2)) if spread_px > 0 else (lags == 0).astype(np.float64)

    def of_step(width: int) -> float:
        # the step's own autocorrelation: of +1 over one block and -1 over the next
        step = np.concatenate([np.ones(width), -np.ones(width)])
        own = np.correlate(step, step, mode="full")
        reach = 2 * width - 1
        middle = 6 * side
        return float(own @ correlation[middle - reach : middle + reach + 1]) / width**2

    return (2.0 * of_step(2 * side) / of_step(side)) ** 2


def _two_sided_limit(probability: float) -> float:
    """Standard deviations that a normal number exceeds with this probability."""
    from scipy.special import ndtri

    return float(-ndtri(0.5 * probability))


def row_length_shown(first: NDArray[Any], second: NDArray[Any]) -> int | None:
    """Row length (px) that two frames (row, column) of one flat show, where it is not theirs; None: theirs, or not told.

    Neighbours share light, those above and below as those beside. In the order of the file their noise then repeats after one row,
    and one pixel before and after that. Electronics that repeat along a row do not do the latter.
    """
    rows, columns = first.shape
    kept = max(min(rows, _RASTER_PIXELS // columns), 2)
    change = second[:kept].astype(np.float64) - first[:kept]
    # lines that the readout moves as a whole say nothing of light
    change -= np.median(change, axis=1, keepdims=True)
    change -= np.median(change, axis=0)
    largest = 4.0 * 1.4826 * float(np.median(np.abs(change)))
    noise = np.clip(change, -largest, largest).ravel()
    whole = float(noise @ noise)
    if whole <= 0.0:
        return None

    def correlation(lag: int) -> float:
        shared: float = float(noise[lag:] @ noise[:-lag])
        return shared / whole * float(noise.size / (noise.size - lag))

    chance = _BY_CHANCE * math.sqrt(2.0 / noise.size)
    lengths = [n for n in range(_SHORTEST_ROW_PX, noise.size // 2) if first.size % n == 0 and n != columns]
    length = max(lengths, key=correlation, default=columns)
    there = correlation(length)
    beside = [correlation(length - 1), correlation(length + 1)]
    told = min(beside) > chance and there > max(beside) and correlation(columns) < 0.5 * there
    return length if told else None

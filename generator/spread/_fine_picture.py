"""Sharp borders of objects on a grid three times as fine as the pixels, so that blur acts on the border and not on pixels.

A picture given as pixel averages says where a border runs: the share of the pixel that is covered, and the direction
from its neighbours. Nine cells a pixel are filled from that (a straight border through the pixel), cells of other pixels
follow the slope of their neighbourhood. Blur, the averaging over the pixel and its sampling are then exact sums over
cosines up to 1.5 cycles a pixel; a picture cut off at half a cycle would ring beside every edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FINE = 3  # cells a pixel along each axis
_MATRICES_TO_PX = 256  # a side: up to there two products are faster than cosine transforms, twice at 128


@dataclass(frozen=True, slots=True)
class Borders:
    """Pixels that the border of an object cuts: the signal is shared between the neighbours on either side.

    Fields: pixel, thick, thin (n,): flat indices of the pixel and of its most and least attenuating neighbour; covered
    (n,): share of the pixel behind the thick one; normal (2, n): direction along rows and columns to the thick side, any
    length; sharpness (n,): 1 a step, 0 a slope; any_steps: whether the picture has steps at all, pixels that are cut or not.
    """

    pixel: NDArray[np.intp]
    thick: NDArray[np.intp]
    thin: NDArray[np.intp]
    covered: FloatArray
    normal: FloatArray
    sharpness: FloatArray
    any_steps: bool


def find_borders(depth: FloatArray, *, least_depth: float) -> Borders:
    """Pixels of `depth` (row, column) (optical depth, pixel means) that lie on a step between two plateaus.

    The mean of exp(-depth) over a pixel that an edge cuts is not exp(-mean depth). A step spans the same range in 3 x 3
    as in 5 x 5 pixels, a slope half of it; between the two, sharpness falls from 1 to 0.

    Args:
        depth: pixel means.
        least_depth: range across 3 x 3 pixels from which a step counts.
    """
    rows, columns = depth.shape
    # borders of the frame go on as they come, so that a slope does not end there in a plateau
    wide = np.pad(depth, 2, mode="reflect", reflect_type="odd")
    most_3, least_3 = _of_three(wide, np.maximum), _of_three(wide, np.minimum)
    range_3 = (most_3 - least_3)[1:-1, 1:-1]
    range_5 = _of_three(most_3, np.maximum) - _of_three(least_3, np.minimum)
    sharpness = np.clip(2.0 * range_3 / np.maximum(range_5, 1e-12) - 1.0, 0.0, 1.0)
    steps = (range_3 > least_depth) & (sharpness > 1e-6)
    any_steps = bool(np.any(sharpness[steps] > 0.5))
    row, column = np.nonzero(steps)
    if row.size == 0:
        none = np.zeros(0, dtype=np.intp)
        return Borders(none, none, none, np.zeros(0), np.zeros((2, 0)), np.zeros(0), any_steps)
    around = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    near_row = np.clip(row[:, None] + around[:, 0], 0, rows - 1)
    near_column = np.clip(column[:, None] + around[:, 1], 0, columns - 1)
    near = depth[near_row, near_column]
    index = near_row * columns + near_column
    every = np.arange(row.size)
    most, least = near.argmax(axis=1), near.argmin(axis=1)
    high, low = near[every, most], near[every, least]
    covered = (depth[row, column] - low) / (high - low)
    inside = (covered > 1e-6) & (covered < 1 - 1e-6)
    part = (near[inside] - low[inside, None]) / (high - low)[inside, None]
    smooth = np.array([1.0, 2.0, 1.0])
    normal_row = part @ (around[:, 0] * smooth[around[:, 1] + 1])
    normal_column = part @ (around[:, 1] * smooth[around[:, 0] + 1])
    return Borders(
        pixel=(row * columns + column)[inside],
        thick=index[every, most][inside],
        thin=index[every, least][inside],
        covered=covered[inside],
        normal=np.stack([normal_row, normal_column]),
        sharpness=sharpness[row, column][inside],
        any_steps=any_steps,
    )


def _of_three(picture: FloatArray, which: np.ufunc) -> FloatArray:
    """Largest or least of 3 x 3 pixels (row - 2, column - 2), by what `which` of two is."""
    lines = which(which(picture[:-2], picture[1:-1]), picture[2:])
    return np.asarray(which(which(lines[:, :-2], lines[:, 1:-1]), lines[:, 2:]))


def area_beyond(distance: FloatArray, long: FloatArray, short: FloatArray) -> FloatArray:
    """Share of a unit square on the far side of a line at `distance` from its centre, normal (long, short), long >= short.

    The projection of the square on the normal is the sum of two uniform numbers of widths `long` and `short`.
    """
    plus, minus = 0.5 * (long + short), 0.5 * (long - short)

    def square(values: FloatArray) -> FloatArray:
        return np.maximum(values, 0.0) ** 2

    below = (
        square(distance + plus) - square(distance + minus) - square(distance - minus) + square(distance - plus)
    ) / (2.0 * long * short)
    return np.asarray(1.0 - np.clip(below, 0.0, 1.0))


def cell_coverage(normal_row: FloatArray, normal_column: FloatArray, covered: FloatArray) -> FloatArray:
    """Covered share of each cell (n, 3, 3) of pixels that a straight border cuts so that `covered` (n,) lies behind it.

    Args:
        normal_row, normal_column: (n,) direction from the open to the covered side, any length.
        covered: (n,) share of the pixel, between 0 and 1.
    """
    length = np.hypot(normal_row, normal_column)
    known = length > 1e-9
    down = np.where(known, normal_row, 1.0) / np.where(known, length, 1.0)
    right = np.where(known, normal_column, 0.0) / np.where(known, length, 1.0)
    long = np.maximum(np.abs(down), np.abs(right))
    short = np.maximum(np.minimum(np.abs(down), np.abs(right)), 1e-4)
    lowest, highest = np.full(covered.shape, -1.0), np.full(covered.shape, 1.0)
    for _ in range(40):
        middle = 0.5 * (lowest + highest)
        too_much = area_beyond(middle, long, short) > covered
        lowest, highest = np.where(too_much, middle, lowest), np.where(too_much, highest, middle)
    distance = 0.5 * (lowest + highest)
    place = (np.arange(FINE) - 0.5 * (FINE - 1)) / FINE
    offset = down[:, None, None] * place[:, None] + right[:, None, None] * place[None, :]
    cells = area_beyond(FINE * (distance[:, None, None] - offset), long[:, None, None], short[:, None, None])
    # what is not straight within the pixel would change its mean
    return np.asarray(cells + (covered - cells.mean(axis=(1, 2)))[:, None, None])


def _least_slope(picture: FloatArray, axis: int) -> FloatArray:
    """Slope of each pixel along an axis: the lesser of those to either side, 0 where they differ in sign."""
    steps = np.zeros([length + (along == axis) for along, length in enumerate(picture.shape)])
    inside, before, after = (
        tuple(part if along == axis else slice(None) for along in (0, 1))
        for part in (slice(1, -1), slice(None, -1), slice(1, None))
    )
    np.subtract(picture[after], picture[before], out=steps[inside])
    one, other = steps[before], steps[after]
    # both rising or both falling, else 0
    return np.asarray(np.maximum(np.minimum(one, other), 0.0) + np.minimum(np.maximum(one, other), 0.0))


def fine_cells(
    picture: FloatArray, thick: FloatArray, thin: FloatArray, borders: Borders, share: FloatArray
) -> FloatArray:
    """Cells (3 row, 3 column) of a picture (row, column): mean over a pixel's cells is the pixel.

    Args:
        picture: pixel means.
        thick, thin: (n,) values of the plateaus on either side of each border pixel.
        borders: where they are.
        share: (n, 3, 3) covered share of their cells.
    """
    rows, columns = picture.shape
    place = (np.arange(FINE) - 0.5 * (FINE - 1)) / FINE
    down, right = _least_slope(picture, 0), _least_slope(picture, 1)
    cells = np.empty((rows, FINE, columns, FINE))
    for i, below in enumerate(place):
        line = picture + below * down
        for j, beside in enumerate(place):
            cells[:, i, :, j] = line + beside * right
    if borders.pixel.size:
        row, column = np.divmod(borders.pixel, columns)
        shared = share * thick[:, None, None] + (1.0 - share) * thin[:, None, None]
        smooth = cells[row, :, column, :]
        cells[row, :, column, :] = smooth + borders.sharpness[:, None, None] * (shared - smooth)
    return np.asarray(cells.reshape(FINE * rows, FINE * columns))


def pixel_means(cells: FloatArray) -> FloatArray:
    """Mean over the cells of each pixel (row, column)."""
    rows, columns = cells.shape[0] // FINE, cells.shape[1] // FINE
    return np.asarray(cells.reshape(rows, FINE, columns, FINE).mean(axis=(1, 3)))


@dataclass(frozen=True, slots=True)
class FineCells:
    """Cells (3 row, 3 column) of a picture, and what was made of them.

    drawn: pixels (row, column) by what they were drawn with; filled by those who draw.
    """

    cells: NDArray[np.floating]
    drawn: dict[object, NDArray[np.floating]] = field(default_factory=dict, compare=False, repr=False)

    @property
    def transform(self) -> NDArray[np.floating]:
        """Cosine transform (3 row, 3 column), the averaging over pixels in it."""
        if "transform" not in self.drawn:
            self.drawn["transform"] = transform_of_cells(self.cells).astype(self.cells.dtype, copy=False)
        return self.drawn["transform"]

    @property
    def nbytes(self) -> int:
        """Memory that cells and transform take."""
        return 2 * self.cells.nbytes


def transform_of_cells(cells: NDArray[np.floating]) -> FloatArray:
    """Cosine transform (3 row, 3 column) of the cells, the averaging over pixels in it."""
    from scipy.fft import dctn

    found = dctn(cells, type=2, axes=(-2, -1))
    return np.asarray(found * averaging(cells.shape[0])[:, None] * averaging(cells.shape[1])[None, :])


@lru_cache(maxsize=32)
def averaging(length: int) -> FloatArray:
    """What the mean of three neighbouring cells leaves of each cosine (length,)."""
    return np.asarray((1.0 + 2.0 * np.cos(np.pi * np.arange(length) / length)) / FINE)


@lru_cache(maxsize=32)
def fine_frequencies(length: int) -> FloatArray:
    """Frequencies (3 length,) of the cosines of `length` pixels' cells, cycles per pixel."""
    return np.asarray(np.arange(FINE * length) / (2.0 * length))


def kept_cosines(along: FloatArray, least: float) -> int:
    """Number of cosines that a transfer function along an axis (`fine_frequencies`,) leaves above `least`, one a pixel at least."""
    last = int(np.flatnonzero(np.abs(along) > least)[-1])
    return min(along.size, max(last, along.size // FINE) + 1)


def cosines_at_pixels(
    length: int, points: int, count: int, shift_px: float, places_px: tuple[float, ...] = ()
) -> FloatArray:
    """Pixels (length,) from the first `count` amplitudes of a cosine transform over `points`: (length, count).

    The picture is moved on by `shift_px` (and stands at `places_px` from there in turn), and mirrors at its borders. What no pixel
    can tell apart (frequencies beyond half a cycle a pixel) adds up.
    """
    return _waves_at_pixels(length, points, count, shift_px, places_px)[0]


@lru_cache(maxsize=32)
def _waves_at_pixels(
    length: int, points: int, count: int, shift_px: float, places_px: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """The same of each cosine, and of the sine of its frequency: (length, count) each."""
    scale = np.where(np.arange(count) == 0, 0.5, 1.0) / points
    even, odd = _moved(length, count, shift_px, places_px)
    angle = np.pi * np.outer((np.arange(length) + 0.5) / length, np.arange(count))
    cosine, sine = np.cos(angle), np.sin(angle)
    return (cosine * even + sine * odd) * scale, (sine * even - cosine * odd) * scale


def _moved(length: int, count: int, shift_px: float, places_px: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """What a displacement makes of each cosine (count,): as much of the cosine, and of the sine; means over the places."""
    places = shift_px + (np.array(places_px) if places_px else np.zeros(1))
    phase = np.pi * np.outer(places, np.arange(count)) / length
    return np.cos(phase).mean(axis=0), np.sin(phase).mean(axis=0)


def sampled_terms(
    transform: FloatArray, length: int, axis: int, shift_px: float, places_px: tuple[float, ...] = ()
) -> tuple[FloatArray, ...]:
    """Amplitudes of the cosines, and of the sines where the picture moves, of a picture sampled at the pixels.

    A picture moved on by d is cos(w (x - d)) = cos(w x) cos(w d) + sin(w x) sin(w d) for each of its cosines. What no
    pixel can tell apart (frequencies beyond half a cycle a pixel) is added up.

    Args:
        transform: cosine transform whose `axis` has `length` amplitudes (pixels), or more, up to three times as many
            (the first of those over cells).
        length: pixels along the axis.
        shift_px: displacement.
        places_px: where the picture stands in turn, from there; empty: it stays.

    Returns:
        Amplitudes for `scipy.fft.idct`, and for `idst` after a shift, `length` along the axis.
    """
    found = np.moveaxis(transform, axis, 0)
    if shift_px == 0.0 and not places_px:
        return (np.moveaxis(_fold(found, length, -1.0), 0, axis),)
    of_cosine, of_sine = _moved(length, found.shape[0], shift_px, places_px)
    along = (slice(None), *([None] * (found.ndim - 1)))
    odd = _fold(found * of_sine[along], length, 1.0)
    sines = np.zeros_like(odd)
    sines[:-1] = odd[1:]
    if found.shape[0] > length:
        sines[-1] = 2.0 / FINE * found[length] * of_sine[length]
    return (
        np.moveaxis(_fold(found * of_cosine[along], length, -1.0), 0, axis),
        np.moveaxis(sines, 0, axis),
    )


def _fold(found: FloatArray, length: int, sign: float) -> FloatArray:
    """Amplitudes 0..length-1 with those above added: 2 length - k with `sign`, 2 length + k taken off."""
    count = found.shape[0]
    if count == length:
        return found
    result = found[:length] / FINE
    middle = found[length + 1 : 2 * length + 1] * (sign / FINE)  # k = length + 1 ... stands at 2 length - k
    result[length - middle.shape[0] :] += middle[::-1]
    if count > 2 * length:
        result[: count - 2 * length] -= found[2 * length :] / FINE
    return result


def sampled_picture(
    transforms: Sequence[tuple[NDArray[np.floating], NDArray[np.inexact] | None]],
    shape: tuple[int, int],
    shift_px: tuple[float, float],
    course_px: tuple[tuple[float, ...], tuple[float, ...]] = ((), ()),
) -> FloatArray:
    """Pixels (row, column) of the sum of pictures given by their cosine transforms, blurred and displaced.

    Args:
        transforms: (the first amplitudes of a transform over pixels or cells, transfer function of its shape or None) each; of a
            blur to one side it is complex (2, ...), with frequencies along columns as they are and reversed.
        shape: rows and columns of the pixels.
        shift_px: displacement along rows and columns.
        course_px: where the picture stands in turn along each, from there; empty: it stays.
    """
    to_one_side = any(filters is not None and np.iscomplexobj(filters) for _, filters in transforms)
    if to_one_side or max(shape) <= _MATRICES_TO_PX:
        return _sampled_by_matrices(transforms, shape, shift_px, course_px)
    from scipy.fft import idct, idst

    inverse = (idct, idst)
    rows: list[list[FloatArray]] = [[], []]
    for transform, filters in transforms:
        found = np.asarray(transform if filters is None else transform * filters)
        for kind, part in enumerate(sampled_terms(found, shape[0], 0, shift_px[0], course_px[0])):
            rows[kind].append(part)
    result = np.zeros(shape)
    for kind, parts in enumerate(rows):
        if not parts:
            continue
        sums: list[FloatArray | None] = [None, None]
        for part in parts:
            for other, term in enumerate(sampled_terms(part, shape[1], 1, shift_px[1], course_px[1])):
                before = sums[other]
                sums[other] = term if before is None else before + term
        lines = sum(inverse[other](term, type=2, axis=1) for other, term in enumerate(sums) if term is not None)
        result += inverse[kind](lines, type=2, axis=0)
    return result


def _sampled_by_matrices(
    transforms: Sequence[tuple[NDArray[np.floating], NDArray[np.inexact] | None]],
    shape: tuple[int, int],
    shift_px: tuple[float, float],
    course_px: tuple[tuple[float, ...], tuple[float, ...]],
) -> FloatArray:
    """`sampled_picture` as products of matrices, one a side.

    A blur with H = E - i O, E even and O odd in f, makes of cos(a) the wave E cos(a) + O sin(a). cos(a) cos(b) is half of
    cos(a + b) and half of cos(a - b), so it becomes, with sums and differences of H at (f_row, f_column) and (f_row, -f_column),
    1/2 [(E+ + E-) cos(a) cos(b) - (E+ - E-) sin(a) sin(b) + (O+ + O-) sin(a) cos(b) + (O+ - O-) cos(a) sin(b)].
    """
    result = np.zeros(shape)
    for transform, filters in transforms:
        (cosine_rows, sine_rows), (cosine_columns, sine_columns) = (
            _waves_at_pixels(length, length if count == length else FINE * length, count, shift, places)
            for length, count, shift, places in zip(shape, transform.shape, shift_px, course_px, strict=True)
        )
        if filters is None or not np.iscomplexobj(filters):
            result += cosine_rows @ (transform if filters is None else transform * filters.real) @ cosine_columns.T
            continue
        alike, unlike = transform * (0.5 * (filters[0] + filters[1])), transform * (0.5 * (filters[0] - filters[1]))
        result += (cosine_rows @ alike.real - sine_rows @ alike.imag) @ cosine_columns.T
        result -= (sine_rows @ unlike.real + cosine_rows @ unlike.imag) @ sine_columns.T
    return result

"""Signs that frames were processed or stored otherwise than declared, from numbers and patterns of one series.

Each function states the law that raw frames follow and returns what departs from it, or None.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames.code_steps import FALSE_ALARM, code_step
from ..calibration.frames.robust import robust_sd

_MOST_AVERAGED = 256
_CODES_AT_TOP = 10
_GRID = 8  # pixels a side of what JPEG and its kin transform
_NEIGHBOURS_SHARE = 1.1  # taking off the mean of 5 x 5 neighbours correlates pixels of a row a little
_PILE_UP = 10.0  # times as many values at the top as at the codes below it
# turned and mirrored pictures, as numpy makes them and as people say it
_TURNS: tuple[tuple[str, int, bool], ...] = (
    ("turned by 90 degrees", 1, False),
    ("turned by 180 degrees", 2, False),
    ("turned by 270 degrees", 3, False),
    ("mirrored left to right", 0, True),
    ("mirrored and turned by 90 degrees", 1, True),
    ("mirrored top to bottom", 2, True),
    ("mirrored and turned by 270 degrees", 3, True),
)


def averaged_by_codes(values: NDArray[Any]) -> int | None:
    """How many whole-numbered frames were averaged into fractions: the smallest n with n x values whole; None: not told.

    Args:
        values: floats of any shape, DN; float32 resolves n up to about 2^22 over the value.
    """
    if values.dtype.kind != "f":
        return None
    sample = np.asarray(values, dtype=np.float64).reshape(-1)
    largest = float(np.max(np.abs(sample), initial=0.0))
    if bool(np.all(sample == np.rint(sample))) or largest == 0.0:
        return None
    resolution = float(np.spacing(np.float32(largest)))
    for count in range(2, _MOST_AVERAGED + 1):
        room = 2.0 * count * resolution
        if room > 0.1:
            return None
        if bool(np.all(np.abs(sample * count - np.rint(sample * count)) <= room)):
            return count
    return None


def share_at_zero(values: NDArray[Any]) -> float | None:
    """Share of values that are 0 where noise was cut off there; None where it was not.

    A cut leaves everything below 0 at 0: no negative values, and more zeros than ones by more than their Poisson spread,
    while the values above 0 spread over several steps.
    """
    if values.size == 0 or float(values.min()) != 0.0:
        return None
    zeros = int(np.count_nonzero(values == 0))
    ones = int(np.count_nonzero((values > 0) & (values <= 1)))
    above = int(np.count_nonzero(values > 1))
    if above == 0 or zeros / values.size < 1e-3:
        return None
    return zeros / values.size if zeros - ones > 5.0 * math.sqrt(zeros + ones) else None


def pile_up_at_top(values: NDArray[Any]) -> tuple[float, float] | None:
    """(highest value, its share) where values pile up at the highest one as no noise does; None where they do not.

    Args:
        values: any shape, DN.
    """
    if values.size == 0:
        return None
    top = float(values.max())
    at_top = int(np.count_nonzero(values == top))
    step = code_step(values) or 1.0
    below = int(np.count_nonzero((values >= top - _CODES_AT_TOP * step) & (values < top))) / _CODES_AT_TOP
    if at_top < 1e-4 * values.size or at_top < _PILE_UP * max(below, 1.0):
        return None
    return top, at_top / values.size


def block_grid(differences: NDArray[np.float64]) -> bool:
    """Whether noise breaks off at a grid of 8 x 8 pixels along rows and columns, as lossy compression leaves it.

    Steps between neighbours have one variance wherever they lie; across the grid's lines they have more, or less, than
    elsewhere. A readout with eight channels shows this along one axis only.

    Args:
        differences: of successive frames (n, row, column), DN.
    """
    if min(differences.shape[1:]) <= 4 * _GRID:
        return False
    return all(_steps_at_grid(np.diff(differences, axis=axis), axis) for axis in (1, 2))


def _steps_at_grid(steps: NDArray[np.float64], axis: int) -> bool:
    squares = np.minimum(steps**2, 25.0 * max(float(np.median(steps**2)), 1e-12))
    other = (0, 3 - axis)
    along = squares.mean(axis=other)
    phases = np.array([float(np.mean(along[phase::_GRID])) for phase in range(_GRID)])
    # sampling error of a phase from the spread of its members, whatever correlates the noise
    errors = np.array(
        [float(np.std(along[phase::_GRID], ddof=1)) / math.sqrt(along[phase::_GRID].size) for phase in range(_GRID)]
    )
    odd = int(np.argmax(np.abs(phases - np.median(phases))))
    rest = np.delete(phases, odd)
    error = math.hypot(float(errors[odd]), float(np.median(errors)) / math.sqrt(_GRID - 1))
    spread = float(np.std(rest, ddof=1))
    # t of few members: eight standard errors; and not one phase among a spread of others
    return abs(phases[odd] - float(np.mean(rest))) > 8.0 * max(error, 1e-12) and bool(
        abs(phases[odd] - float(np.mean(rest))) > 4.0 * spread
    )


def pattern_of(mean_DN: NDArray[np.float64]) -> NDArray[np.float32]:
    """Fixed pattern of a mean frame (row, column): each pixel less the mean of its neighbours, of unit rms, tails cut.

    Beam shape and objects leave edges alone; dead and hot pixels count no more than five standard deviations.
    """
    from scipy.ndimage import uniform_filter

    smooth = uniform_filter(mean_DN, 5)
    pattern = mean_DN - smooth
    spread = robust_sd(pattern)
    if not spread > 0:
        return np.zeros(mean_DN.shape, dtype=np.float32)
    limited = np.clip(pattern / spread, -5.0, 5.0)
    limited -= limited.mean()
    return np.asarray(limited / max(float(np.sqrt(np.mean(limited**2))), 1e-12), dtype=np.float32)


def correlation(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Correlation of two patterns of unit rms."""
    return float(np.mean(first * second))


def _significant(size: int) -> float:
    """Correlation that patterns without anything in common exceed with `FALSE_ALARM`.

    Taking off the neighbours' mean correlates pixels: independent ones are taken as a quarter.
    """
    from scipy.special import ndtri

    return float(-ndtri(FALSE_ALARM)) * 2.0 / math.sqrt(max(size, 1))


def turned_pattern(pattern: NDArray[np.float32], reference: NDArray[np.float32]) -> str | None:
    """In words, how a pattern was turned or mirrored against the reference; None where it was not, or nobody can tell."""
    own = correlation(pattern, reference) if pattern.shape == reference.shape else 0.0
    least = _significant(reference.size)
    best, words = max(own, least), None
    for name, quarters, mirrored in _TURNS:
        turned = np.rot90(reference[:, ::-1] if mirrored else reference, quarters)
        if turned.shape != pattern.shape:
            continue
        found = correlation(pattern, turned)
        if found > best and found > own + least:
            best, words = found, name
    return words


def shifted_pattern(pattern: NDArray[np.float32], reference: NDArray[np.float32]) -> tuple[int, int] | None:
    """Rows and columns by which a pattern lies beside the reference; None where it lies on it, or nobody can tell."""
    if pattern.shape != reference.shape:
        return None
    product = np.fft.rfft2(pattern) * np.conj(np.fft.rfft2(reference))
    surface = np.fft.irfft2(product, pattern.shape) / pattern.size
    at = int(np.argmax(surface))
    row, column = at // pattern.shape[1], at % pattern.shape[1]
    # the largest of as many numbers as there are shifts
    least = _significant(pattern.size) * 1.7
    if (row, column) == (0, 0) or surface[row, column] < max(least, float(surface[0, 0]) + least):
        return None
    rows, columns = pattern.shape
    return row - rows * (row > rows // 2), column - columns * (column > columns // 2)


def swapped_rows(pattern: NDArray[np.float32], reference: NDArray[np.float32]) -> tuple[int, int] | None:
    """The first two rows that have changed places against the reference; None where all stand where they stood."""
    if pattern.shape != reference.shape or pattern.shape[1] < 16:
        return None
    columns = pattern.shape[1]

    def rows_of(values: NDArray[np.float32]) -> NDArray[np.float32]:
        centred = values - values.mean(axis=1, keepdims=True)
        return np.asarray(centred / np.maximum(np.sqrt((centred**2).mean(axis=1, keepdims=True)), 1e-12))

    table = rows_of(pattern) @ rows_of(reference).T / columns
    best = np.argmax(table, axis=1)
    height = table.max(axis=1)
    # two rows that point at each other by chance: rows^2 / 2 times the square of one such probability
    from scipy.special import ndtri

    least = float(-ndtri(math.sqrt(2.0 * FALSE_ALARM) / len(table))) * _NEIGHBOURS_SHARE / math.sqrt(columns)
    moved = np.flatnonzero((best != np.arange(len(best))) & (height > least) & (np.diag(table) < 0.5 * height))
    for row in moved:
        partner = int(best[row])
        if partner in moved and int(best[partner]) == int(row):
            return int(row), partner
    return None


def most_uneven(mean_signal_DN: NDArray[np.float64], differences: NDArray[np.float64], frames: int) -> float:
    """The most by which pixels of a flat can differ in their response: rms over the signal, of neighbours or over the field.

    Gain maps take away the pattern of pixels, and what is uneven over the field with it. Temporal noise that is left in the mean is
    not counted. inf: without light or differences.

    Args:
        mean_signal_DN: mean of `frames` frames less the dark (row, column).
        differences: of successive frames (n, row, column), DN: steps between neighbours have 4 (1 - r) times the variance.
        frames: averaged into the mean.
    """
    level = float(np.median(mean_signal_DN))
    if not level > 0 or not differences.size:
        return math.inf

    def variance(values: NDArray[np.float64]) -> float:
        return robust_sd(values) ** 2

    def steps(values: NDArray[np.float64]) -> float:
        return variance(np.diff(values, axis=-1)) / 2.0

    # error of a robust variance (efficiency 0.37); steps share pixels
    error = math.sqrt(2.0 / 0.37 * 2.0 / mean_signal_DN.size)
    most = max(
        max(of(mean_signal_DN) - of(differences) / 2.0 / frames, 0.0) + 5.0 * error * of(mean_signal_DN)
        for of in (steps, variance)
    )
    return math.sqrt(most) / level

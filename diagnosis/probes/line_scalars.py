"""What noise of lines adds to scalar probes: offsets of rows and columns, and lines that flicker with the light."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.line_state import between_lines
from ..session.summaries import BLOCK_PX
from .fixed_pattern import Pattern
from .scalar_context import ScalarContext


@dataclass(frozen=True, slots=True)
class _Part:
    """What rows and columns have in common for one reason."""

    row: float  # with column: variances, DN^2, of flicker relative
    column: float
    together_lines: float  # over which it fades
    # by which these are multiplied in all good pixels, and in each label: 1, or the mean square of the signal
    squares: tuple[float, ...]
    of_rows: float = 1.0  # the same of means along rows
    of_columns: float = 1.0  # and along columns

    def pixel(self, label: int | None) -> tuple[float, float]:
        """Variances of rows and of columns in single pixels, DN^2: of all good ones, or of a label's."""
        square = self.squares[0 if label is None else 1 + label]
        return self.row * square, self.column * square


@dataclass(frozen=True, slots=True)
class LineNoise:
    """Variances, DN^2, of what rows and columns of one frame have in common."""

    parts: tuple[_Part, ...]  # offsets, the same with and without light, and lines that flicker with it

    @staticmethod
    def of(expected: ExpectedSeries, context: ScalarContext) -> "LineNoise":
        """Of a series as the model expects it."""
        offsets, *flicker = _variances(expected)
        parts = [_Part(*offsets, squares=(1.0,) * (1 + len(context.areas.parts)))]
        if flicker:
            signal = np.asarray(expected.signal_DN, dtype=np.float64)
            whole, labels = context.areas.means(signal**2)
            lines = (float(np.mean(signal.mean(axis=axis) ** 2)) for axis in (1, 0))
            parts.append(_Part(*flicker[0], (whole, *map(float, labels)), *lines))
        return LineNoise(tuple(parts))

    def pixel(self, label: int | None = None) -> float:
        """Of single pixels: of all good ones, or of a label's."""
        return sum(sum(part.pixel(label)) for part in self.parts)

    def together(self, down: int, right: int, label: int | None = None) -> float:
        """Covariance of pixels so many rows and columns apart."""
        total = 0.0
        for part in self.parts:
            row, column = part.pixel(label)
            total += row * between_lines(down, part.together_lines) + column * between_lines(right, part.together_lines)
        return total

    def rows(self) -> float:
        """Of rows' offsets, each the mean of all its pixels."""
        return sum(part.row * part.of_rows for part in self.parts)

    def columns(self) -> float:
        """Of columns' offsets."""
        return sum(part.column * part.of_columns for part in self.parts)

    def frame(self, rows: int, columns: int) -> float:
        """Of means over a frame or a part of it, so many rows and columns large."""
        total = 0.0
        for part in self.parts:
            row, column = part.pixel(None)
            total += row * of_mean(rows, part.together_lines) + column * of_mean(columns, part.together_lines)
        return total


def _variances(expected: ExpectedSeries) -> list[tuple[float, float, float]]:
    """Variances of rows and of columns, and over how many lines they fade: of offsets, DN^2; of flicker, relative, if any."""
    found = [(expected.row_variance_DN2, expected.column_variance_DN2, expected.offsets_together_lines)]
    flicker = expected.flicker
    if flicker is not None:
        of_columns = flicker.column_share * flicker.rms**2
        found.append((flicker.rms**2 - of_columns, of_columns, flicker.together_lines))
    return found


@lru_cache(maxsize=64)
def of_mean(count: int, together_lines: float) -> float:
    """Variance of the mean of so many lines over that of one, what is common to each fading over `together_lines`."""
    lag = np.arange(1, count)
    fades = np.exp(-lag / together_lines)
    return float(1.0 + 2.0 * np.sum((1.0 - lag / count) * fades)) / count


def line_pattern(expected: ExpectedSeries, signal2_DN2: float) -> Pattern:
    """What rows and columns of one frame have in common, as a fixed pattern shows it; signal2_DN2: mean square signal.

    Neighbours along rows, pixels or blocks, lie in other columns of the same rows.
    """
    total = np.zeros(4)
    for (rows, columns, together), square in zip(_variances(expected), (1.0, signal2_DN2), strict=False):
        bent = bent_share(together)
        # half the mean square of differences of means over neighbouring blocks
        of_blocks = 2.0 * (of_mean(BLOCK_PX, together) - of_mean(2 * BLOCK_PX, together))
        of_pixels = 1.0 - between_lines(1, together)
        total += square * np.array([of_pixels * columns, of_blocks * columns, bent * rows, bent * columns])
    return total


def bent_share(together_lines: float) -> float:
    """A sixth of the variance of second differences of lines over their variance, what is common to each fading so."""
    one, two = between_lines(1, together_lines), between_lines(2, together_lines)
    return (6.0 - 8.0 * one + 2.0 * two) / 6.0

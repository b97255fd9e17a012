"""What noise of lines adds to scalar probes: offsets of rows and columns, and lines that flicker with the light."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.line_state import EACH_LINE, LineFlicker, between_lines
from ..session.summaries import BLOCK_PX
from .fixed_pattern import Pattern, sum_of_patterns
from .scalar_context import ScalarContext


@dataclass(frozen=True, slots=True, kw_only=True)
class LineNoise:
    """Variances, DN^2, of what rows and columns of one frame have in common.

    Fields: row, column: of offsets, the same with and without light; together_lines: over which these fade; flicker: of lines with
    the light, None: none; squares: mean square of the signal over all good pixels and over those of each label; of_rows, of_columns:
    mean square of the signal's means along rows and columns.
    """

    row: float
    column: float
    together_lines: float = EACH_LINE
    flicker: LineFlicker | None = None
    squares: tuple[float, ...] = (0.0,)
    of_rows: float = 0.0
    of_columns: float = 0.0

    @staticmethod
    def of(expected: ExpectedSeries, context: ScalarContext) -> "LineNoise":
        """Of a series as the model expects it."""
        flicker = expected.flicker
        alone = LineNoise(
            row=expected.row_variance_DN2,
            column=expected.column_variance_DN2,
            together_lines=expected.offsets_together_lines,
        )
        if flicker is None:
            return alone
        signal = np.asarray(expected.signal_DN, dtype=np.float64)
        whole, labels = context.areas.means(signal**2)
        of_rows, of_columns = (float(np.mean(signal.mean(axis=axis) ** 2)) for axis in (1, 0))
        return replace(
            alone,
            flicker=flicker,
            squares=(whole, *map(float, labels)),
            of_rows=of_rows,
            of_columns=of_columns,
        )

    def pixel(self, label: int | None = None) -> float:
        """Of single pixels: of all good ones, or of a label's."""
        return self.row + self.column + float(self._shares(self._square(label)).sum())

    def together(self, down: int, right: int, label: int | None = None) -> float:
        """Covariance of pixels so many rows and columns apart."""
        found = self.row * between_lines(down, self.together_lines)
        found += self.column * between_lines(right, self.together_lines)
        if self.flicker is None:
            return found
        fades = np.array([self.flicker.correlation(down), self.flicker.correlation(right)])
        return found + float(self._shares(self._square(label)) @ fades)

    def rows(self) -> float:
        """Of rows' offsets, each the mean of all its pixels."""
        return self.row + float(self._shares(self.of_rows)[0])

    def columns(self) -> float:
        """Of columns' offsets."""
        return self.column + float(self._shares(self.of_columns)[1])

    def block(self, side: int) -> float:
        """Of means over side x side pixels."""
        found = (self.row + self.column) * of_mean(side, self.together_lines)
        return found + float(self._shares(self._square(None)).sum()) * self._of_mean(side)

    def frame(self, rows: int, columns: int) -> float:
        """Of means over a frame."""
        found = self.row * of_mean(rows, self.together_lines) + self.column * of_mean(columns, self.together_lines)
        if self.flicker is None:
            return found
        by_row, by_column = self._shares(self._square(None))
        return found + float(by_row) * self._of_mean(rows) + float(by_column) * self._of_mean(columns)

    def _square(self, label: int | None) -> float:
        return self.squares[0 if label is None or self.flicker is None else 1 + label]

    def _shares(self, square: float) -> NDArray[np.float64]:
        """Variance of rows' and of columns' factors at a mean square of the signal."""
        if self.flicker is None:
            return np.zeros(2)
        share = self.flicker.column_share
        return np.asarray(self.flicker.rms**2 * square * np.array([1.0 - share, share]))

    def _of_mean(self, count: int) -> float:
        """Variance of the mean of so many lines' factors over that of one."""
        return 1.0 / count if self.flicker is None else of_mean(count, self.flicker.together_lines)


@lru_cache(maxsize=64)
def of_mean(count: int, together_lines: float) -> float:
    """Variance of the mean of so many lines over that of one, what is common to each fading over `together_lines`."""
    lag = np.arange(1, count)
    fades = np.exp(-lag / together_lines)
    return float(1.0 + 2.0 * np.sum((1.0 - lag / count) * fades)) / count


def line_pattern(expected: ExpectedSeries, signal2_DN2: float) -> Pattern:
    """What rows and columns of one frame have in common, as a fixed pattern's statistics show it; signal2_DN2: mean square signal."""
    found = [_of_lines(expected.row_variance_DN2, expected.column_variance_DN2, expected.offsets_together_lines)]
    flicker = expected.flicker
    if flicker is not None:
        of_light = flicker.rms**2 * signal2_DN2
        share = flicker.column_share
        found.append(_of_lines((1.0 - share) * of_light, share * of_light, flicker.together_lines))
    return sum_of_patterns(found)


def _of_lines(rows_DN2: float, columns_DN2: float, together_lines: float) -> Pattern:
    """Of variances of rows and of columns; neighbours along rows, pixels or blocks, lie in other columns of the same rows."""
    bent = bent_share(together_lines)
    # half the mean square of differences of means over neighbouring blocks
    of_blocks = 2.0 * (of_mean(BLOCK_PX, together_lines) - of_mean(2 * BLOCK_PX, together_lines))
    return Pattern(
        pixel_DN2=(1.0 - between_lines(1, together_lines)) * columns_DN2,
        blocks_DN2=of_blocks * columns_DN2,
        rows_DN2=bent * rows_DN2,
        columns_DN2=bent * columns_DN2,
    )


def bent_share(together_lines: float) -> float:
    """A sixth of the variance of second differences of lines over their variance, what is common to each fading so."""
    one, two = between_lines(1, together_lines), between_lines(2, together_lines)
    return (6.0 - 8.0 * one + 2.0 * two) / 6.0

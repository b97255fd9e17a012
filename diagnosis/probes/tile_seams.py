"""Where later flats have seams: borders of lines, evenly apart, at which the panel's brightness steps along their whole length.

At a border of columns the levels that columns to its right and to its left lead to are compared, in stretches of rows. A pattern
that goes on across borders steps alike at all of them; tiles with gains of their own step at their seams.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...generator.line.line_state import Seams
from ..arrays import BoolArray, FloatArray, RealArray
from ..session.summaries import BLOCK_PX

_BESIDE_PX = 4  # lines whose mean is taken, two means to either side of a border
_MEDIAN, _QUARTILE = 0.4549, 1.3233  # of chi square of one degree of freedom, the quartile being the upper one
# of a variance from squares' upper quartile, which a blemish leaves alone, against one from their mean
_EFFICIENCY = 0.60
_LEAST_SIDE_PX = 2 * BLOCK_PX  # of a tile: narrower ones are a pattern of pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenSeams:
    """Seams along rows and along columns, px, and the log probability that an even choice of all that were tried gives them."""

    rows: Seams
    columns: Seams
    log_prior: float

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return self.rows.side_px > 0.0 or self.columns.side_px > 0.0


def seams_in(changes: Sequence[RealArray], weights: Sequence[float], clean: BoolArray) -> SeenSeams | None:
    """The seams that relative changes of flats (row, column), measured over expected less 1, show together; None: no flat."""
    if not changes:
        return None
    change = np.average(np.stack([np.asarray(one, dtype=np.float64) for one in changes]), axis=0, weights=weights)
    columns, tried_columns = _along(change, clean)
    rows, tried_rows = _along(change.T, clean.T)
    tried = (tried_rows if rows.side_px else 1) * (tried_columns if columns.side_px else 1)
    return SeenSeams(rows=rows, columns=columns, log_prior=-math.log(tried))


def _along(change: FloatArray, clean: BoolArray) -> tuple[Seams, int]:
    """Seams between columns whose steps are the likeliest, none where all may be chance; how many choices there were."""
    squares, stretches = _steps(change, clean)
    border = np.arange(2 * _BESIDE_PX, 2 * _BESIDE_PX + len(squares))
    above = np.maximum(squares, 1.0)
    # each border's own size of steps against none, even in its logarithm up to the largest that is seen
    width = math.sqrt(4.0 * math.pi / stretches)
    tells = 0.5 * stretches * (above - 1.0 - np.log(above)) - math.log1p(math.log(float(above.max())) / width)
    best, most, tried = Seams(), 0.0, 0
    for side in range(_LEAST_SIDE_PX, len(squares)):
        # every place of the first seam at once
        of_grids = np.bincount(border % side, weights=tells, minlength=side)
        tried += side
        first = int(np.argmax(of_grids))
        if of_grids[first] > most:
            best, most = Seams(side_px=float(side), first_px=float(first)), float(of_grids[first])
    return (best, tried) if most > math.log(max(tried, 1)) else (Seams(), tried)


def _steps(change: FloatArray, clean: BoolArray) -> tuple[FloatArray, float]:
    """Square of the step at each border (border,) over the usual one, 1 where few pixels are clean, and of how many it is worth."""
    rows = len(change) // BLOCK_PX
    stacked = (rows, BLOCK_PX, change.shape[1])
    known = clean[: rows * BLOCK_PX].reshape(stacked).sum(axis=1)
    sums = np.where(clean, change, 0.0)[: rows * BLOCK_PX].reshape(stacked).sum(axis=1)
    counted, summed = (np.cumsum(np.pad(one, ((0, 0), (1, 0))), axis=1, dtype=np.float64) for one in (known, sums))
    width = _BESIDE_PX
    pixels, totals = (one[:, width:] - one[:, :-width] for one in (counted, summed))
    means = np.divide(totals, pixels, out=np.full_like(totals, np.nan), where=2 * pixels >= width * BLOCK_PX)
    # as lines through two means to either side have it: a slope is no step
    of_left, left, right, of_right = (means[:, part * width : means.shape[1] - (3 - part) * width] for part in range(4))
    step = 1.5 * (right - left) - 0.5 * (of_right - of_left)
    squares, seen = step**2, np.isfinite(step)
    enough = 2 * seen.sum(axis=0) >= rows
    usual = float(np.median(squares[seen])) / _MEDIAN if enough.any() else 0.0
    if usual == 0.0:
        return np.ones(step.shape[1]), 1.0
    at_border = np.ones(step.shape[1])
    at_border[enough] = np.nanquantile(squares[:, enough], 0.75, axis=0) / _QUARTILE / usual
    # stretches of columns that have something of their own step alike
    of_means = float(np.median(np.nanmean(step[:, enough], axis=0) ** 2)) / _MEDIAN
    alone = min(max(usual / max(of_means, 1e-30), 1.0), rows)
    return at_border, max(_EFFICIENCY * alone, 1.0)

"""Offsets of rows and columns that a panel has all the time: they belong to the base as far as they are small."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..arrays import BoolArray
from ..model.changes import LINE_NOISE_LIMIT
from ..session.summaries import LEAST_NOISE_DN2, SeriesSummary
from ..session.usable import SeenSeries


def usual_line_noise(
    seen: Sequence[SeenSeries], summaries: Mapping[str, SeriesSummary], clean: BoolArray
) -> tuple[float, float]:
    """Variance (DN^2) of the rows' and of the columns' offsets in one exposure, from darks, at most what no effect is.

    Of a mean over C pixels of a row, var = r^2 + (v - r^2) / C, v the variance of a pixel; columns alike. The darks that calibrate
    tell, all darks where none does. What the twin knows of it already is not counted again.
    """
    darks = [one for one in seen if one.session.series.kind == "dark" and summaries[one.name].frames > 2]
    darks = [one for one in darks if one.session.calibrates] or darks
    total = np.zeros(2)
    steps = 0
    # in a row, and in a column
    pixels = np.array(clean.shape[::-1], dtype=np.float64)
    for one in darks:
        found, model = summaries[one.name], one.expected
        variance = float(np.mean(found.pair_variance_DN2[clean]))
        if not variance > LEAST_NOISE_DN2:
            continue
        of_lines = np.array([found.row_variance_DN2, found.column_variance_DN2])
        own = (of_lines - variance / pixels) / (1.0 - 1.0 / pixels)
        known = np.array([model.row_variance_DN2, model.column_variance_DN2])
        exposures = one.session.request.exposures_per_frame
        limit = LINE_NOISE_LIMIT**2 * variance
        weight = found.frames - 1
        total += weight * np.clip(own - known, 0.0, limit) * exposures
        steps += weight
    rows, columns = total / max(steps, 1)
    return float(rows), float(columns)

"""Borders of edges and discs as they run between the points of a map, and how truly a straight one is drawn.

The border of a straight edge is a line through its thickness map. Pixels are sorted by their distance from it, in bins finer than a
pixel: any blur is alike all along the edge, and moves whole bins. What pixels of one bin differ by is neither blur nor anything
else that an effect does there; it is noise, roughness of the edge, and how a map draws the pixels that the border cuts. The border of
a disc is the circle of its area about its centroid.

Source: ISO 12233:2017 (slanted edge, four bins a pixel); IEC 62220-1-1:2015.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...generator.spread._fine_picture import area_beyond
from ..arrays import BoolArray, FloatArray, RealArray

_BINS_A_PX = 4
_NEAR_PX = 3.0  # from the border
_STRAIGHT_PX = 0.4  # rms of the border about a line; a border that runs between sampled points departs by 0.29
_LEAST_LINES = 16  # that cross the border: its place is then known to 0.29 / 4 px
_LEAST_CUT = 0.02  # of a pixel, from which a border cuts it
_MOST_CUT = 3.0  # pixels of a line: a step, even a worn one, and no slope
_LEAST_RADIUS_PX = 4.0  # of a disc, whose border is then straight to 1 / 32 px within a pixel
_ROUND_PX = 0.6  # from the border, beyond which no pixel of a disc's map is on the wrong side


@dataclass(frozen=True, slots=True)
class _Border:
    """A straight border that crosses lines of pixels."""

    away_px: FloatArray  # (row, column): distance of each pixel from it, to either side
    slope: float  # pixels that it goes on from line to line
    behind: float  # sign of the distances where the object is
    lines: int  # how many it crosses


def distance_px(thickness_mm: Mapping[str, RealArray]) -> FloatArray | None:
    """Distance of each pixel (row, column) from the border of a straight edge, px, to either side; None: there is no such edge.

    thickness_mm: maps (row, column), by material.
    """
    border = _border(thickness_mm)
    return None if border is None else border.away_px


def covered_scene(kind: str | None, thickness_mm: Mapping[str, RealArray]) -> dict[str, RealArray] | None:
    """Maps (row, column) of the same scene with pixels as thick as the share of them that it covers.

    None where the scene is of another kind than `edge` or `disc`, or its border neither straight nor round.
    """
    covered = {"edge": _behind_line, "disc": _within_circle}.get(kind or "", lambda _: None)(thickness_mm)
    if covered is None:
        return None
    ((name, image),) = thickness_mm.items()
    return {name: (covered * float(np.max(image))).astype(np.float32)}


def _behind_line(thickness_mm: Mapping[str, RealArray]) -> FloatArray | None:
    """Covered share of each pixel (row, column) of a straight edge."""
    border = _border(thickness_mm)
    if border is None:
        return None
    length, sides = math.hypot(1.0, border.slope), sorted((1.0, max(abs(border.slope), 1e-4)))
    short, long = (np.full(border.away_px.shape, side / length) for side in sides)
    return area_beyond(-border.behind * border.away_px, long, short)


def _within_circle(thickness_mm: Mapping[str, RealArray]) -> FloatArray | None:
    """Covered share of each pixel (row, column) of a round disc that lies whole in the field."""
    share = _of_the_thickest(thickness_mm)
    if share is None:
        return None
    area = float(share.sum())
    radius = math.sqrt(area / math.pi)
    row, column = np.ogrid[: share.shape[0], : share.shape[1]]
    down, right = row - float(np.sum(share * row)) / area, column - float(np.sum(share * column)) / area
    away = np.hypot(down, right) - radius
    wrong = (share > 0.5) != (away < 0.0)
    if radius < _LEAST_RADIUS_PX or np.any(np.abs(away[wrong]) > _ROUND_PX):
        return None
    sides = np.abs(np.stack(np.broadcast_arrays(down, right))) / np.maximum(away + radius, 1e-9)
    return area_beyond(away, np.maximum(sides.max(axis=0), 1e-4), np.maximum(sides.min(axis=0), 1e-4))


def _of_the_thickest(thickness_mm: Mapping[str, RealArray]) -> FloatArray | None:
    """The map of a scene of one material (row, column), over its largest value; None of any other scene."""
    if len(thickness_mm) != 1:
        return None
    (image,) = (np.asarray(one, dtype=np.float64) for one in thickness_mm.values())
    most = float(image.max(initial=0.0))
    return image / most if most > 0.0 else None


def _border(thickness_mm: Mapping[str, RealArray]) -> _Border | None:
    share = _of_the_thickest(thickness_mm)
    if share is None:
        return None
    across_rows, across_columns = _across_rows(share), _across_rows(share.T)
    if across_columns is None or (across_rows is not None and across_rows.lines >= across_columns.lines):
        return across_rows
    return replace(across_columns, away_px=across_columns.away_px.T)


def _across_rows(covered: FloatArray) -> _Border | None:
    """The border of an edge (row, column), covered share, that rows cross; None: they cross none, or no straight one."""
    rows, columns = covered.shape
    behind = covered.sum(axis=1)
    crossed = (behind > 1.0) & (behind < columns - 1.0)
    cut = np.count_nonzero((covered > _LEAST_CUT) & (covered < 1.0 - _LEAST_CUT), axis=1)
    if np.count_nonzero(crossed) < _LEAST_LINES or float(np.mean(cut[crossed])) > _MOST_CUT:
        return None
    left = bool(covered[crossed, 0].mean() > covered[crossed, -1].mean())
    place = behind if left else columns - behind
    number = np.arange(rows)
    slope, first = np.polyfit(number[crossed], place[crossed], 1)
    line = first + slope * number
    if float(np.std((place - line)[crossed])) > _STRAIGHT_PX:
        return None
    away = (np.arange(columns) + 0.5 - line[:, None]) / math.hypot(1.0, slope)
    return _Border(away, float(slope), -1.0 if left else 1.0, int(np.count_nonzero(crossed)))


def scatter_share(residual_DN: RealArray, range_DN: RealArray, mask: BoolArray, away_px: FloatArray) -> float:
    """What pixels at one distance from a straight edge differ by, noise as well: rms over the local range of the picture, no unit.

    residual_DN, range_DN, mask, away_px (row, column): of the mean frame, of the expected picture, compared pixels, `distance_px`.
    """
    near = mask & (np.abs(away_px) < _NEAR_PX)
    values, ranges = np.asarray(residual_DN[near], np.float64), np.asarray(range_DN[near], np.float64)
    _, number = np.unique(np.floor(_BINS_A_PX * away_px[near]), return_inverse=True)
    counts = np.bincount(number)
    if values.size <= 3 * len(counts):
        return math.inf

    def about_means(of: FloatArray) -> FloatArray:
        return np.asarray(of - (np.bincount(number, weights=of) / counts)[number])

    # within a bin a profile is a straight line
    left, along = about_means(values), about_means(away_px[near])
    slopes = np.bincount(number, weights=left * along) / np.maximum(np.bincount(number, weights=along**2), 1e-12)
    left -= slopes[number] * along
    freedom = 1.0 - 2.0 * len(counts) / values.size
    return math.sqrt(float(left @ left) / freedom / max(float(ranges @ ranges), 1e-30))

"""Foreign objects of a mask as boxes, run lengths and outlines, in the conventions of COCO."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskShape:
    """One connected part of a mask (corners touch: one part).

    Fields: box_px (left, top, width, height); area_px; outline_px (corner, 2): x and y of the corners of its outer boundary along
    the edges of pixels, in the order in which they are met, holes left out; counts (run lengths down the columns, those outside
    first, as in COCO's uncompressed RLE).
    """

    box_px: tuple[int, int, int, int]
    area_px: int
    outline_px: NDArray[np.int64] = field(repr=False)
    counts: tuple[int, ...] = field(repr=False)


def iter_mask_shapes(mask: NDArray[np.bool_]) -> Iterator[MaskShape]:
    """Yield the connected parts of a mask (row, column).

    Example:
        >>> mask = np.zeros((4, 5), dtype=bool)
        >>> mask[1:3, 2:5] = True
        >>> (shape,) = iter_mask_shapes(mask)
        >>> shape.box_px, shape.area_px, shape.counts
        ((2, 1, 3, 2), 6, (9, 2, 2, 2, 2, 2, 1))
        >>> shape.outline_px.tolist()
        [[2, 1], [5, 1], [5, 3], [2, 3]]

    Source: Lin et al., Microsoft COCO, arXiv:1405.0312; the run lengths are those of its mask API.
    """
    from scipy import ndimage

    labels, _ = ndimage.label(mask, structure=np.ones((3, 3), dtype=int))
    for number, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
        part = labels == number
        yield MaskShape(
            box_px=(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start),
            area_px=int(part.sum()),
            outline_px=_outline(part[rows, columns]) + np.array([columns.start, rows.start]),
            counts=_run_lengths(part),
        )


def _run_lengths(part: NDArray[np.bool_]) -> tuple[int, ...]:
    values = np.asarray(part, dtype=np.int8).ravel(order="F")
    changes = np.flatnonzero(np.diff(values)) + 1
    lengths = np.diff(np.concatenate([[0], changes, [values.size]])).tolist()
    return (0, *lengths) if values[0] else tuple(lengths)


def _outline(part: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The outer boundary, clockwise as the image is seen; where two pixels touch at a corner it runs through both."""
    padded = np.pad(part, 1)
    ends: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(part).tolist():
        above, below = padded[row, column + 1], padded[row + 2, column + 1]
        left, right = padded[row + 1, column], padded[row + 1, column + 2]
        corners = [(column, row), (column + 1, row), (column + 1, row + 1), (column, row + 1)]
        for side, inside in enumerate((above, right, below, left)):
            if not inside:
                ends.setdefault(corners[side], []).append(corners[(side + 1) % 4])
    first = (int(np.flatnonzero(part[0])[0]), 0)
    place, heading = (first[0] + 1, 0), (1, 0)
    corners_met = [first]
    while place != first:
        turned_left = (place[0] + heading[1], place[1] - heading[0])
        following = ends[place]
        then = turned_left if turned_left in following else following[0]
        new_heading = (then[0] - place[0], then[1] - place[1])
        if new_heading != heading:
            corners_met.append(place)
        place, heading = then, new_heading
    return np.array(corners_met, dtype=np.int64)

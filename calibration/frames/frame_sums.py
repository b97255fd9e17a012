"""Sums over the frames of one series: all that photon transfer needs, from one pass in constant memory."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .frame_checks import repeats_the_last

PIECE_BYTES = 8 * 2**20  # of frames that are read at once


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSums:
    """Per-pixel sums over frames x_1 .. x_n, relative to `reference` (the first frame), and the frames' own means.

    Fields: frames (n); pairs (successive differences summed, those to a copy left out where there are others); reference,
    deviation_sum, square_sum, pair_square_sum
    (row, column), DN and DN^2; frame_mean_DN (n,), in time order; maximum_DN (highest value seen) and maximum_count
    (how many values equal it); integer (all values were whole numbers).
    """

    frames: int
    pairs: int
    reference: NDArray[np.float64]
    deviation_sum: NDArray[np.float64]
    square_sum: NDArray[np.float64]
    pair_square_sum: NDArray[np.float64]
    frame_mean_DN: NDArray[np.float64]
    maximum_DN: float
    maximum_count: int
    integer: bool

    @property
    def mean_DN(self) -> NDArray[np.float64]:
        """Mean frame (row, column), DN."""
        return np.asarray(self.reference + self.deviation_sum / self.frames)

    @property
    def stack_variance_DN2(self) -> NDArray[np.float64]:
        """Variance over the stack, ddof = 1 (row, column), DN^2; NaN for a single frame."""
        if self.frames < 2:
            return np.full(self.reference.shape, np.nan)
        spread = self.deviation_sum * self.deviation_sum
        spread *= -1.0 / self.frames
        spread += self.square_sum
        np.maximum(spread, 0.0, out=spread)
        spread /= self.frames - 1
        return spread

    @property
    def pair_variance_DN2(self) -> NDArray[np.float64]:
        """Variance from successive differences, sum (x_(i+1) - x_i)^2 / (2 pairs) (row, column), DN^2.

        Slow drift leaves it alone; lag lowers it more than the stack variance. NaN for a single frame.
        """
        if self.pairs < 1:
            return np.full(self.reference.shape, np.nan)
        return np.asarray(self.pair_square_sum / (2.0 * self.pairs))


def effective_frames(frames: int) -> float:
    """Frames of a stack whose variance is known as well as that from successive differences of `frames` frames.

    Var of the successive-difference estimator for white Gaussian frames is (3 n - 4) / (n - 1)^2 sigma^4 (von Neumann,
    Ann. Math. Stat. 12, 1941); a mean of N squares has 2 / N.
    """
    return 2.0 * (frames - 1) ** 2 / (3.0 * frames - 4.0) if frames > 1 else 0.0


def sum_frames(pieces: Iterable[NDArray[Any]], *, name: str = "frames") -> FrameSums:
    """Sums over frames that arrive in pieces (m, row, column) in time order; each piece is read once, DN.

    Args:
        pieces: arrays (m, row, column), uint16 or float, DN; at least one frame in all.
        name: what to call the series in errors.

    Raises:
        InputError: no frame at all, frames of different shapes, NaN or infinite values.
    """
    from ._kernels import COUNT_BLOCK, accumulate, accumulate_counts, count_equal

    frames = pairs = copies = maximum_count = 0
    maximum_DN = -np.inf
    integer = True
    sums: list[NDArray[np.float64]] = []
    frame_means: list[NDArray[np.float64]] = []
    shape: tuple[int, ...] = ()
    for piece in pieces:
        if piece.ndim != 3 or (sums and piece.shape[1:] != shape):
            raise InputError(name, received=f"shape {piece.shape}", expected="frames (n, row, column) of one shape")
        if piece.shape[0] == 0:
            continue
        flat = np.ascontiguousarray(piece).reshape(piece.shape[0], -1)
        if flat.dtype.kind == "f":
            if not np.all(np.isfinite(flat)):
                raise InputError(
                    name,
                    received="NaN or infinite detector numbers",
                    expected="finite values in every frame",
                    remedy="mark such pixels as defects or leave the frames out",
                )
            integer = integer and bool(np.all(flat == np.rint(flat)))
        if not sums:
            shape = piece.shape[1:]
            sums = (
                [flat[0].astype(np.float64)] + [np.zeros(flat.shape[1]) for _ in range(3)] + [np.zeros(flat.shape[1])]
            )
        reference, deviation, square, pair, last = sums
        count, pixels = flat.shape
        copies += int(np.count_nonzero(repeats_the_last(flat, last if frames else None)))
        if flat.dtype in (np.uint8, np.uint16):
            blocks = -(-pixels // COUNT_BLOCK)
            totals = np.empty((blocks, count), np.int64)
            tops, times = np.empty(blocks, np.int64), np.empty(blocks, np.int64)
            accumulate_counts(flat, last, frames > 0, reference, deviation, square, pair, totals, tops)
            frame_means.append(totals.sum(axis=0) / pixels)
            highest, equal = float(tops.max()), 0
            if highest >= maximum_DN:
                count_equal(flat, tops, tops.max(), times)
                equal = int(times.sum())
        else:
            accumulate(flat, last, frames > 0, reference, deviation, square, pair)
            frame_means.append(flat.mean(axis=1, dtype=np.float64))
            highest = float(flat.max())
            equal = int(np.count_nonzero(flat == highest)) if highest >= maximum_DN else 0
        pairs += count - (1 if frames == 0 else 0)
        frames += count
        if highest > maximum_DN:
            maximum_DN, maximum_count = highest, 0
        if highest == maximum_DN:
            maximum_count += equal
    if not sums:
        raise InputError(name, received="no frames", expected="at least one frame")
    reference, deviation, square, pair, _ = (array.reshape(shape) for array in sums)
    return FrameSums(
        frames=frames,
        pairs=pairs - copies if copies < pairs else pairs,
        reference=reference,
        deviation_sum=deviation,
        square_sum=square,
        pair_square_sum=pair,
        frame_mean_DN=np.concatenate(frame_means),
        maximum_DN=maximum_DN,
        maximum_count=maximum_count,
        integer=integer,
    )

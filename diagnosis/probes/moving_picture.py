"""What a picture that fades from frame to frame, as a ghost does, adds to the noise that frames seem to have."""

from dataclasses import dataclass

import numpy as np

from ...generator.frames.line_model import ExpectedSeries
from ..arrays import FloatArray, IndexArray, RealArray
from ..session.summaries import LEAST_NOISE_DN2, PIECE_FRAMES
from .scalar_context import ScalarContext

_KURTOSIS_PIXELS = 2048  # in which a fading picture's is computed


@dataclass(frozen=True, slots=True)
class MovingPicture:
    """What a picture that fades from frame to frame adds to variances, once the frames' common factor is taken out."""

    # (trend, trend): mean product of the pictures' pixels, of all good ones and of each label's
    products: tuple[FloatArray, ...]
    lines: tuple[FloatArray, ...]  # the same of the means of rows and of columns
    steps: FloatArray  # (trend, trend): half of the mean product of changes from one frame to the next
    courses: FloatArray  # (trend, frame)
    order: IndexArray  # (pixel,): flat indices of some good pixels all over the field
    there: FloatArray  # (trend, pixel): the pictures in these

    @staticmethod
    def of(expected: ExpectedSeries, context: ScalarContext) -> "MovingPicture":
        good, areas = context.good, context.areas
        changing = [
            (image, np.asarray(course, dtype=np.float64))
            for image, course in expected.trend_DN or ()
            if np.size(course) > 1 and float(np.ptp(course)) > 0.0
        ]
        if not changing:
            return _STILL
        pixels = np.empty((len(changing), areas.order.size))
        for row, (image, _) in zip(pixels, changing, strict=True):
            row[:] = areas.pixels(image)
        shape = np.ones(areas.order.size)
        if context.kind in ("flat", "object"):
            shape *= areas.pixels(expected.signal_DN)
            shape /= max(float(shape.mean()), 1e-12)
        pixels -= np.outer(pixels.mean(axis=1), shape)
        largest = np.maximum(pixels.max(axis=1), -pixels.min(axis=1))
        # a hundredth of a DN adds nothing to any variance
        kept = [at for at, (_, course) in enumerate(changing) if largest[at] * float(np.ptp(course)) > 0.01]
        if not kept:
            return _STILL
        pixels = pixels[kept]
        profiles = np.stack([changing[at][1] - changing[at][1].mean() for at in kept])
        rows, columns = np.divmod(areas.order, good.shape[1])
        lines = []
        for axis, number in ((1, rows), (0, columns)):
            counts = good.sum(axis=axis)
            sums = [np.bincount(number, weights=one, minlength=len(counts)) for one in pixels]
            lines.append(_mean_product(np.array(sums) / np.maximum(counts, 1)))
        steps = np.diff(profiles, axis=1)
        stride = max(areas.order.size // _KURTOSIS_PIXELS, 1)
        return MovingPicture(
            (_mean_product(pixels), *(_mean_product(pixels[:, part]) for part in areas.parts)),
            tuple(lines),
            0.5 * steps @ steps.T / steps.shape[1],
            profiles,
            areas.order[::stride],
            pixels[:, ::stride],
        )

    def pixels(self, label: int | None = None) -> float:
        """Variance of single pixels, DN^2: of all good ones, or of a label's."""
        if not self.products:
            return 0.0
        return float(np.sum(self.steps * self.products[0 if label is None else 1 + label]))

    def kurtosis(self, expected: ExpectedSeries) -> float:
        """Excess kurtosis of pixels' steps from frame to frame: most of a picture that fades goes with the first of them.

        Of a Gaussian step of variance v moved by m: (<m^4> - 3 <m^2>^2) / (v + <m^2>)^2, means over the frames that
        `summarise_series` scales a pixel by.
        """
        if not self.products:
            return 0.0

        def pixels(variance: RealArray) -> FloatArray:
            found = np.asarray(variance, dtype=np.float64)
            return found.ravel() if found.size == 1 else found.ravel()[self.order]

        single = pixels(expected.quantum_variance_DN2) * lag_loss(expected) + pixels(expected.white_variance_DN2)
        noise = 2.0 * (single + expected.row_variance_DN2 + expected.column_variance_DN2)
        steps = np.diff(self.courses, axis=1)
        total = 0.0
        for start in range(0, steps.shape[1], PIECE_FRAMES):
            squares = (self.there.T @ steps[:, start : start + PIECE_FRAMES]) ** 2
            second, fourth = squares.mean(axis=1), (squares**2).mean(axis=1)
            whole = np.maximum(noise + second, LEAST_NOISE_DN2)
            ratio = 3.0 + (fourth - 3.0 * second**2) / whole**2
            # what moves is no chance: a pixel's own variance is known better than that of noise alone
            share = 3.0 / min(steps.shape[1], PIECE_FRAMES)
            ratio *= (1.0 + share) / (1.0 + share * (1.0 - (second / whole) ** 2))
            total += float(ratio.mean() - 3.0) * squares.shape[1]
        return float(total / steps.shape[1])

    def rows(self) -> float:
        """Variance of rows' means, DN^2."""
        return float(np.sum(self.steps * self.lines[0])) if self.lines else 0.0

    def columns(self) -> float:
        """Variance of columns' means, DN^2."""
        return float(np.sum(self.steps * self.lines[1])) if self.lines else 0.0

    def lasting(self, step: int) -> float:
        """Mean product of a pixel's deviations `step` frames apart, DN^2."""
        if not self.products:
            return 0.0
        early, late = self.courses[:, :-step], self.courses[:, step:]
        return float(np.sum(early @ late.T / early.shape[1] * self.products[0]))


def lag_loss(expected: ExpectedSeries) -> float:
    """Share of the quanta's variance that steps from frame to frame show: what lag carries over is no step."""
    correlation = np.atleast_1d(np.asarray(expected.temporal_correlation, dtype=np.float64))
    return 1.0 - float(correlation[0]) if correlation.size else 1.0


def _mean_product(images: FloatArray) -> FloatArray:
    """Mean products (image, image) of images (image, pixel)."""
    return np.asarray(images @ images.T / max(images.shape[1], 1))


_NOTHING = np.array([])
_STILL = MovingPicture((), (), _NOTHING, _NOTHING, _NOTHING.astype(np.intp), _NOTHING)

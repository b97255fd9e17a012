"""What a steady law may leave beside itself: what effects that do the same to every frame can do together.

In all series of one beam and scene these change the mean in the same proportion, so what their laws are off by does too. A drift, a
memory or a bent response does not.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import FloatArray, IndexArray
from ..model.curves import Curve
from .nuisances import Whitening


class Steady:
    """The part of a curve that steady effects together can do to the mean frames of each beam and scene."""

    def __init__(self, curves: Sequence[Curve], alike: IndexArray, whitening: Whitening) -> None:
        """From curves of all effects, not whitened; alike: number (probe,) of the beam and scene of mean frames, else below 0."""
        self._whitening = whitening
        steady = [curve.responses[-1] for curve in curves if curve.variant.course == "steady"]
        groups = [np.flatnonzero(alike == number) for number in np.unique(alike[alike >= 0])]
        self._parts = [(members, _reached(np.stack(steady)[:, members])) for members in groups if steady]

    def of(self, curve: Curve) -> Curve:
        """The curve with responses and chance as a steady law could leave them."""
        spread = None if curve.spread is None else self._part(curve.spread.T).T
        return replace(curve, responses=self._part(curve.responses), spread=spread)

    def _part(self, whitened: FloatArray) -> FloatArray:
        """Vectors (vector, probe), whitened, with what steady effects cannot do left out."""
        vectors = self._whitening.undo(whitened)
        for members, reached in self._parts:
            vectors[:, members] = vectors[:, members] @ reached
        return self._whitening.apply(vectors)


def _reached(responses: FloatArray) -> FloatArray:
    """The part (probe, probe) of a vector that a sum of responses (curve, probe) follows, each times a number of variance 1.

    The mean of that sum where the vector is seen with noise of a standard deviation in each probe.
    """
    _, lengths, along = np.linalg.svd(responses, full_matrices=False)
    return np.asarray((along.T * (lengths**2 / (lengths**2 + 1.0))) @ along)

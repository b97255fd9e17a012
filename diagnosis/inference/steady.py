"""What a steady law may leave beside itself: in all series of one beam and scene the same, as far as its light goes.

An effect that does the same to every frame of a setting changes the mean of all series of one beam and scene in proportion. So does
what its law is off by. A drift, a memory or a bent response does not.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import FloatArray, IndexArray
from ..model.curves import Curve
from .nuisances import Whitening


class Steady:
    """The part of a curve that is in proportion in all series of one beam and scene."""

    def __init__(self, curves: Sequence[Curve], alike: IndexArray, whitening: Whitening) -> None:
        """From curves of all effects, not whitened, and a number (probe,) that probes of one beam and scene share."""
        self._whitening = whitening
        steady = [curve.responses[-1] for curve in curves if curve.variant.course == "steady"]
        self._groups = [(members, _directions(np.stack(steady), members)) for members in _of_one_size(alike) if steady]

    def of(self, curve: Curve) -> Curve:
        """The curve with responses and chance as a steady law could leave them."""
        spread = None if curve.spread is None else self._part(curve.spread.T).T
        return replace(curve, responses=self._part(curve.responses), spread=spread)

    def _part(self, whitened: FloatArray) -> FloatArray:
        """Vectors (vector, probe), whitened, with what is not in proportion left out."""
        vectors = self._whitening.undo(whitened)
        for members, directions in self._groups:
            along = np.einsum("vcm,cm->vc", vectors[:, members], directions)
            vectors[:, members] = along[:, :, None] * directions
        return self._whitening.apply(vectors)


def _of_one_size(alike: IndexArray) -> list[IndexArray]:
    """Probes (class, member) that are alike, those of as many members together; a probe that is like no other is left out."""
    order = np.argsort(alike, kind="stable")
    _, starts, counts = np.unique(alike[order], return_index=True, return_counts=True)
    return [order[starts[counts == size][:, None] + np.arange(size)] for size in np.unique(counts[counts > 1])]


def _directions(steady: FloatArray, members: IndexArray) -> FloatArray:
    """Unit vectors (class, member): how steady responses (curve, probe) move probes that are alike, the strongest above all."""
    moved = np.swapaxes(steady[:, members], 0, 1)  # (class, curve, member)
    _, _, right = np.linalg.svd(moved, full_matrices=False)
    return np.asarray(right[:, 0, :])

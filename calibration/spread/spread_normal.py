"""Normal equations of the noise fit, and the prior of white noise that follows the signal."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
# White noise proportional to signal beside the quanta (secondary quanta): 1/K of the quantum variance for K electrons a
# quantum, K = 100-1000; the width leaves room for other white noise that follows the signal. Screens seen by a lens give a few
# electrons: the prior is Student's t, with the degrees of freedom that Lange, Little and Taylor (J. Am. Stat. Assoc. 84 (1989)
# 881) take.
_WHITE_FRACTION_PRIOR = (0.003, 0.03)
_WHITE_DEGREES = 4.0


@dataclass(frozen=True, slots=True)
class WhitePrior:
    """Student's t of the white parts: scale_DN (group,), the width about its middle; sd_DN (group,), that of the normal of the same
    slope where they are."""

    scale_DN: FloatArray
    sd_DN: FloatArray

    @classmethod
    def about(cls, gains: FloatArray) -> "WhitePrior":
        """Of white parts as expected beside these gains (group,)."""
        scale = np.maximum(np.abs(gains), 1e-12) * _WHITE_FRACTION_PRIOR[1]
        return cls(scale, scale)

    def at(self, coefficients: FloatArray) -> "WhitePrior":
        """Where these coefficients are."""
        beyond = self._beyond(coefficients) / math.sqrt(_WHITE_DEGREES + 1.0)
        return replace(self, sd_DN=np.hypot(self.scale_DN, beyond))

    def excess(self, coefficients: FloatArray) -> float:
        """What -2 ln of Student's t has more than the normal's there."""
        squared = self._beyond(coefficients) ** 2
        exact = (_WHITE_DEGREES + 1.0) * np.log1p(squared / ((_WHITE_DEGREES + 1.0) * self.scale_DN**2))
        return float(np.sum(exact - squared / self.sd_DN**2))

    def _beyond(self, coefficients: FloatArray) -> FloatArray:
        quantum, white = np.split(coefficients[: 2 * len(self.scale_DN)], 2)
        return np.asarray(white - _WHITE_FRACTION_PRIOR[0] * quantum)


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations of the linear coefficients, and of the spread's parameters where their derivatives are given."""

    matrix: FloatArray
    right: FloatArray
    square: float  # of the whitened data

    def solved(self, least_0: Sequence[int] = ()) -> tuple[FloatArray, float]:
        """Coefficients and chi-square; those of `least_0` are 0 where they would be negative, and what no datum tells stays 0."""
        free = np.ones(len(self.right), dtype=bool)
        while True:
            matrix, right = self.matrix[np.ix_(free, free)], self.right[free]
            scale = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
            scaled = matrix / np.outer(scale, scale) + 1e-11 * np.eye(len(scale))
            found = np.zeros(len(free))
            found[free] = np.linalg.solve(scaled, right / scale) / scale
            negative = [place for place in least_0 if free[place] and found[place] < 0]
            if not negative:
                return found, self.square - float(right @ found[free])
            # the one that would be most negative in its own standard deviations goes first
            free[min(negative, key=lambda place: found[place] * math.sqrt(self.matrix[place, place]))] = False

    def without(self, places: Sequence[int]) -> "Normal":
        """With the parameters at these places held where they are."""
        rest = np.delete(np.arange(len(self.right)), places)
        return replace(self, matrix=self.matrix[np.ix_(rest, rest)], right=self.right[rest])

    def with_white_prior(self, prior: WhitePrior) -> "Normal":
        """With a prior of the white parts."""
        matrix = self.matrix.copy()
        groups = len(prior.sd_DN)
        for group, sd in enumerate(prior.sd_DN):
            row = np.array([-_WHITE_FRACTION_PRIOR[0], 1.0]) / sd
            both = [group, groups + group]
            matrix[np.ix_(both, both)] += np.outer(row, row)
        return replace(self, matrix=matrix)

    def covariance(self) -> FloatArray:
        """Inverse of the matrix."""
        scale = np.sqrt(np.clip(np.diag(self.matrix), 1e-300, None))
        return np.asarray(np.linalg.pinv(self.matrix / np.outer(scale, scale), rcond=1e-10) / np.outer(scale, scale))

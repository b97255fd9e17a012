"""Scale and weights that a few pixels far away do not change."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# A pixel further than this from a fit, in standard deviations, has no say in it (Tukey's biweight).
REJECTED = 4.0


def robust_sd(residual: NDArray[np.float64]) -> float:
    """Standard deviation of a normal distribution about 0 with the same median absolute value; 1e-6 or more."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-6) if residual.size else 1e-6


def biweight(residual: NDArray[Any], *, sd: float) -> NDArray[np.float64]:
    """Weights from 1 at a residual of 0 down to 0 at four standard deviations.

    Source: Beaton and Tukey 1974, Technometrics 16:147.
    """
    return np.asarray(np.clip(1.0 - (residual / (REJECTED * sd)) ** 2, 0.0, None) ** 2)

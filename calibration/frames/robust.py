"""Standard deviation by most of the values, which a few far ones do not move."""

import numpy as np
from numpy.typing import NDArray

_SD_OF_MEDIAN = 1.4826  # standard deviation of a Gaussian over its median absolute deviation


def robust_sd(values: NDArray[np.floating], *, about: float | None = None) -> float:
    """Standard deviation of Gaussian values from their median absolute deviation, in their unit.

    Args:
        values: of any shape, at least one.
        about: what they deviate from; None: their median.

    >>> round(robust_sd(np.array([1.0, 2.0, 3.0, 4.0, 1000.0])), 4)
    1.4826
    """
    centre = np.median(values) if about is None else about
    return _SD_OF_MEDIAN * float(np.median(np.abs(values - centre)))

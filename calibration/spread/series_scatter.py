"""Whether the noise of several series agrees with what is fitted to all, and the variance that they have besides their sampling.

Noise of a series, or of a beam: measured over fitted, with the standard deviation of that by sampling; nan where nothing is fitted.

Source: Birge, Phys. Rev. 40 (1932) 207; Paule and Mandel, J. Res. NBS 87 (1982) 377.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_CHANCE = 1e-3  # that series which agree look as if they did not, and a warning stands where nothing is wrong


def chi_square_a_degree(ratios: Sequence[tuple[float, float]], degrees: int) -> float:
    """Chi-square a degree of freedom of the series' whole power; 1 where no degree is left.

    Where frames of a series are averages, or its level bends, its frequencies agree with each other: only the series differ.
    """
    known = [((ratio - 1.0) / sd) ** 2 for ratio, sd in ratios if math.isfinite(ratio)]
    return sum(known) / degrees if degrees > 0 else 1.0


def series_differ(ratios: Sequence[tuple[float, float]], degrees: int) -> bool:
    """Whether the noise of series departs from what is fitted by more than chance; arguments as of `scatter_of_series`."""
    from scipy.special import chdtri

    return degrees > 0 and chi_square_a_degree(ratios, degrees) * degrees >= float(chdtri(degrees, _CHANCE))


def scatter_of_series(ratios: Sequence[tuple[float, float]], degrees: int) -> float:
    """Relative variance that series have besides their sampling, which makes their chi-square what it should be; 0 where that
    is within chance.

    Args:
        ratios: noise of each series over the fitted, and its standard deviation by sampling.
        degrees: series less what was fitted to them.
    """
    return _wanted_by(ratios, degrees) if series_differ(ratios, degrees) else 0.0


def own_to_beams(ratios: Sequence[tuple[float, float]], degrees: int) -> tuple[FloatArray, FloatArray]:
    """What each beam's noise departs from the fit by (group,), relative, and what is open of that.

    Departures are drawn from one normal distribution, whose variance is what chi-square wants (`_wanted_by`).
    """
    own = _wanted_by(ratios, degrees)
    known = np.array(ratios).reshape(-1, 2)
    sampling = np.where(np.isfinite(known[:, 1]), known[:, 1] ** 2, math.inf)
    share = own / (own + sampling)
    return np.nan_to_num(share * np.nan_to_num(known[:, 0] - 1.0)), np.sqrt(np.nan_to_num(share * sampling))


def _wanted_by(ratios: Sequence[tuple[float, float]], degrees: int) -> float:
    """Relative variance besides sampling that makes chi-square what it should be, 0 where it is no larger; arguments as above."""
    from scipy.optimize import brentq

    if degrees < 1 or chi_square_a_degree(ratios, degrees) <= 1.0:
        return 0.0
    known = np.array([one for one in ratios if math.isfinite(one[0])]).reshape(-1, 2)
    square, sampling = (known[:, 0] - 1.0) ** 2, known[:, 1] ** 2
    return float(brentq(lambda more: float(np.sum(square / (sampling + more))) - degrees, 0.0, float(square.sum())))

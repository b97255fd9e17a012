"""What an ADC whose steps are not small against the noise makes of variances, averaged over the pixels of a panel.

A Gaussian value of standard deviation r steps about a mean that lies anywhere between two codes, as the pixels' means do,
keeps a variance of r^2 + 1/12 - sum_k exp(-(2 pi k r)^2) / (2 pi^2 k^2) steps^2 about what it is rounded to on average.
Source: characteristic functions of a quantised Gaussian, Widrow and Kollar (2008), chapter 4, averaged over the mean.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FINE = 3.0  # steps of noise from which rounding adds 1/12 and nothing else that matters
_HARMONICS = 200  # the series falls as 1/k^2 where there is hardly any noise


def rounded_variance(variance: ArrayLike, step: float) -> NDArray[np.float64]:
    """Variance of Gaussian values after rounding to multiples of `step` (> 0), in the same unit squared; any shape."""
    before = np.maximum(np.asarray(variance, dtype=np.float64), 0.0)
    relative = before / step**2
    tabled = np.interp(np.sqrt(relative), *_table())
    return np.asarray(np.where(relative < _FINE**2, tabled, relative + 1.0 / 12.0) * step**2)


def variance_before_rounding(variance: ArrayLike, step: float) -> NDArray[np.float64]:
    """Variance that Gaussian values had before they were rounded to multiples of `step` (> 0); any shape."""
    after = np.maximum(np.asarray(variance, dtype=np.float64), 0.0) / step**2
    sd, found = _table()
    return np.asarray(np.where(after < found[-1], np.interp(after, found, sd) ** 2, after - 1.0 / 12.0) * step**2)


def variance_kept_by_means(variance: ArrayLike, step: float) -> NDArray[np.float64]:
    """What rounding to multiples of `step` (> 0) leaves in the mean of any number of values, by their variance after it; any shape.

    Noise below half a step does not move a value over the next threshold each time: step^2 / 12 without any, nothing from a step on.
    """
    after = np.asarray(variance, dtype=np.float64)
    return np.maximum(variance_before_rounding(after, step) + step**2 / 12.0 - np.maximum(after, 0.0), 0.0)


@lru_cache(maxsize=1)
def _table() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard deviations before, and variances after rounding, in steps."""
    sd = np.concatenate([np.linspace(0.0, 0.8, 801), np.linspace(0.8, _FINE, 2201)[1:]])
    k = np.arange(1, _HARMONICS + 1)[:, None]
    kept = np.exp(-((2.0 * np.pi * k * sd) ** 2)) / (2.0 * np.pi**2 * k**2)
    # what the series leaves out beyond its last term, all of which counts without noise
    rest = (1.0 / 12.0 - float(np.sum(1.0 / (2.0 * np.pi**2 * k**2)))) * (sd == 0.0)
    return sd, sd**2 + 1.0 / 12.0 - kept.sum(axis=0) - rest

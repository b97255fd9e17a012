"""Receiver operating characteristic of a continuous response: detection against false alarm over all decisions."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .hit_miss import Z_TWO_SIDED

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Roc:
    """decision (point,) falling, with the share of products without object (false_alarm) and with (detected) at or
    above.

    area: chance that a product with an object responds more than one without; area_low, area_high: its 95 % interval.
    """

    decision: Array
    false_alarm: Array
    detected: Array
    area: float
    area_low: float
    area_high: float


def compute_roc(noise: ArrayLike, signal: ArrayLike) -> Roc:
    """Empirical curve and the area under it, with the interval of DeLong on the logit scale.

    Source: DeLong, DeLong & Clarke-Pearson, Biometrics 44 (1988) 837, doi:10.2307/2531595.

    Args:
        noise: (product,), responses of products without object.
        signal: (product,), responses of products with one.
    """
    n, s = (np.asarray(values, dtype=float) for values in (noise, signal))
    for name, values in (("noise", n), ("signal", s)):
        if values.ndim != 1 or len(values) < 2 or not np.all(np.isfinite(values)):
            raise InputError(name, received=f"{values.size} values", expected="two or more finite responses")
    decision = np.concatenate(([np.inf], np.unique(np.concatenate((n, s)))[::-1]))
    sorted_n, sorted_s = np.sort(n), np.sort(s)
    false_alarm = 1 - np.searchsorted(sorted_n, decision, side="left") / len(n)
    detected = 1 - np.searchsorted(sorted_s, decision, side="left") / len(s)
    # ties count half
    of_signal = (np.searchsorted(sorted_n, s, "left") + np.searchsorted(sorted_n, s, "right")) / (2 * len(n))
    of_noise = 1 - (np.searchsorted(sorted_s, n, "left") + np.searchsorted(sorted_s, n, "right")) / (2 * len(s))
    area = float(of_signal.mean())
    error = math.sqrt(of_signal.var(ddof=1) / len(s) + of_noise.var(ddof=1) / len(n))
    if error == 0 or not 0 < area < 1:
        # perfect order: the exact statement is that of the smaller sample
        least = 0.05 ** (1 / min(len(n), len(s)))
        low, high = (least, 1.0) if area == 1 else (0.0, 1 - least) if area == 0 else (area, area)
    else:
        middle, wide = math.log(area / (1 - area)), Z_TWO_SIDED * error / (area * (1 - area))
        low, high = (1 / (1 + math.exp(-v)) for v in (middle - wide, middle + wide))
    return Roc(
        decision=decision,
        false_alarm=np.asarray(false_alarm),
        detected=np.asarray(detected),
        area=area,
        area_low=low,
        area_high=high,
    )

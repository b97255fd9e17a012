"""Probability of false alarm: marked products among those without foreign object."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class FalseAlarmRate:
    """Share of looks at products without object that ended in an alarm, with its 95 % interval.

    effective_n: the number of independent looks that would be as informative (repeats count less).
    """

    n: int
    false_alarms: int
    rate: float
    low: float
    high: float
    effective_n: float


def false_alarm_rate(
    false_alarm: ArrayLike, *, network: ArrayLike | None = None, image: ArrayLike | None = None
) -> FalseAlarmRate:
    """False-alarm rate (0 to 1) with a 95 % interval.

    Clopper-Pearson on the effective number of looks, n V_binomial / V_clustered (never more than n), times (t(n - 1) / t(m))^2
    for a variance known with m degrees of freedom, t Student's quantile at 97.5 %. V_clustered is by networks and images
    (`robust.clustered_total`). Without repeats it is the exact binomial interval.
    Source: Clopper & Pearson, Biometrika 26 (1934) 404; Korn & Graubard, Survey Methodology 24 (1998) 193.

    Args:
        false_alarm: (look,), 0 or 1.
        network, image: (look,), labels of who looked and at what.
    """
    from scipy.special import betaincinv

    from .few_groups import TWO_SIDED, student_quantile
    from .robust import clustered_total
    from .trials import codes_from_labels

    alarm = np.asarray(false_alarm, dtype=float)
    if alarm.ndim != 1 or not len(alarm) or not np.all(np.isin(alarm, (0.0, 1.0))):
        raise InputError("false_alarm", received=f"shape {alarm.shape}", expected="one column of 0 and 1, not empty")
    n, count = len(alarm), int(alarm.sum())
    rate = count / n
    effective = float(n)
    groups = []
    for name, labels in (("network", network), ("image", image)):
        if labels is not None:
            codes = codes_from_labels(name, labels, n)
            if 0 < codes.max() < n - 1:
                groups.append(codes)
    if groups and 0 < count < n:
        variance, freedom = clustered_total(alarm - rate, groups)
        few = float(student_quantile(TWO_SIDED, n - 1) / student_quantile(TWO_SIDED, freedom)) ** 2
        effective = few * min(n, n * n * rate * (1 - rate) / max(variance, 1e-300))
    elif groups:
        # none or all: the spread cannot be seen, so one look for each level of the smaller factor is what is sure
        effective = float(min(int(codes.max()) + 1 for codes in groups))
    k, m = rate * effective, effective
    low = float(betaincinv(k, m - k + 1, 0.025)) if count else 0.0
    high = float(betaincinv(k + 1, m - k, 0.975)) if count < n else 1.0
    return FalseAlarmRate(n=n, false_alarms=count, rate=rate, low=low, high=high, effective_n=effective)

"""Probability of false alarm: marked products among those without foreign object."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

_BY_CHANCE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class FalseAlarmRate:
    """Share of looks at products without object that ended in an alarm, with its 95 % interval.

    effective_n: the number of independent looks that would be as informative (repeats count less); networks_differ: whether the
    networks' rates differ by more than chance, so that the interval is that of other networks too.
    """

    n: int
    false_alarms: int
    rate: float
    low: float
    high: float
    effective_n: float
    networks_differ: bool = False


def false_alarm_rate(
    false_alarm: ArrayLike, *, network: ArrayLike | None = None, image: ArrayLike | None = None
) -> FalseAlarmRate:
    """False-alarm rate (0 to 1) with a 95 % interval.

    Clopper-Pearson on the effective number of looks, n V_binomial / V_clustered (never more than n), times (t(n - 1) / t(m))^2
    for a variance known with m degrees of freedom, t Student's quantile at 97.5 %. V_clustered is by images, and by networks too
    where these differ by more than chance (Pearson's chi-square of their rates, at 5 %): else the interval is of the mean rate of
    these networks, and few alarms tell no more (`robust.clustered_total`). Of no alarm, or alarms alone, each image is one look.
    Without repeats it is the exact binomial interval.
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
    codes = {}
    for name, labels in (("network", network), ("image", image)):
        if labels is not None:
            code = codes_from_labels(name, labels, n)
            if 0 < code.max() < n - 1:
                codes[name] = code
    differ = "network" in codes and 0 < count < n and _differ(alarm, codes["network"])
    groups = [code for name, code in codes.items() if name == "image" or differ]
    if groups and 0 < count < n:
        variance, freedom = clustered_total(alarm - rate, groups)
        few = float(student_quantile(TWO_SIDED, n - 1) / student_quantile(TWO_SIDED, freedom)) ** 2
        effective = few * min(n, n * n * rate * (1 - rate) / max(variance, 1e-300))
    elif groups:
        effective = float(max(code.max() for code in groups) + 1)
    k, m = rate * effective, effective
    low = float(betaincinv(k, m - k + 1, 0.025)) if count else 0.0
    high = float(betaincinv(k + 1, m - k, 0.975)) if count < n else 1.0
    return FalseAlarmRate(
        n=n, false_alarms=count, rate=rate, low=low, high=high, effective_n=effective, networks_differ=differ
    )


def _differ(alarm: NDArray[np.float64], network: NDArray[np.intp]) -> bool:
    """Whether networks' rates differ by more than one in twenty do by chance (Pearson's chi-square)."""
    from scipy.special import chdtri

    looks = np.bincount(network).astype(float)
    expected = looks * alarm.mean()
    square = (np.bincount(network, weights=alarm) - expected) ** 2
    statistic = float(np.sum(square / (expected * (1.0 - alarm.mean()))))
    return statistic > float(chdtri(len(looks) - 1, _BY_CHANCE))

"""The average over spreads that the noise leaves open: the one that stands for all, and what the others add to its variances.

Source: model averaging: Buckland, Burnham, Augustin, Biometrics 53 (1997) 603.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...generator.line.twin import OtherSpread
from .core_width import core_before_tail_px
from .spread_candidates import Candidate
from .spread_members import Members, likeliest

FloatArray = NDArray[np.float64]
# A spread is as good as another where its likelihood is a tenth of the best at least; and a gain within half a standard
# deviation of the mean adds an eighth to that, while a spread without a tail is quicker wherever it is used.
_AS_LIKELY = 2.0 * math.log(10.0)
_NEAR_THE_MEAN = 0.5
# of a family to be kept: less likely than any law of an effect is beforehand in the diagnosis (0.40 over 28 effects of some laws)
_LEAST_LIKELY = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class SpreadAverage:
    """Spreads and their probabilities.

    Fields: candidates; weights (candidate,), which add up to 1; chosen: the candidate that stands for all; inflation: chi-square a
    degree of freedom of the likeliest, 1 at least.
    """

    candidates: tuple[Candidate, ...]
    weights: FloatArray
    chosen: Candidate
    inflation: float

    @classmethod
    def of(cls, members: Members) -> "SpreadAverage":
        """Of these spreads."""
        weights = np.exp(members.log_weights - members.log_weights.max())
        weights /= weights.sum()
        chosen = _representative(members.candidates, weights, members.inflation)
        return cls(members.candidates, weights, chosen, members.inflation)

    def criteria(self) -> dict[str, float]:
        """Family -> twice the logarithm of the best family's evidence over its own."""
        evidence: dict[str, float] = {}
        for share, item in zip(self.weights, self.candidates, strict=True):
            evidence[item.family] = evidence.get(item.family, 0.0) + float(share)
        best = max(evidence.values())
        return {family: -2.0 * math.log(max(value, 1e-300) / best) for family, value in evidence.items()}

    def others(self) -> tuple[OtherSpread, ...]:
        """Families beside the chosen one that are likely enough to matter, each with the mean of its parameters."""
        found = []
        for family in dict.fromkeys(item.family for item in self.candidates):
            own = [
                (float(share), item.spread)
                for share, item in zip(self.weights, self.candidates, strict=True)
                if item.family == family
            ]
            together = sum(share for share, _ in own)
            if family != self.chosen.family and together >= _LEAST_LIKELY:
                means = {
                    name: sum(share * getattr(spread, name) for share, spread in own) / together
                    for name in ("sigma_px", "aspect", "tail_share", "tail_px")
                }
                found.append(OtherSpread(family=family, probability=together, value=replace(own[0][1], **means)))
        return tuple(sorted(found, key=lambda item: -item.probability))

    def scale_variances(self, inflation: float) -> tuple[FloatArray, FloatArray]:
        """Variances of gains and slopes (group,), DN^2: sampling, and what spreads differ by; scales are averaged by their
        logarithms."""
        gain, slope = self.chosen.gains, self.chosen.slopes
        of_gain, of_slope = np.zeros(len(gain)), np.zeros(len(slope))
        for share, item in zip(self.weights, self.candidates, strict=True):
            own_gain, own_slope = item.sampling_variances(inflation)
            of_gain += share * (own_gain + (gain * _log_ratio(item.gains, gain)) ** 2)
            of_slope += share * (own_slope + (slope * _log_ratio(item.slopes, slope)) ** 2)
        return of_gain, of_slope

    def log_covariance(self, inflation: float) -> FloatArray:
        """Covariance of the logarithms of gains and slopes (2 x group, 2 x group)."""
        gain, slope = self.chosen.gains, self.chosen.slopes
        found = np.zeros((2 * len(gain), 2 * len(gain)))
        for share, item in zip(self.weights, self.candidates, strict=True):
            moved = np.concatenate([_log_ratio(item.gains, gain), _log_ratio(item.slopes, slope)])
            found += share * (item.log_covariance(inflation) + np.outer(moved, moved))
        return found

    def spread_sd(self, inflation: float) -> dict[str, float]:
        """Standard deviations of the spread's parameters."""
        chosen = self.chosen.spread
        variance = dict.fromkeys(self.chosen.spread_variances(inflation), 0.0)
        for share, item in zip(self.weights, self.candidates, strict=True):
            for name, own in item.spread_variances(inflation).items():
                moved = getattr(item.spread, name) - getattr(chosen, name)
                reach_of_none = name == "tail_px" and min(item.spread.tail_share, chosen.tail_share) == 0
                variance[name] += float(share) * (own + (0.0 if reach_of_none else moved**2))
            if share > _LEAST_LIKELY:
                # a tail that stands beside the core, or behind it: one is as likely as the other
                variance["sigma_px"] += (
                    0.5 * float(share) * (core_before_tail_px(item.spread) - item.spread.sigma_px) ** 2
                )
        return {name: math.sqrt(value) for name, value in variance.items()}


def _representative(candidates: Sequence[Candidate], weights: FloatArray, inflation: float) -> Candidate:
    """The spread with the fewest parameters of those that are likely and whose gains lie near the mean of all.

    Args:
        candidates: spreads.
        weights: of each; they add up to 1.
        inflation: what a chi-square is divided by.
    """
    least = likeliest(candidates).chi_square
    scale = np.array([float(np.mean(_log_ratio(item.gains, candidates[0].gains))) for item in candidates])
    mean = float(weights @ scale)
    sd = math.sqrt(float(weights @ (scale - mean) ** 2))
    likely = [place for place, item in enumerate(candidates) if (item.chi_square - least) / inflation <= _AS_LIKELY]
    near = [place for place in likely if abs(scale[place] - mean) <= _NEAR_THE_MEAN * sd]
    if not near:
        near = [min(likely, key=lambda place: abs(scale[place] - mean))]
    return candidates[min(near, key=lambda place: (len(candidates[place].form.names), -weights[place]))]


def _log_ratio(first: FloatArray, second: FloatArray) -> FloatArray:
    """Logarithm of the ratio of two positive scales; 0 where one of them is none."""
    both = (first > 0) & (second > 0)
    return np.asarray(np.log(np.where(both, first, 1.0) / np.where(both, second, 1.0)))

"""Model discrepancy: how far laws of an effect's kind depart from ours, and what effects do by chance.

At a level k a law is off by a random factor of relative size k in each group of probes, by half of that in each probe of its own,
and by a share of that in probes of a place where it acts but foretells less. What it leaves in a series may look like another effect,
up to k times as large as what it does there. Levels are no choice for a session: evidence is averaged over them, with the frequencies
that laws of many shapes have shown (`discrepancy.toml`). The shares below are choices: no script has fitted them.
"""

import math
import tomllib
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.sparse import csc_array

from ..arrays import FloatArray, IndexArray
from ..model.curves import Curve


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """Levels of discrepancy and how often they occur."""

    levels: tuple[float, ...]  # (level,), relative
    of_kind: tuple[float, ...]  # (level,): frequencies where the effect is of the kind that a law describes
    # (level,): where it is not, and the law is the one of the catalogue that resembles it most
    of_another: tuple[float, ...]
    misfit_of_kind: float  # how often such a law leaves a misfit in some families of probes beyond that
    misfit_of_another: float  # the same of the others
    misfit_sd_of_kind: float  # of the length of a misfit over that of what the laws do, a Gaussian about 0
    misfit_of_another_log: tuple[float, float]  # mean and standard deviation of the logarithm of that, a Gaussian

    def up_to(self, level: float) -> "Levels":
        """Those up to a level, with frequencies as they are."""
        kept = sum(one <= level for one in self.levels)
        return replace(self, levels=self.levels[:kept], of_kind=self.of_kind[:kept], of_another=self.of_another[:kept])


def only(level: float) -> Levels:
    """One level, of which laws of any kind are off."""
    return replace(LEVELS, levels=(level,), of_kind=(1.0,), of_another=(1.0,))


def log_frequency(level: float, *, another: bool = False) -> float:
    """Log of how often laws of an effect's kind (or of `another` kind) are off by a level."""
    frequencies = LEVELS.of_another if another else LEVELS.of_kind
    return math.log(frequencies[int(np.argmin(np.abs(np.array(LEVELS.levels) - level)))])


def at_most_off(level: float) -> float:
    """A level by which a law may be off in shape: one that is as good as exact stands for all levels below the next, half of that."""
    return level or 0.5 * LEVELS.levels[1]


def _learnt() -> Levels:
    """As `validation/learn_discrepancy.py` left them."""
    table = tomllib.loads(files("raytwin.diagnosis.inference").joinpath("discrepancy.toml").read_text(encoding="utf-8"))
    values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
    return Levels(**values)


LEVELS = _learnt()
# beyond it a law does not carry the probes: what is off by more than half of itself explains anything
FARTHEST_LEVEL = 0.4
USUAL_LEVEL = 0.1  # of refinement, of laws that a twin has, and of what is fitted on half of a session
PROBE_SHARE = 0.5  # of a level that is each probe's own
ELSEWHERE_SHARE = 0.1  # of a level, times the rms of what the law foretells in a place, in each probe of the place
EXACT_LAW_ERROR = 0.03  # relative error of probes that a strength is defined by
LEAST_FACTOR = 0.05  # variance of a factor along itself that is worth carrying
_LEAST_RATIO = 1e-3  # of a misfit over what laws do: shorter ones do not show
LEAST_MOVED = 0.3  # standard deviations of a probe by which what is random about a law must move one to be carried
# what a law predicts in a place over what is seen there, up to which it may be off by a share of itself
_TIMES_SEEN = 1.5


def credible(response: FloatArray, seen: FloatArray, places: IndexArray) -> FloatArray:
    """The part of a response (probe,) that its law's inaccuracy is a share of: in each place no more than `_TIMES_SEEN` what is seen.

    A law that predicts thousands of standard deviations where nothing is seen is wrong by all of them, not off by a share.
    """
    predicted = np.bincount(places, weights=response**2)
    found = np.bincount(places, weights=np.maximum(seen**2, 1.0))
    share = np.sqrt(np.minimum(1.0, _TIMES_SEEN**2 * found / np.maximum(predicted, 1e-12)))
    return np.asarray(response * share[places])


@dataclass(frozen=True, slots=True)
class LawFactors:
    """What is random about effects at their strengths."""

    of_laws: csc_array  # (factor, probe): what the law is off by, a row for each group of probes and effect
    spread: FloatArray  # (probe, factor): what the effects do by chance

    def __bool__(self) -> bool:
        return bool(self.of_laws.shape[0] or self.spread.shape[1])

    def full(self) -> FloatArray:
        """All of them (probe, factor)."""
        return np.concatenate([self.of_laws.toarray().T, self.spread], axis=1)


def law_factors(
    curve: Curve, strength: float, response: FloatArray, groups: IndexArray, level: float, *, chance: bool = True
) -> LawFactors:
    """What is random about an effect at a strength: its law's inaccuracy, and, with `chance`, its own spread."""
    if curve.exact is not None:
        response = np.where(curve.exact, 0.0, response)
    spread = curve.chance
    if not chance or float(np.max(np.abs(spread), initial=0.0)) * strength < LEAST_MOVED:
        spread = np.zeros((len(response), 0))
    moves = float(np.max(np.abs(response), initial=0.0)) * level >= LEAST_MOVED
    return LawFactors(group_factors(response, groups, level if moves else 0.0), spread * strength)


def group_factors(response: FloatArray, groups: IndexArray, sd: float) -> csc_array:
    """A row (factor, probe) a group: the response there times `sd`; groups in which it would move nothing are left out."""
    power = np.bincount(groups, weights=response**2)
    kept = sd**2 * power > LEAST_FACTOR
    inside = kept[groups]
    places = (np.cumsum(kept) - 1)[groups[inside]]
    starts = np.concatenate([[0], np.cumsum(inside)])
    return csc_array((sd * response[inside], places, starts), shape=(int(np.count_nonzero(kept)), len(response)))


def own_variance(curve: Curve, strength: float, effective: FloatArray, places: IndexArray, level: float) -> FloatArray:
    """Variance (probe,) that an effect gives each probe by itself: by its law's discrepancy, and by chance."""
    share: float | FloatArray = PROBE_SHARE * level
    if curve.exact is not None:
        share = np.where(curve.exact, EXACT_LAW_ERROR, share)
    own = (share * effective) ** 2
    if level:
        of_place = np.bincount(places, weights=effective**2) / np.maximum(np.bincount(places), 1)
        own = own + (ELSEWHERE_SHARE * level) ** 2 * of_place[places]
    return np.asarray(own if curve.jitter is None else own + strength**2 * curve.jitter)


def law_terms(
    curve: Curve, strength: float, groups: IndexArray, places: IndexArray, level: float
) -> tuple[FloatArray, FloatArray]:
    """What a law that is off by so much adds: factors (probe, factor) and each probe's own variance (probe,)."""
    response = curve.response(strength)
    factors = law_factors(curve, strength, response, groups, level).full()
    return factors, own_variance(curve, strength, response, places, level)


def log_misfit(ratio: float, *, another: bool = False) -> float:
    """Log density, in the logarithm of it, of how many times as long a misfit is as what the laws beside it do.

    another: the laws are only like what is there.
    """
    ratio = max(ratio, _LEAST_RATIO)
    if another:
        middle, sd = LEVELS.misfit_of_another_log
        return -0.5 * ((math.log(ratio) - middle) / sd) ** 2 - math.log(math.sqrt(2.0 * math.pi) * sd)
    share = ratio / LEVELS.misfit_sd_of_kind
    return math.log(share) + 0.5 * math.log(2.0 / math.pi) - 0.5 * share**2


def leak_density(ratio: FloatArray, level: float, least: float) -> FloatArray:
    """Density, in the logarithm of it, of what a law leaves in the shape of another effect over what it does itself.

    Even from `least`, below which it does not show, to the level, and falling as a Gaussian beyond; nothing where a law of this level
    leaves nothing that shows.
    """
    from scipy.special import exp1

    if level <= least:
        return np.zeros_like(ratio)
    # the integral of exp(-(x / level)^2 / 2) over the logarithm of x from `least` on
    width = float(0.5 * exp1(0.5 * (least / level) ** 2))
    return np.asarray(np.where(ratio < least, 0.0, np.exp(-0.5 * (ratio / level) ** 2)) / width)


def leak_below(ratio: float, level: float, least: float) -> float:
    """Probability that it is less, or does not show at all."""
    if level <= least:
        return 1.0
    if ratio <= least:
        return 0.0
    inside = np.geomspace(least, ratio, 200)
    return float(np.trapezoid(leak_density(inside, level, least), np.log(inside)))

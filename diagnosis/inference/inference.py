"""Which hypothesis explains a vector of probes: none, one effect, two, or something that is not in the catalogue.

Probes are residuals r (probe,) against the twin, in units of their own standard deviations. Nuisance parameters are
integrated out exactly (they are linear with Gaussian priors): r ~ N(m, C), C = I + F F^T, F (probe, factor) the
responses to the nuisances times their prior standard deviations.

    none      m = 0; now and then one family of probes is off by a little (`unknown.Chance`)
    effect    m = m_e(s), s the strength, log-uniform over its plausible range; its law is off by a level and may leave a rest in
              any families of probes (`discrepancy`), over which the evidence is averaged; what it does by chance is extra covariance
    pair      m = m_e(s) + m_f(t), each law off by a level of its own
    unknown   m = 0 and an extra variance in any number of families of probes; or like an effect of the catalogue, as far off as
              effects of other kinds are from the law that resembles them most
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..model.curves import Curve
from .curve_fits import CurveFit, interval_of, log_mean_exp
from .discrepancy import LEVELS, log_rest
from .observed import Observed, Point
from .pairs import Single, left_by_the_stronger, log_prior, weigh_pairs
from .unknown import Beyond, beyond

UNKNOWN = "unknown_effect"
_WITH_REST = 3  # effects, and pairs, the likeliest, whose rest is looked at
_PAIRS_FROM = 6  # effects, the likeliest, that are the first of a pair


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """One explanation and how probable it is.

    Fields: effects (ids; empty for none; `("unknown_effect",)` for an effect outside the catalogue); probability; log_evidence;
    strengths per effect: best value and 95 % interval (value, low, high); variants per effect; levels: of discrepancy, per effect;
    location: probe group of an unknown effect; rest: the one in which laws leave most, empty where they leave nothing.
    """

    effects: tuple[str, ...]
    probability: float
    log_evidence: float
    strengths: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    variants: Mapping[str, Curve] = field(default_factory=dict)
    levels: Mapping[str, float] = field(default_factory=dict)
    location: str = ""
    rest: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """Prior probabilities of the kinds of hypothesis, shared evenly within each kind; they need not sum to 1."""

    none: float = 0.35
    single: float = 0.40
    pair: float = 0.10
    unknown: float = 0.15


def weigh_hypotheses(
    observed: Observed,
    fits: Sequence[CurveFit],
    *,
    parts: NDArray[np.intp],
    part_names: Sequence[str],
    priors: Priors | None = None,
    of_catalogue: int = 0,
    rests: bool = True,
) -> tuple[Hypothesis, ...]:
    """All hypotheses, most probable first; their probabilities sum to 1.

    Args:
        observed: standardised probes less the twin's, and what may vary.
        fits: of each effect's curves to it; several curves of one effect are variants with equal prior.
        parts, part_names: families of probes (probe,) in which an unknown effect may show.
        priors: of the kinds of hypothesis.
        of_catalogue: number of effects that share the priors, those that cannot show here among them; at least those with fits.
        rests: laws may leave a rest; False: they may not, a first look at a third of the cost.
    """
    priors = priors or Priors()
    singles = _singles(fits)
    count = max(len(singles), of_catalogue, 1)
    ranked = sorted(singles, key=lambda effect: -singles[effect].log_evidence)
    none = beyond(observed, parts, part_names)
    looked_at = _WITH_REST if rests else 0
    beside = _Rests(observed, parts, part_names)
    weighed = [(Hypothesis(effects=(), probability=0.0, log_evidence=none.allowed), math.log(priors.none))]
    of_single = math.log(priors.single / count)
    alike, whole = [], {}
    for effect in ranked:
        single = singles[effect]
        found = _of_fits((effect,), {effect: single.best}, single.log_evidence)
        found = replace(found, strengths={effect: interval_of(single.fits)})
        if effect in ranked[:looked_at]:
            found = beside.of_kind(found, [single.best])
            alike.append(beside.of_another(single))
        weighed.append((found, of_single))
        whole[effect] = found
    leaks: dict[str, Hypothesis] = {}
    of_pair = math.log(priors.pair / max(count * (count - 1) // 2, 1))
    for number, pair in enumerate(weigh_pairs(observed, singles, leading=_PAIRS_FROM)):
        found = _of_fits(pair.effects, pair.fits, pair.log_evidence)
        if number < looked_at:
            found = beside.of_kind(found, list(pair.fits.values()))
        weighed.append((found, of_pair))
        # or the weaker of them is what the stronger one's law leaves
        strong, leaves = left_by_the_stronger(observed, pair)
        alone = replace(whole[strong], log_evidence=found.log_evidence + leaves, rest=found.rest)
        if alone.log_evidence > leaks.get(strong, singles[strong]).log_evidence:
            leaks[strong] = alone
    weighed += [(item, of_single) for item in leaks.values()]
    likest = float(np.logaddexp.reduce(alike)) - math.log(count) if alike else -math.inf
    evidence = float(np.logaddexp(none.log_evidence, likest)) - math.log(2.0)
    unknown = Hypothesis(effects=(UNKNOWN,), probability=0.0, log_evidence=evidence, location=none.place)
    weighed.append((unknown, math.log(priors.unknown)))
    return _by_effects(weighed)


def _by_effects(weighed: Sequence[tuple[Hypothesis, float]]) -> tuple[Hypothesis, ...]:
    """Hypotheses with log priors as probabilities, those with the same effects as one, most probable first."""
    scores = np.array([item.log_evidence + prior for item, prior in weighed])
    shares = np.exp(scores - scores.max())
    shares /= shares.sum()
    best: dict[tuple[str, ...], Hypothesis] = {}
    total: dict[tuple[str, ...], float] = {}
    for number in np.argsort(-scores):
        item = weighed[number][0]
        total[item.effects] = total.get(item.effects, 0.0) + float(shares[number])
        best.setdefault(item.effects, item)
    every = [replace(item, probability=total[effects]) for effects, item in best.items()]
    return tuple(sorted(every, key=lambda item: (-item.probability, -item.log_evidence)))


def evidence_with_rest(
    observed: Observed, points: Sequence[Point], *, parts: NDArray[np.intp], part_names: Sequence[str]
) -> float:
    """Log evidence over none of effects at their points with a rest beside them, whatever it is."""
    return _Rests(observed, parts, part_names).beside(points)[0]


class _Rests:
    """What laws leave beside effects, in families of probes."""

    def __init__(self, observed: Observed, parts: NDArray[np.intp], names: Sequence[str]) -> None:
        self._observed = observed
        self._parts = parts
        self._names = names

    def of_kind(self, hypothesis: Hypothesis, fits: Sequence[CurveFit]) -> Hypothesis:
        """A hypothesis whose laws may leave a rest; fits: of its effects, whose curves are in the first units."""
        points = [fit.point for fit in fits]
        evidence, found = self.beside(points)
        plain = hypothesis.log_evidence + math.log1p(-LEVELS.rest_of_kind) + found.allowed
        moved = math.hypot(*(self._observed.length(point.curve, point.strength) for point in points))
        with_rest = evidence + math.log(LEVELS.rest_of_kind) + log_rest(found.length / max(moved, 1.0))
        return replace(
            hypothesis,
            log_evidence=float(np.logaddexp(plain, with_rest)),
            rest=found.place if with_rest > plain else "",
        )

    def of_another(self, single: Single) -> float:
        """Log evidence over none of an effect that is only like one of the catalogue's."""
        plain = log_mean_exp(
            np.array([fit.averaged(LEVELS.of_another) for fit in single.fits if len(fit.by_level) > 1])
        )
        evidence, _ = self.beside([single.best.at_level(LEVELS.levels[-1])], another=True)
        share = LEVELS.rest_of_another
        return float(np.logaddexp(plain + math.log1p(-share), evidence + math.log(share)))

    def beside(self, points: Sequence[Point], *, another: bool = False) -> tuple[float, Beyond]:
        """Log evidence over none of effects at their points with a rest beside them, and what that rest is."""
        beside = self._observed
        for point in points:
            beside = beside.beside(point)
        found = beyond(beside, self._parts, self._names)
        evidence = beside.log_likelihood - self._observed.log_likelihood + found.log_evidence
        evidence += sum(log_prior(point, another=another) for point in points)
        return evidence, found


def _of_fits(effects: tuple[str, ...], fits: Mapping[str, CurveFit], log_evidence: float) -> Hypothesis:
    return Hypothesis(
        effects=effects,
        probability=0.0,
        log_evidence=log_evidence,
        strengths={effect: interval_of([fit]) for effect, fit in fits.items()},
        variants={effect: fit.curve for effect, fit in fits.items()},
        levels={effect: fit.level for effect, fit in fits.items()},
    )


def _singles(fits: Sequence[CurveFit]) -> dict[str, Single]:
    """Effects by id, from the fits of their variants."""
    by_effect: dict[str, list[CurveFit]] = {}
    for fit in fits:
        by_effect.setdefault(fit.curve.effect, []).append(fit)
    return {
        effect: Single(
            fits=own,
            best=max(own, key=lambda fit: fit.log_evidence),
            log_evidence=float(log_mean_exp(np.array([fit.log_evidence for fit in own]))),
        )
        for effect, own in by_effect.items()
    }

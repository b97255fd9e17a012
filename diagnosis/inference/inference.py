"""Which hypothesis explains a vector of probes: none, one effect, two, or something that is not in the catalogue.

Probes are residuals r (probe,) against the twin, in units of their own standard deviations. Nuisance parameters are
integrated out exactly (they are linear with Gaussian priors): r ~ N(m, C), C = I + F F^T, F (probe, factor) the
responses to the nuisances times their prior standard deviations.

    none      m = 0, or what the twin's own effects do, known but for their laws (`Observed.conditioned`)
    effect    m = m_e(s), s the strength, log-uniform over its plausible range; its law is off by a level and may leave a misfit in
              any families of probes (`discrepancy`), over which the evidence is averaged; what it does by chance is extra covariance
    pair      m = m_e(s) + m_f(t), each law off by a level of its own
    unknown   m = 0 and an extra variance in any number of families of probes; or like an effect of the catalogue, or like two, of
              any strength that is tried (what the twin has: of a plausible one), as far off as effects of other kinds are from the
              law that resembles them most
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...generator.effects import EFFECTS
from ..arrays import FloatArray
from ..model.curves import Curve
from .curve_fits import IN_FULL, CurveFit, fit_curve, interval_of, interval_of_any, log_mean_exp
from .discrepancy import FARTHEST_LEVEL, LEVELS, at_most_off, log_frequency, log_misfit, only
from .observed import Observed, Point
from .pairs import Pair, Single, log_odds_of_leak, log_odds_of_leak_in, log_prior, may_leave, weigh_pairs
from .unknown import LOG_DENSITY, ExtraVariance, Families, fit_extra_variance

UNKNOWN = "unknown_effect"
_NEAR = 10.0  # of log evidence: what lies so near to the likeliest, odds of 22,000, is looked at as that is
# the likeliest effects that are the first of a pair at least: with six the same are named (notebook, ablation)
_PAIRS_FROM = 2
_TURNS, _SETTLED = 6, 0.1  # in which laws and their misfit settle, and gain of log evidence that ends them


def title_of(effect: str) -> str:
    """An effect, or what is not in the catalogue, in words."""
    if effect == UNKNOWN:
        return "an effect that is not in the catalogue"
    return EFFECTS[effect].title if effect in EFFECTS else effect


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """One explanation and how probable it is."""

    effects: tuple[str, ...]  # ids; empty for none; `("unknown_effect",)` for an effect outside the catalogue
    probability: float
    log_evidence: float
    # best value and 95 % interval (value, low, high), by effect
    strengths: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    variants: Mapping[str, Curve] = field(default_factory=dict)  # by effect
    levels: Mapping[str, float] = field(default_factory=dict)  # of discrepancy, by effect
    location: str = ""  # probe group of an unknown effect
    misfit: str = ""  # the family in which laws leave most; empty: they leave nothing
    misfit_variance: FloatArray | None = None  # (probe,) of what they leave; None: nothing

    @property
    def of_catalogue(self) -> bool:
        """Whether it has effects, all of the catalogue."""
        return bool(self.effects) and self.effects != (UNKNOWN,)

    def point(self, effect: str) -> Point:
        """One of its effects at the strength of the best value."""
        return Point(
            curve=self.variants[effect], strength=self.strengths[effect][0], level=self.levels.get(effect, 0.0)
        )

    def points(self, *, but: str = "") -> list[Point]:
        """All its effects of the catalogue at these strengths; but: less this one."""
        return [self.point(effect) for effect in self.variants if effect != but]


@dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """Prior probabilities of the kinds of hypothesis, shared evenly within each kind; they need not sum to 1."""

    none: float = 0.35
    single: float = 0.40
    pair: float = 0.10
    unknown: float = 0.15


def weigh_hypotheses(
    seen: Sequence[tuple[Observed, Sequence[CurveFit]]],
    *,
    families: Families,
    priors: Priors | None = None,
    of_catalogue: int = 0,
    misfits: bool = True,
    beside: Sequence[Curve] = (),
) -> tuple[Hypothesis, ...]:
    """All hypotheses, most probable first; their probabilities sum to 1.

    An effect that the twin has is weighed like any other: a hypothesis that holds it has it at any strength, all others as strong as
    the twin.

    Args:
        seen: what is weighed, and the fits of each effect's curves, variants with equal prior, to it; several of these for several
            levels by which laws of the twin's own effects may be off, over which the evidence is averaged.
        families: of probes, in which an unknown effect may show.
        of_catalogue: number of effects that share the priors, those that cannot show here among them; at least those with fits.
        misfits: laws may leave a misfit; False: they may not, a first look at a third of the cost.
        beside: curves of effects as they respond beside another.
    """
    weighed: list[tuple[Hypothesis, float]] = []
    for observed, fits in seen:
        # one zero for all, and how often laws are off by so much
        zero = observed.conditioned().log_likelihood - seen[0][0].conditioned().log_likelihood
        zero += log_frequency(observed.given[0].level) if len(seen) > 1 else 0.0
        found = _weighed(observed, fits, families, priors or Priors(), of_catalogue, misfits, beside)
        weighed += [(replace(item, log_evidence=item.log_evidence + zero), prior) for item, prior in found]
    return _by_effects(weighed)


def _weighed(
    observed: Observed,
    fits: Sequence[CurveFit],
    families: Families,
    priors: Priors,
    of_catalogue: int,
    misfits: bool,
    beside: Sequence[Curve],
) -> list[tuple[Hypothesis, float]]:
    """All hypotheses with their log evidence over none, and the logarithms of their priors."""
    singles = _singles(fits)
    count = max(len(singles), of_catalogue, 1)
    ranked = sorted(singles, key=lambda effect: -singles[effect].log_evidence)
    # what is no likelier than none leaves nothing to others
    least = max(max((single.log_evidence for single in singles.values()), default=0.0) - _NEAR, 0.0)
    near = [effect for effect in ranked if singles[effect].log_evidence > least]
    left = Misfits(observed, families)
    none = left.none
    nothing = left.no_effect(misfits)
    weighed = [(nothing, math.log(priors.none))]
    of_single = math.log(priors.single / count)
    alike, like_two, whole = [], [], dict[str, _Settled]()
    for effect in ranked:
        single = singles[effect]
        found = _of_fits((effect,), {effect: single.best}, single.log_evidence)
        found = replace(found, strengths={effect: interval_of(single.fits)})
        own = _Settled(found, {effect: single.best}, observed)
        if misfits and effect in {*ranked[:IN_FULL], *near}:
            own, another = left.of_kind(own)
            alike.append(left.of_another(single, another))
            if own.hypothesis.misfit:
                own = own.of_variants(single.fits)
        weighed.append((own.hypothesis, of_single))
        whole[effect] = own
    of_given = _left_by_given(observed, whole)
    if of_given is not None:
        weighed.append((replace(nothing, log_evidence=of_given), math.log(priors.none)))
    leaks: dict[str, Hypothesis] = {}
    of_pair = math.log(priors.pair / max(count * (count - 1) // 2, 1))
    pairs = weigh_pairs(observed, singles, leading=max(_PAIRS_FROM, len(near)), beside=beside)
    least = max((pair.log_evidence for pair in pairs), default=0.0) - _NEAR
    for number, pair in enumerate(pairs):
        own = _Settled(_of_fits(pair.effects, pair.fits, pair.log_evidence), pair.fits, observed)
        if misfits and (number < IN_FULL or pair.log_evidence > least):
            own, another = left.of_kind(own)
            like_two.append(another.log_evidence)
        weighed.append((own.hypothesis, of_pair))
        alone = _of_the_stronger(own, pair, singles, families)
        if alone is not None:
            (strong,) = alone.effects
            if alone.log_evidence > leaks.get(strong, singles[strong]).log_evidence:
                leaks[strong] = alone
    weighed += [(item, of_single) for item in leaks.values()]
    of_one = float(np.logaddexp.reduce(alike)) - math.log(count)
    of_two = float(np.logaddexp.reduce(like_two)) - math.log(max(count * (count - 1) // 2, 1))
    # like none of the catalogue, like one or like two, each as likely
    evidence = float(np.logaddexp.reduce([none.log_evidence, of_one, of_two])) - math.log(3.0)
    unknown = Hypothesis(effects=(UNKNOWN,), probability=0.0, log_evidence=evidence, location=none.place)
    weighed.append((unknown, math.log(priors.unknown)))
    return weighed


def _of_the_stronger(
    own: "_Settled", pair: Pair, singles: Mapping[str, Single], families: Families
) -> Hypothesis | None:
    """The stronger of two effects alone, the weaker one being what its law leaves; None: the twin has that one, so it is there."""
    strong, leaves = log_odds_of_leak(own.observed, replace(pair, fits=own.fits), also_off=own.misfit_ratio)
    ((weak, fit),) = ((effect, fit) for effect, fit in own.fits.items() if effect != strong)
    if own.observed.has(weak):
        return None
    found = own.hypothesis
    # as it is once that is subtracted; what is left of it beyond doubt is a misfit
    shows = pair.log_evidence > singles[strong].log_evidence + _NEAR
    return replace(
        _of_fits((strong,), {strong: own.fits[strong]}, found.log_evidence + leaves),
        misfit=found.misfit or (_place_of(fit, families) if shows else ""),
        misfit_variance=found.misfit_variance,
    )


def _left_by_given(observed: Observed, weighed: Mapping[str, "_Settled"]) -> float | None:
    """Log evidence over none of what laws of the twin's own effects leave in the shape of another; None: the twin has none."""
    given = [point.effect for point in observed.given]
    others = [one for one in weighed if one not in given and any(may_leave(effect, one) for effect in given)]
    if not others:
        return None
    levels = [(1.0, at_most_off(observed.given[0].level))]
    without_misfit = observed.acting(observed.given)

    def evidence(effect: str) -> float:
        own = weighed[effect]
        acting = without_misfit if own.observed is observed else own.observed.acting(observed.given)
        return own.hypothesis.log_evidence + log_odds_of_leak_in(own.observed, own.fits[effect], acting, levels)

    return max(map(evidence, others))


def _by_effects(weighed: Sequence[tuple[Hypothesis, float]]) -> tuple[Hypothesis, ...]:
    """Hypotheses with log priors as probabilities, those with the same effects as one, most probable first.

    One stands as its likeliest does; the bounds of its strengths are those of all of them.
    """
    scores = np.array([item.log_evidence + prior for item, prior in weighed])
    shares = np.exp(scores - scores.max())
    shares /= shares.sum()
    alike: dict[tuple[str, ...], list[int]] = {}
    for number in np.argsort(-scores):
        alike.setdefault(weighed[number][0].effects, []).append(int(number))
    every = [_as_one([weighed[number][0] for number in own], shares[own]) for own in alike.values()]
    return tuple(sorted(every, key=lambda item: (-item.probability, -item.log_evidence)))


def _as_one(alike: Sequence[Hypothesis], shares: FloatArray) -> Hypothesis:
    """Hypotheses with the same effects, the likeliest first, as one; shares (hypothesis,): their probabilities."""
    first, probability = alike[0], float(np.sum(shares))
    if len(alike) == 1 or probability == 0.0:
        return replace(first, probability=probability)
    strengths = {
        effect: interval_of_any([item.strengths[effect] for item in alike], shares) for effect in first.strengths
    }
    return replace(first, probability=probability, strengths=strengths)


@dataclass(frozen=True, slots=True)
class _Settled:
    """A hypothesis, the fits of its effects where it is likeliest, and what they are fitted to: wider where there is a misfit."""

    hypothesis: Hypothesis
    fits: Mapping[str, CurveFit]  # by effect
    observed: Observed
    misfit_ratio: float = 0.0  # length of the misfit over that of what the laws do

    def of_variants(self, fits: Sequence[CurveFit]) -> "_Settled":
        """With the strength of its one effect as all variants that are weighed in full leave it open."""
        ((effect, found),) = self.fits.items()
        observed, levels = self.observed.conditioned(effect), only(found.level)
        again = [fit_curve(observed, fit.curve, levels=levels) for fit in fits if len(fit.by_level) > 1]
        return replace(self, hypothesis=replace(self.hypothesis, strengths={effect: interval_of(again)}))


class Misfits:
    """What laws leave beside effects, in families of probes."""

    def __init__(self, observed: Observed, families: Families) -> None:
        self._observed = observed
        self._families = families
        self.none = fit_extra_variance(observed.conditioned(), families)

    def no_effect(self, misfits: bool) -> Hypothesis:
        """What the twin has and nothing else; with `misfits` the laws of that may leave a misfit."""
        plain = Hypothesis(effects=(), probability=0.0, log_evidence=0.0)
        if not (misfits and self._observed.given):
            return plain
        return _either(plain, self.beside([]))

    def of_kind(self, weighed: "_Settled") -> tuple["_Settled", "OnlyLike"]:
        """A hypothesis whose laws may leave a misfit, from one without, and what is only like its effects."""
        first = self.beside(list(weighed.fits.values()))
        plain = weighed.hypothesis.log_evidence
        found = self.settled(first, plain)
        another = OnlyLike(plain=first.plain_of_another, with_misfit=max(first.of_another, found.of_another))
        hypothesis = _either(weighed.hypothesis, found)
        if not _shows(found, plain):
            return replace(weighed, hypothesis=hypothesis), another
        fits = {fit.curve.effect: fit for fit in found.fits}
        observed = self._observed.with_own_variance(found.misfit.variance)
        return _Settled(
            hypothesis, fits, observed, self.ratio([fit.point for fit in found.fits], found.misfit)
        ), another

    def settled(self, found: "BesideMisfit", plain: float) -> "BesideMisfit":
        """Effects and their misfit, each brought to what the other leaves of the probes, in turn: beside one a law may be nearer.

        plain: log evidence without a misfit; one that is less likely than none is left as it is.
        """
        for _ in range(_TURNS):
            if not _shows(found, plain):
                break
            turn = self.beside(self._fitted_beside(found))
            if turn.log_evidence < found.log_evidence + _SETTLED:
                break
            found = turn
        return found

    def beside(self, fits: Sequence[CurveFit]) -> "BesideMisfit":
        """Effects at the points of their fits, with a misfit."""
        points = [fit.point for fit in fits]
        evidence, found = self.in_presence_of(points)
        ratio = self.ratio(points, found)
        of_kind = evidence + self.prior(points, found) + log_misfit(ratio)
        of_another = evidence + self.prior(points, found, another=True) + log_misfit(ratio, another=True)
        return BesideMisfit(
            fits=tuple(fits),
            log_evidence=of_kind - LOG_DENSITY,
            of_another=of_another - LOG_DENSITY,
            plain_of_another=evidence - found.log_evidence + self.prior(points, another=True),
            misfit=found,
        )

    def _fitted_beside(self, found: "BesideMisfit") -> list[CurveFit]:
        """The effects fitted to what a misfit leaves of the probes, each beside the others."""
        fits = list(found.fits)
        observed = self._observed.conditioned(*(fit.curve.effect for fit in fits))
        observed = observed.with_own_variance(found.misfit.variance)
        for number, fit in enumerate(fits):
            beside = observed
            for other in fits:
                beside = beside if other is fit else beside.in_presence_of(other.point)
            levels = LEVELS if len(fits) == 1 else LEVELS.up_to(FARTHEST_LEVEL)
            fits[number] = replace(fit_curve(beside, fit.curve, levels=levels), share=fit.share)
        return fits

    def ratio(self, points: Sequence[Point], found: ExtraVariance) -> float:
        """Length of a misfit over that of what the laws beside it do, those of the twin's own effects among them."""
        named = {point.effect for point in points}
        acting = [*points, *(point for point in self._observed.given if point.effect not in named)]
        moved = math.hypot(*(self._observed.length(point.curve, point.strength) for point in acting))
        return found.length / max(moved, 1.0)

    def _any_strength(self, effect: str) -> bool:
        """Whether what is like an effect may have any strength: next to none of what the twin has is that effect gone."""
        return not self._observed.has(effect)

    def of_another(self, single: Single, another: "OnlyLike") -> float:
        """Log evidence over none of an effect that is only like one of the catalogue's: at all levels, with a misfit at two."""
        any_strength = self._any_strength(single.best.curve.effect)
        full = [fit for fit in single.fits if len(fit.by_level) > 1]
        plain = log_mean_exp([fit.of_another(any_strength=any_strength) for fit in full])
        farthest = self.beside([replace(single.best, level=LEVELS.levels[-1])])
        return OnlyLike(plain=plain, with_misfit=max(another.with_misfit, farthest.of_another)).log_evidence

    def in_presence_of(self, points: Sequence[Point]) -> tuple[float, ExtraVariance]:
        """Log evidence over none, without priors, of effects at their points with a misfit beside them, and what that misfit is."""
        effects = [point.effect for point in points]
        alone = beside = self._observed.conditioned(*effects)
        for point in points:
            beside = beside.in_presence_of(point)
        acting = {*effects, *(point.effect for point in self._observed.given)}
        found = fit_extra_variance(beside, self._families, left_by=acting)
        evidence = self._observed.log_evidence_without(*effects) + beside.log_likelihood - alone.log_likelihood
        return evidence + found.log_evidence, found

    def prior(self, points: Sequence[Point], misfit: ExtraVariance | None = None, *, another: bool = False) -> float:
        """Log of what effects at their points, beside a misfit, take of the prior; another: of what is only like them."""
        alone = self._observed.conditioned(*(point.effect for point in points))
        if misfit is not None:
            alone = alone.with_own_variance(misfit.variance)
        total = 0.0
        for point in points:
            others = alone
            for other in points:
                others = others if other is point else others.in_presence_of(other)
            any_strength = another and self._any_strength(point.effect)
            total += log_prior(others, point, another=another, any_strength=any_strength)
        return total


@dataclass(frozen=True, slots=True, kw_only=True)
class OnlyLike:
    """Log evidence over none of what is only like effects of the catalogue: without a misfit, and with one."""

    plain: float
    with_misfit: float

    @property
    def log_evidence(self) -> float:
        """Of both, as often as such a law leaves a misfit."""
        share = LEVELS.misfit_of_another
        return float(np.logaddexp(self.plain + math.log1p(-share), self.with_misfit + math.log(share)))


@dataclass(frozen=True, slots=True, kw_only=True)
class BesideMisfit:
    """Effects whose laws leave a misfit; log evidences are over none."""

    fits: tuple[CurveFit, ...]  # one an effect
    log_evidence: float
    of_another: float  # of what is only like these effects
    plain_of_another: float  # of that without a misfit
    misfit: ExtraVariance


def _of_kind(plain: float, found: BesideMisfit) -> tuple[float, float]:
    """Log evidence of a law without a misfit and with the one that was found, as often as each occurs."""
    share = LEVELS.misfit_of_kind
    return plain + math.log1p(-share), found.log_evidence + math.log(share)


def _shows(found: BesideMisfit, plain: float) -> bool:
    """Whether a misfit is likelier than none."""
    without, with_misfit = _of_kind(plain, found)
    return with_misfit > without


def _either(hypothesis: Hypothesis, found: BesideMisfit) -> Hypothesis:
    """A hypothesis whose laws may leave a misfit: as it is without one, or with one, whichever is likelier."""
    evidence = float(np.logaddexp(*_of_kind(hypothesis.log_evidence, found)))
    if not _shows(found, hypothesis.log_evidence):
        return replace(hypothesis, log_evidence=evidence)
    return replace(
        hypothesis,
        log_evidence=evidence,
        strengths={fit.curve.effect: interval_of([fit]) for fit in found.fits},
        levels={fit.curve.effect: fit.level for fit in found.fits},
        misfit=found.misfit.place,
        misfit_variance=found.misfit.variance,
    )


def _place_of(fit: CurveFit, families: Families) -> str:
    """The family of probes that an effect moves most."""
    moved = np.bincount(families.of, weights=fit.curve.response(fit.best) ** 2, minlength=len(families.names))
    return families.names[int(np.argmax(moved))]


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
    return {effect: Single.of(own) for effect, own in by_effect.items()}

"""What a session's probes say: which hypothesis explains the gap, how well its laws fit, and what to measure next."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...generator.effects import EFFECTS, AppliedEffect
from ...generator.line.twin import Twin
from ..advice.next_series import best_measurement
from ..advice.plan import advice_text, best_repeat
from ..arrays import BoolArray, FloatArray
from ..inference.curve_fits import CurveFit, fit_effects
from ..inference.discrepancy import FARTHEST_LEVEL, LEVELS, law_terms
from ..inference.in_series import in_some_series
from ..inference.inference import UNKNOWN, Hypothesis, title_of, weigh_hypotheses
from ..inference.inner_parameters import with_inner_open
from ..inference.nuisances import LocalNuisances, Nuisances, Whitening
from ..inference.observed import Observed
from ..inference.refine import SEEN_FROM, refine
from ..inference.steady import Steady
from ..model.changes import EACH_SCENE, Variant
from ..model.curves import LEAST_RESPONSE, Curve
from ..problem.problem import Problem
from .answer import NO_GAP_FROM, Cause, Diagnosis, Place, improved
from .held_out import MOST, held_out
from .strengths import applied_at_best, strength_of

EXPLAINED_FROM = 0.6  # probability of an effect (over all hypotheses) from which it is named as the explanation
_TIED_HOLD = 0.9  # probability that the hypotheses which are tied hold together, none and an unknown effect counted
_WORST_PLACES = 30
_WORTH_LISTING = 0.02  # probability of an effect that is neither named nor tied
STRAINED_FROM = 5.0  # prior standard deviations
_OF_RENDERING = ("rough edge", "edges,", "outline of", "gain map", "texture")  # nuisances that nobody can look up


def judge(
    problem: Problem, twin: Twin, *, rng: np.random.Generator, progress: Callable[[str], None] | None = None
) -> Diagnosis:
    """The answer to an assembled problem."""
    tell = progress or (lambda stage: None)
    weighed = weigh_problem(problem, tell=tell)
    problem = weighed.problem
    nuisances = LocalNuisances(problem.factors, problem.blocks)
    verdict = verdict_of(weighed.hypotheses)
    tell("held-out data")
    gap, by_axis, shares = held_out(problem, verdict.leading, rng)
    leading, named = verdict.leading, verdict.named
    likeliest = _likeliest_known(problem, verdict, rng)
    marginal = _by_effect(verdict.hypotheses)
    # what acts in some series alone is nothing that the line has
    lasting = [effect for effect in named if not leading.variants[effect].variant.series]
    added = tuple(applied_at_best(problem, leading, effect) for effect in lasting)
    as_read = replace(leading, strengths={effect: strength_of(problem, leading, effect) for effect in leading.variants})
    ambiguous = verdict.word == "ambiguous"
    return Diagnosis(
        verdict="explained_in_part" if verdict.word == "explained" and not gap.explained else verdict.word,
        hypotheses=verdict.hypotheses,
        causes=_causes(problem, verdict, shares | likeliest, _places_left(problem, as_read)),
        probability_no_gap=next((item.probability for item in verdict.hypotheses if not item.effects), 0.0),
        probability_unknown=marginal.get(UNKNOWN, 0.0),
        unknown_location=next((item.location for item in verdict.hypotheses if item.effects == (UNKNOWN,)), ""),
        where=_places(problem, np.where(_acted_on(problem, leading), nuisances.given_others(problem.residual), 0.0)),
        threshold_z=_threshold(len(problem.residual)),
        gap=gap,
        held_out=by_axis,
        ambiguous_with=_indistinct(verdict.tied) if ambiguous else (),
        next_measurement=_next_measurement(problem, verdict.tied, rng) if ambiguous else None,
        twin=improved(twin, added),
        added=added,
        named=named,
        problem=problem,
        warnings=tuple(problem.skipped),
        notes=(*_beyond_plausible(leading), *_of_another_strength(problem, verdict), *_in_some(leading)),
        not_tested=weighed.out_of_reach,
        strained=_strained(problem, leading, nuisances),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Weighed:
    """Hypotheses, most probable first, and what they were weighed with."""

    problem: Problem  # with what was refined
    hypotheses: tuple[Hypothesis, ...]
    out_of_reach: dict[str, str]  # effects that it could not show, and why
    observed: Observed  # whitened
    fits: Sequence[CurveFit]  # of every curve to it


def weigh_problem(problem: Problem, *, tell: Callable[[str], None] = lambda stage: None) -> Weighed:
    """All hypotheses against the whitened probes, twice: inner parameters are refined for the likely ones."""
    tell("hypotheses")
    whitening, observed, whitened = _whitened(problem)
    fits = fit_effects(observed, whitened)
    for effect in (effect for effect, entry in EFFECTS.items() if entry.in_some_series and not observed.has(effect)):
        of_effect = [fit for fit in fits if fit.curve.effect == effect]
        part = in_some_series(observed.conditioned(), of_effect, problem.series_of)
        if part is not None:
            problem = problem.in_series(part.variant, part.series, part.log_prior)
    problem = problem.with_scenes_apart()
    more = whitening.curves(problem.curves[len(whitened) :])
    whitened, fits = (*whitened, *more), [*fits, *fit_effects(observed, more)]

    def weigh(seen: Sequence[tuple[Observed, Sequence[CurveFit]]], *, misfits: bool) -> tuple[Hypothesis, ...]:
        return weigh_hypotheses(
            seen,
            families=problem.families,
            of_catalogue=len(EFFECTS),
            misfits=misfits,
            beside=[curve for curve in whitened if curve.variant.beside is not None],
        )

    first = weigh([(observed, fits)], misfits=False)
    likeliest = _likeliest(first)
    if likeliest is not None:
        tell("nuisances beside the likeliest explanation")
        problem = problem.with_nuisances_beside(_applied_everywhere(likeliest))
        whitening, observed, whitened = _whitened(problem)
        first = _with_curves(first, whitened)
    tell("refinement")
    closer = refine(
        first,
        curves=whitened,
        observed=observed,
        respond=problem.respond,
        whitening=whitening,
        blocks=problem.asked_in_blocks,
    )
    problem = problem.with_variants(closer)
    whitened = (*whitened, *whitening.curves(problem.curves[len(whitened) :]))
    alone = [curve for curve in whitened if curve.variant.beside is None]
    fits = fit_effects(observed, alone)
    nearer = _likeliest(weigh([(observed, fits)], misfits=False)) if closer else None
    if nearer is not None:
        tell("nuisances beside it, as refinement found it")
        problem = problem.with_nuisances_beside(_applied_everywhere(nearer))
        whitening, observed, whitened = _whitened(problem)
        alone = [curve for curve in whitened if curve.variant.beside is None]
        fits = fit_effects(observed, alone)
    tell("all hypotheses")
    seen = [(observed, fits)]
    if observed.given:
        levels = [observed.off_by(level) for level in LEVELS.up_to(FARTHEST_LEVEL).levels]
        seen = [(one, fit_effects(one, alone)) for one in levels]
    hypotheses = weigh(seen, misfits=True)
    hypotheses = tuple(
        with_inner_open(item, observed=observed, respond=problem.respond, whitening=whitening)
        if item.probability > _WORTH_LISTING
        else item
        for item in hypotheses
    )
    problem = problem.released()
    return Weighed(
        problem=problem,
        hypotheses=_with_curves(hypotheses, problem.curves),
        out_of_reach=_out_of_reach(problem, whitened, observed),
        observed=observed,
        fits=fits,
    )


def _likeliest(hypotheses: Sequence[Hypothesis]) -> Hypothesis | None:
    """The likeliest with effects of the catalogue, where it explains anything."""
    known = next((item for item in hypotheses if item.of_catalogue), None)
    return known if known is not None and known.log_evidence > 0.0 else None


def _whitened(problem: Problem) -> tuple[Whitening, Observed, tuple[Curve, ...]]:
    """A problem's probes and curves with nuisances of single series integrated out."""
    whitening = Whitening(problem.factors, problem.blocks)
    had = [point.effect for point in problem.given]
    given = whitening.curves([point.curve for point in problem.given])
    observed = Observed(
        residual=whitening.apply(problem.residual_without(had)[None, :])[0],
        nuisances=Nuisances(whitening.factors),
        groups=problem.groups,
        series=problem.left_apart,
        aspects=problem.aspects,
        steady=Steady(problem.curves, problem.alike, whitening),
        places=problem.places,
        given=tuple(replace(point, curve=curve) for point, curve in zip(problem.given, given, strict=True)),
    )
    return whitening, observed, whitening.curves(problem.curves)


def _with_curves(hypotheses: Sequence[Hypothesis], curves: Sequence[Curve]) -> tuple[Hypothesis, ...]:
    """Hypotheses with the curves of the same variants."""

    def own(variant: Variant) -> Curve:
        return next(curve for curve in curves if curve.variant == variant)

    return tuple(
        replace(item, variants={name: own(curve.variant) for name, curve in item.variants.items()})
        for item in hypotheses
    )


def _applied_everywhere(hypothesis: Hypothesis) -> list[AppliedEffect]:
    """The effects of a hypothesis as they fit best, less those that act in some series only."""
    return [
        point.curve.variant.applied(point.strength) for point in hypothesis.points() if not point.curve.variant.series
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """One of VERDICTS, all hypotheses, the one that leads, and those that are tied with it."""

    word: str
    hypotheses: tuple[Hypothesis, ...]
    leading: Hypothesis
    tied: tuple[Hypothesis, ...] = ()

    @property
    def named(self) -> tuple[str, ...]:
        """Effects of the leading hypothesis; none where it is the unknown one."""
        return self.leading.effects if self.leading.of_catalogue else ()


def verdict_of(hypotheses: tuple[Hypothesis, ...]) -> Verdict:
    """What hypotheses, most probable first, amount to before held-out data are asked."""
    # an effect that nearly every likely hypothesis holds is named, whatever companions it is offered with
    core = {effect for effect, value in _by_effect(hypotheses).items() if effect != UNKNOWN and value >= EXPLAINED_FROM}
    leading = next((item for item in hypotheses if core and set(item.effects) == core), hypotheses[0])
    tied: list[Hypothesis] = []
    if not leading.effects and leading.probability >= NO_GAP_FROM:
        word = "no_gap"
    elif leading.effects == (UNKNOWN,):
        word = "unknown_effect"
    elif core and core == set(leading.effects):
        word = "explained_in_part" if leading.misfit else "explained"
    else:
        word, total = "ambiguous", 0.0
        for item in hypotheses:
            if item.of_catalogue:
                tied.append(item)
            total += item.probability
            if total > _TIED_HOLD:
                break
    return Verdict(word=word, hypotheses=hypotheses, leading=leading, tied=tuple(tied))


def _indistinct(tied: Sequence[Hypothesis]) -> tuple[tuple[str, str], ...]:
    """Pairs of effects of which one stands in the other's place in hypotheses that are tied."""
    return tuple(
        sorted(
            {
                (min(a, b), max(a, b))
                for first in tied
                for second in tied
                for a in first.effects
                for b in second.effects
                if a != b
                and not (set(first.effects) <= set(second.effects) or set(second.effects) <= set(first.effects))
            }
        )
    )


def _likeliest_known(
    problem: Problem, verdict: Verdict, rng: np.random.Generator
) -> dict[str, tuple[float, float, float]]:
    """How far the likeliest effect of the catalogue shrinks the gap, if by most of it and an unknown one is likelier; else empty."""
    known = next((item for item in verdict.hypotheses if len(item.effects) == 1 and item.of_catalogue), None)
    if verdict.word != "unknown_effect" or known is None:
        return {}
    return {effect: found for effect, found in held_out(problem, known, rng)[2].items() if found[0] > MOST}


def _causes(
    problem: Problem, verdict: Verdict, shares: Mapping[str, tuple[float, float, float] | None], left: tuple[Place, ...]
) -> tuple[Cause, ...]:
    """Effects that are named, tied or not out of the question, or whose `shares` of the gap are known, most probable first."""
    marginal = _by_effect(verdict.hypotheses)
    marginal.pop(UNKNOWN, None)
    named = verdict.named
    listed = {*named, *(effect for item in verdict.tied for effect in item.effects)}
    order = [*named, *sorted((item for item in marginal if item not in named), key=lambda item: -marginal[item])]
    causes = []
    for effect in order:
        if effect not in listed and marginal[effect] < _WORTH_LISTING and effect not in shares:
            continue
        # of what is named, as it stands in the explanation that leads
        best = next(item for item in (verdict.leading, *verdict.hypotheses) if effect in item.effects)
        variant = best.variants[effect].variant
        causes.append(
            Cause(
                effect=effect,
                probability=min(marginal[effect], 1.0),
                strength=_signed(variant.sign, strength_of(problem, best, effect)),
                unit=EFFECTS[effect].strength.unit,
                parameters=dict(variant.parameters),
                since=variant.since,
                series=variant.series,
                apart=variant.apart,
                shrinks_by=shares.get(effect),
                level=best.levels.get(effect, 0.0),
                left=left if effect in named else (),
            )
        )
    return tuple(sorted(causes, key=lambda item: -item.probability))


def _signed(sign: float, strength: tuple[float, float, float]) -> tuple[float, float, float]:
    """Value, low and high of a strength with the sign of its variant."""
    value, low, high = (sign * one for one in strength)
    return value, min(low, high), max(low, high)


def _places_left(problem: Problem, leading: Hypothesis) -> tuple[Place, ...]:
    """Probes that depart with what is named added, beyond what that does by chance."""
    factors, variance = problem.with_chance(leading.points())
    root = np.sqrt(variance)
    nuisances = LocalNuisances(factors / root[:, None], problem.blocks)
    return _places(problem, nuisances.given_others(problem.left_by(leading.points()) / root))


def _acted_on(problem: Problem, leading: Hypothesis) -> BoolArray:
    """Probes (probe,) of series in which what is named does anything; all of them where nothing is named.

    What began since calibration parts the series before from those after, and each lies off if the others are believed.
    """
    if not leading.of_catalogue:
        return np.ones(len(problem.residual), dtype=bool)
    moved = np.zeros(len(problem.residual))
    for point in leading.points():
        curve = point.curve
        by_chance = point.strength * np.sqrt(
            np.sum(curve.chance**2, axis=1) + (0.0 if curve.jitter is None else curve.jitter)
        )
        moved += np.abs(curve.response(point.strength)) + by_chance
    acts = np.bincount(problem.series_of, weights=moved > LEAST_RESPONSE) > 0
    return np.asarray(acts[problem.series_of])


def _places(problem: Problem, z: FloatArray) -> tuple[Place, ...]:
    """Probes whose z (probe,), once the nuisances took their part, lies beyond `_threshold`, the farthest first."""
    threshold = _threshold(len(problem.residual))
    return tuple(
        Place(
            axis=problem.names[index].axis,
            series=problem.views[problem.series_of[index]].session.name,
            statistic=problem.names[index].statistic,
            location=problem.names[index].location,
            unit=problem.names[index].unit,
            z=float(z[index]),
        )
        for index in np.argsort(-np.abs(z))[:_WORST_PLACES]
        if abs(z[index]) > threshold
    )


def _by_effect(hypotheses: Sequence[Hypothesis]) -> dict[str, float]:
    """Probability of each effect over all hypotheses that hold it."""
    result: dict[str, float] = {}
    for hypothesis in hypotheses:
        for effect in hypothesis.effects:
            result[effect] = result.get(effect, 0.0) + hypothesis.probability
    return result


def _beyond_plausible(leading: Hypothesis) -> tuple[str, ...]:
    """What to say of effects that are weaker or stronger than their plausible range."""
    notes = []
    for point in leading.points():
        known, variant = EFFECTS[point.effect].strength, point.curve.variant
        if not variant.low <= point.strength <= variant.high:
            side = "weaker" if point.strength < variant.low else "stronger"
            notes.append(
                f"{title_of(point.effect)}: {side} than what is plausible as a rule ({known.low:g} to {known.high:g} {known.unit});"
                " such a strength was given little weight beforehand"
            )
    return tuple(notes)


def _of_another_strength(problem: Problem, verdict: Verdict) -> tuple[str, ...]:
    """What to say of effects that the twin has and that are named: how strong the session shows them."""
    notes = []
    for point in problem.given:
        effect = point.effect
        if effect in verdict.named:
            value, low, high = (one / point.strength for one in strength_of(problem, verdict.leading, effect))
            notes.append(
                f"the twin has {effect}, and this session shows {value:.2f} ({low:.2f} to {high:.2f}) times as much of it"
            )
    return tuple(notes)


def _in_some(leading: Hypothesis) -> tuple[str, ...]:
    """What to say of effects that act in some series only, or in each scene by itself."""
    return tuple(
        f"{title_of(effect)}, {EACH_SCENE}: the improved twin is left without it"
        if curve.variant.apart
        else f"{title_of(effect)} acts in {', '.join(curve.variant.series)} only: the improved twin is left without it"
        for effect, curve in leading.variants.items()
        if curve.variant.series
    )


def _strained(problem: Problem, leading: Hypothesis, nuisances: LocalNuisances) -> tuple[tuple[str, float], ...]:
    """Nuisances that lie far from what is known of them, once the leading explanation is taken off."""
    left = problem.left_by(leading.points())
    if problem.given:
        # what laws of the twin's own effects leave is none of these
        laws = [law_terms(one.curve, one.strength, problem.groups, problem.places, one.level) for one in problem.given]
        root = np.sqrt(1.0 + sum(own for _, own in laws))
        factors = np.concatenate([problem.factors, *(law for law, _ in laws)], axis=1)
        nuisances, left = LocalNuisances(factors / root[:, None], problem.blocks), left / root
    found = zip(problem.factor_names, nuisances.fitted(left), strict=False)
    far = [
        (name, float(value))
        for name, value in found
        if abs(value) > STRAINED_FROM and not name.startswith(_OF_RENDERING)
    ]
    return tuple(sorted(far, key=lambda item: -abs(item[1])))


def _out_of_reach(problem: Problem, curves: Sequence[Curve], observed: Observed) -> dict[str, str]:
    """Effects that the session could not show at their largest plausible strength, each with the reason."""
    farthest: dict[str, tuple[float, float]] = {}
    for curve in curves:
        high = curve.variant.high
        length = observed.length(curve, high)
        if length >= farthest.get(curve.effect, (-1.0, 0.0))[0]:
            farthest[curve.effect] = (length, high)
    found = dict(problem.missing_effects)
    for effect, (length, high) in farthest.items():
        if length < SEEN_FROM:
            strength = EFFECTS[effect].strength
            found[effect] = (
                f"at {high * strength.pixels_per_bin(problem.side):g} {strength.unit}, the largest plausible, it would lie"
                f" {length:.1f} standard deviations from nothing in these series"
            )
    return {effect: found[effect] for effect in EFFECTS if effect in found}


def _next_measurement(
    problem: Problem, tied: Sequence[Hypothesis], rng: np.random.Generator
) -> Mapping[str, Any] | None:
    """What distinguishes the two likeliest explanations: a series taken again where that settles it, else a new one."""
    if len(tied) < 2:
        return None
    first, second = ([item.point(effect) for effect in item.effects] for item in tied[:2])
    repeat = best_repeat(problem, first, second)
    new = None if repeat is not None and repeat.settles else best_measurement(problem, first, second, rng=rng)
    proposals = [item for item in (repeat, new) if item is not None]
    if not proposals:
        return None
    best = next((item for item in proposals if item.settles), proposals[0])
    lately = all(point.curve.variant.since == "calibration" for point in (*first, *second))
    answer: dict[str, Any] = {
        "separates": sorted({*tied[0].effects, *tied[1].effects}),
        "text": advice_text(proposals, tied[0].effects, tied[1].effects, lately=lately),
        "separation": best.separation,
        "separation_then": best.separation_then,
    }
    if best.series:
        return answer | {"series": best.series}
    return answer | {"measurement": best.name, "measure": list(best.measured)}


def _threshold(probes: int) -> float:
    """The |z| that the largest of so many Gaussian probes, however correlated, exceeds in at most 5 % of sessions without a gap.

    Source: Sidak (1967), doi:10.1080/01621459.1967.10482935.
    """
    from scipy.special import ndtri

    return float(-ndtri(0.5 * (1.0 - 0.95 ** (1.0 / probes))))

"""Where the gap between a session and its twin lies, which effect explains it, and how far it shrinks."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile
from ..errors import InputError
from ..generator.effects import EFFECTS, AppliedEffect
from ..generator.twin import Twin
from .assemble import Problem, build_problem
from .changes import catalogue_variants
from .coarse import UNSEEN, in_pixels
from .curve_fits import CurveFit, fit_curve
from .curves import Curve
from .forward_model import can_displace, can_show, can_stand_out
from .held_out import Gap, held_out
from .inference import UNKNOWN, Hypothesis, Priors, weigh_hypotheses
from .known_effects import already_there, with_found
from .local_nuisances import LocalNuisances
from .next_series import best_measurement, proposal_text
from .nuisances import Nuisances
from .pairs import Doubts
from .plan import WORTH_IT, best_repeat, repeat_text
from .preparation import calibrated_twin, mislabelled, prepare_session
from .probes import ALONG_COLUMNS, ALONG_ROWS, OUTLIERS, OUTLIERS_ANYWHERE
from .readings import Suspect
from .refine import refine
from .registration import SHARP_PX
from .strengths import applied_at_best, strength_of
from .unknown import unknown_evidence
from .veto import is_refused, vetoed, with_doubt
from .whitening import Whitening

VERDICTS = ("no_gap", "explained", "ambiguous", "unknown_effect")
EXPLAINED_FROM = 0.6  # probability of an effect (over all hypotheses) from which it is named as the explanation
POWER = 0.8  # sessions without effect showed evidences of 1-4 for the weakest effects, where 0-2 would be chance
_WORST_PLACES = 30
SEEN_FROM = 3.0  # standard deviations that an effect must be able to reach for the session to test it
STRAINED_FROM = 5.0  # prior standard deviations
_OF_RENDERING = ("rough edge", "edges,", "outline of", "gain map", "texture")  # nuisances that nobody can look up
# log evidence: of 64 sealed sessions without effect six showed 4 to 8 of a focal spot, edges being drawn no better
_CHANCE = {"focal_spot": 5.0}
# the same where edges are sharper than a third of a pixel, as in squares of pixels: two panels without effect showed 6 of a tail
# and 77 of a focal spot of 0.47 mm, one with a spot of 0.6 mm showed 107
_SHARP_CHANCE = {
    **dict.fromkeys(("mtf_tail", "motion_blur", "misregistration", "k_fluorescence"), 8.0),
    "focal_spot": 80.0,
}
# photons followed one by one reach shadows that no kernel fills: as a rule up to 3e-3 of scatter's log evidence goes to another
# effect, 0.016 where 40 % of scatter filled a wide field
_LOOSE = {"object_scatter": 0.02}
# beside 16 scatters of 3 to 40 % alone these gained nothing (a focal spot 2, once 350 of an evidence of 1.5e7), a dark drift up to
# 3e-3 of scatter's evidence, a tail, K fluorescence and a lag 3e-4
_SHARP = frozenset(("motion_blur", "misregistration", "focal_spot"))
# traps are more than a law of two knows: in eight sessions with lags of 0.5-4 % alone a dark drift gained up to 4e-5 of lag's
# evidence, beside three since the calibration 4e-4, 5e-4 and 2.5e-3
_LEFT = {("image_lag", "always"): (2e-4, 1.8e-3), ("image_lag", "calibration"): (1e-3, 9e-3)}
# pixels and codes of their own tell these: a gain map of 0.127 % read 0.097 beside a voltage of 4.8 %
_TOLD = frozenset(("gain_map_error", "bad_pixels", "quantisation"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """An effect, how probable it is, its strength and inner parameters, and how far the gap shrinks with it."""

    effect: str
    probability: float
    strength: tuple[float, float, float]
    unit: str
    parameters: Mapping[str, float]
    sign: float
    since: str
    shrinks_by: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A probe that departs from the twin: axis, series, statistic, location, unit; z after the nuisances took their part."""

    axis: str
    series: str
    statistic: str
    location: str
    unit: str
    z: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """The answer; `named` are the effects of the leading hypothesis, `twin` is the twin with them added.

    notes: how the session was looked at, where that limits the answer. strained: nuisances that what is left pulls beyond
    STRAINED_FROM of their standard deviations, and how far, the farthest first.
    mislabelled: series whose labels look wrong; no effect is named then. not_tested: effects that these series could not
    show, each with the reason.
    """

    verdict: str
    hypotheses: tuple[Hypothesis, ...]
    causes: tuple[Cause, ...]
    probability_no_gap: float
    probability_unknown: float
    unknown_location: str
    where: tuple[Place, ...]
    threshold_z: float
    gap: Gap
    held_out: tuple[tuple[str, float, float, float], ...]
    ambiguous_with: tuple[tuple[str, str], ...]
    next_measurement: Mapping[str, Any] | None
    twin: Twin
    added: tuple[AppliedEffect, ...]
    named: tuple[str, ...]
    problem: Problem = field(repr=False)
    warnings: tuple[str, ...] = ()
    mislabelled: tuple[Suspect, ...] = ()
    not_tested: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    strained: tuple[tuple[str, float], ...] = ()


def diagnose(
    acquisition: AcquisitionFile,
    *,
    twin: Twin | None = None,
    rng: np.random.Generator,
    without: Sequence[str] = (),
    priors: Priors | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Diagnose a session.

    Args:
        acquisition: open acquisition file, anything from two flats with darks to the full protocol; without a given twin,
            frames of more than LARGEST_PIXELS are compared as means of squares of pixels.
        twin: calibrated elsewhere; absent, the session's own calibrating series make it. Effects that it has are part of what is
            expected: the gap is what they leave.
        rng: source of randomness.
        without: effects to leave out of the catalogue.
        priors: probabilities of the kinds of hypothesis before looking.
        progress: called with the name of each stage.

    Raises:
        InputError: nothing in the session can be judged.
    """
    session = prepare_session(acquisition, twin=twin, rng=rng, progress=progress)
    had = already_there(session.twin.effects)
    left_out = (*without, *had, *(UNSEEN if session.factor > 1 else ()))

    try:
        problem = build_problem(
            session.acquisition,
            session.twin,
            variants=catalogue_variants(without=left_out, side=session.factor),
            calibrated_elsewhere=session.calibrated_elsewhere,
            exposed=session.exposed,
            ends_at_zero=session.ends_at_zero,
            spectral_point=session.spectral_point,
            side=session.factor,
            progress=progress,
        )
    except InputError as error:
        if session.suspects:
            raise mislabelled(acquisition, session.suspects) from error
        raise
    result = judge(problem, session.twin, rng=rng, priors=priors, progress=progress)
    result = replace(result, warnings=(*session.left_out, *result.warnings), notes=(*session.notes, *result.notes))
    result = replace(result, not_tested={**had, **result.not_tested})
    cleared = [item for item in session.suspects if _clears(result, item)]
    notes = tuple(
        f"{item.text}, or with {' and '.join(result.named)}, which explains the rest as well" for item in cleared
    )
    result = replace(result, notes=(*result.notes, *notes))
    suspects = tuple(item for item in session.suspects if item not in cleared)
    if suspects:
        result = _doubted(result, session.twin, suspects)
    if session.factor == 1:
        return result
    if progress is not None:
        progress("calibration with all pixels")
    return in_pixels(result, twin=calibrated_twin(session.all_pixels, rng=rng), factor=session.factor)


def _clears(diagnosis: Diagnosis, suspect: Suspect) -> bool:
    """Whether an explanation of the whole session says why a label looks wrong."""
    return diagnosis.verdict == "explained" and not set(suspect.or_effects).isdisjoint(diagnosis.named)


def _doubted(diagnosis: Diagnosis, twin: Twin, suspects: tuple[Suspect, ...]) -> Diagnosis:
    """The diagnosis of a session whose labels look wrong: no effect is named, whatever the frames would say under them."""
    known = {item.effects for item in diagnosis.hypotheses}
    hypotheses = [
        replace(item, probability=1.0 if item.effects == (UNKNOWN,) else 0.0) for item in diagnosis.hypotheses
    ]
    if (UNKNOWN,) not in known:
        hypotheses.append(Hypothesis(effects=(UNKNOWN,), probability=1.0, log_evidence=0.0))
    return replace(
        diagnosis,
        verdict="unknown_effect",
        hypotheses=tuple(sorted(hypotheses, key=lambda item: -item.probability)),
        causes=(),
        probability_no_gap=0.0,
        probability_unknown=1.0,
        unknown_location="labels of the series",
        gap=replace(diagnosis.gap, after=diagnosis.gap.before, shrinks_by=None),
        held_out=tuple((axis, before, before, floor) for axis, before, _, floor in diagnosis.held_out),
        ambiguous_with=(),
        next_measurement=None,
        twin=twin,
        added=(),
        named=(),
        warnings=(*(item.text for item in suspects), *diagnosis.warnings),
        mislabelled=suspects,
    )


def _out_of_reach(problem: Problem, curves: Sequence[Curve], nuisances: Nuisances) -> dict[str, str]:
    """Effects that the session could not show at their largest plausible strength, each with the reason."""
    farthest: dict[str, tuple[float, float]] = {}
    for curve in curves:
        response = curve.response(curve.high)[None, :]
        if curve.by_chance_alone and curve.spread is not None:
            response = curve.high * curve.spread.T
        length = math.sqrt(max(float(np.trace(nuisances.inner(response, response))), 0.0))
        if length >= farthest.get(curve.effect, (-1.0, 0.0))[0]:
            farthest[curve.effect] = (length, curve.high)
    found = dict(problem.missing_effects)
    for effect, (length, high) in farthest.items():
        if length < SEEN_FROM:
            found[effect] = (
                f"at {high:g} {EFFECTS[effect].strength.unit}, the largest plausible, it would lie {length:.1f} standard"
                " deviations from nothing in these series"
            )
    return {effect: found[effect] for effect in EFFECTS if effect in found}


def _elsewhere(problem: Problem) -> dict[str, NDArray[np.bool_]]:
    """Probes (probe,) that each effect cannot move, however wrong its law, by effect."""
    of_places = np.array([name.statistic in (ALONG_ROWS, ALONG_COLUMNS) for name in problem.names])
    of_outliers = np.array([name.statistic in (OUTLIERS, OUTLIERS_ANYWHERE) for name in problem.names])
    result = {}
    for effect in {variant.effect for variant in problem.variants}:
        hidden = np.array([not can_show(effect, view.session.request) for view in problem.views], dtype=bool)
        result[effect] = (
            hidden[problem.series_of]
            | (of_places & (not can_displace(effect)))
            | (of_outliers & (not can_stand_out(effect)))
        )
    return result


def judge(
    problem: Problem,
    twin: Twin,
    *,
    rng: np.random.Generator,
    priors: Priors | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """The answer to an assembled problem."""
    tell = progress or (lambda stage: None)
    tell("hypotheses")
    nuisances = LocalNuisances(problem.factors, problem.blocks)
    whitening = Whitening(problem.factors, problem.blocks)
    residual = whitening.apply(problem.residual[None, :])[0]
    shared = Nuisances(whitening.factors)

    probe_places = problem.places

    def fitted(curves: Sequence[Curve]) -> tuple[CurveFit, ...]:
        return tuple(fit_curve(residual, curve, shared, problem.groups, places=probe_places) for curve in curves)

    sharp = problem.base.noise.psf_sigma_px.value < SHARP_PX
    chance = _SHARP_CHANCE if sharp else _CHANCE
    unknown = unknown_evidence(residual, shared, problem.parts, problem.part_names)
    doubts = Doubts(chance=chance, loose=_LOOSE, sharp=_SHARP, left=_LEFT, told=_TOLD, elsewhere=_elsewhere(problem))

    def weigh(curves: Sequence[Curve], fits: Sequence[CurveFit]) -> tuple[Hypothesis, ...]:
        return weigh_hypotheses(
            residual,
            curves=curves,
            nuisances=shared,
            groups=problem.groups,
            group_names=problem.group_names,
            unknown_groups=problem.parts,
            unknown_names=problem.part_names,
            priors=priors or Priors(),
            power=POWER,
            doubts=doubts,
            places=probe_places,
            fits=fits,
            unknown=unknown,
        )

    whitened = whitening.curves(problem.curves)
    fits = fitted(whitened)
    hypotheses = weigh(whitened, fits)
    tell("refinement")
    closer = refine(
        hypotheses,
        variants={(item.effect, item.name): item for item in problem.variants},
        curves=whitened,
        residual=residual,
        nuisances=shared,
        groups=problem.groups,
        places=probe_places,
        respond=problem.respond,
        whitener=whitening,
    )
    if closer:
        problem = problem.with_variants(closer)
        refined = whitening.curves(problem.curves[len(whitened) :])
        hypotheses = weigh((*whitened, *refined), (*fits, *fitted(refined)))
    problem = problem.released()
    own = {(curve.effect, curve.variant): curve for curve in problem.curves}
    hypotheses = tuple(
        replace(item, variants={name: own[curve.effect, curve.variant] for name, curve in item.variants.items()})
        for item in hypotheses
    )
    marginal = _by_effect(hypotheses)
    # an effect that nearly every likely hypothesis holds is named, whatever companions it is offered with
    core = {effect for effect, value in marginal.items() if effect != UNKNOWN and value >= EXPLAINED_FROM}
    leading = next((item for item in hypotheses if core and set(item.effects) == core), hypotheses[0])
    tied: list[Hypothesis] = []
    if not leading.effects:
        verdict = "no_gap"
    elif leading.effects == (UNKNOWN,):
        verdict = "unknown_effect"
    elif core == set(leading.effects):
        verdict = "explained"
    else:
        verdict = "ambiguous"
        total = 0.0
        for item in hypotheses:
            if item.effects and item.effects != (UNKNOWN,):
                tied.append(item)
            total += item.probability
            if total > 0.9 and len(tied) > 1:
                break
        if len({effect for item in tied for effect in item.effects}) < 2:
            verdict = "explained"
    tell("held-out data")
    gap, by_axis, shares = held_out(problem, leading, nuisances, rng)
    if leading.effects and leading.effects != (UNKNOWN,) and is_refused(problem, gap, leading):
        # the best of the wrong ones
        verdict = "unknown_effect"
        hypotheses = vetoed(hypotheses)
        leading = hypotheses[0]
        tied = []
        gap, by_axis, shares = held_out(problem, leading, nuisances, rng)
    # what the fit can no longer doubt may still be wrong in kind
    hypotheses = with_doubt(hypotheses)
    leading = next(item for item in hypotheses if item.effects == leading.effects)
    marginal = _by_effect(hypotheses)
    none = next((item.probability for item in hypotheses if not item.effects), 0.0)
    of_unknown = marginal.pop(UNKNOWN, 0.0)
    named = leading.effects if leading.effects and leading.effects != (UNKNOWN,) else ()
    order = [*named, *sorted((item for item in marginal if item not in named), key=lambda item: -marginal[item])]
    listed = set(named) | {effect for item in tied for effect in item.effects}
    causes = []
    for effect in order:
        if effect not in listed and marginal[effect] < 0.02:
            continue
        best = next(item for item in hypotheses if effect in item.effects)
        curve = best.variants[effect]
        variant = next(item for item in problem.variants if item.effect == curve.effect and item.name == curve.variant)
        causes.append(
            Cause(
                effect=effect,
                probability=min(marginal[effect], 1.0),
                strength=strength_of(problem, best, effect),
                unit=EFFECTS[effect].strength.unit,
                parameters=dict(curve.parameters),
                sign=variant.sign,
                since=variant.since,
                shrinks_by=shares.get(effect),
            )
        )
    causes.sort(key=lambda item: -item.probability)
    z = nuisances.given_others(problem.residual)
    threshold = _threshold(len(problem.residual))
    places = [
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
    ]
    added = tuple(applied_at_best(problem, leading, effect) for effect in named)
    improved = replace(twin, effects=with_found(twin.effects, added))
    pairs = sorted(
        {
            (min(a, b), max(a, b))
            for first in tied
            for second in tied
            for a in first.effects
            for b in second.effects
            if a != b and not (set(first.effects) <= set(second.effects) or set(second.effects) <= set(first.effects))
        }
    )
    return Diagnosis(
        verdict=verdict,
        hypotheses=hypotheses,
        causes=tuple(causes),
        probability_no_gap=none,
        probability_unknown=of_unknown,
        unknown_location=next((item.location for item in hypotheses if item.effects == (UNKNOWN,)), ""),
        where=tuple(places),
        threshold_z=threshold,
        gap=gap,
        held_out=by_axis,
        ambiguous_with=tuple(pairs) if verdict == "ambiguous" else (),
        next_measurement=_next_measurement(problem, tied, rng) if verdict == "ambiguous" else None,
        twin=improved,
        added=added,
        named=tuple(named),
        problem=problem,
        warnings=tuple(problem.skipped),
        notes=_beyond_plausible(leading),
        not_tested=_out_of_reach(problem, whitened, shared),
        strained=_strained(problem, leading, nuisances),
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
    for effect, curve in leading.variants.items():
        known, value = EFFECTS[effect].strength, leading.strengths[effect][0]
        if not curve.low <= value <= curve.high:
            side = "weaker" if value < curve.low else "stronger"
            notes.append(
                f"{effect} is {side} than what is plausible as a rule ({known.low:g} to {known.high:g} {known.unit}): such a"
                " strength was given little weight beforehand"
            )
    return tuple(notes)


def _strained(problem: Problem, leading: Hypothesis, nuisances: LocalNuisances) -> tuple[tuple[str, float], ...]:
    """Nuisances that lie far from what is known of them, once the leading explanation is taken off."""
    left = problem.residual.copy()
    for effect, curve in leading.variants.items():
        left -= curve.response(leading.strengths[effect][0])
    found = zip(problem.factor_names, nuisances.fitted(left), strict=True)
    far = [
        (name, float(value))
        for name, value in found
        if abs(value) > STRAINED_FROM and not name.startswith(_OF_RENDERING)
    ]
    return tuple(sorted(far, key=lambda item: -abs(item[1])))


def _next_measurement(
    problem: Problem, tied: Sequence[Hypothesis], rng: np.random.Generator
) -> Mapping[str, Any] | None:
    """What to measure to tell the two likeliest explanations apart, found from the forward model and its noise.

    A series taken again where that settles it, else the measurement that the session lacks which does.
    """
    if len(tied) < 2:
        return None
    first, second = (
        {effect: (item.variants[effect], item.strengths[effect][0]) for effect in item.effects} for item in tied[:2]
    )
    answer: dict[str, Any] = {"separates": sorted({effect for item in tied[:2] for effect in item.effects})}
    found, other = best_repeat(problem, first, second), None
    if found is None or found.separation_then < WORTH_IT:
        planned = best_measurement(problem, first, second, rng=rng)
        if planned is not None and (planned.separation_then >= WORTH_IT or found is None):
            return answer | {
                "text": proposal_text(planned, tied[0].effects, tied[1].effects),
                "measurement": planned.measurement.name,
                "measure": [item.as_dict() for item in planned.measurement.series],
                "separation": planned.separation,
                "separation_then": planned.separation_then,
            }
        if planned is not None and _all_later(problem, (*first.values(), *second.values())):
            other = planned.measurement.text, planned.separation_then
    if found is None:
        return None
    return answer | {
        "text": repeat_text(found, tied[0].effects, tied[1].effects, other=other),
        "series": found.series,
        "separation": found.separation,
        "separation_then": found.separation_then,
    }


def _all_later(problem: Problem, curves: Sequence[tuple[Curve, float]]) -> bool:
    """Whether curves (with strengths) all stand for effects that set in after the calibration."""
    named = {(curve.effect, curve.variant) for curve, _ in curves}
    return all(item.since == "calibration" for item in problem.variants if (item.effect, item.name) in named)


def _threshold(probes: int) -> float:
    """The |z| that the largest of so many Gaussian probes, however correlated, exceeds in at most 5 % of sessions without a gap.

    Source: Sidak (1967), doi:10.1080/01621459.1967.10482935.
    """
    from scipy.special import ndtri

    return float(-ndtri(0.5 * (1.0 - 0.95 ** (1.0 / probes))))


def diagnosis_answer(diagnosis: Diagnosis, *, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """`diagnosis.json`, the form of the interfaces page."""

    def interval(value: tuple[float, float, float] | None) -> dict[str, float] | None:
        return None if value is None else {"value": value[0], "low": value[1], "high": value[2]}

    def parameters(cause: Cause) -> dict[str, Any]:
        effect = EFFECTS[cause.effect]
        units = {item.name: item.unit for item in effect.parameters}
        values = {
            "strength": {
                "value": cause.sign * cause.strength[0],
                "low": min(cause.sign * cause.strength[1], cause.sign * cause.strength[2]),
                "high": max(cause.sign * cause.strength[1], cause.sign * cause.strength[2]),
                "unit": cause.unit,
            }
        }
        for name, value in cause.parameters.items():
            values[name] = {"value": value, "low": value, "high": value, "unit": units.get(name, "")}
        return values

    return {
        "format": "raytwin-diagnosis",
        "version": 1,
        "verdict": diagnosis.verdict,
        "gap": {
            "before": diagnosis.gap.before,
            "after": diagnosis.gap.after,
            "floor": diagnosis.gap.floor,
            "shrinks_by": interval(diagnosis.gap.shrinks_by),
        },
        "causes": [
            {
                "effect": cause.effect,
                "probability": cause.probability,
                "strength": {**(interval(cause.strength) or {}), "unit": cause.unit},
                "parameters": parameters(cause),
                "since": cause.since,
                "shrinks_by": interval(cause.shrinks_by),
            }
            for cause in diagnosis.causes
        ],
        "hypotheses": [
            {"effects": list(item.effects), "probability": item.probability} for item in diagnosis.hypotheses
        ],
        "probability_no_gap": diagnosis.probability_no_gap,
        "probability_unknown": diagnosis.probability_unknown,
        "where": [
            {
                "axis": place.axis,
                "series": place.series,
                "statistic": place.statistic,
                "z": place.z,
                "location": place.location,
                "unit": place.unit,
            }
            for place in diagnosis.where
        ],
        "ambiguous_with": [list(pair) for pair in diagnosis.ambiguous_with],
        "next_measurement": diagnosis.next_measurement,
        "held_out": [
            {"axis": axis, "before": before, "after": after, "floor": floor}
            for axis, before, after, floor in diagnosis.held_out
        ],
        "not_tested": [{"effect": effect, "reason": reason} for effect, reason in diagnosis.not_tested.items()],
        "strained": [{"nuisance": name, "sd": value} for name, value in diagnosis.strained],
        "mislabelled": [{"series": list(item.series), "text": item.text} for item in diagnosis.mislabelled],
        "task": None,
        "warnings": [*diagnosis.warnings, *diagnosis.notes],
        "inputs": dict(inputs),
    }

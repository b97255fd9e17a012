"""Inner parameters and strengths brought to where the probes want them, by asking the forward model again.

The first weighing knows every effect at a few strengths and inner parameters only. An effect that is seen at tens of
standard deviations would be refused for that coarseness alone; so what leads is asked again, closer and closer.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..generator.effects.effect import Parameter
from ..generator.effects.registration import angles_of, parts_px
from .changes import KEPT_AS_THEY_ARE, ONE_STRENGTH, Variant
from .curve_fits import CurveFit, fit_curve
from .curves import Curve
from .inexact_laws import Widened, widened_for
from .inference import UNKNOWN, Hypothesis
from .nuisances import Nuisances

REFINED_FROM = 6.0  # separation from none, its law taken as exact, from which the grid's coarseness matters
_MOST_EFFECTS = 4
# of the best on the grid over none: refinement adds some fifth to it, and far more is needed to be named
_LEAST_EVIDENCE = 1.0
_REACH = 0.6  # share of the best evidence from which an effect is refined
_REACH_CHANCE = 30.0  # log evidence below that
_REACH_OF_PAIRS = 3.0  # log evidence that a pair may lie below its first effect alone
_CENTRINGS, _CENTRED = 3, 0.15  # times that nodes are laid anew, and logarithm of the strength that needs none
_STARTS = 2
_OTHER_ONSET = 0.5  # share of the leading evidence from which a start with the other onset is refined as well
_ROUNDS = 5
_ENOUGH, _ENOUGH_SHARE = 1.0, 1e-5  # gain of log evidence, and share of it, below which the search ends
_SHAPE = "order"  # of a spread: sought last
_STEP = 0.1  # of half a parameter's range: to find how responses change with it
_FARTHEST = 0.6  # step in half ranges
_FURTHER = 3.0  # times a step that explained more, tried as well where displacements and widths are sought
_LAW_ERROR = 0.1
_NEAR = (0.75, 1.0, 1.33)  # of the strength found: nodes of the refined curve
_UP_TO = (0.75, 1.0)  # where more cannot be asked: the spectrum ends a tenth above the stated voltage


class Responder(Protocol):
    """Responses (strength, probe) of variants, by their place; those that cannot be asked are left out."""

    def __call__(self, asked: Sequence[Variant], /) -> Mapping[int, NDArray[np.float64]]: ...


class Whitener(Protocol):
    """Responses with the local nuisances integrated out."""

    def apply(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]: ...


def refine(
    hypotheses: Sequence[Hypothesis],
    *,
    variants: Mapping[tuple[str, str], Variant],
    curves: Sequence[Curve],
    residual: NDArray[np.float64],
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    respond: Responder,
    whitener: Whitener,
    places: NDArray[np.intp] | None = None,
) -> list[tuple[Variant, NDArray[np.float64]]]:
    """Variants nearer to what was measured than those of the grid, with their responses (strength, probe).

    Args:
        hypotheses: of the first weighing, with whitened curves.
        variants: of the grid, by effect and name.
        curves: of the grid, whitened.
        residual, nuisances, groups, places: whitened, as weighed.
        respond: asks the forward model.
        whitener: of responses.
    """
    result = []
    whole = _Seen(residual=residual, nuisances=nuisances, groups=groups, places=places, whitener=whitener)
    for effect, beside in _to_refine(_within_reach(hypotheses)):
        seen = whole
        for curve, strength in beside:
            seen = seen.beside(curve, strength)
        fits = [seen.fit(curve) for curve in curves if curve.effect == effect]
        clear = [fit for fit in fits if _separation(fit, seen) >= REFINED_FROM]
        starts = [(variants[effect, fit.curve.variant], fit) for fit in _starts_of(clear)] if clear else []
        if effect == "misregistration":
            starts += _displaced_and_distorted(clear, variants)
        refined = (_refined(variant, fit, seen, respond) for variant, fit in starts)
        result += [found for found in refined if found is not None]
    return result


def _to_refine(hypotheses: Sequence[Hypothesis]) -> list[tuple[str, list[tuple[Curve, float]]]]:
    """Effects of the leading hypotheses, most probable first, each with what stands beside it (curve, strength).

    Each effect once alone and once beside another at the most. Of the first hypothesis, if it is a pair, the effect that moves
    more is refined alone as well: on the grid a second effect may stand for what is wrong with its inner parameters, and
    beside that they stay wrong.
    """
    result: list[tuple[str, list[tuple[Curve, float]]]] = []
    for number, hypothesis in enumerate(hypotheses):
        at = {effect: (hypothesis.variants[effect], hypothesis.strengths[effect][0]) for effect in hypothesis.effects}
        if number == 0 and len(at) > 1:
            moves = {effect: float(np.sum(curve.response(strength) ** 2)) for effect, (curve, strength) in at.items()}
            result.append((max(moves, key=lambda effect: moves[effect]), []))
        known = {effect for effect, beside in result if beside or len(hypothesis.effects) == 1}
        for effect in hypothesis.effects:
            if effect not in known and len({name for name, _ in result} | {effect}) <= _MOST_EFFECTS:
                result.append((effect, [one for name, one in at.items() if name != effect]))
    return result


def _separation(fit: CurveFit, seen: "_Seen") -> float:
    """Of a fit from none, its law taken as exact."""
    response = fit.curve.response(fit.best)
    return math.sqrt(max(float(response @ seen.nuisances.solve(response)), 0.0))


def _displaced_and_distorted(
    fits: Sequence[CurveFit], variants: Mapping[tuple[str, str], Variant]
) -> list[tuple[Variant, CurveFit]]:
    """A misregistration that shifts as the best mere shift does, and enlarges or turns as the best that does so.

    From either alone no small step of the angles leads to the other. Empty: one of them is not seen.
    """
    best: dict[bool, CurveFit] = {}
    for fit in sorted(fits, key=lambda item: item.log_evidence):
        shift, *_ = _parts_of(variants[fit.curve.effect, fit.curve.variant], fit.best)
        best[abs(shift) > 0.5 * fit.best] = fit
    if len(best) < 2:
        return []
    variant = variants[best[True].curve.effect, best[True].curve.variant]
    shift, *_ = _parts_of(variant, best[True].best)
    _, radial, turn = _parts_of(variants[best[False].curve.effect, best[False].curve.variant], best[False].best)
    angles = angles_of(abs(shift), radial, turn)
    strength = min(max(angles.pop("strength"), variant.low), variant.high)
    found = replace(best[True], strengths=np.array([strength]), log_likelihood=np.zeros(1))
    return [(replace(variant, parameters={**variant.parameters, **angles}, name=f"{variant.name}, distorted"), found)]


def _parts_of(variant: Variant, strength: float) -> tuple[float, float, float]:
    """Shift, enlargement and turn (px) of a misregistration."""
    angles = {name: variant.parameters.get(name, 0.0) for name in ("magnification_deg", "rotation_deg")}
    return parts_px(strength, **angles)


def _within_reach(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best known effect or pair, and those that refinement could bring past it, best first; none where no effect helps.

    On forty sessions refinement added up to 22 % to the evidence of a leading effect and up to 11 % where it was above 1000;
    no effect with less than nine tenths of the leading one's came near it.
    """
    known = sorted(
        (item for item in hypotheses if item.effects and item.effects != (UNKNOWN,)),
        key=lambda item: -item.log_evidence,
    )
    if not known or known[0].log_evidence < _LEAST_EVIDENCE:
        return []
    alone = {item.effects[0]: item.log_evidence for item in known if len(item.effects) == 1}
    top = known[0].log_evidence

    def near(item: Hypothesis) -> bool:
        if len(item.effects) == 1:
            return item.log_evidence > _REACH * top - _REACH_CHANCE
        # the second of a pair: what it adds to the first, against what the best adds
        first = max(alone[effect] for effect in item.effects)
        best = max(top - first, 0.0)
        return item.log_evidence - first > 0.5 * best - _REACH_OF_PAIRS

    return [known[0], *(item for item in known[1:] if near(item))]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Seen:
    """What one effect is fitted to: the residual less what others explain, in units of what their laws leave uncertain.

    Fields: residual (probe,), nuisances, groups and places as weighed; whitener of responses; root (probe,): standard deviations of
    the probes, in whitened ones (None: 1).
    """

    residual: NDArray[np.float64]
    nuisances: Nuisances
    groups: NDArray[np.intp]
    places: NDArray[np.intp] | None
    whitener: Whitener
    root: NDArray[np.float64] | None = None

    def beside(self, curve: Curve, strength: float) -> "_Seen":
        """The same once another effect stands at a strength, its law off by _LAW_ERROR."""
        found = self.widened(curve, strength)
        root = found.root if self.root is None else self.root * found.root
        rest = (self.residual - curve.response(strength)) / found.root
        return replace(self, residual=rest, nuisances=found.nuisances, root=root)

    def widened(self, curve: Curve, strength: float) -> Widened:
        """What may vary beside a curve at a strength, its law off by _LAW_ERROR."""
        return widened_for(self.residual, curve, strength, self.nuisances, self.groups, _LAW_ERROR, places=self.places)

    def scaled(self, curve: Curve) -> Curve:
        """A whitened curve in these units."""
        return curve if self.root is None else curve.over(self.root)

    def apply(self, responses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Responses as asked of the forward model, whitened and in these units."""
        whitened = self.whitener.apply(responses)
        return whitened if self.root is None else whitened / self.root

    def fit(self, curve: Curve) -> CurveFit:
        """A whitened curve, fitted."""
        return self.fit_scaled(self.scaled(curve))

    def fit_scaled(self, curve: Curve) -> CurveFit:
        """A curve in these units, fitted."""
        return fit_curve(self.residual, curve, self.nuisances, self.groups, places=self.places)


def _starts_of(fits: Sequence[CurveFit]) -> list[CurveFit]:
    """The best on the grid, which is not always the one that leads furthest, and another: of the other onset if any is near.

    A law as good as exact and one that is off on the grid cannot be weighed against each other: where a share of the
    evidence speaks for either onset, both are refined.
    """
    ranked = sorted(fits, key=lambda item: -item.log_evidence)
    first = ranked[0]
    others = [
        item
        for item in ranked
        if item.curve.since != first.curve.since and item.log_evidence > _OTHER_ONSET * first.log_evidence
    ]
    return [first, *(others or ranked[1:])[: _STARTS - 1]]


def _refined(
    variant: Variant, fit: CurveFit, seen: _Seen, respond: Responder
) -> tuple[Variant, NDArray[np.float64]] | None:
    best, strength = variant, fit.best

    def near(parameters: Mapping[str, float], shares: Sequence[float]) -> Variant:
        return variant.refined(parameters, [share * strength for share in shares])

    def curve_of(item: Variant, responses: NDArray[np.float64]) -> Curve:
        like = fit.curve
        return item.curve(seen.apply(responses), spread=like.spread, jitter=like.jitter, exact=like.exact)

    def answered(parameters: Mapping[str, float]) -> tuple[Variant, NDArray[np.float64]] | None:
        for shares in (_NEAR, _UP_TO):
            item = near(parameters, shares)
            answer = respond([item])
            if 0 in answer:
                return item, answer[0]
        return None

    def tried(parameters: Mapping[str, float]) -> CurveFit | None:
        if not in_proportion:
            found = answered(parameters)
            return None if found is None else seen.fit_scaled(curve_of(*found))
        item = near(parameters, (1.0,))
        answer = respond([item])
        return seen.fit_scaled(curve_of(item, answer[0])) if 0 in answer else None

    inner = [
        item for item in variant.fitted if item.name in variant.parameters and variant.effect not in KEPT_AS_THEY_ARE
    ]
    # one strength tells the others where the response grows in proportion
    in_proportion = variant.effect in ONE_STRENGTH
    # laws that may be off hold a fit back along what two parameters explain alike, so a step that helps may go further; but
    # where the law's shape is what is off it leads away (0.4 % of lag read 0.37 so, 0.39 without; scatter 2 % lower)
    shares = (1.0, 0.3, 0.1) if in_proportion else (1.0, _FURTHER, 0.3, 0.1)
    here = tried(best.parameters)
    if here is None:
        return None
    strength = here.best
    for part in _in_turn(inner):
        slopes: _Slopes | None = None
        for _ in range(_ROUNDS if in_proportion else 2 * _ROUNDS):
            learnt = slopes is not None
            slopes = slopes or _slopes_at(here, best, part, seen, respond)
            steps = _newton(here, best, slopes, seen)
            before, start, at = here.log_evidence, best.parameters, here
            taken: dict[str, float] = {}
            for share in shares:
                helped = here.log_evidence > before
                if share != 1.0 and helped == (share < 1.0):
                    continue
                parameters = dict(start)
                for item in part:
                    parameters[item.name] = _moved(item, start[item.name], share * steps.get(item.name, 0.0))
                if parameters == best.parameters:
                    continue  # at the ends of their ranges
                candidate = tried(parameters)
                if candidate is not None and candidate.log_evidence > here.log_evidence:
                    here, strength = candidate, candidate.best
                    best = replace(best, parameters=parameters)
                    taken = {item.name: _way(item, start[item.name], parameters[item.name]) for item in part}
            if here.log_evidence - before >= max(_ENOUGH, _ENOUGH_SHARE * before):
                slopes = slopes.learnt(at, here, taken)
            elif learnt:
                slopes = None
            else:
                break
    final = answered(best.parameters)
    for _ in range(_CENTRINGS):
        if final is None:
            return None
        # a response that saturates is known near its nodes only: they are laid where the strength turns out to be
        found = seen.fit_scaled(curve_of(*final)).best
        if abs(math.log(found / strength)) < _CENTRED:
            break
        strength = found
        final = answered(best.parameters)
    return final


def _in_turn(inner: Sequence[Parameter]) -> list[Sequence[Parameter]]:
    """Parameters that are sought together, one set after the other: reach before shape, which can stand for it far off.

    With both from the start a veiling glare of 4 % was found as 2.4 % of another shape, with 130 less of log evidence.
    """
    plain = [item for item in inner if item.name != _SHAPE]
    turns = [plain, inner] if len(plain) < len(inner) else [inner]
    return [part for part in turns if part]


@dataclass(frozen=True, slots=True)
class _Slopes:
    """How a response changes with inner parameters: rows (parameter, probe) for each half of a parameter's range, at one strength."""

    names: tuple[str, ...]
    rows: NDArray[np.float64]
    strength: float

    def at(self, strength: float) -> NDArray[np.float64]:
        """The rows at another strength, to which they are taken to be in proportion."""
        return self.rows * (strength / self.strength)

    def learnt(self, before: CurveFit, after: CurveFit, step: Mapping[str, float]) -> "_Slopes":
        """With what a step has shown, along that step.

        Source: Broyden (1965), doi:10.1090/S0025-5718-1965-0198670-6.
        """
        strength = after.best
        taken = np.array([step[name] for name in self.names])
        rows, length = self.at(strength), float(taken @ taken)
        if length == 0.0:  # at the ends of their ranges: better by its strength alone
            return _Slopes(self.names, rows, strength)
        change = np.asarray(after.curve.response(strength)) - np.asarray(before.curve.response(strength))
        rows = rows + np.outer(taken, change - taken @ rows) / length
        return _Slopes(self.names, rows, strength)


def _slopes_at(
    here: CurveFit, variant: Variant, inner: Sequence[Parameter], seen: _Seen, respond: Responder
) -> _Slopes:
    """What small steps of the inner parameters do to the response; those that cannot be asked are left out."""
    strength = _plausible(here, variant)
    at = np.asarray(here.curve.response(strength))
    steps, asked = [], []
    for item in inner:
        value = variant.parameters[item.name]
        steps.append(_STEP if _moved(item, value, _STEP) != value else -_STEP)
        moved = {**variant.parameters, item.name: _moved(item, value, steps[-1])}
        asked.append(replace(variant, parameters=moved, strengths=(strength,)))
    answer = respond(asked)
    rows = [(seen.apply(answer[number])[0] - at) / steps[number] for number in sorted(answer)]
    return _Slopes(
        tuple(inner[number].name for number in sorted(answer)), np.reshape(rows, (len(rows), at.size)), strength
    )


def _plausible(here: CurveFit, variant: Variant) -> float:
    """The strength found, within its range: a share of photons beyond it asks for another shape, not for more photons."""
    return min(max(here.best, variant.low), variant.high)


def _newton(here: CurveFit, variant: Variant, slopes: _Slopes, seen: _Seen) -> dict[str, float]:
    """Steps of the inner parameters, each in half of its range, towards where the probes want them.

    Least squares in the parameters and the strength together, responses taken as straight lines near here, the law off
    by _LAW_ERROR, each parameter within about its range.
    """
    strength = _plausible(here, variant)
    at = np.asarray(here.curve.response(strength))
    found = seen.widened(here.curve, strength)
    left, wide = (seen.residual - at) / found.root, found.nuisances
    rows = np.concatenate([at[None, :], slopes.at(strength)]) / found.root
    normal = wide.inner(rows, rows)
    normal[np.arange(1, len(rows)), np.arange(1, len(rows))] += 1.0
    normal[0, 0] += 1e-9 if strength == here.best else 1e12
    solved = np.linalg.solve(normal, wide.inner(rows, left[None, :])[:, 0])
    # shortened as a whole: what parameters explain alike must keep its direction
    farthest = float(np.max(np.abs(solved[1:]), initial=0.0))
    solved *= min(1.0, _FARTHEST / max(farthest, 1e-12))
    return {name: float(step) for name, step in zip(slopes.names, solved[1:], strict=True)}


def _way(item: Parameter, value: float, moved: float) -> float:
    """The step that moves a parameter's value so far, in halves of its range."""
    if item.log:
        return 2.0 * math.log(moved / value) / math.log(item.high / item.low)
    if item.name.endswith("_deg") and item.high - item.low >= 360.0:
        return ((moved - value + 180.0) % 360.0 - 180.0) / 180.0
    return 2.0 * (moved - value) / (item.high - item.low)


def _moved(item: Parameter, value: float, step: float) -> float:
    """A parameter's value moved by `step` times half of its range, within the range."""
    if item.log:
        moved = value * math.exp(step * math.log(item.high / item.low) / 2.0)
    elif item.name.endswith("_deg") and item.high - item.low >= 360.0:
        return (value + 180.0 * step) % 360.0
    else:
        moved = value + step * (item.high - item.low) / 2.0
    return min(max(moved, item.low), item.high)

"""Where a gap is left beside effects that a twin has: they are sought anew with the rest, as effects that are found are.

With its effects fixed a twin leaves what their laws are off by, and that may look like anything. Beside effects that are found, what
another one must bring is known; so the same session is asked whether these effects, as strong as the twin has them, are all there is.
"""

from collections.abc import Sequence
from dataclasses import replace

from ...generator.effects import AppliedEffect
from ..inference.inference import UNKNOWN, Hypothesis
from ..problem.known_effects import lasting
from ..problem.known_laws import changed_effect, says_strength
from .answer import EXPLAINED, Diagnosis

_STRENGTH_OFF = 0.24  # relative: twice what an interval is widened by for real laws and definitions
_LEAVES_MORE, _LEAVES_FLOOR = 1.5, 0.3  # times the gap, and of it, that is left with the effects as the twin has them


def is_to_be_asked(result: Diagnosis, effects: Sequence[AppliedEffect]) -> bool:
    """Whether effects that the twin has are to be sought anew: it has some, no other than its strength of them, and leaves a gap."""
    return bool(lasting(effects)) and result.verdict != "no_gap" and changed_effect(result.unknown_location) is None


def with_sought_anew(result: Diagnosis, anew: Diagnosis, effects: Sequence[AppliedEffect]) -> Diagnosis:
    """The answer, where these effects were sought anew.

    Args:
        result: with the twin's effects as they are.
        anew: of the same session with the twin without them, and them in the catalogue.
        effects: of the twin.
    """
    had = {item.id: abs(item.parameters.get("strength", 0.0)) for item in lasting(effects)}
    if anew.verdict not in EXPLAINED or not had.keys() <= set(anew.named):
        return result
    others = set(anew.named) - had.keys()
    if others:
        if result.verdict in EXPLAINED and set(result.named) == others:
            return result
        return replace(anew, notes=(*anew.notes, _sought(tuple(had))))
    found = {item.effect: item.strength for item in anew.causes}
    as_strong = all(
        low * (1.0 - _STRENGTH_OFF) <= had[effect] <= high * (1.0 + _STRENGTH_OFF)
        for effect, (_, low, high) in found.items()
        if effect in had
    )
    if not as_strong or result.gap.before > _LEAVES_MORE * anew.gap.after + _LEAVES_FLOOR:
        return replace(anew, notes=(*anew.notes, _sought(tuple(had))))
    hypotheses = _beside(anew.hypotheses, frozenset(had))
    marginal = {item.effects: item.probability for item in hypotheses}
    return replace(
        result,
        verdict="no_gap",
        hypotheses=hypotheses,
        causes=(),
        probability_no_gap=marginal.get((), 0.0),
        probability_unknown=marginal.get((UNKNOWN,), 0.0),
        unknown_location="",
        gap=replace(result.gap, after=result.gap.before, shrinks_by=None),
        held_out=tuple((axis, before, before, floor) for axis, before, _, floor in result.held_out),
        ambiguous_with=(),
        next_measurement=None,
        twin=replace(result.twin, effects=tuple(effects)),
        added=(),
        named=(),
        notes=(
            *(note for note in result.notes if not any(says_strength(note, effect) for effect in had)),
            f"{_sought(tuple(had))}: what still differs is no more than their laws leave",
        ),
        strained=(),
    )


def _sought(had: Sequence[str]) -> str:
    return (
        f"{' and '.join(had)}, which the twin has, {'was' if len(had) == 1 else 'were'} sought anew beside all others"
    )


def _beside(hypotheses: Sequence[Hypothesis], had: frozenset[str]) -> tuple[Hypothesis, ...]:
    """Hypotheses less the effects that the twin has, those that are the same then as one, most probable first."""
    merged: dict[tuple[str, ...], Hypothesis] = {}
    for item in hypotheses:
        effects = tuple(effect for effect in item.effects if effect not in had)
        own = replace(
            item,
            effects=effects,
            strengths={effect: item.strengths[effect] for effect in effects if effect in item.strengths},
            variants={effect: item.variants[effect] for effect in effects if effect in item.variants},
        )
        known = merged.get(effects)
        merged[effects] = own if known is None else replace(known, probability=known.probability + own.probability)
    return tuple(sorted(merged.values(), key=lambda item: -item.probability))

"""Inner parameters and strengths brought to where the probes want them, by asking the forward model again.

The first weighing knows every effect at a few strengths and inner parameters only. An effect that is seen at tens of
standard deviations would be refused for that coarseness alone; so what leads is asked again, closer and closer.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...generator.effects import EFFECTS
from ...generator.effects.effect import Placement
from ..arrays import FloatArray
from ..model.changes import Variant
from ..model.curves import Curve
from .curve_fits import CurveFit
from .discrepancy import USUAL_LEVEL
from .inference import Hypothesis
from .nuisances import Whitening
from .observed import Observed, Point
from .search import ENOUGH, searched
from .seen import Blocks, FitTarget, Responder

_MOST_EFFECTS = 4
_REACH = 0.6  # share of the best evidence from which an effect is refined
_REACH_CHANCE = 30.0  # log evidence below that
_REACH_OF_PAIRS = 3.0  # log evidence that a pair may lie below its first effect alone
# standard deviations at which an effect shows beside none, so that it is tested and refined, and one explanation beside another
SEEN_FROM = 3.0
_OTHER_ONSET = 0.5  # share of the leading evidence from which a start with the other onset is refined as well


def refine(
    hypotheses: Sequence[Hypothesis],
    *,
    curves: Sequence[Curve],
    observed: Observed,
    respond: Responder,
    whitening: Whitening,
    blocks: Blocks | None = None,
) -> list[tuple[Variant, FloatArray]]:
    """Variants nearer to what was measured than those of the grid, with their responses (strength, probe).

    Hypotheses of the first weighing, curves of the grid and `observed` are whitened; blocks: of series that share local nuisances, of
    which the search asks those that tell most (None: all).
    """
    whole = FitTarget(observed=observed, respond=respond, whitening=whitening, blocks=blocks)
    refinement = _Refinement(whole, curves)
    for task in tasks_of(hypotheses):
        refinement.run(task)
    return refinement.found


@dataclass(frozen=True, slots=True)
class Task:
    """An effect to be refined."""

    own: Point  # where it is on the grid, beside the other of a pair
    beside: Point | None = None  # of a pair, the other, on the grid
    moves_more: bool = False  # of a pair, that it moves the probes more than the other
    leads: bool = False  # of the first hypothesis

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.own.effect


class _Refinement:
    """Variants found so far; what stands beside an effect is taken as it was found last."""

    def __init__(self, whole: FitTarget, curves: Sequence[Curve]) -> None:
        self._whole = whole
        self._curves = curves
        self._closer: dict[str, CurveFit] = {}
        self.found: list[tuple[Variant, FloatArray]] = []

    def run(self, task: Task) -> None:
        """Refine an effect; one that is not clearly seen, or beside which the other one of its pair is not, is left as it is."""
        seen = self._standing(task)
        if task.beside is not None:
            if task.moves_more and not self._clear(task.beside.effect, seen.in_presence_of(self._last(task.own))):
                return
            seen = seen.in_presence_of(self._last(task.beside))
        # brought nearer alone already; the lesser of two is sought anew beside the other, which it may have stood for
        known = self._closer.get(task.effect) if task.moves_more else None
        if known is not None:
            starts = [seen.fit(known.curve)]
        else:
            clear = self._clear(task.effect, seen)
            starts = _starts_of(clear, task.leads or task.beside is None)
            placement = EFFECTS[task.effect].placement
            if placement is not None:
                starts += _displaced_and_distorted(clear, placement)
            if task.beside is not None and not task.moves_more:
                stronger = self._last(task.beside)
                if not stronger.curve.variant.series:  # what acts in some series only is not there in all
                    there = stronger.curve.variant.applied(stronger.strength)
                    starts = [_with(fit, beside=there) for fit in starts]
        best: CurveFit | None = None
        for start in starts:
            found = searched(start, seen)
            if found is None:
                continue
            self.found.append(found)
            fit = seen.fit(replace(start.curve, variant=found[0], responses=self._whole.own(found[1])))
            if best is None or fit.log_evidence > best.log_evidence:
                best = fit
        # what it is beside another says nothing of it beside a third
        if best is not None and best.curve.variant.beside is None:
            self._closer[task.effect] = best

    def _standing(self, task: Task) -> FitTarget:
        """What a task's effects are fitted to: the twin has its effects but these."""
        effects = [task.effect] if task.beside is None else [task.effect, task.beside.effect]
        return replace(self._whole, observed=self._whole.observed.conditioned(*effects))

    def _last(self, grid: Point) -> Point:
        """An effect as it was found last; as the grid has it before."""
        known = self._closer.get(grid.effect)
        return grid if known is None else known.point

    def _clear(self, effect: str, seen: FitTarget) -> list[CurveFit]:
        """Fits of an effect's curves of the grid that show it clearly."""
        fits = [seen.fit(curve) for curve in self._curves if curve.effect == effect]
        return [fit for fit in fits if _separation(fit, seen) >= SEEN_FROM]


def _with(fit: CurveFit, **changed: Any) -> CurveFit:
    """A fit as the start of its variant with some fields changed."""
    return replace(fit, curve=replace(fit.curve, variant=replace(fit.curve.variant, **changed)))


def _separation(fit: CurveFit, seen: FitTarget) -> float:
    """Of a fit from none, its law taken as exact."""
    response = fit.curve.response(fit.best) / seen.observed.units
    return math.sqrt(max(float(response @ seen.observed.nuisances.solve(response)), 0.0))


def _displaced_and_distorted(fits: Sequence[CurveFit], placement: Placement) -> list[CurveFit]:
    """A displacement that shifts as the best mere shift does, and distorts as the best that does so: no small step leads there."""
    best: dict[bool, tuple[CurveFit, dict[str, float]]] = {}
    for fit in sorted(fits, key=lambda item: item.log_evidence):
        parameters = {**fit.curve.variant.parameters, "strength": fit.best}
        best[abs(placement.parts(parameters).shift_px) > 0.5 * fit.best] = fit, parameters
    if len(best) < 2:
        return []
    shift, shifted = best[True]
    variant = shift.curve.variant
    parameters = placement.combined(shifted, best[False][1])
    strength = min(max(parameters.pop("strength"), variant.low), variant.high)
    found = _with(shift, parameters=parameters, name=f"{variant.name}, distorted")
    return [replace(found, strengths=np.array([strength]), log_likelihood=np.zeros(1))]


def _starts_of(fits: Sequence[CurveFit], several: bool) -> list[CurveFit]:
    """The best on the grid, and another: of the other onset if any is near, else, with `several`, the second best.

    A law as good as exact and one that is off on the grid cannot be weighed against each other.
    """
    ranked = sorted(fits, key=lambda item: -item.log_evidence)
    if not ranked:
        return []
    first = ranked[0]
    others = [
        item
        for item in ranked
        if item.curve.variant.since != first.curve.variant.since
        and item.log_evidence > _OTHER_ONSET * first.log_evidence
    ]
    return [first, *(others or (ranked[1:] if several else []))[:1]]


def tasks_of(hypotheses: Sequence[Hypothesis]) -> list[Task]:
    """Effects of the leading hypotheses, those of the most probable first.

    Each effect once alone and once beside another at the most. Of the first hypothesis, if it is a pair, the effect that moves
    more is refined alone as well: on the grid a second effect may stand for what is wrong with its inner parameters, and
    beside that they stay wrong. Of a pair that does not lead it is not refined beside the other.
    """
    result: list[Task] = []
    for number, hypothesis in enumerate(_within_reach(hypotheses)):
        at = {point.effect: replace(point, level=USUAL_LEVEL) for point in hypothesis.points()}
        moves = {effect: float(np.sum(one.curve.response(one.strength) ** 2)) for effect, one in at.items()}
        more = max(moves, key=lambda effect: moves[effect])
        if number == 0 and len(at) > 1:
            result.append(Task(at[more], leads=True))
        if len(at) == 1:
            # beside another it went where the two together want it
            known = {task.effect for task in result if task.beside is None}
        else:
            known = {task.effect for task in result if task.beside or (number > 0 and task.effect == more)}
        for effect in hypothesis.effects:
            if effect not in known and len({task.effect for task in result} | {effect}) <= _MOST_EFFECTS:
                beside = next((one for name, one in at.items() if name != effect), None)
                moves_more = beside is not None and effect == more
                result.append(Task(at[effect], beside, moves_more=moves_more, leads=number == 0))
    # of a pair the one that moves more is first brought to where it is wanted beside the other
    return sorted(result, key=lambda task: (not task.leads, task.beside is not None, not task.moves_more))


def _drawn_in_full(effect: str) -> bool:
    """Whether the effect, of the catalogue, draws every factor of a pattern by chance."""
    return effect in EFFECTS and EFFECTS[effect].drawn_in_full


def _within_reach(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best known effect or pair, and those that refinement could bring past it, best first; none where no effect helps."""
    known = sorted((item for item in hypotheses if item.of_catalogue), key=lambda item: -item.log_evidence)
    # refinement adds some fifth to the evidence of the best on the grid, and far more is needed to be named
    if not known or known[0].log_evidence < ENOUGH:
        return []
    alone = {item.effects[0]: item.log_evidence for item in known if len(item.effects) == 1}
    top = known[0].log_evidence
    # what draws every factor of a pattern explains any at once: it is no measure of what a law will when it is refined
    by_law = max((value for effect, value in alone.items() if not _drawn_in_full(effect)), default=top)

    def near(item: Hypothesis) -> bool:
        if len(item.effects) == 1:
            whole = top if _drawn_in_full(item.effects[0]) else min(top, by_law)
            return item.log_evidence > _REACH * whole - _REACH_CHANCE
        # the second of a pair: what it adds to the first, against what the best adds
        first = max(alone[effect] for effect in item.effects)
        best = max(top - first, 0.0)
        return item.log_evidence - first > 0.5 * best - _REACH_OF_PAIRS

    return [known[0], *(item for item in known[1:] if near(item))]

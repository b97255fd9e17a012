"""Which effects a measurement set can tell apart, and which of its series should be taken again to break a tie.

Only expectations, noise and nuisances are used, so the frames' contents do not matter: a session that was planned, or
taken on another day, says as much.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import InputError
from ...generator.effects import EFFECTS
from ..arrays import FloatArray, IndexArray
from ..inference.inference import title_of
from ..inference.nuisances import Nuisances, Whitening
from ..inference.observed import Point
from ..inference.refine import SEEN_FROM
from ..model.curves import Curve, places_of
from ..problem.problem import Problem

_GRID = 41  # strengths of a competitor, evenly in the logarithm
_FINE_GRID = 121  # strengths that are asked whether they are seen
CLEAR = 5.0  # standard deviations
_REPEATS = 4  # times as many frames
_CANDIDATES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Distinguishability:
    """Separation of effects, standard deviations, nuisances and the other's strength and inner parameters refitted."""

    effects: tuple[str, ...]  # (effect,)
    since: tuple[str, ...]  # (effect,): the onset that each is taken with, its usual one where the session can show it
    strengths: FloatArray  # (effect,): middle of the range, inner parameters those that are seen neither best nor worst
    from_none: FloatArray  # (effect,)
    seen_from: FloatArray  # (effect,): least strength of the plausible range that lies CLEAR from none, inf: none
    between: FloatArray  # (effect, effect): of the row's effect from the column's at what strength and inner parameters come nearest


def distinguishability(problem: Problem) -> Distinguishability:
    """How well the session of a problem tells the catalogue's effects apart."""
    whitening = Whitening(problem.factors, problem.blocks)
    curves = whitening.curves(problem.curves)
    if not curves:
        raise InputError(
            "session",
            received="no effect of the catalogue that could change what was measured",
            expected="one at least",
            remedy="leave fewer effects out, or measure flats and objects too",
        )
    nodes = np.concatenate([curve.responses for curve in curves])
    gram = Nuisances(whitening.factors).inner(nodes, nodes)
    places = places_of([curve.responses for curve in curves])

    def lengths(number: int, strengths: FloatArray) -> FloatArray:
        weights, own = curves[number].weights(strengths), gram[places[number], places[number]]
        return np.asarray(np.sqrt(np.maximum(np.einsum("si,ij,sj->s", weights, own, weights), 0.0)))

    order = {effect: place for place, effect in enumerate(EFFECTS)}
    effects = tuple(
        sorted(dict.fromkeys(curve.effect for curve in curves), key=lambda name: order.get(name, len(order)))
    )
    taken = [_usual(effect, curves, lengths) for effect in effects]
    strengths = np.array([_middle(curves[number]) for number in taken])
    from_none, seen_from = np.zeros(len(effects)), np.full(len(effects), np.inf)
    between = np.zeros((len(effects), len(effects)))
    for row, (number, strength) in enumerate(zip(taken, strengths, strict=True)):
        own, mine = curves[number], places[number]
        from_none[row] = lengths(number, np.array([strength]))[0]
        grid = np.geomspace(own.variant.low, own.variant.high, _FINE_GRID)
        clear = np.nonzero(lengths(number, grid) >= CLEAR)[0]
        if clear.size:
            seen_from[row] = grid[clear[0]]
        weights = own.weights(np.array([strength]))[0]
        nearest = np.full(len(effects), from_none[row] ** 2)
        for curve, place in zip(curves, places, strict=True):
            column = effects.index(curve.effect)
            others = curve.weights(np.geomspace(curve.variant.low / 3.0, 1.5 * curve.variant.high, _GRID))
            distance = (
                from_none[row] ** 2
                - 2.0 * others @ (gram[place, mine] @ weights)
                + np.einsum("si,ij,sj->s", others, gram[place, place], others)
            )
            nearest[column] = min(nearest[column], float(distance.min()))
        between[row] = np.sqrt(np.maximum(nearest, 0.0))
        between[row, row] = 0.0
    return Distinguishability(
        effects=effects,
        since=tuple(curves[number].variant.since for number in taken),
        strengths=strengths,
        from_none=from_none,
        seen_from=seen_from,
        between=between,
    )


def _middle(curve: Curve) -> float:
    """Middle of the plausible range."""
    return math.sqrt(curve.variant.low * curve.variant.high)


def _usual(effect: str, curves: Sequence[Curve], lengths: Callable[[int, FloatArray], FloatArray]) -> int:
    """Number of the curve that stands for an effect: of its usual onset, if there is one, and of those the middle one in length."""
    own = [number for number, curve in enumerate(curves) if curve.effect == effect]
    onset = EFFECTS[effect].usual_onset
    usual = [number for number in own if curves[number].variant.since == onset] or own
    ranked = sorted(usual, key=lambda number: float(lengths(number, np.array([_middle(curves[number])]))[0]))
    return ranked[(len(ranked) - 1) // 2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """What to measure to distinguish two explanations, and their separation, standard deviations."""

    what: str  # in words
    separation: float  # as the session is
    separation_then: float  # with it
    series: str = ""  # that is taken again; empty: none
    measured: tuple[Mapping[str, Any], ...] = ()  # new series, as an acquisition's attributes
    name: str = ""  # of what is measured new

    @property
    def settles(self) -> bool:
        """Whether the matter is settled with it: what is as it was told the two apart no better, however clearly it would."""
        return self.separation_then**2 - self.separation**2 >= SEEN_FROM**2


def advice_text(proposals: Sequence[Proposal], first: Sequence[str], second: Sequence[str], *, lately: bool) -> str:
    """What to measure to distinguish two explanations (effects): what settles it, or, where nothing does, what isolates them.

    proposals: the best one of each kind; lately: all effects came after the calibration, which has not seen them.
    """
    names = " from ".join(" and ".join(map(title_of, effects)) for effects in (first, second))
    best = next((item for item in proposals if item.settles), None)
    if best is not None:
        return (
            f"{best.what}, which would tell {names} by {best.separation_then:.1f} standard deviations instead of"
            f" {best.separation:.1f}"
        )
    isolating = "; ".join(
        f"{title_of(effect)} by {EFFECTS[effect].isolated_by}"
        for effect in (*first, *second)
        if effect in EFFECTS and (effect in first) != (effect in second)
    )
    weighed = "; ".join(f"{item.what}: {item.separation_then:.1f}" for item in proposals)
    text = (
        f"nothing that was weighed tells {names} by {SEEN_FROM:g} standard deviations more ({weighed}; now"
        f" {proposals[0].separation:.1f})."
    )
    if lately and any(item.measured for item in proposals):
        return (
            f"{text} A change is told by what was measured before it as well: have among the calibrating series, too, what"
            f" isolates them: {isolating}"
        )
    return f"{text} Measure what isolates them: {isolating}"


def best_repeat(problem: Problem, first: Sequence[Point], second: Sequence[Point]) -> Proposal | None:
    """The series whose repetition would separate two explanations most; None where they are alike everywhere."""

    def response(explanation: Sequence[Point]) -> FloatArray:
        return sum((one.curve.response(one.strength) for one in explanation), np.zeros(len(problem.residual)))

    apart = response(first) - response(second)
    now = length(problem.factors, problem.blocks, apart)
    if not now > 0.0:
        return None
    whitening = Whitening(problem.factors, problem.blocks)
    moved = whitening.apply(apart[None, :])[0]
    weight = Nuisances(whitening.factors).solve(moved) * moved
    by_series = np.bincount(problem.series_of, weights=weight, minlength=len(problem.views))
    found: list[Proposal] = []
    for number in np.argsort(-by_series)[:_CANDIDATES]:
        # more frames leave less counting noise, and all that is no noise as it was
        shrunk = np.where(problem.series_of == number, 1.0 - (1.0 - 1.0 / _REPEATS) * problem.noise**2, 1.0)
        root = np.sqrt(shrunk)
        found.append(
            Proposal(
                what=f"take {problem.views[int(number)].session.name} again with {_REPEATS} times as many frames",
                series=problem.views[int(number)].session.name,
                separation=now,
                separation_then=length(problem.factors / root[:, None], problem.blocks, apart / root),
            )
        )
    return max(found, key=lambda item: item.separation_then)


def length(factors: FloatArray, blocks: IndexArray, moved: FloatArray) -> float:
    """Length of a change of the probes (probe,), sd, nuisances (probe, factor), local in blocks (probe,), refitted."""
    whitening = Whitening(factors, blocks)
    whitened = whitening.apply(moved[None, :])
    return math.sqrt(max(float(Nuisances(whitening.factors).inner(whitened, whitened)[0, 0]), 0.0))


def table_text(found: Distinguishability) -> str:
    """The matrix as text, one row an effect: onset, detection, and the effects from which it is not clearly apart."""
    title = f"not distinguished there (separation below {CLEAR:g})"
    lines = [f"{'effect':<19}{'since':<12}{'seen from':>10}{'strength':>10} {'unit':<5}{'from none':>11}   {title}"]
    for row, effect in enumerate(found.effects):
        unit = EFFECTS[effect].strength.unit if effect in EFFECTS else ""
        least = f"{found.seen_from[row]:.3g}" if np.isfinite(found.seen_from[row]) else "-"
        near = [
            f"{other} {found.between[row, column]:.1f}"
            for column, other in enumerate(found.effects)
            if column != row and found.between[row, column] < CLEAR
        ]
        said = "not seen at this strength" if found.from_none[row] < CLEAR else ", ".join(near) or "-"
        known = f"{least:>10}{found.strengths[row]:>10.3g} {unit:<5}{found.from_none[row]:>11.1f}"
        lines.append(f"{effect:<19}{found.since[row]:<12}{known}   {said}")
    return "\n".join(lines)

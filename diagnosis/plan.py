"""Which effects a measurement set can tell apart, and which of its series should be taken again to break a tie.

Only expectations, noise and nuisances are used, so the frames' contents do not matter: a session that was planned, or
taken on another day, says as much.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .assemble import Problem
from .inference import Curve, Nuisances
from .whitening import Whitening

_GRID = 41  # strengths of a competitor, evenly in the logarithm
_CLEAR = 5.0  # standard deviations
_REPEATS = 4  # times as many frames
_CANDIDATES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Distinguishability:
    """Separation of effects, standard deviations, nuisances and the other's strength and inner parameters refitted.

    Fields: effects (effect,); strengths (effect,): at which each is taken, middle of its range; from_none (effect,);
    between (effect, effect): of the row's effect from the column's at whatever strength and inner parameters come nearest.
    """

    effects: tuple[str, ...]
    strengths: NDArray[np.float64]
    from_none: NDArray[np.float64]
    between: NDArray[np.float64]


def distinguishability(problem: Problem) -> Distinguishability:
    """How well the session of a problem tells the catalogue's effects apart."""
    whitening = Whitening(problem.factors, problem.blocks)
    curves = whitening.curves(problem.curves)
    nodes = np.concatenate([curve.responses for curve in curves])
    gram = Nuisances(whitening.factors).inner(nodes, nodes)
    places: list[slice] = []
    position = 0
    for curve in curves:
        places.append(slice(position, position + len(curve.responses)))
        position += len(curve.responses)
    effects = tuple(dict.fromkeys(curve.effect for curve in curves))
    strengths = np.zeros(len(effects))
    from_none = np.zeros(len(effects))
    between = np.zeros((len(effects), len(effects)))
    for row, effect in enumerate(effects):
        first = next(index for index, curve in enumerate(curves) if curve.effect == effect)
        own, mine = curves[first], places[first]
        strengths[row] = np.sqrt(own.low * own.high)
        weights = own.weights(np.array([strengths[row]]))[0]
        length = float(weights @ gram[mine, mine] @ weights)
        from_none[row] = np.sqrt(max(length, 0.0))
        nearest = np.full(len(effects), length)
        for curve, place in zip(curves, places, strict=True):
            column = effects.index(curve.effect)
            grid = curve.weights(np.geomspace(curve.low / 3.0, 1.5 * curve.high, _GRID))
            distance = (
                length
                - 2.0 * grid @ (gram[place, mine] @ weights)
                + np.einsum("si,ij,sj->s", grid, gram[place, place], grid)
            )
            nearest[column] = min(nearest[column], float(distance.min()))
        between[row] = np.sqrt(np.maximum(nearest, 0.0))
        between[row, row] = 0.0
    return Distinguishability(effects=effects, strengths=strengths, from_none=from_none, between=between)


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeat:
    """A series to take again with more frames: its name, how many times as many, separation of a tie now and then."""

    series: str
    times: int
    separation: float
    separation_then: float


def best_repeat(
    problem: Problem, first: Mapping[str, tuple[Curve, float]], second: Mapping[str, tuple[Curve, float]]
) -> Repeat | None:
    """The series whose repetition would separate two explanations most; None where they are alike everywhere.

    Args:
        problem: of the session.
        first, second: effect -> (curve of the problem, strength) of either explanation.
    """

    def response(explanation: Mapping[str, tuple[Curve, float]]) -> NDArray[np.float64]:
        return sum(
            (curve.response(strength) for curve, strength in explanation.values()), np.zeros(len(problem.residual))
        )

    apart = response(first) - response(second)
    whitening = Whitening(problem.factors, problem.blocks)
    moved = whitening.apply(apart[None, :])[0]
    shared = Nuisances(whitening.factors)
    weight = shared.solve(moved) * moved
    now = float(np.sqrt(max(float(weight.sum()), 0.0)))
    if not now > 0:
        return None
    by_series = np.bincount(problem.series_of, weights=weight, minlength=len(problem.views))
    found: list[Repeat] = []
    for number in np.argsort(-by_series)[:_CANDIDATES]:
        # more frames leave less counting noise, and all that is no noise as it was
        shrunk = np.where(problem.series_of == number, 1.0 - (1.0 - 1.0 / _REPEATS) * problem.noise**2, 1.0)
        root = np.sqrt(shrunk)
        again = Whitening(problem.factors / root[:, None], problem.blocks)
        there = again.apply((apart / root)[None, :])
        length = float(Nuisances(again.factors).inner(there, there)[0, 0])
        found.append(
            Repeat(
                series=problem.views[int(number)].session.name,
                times=_REPEATS,
                separation=now,
                separation_then=float(np.sqrt(max(length, 0.0))),
            )
        )
    return max(found, key=lambda item: item.separation_then)


def table_text(found: Distinguishability) -> str:
    """The matrix as text, one row an effect: detection, and the effects from which it is not clearly apart."""
    lines = [f"{'effect':<18}{'strength':>9}{'from none':>11}   not told apart (separation below {_CLEAR:g})"]
    for row, effect in enumerate(found.effects):
        if found.from_none[row] < _CLEAR:
            lines.append(
                f"{effect:<18}{found.strengths[row]:>9.3g}{found.from_none[row]:>11.1f}   not seen at this strength"
            )
            continue
        near = [
            f"{other} {found.between[row, column]:.1f}"
            for column, other in enumerate(found.effects)
            if column != row and found.between[row, column] < _CLEAR
        ]
        lines.append(
            f"{effect:<18}{found.strengths[row]:>9.3g}{found.from_none[row]:>11.1f}   {', '.join(near) or '-'}"
        )
    return "\n".join(lines)

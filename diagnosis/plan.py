"""Which effects a measurement set can tell apart, and which of its series should be taken again to break a tie.

Only expectations, noise and nuisances are used, so the frames' contents do not matter: a session that was planned, or
taken on another day, says as much.
"""

from collections.abc import Mapping, Sequence
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
WORTH_IT = 3.0  # standard deviations between two explanations, from which a repeat settles the matter

# what shows an effect by itself; also what a session has to hold for it to be told from its like
ISOLATED_BY = {
    "object_scatter": "a slab at two gaps to the detector, or a beam stop",
    "veiling_glare": "opaque discs of several sizes",
    "focal_spot": "an edge at two magnifications",
    "mtf_tail": "an edge close to the detector, with flats",
    "k_fluorescence": "the same at a tube voltage below the scintillator's K edge (30 kV) and above it (60 kV)",
    "image_lag": "frames with the beam off straight after an exposure",
    "nonlinearity": "flats at several exposure times and one current",
    "dark_drift": "darks in between, at the longest exposure time",
    "output_drift": "frames with an open field beside the object",
    "kv_error": "flats and two materials of known thickness at several tube voltages",
    "filtration_error": "flats at two tube voltages with and without a known filter",
    "heel": "a flat with the panel turned by 180 degrees, and a wedge at two places",
    "row_noise": "darks",
    "bad_pixels": "darks and flats",
    "excess_noise": "flats of many frames at several levels",
    "quantisation": "darks and flats at finely spaced levels",
    "motion_blur": "an edge at several exposure times of equal charge",
    "misregistration": "a grid of balls, or an edge in two directions",
    "gain_map_error": "flats repeated, and behind a filter",
    "composition_error": "a certified wedge of the product's material",
}


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


def repeat_text(repeat: Repeat, first: Sequence[str], second: Sequence[str]) -> str:
    """What to measure to tell two explanations (effects) apart: the repeat, or, where that is not worth it, what isolates them."""
    names = " and ".join(first) + " from " + " and ".join(second)
    if repeat.separation_then >= WORTH_IT:
        return (
            f"take {repeat.series} again with {repeat.times} times as many frames, which would tell {names} by"
            f" {repeat.separation_then:.1f} standard deviations instead of {repeat.separation:.1f}"
        )
    isolating = "; ".join(
        f"{effect} by {ISOLATED_BY[effect]}"
        for effect in (*first, *second)
        if effect in ISOLATED_BY and (effect in first) != (effect in second)
    )
    return (
        f"no series of this session will do: {repeat.times} times as many frames of the best one, {repeat.series}, tell"
        f" {names} by {repeat.separation_then:.1f} standard deviations instead of {repeat.separation:.1f}. Measure what"
        f" isolates them: {isolating}"
    )


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

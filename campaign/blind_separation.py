"""How far a true effect lies from everything else that could be said, in standard deviations of the session.

sigma of an effect e at its true strength s: the smallest length, in the metric C^-1 of noise and nuisances, of

    m_e(s) - m_f(t)      over every other effect f, its variants and strengths t, and over no effect at all,

so nuisances and the other effect are refitted. In a pair the strength of the partner is refitted too, by its tangent at the
truth. It is Fisher's separation: the inaccuracy of the catalogue's laws is not in it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..diagnosis.model.curves import node_weights
from .blind_statistics import CurveKey, SessionStatistics

_GRID = 61  # strengths of a competitor, evenly in the logarithm
NO_EFFECT = "no effect"


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """How far an effect lies from other models, standard deviations.

    Fields: sigma, nearest: the nearest one (an id or `no effect`); detection: from no effect; distances: from each other effect
    at its best variant and strength, by id.
    """

    sigma: float
    nearest: str
    detection: float
    distances: Mapping[str, float] = field(default_factory=dict)


def separation_of(
    statistics: SessionStatistics,
    effect: str,
    strength: float,
    *,
    since: str | None = None,
    partner: tuple[str, float, str | None] | None = None,
    without: Sequence[str] = (),
) -> Separation | None:
    """Separation of a planted effect from all other models, standard deviations.

    Args:
        statistics: of the session.
        effect, strength, since: what was planted; the strength has its sign.
        partner: the other effect of a pair, its strength and onset.
        without: effects that are no competitors.

    Returns:
        None where the catalogue has no response of the effect (it is not in it, or was left out); 0 where nothing in the
        session responds to it.
    """
    if effect in statistics.missing:
        return Separation(sigma=0.0, nearest=NO_EFFECT, detection=0.0)
    own = _best_variant(statistics, effect, strength, since)
    if own is None:
        return None
    gram = statistics.gram
    if partner is not None:
        beside = _best_variant(statistics, partner[0], partner[1], partner[2])
        if beside is not None:
            tangent = _tangent(statistics, beside, abs(partner[1]))
            column = gram @ tangent
            length = float(tangent @ column)
            if length > 0:
                gram = gram - np.outer(column, column) / length
    mine = np.zeros(len(gram))
    mine[own.nodes] = _weights(own, np.array([abs(strength)]))[0]
    image = gram @ mine
    square = max(float(mine @ image), 0.0)
    detection = math.sqrt(square)
    distances: dict[str, float] = {}
    for curve in statistics.curves:
        if curve.effect == effect or curve.effect in without or (partner is not None and curve.effect == partner[0]):
            continue
        inner, cross = gram[curve.nodes, curve.nodes], image[curve.nodes]
        low, high = curve.low / 10.0, 1.5 * curve.high
        distance = square
        for _ in range(2):  # the second time between the neighbours of the best
            strengths = np.geomspace(low, high, _GRID)
            weights = _weights(curve, strengths)
            quadratic = np.einsum("si,ij,sj->s", weights, inner, weights)
            squares = square - 2.0 * weights @ cross + quadratic
            at = int(np.argmin(squares))
            distance = min(distance, float(squares[at]))
            low, high = strengths[max(at - 1, 0)], strengths[min(at + 1, _GRID - 1)]
        distances[curve.effect] = min(distances.get(curve.effect, detection), math.sqrt(max(distance, 0.0)))
    nearest = min(distances, key=lambda name: distances[name], default=NO_EFFECT)
    # a competitor whose best strength is none is no effect
    if not distances or distances[nearest] >= detection * (1.0 - 1e-9):
        nearest = NO_EFFECT
    sigma = min([detection, *distances.values()])
    return Separation(sigma=sigma, nearest=nearest, detection=detection, distances=distances)


def matched_filter(statistics: SessionStatistics, *, bare: bool) -> dict[str, float]:
    """Correlation of the residual with each effect's template, the best of its variants and strengths, standard deviations.

    b / sqrt(G) with the nuisances' covariance, or (`bare`) N r / |N| of probes alone.
    """
    result: dict[str, float] = {}
    for curve in statistics.curves:
        if bare:
            top, length = statistics.bare[curve.nodes], statistics.bare_norm[curve.nodes]
        else:
            top, length = (
                statistics.linear[curve.nodes],
                np.sqrt(np.maximum(np.diag(statistics.gram)[curve.nodes], 0.0)),
            )
        values = np.where(length > 1e-6, top / np.maximum(length, 1e-6), 0.0)
        result[curve.effect] = max(result.get(curve.effect, 0.0), float(values.max(initial=0.0)))
    return result


def _weights(curve: CurveKey, strengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (strength, node) of a curve's nodes at strengths."""
    return node_weights(np.array(curve.strengths), strengths)


def _tangent(statistics: SessionStatistics, curve: CurveKey, strength: float) -> NDArray[np.float64]:
    """Node weights of d m / d s at a strength."""
    step = 0.01 * strength
    weights = _weights(curve, np.array([strength - step, strength + step]))
    result = np.zeros(len(statistics.gram))
    result[curve.nodes] = (weights[1] - weights[0]) / (2.0 * step)
    return result


def _best_variant(statistics: SessionStatistics, effect: str, strength: float, since: str | None) -> CurveKey | None:
    """Of an effect's variants of the right sign and onset the one that the session itself likes best at this strength."""
    own = [curve for curve in statistics.curves if curve.effect == effect]
    if not own:
        return None
    right = [curve for curve in own if curve.sign == math.copysign(1.0, strength)] or own
    right = [curve for curve in right if since is None or curve.since == since] or right

    def likelihood(curve: CurveKey) -> float:
        weights = _weights(curve, np.array([abs(strength)]))[0]
        inner = statistics.gram[curve.nodes, curve.nodes]
        return float(weights @ statistics.linear[curve.nodes] - 0.5 * weights @ inner @ weights)

    return max(right, key=likelihood)

"""What is weighed: standardised probes with what may vary beside an effect, the law of an effect that is there among it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array

from ..arrays import BoolArray, FloatArray, IndexArray
from ..model.curves import Curve
from .discrepancy import LEAST_FACTOR, credible, law_factors, own_variance
from .nuisances import Nuisances
from .steady import Steady

# of the logarithm of a strength beside which something else is sought: wide against what the probes tell of it
FREE_SD = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """An effect at a strength, its law off by a level."""

    curve: Curve  # in the units of the probes before any effect is taken off
    strength: float
    level: float
    # of the logarithm of the strength, a Gaussian: how free it is beside something else that is sought
    strength_sd: float = FREE_SD
    share: float = 0.0  # log of the mean likelihood of all the effect's variants over this one's

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.curve.effect


@dataclass(frozen=True, kw_only=True)
class Observed:
    """A residual and its covariance."""

    residual: FloatArray  # (probe,), in standard deviations
    nuisances: Nuisances  # their factor model
    groups: IndexArray  # (probe,), within which a law is off by one factor
    places: IndexArray  # (probe,), within which it is off by a share of no more than what is seen there
    series: IndexArray  # (probe,): a law leaves nothing that shows in a series, or a part of it, that it does not move
    # (probe,): series, mean and kinds of frames' differences apart, for laws of a known course; None: `series`
    aspects: IndexArray | None = None
    steady: Steady | None = None  # what of an effect a steady law could leave; None: all of it
    root: FloatArray | None = None  # (probe,): standard deviations in the units of the first probes; None: 1
    given: tuple[Point, ...] = ()  # effects that the twin has, still in the residual: `conditioned` takes them off

    @property
    def units(self) -> FloatArray:
        """Standard deviations (probe,) of the probes in the units of the first."""
        return np.ones(len(self.residual)) if self.root is None else self.root

    @cached_property
    def left(self) -> FloatArray:
        """What the nuisances leave of the residual (probe,)."""
        return self.nuisances.solve(self.residual)

    @cached_property
    def log_likelihood(self) -> float:
        """Of the residual, but for a constant that all that come from the same probes share."""
        squares = float(self.residual @ self.left)
        return -0.5 * (self.nuisances.log_determinant + squares) - float(np.sum(np.log(self.units)))

    @cached_property
    def _projected_alone(self) -> FloatArray:
        """What nuisances make of each probe by itself (probe, factor), as `Nuisances.project` has it."""
        return self.nuisances.project_each()

    @cached_property
    def _standing(self) -> dict[frozenset[str], "Observed"]:
        return {}

    def has(self, effect: str) -> bool:
        """Whether the twin has an effect."""
        return bool(self._free([effect]))

    def conditioned(self, *free: str) -> "Observed":
        """The same with the effects that the twin has as strong as it has them, but those in `free`, which are not there."""
        left_out = self._free(free)
        if left_out not in self._standing:
            found = replace(self, given=()) if self.given else self
            for point in self.given:
                if point.effect not in left_out:
                    found = found.in_presence_of(point)
            self._standing[left_out] = found
        return self._standing[left_out]

    def log_evidence_without(self, *free: str) -> float:
        """Log evidence, over all that the twin has and nothing else, of all that but the effects in `free`."""
        return self.conditioned(*free).log_likelihood - self.conditioned().log_likelihood

    def off_by(self, level: float) -> "Observed":
        """The same with laws of the effects that the twin has off by another level."""
        return replace(self, given=tuple(replace(point, level=level) for point in self.given))

    def _free(self, effects: Sequence[str]) -> frozenset[str]:
        return frozenset(point.effect for point in self.given).intersection(effects)

    def scaled(self, curve: Curve) -> Curve:
        """A curve in the units of the first probes, in these."""
        return curve if self.root is None else curve.over(self.root)

    def widened(self, curve: Curve, strength: float, level: float, *, chance: bool = True) -> "Observed | None":
        """The same residual where a curve's law (in these units) is off by a level at a strength; None: that moves nothing.

        chance: with what the effect does by chance there, its spread; what it gives each probe by itself counts in either case.
        """
        effective = self.nuisances.solve(curve.response(strength))
        effective = credible(effective, self.left, self.places)
        law = law_factors(curve, strength, effective, self.groups, level, chance=chance)
        own = own_variance(curve, strength, effective, self.places, level)
        if not law and float(own.max()) < LEAST_FACTOR:
            return None
        root = np.sqrt(1.0 + own)
        return replace(
            self,
            residual=self.residual / root,
            nuisances=self.nuisances.over(root, law.spread, law.of_laws),
            root=self.units * root,
        )

    def with_own_variance(self, variance: FloatArray) -> "Observed":
        """The same residual where each probe varies by so much more (probe,), squares of standard deviations of the first probes."""
        root = np.sqrt(1.0 + variance / self.units**2)
        no_factor = np.zeros((len(root), 0))
        return replace(
            self,
            residual=self.residual / root,
            nuisances=self.nuisances.over(root, no_factor, csc_array((0, len(root)))),
            root=self.units * root,
        )

    def in_presence_of(self, point: Point) -> "Observed":
        """What is left once an effect stands there, its strength about as it says."""
        left, of_strength = self._less(point)
        free = point.strength_sd * of_strength[:, None]
        if not np.any(free):
            return left
        return replace(left, nuisances=left.nuisances.over(np.ones(len(free)), free, csc_array((0, len(free)))))

    def score_and_information(self, point: Point) -> tuple[float, float]:
        """Slope and curvature, >= 0, of the log likelihood in the logarithm of a point's strength, about that strength."""
        left, of_strength = self._less(point)
        both = np.stack([left.residual, of_strength])
        inner = left.nuisances.inner(both, both)
        return float(inner[0, 1]), max(float(inner[1, 1]), 0.0)

    def _less(self, point: Point) -> tuple["Observed", FloatArray]:
        """What an effect leaves at a point, and the slope (probe,) of its response with the logarithm of the strength."""
        wide = self.widened(self.scaled(point.curve), point.strength, point.level) or self
        own = wide.scaled(point.curve)
        return replace(wide, residual=wide.residual - own.response(point.strength)), slope(own, point.strength)

    def of_probes(self, probes: BoolArray) -> "Observed":
        """Of some of its probes (probe,)."""
        return replace(
            self,
            residual=self.residual[probes],
            nuisances=self.nuisances.of_probes(probes),
            groups=self.groups[probes],
            places=self.places[probes],
            series=self.series[probes],
            aspects=None if self.aspects is None else self.aspects[probes],
            steady=None,
            root=None if self.root is None else self.root[probes],
        )

    def length(self, curve: Curve, strength: float) -> float:
        """How far a curve (in these units) moves the probes at a strength, by its law and by chance, nuisances aside; sd."""
        moved = self._moved(curve, strength)
        squares = float(np.trace(self.nuisances.inner(moved, moved)))
        if curve.jitter is not None:
            squares += strength**2 * float(np.sum(curve.jitter))
        return math.sqrt(max(squares, 0.0))

    def acting(self, points: Sequence[Point]) -> tuple[IndexArray, FloatArray]:
        """Part of the session (probe,) in which laws leave no more than a share of what they do there, and that: squares (part,).

        Of effects that are the same in every frame, or new in each, mean and noise of frames are parts of their own. What is new in
        every frame does nothing to their mean but by chance, which the covariance holds.
        """
        known = all(point.curve.variant.course for point in points)
        parts = self.aspects if known and self.aspects is not None else self.series
        squares = [
            self.power_by_part(
                replace(point.curve, spread=None, jitter=None)
                if known and point.curve.variant.course == "random"
                else point.curve,
                point.strength,
                parts,
            )
            for point in points
        ]
        return parts, np.sum(squares, axis=0)

    def power_by_part(self, curve: Curve, strength: float, parts: IndexArray) -> FloatArray:
        """The square of `length` in each of some parts (part,), were the curve (in these units) to move that part and no other.

        So a nuisance that parts share brings nothing into those that the curve does not move.
        """
        moved = self._moved(curve, strength)
        squares = np.sum(moved**2, axis=0)
        if curve.jitter is not None:
            squares = squares + strength**2 * curve.jitter
        found = np.bincount(parts, weights=squares)
        for part in range(len(found)):
            own = np.flatnonzero(parts == part)
            found[part] -= float(np.sum((moved[:, own] @ self._projected_alone[own]) ** 2))
        return np.maximum(found, 0.0)

    @staticmethod
    def _moved(curve: Curve, strength: float) -> FloatArray:
        """Rows (1 + chance, probe): what a curve's law does at a strength, and what it does by chance."""
        return np.concatenate([curve.response(strength)[None, :], strength * curve.chance.T])


def slope(curve: Curve, strength: float) -> FloatArray:
    """Change (probe,) of a response with the logarithm of the strength."""
    step = 0.02
    above, below = curve.response(strength * math.exp(step)), curve.response(strength * math.exp(-step))
    return np.asarray((above - below) / (2.0 * step))

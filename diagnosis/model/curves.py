"""What an effect would do to the probes at any strength: its responses at a few, and how they are joined."""

from collections.abc import Sequence, Sized
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from ..arrays import BoolArray, FloatArray
from . import _node_loops
from .changes import Variant

LEAST_RESPONSE = 1e-3  # standard deviations of a probe, below which it responds to nothing, effect or nuisance
STRENGTH_NODES = 37
_WEAKER = 30.0  # times below its plausible range that an effect is tried
_STRONGER = 2.5  # times above it where the response grows in proportion to the strength
_BEYOND_NODES = 1.5  # times above the last strength that was asked, elsewhere


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Response of the probes to one variant of an effect, 0 at strength 0.

    Between nodes and zero the response is interpolated (Lagrange through the four nearest points, 0 one of them).
    """

    variant: Variant
    responses: FloatArray  # (node, probe): at the variant's strengths, standardised as the probes are
    # (probe, factor): random responses a unit of strength, as a drifting output shifts each series' level
    spread: FloatArray | None = None
    # (probe,): variance a unit of strength squared of each probe by itself, as of a gain map that changed pixel by pixel
    jitter: FloatArray | None = None
    exact: BoolArray | None = None  # (probe,): probes that the strength is defined by, in which no law can be far off

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.variant.effect

    @property
    def strengths(self) -> FloatArray:
        """Strengths (node,) of the responses."""
        return np.array(self.variant.strengths)

    @property
    def reach(self) -> tuple[float, float]:
        """Strengths between which the curve is tried: beyond the plausible range on both sides."""
        own = self.variant
        highest = _STRONGER * own.high
        if len(own.strengths) > 1:
            highest = _BEYOND_NODES * max(own.high, own.strengths[-1])
        return own.low / _WEAKER, min(highest, own.most)

    def log_strengths(self) -> FloatArray:
        """Strengths at which integrals are taken: evenly in the logarithm over the reach, and the ends of the plausible range."""
        ends = np.array([self.variant.low, self.variant.high])
        return np.unique(np.concatenate([np.geomspace(*self.reach, STRENGTH_NODES), ends]))

    @property
    def chance(self) -> FloatArray:
        """What the effect does by chance (probe, factor), a unit of strength: its spread, of no factor where it has none."""
        return np.zeros((self.responses.shape[1], 0)) if self.spread is None else self.spread

    @property
    def by_chance_alone(self) -> bool:
        """Whether the effect moves no probe by a known amount, but some by chance."""
        return self.spread is not None and not bool(np.any(np.abs(self.responses) > LEAST_RESPONSE))

    def weights(self, strength: FloatArray) -> FloatArray:
        """Weights (strength, node) with which the nodes' responses add up at given strengths."""
        return node_weights(self.strengths, np.atleast_1d(np.asarray(strength, dtype=np.float64)))

    def response(self, strength: float) -> FloatArray:
        """Response (probe,) at one strength."""
        return np.asarray(self.weights(np.array([strength]))[0] @ self.responses)

    def of_probes(self, probes: BoolArray) -> "Curve":
        """The curve of some of its probes (probe,)."""
        return replace(
            self,
            responses=self.responses[:, probes],
            spread=None if self.spread is None else self.spread[probes],
            jitter=None if self.jitter is None else self.jitter[probes],
            exact=None if self.exact is None else self.exact[probes],
        )

    def over(self, root: FloatArray) -> "Curve":
        """The curve of probes whose standard deviations are `root` (probe,) times as large."""
        return replace(
            self,
            responses=self.responses / root,
            spread=None if self.spread is None else self.spread / root[:, None],
            jitter=None if self.jitter is None else self.jitter / root**2,
        )


def places_of(parts: Sequence[Sized]) -> list[slice]:
    """Where each of several parts lies among all of them one after the other."""
    stops = accumulate(map(len, parts))
    return [slice(stop - len(part), stop) for part, stop in zip(parts, stops, strict=True)]


def node_weights(nodes: FloatArray, strengths: FloatArray) -> FloatArray:
    """Weights (strength, node) with which responses at nodes > 0 add up: Lagrange through the four nearest of 0 and nodes."""
    return np.asarray(_node_loops.node_weights(nodes, strengths))

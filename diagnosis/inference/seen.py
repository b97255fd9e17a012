"""What refinement fits an effect to: the residual less what others explain, of all series or of those that tell most."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..model.changes import Variant
from ..model.curves import Curve
from .curve_fits import CurveFit, fit_curve
from .discrepancy import LEVELS, USUAL_LEVEL, only
from .nuisances import Whitening
from .observed import Observed, Point

_TELLS = 0.8  # share of what tells an effect, its law off as usual, that the series of a search hold
_WORTH = 0.7  # share of all series' cost from which a search asks all of them


class Responder(Protocol):
    """Responses (strength, probe) of variants, by their place; those that cannot be asked are left out.

    `wanted` (probe,) says which probes are; others may be 0.
    """

    def __call__(self, asked: Sequence[Variant], /, wanted: BoolArray | None = None) -> Mapping[int, FloatArray]: ...


@dataclass(frozen=True, slots=True)
class Blocks:
    """Series that share local nuisances: `of` (probe,) is the block of each probe, `costs` (block,) how long it takes to ask it."""

    of: IndexArray
    costs: FloatArray

    def telling(self, tells: FloatArray) -> BoolArray | None:
        """Probes (probe,) of the blocks that tell most, by what each probe tells, for what they cost; None: nearly all are needed.

        Blocks that cost less than a tenth of the dearest are always among them: they say what nuisances do.
        """
        of_block = np.maximum(np.bincount(self.of, weights=tells, minlength=len(self.costs)), 0.0)
        kept = self.costs < 0.1 * self.costs.max()
        # a series without probes costs nothing
        worth = np.divide(of_block, self.costs, out=np.zeros(len(of_block)), where=self.costs > 0.0)
        for block in np.argsort(-worth):
            if float(of_block[kept].sum()) >= _TELLS * float(of_block.sum()):
                break
            kept[block] = True
        if float(self.costs[kept].sum()) > _WORTH * float(self.costs.sum()):
            return None
        return np.asarray(kept[self.of])


@dataclass(frozen=True, slots=True, kw_only=True)
class FitTarget:
    """What one effect is fitted to, in curves whitened and in the units of the first probes, and how the forward model is asked."""

    observed: Observed
    respond: Responder
    whitening: Whitening  # of its responses
    blocks: Blocks | None = None  # of series; None: all are asked
    wanted: BoolArray | None = None  # which of all probes these are; None: all
    level: float = USUAL_LEVEL  # by which laws are taken to be off

    def in_presence_of(self, point: Point) -> "FitTarget":
        """The same once another effect stands there."""
        return replace(self, observed=self.observed.in_presence_of(point))

    def most_informative(self, fit: CurveFit) -> "FitTarget":
        """The same of the series that tell most of a fitted curve; itself where nearly all are needed."""
        if self.blocks is None:
            return self
        wide = self.widened(fit.curve, fit.best)
        response = fit.curve.response(fit.best) / wide.units
        kept = self.blocks.telling(response * wide.nuisances.solve(response))
        if kept is None:
            return self
        return replace(self, observed=self.observed.of_probes(kept), blocks=None, wanted=kept)

    def widened(self, curve: Curve, strength: float) -> Observed:
        """What is seen where a curve's law is off at a strength."""
        return self.observed.widened(self.observed.scaled(curve), strength, self.level) or self.observed

    def ask(self, variants: Sequence[Variant]) -> dict[int, FloatArray]:
        """Responses (strength, probe) of variants by their place, whitened."""
        return {number: self.own(found) for number, found in self.respond(variants, wanted=self.wanted).items()}

    def own(self, responses: FloatArray) -> FloatArray:
        """Responses of all probes as the forward model gives them, whitened, of these probes."""
        whitened = self.whitening.apply(responses)
        return whitened if self.wanted is None else whitened[:, self.wanted]

    def cut(self, curve: Curve) -> Curve:
        """A curve of all probes, of these."""
        return curve if self.wanted is None else curve.of_probes(self.wanted)

    def fit(self, curve: Curve) -> CurveFit:
        """A curve of these probes, fitted with its law off by the level."""
        return fit_curve(self.observed, curve, levels=only(self.level))

    def at_smaller_level(self) -> "FitTarget | None":
        """The same with laws off by the level two below, or exact; None: they are exact."""
        below = sum(level < self.level for level in LEVELS.levels)
        return replace(self, level=LEVELS.levels[max(below - 2, 0)]) if below else None

    def evidence(self, curve: Curve) -> float:
        """Log evidence of a curve of these probes, its law off by any level."""
        return fit_curve(self.observed, curve).log_evidence

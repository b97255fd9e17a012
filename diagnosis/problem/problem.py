"""What inference is asked about: the probes of a session, what may explain them, and what stands beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...checks.readings import Explained
from ...generator.effects import EFFECTS, AppliedEffect
from ...generator.effects.effect import OF_FRAMES
from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.twin import Twin
from ..arrays import BoolArray, FloatArray, IndexArray
from ..inference.observed import Point
from ..inference.seen import Blocks
from ..inference.unknown import Families
from ..model.changes import Variant
from ..model.curves import Curve
from ..model.forward_model import draft_cache
from ..model.responses import SessionModel
from ..probes.probes import ProbeName
from ..session.even_maps import full_size
from ..session.summaries import LEAST_NOISE_DN2
from .asked_again import AskedAgain
from .scenes_apart import scenes_apart
from .series_block import SeriesView

_WITHOUT_SCENE = 0.07  # time that a series without a scene takes, over that of one with a scene


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Everything that inference needs; probes are standardised."""

    residual: FloatArray  # (probe,)
    factors: FloatArray  # (probe, nuisance)
    factor_names: tuple[str, ...]
    curves: tuple[Curve, ...]
    names: tuple[ProbeName, ...]  # one a probe
    series_of: IndexArray  # (probe,): index into views
    sd: FloatArray  # (probe,): of scalar probes in their unit, 1 for map probes
    noise: FloatArray  # (probe,): counting noise's share of each probe's standard deviation
    groups: IndexArray  # (probe,): within which an effect's law is off by one factor
    families: Families  # in which an unknown effect may show
    blocks: IndexArray  # (probe,): series that share local nuisances
    views: tuple[SeriesView, ...]
    session: SessionModel  # the forward model of its series
    skipped: tuple[str, ...]  # what could not be used and why
    missing_effects: dict[str, str]  # that cannot be judged here, and why
    again: AskedAgain | None  # asks the forward model once more; None: released
    side: int = 1  # of the squares of the panel's pixels that stand for pixels
    given: tuple[Point, ...] = ()  # the effects of the base, taken off the residual, at their strengths

    @property
    def base(self) -> Twin:
        """The twin with all pixels alike, and the effects that it has."""
        return self.session.model.base

    @property
    def conditions(self) -> Mapping[str, float]:
        """Conditions of the session that effects know."""
        return self.session.model.conditions

    def in_series(self, variant: Variant, series: Sequence[int], log_prior: float) -> "Problem":
        """With a variant as it acts in some series (numbers of views) alone, as one more variant."""
        names = tuple(self.views[number].session.name for number in series)
        name = f"{variant.name}, in {len(names)} series".strip(", ")
        curve = next(item for item in self.curves if item.variant == variant)
        own = Curve(
            variant=replace(variant, name=name, series=names, log_prior=log_prior),
            responses=np.where(np.isin(self.series_of, series), curve.responses, 0.0),
        )
        return replace(self, curves=(*self.curves, own))

    def with_scenes_apart(self) -> "Problem":
        """With one more variant of an effect that displaces scenes, where there are several: each has an amount of its own."""
        had = {point.effect for point in self.given}
        own = scenes_apart(
            [curve for curve in self.curves if curve.effect not in had],
            [view.session.place if view.session.series.kind == "object" else None for view in self.views],
            [view.session.name for view in self.views],
            self.series_of,
        )
        return self if own is None else replace(self, curves=(*self.curves, own))

    def residual_without(self, effects: Sequence[str]) -> FloatArray:
        """The residual (probe,) of the base less those of its own effects that are among these."""
        left = self.residual.copy()
        for point in self.given:
            if point.effect in effects:
                left += point.curve.response(point.strength)
        return left

    def left_by(self, points: Sequence[Point], *, without: Sequence[str] = ()) -> FloatArray:
        """What effects at their strengths leave of the residual (probe,).

        They take the place of the base's own; of these, those in `without` are not there either.
        """
        left = self.residual_without((*(point.effect for point in points), *without))
        for point in points:
            left -= point.curve.response(point.strength)
        return left

    def with_chance(self, points: Sequence[Point]) -> tuple[FloatArray, FloatArray]:
        """Factors (probe, factor) of nuisances and of what effects do by chance; variance (probe,) of each probe by itself."""
        factors = np.concatenate([self.factors, *(point.strength * point.curve.chance for point in points)], axis=1)
        variance = np.ones(len(self.residual))
        for point in points:
            if point.curve.jitter is not None:
                variance += point.strength**2 * point.curve.jitter
        return factors, variance

    @property
    def places(self) -> IndexArray:
        """Place of each probe (probe,): one axis of one series, or what one effect alone can make there."""
        return self._numbered([name.axis for name in self.names])

    @property
    def left_apart(self) -> IndexArray:
        """Series of each probe (probe,), what one effect alone can make apart: a law leaves nothing where it moves nothing."""
        return self._numbered(["" for _ in self.names])

    @property
    def aspects(self) -> IndexArray:
        """The same (probe,), with what a series' mean frame shows and each kind of what its frames differ by apart."""
        return self._numbered([name.axis if name.axis in OF_FRAMES else "mean frame" for name in self.names])

    @property
    def alike(self) -> IndexArray:
        """Number (probe,) of the beam, scene and geometry, calibrating or not, of a probe of the mean frame; -1 for others."""
        keys = []
        for view, name in zip(self.series_of, self.names, strict=True):
            own, asked = self.views[view].session, self.views[view].session.request
            beam = own.series.kind, own.series.scene, own.series.kV, own.series.filters
            geometry = asked.source_object_mm, asked.source_detector_mm, asked.panel_rotation_deg
            other = name.statistic != "mean frame" or own.series.kind == "dark"
            keys.append("" if other else f"{beam} {geometry} {own.calibrates}")
        _, found = np.unique(keys, return_inverse=True)
        return np.where(np.array(keys) == "", -1, found).astype(np.intp)

    def _numbered(self, kinds: Sequence[str]) -> IndexArray:
        exact = read_exactly()
        own = [
            name.statistic if name.statistic in exact else kind for name, kind in zip(self.names, kinds, strict=True)
        ]
        keys = [f"{series} {kind}" for series, kind in zip(self.series_of, own, strict=True)]
        _, found = np.unique(keys, return_inverse=True)
        return np.asarray(found, dtype=np.intp)

    @property
    def asked_in_blocks(self) -> Blocks:
        """Series that share local nuisances, and what it costs to ask the forward model for them."""
        costs = np.zeros(int(self.blocks.max()) + 1)
        for number, first in zip(*np.unique(self.series_of, return_index=True), strict=True):
            scene = self.views[number].session.series.kind == "object"
            costs[self.blocks[first]] += 1.0 if scene else _WITHOUT_SCENE
        return Blocks(of=self.blocks, costs=costs)

    def explained_by(self, effects: Sequence[AppliedEffect]) -> dict[str, Explained]:
        """What effects do to each series that they can show in, by its name."""
        model = self.session.model
        change = model.with_found(effects)
        return {
            view.session.name: _difference(
                view.expected, model.under(change, view.session.request), shape=view.residual_DN.shape
            )
            for view in self.views
            if change.touches(view.session.request)
        }

    def released(self) -> "Problem":
        """Without the frames' projections, so that nothing can be asked again, and without what the forward model keeps."""
        model = replace(self.session.model, cache=draft_cache())
        return replace(self, again=None, session=replace(self.session, model=model))

    def respond(self, variants: Sequence[Variant], /, wanted: BoolArray | None = None) -> Mapping[int, FloatArray]:
        """Responses (strength, probe) of further variants, see `AskedAgain.respond`."""
        return self._open.respond(variants, wanted)

    def with_nuisances_beside(self, effects: Sequence[AppliedEffect]) -> "Problem":
        """With nuisances as they act where effects have been found, see `AskedAgain.factors_with`."""
        factors = self._open.factors_with(effects)
        return replace(self, factors=np.stack(list(factors.values()), axis=1), factor_names=tuple(factors))

    @property
    def _open(self) -> AskedAgain:
        if self.again is None:
            raise RuntimeError("asked of a problem whose projections were released")
        return self.again

    def with_variants(self, more: Sequence[tuple[Variant, FloatArray]]) -> "Problem":
        """With further variants and their responses (strength, probe)."""
        curves = []
        for variant, responses in more:
            # what an effect does by chance depends on its onset (lost bits lower later levels only), and on the direction of a heel
            onset = variant.effect, variant.since
            alike = [item for item in self.curves if (item.effect, item.variant.since) == onset]
            like = next((item for item in alike if item.variant.name == variant.refined_from), alike[0])
            inflow = self._open.border_inflow(variant.applied(variant.strengths[-1]))
            spread = like.spread if inflow is None else inflow
            curves.append(replace(like, variant=variant, responses=responses, spread=spread))
        return replace(self, curves=(*self.curves, *curves))


def _difference(before: ExpectedSeries, after: ExpectedSeries, *, shape: tuple[int, ...]) -> Explained:
    """What has been added to a series' mean, and by what its frames' variance was multiplied (row, column)."""
    first, last = (
        np.maximum(item.quantum_variance_DN2 + item.white_variance_DN2, LEAST_NOISE_DN2) for item in (before, after)
    )
    mean_DN = full_size(after.mean_DN - before.mean_DN, shape)
    return Explained(mean_DN=mean_DN, variance=full_size(last / first, shape))


def read_exactly() -> frozenset[str]:
    """Statistics that one effect alone can make, by name."""
    return frozenset(name for effect in EFFECTS.values() if effect.reading.sd == 0.0 for name in effect.reading.probes)

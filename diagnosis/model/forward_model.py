"""The base twin as series ask it, and what it expects of them under changes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from ...generator.effects import EFFECTS, AppliedEffect
from ...generator.frames.conditions import with_conditions
from ...generator.frames.line_model import ExpectedSeries, LineModel
from ...generator.frames.model_cache import ModelCache
from ...generator.line.series_request import SeriesRequest
from ...generator.line.twin import Twin
from ..arrays import FloatArray
from ..probes.registration import SHARP_PX
from ..session.session import SessionSeries
from .changes import OF_BEAMS_GROWS, Change, Variant, departures_found
from .curves import places_of

_CACHE_BYTES = 400_000_000
_IN_MAPS_OF_BEAMS = "maps of beams"  # the twin's own maps hold what was always there of these


def draft_cache() -> ModelCache:
    """A cache for responses: single pixels stand for maps that are the same everywhere."""
    return ModelCache(draft=True, budget_bytes=_CACHE_BYTES)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForwardModel:
    """The base twin as the series of a session ask it."""

    base: Twin  # with all pixels alike, and the effects that it has
    conditions: dict[str, float]  # of the session, that effects know
    own_maps: bool = True  # flats of the session make the gain map, and are asked for what was always there
    cache: ModelCache = field(default_factory=draft_cache)  # filled by asking

    @property
    def sharp(self) -> bool:
        """Whether pixels see no farther than themselves, along one axis at least."""
        spread = self.base.noise.spread.value
        return spread.sigma_px < SHARP_PX or spread.axes != "both"

    @property
    def beams_differ(self) -> float:
        """How many times more than usual beams may differ from the spectral model: 1 unless calibration found large departures."""
        return 1.0 + OF_BEAMS_GROWS * (departures_found(self.base.spectral) - 1.0)

    @property
    def unchanged(self) -> Change:
        """The base twin itself."""
        return Change(label="base", twin=self.base)

    def change(self, variant: Variant, strength: float) -> Change:
        """An effect of the catalogue at a strength, in this session; it takes the place of the same one, if the base has that."""
        beside = [] if variant.beside is None else [variant.beside]
        return replace(self.with_found([*beside, variant.applied(strength)]), label=variant.effect)

    def with_found(self, effects: Sequence[AppliedEffect]) -> Change:
        """The base twin with effects in this session; they take the place of the same ones, if the base has those."""
        applied = tuple(with_conditions(item, self.conditions) for item in effects)
        return replace(self.without(*(item.id for item in effects)), label="found", effects=applied)

    def without(self, *effects: str) -> Change:
        """The base twin less some of its effects; the base itself where it has none of them."""
        had = tuple(item for item in self.base.effects if item.id in effects)
        rest = tuple(item for item in self.base.effects if item.id not in effects)
        twin = replace(self.base, effects=rest) if had else self.base
        return Change(label=f"without {', '.join(effects)}", twin=twin, instead_of=had)

    def carried_px(self, change: Change, request: SeriesRequest) -> tuple[float, float]:
        """How much farther than in the base twin a scene lies on average under a change, along rows and columns."""
        down, right = _mean_shift_px((*change.twin.effects, *change.effects), change.twin, request)
        base_down, base_right = _mean_shift_px(self.base.effects, self.base, request)
        return down - base_down, right - base_right

    def expect(self, request: SeriesRequest) -> ExpectedSeries:
        """The series as the base twin expects it; raises as `under`."""
        return self.under(self.unchanged, request)

    def expect_changed(self, request: SeriesRequest, change: Change, unchanged: ExpectedSeries) -> ExpectedSeries:
        """The series under a change: `unchanged` itself where the change cannot show; raises as `under`."""
        return self.under(change, request) if change.touches(request) else unchanged

    def under(self, change: Change, request: SeriesRequest) -> ExpectedSeries:
        """A series under a change, whether that can show there or not.

        Raises:
            InputError: the twin knows too little for it.
        """
        line, shown = self._line(change, request)
        return line.expect(shown)

    def from_beyond(self, change: Change, request: SeriesRequest) -> FloatArray:
        """What surroundings would let into the field of a series under a change, see `LineModel.from_beyond`; raises as `under`."""
        line, shown = self._line(change, request)
        return line.from_beyond(shown)

    def _line(self, change: Change, request: SeriesRequest) -> tuple[LineModel, SeriesRequest]:
        """The line under a change, and the series as it is asked of it."""
        effects = (*change.twin.effects, *change.effects)
        in_maps = {item.id for item in effects if EFFECTS[item.id].absorbed == _IN_MAPS_OF_BEAMS}
        if self.own_maps and any(item.id in in_maps and item.since == "always" for item in effects):
            acting = (item for item in effects if item.since == "always" or request.after_calibration)
            effects = tuple(replace(item, since="calibration") if item.id in in_maps else item for item in acting)
            request = replace(request, after_calibration=True)
        line = LineModel(
            change.twin, effects=effects, parameters=change.parameters, cache=self.cache, use_measured_level=False
        )
        return line, request


def _mean_shift_px(effects: Sequence[AppliedEffect], twin: Twin, request: SeriesRequest) -> tuple[float, float]:
    """How far effects displace a scene on average that registration finds, and that are no displacements themselves."""
    down, right = 0.0, 0.0
    for item in effects:
        effect = EFFECTS[item.id]
        if effect.mean_shift is not None and (item.since == "always" or request.after_calibration):
            of_one = effect.mean_shift(effect.values(item.parameters), request, twin)
            down, right = down + of_one[0], right + of_one[1]
    return down, right


def own_maps(series: Iterable[SessionSeries]) -> bool:
    """Whether flats of the session make the gain map."""
    return any(item.calibrates and item.series.kind == "flat" for item in series)


def strength_rows(variants: Sequence[Variant]) -> list[slice]:
    """Where each variant's strengths lie among those of all variants one after the other."""
    return places_of([variant.strengths for variant in variants])

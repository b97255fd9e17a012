"""The base twin as series ask it, and the changes of it that a diagnosis tries: what each can move at all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..generator.effects import EFFECTS, AppliedEffect
from ..generator.effects.registration import angles_of, parts_px
from ..generator.series import ExpectedSeries, ModelCache, SeriesRequest, expected_series, with_conditions
from ..generator.twin import Twin
from .changes import OF_BEAMS_GROWS, TwinChange, Variant, departures_found
from .probes import ALONG_COLUMNS, ALONG_ROWS
from .registration import SHARP_PX
from .session import SessionSeries

_CACHE_BYTES = 200_000_000
_KNOW_WHEN = frozenset(
    ("heel", "bad_pixels", "gain_map_error")
)  # effects that look otherwise where calibration has seen them
_TAKEN_IN = frozenset(("heel",))  # the twin's own maps hold what was always there of these, beam by beam
_ON_OBJECTS_ALONE = frozenset(
    {item.id for item in EFFECTS.values() if item.stage == "object_blur"}
    | {"misregistration", "object_scatter", "composition_error"}
)
# beside blurs: effects that make edges look as if they lay elsewhere
_RESHAPES = frozenset(("misregistration", "object_scatter", "composition_error"))
# what singles pixels out
_STANDS_OUT = frozenset(("bad_pixels", "gain_map_error"))
_ALL_SHIFT = 0.017  # share of a misregistration that may be anything else


def draft_cache() -> ModelCache:
    """A cache for responses: single pixels stand for maps that are the same everywhere."""
    return ModelCache(draft=True, budget_bytes=_CACHE_BYTES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A change asked of the forward model.

    Fields: label: effect or nuisance; twin; effects, besides those that the twin has; parameters (parameter,) of the spectrum in
    place of the best ones; step_sd: size of a nuisance's step in prior standard deviations; spectral: moves lit series alone.
    """

    label: str
    twin: Twin
    effects: tuple[AppliedEffect, ...] = ()
    parameters: NDArray[np.float64] | None = None
    step_sd: float = 1.0
    spectral: bool = False

    @classmethod
    def of_twin(cls, step: TwinChange) -> "Change":
        """A step in what calibration has fitted."""
        return cls(
            label=step.name,
            twin=step.twin,
            parameters=step.parameters,
            step_sd=step.step_sd,
            spectral=step.parameters is not None,
        )

    def touches(self, request: SeriesRequest) -> bool:
        """Whether the change can show in a series."""
        if not self.effects:
            return self.spectral is False or request.beam_on
        for effect in self.effects:
            if effect.since == "calibration" and not request.after_calibration:
                continue
            if can_show(effect.id, request) and not (effect.id in _ON_OBJECTS_ALONE and self.only_displaces):
                return True
        return False

    @property
    def only_displaces(self) -> bool:
        """Whether the change is a mere shift of the scene, which registration takes out of the pictures."""
        misplaced = self._misplaced
        return misplaced is not None and math.hypot(misplaced.radial, misplaced.turn) <= _ALL_SHIFT * misplaced.size

    @property
    def displacement(self) -> dict[str, float]:
        """Displacement (px) that the change brings to a scene's picture, by probe; empty: none."""
        misplaced = self._misplaced
        if misplaced is None:
            return {}
        angle = math.radians(misplaced.effect.parameters.get("direction_deg", 0.0))
        return {ALONG_ROWS: misplaced.shift * math.cos(angle), ALONG_COLUMNS: misplaced.shift * math.sin(angle)}

    def found_in_place(self) -> "Change":
        """The change as it shows once registration has found the scene: of a misregistration, what is no shift."""
        misplaced = self._misplaced
        if misplaced is None or self.only_displaces:
            return self
        rest = {**angles_of(0.0, misplaced.radial, misplaced.turn), "direction_deg": 0.0}
        effect = misplaced.effect
        others = (item for item in self.effects if item is not effect)
        return replace(self, effects=(*others, replace(effect, parameters={**effect.parameters, **rest})))

    @property
    def _misplaced(self) -> "_Misplaced | None":
        for effect in self.effects:
            if effect.id == "misregistration":
                size = effect.parameters["strength"]
                angles = {name: effect.parameters.get(name, 0.0) for name in ("magnification_deg", "rotation_deg")}
                return _Misplaced(effect, abs(size), *parts_px(size, **angles))
        return None

    def whenever_it_began(self, request: SeriesRequest) -> object | None:
        """What stands for a change of a series that the same effect, begun at another time, makes as well; None: only itself."""
        if len(self.effects) != 1 or self.effects[0].id in _KNOW_WHEN or not self.touches(request):
            return None
        effect = self.effects[0]
        if effect.since == "always" and any(not item.after_calibration for item in request.previous):
            return None  # what was exposed before calibration ended remembers when it began
        return (effect.id, tuple(effect.parameters.items()), tuple(effect.options.items()))


@dataclass(frozen=True, slots=True)
class _Misplaced:
    """A misregistration in px: its rms size, and the parts of it that shift, enlarge and turn."""

    effect: AppliedEffect
    size: float
    shift: float
    radial: float
    turn: float


def can_show(effect: str, request: SeriesRequest) -> bool:
    """Whether an effect of the catalogue can move a series at all, whatever its law."""
    if effect in _ON_OBJECTS_ALONE:
        return request.kind == "object"
    if EFFECTS[effect].stage in ("beam", "arrivals", "quanta", "optics", "exposure"):
        return request.beam_on
    return True


def can_displace(effect: str) -> bool:
    """Whether an effect of the catalogue, or what is wrong with its law, can seem to move a scene's picture."""
    return effect in _RESHAPES or EFFECTS[effect].stage in ("object_blur", "optics")


def can_stand_out(effect: str) -> bool:
    """Whether an effect of the catalogue, or what is wrong with its law, can make single pixels stand out of their neighbours."""
    return effect in _STANDS_OUT


@dataclass(frozen=True, slots=True, kw_only=True)
class ForwardModel:
    """The base twin as the series of a session ask it.

    Fields: base: the twin with all pixels alike, and the effects that it has; conditions of the session that effects know;
    own_maps: flats of the session make the gain map, so that these, too, are asked for what was always there;
    cache, filled by asking.
    """

    base: Twin
    conditions: dict[str, float]
    own_maps: bool = True
    cache: ModelCache = field(default_factory=draft_cache)

    @property
    def sharp(self) -> bool:
        """Whether pixels see no farther than themselves."""
        return self.base.noise.spread.value.sigma_px < SHARP_PX

    @property
    def beams_differ(self) -> float:
        """How many times more than usual beams may differ from the spectral model: 1 unless calibration found large departures."""
        return 1.0 + OF_BEAMS_GROWS * (departures_found(self.base.spectral) - 1.0)

    def change(self, variant: Variant, strength: float) -> Change:
        """An effect of the catalogue at a strength, in this session."""
        applied = with_conditions(variant.applied(strength), self.conditions)
        return Change(label=variant.effect, twin=self.base, effects=(applied,))

    def expect(self, request: SeriesRequest) -> ExpectedSeries:
        """The series as the base twin expects it.

        Raises:
            InputError: the twin knows too little for it.
        """
        return self._asked(request, Change(label="base", twin=self.base))

    def expect_changed(self, request: SeriesRequest, change: Change, unchanged: ExpectedSeries) -> ExpectedSeries:
        """The series under a change: `unchanged` itself where the change cannot show.

        Raises:
            InputError: the twin knows too little for it.
        """
        return self._asked(request, change) if change.touches(request) else unchanged

    def expect_all(self, items: Sequence[SessionSeries]) -> tuple[dict[str, ExpectedSeries], list[str]]:
        """The series as the base twin expects them, by name, and why others cannot be."""
        expected: dict[str, ExpectedSeries] = {}
        refused: list[str] = []
        for item in items:
            try:
                expected[item.name] = self.expect(item.request)
            except InputError as error:
                refused.append(f"{item.name}: {error}")
        return expected, refused

    def _asked(self, request: SeriesRequest, change: Change) -> ExpectedSeries:
        effects = (*change.twin.effects, *change.effects)
        if self.own_maps and any(item.id in _TAKEN_IN and item.since == "always" for item in effects):
            acting = (item for item in effects if item.since == "always" or request.after_calibration)
            effects = tuple(replace(item, since="calibration") if item.id in _TAKEN_IN else item for item in acting)
            request = replace(request, after_calibration=True)
        return expected_series(
            change.twin,
            request,
            effects=effects,
            parameters=change.parameters,
            cache=self.cache,
            use_measured_level=False,
        )


def strength_rows(variants: Sequence[Variant]) -> list[range]:
    """Where each variant's strengths lie among those of all variants one after the other."""
    stops = np.cumsum([len(variant.strengths) for variant in variants], dtype=np.intp)
    return [range(int(stop) - len(variant.strengths), int(stop)) for variant, stop in zip(variants, stops, strict=True)]

"""The light of one exposure: beam, projection, quanta and spread, up to the charge that it brings to the pixels.

Under even illumination, before the spread, one exposure has signal P = sum_E w1 exp(-mu t) and quantum variance
V = sum_E w2 exp(-mu t); the flat's shape s and the relative gain g of the pixels act at readout: mean s P, variance
s g V. Light that leaves the field is replaced by as much that enters: borders mirror.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..effects import AppliedEffect, Effect
from ..line.line_state import FloatArray, LineContext, LineState
from ..line.series_request import SeriesRequest
from ..line.twin import Twin
from ..spread.psf import Spread
from ._spread import Kept, NoisePattern, noise_pattern, spread_maps
from .beam import BeamProjection, model_of, project_beam
from .declared_spot import blur_by_declared_spot
from .model_cache import ModelCache
from .stated_belt import blur_by_belt

# what a series is called and when it was taken does not change the light
_OF_THE_SPREAD = (
    "kind",
    "exposure_ms",
    "source_object_mm",
    "source_detector_mm",
    "belt_speed_mm_s",
    "belt_axis",
    "panel_rotation_deg",
)
_OF_THE_LIGHT = (*_OF_THE_SPREAD, "open_signal_DN", "product_material", "scene_kind", "displacement_px")
BEFORE_EXPOSURE = frozenset(("beam", "arrivals", "object_blur", "quanta", "optics"))

Acting = Sequence[tuple[AppliedEffect, Effect, dict[str, float]]]


@dataclass(frozen=True, slots=True)
class Charge:
    """What one exposure brings to the pixels, before lag; maps (row, column), or (1, 1) where all pixels are alike.

    Fields: mean, DN; correlated, white: variance of quanta after the spread, and of secondary quanta, DN^2; shape: of the light, with
    what effects change in it; relative: gain of the pixels; pattern: correlation of the noise.
    """

    mean: FloatArray
    correlated: FloatArray
    white: FloatArray
    shape: FloatArray
    relative: FloatArray
    pattern: NoisePattern

    def times(self, factor: float) -> "Charge":
        """That of a larger tube load."""
        return replace(self, mean=factor * self.mean, correlated=factor * self.correlated, white=factor * self.white)

    @property
    def nbytes(self) -> int:
        """Of the maps that belong to it alone."""
        return self.mean.nbytes + self.correlated.nbytes + self.white.nbytes


def of_quanta(state: LineState, left: float = 1.0) -> LineState:
    """The state with the variance of quanta alone; secondary quanta follow the signal, whatever the spectrum.

    left: factor on that variance.
    """
    white = np.minimum(state.secondary_DN * np.maximum(state.signal_DN, 0.0), 0.9 * state.variance_DN2)
    return replace(state, variance_DN2=left * (state.variance_DN2 - white))


def charge_of(
    quanta: LineState,
    *,
    shape: FloatArray,
    relative: FloatArray,
    pattern: NoisePattern,
    spread: Spread,
    draft: bool = False,
    kept: Kept | None = None,
) -> Charge:
    """Light spread over the pixels.

    Args:
        quanta: the state after the optics, see `of_quanta`.
        shape: of the flat (row, column).
        relative: gain of the pixels (row, column).
        pattern: correlation of the noise with the state's spread.
        spread: the calibrated one.
        draft, kept: as in `spread_maps`.
    """
    picture, power = spread_maps(
        quanta.signal_DN,
        quanta.variance_DN2,
        state=quanta,
        pattern=pattern,
        spread=spread,
        draft=draft,
        kept=kept,
    )
    lit = shape * quanta.flat_factor
    scale = lit * relative
    return Charge(
        mean=lit * picture,
        correlated=scale * power,
        white=scale * quanta.secondary_DN * np.maximum(picture, 0.0),
        shape=lit,
        relative=relative,
        pattern=pattern,
    )


@dataclass(frozen=True, slots=True)
class Light:
    """A series up to the spread of light.

    Fields: state and projection; charge of a load `load` times as large as the one that these were drawn for.
    """

    state: LineState
    projection: BeamProjection | None
    charge: Charge
    load: float = 1.0

    @property
    def nbytes(self) -> int:
        """Of the charge."""
        return self.charge.nbytes

    def times(self, factor: float) -> "Light":
        """The same light, more of it."""
        return replace(self, charge=self.charge.times(factor), load=factor * self.load)

    def at_load(self) -> "Light":
        """With state and projection of the charge's load."""
        factor, state, picture, light = self.load, self.state, self.state.picture, self.projection
        state = replace(
            state,
            signal_DN=factor * state.signal_DN,
            variance_DN2=factor * state.variance_DN2,
            picture=None
            if picture is None
            else replace(picture, scale=factor * picture.scale, signal_DN=factor * picture.signal_DN),
        )
        return replace(
            self,
            state=state,
            projection=None
            if light is None
            else replace(
                light,
                open_signal_DN=factor * light.open_signal_DN,
                signal_DN=factor * light.signal_DN,
                variance_DN2=factor * light.variance_DN2,
                picture=state.picture,
            ),
            load=1.0,
        )


def light_of(
    twin: Twin,
    request: SeriesRequest,
    acting: Acting,
    *,
    parameters: FloatArray | None,
    use_measured_level: bool,
    cache: ModelCache,
) -> Light:
    """The light of a series, from the cache where the same was asked before.

    Light goes as the tube load: of series that differ in nothing else one is drawn.

    Args:
        twin, request: the line and the series.
        acting: effects, in order of their stages, up to the optics.
        parameters: (parameter,) of the spectrum.
        use_measured_level, cache: as in `LineModel`.
    """

    timed = bool(request.belt_speed_mm_s) or any(effect.timed for _, effect, _ in acting)
    once, load_mAs = cache.made("once", (request,), timed, lambda: _at_unit_load(request, timed=timed))
    of_effects = tuple(
        (item.id, item.since, tuple(numbers.items()), tuple(item.options.items())) for item, _, numbers in acting
    )
    key = (
        once.setting,
        None if parameters is None else parameters.tobytes(),
        use_measured_level,
        tuple(getattr(once, name) for name in _OF_THE_LIGHT),
        of_effects,
    )

    def drawn() -> Light:
        return _drawn(twin, once, acting, parameters, use_measured_level=use_measured_level, cache=cache)

    owners = (twin, request.thickness_mm)
    light: Light = cache.made("light", owners, key, drawn)
    if load_mAs != 1.0:
        light = cache.made("light at a load", owners, (*key, load_mAs), lambda: light.times(load_mAs))
    return light


def _at_unit_load(request: SeriesRequest, *, timed: bool) -> tuple[SeriesRequest, float]:
    """The same series at a load of 1 mAs, and its own load, mAs; as it is where the load is not what says how much light.

    timed: the exposure's length matters besides.
    """
    load = None if request.setting is None else request.setting.tube_load_mAs
    if not request.beam_on or request.setting is None or not load or request.open_signal_DN is not None:
        return request, 1.0
    exposure_ms = request.setting.exposure_ms if timed else 1000.0
    setting = replace(request.setting, current_mA=1000.0 / exposure_ms, power_W=None, exposure_ms=exposure_ms)
    shown_ms = request.exposure_ms if timed else exposure_ms
    return replace(request, setting=setting, exposure_ms=shown_ms, previous=()), load


def _drawn(
    twin: Twin,
    request: SeriesRequest,
    acting: Acting,
    parameters: FloatArray | None,
    *,
    use_measured_level: bool,
    cache: ModelCache,
) -> Light:
    """The line up to the spread of light."""
    one = np.ones((1, 1))
    state = LineState(
        parameters=parameters,
        signal_DN=0.0 * one,
        variance_DN2=0.0 * one,
        flat_factor=one,
        step_DN=1.0 if twin.noise.quantised else 0.0,
    )
    projection: BeamProjection | None = None
    if request.beam_on:
        model = model_of(twin, request)
        for applied, effect, numbers in acting:
            if effect.stage == "beam":
                context = replace(context_of(twin, request, applied, None, cache), model=model)
                state = effect.change(state, numbers, context)
        projection = project_beam(
            twin,
            request,
            state.parameters,
            state.attenuation_scale,
            use_measured_level=use_measured_level,
            cache=cache,
        )
        state = replace(
            state,
            signal_DN=projection.signal_DN,
            variance_DN2=projection.variance_DN2,
            secondary_DN=projection.secondary_DN,
            picture=projection.picture,
            shift_px=request.displacement_px if request.thickness_mm else (0.0, 0.0),
            object_transfers=(*blur_by_declared_spot(twin, request), *blur_by_belt(twin, request)),
        )
        for applied, effect, numbers in acting:
            if effect.stage != "beam":
                state = effect.change(state, numbers, context_of(twin, request, applied, projection, cache))
        if twin.noise.spread.value.model != "aperture" and state.shift_px != (0.0, 0.0):
            # points, not means over pixels: a step between two of them has no place that a transform could move
            state = replace(
                state,
                signal_DN=_interpolated(state.signal_DN, state.shift_px),
                variance_DN2=_interpolated(state.variance_DN2, state.shift_px),
                shift_px=(0.0, 0.0),
            )
    return Light(state, projection, _charge(twin, request, state, _kept(twin, request, state, acting, cache), cache))


def _kept(twin: Twin, request: SeriesRequest, state: LineState, acting: Acting, cache: ModelCache) -> Kept:
    """Keeps what belongs to the spread of light, which is alike behind all scenes, whenever it began to be so."""
    if not (state.tails or state.optical_transfers or state.power_transfers or state.object_transfers):
        return lambda name, make: cache.made("spread", (twin,), name, make)
    key = (
        None if state.parameters is None else state.parameters.tobytes(),
        None if request.setting is None else (request.setting.kV, request.setting.filters),
        tuple((item.id, tuple(numbers.items()), tuple(item.options.items())) for item, _, numbers in acting),
        tuple(getattr(request, name) for name in _OF_THE_SPREAD),
        bool(request.thickness_mm),
    )
    return lambda name, make: cache.made("spread", (twin,), (*key, name), make)


def _charge(twin: Twin, request: SeriesRequest, state: LineState, kept: Kept, cache: ModelCache) -> Charge:
    """What one exposure brings."""
    shape, relative = _illumination(twin, request, cache)
    pattern: NoisePattern = kept("pattern", lambda: noise_pattern(twin.noise.spread.value, state))
    if not request.beam_on:
        nothing = np.zeros(shape.shape)
        return Charge(nothing, nothing, nothing, shape, relative, pattern)
    return charge_of(
        of_quanta(state),
        shape=shape,
        relative=relative,
        pattern=pattern,
        spread=twin.noise.spread.value,
        draft=cache.draft,
        kept=kept,
    )


def _illumination(twin: Twin, request: SeriesRequest, cache: ModelCache) -> tuple[FloatArray, FloatArray]:
    """Shape of the flat nearest in kV and filters, and relative gain (row, column)."""
    gain = twin.maps.gain_relative
    relative = cache.pixels(twin.maps, "relative gain", lambda: np.where(gain > 1e-6, gain, 1.0))
    level = twin.level_nearest(request.setting)
    if level is None:
        return relative, relative
    seen = level.flat_shape
    return cache.pixels(level, "shape of the flat", lambda: np.maximum(seen, 0.0)), relative


def context_of(
    twin: Twin,
    request: SeriesRequest,
    applied: AppliedEffect,
    projection: BeamProjection | None,
    cache: ModelCache,
) -> LineContext:
    """What an effect may know of a series besides the state."""
    return LineContext(
        twin=twin,
        request=request,
        model=None if projection is None else projection.model,
        since=applied.since,
        weights=None if projection is None else projection.weights,
        energies_keV=None if projection is None else projection.energies_keV,
        project=None if projection is None else projection.moments,
        open_signal_DN=0.0 if projection is None else projection.open_signal_DN,
        options=applied.options,
        made_of=lambda thing, name, make: cache.made("effects", (thing,), name, make),
    )


def _interpolated(picture: FloatArray, shift_px: tuple[float, float]) -> FloatArray:
    """A picture (row, column) moved on by a displacement, by cubic interpolation between its four nearest points a side.

    No value lies beyond those of the two points on either side of it: beside a step nothing is brighter than the open beam, nor
    darker than the shadow.

    Source: Keys (1981), cubic convolution, doi:10.1109/TASSP.1981.1163711.
    """
    for axis, along in enumerate(shift_px):
        if along == 0.0 or picture.shape == (1, 1):
            continue
        whole = math.floor(along)
        length = picture.shape[axis]
        near = [
            np.take(picture, np.clip(np.arange(length) - whole - step, 0, length - 1), axis=axis)
            for step in (-1, 0, 1, 2)
        ]
        moved = sum(
            _cubic(abs(step - (along - whole))) * points for step, points in zip((-1, 0, 1, 2), near, strict=True)
        )
        picture = np.clip(moved, np.minimum(near[1], near[2]), np.maximum(near[1], near[2]))
    return picture


def _cubic(distance_px: float) -> float:
    """Weight of a point at a distance below 2 px."""
    if distance_px <= 1.0:
        return (1.5 * distance_px - 2.5) * distance_px**2 + 1.0
    return ((-0.5 * distance_px + 2.5) * distance_px - 4.0) * distance_px + 2.0

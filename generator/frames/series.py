"""The forward model of a series of frames: what they are expected to hold, and samples of them.

One chain of stages in the order of the real line (`line_state`): beam, projection, arrivals, blur of the object, quanta,
optical spread, exposure, lag, response, electronics, readout. `expected_series` and `sample_series` read the same final
state of that chain, so that they cannot disagree. An effect changes the state at its stage (`effects`).

Under even illumination, before the spread, one exposure has signal P = sum_E w1 exp(-mu t) and quantum variance
V = sum_E w2 exp(-mu t); the flat's shape s and the relative gain g of the pixels act at readout: mean s P, variance
s g V. Light that leaves the field is replaced by as much that enters: borders mirror.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..effects import AppliedEffect, Effect, effect_of, in_order
from ..line.line_state import (
    FixedPattern,
    FloatArray,
    GainMemory,
    LagLaw,
    LineContext,
    LineFlicker,
    LineState,
    TelegraphPixels,
    TilePattern,
)
from ..line.rounding import rounded_variance
from ..line.series_request import SeriesRequest
from ..line.spectral_signal import mean_signal_energy_keV
from ..line.twin import Twin
from ._scene import BeamProjection, ModelCache
from ._spread import NoisePattern, blurred_object, noise_pattern, spread_maps
from .defects import Jumping, gain_pattern, new_bad_pixels, sample_flicker, sample_offsets, tile_gain
from .response import counting_noise, responded, responds, slope

__all__ = [
    "ExpectedSeries",
    "LineMemory",
    "ModelCache",
    "SeriesRequest",
    "beam_conditions",
    "expected_series",
    "sample_series",
    "session_conditions",
    "with_conditions",
]

_LAGS = 3
_FOLLOWED = 2  # pictures exposed before a series' own, the last ones, whose fading is followed one by one
_BEFORE_EXPOSURE = frozenset(("beam", "arrivals", "object_blur", "quanta", "optics"))
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
_HARMONICS = 6  # of the ADC's staircase; needed only where the noise is below half a step
_ROUNDED_SD = 0.7  # of noise, in steps of the ADC: from there on the staircase's first harmonic is below 1e-4 of a step
_HOT_SIGMAS = 20.0  # of the read noise: offset of a new hot pixel in the samples


def session_conditions(requests: Sequence[SeriesRequest], *, readout_ms: float | None = None) -> dict[str, float]:
    """What a session states of the effects' parameters that are not fitted: name -> value, units in the names.

    session_s: from the first exposure to the last. longest_exposure_ms: of the darks, or of all series. calibrated_s: when
    the darks that calibrate were taken, on average. after_s: length of the exposure before the first `afterglow` series;
    left out where there is none.

    Args:
        requests: the series of the session in order of time.
        readout_ms: of the detector, for series that do not state their frame interval.
    """
    if not requests:
        return {}
    ends = [item.start_s + _length_s(item, readout_ms) for item in requests]
    darks = [item for item in requests if item.kind == "dark"]
    longest = max(item.exposure_ms for item in darks or requests)
    found = {"session_s": max(1.0, *ends), "longest_exposure_ms": max(longest, 0.01)}
    calibrating = [
        0.5 * (item.start_s + end)
        for item, end in zip(requests, ends, strict=True)
        if item.kind == "dark" and not item.after_calibration
    ]
    if calibrating:
        found["calibrated_s"] = max(sum(calibrating) / len(calibrating), 0.0)
    for number, item in enumerate(requests):
        before = (*requests[:number], *item.previous)[-1:]
        if item.kind == "afterglow" and before and before[0].beam_on:
            found["after_s"] = max(_length_s(before[0], readout_ms), 1e-3)
            break
    return found


def beam_conditions(
    twin: Twin, requests: Sequence[SeriesRequest], *, cache: "ModelCache | None" = None
) -> dict[str, float]:
    """What a session's beams say of the effects' parameters that are not fitted.

    reference_keV: geometric mean, over the beams that objects were measured with, of the mean energy of the open beam's signal;
    left out where no such beam is known.

    Args:
        twin: with a spectral part, or nothing is known.
        requests: the series of the session.
        cache: as in `expected_series`.
    """
    cache = ModelCache() if cache is None else cache
    found: dict[tuple[object, ...], float] = {}
    for item in requests:
        if item.kind != "object" or item.setting is None or (item.setting.kV, item.setting.filters) in found:
            continue
        beam = replace(item, kind="flat", thickness_mm=None, displacement_px=(0.0, 0.0), previous=())
        try:
            light = _lit(twin, beam, _Choice((), None, False), cache)[0].projection
        except InputError:
            continue
        if light is not None and light.weights is not None and light.energies_keV is not None:
            found[item.setting.kV, item.setting.filters] = mean_signal_energy_keV(light.weights[0], light.energies_keV)
    if not found:
        return {}
    return {"reference_keV": math.exp(sum(map(math.log, found.values())) / len(found))}


def _length_s(request: SeriesRequest, readout_ms: float | None) -> float:
    """Of a series, from its first exposure's begin to its last one's end."""
    return request.frames * request.exposures_per_frame * request.interval_s(readout_ms)


def with_conditions(effect: AppliedEffect, conditions: Mapping[str, float]) -> AppliedEffect:
    """The effect with those of `conditions` that are parameters of it, where it does not state them itself."""
    names = {item.name for item in effect_of(effect).parameters}
    known = {name: value for name, value in conditions.items() if name in names}
    return replace(effect, parameters={**known, **effect.parameters})


@dataclass(slots=True, kw_only=True)
class ExpectedSeries:
    """What the stored frames of a series are expected to hold; variances of one stored frame.

    Maps are (row, column); with a draft's cache (1, 1) where all pixels are alike.

    Fields:
        mean_DN: raw, dark included, mean over the frames.
        dark_DN: of it, what is there without beam (drift included).
        signal_DN: of it, what the beam brings (released charge included).
        trend_DN: change over the frames that is no noise: (map, (frames,) profile of mean 0) each; None: none.
        quantum_variance_DN2: from frame to frame, of quanta, after the spread, lag and response.
        white_variance_DN2: of electronics, secondary quanta and the ADC; without row and column noise.
        noise_autocovariance: (4, 4) of the quantum part over lags of 0-3 rows and columns, 1 at lag 0.
        row_variance_DN2, column_variance_DN2: of what a row or a column of one frame has in common; offsets_together_lines: over so
            many lines its correlation falls to 1/e.
        flicker: factors of the lines of a frame; None: there are none.
        frame_factor_rms: of the common factor of a frame.
        frame_factor_correlation: (frames,) its correlation over 0, 1, 2... frames.
        temporal_correlation: (3,) correlation of the quantum part over 1, 2, 3 frames.
        quantisation_step_DN: of the stored numbers, before averaging; 0: none.
        bad_pixel_share, hot_pixel_share: pixels beyond the known bad ones, and those of them that show without beam.
        telegraph: pixels that jump, whose mean and variance are not in the maps; None: none.
        gain_pattern: of the pixels' gains, that no map knows; None: none.
        tile_pattern: the same of tiles; None: there is none.
        repeated_share: chance of a frame to be a copy of the one before; its mean and noise are those of any other.
        saturated_share: share of pixels whose mean lies at the end of the ADC's range.
        frames: in the series.
    """

    mean_DN: FloatArray
    dark_DN: FloatArray
    signal_DN: FloatArray
    trend_DN: list[tuple[FloatArray, FloatArray]] | None
    quantum_variance_DN2: FloatArray
    white_variance_DN2: FloatArray
    noise_autocovariance: FloatArray
    row_variance_DN2: float
    column_variance_DN2: float
    offsets_together_lines: float
    flicker: LineFlicker | None
    frame_factor_rms: float
    frame_factor_correlation: FloatArray
    temporal_correlation: FloatArray
    quantisation_step_DN: float
    bad_pixel_share: float
    hot_pixel_share: float
    telegraph: TelegraphPixels | None
    gain_pattern: FixedPattern | None
    tile_pattern: TilePattern | None
    repeated_share: float
    saturated_share: float
    frames: int


_Active = list[tuple[AppliedEffect, Effect, dict[str, float]]]


@dataclass(slots=True, kw_only=True)
class LineMemory:
    """What the line remembers from one series to the next when frames are sampled: trapped charge and output error.

    Fields: trapped_DN (trap, row, column) or None, at time_s; output_error of the exposure that began at output_time_s.
    """

    trapped_DN: FloatArray | None = None
    time_s: float = 0.0
    output_error: float | None = None
    output_time_s: float = 0.0


@dataclass(frozen=True, slots=True)
class _Choice:
    """What a caller asks the model with besides twin and request."""

    effects: Sequence[AppliedEffect] | None
    parameters: NDArray[np.float64] | None
    use_measured_level: bool

    def line(self, twin: Twin, request: SeriesRequest, cache: ModelCache) -> tuple[LineState, "_Charge"]:
        """The final state of the line for a request, but for its light, and what one exposure brings."""
        lit, late = _lit(twin, request, self, cache)
        return _read_out(twin, request, lit, late, cache), lit.charge


@dataclass(frozen=True, slots=True)
class _Charge:
    """What one exposure of a series brings to the pixels, before lag: mean and variances in DN, gain and shape applied."""

    mean: FloatArray
    correlated: FloatArray
    white: FloatArray
    shape: FloatArray
    relative: FloatArray
    pattern: NoisePattern


def _illumination(twin: Twin, request: SeriesRequest, cache: ModelCache) -> tuple[FloatArray, FloatArray]:
    """Shape of the flat nearest in kV and filters, and relative gain (row, column)."""
    gain = twin.maps.gain_relative
    relative = cache.pixels(twin.maps, "relative gain", lambda: np.where(gain > 1e-6, gain, 1.0))
    level = twin.level_nearest(request.setting)
    if level is None:
        return relative, relative
    seen = level.flat_shape
    return cache.pixels(level, "shape of the flat", lambda: np.maximum(seen, 0.0)), relative


def _context(
    twin: Twin,
    request: SeriesRequest,
    applied: AppliedEffect | None,
    projection: BeamProjection | None,
    cache: ModelCache,
) -> LineContext:
    return LineContext(
        twin=twin,
        request=request,
        model=None if projection is None else projection.model,
        since="always" if applied is None else applied.since,
        weights=None if projection is None else projection.weights,
        energies_keV=None if projection is None else projection.energies_keV,
        project=None if projection is None else projection.moments,
        open_signal_DN=0.0 if projection is None else projection.open_signal_DN,
        options={} if applied is None else applied.options,
        made_of=cache.made_of,
    )


@dataclass(frozen=True, slots=True)
class _Lit:
    """A series up to the spread of light: state, projection and the charge that one exposure brings; effects still to act.

    `twin` and `thickness_mm` are held so that their identity stands for them in the cache's keys. `charge` is that of a load
    `load` times as large as the one that state and projection were drawn for.
    """

    twin: Twin
    thickness_mm: Mapping[str, NDArray[np.floating]] | None
    state: LineState
    projection: BeamProjection | None
    charge: "_Charge"
    load: float = 1.0

    def times(self, factor: float) -> "_Lit":
        """The same light, more of it."""
        charge = replace(
            self.charge,
            mean=factor * self.charge.mean,
            correlated=factor * self.charge.correlated,
            white=factor * self.charge.white,
        )
        return replace(self, charge=charge, load=factor * self.load)

    def at_load(self) -> "_Lit":
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


def _lit(twin: Twin, request: SeriesRequest, choice: "_Choice", cache: ModelCache) -> tuple["_Lit", "_Active"]:
    """The line up to the spread of light, from the cache where the same was asked before, and the effects that act later.

    Light goes as the tube load: of series that differ in nothing else one is drawn.
    """
    effects = twin.effects if choice.effects is None else choice.effects
    active = [item for item in in_order(effects) if item[0].since == "always" or request.after_calibration]
    early = [item for item in active if item[1].stage in _BEFORE_EXPOSURE]
    late = [item for item in active if item[1].stage not in _BEFORE_EXPOSURE]
    values: NDArray[np.float64] | None = None
    if twin.spectral is not None:
        given = twin.spectral.best if choice.parameters is None else choice.parameters
        values = np.asarray(given, dtype=np.float64)
        if values.shape != twin.spectral.best.shape:
            raise InputError(
                "spectral parameters",
                received=f"shape {values.shape}",
                expected=f"{twin.spectral.best.shape}: one value for each of {', '.join(twin.spectral.names)}",
            )

    def key(asked: SeriesRequest) -> tuple[object, ...]:
        return (
            id(twin),
            id(asked.thickness_mm),
            asked.setting,
            None if values is None else values.tobytes(),
            choice.use_measured_level,
            tuple(getattr(asked, name) for name in _OF_THE_LIGHT),
            tuple(
                (item.id, item.since, tuple(numbers.items()), tuple(item.options.items())) for item, _, numbers in early
            ),
        )

    def known(asked: SeriesRequest) -> _Lit | None:
        kept = cache.lit(key(asked))
        if isinstance(kept, _Lit) and kept.twin is twin and kept.thickness_mm is request.thickness_mm:
            return kept
        return None

    def keep(asked: SeriesRequest, lit: _Lit) -> _Lit:
        cache.keep_lit(
            key(asked), lit, sum(item.nbytes for item in (lit.charge.mean, lit.charge.correlated, lit.charge.white))
        )
        return lit

    found = known(request)
    if found is None:
        timed = any(effect.timed for _, effect, _ in early)
        once, load_mAs = cache.made_of(request, ("once", timed), lambda: _at_unit_load(request, timed=timed))
        found = known(once) or keep(once, _drawn(twin, once, choice, cache, values, early))
        if load_mAs != 1.0:
            found = keep(request, found.times(load_mAs))
    return found, late


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
    choice: "_Choice",
    cache: ModelCache,
    values: NDArray[np.float64] | None,
    early: "_Active",
) -> "_Lit":
    """The line up to the spread of light."""
    one = np.ones((1, 1))
    state = LineState(
        parameters=values,
        signal_DN=0.0 * one,
        variance_DN2=0.0 * one,
        flat_factor=one,
        step_DN=1.0 if twin.noise.quantised else 0.0,
    )
    projection: BeamProjection | None = None
    if request.beam_on:
        model = cache.model(twin, request)
        for applied, effect, numbers in early:
            if effect.stage == "beam":
                context = replace(_context(twin, request, applied, None, cache), model=model)
                state = effect.change(state, numbers, context)
        projection = cache.projection(
            twin,
            request,
            model,
            state.parameters,
            state.attenuation_scale,
            use_measured_level=choice.use_measured_level,
        )
        state = replace(
            state,
            signal_DN=projection.signal_DN,
            variance_DN2=projection.variance_DN2,
            secondary_DN=projection.secondary_DN,
            picture=projection.picture,
            shift_px=request.displacement_px if request.thickness_mm else (0.0, 0.0),
        )
        for applied, effect, numbers in early:
            if effect.stage != "beam":
                state = effect.change(state, numbers, _context(twin, request, applied, projection, cache))
        if twin.noise.spread.value.model != "aperture" and state.shift_px != (0.0, 0.0):
            # points, not means over pixels: a step between two of them has no place that a transform could move
            state = replace(
                state,
                signal_DN=_interpolated(state.signal_DN, state.shift_px),
                variance_DN2=_interpolated(state.variance_DN2, state.shift_px),
                shift_px=(0.0, 0.0),
            )
    spread: dict[object, Any] = {}
    if state.tails or state.optical_transfers or state.power_transfers:
        # such light spreads alike behind all scenes, whenever it began to
        spread = cache.spread(
            (
                id(twin),
                None if values is None else values.tobytes(),
                None if request.setting is None else (request.setting.kV, request.setting.filters),
                tuple((item.id, tuple(numbers.items()), tuple(item.options.items())) for item, _, numbers in early),
                tuple(getattr(request, name) for name in _OF_THE_SPREAD),
                bool(request.thickness_mm),
            ),
            twin,
        )
    charge = _charge(twin, request, state, spread, cache)
    return _Lit(twin, request.thickness_mm, state, projection, charge)


def _interpolated(picture: FloatArray, shift_px: tuple[float, float]) -> FloatArray:
    """A picture (row, column) moved on by a displacement, by cubic interpolation between its four nearest points a side.

    Source: Keys (1981), cubic convolution, doi:10.1109/TASSP.1981.1163711.
    """
    for axis, along in enumerate(shift_px):
        if along == 0.0 or picture.shape == (1, 1):
            continue
        whole = math.floor(along)
        length = picture.shape[axis]
        moved = np.zeros(picture.shape)
        for step in (-1, 0, 1, 2):
            places = np.clip(np.arange(length) - whole - step, 0, length - 1)
            moved += _cubic(abs(step - (along - whole))) * np.take(picture, places, axis=axis)
        picture = moved
    return picture


def _cubic(distance_px: float) -> float:
    """Weight of a point at a distance below 2 px."""
    if distance_px <= 1.0:
        return (1.5 * distance_px - 2.5) * distance_px**2 + 1.0
    return ((-0.5 * distance_px + 2.5) * distance_px - 4.0) * distance_px + 2.0


def _read_out(twin: Twin, request: SeriesRequest, lit: "_Lit", late: "_Active", cache: ModelCache) -> LineState:
    """All stages from the exposure on."""
    state = lit.state
    for applied, effect, numbers in late:
        state = effect.change(state, numbers, _context(twin, request, applied, lit.projection, cache))
    return state


def _quanta(state: LineState) -> LineState:
    """The state with the variance of quanta alone; secondary quanta follow the signal, whatever the spectrum."""
    white = np.minimum(state.secondary_DN * np.maximum(state.signal_DN, 0.0), 0.9 * state.variance_DN2)
    return replace(state, variance_DN2=state.variance_DN2 - white)


def _charge(
    twin: Twin, request: SeriesRequest, state: LineState, spread: dict[object, Any], cache: ModelCache
) -> _Charge:
    """Light spread over the pixels; `spread` holds what earlier series of the same beam and spread have left."""
    shape, relative = _illumination(twin, request, cache)
    if "pattern" not in spread:
        spread["pattern"] = noise_pattern(twin.noise.spread.value, state)
    pattern: NoisePattern = spread["pattern"]
    if not request.beam_on:
        nothing = np.zeros(shape.shape)
        return _Charge(nothing, nothing, nothing, shape, relative, pattern)
    quanta = _quanta(state)
    picture, power = spread_maps(
        quanta.signal_DN,
        quanta.variance_DN2,
        state=quanta,
        pattern=pattern,
        spread=twin.noise.spread.value,
        draft=cache.draft,
        known=spread,
    )
    lit = shape * state.flat_factor
    scale = lit * relative
    return _Charge(
        mean=lit * picture,
        correlated=scale * power,
        white=scale * state.secondary_DN * np.maximum(picture, 0.0),
        shape=lit,
        relative=relative,
        pattern=pattern,
    )


def _decays(law: LagLaw, interval_s: float) -> FloatArray:
    return np.exp(-interval_s / np.asarray(law.time_s, dtype=np.float64))


def _pause_s(law: LagLaw, request: SeriesRequest, clock_s: float) -> float:
    """From clock_s, when the exposures before ended, to the begin of the series."""
    return request.start_s - clock_s if request.pause_stated else law.idle_s


def _paused(law: LagLaw, trapped: FloatArray, pause_s: float) -> tuple[FloatArray, FloatArray]:
    """Charge in the traps (trap, ...) after a pause, and what the next exposure reads of that released in it."""
    left = (trapped.T * _decays(law, max(pause_s, 0.0))).T
    return left, law.pause_share * np.sum(trapped - left, axis=0)


@dataclass(frozen=True, slots=True)
class _Trapped:
    """What earlier exposures have left behind, as sums of what each of them brought.

    Fields: pictures, each (row, column) or (1, 1), DN; held (trap, picture): shares of them in the traps; found (picture,): shares
    that the first exposure finds.
    """

    pictures: tuple[FloatArray, ...]
    held: FloatArray
    found: FloatArray

    def images(self) -> tuple[FloatArray, FloatArray]:
        """Charge in the traps (trap, row, column) and what the first exposure finds (row, column), DN."""
        none = np.zeros((1, 1))
        held = [
            sum((share * one for share, one in zip(shares, self.pictures, strict=True)), none) for shares in self.held
        ]
        found = sum((share * one for share, one in zip(self.found, self.pictures, strict=True)), none)
        return np.stack(held), found


def _trapped_before(twin: Twin, request: SeriesRequest, law: LagLaw, choice: _Choice, cache: ModelCache) -> _Trapped:
    """Charge in the traps at the begin of the series, and what its first exposure finds."""
    share = np.asarray(law.trapped)
    pictures: list[FloatArray] = []
    trapped = np.zeros((len(law.trapped), len(request.previous)))
    clock: float | None = None
    for earlier in request.previous:
        interval = earlier.interval_s(twin.instrument.readout_ms)
        exposures = earlier.frames * earlier.exposures_per_frame
        if clock is not None:
            trapped, _ = _paused(law, trapped, _pause_s(law, earlier, clock))
        decay = _decays(law, interval)
        left = decay**exposures
        trapped = trapped * left[:, None]
        if earlier.beam_on:
            state, charge = choice.line(twin, earlier, cache)
            caught = 1.0 if state.lag is not None else law.before_share
            if caught > 0.0:
                trapped[:, len(pictures)] = caught * share * (1.0 - left) / np.maximum(1.0 - decay, 1e-12)
                pictures.append(charge.mean)
        clock = earlier.start_s + exposures * interval
    found = np.zeros(trapped.shape[1])
    if clock is not None:
        trapped, found = _paused(law, trapped, _pause_s(law, request, clock))
    return _Trapped(tuple(pictures), trapped[:, : len(pictures)], found[: len(pictures)])


def _with_trapped(
    law: LagLaw, decay: FloatArray, before: _Trapped, own: FloatArray, exposures: int, averaged: int
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Mean signal of a series whose exposures bring `own` (row, column), DN, with lag, and how it changes over the frames.

    y_n = x - sum_i a_i^n [phi_i x - (1 - a_i) R_i], R_i a sum of the pictures of earlier exposures: each picture has one course.
    Those of long ago, of which only slow traps hold some still, fade together.
    """
    number = np.arange(exposures)
    fades = np.array([_frame_means(left**number, averaged) for left in decay])
    courses = ((1.0 - decay)[:, None] * before.held).T @ fades
    if law.pause_share > 0:
        courses = courses + before.found[:, None] * _frame_means((number == 0).astype(np.float64), averaged)
    long_ago = max(len(before.pictures) - _FOLLOWED, 0)
    moving = [
        (own, -np.asarray(law.trapped) @ fades),
        *zip(before.pictures[long_ago:], courses[long_ago:], strict=True),
    ]
    shares = courses[:long_ago].mean(axis=1)
    if shares.any():
        faint = sum(share * one for share, one in zip(shares, before.pictures[:long_ago], strict=True))
        moving.append((np.asarray(faint), courses[:long_ago].sum(axis=0) / shares.sum()))
    signal = own
    trend = []
    for picture, course in moving:
        signal = signal + course.mean() * picture
        trend.append((picture, course - course.mean()))
    return signal, trend


def _filled_before(
    twin: Twin, request: SeriesRequest, law: GainMemory, choice: _Choice, cache: ModelCache
) -> FloatArray:
    """Share of the traps (row, column) or (1, 1) that earlier exposures have left full at the begin of the series."""
    filled: FloatArray = np.zeros((1, 1))
    clock_s = 0.0
    for earlier in request.previous:
        if earlier.beam_on:
            state, charge = choice.line(twin, earlier, cache)
            if state.gain_memory is not None:  # else it had not set in
                interval = earlier.interval_s(twin.instrument.readout_ms)
                exposures = earlier.frames * earlier.exposures_per_frame
                filled = filled * math.exp(-max(earlier.start_s - clock_s, 0.0) / law.fade_s)
                steady, pace = _filling(law, charge.mean, interval)
                filled = steady + (filled - steady) * np.exp(-exposures * pace)
                clock_s = earlier.start_s + exposures * interval
    return filled * math.exp(-max(request.start_s - clock_s, 0.0) / law.fade_s)


def _filling(law: GainMemory, light_DN: FloatArray, interval_s: float) -> tuple[FloatArray, FloatArray]:
    """Share of the traps that are full in the end under exposures of this light, and 1 over the exposures that it takes."""
    filling = law.filled_per_DN * np.maximum(light_DN, 0.0)
    pace = filling + interval_s / law.fade_s
    return filling / pace, pace


def _gain_course(
    law: GainMemory, before: FloatArray, light_DN: FloatArray, interval_s: float, exposures: int, averaged: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean factor on the signal over a series, and its change: (map, profile over the stored frames of mean 0).

    The mean is exact; all pixels change in the course of the one in the middle, as far as each does.
    """
    steady, pace = _filling(law, light_DN, interval_s)
    away = before - steady
    left = -np.expm1(-exposures * pace)
    mean = steady + away * left / (exposures * -np.expm1(-pace))
    course = np.exp(-float(np.median(pace)) * np.arange(exposures))
    course = _frame_means(
        (course - course.mean()) / max(1.0 - math.exp(-float(np.median(pace)) * exposures), 1e-300), averaged
    )
    return 1.0 + law.most * mean, law.most * away * left, course


def _temporal_covariance(law: LagLaw | None, decay: FloatArray | None, averaged: int) -> FloatArray:
    """Covariance of stored frames (1 + lags,) over the variance of one exposure without lag."""
    if law is None or decay is None:
        return np.concatenate([[1.0 / averaged], np.zeros(_LAGS)])
    trapped = np.asarray(law.trapped)
    # covariance of single exposures over `lag`, sums of geometric series in closed form
    first = 1.0 - float(trapped.sum())
    amount = trapped * (1.0 - decay)
    mixed = np.outer(amount, amount) / (1.0 - np.outer(decay, decay))

    def single(lag: int) -> float:
        if lag == 0:
            return first**2 + float(mixed.sum())
        return first * float(np.sum(amount * decay ** (lag - 1))) + float(np.sum(mixed * decay[:, None] ** lag))

    if averaged == 1:
        return np.array([single(lag) for lag in range(_LAGS + 1)])
    reach = averaged * (_LAGS + 1)
    singles = np.array([single(lag) for lag in range(reach)])
    inside = averaged - np.abs(np.arange(-averaged + 1, averaged))
    return np.array(
        [
            float(np.sum(inside * singles[np.abs(lag * averaged + np.arange(-averaged + 1, averaged))])) / averaged**2
            for lag in range(_LAGS + 1)
        ]
    )


def _frame_means(profile: FloatArray, averaged: int) -> FloatArray:
    """Profile over exposures -> profile over stored frames."""
    return np.asarray(profile.reshape(-1, averaged).mean(axis=1))


def _staircase(
    mean_DN: FloatArray, variance_DN2: FloatArray, step_DN: float
) -> tuple[FloatArray | float, FloatArray | float]:
    """What rounding to multiples of `step_DN` adds to the mean and the variance of a Gaussian value.

    Source: characteristic functions of a quantised Gaussian, Widrow and Kollar (2008), chapter 4.
    """
    if step_DN <= 0:
        return 0.0, 0.0
    if float(np.min(variance_DN2)) > _ROUNDED_SD**2 * step_DN**2:
        return 0.0, step_DN**2 / 12.0
    mean_DN, variance_DN2 = np.broadcast_arrays(mean_DN, variance_DN2)
    shift = np.zeros_like(mean_DN)
    square = np.full_like(mean_DN, step_DN**2 / 12.0)
    cross = np.zeros_like(mean_DN)
    for k in range(1, _HARMONICS + 1):
        sign = -1.0 if k % 2 else 1.0
        seen = sign * np.exp(-2.0 * (np.pi * k / step_DN) ** 2 * variance_DN2)
        angle = 2.0 * np.pi * k / step_DN * mean_DN
        wave = seen * np.cos(angle)
        shift += seen * np.sin(angle) * (step_DN / (np.pi * k))
        square += wave * (step_DN / (np.pi * k)) ** 2
        cross += 2.0 * variance_DN2 * wave
    return shift, np.maximum(square + 2.0 * cross - shift**2, -variance_DN2)


def _read_variance(twin: Twin, state: LineState, cache: ModelCache) -> FloatArray:
    """White electronic variance (row, column) of one exposure without the ADC's rounding, DN^2."""
    rounding = 1.0 / 12.0 if twin.noise.quantised else 0.0
    calibrated = cache.pixels(twin.maps, "read variance", lambda: twin.maps.read_variance_DN2)
    return np.maximum(calibrated - (rounding + state.read_variance_taken_DN2), 0.0)


def expected_series(
    twin: Twin,
    request: SeriesRequest,
    *,
    effects: Sequence[AppliedEffect] | None = None,
    parameters: NDArray[np.float64] | None = None,
    cache: ModelCache | None = None,
    use_measured_level: bool = True,
) -> ExpectedSeries:
    """What the frames of a series are expected to hold, DN.

    Args:
        twin: the calibrated line.
        request: the series.
        effects: in place of the twin's own; None: the twin's.
        parameters: (parameter,) of the spectrum in place of the posterior's best.
        cache: kept by the caller between calls, so that scenes and beams are projected once.
        use_measured_level: where the twin measured this kV and filters, take level and noise from there and only their
            change with the parameters from the spectral model.

    Raises:
        InputError: a beam without known level, a scene for a twin without spectral part, an unknown effect or parameter.
    """
    cache = ModelCache() if cache is None else cache
    choice = _Choice(effects, parameters, use_measured_level)
    state, charge = choice.line(twin, request, cache)
    averaged = request.exposures_per_frame
    exposures = request.frames * averaged
    interval = request.interval_s(twin.instrument.readout_ms)
    signal = charge.mean
    trend: list[tuple[FloatArray, FloatArray]] = []
    decay = None
    if state.lag is not None:
        law = state.lag
        decay = _decays(law, interval)
        before = _trapped_before(twin, request, law, choice, cache)
        signal, trend = _with_trapped(law, decay, before, charge.mean, exposures, averaged)
    covariance = _temporal_covariance(state.lag, decay, averaged)
    gained: FloatArray | float = 1.0
    if state.gain_memory is not None:
        before_it = _filled_before(twin, request, state.gain_memory, choice, cache)
        gained, gains, profile_of_gain = _gain_course(
            state.gain_memory, before_it, charge.mean, interval, exposures, averaged
        )
        trend = [*((gained * amount, course) for amount, course in trend), (gains * signal, profile_of_gain)]
        signal = gained * signal
    response: FloatArray | float = 1.0
    if responds(state):
        steepness = slope(state, signal)
        response = steepness**2 * counting_noise(state, signal)
        signal = responded(state, signal)
        trend = [(steepness * amount, course) for amount, course in trend]
    quantum, white = charge.correlated, charge.white
    if covariance[0] != 1.0 or responds(state) or state.gain_memory is not None:
        # secondary quanta are drawn before the traps as the others are
        quantum, white = (covariance[0] * gained**2 * response * variance for variance in (quantum, white))
    dark = cache.pixels(twin.maps, ("dark", request.exposure_ms), lambda: twin.maps.dark_at(request.exposure_ms))
    for height, profile in state.offsets:
        times = request.start_s + interval * np.arange(exposures, dtype=np.float64)
        course = _frame_means(profile(times), averaged)
        dark = dark + height * course.mean()
        if request.frames > 1:
            trend.append((np.full(dark.shape, height), course - course.mean()))
    electronic = _read_variance(twin, state, cache)
    mean = dark + signal
    least = electronic + state.row_variance_DN2 + state.column_variance_DN2
    rounding: FloatArray | float = state.step_DN**2 / 12.0
    if float(np.min(least)) < _ROUNDED_SD**2 * state.step_DN**2:
        noise = averaged * (quantum + white) + least
        if cache.draft:
            # pixels that stand for others with means of their own: what rounding does on average
            rounding = rounded_variance(noise, state.step_DN) - noise
        else:
            shift, rounding = _staircase(mean, noise, state.step_DN)
            mean = mean + shift
    white = white + (electronic + rounding) / averaged
    saturated = 0.0
    if twin.instrument.bits is not None:
        highest = 2.0**twin.instrument.bits - 1.0
        if float(mean.max()) >= highest:
            saturated = float(np.mean(mean >= highest))
            mean = np.minimum(mean, highest)
    lags = np.arange(request.frames) * interval * averaged
    correlation = np.exp(-lags / max(state.output_correlation_s, 1e-12))
    wandering = (1.0 - state.output_jitter_share) * _mean_of_correlated(interval, state.output_correlation_s, averaged)
    output = wandering + state.output_jitter_share / averaged
    correlation[1:] *= wandering / output
    return ExpectedSeries(
        mean_DN=mean,
        dark_DN=dark,
        signal_DN=signal,
        trend_DN=trend if trend and request.frames > 1 else None,
        quantum_variance_DN2=np.asarray(quantum),
        white_variance_DN2=np.asarray(white),
        noise_autocovariance=charge.pattern.autocovariance,
        row_variance_DN2=state.row_variance_DN2 / averaged,
        column_variance_DN2=state.column_variance_DN2 / averaged,
        offsets_together_lines=state.offsets_together_lines,
        flicker=None
        if state.flicker is None or not request.beam_on
        else replace(state.flicker, rms=state.flicker.rms / math.sqrt(averaged)),
        frame_factor_rms=state.output_rms * math.sqrt(output) if request.beam_on else 0.0,
        frame_factor_correlation=correlation,
        temporal_correlation=covariance[1:] / covariance[0],
        quantisation_step_DN=state.step_DN,
        bad_pixel_share=state.bad_share,
        hot_pixel_share=state.bad_share * state.bad_hot_share,
        telegraph=state.telegraph,
        gain_pattern=state.gain_pattern if request.beam_on else None,
        tile_pattern=state.tile_pattern if request.beam_on else None,
        repeated_share=state.repeated_share,
        saturated_share=saturated,
        frames=request.frames,
    )


def _mean_of_correlated(interval_s: float, correlation_s: float, count: int) -> float:
    """Variance of the mean of `count` values of an AR(1) process over its variance."""
    if count == 1:
        return 1.0
    lag = np.arange(1, count)
    rho = np.exp(-lag * interval_s / max(correlation_s, 1e-12))
    return float((1.0 + 2.0 * np.sum((1.0 - lag / count) * rho)) / count)


def sample_series(
    twin: Twin,
    request: SeriesRequest,
    *,
    rng: np.random.Generator,
    effects: Sequence[AppliedEffect] | None = None,
    parameters: NDArray[np.float64] | None = None,
    cache: ModelCache | None = None,
    use_measured_level: bool = True,
    memory: LineMemory | None = None,
) -> Iterator[NDArray[np.float32]]:
    """Yield the stored frames (row, column) of a series, DN, with noise and as the ADC gives them.

    Args:
        twin, request, effects, parameters, cache, use_measured_level: as in `expected_series`.
        rng: source of randomness.
        memory: what the line remembers; handed from series to series it carries the charge that was really trapped and
            the output error. None: as expected after `request.previous`, and nothing is handed on.

    Raises:
        InputError: as `expected_series`.
    """
    cache = ModelCache() if cache is None else cache
    choice = _Choice(effects, parameters, use_measured_level)
    lit, late = _lit(twin, request, choice, cache)
    state, charge = _read_out(twin, request, lit.at_load(), late, cache), lit.charge
    shape = twin.maps.shape
    interval = request.interval_s(twin.instrument.readout_ms)
    averaged = request.exposures_per_frame
    carried = LineMemory(time_s=request.start_s) if memory is None else memory
    trapped = None
    decay = np.zeros(0)
    found = np.zeros(shape)
    if state.lag is not None:
        decay = _decays(state.lag, interval)[:, None, None]
        if carried.trapped_DN is None:
            trapped, found = _trapped_before(twin, request, state.lag, choice, cache).images()
        else:
            trapped, found = _paused(state.lag, carried.trapped_DN, _pause_s(state.lag, request, carried.time_s))
        share = np.asarray(state.lag.trapped)[:, None, None]
    gain = None if state.gain_pattern is None or not request.beam_on else gain_pattern(state.gain_pattern, shape)
    if state.tile_pattern is not None and request.beam_on:
        gain = (1.0 if gain is None else gain) * tile_gain(state.tile_pattern, shape)
    filled = steady = pace = np.zeros((1, 1))
    if state.gain_memory is not None:
        filled = _filled_before(twin, request, state.gain_memory, choice, cache)
        steady, pace = _filling(state.gain_memory, charge.mean, interval)
    bad = new_bad_pixels(state, shape)
    jumping = None if state.telegraph is None else Jumping(state.telegraph, shape, rng)
    dark = np.asarray(twin.maps.dark_at(request.exposure_ms), dtype=np.float64)
    electronic = np.sqrt(_read_variance(twin, state, cache))
    highest = math.inf if twin.instrument.bits is None else 2.0**twin.instrument.bits - 1.0
    lowest = 0.0 if twin.noise.quantised else -math.inf
    by_chance = counting_noise(state, charge.mean)
    scale = np.sqrt(charge.shape * charge.relative * by_chance)
    white = np.sqrt(charge.white * by_chance)
    before, variance = blurred_object(_quanta(state))
    # a quantum's worth, so that their number is Poisson; floors where an opaque object lets nothing through
    quantum = variance / np.maximum(before, 1e-300)
    quantum = np.maximum(quantum, 1e-9 * float(np.max(quantum)) + 1e-300)
    number = 0
    stored: NDArray[np.float32] | None = None
    for _ in range(request.frames):
        total = np.zeros(shape)
        for _ in range(averaged):
            now = request.start_s + number * interval
            value = np.zeros(shape)
            if request.beam_on:
                noise = scale * charge.pattern.sample(before, quantum, shape, rng)
                noise += white * rng.standard_normal(shape)
                factor = 1.0
                if state.output_rms > 0:
                    carried.output_error = _next_error(carried, now, state, rng)
                    carried.output_time_s = now
                    error = carried.output_error
                    if state.output_jitter_share > 0:
                        error += math.sqrt(state.output_jitter_share) * state.output_rms * float(rng.standard_normal())
                    factor = max(1.0 + error, 0.0)
                value = factor * charge.mean + math.sqrt(factor) * noise
                if state.flicker is not None:
                    value = value * sample_flicker(state.flicker, shape, rng)
            if trapped is not None:
                released = (1.0 - decay) * trapped
                trapped = trapped - released + share * value
                value = value * (1.0 - share.sum()) + released.sum(axis=0)
                if number == 0:
                    value = value + found
            if gain is not None:
                value = value * gain
            if state.gain_memory is not None:
                value = value * (1.0 + state.gain_memory.most * filled)
                filled = steady + (filled - steady) * np.exp(-pace)
            value = responded(state, value)
            if bad is not None:
                value = np.where(bad.dead, 0.0, value)
            value = value + dark + electronic * rng.standard_normal(shape)
            for height, profile in state.offsets:
                value += height * float(profile(np.array(now)))
            value += sample_offsets(state, shape, rng)
            if jumping is not None:
                value = jumping.added_to(value, electronic, rng)
            if bad is not None:
                value = np.where(bad.hot, value + _HOT_SIGMAS * (electronic + 1.0), value)
            if state.step_DN > 0:
                value = np.rint(value / state.step_DN) * state.step_DN
            total += np.clip(value, lowest, highest)
            number += 1
        carried.trapped_DN = trapped
        if stored is None or state.repeated_share == 0.0 or rng.random() >= state.repeated_share:
            stored = (total / averaged).astype(np.float32)
        yield stored.copy()
    carried.time_s = request.start_s + number * interval


def _next_error(memory: LineMemory, now_s: float, state: LineState, rng: np.random.Generator) -> float:
    """The next value of the output's AR(1) process."""
    draw = math.sqrt(1.0 - state.output_jitter_share) * float(rng.standard_normal())
    if memory.output_error is None:
        return state.output_rms * draw
    rho = math.exp(-max(now_s - memory.output_time_s, 0.0) / max(state.output_correlation_s, 1e-12))
    return rho * memory.output_error + math.sqrt(1.0 - rho**2) * state.output_rms * draw

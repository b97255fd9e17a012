"""The bench of long sessions: two gaps, a panel that can be turned, effects that set in, and a clock that runs on.

It works off the same list of stages as `bench`, with loops made for bright frames, and hands every exposure through
the effects that were planted: layers in the beam, changes of what arrives, stages in the chain, laws of time.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter, Setting
from .bench import Frame
from .chain import BASE_STAGES, SUBPIXELS, FrameContext, Stage, electrons_drawn, level_read_out, run_chain
from .objects import fine_shape
from .phantoms import Posed
from .response import Incidence, compute_incidence, tube_load_mAs
from .system import DetectorMaps, LabSystem, detector_maps
from .unkindness import USUAL_SERIES, course_of, with_bad_pixels

FineMap = NDArray[np.float32]

_CELLS_AT_ONCE = 65536
_LAYER_LEVELS = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class FineRates:
    """Photons on their way into the scintillator, by class and sub-pixel, with the sums that bright ones are drawn by.

    Fields: cell (fine row, fine column) index into `rates`; rates (cell, class) photons per pixel and mAs; deposit_keV
    (class,); load_mAs of the frame; totals (cell,) sum of the rates; sums (cell, 3) of rate x deposit^k, k = 1, 2, 3;
    remote (cell,) rate of further photons that leave `remote_keV` (cell,) where they stop and the rest elsewhere (None:
    there are none).
    """

    cell: NDArray[np.int32]
    rates: NDArray[np.float32]
    deposit_keV: NDArray[np.float64]
    load_mAs: float
    totals: NDArray[np.float32]
    sums: NDArray[np.float32]
    remote: NDArray[np.float32] | None = None
    remote_keV: NDArray[np.float32] | None = None

    def spelled_out(self) -> NDArray[np.float32]:
        """Rates of every sub-pixel, (fine row, fine column, class)."""
        return self.rates[self.cell]


def fine_rates(
    cell: NDArray[np.int32], rates: NDArray[np.float32], deposit_keV: NDArray[np.float64], *, load_mAs: float = 1.0
) -> FineRates:
    """Rates of cells with their sums."""
    powers = np.stack([deposit_keV**power for power in range(4)], axis=1).astype(np.float32)
    sums = np.ascontiguousarray((rates @ powers).T)
    return FineRates(
        cell=cell, rates=rates, deposit_keV=deposit_keV, load_mAs=load_mAs, totals=sums[0], sums=sums[1:].T.copy()
    )


def rates_of_map(rates: NDArray[np.float32], like: FineRates) -> FineRates:
    """Rates (fine row, fine column, class) that no two sub-pixels share any more."""
    if like.remote is not None:
        raise ValueError("photons that were split in the screen are not moved any more")
    shape = rates.shape[:2]
    cell = np.arange(shape[0] * shape[1], dtype=np.int32).reshape(shape)
    return fine_rates(cell, np.ascontiguousarray(rates.reshape(-1, rates.shape[2])), like.deposit_keV)


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """What an effect may know of the exposure that it changes.

    Fields: system (true, at this gap); kV, filters, exposure_ms (as set); scene (name, empty: open field);
    thickness_mm (material -> fine map as it really is); panel_rotation_deg; incidence (the beam without object).
    """

    system: LabSystem
    kV: float
    filters: tuple[Filter, ...]
    exposure_ms: float
    scene: str
    thickness_mm: Mapping[str, FineMap]
    panel_rotation_deg: float
    incidence: Incidence


@dataclass(frozen=True, slots=True, kw_only=True)
class Planted:
    """An effect as it acts: any of these hooks, each None where the effect does not act there.

    Fields: id, strength, unit, since (`always` or `calibration`: after the calibration series); law (in words); parameters
    (inner ones, for the truth); system, maps: change the truth of the line; pose: of an object, with the size of a pixel in
    its plane in mm; layers: further path lengths in the beam; rates: change what arrives; in_screen: they do so where
    photons stop, after all that happens to the beam before; per_exposure_ms: `rates` depends on the exposure time; load:
    factor on the tube's output at a time (s); stages: (name of the base stage that it follows or, with a leading `-`,
    replaces; stage).
    """

    id: str
    strength: float
    unit: str
    since: str
    law: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    system: Callable[[LabSystem], LabSystem] | None = None
    maps: Callable[[DetectorMaps], DetectorMaps] | None = None
    pose: Callable[[Posed, float], Posed] | None = None
    layers: Callable[[Exposure], Mapping[str, FineMap]] | None = None
    rates: Callable[[FineRates, Exposure], FineRates] | None = None
    in_screen: bool = False
    per_exposure_ms: bool = False
    load: Callable[[float], float] | None = None
    stages: tuple[tuple[str, Stage], ...] = ()


def light_of_arrivals(arrivals: FineRates, context: FrameContext) -> NDArray[np.float32]:
    """Light (keV) at the sub-pixels where photons stopped."""
    from ._loops import poisson_tables
    from ._session_loops import light_of_many_photons

    keep, alias = poisson_tables()
    light = np.empty(arrivals.cell.shape, dtype=np.float32)
    light_of_many_photons(
        arrivals.cell,
        arrivals.rates,
        arrivals.totals,
        arrivals.sums,
        arrivals.load_mAs * context.summed / SUBPIXELS**2,
        arrivals.deposit_keV,
        1.0 / context.system.light_swank - 1.0,
        context.key,
        context.frame,
        SUBPIXELS,
        keep,
        alias,
        light,
    )
    return light


def _electrons(light_keV: NDArray[np.float32], context: FrameContext) -> NDArray[np.float32]:
    from ._session_loops import electrons_of_much_light

    return electrons_drawn(light_keV, context, loop=electrons_of_much_light)


def _readout(electrons: NDArray[np.float32], context: FrameContext) -> NDArray[np.float32]:
    from ._session_loops import read_out_fast

    return level_read_out(electrons, context, loop=read_out_fast)


# Photons, spread, shading, electrons, readout, lines, digitise; all but the loops of bright frames as in every chain.
SESSION_STAGES: tuple[Stage, ...] = (
    Stage(name="photons", apply=light_of_arrivals),
    *BASE_STAGES[1:3],
    Stage(name="electrons", apply=_electrons),
    Stage(name="readout", apply=_readout),
    *BASE_STAGES[5:],
)


def stages_with(planted: tuple[Planted, ...]) -> tuple[Stage, ...]:
    """The chain with the stages of effects put where they belong, in the order of the effects."""
    chain = list(SESSION_STAGES)
    for effect in planted:
        for place, stage in effect.stages:
            at = [one.name for one in chain].index(place.removeprefix("-"))
            if place.startswith("-"):
                chain[at] = stage
            else:
                # After the base stage and whatever was put behind it before.
                names = {one.name for one in SESSION_STAGES}
                at += 1
                while at < len(chain) and chain[at].name not in names:
                    at += 1
                chain.insert(at, stage)
    return tuple(chain)


class Line:
    """A system with its effects, switched on; the same system, effects, seed and order give the same bytes."""

    def __init__(
        self,
        system: LabSystem,
        *,
        rng: np.random.Generator,
        planted: tuple[Planted, ...] = (),
        series_count: int = USUAL_SERIES,
    ) -> None:
        self.base = system
        self._planted = planted
        self.clock_s = 0.0
        self._key = np.uint64(rng.integers(0, 2**64, dtype=np.uint64))
        self._next_frame = 0
        self.series = 0
        self.course = course_of(system, self._key, series_count)
        self._memory: dict[str, Any] = {}
        self.base_maps = detector_maps(system)
        self._kept: dict[tuple[Any, ...], FineRates] = {}
        self._kept_scene = ""
        self._set_in(calibrated=False)

    def _set_in(self, *, calibrated: bool) -> None:
        self.calibrated = calibrated
        self.active = tuple(effect for effect in self._planted if effect.since == "always" or calibrated)
        self.system, self.maps = self.base, self.base_maps
        for effect in self.active:
            if effect.system is not None:
                self.system = effect.system(self.system)
            if effect.maps is not None:
                self.maps = effect.maps(self.maps)
        if self.course is not None:
            self.maps = with_bad_pixels(self.maps, self.course.turned_bad(self.series))
        self._stages = stages_with(self.active)
        self._additive = all(stage.additive for stage in self._stages) and not any(e.load for e in self.active)
        self._kept.clear()

    def calibration_is_over(self) -> None:
        """Effects that came after the calibration act from now on."""
        if not self.calibrated:
            self._set_in(calibrated=True)

    def begin_series(self, number: int) -> None:
        """What changes from series to series is from now on as in the series of this number."""
        before, self.series = self.series, number
        if self.course is not None and self.course.turned_bad(before) != self.course.turned_bad(number):
            self._set_in(calibrated=self.calibrated)

    def pause(self, seconds: float) -> None:
        """Let time pass with the beam off and no frame read."""
        self.clock_s += seconds

    def at_gap(self, source_object_mm: float | None) -> LabSystem:
        """The system with its object at another place."""
        if source_object_mm is None:
            return self.system
        return replace(self.system, source_object_mm=source_object_mm)

    def arrivals(
        self,
        setting: Setting,
        *,
        scene: str = "",
        thickness_mm: Mapping[str, FineMap] | None = None,
        source_object_mm: float | None = None,
        panel_rotation_deg: float = 0.0,
    ) -> FineRates:
        """Photons that one exposure brings to every sub-pixel, behind an object as it really is or the open field."""
        lengths = thickness_mm or {}
        if scene != self._kept_scene:
            self._kept.clear()
            self._kept_scene = scene
        timed = any(effect.per_exposure_ms for effect in self.active)
        key = (setting.kV, setting.filters, panel_rotation_deg, setting.exposure_ms if timed else None)
        if key not in self._kept:
            incidence = compute_incidence(
                # The gap and the effects' read noise leave the beam as it is: one entry in the cache for all of them.
                self.system,
                kV=setting.kV,
                filters=setting.filters,
                materials=LINE_MATERIALS,
            )
            exposure = Exposure(
                system=self.at_gap(source_object_mm),
                kV=setting.kV,
                filters=setting.filters,
                exposure_ms=setting.exposure_ms,
                scene=scene,
                thickness_mm=lengths,
                panel_rotation_deg=panel_rotation_deg,
                incidence=incidence,
            )
            self._kept[key] = self._arriving(exposure)
        kept = self._kept[key]
        return replace(kept, load_mAs=tube_load_mAs(setting))

    def _arriving(self, exposure: Exposure) -> FineRates:
        layers: dict[str, FineMap] = dict(exposure.thickness_mm)
        for effect in self.active:
            if effect.layers is not None:
                for material, length in effect.layers(exposure).items():
                    layers[material] = layers[material] + length if material in layers else length
        incidence = exposure.incidence
        shape = fine_shape(self.system)
        if exposure.scene:
            rates = _rates_behind_map(incidence, layers, shape)
        elif layers:
            rates = _rates_behind_smooth_layer(incidence, layers)
        else:
            open_field = incidence.rates_per_mAs()[None].astype(np.float32)
            rates = fine_rates(np.zeros(shape, dtype=np.int32), open_field, incidence.deposit_keV)
        for effect in sorted(self.active, key=lambda effect: effect.in_screen):
            if effect.rates is not None:
                rates = effect.rates(rates, exposure)
        return rates

    def expose(self, arrivals: FineRates, setting: Setting, *, frames: int) -> Iterator[tuple[Frame, float]]:
        """Frames with the beam on, each with the time (s) at which it began."""
        for _ in range(frames):
            yield self._frame(arrivals, setting.exposure_ms, setting.averaged)

    def dark(self, exposure_ms: float, *, frames: int, averaged: int = 1) -> Iterator[tuple[Frame, float]]:
        """Frames with the beam off, each with the time (s) at which it began."""
        for _ in range(frames):
            yield self._frame(None, exposure_ms, averaged)

    def frame_interval_ms(self, exposure_ms: float) -> float:
        """Time from one frame's begin to the next's: exposure and readout."""
        return exposure_ms + self.system.readout_ms

    def _single(self, arrivals: FineRates | None, exposure_ms: float, summed: int) -> Frame:
        context = FrameContext(
            system=self.system,
            maps=self.maps,
            exposure_ms=exposure_ms,
            summed=summed,
            key=self._key,
            frame=self._next_frame,
            memory=self._memory,
            began_s=self.clock_s,
            series=self.series,
            course=self.course,
        )
        if arrivals is not None:
            if self.course is not None:
                factor = self.course.output(self.clock_s) * self.course.level(self.series)
                arrivals = replace(arrivals, load_mAs=arrivals.load_mAs * factor)
            for effect in self.active:
                if effect.load is not None:
                    arrivals = replace(arrivals, load_mAs=arrivals.load_mAs * effect.load(self.clock_s))
        self._next_frame += summed
        self.clock_s += summed * self.frame_interval_ms(exposure_ms) / 1000.0
        return run_chain(arrivals, context, stages=self._stages)  # type: ignore[arg-type]

    def _frame(self, arrivals: FineRates | None, exposure_ms: float, averaged: int) -> tuple[Frame, float]:
        began_s = self.clock_s
        if averaged == 1 or self._additive:
            return self._single(arrivals, exposure_ms, averaged), began_s
        total = np.zeros((self.system.rows, self.system.columns))
        for _ in range(averaged):
            total += self._single(arrivals, exposure_ms, 1)
        return (total / averaged).astype(np.float32), began_s


# All that a session may put into the beam, so that one table a beam serves every object.
MINERAL = "K2HPO4@2.44"
LINE_MATERIALS = ("chicken_breast", "rib_bone", "pmma", "water", "Al", "W", MINERAL)


def _sum_of_layers(incidence: Incidence, lengths: Mapping[str, NDArray[np.float32]], piece: slice) -> NDArray[Any]:
    first = next(iter(lengths.values()))
    exponent = np.zeros((first[piece].size, incidence.photons_per_mAs.size), dtype=np.float32)
    for material, length in lengths.items():
        exponent -= length[piece, None] * incidence.mu_of[material].astype(np.float32)
    return exponent


def _rates_of_lengths(incidence: Incidence, lengths: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """Rates (point, class) behind path lengths (point,)."""
    count = next(iter(lengths.values())).size
    share = incidence.class_share.astype(np.float32)
    photons = incidence.photons_per_mAs.astype(np.float32)
    rates = np.empty((count, share.shape[1]), dtype=np.float32)
    for start in range(0, count, _CELLS_AT_ONCE):
        piece = slice(start, min(start + _CELLS_AT_ONCE, count))
        # Nothing of e^-60 is ever seen, and numbers too small for single precision slow every loop down.
        exponent = np.maximum(_sum_of_layers(incidence, lengths, piece), np.float32(-60.0))
        np.matmul(photons * np.exp(exponent, out=exponent), share, out=rates[piece])
    return rates


def _rates_behind_map(incidence: Incidence, layers: Mapping[str, FineMap], shape: tuple[int, int]) -> FineRates:
    """Rates behind maps of path lengths; sub-pixels with the same layers share a cell where most of them do."""
    stacked = np.stack([layers[material].ravel() for material in layers])
    key = np.zeros(stacked.shape[1])
    for number, row in enumerate(stacked):
        key += row.astype(np.float64) * (math.sqrt(2.0) + number * math.e)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    lengths = {material: stacked[number, first] for number, material in enumerate(layers)}
    rates = _rates_of_lengths(incidence, lengths)
    return fine_rates(inverse.reshape(shape).astype(np.int32), rates, incidence.deposit_keV)


def _rates_behind_smooth_layer(incidence: Incidence, layers: Mapping[str, FineMap]) -> FineRates:
    """Rates behind layers that vary slowly over the open field, in steps too small to be seen."""
    if len(layers) == 1:
        ((material, length),) = layers.items()
        low, high = float(length.min()), float(length.max())
        step = (high - low) / (_LAYER_LEVELS - 1) or 1.0
        cell = np.rint((length - low) / step).astype(np.int32)
        levels = (low + step * np.arange(_LAYER_LEVELS)).astype(np.float32)
        rates = _rates_of_lengths(incidence, {material: levels})
        return fine_rates(cell, rates, incidence.deposit_keV)
    shape = next(iter(layers.values())).shape
    return _rates_behind_map(incidence, layers, (shape[0], shape[1]))

"""The bench of the virtual lab: put something in the beam, press the button, get frames."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter, Setting
from .chain import BASE_STAGES, Arrivals, FrameContext, Stage, run_chain
from .objects import Scene, fine_shape, thickness_on_fine_grid
from .response import Incidence, compute_incidence, tube_load_mAs
from .system import LabSystem, detector_maps
from .unkindness import USUAL_SERIES, course_of, with_bad_pixels

Frame = NDArray[np.uint16] | NDArray[np.float32]

_CELLS_AT_ONCE = 65536


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedScene:
    """A scene as the sub-pixels of one detector see it, so that it need not be drawn again for every setting.

    Fields: thickness_mm: material -> (fine row, fine column), margins included; cell (fine row, fine column) number of
    the covered sub-pixel, 0 in the open field; covered_mm: material -> (covered sub-pixel,).
    """

    thickness_mm: Mapping[str, NDArray[np.float32]]
    cell: NDArray[np.int32]
    covered_mm: Mapping[str, NDArray[np.float32]]

    @property
    def materials(self) -> tuple[str, ...]:
        """What the scene is made of."""
        return tuple(self.thickness_mm)


class Bench:
    """A system, switched on: it keeps the clock, the number of the next frame and what stages remember.

    The same system, seed and order of exposures give the same bytes, on any number of threads.
    """

    def __init__(
        self,
        system: LabSystem,
        *,
        rng: np.random.Generator,
        stages: tuple[Stage, ...] = BASE_STAGES,
        series_count: int = USUAL_SERIES,
    ) -> None:
        self.system = system
        self.base_maps = self.maps = detector_maps(system)
        self.stages = stages
        self.clock_s = 0.0
        self._key = np.uint64(rng.integers(0, 2**64, dtype=np.uint64))
        self._next_frame = 0
        self.series = 0
        self.course = course_of(system, self._key, series_count)
        self._memory: dict[str, Any] = {}
        # Rates behind the scene now in the beam, by kV and filters: other exposures of it need no new sum.
        self._in_beam: RenderedScene | None = None
        self._rates: dict[tuple[float, tuple[Filter, ...]], NDArray[np.float32]] = {}

    def begin_series(self, number: int) -> None:
        """What changes from series to series is from now on as in the series of this number."""
        self.series = number
        if self.course is not None:
            self.maps = with_bad_pixels(self.base_maps, self.course.turned_bad(number))

    def arrivals(self, setting: Setting, *, scene: Scene | RenderedScene | None = None) -> Arrivals:
        """Photons that one exposure brings to every sub-pixel, behind a scene or the open field."""
        load_mAs = tube_load_mAs(setting)
        system = self.system
        if setting.source_detector_mm is not None:
            ratio = setting.source_detector_mm / system.source_detector_mm
            load_mAs /= ratio**2
        incidence = compute_incidence(
            system, kV=setting.kV, filters=setting.filters, materials=() if scene is None else scene.materials
        )
        if scene is None:
            cell = np.zeros(fine_shape(system), dtype=np.int32)
            rates = _rates_behind(incidence, {})
        else:
            rendered = scene if isinstance(scene, RenderedScene) else render(system, scene)
            if rendered is not self._in_beam:
                self._in_beam, self._rates = rendered, {}
            beam_is = (setting.kV, setting.filters)
            if beam_is not in self._rates:
                self._rates[beam_is] = _rates_behind(incidence, rendered.covered_mm)
            cell, rates = rendered.cell, self._rates[beam_is]
        return Arrivals(cell=cell, rates=rates, deposit_keV=incidence.deposit_keV, load_mAs=load_mAs)

    def expose(
        self, setting: Setting, *, frames: int, scene: Scene | RenderedScene | None = None
    ) -> Iterator[tuple[Frame, float]]:
        """Frames with the beam on, each with the time (s) at which it began.

        A setting with `averaged` above 1 gives means of so many exposures, float32.
        """
        arrivals = self.arrivals(setting, scene=scene)
        for _ in range(frames):
            yield self._frame(arrivals, setting.exposure_ms, setting.averaged)

    def dark(self, exposure_ms: float, *, frames: int, averaged: int = 1) -> Iterator[tuple[Frame, float]]:
        """Frames with the beam off, each with the time (s) at which it began."""
        for _ in range(frames):
            yield self._frame(None, exposure_ms, averaged)

    def _frame(self, arrivals: Arrivals | None, exposure_ms: float, averaged: int) -> tuple[Frame, float]:
        began_s = self.clock_s
        self.clock_s += averaged * self.frame_interval_ms(exposure_ms) / 1000.0
        if arrivals is not None and self.course is not None:
            factor = self.course.output(began_s) * self.course.level(self.series)
            arrivals = replace(arrivals, load_mAs=arrivals.load_mAs * factor)
        context = FrameContext(
            system=self.system,
            maps=self.maps,
            exposure_ms=exposure_ms,
            summed=averaged,
            key=self._key,
            frame=self._next_frame,
            memory=self._memory,
            began_s=began_s,
            series=self.series,
            course=self.course,
        )
        self._next_frame += averaged
        if averaged > 1 and all(stage.additive for stage in self.stages):
            mean = run_chain(arrivals, context, stages=self.stages)
            if not self._near_saturation(mean, arrivals):
                return mean, began_s
        if averaged == 1:
            return run_chain(arrivals, context, stages=self.stages), began_s
        total = np.zeros((self.system.rows, self.system.columns))
        for number in range(averaged):
            one = replace(context, summed=1, frame=context.frame + number)
            total += run_chain(arrivals, one, stages=self.stages)
        return (total / averaged).astype(np.float32), began_s

    def frame_interval_ms(self, exposure_ms: float) -> float:
        """Time from one frame's begin to the next's: exposure and readout."""
        return exposure_ms + self.system.readout_ms

    def _near_saturation(self, mean: Frame, arrivals: Arrivals | None) -> bool:
        """Whether single exposures of this mean could have been cut off by the ADC, at either end."""
        highest_DN, lowest_DN = float(mean.max()), float(mean.min())
        system = self.system
        quantum_keV = 0.0 if arrivals is None else float(arrivals.deposit_keV.max()) / system.light_swank
        gain_DN = system.DN_per_electron * (1.0 + system.electrons_per_keV * quantum_keV)
        noise_DN = math.sqrt(gain_DN * highest_DN + float(self.maps.read_noise_DN.max()) ** 2)
        dark_noise_DN = float(self.maps.read_noise_DN.max())
        return highest_DN + 6.0 * noise_DN > system.saturation_DN or lowest_DN < 6.0 * dark_noise_DN


def render(system: LabSystem, scene: Scene) -> RenderedScene:
    """A scene on the sub-pixels of a system's detector."""
    lengths = thickness_on_fine_grid(system, scene)
    covered = np.any([length > 0 for length in lengths.values()], axis=0)
    cell = np.zeros(covered.shape, dtype=np.int32)
    cell[covered] = np.arange(1, int(covered.sum()) + 1, dtype=np.int32)
    return RenderedScene(
        thickness_mm=lengths, cell=cell, covered_mm={material: length[covered] for material, length in lengths.items()}
    )


def _rates_behind(incidence: Incidence, covered_mm: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """Rates of every class: row 0 in the open field, then one row a covered sub-pixel."""
    count = len(next(iter(covered_mm.values()))) if covered_mm else 0
    share = incidence.class_share.astype(np.float32)
    photons = incidence.photons_per_mAs.astype(np.float32)
    rates = np.empty((count + 1, share.shape[1]), dtype=np.float32)
    rates[0] = incidence.rates_per_mAs()
    for start in range(0, count, _CELLS_AT_ONCE):
        piece = slice(start, min(start + _CELLS_AT_ONCE, count))
        exponent = np.zeros((piece.stop - piece.start, photons.size), dtype=np.float32)
        for material, length in covered_mm.items():
            exponent -= length[piece, None] * incidence.mu_of[material].astype(np.float32)
        np.matmul(photons * np.exp(exponent, out=exponent), share, out=rates[piece.start + 1 : piece.stop + 1])
    return rates

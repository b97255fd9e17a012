"""The bench of the virtual lab: put something in the beam, press the button, get frames."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Setting
from .chain import BASE_STAGES, SUBPIXELS, Arrivals, FrameContext, Stage, margin_px, run_chain
from .objects import Scene, thickness_on_fine_grid
from .response import Incidence, compute_incidence, tube_load_mAs
from .system import LabSystem, detector_maps

Frame = NDArray[np.uint16] | NDArray[np.float32]

_CELLS_AT_ONCE = 65536


class Bench:
    """A system, switched on: it keeps the clock, the number of the next frame and what stages remember.

    The same system, seed and order of exposures give the same bytes, on any number of threads.
    """

    def __init__(self, system: LabSystem, *, rng: np.random.Generator, stages: tuple[Stage, ...] = BASE_STAGES) -> None:
        self.system = system
        self.maps = detector_maps(system)
        self.stages = stages
        self.clock_s = 0.0
        self._key = np.uint64(rng.integers(0, 2**64, dtype=np.uint64))
        self._next_frame = 0
        self._memory: dict[str, Any] = {}

    def arrivals(self, setting: Setting, *, scene: Scene | None = None) -> Arrivals:
        """Photons that one exposure brings to every sub-pixel, behind a scene or the open field."""
        load_mAs = tube_load_mAs(setting)
        system = self.system
        if setting.source_detector_mm is not None:
            ratio = setting.source_detector_mm / system.source_detector_mm
            load_mAs /= ratio**2
        incidence = compute_incidence(
            system, kV=setting.kV, filters=setting.filters, materials=() if scene is None else scene.materials
        )
        cell, rates = _cells(system, incidence, scene)
        return Arrivals(cell=cell, rates=rates, deposit_keV=incidence.deposit_keV, load_mAs=load_mAs)

    def expose(self, setting: Setting, *, frames: int, scene: Scene | None = None) -> Iterator[tuple[Frame, float]]:
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
        context = FrameContext(
            system=self.system,
            maps=self.maps,
            exposure_ms=exposure_ms,
            summed=averaged,
            key=self._key,
            frame=self._next_frame,
            memory=self._memory,
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


def _cells(
    system: LabSystem, incidence: Incidence, scene: Scene | None
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Which row of a table of rates each sub-pixel takes, and the table: row 0 is the open field."""
    open_field = incidence.rates_per_mAs()[None, :].astype(np.float32)
    margin = margin_px(system.psf_sigma_px)
    shape = ((system.rows + 2 * margin) * SUBPIXELS, (system.columns + 2 * margin) * SUBPIXELS)
    if scene is None:
        return np.zeros(shape, dtype=np.int32), open_field
    lengths = thickness_on_fine_grid(system, scene)
    covered = np.zeros(shape, dtype=bool)
    for length in lengths.values():
        covered |= length > 0
    cell = np.zeros(shape, dtype=np.int32)
    count = int(covered.sum())
    cell[covered] = np.arange(1, count + 1, dtype=np.int32)
    rates = np.empty((count + 1, open_field.shape[1]), dtype=np.float32)
    rates[0] = open_field
    flat = {material: length[covered] for material, length in lengths.items()}
    for start in range(0, count, _CELLS_AT_ONCE):
        piece = slice(start, min(start + _CELLS_AT_ONCE, count))
        behind = incidence.rates_per_mAs({material: length[piece] for material, length in flat.items()})
        rates[piece.start + 1 : piece.stop + 1] = behind
    return cell, rates

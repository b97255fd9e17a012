"""The measuring chain of the lab: a list of stages from the photons that arrive to the numbers that the ADC gives.

An effect that a real line has and the base lab has not is one more stage, put into the list where it belongs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .system import DetectorMaps, LabSystem
from .unkindness import SessionCourse

SUBPIXELS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrivals:
    """Photons on their way into the scintillator, by class and sub-pixel.

    Fields: cell (fine row, fine column) index into `rates`, margins of the spread included; rates (cell, class)
    photons per pixel and mAs; deposit_keV (class,); load_mAs of the frame.
    """

    cell: NDArray[np.int32]
    rates: NDArray[np.float32]
    deposit_keV: NDArray[np.float64]
    load_mAs: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameContext:
    """What a stage may know of the frame that it works on.

    Fields: system, maps; exposure_ms; summed: how many exposures are simulated as one and averaged (1: a single frame);
    key: of the random streams; frame: number within the session; memory: what stateful stages keep between frames;
    began_s: the session's clock when the exposure began; series: number within the session; course: of what the line does
    a little all the time (None: nothing).
    """

    system: LabSystem
    maps: DetectorMaps
    exposure_ms: float
    summed: int
    key: np.uint64
    frame: int
    memory: dict[str, Any] = field(default_factory=dict)
    began_s: float = 0.0
    series: int = 0
    course: SessionCourse | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One step of the chain.

    Fields: name; apply (what comes in, context) -> what goes on; additive: n exposures may be drawn as one of n times
    the load and divided by n, because the stage is linear and keeps nothing between frames.
    """

    name: str
    apply: Callable[[Any, FrameContext], Any]
    additive: bool = True


def margin_px(psf_sigma_px: float) -> int:
    """Pixels around the detector from which light still reaches it: 4 sigma and a half, rounded up."""
    return 0 if psf_sigma_px == 0 else math.ceil(4.0 * psf_sigma_px + 0.5)


TAIL_REACH_PX = 12


@lru_cache(maxsize=64)
def _tail_kernel(law: str, length_px: float) -> NDArray[np.float64]:
    steps = np.arange(-TAIL_REACH_PX, TAIL_REACH_PX + 1)
    distance = np.hypot(steps[:, None], steps[None, :]) / length_px
    weights = np.exp(-distance) if law == "exponential" else (1.0 + distance**2) ** -1.5
    return np.asarray(weights / weights.sum())


def tail_kernel(law: str, length_px: float) -> NDArray[np.float64]:
    """Shares (row, column) of the tail's light that pixels around take, from -12 to 12 px; they add up to 1."""
    return _tail_kernel(law, length_px).copy()


@lru_cache(maxsize=16)
def _tail_spectrum(law: str, length_px: float, shape: tuple[int, int]) -> NDArray[np.complex64]:
    from scipy import fft

    kernel = _tail_kernel(law, length_px).astype(np.float32)
    placed = np.zeros(shape, dtype=np.float32)
    placed[: kernel.shape[0], : kernel.shape[1]] = kernel
    placed = np.roll(placed, (-TAIL_REACH_PX, -TAIL_REACH_PX), axis=(0, 1))
    return np.asarray(fft.rfft2(placed, workers=1))


def with_tail(light: NDArray[np.float32], system: LabSystem) -> NDArray[np.float32]:
    """Light in pixels (row, column) of which a share has gone farther; beyond the borders it goes on as in a mirror."""
    from scipy import fft

    share = np.float32(system.tail_share)
    wide = np.pad(light, TAIL_REACH_PX, mode="symmetric")
    shape = tuple(fft.next_fast_len(length, real=True) for length in wide.shape)
    spectrum = _tail_spectrum(system.tail_law, system.tail_length_px, (shape[0], shape[1]))
    far = fft.irfft2(fft.rfft2(wide, s=shape, workers=1) * spectrum, s=shape, workers=1)
    rows, columns = light.shape
    inside = slice(TAIL_REACH_PX, TAIL_REACH_PX + rows), slice(TAIL_REACH_PX, TAIL_REACH_PX + columns)
    mixed = (np.float32(1.0) - share) * light + share * far[inside]
    return np.asarray(np.maximum(mixed, 0.0), dtype=np.float32)


def spread_taps(psf_sigma_px: float, *, margin: int | None = None) -> NDArray[np.float32]:
    """Shares that a pixel takes of a line of sub-pixels across it and its margins; shape ((2 margin + 1) SUBPIXELS,).

    w(x) = Phi((x + 1/2) / sigma) - Phi((x - 1/2) / sigma), x from the pixel's centre to the sub-pixel's, rescaled so
    that each sub-pixel gives all its light.
    """
    from scipy.special import ndtr

    margin = margin_px(psf_sigma_px) if margin is None else margin
    x = (np.arange((2 * margin + 1) * SUBPIXELS) + 0.5) / SUBPIXELS - margin - 0.5
    if psf_sigma_px == 0:
        return (np.abs(x) < 0.5).astype(np.float32)
    taps = ndtr((x + 0.5) / psf_sigma_px) - ndtr((x - 0.5) / psf_sigma_px)
    phases = taps.reshape(-1, SUBPIXELS)
    shares: NDArray[np.float32] = (phases / phases.sum(axis=0)).ravel().astype(np.float32)
    return shares


def _photons(arrivals: Arrivals, context: FrameContext) -> NDArray[np.float32]:
    """Photons drawn, absorbed, turned into light (keV) at the sub-pixel where they landed."""
    from ._loops import light_of_photons, poisson_tables

    keep, alias = poisson_tables()
    light = np.empty(arrivals.cell.shape, dtype=np.float32)
    light_of_photons(
        arrivals.cell,
        arrivals.rates,
        arrivals.rates.sum(axis=1, dtype=np.float32),
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


def _dark_light(context: FrameContext) -> NDArray[np.float32]:
    return np.zeros((context.system.rows, context.system.columns), dtype=np.float32)


def _spread(light: NDArray[np.float32], context: FrameContext) -> NDArray[np.float32]:
    """Light spread and collected in square pixels (keV per pixel)."""
    from ._loops import spread_light

    collected, system = _dark_light(context), context.system
    margin = margin_px(max(system.core_px))
    by_row, by_column = (spread_taps(sigma, margin=margin) for sigma in system.core_px)
    spread_light(light, by_row, by_column, SUBPIXELS, collected)
    return with_tail(collected, system) if system.tail_share else collected


def _shading(light: NDArray[np.float32], context: FrameContext) -> NDArray[np.float32]:
    """Light as the open field's shape and dust are in this series."""
    if context.course is None:
        return light
    shaded: NDArray[np.float32] = light * context.course.shading(context.series)
    return shaded


def _lines(level_DN: NDArray[np.float32], context: FrameContext) -> NDArray[np.float32]:
    """The level with the dark's drift and the offsets of rows and columns in this frame."""
    if context.course is None:
        return level_DN
    sigma_DN = context.system.read_noise_DN
    rows, columns = context.course.line_noise(context.frame, context.summed)
    offset_DN = context.course.dark_DN(context.began_s)
    moved: NDArray[np.float32] = level_DN + (sigma_DN * rows[:, None] + sigma_DN * columns + offset_DN).astype(
        np.float32
    )
    return moved


def electrons_drawn(
    light_keV: NDArray[np.float32], context: FrameContext, *, loop: Callable[..., None]
) -> NDArray[np.float32]:
    """Electrons of light and dark current, Poisson in each pixel; loop: as `_loops.electrons_of_light`."""
    from ._loops import poisson_tables

    keep, alias = poisson_tables()
    dark = context.maps.dark_current_DN_per_ms * (context.exposure_ms * context.summed / context.system.DN_per_electron)
    electrons = np.empty_like(light_keV)
    loop(light_keV, context.system.electrons_per_keV, dark, context.key, context.frame, keep, alias, electrons)
    return electrons


def level_read_out(
    electrons: NDArray[np.float32], context: FrameContext, *, loop: Callable[..., None]
) -> NDArray[np.float32]:
    """Analogue level in DN: conversion map, dark map, white electronic noise; loop: as `_loops.read_out`."""
    summed = context.summed
    # The mean of n rounded numbers keeps 1/12n DN2 of rounding; `_digitise` rounds the mean once, in steps of 1/n.
    rounding_DN2 = (1.0 / summed - 1.0 / summed**2) / 12.0
    noise = np.sqrt(context.maps.read_noise_DN**2 / summed + np.float32(rounding_DN2))
    level_DN = np.empty_like(electrons)
    loop(
        electrons,
        context.maps.DN_per_electron,
        context.maps.dark_DN,
        noise,
        1.0 / summed,
        context.key,
        context.frame,
        level_DN,
    )
    return level_DN


def _electrons(light_keV: NDArray[np.float32], context: FrameContext) -> NDArray[np.float32]:
    from ._loops import electrons_of_light

    return electrons_drawn(light_keV, context, loop=electrons_of_light)


def _readout(electrons: NDArray[np.float32], context: FrameContext) -> NDArray[np.float32]:
    from ._loops import read_out

    return level_read_out(electrons, context, loop=read_out)


def _digitise(level_DN: NDArray[np.float32], context: FrameContext) -> NDArray[np.uint16] | NDArray[np.float32]:
    """ADC: whole numbers from 0 to the highest that `bits` hold."""
    if context.summed == 1:
        numbers: NDArray[np.uint16] = np.clip(np.rint(level_DN), 0, context.system.saturation_DN).astype(np.uint16)
        return numbers
    steps = np.float32(context.summed)
    mean: NDArray[np.float32] = np.clip(np.rint(level_DN * steps) / steps, 0, context.system.saturation_DN)
    return mean


BASE_STAGES: tuple[Stage, ...] = (
    Stage(name="photons", apply=_photons),
    Stage(name="spread", apply=_spread),
    Stage(name="shading", apply=_shading),
    Stage(name="electrons", apply=_electrons),
    Stage(name="readout", apply=_readout),
    Stage(name="lines", apply=_lines),
    Stage(name="digitise", apply=_digitise),
)


def run_chain(
    arrivals: Arrivals | None, context: FrameContext, *, stages: tuple[Stage, ...] = BASE_STAGES
) -> NDArray[np.uint16] | NDArray[np.float32]:
    """One frame in DN (row, column): uint16, or float32 where exposures are summed and averaged.

    Args:
        arrivals: what comes from the tube; None: beam off, and the stages up to `spread` are left out.
        context: of the frame.
        stages: the chain, in order.
    """
    if arrivals is not None:
        signal: Any = arrivals
        remaining = stages
    else:
        signal = _dark_light(context)
        names = [stage.name for stage in stages]
        remaining = stages[names.index("spread") + 1 :]
    for stage in remaining:
        signal = stage.apply(signal, context)
    return signal  # type: ignore[no-any-return]

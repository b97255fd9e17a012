"""The stages that an exposure's charge passes on its way to the stored number: each says what is expected, and draws it.

    Quanta          photons, spread of light, output of the tube
    LineFactors     factors of rows and columns of one exposure
    Traps           charge that is caught and read later
    FixedGain       patterns of the gain that calibration has not seen
    RisingGain      a gain that light raises
    Response        a curve that bends, counts that are lost
    Electronics     dark, offsets, noise, bad pixels
    Converter       rounding and the ends of the ADC's range

`Chain` holds those of one series. What all frames of a series have alike is expected at the stage where it arises; what is new in
each frame and has no part in the mean of a pixel is drawn alone.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..line.line_state import FloatArray, GainMemory, LagLaw, LineFlicker, LineState
from ..line.rounding import rounded_variance
from ._spread import blurred_object
from .defects import BadPixels, Jumping, gain_pattern, new_bad_pixels, sample_flicker, sample_offsets, tile_gain
from .light import Charge
from .memory import LAGS, Trapped, decays, filling, frame_means, gain_course, temporal_covariance, with_trapped
from .response import counting_noise, responded, responds, slope

_HARMONICS = 6  # of the ADC's staircase; needed only where the noise is below half a step
_ROUNDED_SD = 0.7  # of noise, in steps of the ADC: from there on the staircase's first harmonic is below 1e-4 of a step
_HOT_SIGMAS = 20.0  # of the read noise: offset of a new hot pixel in the samples

Trend = list[tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """When exposures are made: start_s and interval_s of a series, its stored frames, exposures averaged in each."""

    start_s: float
    interval_s: float
    frames: int
    averaged: int

    @property
    def exposures(self) -> int:
        """Of the whole series."""
        return self.frames * self.averaged

    def times_s(self) -> FloatArray:
        """Begin of every exposure (exposure,), in the session."""
        return np.asarray(self.start_s + self.interval_s * np.arange(self.exposures, dtype=np.float64))


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """What the readout knows of the detector.

    Fields: shape; dark_DN, read_DN2 (row, column): without what effects add; the variance is that of one exposure without rounding;
    bits of the ADC, or None; from_zero: it stores nothing below 0; draft: pixels stand for others with means of their own.
    """

    shape: tuple[int, int]
    dark_DN: FloatArray
    read_DN2: FloatArray
    bits: int | None
    from_zero: bool
    draft: bool = False


@dataclass(frozen=True, slots=True)
class Exposure:
    """One that is drawn: its number in the series, its begin in the session, s, and where chance comes from."""

    number: int
    time_s: float
    rng: np.random.Generator


@dataclass(slots=True, kw_only=True)
class Frames:
    """Stored frames as they are expected after a stage; maps (row, column), or (1, 1) where all pixels are alike.

    Fields: signal_DN: mean over the frames, above dark; trend: (map, (frames,) profile of mean 0), its change over them;
    on_quanta: factor on the variance of one exposure's quanta; temporal_correlation (3,) of that over 1, 2, 3 frames; dark_DN;
    read_DN2: variance of the electronics in one exposure; mean_DN: dark included; quantum_DN2, white_DN2; saturated_share.
    """

    signal_DN: FloatArray
    trend: Trend = field(default_factory=list)
    on_quanta: FloatArray | float
    temporal_correlation: FloatArray = field(default_factory=lambda: np.zeros(LAGS))
    dark_DN: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    read_DN2: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    mean_DN: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    quantum_DN2: FloatArray
    white_DN2: FloatArray
    saturated_share: float = 0.0


class Stage(Protocol):
    """What one part of the line does to exposures."""

    def expect(self, frames: Frames) -> Frames:
        """Stored frames behind this stage, of those before it."""

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """One exposure (row, column) behind this stage, of that before it."""


@dataclass(slots=True, kw_only=True)
class LineMemory:
    """What the line remembers from one series to the next when frames are sampled: trapped charge and output error.

    Fields: trapped_DN (trap, row, column) or None, at time_s; output_error of the exposure that began at output_time_s.
    """

    trapped_DN: FloatArray | None = None
    time_s: float = 0.0
    output_error: float | None = None
    output_time_s: float = 0.0


class TubeOutput:
    """One factor for all pixels of an exposure: an AR(1) process, and a part that is new in each exposure."""

    def __init__(self, state: LineState, memory: LineMemory) -> None:
        self._rms = state.output_rms
        self._correlation_s = max(state.output_correlation_s, 1e-12)
        self._jitter = state.output_jitter_share
        self._memory = memory

    def variance_of_mean(self, interval_s: float, exposures: int) -> float:
        """Of the mean of so many exposures, over that of one."""
        return self._wandering(interval_s, exposures) + self._jitter / exposures

    def correlation(self, clock: Clock) -> FloatArray:
        """Of a stored frame with the one 0, 1, 2... frames later (frames,)."""
        lags = np.arange(clock.frames) * clock.interval_s * clock.averaged
        found = np.exp(-lags / self._correlation_s)
        wandering = self._wandering(clock.interval_s, clock.averaged)
        found[1:] *= wandering / (wandering + self._jitter / clock.averaged)
        return np.asarray(found)

    def sample(self, exposure: Exposure) -> float:
        """Factor of an exposure."""
        if self._rms <= 0:
            return 1.0
        memory, rng = self._memory, exposure.rng
        draw = math.sqrt(1.0 - self._jitter) * float(rng.standard_normal())
        if memory.output_error is None:
            error = self._rms * draw
        else:
            rho = math.exp(-max(exposure.time_s - memory.output_time_s, 0.0) / self._correlation_s)
            error = rho * memory.output_error + math.sqrt(1.0 - rho**2) * self._rms * draw
        memory.output_error, memory.output_time_s = error, exposure.time_s
        if self._jitter > 0:
            error += math.sqrt(self._jitter) * self._rms * float(rng.standard_normal())
        return max(1.0 + error, 0.0)

    def sample_mean(self, interval_s: float, exposures: int, rng: np.random.Generator) -> float:
        """Mean factor of exposures one after the other."""
        if self._rms <= 0:
            return 1.0
        rms = math.sqrt(self.variance_of_mean(interval_s, exposures)) * self._rms
        return max(1.0 + rms * float(rng.standard_normal()), 0.0)

    def _wandering(self, interval_s: float, exposures: int) -> float:
        if exposures == 1:
            return 1.0 - self._jitter
        lag = np.arange(1, exposures)
        rho = np.exp(-lag * interval_s / self._correlation_s)
        mean = float((1.0 + 2.0 * np.sum((1.0 - lag / exposures) * rho)) / exposures)
        return (1.0 - self._jitter) * mean


class Quanta:
    """Photons of one exposure, counted per pixel, then spread, under the tube's output.

    state: where they are drawn, with the variance of quanta alone (`of_quanta`).
    """

    def __init__(self, state: LineState, charge: Charge, output: TubeOutput, shape: tuple[int, int]) -> None:
        self._state, self.charge, self._output, self._shape = state, charge, output, shape

    def expect(self, averaged: int) -> Frames:
        """Stored frames of exposures that nothing else has changed."""
        charge = self.charge
        return Frames(
            signal_DN=charge.mean, on_quanta=1.0 / averaged, quantum_DN2=charge.correlated, white_DN2=charge.white
        )

    def sample(self, exposure: Exposure) -> FloatArray:
        """Charge of one exposure (row, column), DN."""
        scale, white, before, quantum = self._parts
        noise = scale * self.charge.pattern.sample(before, quantum, self._shape, exposure.rng)
        noise += white * exposure.rng.standard_normal(self._shape)
        factor = self._output.sample(exposure)
        return np.asarray(factor * self.charge.mean + math.sqrt(factor) * noise)

    @cached_property
    def _parts(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Factor on the spread noise of quanta; sd of the white part; mean before the spread; a quantum's worth."""
        charge = self.charge
        by_chance = counting_noise(self._state, charge.mean)
        before, variance = blurred_object(self._state)
        # a quantum's worth, so that their number is Poisson; floors where an opaque object lets nothing through
        quantum = variance / np.maximum(before, 1e-300)
        quantum = np.maximum(quantum, 1e-9 * float(np.max(quantum)) + 1e-300)
        return np.sqrt(charge.shape * charge.relative * by_chance), np.sqrt(charge.white * by_chance), before, quantum


class LineFactors:
    """Factors of the rows and columns of an exposure, or of the mean of several: 1 on average."""

    def __init__(self, flicker: LineFlicker, shape: tuple[int, int], mean_of: int) -> None:
        self._flicker, self._shape = replace(flicker, rms=flicker.rms / math.sqrt(mean_of)), shape

    def expect(self, frames: Frames) -> Frames:
        """As they are: rows and columns are told apart from pixels."""
        return frames

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """Times the factors of this exposure."""
        return value_DN * sample_flicker(self._flicker, self._shape, exposure.rng)


class Traps:
    """Charge that is caught in one exposure and read in later ones.

    Args:
        law: of the traps.
        clock: of the series.
        before: what earlier exposures have left, where the mean is asked.
        begin: (trap, row, column) in the traps at the begin of the series, and what its first exposure finds, where frames are drawn.
    """

    def __init__(
        self,
        law: LagLaw,
        clock: Clock,
        before: Callable[[], Trapped],
        begin: Callable[[], tuple[FloatArray, FloatArray]],
    ) -> None:
        self._law, self._clock, self._before, self._begin = law, clock, before, begin
        self.held_DN: FloatArray | None = None

    def expect(self, frames: Frames) -> Frames:
        """With what is released, less what is caught; noise carried on from frame to frame."""
        law, clock = self._law, self._clock
        decay = decays(law, clock.interval_s)
        signal, trend = with_trapped(law, decay, self._before(), frames.signal_DN, clock.exposures, clock.averaged)
        covariance = temporal_covariance(law, decay, clock.averaged)
        return replace(
            frames,
            signal_DN=signal,
            trend=trend,
            on_quanta=float(covariance[0]),
            temporal_correlation=covariance[1:] / covariance[0],
        )

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """What is read of this exposure."""
        found: FloatArray | None = None
        if self.held_DN is None:
            self.held_DN, found = self._begin()
        decay = decays(self._law, self._clock.interval_s)[:, None, None]
        share = np.asarray(self._law.trapped)[:, None, None]
        released = (1.0 - decay) * self.held_DN
        self.held_DN = self.held_DN - released + share * value_DN
        value_DN = value_DN * (1.0 - share.sum()) + released.sum(axis=0)
        return value_DN if found is None else value_DN + found


class FixedGain:
    """Patterns of the gain that no map knows, drawn from the effects' seeds: 1 on average."""

    def __init__(self, state: LineState, shape: tuple[int, int]) -> None:
        self._state, self._shape = state, shape

    def expect(self, frames: Frames) -> Frames:
        """As they are: where a pixel lies in the pattern is not known."""
        return frames

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """Times the gain of each pixel."""
        return value_DN * self._gain

    @cached_property
    def _gain(self) -> FloatArray:
        fixed, tiles = self._state.gain_pattern, self._state.tile_pattern
        gain = np.ones((1, 1)) if fixed is None else gain_pattern(fixed, self._shape)
        return gain if tiles is None else gain * tile_gain(tiles, self._shape)


class RisingGain:
    """A gain that earlier light has raised.

    Args:
        law: of its traps.
        clock: of the series.
        light_DN: of one exposure.
        before: share of each kind of its traps that earlier series have filled.
    """

    def __init__(self, law: GainMemory, clock: Clock, light_DN: FloatArray, before: Sequence[FloatArray]) -> None:
        self._law, self._clock, self._light, self._filled = law, clock, light_DN, list(before)
        self._filling = filling(law, light_DN, clock.interval_s)

    def expect(self, frames: Frames) -> Frames:
        """Times the mean gain, which rises over the series."""
        clock = self._clock
        gain, changes = gain_course(
            self._law, self._filled, self._light, clock.interval_s, clock.exposures, clock.averaged
        )
        rising = ((rise * frames.signal_DN, course) for rise, course in changes)
        return replace(
            frames,
            signal_DN=gain * frames.signal_DN,
            trend=[*((gain * amount, each) for amount, each in frames.trend), *rising],
            on_quanta=frames.on_quanta * gain**2,
        )

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """Times the gain as it is now."""
        full = sum(share * filled for (share, _), filled in zip(self._law.kinds, self._filled, strict=True))
        self._filled = [
            steady + (filled - steady) * np.exp(-pace)
            for filled, (steady, pace) in zip(self._filled, self._filling, strict=True)
        ]
        return value_DN * (1.0 + self._law.most * full)


class Response:
    """A curve that bends, and counts that are lost."""

    def __init__(self, state: LineState) -> None:
        self._state = state

    def expect(self, frames: Frames) -> Frames:
        """Through the curve; changes and noise by its slope."""
        state = self._state
        if not responds(state):
            return frames
        steepness = slope(state, frames.signal_DN)
        return replace(
            frames,
            signal_DN=responded(state, frames.signal_DN),
            trend=[(steepness * amount, course) for amount, course in frames.trend],
            on_quanta=frames.on_quanta * (steepness**2 * counting_noise(state, frames.signal_DN)),
        )

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """What is read of this light."""
        return responded(self._state, value_DN)


class Electronics:
    """Dark, offsets, noise of the readout, and pixels that went bad."""

    def __init__(self, state: LineState, panel: Panel, clock: Clock, mean_of: int, *, noisy: bool) -> None:
        self._state, self._panel, self._clock = state, panel, clock
        self._mean_of, self._noisy = mean_of, noisy
        self._jumping: Jumping | None = None

    def expect(self, frames: Frames) -> Frames:
        """On dark and offsets; what drifts in the darks is a trend."""
        clock, dark, trend = self._clock, self._panel.dark_DN, list(frames.trend)
        for height, profile in self._state.offsets:
            course = frame_means(profile(clock.times_s()), clock.averaged)
            dark = dark + height * course.mean()
            if clock.frames > 1:
                trend.append((np.full(dark.shape, height), course - course.mean()))
        quantum, white = frames.quantum_DN2, frames.white_DN2
        if np.ndim(frames.on_quanta) or frames.on_quanta != 1.0:
            # secondary quanta are drawn before the traps as the others are
            quantum, white = frames.on_quanta * quantum, frames.on_quanta * white
        return replace(
            frames,
            trend=trend,
            dark_DN=dark,
            mean_DN=dark + frames.signal_DN,
            quantum_DN2=quantum,
            white_DN2=white,
            read_DN2=self._panel.read_DN2,
        )

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """Everything that is added after the light."""
        state, shape, rng = self._state, self._panel.shape, exposure.rng
        read_DN, bad = self._read_DN, self._bad
        if state.telegraph is not None and self._jumping is None:
            self._jumping = Jumping(state.telegraph, shape, rng)
        if bad is not None:
            value_DN = np.where(bad.dead, 0.0, value_DN)
        value_DN = value_DN + self._panel.dark_DN
        if self._noisy:
            value_DN = value_DN + read_DN * rng.standard_normal(shape)
        for height, profile in state.offsets:
            value_DN = value_DN + height * float(profile(np.array(exposure.time_s)))
        value_DN = value_DN + sample_offsets(state, shape, rng) / math.sqrt(self._mean_of)
        if self._jumping is not None:
            for _ in range(self._mean_of):
                value_DN = self._jumping.added_to(value_DN, read_DN / self._mean_of, rng)
        if bad is not None:
            value_DN = np.where(bad.hot, value_DN + _HOT_SIGMAS * (read_DN + 1.0), value_DN)
        return value_DN

    @cached_property
    def _read_DN(self) -> FloatArray:
        return np.sqrt(self._panel.read_DN2)

    @cached_property
    def _bad(self) -> BadPixels | None:
        return new_bad_pixels(self._state, self._panel.shape)


class Converter:
    """The ADC: rounding, and the ends of its range."""

    def __init__(self, state: LineState, panel: Panel, averaged: int, mean_of: int) -> None:
        self._state, self._averaged, self._mean_of, self._draft = state, averaged, mean_of, panel.draft
        self._highest = math.inf if panel.bits is None else 2.0**panel.bits - 1.0
        self._lowest = 0.0 if panel.from_zero else -math.inf

    def expect(self, frames: Frames) -> Frames:
        """Mean and noise of rounded numbers, cut at the end of the range."""
        state, averaged, mean = self._state, self._averaged, frames.mean_DN
        least = frames.read_DN2 + state.row_variance_DN2 + state.column_variance_DN2
        rounding: FloatArray | float = state.step_DN**2 / 12.0
        if float(np.min(least)) < _ROUNDED_SD**2 * state.step_DN**2:
            noise = averaged * (frames.quantum_DN2 + frames.white_DN2) + least
            if self._draft:
                # what rounding does on average
                rounding = rounded_variance(noise, state.step_DN) - noise
            else:
                shift, rounding = _staircase(mean, noise, state.step_DN)
                mean = mean + shift
        saturated = 0.0
        if float(mean.max()) >= self._highest:
            saturated = float(np.mean(mean >= self._highest))
            mean = np.minimum(mean, self._highest)
        return replace(
            frames,
            mean_DN=mean,
            white_DN2=frames.white_DN2 + (frames.read_DN2 + rounding) / averaged,
            saturated_share=saturated,
        )

    def sample(self, value_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """The number that is stored."""
        step = self._state.step_DN / self._mean_of
        if step > 0:
            value_DN = np.rint(value_DN / step) * step
        return np.asarray(np.clip(value_DN, self._lowest, self._highest))


@dataclass(frozen=True, slots=True)
class Chain:
    """The stages that the charge of a series passes."""

    stages: Sequence[Stage]
    clock: Clock
    shape: tuple[int, int]

    @property
    def held_DN(self) -> FloatArray | None:
        """Charge in the traps (trap, row, column) after the frames that were drawn, or None."""
        return next((stage.held_DN for stage in self.stages if isinstance(stage, Traps)), None)

    def expect(self, quanta: Quanta) -> Frames:
        """Stored frames."""
        frames = quanta.expect(self.clock.averaged)
        for stage in self.stages:
            frames = stage.expect(frames)
        return frames

    def sample(self, quanta: Quanta | None, frame: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Stored frame (row, column) of this number, DN; frames are drawn in their order. quanta: None without beam."""
        clock = self.clock
        total = np.zeros(self.shape)
        for number in range(frame * clock.averaged, (frame + 1) * clock.averaged):
            exposure = Exposure(number, clock.start_s + number * clock.interval_s, rng)
            total += self.read(np.zeros(self.shape) if quanta is None else quanta.sample(exposure), exposure)
        return np.asarray(total / clock.averaged, dtype=np.float32)

    def read(self, charge_DN: FloatArray, exposure: Exposure) -> FloatArray:
        """What is stored of a charge (row, column)."""
        for stage in self.stages:
            charge_DN = stage.sample(charge_DN, exposure)
        return charge_DN


def chain_of(
    state: LineState,
    panel: Panel,
    clock: Clock,
    *,
    lit: bool = True,
    traps: Traps | None = None,
    rising: RisingGain | None = None,
    mean_of: int = 1,
    noisy: bool = True,
) -> Chain:
    """The stages of a line in this state.

    Args:
        state: after all effects.
        panel, clock: detector and series.
        lit: whether the beam is on.
        traps, rising: what remembers earlier exposures, where the line has it.
        mean_of: exposures that one drawn charge is the mean of.
        noisy: whether the electronics draw the pixels' noise; False: charges hold it.
    """
    patterns = lit and (state.gain_pattern is not None or state.tile_pattern is not None)
    stages: list[Stage | None] = [
        LineFactors(state.flicker, panel.shape, mean_of) if lit and state.flicker is not None else None,
        traps,
        FixedGain(state, panel.shape) if patterns else None,
        rising,
        Response(state),
        Electronics(state, panel, clock, mean_of, noisy=noisy),
        Converter(state, panel, clock.averaged, mean_of),
    ]
    return Chain([stage for stage in stages if stage is not None], clock, panel.shape)


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

"""The line as it is asked: a twin with effects, what its series of frames are expected to hold, and frames drawn from it.

One chain in the order of the real line (`line_state`): beam, projection, arrivals, blur of the object, quanta and optical spread
(`light`); exposure, lag, response, electronics, readout (`stages`). What is expected and what is drawn pass the same stages.
"""

import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..effects import AppliedEffect, in_order
from ..line.line_state import FixedPattern, FloatArray, LagLaw, LineFlicker, LineState, TelegraphPixels, TilePattern
from ..line.series_request import SeriesRequest
from ..line.twin import Twin
from ._spread import from_beyond
from .light import BEFORE_EXPOSURE, Acting, Charge, Light, context_of, light_of, of_quanta
from .memory import Trapped, filled_before, pause_of, paused, trapped_before
from .model_cache import ModelCache
from .stages import Chain, Clock, LineMemory, Panel, Quanta, RisingGain, Traps, TubeOutput, chain_of

__all__ = ["ExpectedSeries", "LineMemory", "LineModel"]


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


@dataclass(frozen=True, slots=True, eq=False)
class LineModel:
    """A line: a twin with effects.

    Fields:
        twin: the calibrated line.
        effects: in place of the twin's own; None: the twin's.
        parameters: (parameter,) of the spectrum in place of the posterior's best.
        use_measured_level: where the twin measured this kV and filters, take level and noise from there and only their
            change with the parameters from the spectral model.
        cache: scenes and beams that were projected; lines that share it share them.

    Example:
        >>> import raytwin as rt
        >>> from raytwin.generator import LineModel, SeriesRequest
        >>> from raytwin.acquisition.setting import setting_from_text
        >>> setting = setting_from_text("kv=60,power_w=30,exposure_ms=20,filter=Cu:0.1")
        >>> line = LineModel(rt.read_twin("virtual_lab"))
        >>> flat = line.expect(SeriesRequest(kind="flat", setting=setting, frames=10, exposure_ms=20.0))
        >>> flat.mean_DN.ndim
        2
    """

    twin: Twin
    effects: Sequence[AppliedEffect] | None = None
    parameters: NDArray[np.float64] | None = None
    use_measured_level: bool = True
    cache: ModelCache = field(default_factory=ModelCache)

    def light(self, request: SeriesRequest) -> Light:
        """The light of a series, up to the charge that one exposure brings.

        Raises:
            InputError: a beam without known level, a scene for a twin without spectral part, an unknown effect or parameter.
        """
        return self._light(request, self._acting(request))

    def from_beyond(self, request: SeriesRequest) -> FloatArray:
        """What pixels would get more (row, column), DN, if a picture did not mirror at its borders, but went on as it ends there.

        A model knows no more than the field; what effects blur into it from outside is a guess. (1, 1), zero, where all pixels are
        alike.

        Raises:
            InputError: as `light`.
        """
        return from_beyond(self.light(request).at_load().state, self.twin.noise.spread.value)

    def expect(self, request: SeriesRequest) -> ExpectedSeries:
        """What the frames of a series are expected to hold, DN.

        Raises:
            InputError: as `light`.
        """
        acting = self._acting(request)
        light = self._light(request, acting)
        state = self._state(request, light, acting)
        output = TubeOutput(state, LineMemory())
        chain = self._chain(request, state, light.charge)
        frames = chain.expect(Quanta(state, light.charge, output, chain.shape))
        averaged = chain.clock.averaged
        of_output = state.output_rms * math.sqrt(output.variance_of_mean(chain.clock.interval_s, averaged))
        return ExpectedSeries(
            mean_DN=frames.mean_DN,
            dark_DN=frames.dark_DN,
            signal_DN=frames.signal_DN,
            trend_DN=frames.trend if frames.trend and request.frames > 1 else None,
            quantum_variance_DN2=np.asarray(frames.quantum_DN2),
            white_variance_DN2=np.asarray(frames.white_DN2),
            noise_autocovariance=light.charge.pattern.autocovariance,
            row_variance_DN2=state.row_variance_DN2 / averaged,
            column_variance_DN2=state.column_variance_DN2 / averaged,
            offsets_together_lines=state.offsets_together_lines,
            flicker=None
            if state.flicker is None or not request.beam_on
            else replace(state.flicker, rms=state.flicker.rms / math.sqrt(averaged)),
            frame_factor_rms=of_output if request.beam_on else 0.0,
            frame_factor_correlation=output.correlation(chain.clock),
            temporal_correlation=frames.temporal_correlation,
            quantisation_step_DN=state.step_DN,
            bad_pixel_share=state.bad_share,
            hot_pixel_share=state.bad_share * state.bad_hot_share,
            telegraph=state.telegraph,
            gain_pattern=state.gain_pattern if request.beam_on else None,
            tile_pattern=state.tile_pattern if request.beam_on else None,
            repeated_share=state.repeated_share,
            saturated_share=frames.saturated_share,
            frames=request.frames,
        )

    def sample(
        self, request: SeriesRequest, *, rng: np.random.Generator, memory: LineMemory | None = None
    ) -> Iterator[NDArray[np.float32]]:
        """Yield the stored frames (row, column) of a series, DN, with noise and as the ADC gives them.

        Args:
            request: the series.
            rng: source of randomness.
            memory: what the line remembers; handed from series to series it carries the charge that was really trapped and
                the output error. None: as expected after `request.previous`, and nothing is handed on.

        Raises:
            InputError: as `light`.
        """
        acting = self._acting(request)
        light = self._light(request, acting).at_load()
        state = self._state(request, light, acting)
        carried = LineMemory(time_s=request.start_s) if memory is None else memory
        chain = self._chain(request, state, light.charge, carried)
        quanta = None
        if request.beam_on:
            quanta = Quanta(of_quanta(state), light.charge, TubeOutput(state, carried), chain.shape)
        stored: NDArray[np.float32] | None = None
        for number in range(request.frames):
            drawn = chain.sample(quanta, number, rng)
            if stored is None or state.repeated_share == 0.0 or rng.random() >= state.repeated_share:
                stored = drawn
            carried.trapped_DN = chain.held_DN
            yield stored.copy()
        carried.time_s = request.start_s + chain.clock.exposures * chain.clock.interval_s

    @property
    def _asked_for(self) -> Hashable:
        """What stands for the line beside the twin: effects and parameters by their values."""
        effects = self.twin.effects if self.effects is None else self.effects
        return (
            tuple((item.id, item.since, *item.parameters.items(), *item.options.items()) for item in effects),
            None if self.parameters is None else self.parameters.tobytes(),
            self.use_measured_level,
        )

    def _acting(self, request: SeriesRequest) -> Acting:
        """Effects that act on a series, in the order of their stages."""
        effects = self.twin.effects if self.effects is None else self.effects
        return [item for item in in_order(effects) if item[0].since == "always" or request.after_calibration]

    def _parameters(self) -> FloatArray | None:
        """Of the spectrum, where the twin has one."""
        if self.twin.spectral is None:
            return None
        best, names = self.twin.spectral.best, self.twin.spectral.names
        values = np.asarray(best if self.parameters is None else self.parameters, dtype=np.float64)
        if values.shape != best.shape:
            raise InputError(
                "spectral parameters",
                received=f"shape {values.shape}",
                expected=f"{best.shape}: one value for each of {', '.join(names)}",
            )
        return values

    def _light(self, request: SeriesRequest, acting: Acting) -> Light:
        return light_of(
            self.twin,
            request,
            [item for item in acting if item[1].stage in BEFORE_EXPOSURE],
            parameters=self._parameters(),
            use_measured_level=self.use_measured_level,
            cache=self.cache,
        )

    def _state(self, request: SeriesRequest, light: Light, acting: Acting) -> LineState:
        """The line after all stages."""
        state = light.state
        for applied, effect, numbers in acting:
            if effect.stage not in BEFORE_EXPOSURE:
                context = context_of(self.twin, request, applied, light.projection, self.cache)
                state = effect.change(state, numbers, context)
        return state

    def _exposed(self, request: SeriesRequest) -> tuple[LineState, Charge]:
        """The line in an earlier series, and what each of its exposures brought."""
        acting = self._acting(request)
        light = self._light(request, acting)
        return self._state(request, light, acting), light.charge

    def _chain(
        self, request: SeriesRequest, state: LineState, charge: Charge, carried: LineMemory | None = None
    ) -> Chain:
        """The stages of a series; carried: what the line remembers where frames are drawn."""
        twin, cache, readout_ms = self.twin, self.cache, self.twin.instrument.readout_ms
        clock = Clock(
            start_s=request.start_s,
            interval_s=request.interval_s(readout_ms),
            frames=request.frames,
            averaged=request.exposures_per_frame,
        )
        dark = cache.pixels(twin.maps, ("dark", request.exposure_ms), lambda: twin.maps.dark_at(request.exposure_ms))
        read = cache.pixels(twin.maps, "read variance", lambda: twin.maps.read_variance_DN2)
        rounding = 1.0 / 12.0 if twin.noise.quantised else 0.0
        panel = Panel(
            shape=twin.maps.shape,
            dark_DN=dark,
            read_DN2=np.maximum(read - (rounding + state.read_variance_taken_DN2), 0.0),
            bits=twin.instrument.bits,
            from_zero=twin.noise.quantised,
            draft=cache.draft,
        )
        traps = rising = None
        if state.lag is not None:
            law = state.lag

            def before() -> Trapped:
                return trapped_before(request, law, self._exposed, readout_ms)

            traps = Traps(law, clock, before, lambda: _found(law, request, before, carried))
        if state.gain_memory is not None:
            filled = filled_before(
                request, state.gain_memory, self._exposed, readout_ms, cache.carried(twin, self._asked_for)
            )
            rising = RisingGain(state.gain_memory, clock, charge.mean, filled)
        return chain_of(state, panel, clock, lit=request.beam_on, traps=traps, rising=rising)


def _found(
    law: LagLaw, request: SeriesRequest, before: Callable[[], Trapped], carried: LineMemory | None
) -> tuple[FloatArray, FloatArray]:
    """Charge in the traps at the begin of a series, and what its first exposure reads of it."""
    if carried is None or carried.trapped_DN is None:
        return before().images()
    return paused(law, carried.trapped_DN, pause_of(law, request, carried.time_s))

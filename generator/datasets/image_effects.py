"""Effects in single images: what they make of a picture, of its noise and of its readout.

A described scene goes through the whole line (`line_state`) with the twin's effects. A reference image was taken on the
line: what was always there is in its picture already, and only what came after calibration changes it. That change is
computed on the quietened picture and added, so that the reference's own noise stays what it is. Noise and readout
are drawn with all effects in either case.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Setting
from ...errors import InputError
from ..effects import AppliedEffect, effect_of, in_order
from ..frames._spread import NoisePattern, noise_pattern, object_transfer, optical_transfer
from ..frames.flat_change import has_always_bent, is_in_noise
from ..frames.light import Charge, charge_of, of_quanta
from ..frames.response import light_of, responded
from ..frames.stages import Chain, Clock, Exposure, LineMemory, Panel, Quanta, TubeOutput, chain_of
from ..kernels.projection import project_polychromatic
from ..line.line_state import FinePicture, FloatArray, LineContext, LineState
from ..line.series_request import SeriesRequest
from ..line.spectral_signal import OpenBeam, SpectralModel
from ..line.twin import Twin
from ..line.twin_spectrum import spectral_model_of
from ..spread._fine_picture import FineCells, pixel_means, sampled_picture
from ..spread.spot import gaussian_transfer

_PICTURE = ("arrivals", "object_blur", "optics")


@dataclass(frozen=True, slots=True, kw_only=True)
class AffectedImage:
    """One channel of a scene on its way through a line with effects, without noise.

    Fields: state after all stages; charge of one exposure above dark, before the response; log_image: -ln of the mean over the open
    field's.
    """

    state: LineState
    charge: Charge = field(repr=False)
    log_image: FloatArray = field(repr=False)


@dataclass(slots=True, kw_only=True)
class ImageEffects:
    """The effects of a line at one setting, for images.

    Fields: twin (without effects); effects; setting; open_signal_DN (row, column) and open_level_DN (its level under even
    illumination) of one exposure; gain_DN of the open beam and secondary_DN, what secondary quanta add to it; dark_DN,
    read_variance_DN2 (row, column); product_material; instrument: distances and pitch where a description states others than
    the twin's. What follows from them: flat_DN (row, column): open field of the line as it is, above dark, with all that a
    correction's flat would hold: gain and pixels that changed are not in it; open_charge_DN (row, column): open field
    before a response that was always bent; gain_factor: on the quantum variance, where light that was always spread
    further leaves less of it in a pixel than the calibrated spread, although the slope was measured with it; pattern:
    correlation of the noise; warnings: effects that are left out, one line each.
    """

    twin: Twin
    effects: tuple[AppliedEffect, ...]
    setting: Setting
    open_signal_DN: FloatArray
    open_level_DN: float
    gain_DN: float
    secondary_DN: float
    dark_DN: NDArray[np.float32]
    read_variance_DN2: NDArray[np.float32]
    product_material: str
    instrument: Instrument | None = None
    flat_DN: FloatArray = field(init=False)
    open_charge_DN: FloatArray = field(init=False)
    gain_factor: float = field(init=False)
    pattern: NoisePattern = field(init=False)
    warnings: tuple[str, ...] = field(init=False)
    _model: SpectralModel | None = field(init=False)
    _weights: FloatArray | None = field(init=False)
    _end: LineState = field(init=False)

    def __post_init__(self) -> None:
        if self.instrument is not None:
            self.twin = replace(self.twin, instrument=self.instrument)
        self._model = self._weights = None
        if self.twin.spectral is not None:
            beam = OpenBeam(kV=self.setting.kV, filters=self.setting.filters)
            self._model = spectral_model_of(self.twin, highest_kV=self.setting.kV)
            self._weights = self._model.moment_weights(self.twin.spectral.best, beam)[:2]
        self.effects, self.warnings = self._usable()
        open_beam = self._through(self._open_state(), self.effects, None)
        self._end = open_beam
        self.pattern = noise_pattern(self.twin.noise.spread.value, open_beam)
        self.open_charge_DN = self._unbent(self.open_signal_DN)
        spread = [item for item in self.effects if is_in_noise(item)]
        base = self.twin.noise.spread.value
        left = noise_pattern(base, self._through(self._open_state(), spread, None)).share
        self.gain_factor = noise_pattern(base, self._open_state()).share / left
        self.read_variance_DN2 = self._without_absorbed(self.read_variance_DN2, spread)
        # light spreads over the borders of what stands in the beam
        self.flat_DN = responded(open_beam, self._charge(open_beam).mean)

    def _usable(self) -> tuple[tuple[AppliedEffect, ...], tuple[str, ...]]:
        usable, told = [], []
        slab = {self.product_material: np.full(self.twin.maps.shape, 10.0)}
        for item in self.effects:
            effect = effect_of(item)
            if effect.images.left_out:
                told.append(f"effect {item.id} is not in the images: {effect.images.left_out}")
            elif self._model is None and "spectral" in effect.needs:
                told.append(f"effect {item.id} is not in the images: the twin has no spectral part")
            else:
                try:
                    self._through(self._open_state(), (item,), slab)
                    usable.append(item)
                except InputError as error:
                    told.append(f"effect {item.id} is not in the images: {error}")
        return tuple(usable), tuple(told)

    def _unbent(self, measured_DN: FloatArray) -> FloatArray:
        """Charge that a response that was always bent shows as `measured_DN`."""
        always = [item for item in self.effects if has_always_bent(item)]
        if not always:
            return measured_DN
        return light_of(self._through(self._open_state(), always, None), measured_DN)

    def _without_absorbed(
        self, read_variance_DN2: NDArray[np.float32], always: Sequence[AppliedEffect]
    ) -> NDArray[np.float32]:
        """Read variance without the rows, columns and lost bits that the darks of the calibration held."""
        state = self._through(self._open_state(), always, None)
        held = state.read_variance_taken_DN2
        rounding = 1.0 / 12.0 if self.twin.noise.quantised else 0.0
        if held <= 0:
            return read_variance_DN2
        return np.asarray(np.maximum(read_variance_DN2 - np.float32(held), np.float32(rounding)))

    def _open_state(self) -> LineState:
        one = np.ones((1, 1))
        level = self.open_level_DN
        return LineState(
            parameters=None if self.twin.spectral is None else self.twin.spectral.best,
            signal_DN=level * one,
            variance_DN2=level * self.gain_DN * one,
            secondary_DN=self.secondary_DN,
            flat_factor=one,
            step_DN=1.0 if self.twin.noise.quantised else 0.0,
        )

    def _through(
        self,
        state: LineState,
        effects: Sequence[AppliedEffect],
        thickness_mm: Mapping[str, NDArray[np.floating]] | None,
    ) -> LineState:
        """The state after the stages of `effects`, with something of known thickness in the beam or nothing."""
        request = SeriesRequest(
            kind="flat" if thickness_mm is None else "object",
            setting=self.setting,
            frames=1,
            exposure_ms=self.setting.exposure_ms,
            thickness_mm=thickness_mm,
            product_material=self.product_material,
            scene_kind=None if thickness_mm is None else "product",
            belt_speed_mm_s=self.setting.belt_speed_mm_s,
            belt_axis=self.twin.instrument.belt_axis or "row",
        )
        for applied, effect, numbers in in_order(effects):
            weights = self._weights
            context = LineContext(
                twin=self.twin,
                request=request,
                model=self._model,
                since=applied.since,
                weights=weights,
                energies_keV=None
                if self._model is None or weights is None
                else self._model.energies_keV[: weights.shape[1]],
                project=self._projector(thickness_mm, state),
                open_signal_DN=self.open_level_DN,
                options=applied.options,
            )
            state = effect.change(state, numbers, context)
        return state

    def _projector(
        self, thickness_mm: Mapping[str, NDArray[np.floating]] | None, state: LineState
    ) -> Callable[[str, FloatArray], FloatArray] | None:
        model = self._model
        if model is None:
            return None

        def project(name: str, weights: FloatArray) -> FloatArray:
            if thickness_mm is None:
                return np.asarray(weights.sum(axis=1)[:, None, None])
            top = weights.shape[1]
            mu = [model.mu(one)[:top] * state.attenuation_scale.get(one, 1.0) for one in thickness_mm]
            stack = np.stack([np.asarray(one, dtype=np.float32) for one in thickness_mm.values()])
            return project_polychromatic(stack, np.stack(mu), weights).astype(np.float64)

        return project

    # ------------------------------------------------------------------------------------------ described scenes

    def attenuation_scale(self, materials: Sequence[str]) -> Mapping[str, float]:
        """Factors on the attenuation of a scene's materials, by name."""
        shape = self.twin.maps.shape
        at_the_beam = [item for item in self.effects if effect_of(item).stage == "beam"]
        thin = {name: np.ones(shape, dtype=np.float32) for name in materials}
        return self._through(self._open_state(), at_the_beam, thin).attenuation_scale

    def image(
        self,
        signal: NDArray[np.floating],
        variance: NDArray[np.floating],
        thickness_mm: Mapping[str, NDArray[np.floating]],
        *,
        focal_blur_px: float,
    ) -> AffectedImage:
        """A scene through the line.

        Args:
            signal, variance: (3 row, 3 column) behind the scene, over those of the open beam, on three rays a pixel and axis.
            thickness_mm: material -> (row, column) path length through the middle of each pixel.
            focal_blur_px: sd of the image of the instrument's focal spot; an effect adds to it.
        """
        level = self.open_level_DN
        cells = np.asarray(signal, dtype=np.float64)
        means = level * pixel_means(cells)
        state = replace(
            self._open_state(),
            signal_DN=means,
            variance_DN2=level * self.gain_DN * pixel_means(np.asarray(variance, dtype=np.float64)),
            attenuation_scale=self.attenuation_scale(tuple(thickness_mm)),
        )
        if self.twin.noise.spread.value.model == "aperture":
            state = replace(state, picture=FinePicture(fine=FineCells(cells), scale=level, signal_DN=means))
        later = [item for item in self.effects if effect_of(item).stage != "beam"]
        state = replace(self._through(state, later, thickness_mm), shift_px=(0.0, 0.0))  # masks stay with the picture
        if focal_blur_px > 0:
            state = replace(state, object_transfers=(*state.object_transfers, gaussian_transfer(focal_blur_px)))
        charge = self._charge(state)
        ratio = np.maximum(responded(state, charge.mean), 1e-30) / np.maximum(self.flat_DN, 1e-30)
        return AffectedImage(state=state, charge=charge, log_image=-np.log(ratio))

    def _charge(self, state: LineState) -> Charge:
        return charge_of(
            of_quanta(state, self.gain_factor),
            shape=self.open_charge_DN / self.open_level_DN,
            relative=np.maximum(self.twin.maps.gain_relative, 0.0),
            pattern=self.pattern,
            spread=self.twin.noise.spread.value,
        )

    def sample(self, image: AffectedImage, rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (row, column) of one frame, or of the mean of the setting's averaged frames, DN."""
        chain = self._chain(self.setting.averaged)
        state = of_quanta(image.state, self.gain_factor)
        quanta = Quanta(state, image.charge, TubeOutput(state, LineMemory()), chain.shape)
        return chain.sample(quanta, 0, rng)

    # ------------------------------------------------------------------------------------------ reference images

    def straightened(self, transmission: NDArray[np.floating], *, open_signal_DN: FloatArray) -> FloatArray:
        """A reference's transmission with the bend of the response that was always there taken out.

        Args:
            transmission: I / I0 of the reference.
            open_signal_DN: (row, column) of one of its frames, as measured.
        """
        values = np.asarray(transmission, dtype=np.float64)
        return np.asarray(self._unbent(values * open_signal_DN) / self._unbent(open_signal_DN))

    def changes_picture(self) -> bool:
        """Whether reference images, taken when the twin was calibrated, would look otherwise now."""
        return bool(self._late())

    def _late(self) -> list[AppliedEffect]:
        return [item for item in self.effects if item.since == "calibration" and effect_of(item).stage in _PICTURE]

    def picture_change(self, quiet: NDArray[np.floating], thickness_mm: NDArray[np.floating]) -> FloatArray:
        """What to add to a reference's transmission (row, column) for what came after calibration; no unit.

        Args:
            quiet: the reference's transmission with its noise smoothed away.
            thickness_mm: (row, column) of product that transmits as much.
        """
        late = self._late()
        before = self.open_level_DN * np.asarray(quiet, dtype=np.float64)
        state = replace(self._open_state(), signal_DN=before, variance_DN2=self.gain_DN * before)
        state = self._through(state, late, {self.product_material: thickness_mm})
        from scipy.fft import dctn

        shape = before.shape[0], before.shape[1]
        f_row, f_column = np.arange(shape[0])[:, None] / (2.0 * shape[0]), np.arange(shape[1])[None] / (2.0 * shape[1])
        ratio = object_transfer(state, f_row, f_column)
        if state.tails or state.optical_transfers:
            base = self.twin.noise.spread.value
            calibrated = base.transfer(f_row, f_column)
            # where the calibrated spread leaves nothing there is nothing to put elsewhere
            of_light = optical_transfer(state, base, f_row, f_column) / np.maximum(calibrated, 1e-3)
            ratio = of_light if ratio is None else ratio * of_light
        after = state.signal_DN
        if ratio is not None:
            after = sampled_picture([(dctn(after, type=2), ratio)], shape, (0.0, 0.0), state.course_px)
        return np.asarray((after - before) / self.open_level_DN)

    def read_out(self, charge_DN: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (row, column) of charge that has all its noise but that of rows, columns and output, DN."""
        averaged = self.setting.averaged
        chain = self._chain(1, mean_of=averaged, noisy=False)
        output = TubeOutput(self._end, LineMemory()).sample_mean(chain.clock.interval_s, averaged, rng)
        charge = output * np.asarray(charge_DN, dtype=np.float64)
        return chain.read(charge, Exposure(0, 0.0, rng)).astype(np.float32)

    # ------------------------------------------------------------------------------------------ readout

    def _chain(self, averaged: int, *, mean_of: int = 1, noisy: bool = True) -> Chain:
        """Stages of the readout; mean_of, noisy: as in `chain_of`."""
        twin = self.twin
        rounding = 1.0 / 12.0 if twin.noise.quantised else 0.0
        panel = Panel(
            shape=twin.maps.shape,
            dark_DN=np.asarray(self.dark_DN, dtype=np.float64),
            read_DN2=np.maximum(np.asarray(self.read_variance_DN2, dtype=np.float64) - rounding, 0.0),
            bits=twin.instrument.bits,
            from_zero=twin.noise.quantised,
        )
        interval_s = (self.setting.exposure_ms + (twin.instrument.readout_ms or 0.0)) / 1000.0
        clock = Clock(start_s=0.0, interval_s=interval_s, frames=1, averaged=averaged)
        return chain_of(self._end, panel, clock, mean_of=mean_of, noisy=noisy)

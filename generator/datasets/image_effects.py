"""Effects in single images: what they make of a picture, of its noise and of its readout.

A described scene goes through the whole line (`line_state`) with the twin's effects. A reference image was taken on the
line: what was always there is in its picture already, and only what came after calibration changes it. That change is
computed on the quietened picture and added, so that the reference's own noise stays what it is. Noise and readout
are drawn with all effects in either case.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Setting
from ...errors import InputError
from ..effects import AppliedEffect, effect_of, in_order
from ..frames._spread import NoisePattern, blurred_object, noise_pattern, optical_transfer, spread_maps
from ..frames.defects import Jumping, gain_pattern, new_bad_pixels, sample_flicker, sample_offsets, tile_gain
from ..frames.flat_change import has_always_bent, is_in_noise
from ..frames.response import counting_noise, light_of, responded
from ..kernels.projection import project_polychromatic
from ..line.line_state import FinePicture, FloatArray, LineContext, LineState, Transfer
from ..line.series_request import SeriesRequest
from ..line.spectral_signal import OpenBeam, SpectralModel
from ..line.twin import Twin
from ..line.twin_spectrum import spectral_model_of
from ..spread._fine_picture import FineCells, pixel_means

_PICTURE = ("arrivals", "object_blur", "optics")
_HOT_SIGMAS = 20.0  # of the read noise, as in series of frames


@dataclass(frozen=True, slots=True, kw_only=True)
class AffectedImage:
    """One channel of a scene on its way through a line with effects, without noise.

    Fields: state after all stages; charge_DN (row, column): mean of one exposure above dark, before the response; scale,
    white_DN: factors of the quantum noise and sd of what is white in it; before_DN, quantum_DN: mean before the spread
    under even illumination, and the worth of a quantum; pattern: correlation of the noise; log_image: -ln of the mean over
    the open field's.
    """

    state: LineState
    charge_DN: FloatArray = field(repr=False)
    scale: FloatArray = field(repr=False)
    white_DN: FloatArray = field(repr=False)
    before_DN: FloatArray = field(repr=False)
    quantum_DN: FloatArray = field(repr=False)
    pattern: NoisePattern = field(repr=False)
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
        blurred, _ = spread_maps(
            open_beam.signal_DN, open_beam.variance_DN2, state=open_beam, pattern=self.pattern, spread=base
        )
        lit = self.open_charge_DN * (blurred / self.open_level_DN) * open_beam.flat_factor
        self.flat_DN = responded(open_beam, lit)

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
            focal_blur_px: sd of the focal spot's image, unless an effect says how large the spot is.
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
        state = self._through(state, later, thickness_mm)
        if focal_blur_px > 0 and not any(effect_of(item).images.spot for item in self.effects):
            state = replace(state, object_transfers=(*state.object_transfers, _gaussian(focal_blur_px)))
        return self._image_of(state)

    def _image_of(self, state: LineState) -> AffectedImage:
        noise = self.twin.noise
        # secondary quanta follow the signal, whatever the spectrum
        white = np.minimum(self.secondary_DN * np.maximum(state.signal_DN, 0.0), 0.9 * state.variance_DN2)
        state = replace(state, variance_DN2=self.gain_factor * (state.variance_DN2 - white))
        picture, _ = spread_maps(
            state.signal_DN,
            state.variance_DN2,
            state=state,
            pattern=self.pattern,
            spread=noise.spread.value,
        )
        lit = self.open_charge_DN / self.open_level_DN * state.flat_factor
        charge = lit * picture
        scale = lit * self.twin.maps.gain_relative * counting_noise(state, charge)
        before, variance = blurred_object(state)
        # a quantum's worth, so that their number is Poisson; floors where an opaque object lets nothing through
        before = np.maximum(before, 1e-300)
        quantum = variance / before
        mean = responded(state, charge)
        return AffectedImage(
            state=state,
            charge_DN=charge,
            scale=np.sqrt(np.maximum(scale, 0.0)),
            white_DN=np.sqrt(np.maximum(scale * self.secondary_DN * picture, 0.0)),
            before_DN=before,
            quantum_DN=np.maximum(quantum, 1e-9 * float(np.max(quantum)) + 1e-300),
            pattern=self.pattern,
            log_image=-np.log(np.maximum(mean, 1e-30) / np.maximum(self.flat_DN, 1e-30)),
        )

    def sample(self, image: AffectedImage, rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (row, column) of one frame, or of the mean of the setting's averaged frames, DN."""
        shape = self.twin.maps.shape
        rounding = 1.0 / 12.0 if self.twin.noise.quantised else 0.0
        electronic = np.sqrt(np.maximum(np.asarray(self.read_variance_DN2, dtype=np.float64) - rounding, 0.0))
        total = np.zeros(shape)
        for _ in range(self.setting.averaged):
            noise = image.scale * image.pattern.sample(image.before_DN, image.quantum_DN, shape, rng)
            noise += image.white_DN * rng.standard_normal(shape)
            factor = self._output_factor(1, rng)
            charge = factor * image.charge_DN + math.sqrt(factor) * noise
            total += self._counts(charge, electronic * rng.standard_normal(shape), averaged=1, rng=rng)
        return (total / self.setting.averaged).astype(np.float32)

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
        from scipy.fft import dctn, idctn

        shape = before.shape
        f_row, f_column = np.arange(shape[0])[:, None] / (2.0 * shape[0]), np.arange(shape[1])[None] / (2.0 * shape[1])
        ratio: FloatArray | None = None
        if state.tails or state.optical_transfers:
            base = self.twin.noise.spread.value
            calibrated = base.transfer(f_row, f_column)
            # where the calibrated spread leaves nothing there is nothing to put elsewhere
            ratio = optical_transfer(state, base, f_row, f_column) / np.maximum(calibrated, 1e-3)
        for transfer in state.object_transfers:
            part = transfer(f_row, f_column)
            ratio = part if ratio is None else ratio * part
        after = state.signal_DN
        if ratio is not None:
            after = np.asarray(idctn(dctn(after, type=2) * ratio, type=2))
        return np.asarray((after - before) / self.open_level_DN)

    def read_out(self, charge_DN: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (row, column) of charge that has all its noise but that of rows, columns and output, DN."""
        averaged = self.setting.averaged
        charge = self._output_factor(averaged, rng) * np.asarray(charge_DN, dtype=np.float64)
        return self._counts(charge, 0.0, averaged=averaged, rng=rng).astype(np.float32)

    # ------------------------------------------------------------------------------------------ response and readout

    def _output_factor(self, averaged: int, rng: np.random.Generator) -> float:
        state = self._end
        if state.output_rms <= 0:
            return 1.0
        interval_s = (self.setting.exposure_ms + (self.twin.instrument.readout_ms or 0.0)) / 1000.0
        lag = np.arange(1, averaged)
        rho = np.exp(-lag * interval_s / max(state.output_correlation_s, 1e-12))
        wandering = 1.0 - state.output_jitter_share
        share = float((1.0 + 2.0 * wandering * np.sum((1.0 - lag / averaged) * rho)) / averaged)
        return max(1.0 + math.sqrt(share) * state.output_rms * float(rng.standard_normal()), 0.0)

    def _counts(
        self, charge: FloatArray, electronic: FloatArray | float, *, averaged: int, rng: np.random.Generator
    ) -> FloatArray:
        state, shape = self._end, self.twin.maps.shape
        value = charge
        if state.flicker is not None:
            flicker = replace(state.flicker, rms=state.flicker.rms / math.sqrt(averaged))
            value = value * sample_flicker(flicker, shape, rng)
        if state.gain_pattern is not None:
            value = value * gain_pattern(state.gain_pattern, shape)
        if state.tile_pattern is not None:
            value = value * tile_gain(state.tile_pattern, shape)
        value = responded(state, value)
        bad = new_bad_pixels(state, shape)
        if bad is not None:
            value = np.where(bad.dead, 0.0, value)
        value = value + self.dark_DN + electronic
        value = value + sample_offsets(state, shape, rng) / math.sqrt(averaged)
        read_DN = np.sqrt(np.asarray(self.read_variance_DN2, dtype=np.float64))
        if state.telegraph is not None:
            jumping = Jumping(state.telegraph, shape, rng)
            for _ in range(averaged):
                value = jumping.added_to(value, read_DN / averaged, rng)
        if bad is not None:
            value = np.where(bad.hot, value + _HOT_SIGMAS * (read_DN + 1.0), value)
        if state.step_DN > 0:
            step = state.step_DN / averaged
            value = np.rint(value / step) * step
        bits = self.twin.instrument.bits
        highest = math.inf if bits is None else 2.0**bits - 1.0
        return np.asarray(np.clip(value, 0.0 if self.twin.noise.quantised else -math.inf, highest))


def _gaussian(sigma_px: float) -> Transfer:
    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        rows, columns = (np.exp(-2.0 * (math.pi * sigma_px * f) ** 2) for f in (f_row, f_column))
        return np.asarray(rows * columns)

    return transfer

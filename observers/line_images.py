"""What a line's log images hold of objects at many settings: their signals, and the noise they stand in.

At a setting with open signal S0 (DN), gain g of the beam and g_s of its secondary quanta (DN), read variance v and N frames averaged,
behind a product with log image M:

    M      = -ln(sum of spectrum through the product / sum of open spectrum)             S = S0 exp(-M)
    power  = [ (g - g_s) / S  P(f)  +  g_s / S + v / S^2 ] / N                            of one log image
    signal = M(product and object) - M(product), times the optical transfer and that of the belt's motion, sinc(l f)

P(f) is the power that the optical spread leaves of the quanta. The images of a pair are combined with weights (a, b):

| image | a | b |
|---|---|---|
| residual | 1 | -dM_low / dM_high of the product: its thickness drops out |
| quotient | 1 | -M_low / M_high: the quotient that Delta R is read from, to first order |
| low, high | 1, 0 | 0, 1: one image, in which the product's texture is noise |
| both | the best at each frequency | of images whose texture is one and the same |
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from ..generator.frames.present_line import present_line
from ..generator.line.belt_path import belt_path_px
from ..generator.line.binning import refuse_binning
from ..generator.line.line_limits import broken_limits
from ..generator.line.spectral_signal import OpenBeam, SpectralModel
from ..generator.line.twin import Twin
from ..generator.line.twin_spectrum import slope_share, spectral_model_of, white_gain_DN
from ..generator.predictions.contrast import FEW_PHOTONS
from ..generator.predictions.predict import saturation_text
from ..generator.predictions.predict_many import Levels, predict_levels
from ..generator.spread.psf import whole_spectrum
from ..materials import material_from_name, mu_per_mm
from .frequencies import FrequencyBins
from .objects import ForeignObjects, ReferenceObjects, spectra_of_masks

FloatArray = NDArray[np.float64]
Pair = tuple[Setting, Setting]

IMAGES = ("residual", "quotient", "low", "high", "both")
TEXTURED = ("low", "high", "both")  # in these the product's texture is noise
_STEP = 0.01  # relative, of the product's thickness, to see how one log image follows the other
_THICKEST_MM = 2000.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Beam:
    """A kV and filter behind the objects' places, whatever the load (object,): M of the product, M with the object, change of M
    with the product's thickness (/mm), gain over that of the open beam."""

    product: FloatArray
    with_object: FloatArray
    slope: FloatArray
    gain_ratio: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairImages:
    """Images to look at, one combined image or both log images, at many settings.

    Fields: signal (image, 2, setting, object): what the object's change of each log image adds to an image; product_slope, alike:
    what a change of the product's thickness adds, /mm; quantum, white (image, setting, object): powers in an image, before the
    spread and white; delta_R (setting, object): difference of the quotient.
    """

    signal: FloatArray
    product_slope: FloatArray
    quantum: FloatArray
    white: FloatArray
    delta_R: FloatArray


class LineImages:
    """A twin as an observer sees it; beams and what they cross are kept.

    Args:
        twin: a calibrated line with a spectral part; effects on beam and noise are in it, others are named in `warnings`.

    Raises:
        InputError: a twin without a spectral part.
    """

    def __init__(self, twin: Twin) -> None:
        line = present_line(twin)
        self.twin = line.twin
        self.warnings: tuple[str, ...] = tuple(line.warnings)
        if line.effects:
            self.warnings += ("left out of the observer: effects " + ", ".join(one.id for one in line.effects),)
        self._model: SpectralModel = spectral_model_of(self.twin)
        self._last_weights: dict[tuple[float, tuple[Filter, ...]], tuple[SpectralModel, FloatArray]] = {}

    @property
    def pixel_mm(self) -> float:
        """Pitch of the detector; 0.15 mm where it is unknown."""
        return self.twin.instrument.pixel_mm or 0.15

    @property
    def object_pixel_mm(self) -> float:
        """Pitch in the object's plane."""
        return self.pixel_mm / (self.twin.instrument.magnification or 1.0)

    def _mu(self, material: str, model: SpectralModel) -> FloatArray:
        return mu_per_mm(material_from_name(material), model.energies_keV)

    def _weights(self, setting: Setting) -> tuple[SpectralModel, FloatArray]:
        key = (setting.kV, setting.filters)
        if key not in self._last_weights:
            posterior = self.twin.spectral
            model = spectral_model_of(self.twin, highest_kV=setting.kV)
            best = model.default_parameters() if posterior is None else posterior.best
            weights = model.moment_weights(best, OpenBeam(kV=setting.kV, filters=setting.filters))[:2]
            # the same beam is asked for behind several stacks, one after the other
            self._last_weights = {key: (model, weights)}
        return self._last_weights[key]

    def _behind(self, setting: Setting, layers: Sequence[tuple[str, FloatArray]]) -> tuple[FloatArray, FloatArray]:
        """M and gain over that of the open beam (place,) behind materials of these thicknesses (place,), mm."""
        model, weights = self._weights(setting)
        top = weights.shape[1]
        depth = sum(np.multiply.outer(thickness, self._mu(material, model)[:top]) for material, thickness in layers)
        passed = np.exp(-np.asarray(depth)) @ weights.T
        opened = weights.sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_image = -np.log(passed[:, 0] / opened[0])
            ratio = passed[:, 1] / passed[:, 0] / (opened[1] / opened[0])
        if not np.all(np.isfinite(log_image) & np.isfinite(ratio)):
            raise InputError(
                "product and foreign object",
                received=f"nothing gets through at {setting.kV:g} kV",
                expected="thicknesses that let some photons through",
            )
        return log_image, ratio

    def quotient_of(
        self, pair: Pair, materials: tuple[str, str], *, product_mm: FloatArray, object_mm: FloatArray, displaces: bool
    ) -> FloatArray:
        """Delta R (object,): quotient M_low / M_high with the object less that of the product alone."""
        around = product_mm - object_mm if displaces else product_mm
        found = []
        for setting in pair:
            bare, _ = self._behind(setting, [(materials[0], product_mm)])
            both, _ = self._behind(setting, [(materials[0], around), (materials[1], object_mm)])
            found.append((bare, both))
        (bare_low, both_low), (bare_high, both_high) = found
        return np.asarray(both_low / both_high - bare_low / bare_high)

    def objects_from_references(
        self,
        references: ReferenceObjects,
        *,
        pair: Pair,
        product_material: str,
        foreign_material: str,
        size: str = "contrast",
    ) -> ForeignObjects:
        """Objects of reference images with the thicknesses that their contrasts stand for.

        The object takes the product's place. The product's thickness follows from M_high around the object; the object's is
        that whose Delta R, at the references' setting, is the contrast, taken as the same over the mask.

        Args:
            references: of `objects_of_references`.
            pair: setting of the references.
            product_material, foreign_material: what they are of.
            size: `contrast` or `size_mm`.

        Raises:
            InputError: contrasts that the materials cannot make, sizes that are not known.
        """
        sizes = getattr(references, size)
        if not np.all(np.isfinite(sizes)):
            raise InputError("size", received=f"objects whose {size} is unknown", expected="a known size of each")
        grid = np.geomspace(0.05, _THICKEST_MM, 241)
        log_image, _ = self._behind(pair[1], [(product_material, grid[grid < 1000])])
        product_mm = np.interp(references.ring_log, log_image, grid[grid < 1000])
        share = np.concatenate([[0.0], np.geomspace(1e-4, 0.95, 60)])
        thickness = product_mm[:, None] * share
        flat = (np.repeat(product_mm, share.size), thickness.ravel())
        contrasts = self.quotient_of(
            pair, (product_material, foreign_material), product_mm=flat[0], object_mm=flat[1], displaces=True
        ).reshape(thickness.shape)
        contrasts *= math.copysign(1.0, float(np.median(contrasts[:, -1])))
        too_large = references.contrast > np.max(contrasts, axis=1)
        if too_large.any():
            raise InputError(
                "contrasts of the references",
                received=f"up to {references.contrast[too_large].max():.3g} of {too_large.sum()} of {too_large.size} objects",
                expected=f"what {foreign_material} can make in {product_material}",
                remedy="state other materials, or leave out objects where the product's thickness changes, as at its edge",
            )
        object_mm = np.array(
            [
                np.interp(wanted, np.maximum.accumulate(row), depth)
                for wanted, row, depth in zip(references.contrast, contrasts, thickness, strict=True)
            ]
        )
        energy, amplitude, bins = spectra_of_masks(references.masks)
        return ForeignObjects(
            names=references.names,
            size=np.asarray(sizes, dtype=float),
            size_name=size,
            product_mm=product_mm,
            object_mm=object_mm,
            energy=energy,
            amplitude=amplitude,
            bins=bins,
            area_px=references.area_px,
            product_material=product_material,
            foreign_material=foreign_material,
            displaces=True,
            sampled=True,
        )

    def _beam(self, setting: Setting, objects: ForeignObjects) -> _Beam:
        around = objects.product_mm - objects.object_mm if objects.displaces else objects.product_mm
        product, ratio = self._behind(setting, [(objects.product_material, objects.product_mm)])
        thicker, _ = self._behind(setting, [(objects.product_material, objects.product_mm * (1 + _STEP))])
        both, _ = self._behind(
            setting, [(objects.product_material, around), (objects.foreign_material, objects.object_mm)]
        )
        return _Beam(
            product=product,
            with_object=both,
            slope=(thicker - product) / (_STEP * objects.product_mm),
            gain_ratio=ratio,
        )

    def _levels(self, settings: Sequence[Setting]) -> Levels:
        distance = {one.source_detector_mm for one in settings}
        if len(distance) > 1:
            raise InputError(
                "settings", received=f"{len(distance)} source-detector distances", expected="one for all of them"
            )
        return predict_levels(
            self.twin,
            kV=[one.kV for one in settings],
            filters=[one.filters for one in settings],
            load_mAs=[one.stated_load_mAs() for one in settings],
            averaged=[one.averaged for one in settings],
            source_detector_mm=distance.pop(),
        )

    def reasons_against(
        self, pairs: Sequence[Pair], objects: ForeignObjects, *, image: str = "both"
    ) -> tuple[str, ...]:
        """Why nothing can be said of an image at each pair (pair,), or of those that it is made of; empty: it can.

        A limit of tube, readout or belt is broken; the open field, which every image is divided by, saturates; or a pixel
        behind the product (the median of the objects') holds so little signal that its logarithm is no straight one.
        """
        reasons = [""] * len(pairs)
        for side in {"low": (0,), "high": (1,)}.get(image, (0, 1)):
            settings = [pair[side] for pair in pairs]
            levels = self._levels(settings)
            for number, one in enumerate(settings):
                mean_DN, gain_DN = float(levels.mean_DN[number]), float(levels.gain_DN[number])
                broken = broken_limits(self.twin.instrument, one)
                saturated = saturation_text(self.twin, one, mean_DN)
                if broken:
                    found = str(broken[0])
                elif saturated:
                    found = f"open field at {one}: {saturated}"
                elif self._noise_behind(one, mean_DN, gain_DN, objects) > FEW_PHOTONS:
                    found = (
                        f"a pixel behind the product at {one} is noisier than {100 * FEW_PHOTONS:.0f} %: its logarithm is biased,"
                        " and no a90 follows from noise that is added to it"
                    )
                else:
                    continue
                reasons[number] = reasons[number] or found
        return tuple(reasons)

    def _noise_behind(self, setting: Setting, mean_DN: float, gain_DN: float, objects: ForeignObjects) -> float:
        """Relative standard deviation of a pixel's signal behind the product; infinite where the open field has none."""
        thickness = np.array([float(np.median(objects.product_mm))])
        log_image, ratio = self._behind(setting, [(objects.product_material, thickness)])
        signal_DN = mean_DN * math.exp(-float(log_image[0]))
        if not signal_DN > 0:
            return math.inf
        variance_DN2 = (
            gain_DN * float(ratio[0]) * slope_share(self.twin) * signal_DN + self.twin.noise.read_variance_DN2
        )
        return math.sqrt(variance_DN2 / setting.averaged) / signal_DN

    def pair_images(self, pairs: Sequence[Pair], objects: ForeignObjects, *, image: str = "residual") -> PairImages:
        """Signals and noise of the images to look at, at every pair of settings; see the module.

        Raises:
            InputError: an unknown image, binned settings, settings without load, objects that nothing gets through.
        """
        if image not in IMAGES:
            raise InputError("image", received=image, expected="one of " + ", ".join(IMAGES))
        refuse_binning(*(one for pair in pairs for one in pair))
        sides = []
        beams: dict[tuple[float, tuple[Filter, ...]], _Beam] = {}
        for side in (0, 1):
            settings = [pair[side] for pair in pairs]
            levels = self._levels(settings)
            for one in settings:
                key = (one.kV, one.filters)
                if key not in beams:
                    beams[key] = self._beam(one, objects)
            chosen = [beams[(one.kV, one.filters)] for one in settings]
            product, both, slope, ratio = (
                np.stack([getattr(beam, name) for beam in chosen])
                for name in ("product", "with_object", "slope", "gain_ratio")
            )
            frames = np.array([one.averaged for one in settings], dtype=float)[:, None]
            signal_DN = levels.mean_DN[:, None] * np.exp(-product)
            gain_DN = levels.gain_DN[:, None] * ratio
            secondary = np.minimum(
                np.array([white_gain_DN(self.twin, gain) for gain in levels.gain_DN])[:, None], 0.9 * gain_DN
            )
            rounding = 1.0 / 12.0 if self.twin.noise.quantised else 0.0
            read = max(self.twin.noise.read_variance_DN2, rounding)
            sides.append(
                (
                    product,
                    both,
                    slope,
                    (gain_DN - secondary) / signal_DN / frames,
                    (secondary / signal_DN + read / signal_DN**2) / frames,
                )
            )
        product, with_object, slope, quantum, white = (np.stack(one) for one in zip(*sides, strict=True))
        whole, none = np.ones_like(product[0]), np.zeros_like(product[0])
        weights = {
            "residual": [(whole, -slope[0] / slope[1])],
            "quotient": [(whole, -product[0] / product[1])],
            "low": [(whole, none)],
            "high": [(none, whole)],
            "both": [(whole, none), (none, whole)],
        }
        mixed = np.array(weights[image])  # (image, 2, setting, object)
        return PairImages(
            signal=mixed * (with_object - product),
            quantum=(mixed**2 * quantum).sum(axis=1),
            white=(mixed**2 * white).sum(axis=1),
            product_slope=mixed * slope,
            delta_R=with_object[0] / with_object[1] - product[0] / product[1],
        )

    def product_at(
        self, log_image: FloatArray, setting: Setting, material: str
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Thickness (mm), slope (/mm), quantum and white power (place,) where the product's log image at a setting is `log_image`."""
        grid = np.geomspace(0.05, 1000.0, 241)
        logs, ratios = self._behind(setting, [(material, grid)])
        thickness = np.interp(log_image, logs, grid)
        slope = np.interp(thickness, grid, np.gradient(logs, grid))
        levels = self._levels([setting])
        gain_DN = levels.gain_DN[0] * np.interp(thickness, grid, ratios)
        secondary = np.minimum(white_gain_DN(self.twin, float(levels.gain_DN[0])), 0.9 * gain_DN)
        signal_DN = levels.mean_DN[0] * np.exp(-log_image)
        quantum = (gain_DN - secondary) / signal_DN / setting.averaged
        white = (secondary / signal_DN + self.twin.noise.read_variance_DN2 / signal_DN**2) / setting.averaged
        return thickness, slope, quantum, white

    def noise_power_of_patch(self, cells: int) -> FloatArray:
        """Power of unit white quanta after the spread at all frequencies of a patch (cells, cells), in the order of `fft2`."""
        return whole_spectrum(self.twin.noise.spread.value.noise_power(cells))

    def noise_power(self, bins: FrequencyBins) -> FloatArray:
        """Power of unit white quanta after the spread, mean in each bin (bin,)."""
        return bins.mean_quadrant(self.twin.noise.spread.value.noise_power(bins.cells))

    def optical_transfer(self, bins: FrequencyBins) -> FloatArray:
        """Square root of the mean squared transfer of the spread in each bin (bin,)."""
        frequency = np.arange(bins.cells // 2 + 1) / bins.cells
        transfer = self.twin.noise.spread.value.transfer(frequency[:, None], frequency[None, :])
        return np.sqrt(bins.mean_quadrant(transfer**2))

    def motion_transfers(self, pairs: Sequence[Pair], bins: FrequencyBins) -> FloatArray:
        """Transfer of the belt's motion in one exposure (2, setting, bin), mean in each bin."""
        frequency = np.arange(bins.cells // 2 + 1) / bins.cells
        paths = np.array([[self.motion_px(pair[side]) for pair in pairs] for side in (0, 1)])
        along = bins.mean_axis(np.sinc(paths[..., None] * frequency))
        on_columns = self.twin.instrument.belt_axis == "column"
        return bins.on_columns(along) if on_columns else bins.on_rows(along)

    def motion_px(self, setting: Setting) -> float:
        """Path (px) of the object's image in one exposure."""
        if setting.belt_speed_mm_s is None:
            return 0.0
        return belt_path_px(
            self.twin.instrument,
            speed_mm_s=setting.belt_speed_mm_s,
            exposure_ms=setting.exposure_ms,
            magnification=self.twin.instrument.magnification or 1.0,
            pixel_mm=self.pixel_mm,
        )

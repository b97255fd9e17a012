"""Dual-energy images at a setting from reference images: the noise each reference lacks is drawn anew.

At the kV and filter of the references that is a top-up (generator.references.topup); at any other, a transfer through two materials
(generator.references.transfer).
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.dataset_io import Dataset, DatasetRow, write_dataset
from ...acquisition.instrument import Instrument
from ...acquisition.pairs import flat_corrected_log, replace_bad_pixels
from ...acquisition.setting import Setting, setting_from_text
from ...errors import InputError
from ...files import sha256_of_file
from ..effects import AppliedEffect, effect_of
from ..frames.present_line import present_line
from ..kernels.projection import project_polychromatic
from ..line.binning import refuse_binning
from ..line.spectral_signal import OpenBeam, gain_behind_object
from ..line.twin import BAD_PIXEL_MAP, Level, Twin
from ..line.twin_spectrum import secondary_gain_DN, slope_share, spectral_model_of
from ..predictions.predict import predict_flatfield
from ..references.as_published import published_parameters, sample_as_published
from ..references.topup import apply_top_up, plan_top_up, same_layers, topped_up_charge
from ..references.transfer import (
    Channel,
    DetectorNoise,
    TransferredPair,
    check_geometry,
    check_transfer,
    quiet_image,
    sample_transferred,
    transfer_pair,
    transferred_charge,
)
from ..references.two_material import TwoMaterialTables, tabulate_two_materials
from ..spread.registration import estimate_shift_px, shift_image
from .image_effects import ImageEffects
from .reference_materials import USUAL_MATERIALS, stated_materials

RECIPES = ("raytwin", "as_published")
DEFAULT_PRODUCT, DEFAULT_FOREIGN = USUAL_MATERIALS
BAD_PIXELS = ("repaired", "measured")
_GAIN_THICKNESSES_MM = np.array([0.0, 1, 2, 4, 7, 11, 16, 22, 30, 40, 55, 75, 100, 140])


def refuse_pair(low: Setting, high: Setting, *, bad_pixels: str) -> None:
    """Raise where images of two settings cannot be asked for so.

    Raises:
        InputError: an unknown treatment of bad pixels, or settings that are not low kV and high kV.
    """
    if bad_pixels not in BAD_PIXELS:
        raise InputError(BAD_PIXEL_MAP, received=bad_pixels, expected="one of " + ", ".join(BAD_PIXELS))
    if high.kV <= low.kV:
        raise InputError(
            "settings",
            received=f"low {low.kV:g} kV, high {high.kV:g} kV",
            expected="low kV below high kV",
            remedy="exchange low and high, or give another kV",
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationSummary:
    """What was generated."""

    images: int
    references: int
    with_foreign_object: int
    seed: int
    recipe: str
    setting: str
    dataset_sha256: str
    reference_sha256: str
    clipped_percent: float
    warnings: tuple[str, ...]
    transferred: bool = False

    def as_dict(self) -> dict[str, Any]:
        """The answer of `raytwin generate --json`."""
        return {
            "images": self.images,
            "references": self.references,
            "with_foreign_object": self.with_foreign_object,
            "seed": self.seed,
            "recipe": self.recipe,
            "setting": self.setting,
            "hashes": {"dataset_sha256": self.dataset_sha256, "reference_sha256": self.reference_sha256},
            "clipped_percent": self.clipped_percent,
            "transferred": self.transferred,
            "warnings": list(self.warnings),
        }


@dataclass(slots=True)
class ChannelModel:
    """One tube voltage of a pair at the target: open signal, dark, and gain as a function of the transmission.

    `twin` is without effects (`present_line` takes them off), `effects` are those that images go through. `bad_pixels` is
    `repaired`, where they are as their neighbours, or `measured`, where they are as the twin knows them. `instrument`
    states distances and pitch where they differ from the twin's.
    """

    twin: Twin
    target: Setting
    product_material: str
    bad_pixels: str = "repaired"
    effects: tuple[AppliedEffect, ...] = ()
    instrument: Instrument | None = None
    image_effects: ImageEffects | None = field(init=False)
    level: Level | None = field(init=False)
    open_signal_DN: NDArray[np.float64] = field(init=False)
    dark_DN: NDArray[np.float32] = field(init=False)
    read_variance_DN2: NDArray[np.float32] = field(init=False)
    gain_DN: float = field(init=False)
    secondary_DN: float = field(init=False)
    warnings: tuple[str, ...] = field(init=False)
    _transmission: NDArray[np.float64] = field(init=False)
    _gain_ratio: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        twin = self.twin
        self.level = twin.level_at(self.target)
        if self.level is None and twin.spectral is None:
            known = "; ".join(item.name for item in twin.levels)
            raise InputError(
                "target setting",
                received=str(self.target),
                expected=f"a kV and filter that the twin was calibrated at ({known})",
                remedy="add flats at this kV and filter to the calibration",
            )
        predicted = predict_flatfield(twin, replace(self.target, averaged=1))
        shape = _flat_shape(twin, self.target).astype(np.float64)
        dark = twin.maps.dark_at(self.target.exposure_ms)
        variance = twin.maps.read_variance_DN2
        bad = twin.maps.bad_pixels > 0
        if self.bad_pixels == "repaired":
            # they took their neighbours' place in the references, so flat, dark and noise are those of a good pixel
            shape, dark = replace_bad_pixels(shape, bad), replace_bad_pixels(dark, bad)
            variance = np.where(bad, np.float32(np.median(variance[~bad])), variance).astype(np.float32)
        self.open_signal_DN = predicted.mean_DN.value * shape
        self.dark_DN = dark
        self.read_variance_DN2 = variance
        self.gain_DN = predicted.gain_DN.value
        secondary = secondary_gain_DN(twin, self.target)
        white = twin.noise.white_fraction
        self.secondary_DN = self.gain_DN * white / (1.0 + white) if secondary is None else secondary
        self.warnings = self._warnings(predicted.extrapolated)
        self.image_effects = None
        if self.effects:
            self.image_effects = ImageEffects(
                twin=twin,
                effects=self.effects,
                setting=self.target,
                open_signal_DN=self.open_signal_DN,
                open_level_DN=predicted.mean_DN.value,
                gain_DN=self.gain_DN,
                secondary_DN=self.secondary_DN,
                dark_DN=self.dark_DN,
                read_variance_DN2=self.read_variance_DN2,
                product_material=self.product_material,
                instrument=self.instrument,
            )
        if twin.spectral is None:
            self._transmission, self._gain_ratio = np.array([0.0, 1.0]), np.ones(2)
        else:
            model = spectral_model_of(twin, highest_kV=self.target.kV)
            rate, ratio = gain_behind_object(
                model,
                twin.spectral.best,
                OpenBeam(kV=self.target.kV, filters=self.target.filters),
                material=self.product_material,
                thickness_mm=_GAIN_THICKNESSES_MM,
            )
            self._transmission, self._gain_ratio = rate[::-1], ratio[::-1]

    def _warnings(self, extrapolated: bool) -> tuple[str, ...]:
        found = []
        if self.level is None and extrapolated:
            found.append(
                f"{self.target} lies outside the calibrated kV or filters: its level rests on the spectral model"
            )
        bits = self.twin.instrument.bits
        if bits is not None:
            noise_DN = np.sqrt(self.gain_DN * np.maximum(self.open_signal_DN, 0.0))
            brightest = self.open_signal_DN + 4.0 * noise_DN + self.dark_DN
            cut = 100.0 * float(np.mean(brightest > 2.0**bits - 1))
            if cut > 1.0:
                found.append(f"{self.target} drives {cut:.3g} % of the pixels in the open field to the end of the ADC")
        return tuple(found)

    @property
    def flat_DN(self) -> NDArray[np.float64]:
        """Open field (row, column) above dark that corrections divide by, DN."""
        return self.open_signal_DN if self.image_effects is None else self.image_effects.flat_DN

    def channel(self) -> Channel:
        """The same as a transfer needs it."""
        return Channel(
            setting=self.target,
            open_signal_DN=self.open_signal_DN,
            gain_DN=self.gain_DN,
            dark_DN=self.dark_DN,
            secondary_DN=self.secondary_DN,
        )

    def gain_behind(self, transmission: NDArray[np.floating]) -> NDArray[np.float64]:
        """Gain (row, column) of the spectrum behind as much product as the transmission says, DN."""
        return np.asarray(self.gain_DN * np.interp(transmission, self._transmission, self._gain_ratio))

    def white_behind(self, gain_DN: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signal-following white variance over quantum variance before the spread (row, column), at pixels of this gain."""
        return np.asarray(self.secondary_DN / np.maximum(gain_DN - self.secondary_DN, 1e-3 * gain_DN))

    def thickness_behind(self, transmission: NDArray[np.floating]) -> NDArray[np.float64]:
        """Product (row, column) that transmits as much, mm; 0 where the twin has no spectral part."""
        if self.twin.spectral is None:
            return np.zeros(np.shape(transmission))
        # the logarithm is nearly straight over thickness
        depth = -np.log(np.maximum(self._transmission, 1e-30))
        wanted = -np.log(np.clip(transmission, 1e-30, 1.0))
        return np.asarray(np.interp(wanted, depth[::-1], _GAIN_THICKNESSES_MM))

    def sample_counts(
        self,
        transmission: NDArray[np.floating],
        reference: Setting,
        rng: np.random.Generator,
        *,
        reference_gain: float = 1.0,
    ) -> NDArray[np.float32]:
        """Counts with dark (row, column) at the target by top-up of a reference's transmission, DN.

        Args:
            transmission: the reference's I / I0.
            reference: its setting.
            rng: source of randomness.
            reference_gain: quantum variance per signal when the reference was taken over that of now.
        """
        noise = self.twin.noise
        plan = plan_top_up(reference=reference, target=self.target, reference_gain=reference_gain)
        effects = self.image_effects
        if effects is not None:
            straight = effects.straightened(transmission, open_signal_DN=self.open_signal_DN / plan.scale)
            if effects.changes_picture():
                quiet = self._quiet(straight, reference)
                straight = straight + effects.picture_change(quiet, self.thickness_behind(quiet))
            gain = self.gain_behind(straight)
            quanta = effects.gain_factor * np.maximum(gain - self.secondary_DN, 1e-3 * gain)
            charge = topped_up_charge(
                straight,
                plan,
                open_signal_DN=effects.open_charge_DN,
                gain_DN=quanta + self.secondary_DN,
                gain_relative=self.twin.maps.gain_relative,
                white_fraction=self.secondary_DN / quanta,
                read_variance_DN2=effects.read_variance_DN2,
                spread=noise.spread.value,
                quantised=noise.quantised,
                rng=rng,
                kernel=effects.pattern.kernel,
            )
            return effects.read_out(charge, rng)
        gain = self.gain_behind(transmission)
        return apply_top_up(
            transmission,
            plan,
            open_signal_DN=self.open_signal_DN,
            gain_DN=gain,
            gain_relative=self.twin.maps.gain_relative,
            white_fraction=self.white_behind(gain),
            read_variance_DN2=self.read_variance_DN2,
            spread=noise.spread.value,
            dark_DN=self.dark_DN,
            bits=self.twin.instrument.bits,
            quantised=noise.quantised,
            rng=rng,
        )

    def _quiet(self, transmission: NDArray[np.float64], reference: Setting) -> NDArray[np.float64]:
        """The transmission without its noise, detail that stands out of the noise kept (row, column)."""
        logs = -np.log(np.maximum(transmission, 1e-6))[None]
        taken = replace(self.channel(), setting=reference)
        return np.asarray(np.exp(-quiet_image(logs, [taken], detector_noise(self.twin))[0]))

    def sample_as_published(self, transmission: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (row, column) at the target by the paper's recipe, DN."""
        return sample_as_published(
            self.open_signal_DN * transmission, dark_DN=self.dark_DN, rng=rng, **published_parameters(self.twin)
        )

    def log_image(self, counts: NDArray[np.floating]) -> NDArray[np.float32]:
        """-log(I / I0) of counts (row, column); bad pixels that were put in are replaced by their neighbours."""
        image = flat_corrected_log(counts, dark_DN=self.dark_DN, flat_DN=self.flat_DN + self.dark_DN)
        if self.bad_pixels == "repaired":
            return image
        return np.asarray(replace_bad_pixels(image, self.twin.maps.bad_pixels > 0), dtype=np.float32)


def _flat_shape(twin: Twin, setting: Setting) -> NDArray[np.float32]:
    """Open field over its median (row, column): of this kV and filter, else of the nearest kV that was measured."""
    level = twin.level_nearest(setting)
    if level is None:
        raise InputError(
            "twin", received="no levels", expected="at least one measured flat", remedy="calibrate it from flats"
        )
    return level.flat_shape


def same_beam(first: Setting, second: Setting) -> bool:
    """Whether two settings have the same kV and filters."""
    return abs(first.kV - second.kV) <= 1e-6 * second.kV and same_layers(first.filters, second.filters)


def detector_noise(twin: Twin, *, bad_pixels: str = "repaired") -> DetectorNoise:
    """The part of a twin's noise that no setting changes."""
    variance = twin.maps.read_variance_DN2
    bad = twin.maps.bad_pixels > 0
    if bad_pixels == "repaired":
        variance = np.where(bad, np.float32(np.median(variance[~bad])), variance).astype(np.float32)
    return DetectorNoise(
        spread=twin.noise.spread.value,
        white_fraction=twin.noise.white_fraction,
        slope_share=slope_share(twin),
        gain_relative=twin.maps.gain_relative,
        read_variance_DN2=variance,
        bits=twin.instrument.bits,
        quantised=twin.noise.quantised,
    )


class PairTransfer:
    """Brings reference pairs to one target pair of another kV or filter; tables and reference channels are kept.

    Raises:
        InputError: a twin without spectral part, or settings that a transfer cannot join.
    """

    def __init__(
        self,
        twin: Twin,
        *,
        low: Setting,
        high: Setting,
        product_material: str = DEFAULT_PRODUCT,
        foreign_material: str = DEFAULT_FOREIGN,
        bad_pixels: str = "repaired",
        effects: tuple[AppliedEffect, ...] = (),
        reference_twin: Twin | None = None,
    ) -> None:
        if twin.spectral is None:
            raise InputError(
                "target setting",
                received=f"{low};{high}",
                expected="the kV and filter of the references, because this twin has no spectral part",
                remedy="calibrate from flats that state kV and tube load",
            )
        self.twin = twin
        self.targets = (low, high)
        self.materials = (product_material, foreign_material)
        self._reference_twin = twin if reference_twin is None else reference_twin
        self.models = tuple(ChannelModel(twin, one, product_material, bad_pixels, effects) for one in (low, high))
        self._drawn = tuple(model.channel() for model in self.models)
        repaired = self.models
        if bad_pixels != "repaired":
            repaired = tuple(ChannelModel(twin, one, product_material) for one in (low, high))
        self._good = tuple(model.channel() for model in repaired)
        self._detector = detector_noise(twin)
        self._detector_drawn = detector_noise(twin, bad_pixels=bad_pixels)
        changed = self.models[0].image_effects
        if changed is not None:
            self._detector_drawn = replace(self._detector_drawn, kernel=changed.pattern.kernel)
        self._references: dict[Setting, Channel] = {}
        self._tables: dict[tuple[OpenBeam, OpenBeam, float], TwoMaterialTables] = {}

    def transfer(
        self,
        log_images: NDArray[np.floating],
        references: tuple[Setting, Setting],
        *,
        product: NDArray[np.bool_] | None = None,
        name: str = "reference",
    ) -> tuple[TransferredPair, tuple[str, ...]]:
        """One reference pair (2, row, column) at the target's spectra, with the noise it brings, and warnings.

        Raises:
            InputError: the reference is too noisy for the target, or was taken at another distance.
        """
        check_geometry(references, self.targets)
        log_images = np.asarray(log_images, dtype=np.float64)
        effects = self.models[0].image_effects
        if effects is not None:
            straight = [
                effects.straightened(np.exp(-plane), open_signal_DN=self._reference(one).open_signal_DN)
                for plane, one in zip(log_images, references, strict=True)
            ]
            log_images = -np.log(np.maximum(np.stack(straight), 1e-6))
        pair = transfer_pair(
            log_images,
            self._tables_for(references, _highest_log(log_images[0])),
            references=[self._reference(one) for one in references],
            targets=self._good,
            detector=self._detector,
            product=product,
        )
        warnings = check_transfer(pair, references=references, targets=self.targets, name=name)
        if pair.unsolved_percent > 0.01:
            warnings += (
                f"{pair.unsolved_percent:.2g} % of the pixels fit no mixture of {self.materials[0]} and"
                f" {self.materials[1]}; name a foreign material that does",
            )
        return self._changed(pair), warnings

    def _changed(self, pair: TransferredPair) -> TransferredPair:
        """The pair with what came after calibration in its picture."""
        transmission = pair.transmission
        for plane, model in enumerate(self.models):
            effects = model.image_effects
            if effects is not None and effects.changes_picture():
                transmission = transmission.copy()
                # a solution's path lengths belong to the smoothed pair, and so does its transmission
                quiet = np.exp(-self._log_of(pair.thickness_mm, plane))
                transmission[plane] += effects.picture_change(quiet, model.thickness_behind(quiet))
        return pair if transmission is pair.transmission else replace(pair, transmission=transmission)

    def _log_of(self, thickness_mm: NDArray[np.float64], plane: int) -> NDArray[np.float64]:
        spectral = self.twin.spectral
        target = self.targets[plane]
        model = spectral_model_of(self.twin, highest_kV=target.kV)
        best = model.default_parameters() if spectral is None else spectral.best
        weights = model.moment_weights(best, OpenBeam(kV=target.kV, filters=target.filters))[:1]
        mu = np.stack([model.mu(name)[: weights.shape[1]] for name in self.materials])
        behind = project_polychromatic(thickness_mm, mu, weights / weights.sum(), allow_negative=True)
        return np.asarray(-np.log(np.maximum(behind[0].astype(np.float64), 1e-12)))

    def draw(self, pair: TransferredPair, rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (2, row, column) of a transferred pair, DN; each call draws its own noise."""
        effects = [model.image_effects for model in self.models]
        if effects[0] is not None and effects[1] is not None:
            charge = transferred_charge(pair, targets=self._drawn, detector=self._detector_drawn, rng=rng)
            return np.stack([one.read_out(plane, rng) for one, plane in zip(effects, charge, strict=True) if one])
        return sample_transferred(pair, targets=self._drawn, detector=self._detector_drawn, rng=rng)

    def _reference(self, setting: Setting) -> Channel:
        if setting not in self._references:
            self._references[setting] = ChannelModel(self._reference_twin, setting, self.materials[0]).channel()
        return self._references[setting]

    def _tables_for(self, references: tuple[Setting, Setting], highest_log: float) -> TwoMaterialTables:
        beams = tuple(OpenBeam(kV=one.kV, filters=one.filters) for one in (*references, *self.targets))
        # no detector of 16 bits shows more than ln 65535 = 11; beyond a table its functions go on straight
        top = min(2.0 ** math.ceil(math.log2(max(highest_log, 1.0)) + 0.25), 12.0)
        key = (beams[0], beams[1], top)
        if key not in self._tables:
            model = spectral_model_of(self.twin, highest_kV=max(beam.kV for beam in beams))
            now, then = (
                model.default_parameters() if one.spectral is None else one.spectral.best
                for one in (self.twin, self._reference_twin)
            )
            self._tables[key] = tabulate_two_materials(
                model, np.stack([then, then, now, now]), beams=beams, materials=self.materials, highest_log=top
            )
        return self._tables[key]


def reference_settings(row: DatasetRow, fallback: tuple[Setting, Setting] | None) -> tuple[Setting, Setting]:
    """Low and high setting of a reference row.

    Raises:
        InputError: the row does not say and no fallback was given.
    """
    low, semicolon, high = row.setting.partition(";")
    if semicolon:
        return setting_from_text(low), setting_from_text(high)
    if fallback is None:
        raise InputError(
            f"reference image {row.image}",
            received=f"setting {row.setting!r}",
            expected="LOW;HIGH, for example kv=40,power_w=40,exposure_ms=100,averaged=10;kv=90,...",
            remedy="give --reference-low and --reference-high",
        )
    return fallback


class ReferenceImages:
    """References of a dataset as a line would show them at one target, each time with other noise.

    `len()` is the number of references; positions count them in the order of the dataset, `numbers` says which of its
    images they are.

    Raises:
        InputError: targets the twin or the references cannot reach, another detector size, no reference.
    """

    def __init__(
        self,
        twin: Twin,
        reference: Dataset,
        *,
        low: Setting,
        high: Setting,
        recipe: str = "raytwin",
        product_material: str = DEFAULT_PRODUCT,
        foreign_material: str = DEFAULT_FOREIGN,
        bad_pixels: str = "repaired",
        registration_px: tuple[float, float] | str | None = None,
        split: str | None = None,
        reference_setting: tuple[Setting, Setting] | None = None,
    ) -> None:
        refuse_binning(low, high)
        if recipe not in RECIPES:
            raise InputError("recipe", received=recipe, expected="one of " + ", ".join(RECIPES))
        refuse_pair(low, high, bad_pixels=bad_pixels)
        if reference.shape != twin.maps.shape:
            raise InputError(
                "reference",
                received=f"images of {reference.shape}",
                expected=f"the twin's detector, {twin.maps.shape} (row, column)",
                remedy="calibrate from flats of the detector that took the references",
            )
        reference.refuse_other_pitch(twin.instrument.pixel_mm)
        self.numbers = [int(number) for number in reference.indices(split=split)]
        if not self.numbers:
            raise InputError(
                "reference", received=f"no image of split {split}", expected="at least one reference image"
            )
        line = present_line(twin)
        now, effects, told = line.twin, line.effects, line.warnings
        then = present_line(twin, after_calibration=False).twin
        if recipe == "as_published" and twin.effects:
            now, effects, told = then, (), ("the published recipe knows no effects: those of the twin are left out",)
        self._reference_gain = [1.0, 1.0]
        if now is not then:
            gains = [[predict_flatfield(one, at).gain_DN.value for at in (low, high)] for one in (then, now)]
            self._reference_gain = [before / after for before, after in zip(*gains, strict=True)]
        self._reference = reference
        self._recipe = recipe
        self._registration_px = registration_px
        self._settings = [reference_settings(reference.rows[number], reference_setting) for number in self.numbers]
        # a beam that is another one since calibration is reached as another setting is
        other_beam = now.spectral is not None and any(
            item.since == "calibration" and effect.stage == "beam" and effect.worked_in is not None
            for item, effect in zip(twin.effects, map(effect_of, twin.effects), strict=True)
        )
        self._needs_transfer = {
            pair: (other_beam and recipe == "raytwin")
            or not all(same_beam(own, target) for own, target in zip(pair, (low, high), strict=True))
            for pair in sorted(set(self._settings), key=str)
        }
        self.transfers = any(self._needs_transfer.values())
        if recipe == "as_published" and self.transfers:
            raise InputError(
                "target setting",
                received=f"{low};{high}",
                expected="the kV and filter of the references: the published recipe knows no other",
                remedy="use --recipe raytwin",
            )
        self._transfer: PairTransfer | None = None
        if self.transfers:
            self._transfer = PairTransfer(
                now,
                low=low,
                high=high,
                product_material=product_material,
                foreign_material=foreign_material,
                bad_pixels=bad_pixels,
                effects=effects,
                reference_twin=then,
            )
            self.channels = self._transfer.models
        else:
            self.channels = tuple(ChannelModel(now, one, product_material, bad_pixels, effects) for one in (low, high))
        self.warnings = (*told, *self._plan_warnings(twin, (low, high)))

    def __len__(self) -> int:
        return len(self.numbers)

    def counts(self, position: int, rng: np.random.Generator) -> tuple[NDArray[np.float32], tuple[str, ...]]:
        """Counts with dark (2, row, column) of one reference at the target, DN, and warnings.

        Raises:
            InputError: the reference is too noisy for the target.
        """
        number, settings = self.numbers[position], self._settings[position]
        images = _registered(self._reference.images(number), self._registration_px)
        if self._transfer is not None and self._needs_transfer[settings]:
            pair, told = self._transfer.transfer(
                images,
                settings,
                product=self._reference.product_masks(number),
                name=f"reference {self._reference.rows[number].image}",
            )
            return self._transfer.draw(pair, rng), told
        counts = np.empty(images.shape, dtype=np.float32)
        for plane, channel in enumerate(self.channels):
            transmission = np.exp(-images[plane].astype(np.float64))
            if self._recipe == "raytwin":
                counts[plane] = channel.sample_counts(
                    transmission, settings[plane], rng, reference_gain=self._reference_gain[plane]
                )
            else:
                counts[plane] = channel.sample_as_published(transmission, rng)
        return counts, ()

    def log_images(self, counts: NDArray[np.floating]) -> NDArray[np.float32]:
        """-log(I / I0) of counts (2, row, column) of the target."""
        return np.stack([channel.log_image(plane) for channel, plane in zip(self.channels, counts, strict=True)])

    def _plan_warnings(self, twin: Twin, targets: tuple[Setting, Setting]) -> Iterator[str]:
        for pair, transferred in self._needs_transfer.items():
            if transferred:
                continue
            for own, target in zip(pair, targets, strict=True):
                plan = plan_top_up(reference=own, target=target)
                if plan.read < -1e-9:
                    excess = math.sqrt(-plan.read) * twin.noise.read_noise_DN.value
                    yield (
                        f"references at {own} carry {excess:.3g} DN rms more electronic noise than {target} would: their"
                        " frames are too many and too dim for it"
                    )
        if twin.spectral is None:
            yield "the twin has no spectral part: the gain behind the product is that of the open beam"
        for channel in self.channels:
            yield from channel.warnings
        yield from effect_warnings(self.channels, references=True)


def effects_provenance(twin: Twin | None) -> dict[str, str]:
    """Entry for a dataset's provenance that says which effects the twin has; none where it has none."""
    if twin is None or not twin.effects:
        return {}
    return {"effects": "+".join(f"{item.id}={item.parameters.get('strength', math.nan):g}" for item in twin.effects)}


def effect_warnings(channels: Sequence[ChannelModel], *, references: bool) -> list[str]:
    """One line for each effect that images do not hold."""
    found: dict[str, None] = {}
    for channel in channels:
        if channel.image_effects is None:
            continue
        found.update(dict.fromkeys(channel.image_effects.warnings))
        for effect in map(effect_of, channel.image_effects.effects if references else ()):
            if effect.images.not_in_references:
                found[f"effect {effect.id} is not in the images: {effect.images.not_in_references}"] = None
    return list(found)


def generate_dataset(
    twin: Twin,
    reference: Dataset,
    out: str | os.PathLike[str],
    *,
    low: Setting,
    high: Setting,
    images: int,
    seed: int,
    recipe: str = "raytwin",
    product_material: str = DEFAULT_PRODUCT,
    foreign_material: str = DEFAULT_FOREIGN,
    bad_pixels: str = "repaired",
    registration_px: tuple[float, float] | str | None = None,
    split: str | None = None,
    with_counts: bool = True,
    reference_setting: tuple[Setting, Setting] | None = None,
    twin_sha256: str = "",
    progress: Callable[[int], None] | None = None,
) -> GenerationSummary:
    """Write `images` image pairs at (low, high) drawn from the references, with their masks, contrasts and splits.

    Each image takes one reference (all in turn, in an order drawn from the seed) and a noise of its own that depends on
    the seed and the image's number alone.

    Args:
        twin: the calibrated line.
        reference: pairs with as little noise as can be had.
        out: dataset file to write.
        low, high: target settings; another kV or filter than the references' is reached through two materials.
        product_material, foreign_material: what the beam hardens in, and the two materials of a transfer.
        bad_pixels: `repaired` (as their neighbours) or `measured` (in the counts as the twin knows them; in the log
            images replaced by their neighbours, as an import with a twin does).
        registration_px: shift (row, column) of the reference's high image against the low one, taken off before anything
            else; `estimate` finds it for each pair; None leaves the pair as it is.
        split: references of this split only.
        reference_setting: low and high setting of references that do not say.

    Raises:
        InputError: targets the twin or the references cannot reach, another detector size, no reference.
    """
    if images < 1:
        raise InputError("number of images", received=images, expected="1 or more")
    drawn = ReferenceImages(
        twin,
        reference,
        low=low,
        high=high,
        recipe=recipe,
        product_material=product_material,
        foreign_material=foreign_material,
        bad_pixels=bad_pixels,
        registration_px=registration_px,
        split=split,
        reference_setting=reference_setting,
    )
    warnings = list(drawn.warnings)
    setting_text = f"{low};{high}"
    reference_sha256 = sha256_of_file(reference.path)
    order = np.random.default_rng([seed, 0]).permutation(len(drawn))
    with_foreign = clipped = values = 0
    provenance = {
        "twin_sha256": twin_sha256,
        "reference_sha256": reference_sha256,
        "setting_low": str(low),
        "setting_high": str(high),
        "pixel_mm": twin.instrument.pixel_mm,
        "seed": seed,
        "recipe": recipe,
        "product_material": product_material,
        "foreign_material": foreign_material if drawn.transfers or stated_materials(reference)[1] else None,
        BAD_PIXEL_MAP: bad_pixels,
        "registration_px": None if registration_px is None else str(registration_px),
        **effects_provenance(twin if recipe == "raytwin" else None),
    }
    with write_dataset(out, shape=reference.shape, provenance=provenance) as writer:
        for number in range(images):
            position = int(order[number % len(drawn)])
            counts, told = drawn.counts(position, np.random.default_rng([seed, 1, number]))
            warnings += [line for line in told if line not in warnings]
            for plane, channel in enumerate(drawn.channels):
                clipped += int(np.count_nonzero(counts[plane] - channel.dark_DN < 1.0))
            values += counts.size
            index = drawn.numbers[position]
            row = reference.rows[index]
            foreign = reference.foreign_object_masks(index)
            with_foreign += bool(foreign.any())
            writer.append(
                image=drawn.log_images(counts),
                counts=counts if with_counts else None,
                foreign_object_mask=foreign,
                product_mask=reference.product_masks(index),
                # the first image of a reference keeps its name, so that it pairs with the measured one
                row=replace(
                    row, image=row.image if number < len(drawn) else f"{row.image}-{number:05d}", setting=setting_text
                ),
            )
            if progress is not None:
                progress(number + 1)
    clipped_percent = 100.0 * clipped / values
    if clipped_percent > 0.1:
        warnings.append(
            f"{clipped_percent:.2g} % of the values lie below 1 DN above dark and are clipped in the log image"
        )
    return GenerationSummary(
        images=images,
        references=min(images, len(drawn)),
        with_foreign_object=with_foreign,
        seed=seed,
        recipe=recipe,
        setting=setting_text,
        dataset_sha256=sha256_of_file(out),
        reference_sha256=reference_sha256,
        clipped_percent=clipped_percent if math.isfinite(clipped_percent) else 0.0,
        warnings=tuple(warnings),
        transferred=drawn.transfers,
    )


def _highest_log(image: NDArray[np.floating]) -> float:
    """Largest value of a log image (row, column) that is more than a noisy pixel: of its means over 3 x 3 pixels."""
    from scipy.ndimage import uniform_filter

    highest = float(uniform_filter(np.asarray(image, dtype=np.float64), 3).max())
    return highest if math.isfinite(highest) else 1.0


def _registered(
    log_images: NDArray[np.float32], registration_px: tuple[float, float] | str | None
) -> NDArray[np.floating]:
    """The pair with its high image moved onto the low one (2, row, column)."""
    if registration_px is None:
        return log_images
    if isinstance(registration_px, str):
        registration_px = estimate_shift_px(log_images[0], log_images[1])
    return np.stack([log_images[0], shift_image(log_images[1], (-registration_px[0], -registration_px[1]))])

"""Dual-energy images at a setting from reference images: the noise each reference lacks is drawn anew."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.dataset_io import Dataset, DatasetRow, write_dataset
from ..acquisition.pairs import flat_corrected_log, replace_bad_pixels
from ..acquisition.setting import Setting, setting_from_text
from ..errors import InputError
from ..files import sha256_of_file
from .as_published import published_parameters, sample_as_published
from .predict import predict_flatfield, spectral_model_of
from .spectral_signal import OpenBeam, gain_behind_object
from .topup import apply_top_up, plan_top_up
from .twin import Level, Twin

RECIPES = ("raytwin", "as_published")
DEFAULT_PRODUCT = "chicken_breast"
_GAIN_THICKNESSES_MM = np.array([0.0, 1, 2, 4, 7, 11, 16, 22, 30, 40, 55, 75, 100, 140])


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
            "warnings": list(self.warnings),
        }


@dataclass(slots=True)
class ChannelModel:
    """One tube voltage of a pair at the target: open signal, dark, and gain as a function of the transmission."""

    twin: Twin
    target: Setting
    product_material: str
    level: Level = field(init=False)
    open_signal_DN: NDArray[np.float64] = field(init=False)
    dark_DN: NDArray[np.float32] = field(init=False)
    gain_DN: float = field(init=False)
    _transmission: NDArray[np.float64] = field(init=False)
    _gain_ratio: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        level = self.twin.level_at(self.target)
        if level is None:
            known = "; ".join(item.name for item in self.twin.levels)
            raise InputError(
                "target setting",
                received=str(self.target),
                expected=f"a kV and filter that the twin was calibrated at ({known})",
                remedy="add flats at this kV and filter to the calibration",
            )
        predicted = predict_flatfield(self.twin, replace(self.target, averaged=1))
        self.level = level
        # bad pixels took their neighbours' place in the references, so flat, dark and noise are those of a good pixel
        bad = self.twin.maps.bad_pixels > 0
        shape = replace_bad_pixels(level.flat_shape.astype(np.float64), bad)
        self.open_signal_DN = predicted.mean_DN.value * shape
        self.dark_DN = replace_bad_pixels(self.twin.maps.dark_at(self.target.exposure_ms), bad)
        self.gain_DN = predicted.gain_DN.value
        if self.twin.spectral is None:
            self._transmission, self._gain_ratio = np.array([0.0, 1.0]), np.ones(2)
        else:
            model = spectral_model_of(self.twin, highest_kV=self.target.kV)
            rate, ratio = gain_behind_object(
                model,
                self.twin.spectral.best,
                OpenBeam(kV=self.target.kV, filters=self.target.filters),
                material=self.product_material,
                thickness_mm=_GAIN_THICKNESSES_MM,
            )
            self._transmission, self._gain_ratio = rate[::-1], ratio[::-1]

    def gain_behind(self, transmission: NDArray[np.floating]) -> NDArray[np.float64]:
        """Gain (row, column) of the spectrum behind as much product as the transmission says, DN."""
        return np.asarray(self.gain_DN * np.interp(transmission, self._transmission, self._gain_ratio))

    def sample_counts(
        self, transmission: NDArray[np.floating], reference: Setting, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Counts with dark (row, column) at the target by top-up of a reference's transmission, DN."""
        noise = self.twin.noise
        return apply_top_up(
            transmission,
            plan_top_up(reference=reference, target=self.target),
            open_signal_DN=self.open_signal_DN,
            gain_DN=self.gain_behind(transmission),
            gain_relative=self.twin.maps.gain_relative,
            white_fraction=noise.white_fraction,
            read_variance_DN2=self._read_variance(),
            psf_model=noise.psf_model,
            psf_sigma_px=noise.psf_sigma_px.value,
            dark_DN=self.dark_DN,
            bits=self.twin.instrument.bits,
            quantised=noise.quantised,
            rng=rng,
        )

    def sample_as_published(self, transmission: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (row, column) at the target by the paper's recipe, DN."""
        return sample_as_published(
            self.open_signal_DN * transmission, dark_DN=self.dark_DN, rng=rng, **published_parameters(self.twin)
        )

    def log_image(self, counts: NDArray[np.floating]) -> NDArray[np.float32]:
        """-log(I / I0) of counts (row, column)."""
        return flat_corrected_log(counts, dark_DN=self.dark_DN, flat_DN=self.open_signal_DN + self.dark_DN)

    def _read_variance(self) -> NDArray[np.float32]:
        variance = self.twin.maps.read_variance_DN2
        good = self.twin.maps.bad_pixels == 0
        return np.where(good, variance, np.float32(np.median(variance[good]))).astype(np.float32)


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
    split: str | None = None,
    with_counts: bool = True,
    reference_setting: tuple[Setting, Setting] | None = None,
    twin_sha256: str = "",
    progress: Callable[[int], None] | None = None,
) -> GenerationSummary:
    """Write `images` image pairs at (low, high) drawn from the references, with their masks, contrasts and splits.

    Each image takes one reference (all in turn, in an order drawn from the seed) and a noise of its own that depends on
    the seed and the image's number alone.

    Raises:
        InputError: targets the twin or the references cannot reach, another detector size, no reference.
    """
    if recipe not in RECIPES:
        raise InputError("recipe", received=recipe, expected="one of " + ", ".join(RECIPES))
    if images < 1:
        raise InputError("number of images", received=images, expected="1 or more")
    if high.kV <= low.kV:
        raise InputError(
            "settings", received=f"low {low.kV:g} kV, high {high.kV:g} kV", expected="low kV below high kV"
        )
    if reference.shape != twin.maps.shape:
        raise InputError(
            "reference",
            received=f"images of {reference.shape}",
            expected=f"the twin's detector, {twin.maps.shape} (row, column)",
            remedy="calibrate from flats of the detector that took the references",
        )
    chosen = reference.indices(split=split)
    if len(chosen) == 0:
        raise InputError("reference", received=f"no image of split {split}", expected="at least one reference image")
    channels = [ChannelModel(twin, low, product_material), ChannelModel(twin, high, product_material)]
    settings = [reference_settings(reference.rows[int(index)], reference_setting) for index in chosen]
    warnings = []
    for pair in sorted(set(settings), key=str):
        for own, target in zip(pair, (low, high), strict=True):
            plan = plan_top_up(reference=own, target=target)
            if plan.read < -1e-9:
                excess = math.sqrt(-plan.read) * twin.noise.read_noise_DN.value
                warnings.append(
                    f"references at {own} carry {excess:.3g} DN rms more electronic noise than {target} would: their"
                    " frames are too many and too dim for it"
                )
    if twin.spectral is None:
        warnings.append("the twin has no spectral part: the gain behind the product is that of the open beam")
    setting_text = f"{low};{high}"
    reference_sha256 = sha256_of_file(reference.path)
    order = np.random.default_rng([seed, 0]).permutation(len(chosen))
    with_foreign = clipped = values = 0
    provenance = {
        "twin_sha256": twin_sha256,
        "reference_sha256": reference_sha256,
        "setting_low": str(low),
        "setting_high": str(high),
        "seed": seed,
        "recipe": recipe,
        "product_material": product_material,
    }
    with write_dataset(out, shape=reference.shape, provenance=provenance) as writer:
        for number in range(images):
            position = int(order[number % len(chosen)])
            index = int(chosen[position])
            transmission = np.exp(-reference.images(index).astype(np.float64))
            rng = np.random.default_rng([seed, 1, number])
            counts = np.empty((2, *reference.shape), dtype=np.float32)
            logs = np.empty_like(counts)
            for plane, channel in enumerate(channels):
                if recipe == "raytwin":
                    counts[plane] = channel.sample_counts(transmission[plane], settings[position][plane], rng)
                else:
                    counts[plane] = channel.sample_as_published(transmission[plane], rng)
                logs[plane] = channel.log_image(counts[plane])
                clipped += int(np.count_nonzero(counts[plane] - channel.dark_DN < 1.0))
                values += counts[plane].size
            row = reference.rows[index]
            foreign = reference.foreign_object_masks(index)
            with_foreign += bool(foreign.any())
            writer.append(
                image=logs,
                counts=counts if with_counts else None,
                foreign_object_mask=foreign,
                product_mask=reference.product_masks(index),
                # the first image of a reference keeps its name, so that it pairs with the measured one
                row=replace(
                    row, image=row.image if number < len(chosen) else f"{row.image}-{number:05d}", setting=setting_text
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
        references=min(images, len(chosen)),
        with_foreign_object=with_foreign,
        seed=seed,
        recipe=recipe,
        setting=setting_text,
        dataset_sha256=sha256_of_file(out),
        reference_sha256=reference_sha256,
        clipped_percent=clipped_percent if math.isfinite(clipped_percent) else 0.0,
        warnings=tuple(warnings),
    )

"""Datasets from descriptions: products and foreign objects drawn at random, projected, and given a detector's noise."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...acquisition.contrast import delta_r, dilations_for_pixel
from ...acquisition.dataset_io import DatasetRow, write_dataset
from ...acquisition.setting import Setting
from ...errors import InputError
from ...files import sha256_of_file
from ..frames.present_line import PresentLine, present_line
from ..line.binning import refuse_binning
from ..line.twin import BAD_PIXEL_MAP, Twin
from ..references.transfer import Channel
from ..scenes.describe import Description, Individual, Scene, choose_kind, sample_individual, sample_scene
from ..spread._fine_picture import FINE
from .generate import ChannelModel, GenerationSummary, detector_noise, effect_warnings, effects_provenance, refuse_pair
from .image_effects import AffectedImage
from .render import (
    SUPERSAMPLING,
    ExpectedImage,
    Geometry,
    RenderedScene,
    TracedScene,
    geometry_of,
    refuse_without_spectrum,
    render_scene,
    sample_expected,
    trace_scene,
)

_Images = tuple[ExpectedImage | AffectedImage, ExpectedImage | AffectedImage]  # (low, high)
_POSE, _NOISE, _PRODUCT, _SPLIT = 2, 1, 3, 4  # places of the random streams of a seed


@dataclass(frozen=True, slots=True, kw_only=True)
class DescribedPair:
    """A scene and what the detector shows of it on average: the images (low, high), masks (row, column) and the row."""

    scene: Scene
    expected: _Images
    foreign_object_mask: NDArray[np.bool_]
    product_mask: NDArray[np.bool_]
    row: DatasetRow


def described_geometry(
    twin: Twin, description: Description, *, low: Setting, high: Setting, bad_pixels: str = "repaired"
) -> Geometry:
    """The geometry in which a line sees a description's scenes at two settings.

    Raises:
        InputError: a twin without spectral part or geometry, settings that are no pair.
    """
    refuse_binning(low, high)
    refuse_without_spectrum(twin)
    refuse_pair(low, high, bad_pixels=bad_pixels)
    return geometry_of(twin, settings=(low, high), line=description.line)


def channel_warnings(twin: Twin, description: Description, setting: Setting, geometry: Geometry) -> tuple[str, ...]:
    """What is said of a description's images at one setting, whatever the other one is.

    Raises:
        InputError: a setting that the twin cannot reach.
    """
    line = present_line(twin)
    model = _channel_model(line, description, setting, geometry, bad_pixels="repaired")
    return (*line.warnings, *_warnings_of((model,)))


def _channel_model(
    line: PresentLine, description: Description, setting: Setting, geometry: Geometry, *, bad_pixels: str
) -> ChannelModel:
    """One setting of a line in a geometry."""
    instrument = replace(
        line.twin.instrument,
        pixel_mm=geometry.pixel_mm,
        source_object_mm=geometry.source_object_mm,
        source_detector_mm=geometry.source_detector_mm,
    )
    material = description.products[0].material or "water"
    return ChannelModel(line.twin, setting, material, bad_pixels, line.effects, instrument)


def _warnings_of(models: Sequence[ChannelModel]) -> tuple[str, ...]:
    return (*(text for model in models for text in model.warnings), *effect_warnings(models, references=False))


class DescribedScenes:
    """Draws the scenes of a description as one line sees them; scene `number` is the same however often it is asked for.

    Raises:
        InputError: a twin without spectral part or geometry, settings that it cannot reach.
    """

    def __init__(
        self,
        twin: Twin,
        description: Description,
        *,
        low: Setting,
        high: Setting,
        seed: int,
        bad_pixels: str = "repaired",
        supersampling: int = SUPERSAMPLING,
    ) -> None:
        self.geometry: Geometry = described_geometry(twin, description, low=low, high=high, bad_pixels=bad_pixels)
        if not 1 <= supersampling <= 9:
            raise InputError("supersampling", received=supersampling, expected="1 to 9 sub-pixels along each axis")
        line = present_line(twin)
        twin = line.twin
        self.twin = twin
        self.description = description
        self.settings = (low, high)
        self.seed = seed
        self.supersampling = supersampling
        self.models = tuple(
            _channel_model(line, description, one, self.geometry, bad_pixels=bad_pixels) for one in (low, high)
        )
        self.warnings = (*line.warnings, *_warnings_of(self.models))
        self._channels: tuple[Channel, ...] = tuple(model.channel() for model in self.models)
        self._detector = detector_noise(twin, bad_pixels=bad_pixels)
        self._products: dict[int, Individual] = {}
        self._splits: dict[int, str] = {}

    def pair(self, number: int) -> DescribedPair:
        """Scene `number` and its images without noise.

        Raises:
            InputError: a product or an object that finds no room.
        """
        known = round(self.description.images["products"][1])
        rng = np.random.default_rng([self.seed, _POSE, number])
        which = number % known if known else number
        product = self._product(which)
        scene = sample_scene(self.description, product, rays=self.geometry.rays(), rng=rng)
        rendered, expected = self._seen(scene)
        foreign = _mask(rendered.foreign_cover)
        inside = _mask(rendered.cover)
        objects = [one.individual for one in scene.foreign_objects]
        return DescribedPair(
            scene=scene,
            expected=expected,
            foreign_object_mask=foreign,
            product_mask=inside | foreign,
            row=DatasetRow(
                image=f"{number:05d}",
                product=product.name,
                foreign_object="+".join(one.name for one in objects),
                size_mm=max((one.size_mm for one in objects), default=math.nan),
                contrast=self._contrast(scene, expected, foreign),
                split=self._split(which),
                setting=";".join(map(str, self.settings)),
            ),
        )

    def _seen(self, scene: Scene) -> tuple[RenderedScene | TracedScene, _Images]:
        """A scene as it is projected, and its images (low, high) without noise."""
        effects = [model.image_effects for model in self.models]
        if effects[0] is None:
            rendered = render_scene(
                scene,
                twin=self.twin,
                channels=self._channels,
                geometry=self.geometry,
                supersampling=self.supersampling,
            )
            low, high = rendered.images
            return rendered, (low, high)
        traced = trace_scene(
            scene,
            twin=self.twin,
            channels=self._channels,
            geometry=self.geometry,
            supersampling=FINE,
            attenuation_scale=effects[0].attenuation_scale,
        )
        affected = [
            one.image(*moments, traced.lengths_mm, focal_blur_px=self.geometry.focal_blur_px)
            for one, moments in zip(effects, traced.moments, strict=True)
            if one is not None
        ]
        return traced, (affected[0], affected[1])

    def draw(self, pair: DescribedPair, rng: np.random.Generator) -> NDArray[np.float32]:
        """Counts with dark (2, row, column) of a pair, DN; each call draws its own noise."""
        frames = []
        for image, channel, model in zip(pair.expected, self._channels, self.models, strict=True):
            if isinstance(image, AffectedImage) and model.image_effects is not None:
                frames.append(model.image_effects.sample(image, rng))
            elif isinstance(image, ExpectedImage):
                frames.append(sample_expected(image, channel=channel, detector=self._detector, rng=rng))
        return np.stack(frames)

    def _product(self, number: int) -> Individual:
        if number not in self._products:
            rng = np.random.default_rng([self.seed, _PRODUCT, number])
            kind = choose_kind(self.description.products, rng)
            if len(self._products) > 256:
                self._products.clear()
            self._products[number] = sample_individual(kind, name=f"{kind.name}{number + 1:03d}", rng=rng)
        return self._products[number]

    def _split(self, product: int) -> str:
        """Split of a product, decided by its number alone."""
        images = self.description.images
        known = round(images["products"][1])
        test, validation = images["test"][1], images["validation"][1]
        if known:
            if not self._splits:
                order = np.random.default_rng([self.seed, _SPLIT]).permutation(known)
                n_test, n_validation = round(test * known), round(validation * known)
                names = ["test"] * n_test + ["val"] * n_validation
                names += ["train"] * (known - len(names))
                self._splits = {int(one): name for one, name in zip(order, names, strict=True)}
            return self._splits[product]
        value = float(np.random.default_rng([self.seed, _SPLIT, product]).random())
        return "test" if value < test else "val" if value < test + validation else "train"

    def _contrast(self, scene: Scene, expected: _Images, mask: NDArray[np.bool_]) -> float:
        if not mask.any():
            return math.nan
        _, alone = self._seen(replace(scene, foreign_objects=()))
        dilations = dilations_for_pixel(self.geometry.pixel_mm)
        try:
            return delta_r(*_log_images(expected), mask, dilations=dilations, alone=_log_images(alone))
        except InputError:
            return math.nan  # an object beside the product or across all of it has no ring to be compared with


def _log_images(images: _Images) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    return images[0].log_image, images[1].log_image


def _mask(cover: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels at least half covered; the most covered one where none is."""
    mask = cover >= 0.5
    if not mask.any() and cover.any():
        mask.flat[int(cover.argmax())] = True
    return np.asarray(mask)


def generate_from_description(
    twin: Twin,
    description: Description,
    out: str | os.PathLike[str],
    *,
    low: Setting,
    high: Setting,
    images: int,
    seed: int,
    bad_pixels: str = "repaired",
    supersampling: int = SUPERSAMPLING,
    with_counts: bool = True,
    twin_sha256: str = "",
    progress: Callable[[int], None] | None = None,
) -> GenerationSummary:
    """Write `images` image pairs at (low, high) of scenes drawn from a description, with masks, contrasts and splits.

    Scene and noise of an image depend on the seed and its number alone. Contrasts are those of the noiseless pair, against
    a ring as wide in mm as 21 pixels of 0.15 mm, less what the product alone shows there (`delta_r`). Masks hold the pixels
    that are at least half covered.

    Raises:
        InputError: see `DescribedScenes`; nothing is left behind.
    """
    if images < 1:
        raise InputError("number of images", received=images, expected="1 or more")
    scenes = DescribedScenes(
        twin, description, low=low, high=high, seed=seed, bad_pixels=bad_pixels, supersampling=supersampling
    )
    provenance = {
        "twin_sha256": twin_sha256,
        "description_sha256": description.sha256,
        "description": description.text,
        "setting_low": str(low),
        "setting_high": str(high),
        "pixel_mm": twin.instrument.pixel_mm,
        "seed": seed,
        "recipe": "raytwin",
        BAD_PIXEL_MAP: bad_pixels,
        "supersampling": supersampling,
        **effects_provenance(twin),
    }
    with_foreign = clipped = values = 0
    products = set()
    with write_dataset(out, shape=twin.maps.shape, provenance=provenance) as writer:
        for number in range(images):
            pair = scenes.pair(number)
            counts = scenes.draw(pair, np.random.default_rng([seed, _NOISE, number]))
            logs = np.stack([model.log_image(plane) for model, plane in zip(scenes.models, counts, strict=True)])
            dark = np.stack([model.dark_DN for model in scenes.models])
            clipped += int(np.count_nonzero(counts - dark < 1.0))
            values += counts.size
            with_foreign += bool(pair.row.foreign_object)
            products.add(pair.row.product)
            writer.append(
                image=logs,
                counts=counts if with_counts else None,
                foreign_object_mask=pair.foreign_object_mask,
                product_mask=pair.product_mask,
                row=pair.row,
            )
            if progress is not None:
                progress(number + 1)
    warnings = list(scenes.warnings)
    if 100.0 * clipped / values > 0.1:
        warnings.append(
            f"{100.0 * clipped / values:.2g} % of the values lie below 1 DN above dark and are clipped in the log image"
        )
    return GenerationSummary(
        images=images,
        references=len(products),
        with_foreign_object=with_foreign,
        seed=seed,
        recipe="raytwin",
        setting=f"{low};{high}",
        dataset_sha256=sha256_of_file(out),
        reference_sha256=description.sha256,
        clipped_percent=100.0 * clipped / values,
        warnings=tuple(warnings),
    )

"""Images of objects whose path lengths are known ray by ray: a twin's picture of what was measured, at any setting.

The path lengths are those of an acquisition's scenes. They go through the whole line with the twin's effects, as described
scenes do, and twins with and without effects take the same way, so that their pictures differ by the effects alone.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...acquisition.contrast import delta_r, dilations_for_pixel
from ...acquisition.dataset_io import DatasetRow, write_dataset
from ...acquisition.pairs import flat_corrected_log
from ...acquisition.setting import Setting
from ...errors import InputError
from ..frames.present_line import present_line
from ..line.binning import refuse_binning
from ..line.twin import Twin
from ..predictions.predict import predict_flatfield
from ..references.transfer import Channel
from ..spread._fine_picture import FINE
from .generate import ChannelModel, effect_warnings, effects_provenance
from .image_effects import AffectedImage, ImageEffects
from .render import geometry_of, moments_behind, refuse_without_spectrum

_NOISE = 5  # place of the random streams of a seed


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownScene:
    """An object of known path lengths.

    Fields: row (image, product, foreign object, size, contrast, split as a dataset holds them); thickness_mm: material ->
    (row, column) path length along the ray of each pixel; foreign_object_mask, product_mask (row, column).
    """

    row: DatasetRow
    thickness_mm: Mapping[str, NDArray[np.floating]] = field(repr=False)
    foreign_object_mask: NDArray[np.bool_] = field(repr=False)
    product_mask: NDArray[np.bool_] = field(repr=False)


class KnownScenes:
    """One line's pictures of known objects at a low and a high setting.

    Raises:
        InputError: a twin without spectral part or geometry, or settings that it cannot reach.
    """

    def __init__(self, twin: Twin, *, low: Setting, high: Setting, product_material: str) -> None:
        refuse_binning(low, high)
        refuse_without_spectrum(twin)
        if high.kV <= low.kV:
            raise InputError(
                "settings",
                received=f"low {low.kV:g} kV, high {high.kV:g} kV",
                expected="low kV below high kV",
                remedy="exchange low and high, or give another kV",
            )
        line = present_line(twin)
        self.twin = line.twin
        self.settings = (low, high)
        self.geometry = geometry_of(self.twin, settings=(low, high))
        models = tuple(
            ChannelModel(self.twin, one, product_material, "repaired", line.effects, self.twin.instrument)
            for one in self.settings
        )
        self.models = models
        self._channels: tuple[Channel, ...] = tuple(model.channel() for model in models)
        self._effects = tuple(model.image_effects or _without_effects(model) for model in models)
        self.warnings = (
            *line.warnings,
            *(text for model in models for text in model.warnings),
            *effect_warnings(models, references=False),
        )

    def expected(self, thickness_mm: Mapping[str, NDArray[np.floating]]) -> tuple[AffectedImage, ...]:
        """What the detector shows on average, low kV first.

        Args:
            thickness_mm: material -> (row, column) path length.
        """
        names = tuple(name for name, values in thickness_mm.items() if np.any(values > 0)) or tuple(thickness_mm)[:1]
        shape = self.twin.maps.shape
        for name in names:
            if np.shape(thickness_mm[name]) != shape:
                raise InputError(
                    f"thickness of {name}",
                    received=f"{np.shape(thickness_mm[name])} pixels",
                    expected=f"{shape}, as the twin's detector",
                )
        stack = np.stack([np.asarray(thickness_mm[name], dtype=np.float32) for name in names])
        scale = self._effects[0].attenuation_scale(names)
        moments = moments_behind(stack, names, twin=self.twin, channels=self._channels, scale=scale)
        lengths = {name: np.asarray(thickness_mm[name], dtype=np.float64) for name in names}
        images = []
        for effects, planes in zip(self._effects, moments, strict=True):
            signal, variance = (plane.repeat(FINE, axis=0).repeat(FINE, axis=1) for plane in planes)
            images.append(effects.image(signal, variance, lengths, focal_blur_px=self.geometry.focal_blur_px))
        return tuple(images)

    def draw(self, expected: Sequence[AffectedImage], rng: np.random.Generator) -> NDArray[np.float32]:
        """-ln(I / I0) (2, row, column) with noise of its own, divided by the flat of the line as it is now."""
        planes = []
        for effects, image in zip(self._effects, expected, strict=True):
            counts = effects.sample(image, rng)
            planes.append(
                flat_corrected_log(counts, dark_DN=effects.dark_DN, flat_DN=effects.flat_DN + effects.dark_DN)
            )
        return np.stack(planes)

    def contrast(self, expected: Sequence[AffectedImage], mask: NDArray[np.bool_]) -> float:
        """Delta R (no unit) of a foreign object in the images without noise; NaN where there is none or it has no ring."""
        if not mask.any():
            return float("nan")
        try:
            low, high = (image.log_image for image in expected)
            return delta_r(low, high, mask, dilations=dilations_for_pixel(self.geometry.pixel_mm))
        except InputError:
            return float("nan")


def _without_effects(model: ChannelModel) -> ImageEffects:
    """The way through the line of a twin that has no effects."""
    level = predict_flatfield(model.twin, replace(model.target, averaged=1)).mean_DN.value
    return ImageEffects(
        twin=model.twin,
        effects=(),
        setting=model.target,
        open_signal_DN=model.open_signal_DN,
        open_level_DN=level,
        gain_DN=model.gain_DN,
        secondary_DN=model.secondary_DN,
        dark_DN=model.dark_DN,
        read_variance_DN2=model.read_variance_DN2,
        product_material=model.product_material,
        instrument=model.instrument,
    )


def generate_known_scenes(
    twin: Twin,
    scenes: Sequence[KnownScene],
    out: str | os.PathLike[str],
    *,
    low: Setting,
    high: Setting,
    draws: int,
    seed: int,
    product_material: str,
) -> tuple[str, ...]:
    """Write `draws` images of every scene, each with noise of its own, to a dataset file; returns warnings.

    Noise depends on the seed, the scene's place and the draw, so that an effect that changes no picture changes no pixel.
    Images are named `SCENE`, `SCENE#2` and so on.

    Raises:
        InputError: see `KnownScenes`; no scene.
    """
    if draws < 1:
        raise InputError("draws", received=draws, expected="1 or more")
    line = KnownScenes(twin, low=low, high=high, product_material=product_material)
    provenance = {
        "setting_low": str(low),
        "setting_high": str(high),
        "seed": seed,
        "source": "path lengths of an acquisition's scenes",
        **effects_provenance(twin),
    }
    with write_dataset(out, shape=twin.maps.shape, provenance=provenance) as writer:
        for place, scene in enumerate(scenes):
            expected = line.expected(scene.thickness_mm)
            for draw in range(draws):
                name = scene.row.image if draw == 0 else f"{scene.row.image}#{draw + 1}"
                writer.append(
                    image=line.draw(expected, np.random.default_rng([seed, _NOISE, place, draw])),
                    foreign_object_mask=scene.foreign_object_mask,
                    product_mask=scene.product_mask,
                    row=replace(scene.row, image=name, setting=";".join(map(str, line.settings))),
                )
    return tuple(dict.fromkeys(line.warnings))

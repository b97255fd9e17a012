"""Effects that no catalogue of the twin holds: what a diagnosis must call unknown, with its place."""

import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .chain import FrameContext, Stage
from .effect import Asked, EffectLaw, Site, effect_law, planted
from .effects_detector import Map, frame_rng, mixed_gaussians
from .line import Planted


def _tile_offsets(request: Asked, site: Site) -> Planted:
    rng, shape = site.rng, (site.system.rows, site.system.columns)
    tile = int(rng.choice([32, 48, 64]))
    row_of, column_of = np.arange(shape[0]) // tile, np.arange(shape[1]) // tile
    rms_DN = request.strength * site.system.read_noise_DN

    def wander(level_DN: Map, context: FrameContext) -> Map:
        offsets = frame_rng(context, 13).standard_normal((row_of[-1] + 1, column_of[-1] + 1)).astype(np.float32)
        offsets *= np.float32(rms_DN / math.sqrt(context.summed))
        moved: Map = level_DN + offsets[row_of][:, column_of]
        return moved

    return planted(
        request,
        "a baseline that wanders from frame to frame, tile by tile",
        {"tile_px": tile},
        stages=(("readout", Stage(name="tile_offsets", apply=wander)),),
    )


def _digitised(level: NDArray[Any], context: FrameContext) -> NDArray[np.uint16]:
    numbers: NDArray[np.uint16] = np.clip(np.rint(level), 0, context.system.saturation_DN).astype(np.uint16)
    return numbers


def _sharpening(request: Asked, site: Site) -> Planted:
    amount, sigma_px = request.strength / 100.0, float(site.rng.uniform(0.8, 2.0))

    def sharpen(numbers: NDArray[Any], context: FrameContext) -> NDArray[Any]:
        image = numbers.astype(np.float32)
        return _digitised(image + np.float32(amount) * (image - mixed_gaussians(image, ((1.0, sigma_px),))), context)

    return planted(
        request,
        "an unsharp mask in the firmware",
        {"sigma_px": sigma_px},
        stages=(("digitise", Stage(name="sharpening", apply=sharpen, additive=False)),),
    )


def _compression(request: Asked, site: Site) -> Planted:
    step = request.strength
    # Fine detail is stored coarser, as in picture formats.
    frequency = np.arange(8)
    steps = step * (1.0 + 0.5 * (frequency[:, None] + frequency[None, :]))
    steps[0, 0] = 1.0

    def squeeze(numbers: NDArray[Any], context: FrameContext) -> NDArray[Any]:
        from scipy.fft import dctn, idctn

        rows, columns = numbers.shape
        image = np.pad(numbers.astype(np.float32), ((0, -rows % 8), (0, -columns % 8)), mode="edge")
        blocks = image.reshape(image.shape[0] // 8, 8, image.shape[1] // 8, 8).transpose(0, 2, 1, 3)
        stored = np.rint(dctn(blocks, axes=(2, 3), norm="ortho") / steps) * steps
        back = idctn(stored, axes=(2, 3), norm="ortho").transpose(0, 2, 1, 3).reshape(image.shape)
        return _digitised(back[:rows, :columns], context)

    return planted(
        request,
        "8 x 8 blocks of cosine waves in steps that grow with their frequency",
        {},
        stages=(("digitise", Stage(name="compression", apply=squeeze, additive=False)),),
    )


def _lookup_table(request: Asked, site: Site) -> Planted:
    waves = float(np.exp(site.rng.uniform(np.log(6.0), np.log(40.0))))  # over the range of the numbers
    begins = float(site.rng.uniform(0.0, 2.0 * math.pi))

    def look_up(numbers: NDArray[Any], context: FrameContext) -> NDArray[Any]:
        phase = 2.0 * math.pi * waves / context.system.saturation_DN * numbers.astype(np.float64) + begins
        return _digitised(numbers + request.strength * (np.sin(phase) - math.sin(begins)), context)

    return planted(
        request,
        "a look-up table that waves over the range of the numbers",
        {"waves": waves},
        stages=(("digitise", Stage(name="lookup_table", apply=look_up, additive=False)),),
    )


_unknown = partial(effect_law, since="calibration", known=False)

UNKNOWN_LAWS: tuple[EffectLaw, ...] = (
    _unknown("unknown:tile_offsets", "offsets of tiles that wander", "read-noise sigmas", (0.05, 1.5), _tile_offsets),
    _unknown("unknown:sharpening", "sharpening in the firmware", "%", (3.0, 80.0), _sharpening),
    _unknown("unknown:compression", "lossy compression", "DN", (8.0, 200.0), _compression),
    _unknown("unknown:lookup_table", "a look-up table that waves", "DN", (20.0, 400.0), _lookup_table),
)

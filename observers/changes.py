"""What limits a setting: how much smaller its a90 would be with more quanta, less motion, quieter electronics or better networks.

Each change halves one source of noise or blur and leaves the others as they are, so that the factors of a90 can be compared:
twice the quanta (both images, as by twice the frames), half the belt speed, half the electronic variance, half the internal noise (as
a variance) of the networks that the observer stands for.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Setting
from .line_images import LineImages
from .objects import ForeignObjects
from .observe import Observer, observe_settings
from .texture import ProductTexture

FloatArray = NDArray[np.float64]
Pair = tuple[Setting, Setting]


def factors_of_changes(
    line: LineImages,
    pairs: Sequence[Pair],
    objects: ForeignObjects,
    *,
    observer: Observer,
    texture: ProductTexture | None = None,
) -> dict[str, FloatArray]:
    """a90 after each change over a90 before it (setting,), by the change's name; NaN where there is no a90.

    Args:
        line, pairs, objects, observer, texture: as of `observe_settings`.

    Raises:
        InputError: as `observe_settings`.

    Source: Barrett & Myers, Foundations of Image Science (2004), ch. 13 (the observer's noise is a sum of sources).
    """

    def a90(seen: LineImages, settings: Sequence[Pair], who: Observer) -> FloatArray:
        return observe_settings(seen, settings, objects, observer=who, texture=texture).a90_of_curve

    before = a90(line, pairs, observer)
    found = {"quanta": a90(line, [_each(pair, _twice) for pair in pairs], observer) / before}
    if any(one.belt_speed_mm_s for pair in pairs for one in pair):
        found["motion"] = a90(line, [_each(pair, _slower) for pair in pairs], observer) / before
    noise = line.twin.noise
    if noise.read_noise_DN.value > 0:
        quieter = replace(line.twin, noise=replace(noise, read_noise_DN=noise.read_noise_DN.times(0.5**0.5)))
        found["electronics"] = a90(LineImages(quieter), pairs, observer) / before
    if observer.internal_noise > 0:
        calmer = replace(observer, internal_noise=observer.internal_noise * 0.5**0.5)
        found["networks"] = a90(line, pairs, calmer) / before
    return found


def _each(pair: Pair, change: Callable[[Setting], Setting]) -> Pair:
    return change(pair[0]), change(pair[1])


def _twice(setting: Setting) -> Setting:
    return replace(setting, averaged=2 * setting.averaged)


def _slower(setting: Setting) -> Setting:
    speed = setting.belt_speed_mm_s
    return setting if speed is None else replace(setting, belt_speed_mm_s=0.5 * speed)

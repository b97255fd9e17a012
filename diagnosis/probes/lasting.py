"""Pixels whose level stays for some frames and jumps: noisier than others, and alike from one frame to the next.

Of independent Gaussian values the ratio of the variance from successive differences to that of the stack does not depend on the
stack's variance, has mean 1 and variance (n - 2) / (n^2 - 1): so both limits are passed by chance as often as their chances' product.

Source: von Neumann, Ann. Math. Statist. 12 (1941) 367-395, doi:10.1214/aoms/1177731677.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...generator.line.line_state import TelegraphPixels
from ..arrays import BoolArray, FloatArray, RealArray
from ..session.even_maps import NEIGHBOURS_PX

LEAST_FRAMES = 10  # below, levels that last and chance are too much alike
BY_CHANCE = 1e-6  # of a quiet pixel: one in sixty panels of 128 x 128 pixels
_NOISIER, _MEMORY_SD = 1e-4, 2.326  # chance of such a variance; standard deviations that one in a hundred passes
_MOST = 0.15  # share of the pixels; more of them are a picture that fades, not pixels that jump
_MOST_AROUND = 0.35  # the same of the neighbours of one: of 10 % by chance one square in 500
_DRAWN = 4000  # pixels of which chances are counted: 1 % of a share of one half
_SEED = 0x7E1E
OUTLYING = 8.0  # standard deviations of its mean from which a pixel stands out


@lru_cache(maxsize=64)
def _limits(frames: int) -> tuple[float, float]:
    """Stack variance over the pixels' median, and share of it that lasts, from which a pixel's level lasts."""
    from scipy.special import gammainccinv

    half = 0.5 * (frames - 1)
    memory = _MEMORY_SD * math.sqrt((frames - 2.0) / (frames**2 - 1.0))
    return float(gammainccinv(half, _NOISIER) / gammainccinv(half, 0.5)), memory


def lasting_pixels(
    stack_variance_DN2: RealArray, pair_variance_DN2: RealArray, frames: int, good: BoolArray, *, least_DN2: float
) -> BoolArray:
    """Good pixels (row, column) whose level lasts in a dark of so many frames; none where frames have no noise of least_DN2.

    Where most of those around do as well, a picture fades.
    """
    from scipy.ndimage import uniform_filter

    none = np.zeros(good.shape, dtype=bool)
    if frames < LEAST_FRAMES or not good.any():
        return none
    usual = float(np.median(stack_variance_DN2[good]))
    if usual < least_DN2:
        return none
    noisier, memory = _limits(frames)
    noisy = good & (stack_variance_DN2 > noisier * usual)
    lasts = pair_variance_DN2 < (1.0 - memory) * stack_variance_DN2
    found: BoolArray = noisy & lasts
    around = uniform_filter(found.astype(np.float64), NEIGHBOURS_PX, mode="constant")
    found &= around < _MOST_AROUND
    return found if np.count_nonzero(found) < _MOST * np.count_nonzero(good) else none


def chances(law: TelegraphPixels | None, darks: tuple[tuple[int, int], ...]) -> tuple[float, list[float], float]:
    """Chances of a pixel that jumps: its level lasts in any dark; it stands out in each, or in any, but lasts in none.

    darks: frames of each dark, and exposures a frame.
    """
    if law is None or law.share == 0.0 or not darks:
        return 0.0, [0.0] * len(darks), 0.0
    lasts, out = _in_darks(_like(law), darks)
    return float(lasts.mean()), [float((one & ~lasts).mean()) for one in out], float((out.any(axis=0) & ~lasts).mean())


def chance_in_flat(
    law: TelegraphPixels, darks: tuple[tuple[int, int], ...], frames: int, averaged: int, limit_reads: float
) -> float:
    """Chance of a pixel that jumps to last in no dark but to depart in a flat's mean by more than a limit, read noises."""
    if not darks:
        return 0.0
    lasts, _ = _in_darks(_like(law), darks)
    height_reads, levels = _levels(_like(law), frames, averaged, len(darks))
    return float((~lasts & (height_reads * levels.mean(axis=0) / averaged > limit_reads)).mean())


def _like(law: TelegraphPixels) -> TelegraphPixels:
    """The same law for any share of the pixels, wherever they are."""
    height, stay = round(law.amplitude_reads, 2), round(law.stay_exposures, 2)
    return replace(law, share=1.0, seed=0, amplitude_reads=height, stay_exposures=stay)


@lru_cache(maxsize=64)
def _in_darks(law: TelegraphPixels, darks: tuple[tuple[int, int], ...]) -> tuple[BoolArray, BoolArray]:
    """Whether drawn pixels that jump last in any dark (pixel,), and stand out of each (dark, pixel)."""
    lasts, stands = np.zeros(_DRAWN, dtype=bool), []
    for number, (frames, averaged) in enumerate(darks):
        height_reads, levels = _levels(law, frames, averaged, number)
        noise = np.random.default_rng([_SEED, number]).standard_normal((frames, _DRAWN)) / math.sqrt(averaged)
        value = height_reads / averaged * levels + noise
        stands.append(np.abs(value.mean(axis=0)) > OUTLYING / math.sqrt(frames * averaged))
        if frames >= LEAST_FRAMES:
            noisier, memory = _limits(frames)
            stack, pair = value.var(axis=0, ddof=1), 0.5 * np.mean(np.diff(value, axis=0) ** 2, axis=0)
            lasts |= (stack > noisier / averaged) & (pair < (1.0 - memory) * stack)
    return lasts, np.array(stands)


@lru_cache(maxsize=128)
def _levels(law: TelegraphPixels, frames: int, averaged: int, number: int) -> tuple[FloatArray, FloatArray]:
    """Heights of drawn pixels, read noises (pixel,), and exposures of each frame in which they are up (frame, pixel)."""
    height_reads, stay = law.of_pixels(_DRAWN, np.random.default_rng(_SEED))
    rng = np.random.default_rng([_SEED, number, frames])
    up = rng.random(_DRAWN) < 0.5
    levels = np.zeros((frames, _DRAWN))
    for exposure in range(frames * averaged):
        levels[exposure // averaged] += up
        up = up ^ (rng.random(_DRAWN) < 1.0 / stay)
    return height_reads, levels

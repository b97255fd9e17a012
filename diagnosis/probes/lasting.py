"""Pixels whose level stays for some frames and jumps: noisier than others, and alike from one frame to the next.

Of independent Gaussian values the ratio of the variance from successive differences to that of the stack does not depend on the
stack's variance, has mean 1 and variance (n - 2) / (n^2 - 1): so both limits are passed by chance as often as their chances' product.

Source: von Neumann, Ann. Math. Statist. 12 (1941) 367-395, doi:10.1214/aoms/1177731677.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...generator.line.line_state import TelegraphPixels

LEAST_FRAMES = 10  # below, levels that last and chance are too much alike
BY_CHANCE = 1e-6  # of a quiet pixel: one in sixty panels of 128 x 128 pixels
_NOISIER, _MEMORY_SD = 1e-4, 2.326  # chance of such a variance; standard deviations that one in a hundred passes
_MOST = 0.15  # share of the pixels; more of them are a picture that fades, not pixels that jump
_AROUND_PX, _MOST_AROUND = 5, 0.35  # the same of a square around one: of 10 % by chance one square in 500
_DRAWN = 4000  # pixels of which chances are counted: 1 % of a share of one half
_OUTLYING = 8.0  # standard deviations of its mean from which a pixel stands out, as in `model.defects`


@lru_cache(maxsize=64)
def _limits(frames: int) -> tuple[float, float]:
    """Stack variance over the pixels' median, and share of it that lasts, from which a pixel's level lasts."""
    from scipy.special import gammainccinv

    half = 0.5 * (frames - 1)
    memory = _MEMORY_SD * math.sqrt((frames - 2.0) / (frames**2 - 1.0))
    return float(gammainccinv(half, _NOISIER) / gammainccinv(half, 0.5)), memory


def lasting_pixels(
    stack_variance_DN2: NDArray[np.floating],
    pair_variance_DN2: NDArray[np.floating],
    frames: int,
    good: NDArray[np.bool_],
    *,
    least_DN2: float,
) -> NDArray[np.bool_]:
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
    found: NDArray[np.bool_] = noisy & lasts
    around = uniform_filter(found.astype(np.float64), _AROUND_PX, mode="constant")
    found &= around < _MOST_AROUND
    return found if np.count_nonzero(found) < _MOST * np.count_nonzero(good) else none


def chances(law: TelegraphPixels | None, darks: tuple[tuple[int, int], ...]) -> tuple[float, list[float], float]:
    """Chances of a pixel that jumps: its level lasts in any dark; it stands out in each, or in any, but lasts in none.

    Args:
        law: None: no pixel jumps.
        darks: frames of each dark, and exposures a frame.
    """
    if law is None or law.share == 0.0:
        return 0.0, [0.0] * len(darks), 0.0
    each = [
        _chances_in_one(round(law.amplitude_reads, 2), round(law.stay_exposures, 2), frames, averaged)
        for frames, averaged in darks
    ]
    in_none = math.prod(1.0 - lasts for lasts, _ in each)
    out = [in_none / max(1.0 - lasts, 1e-9) * stands for lasts, stands in each]
    quiet = math.prod(1.0 - lasts - stands for lasts, stands in each)
    return 1.0 - in_none, out, in_none - quiet


@lru_cache(maxsize=512)
def _chances_in_one(amplitude_reads: float, stay_exposures: float, frames: int, averaged: int) -> tuple[float, float]:
    """Chances that a pixel that jumps lasts in one dark, and that it does not but its mean stands out; counted in drawn pixels."""
    rng = np.random.default_rng(0x7E1E)
    up = rng.random(_DRAWN) < 0.5
    levels = np.zeros((frames, _DRAWN))
    for number in range(frames * averaged):
        levels[number // averaged] += up
        up = up ^ (rng.random(_DRAWN) < 1.0 / stay_exposures)
    noise = rng.standard_normal((frames, _DRAWN)) / math.sqrt(averaged)
    value = amplitude_reads / averaged * levels + noise
    out = np.abs(value.mean(axis=0)) > _OUTLYING / math.sqrt(frames * averaged)
    if frames < LEAST_FRAMES:
        return 0.0, float(out.mean())
    noisier, memory = _limits(frames)
    stack = value.var(axis=0, ddof=1)
    lasts = (stack > noisier / averaged) & (0.5 * np.mean(np.diff(value, axis=0) ** 2, axis=0) < (1.0 - memory) * stack)
    return float(lasts.mean()), float((out & ~lasts).mean())

"""Large panels: sessions are diagnosed with binned pixels, and the answer is put in terms of the panel's own.

Every probe and every response is a picture of the panel; at 760 x 956 they would fill the memory of a large machine and
take hours, for effects of which most are as plain in a fortieth of the pixels.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from ...generator.effects import EFFECTS, Parameter

LEAST_SIDE = 16  # rows and columns below which pictures say nothing
LARGEST_PIXELS = 2**15  # of a frame that is diagnosed as it is


def bin_factor(shape: tuple[int, int]) -> int:
    """Pixels along each side of the squares to average, so that a frame has no more than LARGEST_PIXELS.

    Fewer where a long strip would be left with less than LEAST_SIDE rows or columns.
    """
    factor = max(1, math.floor(math.sqrt(shape[0] * shape[1] / LARGEST_PIXELS)))
    while (shape[0] // factor) * (shape[1] // factor) > LARGEST_PIXELS:
        factor += 1
    return max(1, min(factor, min(shape) // LEAST_SIDE))


def lost_by_binning() -> dict[str, str]:
    """Why effects cannot be seen in squares of pixels, by id."""
    return {effect.id: effect.lost_by_binning for effect in EFFECTS.values() if effect.lost_by_binning}


def per_bin(parameter: Parameter, factor: int) -> Parameter:
    """A parameter with its range as it is where squares stand for pixels."""
    share = parameter.pixels_per_bin(factor)
    return replace(parameter, low=parameter.low / share, high=parameter.high / share, default=parameter.default / share)


def parameters_in_pixels(effect: str, parameters: Mapping[str, float], factor: int) -> dict[str, float]:
    """Parameters of an effect, strength with them, that were found with squares of pixels."""
    return {name: value * EFFECTS[effect].pixels_per_bin(name, factor) for name, value in parameters.items()}

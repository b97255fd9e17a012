"""Large panels: sessions are diagnosed with coarser pixels, and the answer is put in terms of the panel's own.

Every probe and every response is a picture of the panel; at 760 x 956 they would fill the memory of a large machine and
take hours, for effects of which most are as plain in a fortieth of the pixels.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from ..generator.effects.effect import Parameter

LEAST_SIDE = 16  # rows and columns below which pictures say nothing
LARGEST_PIXELS = 2**15  # of a frame that is diagnosed as it is
UNSEEN = {"quantisation": "codes are lost where frames are averaged"}


def coarse_factor(shape: tuple[int, int]) -> int:
    """Pixels along each side of the squares to average, so that a frame has no more than LARGEST_PIXELS.

    Fewer where a long strip would be left with less than LEAST_SIDE rows or columns.
    """
    factor = max(1, math.floor(math.sqrt(shape[0] * shape[1] / LARGEST_PIXELS)))
    while (shape[0] // factor) * (shape[1] // factor) > LARGEST_PIXELS:
        factor += 1
    return max(1, min(factor, min(shape) // LEAST_SIDE))


def pixels_in_square(effect: str, name: str, factor: int) -> float:
    """By what a parameter that was found in squares is multiplied to mean pixels."""
    if (effect, name) in (("motion_blur", "strength"), ("misregistration", "strength"), ("mtf_tail", "reach_px")):
        return float(factor)  # lengths
    if name != "strength":
        return 1.0
    if effect == "bad_pixels":
        return 1.0 / factor**2  # a bad pixel spoils its square
    if effect == "row_noise":
        return 1.0 / math.sqrt(factor)  # over the read noise, which falls with the side, the line's with its root
    if effect == "gain_map_error":
        return float(factor)  # of a pattern from pixel to pixel
    return 1.0


def in_squares(effect: str, parameter: Parameter, factor: int) -> Parameter:
    """A parameter with its range as it is where squares stand for pixels."""
    share = pixels_in_square(effect, parameter.name, factor)
    return replace(parameter, low=parameter.low / share, high=parameter.high / share, default=parameter.default / share)


def parameters_in_pixels(effect: str, parameters: Mapping[str, float], factor: int) -> dict[str, float]:
    """Parameters of an effect, strength with them, that were found with squares of pixels."""
    return {name: value * pixels_in_square(effect, name, factor) for name, value in parameters.items()}

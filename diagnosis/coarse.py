"""Large panels: sessions are diagnosed with coarser pixels, and the answer is put in terms of the panel's own.

Every probe and every response is a picture of the panel; at 760 x 956 they would fill the memory of a large machine and
take hours, for effects of which most are as plain in a fortieth of the pixels.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from ..generator.effects import AppliedEffect
from ..generator.effects.effect import Parameter
from ..generator.twin import Twin
from .known_effects import with_found

if TYPE_CHECKING:
    from .diagnose import Diagnosis

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


def in_pixels(diagnosis: "Diagnosis", *, twin: Twin, factor: int) -> "Diagnosis":
    """A diagnosis made with squares of pixels, in terms of the panel's pixels.

    Args:
        diagnosis: of the coarser session.
        twin: the panel's own, calibrated from the same series.
        factor: pixels along each side of a square.
    """
    added = tuple(
        AppliedEffect(
            id=item.id,
            parameters=parameters_in_pixels(item.id, item.parameters, factor),
            since=item.since,
            options=item.options,
        )
        for item in diagnosis.added
    )
    causes = []
    for cause in diagnosis.causes:
        share = pixels_in_square(cause.effect, "strength", factor)
        value, low, high = cause.strength
        causes.append(
            replace(
                cause,
                strength=(share * value, share * low, share * high),
                parameters=parameters_in_pixels(cause.effect, cause.parameters, factor),
            )
        )
    rows, columns = twin.maps.shape
    text = (
        f"frames of {rows} x {columns} were compared as means of {factor} x {factor} pixels: what is finer than that (codes,"
        " sharpness and texture within some pixels) is hardly seen; diagnose a part of the panel for it"
    )
    return replace(
        diagnosis,
        added=added,
        causes=tuple(causes),
        twin=replace(twin, effects=with_found(twin.effects, added)),
        not_tested={**diagnosis.not_tested, **UNSEEN},
        notes=(*diagnosis.notes, text),
    )

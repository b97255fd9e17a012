"""The catalogue of effects: each is a change of the forward model at one stage, with parameters and a strength.

A new effect is one definition in one of these files and one line in `EFFECTS`.
"""

from collections.abc import Sequence

from ..line_state import STAGES
from .beam import COMPOSITION_ERROR, FILTRATION_ERROR, HEEL, KV_ERROR
from .drift import DARK_DRIFT, OUTPUT_DRIFT
from .effect import AppliedEffect, Effect, Parameter
from .fluorescence import K_FLUORESCENCE
from .glare import VEILING_GLARE
from .lag import IMAGE_LAG
from .readout import BAD_PIXELS, QUANTISATION, ROW_NOISE
from .registration import MISREGISTRATION
from .response import EXCESS_NOISE, GAIN_MAP_ERROR, NONLINEARITY
from .scatter import OBJECT_SCATTER
from .sharpness import FOCAL_SPOT, MOTION_BLUR, MTF_TAIL

# within a stage effects act in this order
EFFECTS: dict[str, Effect] = {
    effect.id: effect
    for effect in (
        MISREGISTRATION,
        OBJECT_SCATTER,
        VEILING_GLARE,
        FOCAL_SPOT,
        MTF_TAIL,
        K_FLUORESCENCE,
        IMAGE_LAG,
        NONLINEARITY,
        DARK_DRIFT,
        OUTPUT_DRIFT,
        KV_ERROR,
        FILTRATION_ERROR,
        HEEL,
        ROW_NOISE,
        BAD_PIXELS,
        EXCESS_NOISE,
        QUANTISATION,
        MOTION_BLUR,
        GAIN_MAP_ERROR,
        COMPOSITION_ERROR,
    )
}

__all__ = [
    "EFFECTS",
    "AppliedEffect",
    "Effect",
    "Parameter",
    "effect_of",
    "in_order",
]


def effect_of(applied: AppliedEffect) -> Effect:
    """The catalogue's entry of an applied effect.

    Raises:
        InputError: an id that the catalogue does not hold.
    """
    from difflib import get_close_matches

    from ...errors import InputError

    if applied.id not in EFFECTS:
        near = get_close_matches(applied.id, EFFECTS, n=1, cutoff=0.0)
        raise InputError(
            "effect", received=applied.id, expected="one of " + ", ".join(EFFECTS), remedy=f"did you mean {near[0]}?"
        )
    return EFFECTS[applied.id]


def in_order(effects: Sequence[AppliedEffect]) -> tuple[tuple[AppliedEffect, Effect, dict[str, float]], ...]:
    """Effects with their entries and all their parameters, in the order in which they act.

    Raises:
        InputError: an unknown effect or parameter.
    """
    places = {name: position for position, name in enumerate(EFFECTS)}
    found = [(applied, effect_of(applied)) for applied in effects]
    found.sort(key=lambda pair: (STAGES.index(pair[1].stage), places[pair[1].id]))
    return tuple((applied, effect, effect.values(applied.parameters)) for applied, effect in found)

"""The catalogue of effects: each is a change of the forward model at one stage, with all that others need to know of it.

A new effect is one file here and one line in `OURS`; or, in another package, an `Effect` under an entry point of the group
`raytwin.effects`.
"""

from collections.abc import Sequence
from difflib import get_close_matches

from ...errors import InputError
from ..line.applied_effect import AppliedEffect
from ..line.line_state import STAGES
from .bad_pixels import BAD_PIXELS
from .burn_in import BURN_IN
from .catalogue import GROUP, Catalogue
from .composition_error import COMPOSITION_ERROR
from .crosstalk import CROSSTALK
from .dark_drift import DARK_DRIFT
from .dropped_frames import DROPPED_FRAMES
from .effect import (
    EVERY_SERIES,
    LIT_SERIES,
    AlwaysALittle,
    Displacement,
    Effect,
    Grid,
    InImages,
    Parameter,
    Placement,
    Reading,
    Shows,
    Variation,
)
from .excess_noise import EXCESS_NOISE
from .filtration_error import FILTRATION_ERROR
from .focal_spot import FOCAL_SPOT
from .gain_map_error import GAIN_MAP_ERROR
from .grey_absorber import GREY_ABSORBER
from .heel import HEEL
from .image_lag import IMAGE_LAG
from .k_fluorescence import K_FLUORESCENCE
from .kv_error import KV_ERROR
from .line_flicker import LINE_FLICKER
from .misregistration import MISREGISTRATION
from .motion_blur import MOTION_BLUR
from .mtf_tail import MTF_TAIL
from .nonlinearity import NONLINEARITY
from .object_scatter import OBJECT_SCATTER
from .off_focal import OFF_FOCAL
from .output_drift import OUTPUT_DRIFT
from .pile_up import PILE_UP
from .quantisation import QUANTISATION
from .random_telegraph import RANDOM_TELEGRAPH
from .row_noise import ROW_NOISE
from .threshold_error import THRESHOLD_ERROR
from .tile_gain import TILE_GAIN
from .veiling_glare import VEILING_GLARE

# within a stage effects act in this order, those of other packages after ours
OURS: dict[str, Effect] = {
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
        TILE_GAIN,
        COMPOSITION_ERROR,
        CROSSTALK,
        LINE_FLICKER,
        GREY_ABSORBER,
        DROPPED_FRAMES,
        OFF_FOCAL,
        RANDOM_TELEGRAPH,
        BURN_IN,
        PILE_UP,
        THRESHOLD_ERROR,
    )
}
EFFECTS = Catalogue(OURS)

__all__ = [
    "EFFECTS",
    "EVERY_SERIES",
    "GROUP",
    "LIT_SERIES",
    "OURS",
    "AlwaysALittle",
    "AppliedEffect",
    "Catalogue",
    "Displacement",
    "Effect",
    "Grid",
    "InImages",
    "Parameter",
    "Placement",
    "Reading",
    "Shows",
    "Variation",
    "effect_of",
    "in_order",
]


def effect_of(applied: AppliedEffect) -> Effect:
    """The catalogue's entry of an applied effect.

    Raises:
        InputError: an id that the catalogue does not hold.
    """
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

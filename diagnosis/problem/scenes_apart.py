"""Scenes that are put down one after the other: each lies elsewhere than its maps, by an amount of its own."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...generator.effects import EFFECTS
from ..arrays import IndexArray
from ..model.changes import EACH_SCENE
from ..model.curves import LEAST_RESPONSE, Curve

# along rows and along columns; what a scene is turned besides is left to the law's discrepancy
_WAYS_DEG = (0.0, 90.0)


def scenes_apart(
    curves: Sequence[Curve], places: Sequence[object | None], names: Sequence[str], series_of: IndexArray
) -> Curve | None:
    """What a displacement of each scene by itself does by chance, its rms over all scenes the strength: a curve without a mean.

    places: where each series' scene stood, None: it has none; series_of: number of each probe's series (probe,). None: there are not
    two scenes that an effect of the curves moves.
    """
    ways = [next((curve for curve in curves if _shifts(curve, way)), None) for way in _WAYS_DEG]
    found = [curve for curve in ways if curve is not None]
    columns, seen = [], set[object]()
    for place in dict.fromkeys(place for place in places if place is not None):
        here = np.array([one == place for one in places])[series_of]
        for curve in found:
            column = np.where(here, curve.responses[-1] / curve.strengths[-1] / math.sqrt(len(_WAYS_DEG)), 0.0)
            if float(np.max(np.abs(column))) > LEAST_RESPONSE:
                columns.append(column)
                seen.add(place)
    if len(seen) < 2:
        return None
    variant = replace(
        found[0].variant,
        name=EACH_SCENE,
        parameters={},
        fitted=(),
        series=tuple(name for name, place in zip(names, places, strict=True) if place in seen),
        apart=True,
    )
    return Curve(variant=variant, responses=np.zeros_like(found[0].responses), spread=np.stack(columns, axis=1))


def _shifts(curve: Curve, direction_deg: float) -> bool:
    """Whether a curve's effect does nothing but shift scenes in a direction."""
    placement = EFFECTS[curve.effect].placement
    if placement is None:
        return False
    lies = placement.parts({**curve.variant.parameters, "strength": 1.0})
    return math.isclose(lies.shift_px, lies.size_px) and lies.direction_deg == direction_deg

"""Scenes as they may be instead: a material thicker, a border where it runs between the points of a map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import RealArray
from ..model import changes as scales
from ..model.point_maps import sampled_at_points
from ..model.responses import Asked, Moved, SeriesModel, SessionModel
from ..probes.straight_edge import covered_scene
from ..session.even_maps import Map

_Maps = Mapping[str, RealArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherScenes:
    """Thickness maps (row, column), mm, of what may stand in a scene's place."""

    thicker: Mapping[str, _Maps]  # one material thicker by THICKNESS_SD, by that material
    # a straight or round border drawn by the share of each pixel that it covers; None: there is none, or drawn so
    covered: _Maps | None

    def drawn(self, session: SessionModel, one: SeriesModel, asked: Asked) -> "Redrawn":
        """What each shows in a series under a change, less what its own scene shows there."""
        return Redrawn(
            thicker={material: session.with_scene(one, maps, asked) for material, maps in self.thicker.items()},
            covered=None if self.covered is None else session.with_scene(one, self.covered, asked)[0],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Redrawn:
    """What other scenes show in a series, by the fields of `OtherScenes`; maps (row, column), DN."""

    thicker: Mapping[str, Moved]
    covered: Map | None


NO_SCENES = OtherScenes(thicker={}, covered=None)


def other_scenes(series: Sequence[SeriesModel]) -> dict[str, OtherScenes]:
    """Other scenes by the name of each series of objects; one object for all series of the same maps, so that each is drawn once."""
    result: dict[str, OtherScenes] = {}
    known: dict[int, OtherScenes] = {}
    factor = np.float32(1.0 + scales.THICKNESS_SD)
    for one in series:
        if one.session.series.kind != "object":
            continue
        asked = one.session.request
        maps = asked.thickness_mm or {}
        if id(asked.thickness_mm) not in known:
            known[id(asked.thickness_mm)] = OtherScenes(
                thicker={
                    material: {name: image * factor if name == material else image for name, image in maps.items()}
                    for material in maps
                },
                covered=covered_scene(asked.scene_kind, maps) if sampled_at_points(maps) else None,
            )
        result[one.name] = known[id(asked.thickness_mm)]
    return result

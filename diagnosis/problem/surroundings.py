"""Light that an effect blurs into the picture from beyond its borders, where nobody knows what stands."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...generator.effects import AppliedEffect
from ..model import changes as scales
from ..model.responses import SessionModel
from .series_probes import SeriesProbes


def light_let_in(session: SessionModel, series: Sequence[SeriesProbes], effect: AppliedEffect) -> NDArray[np.float64]:
    """What an effect may let in by chance (probe, placement of a scene), a unit of its strength.

    That is what comes in if the picture goes on as it ends, less what comes in if it mirrors. An edge that crosses a border and runs
    on straight lets in twice that. Series of one placement have the same surroundings.

    Args:
        session: all series as the base twin expects them.
        series: probes of all of them, in order of time.
        effect: at a strength; it takes the place of the same one, if the base has that.
    """
    with_it, without = session.model.with_found([effect]), session.model.without(effect.id)
    places: dict[tuple[str | None, float | None], int] = {}
    found = []
    for probes in series:
        item = probes.series.session
        if item.series.kind == "object":
            image_DN = session.from_beyond(probes.series, with_it) - session.from_beyond(probes.series, without)
            if image_DN.any():
                place = places.setdefault((item.series.scene, item.request.source_object_mm), len(places))
                a_unit = scales.BEYOND_SD / abs(effect.parameters["strength"])
                found.append((place, probes.of_maps(a_unit * image_DN[None])[0] * probes.shrink))
                continue
        found.append((0, np.zeros(len(probes))))
    result = np.zeros((sum(map(len, series)), max(len(places), 1)))
    start = 0
    for place, column in found:
        result[start : start + len(column), place] = column
        start += len(column)
    return result

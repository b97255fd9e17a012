"""Light that an effect blurs into the picture from beyond its borders, where nobody knows what stands."""

from collections.abc import Sequence

import numpy as np

from ...generator.effects import EFFECTS, AppliedEffect
from ..arrays import FloatArray
from ..model import changes as scales
from ..model.responses import SessionModel
from .series_probes import SeriesProbes


def border_inflow(session: SessionModel, series: Sequence[SeriesProbes], effect: AppliedEffect) -> FloatArray | None:
    """What an effect may let in by chance (probe, placement of a scene), a unit of its strength; None: it brings nothing in.

    That is what comes in if the picture goes on as it ends, less what comes in if it mirrors. An edge that crosses a border and runs
    on straight lets in twice that. Series of one placement have the same surroundings.
    """
    if EFFECTS[effect.id].variation.random != "surroundings":
        return None
    columns = [_of_series(session, probes, effect) for probes in series]
    of = [probes.series.session.place for probes in series]
    places = dict.fromkeys(place for place, column in zip(of, columns, strict=True) if column.any())
    if not places:
        return None
    return np.concatenate(
        [np.outer(column, [one == place for one in places]) for place, column in zip(of, columns, strict=True)]
    )


def _of_series(session: SessionModel, probes: SeriesProbes, effect: AppliedEffect) -> FloatArray:
    """The same of one series (probe,)."""
    if probes.series.session.series.kind != "object":
        return np.zeros(len(probes))
    with_it, without = session.model.with_found([effect]), session.model.without(effect.id)
    image_DN = session.from_beyond(probes.series, with_it) - session.from_beyond(probes.series, without)
    if not image_DN.any():
        return np.zeros(len(probes))
    a_unit = scales.BEYOND_SD / abs(effect.parameters["strength"])
    return np.asarray(probes.of_maps(a_unit * image_DN[None])[0] * probes.shrink)

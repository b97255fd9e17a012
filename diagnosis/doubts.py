"""How effects are known to mislead: what their laws leave, and what sessions without them show of them by chance."""

import numpy as np
from numpy.typing import NDArray

from ..generator.effects import EFFECTS
from .pairs import Doubts
from .probes import ALONG_COLUMNS, ALONG_ROWS, OUTLIERS, OUTLIERS_ANYWHERE
from .problem import Problem
from .registration import SHARP_PX


def doubts_of(problem: Problem) -> Doubts:
    """What is known of how the catalogue's effects mislead in a session."""
    sharp = problem.base.noise.spread.value.sigma_px < SHARP_PX
    known = {effect.id: effect.false_evidence for effect in EFFECTS.values()}
    chance = {name: item.alone_sharp if sharp else item.alone for name, item in known.items()}
    return Doubts(
        chance={name: value for name, value in chance.items() if value > 0.0},
        loose={name: item.leaves for name, item in known.items() if item.leaves > 0.0},
        sharp=frozenset(name for name, item in known.items() if item.edges_alone),
        told=frozenset(name for name, item in known.items() if item.unmistakable),
        elsewhere=_elsewhere(problem),
    )


def _elsewhere(problem: Problem) -> dict[str, NDArray[np.bool_]]:
    """Probes (probe,) that each effect cannot move, however wrong its law, by effect."""
    of_places = np.array([name.statistic in (ALONG_ROWS, ALONG_COLUMNS) for name in problem.names])
    of_outliers = np.array([name.statistic in (OUTLIERS, OUTLIERS_ANYWHERE) for name in problem.names])
    result = {}
    for effect in {variant.effect for variant in problem.variants}:
        shows = EFFECTS[effect].shows
        hidden = np.array([view.session.request.kind not in shows.series for view in problem.views], dtype=bool)
        result[effect] = (
            hidden[problem.series_of] | (of_places & (not shows.places)) | (of_outliers & (not shows.single_pixels))
        )
    return result

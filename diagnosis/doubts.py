"""How effects are known to mislead: what their laws leave, and what sessions without them show of them by chance."""

import numpy as np
from numpy.typing import NDArray

from .assemble import Problem
from .forward_model import can_displace, can_show, can_stand_out
from .pairs import Doubts
from .probes import ALONG_COLUMNS, ALONG_ROWS, OUTLIERS, OUTLIERS_ANYWHERE
from .registration import SHARP_PX

# log evidence: of 64 sealed sessions without effect six showed 4 to 8 of a focal spot, edges being drawn no better
_CHANCE = {"focal_spot": 5.0}
# the same where edges are sharper than a third of a pixel, as in squares of pixels: two panels without effect showed 6 of a tail
# and 77 of a focal spot of 0.47 mm, one with a spot of 0.6 mm showed 107
_SHARP_CHANCE = {
    **dict.fromkeys(("mtf_tail", "motion_blur", "misregistration", "k_fluorescence"), 8.0),
    "focal_spot": 80.0,
}
# photons followed one by one reach shadows that no kernel fills: as a rule up to 3e-3 of scatter's log evidence goes to another
# effect, 0.016 where 40 % of scatter filled a wide field
_LOOSE = {"object_scatter": 0.02}
# beside 16 scatters of 3 to 40 % alone these gained nothing (a focal spot 2, once 350 of an evidence of 1.5e7), a dark drift up to
# 3e-3 of scatter's evidence, a tail, K fluorescence and a lag 3e-4
_SHARP = frozenset(("motion_blur", "misregistration", "focal_spot"))
# pixels and codes of their own tell these: a gain map of 0.127 % read 0.097 beside a voltage of 4.8 %
_TOLD = frozenset(("gain_map_error", "bad_pixels", "quantisation"))


def doubts_of(problem: Problem) -> Doubts:
    """What is known of how the catalogue's effects mislead in a session."""
    sharp = problem.base.noise.spread.value.sigma_px < SHARP_PX
    return Doubts(
        chance=_SHARP_CHANCE if sharp else _CHANCE,
        loose=_LOOSE,
        sharp=_SHARP,
        told=_TOLD,
        elsewhere=_elsewhere(problem),
    )


def _elsewhere(problem: Problem) -> dict[str, NDArray[np.bool_]]:
    """Probes (probe,) that each effect cannot move, however wrong its law, by effect."""
    of_places = np.array([name.statistic in (ALONG_ROWS, ALONG_COLUMNS) for name in problem.names])
    of_outliers = np.array([name.statistic in (OUTLIERS, OUTLIERS_ANYWHERE) for name in problem.names])
    result = {}
    for effect in {variant.effect for variant in problem.variants}:
        hidden = np.array([not can_show(effect, view.session.request) for view in problem.views], dtype=bool)
        result[effect] = (
            hidden[problem.series_of]
            | (of_places & (not can_displace(effect)))
            | (of_outliers & (not can_stand_out(effect)))
        )
    return result

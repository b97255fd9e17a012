"""The width of the core where the tail's light has been through the core first.

A tail stands beside the core, H = (1 - w) G + w T, or spreads a share of the core's light once more, H = G (1 - w + w T): a
screen that scatters, and glass behind it. Beyond the core's width they are one curve; beside a short tail the core that fits one
is some per cent wider than the core that fits the other, and noise does not tell which it is.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...generator.spread.psf import Spread

_FREQUENCIES = np.linspace(0.01, 0.5, 50)  # cycles a pixel
_WEIGHTS = np.sqrt(_FREQUENCIES) * np.sinc(_FREQUENCIES)  # of a ring in the plane of frequencies, through square pixels
_NARROWEST_PX, _LONGEST_PX = 0.01, 100.0


def core_before_tail_px(spread: Spread) -> float:
    """Width of the core, px, of the likest spread whose tail spreads the core's light once more.

    Example:
        >>> round(core_before_tail_px(Spread(sigma_px=0.5, tail_share=0.1, tail_px=0.6)), 2)
        0.49
        >>> round(core_before_tail_px(Spread(sigma_px=0.5, tail_share=0.1, tail_px=2.5)), 2)
        0.5
    """
    from scipy.optimize import least_squares

    if spread.tail_share == 0.0 or spread.sigma_px <= _NARROWEST_PX:
        return spread.sigma_px
    wanted = _along(spread)

    def missed(theta: NDArray[np.float64]) -> NDArray[np.float64]:
        sigma_px, share, tail_px = math.exp(theta[0]), float(theta[1]), math.exp(theta[2])
        core = _along(replace(spread, sigma_px=sigma_px, tail_share=0.0))
        tail = _along(replace(spread, sigma_px=0.0, tail_share=1.0, tail_px=tail_px))
        return np.asarray(_WEIGHTS * (core * (1.0 - share + share * tail) - wanted))

    narrow, far = math.log(_NARROWEST_PX), math.log(_LONGEST_PX)
    start = [math.log(spread.sigma_px), spread.tail_share, math.log(spread.tail_px)]
    found = least_squares(missed, start, bounds=([narrow, 0.0, narrow], [far, 1.0, far]))
    return math.exp(found.x[0])


def _along(spread: Spread) -> NDArray[np.float64]:
    """Transfer (frequency,) along one axis, alike along both."""
    return replace(spread, aspect=1.0, axes="both").transfer(_FREQUENCIES, np.zeros(len(_FREQUENCIES)))

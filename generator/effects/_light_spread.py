"""Transfer functions of light that spreads, of any shape: glare, tails and K photons share them."""

import numpy as np

from ..line.line_state import FloatArray
from .effect import Parameter


def spread_transfer(
    f_row: FloatArray, f_column: FloatArray, *, reach_px: float, order: float, usual_order: float
) -> FloatArray:
    """Transfer function (1 + (m / p) (2 pi L f)^2)^-p of light that spreads with reach L, of any shape p.

    p = 1/2 is exp(-R / L) / (2 pi L R), p = 1 a Lorentzian; larger orders come close to a Gaussian. The rms distance is the
    same for all orders; m = `usual_order` is the one for which reach_px is defined. Frequencies in cycles per pixel.
    """
    squared = (2.0 * np.pi * reach_px) ** 2 * (f_row**2 + f_column**2)
    return np.asarray((1.0 + usual_order / order * squared) ** -order)


def order_parameter(usual: float) -> Parameter:
    """The shape of a spread's transfer function."""
    return Parameter(
        name="order",
        unit="",
        low=0.5,
        high=6.0,
        default=usual,
        source="1/2: exponential over distance, 1: Lorentzian, large: Gaussian",
        log=True,
        sought_last=True,
    )

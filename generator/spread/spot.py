"""Image of a focal spot behind what stands in the beam, the spot taken as a Gaussian of its full width at half maximum."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_FWHM_PER_SD = 2.0 * math.sqrt(2.0 * math.log(2.0))


def spot_image_px(size_mm: float, *, magnification: float, pixel_mm: float) -> float:
    """Standard deviation of the spot's image on the detector, px: a (M - 1) / 2.355 / pitch.

    Args:
        size_mm: full width at half maximum a of the spot.
        magnification: M, source-detector over source-object distance.
        pixel_mm: pitch of the detector.

    Example:
        >>> round(spot_image_px(0.4, magnification=1.5, pixel_mm=0.1), 3)
        0.849
    """
    return size_mm * (magnification - 1.0) / _FWHM_PER_SD / pixel_mm


def gaussian_transfer(sigma_px: float) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Transfer function of a Gaussian blur, even in both: (f_row (n, 1), f_column (1, m), cycles per px) -> (n, m)."""

    def transfer(f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        rows, columns = (np.exp(-2.0 * (math.pi * sigma_px * f) ** 2) for f in (f_row, f_column))
        return np.asarray(rows * columns)

    return transfer

"""The contrast of a foreign object in a dual-energy pair: how much it shifts the quotient of the two log images."""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

PRODUCT_THRESHOLD = 0.1
DILATIONS = 21


def delta_r(
    M_low: NDArray[np.floating],
    M_high: NDArray[np.floating],
    foreign_object_mask: NDArray[np.bool_],
    *,
    dilations: int = DILATIONS,
    alone: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None,
) -> float:
    """Contrast of a foreign object (dimensionless): mean quotient in it less mean quotient in a ring around it.

    Equation: Delta R = <q>_object - <q>_ring with q = M_low / M_high. The object is the mask; the ring is
    the mask dilated `dilations` times with the cross of four neighbours, within the product (M_low > 0.1), less the
    mask. Meant for the low-noise pair: the mean of a quotient of noisy images is biased.

    Validity: a ring of 21 pixels belongs to pixels of 0.15 mm (3.2 mm); scale `dilations` for other pixels. Pixels with
    M_high <= 0 carry no quotient and are left out of both means. Beside an edge the ring holds the edge as well, up to forty times
    the contrast of a void in aluminium; where the product without the object is known (`alone`), the same difference of that is
    subtracted, and of both nothing but the object is left.

    Args:
        M_low: (row, column) -log(I/I0) at the low tube voltage.
        M_high: (row, column) the same at the high tube voltage.
        foreign_object_mask: (row, column), True in the foreign object; one object an image.
        dilations: width of the ring in pixels, 1 or more.
        alone: (M_low, M_high) of the same product without the object; None: it is not known.

    Returns:
        Delta R; its sign says whether the object hardens the beam more or less than the product around it.

    Raises:
        InputError: shapes that differ, an empty mask, an object outside the product, or no product around it.

    Source: Andriiashen, van Liere, van Leeuwen, Batenburg, X-ray Image Generation as a Method of Performance
        Prediction for Real-Time Inspection: a Case Study (the definition of Delta R), and its authors' code (the ring).
    """
    inside, ring = object_and_ring(M_low, M_high, foreign_object_mask, dilations=dilations, alone=alone)

    def difference(low: NDArray[np.floating], high: NDArray[np.floating]) -> float:
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        return float(np.mean(low[inside] / high[inside]) - np.mean(low[ring] / high[ring]))

    return difference(M_low, M_high) - (0.0 if alone is None else difference(*alone))


def object_and_ring(
    M_low: NDArray[np.floating],
    M_high: NDArray[np.floating],
    foreign_object_mask: NDArray[np.bool_],
    *,
    dilations: int = DILATIONS,
    alone: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels (row, column) of a foreign object and of the ring of product around it, as `delta_r` compares them.

    Args, errors: as `delta_r`.
    """
    from scipy.ndimage import binary_dilation, generate_binary_structure

    low = np.asarray(M_low, dtype=np.float64)
    high = np.asarray(M_high, dtype=np.float64)
    mask = np.asarray(foreign_object_mask) != 0
    if low.ndim != 2 or low.shape != high.shape or low.shape != mask.shape:
        raise InputError(
            "images and mask",
            received=f"shapes {low.shape}, {high.shape} and {mask.shape}",
            expected="one shape (row, column)",
        )
    check_dilations(dilations)
    if not mask.any():
        raise InputError("foreign-object mask", received="an empty mask", expected="at least one pixel")
    seen = high > 0
    if alone is not None:
        seen &= (np.asarray(alone[0]) > PRODUCT_THRESHOLD) & (np.asarray(alone[1]) > 0)
    inside = mask & seen
    cross = generate_binary_structure(2, 1)
    ring = binary_dilation(mask, structure=cross, iterations=dilations) & (low > PRODUCT_THRESHOLD) & seen & ~mask
    for region, name, needed in (
        (inside, "foreign object", "M_high > 0"),
        (ring, f"ring of {dilations} pixels around it", f"M_low > {PRODUCT_THRESHOLD:g} and M_high > 0"),
    ):
        if not region.any():
            raise InputError(
                f"contrast, {name}",
                received="no pixel inside the product",
                expected=f"pixels with {needed}",
                remedy="check that mask and image belong together",
            )
    return inside, ring


def check_dilations(dilations: int) -> None:
    """Refuse a ring that is no pixel wide."""
    if dilations < 1:
        raise InputError("dilations", received=dilations, expected="1 pixel or more")


def dilations_for_pixel(pixel_mm: float) -> int:
    """Width of the ring (pixels) that is as wide in mm as 21 pixels of 0.15 mm."""
    if not pixel_mm > 0:
        raise InputError("pixel_mm", received=pixel_mm, expected="a pitch above 0 mm")
    return max(1, round(DILATIONS * 0.15 / pixel_mm))

"""Thickness maps that were sampled at points, as rays to the middle of each pixel have them, and not averaged over pixels.

Averaged, a border between two thicknesses shows in the pixels that it cuts where it runs; sampled, it jumps from one pixel to the
next, and where it runs between them is not known to half a pixel.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, RealArray
from ..session.even_maps import local_range

_LEAST_STEP = 0.1  # of the largest thickness, over three pixels' distance
_WHOLE = 0.95  # share of such a step that lies between two neighbours: of borders that cut pixels anywhere, one in ten
_MOSTLY = 0.7  # share of a map's borders
_LEAST_BORDERS = 24  # crossings of lines of pixels
_SMOOTHED = (20, 60, 200)  # times: borders that lean by a third, a twentieth and a fiftieth of a pixel a row
_BLURS_PX = (0.7, 1.5)
_FARTHEST_PX = 6.0  # from a border, beyond which distances are alike


def sampled_at_points(thickness_mm: Mapping[str, RealArray] | None) -> bool:
    """Whether the borders in a scene's maps (row, column), by material, run between pixels and cut none."""
    whole = every = 0
    for image in (thickness_mm or {}).values():
        values = np.asarray(image, dtype=np.float64)
        most = float(values.max(initial=0.0))
        for lines in (values, values.T):
            if lines.shape[1] < 4 or not most > 0.0:
                continue
            steps = np.abs(np.diff(lines, axis=1))
            change = np.abs(lines[:, 3:] - lines[:, :-3])
            middle = steps[:, 1:-1]
            # a border in the middle of four pixels
            crossed = (change > _LEAST_STEP * most) & (middle >= steps[:, :-2]) & (middle > steps[:, 2:])
            every += int(np.count_nonzero(crossed))
            whole += int(np.count_nonzero(crossed & (middle > _WHOLE * change)))
    return every >= _LEAST_BORDERS and whole > _MOSTLY * every


def blurred_between_points(thickness_mm: Mapping[str, RealArray], signal: FloatArray) -> NDArray[np.float32]:
    """What a blur of borders that run smoothly between the points adds to a blur of the jumps (image, row, column), DN.

    A border is taken to run as smoothly as the points allow (three smoothnesses, two blurs): its distance is smoothed, many times,
    and kept to the side that each point says. What is the same all along a border is left out: that is a blur.

    Source: R. T. Whitaker, Reducing aliasing artifacts in iso-surfaces of binary volumes, IEEE Symposium on Volume
        Visualization 2000, 23-32, doi:10.1109/VV.2000.10000.
    """
    from scipy.ndimage import gaussian_filter, gaussian_filter1d

    jump = local_range(signal, 2)
    result = []
    for image in thickness_mm.values():
        thick = np.asarray(image) > 0.5 * float(np.max(image))
        for covered in _smooth_borders(thick):
            added = (thick - covered) * jump
            result += [gaussian_filter(added, blur_px) for blur_px in _BLURS_PX]
    if not result:
        return np.zeros((0, *signal.shape), np.float32)
    # what is alike all along a border is a blur, of which these say nothing
    blurs = [gaussian_filter1d(signal, blur_px, axis=axis) - signal for blur_px in _BLURS_PX for axis in (0, 1)]
    images, known = np.stack(result).reshape(len(result), -1), np.stack(blurs).reshape(len(blurs), -1)
    images -= np.linalg.lstsq(known.T, images.T, rcond=1e-9)[0].T @ known
    return images.reshape(-1, *signal.shape).astype(np.float32)


def _smooth_borders(thick: BoolArray) -> list[FloatArray]:
    """Covered share of pixels (row, column) whose middles lie behind a border or not, as it runs the smoother the longer."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    if thick.all() or not thick.any():
        return []
    distance = np.where(thick, distance_transform_edt(thick) - 0.5, 0.5 - distance_transform_edt(~thick))
    distance = np.clip(distance, -_FARTHEST_PX, _FARTHEST_PX)
    found = []
    for number in range(1, max(_SMOOTHED) + 1):
        distance = gaussian_filter(distance, 1.0, mode="nearest")
        distance = np.where(thick, np.maximum(distance, 0.0), np.minimum(distance, 0.0))
        if number in _SMOOTHED:
            steepness = np.maximum(np.hypot(*np.gradient(distance)), 0.3)
            found.append(np.clip(distance / steepness + 0.5, 0.0, 1.0))
    return found

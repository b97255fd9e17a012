"""The object does not lie where the thickness maps say: shift and magnification.

d(r) = s [cos(b) (cos(a), sin(a)) + sin(b) (r - centre) / rms(r - centre)],  so that the rms of d is s
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..line_state import FloatArray, LineContext, LineState
from .effect import Effect, Parameter


def displacement_px(
    shape: tuple[int, int], *, strength_px: float, direction_deg: float, magnification_deg: float
) -> tuple[FloatArray, FloatArray]:
    """Displacement (row, column) of the picture along rows and along columns, px."""
    row = np.arange(shape[0]) - 0.5 * (shape[0] - 1)
    column = np.arange(shape[1]) - 0.5 * (shape[1] - 1)
    rms = math.sqrt(float(np.mean(row**2) + np.mean(column**2))) or 1.0
    shift = strength_px * math.cos(math.radians(magnification_deg))
    radial = strength_px * math.sin(math.radians(magnification_deg)) / rms
    along_rows = shift * math.cos(math.radians(direction_deg)) + radial * row[:, None] + 0.0 * column[None, :]
    along_columns = shift * math.sin(math.radians(direction_deg)) + radial * column[None, :] + 0.0 * row[:, None]
    return along_rows, along_columns


def _displace(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0 or not context.has_scene or state.signal_DN.shape != context.shape:
        return state
    direction, mix = math.radians(parameters["direction_deg"]), math.radians(parameters["magnification_deg"])
    shift = parameters["strength"] * math.cos(mix)
    before = state.shift_px
    state = replace(state, shift_px=(before[0] + shift * math.cos(direction), before[1] + shift * math.sin(direction)))
    if mix == 0:
        return state
    down, right = displacement_px(
        context.shape,
        strength_px=parameters["strength"] * math.sin(mix),
        direction_deg=0.0,
        magnification_deg=90.0,
    )
    # a magnification moves rows alike in all columns, and columns alike in all rows
    rows, columns = (_resampling(line.tobytes()) for line in (np.ascontiguousarray(down[:, 0]), right[0]))
    moved = [np.maximum(rows @ values @ columns.T, 0.0) for values in (state.signal_DN, state.variance_DN2)]
    return replace(state, signal_DN=moved[0], variance_DN2=moved[1])


@lru_cache(maxsize=32)
def _resampling(displacement_px: bytes) -> FloatArray:
    """Cubic splines through the pixels of a line (pixel,), taken where each pixel comes from: (pixel, pixel)."""
    from scipy.ndimage import map_coordinates

    moved = np.frombuffer(displacement_px)
    line, pixel = np.indices((moved.size, moved.size), dtype=np.float64)
    places = np.stack([line - moved[:, None], pixel])
    return np.asarray(map_coordinates(np.eye(moved.size), places, order=3, mode="nearest"), dtype=np.float64)


MISREGISTRATION = Effect(
    id="misregistration",
    title="object lies elsewhere than its thickness maps",
    parameters=(
        Parameter(
            name="strength",
            unit="px",
            low=0.1,
            high=3.0,
            default=0.5,
            source="rms displacement over the field",
            log=True,
        ),
        Parameter(
            name="direction_deg",
            unit="deg",
            low=0.0,
            high=360.0,
            default=0.0,
            source="of the shift: 0 along rising row index, 90 along rising column index",
            log=False,
        ),
        Parameter(
            name="magnification_deg",
            unit="deg",
            low=-90.0,
            high=90.0,
            default=0.0,
            source="0: all shift; 90: all magnification; -90: all reduction",
            log=False,
        ),
    ),
    stage="arrivals",
    reference="rigid shift and uniform scale",
    after_calibration=False,
    change=_displace,
    needs=("scene",),
)

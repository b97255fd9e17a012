"""Anode heel: exp(-mu_anode tau (o + u + c u^2)), u from -1/2 to 1/2 across the field."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState
from ..line.spectral_signal import OpenBeam
from .effect import LIT_SERIES, Effect, Grid, Parameter, Shows, Variation


def _field_coordinate(shape: tuple[int, int], direction_deg: float) -> FloatArray:
    """-1/2 to 1/2 across the field (row, column), along a direction counted from rows towards columns."""
    angle = math.radians(direction_deg)
    row = (np.arange(shape[0]) - 0.5 * (shape[0] - 1)) / max(shape[0] - 1, 1)
    column = (np.arange(shape[1]) - 0.5 * (shape[1] - 1)) / max(shape[1] - 1, 1)
    return np.asarray(row[:, None] * math.cos(angle) + column[None, :] * math.sin(angle), dtype=np.float64)


def _factor(moments: FloatArray, length: FloatArray) -> FloatArray:
    """Mean of exp(-mu length) over a spectrum of moments (3, ...) of mu (0, 1, 2), to second order in length."""
    mean = moments[1] / moments[0]
    spread = moments[2] / moments[0] - mean**2
    return np.asarray(np.exp(-mean * length + 0.5 * spread * length**2))


def _tilt(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    request, model = context.request, context.model
    absorbed = context.since == "always"
    if parameters["strength"] == 0 or (absorbed and not context.has_scene and request.panel_rotation_deg == 0):
        return state
    if model is None or context.project is None or context.weights is None or state.parameters is None:
        raise InputError(
            "effect heel",
            received="a twin without spectral part",
            expected="a twin with one",
            remedy="calibrate from flats that state kV and tube load",
        )
    if request.setting is None:
        return state
    bare = model.moment_weights(state.parameters, OpenBeam(kV=request.setting.kV, filters=()))[0]
    anode = model.mu(model.anode)
    # anode path (mm) from one border of the field to the other
    path = parameters["strength"] / 100.0 * float(bare.sum()) / float(bare @ anode[: bare.size])
    top = context.weights.shape[1]
    mu = anode[:top]
    first, second = context.weights
    rows = np.stack([first, first * mu, first * mu**2, second, second * mu, second * mu**2])

    def path_of(direction_deg: float) -> FloatArray:
        u = _field_coordinate(context.shape, direction_deg)
        return path * (parameters["offset"] + u + parameters["curvature"] * u**2)

    across = path_of(parameters["direction_deg"] - request.panel_rotation_deg)
    behind = context.project("heel", rows)
    tiny = 1e-300
    signal = _factor(np.maximum(behind[:3], tiny), across)
    variance = _factor(np.maximum(behind[3:], tiny), across)
    if absorbed:
        # the calibrated flat holds the heel of the unturned panel in the open beam
        seen = path_of(parameters["direction_deg"])
        known = _factor(np.sum(rows[:3], axis=1)[:, None, None], seen)
        signal, variance = signal / known, variance / known
    return replace(state, signal_DN=state.signal_DN * signal, variance_DN2=state.variance_DN2 * variance)


HEEL = Effect(
    id="heel",
    title="anode heel",
    law=r"N(E) \to N(E)\,e^{-\mu_\mathrm{anode}(E)\,\tau\,(o + u + c\,u^2)},\quad u \in [-\tfrac12, \tfrac12]\ \text{across}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=1.0,
            high=20.0,
            default=5.0,
            source="change of the unfiltered beam's signal across the field, the same at each kV",
            log=False,
        ),
        Parameter(
            name="direction_deg",
            unit="deg",
            low=0.0,
            high=360.0,
            default=0.0,
            source="direction in which the signal falls: 0 along rising row index, 90 along rising column index",
            log=False,
        ),
        Parameter(
            name="curvature",
            unit="",
            low=-0.4,
            high=0.8,
            default=0.2,
            source="cot(anode angle) times the field's angle: 0.24 for 12 degrees and 51 mm at 1 m",
            log=False,
        ),
        Parameter(
            name="offset",
            unit="",
            low=-0.5,
            high=0.5,
            default=0.0,
            source="path in the middle of the field over its change across it: an anode that roughens lengthens every path (1/2: all "
            "but those at one border), another anode some of them",
            log=False,
        ),
    ),
    stage="arrivals",
    reference="path z cot(alpha + phi) in the anode, to second order in the position: Braun (1978), doi:10.1088/0031-9155/23/5/005",
    after_calibration=True,
    course="steady",
    change=_tilt,
    needs=("spectral",),
    isolated_by="a flat with the panel turned by 180 degrees, and a wedge at two places",
    shows=Shows(series=LIT_SERIES, axis="position"),
    either_onset=True,
    absorbed="maps of beams",
    grid=Grid(
        shares=(0.8,),
        # a search begins between a change about the middle (0) and one that grows from a border on (1/2)
        variants=tuple({"direction_deg": direction, "offset": 0.2} for direction in (0.0, 90.0, 180.0, 270.0)),
    ),
    variation=Variation(random="sides"),
)

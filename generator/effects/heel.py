"""Anode heel: exp(-mu_anode tau (o + u + c u^2)), u from -1/2 to 1/2 across the field.

Electrons reach deeper at a higher voltage, and the anode absorbs less: tau takes about the same share of the unfiltered beam at
every voltage. A deposit on the window or a worn track has one tau at all of them. tau = tau_s(kV)^(1 - f) tau_s(kV_0)^f, tau_s the
path that changes the signal by the strength, kV_0 the middle of the calibrated voltages, f the parameter `fixed_path`.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState
from ..line.spectral_signal import OpenBeam, SpectralModel
from ..line.twin import Twin
from ._sheets import Sheets
from .effect import LIT_SERIES, Effect, Grid, Parameter, Shows, Variation

_UNIT = 0.1  # share of the unfiltered signal that the unit of depth takes
# of the anodes behind which scenes are projected: exact to 2e-4 of the beam where up to 30 % of it is taken
_DEPTHS = (-1.0, 1.0, 2.0, 4.0)


def _field_coordinate(shape: tuple[int, int], direction_deg: float) -> FloatArray:
    """-1/2 to 1/2 across the field (row, column), along a direction counted from rows towards columns."""
    angle = math.radians(direction_deg)
    row = (np.arange(shape[0]) - 0.5 * (shape[0] - 1)) / max(shape[0] - 1, 1)
    column = (np.arange(shape[1]) - 0.5 * (shape[1] - 1)) / max(shape[1] - 1, 1)
    return np.asarray(row[:, None] * math.cos(angle) + column[None, :] * math.sin(angle), dtype=np.float64)


def _path_mm(model: SpectralModel, parameters: FloatArray, kV: float) -> float:
    """Anode (mm) that takes _UNIT of the unfiltered beam's signal at a voltage, to first order."""
    bare = model.moment_weights(parameters, OpenBeam(kV=kV, filters=()))[0]
    return _UNIT * float(bare.sum()) / float(bare @ model.mu(model.anode)[: bare.size])


def _middle_kV(twin: Twin, kV: float) -> float:
    """Middle of the voltages that calibrated the twin; kV where none is known."""
    known = [level.kV for level in twin.levels if level.kV]
    return math.sqrt(min(known) * max(known)) if known else kV


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
    if request.setting is None or request.setting.kV is None:
        return state
    kV = request.setting.kV
    unit_mm = _path_mm(model, state.parameters, kV)
    # in units of the path that takes _UNIT at this voltage, from one border of the field to the other
    depth = parameters["strength"] / (100.0 * _UNIT)
    if parameters["fixed_path"] != 0:
        middle_mm = _path_mm(model, state.parameters, _middle_kV(context.twin, kV))
        depth *= (middle_mm / unit_mm) ** parameters["fixed_path"]
    sheets = Sheets(_DEPTHS, unit_mm * model.mu(model.anode)[: context.weights.shape[1]])
    rows = sheets.rows(context.weights)

    def depth_of(direction_deg: float) -> FloatArray:
        u = _field_coordinate(context.shape, direction_deg)
        return depth * (parameters["offset"] + u + parameters["curvature"] * u**2)

    across = depth_of(parameters["direction_deg"] - request.panel_rotation_deg)
    signal, variance = sheets.passed(context.project("heel", rows), across)
    if absorbed:
        # the calibrated flat holds the heel of the unturned panel in the open beam
        known = sheets.passed(rows.sum(axis=1)[:, None, None], depth_of(parameters["direction_deg"]))
        signal, variance = signal / known[0], variance / known[0]
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
            source="change of the unfiltered beam's signal across the field, at the middle of the calibrated voltages",
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
        Parameter(
            name="fixed_path",
            unit="",
            low=-0.6,
            high=1.0,
            default=0.0,
            source="0: the same share of the signal at each kV; 1: one path at all, of a deposit or a worn track; -0.6: of a "
            "depth that grows as kV^1.67 (Kanaya and Okayama, 1972)",
            log=False,
        ),
    ),
    stage="arrivals",
    reference="path z cot(alpha + phi) in the anode, to second order in the position: Braun (1978), doi:10.1088/0031-9155/23/5/005",
    after_calibration=True,
    course="steady",
    pattern=True,
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

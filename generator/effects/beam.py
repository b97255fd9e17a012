"""The beam is not what the twin thinks: tube voltage, filtration, anode heel, and the composition of the object.

kV error            kV (1 + d)
filtration error    exp(-mu_Al t)
composition error   mu t (1 + d) of one material of the scene
heel                exp(-mu_anode tau u), u from -1/2 to 1/2 across the field
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ..line_state import FloatArray, LineContext, LineState
from ..spectral_signal import OpenBeam
from .effect import Effect, Parameter

# the spectral model's table of tube voltage errors ends at 6 %; larger ones are counted from a voltage 5 % off
_TABLE_END = 0.055
_REBASED = 0.05


def _shifted(state: LineState, context: LineContext, name: str, amount: float, effect: str) -> LineState:
    if context.model is None or state.parameters is None:
        raise InputError(
            f"effect {effect}",
            received="a twin without spectral part",
            expected="a twin calibrated from flats that state kV and tube load",
        )
    parameters = state.parameters.copy()
    parameters[context.model.names.index(name)] += amount
    return replace(state, parameters=parameters)


def _shift_kV(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    before = 0.0
    if context.model is not None and state.parameters is not None:
        before = float(state.parameters[context.model.names.index("kV_error")])
    total = (1.0 + before) * (1.0 + parameters["strength"] / 100.0) - 1.0
    factor = 1.0 if abs(total) <= _TABLE_END else 1.0 + math.copysign(_REBASED, total)
    rest = (1.0 + total) / factor - 1.0
    if abs(rest) > _TABLE_END:
        raise InputError(
            "strength of kv_error",
            received=f"{parameters['strength']:g} % on top of a calibrated {100 * before:.2g} %",
            expected="together within 10 % of the tube voltage",
        )
    return replace(_shifted(state, context, "kV_error", rest - before, "kv_error"), kV_factor=state.kV_factor * factor)


KV_ERROR = Effect(
    id="kv_error",
    title="tube voltage differs from the calibrated one",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.5,
            high=5.0,
            default=1.0,
            source="IEC 61223 allows 5-10 % of the voltage",
            log=False,
            signed=True,
        ),
    ),
    stage="beam",
    reference="spectrum model at kV (1 + d)",
    after_calibration=True,
    change=_shift_kV,
    needs=("spectral",),
)


def _shift_filtration(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0:
        return state
    return _shifted(state, context, "inherent_filtration_mm_Al", parameters["strength"], "filtration_error")


FILTRATION_ERROR = Effect(
    id="filtration_error",
    title="filtration differs from the calibrated one",
    parameters=(
        Parameter(
            name="strength",
            unit="mm Al",
            low=0.03,
            high=1.0,
            default=0.2,
            source="anode roughening, an exchanged window or a forgotten sheet",
            log=False,
        ),
    ),
    stage="beam",
    reference="Beer-Lambert with aluminium",
    after_calibration=True,
    change=_shift_filtration,
    needs=("spectral",),
)


_CERTIFIED = ("wedge", "edge", "disc")  # test objects whose composition is not in question unless they are named


def longest_material(thickness_mm: Mapping[str, object]) -> str:
    """The material of a scene with the longest path in all; '' where there is none."""
    sums = {name: float(np.sum(np.asarray(value))) for name, value in thickness_mm.items()}
    return max(sums, key=lambda name: sums[name]) if sums else ""


def _scale_attenuation(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    request = context.request
    if parameters["strength"] == 0 or not request.thickness_mm:
        return state
    material = context.options.get("material") or request.product_material
    if material is None:
        if request.scene_kind in _CERTIFIED:
            return state
        material = longest_material(request.thickness_mm)
    scale = dict(state.attenuation_scale)
    scale[material] = scale.get(material, 1.0) * (1.0 + parameters["strength"] / 100.0)
    return replace(state, attenuation_scale=scale)


COMPOSITION_ERROR = Effect(
    id="composition_error",
    title="composition or density of the object differs",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.5,
            high=5.0,
            default=2.0,
            source="change of the attenuation; fat and water content of meat move it by a few per cent",
            log=False,
            signed=True,
        ),
    ),
    stage="beam",
    reference="mu t (1 + d) of one material",
    after_calibration=False,
    change=_scale_attenuation,
    needs=("spectral", "scene"),
    options={
        "material": "of the scene, that differs; not given: the product's, or the one of longest path in a scene that is"
        " no wedge, edge or disc"
    },
)


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
        raise InputError("effect heel", received="a twin without spectral part", expected="a twin with one")
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
        return path * (u + parameters["curvature"] * u**2)

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
    ),
    stage="arrivals",
    reference="path z cot(alpha + phi) in the anode, to second order in the position: Braun (1978), doi:10.1088/0031-9155/23/5/005",
    after_calibration=True,
    change=_tilt,
    needs=("spectral",),
)

"""The object does not lie where the thickness maps say: shift, magnification and a turn about the field's middle.

    d(r) = s {cos(c) [cos(b) (cos(a), sin(a)) + sin(b) q] + sin(c) turned(q)},    q = (r - centre) / rms(r - centre)

so that the rms of d is s; turned(q) is q a quarter turn counter-clockwise on.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from ..line.line_state import LineContext, LineState
from .effect import Displacement, Effect, Grid, InImages, Parameter, Placement, Reading, Shows


def parts_px(strength_px: float, *, magnification_deg: float, rotation_deg: float) -> tuple[float, float, float]:
    """How much of a misregistration is shift, magnification and turn; their squares add up to that of the strength."""
    straight, turn = (share(math.radians(rotation_deg)) for share in (math.cos, math.sin))
    shift, radial = (share(math.radians(magnification_deg)) for share in (math.cos, math.sin))
    return strength_px * straight * shift, strength_px * straight * radial, strength_px * turn


def angles_of(shift_px: float, radial_px: float, turn_px: float) -> dict[str, float]:
    """Strength (px) and angles (deg) of a misregistration with these parts, the shift 0 or more; what `parts_px` takes apart."""
    straight = math.hypot(shift_px, radial_px)
    return {
        "strength": math.hypot(straight, turn_px),
        "magnification_deg": math.degrees(math.atan2(radial_px, shift_px)),
        "rotation_deg": math.degrees(math.atan2(turn_px, straight)),
    }


def _displace(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    if parameters["strength"] == 0 or not context.has_scene or state.signal_DN.shape != context.shape:
        return state
    direction = math.radians(parameters["direction_deg"])
    shift, radial, turn = parts_px(
        parameters["strength"],
        magnification_deg=parameters["magnification_deg"],
        rotation_deg=parameters["rotation_deg"],
    )
    down, right = state.shift_px
    larger, turned = state.distortion_px
    return replace(
        state,
        shift_px=(down + shift * math.cos(direction), right + shift * math.sin(direction)),
        distortion_px=(larger + radial, turned + turn),
    )


def _parts(parameters: Mapping[str, float]) -> Displacement:
    strength = parameters["strength"]
    angles = {name: parameters.get(name, 0.0) for name in ("magnification_deg", "rotation_deg")}
    shift, radial, turn = parts_px(strength, **angles)
    return Displacement(
        size_px=abs(strength),
        shift_px=shift,
        direction_deg=parameters.get("direction_deg", 0.0),
        radial_px=radial,
        turn_px=turn,
    )


def _without_shift(parameters: Mapping[str, float]) -> dict[str, float]:
    parts = _parts(parameters)
    return {**parameters, **angles_of(0.0, parts.radial_px, parts.turn_px), "direction_deg": 0.0}


def _combined(shifted: Mapping[str, float], distorted: Mapping[str, float]) -> dict[str, float]:
    shift, other = _parts(shifted).shift_px, _parts(distorted)
    return {**shifted, **angles_of(abs(shift), other.radial_px, other.turn_px)}


MISREGISTRATION = Effect(
    id="misregistration",
    title="object lies elsewhere than its thickness maps",
    law=r"\mathbf r \to \mathbf r + \mathbf d(\mathbf r),\quad \sqrt{\langle d^2\rangle} = s",
    parameters=(
        Parameter(
            name="strength",
            unit="px",
            low=0.1,
            high=3.0,
            default=0.5,
            source="rms displacement over the field",
            log=True,
            pixel_power=1.0,
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
            source="of what is no turn, 0: all shift; 90: all magnification; -90: all reduction",
            log=False,
        ),
        Parameter(
            name="rotation_deg",
            unit="deg",
            low=-90.0,
            high=90.0,
            default=0.0,
            source="0: no turn; 90: all of the displacement a turn counter-clockwise; -90: clockwise",
            log=False,
        ),
    ),
    stage="arrivals",
    reference="rigid shift, uniform scale and turn",
    after_calibration=False,
    change=_displace,
    needs=("scene",),
    isolated_by="a grid of balls, or an edge in two directions",
    shows=Shows(series=("object",), axis="sharpness", flats=False),
    in_some_series=True,
    absorbed="nothing",
    reading=Reading(probes=("displacement along rows", "displacement along columns")),  # where scenes lie is its shift
    grid=Grid(
        shares=(0.6, 1.0),
        variants=(
            *({"direction_deg": 45.0 * k, "magnification_deg": 0.0} for k in range(8)),
            *(
                {"direction_deg": 0.0, name: sign * 90.0}
                for name in ("magnification_deg", "rotation_deg")
                for sign in (1, -1)
            ),
        ),
    ),
    images=InImages(left_out="picture and masks stay together"),
    placement=Placement(parts=_parts, without_shift=_without_shift, combined=_combined),
)

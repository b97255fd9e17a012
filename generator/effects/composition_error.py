"""Composition or density of the object that differs: mu t (1 + d) of one material of the scene."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..line.line_state import LineContext, LineState
from .effect import Effect, Grid, InImages, Parameter, Shows

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
    law=r"\mu\,\rho\,L \to \mu\,\rho\,L\,(1 + s)\ \text{of one material}",
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
    course="steady",
    change=_scale_attenuation,
    needs=("spectral", "scene"),
    options={
        "material": "of the scene, that differs; not given: the product's, or the one of longest path in a scene that is"
        " no wedge, edge or disc"
    },
    isolated_by="a certified wedge of the product's material",
    shows=Shows(series=("object",), axis="energy", flats=False),
    absorbed="nothing",
    grid=Grid(shares=(0.6, 1.0)),
    images=InImages(not_in_references="references show the product as it is"),
)

"""A worn screen: light x (1 - s exp(-r^2 / (2 w^2))), r from the middle of the field over its side.

The whole of what another package writes to add an effect; docs/effects.md says how it is installed.
"""

from dataclasses import replace

import numpy as np

from raytwin.generator.effects import LIT_SERIES, Effect, Grid, Parameter, Shows


def _wear(state, parameters, context):
    row, column = (np.linspace(-0.5, 0.5, side) for side in context.shape)
    squared = row[:, None] ** 2 + column[None, :] ** 2
    left = 1.0 - parameters["strength"] / 100.0 * np.exp(-0.5 * squared / parameters["width"] ** 2)
    return replace(state, signal_DN=left * state.signal_DN, variance_DN2=left * state.variance_DN2)


WORN_SCREEN = Effect(
    id="worn_screen",
    title="screen worn about the middle of the field",
    law=r"P \to P\,(1 - s\,e^{-r^2 / (2 w^2)})",
    parameters=(
        Parameter(
            name="strength", unit="%", low=0.5, high=20.0, default=5.0, source="light lost in the middle", log=False
        ),
        Parameter(name="width", unit="", low=0.05, high=0.3, default=0.12, source="over the field's side", log=True),
    ),
    stage="optics",
    reference="radiation damage of CsI screens",
    isolated_by="a flat with the screen shifted",
    shows=Shows(series=LIT_SERIES, axis="position"),
    after_calibration=True,
    course="steady",
    absorbed="maps",
    change=_wear,
    grid=Grid(shares=(0.8,)),
)

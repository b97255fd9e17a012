"""The response of one exposure: counts that are lost to pile-up, then a curve that bends.

y = z (1 - b z),    z = x / (1 + k x)
"""

import numpy as np

from ..line.line_state import FloatArray, LineState


def responds(state: LineState) -> bool:
    """Whether the response is no line."""
    return state.bend_per_DN != 0.0 or state.blind_per_DN != 0.0


def responded(state: LineState, light_DN: FloatArray) -> FloatArray:
    """What is read of light, DN; any shape."""
    seen = light_DN
    if state.blind_per_DN != 0.0:
        seen = light_DN / (1.0 + state.blind_per_DN * np.maximum(light_DN, 0.0))
    return seen * (1.0 - state.bend_per_DN * seen)


def slope(state: LineState, light_DN: FloatArray) -> FloatArray:
    """Change of what is read with the light."""
    left = 1.0 / (1.0 + state.blind_per_DN * np.maximum(light_DN, 0.0))
    return np.asarray(left**2 * (1.0 - 2.0 * state.bend_per_DN * light_DN * left))


def counting_noise(state: LineState, light_DN: FloatArray) -> FloatArray | float:
    """Factor on the variance of quanta, besides the square of the slope: lost counts are lost by chance.

    A counter of constant dead time has the variance x / (1 + k x)^3, of which the slope explains x / (1 + k x)^4.
    """
    return 1.0 if state.blind_per_DN == 0.0 else 1.0 + state.blind_per_DN * np.maximum(light_DN, 0.0)


def light_of(state: LineState, read_DN: FloatArray) -> FloatArray:
    """Light of which `read_DN` is read: `responded` the other way round; the highest that there is beyond its end."""
    root = np.sqrt(np.maximum(1.0 - 4.0 * state.bend_per_DN * read_DN, 0.0))
    seen = 2.0 * read_DN / (1.0 + root)
    if state.blind_per_DN == 0.0:
        return np.asarray(seen)
    return np.asarray(seen / np.maximum(1.0 - state.blind_per_DN * seen, 1e-6))

"""The response of one exposure: counts that are lost to pile-up, then a curve that bends.

y = z (1 - sum_i b_i z^p_i),    z = x / (1 + k x)
"""

import numpy as np

from ..line.line_state import FloatArray, LineState

_LEAST_SLOPE = 1e-6  # of a curve that bends, for the steps towards its end
_STEPS = 60
_MOST_DN = 1e12


def responds(state: LineState) -> bool:
    """Whether the response is no line."""
    return bool(state.bends) or state.blind_per_DN != 0.0


def responded(state: LineState, light_DN: FloatArray) -> FloatArray:
    """What is read of light, DN; any shape."""
    seen = light_DN
    if state.blind_per_DN != 0.0:
        seen = light_DN / (1.0 + state.blind_per_DN * np.maximum(light_DN, 0.0))
    return seen * (1.0 - _bent(state, seen))


def _bent(state: LineState, seen_DN: FloatArray, *, of_slope: bool = False) -> FloatArray | float:
    """Share that bends take of what is seen; of_slope: of the slope there."""
    lit = np.maximum(seen_DN, 0.0)
    shares = ((1.0 + power if of_slope else 1.0) * each * lit**power for each, power in state.bends)
    return sum(shares, start=0.0)


def slope(state: LineState, light_DN: FloatArray) -> FloatArray:
    """Change of what is read with the light."""
    left = 1.0 / (1.0 + state.blind_per_DN * np.maximum(light_DN, 0.0))
    return np.asarray(left**2 * (1.0 - _bent(state, light_DN * left, of_slope=True)))


def _end_of_rise(state: LineState) -> float:
    """Light, DN, beyond which less is read of more; infinite: there is none."""
    from scipy.optimize import brentq

    def rise(light_DN: float) -> float:
        return float(1.0 - _bent(state, np.asarray(light_DN), of_slope=True))

    above = 1.0
    while rise(above) > 0.0:
        above *= 2.0
        if above > _MOST_DN:
            return np.inf
    return float(brentq(rise, 0.0, above))


def counting_noise(state: LineState, light_DN: FloatArray) -> FloatArray | float:
    """Factor on the variance of quanta, besides the square of the slope: lost counts are lost by chance.

    A counter of constant dead time has the variance x / (1 + k x)^3, of which the slope explains x / (1 + k x)^4.
    """
    return 1.0 if state.blind_per_DN == 0.0 else 1.0 + state.blind_per_DN * np.maximum(light_DN, 0.0)


def light_of(state: LineState, read_DN: FloatArray) -> FloatArray:
    """Light of which `read_DN` is read: `responded` the other way round; the highest that there is beyond its end."""
    seen = np.asarray(read_DN, dtype=np.float64)
    if state.bends:
        end = _end_of_rise(state)
        wanted = seen if np.isinf(end) else np.minimum(seen, end * (1.0 - _bent(state, np.asarray(end))))
        # Newton's steps come from one side: the curve bends one way
        seen = np.minimum(seen, end)
        for _ in range(_STEPS):
            rise = np.maximum(1.0 - _bent(state, seen, of_slope=True), _LEAST_SLOPE)
            before, seen = seen, np.minimum(seen + (wanted - seen * (1.0 - _bent(state, seen))) / rise, end)
            if np.all(np.abs(seen - before) <= 1e-13 * np.abs(seen)):
                break
    if state.blind_per_DN == 0.0:
        return seen
    return np.asarray(seen / np.maximum(1.0 - state.blind_per_DN * seen, 1e-6))

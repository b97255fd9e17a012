"""What happens to the charge of a pixel: a response that bends, a gain that calibration does not know, excess noise.

nonlinearity     y = x (1 - s x / x_half), x_half half of the highest level: s is the departure from a line there
gain map error   y = x (1 + eta), eta fixed from frame to frame
excess noise     quantum variance x (1 + e)
"""

from collections.abc import Mapping
from dataclasses import replace

from ..line_state import FixedPattern, LineContext, LineState
from .effect import Effect, Parameter


def _bend(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    highest = parameters["highest_signal_DN"]
    if highest <= 0:
        bits = context.twin.instrument.bits or 16
        highest = 2.0**bits - 1.0 - context.twin.dark_DN.value
    return replace(state, bend_per_DN=state.bend_per_DN + parameters["strength"] / 100.0 / (0.5 * highest))


NONLINEARITY = Effect(
    id="nonlinearity",
    title="response that bends",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.3,
            high=5.0,
            default=1.0,
            source="departure from the initial line at half of the highest level",
            log=False,
            signed=True,
        ),
        Parameter(
            name="highest_signal_DN",
            unit="DN",
            low=0.0,
            high=2.0**24,
            default=0.0,
            source="highest level above dark that `strength` refers to; 0: full scale of the ADC",
            log=False,
            fitted=False,
        ),
    ),
    stage="response",
    reference="first term of a saturating response; EMVA Standard 1288, release 4.0, linearity error",
    after_calibration=False,
    change=_bend,
)


def _change_gain(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    # a pattern that calibration saw is in its maps
    if parameters["strength"] == 0 or context.since == "always":
        return state
    return replace(
        state, gain_pattern=FixedPattern(rms=parameters["strength"] / 100.0, seed=int(parameters["pattern_seed"]))
    )


GAIN_MAP_ERROR = Effect(
    id="gain_map_error",
    title="per-pixel gain has changed",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.1,
            high=3.0,
            default=0.5,
            source="standard deviation over the pixels; flat panels between two gain calibrations",
            log=True,
        ),
        Parameter(
            name="pattern_seed",
            unit="",
            low=0.0,
            high=2.0**31,
            default=0.0,
            source="draws the pattern",
            log=False,
            fitted=False,
        ),
    ),
    stage="response",
    reference="fixed-pattern noise (PRNU), EMVA Standard 1288, release 4.0",
    after_calibration=True,
    change=_change_gain,
)


def _add_excess(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    factor = 1.0 + parameters["strength"] / 100.0
    return replace(state, variance_DN2=factor * state.variance_DN2, secondary_DN=factor * state.secondary_DN)


EXCESS_NOISE = Effect(
    id="excess_noise",
    title="more quantum noise than calibrated",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=3.0,
            high=100.0,
            default=20.0,
            source="of the quantum variance; a Swank factor that falls from 0.95 to 0.5 adds 90 %",
            log=False,
        ),
    ),
    stage="quanta",
    reference="Swank (1973), doi:10.1063/1.1662918",
    after_calibration=True,
    change=_add_excess,
)

"""Parameters of the spectral model that effects on the beam move."""

from dataclasses import replace

from ...errors import InputError
from ..line.line_state import LineContext, LineState


def shifted_parameter(state: LineState, context: LineContext, name: str, amount: float, effect: str) -> LineState:
    """The state with a parameter of the spectral model moved.

    Raises:
        InputError: a twin without spectral part.
    """
    if context.model is None or state.parameters is None:
        raise InputError(
            f"effect {effect}",
            received="a twin without spectral part",
            expected="a twin calibrated from flats that state kV and tube load",
        )
    parameters = state.parameters.copy()
    parameters[context.model.names.index(name)] += amount
    return replace(state, parameters=parameters)

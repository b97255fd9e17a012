"""Effects that a detector of another kind may have."""

from ...acquisition.instrument import Instrument
from ...generator.effects import EFFECTS


def inapplicable(instrument: Instrument) -> tuple[str, ...]:
    """Ids of the effects that need a photon counter, where the instrument says that it is none; else nothing."""
    if instrument.counting is not False:
        return ()
    return tuple(effect.id for effect in EFFECTS.values() if "counting" in effect.needs)

"""The line as it is now: what effects do to beam and noise worked into the twin, and the effects that are left.

Effects on tube voltage, filtration and quantum noise change numbers that the base model has already: parameters of the
spectrum, level and gain of each kV. A twin with such an effect is the same as one whose numbers differ. Those are changed
(`Effect.worked_in`), and the effect is left out. Whatever else there is goes on as an effect.
"""

from dataclasses import dataclass, replace

from ..effects import AppliedEffect, effect_of
from ..line.twin import Twin


@dataclass(frozen=True, slots=True, kw_only=True)
class PresentLine:
    """A twin without effects whose numbers are those of now; the effects that are left; what could not be done."""

    twin: Twin
    effects: tuple[AppliedEffect, ...]
    warnings: tuple[str, ...]


def present_line(twin: Twin, *, after_calibration: bool = True) -> PresentLine:
    """The twin with the effects on beam and noise worked into its numbers, and the other effects.

    kV and filtration move every parameter set of the spectrum and, by the change of the most probable one, the measured
    levels; excess noise raises gain and photon-transfer slope of all levels and lowers the Swank factor.

    Args:
        twin: any twin; without effects it comes back as it is.
        after_calibration: whether effects that came after calibration are there.
    """
    active = tuple(item for item in twin.effects if after_calibration or item.since == "always")
    bare = replace(twin, effects=()) if twin.effects else twin
    rest: list[AppliedEffect] = []
    warnings: list[str] = []
    for item in active:
        effect = effect_of(item)
        strength = effect.values(item.parameters)["strength"]
        if effect.worked_in is None:
            rest.append(item)
        elif bare.spectral is None and "spectral" in effect.needs:
            warnings.append(f"effect {item.id} is left out: the twin has no spectral part")
        elif strength != 0:
            bare, told = effect.worked_in(bare, strength)
            warnings += told
    return PresentLine(twin=bare, effects=tuple(rest), warnings=tuple(warnings))

"""What an effect of the lab is: how it is asked for, where it is planted, its unit and range."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .line import Planted
from .system import LabSystem

if TYPE_CHECKING:
    from .session import Geometry, SessionPlan

SINCE = ("always", "calibration")
FORM = "write ID=STRENGTH or ID=STRENGTH@calibration, for example kv_error=1.5@calibration"


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectRequest:
    """An effect that is asked for.

    Fields: id (of `EFFECTS`); strength (in the unit of the effect); since (`always`, `calibration`: it sets in after
    the calibration series; None: what is usual for the effect).
    """

    id: str
    strength: float
    since: str | None = None

    def __post_init__(self) -> None:
        from .effects import EFFECTS

        law = EFFECTS.get(self.id)
        if law is None:
            import difflib

            near = difflib.get_close_matches(self.id, EFFECTS, n=3, cutoff=0.4) or list(EFFECTS)
            raise InputError("effect", received=repr(self.id), expected="an effect's id, such as " + ", ".join(near))
        if self.since is not None and self.since not in SINCE:
            raise InputError(
                f"onset of {self.id}", received=repr(self.since), expected="always or calibration", remedy=FORM
            )
        low = -law.high if law.signed else 0.0
        # Ten times beyond the plausible range a law need not make sense any more.
        if not (math.isfinite(self.strength) and 10.0 * low <= self.strength <= 10.0 * law.high):
            raise InputError(
                f"strength of {self.id}",
                received=f"{self.strength:g} {law.unit}",
                expected=f"{'-' if law.signed else ''}{law.low:g} to {law.high:g} {law.unit}",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Where an effect is planted: the true system, its geometry, what will be measured, and random numbers."""

    system: LabSystem
    geometry: "Geometry"
    plan: "SessionPlan"
    rng: np.random.Generator


Build = Callable[[EffectRequest, Site], Planted]


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectLaw:
    """One kind of effect.

    Fields: id; title; unit, low and high of the strength's plausible range; since (what is usual); signed (the strength
    may be negative); build; known (in the catalogue that a diagnosis may name).
    """

    id: str
    title: str
    unit: str
    low: float
    high: float
    since: str
    build: Build
    signed: bool = False
    known: bool = True

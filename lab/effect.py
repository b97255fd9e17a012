"""What an effect of the lab is: how it is asked for, where it is planted, its unit and range."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .line import Planted
from .system import LabSystem

if TYPE_CHECKING:
    from .session import Geometry, SessionPlan

SINCE = ("always", "calibration")
FORM = "write ID=STRENGTH or ID=STRENGTH@calibration, for example kv_error=1.5@calibration"


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """An effect that is asked for: plain data; `effects.EffectRequest` knows which there are.

    Fields: id (of `effects.EFFECTS`); strength (in the unit of the effect); since (`always`, `calibration`: it sets in after
    the calibration series; None: what is usual for the effect).
    """

    id: str
    strength: float
    since: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Where an effect is planted: the true system, its geometry, what will be measured, and random numbers."""

    system: LabSystem
    geometry: "Geometry"
    plan: "SessionPlan"
    rng: np.random.Generator


Build = Callable[[Asked, Site], Planted]


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectLaw:
    """One kind of effect.

    Fields: id; title; unit, low and high of the strength's plausible range; since (what is usual); signed (the strength
    may be negative); build; known (in the catalogue that a diagnosis may name); drawn (False: planted where asked for alone, as the
    lab's detector adds up energies and this is an effect of others).
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
    drawn: bool = True

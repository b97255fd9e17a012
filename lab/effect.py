"""What an effect of the lab is: how it is asked for, where it is planted, its unit and range."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

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

    def __str__(self) -> str:
        """As `--effect` takes it."""
        return f"{self.id}={self.strength:g}" + (f"@{self.since}" if self.since else "")


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

    def plant(self, request: Asked, site: Site) -> Planted:
        """The effect as it acts, with the unit of its strength."""
        return replace(self.build(request, site), unit=self.unit)


def effect_law(
    name: str,
    title: str,
    unit: str,
    span: tuple[float, float],
    build: Build,
    *,
    since: str = "always",
    **more: bool,
) -> EffectLaw:
    """A law in one line of a table; span: low and high of its strength; more: flags of `EffectLaw`."""
    return EffectLaw(id=name, title=title, unit=unit, low=span[0], high=span[1], since=since, build=build, **more)


def planted(request: Asked, law: str, parameters: dict[str, Any], **hooks: Any) -> Planted:
    """What a law builds: the words of its request, and where the effect acts; `EffectLaw.plant` adds the unit."""
    return Planted(
        id=request.id,
        strength=request.strength,
        unit="",
        since=request.since or "always",
        law=law,
        parameters=parameters,
        **hooks,
    )

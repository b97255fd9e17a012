"""The effects that can be planted in a session: the one registry, requests from text, and planting.

Each law is made to give the strength that was asked for, as the column `strength` of the catalogue defines it, and is
of another form than the catalogue's formula wherever nature allows.
"""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .effect import FORM, SINCE, Asked, EffectLaw, Site
from .effects_beam import BEAM_LAWS, COVER_LAWS, SOURCE_LAWS
from .effects_detector import DETECTOR_LAWS, MEMORY_LAWS
from .effects_frames import FRAME_LAWS
from .effects_pixels import JUMP_LAWS, PIXEL_LAWS
from .effects_unknown import UNKNOWN_LAWS
from .line import Planted

EFFECTS: Mapping[str, EffectLaw] = {
    law.id: law
    for law in (
        *BEAM_LAWS,
        *DETECTOR_LAWS,
        *SOURCE_LAWS,
        *UNKNOWN_LAWS,
        *JUMP_LAWS,
        *PIXEL_LAWS,
        *COVER_LAWS,
        *FRAME_LAWS,
        *MEMORY_LAWS,
    )
}


@dataclass(frozen=True, slots=True, kw_only=True)
class EffectRequest(Asked):
    """An effect that is asked for, of those that there are and of a strength that makes sense.

    Raises:
        InputError: an unknown id or onset, or a strength far out of range.
    """

    def __post_init__(self) -> None:
        law = EFFECTS.get(self.id)
        if law is None:
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


def request_from_text(text: str) -> EffectRequest:
    """A request from `ID=STRENGTH[@always|@calibration]`.

    Raises:
        InputError: an unknown id, no number, or a strength far out of range.
    """
    name, equals, rest = text.strip().partition("=")
    word, at, since = rest.partition("@")
    try:
        if not equals:
            raise ValueError
        strength = float(word)
    except ValueError:
        raise InputError("--effect", received=repr(text), expected="ID=STRENGTH", remedy=FORM) from None
    return EffectRequest(id=name.strip(), strength=strength, since=since.strip() if at else None)


def plant(requests: Sequence[EffectRequest], site: Site) -> tuple[Planted, ...]:
    """The effects as they will act, each with random numbers of its own; strength 0 plants nothing.

    Raises:
        InputError: the same effect twice.
    """
    names = [request.id for request in requests]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError("effects", received=f"{twice[0]} twice", expected="each effect at most once")
    planted = []
    order = list(EFFECTS)
    seeds = site.rng.integers(0, 2**62, size=len(order))
    for request in sorted(requests, key=lambda one: order.index(one.id)):
        if request.strength == 0.0:
            continue
        rng = np.random.default_rng(int(seeds[order.index(request.id)]))
        own = Site(system=site.system, geometry=site.geometry, plan=site.plan, rng=rng)
        law = EFFECTS[request.id]
        asked = EffectRequest(id=request.id, strength=request.strength, since=request.since or law.since)
        planted.append(law.plant(asked, own))
    return tuple(planted)

"""Forms that the optical spread may have, and how likely each is before any datum.

A Gaussian core, of one width or two; with or without a tail of one of several laws; of light that pixels collect, or of quanta
that are counted in pixels first.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from ..generator.spread.psf import LAYER, Spread
from .noise_power import LARGEST_SQUARE_PX

WIDTHS = ("sigma_px2", "log_aspect")  # the square: by the width itself nothing changes at a width of 0
TAIL = ("tail_share", "log_tail_px")
# Light that goes farther is glare, not spread. The longest reach L is that whose transfer function is still 0.8 at 2 / M, the
# lowest frequency that the largest squares, of M px, have in full use: 2 pi L (2 / M) = 1/2.
_LONGEST_TAIL_PX = LARGEST_SQUARE_PX / (8.0 * math.pi)
LOG_REACH = (math.log(0.25), math.log(_LONGEST_TAIL_PX))  # of a tail, px: any reach between these is equally likely
# Light is absorbed in a layer over lengths, px, that change a tail at these frequencies: the wave number there is 4 pi / M. About
# its inverse by factors of two; and not absorbed.
_ABSORBED_PX = tuple(LARGEST_SQUARE_PX / (4.0 * math.pi) * factor for factor in (0.5, 1.0, 2.0, math.inf))
# Light that diffuses through a screen has a tail, however small (Swank, Appl. Opt. 12 (1973) 1865); without a screen a tail (the
# low-frequency drop of IEC 62220-1) is as likely as none. Assumed, since no survey of panels says it: its share of the light
# follows a beta law of mean 0.1, in one case of ten any share.
_NO_TAIL = 0.5
_TAIL_SHARE_POWER, _ANY_TAIL = 9.0, 0.1
# Behind a screen quanta land anywhere in a pixel; but of frames that are said to have one, so many come from a simulation that
# counts quanta in pixels. Assumed; noise decides where the spread is narrower than a pixel, and hardly where it is wider.
_SIMULATED = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Spreads of one form.

    Fields: model (how quanta meet pixels); names (its parameters); order and absorption_per_px of its tail; of_tails: its share of
    all tails, before any datum.
    """

    model: str
    names: tuple[str, ...]
    order: float = 1.0
    absorption_per_px: float = 0.0
    of_tails: float = 0.0

    def spread(self, theta: Iterable[float]) -> Spread:
        """The spread of these parameters (name,)."""
        values = dict(zip(self.names, (float(value) for value in theta), strict=True))
        return Spread(
            model=self.model,
            sigma_px=math.sqrt(max(values["sigma_px2"], 0.0)),
            aspect=math.exp(values.get("log_aspect", 0.0)),
            tail_share=min(max(values.get("tail_share", 0.0), 0.0), 1.0),
            tail_px=math.exp(values.get("log_tail_px", 0.0)),
            tail_order=self.order,
            absorption_per_px=self.absorption_per_px,
        )


def _laws_of_tails() -> dict[str, tuple[float, float, float]]:
    """Order, absorption (1/px) and probability of each law: three are equally likely, and what a layer absorbs is."""
    laws = {"a Lorentzian tail": (1.0, 0.0, 1.0 / 3.0), "an exponential tail": (1.5, 0.0, 1.0 / 3.0)}
    for length_px in _ABSORBED_PX:
        layer = "a clear layer" if math.isinf(length_px) else f"a layer that absorbs over {length_px:.1f} px"
        laws[f"the tail of {layer}"] = (LAYER, 1.0 / length_px, 1.0 / (3.0 * len(_ABSORBED_PX)))
    return laws


def _families() -> dict[str, Family]:
    """All forms, by what they are called."""
    found = {}
    for model, pixels in (("aperture", "light collected in pixels"), ("sampled", "quanta counted in pixels")):
        for core, names in (("Gaussian", WIDTHS[:1]), ("two widths", WIDTHS)):
            found[f"{core}, {pixels}"] = Family(model=model, names=names)
            of_counts = "" if model == "aperture" else f", {pixels}"
            for law, (order, absorption_per_px, of_tails) in _laws_of_tails().items():
                found[f"{core} with {law}{of_counts}"] = Family(
                    model=model,
                    names=(*names, *TAIL),
                    order=order,
                    absorption_per_px=absorption_per_px,
                    of_tails=of_tails,
                )
    return found


FAMILIES = _families()
SIMPLEST = "Gaussian, light collected in pixels"
GENERAL = {
    "aperture": "two widths with an exponential tail",
    "sampled": "two widths with an exponential tail, quanta counted in pixels",
}
CORES = tuple(name for name, family in FAMILIES.items() if not set(family.names) & set(TAIL))


def prior_of_models(*, screen: bool) -> dict[str, tuple[float, float]]:
    """How likely each way that quanta meet pixels is, and how likely it is to have no tail.

    Args:
        screen: whether a screen is known to spread light.
    """
    return {
        "aperture": (1.0 - _SIMULATED, 0.0) if screen else (0.5, _NO_TAIL),
        "sampled": (_SIMULATED if screen else 0.5, _NO_TAIL),
    }


def reach_mass(log_reach: float, width: float) -> float:
    """Share of all reaches that lie within a width of the logarithm about this one."""
    return math.exp(log_reach) * width / (math.exp(LOG_REACH[1]) - math.exp(LOG_REACH[0]))


def share_density(share: float) -> float:
    """Prior density of the share of the light that is in the tail."""
    beta = _TAIL_SHARE_POWER * (1.0 - share) ** (_TAIL_SHARE_POWER - 1.0)
    return float(_ANY_TAIL + (1.0 - _ANY_TAIL) * beta)

"""Forms that the optical spread may have, and how likely each is before any datum.

A Gaussian core, of one width or two; with or without a tail of one of several laws; of light that pixels collect, or of quanta
that are counted in pixels first. The light of a line camera spreads along its line alone.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...acquisition.instrument import Instrument
from ...generator.spread.psf import AXES, LAYER, Spread
from .noise_power import LARGEST_SQUARE_PX, NoisePower

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
_CLEARLY_ALIKE = 5.0  # standard deviations, from which the noise of neighbours tells which of them share light


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Spreads of one form.

    Fields: name (what it is called); model (how quanta meet pixels); axes along which it spreads; names (its parameters); order and
    absorption_per_px of its tail; of_tails: its share of all tails, before any datum.
    """

    name: str
    model: str
    axes: str
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
            axes=self.axes,
        )


def _laws_of_tails() -> dict[str, tuple[float, float, float]]:
    """Order, absorption (1/px) and probability of each law: three are equally likely, and what a layer absorbs is."""
    laws = {"a Lorentzian tail": (1.0, 0.0, 1.0 / 3.0), "an exponential tail": (1.5, 0.0, 1.0 / 3.0)}
    for length_px in _ABSORBED_PX:
        layer = "a clear layer" if math.isinf(length_px) else f"a layer that absorbs over {length_px:.1f} px"
        laws[f"the tail of {layer}"] = (LAYER, 1.0 / length_px, 1.0 / (3.0 * len(_ABSORBED_PX)))
    return laws


@dataclass(frozen=True, slots=True)
class Forms:
    """All forms that the spread of a detector may have; general: by model, the one that comes near all others of it."""

    families: tuple[Family, ...]
    general: dict[str, Family]

    @property
    def cores(self) -> tuple[Family, ...]:
        """Those without a tail, the simplest first."""
        return tuple(family for family in self.families if not set(family.names) & set(TAIL))


def spread_axes(instrument: Instrument, flats: Sequence[NoisePower]) -> tuple[str, str | None]:
    """Index along which light spreads from pixel to pixel: both, or that along the lines of a line camera.

    Lines that were taken one after another share no light. Where neighbouring lines are more than half as alike as neighbours in
    a line, or lines run the other way, the noise is believed and not the declaration.

    Args:
        instrument: with `detector` and `belt_axis`, if declared.
        flats: noise power of the flats.

    Returns:
        One of AXES, and a warning where that is not as declared.
    """
    if instrument.detector != "line":
        return "both", None
    declared = "row" if instrument.belt_axis == "column" else "column"
    (row, column), sd = _neighbours_alike(flats)
    if max(row, column) < _CLEARLY_ALIKE * sd:
        return declared, None
    less, more = sorted((row, column))
    found = "both" if less > 0.5 * more else "row" if row > column else "column"
    if found == declared:
        return declared, None
    fitting = {"both": "detector = area or tdi", "row": "belt_axis = column", "column": "belt_axis = row"}[found]
    return found, (
        f"the detector is declared as line, but the noise of neighbours is as alike as {row:.2f} from row to row and {column:.2f} "
        f"from column to column: {fitting} is taken to be meant; correct the declaration"
    )


def _neighbours_alike(flats: Sequence[NoisePower]) -> tuple[tuple[float, float], float]:
    """Covariance of the noise of neighbours over the variance, from row to row and from column to column, and its standard
    deviation: the first terms of the power's cosine series, of which the frequencies in use leave white noise none."""
    rows, values, weights = [], [], []
    for item in flats:
        frequency = np.arange(item.power_DN2.shape[0]) / item.square_px
        along = np.cos(2.0 * np.pi * frequency)
        f_row, f_column = np.broadcast_arrays(along[:, None], along[None, :])
        used = item.used
        rows.append(np.stack([np.ones(used.sum()), f_row[used], f_column[used], (f_row * f_column)[used]], axis=1))
        values.append(item.power_DN2[used] / float(np.average(item.power_DN2[used], weights=item.modes[used])))
        weights.append(item.modes[used])
    design, value, weight = np.concatenate(rows), np.concatenate(values), np.concatenate(weights)
    covariance = np.linalg.pinv(design.T @ (design * weight[:, None]))
    mean, row, column, _ = covariance @ (design.T @ (weight * value))
    sd = math.sqrt(max(float(covariance[1, 1]), float(covariance[2, 2])))
    return (float(row / (2.0 * mean)), float(column / (2.0 * mean))), float(sd / (2.0 * mean))


@lru_cache(maxsize=len(AXES))
def forms_of(axes: str) -> Forms:
    """The forms of a spread along these axes."""
    along_both = (("Gaussian", WIDTHS[:1]), ("two widths", WIDTHS))
    cores = along_both if axes == "both" else (("Gaussian along lines", WIDTHS[:1]),)
    found: dict[str, Family] = {}
    general = {}
    for model, pixels in (("aperture", "light collected in pixels"), ("sampled", "quanta counted in pixels")):
        of_counts = "" if model == "aperture" else f", {pixels}"
        for core, names in cores:
            name = f"{core}, {pixels}"
            found[name] = Family(name=name, model=model, axes=axes, names=names)
            for law, (order, absorption_per_px, of_tails) in _laws_of_tails().items():
                name = f"{core} with {law}{of_counts}"
                found[name] = Family(
                    name=name,
                    model=model,
                    axes=axes,
                    names=(*names, *TAIL),
                    order=order,
                    absorption_per_px=absorption_per_px,
                    of_tails=of_tails,
                )
        general[model] = found[f"{cores[-1][0]} with an exponential tail{of_counts}"]
    return Forms(tuple(found.values()), general)


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

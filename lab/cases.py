"""Cases for a blind check: what is wrong with a line, which bench it stands on, and which series were taken.

Of the cases about 30 % have no effect, 40 % one, 15 % two, 15 % one that the twin's catalogue does not hold. Strengths
are spread evenly over the logarithm of the plausible range, so that they reach from below the detection limit to well
above it. One case in five lacks a part of the measurement set.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .effects import EFFECTS, EffectRequest

LABELS = {"none": 0.30, "single": 0.40, "pair": 0.15, "unknown": 0.15}
# What only fine pixels, or only a wide field, can show.
FINE = ("focal_spot", "mtf_tail", "k_fluorescence", "motion_blur", "misregistration", "unknown:sharpening")
COARSE = ("object_scatter", "veiling_glare", "heel", "off_focal")
# There all the time as a rule, but now and then they come later; what calibration would take in never comes before.
MAY_COME_LATER = ("veiling_glare", "image_lag", "nonlinearity", "row_noise", "quantisation")
# effects that the wrong data cannot tell apart: confusions are pooled by these
SETS: Mapping[str, tuple[str, ...]] = {
    "A": ("object_scatter", "veiling_glare", "dark_drift", "nonlinearity"),
    "B": ("kv_error", "filtration_error", "heel", "composition_error"),
    "C": ("focal_spot", "mtf_tail", "k_fluorescence", "motion_blur", "misregistration", "crosstalk"),
    "D": ("image_lag", "dark_drift", "output_drift"),
    "E": ("excess_noise", "mtf_tail", "nonlinearity"),
}
REDUCED = 0.20
REMOVABLE = ("afterglow", "wedge", "slab", "edge", "disc", "product", "turned", "near", "open_flats", "low_kV")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One case: the label, its effects, and how it is measured; everything but a seed and a size.

    Fields: label (`none`, `single`, `pair`, `unknown`); requests; protocol; geometry; leave_out (groups of series).
    """

    label: str
    requests: tuple[EffectRequest, ...]
    protocol: str
    geometry: str
    leave_out: tuple[str, ...] = ()

    def arguments(self) -> dict[str, Any]:
        """What `run_protocol` wants to know of the case."""
        return {
            "protocol": self.protocol,
            "geometry": self.geometry,
            "effects": self.requests,
            "leave_out": self.leave_out,
        }


def sample_strength(rng: np.random.Generator, name: str) -> float:
    """A strength in the effect's plausible range, even in its logarithm; of either sign where the effect has one."""
    law = EFFECTS[name]
    size = math.exp(rng.uniform(math.log(law.low), math.log(law.high)))
    strength = float(f"{size:.4g}")
    return -strength if law.signed and rng.random() < 0.5 else strength


def _request(rng: np.random.Generator, name: str) -> EffectRequest:
    strength = sample_strength(rng, name)
    since = "calibration" if name in MAY_COME_LATER and rng.random() < 0.25 else EFFECTS[name].since
    return EffectRequest(id=name, strength=strength, since=since)


def draw_case(rng: np.random.Generator, *, label: str | None = None, names: tuple[str, ...] | None = None) -> Case:
    """A case for a blind check; some lack a part of the measurement set.

    Args:
        rng: draws it.
        label: of `LABELS`; None draws one.
        names: the catalogue's effects to draw from; None: all of them.
    """
    if label is None:
        label = str(rng.choice(list(LABELS), p=list(LABELS.values())))
    known = [name for name, law in EFFECTS.items() if law.known and law.drawn and (names is None or name in names)]
    unknown = [name for name, law in EFFECTS.items() if not law.known]
    chosen: list[str] = []
    if label == "unknown":
        chosen = [str(rng.choice(unknown))]
    elif label != "none":
        count = min(2 if label == "pair" else 1, len(known))
        chosen = [str(name) for name in rng.choice(known, size=count, replace=False)]
    requests = tuple(_request(rng, name) for name in chosen)
    wants_fine, wants_coarse = any(name in FINE for name in chosen), any(name in COARSE for name in chosen)
    either = str(rng.choice(["fine", "coarse"]))
    geometry = either if wants_fine == wants_coarse else "fine" if wants_fine else "coarse"
    protocol = "full"
    leave_out: tuple[str, ...] = ()
    if rng.random() < REDUCED:
        way = rng.random()
        if way < 0.3:
            protocol = "short"
        elif way < 0.45:
            protocol = "products"
        else:
            count = int(rng.integers(1, 4))
            leave_out = tuple(sorted(str(name) for name in rng.choice(REMOVABLE, size=count, replace=False)))
    return Case(label=label, requests=requests, protocol=protocol, geometry=geometry, leave_out=leave_out)

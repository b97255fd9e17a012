"""What an effect of the catalogue is: its parameters, its strength, its stage, and the change that it makes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches

import numpy as np

from ...errors import InputError
from ..line_state import STAGES, Change, FloatArray

SINCE = ("always", "calibration")


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """A parameter of an effect.

    Fields: name; unit (empty: none); low, high (plausible range of its size); default; source (of the range); log
    (fitted in its logarithm); signed (may be negative with the same size); fitted (False: states a condition of the
    session, such as its length, and is not estimated).
    """

    name: str
    unit: str
    low: float
    high: float
    default: float
    source: str
    log: bool
    signed: bool = False
    fitted: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and self.low <= self.default <= self.high and math.isfinite(self.high)):
            raise InputError(
                f"parameter {self.name}",
                received=f"{self.low} to {self.high}, default {self.default}",
                expected="low <= default <= high, finite",
            )
        if self.log and not (self.low > 0 and not self.signed):
            raise InputError(f"parameter {self.name}", received=self.low, expected="above 0 and unsigned, for log")


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """An effect that a real line may have and the base model has not.

    Fields: id; title; parameters (the first is the strength); stage (where in the line it acts, see line_state);
    reference (source of the model); after_calibration (usual reading: True, it set in after the calibration series;
    False, it was always there); change: (state, parameters, context) -> state, which is no change at strength 0;
    needs (what must be known of instrument or series: `source_object_mm`, `source_detector_mm`, `pixel_mm`,
    `spectral`, `scene`); options (words that an applied effect may carry, with what they mean).
    """

    id: str
    title: str
    parameters: tuple[Parameter, ...]
    stage: str
    reference: str
    after_calibration: bool
    change: Change = field(repr=False)
    needs: tuple[str, ...] = ()
    options: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise InputError(f"effect {self.id}, stage", received=self.stage, expected="one of " + ", ".join(STAGES))
        if not self.parameters or self.parameters[0].name != "strength":
            raise InputError(f"effect {self.id}", received="no strength", expected="strength as first parameter")

    @property
    def strength(self) -> Parameter:
        """The parameter that reports quote."""
        return self.parameters[0]

    def values(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """All parameters by name; what is not given takes its default.

        Raises:
            InputError: a parameter that this effect has not, or a value that is not finite, or 0 or less of a length, time or energy.
        """
        result = {item.name: item.default for item in self.parameters}
        above_0 = {item.name for item in self.parameters[1:] if item.log}
        for name, value in parameters.items():
            if name not in result:
                near = get_close_matches(name, result, n=1, cutoff=0.0)
                raise InputError(
                    f"parameter of effect {self.id}",
                    received=name,
                    expected="one of " + ", ".join(result),
                    remedy=f"did you mean {near[0]}?" if near else "",
                )
            if not math.isfinite(value):
                raise InputError(f"{name} of effect {self.id}", received=value, expected="a finite number")
            if name in above_0 and value <= 0.0:
                raise InputError(f"{name} of effect {self.id}", received=value, expected="a number above 0")
            result[name] = float(value)
        return result


def spread_transfer(
    f_row: FloatArray, f_column: FloatArray, *, reach_px: float, order: float, usual_order: float
) -> FloatArray:
    """Transfer function (1 + (m / p) (2 pi L f)^2)^-p of light that spreads with reach L, of any shape p.

    p = 1/2 is exp(-R / L) / (2 pi L R), p = 1 a Lorentzian; larger orders come close to a Gaussian. The rms distance is the
    same for all orders; m = `usual_order` is the one for which reach_px is defined. Frequencies in cycles per pixel.
    """
    squared = (2.0 * np.pi * reach_px) ** 2 * (f_row**2 + f_column**2)
    return np.asarray((1.0 + usual_order / order * squared) ** -order)


def order_parameter(usual: float) -> Parameter:
    """The shape of a spread's transfer function."""
    return Parameter(
        name="order",
        unit="",
        low=0.5,
        high=6.0,
        default=usual,
        source="1/2: exponential over distance, 1: Lorentzian, large: Gaussian",
        log=True,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class AppliedEffect:
    """An effect as it is in one line: its parameters, and since when.

    Fields: id; parameters (name -> value; what is missing takes its default); since (`always`: it was there when the
    twin was calibrated, so that calibration took a part of it in; `calibration`: it came afterwards); options (words).
    """

    id: str
    parameters: Mapping[str, float]
    since: str = "always"
    options: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.since not in SINCE:
            raise InputError(f"effect {self.id}, since", received=self.since, expected="one of " + ", ".join(SINCE))
        for name, value in self.parameters.items():
            if not math.isfinite(value):
                raise InputError(f"{name} of effect {self.id}", received=value, expected="a finite number")

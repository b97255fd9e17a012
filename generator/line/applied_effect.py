"""An effect as one line has it: plain data, which twins and requests carry."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from ...errors import InputError

SINCE = ("always", "calibration")


@dataclass(frozen=True, slots=True, kw_only=True)
class AppliedEffect:
    """An effect as it is in one line: its parameters, and since when.

    Fields: id; parameters (name -> value; what is missing takes its default); since (`always`: it was there when the
    twin was calibrated, so that calibration took a part of it in; `calibration`: it came afterwards); options (words);
    strength_sd, law_sd: relative standard deviations of the strength, and of what the law says from one kind of measurement to
    another, as the diagnosis that found it saw (None: they count as known).
    """

    id: str
    parameters: Mapping[str, float]
    since: str = "always"
    options: Mapping[str, str] = field(default_factory=dict)
    strength_sd: float | None = None
    law_sd: float | None = None

    @property
    def sd(self) -> float:
        """Relative standard deviation of what the effect changes."""
        return math.hypot(self.strength_sd or 0.0, self.law_sd or 0.0)

    def __post_init__(self) -> None:
        if self.since not in SINCE:
            raise InputError(f"effect {self.id}, since", received=self.since, expected="one of " + ", ".join(SINCE))
        for name, value in self.parameters.items():
            if not math.isfinite(value):
                raise InputError(f"{name} of effect {self.id}", received=value, expected="a finite number")
        for name, sd in (("strength_sd", self.strength_sd), ("law_sd", self.law_sd)):
            if sd is not None and not 0.0 <= sd < math.inf:
                raise InputError(f"{name} of effect {self.id}", received=sd, expected="0 or more")

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
    law_sd: relative standard deviation by which its law is off from one kind of measurement to another, as the diagnosis that
    found it saw (None: nobody has seen).
    """

    id: str
    parameters: Mapping[str, float]
    since: str = "always"
    options: Mapping[str, str] = field(default_factory=dict)
    law_sd: float | None = None

    def __post_init__(self) -> None:
        if self.since not in SINCE:
            raise InputError(f"effect {self.id}, since", received=self.since, expected="one of " + ", ".join(SINCE))
        for name, value in self.parameters.items():
            if not math.isfinite(value):
                raise InputError(f"{name} of effect {self.id}", received=value, expected="a finite number")
        if self.law_sd is not None and not 0.0 <= self.law_sd < math.inf:
            raise InputError(f"law_sd of effect {self.id}", received=self.law_sd, expected="0 or more")

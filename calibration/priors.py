"""What is known of a tube and a detector before its flats are looked at. The one place where priors stand.

Each prior is Gaussian in the parameter (cut at the bounds); logarithms are natural.
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """Centre and standard deviation of a parameter, its bounds, and why."""

    centre: float
    sd: float
    low: float = -math.inf
    high: float = math.inf
    reason: str

    def __str__(self) -> str:
        return f"{self.centre:g} +- {self.sd:g} ({self.reason})"


PRIORS: dict[str, Prior] = {
    "inherent_filtration_mm_Al": Prior(
        centre=1.0,
        sd=1.5,
        low=0.0,
        high=12.0,
        reason="exit window, oil, housing and air as mm Al, beyond what is declared",
    ),
    "log_scintillator_thickness": Prior(
        centre=0.0, sd=0.2, low=-1.6, high=1.6, reason="packing density and tolerance of a declared scintillator"
    ),
    "kV_error": Prior(centre=0.0, sd=0.01, low=-0.06, high=0.06, reason="generators are set to about 1 %"),
    "log_output": Prior(
        centre=0.0, sd=1.0, reason="tube output over the model's; fixed by the level and the gain, not by this prior"
    ),
    "log_DN_per_keV": Prior(centre=0.0, sd=20.0, reason="electronics unknown"),
    "log_swank": Prior(
        centre=math.log(0.9),
        sd=0.07,
        low=math.log(0.3),
        high=0.0,
        reason="light only, 0.8-1: escape of K photons, which takes CsI and Gd2O2S screens down to 0.7, is in the response",
    ),
    "yield_exponent": Prior(
        centre=0.0, sd=0.02, reason="spectrum models differ by 2 % in output from 40 to 120 kV (casim against kqp)"
    ),
    "hardness_exponent": Prior(
        centre=0.0, sd=0.03, reason="spectrum models differ by 2 % in hardness at 40 kV (casim against kqp)"
    ),
}
UNDECLARED_SCINTILLATOR = Prior(
    centre=0.0, sd=0.5, low=-1.6, high=1.6, reason="scintillator not declared: CsI 0.5 mm assumed"
)
COUNTING_SWANK = Prior(
    centre=-0.005, sd=0.01, low=-0.1, high=0.0, reason="a counter has no energy-dependent pulse noise"
)
ATTENUATION_SCALE = Prior(
    centre=0.0, sd=0.015, reason="attenuation tables differ by 1-4 % (xraylib, Chantler, PENELOPE)"
)

LEVEL_DISCREPANCY = 0.003  # of the level of a kV and filter: reproducibility of tube and filters beyond the parameters
GAIN_DISCREPANCY = 0.01  # of the gain of a kV and filter

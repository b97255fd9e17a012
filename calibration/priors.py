"""What is known of a tube and a detector before its flats are looked at. The one place where priors stand.

Each prior is Gaussian in the parameter (cut at the bounds); logarithms are natural. Three kinds of parameters: what the
vendor does not tell (filtration, scintillator, voltage, output, gain), what the physics tables leave open (attenuation,
spectrum model, escape), and how well a line repeats itself (the discrepancies).
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
        sd=1.0,
        low=0.0,
        high=12.0,
        reason="exit window, oil, housing and air: 0 to 2.5 mm Al in most tubes, beyond what is declared",
    ),
    "log_scintillator_thickness": Prior(
        centre=0.0, sd=0.2, low=-1.6, high=1.6, reason="packing density and tolerance of a declared scintillator"
    ),
    "kV_error": Prior(centre=0.0, sd=0.01, low=-0.06, high=0.06, reason="generators are set to about 1 %"),
    "kV_tilt": Prior(centre=0.0, sd=0.002, reason="the error differs between voltages, by 0.2 % from 40 to 110 kV"),
    "log_output": Prior(
        centre=0.0, sd=0.3, reason="tube output over the model's: current, distance, worn anodes and fill factor"
    ),
    "log_DN_per_keV": Prior(centre=0.0, sd=20.0, reason="electronics unknown"),
    "log_swank": Prior(
        centre=math.log(0.9),
        sd=0.07,
        low=math.log(0.3),
        high=0.0,
        reason="light only, 0.8-1: escape of K photons, which takes CsI and Gd2O2S screens down to 0.7, is in the response",
    ),
    "spectrum_model": Prior(
        centre=0.5, sd=0.5, reason="SpekPy's casim is 0, its kqp 1: mean and sd of the two, taken as equally likely"
    ),
    "yield_exponent": Prior(
        centre=0.0, sd=0.01, reason="output against voltage beyond the models' own difference: 1 % from 40 to 110 kV"
    ),
    "hardness_exponent": Prior(
        centre=0.0,
        sd=0.02,
        reason="hardness beyond the models' own difference: 1.4 % from 30 to 60 keV",
    ),
    "escape_scale": Prior(
        centre=0.0,
        sd=0.1,
        low=-1.0,
        high=0.5,
        reason="K photons that leave the scintillator: yields to 3 %, columns and covers to 10 %",
    ),
    "scintillator_table": Prior(
        centre=0.67,
        sd=0.47,
        reason="0 is xraylib, 1 the mean of Chantler's and PENELOPE's: three equally likely tables",
    ),
}
# where measured spectra stand in for the model, windows and housing are in them
MEASURED_SPECTRUM: dict[str, Prior] = {
    "inherent_filtration_mm_Al": Prior(
        centre=0.0, sd=0.1, low=0.0, high=12.0, reason="beyond the measured spectrum: its own error, as mm Al"
    ),
    "spectrum_model": Prior(
        centre=0.0,
        sd=0.3,
        reason="the models' difference is in the measured spectrum; what differs between voltages stays",
    ),
}
FREE_OUTPUT = Prior(centre=0.0, sd=3.0, reason="distance or pixel pitch not declared: no absolute output")
UNDECLARED_SCINTILLATOR = Prior(
    centre=0.0, sd=0.5, low=-1.6, high=1.6, reason="scintillator not declared: CsI 0.5 mm or Gd2O2S 0.15 mm assumed"
)
# prior probability of Gd2O2S where nobody says: nothing is known, so CsI has the other half
GADOLINIUM_SHARE = 0.5
COUNTING_SWANK = Prior(
    centre=-0.005, sd=0.01, low=-0.1, high=0.0, reason="a counter has no energy-dependent pulse noise"
)
ATTENUATION_SCALE = Prior(centre=0.0, sd=0.01, reason="density and thickness of a filter")
TABLE_SHARE = Prior(
    centre=0.33, sd=0.47, reason="0 is xraylib, 1 the other table: xraylib, Chantler and PENELOPE are equally likely"
)
# of the shares of the two other tables of a material: of three equally likely tables one is right
SHARES_CORRELATION = -0.5

# Sizes of small departures, learned from the data. Nobody states them for a line, and lines differ by more than ten: each
# has a lognormal prior, by its median and its logarithm's standard deviation.

# Departures from tables and models: one factor for all their standard deviations. Its median is 0.3, its upper 95 % bound
# 1.4: most lines show little of all this, some much.
DEPARTURES = ("kV_tilt", "yield_exponent", "hardness_exponent", "escape_scale", "log_mu_")
DEPARTURE_FACTOR = 0.3
LOG_DEPARTURE_SD = 0.8

# Departure of single levels and gains from any such model: reproducibility of tube and filters, and physics that is not
# in it; relative standard deviation. Levels carry no other allowance for reproducibility. Settings measured more than once
# tell it best: a steady line's intervals shrink, and those of one that is not widen.
LEVEL_DISCREPANCY = 0.0006
GAIN_DISCREPANCY = 0.002
LOG_DISCREPANCY_SD = 0.8  # a factor of 2.2 either way

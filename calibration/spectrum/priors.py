"""What is known of a tube and a detector before its flats are looked at. The one place where priors stand.

Each prior is Gaussian in the parameter (cut at the bounds); logarithms are natural. Three kinds of parameters: what the
vendor does not tell (filtration, scintillator, voltage, output, gain), what the physics tables leave open (attenuation,
spectrum model, escape), and how well a line repeats itself (the discrepancies).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import HIGHEST_THRESHOLD_KEV


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

    @property
    def spread(self) -> float:
        """Standard deviation as the bounds leave it."""
        from scipy.stats import truncnorm

        return self.sd * float(truncnorm((self.low - self.centre) / self.sd, (self.high - self.centre) / self.sd).std())


PRIORS: dict[str, Prior] = {
    "inherent_filtration_mm_Al": Prior(
        centre=1.0,
        sd=1.5,
        low=0.0,
        high=12.0,
        reason="window, oil, housing and air beyond the declared: 0 to 2.5 mm Al in most industrial tubes, to 4.5 in medical ones",
    ),
    "log_scintillator_thickness": Prior(
        centre=-0.15,
        sd=0.25,
        low=-1.6,
        high=1.6,
        reason="of a declared one: columns fill 0.75 to 1 of a layer, grains 0.5 to 0.7 unless the label allows for it",
    ),
    "kV_error": Prior(
        centre=0.0,
        sd=0.01,
        low=-0.09,
        high=0.06,
        reason="generators are set to about 1 %; the mean of a rippling voltage lies by half of its ripple below the peak",
    ),
    "kV_tilt": Prior(
        centre=0.0, sd=0.003, reason="the error differs between voltages, by 0.3 % from 40 to 110 kV (kV meters' own)"
    ),
    "kV_variance": Prior(
        centre=2.7e-4,
        sd=4.8e-4,
        low=0.0,
        reason="relative variance of the voltage in an exposure: an eighth of the squared ripple, mean and sd over the ripples",
    ),
    "shared_charge": Prior(
        centre=0.35,
        sd=0.35,
        low=0.0,
        high=1.0,
        reason="share of a counter's photons whose charge two pixels share: few at 0.3 mm, most at 0.05 mm; none where it is added",
    ),
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
    "end_exponent": Prior(
        centre=-0.06,
        sd=0.08,
        reason="fall to the end point: mean and sd of SpekPy's six models (0 to -0.2); PTB's spectra want -0.08 to -0.13",
    ),
    "yield_exponent": Prior(
        centre=0.0,
        sd=0.05,
        reason="output against voltage: exponents of SpekPy's six models differ by 0.03 (sd), dose reports of two tubes leave 0.04",
    ),
    "hardness_exponent": Prior(
        centre=0.0,
        sd=0.15,
        reason="60 PTB qualities of 30 to 150 kV want -0.1 to +0.1 (HVL, mean energy), PTB's spectra at 20 to 45 kV +0.41",
    ),
    "hardness_tilt": Prior(
        centre=0.0,
        sd=0.1,
        reason="how that changes for each e-fold of kV: PTB's spectra want -0.16, PTB's qualities -0.1 to +0.06",
    ),
    "anode_roughness_um": Prior(
        centre=1.0,
        sd=1.5,
        reason="of the anode's metal beyond a smooth one: -0.4 to 1.3 um in PTB's spectra and qualities, a few um in worn anodes",
    ),
    "escape_scale": Prior(
        centre=-0.4,
        sd=1.0,
        low=-1.0,
        high=0.15,
        reason="K photons that leave, nearly flat: all that a slab lets out, to none where columns and covers stop them",
    ),
    "scintillator_table": Prior(
        centre=0.67,
        sd=0.47,
        reason="0 is xraylib, 1 the mean of Chantler's and PENELOPE's: three equally likely tables",
    ),
    "cover_mm_C": Prior(
        centre=0.5,
        sd=0.5,
        reason="cover, reflector and glue: carbon fibre 0.3 to 1.5 mm, or plastic, beyond what is declared",
    ),
    "cover_mm_Al": Prior(
        centre=0.0,
        sd=0.5,
        low=0.0,
        reason="cover not declared: half are of carbon fibre or plastic, without aluminium, half have up to 1 mm",
    ),
    "dead_layer_um": Prior(
        centre=3.0, sd=4.0, reason="scintillator whose light is lost: starting layers and tips of columns, a few um"
    ),
    "light_nonproportionality": Prior(
        centre=0.7,
        sd=0.7,
        reason="1 is a dip of 3 % above CsI's K edges; published dips are 2 to 5 %, near 0 where light is gathered for long",
    ),
    "light_exponent": Prior(
        centre=-0.02,
        sd=0.04,
        reason="light a keV falls by 15 to 20 % from 20 to 662 keV in CsI(Tl) (-0.05), by little in Gd2O2S and slow readout",
    ),
    "light_depth_slope": Prior(
        centre=0.1,
        sd=0.1,
        reason="light from the far side of a screen is dimmer: by 0 to 30 %, as its Swank factor has it",
    ),
    "swank_exponent": Prior(
        centre=0.0,
        sd=0.04,
        reason="light's Swank factor changes by a few per cent from 30 to 90 keV (depth of interaction)",
    ),
}
# Ripple r of a voltage: by how much it dips below its peak, relative to that. The mean of a dip as a sine's lies r / 2 lower and
# its relative variance is r^2 / 8, so that both are known together. Its order of magnitude differs between generators: each is
# equally likely from those of constant potential (0.2 %) to six pulses (13.4 %).
KV_RIPPLES = (0.002, 0.134)


def ripple_from_latent(latent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ripple of the voltage over its peak, its logarithm uniform where `latent` is a standard Gaussian, of any shape."""
    from scipy.special import ndtr

    low, high = KV_RIPPLES
    return np.asarray(low * np.exp(math.log(high / low) * ndtr(latent)))


def draw_parameters(priors: Mapping[str, Prior], draws: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Parameter sets as the priors have them (draw, parameter), the voltage's error and variance with their ripple.

    Of the shares of other attenuation tables each is drawn by itself.
    """
    from scipy.stats import truncnorm

    columns = {
        name: truncnorm.rvs(
            (prior.low - prior.centre) / prior.sd,
            (prior.high - prior.centre) / prior.sd,
            loc=prior.centre,
            scale=prior.sd,
            size=draws,
            random_state=rng,
        )
        for name, prior in priors.items()
    }
    if priors.get("kV_variance") is PRIORS["kV_variance"]:
        ripple = ripple_from_latent(rng.standard_normal(draws))
        columns["kV_error"] = columns["kV_error"] - 0.5 * ripple
        columns["kV_variance"] = ripple**2 / 8.0
    return np.stack(list(columns.values()), axis=1)


def spread_of(prior: Prior) -> float:
    """Standard deviation of a parameter before anything is measured: its own, and what the voltage's ripple adds to an error."""
    if prior is not PRIORS["kV_error"]:
        return prior.spread
    low, high = KV_RIPPLES
    mean, square = ((high**power - low**power) / (power * math.log(high / low)) for power in (1, 2))
    return math.hypot(prior.spread, 0.5 * math.sqrt(square - mean**2))


# parameters of a layer that is there or is not, as likely as not: where the Gaussian is negative, it is not
NONE_OR_SOME = ("cover_mm_Al",)
# parameters by which a line departs from tables and models, beyond what its sheet or its adjustment leaves open
DEPARTURES = (
    "kV_tilt",
    "kV_variance",
    "yield_exponent",
    "hardness_",
    "anode_roughness_um",
    "cover_mm_",
    "dead_layer_um",
    "light_",
    "swank_exponent",
    "log_mu_",
)
# where measured spectra stand in for the model, windows and housing are in them
MEASURED_SPECTRUM: dict[str, Prior] = {
    "inherent_filtration_mm_Al": Prior(
        centre=0.0, sd=0.1, low=0.0, high=12.0, reason="beyond the measured spectrum: its own error, as mm Al"
    ),
    "end_exponent": Prior(
        centre=0.0,
        sd=0.02,
        reason="in the measured spectrum: SpekPy's models change theirs by so much between voltages",
    ),
    "hardness_exponent": Prior(
        centre=0.0, sd=0.03, reason="of the measured spectrum: the spectrometer's own efficiency"
    ),
    "hardness_tilt": Prior(centre=0.0, sd=0.03, reason="between and beyond the measured spectra's voltages"),
    "anode_roughness_um": Prior(
        centre=0.0, sd=0.1, reason="in the measured spectrum: what differs between voltages stays"
    ),
    "kV_variance": Prior(centre=0.0, sd=1e-4, reason="in the measured spectrum: what differs between voltages stays"),
}
FREE_OUTPUT = Prior(centre=0.0, sd=3.0, reason="distance or pixel pitch not declared: no absolute output")
UNLIKE_OUTPUT = Prior(
    centre=0.0,
    sd=20.0,
    reason="far from the model's: loads, distance or pixel pitch are not as labelled, by nobody knows how much",
)
UNDECLARED_SCINTILLATOR = Prior(
    centre=-0.1, sd=0.5, low=-1.6, high=1.6, reason="scintillator not declared: CsI 0.5 mm or Gd2O2S 0.15 mm assumed"
)
# prior probability of Gd2O2S where nobody says: nothing is known, so CsI has the other half
GADOLINIUM_SHARE = 0.5
# of a counter's declared threshold (sd, keV): pixels are trimmed to a keV or so
THRESHOLD_SD_KEV = 1.0
UNDECLARED_THRESHOLD = Prior(
    centre=10.0,
    sd=10.0,
    low=0.0,
    high=HIGHEST_THRESHOLD_KEV,
    reason="threshold not declared: above noise (4 keV in silicon, 10 in CdTe), 20 to 35 where two energies are counted",
)
# of a counter, of which one pixel's variance over its mean tells the DN of a count (`counter_priors`)
COUNTING_SWANK = Prior(
    centre=-0.2,
    sd=0.3,
    low=-1.1,
    high=0.0,
    reason="noise of counts summed over neighbours, which a photon that they share raises by up to a factor of two or three",
)
COUNT_SD = 0.01  # relative, of the DN of a count, however well slopes agree: dead times, defects
# of the logarithm of gain over slope, which charge on two pixels raises: on three or four, and by K photons, it counts more often, up
# to as much again; two standard deviations
COUNTED_MORE_SHARE = 0.5
# shared charge over the logarithm of gain over slope, and its uncertainty: shared at random by two pixels, all charge raises that by
# 0.3 (threshold at 0.4 of the energy) to 0.7 (at 0.05)
SHARED_OVER_EXCESS, SHARED_OVER_EXCESS_SD = 2.0, 1.0
# in standard deviations of what `setting_errors` knows of it
DARK_CURRENT = "dark_current"
DARK_CURRENT_PRIOR = Prior(centre=0.0, sd=1.0, reason="dark current, of which darks at one exposure tell nothing")
# EN 485-4 allows 3 mm sheet 0.10 mm, a limit, whose law is rectangular; what iron and silicon of EN AW-1050A (EN 573-3, 99.5 % Al)
# add to the attenuation of aluminium at 40 keV is 2 % (6 % in EN AW-6082)
WEDGE_THICKNESS = Prior(
    centre=0.0,
    sd=math.hypot(0.10 / 3.0 / math.sqrt(3.0), 0.02),
    reason="of all steps of a wedge: tolerance of rolled sheet, iron and silicon in commercially pure aluminium",
)
ATTENUATION_SCALE = Prior(centre=0.0, sd=0.01, reason="density and thickness of a filter")
TABLE_SHARE = Prior(
    centre=0.33, sd=0.47, reason="0 is xraylib, 1 the other table: xraylib, Chantler and PENELOPE are equally likely"
)
# of the shares of the two other tables of a material: of three equally likely tables one is right
SHARES_CORRELATION = -0.5

# The widths above are stated one by one, and no common size of them is learned: two or four levels hold no number that would
# show one. What follows nobody states for a line, and lines differ in it by more than ten: sizes that the data show, each with a
# lognormal prior, by its median and its logarithm's standard deviation.

# Departure of single levels and gains from any such model: reproducibility of tube and filters, and physics that is not
# in it; relative standard deviation. Levels carry no other allowance for reproducibility. Settings measured more than once
# tell it best: a steady line's intervals shrink, and those of one that is not widen.
LEVEL_DISCREPANCY = 0.0006
GAIN_DISCREPANCY = 0.002
LOG_DISCREPANCY_SD = 0.8  # a factor of 2.2 either way

"""What dosimeters say of a tube: air kerma per mAs and its ratios, as data of the spectral fit, with their priors.

A reading of air kerma, over load and distance (K the kerma per mAs at 1 m that the tube's spectrum gives):

    ln reading = ln K(kV, filters) + r c + x <ln(E / 50 keV)> + setting's own + scatter and rounding

c is the dosimeter's calibration (r: its relative uncertainty at this reading), common to all; x the slope of its response
over energy. A ratio behind and before layers has no c. A half-value layer is the ratio 1/2 behind that much aluminium.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Filter
from ...generator.line.spectral_signal import KERMA_OUTPUT, OpenBeam, SpectralModel, absorber_thickness_name
from .priors import Prior

DOSIMETER_CALIBRATION = "log_dosimeter"
DOSIMETER_HARDNESS = "dosimeter_hardness_exponent"

# IEC 61674:2012 lets the response of a diagnostic dosimeter vary by 5 % over the radiation qualities it is rated for, and
# as much in its intrinsic error. A limit is a rectangular law: its standard deviation is the limit over root 3 (GUM 4.3.7).
DOSIMETER_LIMIT = 0.05
_RECTANGULAR = math.sqrt(3.0)
DOSIMETER_CALIBRATION_SD = DOSIMETER_LIMIT / _RECTANGULAR
# What a reading scatters where nobody repeated any, and how many repeats that assumption is worth against those made: it
# stands for the generator too, and gives way to ten repeats.
REPEATABILITY = 0.01
REPEATABILITY_WORTH = 4.0
# RQR 2 to RQR 10 (IEC 61267) lie up to so far in ln(mean energy) from the calibration's RQR 5
_RATED_LOG_ENERGY = 0.35

DOSE_PRIORS: dict[str, Prior] = {
    DOSIMETER_CALIBRATION: Prior(centre=0.0, sd=1.0, reason="the dosimeter's calibration, in its stated uncertainties"),
    DOSIMETER_HARDNESS: Prior(
        centre=0.0,
        sd=DOSIMETER_LIMIT / _RECTANGULAR / _RATED_LOG_ENERGY,
        reason="response of a dosimeter over energy: 5 % over its rated qualities (IEC 61674)",
    ),
    KERMA_OUTPUT: Prior(
        centre=0.0,
        sd=0.1,
        reason="flux in front of the dosimeter over that on the detector: fill factor, distances, cover",
    ),
}
# Dosimeters are read at medical tubes too, which filter more than those of inspection lines.
DOSE_FILTRATION = Prior(
    centre=2.0,
    sd=1.5,
    low=0.0,
    high=12.0,
    reason="0 to 2.5 mm Al in most industrial tubes, 2.5 to 4.5 in medical ones (2.5 at least: IEC 60601-1-3)",
)
FREE_KERMA_OUTPUT = Prior(
    centre=0.0, sd=3.0, reason="distance or pixel pitch not declared: the flats have no absolute output"
)

# Departure of one setting's kerma, and of one ratio, from any such spectrum, relative standard deviations (medians of
# lognormal priors, as those of levels and gains in `priors`): kV and filter of a setting stray on their own. Readings of
# two clinical tubes stray by 2 and 4.5 % over their filters (`validation/dosimeter.py --real`), a bench's by less; their
# ratios, where kV is not set anew, by 0.6 %.
KERMA_DISCREPANCY = 0.015
RATIO_DISCREPANCY = 0.003
# What has no absorption edge in the beam attenuates as two others together, of lower and of higher atomic number, to a part
# in a hundred: photoelectric effect and scattering have one shape each over energy (Alvarez and Macovski 1976,
# doi:10.1088/0031-9155/21/5/002). The pairs cover plastics to copper.
ABSORBER_PAIRS = (("polyethylene", "Al"), ("Al", "Cu"))
_WIDEST_ABSORBER = 0.5  # prior sd of an absorber's thicknesses over what either alone would need


@dataclass(frozen=True, slots=True, kw_only=True)
class KermaReading:
    """Air kerma per mAs at 1 m of one setting, uGy / mAs: all its readings together.

    Fields: kV, filters; value; relative_sd: of scatter and rounding; freedom: degrees of freedom that it is known by;
    calibration_sd: relative, of the dosimeter's calibration; rows: of the table.
    """

    kV: float
    filters: tuple[Filter, ...]
    value: float
    relative_sd: float
    calibration_sd: float
    freedom: float = math.inf
    rows: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class KermaRatio:
    """Air kerma behind layers or an unknown absorber over that before, at one kV and filter; no unit.

    Fields: kV, filters; layers (known ones), absorber (name of an unknown one; empty: none); value; relative_sd: of scatter
    and rounding; of_signal: the ratio of the detector's signals instead of kermas; rows: of the table.
    """

    kV: float
    filters: tuple[Filter, ...]
    value: float
    relative_sd: float
    layers: tuple[Filter, ...] = ()
    absorber: str = ""
    of_signal: bool = False
    rows: tuple[int, ...] = ()


def dose_parameters(
    kermas: Sequence[KermaReading], ratios: Sequence[KermaRatio], *, with_flats: bool
) -> tuple[str, ...]:
    """Names of the parameters that dose data add to a spectral model."""
    names: list[str] = []
    if kermas:
        names.append(DOSIMETER_CALIBRATION)
        if with_flats:
            names.append(KERMA_OUTPUT)
    if kermas or any(not item.of_signal for item in ratios):
        names.append(DOSIMETER_HARDNESS)
    return tuple(names)


def absorber_priors(
    model: SpectralModel, centre: NDArray[np.float64], ratios: Sequence[KermaRatio]
) -> dict[str, Prior]:
    """Wide priors of the thicknesses that unknown absorbers amount to, by the parameters' names.

    Of `ABSORBER_PAIRS` an absorber takes the pair that fits its ratios best at the parameter set `centre` (parameter,). The
    priors stand about that fit; half of what either material alone would need is far wider than what the data leave, so
    that where they stand is a start and says nothing.
    """
    found: dict[str, Prior] = {}
    for absorber in dict.fromkeys(item.absorber for item in ratios if item.absorber):
        own = [item for item in ratios if item.absorber == absorber]
        measured = np.array([math.log(item.value) for item in own])
        weights = []
        for item in own:
            photons = model.weights(centre[None, :], OpenBeam(kV=item.kV, filters=(*item.filters, *item.layers)))[0]
            weight = photons * model.kerma_weights[: photons.size]
            weights.append(weight / weight.sum())
        fits = []
        for pair in ABSORBER_PAIRS:
            mus = [np.stack([model.mu(material)[: weight.size] for material in pair]) for weight in weights]
            fits.append((*_thicknesses(measured, weights, mus), pair, mus))
        _, both, pair, mus = min(fits, key=lambda fit: fit[0])
        for place, material in enumerate(pair):
            alone = _thicknesses(measured, weights, [mu[place : place + 1] for mu in mus])[1][0]
            found[absorber_thickness_name(absorber, material)] = Prior(
                centre=float(both[place]),
                sd=_WIDEST_ABSORBER * float(alone),
                low=0.0,
                reason=f"{absorber}, of unknown composition, as {material}",
            )
    return found


def _thicknesses(
    measured: NDArray[np.float64], weights: Sequence[NDArray[np.float64]], mus: Sequence[NDArray[np.float64]]
) -> tuple[float, NDArray[np.float64]]:
    """Squared misfit and thicknesses (material,) of 0 mm or more of the least squares of ln sum(w exp(-mu t))."""
    from scipy.optimize import least_squares

    def misfit(thickness_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        pairs = zip(weights, mus, strict=True)
        return np.array([math.log(float(weight @ np.exp(-thickness_mm @ mu))) for weight, mu in pairs]) - measured

    # the start: each material takes an equal part of the depth, at the beam's mean attenuation
    mean = np.array([mu @ weight for weight, mu in zip(weights, mus, strict=True)])
    start = -np.mean(measured) / mean.mean(axis=0) / mean.shape[1]
    fit = least_squares(misfit, start, bounds=(0.0, np.inf), x_scale=start)
    return float(2.0 * fit.cost), np.asarray(fit.x, dtype=np.float64)

"""Effective attenuation (Eq. 4): what one number of mu a polychromatic system would read."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..materials import Material, mu_per_mm
from .detector import Response, detector_response
from .spectrum import Spectrum

FloatArray = NDArray[np.float64]


def signal_weights(spectrum: Spectrum, response: Response | None = None) -> FloatArray:
    """(n,) share of each energy in the detector's signal, sum 1.

    w = E D(E) phi(E) for an energy-integrating detector, w = A(E) phi(E) for a photon-counting one (A: share that
    interacts): the response's first moment times the fluence, normalised.

    Args:
        spectrum: the beam that reaches the detector without the object.
        response: the detector, on the spectrum's energies; None: 0.5 mm CsI, energy-integrating.

    Raises:
        InputError: the response stands on other energies, or nothing is detected.
    """
    detector = detector_response(energies_keV=spectrum.energies_keV) if response is None else response
    bins = spectrum.energies_keV.size
    if detector.energies_keV.size < bins or not np.array_equal(detector.energies_keV[:bins], spectrum.energies_keV):
        raise InputError(
            "response",
            received=f"a response at {detector.energies_keV.size} energies",
            expected="a response on the spectrum's energies (or a longer piece of the same grid)",
        )
    weights = spectrum.fluence * detector.mean_deposited_keV[:bins]
    total = weights.sum()
    if not total > 0:
        raise InputError("spectrum", received="a beam of which nothing is detected", expected="a detectable beam")
    return np.asarray(weights / total, dtype=float)


def effective_mu_per_mm(
    material: Material,
    *,
    spectrum: Spectrum,
    response: Response | None = None,
    thickness_mm: ArrayLike | None = None,
    table: str = "xraylib",
) -> FloatArray:
    """Effective linear attenuation coefficient in 1/mm of a material in this beam and detector.

    Without a thickness, the limit of a thin object: mu_eff = sum(w mu) / sum(w). With thickness L, what is measured
    through it: -ln(sum(w exp(-mu L)) / sum(w)) / L, which falls as L grows (beam hardening) and tends to the thin limit
    as L tends to 0. w: `signal_weights`. No scatter.

    Args:
        material: the object.
        spectrum: the beam that reaches the detector without the object.
        response: the detector; None: 0.5 mm CsI, energy-integrating.
        thickness_mm: thicknesses, any shape, 0 or more (0 gives the thin limit); None: thin limit.
        table: attenuation table.

    Returns:
        Array of the shape of `thickness_mm` (shape () for None).

    Raises:
        InputError: a negative or infinite thickness, or what `signal_weights` refuses.

    Source: Beer-Lambert; Andriiashen et al. (2024), Eq. 4, with the normalisation that it lacks in print.
    """
    weights = signal_weights(spectrum, response)
    mu = mu_per_mm(material, spectrum.energies_keV, table=table)
    thin = np.asarray(weights @ mu)
    if thickness_mm is None:
        return thin
    thickness = np.asarray(thickness_mm, dtype=float)
    if not np.all(np.isfinite(thickness) & (thickness >= 0)):
        raise InputError(
            "thickness_mm", received=f"{thickness.min()} mm", expected="finite thicknesses of 0 mm or more"
        )
    # the least attenuated energy is taken out, so that thick objects do not underflow
    least = mu[weights > 0].min()
    remaining = np.exp(-np.multiply.outer(thickness, np.maximum(mu - least, 0.0))) @ weights
    # below 1e-6 of attenuation the quotient loses digits and the thin limit is nearer
    tiny = thickness * thin < 1e-6
    safe = np.where(tiny, 1.0, thickness)
    return np.where(tiny, thin, least - np.log(remaining) / safe)

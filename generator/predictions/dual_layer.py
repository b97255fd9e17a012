"""Dual-layer panels: what the second scintillator, behind the first and an interlayer, makes of the same exposure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Setting
from ...errors import InputError
from ...materials import transmission
from ...spectra import BIN_WIDTH_KEV, detector_response
from ..frames.present_line import present_line
from ..line.spectral_signal import OpenBeam
from ..line.twin import Estimate, Twin, estimate_from_log_draws
from ..line.twin_spectrum import model_of_posterior, spectral_posterior_of


@dataclass(frozen=True, slots=True, kw_only=True)
class BackLayer:
    """The back layer beside the front one, at one exposure.

    Fields: signal_over_front (energy absorbed in the back over that in the front; the ratio of the images' DN where both
    layers make the same DN of a keV); photons_absorbed (in the back, a pixel and frame); mean_energy_front_keV,
    mean_energy_back_keV (of what each absorbs, by energy).
    """

    signal_over_front: Estimate
    photons_absorbed: Estimate
    mean_energy_front_keV: Estimate
    mean_energy_back_keV: Estimate

    def as_dict(self) -> dict[str, dict[str, float]]:
        """Plain numbers for JSON."""
        return {
            "signal_over_front": self.signal_over_front.as_dict(),
            "photons_absorbed": self.photons_absorbed.as_dict(),
            "mean_energy_front_keV": self.mean_energy_front_keV.as_dict(),
            "mean_energy_back_keV": self.mean_energy_back_keV.as_dict(),
        }


def predict_back_layer(twin: Twin, setting: Setting) -> BackLayer:
    """The back layer's share of an exposure, from a twin that was calibrated on the front layer.

        N_back(E) = N(E) T_cover(E) exp(-mu_front t_front) T_interlayer(E)

    with the posterior's thickness of the front layer; what it absorbs follows from the back layer as declared. Left out:
    K-fluorescence that leaves the front layer and is caught in the back (a millimetre of copper between them stops it)
    and the DN that the back layer makes of a keV, which only its own flats can tell (`raytwin calibrate --layer back`).

    Raises:
        InputError: no back scintillator declared, no spectral part, no tube load, or no photon that reaches the back.
    """
    instrument = twin.instrument
    if not instrument.back_scintillator:
        raise InputError(
            "twin", received="an instrument with one sensitive layer", expected="a declared back_scintillator"
        )
    twin = present_line(twin).twin  # effects on the beam reach the back layer too
    posterior = spectral_posterior_of(twin)
    model = model_of_posterior(posterior, highest_kV=setting.kV)
    load = setting.stated_load_mAs()
    beam = OpenBeam(kV=setting.kV, filters=setting.filters)
    photons = model.weights(posterior.samples, beam)
    top = photons.shape[1]
    energies = model.energies_keV[:top]
    front_depth = np.sum([model.depth(layer)[:top] for layer in posterior.scintillator], axis=0)
    thickness = np.exp(posterior.column("log_scintillator_thickness"))
    cover = transmission(posterior.cover, energies, bin_width_keV=BIN_WIDTH_KEV)
    reaching = photons * cover
    behind = reaching * np.exp(-thickness[:, None] * front_depth)
    back = detector_response(
        energies_keV=energies,
        scintillator=instrument.back_scintillator,
        cover=instrument.interlayer or (),
        counting=posterior.counting,
    )
    front = model.signal(posterior.samples, beam)
    front_signal = front.rate_DN_per_mAs / np.exp(posterior.column("log_DN_per_keV"))
    back_signal = behind @ back.mean_deposited_keV
    back_photons = behind @ back.interacting_fraction
    if not np.all(back_photons > 1e-30 * photons.sum(axis=1)):
        raise InputError(
            "interlayer", received=str(setting), expected="a beam of which something reaches the back layer"
        )
    absorbed_front = reaching * -np.expm1(-thickness[:, None] * front_depth)
    absorbed_back = behind * back.interacting_fraction
    distance = setting.source_detector_mm or instrument.source_detector_mm or 1000.0
    factor = load * (1000.0 / distance) ** 2 * (instrument.pixel_mm or 1.0) ** 2 * setting.binning**2
    strays = posterior.level_discrepancy
    return BackLayer(
        signal_over_front=_estimate(back_signal / front_signal, np.sqrt(2.0) * strays),
        photons_absorbed=_estimate(back_photons * factor, strays),
        mean_energy_front_keV=_estimate(_mean_energy(absorbed_front, energies), 0.0),
        mean_energy_back_keV=_estimate(_mean_energy(absorbed_back, energies), 0.0),
    )


def _mean_energy(photons: NDArray[np.float64], energies_keV: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean energy (draw,), keV, each photon weighed by its energy."""
    return np.asarray(photons @ energies_keV**2 / (photons @ energies_keV))


def _estimate(draws: NDArray[np.float64], relative_sd: float) -> Estimate:
    return estimate_from_log_draws(np.log(draws), float(relative_sd))

"""Spectra of X-ray tubes and the response of detectors: from kV and filters to what is detected.

Files:
    grid          the energy grid
    tube          tube spectra, and between their kV
    _packaged     spectra that come with the package; make_table writes them
    _cache        spectra kept on disk
    measured      measured spectra
    spectrum      mean energy, kerma, half-value layers
    detector      energy that a detector keeps of each photon
    light_yield   light of a scintillator against energy
    effective     effective attenuation
"""

from ._packaged import is_packaged
from .detector import DEFAULT_SCINTILLATOR, Response, counted_fraction, detector_response, k_escape_fractions
from .effective import effective_mu_per_mm, signal_weights
from .grid import BIN_WIDTH_KEV, FIRST_CENTRE_KEV, MAXIMUM_KV, energy_grid_keV
from .light_yield import electron_response, light_per_keV
from .measured import spectrum_from_file
from .spectrum import (
    Spectrum,
    air_kerma_uGy_per_mAs,
    filtered_spectrum,
    fluence_per_cm2_mAs,
    half_value_layer_mm,
    mean_energy_keV,
)
from .tube import (
    DEFAULT_ANGLE_DEG,
    DEFAULT_ANODE,
    DEFAULT_MODEL,
    MAXIMUM_KV_OF_ANODE,
    MINIMUM_KV,
    MODELS,
    checked_anode,
    checked_kV,
    tube_fluence_interpolated,
    tube_spectrum,
)

__all__ = [
    "BIN_WIDTH_KEV",
    "DEFAULT_ANGLE_DEG",
    "DEFAULT_ANODE",
    "DEFAULT_MODEL",
    "DEFAULT_SCINTILLATOR",
    "FIRST_CENTRE_KEV",
    "MAXIMUM_KV",
    "MAXIMUM_KV_OF_ANODE",
    "MINIMUM_KV",
    "MODELS",
    "Response",
    "Spectrum",
    "air_kerma_uGy_per_mAs",
    "checked_anode",
    "checked_kV",
    "counted_fraction",
    "detector_response",
    "effective_mu_per_mm",
    "electron_response",
    "energy_grid_keV",
    "filtered_spectrum",
    "fluence_per_cm2_mAs",
    "half_value_layer_mm",
    "is_packaged",
    "k_escape_fractions",
    "light_per_keV",
    "mean_energy_keV",
    "signal_weights",
    "spectrum_from_file",
    "tube_fluence_interpolated",
    "tube_spectrum",
]

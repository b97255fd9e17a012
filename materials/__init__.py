"""Materials by name, composition and density, and how they attenuate X-rays."""

from .attenuation import (
    MAXIMUM_ENERGY_KEV,
    MINIMUM_ENERGY_KEV,
    TABLES,
    absorption_edges_keV,
    bins_cut_by_edges,
    energies_inside_bins,
    mass_attenuation_cm2_g,
    mass_energy_absorption_cm2_g,
    mass_photoelectric_cm2_g,
    mu_per_mm,
    optical_depth,
    transmission,
)
from .library import Library, library_from_files, material_from_name, nist_identifier, read_library
from .material import Material, atomic_number_from_symbol, mass_fractions_from_formula, mixture_by_mass
from .scattering import scattering_per_sr

__all__ = [
    "MAXIMUM_ENERGY_KEV",
    "MINIMUM_ENERGY_KEV",
    "TABLES",
    "Library",
    "Material",
    "absorption_edges_keV",
    "atomic_number_from_symbol",
    "bins_cut_by_edges",
    "energies_inside_bins",
    "library_from_files",
    "mass_attenuation_cm2_g",
    "mass_energy_absorption_cm2_g",
    "mass_fractions_from_formula",
    "mass_photoelectric_cm2_g",
    "material_from_name",
    "mixture_by_mass",
    "mu_per_mm",
    "nist_identifier",
    "optical_depth",
    "read_library",
    "scattering_per_sr",
    "transmission",
]

"""What is true of a system and of the series that it took: the answers that a calibration is judged by."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Setting, text_from_filters
from .attenuation import mu_per_mm
from .response import (
    Level,
    compute_incidence,
    compute_level,
    equivalent_sigma_px,
    gain_DN,
    level_of_groups,
    noise_shares,
    tube_load_mAs,
)
from .system import DetectorMaps, LabSystem, detector_maps


def _level(system: LabSystem, setting: Setting) -> Level:
    return level_of_groups(compute_incidence(system, kV=setting.kV, filters=setting.filters))


def aluminium_equivalent_mm(system: LabSystem) -> float:
    """Inherent filtration, rough anode and covers as mm of aluminium: exact for aluminium, else matched at 30 keV.

    Flats cannot tell on which side of the object a layer lies.
    """
    energy_keV = np.array([30.0])
    layers = (*system.inherent_filtration, *system.cover)
    total = sum(mu_per_mm(layer.material, energy_keV)[0] * layer.thickness_mm for layer in layers)
    total += mu_per_mm("W", energy_keV)[0] * system.anode_rough_um / 1000.0
    return float(total / mu_per_mm("Al", energy_keV)[0])


def electronic_noise_DN(system: LabSystem, read_noise_DN: NDArray[np.float32]) -> float:
    """Temporal noise of a pixel's electronics (median of pixels (n,) or (row, column)), with what its row and column share."""
    sizes = system.unkindness
    lines = 1.0 + sizes.row_noise_sigma**2 + sizes.column_noise_sigma**2
    return float(np.median(read_noise_DN)) * math.sqrt(lines)


def flat_truth(system: LabSystem, maps: DetectorMaps, setting: Setting) -> dict[str, float]:
    """Expected flatfield at a setting, detector median over good pixels.

    Args:
        system, maps: the truth.
        setting: with a current or power; `averaged` counts.

    Returns:
        `mean_DN` above dark, `sd_DN` (temporal, one pixel, of the mean of `averaged` frames), `gain_DN` (quantum
        variance over signal with the blur's share restored, secondary quanta included; the same at every level),
        `photon_transfer_slope_DN` (what a straight line through variance against signal gives),
        `photons_absorbed` (per pixel, single frame), `DN_per_ms`.
    """
    level = _level(system, setting)
    load_mAs = tube_load_mAs(setting)
    if setting.source_detector_mm is not None:
        load_mAs *= (system.source_detector_mm / setting.source_detector_mm) ** 2
    conversion = float(np.median(maps.DN_per_electron[maps.DN_per_electron > 0]))
    mean_DN = level.energy_keV_per_mAs * load_mAs * system.electrons_per_keV * conversion
    gain = gain_DN(system, level, DN_per_electron=conversion)
    slope = (gain - conversion) * noise_shares(system) + conversion
    dark_variance_DN2 = (
        electronic_noise_DN(system, maps.read_noise_DN) ** 2
        + conversion * float(np.median(maps.dark_current_DN_per_ms)) * setting.exposure_ms
        + 1.0 / 12.0
    )
    return {
        "mean_DN": mean_DN,
        "sd_DN": math.sqrt((slope * mean_DN + dark_variance_DN2) / setting.averaged),
        "gain_DN": gain,
        "photon_transfer_slope_DN": slope,
        "photons_absorbed": level.photons_absorbed_per_mAs * load_mAs,
        "DN_per_ms": mean_DN / setting.exposure_ms,
    }


def compute_truth(system: LabSystem, *, settings: Iterable[Setting], exposures_ms: Iterable[float]) -> dict[str, Any]:
    """Everything that is true of a system, and its levels for every kV and filter among the settings.

    Args:
        system: the truth.
        settings: of the flats and objects that were measured.
        exposures_ms: for which the dark level is given.

    Returns:
        A dictionary for JSON. Lengths in mm, levels in DN, detector medians over good pixels.
    """
    maps = detector_maps(system)
    good = np.ones((system.rows, system.columns), dtype=bool)
    for row, column, _ in maps.bad_pixels:
        good[row, column] = False
    settings = list(settings)
    levels = []
    for kV, filters in sorted({(s.kV, s.filters) for s in settings}, key=lambda pair: (pair[0], str(pair[1]))):
        reference = Setting(kV=kV, exposure_ms=1000.0, current_mA=1.0, filters=filters)
        expected = flat_truth(system, maps, reference)
        exact = compute_level(system, kV=kV, filters=filters)
        levels.append(
            {
                "kV": kV,
                "filter": text_from_filters(filters),
                "gain_DN": expected["gain_DN"],
                "photon_transfer_slope_DN": expected["photon_transfer_slope_DN"],
                "DN_per_mAs": expected["mean_DN"],
                "photons_absorbed_per_mAs": expected["photons_absorbed"],
                "mean_deposit_keV": exact.energy_keV_per_mAs / exact.photons_absorbed_per_mAs,
                "swank": exact.energy_keV_per_mAs**2
                / (exact.photons_absorbed_per_mAs * exact.squared_keV2_per_mAs)
                * system.light_swank,
                "saturation_DN": system.saturation_DN,
            }
        )
    return {
        "size": [system.rows, system.columns],
        "pixel_mm": system.pixel_mm,
        "source_object_mm": system.source_object_mm,
        "source_detector_mm": system.source_detector_mm,
        "anode_angle_deg": system.anode_angle_deg,
        "kV_offset_percent": system.kV_offset_percent,
        "flux_scale": system.tube_output,
        "inherent_filtration": text_from_filters(system.inherent_filtration),
        "inherent_filtration_mm_Al": aluminium_equivalent_mm(system),
        "tube_model": system.tube_model,
        "kV_ripple_percent": system.kV_ripple_percent,
        "anode_rough_um": system.anode_rough_um,
        "output_exponent": system.output_exponent,
        "cover": text_from_filters(system.cover),
        "scintillator": f"{system.scintillator}:{system.scintillator_mm:g}",
        "labelled_scintillator_mm": system.labelled_scintillator_mm,
        "k_escape_share": system.k_escape_share,
        "light_curve": system.light_curve,
        "depth_light": system.depth_light,
        "scintillator_mm": system.scintillator_mm,
        "light_swank": system.light_swank,
        "electrons_per_keV": system.electrons_per_keV,
        "DN_per_electron": float(np.median(maps.DN_per_electron[good])),
        # Of the core; the spread as a whole below, with the Gaussian that leaves the same share of the quanta's noise.
        "psf_sigma_px": system.psf_sigma_px,
        "spread": {
            "equivalent_sigma_px": equivalent_sigma_px(system),
            "core_row_px": system.core_px[0],
            "core_column_px": system.core_px[1],
            "tail_share": system.tail_share,
            "tail_length_px": system.tail_length_px,
            "tail_law": system.tail_law,
        },
        "noise_correlation": [
            {"lag_row": row, "lag_column": column, "value": noise_shares(system, row, column) / noise_shares(system)}
            for row, column in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0))
        ],
        # of one pixel: what its row and its column share is part of it
        "read_noise_DN": electronic_noise_DN(system, maps.read_noise_DN[good]),
        # What a dark series shows: electronic noise and the rounding of the ADC.
        "dark_sd_DN": math.sqrt(electronic_noise_DN(system, maps.read_noise_DN[good]) ** 2 + 1.0 / 12.0),
        "dark_DN": float(np.median(maps.dark_DN[good])),
        "dark_current_DN_per_ms": float(np.median(maps.dark_current_DN_per_ms[good])),
        "dark_DN_at": [
            {
                "exposure_ms": exposure_ms,
                "dark_DN": float(np.median((maps.dark_DN + maps.dark_current_DN_per_ms * exposure_ms)[good])),
            }
            for exposure_ms in sorted(set(exposures_ms))
        ],
        "bits": system.bits,
        "saturation_DN": system.saturation_DN,
        "bad_pixels": [{"row": row, "column": column, "kind": kind} for row, column, kind in maps.bad_pixels],
        "levels": levels,
    }

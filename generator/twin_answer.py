"""The answer of a calibration: what a twin knows, in plain numbers, and as a short table."""

from typing import Any

import numpy as np

from ..acquisition.setting import text_from_filters
from ..results import Table, interval_text
from .twin import Estimate, SpreadEstimate, Twin


def spread_answer(spread: SpreadEstimate) -> dict[str, Any]:
    """The optical spread as the answer has it: family, model, and each parameter with its interval."""
    value = spread.value
    return {
        "family": spread.family,
        "model": value.model,
        **{
            name: (spread.intervals[name].as_dict() if name in spread.intervals else getattr(value, name))
            for name in ("sigma_px", "aspect", "tail_share", "tail_px")
        },
        "variance_share": value.variance_share,
    }


def calibration_answer(twin: Twin) -> dict[str, Any]:
    """The answer of `raytwin calibrate --json`."""

    def plain(estimate: Estimate | None) -> dict[str, float] | None:
        return None if estimate is None else estimate.as_dict()

    spectral = twin.spectral
    filtration = flux = None
    warnings = list(twin.warnings)
    if spectral is not None:
        filtration = spectral.interval("inherent_filtration_mm_Al")
        if any(level.rate_DN_per_mAs for level in twin.levels):
            draws = np.exp(spectral.column("log_output"))
            low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975])
            flux = Estimate(value=float(middle), low=float(low), high=float(high))
    if twin.noise.spread.gaussian_px is None:
        warnings.append(
            "psf_sigma_px is null: most of the light is in the tail of the spread, which no Gaussian width describes; see `spread`"
        )
    if filtration is None:
        warnings.append("inherent_filtration_mm_Al is null: the twin has no spectral part")
    if flux is None:
        warnings.append("flux_scale is null: it needs kV and tube load")
    return {
        "psf_sigma_px": plain(twin.noise.spread.gaussian_px),
        "spread": spread_answer(twin.noise.spread),
        "read_noise_DN": plain(twin.noise.read_noise_DN),
        "dark_DN": plain(twin.dark_DN),
        "inherent_filtration_mm_Al": plain(filtration),
        "flux_scale": plain(flux),
        "levels": [
            {
                "kV": level.kV,
                "filter": text_from_filters(level.filters),
                "gain_DN": level.gain_DN.value,
                "gain_DN_low": level.gain_DN.low,
                "gain_DN_high": level.gain_DN.high,
                "photon_transfer_slope_DN": level.photon_transfer_slope_DN.value,
                "photon_transfer_slope_DN_low": level.photon_transfer_slope_DN.low,
                "photon_transfer_slope_DN_high": level.photon_transfer_slope_DN.high,
                "rate_DN_per_mAs": plain(level.rate_DN_per_mAs),
                "saturation_DN": level.saturation_DN,
                "series": list(level.series),
            }
            for level in twin.levels
        ],
        "bad_pixels": {
            "count": int(np.count_nonzero(twin.maps.bad_pixels)),
            "share_percent": 100.0 * float(np.mean(twin.maps.bad_pixels > 0)),
            "reasons": twin.evidence.get("bad_pixels", {}),
        },
        "undetermined": list(spectral.undetermined) if spectral is not None else [],
        "next_measurement": twin.evidence.get("next_measurement"),
        "evidence": dict(twin.evidence),
        "warnings": warnings,
    }


def twin_table(twin: Twin) -> Table:
    """The twin in ten lines: detector, noise, spread, tube, levels."""
    answer = calibration_answer(twin)
    instrument, spectral = twin.instrument, twin.spectral
    pitch = "unknown pitch" if instrument.pixel_mm is None else f"{instrument.pixel_mm:g} mm"
    rows_px, columns_px = twin.maps.shape
    title = f"Twin of a detector of {rows_px} x {columns_px} pixels, {pitch}"
    rows = [
        (name, *interval_text(answer[key]), unit)
        for name, key, unit in (
            ("dark", "dark_DN", "DN"),
            ("read noise", "read_noise_DN", "DN"),
            ("optical spread (sigma)", "psf_sigma_px", "px"),
            ("inherent filtration", "inherent_filtration_mm_Al", "mm Al"),
            ("flux scale", "flux_scale", "x model"),
        )
    ]
    shown = answer["levels"][:6]
    for level in shown:
        voltage = "unknown kV" if level["kV"] is None else f"{level['kV']:g} kV"
        gain = {"value": level["gain_DN"], "low": level["gain_DN_low"], "high": level["gain_DN_high"]}
        rows.append((f"gain, {voltage} {level['filter']}".strip(), *interval_text(gain), "DN"))
    notes = []
    if len(answer["levels"]) > len(shown):
        notes.append(f"{len(answer['levels']) - len(shown)} more levels")
    if spectral is None:
        notes.append("no spectral part: predictions at the measured kV and filters only")
    if twin.effects:
        notes.append("effects: " + ", ".join(item.id for item in twin.effects))
    if answer["warnings"]:
        notes.append(f"{len(answer['warnings'])} warnings: see .warnings")
    return Table(title=title, header=("", "value", "95 % interval", "unit"), rows=tuple(rows), notes=tuple(notes))

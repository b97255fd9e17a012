"""The answer of a calibration: what a twin knows, in plain numbers, and as a short table."""

from dataclasses import asdict
from typing import Any

import numpy as np

from ...acquisition.setting import text_from_filters
from ...materials import material_from_name, mu_per_mm
from ...results import Table, counted, interval_text
from ..line.twin import BAD_PIXEL_MAP, Estimate, SpectralPosterior, SpreadEstimate, Twin
from ..predictions.tube_twin import TubeTwin

_EQUIVALENT_KEV = 30.0
BEYOND = "mm Al beyond the declared"  # unit of the inherent filtration


def spread_answer(spread: SpreadEstimate) -> dict[str, Any]:
    """The optical spread as the answer has it: family, model, and each parameter with its interval."""
    value = spread.value
    return {
        "family": spread.family,
        "model": value.model,
        "axes": value.axes,
        **{
            name: (spread.intervals[name].as_dict() if name in spread.intervals else getattr(value, name))
            for name in ("sigma_px", "aspect", "tail_share", "tail_px", "tail_order", "absorption_per_px")
        },
        "variance_share": value.variance_share,
        "others": [asdict(item) for item in spread.others],
    }


def calibration_answer(twin: Twin | TubeTwin) -> dict[str, Any]:
    """The answer of `raytwin calibrate --json`; of a tube alone, what needs a detector is null."""
    if isinstance(twin, TubeTwin):
        return _tube_answer(twin)

    def plain(estimate: Estimate | None) -> dict[str, float] | None:
        return None if estimate is None else estimate.as_dict()

    spectral = twin.spectral
    filtration = flux = None
    if spectral is not None:
        filtration = equivalent_filtration(spectral)
        if any(level.rate_DN_per_mAs for level in twin.levels):
            flux = _output_scale(twin)
    reasons = {
        "psf_sigma_px": "most of the light is in the tail of the spread, which no Gaussian width describes; see `spread`",
        "inherent_filtration_mm_Al": "the twin has no spectral part",
        "flux_scale": "it needs kV and tube load",
    }
    found = {"psf_sigma_px": twin.noise.spread.gaussian_px, "inherent_filtration_mm_Al": filtration, "flux_scale": flux}
    nulls = [f"{name} is null: {reasons[name]}" for name, value in found.items() if value is None]
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
        BAD_PIXEL_MAP: {
            "count": int(np.count_nonzero(twin.maps.bad_pixels)),
            "share_percent": 100.0 * float(np.mean(twin.maps.bad_pixels > 0)),
            "reasons": twin.evidence.get(BAD_PIXEL_MAP, {}),
        },
        "undetermined": list(spectral.undetermined) if spectral is not None else [],
        "next_measurement": twin.evidence.get("next_measurement"),
        "evidence": dict(twin.evidence),
        "warnings": [*twin.warnings, *nulls],
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
            ("inherent filtration", "inherent_filtration_mm_Al", BEYOND),
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
        notes.append(f"{counted(len(answer['levels']) - len(shown), 'more level')}")
    if spectral is None:
        notes.append("no spectral part: predictions at the measured kV and filters only")
    if twin.effects:
        notes.append("effects: " + ", ".join(item.id for item in twin.effects))
    notes += answer["warnings"][len(twin.warnings) :]
    if twin.warnings:
        notes.append(f"{counted(len(twin.warnings), 'warning')}: see .warnings")
    return Table(title=title, header=("", "value", "95 % interval", "unit"), rows=tuple(rows), notes=tuple(notes))


def equivalent_filtration(spectral: SpectralPosterior, *, seen_by_detector: bool = True) -> Estimate:
    """Filtration that nobody declared, as mm of aluminium: aluminium itself, the metal of a rough anode, the detector's cover, and
    scintillator that gives no light.

    Measurements tell the sum of these, hardly its parts. Layers count by their attenuation at 30 keV, where a beam of 40 to
    60 kV behind thin filters has its mean energy.

    Args:
        spectral: the posterior of a line or of a tube.
        seen_by_detector: False: without what lies in front of the detector, which a dosimeter does not see.

    Returns:
        Median and 95 % interval, mm Al.
    """
    layers = [("anode_roughness_um", spectral.anode, 1e-3)]
    if seen_by_detector:
        layers += [
            ("cover_mm_C", "C", 1.0),
            ("cover_mm_Al", "Al", 1.0),
            ("dead_layer_um", spectral.scintillator[0].material, 1e-3),
        ]
    total = spectral.column("inherent_filtration_mm_Al").copy()
    for name, material, unit_mm in layers:
        if name in spectral.names:
            total += unit_mm * _attenuation_over_aluminium(material) * spectral.column(name)
    low, middle, high = np.quantile(total, [0.025, 0.5, 0.975])
    return Estimate(value=float(middle), low=float(low), high=float(high))


def _attenuation_over_aluminium(material: str) -> float:
    """Linear attenuation of a material over that of aluminium at 30 keV."""
    own, aluminium = (float(mu_per_mm(material_from_name(name), _EQUIVALENT_KEV)) for name in (material, "Al"))
    return own / aluminium


def _output_scale(twin: Twin | TubeTwin) -> Estimate | None:
    """Output of the tube over the spectrum model's."""
    if twin.spectral is None:
        return None
    low, middle, high = np.quantile(np.exp(twin.spectral.column("log_output")), [0.025, 0.5, 0.975])
    return Estimate(value=float(middle), low=float(low), high=float(high))


def _tube_answer(twin: TubeTwin) -> dict[str, Any]:
    flux = _output_scale(twin) if twin.output_known else None
    missing = ("psf_sigma_px", "read_noise_DN", "dark_DN", *(() if flux is not None else ("flux_scale",)))
    return {
        "psf_sigma_px": None,
        "spread": None,
        "read_noise_DN": None,
        "dark_DN": None,
        "inherent_filtration_mm_Al": equivalent_filtration(twin.spectral, seen_by_detector=False).as_dict(),
        "flux_scale": None if flux is None else flux.as_dict(),
        "levels": [],
        BAD_PIXEL_MAP: None,
        "undetermined": list(twin.spectral.undetermined),
        "next_measurement": None,
        "evidence": dict(twin.evidence),
        "warnings": [*twin.warnings, f"null: {', '.join(missing)}, bad_pixels"],
    }


def tube_table(twin: TubeTwin) -> Table:
    """A calibrated tube in a few lines."""
    answer = calibration_answer(twin)
    low, high = twin.spectral.calibrated_kV
    rows = tuple(
        (name, *interval_text(answer[key]), unit)
        for name, key, unit in (
            ("inherent filtration", "inherent_filtration_mm_Al", BEYOND),
            ("output", "flux_scale", "x model"),
        )
    )
    title = f"Tube twin: {twin.spectral.anode} anode, {twin.spectral.anode_angle_deg:g} degrees, {low:g} to {high:g} kV"
    notes = (f"{len(answer['warnings'])} warnings: see .warnings",) if answer["warnings"] else ()
    return Table(title=title, header=("", "value", "95 % interval", "unit"), rows=rows, notes=notes)

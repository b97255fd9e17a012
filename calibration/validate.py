"""Predictions of a twin against measured flats: per series, with intervals that include the series' sampling noise."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..acquisition.acquisition_io import AcquisitionFile
from ..acquisition.setting import Setting, text_from_filters
from ..errors import InputError
from ..files import sha256_of_file
from ..generator.predict import predict_flatfield
from ..generator.psf import noise_autocovariance_1d
from ..generator.twin import Estimate, Twin
from .frame_sums import effective_frames, sum_frames

_LAGS = 24  # px; farther neighbours share no light


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationRow:
    """One flat series: measured and predicted detector-median level above dark and temporal noise of one pixel, DN."""

    series: str
    setting: Setting
    role: str
    used_in_calibration: bool
    measured_mean_DN: float
    measured_sd_DN: float
    predicted_mean_DN: Estimate
    predicted_sd_DN: Estimate
    extrapolated: bool

    @property
    def inside_mean(self) -> bool:
        """Measured mean inside the interval."""
        return self.predicted_mean_DN.low <= self.measured_mean_DN <= self.predicted_mean_DN.high

    @property
    def inside_sd(self) -> bool:
        """Measured noise inside the interval."""
        return self.predicted_sd_DN.low <= self.measured_sd_DN <= self.predicted_sd_DN.high

    def as_dict(self) -> dict[str, Any]:
        """A row of `raytwin validate --json`."""
        return {
            "series": self.series,
            "kV": self.setting.kV,
            "filter": text_from_filters(self.setting.filters),
            "exposure_ms": self.setting.exposure_ms,
            "setting": str(self.setting),
            "role": self.role,
            "used_in_calibration": self.used_in_calibration,
            "measured_mean_DN": self.measured_mean_DN,
            "measured_sd_DN": self.measured_sd_DN,
            "mean_DN": self.predicted_mean_DN.as_dict(),
            "sd_DN": self.predicted_sd_DN.as_dict(),
            "mean_error_percent": 100.0 * (self.predicted_mean_DN.value / self.measured_mean_DN - 1.0),
            "sd_error_percent": 100.0 * (self.predicted_sd_DN.value / self.measured_sd_DN - 1.0),
            "inside": {"mean": self.inside_mean, "sd": self.inside_sd},
            "extrapolated": self.extrapolated,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """All rows and what was left out."""

    rows: tuple[ValidationRow, ...]
    skipped: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The answer of `raytwin validate --json`."""
        errors = [abs(row.predicted_mean_DN.value / row.measured_mean_DN - 1.0) for row in self.rows]
        noise = [abs(row.predicted_sd_DN.value / row.measured_sd_DN - 1.0) for row in self.rows]
        return {
            "rows": [row.as_dict() for row in self.rows],
            "median_abs_error_percent": {
                "mean": 100.0 * float(np.median(errors)),
                "sd": 100.0 * float(np.median(noise)),
            },
            "coverage": {
                "mean": float(np.mean([row.inside_mean for row in self.rows])),
                "sd": float(np.mean([row.inside_sd for row in self.rows])),
                "rows": len(self.rows),
            },
            "skipped": list(self.skipped),
        }


def validate_twin(
    twin: Twin, acquisition: AcquisitionFile, *, progress: Callable[[str], None] | None = None
) -> Validation:
    """Compare predictions with the flats of an acquisition: those held back for evaluation if any, else all.

    Raises:
        InputError: no flat that can be compared, another detector, or no darks.
    """
    tell = progress or (lambda name: None)
    flats = [item for item in acquisition.of_kind("flat") if not item.corrected & {"log", "gain"}]
    held_back = [item for item in flats if item.role == "evaluation"]
    chosen = held_back or flats
    if not chosen:
        raise InputError(
            f"acquisition {acquisition.path}", received="no raw flat series", expected="at least one flat series"
        )
    if any(item.shape != twin.maps.shape for item in chosen):
        raise InputError(
            f"acquisition {acquisition.path}",
            received=f"frames of {chosen[0].shape}",
            expected=f"the twin's detector of {twin.maps.shape} pixels",
            remedy="validate against flats of the same detector",
        )
    good = twin.maps.bad_pixels == 0
    axis = noise_autocovariance_1d(twin.noise.psf_model, twin.noise.psf_sigma_px.value, _LAGS) ** 2
    squared_correlations = float((axis[0] + 2.0 * axis[1:].sum()) / axis[0]) ** 2
    darks = {
        item.exposure_ms: sum_frames(item.iter_frames(), name=f"series {item.name}").mean_DN
        for item in acquisition.of_kind("dark")
        if not item.corrected
    }
    calibrated = {name for level in twin.levels for name in level.series}
    same_session = twin.provenance.get("acquisition_sha256") == sha256_of_file(acquisition.path)
    rows, skipped = [], []
    for item in chosen:
        tell(item.name)
        setting = item.setting
        if setting is None or setting.tube_load_mAs is None:
            skipped.append(f"{item.name}: kV, exposure or tube load unknown")
            continue
        total = sum_frames(item.iter_frames(), name=f"series {item.name}")
        if total.frames < 2:
            skipped.append(f"{item.name}: a single frame has no noise")
            continue
        if "offset" in item.corrected:
            dark: Any = 0.0
        else:
            dark = darks.get(item.exposure_ms)
            if dark is None:
                dark = twin.maps.dark_at(item.exposure_ms)
        if acquisition.instrument.bits and total.maximum_count > 1e-3 * total.frames * good.size:
            full = 2.0**acquisition.instrument.bits - 1
            if total.maximum_DN >= full:
                skipped.append(f"{item.name}: saturated at {full:g} DN")
                continue
        signal = total.mean_DN - dark
        mean = float(np.median(signal[good]))
        variance = float(np.mean(total.pair_variance_DN2[good]))
        try:
            predicted = predict_flatfield(twin, setting)
        except InputError as error:
            skipped.append(f"{item.name}: {error}")
            continue
        pixels = int(good.sum())
        # quantum noise is correlated: the mean over pixels carries gain, not slope
        spread = predicted.gain_DN.value * mean / item.averaged + twin.noise.read_variance_DN2 / item.averaged
        mean_sd = math.sqrt(max(spread, variance) / total.frames / pixels) * 1.2533
        # neighbours share quantum noise, so a variance over pixels counts fewer of them: by the sum of squared correlations
        quantum = (
            min(max(1.0 - twin.noise.read_variance_DN2 / item.averaged / variance, 0.0), 1.0) if variance > 0 else 0.0
        )
        shared = 1.0 + quantum**2 * (squared_correlations - 1.0)
        noise_sd = math.sqrt(0.5 * variance * shared / (effective_frames(total.frames) * pixels))
        rows.append(
            ValidationRow(
                series=item.name,
                setting=setting,
                role=item.role or "",
                used_in_calibration=same_session and item.name in calibrated,
                measured_mean_DN=mean,
                measured_sd_DN=math.sqrt(variance),
                predicted_mean_DN=_widened(predicted.mean_DN, mean_sd),
                predicted_sd_DN=_widened(predicted.sd_DN, noise_sd),
                extrapolated=predicted.extrapolated,
            )
        )
    if not rows:
        raise InputError(
            f"acquisition {acquisition.path}",
            received="; ".join(skipped) or "no flats",
            expected="at least one flat with kV, exposure and tube load that the twin can predict",
        )
    return Validation(rows=tuple(rows), skipped=tuple(skipped))


def _widened(estimate: Estimate, sd: float) -> Estimate:
    below = math.hypot(estimate.value - estimate.low, 1.959964 * sd)
    above = math.hypot(estimate.high - estimate.value, 1.959964 * sd)
    return Estimate(value=estimate.value, low=estimate.value - below, high=estimate.value + above)

"""What effects change in a flatfield, long after the beam was switched on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..acquisition.setting import Setting
from ..errors import InputError
from .effects import AppliedEffect, effect_of
from .series import ExpectedSeries, ModelCache, SeriesRequest, expected_series
from .twin import Twin

_STEADY_S = 3600.0  # of beam before the frames that are predicted
# they need an object, leave the mean above dark alone, or move single pixels only
_NOTHING_IN_FLATS = (
    "object_scatter",
    "focal_spot",
    "motion_blur",
    "misregistration",
    "composition_error",
    "dark_drift",
    "bad_pixels",
    "gain_map_error",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlatChange:
    """Factors on mean above dark, noise of one pixel, gain and photons absorbed; what could not be done."""

    mean: float
    sd: float
    gain: float
    photons: float
    warnings: tuple[str, ...]


def flat_change(twin: Twin, effects: Sequence[AppliedEffect], setting: Setting) -> FlatChange:
    """By what effects change detector-median level, noise, gain and photons of a flatfield (factors, no unit).

    Noise is that of one pixel from frame to frame, with what all pixels of a frame, a row or a column have in common.
    The gain keeps the spread's share restored, so that spreads of light leave it alone.

    Args:
        twin: the line without effects.
        effects: those to apply; one that cannot be is left out and named in the warnings.
        setting: of the flatfield.
    """
    warnings = []
    if setting.binning > 1:
        warnings.append("the effects' part of the noise is that of pixels that are not binned")
    cache = ModelCache()
    before = _flat(twin, (), setting, cache)
    usable: list[AppliedEffect] = []
    for item in effects:
        if item.id in _NOTHING_IN_FLATS:
            continue
        try:
            _flat(twin, (item,), setting, cache)
            usable.append(item)
        except InputError as error:
            warnings.append(f"effect {item.id} is left out: {error}")
    if not usable:
        return FlatChange(mean=1.0, sd=1.0, gain=1.0, photons=1.0, warnings=tuple(warnings))
    after = _flat(twin, usable, setting, cache)
    arriving = [item for item in usable if effect_of(item).stage == "arrivals"]
    # neither light nor memory: what is left changes variance over signal, not its share in one pixel
    gain_like = [item for item in usable if effect_of(item).stage not in ("optics", "lag", "exposure", "electronics")]
    level = _level(before)
    arrived, gained = _flat(twin, arriving, setting, cache), _flat(twin, gain_like, setting, cache)
    mean = _level(after) / level
    return FlatChange(
        mean=mean,
        sd=math.sqrt(_variance(after) / _variance(before)),
        gain=_quantum(gained) / _quantum(before) / (_level(gained) / level),
        photons=_level(arrived) / level,
        warnings=tuple(warnings),
    )


def _flat(twin: Twin, effects: Sequence[AppliedEffect], setting: Setting, cache: ModelCache) -> ExpectedSeries:
    asked = SeriesRequest(kind="flat", setting=setting, frames=1, exposure_ms=setting.exposure_ms)
    one_s = asked.interval_s(twin.instrument.readout_ms) * asked.exposures_per_frame
    frames = math.ceil(_STEADY_S / one_s)
    steady = replace(asked, start_s=frames * one_s, previous=(replace(asked, frames=frames),))
    return expected_series(twin, steady, effects=effects, cache=cache)


def _level(flat: ExpectedSeries) -> float:
    return float(np.median(flat.signal_DN))


def _quantum(flat: ExpectedSeries) -> float:
    return float(np.median(flat.quantum_variance_DN2))


def _variance(flat: ExpectedSeries) -> float:
    lines = flat.row_variance_DN2 + flat.column_variance_DN2
    pixel = float(np.median(flat.quantum_variance_DN2 + flat.white_variance_DN2))
    return pixel + lines + (flat.frame_factor_rms * _level(flat)) ** 2

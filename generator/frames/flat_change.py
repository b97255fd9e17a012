"""What effects change in a flatfield, long after the beam was switched on.

A flat that calibrated the twin held what was always there, and so do the twin's levels and maps: the spread of light in slope and
width, rows and lost bits in the read noise, lag in the variance. Such effects change nothing a second time; a response that was
always bent does so only in so far as the level differs from those that calibrated.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...acquisition.setting import Setting
from ...errors import InputError
from ..effects import AppliedEffect, effect_of
from ..line.measured_flats import measured_flats
from ..line.series_request import SeriesRequest
from ..line.twin import Twin
from .line_model import ExpectedSeries, LineModel
from .model_cache import ModelCache

_STEADY_S = 3600.0  # of beam before the frames that are predicted


@dataclass(frozen=True, slots=True, kw_only=True)
class FlatChange:
    """Factors on mean above dark, noise of one pixel, gain and photons absorbed; what could not be done."""

    mean: float
    sd: float
    gain: float
    photons: float
    warnings: tuple[str, ...]

    def over(self, other: "FlatChange") -> "FlatChange":
        """Factors of this change over those of another."""
        return FlatChange(
            mean=self.mean / other.mean,
            sd=self.sd / other.sd,
            gain=self.gain / other.gain,
            photons=self.photons / other.photons,
            warnings=self.warnings,
        )


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
    usable: list[AppliedEffect] = []
    for item in effects:
        if not effect_of(item).shows.flats or is_in_noise(item):
            continue
        try:
            _flat(twin, (item,), setting, cache)
            usable.append(item)
        except InputError as error:
            warnings.append(f"effect {item.id} is left out: {error}")
    found = _change(twin, usable, setting, cache)
    bent = [item for item in usable if has_always_bent(item)]
    calibrated_DN = _calibrated_signal_DN(twin, setting)
    if bent and calibrated_DN is not None:
        there = _change(
            twin, bent, setting.with_current_times(calibrated_DN / _level(_flat(twin, (), setting, cache))), cache
        )
        found = found.over(there)
    elif bent:
        found = _change(twin, [item for item in usable if item not in bent], setting, cache)
    return replace(found, warnings=tuple(warnings))


def is_in_noise(item: AppliedEffect) -> bool:
    """Whether the calibrated spread, slope and read noise hold the effect: flats stay as calibrated."""
    return item.since == "always" and effect_of(item).absorbed == "noise"


def has_always_bent(item: AppliedEffect) -> bool:
    """Whether the effect acts on the response and was there when levels were calibrated."""
    return item.since == "always" and effect_of(item).stage == "response"


def _calibrated_signal_DN(twin: Twin, setting: Setting) -> float | None:
    """Median signal of the flats that calibrated: of the setting's own level where it was measured, else of all, DN."""
    own = twin.level_at(setting)
    known = [flat.signal_DN for flat in measured_flats(twin) if own is None or flat.series in own.series]
    return float(np.median(known)) if known else None


def _change(twin: Twin, usable: Sequence[AppliedEffect], setting: Setting, cache: ModelCache) -> FlatChange:
    if not usable:
        return FlatChange(mean=1.0, sd=1.0, gain=1.0, photons=1.0, warnings=())
    before, after = _flat(twin, (), setting, cache), _flat(twin, usable, setting, cache)
    level = _level(before)
    arriving = [item for item in usable if effect_of(item).stage == "arrivals"]
    # neither light nor memory: what is left changes variance over signal, not its share in one pixel
    gain_like = [item for item in usable if effect_of(item).stage not in ("optics", "lag", "exposure", "electronics")]
    arrived, gained = _flat(twin, arriving, setting, cache), _flat(twin, gain_like, setting, cache)
    mean = _level(after) / level
    return FlatChange(
        mean=mean,
        sd=math.sqrt(_variance(after) / _variance(before)),
        gain=_quantum(gained) / _quantum(before) / (_level(gained) / level),
        photons=_level(arrived) / level,
        warnings=(),
    )


def _flat(twin: Twin, effects: Sequence[AppliedEffect], setting: Setting, cache: ModelCache) -> ExpectedSeries:
    asked = SeriesRequest(kind="flat", setting=setting, frames=1, exposure_ms=setting.exposure_ms)
    one_s = asked.interval_s(twin.instrument.readout_ms) * asked.exposures_per_frame
    frames = math.ceil(_STEADY_S / one_s)
    steady = replace(asked, start_s=frames * one_s, previous=(replace(asked, frames=frames),))
    return LineModel(twin, effects=effects, cache=cache).expect(steady)


def _level(flat: ExpectedSeries) -> float:
    return float(np.median(flat.signal_DN))


def _quantum(flat: ExpectedSeries) -> float:
    return float(np.median(flat.quantum_variance_DN2))


def _variance(flat: ExpectedSeries) -> float:
    lines = flat.row_variance_DN2 + flat.column_variance_DN2
    if flat.flicker is not None:
        lines += (flat.flicker.rms * _level(flat)) ** 2
    pixel = float(np.median(flat.quantum_variance_DN2 + flat.white_variance_DN2))
    return pixel + lines + (flat.frame_factor_rms * _level(flat)) ** 2

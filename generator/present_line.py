"""The line as it is now: what effects do to beam and noise worked into the twin, and the effects that are left.

Tube voltage, filtration and excess noise change numbers that the base model has already: parameters of the spectrum, level
and gain of each kV. A twin with such an effect is the same as one whose numbers differ, so those are changed and the
effect is taken off. Whatever else there is goes on as an effect.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .effects import AppliedEffect, effect_of
from .spectral_signal import OpenBeam, SpectralModel
from .twin_spectrum import spectral_model_of

if TYPE_CHECKING:
    from .twin import Level, SpectralPosterior, Twin

FloatArray = NDArray[np.float64]

WORKED_IN = ("kv_error", "filtration_error", "excess_noise")
_TABLE_END = 0.06  # of the tube voltage: the spectral model's tables of other voltages end there


@dataclass(frozen=True, slots=True, kw_only=True)
class PresentLine:
    """A twin without effects whose numbers are those of now; the effects that are left; what could not be done."""

    twin: "Twin"
    effects: tuple[AppliedEffect, ...]
    warnings: tuple[str, ...]


def present_line(twin: "Twin", *, after_calibration: bool = True) -> PresentLine:
    """The twin with the effects on beam and noise worked into its numbers, and the other effects.

    kV and filtration move every parameter set of the spectrum and, by the change of the most probable one, the measured
    levels; excess noise raises gain and photon-transfer slope of all levels and lowers the Swank factor.

    Args:
        twin: any twin; without effects it comes back as it is.
        after_calibration: whether effects that came after calibration are there.
    """
    active = tuple(item for item in twin.effects if after_calibration or item.since == "always")
    bare = replace(twin, effects=()) if twin.effects else twin
    rest: list[AppliedEffect] = []
    warnings: list[str] = []
    for item in active:
        numbers = effect_of(item).values(item.parameters)
        strength = numbers["strength"]
        if item.id not in WORKED_IN:
            rest.append(item)
        elif item.id == "excess_noise":
            bare = _with_gain(bare, 1.0 + strength / 100.0)
        elif bare.spectral is None:
            warnings.append(f"effect {item.id} is left out: the twin has no spectral part")
        elif strength != 0:
            bare, told = _with_spectrum(bare, bare.spectral, item.id, strength)
            warnings += told
    return PresentLine(twin=bare, effects=tuple(rest), warnings=tuple(warnings))


def _with_gain(twin: "Twin", factor: float) -> "Twin":
    """The twin with a quantum variance larger by a factor, at the same signal and number of photons."""
    levels = tuple(
        replace(
            level,
            gain_DN=level.gain_DN.times(factor),
            photon_transfer_slope_DN=level.photon_transfer_slope_DN.times(factor),
        )
        for level in twin.levels
    )
    spectral = twin.spectral
    if spectral is not None:
        spectral = _moved(spectral, "log_swank", lambda values: values - math.log(factor))
    return replace(twin, levels=levels, spectral=spectral)


def _moved(spectral: "SpectralPosterior", name: str, change: Callable[[FloatArray], FloatArray]) -> "SpectralPosterior":
    column = spectral.names.index(name)
    samples, best = spectral.samples.copy(), spectral.best.copy()
    samples[:, column] = change(samples[:, column])
    best[column] = change(best[column : column + 1])[0]
    return replace(spectral, samples=samples, best=best)


def _with_spectrum(twin: "Twin", before: "SpectralPosterior", effect: str, strength: float) -> tuple["Twin", list[str]]:
    """The twin with another tube voltage (%) or filtration (mm Al) than it was calibrated with, and warnings."""

    told: list[str] = []
    if effect == "kv_error":
        after = _moved(before, "kV_error", lambda values: (1.0 + values) * (1.0 + strength / 100.0) - 1.0)
        total = float(after.best[after.names.index("kV_error")])
        if abs(total) > _TABLE_END:
            told.append(
                f"effect kv_error: {100 * total:.2g} % off in all is taken as {math.copysign(100 * _TABLE_END, total):g} %,"
                " where the tables of spectra end"
            )
    else:
        after = _moved(before, "inherent_filtration_mm_Al", lambda values: values + strength)
    highest = max([160.0, *(level.kV for level in twin.levels if level.kV is not None)])
    model = spectral_model_of(twin, highest_kV=highest)
    levels = tuple(_moved_level(level, model, before.best, after.best) for level in twin.levels)
    return replace(twin, spectral=after, levels=levels), told


def _moved_level(level: "Level", model: SpectralModel, before: FloatArray, after: FloatArray) -> "Level":
    if level.kV is None:
        return level
    found = model.signal(np.stack([before, after]), OpenBeam(kV=level.kV, filters=level.filters))
    rate = float(found.rate_DN_per_mAs[1] / found.rate_DN_per_mAs[0])
    gain = float(found.gain_DN[1] / found.gain_DN[0])
    return replace(
        level,
        rate_DN_per_mAs=None if level.rate_DN_per_mAs is None else level.rate_DN_per_mAs.times(rate),
        gain_DN=level.gain_DN.times(gain),
        photon_transfer_slope_DN=level.photon_transfer_slope_DN.times(gain),
    )

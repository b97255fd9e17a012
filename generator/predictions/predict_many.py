"""Flatfield levels at many settings at once: mean and noise of the twin's most probable parameters, no intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...acquisition.setting import Filter, Setting
from ...errors import InputError
from ...spectra import checked_kV
from ..frames.present_line import present_line
from ..line.twin import Twin
from ..line.twin_spectrum import slope_over_gain, slope_share, spectral_model_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """Flatfields of many settings (setting,): mean_DN (above dark), sd_DN (temporal, one pixel, of the averaged frame),
    gain_DN (single frame), measured (the twin's own level at this kV and filter was used)."""

    mean_DN: NDArray[np.float64]
    sd_DN: NDArray[np.float64]
    gain_DN: NDArray[np.float64]
    measured: NDArray[np.bool_]


def predict_levels(
    twin: Twin,
    *,
    kV: ArrayLike,
    filters: Sequence[Sequence[Filter]],
    load_mAs: ArrayLike,
    averaged: ArrayLike = 1,
    source_detector_mm: float | None = None,
) -> Levels:
    """Mean (DN above dark), noise and gain of flatfields at many settings.

    At a kV and filter that was measured, the measured level scaled to the load; elsewhere the spectral model at the
    most probable parameters (`predict_flatfield` gives the median over the posterior, and intervals):

        mean = rate(kV, filters) load (1000 / d)^2 a^2        sd^2 = (gain share mean + read^2) / averaged

    Each kV is taken from the spectra's cache and each filter stack is one exponential; exposure and current cost nothing
    more. Power limits and saturation are `predict_flatfield`'s to check, and of the twin's effects only those on beam and
    noise are in (`present_line`).

    Args:
        twin: a calibrated line.
        kV: (setting,) tube voltage.
        filters: (setting) the layers in the beam of each.
        load_mAs: (setting,) or one number, the charge of one frame.
        averaged: (setting,) or one number, frames averaged.
        source_detector_mm: of all settings; None: the instrument's.

    Returns:
        Levels, one entry a setting.

    Raises:
        InputError: arrays of different lengths, values that are not above 0, filters that let no photon through, a kV
            outside the tube's range, or a setting that a twin without a spectral part has not measured.

    Checked against: `predict_flatfield` (tests/test_generator_predict_many.py), SpekPy called for each setting
        (benchmarks/predict_settings.py).
    """
    twin = present_line(twin).twin
    volts = np.asarray(kV, dtype=float)
    if volts.ndim != 1 or len(filters) != volts.size:
        raise InputError(
            "kV and filters",
            received=f"kV of shape {volts.shape} and {len(filters)} filter stacks",
            expected="one kV and one filter stack a setting",
        )
    load = _one_each("load_mAs", load_mAs, volts.size)
    frames = _one_each("averaged", averaged, volts.size)
    for name, values in (("kV", volts), ("load_mAs", load), ("averaged", frames)):
        if not np.all(np.isfinite(values) & (values > 0)):
            raise InputError(name, received="a value of 0 or less, infinite or NaN", expected="finite values above 0")
    rate_DN_per_mAs, gain_DN, slope_DN, measured = (np.empty(volts.size) for _ in range(4))
    stacks: dict[tuple[Filter, ...], int] = {}
    stack_of = np.array([stacks.setdefault(tuple(stack), len(stacks)) for stack in filters], dtype=np.intp)
    every_stack = tuple(stacks)
    unique_kV, kV_of = np.unique(volts, return_inverse=True)
    for position, voltage in enumerate(unique_kV):
        there = np.flatnonzero(kV_of == position)
        wanted, entry = np.unique(stack_of[there], return_inverse=True)
        columns = _levels_of_kV(twin, float(voltage), [every_stack[one] for one in wanted], source_detector_mm)
        for target, column in zip((rate_DN_per_mAs, gain_DN, slope_DN, measured), columns, strict=True):
            target[there] = column[entry]
    mean_DN = rate_DN_per_mAs * load
    return Levels(
        mean_DN=mean_DN,
        sd_DN=np.sqrt((slope_DN * mean_DN + twin.noise.read_variance_DN2) / frames),
        gain_DN=gain_DN,
        measured=measured > 0,
    )


def _one_each(name: str, values: ArrayLike, settings: int) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=float)
    if array.shape not in ((), (settings,)):
        raise InputError(name, received=f"shape {array.shape}", expected=f"one number, or one for each of {settings}")
    return np.broadcast_to(array, (settings,))


def _levels_of_kV(
    twin: Twin, kV: float, stacks: list[tuple[Filter, ...]], source_detector_mm: float | None
) -> NDArray[np.float64]:
    """Rate (DN / mAs at the detector), gain, photon-transfer slope and whether measured (4, stack) at one kV."""
    answer = np.zeros((4, len(stacks)))
    unmeasured = []
    distance = source_detector_mm or twin.instrument.source_detector_mm
    for number, stack in enumerate(stacks):
        level = twin.level_at(Setting(kV=kV, exposure_ms=1.0, filters=stack))
        if level is None or level.rate_DN_per_mAs is None:
            unmeasured.append(number)
        if level is not None and level.rate_DN_per_mAs is not None:
            there = level.source_detector_mm or distance or 1000.0
            scale = (there / (distance or there)) ** 2
            answer[:, number] = (
                level.rate_DN_per_mAs.value * scale,
                level.gain_DN.value,
                level.photon_transfer_slope_DN.value,
                1.0,
            )
    if unmeasured:
        if twin.spectral is not None:
            checked_kV(kV, anode=twin.spectral.anode)
        model = spectral_model_of(twin, highest_kV=kV)  # raises where the twin has no spectral part
        best = twin.spectral.best if twin.spectral is not None else model.default_parameters()
        # the bare tube comes first, to measure the others by
        signal = model.signal_of_stacks(best, kV=kV, stacks=[(), *(stacks[number] for number in unmeasured)])
        # fewer than one photon in 1e30 is no beam, whatever floating point can still hold
        if not np.all(signal.absorbed_per_mAs[1:] > 1e-30 * signal.absorbed_per_mAs[0]):
            raise InputError(
                "filters", received=f"a stack at {kV:g} kV", expected="layers that let some photons through"
            )
        factor = (1000.0 / (distance or 1000.0)) ** 2 * (twin.instrument.pixel_mm or 1.0) ** 2
        answer[0, unmeasured] = signal.rate_DN_per_mAs[1:] * factor
        answer[1, unmeasured] = signal.gain_DN[1:]
        share = slope_over_gain(twin.levels, twin.noise, signal.gain_DN[1:])
        answer[2, unmeasured] = signal.gain_DN[1:] * (slope_share(twin) if share is None else share)
    return answer

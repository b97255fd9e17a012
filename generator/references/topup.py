"""From a reference image to a shorter exposure: add the noise that is missing, no more.

A reference is itself a measurement. Scaled to the target it already carries a share of the target's noise, blurred by
the same detector, so the signal is not blurred again and only the rest is drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Filter, Setting
from ...errors import InputError
from ..spread.noise import digitise, sample_frame_noise
from ..spread.psf import Spread


@dataclass(frozen=True, slots=True, kw_only=True)
class TopUp:
    """Shares of the target's single-frame noise that a reference does not hold.

    Fields: scale (target over reference signal, one frame each); quantum (variance), third_cumulant, read (electronic
    variance), each over that of one target frame; held: quantum variance that the reference brings, over the same;
    averaged: frames averaged in the target. A negative `read` is electronic noise of the reference beyond the target's,
    which nothing can take away.
    """

    scale: float
    quantum: float
    third_cumulant: float
    read: float
    held: float
    averaged: int


def same_layers(first: Sequence[Filter], second: Sequence[Filter]) -> bool:
    """Whether two stacks hold the same layers, in any order."""
    return sorted(str(layer) for layer in first) == sorted(str(layer) for layer in second)


def plan_top_up(*, reference: Setting, target: Setting, reference_gain: float = 1.0) -> TopUp:
    """What a top-up from `reference` to `target` must draw, for the same kV, filter and distance.

    With loads L (mAs a frame), N frames averaged and s = L_t / L_r:
    quantum 1/N_t - s/N_r, third cumulant 1/N_t^2 - s^2/N_r^2, electronic 1/N_t - s^2/N_r.
    n frames of t averaged are not one frame of n t: the electronic noise differs. Where the reference's quantum variance per
    signal was `reference_gain` times the target's, s / N_r of the first is that many times as large, of the second its square.

    Raises:
        InputError: different kV, filters or distance, unknown load, or a reference noisier than the target.
    """
    if abs(reference.kV - target.kV) > 1e-6 * target.kV or not same_layers(reference.filters, target.filters):
        raise InputError(
            "target setting",
            received=f"{target}",
            expected=f"the kV and filter of the reference ({reference})",
            remedy="a top-up changes current, exposure and averaging; measure references at this kV and filter",
        )
    if target.source_detector_mm != reference.source_detector_mm and None not in (
        target.source_detector_mm,
        reference.source_detector_mm,
    ):
        raise InputError(
            "target setting",
            received=f"source-detector distance {target.source_detector_mm} mm",
            expected=f"the reference's {reference.source_detector_mm} mm",
            remedy="another distance is another magnification; measure references there",
        )
    loads = (reference.tube_load_mAs, target.tube_load_mAs)
    if loads[0] is None or loads[1] is None:
        raise InputError(
            "setting",
            received=f"reference {reference}; target {target}",
            expected="power_w or current_ma in both",
            remedy="give the tube load, for example power_w=40",
        )
    scale = loads[1] / loads[0]
    frames_r, frames_t = reference.averaged, target.averaged
    held = reference_gain * scale / frames_r
    quantum = 1.0 / frames_t - held
    if quantum <= 1e-9:
        raise InputError(
            "target setting",
            received=f"{target} ({loads[1] * frames_t:.4g} mAs in all)",
            expected=f"less than the reference's {loads[0] * frames_r:.4g} mAs ({reference})",
            remedy="the reference is too noisy for this target; use longer references",
        )
    return TopUp(
        scale=scale,
        quantum=quantum,
        third_cumulant=1.0 / frames_t**2 - reference_gain**2 * scale**2 / frames_r**2,
        read=1.0 / frames_t - scale**2 / frames_r,
        held=held,
        averaged=frames_t,
    )


def apply_top_up(
    transmission: NDArray[np.floating],
    plan: TopUp,
    *,
    open_signal_DN: NDArray[np.floating],
    gain_DN: NDArray[np.floating] | float,
    gain_relative: NDArray[np.floating] | float,
    white_fraction: NDArray[np.floating] | float,
    read_variance_DN2: NDArray[np.floating] | float,
    spread: Spread,
    dark_DN: NDArray[np.floating],
    bits: int | None,
    quantised: bool,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Raw counts (row, column) at the target from a reference's transmission, dark included, DN.

    The sum of `topped_up_charge` and dark, digitised.

    Args: as there, and
        dark_DN: dark frame at the target's exposure (row, column), DN.
        bits, quantised: ADC range, and whether it rounds.
    """
    charge = topped_up_charge(
        transmission,
        plan,
        open_signal_DN=open_signal_DN,
        gain_DN=gain_DN,
        gain_relative=gain_relative,
        white_fraction=white_fraction,
        read_variance_DN2=read_variance_DN2,
        spread=spread,
        quantised=quantised,
        rng=rng,
    )
    return digitise(charge + dark_DN, bits=bits, quantised=quantised, averaged=plan.averaged)


def topped_up_charge(
    transmission: NDArray[np.floating],
    plan: TopUp,
    *,
    open_signal_DN: NDArray[np.floating],
    gain_DN: NDArray[np.floating] | float,
    gain_relative: NDArray[np.floating] | float,
    white_fraction: NDArray[np.floating] | float,
    read_variance_DN2: NDArray[np.floating] | float,
    spread: Spread,
    quantised: bool,
    rng: np.random.Generator,
    kernel: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """What the pixels hold (row, column) at the target from a reference's transmission, above dark, with its noise, DN.

    Args:
        transmission: the reference's I / I0 (row, column), its noise included.
        plan: from `plan_top_up`.
        open_signal_DN: mean above dark without object at the target, one frame (row, column), DN.
        gain_DN: variance per signal at each pixel's spectrum, the spread's share restored, DN.
        quantised: whether the ADC rounds, which brings a part of the electronic noise.
        rng: source of randomness.
        kernel: of the noise in place of the calibrated spread's, see `noise.sample_correlated_quanta`.
    """
    signal = np.asarray(open_signal_DN, dtype=np.float64) * transmission
    # where the reference's noise is up, more noise is drawn: this couples them in the third moment; it is taken off
    coupling = 3.0 * plan.quantum * plan.held * spread.noise_coupling
    third_cumulant = max(plan.third_cumulant - coupling, 0.01 * plan.quantum)
    rounding = 1.0 / 12.0 / plan.averaged if quantised else 0.0
    # rounding comes with digitising below; what the electronics still lack excludes it
    electronic = np.clip(plan.read * np.asarray(read_variance_DN2, dtype=np.float64) - rounding, 0.0, None)
    noise = sample_frame_noise(
        signal,
        gain_DN=gain_DN,
        gain_relative=gain_relative,
        white_fraction=white_fraction,
        read_variance_DN2=electronic,
        spread=spread,
        rng=rng,
        quantum_share=plan.quantum,
        third_cumulant_share=third_cumulant,
        kernel=kernel,
    )
    return np.asarray(signal + noise)

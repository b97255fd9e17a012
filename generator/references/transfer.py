"""From a reference pair to another tube voltage, filter or both: two path lengths a pixel, and only the noise that lacks.

The reference's two log images M_1, M_2, quietened, are solved for two materials (`two_material`), and the solution is
projected through the target's spectrum. What the reference holds beyond that, noise and faint detail, goes along by the
solution's own derivative A = dM'/dM, so nothing is blurred again. The reference's noise arrives mixed by A: the two target
images share it, while those of a real detector share nothing. The noise that is added takes that back: its covariance is
the target's minus the transferred one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Setting
from ...errors import InputError
from ..spread.noise import digitise, sample_correlated_quanta, spread_inside
from ..spread.psf import Spread, convolve_separable, sampled_gaussian_1d
from .two_material import TwoMaterialTables, solve_two_materials

Array = NDArray[np.float64]

_SMOOTHING_PX = 2.5  # the solution is linear about the image smoothed by this
_DETAIL_SD = 5.0  # detail that stands out of the noise by more is part of what the solution is linear about
_BRIGHTEST_LOG = (
    -2.0
)  # nothing is brighter than seven open fields: where no material fits, lengths may be far below zero
_DARKEST_LOG = 80.0
_REFUSED_EXCESS = 0.03  # of the noise's variance, mean over the product
_TELL_EXCESS = 0.003


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One setting of the line as a transfer needs it.

    Fields: setting; open_signal_DN (row, column) of one frame; gain_DN (variance per signal of the open beam, the spread's
    share restored); dark_DN (row, column); secondary_DN: variance per signal of secondary quanta in it, the same behind any
    object; None: the detector's white fraction of the gain.
    """

    setting: Setting
    open_signal_DN: Array = field(repr=False)
    gain_DN: float
    dark_DN: NDArray[np.float32] = field(repr=False)
    secondary_DN: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorNoise:
    """What of the detector's noise does not depend on the setting; see generator.line.twin.NoiseModel.

    Fields: gain_relative, read_variance_DN2 (row, column), the latter of one frame with its rounding; kernel: of noise that
    is drawn, where effects have changed the calibrated spread.
    """

    spread: Spread
    white_fraction: float
    slope_share: float
    gain_relative: NDArray[np.float32] = field(repr=False)
    read_variance_DN2: NDArray[np.float32] = field(repr=False)
    bits: int | None
    quantised: bool
    kernel: Array | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferredPair:
    """A reference pair at the target's two spectra, with the noise it brought along.

    Fields (channel 0 low, 1 high): transmission (2, row, column), I / I0 with the reference's noise, on average right;
    gain_DN (2, row, column); held (2, 2, row, column): covariance of the transferred quantum noise before the spread, over
    the square roots of the variances of one target frame; held_third (2, row, column): its third cumulant over that of one
    target frame; held_read_DN2 (2, 2, row, column): covariance of the transferred electronic noise; thickness_mm (2, row,
    column) of the smoothed reference; excess (2,): variance beyond the target's that cannot be taken away, over the
    target's, mean over the product; strongest: the largest eigenvalue of `held` in the product, times the frames averaged;
    unsolved_percent of the pixels.
    """

    transmission: Array
    gain_DN: Array
    held: Array
    held_third: Array
    held_read_DN2: Array
    thickness_mm: Array
    excess: tuple[float, float]
    strongest: float
    unsolved_percent: float


def transfer_pair(
    log_images: NDArray[np.floating],
    tables: TwoMaterialTables,
    *,
    references: Sequence[Channel],
    targets: Sequence[Channel],
    detector: DetectorNoise,
    product: NDArray[np.bool_] | None = None,
) -> TransferredPair:
    """Transmission of a reference pair (no unit) at two other spectra, and the noise that comes along.

        M' = M'(t) + A (M - M(t)),   A = dM'/dt (dM/dt)^-1 at the solution t of the quietened pair
        I' / I0' = exp(-M') exp(1/2 sum_j A_cj (1 - A_cj) v_j)

    v_j, the variance of M_j, takes off the bias of logarithms and powers of noisy values. The covariance of the transferred
    noise is A diag(v) A^T, quantum and electronic noise each for themselves.

    Args:
        log_images: (2, row, column) -ln(I / I0) of the reference, low kV first, normalised by its own flats.
        tables: of the two reference beams, then the two target beams.
        references, targets: low and high channel of each.
        detector: the noise model.
        product: (row, column), where noise is judged; None: everywhere.

    Raises:
        InputError: images of another shape, or values that are not finite.
    """
    logs = np.asarray(log_images, dtype=np.float64)
    solution = solve_two_materials(tables, quiet_image(logs, references, detector))
    mixing = solution.transfer()[2:]
    own = solution.log_signal[:2]
    at_target = np.clip(solution.log_signal[2:], _BRIGHTEST_LOG, _DARKEST_LOG)
    read_DN2 = np.asarray(detector.read_variance_DN2, dtype=np.float64)
    relative = np.asarray(detector.gain_relative, dtype=np.float64)

    reference_signal = np.stack([one.open_signal_DN for one in references]) * np.exp(-own)
    frames = np.array([one.setting.averaged for one in references], dtype=np.float64)[:, None, None]
    gain = np.stack([one.gain_DN * solution.gain_ratio[j] for j, one in enumerate(references)])
    slope = np.stack([_slope(one, detector, gain[j]) for j, one in enumerate(references)])
    variance = (relative * slope * reference_signal + read_DN2) / (frames * reference_signal**2)
    logs_target = at_target + np.einsum("cjyx,jyx->cyx", mixing, logs - own)
    unbiased = 0.5 * np.einsum("cjyx,jyx->cyx", mixing * (1.0 - mixing), variance)

    gain_target = np.stack([one.gain_DN * solution.gain_ratio[2 + c] for c, one in enumerate(targets)])
    signal_target = np.stack([one.open_signal_DN for one in targets]) * np.exp(-at_target)
    # DN of a target frame for each DN of a reference
    carried = mixing * signal_target[:, None] / reference_signal[None, :]
    root = np.sqrt(gain_target * signal_target)
    quantum = gain * reference_signal / frames
    held = np.einsum("cjyx,djyx,jyx->cdyx", carried, carried, quantum) / (root[:, None] * root[None, :])
    third = np.einsum("cjyx,jyx->cyx", carried**3, gain * quantum / frames) / (gain_target * root**2)
    held_read = np.einsum("cjyx,djyx,jyx->cdyx", carried, carried, np.broadcast_to(read_DN2 / frames, gain.shape))
    inside = np.ones(logs.shape[1:], dtype=bool) if product is None or not product.any() else product
    excess, strongest = _excess(held, held_read, root**2 * relative, targets, detector, inside)
    return TransferredPair(
        transmission=np.exp(-np.clip(logs_target - unbiased, _BRIGHTEST_LOG, _DARKEST_LOG)),
        gain_DN=gain_target,
        held=held,
        held_third=third,
        held_read_DN2=held_read,
        thickness_mm=solution.thickness_mm,
        excess=excess,
        strongest=strongest,
        unsolved_percent=100.0 * float(np.mean(~solution.solved)),
    )


def quiet_image(logs: Array, references: Sequence[Channel], detector: DetectorNoise) -> Array:
    """Log images (2, row, column) smoothed, but for detail that no noise can be.

    M + w (M0 - M) with M0 the image, M the smoothed one, w = z^4 / (z^4 + 5^4), z^2 the sum of squares of both channels'
    differences in standard deviations: noise has w below 0.01, an edge of ten standard deviations 0.94.
    """
    kernel = sampled_gaussian_1d(_SMOOTHING_PX, math.ceil(4 * _SMOOTHING_PX))
    smooth = -np.log(convolve_separable(np.exp(-logs), kernel).astype(np.float64))
    read_DN2 = np.asarray(detector.read_variance_DN2, dtype=np.float64)
    squares = np.zeros(logs.shape[1:])
    for image, quiet, channel in zip(logs, smooth, references, strict=True):
        signal = channel.open_signal_DN * np.exp(-quiet)
        one_frame = detector.slope_share * channel.gain_DN * signal + read_DN2
        squares += (image - quiet) ** 2 * signal**2 * channel.setting.averaged / one_frame
    kept = squares**2 / (squares**2 + _DETAIL_SD**4)
    return np.asarray(smooth + kept * (logs - smooth))


def _excess(
    held: Array,
    held_read: Array,
    quantum_DN2: Array,
    targets: Sequence[Channel],
    detector: DetectorNoise,
    inside: NDArray[np.bool_],
) -> tuple[tuple[float, float], float]:
    """Noise that stays too much, over the target's (2,), and the largest share of it that the reference brings."""
    wanted = np.eye(2)[:, :, None] * np.array([1.0 / one.setting.averaged for one in targets])[:, None, None]
    part = held[:, :, inside]
    kept = nearest_covariance(wanted - part)
    read = np.asarray(detector.read_variance_DN2, dtype=np.float64)[inside]
    read_part = held_read[:, :, inside]
    kept_read = nearest_covariance(wanted * read - read_part)
    excess = []
    for c in (0, 1):
        quantum = quantum_DN2[c][inside] * detector.slope_share
        target = wanted[c, c] * (quantum + read)
        beyond = (kept[c, c] + part[c, c] - wanted[c, c]) * quantum
        beyond_read = kept_read[c, c] + read_part[c, c] - wanted[c, c] * read
        excess.append(float(np.mean((beyond + beyond_read) / target)))
    scaled = part / np.sqrt(wanted[[0, 1], [0, 1], 0][:, None, None] * wanted[[0, 1], [0, 1], 0][None, :, None])
    middle, half = 0.5 * (scaled[0, 0] + scaled[1, 1]), np.hypot(0.5 * (scaled[0, 0] - scaled[1, 1]), scaled[0, 1])
    return (excess[0], excess[1]), float(np.quantile(middle + half, 0.95))


def nearest_covariance(matrix: Array) -> Array:
    """Symmetric matrices (2, 2, ...) with their negative eigenvalues set to 0, so that noise of this covariance exists."""
    (a, c), (_, b) = matrix
    middle, half = 0.5 * (a + b), np.hypot(0.5 * (a - b), c)
    larger, smaller = np.maximum(middle + half, 0.0), np.maximum(middle - half, 0.0)
    # where both eigenvalues are equal the direction does not matter
    share = np.where(half > 0, 0.5 * (larger - smaller) / np.where(half > 0, half, 1.0), 0.0)
    even = 0.5 * (larger + smaller)
    off = share * c
    lean = share * 0.5 * (a - b)
    return np.stack([np.stack([even + lean, off]), np.stack([off, even - lean])])


def check_transfer(
    pair: TransferredPair, *, references: Sequence[Setting], targets: Sequence[Setting], name: str = "reference"
) -> tuple[str, ...]:
    """Warnings about a transferred pair.

    Raises:
        InputError: the reference is too noisy for the target.
    """
    worst = max(pair.excess)
    if worst > _REFUSED_EXCESS:
        raise InputError(
            f"target setting {targets[0]};{targets[1]}",
            received=f"{name}, whose noise, carried over, is {pair.strongest:.2g} times the target's in its strongest"
            " direction",
            expected=f"a target of at most {1 / pair.strongest:.2g} times this exposure",
            remedy=f"the reference is too noisy for it: use references longer than"
            f" {references[0].exposure_ms * references[0].averaged:g} ms",
        )
    if worst > _TELL_EXCESS:
        return (
            f"the references carry some noise that the target would not have: its variance is {100 * worst:.3g} % too high",
        )
    return ()


def check_geometry(references: Sequence[Setting], targets: Sequence[Setting]) -> None:
    """Refuse what no transfer can do.

    Raises:
        InputError: another source-detector distance, or an unknown tube load.
    """
    for reference, target in zip(references, targets, strict=True):
        distances = (reference.source_detector_mm, target.source_detector_mm)
        if None not in distances and distances[0] != distances[1]:
            raise InputError(
                "target setting",
                received=f"source-detector distance {target.source_detector_mm:g} mm",
                expected=f"the reference's {reference.source_detector_mm:g} mm",
                remedy="another distance is another magnification; measure references there",
            )
        for setting in (reference, target):
            setting.stated_load_mAs()


def sample_transferred(
    pair: TransferredPair, *, targets: Sequence[Channel], detector: DetectorNoise, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Counts with dark (2, row, column) of a transferred pair at its target, DN: the missing noise is drawn and added."""
    charge = transferred_charge(pair, targets=targets, detector=detector, rng=rng)
    return np.stack(
        [
            digitise(
                charge[c] + one.dark_DN, bits=detector.bits, quantised=detector.quantised, averaged=one.setting.averaged
            )
            for c, one in enumerate(targets)
        ]
    )


def transferred_charge(
    pair: TransferredPair, *, targets: Sequence[Channel], detector: DetectorNoise, rng: np.random.Generator
) -> Array:
    """What the pixels hold (2, row, column) of a transferred pair at its target, above dark, with its noise, DN.

    Quantum noise is drawn as independent compound Poisson noise with the target's third cumulant, plus a common part, one
    normal field seen by both channels, whose covariance is minus that of the transferred noise.
    """
    relative = np.asarray(detector.gain_relative, dtype=np.float64)
    frames = np.array([one.setting.averaged for one in targets], dtype=np.float64)
    signal = np.stack([one.open_signal_DN for one in targets]) * pair.transmission
    one_frame = pair.gain_DN * np.clip(signal, 0.0, None) * relative
    wanted = np.eye(2)[:, :, None, None] / frames[:, None, None, None]
    missing = nearest_covariance(wanted - pair.held)
    own = np.stack([missing[0, 0], missing[1, 1]])
    geometric = np.sqrt(own[0] * own[1])
    together = np.where(geometric > 0, missing[0, 1] / np.where(geometric > 0, geometric, 1.0), 0.0)
    common = np.minimum(np.abs(together), 1.0)
    coupling = 3.0 * detector.spread.noise_coupling
    kernel: Array = detector.spread.noise_kernel
    if detector.kernel is not None:
        kernel = detector.kernel
    reach = len(kernel) // 2
    shape = signal.shape[1:]
    field_of_both = rng.standard_normal((shape[0] + 2 * reach, shape[1] + 2 * reach), dtype=np.float32)
    white = np.stack([white_fraction_of(one, detector, pair.gain_DN[c]) for c, one in enumerate(targets)])
    seen = 1.0 / (1.0 + white)
    counts = np.empty(signal.shape)
    for c in (0, 1):
        alone = own[c] * (1.0 - common)
        third = 1.0 / frames[c] ** 2 - pair.held_third[c] - coupling * own[c] * pair.held[c, c]
        share = np.maximum(third, 0.01 * own[c]) / np.maximum(alone, 1e-12)
        noise = relative * sample_correlated_quanta(
            seen[c] * alone * one_frame[c] / relative**2,
            pair.gain_DN[c] * np.clip(share, 1e-3, 1e3),
            spread=detector.spread,
            rng=rng,
            kernel=kernel,
        )
        amplitude = np.sqrt(seen[c] * own[c] * common * one_frame[c])
        if c == 1:
            amplitude = amplitude * np.sign(together)
        wide = np.pad(amplitude, reach, mode="edge") * field_of_both
        counts[c] = signal[c] + noise + spread_inside(wide, kernel)
    counts += _white_noise(pair, white / (1.0 + white) * one_frame, missing, frames, detector, rng)
    return counts


def white_fraction_of(channel: Channel, detector: DetectorNoise, gain_DN: Array) -> Array:
    """Signal-following white variance over quantum variance before the spread (row, column), at each pixel's gain."""
    if channel.secondary_DN is None:
        return np.full(gain_DN.shape, detector.white_fraction)
    return np.asarray(channel.secondary_DN / np.maximum(gain_DN - channel.secondary_DN, 1e-3 * gain_DN))


def _slope(channel: Channel, detector: DetectorNoise, gain_DN: Array) -> Array:
    """Photon-transfer slope (row, column) of one pixel at its gain, DN."""
    left = detector.slope_share * (1.0 + detector.white_fraction) - detector.white_fraction
    white = white_fraction_of(channel, detector, gain_DN)
    return np.asarray(gain_DN * (left + white) / (1.0 + white))


def _white_noise(
    pair: TransferredPair,
    white_DN2: Array,
    missing: Array,
    frames: Array,
    detector: DetectorNoise,
    rng: np.random.Generator,
) -> Array:
    """Signal-following white noise and electronic noise that the reference lacks (2, row, column), DN."""
    root = np.sqrt(white_DN2)
    covariance = missing * root[:, None] * root[None, :] - pair.held_read_DN2
    for c in (0, 1):
        # rounding comes with digitising
        rounding = 1.0 / 12.0 / frames[c] if detector.quantised else 0.0
        covariance[c, c] += np.asarray(detector.read_variance_DN2, dtype=np.float64) / frames[c] - rounding
    (a, c01), (_, b) = nearest_covariance(covariance)
    first, second = rng.standard_normal((2, *root.shape[1:]), dtype=np.float32)
    scale = np.sqrt(a)
    slope = np.where(scale > 0, c01 / np.where(scale > 0, scale, 1.0), 0.0)
    return np.stack([scale * first, slope * first + np.sqrt(np.maximum(b - slope**2, 0.0)) * second])

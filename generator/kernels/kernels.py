"""Noisy detector frames, fast and reproducible: compound-Poisson quanta, optical spread, electronics, readout.

One function for two ways to compute: compiled loops on the processor's cores, torch on a GPU. Random numbers are counted,
not drawn in turn: every one is a function of (key, number of the frame, row, column), so that a frame has the same bytes
whatever the number of threads and however a stack is cut into pieces.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import InputError
from ._frames import FloatMap, Frames
from ._noise_constants import LARGEST_INVERTED, TAPS_TOGETHER

BACKENDS = ("cpu", "torch", "torch_compiled")
_HIGHEST = 1e15  # DN: products of two of them still fit single precision


def draw_key(rng: np.random.Generator) -> int:
    """A key of 64 bits for a set of frames, from the caller's source of randomness; no unit."""
    return int(rng.integers(0, 2**64, dtype=np.uint64))


def is_tensor(values: object) -> bool:
    """Whether `values` is a torch tensor, told without loading torch."""
    return hasattr(values, "detach") and hasattr(values, "device")


def _single(values: Any) -> Any:
    """Contiguous single precision, where the values are."""
    return values.float().contiguous() if is_tensor(values) else np.ascontiguousarray(values, dtype=np.float32)


def _map(name: str, values: Any, shape: tuple[int, int, int], *, low: float, unit: str, high: float = _HIGHEST) -> Any:
    """`values` as (frame or 1, row or 1, column or 1) float32, finite and at least `low`."""
    given: Any = values.detach() if is_tensor(values) else np.asarray(values)
    if not is_tensor(given) and given.dtype.kind not in "fiub":
        raise InputError(name, received=f"{given.dtype}", expected="numbers")
    count = math.prod(given.shape)
    if count and not (float(given.min()) >= low and float(given.max()) <= high):  # NaN fails both
        wrong = given[~((given >= low) & (given <= high))].reshape(-1)
        raise InputError(
            name,
            received=f"{float(wrong[0]):g} in {len(wrong)} of {count} places",
            expected=f"finite, {low:g} to {high:g} {unit}".rstrip(),
        )
    while given.ndim > 3 and given.shape[0] == 1:
        given = given[0]
    full = given.reshape((1,) * (3 - given.ndim) + given.shape) if given.ndim <= 3 else given
    fits = full.ndim == 3 and all(one in (1, all_) for one, all_ in zip(full.shape, shape, strict=True))
    if not fits:
        raise InputError(
            name,
            received=f"shape {tuple(given.shape)}",
            expected=f"one number, or a map that fits frames, rows and columns {shape}",
        )
    if tuple(full.shape[1:]) not in ((1, 1), shape[1:]):
        target = (full.shape[0], *shape[1:])
        full = full.expand(target) if is_tensor(full) else np.broadcast_to(full, target)
    return _single(full)


def _kernel(name: str, values: ArrayLike | None) -> FloatMap:
    if values is None:
        return np.ones(1, dtype=np.float32)
    kernel = np.asarray(values, dtype=np.float64)
    if kernel.ndim != 1 or len(kernel) % 2 == 0 or not np.all(np.isfinite(kernel)) or len(kernel) > 4001:
        raise InputError(name, received=f"shape {kernel.shape}", expected="(2 R + 1,) finite numbers, R at most 2000")
    half = len(kernel) // 2
    # ends too small to change a pixel by 1e-7 of the kernel's norm cost time and give nothing
    share = np.cumsum(kernel[:half] ** 2 + kernel[:half:-1] ** 2)
    cut = int(np.searchsorted(share, 1e-14 * float(np.sum(kernel**2))))
    return np.asarray(kernel[cut : len(kernel) - cut], dtype=np.float32)


def _with_reach(kernel: FloatMap, reach: int) -> FloatMap:
    """The kernel with zeros up to `reach` on both sides, and at the end up to a multiple of the taps taken together."""
    missing = reach - len(kernel) // 2
    length = 2 * reach + 1
    return np.ascontiguousarray(np.pad(kernel, (missing, missing + -length % TAPS_TOGETHER)), dtype=np.float32)


def _check_number(name: str, value: float, *, low: float, high: float, unit: str) -> float:
    if not low <= value <= high:
        raise InputError(name, received=f"{value:g}", expected=f"{low:g} to {high:g} {unit}".rstrip())
    return float(value)


def _prepare(
    signal_DN: ArrayLike,
    *,
    gain_DN: ArrayLike,
    step_DN: ArrayLike | None,
    deposit_spread: ArrayLike,
    gain_relative: ArrayLike,
    white_fraction: float,
    kernel_1d: ArrayLike | None,
    signal_kernel_1d: ArrayLike | None,
    read_noise_DN: ArrayLike,
    dark_DN: ArrayLike,
    bits: int | None,
    quantised: bool,
    averaged: int,
    key: int,
    first_frame: int,
    frames: int | None,
    with_signal: bool = True,
) -> Frames:
    given: Any = signal_DN if is_tensor(signal_DN) else np.asarray(signal_DN)
    if given.ndim not in (2, 3):
        raise InputError(
            "signal_DN", received=f"shape {tuple(given.shape)}", expected="(row, column) or (frame, row, column)"
        )
    if given.ndim == 3 and frames is not None and frames != len(given):
        raise InputError("frames", received=frames, expected=f"{len(given)}, as many as there are signals, or none")
    count = len(given) if given.ndim == 3 else (1 if frames is None else frames)
    for name, whole, low, high in (
        ("frames", count, 0, 2**40),
        ("averaged", averaged, 1, 10**6),
        ("first_frame", first_frame, 0, 2**62),
        ("key", key, 0, 2**64 - 1),
    ):
        if isinstance(whole, bool) or not isinstance(whole, int | np.integer) or not low <= whole <= high:
            raise InputError(name, received=whole, expected=f"a whole number from {low} to {high}")
    if bits is not None and not (isinstance(bits, int | np.integer) and 1 <= bits <= 24):
        raise InputError("bits", received=bits, expected="1 to 24 bits, or None for no upper end")
    shape = (count, *given.shape[-2:])
    white = _check_number("white_fraction", white_fraction, low=0.0, high=1e6, unit="of the quantum variance")
    maps = {
        "signal": _map("signal_DN", given, shape, low=-_HIGHEST, unit="DN"),
        "gain": _map("gain_DN", gain_DN, shape, low=1e-12, unit="DN"),
        "excess": _map("deposit_spread", deposit_spread, shape, low=0.0, unit=""),
        "relative": _map("gain_relative", gain_relative, shape, low=1e-6, high=1e6, unit=""),
        "read": _map("read_noise_DN", read_noise_DN, shape, low=0.0, unit="DN"),
        "dark": _map("dark_DN", dark_DN, shape, low=-_HIGHEST, unit="DN"),
    }
    if step_DN is not None:
        maps["step"] = _map("step_DN", step_DN, shape, low=1e-12, unit="DN")
    places = [values.device for values in maps.values() if is_tensor(values)]
    if places:
        from ._torch_kernels import on_device

        maps = {name: on_device(values, places[0]) for name, values in maps.items()}
    slope, excess = maps["gain"] / float(1.0 + white), maps["excess"]
    if step_DN is None:
        step = slope * (1.0 + 2.0 * excess) / (1.0 + excess)  # of deposits that follow a gamma distribution
    else:
        step = maps["step"]
        _check_deposits(slope, step, excess)
    noise_kernel = _kernel("kernel_1d", kernel_1d)
    signal_kernel = None if signal_kernel_1d is None else _kernel("signal_kernel_1d", signal_kernel_1d)
    reach = max(len(noise_kernel), 0 if signal_kernel is None else len(signal_kernel)) // 2
    read = maps["read"] ** 2 / averaged
    if quantised:
        # each of the averaged frames was rounded; rounding their mean to 1 / averaged DN gives 1 / averaged^2 of it
        read = read + (1.0 / averaged - 1.0 / averaged**2) / 12.0
    return Frames(
        signal=maps["signal"],
        relative=maps["relative"],
        slope=_single(slope / averaged),
        step=_single(step / averaged),
        excess=excess,
        read_variance=_single(read),
        dark=maps["dark"],
        white_fraction=white,
        kernel=noise_kernel if reach == 0 and noise_kernel[0] == 1 else _with_reach(noise_kernel, reach),
        signal_kernel=np.zeros(0, np.float32) if signal_kernel is None else _with_reach(signal_kernel, reach),
        reach=reach,
        electronics=bool(white > 0 or (read > 0).any()),
        steps_a_DN=float(averaged) if quantised else 0.0,
        lowest=0.0 if quantised else -math.inf,
        highest=math.inf if bits is None else float(2**bits - 1),
        signal_share=1.0 if with_signal else 0.0,
        key=int(key),
        first_frame=int(first_frame),
        frames=count,
    )


def _check_deposits(slope: Any, step: Any, excess: Any) -> None:
    """Deposits of 0 or more have E q^3 E q >= (E q^2)^2: the step is no smaller than the variance per signal."""
    if not bool((excess > 0).any()):
        return
    ratio = step / slope
    if not bool(((ratio >= 1.0 - 1e-6) | (excess <= 0)).all()):
        raise InputError(
            "step_DN",
            received=f"{float(ratio.min()):g} of the quantum variance per signal",
            expected="as much or more, for deposits of 0 or more",
            remedy="leave step_DN out for deposits of a gamma distribution, or set deposit_spread to 0",
        )
    if not float((ratio**2 * (1.0 + excess)).max()) * 20.0 < LARGEST_INVERTED:
        raise InputError(
            "deposit_spread and step_DN",
            received=f"up to {float(excess.max()):g}, and {float(ratio.max()):g} of the variance per signal",
            expected="(step / variance per signal)^2 (1 + spread) below 30",
        )


def sample_frames(
    signal_DN: ArrayLike,
    *,
    gain_DN: ArrayLike,
    key: int,
    first_frame: int = 0,
    frames: int | None = None,
    deposit_spread: ArrayLike = 0.0,
    step_DN: ArrayLike | None = None,
    gain_relative: ArrayLike = 1.0,
    white_fraction: float = 0.0,
    kernel_1d: ArrayLike | None = None,
    signal_kernel_1d: ArrayLike | None = None,
    read_noise_DN: ArrayLike = 0.0,
    dark_DN: ArrayLike = 0.0,
    stuck_DN: ArrayLike | None = None,
    bits: int | None = None,
    quantised: bool = True,
    averaged: int = 1,
    backend: str = "cpu",
    device: str | None = None,
) -> Any:
    """Detector frames (frame, row, column), or (row, column) for one signal, dark included, DN.

    Per pixel, r the relative gain, S the signal, a = gain / (1 + white_fraction), * the spread:

        Q  = r (S / r * h_signal) + r ((X - E X) * h)     X compound Poisson of mean S / r, variance a S / r
        out = ADC(Q + sqrt(white_fraction a S r + read_noise^2) normal + dark)

    X has the right mean, variance and third cumulant (`step_DN` times the variance) at any signal. Below 20 effective
    quanta (variance over squared step) it is a sum of exact Poisson numbers of deposits of two sizes, which also has the
    right number of photons, (1 + deposit_spread) S / (r a); above, one Poisson number by an expansion of its quantile.
    Averaged frames: quanta and electronics of the mean of `averaged` frames, each rounded, in steps of 1 / averaged DN; of
    frames that saturate the mean is not right.

    Args:
        signal_DN: mean above dark before the spread (row, column) or (frame, row, column), DN; negative counts as 0 quanta.
        gain_DN: variance per signal with the spread's share restored, secondary quanta included, above 0 DN.
        key: from `draw_key`.
        first_frame: number of the first frame under this key; frame f of a piece is frame first_frame + f of the whole.
        frames: how many frames of one signal (row, column); None for one, without the frame axis.
        deposit_spread: squared coefficient of variation of what a photon deposits; 0 for equal deposits.
        step_DN: third cumulant over variance of the quanta, DN; None for deposits of a gamma distribution.
        gain_relative: the pixel's own gain over the detector median, above 0.
        white_fraction: signal-following white variance over quantum variance before the spread.
        kernel_1d: (2 R + 1,) per axis that correlates the noise, `psf.noise_kernel_1d`; None for no spread.
        signal_kernel_1d: the same for the signal, `psf.optical_kernel_1d`; None where the signal is spread already.
        read_noise_DN: electronic noise of one frame without the ADC's rounding.
        dark_DN: mean without beam.
        stuck_DN: value of pixels that show nothing else, NaN elsewhere (row, column), DN; None for none.
        bits: ADC range 0 .. 2^bits - 1; None for no upper end.
        quantised: whole DN (steps of 1 / averaged) from 0; otherwise neither rounded nor cut at 0.
        averaged: frames averaged in the detector.
        backend: `cpu` (compiled, returns numpy float32), `torch` (returns a float32 tensor on `device`), or
            `torch_compiled` (the same with the steps joined by torch's compiler, which takes its time once for a shape).
        device: torch's name of the device; None for `cuda` where there is one, else `cpu`.

    Maps broadcast: one number, (row, column), (frame, 1, 1) or (frame, row, column). With torch they may be tensors: on a
    GPU what `project_polychromatic` gives need not leave it.

    Raises:
        InputError: NaN, infinite or impossible values, shapes that do not fit, an unknown backend.

    Checked against: moments, covariances and distribution in theory, tests/test_generator_kernels.py.
    """
    _check_backend(backend)
    request = _prepare(
        signal_DN,
        gain_DN=gain_DN,
        step_DN=step_DN,
        deposit_spread=deposit_spread,
        gain_relative=gain_relative,
        white_fraction=white_fraction,
        kernel_1d=kernel_1d,
        signal_kernel_1d=signal_kernel_1d,
        read_noise_DN=read_noise_DN,
        dark_DN=dark_DN,
        bits=bits,
        quantised=quantised,
        averaged=averaged,
        key=key,
        first_frame=first_frame,
        frames=frames,
    )
    return _sample(
        request,
        _stuck(stuck_DN, request.signal.shape[-2:]),
        single=np.ndim(signal_DN) == 2 and frames is None,
        backend=backend,
        device=device,
    )


def _check_backend(backend: str) -> None:
    if backend not in BACKENDS:
        raise InputError("backend", received=backend, expected="one of " + ", ".join(BACKENDS))


def _sample(
    request: Frames,
    stuck: tuple[tuple[Any, ...], NDArray[np.float32]] | None,
    *,
    single: bool,
    backend: str,
    device: str | None,
) -> Any:
    if backend != "cpu":
        from ._torch_kernels import sample

        result = sample(request, device=device, fused=backend == "torch_compiled")
        if stuck is not None:
            places = [result.new_tensor(axis).long() for axis in stuck[0]]
            result[:, places[0], places[1]] = result.new_tensor(stuck[1])
    elif is_tensor(request.signal):
        raise InputError(
            "backend",
            received="cpu for torch tensors",
            expected="torch or torch_compiled",
            remedy="or give numpy arrays",
        )
    else:
        result = _sample_compiled(request)
        if stuck is not None:
            result[:, stuck[0][0], stuck[0][1]] = stuck[1]
    return result[0] if single else result


def _stuck(stuck_DN: ArrayLike | None, shape: tuple[int, ...]) -> tuple[tuple[Any, ...], NDArray[np.float32]] | None:
    if stuck_DN is None:
        return None
    values = np.asarray(stuck_DN, dtype=np.float64)
    if values.shape != shape or np.any(np.isinf(values)):
        raise InputError(
            "stuck_DN", received=f"shape {values.shape}", expected=f"DN or NaN of shape {shape}, no infinity"
        )
    where = np.nonzero(~np.isnan(values))
    return where, values[where].astype(np.float32)


def sample_quanta(
    signal_DN: ArrayLike,
    *,
    gain_DN: ArrayLike,
    key: int,
    first_frame: int = 0,
    frames: int | None = None,
    deposit_spread: ArrayLike = 0.0,
    step_DN: ArrayLike | None = None,
    kernel_1d: ArrayLike | None = None,
    backend: str = "cpu",
    device: str | None = None,
) -> Any:
    """Quantum noise of zero mean after the spread, without electronics or readout; shapes and DN of `sample_frames`.

    For noise that later stages change (lag, nonlinearity) or that something else spreads (leave `kernel_1d` out), and for
    top-ups: gain the missing variance per signal, step the third cumulant over it.
    """
    _check_backend(backend)
    request = _prepare(
        signal_DN,
        gain_DN=gain_DN,
        step_DN=step_DN,
        deposit_spread=deposit_spread,
        gain_relative=1.0,
        white_fraction=0.0,
        kernel_1d=kernel_1d,
        signal_kernel_1d=None,
        read_noise_DN=0.0,
        dark_DN=0.0,
        bits=None,
        quantised=False,
        averaged=1,
        key=key,
        first_frame=first_frame,
        frames=frames,
        with_signal=False,
    )
    return _sample(request, None, single=np.ndim(signal_DN) == 2 and frames is None, backend=backend, device=device)


def _sample_compiled(request: Frames) -> NDArray[np.float32]:
    from ._numba_kernels import fill_frame, fill_quanta

    rows, columns = request.signal.shape[-2:]
    result = np.empty((request.frames, rows, columns), dtype=np.float32)
    if result.size == 0:
        return result
    noise_rows = np.empty((rows + 2 * request.reach, columns), dtype=np.float32)
    signal_rows = np.empty_like(noise_rows) if len(request.signal_kernel) else np.empty((0, 0), dtype=np.float32)
    key = np.uint64(request.key)
    for frame in range(request.frames):
        signal, relative = request.of("signal", frame), request.of("relative", frame)
        slope, number = request.of("slope", frame), np.uint64(request.first_frame + frame)
        fill_quanta(
            key,
            number,
            signal,
            relative,
            slope,
            request.of("step", frame),
            request.of("excess", frame),
            request.kernel,
            request.signal_kernel,
            request.reach,
            noise_rows,
            signal_rows,
        )
        fill_frame(
            key,
            number,
            signal,
            relative,
            slope,
            np.float32(request.white_fraction),
            request.of("read_variance", frame),
            request.of("dark", frame),
            request.kernel,
            request.signal_kernel,
            noise_rows,
            signal_rows,
            request.electronics,
            np.float32(request.signal_share),
            np.float32(request.steps_a_DN),
            np.float32(request.lowest),
            np.float32(request.highest),
            result[frame],
        )
    return result

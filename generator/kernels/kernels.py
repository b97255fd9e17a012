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
from ._noise_constants import TAPS_TOGETHER

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


def _with_padding(kernel: FloatMap) -> FloatMap:
    """The kernel with zeros at its end up to a multiple of the taps taken together."""
    return np.pad(kernel, (0, -len(kernel) % TAPS_TOGETHER))


def _check_number(name: str, value: float, *, low: float, high: float, unit: str) -> float:
    if not low <= value <= high:
        raise InputError(name, received=f"{value:g}", expected=f"{low:g} to {high:g} {unit}".rstrip())
    return float(value)


def _prepare(
    signal_DN: ArrayLike,
    *,
    gain_DN: ArrayLike,
    gain_relative: ArrayLike,
    white_fraction: float,
    kernel_1d: ArrayLike | None,
    read_noise_DN: ArrayLike,
    dark_DN: ArrayLike,
    bits: int | None,
    quantised: bool,
    averaged: int,
    key: int,
    first_frame: int,
    frames: int | None,
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
        "relative": _map("gain_relative", gain_relative, shape, low=1e-6, high=1e6, unit=""),
        "read": _map("read_noise_DN", read_noise_DN, shape, low=0.0, unit="DN"),
        "dark": _map("dark_DN", dark_DN, shape, low=-_HIGHEST, unit="DN"),
    }
    places = [values.device for values in maps.values() if is_tensor(values)]
    if places:
        from ._torch_kernels import on_device

        maps = {name: on_device(values, places[0]) for name, values in maps.items()}
    kernel = _kernel("kernel_1d", kernel_1d)
    reach = len(kernel) // 2
    read = maps["read"] ** 2 / averaged
    if quantised:
        # each of the averaged frames was rounded; rounding their mean to 1 / averaged DN gives 1 / averaged^2 of it
        read = read + (1.0 / averaged - 1.0 / averaged**2) / 12.0
    return Frames(
        signal=maps["signal"],
        relative=maps["relative"],
        slope=_single(maps["gain"] / float(1.0 + white) / averaged),
        read_variance=_single(read),
        dark=maps["dark"],
        white_fraction=white,
        kernel=kernel if reach == 0 and kernel[0] == 1 else _with_padding(kernel),
        reach=reach,
        electronics=bool(white > 0 or (read > 0).any()),
        steps_a_DN=float(averaged) if quantised else 0.0,
        lowest=0.0 if quantised else -math.inf,
        highest=math.inf if bits is None else float(2**bits - 1),
        key=int(key),
        first_frame=int(first_frame),
        frames=count,
    )


def sample_frames(
    signal_DN: ArrayLike,
    *,
    gain_DN: ArrayLike,
    key: int,
    first_frame: int = 0,
    frames: int | None = None,
    gain_relative: ArrayLike = 1.0,
    white_fraction: float = 0.0,
    kernel_1d: ArrayLike | None = None,
    read_noise_DN: ArrayLike = 0.0,
    dark_DN: ArrayLike = 0.0,
    bits: int | None = None,
    quantised: bool = True,
    averaged: int = 1,
    backend: str = "cpu",
    device: str | None = None,
) -> Any:
    """Detector frames (frame, row, column), or (row, column) for one signal, dark included, DN.

    Per pixel, r the relative gain, S the signal, a = gain / (1 + white_fraction), * the spread:

        Q  = S + r ((X - E X) * h)     X = a N, N a Poisson number of mean S / (r a)
        out = ADC(Q + sqrt(white_fraction a S r + read_noise^2) normal + dark)

    Below a mean of 20, N is an exact Poisson number by inversion; above, one by an expansion of its quantile. Averaged
    frames: quanta and electronics of the mean of `averaged` frames, each rounded, in steps of 1 / averaged DN; of frames
    that saturate the mean is not right.

    Args:
        signal_DN: mean above dark, spread already (row, column) or (frame, row, column), DN; negative counts as 0 quanta.
        gain_DN: variance per signal with the spread's share restored, secondary quanta included, above 0 DN.
        key: from `draw_key`.
        first_frame: number of the first frame under this key; frame f of a piece is frame first_frame + f of the whole.
        frames: how many frames of one signal (row, column); None for one, without the frame axis.
        gain_relative: the pixel's own gain over the detector median, above 0.
        white_fraction: signal-following white variance over quantum variance before the spread.
        kernel_1d: (2 R + 1,) per axis that correlates the noise, `psf.noise_kernel_1d`; None for no spread.
        read_noise_DN: electronic noise of one frame without the ADC's rounding.
        dark_DN: mean without beam.
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
        gain_relative=gain_relative,
        white_fraction=white_fraction,
        kernel_1d=kernel_1d,
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
        single=np.ndim(signal_DN) == 2 and frames is None,
        backend=backend,
        device=device,
    )


def _check_backend(backend: str) -> None:
    if backend not in BACKENDS:
        raise InputError("backend", received=backend, expected="one of " + ", ".join(BACKENDS))


def _sample(
    request: Frames,
    *,
    single: bool,
    backend: str,
    device: str | None,
) -> Any:
    if backend != "cpu":
        from ._torch_kernels import sample

        result = sample(request, device=device, fused=backend == "torch_compiled")
    elif is_tensor(request.signal):
        raise InputError(
            "backend",
            received="cpu for torch tensors",
            expected="torch or torch_compiled",
            remedy="or give numpy arrays",
        )
    else:
        result = _sample_compiled(request)
    return result[0] if single else result


def _sample_compiled(request: Frames) -> NDArray[np.float32]:
    from ._numba_kernels import fill_frame, fill_quanta

    rows, columns = request.signal.shape[-2:]
    result = np.empty((request.frames, rows, columns), dtype=np.float32)
    if result.size == 0:
        return result
    noise_rows = np.empty((rows + 2 * request.reach, columns), dtype=np.float32)
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
            request.kernel,
            request.reach,
            noise_rows,
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
            noise_rows,
            request.electronics,
            np.float32(request.steps_a_DN),
            np.float32(request.lowest),
            np.float32(request.highest),
            result[frame],
        )
    return result

"""The noise of detector frames in torch: the words of the compiled loops, on whatever device torch has.

Same random words, same expansions, other rounding: frames agree with the compiled ones but for the last bits of the
normal numbers (one pixel in some ten thousand takes the next whole quantum).
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ._frames import Frames
from ._noise_constants import (
    EXPANSION_FROM,
    MIX_64,
    MOST_QUANTA,
    MULTIPLIERS,
    STAGE_ELECTRONICS,
    STAGE_FEW_QUANTA,
    STAGE_QUANTA,
    STEP_64,
    STRIDE,
)

_SUMMANDS_AT_ONCE = 2**26  # pixels times energies of a projection: 0.25 GB
_PIXELS_AT_ONCE = 2**24  # frames of a stack are taken together up to this many: some 60 bytes a pixel


def torch_device(device: str | None) -> Any:
    """The torch device of a name; None: cuda where there is one, else the processor.

    Raises:
        InputError: torch does not have it here.
    """
    import torch

    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        found = torch.device(device)
        torch.empty(1, device=found)
    except (RuntimeError, AssertionError) as problem:
        raise InputError(
            "device",
            received=device,
            expected="a device that torch has here, for example cpu or cuda",
            remedy=str(problem).splitlines()[0],
        ) from problem
    return found


def on_device(values: Any, device: Any) -> Any:
    """An array or a tensor as a tensor on the device."""
    import torch

    return (torch.from_numpy(values) if isinstance(values, np.ndarray) else values).to(device)


def _signed(value: int, bits: int) -> int:
    value &= 2**bits - 1
    return value - 2**bits if value >= 2 ** (bits - 1) else value


def _shifted(word: Any, by: int, bits: int = 32) -> Any:
    """Logical shift to the right of signed words."""
    return (word >> by) & (2 ** (bits - by) - 1)


def _mixed(word: Any) -> Any:
    word = (word ^ _shifted(word, 30, 64)) * _signed(MIX_64[0], 64)
    word = (word ^ _shifted(word, 27, 64)) * _signed(MIX_64[1], 64)
    return word ^ _shifted(word, 31, 64)


def row_keys(key: int, frames: Any, stage: int, rows: int) -> Any:
    """Four 32-bit keys (4, frame, row, 1) of every row of `frames` (frame,) int64."""
    import torch

    step = _signed(STEP_64, 64)
    start = torch.tensor(_signed(key + STEP_64, 64), dtype=torch.int64, device=frames.device)
    of_frame = _mixed(_mixed(start) + frames)[:, None]
    row = torch.arange(rows, dtype=torch.int64, device=frames.device)[None, :]
    stream = _mixed(of_frame + (row * 8 + stage))
    other = _mixed(stream + step)
    keys = torch.stack([stream, _shifted(stream, 32, 64), other, _shifted(other, 32, 64)])
    return keys.to(torch.int32)[..., None]  # the low 32 bits


def random_words(keys: Any, column: Any) -> Any:
    """Random words (frame, row, column) int32 from the keys of the rows, for columns given by number (int32)."""
    first, second, third = (_signed(value, 32) for value in MULTIPLIERS)
    x = column * _signed(STRIDE, 32) + keys[0]
    x = x ^ _shifted(x, 17)
    x = (x * first) ^ keys[1]
    x = x ^ _shifted(x, 11)
    x = x * second + keys[2]
    x = x ^ _shifted(x, 15)
    x = (x * third) ^ keys[3]
    return x ^ _shifted(x, 14)


def _unsigned(words: Any, dtype: Any) -> Any:
    """Words as numbers from 0 to 2^32, rounded once."""
    return _shifted(words, 16).to(dtype) * 65536.0 + (words & 0xFFFF).to(dtype)


def normals(keys: Any, columns: int) -> Any:
    """Independent normal numbers (frame, row, columns) from the keys of the rows (Box and Muller).

    The halves of a row share their words; each pixel makes both of its own, so that no pixel needs another's.
    """
    import torch

    half = (columns + 1) // 2
    column = torch.arange(columns, dtype=torch.int32, device=keys.device)
    is_second = column >= half
    place = torch.where(is_second, column - half, column)
    uniform = (_unsigned(random_words(keys, place), torch.float32) + 0.5) * 2.0**-32
    turn = random_words(keys, place + half).to(torch.float32) * (2.0 * math.pi * 2.0**-32)
    return torch.sqrt(-2.0 * torch.log(uniform)) * torch.where(is_second, torch.sin(turn), torch.cos(turn))


def many_quanta(quanta: Any, slope: Any, w: Any) -> Any:
    """slope x (Poisson count - mean) from normal numbers w, for means of EXPANSION_FROM or more (see _numba_kernels)."""
    import torch

    mean = torch.clamp(quanta, min=EXPANSION_FROM)
    root = torch.sqrt(mean)
    part = 1.0 / root
    square = w * w
    away = root * w + (1.0 / 3.0 + square * (1.0 / 6.0))
    away = away - part * w * (1.0 / 36.0 + square * (1.0 / 72.0))
    away = away + part * part * (-8.0 / 405.0 + square * (7.0 / 810.0 + square * (1.0 / 270.0)))
    rest = mean - torch.floor(mean)
    return slope * (torch.floor(rest + away) - rest)


def _inverted(words: Any, mean: Any) -> Any:
    """Poisson counts of `mean` (number,) by inversion, one word each."""
    import torch

    uniform = (_unsigned(words, torch.float64) + 0.5) * 2.0**-32
    probability = torch.exp(-mean)
    cumulative = probability.clone()
    count = torch.zeros_like(mean)
    top = float(mean.max()) if mean.numel() else 0.0
    if top > 0:
        for k in range(1, int(top + 7.0 * math.sqrt(top) + 14.0)):
            count += uniform > cumulative
            probability *= mean / k
            cumulative += probability
    return count


def few_quanta(slope: Any, quanta: Any, words: Any) -> Any:
    """Noise (number,) of pixels of few quanta, float32: see _numba_kernels."""
    import torch

    slope, mean = slope.to(torch.float64), quanta.to(torch.float64)
    return ((_inverted(words, mean) - mean) * slope).to(torch.float32)


def _draw_many(keys: Any, quanta: Any, slope: Any, wide: int) -> Any:
    """Noise (frame, row, wide) of rows whose keys are given, for pixels of many quanta."""
    return many_quanta(quanta, slope, normals(keys, wide))


def _read_out(
    keys: Any,
    signal: Any,
    noise: Any,
    relative: Any,
    slope: Any,
    read_variance: Any,
    dark: Any,
    numbers: tuple[float, float, float, float],
) -> Any:
    """Frames from spread signal and noise; keys None: no electronics; numbers: see `_sample_piece`."""
    import torch

    white_fraction, steps_a_DN, lowest, highest = numbers
    columns = signal.shape[-1]
    frame = signal + noise * relative
    if keys is not None:
        drawn = normals(keys, columns)
        white = white_fraction * slope * relative * torch.clamp(signal, min=0.0)
        frame = frame + torch.sqrt(white + read_variance) * drawn
    frame = frame + dark
    if steps_a_DN > 0:
        frame = torch.round(frame * steps_a_DN) * float(np.float32(1.0) / np.float32(steps_a_DN))
    return torch.clamp(frame, lowest, highest)


def _spread_both(image: Any, taps: tuple[float, ...], rows: int, columns: int) -> Any:
    """Convolution along rows and columns, in single precision whatever the device's convolutions are set to."""
    for axis, length in ((2, columns), (1, rows)):
        result = image.narrow(axis, 0, length) * taps[0]
        for j, tap in enumerate(taps[1:], start=1):
            if tap:
                result = result + image.narrow(axis, j, length) * tap
        image = result
    return image


def sample(request: Frames, *, device: str | None, fused: bool = False) -> Any:
    """Frames (frame, row, column) float32 on the device; `fused` lets torch's compiler join the steps."""
    import torch

    where = torch_device(device)
    rows, columns = request.signal.shape[-2:]
    result = torch.empty((request.frames, rows, columns), dtype=torch.float32, device=where)
    if result.numel() == 0:
        return result
    together = max(1, _PIXELS_AT_ONCE // (rows * columns))
    names = ("signal", "relative", "slope", "read_variance", "dark")
    whole = {name: on_device(getattr(request, name), where) for name in names}
    with torch.no_grad():
        for start in range(0, request.frames, together):
            stop = min(start + together, request.frames)
            maps = {name: values[start:stop] if len(values) > 1 else values for name, values in whole.items()}
            numbers = torch.arange(start, stop, dtype=torch.int64, device=where) + request.first_frame
            result[start:stop] = _sample_piece(request, maps, numbers, fused=fused)
    return result


def _sample_piece(request: Frames, maps: dict[str, Any], frames: Any, *, fused: bool) -> Any:
    import torch

    def step_of(name: str) -> Any:
        return _compiled(name) if fused else globals()[name]

    rows, columns = request.signal.shape[-2:]
    reach = request.reach
    high, wide = rows + 2 * reach, columns + 2 * reach
    device = frames.device
    row_at = torch.clamp(torch.arange(-reach, rows + reach, device=device), 0, rows - 1)
    column_at = torch.clamp(torch.arange(-reach, columns + reach, device=device), 0, columns - 1)

    def widened(values: Any) -> Any:
        if values.shape[1:] == (1, 1) or reach == 0:
            return values
        return values.index_select(1, row_at).index_select(2, column_at)

    slope = widened(maps["slope"])
    level = torch.clamp(widened(maps["signal"]) / widened(maps["relative"]), min=0.0)
    quanta = torch.clamp(level * slope / (slope * slope), max=MOST_QUANTA)
    noise = step_of("_draw_many")(row_keys(request.key, frames, STAGE_QUANTA, high), quanta, slope, wide)
    few = quanta < EXPANSION_FROM
    if bool(few.any()):
        shape = noise.shape
        places = few.expand(shape).nonzero(as_tuple=True)

        def chosen(values: Any) -> Any:
            return values.expand(shape)[places]

        column = torch.arange(wide, dtype=torch.int32, device=device)
        words = random_words(row_keys(request.key, frames, STAGE_FEW_QUANTA, high), column)
        noise[places] = few_quanta(chosen(slope), chosen(quanta), words[places])
    if len(request.kernel) > 1 or reach:
        taps = tuple(float(tap) for tap in request.kernel[: 2 * reach + 1])
        noise = step_of("_spread_both")(noise, taps, rows, columns)
    keys = row_keys(request.key, frames, STAGE_ELECTRONICS, rows) if request.electronics else None
    numbers = (request.white_fraction, request.steps_a_DN, request.lowest, request.highest)
    return step_of("_read_out")(
        keys, maps["signal"], noise, maps["relative"], maps["slope"], maps["read_variance"], maps["dark"], numbers
    )


@contextmanager
def _single_precision() -> Iterator[None]:
    """Matrix products in full single precision, whatever the caller allows for networks."""
    import torch

    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _exponential_sums(paths: Any, depths: Any, shares: Any) -> Any:
    """(pixel, k) of paths (pixel, material), depths (material, energy) and shares (energy, k)."""
    import torch

    # past 2^126 only negative thicknesses come, and no further than single precision
    return torch.exp2(torch.clamp(paths @ -depths, max=126.0)) @ shares


def _fused_exponential_sums(paths: Any, depths: Any, shares: Any) -> Any:
    """The same without matrix products, in a form whose (pixel, energy) terms a compiler never writes down."""
    import torch

    exponent = -(paths[:, 0, None] * depths[0])
    for material in range(1, depths.shape[0]):
        exponent = exponent - paths[:, material, None] * depths[material]
    terms = torch.exp2(torch.clamp(exponent, max=126.0))
    return torch.stack([(terms * shares[:, k]).sum(dim=1) for k in range(shares.shape[1])], dim=1)


def project(
    thickness: Any,
    depth: NDArray[np.float64],
    share: NDArray[np.float64],
    *,
    device: str | None,
    fused: bool = False,
) -> Any:
    """sum_j share[k, j] 2^(-sum_m depth[m, j] thickness[m, p]) (k, pixel) float32 on the device."""
    import torch

    where = torch_device(device)
    paths = on_device(thickness, where)
    depths = torch.from_numpy(depth.astype(np.float32)).to(where)
    shares = torch.from_numpy(share.astype(np.float32).T.copy()).to(where)
    pixels, energies = thickness.shape[1], depth.shape[1]
    if fused and len(depths) and energies and pixels:
        with torch.no_grad():
            return _compiled("_fused_exponential_sums")(paths.T, depths, shares).T
    result = torch.zeros((share.shape[0], pixels), dtype=torch.float32, device=where)
    together = max(1, _SUMMANDS_AT_ONCE // max(energies, 1))
    with torch.no_grad(), _single_precision():
        for start in range(0, pixels, together):
            part = paths[:, start : start + together].T
            result[:, start : start + together] = _exponential_sums(part, depths, shares).T
    return result


@lru_cache(maxsize=16)
def _compiled(name: str) -> Any:
    """A function of this module as torch's compiler makes it: one pass over memory for what is many otherwise."""
    import torch

    return torch.compile(globals()[name], dynamic=False)

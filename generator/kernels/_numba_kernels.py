"""Compiled noise of detector frames: random words by counting, quanta, spread, electronics, readout.

Every number is a function of (key, frame, stage, row, column) alone, and every pixel's arithmetic of its place in its
row: neither threads nor pieces change a byte. Loops run along rows in buffers that stay in the nearest cache, so that the
compiler turns them into vector instructions.
"""

from typing import Any

import numpy as np
from numba import njit, prange

from ._noise_constants import (
    COSINE,
    EXPANSION_FROM,
    LOGARITHM,
    MIX_64,
    MOST_QUANTA,
    MULTIPLIERS,
    SINE,
    STAGE_ELECTRONICS,
    STAGE_FEW_QUANTA,
    STAGE_QUANTA,
    STEP_64,
    STRIDE,
    TAPS_TOGETHER,
)

# error_model="numpy" everywhere: the check for a zero divisor would keep divisions out of vectors; divisors are checked before
_FAST = {"contract", "nsz", "arcp"}
_BAND = 8  # rows a thread takes at a time
_A, _B, _C = (np.uint32(value) for value in MULTIPLIERS)
_STRIDE = np.uint32(STRIDE)
_MIX_1, _MIX_2 = (np.uint64(value) for value in MIX_64)
_STEP = np.uint64(STEP_64)
_L0, _L1, _L2, _L3, _L4, _L5, _L6, _L7, _L8 = (np.float32(value) for value in LOGARITHM)
_S0, _S1, _S2, _S3, _S4, _S5 = (np.float32(value) for value in SINE)
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = (np.float32(value) for value in COSINE)
_FROM = np.float32(EXPANSION_FROM)
_MOST = np.float32(MOST_QUANTA)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _mixed(word: Any) -> Any:
    """A 64-bit word well mixed (the finalizer of splitmix64)."""
    word = (word ^ (word >> np.uint64(30))) * _MIX_1
    word = (word ^ (word >> np.uint64(27))) * _MIX_2
    return word ^ (word >> np.uint64(31))


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _fill_words(key: Any, frame: Any, stage: Any, row: Any, words: Any) -> None:
    """Random 32-bit words of a row, one a column: three keyed rounds of multiply and shift on the column's number."""
    stream = _mixed(_mixed(_mixed(key + _STEP) + frame) + (np.uint64(row) * np.uint64(8) + np.uint64(stage)))
    other = _mixed(stream + _STEP)
    k_0 = np.uint32(stream)
    k_1 = np.uint32(stream >> np.uint64(32))
    k_2 = np.uint32(other)
    k_3 = np.uint32(other >> np.uint64(32))
    for c in range(len(words)):
        x = np.uint32(np.uint32(c) * _STRIDE + k_0)
        x = np.uint32(x ^ (x >> np.uint32(17)))
        x = np.uint32(np.uint32(x * _A) ^ k_1)
        x = np.uint32(x ^ (x >> np.uint32(11)))
        x = np.uint32(np.uint32(x * _B) + k_2)
        x = np.uint32(x ^ (x >> np.uint32(15)))
        x = np.uint32(np.uint32(x * _C) ^ k_3)
        words[c] = np.uint32(x ^ (x >> np.uint32(14)))


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _fill_polar(words: Any, turns: Any, first: Any, second: Any) -> None:
    """Two independent normal numbers of each pair of words (Box and Muller), each factor to 1e-6."""
    for c in range(len(second)):
        u = np.float32((np.float32(words[c]) + np.float32(0.5)) * np.float32(2.0**-32))
        bits = np.int32(u.view(np.int32))
        # the power of two that brings the rest to sqrt(1/2) .. sqrt(2), whose bits the constant holds
        power = np.int32(np.int32(bits - np.int32(0x3F3504F3)) >> np.int32(23))
        x = np.float32(np.int32(bits - np.int32(power << np.int32(23))).view(np.float32) - np.float32(1.0))
        y = _L0
        y = y * x + _L1
        y = y * x + _L2
        y = y * x + _L3
        y = y * x + _L4
        y = y * x + _L5
        y = y * x + _L6
        y = y * x + _L7
        y = y * x + _L8
        y = y * x * x * x - np.float32(0.5) * x * x + x
        logarithm = y + np.float32(power) * np.float32(0.6931472)
        radius = np.sqrt(np.float32(abs(np.float32(-2.0) * logarithm)))  # -0 and a last bit below it at u = 1
        v = np.float32(np.int32(turns[c])) * np.float32(2.0**-32)
        q = v * v
        sine = v * (_S0 + q * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * _S5)))))
        cosine = _C0 + q * (_C1 + q * (_C2 + q * (_C3 + q * (_C4 + q * (_C5 + q * _C6)))))
        first[c] = radius * cosine
        second[c] = radius * sine


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _fill_normals(key: Any, frame: Any, stage: Any, row: Any, words: Any, normals: Any) -> None:
    """Independent normal numbers of a row (columns,); words and normals hold room for an even number."""
    half = len(normals) // 2
    _fill_words(key, frame, stage, row, words[: 2 * half])
    _fill_polar(words[:half], words[half : 2 * half], normals[:half], normals[half : 2 * half])


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _row_of(values: Any, row: Any, out: Any, reach: Any) -> None:
    """A row of a map (rows or 1, columns or 1) repeated at both ends by `reach`."""
    from_row = row if values.shape[0] > 1 else 0
    size = values.shape[1]
    if size == 1:
        for c in range(len(out)):
            out[c] = values[from_row, 0]
        return
    for c in range(reach):
        out[c] = values[from_row, 0]
    for c in range(size):
        out[reach + c] = values[from_row, c]
    for c in range(reach + size, len(out)):
        out[c] = values[from_row, size - 1]


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _add_taps(k: Any, r_0: Any, r_1: Any, r_2: Any, r_3: Any, r_4: Any, r_5: Any, r_6: Any, r_7: Any, out: Any) -> None:
    """Add eight rows of at least the length of `out`, weighted with `k` (8,)."""
    k_0, k_1, k_2, k_3, k_4, k_5, k_6, k_7 = k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7]
    for c in range(len(out)):
        total = (k_0 * r_0[c] + k_1 * r_1[c]) + (k_2 * r_2[c] + k_3 * r_3[c])
        out[c] += total + ((k_4 * r_4[c] + k_5 * r_5[c]) + (k_6 * r_6[c] + k_7 * r_7[c]))


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _convolve(wide: Any, kernel: Any, out: Any) -> None:
    """out[c] = sum_j kernel[j] wide[c + j]; the kernel's length a multiple of TAPS_TOGETHER, zeros at its end."""
    for c in range(len(out)):
        out[c] = 0.0
    for j in range(0, len(kernel), TAPS_TOGETHER):
        p = wide[j:]
        _add_taps(kernel[j : j + TAPS_TOGETHER], p, p[1:], p[2:], p[3:], p[4:], p[5:], p[6:], p[7:], out)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _convolve_down(rows: Any, first: Any, kernel: Any, out: Any) -> None:
    """out[c] = sum_j kernel[j] rows[first + j, c]; rows beyond the last stand for zeros of the kernel."""
    end = len(rows) - 1
    for c in range(len(out)):
        out[c] = 0.0
    for j in range(0, len(kernel), TAPS_TOGETHER):
        at = first + j
        _add_taps(
            kernel[j : j + TAPS_TOGETHER],
            rows[min(at, end)],
            rows[min(at + 1, end)],
            rows[min(at + 2, end)],
            rows[min(at + 3, end)],
            rows[min(at + 4, end)],
            rows[min(at + 5, end)],
            rows[min(at + 6, end)],
            rows[min(at + 7, end)],
            out,
        )


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _invert(words: Any, mean: Any, count: Any, number: Any) -> None:
    """Poisson counts (number,) of `mean` by inversion of the cumulative probability; one word each."""
    piece = 64
    probability = np.empty(piece, np.float64)
    cumulative = np.empty(piece, np.float64)
    uniform = np.empty(piece, np.float64)
    found = np.empty(piece, np.float64)
    for start in range(0, number, piece):
        size = min(piece, number - start)
        top = 0.0
        for i in range(size):
            top = max(top, mean[start + i])
        for i in range(size):
            probability[i] = np.exp(-mean[start + i])
            cumulative[i] = probability[i]
            uniform[i] = (np.float64(words[start + i]) + 0.5) * 2.0**-32
            found[i] = 0.0
        if top > 0:
            # beyond this nothing of 2^-33 is left
            for k in range(1, int(top + 7.0 * np.sqrt(top) + 14.0)):
                share = 1.0 / k
                for i in range(size):
                    found[i] += 1.0 if uniform[i] > cumulative[i] else 0.0
                    probability[i] *= mean[start + i] * share
                    cumulative[i] += probability[i]
        for i in range(size):
            count[start + i] = found[i]


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _draw_few(key: Any, frame: Any, row: Any, quanta: Any, slope: Any, words: Any, noise: Any) -> None:
    """Replace the noise of pixels of few quanta by slope x (exact Poisson count - mean)."""
    columns = len(quanta)
    at = np.empty(columns, np.int64)
    mean = np.empty(columns, np.float64)
    number = 0
    for c in range(columns):
        if quanta[c] >= _FROM:
            continue
        if quanta[c] <= 0:
            noise[c] = 0.0
            continue
        at[number], mean[number] = c, quanta[c]
        number += 1
    if number == 0:
        return
    count = np.empty(columns, np.float64)
    chosen = np.empty(number, np.uint32)
    _fill_words(key, frame, STAGE_FEW_QUANTA, row, words[:columns])
    for i in range(number):
        chosen[i] = words[at[i]]
    _invert(chosen, mean, count, number)
    for i in range(number):
        worth = np.float64(slope[at[i]])
        noise[at[i]] = count[i] * worth - mean[i] * worth


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _draw_many(quanta: Any, slope: Any, noise: Any) -> None:
    """Normal numbers in `noise` become slope x (Poisson count - mean), for means of EXPANSION_FROM or more.

    The quantile of a Poisson number as an expansion in a normal number (Giles 2016, ACM TOMS 42, 7, doi 10.1145/2699466),
    relative to the mean so that single precision does for any mean.
    """
    for c in range(len(quanta)):
        mean = max(quanta[c], _FROM)
        root = np.sqrt(mean)
        part = np.float32(1.0) / root
        w = noise[c]
        square = w * w
        away = root * w + (np.float32(1.0 / 3.0) + square * np.float32(1.0 / 6.0))
        away -= part * w * (np.float32(1.0 / 36.0) + square * np.float32(1.0 / 72.0))
        away += (
            part
            * part
            * (np.float32(-8.0 / 405.0) + square * (np.float32(7.0 / 810.0) + square * np.float32(1.0 / 270.0)))
        )
        rest = mean - np.floor(mean)
        noise[c] = slope[c] * (np.floor(rest + away) - rest)


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _divide(first: Any, second: Any, out: Any) -> None:
    for c in range(len(out)):
        out[c] = first[c] / second[c]


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _count_quanta(mean: Any, slope: Any, quanta: Any) -> None:
    """Mean number of quanta: variance over the square of a quantum, of a signal of 0 or more."""
    for c in range(len(quanta)):
        quanta[c] = max(mean[c], np.float32(0.0))
    for c in range(len(quanta)):
        quanta[c] = min(quanta[c] * slope[c] / (slope[c] * slope[c]), _MOST)


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _scale_normals(white_fraction: Any, slope: Any, gains: Any, mean: Any, read: Any, normals: Any) -> None:
    """Normal numbers times the standard deviation of white quanta and electronics."""
    for c in range(len(mean)):
        white = white_fraction * slope[c] * gains[c] * max(mean[c], np.float32(0.0)) + read[c]
        normals[c] *= np.sqrt(white)


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _multiply(factor: Any, out: Any) -> None:
    for c in range(len(out)):
        out[c] *= factor[c]


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _add_up(mean: Any, noise: Any, normals: Any, dark: Any, out: Any) -> None:
    for c in range(len(out)):
        out[c] = (mean[c] + noise[c]) + (normals[c] + dark[c])


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _quanta_band(
    band: Any,
    key: Any,
    frame: Any,
    signal: Any,
    relative: Any,
    slope: Any,
    kernel: Any,
    reach: Any,
    noise_out: Any,
) -> None:
    rows, columns = signal.shape
    total = len(noise_out)
    wide = columns + 2 * reach
    words = np.empty(wide + 1, np.uint32)
    level = np.empty(wide, np.float32)
    gains = np.empty(wide, np.float32)
    slopes = np.empty(wide, np.float32)
    quanta = np.empty(wide, np.float32)
    # the kernel is padded to a multiple of taps; zeros stand beyond the row
    noise = np.zeros(wide + TAPS_TOGETHER, np.float32)
    mean = np.empty(wide, np.float32)
    for i in range(band * _BAND, min(band * _BAND + _BAND, total)):
        row = min(max(i - reach, 0), rows - 1)
        _row_of(signal, row, level, reach)
        _row_of(relative, row, gains, reach)
        _row_of(slope, row, slopes, reach)
        _divide(level, gains, mean)
        _count_quanta(mean, slopes, quanta)
        few = np.int32(0)
        for c in range(wide):
            few = np.int32(few + np.int32(quanta[c] < _FROM))
        _fill_normals(key, frame, STAGE_QUANTA, i, words, noise[: wide + wide % 2])
        _draw_many(quanta, slopes, noise[:wide])
        if few > 0:
            _draw_few(key, frame, i, quanta, slopes, words, noise[:wide])
        if len(kernel) > 1:
            _convolve(noise, kernel, noise_out[i])
        else:
            for c in range(columns):
                noise_out[i, c] = noise[c]


@njit(parallel=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def fill_quanta(
    key: Any,
    frame: Any,
    signal: Any,
    relative: Any,
    slope: Any,
    kernel: Any,
    reach: Any,
    noise_out: Any,
) -> None:
    """Quantum noise of rows -reach .. rows + reach, spread along the rows: noise_out (rows + 2 reach, columns).

    Maps are (rows or 1, columns or 1); outside the image the edge's values stand.
    """
    for band in prange((len(noise_out) + _BAND - 1) // _BAND):
        _quanta_band(
            band,
            key,
            frame,
            signal,
            relative,
            slope,
            kernel,
            reach,
            noise_out,
        )


@njit(fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _frame_band(
    band: Any,
    key: Any,
    frame: Any,
    signal: Any,
    relative: Any,
    slope: Any,
    white_fraction: Any,
    read_variance: Any,
    dark: Any,
    kernel: Any,
    noise_rows: Any,
    electronics: Any,
    steps_a_DN: Any,
    lowest: Any,
    highest: Any,
    out: Any,
) -> None:
    rows, columns = out.shape
    words = np.empty(columns + 1, np.uint32)
    normals = np.zeros(columns + 1, np.float32)
    noise = np.empty(columns, np.float32)
    mean = np.empty(columns, np.float32)
    gains = np.empty(columns, np.float32)
    slopes = np.empty(columns, np.float32)
    reads = np.empty(columns, np.float32)
    darks = np.empty(columns, np.float32)
    for row in range(band * _BAND, min(band * _BAND + _BAND, rows)):
        _row_of(relative, row, gains, 0)
        _row_of(slope, row, slopes, 0)
        _row_of(read_variance, row, reads, 0)
        _row_of(dark, row, darks, 0)
        if len(kernel) > 1:
            _convolve_down(noise_rows, row, kernel, noise)
        else:
            for c in range(columns):
                noise[c] = noise_rows[row, c]
        _row_of(signal, row, mean, 0)
        if electronics:
            _fill_normals(key, frame, STAGE_ELECTRONICS, row, words, normals[: columns + columns % 2])
        one = out[row]
        _scale_normals(white_fraction, slopes, gains, mean, reads, normals)
        _multiply(gains, noise)
        _add_up(mean, noise, normals, darks, one)
        if steps_a_DN > 0:
            step = np.float32(1.0) / steps_a_DN
            for c in range(columns):
                one[c] = np.rint(one[c] * steps_a_DN) * step
        for c in range(columns):
            one[c] = min(max(one[c], lowest), highest)


@njit(parallel=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def fill_frame(
    key: Any,
    frame: Any,
    signal: Any,
    relative: Any,
    slope: Any,
    white_fraction: Any,
    read_variance: Any,
    dark: Any,
    kernel: Any,
    noise_rows: Any,
    electronics: Any,
    steps_a_DN: Any,
    lowest: Any,
    highest: Any,
    out: Any,
) -> None:
    """Spread along the columns, add white noise, electronics and dark, digitise; out (rows, columns).

    steps_a_DN 0 leaves the result unrounded; noise_rows come from fill_quanta.
    """
    for band in prange((len(out) + _BAND - 1) // _BAND):
        _frame_band(
            band,
            key,
            frame,
            signal,
            relative,
            slope,
            white_fraction,
            read_variance,
            dark,
            kernel,
            noise_rows,
            electronics,
            steps_a_DN,
            lowest,
            highest,
            out,
        )

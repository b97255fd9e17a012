"""Registration of a dual-energy pair: by how much one image lies beside the other, and moving it back."""

import math

import numpy as np
from numpy.typing import NDArray

from ...errors import FitError, InputError
from .psf import convolve_separable, sampled_gaussian_1d

_STEPS = 20
_SETTLED_PX = 1e-3
_LARGEST_PX = 20.0


def shift_image(image: NDArray[np.floating], shift_px: tuple[float, float]) -> NDArray[np.float64]:
    """An image moved by (row, column) pixels (unit of the image): what was at y is at y + shift.

    By the shift theorem: every spatial frequency keeps its amplitude, so noise keeps its variance and correlation, which
    interpolation between pixels would lower. Whole pixels move exactly. The border is continued by mirroring.

    Args:
        image: (row, column).
        shift_px: rows and columns, at most 20.

    Raises:
        InputError: a shift that is not finite or above 20 pixels.
    """
    if not all(math.isfinite(one) and abs(one) <= _LARGEST_PX for one in shift_px):
        raise InputError("registration shift", received=f"{shift_px} px", expected=f"at most {_LARGEST_PX:g} px")
    plane = np.asarray(image, dtype=np.float64)
    margin = min(32, *(length - 1 for length in plane.shape))
    # mirrored about the border, and tapered by nothing: both ends of the enlarged image meet at equal values
    wide = np.pad(plane, margin, mode="symmetric") if margin > 0 else plane
    whole = [round(one) for one in shift_px]
    rest = [one - step for one, step in zip(shift_px, whole, strict=True)]
    moved = np.roll(wide, whole, axis=(0, 1))
    if any(abs(one) > 1e-9 for one in rest):
        rows, columns = (np.fft.fftfreq(length) for length in moved.shape)
        phase = np.exp(-2j * np.pi * (rows[:, None] * rest[0] + columns[None, :] * rest[1]))
        moved = np.fft.ifft2(np.fft.fft2(moved) * phase).real
    inner = slice(margin, -margin) if margin > 0 else slice(None)
    return np.asarray(moved[inner, inner])


def estimate_shift_px(low: NDArray[np.floating], high: NDArray[np.floating]) -> tuple[float, float]:
    """Shift (row, column) of the high-kV log image against the low-kV one, in pixels.

    Both are smoothed by a pixel; the peak of their correlation gives whole pixels. Then the low image is fitted by
    c0 + c1 H + c2 H^2 + s_row dH/drow + s_column dH/dcolumn, H the high image moved back by the shift so far; s / c1 is what
    is still missing. A foreign object attenuates otherwise than the product, which pulls at the fit on all sides alike.

    Args:
        low, high: (row, column) -ln(I / I0).

    Raises:
        FitError: images without structure, or more than 20 pixels apart.
    """
    wanted, given = (_quietened(image) for image in (low, high))
    shift = _whole_pixels(wanted, given)
    for _ in range(_STEPS):
        moved = shift_image(given, (-float(shift[0]), -float(shift[1])))
        slopes = np.gradient(moved)
        # what came in over the border is no measurement
        rim = 3 + math.ceil(float(np.abs(shift).max()))
        edge = slice(rim, -rim)
        columns = np.stack([np.ones_like(moved), moved, moved**2, slopes[0], slopes[1]], axis=-1)[edge, edge].reshape(
            -1, 5
        )
        found, _, rank, _ = np.linalg.lstsq(columns, wanted[edge, edge].ravel(), rcond=1e-10)
        if rank < 5 or not found[1] > 0:
            raise FitError("registration: the images have too little structure to find their shift; state it in pixels")
        # H, still d too far, is H0 - d dH0/dy: the low image asks for H + d dH/dy
        missing = found[3:] / (found[1] + 2 * found[2] * float(np.mean(moved)))
        shift = shift + np.clip(missing, -2.0, 2.0)
        if not np.all(np.abs(shift) <= _LARGEST_PX):
            raise FitError("registration: the images lie more than 20 pixels apart; state the shift in pixels")
        if np.all(np.abs(missing) < _SETTLED_PX):
            break
    return float(shift[0]), float(shift[1])


def _quietened(image: NDArray[np.floating]) -> NDArray[np.float64]:
    return convolve_separable(image, sampled_gaussian_1d(1.0, 4)).astype(np.float64)


def _whole_pixels(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift of `high` in whole pixels, at most 20, where it correlates best with `low`."""
    window = np.outer(*(np.hanning(length + 2)[1:-1] for length in low.shape))
    first, second = ((image - image.mean()) * window for image in (low, high))
    shape = [2 * length for length in low.shape]
    correlation = np.fft.irfft2(np.conj(np.fft.rfft2(first, shape)) * np.fft.rfft2(second, shape), shape)
    reach = [min(int(_LARGEST_PX) - 1, length // 2) for length in low.shape]
    offsets = [np.arange(-one, one + 1) for one in reach]
    near = correlation[np.ix_(*offsets)]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    return np.array([offsets[0][row], offsets[1][column]], dtype=np.float64)

"""Spatial frequencies that objects and noise are compared at: the quadrant of a square patch, in bins.

A patch of n x n pixels has frequencies k / n along rows and columns. Powers of noise are even along both axes, so the quadrant
0 .. 1/2 is enough. Neighbouring frequencies share a bin, one by one near 0 and wider ones further out, where the power of
objects is small and smooth:

    sum over bins of (quantity summed within the bin) = sum over all n x n frequencies / n^2
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrequencyBins:
    """Bins of the frequencies of a patch.

    Fields: cells (side n of the patch, px); axis (bin of each frequency 0 .. n/2, one axis); row, column (bin,): root mean square
    frequency, cycles per pixel; share (bin,): frequencies in it over n^2, which sum to 1.

    Example:
        >>> from raytwin.observers import frequency_bins
        >>> bins = frequency_bins(32)
        >>> round(float(bins.share.sum()), 9)
        1.0
    """

    cells: int
    axis: NDArray[np.intp]
    row: FloatArray
    column: FloatArray
    share: FloatArray

    def sum_quadrant(self, values: FloatArray) -> FloatArray:
        """Sums (..., bin) of a quantity given on the quadrant (..., n/2 + 1, n/2 + 1), each already summed over its signs."""
        starts = np.flatnonzero(np.diff(self.axis, prepend=-1))
        summed = np.add.reduceat(np.add.reduceat(values, starts, axis=-2), starts, axis=-1)
        return np.asarray(summed.reshape(*values.shape[:-2], -1))

    def mean_quadrant(self, values: FloatArray) -> FloatArray:
        """Means (..., bin) of a quantity that is even along both axes, given on the quadrant."""
        return self.sum_quadrant(values * _multiplicity(self.cells)) / (self.share * self.cells**2)

    def mean_axis(self, values: FloatArray) -> FloatArray:
        """Means (..., axis bin) of a quantity of one axis (..., n/2 + 1) that is even."""
        starts = np.flatnonzero(np.diff(self.axis, prepend=-1))
        weight = _signs(self.cells)
        return np.asarray(np.add.reduceat(values * weight, starts, axis=-1) / np.add.reduceat(weight, starts))

    def on_rows(self, values: FloatArray) -> FloatArray:
        """A quantity of the row frequency alone (..., axis bin) at every bin (..., bin)."""
        return np.repeat(values, values.shape[-1], axis=-1)

    def on_columns(self, values: FloatArray) -> FloatArray:
        """A quantity of the column frequency alone (..., axis bin) at every bin (..., bin)."""
        return np.tile(values, values.shape[-1])


def _signs(cells: int) -> FloatArray:
    """How many of the patch's frequencies stand for each of 0 .. n/2 along one axis."""
    count = np.full(cells // 2 + 1, 2.0)
    count[[0, -1]] = 1.0
    return count


def _multiplicity(cells: int) -> FloatArray:
    return np.multiply.outer(_signs(cells), _signs(cells))


def frequency_bins(cells: int) -> FrequencyBins:
    """Bins of a patch of `cells` x `cells` pixels (an even number, 8 or more): alone up to 4 / n, then a third wide.

    Raises:
        InputError: an odd or too small patch.
    """
    if cells < 8 or cells % 2:
        raise InputError("cells", received=cells, expected="an even number of pixels, 8 or more")
    edges = [0, 1, 2, 3, 4]
    while edges[-1] < cells // 2:
        edges.append(max(edges[-1] + 1, (4 * edges[-1]) // 3))
    axis = np.searchsorted(np.array(edges), np.arange(cells // 2 + 1), side="left").astype(np.intp)
    signs = _signs(cells)
    frequency = np.arange(cells // 2 + 1) / cells
    count = np.bincount(axis, signs)
    rms = np.sqrt(np.bincount(axis, signs * frequency**2) / count)
    share = np.multiply.outer(count, count).ravel() / cells**2
    return FrequencyBins(
        cells=cells,
        axis=axis,
        row=np.repeat(rms, rms.size),
        column=np.tile(rms, rms.size),
        share=share,
    )


def object_spectrum(profile: FloatArray, bins: FrequencyBins) -> tuple[FloatArray, FloatArray]:
    """Energy and amplitude of an object's profile (row, column), at most a patch in size, in bins.

    energy: |F|^2 / n^2, whose sum is that of the squares of the profile; amplitude: Re F / n^2 about its centre of gravity, whose
    sum with a channel's transfer function is the response of that channel in the centre.

    Returns:
        energy (bin,), amplitude (bin,).

    Raises:
        InputError: a profile larger than the patch, or without any object.
    """
    n = bins.cells
    if max(profile.shape) > n:
        raise InputError("object's profile", received=f"{profile.shape} px", expected=f"at most {n} x {n} px")
    total = float(profile.sum())
    if not total > 0:
        raise InputError("object's profile", received="nothing in it", expected="values above 0")
    rows, columns = (np.arange(length, dtype=np.float64) for length in profile.shape)
    centre = (float(profile.sum(axis=1) @ rows) / total, float(profile.sum(axis=0) @ columns) / total)
    frequency = np.fft.fftfreq(n)
    back = np.exp(2j * np.pi * (centre[0] * frequency[:, None] + centre[1] * frequency[None, :]))
    spectrum = np.fft.fft2(profile, s=(n, n)) * back
    energy, amplitude = (_folded(values) / n**2 for values in (np.abs(spectrum) ** 2, spectrum.real))
    return bins.sum_quadrant(energy), bins.sum_quadrant(amplitude)


def _folded(whole: FloatArray) -> FloatArray:
    """Sums over the signs of the frequencies, (n/2 + 1, n/2 + 1) of (n, n)."""
    half = whole.shape[0] // 2
    rows = whole[: half + 1].copy()
    rows[1:half] += whole[-1:half:-1]
    folded = rows[:, : half + 1].copy()
    folded[:, 1:half] += rows[:, -1:half:-1]
    return folded

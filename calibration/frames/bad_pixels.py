"""Bad pixels of a session, with the reason for each, and the clusters that they form."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import Series
from ...generator.line.twin import BAD_PIXEL_CODES
from ._kept_sums import KeptSums
from .code_steps import least_change
from .dark_frames import DarkFrames
from .robust import robust_sd

_DARK_NOISE_SIGMAS = 8.0  # how far a pixel must stand out to be called hot
_DEAD = 0.5  # share of its neighbours' response below which a pixel is dead
_LEAST_DEPARTURE = 0.05  # of its response, from which a pixel is nonlinear
_SAMPLED = 100_000  # pixels that tell a middle and a spread to half a per cent
_CLUSTER_SHARE = 0.6  # of those limits, in pixels that touch a bad one
_CLUSTER_NEIGHBOURS = 5  # bad ones of the eight about a pixel that leave it nothing to be interpolated from
_NOISY_CHANCE = 1e-9  # chance that a good pixel's noise looks as large as one called noisy


def find_bad_pixels(darks: DarkFrames, flats: Sequence[tuple[Series, KeptSums]]) -> NDArray[np.uint8]:
    """Reason codes (row, column) from the darks' level and noise and from the flats' response.

    The response is judged in the brightest flat, and what differs from that in each other one: a pixel may die in between.
    """
    from scipy.ndimage import median_filter

    code, closest = _bad_in_darks(darks)
    brightest = max(flats, key=lambda pair: float(np.median(pair[1].mean_DN)))
    signal = brightest[1].mean_DN - darks.of(brightest[0])
    if not np.median(signal) > 0:
        return _with_clusters(code, closest)  # no response to judge; the caller says so
    local = median_filter(signal, size=5, mode="nearest")
    ratio = signal / np.where(local > 0, local, np.nan)
    code[(~np.isfinite(ratio) | (ratio < _DEAD)) & (code == 0)] = BAD_PIXEL_CODES["dead"]
    centre, spread = _robust_spread(ratio[np.isfinite(ratio)])
    departure = np.nan_to_num(np.abs(ratio - centre) / max(_DARK_NOISE_SIGMAS * spread, _LEAST_DEPARTURE))
    np.maximum(closest, departure, out=closest)
    code[(departure > 1.0) & (code == 0)] = BAD_PIXEL_CODES["nonlinear"]
    del local, ratio, departure  # as large as the panel
    for item, total in flats:
        if item is not brightest[0]:
            _mark_changed(code, total.mean_DN - darks.of(item), signal)
    return _with_clusters(code, closest)


def unsteady_in_darks(darks: DarkFrames) -> NDArray[np.bool_]:
    """Pixels (row, column) that the darks alone show as bad: hot ones and noisy ones."""
    return np.asarray(_bad_in_darks(darks)[0] != 0)


def is_noisy(variance_DN2: NDArray[np.float64], effective: float, step_DN2: float = 0.0) -> NDArray[np.bool_]:
    """Where a variance from so many frames lies above that of all others by more than chance.

    A variance from few frames has long tails (chi-square): cutting them off would lower the pooled variance.
    """
    from scipy.special import chdtri  # of chi-square's upper tail; scipy.stats would take 40 MB

    centre = float(np.median(variance_DN2)) * effective / float(chdtri(effective, 0.5))
    limit = centre * float(chdtri(effective, _NOISY_CHANCE)) / effective + step_DN2
    return np.asarray(variance_DN2 > max(limit, 2.0 * centre))


def _bad_in_darks(darks: DarkFrames) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Reason codes of hot and noisy pixels, and the largest departure of each pixel in limits (row, column)."""
    from scipy.ndimage import median_filter

    code = np.zeros(darks.per_ms.shape, dtype=np.uint8)
    closest = np.zeros(darks.per_ms.shape)
    # noise far below the distance of the codes shows in pixels that lie between two of them alone: half of it in a mean
    steps = [(least_change(item.read_frames(0, min(item.n_frames, 2))), item.averaged) for item, _ in darks.sums]
    step_DN = max((step for step, _ in steps), default=1.0)
    # what a step in a mean of exposures is in the variance of one
    step_DN2 = max((averaged * step**2 for step, averaged in steps), default=1.0)
    for key, mean in darks.by_exposure.items():
        local = mean - median_filter(mean, size=5, mode="nearest")
        centre, spread = _robust_spread(local)
        limit = _DARK_NOISE_SIGMAS * max(spread, 0.5 * step_DN)
        frames = sum(
            total.frames * item.averaged for item, total in darks.sums if (item.session, item.exposure_ms) == key
        )
        # the mean of a noisy pixel strays by its own noise; that alone does not make it hot
        own = 4.0 * np.sqrt(np.nan_to_num(darks.variance) / max(frames, 1))
        departure = np.abs(local - centre) / np.maximum(limit, own)
        np.maximum(closest, departure, out=closest)
        code[(departure > 1.0) & (code == 0)] = BAD_PIXEL_CODES["hot"]
    variance, effective = (darks.variance, darks.effective) if darks.effective > 0 else darks.variance_between_series()
    if effective > 0 and np.all(np.isfinite(variance)):
        code[is_noisy(variance, effective, step_DN2) & (code == 0)] = BAD_PIXEL_CODES["noisy"]
    return code, closest


def _mark_changed(code: NDArray[np.uint8], other: NDArray[np.float64], signal: NDArray[np.float64]) -> None:
    """Mark pixels (row, column) whose response in another flat is not that of the brightest; signals less darks, DN.

    A part of the field that changed, as by something that stood in the beam, is no fault of its pixels: they change as their
    neighbours do.
    """
    from scipy.ndimage import median_filter

    judged = code == 0
    change = np.divide(other, signal, out=np.zeros_like(signal), where=judged)
    every = max(math.isqrt(change.size // _SAMPLED), 1)
    sample = change[::every, ::every][judged[::every, ::every]]
    if not sample.size:
        return
    centre, spread = _robust_spread(sample)
    limit = max(_DARK_NOISE_SIGMAS * spread, _LEAST_DEPARTURE * centre)
    if not 0.0 < limit < _DEAD * centre:
        return  # too dim to tell a pixel that has lost half of its response
    if np.any(departed := judged & (np.abs(change - centre) > limit)):
        local = median_filter(np.where(judged, change, centre), size=5, mode="nearest")
        departed &= np.abs(change - local) > limit
        code[departed] = BAD_PIXEL_CODES["nonlinear"]
        code[departed & (change < _DEAD * local)] = BAD_PIXEL_CODES["dead"]


def _with_clusters(code: NDArray[np.uint8], closest: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Bad pixels with those that a cluster of them takes along: beside a bad one and at `_CLUSTER_SHARE` of a limit, or
    hemmed in by bad ones."""
    while True:
        neighbours = _bad_neighbours(code != 0)
        taken = (code == 0) & (((neighbours > 0) & (closest > _CLUSTER_SHARE)) | (neighbours >= _CLUSTER_NEIGHBOURS))
        if not np.any(taken):
            return code
        code = np.where(taken, np.uint8(BAD_PIXEL_CODES["clustered"]), code)


def _bad_neighbours(bad: NDArray[np.bool_]) -> NDArray[np.int64]:
    """How many of the eight pixels about each are bad (row, column)."""
    from scipy.ndimage import convolve

    around = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    return np.asarray(convolve(bad.astype(np.int64), around, mode="constant"))


def _robust_spread(values: NDArray[np.float64]) -> tuple[float, float]:
    centre = float(np.median(values))
    return centre, robust_sd(values, about=centre)


def cluster_evidence(bad: NDArray[np.uint8]) -> dict[str, int]:
    """Groups of two or more bad pixels that touch: how many, pixels in the largest, and kernel pixels.

    A kernel pixel is a bad one with fewer than five good neighbours, which interpolation cannot mend (ASTM E2597).
    """
    from scipy.ndimage import label

    numbered, _ = label(bad != 0, structure=np.ones((3, 3)))
    sizes = np.bincount(numbered.ravel())[1:]
    kernel = (bad != 0) & (_bad_neighbours(bad != 0) > 3)
    return {
        "groups": int(np.count_nonzero(sizes > 1)),
        "largest": int(sizes.max(initial=0)),
        "kernel_pixels": int(np.count_nonzero(kernel)),
    }

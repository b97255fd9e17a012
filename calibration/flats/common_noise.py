"""Noise that the pixels of a frame share: output from exposure to exposure, whole lines, a source that wanders.

The power fit takes such noise out, so that the gain is that of the quanta. A pixel shows it all the same:

v_i = g_b I_i + r^2 + c^2 I_i^2

v_i: variance of a pixel between successive frames of a series; g_b I + r^2: what the power fit makes of a beam b; c: relative rms
of what is shared. What the fit leaves open of g_b and r^2 is fitted along, with its standard deviations as prior.
"""

from collections.abc import Sequence

import numpy as np

from ...generator.line.twin import Estimate, estimate_from_sd
from ..frames.frame_sums import effective_frames
from .flat_levels import SeriesPoint
from .noise_of_flats import FlatNoise

_ROUNDS = 4  # of weights that follow the noise as it was fitted


def common_variance(points: Sequence[SeriesPoint], noise: FlatNoise) -> Estimate | None:
    """c^2 with its 95 % interval, relative to the squared signal; None where no series shows it.

    Where series scatter by more than their sampling noise, its standard deviation grows by as much (Birge, Phys. Rev. 40 (1932) 207).

    Args:
        points: levels and variances of the flats.
        noise: fit of the same flats.
    """
    fit, places = noise.fit, noise.place_in_fit
    sources = {
        item.name: source for (item, _), source in zip(noise.stacks, noise.of_stacks, strict=True) if source.in_fit
    }
    # of means of exposures, what they share is averaged as well, and rounding adds to their variance
    kept = [
        (point, sources[point.series])
        for point in points
        if point.used and point.averaged == 1 and point.frames > 2 and point.series in sources
    ]
    if not kept:
        return None
    beams = np.array([places[source.group] for _, source in kept])
    samples = np.array([source.power.samples for _, source in kept])
    signal = np.array([point.mean_signal_DN for point, _ in kept])
    shown = np.array([point.pair_variance_DN2 for point, _ in kept])
    frames = np.array([effective_frames(point.frames) for point, _ in kept])
    expected = fit.slope_DN[beams] * signal + fit.read_variance_DN2
    used = sorted(set(beams.tolist()))
    # of each beam's slope, of the read variance, and of what is shared
    design = np.zeros((len(kept), len(used) + 2))
    for column, beam in enumerate(used):
        design[beams == beam, column] = signal[beams == beam]
    design[:, -2], design[:, -1] = 1.0, signal**2
    prior = np.array(
        [*(1.0 / np.maximum(fit.slope_sd_DN[used], 1e-12) ** 2), 1.0 / max(fit.read_sd_DN2, 1e-12) ** 2, 0.0]
    )
    shared, covariance, left = 0.0, np.eye(len(prior)), np.zeros(len(kept))
    for _ in range(_ROUNDS):
        variance = 2.0 * expected**2 / samples + 2.0 * (shared * signal**2) ** 2 / frames
        scale = np.sqrt(np.diag(design.T @ (design / variance[:, None])) + prior) + 1e-300
        normal = (design.T @ (design / variance[:, None]) + np.diag(prior)) / np.outer(scale, scale)
        covariance = np.linalg.pinv(normal) / np.outer(scale, scale)
        found = covariance @ (design.T @ ((shown - expected) / variance))
        shared = max(float(found[-1]), 0.0)
        left = (shown - expected - design @ found) ** 2 / variance
    scatter = max(float(np.sum(left)) / max(len(kept) - 1, 1), 1.0)
    return estimate_from_sd(shared, float(np.sqrt(scatter * covariance[-1, -1])), lowest=0.0)

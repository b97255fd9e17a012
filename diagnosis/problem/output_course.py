"""What a tube's wandering output does by chance to series: their levels, and their course from frame to frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...generator.line.series_request import SeriesRequest
from ..arrays import FloatArray

_MOMENTS = 8  # of a series, that stand for its exposures against another's


@dataclass(frozen=True, slots=True)
class OutputCourse:
    """How a wandering output of unit variance moves: a share new in every exposure, the rest with exp(-|dt| / tau)."""

    correlation_s: float  # tau
    jitter_share: float  # 0 to 1
    idle_s: float = 0.0  # pause before each series whose pause is not stated

    def means(self, requests: Sequence[SeriesRequest], readout_ms: float | None) -> FloatArray:
        """A root (series, factor) of the covariance of the series' means."""
        middles = (np.arange(_MOMENTS) + 0.5) / _MOMENTS
        idle_s = self.idle_s * np.cumsum([not item.pause_stated for item in requests])
        times = np.array(
            [
                item.start_s + pause_s + middles * item.frames * item.exposures_per_frame * item.interval_s(readout_ms)
                for item, pause_s in zip(requests, idle_s, strict=True)
            ]
        ).ravel()
        alike = np.exp(-np.abs(times[:, None] - times[None, :]) / self.correlation_s)
        between = alike.reshape(len(requests), _MOMENTS, len(requests), _MOMENTS).mean(axis=(1, 3))
        between *= 1.0 - self.jitter_share
        for number, item in enumerate(requests):
            between[number, number] = float(self._frames(item, readout_ms).mean())
        values, vectors = np.linalg.eigh(between)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    def steps(self, request: SeriesRequest, readout_ms: float | None) -> float:
        """Standard deviation of steps from frame to frame over that of an output that is new in every frame."""
        step_s = request.interval_s(readout_ms) * request.exposures_per_frame
        return math.sqrt(1.0 - (1.0 - self.jitter_share) * math.exp(-step_s / self.correlation_s))

    def along(self, profile: FloatArray, request: SeriesRequest, readout_ms: float | None) -> float:
        """Standard deviation of the projection of a series' frames on a profile (frame,)."""
        return math.sqrt(max(float(profile @ self._frames(request, readout_ms) @ profile), 0.0))

    def _frames(self, request: SeriesRequest, readout_ms: float | None) -> FloatArray:
        """Covariance (frame, frame) of a series' stored frames."""
        step_s = request.interval_s(readout_ms) * request.exposures_per_frame
        number = np.arange(request.frames)
        lag_s = np.abs(number[:, None] - number[None, :]) * step_s
        jitter = self.jitter_share / request.exposures_per_frame * np.eye(request.frames)
        return np.asarray((1.0 - self.jitter_share) * np.exp(-lag_s / self.correlation_s) + jitter)


def rms_about_mean(levels: Sequence[float], courses: Sequence[FloatArray], noise: Sequence[float]) -> float:
    """Root mean square of all frames' relative output about its mean over them, noise taken off; 0 where noise is all.

    Of each series: level over what is expected, less 1; course (frame,), relative; variance of a frame's level that is no output.
    """
    frames = np.array([len(course) for course in courses], dtype=np.float64)
    middle = float(frames @ np.asarray(levels)) / float(frames.sum())
    squares = sum(
        len(course) * (level - middle) ** 2 + float(np.sum((course - course.mean()) ** 2)) - len(course) * variance
        for level, course, variance in zip(levels, courses, noise, strict=True)
    )
    return math.sqrt(max(squares, 0.0) / float(frames.sum()))

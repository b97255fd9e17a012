import math

import numpy as np
import pytest

from raytwin.acquisition.setting import setting_from_text
from raytwin.diagnosis.problem.output_course import OutputCourse, rms_about_mean
from raytwin.generator.line.series_request import SeriesRequest

READOUT_MS = 10.0


def series(start_s, frames=20, averaged=1):
    setting = setting_from_text(f"kV=60,power_w=20,exposure_ms=90,averaged={averaged}")
    return SeriesRequest(kind="flat", frames=frames, exposure_ms=90.0, setting=setting, start_s=start_s)


def drawn(course, requests, count, seed):
    """Frames (draw, series, frame) of a first-order process with white noise, exposure by exposure."""
    rng = np.random.default_rng(seed)
    result = []
    for request in requests:
        averaged = request.exposures_per_frame
        times = request.start_s + 0.1 * np.arange(request.frames * averaged)
        result.append(times)
    clock = np.concatenate(result)
    slow = np.exp(-np.abs(clock[:, None] - clock[None, :]) / course.correlation_s)
    root = np.linalg.cholesky(slow + 1e-9 * np.eye(len(clock)))
    value = math.sqrt(1 - course.jitter_share) * rng.standard_normal((count, len(clock))) @ root.T
    value += math.sqrt(course.jitter_share) * rng.standard_normal(value.shape)
    shape = (count, len(requests), requests[0].frames, requests[0].exposures_per_frame)
    return value.reshape(shape).mean(axis=-1)


@pytest.mark.parametrize(("correlation_s", "jitter_share"), [(10.0, 0.35), (0.5, 0.0), (10.0, 1.0)])
def test_series_means_and_courses_scatter_as_a_process_drawn_exposure_by_exposure(correlation_s, jitter_share):
    course = OutputCourse(correlation_s, jitter_share)
    requests = [series(0.0), series(2.5), series(40.0)]
    frames = drawn(course, requests, 20_000, seed=1)
    root = course.means(requests, READOUT_MS)
    found = np.cov(frames.mean(axis=2).T)
    # the covariance of 20 000 draws is known to 1 %
    np.testing.assert_allclose(root @ root.T, found, atol=0.02 * float(np.diag(found).max()), rtol=0.03)
    profile = np.linspace(-1.0, 1.0, 20)
    profile /= np.linalg.norm(profile)
    assert course.along(profile, requests[0], READOUT_MS) == pytest.approx(
        float(np.std(frames[:, 0] @ profile)), rel=0.03
    )


def split(output, frames):
    """Levels and courses of series that follow one another."""
    parts = np.split(output, np.cumsum(frames)[:-1])
    return [float(part.mean()) for part in parts], [1000.0 * (1.0 + part - part.mean()) / 1000.0 for part in parts]


def test_the_rms_of_an_output_is_that_of_its_frames_about_their_mean_whatever_its_periods():
    frames = np.array([30, 6, 30, 12, 3])
    clock = np.arange(frames.sum())
    for period in (3.0, 20.0, 400.0):
        output = 0.02 + 0.007 * np.sin(2.0 * np.pi * clock / period + 0.4)
        levels, courses = split(output, frames)
        assert rms_about_mean(levels, courses, [0.0] * 5) == pytest.approx(float(output.std()), rel=1e-9)


def test_noise_of_the_frames_is_no_output():
    rng = np.random.default_rng(5)
    frames = np.full(40, 50)
    output = 0.004 * rng.standard_normal(frames.sum())
    noisy = output + 0.01 * rng.standard_normal(frames.sum())
    levels, courses = split(noisy, frames)
    assert rms_about_mean(levels, courses, [1e-4] * 40) == pytest.approx(0.004, rel=0.15)
    assert rms_about_mean(levels, courses, [1e-3] * 40) == 0.0

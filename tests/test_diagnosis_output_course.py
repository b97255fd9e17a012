import math
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.acquisition.setting import setting_from_text
from raytwin.diagnosis.probes.probes import noise_name
from raytwin.diagnosis.probes.scalar_context import Areas
from raytwin.diagnosis.problem.nuisance_columns import brighter
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


def test_more_light_has_the_noise_of_more_quanta():
    """Against frames drawn at both levels: a bright and a dim half, electronics of one variance."""
    shape, gain, white, more = (40, 50), 2.0, 300.0, 0.3
    signal = np.where(np.arange(50) < 25, 1000.0, 60.0) * np.ones((40, 1))
    rng = np.random.default_rng(3)

    def variances(light):
        frames = gain * rng.poisson(light / gain, (2000, *shape)) + math.sqrt(white) * rng.standard_normal(
            (2000, *shape)
        )
        return [float(frames[:, :, half].var(axis=0).mean()) for half in (np.s_[:25], np.s_[25:])]

    dim, lit = variances(signal), variances((1.0 + more) * signal)
    labels = (np.arange(50) >= 25).astype(np.int64) * np.ones((40, 1), np.int64)
    scalars = [SimpleNamespace(name=noise_name(label), label=label, lag=None) for label in ("bright", "dim")]
    scalars.append(SimpleNamespace(name="frame_factor", label="", lag=None))
    series = SimpleNamespace(
        expected=SimpleNamespace(quantum_variance_DN2=gain * signal, white_variance_DN2=np.full((1, 1), white)),
        context=SimpleNamespace(areas=Areas.of(np.ones(shape, dtype=bool), labels, 2), label_names=("bright", "dim")),
    )
    probes = SimpleNamespace(
        series=series,
        of_maps=lambda images: np.pad(images.mean(axis=(1, 2))[:, None], ((0, 0), (0, 3))),
        of_scalars=lambda change: np.array([0.0, *(change(one) for one in scalars)]),
    )
    level, bright, faint, steps = 100.0 * more * brighter(probes, signal)
    assert level == pytest.approx(more * signal.mean())
    assert steps == 0.0
    # the variance itself grows in proportion
    for found, before, after in zip((bright, faint), dim, lit, strict=True):
        assert math.log1p(found) == pytest.approx(math.log(after / before), abs=0.01)
    assert bright > 2.0 * faint

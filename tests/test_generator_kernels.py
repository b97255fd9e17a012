"""Noisy frames: moments, covariances and distribution as theory has them at any level; bytes that depend on nothing else.

Bounds are four standard errors, from the sample's own influence values or from Bartlett's formula for correlated noise; a
family of checks shares one error rate.
"""

import math
import shutil
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from raytwin.errors import InputError
from raytwin.generator.kernels.kernels import draw_key, sample_frames
from raytwin.generator.kernels.projection import project_polychromatic
from raytwin.generator.spread.psf import noise_autocovariance, noise_kernel_1d

LEVELS = (0.1, 1.0, 5.0, 19.9, 20.1, 100.0, 1e3, 1e5)
STANDARD_ERRORS = 4.0
MILLION = (1, 1000, 1000)
TEN_MILLION = (10, 1000, 1000)
BACKENDS = ("cpu", "torch")


def constant(level, shape):
    return np.full(shape, level, dtype=np.float32)


def in_standard_errors(noise, *, variance, skewness):
    """Mean, variance and skewness of independent zero-mean noise, each off its theory in standard errors."""
    z = noise.astype(np.float64).ravel() / math.sqrt(variance)
    size = z.size
    square, cube = z**2, z**3
    g = float(cube.mean())
    influence = cube - 3 * z - g - 1.5 * g * (square - 1)  # of the skewness, mean and variance estimated beside it
    centred = z - z.mean()
    found = float((centred**3).mean() / (centred**2).mean() ** 1.5)
    return (
        float(z.mean() * math.sqrt(size)),
        float((square.mean() - 1.0) / (square.std() / math.sqrt(size))),
        float((found - skewness) / (influence.std() / math.sqrt(size))),
    )


def quantum_noise(level, shape, **settings):
    """Frames of quanta alone less their mean."""
    frames = sample_frames(constant(level, shape), quantised=False, **settings)
    return np.asarray(frames, dtype=np.float64) - np.float32(level)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("level", LEVELS)
def test_quanta_have_the_mean_variance_and_skewness_of_a_poisson_number(level, backend):
    shape = MILLION if backend == "cpu" else (1, 400, 500)
    gain = 1.3
    noise = quantum_noise(level, shape, gain_DN=gain, key=11, backend=backend, device="cpu")
    off = in_standard_errors(noise, variance=gain * level, skewness=math.sqrt(gain / level))
    assert np.max(np.abs(off)) < STANDARD_ERRORS, f"mean, variance, skewness off by {off} standard errors"


def check_poisson(level, shape, key, backend="cpu"):
    frames = sample_frames(constant(level, shape), gain_DN=1.0, key=key, quantised=False, backend=backend)
    count = np.rint(np.asarray(frames, dtype=np.float64)).astype(np.int64).ravel()
    size = count.size
    assert count.min() >= 0
    edges = np.arange(stats.poisson.ppf(20.0 / size, level), stats.poisson.isf(20.0 / size, level) + 1)
    expected = np.diff(np.concatenate([[0.0], stats.poisson.cdf(edges, level), [1.0]])) * size
    seen = np.bincount(np.searchsorted(edges, count, side="left"), minlength=len(expected))
    kept = expected > 5
    chi_square = float(np.sum((seen[kept] - expected[kept]) ** 2 / expected[kept]))
    return stats.chi2.sf(chi_square, kept.sum() - 1)


@pytest.mark.parametrize("level", [0.1, 1.0, 3.0, 10.0, 19.9, 20.1, 35.0, 100.0, 240.0, 2e3, 1e5])
def test_equal_quanta_follow_the_poisson_law(level):
    # 11 levels share an error rate of 1e-3
    assert check_poisson(level, MILLION, key=31) > 1e-3 / 11


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "backend"), [(1.0, "cpu"), (19.9, "cpu"), (20.1, "cpu"), (240.0, "cpu"), (20.1, "torch")]
)
def test_ten_million_equal_quanta_follow_the_poisson_law(level, backend):
    assert check_poisson(level, TEN_MILLION, key=41, backend=backend) > 1e-3 / 5


def bartlett(acf, lag, size, excess_kurtosis):
    """Standard error of the covariance at `lag` of a linear process with known mean, acf lag 0 in the centre."""
    reach = acf.shape[0] // 2

    def at(i, j):
        return acf[i + reach, j + reach] if abs(i) <= reach and abs(j) <= reach else 0.0

    lags = range(-reach, reach + 1)
    total = sum(at(i, j) ** 2 + at(i + lag[0], j + lag[1]) * at(i - lag[0], j - lag[1]) for i in lags for j in lags)
    return math.sqrt((total + excess_kurtosis * at(*lag) ** 2) / size)


def check_covariances(level, shape, backend, key):
    model, sigma = "aperture", 0.6
    noise = quantum_noise(level, shape, gain_DN=1.0, kernel_1d=noise_kernel_1d(model, sigma), key=key, backend=backend)
    acf = noise_autocovariance(model, sigma, 7)
    off = {}
    for lag in [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (1, -1), (3, 0), (0, 3), (8, 0), (0, 8)]:
        rows, columns = lag
        ahead = noise[:, rows:, columns:] if columns >= 0 else noise[:, rows:, :columns]
        behind = (
            noise[:, : shape[1] - rows, : shape[2] - columns]
            if columns >= 0
            else noise[:, : shape[1] - rows, -columns:]
        )
        found = float(np.mean(ahead * behind)) / level
        theory = acf[7 + rows, 7 + columns] if max(map(abs, lag)) <= 7 else 0.0
        off[lag] = (found - theory) / bartlett(acf, lag, ahead.size, 1.0 / level)
    assert max(map(abs, off.values())) < STANDARD_ERRORS, off


@pytest.mark.parametrize(("level", "backend"), [(0.3, "cpu"), (150.0, "cpu"), (1500.0, "torch")])
def test_neighbours_have_the_covariance_of_the_spread(level, backend):
    check_covariances(level, MILLION if backend == "cpu" else (1, 400, 500), backend, key=51)


def test_there_are_no_seams_where_threads_or_vectors_meet_and_none_at_the_borders():
    frames, rows, columns = 400, 40, 70
    sigma = 0.8
    kernel = noise_kernel_1d("aperture", sigma)
    noise = quantum_noise(200.0, (rows, columns), gain_DN=1.0, kernel_1d=kernel, frames=frames, key=71)
    acf = noise_autocovariance("aperture", sigma, 7) * 200.0
    variance, beside, below = acf[7, 7], acf[7, 8], acf[8, 7]
    of_rows = [(noise[:, r] ** 2).mean() / variance - 1 for r in range(rows)]
    of_columns = [(noise[:, :, c] ** 2).mean() / variance - 1 for c in range(columns)]
    pairs_down = [(noise[:, r] * noise[:, r + 1]).mean() / below - 1 for r in range(rows - 1)]
    pairs_along = [(noise[:, :, c] * noise[:, :, c + 1]).mean() / beside - 1 for c in range(columns - 1)]
    correlation = (acf / variance) ** 2
    # of a row's mean square: 2 sum of squared correlations along it; of a product the same and more by 1 / rho^2
    for values, size, along, over in (
        (of_rows, frames * columns, correlation[7].sum(), 1.0),
        (of_columns, frames * rows, correlation[:, 7].sum(), 1.0),
        (pairs_down, frames * columns, correlation[7].sum(), variance / below),
        (pairs_along, frames * rows, correlation[:, 7].sum(), variance / beside),
    ):
        assert np.max(np.abs(values)) < 4.5 * over * math.sqrt(2.0 * along / size)


def test_a_frame_has_the_same_bytes_however_the_stack_is_cut():
    rng = np.random.default_rng(0)
    signal = rng.uniform(0.0, 300.0, size=(5, 33, 47)).astype(np.float32)
    for backend in BACKENDS:
        settings = {
            "gain_DN": 1.5,
            "key": 2**63 + 9,
            "kernel_1d": noise_kernel_1d("aperture", 0.6),
            "read_noise_DN": 2.0,
            "white_fraction": 0.02,
            "dark_DN": 100.0,
            "backend": backend,
        }
        whole = np.asarray(sample_frames(signal, **settings))
        again = [np.asarray(sample_frames(signal[i : i + 2], first_frame=i, **settings)) for i in (0, 2, 4)]
        assert whole.tobytes() == np.concatenate(again).tobytes()
        single = np.asarray(sample_frames(signal[3], first_frame=3, **settings))
        assert whole[3].tobytes() == single.tobytes()
        assert not np.array_equal(whole[3], np.asarray(sample_frames(signal[3], first_frame=4, **settings)))


def test_a_frame_has_the_same_bytes_whatever_the_number_of_threads():
    code = (
        "import hashlib, numpy as np\n"
        "from raytwin.generator.kernels.kernels import sample_frames\n"
        "signal = np.linspace(0, 400, 60 * 75, dtype=np.float32).reshape(60, 75)\n"
        "frame = sample_frames(signal, gain_DN=1.2, key=7, kernel_1d=[.2, .6, .2], read_noise_DN=1)\n"
        "print(hashlib.sha256(frame.tobytes()).hexdigest())\n"
    )
    hashes = {
        subprocess.run(
            [sys.executable, "-c", code],
            check=True,
            capture_output=True,
            text=True,
            env={"NUMBA_NUM_THREADS": threads, "PATH": ""},
        ).stdout
        for threads in ("1", "2")
    }
    assert len(hashes) == 1


@pytest.mark.parametrize("backend", ["torch", pytest.param("torch_compiled", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore")  # of torch's compiler
def test_torch_draws_the_frames_of_the_compiled_loops_but_for_last_bits(backend):
    if backend == "torch_compiled" and shutil.which("g++") is None:
        pytest.skip("torch's compiler needs g++")
    rng = np.random.default_rng(1)
    signal = np.concatenate([rng.uniform(0, 30, (1, 60, 81)), rng.uniform(90, 2000, (1, 60, 81))])
    settings = {
        "gain_DN": 1.3,
        "key": 77,
        "gain_relative": rng.uniform(0.9, 1.1, (60, 81)),
        "kernel_1d": noise_kernel_1d("aperture", 0.6),
        "read_noise_DN": 1.5,
        "dark_DN": 50.0,
        "white_fraction": 0.02,
        "quantised": False,
    }
    compiled = sample_frames(signal, **settings)
    in_torch = sample_frames(signal, backend=backend, device="cpu", **settings).numpy()
    # where a last bit moves a count by one quantum, the spread takes it to some of its neighbours
    assert np.mean(np.abs(compiled - in_torch) > 2e-3) < 5e-3


def test_tensors_stay_where_they_are_from_thickness_to_frames():
    import torch

    thickness = torch.linspace(0.0, 20.0, 3 * 20 * 30).reshape(1, 3, 20, 30)
    mu, weights = np.array([[0.1, 0.05]]), np.array([[40.0, 60.0], [70.0, 120.0]])
    signal, variance = project_polychromatic(thickness, mu, weights, backend="torch", device="cpu")
    assert isinstance(signal, torch.Tensor)
    settings = {"key": 3, "read_noise_DN": 1.0, "dark_DN": np.full((20, 30), 10.0), "white_fraction": 0.01}
    frames = sample_frames(signal, gain_DN=variance / signal, backend="torch", device="cpu", **settings)
    again = sample_frames(
        signal.numpy(), gain_DN=(variance / signal).numpy(), backend="torch", device="cpu", **settings
    )
    assert torch.equal(frames, again)
    with pytest.raises(InputError, match="backend: got cpu for torch tensors; expected torch or torch_compiled"):
        sample_frames(signal, gain_DN=1.0, key=1)
    with pytest.raises(InputError, match="backend: got cpu for torch tensors"):
        project_polychromatic(thickness, mu, weights)
    with pytest.raises(InputError, match="signal_DN: got nan in 1 of 1 places"):
        sample_frames(torch.full((1, 1), math.nan), gain_DN=1.0, key=1, backend="torch", device="cpu")


def test_random_words_are_even_in_every_bit_and_independent_of_their_neighbours():
    # quanta of a mean of 1e6 are lattice normals: judge the words through the plain normals of the electronics
    normal = sample_frames(np.zeros((6, 512, 512)), gain_DN=1.0, read_noise_DN=1.0, quantised=False, key=3).astype(
        np.float64
    )
    size = normal.size
    uniform = stats.norm.cdf(normal).ravel()
    seen = np.bincount((uniform * 4096).astype(int), minlength=4096)
    assert stats.chi2.sf(float(np.sum((seen - size / 4096) ** 2) / (size / 4096)), 4095) > 1e-4
    others = {
        "next column": (normal[:, :, 1:], normal[:, :, :-1]),
        "half a row": (normal[:, :, 256:], normal[:, :, :256]),
        "next row": (normal[:, 1:], normal[:, :-1]),
        "next frame": (normal[1:], normal[:-1]),
    }
    other_key = sample_frames(np.zeros((6, 512, 512)), gain_DN=1.0, read_noise_DN=1.0, quantised=False, key=4)
    others["next key"] = (normal, other_key.astype(np.float64))
    for name, (one, two) in others.items():
        for power in (1, 2, 3):
            a, b = one**power, two**power
            correlation = np.corrcoef(a.ravel(), b.ravel())[0, 1]
            assert abs(correlation) < 4.5 / math.sqrt(a.size), (name, power)


def test_electronics_white_quanta_and_gain_enter_as_stated():
    size = (500, 800)
    signal, gain, white, relative, read = 400.0, 1.4, 0.05, 1.3, 3.0
    frame = sample_frames(
        constant(signal, size),
        gain_DN=gain,
        white_fraction=white,
        gain_relative=relative,
        read_noise_DN=read,
        dark_DN=100.0,
        quantised=False,
        key=8,
    ).astype(np.float64)
    variance = gain * signal * relative + read**2
    number = frame.size
    assert abs(frame.mean() - signal - 100.0) < STANDARD_ERRORS * math.sqrt(variance / number)
    assert abs(frame.var() / variance - 1.0) < STANDARD_ERRORS * math.sqrt(2.01 / number)


@pytest.mark.parametrize("averaged", [1, 4, 10])
def test_averaged_frames_have_the_noise_of_a_mean_of_rounded_frames(averaged):
    size, signal, gain, read = (500, 800), 90.3, 1.2, 0.9
    settings = {"gain_DN": gain, "read_noise_DN": read, "dark_DN": 20.0}
    frame = sample_frames(constant(signal, size), averaged=averaged, key=9, **settings).astype(np.float64)
    steps = frame * averaged
    assert np.allclose(steps, np.rint(steps), atol=1e-3)
    variance = (gain * signal + read**2 + 1.0 / 12.0) / averaged
    number = frame.size
    assert abs(frame.mean() - signal - 20.0) < STANDARD_ERRORS * math.sqrt(variance / number)
    assert abs(frame.var() / variance - 1.0) < STANDARD_ERRORS * math.sqrt(2.1 / number)


def test_readout_saturates_and_cuts_at_zero():
    for backend in BACKENDS:
        low = np.asarray(
            sample_frames(constant(0.0, (20, 30)), gain_DN=1.0, read_noise_DN=50.0, key=1, backend=backend)
        )
        high = np.asarray(
            sample_frames(constant(5000.0, (20, 30)), gain_DN=1.0, bits=12, key=1, frames=2, backend=backend)
        )
        assert low.min() == 0.0
        assert np.array_equal(low, np.rint(low))
        assert high.shape == (2, 20, 30)
        assert np.all(high == 4095.0)


def test_no_photons_no_electronics_nothing_but_the_dark():
    for signal in (0.0, -50.0):
        frame = sample_frames(constant(signal, (7, 9)), gain_DN=2.0, dark_DN=100.0, key=0, quantised=False)
        assert np.array_equal(frame, constant(100.0 + signal, (7, 9)))


def test_keys_come_from_the_callers_generator():
    assert draw_key(np.random.default_rng(3)) == draw_key(np.random.default_rng(3))
    assert draw_key(np.random.default_rng(3)) != draw_key(np.random.default_rng(4))


@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.sampled_from([0.0, 1e-6, 0.3, 7.0, 19.99, 20.0, 1e3, 1e9, 1e15]),
    st.sampled_from([np.float16, np.float32, np.float64, np.uint16, np.int64]),
    st.sampled_from([1e-12, 1e-3, 1.0, 50.0, 1e15]),
    st.sampled_from([None, 0.0, 0.3, 2.5]),
    st.sampled_from([None, 8, 16]),
    st.integers(0, 2**64 - 1),
    st.sampled_from(BACKENDS),
)
def test_any_shape_type_and_level_gives_finite_frames(rows, columns, level, dtype, gain, sigma, bits, key, backend):
    signal = np.full((rows, columns), min(level, float(np.finfo(np.float16).max) if dtype == np.float16 else 6e4))
    signal = (
        signal.astype(dtype)
        if np.dtype(dtype).kind != "f" or dtype == np.float16
        else np.full_like(signal, level, dtype)
    )
    frame = np.asarray(
        sample_frames(
            signal,
            gain_DN=gain,
            kernel_1d=None if sigma is None else noise_kernel_1d("aperture", sigma),
            read_noise_DN=1.0,
            white_fraction=0.01,
            bits=bits,
            key=key,
            backend=backend,
        )
    )
    assert frame.shape == (rows, columns)
    assert frame.dtype == np.float32
    assert np.all(np.isfinite(frame))
    assert np.all(frame >= 0)
    assert bits is None or np.all(frame <= 2**bits - 1)


@given(
    hnp.arrays(
        np.float32, hnp.array_shapes(min_dims=2, max_dims=3, min_side=0, max_side=9), elements=st.floats(width=32)
    ),
    st.floats() | st.sampled_from([1e-12, 1e-3, 1.0, 50.0, 1e15]),
    st.floats() | st.sampled_from([0.0, 1.0, 30.0]),
    st.sampled_from(BACKENDS),
)
def test_whatever_numbers_come_the_answer_is_frames_or_an_error_in_lab_words(signal, gain, read, backend):
    try:
        frames = sample_frames(signal, gain_DN=gain, read_noise_DN=read, bits=16, key=1, backend=backend)
    except InputError as error:
        assert "expected" in str(error)
        return
    frames = np.asarray(frames)
    assert frames.shape == signal.shape
    assert np.all((frames >= 0) & (frames <= 65535))


GOOD = {"signal_DN": np.ones((4, 5)), "gain_DN": 1.0, "key": 1}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"signal_DN": np.full((4, 5), np.nan)},
            r"signal_DN: got nan in 20 of 20 places; expected finite, -1e\+15 to 1e\+15 DN",
        ),
        ({"signal_DN": np.full((4, 5), np.inf)}, r"signal_DN: got inf in 20 of 20"),
        ({"signal_DN": np.ones(5)}, r"signal_DN: got shape \(5,\); expected \(row, column\) or"),
        ({"signal_DN": np.array([["a"]])}, r"signal_DN: got .*; expected numbers"),
        ({"gain_DN": 0.0}, r"gain_DN: got 0 in 1 of 1 places; expected finite, 1e-12 to 1e\+15 DN"),
        (
            {"gain_DN": np.ones((3, 5))},
            r"gain_DN: got shape \(3, 5\); expected one number, or a map that fits .*\(1, 4, 5\)",
        ),
        ({"gain_relative": -1.0}, r"gain_relative: got -1"),
        ({"read_noise_DN": np.nan}, r"read_noise_DN: got nan"),
        ({"dark_DN": np.inf}, r"dark_DN: got inf"),
        ({"white_fraction": -0.1}, r"white_fraction: got -0.1; expected 0 to 1e\+06 of the quantum variance"),
        ({"kernel_1d": [0.5, 0.5]}, r"kernel_1d: got shape \(2,\); expected \(2 R \+ 1,\) finite numbers"),
        ({"kernel_1d": [0.5, np.nan, 0.5]}, r"kernel_1d: got shape"),
        ({"bits": 40}, r"bits: got 40; expected 1 to 24 bits"),
        ({"averaged": 0}, r"averaged: got 0; expected a whole number from 1"),
        ({"averaged": 1.5}, r"averaged: got 1.5; expected a whole number"),
        ({"key": -1}, r"key: got -1; expected a whole number from 0"),
        ({"first_frame": -1}, r"first_frame: got -1"),
        ({"frames": -1}, r"frames: got -1"),
        ({"signal_DN": np.ones((3, 4, 5)), "frames": 2}, r"frames: got 2; expected 3, as many as there are signals"),
        ({"backend": "gpu"}, r"backend: got gpu; expected one of cpu, torch, torch_compiled"),
        ({"backend": "torch", "device": "nowhere"}, r"device: got nowhere; expected a device that torch has here"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_lab_words(wrong, message):
    with pytest.raises(InputError, match=message):
        sample_frames(**{**GOOD, **wrong})

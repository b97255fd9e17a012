"""Top-up: reference and drawn noise together have the target's mean, variance, skewness and covariance."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition import Setting, setting_from_text
from raytwin.errors import InputError
from raytwin.generator.references.topup import apply_top_up, plan_top_up
from raytwin.generator.spread.noise import sample_frame_noise
from raytwin.generator.spread.psf import Spread, noise_autocovariance, noise_coupling, noise_kernel_1d

SIGMA, WHITE, GAIN, READ = 0.55, 0.01, 9.0, 80.0
OPTICS = {"white_fraction": WHITE, "spread": Spread(sigma_px=SIGMA)}
SHAPE = (40, 40)


def setting(exposure_ms, averaged=1, **changes):
    return Setting(**{"kV": 40.0, "power_W": 40.0, "exposure_ms": exposure_ms, "averaged": averaged, **changes})


def averaged_noise(signal, averaged, rng, read=READ):
    """Noise of the mean of several frames, drawn at once."""
    return sample_frame_noise(
        signal,
        gain_DN=GAIN,
        read_variance_DN2=read,
        rng=rng,
        quantum_share=1 / averaged,
        third_cumulant_share=1 / averaged**2,
        read_share=1 / averaged,
        **OPTICS,
    )


def topped_up(reference, target, *, count, target_signal=150.0, seed=1, read=READ):
    """Frames above dark at `target` from as many independent references."""
    rng = np.random.default_rng(seed)
    plan = plan_top_up(reference=reference, target=target)
    reference_signal = np.full(SHAPE, target_signal / plan.scale)
    frames = []
    for _ in range(count):
        transmission = (
            reference_signal + averaged_noise(reference_signal, reference.averaged, rng, read)
        ) / reference_signal
        frames.append(
            apply_top_up(
                transmission,
                plan,
                open_signal_DN=np.full(SHAPE, target_signal),
                gain_DN=GAIN,
                gain_relative=1.0,
                read_variance_DN2=read,
                dark_DN=np.full(SHAPE, 1000.0),
                bits=16,
                quantised=False,
                rng=rng,
                **OPTICS,
            )
            - 1000.0
        )
    return np.array(frames, dtype=np.float64)


CASES = {
    "100 ms from ten of 100 ms": (setting(100, 10), setting(100)),
    "20 ms from ten of 100 ms": (setting(100, 10), setting(20)),
    "50 ms from one of 1 s": (setting(1000), setting(50)),
    "three of 100 ms from ten of 100 ms": (setting(100, 10), setting(100, 3)),
    "500 ms from one of 1 s": (setting(1000), setting(500)),
}


@pytest.mark.parametrize("case", CASES)
def test_reference_and_top_up_have_the_moments_of_a_target_frame(case):
    reference, target = CASES[case]
    count, signal = 150, 150.0
    frames = topped_up(reference, target, count=count, target_signal=signal)
    n = frames.size
    averaged = target.averaged
    quantum = GAIN * signal / averaged
    rho = noise_autocovariance("aperture", SIGMA, 2)[2:, 2:]
    correlated = float(np.sum(noise_autocovariance("aperture", SIGMA, 6) ** 2) / rho[0, 0] ** 2)
    variance = quantum * (rho[0, 0] + WHITE) / (1 + WHITE) + READ / averaged
    centred = frames - signal
    assert frames.mean() == pytest.approx(signal, abs=5 * math.sqrt(quantum / n))
    assert centred.var() == pytest.approx(variance, rel=4.5 * math.sqrt(2 * correlated / n))
    for dy, dx in ((0, 1), (1, 0), (1, 1)):
        products = centred[:, : SHAPE[0] - dy, : SHAPE[1] - dx] * centred[:, dy:, dx:]
        assert products.mean() == pytest.approx(
            quantum * rho[dy, dx] / (1 + WHITE), abs=4.5 * variance * math.sqrt(2 * correlated / n)
        )
    kernel = noise_kernel_1d("aperture", SIGMA)
    third = GAIN**2 * signal / averaged**2 * float(np.sum(kernel**3)) ** 2
    own = float(np.mean(centred**3)) - 3 * float(centred.mean()) * variance
    assert own == pytest.approx(third, abs=5 * variance**1.5 * math.sqrt(15 * correlated / n))


def test_noise_that_follows_a_noisy_reference_does_not_skew_the_sum():
    """Half the quanta are in the reference: without care the third moment would be 1 + 3/4 sum(h^2 rho) / sum(h^3)."""
    signal = 60.0
    frames = topped_up(setting(1000), setting(500), count=400, target_signal=signal, read=2.0) - signal
    kernel = noise_kernel_1d("aperture", SIGMA)
    third = GAIN**2 * signal * float(np.sum(kernel**3)) ** 2
    allowed = 5 * frames.var() ** 1.5 * math.sqrt(15 * 2 / frames.size)
    careless = third * 0.75 * noise_coupling("aperture", SIGMA)
    assert allowed < 0.7 * careless
    assert float(np.mean(frames**3)) - 3 * frames.mean() * frames.var() == pytest.approx(third, abs=allowed)


def test_n_frames_of_t_are_not_one_frame_of_n_t():
    """Quanta are the same in number, electronic noise is not: ten read-outs against one."""
    reference = setting(1000, 10)
    many = plan_top_up(reference=reference, target=setting(10, 10))
    one = plan_top_up(reference=reference, target=setting(100, 1))
    # in DN^2 of the sum over frames: averages times ten
    read_many = many.read * 10**2 + many.scale**2 * 10**2 / 10
    read_one = one.read + one.scale**2 / 10
    assert read_many == pytest.approx(10.0)
    assert read_one == pytest.approx(1.0)
    quanta_many = (many.quantum + many.held) * 10
    quanta_one = one.quantum + one.held
    assert quanta_many == pytest.approx(quanta_one * 1.0, rel=1e-9)


loads = st.floats(1.0, 1000.0)
numbers = st.integers(1, 30)


@given(loads, numbers, loads, numbers)
def test_shares_drawn_and_held_add_up_to_the_target(reference_ms, reference_frames, target_ms, target_frames):
    reference, target = setting(reference_ms, reference_frames), setting(target_ms, target_frames)
    used = target_ms * target_frames / (reference_ms * reference_frames)
    if used > 1:
        with pytest.raises(InputError, match="too noisy"):
            plan_top_up(reference=reference, target=target)
    elif used < 0.999:
        plan = plan_top_up(reference=reference, target=target)
        assert plan.quantum > 0
        assert plan.quantum + plan.held == pytest.approx(1 / target_frames)
        assert plan.read + plan.scale**2 / reference_frames == pytest.approx(1 / target_frames)


@pytest.mark.parametrize(
    ("reference", "target", "message"),
    [
        ("kv=40,power_w=40,exposure_ms=100", "kv=40,power_w=40,exposure_ms=200", "too noisy for this target"),
        ("kv=40,power_w=40,exposure_ms=100", "kv=90,power_w=40,exposure_ms=50", "kV and filter of the reference"),
        ("kv=40,power_w=40,exposure_ms=100,filter=Cu:0.1", "kv=40,power_w=40,exposure_ms=50", "kV and filter"),
        (
            "kv=40,power_w=40,exposure_ms=100,filter=Cu:0.1+Cu:0.1",
            "kv=40,power_w=40,exposure_ms=50,filter=Cu:0.1",
            "kV and filter",
        ),
        ("kv=40,exposure_ms=100", "kv=40,power_w=40,exposure_ms=50", "power_w or current_ma in both"),
        (
            "kv=40,power_w=40,exposure_ms=100,source_detector_mm=500",
            "kv=40,power_w=40,exposure_ms=50,source_detector_mm=600",
            "another magnification",
        ),
    ],
)
def test_a_target_that_the_reference_cannot_reach_is_refused(reference, target, message):
    with pytest.raises(InputError, match=message):
        plan_top_up(reference=setting_from_text(reference), target=setting_from_text(target))


def test_the_order_of_layers_does_not_matter():
    first = setting_from_text("kv=40,power_w=40,exposure_ms=100,filter=Cu:0.1+Al:1")
    second = setting_from_text("kv=40,power_w=40,exposure_ms=50,filter=Al:1+Cu:0.1")
    assert plan_top_up(reference=first, target=second).quantum == pytest.approx(0.5)

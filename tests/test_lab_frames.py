"""Frames of the lab against closed forms of their mean, variance and covariance; bounds come from the sample size."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition.setting import Setting, filters_from_text
from raytwin.errors import InputError
from raytwin.lab import Bench, LabSystem, Slab, aperture_share, compute_incidence, detector_maps
from raytwin.lab.chain import BASE_STAGES, Stage, spread_taps
from raytwin.lab.objects import fine_grid_mm
from raytwin.lab.response import level_of_groups
from raytwin.lab.truth import compute_truth, flat_truth

COPPER = filters_from_text("Cu:0.05")
# All pixels alike, so that a statistic over pixels is one over repetitions.
UNIFORM = LabSystem(rows=48, columns=64, gain_spread_percent=0.0, dark_spread_DN=0.0, dead_pixels=0, hot_pixels=0)


def setting(kV=40.0, power_W=40.0, exposure_ms=20.0, averaged=1):
    return Setting(kV=kV, power_W=power_W, exposure_ms=exposure_ms, filters=COPPER, averaged=averaged)


def frames_of(system, wanted, count, *, seed=1, scene=None):
    bench = Bench(system, rng=np.random.default_rng(seed))
    return np.array([frame for frame, _ in bench.expose(wanted, frames=count, scene=scene)], dtype=np.float64)


def covariance(frames, row, column):
    """Temporal covariance of pixels (row, column) apart, mean over pixels and frames."""
    left = frames - frames.mean(axis=0)
    n, rows, columns = left.shape
    return (left[:, : rows - row, : columns - column] * left[:, row:, column:]).mean() * n / (n - 1)


@pytest.mark.parametrize("sigma", [0.0, 0.35, 1.0])
@pytest.mark.parametrize(("kV", "power_W"), [(40.0, 1.0), (40.0, 40.0), (90.0, 45.0)])
def test_a_flat_has_the_mean_variance_and_covariances_of_the_closed_form(sigma, kV, power_W):
    system = replace(UNIFORM, psf_sigma_px=sigma)
    wanted, count = setting(kV, power_W), 24
    frames = frames_of(system, wanted, count)
    truth = flat_truth(system, detector_maps(system), wanted)
    dark_DN = system.dark_DN + system.dark_current_DN_per_ms * wanted.exposure_ms
    independent = frames.size * max(aperture_share(sigma) ** 2, 0.05)  # blur makes neighbours tell the same
    assert abs(frames.mean() - dark_DN - truth["mean_DN"]) < 5 * truth["sd_DN"] / np.sqrt(independent)
    white = truth["sd_DN"] ** 2 - truth["photon_transfer_slope_DN"] * truth["mean_DN"]
    secondary = system.DN_per_electron
    quantum = (truth["gain_DN"] - secondary) * truth["mean_DN"]
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 1)):
        expected = quantum * aperture_share(sigma, row) * aperture_share(sigma, column)
        if (row, column) == (0, 0):
            expected += secondary * truth["mean_DN"] + white
        # Standard error of a covariance is the variance over root n; compound noise and blur widen it.
        bound = 6 * truth["sd_DN"] ** 2 / np.sqrt(independent)
        assert abs(covariance(frames, row, column) - expected) < bound, (row, column)


def test_a_dark_has_offset_dark_current_and_read_noise():
    system = replace(UNIFORM, dark_current_DN_per_ms=0.5)
    bench = Bench(system, rng=np.random.default_rng(3))
    frames = np.array([frame for frame, _ in bench.dark(100.0, frames=20)], dtype=np.float64)
    variance = system.read_noise_DN**2 + 1 / 12 + system.DN_per_electron * 50.0
    assert abs(frames.mean() - system.dark_DN - 50.0) < 5 * np.sqrt(variance / frames.size)
    assert frames.var(ddof=1) / variance == pytest.approx(1, abs=5 * np.sqrt(2 / frames.size))


def test_a_slab_transmits_what_the_sum_over_energies_says():
    system = UNIFORM
    slab = Slab(layers_mm={"chicken_breast": 18.0, "rib_bone": 1.5})
    wanted = setting(40.0, 40.0, 100.0)
    frames = frames_of(system, wanted, 10, scene=slab)
    level = level_of_groups(
        compute_incidence(system, kV=40.0, filters=COPPER, materials=slab.materials), thickness_mm=slab.layers_mm
    )
    expected = level.energy_keV_per_mAs * wanted.tube_load_mAs * system.electrons_per_keV * system.DN_per_electron
    signal = frames.mean() - system.dark_DN - 100.0 * system.dark_current_DN_per_ms
    assert abs(signal - expected) < 5 * frames.std() / np.sqrt(frames.size * aperture_share(system.psf_sigma_px) ** 2)


class HalfPixelEdge:
    """Material that covers a third of every pixel of one column, and all columns beyond."""

    materials = ("rib_bone",)

    def __init__(self, system, column):
        _, x_mm = fine_grid_mm(system)
        step = x_mm[0, 1] - x_mm[0, 0]
        margin = (x_mm.size - 3 * system.columns) // 2
        self.from_mm = x_mm[0, margin + 3 * column + 2] - step / 2

    def thickness_mm(self, y_mm, x_mm):
        return {"rib_bone": np.where(x_mm > self.from_mm, 6.0, 0.0) + 0.0 * y_mm}


def test_an_edge_inside_a_pixel_averages_transmission_not_thickness():
    system = replace(UNIFORM, psf_sigma_px=0.0, read_noise_DN=1.0)
    wanted = setting(40.0, 40.0, 100.0, averaged=50)
    frame = frames_of(system, wanted, 1, scene=HalfPixelEdge(system, 30))[0]
    signal = frame.mean(axis=0) - system.dark_DN - 100.0 * system.dark_current_DN_per_ms
    expected = (2 * signal[:30].mean() + signal[31:].mean()) / 3
    wrong = signal[:30].mean() ** (2 / 3) * signal[31:].mean() ** (1 / 3)
    error = np.sqrt(8.0 * signal[30] / 50 / system.rows)
    assert abs(signal[30] - expected) < 5 * error
    assert abs(signal[30] - wrong) > 20 * error


def test_an_average_drawn_at_once_is_an_average_of_frames():
    system = replace(UNIFORM, read_noise_DN=3.0)
    singles = frames_of(system, setting(), 240).reshape(60, 4, 48, 64).mean(axis=1)
    averages = frames_of(system, setting(averaged=4), 60, seed=2)
    assert np.allclose(averages * 4, np.rint(averages * 4))
    spread = singles.std(axis=0, ddof=1).mean()
    independent = singles.size * aperture_share(system.psf_sigma_px) ** 2
    assert abs(singles.mean() - averages.mean()) < 5 * spread * np.sqrt(2 / independent)
    for lag in ((0, 0), (0, 1)):
        assert covariance(singles, *lag) / spread**2 == pytest.approx(
            covariance(averages, *lag) / spread**2, abs=6 * np.sqrt(2 / independent)
        )


def test_a_chain_that_remembers_is_averaged_frame_by_frame():
    seen = []

    def note(electrons, context):
        seen.append(context.summed)
        return electrons

    stages = (*BASE_STAGES[:3], Stage(name="note", apply=note, additive=False), *BASE_STAGES[3:])
    bench = Bench(UNIFORM, rng=np.random.default_rng(0), stages=stages)
    frame, _ = next(bench.expose(setting(averaged=5), frames=1))
    assert seen == [1] * 5
    assert frame.dtype == np.float32


@pytest.mark.parametrize("averaged", [1, 4])
def test_the_adc_stops_at_its_highest_number(averaged):
    system = replace(UNIFORM, bits=12)
    frames = frames_of(system, setting(90.0, 45.0, 100.0, averaged), 1)
    assert frames.max() == system.saturation_DN == 4095
    # A level just under the limit is cut in single frames: their mean lies below the limit, not at it.
    near = frames_of(system, setting(90.0, 45.0, 16.5, averaged), 1)
    assert near.max() <= 4095
    if averaged > 1:
        assert near.mean() < 4095 - 1


def test_dead_pixels_see_no_light_and_hot_ones_glow():
    system = replace(UNIFORM, dead_pixels=4, hot_pixels=4)
    bright = frames_of(system, setting(90.0, 45.0), 8).mean(axis=0)
    bench = Bench(system, rng=np.random.default_rng(4))
    dark = np.array([frame for frame, _ in bench.dark(100.0, frames=8)], dtype=float).mean(axis=0)
    kinds = [kind for *_, kind in detector_maps(system).bad_pixels]
    assert kinds.count("dead") == kinds.count("hot") == 4
    for row, column, kind in detector_maps(system).bad_pixels:
        if kind == "dead":
            assert abs(bright[row, column] - system.dark_DN) < 30
        else:
            assert dark[row, column] > system.dark_DN + 50


def test_time_runs_and_frames_differ():
    bench = Bench(UNIFORM, rng=np.random.default_rng(0))
    (first, at_first), (second, at_second) = bench.expose(setting(), frames=2)
    assert at_second - at_first == pytest.approx(0.022)
    assert not np.array_equal(first, second)


def test_a_shorter_distance_brings_more_photons():
    near = Setting(kV=40.0, power_W=40.0, exposure_ms=20.0, filters=COPPER, source_detector_mm=3177.0 / 2)
    far = setting()
    bench = Bench(UNIFORM, rng=np.random.default_rng(0))
    assert bench.arrivals(near).load_mAs == pytest.approx(4 * bench.arrivals(far).load_mAs)
    maps = detector_maps(UNIFORM)
    assert flat_truth(UNIFORM, maps, near)["mean_DN"] == pytest.approx(4 * flat_truth(UNIFORM, maps, far)["mean_DN"])


def test_a_setting_without_load_is_refused():
    bench = Bench(UNIFORM, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="a tube current or power; add power_w"):
        next(bench.expose(Setting(kV=40.0, exposure_ms=20.0), frames=1))


@pytest.mark.parametrize("sigma", [0.0, 0.42, 1.3])
def test_every_sub_pixel_gives_all_its_light(sigma):
    assert spread_taps(sigma).reshape(-1, 3).sum(axis=0) == pytest.approx(np.ones(3), abs=1e-6)


def test_truth_holds_what_a_calibration_must_find():
    truth = compute_truth(LabSystem(), settings=[setting(), setting(90.0, 45.0)], exposures_ms=[20.0, 100.0])
    low, high = truth["levels"]
    # The gain at 90 kV is about 1.7 times that at 40 kV: <E^2>/<E> grows.
    assert 1.5 < high["gain_DN"] / low["gain_DN"] < 1.8
    assert low["photon_transfer_slope_DN"] < low["gain_DN"]
    assert truth["inherent_filtration_mm_Al"] == pytest.approx(1.0)
    assert truth["dark_DN_at"][1]["dark_DN"] - truth["dark_DN_at"][0]["dark_DN"] == pytest.approx(4.0, abs=0.01)
    assert 0.8 < low["swank"] < 0.95


_HASH = """
import hashlib, sys
import numpy as np
from raytwin.acquisition.setting import Setting, filters_from_text
from raytwin.lab import Bench, LabSystem, Slab
bench = Bench(LabSystem(rows=33, columns=40), rng=np.random.default_rng(5))
wanted = Setting(kV=40.0, power_W=40.0, exposure_ms=20.0, filters=filters_from_text("Cu:0.05"))
taken = [frame for frame, _ in bench.expose(wanted, frames=2, scene=Slab(layers_mm={"water": 5.0}))]
taken += [frame for frame, _ in bench.dark(20.0, frames=1)]
print(hashlib.sha256(np.array(taken).tobytes()).hexdigest())
"""


def test_the_same_seed_gives_the_same_bytes_on_one_thread_and_on_two():
    hashes = set()
    for threads in ("1", "2"):
        environment = {**os.environ, "NUMBA_NUM_THREADS": threads}
        done = subprocess.run(
            [sys.executable, "-c", _HASH], env=environment, capture_output=True, text=True, check=True, timeout=120
        )
        hashes.add(done.stdout.strip())
    assert len(hashes) == 1 and len(hashes.pop()) == 64


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "kV", "power_W"), [(0.35, 40.0, 40.0), (0.7, 90.0, 45.0)])
def test_many_frames_have_the_moments_of_the_closed_form_within_half_a_per_cent(sigma, kV, power_W):
    system = replace(UNIFORM, rows=128, columns=160, psf_sigma_px=sigma)
    wanted, count = setting(kV, power_W), 150
    frames = frames_of(system, wanted, count)
    truth = flat_truth(system, detector_maps(system), wanted)
    dark_DN = system.dark_DN + system.dark_current_DN_per_ms * wanted.exposure_ms
    assert frames.mean() - dark_DN == pytest.approx(truth["mean_DN"], rel=5e-4)
    secondary = system.DN_per_electron * truth["mean_DN"]
    quantum = truth["gain_DN"] * truth["mean_DN"] - secondary
    white = system.read_noise_DN**2 + 1 / 12 + secondary
    variance = covariance(frames, 0, 0)
    assert variance == pytest.approx(quantum * aperture_share(sigma) ** 2 + white, rel=5e-3)
    for row, column in ((0, 1), (1, 0), (1, 1)):
        expected = quantum * aperture_share(sigma, row) * aperture_share(sigma, column)
        assert abs(covariance(frames, row, column) - expected) < 5e-3 * variance

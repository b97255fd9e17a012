"""What every line of the lab does a little has the size that it states, and families change what they say and no more."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from raytwin.acquisition.acquisition_io import open_acquisition
from raytwin.acquisition.setting import Filter, Setting
from raytwin.errors import InputError
from raytwin.lab import FAMILIES, LabSystem, Unkindness, compute_level, sample_system, sample_unkindness
from raytwin.lab.bench import Bench
from raytwin.lab.chain import tail_kernel
from raytwin.lab.light import relative_yield
from raytwin.lab.protocols import run_protocol
from raytwin.lab.response import compute_deposits, equivalent_sigma_px, noise_shares
from raytwin.lab.system import detector_maps
from raytwin.lab.tube import MODELS, beam
from raytwin.lab.unkindness import NONE, SessionCourse, one_over_f

COPPER = (Filter(material="Cu", thickness_mm=0.05),)
QUIET = LabSystem(
    rows=64, columns=96, gain_spread_percent=0.0, dark_spread_DN=0.0, dead_pixels=0, hot_pixels=0, psf_sigma_px=0.5
)


def course_with(key=5, **sizes):
    return SessionCourse(Unkindness(**sizes), (48, 64), key, 40)


def test_shape_and_level_of_series_have_the_sizes_that_are_stated():
    shapes, levels = [], []
    for key in range(30):
        course = course_with(key, shape_percent=0.03, level_percent=0.1)
        shapes += [course.shading(series) - 1.0 for series in range(0, 40, 5)]
        levels += [course.level(series) - 1.0 for series in range(40)]
    rms = math.sqrt(float(np.mean(np.square(shapes))))
    # six parts of random phase in each of thirty sessions
    assert rms == pytest.approx(3e-4, rel=0.15)
    assert abs(float(np.mean(shapes))) < 1e-5
    # a normal number cut at 1.5 standard deviations has a spread of 0.83 of them
    assert np.std(levels) == pytest.approx(1e-3 * 0.83, rel=0.07)
    assert np.abs(levels).max() < 1.5e-3 + 1e-9


def test_drift_has_equal_power_in_every_octave():
    times_s = np.arange(0.0, 3600.0, 1.0)
    power = np.zeros((4,))
    for seed in range(40):
        course = one_over_f(np.random.default_rng(seed), rms=1.0)
        values = np.array([course(float(time_s)) for time_s in times_s])
        spectrum = np.abs(np.fft.rfft(values * np.hanning(values.size))) ** 2
        # octaves of the period from 512 s to 32 s; what is faster than a second is folded into still shorter ones
        edges = [math.ceil(3600.0 / period) for period in (512, 256, 128, 64, 32)]
        power += [float(spectrum[low:high].sum()) for low, high in pairwise(edges)]
    assert np.all(np.abs(power / power.mean() - 1.0) < 0.5)


def test_dark_wanders_within_its_limit_and_the_same_key_gives_the_same_course():
    course = course_with(dark_DN=0.5)
    values = [course.dark_DN(60.0 * minute) for minute in range(60)]
    assert max(map(abs, values)) <= 0.5 and np.std(values) > 0.02
    assert values == [course_with(dark_DN=0.5).dark_DN(60.0 * minute) for minute in range(60)]


def test_lines_of_a_dark_have_the_noise_that_is_stated():
    system = replace(QUIET, unkindness=Unkindness(row_noise_sigma=0.2, column_noise_sigma=0.1))
    bench = Bench(system, rng=np.random.default_rng(3))
    frames = np.array([frame for frame, _ in bench.dark(20.0, frames=150)], dtype=float)
    left = frames - frames.mean(axis=0)
    of_pixels = float(left.var())
    for axis, other, sigma in ((2, 1, 0.2), (1, 2, 0.1)):
        count = frames.shape[axis]
        excess = float(left.mean(axis=axis).var()) - of_pixels / count
        lines = 150 * frames.shape[other]
        wanted = (sigma * system.read_noise_DN) ** 2
        assert abs(excess - wanted) < 5 * (wanted + of_pixels / count) * math.sqrt(2 / lines) + 0.05 * wanted


def test_dust_moves_once_and_pixels_turn_bad_once():
    course = course_with(dust_specks=4, dust_percent=1.0)
    moved = course.change.dust_series
    assert 0 < moved < 40
    before, after = course.shading(moved - 1).copy(), course.shading(moved).copy()
    assert np.array_equal(before, course.shading(0)) and not np.array_equal(before, after)
    assert 0.99 <= before.min() < 0.998 and before.max() == 1.0
    assert 4 <= int((before < 1.0).sum()) <= 4 * 30
    worn = course_with(key=2, new_bad_share=1e-3)
    bad = worn.change.new_bad
    assert 1 <= len(bad) <= 2
    assert worn.turned_bad(worn.change.bad_series) == bad and worn.turned_bad(worn.change.bad_series - 1) == ()


def test_unkindness_can_be_switched_off_and_the_truth_tells(tmp_path):
    taken = []
    for name, unkindness in (("a", NONE), ("b", None)):
        path = tmp_path / f"{name}.h5"
        system = replace(QUIET, rows=24, columns=24, unkindness=Unkindness(level_percent=0.1, row_noise_sigma=0.1))
        truth = run_protocol(path, protocol="calibration", seed=4, system=system, frames=2, unkindness=unkindness)
        with open_acquisition(path) as session:
            taken.append(np.concatenate([series.read_frames() for series in session.series]))
        assert (truth["unkindness"] is None) == (unkindness is NONE)
    assert taken[0].shape == taken[1].shape and not np.array_equal(*taken)


@pytest.mark.parametrize("law", ["exponential", "lorentzian"])
def test_tails_and_two_widths_leave_the_covariances_of_the_closed_form(law):
    system = replace(QUIET, psf_aspect=1.3, tail_share=0.15, tail_length_px=1.2, tail_law=law, read_noise_DN=1.0)
    setting = Setting(kV=40.0, power_W=40.0, exposure_ms=100.0, filters=COPPER)
    bench = Bench(system, rng=np.random.default_rng(1))
    frames = np.array([frame for frame, _ in bench.expose(setting, frames=80)], dtype=float)
    left = (frames - frames.mean(axis=0))[:, 12:-12, 12:-12]
    scale = 80 / 79
    variance = float((left * left).mean()) * scale
    level = float(frames.mean()) - system.dark_DN - 5.0
    white = level * system.DN_per_electron + 1.0 + 1.0 / 12.0
    quantum = variance - white
    for row, column in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0)):
        product = left[:, : left.shape[1] - row, : left.shape[2] - column] * left[:, row:, column:]
        wanted = noise_shares(system, row, column) / noise_shares(system)
        assert float(product.mean()) * scale / quantum == pytest.approx(wanted, abs=6.0 / math.sqrt(left.size))
    assert noise_shares(system, 1, 0) > noise_shares(system, 0, 1)
    assert tail_kernel(law, 1.2).sum() == pytest.approx(1.0)
    # a plain Gaussian is equivalent to itself
    assert equivalent_sigma_px(QUIET) == pytest.approx(0.5, abs=1e-6)


def test_layers_of_a_screen_absorb_what_the_whole_screen_does():
    energy_keV = np.array([20.0, 33.0, 40.0, 60.0])

    def absorbed(**more):
        found = compute_deposits(energy_keV, scintillator_mm=0.4, **more)
        total = np.bincount(found.energy_index, found.probability, 4)
        return total, np.bincount(found.energy_index, found.probability * found.deposit_keV, 4) / total

    plain, mean_keV = absorbed()
    deep, deep_keV = absorbed(depth_light=0.5)
    assert deep == pytest.approx(plain, rel=1e-6)
    # low energies stop near the entrance, where there is less light
    assert np.all(np.diff(deep_keV / mean_keV)[[0, 2]] > 0)
    _, without = absorbed(k_escape_share=0.0)
    assert without == pytest.approx(energy_keV) and np.all(mean_keV[2:] < 0.95 * energy_keV[2:])
    _, curved = absorbed(light_curve=1.0, k_escape_share=0.0)
    assert curved / energy_keV == pytest.approx(relative_yield("CsI", energy_keV, of_photon=True))


def test_light_dips_behind_the_k_edge_for_photons_alone():
    for scintillator, edge_keV in (("CsI", 34.5), ("Gd2O2S@7.32", 50.24)):
        below, above = edge_keV - 0.1, edge_keV + 0.1
        of_photons = relative_yield(scintillator, np.array([below, above]), of_photon=True)
        of_electrons = relative_yield(scintillator, np.array([below, above]), of_photon=False)
        assert of_photons[0] - of_photons[1] > 0.015 and abs(of_electrons[0] - of_electrons[1]) < 1e-3
        assert relative_yield(scintillator, np.array([60.0]), of_photon=False) == pytest.approx([1.0])


@pytest.mark.slow
def test_tube_models_ripple_and_roughness_change_the_beam_as_they_should():
    def mean_keV(**more):
        light = beam(kV=60.0, anode_angle_deg=12.0, filters=COPPER, **more)
        photons = light.photons_per_mAs_mm2
        return float(photons @ light.energy_keV / photons.sum()), float(photons.sum())

    plain = mean_keV()
    assert set(MODELS) > {"kqp", "diff"} and abs(mean_keV(model="diff")[0] - plain[0]) > 0.05
    softer = mean_keV(ripple_percent=10.0)
    assert softer[0] < plain[0] and softer[1] < plain[1]
    with pytest.raises(InputError, match="tube model of the virtual lab: got 'lore'; expected one of kqp"):
        beam(kV=60.0, anode_angle_deg=12.0, model="lore")
    usual = compute_level(QUIET, kV=60.0, filters=COPPER).energy_keV_per_mAs
    steep = replace(QUIET, output_exponent=0.1)
    assert compute_level(steep, kV=60.0, filters=COPPER).energy_keV_per_mAs == pytest.approx(usual)
    assert compute_level(replace(QUIET, anode_rough_um=3.0), kV=60.0, filters=COPPER).energy_keV_per_mAs < usual


def test_a_family_left_out_changes_nothing_else():
    all_of_them = sample_system(np.random.default_rng([8, 0]))
    without = sample_system(np.random.default_rng([8, 0]), families=[name for name in FAMILIES if name != "k_escape"])
    assert replace(without, k_escape_share=all_of_them.k_escape_share) == all_of_them
    plain = sample_system(np.random.default_rng([8, 0]), families=())
    assert plain.unkindness == all_of_them.unkindness != NONE
    assert (plain.tube_model, plain.k_escape_share, plain.tail_share, plain.cover) == ("kqp", 1.0, 0.0, ())
    with pytest.raises(InputError, match="family: got 'k_escap'; expected a family such as k_escape"):
        sample_system(np.random.default_rng(1), families=["k_escap"])


def test_every_family_draws_systems_that_differ_and_the_sheet_tells_only_the_label():
    for name in FAMILIES:
        drawn = [sample_system(np.random.default_rng([seed, 0]), families=[name]) for seed in range(12)]
        plain = [sample_system(np.random.default_rng([seed, 0]), families=()) for seed in range(12)]
        assert sum(one != other for one, other in zip(drawn, plain, strict=True)) >= 2, name
        for one, other in zip(drawn, plain, strict=True):
            if one.scintillator == other.scintillator:
                assert one.instrument() == other.instrument(), name
    sizes = sample_unkindness(np.random.default_rng(2))
    assert 0 < sizes.row_noise_sigma < 0.1 and 0 < sizes.dark_DN < 0.5


def test_clusters_and_dead_lines_are_in_the_list_of_bad_pixels():
    system = replace(QUIET, bad_clusters=2, dead_lines=1)
    maps = detector_maps(system)
    dead = {(row, column) for row, column, kind in maps.bad_pixels if kind == "dead"}
    assert dead == {(int(row), int(column)) for row, column in np.argwhere(maps.DN_per_electron == 0)}
    lines = [sum(place[axis] == number for place in dead) for axis in (0, 1) for number in range(96)]
    assert max(lines) >= 16 and len(dead) > max(lines) + 4


@pytest.mark.parametrize(("protocol", "times"), [("averaged", 1), ("averaged_pairs", 2)])
def test_flats_can_be_stored_as_averages_once_or_in_two_series(protocol, times, tmp_path):
    system = replace(QUIET, rows=16, columns=16)
    run_protocol(tmp_path / "s.h5", protocol=protocol, seed=1, system=system, frames=8)
    with open_acquisition(tmp_path / "s.h5") as session:
        flats = [one for one in session.series if one.kind == "flat" and one.role == "calibration"]
        assert all(one.n_frames == 1 and one.averaged == 8 for one in session.series)
        settings = [(one.kV, one.filters, one.power_W, one.exposure_ms) for one in flats]
        assert {settings.count(setting) for setting in settings} == {times}

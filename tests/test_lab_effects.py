"""Every effect of the lab does what its strength says: measured on expectations, responses or frames."""

import math
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition.setting import Filter
from raytwin.errors import InputError
from raytwin.lab import EFFECTS, EffectRequest, compute_level, detector_maps, request_from_text
from raytwin.lab.attenuation import mu_per_mm
from raytwin.lab.chain import SUBPIXELS, FrameContext
from raytwin.lab.effect import Site
from raytwin.lab.effects import plant
from raytwin.lab.effects_detector import TRAP_TIMES_S, lag_of_signals
from raytwin.lab.line import Line, fine_rates
from raytwin.lab.objects import Slab, pixel_means, thickness_on_fine_grid
from raytwin.lab.phantoms import Edge, Posed
from raytwin.lab.session import COPPER, GEOMETRIES, make_session, session_system
from raytwin.lab.unkindness import NONE

SIZE = 64


def system_on(geometry, *, size=SIZE, **more):
    quiet = {"gain_spread_percent": 0.0, "dark_spread_DN": 0.0, "dead_pixels": 0, "hot_pixels": 0}
    # The laws are exact: nothing else may move.
    system = session_system(0, rows=size, columns=size, geometry=GEOMETRIES[geometry], families=())
    system = replace(system, unkindness=NONE)
    # Round voltage and angle: the spectra are kept from test to test.
    return replace(system, **{"kV_offset_percent": 0.0, "psf_sigma_px": 0.5, **quiet, **more})


def site_of(system, geometry, *, seed=1, frames=10):
    bench = GEOMETRIES[geometry]
    plan = make_session("full", system=system, geometry=bench, rng=np.random.default_rng(5), frames=frames, products=1)
    return Site(system=system, geometry=bench, plan=plan, rng=np.random.default_rng(seed))


def planted(text, geometry="coarse", *, seed=1, system=None):
    system = system_on(geometry) if system is None else system
    (effect,) = plant([request_from_text(text)], site_of(system, geometry, seed=seed))
    return effect


def line_with(text, geometry="coarse", *, seed=1, system=None):
    system = system_on(geometry) if system is None else system
    effects = () if text is None else (planted(text, geometry, seed=seed, system=system),)
    line = Line(system, rng=np.random.default_rng(7), planted=effects)
    line.calibration_is_over()
    return line


def setting_of(line, kV, exposure_ms=100.0, *, filtered=True, geometry="coarse"):
    from raytwin.acquisition.setting import Setting

    bench = GEOMETRIES[geometry]
    return Setting(
        kV=kV,
        power_W=bench.power_W[kV, filtered],
        exposure_ms=exposure_ms,
        filters=COPPER if filtered else (),
    )


def expected_keV(line, setting, *, scene=None, source_object_mm=None, rotation=0.0):
    """Expected deposit (keV per mAs and pixel) before any spread."""
    at = line.at_gap(source_object_mm)
    lengths = {} if scene is None else thickness_on_fine_grid(at, scene)
    arrivals = line.arrivals(
        setting,
        scene="" if scene is None else f"{scene}{source_object_mm}",
        thickness_mm=lengths,
        source_object_mm=source_object_mm,
        panel_rotation_deg=rotation,
    )
    return pixel_means(at, arrivals.sums[:, 0][arrivals.cell]).astype(float)


def frames_of(line, setting, count, **more):
    arrivals = line.arrivals(setting, **more)
    return np.array([frame for frame, _ in line.expose(arrivals, setting, frames=count)], dtype=np.float64)


def context_of(system, **more):
    given = {"exposure_ms": 100.0, "summed": 1, "key": np.uint64(5), "frame": 0, **more}
    return FrameContext(system=system, maps=detector_maps(system), **given)


def stage_of(effect):
    ((_, stage),) = effect.stages
    return stage.apply


# --- tube and beam ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kV", [40.0, 90.0])
def test_kv_error_changes_the_level_as_another_voltage_does(kV):
    system = system_on("coarse")
    line = line_with("kv_error=2", system=system)
    setting = setting_of(line, kV)
    found = expected_keV(line, setting).mean() / expected_keV(line_with(None, system=system), setting).mean()
    other = compute_level(system, kV=1.02 * kV, filters=COPPER).energy_keV_per_mAs
    assert found == pytest.approx(other / compute_level(system, kV=kV, filters=COPPER).energy_keV_per_mAs, rel=2e-3)
    assert line.system.kV_offset_percent == pytest.approx(2.0)


def test_filtration_error_is_a_layer_of_aluminium():
    system = system_on("coarse")
    line = line_with("filtration_error=0.3", system=system)
    setting = setting_of(line, 40.0, filtered=False)
    found = expected_keV(line, setting).mean() / expected_keV(line_with(None, system=system), setting).mean()
    layer = (Filter(material="Al", thickness_mm=0.3),)
    behind = compute_level(system, kV=40.0, filters=layer).energy_keV_per_mAs
    assert found == pytest.approx(behind / compute_level(system, kV=40.0, filters=()).energy_keV_per_mAs, rel=2e-3)
    assert found < 0.95


@pytest.mark.parametrize("kV", [40.0, 90.0])
def test_heel_changes_the_open_beam_across_the_field_by_its_strength_and_turns_with_the_panel(kV):
    line = line_with("heel=6", seed=3)
    degrees = line.active[0].parameters["direction_deg"]
    image = expected_keV(line, setting_of(line, kV, filtered=False))
    turned = expected_keV(line, setting_of(line, kV, filtered=False), rotation=180.0)
    assert turned == pytest.approx(image[::-1, ::-1], rel=1e-3)
    middle = SIZE // 2
    along = image[:, middle] if abs(math.cos(math.radians(degrees))) > 0.7 else image[middle, :]
    assert abs(along[0] - along[-1]) / along[middle] == pytest.approx(0.06, rel=0.03)
    # What is left is hardened: behind copper the same path takes away less.
    behind = expected_keV(line, setting_of(line, kV, filtered=True))
    along = behind[:, middle] if abs(math.cos(math.radians(degrees))) > 0.7 else behind[middle, :]
    assert abs(along[0] - along[-1]) / along[middle] < 0.058


@pytest.mark.parametrize("seed", [1, 2, 3, 5])
def test_an_absorber_takes_its_share_of_45_keV_on_one_side_and_turns_with_the_panel(seed):
    system = system_on("coarse")
    effect = planted("grey_absorber=20", seed=seed)
    line, bare = line_with("grey_absorber=20", seed=seed, system=system), line_with(None, system=system)
    ratios = {}
    for kV in (40.0, 90.0):
        setting = setting_of(line, kV)
        ratios[kV] = expected_keV(line, setting) / expected_keV(bare, setting)
        turned = expected_keV(line, setting, rotation=180.0) / expected_keV(bare, setting)
        assert turned == pytest.approx(ratios[kV][::-1, ::-1], rel=1e-3)
        assert ratios[kV].max() == pytest.approx(1.0, abs=1e-3)
    if not effect.parameters["foil"]:
        assert [ratios[kV].min() for kV in ratios] == pytest.approx([0.80, 0.80], abs=1e-3)
        return
    # the aluminium behind which a fifth of 45 keV photons is missing, as a filter of the whole beam
    thick_mm = -math.log(0.80) / float(mu_per_mm("Al", np.array([45.0]))[0])
    behind = (*COPPER, Filter(material="Al", thickness_mm=thick_mm))
    for kV, ratio in ratios.items():
        known, whole = (compute_level(system, kV=kV, filters=one).energy_keV_per_mAs for one in (behind, COPPER))
        assert ratio.min() == pytest.approx(known / whole, rel=2e-3)
    assert ratios[40.0].min() < ratios[90.0].min() - 0.02


def test_output_drift_has_its_rms_over_the_frames_of_the_session():
    from raytwin.lab.effects_beam import _sampled_clock

    site = site_of(system_on("coarse"), "coarse")
    (effect,) = plant([EffectRequest(id="output_drift", strength=0.8)], site)
    deviations = np.array([effect.load(clock_s) for clock_s in _sampled_clock(site)]) - 1.0
    assert math.sqrt(np.mean(deviations**2)) == pytest.approx(0.008, rel=1e-6)


# --- object -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_scatter_behind_20_mm_of_water_has_its_strength_over_primary_on_the_mean_of_both_kV():
    system = system_on("coarse")
    line, bare = line_with("object_scatter=20", system=system), line_with(None, system=system)
    water = Slab(layers_mm={"water": 20.0})
    ratios = []
    for kV in (40.0, 90.0):
        setting = setting_of(line, kV)
        primary = expected_keV(bare, setting, scene=water)
        scattered = expected_keV(line, setting, scene=water) - primary
        middle = slice(SIZE // 2 - 4, SIZE // 2 + 4)
        ratios.append(scattered[middle, middle].mean() / primary.mean())
        near = expected_keV(line, setting, scene=water, source_object_mm=900.0) - primary
        assert near.mean() > 3 * scattered.mean()
        assert expected_keV(line, setting) == pytest.approx(expected_keV(bare, setting))
    # Two estimates of 1 % each, at each kV.
    assert np.mean(ratios) == pytest.approx(0.20, rel=0.04)


def edge_profile(line, setting, *, direction, source_object_mm=None):
    """Line spread (per fine sub-pixel) of an untilted edge, from the mean over the lines along it."""
    at = line.at_gap(source_object_mm)
    scene = Edge(angle=0.0 if direction == "x" else math.pi / 2.0)
    arrivals = line.arrivals(
        setting,
        scene=f"{direction}{source_object_mm}",
        thickness_mm=thickness_on_fine_grid(at, scene),
        source_object_mm=source_object_mm,
    )
    signal = arrivals.sums[:, 0][arrivals.cell].astype(float).mean(axis=0 if direction == "x" else 1)
    spread = -np.diff(signal)
    return spread / spread.sum()


def rms_width_px(spread):
    place = np.arange(spread.size) / SUBPIXELS
    mean = spread @ place
    return math.sqrt(spread @ (place - mean) ** 2)


@pytest.mark.parametrize("strength", [0.1, 0.6])
def test_focal_spot_blurs_edges_by_its_size_times_magnification_less_one(strength):
    line = line_with(f"focal_spot={strength}", "fine")
    setting = setting_of(line, 60.0, geometry="fine")
    for source_object_mm in (None, 360.0):
        at = line.at_gap(source_object_mm)
        width_px = strength * (at.magnification - 1.0) / at.pixel_mm
        spread = edge_profile(line, setting, direction="x", source_object_mm=source_object_mm)
        # A triangle of half width w has the standard deviation w / root 6.
        assert rms_width_px(spread) == pytest.approx(width_px / math.sqrt(6.0), rel=0.02)
    if strength > 0.5:
        spread = edge_profile(line, setting, direction="y")
        above = np.flatnonzero(spread > 0.5 * spread.max())
        width_px = strength * (line.system.magnification - 1.0) / line.system.pixel_mm
        assert (above[-1] - above[0] + 1) / SUBPIXELS == pytest.approx(width_px, abs=0.5)


def test_motion_blur_is_as_long_as_its_strength_at_50_ms_and_grows_with_the_exposure():
    line = line_with("motion_blur=4", "fine")
    for exposure_ms in (25.0, 50.0, 100.0):
        setting = setting_of(line, 60.0, exposure_ms, geometry="fine")
        along = rms_width_px(edge_profile(line, setting, direction="y")) * math.sqrt(12.0)
        # The belt's speed ripples by 15 %, over a cycle of 20 to 60 ms.
        assert along == pytest.approx(4.0 * exposure_ms / 50.0, rel=0.17 if exposure_ms < 50 else 0.10)
        assert rms_width_px(edge_profile(line, setting, direction="x")) < 0.01


def test_misregistration_displaces_by_its_rms():
    effect = planted("misregistration=0.7", "fine")
    system = system_on("fine")
    pitch_mm = system.pixel_mm / system.magnification
    pose = effect.pose(Posed(scene=Slab(layers_mm={"water": 1.0})), pitch_mm)
    places = (np.arange(SIZE) - (SIZE - 1) / 2.0) * pitch_mm
    y, x = np.meshgrid(places, places, indexing="ij")
    cosine, sine = math.cos(pose.rotation), math.sin(pose.rotation)
    moved_y = y * cosine + x * sine + pose.shift_y_mm
    moved_x = x * cosine - y * sine + pose.shift_x_mm
    rms_px = math.sqrt(np.mean((moved_y - y) ** 2 + (moved_x - x) ** 2)) / pitch_mm
    assert rms_px == pytest.approx(0.7, rel=2e-3)


@pytest.mark.parametrize("strength", [-3.0, 3.0])
def test_composition_error_changes_the_attenuation_of_the_product_and_of_nothing_else(strength):
    system = system_on("coarse")
    line, bare = line_with(f"composition_error={strength}", system=system), line_with(None, system=system)
    meat, plastic = Slab(layers_mm={"chicken_breast": 20.0}), Slab(layers_mm={"pmma": 20.0})
    changes = []
    for kV in (40.0, 90.0):
        setting = setting_of(line, kV)
        open_keV = expected_keV(bare, setting).mean()
        before, after = (-math.log(expected_keV(one, setting, scene=meat).mean() / open_keV) for one in (bare, line))
        changes.append(100.0 * (after / before - 1.0))
        assert expected_keV(line, setting, scene=plastic) == pytest.approx(expected_keV(bare, setting, scene=plastic))
    # Exact at one energy; salt counts for more at the low kV and for less at the high one.
    assert np.mean(changes) == pytest.approx(strength, rel=0.08)
    assert abs(changes[0]) > abs(changes[1])


# --- light and charge -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("text", "core"), [("veiling_glare=3", 0.97), ("mtf_tail=20", 0.80)])
def test_strayed_light_is_its_share_and_none_is_lost(text, core):
    effect = planted(text, "fine")
    point = np.zeros((SIZE, SIZE), dtype=np.float32)
    point[SIZE // 2, SIZE // 2] = 1.0
    spread = stage_of(effect)(point, None)
    wide = np.delete(spread.ravel(), SIZE // 2 * SIZE + SIZE // 2)
    assert wide.min() >= 0
    # What falls back on the pixel itself is small: the tail is wider than a pixel.
    assert spread.max() == pytest.approx(core, abs=0.3 * (1.0 - core))
    assert spread.max() >= core
    even = np.full((SIZE, SIZE), 7.0, dtype=np.float32)
    assert stage_of(effect)(even, None) == pytest.approx(even, rel=1e-5)


def covariance(frames, row, column):
    left = frames - frames.mean(axis=0)
    n, rows, columns = left.shape
    return (left[:, : rows - row, : columns - column] * left[:, row:, column:]).mean() * n / (n - 1)


def test_k_photons_of_gadolinium_come_above_its_own_edge():
    system = replace(system_on("fine"), scintillator="Gd2O2S@7.32", scintillator_mm=0.15)
    line = line_with("k_fluorescence=40", "fine", system=system)
    arrivals = line.arrivals(setting_of(line, 60.0, geometry="fine"))
    bare = line_with(None, "fine", system=system).arrivals(setting_of(line, 60.0, geometry="fine"))
    split = bare.rates.sum() - arrivals.rates.sum()
    above = bare.rates[:, bare.deposit_keV > 50.2].sum()
    assert split == pytest.approx(0.4 * above, rel=1e-4) and 0.0 < above < 0.3 * bare.rates.sum()
    assert arrivals.remote.sum() == pytest.approx(split, rel=1e-4)
    # what stays where such a photon stops is all above gadolinium's line
    assert 50.2 - 42.8 < float(arrivals.remote_keV[0]) < 60.0 - 42.8


def test_k_fluorescence_leaves_the_level_and_takes_variance_from_the_pixel_above_the_edge_only():
    system = system_on("fine", psf_sigma_px=0.35)
    line, bare = line_with("k_fluorescence=40", "fine", system=system), line_with(None, "fine", system=system)
    below, above = (setting_of(line, kV, geometry="fine") for kV in (30.0, 60.0))
    assert np.array_equal(frames_of(line, below, 2), frames_of(bare, below, 2))
    with_it, without = frames_of(line, above, 40), frames_of(bare, above, 40)
    spread = without.std(axis=0).mean()
    assert with_it.mean() == pytest.approx(without.mean(), abs=5 * spread * math.sqrt(2 / without.size))
    variance = covariance(without, 0, 0)
    assert covariance(with_it, 0, 0) < 0.93 * variance
    assert covariance(with_it, 0, 2) + covariance(with_it, 2, 0) > 0.01 * variance

    # Energy moves, none is lost: the sum over bins of 8 pixels hardly changes.
    def binned(frames):
        return frames.reshape(-1, SIZE // 8, 8, SIZE // 8, 8).sum(axis=(2, 4)).var(axis=0, ddof=1).mean()

    error = math.sqrt(2.0 / (40 * (SIZE // 8) ** 2))
    assert binned(with_it) / binned(without) == pytest.approx(1.0 - 0.02, abs=5 * math.sqrt(2) * error)


@pytest.mark.parametrize("other", ["crosstalk=20", "off_focal=5"])
def test_k_photons_are_split_off_where_quanta_stop_and_none_is_lost(other):
    system = system_on("fine")
    requests = [request_from_text("k_fluorescence=40"), request_from_text(other)]
    both = Line(system, rng=np.random.default_rng(7), planted=plant(requests, site_of(system, "fine")))
    both.calibration_is_over()
    bare = line_with(None, "fine", system=system)
    setting = setting_of(bare, 60.0, geometry="fine")
    lengths = {"Al": np.full(thickness_on_fine_grid(system, Edge(angle=0.0))["W"].shape, 1.0, dtype=np.float32)}
    means = [frames_of(line, setting, 4, scene="plate", thickness_mm=lengths).mean() for line in (both, bare)]
    assert means[0] == pytest.approx(means[1], rel=2e-3)


def test_crosstalk_moves_its_share_of_the_quanta_out_of_their_pixel_and_loses_none():
    system = system_on("fine")
    line, bare = line_with("crosstalk=20", "fine", system=system), line_with(None, "fine", system=system)
    setting = setting_of(line, 60.0, geometry="fine")
    # one pixel in an opaque plate lets light through
    lengths = {"W": np.full(thickness_on_fine_grid(system, Edge(angle=0.0))["W"].shape, 5.0, dtype=np.float32)}
    fine = lengths["W"].shape[0]
    first = (fine // SUBPIXELS // 2) * SUBPIXELS
    lengths["W"][first : first + SUBPIXELS, first : first + SUBPIXELS] = 0.0
    both = []
    for one in (line, bare):
        arrivals = one.arrivals(setting, scene="hole", thickness_mm=lengths)
        both.append(arrivals.sums[:, 0][arrivals.cell].astype(float))
    moved, still = (image.reshape(fine // SUBPIXELS, SUBPIXELS, -1, SUBPIXELS).sum(axis=(1, 3)) for image in both)
    at = first // SUBPIXELS
    assert moved.sum() == pytest.approx(still.sum(), rel=1e-4)
    assert 1.0 - moved[at, at] / still[at, at] == pytest.approx(0.20, abs=1e-3)
    beside = [moved[at - 1, at], moved[at + 1, at], moved[at, at - 1], moved[at, at + 1]]
    assert np.ptp(beside) < 0.01 * np.mean(beside) and min(beside) > 0.01 * still[at, at]


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5, 6])
def test_gains_of_tiles_have_their_rms_and_steps_only_at_the_seams(seed):
    effect = planted("tile_gain=1.5", seed=seed)
    maps = detector_maps(system_on("coarse"))
    gain = effect.maps(maps).DN_per_electron.astype(float) / maps.DN_per_electron
    side, first, narrow = (effect.parameters[name] for name in ("chip_px", "first_px", "narrow"))
    borders = np.arange(first, SIZE, side)
    steps = np.flatnonzero(np.any(np.abs(np.diff(gain, axis=1)) > 1e-5, axis=0)) + 1
    seams = np.sort([borders - 1, borders, borders + 1], axis=None) if narrow else borders
    np.testing.assert_array_equal(steps, seams[(seams > 0) & (seams < SIZE)])
    inside = np.ones(SIZE, dtype=bool)
    inside[[*(borders - 1), *borders][: 2 * borders.size]] = not narrow
    if effect.parameters["channels"]:
        assert np.ptp(gain, axis=0).max() < 1e-5
    elif narrow:
        return  # rows beside a seam are narrow as well
    # of chips alone: what narrow pixels lose is no part of the strength
    whole = gain[:, inside]
    assert whole.mean() == pytest.approx(1.0, abs=1e-6 if not narrow else 2e-3)
    assert whole.std() == pytest.approx(0.015, rel=1e-4 if not narrow else 0.2)


def test_lines_flicker_with_the_light_by_their_rms_and_not_in_the_dark():
    effect = planted("line_flicker=0.5", seed=2)
    line = line_with("line_flicker=0.5", seed=2)
    even = np.full((SIZE, SIZE), 1000.0, dtype=np.float32)
    factors = np.array([stage_of(effect)(even, context_of(line.system, frame=n))[:, 0] / 1000.0 for n in range(400)])
    assert np.ptp(stage_of(effect)(even, context_of(line.system)), axis=1).max() == 0.0
    assert (factors - 1.0).std() == pytest.approx(0.005, rel=0.05)
    assert factors.mean() == pytest.approx(1.0, abs=3e-4)
    # the mean of ten exposures flickers less, and frames have phases of their own
    summed = np.array([stage_of(effect)(even, context_of(line.system, frame=n, summed=10))[:, 0] for n in range(400)])
    assert (summed / 1000.0 - 1.0).std() == pytest.approx(0.005 / math.sqrt(10.0), rel=0.1)
    (dark, _), (bare, _) = next(line.dark(100.0, frames=1)), next(line_with(None).dark(100.0, frames=1))
    assert np.array_equal(dark, bare)


def test_quanta_that_moved_stay_independent():
    system = system_on("fine", psf_sigma_px=0.35)
    line, bare = line_with("crosstalk=30", "fine", system=system), line_with(None, "fine", system=system)
    setting = setting_of(line, 60.0, geometry="fine")
    lengths = thickness_on_fine_grid(system, Slab(layers_mm={"pmma": 10.0}))
    with_it, without = (frames_of(one, setting, 40, scene="slab", thickness_mm=lengths) for one in (line, bare))
    error = math.sqrt(2.0 / 40.0) / SIZE
    assert covariance(with_it, 0, 0) / covariance(without, 0, 0) == pytest.approx(1.0, abs=5 * math.sqrt(2) * error)
    for lag in ((0, 1), (1, 0), (1, 1)):
        correlations = [covariance(one, *lag) / covariance(one, 0, 0) for one in (with_it, without)]
        assert correlations[0] == pytest.approx(correlations[1], abs=5 * error)


@pytest.mark.parametrize("since", ["always", "calibration"])
def test_lag_leaves_its_strength_in_the_first_frame_without_beam(since):
    line = line_with(f"image_lag=2@{since}", seed=4)
    quiet = line_with(None)
    setting = setting_of(line, 90.0)
    dark_DN = np.mean([frame for frame, _ in quiet.dark(100.0, frames=5)])
    site = site_of(system_on("coarse"), "coarse", seed=4)
    for take in site.plan.takes:
        line.pause(take.pause_s)
        if take.kind == "afterglow":
            break
        if since == "calibration" and take.role == "calibration":
            continue
        if take.kind == "flat":
            one = take.setting
            arrivals = line.arrivals(one)
            lit = [frame for frame, _ in line.expose(arrivals, one, frames=take.frames)]
        else:
            list(line.dark(take.setting.exposure_ms, frames=take.frames))
    (off, _), (later, _) = line.dark(setting.exposure_ms, frames=2)
    ratio = (np.mean(off) - dark_DN) / (np.mean(lit[-1]) - dark_DN)
    assert ratio == pytest.approx(0.02, rel=0.02)
    assert dark_DN < np.mean(later) < np.mean(off)


def test_trapped_charge_is_conserved():
    capture = np.full(len(TRAP_TIMES_S), 0.01)
    signals = np.concatenate([np.ones(400), np.zeros(200_000)])
    read = lag_of_signals(signals, np.full(signals.size, 0.1), capture)
    assert read.sum() == pytest.approx(400.0, rel=1e-6)
    assert read[0] == pytest.approx(0.95)
    late = read[400:]
    assert np.all(np.diff(late) <= 0)
    # Not one exponential: the decay slows down by far more than a factor of ten.
    assert late[1] / late[0] < 0.9 and late[1001] / late[1000] > 0.99


@pytest.mark.parametrize("strength", [-2.0, 0.5, 4.0])
def test_nonlinearity_departs_by_its_strength_at_half_of_the_highest_level(strength):
    system = system_on("coarse")
    bend = stage_of(planted(f"nonlinearity={strength}", system=system))
    half = 0.5 * (system.saturation_DN - system.dark_DN) / system.DN_per_electron
    electrons = np.array([[1.0, half]], dtype=np.float32)
    bent = bend(electrons, None)
    assert bent[0, 1] / half == pytest.approx(1.0 - strength / 100.0, rel=1e-5)
    assert bent[0, 0] == pytest.approx(1.0, rel=1e-4)


def test_dark_drift_changes_by_its_strength_over_the_session_at_the_longest_exposure():
    system = system_on("coarse")
    effect = planted("dark_drift=30", system=system)
    warm, end_s = stage_of(effect), effect.parameters["session_s"]
    none = np.zeros((SIZE, SIZE), dtype=np.float32)
    for exposure_ms in (10.0, 100.0):
        last = warm(none, context_of(system, exposure_ms=exposure_ms, began_s=end_s)) * system.DN_per_electron
        first = warm(none, context_of(system, exposure_ms=exposure_ms, began_s=0.0)) * system.DN_per_electron
        assert np.median(last - first) == pytest.approx(30.0 * exposure_ms / 100.0, rel=1e-4)


# --- patterns, noises, codes ------------------------------------------------------------------------------------------


def test_gain_map_error_has_its_rms_and_mean_0():
    line = line_with("gain_map_error=1.2")
    eta = line.maps.DN_per_electron / line.base_maps.DN_per_electron - 1.0
    assert eta.std() == pytest.approx(0.012, rel=1e-3) and abs(eta.mean()) < 1e-5


def test_bad_pixels_are_as_many_as_asked_for():
    line = line_with("bad_pixels=1.5")
    places = line.active[0].parameters["places"]
    assert len(places) == round(0.015 * SIZE**2)
    changed = line.maps.DN_per_electron != line.base_maps.DN_per_electron
    changed |= line.maps.dark_current_DN_per_ms != line.base_maps.dark_current_DN_per_ms
    assert changed.sum() == len(places)


def test_excess_noise_multiplies_the_quantum_variance_and_leaves_the_level():
    system = system_on("coarse", psf_sigma_px=0.0, read_noise_DN=1.0)
    line, bare = line_with("excess_noise=40", system=system), line_with(None, system=system)
    setting = setting_of(line, 90.0)
    with_it, without = frames_of(line, setting, 60), frames_of(bare, setting, 60)
    signal = without.mean() - system.dark_DN
    assert with_it.mean() == pytest.approx(without.mean(), abs=5 * with_it.std() * math.sqrt(2 / with_it.size))
    white = 1.0 + 1.0 / 12.0 + system.DN_per_electron * signal
    ratio = (covariance(with_it, 0, 0) - white) / (covariance(without, 0, 0) - white)
    assert ratio == pytest.approx(1.4, abs=5 * 1.4 * math.sqrt(4.0 / with_it.size))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_row_noise_has_its_rms_in_every_frame_anew_in_lines_or_bands(seed):
    system = system_on("coarse")
    line = line_with("row_noise=1.5", system=system, seed=seed)
    darks = np.array([frame for frame, _ in line.dark(10.0, frames=80)], dtype=float)
    axis = 2 if line.active[0].parameters["axis"] == "row" else 1
    lines = (darks - darks.mean(axis=0)).mean(axis=axis)
    white = system.read_noise_DN**2 / SIZE
    rms = math.sqrt(lines.var(ddof=0) * 80 / 79 - white)
    # A Student's t of 6 degrees has an excess kurtosis of 3.
    bands = line.active[0].parameters["bands"]
    assert rms / system.read_noise_DN == pytest.approx(1.5, rel=5 * 0.5 * math.sqrt(5.0 * bands / lines.size))
    correlation = np.corrcoef(lines[:-1].ravel(), lines[1:].ravel())[0, 1]
    assert abs(correlation) < 5 * math.sqrt(bands / lines.size)
    beside = np.corrcoef(lines[:, :-1].ravel(), lines[:, 1:].ravel())[0, 1]
    assert abs(beside - (bands - 1) / bands) < 5 * math.sqrt(bands / lines.size)


def test_quantisation_gives_multiples_of_its_step():
    line = line_with("quantisation=16")
    frames = frames_of(line, setting_of(line, 90.0), 2)
    assert np.all(frames % 16 == 0)
    values = np.unique(frames_of(line_with("quantisation=2.5"), setting_of(line, 90.0), 2))
    assert np.array_equal(values, np.rint(np.rint(values / 2.5) * 2.5))


def test_off_focal_radiation_lights_the_shadow_and_leaves_the_open_field():
    line = line_with("off_focal=10", "coarse")
    setting = setting_of(line, 90.0)
    spread = edge_profile(line, setting, direction="x")
    middle = spread.argmax()
    near = spread[middle - 2 : middle + 3].sum()
    assert near == pytest.approx(0.9, abs=0.03)
    flat = expected_keV(line, setting)
    assert flat.std() < 1e-6 * flat.mean()


def test_a_screen_brightens_by_its_strength_after_a_hundred_exposures_at_full_scale():
    system = system_on("coarse")
    brighten = stage_of(planted("burn_in=2", system=system))
    full_keV = (system.saturation_DN - system.dark_DN) / system.DN_per_electron / system.electrons_per_keV
    light = np.full((SIZE, SIZE), full_keV, np.float32)
    light[:, : SIZE // 2] = 0.0
    memory = {}
    for number in range(100):
        brighten(light, context_of(system, began_s=0.001 * number, memory=memory))
    even = np.ones((SIZE, SIZE), np.float32)
    seen = brighten(even, context_of(system, began_s=0.1, memory=memory))
    assert seen[:, -1] == pytest.approx(1.02, abs=2e-4) and seen[:, 0] == pytest.approx(1.0, abs=1e-6)
    # it fades
    later = brighten(even, context_of(system, began_s=10_000.0, memory=memory))
    assert 1.002 < later[0, -1] < 1.01


def test_piled_up_pulses_are_lost_as_by_a_dead_time_that_each_prolongs():
    system = system_on("coarse")
    miss = stage_of(planted("pile_up=1000", system=system))
    electrons = np.full((SIZE, SIZE), 45.0 * system.electrons_per_keV * 20_000, np.float32)
    electrons[0] /= 1000.0
    seen = miss(electrons, context_of(system, exposure_ms=100.0)) / electrons
    # 20,000 photons in 0.1 s, blind for 1 us after each
    assert seen[1] == pytest.approx(math.exp(-0.2), rel=1e-5) and seen[0] == pytest.approx(1.0 - 2e-4, rel=1e-5)


def test_a_threshold_that_rose_loses_the_photons_between_both():
    miss = planted("threshold_error=6", system=system_on("coarse")).rates
    deposit_keV = np.array([10.0, 20.0, 23.0, 26.0, 40.0])
    cell = np.zeros((SIZE, SIZE), dtype=np.int32)
    seen = miss(fine_rates(cell, np.full((1, 5), 8.0, np.float32), deposit_keV, load_mAs=2.0), None)
    np.testing.assert_allclose(seen.rates[0] / 8.0, [1.0, 0.5, 0.05, 0.5, 1.0], atol=0.01)
    assert seen.load_mAs == 2.0 and seen.totals[0] == pytest.approx(seen.rates[0].sum(), rel=1e-5)


def test_lost_frames_are_copies_of_the_last_good_one_of_their_series():
    line = line_with("dropped_frames=20", seed=3)
    shown = []
    for number in range(2):
        line.begin_series(number)
        shown.append(np.array([frame for frame, _ in line.dark(10.0, frames=600)]))
    copies = [np.all(frames[1:] == frames[:-1], axis=(1, 2)) for frames in shown]
    share = np.mean(copies)
    # stalls of 1.5 frames: twice the variance of copies drawn one by one
    assert abs(share - 0.20) < 4 * math.sqrt(2 * 0.2 * 0.8 / 1200)
    lengths = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], copies[0], [0]]))))[::2]
    assert lengths.mean() == pytest.approx(1.5, abs=4 * math.sqrt(0.75 / lengths.size))
    assert not np.array_equal(shown[1][0], shown[0][-1])


# --- what no catalogue holds ------------------------------------------------------------------------------------------


def test_offsets_of_tiles_wander_by_their_strength_and_leave_their_mean():
    system = system_on("coarse", size=128)
    effect = planted("unknown:tile_offsets=0.5", system=system)
    dark = np.full((128, 128), 100.0, dtype=np.float32)
    shown = np.array([stage_of(effect)(dark, context_of(system, frame=n)) for n in range(400)])[:, 3::32, 3::32]
    assert shown.std() == pytest.approx(0.5 * system.read_noise_DN, rel=0.05)
    assert abs(shown.mean() - 100.0) < 0.05 * system.read_noise_DN


def test_random_telegraph_pixels_jump_and_stay():
    system = system_on("coarse")
    line = line_with("random_telegraph=3", system=system)
    darks = np.array([frame for frame, _ in line.dark(10.0, frames=100)], dtype=float)
    spread = darks.std(axis=0, ddof=1)
    jumping = spread > 1.5 * system.read_noise_DN
    assert jumping.sum() == pytest.approx(0.03 * SIZE**2, rel=0.1)
    series = darks[:, jumping] - darks[:, jumping].mean(axis=0)
    assert (series[1:] * series[:-1]).mean() / (series**2).mean() > 0.4


def test_sharpening_keeps_flats_and_overshoots_at_edges():
    sharpen = stage_of(planted("unknown:sharpening=50"))
    system = system_on("coarse")
    step = np.full((SIZE, SIZE), 1000, dtype=np.uint16)
    assert np.array_equal(sharpen(step, context_of(system)), step)
    step[:, SIZE // 2 :] = 5000
    out = sharpen(step, context_of(system)).astype(int)
    assert out.max() > 5000 + 0.1 * 4000 and out.min() < 1000 - 0.1 * 4000


def test_a_waving_look_up_table_moves_numbers_by_its_strength_and_leaves_0_alone():
    effect = planted("unknown:lookup_table=100")
    system = system_on("coarse")
    numbers = np.linspace(0, 0.9 * system.saturation_DN, SIZE**2).astype(np.uint16).reshape(SIZE, SIZE)
    moved = stage_of(effect)(numbers, context_of(system)).astype(float) - numbers
    assert moved.flat[0] == 0.0
    assert np.ptp(moved[numbers > 300]) == pytest.approx(200.0, rel=0.02)


def test_compression_stores_few_waves_a_block():
    from scipy.fft import dctn

    line = line_with("unknown:compression=100", system=system_on("coarse"))
    frame = frames_of(line, setting_of(line, 90.0), 1)[0]
    block = dctn(frame[8:16, 8:16], norm="ortho")
    # What was stored are multiples of the steps; rounding to whole DN adds about 0.3.
    assert np.all(np.abs(block[0, 1] / 150.0 - np.rint(block[0, 1] / 150.0)) < 0.02)
    assert (np.abs(block) < 3.0).sum() > 10


# --- all of them ------------------------------------------------------------------------------------------------------


def test_strength_0_plants_nothing_and_requests_are_checked():
    site = site_of(system_on("coarse"), "coarse")
    assert plant([EffectRequest(id=name, strength=0.0) for name in EFFECTS], site) == ()
    with pytest.raises(InputError, match="an effect's id, such as image_lag"):
        EffectRequest(id="image_log", strength=1.0)
    with pytest.raises(InputError, match=r"strength of heel: got nan %; expected 1 to 20 %"):
        EffectRequest(id="heel", strength=math.nan)
    with pytest.raises(InputError, match="strength of image_lag: got -1 %"):
        EffectRequest(id="image_lag", strength=-1.0)
    assert request_from_text(" kv_error=-1.5@calibration") == EffectRequest(
        id="kv_error", strength=-1.5, since="calibration"
    )


def test_an_effect_keeps_its_inner_parameters_whatever_stands_beside_it():
    site = site_of(system_on("coarse"), "coarse", seed=8)
    alone = plant([EffectRequest(id="image_lag", strength=1.0)], site)
    site = site_of(system_on("coarse"), "coarse", seed=8)
    both = plant([EffectRequest(id="image_lag", strength=1.0), EffectRequest(id="heel", strength=3.0)], site)
    told = {effect.id: effect.parameters for effect in both}
    assert told["image_lag"] == alone[0].parameters

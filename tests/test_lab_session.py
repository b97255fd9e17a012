"""Long sessions: what they hold, what their frames obey, when effects set in, and the cases of a blind check."""

import json
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition.acquisition_io import open_acquisition
from raytwin.acquisition.setting import Setting
from raytwin.errors import InputError
from raytwin.lab import EFFECTS, GEOMETRIES, EffectRequest, aperture_share, detector_maps, draw_case
from raytwin.lab.cases import LABELS
from raytwin.lab.line import Line
from raytwin.lab.protocols import run_protocol, truth_path
from raytwin.lab.session import COPPER, EXPOSURES_MS, session_system
from raytwin.lab.truth import flat_truth
from raytwin.lab.unkindness import NONE

SIZE = 48


def taken(path, **more):
    return run_protocol(
        path, **{"protocol": "full", "seed": 6, "rows": SIZE, "frames": 4, "products": 2, "families": (), **more}
    )


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    path = tmp_path_factory.mktemp("lab") / "full.h5"
    return path, taken(path)


def frames_by_name(path):
    with open_acquisition(path) as session:
        return {series.name: series.read_frames() for series in session.series}


@pytest.mark.slow
def test_a_full_session_holds_the_measurement_set_that_splits_every_pair(full):
    path, truth = full
    with open_acquisition(path) as session:
        series = session.series
        flats = [one for one in series if one.kind == "flat"]
        calibrating = [one for one in flats if one.role == "calibration"]
        low_kV, high_kV = GEOMETRIES["coarse"].kVs
        beams = {(one.kV, one.filters, one.exposure_ms) for one in calibrating}
        assert beams == {(kV, layers, ms) for kV in (low_kV, high_kV) for layers in ((), COPPER) for ms in EXPOSURES_MS}
        darks = [one for one in series if one.kind == "dark"]
        assert {one.exposure_ms for one in darks if one.role == "calibration"} == set(EXPOSURES_MS)
        places = [series.index(one) for one in darks]
        assert len(places) >= 12 and max(np.diff(places)) < len(series) / 2 and places[-1] == len(series) - 1
        (afterglow,) = (one for one in series if one.kind == "afterglow")
        before = series[series.index(afterglow) - 1]
        assert before.kind == "flat" and before.exposure_ms == afterglow.exposure_ms
        # Beam off straight after the last exposure: one frame's time later.
        gap_ms = 1000.0 * (afterglow.time_s[0] - before.time_s[-1])
        assert gap_ms == pytest.approx(before.frame_interval_ms, rel=1e-6)
        assert {one.panel_rotation_deg for one in flats} == {0.0, 180.0}
        scenes = session.scenes
        for kind, wanted in (("wedge", 4), ("slab", 2), ("edge", 4), ("disc", 2), ("product", 2)):
            assert sum(scene.kind == kind for scene in scenes.values()) == wanted
        for name in ("wedge_far_a", "wedge_near_b", "slab_far"):
            assert {one.kV for one in series if one.scene == name} == {low_kV, high_kV}
        near = {one.scene for one in series if one.source_object_mm is not None}
        assert near == {name for name in scenes if "near" in name}
        edges = [one for one in series if one.scene == "edge_far_y" and one.kV == high_kV]
        assert len({one.exposure_ms for one in edges}) == 3
        assert max(one.setting.tube_load_mAs for one in edges) == pytest.approx(
            min(one.setting.tube_load_mAs for one in edges)
        )
        assert {one.exposure_ms for one in series if one.scene == "product1"} == {25.0, 100.0}
        assert all(one.role == "evaluation" for one in series if one.kind == "object")
        assert all(one.time_s is not None and one.frame_interval_ms for one in series)
        assert [one.index for one in series] == list(range(len(series)))
        times = np.concatenate([one.time_s for one in series])
        assert np.all(np.diff(times) > 0)
        assert session.instrument.pixel_mm == 0.4 and session.instrument.source_object_mm == 650.0
    assert truth["effects"] == {}
    written = json.loads(truth_path(path).read_text(encoding="utf-8"))
    assert written == json.loads(json.dumps(truth))


def test_stated_thickness_maps_are_what_was_meant_and_the_true_objects_a_little_off(full):
    path, truth = full
    with open_acquisition(path) as session:
        wedge = session.scenes["wedge_far_a"].thickness_mm
        assert set(wedge) == {"pmma", "Al"}
        assert np.unique(np.round(wedge["pmma"][10:-10, 10:-10], 3)).max() == 30.0
        other = session.scenes["wedge_far_b"].thickness_mm
        assert np.array_equal(wedge["pmma"][::-1, ::-1], other["pmma"])
        # Nearer to the detector an object is less magnified.
        near = session.scenes["wedge_near_a"].thickness_mm
        assert (near["pmma"] > 0).sum() < (wedge["pmma"] > 0).sum()
        assert session.scenes["slab_far"].thickness_mm["chicken_breast"] == pytest.approx(20.0)
        assert session.scenes["edge_far_x"].thickness_mm["W"].max() == 2.0
    poses = truth["scenes"].values()
    # One wedge and one slab, wherever they are put; every product is another.
    wedges = {json.dumps(pose["scale"]) for name, pose in truth["scenes"].items() if name.startswith("wedge")}
    scales = {scale for pose in poses for scale in pose["scale"].values() if scale != 1.0}
    assert len(wedges) == 1 and len(scales) >= 5 and 0.001 < np.std(list(scales)) < 0.015
    outputs = [told["output"] for told in truth["series"].values() if "output" in told]
    assert 1.5e-4 < np.std(outputs) < 4e-4 and np.mean(outputs) == pytest.approx(1.0, abs=3e-4)
    shifts = [abs(pose["shift_x_mm"]) for pose in poses]
    assert 0 < max(shifts) <= 0.2 * 0.4


def test_opaque_plates_are_dark_and_products_cast_shadows(full):
    path, truth = full
    frames = frames_by_name(path)
    with open_acquisition(path) as session:
        mask = session.scenes["edge_far_x"].thickness_mm["W"]
        dark_DN = truth["dark_DN_at"][-1]["dark_DN"]
        behind = frames["edge_far_x_90kV_100ms"].mean(axis=0)
        deep = np.zeros_like(mask, dtype=bool)
        deep[6:-6, 6:-6] = (mask[6:-6, 6:-6] == 2.0) & (np.roll(mask, 5, axis=1)[6:-6, 6:-6] == 2.0)
        assert abs(np.median(behind[deep]) - dark_DN) < 10.0
        assert np.median(behind[mask == 0]) > dark_DN + 5000
        product = session.scenes["product1"]
        shadow = frames["product1_40kV_100ms"].mean(axis=0)
        assert np.median(shadow[product.product_mask]) < 0.8 * np.median(shadow[~product.product_mask])


def test_an_effect_that_came_later_leaves_the_calibration_as_it_was(full, tmp_path):
    path, _ = full
    later = tmp_path / "later.h5"
    truth = taken(later, effects=[EffectRequest(id="gain_map_error", strength=2.0)])
    assert truth["effects"]["gain_map_error"]["since"] == "calibration"
    before, after = frames_by_name(path), frames_by_name(later)
    assert list(before) == list(after)
    with open_acquisition(path) as session:
        roles = {series.name: (series.role, series.kind) for series in session.series}
    for name, (role, kind) in roles.items():
        if role == "calibration" or kind in ("flat", "object"):
            assert np.array_equal(before[name], after[name]) == (role == "calibration"), name
    always = tmp_path / "always.h5"
    taken(always, effects=[EffectRequest(id="gain_map_error", strength=2.0, since="always")])
    name = next(name for name, (role, kind) in roles.items() if role == "calibration" and kind == "flat")
    assert not np.array_equal(frames_by_name(always)[name], before[name])


def test_strength_0_and_no_effect_give_the_same_bytes(full, tmp_path):
    path, _ = full
    taken(tmp_path / "zero.h5", effects=[EffectRequest(id=name, strength=0.0) for name in EFFECTS])
    before, after = frames_by_name(path), frames_by_name(tmp_path / "zero.h5")
    assert all(np.array_equal(before[name], after[name]) for name in before)


@pytest.mark.slow
def test_all_effects_together_still_make_a_session(tmp_path):
    requests = [EffectRequest(id=name, strength=law.low) for name, law in EFFECTS.items()]
    # Scatter takes a second an object: few of them.
    fewer = ["wedge", "edge", "near", "low_kV"]
    truth = taken(tmp_path / "all.h5", effects=requests, geometry="fine", leave_out=fewer, products=1)
    assert set(truth["effects"]) == set(EFFECTS)
    for name, told in truth["effects"].items():
        assert told["strength"] == EFFECTS[name].low and told["law"] and told["unit"] == EFFECTS[name].unit
    assert truth["effects"]["object_scatter"]["parameters"]["natural_percent"][0] > 0


def test_series_can_be_left_out_or_taken_alone_on_another_day(tmp_path):
    truth = taken(tmp_path / "less.h5", leave_out=["wedge", "near", "afterglow", "low_kV"], effects=[])
    names = list(truth["series"])
    assert names and not any(word in name for name in names for word in ("wedge", "near", "afterglow", "40kV"))
    more = taken(tmp_path / "more.h5", only=["edge"], session=1)
    kinds = Counter(told["kind"] for told in more["series"].values())
    assert set(kinds) == {"dark", "object"} and kinds["object"] == 12
    assert truth["psf_sigma_px"] == more["psf_sigma_px"]
    with pytest.raises(InputError, match="group of series: got 'pyramid'; expected one of afterglow, wedge"):
        taken(tmp_path / "none.h5", only=["pyramid"])


def test_inner_parameters_are_the_same_on_another_day(tmp_path):
    requests = [EffectRequest(id="image_lag", strength=1.0), EffectRequest(id="bad_pixels", strength=1.0)]
    days = [taken(tmp_path / f"{day}.h5", protocol="short", session=day, effects=requests)["effects"] for day in (0, 1)]
    assert days[0] == days[1]


@pytest.mark.parametrize("protocol", ["short", "products"])
def test_smaller_sessions(protocol, tmp_path):
    taken(tmp_path / "s.h5", protocol=protocol, geometry="fine")
    with open_acquisition(tmp_path / "s.h5") as session:
        kinds = Counter(series.kind for series in session.series)
        assert set(kinds) == {"dark", "flat", "object"} and kinds["object"] == 8
        averaged = {series.averaged for series in session.series if series.kind == "flat"}
        assert averaged == ({1} if protocol == "short" else {50})
        assert session.instrument.pixel_mm == 0.12
        assert {series.kV for series in session.series if series.kind == "flat"} == {30.0, 60.0}


def covariance(frames, row, column):
    left = frames - frames.mean(axis=0)
    n, rows, columns = left.shape
    return (left[:, : rows - row, : columns - column] * left[:, row:, column:]).mean() * n / (n - 1)


@pytest.mark.parametrize("averaged", [1, 4])
@pytest.mark.parametrize(("kV", "share"), [(40.0, 1.0), (90.0, 1.0), (90.0, 0.03), (90.0, 0.004)])
def test_bright_and_dim_flats_have_the_moments_of_the_closed_form(kV, share, averaged):
    geometry = GEOMETRIES["coarse"]
    quiet = {"gain_spread_percent": 0.0, "dark_spread_DN": 0.0, "dead_pixels": 0, "hot_pixels": 0}
    system = replace(
        session_system(0, rows=64, columns=64, geometry=geometry, families=()),
        kV_offset_percent=0.0,
        psf_sigma_px=0.6,
        unkindness=NONE,
        **quiet,
    )
    line = Line(system, rng=np.random.default_rng(2))
    setting = Setting(
        kV=kV, power_W=geometry.power_W[kV, True] * share, exposure_ms=100.0, filters=COPPER, averaged=averaged
    )
    arrivals = line.arrivals(setting)
    frames = np.array([frame for frame, _ in line.expose(arrivals, setting, frames=60)], dtype=float)
    truth = flat_truth(system, detector_maps(system), setting)
    dark_DN = system.dark_DN + 100.0 * system.dark_current_DN_per_ms
    sigma = system.psf_sigma_px
    independent = frames.size * aperture_share(sigma) ** 2
    # Forty energy groups keep the signal within 0.05 % of what the closed form of the same groups says.
    bound = 5 * truth["sd_DN"] / math.sqrt(independent) + 2e-4 * truth["mean_DN"]
    assert abs(frames.mean() - dark_DN - truth["mean_DN"]) < bound
    variance = truth["sd_DN"] ** 2
    assert abs(covariance(frames, 0, 0) - variance) < 6 * variance * math.sqrt(2 / independent)
    quantum = (truth["gain_DN"] - system.DN_per_electron) * truth["mean_DN"] / averaged
    for row, column in ((0, 1), (1, 0), (1, 1)):
        expected = quantum * aperture_share(sigma, row) * aperture_share(sigma, column)
        assert abs(covariance(frames, row, column) - expected) < 6 * variance / math.sqrt(independent)
    if averaged == 1:
        centred = (frames - frames.mean(axis=0)) / math.sqrt(variance)
        skewness = (centred**3).mean()
        # Skewness of a compound Poisson sum: not that of a gamma law, and of a normal law only when bright.
        assert -5 * math.sqrt(6 / independent) < skewness < 0.15
        if share < 1:
            assert skewness > 5 * math.sqrt(6 / independent)


def test_cases_have_the_shares_strengths_and_benches_that_a_blind_check_wants():
    rng = np.random.default_rng(3)
    cases = [draw_case(rng) for _ in range(3000)]
    found = Counter(case.label for case in cases)
    for label, share in LABELS.items():
        assert abs(found[label] / 3000 - share) < 5 * math.sqrt(share * (1 - share) / 3000)
    assert sum(LABELS.values()) == pytest.approx(1.0)
    strengths: dict[str, list[float]] = {}
    for case in cases:
        assert len(case.requests) == {"none": 0, "single": 1, "pair": 2, "unknown": 1}[case.label]
        for request in case.requests:
            law = EFFECTS[request.id]
            assert law.known == (case.label != "unknown")
            assert 0.999 * law.low <= abs(request.strength) <= 1.001 * law.high
            assert request.strength > 0 or law.signed
            strengths.setdefault(request.id, []).append(abs(request.strength))
    assert set(strengths) == {name for name, law in EFFECTS.items() if law.drawn}
    for name, values in strengths.items():
        law = EFFECTS[name]
        place = np.log(np.array(values) / law.low) / math.log(law.high / law.low)
        assert abs(place.mean() - 0.5) < 5 / math.sqrt(12 * place.size), name
    assert all(case.geometry == "fine" for case in cases if [r.id for r in case.requests] == ["k_fluorescence"])
    assert all(case.geometry == "coarse" for case in cases if [r.id for r in case.requests] == ["heel"])
    reduced = sum(case.protocol != "full" or bool(case.leave_out) for case in cases) / 3000
    assert reduced == pytest.approx(0.2, abs=0.04)
    assert draw_case(np.random.default_rng(9)) == draw_case(np.random.default_rng(9))
    assert draw_case(rng, label="single", names=("heel",)).requests[0].id == "heel"


def test_a_case_can_be_measured_as_it_is(tmp_path):
    case = draw_case(np.random.default_rng(0), label="pair", names=("row_noise", "image_lag"))
    sealed = tmp_path / "elsewhere" / "label.json"
    sealed.parent.mkdir()
    truth = run_protocol(
        tmp_path / "case.h5",
        seed=6,
        rows=SIZE,
        frames=4,
        products=1,
        families=(),
        truth_file=sealed,
        **case.arguments(),
    )
    assert json.loads(sealed.read_text(encoding="utf-8")) == json.loads(json.dumps(truth))
    assert not truth_path(tmp_path / "case.h5").exists()
    assert set(truth["effects"]) == {"row_noise", "image_lag"}

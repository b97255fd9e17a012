"""Poor sessions: an answer about what they allow, or one line that says what is missing; never a name they cannot carry."""

import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest

from raytwin.acquisition import open_acquisition, write_acquisition
from raytwin.checks.labels import check_labels
from raytwin.cli import main
from raytwin.diagnosis.inference.nuisances import Nuisances, Whitening
from raytwin.diagnosis.inference.observed import Observed
from raytwin.diagnosis.inference.unknown import fit_extra_variance
from raytwin.diagnosis.model.changes import LEVEL_OF_SERIES_SD, POSITION_SD_PX, catalogue_variants
from raytwin.diagnosis.problem.assemble import build_problem, map_changes
from raytwin.diagnosis.problem.series_probes import mean_frame
from raytwin.diagnosis.session.origin import made_of
from raytwin.diagnosis.session.preparation import prepare_session
from raytwin.diagnosis.session.session import measured_levels, read_session
from raytwin.generator.effects import EFFECTS, AppliedEffect
from raytwin.generator.frames.conditions import session_conditions
from raytwin.generator.frames.line_model import LineModel
from raytwin.generator.twins.twin_io import read_twin

FLAT_40, FLAT_90 = "flat_40kV_25ms_Cu0.05", "flat_90kV_25ms_Cu0.05"


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A folder with a session without effects and the twin calibrated from it."""
    folder = tmp_path_factory.mktemp("reduced")
    words = ["--protocol", "short", "--seed", "31", "--size", "48", "--frames", "10", "--products", "1"]
    assert main(["lab", "--family", "none", "-o", str(folder / "session.h5"), *words]) == 0
    assert main(["calibrate", str(folder / "session.h5"), "-o", str(folder / "twin.h5")]) == 0
    return folder


@pytest.fixture
def diagnosed(line, tmp_path, capsys):
    """Run `raytwin diagnose` on a changed copy: (exit code, answer or None, lines on standard error)."""

    def run(change, *words):
        path = tmp_path / "changed.h5"
        shutil.copy(line / "session.h5", path)
        with h5py.File(path, "r+") as file:
            change(file)
        capsys.readouterr()
        code = main(["diagnose", str(path), "-o", str(tmp_path / "answer"), "--json", *words])
        printed = capsys.readouterr()
        return code, json.loads(printed.out) if code == 0 else None, printed.err.strip().splitlines()

    return run


@pytest.mark.slow
def test_lines_move_later_means_by_chance_and_places_of_scenes_follow_no_law(line):
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=catalogue_variants())
    names = problem.names
    calibrates = np.array([problem.views[number].session.calibrates for number in problem.series_of])
    level = np.array([name.location == "whole field" for name in names])
    along_columns = np.array([name.location == "along columns" for name in names])
    displaced = {"displacement along rows", "displacement along columns"}
    seen = set()
    for curve in problem.curves:
        if curve.effect == "misregistration":
            assert {names[number].statistic for number in np.flatnonzero(curve.exact)} == displaced
        if curve.effect == "row_noise":
            share = curve.variant.parameters["column_share"]
            seen.add((share, curve.variant.since))
            assert np.all(curve.jitter[level & ~calibrates] > 0.0)
            assert np.any(curve.jitter[calibrates]) == (curve.variant.since == "always")
            # noise of rows is even along each of them
            steps = curve.jitter[along_columns & ~calibrates]
            assert np.median(steps) < 1e-3 * np.median(curve.jitter[level & ~calibrates]) or share == 1.0
    assert seen == {(share, since) for share in (0.0, 1.0) for since in ("always", "calibration")}


@pytest.mark.slow
def test_scenes_that_all_lie_elsewhere_are_seen_as_a_family_of_their_own(line):
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=())
    found = np.array([name.statistic.startswith("displacement along") for name in problem.names])
    (number,) = set(problem.families.of[found])
    assert problem.families.names[number] == "places of scenes"
    np.testing.assert_array_equal(problem.families.of == number, found)
    whitening = Whitening(problem.factors, problem.blocks)
    shared = Nuisances(whitening.factors)

    def unknown(displaced_sds):
        residual = whitening.apply((displaced_sds * found)[None, :])[0]
        seen = Observed(
            residual=residual, nuisances=shared, groups=problem.groups, places=problem.places, series=problem.series_of
        )
        return fit_extra_variance(seen, problem.families)

    assert unknown(0.0).log_evidence < 0.0
    found_there = unknown(8.0)
    assert found_there.log_evidence > 10.0
    assert found_there.place == "places of scenes"


def only(*kinds):
    def change(file):
        for name in list(file["series"]):
            if file["series"][name].attrs["kind"] not in kinds:
                del file["series"][name]

    return change


def without(*attributes):
    def change(file):
        for node in file["series"].values():
            for name in attributes:
                node.attrs.pop(name, None)

    return change


def single_frames(file):
    for node in file["series"].values():
        for name in ("frames", "time_s"):
            values = node[name][:1]
            del node[name]
            node[name] = values


def averages(file):
    for node in file["series"].values():
        frames = node["frames"][:].astype(np.float32).mean(axis=0, keepdims=True)
        count = len(node["frames"])
        for name in ("frames", "time_s"):
            del node[name]
        node["frames"] = frames
        node.attrs["averaged"] = count


def divided(line, *, held):
    """Products of a session held as `logarithms` of I/I0, as `shares` I/I0, or as `light`: I/I0 times the open field; alone."""

    def change(file):
        with h5py.File(line / "session.h5", "r") as session:
            means = {name: node["frames"][:].mean(axis=0) for name, node in session["series"].items()}
        for name, node in list(file["series"].items()):
            if node.attrs["kind"] != "object":
                del file["series"][name]
                continue
            kV, exposure = name.split("_")[1:3]
            dark = means[f"dark_{exposure}"]
            flat = means[f"flat_{kV}_{exposure}_Cu0.05"] - dark
            share = np.maximum(node["frames"][:] - dark, 1.0) / np.maximum(flat, 1.0)
            del node["frames"]
            forms = {"logarithms": -np.log(share), "shares": share, "light": share * np.median(flat)}
            node["frames"] = forms[held].astype(np.float32)
            node.attrs["corrected"] = "offset+gain+log" if held == "logarithms" else "offset+gain"

    return change


def untested(answer):
    return {item["effect"] for item in answer["not_tested"]}


@pytest.mark.parametrize(
    ("change", "mention"),
    [
        (only("flat"), "flats without a dark series"),
        (only("dark"), "no flat series that may calibrate"),
    ],
)
def test_session_that_cannot_calibrate_says_what_is_missing_and_what_a_twin_would_allow(diagnosed, change, mention):
    code, _, lines = diagnosed(change)
    assert code == 2
    assert len(lines) == 1
    assert mention in lines[0]
    assert "--twin" in lines[0]


def test_darks_alone_test_only_what_darks_can_show(diagnosed, line):
    code, answer, _ = diagnosed(only("dark"), "--twin", str(line / "twin.h5"))
    assert code == 0
    assert answer["verdict"] == "no_gap"
    assert {"object_scatter", "kv_error", "focal_spot", "nonlinearity"} <= untested(answer)
    # the instrument states counting = false: no session of this line can have pile-up or a threshold
    assert not {"row_noise", "dark_drift", "quantisation", "pile_up", "threshold_error"} & untested(answer)
    assert all(cause["probability"] < 0.5 for cause in answer["causes"])


@pytest.mark.slow
def test_single_frames_with_a_twin_are_judged_and_lines_seen_as_they_stand_in_one(diagnosed, line):
    code, answer, _ = diagnosed(single_frames, "--twin", str(line / "twin.h5"))
    assert code == 0
    assert answer["verdict"] != "explained"
    # an output that wanders shows in levels, noise of lines in the flats that the maps do not hold
    assert not {"output_drift", "row_noise"} & untested(answer)
    assert "composition_error" in untested(answer)


@pytest.mark.slow
def test_images_divided_by_their_open_field_are_compared_alike_as_light_shares_and_logarithms(diagnosed, line):
    words = ("--twin", str(line / "twin.h5"))
    answers = []
    for held in ("logarithms", "light", "shares"):
        code, answer, lines = diagnosed(divided(line, held=held), *words)
        assert code == 0
        assert not lines
        assert answer["verdict"] == "no_gap"
        # what divides out of such images cannot be judged by them
        assert {"output_drift", "filtration_error", "row_noise"} <= untested(answer)
        assert not {"focal_spot", "motion_blur", "misregistration", "object_scatter"} & untested(answer)
        answers.append(answer)
    first = answers[0]
    for other in answers[1:]:
        assert first["gap"]["before"] == pytest.approx(other["gap"]["before"], rel=0.02)
        assert first["probability_no_gap"] == pytest.approx(other["probability_no_gap"], abs=0.02)


def test_a_session_in_fractions_of_its_brightest_flat_is_refused_with_what_to_do(diagnosed):
    def change(file):
        for node in file["series"].values():
            frames = node["frames"][:] / np.float32(50_000.0)
            del node["frames"]
            node["frames"] = frames

    code, _, lines = diagnosed(change)
    assert code == 2
    assert len(lines) == 1
    assert "multiply all frames of the file by one factor, darks included, for example 10000" in lines[0]


@pytest.mark.slow
def test_one_dark_of_zeros_among_others_is_a_failure_to_read_it(diagnosed):
    def change(file):
        file["series"]["dark_25ms"]["frames"][...] = 0

    code, answer, _ = diagnosed(change)
    assert code == 0
    assert answer["warnings"] == ["dark_25ms: every pixel of every frame is 0 DN"]


@pytest.mark.slow
def test_objects_and_darks_without_flats_are_judged_with_a_twin(diagnosed, line):
    code, answer, _ = diagnosed(only("dark", "object"), "--twin", str(line / "twin.h5"))
    assert code == 0
    assert answer["verdict"] == "no_gap"
    assert not {"row_noise", "object_scatter"} & untested(answer)


@pytest.mark.slow
def test_a_session_is_compared_with_a_twin_of_its_own_as_without_one(diagnosed, line, tmp_path):
    shutil.copy(line / "session.h5", tmp_path / "plain.h5")
    with h5py.File(tmp_path / "plain.h5", "r+") as file:
        without("role")(file)
    assert main(["calibrate", str(tmp_path / "plain.h5"), "-o", str(tmp_path / "own.h5")]) == 0
    code, answer, lines = diagnosed(without("role"), "--twin", str(tmp_path / "own.h5"))
    assert code == 0
    # its darks lie closer to the twin's than their noise allows, which had been an unknown effect
    assert answer["verdict"] == "no_gap"
    assert [line for line in lines if "calibrated from series of this session" in line] == lines


def test_a_twin_knows_the_frames_it_was_made_of(line, tmp_path):
    twin = read_twin(line / "twin.h5")
    words = [
        "--protocol",
        "short",
        "--seed",
        "31",
        "--size",
        "48",
        "--frames",
        "10",
        "--products",
        "1",
        "--session",
        "1",
    ]
    assert main(["lab", "--family", "none", "-o", str(tmp_path / "later.h5"), *words]) == 0
    with open_acquisition(line / "session.h5") as acquisition:
        for kind in ("dark", "flat"):
            assert made_of(twin, acquisition.of_kind(kind))
        assert not made_of(twin, acquisition.of_kind("object"))
        # the evaluating ones are not in it
        assert not made_of(twin, [item for item in acquisition.series if item.role == "evaluation"])
    with open_acquisition(tmp_path / "later.h5") as acquisition:
        assert not made_of(twin, acquisition.series)


@pytest.mark.slow
def test_a_fading_ghost_is_no_noise_that_another_days_darks_may_lie_within(tmp_path):
    words = ["--protocol", "full", "--seed", "2942", "--size", "48", "--frames", "4", "--effect", "image_lag=2"]
    for day in ("0", "1"):
        assert main(["lab", "--family", "none", "-o", str(tmp_path / f"{day}.h5"), *words, "--session", day]) == 0
    assert main(["calibrate", str(tmp_path / "0.h5"), "-o", str(tmp_path / "twin.h5")]) == 0
    twin = read_twin(tmp_path / "twin.h5")
    with open_acquisition(tmp_path / "0.h5") as acquisition:
        assert made_of(twin, acquisition.series)
    with open_acquisition(tmp_path / "1.h5") as acquisition:
        assert not made_of(twin, acquisition.series)


@pytest.mark.slow
def test_products_at_two_exposures_tell_a_bent_line(line, tmp_path, capsys):
    session = tmp_path / "bent.h5"
    words = [
        "--protocol",
        "full",
        "--only",
        "product",
        "--seed",
        "31",
        "--session",
        "1",
        "--size",
        "48",
        "--frames",
        "10",
    ]
    assert main(["lab", "--family", "none", "-o", str(session), *words, "--effect", "nonlinearity=3@always"]) == 0
    capsys.readouterr()
    words = ["--twin", str(line / "twin.h5"), "--json"]
    assert main(["diagnose", str(session), "-o", str(tmp_path / "answer"), *words]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["verdict"] == "explained"
    # each half of the series held both exposures: what one shows of the bend the other one has too
    assert [cause["effect"] for cause in answer["causes"] if cause["probability"] > 0.6] == ["nonlinearity"]
    strength = answer["causes"][0]["parameters"]["strength"]
    assert strength["low"] < 3.0 < strength["high"]


@pytest.mark.slow
def test_the_back_layer_of_a_panel_is_no_mislabelled_front(diagnosed, line, tmp_path):
    def with_back_layer(file):
        for name in list(file["series"]):
            file["series"][name].attrs["layer"] = "front"
            file.copy(file["series"][name], file["series"], name=f"{name}_back")
            back = file["series"][f"{name}_back"]
            back.attrs["layer"] = "back"
            back["frames"][...] = back["frames"][:] // 3

    code, answer, lines = diagnosed(with_back_layer)
    assert code == 0
    assert not lines
    assert answer["verdict"] == "no_gap"
    code, _, lines = diagnosed(with_back_layer, "--layer", "back")
    assert code == 2
    assert lines == [
        "raytwin diagnose: error: --layer: got back; expected front;"
        " declare the panel's back_scintillator to work with its back layer, or take a twin of the front one"
    ]


@pytest.mark.slow
def test_a_dark_with_the_beam_on_is_found_among_objects_without_flats(diagnosed, line):
    def change(file):
        only("dark", "object")(file)
        frames = file["series"]["dark_25ms_2"]["frames"]
        frames[...] = frames[:] + 3000

    code, answer, _ = diagnosed(change, "--twin", str(line / "twin.h5"))
    assert code == 0
    assert answer["mislabelled"][0]["series"] == ["dark_25ms_2"]


def test_averaged_frames_of_darks_are_as_quiet_as_their_number_says(line, tmp_path):
    path = tmp_path / "averaged.h5"
    shutil.copy(line / "session.h5", path)
    with h5py.File(path, "r+") as file:
        averages(file)
    with open_acquisition(path) as acquisition:
        session = read_session(acquisition)
    assert {item.request.exposures_per_frame for item in session if item.series.kind == "flat"} == {10}
    assert all(item.request.exposures_per_frame == item.series.averaged for item in session)


@pytest.mark.slow
def test_session_without_kV_is_judged_by_levels_and_noise_alone(diagnosed):
    """Of one beam: flats of several voltages have gains of their own."""
    code, _, lines = diagnosed(without("kV"))
    assert code == 2
    assert len(lines) == 1
    assert "state the kV of every flat" in lines[0]

    def of_one_beam(file):
        for name in [name for name in file["series"] if "90kV" in name]:
            del file["series"][name]
        without("kV")(file)

    code, answer, _ = diagnosed(of_one_beam)
    assert code == 0
    assert answer["verdict"] == "no_gap"
    assert {"kv_error", "filtration_error", "composition_error", "focal_spot"} <= untested(answer)
    assert not {"excess_noise", "nonlinearity", "row_noise", "output_drift"} & untested(answer)
    assert any("product1" in line for line in answer["warnings"])


def test_level_without_tube_load_goes_as_the_exposure_of_the_flats_that_calibrate(line, tmp_path):
    path = tmp_path / "unloaded.h5"
    shutil.copy(line / "session.h5", path)
    with h5py.File(path, "r+") as file:
        without("power_W")(file)
    with open_acquisition(path) as acquisition:
        levels = measured_levels(acquisition.series)
    for kV in (40, 90):
        short, long = levels[f"flat_{kV}kV_25ms_Cu0.05"], levels[f"flat_{kV}kV_100ms_Cu0.05"]
        assert long / short == pytest.approx(4.0, rel=1e-12)
        assert levels[f"product1_{kV}kV_25ms"] == pytest.approx(short, rel=1e-12)
    with h5py.File(path, "r") as file:
        raw = file["series"][FLAT_40]["frames"][:].mean() - file["series"]["dark_25ms"]["frames"][:].mean()
    # the longer exposures weigh more, and the line is straight within a few tenths of a percent
    assert levels[FLAT_40] == pytest.approx(raw, rel=5e-3)


def test_levels_that_no_single_tube_load_explains_are_each_their_own(line, tmp_path):
    path = tmp_path / "several_loads.h5"
    shutil.copy(line / "session.h5", path)
    with h5py.File(path, "r+") as file:
        without("power_W")(file)
        node = file["series"]["flat_40kV_100ms_Cu0.05"]
        node["frames"][...] = node["frames"][:] // 2
    with open_acquisition(path) as acquisition:
        levels = measured_levels(acquisition.series)
    assert levels["flat_40kV_100ms_Cu0.05"] / levels[FLAT_40] < 2.5
    assert "product1_40kV_25ms" not in levels


def test_a_session_of_saturated_flats_says_so(diagnosed):
    def saturate(file):
        for node in file["series"].values():
            if node.attrs["kind"] in ("flat", "object"):
                node["frames"][...] = 65535

    code, _, lines = diagnosed(saturate)
    assert code == 2
    assert len(lines) == 1
    assert "every pixel of every frame is 65535 DN and" in lines[0]


@pytest.mark.slow
def test_series_without_light_is_left_out_and_the_rest_is_judged(diagnosed):
    def change(file):
        file["series"][f"{FLAT_40}_2"]["frames"][...] = 0

    code, answer, lines = diagnosed(change)
    assert code == 0
    assert answer["verdict"] == "no_gap"
    assert answer["warnings"] == [f"{FLAT_40}_2: every pixel of every frame is 0 DN"]
    assert lines == [f"not used: {FLAT_40}_2: every pixel of every frame is 0 DN"]


def test_lines_are_not_pictures(diagnosed):
    def change(file):
        for node in file["series"].values():
            frames = node["frames"][:, :4]
            del node["frames"]
            node["frames"] = frames
        del file["scenes"]

    code, _, lines = diagnosed(change)
    assert code == 2
    assert len(lines) == 1
    assert "frames of 4 x 48; expected at least 16 rows and columns" in lines[0]


@pytest.mark.slow
def test_a_wrong_label_is_said_first_and_the_other_series_are_judged(diagnosed, tmp_path):
    def change(file):
        one, other = (file["series"][name].attrs for name in (FLAT_40, FLAT_90))
        one["kV"], other["kV"] = 90.0, 40.0

    code, answer, lines = diagnosed(change)
    assert code == 0
    assert answer["verdict"] == "unknown_effect"
    assert all(cause["probability"] < 0.5 for cause in answer["causes"])
    assert answer["probability_no_gap"] > 0.5
    assert sum(item["probability"] for item in answer["hypotheses"]) == pytest.approx(1.0)
    assert set(answer["mislabelled"][0]["series"]) == {FLAT_40, FLAT_90}
    assert {one["code"] for one in answer["findings"]} == {"label_against_frames"}
    assert lines[0].startswith("finding: ") and "its tube voltage (" in lines[0]
    assert {f"not used: {name}: its frames contradict what it states" for name in (FLAT_40, FLAT_90)} <= set(lines)
    page = (tmp_path / "answer" / "report.html").read_text(encoding="utf-8")
    assert "Labels look wrong" in page
    assert "its tube voltage (" in page
    assert read_twin(tmp_path / "answer" / "twin.h5").effects == ()


@pytest.mark.slow
def test_what_a_session_cannot_show_is_listed_with_reasons(diagnosed):
    code, answer, _ = diagnosed(only("dark", "flat"))
    assert code == 0
    assert set(EFFECTS) >= untested(answer) >= {"object_scatter", "motion_blur", "misregistration"}
    assert all(item["reason"] for item in answer["not_tested"])


def test_times_that_begin_anew_in_every_series_follow_one_after_the_other(line, tmp_path):
    def starts(path):
        with open_acquisition(path) as acquisition:
            return [(item.request.start_s, item.request.frame_interval_ms) for item in read_session(acquisition)]

    own = tmp_path / "own_clocks.h5"
    shutil.copy(line / "session.h5", own)
    with h5py.File(own, "r+") as file:
        for node in file["series"].values():
            node["time_s"][...] -= node["time_s"][0]
    (stated_s, stated_ms), (found_s, found_ms) = (np.array(starts(path)).T for path in (line / "session.h5", own))
    np.testing.assert_allclose(found_ms, stated_ms, rtol=1e-6)
    assert np.all(np.diff(found_s) > 0.0)
    # what stands between two series is not known any more
    np.testing.assert_allclose(found_s, stated_s - stated_s[0], atol=0.5 * stated_s[-1])


def test_series_that_take_turns_frame_by_frame_are_on_one_clock(tmp_path):
    frames = np.full((8, 16, 16), 500, np.uint16)
    with write_acquisition(tmp_path / "turns.h5") as writer:
        for number, kV in enumerate((60.0, 90.0)):
            times_s = 100.0 + number + 2.0 * np.arange(8.0)
            writer.add_series(
                f"flat_{kV:g}", kind="flat", frames=frames, kV=kV, current_mA=1.0, exposure_ms=100.0, time_s=times_s
            )
    with open_acquisition(tmp_path / "turns.h5") as acquisition:
        assert [item.request.start_s for item in read_session(acquisition)] == [100.0, 101.0]


def test_beam_off_frames_follow_straight_after_the_exposure_where_no_times_are_stated(tmp_path):
    frames = np.full((4, 16, 16), 500, np.uint16)
    with write_acquisition(tmp_path / "timeless.h5") as writer:
        writer.add_series("dark", kind="dark", frames=frames, exposure_ms=100.0)
        writer.add_series("flat", kind="flat", frames=frames, kV=60.0, current_mA=1.0, exposure_ms=100.0)
        writer.add_series("after", kind="afterglow", frames=frames, exposure_ms=100.0)
        writer.add_series("later", kind="dark", frames=frames, exposure_ms=100.0)
    with open_acquisition(tmp_path / "timeless.h5") as acquisition:
        starts = {item.name: item.request.start_s for item in read_session(acquisition)}
    assert starts["after"] == pytest.approx(starts["flat"] + 0.4)
    assert starts["later"] > starts["after"] + 0.4 + 0.5


@pytest.mark.slow
def test_pauses_that_no_session_states_are_sought_with_a_lag_and_those_it_states_are_not(line, tmp_path):
    timeless = tmp_path / "timeless.h5"
    shutil.copy(line / "session.h5", timeless)
    with h5py.File(timeless, "r+") as file:
        for node in file["series"].values():
            del node["time_s"]

    def lags(path):
        wanted = [item for item in catalogue_variants() if item.effect in ("image_lag", "row_noise")]
        with open_acquisition(path) as acquisition:
            stated = {item.request.pause_stated for item in read_session(acquisition) if item.series.kind == "flat"}
            problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=wanted)
        assert any(item.effect == "row_noise" for item in problem.curves)
        return stated, [item.variant for item in problem.curves if item.effect == "image_lag"]

    (known, plain), (unknown, asking) = lags(line / "session.h5"), lags(timeless)
    assert (known, unknown) == ({True}, {False})
    assert {item.name for item in plain[0].fitted} == {item.name for item in asking[0].fitted} - {"idle_s"}
    assert len(asking) == 2 * len(plain)
    assert {item.parameters["idle_s"] for item in asking} == {1.0, 20.0}
    # whether its traps were full before is open where it came after the calibration alone
    later = [item for item in plain if item.since == "calibration"]
    assert 0 < len(later) < len(plain)
    assert all((item in later) == ("before_share" in {one.name for one in item.fitted}) for item in plain)


@pytest.mark.parametrize("bright_DN", [4100, 9000])
def test_a_saturated_series_is_not_judged_but_has_left_its_charge(tmp_path, bright_DN):
    rng = np.random.default_rng(3)
    with write_acquisition(tmp_path / "bright.h5") as writer:
        for name, kind, level in (
            ("dark", "dark", 100),
            ("dim", "flat", 2000),
            ("bright", "flat", bright_DN),
            ("after", "afterglow", 120),
        ):
            frames = np.minimum(rng.normal(level, 20.0, (6, 32, 32)), 4095).astype(np.uint16)
            beam = {"kV": 60.0, "current_mA": level / 2000.0} if kind == "flat" else {}
            writer.add_series(name, kind=kind, frames=frames, exposure_ms=100.0, **beam)
    with open_acquisition(tmp_path / "bright.h5") as acquisition:
        found = check_labels(acquisition, calibrating=frozenset(("dark", "dim", "bright")))
        assert (set(found.unusable), found.saturated) == ({"bright"}, {"bright"})
        kept = tuple(item for item in acquisition.series if item.name != "bright")
        bright = [item for item in acquisition.series if item.name == "bright"]
        with_it = read_session(replace(acquisition, series=kept), exposed=bright)
        without_it = read_session(replace(acquisition, series=kept))
    assert [item.name for item in with_it] == [item.name for item in without_it] == ["dark", "dim", "after"]
    loads = [item.request.previous[-1].setting.tube_load_mAs for item in (with_it[-1], without_it[-1])]
    assert loads == pytest.approx([bright_DN / 2e4, 0.1])
    assert session_conditions([with_it[-1].request])["after_s"] == pytest.approx(0.6)


@pytest.mark.slow
def test_a_heel_that_was_always_there_is_named_with_a_twin_from_another_session(tmp_path, capsys):
    path, twin = tmp_path / "session.h5", tmp_path / "twin.h5"
    words = ["--protocol", "full", "--seed", "2074", "--size", "48", "--frames", "10", "--products", "1"]
    assert main(["lab", "--family", "none", "-o", str(path), *words, "--effect", "heel=12@always"]) == 0
    assert main(["calibrate", str(path), "-o", str(twin)]) == 0
    with h5py.File(path, "r+") as file:
        for name, node in list(file["series"].items()):
            if node.attrs["role"] == "calibration":
                del file["series"][name]
    capsys.readouterr()
    assert main(["diagnose", str(path), "-o", str(tmp_path / "answer"), "--json", "--twin", str(twin)]) == 0
    answer = json.loads(capsys.readouterr().out)
    # each beam's flats hold the heel of their own: the mean of all of them had left a gradient in every beam
    leading = answer["causes"][0]
    assert leading["effect"] == "heel"
    assert leading["probability"] > 0.9
    assert leading["strength"]["value"] == pytest.approx(12.0, abs=2.5)


@pytest.mark.slow
def test_beams_that_no_series_calibrated_move_where_the_spectrums_lines_are_drawn(line, tmp_path):
    shutil.copy(line / "session.h5", tmp_path / "one.h5")
    with h5py.File(tmp_path / "one.h5", "r+") as file:
        for node in file["series"].values():
            if node.attrs["kind"] == "flat" and node.attrs["kV"] < 60.0:
                node.attrs["role"] = "evaluation"
    points, twins = {}, {}
    for name, path in (("both", line / "session.h5"), ("one", tmp_path / "one.h5")):
        with open_acquisition(path) as acquisition:
            prepared = prepare_session(acquisition, twin=None, rng=np.random.default_rng(1))
        points[name], twins[name] = prepared.spectral_point, prepared.twin
    assert points["both"] is None
    names = twins["one"].spectral.names
    assert points["one"].shape == (len(names),)
    of = names.index("inherent_filtration_mm_Al")
    wanted = twins["both"].spectral.best[twins["both"].spectral.names.index("inherent_filtration_mm_Al")]
    # the twin's own best filtration comes from flats of one voltage
    assert abs(points["one"][of] - wanted) < abs(twins["one"].spectral.best[of] - wanted)
    # a twin from elsewhere that knows one voltage, and a session whose own calibrating flats show both
    with open_acquisition(line / "session.h5") as acquisition:
        given = prepare_session(acquisition, twin=twins["one"], rng=np.random.default_rng(1))
    assert abs(given.spectral_point[of] - wanted) < abs(twins["one"].spectral.best[of] - wanted)
    # flats of a panel that was turned do not calibrate, nor here
    with h5py.File(tmp_path / "one.h5", "r+") as file:
        for node in file["series"].values():
            if node.attrs["kind"] == "flat" and node.attrs["kV"] < 60.0:
                node.attrs["panel_rotation_deg"] = 90.0
    with open_acquisition(tmp_path / "one.h5") as acquisition:
        turned = prepare_session(acquisition, twin=twins["one"], rng=np.random.default_rng(1))
    assert turned.spectral_point is None


@pytest.mark.slow
def test_a_change_of_the_beam_that_one_calibrated_voltage_cannot_tell_stays_a_tie(tmp_path, capsys):
    session, more = tmp_path / "session.h5", tmp_path / "more.h5"
    words = ["--seed", "2951", "--size", "64", "--effect"]
    short = ["--protocol", "products", "--leave-out", "low_kV", "--frames", "12"]
    full = ["--protocol", "full", "--session", "1", "--only", "wedge", "--only", "filtered_flats", "--frames", "12"]
    assert main(["lab", "--family", "none", "-o", str(session), *short, *words, "kv_error=-1.2"]) == 0
    assert main(["lab", "--family", "none", "-o", str(more), *full, *words, "kv_error=-1.2@always"]) == 0
    capsys.readouterr()
    assert main(["diagnose", str(session), "-o", str(tmp_path / "answer"), "--also", str(more), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    at = {cause["effect"]: cause["probability"] for cause in answer["causes"]}
    # a filtration had been named, which made up for the bent way to the other voltage
    assert at["kv_error"] > 0.3
    assert at["filtration_error"] < 0.6
    if answer["verdict"] == "ambiguous":
        assert "A change is told by what was measured before it as well" in answer["next_measurement"]["text"]


def test_what_one_effect_alone_can_make_is_a_place_of_its_own(line):
    """Noise of lines, however its law is off, makes no frame the copy of another."""
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=())
    copies = np.array([name.statistic == "repeated frames" for name in problem.names])
    assert copies.any()
    places, series = problem.places, problem.series_of
    for number in np.flatnonzero(copies):
        assert np.count_nonzero(places == places[number]) == 1
    others = [name.axis for name in problem.names]
    for number in np.flatnonzero(~copies):
        alike = np.flatnonzero(~copies & (places == places[number]))
        assert {(series[one], others[one]) for one in alike} == {(series[number], others[number])}
    # nor does a law leave its shape there; all else of a series counts as one
    apart = problem.left_apart
    assert len(set(apart)) == len(set(series)) + np.count_nonzero(copies)
    assert set(apart[copies]).isdisjoint(apart[~copies])
    assert {problem.families.names[number] for number in problem.families.exact} == {"repeated frames"}
    # of steady laws the mean frame and each kind of what frames differ by
    assert len(set(problem.aspects)) > len(set(apart))
    assert all(len(set(apart[problem.aspects == one])) == 1 for one in set(problem.aspects))


def test_probes_are_alike_where_the_same_stood_in_the_same_beam(line):
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=())
    numbers = np.unique(problem.alike[problem.alike >= 0])
    together = 0
    for number in numbers:
        members = np.flatnonzero(problem.alike == number)
        stated = [problem.views[problem.series_of[one]].session for one in members]
        together += len({one.name for one in stated}) > 1
        assert {problem.names[one].statistic for one in members} == {"mean frame"}
        assert "dark" not in {one.series.kind for one in stated}
        assert (
            len({(one.series.scene, one.series.kV, one.request.panel_rotation_deg, one.calibrates) for one in stated})
            == 1
        )
    assert together > 3


def test_nuisances_act_on_what_is_there_once_an_effect_is_found(line):
    """With a higher voltage there is more light, and more of it strays; calibrating series are as they were."""
    higher = AppliedEffect(id="kv_error", parameters={"strength": 6.0}, since="calibration")
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=())
        beside = problem.with_nuisances_beside([higher])
    before = dict(zip(problem.factor_names, problem.factors.T, strict=True))
    after = dict(zip(beside.factor_names, beside.factors.T, strict=True))
    assert set(before) == set(after)
    calibrates = np.array([problem.views[number].session.calibrates for number in problem.series_of])
    for name, column in before.items():
        np.testing.assert_array_equal(after[name][calibrates], column[calibrates])
    twin = replace(problem.base, effects=(higher,))
    seen = 0
    for number, view in enumerate(problem.views):
        request = view.session.request
        if view.session.calibrates or not request.beam_on or request.kind != "flat":
            continue
        brighter = float(np.mean(LineModel(twin, use_measured_level=False).expect(request).signal_DN)) / float(
            np.mean(view.expected.signal_DN)
        )
        assert brighter > 1.05
        level = (problem.series_of == number) & np.array([name.location == "whole field" for name in problem.names])
        name = f"level of {view.session.name}"
        np.testing.assert_allclose(after[name][level], brighter * before[name][level], rtol=0.01)
        seen += 1
    assert seen


def test_what_stands_beyond_the_borders_is_a_random_part_of_the_effect_that_brings_it_in(line, tmp_path):
    """Of a glare one number a placement of a scene, in its series' pictures alone; a twin's glare has it, too."""
    variants = [item for item in catalogue_variants() if item.effect == "veiling_glare" and item.since == "always"]
    twin, path = read_twin(line / "twin.h5"), shutil.copy(line / "session.h5", tmp_path / "two_places.h5")
    with h5py.File(path, "r+") as file:  # an object of it elsewhere
        (*_, last) = [one for one in file["series"].values() if one.attrs["kind"] == "object"]
        last.attrs["source_object_mm"] = 500.0
    with open_acquisition(path) as acquisition:
        problem = build_problem(acquisition, twin, variants=variants)
        farther = replace(variants[0], parameters={**variants[0].parameters, "length_mm": 15.0}, strengths=(2.0,))
        problem = problem.with_variants([(farther, problem.respond([farther])[0])])
        glare = AppliedEffect(
            id="veiling_glare", parameters={**variants[0].parameters, "strength": 2.0}, since="always"
        )
        (point,) = build_problem(acquisition, replace(twin, effects=(glare,)), variants=()).given
    places = [
        None
        if view.session.series.kind != "object"
        else (view.session.series.scene, view.session.request.source_object_mm)
        for view in problem.views
    ]
    first, *_, last = problem.curves
    assert first.spread.shape[1] == len({place for place in places if place is not None}) == 2
    of_maps = np.array([name.statistic == "mean frame" for name in problem.names])
    assert not np.any(first.spread[~of_maps])
    for column in first.spread.T:
        there = {places[number] for number in problem.series_of[np.flatnonzero(column)]}
        assert len(there) == 1 and None not in there
    # farther light has farther surroundings
    assert last.variant is farther and np.abs(last.spread).sum() > 1.5 * np.abs(first.spread).sum()
    assert np.linalg.norm(point.curve.spread) == pytest.approx(np.linalg.norm(first.spread), rel=0.05)


def test_what_calibration_takes_in_divides_later_frames(line):
    """A response that bends by a fifth was there when the gain map was made, at the level of its flats."""
    variant = next(
        item
        for item in catalogue_variants()
        if item.effect == "nonlinearity" and item.sign > 0 and item.since == "always"
    )
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=())
        (found,) = problem.respond([replace(variant, strengths=(20.0,))])[0]
    level = np.array([name.location == "whole field" for name in problem.names])
    factors = dict(zip(problem.factor_names, problem.factors.T, strict=True))
    bent = replace(problem.base, effects=(variant.applied(20.0),))

    def changes(view):
        """Light with the effect over that without."""
        return float(
            np.mean(LineModel(bent, use_measured_level=False).expect(view.session.request).signal_DN)
            / np.mean(view.expected.signal_DN)
        )

    taken_in = sum(
        problem.session.maps.shares[view.session.name] * changes(view)
        for view in problem.views
        if view.session.name in problem.session.maps.shares
    )
    seen = 0
    for number, view in enumerate(problem.views):
        if view.session.calibrates or view.session.series.kind != "flat":
            continue
        probes = level & (problem.series_of == number)
        of_level = factors[f"level of {view.session.name}"][probes] / LEVEL_OF_SERIES_SD
        expected = changes(view) / taken_in - 1.0
        np.testing.assert_allclose(found[probes] / of_level, expected, rtol=0.01)
        assert abs(changes(view) - taken_in) < 0.97 * abs(expected)  # subtracted, it would be less
        seen += 1
    assert seen


def test_an_effect_beside_another_is_what_it_adds_to_that_one(line):
    """A beam that a filter has weakened gains less light by a higher voltage."""
    filtered = AppliedEffect(id="filtration_error", parameters={"strength": 1.0}, since="calibration")
    variant = next(item for item in catalogue_variants() if item.effect == "kv_error" and item.sign > 0)
    variant = replace(variant, strengths=(6.0,))
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=(variant,))
        found = problem.respond([variant, replace(variant, beside=filtered)])
    level = np.array([name.location == "whole field" for name in problem.names])
    seen = 0
    for number, view in enumerate(problem.views):
        if view.session.calibrates or view.session.series.kind != "flat":
            continue

        def light(*effects, request=view.session.request):
            twin = replace(problem.base, effects=effects)
            return float(np.mean(LineModel(twin, use_measured_level=False).expect(request).signal_DN))

        more = variant.applied(6.0)
        weaker = (light(filtered, more) - light(filtered)) / (light(more) - light())
        assert weaker < 0.95
        probes = level & (problem.series_of == number)
        np.testing.assert_allclose(found[1][0, probes], weaker * found[0][0, probes], rtol=0.01)
        seen += 1
    assert seen


def test_what_registration_finds_of_a_moving_scene_is_in_its_place_and_in_no_picture_of_that_exposure(line):
    """Where in its path an object is on average is told by its place, and by pictures of exposures of another length."""
    variant = next(item for item in catalogue_variants() if item.effect == "motion_blur")
    strength, along = 8.0, 0.3
    started = replace(variant, parameters={"acceleration": 0.2, "mean_place": along}, strengths=(strength,))
    centred = replace(started, parameters={"acceleration": 0.2, "mean_place": 0.0})
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=(centred,))
        found = problem.respond([centred, started])
    difference = found[1][0] - found[0][0]
    exposures_ms = np.array([problem.views[number].session.request.exposure_ms for number in problem.series_of])
    statistics = np.array([name.statistic for name in problem.names])
    of_objects = np.array([problem.views[number].session.series.kind == "object" for number in problem.series_of])
    # the brightest series, of 100 ms, tells the place: 2.4 of the 8 px in 50 ms, twice
    (probe,) = np.flatnonzero(statistics == "displacement along rows")
    assert exposures_ms[probe] == 100.0
    assert difference[probe] == pytest.approx(along * strength * 2.0 / POSITION_SD_PX, rel=0.02)
    assert difference[statistics == "displacement along columns"] == 0.0
    pictures = of_objects & ~np.char.startswith(statistics, "displacement along")
    assert np.abs(difference[pictures & (exposures_ms == 100.0)]).max() < 1e-3
    assert np.abs(difference[pictures & (exposures_ms == 25.0)]).max() > 5.0
    assert not difference[~of_objects].any()


def test_an_output_that_wanders_since_the_calibration_leaves_the_calibrating_series_as_they_are(line):
    variants = [item for item in catalogue_variants() if item.effect == "output_drift"]
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=variants)
    calibrates = np.array([problem.views[number].session.calibrates for number in problem.series_of])
    assert {curve.variant.since for curve in problem.curves} == {"always", "calibration"}
    for curve in problem.curves:
        assert np.any(curve.spread[calibrates]) == (curve.variant.since == "always")
        assert np.any(curve.spread[~calibrates])


def test_pictures_of_scenes_that_registration_has_found_hold_no_displacement(line):
    """What explains where a scene lies is no change of its picture, which is drawn where it lies."""
    shifted, turned = (
        AppliedEffect(id="misregistration", parameters={"strength": 2.0, "rotation_deg": turned}, since="always")
        for turned in (0.0, 90.0)
    )
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=())
    placed = [number for number, one in enumerate(problem.session.series) if one.placement is not None]
    assert placed
    changes = {name: map_changes(problem, [effect]) for name, effect in (("shift", shifted), ("turn", turned))}
    for number in placed:
        assert not changes["shift"][number].any()
        assert float(np.abs(changes["turn"][number]).max()) > 1.0
    assert all(change.shape == problem.views[0].mask.shape for change in changes["turn"])


@pytest.mark.parametrize("step_DN", [0.0, 1.0])
def test_rounding_stays_in_means_of_whole_numbers_alone(line, step_DN):
    """Squares of a large panel's pixels, and frames of fractions, are not rounded."""
    with open_acquisition(line / "session.h5") as acquisition:
        problem = build_problem(acquisition, read_twin(line / "twin.h5"), variants=())
    dark = next(one for one in problem.session.series if one.session.series.kind == "dark")
    quiet = replace(
        dark, expected=replace(dark.expected, white_variance_DN2=np.full((1, 1), 0.04), quantisation_step_DN=step_DN)
    )
    shape = problem.views[0].mask.shape
    variance, usual = (
        float(np.mean(mean_frame(one, np.zeros(shape), problem.session.maps, frames=20, side=1).white_DN2))
        for one in (quiet, replace(quiet, expected=replace(quiet.expected, quantisation_step_DN=0.0)))
    )
    # 0.04 DN^2 after rounding are 0.005 before: 1/12 + 0.005 - 0.04 DN^2 stay in a mean of any length
    assert variance - usual == pytest.approx(0.048 if step_DN else 0.0, abs=0.0005)

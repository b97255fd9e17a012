"""A session of the virtual lab from calibration to validation: the twin shares no physics with what it measures."""

import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest

from raytwin.acquisition import open_acquisition, write_acquisition
from raytwin.calibration.calibrate import calibrate_twin, calibration_answer
from raytwin.calibration.validate import validate_twin
from raytwin.cli import main
from raytwin.files import sha256_of_file
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.lab.protocols import run_protocol
from raytwin.lab.unkindness import NONE


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("lab") / "session.h5"
    truth = run_protocol(path, protocol="calibration", seed=5, rows=48, columns=48, frames=8, families=())
    with open_acquisition(path) as acquisition:
        twin = calibrate_twin(
            acquisition, rng=np.random.default_rng(1), provenance={"acquisition_sha256": sha256_of_file(path)}
        )
        settings = {item.name: item.setting for item in acquisition.series}
        validation = validate_twin(twin, acquisition)
    return {"path": path, "truth": truth, "twin": twin, "settings": settings, "validation": validation}


def off_by(estimate, truth):
    """Error in standard deviations of the stated interval."""
    return (estimate["value"] - truth) / ((estimate["high"] - estimate["low"]) / 3.92)


def test_the_hidden_truth_lies_within_four_standard_deviations_of_every_answer(session):
    truth, answer = session["truth"], calibration_answer(session["twin"])
    assert abs(off_by(answer["psf_sigma_px"], truth["psf_sigma_px"])) < 4
    assert abs(off_by(answer["read_noise_DN"], truth["read_noise_DN"])) < 4
    dark = {entry["exposure_ms"]: entry["dark_DN"] for entry in truth["dark_DN_at"]}
    assert abs(off_by(answer["dark_DN"], dark[session["twin"].maps.dark_exposure_ms])) < 4
    assert abs(off_by(answer["inherent_filtration_mm_Al"], truth["inherent_filtration_mm_Al"])) < 3
    assert abs(off_by(answer["flux_scale"], truth["flux_scale"])) < 3
    for level in answer["levels"]:
        exact = next(row for row in truth["levels"] if (row["kV"], row["filter"]) == (level["kV"], level["filter"]))
        for name in ("gain_DN", "photon_transfer_slope_DN"):
            estimate = {"value": level[name], "low": level[f"{name}_low"], "high": level[f"{name}_high"]}
            assert abs(off_by(estimate, exact[name])) < 4
            assert level[name] == pytest.approx(exact[name], rel=0.1)


def _exposures_in_s(file):
    for series in file["series"].values():
        if series.attrs["kind"] == "flat":
            series.attrs["exposure_ms"] /= 1000.0


def _pitch_in_um(file):
    file["instrument"].attrs["pixel_mm"] *= 1000.0


def _powers_times_4(file):
    for series in file["series"].values():
        if "power_W" in series.attrs:
            series.attrs["power_W"] *= 4.0


@pytest.mark.slow
@pytest.mark.parametrize(("slip", "output"), [(_exposures_in_s, 1000.0), (_pitch_in_um, 1e-6), (_powers_times_4, 0.25)])
def test_labels_of_another_unit_are_named_and_bend_no_filtration_of_a_lab_line(session, tmp_path, slip, output):
    path = tmp_path / "slipped.h5"
    shutil.copy(session["path"], path)
    with h5py.File(path, "r+") as file:
        slip(file)
    with open_acquisition(path) as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(1), advise=False)
    (told,) = [text for text in twin.warnings if text.startswith("output is")]
    truth = session["truth"]
    assert float(told.split()[2]) == pytest.approx(output * truth["flux_scale"], rel=0.4)
    assert not any(text.startswith("output is") for text in session["twin"].warnings)
    found = twin.spectral.interval("inherent_filtration_mm_Al")
    assert found.low <= truth["inherent_filtration_mm_Al"] <= found.high


def test_the_lab_s_bad_pixels_are_found_and_few_others(session):
    marked = session["twin"].maps.bad_pixels > 0
    for pixel in session["truth"]["bad_pixels"]:
        assert marked[pixel["row"], pixel["column"]], pixel
    assert marked.sum() - len(session["truth"]["bad_pixels"]) <= 3


def test_held_back_settings_are_predicted_within_their_intervals(session):
    rows = session["validation"].rows
    assert len(rows) == 8
    assert all(row.role == "evaluation" and not row.used_in_calibration for row in rows)
    assert sum(row.inside_mean for row in rows) >= 7
    assert sum(row.inside_sd for row in rows) >= 7
    answer = session["validation"].to_dict()
    assert answer["median_abs_error_percent"]["mean"] < 2
    assert answer["median_abs_error_percent"]["sd"] < 2
    for row in rows:
        expected = session["truth"]["series"][row.series]
        prediction = predict_flatfield(session["twin"], session["settings"][row.series])
        assert prediction.mean_DN.value == pytest.approx(expected["mean_DN"], rel=0.06)
        assert prediction.gain_DN.value == pytest.approx(expected["gain_DN"], rel=0.1)
        assert prediction.photons_absorbed.low < expected["photons_absorbed"] < prediction.photons_absorbed.high


def test_a_single_averaged_flat_is_compared_by_its_level_alone(session, tmp_path, capsys):
    path = tmp_path / "averages.h5"
    with open_acquisition(session["path"]) as acquisition, write_acquisition(path, acquisition.instrument) as writer:
        for item in acquisition.series:
            if item.kind == "dark" or item.role == "evaluation":
                frames = np.concatenate(list(item.iter_frames()))
                mean = frames.mean(axis=0, dtype=np.float64).astype(np.float32)
                writer.add_series(
                    item.name,
                    kind=item.kind,
                    role=item.role,
                    setting=replace(item.setting, averaged=len(frames)) if item.setting else None,
                    exposure_ms=None if item.setting else item.exposure_ms,
                    frames=mean[None],
                )
    with open_acquisition(path) as acquisition:
        single = validate_twin(session["twin"], acquisition)
    for row, whole in zip(single.rows, session["validation"].rows, strict=True):
        assert row.measured_mean_DN == pytest.approx(whole.measured_mean_DN, rel=1e-4)
        assert row.measured_sd_DN is None and row.inside_sd is None
    assert single.to_dict()["median_abs_error_percent"]["sd"] is None
    session["twin"].save(tmp_path / "twin.h5")
    assert main(["validate", str(tmp_path / "twin.h5"), str(path)]) == 0
    assert "yes/-" in capsys.readouterr().out


def test_the_spectral_posterior_names_what_flats_leave_open(session):
    spectral = session["twin"].spectral
    assert any(line.startswith("log_mu_Al") for line in spectral.undetermined)
    assert session["twin"].evidence["spectrum"]["effective_draws"] > 100
    assert spectral.calibrated_kV == (40.0, 90.0)


def test_the_commands_give_the_same_twin_for_the_same_seed(session, tmp_path, json_of):
    answers = []
    for name in ("a.h5", "b.h5"):
        answers.append(json_of("calibrate", session["path"], "-o", tmp_path / name, "--seed", "3"))
    assert answers[0] == answers[1]
    shown = json_of("validate", tmp_path / "a.h5", session["path"])
    assert shown["coverage"]["rows"] == 8
    words = ["predict", str(tmp_path / "a.h5"), "--kv", "60", "--filter", "Cu:0.05", "--power-w", "40"]
    predicted = json_of(*words, "--exposure-ms", "20")
    row = next(row for row in shown["rows"] if row["kV"] == 60 and row["exposure_ms"] == 20)
    assert predicted["mean_DN"]["value"] == pytest.approx(row["mean_DN"]["value"])
    # the row's interval holds the measured series' own noise too
    assert row["mean_DN"]["high"] - row["mean_DN"]["low"] > predicted["mean_DN"]["high"] - predicted["mean_DN"]["low"]


@pytest.mark.slow
def test_a_fit_is_not_taken_for_a_prediction(session, tmp_path, capsys):
    plain = tmp_path / "plain.h5"
    shutil.copy(session["path"], plain)
    with h5py.File(plain, "r+") as file:
        for node in file["series"].values():
            node.attrs.pop("role", None)
    shown = []
    for path in (session["path"], plain):
        assert main(["calibrate", str(path), "-o", str(tmp_path / "twin.h5")]) == 0
        capsys.readouterr()
        assert main(["validate", str(tmp_path / "twin.h5"), str(path)]) == 0
        shown.append(capsys.readouterr().out)
    flats = sum(line.startswith("kv=") for line in shown[1].splitlines())
    assert "calibrated this twin" not in shown[0]
    assert f"{flats} of {flats} series calibrated this twin" in shown[1]


def test_every_spectrum_is_at_hand_before_frames_are_read(session, monkeypatch):
    # SpekPy's own tables and the maps of a large detector would not fit into 400 MB together
    from raytwin.generator.line import photon_tables
    from raytwin.spectra import tube

    stages: list[str] = []
    asked: list[tuple[str, float]] = []

    def recorded(anode, anode_angle_deg, model, kV):
        asked.append((stages[-1], kV))
        return found(anode, anode_angle_deg, model, kV)

    found = tube.packaged_fluence
    monkeypatch.setattr(tube, "packaged_fluence", recorded)
    for kept in (tube._tube_node, photon_tables._kept_fluence):
        kept.cache_clear()
    with open_acquisition(session["path"]) as acquisition:
        calibrate_twin(acquisition, rng=np.random.default_rng(2), progress=stages.append)
    assert {stage for stage, _ in asked} == {"spectra"}
    assert stages.index("spectra") < stages.index("darks")


def test_the_noise_of_a_twins_maps_is_what_a_second_day_shows(tmp_path):
    twins = []
    for day in (0, 1):
        path = tmp_path / f"day{day}.h5"
        run_protocol(
            path,
            protocol="calibration",
            seed=77,
            session=day,
            rows=64,
            columns=64,
            frames=8,
            families=(),
            unkindness=NONE,
        )
        with open_acquisition(path) as acquisition:
            twins.append(calibrate_twin(acquisition, rng=np.random.default_rng(day)))
    first, second = twins
    good = (first.maps.bad_pixels == 0) & (second.maps.bad_pixels == 0)
    electronic_DN2 = first.noise.read_noise_DN.value**2
    for exposure_ms in (first.maps.dark_exposure_ms, 5.0 * first.maps.dark_exposure_ms):
        change = (second.maps.dark_at(exposure_ms) - first.maps.dark_at(exposure_ms))[good]
        expected = electronic_DN2 * sum(twin.maps.dark_noise_at(exposure_ms) for twin in twins)
        assert np.var(change) == pytest.approx(expected, rel=0.1)
    for one, other in zip(first.levels, second.levels, strict=True):
        change = (other.flat_shape - one.flat_shape)[good]
        expected = sum(
            level.photon_transfer_slope_DN.value / (level.signal_DN * level.exposures)
            + electronic_DN2 * (1.0 / level.exposures + level.dark_noise) / level.signal_DN**2
            for level in (one, other)
        )
        # white noise that follows the signal comes on top
        assert np.var(change) == pytest.approx(expected, rel=0.15)

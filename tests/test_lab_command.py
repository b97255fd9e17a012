"""`raytwin lab`: sessions that can be read, truths that agree with each other, and bad input."""

import json

import numpy as np
import pytest

from raytwin.acquisition.acquisition_io import open_acquisition
from raytwin.cli import main
from raytwin.lab.protocols import run_protocol, system_of_seed, truth_path


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("lab") / "calibration.h5"
    truth = run_protocol(path, protocol="calibration", seed=4, rows=24, columns=32, frames=3, families=())
    return path, truth


@pytest.fixture(scope="module")
def second_set(tmp_path_factory):
    path = tmp_path_factory.mktemp("lab") / "products.h5"
    truth = run_protocol(path, protocol="set2", seed=4, rows=48, columns=64, products=4, families=())
    return path, truth


def test_a_calibration_has_darks_flats_and_settings_held_back(calibration):
    path, truth = calibration
    with open_acquisition(path) as session:
        flats = [series for series in session.series if series.kind == "flat"]
        darks = [series for series in session.series if series.kind == "dark"]
        assert {series.exposure_ms for series in darks} == {20.0, 50.0, 100.0}
        assert session.series[0].kind == session.series[-1].kind == "dark"
        for kV in (40.0, 90.0):
            powers = {
                series.power_W
                for series in flats
                if series.kV == kV and series.exposure_ms == 20.0 and series.role == "calibration"
            }
            assert powers >= {1.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0}
        held_back = [series for series in flats if series.role == "evaluation"]
        assert {series.kV for series in held_back} == {40.0, 60.0, 90.0}
        assert {series.role for series in flats} == {"calibration", "evaluation"}
        assert all(series.dtype == np.uint16 for series in session.series)
        times = [float(series.time_s[0]) for series in session.series]
        assert times == sorted(times) and len(set(times)) == len(times)
        # Without the truth, nobody can know these.
        assert session.instrument.inherent_filtration is None
        assert session.instrument.pixel_mm == 0.45
        for series in flats:
            expected = truth["series"][series.name]["mean_DN"]
            dark_DN = next(
                entry["dark_DN"] for entry in truth["dark_DN_at"] if entry["exposure_ms"] == series.exposure_ms
            )
            measured = float(np.median(series.read_frames().astype(float).mean(axis=0))) - dark_DN
            noise = truth["series"][series.name]["sd_DN"]
            # A median of 24 x 32 pixels, whose conversions and offsets differ, each blurred into its neighbours.
            assert abs(measured - expected) < 0.01 * expected + 0.4 * noise + 8.0, series.name


def test_the_truth_lies_beside_the_acquisition(calibration):
    path, truth = calibration
    written = json.loads(truth_path(path).read_text(encoding="utf-8"))
    assert written == json.loads(json.dumps(truth))
    assert truth_path(path).name == "calibration.truth.json"
    assert {"kV", "filter", "gain_DN", "photon_transfer_slope_DN"} <= set(written["levels"][0])
    for key in ("read_noise_DN", "dark_DN", "psf_sigma_px", "inherent_filtration_mm_Al", "flux_scale", "bad_pixels"):
        assert key in written


def test_a_seed_is_one_system_in_every_protocol(calibration, second_set):
    hidden = ("psf_sigma_px", "inherent_filtration_mm_Al", "kV_offset_percent", "flux_scale", "scintillator_mm")
    assert [calibration[1][key] for key in hidden] == [second_set[1][key] for key in hidden]
    assert system_of_seed(4).psf_sigma_px != system_of_seed(5).psf_sigma_px


def test_products_come_with_thickness_masks_and_names(second_set):
    path, _ = second_set
    with open_acquisition(path) as session:
        assert len(session.scenes) == 4
        boneless = 0
        for scene in session.scenes.values():
            lengths = {material: np.asarray(length) for material, length in scene.thickness_mm.items()}
            total = sum(lengths.values())
            np.testing.assert_array_equal(scene.product_mask, total > 0)
            if "rib_bone" in lengths:
                np.testing.assert_array_equal(scene.foreign_object_mask, lengths["rib_bone"] > 0)
                assert scene.foreign_object_mask.any()
                assert scene.size_mm in (2.0, 3.0) and scene.foreign_object.startswith("test_bone")
            else:
                boneless += 1
                assert not scene.foreign_object_mask.any()
            assert scene.product.startswith("test_fillet")
        assert boneless == 1
        shadowed = 0
        for series in session.series:
            if series.kind != "object":
                continue
            mask = session.scenes[series.scene].product_mask
            frame = series.read_frames()[0].astype(float)
            assert np.median(frame[mask]) < np.median(frame[~mask])
            shadowed += 1
        assert shadowed == 4 * 8


def test_the_same_seed_gives_the_same_frames_and_another_day_others(tmp_path):
    taken = {}
    for name, session in (("a", 0), ("b", 0), ("c", 1)):
        path = tmp_path / f"{name}.h5"
        truth = run_protocol(
            path, protocol="set2", seed=4, rows=24, columns=24, products=2, session=session, families=()
        )
        with open_acquisition(path) as acquisition:
            taken[name] = b"".join(series.read_frames().tobytes() for series in acquisition.series)
        taken[name + "_psf"] = truth["psf_sigma_px"]
    assert taken["a"] == taken["b"] != taken["c"]
    assert taken["a_psf"] == taken["c_psf"]


def test_the_command_prints_the_truth_as_json(tmp_path, capsys):
    words = ["lab", "-o", str(tmp_path / "s.h5"), "--protocol", "set1", "--seed", "4", "--size", "40x48"]
    words += ["--family", "none"]
    assert main([*words, "--products", "3", "--json"]) == 0
    answered = capsys.readouterr()
    assert json.loads(answered.out)["protocol"] == "set1"
    assert main([*words, "--products", "3"]) == 0
    assert "s.truth.json: the truth" in capsys.readouterr().out


@pytest.mark.slow
def test_the_command_plants_effects_and_names_them_in_the_truth(tmp_path, capsys):
    words = ["lab", "-o", str(tmp_path / "s.h5"), "--protocol", "short", "--seed", "4", "--size", "48", "--frames", "4"]
    words += ["--products", "1", "--geometry", "coarse", "--leave-out", "high_kV", "--family", "none", "--json"]
    assert main([*words, "--effect", "row_noise=0.4@calibration", "--effect", "random_telegraph=2"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["geometry"] == "coarse"
    assert {name: (one["strength"], one["since"]) for name, one in told["effects"].items()} == {
        "row_noise": (0.4, "calibration"),
        "random_telegraph": (2.0, "calibration"),
    }
    assert not any("90kV" in name for name in told["series"])
    assert main([*words, "--only", "product"]) == 0
    assert {one["kind"] for one in json.loads(capsys.readouterr().out)["series"].values()} == {"dark", "object"}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--protocol", "tomography"], "protocol: got 'tomography'; expected one of calibration, set1, set2,"),
        (["--protocol", "set1", "--size", "7"], "--size: got '7'; expected N or ROWSxCOLUMNS from 8 to 8192 pixels"),
        (["--protocol", "set1", "--size", "ax3"], "--size: got 'ax3'"),
        (["--protocol", "set1", "--product-mm", "300"], "one that fits into 52 x 66 mm, the field without its borders"),
        (["--protocol", "set2", "--bones-mm", "60"], "foreign object: got a bone of 60 mm"),
        (["--protocol", "set2", "--bones-mm", "x"], "--bones-mm: got 'x'"),
        (["--protocol", "calibration", "--frames", "1"], "frames: got 1; expected 2 or more"),
        (["--protocol", "set1", "--pixel-mm", "nan"], "--pixel-mm: got nan mm"),
        (["--protocol", "set1", "--seed", "-1"], "--seed: got -1"),
        (
            ["--protocol", "set1", "--effect", "image_lag=2@always", "--effect", "row_noise=1"],
            "got image_lag=2@always, row_noise=1; expected nothing: it belongs to a long session (full, short or products)",
        ),
        (["--protocol", "full", "--effect", "lag=2"], "effect: got 'lag'; expected an effect's id, such as image_lag"),
        (["--protocol", "full", "--effect", "image_lag"], "--effect: got 'image_lag'; expected ID=STRENGTH; write ID="),
        (["--protocol", "full", "--effect", "image_lag=x"], "--effect: got 'image_lag=x'; expected ID=STRENGTH"),
        (["--protocol", "full", "--effect", "image_lag=99"], "strength of image_lag: got 99 %; expected 0.02 to 5 %"),
        (["--protocol", "full", "--effect", "image_lag=1@noon"], "onset of image_lag: got 'noon'; expected always or"),
        (["--protocol", "full", *2 * ["--effect", "image_lag=1"]], "effects: got image_lag twice; expected each"),
        (["--protocol", "full", "--size", "32"], "expected 48x48 pixels or more for the protocol full"),
        (["--protocol", "full", "--geometry", "round"], "geometry: got 'round'; expected one of fine, coarse"),
        (["--protocol", "short", "--frames", "3"], "frames: got 3; expected 4 or more"),
        (["--protocol", "products", "--products", "0"], "products: got 0; expected 1 or more"),
        (["--protocol", "full", "--pixel-mm", "0.2"], "it belongs to a set of products or a calibration"),
        (["--protocol", "set1", "--geometry", "fine"], "it belongs to a long session (full, short or products)"),
        (["--protocol", "set1", "--source-detector-mm", "-4"], "--source-detector-mm: got -4 mm"),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(words, line, tmp_path, refused_line):
    assert line in refused_line("lab", "-o", tmp_path / "s.h5", *words)
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_cannot_be_written_is_bad_input(tmp_path, refused_line):
    (tmp_path / "file").write_text("")
    assert "expected a file in a folder of yours" in refused_line(
        "lab", "-o", tmp_path / "file" / "s.h5", "--protocol", "set1", "--products", "2"
    )

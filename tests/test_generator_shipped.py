"""Calibrations that come with raytwin: found by name, small, and true to the lab that made them."""

import json

import pytest

from raytwin.acquisition import Setting, filters_from_text
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.generator.twins.shipped import FOLDER, shipped_calibration, shipped_calibrations
from raytwin.generator.twins.twin_io import read_twin


def test_what_is_shipped_is_small_listed_and_described():
    found = shipped_calibrations()
    assert set(found) == {"flexray_2024", "virtual_lab"}
    readme = (FOLDER / "README.md").read_text(encoding="utf-8")
    for path in found.values():
        assert path.stat().st_size < 300_000
        assert path.name in readme


def test_the_shipped_twin_predicts_the_lab_s_own_expectation():
    """The lab's truth for seed 2024 at two settings that its calibration did not hold, DN above dark and noise."""
    from raytwin.lab.protocols import system_of_seed
    from raytwin.lab.system import detector_maps
    from raytwin.lab.truth import flat_truth

    twin = read_twin(shipped_calibration("virtual_lab"))
    system = system_of_seed(2024, rows=64, columns=64, pixel_mm=0.45, families=())
    for kV, power_W, filters in ((60.0, 40.0, "Cu:0.05"), (90.0, 20.0, "Al:1")):
        setting = Setting(kV=kV, power_W=power_W, exposure_ms=20.0, filters=filters_from_text(filters))
        truth = flat_truth(system, detector_maps(system), setting)
        found = predict_flatfield(twin, setting)
        assert found.mean_DN.value == pytest.approx(truth["mean_DN"], rel=0.03)
        assert found.sd_DN.value == pytest.approx(truth["sd_DN"], rel=0.03)


def test_commands_take_a_shipped_twin_by_name(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["--kv", "60", "--power-w", "30", "--exposure-ms", "20", "--filter", "Cu:0.05", "--json"]
    assert main(["predict", "virtual_lab", *arguments]) == 0
    by_name = json.loads(capsys.readouterr().out)
    assert main(["predict", str(shipped_calibrations()["virtual_lab"]), *arguments]) == 0
    assert json.loads(capsys.readouterr().out) == by_name
    assert by_name["mean_DN"]["value"] > 0


def test_a_name_that_is_no_twin_is_refused(capsys):
    with pytest.raises(
        InputError, match="got virtual_lap; expected one of the shipped twins, virtual_lab; did you mean"
    ):
        shipped_calibration("virtual_lap")
    with pytest.raises(InputError, match="a published description without flats"):
        shipped_calibration("flexray_2024")
    with pytest.raises(SystemExit) as ended:
        main(["predict", "flexray_2024", "--kv", "60", "--power-w", "30", "--exposure-ms", "20"])
    assert ended.value.code == 2
    assert "a published description without flats" in capsys.readouterr().err

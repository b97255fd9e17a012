"""Whether two instruments can be one."""

import pytest

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.cli import main

STATED = {"pixel_mm": 0.4, "bits": 14, "anode": "W", "counting": False}


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"pixel_mm": 0.45}, ("pixels of 0.45 mm", "0.4 mm")),
        ({"bits": 16}, ("16 bits", "14 bits")),
        ({"anode": "Mo"}, ("an anode of Mo", "an anode of W")),
        ({"counting": True}, ("counting = True", "counting = False")),
        ({"pixel_mm": 0.4015}, None),
        ({"pixel_mm": None, "bits": None, "anode": None, "counting": None}, None),
        # what a setting or a table may change
        ({"source_detector_mm": 700.0, "maximum_power_w": 10.0}, None),
    ],
)
def test_what_both_state_and_no_setting_changes_tells_them_apart(other, said):
    assert Instrument(**STATED).unlike(Instrument(**{**STATED, **other})) == said


def test_a_twin_of_another_line_is_refused(tmp_path, capsys):
    words = ["--seed", "12", "--size", "48", "--frames", "6"]
    assert main(["lab", "-o", str(tmp_path / "line.h5"), "--protocol", "calibration", *words]) == 0
    assert main(["calibrate", str(tmp_path / "line.h5"), "-o", str(tmp_path / "twin.h5")]) == 0
    with open_acquisition(tmp_path / "line.h5") as acquisition:
        pitch_mm = acquisition.instrument.pixel_mm
    # long sessions have pixels of their own
    assert main(["lab", "-o", str(tmp_path / "later.h5"), "--protocol", "short", "--products", "1", *words]) == 0
    for command in (
        ["diagnose", str(tmp_path / "later.h5"), "-o", str(tmp_path / "answer"), "--twin", str(tmp_path / "twin.h5")],
        ["validate", str(tmp_path / "twin.h5"), str(tmp_path / "later.h5")],
    ):
        capsys.readouterr()
        assert main(command) == 2
        said = capsys.readouterr().err.strip()
        assert "\n" not in said
        assert "pixels of 0.4 mm" in said
        assert f"expected the twin's: {pitch_mm:g} mm" in said
    assert not (tmp_path / "answer").exists() or not list((tmp_path / "answer").iterdir())

"""Whether two instruments can be one."""

import numpy as np
import pytest

from raytwin.acquisition import write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.twins.twin_io import write_twin

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


def test_a_twin_of_another_line_is_refused(make_model_twin, tmp_path, capsys):
    shape = (48, 48)
    write_twin(tmp_path / "twin.h5", make_model_twin(shape, pixel_mm=0.45))
    rng = np.random.default_rng(0)
    with write_acquisition(tmp_path / "later.h5", Instrument(pixel_mm=0.4, bits=16)) as writer:
        for name, kind, level in (("dark", "dark", 1200.0), ("flat", "flat", 5000.0), ("again", "flat", 5000.0)):
            frames = np.rint(rng.normal(level, 20.0, (6, *shape))).astype(np.uint16)
            beam = {"kV": 40.0, "power_W": 20.0} if kind == "flat" else {}
            writer.add_series(name, kind=kind, frames=frames, exposure_ms=20.0, **beam)
    for command in (
        ["diagnose", str(tmp_path / "later.h5"), "-o", str(tmp_path / "answer"), "--twin", str(tmp_path / "twin.h5")],
        ["validate", str(tmp_path / "twin.h5"), str(tmp_path / "later.h5")],
    ):
        capsys.readouterr()
        assert main(command) == 2
        said = capsys.readouterr().err.strip()
        assert "\n" not in said
        assert "pixels of 0.4 mm" in said
        assert "expected the twin's: 0.45 mm" in said
    assert not (tmp_path / "answer").exists() or not list((tmp_path / "answer").iterdir())


@pytest.mark.parametrize(
    ("stated", "line"),
    [
        ({"threshold_keV": 20.0, "counting": False}, "no threshold, or counting = true"),
        ({"threshold_keV": 20000.0, "counting": True}, "got 20000 keV; expected 0 to 80 keV"),
        ({"threshold_keV": -1.0, "counting": True}, "threshold_keV: got -1"),
    ],
)
def test_a_threshold_is_a_counter_s_and_in_keV(stated, line):
    with pytest.raises(InputError, match=line):
        Instrument(**stated)

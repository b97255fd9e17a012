"""`raytwin diagnose --also`: what was measured later joins the session behind it in time, and calibrates nothing."""

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition, write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.series_roles import calibrating_names
from raytwin.acquisition.sessions import continued_session
from raytwin.acquisition.setting import setting_from_text


def write(path, *, kinds, role="calibration", pixel_mm=0.4):
    """A small file with series of two frames, one second apart."""
    frames = np.full((2, 8, 8), 100, dtype=np.uint16)
    with write_acquisition(path, Instrument(pixel_mm=pixel_mm)) as writer:
        for number, kind in enumerate(kinds):
            setting = (
                {"exposure_ms": 25.0} if kind == "dark" else {"setting": setting_from_text("kv=40,exposure_ms=25")}
            )
            series = writer.add_series(
                f"{kind}_{number}", kind=kind, shape=(8, 8), dtype=np.uint16, role=role, **setting
            )
            series.append(frames, time_s=[10.0 * number, 10.0 * number + 1.0])
    return path


def test_later_measurements_come_last_in_time_and_calibrate_nothing(tmp_path):
    first = write(tmp_path / "first.h5", kinds=["dark", "flat"])
    more = write(tmp_path / "more.h5", kinds=["dark", "flat"])
    with continued_session([open_acquisition(path) for path in (first, more, more)]) as found:
        starts = [float(item.time_s[0]) for item in found.series]
        assert starts == sorted(starts)
        assert starts[2] > 3000.0
        assert starts[4] > starts[3] + 3000.0
        assert len({item.name for item in found.series}) == 6
        assert [item.role for item in found.series] == ["calibration"] * 2 + ["evaluation"] * 4
        assert calibrating_names(found.series) == {"dark_0", "flat_1"}


def test_sessions_of_another_detector_do_not_join(tmp_path, refused_line):
    first = write(tmp_path / "first.h5", kinds=["dark", "flat"])
    other = write(tmp_path / "other.h5", kinds=["dark"], pixel_mm=0.2)
    assert "pixel_mm" in refused_line("diagnose", first, "-o", tmp_path / "no", "--also", other)


@pytest.mark.parametrize("name", ["missing.h5"])
def test_a_file_that_is_not_there_is_named(tmp_path, refused_line, name):
    first = write(tmp_path / "first.h5", kinds=["dark", "flat"])
    assert name in refused_line("diagnose", first, "-o", tmp_path / "no", "--also", tmp_path / name)

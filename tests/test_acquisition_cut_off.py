import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.cut_off import share_of_zeros, without_cut_off_darks

_SHAPE = (6, 20, 30)


def written(path, frames_of, **series):
    """An open acquisition of series: name -> (kind, frames, what else the series says)."""
    with write_acquisition(path) as writer:
        for name, (kind, frames, said) in series.items():
            writer.add_series(name, kind=kind, exposure_ms=20.0, frames=frames_of(frames), **said)
    return open_acquisition(path)


def as_written(frames):
    """Unsigned whole numbers, as a camera writes them."""
    return np.clip(np.round(frames), 0, 65535).astype(np.uint16)


def around(level_DN, sd_DN=4.0):
    return level_DN + sd_DN * np.random.default_rng(5).standard_normal(_SHAPE)


@pytest.mark.parametrize(
    ("level_DN", "sd_DN", "share"), [(0.0, 4.0, 0.55), (4.0, 4.0, 0.19), (100.0, 4.0, 0.0), (0.0, 0.0, 1.0)]
)
def test_zeros_are_counted(tmp_path, level_DN, sd_DN, share):
    with written(tmp_path / "a.h5", as_written, dark=("dark", around(level_DN, sd_DN), {})) as acquisition:
        assert share_of_zeros(acquisition.series[0]) == pytest.approx(share, abs=0.03)


def test_negative_numbers_say_that_nothing_was_cut_off(tmp_path):
    frames = np.round(around(0.0))
    with written(tmp_path / "a.h5", np.float32, dark=("dark", frames, {})) as acquisition:
        assert share_of_zeros(acquisition.series[0]) == 0.0
        assert without_cut_off_darks(acquisition) == (acquisition, ())


def test_darks_and_afterglows_that_were_cut_off_are_left_out_and_the_rest_is_offset_corrected(tmp_path):
    with written(
        tmp_path / "a.h5",
        as_written,
        dark=("dark", around(0.0), {}),
        flat=("flat", around(3000.0), {}),
        afterglow=("afterglow", around(1.0), {}),
    ) as acquisition:
        found, said = without_cut_off_darks(acquisition)
        assert [(item.name, item.corrected) for item in found.series] == [("flat", {"offset"})]
        assert len(said) == 1
        assert said[0].startswith("dark, afterglow: 43 to 53 % of their numbers are 0")
        assert "frames count as `corrected` for `offset`" in said[0]
        # the file's own are as they were
        assert [item.corrected for item in acquisition.series] == [frozenset()] * 3


@pytest.mark.parametrize("later_DN", [0.0, 40.0])
def test_darks_that_drifted_later_do_not_make_the_calibrating_ones_readable(tmp_path, later_DN):
    with written(
        tmp_path / "a.h5",
        as_written,
        dark=("dark", around(0.0), {"role": "calibration"}),
        flat=("flat", around(3000.0), {"role": "calibration"}),
        later=("dark", around(later_DN), {"role": "evaluation"}),
    ) as acquisition:
        found, said = without_cut_off_darks(acquisition)
        assert {item.name: item.corrected for item in found.series} == {"flat": {"offset"}} | (
            {"later": {"offset"}} if later_DN else {}
        )
        # the later one, where it was cut off too, is named in the same line
        assert [("later" in line) for line in said] == [not later_DN]


def test_one_readable_dark_is_an_offset_that_is_still_there(tmp_path):
    with written(
        tmp_path / "a.h5",
        as_written,
        short=("dark", around(0.0), {}),
        long=("dark", around(100.0), {}),
        flat=("flat", around(3000.0), {}),
    ) as acquisition:
        found, said = without_cut_off_darks(acquisition)
        assert [(item.name, item.corrected) for item in found.series] == [("long", frozenset()), ("flat", frozenset())]
        assert len(said) == 1
        assert said[0].startswith("short: 53 % of its numbers are 0")
        assert "corrected" not in said[0]


def test_many_series_that_were_cut_off_are_one_line(tmp_path):
    darks = {f"dark{number}": ("dark", around(0.0), {}) for number in range(9)}
    with written(tmp_path / "a.h5", as_written, **darks) as acquisition:
        _, said = without_cut_off_darks(acquisition)
        assert said[0].startswith("dark0, dark1, dark2, dark3 and 5 more: 53 % of their numbers")


def test_a_panel_that_counts_has_silent_darks_and_loses_nothing(tmp_path):
    counts = np.random.default_rng(6).poisson(0.01, _SHAPE)
    with written(
        tmp_path / "a.h5", as_written, dark=("dark", counts, {}), flat=("flat", around(50.0), {})
    ) as acquisition:
        assert share_of_zeros(acquisition.series[0]) > 0.97
        assert without_cut_off_darks(acquisition) == (acquisition, ())

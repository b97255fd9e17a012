"""`raytwin check`: what is broken is told in one line of the right series; what is good is not suspected; damage is told."""

import json
import math
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import tifffile

from raytwin.acquisition import open_acquisition
from raytwin.calibration import frame_signs
from raytwin.calibration.check import check_acquisition
from raytwin.calibration.findings import Finding, FindingCode
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.twins.twin_io import write_twin

FOLDER = Path(__file__).parents[1] / "validation"


@pytest.fixture(scope="module")
def broken():
    sys.path.insert(0, str(FOLDER))
    try:
        yield import_module("broken_sessions")
    finally:
        sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def session(broken, tmp_path_factory):
    path = tmp_path_factory.mktemp("session") / "session.h5"
    broken.write(path, broken.good_session(broken.panel_of(7)))
    return path


# the rest of the forty is run by validation/broken_sessions.py
@pytest.mark.parametrize(
    "name",
    [
        "moved_table",
        "averaged_rounded",
        "lossy_compression",
        "two_rows_swapped",
        "kV_of_two_beams_exchanged",
        "value_that_is_no_number",
    ],
)
def test_a_broken_session_is_told_in_one_line_and_nothing_else_is(broken, name):
    outcome = broken.run_case(name, seed=3, calibrate=False)
    assert outcome.right
    assert not outcome.others


def test_a_good_session_is_not_suspected_and_its_series_serve(session):
    result = check_acquisition(session)
    assert result.counts == {"error": 0, "warning": 0, "note": 0}
    assert all(row.serves_for for row in result.series)
    possible = {item.what for item in result.allows if item.possible}
    assert {"dark level", "read noise", "gain, blur and photons a pixel", "linearity"} <= possible
    assert {"spectrum: other kV and filters", "output of the tube, dose"} <= possible
    assert "lag" not in possible
    assert len(repr(result).splitlines()) <= 20


def test_the_json_answer_holds_what_scripts_read(session, capsys):
    assert main(["check", str(session), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert {"series", "findings", "allows", "next_measurements"} <= set(answer)
    assert {"name", "kind", "setting", "frames", "serves_for"} <= set(answer["series"][0])


def test_every_code_has_a_sentence_of_its_values():
    values = dict.fromkeys(
        [
            "what",
            "shape",
            "other",
            "other_shape",
            "frame",
            "how",
            "percent",
            "count",
            "frames",
            "first",
            "origin",
            "value",
            "top",
            "level",
            "dark",
            "low",
            "high",
            "declared",
            "step",
            "rows",
            "columns",
            "second",
            "quantity",
            "fits",
            "unit",
            "kV",
            "other_kV",
            "filters",
            "other_filters",
            "gap",
            "usual",
            "interval_ms",
            "exposure_ms",
        ],
        1.0,
    )
    for code in FindingCode:
        found = Finding(code=code, values=values)
        assert found.text and set(found.to_dict()) == {"code", "series", "text", "severity"}


def test_a_file_that_is_damaged_in_one_series_is_checked_in_the_others(broken, session, tmp_path):
    path = tmp_path / "damaged.h5"
    path.write_bytes(session.read_bytes())
    broken.set_attribute(broken.VICTIM, "kind", "flaat")(path)
    result = check_acquisition(path)
    assert [item.code for item in result.findings] == [FindingCode.DAMAGED]
    assert "flaat" in result.findings[0].text
    with open_acquisition(session) as whole:
        assert len(result.series) == len(whole.series) - 1


def test_what_is_no_measurement_is_one_finding_or_one_line(tmp_path, capsys):
    text = tmp_path / "notes.txt"
    text.write_text("not HDF5")
    assert [item.code for item in check_acquisition(text).findings] == [FindingCode.DAMAGED]
    with pytest.raises(InputError, match="no such file"):
        check_acquisition(tmp_path / "absent.h5")
    assert main(["check", str(tmp_path / "absent.h5")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_bare_images_get_a_draft_of_a_sidecar(tmp_path, capsys):
    rng = np.random.default_rng(0)
    for name, level in (("di0001", 300), ("io0001", 9000), ("io0002", 9000), ("scan_0001", 6000)):
        tifffile.imwrite(tmp_path / f"{name}.tif", rng.poisson(level, (8, 9)).astype(np.uint16))
    assert main(["check", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    for line in ('kind = "dark"', 'files = "di0001.tif"', 'kind = "flat"', 'files = "io*.tif"', 'kind = "object"'):
        assert line in told
    result = check_acquisition(tmp_path)
    assert [item.code for item in result.findings] == [FindingCode.NO_SIDECAR]


def test_a_twin_tells_its_levels(series_line, tmp_path):
    write_twin(tmp_path / "twin.h5", series_line)
    result = check_acquisition(tmp_path / "twin.h5")
    assert result.what == "twin"
    assert len(result.series) == len(series_line.levels)


def test_code_steps_averages_zeros_and_tops_are_read_off_the_numbers():
    rng = np.random.default_rng(1)
    whole = np.rint(1000.0 + 30.0 * rng.standard_normal((50, 50)))
    assert frame_signs.code_step(whole.astype(np.uint16)) is None
    assert frame_signs.code_step((16 * whole).astype(np.uint16)) == 16.0
    mean = np.mean([np.rint(1000.0 + 30.0 * rng.standard_normal((50, 50))) for _ in range(10)], axis=0)
    assert frame_signs.averaged_by_codes(mean.astype(np.float32)) == 10
    assert frame_signs.averaged_by_codes(rng.standard_normal((50, 50)).astype(np.float32)) is None
    assert frame_signs.share_at_zero(np.clip(whole - 1000.0, 0, None)) == pytest.approx(0.5, abs=0.05)
    assert frame_signs.share_at_zero(whole) is None
    assert frame_signs.pile_up_at_top(np.minimum(whole, 1030.0)) == pytest.approx((1030.0, 0.16), abs=0.02)
    assert frame_signs.pile_up_at_top(whole) is None


@pytest.mark.parametrize(("pixels", "field", "raw"), [(0.0, 0.0, False), (0.006, 0.0, True), (0.001, 0.005, True)])
def test_frames_are_even_where_neither_pixels_nor_the_field_differ(pixels, field, raw):
    """A CCD's pixels respond alike to a tenth of a per cent, and even light is not that even."""
    rng = np.random.default_rng(2)
    shape, frames = (80, 100), 8
    response = 1.0 + pixels * rng.standard_normal(shape) + field * np.linspace(-1.7, 1.7, shape[1])
    taken = 2000.0 * response + 10.0 * rng.standard_normal((frames, *shape))
    found = frame_signs.most_uneven(taken.mean(axis=0), np.diff(taken, axis=0), frames)
    assert found > math.hypot(pixels, field) * 0.9
    assert (found > 0.003) == raw

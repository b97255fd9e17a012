"""`raytwin check`: what is broken is told in one line of the right series; what is good is not suspected; damage is told."""

import math
import re
import sys
import tomllib
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from raytwin import calibrate
from raytwin.acquisition import open_acquisition, write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.checks import frame_signs
from raytwin.checks.check import check_acquisition
from raytwin.checks.check_series import _lifted_by_light
from raytwin.checks.findings import Finding, FindingCode
from raytwin.checks.frame_signs import pile_up_at_top
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


@contextmanager
def copy_of(session, folder):
    """A copy of a session, and its file to change."""
    path = folder / "session.h5"
    path.write_bytes(session.read_bytes())
    with h5py.File(path, "r+") as file:
        yield path, file


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


def test_products_are_reference_images_and_test_objects_of_known_thickness_are_not(tmp_path):
    path, rng = tmp_path / "objects.h5", np.random.default_rng(5)
    with write_acquisition(path, Instrument()) as writer:
        writer.add_scene("wedge", kind="wedge", thickness_mm={"Al": np.full((24, 24), 2.0)})
        writer.add_scene("fish", kind="product")
        for scene in ("wedge", "fish"):
            for kV in (40.0, 90.0):
                frames = rng.normal(3000.0 + kV, 20.0, (3, 24, 24)).astype(np.uint16)
                writer.add_series(
                    f"{scene}_{kV:g}",
                    kind="object",
                    frames=frames,
                    kV=kV,
                    current_mA=1.0,
                    exposure_ms=20.0,
                    scene=scene,
                )
    result = check_acquisition(path)
    served = {row.name: row.serves_for for row in result.series}
    assert served["wedge_40"] == ("attenuation and scatter",)
    assert served["fish_40"] == ("reference images",)
    allowed = {item.what: item for item in result.allows}
    assert allowed["reference images for two energies"].why == "1 pair"
    assert allowed["attenuation and scatter"].why == "wedge_40, wedge_90"


@pytest.fixture
def panel_of_bad_pixels(broken, tmp_path):
    """A session with pixels stuck at full scale and wildly noisy ones, and one flat that saturates."""
    rng = np.random.default_rng(8)
    stuck, noisy = np.zeros((2, *broken.SHAPE), dtype=bool)
    stuck.flat[rng.choice(stuck.size, 12, replace=False)] = True
    noisy.flat[rng.choice(stuck.size, 8, replace=False)] = True
    series = []
    for one in broken.good_session(broken.panel_of(7)):
        frames = one.frames + np.where(noisy, 900.0 * rng.standard_normal(one.frames.shape), 0.0)
        if one.name == broken.BRIGHT:
            frames[:, 40:60, 40:60] = broken.FULL_DN
        frames = np.where(stuck, broken.FULL_DN, np.clip(np.rint(frames), 0, broken.FULL_DN))
        series.append(replace(one, frames=frames.astype(np.uint16)))
    broken.write(tmp_path / "session.h5", series)
    return tmp_path / "session.h5"


@pytest.mark.slow
def test_stuck_and_wildly_noisy_pixels_make_no_flat_saturated_and_no_scene_change(broken, panel_of_bad_pixels):
    """Both show in the darks, and no panel is without them; a flat that saturates is told all the same."""
    found = [(finding.code, finding.series) for finding in check_acquisition(panel_of_bad_pixels).findings]
    assert found == [(FindingCode.SATURATED, broken.BRIGHT)]


def test_pixels_that_stand_at_the_top_alone_are_stuck_and_areas_are_lit():
    """Without a dark that shows them: they came up in the session."""
    frames = 2600.0 + 30.0 * np.random.default_rng(4).standard_normal((6, 40, 50))
    for row, column in ((5, 7), (20, 30), (39, 49)):
        frames[:, row, column] = 13106.0
    frames[:, 12, :] = 13106.0  # a line
    assert pile_up_at_top(_lifted_by_light(np.rint(frames), None)) is None
    frames[:, 25:31, 10:18] = 13106.0
    top, share = pile_up_at_top(_lifted_by_light(np.rint(frames), None))
    assert (top, share) == (13106.0, pytest.approx(48 / 2000, rel=0.1))


@pytest.mark.slow
def test_calibration_leaves_out_the_flat_that_saturates_and_not_those_with_stuck_pixels(broken, panel_of_bad_pixels):
    twin = calibrate(panel_of_bad_pixels)
    assert [line for line in twin.warnings if "left out" in line] == [
        f"left out of the fit: {broken.BRIGHT} (saturated at {broken.FULL_DN} DN)"
    ]
    assert all(level.gain_DN.low < broken.GAIN_DN < level.gain_DN.high for level in twin.levels)


@pytest.mark.parametrize(
    ("changed", "series", "text"),
    [
        ({"filter": "steel:0.5"}, True, r"filter: got steel:0\.5; expected .* nearest: steel_304"),
        ({"kV": 40000.0}, True, r"kV: got 40000 kV; expected 10 to 300 kV"),
        ({"anode": "tungsten"}, False, r"anode: got 'tungsten'; expected one of W, Mo"),
        ({"scintillator": "Csi:0.5+glue:1"}, False, r"scintillator: got .*glue:1.*"),
    ],
)
def test_words_that_nobody_knows_are_told_as_they_were_written(broken, session, tmp_path, changed, series, text):
    with copy_of(session, tmp_path) as (path, file):
        (file[f"series/{broken.VICTIM}"] if series else file["instrument"]).attrs.update(changed)
    (found,) = (item for item in check_acquisition(path).findings if item.severity == "error")
    assert found.code == FindingCode.UNKNOWN and found.series == (broken.VICTIM if series else "")
    assert re.search(text, found.text)


def test_a_label_whose_case_is_wrong_is_no_missing_label(broken, session, tmp_path):
    with copy_of(session, tmp_path) as (path, file):
        labels = file[f"series/{broken.VICTIM}"].attrs
        labels["kv"] = labels["kV"]
        del labels["kV"]
    with pytest.raises(InputError, match=r"attribute kv: got 'kv'; expected kV, written like that"):
        open_acquisition(path)


def test_flats_of_two_voltages_that_nobody_states_are_no_beam(broken, session, tmp_path):
    with copy_of(session, tmp_path) as (path, file):
        for item in file["series"].values():
            item.attrs.pop("kV", None)
    told = [item for item in check_acquisition(path).findings if item.severity != "note"]
    assert [item.code for item in told] == [FindingCode.NO_KV]
    with pytest.raises(InputError, match=r"flats without kV: got \d+ to \d+ DN a mAs; .* state the kV of every flat"):
        calibrate(path)


def test_flats_that_calibrate_nothing_are_told(broken, session, tmp_path):
    with copy_of(session, tmp_path) as (path, file):
        for item in file["series"].values():
            if item.attrs["kind"] == "flat":
                item.attrs["corrected"] = "offset+gain"
    result = check_acquisition(path)
    assert FindingCode.CORRECTED_FLATS in {item.code for item in result.findings}
    assert not any(item.possible for item in result.allows if item.what.startswith(("gain", "spectrum", "linearity")))


def test_lines_of_a_line_camera_are_told_to_be_stacked(broken, tmp_path):
    path = tmp_path / "session.h5"
    lines = [replace(one, frames=one.frames[:, :1]) for one in broken.good_session(broken.panel_of(7))]
    broken.write(path, lines)
    result = check_acquisition(path)
    small = [item for item in result.findings if item.code == FindingCode.SMALL]
    assert len(small) == len(lines) and "stack lines" in small[0].text
    assert not any(row.serves_for for row in result.series)


def test_a_series_of_another_shape_is_told_and_not_those_it_differs_from(session, tmp_path):
    with copy_of(session, tmp_path) as (path, file):
        order = sorted(file["series"], key=lambda name: int(file["series"][name].attrs["index"]))
        group = file["series"][order[0]]
        frames = group["frames"][()][:, :-2]
        del group["frames"]
        group["frames"] = frames
    found = check_acquisition(path).findings
    assert [item.series for item in found if item.code is FindingCode.SHAPES] == [order[0]]


def test_the_json_answer_holds_what_scripts_read(session, json_of):
    answer = json_of("check", session)
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
            "signal",
            "reached",
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
    product = np.where(np.arange(9) < 4, 0.6, 1.0)
    for name, level in (("di0001", 300), ("io0001", 9000), ("io0002", 9000), ("scan_0001", 9000 * product)):
        tifffile.imwrite(tmp_path / f"{name}.tif", rng.poisson(level, (8, 9)).astype(np.uint16))
    assert main(["check", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    for line in ('kind = "dark"', 'files = "di0001.tif"', 'kind = "flat"', 'files = "io*.tif"', 'kind = "object"'):
        assert line in told
    result = check_acquisition(tmp_path)
    assert [item.code for item in result.findings] == [FindingCode.NO_SIDECAR]


def test_a_draft_reads_settings_in_names_and_tells_even_light_from_a_product(tmp_path, capsys, refused_line):
    rng = np.random.default_rng(0)
    row, column = np.mgrid[-1:1:64j, -1:1:64j]
    field = 1.0 - 0.15 * row - 0.2 * row**2 - 0.2 * column**2  # heel and distance
    bone = np.where(row**2 + column**2 < 0.3, 0.5, 1.0)
    scenes = {
        "40kV_10W_20ms": 3000.0 * field,
        "90kV_12mA_20ms": 9000.0 * field,
        "90kV_12mA_20ms/fillet": 9000.0 * field * bone,
        "90kV_12mA_20ms/slab": 5000.0 * field,
        "off_20ms": np.zeros((64, 64)),
    }
    for name, light in scenes.items():
        (tmp_path / name).mkdir(parents=True)
        for number in range(2):
            image = rng.poisson(100.0 + light).astype(np.uint16)
            tifffile.imwrite(tmp_path / name / f"img_{number}.tif", image)
    draft = check_acquisition(tmp_path).draft
    series = {one["files"]: one for one in tomllib.loads(draft)["series"]}
    assert {name.removesuffix("/img_*.tif"): one["kind"] for name, one in series.items()} == {
        "40kV_10W_20ms": "flat",
        "90kV_12mA_20ms": "flat",
        "90kV_12mA_20ms/fillet": "object",
        "90kV_12mA_20ms/slab": "?",
        "off_20ms": "dark",
    }
    assert series["40kV_10W_20ms/img_*.tif"]["setting"] == "kv=40,power_w=10,exposure_ms=20"
    assert series["90kV_12mA_20ms/fillet/img_*.tif"]["setting"] == "kv=90,current_ma=12,exposure_ms=20"
    assert series["off_20ms/img_*.tif"]["exposure_ms"] == 20
    # a draft that is used as it is names what is left to do
    (tmp_path / "raytwin.toml").write_text(draft)
    assert main(["import", "images", str(tmp_path), "-o", str(tmp_path / "out.h5")]) == 2
    assert re.search(
        r"raytwin.toml, series 4, kind of .* got '\?'; expected one of dark, flat", capsys.readouterr().err
    )
    (tmp_path / "raytwin.toml").write_text(draft.replace('"?"', '"object"').replace("kv=90", "kv=0"))
    assert "raytwin.toml, series 2, kV: got 0.0 kV" in refused_line(
        "import", "images", tmp_path, "-o", tmp_path / "out.h5"
    )
    assert not (tmp_path / "out.h5").exists()


def test_a_number_with_its_unit_is_no_number_of_a_frame(tmp_path):
    for ms in (10, 20):
        for number in range(2):
            tifffile.imwrite(tmp_path / f"flat_{number}_{ms}ms.tif", np.full((8, 8), 100 * ms, np.uint16))
    series = tomllib.loads(check_acquisition(tmp_path).draft)["series"]
    assert [(one["files"], one["setting"]) for one in series] == [
        (f"flat_*_{ms}ms.tif", f"kv=0,power_w=0,exposure_ms={ms}") for ms in (10, 20)
    ]


@pytest.mark.parametrize("damaged", ["flat_a_0.tif", "flat_a_3.tif"])
def test_a_damaged_image_is_a_finding_and_the_other_series_are_checked(tmp_path, damaged):
    rng = np.random.default_rng(0)
    sidecar = ""
    for name, kind, level in (("dark", "dark", 100), ("flat_a", "flat", 4000), ("flat_b", "flat", 8000)):
        for number in range(5):
            tifffile.imwrite(tmp_path / f"{name}_{number}.tif", rng.poisson(level, (16, 16)).astype(np.uint16))
        sidecar += f'[[series]]\nname = "{name}"\nkind = "{kind}"\nfiles = "{name}_*.tif"\nexposure_ms = 10\n'
    (tmp_path / "raytwin.toml").write_text(sidecar)
    (tmp_path / damaged).write_bytes((tmp_path / damaged).read_bytes()[:200])
    result = check_acquisition(tmp_path)
    assert [row.name for row in result.series] == ["dark", "flat_b"]
    (found,) = (item for item in result.findings if item.code == FindingCode.DAMAGED)
    assert found.text.startswith("series flat_a, ") and f"{damaged}: got 200 bytes" in found.text
    assert result.series[1].level_DN == pytest.approx(8000, rel=0.05)


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


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_flats_that_are_no_brighter_than_a_dark_drifts_are_not_called_wrong(tmp_path, seed):
    # 6 DN above a dark that differs by as much as 1 DN from series to series
    path = tmp_path / "session.h5"
    line = ["--protocol", "calibration", "--seed", str(seed), "--size", "48", "--frames", "8"]
    assert main(["lab", "-o", str(path), *line]) == 0
    assert [item.text for item in check_acquisition(path).findings] == []

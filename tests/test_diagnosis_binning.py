"""Large panels: diagnosed with squares of pixels, answered in pixels."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition.binned_frames import means_of_bins
from raytwin.cli import main
from raytwin.diagnosis.model.changes import variants_of
from raytwin.diagnosis.probes.registration import render_variance
from raytwin.diagnosis.session import binning
from raytwin.diagnosis.session.binned_twin import effect_in_squares
from raytwin.diagnosis.session.binning import LARGEST_PIXELS, LEAST_SIDE, bin_factor, parameters_in_pixels
from raytwin.generator.effects import EFFECTS, AppliedEffect


@given(rows=st.integers(1, 5000), columns=st.integers(1, 5000))
def test_the_factor_is_the_least_that_keeps_frames_small(rows, columns):
    factor = bin_factor((rows, columns))
    if min(rows, columns) >= LEAST_SIDE:
        assert min(rows, columns) // factor >= LEAST_SIDE
    if min(rows, columns) // (factor + 1) >= LEAST_SIDE:  # no long strip
        assert (rows // factor) * (columns // factor) <= LARGEST_PIXELS
    if factor > 1:
        assert (rows // (factor - 1)) * (columns // (factor - 1)) > LARGEST_PIXELS


def strength_in_pixels(effect, found, factor):
    return parameters_in_pixels(effect, {"strength": found}, factor)["strength"]


def test_strengths_found_with_squares_are_those_of_the_pixels():
    rng, factor = np.random.default_rng(3), 4
    shape = (800, 400)
    # lines: rms over the read noise
    rows, read = 0.5 * rng.standard_normal((shape[0], 1)), rng.standard_normal(shape)
    small_rows = means_of_bins(np.broadcast_to(rows, shape), factor)
    found = float(small_rows.std() / means_of_bins(read, factor).std())
    assert strength_in_pixels("row_noise", found, factor) == pytest.approx(0.5, rel=4 / math.sqrt(2 * 200))
    # a pattern from pixel to pixel: rms
    found = float(means_of_bins(0.01 * read, factor).std())
    assert strength_in_pixels("gain_map_error", found, factor) == pytest.approx(0.01, rel=4 / math.sqrt(2 * 20_000))
    # single pixels: share of the squares that they spoil
    bad = rng.random(shape) < 0.001
    found = float(np.mean(means_of_bins(bad, factor) > 0))
    assert strength_in_pixels("bad_pixels", found, factor) == pytest.approx(float(bad.mean()), rel=0.02)
    # a displacement
    assert strength_in_pixels("misregistration", 0.5, factor) == 2.0
    # what has no pixel in it
    assert strength_in_pixels("object_scatter", 7.0, factor) == 7.0
    assert parameters_in_pixels("mtf_tail", {"strength": 5.0, "reach_px": 1.5}, factor) == {
        "strength": 5.0,
        "reach_px": 6.0,
    }


@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_pictures_of_squares_are_drawn_with_what_was_found_in_squares(effect):
    entry = EFFECTS[effect]
    found = {item.name: min(1.3 * item.default, 0.9 * item.most) for item in entry.parameters}
    applied = AppliedEffect(id=effect, parameters=parameters_in_pixels(effect, found, 4))
    assert effect_in_squares(applied, 4).parameters == pytest.approx(found)


def test_ranges_of_lengths_and_shares_are_those_of_the_panel_s_pixels():
    for effect in EFFECTS.values():
        here, fine = variants_of(effect, side=5), variants_of(effect)
        assert [item.parameters.keys() for item in here] == [item.parameters.keys() for item in fine]
        for small, large in zip(here, fine, strict=True):
            # what was found with squares, put in pixels, is what the catalogue allows
            back = parameters_in_pixels(effect.id, {**small.parameters, "strength": small.high}, 5)
            assert back == pytest.approx({**large.parameters, "strength": large.high})
            for item in small.fitted:
                high = parameters_in_pixels(effect.id, {item.name: item.high}, 5)[item.name]
                assert high == pytest.approx(next(other.high for other in large.fitted if other.name == item.name))


def test_the_far_end_of_a_blur_stays_open_over_as_many_of_the_panel_s_pixels():
    edge = np.where(np.arange(100) < 50, 1000.0, 0.0) * np.ones((20, 1))
    open_px = {side: np.count_nonzero(render_variance(edge, side=side)[10, 50:] > 0) for side in (1, 2, 4)}
    assert open_px == {1: 12, 2: 6, 4: 3}


@pytest.mark.slow
def test_a_large_panel_is_compared_in_squares_and_its_own_twin_improved(tmp_path, capsys, monkeypatch):
    from raytwin.generator.twins.twin_io import read_twin

    session = tmp_path / "session.h5"
    words = ["--protocol", "short", "--seed", "31", "--size", "96", "--frames", "12", "--products", "1"]
    assert main(["lab", "--family", "none", "-o", str(session), *words, "--effect", "excess_noise=60@calibration"]) == 0
    monkeypatch.setattr(binning, "LARGEST_PIXELS", 48 * 48)
    capsys.readouterr()
    assert main(["diagnose", str(session), "-o", str(tmp_path / "answer"), "--json"]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert found["causes"][0]["effect"] == "excess_noise"
    assert found["causes"][0]["strength"]["value"] == pytest.approx(60.0, rel=0.2)
    assert "quantisation" in {item["effect"] for item in found["not_tested"]}
    assert any("96 x 96 were compared as means of 2 x 2 pixels" in line for line in found["warnings"])
    assert "means of 2 x 2 pixels" in printed.err
    twin = read_twin(tmp_path / "answer" / "twin.h5")
    assert twin.maps.shape == (96, 96)
    assert [effect.id for effect in twin.effects] == ["excess_noise"]
    assert "means of 2 x 2 pixels" in (tmp_path / "answer" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_long_line_is_refused_as_a_line_and_a_small_series_is_left_out(tmp_path, capsys):
    import h5py

    session = tmp_path / "session.h5"
    words = ["--protocol", "short", "--seed", "31", "--size", "48", "--frames", "10", "--products", "1"]
    assert main(["lab", "--family", "none", "-o", str(session), *words]) == 0

    def reshaped(names, shape):
        with h5py.File(session, "r+") as file:
            for name in names(list(file["series"])):
                frames = file["series"][name]["frames"][:]
                del file["series"][name]["frames"]
                file["series"][name]["frames"] = np.resize(frames, (len(frames), *shape))
            if names(["one", "two"]) == ["one", "two"]:
                del file["scenes"]
                for name in list(file["series"]):
                    if file["series"][name].attrs["kind"] == "object":
                        del file["series"][name]

    # one dark of another size: left out, and said
    reshaped(lambda names: [name for name in names if name.startswith("dark")][-1:], (2, 8))
    capsys.readouterr()
    assert main(["diagnose", str(session), "-o", str(tmp_path / "answer"), "--json"]) == 0
    assert any("frames of 2 x 8, not 48 x 48" in line for line in json.loads(capsys.readouterr().out)["warnings"])
    # all of them lines of 70,000 pixels
    reshaped(lambda names: names, (1, 70_000))
    assert main(["diagnose", str(session), "-o", str(tmp_path / "line"), "--json"]) == 2
    assert "at least 16 rows and columns" in capsys.readouterr().err


@pytest.mark.slow
def test_a_plan_of_a_large_panel_is_in_its_own_pixels(tmp_path, capsys, monkeypatch):
    session = tmp_path / "session.h5"
    words = ["--protocol", "short", "--seed", "31", "--size", "96", "--frames", "6", "--products", "1"]
    assert main(["lab", "--family", "none", "-o", str(session), *words]) == 0
    found = {}
    for name, largest in (("fine", 96 * 96), ("squares", 48 * 48)):
        monkeypatch.setattr(binning, "LARGEST_PIXELS", largest)
        capsys.readouterr()
        assert main(["diagnose", str(session), "-o", str(tmp_path / name), "--plan", "--json"]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    strengths = {name: dict(zip(plan["effects"], plan["strengths"], strict=True)) for name, plan in found.items()}
    assert "motion_blur" in strengths["squares"]
    for effect, strength in strengths["squares"].items():
        assert strength == pytest.approx(strengths["fine"][effect], rel=1e-6)
    seen = {name: dict(zip(plan["effects"], plan["seen_from"], strict=True)) for name, plan in found.items()}
    # a blur of so many pixels is seen from as many, however they are looked at
    assert 0.3 < seen["squares"]["misregistration"] / seen["fine"]["misregistration"] < 10.0
    assert dict(zip(found["fine"]["effects"], found["fine"]["units"], strict=True))["misregistration"] == "px"
    assert "quantisation" in found["squares"]["cannot_be_judged"]
    assert "quantisation" not in found["squares"]["effects"]

"""Real cameras through `raytwin diagnose`: what their sessions show without any tube voltage, and what they cannot."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from raytwin.cli import main

REALDATA = Path(__file__).parents[2] / "shared" / "realdata"
CCD = REALDATA / "emva_ccd"
K11 = REALDATA / "k11"
NEEDS_A_SPECTRUM = {"kv_error", "filtration_error", "heel", "composition_error", "object_scatter", "focal_spot"}

pytestmark = pytest.mark.realdata


def diagnosed(source, layout, folder, capsys, *, side_px=None):
    session = folder / "session.h5"
    assert main(["import", layout, str(source), "-o", str(session)]) == 0
    if side_px is not None:
        with h5py.File(session, "r+") as file:
            for node in file["series"].values():
                frames = node["frames"][:, :side_px, :side_px]
                del node["frames"]
                node["frames"] = frames
    capsys.readouterr()
    assert main(["diagnose", str(session), "-o", str(folder / "answer"), "--json"]) == 0
    return session, json.loads(capsys.readouterr().out)


def places(answer, axis, series, statistic):
    return [
        place["z"]
        for place in answer["where"]
        if (place["axis"], place["series"], place["statistic"]) == (axis, series, statistic)
    ]


@pytest.mark.skipif(not K11.is_dir(), reason="the K11 tomography scan is not here (shared/realdata/k11)")
@pytest.mark.slow
def test_k11_flats_after_the_scan_are_brighter_and_the_tomogram_itself_cannot_be_judged(tmp_path, capsys):
    session, answer = diagnosed(K11 / "k11-18014.nxs", "nxtomo", tmp_path, capsys)
    with h5py.File(session) as file:
        series = file["series"]
        first, last, dark = (
            series[name]["frames"][:].mean(dtype=np.float64) for name in ("000_flat", "003_flat", "001_dark")
        )
    assert (last - dark) / (first - dark) == pytest.approx(1.0143, abs=0.002)  # by hand
    assert max(places(answer, "level", "003_flat", "mean frame")) > 5
    assert answer["mislabelled"] == []
    assert answer["verdict"] != "no_gap"
    assert {item["effect"] for item in answer["not_tested"]} >= NEEDS_A_SPECTRUM
    assert any(line.startswith("002_object: ") for line in answer["warnings"])


@pytest.mark.slow
@pytest.mark.skipif(not K11.is_dir(), reason="the K11 tomography scan is not here (shared/realdata/k11)")
def test_k11_one_level_that_rose_names_no_effect_with_confidence(tmp_path, capsys):
    _, answer = diagnosed(K11 / "k11-18014.nxs", "nxtomo", tmp_path, capsys)
    assert answer["verdict"] in ("unknown_effect", "ambiguous")


@pytest.mark.slow
@pytest.mark.skipif(not CCD.is_dir(), reason="the EMVA 1288 camera set is not here (shared/realdata/emva_ccd)")
def test_ccd_camera_shows_lines_of_its_readout(tmp_path, capsys):
    # a corner of the sensor says the same in a twentieth of the time
    session, answer = diagnosed(CCD, "emva1288", tmp_path, capsys, side_px=128)
    dark = "dark_027_5.16ms"
    with h5py.File(session) as file:
        frames = np.diff(file["series"][dark]["frames"][:].astype(np.float64), axis=0)
        frames -= frames.mean(axis=(1, 2), keepdims=True)
        # what a row has in common, over what independent pixels would give: by hand
        ratio = frames.mean(axis=2).var() * frames.shape[2] / frames.var()
    assert ratio > 1.2
    assert max(places(answer, "texture", dark, "row_ratio")) > 5
    assert {item["effect"] for item in answer["not_tested"]} >= NEEDS_A_SPECTRUM
    assert not {"row_noise", "nonlinearity", "output_drift"} & {item["effect"] for item in answer["not_tested"]}
    # three flats are saturated throughout
    assert sum("every pixel of every frame is 4095 DN" in line for line in answer["warnings"]) == 3
    assert answer["mislabelled"] == []

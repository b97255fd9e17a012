"""The shipped frames of a real line: the page's commands run, and intervals hold a calculation of the test's own."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter, median_filter

import raytwin as rt
from raytwin.acquisition import open_acquisition
from raytwin.acquisition.images import import_images
from raytwin.cli import main
from raytwin.diagnosis.session.origin import made_of
from raytwin.generator.twins.twin_io import read_twin

ROOT = Path(__file__).parents[1]
FRAMES = ROOT / "data" / "real" / "flexray"
WHOLE = ROOT.parent / "shared" / "realdata" / "flexray_walnut"


def own_calculation(folder, *, smooth_px):
    """Slope, and gain by covariances summed to three pixels, of the two mean flats; the shape is taken out with a Gaussian."""
    dark, first, second = (
        tifffile.imread(folder / f"{name}.tif").astype(float) for name in ("di000000", "io000000", "io000001")
    )
    first, second = first - dark, second - dark
    mean = 0.5 * (first + second)
    change = second / second.mean() - first / first.mean()
    rest = change - gaussian_filter(median_filter(change, 3), smooth_px)
    rest = np.where(np.abs(rest) < 6 * rest.std(), rest, 0.0) * mean
    lags = range(-3, 4)
    covariance = np.array([[np.mean(rest * np.roll(rest, (i, j), (0, 1))) for j in lags] for i in lags])
    scale = 50 / 2 / mean.mean()
    return scale * covariance[3, 3], scale * covariance.sum(), second.mean() / first.mean()


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    folder = tmp_path_factory.mktemp("line")
    assert main(["import", "images", str(FRAMES), "-o", str(folder / "line.h5")]) == 0
    return folder


@pytest.fixture(scope="module")
def answer(line):
    return calibrated(line)


def calibrated(folder):
    import contextlib
    import io

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["calibrate", str(folder / "line.h5"), "-o", str(folder / "twin.h5"), "--json"]) == 0
    return json.loads(said.getvalue())


def test_a_twin_of_single_averaged_frames_knows_the_session_it_was_made_of(line, answer):
    """Compared with themselves these frames are closer to their maps than any noise: they had been an unknown effect."""
    with open_acquisition(line / "line.h5") as acquisition:
        assert made_of(read_twin(line / "twin.h5"), acquisition.of_kind("dark"))
        assert not made_of(read_twin(line / "twin.h5"), acquisition.of_kind("object"))


def test_the_intervals_of_the_crop_hold_a_calculation_of_its_own(answer):
    (level,) = answer["levels"]
    slope, _, ratio = own_calculation(FRAMES, smooth_px=10)
    assert level["photon_transfer_slope_DN_low"] < slope < level["photon_transfer_slope_DN_high"]
    # the smooth part takes noise along on a fine scale and leaves shape on a coarse one: the gain lies between
    fine, coarse = (own_calculation(FRAMES, smooth_px=scale)[1] for scale in (8, 32))
    assert level["gain_DN_low"] < 0.5 * (fine + coarse) < level["gain_DN_high"]
    (repeat,) = answer["evidence"]["repeated_settings"]
    assert repeat["change_percent"] == pytest.approx(100 * (ratio - 1), abs=0.03)


def test_what_the_frames_cannot_tell_is_null_or_wide_and_said(answer):
    assert answer["psf_sigma_px"] is None
    assert any(line.startswith("psf_sigma_px is null") for line in answer["warnings"])
    assert answer["spread"]["variance_share"] < 0.25
    assert answer["read_noise_DN"]["low"] == 0.0 < answer["read_noise_DN"]["high"]
    assert any("pairs of single flats" in line for line in answer["warnings"])


def test_the_page_of_the_real_line_states_the_read_noise_of_its_own_commands(tmp_path):
    import_images(FRAMES, tmp_path / "line.h5")
    noise = rt.calibrate(tmp_path / "line.h5").noise.read_noise_DN
    row = f"| read noise | {noise.value:.0f} DN ({noise.low:.0f} to {noise.high:.0f}) |"
    assert row in (ROOT / "docs" / "real_line.md").read_text(encoding="utf-8")


def test_the_page_of_the_real_line_runs(tmp_path, monkeypatch, capsys):
    (block,) = re.findall(r"```\n(raytwin import.*?)```", (ROOT / "docs" / "real_line.md").read_text(), re.DOTALL)
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    for line in block.strip().splitlines():
        assert main(shlex.split(line)[1:]) == 0, line
    assert "the difference of flat_before and flat_after" in capsys.readouterr().out


@pytest.mark.realdata
@pytest.mark.skipif(not WHOLE.is_dir(), reason="the whole frames are not here (shared/realdata/flexray_walnut)")
@pytest.mark.slow
def test_the_whole_frames_give_what_independent_calculations_give(tmp_path):
    sidecar = (FRAMES / "raytwin.toml").read_text()
    walnut = '[[series]]\nname = "walnut"\nkind = "object"\nfiles = "scan_*.tif"\nsetting = "kv=40,power_w=12,exposure_ms=80"\n'
    single = re.compile(r'\[\[series\]\]\nname = "walnut_.*?\n\n', re.DOTALL)
    # ten projections of a turning walnut declared as one series: the mistake changes nothing but one line
    (tmp_path / "line.toml").write_text(single.sub("", sidecar) + "\n" + walnut)
    words = ["import", "images", str(WHOLE), "--sidecar", str(tmp_path / "line.toml"), "-o", str(tmp_path / "line.h5")]
    assert main(words) == 0
    found = calibrated(tmp_path)
    (level,) = found["levels"]
    assert level["photon_transfer_slope_DN"] == pytest.approx(0.316, rel=0.06)
    assert 1.6 < level["gain_DN"] < 2.4
    assert level["gain_DN_low"] < 1.95 < level["gain_DN_high"]
    correlation = {(row["lag_row"], row["lag_column"]): row["value"] for row in found["evidence"]["noise_correlation"]}
    for lag, expected in {(0, 1): 0.49, (1, 0): 0.50, (1, 1): 0.29, (0, 2): 0.125, (2, 0): 0.125}.items():
        assert correlation[lag] == pytest.approx(expected, abs=0.03)
    (repeat,) = found["evidence"]["repeated_settings"]
    assert repeat["change_percent"] == pytest.approx(0.65, abs=0.02)

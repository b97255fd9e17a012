"""Real cameras through the commands: gain, dark noise and linearity against a calculation of the test's own."""

import json
import re
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
import pytest

from raytwin.cli import main

REALDATA = Path(__file__).parents[2] / "shared" / "realdata"
CCD = REALDATA / "emva_ccd"
K11 = REALDATA / "k11"

pytestmark = pytest.mark.realdata


def calibrated(source, layout, folder, capsys):
    session, twin = folder / "session.h5", folder / "twin.h5"
    assert main(["import", layout, str(source), "-o", str(session)]) == 0
    capsys.readouterr()
    assert main(["calibrate", str(session), "-o", str(twin), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def emva_levels():
    """(photons, mean above dark, temporal variance, dark variance, saturated) of every level with two images."""
    levels, current = {}, None
    for line in (CCD / "EMVA1288_Data.txt").read_text().splitlines():
        words = line.split()
        if not words or words[0] not in "bdi":
            continue
        if words[0] == "i":
            levels[current].append(iio.imread(CCD / words[1].replace("\\", "/")).astype(np.float64))
        else:
            photons = float(words[2]) if len(words) > 2 else 0.0
            current = (words[0], float(words[1]), photons)
            levels.setdefault(current, [])
    rows = []
    for (kind, exposure, photons), images in levels.items():
        if kind != "b" or len(images) != 2:
            continue
        dark = next(value for key, value in levels.items() if key[:2] == ("d", exposure) and len(value) == 2)
        mean = np.mean(images) - np.mean(dark)
        # EMVA 1288, equation for the temporal variance from two images
        variance, dark_variance = (np.mean((a - b) ** 2) / 2 - np.mean(a - b) ** 2 / 2 for a, b in (images, dark))
        rows.append((photons, mean, variance, dark_variance, np.mean(images) > 4000))
    return np.array(rows)


@pytest.mark.skipif(not CCD.is_dir(), reason="the EMVA 1288 camera set is not here (shared/realdata/emva_ccd)")
@pytest.mark.slow
def test_gain_dark_noise_and_linearity_of_the_ccd_camera(tmp_path, capsys):
    answer = calibrated(CCD, "emva1288", tmp_path, capsys)
    photons, mean, variance, dark_variance, saturated = emva_levels().T
    usable = saturated == 0
    # system gain by EMVA 1288: slope of (variance - dark variance) against (mean - dark) up to 70 % of saturation
    fitted = usable & (mean < 0.7 * mean.max())
    gain = np.sum(mean[fitted] * (variance - dark_variance)[fitted]) / np.sum(mean[fitted] ** 2)
    (level,) = answer["levels"]
    assert level["photon_transfer_slope_DN"] == pytest.approx(gain, rel=0.02)
    assert level["gain_DN"] == pytest.approx(gain, rel=0.03)
    # dark noise: the mean over the darks, the ADC's rounding taken off
    dark_noise = np.sqrt(np.mean(dark_variance) - 1 / 12)
    assert answer["read_noise_DN"]["value"] == pytest.approx(dark_noise, rel=0.02)
    # linearity: departures from a line through zero in photons, weighted as in the answer by nothing but the sums
    responsivity = np.sum(mean[usable]) / np.sum(photons[usable])
    departure = 100 * np.abs(mean - responsivity * photons)[usable].max() / mean[usable].max()
    assert answer["evidence"]["linearity"]["largest_departure_percent"] == pytest.approx(departure, abs=0.2)
    assert departure < 1.0
    # the three brightest levels stand at the full scale of 12 bits
    assert int(np.sum(~usable)) == sum(
        not point["used"] for point in answer["evidence"]["photon_transfer"] if "saturated" in point["masked"]
    )
    assert level["saturation_DN"] == 4095.0
    assert re.search(r"saturated at 4095 DN", " ".join(answer["warnings"]))


@pytest.mark.skipif(not K11.is_dir(), reason="the K11 tomography scan is not here (shared/realdata/k11)")
def test_gain_dark_and_drift_of_the_synchrotron_camera(tmp_path, capsys):
    answer = calibrated(K11 / "k11-18014.nxs", "nxtomo", tmp_path, capsys)
    with h5py.File(K11 / "k11-18014.nxs") as file:
        keys = file["entry/imaging/image_key"][()] if "entry/imaging/image_key" in file else None
    frames, keys = _k11_frames(keys)
    flats = [frames[:50].astype(np.float64), frames[3101:3151].astype(np.float64)]
    darks = [frames[50:100].astype(np.float64), frames[3151:3201].astype(np.float64)]
    assert np.all(keys[:50] == 1) and np.all(keys[50:100] == 2)
    good = np.mean([np.diff(dark, axis=0).var(axis=0) / 2 for dark in darks], axis=0)
    good = good < 2.5 * np.median(good)
    dark_mean = np.mean([dark.mean(axis=0) for dark in darks], axis=0)
    gains = []
    for flat in flats:
        pair = np.mean(np.diff(flat - flat.mean(axis=(1, 2), keepdims=True), axis=0) ** 2, axis=0) / 2
        gains.append(np.mean(pair[good]) / np.mean((flat.mean(axis=0) - dark_mean)[good]))
    (level,) = answer["levels"]
    assert level["photon_transfer_slope_DN"] == pytest.approx(np.mean(gains), rel=0.02)
    assert level["gain_DN_low"] < np.mean(gains) < level["gain_DN_high"]
    assert answer["dark_DN"]["value"] == pytest.approx(np.median(dark_mean), abs=0.1)
    dark_noise = np.sqrt(np.mean([np.mean(np.diff(dark, axis=0)[:, good] ** 2) / 2 for dark in darks]) - 1 / 12)
    assert answer["read_noise_DN"]["value"] == pytest.approx(dark_noise, rel=0.03)
    # drift: the flats after the scan against those before it
    change = 100 * (np.mean((flats[1] - dark_mean)[:, good]) / np.mean((flats[0] - dark_mean)[:, good]) - 1)
    (repeat,) = answer["evidence"]["repeated_settings"]
    assert repeat["change_percent"] == pytest.approx(change, abs=0.05)
    assert any("drift between series" in line for line in answer["warnings"])


def _k11_frames(keys):
    with h5py.File(K11 / "k11-18014-imaging.h5") as file:
        found = []
        file.visititems(lambda name, item: found.append(name) if getattr(item, "ndim", 0) == 3 else None)
        frames = file[found[0]][()]
    if keys is None:
        with h5py.File(K11 / "k11-18014.nxs") as file:
            names = []
            file.visititems(lambda name, item: names.append(name) if name.endswith("image_key") else None)
            keys = file[names[0]][()]
    return frames, keys

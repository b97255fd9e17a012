"""Detectors without a dark level and without electronic noise: panels that count, and simulated ones."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.diagnosis.diagnose_session import diagnose
from raytwin.lab.effects import request_from_text
from raytwin.lab.protocols import run_protocol
from raytwin.lab.session import GEOMETRIES, session_system


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    """What is said of a short session of a silent detector with an effect; of each session once."""
    folder = tmp_path_factory.mktemp("silent")
    drawn = session_system(2071, rows=48, columns=48, geometry=GEOMETRIES["coarse"], families=())
    silent = replace(
        drawn, read_noise_DN=0.0, dark_DN=0.1, dark_spread_DN=0.0, dark_current_DN_per_ms=0.0, hot_pixels=0
    )

    def run(effect=""):
        path = folder / f"{effect or 'none'}.h5"
        effects = (request_from_text(effect),) if effect else ()
        run_protocol(
            path, protocol="short", seed=2071, system=silent, geometry="coarse", frames=10, products=1, effects=effects
        )
        with h5py.File(path) as file:
            darks = (node for node in file["series"].values() if node.attrs["kind"] == "dark")
            assert not min(darks, key=lambda node: node.attrs["index"])["frames"][:].any()
        with open_acquisition(path) as acquisition:
            return diagnose(acquisition, rng=np.random.default_rng(1))

    return run


@pytest.mark.slow
def test_darks_of_exact_zeros_are_compared_and_show_no_gap(diagnosed):
    found = diagnosed()
    assert found.verdict == "no_gap"
    assert not found.warnings


@pytest.mark.parametrize(
    ("effect", "least", "most", "widest"),
    [
        pytest.param("image_lag=1", 0.7, 1.4, 2.0, marks=pytest.mark.slow),
        pytest.param("output_drift=1", 0.5, 2.0, 4.0, marks=pytest.mark.slow),
        # so short a session hardly parts a voltage from a filtration
        pytest.param("kv_error=2", 1.5, 2.6, 1.7, marks=pytest.mark.slow),
    ],
)
def test_an_effect_is_named_where_darks_are_exact_zeros(diagnosed, effect, least, most, widest):
    found = diagnosed(effect)
    name, planted = effect.split("=")
    assert found.named == (name,)
    value, low, high = found.causes[0].strength
    assert least < value < most
    assert low < float(planted) < high < widest * low


@pytest.mark.slow
def test_a_camera_that_subtracts_its_own_dark_cuts_noise_off_at_0(tmp_path):
    path = tmp_path / "session.h5"
    drawn = session_system(2072, rows=48, columns=48, geometry=GEOMETRIES["coarse"], families=())
    noisy = replace(drawn, read_noise_DN=20.0, hot_pixels=0)
    run_protocol(path, protocol="full", seed=2072, system=noisy, geometry="coarse", frames=6, products=1)
    with h5py.File(path, "r+") as file:
        series = file["series"].values()
        first = min((one for one in series if one.attrs["kind"] == "dark"), key=lambda one: one.attrs["index"])
        dark, exposure_ms = first["frames"][:].mean(axis=0), first.attrs["exposure_ms"]
        growth = noisy.dark_current_DN_per_ms
        shadow = 0.0
        for one in series:
            left = one["frames"][:] - dark - growth * (one.attrs["exposure_ms"] - exposure_ms)
            one["frames"][...] = np.clip(np.round(left), 0, 65535)
            if one.attrs["kind"] == "object":
                shadow = max(shadow, float(np.mean(one["frames"][:] == 0)))
    # the step's lead end is dark enough for it
    assert shadow > 0.02
    with open_acquisition(path) as acquisition:
        found = diagnose(acquisition, rng=np.random.default_rng(1))
    assert found.verdict == "no_gap"
    assert any("noise below 0 was cut off" in line for line in found.warnings)
    assert any("as by a camera that subtracts its own dark" in line for line in found.warnings)

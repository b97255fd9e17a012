import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.log_images import light_of_log, logarithm_of_share, transmitted_share
from raytwin.acquisition.setting import setting_from_text


def test_logarithms_come_back_as_light_of_the_open_field(tmp_path):
    rng = np.random.default_rng(3)
    light_DN = rng.uniform(5.0, 12_000.0, size=(5, 7, 9))
    with write_acquisition(tmp_path / "logs.h5") as writer:
        writer.add_series(
            "product",
            kind="object",
            setting=setting_from_text("kv=60,power_w=20,exposure_ms=50"),
            frames=-np.log(light_DN / 10_000.0).astype(np.float32),
            corrected=("offset", "gain", "defects", "log"),
        )
    with open_acquisition(tmp_path / "logs.h5") as acquisition:
        light = light_of_log(acquisition.series[0], 10_000.0)
        assert light.corrected == {"offset", "gain", "defects"}
        assert light.dtype == np.float32
        np.testing.assert_allclose(light.read_frames(), light_DN, rtol=2e-6)
        np.testing.assert_array_equal(np.concatenate(list(light.iter_frames(maximum_bytes=1))), light.read_frames())
        np.testing.assert_array_equal(light.read_frames(-2), light.read_frames()[3:])
        # the file's own is as it was
        assert "log" in acquisition.series[0].corrected


def test_what_no_light_reached_and_what_was_dead_in_the_flat_stay_finite():
    assert logarithm_of_share(np.zeros(1)) == pytest.approx(87.3, abs=0.1)
    assert transmitted_share(np.array([200.0, -1e4])) == pytest.approx([0.0, np.exp(5.0)])

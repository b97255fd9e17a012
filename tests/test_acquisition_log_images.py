import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.log_images import holds_shares, light_of_shares, logarithm_of_share, transmitted_share
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
        light = light_of_shares(acquisition.series[0], 10_000.0)
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


@pytest.mark.parametrize(
    ("factor", "dtype", "corrected", "kind", "shares"),
    [
        (1.0, np.float32, ("offset", "gain"), "object", True),
        (1.0, np.float32, ("offset", "gain"), "flat", True),
        (1.0, np.float32, ("offset",), "object", False),
        (1.0, np.float32, ("offset", "gain"), "dark", False),
        (1.0, np.float32, ("offset", "gain", "log"), "object", True),
        (4000.0, np.float32, ("offset", "gain"), "object", False),
        (2.0, np.uint16, ("offset", "gain"), "object", False),
    ],
)
def test_shares_of_the_open_field_are_told_from_detector_numbers(tmp_path, factor, dtype, corrected, kind, shares):
    share = np.random.default_rng(4).uniform(-0.01, 1.02, size=(3, 8, 8))
    share[:, 2, 3] = 900.0  # dead in the flat
    with write_acquisition(tmp_path / "shares.h5") as writer:
        frames = np.clip(factor * share, 0, None) if dtype == np.uint16 else factor * share
        setting = None if kind == "dark" else setting_from_text("kv=60,power_w=20,exposure_ms=50")
        writer.add_series("one", kind=kind, setting=setting, exposure_ms=50.0 if setting is None else None,
                          frames=frames.astype(dtype), corrected=corrected)  # fmt: skip
    with open_acquisition(tmp_path / "shares.h5") as acquisition:
        series = acquisition.series[0]
        assert holds_shares(series) is shares
        if shares and "log" not in corrected:
            np.testing.assert_allclose(light_of_shares(series, 500.0).read_frames(), 500.0 * share, rtol=1e-5)

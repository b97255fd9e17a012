"""Several sessions as one, clusters of bad pixels, both variance estimators, and the layers of a dual-layer panel."""

from contextlib import ExitStack

import h5py
import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition import Filter, Setting, open_acquisition, write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.sessions import merge_sessions, one_layer, select_layer
from raytwin.calibration.calibrate import bad_pixel_counts
from raytwin.calibration.flats.photon_transfer import compute_photon_transfer
from raytwin.calibration.frames.bad_pixels import cluster_evidence
from raytwin.calibration.spread.noise_power import compute_noise_power
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.line.twin import BAD_PIXEL_CODES
from raytwin.generator.twins.twin_io import read_twin

SHAPE = (36, 40)
GAIN, READ_DN = 9.0, 11.0
LINE = Instrument(bits=16, pixel_mm=0.15, source_detector_mm=1059.0, source_object_mm=990.0)


def frames_of(level, *, rng, dark=1200.0, count=16, gain=GAIN):
    noise = np.sqrt(gain * level + READ_DN**2) * rng.standard_normal((count, *SHAPE))
    return np.clip(np.rint(dark + level + noise), 0, 65535).astype(np.uint16)


def session(
    path, *, seed, powers=(5.0, 10.0, 20.0), dark=1200.0, output=1.0, instrument=LINE, kV=40.0, break_=None, **series
):
    rng = np.random.default_rng(seed)
    with write_acquisition(path, instrument) as writer:
        for name, kind, power in [("dark", "dark", 0.0), *((f"flat_{p:g}W", "flat", p) for p in powers)]:
            setting = Setting(kV=kV, exposure_ms=20.0, power_W=power or None)
            level = 200000.0 * output * (setting.tube_load_mAs or 0.0)
            frames = frames_of(level, rng=rng, dark=dark)
            if break_ is not None:
                frames = break_(frames.astype(float), level).astype(np.uint16)
            writer.add_series(name, kind=kind, frames=frames, setting=setting, **series)
    return path


def merged(*paths):
    stack = ExitStack()
    return stack, merge_sessions([stack.enter_context(open_acquisition(path)) for path in paths])


def test_sessions_of_one_line_are_one_acquisition_with_series_in_order(tmp_path):
    first = session(tmp_path / "a.h5", seed=1)
    second = session(tmp_path / "b.h5", seed=2, powers=(10.0, 30.0))
    stack, both = merged(first, second)
    with stack:
        assert [item.name for item in both.series] == [
            "dark", "flat_5W", "flat_10W", "flat_20W", "2.dark", "2.flat_10W", "flat_30W",
        ]  # fmt: skip
        assert [item.session for item in both.series] == [0, 0, 0, 0, 1, 1, 1]
        assert [item.index for item in both.series] == list(range(7))
        assert both.series[4].read_frames().shape == (16, *SHAPE)
        assert merge_sessions([both]) is both
    with pytest.raises(InputError, match="sessions: got none; expected at least one acquisition"):
        merge_sessions([])


def test_sessions_tell_each_other_what_they_know_and_must_not_contradict(tmp_path):
    sparse = session(tmp_path / "a.h5", seed=1, instrument=Instrument(pixel_mm=0.15))
    full = session(tmp_path / "b.h5", seed=2)
    other = session(tmp_path / "c.h5", seed=3, instrument=Instrument(pixel_mm=0.2))
    stack, both = merged(sparse, full)
    with stack:
        assert both.instrument == LINE
    with pytest.raises(
        InputError, match=r"c.h5, instrument pixel_mm: got 0.2; expected 0.15 as in the sessions before"
    ):
        merged(full, other)


def test_each_session_has_its_own_darks_and_drift_between_them_is_said(tmp_path):
    """The dark moves by 40 DN and the tube's output by 2 % from one day to the next."""
    first = session(tmp_path / "a.h5", seed=1)
    second = session(tmp_path / "b.h5", seed=2, dark=1240.0, output=1.02)
    stack, both = merged(first, second)
    with stack:
        found = compute_photon_transfer(both)
    assert found.dark_DN.value == pytest.approx(1240.0, abs=1.0)  # of the last session
    one, two = found.evidence["sessions"]
    assert one["level_change_percent"] == {"40 kV": 0.0}
    assert two["dark_change_DN"]["20 ms"] == pytest.approx(40.0, abs=1.0)
    assert two["level_change_percent"]["40 kV"] == pytest.approx(2.0, abs=0.2)
    assert any("session 2: levels changed by up to +2 %" in line for line in found.warnings)
    assert any("session 2: the dark level moved by +40" in line for line in found.warnings)
    # offsets that were mixed up would make the level of one session 40 DN wrong
    levels = {point.series: point.signal_DN for point in found.points}
    assert levels["2.flat_5W"] / levels["flat_5W"] == pytest.approx(1.02, abs=0.004)
    assert found.levels[0].gain_DN.value == pytest.approx(GAIN, rel=0.03)
    assert found.maps.bad_pixels.sum() == 0


def test_one_session_has_no_evidence_of_sessions(tmp_path):
    with open_acquisition(session(tmp_path / "a.h5", seed=1)) as acquisition:
        assert "sessions" not in compute_photon_transfer(acquisition).evidence


@pytest.mark.slow
def test_more_frames_of_a_second_session_narrow_the_slope(tmp_path):
    first = session(tmp_path / "a.h5", seed=1)
    second = session(tmp_path / "b.h5", seed=2)
    with open_acquisition(first) as acquisition:
        alone = compute_photon_transfer(acquisition).levels[0].photon_transfer_slope_DN
    stack, both = merged(first, second)
    with stack:
        together = compute_photon_transfer(both).levels[0].photon_transfer_slope_DN
    width = [value.high - value.low for value in (alone, together)]
    assert width[1] / width[0] == pytest.approx(np.sqrt(0.5), rel=0.25)


def test_a_cluster_takes_along_what_touches_it_and_is_half_bad(tmp_path):
    """A hot pixel with a warm neighbour; the same warmth alone is no reason; a pixel hemmed in by dead ones."""
    hot, beside, alone, hemmed = (10, 10), (10, 11), (25, 30), (20, 20)

    def break_pixels(frames, level):
        frames[:, *hot] += 800.0
        for place in (beside, alone):
            frames[:, *place] += 18.0
        for row in (-1, 0, 1):
            for column in (-1, 0, 1):
                if (row, column) != (0, 0):
                    frames[:, hemmed[0] + row, hemmed[1] + column] = 1200.0
        return frames

    with open_acquisition(session(tmp_path / "a.h5", seed=1, break_=break_pixels)) as acquisition:
        found = compute_photon_transfer(acquisition)
    bad = found.maps.bad_pixels
    assert bad[hot] == BAD_PIXEL_CODES["hot"]
    assert bad[beside] == BAD_PIXEL_CODES["clustered"]
    assert bad[alone] == BAD_PIXEL_CODES["good"]
    assert bad[hemmed] != BAD_PIXEL_CODES["good"]
    assert bad_pixel_counts(found)["clustered"] >= 1
    assert found.evidence["clusters"] == {"groups": 2, "largest": 9, "kernel_pixels": 5}


def test_clusters_are_counted_as_groups_that_touch():
    bad = np.zeros((8, 8), np.uint8)
    bad[0, 0] = bad[1, 1] = bad[5, 5] = 1
    bad[2:5, 2] = 2  # touches (1, 1) by a corner
    assert cluster_evidence(bad) == {"groups": 1, "largest": 5, "kernel_pixels": 0}
    assert cluster_evidence(np.zeros((4, 4), np.uint8)) == {"groups": 0, "largest": 0, "kernel_pixels": 0}


def test_stack_and_pair_noise_power_agree_on_white_frames():
    rng = np.random.default_rng(4)
    frames = 3.0 * rng.standard_normal((40, 48, 48))
    good = np.ones((48, 48), bool)
    signal = np.zeros((48, 48))
    about = (frames.mean(axis=0), len(frames))
    stack = compute_noise_power([frames], signal_DN=signal, good=good, about=about)
    pairs = compute_noise_power([frames], signal_DN=signal, good=good)
    for found in (stack, pairs):
        flat = np.full(found.power_DN2.shape, 9.0)
        assert found.variance_DN2(flat) == pytest.approx(9.0, abs=5 * 9.0 * np.sqrt(2 / found.samples))
    assert pairs.samples < stack.samples < 39 * 48 * 48
    assert stack.samples > 1.4 * pairs.samples


def test_drift_enters_the_gain_from_stacks_and_not_that_from_pairs(tmp_path):
    """A chessboard that comes up over the series, which no factor of a frame, row or column takes out: +-6 % from first to last."""
    pattern = np.where(np.add.outer(np.arange(SHAPE[0]), np.arange(SHAPE[1])) % 2 == 0, 0.06, -0.06)

    def drift(frames, level):
        ramp = np.linspace(-0.5, 0.5, len(frames))[:, None, None]
        return frames + level * ramp * pattern

    gains = {}
    with open_acquisition(session(tmp_path / "a.h5", seed=1, break_=drift)) as acquisition:
        for estimator in ("pairs", "stack"):
            found = compute_photon_transfer(acquisition, estimator=estimator)
            assert found.evidence["estimator"] == estimator
            # the variance of one pixel: the pattern has no sum over neighbours
            gains[estimator] = found.levels[0].photon_transfer_slope_DN.value
        with pytest.raises(InputError, match="estimator: got median; expected one of pairs, stack"):
            compute_photon_transfer(acquisition, estimator="median")
    assert gains["pairs"] == pytest.approx(GAIN, rel=0.03)
    assert gains["stack"] > 1.03 * gains["pairs"]


def test_maps_say_how_well_a_pixel_is_known(tmp_path):
    with open_acquisition(session(tmp_path / "a.h5", seed=1)) as acquisition:
        maps = compute_photon_transfer(acquisition).evidence["maps"]
    assert maps["dark_sd_DN"] == pytest.approx(READ_DN / 4.0, rel=0.05)  # 16 frames
    # uniform detector: almost nothing of a pixel's own slope is kept, and its gain is known better than by itself
    assert 0.0 <= maps["gain_relative_sd"] < np.sqrt(2.0 / 15)
    assert maps["gain_relative_spread"] < 0.1


def test_binned_flats_do_not_calibrate_single_pixels(tmp_path):
    path = tmp_path / "a.h5"
    rng = np.random.default_rng(1)
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=frames_of(0.0, rng=rng), exposure_ms=20.0)
        setting = Setting(kV=40.0, exposure_ms=20.0, power_W=10.0, binning=2)
        writer.add_series("flat", kind="flat", frames=frames_of(1000.0, rng=rng), setting=setting)
    with open_acquisition(path) as acquisition, pytest.raises(InputError, match=r"got binned flats \(flat\)"):
        compute_photon_transfer(acquisition)


PANEL = Instrument(
    pixel_mm=0.15,
    source_detector_mm=1059.0,
    scintillator=(Filter(material="CsI", thickness_mm=0.3),),
    interlayer=(Filter(material="Cu", thickness_mm=1.0),),
    back_scintillator=(Filter(material="Gd2O2S@7.32", thickness_mm=0.4),),
)


def dual_session(path):
    """A dark and a flat of each layer of a panel; the back layer sees a quarter of the light."""
    rng = np.random.default_rng(1)
    with write_acquisition(path, PANEL) as writer:
        for layer, level in (("front", 4000.0), ("back", 900.0)):
            writer.add_series(
                f"dark_{layer}", kind="dark", frames=frames_of(0.0, rng=rng), exposure_ms=20.0, layer=layer
            )
            setting = Setting(kV=90.0, exposure_ms=20.0, power_W=10.0)
            writer.add_series(
                f"flat_{layer}", kind="flat", frames=frames_of(level, rng=rng), setting=setting, layer=layer
            )
    return path


def test_a_layer_has_its_own_series_and_sees_what_lies_before_it(tmp_path):
    path = dual_session(tmp_path / "dual.h5")
    with open_acquisition(path) as acquisition:
        back = select_layer(acquisition, "back")
        assert [item.name for item in back.series] == ["dark_back", "flat_back"]
        assert back.instrument.scintillator == PANEL.back_scintillator
        assert back.instrument.detector_cover == (*PANEL.scintillator, *PANEL.interlayer)
        assert select_layer(acquisition, "front").instrument == PANEL
        assert [item.name for item in one_layer(acquisition).series] == ["dark_front", "flat_front"]
        assert one_layer(acquisition, "back").instrument == back.instrument
        with pytest.raises(InputError, match="layer: got middle; expected front or back"):
            select_layer(acquisition, "middle")
    plain = session(tmp_path / "plain.h5", seed=1)
    with open_acquisition(plain) as acquisition:
        assert one_layer(acquisition) is acquisition
    with (
        open_acquisition(plain) as acquisition,
        pytest.raises(InputError, match="declare the panel's back_scintillator"),
    ):
        select_layer(acquisition, "back")


def test_calibrate_takes_several_sessions(tmp_path, capsys):
    first = session(tmp_path / "a.h5", seed=1)
    second = session(tmp_path / "b.h5", seed=2, kV=60.0)
    assert main(["calibrate", str(first), str(second), "-o", str(tmp_path / "t.h5"), "--estimator", "stack"]) == 0
    capsys.readouterr()
    twin = read_twin(tmp_path / "t.h5")
    assert [level.kV for level in twin.levels] == [40.0, 60.0]
    assert len(twin.evidence["sessions"]) == 2
    assert len(str(twin.provenance["acquisition_sha256"]).split("+")) == 2


def test_several_sessions_are_validated_as_one_and_each_knows_whether_it_calibrated(tmp_path):
    paths = [session(tmp_path / "a.h5", seed=1), session(tmp_path / "b.h5", seed=2, powers=(8.0, 30.0))]
    twin = rt.calibrate(paths[0], seed=0)
    found = rt.validate(twin, tuple(paths))
    assert [(row.series, row.used_in_calibration) for row in found.rows] == [
        ("flat_5W", True), ("flat_10W", True), ("flat_20W", True), ("flat_8W", False), ("flat_30W", False),
    ]  # fmt: skip
    with ExitStack() as stack:
        files = [stack.enter_context(open_acquisition(path)) for path in paths]
        assert rt.validate(twin, files) == found


def test_a_session_given_twice_is_refused(tmp_path, refused_line):
    path = session(tmp_path / "a.h5", seed=1)
    copy = tmp_path / "copy.h5"
    copy.write_bytes(path.read_bytes())
    for second in (path, copy):
        assert "each session once" in refused_line("calibrate", path, second, "-o", tmp_path / "t.h5")
    assert not (tmp_path / "t.h5").exists()


def test_a_twin_is_compared_with_the_layer_that_calibrated_it(tmp_path, capsys, refused_line):
    dual = dual_session(tmp_path / "dual.h5")
    twin = tmp_path / "back.h5"
    assert main(["calibrate", str(dual), "--layer", "back", "-o", str(twin)]) == 0
    assert read_twin(twin).layer == "back"
    assert rt.calibrate(session(tmp_path / "plain.h5", seed=1)).layer is None
    assert [row.series for row in rt.validate(twin, dual).rows] == ["flat_back"]
    capsys.readouterr()
    assert "got front; expected back, which the twin was calibrated from" in refused_line(
        "validate", twin, dual, "--layer", "front"
    )
    assert "layer: got back; expected front" in refused_line(
        "diagnose", tmp_path / "plain.h5", "--twin", twin, "-o", tmp_path / "d"
    )


def test_a_twin_file_without_a_layer_is_read(tmp_path):
    twin = rt.calibrate(dual_session(tmp_path / "dual.h5"), layer="front")
    twin.save(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "r+") as file:
        del file.attrs["layer"]
    assert read_twin(tmp_path / "t.h5").layer is None

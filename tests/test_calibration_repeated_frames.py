"""Sessions whose flats are single averaged frames: level and maps from these, noise from what was repeated at the beam."""

import sys

import numpy as np
import pytest

from raytwin.acquisition import Setting, open_acquisition, write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.calibration.flats.photon_transfer import compute_photon_transfer
from raytwin.calibration.flats.repeated_frames import most_read_variance
from raytwin.diagnosis.session.preparation import calibrated_twin
from raytwin.diagnosis.session.session import only_own_noise, read_session
from raytwin.errors import FitError, InputError
from raytwin.generator.spread.noise import sample_frame_noise
from raytwin.generator.spread.psf import Spread, blur_variance_share

SHAPE = (64, 64)
GAIN, SIGMA, READ_DN, DARK_DN, AVERAGED = 9.0, 0.55, 11.0, 1200.0, 16
LEVELS = {20.0: 8000.0, 80.0: 32000.0}
HARDER = 1.1  # gain behind the object over that in the open field


def exposures(mean, count, rng, gain=GAIN):
    """Whole-number frames (count, row, column) of a mean signal (row, column)."""
    frames = [
        DARK_DN
        + mean
        + sample_frame_noise(
            mean,
            gain_DN=gain,
            white_fraction=0.003,
            read_variance_DN2=READ_DN**2,
            spread=Spread(sigma_px=SIGMA),
            rng=rng,
        )
        for _ in range(count)
    ]
    return np.clip(np.rint(np.array(frames)), 0, 65535).astype(np.uint16)


def averaged(mean, rng):
    return np.mean(exposures(mean, AVERAGED, rng), axis=0, dtype=np.float64)[None].astype(np.float32)


def shadow(share):
    """Thickness map (row, column) in mm with an object over a share of the rows."""
    plane = np.zeros(SHAPE, np.float32)
    plane[: round(share * SHAPE[0])] = 10.0
    return plane


def write_session(
    path,
    *,
    share=0.4,
    frames=3,
    objects=6,
    role="evaluation",
    flat_frames=0,
    with_maps=True,
    seed=0,
    filters=(),
    exposures_ms=tuple(LEVELS),
):
    """Averaged darks and flats at two exposures, and repeated frames of objects, or `flat_frames` of flats, after them."""
    rng = np.random.default_rng(seed)
    pattern = 1.0 + 0.03 * rng.standard_normal(SHAPE)
    instrument = Instrument(bits=16, pixel_mm=0.15, source_detector_mm=1059.0, source_object_mm=990.0)
    with write_acquisition(path, instrument) as writer:
        for exposure_ms in exposures_ms:
            level = LEVELS[exposure_ms]
            words = {"exposure_ms": exposure_ms, "averaged": AVERAGED, "role": "calibration"}
            writer.add_series(f"dark_{exposure_ms:g}", kind="dark", frames=averaged(np.zeros(SHAPE), rng), **words)
            words |= {"kV": 40.0, "power_W": 20.0}
            writer.add_series(f"flat_{exposure_ms:g}", kind="flat", frames=averaged(level * pattern, rng), **words)
        thickness = shadow(share)
        for number in range(objects):
            scene = f"product{number}"
            writer.add_scene(
                scene, kind="product", thickness_mm={"chicken_breast": thickness} if with_maps else None, product=scene
            )
            for exposure_ms in exposures_ms:
                level = LEVELS[exposure_ms]
                covered = thickness > 0
                mean = level * pattern * np.where(covered, 0.5, 1.0)
                found = np.where(
                    covered, exposures(mean, frames, rng, gain=HARDER * GAIN), exposures(mean, frames, rng)
                ).astype(np.uint16)
                setting = Setting(kV=40.0, power_W=20.0, exposure_ms=exposure_ms, filters=filters)
                writer.add_series(
                    f"{scene}_{exposure_ms:g}", kind="object", frames=found, setting=setting, scene=scene, role=role
                )
        if flat_frames:
            setting = Setting(kV=40.0, power_W=20.0, exposure_ms=20.0)
            found = exposures(LEVELS[20.0] * pattern, flat_frames, rng)
            writer.add_series("flat_again", kind="flat", frames=found, setting=setting, role="evaluation")
    return path


def transfer_of(path, **words):
    with open_acquisition(path) as acquisition:
        return compute_photon_transfer(acquisition, **words)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return write_session(tmp_path_factory.mktemp("single") / "session.h5")


@pytest.fixture(scope="module")
def found(session):
    return transfer_of(session)


def test_the_noise_of_the_field_beside_objects_is_that_of_the_beam(found):
    (level,) = found.levels
    assert level.gain_DN.low < GAIN < level.gain_DN.high
    assert level.gain_DN.value == pytest.approx(GAIN, rel=0.06)
    slope = GAIN * (blur_variance_share("aperture", SIGMA) + 0.003) / 1.003
    assert level.photon_transfer_slope_DN.value == pytest.approx(slope, rel=0.03)
    assert found.noise.spread.value.sigma_px == pytest.approx(SIGMA, rel=0.04)
    (row,) = found.evidence["repeated_frames"]
    assert row["where"] == "beside objects"
    assert len(row["series"]) == 12


def test_levels_and_dark_come_from_the_single_frames_alone(found):
    (level,) = found.levels
    assert level.series == ("flat_20", "flat_80")
    assert level.rate_DN_per_mAs.value == pytest.approx(8000.0 / (20.0 / 40.0 * 0.020), rel=2e-3)
    assert found.dark_DN.low < DARK_DN < found.dark_DN.high
    assert found.dark_DN.high - found.dark_DN.low < 0.5
    points = {point.series: point for point in found.points}
    expected = level.photon_transfer_slope_DN.value * points["flat_20"].mean_signal_DN + READ_DN**2
    assert points["flat_20"].pair_variance_DN2 == pytest.approx(expected, rel=0.03)


def test_whole_numbers_are_looked_for_where_nothing_was_averaged(found):
    assert found.noise.quantised


def test_read_noise_that_a_far_intercept_leaves_open_is_bounded_by_the_darks(found):
    read = found.noise.read_noise_DN
    assert read.low < READ_DN < read.high
    assert read.high < 1.3 * READ_DN


def test_it_is_said_where_the_noise_comes_from_and_what_it_cannot_tell(found):
    (said,) = [line for line in found.warnings if "repeated frames of 12 other series" in line]
    assert "noise that has changed since the flats cannot be seen" in said


@pytest.mark.slow
def test_behind_objects_the_gain_is_harder_and_its_interval_says_so(tmp_path):
    covered = transfer_of(write_session(tmp_path / "covered.h5", share=1.0, exposures_ms=(20.0,)))
    (row,) = covered.evidence["repeated_frames"]
    assert row["where"] == "behind objects"
    (level,) = covered.levels
    assert level.gain_DN.low < HARDER * GAIN < level.gain_DN.high
    assert level.gain_DN.high - level.gain_DN.low > 2.0 * 1.96 * 0.03 * level.gain_DN.value


def test_objects_that_nobody_maps_are_read_away_from_steps(tmp_path):
    blind = transfer_of(write_session(tmp_path / "blind.h5", with_maps=False, exposures_ms=(20.0,)))
    assert [row["where"] for row in blind.evidence["repeated_frames"]] == ["behind objects"]
    # half of the frame lies behind the object, where the beam is harder
    mixed = 0.5 * (1.0 + HARDER) * GAIN
    gain_DN = blind.levels[0].gain_DN
    assert gain_DN.low < mixed < gain_DN.high
    assert gain_DN.value == pytest.approx(mixed, rel=0.08)


@pytest.mark.slow
def test_repeated_flats_held_back_for_evaluation_give_the_whole_field(tmp_path):
    again = transfer_of(write_session(tmp_path / "again.h5", objects=0, flat_frames=12))
    (row,) = again.evidence["repeated_frames"]
    assert (row["series"], row["share_percent"]) == (["flat_again"], 100.0)
    assert again.levels[0].gain_DN.low < GAIN < again.levels[0].gain_DN.high
    assert again.levels[0].series == ("flat_20", "flat_80")


@pytest.mark.slow
def test_series_held_back_for_evaluation_stay_so_where_others_repeat_the_beam(tmp_path):
    free = transfer_of(write_session(tmp_path / "free.h5", role=None, flat_frames=12))
    (row,) = free.evidence["repeated_frames"]
    assert "flat_again" not in row["series"]


@pytest.mark.parametrize("words", [{"frames": 1}, {"objects": 0}], ids=["single frames", "no objects"])
def test_without_any_repeated_frame_one_line_says_what_is_missing(tmp_path, words):
    path = write_session(tmp_path / "single.h5", exposures_ms=(20.0,), **words)
    with pytest.raises(InputError, match="a single frame has no noise") as error:
        transfer_of(path)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_wide_spread_is_found_or_no_gain_is_given(tmp_path, monkeypatch):
    """Quanta spread over most of an open field are seen as slow changes: the interval holds the gain, or there is none."""
    for sigma_px, share in ((1.2, 0.4), (2.2, 0.75)):
        monkeypatch.setattr(sys.modules[__name__], "SIGMA", sigma_px)
        try:
            wide = transfer_of(write_session(tmp_path / f"{sigma_px}.h5", share=share, objects=8))
        except FitError as error:
            assert sigma_px > 2 and "the noise tells no gain" in str(error)
        else:
            assert wide.levels[0].gain_DN.low < GAIN < wide.levels[0].gain_DN.high


def test_objects_in_another_beam_say_nothing_of_this_one(tmp_path):
    from raytwin.acquisition.setting import filters_from_text

    path = write_session(tmp_path / "other.h5", filters=filters_from_text("Cu:0.2"), exposures_ms=(20.0,))
    with pytest.raises(InputError, match="a single frame has no noise"):
        transfer_of(path)


def test_two_single_flats_of_a_beam_are_a_pair_whose_difference_holds_the_noise(tmp_path):
    paired = transfer_of(write_session(tmp_path / "pair.h5", objects=0))
    assert [row["series"] for row in paired.evidence["flat_pairs"]] == [["flat_20", "flat_80"]]
    (level,) = paired.levels
    assert level.gain_DN.low < GAIN < level.gain_DN.high
    assert level.gain_DN.high - level.gain_DN.low < 1.5 * GAIN, "one pair without repeated darks still tells something"
    slope = GAIN * (blur_variance_share("aperture", SIGMA) + 0.003) / 1.003
    assert level.photon_transfer_slope_DN.low < slope < level.photon_transfer_slope_DN.high
    assert any("noise comes from 1 pairs of single flats" in line for line in paired.warnings)


def test_a_turning_object_is_no_repeat_and_changes_nothing_but_one_line(tmp_path):
    """Frames of one series that show another scene each are left out of the noise, and one line says so."""
    rng = np.random.default_rng(9)
    paths = [tmp_path / "with.h5", tmp_path / "without.h5"]
    for path in paths:
        rng = np.random.default_rng(9)
        instrument = Instrument(bits=16, pixel_mm=0.15, source_detector_mm=1059.0, source_object_mm=990.0)
        with write_acquisition(path, instrument) as writer:
            words = {"exposure_ms": 20.0, "averaged": AVERAGED}
            writer.add_series("dark", kind="dark", frames=averaged(np.zeros(SHAPE), rng), **words)
            for number in range(2):
                flat = averaged(np.full(SHAPE, 8e3), rng)
                writer.add_series(f"flat{number}", kind="flat", frames=flat, kV=40.0, power_W=20.0, **words)
            if path == paths[0]:
                rows = np.arange(SHAPE[0])[:, None]
                turning = [
                    exposures(8e3 * np.where(np.abs(rows - 20 - 5 * turn) < 12, 0.4, 1.0) * np.ones(SHAPE), 1, rng)
                    for turn in range(6)
                ]
                setting = Setting(kV=40.0, power_W=20.0, exposure_ms=20.0)
                writer.add_series("walnut", kind="object", frames=np.concatenate(turning), setting=setting)
    first, second = (transfer_of(path) for path in paths)
    assert first.levels[0].gain_DN == second.levels[0].gain_DN
    (line,) = set(first.warnings) - set(second.warnings)
    assert line.startswith("walnut is not used for noise: its frames do not show one scene")


def test_copies_of_a_frame_are_counted_once(tmp_path):
    """A grabber that hands the last frame out again halves the pair variances; each exposure is counted once."""
    rng = np.random.default_rng(4)
    instrument = Instrument(bits=16, pixel_mm=0.15, source_detector_mm=1059.0)
    setting = Setting(kV=40.0, power_W=20.0, exposure_ms=20.0)
    own = exposures(np.full(SHAPE, 8e3), 10, rng)
    dark = exposures(np.zeros(SHAPE), 8, rng)
    found = {}
    for name, frames in (("clean", own), ("copied", np.repeat(own, 2, axis=0))):
        with write_acquisition(tmp_path / f"{name}.h5", instrument) as writer:
            writer.add_series("dark", kind="dark", frames=dark, exposure_ms=20.0)
            writer.add_series("flat", kind="flat", frames=frames, setting=setting)
        found[name] = transfer_of(tmp_path / f"{name}.h5")
    assert found["copied"].levels[0].gain_DN == found["clean"].levels[0].gain_DN
    assert any("10 of 20 frames are copies" in line for line in found["copied"].warnings)


def test_series_of_one_frame_over_and_over_are_refused_in_one_line(tmp_path):
    rng = np.random.default_rng(4)
    instrument = Instrument(bits=16, pixel_mm=0.15, source_detector_mm=1059.0)
    with write_acquisition(tmp_path / "copies.h5", instrument) as writer:
        dark = np.repeat(exposures(np.zeros(SHAPE), 1, rng), 8, axis=0)
        writer.add_series("dark", kind="dark", frames=dark, exposure_ms=20.0)
        for exposure_ms, level in LEVELS.items():
            setting = Setting(kV=40.0, power_W=20.0, exposure_ms=exposure_ms)
            frames = np.repeat(exposures(np.full(SHAPE, level), 1, rng), 10, axis=0)
            writer.add_series(f"flat_{exposure_ms:g}", kind="flat", frames=frames, setting=setting)
    with pytest.raises(InputError, match="flats whose frames do not differ in any pixel"):
        transfer_of(tmp_path / "copies.h5")


@pytest.mark.slow
def test_a_beam_with_repeated_flats_takes_nothing_from_objects(tmp_path):
    with_objects, without = tmp_path / "with.h5", tmp_path / "without.h5"
    for path, objects in ((with_objects, 2), (without, 0)):
        rng = np.random.default_rng(3)
        instrument = Instrument(bits=16, pixel_mm=0.15, source_detector_mm=1059.0)
        with write_acquisition(path, instrument) as writer:
            setting = Setting(kV=40.0, power_W=20.0, exposure_ms=20.0)
            writer.add_series("dark", kind="dark", frames=exposures(np.zeros(SHAPE), 8, rng), exposure_ms=20.0)
            writer.add_series("flat", kind="flat", frames=exposures(np.full(SHAPE, 8e3), 8, rng), setting=setting)
            for number in range(objects):
                writer.add_scene(f"p{number}", kind="product", thickness_mm={"chicken_breast": shadow(0.3)})
                frames = exposures(np.full(SHAPE, 8e3), 3, rng)
                writer.add_series(f"o{number}", kind="object", frames=frames, setting=setting, scene=f"p{number}")
    first, second = transfer_of(with_objects), transfer_of(without)
    assert repr(first.levels[0].gain_DN) == repr(second.levels[0].gain_DN)
    assert first.evidence == second.evidence


@pytest.mark.slow
def test_a_diagnosis_calibrates_such_a_session_and_knows_whose_noise_it_has(session):
    with open_acquisition(session) as acquisition:
        twin = calibrated_twin(acquisition, rng=np.random.default_rng(0))
        parts = {item.name: item for item in read_session(acquisition)}
        elsewhere = read_session(acquisition, calibrated_elsewhere=True)
    assert twin.evidence["repeated_frames"][0]["where"] == "beside objects"
    assert twin.spectral is not None
    assert parts["product0_20"].own_noise
    assert not parts["dark_20"].own_noise
    assert not any(item.own_noise for item in elsewhere)
    assert only_own_noise(list(parts.values()))
    assert not only_own_noise(elsewhere)


def test_two_averaged_darks_bound_the_read_variance_whatever_their_pattern():
    rng = np.random.default_rng(0)
    pattern = 40.0 * rng.standard_normal((100, 100))
    darks = [(pattern + READ_DN / 4.0 * rng.standard_normal((100, 100)), 16) for _ in range(2)]
    good = np.ones((100, 100), bool)
    # 9900 differences: their median is known to 2 %
    assert most_read_variance(darks, good) == pytest.approx(1.2 * READ_DN**2, rel=0.08)
    assert most_read_variance(darks[:1], good) is None


@pytest.mark.slow
def test_pixels_that_jump_from_one_averaged_dark_to_the_next_are_noisy(tmp_path):
    rng = np.random.default_rng(3)
    jumping = {(20, 20): 30.0, (40, 7): 45.0}  # DN; the noise of a mean dark is a quarter of READ_DN
    pattern = 1.0 + 0.03 * rng.standard_normal(SHAPE)

    def mean_frame(level, number):
        frame = averaged(level * pattern, rng)
        for place, size in jumping.items():
            frame[0][place] += size * (-1.0) ** number
        return frame

    with write_acquisition(tmp_path / "pairs.h5", Instrument(bits=16, pixel_mm=0.15)) as writer:
        words = {"exposure_ms": 20.0, "averaged": AVERAGED}
        for number in range(4):
            writer.add_series(f"dark_{number}", kind="dark", frames=mean_frame(0.0, number), **words)
            for level in (500.0, 2000.0, 8000.0):
                flat = {"kV": 40.0, "power_W": level / 400.0, **words}
                writer.add_series(f"flat_{number}_{level:g}", kind="flat", frames=mean_frame(level, number), **flat)
    with open_acquisition(tmp_path / "pairs.h5") as acquisition:
        found = compute_photon_transfer(acquisition)
    assert {tuple(place) for place in np.argwhere(found.maps.bad_pixels)} == set(jumping)
    assert found.noise.read_noise_DN.value == pytest.approx(READ_DN, rel=0.05)


@pytest.mark.slow
def test_pixels_between_two_codes_of_an_averaged_dark_are_not_noisy(tmp_path):
    """Means that are stored as whole numbers, their noise far below a code: most pixels never change, some do by one code."""
    rng = np.random.default_rng(4)
    level = rng.uniform(99.0, 103.0, SHAPE)

    def mean_frame(signal):
        exact = (
            level + signal + 0.03 * rng.standard_normal(SHAPE) + np.sqrt(signal / AVERAGED) * rng.standard_normal(SHAPE)
        )
        return np.rint(exact)[None].astype(np.uint16)

    with write_acquisition(tmp_path / "coarse.h5", Instrument(bits=16, pixel_mm=0.15)) as writer:
        words = {"exposure_ms": 20.0, "averaged": AVERAGED}
        for number in range(4):
            writer.add_series(f"dark_{number}", kind="dark", frames=mean_frame(0.0), **words)
            for signal in (500.0, 2000.0, 8000.0):
                flat = {"kV": 40.0, "power_W": signal / 400.0, **words}
                writer.add_series(f"flat_{number}_{signal:g}", kind="flat", frames=mean_frame(signal), **flat)
    with open_acquisition(tmp_path / "coarse.h5") as acquisition:
        darks = np.array([item.read_frames(0, 1)[0] for item in acquisition.of_kind("dark")], float)
        found = compute_photon_transfer(acquisition)
    assert 0.02 < np.mean(np.ptp(darks, axis=0) > 0) < 0.3
    assert not found.maps.bad_pixels.any()

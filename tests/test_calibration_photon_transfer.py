"""Photon transfer of sessions with planted truths and faults: what is found, what is said, what is refused."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from raytwin.acquisition import Setting, open_acquisition, write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.calibration.calibrate import bad_pixel_counts, calibrate_twin, calibration_answer
from raytwin.calibration.flats.photon_transfer import compute_photon_transfer
from raytwin.errors import FitError, InputError
from raytwin.generator.line.twin import BAD_PIXEL_CODES
from raytwin.generator.spread.noise import sample_frame_noise
from raytwin.generator.spread.psf import Spread, blur_variance_share

SHAPE = (40, 40)
GAIN, SIGMA, READ_DN, DARK_DN = 9.0, 0.55, 11.0, 1200.0
DN_PER_MAS = 200000.0
WHITE = 0.01


def flat_frames(level, *, count=24, rng, gain=GAIN, read_DN=READ_DN, dark=DARK_DN, axes="both"):
    """Whole-number frames (count, row, column) of a mean level above dark, one number or (row, column)."""
    mean = np.broadcast_to(np.asarray(level, dtype=np.float64), SHAPE)
    frames = [
        dark
        + mean
        + sample_frame_noise(
            mean,
            gain_DN=gain,
            white_fraction=WHITE,
            read_variance_DN2=read_DN**2,
            spread=Spread(sigma_px=SIGMA, axes=axes),
            rng=rng,
        )
        for _ in range(count)
    ]
    return np.array(frames)


def as_adc(frames, bits=16):
    return np.clip(np.rint(frames), 0, 2**bits - 1).astype(np.uint16)


def write_session(
    path,
    *,
    change=lambda frames, setting, rng: frames,
    powers=(2.0, 5.0, 10.0, 20.0, 40.0),
    with_darks=True,
    kV=40.0,
    bits=16,
    count=24,
    swap=False,
    seed=0,
    axes="both",
    **detector,
):
    """Darks and flats at 40 kV, 20 ms; `change` plants a fault in the frames of every series."""
    rng = np.random.default_rng(seed)
    instrument = Instrument(bits=bits, pixel_mm=0.15, source_detector_mm=1059.0, source_object_mm=990.0, **detector)
    with write_acquisition(path, instrument) as writer:
        if with_darks:
            frames = change(flat_frames(0.0, rng=rng, count=count), None, rng)
            kind = "flat" if swap else "dark"
            writer.add_series("dark", kind=kind, frames=as_adc(frames, bits), setting=Setting(kV=kV, exposure_ms=20.0))
        for power in powers:
            setting = Setting(kV=kV, power_W=power, exposure_ms=20.0)
            level = DN_PER_MAS * setting.tube_load_mAs
            frames = change(flat_frames(level, rng=rng, count=count, axes=axes), setting, rng)
            kind = "dark" if swap else "flat"
            writer.add_series(f"flat_{power:g}W", kind=kind, frames=as_adc(frames, bits), setting=setting)
    return path


def transfer_of(path):
    with open_acquisition(path) as acquisition:
        return compute_photon_transfer(acquisition)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return transfer_of(write_session(tmp_path_factory.mktemp("session") / "clean.h5"))


def is_gain(estimate):
    """Frames of 48 x 48 pixels show a tail of the spread hardly; half of 95 % is a tenth."""
    return estimate.low < GAIN < estimate.high and abs(estimate.value / GAIN - 1.0) < 0.1


def test_a_clean_session_gives_its_truth_and_no_warning(clean):
    assert clean.warnings == ()
    assert clean.evidence["scatter_of_flats"]["relative_sd"] < 0.002
    assert clean.evidence["scatter_of_noise"]["relative_sd"] < 0.01
    (level,) = clean.levels
    assert level.gain_DN.low < GAIN < level.gain_DN.high
    assert is_gain(level.gain_DN)
    slope = GAIN * (blur_variance_share("aperture", SIGMA) + WHITE) / (1 + WHITE)
    assert level.photon_transfer_slope_DN.value == pytest.approx(slope, rel=0.03)
    assert clean.noise.spread.value.sigma_px == pytest.approx(SIGMA, rel=0.03)
    assert clean.noise.read_noise_DN.value == pytest.approx(READ_DN, rel=0.02)
    assert clean.noise.quantised
    assert clean.dark_DN.value == pytest.approx(DARK_DN, abs=0.3)
    assert level.rate_DN_per_mAs.value == pytest.approx(DN_PER_MAS, rel=0.003)
    assert level.saturation_DN is None
    assert np.all(clean.maps.bad_pixels == 0)
    assert all(point.used for point in clean.points)


@pytest.mark.parametrize(("belt_axis", "axes"), [(None, "column"), ("column", "row")])
def test_the_light_of_a_line_camera_spreads_along_its_lines(tmp_path, belt_axis, axes):
    path = write_session(tmp_path / "lines.h5", axes=axes, detector="line", belt_axis=belt_axis)
    found = transfer_of(path)
    assert found.warnings == ()
    assert found.noise.spread.value.axes == axes
    assert is_gain(found.levels[0].gain_DN)
    share = Spread(sigma_px=SIGMA, axes=axes).variance_share
    assert found.levels[0].photon_transfer_slope_DN.value == pytest.approx(
        GAIN * (share + WHITE) / (1 + WHITE), rel=0.03
    )


@pytest.mark.parametrize(("axes", "meant"), [("both", "detector = area or tdi"), ("row", "belt_axis = column")])
def test_a_line_camera_whose_lines_share_light_is_none_and_its_noise_is_believed(tmp_path, axes, meant):
    found = transfer_of(write_session(tmp_path / "lines.h5", axes=axes, detector="line"))
    (warning,) = found.warnings
    assert f"{meant} is taken to be meant" in warning
    assert found.noise.spread.value.axes == axes
    assert is_gain(found.levels[0].gain_DN)


@pytest.mark.parametrize(("share", "known"), [(0.1, True), (0.7, False)])
def test_frames_that_hold_a_share_of_the_last_one_widen_the_gain_or_give_none(tmp_path, share, known):
    """Differences show (1 - a)^2 / (1 + a) of the noise: a third less for a tenth, nearly all for seven."""

    def filtered(frames, setting, rng):
        kept = frames[0]
        result = []
        for frame in frames:
            kept = share * kept + (1.0 - share) * frame
            result.append(kept)
        return np.array(result)

    path = write_session(tmp_path / "filter.h5", change=filtered)
    if not known:
        with pytest.raises(FitError, match="a recursive filter"):
            transfer_of(path)
        return
    found = transfer_of(path)
    gain = found.levels[0].gain_DN
    assert gain.value < 0.85 * GAIN
    assert gain.low < GAIN < gain.high
    assert any("recursive filter" in text for text in found.warnings)


def test_what_pixels_share_is_predicted_as_noise_of_a_pixel(tmp_path, clean):
    """Whole rows that flicker with the light: no frame factor, and nothing of it in the gain."""
    rms = 0.02

    def flickering(frames, setting, rng):
        factors = 1.0 + rms * rng.standard_normal((*frames.shape[:2], 1))
        return DARK_DN + (frames - DARK_DN) * factors if setting is not None else frames

    found = transfer_of(write_session(tmp_path / "rows.h5", change=flickering))
    assert is_gain(found.levels[0].gain_DN)
    shared = found.noise.common_variance
    assert shared.low < rms**2 < shared.high < 1.5 * rms**2
    assert clean.noise.common_variance.low == 0.0
    assert clean.noise.common_variance.high < 0.1 * rms**2


def test_evidence_of_a_clean_session_shows_nothing(clean):
    evidence = clean.evidence
    assert evidence["stack_over_pair_variance"] == pytest.approx(1.0, abs=0.01)
    assert evidence["output_rms_percent"] < 0.1
    assert evidence["linearity"]["largest_departure_percent"] < 0.3
    assert max(abs(value) for value in evidence["drift_percent_per_series"].values()) < 0.5
    assert max(evidence["line_noise_DN"].values()) < 0.1 * READ_DN


def planted(tmp_path, change, **options):
    return transfer_of(write_session(tmp_path / "planted.h5", change=change, **options))


def test_a_drifting_tube_shows_in_the_stack_variance_and_not_in_the_gain(tmp_path):
    def drift(frames, setting, rng):
        if setting is None:
            return frames
        ramp = 1 + 0.04 * np.linspace(-0.5, 0.5, len(frames))[:, None, None]
        return DARK_DN + (frames - DARK_DN) * ramp

    found = planted(tmp_path, drift)
    assert found.evidence["stack_over_pair_variance"] > 1.02
    assert any("drifts or frames are correlated" in line for line in found.warnings)
    assert found.evidence["drift_percent_per_series"]["flat_40W"] == pytest.approx(4.0, abs=0.3)
    assert is_gain(found.levels[0].gain_DN)


def test_lag_shows_as_stack_variances_above_pair_variances(tmp_path):
    def lag(frames, setting, rng):
        result = frames.copy()
        for k in range(1, len(frames)):
            result[k] = 0.9 * frames[k] + 0.1 * result[k - 1]
        return result

    found = planted(tmp_path, lag)
    # C0 (1 - rho) against C0, rho = the lag
    assert found.evidence["stack_over_pair_variance"] == pytest.approx(1 / 0.9, rel=0.03)
    assert any("frames are correlated" in line for line in found.warnings)


def test_output_noise_from_frame_to_frame_is_named_with_its_size(tmp_path):
    def flicker(frames, setting, rng):
        if setting is None:
            return frames
        return DARK_DN + (frames - DARK_DN) * (1 + 0.01 * rng.standard_normal(len(frames)))[:, None, None]

    found = planted(tmp_path, flicker)
    assert 0.6 < found.evidence["output_rms_percent"] < 1.7
    assert any("tube output varies by" in line for line in found.warnings)
    level = found.levels[0]
    assert level.gain_DN.low < GAIN < level.gain_DN.high
    assert is_gain(level.gain_DN)


@pytest.mark.slow
def test_a_nonlinear_detector_departs_from_the_line_in_load(tmp_path):
    def bend(frames, setting, rng):
        signal = frames - DARK_DN
        return DARK_DN + signal * (1 - 0.1 * signal / (DN_PER_MAS * 0.02))

    found = planted(tmp_path, bend)
    assert found.evidence["linearity"]["largest_departure_percent"] > 1.0
    assert any("departs from a line" in line for line in found.warnings)
    # loads of one beam, each over its level: what one more load strays by
    used = [point for point in found.points if point.used]
    rates = np.array([point.signal_DN / point.load_mAs for point in used])
    scatter = found.evidence["scatter_of_flats"]
    assert len({point.kV for point in used}) == 1
    assert scatter["degrees"] == len(used) - 1
    assert scatter["relative_sd"] == pytest.approx(np.std(rates / rates.mean(), ddof=1))
    assert scatter["relative_sd"] > 0.02
    assert found.evidence["scatter_of_noise"]["relative_sd"] > 0.02


def test_a_flat_above_full_well_is_left_out_and_named(tmp_path):
    full_well = DN_PER_MAS * 0.0181

    def clip(frames, setting, rng):
        return np.minimum(frames, DARK_DN + full_well + 0.2 * np.maximum(frames - DARK_DN - full_well, 0))

    found = planted(tmp_path, clip)
    assert any("left out of the fit: flat_40W (its variance bends" in line for line in found.warnings)
    assert is_gain(found.levels[0].gain_DN)


def test_a_saturated_series_is_masked_with_a_warning_and_its_level(tmp_path):
    found = planted(tmp_path, lambda frames, setting, rng: frames, powers=(0.5, 2.0, 5.0, 10.0, 45.0), bits=12)
    assert any("left out of the fit: flat_45W (saturated at 4095 DN)" in line for line in found.warnings)
    assert found.levels[0].saturation_DN == 4095.0
    assert is_gain(found.levels[0].gain_DN)
    assert [point.series for point in found.points if not point.used] == ["flat_45W"]


def test_bad_pixels_are_found_with_their_reasons(tmp_path):
    places = {"dead": (5, 7), "hot": (12, 30), "noisy": (20, 20), "nonlinear": (33, 9)}

    def break_pixels(frames, setting, rng):
        frames = frames.copy()
        frames[:, *places["dead"]] = DARK_DN + READ_DN * rng.standard_normal(len(frames))
        frames[:, *places["hot"]] += 900.0
        frames[:, *places["noisy"]] += 150.0 * rng.standard_normal(len(frames))
        frames[:, *places["nonlinear"]] = DARK_DN + 0.8 * (frames[:, *places["nonlinear"]] - DARK_DN)
        return frames

    found = planted(tmp_path, break_pixels)
    for reason, place in places.items():
        assert found.maps.bad_pixels[place] == BAD_PIXEL_CODES[reason], reason
    assert int(np.sum(found.maps.bad_pixels > 0)) == 4
    assert bad_pixel_counts(found)["dead"] == 1
    assert is_gain(found.levels[0].gain_DN)


def test_pixels_that_firmware_replaced_are_found_and_left_out(tmp_path):
    """A quarter and half of the noise, shared with neighbours: one pixel in twenty had lowered the slope and raised the gain."""
    replaced = np.zeros((40, 40), dtype=bool)
    replaced[4:36:5, 3:28:4] = True  # by the mean of the next four
    copied, column = (20, 37), 34

    def replace_pixels(frames, setting, rng):
        frames = np.rint(frames)
        made = frames.copy()
        next_four = [np.roll(frames, step, axis) for step in (1, -1) for axis in (1, 2)]
        made[:, replaced] = np.rint(np.mean(next_four, axis=0))[:, replaced]
        made[:, :, column] = np.rint(0.5 * (frames[:, :, column - 1] + frames[:, :, column + 1]))
        made[:, *copied] = frames[:, copied[0], copied[1] + 1]
        return made

    found = planted(tmp_path, replace_pixels)
    marked = found.maps.bad_pixels == BAD_PIXEL_CODES["interpolated"]
    expected = replaced.copy()
    expected[1:-1, column] = True  # pixels at the border are not judged
    # of two alike nobody knows which is the copy
    expected[copied] = expected[copied[0], copied[1] + 1] = True
    assert np.array_equal(marked, expected)
    assert any("hold means of their neighbours" in line for line in found.warnings)
    (level,) = found.levels
    assert is_gain(level.gain_DN)
    slope = GAIN * (blur_variance_share("aperture", SIGMA) + WHITE) / (1 + WHITE)
    assert level.photon_transfer_slope_DN.low < slope < level.photon_transfer_slope_DN.high


def test_replaced_pixels_that_so_few_frames_do_not_tell_are_said(tmp_path):
    path = write_session(tmp_path / "few.h5", count=2, powers=(10.0, 20.0))
    with h5py.File(path, "r+") as file:
        for item in file["series"].values():
            item.attrs["corrected"] = "defects"
    assert any("so few frames do not tell which" in line for line in transfer_of(path).warnings)


def test_gain_map_of_a_uniform_detector_is_flat_and_of_two_halves_is_not(tmp_path, clean):
    assert float(np.std(clean.maps.gain_relative)) < 0.04

    def halves(frames, setting, rng):
        scale = np.ones(SHAPE)
        scale[:, 20:] = 1.3
        return DARK_DN + (frames - DARK_DN) * scale

    found = planted(tmp_path, halves)
    ratio = found.maps.gain_relative[:, 22:].mean() / found.maps.gain_relative[:, :18].mean()
    assert 1.1 < ratio < 1.4
    flat = found.levels[0].flat_shape
    assert flat[:, 22:].mean() / flat[:, :18].mean() == pytest.approx(1.3, rel=0.01)


def test_held_back_series_are_not_looked_at(tmp_path):
    path = tmp_path / "roles.h5"
    rng = np.random.default_rng(1)
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=as_adc(flat_frames(0.0, rng=rng)), exposure_ms=20.0)
        for role, level in (("calibration", 500.0), ("calibration", 2000.0), ("evaluation", 60000.0)):
            writer.add_series(
                f"{role}_{level:g}",
                kind="flat",
                frames=as_adc(flat_frames(level, rng=rng)),
                exposure_ms=20.0,
                role=role,
            )
    found = transfer_of(path)
    assert {point.series for point in found.points} == {"calibration_500", "calibration_2000"}


def test_without_kV_there_are_gain_and_noise_but_no_spectral_part(tmp_path):
    path = tmp_path / "plain.h5"
    rng = np.random.default_rng(2)
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=as_adc(flat_frames(0.0, rng=rng)))
        for level in (300.0, 3000.0):
            writer.add_series(f"flat_{level:g}", kind="flat", frames=as_adc(flat_frames(level, rng=rng)))
    with open_acquisition(path) as acquisition:
        answer = calibration_answer(calibrate_twin(acquisition, rng=np.random.default_rng(0)))
    assert answer["levels"][0]["gain_DN"] == pytest.approx(GAIN, rel=0.1)
    assert answer["inherent_filtration_mm_Al"] is None
    assert answer["flux_scale"] is None
    assert any("no series states its kV" in line for line in answer["warnings"])
    assert answer["read_noise_DN"]["low"] < READ_DN < answer["read_noise_DN"]["high"]


def test_averaged_frames_give_the_gain_of_single_ones(tmp_path):
    path = tmp_path / "averaged.h5"
    rng = np.random.default_rng(3)

    def mean_of_four(level):
        return flat_frames(level, rng=rng, count=96).reshape(24, 4, *SHAPE).mean(axis=1).astype(np.float32)

    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=mean_of_four(0.0), exposure_ms=20.0, averaged=4)
        for level in (300.0, 3000.0):
            writer.add_series(f"f{level:g}", kind="flat", frames=mean_of_four(level), exposure_ms=20.0, averaged=4)
    found = transfer_of(path)
    assert is_gain(found.levels[0].gain_DN)
    assert found.noise.read_noise_DN.value == pytest.approx(READ_DN, rel=0.03)


REFUSED = {
    "no darks": ({"with_darks": False}, "flats without a dark series"),
    "kinds swapped": ({"swap": True}, "kinds are not swapped"),
    "all saturated": ({"powers": (400.0, 450.0), "bits": 12}, "no usable flat .flat_400W: saturated at 4095 DN"),
    "a single frame": ({"count": 1, "powers": (5.0,)}, "a single frame has no noise"),
    "no flats": ({"powers": ()}, "no flat series that may calibrate"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_session_that_cannot_calibrate_is_refused_with_the_reason(tmp_path, case):
    options, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        transfer_of(write_session(tmp_path / "bad.h5", **options))


def test_darks_and_flats_of_two_detectors_are_refused(tmp_path):
    path = tmp_path / "two.h5"
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=np.ones((4, 20, 20), dtype=np.uint16))
        writer.add_series("flat", kind="flat", frames=np.ones((4, 20, 24), dtype=np.uint16))
    with pytest.raises(InputError, match="darks and flats of one shape"):
        transfer_of(path)


def test_flats_without_any_noise_are_refused(tmp_path):
    path = tmp_path / "constant.h5"
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=np.full((4, 20, 20), 100, dtype=np.uint16))
        writer.add_series("flat", kind="flat", frames=np.full((4, 20, 20), 900, dtype=np.uint16))
    with pytest.raises(InputError, match="no usable flat"):
        transfer_of(path)


def test_a_level_that_changes_between_repeats_of_a_setting_is_said(tmp_path):
    path = tmp_path / "repeats.h5"
    rng = np.random.default_rng(5)
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=as_adc(flat_frames(0.0, rng=rng)), exposure_ms=20.0)
        for name, level in (("before", 3000.0), ("after", 3045.0), ("same", 3000.0)):
            exposure_ms = 40.0 if name == "same" else 20.0
            frames = as_adc(flat_frames(level, rng=rng))
            writer.add_series(name, kind="flat", frames=frames, exposure_ms=exposure_ms)
    found = transfer_of(path)
    (row,) = found.evidence["repeated_settings"]
    assert row["series"] == ["before", "after"]
    assert row["change_percent"] == pytest.approx(1.5, abs=0.15)
    assert any("the level changed by +1.5 % from before to after" in line for line in found.warnings)


def test_a_steady_level_between_repeats_is_not_mentioned(tmp_path):
    path = tmp_path / "steady.h5"
    rng = np.random.default_rng(6)
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=as_adc(flat_frames(0.0, rng=rng)), exposure_ms=20.0)
        for name in ("before", "after"):
            writer.add_series(name, kind="flat", frames=as_adc(flat_frames(3000.0, rng=rng)), exposure_ms=20.0)
    found = transfer_of(path)
    assert abs(found.evidence["repeated_settings"][0]["change_percent"]) < 0.3
    assert found.warnings == ()


def test_repeats_of_a_dim_level_are_judged_by_the_noise_of_darks_too(tmp_path):
    """Two series of 5 DN above a dark known to 0.3 DN: a change of 2 % says nothing."""
    path = tmp_path / "dim.h5"
    rng = np.random.default_rng(9)
    with write_acquisition(path) as writer:
        dark = flat_frames(0.0, rng=rng, count=3, read_DN=20.0)
        writer.add_series("dark", kind="dark", frames=as_adc(dark), exposure_ms=20.0)
        for name, level in (("before", 5.0), ("after", 5.1)):
            frames = as_adc(flat_frames(level, rng=rng, read_DN=20.0))
            writer.add_series(name, kind="flat", frames=frames, exposure_ms=20.0)
        writer.add_series("bright", kind="flat", frames=as_adc(flat_frames(3000.0, rng=rng)), exposure_ms=100.0)
    found = transfer_of(path)
    (row,) = found.evidence["repeated_settings"]
    assert row["noise_percent"] > 1.0
    assert not any("the level changed" in line for line in found.warnings)


def test_levels_of_repeats_scatter_as_their_sampling_noise_says(tmp_path):
    """Within four standard errors of 39 degrees of freedom; output noise from frame to frame is in the measured part."""
    path = tmp_path / "forty.h5"
    rng = np.random.default_rng(10)
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=as_adc(flat_frames(0.0, rng=rng, count=60)), exposure_ms=20.0)
        for number in range(40):
            frames = as_adc(flat_frames(3000.0, rng=rng, count=6))
            writer.add_series(f"flat_{number}", kind="flat", frames=frames, exposure_ms=20.0)
    (row,) = transfer_of(path).evidence["repeated_settings"]
    levels = np.array(row["mean_signal_DN"])
    scatter = 100.0 * float(np.std(levels, ddof=1)) / levels.mean()
    stated = float(np.sqrt(np.mean(np.square(row["sampling_percent"]))))
    assert scatter / stated == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * 39))


def test_two_frames_of_whole_numbers_still_give_a_fine_dark_level(tmp_path):
    path = tmp_path / "few.h5"
    rng = np.random.default_rng(7)
    with write_acquisition(path) as writer:
        frames = as_adc(flat_frames(0.0, rng=rng, count=2, dark=14.7 + 100, read_DN=3.0))
        writer.add_series("dark", kind="dark", frames=frames, exposure_ms=20.0)
        frames = as_adc(flat_frames(3000.0, rng=rng, count=2, dark=14.7 + 100, read_DN=3.0))
        writer.add_series("flat", kind="flat", frames=frames, exposure_ms=20.0)
    found = transfer_of(path)
    assert found.dark_DN.value == pytest.approx(114.7, abs=4 * 1.2533 * 3.0 / np.sqrt(2 * 1600))


def test_two_frames_leave_the_noise_unbiased(tmp_path: Path) -> None:
    """The variance of two frames is chi-square with one degree of freedom: its long tail is noise, not bad pixels."""
    rng = np.random.default_rng(11)
    path = tmp_path / "two.h5"
    with write_acquisition(path) as writer:
        writer.add_series("dark", kind="dark", frames=(100 + 5 * rng.standard_normal((2, 96, 96))).astype(np.float32))
        quanta = 2.0 * rng.poisson(400.0, (2, 96, 96))
        flat = quanta + 100 + 5 * rng.standard_normal((2, 96, 96))
        writer.add_series("flat", kind="flat", frames=flat.astype(np.float32))
    with open_acquisition(path) as acquisition:
        transfer = compute_photon_transfer(acquisition)
    # 9216 pairs: 1.5 % standard deviation of a variance, 0.75 % of a noise
    assert np.count_nonzero(transfer.maps.bad_pixels) <= 2
    assert transfer.noise.read_noise_DN.value == pytest.approx(5.0, rel=0.03)
    assert transfer.levels[0].photon_transfer_slope_DN.value == pytest.approx(2.0, rel=0.06)


def test_a_flat_whose_dark_was_taken_off_lies_on_the_line_of_raw_ones(tmp_path):
    rng = np.random.default_rng(11)
    path = tmp_path / "mixed.h5"
    with write_acquisition(path, Instrument(bits=16, pixel_mm=0.15, source_detector_mm=1059.0)) as writer:
        dark = flat_frames(0.0, rng=rng)
        writer.add_series("dark", kind="dark", frames=as_adc(dark), setting=Setting(kV=40.0, exposure_ms=20.0))
        for power, corrected in ((5.0, ()), (10.0, ()), (20.0, ("offset",)), (40.0, ())):
            setting = Setting(kV=40.0, power_W=power, exposure_ms=20.0)
            level = DN_PER_MAS * setting.tube_load_mAs
            frames = as_adc(flat_frames(level, rng=rng))
            if corrected:
                frames = frames.astype(np.float32) - dark.mean(axis=0).astype(np.float32)
            writer.add_series(f"flat_{power:g}W", kind="flat", frames=frames, setting=setting, corrected=corrected)
    found = transfer_of(path)
    (level,) = found.levels
    assert len(level.series) == 4
    assert level.rate_DN_per_mAs.value == pytest.approx(DN_PER_MAS, rel=2e-3)
    for point in found.points:
        assert point.used
        assert point.signal_DN == pytest.approx(DN_PER_MAS * point.load_mAs, rel=5e-3)

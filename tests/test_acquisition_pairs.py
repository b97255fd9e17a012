"""From object series to a dataset: correction in closed form, pairing by scene, contrasts of the low-noise pair."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition import (
    Instrument,
    dataset_from_acquisition,
    delta_r,
    flat_corrected_log,
    mean_of_frames,
    object_pairs,
    open_acquisition,
    read_dataset,
    replace_bad_pixels,
    setting_from_text,
    split_by_product,
    unpaired_objects,
    write_acquisition,
)
from raytwin.errors import InputError

SHAPE = (40, 48)
LOW, HIGH = (setting_from_text(f"kv={kv},power_w=40,exposure_ms=100,filter=Cu:0.05") for kv in (40, 90))
DARK, FLAT = 100.0, 4000.0


def at(setting, exposure_ms, averaged=1):
    return setting_from_text(str(setting).replace("exposure_ms=100", f"exposure_ms={exposure_ms},averaged={averaged}"))


def log_images(number):
    """A drawn fillet, with a bone in odd numbers."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    high = 0.4 * np.exp(-((row - 20) ** 2 + (column - 24) ** 2) / 400)
    mask = (np.abs(row - 20) < 3) & (np.abs(column - 20 - number) < 5) & bool(number % 2)
    return high * (1.7 + 0.1 * number * mask), high, mask


def counts_of(image):
    return np.rint(DARK + (FLAT - DARK) * np.exp(-image)).astype(np.uint16)


def write(path, *, scenes=3, exposures=((100, 1),), noise=0.0, dark=True, flat=True, extra=None, masks=True):
    rng = np.random.default_rng(5)
    with write_acquisition(path, Instrument(pixel_mm=0.15)) as writer:
        if dark:
            for exposure_ms in sorted({exposure for exposure, _ in exposures}):
                for when in ("before", "after"):
                    frames = np.full((3, *SHAPE), DARK + (1 if when == "after" else -1), np.uint16)
                    writer.add_series(f"dark_{when}_{exposure_ms}", kind="dark", frames=frames, exposure_ms=exposure_ms)
        for setting in (LOW, HIGH) if flat else ():
            for exposure_ms in sorted({exposure for exposure, _ in exposures}):
                frames = np.full((4, *SHAPE), FLAT, np.uint16)
                name = f"flat_{setting.kV:g}_{exposure_ms}"
                writer.add_series(name, kind="flat", frames=frames, setting=at(setting, exposure_ms, 5))
        for number in range(scenes):
            *images, mask = log_images(number)
            for exposure_ms, averaged in exposures:
                for setting, image in zip((LOW, HIGH), images, strict=True):
                    frames = counts_of(image)[None].astype(np.float32)
                    frames = frames + noise / np.sqrt(exposure_ms * averaged) * rng.normal(size=(2, *SHAPE))
                    writer.add_series(
                        f"p{number}_{setting.kV:g}_{exposure_ms}_{averaged}",
                        kind="object",
                        frames=frames,
                        setting=at(setting, exposure_ms, averaged),
                        scene=f"p{number}",
                    )
            writer.add_scene(
                f"p{number}",
                kind="product",
                foreign_object_mask=mask if masks else None,
                product=f"fillet {number // 2}",
                foreign_object="rib" if number % 2 else "",
                size_mm=3.0 if number % 2 else None,
                attributes={"split": "train"},
            )
        if extra is not None:
            extra(writer)


# Correction


@given(st.floats(0, 3), st.floats(50, 2000), st.floats(100, 60000))
def test_correction_undoes_attenuation_whatever_dark_and_flat(log_image, dark, signal):
    counts = np.full((2, 2), dark + signal * np.exp(-log_image))
    corrected = flat_corrected_log(counts, dark_DN=np.full((2, 2), dark), flat_DN=np.full((2, 2), dark + signal))
    floor = max(signal * np.exp(-log_image), 1.0)
    np.testing.assert_allclose(corrected, -np.log(floor / signal), rtol=1e-5, atol=2e-6)


def test_signals_below_the_minimum_are_set_to_it_so_that_nothing_is_infinite():
    counts = np.array([[0.0, 100.0, 100.5, 102.0]])
    flat = np.full((1, 4), 1100.0)
    np.testing.assert_allclose(
        flat_corrected_log(counts, dark_DN=100.0, flat_DN=flat), np.log([[1000.0, 1000.0, 1000.0, 500.0]]), rtol=1e-6
    )
    assert np.isfinite(flat_corrected_log(counts, dark_DN=100.0, flat_DN=np.zeros((1, 4)))).all()


def test_bad_pixels_become_the_median_of_good_neighbours():
    image = np.arange(30.0).reshape(5, 6)
    bad = np.zeros((5, 6), bool)
    bad[2, 3] = True
    assert replace_bad_pixels(image, bad)[2, 3] == 15.0  # the median of 9, 14, 16, 21
    bad[1, 3] = bad[3, 3] = bad[2, 2] = True  # one good neighbour of four is left: the eight are asked
    assert replace_bad_pixels(image, bad)[2, 3] == np.median([8, 10, 16, 20, 22])
    bad[:] = True
    bad[0, 0] = False
    np.testing.assert_array_equal(replace_bad_pixels(image, bad), 0.0)
    corner = np.zeros((5, 6), bool)
    corner[0, 0] = True
    assert replace_bad_pixels(image, corner)[0, 0] == np.median([1, 6])


def test_bad_pixels_are_replaced_in_every_frame_and_nothing_else_changes():
    rng = np.random.default_rng(0)
    frames = rng.normal(size=(3, 8, 9)).astype(np.float32)
    bad = rng.random((8, 9)) < 0.2
    repaired = replace_bad_pixels(frames, bad)
    np.testing.assert_array_equal(repaired[:, ~bad], frames[:, ~bad])
    for frame, whole in zip(frames, repaired, strict=True):
        np.testing.assert_array_equal(replace_bad_pixels(frame, bad), whole)
    with pytest.raises(InputError, match="every pixel bad"):
        replace_bad_pixels(frames, np.ones((8, 9), bool))
    with pytest.raises(InputError, match=r"map of bad pixels: got 3 x 3 pixels"):
        replace_bad_pixels(frames, np.ones((3, 3), bool))


def test_the_mean_of_series_weighs_averaged_frames_as_many(tmp_path):
    with write_acquisition(tmp_path / "a.h5") as writer:
        writer.add_series("one", kind="flat", frames=np.zeros((3, 2, 2), np.uint16))
        writer.add_series("ten", kind="flat", frames=np.full((1, 2, 2), 13.0), averaged=10)
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        np.testing.assert_allclose(mean_of_frames(acquisition.series), 10.0)


# Pairing


def test_series_of_a_scene_pair_by_exposure_and_averaging(tmp_path):
    write(tmp_path / "a.h5", exposures=((100, 10), (100, 1), (20, 1)))
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        pairs = object_pairs(acquisition)
        assert len(pairs) == 9
        for pair in pairs:
            assert (pair.low.kV, pair.high.kV) == (40, 90)
            assert pair.low.scene == pair.high.scene == pair.scene
            assert (pair.low.exposure_ms, pair.low.averaged) == (pair.high.exposure_ms, pair.high.averaged)
        assert unpaired_objects(acquisition) == ()


def test_what_makes_no_pair_is_told_with_its_reason(tmp_path):
    def extra(writer):
        frames = np.full((1, *SHAPE), 200, np.uint16)
        writer.add_series("alone", kind="object", frames=frames, setting=LOW, scene="q")
        writer.add_series("nowhere", kind="object", frames=frames, setting=LOW)
        writer.add_series("unknown", kind="object", frames=frames, scene="q")

    write(tmp_path / "a.h5", extra=extra)
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        assert len(object_pairs(acquisition)) == 3
        assert unpaired_objects(acquisition) == (
            "object series alone: scene q has no partner for it at another tube voltage",
            "object series nowhere: it names no scene",
            "object series unknown: its tube voltage or exposure time is unknown",
        )


def test_different_exposures_of_the_two_voltages_pair_where_that_cannot_be_mistaken(tmp_path):
    frames = np.full((1, *SHAPE), 200, np.uint16)
    with write_acquisition(tmp_path / "a.h5") as writer:
        writer.add_series("low", kind="object", frames=frames, setting=at(LOW, 50), scene="p")
        writer.add_series("high", kind="object", frames=frames, setting=at(HIGH, 20), scene="p")
        for number in range(2):
            writer.add_series(f"r{number}", kind="object", frames=frames, setting=at(LOW, 50), scene="r")
            writer.add_series(f"s{number}", kind="object", frames=frames, setting=at(HIGH, 50), scene="r")
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        names = [(pair.low.name, pair.high.name) for pair in object_pairs(acquisition)]
    assert names == [("low", "high"), ("r0", "s0"), ("r1", "s1")]


# Datasets


def test_a_dataset_holds_the_log_images_masks_and_rows_of_every_scene(tmp_path):
    write(tmp_path / "a.h5")
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        summary = dataset_from_acquisition(acquisition, tmp_path / "d.h5")
    assert (summary.images, summary.with_foreign_object, summary.shape, summary.skipped) == (3, 1, SHAPE, ())
    with read_dataset(tmp_path / "d.h5") as dataset:
        for number, row in enumerate(dataset.rows):
            low, high, mask = log_images(number)
            # One DN of rounding: at most 0.5 / (3900 exp(-0.7)) in the log.
            np.testing.assert_allclose(dataset.images(number), [low, high], atol=3e-4)
            np.testing.assert_array_equal(dataset.counts(number), [counts_of(low), counts_of(high)])
            np.testing.assert_array_equal(dataset.foreign_object_masks(number), mask)
            np.testing.assert_array_equal(dataset.product_masks(number), dataset.images(number)[0] > 0.1)
            assert (row.image, row.product, row.split) == (f"p{number}", f"fillet {number // 2}", "train")
            assert row.foreign_object == ("rib" if number % 2 else "")
            assert row.size_mm == 3.0 if number % 2 else np.isnan(row.size_mm)
            low_text, high_text = row.setting.split(";")
            assert setting_from_text(low_text) == at(LOW, 100, 2) and setting_from_text(high_text) == at(HIGH, 100, 2)
        assert dataset.rows[1].contrast == pytest.approx(0.1, abs=5e-3)
        assert np.isnan(dataset.rows[0].contrast)


def test_contrasts_of_noisy_pairs_come_from_the_longest_exposure_of_the_same_scene(tmp_path):
    write(tmp_path / "a.h5", exposures=((20, 1), (100, 10)), noise=2000.0)
    short, long = (at(LOW, 20), at(HIGH, 20)), (at(LOW, 100, 10), at(HIGH, 100, 10))
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        dataset_from_acquisition(acquisition, tmp_path / "d.h5", low=short[0], high=short[1])
        dataset_from_acquisition(acquisition, tmp_path / "l.h5", low=long[0], high=long[1])
    with read_dataset(tmp_path / "d.h5") as d, read_dataset(tmp_path / "l.h5") as long_ones:
        assert d.rows[1].contrast == long_ones.rows[1].contrast
        expected = delta_r(*long_ones.images(1), long_ones.foreign_object_masks(1))
        assert d.rows[1].contrast == pytest.approx(expected, rel=1e-5)
        assert abs(d.rows[1].contrast - delta_r(*d.images(1), d.foreign_object_masks(1))) > 1e-3
        assert d.rows[1].setting != long_ones.rows[1].setting


def test_each_frame_can_make_an_image_of_its_own(tmp_path):
    write(tmp_path / "a.h5", noise=500.0)
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        summary = dataset_from_acquisition(acquisition, tmp_path / "d.h5", each_frame=True, with_counts=False)
        frames = next(series for series in acquisition.series if series.name == "p0_40_100_1").read_frames()
    assert summary.images == 6
    with read_dataset(tmp_path / "d.h5") as dataset:
        assert [row.image for row in dataset.rows[:2]] == ["p0", "p0#2"]
        assert setting_from_text(dataset.rows[0].setting.split(";")[0]) == LOW
        assert not dataset.has_counts
        expected = flat_corrected_log(frames, dark_DN=DARK, flat_DN=np.full(SHAPE, FLAT))
        np.testing.assert_allclose(dataset.images([0, 1])[:, 0], expected, rtol=1e-5, atol=1e-6)


def test_a_setting_is_chosen_without_naming_its_filter_where_only_one_fits(tmp_path):
    write(tmp_path / "a.h5", exposures=((20, 1), (100, 10)))
    wanted = [setting_from_text(f"kv={kv},exposure_ms=20") for kv in (40, 90)]
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        summary = dataset_from_acquisition(acquisition, tmp_path / "d.h5", low=wanted[0], high=wanted[1])
        assert summary.images == 3
        with pytest.raises(
            InputError, match=r"setting pair: got 2 that fit \(none was chosen\); expected one of kv=40"
        ):
            dataset_from_acquisition(acquisition, tmp_path / "e.h5")
        with pytest.raises(
            InputError, match=r"nearest differs in kv, current_ma or power_w of low\); expected one of kv=40"
        ):
            dataset_from_acquisition(acquisition, tmp_path / "e.h5", low=HIGH)
    assert not (tmp_path / "e.h5").exists()


def test_a_setting_is_chosen_without_naming_how_many_were_averaged(tmp_path):
    write(tmp_path / "a.h5", exposures=((20, 1), (100, 10)))
    wanted = [setting_from_text(f"kv={kv},exposure_ms=100") for kv in (40, 90)]
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        found = dataset_from_acquisition(acquisition, tmp_path / "d.h5", low=wanted[0], high=wanted[1])
        with pytest.raises(InputError, match=r"nearest differs in averaged of low; exposure_ms of high\)"):
            dataset_from_acquisition(
                acquisition,
                tmp_path / "e.h5",
                low=replace(wanted[0], averaged=5),
                high=replace(wanted[1], exposure_ms=90),
            )
    assert found.images == 3
    # two frames, each the mean of ten
    assert [setting_from_text(text.split(";")[0]) for text in found.settings] == [at(LOW, 100, 20)]


def test_without_dark_flat_or_mask_the_message_says_what_to_measure(tmp_path):
    cases = [
        (
            {"dark": False},
            "darks for series p0_40_100_1: got none at its exposure time; expected a dark series of 100 ms",
        ),
        ({"flat": False}, "flats for series p0_40_100_1: got none at kv=40"),
        ({"masks": False}, "expected scenes with foreign_object_mask"),
        ({"scenes": 0}, "got 0 object series that make no pair"),
    ]
    for options, message in cases:
        write(tmp_path / "a.h5", **options)
        with open_acquisition(tmp_path / "a.h5") as acquisition, pytest.raises(InputError) as caught:
            dataset_from_acquisition(acquisition, tmp_path / "d.h5")
        assert message in str(caught.value) and "\n" not in str(caught.value)
        assert not (tmp_path / "d.h5").exists()


@pytest.mark.parametrize("held", ["logarithms", "shares"])
def test_frames_that_are_divided_by_their_open_field_already_pass_through(tmp_path, held):
    low, high, mask = log_images(1)
    corrected = ("offset", "gain", "log") if held == "logarithms" else ("offset", "gain")
    with write_acquisition(tmp_path / "a.h5") as writer:
        for setting, image in ((LOW, low), (HIGH, high)):
            writer.add_series(
                f"{setting.kV:g}",
                kind="object",
                frames=image[None] if held == "logarithms" else np.exp(-image[None]),
                setting=setting,
                scene="p",
                corrected=corrected,
            )
        writer.add_scene("p", kind="product", foreign_object_mask=mask)
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        summary = dataset_from_acquisition(acquisition, tmp_path / "d.h5")
    assert summary.notes == ("no counts: the frames are not raw",)
    with read_dataset(tmp_path / "d.h5") as dataset:
        np.testing.assert_allclose(dataset.images(0), [low, high], rtol=1e-6, atol=1e-6)
        assert dataset.rows[0].foreign_object == "unnamed" and not dataset.has_counts


def test_bad_pixels_do_not_reach_the_images(tmp_path):
    def extra(writer):
        pass

    write(tmp_path / "a.h5", extra=extra)
    bad = np.zeros(SHAPE, bool)
    bad[20, 30] = True
    with open_acquisition(tmp_path / "a.h5") as acquisition:
        dataset_from_acquisition(acquisition, tmp_path / "d.h5", bad_pixels=bad)
        dataset_from_acquisition(acquisition, tmp_path / "e.h5")
    with read_dataset(tmp_path / "d.h5") as repaired, read_dataset(tmp_path / "e.h5") as raw:
        np.testing.assert_array_equal(repaired.images(0), replace_bad_pixels(raw.images(0), bad))


def test_products_are_dealt_out_whole():
    products = {f"scene {number}": f"fillet {number // 3}" for number in range(30)}
    splits = split_by_product(products, validation=0.2, test=0.3, rng=np.random.default_rng(1))
    assert splits == split_by_product(products, validation=0.2, test=0.3, rng=np.random.default_rng(1))
    assert splits != split_by_product(products, validation=0.2, test=0.3, rng=np.random.default_rng(2))
    for fillet in range(10):
        assert len({splits[f"scene {number}"] for number in range(3 * fillet, 3 * fillet + 3)}) == 1
    counts = [list(splits.values()).count(split) for split in ("train", "val", "test")]
    assert counts == [15, 6, 9]
    with pytest.raises(InputError, match="validation and test shares"):
        split_by_product(products, validation=0.8, test=0.3, rng=np.random.default_rng(1))

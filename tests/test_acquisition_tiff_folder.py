"""TIFF folders in the paper's layout: what is written is what the importer of that layout reads."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition import Setting, read_dataset
from raytwin.acquisition.dataset_io import DatasetRow, write_dataset
from raytwin.acquisition.setting import filters_from_text
from raytwin.acquisition.tiff_folder import setting_folder_name, write_tiff_folder
from raytwin.acquisition.zenodo import import_zenodo
from raytwin.errors import InputError

COPPER = filters_from_text("Cu:0.05")
LOW = Setting(kV=40.0, power_W=40.0, exposure_ms=100.0, averaged=10, filters=COPPER)
HIGH = Setting(kV=90.0, power_W=45.0, exposure_ms=100.0, averaged=10, filters=COPPER)
SHAPE = (20, 24)


def dataset_file(path, *, settings=((LOW, HIGH),), images=5):
    rng = np.random.default_rng(0)
    with write_dataset(path, shape=SHAPE) as writer:
        for low, high in settings:
            for number in range(images):
                foreign = np.zeros(SHAPE, dtype=bool)
                if number % 2:
                    foreign[5:8, 6:10] = True
                writer.append(
                    image=rng.random((2, *SHAPE)).astype(np.float32),
                    foreign_object_mask=foreign,
                    product_mask=np.ones(SHAPE),
                    row=DatasetRow(
                        image=f"image{number}",
                        product=f"fillet{number}",
                        foreign_object="rib" if number % 2 else "",
                        size_mm=3.25 if number % 2 else math.nan,
                        contrast=0.0625 if number % 2 else math.nan,
                        split=("train", "val", "test")[number % 3],
                        setting=f"{low};{high}",
                    ),
                )
    return path


def test_a_dataset_comes_back_through_the_importer_of_the_layout(tmp_path):
    with read_dataset(dataset_file(tmp_path / "d.h5")) as dataset:
        written = write_tiff_folder(dataset, tmp_path / "tiff")
        assert written.images == 5
        assert written.trees == ("40kV_40W_100ms_10avg", "90kV_45W_100ms_10avg")
        assert "Cu:0.05" in written.notes[0]
        report = import_zenodo(tmp_path / "tiff", tmp_path / "back.h5")
        assert report.skipped == ()
        with read_dataset(tmp_path / "back.h5") as back:
            assert len(back) == 5
            found = {row.product: number for number, row in enumerate(back.rows)}
            for number, row in enumerate(dataset.rows):
                again = found[row.product]
                np.testing.assert_array_equal(back.images(again), dataset.images(number))
                np.testing.assert_array_equal(back.product_masks(again), dataset.product_masks(number))
                np.testing.assert_array_equal(back.foreign_object_masks(again), dataset.foreign_object_masks(number))
                same = back.rows[again]
                assert (same.split, same.foreign_object, same.setting) == (row.split, row.foreign_object, row.setting)
                np.testing.assert_equal((same.size_mm, same.contrast), (row.size_mm, row.contrast))


def test_the_tables_have_the_paper_s_columns_and_the_image_s_name(tmp_path):
    with read_dataset(dataset_file(tmp_path / "d.h5")) as dataset:
        write_tiff_folder(dataset, tmp_path / "tiff")
    table = tmp_path / "tiff" / "40kV_40W_100ms_10avg" / "val" / "RibBone.csv"
    with table.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert rows[0] == {
        "ID": "1",
        "FO_size": "3.25",
        "Contrast": "0.0625",
        "Chicken_ID": "fillet1",
        "Bone_Class": "rib",
        "Bone_ID": "",
        "Image": "image1",
    }


def test_several_exposures_are_several_trees(tmp_path):
    short = tuple(replace(one, exposure_ms=20.0, averaged=1) for one in (LOW, HIGH))
    with read_dataset(dataset_file(tmp_path / "d.h5", settings=((LOW, HIGH), short))) as dataset:
        assert "40kV_40W_20ms" in write_tiff_folder(dataset, tmp_path / "tiff").trees
    import_zenodo(tmp_path / "tiff", tmp_path / "back.h5")
    with read_dataset(tmp_path / "back.h5") as back:
        assert len(back) == 10


def test_a_setting_s_folder_states_kv_power_time_and_averaging():
    assert setting_folder_name(replace(LOW, exposure_ms=12.5, averaged=1)) == "40kV_40W_12.5ms"
    assert setting_folder_name(Setting(kV=60.0, current_mA=0.5, exposure_ms=20.0)) == "60kV_30W_20ms"
    with pytest.raises(InputError, match="a tube load"):
        setting_folder_name(Setting(kV=60.0, exposure_ms=20.0))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (((LOW, HIGH), (LOW, replace(HIGH, kV=100.0))), "one partner for each tree"),
        (((replace(LOW, power_W=None), HIGH),), "a tube load"),
    ],
)
def test_what_the_layout_cannot_hold_is_refused_and_leaves_nothing(tmp_path, settings, message):
    with (
        read_dataset(dataset_file(tmp_path / "d.h5", settings=settings)) as dataset,
        pytest.raises(InputError, match=message),
    ):
        write_tiff_folder(dataset, tmp_path / "tiff")
    assert [path.name for path in tmp_path.iterdir()] == ["d.h5"]


def test_a_folder_with_something_in_it_is_left_alone(tmp_path):
    (tmp_path / "tiff").mkdir()
    (tmp_path / "tiff" / "mine.txt").write_text("mine")
    with (
        read_dataset(dataset_file(tmp_path / "d.h5")) as dataset,
        pytest.raises(InputError, match="a new or empty folder"),
    ):
        write_tiff_folder(dataset, tmp_path / "tiff")
    assert (tmp_path / "tiff" / "mine.txt").read_text() == "mine"

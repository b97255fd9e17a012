"""The dataset file: pairs, masks and rows come back; what does not fit is one clear line."""

import pickle

import h5py
import numpy as np
import pytest

from raytwin.acquisition import (
    DatasetRow,
    concatenate_datasets,
    read_dataset,
    write_dataset,
    write_selected,
)
from raytwin.errors import FileFormatError, InputError

SHAPE = (6, 7)


def pair(number, *, seed=0):
    rng = np.random.default_rng([seed, number])
    image = rng.normal(size=(2, *SHAPE)).astype(np.float32)
    return image, rng.random(SHAPE) > 0.5, rng.random(SHAPE) > 0.2


def write(path, n=5, *, counts=False, seed=0, shape=SHAPE):
    with write_dataset(path, shape=shape, provenance={"seed": seed, "settings": ["a", "b"], "note": None}) as writer:
        for number in range(n):
            image, foreign, product = pair(number, seed=seed)
            writer.append(
                image=image,
                counts=100 * image if counts else None,
                foreign_object_mask=foreign if number % 2 else None,
                product_mask=product,
                row=DatasetRow(
                    image=f"i{number}",
                    product=f"fillet {number // 2} ä",
                    foreign_object="rib" if number % 2 else "",
                    size_mm=2.5 if number % 2 else np.nan,
                    contrast=0.1 * number if number % 2 else np.nan,
                    split=("train", "val", "test")[number % 3],
                    setting="kv=40,exposure_ms=20;kv=90,exposure_ms=20",
                ),
            )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "d.h5"


def test_pairs_masks_and_rows_come_back_as_written(path):
    write(path, counts=True)
    with read_dataset(path) as dataset:
        assert len(dataset) == 5 and dataset.shape == SHAPE and dataset.has_counts
        assert dataset.attributes["seed"] == 0 and dataset.attributes["settings"] == '["a", "b"]'
        assert "raytwin_version" in dataset.attributes and "note" not in dataset.attributes
        for number in range(5):
            image, foreign, product = pair(number)
            np.testing.assert_array_equal(dataset.images(number), image)
            np.testing.assert_allclose(dataset.counts(number), 100 * image, rtol=1e-6)
            np.testing.assert_array_equal(dataset.product_masks(number), product)
            np.testing.assert_array_equal(dataset.foreign_object_masks(number), foreign if number % 2 else False)
        row = dataset.rows[3]
        assert (row.image, row.product, row.foreign_object) == ("i3", "fillet 1 ä", "rib")
        assert (row.size_mm, row.split) == (2.5, "train") and row.contrast == pytest.approx(0.3)
        assert np.isnan(dataset.rows[0].size_mm) and np.isnan(dataset.rows[0].contrast)


def test_the_layout_is_the_one_that_others_read(path):
    write(path, counts=True)
    with h5py.File(path) as file:
        assert (file.attrs["format"], file.attrs["version"]) == ("raytwin-dataset", 1)
        assert file["images"].shape == (5, 2, *SHAPE) and file["images"].dtype == np.float32
        assert file["counts"].shape == file["images"].shape
        for mask in ("foreign_object_masks", "product_masks"):
            assert file[mask].shape == (5, *SHAPE) and file[mask].dtype == np.uint8
        assert set(file["rows"]) == {"image", "product", "foreign_object", "size_mm", "contrast", "split", "setting"}
        assert all(column.shape == (5,) for column in file["rows"].values())


@pytest.mark.parametrize(
    ("selection", "numbers"),
    [
        (slice(1, 3), [1, 2]),
        (slice(None, None, -2), [4, 2, 0]),
        ([4, 1, 1], [4, 1, 1]),
        (np.array([True, False, False, False, True]), [0, 4]),
        ([-1], [4]),
        ([], []),
    ],
)
def test_a_selection_is_read_in_its_own_order(path, selection, numbers):
    write(path)
    with read_dataset(path) as dataset:
        images = dataset.images(selection)
        assert images.shape == (len(numbers), 2, *SHAPE)
        for image, number in zip(images, numbers, strict=True):
            np.testing.assert_array_equal(image, pair(number)[0])
        assert dataset.counts(selection) is None


def test_splits_and_columns_can_be_asked_for(path):
    write(path)
    with read_dataset(path) as dataset:
        np.testing.assert_array_equal(dataset.indices(split="train"), [0, 3])
        np.testing.assert_array_equal(dataset.indices(setting="other"), [])
        assert dataset.column("image").tolist() == ["i0", "i1", "i2", "i3", "i4"]
        np.testing.assert_array_equal(dataset.column("size_mm"), [np.nan, 2.5, np.nan, 2.5, np.nan])
        with pytest.raises(InputError, match="split: got 'training'; expected one of train, val, test"):
            dataset.indices(split="training")
        with pytest.raises(InputError, match="image number: got 5 to 5; expected 0 to 4"):
            dataset.images(5)


def test_a_dataset_can_be_handed_to_another_process(path):
    write(path)
    with read_dataset(path) as dataset, pickle.loads(pickle.dumps(dataset)) as copy:
        np.testing.assert_array_equal(copy.images(2), dataset.images(2))


def test_a_selection_and_a_concatenation_are_datasets_again(tmp_path):
    write(tmp_path / "a.h5", counts=True)
    write(tmp_path / "b.h5", n=2, seed=1)
    with read_dataset(tmp_path / "a.h5") as a, read_dataset(tmp_path / "b.h5") as b:
        write_selected(a, tmp_path / "c.h5", selection=[3, 0], split="val")
        concatenate_datasets([a, b], tmp_path / "d.h5")
        with read_dataset(tmp_path / "c.h5") as c:
            assert [row.image for row in c.rows] == ["i3", "i0"] and {row.split for row in c.rows} == {"val"}
            assert c.has_counts and c.attributes["seed"] == 0
            np.testing.assert_array_equal(c.images(0), a.images(3))
        with read_dataset(tmp_path / "d.h5") as d:
            assert len(d) == 7 and not d.has_counts
            np.testing.assert_array_equal(d.images(6), b.images(1))
            assert d.rows[6].size_mm == 2.5


def test_datasets_of_different_shapes_are_not_joined(tmp_path):
    write(tmp_path / "a.h5")
    with write_dataset(tmp_path / "b.h5", shape=(2, 2)) as writer:
        writer.append(
            image=np.zeros((2, 2, 2)), foreign_object_mask=None, product_mask=np.ones((2, 2)), row=DatasetRow(image="x")
        )
    with read_dataset(tmp_path / "a.h5") as a, read_dataset(tmp_path / "b.h5") as b:
        with pytest.raises(InputError, match="got images of 2 x 2 pixels; expected 6 x 7 as in"):
            concatenate_datasets([a, b], tmp_path / "c.h5")
        with pytest.raises(InputError, match="got no images"):
            concatenate_datasets([], tmp_path / "c.h5")
    assert not (tmp_path / "c.h5").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda f: f.attrs.__setitem__("format", "raytwin-acquisition"),
            "got an acquisition, frames of a session (format",
        ),
        (lambda f: f.__delitem__("images"), "images: got no such array"),
        (lambda f: f.__delitem__("rows"), "rows: got nothing"),
        (lambda f: f["rows"].__delitem__("split"), "rows/split: got nothing; expected 5 values"),
        (lambda f: (f["rows"].__delitem__("image"), f["rows"].create_dataset("image", data=[1, 2])), "got shape (2,)"),
        (lambda f: (f["rows"].__delitem__("image"), f["rows"].create_dataset("image", data=[1] * 5)), "expected texts"),
        (
            lambda f: (f["rows"].__delitem__("size_mm"), f["rows"].create_dataset("size_mm", data=["a"] * 5)),
            "rows/size_mm: got values of type object; expected numbers",
        ),
        (lambda f: f["rows/split"].__setitem__(2, "exam"), "split of image i2: got 'exam'"),
        (lambda f: f["rows/size_mm"].__setitem__(2, -1.0), "size_mm of image i2: got -1"),
        (lambda f: f["rows/contrast"].__setitem__(2, np.inf), "contrast of image i2: got inf"),
        (
            lambda f: (f.__delitem__("product_masks"), f.create_dataset("product_masks", data=np.zeros((5, 2, 2)))),
            "product_masks: got shape (5, 2, 2); expected shape (5, 6, 7)",
        ),
        (lambda f: f.__delitem__("foreign_object_masks"), "foreign_object_masks: got no such array"),
    ],
)
def test_a_file_that_is_no_dataset_says_where(path, change, message):
    write(path)
    with h5py.File(path, "a") as file:
        change(file)
    with pytest.raises(FileFormatError) as caught:
        read_dataset(path)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_truncated_dataset_is_told_from_another_file(path, tmp_path):
    write(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(FileFormatError, match="truncated"):
        read_dataset(path)
    with pytest.raises(FileFormatError, match="got no such file; expected a dataset file"):
        read_dataset(tmp_path / "absent.h5")


def test_an_image_that_is_not_finite_is_named_when_it_is_read(path):
    write(path)
    with h5py.File(path, "a") as file:
        file["images"][3, 1, 2, 2] = np.nan
    with read_dataset(path) as dataset:
        assert dataset.images(slice(0, 3)).shape[0] == 3
        for selection in (3, slice(2, 5), [4, 3]):
            with pytest.raises(FileFormatError, match="images, image i3: got a value that is not finite"):
                dataset.images(selection)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"image": np.zeros((2, 3, 3))}, r"image x: got shape \(2, 3, 3\); expected shape \(2, 6, 7\)"),
        ({"image": np.full((2, *SHAPE), np.nan)}, "image x: got a value that is not finite"),
        ({"product_mask": np.zeros((3, 3))}, "product mask of image x: got shape"),
        ({"foreign_object_mask": np.zeros((3, 3))}, "foreign-object mask of image x: got shape"),
        ({"counts": np.zeros((2, 3, 3))}, "counts of image x: got shape"),
    ],
)
def test_what_does_not_fit_leaves_no_file_behind(path, given, message):
    whole = {"image": np.zeros((2, *SHAPE)), "product_mask": np.ones(SHAPE), "foreign_object_mask": None}
    with pytest.raises(InputError, match=message), write_dataset(path, shape=SHAPE) as writer:
        writer.append(**(whole | given), row=DatasetRow(image="x"))
    assert not list(path.parent.iterdir())


def test_counts_are_kept_for_all_images_or_for_none(path):
    whole = {"image": np.zeros((2, *SHAPE)), "product_mask": np.ones(SHAPE), "foreign_object_mask": None}
    with pytest.raises(InputError, match="counts of image y: got none"), write_dataset(path, shape=SHAPE) as writer:
        writer.append(**whole, counts=np.ones((2, *SHAPE)), row=DatasetRow(image="x"))
        writer.append(**whole, row=DatasetRow(image="y"))
    with pytest.raises(InputError, match="got no images"), write_dataset(path, shape=SHAPE):
        pass
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"image": ""}, "image of a dataset row: got an empty text"),
        ({"image": "a", "split": "x"}, "split of image a"),
        ({"image": "a", "size_mm": -1.0}, "size_mm of image a"),
        ({"image": "a", "contrast": np.inf}, "contrast of image a"),
    ],
)
def test_a_row_knows_what_it_may_hold(values, message):
    with pytest.raises(InputError, match=message):
        DatasetRow(**values)


def test_every_image_is_a_compressed_chunk_of_its_own(tmp_path):
    path = tmp_path / "d.h5"
    rng = np.random.default_rng(0)
    with write_dataset(path, shape=(64, 80)) as writer:
        for number in range(3):
            counts = rng.poisson(1500, (2, 64, 80)).astype(np.float32)
            writer.append(
                image=-np.log(counts / 3000),
                counts=counts,
                foreign_object_mask=None,
                product_mask=np.ones((64, 80)),
                row=DatasetRow(image=str(number)),
            )
    with h5py.File(path) as file:
        for name, chunk in (("images", (1, 2, 64, 80)), ("counts", (1, 2, 64, 80)), ("product_masks", (1, 64, 80))):
            assert file[name].chunks == chunk
            assert file[name].compression == "gzip"  # LZF does not give the same bytes each time
        assert file["counts"].id.get_storage_size() < 0.5 * file["counts"].size * 4

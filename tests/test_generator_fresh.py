"""Images made when asked for: their noise is decided by seed, epoch and position."""

import json
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition import Setting, read_dataset
from raytwin.acquisition.dataset_io import DatasetRow, write_dataset
from raytwin.acquisition.setting import filters_from_text
from raytwin.cli import main
from raytwin.generator.datasets.fresh import FreshReferences
from raytwin.generator.datasets.generate import generate_dataset
from raytwin.generator.twins.twin_io import write_twin
from raytwin.segmentation import RECIPES
from raytwin.segmentation.examples import examples_from_dataset

SHAPE = (32, 48)
COPPER = filters_from_text("Cu:0.05")
REFERENCE = (
    Setting(kV=40.0, power_W=40.0, exposure_ms=100.0, filters=COPPER, averaged=10),
    Setting(kV=90.0, power_W=45.0, exposure_ms=100.0, filters=COPPER, averaged=10),
)
RESIDUAL = replace(RECIPES["raytwin"], scaling="residual")
LOW, HIGH = (replace(one, exposure_ms=20.0, averaged=1) for one in REFERENCE)


@pytest.fixture(scope="module")
def twin(make_model_twin):
    return make_model_twin(SHAPE)


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    path = tmp_path_factory.mktemp("fresh") / "references.h5"
    rng = np.random.default_rng(0)
    with write_dataset(path, shape=SHAPE) as writer:
        for number in range(6):
            foreign = np.zeros(SHAPE, dtype=bool)
            if number % 3:
                foreign[10:16, 12:22] = True
            image = np.stack([0.5 + 0.2 * foreign, 0.3 + 0.08 * foreign]) + 0.005 * rng.standard_normal((2, *SHAPE))
            writer.append(
                image=image.astype(np.float32),
                foreign_object_mask=foreign,
                product_mask=np.ones(SHAPE),
                row=DatasetRow(
                    image=f"r{number}",
                    product=f"p{number}",
                    foreign_object="bone" if number % 3 else "",
                    split="val" if number > 3 else "train",
                    setting=f"{REFERENCE[0]};{REFERENCE[1]}",
                ),
            )
    return path


def source(twin, references, **options):
    return FreshReferences(twin, references, **{"low": LOW, "high": HIGH, "seed": 3, **options})


def test_the_same_epoch_is_the_same_image_and_another_epoch_another_noise(twin, references):
    first, again = source(twin, references), source(twin, references)
    one = first.log_images(2, epoch=4)
    np.testing.assert_array_equal(one, again.log_images(2, epoch=4))
    seen = [first.log_images(2, epoch=epoch) for epoch in range(4)]
    for number, image in enumerate(seen):
        for other in seen[number + 1 :]:
            noise = np.corrcoef(image[0].ravel() - 0.5, other[0].ravel() - 0.5)[0, 1]
            assert not np.array_equal(image, other)
            assert abs(noise) < 0.9
    assert not np.array_equal(one, source(twin, references, seed=4).log_images(2, epoch=4))


def test_fresh_noise_is_that_of_a_generated_dataset(tmp_path, twin, references):
    with read_dataset(references) as dataset:
        generate_dataset(twin, dataset, tmp_path / "g.h5", low=LOW, high=HIGH, images=48, seed=1)
    with read_dataset(tmp_path / "g.h5") as made:
        written = made.images(slice(None))[:, :, :8].std(axis=(0, 2, 3))
    fresh = source(twin, references)
    drawn = np.stack([fresh.log_images(number % 6, epoch=number // 6) for number in range(48)])
    np.testing.assert_allclose(drawn[:, :, :8].std(axis=(0, 2, 3)), written, rtol=5 * np.sqrt(3 / (2 * 48 * 8 * 48)))


def test_examples_of_an_epoch_come_from_the_source_and_validation_stays_the_same(twin, references):
    fresh = source(twin, references)
    calls = []

    def images(number, epoch):
        calls.append((number, epoch))
        return fresh.log_images(number, epoch=epoch)

    with read_dataset(references) as dataset:
        examples = examples_from_dataset(dataset, [1, 2], recipe=RESIDUAL, fresh=images)
        first, second = examples.at_epoch(1)[0][0], examples.at_epoch(2)[0][0]
        assert not np.array_equal(first, second)
        np.testing.assert_array_equal(examples[0][0], examples[0][0])
        assert calls == [(1, 1), (1, 2), (1, 0)]
        plain = examples_from_dataset(dataset, [1, 2], recipe=RESIDUAL)
        assert plain.at_epoch(5) is plain


def test_train_draws_noise_anew_and_goes_on_only_with_the_same_source(tmp_path, twin, references, capsys, refused_line):
    pytest.importorskip("segmentation_models_pytorch")
    write_twin(tmp_path / "twin.h5", twin)
    words = ["train", str(references), "-o", str(tmp_path / "runs"), "--epochs", "1", "--batch", "2", "--threads", "1"]
    words += ["--json", "--device", "cpu"]
    fresh = ["--fresh-noise", str(tmp_path / "twin.h5"), "--low", str(LOW), "--high", str(HIGH)]
    assert main([*words, *fresh]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["networks"][0]["epochs"] == 1
    held = json.loads((tmp_path / "runs" / "run.json").read_text())
    assert held["fresh_noise"]["low"] == str(LOW)
    assert "fresh_noise" in refused_line(*words)
    assert "all three" in refused_line(*words, "--fresh-noise", tmp_path / "twin.h5")

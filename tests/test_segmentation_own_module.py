"""A torch module of the user's own: trained, resumed, tried, its weights read elsewhere; what it cannot be is one line."""

import dataclasses
import math

import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition import DatasetRow, read_dataset, write_dataset
from raytwin.errors import InputError
from raytwin.segmentation import RECIPES, build_module, recipe_for_module, segmenter_from_module, train_networks

torch = pytest.importorskip("torch", reason="needs the extra `segmentation`")
WORDS = {"steps": 4, "batch": 2, "seed": 3, "device": "cpu"}


def make():
    return torch.nn.Sequential(
        torch.nn.Conv2d(2, 4, 3, padding=1), torch.nn.BatchNorm2d(4), torch.nn.ReLU(), torch.nn.Conv2d(4, 1, 1)
    )


class Reshaping(torch.nn.Module):
    """Takes its images apart with `view`, which channels-last images do not allow."""

    def __init__(self):
        super().__init__()
        self.mix = torch.nn.Linear(2, 1)

    def forward(self, images):
        image, channel, row, column = images.shape
        return self.mix(images.view(image, channel, row * column).mT).mT.reshape(image, 1, row, column)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Eight images of 40 x 56 pixels with noise and, in every other one, a block."""
    path = tmp_path_factory.mktemp("own") / "images.h5"
    rng = np.random.default_rng(1)
    with write_dataset(path, shape=(40, 56)) as writer:
        for number in range(8):
            bone = number % 2 == 0
            mask = np.zeros((40, 56), dtype=np.uint8)
            mask[10:16, 20:30] = bone
            low = 1.0 + 0.02 * rng.standard_normal((40, 56)) + 0.4 * mask
            high = 0.5 + 0.02 * rng.standard_normal((40, 56)) + 0.1 * mask
            row = DatasetRow(
                image=f"i{number}",
                product=f"p{number}",
                foreign_object="block" if bone else "",
                size_mm=3.0 if bone else math.nan,
                contrast=0.3 if bone else math.nan,
                split="train" if number < 6 else "val",
                setting="low;high",
            )
            writer.append(
                image=np.stack([low, high]).astype(np.float32),
                foreign_object_mask=mask,
                product_mask=np.ones_like(mask),
                row=row,
            )
    return path


@pytest.fixture(scope="module")
def trained(images, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "own"
    return rt.train(images, folder, network=make, networks=2, **WORDS)


def test_networks_of_a_function_differ_and_are_the_same_for_the_same_seed(images, trained, tmp_path):
    first, second = trained.networks
    assert first.weights_sha256 != second.weights_sha256
    state = torch.random.get_rng_state()
    again = rt.train(images, tmp_path / "again", network=make, networks=2, **WORDS)
    assert [item.weights_sha256 for item in again.networks] == [first.weights_sha256, second.weights_sha256]
    assert torch.equal(torch.random.get_rng_state(), state)


def test_the_weights_are_safetensors_that_a_plain_module_takes_and_then_marks_the_same(images, trained):
    from safetensors.torch import load_file

    found = rt.detect(trained, images, split="all", network=make)
    module = make()
    module.load_state_dict(load_file(trained.path / "network_001" / "weights.safetensors"))
    segmenter = segmenter_from_module(module, scaling=trained.recipe.scaling)
    by_hand = rt.detect(segmenter, images, split="all")
    mine = [row.response for row in found.rows if row.network == 1]
    assert mine == pytest.approx([row.response for row in by_hand.rows], abs=1e-6)
    assert len(set(mine)) == 8


def test_a_run_that_was_stopped_ends_in_the_same_weights(images, trained, tmp_path):
    recipe = dataclasses.replace(trained.recipe)

    class StoppedError(Exception):
        pass

    def stop(network, done, wanted, result):
        raise StoppedError

    with read_dataset(images) as dataset:
        words = {"recipe": recipe, "networks": 1, "seed": 3, "network": make}
        with pytest.raises(StoppedError):
            train_networks(dataset, tmp_path / "runs", progress=stop, **words)
        assert (tmp_path / "runs" / "network_000" / "state.pt").is_file()
        (result,) = train_networks(dataset, tmp_path / "runs", **words)
    assert result.weights_sha256 == trained.networks[0].weights_sha256


def test_a_module_is_copied_and_learns_from_its_own_weights(images, tmp_path):
    module = Reshaping()
    before = {name: value.clone() for name, value in module.state_dict().items()}
    copied = build_module(module, recipe=recipe_for_module(RECIPES["raytwin"]), seed=1)
    assert all(torch.equal(value, before[name]) for name, value in copied.state_dict().items())
    found = rt.train(images, tmp_path / "runs", network=module, networks=1, **WORDS)
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())
    losses = [epoch.loss for epoch in found.networks[0].history]
    assert all(math.isfinite(loss) for loss in losses)
    # another start is another folder's
    with torch.no_grad():
        module.mix.bias += 1.0
    with pytest.raises(InputError, match="a folder of networks that differ in network"):
        rt.train(images, tmp_path / "runs", network=module, networks=1, **WORDS)


def test_a_module_with_two_classes_learns_the_published_recipe(images, tmp_path):
    found = rt.train(
        images, tmp_path / "runs", network=lambda: torch.nn.Conv2d(2, 2, 3, padding=1), recipe="as_published", **WORDS
    )
    assert found.recipe.classes == ("product", "foreign_object")
    assert math.isfinite(found.networks[0].best_validation_loss)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (
            torch.nn.Conv2d(2, 3, 1),
            r"network: got an answer of \(1, 3, 64, 64\) to images \(1, 2, 64, 64\); expected logits",
        ),
        (torch.nn.Conv2d(2, 1, 3), r"got an answer of \(1, 1, 62, 62\)"),
        (torch.nn.Conv2d(3, 1, 1), r"got a module that fails on images \(1, 2, 64, 64\)"),
        (lambda: 3, "got a int; expected a torch.nn.Module, or a function"),
        ("FPN", "got a str; expected a torch.nn.Module, or a function"),
    ],
)
def test_a_module_that_cannot_be_trained_is_refused_before_anything_is_written(network, message, images, tmp_path):
    with pytest.raises(InputError, match=message):
        rt.train(images, tmp_path / "runs", network=network, **WORDS)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"encoder": "resnet18"}, "encoder: got resnet18 with a network of your own"),
        ({"workers": 2}, "workers: got 2 with a network of your own"),
        ({"encoder_weights": "imagenet"}, "encoder weights: got imagenet"),
    ],
)
def test_words_of_raytwins_networks_do_not_go_with_a_module(words, message, images, tmp_path):
    with pytest.raises(InputError, match=message):
        rt.train(images, tmp_path / "runs", network=make, **WORDS, **words)


def test_a_folder_of_modules_is_tried_with_its_module_and_no_other(images, trained, tmp_path, refused_line):
    assert "in Python give network=" in refused_line(
        "detect", trained.path, images, "-o", tmp_path / "hits.csv", "--split", "all"
    )
    with pytest.raises(InputError, match="weights: got"):
        rt.detect(trained.path, images, split="all", network=Reshaping)
    with pytest.raises(InputError, match="network: got given beside networks made elsewhere"):
        rt.detect(lambda maps: maps[:, 0] * 0, images, split="all", network=make)

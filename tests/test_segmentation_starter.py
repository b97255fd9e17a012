"""The starter network: it loads, has learnt already, keeps its recipe, and is refused where it does not fit."""

import dataclasses

import numpy as np
import pytest

from raytwin.errors import FileFormatError, InputError
from raytwin.segmentation import (
    RECIPES,
    SCALINGS,
    STARTER_PATH,
    build_network,
    read_safetensors,
    starter_recipe,
    write_safetensors,
)
from raytwin.segmentation.network import probabilities_from_scaled
from raytwin.segmentation.runs import _starting_weights


def pair_with_object(seed):
    """A rounded product with a block of 5 x 8 pixels that only the low kV shows, at five times the noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1:1:96j, -1:1:128j]
    thickness = np.maximum(1.0 - (y**2 + x**2) / 0.6, 0.0) ** 0.5
    image = np.stack([2.0 * thickness, thickness]) + 0.01 * rng.standard_normal((2, 96, 128))
    mask = np.zeros((96, 128), dtype=bool)
    mask[45:50, 60:68] = True
    image[0] += 0.15 * mask
    return image.astype(np.float32), mask


def test_the_starter_finds_an_object_that_a_fresh_network_does_not():
    recipe, weights = read_safetensors(STARTER_PATH)
    image, mask = pair_with_object(1)
    scaled = SCALINGS[recipe.scaling](image)[None]
    found = []
    for trained in (True, False):
        network = build_network(recipe, seed=0, pretrained=False)
        if trained:
            network.load_state_dict(weights)
        marked = probabilities_from_scaled(network, scaled, recipe=recipe)[0] > 0.5
        found.append(marked[mask].mean())
        assert marked[:5].sum() == 0
    assert found[0] > 0.5
    assert found[1] == 0.0


def test_weights_and_recipe_come_back_and_the_same_weights_give_the_same_bytes(tmp_path):
    recipe, weights = read_safetensors(STARTER_PATH)
    for name in ("a", "b"):
        write_safetensors(tmp_path / f"{name}.safetensors", recipe, weights)
    content = (tmp_path / "a.safetensors").read_bytes()
    assert content == (tmp_path / "b.safetensors").read_bytes()
    again = read_safetensors(tmp_path / "a.safetensors")
    assert again[0] == recipe
    assert all(bool((again[1][name] == value).all()) for name, value in weights.items())
    (tmp_path / "a.safetensors").write_bytes(content[:1000])
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_safetensors(tmp_path / "a.safetensors")


def test_a_network_of_another_kind_does_not_start_from_it():
    assert starter_recipe().steps == 60
    with pytest.raises(InputError, match="architecture"):
        _starting_weights(STARTER_PATH, RECIPES["raytwin"])


@pytest.mark.parametrize(("field", "value"), [("architecture", "Nonesuch"), ("encoder", "nonesuch")])
def test_an_unknown_network_is_one_clear_line(field, value):
    with pytest.raises(InputError, match="segmentation-models-pytorch"):
        build_network(dataclasses.replace(RECIPES["raytwin"], **{field: value}), seed=0)

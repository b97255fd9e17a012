"""Weights as safetensors: tensors and text alone, so that reading a file runs no code. The starter network is one of them.

The file's metadata holds the recipe, so that the network can be built again. Floating-point numbers are stored in half
precision (3 significant digits), unless it is asked for otherwise, and read as single precision.
"""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, InputError
from ..files import whole_file
from ._torch import load_torch
from .recipe import Recipe, recipe_from_mapping
from .scaling import MATCHED

STARTER_PATH = Path(__file__).parents[1] / "data" / "starter" / "starter.safetensors"
_KEY = "raytwin_recipe"


def write_safetensors(
    path: str | os.PathLike[str], recipe: Recipe, weights: Mapping[str, Any], *, half: bool = True
) -> None:
    """Write weights with their recipe; the file appears whole or not at all.

    Args:
        path: ends in `.safetensors`.
        recipe: how the network is built and its images are scaled.
        weights: name -> tensor, a network's `state_dict()`.
        half: floating-point numbers in half precision; False: as they are.
    """
    load_torch()
    from safetensors.torch import save

    packed = {
        name: (value.half() if half and value.is_floating_point() else value).detach().cpu().contiguous()
        for name, value in weights.items()
    }
    # one key alone: safetensors writes several in an order that changes from run to run
    content = save(packed, metadata={_KEY: json.dumps(dataclasses.asdict(recipe))})
    with whole_file(path) as temporary:
        temporary.write_bytes(content)


def read_safetensors(path: str | os.PathLike[str]) -> tuple[Recipe, dict[str, Any]]:
    """Recipe and weights (single precision) of a file that `write_safetensors` wrote.

    Raises:
        FileFormatError: not there, truncated, or without a recipe that this version knows.
    """
    load_torch()
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as held:
            metadata = held.metadata() or {}
            weights = {name: held.get_tensor(name) for name in held.keys()}  # noqa: SIM118
        recipe = recipe_from_mapping(json.loads(metadata[_KEY]))
    except (FileNotFoundError, OSError, SafetensorError) as error:
        received = f"a file that cannot be read ({' '.join(str(error).split())[:60]})"
    except (InputError, KeyError, TypeError, ValueError) as error:
        received = f"no recipe that can be used ({error})"
    else:
        return recipe, {name: value.float() if value.is_floating_point() else value for name, value in weights.items()}
    raise FileFormatError(
        str(path),
        received=received,
        expected="a safetensors file with the recipe in its metadata, see write_safetensors",
    )


def starter_recipe() -> Recipe:
    """The recipe that a network which starts from the starter is trained with: a few steps, at a small rate, along
    the direction of what it is to find.

    Raises:
        FileFormatError: the package came without the starter.
    """
    recipe, _ = read_safetensors(STARTER_PATH)
    return dataclasses.replace(recipe, scaling=MATCHED, steps=60, epochs=None, learning_rate=recipe.learning_rate / 4)
